//! Steps in which axes follow more than a target of their own: lines, waves, tables, other axes.

use ecaxis_axis::group::{Line, LineAxis, arrive_together};
use ecaxis_axis::setpoint::{
    GearConfig, Goal, JerkLimited, MotionLimits, Order as Way, Playback, PositionWave,
    SetpointError, Wave,
};
use ecaxis_axis::{Command, Limits};

use super::Supervisor;
use super::program::{Aim, Settling};
use crate::clock::{self, Nanos};
use crate::config::Step;
use crate::rt::feed::{FeedState, Start, commanded};
use crate::rt::handover::Order;
use crate::session::RunError;

/// How long a follower may take to catch up.
const ENGAGE_TIMEOUT: Nanos = 30_000_000_000;

/// No step is worth more than this part of an axis' limits: products of f64s are rounded.
const WHOLE: f64 = 1.0 - 1e-9;

impl Supervisor {
    /// Of the axis of a device.
    pub(super) fn limits(&self, device: usize) -> Limits {
        let axis = self.machine.devices[device].axis.as_ref();
        // Steps name only devices with an axis.
        axis.map_or(
            Limits {
                position: None,
                velocity: 0.0,
                acceleration: 0.0,
                jerk: None,
                torque: 0.0,
                following_error: None,
            },
            |axis| axis.config.limits,
        )
    }

    /// `part`: of the velocity, and of the acceleration and jerk limits.
    pub(super) async fn line(
        &mut self,
        step: &Step,
        start: Nanos,
        relative: bool,
        targets: &[(usize, f64)],
        part: [f64; 2],
    ) -> Result<(), RunError> {
        let places = self.targets(targets);
        let axes: Vec<usize> = places.iter().map(|&(axis, _)| axis).collect();
        self.settle(&axes, start).await?;
        let snapshot = self.tick().await?;
        let mut line_axes = Vec::with_capacity(axes.len());
        for (&(axis, target), &(device, _)) in places.iter().zip(targets) {
            let from = commanded(&snapshot.axes[axis]);
            line_axes.push(LineAxis {
                from,
                target: if relative {
                    from.position + target
                } else {
                    self.place_to_go(axis, from.position, target)
                },
                limits: self.part_of(device, part),
                range: self.limits(device).position,
            });
        }
        let line = Line::plan(&line_axes)
            .map_err(|error| self.refusal(step, axes[error.axis], &error.error))?;
        let feeds = axes.iter().zip(&line_axes);
        let feeds: Vec<_> = feeds
            .map(|(&axis, part)| (axis, Start::Line(line.along(part))))
            .collect();
        self.follow(step, start, &feeds, FeedState::Finished).await
    }

    /// Every axis jerk-limited on its own way, all as slowly as the one that takes longest. `part` as of a line.
    pub(super) async fn together(
        &mut self,
        step: &Step,
        start: Nanos,
        relative: bool,
        targets: &[(usize, f64)],
        part: [f64; 2],
    ) -> Result<(), RunError> {
        let axes = self.places(
            &targets
                .iter()
                .map(|&(device, _)| device)
                .collect::<Vec<_>>(),
        );
        self.settle(&axes, start).await?;
        let there = self.destinations(relative, targets).await?;
        let snapshot = self.tick().await?;
        let dt_s = self.machine.bus.cycle_ns as f64 * 1e-9;
        let mut moves = Vec::with_capacity(axes.len());
        for (&(axis, target), &(device, _)) in there.iter().zip(targets) {
            let from = commanded(&snapshot.axes[axis]);
            let order = Way {
                range: self.limits(device).position,
                ..Way::within(Goal::Position(target), self.part_of(device, part))
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
        let feeds = axes.iter().zip(&moves);
        let feeds: Vec<_> = feeds
            .map(|(&axis, &planned)| (axis, Start::Move(planned)))
            .collect();
        self.follow(step, start, &feeds, FeedState::Finished).await
    }

    /// Fractions of the velocity, and of the acceleration and jerk limits of the axis of a device.
    fn part_of(&self, device: usize, part: [f64; 2]) -> MotionLimits {
        let [speed, ramp] = part.map(|part| part * WHOLE);
        let limits = self.limits(device);
        MotionLimits {
            velocity: limits.velocity * speed,
            acceleration: limits.acceleration * ramp,
            jerk: limits.jerk() * ramp,
        }
    }

    /// `devices`: the follower and the one that it follows.
    pub(super) async fn gear(
        &mut self,
        step: &Step,
        start: Nanos,
        devices: [usize; 2],
        actual: bool,
        config: GearConfig,
    ) -> Result<(), RunError> {
        let feed = match *self.places(&devices) {
            [axis, master] => Some((
                axis,
                Start::Gear {
                    master,
                    actual,
                    config,
                },
            )),
            _ => None,
        };
        let feeds: Vec<_> = feed.into_iter().collect();
        self.follow(step, start, &feeds, FeedState::Engaged).await
    }

    pub(super) async fn wave(
        &mut self,
        step: &Step,
        start: Nanos,
        device: usize,
        wave: Wave,
    ) -> Result<(), RunError> {
        let axes = self.places(&[device]);
        self.settle(&axes, start).await?;
        let snapshot = self.tick().await?;
        let limits = self.limits(device);
        let dt_s = self.machine.bus.cycle_ns as f64 * 1e-9;
        let mut feeds = Vec::new();
        for axis in axes {
            let at = commanded(&snapshot.axes[axis]);
            let wave = PositionWave::new(wave, at, limits.motion(), limits.position, dt_s)
                .map_err(|error| self.refusal(step, axis, &error))?;
            feeds.push((axis, Start::Wave(wave)));
        }
        self.follow(step, start, &feeds, FeedState::Finished).await
    }

    /// To the first row first.
    pub(super) async fn play(
        &mut self,
        step: &Step,
        start: Nanos,
        [device, table]: [usize; 2],
        [speed, ramp]: [f64; 2],
    ) -> Result<(), RunError> {
        let axes = self.places(&[device]);
        let [first, _] = self.machine.tables[table].table.ends();
        let there: Vec<_> = axes.iter().map(|&axis| (axis, first)).collect();
        self.reach(step, start, Aim::Position, &there, |position| {
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
        let snapshot = self.tick().await?;
        let limits = self.limits(device).motion();
        let mut feeds = Vec::new();
        for axis in axes {
            let at = commanded(&snapshot.axes[axis]);
            let playback = Playback::new(&self.machine.tables[table].table, at, limits, 0.0)
                .map_err(|error| self.refusal(step, axis, &error))?;
            feeds.push((axis, Start::Table { table, playback }));
        }
        self.follow(step, start, &feeds, FeedState::Finished).await
    }

    /// Begins all feeds in one cycle and waits until each is in the state that ends the step, its axis with it.
    pub(super) async fn follow(
        &mut self,
        step: &Step,
        start: Nanos,
        feeds: &[(usize, Start)],
        until: FeedState,
    ) -> Result<(), RunError> {
        let orders = feeds
            .iter()
            .map(|&(axis, start)| Order::Feed { axis, start });
        self.orders(&orders.collect::<Vec<_>>()).await;
        let begun = clock::now();
        let mut settling = Settling::default();
        self.watch(step, start, |this, snapshot| {
            let mut done = true;
            let mut late = None;
            for &(axis, _) in feeds {
                match snapshot.feeds[axis] {
                    FeedState::NotBegun(error) => return Err(this.refusal(step, axis, &error)),
                    FeedState::Refused(reason) => return Err(this.refusal(step, axis, &reason)),
                    FeedState::Lost(why) => return Err(this.refusal(step, axis, &why)),
                    // Something else has taken the axis over.
                    FeedState::None => {}
                    state => done &= state == until,
                }
                if until == FeedState::Finished && !snapshot.axes[axis].in_target {
                    late = Some(axis);
                }
            }
            if !done {
                let waited = clock::now().saturating_sub(begun);
                if until == FeedState::Engaged && waited > ENGAGE_TIMEOUT {
                    let axis = feeds.first().map_or(0, |&(axis, _)| axis);
                    return Err(this.refusal(step, axis, &"it does not catch up"));
                }
                settling = Settling::default();
                return Ok(false);
            }
            let Some(axis) = late else { return Ok(true) };
            let status = &snapshot.axes[axis];
            let target = status.target_position;
            if settling.over() {
                return Err(this.not_reached(step, axis, Aim::Position, target, status));
            }
            Ok(false)
        })
        .await
    }
}
