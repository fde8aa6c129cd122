//! Branches of a program that run at the same time take turns. One of them has the supervisor, and
//! gives it away while it waits for the next snapshot.

use std::ops::{Deref, DerefMut};

use tokio::sync::{Mutex, MutexGuard};

use super::super::{Supervisor, TICK};
use crate::clock::{self, Nanos};
use crate::concurrent::try_join_all;
use crate::config::Step;
use crate::report::Error;
use crate::rt::channel::Snapshot;

/// The supervisor in the hands of one branch.
#[derive(Debug)]
pub(in crate::supervise) struct Turn<'m, 's> {
    shared: &'m Mutex<&'s mut Supervisor>,
    /// `None` only while the branch waits.
    held: Option<MutexGuard<'m, &'s mut Supervisor>>,
}

impl<'m, 's> Turn<'m, 's> {
    /// Waits until no other branch has the supervisor.
    pub async fn take(shared: &'m Mutex<&'s mut Supervisor>) -> Self {
        let held = Some(shared.lock().await);
        Self { shared, held }
    }

    /// Waits for the next snapshot, while other branches run, and until stopped groups are reported.
    /// Fails if the cycle has stopped the
    /// machine.
    pub async fn poll_and_query(&mut self) -> Result<Snapshot, Error> {
        loop {
            self.held = None;
            clock::delay(TICK).await;
            self.held = Some(self.shared.lock().await);
            let snapshot = self.take_snapshot().await?;
            if self.report_stopped_groups(&snapshot).await {
                return Ok(snapshot);
            }
        }
    }

    /// Runs all branches until each has ended. The first failure ends the others.
    pub async fn run_parallel(
        &mut self,
        branches: &[Vec<Step>],
        run: u32,
        start: Nanos,
    ) -> Result<(), Error> {
        let shared = self.shared;
        self.held = None;
        let each = branches.iter().map(|steps| async move {
            let mut turn = Turn::take(shared).await;
            turn.run_steps(steps, run, start).await
        });
        let result = try_join_all(each).await;
        self.held = Some(shared.lock().await);
        result.map(drop)
    }
}

impl Deref for Turn<'_, '_> {
    type Target = Supervisor;

    fn deref(&self) -> &Supervisor {
        self.held.as_ref().expect("the branch has its turn")
    }
}

impl DerefMut for Turn<'_, '_> {
    fn deref_mut(&mut self) -> &mut Supervisor {
        self.held.as_mut().expect("the branch has its turn")
    }
}
