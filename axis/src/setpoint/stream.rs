//! Set-points from points that arrive during the motion.
//!
//! Points have a fixed time distance. Each arriving point is checked together with the piece from
//! the previous point. So no point in the buffer can exceed a limit later. When the points run out,
//! the axis decelerates with its limit and stands. The state is then [`StreamState::Underrun`], and
//! the next motion must start from there.

use super::error::{finite, usable};
use super::spline::{Interpolation, Piece, check_corner, check_end, check_stop};
use super::{Hold, HoldResponse, Knot, Motion, MotionLimits, Rate, Setpoint, SetpointError};

/// The configuration of a stream.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StreamConfig {
    /// The path between two points.
    pub interpolation: Interpolation,
    /// Time from one point to the next, seconds.
    pub interval_s: f64,
    /// Number of points that start the motion; the last point also starts it.
    pub prefill: usize,
    /// The limits that every piece must keep.
    pub limits: MotionLimits,
    /// Lowest and highest position; `None`: unlimited.
    pub range: Option<[f64; 2]>,
    /// Cycle time, seconds.
    pub dt_s: f64,
}

/// The state of a stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum StreamState {
    /// Waits for the first points.
    Waiting,
    /// Passes the points.
    Moving,
    /// The last point has been passed.
    Ended,
    /// The points ran out before [`Stream::close`], or the axis was interrupted: it brakes, then
    /// stands. Further points are rejected.
    Underrun,
}

/// A buffer of `N` points and its interpolation. Stored inline, without allocation.
#[derive(Debug, Clone, PartialEq)]
pub struct Stream<const N: usize> {
    config: StreamConfig,
    buffer: [Piece; N],
    /// The torque at the end of each piece, and at the start of the present one.
    torques: [f64; N],
    torque_before: f64,
    first: usize,
    filled: usize,
    /// The last accepted point, with the velocity there.
    newest: Knot,
    closed: bool,
    state: StreamState,
    elapsed: f64,
    last: Motion,
}

impl<const N: usize> Stream<N> {
    /// Creates a stream that starts at the standstill `motion`.
    pub fn new(config: StreamConfig, motion: Motion) -> Result<Self, SetpointError> {
        usable("interval", config.interval_s)?;
        usable("cycle time", config.dt_s)?;
        // Several points in a cycle would add several changes of velocity in it.
        if config.interval_s < config.dt_s * (1.0 - 1e-9) {
            return Err(SetpointError::NoTime);
        }
        config.limits.check()?;
        motion.check()?;
        let velocity = motion.velocity;
        if velocity != 0.0 {
            return Err(SetpointError::NotAtRest { velocity });
        }
        let at = Knot {
            position: motion.position,
            velocity: 0.0,
        };
        Ok(Self {
            config,
            buffer: [Piece::new(at, at, config.interval_s); N],
            torques: [0.0; N],
            torque_before: 0.0,
            first: 0,
            filled: 0,
            newest: at,
            closed: false,
            state: StreamState::Waiting,
            elapsed: 0.0,
            last: motion,
        })
    }

    /// Accepts the point `interval_s` after the previous one, or rejects it and changes nothing.
    /// RT: O(1).
    pub fn push(&mut self, point: Knot) -> Result<(), SetpointError> {
        self.push_with_torque(point, 0.0)
    }

    /// Like [`Stream::push`], with the torque feed-forward at the point in percent of rated torque.
    pub fn push_with_torque(&mut self, point: Knot, torque: f64) -> Result<(), SetpointError> {
        finite("torque", torque)?;
        if self.closed || self.state == StreamState::Underrun {
            return Err(SetpointError::Ended);
        }
        if self.filled >= N {
            return Err(SetpointError::Full { capacity: N });
        }
        let piece = self.check(point)?;
        if let Some(place) = self.buffer.get_mut((self.first + self.filled) % N) {
            *place = piece;
        }
        if let Some(place) = self.torques.get_mut((self.first + self.filled) % N) {
            *place = torque;
        }
        self.filled += 1;
        self.newest = piece.to();
        Ok(())
    }

    /// Ends the stream: the axis stands at the last point. Fails, without closing, if the axis
    /// would be too fast there. A cubic must end with velocity 0.
    pub fn close(&mut self) -> Result<(), SetpointError> {
        let config = &self.config;
        check_end(
            config.interpolation,
            self.newest.velocity,
            config.limits.acceleration,
            config.dt_s,
        )?;
        self.closed = true;
        Ok(())
    }

    /// Returns the torque feed-forward at the present position, linear between the points. 0 unless
    /// the stream moves.
    #[must_use]
    pub fn torque(&self) -> f64 {
        let piece = self.buffer.get(self.first).filter(|_| self.filled > 0);
        let (Some(piece), Some(after)) = (piece, self.torques.get(self.first)) else {
            return 0.0;
        };
        if self.state != StreamState::Moving {
            return 0.0;
        }
        let share = self.elapsed / piece.time();
        self.torque_before + (after - self.torque_before) * share
    }

    /// Returns the state.
    #[must_use]
    pub const fn state(&self) -> StreamState {
        self.state
    }

    /// Returns the number of points that still fit into the buffer.
    #[must_use]
    pub const fn free(&self) -> usize {
        N.saturating_sub(self.filled)
    }

    fn check(&self, point: Knot) -> Result<Piece, SetpointError> {
        let config = &self.config;
        super::error::position("point", point.position)?;
        finite("velocity", point.velocity)?;
        let before = self.newest;
        let piece = match config.interpolation {
            Interpolation::Cubic => Piece::new(before, point, config.interval_s),
            Interpolation::Linear => {
                Piece::straight(before.position, point.position, config.interval_s)
            }
        };
        let acceleration = config.limits.acceleration;
        piece.check(config.limits, config.range)?;
        check_corner(
            before.velocity,
            piece.from().velocity,
            acceleration,
            config.dt_s,
        )?;
        check_stop(piece.to(), acceleration, config.range, config.dt_s)?;
        Ok(piece)
    }

    fn start(&mut self) {
        let enough = self.config.prefill.clamp(1, N.max(1));
        if self.state == StreamState::Waiting && (self.filled >= enough || self.closed) {
            self.state = StreamState::Moving;
        }
    }

    /// Returns the position after a further `dt_s`, or `None` if the points have run out.
    fn pass(&mut self, dt_s: f64) -> Option<f64> {
        self.elapsed += dt_s;
        while self.filled > 0 {
            let piece = self.buffer.get(self.first)?;
            if self.elapsed < piece.time() {
                return Some(piece.position(self.elapsed));
            }
            self.elapsed -= piece.time();
            self.torque_before = self.torques.get(self.first).copied().unwrap_or_default();
            self.first = (self.first + 1) % N;
            self.filled -= 1;
        }
        if !self.closed {
            return None;
        }
        self.state = StreamState::Ended;
        Some(self.newest.position)
    }
}

impl<const N: usize> Setpoint for Stream<N> {
    /// RT: O(points passed in one cycle).
    fn advance(&mut self, motion: Motion, rate: Rate, dt_s: f64) -> Motion {
        if dt_s.is_nan() || dt_s <= 0.0 {
            return motion;
        }
        if (motion.position, motion.velocity) != (self.last.position, self.last.velocity) {
            self.state = StreamState::Underrun;
        }
        if !rate.is_held() {
            self.start();
        } else if self.state == StreamState::Moving {
            // The time of the points passes without the axis.
            self.state = StreamState::Underrun;
        }
        let position = match self.state {
            StreamState::Moving => self.pass(dt_s),
            StreamState::Waiting => Some(motion.position),
            StreamState::Ended => Some(self.newest.position),
            StreamState::Underrun => None,
        };
        let next = match position {
            Some(position) => motion.then(position, (position - motion.position) / dt_s, dt_s),
            None => {
                self.state = StreamState::Underrun;
                let acceleration = self.config.limits.acceleration;
                Hold { acceleration }.brake(motion, dt_s)
            }
        };
        self.last = next;
        next
    }

    /// A stream that has not begun waits.
    fn at_hold(&self) -> HoldResponse {
        HoldResponse::Ends
    }

    fn finished(&self, motion: Motion) -> bool {
        matches!(self.state, StreamState::Ended | StreamState::Underrun) && motion.velocity == 0.0
    }
}

#[cfg(test)]
#[path = "stream_tests.rs"]
mod tests;
