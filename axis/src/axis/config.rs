//! Configuration of an axis and its checks.

use super::SecondEncoder;
use crate::cia402::{Mode, Modes, QuickStopOption};
use crate::limits::{LimitError, Limits};
use crate::position_loop::Loops;
use crate::scale::Scale;
use crate::supervision::{Brake, FaultReset, Supervision};

/// The configuration of an axis. [`AxisConfig::new`] has defaults for all but mode, scale and
/// limits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AxisConfig {
    /// The mode after start; any mode except homing.
    pub mode: Mode,
    /// Further modes that may be switched to: those with mapped targets.
    pub modes: Modes,
    /// The conversion between counts and user units.
    pub scale: Scale,
    /// The limits of position, motion and torque.
    pub limits: Limits,
    /// Distance from the target up to which a move is in target, user units.
    pub target_window: f64,
    /// Steepest change of a commanded torque, percent per second. A stop reduces the torque with
    /// this slope.
    pub torque_slope: f64,
    /// True: moves and [`super::Command::Stop`] also keep the jerk limit ([`Limits::jerk`]). False:
    /// they are trapezoidal.
    pub jerk_limited: bool,
    /// The position loops closed in the MainDevice.
    pub loops: Loops,
    /// Time in seconds from sending a set-point until a reported position can show it. It includes
    /// both transmissions, the drive's interpolation and its lag. In every mode, set-point and
    /// reported position are compared over this time.
    pub dead_time_s: f64,
    /// Number of cycles by which inputs are older than those of the last sent frame. 0: each cycle
    /// uses the answer to its own frame.
    pub answers_late: u8,
    /// Time in seconds within which 0x6061 must show the commanded mode.
    pub mode_time_s: f64,
    /// True if the drive shows the commanded mode in 0x6061 in Operation enabled only. Then it gets
    /// its power first, and has `mode_time_s` to show the mode; targets follow actual values until
    /// then.
    pub mode_display_enabled: bool,
    /// True if the drive changes its mode only without power. Then a mode switch needs standstill,
    /// and passes through Switch on disabled.
    pub mode_change_unpowered: bool,
    /// The drive's 0x605A, if known. Without transition 16 the axis is enabled again via Switch on
    /// disabled.
    pub quick_stop: Option<QuickStopOption>,
    /// True if a quick stop of the drive ends without power and its brake must close in that time
    /// (Sercos, S-0-0207). "Disable voltage" then follows at a time-out only.
    pub quick_stop_ends: bool,
    /// Further supervision.
    pub supervision: Supervision,
    /// The holding brake.
    pub brake: Brake,
    /// Resets of drive faults.
    pub fault_reset: FaultReset,
    /// Time in seconds after which a stop becomes harder. `None`: calculated from speed,
    /// acceleration and jerk, and extended while the axis still slows down.
    pub stop_timeout_s: Option<f64>,
    /// True if the drive supports Statusword bit 12 (drive follows command value) in CSP, CSV and
    /// CST.
    pub follows_bit: bool,
    /// True if the drive keeps home without power: an absolute encoder.
    pub absolute: bool,
    /// False if the position at a start does not determine where an absolute encoder is: the drive's 32
    /// bits may have wrapped. Home is then kept over a return of the drive only.
    pub absolute_start: bool,
    /// True if no profile values (0x6081, 0x6083, 0x6084) are in the process data: a move in PP
    /// runs with those that the drive has, and takes no other speed or ramp.
    pub profile_fixed: bool,
    /// The second encoder at the load.
    pub second_encoder: Option<SecondEncoder>,
    /// What a completed homing shows, if known.
    pub home: Option<HomeReference>,
}

/// What a completed homing shows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HomeReference {
    /// The position in 0x6064 after homing, user units. `None`: the drive's own setting.
    pub position: Option<f64>,
    /// Distance from it at which the drive may stand: it may stop beyond its switch or index.
    pub window: f64,
    /// False for methods without motion (35, 37). They may end before the axis has seen Statusword
    /// bit 12 low.
    pub moves: bool,
}

impl AxisConfig {
    /// Builds a configuration with defaults. The target window is a tenth of the following error
    /// limit (without limit: ten counts), at least two counts. Full torque takes 0.1 s and a mode
    /// switch at most 1 s. There is no further mode, no position loop and no dead time.
    #[must_use]
    pub fn new(mode: Mode, scale: Scale, limits: Limits) -> Self {
        let window = limits
            .following_error
            .map_or(scale.units_of_counts(10.0), |error| error * 0.1);
        Self {
            mode,
            modes: Modes::only(mode),
            scale,
            limits,
            target_window: window.max(scale.units_of_counts(2.0)),
            torque_slope: limits.torque * 10.0,
            jerk_limited: false,
            loops: Loops::default(),
            dead_time_s: 0.0,
            answers_late: 0,
            mode_time_s: 1.0,
            mode_display_enabled: false,
            mode_change_unpowered: false,
            quick_stop: None,
            quick_stop_ends: false,
            supervision: Supervision::default(),
            brake: Brake::default(),
            fault_reset: FaultReset::default(),
            stop_timeout_s: None,
            follows_bit: true,
            absolute: false,
            absolute_start: true,
            profile_fixed: false,
            second_encoder: None,
            home: None,
        }
    }

    pub(super) fn check(&self) -> Result<(), ConfigError> {
        if !matches!(
            self.mode,
            Mode::Csp | Mode::Csv | Mode::Cst | Mode::Pp | Mode::Pv
        ) {
            return Err(ConfigError::Mode(self.mode));
        }
        self.limits.check(&self.scale)?;
        let watch = &self.supervision;
        let reset_delay = match self.fault_reset {
            FaultReset::Manual => 0.0,
            FaultReset::Automatic { delay_s, .. } => delay_s,
        };
        let csv = self.loops.csv;
        let cst = self.loops.cst;
        for (what, value) in [
            ("target_window", Some(self.target_window)),
            ("torque_slope", Some(self.torque_slope)),
            ("mode_time_s", Some(self.mode_time_s)),
            ("supervised torque", watch.torque.map(|t| t.percent)),
            ("supervised acceleration", watch.acceleration),
            ("standstill window", watch.standstill),
            ("stop_timeout_s", self.stop_timeout_s),
            (
                "max_difference",
                self.second_encoder.map(|e| e.max_difference),
            ),
            (
                "counts of the second encoder",
                self.second_encoder.map(|e| e.counts_per_unit.abs()),
            ),
            ("kv", csv.map(|l| l.kv)),
            ("kp", cst.map(|l| l.kp)),
            ("tn_s", cst.and_then(|l| l.tn_s)),
        ] {
            if let Some(value) = value
                && !(value.is_finite() && value > 0.0)
            {
                return Err(ConfigError::NotPositive { what, value });
            }
        }
        for (what, value, most) in [
            ("dead_time_s", self.dead_time_s, LONGEST_DEAD_TIME_S),
            (
                "supervised torque's time",
                watch.torque.map_or(0.0, |t| t.time_s),
                LONGEST_S,
            ),
            ("target dwell", watch.target_dwell_s, LONGEST_S),
            ("standstill dwell", watch.standstill_dwell_s, LONGEST_S),
            ("brake release", self.brake.release_s, LONGEST_S),
            ("brake engage", self.brake.engage_s, LONGEST_S),
            ("fault reset delay", reset_delay, LONGEST_S),
            ("velocity feed-forward", self.loops.csp.velocity, 1.0),
            (
                "velocity feed-forward",
                csv.map_or(0.0, |l| l.feed_forward),
                1.0,
            ),
            ("tv_s", cst.map_or(0.0, |l| l.tv_s), f64::MAX),
            (
                "acceleration feed-forward",
                self.loops.csp.acceleration,
                f64::MAX,
            ),
            (
                "acceleration feed-forward",
                cst.map_or(0.0, |l| l.acceleration),
                f64::MAX,
            ),
        ] {
            if !(0.0..=most).contains(&value) {
                return Err(ConfigError::Outside { what, value, most });
            }
        }
        Ok(())
    }

    /// Returns the time in seconds after which a stop from `speed` becomes harder: ramp time with
    /// jerk, dead time, and one second.
    #[must_use]
    pub fn stop_time_s(&self, mode: Mode, speed: f64) -> f64 {
        let limits = &self.limits;
        let ramp_s = match self.control(mode) {
            ControlledQuantity::Torque => limits.torque / self.torque_slope,
            _ if self.jerk_limited => {
                speed / limits.acceleration + limits.acceleration / limits.jerk()
            }
            _ => speed / limits.acceleration,
        };
        let calculated_s = ramp_s + self.dead_time_s + STOP_MARGIN_S;
        self.stop_timeout_s.unwrap_or(calculated_s).min(LONGEST_S)
    }

    /// Returns the quantity that commands control in `mode`.
    pub(super) const fn control(&self, mode: Mode) -> ControlledQuantity {
        match mode {
            Mode::Csv if self.loops.csv.is_none() => ControlledQuantity::Velocity,
            Mode::Cst if self.loops.cst.is_none() => ControlledQuantity::Torque,
            Mode::Pp | Mode::Pv | Mode::Hm => ControlledQuantity::Drive,
            _ => ControlledQuantity::Position,
        }
    }
}

/// Longest accepted dead time.
const LONGEST_DEAD_TIME_S: f64 = 0.1;

/// Margin added to the deceleration time, for settling and for the drive's lag.
const STOP_MARGIN_S: f64 = 1.0;

/// Longest accepted dwell, delay and brake time.
const LONGEST_S: f64 = 3600.0;

/// The quantity that the set-point controls in a mode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ControlledQuantity {
    /// Position, and with it velocity.
    Position,
    /// Velocity; the position follows from the motion.
    Velocity,
    /// Torque; the motion follows from it.
    Torque,
    /// None: the drive generates its own motion.
    Drive,
}

/// The configuration of an axis is invalid.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum ConfigError {
    /// The axis cannot start in this mode.
    #[error("mode {0} is not one of CSP, CSV, CST, PP, PV")]
    Mode(Mode),
    /// A limit is invalid.
    #[error(transparent)]
    Limit(#[from] LimitError),
    /// A value is not a finite number above zero.
    #[error("{what} is {value}: it must be a finite number above zero")]
    NotPositive {
        /// The value's name.
        what: &'static str,
        /// The rejected value.
        value: f64,
    },
    /// A value is out of range.
    #[error("{what} is {value}: it must be between 0 and {most}")]
    Outside {
        /// The value's name.
        what: &'static str,
        /// The rejected value.
        value: f64,
        /// The largest accepted value.
        most: f64,
    },
}
