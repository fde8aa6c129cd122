//! Sine and square waves for commissioning.
//!
//! A sine fades in during one additional period and fades out during another. So it starts and ends
//! at rest, without a step of the acceleration. A square wave of positions consists of jerk-limited
//! moves, and ends in the middle.

use core::f64::consts::TAU;

use super::error::{position, usable};
use super::rate::WaveRate;
use super::spline::within;
use super::{
    Goal, Hold, HoldResponse, JerkLimited, Motion, MotionLimits, MoveRequest, Rate, Setpoint,
    SetpointError,
};

/// The shape of an oscillation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shape {
    /// A sine.
    Sine,
    /// A rectangle.
    Square,
}

/// A value that oscillates about zero: a velocity, a torque, or the offset of a [`PositionWave`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wave {
    shape: Shape,
    amplitude: f64,
    frequency: f64,
    periods: f64,
    /// Periods since the start.
    phase: f64,
}

/// Factors by which a sine's derivatives grow while it fades in or out. The steady derivatives are
/// 2π, 4π² and 8π³ per period.
const FADING: [f64; 3] = [1.0, 1.1122, 1.3286];

/// Share of the limits that a sine leaves for changes of its rate; twice as much of the jerk.
const RESERVE: f64 = 0.03;

/// Minimum number of cycles per period of a sine.
const CYCLES_PER_PERIOD: f64 = 10.0;

impl Wave {
    /// Creates a wave: `amplitude` to each side of zero, `frequency` in Hz, whole `periods` (1 to
    /// 2³² − 1). `dt_s` is the cycle time.
    pub fn new(
        shape: Shape,
        amplitude: f64,
        frequency: f64,
        periods: u32,
        dt_s: f64,
    ) -> Result<Self, SetpointError> {
        usable("amplitude", amplitude)?;
        usable("frequency", frequency)?;
        usable("cycle time", dt_s)?;
        if periods == 0 {
            return Err(SetpointError::NoTime);
        }
        let highest = 1.0 / (CYCLES_PER_PERIOD * dt_s);
        if frequency > highest {
            return Err(SetpointError::TooOften { frequency, highest });
        }
        Ok(Self {
            shape,
            amplitude,
            frequency,
            periods: f64::from(periods),
            phase: 0.0,
        })
    }

    /// Returns the distance to each side of the start.
    #[must_use]
    pub const fn amplitude(&self) -> f64 {
        self.amplitude
    }

    /// Returns the highest first, second and third derivative of a sine.
    #[must_use]
    pub fn slopes(&self) -> [f64; 3] {
        let omega = TAU * self.frequency;
        [1, 2, 3].map(|order: i32| {
            let fading = match order {
                1 => FADING[0],
                2 => FADING[1],
                _ => FADING[2],
            };
            self.amplitude * omega.powi(order) * fading
        })
    }

    /// Returns the duration in seconds.
    #[must_use]
    pub fn duration_s(&self) -> f64 {
        self.length() / self.frequency
    }

    /// True at the end.
    #[must_use]
    pub fn finished(&self) -> bool {
        self.phase >= self.length()
    }

    /// Advances one cycle. RT: O(1). The value of a square wave steps; its user must apply a ramp.
    pub fn advance(&mut self, dt_s: f64) -> f64 {
        self.phase = (self.phase + self.frequency * dt_s.max(0.0)).min(self.length());
        if self.finished() {
            return 0.0;
        }
        match self.shape {
            Shape::Sine => {
                let weight = smooth(self.phase) * smooth(self.length() - self.phase);
                self.amplitude * weight * (TAU * self.phase.fract()).sin()
            }
            Shape::Square if self.phase.fract() < 0.5 => self.amplitude,
            Shape::Square => -self.amplitude,
        }
    }

    fn length(&self) -> f64 {
        match self.shape {
            Shape::Sine => self.periods + 2.0,
            Shape::Square => self.periods,
        }
    }
}

/// Returns a smooth step from 0 to 1, with velocity and acceleration zero at both ends.
fn smooth(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * x * (10.0 + x * (6.0 * x - 15.0))
}

#[expect(
    clippy::large_enum_variant,
    reason = "nothing may be allocated in the cycle"
)]
#[derive(Debug, Clone, Copy, PartialEq)]
enum State {
    Sine,
    Square(JerkLimited),
    Interrupted,
}

/// A [`Wave`] about a position.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PositionWave {
    wave: Wave,
    centre: f64,
    limits: MotionLimits,
    state: State,
    /// The present rate of a sine's time.
    rate: WaveRate,
    last: Motion,
}

impl PositionWave {
    /// Creates a wave about the standstill `motion`. Fails if it would exceed a limit or leave the
    /// range. A square wave also fails if half a period is too short for its moves.
    pub fn new(
        wave: Wave,
        motion: Motion,
        limits: MotionLimits,
        range: Option<[f64; 2]>,
        dt_s: f64,
    ) -> Result<Self, SetpointError> {
        limits.check()?;
        motion.check()?;
        position("amplitude", wave.amplitude)?;
        let velocity = motion.velocity;
        if velocity != 0.0 {
            return Err(SetpointError::NotAtRest { velocity });
        }
        let centre = motion.position;
        if let Some(range) = range {
            within(centre + wave.amplitude, range)?;
            within(centre - wave.amplitude, range)?;
        }
        let state = match wave.shape {
            Shape::Sine => {
                let [velocity, acceleration, jerk] = wave.slopes();
                if velocity > limits.velocity {
                    return Err(SetpointError::TooFast {
                        velocity,
                        limit: limits.velocity,
                    });
                }
                if acceleration > limits.acceleration * (1.0 - RESERVE) {
                    return Err(SetpointError::TooSteep {
                        acceleration,
                        limit: limits.acceleration * (1.0 - RESERVE),
                    });
                }
                if jerk > limits.jerk * (1.0 - 2.0 * RESERVE) {
                    return Err(SetpointError::TooMuchJerk {
                        jerk,
                        limit: limits.jerk * (1.0 - 2.0 * RESERVE),
                    });
                }
                State::Sine
            }
            Shape::Square => {
                let order = |target| MoveRequest::within(Goal::Position(target), limits);
                let swing = JerkLimited::new(
                    order(centre + wave.amplitude),
                    Motion::at(centre - wave.amplitude),
                    dt_s,
                )?;
                // The end of a move takes one more cycle, and half periods need not be whole
                // cycles.
                if swing.duration_s() + 2.0 * dt_s > 0.5 / wave.frequency {
                    return Err(SetpointError::NoTime);
                }
                State::Square(JerkLimited::new(order(centre), motion, dt_s)?)
            }
        };
        Ok(Self {
            wave,
            centre,
            limits,
            state,
            rate: WaveRate::WHOLE,
            last: motion,
        })
    }

    /// Returns the limits.
    #[must_use]
    pub const fn limits(&self) -> &MotionLimits {
        &self.limits
    }

    /// Returns true if the axis was interrupted; it stands since then.
    #[must_use]
    pub fn interrupted(&self) -> bool {
        self.state == State::Interrupted
    }
}

impl Setpoint for PositionWave {
    /// The time of the wave passes at the rate, at most 1. A sine changes its rate within the limits
    /// of the axis. RT: O(1).
    fn advance(&mut self, motion: Motion, rate: Rate, dt_s: f64) -> Motion {
        if dt_s.is_nan() || dt_s <= 0.0 {
            return motion;
        }
        let wanted = rate.min(Rate::WHOLE);
        if (motion.position, motion.velocity) != (self.last.position, self.last.velocity) {
            self.state = State::Interrupted;
        }
        let next = match &mut self.state {
            State::Sine => {
                let (slopes, limits) = (self.wave.slopes(), &self.limits);
                let rate = self.rate.advance(wanted, slopes, limits, dt_s);
                let value = self.wave.advance(rate * dt_s);
                let position = self.centre + value;
                motion.then(position, (position - motion.position) / dt_s, dt_s)
            }
            State::Square(source) => {
                let mut ahead = self.wave;
                let target = self.centre + ahead.advance(wanted.value() * dt_s);
                let order = MoveRequest::within(Goal::Position(target), self.limits);
                let same = source.request().goal == order.goal;
                // A hold delays a move, and the wave waits for its end.
                if same || source.finished(motion) {
                    self.wave = ahead;
                }
                if !same
                    && source.finished(motion)
                    && let Ok(next) = source.redirect(order, motion, dt_s)
                {
                    *source = next;
                }
                source.advance(motion, wanted, dt_s)
            }
            State::Interrupted => Hold {
                acceleration: self.limits.acceleration,
            }
            .brake(motion, dt_s),
        };
        self.last = next;
        next
    }

    fn at_hold(&self) -> HoldResponse {
        HoldResponse::Waits
    }

    fn finished(&self, motion: Motion) -> bool {
        match &self.state {
            State::Sine => self.wave.finished() && motion.stands_at(self.centre),
            State::Square(source) => {
                self.wave.finished()
                    && source.request().goal == Goal::Position(self.centre)
                    && source.finished(motion)
            }
            State::Interrupted => motion.velocity == 0.0,
        }
    }
}

#[cfg(test)]
#[path = "wave_tests.rs"]
mod tests;
