//! Errors of the mechanics between a drive and its load: backlash, and the pitch of a screw.
//!
//! The *load position* is what commands, limits and the status speak of. The *drive position* is in
//! 0x607A and 0x6064:
//!
//! ```text
//! drive = load − error(load) + play
//! ```
//!
//! `error` comes from a table. It is linear between the points; its corners are rounded, so that the
//! drive keeps the acceleration limit of its axis there. `play` is 0 on the reference flank, and the
//! backlash on the other one.

use crate::limits::Limits;
use crate::setpoint::MotionLimits;

/// The largest change of the error per unit of position. A larger one is a wrong scale.
pub const MAX_SLOPE: f64 = 0.05;
/// The largest number of points of a table.
pub const MAX_POINTS: usize = 100_000;

/// The shares of the limits with which backlash is taken up.
const TAKE_UP_VELOCITY: f64 = 0.05;
const TAKE_UP_ACCELERATION: f64 = 0.1;
const TAKE_UP_JERK: f64 = 0.2;
/// The share of the acceleration limit for the corners of the table.
const CORNER_ACCELERATION: f64 = 0.1;
/// Each step reduces the error of the inverse to [`MAX_SLOPE`] of it: the rest is below rounding.
const INVERSE_STEPS: usize = 10;

/// A table or a backlash is invalid. Values in user units.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum CompensationError {
    /// A table needs two points at least.
    #[error("a table has 2 to {MAX_POINTS} points, not {0}")]
    Points(usize),
    /// A value is not finite.
    #[error("point {0} is not finite")]
    NotFinite(usize),
    /// Positions must increase.
    #[error("position {position} of point {point} does not come after {before}")]
    Order {
        /// The number of the point, from 1.
        point: usize,
        /// Its position.
        position: f64,
        /// The position before it.
        before: f64,
    },
    /// The error changes too much.
    #[error(
        "from {from} to {to} the error changes by {percent:.1} % of the way: at most {} % are corrected",
        MAX_SLOPE * 100.0
    )]
    Slope {
        /// The position of the point before.
        from: f64,
        /// The position of the point.
        to: f64,
        /// The change of the error in percent of the way.
        percent: f64,
    },
    /// The table bends so much that the drive would exceed the acceleration limit.
    #[error(
        "at {position} the error bends too much for the velocity limit: its corner is {rounding:.4} long, its neighbours leave {room:.4}"
    )]
    Corner {
        /// The position of the point.
        position: f64,
        /// The way that the corner needs.
        rounding: f64,
        /// The way that the neighbours leave.
        room: f64,
    },
    /// The table of a modulo axis covers one period.
    #[error(
        "the table of a modulo axis goes from 0 to {period} and ends with the error of its begin"
    )]
    Period {
        /// The period.
        period: f64,
    },
    /// The backlash is not a positive number.
    #[error("a backlash of {0} is not possible: it is above 0")]
    Backlash(f64),
}

/// The flank on which the load rests when homing ends: the direction of the motion at its end.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ReferenceFlank {
    /// Homing ends in the positive direction.
    #[default]
    Positive,
    /// Homing ends in the negative direction.
    Negative,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Corner {
    position: f64,
    error: f64,
    /// The slope behind the point, and its change at the point.
    slope: f64,
    bend: f64,
    /// The bend is spread over this way before and behind the point.
    rounding: f64,
}

/// The correction of an axis. The default corrects nothing.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Compensation {
    corners: Box<[Corner]>,
    /// The slope before the first point.
    slope: f64,
    period: Option<f64>,
    /// The play on the other flank; negative if that is in the negative direction.
    play: f64,
    /// The limits of the motion that takes up backlash.
    take_up: Option<MotionLimits>,
    limits: Option<[Limits; 2]>,
}

/// What is known about the mechanics of an axis. User units.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Mechanics<'p> {
    /// Position and error, load position minus drive position; outside of them, the error of the
    /// end holds. Empty: no error is known.
    pub errors: &'p [[f64; 2]],
    /// The way between both flanks.
    pub backlash: Option<f64>,
    /// The flank of the position at the end of homing.
    pub reference: ReferenceFlank,
    /// The period of a modulo axis.
    pub period: Option<f64>,
}

impl Compensation {
    /// Builds the correction of an axis whose drive keeps `limits`. Allocates.
    pub fn new(mechanics: &Mechanics<'_>, limits: &Limits) -> Result<Self, CompensationError> {
        let mut made = Self::default();
        let mut velocity = limits.velocity;
        let mut acceleration = limits.acceleration;
        let mut jerk = limits.jerk();
        if let Some(backlash) = mechanics.backlash {
            if !(backlash.is_finite() && backlash > 0.0) {
                return Err(CompensationError::Backlash(backlash));
            }
            made.play = match mechanics.reference {
                ReferenceFlank::Positive => -backlash,
                ReferenceFlank::Negative => backlash,
            };
            let own = MotionLimits {
                velocity: limits.velocity * TAKE_UP_VELOCITY,
                acceleration: limits.acceleration * TAKE_UP_ACCELERATION,
                jerk: jerk * TAKE_UP_JERK,
            };
            made.take_up = Some(own);
            velocity -= own.velocity;
            acceleration -= own.acceleration;
            jerk -= own.jerk;
        }
        if !mechanics.errors.is_empty() {
            made.period = mechanics.period;
            let slopes = slopes(mechanics.errors)?;
            check_period(mechanics)?;
            let steepest = slopes.iter().fold(0.0, |a: f64, b| a.max(b.abs()));
            let corners = limits.acceleration * CORNER_ACCELERATION;
            velocity /= 1.0 + steepest;
            acceleration = (acceleration - corners) / (1.0 + steepest);
            jerk /= 1.0 + steepest;
            made.add_corners(
                mechanics.errors,
                &slopes,
                velocity * velocity / (2.0 * corners),
            )?;
        }
        if made.is_active() {
            let load = Limits {
                velocity,
                acceleration,
                jerk: Some(jerk),
                ..*limits
            };
            made.limits = Some([load, *limits]);
        }
        Ok(made)
    }

    fn add_corners(
        &mut self,
        points: &[[f64; 2]],
        slopes: &[f64],
        rounding_per_bend: f64,
    ) -> Result<(), CompensationError> {
        let (first, last) = match self.period {
            Some(_) => (slopes.last(), slopes.first()),
            None => (None, None),
        };
        self.slope = first.copied().unwrap_or(0.0);
        let mut before = self.slope;
        let mut corners = Vec::with_capacity(points.len());
        let behind = slopes.iter().chain([last.unwrap_or(&0.0)]);
        for (&[position, error], &slope) in points.iter().zip(behind) {
            let bend = slope - before;
            corners.push(Corner {
                position,
                error,
                slope,
                bend,
                rounding: rounding_per_bend * bend.abs(),
            });
            before = slope;
        }
        for pair in corners.windows(2) {
            if let [a, b] = pair {
                let room = (b.position - a.position) / 2.0;
                let tight = [a, b].into_iter().find(|corner| corner.rounding > room);
                if let Some(corner) = tight {
                    return Err(CompensationError::Corner {
                        position: corner.position,
                        rounding: 2.0 * corner.rounding,
                        room: 2.0 * room,
                    });
                }
            }
        }
        self.corners = corners.into();
        Ok(())
    }

    /// True if anything is corrected.
    #[must_use]
    pub fn is_active(&self) -> bool {
        self.take_up.is_some() || !self.corners.is_empty()
    }

    /// Returns the limits of the load: those of the drive without the shares of the correction.
    #[must_use]
    pub fn load_limits(&self, limits: &Limits) -> Limits {
        match &self.limits {
            None => *limits,
            Some([load, _]) => Limits {
                velocity: load.velocity,
                acceleration: load.acceleration,
                jerk: load.jerk,
                ..*limits
            },
        }
    }

    /// Returns the limits of the drive for those of its load, the range of positions included.
    #[must_use]
    pub fn drive_limits(&self, load: &Limits) -> Limits {
        let Some([_, drive]) = &self.limits else {
            return *load;
        };
        let [least, most] = self.range_of_play();
        let range = |[low, high]: [f64; 2]| [self.screw(low) + least, self.screw(high) + most];
        Limits {
            velocity: drive.velocity,
            acceleration: drive.acceleration,
            jerk: drive.jerk,
            position: load.position.map(range),
            ..*load
        }
    }

    /// Returns the velocity limit of a drive whose load has the limit `velocity`.
    pub(crate) fn drive_velocity(&self, velocity: f64) -> f64 {
        self.limits.map_or(velocity, |[load, drive]| {
            velocity * drive.velocity / load.velocity
        })
    }

    pub(crate) const fn take_up(&self) -> Option<MotionLimits> {
        self.take_up
    }

    /// Returns the lowest and the highest play.
    pub(crate) const fn range_of_play(&self) -> [f64; 2] {
        [self.play.min(0.0), self.play.max(0.0)]
    }

    /// Returns the play on the flank that pushes the load in this direction.
    pub(crate) fn play_towards(&self, direction: f64) -> f64 {
        if direction * self.play > 0.0 {
            self.play
        } else {
            0.0
        }
    }

    /// Returns the error of a load position and its slope. RT: O(log points).
    #[must_use]
    pub fn error(&self, position: f64) -> [f64; 2] {
        let at = self
            .period
            .map_or(position, |period| position.rem_euclid(period));
        let behind = self.corners.partition_point(|corner| corner.position <= at);
        let before = behind.checked_sub(1).and_then(|n| self.corners.get(n));
        let next = self.corners.get(behind);
        let [error, slope] = match (before, next) {
            (Some(corner), _) => [
                corner.error + corner.slope * (at - corner.position),
                corner.slope,
            ],
            (None, Some(corner)) => [
                corner.error + self.slope * (at - corner.position),
                self.slope,
            ],
            (None, None) => return [0.0, 0.0],
        };
        // At most one corner reaches this position.
        for corner in [before, next].into_iter().flatten() {
            let way = at - corner.position;
            let inside = corner.rounding - way.abs();
            if inside > 0.0 {
                let bend = corner.bend / (2.0 * corner.rounding);
                let turned = bend * inside * if way < 0.0 { 1.0 } else { -1.0 };
                return [error + bend * inside * inside / 2.0, slope + turned];
            }
        }
        [error, slope]
    }

    /// Returns the drive position without play.
    pub(crate) fn screw(&self, load: f64) -> f64 {
        let [error, _] = self.error(load);
        load - error
    }

    /// Returns the load position: the inverse of [`Compensation::screw`]. RT: O(log points).
    pub(crate) fn load(&self, screw: f64) -> f64 {
        if self.corners.is_empty() {
            return screw;
        }
        let mut load = screw;
        for _ in 0..INVERSE_STEPS {
            let [error, _] = self.error(load);
            load = screw + error;
        }
        load
    }

    /// Returns the way of the drive per way of the load.
    pub(crate) fn ratio(&self, load: f64) -> f64 {
        let [_, slope] = self.error(load);
        1.0 - slope
    }
}

/// Returns the slope of each segment.
fn slopes(points: &[[f64; 2]]) -> Result<Vec<f64>, CompensationError> {
    if !(2..=MAX_POINTS).contains(&points.len()) {
        return Err(CompensationError::Points(points.len()));
    }
    let bad = |point: &[f64; 2]| !point.iter().all(|n| n.is_finite() && n.abs() < 1e12);
    if let Some(at) = points.iter().position(bad) {
        return Err(CompensationError::NotFinite(at + 1));
    }
    let segments = (2..).zip(points.iter().zip(points.iter().skip(1)));
    segments
        .map(|(point, (&[from, a], &[to, b]))| {
            // A difference may round to 0.
            if to - from <= 0.0 {
                return Err(CompensationError::Order {
                    point,
                    position: to,
                    before: from,
                });
            }
            let slope = (b - a) / (to - from);
            if slope.abs() <= MAX_SLOPE {
                return Ok(slope);
            }
            let percent = slope * 100.0;
            Err(CompensationError::Slope { from, to, percent })
        })
        .collect()
}

fn check_period(mechanics: &Mechanics<'_>) -> Result<(), CompensationError> {
    let Some(period) = mechanics.period else {
        return Ok(());
    };
    match (mechanics.errors.first(), mechanics.errors.last()) {
        (Some([first, a]), Some([last, b])) if *first == 0.0 && *last == period && a == b => Ok(()),
        _ => Err(CompensationError::Period { period }),
    }
}

#[cfg(test)]
#[path = "compensation_tests.rs"]
mod tests;
