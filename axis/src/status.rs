//! What an axis tells: its status, why it stopped, why it refused.

use core::fmt;

use crate::cia402::{Mode, ModeStatus, State, Statusword, describe};
use crate::homing::HomingError;
use crate::probe::ProbeStatus;
use crate::setpoint::SetpointError;
use crate::supervision::StopMethod;

/// Everything about one axis in one cycle, in user units. `Copy`, so that it can go into a snapshot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AxisStatus {
    /// The mode whose targets count.
    pub mode: Mode,
    /// The mode on its way: 0x6060 is written, 0x6061 does not show it yet.
    pub switching: Option<Mode>,
    /// The last mode that was commanded did not show in time; the axis has stayed in `mode`.
    pub switch_failed: Option<Mode>,
    /// From the last fresh Statusword.
    pub state: State,
    pub time_in_state_s: f64,
    pub statusword: u16,
    /// As put into the last outputs.
    pub controlword: u16,
    /// Operation enabled, mode confirmed, set-points come from here. Before that, targets follow actual values.
    pub enabled: bool,
    /// Motion commands are taken: `enabled`, neither disabling nor stopping for good, and the brake is open.
    pub ready: bool,
    /// 0x6061 shows `mode` or `switching`, or is not mapped.
    pub mode_confirmed: bool,
    /// The set-point is still changing, or waits for lost frames before it goes on.
    pub moving: bool,
    /// The set-point has arrived, and so has the axis (position: within the target window; velocity: within the velocity
    /// window).
    pub in_target: bool,
    /// Commanded and reported velocity are near zero.
    pub at_rest: bool,
    /// Reported position. 0 until one was reported.
    pub position: f64,
    /// Reported velocity, or the filtered difference of positions where velocity is not mapped.
    pub velocity: f64,
    /// Reported torque in percent of rated torque.
    pub torque: f64,
    /// As commanded in this cycle.
    pub target_position: f64,
    pub target_velocity: f64,
    pub target_acceleration: f64,
    pub target_torque: f64,
    /// Commanded (in the cycle before, and by what of the dead time is longer) minus reported position.
    pub following_error: f64,
    /// Largest amount since enabling.
    pub max_following_error: f64,
    /// Target minus reported position once a position move's set-point has arrived.
    pub final_error_counts: Option<i64>,
    /// A commanded velocity is held back so that the axis can stop before the end of its range.
    pub held_by_range: bool,
    /// Cycles in which the last guard had to change a set-point. Stays 0 unless something here is wrong.
    pub guarded_cycles: u32,
    /// Cycles since the last fresh inputs.
    pub stale_cycles: u32,
    /// Why enabling does not go on.
    pub waiting: Option<Waiting>,
    pub probes: [ProbeStatus; 2],
    /// Automatic fault resets since the last one by command.
    pub resets_tried: u8,
    pub homing: HomingStatus,
    /// Home was found, and not searched anew since.
    pub homed: bool,
    /// The drive's first fault since the last reset.
    pub fault: Option<DriveFault>,
    /// Why the axis stopped itself, first cause since the last reset.
    pub trip: Option<Trip>,
    /// A stop that is to end without power, or in Quick stop active.
    pub stop: Option<StopStatus>,
    /// Statusword bit 11: the drive limits what it is commanded.
    pub internal_limit: bool,
    /// Reset pulses are being sent.
    pub resetting: bool,
    /// The last reset did not help.
    pub reset_failed: bool,
}

impl AxisStatus {
    /// The Statusword's bits, remote and voltage enabled among them.
    #[must_use]
    pub const fn word(&self) -> Statusword {
        Statusword::from_bits_retain(self.statusword)
    }

    /// What the Statusword says in the mode that counts.
    #[must_use]
    pub const fn mode_status(&self) -> ModeStatus {
        self.word().in_mode(self.mode)
    }
}

/// A stop under way.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StopStatus {
    pub method: StopMethod,
    pub phase: StopPhase,
    /// Since the method was chosen; from the removal of the power on, since that.
    pub elapsed_s: f64,
    /// When a harder method takes over.
    pub timeout_s: f64,
}

/// How far a stop is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum StopPhase {
    Decelerating,
    /// The axis stands; the brake closes.
    Standstill,
    /// The drive was told to remove the power and has not reported it yet.
    RemovingPower,
    /// The drive still reports power, long after its removal was requested.
    PowerKept,
    /// The drive has not been heard since, for as long.
    Silent,
}

/// Why an axis that is to be enabled is not ready yet.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum Waiting {
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
    /// And says nothing about why.
    #[error("the drive stays in {state}")]
    Drive { state: State },
}

/// The last homing.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum HomingStatus {
    /// There was none.
    #[default]
    None,
    Running,
    Attained,
    Failed(HomingError),
}

/// A fault the drive reported.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DriveFault {
    pub statusword: u16,
    /// 0x603F or an emergency's code, if someone told ([`crate::Axis::note_error_code`]).
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

/// Why an axis stopped itself. Values in user units.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum Trip {
    #[error("following error {error:.4} exceeds {limit:.4}")]
    FollowingError { error: f64, limit: f64 },
    #[error("position {position:.4} is outside [{low:.4}, {high:.4}]")]
    PositionLimit { position: f64, low: f64, high: f64 },
    #[error("velocity {velocity:.4} exceeds 1.2 × the limit of {limit:.4}")]
    OverVelocity { velocity: f64, limit: f64 },
    #[error("the drive left Operation enabled for {state} without being told to")]
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

/// Why a command was not taken. Nothing has changed. Values in user units.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum Refused {
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
