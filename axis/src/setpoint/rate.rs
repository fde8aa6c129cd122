//! The override of an axis, and the rate at which the time of waves and tables passes.
//!
//! The rate of tables is searched cycle by cycle: [`TableRate`].
//!
//! A wave p(s) with the rate r has the velocity p′·r, the acceleration p″·r² + p′·r′ and the jerk
//! p‴·r³ + 3·p″·r·r′ + p′·r″. With the highest slopes V, A and J of the wave, bounded r′ and r″ keep
//! all of them within the limits:
//!
//! - r′ ≤ (acceleration − A·h²) / V and r′ ≤ S / (6·A·h)
//! - r″ ≤ S / (2·V) with S = jerk − J·h³
//!
//! h is the highest rate until the rate is constant again.

use super::{MotionLimits, braking_velocity};
use crate::{MAX_RATE, MIN_RATE};

/// The override of an axis in one cycle: a factor on its velocities, or on the time of its motion.
/// 0 holds the axis.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd)]
pub struct Rate(f64);

impl Rate {
    /// No override.
    pub const WHOLE: Self = Self(1.0);
    /// The axis is held.
    pub const HELD: Self = Self(0.0);

    /// Returns a rate up to [`MAX_RATE`]. An invalid one, or one below [`MIN_RATE`], holds the axis.
    #[must_use]
    pub const fn new(value: f64) -> Self {
        // Written so that NaN is rejected, too.
        let valid = value >= MIN_RATE && value <= MAX_RATE;
        Self(if valid { value } else { 0.0 })
    }

    /// Returns the factor.
    #[must_use]
    pub const fn value(self) -> f64 {
        self.0
    }

    /// Returns true if the axis is held.
    #[must_use]
    pub const fn is_held(self) -> bool {
        self.0 == 0.0
    }

    /// Returns the lower of two rates.
    #[must_use]
    pub const fn min(self, other: Self) -> Self {
        Self(self.0.min(other.0))
    }
}

/// Share of the limits that a changing rate uses; the rest covers differences of cycles.
const USED: f64 = 0.99;

/// The rate of a wave, from 0 to 1. It changes within the limits of an axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct WaveRate {
    value: f64,
    slope: f64,
    /// The highest rate until the slope is 0.
    highest: f64,
}

impl WaveRate {
    pub(super) const WHOLE: Self = Self {
        value: 1.0,
        slope: 0.0,
        highest: 1.0,
    };

    /// Advances one cycle towards `wanted` and returns the rate of this cycle. `slopes`: highest
    /// velocity, acceleration and jerk at rate 1. RT: O(1).
    pub(super) fn advance(
        &mut self,
        wanted: Rate,
        slopes: [f64; 3],
        limits: &MotionLimits,
        dt_s: f64,
    ) -> f64 {
        let left = wanted.min(Rate::WHOLE).0 - self.value;
        if left == 0.0 && self.slope == 0.0 {
            return self.value;
        }
        self.highest = match (self.slope > 0.0, left > 0.0) {
            (true, _) => self.highest.max(self.value + left),
            (false, true) if self.slope == 0.0 => self.value + left,
            (false, _) => self.value,
        };
        let [velocity, acceleration, jerk] = slopes;
        let top = self.highest;
        let jerk_left = (limits.jerk * USED - jerk * top.powi(3)).max(0.0);
        let steepest = ((limits.acceleration * USED - acceleration * top * top).max(0.0)
            / velocity)
            .min(jerk_left / (6.0 * acceleration * top));
        let bend = jerk_left / (2.0 * velocity) * dt_s;
        // The last change of the slope, to 0, is as large as the others.
        let slope = braking_velocity(left.abs(), jerk_left / (2.0 * velocity), dt_s);
        let slope = slope.min(steepest).copysign(left);
        let mut next = slope.max(self.slope - bend).min(self.slope + bend);
        // The bounds of a rising rate are not those of a falling one.
        if next * self.slope < 0.0 {
            next = 0.0;
        }
        let step = next * dt_s;
        if (left - step).abs() <= left.abs() * 1e-9 {
            self.value += left;
        } else {
            self.value = (self.value + step).clamp(0.0, 1.0);
        }
        self.slope = next;
        self.value
    }
}

/// The highest change of a table's rate per second.
const TABLE_SLEW: f64 = 5.0;

/// The smallest change of the slope per cycle, as a share of [`TABLE_SLEW`].
const FINEST: f64 = 1.0 / 65_536.0;

/// Most cycles from a slope to a constant rate. Each of them is checked in each cycle.
const LONGEST: f64 = 96.0;

/// The rate of tables that play in common time.
///
/// A constant rate up to 1 keeps the limits that the tables keep. A changing rate may not: what is
/// possible now can have no continuation within the limits some cycles later. So each change is
/// taken only together with a [`RateCourse`] back to a constant rate that keeps all limits. While
/// no new course does, the last one continues.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TableRate {
    value: f64,
    slope: f64,
    /// Change of the slope per cycle.
    bend: f64,
}

impl TableRate {
    /// The rate 1.
    pub const WHOLE: Self = Self {
        value: 1.0,
        slope: 0.0,
        bend: TABLE_SLEW,
    };

    /// Returns the rate of this cycle.
    #[must_use]
    pub const fn value(&self) -> Rate {
        // A changing rate passes all values, so the lowest override does not apply.
        Rate(self.value)
    }

    /// Sets a constant rate while no table plays.
    pub const fn set(&mut self, rate: Rate) {
        *self = Self {
            value: rate.min(Rate::WHOLE).0,
            ..Self::WHOLE
        };
    }

    /// True while the rate changes. A table that begins meanwhile must wait at its start, because
    /// the way back to a constant rate was found without it.
    #[must_use]
    pub const fn changes(&self) -> bool {
        self.slope != 0.0
    }

    /// Advances one cycle towards `wanted`, which counts as 1 if it is higher. `keeps`: true if
    /// every table keeps its limits on a course. RT: five calls of `keeps` at most.
    pub fn advance(
        &mut self,
        wanted: Rate,
        dt_s: f64,
        keeps: impl FnMut(RateCourse) -> bool,
    ) -> Rate {
        self.change(wanted.min(Rate::WHOLE).0, dt_s, keeps);
        self.value()
    }

    fn change(&mut self, wanted: f64, dt_s: f64, mut keeps: impl FnMut(RateCourse) -> bool) {
        let left = wanted - self.value;
        if left == 0.0 && self.slope == 0.0 {
            return;
        }
        // First a new slope, then the present one. A bend that the limits do not permit is halved,
        // and doubled again as soon as they do.
        for (factor, changes) in [
            (2.0, true),
            (1.0, true),
            (0.5, true),
            (0.5, false),
            (1.0, false),
        ] {
            let bend = (self.bend * factor).clamp(TABLE_SLEW * FINEST, TABLE_SLEW);
            // The rate can become constant at the wanted one.
            let fastest = braking_velocity(left.abs(), bend / dt_s, dt_s)
                .min(TABLE_SLEW)
                .min(bend * LONGEST);
            let slope = if changes {
                let toward = fastest.copysign(left);
                toward.max(self.slope - bend).min(self.slope + bend)
            } else {
                self.slope
            };
            let away = slope * left < 0.0;
            if (away && !changes)
                || (!away && slope.abs() > fastest * (1.0 + 1e-9))
                || (slope == 0.0 && self.slope == 0.0)
            {
                continue;
            }
            let course = RateCourse::new(self.value, slope, bend, dt_s);
            if (0.0..=1.0).contains(&course.end()) && keeps(course) {
                (self.slope, self.bend) = (slope, bend);
                let step = slope * dt_s;
                self.value = if (left - step).abs() <= left.abs() * 1e-9 {
                    wanted
                } else {
                    (self.value + step).clamp(0.0, 1.0)
                };
                return;
            }
        }
        if self.slope == 0.0 {
            // A finer change may be possible in the next cycle.
            self.bend = (self.bend * 0.5).max(TABLE_SLEW * FINEST);
        }
        self.slope = towards_zero(self.slope, self.bend);
        self.value = (self.value + self.slope * dt_s).clamp(0.0, 1.0);
    }
}

fn towards_zero(slope: f64, bend: f64) -> f64 {
    (slope.abs() - bend).max(0.0).copysign(slope)
}

/// The rates of the next cycles, until the rate is constant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RateCourse {
    value: f64,
    /// The slope of the next cycle.
    slope: f64,
    bend: f64,
    dt_s: f64,
    cycles: u32,
}

impl RateCourse {
    fn new(value: f64, slope: f64, bend: f64, dt_s: f64) -> Self {
        // Velocity, acceleration and jerk are constant again two cycles after the rate.
        let cycles = (slope.abs() / bend).ceil().min(LONGEST) as u32 + 3;
        Self {
            value,
            slope,
            bend,
            dt_s,
            cycles,
        }
    }

    /// Returns the constant rate at the end.
    fn end(&self) -> f64 {
        let (slope, whole) = (self.slope.abs(), (self.slope.abs() / self.bend).floor());
        let way = (whole + 1.0) * (slope - self.bend * whole * 0.5);
        let end = self.value + way.copysign(self.slope) * self.dt_s;
        // Without the rounding of the sum.
        if end.abs() < 1e-12 {
            0.0
        } else if (end - 1.0).abs() < 1e-12 {
            1.0
        } else {
            end
        }
    }
}

impl Iterator for RateCourse {
    type Item = f64;

    /// Returns the rate of the next cycle.
    fn next(&mut self) -> Option<f64> {
        self.cycles = self.cycles.checked_sub(1)?;
        self.value = (self.value + self.slope * self.dt_s).clamp(0.0, 1.0);
        self.slope = towards_zero(self.slope, self.bend);
        Some(self.value)
    }
}
