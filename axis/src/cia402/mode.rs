//! Modes of operation (0x6060 and 0x6061).

use core::fmt;

/// A mode of operation, 0x6060 and 0x6061.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Mode {
    /// Profile position.
    Pp,
    /// Profile velocity.
    Pv,
    /// Homing.
    Hm,
    /// Cyclic synchronous position.
    Csp,
    /// Cyclic synchronous velocity.
    Csv,
    /// Cyclic synchronous torque.
    Cst,
    /// Vendor modes (negative), no mode (0) and modes not supported here.
    Unknown(i8),
}

impl Mode {
    /// Converts the value of 0x6060 or 0x6061.
    #[must_use]
    pub const fn from_code(code: i8) -> Self {
        match code {
            1 => Self::Pp,
            3 => Self::Pv,
            6 => Self::Hm,
            8 => Self::Csp,
            9 => Self::Csv,
            10 => Self::Cst,
            other => Self::Unknown(other),
        }
    }

    /// Returns the value of 0x6060.
    #[must_use]
    pub const fn code(self) -> i8 {
        match self {
            Self::Pp => 1,
            Self::Pv => 3,
            Self::Hm => 6,
            Self::Csp => 8,
            Self::Csv => 9,
            Self::Cst => 10,
            Self::Unknown(code) => code,
        }
    }
}

impl fmt::Display for Mode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Pp => f.write_str("PP"),
            Self::Pv => f.write_str("PV"),
            Self::Hm => f.write_str("HM"),
            Self::Csp => f.write_str("CSP"),
            Self::Csv => f.write_str("CSV"),
            Self::Cst => f.write_str("CST"),
            Self::Unknown(0) => f.write_str("none (0)"),
            Self::Unknown(code) => write!(f, "mode {code}"),
        }
    }
}

/// A set of modes, without [`Mode::Unknown`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Modes(u8);

impl Modes {
    /// No mode.
    pub const NONE: Self = Self(0);

    /// Returns the set with one mode. [`Mode::Unknown`] gives the empty set.
    #[must_use]
    pub const fn only(mode: Mode) -> Self {
        Self::NONE.with(mode)
    }

    /// Returns the set with this mode added.
    #[must_use]
    pub const fn with(self, mode: Mode) -> Self {
        Self(self.0 | Self::bit(mode))
    }

    /// True if the set contains this mode.
    #[must_use]
    pub const fn contains(self, mode: Mode) -> bool {
        self.0 & Self::bit(mode) != 0
    }

    const fn bit(mode: Mode) -> u8 {
        match mode {
            Mode::Pp => 1,
            Mode::Pv => 2,
            Mode::Hm => 4,
            Mode::Csp => 8,
            Mode::Csv => 16,
            Mode::Cst => 32,
            Mode::Unknown(_) => 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mode_sets_contain_their_modes() {
        let set = Modes::only(Mode::Csp).with(Mode::Hm);
        for code in i8::MIN..=i8::MAX {
            let mode = Mode::from_code(code);
            assert_eq!(set.contains(mode), matches!(code, 6 | 8), "{mode}");
            let alone = Modes::only(mode);
            assert_eq!(alone.contains(mode), alone != Modes::NONE);
        }
    }

    #[test]
    fn every_code_survives() {
        for code in i8::MIN..=i8::MAX {
            assert_eq!(Mode::from_code(code).code(), code);
        }
    }
}
