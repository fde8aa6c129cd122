//! What an axis does for an operator.

use std::fmt;

use ecaxis_axis::Mode;

/// The activity of an axis in manual mode.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Activity {
    #[default]
    Nothing,
    Enabling,
    Disabling,
    /// Moves at this velocity while requests continue.
    Jogging {
        velocity: f64,
    },
    /// Moves to a position, or by a distance.
    Moving {
        by: bool,
        value: f64,
    },
    /// Turns at this velocity until another request.
    Turning {
        velocity: f64,
    },
    /// Applies this torque, in percent of the rated torque, until another request.
    Pressing {
        percent: f64,
    },
    Homing,
    Switching {
        to: Mode,
    },
    Resetting,
    Stopping,
}

impl Activity {
    pub(super) fn moves(self) -> bool {
        matches!(
            self,
            Self::Jogging { .. }
                | Self::Moving { .. }
                | Self::Turning { .. }
                | Self::Pressing { .. }
                | Self::Homing
        )
    }
}

impl fmt::Display for Activity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Nothing => f.write_str("nothing"),
            Self::Enabling => f.write_str("enable"),
            Self::Disabling => f.write_str("disable"),
            Self::Jogging { velocity } => write!(f, "jog at {velocity}"),
            Self::Moving { by: true, value } => write!(f, "move by {value}"),
            Self::Moving { by: false, value } => write!(f, "move to {value}"),
            Self::Turning { velocity } => write!(f, "turn at {velocity}"),
            Self::Pressing { percent } => write!(f, "press with {percent} %"),
            Self::Homing => f.write_str("home"),
            Self::Switching { to } => write!(f, "mode {to}"),
            Self::Resetting => f.write_str("reset"),
            Self::Stopping => f.write_str("stop"),
        }
    }
}
