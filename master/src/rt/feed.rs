//! Set-points that come from more than the axis itself: a line with other axes, a table, another axis' motion.
//!
//! A feed gives its axis one position a cycle, through the same door as a controller of one's own, so the axis' limits judge
//! each of them. Whatever else an axis is told to do ends its feed.

use ecaxis_axis::group::Along;
use ecaxis_axis::setpoint::{
    Gear, GearConfig, JerkLimited, Motion, Playback, PositionWave, Setpoint, SetpointError, Table,
};
use ecaxis_axis::{Axis, AxisStatus, HomingStatus, Refused};

/// What an axis is to follow from now on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Start {
    /// Its part of a straight line.
    Line(Along),
    /// On its own way, timed with others.
    Move(JerkLimited),
    Wave(PositionWave),
    /// Index of the table among those of the machine.
    Table {
        table: usize,
        playback: Playback,
    },
    /// Another axis.
    Gear {
        master: usize,
        /// The master's reported position instead of its set-point.
        actual: bool,
        config: GearConfig,
    },
}

/// What an axis follows.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Source {
    Line(Along),
    Move(JerkLimited),
    Wave(PositionWave),
    Table {
        table: usize,
        playback: Playback,
    },
    Gear {
        master: usize,
        actual: bool,
        gear: Gear,
    },
}

/// Less is no difference between two velocities; a stop by lost frames is more.
const ROUNDING: f64 = 1e-6;

const RING: &str = "the axes would follow each other";
const NO_MASTER: &str = "the axis that is followed has no power, or searches its home";
/// A line goes on from where it was held up; points by time are past.
pub(crate) const HELD_UP: &str = "lost frames held the axis up, and its time is past";
const NO_PARTNER: &str = "an axis of the same line has stopped";
const SLIPS: &str = "the axis cannot follow within its limits";

/// A gear that was engaged may be behind for so long.
const SLIP_S: f64 = 0.02;
/// Reported positions come in steps, and a drive that catches up accelerates harder than its set-point.
const SLIP_ACTUAL_S: f64 = 0.5;

/// How the last feed of an axis stands.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum FeedState {
    #[default]
    None,
    Running,
    /// A gear that is where it is to be.
    Engaged,
    /// The end is reached.
    Finished,
    /// It could not begin: the axis was elsewhere, or in motion.
    NotBegun(SetpointError),
    /// The axis did not take a set-point of it, and decelerates.
    Refused(Refused),
    /// Why there is nothing to follow, or it cannot be followed.
    Lost(&'static str),
}

/// The feed of one axis.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Feed {
    source: Option<Source>,
    state: FeedState,
    /// What the source said last.
    given: Option<Motion>,
    /// How long a gear that was engaged has been behind.
    slipping_s: f64,
}

/// An axis' set-point.
#[must_use]
pub fn commanded(status: &AxisStatus) -> Motion {
    Motion {
        position: status.target_position,
        velocity: status.target_velocity,
        acceleration: status.target_acceleration,
    }
}

/// Where a master is: its set-point, or what it reports. `None`: it has no power or searches its home, and its position may
/// jump.
#[must_use]
pub fn master_motion(status: &AxisStatus, actual: bool) -> Option<Motion> {
    if !status.enabled || matches!(status.homing, HomingStatus::Running) {
        return None;
    }
    Some(if actual {
        Motion {
            position: status.position,
            velocity: status.velocity,
            acceleration: 0.0,
        }
    } else {
        commanded(status)
    })
}

impl Feed {
    #[must_use]
    pub fn state(&self) -> FeedState {
        self.state
    }

    /// Whether the axis is led.
    #[must_use]
    pub fn runs(&self) -> bool {
        self.source.is_some()
    }

    /// `master` is the motion of the gear's master; `ring`: that one follows this axis. RT: O(1).
    pub fn begin(&mut self, start: Start, axis: &AxisStatus, master: Option<Motion>, ring: bool) {
        self.slipping_s = 0.0;
        if ring || (matches!(start, Start::Gear { .. }) && master.is_none()) {
            let why = if ring { RING } else { NO_MASTER };
            (self.source, self.state) = (None, FeedState::Lost(why));
            return;
        }
        let source = match start {
            Start::Line(along) => Ok(Source::Line(along)),
            Start::Move(planned) => Ok(Source::Move(planned)),
            Start::Wave(wave) => Ok(Source::Wave(wave)),
            Start::Table { table, playback } => Ok(Source::Table { table, playback }),
            Start::Gear {
                master: index,
                actual,
                config,
            } => Gear::new(config, master.unwrap_or_default(), commanded(axis)).map(|gear| {
                Source::Gear {
                    master: index,
                    actual,
                    gear,
                }
            }),
        };
        self.given = None;
        (self.source, self.state) = match source {
            Ok(source) => (Some(source), FeedState::Running),
            Err(error) => (None, FeedState::NotBegun(error)),
        };
    }

    /// Whether the axis is led along a line: those that are at the same time are on the same.
    #[must_use]
    pub fn on_line(&self) -> bool {
        matches!(self.source, Some(Source::Line(_)))
    }

    /// Another axis of its line does not go on.
    pub fn part(&mut self) {
        (self.source, self.state) = (None, FeedState::Lost(NO_PARTNER));
    }

    /// It is not begun, because the axis may not move.
    pub fn refuse(&mut self, reason: Refused) {
        (self.source, self.state) = (None, FeedState::Refused(reason));
    }

    /// The axis was told to do something else.
    pub fn end(&mut self) {
        if self.source.take().is_some() {
            self.state = FeedState::None;
        }
    }

    /// Index of the axis that is followed, and whether what it reports is.
    #[must_use]
    pub fn master(&self) -> Option<(usize, bool)> {
        match self.source {
            Some(Source::Gear { master, actual, .. }) => Some((master, actual)),
            _ => None,
        }
    }

    /// Where the source left the axis, if it is still there: the axis works the velocity out from positions, which rounds, and the
    /// source would take that for a disturbance.
    fn taken(&self, axis: &Axis, dt_s: f64) -> Motion {
        let now = commanded(&axis.status());
        let Some(given) = self.given.filter(|given| given.position == now.position) else {
            return now;
        };
        let smallest = axis.config().limits.acceleration * dt_s;
        if (given.velocity - now.velocity).abs() <= ROUNDING * (given.velocity.abs() + smallest) {
            given
        } else {
            now
        }
    }

    /// Gives the axis this cycle's set-point; between its `observe` and `act`. RT: O(1), for a table O(rows in a cycle).
    /// `true`: it has just ended without an order to.
    pub fn give(
        &mut self,
        axis: &mut Axis,
        tables: &[Table],
        master: Option<Motion>,
        dt_s: f64,
    ) -> bool {
        let Some(mut source) = self.source else {
            return false;
        };
        if self.master().is_some() && master.is_none() {
            (self.source, self.state) = (None, FeedState::Lost(NO_MASTER));
            return true;
        }
        let before = self.taken(axis, dt_s);
        let mut interrupted = false;
        let (next, finished, state) = match &mut source {
            Source::Line(along) => {
                let next = along.advance(before, dt_s);
                (next, along.finished(next), FeedState::Running)
            }
            Source::Move(planned) => {
                let next = planned.advance(before, dt_s);
                (next, planned.finished(next), FeedState::Running)
            }
            Source::Wave(wave) => {
                let next = wave.advance(before, dt_s);
                interrupted = wave.interrupted();
                (next, wave.finished(next), FeedState::Running)
            }
            Source::Table { table, playback } => match tables.get(*table) {
                Some(table) => {
                    let next = playback.advance(table, before, dt_s);
                    interrupted = playback.interrupted();
                    (next, playback.finished(next), FeedState::Running)
                }
                None => (before, true, FeedState::Running),
            },
            Source::Gear { gear, .. } => {
                let next = gear.advance(master.unwrap_or_default(), before, dt_s);
                let state = if gear.engaged() {
                    FeedState::Engaged
                } else {
                    FeedState::Running
                };
                if self.state == FeedState::Engaged && state == FeedState::Running {
                    self.slipping_s = dt_s;
                } else if self.slipping_s > 0.0 && state == FeedState::Running {
                    self.slipping_s += dt_s;
                } else {
                    self.slipping_s = 0.0;
                }
                (next, false, state)
            }
        };
        let patience = match source {
            Source::Gear { actual: true, .. } => SLIP_ACTUAL_S,
            _ => SLIP_S,
        };
        if self.slipping_s > patience {
            (self.source, self.state) = (None, FeedState::Lost(SLIPS));
            return true;
        }
        if interrupted {
            (self.source, self.state) = (None, FeedState::Lost(HELD_UP));
            return true;
        }
        match axis.set_point(next.position) {
            Ok(()) if finished => (self.source, self.state) = (None, FeedState::Finished),
            Ok(()) => {
                (self.source, self.state) = (Some(source), state);
                self.given = Some(next);
            }
            // The axis waits; so does what it follows.
            Err(Refused::FramesLost) => {}
            Err(reason) => {
                (self.source, self.state) = (None, FeedState::Refused(reason));
                return true;
            }
        }
        false
    }
}

#[cfg(test)]
#[path = "feed_tests.rs"]
mod tests;
