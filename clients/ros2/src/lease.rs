//! The lease and the cyclic area: a thread that gets them, keeps them, and gets them again.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use ecaxis_client::{Cyclic, Error, Machine, Samples};
use serde_json::json;

use crate::cycle::{Columns, Cycle, Message, Report};
use crate::follower::Follower;
use crate::joints::Joint;
use crate::options::Options;
use crate::services::LeaseRequest;
use crate::status::NodeStatus;

/// The longest silence of the node.
pub const LEASE: Duration = Duration::from_secs(1);
/// The pause between two looks at the lease.
const KEEP: Duration = Duration::from_millis(100);
/// The pause before the next attempt.
const RETRY: Duration = Duration::from_millis(500);

/// The samples, and where the values of each joint are in a row.
pub type KnownSamples = (Samples, Arc<Vec<Columns>>);

/// What the threads share.
#[derive(Debug, Clone)]
pub struct Shared {
    pub machine: Arc<Machine>,
    pub joints: Arc<Vec<Joint>>,
    pub options: Arc<Options>,
    status: Arc<Mutex<NodeStatus>>,
    /// The samples and the columns of the joints, once they are known.
    samples: Arc<Mutex<Option<KnownSamples>>>,
    /// The node ends.
    pub ends: Arc<AtomicBool>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Returns an error as a text of `/diagnostics` and of services.
#[must_use]
pub fn text(error: Error) -> String {
    match error.help {
        Some(help) => format!("{}; help: {help}", error.cause),
        None => error.cause.into(),
    }
}

impl Shared {
    #[must_use]
    pub fn new(
        machine: Machine,
        joints: Vec<Joint>,
        options: Options,
        ends: Arc<AtomicBool>,
    ) -> Self {
        Self {
            machine: Arc::new(machine),
            status: Arc::new(Mutex::new(NodeStatus::new(joints.len()))),
            joints: Arc::new(joints),
            options: Arc::new(options),
            samples: Arc::default(),
            ends,
        }
    }

    /// Changes the state of the node.
    pub fn update(&self, change: impl FnOnce(&mut NodeStatus)) {
        change(&mut lock(&self.status));
    }

    /// Returns the state of the node.
    #[must_use]
    pub fn status(&self) -> NodeStatus {
        lock(&self.status).clone()
    }

    /// Returns the samples; `None` before the node has had the lease.
    #[must_use]
    pub fn samples(&self) -> Option<KnownSamples> {
        lock(&self.samples).clone()
    }

    #[must_use]
    pub fn ends(&self) -> bool {
        self.ends.load(Ordering::Relaxed)
    }
}

/// Keeps the lease until the node ends.
///
/// # Errors
/// Fails if the system gives no thread.
pub fn keep_lease(
    shared: &Shared,
    requests: &Receiver<LeaseRequest>,
    messages: Receiver<Message>,
    reports: &Sender<(usize, Report)>,
) -> Result<(), String> {
    // The messages go from one cycle to the next.
    let messages = Arc::new(Mutex::new(messages));
    let mut wanted = true;
    // The service `take`, which waits for its answer.
    let mut taking: Option<Sender<Result<(), String>>> = None;
    while !shared.ends() {
        if wanted {
            let attached = attach(shared, taking.is_some());
            if let Some(answer) = taking.take() {
                let _ = answer.send(attached.as_ref().map(drop).map_err(Clone::clone));
            }
            match attached {
                Ok((cyclic, columns)) => {
                    shared.update(|status| status.no_lease = None);
                    let dt_s = cyclic.cycle_time().as_secs_f64();
                    let follower =
                        |joint| Follower::new(Follower::config(joint, &shared.options, dt_s));
                    let followers = shared.joints.iter().map(follower).collect();
                    let mut cycle = Cycle::new(cyclic, columns, followers, reports.clone());
                    let ended = Arc::new(AtomicBool::new(false));
                    let (stop, queue) = (Arc::clone(&ended), Arc::clone(&messages));
                    let thread = thread::Builder::new()
                        .name("cycle".to_owned())
                        .spawn(move || {
                            let queue = lock(&queue);
                            // Commands from before do not count.
                            while queue.try_recv().is_ok() {}
                            cycle.run(&queue, &stop);
                        });
                    let thread = thread.map_err(|error| format!("no thread: {error}"))?;
                    let kept = keep(shared, requests, &thread);
                    ended.store(true, Ordering::Relaxed);
                    let _ = thread.join();
                    match kept {
                        Kept::Lost(why) => shared.update(|status| status.no_lease = Some(why)),
                        Kept::Take(answer) => taking = Some(answer),
                        Kept::Release(answer) => {
                            let _ = answer.send(shared.machine.release().map_err(text));
                            wanted = false;
                            let why = "the service release has given it back".to_owned();
                            shared.update(|status| status.no_lease = Some(why));
                        }
                    }
                    continue;
                }
                Err(why) => shared.update(|status| status.no_lease = Some(why)),
            }
        }
        match requests.recv_timeout(RETRY) {
            Ok(LeaseRequest::Take(answer)) => (wanted, taking) = (true, Some(answer)),
            Ok(LeaseRequest::Release(answer)) => {
                wanted = false;
                let _ = answer.send(Ok(()));
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return Ok(()),
        }
    }
    let _ = shared.machine.release();
    Ok(())
}

enum Kept {
    Lost(String),
    Take(Sender<Result<(), String>>),
    Release(Sender<Result<(), String>>),
}

/// Gets the lease and the area.
fn attach(shared: &Shared, force: bool) -> Result<(Cyclic, Vec<Columns>), String> {
    let machine = &shared.machine;
    let bus = machine.request("state", json!({})).map_err(text)?;
    if bus["bus"]["state"] != "op" {
        let error = bus["bus"]["error"]
            .as_str()
            .map(|error| format!(": {error}"));
        return Err(format!("the bus is not in Op{}", error.unwrap_or_default()));
    }
    machine.take(force).map_err(text)?;
    let cyclic = machine.cyclic().map_err(text)?;
    let columns = Columns::of_joints(&cyclic, &shared.joints).map_err(text)?;
    let known = (cyclic.samples().clone(), Arc::new(columns.clone()));
    *lock(&shared.samples) = Some(known);
    Ok((cyclic, columns))
}

/// Renews the lease until it is lost.
fn keep(
    shared: &Shared,
    requests: &Receiver<LeaseRequest>,
    cycle: &thread::JoinHandle<()>,
) -> Kept {
    loop {
        match requests.recv_timeout(KEEP) {
            Ok(LeaseRequest::Take(answer)) => return Kept::Take(answer),
            Ok(LeaseRequest::Release(answer)) => return Kept::Release(answer),
            Err(RecvTimeoutError::Timeout) if !shared.ends() => {}
            Err(_) => return Kept::Lost("the node ends".to_owned()),
        }
        if cycle.is_finished() {
            return Kept::Lost("the bus has no cycles".to_owned());
        }
        if let Err(error) = shared.machine.keep() {
            return Kept::Lost(text(error));
        }
    }
}
