//! A move that an edge at a touch probe's input ends.
//!
//! The drive takes the position of the edge in hardware; the axis stops in the cycle in which the drive shows it. What is
//! looked at here comes later, and only decides whether the step has done what it is for.

use ecaxis_axis::units::UserUnits;
use ecaxis_axis::{Command, Edge, Probe, ProbeStatus, Source};

use super::{Aim, Settling, Supervisor};
use crate::clock::{self, Nanos};
use crate::config::Step;
use crate::rt::handover::Snapshot;
use crate::session::{Capture, Progress, RunError};

/// How long the drive may take to show in 0x60B9 that it watches the input.
const ARM_TIMEOUT: Nanos = 1_000_000_000;
/// How long after the arrival an edge may still be shown that came on the way.
const LATE_EDGE: Nanos = 50_000_000;

/// What is searched, and where.
#[derive(Debug, Clone, Copy)]
pub(super) struct Search {
    pub device: usize,
    pub probe: Probe,
    pub edge: Edge,
    pub relative: bool,
    pub target: f64,
    /// Fractions of the axis' limits.
    pub speed: f64,
    pub ramp: f64,
}

impl Supervisor {
    pub(super) async fn probe(
        &mut self,
        step: &Step,
        start: Nanos,
        run: u32,
        search: Search,
    ) -> Result<(), RunError> {
        let Search {
            device,
            probe,
            speed,
            ramp,
            ..
        } = search;
        let Some(&axis) = self.places(&[device]).first() else {
            return Ok(());
        };
        self.arm(step, start, axis, &search).await?;
        let there = self
            .destinations(search.relative, &[(device, search.target)])
            .await?;
        if self.over(start) {
            return Ok(());
        }
        let target = there.first().map_or(search.target, |&(_, target)| target);
        // An edge that came meanwhile leaves nothing to search.
        let found = |status: ProbeStatus| match status {
            ProbeStatus::Captured { position } => Some(position),
            _ => None,
        };
        if found(self.tick().await?.axes[axis].probes[probe.index()]).is_none() {
            let go = Command::MoveTo {
                position: target,
                speed,
                ramp,
            };
            self.command([(axis, go)].into_iter()).await;
        }
        let mut settling = Settling::default();
        let mut arrived = None;
        let mut captured = None;
        self.watch(step, start, |this, snapshot| {
            let status = &snapshot.axes[axis];
            captured = found(status.probes[probe.index()]);
            if captured.is_some() {
                return Ok(true);
            }
            if status.moving {
                arrived = None;
                settling = Settling::default();
            } else if status.in_target {
                let since = *arrived.get_or_insert_with(clock::now);
                if clock::now().saturating_sub(since) > LATE_EDGE {
                    return Err(this.not_probed(step, axis, target, &search));
                }
            } else if settling.over() {
                return Err(this.not_reached(step, axis, Aim::Position, target, status));
            }
            Ok(false)
        })
        .await?;
        let Some(position) = captured else {
            return Ok(());
        };
        // It stops already, unless the edge came in the very cycle that took the move.
        self.command([(axis, Command::Stop)].into_iter()).await;
        let resting = |s: &Snapshot, axis: usize| !s.axes[axis].moving && s.axes[axis].at_rest;
        self.until(step, start, resting, &[axis]).await?;
        self.keep(step, run, axis, &search, position);
        Ok(())
    }

    /// Until the drive says that it watches the input.
    async fn arm(
        &mut self,
        step: &Step,
        start: Nanos,
        axis: usize,
        search: &Search,
    ) -> Result<(), RunError> {
        let arm = Command::ArmProbe {
            probe: search.probe,
            edge: search.edge,
            source: Source::Input,
            stop: true,
        };
        self.command([(axis, arm)].into_iter()).await;
        let begun = clock::now();
        let at = search.probe.index();
        self.watch(step, start, |this, snapshot| {
            let status = snapshot.axes[axis].probes[at];
            if matches!(status, ProbeStatus::Armed | ProbeStatus::Captured { .. }) {
                return Ok(true);
            }
            if clock::now().saturating_sub(begun) > ARM_TIMEOUT {
                return Err(RunError::ProbeNotArmed {
                    device: this.device_of(axis),
                    step: step.into(),
                    input: search.probe.number(),
                    timeout_ms: ARM_TIMEOUT / 1_000_000,
                });
            }
            Ok(false)
        })
        .await
    }

    fn not_probed(&self, step: &Step, axis: usize, target: f64, search: &Search) -> RunError {
        let setup = self.setup(axis);
        let place = |position| match setup {
            Some(setup) => setup.config.scale.place(UserUnits(position)).0,
            None => position,
        };
        RunError::NotProbed {
            device: self.device_of(axis),
            step: step.into(),
            input: search.probe.number(),
            edge: edge_word(search.edge),
            target: place(target),
            unit: setup.map_or(String::new(), |setup| setup.unit.clone()),
        }
    }

    /// Tells what was captured, and keeps it for the summary.
    fn keep(&mut self, step: &Step, run: u32, axis: usize, search: &Search, position: f64) {
        let setup = self.setup(axis);
        let scale = setup.map(|setup| &setup.config.scale);
        let found = Capture {
            step: step.number.clone(),
            axis: self.axis_name(axis),
            input: search.probe.number(),
            edge: edge_word(search.edge),
            times: 1,
            position,
            place: scale
                .filter(|scale| scale.modulo().is_some())
                .map(|scale| scale.place(UserUnits(position)).0),
            unit: setup.map_or(String::new(), |setup| setup.unit.clone()),
        };
        self.tell(Progress::Captured {
            run,
            capture: found.clone(),
        });
        let same = |known: &&mut Capture| known.step == found.step;
        match self.captures.iter_mut().find(same) {
            Some(known) => {
                *known = Capture {
                    times: known.times.saturating_add(1),
                    ..found
                }
            }
            None => self.captures.push(found),
        }
    }
}

const fn edge_word(edge: Edge) -> &'static str {
    match edge {
        Edge::Positive => "rising",
        Edge::Negative => "falling",
    }
}
