//! The start of the program at an instant of common time.

use std::time::Duration;

use super::Supervisor;
use super::program::Turn;
use crate::clock::{self, Nanos};
use crate::config::{Action, Step};
use crate::report::{Cause, Error};
use crate::rt::channel::{COMMANDS_PER_CYCLE, RtCommand, Snapshot};
use crate::rt::common_time::CommonTimeStatus;
use crate::rt::cycle::StartState;
use crate::rt::phase::ClockPlan;

/// The farthest instant, in ns from now.
pub const MAX_START_DELAY: Nanos = 3_600_000_000_000;
/// The time before the instant at which the first step is sent to the cycle. It is longer than
/// stalls of this thread.
const LEAD: Nanos = 200_000_000;
const LEAD_CYCLES: u64 = 10;

/// The wait for SYNC0 to be at its place in common time, before Op.
#[derive(Debug)]
pub(super) struct AlignmentWait {
    began: Nanos,
    aligned: Option<Nanos>,
}

impl AlignmentWait {
    /// The longest wait in ns.
    const TIMEOUT: Nanos = 10_000_000_000;
    /// The time in which the other clocks follow the corrected reference clock.
    const SETTLING_TIME: Nanos = 500_000_000;

    pub fn new() -> Self {
        let (began, aligned) = (clock::now(), None);
        Self { began, aligned }
    }

    /// Returns the time that the wait adds to others.
    pub fn timeout(plan: Option<&ClockPlan>) -> Nanos {
        let aligns = plan.is_some_and(|plan| plan.align);
        if aligns { Self::TIMEOUT } else { 0 }
    }

    /// Returns true once SYNC0 is aligned, or has had the time for it.
    pub fn is_over(&mut self, common: &CommonTimeStatus) -> bool {
        let Some(alignment) = common.alignment else {
            return true;
        };
        let now = clock::now();
        self.aligned = alignment.aligned.then(|| self.aligned.unwrap_or(now));
        let since = |from: Nanos| now.saturating_sub(from);
        self.aligned
            .is_some_and(|at| since(at) >= Self::SETTLING_TIME)
            || since(self.began) >= Self::TIMEOUT
    }

    /// Returns a warning if SYNC0 is not aligned.
    pub fn warning(common: &CommonTimeStatus) -> Option<String> {
        let alignment = common.alignment.filter(|alignment| !alignment.aligned)?;
        Some(match common.locked {
            false => "SYNC0 is not aligned: common time is not locked".to_owned(),
            true => format!(
                "SYNC0 is {:.1} µs from its place in common time; it approaches with 1 ppm",
                alignment.sync0_ns / 1000.0
            ),
        })
    }
}

/// An instant of common time at which the program starts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct CommonStart {
    /// In ns since 1970, a multiple of the cycle.
    at: u64,
    /// The jumps of common time before.
    jumps: u64,
}

impl CommonStart {
    /// Returns the start at the multiple of the cycle that is next to an instant.
    ///
    /// # Errors
    /// The reason to refuse the instant.
    pub fn new(
        at_unix_ns: u64,
        cycle_ns: Nanos,
        common: &CommonTimeStatus,
    ) -> Result<Self, String> {
        if !common.locked {
            return Err("common time is not locked".to_owned());
        }
        let now = common_now(common);
        let Some(ahead) = at_unix_ns.checked_sub(now).filter(|ahead| *ahead > 0) else {
            let late_ms = (now - at_unix_ns) / 1_000_000;
            return Err(format!("the instant is {late_ms} ms in the past"));
        };
        if ahead > MAX_START_DELAY {
            return Err("the instant is more than 1 h ahead".to_owned());
        }
        let cycle = cycle_ns.max(1);
        let at = at_unix_ns.saturating_add(cycle / 2) / cycle * cycle;
        let jumps = common.jumps;
        Ok(Self { at, jumps })
    }

    /// Returns the commands as parts that wait for the instant.
    pub fn defer(self, commands: &[RtCommand]) -> Vec<Vec<RtCommand>> {
        let parts = commands.chunks(COMMANDS_PER_CYCLE - 1);
        let defer = |part: &[RtCommand]| {
            let (at, count) = (self.at, part.len());
            let mut all = vec![RtCommand::Defer { at, count }];
            all.extend_from_slice(part);
            all
        };
        parts.map(defer).collect()
    }
}

fn common_now(common: &CommonTimeStatus) -> u64 {
    clock::now().wrapping_add_signed(common.host_offset_ns)
}

/// Returns true if a step commands something as it begins, and does not wait first.
fn commands_at_once(step: &Step) -> bool {
    match &step.action {
        Action::Repeat { steps, .. } | Action::Call { steps, .. } => {
            steps.first().is_some_and(commands_at_once)
        }
        Action::Parallel { branches } => branches
            .iter()
            .all(|steps| steps.first().is_some_and(commands_at_once)),
        Action::Enable { .. }
        | Action::Move { .. }
        | Action::Line { .. }
        | Action::Wave { .. }
        | Action::Table { .. }
        | Action::Gear { .. }
        | Action::Velocity { .. }
        | Action::Torque { .. }
        | Action::Set { .. } => true,
        _ => false,
    }
}

impl Turn<'_, '_> {
    /// Waits until shortly before the instant. The commands of the first step then wait in the
    /// cycle. A program that begins otherwise starts here, as soon as the instant is over.
    pub(super) async fn await_start(&mut self, start: CommonStart) -> Result<(), Error> {
        let lead = LEAD + LEAD_CYCLES * self.machine.bus.cycle_ns;
        loop {
            let common = self.poll_and_query().await?.common_time;
            let lost = if common.jumps != start.jumps {
                Some("common time has jumped")
            } else if !common.locked {
                Some("common time is not locked")
            } else if common_now(&common) >= start.at {
                Some("the axes were enabled too late")
            } else {
                None
            };
            if let Some(why) = lost {
                return Err(missed(why));
            }
            if common_now(&common).saturating_add(lead) >= start.at {
                break;
            }
        }
        self.start = Some(start);
        if self.machine.steps.first().is_some_and(commands_at_once) {
            return Ok(());
        }
        let (at, count) = (start.at, 0);
        self.send_now(&[RtCommand::Defer { at, count }]).await;
        while self.start.is_some() {
            self.poll_and_query().await?;
        }
        Ok(())
    }
}

fn missed(why: &str) -> Error {
    let why = why.to_owned();
    Cause::StartMissed { why }.into()
}

impl Supervisor {
    /// Ends the wait for the instant once the cycle has begun. Fails if the cycle has dropped the
    /// commands.
    pub(super) fn follow_start(&mut self, snapshot: &Snapshot) -> Result<(), Error> {
        let Some(start) = self.start else {
            return Ok(());
        };
        match snapshot.start {
            StartState::Begun { at, cycle } if at == start.at => {
                tracing::info!(at, cycle, "common start");
                self.start = None;
            }
            StartState::Dropped { at, cause } if at == start.at => {
                self.start = None;
                return Err(missed(&cause.to_string()));
            }
            _ => {}
        }
        Ok(())
    }

    /// Drops commands that wait for the instant.
    pub(super) async fn cancel_start(&mut self) {
        self.start = None;
        self.send_now(&[RtCommand::CancelStart]).await;
    }

    /// Returns a task that reads the offset of a reference clock for the cycle, which corrects it.
    pub(super) fn keep_offset(&self) -> impl Future<Output = ()> + use<> {
        /// The time between two looks.
        const LOOK: Duration = Duration::from_millis(5);
        let aligns = self.bus.dc.as_ref().is_some_and(|plan| plan.align);
        let (wire, status) = (self.wire, std::sync::Arc::clone(&self.bus_status));
        let devices = self.bus.devices.iter().map(|device| device.at.clone());
        let devices: Vec<_> = devices.collect();
        async move {
            if !aligns {
                return;
            }
            loop {
                clock::delay(LOOK).await;
                let Some(wanted) = status.wanted_offset() else {
                    continue;
                };
                let Some(device) = devices.get(wanted.0) else {
                    continue;
                };
                // It is wanted until it was read.
                match crate::bringup::clock_offset(&wire, device).await {
                    Ok(offset) => status.set_offset(wanted, offset),
                    Err(error) => tracing::info!("{error}"),
                }
            }
        }
    }
}
