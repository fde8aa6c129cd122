//! What an axis is made with, and what of that cannot work.

use crate::cia402::{Mode, Modes, QuickStopOption};
use crate::limits::{LimitError, Limits};
use crate::loops::Loops;
use crate::scale::Scale;
use crate::supervision::{Brake, FaultReset, Supervision};

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AxisConfig {
    /// Until another one is commanded: any but homing.
    pub mode: Mode,
    /// What may be switched to besides `mode`: the modes whose targets are mapped.
    pub modes: Modes,
    pub scale: Scale,
    pub limits: Limits,
    /// A move is in target when the reported position is this near, user units.
    pub target_window: f64,
    /// Steepest change of a commanded torque, percent per second; also how a stop takes torque away.
    pub torque_slope: f64,
    /// Moves keep the jerk limit, too ([`Limits::jerk`]), and [`super::Command::Stop`] ends them so. Otherwise they are trapezoids.
    pub jerk_limited: bool,
    pub loops: Loops,
    /// From a set-point's leaving here until a reported position can show it, seconds: the wire both ways, the drive's
    /// interpolation and its lag. Set-point and reported position are compared over this time, in every mode.
    pub dead_time_s: f64,
    /// Cycles by which inputs are older than those of the frame that went out last: 0 where each cycle takes the answer to its
    /// own frame.
    pub answers_late: u8,
    /// How long 0x6061 may take to show the mode that was commanded, seconds.
    pub mode_time_s: f64,
    /// 0x605A, where it is known: without transition 16 an axis is enabled again by way of Switch on disabled.
    pub quick_stop: Option<QuickStopOption>,
    pub supervision: Supervision,
    pub brake: Brake,
    pub fault_reset: FaultReset,
    /// When a stop becomes harder, seconds. `None`: calculated from speed, acceleration and jerk, and later where the axis
    /// still slows down.
    pub stop_timeout_s: Option<f64>,
    /// The drive serves Statusword bit 12 (drive follows command value) in CSP, CSV and CST.
    pub follows_bit: bool,
}

impl AxisConfig {
    /// With a target window of a tenth of the following error limit (ten counts where there is none, never below two), full
    /// torque in 0.1 s, no other mode, no loops, no dead time, and a second to switch modes.
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
            quick_stop: None,
            supervision: Supervision::default(),
            brake: Brake::default(),
            fault_reset: FaultReset::default(),
            stop_timeout_s: None,
            follows_bit: true,
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

    /// When a stop from this speed becomes harder, seconds: what the ramp takes, with its jerk, and a second for the drive.
    #[must_use]
    pub fn stop_time_s(&self, mode: Mode, speed: f64) -> f64 {
        let limits = &self.limits;
        let ramp_s = match self.control(mode) {
            Control::Torque => limits.torque / self.torque_slope,
            _ if self.jerk_limited => {
                speed / limits.acceleration + limits.acceleration / limits.jerk()
            }
            _ => speed / limits.acceleration,
        };
        let calculated_s = ramp_s + self.dead_time_s + STOP_MARGIN_S;
        self.stop_timeout_s.unwrap_or(calculated_s).min(LONGEST_S)
    }

    /// What can be commanded in a mode.
    pub(super) const fn control(&self, mode: Mode) -> Control {
        match mode {
            Mode::Csv if self.loops.csv.is_none() => Control::Velocity,
            Mode::Cst if self.loops.cst.is_none() => Control::Torque,
            Mode::Pp | Mode::Pv | Mode::Hm => Control::Drive,
            _ => Control::Position,
        }
    }
}

/// Longer is no dead time.
const LONGEST_DEAD_TIME_S: f64 = 0.1;

/// Added to the time that a deceleration takes: settling, a drive that follows late.
const STOP_MARGIN_S: f64 = 1.0;

/// An hour is longer than any dwell, delay or brake.
const LONGEST_S: f64 = 3600.0;

/// What of the set-point counts in a mode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Control {
    /// Position, and so velocity.
    Position,
    /// Velocity; the position is what it turns out to be.
    Velocity,
    /// Torque; the motion is what it turns out to be.
    Torque,
    /// Nothing: the drive makes its own.
    Drive,
}

#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum ConfigError {
    #[error("mode {0} is not one of CSP, CSV, CST, PP, PV")]
    Mode(Mode),
    #[error(transparent)]
    Limit(#[from] LimitError),
    #[error("{what} is {value}: it must be a finite number above zero")]
    NotPositive { what: &'static str, value: f64 },
    #[error("{what} is {value}: it must be between 0 and {most}")]
    Outside {
        what: &'static str,
        value: f64,
        most: f64,
    },
}
