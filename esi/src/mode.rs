//! CiA 402 modes of operation and their names.

use std::fmt;
use std::str::FromStr;

/// A CiA 402 mode of operation (0x6060).
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
}

impl Mode {
    /// All modes.
    pub const ALL: [Self; 6] = [
        Self::Pp,
        Self::Pv,
        Self::Hm,
        Self::Csp,
        Self::Csv,
        Self::Cst,
    ];

    /// Returns the value of 0x6060.
    #[must_use]
    pub fn code(self) -> i8 {
        match self {
            Self::Pp => 1,
            Self::Pv => 3,
            Self::Hm => 6,
            Self::Csp => 8,
            Self::Csv => 9,
            Self::Cst => 10,
        }
    }

    /// Converts the value of 0x6060; `None` for other modes.
    #[must_use]
    pub fn from_code(code: i8) -> Option<Self> {
        Self::ALL.into_iter().find(|mode| mode.code() == code)
    }

    /// Returns the abbreviation in lower case, such as `csp`.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Pp => "pp",
            Self::Pv => "pv",
            Self::Hm => "hm",
            Self::Csp => "csp",
            Self::Csv => "csv",
            Self::Cst => "cst",
        }
    }

    /// Returns the set-point object that the outputs must contain. Homing has none.
    #[must_use]
    pub fn target_object(self) -> Option<u16> {
        match self {
            Self::Pp | Self::Csp => Some(0x607a),
            Self::Pv | Self::Csv => Some(0x60ff),
            Self::Cst => Some(0x6071),
            Self::Hm => None,
        }
    }

    /// Returns the actual value object that the inputs should contain.
    #[must_use]
    pub fn actual_object(self) -> u16 {
        match self {
            Self::Pp | Self::Csp | Self::Hm => 0x6064,
            Self::Pv | Self::Csv => 0x606c,
            Self::Cst => 0x6077,
        }
    }

    /// True for modes with a set-point in every cycle: CSP, CSV and CST.
    #[must_use]
    pub fn is_cyclic(self) -> bool {
        matches!(self, Self::Csp | Self::Csv | Self::Cst)
    }

    /// True if a vendor's label names this mode, such as `CSP Mode`, `PPM` or `csp - axis`.
    pub(crate) fn is_named_in(self, label: &str) -> bool {
        label
            .split(|c: char| !c.is_ascii_alphanumeric())
            .any(|word| {
                let word = word.to_ascii_lowercase();
                word == self.name() || word.strip_suffix('m') == Some(self.name())
            })
    }
}

impl fmt::Display for Mode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The text names no mode.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is not a mode; there are pp, pv, hm, csp, csv and cst")]
pub struct UnknownMode(String);

impl FromStr for Mode {
    type Err = UnknownMode;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let found = Self::ALL
            .into_iter()
            .find(|mode| mode.name().eq_ignore_ascii_case(text.trim()));
        found.ok_or_else(|| UnknownMode(text.to_owned()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mode_codes_and_names_round_trip() {
        for mode in Mode::ALL {
            assert_eq!(Mode::from_code(mode.code()), Some(mode));
            assert_eq!(mode.to_string().parse(), Ok(mode));
        }
        assert!("csx".parse::<Mode>().is_err());
    }

    #[test]
    fn mode_is_recognised_in_vendor_labels() {
        assert!(Mode::Csp.is_named_in("CSP Mode"));
        assert!(Mode::Pp.is_named_in("PPM Mode"));
        assert!(Mode::Csv.is_named_in("csv,csp - axis"));
        assert!(!Mode::Cst.is_named_in("csv,csp - axis"));
        assert!(!Mode::Pp.is_named_in("Supply"));
    }
}
