//! Steps in which axes follow more than a target: lines, waves, tables, other axes.

use ecaxis_axis::group::{Line, LineAxis, arrive_together};
use ecaxis_axis::setpoint::{
    GearConfig, Goal, JerkLimited, MotionLimits, MoveRequest as Way, Playback, PositionWave,
    SetpointError, Wave,
};
use ecaxis_axis::{Command, Limits};
use ecaxis_ecat::index::AxisIndex;

use super::program::{Settling, TargetKind, Turn};
use crate::clock::{self, Nanos};
use crate::config::Step;
use crate::report::{Cause, Error};
use crate::rt::channel::RtCommand;
use crate::rt::setpoint_generator::{
    CamRef, GearMaster, GeneratorError, GeneratorRequest, GeneratorState, commanded,
};

/// The timeout in ns for a follower to catch up.
const ENGAGE_TIMEOUT: Nanos = 30_000_000_000;

/// The maximum fraction of an axis's limits in a step. Products of `f64` are rounded, so it is
/// slightly below 1.
const WHOLE: f64 = 1.0 - 1e-9;

impl Turn<'_, '_> {
    pub(super) fn limits(&self, axis: AxisIndex) -> Limits {
        self.machine.axes[axis].config.limits
    }

    /// Moves along a straight line. `part`: fraction of the velocity limits, and of the
    /// acceleration and jerk limits.
    pub(super) async fn line(
        &mut self,
        step: &Step,
        start: Nanos,
        relative: bool,
        targets: &[(AxisIndex, f64)],
        part: [f64; 2],
    ) -> Result<(), Error> {
        let axes: Vec<_> = targets.iter().map(|&(axis, _)| axis).collect();
        self.settle(&axes, start).await?;
        let snapshot = self.poll_and_query().await?;
        let mut line_axes = Vec::with_capacity(axes.len());
        for &(axis, target) in targets {
            let from = commanded(&snapshot.axes[axis]);
            line_axes.push(LineAxis {
                from,
                target: if relative {
                    from.position + target
                } else {
                    self.resolve_target(axis, from.position, target)
                },
                limits: self.part_of(axis, part),
                fastest: self.limits(axis).velocity * WHOLE,
                range: self.limits(axis).position,
            });
        }
        let line = Line::plan(&line_axes)
            .map_err(|error| self.refusal(step, axes[error.axis], &error.error))?;
        let first = axes.first().copied().unwrap_or_default();
        let generators = axes.iter().zip(&line_axes).map(|(&axis, part)| {
            let along = line.along(part);
            (axis, GeneratorRequest::Line { along, first })
        });
        let generators: Vec<_> = generators.collect();
        self.follow(step, start, &generators, GeneratorState::Finished)
            .await
    }

    /// Moves every axis on its own path, jerk-limited, so that all arrive with the slowest one.
    /// `part` as in `line`.
    pub(super) async fn together(
        &mut self,
        step: &Step,
        start: Nanos,
        relative: bool,
        targets: &[(AxisIndex, f64)],
        part: [f64; 2],
    ) -> Result<(), Error> {
        let axes: Vec<_> = targets.iter().map(|&(axis, _)| axis).collect();
        self.settle(&axes, start).await?;
        let there = self.destinations(relative, targets).await?;
        let snapshot = self.poll_and_query().await?;
        let dt_s = self.machine.bus.cycle_ns as f64 * 1e-9;
        let mut moves = Vec::with_capacity(axes.len());
        for &(axis, target) in &there {
            let from = commanded(&snapshot.axes[axis]);
            let order = Way {
                range: self.limits(axis).position,
                ..Way::within(Goal::Position(target), self.part_of(axis, part))
            };
            let planned = if from.velocity == 0.0 {
                JerkLimited::new(order, from, dt_s)
            } else {
                let velocity = from.velocity;
                Err(SetpointError::NotAtRest { velocity })
            };
            moves.push(planned.map_err(|error| self.refusal(step, axis, &error))?);
        }
        let first = axes.first().copied().unwrap_or_default();
        arrive_together(&mut moves).map_err(|error| self.refusal(step, first, &error))?;
        let generators = axes.iter().zip(&moves);
        let generators: Vec<_> = generators
            .map(|(&axis, &planned)| (axis, GeneratorRequest::Move(planned)))
            .collect();
        self.follow(step, start, &generators, GeneratorState::Finished)
            .await
    }

    /// Returns fractions of the velocity limit, and of the acceleration and jerk limits of an
    /// axis.
    fn part_of(&self, axis: AxisIndex, part: [f64; 2]) -> MotionLimits {
        let [speed, ramp] = part.map(|part| part * WHOLE);
        let limits = self.limits(axis);
        MotionLimits {
            velocity: limits.velocity * speed,
            acceleration: limits.acceleration * ramp,
            jerk: limits.jerk() * ramp,
        }
    }

    /// Makes an axis follow its master.
    pub(super) async fn gear(
        &mut self,
        step: &Step,
        start: Nanos,
        axis: AxisIndex,
        (master, cam): (GearMaster, Option<CamRef>),
        config: GearConfig,
    ) -> Result<(), Error> {
        let generator = GeneratorRequest::Gear {
            master,
            cam,
            config,
        };
        self.follow(step, start, &[(axis, generator)], GeneratorState::Engaged)
            .await
    }

    pub(super) async fn wave(
        &mut self,
        step: &Step,
        start: Nanos,
        axis: AxisIndex,
        wave: Wave,
    ) -> Result<(), Error> {
        self.settle(&[axis], start).await?;
        let snapshot = self.poll_and_query().await?;
        let limits = self.limits(axis);
        let dt_s = self.machine.bus.cycle_ns as f64 * 1e-9;
        let at = commanded(&snapshot.axes[axis]);
        let wave = PositionWave::new(wave, at, limits.motion(), limits.position, dt_s)
            .map_err(|error| self.refusal(step, axis, &error))?;
        let generator = (axis, GeneratorRequest::Wave(wave));
        self.follow(step, start, &[generator], GeneratorState::Finished)
            .await
    }

    /// Moves to the first rows of the tables, then plays all in common time.
    pub(super) async fn play(
        &mut self,
        step: &Step,
        start: Nanos,
        tables: &[(AxisIndex, usize)],
        [speed, ramp]: [f64; 2],
    ) -> Result<(), Error> {
        let there: Vec<_> = tables
            .iter()
            .map(|&(axis, table)| (axis, self.machine.tables[table].ends()[0]))
            .collect();
        self.move_and_wait(step, start, TargetKind::Position, &there, |position| {
            Command::MoveTo {
                position,
                speed,
                ramp,
            }
        })
        .await?;
        if self.over(start) {
            return Ok(());
        }
        let snapshot = self.poll_and_query().await?;
        let mut generators = Vec::with_capacity(tables.len());
        for &(axis, table) in tables {
            let limits = self.limits(axis).motion();
            let at = commanded(&snapshot.axes[axis]);
            let playback = Playback::new(&self.machine.tables[table], at, limits, 0.0)
                .map_err(|error| self.refusal(step, axis, &error))?;
            generators.push((axis, GeneratorRequest::Table { table, playback }));
        }
        self.follow(step, start, &generators, GeneratorState::Finished)
            .await
    }

    /// Starts all generators in one cycle. Waits until each reaches the state `until` and its axis
    /// is in target.
    pub(super) async fn follow(
        &mut self,
        step: &Step,
        start: Nanos,
        generators: &[(AxisIndex, GeneratorRequest)],
        until: GeneratorState,
    ) -> Result<(), Error> {
        let commands = generators
            .iter()
            .map(|&(axis, start)| RtCommand::Generate { axis, start });
        let commands: Vec<_> = commands.collect();
        let axes: Vec<_> = generators.iter().map(|&(axis, _)| axis).collect();
        self.send_and_follow(step, start, &commands, &axes, until)
            .await
    }

    /// Shifts followers against their masters, or axes on top of any motion. Waits until the shift
    /// is done.
    pub(super) async fn shift(
        &mut self,
        step: &Step,
        start: Nanos,
        targets: &[(AxisIndex, f64)],
        superimpose: bool,
    ) -> Result<(), Error> {
        let commands = targets.iter().map(|&(axis, distance)| RtCommand::Shift {
            axis,
            distance,
            superimpose,
        });
        let commands: Vec<_> = commands.collect();
        let axes: Vec<_> = targets.iter().map(|&(axis, _)| axis).collect();
        self.send_and_follow(step, start, &commands, &axes, GeneratorState::Engaged)
            .await
    }

    async fn send_and_follow(
        &mut self,
        step: &Step,
        start: Nanos,
        commands: &[RtCommand],
        axes: &[AxisIndex],
        until: GeneratorState,
    ) -> Result<(), Error> {
        self.send_all(commands).await;
        let begun = clock::now();
        let mut settling = Settling::default();
        self.wait_until(step, start, |this, snapshot| {
            let mut done = true;
            let mut late = None;
            for &axis in axes {
                match snapshot.generators[axis] {
                    GeneratorState::Failed(GeneratorError::LineShaft { shaft, end }) => {
                        let name = this.machine.line_shaft_name(shaft).to_owned();
                        let cause = Cause::LineShaftWaits { name, end };
                        return Err(cause.with_device(this.device_of(axis)).with_step(step));
                    }
                    GeneratorState::Failed(error) => return Err(this.refusal(step, axis, &error)),
                    // Another command has taken over the axis.
                    GeneratorState::None => {}
                    // A shifted motion may end together with its shift.
                    GeneratorState::Finished if until == GeneratorState::Engaged => {}
                    state => done &= state == until,
                }
                if until == GeneratorState::Finished && !snapshot.axes[axis].in_target {
                    late = Some(axis);
                }
            }
            if !done {
                let waited = clock::now().saturating_sub(begun);
                if until == GeneratorState::Engaged && waited > ENGAGE_TIMEOUT {
                    let axis = axes.first().copied().unwrap_or_default();
                    return Err(this.refusal(step, axis, &"it does not catch up"));
                }
                settling = Settling::default();
                return Ok(false);
            }
            let Some(axis) = late else { return Ok(true) };
            let target = snapshot.axes[axis].target_position;
            if settling.time_limit_reached() {
                return Err(this.not_reached(step, axis, TargetKind::Position, target, snapshot));
            }
            Ok(false)
        })
        .await
    }
}
