//! Controlword (0x6040) and Statusword (0x6041). `from_bits_retain` keeps unnamed bits.

use bitflags::bitflags;

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

#[cfg(test)]
mod tests {
    use super::*;

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
