//! A master on another machine: the line shaft that drives several machines.
//!
//! Points of its motion arrive later than they are needed, and not all of them. Each carries its
//! instant, in ns of a time that both machines have in common. The motion between and after the
//! points is predicted from the newest one. A new point changes the prediction; the difference
//! decays, critically damped, so that position and velocity are continuous.
//!
//! When the stream of points ends, the shaft decelerates to rest by itself. Its followers stay in
//! gear with it.

use super::error::SetpointError;
use super::{Motion, Ramp, braking_velocity};

/// The time constants within which a difference has decayed to 2 %.
const TIME_CONSTANTS: f64 = 6.0;
/// A larger deviation of a cycle from its nominal time is a skipped cycle.
const CYCLE_TOLERANCE: f64 = 0.01;
/// The fraction of the acceleration to brake after a large difference. The rest is for the motion of
/// the master meanwhile.
const CLOSING: f64 = 0.5;
/// The least time at rest after which the shaft has ended.
const REST_S: f64 = 0.02;
/// Values at a limit are accepted although they are rounded.
const ROUNDING: f64 = 1.0 + 1e-6;

/// The settings of a line shaft, in its units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LineShaftConfig {
    /// The velocity limit, units per second.
    pub velocity: f64,
    /// The acceleration limit, units per second². Also that of its stop.
    pub acceleration: f64,
    /// The time in seconds without a newer point at which the stream has ended. It counts from the
    /// point's instant or from the cycle in which it came, whichever is earlier.
    pub timeout_s: f64,
    /// The time in seconds within which a difference from the prediction decays.
    pub smoothing_s: f64,
    /// The difference from the prediction at which the stream has ended.
    pub max_error: f64,
}

/// A point of the motion of a master.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LineShaftPoint {
    /// Names one uninterrupted motion of the master.
    pub stream: u64,
    /// The instant in ns of common time.
    pub at_ns: u64,
    /// Position, velocity and acceleration at the instant.
    pub motion: Motion,
}

/// Why a point is rejected.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum LineShaftPointError {
    /// A value is not finite or exceeds a limit of the shaft.
    #[error(transparent)]
    Motion(#[from] SetpointError),
    /// The point is older than the timeout.
    #[error("its instant was {age_ms:.1} ms ago, more than the timeout of {timeout_ms:.1} ms")]
    Late {
        /// The age of the point.
        age_ms: f64,
        /// The timeout of the shaft.
        timeout_ms: f64,
    },
    /// The instant is in the future by more than the timeout.
    #[error("its instant is {ahead_ms:.1} ms ahead, more than the timeout of {timeout_ms:.1} ms")]
    Ahead {
        /// The time until the instant.
        ahead_ms: f64,
        /// The timeout of the shaft.
        timeout_ms: f64,
    },
}

/// Why a line shaft does not run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, thiserror::Error)]
#[non_exhaustive]
pub enum LineShaftEnd {
    /// It has not run yet.
    #[default]
    #[error("it has received no set-points")]
    NoPoints,
    /// No point within the timeout.
    #[error("no set-point came within its `timeout`")]
    Timeout,
    /// The stream has another name.
    #[error("its stream of set-points was interrupted and has begun again")]
    StreamChanged,
    /// No connection feeds the shaft.
    #[error("the connection that feeds it has closed")]
    Closed,
    /// Common time has jumped, or is not locked.
    #[error("common time has jumped, or is not locked")]
    CommonTime,
    /// The prediction was wrong by more than the largest error.
    #[error("its set-points jumped by more than `max_error`")]
    Jumped,
}

/// The state of a line shaft.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum LineShaftState {
    /// It stands, without points.
    #[default]
    Waiting,
    /// It follows its points.
    Running,
    /// The stream has ended; the shaft decelerates.
    Stopping,
}

/// The motion of a master on another machine.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LineShaft {
    config: LineShaftConfig,
    state: LineShaftState,
    newest: LineShaftPoint,
    /// The last point that came, and the instant of its first cycle.
    arrived: LineShaftPoint,
    arrived_ns: u64,
    /// The instant of the first cycle with the newest point.
    newest_ns: u64,
    /// The instant of the motion.
    at_ns: u64,
    motion: Motion,
    /// The velocity at the end of the cycle; that of `motion` is the mean one.
    velocity: f64,
    /// The last difference from the prediction.
    error: f64,
    /// How long the shaft has stood, and after what time it has ended.
    rest_s: f64,
    ends_after_s: f64,
    /// The time of a cycle by common time.
    cycle_s: f64,
    end: LineShaftEnd,
}

impl LineShaftConfig {
    /// Returns the error that a motion within the limits cannot exceed: the acceleration changes
    /// from one limit to the other just after the last point before the timeout.
    #[must_use]
    pub fn largest_error(acceleration: f64, timeout_s: f64) -> f64 {
        acceleration * timeout_s * timeout_s
    }

    /// Checks a point at the instant `now_ns`. RT: O(1).
    ///
    /// # Errors
    /// Says why the shaft rejects it.
    pub fn check(&self, point: &LineShaftPoint, now_ns: u64) -> Result<(), LineShaftPointError> {
        let Motion {
            velocity,
            acceleration,
            ..
        } = point.motion;
        point.motion.check()?;
        if velocity.abs() > self.velocity * ROUNDING {
            let limit = self.velocity;
            return Err(SetpointError::TooFast { velocity, limit }.into());
        }
        if acceleration.abs() > self.acceleration * ROUNDING {
            let limit = self.acceleration;
            return Err(SetpointError::TooSteep {
                acceleration,
                limit,
            }
            .into());
        }
        let age_s = seconds(now_ns, point.at_ns);
        let timeout_ms = self.timeout_s * 1e3;
        if age_s > self.timeout_s {
            let age_ms = age_s * 1e3;
            return Err(LineShaftPointError::Late { age_ms, timeout_ms });
        }
        if -age_s > self.timeout_s {
            let ahead_ms = -age_s * 1e3;
            return Err(LineShaftPointError::Ahead {
                ahead_ms,
                timeout_ms,
            });
        }
        Ok(())
    }

    /// Returns the motion at an instant. The acceleration lasts until the velocity limit, at most
    /// for the timeout. A deceleration ends at a standstill: a master that stops is not predicted to
    /// reverse.
    fn predict(&self, point: &LineShaftPoint, at_ns: u64) -> Motion {
        let dt = seconds(at_ns, point.at_ns);
        let Motion {
            position,
            velocity,
            acceleration,
        } = point.motion;
        let velocity = velocity.max(-self.velocity).min(self.velocity);
        let mut lasts = dt.max(-self.timeout_s).min(self.timeout_s);
        // Forwards in time only: the past of a point is its motion before.
        if acceleration != 0.0 && dt > 0.0 {
            let limit = match velocity * acceleration < 0.0 {
                true => 0.0,
                false => self.velocity.copysign(acceleration),
            };
            lasts = lasts.min((limit - velocity) / acceleration);
        }
        let end = velocity + acceleration * lasts;
        Motion {
            position: position + velocity * dt + acceleration * lasts * (dt - lasts / 2.0),
            velocity: end.max(-self.velocity).min(self.velocity),
            acceleration: if lasts == dt { acceleration } else { 0.0 },
        }
    }
}

/// Returns the time from `since` to `at` in seconds.
fn seconds(at: u64, since: u64) -> f64 {
    at.wrapping_sub(since).cast_signed() as f64 * 1e-9
}

impl LineShaft {
    /// Creates a shaft that waits for points.
    ///
    /// # Errors
    /// Fails if a setting is not usable.
    pub fn new(config: LineShaftConfig) -> Result<Self, SetpointError> {
        use super::error::usable;
        usable("velocity limit", config.velocity)?;
        usable("acceleration limit", config.acceleration)?;
        usable("timeout", config.timeout_s)?;
        usable("smoothing time", config.smoothing_s)?;
        usable("largest error", config.max_error)?;
        Ok(Self {
            config,
            state: LineShaftState::Waiting,
            newest: LineShaftPoint::default(),
            arrived: LineShaftPoint::default(),
            arrived_ns: 0,
            newest_ns: 0,
            at_ns: 0,
            motion: Motion::default(),
            velocity: 0.0,
            error: 0.0,
            rest_s: 0.0,
            ends_after_s: REST_S,
            cycle_s: 0.0,
            end: LineShaftEnd::NoPoints,
        })
    }

    /// Sets the longest time between two set-points of a follower. The shaft stands for two of them
    /// before it ends, so that each follower comes to rest with it.
    #[must_use]
    pub const fn with_slowest_follower(mut self, cycle_s: f64) -> Self {
        self.ends_after_s = REST_S.max(2.0 * cycle_s);
        self
    }

    /// Returns the state.
    #[must_use]
    pub const fn state(&self) -> LineShaftState {
        self.state
    }

    /// Returns the last motion.
    #[must_use]
    pub const fn last_motion(&self) -> Motion {
        self.motion
    }

    /// Returns the motion of this cycle.
    ///
    /// # Errors
    /// Says why the shaft waits.
    pub const fn motion(&self) -> Result<Motion, LineShaftEnd> {
        match self.state {
            LineShaftState::Waiting => Err(self.end),
            _ => Ok(self.motion),
        }
    }

    /// Returns the motion of this cycle if the shaft runs.
    ///
    /// # Errors
    /// Says why it does not.
    pub const fn running(&self) -> Result<Motion, LineShaftEnd> {
        match self.state {
            LineShaftState::Running => Ok(self.motion),
            _ => Err(self.end),
        }
    }

    /// Returns why the shaft last stopped.
    #[must_use]
    pub const fn end(&self) -> LineShaftEnd {
        self.end
    }

    /// Returns the newest point.
    #[must_use]
    pub const fn newest(&self) -> LineShaftPoint {
        self.newest
    }

    /// Returns the difference from the prediction in the last cycle.
    #[must_use]
    pub const fn error(&self) -> f64 {
        self.error
    }

    /// Advances one cycle. `now_ns` is the instant of the cycle; `None`: common time is not known.
    /// `point` is the newest point that has arrived; `None`: nothing feeds the shaft. RT: O(1).
    pub fn advance(&mut self, now_ns: Option<u64>, point: Option<LineShaftPoint>, dt_s: f64) {
        if dt_s.is_nan() || dt_s <= 0.0 {
            return;
        }
        if let (Some(now), Some(point)) = (now_ns, point)
            && (point.stream, point.at_ns) != (self.arrived.stream, self.arrived.at_ns)
        {
            (self.arrived, self.arrived_ns) = (point, now);
        }
        match self.state {
            LineShaftState::Waiting => {
                self.cycle_s = dt_s;
                self.begin(now_ns, point);
            }
            LineShaftState::Running => {
                if let Err(end) = self.follow(now_ns, point, dt_s) {
                    (self.state, self.end) = (LineShaftState::Stopping, end);
                    (self.error, self.rest_s) = (0.0, 0.0);
                    self.brake();
                }
            }
            LineShaftState::Stopping => self.brake(),
        }
    }

    fn begin(&mut self, now_ns: Option<u64>, point: Option<LineShaftPoint>) {
        let (Some(now), Some(point)) = (now_ns, point) else {
            return;
        };
        // The last point of a dead stream from the future may still be there.
        let dead = seconds(now, self.arrived_ns) > self.config.timeout_s;
        if !dead && self.config.check(&point, now).is_ok() {
            self.state = LineShaftState::Running;
            (self.newest, self.newest_ns, self.at_ns) = (point, self.arrived_ns, now);
            self.motion = self.config.predict(&point, now);
            (self.velocity, self.error) = (self.motion.velocity, 0.0);
        }
    }

    fn follow(
        &mut self,
        now_ns: Option<u64>,
        point: Option<LineShaftPoint>,
        dt_s: f64,
    ) -> Result<(), LineShaftEnd> {
        let now = now_ns.ok_or(LineShaftEnd::CommonTime)?;
        let point = point.ok_or(LineShaftEnd::Closed)?;
        let config = &self.config;
        let newer = seconds(point.at_ns, self.newest.at_ns) > 0.0;
        if newer && point.stream != self.newest.stream {
            return Err(LineShaftEnd::StreamChanged);
        }
        if newer && config.check(&point, now).is_ok() {
            (self.newest, self.newest_ns) = (point, self.arrived_ns);
        }
        // A point from the future does not prolong the time without points.
        let age_s = seconds(now, self.newest.at_ns).max(seconds(now, self.newest_ns));
        if age_s > config.timeout_s {
            return Err(LineShaftEnd::Timeout);
        }
        let before = config.predict(&self.newest, self.at_ns);
        let after = config.predict(&self.newest, now);
        let error = self.motion.position - before.position;
        if error.is_nan() || error.abs() > config.max_error {
            return Err(LineShaftEnd::Jumped);
        }
        let elapsed_s = seconds(now, self.at_ns);
        let regular = (elapsed_s - dt_s).abs() <= CYCLE_TOLERANCE * dt_s;
        if regular {
            self.cycle_s = elapsed_s;
        }
        let dt_s = self.cycle_s;
        let drift = self.velocity - before.velocity;
        let constant_s = (config.smoothing_s / TIME_CONSTANTS).max(dt_s);
        let share = dt_s / constant_s;
        let left = (-share).exp() * (drift - (drift + error / constant_s) * share);
        let change = config.acceleration * dt_s;
        // Not faster than the rest of the difference permits to brake.
        let closing = braking_velocity(error.abs(), config.acceleration * CLOSING, dt_s);
        let left = match left * error < 0.0 {
            true => left.max(-closing).min(closing),
            false => left,
        };
        let wanted = after.velocity + left;
        let velocity = wanted.max(-config.velocity).min(config.velocity);
        let velocity = velocity.max(self.velocity - change);
        let velocity = velocity.min(self.velocity + change);
        (self.at_ns, self.error) = (now, error);
        self.pass(velocity, dt_s);
        Ok(())
    }

    /// Decelerates, and ends after a time at rest.
    fn brake(&mut self) {
        // As before the stop: the clocks of both machines have different rates.
        let dt_s = self.cycle_s;
        let ramp = Ramp {
            target: 0.0,
            slope: self.config.acceleration,
        };
        let velocity = ramp.advance(self.velocity, dt_s);
        if velocity == 0.0 && self.velocity == 0.0 {
            self.rest_s += dt_s;
        }
        self.pass(velocity, dt_s);
        if self.rest_s > self.ends_after_s {
            self.state = LineShaftState::Waiting;
        }
    }

    /// Moves on for a cycle with a constant acceleration.
    fn pass(&mut self, velocity: f64, dt_s: f64) {
        let mean = f64::midpoint(self.velocity, velocity);
        let position = self.motion.position + mean * dt_s;
        self.motion = self.motion.then(position, mean, dt_s);
        self.velocity = velocity;
    }
}

#[cfg(test)]
#[path = "line_shaft_tests.rs"]
mod tests;
