//! Set-points that depend on more than the axis itself: a line with other axes, a table, the motion
//! of another axis.
//!
//! A generator gives its axis one position per cycle through `Axis::set_point`, like a user
//! controller. The limits of the axis therefore apply to each position. Any other motion command to
//! the axis ends its generator.

use ecaxis_axis::group::LinePath;
use ecaxis_axis::setpoint::{
    self, Cam, Gear, GearConfig, GearInMode, Goal, JerkLimited, LineShaftEnd, Master, Motion,
    Playback, PositionWave, Rate, RateCourse, Setpoint, SetpointError, Table,
};
use ecaxis_axis::{Axis, AxisStatus, Command, CommandError, HomingStatus};
use ecaxis_ecat::index::{AxisIndex, LineShaftIndex};

use super::overrides::Rates;

/// A request to start following a set-point source.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum GeneratorRequest {
    /// The axis' part of a straight line. `first`: the first axis of this line names it.
    Line {
        along: LinePath,
        first: AxisIndex,
    },
    /// A move of its own, synchronised in time with other axes.
    Move(JerkLimited),
    Wave(PositionWave),
    /// A table; `table` is an index into the machine's tables.
    Table {
        table: usize,
        playback: Playback,
    },
    /// The motion of another axis or of a line shaft.
    Gear {
        master: GearMaster,
        /// The cam between both.
        cam: Option<CamRef>,
        config: GearConfig,
    },
}

/// What a gear follows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GearMaster {
    Axis {
        axis: AxisIndex,
        /// True for the master's reported position, false for its set-point.
        actual: bool,
    },
    LineShaft(LineShaftIndex),
}

impl GearMaster {
    /// Returns the followed axis of this machine.
    #[must_use]
    pub const fn axis(self) -> Option<AxisIndex> {
        match self {
            Self::Axis { axis, .. } => Some(axis),
            Self::LineShaft(_) => None,
        }
    }
}

/// A cam and the way on it per way of the master.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CamRef {
    /// Index into the machine's cams.
    pub cam: usize,
    pub scale: f64,
}

impl CamRef {
    /// Returns the motion that the follower's gear follows. RT.
    pub(super) fn through(cam: Option<Self>, cams: &[Cam], master: Motion) -> Motion {
        let known = cam.and_then(|at| Some((cams.get(at.cam)?, at.scale)));
        known.map_or(master, |(cam, scale)| cam.motion(master, scale))
    }
}

/// The source that an axis follows.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Source {
    /// A source that needs only the motion of the axis. `line`: the first axis of its line.
    Single {
        source: setpoint::Source,
        line: Option<AxisIndex>,
    },
    Table {
        table: usize,
        playback: Playback,
    },
    Gear {
        master: GearMaster,
        cam: Option<CamRef>,
        gear: Gear,
    },
}

/// A move on top of another motion.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Superimposed {
    /// Follows the motion with ratio 1, shifted by the move.
    gear: Gear,
    /// The motion without the move.
    below: Motion,
}

/// Smaller differences between two velocities are rounding; a stop by lost frames exceeds this.
const ROUNDING: f64 = 1e-6;

/// The longest time that an engaged gear may lag.
const SLIP_S: f64 = 0.02;
/// The same for reported positions. They change in steps, and a drive that catches up accelerates
/// more than its set-point.
const SLIP_ACTUAL_S: f64 = 0.5;

/// Why a generator did not start, or ended before its source.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum GeneratorError {
    /// Not started: the axis was at another position or in motion.
    #[error(transparent)]
    NotBegun(SetpointError),
    /// The axis rejected a set-point and decelerates.
    #[error(transparent)]
    Refused(CommandError),
    #[error("the axes would follow each other")]
    Ring,
    #[error("the followed axis has no power or is homing")]
    NoMaster,
    #[error("the line shaft does not run: {end}")]
    LineShaft {
        shaft: LineShaftIndex,
        end: LineShaftEnd,
    },
    /// Of time-based sources only. A line continues where it was interrupted, but points in time
    /// are past.
    #[error("lost frames delayed the axis, and the time of its set-points is past")]
    Delayed,
    #[error("another axis of the same line has stopped")]
    PartnerStopped,
    #[error("the axis cannot follow within its limits")]
    Slipped,
}

/// The state of the last generator of an axis.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum GeneratorState {
    #[default]
    None,
    Running,
    /// A gear that has reached its ratio and offset.
    Engaged,
    /// The end is reached.
    Finished,
    Failed(GeneratorError),
}

impl GeneratorState {
    /// True while the axis follows a source.
    #[must_use]
    pub const fn runs(self) -> bool {
        matches!(self, Self::Running | Self::Engaged)
    }
}

/// The set-point generator of one axis.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SetpointGenerator {
    source: Option<Source>,
    superimposed: Option<Superimposed>,
    state: GeneratorState,
    /// The last motion that the source gave.
    given: Option<Motion>,
    /// How long an engaged gear has lagged.
    slipping_s: f64,
}

/// Returns the set-point of an axis.
#[must_use]
pub fn commanded(status: &AxisStatus) -> Motion {
    Motion {
        position: status.target_position,
        velocity: status.target_velocity,
        acceleration: status.target_acceleration,
    }
}

/// Returns the motion of a master: its set-point, or its reported values. Returns `None` if the
/// master has no power or is homing, because its position may jump.
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

impl SetpointGenerator {
    #[must_use]
    pub fn state(&self) -> GeneratorState {
        self.state
    }

    /// True while the axis follows a source.
    #[must_use]
    pub fn runs(&self) -> bool {
        self.source.is_some()
    }

    /// Starts a source. `master` is the motion of the gear's master. `rate` is the override of the
    /// axis. RT: O(1).
    pub fn begin(
        &mut self,
        start: GeneratorRequest,
        axis: &AxisStatus,
        master: Result<Motion, GeneratorError>,
        rate: Rate,
    ) {
        self.slipping_s = 0.0;
        let master = match master {
            Ok(master) => master,
            Err(error) => return self.fail(error),
        };
        let source = match start {
            GeneratorRequest::Line { along, first } => Ok(Source::Single {
                source: setpoint::Source::Line(along),
                line: Some(first),
            }),
            // From rest, slower moves of the same duration still arrive together.
            GeneratorRequest::Move(planned) => Ok(Source::Single {
                source: setpoint::Source::JerkLimited(planned.slowed(rate.value())),
                line: None,
            }),
            GeneratorRequest::Wave(wave) => Ok(Source::Single {
                source: setpoint::Source::Wave(wave),
                line: None,
            }),
            GeneratorRequest::Table { table, playback } => Ok(Source::Table { table, playback }),
            GeneratorRequest::Gear {
                master: of,
                cam,
                config,
            } => Gear::new(config, master, commanded(axis)).map(|gear| Source::Gear {
                master: of,
                cam,
                gear,
            }),
        };
        self.superimposed = None;
        self.given = match &source {
            Ok(Source::Table { playback, .. }) => Some(playback.motion()),
            _ => None,
        };
        (self.source, self.state) = match source {
            Ok(source) => (Some(source), GeneratorState::Running),
            Err(error) => (
                None,
                GeneratorState::Failed(GeneratorError::NotBegun(error)),
            ),
        };
    }

    /// Returns the first axis of the line on which the axis moves.
    #[must_use]
    pub fn line(&self) -> Option<AxisIndex> {
        match self.source {
            Some(Source::Single { line, .. }) => line,
            _ => None,
        }
    }

    /// True while the axis plays a table. `begun`: only if its first cycle has been played.
    #[must_use]
    pub fn plays(&self, begun: bool) -> bool {
        match self.source {
            Some(Source::Table { playback, .. }) => !begun || playback.has_begun(),
            _ => false,
        }
    }

    /// Returns true if the table keeps the limits of the axis on a course of rates. RT: as
    /// [`Playback::keeps`].
    pub fn keeps(&self, axis: &Axis, tables: &[Table], course: RateCourse, cycle_s: f64) -> bool {
        let Some(Source::Table { table, playback }) = self.source else {
            return true;
        };
        let limits = axis.config().limits.motion();
        let table = tables.get(table);
        table.is_none_or(|table| playback.keeps(table, &limits, course, cycle_s))
    }

    /// Lets the time of the table pass, in every cycle of the bus. So all tables of a group have a
    /// common time, however often their axes step. RT: O(rows in a cycle).
    pub fn play(&mut self, tables: &[Table], rate: Rate, cycle_s: f64) {
        if let Some(Source::Table { table, playback }) = &mut self.source
            && let Some(table) = tables.get(*table)
        {
            let last = playback.motion();
            playback.with_table(table).advance(last, rate, cycle_s);
        }
    }

    /// Ends the line because another axis on it has stopped.
    pub fn abort_line(&mut self) {
        self.fail(GeneratorError::PartnerStopped);
    }

    /// Rejects the start because the axis may not move.
    pub fn refuse(&mut self, reason: CommandError) {
        self.fail(GeneratorError::Refused(reason));
    }

    fn fail(&mut self, error: GeneratorError) {
        (self.source, self.superimposed) = (None, None);
        self.state = GeneratorState::Failed(error);
    }

    /// Ends the source because the axis received another command.
    pub fn end(&mut self) {
        self.superimposed = None;
        if self.source.take().is_some() {
            self.state = GeneratorState::None;
        }
    }

    /// Returns what the axis follows, and the cam between both.
    #[must_use]
    pub fn master(&self) -> Option<(GearMaster, Option<CamRef>)> {
        match self.source {
            Some(Source::Gear { master, cam, .. }) => Some((master, cam)),
            _ => None,
        }
    }

    /// Returns the followed axis of this machine.
    #[must_use]
    pub fn followed(&self) -> Option<AxisIndex> {
        self.master()?.0.axis()
    }

    /// Shifts a follower against its master. RT: O(1).
    ///
    /// # Errors
    /// Fails if the axis follows none, or the distance is invalid.
    pub(super) fn shift(&mut self, distance: f64, dt_s: f64) -> Result<(), CommandError> {
        let Some(Source::Gear { gear, .. }) = &mut self.source else {
            return Err(CommandError::NotFollowing);
        };
        gear.shift(distance, dt_s)?;
        (self.state, self.slipping_s) = (GeneratorState::Running, 0.0);
        Ok(())
    }

    /// Adds a move to any motion of the axis. RT: O(1).
    ///
    /// # Errors
    /// Fails if the axis commands no position, may not move, or the distance is invalid.
    pub(super) fn superimpose(
        &mut self,
        axis: &Axis,
        distance: f64,
        dt_s: f64,
    ) -> Result<(), CommandError> {
        if self.master().is_some() {
            return self.shift(distance, dt_s);
        }
        let source = match self.source {
            Some(source) => source,
            None => Source::Single {
                source: axis.source()?,
                line: None,
            },
        };
        let mut superimposed = match self.superimposed {
            Some(superimposed) => superimposed,
            None => {
                let limits = &axis.config().limits;
                let config = GearConfig {
                    ratio: 1.0,
                    engage: GearInMode::Here,
                    smoothing_s: 0.0,
                    limits: limits.motion(),
                    range: limits.position,
                };
                // A source that runs continues from its own motion, without the rounding of the axis.
                let below = match self.source {
                    Some(_) => self.resume_motion(axis, dt_s),
                    None => commanded(&axis.status()),
                };
                let gear = Gear::new(config, below, below)?;
                Superimposed { gear, below }
            }
        };
        superimposed.gear.shift(distance, dt_s)?;
        if self.source.is_none() {
            self.given = None;
        }
        (self.source, self.superimposed) = (Some(source), Some(superimposed));
        self.state = GeneratorState::Running;
        Ok(())
    }

    /// Returns velocity and acceleration with which the axis continues by itself after a
    /// superimposed move.
    fn continues_at(&self) -> Option<[f64; 2]> {
        let over = self.superimposed?.gear.engaged();
        match self.source? {
            Source::Single {
                source: setpoint::Source::JerkLimited(plan),
                ..
            } if over => match plan.request().goal {
                Goal::Velocity(velocity) => Some([velocity, plan.request().limits.acceleration]),
                Goal::Position(_) => None,
            },
            _ => None,
        }
    }

    /// Returns where the source left the axis, if it is still there. The axis computes its velocity
    /// from positions with rounding, which the source would take for a disturbance.
    fn resume_motion(&self, axis: &Axis, dt_s: f64) -> Motion {
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

    /// Gives the axis this cycle's set-point; call it between the axis' `observe` and `act`.
    /// `master` is the motion of its master. Returns true if the source has just ended without a
    /// command. RT: O(1).
    pub fn advance(
        &mut self,
        axis: &mut Axis,
        master: Result<Master, GeneratorError>,
        rates: Rates,
        dt_s: f64,
    ) -> bool {
        let Some(mut source) = self.source else {
            return false;
        };
        let master = match master {
            Ok(master) => master,
            Err(error) => {
                self.fail(error);
                return true;
            }
        };
        if let Some([velocity, acceleration]) = self.continues_at() {
            self.end();
            let ramp = (acceleration / axis.config().limits.acceleration).min(1.0);
            if let Err(reason) = axis.command(Command::Velocity { velocity, ramp }) {
                self.fail(GeneratorError::Refused(reason));
                return true;
            }
            return false;
        }
        let own = rates.own.min(Rate::WHOLE);
        let before = self.resume_motion(axis, dt_s);
        let disturbed = self.given.is_some_and(|given| given != before);
        let mut superimposed = self.superimposed;
        let mut interrupted = superimposed.is_some() && disturbed;
        let below = superimposed.map_or(before, |superimposed| superimposed.below);
        let (mut next, mut finished, mut state) = match &mut source {
            Source::Single { source, line } => {
                let rate = match line {
                    Some(_) => rates.line,
                    None => own,
                };
                let next = source.advance(below, rate, dt_s);
                if let setpoint::Source::Wave(wave) = source {
                    interrupted |= wave.interrupted();
                }
                (next, source.finished(next), GeneratorState::Running)
            }
            Source::Table { playback, .. } => {
                interrupted |= disturbed;
                let position = playback.motion().position;
                let next = below.then(position, (position - below.position) / dt_s, dt_s);
                (next, playback.finished(next), GeneratorState::Running)
            }
            Source::Gear { gear, .. } => {
                let next = gear.with_master(master).advance(before, own, dt_s);
                let state = if gear.engaged() {
                    GeneratorState::Engaged
                } else {
                    GeneratorState::Running
                };
                if own.is_held() {
                    // It waits, or follows its master to rest.
                    self.slipping_s = 0.0;
                } else if self.state == GeneratorState::Engaged && state == GeneratorState::Running
                {
                    self.slipping_s = dt_s;
                } else if self.slipping_s > 0.0 && state == GeneratorState::Running {
                    self.slipping_s += dt_s;
                } else {
                    self.slipping_s = 0.0;
                }
                (next, false, state)
            }
        };
        if let Some(Superimposed { gear, below }) = &mut superimposed {
            *below = next;
            let master = Master {
                motion: next,
                comes_to_rest: true,
            };
            next = gear.with_master(master).advance(before, own, dt_s);
            finished &= gear.engaged() && next.velocity == 0.0;
            if gear.engaged() {
                state = GeneratorState::Engaged;
            }
        }
        let timeout = match source {
            Source::Gear {
                master: GearMaster::Axis { actual: true, .. },
                ..
            } => SLIP_ACTUAL_S,
            _ => SLIP_S,
        };
        if self.slipping_s > timeout {
            self.fail(GeneratorError::Slipped);
            return true;
        }
        if interrupted {
            self.fail(GeneratorError::Delayed);
            return true;
        }
        match axis.set_point(next.position) {
            Ok(()) if finished => {
                (self.source, self.superimposed) = (None, None);
                self.state = GeneratorState::Finished;
            }
            Ok(()) => {
                (self.source, self.superimposed) = (Some(source), superimposed);
                self.state = state;
                self.given = Some(next);
            }
            // The axis waits, and so does its source. Only the time of a table passes.
            Err(CommandError::FramesLost) => {
                if matches!(source, Source::Table { .. }) && next.position != before.position {
                    self.fail(GeneratorError::Delayed);
                    return true;
                }
            }
            Err(reason) => {
                self.fail(GeneratorError::Refused(reason));
                return true;
            }
        }
        false
    }
}

#[cfg(test)]
#[path = "setpoint_generator_tests.rs"]
mod tests;
