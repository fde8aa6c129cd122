//! The status of an axis, its trips, and the reasons for a rejected command.
//!
//! ```
//! use ecaxis_axis::status::DriveFault;
//!
//! let fault = DriveFault { statusword: 0x0008, code: Some(0x8611) };
//! assert!(fault.to_string().starts_with("drive fault 0x8611: "));
//! ```

use core::fmt;

use crate::cia402::{Mode, State, Statusword, describe};
use crate::homing::HomingError;
use crate::setpoint::SetpointError;
use crate::supervision::StopMethod;
use crate::touch_probe::ProbeStatus;

/// The status of one axis in one cycle, in user units. `Copy`, so that a snapshot can contain it.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct AxisStatus {
    /// The active mode; its targets apply.
    pub mode: Mode,
    /// The mode of a pending switch: 0x6061 does not show it yet, or power has not returned yet
    /// ([`crate::AxisConfig::mode_change_unpowered`]).
    pub switching: Option<Mode>,
    /// The last commanded mode, if 0x6061 did not show it in time. The axis has stayed in `mode`.
    pub switch_failed: Option<Mode>,
    /// The power state in the last fresh Statusword.
    pub state: State,
    /// Time since the drive entered this state, seconds.
    pub time_in_state_s: f64,
    /// The last fresh Statusword.
    pub statusword: u16,
    /// The Controlword of the last outputs.
    pub controlword: u16,
    /// True in Operation enabled by our command. The limits are supervised.
    pub powered: bool,
    /// True while the drive follows set-points: powered, the mode shown, Statusword bit 12 set.
    /// Before that, targets follow actual values.
    pub enabled: bool,
    /// True while motion commands are accepted: `enabled`, not stopping and not being disabled,
    /// brake open.
    pub ready: bool,
    /// True if 0x6061 shows `mode` or `switching`, or is not mapped.
    pub mode_confirmed: bool,
    /// True while the set-point changes, or waits because of lost frames.
    pub moving: bool,
    /// True if set-point and axis have reached the target. Position: within the target window.
    /// Velocity: within the velocity window.
    pub in_target: bool,
    /// True while commanded and reported velocity are near zero.
    pub at_rest: bool,
    /// Reported position. 0 until the first report.
    pub position: f64,
    /// Reported velocity; without a mapped velocity the filtered difference of positions.
    pub velocity: f64,
    /// Reported torque in percent of rated torque.
    pub torque: f64,
    /// The target of the last position move, until another command, a stop or a loss of power
    /// replaces it. A move is done only where this is still its target.
    pub commanded_target: Option<f64>,
    /// Commanded position of this cycle.
    pub target_position: f64,
    /// Commanded velocity of this cycle.
    pub target_velocity: f64,
    /// Commanded acceleration of this cycle.
    pub target_acceleration: f64,
    /// Commanded torque of this cycle, percent of rated torque.
    pub target_torque: f64,
    /// Commanded minus reported position. The commanded position is the one of a dead time ago, at
    /// least one cycle.
    pub following_error: f64,
    /// Largest absolute following error since enabling.
    pub max_following_error: f64,
    /// Target minus reported position, once the set-point of a position move has arrived.
    pub final_error_counts: Option<i64>,
    /// Position minus that of the second encoder; `None` while they are not compared.
    pub encoder_difference: Option<f64>,
    /// True during a move, which ends after it has taken up the backlash.
    pub takes_up: bool,
    /// True while a commanded velocity is reduced so that the axis can stop inside its range.
    pub held_by_range: bool,
    /// Cycles in which the final limiter changed a set-point. A value above 0 indicates a planning
    /// error in this crate.
    pub guarded_cycles: u32,
    /// Cycles since the last fresh inputs.
    pub stale_cycles: u32,
    /// The condition that blocks enabling.
    pub waiting: Option<EnableBlocker>,
    /// The touch probes.
    pub probes: [ProbeStatus; 2],
    /// Automatic fault resets since the last [`crate::Command::ResetFault`], or since the axis was
    /// last enabled for a minute.
    pub resets_tried: u8,
    /// The state of the last homing.
    pub homing: HomingStatus,
    /// What the reported position refers to.
    pub validity: PositionValidity,
    /// The first fault of the drive since the last reset.
    pub fault: Option<DriveFault>,
    /// The first trip since the last reset.
    pub trip: Option<Trip>,
    /// The cause of the present stop, or of the last loss of power, since the axis was enabled.
    pub power_loss_cause: Option<PowerLossCause>,
    /// The active stop that ends without power or in Quick stop active.
    pub stop: Option<StopStatus>,
    /// Statusword bit 11: the drive limits the commanded value.
    pub internal_limit: bool,
    /// True while fault reset pulses are sent.
    pub resetting: bool,
    /// True if the fault remained after the last reset.
    pub reset_failed: bool,
}

impl AxisStatus {
    /// Returns the Statusword, including bits such as remote and voltage enabled.
    #[must_use]
    pub const fn word(&self) -> Statusword {
        Statusword::from_bits_retain(self.statusword)
    }

    /// Returns true if home is known: by an absolute encoder, or found and not lost since.
    #[must_use]
    pub const fn homed(&self) -> bool {
        self.validity.is_homed()
    }
}

/// What reported positions refer to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum PositionValidity {
    /// The axis has no homing: positions count from where the drive has set its origin.
    #[default]
    Unreferenced,
    /// The axis has a homing that has not succeeded yet, or home was lost.
    Unknown,
    /// Homing runs: the origin may shift at any moment.
    Homing,
    /// Home was found.
    Homed,
    /// An absolute encoder keeps home.
    Absolute,
}

impl fmt::Display for PositionValidity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Unreferenced => "unreferenced",
            Self::Unknown => "unknown",
            Self::Homing => "homing",
            Self::Homed => "homed",
            Self::Absolute => "absolute",
        })
    }
}

impl PositionValidity {
    /// Returns true if home is known.
    #[must_use]
    pub const fn is_homed(self) -> bool {
        matches!(self, Self::Homed | Self::Absolute)
    }

    /// Returns true if an action may depend on the position: it refers to home, or the axis has no
    /// other reference than the drive's origin.
    #[must_use]
    pub const fn is_defined(self) -> bool {
        !matches!(self, Self::Unknown | Self::Homing)
    }
}

/// The reason why an axis loses its power, or has lost it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum PowerLossCause {
    /// [`crate::Command::Disable`], [`crate::Command::QuickStop`] or
    /// [`crate::Command::DisableVoltage`].
    Command,
    /// The axis has tripped ([`AxisStatus::trip`]).
    Trip,
    /// The drive has a fault ([`AxisStatus::fault`]).
    Fault,
    /// A stop of the machine, of a group or of a gantry ([`crate::Axis::stop_by`]).
    Outside,
    /// The drive had power without a command.
    Unrequested,
    /// A stop or a hold has ended the torque, and the axis did not come to rest.
    Coasting,
}

impl fmt::Display for PowerLossCause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Command => "a command",
            Self::Trip => "the trip of the axis",
            Self::Fault => "the fault of the drive",
            Self::Outside => "a stop of the machine, the group or the gantry",
            Self::Unrequested => "the drive had power without a command",
            Self::Coasting => "the axis did not come to rest without torque",
        })
    }
}

/// An active stop.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct StopStatus {
    /// The present method of the stop.
    pub method: StopMethod,
    /// The present phase.
    pub phase: StopPhase,
    /// Time since the method was chosen, or since the removal of power was requested.
    pub elapsed_s: f64,
    /// Time in seconds after which a harder method takes over.
    pub timeout_s: f64,
}

/// The phase of a stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum StopPhase {
    /// The axis slows down.
    Decelerating,
    /// The axis stands; the brake closes.
    Standstill,
    /// Removal of power was requested; the drive has not confirmed it.
    RemovingPower,
    /// The drive still reports power long after the request to remove it.
    PowerKept,
    /// No answer from the drive has arrived for as long after the request.
    Silent,
}

/// The reason why an axis is not ready although it is to be enabled.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum EnableBlocker {
    /// No position is reported.
    #[error("no position is reported (0x6064)")]
    Position,
    /// Statusword bit 9 (remote) is not set.
    #[error("the drive is not controlled from here: Statusword bit 9 (remote) is not set")]
    Remote,
    /// Statusword bit 4 (voltage enabled) is not set.
    #[error("the power stage has no voltage: Statusword bit 4 is not set")]
    Voltage,
    /// 0x6061 shows another mode.
    #[error("0x6061 shows mode {display} instead of {expected}")]
    Mode {
        /// The requested mode.
        expected: Mode,
        /// The mode in 0x6061.
        display: Mode,
    },
    /// Statusword bit 12 (drive follows command value) is not set.
    #[error("the drive does not follow the command value: Statusword bit 12 is not set in {mode}")]
    Follows {
        /// The mode of the axis.
        mode: Mode,
    },
    /// The brake is opening.
    #[error("the brake is opening")]
    Brake,
    /// A gantry is squared once a hold ends.
    #[error("the axis is held, so its gantry is not squared yet")]
    Held,
    /// The drive gives no reason.
    #[error("the drive stays in {state}")]
    Drive {
        /// The state of the drive.
        state: State,
    },
}

/// The state of the last homing.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum HomingStatus {
    /// No homing has started.
    #[default]
    None,
    /// Homing runs.
    Running,
    /// Home was found.
    Attained,
    /// Home was not found.
    Failed(HomingError),
}

impl HomingStatus {
    /// True if home was not found.
    #[must_use]
    pub const fn is_failed(&self) -> bool {
        matches!(self, Self::Failed(_))
    }
}

/// A fault reported by the drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DriveFault {
    /// The last fresh Statusword.
    pub statusword: u16,
    /// The code from 0x603F or from an emergency message, if known
    /// ([`crate::Axis::note_error_code`]).
    pub code: Option<u16>,
}

impl fmt::Display for DriveFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.code {
            Some(code) => write!(f, "drive fault {code:#06x}: {}", describe(code).text),
            None => write!(f, "drive fault (Statusword {:#06x})", self.statusword),
        }
    }
}

/// The reason why an axis stopped itself. Values in user units.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum Trip {
    /// The following error exceeds its limit.
    #[error("following error {error:.4} exceeds {limit:.4}")]
    FollowingError {
        /// The following error.
        error: f64,
        /// The limit.
        limit: f64,
    },
    /// The axis is outside its position range.
    #[error("position {position:.4} is outside [{low:.4}, {high:.4}]")]
    PositionLimit {
        /// The position.
        position: f64,
        /// The lower end of the range.
        low: f64,
        /// The upper end of the range.
        high: f64,
    },
    /// The reported velocity exceeds 1.2 times the limit.
    #[error("velocity {velocity:.4} exceeds 1.2 × the limit of {limit:.4}")]
    OverVelocity {
        /// The velocity.
        velocity: f64,
        /// The limit.
        limit: f64,
    },
    /// The drive left Operation enabled without a command.
    #[error("the drive left Operation enabled for {state} without a command")]
    PowerLost {
        /// The state of the drive.
        state: State,
    },
    /// The torque exceeded its limit for too long.
    #[error("torque {torque:.1} % has been above {limit:.1} % for {time_s} s")]
    OverTorque {
        /// The torque in percent.
        torque: f64,
        /// The limit.
        limit: f64,
        /// The time in seconds.
        time_s: f64,
    },
    /// The reported acceleration exceeds its limit.
    #[error("acceleration {acceleration:.4} exceeds {limit:.4}")]
    OverAcceleration {
        /// The acceleration.
        acceleration: f64,
        /// The limit.
        limit: f64,
    },
    /// The second encoder shows another position.
    #[error(
        "the position is {difference:.4} off that of the second encoder: the limit is {limit:.4}"
    )]
    EncoderDifference {
        /// Position of the axis minus that of the second encoder.
        difference: f64,
        /// The limit.
        limit: f64,
    },
    /// The halves of a gantry are too far apart, or would be at rest.
    #[error(
        "the skew of the gantry is {skew:.4} and would be {at_rest:.4} at rest: its limit is {limit:.4}"
    )]
    Skew {
        /// Second minus first half, without the offset at which they were coupled.
        skew: f64,
        /// The same after a stop of the half that moves.
        at_rest: f64,
        /// The limit.
        limit: f64,
    },
    /// The halves of a gantry moved apart during homing.
    #[error(
        "homing has moved the halves of the gantry apart by {skew:.4}: the limit is {limit:.4}"
    )]
    HomingSkew {
        /// Way of the second half minus that of the first, since the start of homing.
        skew: f64,
        /// The limit.
        limit: f64,
    },
    /// A half of a gantry moves alone.
    #[error("this half of the gantry moves at {velocity:.4} while the other half has no power")]
    HalfMoves {
        /// The velocity.
        velocity: f64,
    },
    /// The emergency stop was commanded.
    #[error("emergency stop")]
    EmergencyStop,
    /// PP: the drive did not acknowledge a set-point.
    #[error("the drive did not acknowledge a set-point")]
    SetPointNotTaken,
    /// PP, PV, homing: the drive does not obey the halt.
    #[error(
        "the drive ignores the halt (Controlword bit 8): it moves at {velocity:.4} after {time_s:.2} s"
    )]
    HaltIgnored {
        /// The velocity.
        velocity: f64,
        /// Time since the halt in seconds.
        time_s: f64,
    },
    /// The Statusword is none of those that CiA 402 lists for a drive with power.
    #[error("the Statusword {word:#06x} is none of a drive with power")]
    UnlistedStatusword {
        /// The Statusword.
        word: u16,
    },
    /// The reported position moved further than the axis can.
    #[error(
        "the reported position (0x6064) has jumped by {step:.4}: the velocity limit allows {most:.4}"
    )]
    PositionJump {
        /// The change of position.
        step: f64,
        /// The largest plausible change.
        most: f64,
    },
    /// The reported velocity contradicts the reported positions.
    #[error(
        "the drive reports a velocity (0x606C) of {reported:.4}, its positions (0x6064) change by {derived:.4} per second"
    )]
    VelocityContradiction {
        /// The reported velocity.
        reported: f64,
        /// The velocity of the reported positions.
        derived: f64,
    },
    /// Statusword bit 12 was cleared during motion.
    #[error(
        "the drive no longer follows the command value: Statusword bit 12 is not set in {mode}"
    )]
    NotFollowing {
        /// The mode of the axis.
        mode: Mode,
    },
    /// A stop did not bring the axis to rest in time.
    #[error(
        "the axis was not brought to rest by {method} within {time_s:.2} s: it moves at {velocity:.4}"
    )]
    NotStopped {
        /// The velocity.
        velocity: f64,
        /// The time in seconds.
        time_s: f64,
        /// The present method of the stop.
        method: StopMethod,
    },
    /// 0x6061 does not show the mode in Operation enabled
    /// ([`crate::AxisConfig::mode_display_enabled`]).
    #[error("0x6061 shows mode {display} instead of {expected} {time_s} s after Operation enabled")]
    ModeNotShown {
        /// The requested mode.
        expected: Mode,
        /// The mode in 0x6061.
        display: Mode,
        /// The time in seconds.
        time_s: f64,
    },
    /// 0x6061 changed without a command.
    #[error("the drive changed its mode of operation from {expected} to {display}")]
    ModeLost {
        /// The requested mode.
        expected: Mode,
        /// The mode in 0x6061.
        display: Mode,
    },
}

/// The reason why a command was rejected. A rejected command changes nothing. Values in user units.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum CommandError {
    /// The bus is not in Op.
    #[error("the bus is not in Op yet")]
    NotInOp,
    /// The axis is the second half of a coupled gantry.
    #[error("the axis is the second half of a gantry: command the first half")]
    SecondHalf,
    /// The axis is the first half of a gantry that is not coupled yet.
    #[error("the gantry is not coupled: both halves must be enabled, at rest and square")]
    NotCoupled,
    /// A coupled gantry does not support the command.
    #[error("the axis is part of a coupled gantry, which stays in CSP; decouple it first")]
    Coupled,
    /// The axis is held, and the command cannot wait.
    #[error("the axis is held: let its motions continue first")]
    Held,
    /// The axis follows no other axis.
    #[error("the axis follows no other axis")]
    NotFollowing,
    /// The axis follows a gear, stream or other source.
    #[error("the axis follows something else; stop it first")]
    Following,
    /// A touch probe waits for the edge that stops the axis.
    #[error("a touch probe is to stop the axis; wait for its edge")]
    Probing,
    /// A parameter is not finite.
    #[error("{what} is {value}: not a finite number")]
    NotFinite {
        /// The parameter's name.
        what: &'static str,
        /// The rejected value.
        value: f64,
    },
    /// A parameter is not in (0, 1].
    #[error("{what} is {value}: it must be above 0 and at most 1")]
    NotAFraction {
        /// The parameter's name.
        what: &'static str,
        /// The rejected value.
        value: f64,
    },
    /// A parameter is negative.
    #[error("{what} is {value}: it must not be negative")]
    Negative {
        /// The parameter's name.
        what: &'static str,
        /// The rejected value.
        value: f64,
    },
    /// The target is outside the position range.
    #[error("position {position} is outside the range [{low}, {high}]")]
    OutsideRange {
        /// The position.
        position: f64,
        /// The lower end of the range.
        low: f64,
        /// The upper end of the range.
        high: f64,
    },
    /// The target is outside the positions at which both halves of a gantry are in their ranges.
    #[error(
        "position {position} is outside [{low}, {high}], where both halves of the gantry are in their ranges"
    )]
    OutsideSharedRange {
        /// The position.
        position: f64,
        /// The lower end of the positions.
        low: f64,
        /// The upper end of the positions.
        high: f64,
    },
    /// The velocity exceeds the limit.
    #[error("velocity {velocity} exceeds the limit of {limit}")]
    TooFast {
        /// The velocity.
        velocity: f64,
        /// The limit.
        limit: f64,
    },
    /// The drive moves with its own speed and ramp.
    #[error(
        "the drive moves with its own speed and ramp: their objects are not in the process data"
    )]
    ProfileFixed,
    /// The torque exceeds the limit.
    #[error("torque {percent} % exceeds the limit of {limit} %")]
    TooMuchTorque {
        /// The torque in percent.
        percent: f64,
        /// The limit.
        limit: f64,
    },
    /// The command needs another mode.
    #[error("{command} needs mode {needs}, the axis is in {mode}")]
    WrongMode {
        /// The command.
        command: &'static str,
        /// The necessary mode.
        needs: Mode,
        /// The mode of the axis.
        mode: Mode,
    },
    /// The mode is not among [`crate::AxisConfig::modes`].
    #[error("mode {mode} is not among those that were made ready for this axis")]
    ModeNotOffered {
        /// The mode of the axis.
        mode: Mode,
    },
    /// 0x6061 is not mapped, so a switch cannot be confirmed.
    #[error("the drive's mode is not visible: 0x6061 is not mapped")]
    NoModeDisplay,
    /// The mode needs 0x6064, which is not mapped.
    #[error("mode {mode} needs a reported position: 0x6064 is not mapped")]
    NoPosition {
        /// The mode of the axis.
        mode: Mode,
    },
    /// A mode switch is pending.
    #[error("the axis is just being switched to mode {to}")]
    Switching {
        /// The mode of the pending switch.
        to: Mode,
    },
    /// The motion cannot be planned.
    #[error(transparent)]
    Plan(#[from] SetpointError),
    /// The brake is still opening.
    #[error("the brake is still opening")]
    BrakeOpening,
    /// 0x60B9 is not mapped.
    #[error("no touch probe is mapped (0x60B9)")]
    NoProbe,
    /// The axis is homing.
    #[error("the axis is homing")]
    Homing,
    /// After an external position the axis could no longer stop within the range.
    #[error(
        "at {position} with velocity {velocity}, the axis cannot stop within the range [{low}, {high}]"
    )]
    NoRoomToStop {
        /// The velocity to the position.
        velocity: f64,
        /// The position.
        position: f64,
        /// The lower end of the range.
        low: f64,
        /// The upper end of the range.
        high: f64,
    },
    /// An external position is too far from the previous one.
    #[error("a step of {step} in one cycle is more than the {most} of the velocity limit")]
    Step {
        /// The distance.
        step: f64,
        /// The largest accepted value.
        most: f64,
    },
    /// An external velocity differs too much from the previous one.
    #[error(
        "velocity changes by {change} in one cycle, more than the {most} of the acceleration limit"
    )]
    Jump {
        /// The change of velocity.
        change: f64,
        /// The largest accepted value.
        most: f64,
    },
    /// Frames are being lost.
    #[error("frames are being lost; the set-point waits")]
    FramesLost,
    /// The axis is not enabled.
    #[error("the axis is not enabled (drive: {state})")]
    NotEnabled {
        /// The state of the drive.
        state: State,
    },
    /// 0x6061 does not show the mode yet.
    #[error("the drive has not confirmed mode {expected}, it shows {display}")]
    ModeNotConfirmed {
        /// The requested mode.
        expected: Mode,
        /// The mode in 0x6061.
        display: Mode,
    },
    /// The drive is in Fault.
    #[error("{0}; reset it first")]
    Faulted(DriveFault),
    /// The axis has tripped.
    #[error("the axis stopped itself: {0}; reset it first")]
    Tripped(Trip),
    /// The axis is stopping or being disabled.
    #[error("the axis is stopping or being disabled")]
    Stopping,
    /// The reaction group of the axis is stopped.
    #[error("the group of axes that it belongs to is stopped; reset it first")]
    GroupStopped,
    /// The axis has power, and the command needs it without.
    #[error("the axis has power; disable it first")]
    HasPower,
    /// The axis moves.
    #[error("the axis still moves at {velocity}")]
    StillMoving {
        /// The velocity.
        velocity: f64,
    },
}
