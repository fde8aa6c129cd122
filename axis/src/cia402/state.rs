//! The power state, decoded from the Statusword with the mask/value table of the standard.

use core::fmt;

use super::words::Statusword;

/// States of the power drive system (CiA 402-2, "Statusword, state coding").
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum State {
    /// Not ready to switch on.
    NotReadyToSwitchOn,
    /// Switch on disabled.
    SwitchOnDisabled,
    /// Ready to switch on.
    ReadyToSwitchOn,
    /// Switched on.
    SwitchedOn,
    /// Operation enabled.
    OperationEnabled,
    /// Quick stop active.
    QuickStopActive,
    /// Fault reaction active.
    FaultReactionActive,
    /// Fault.
    Fault,
    /// A Statusword that the table does not list; contains all bits.
    Unknown(u16),
}

impl State {
    /// Decodes bits 0–3, 5 and 6 (CiA 402-2 "statusword").
    #[must_use]
    pub const fn from_statusword(word: Statusword) -> Self {
        let bits = word.bits();
        // Bits 0–3, 5 and 6. Bit 5 (quick stop) matters only in half of the states.
        match bits & 0x6F {
            0x00 | 0x20 => Self::NotReadyToSwitchOn,
            0x40 | 0x60 => Self::SwitchOnDisabled,
            0x21 => Self::ReadyToSwitchOn,
            0x23 => Self::SwitchedOn,
            0x27 => Self::OperationEnabled,
            0x07 => Self::QuickStopActive,
            0x0F | 0x2F => Self::FaultReactionActive,
            0x08 | 0x28 => Self::Fault,
            _ => Self::Unknown(bits),
        }
    }

    /// Returns true if the drive can move the axis.
    #[must_use]
    pub const fn has_power(self) -> bool {
        matches!(
            self,
            Self::OperationEnabled | Self::QuickStopActive | Self::FaultReactionActive
        )
    }

    /// Returns true in Fault and Fault reaction active.
    #[must_use]
    pub const fn is_fault(self) -> bool {
        matches!(self, Self::Fault | Self::FaultReactionActive)
    }
}

impl fmt::Display for State {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::NotReadyToSwitchOn => "Not ready to switch on",
            Self::SwitchOnDisabled => "Switch on disabled",
            Self::ReadyToSwitchOn => "Ready to switch on",
            Self::SwitchedOn => "Switched on",
            Self::OperationEnabled => "Operation enabled",
            Self::QuickStopActive => "Quick stop active",
            Self::FaultReactionActive => "Fault reaction active",
            Self::Fault => "Fault",
            Self::Unknown(word) => return write!(f, "unknown (Statusword {word:#06x})"),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The table of the standard: mask, value, state. The rows exclude each other, so their order
    /// does not matter.
    const TABLE: [(u16, u16, State); 8] = [
        (0x4F, 0x00, State::NotReadyToSwitchOn),
        (0x4F, 0x40, State::SwitchOnDisabled),
        (0x6F, 0x21, State::ReadyToSwitchOn),
        (0x6F, 0x23, State::SwitchedOn),
        (0x6F, 0x27, State::OperationEnabled),
        (0x6F, 0x07, State::QuickStopActive),
        (0x4F, 0x0F, State::FaultReactionActive),
        (0x4F, 0x08, State::Fault),
    ];

    #[test]
    fn every_word_by_the_table() {
        for bits in 0..=u16::MAX {
            let row = TABLE.iter().find(|(mask, value, _)| bits & mask == *value);
            let expected = row.map_or(State::Unknown(bits), |row| row.2);
            assert_eq!(state(bits), expected, "{bits:#06x}");
        }
    }

    fn state(bits: u16) -> State {
        State::from_statusword(Statusword::from_bits_retain(bits))
    }

    /// Words from real drives, with voltage enabled, remote and vendor bits.
    #[test]
    fn words_of_real_drives_are_decoded() {
        for (bits, expected) in [
            (0x0000, State::NotReadyToSwitchOn),
            (0x0240, State::SwitchOnDisabled),
            (0x0250, State::SwitchOnDisabled),
            (0x0160, State::SwitchOnDisabled),
            (0x0221, State::ReadyToSwitchOn),
            (0x0231, State::ReadyToSwitchOn),
            (0x0233, State::SwitchedOn),
            (0x1237, State::OperationEnabled),
            (0x0217, State::QuickStopActive),
            (0x021F, State::FaultReactionActive),
            (0x0208, State::Fault),
            (0x0218, State::Fault),
            (0x0238, State::Fault),
        ] {
            assert_eq!(state(bits), expected, "{bits:#06x}");
        }
    }

    #[test]
    fn unlisted_words_survive() {
        assert_eq!(state(0x0201), State::Unknown(0x0201));
        assert_eq!(state(0xFFFF), State::Unknown(0xFFFF));
        assert!(state(0xFFFF).to_string().contains("0xffff"));
    }

    #[test]
    fn no_word_matches_two_rows() {
        for bits in 0..=u16::MAX {
            let rows = TABLE.iter().filter(|(m, v, _)| bits & m == *v).count();
            assert!(rows <= 1, "{bits:#06x} matches {rows} rows");
        }
    }
}
