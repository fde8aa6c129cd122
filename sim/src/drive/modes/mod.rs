//! The modes of operation, from set-points to the demand on the control loops for one control
//! cycle. Units are counts and seconds; positions are unwrapped encoder counts.
//!
//! * here: the input of a mode, the cyclic modes, the Statusword's bits
//! * `position`, `velocity`: profile position and profile velocity
//! * `homing`: all homing methods
//! * `stop`: deceleration to standstill for halts and the power state machine's stops

mod homing;
mod position;
mod stop;
mod velocity;

use super::control::{Demand, Feed};
use super::io::Inputs;
use super::objects::{HomingParameters, Parameters, float};
use super::profile::{Interpolator, Profile};
use crate::quirks::Quirks;
use homing::Homing;
pub(super) use homing::METHODS;
use position::PointToPoint;
use velocity::VelocityWindow;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Mode {
    ProfilePosition,
    ProfileVelocity,
    Homing,
    CyclicPosition,
    CyclicVelocity,
    CyclicTorque,
}

impl Mode {
    pub(super) fn from_code(code: i64) -> Option<Self> {
        Some(match code {
            1 => Self::ProfilePosition,
            3 => Self::ProfileVelocity,
            6 => Self::Homing,
            8 => Self::CyclicPosition,
            9 => Self::CyclicVelocity,
            10 => Self::CyclicTorque,
            _ => return None,
        })
    }

    pub(super) fn code(self) -> i64 {
        match self {
            Self::ProfilePosition => 1,
            Self::ProfileVelocity => 3,
            Self::Homing => 6,
            Self::CyclicPosition => 8,
            Self::CyclicVelocity => 9,
            Self::CyclicTorque => 10,
        }
    }

    pub(super) fn is_cyclic(self) -> bool {
        matches!(
            self,
            Self::CyclicPosition | Self::CyclicVelocity | Self::CyclicTorque
        )
    }
}

/// Process data at the last SYNC, in the objects' own units.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct SetPoints {
    pub controlword: u16,
    pub position: i64,
    pub velocity: i64,
    pub torque: i64,
    pub position_offset: i64,
    pub velocity_offset: i64,
    pub torque_offset: i64,
}

impl SetPoints {
    /// True with bit 4: new set-point, or homing operation start.
    pub(super) fn starts(&self) -> bool {
        self.controlword & 1 << 4 != 0
    }

    /// True with bit 5: change set immediately.
    fn change_at_once(&self) -> bool {
        self.controlword & 1 << 5 != 0
    }

    /// True with bit 6: relative target.
    fn relative(&self) -> bool {
        self.controlword & 1 << 6 != 0
    }

    /// True with bit 9: pass one target at speed and go on to the next.
    fn change_on_set_point(&self) -> bool {
        self.controlword & 1 << 9 != 0
    }

    /// True with bit 8: halt.
    pub(super) fn halt(&self) -> bool {
        self.controlword & 1 << 8 != 0
    }
}

/// The mapping of encoder counts to 0x6064.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct PositionFrame {
    pub min: i64,
    pub width: i64,
    /// The shift that homing added.
    pub shift: i64,
    /// 0x607E: positions and velocities on the bus have the opposite sign.
    pub polarity: Polarity,
}

/// 0x607E, bits 7 and 6, and the bit for torques that some drives have.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Polarity {
    pub position: bool,
    pub velocity: bool,
    /// The bit of [`Quirks::torque_polarity_bit`].
    pub torque: bool,
}

impl Polarity {
    pub(super) fn of(object: i64, quirks: &Quirks) -> Self {
        let torque = quirks.torque_polarity_bit;
        Self {
            position: object & 1 << 7 != 0,
            velocity: object & 1 << 6 != 0,
            torque: torque.is_some_and(|bit| object & 1 << bit != 0),
        }
    }

    /// Converts a torque between bus and drive, in either direction.
    pub(super) fn torque(self, value: i64) -> i64 {
        if self.torque { -value } else { value }
    }

    /// Converts a velocity between bus and drive, in either direction.
    pub(super) fn velocity(self, value: i64) -> i64 {
        if self.velocity { -value } else { value }
    }

    pub(super) fn way(self, value: i64) -> i64 {
        if self.position { -value } else { value }
    }
}

impl PositionFrame {
    /// Converts a position between bus and drive, in either direction.
    pub(super) fn turned(&self, shown: i64) -> i64 {
        if !self.polarity.position {
            return shown;
        }
        if self.width == 1 << 32 {
            return -shown << 32 >> 32;
        }
        self.min + (-shown - self.min).rem_euclid(self.width)
    }

    pub(super) fn show(&self, counts: i64) -> i64 {
        self.wrap(counts + self.shift)
    }

    fn wrap(&self, position: i64) -> i64 {
        if self.width == 1 << 32 {
            // The usual case, without a division.
            return position << 32 >> 32;
        }
        self.min + (position - self.min).rem_euclid(self.width)
    }

    /// Returns the shortest distance from one shown position to another.
    fn way(&self, from: i64, to: i64) -> i64 {
        if self.width == 1 << 32 {
            return (to - from) << 32 >> 32;
        }
        let half = self.width / 2;
        (to - from + half).rem_euclid(self.width) - half
    }
}

/// Statusword bits 8–15 that depend on the mode.
pub(super) mod bit {
    pub const TARGET_REACHED: u16 = 1 << 10;
    pub const INTERNAL_LIMIT: u16 = 1 << 11;
    /// Drive follows the command value, set-point acknowledged, speed is zero, homing attained.
    pub const MODE_12: u16 = 1 << 12;
    /// Following error, homing error, slippage.
    pub const MODE_13: u16 = 1 << 13;
    pub const REFERENCED: u16 = 1 << 15;
}

#[derive(Debug, Clone)]
pub(super) struct Motion {
    /// CSP: the last received target, and the same target in unwrapped counts.
    received: i64,
    target: i64,
    position: Interpolator,
    velocity: Interpolator,
    /// The moving point of PP, PV, CSP under 0x6080, and of every stop.
    profile: Profile,
    point_to_point: PointToPoint,
    speed: VelocityWindow,
    /// A stop at the current limit has ended, and the axis holds its position.
    held: bool,
    halted: bool,
    reached: bool,
    homing: Homing,
    referenced: bool,
    /// A position or speed limit reduced a set-point.
    cut: bool,
    /// The target position is outside the software limits.
    ignored: bool,
    torque: f64,
}

/// The input of a mode for one control cycle.
#[derive(Debug, Clone, Copy)]
pub(super) struct Cycle<'a> {
    pub parameters: &'a Parameters,
    pub homing: &'a HomingParameters,
    pub inputs: &'a Inputs,
    pub set_points: &'a SetPoints,
    /// Controlword bit 4 rose.
    pub start: bool,
    /// Controlword bit 8, if the mode obeys it.
    pub halted: bool,
    pub counts: i64,
    /// The estimated velocity, in counts/s.
    pub velocity: f64,
    pub stands: bool,
    /// The mean current, in A.
    pub current: f64,
}

impl Motion {
    pub(super) fn new(counts: i64) -> Self {
        Self {
            received: counts,
            target: counts,
            position: Interpolator::at(float(counts)),
            velocity: Interpolator::default(),
            profile: Profile::at(float(counts), 0.0),
            point_to_point: PointToPoint::at(counts),
            speed: VelocityWindow::default(),
            held: false,
            halted: false,
            reached: true,
            homing: Homing::default(),
            referenced: false,
            cut: false,
            ignored: false,
            torque: 0.0,
        }
    }

    /// Drops every set-point and continues from the actual position and velocity.
    pub(super) fn restart(&mut self, counts: i64, velocity: f64, frame: &PositionFrame) {
        *self = Self {
            received: frame.show(counts),
            velocity: Interpolator::at(velocity),
            // One cycle back, so that the first step of a ramp ends at the present position.
            profile: Profile::at(float(counts) - velocity * super::CONTROL_STEP, velocity),
            homing: self.homing.interrupted(),
            referenced: self.referenced,
            ..Self::new(counts)
        };
    }

    /// Shifts the frame of the received targets.
    pub(super) fn shift(&mut self, counts: i64, frame: &PositionFrame) {
        self.received = frame.wrap(self.received + counts);
    }

    /// Takes the set-points of a SYNC while the operation is enabled.
    pub(super) fn take(
        &mut self,
        mode: Mode,
        set_points: &SetPoints,
        p: &Parameters,
        frame: &PositionFrame,
    ) {
        match mode {
            Mode::CyclicPosition => {
                let received = set_points.position + set_points.position_offset;
                self.target += frame.way(self.received, received);
                self.received = received;
                let within = match p.software_limits {
                    Some((min, max)) => self.target.clamp(min - frame.shift, max - frame.shift),
                    None => self.target,
                };
                self.cut = within != self.target;
                self.ignored = self.cut;
                self.position.take(float(within), p.period_ns);
            }
            Mode::CyclicVelocity => {
                let wanted =
                    float(set_points.velocity + set_points.velocity_offset) * p.velocity_unit;
                let within = wanted.clamp(-p.max_speed, p.max_speed);
                self.cut = within != wanted;
                self.ignored = false;
                self.velocity.take(within, p.period_ns);
            }
            Mode::CyclicTorque => {
                (self.cut, self.ignored) = (false, false);
                self.torque = float(set_points.torque + set_points.torque_offset) * p.torque_unit;
            }
            Mode::ProfilePosition | Mode::ProfileVelocity | Mode::Homing => {}
        }
    }

    /// Runs one control cycle with the operation enabled. Homing may shift the frame.
    pub(super) fn demand(
        &mut self,
        mode: Mode,
        cycle: &Cycle,
        frame: &mut PositionFrame,
    ) -> Demand {
        let p = cycle.parameters;
        let torque = float(cycle.set_points.torque_offset) * p.torque_unit;
        match mode {
            Mode::ProfilePosition => self.take_set_point(cycle, frame),
            Mode::Homing if cycle.start => self.begin_homing(cycle, frame),
            _ => {}
        }
        self.halted = cycle.halted;
        if cycle.halted {
            let ramp = p.options.halt_ramp();
            let (demand, stands) = self.stop(ramp, Some(mode), cycle);
            self.reached = stands;
            // Motion continues from here when the halt ends.
            self.position = Interpolator::at(self.profile.position);
            self.velocity = Interpolator::at(self.profile.velocity);
            return demand;
        }
        self.held = false;
        match mode {
            Mode::CyclicPosition => {
                let (position, slope) = self.position.advance();
                let reach = p.max_speed * super::CONTROL_STEP;
                let before = self.profile.position;
                let within = position.clamp(before - reach, before + reach);
                let velocity = slope.clamp(-p.max_speed, p.max_speed);
                if within != position {
                    self.cut = true;
                }
                self.profile = Profile::at(within, velocity);
                Demand::Position {
                    position: within,
                    feed: Feed {
                        velocity: float(cycle.set_points.velocity_offset) * p.velocity_unit,
                        acceleration: 0.0,
                    },
                    torque,
                }
            }
            Mode::CyclicVelocity => {
                let (velocity, _) = self.velocity.advance();
                self.profile = Profile::at(float(cycle.counts), velocity);
                Demand::Velocity {
                    velocity,
                    feed: Feed::default(),
                    torque,
                }
            }
            Mode::CyclicTorque => {
                self.profile = Profile::at(float(cycle.counts), cycle.velocity);
                Demand::Torque(self.torque)
            }
            Mode::ProfilePosition => {
                self.profile_position(cycle);
                self.profile_demand(torque)
            }
            Mode::ProfileVelocity => self.profile_velocity(cycle, torque),
            Mode::Homing => {
                self.home(cycle, frame);
                self.profile_demand(torque)
            }
        }
    }

    /// Holds the present point.
    pub(super) fn hold(&mut self) -> Demand {
        self.profile = Profile::at(self.profile.position, 0.0);
        self.profile_demand(0.0)
    }

    fn profile_demand(&self, torque: f64) -> Demand {
        Demand::Position {
            position: self.profile.position,
            feed: self.profile.feed(),
            torque,
        }
    }

    /// Ends homing with an error.
    pub(super) fn fail_homing(&mut self) {
        self.homing.fail();
    }

    /// Resets the homing status.
    pub(super) fn forget_homing(&mut self) {
        self.homing = Homing::default();
    }

    /// Returns demand minus position in counts; zero without a position demand.
    pub(super) fn following_error(&self, demand: &Demand, counts: i64) -> f64 {
        match demand {
            Demand::Position { position, .. } => position - float(counts),
            _ => 0.0,
        }
    }

    /// Returns the demanded position and speed, for 0x6062 and 0x606B.
    pub(super) fn demanded(&self) -> (f64, f64) {
        (self.profile.position, self.profile.velocity)
    }

    /// Returns the mode's Statusword bits. `follows`: enabled and not stopping.
    pub(super) fn status(&self, mode: Mode, follows: bool, velocity: f64, p: &Parameters) -> u16 {
        let mut bits = 0;
        let mut set = |on: bool, bit: u16| bits |= if on { bit } else { 0 };
        set(follows && self.cut, bit::INTERNAL_LIMIT);
        set(self.referenced, bit::REFERENCED);
        match mode {
            Mode::CyclicPosition | Mode::CyclicVelocity | Mode::CyclicTorque => {
                // Bit 12 stays set for a target limited in speed, not for one outside the software
                // limits.
                set(follows && !self.ignored && !self.halted, bit::MODE_12);
            }
            Mode::ProfilePosition => {
                set(self.point_to_point.acknowledged() && follows, bit::MODE_12);
                set(self.reached, bit::TARGET_REACHED);
            }
            Mode::ProfileVelocity => {
                set(self.speed.is_zero(velocity, p), bit::MODE_12);
                set(follows && self.speed.slips(), bit::MODE_13);
                set(self.reached, bit::TARGET_REACHED);
            }
            Mode::Homing => {
                bits |= self.homing.bits(self.profile.velocity == 0.0, self.halted);
            }
        }
        bits
    }
}
