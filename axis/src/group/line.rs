//! A straight line through the positions of several axes.
//!
//! Synchronous arrival alone does not give a line: axes that reach their limits at different times
//! deviate by millimetres. So all axes share one profile of the path parameter from 0 to 1. Its
//! limits keep every axis within its own limits.

use crate::setpoint::{
    Goal, HoldResponse, JerkLimited, Motion, MotionLimits, MoveRequest, Rate, Setpoint,
    SetpointError,
};

/// The part of one axis in a line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LineAxis {
    /// The present set-point, at rest.
    pub from: Motion,
    /// The target, user units.
    pub target: f64,
    /// Limits of this axis on the line.
    pub limits: MotionLimits,
    /// The highest velocity at a rate above 1, at least that of `limits`.
    pub fastest: f64,
    /// Lowest and highest position, user units; `None`: unlimited.
    pub range: Option<[f64; 2]>,
}

/// The line is impossible for one of its axes.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("axis {axis} of the line: {error}")]
#[non_exhaustive]
pub struct LineError {
    /// Index in the slice passed to [`Line::plan`].
    pub axis: usize,
    /// The reason.
    #[source]
    pub error: SetpointError,
}

/// The profile shared by all axes of a line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Line {
    path: JerkLimited,
}

impl Line {
    /// Plans a line. All axes must be at rest. O(axes), no allocation.
    pub fn plan(axes: &[LineAxis]) -> Result<Self, LineError> {
        let unbounded = MotionLimits {
            velocity: f64::INFINITY,
            acceleration: f64::INFINITY,
            jerk: f64::INFINITY,
        };
        let mut limits = unbounded;
        let mut fastest = f64::INFINITY;
        let mut slowest = 0;
        for (index, axis) in axes.iter().enumerate() {
            let way = axis
                .check()
                .map_err(|error| LineError { axis: index, error })?;
            if way == 0.0 {
                continue;
            }
            let own = axis.limits.scaled(1.0 / way);
            if own.velocity < limits.velocity {
                slowest = index;
            }
            fastest = fastest.min(axis.fastest / way);
            limits = MotionLimits {
                velocity: limits.velocity.min(own.velocity),
                acceleration: limits.acceleration.min(own.acceleration),
                jerk: limits.jerk.min(own.jerk),
            };
        }
        let (start, limits, fastest) = if limits == unbounded {
            (1.0, UNIT, UNIT.velocity)
        } else {
            (0.0, limits, fastest)
        };
        let order = MoveRequest {
            ceiling: MotionLimits {
                velocity: limits.velocity.max(fastest),
                ..limits
            },
            ..MoveRequest::within(Goal::Position(1.0), limits)
        };
        let path = JerkLimited::new(order, Motion::at(start), 0.0).map_err(|error| LineError {
            axis: slowest,
            error,
        })?;
        Ok(Self { path })
    }

    /// Returns the source for one axis; `axis` must be an element of the plan.
    #[must_use]
    pub fn along(&self, axis: &LineAxis) -> LinePath {
        LinePath {
            path: self.path,
            at: Motion::at(if self.path.duration_s() > 0.0 {
                0.0
            } else {
                1.0
            }),
            start: axis.from.position,
            target: axis.target,
            last: axis.from,
        }
    }

    /// Returns the duration in seconds.
    #[must_use]
    pub fn duration_s(&self) -> f64 {
        self.path.duration_s()
    }
}

/// Limits of a line of length zero.
const UNIT: MotionLimits = MotionLimits {
    velocity: 1.0,
    acceleration: 1.0,
    jerk: 1.0,
};

impl LineAxis {
    /// Checks the part of this axis and returns the length of its way.
    fn check(&self) -> Result<f64, SetpointError> {
        self.limits.check()?;
        let order = MoveRequest {
            range: self.range,
            ..MoveRequest::within(Goal::Position(self.target), self.limits)
        };
        let velocity = self.from.velocity;
        if velocity != 0.0 {
            return Err(SetpointError::NotAtRest { velocity });
        }
        // Detects NaN and a target outside the range.
        JerkLimited::new(order, Motion::at(self.from.position), 0.0)?;
        Ok((self.target - self.from.position).abs())
    }
}

/// One axis on a line. All axes of a line advance in the same cycles by the same `dt_s`. They are
/// stopped and continued in the same cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LinePath {
    path: JerkLimited,
    /// State on the path: 0 at the start, 1 at the target.
    at: Motion,
    start: f64,
    target: f64,
    last: Motion,
}

impl LinePath {
    /// Returns the progress, from 0 to 1.
    #[must_use]
    pub const fn progress(&self) -> f64 {
        self.at.position
    }

    /// Returns the target, user units.
    #[must_use]
    pub const fn target(&self) -> f64 {
        self.target
    }

    /// Returns this axis's part of the line's deceleration.
    #[must_use]
    pub const fn braking(&self) -> f64 {
        self.path.used().acceleration * (self.target - self.start).abs()
    }

    /// Restarts from `motion` after an interruption. The other axes of the line were interrupted as
    /// well and compute the same.
    fn take_up(&mut self, motion: Motion) {
        let way = self.target - self.start;
        if way == 0.0 {
            return;
        }
        if motion.position != self.last.position {
            self.at.position = (motion.position - self.start) / way;
        }
        self.at.velocity = motion.velocity / way;
        self.at.acceleration = 0.0;
    }
}

impl Setpoint for LinePath {
    /// Multiplies the velocity on the line by `rate`, within the limits of the axes; 0 stops on the
    /// line. All axes of the line need the same rate. RT: O(1).
    fn advance(&mut self, motion: Motion, rate: Rate, dt_s: f64) -> Motion {
        if dt_s.is_nan() || dt_s <= 0.0 {
            return motion;
        }
        if (motion.position, motion.velocity) != (self.last.position, self.last.velocity) {
            self.take_up(motion);
        }
        self.at = self.path.advance(self.at, rate, dt_s);
        let way = self.target - self.start;
        let position = if self.at.position == 1.0 {
            self.target
        } else {
            self.start + way * self.at.position
        };
        self.last = motion.then(position, way * self.at.velocity, dt_s);
        self.last
    }

    fn at_hold(&self) -> HoldResponse {
        HoldResponse::Waits
    }

    /// True at the target.
    fn finished(&self, _: Motion) -> bool {
        self.path.finished(self.at)
    }
}

#[cfg(test)]
#[path = "line_tests.rs"]
mod tests;
