//! Controlword (0x6040) and Statusword (0x6041). `from_bits_retain` keeps unnamed bits.

use core::fmt;

use bitflags::bitflags;

use super::state::State;

bitflags! {
    /// The Statusword, 0x6041 (CiA 402-2 "statusword").
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
    pub struct Statusword: u16 {
        /// Ready to switch on.
        const READY_TO_SWITCH_ON = 1 << 0;
        /// Switched on.
        const SWITCHED_ON = 1 << 1;
        /// Operation enabled.
        const OPERATION_ENABLED = 1 << 2;
        /// Fault.
        const FAULT = 1 << 3;
        /// Voltage enabled: the power stage is supplied.
        const VOLTAGE_ENABLED = 1 << 4;
        /// Active low: set if no quick stop is active.
        const QUICK_STOP = 1 << 5;
        /// Switch on disabled.
        const SWITCH_ON_DISABLED = 1 << 6;
        /// Warning.
        const WARNING = 1 << 7;
        /// Remote: the drive obeys the Controlword.
        const REMOTE = 1 << 9;
        /// Target reached.
        const TARGET_REACHED = 1 << 10;
        /// Internal limit active.
        const INTERNAL_LIMIT_ACTIVE = 1 << 11;
        /// In the cyclic synchronous modes: the drive follows the command value. Other modes use
        /// it otherwise.
        const FOLLOWS_COMMAND = 1 << 12;
        /// In CSP: following error of the drive. Other modes use it otherwise.
        const FOLLOWING_ERROR = 1 << 13;
        const _ = !0;
    }
}

bitflags! {
    /// The Controlword, 0x6040 (CiA 402-2 "controlword").
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
    pub struct Controlword: u16 {
        /// Switch on.
        const SWITCH_ON = 1 << 0;
        /// Enable voltage.
        const ENABLE_VOLTAGE = 1 << 1;
        /// Active low: a cleared bit requests quick stop.
        const QUICK_STOP = 1 << 2;
        /// Enable operation.
        const ENABLE_OPERATION = 1 << 3;
        /// Acts on its rising edge.
        const FAULT_RESET = 1 << 7;
        /// In PP, PV and HM. Otherwise 0x605D applies.
        const HALT = 1 << 8;
        const _ = !0;
    }
}

// The commands of the standard.
impl Controlword {
    /// Transitions 7, 9, 10, 12.
    pub const DISABLE_VOLTAGE_COMMAND: Self = Self::empty();
    /// Transitions 2, 6, 8.
    pub const SHUTDOWN_COMMAND: Self = Self::ENABLE_VOLTAGE.union(Self::QUICK_STOP);
    /// Transition 3. In Operation enabled, the same word is "disable operation", transition 5.
    pub const SWITCH_ON_COMMAND: Self = Self::SHUTDOWN_COMMAND.union(Self::SWITCH_ON);
    /// Transitions 4, 16.
    pub const ENABLE_OPERATION_COMMAND: Self =
        Self::SWITCH_ON_COMMAND.union(Self::ENABLE_OPERATION);
    /// Transitions 7, 10, 11.
    pub const QUICK_STOP_COMMAND: Self = Self::ENABLE_VOLTAGE;
    /// Transition 15.
    pub const FAULT_RESET_COMMAND: Self = Self::FAULT_RESET;
}

/// Bits that a Statusword shows besides its state. The meaning of 12 and 13 depends on the mode.
const STATUS_BITS: [(Statusword, &str); 8] = [
    (Statusword::WARNING, "warning"),
    (Statusword::from_bits_retain(1 << 8), "bit 8"),
    (Statusword::TARGET_REACHED, "target reached"),
    (Statusword::INTERNAL_LIMIT_ACTIVE, "internal limit active"),
    (Statusword::FOLLOWS_COMMAND, "bit 12"),
    (Statusword::FOLLOWING_ERROR, "bit 13"),
    (Statusword::from_bits_retain(1 << 14), "bit 14"),
    (Statusword::from_bits_retain(1 << 15), "bit 15"),
];

/// Formats the state, and the bits that do not belong to it.
impl fmt::Display for Statusword {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match State::from_statusword(*self) {
            State::Unknown(_) => f.write_str("unknown state")?,
            state => write!(f, "{state}")?,
        }
        if !self.contains(Self::VOLTAGE_ENABLED) {
            f.write_str(", no voltage")?;
        }
        if !self.contains(Self::REMOTE) {
            f.write_str(", not remote")?;
        }
        let mut set = STATUS_BITS.iter().filter(|(bit, _)| self.contains(*bit));
        set.try_for_each(|(_, name)| write!(f, ", {name}"))
    }
}

/// Bits that a Controlword shows besides its command. The meaning of 4, 5, 6 and 9 depends on the
/// mode.
const CONTROL_BITS: [(u16, &str); 10] = [
    (1 << 4, "bit 4"),
    (1 << 5, "bit 5"),
    (1 << 6, "bit 6"),
    (1 << 8, "halt"),
    (1 << 9, "bit 9"),
    (1 << 11, "bit 11"),
    (1 << 12, "bit 12"),
    (1 << 13, "bit 13"),
    (1 << 14, "bit 14"),
    (1 << 15, "bit 15"),
];

/// Formats the command (CiA 402-2, "command coding"), and the bits that do not belong to it.
impl fmt::Display for Controlword {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self.bits() & 0x8F {
            bits if bits & 0x80 != 0 => "fault reset",
            bits if bits & 0x02 == 0 => "disable voltage",
            bits if bits & 0x04 == 0 => "quick stop",
            bits if bits & 0x01 == 0 => "shutdown",
            bits if bits & 0x08 == 0 => "switch on",
            _ => "enable operation",
        })?;
        let mut set = CONTROL_BITS
            .iter()
            .filter(|(bit, _)| self.bits() & bit != 0);
        set.try_for_each(|(_, name)| write!(f, ", {name}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_show_state_or_command_and_further_bits() {
        for (bits, text) in [
            (0x0237, "Operation enabled"),
            (0x1637, "Operation enabled, target reached, bit 12"),
            (0x0218, "Fault"),
            (0x0240, "Switch on disabled, no voltage"),
            (
                0x88b1,
                "Ready to switch on, not remote, warning, internal limit active, bit 15",
            ),
            (0x0002, "unknown state, no voltage, not remote"),
        ] {
            assert_eq!(Statusword::from_bits_retain(bits).to_string(), text);
        }
        for (bits, text) in [
            (0x0000, "disable voltage"),
            (0x0002, "quick stop"),
            (0x0006, "shutdown"),
            (0x0007, "switch on"),
            (0x000f, "enable operation"),
            (0x011f, "enable operation, bit 4, halt"),
            (0x0080, "fault reset"),
            (0x008f, "fault reset"),
            (0x8007, "switch on, bit 15"),
        ] {
            assert_eq!(Controlword::from_bits_retain(bits).to_string(), text);
        }
    }

    #[test]
    fn command_words() {
        for (word, bits) in [
            (Controlword::DISABLE_VOLTAGE_COMMAND, 0x0000),
            (Controlword::QUICK_STOP_COMMAND, 0x0002),
            (Controlword::SHUTDOWN_COMMAND, 0x0006),
            (Controlword::SWITCH_ON_COMMAND, 0x0007),
            (Controlword::ENABLE_OPERATION_COMMAND, 0x000F),
            (Controlword::FAULT_RESET_COMMAND, 0x0080),
        ] {
            assert_eq!(word.bits(), bits);
        }
    }

    #[test]
    fn vendor_bits_survive() {
        assert_eq!(Statusword::from_bits_retain(0xD123).bits(), 0xD123);
        assert_eq!(Controlword::from_bits_retain(0xF870).bits(), 0xF870);
    }
}
