//! Sercos drives (IEC 61800-7-204): master control word (S-0-0134) and drive status word (S-0-0135)
//! as Controlword and Statusword of CiA 402.
//!
//! An axis knows CiA 402 only. [`DriveWords`] stands between the axis and its drive; all other
//! values of a Sercos drive mean the same as their objects.
//!
//! | command of the axis | S-0-0134 | the drive |
//! |---|---|---|
//! | disable voltage | 0 | has no torque, at once |
//! | quick stop, shutdown, switch on | 0x6000: enable, no halt | decelerates, then has no torque |
//! | enable operation | 0xE000: also drive on | follows its command values |
//! | enable operation with halt | 0xC000 | decelerates and keeps torque |
//! | fault reset | 0, and the procedure command S-0-0099 | clears errors of class 1 |
//!
//! S-0-0135 does not distinguish the states before "Operation enabled". The last command decides.
//! A status word is at least one cycle old, and a brake takes time to close: torque after "drive on"
//! has ended is "Quick stop active", whatever the command, until the drive has no torque.

use crate::cia402::Statusword;

/// Drive on; a falling edge decelerates the drive, then removes the torque.
const ON: u16 = 1 << 15;
/// Enable drive; without it the drive has no torque.
const ENABLE: u16 = 1 << 14;
/// Drive restart; without it the drive halts and keeps its torque.
const RESTART: u16 = 1 << 13;
/// Toggles with each new set of command values.
const SYNC: u16 = 1 << 10;

/// Errors of class 1 have shut the drive down.
const SHUT_DOWN: u16 = 1 << 13;
/// The diagnostics of class 2, warnings, have changed.
const WARNING_CHANGED: u16 = 1 << 12;
/// The operation mode that is active; 0 is the primary one (S-0-0032).
const MODE: u16 = 7 << 8;
/// The drive follows its command values.
const FOLLOWS: u16 = 1 << 3;

const FAULT_RESET: u16 = 1 << 7;
const HALT: u16 = 1 << 8;

/// A command of the axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum Order {
    #[default]
    DisableVoltage,
    QuickStop,
    Shutdown,
    SwitchOn,
    EnableOperation,
}

impl Order {
    /// CiA 402-2, command coding.
    const fn decode(controlword: u16) -> Self {
        match controlword & 0x8f {
            word if word & FAULT_RESET != 0 || word & 0x02 == 0 => Self::DisableVoltage,
            word if word & 0x04 == 0 => Self::QuickStop,
            word if word & 0x01 == 0 => Self::Shutdown,
            word if word & 0x08 == 0 => Self::SwitchOn,
            _ => Self::EnableOperation,
        }
    }
}

/// The words that a drive has on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DriveWords {
    /// Controlword and Statusword, as the axis has them.
    #[default]
    Cia402,
    /// S-0-0134 and S-0-0135.
    Sercos(SercosWords),
}

/// The words of a Sercos drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SercosWords {
    order: Order,
    /// Bit 7 of the last Controlword.
    reset: bool,
    sync: bool,
    /// "Drive on" has ended, and the drive has had torque since.
    stopping: bool,
    /// The drive has bit 3 of S-0-0135.
    follows_bit: bool,
}

impl SercosWords {
    /// Creates the words of a drive. `follows_bit`: it reports in bit 3 of S-0-0135 that it follows its
    /// command values.
    #[must_use]
    pub const fn new(follows_bit: bool) -> Self {
        Self {
            order: Order::DisableVoltage,
            reset: false,
            sync: false,
            stopping: false,
            follows_bit,
        }
    }

    const fn statusword(&mut self, word: u16) -> u16 {
        self.stopping &= word >> 14 == 3;
        let follows = word & MODE == 0 && (!self.follows_bit || word & FOLLOWS != 0);
        let state = match (word & SHUT_DOWN != 0, word >> 14) {
            // Fault reaction active.
            (true, 3) => 0x000f,
            // Fault.
            (true, _) => 0x0008,
            // Not ready to switch on: the drive tests itself.
            (false, 0) => 0x0000,
            // Without power, and after commands that remove it: Switch on disabled.
            (false, 1) => 0x0040,
            (false, 2) => match self.order {
                Order::DisableVoltage | Order::QuickStop => 0x0040,
                Order::Shutdown => 0x0021,
                Order::SwitchOn | Order::EnableOperation => 0x0023,
            },
            // Torque: Quick stop active, or Operation enabled.
            (false, _) => match self.order {
                Order::QuickStop => 0x0007,
                _ if self.stopping => 0x0007,
                _ if follows => 0x0027 | Statusword::FOLLOWS_COMMAND.bits(),
                _ => 0x0027,
            },
        };
        let mut status = state | Statusword::REMOTE.bits();
        if word >> 14 >= 2 {
            status |= Statusword::VOLTAGE_ENABLED.bits();
        }
        if word & WARNING_CHANGED != 0 {
            status |= Statusword::WARNING.bits();
        }
        status
    }

    const fn control(&mut self, controlword: u16) -> ControlOutput {
        let order = Order::decode(controlword);
        let word = match order {
            Order::DisableVoltage => 0,
            Order::QuickStop | Order::Shutdown | Order::SwitchOn => ENABLE | RESTART,
            Order::EnableOperation if controlword & HALT != 0 => ON | ENABLE,
            Order::EnableOperation => ON | ENABLE | RESTART,
        };
        let reset = controlword & FAULT_RESET != 0;
        let reset_rose = reset && !self.reset;
        let sync = !self.sync;
        let ended = matches!(self.order, Order::EnableOperation | Order::QuickStop)
            && !matches!(order, Order::EnableOperation);
        self.stopping |= ended;
        self.order = order;
        self.reset = reset;
        self.sync = sync;
        ControlOutput {
            word: word | if sync { SYNC } else { 0 },
            reset: reset_rose,
        }
    }
}

/// What the drive receives for a Controlword.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ControlOutput {
    /// The word in the process data.
    pub word: u16,
    /// True if a procedure command must clear the errors of the drive (S-0-0099).
    pub reset: bool,
}

impl DriveWords {
    /// Returns the Statusword for a word of the drive. Call it once per cycle. RT: O(1).
    #[must_use]
    pub const fn statusword(&mut self, word: u16) -> u16 {
        match self {
            Self::Cia402 => word,
            Self::Sercos(words) => words.statusword(word),
        }
    }

    /// Returns what the drive receives for a Controlword. Call it once per cycle. RT: O(1).
    pub const fn control(&mut self, controlword: u16) -> ControlOutput {
        match self {
            Self::Cia402 => ControlOutput {
                word: controlword,
                reset: false,
            },
            Self::Sercos(words) => words.control(controlword),
        }
    }

    /// Takes back the last word, which was never sent: its successor replaces it. RT: O(1).
    pub const fn take_back(&mut self) {
        if let Self::Sercos(words) = self {
            words.sync = !words.sync;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cia402::{Controlword, State};

    fn state(words: &mut DriveWords, raw: u16) -> State {
        State::from_statusword(Statusword::from_bits_retain(words.statusword(raw)))
    }

    /// IEC 61800-7-204, bits of S-0-0134, command by command.
    #[test]
    fn commands_row_by_row() {
        for (controlword, expected) in [
            (Controlword::DISABLE_VOLTAGE_COMMAND, 0x0000),
            (Controlword::QUICK_STOP_COMMAND, 0x6000),
            (Controlword::SHUTDOWN_COMMAND, 0x6000),
            (Controlword::SWITCH_ON_COMMAND, 0x6000),
            (Controlword::ENABLE_OPERATION_COMMAND, 0xe000),
            (
                Controlword::ENABLE_OPERATION_COMMAND | Controlword::HALT,
                0xc000,
            ),
            (Controlword::FAULT_RESET_COMMAND, 0x0000),
        ] {
            let mut words = DriveWords::Sercos(SercosWords::new(true));
            let first = words.control(controlword.bits());
            let second = words.control(controlword.bits());
            assert_eq!(first.word, expected | SYNC, "{controlword}");
            assert_eq!(second.word, expected, "{controlword}");
            let resets = controlword.contains(Controlword::FAULT_RESET);
            assert_eq!((first.reset, second.reset), (resets, false));
        }
    }

    /// IEC 61800-7-204, bits 13 to 15 of S-0-0135, for each command.
    #[test]
    fn states_row_by_row() {
        use Controlword as C;
        let commands = [
            C::DISABLE_VOLTAGE_COMMAND,
            C::QUICK_STOP_COMMAND,
            C::SHUTDOWN_COMMAND,
            C::SWITCH_ON_COMMAND,
            C::ENABLE_OPERATION_COMMAND,
        ];
        use State as S;
        let [disabled, ready, on] = [S::SwitchOnDisabled, S::ReadyToSwitchOn, S::SwitchedOn];
        for (raw, expected) in [
            (0x0000, [S::NotReadyToSwitchOn; 5]),
            (0x4000, [disabled; 5]),
            (0x8000, [disabled, disabled, ready, on, on]),
            (
                0xc008,
                [
                    S::OperationEnabled,
                    S::QuickStopActive,
                    S::OperationEnabled,
                    S::OperationEnabled,
                    S::OperationEnabled,
                ],
            ),
            (0xe000, [S::FaultReactionActive; 5]),
            (0xa000, [S::Fault; 5]),
            (0x2000, [S::Fault; 5]),
            (0x6000, [S::Fault; 5]),
        ] {
            for (command, expected) in commands.into_iter().zip(expected) {
                let mut words = DriveWords::Sercos(SercosWords::new(true));
                words.control(command.bits());
                assert_eq!(state(&mut words, raw), expected, "{raw:#06x} {command}");
            }
        }
    }

    #[test]
    fn other_bits_of_the_status_word() {
        let mut words = DriveWords::Sercos(SercosWords::new(true));
        words.control(0x000f);
        let status =
            |words: &mut DriveWords, raw| Statusword::from_bits_retain(words.statusword(raw));
        assert!(status(&mut words, 0xc008).contains(Statusword::FOLLOWS_COMMAND));
        assert!(!status(&mut words, 0xc000).contains(Statusword::FOLLOWS_COMMAND));
        // Another operation mode is active.
        for mode in 1..8 {
            let raw = 0xc008 | mode << 8;
            assert!(!status(&mut words, raw).contains(Statusword::FOLLOWS_COMMAND));
        }
        assert!(status(&mut words, 0xd000).contains(Statusword::WARNING));
        assert!(!status(&mut words, 0x4000).contains(Statusword::VOLTAGE_ENABLED));
        let mut without = DriveWords::Sercos(SercosWords::new(false));
        without.control(0x000f);
        assert!(status(&mut without, 0xc000).contains(Statusword::FOLLOWS_COMMAND));
    }

    /// Torque after "drive on" stays a quick stop until the drive reports that it has none.
    #[test]
    fn torque_after_drive_on_is_a_quick_stop() {
        use Controlword as C;
        for end in [
            C::QUICK_STOP_COMMAND,
            C::SHUTDOWN_COMMAND,
            C::DISABLE_VOLTAGE_COMMAND,
        ] {
            let mut words = DriveWords::Sercos(SercosWords::new(false));
            words.control(C::ENABLE_OPERATION_COMMAND.bits());
            assert_eq!(state(&mut words, 0xc000), State::OperationEnabled);
            for order in [end, C::DISABLE_VOLTAGE_COMMAND, C::ENABLE_OPERATION_COMMAND] {
                words.control(order.bits());
                assert_eq!(state(&mut words, 0xc000), State::QuickStopActive, "{order}");
            }
            assert_ne!(state(&mut words, 0x8000), State::QuickStopActive);
            assert_eq!(state(&mut words, 0xc000), State::OperationEnabled);
        }
    }

    /// A word that replaces one that was not sent has the same toggle bit.
    #[test]
    fn a_replaced_word_toggles_once() {
        let mut words = DriveWords::Sercos(SercosWords::new(true));
        let sent = words.control(0x000f).word;
        let staged = words.control(0x000f).word;
        words.take_back();
        let replaced = words.control(0x0002).word;
        assert_eq!((sent ^ staged) & SYNC, SYNC);
        assert_eq!((staged ^ replaced) & SYNC, 0);
    }

    /// No word of a drive and no command panics, and only "drive on" with "enable" gives torque.
    #[test]
    fn every_word_has_a_state_and_only_enable_operation_switches_on() {
        for word in 0..=u16::MAX {
            let mut words = DriveWords::Sercos(SercosWords::new(word & 1 != 0));
            let sent = words.control(word).word;
            assert_eq!(sent & ON != 0, word & 0x8f == 0x0f, "{word:#06x}");
            assert!(sent & ON == 0 || sent & ENABLE != 0);
            assert!(
                !matches!(state(&mut words, word), State::Unknown(_)),
                "{word:#06x}"
            );
            assert_eq!(DriveWords::Cia402.control(word).word, word);
            assert_eq!(DriveWords::Cia402.statusword(word), word);
        }
    }
}
