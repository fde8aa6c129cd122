//! A move that ends at an edge of a touch probe's input.
//!
//! The drive captures the position of the edge in hardware. The axis stops in the cycle in which
//! the drive shows the edge. The code here runs later and only decides whether the step has
//! succeeded.

use ecaxis_axis::units::UserUnits;
use ecaxis_axis::{Command, Edge, Probe, ProbeStatus, Source};
use ecaxis_ecat::index::AxisIndex;

use super::{Settling, TargetKind, Turn};
use crate::clock::{self, Nanos};
use crate::config::Step;
use crate::report::{Cause, Error, ProbeCapture, Progress};
use crate::rt::channel::Snapshot;

/// The timeout in ns until 0x60B9 shows that the drive watches the input.
const ARM_TIMEOUT: Nanos = 1_000_000_000;
/// The time in ns after arrival during which an edge from the move may still appear.
const LATE_EDGE: Nanos = 50_000_000;

/// The target, input and edge of a search.
#[derive(Debug, Clone, Copy)]
pub(super) struct ProbeMove {
    pub axis: AxisIndex,
    pub probe: Probe,
    pub edge: Edge,
    pub relative: bool,
    pub target: f64,
    /// Fractions of the axis's limits.
    pub speed: f64,
    pub ramp: f64,
}

impl Turn<'_, '_> {
    pub(super) async fn probe(
        &mut self,
        step: &Step,
        start: Nanos,
        run: u32,
        search: ProbeMove,
    ) -> Result<(), Error> {
        let ProbeMove {
            axis,
            probe,
            speed,
            ramp,
            ..
        } = search;
        self.arm(step, start, axis, &search).await?;
        let there = self
            .destinations(search.relative, &[(axis, search.target)])
            .await?;
        if self.over(start) {
            return Ok(());
        }
        let target = there.first().map_or(search.target, |&(_, target)| target);
        // An edge may already have occurred; then no move is needed.
        let found = |status: ProbeStatus| match status {
            ProbeStatus::Captured { position } => Some(position),
            _ => None,
        };
        if found(self.poll_and_query().await?.axes[axis].probes[probe.index()]).is_none() {
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
        self.wait_until(step, start, |this, snapshot| {
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
            } else if settling.time_limit_reached() {
                return Err(this.not_reached(step, axis, TargetKind::Position, target, snapshot));
            }
            Ok(false)
        })
        .await?;
        let Some(position) = captured else {
            return Ok(());
        };
        // The axis already stops, unless the edge came in the cycle that accepted the move.
        self.command([(axis, Command::Stop)].into_iter()).await;
        let resting = |s: &Snapshot, axis: AxisIndex| !s.axes[axis].moving && s.axes[axis].at_rest;
        self.until(step, start, resting, &[axis]).await?;
        self.keep(step, run, axis, &search, position);
        Ok(())
    }

    /// Waits until the drive reports that it watches the input.
    async fn arm(
        &mut self,
        step: &Step,
        start: Nanos,
        axis: AxisIndex,
        search: &ProbeMove,
    ) -> Result<(), Error> {
        let arm = Command::ArmProbe {
            probe: search.probe,
            edge: search.edge,
            source: Source::Input,
            stop: true,
        };
        self.command([(axis, arm)].into_iter()).await;
        let begun = clock::now();
        let at = search.probe.index();
        self.wait_until(step, start, |this, snapshot| {
            let status = snapshot.axes[axis].probes[at];
            if matches!(status, ProbeStatus::Armed | ProbeStatus::Captured { .. }) {
                return Ok(true);
            }
            if clock::now().saturating_sub(begun) > ARM_TIMEOUT {
                return Err(Cause::ProbeNotArmed {
                    input: search.probe.number(),
                    timeout_ms: ARM_TIMEOUT / 1_000_000,
                }
                .with_device(this.device_of(axis))
                .with_step(step));
            }
            Ok(false)
        })
        .await
    }

    fn not_probed(&self, step: &Step, axis: AxisIndex, target: f64, search: &ProbeMove) -> Error {
        let setup = self.setup(axis);
        let place = |position| match setup {
            Some(setup) => setup.config.scale.place(UserUnits(position)).0,
            None => position,
        };
        Cause::NotProbed {
            input: search.probe.number(),
            edge: edge_word(search.edge),
            target: place(target),
            unit: setup.map_or(String::new(), |setup| setup.unit.clone()),
        }
        .with_device(self.device_of(axis))
        .with_step(step)
    }

    /// Reports what was captured and stores it for the summary.
    fn keep(&mut self, step: &Step, run: u32, axis: AxisIndex, search: &ProbeMove, position: f64) {
        let setup = self.setup(axis);
        let scale = setup.map(|setup| &setup.config.scale);
        let found = ProbeCapture {
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
        self.report(Progress::Captured {
            run,
            capture: found.clone(),
        });
        let same = |known: &&mut ProbeCapture| known.step == found.step;
        match self.captures.iter_mut().find(same) {
            Some(known) => {
                *known = ProbeCapture {
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
