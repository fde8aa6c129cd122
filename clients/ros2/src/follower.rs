//! What one joint follows: the commands of a publisher, or a trajectory.
//!
//! A joint begins to follow with a command at its axis and ends when commands stay away. Positions
//! come at the rate of the publisher; between them a leader moves on, and a gear follows it within
//! the limits of the axis.

use ecaxis_axis::setpoint::{
    Gear, GearConfig, GearInMode, Master, Motion, MotionLimits, Playback, Rate, Setpoint, Table,
};
use ecaxis_client::SetPoint;

use crate::joints::Joint;

/// The cycles that one call makes up for.
const MAX_CYCLES: u64 = 1000;
/// The leader takes this many times the period of the commands from one to the next.
const STRETCH: f64 = 1.5;
/// The weight of the newest period in their average.
const NEWEST: f64 = 0.2;
/// A leader at this part of a cycle's motion from its command stands.
const NEAR: f64 = 1e-3;
/// Commands that differ by this many times that distance move the joint.
const STEPS: f64 = 10.0;

/// Who sends the commands.
pub type Publisher = [u8; 16];

/// The settings of a follower, in units of the axis.
#[derive(Debug, Clone, Copy)]
pub struct FollowerConfig {
    pub limits: MotionLimits,
    pub range: Option<[f64; 2]>,
    pub start_tolerance: f64,
    pub smoothing_s: f64,
    pub stale_cycles: u64,
    pub dt_s: f64,
}

impl FollowerConfig {
    /// Returns the distance at which a joint counts as there.
    fn near(&self) -> f64 {
        self.limits.velocity * self.dt_s * NEAR
    }
}

/// What the cycle says about the axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AxisInput {
    pub target_position: f64,
    /// In Operation enabled.
    pub enabled: bool,
    /// The set-point does not move.
    pub stands: bool,
    /// The server waits for kind 0.
    pub blocked: bool,
}

/// Why a joint follows no longer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum End {
    /// The commands stay away, and the last ones moved the joint.
    Stale,
    /// The commands stay away; the joint stands.
    Silent,
    /// The trajectory is done.
    Done,
    /// The axis is not enabled any more.
    Disabled,
    /// The server follows no longer.
    Blocked,
}

/// Why a command is not followed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Refusal {
    Disabled,
    /// A service has stopped the joint.
    Held,
    Moves,
    /// The first command, and how far it is from the axis, in units of the axis.
    Far(f64),
    /// A trajectory is under way.
    Trajectory,
    /// Another publisher commands the joint.
    OtherPublisher,
}

#[derive(Debug, Clone)]
#[allow(
    clippy::large_enum_variant,
    reason = "nothing is allocated in the cycle, and each axis has one source"
)]
enum Source {
    Free,
    Position {
        leader: Leader,
        gear: Gear,
        motion: Motion,
    },
    /// A velocity or a torque.
    Constant(SetPoint),
    Trajectory {
        table: Table,
        playback: Playback,
        motion: Motion,
    },
}

/// A motion from command to command at constant velocity.
#[derive(Debug, Clone, Copy)]
struct Leader {
    motion: Motion,
    command: f64,
    /// The average period of the commands in cycles.
    period: f64,
    /// The cycles to the command.
    left: f64,
    /// The last command was not where the one before was.
    moves: bool,
}

impl Leader {
    fn command(&mut self, position: f64, since: u64, most: f64, near: f64) {
        let since = (since as f64).clamp(1.0, most);
        self.period += (since - self.period) * NEWEST;
        self.moves = (position - self.command).abs() > near * STEPS;
        self.command = position;
        self.left = (self.period * STRETCH).max(1.0);
    }

    fn advance(&mut self, dt_s: f64) {
        let step = (self.command - self.motion.position) / self.left.max(1.0);
        self.left = (self.left - 1.0).max(0.0);
        let position = if self.left == 0.0 {
            self.command
        } else {
            self.motion.position + step
        };
        let velocity = (position - self.motion.position) / dt_s;
        self.motion = self.motion.then(position, velocity, dt_s);
    }
}

/// Follows commands for one joint.
#[derive(Debug, Clone)]
pub struct Follower {
    config: FollowerConfig,
    source: Source,
    publisher: Publisher,
    /// The cycle of the last command.
    commanded: u64,
    cycle: u64,
    /// A service has stopped the joint; commands wait for `enable`.
    held: bool,
    input: AxisInput,
}

impl Follower {
    #[must_use]
    pub fn new(config: FollowerConfig) -> Self {
        let input = AxisInput {
            target_position: 0.0,
            enabled: false,
            stands: false,
            blocked: true,
        };
        Self {
            config,
            source: Source::Free,
            publisher: Publisher::default(),
            commanded: 0,
            cycle: 0,
            held: false,
            input,
        }
    }

    /// Returns the settings of a joint's follower.
    #[must_use]
    pub fn config(joint: &Joint, options: &crate::options::Options, dt_s: f64) -> FollowerConfig {
        FollowerConfig {
            limits: joint.limits,
            range: joint.range,
            start_tolerance: (options.start_tolerance / joint.scale).abs(),
            smoothing_s: options.smoothing_ms * 1e-3,
            stale_cycles: (options.stale_ms * 1e-3 / dt_s).ceil().max(1.0) as u64,
            dt_s,
        }
    }

    #[must_use]
    pub fn is_free(&self) -> bool {
        matches!(self.source, Source::Free)
    }

    #[must_use]
    pub fn is_held(&self) -> bool {
        self.held
    }

    /// Ends what the joint follows. With `hold`, commands wait for [`Self::release`].
    pub fn stop(&mut self, hold: bool) {
        self.source = Source::Free;
        self.held |= hold;
    }

    /// Lets the joint follow commands again.
    pub fn release(&mut self) {
        self.held = false;
    }

    /// Gives the joint a command.
    ///
    /// # Errors
    /// Says why the joint does not follow it.
    pub fn command(&mut self, wanted: SetPoint, publisher: Publisher) -> Result<(), Refusal> {
        if self.is_free() {
            self.begin(wanted)?;
            self.publisher = publisher;
        } else if publisher != self.publisher {
            return Err(Refusal::OtherPublisher);
        }
        let since = self.cycle.saturating_sub(self.commanded);
        let most = self.config.stale_cycles as f64;
        let near = self.config.near();
        match (&mut self.source, wanted) {
            (Source::Trajectory { .. }, _) => return Err(Refusal::Trajectory),
            (Source::Position { leader, .. }, SetPoint::Position(position)) => {
                leader.command(position, since, most, near);
            }
            (Source::Constant(now), SetPoint::Velocity(_) | SetPoint::Torque(_)) => {
                // The mode cannot change while the joint follows.
                *now = wanted;
            }
            _ => return Err(Refusal::Moves),
        }
        self.commanded = self.cycle;
        Ok(())
    }

    fn begin(&mut self, wanted: SetPoint) -> Result<(), Refusal> {
        let AxisInput {
            target_position,
            enabled,
            stands,
            blocked,
        } = self.input;
        if !enabled {
            return Err(Refusal::Disabled);
        }
        if self.held {
            return Err(Refusal::Held);
        }
        if !stands || blocked {
            return Err(Refusal::Moves);
        }
        self.source = match wanted {
            SetPoint::Position(position) => {
                let distance = position - target_position;
                if distance.abs() > self.config.start_tolerance {
                    return Err(Refusal::Far(distance));
                }
                let motion = Motion::at(target_position);
                let gear = GearConfig {
                    ratio: 1.0,
                    engage: GearInMode::At { offset: 0.0 },
                    smoothing_s: self.config.smoothing_s,
                    limits: self.config.limits,
                    range: self.config.range,
                };
                // The limits were checked by the server, the position came from it.
                let gear = Gear::new(gear, motion, motion).map_err(|_| Refusal::Disabled)?;
                // A slow publisher until the periods are known.
                let period = 0.5 * self.config.stale_cycles as f64;
                let leader = Leader {
                    motion,
                    command: target_position,
                    period,
                    left: 0.0,
                    moves: false,
                };
                Source::Position {
                    leader,
                    gear,
                    motion,
                }
            }
            constant => Source::Constant(constant),
        };
        self.commanded = self.cycle;
        Ok(())
    }

    /// Checks whether a trajectory can begin at the set-point `start`.
    ///
    /// # Errors
    /// Says why the joint does not follow it.
    pub fn check_play(&self, start: f64) -> Result<(), Refusal> {
        match &self.source {
            Source::Trajectory { .. } => return Err(Refusal::Trajectory),
            Source::Position { motion, .. } if motion.velocity != 0.0 => {
                return Err(Refusal::Moves);
            }
            Source::Constant(_) => return Err(Refusal::Moves),
            Source::Free | Source::Position { .. } => {}
        }
        let AxisInput {
            target_position,
            enabled,
            stands,
            blocked,
        } = self.input;
        if !enabled {
            return Err(Refusal::Disabled);
        }
        if self.held {
            return Err(Refusal::Held);
        }
        if !stands || blocked || target_position != start {
            return Err(Refusal::Moves);
        }
        Ok(())
    }

    /// Begins a checked trajectory at the set-point `start`.
    ///
    /// # Errors
    /// Says why the joint does not follow it.
    pub fn play(&mut self, table: Table, start: f64) -> Result<(), Refusal> {
        self.check_play(start)?;
        let motion = Motion::at(start);
        let playback = Playback::new(&table, motion, self.config.limits, 0.0);
        let playback = playback.map_err(|_| Refusal::Far(table.ends()[0] - start))?;
        self.source = Source::Trajectory {
            table,
            playback,
            motion,
        };
        Ok(())
    }

    /// True while a trajectory is under way.
    #[must_use]
    pub fn plays(&self) -> bool {
        matches!(self.source, Source::Trajectory { .. })
    }

    /// Advances by `cycles`. Returns the set-point for the next cycle, and why the joint follows no
    /// longer.
    pub fn advance(&mut self, input: AxisInput, cycles: u64) -> (Option<SetPoint>, Option<End>) {
        self.input = input;
        self.cycle += cycles;
        let dt_s = self.config.dt_s;
        let silent = self.cycle - self.commanded > self.config.stale_cycles;
        let steps = cycles.min(MAX_CYCLES);
        let end = match &mut self.source {
            Source::Free => return (None, None),
            _ if !input.enabled => Some(End::Disabled),
            _ if input.blocked => Some(End::Blocked),
            Source::Position {
                leader,
                gear,
                motion,
            } => {
                if silent {
                    let near = self.config.near();
                    let left = (leader.command - motion.position).abs();
                    let stands = left <= near && (motion.velocity * dt_s).abs() <= near;
                    Some(if stands && !leader.moves {
                        End::Silent
                    } else {
                        End::Stale
                    })
                } else {
                    for _ in 0..steps {
                        leader.advance(dt_s);
                        let master = Master {
                            motion: leader.motion,
                            comes_to_rest: false,
                        };
                        *motion = gear.with_master(master).advance(*motion, Rate::WHOLE, dt_s);
                    }
                    return (Some(SetPoint::Position(motion.position)), None);
                }
            }
            Source::Constant(wanted) => match (silent, *wanted) {
                (false, wanted) => return (Some(wanted), None),
                (true, SetPoint::Velocity(0.0) | SetPoint::Torque(0.0)) => Some(End::Silent),
                (true, _) => Some(End::Stale),
            },
            Source::Trajectory {
                table,
                playback,
                motion,
            } => {
                if playback.finished(*motion) {
                    Some(End::Done)
                } else {
                    for _ in 0..steps {
                        *motion = playback
                            .with_table(table)
                            .advance(*motion, Rate::WHOLE, dt_s);
                    }
                    return (Some(SetPoint::Position(motion.position)), None);
                }
            }
        };
        self.source = Source::Free;
        (None, end)
    }
}

#[cfg(test)]
#[path = "follower_tests.rs"]
mod tests;
