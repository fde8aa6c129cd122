//! The status of an axis, its trips, and the reasons for a rejected command.

use core::fmt;

use crate::cia402::{Mode, ModeStatus, State, Statusword, describe};
use crate::homing::HomingError;
use crate::setpoint::SetpointError;
use crate::supervision::StopMethod;
use crate::touch_probe::ProbeStatus;

/// The status of one axis in one cycle, in user units. `Copy`, so that a snapshot can contain it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AxisStatus {
    /// The active mode; its targets apply.
    pub mode: Mode,
    /// The mode of a pending switch: 0x6060 is written, 0x6061 does not show it yet.
    pub switching: Option<Mode>,
    /// The last commanded mode, if 0x6061 did not show it in time. The axis has stayed in `mode`.
    pub switch_failed: Option<Mode>,
    /// The power state in the last fresh Statusword.
    pub state: State,
    pub time_in_state_s: f64,
    pub statusword: u16,
    /// The Controlword of the last outputs.
    pub controlword: u16,
    /// True in Operation enabled with confirmed mode: the axis generates the set-points. Before
    /// that, targets follow actual values.
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
    /// Commanded position of this cycle.
    pub target_position: f64,
    pub target_velocity: f64,
    pub target_acceleration: f64,
    pub target_torque: f64,
    /// Commanded minus reported position. The commanded position is the one of a dead time ago, at
    /// least one cycle.
    pub following_error: f64,
    /// Largest absolute following error since enabling.
    pub max_following_error: f64,
    /// Target minus reported position, once the set-point of a position move has arrived.
    pub final_error_counts: Option<i64>,
    /// True while a commanded velocity is reduced so that the axis can stop inside its range.
    pub held_by_range: bool,
    /// Cycles in which the final limiter changed a set-point. A value above 0 indicates a planning
    /// error in this crate.
    pub guarded_cycles: u32,
    /// Cycles since the last fresh inputs.
    pub stale_cycles: u32,
    /// The condition that blocks enabling.
    pub waiting: Option<EnableBlocker>,
    pub probes: [ProbeStatus; 2],
    /// Automatic fault resets since the last [`crate::Command::ResetFault`], or since the axis was
    /// last enabled for a minute.
    pub resets_tried: u8,
    pub homing: HomingStatus,
    /// True if home was found and no homing has started since.
    pub homed: bool,
    /// The first fault of the drive since the last reset.
    pub fault: Option<DriveFault>,
    /// The first trip since the last reset.
    pub trip: Option<Trip>,
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

    /// Returns the mode-specific bits of the Statusword, decoded for the active mode.
    #[must_use]
    pub const fn mode_status(&self) -> ModeStatus {
        self.word().in_mode(self.mode)
    }
}

/// An active stop.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StopStatus {
    pub method: StopMethod,
    pub phase: StopPhase,
    /// Time since the method was chosen, or since the removal of power was requested.
    pub elapsed_s: f64,
    /// Time in seconds after which a harder method takes over.
    pub timeout_s: f64,
}

/// The phase of a stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum StopPhase {
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
pub enum EnableBlocker {
    #[error("no position is reported (0x6064)")]
    Position,
    #[error("the drive is not controlled from here: Statusword bit 9 (remote) is not set")]
    Remote,
    #[error("the power stage has no voltage: Statusword bit 4 is not set")]
    Voltage,
    #[error("the drive shows mode {display} instead of {expected}")]
    Mode { expected: Mode, display: Mode },
    #[error("the drive does not follow the command value: Statusword bit 12 is not set in {mode}")]
    Follows { mode: Mode },
    #[error("the brake is opening")]
    Brake,
    /// The drive gives no reason.
    #[error("the drive stays in {state}")]
    Drive { state: State },
}

/// The state of the last homing.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum HomingStatus {
    /// No homing has started.
    #[default]
    None,
    Running,
    Attained,
    Failed(HomingError),
}

/// A fault reported by the drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DriveFault {
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
    #[error("following error {error:.4} exceeds {limit:.4}")]
    FollowingError { error: f64, limit: f64 },
    #[error("position {position:.4} is outside [{low:.4}, {high:.4}]")]
    PositionLimit { position: f64, low: f64, high: f64 },
    #[error("velocity {velocity:.4} exceeds 1.2 × the limit of {limit:.4}")]
    OverVelocity { velocity: f64, limit: f64 },
    #[error("the drive left Operation enabled for {state} without a command")]
    PowerLost { state: State },
    #[error("torque {torque:.1} % has been above {limit:.1} % for {time_s} s")]
    OverTorque {
        torque: f64,
        limit: f64,
        time_s: f64,
    },
    #[error("acceleration {acceleration:.4} exceeds {limit:.4}")]
    OverAcceleration { acceleration: f64, limit: f64 },
    #[error("emergency stop")]
    EmergencyStop,
    #[error("the drive did not acknowledge a set-point")]
    SetPointNotTaken,
    #[error(
        "the drive no longer follows the command value: Statusword bit 12 is not set in {mode}"
    )]
    NotFollowing { mode: Mode },
    #[error(
        "the axis was not brought to rest by {method} within {time_s:.2} s: it moves at {velocity:.4}"
    )]
    NotStopped {
        velocity: f64,
        time_s: f64,
        method: StopMethod,
    },
    #[error("the drive changed its mode of operation from {expected} to {display}")]
    ModeLost { expected: Mode, display: Mode },
}

/// The reason why a command was rejected. A rejected command changes nothing. Values in user units.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum CommandError {
    #[error("the bus is not in Op yet")]
    NotInOp,
    #[error("the axis follows something else; stop it first")]
    Following,
    #[error("{what} is {value}: not a finite number")]
    NotFinite { what: &'static str, value: f64 },
    #[error("{what} is {value}: it must be above 0 and at most 1")]
    NotAFraction { what: &'static str, value: f64 },
    #[error("{what} is {value}: it must not be negative")]
    Negative { what: &'static str, value: f64 },
    #[error("position {position} is outside the range [{low}, {high}]")]
    OutsideRange { position: f64, low: f64, high: f64 },
    #[error("velocity {velocity} exceeds the limit of {limit}")]
    TooFast { velocity: f64, limit: f64 },
    #[error("torque {percent} % exceeds the limit of {limit} %")]
    TooMuchTorque { percent: f64, limit: f64 },
    #[error("{command} needs mode {needs}, the axis is in {mode}")]
    WrongMode {
        command: &'static str,
        needs: Mode,
        mode: Mode,
    },
    #[error("mode {mode} is not among those that were made ready for this axis")]
    ModeNotOffered { mode: Mode },
    #[error("the drive's mode is not visible: 0x6061 is not mapped")]
    NoModeDisplay,
    #[error("mode {mode} needs a reported position: 0x6064 is not mapped")]
    NoPosition { mode: Mode },
    #[error("the axis is just being switched to mode {to}")]
    Switching { to: Mode },
    #[error(transparent)]
    Plan(#[from] SetpointError),
    #[error("the brake is still opening")]
    BrakeOpening,
    #[error("no touch probe is mapped (0x60B9)")]
    NoProbe,
    #[error("the axis is homing")]
    Homing,
    #[error("a step of {step} in one cycle is more than the {most} of the velocity limit")]
    Step { step: f64, most: f64 },
    #[error(
        "velocity changes by {change} in one cycle, more than the {most} of the acceleration limit"
    )]
    Jump { change: f64, most: f64 },
    #[error("frames are being lost; the set-point waits")]
    FramesLost,
    #[error("the axis is not enabled (drive: {state})")]
    NotEnabled { state: State },
    #[error("the drive has not confirmed mode {expected}, it shows {display}")]
    ModeNotConfirmed { expected: Mode, display: Mode },
    #[error("{0}; reset it first")]
    Faulted(DriveFault),
    #[error("the axis stopped itself: {0}; reset it first")]
    Tripped(Trip),
    #[error("the axis is stopping or being disabled")]
    Stopping,
    #[error("the group of axes that it belongs to is stopped; reset it first")]
    GroupStopped,
    #[error("the axis still moves at {velocity}")]
    StillMoving { velocity: f64 },
}
