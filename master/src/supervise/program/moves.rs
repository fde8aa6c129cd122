//! Steps that move axes to their own targets or change their modes.

use std::sync::Arc;

use ecaxis_axis::units::UserUnits;
use ecaxis_axis::{AxisStatus, Command, Mode};
use ecaxis_ecat::index::{AxisIndex, IndexVec};

use super::{Settling, Stall, TargetKind, Turn};
use crate::clock::Nanos;
use crate::config::Step;
use crate::report::{Cause, Error};
use crate::rt::channel::Snapshot;

impl Turn<'_, '_> {
    /// Starts all moves in the same cycle; each arrives on its own. `part`: fraction of the
    /// velocity and acceleration limits.
    pub(super) async fn move_each(
        &mut self,
        step: &Step,
        start: Nanos,
        relative: bool,
        targets: &[(AxisIndex, f64)],
        [speed, ramp]: [f64; 2],
    ) -> Result<(), Error> {
        let targets = self.destinations(relative, targets).await?;
        self.move_and_wait(step, start, TargetKind::Position, &targets, |position| {
            Command::MoveTo {
                position,
                speed,
                ramp,
            }
        })
        .await
    }

    /// Returns target positions, relative ones from the axes' present set-points.
    pub(in crate::supervise) async fn destinations(
        &mut self,
        relative: bool,
        targets: &[(AxisIndex, f64)],
    ) -> Result<Vec<(AxisIndex, f64)>, Error> {
        let turning = targets.iter().any(|&(axis, _)| self.modulo(axis));
        let origin = if relative || turning {
            self.poll_and_query().await?.axes
        } else {
            IndexVec::default()
        };
        let there = targets.iter().map(|&(axis, target)| {
            let from = origin.get(axis).map_or(0.0, |s| s.target_position);
            let target = if relative {
                from + target
            } else {
                self.resolve_target(axis, from, target)
            };
            (axis, target)
        });
        Ok(there.collect())
    }

    fn modulo(&self, axis: AxisIndex) -> bool {
        let setup = self.setup(axis);
        setup.is_some_and(|s| s.config.scale.modulo().is_some())
    }

    pub(super) async fn switch(
        &mut self,
        step: &Step,
        start: Nanos,
        targets: &[(AxisIndex, Mode)],
    ) -> Result<(), Error> {
        let axes: Vec<_> = targets.iter().map(|&(axis, _)| axis).collect();
        let commands = targets.iter();
        let commands = commands.map(|&(axis, mode)| (axis, Command::SetMode(mode)));
        self.command_at_rest(step, start, &commands.collect::<Vec<_>>())
            .await?;
        let machine = Arc::clone(&self.machine);
        let there = |s: &Snapshot, axis: AxisIndex| {
            let wanted = targets.iter().find(|(a, _)| *a == axis);
            let status = &s.axes[axis];
            // With the power, the brake opens again.
            let unpowered = machine.axes[axis].config.mode_change_unpowered;
            let opens = unpowered && status.powered && !status.ready;
            Some(status.mode) == wanted.map(|(_, mode)| *mode)
                && status.switching.is_none()
                && !opens
        };
        self.until(step, start, there, &axes).await
    }

    /// Commands every axis to its target and waits until all have arrived. Fails if an axis does
    /// not follow its arrived set-point.
    pub(in crate::supervise) async fn move_and_wait(
        &mut self,
        step: &Step,
        start: Nanos,
        aim: TargetKind,
        targets: &[(AxisIndex, f64)],
        command: impl Fn(f64) -> Command,
    ) -> Result<(), Error> {
        self.command(
            targets
                .iter()
                .map(|&(axis, target)| (axis, command(target))),
        )
        .await;
        let mut settling = Settling::default();
        let mut stall = Stall::default();
        let mut superimposed = false;
        self.wait_until(step, start, |this, snapshot| {
            let status = |axis: AxisIndex| &snapshot.axes[axis];
            // A superimposed move lets the axis follow a generator.
            let follows = |axis: AxisIndex| snapshot.generators[axis].runs();
            superimposed |= targets.iter().any(|&(axis, _)| follows(axis));
            // Whatever replaces a move leads elsewhere.
            let replaced = |axis: AxisIndex, target: f64| {
                let commanded = status(axis).commanded_target;
                aim == TargetKind::Position && !superimposed && commanded != Some(target)
            };
            let arrived = |axis: AxisIndex, target: f64| {
                status(axis).in_target && !follows(axis) && !replaced(axis, target)
            };
            let late = targets
                .iter()
                .find(|&&(axis, target)| !arrived(axis, target));
            let Some(&(axis, target)) = late else {
                return Ok(true);
            };
            // A profile of the drive may never end: the axis is blocked, or bit 10 does not come.
            let profile = matches!(status(axis).mode, Mode::Pp | Mode::Pv);
            if profile && !follows(axis) && !this.is_held(snapshot, axis) {
                let scale = this.setup(axis).map(|setup| setup.config.scale);
                let count = scale.map_or(0.0, |scale| scale.units_of_counts(1.0).abs());
                let position = status(axis).position;
                let progress = match aim {
                    TargetKind::Velocity if target == 0.0 => -status(axis).velocity.abs(),
                    TargetKind::Velocity => position * target.signum(),
                    _ => -(target - position).abs(),
                };
                if stall.time_limit_reached(axis, progress, count) {
                    return Err(this.not_reached(step, axis, aim, target, snapshot));
                }
            } else {
                stall = Stall::default();
            }
            let on_its_way = |axis: AxisIndex| {
                follows(axis) || status(axis).moving && !status(axis).held_by_range
            };
            if targets.iter().any(|&(axis, _)| on_its_way(axis)) {
                settling = Settling::default();
                return Ok(false);
            }
            if settling.time_limit_reached() {
                return Err(this.not_reached(step, axis, aim, target, snapshot));
            }
            Ok(false)
        })
        .await
    }

    /// Returns the error of an axis that missed its target. `target`: as in [`Command`].
    pub(in crate::supervise) fn not_reached(
        &self,
        step: &Step,
        axis: AxisIndex,
        aim: TargetKind,
        target: f64,
        snapshot: &Snapshot,
    ) -> Error {
        let axis = self.later_half(axis, snapshot);
        let last = &snapshot.axes[axis];
        let (target, actual, unit) = self.to_display_unit(axis, aim, target, last);
        Cause::NotReached {
            target,
            actual,
            unit,
        }
        .with_device(self.device_of(axis))
        .with_step(step)
    }

    /// Returns the half of the axis' gantry that is farther from its set-point.
    fn later_half(&self, axis: AxisIndex, snapshot: &Snapshot) -> AxisIndex {
        let error = |axis: AxisIndex| {
            let status = &snapshot.axes[axis];
            (status.target_position - status.position).abs()
        };
        let other = self.machine.other_half(axis);
        other
            .filter(|&other| error(other) > error(axis))
            .unwrap_or(axis)
    }

    /// Converts a target and the reported value to the file's unit; positions of a modulo axis lie
    /// within one turn.
    fn to_display_unit(
        &self,
        axis: AxisIndex,
        aim: TargetKind,
        target: f64,
        last: &AxisStatus,
    ) -> (f64, f64, String) {
        let Some(setup) = self.setup(axis) else {
            return (target, last.position, String::new());
        };
        match aim {
            TargetKind::Velocity => (target, last.velocity, format!("{}/s", setup.unit)),
            TargetKind::Torque => {
                let torque = &setup.torque;
                let unit = torque.unit.to_string();
                (torque.shown(target), torque.shown(last.torque), unit)
            }
            TargetKind::Position => {
                let scale = &setup.config.scale;
                let place = |position| scale.place(UserUnits(position)).0;
                (place(target), place(last.position), setup.unit.clone())
            }
        }
    }
}
