//! Mode-specific bits: 4–6 and 8 of the Controlword; 10, 12 and 13 of the Statusword (CiA 402-2,
//! tables of each mode).

use super::mode::Mode;
use super::words::{Controlword, Statusword};

/// The mode-specific bits of a Statusword.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum ModeStatus {
    Pp {
        /// Bit 10. With halt: the axis stands.
        target_reached: bool,
        /// Bit 12: the drive has accepted the set-point.
        acknowledged: bool,
        /// Bit 13.
        following_error: bool,
    },
    Pv {
        /// Bit 10. With halt: the axis stands.
        target_reached: bool,
        /// Bit 12.
        zero_speed: bool,
        /// Bit 13: maximum slippage reached.
        slipping: bool,
    },
    Hm(HomingState),
    Csp {
        /// Bit 12: the drive follows the target position.
        follows: bool,
        /// Bit 13.
        following_error: bool,
    },
    Csv {
        /// Bit 12: the drive follows the target velocity.
        follows: bool,
    },
    Cst {
        /// Bit 12: the drive follows the target torque.
        follows: bool,
    },
    /// A mode without known bits.
    Other,
}

/// Homing state: bits 13, 12 and 10.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum HomingState {
    /// 000.
    InProgress,
    /// 001: not started or interrupted.
    NotStarted,
    /// 010: home found, the axis still moves to its target.
    AttainedNotReached,
    /// 011.
    Completed,
    /// 100: the axis still moves.
    ErrorMoving,
    /// 101: the axis stands.
    ErrorStanding,
    /// 11x.
    Reserved,
}

impl HomingState {
    #[must_use]
    pub const fn is_error(self) -> bool {
        matches!(
            self,
            Self::ErrorMoving | Self::ErrorStanding | Self::Reserved
        )
    }

    #[must_use]
    pub const fn is_attained(self) -> bool {
        matches!(self, Self::AttainedNotReached | Self::Completed)
    }
}

impl Statusword {
    /// Decodes bits 10, 12 and 13 for the mode that 0x6061 shows.
    #[must_use]
    pub(crate) const fn in_mode(self, mode: Mode) -> ModeStatus {
        let reached = self.contains(Self::TARGET_REACHED);
        let bit_12 = self.contains(Self::FOLLOWS_COMMAND);
        let bit_13 = self.contains(Self::FOLLOWING_ERROR);
        match mode {
            Mode::Pp => ModeStatus::Pp {
                target_reached: reached,
                acknowledged: bit_12,
                following_error: bit_13,
            },
            Mode::Pv => ModeStatus::Pv {
                target_reached: reached,
                zero_speed: bit_12,
                slipping: bit_13,
            },
            Mode::Hm => ModeStatus::Hm(match (bit_13, bit_12, reached) {
                (false, false, false) => HomingState::InProgress,
                (false, false, true) => HomingState::NotStarted,
                (false, true, false) => HomingState::AttainedNotReached,
                (false, true, true) => HomingState::Completed,
                (true, false, false) => HomingState::ErrorMoving,
                (true, false, true) => HomingState::ErrorStanding,
                (true, true, _) => HomingState::Reserved,
            }),
            Mode::Csp => ModeStatus::Csp {
                follows: bit_12,
                following_error: bit_13,
            },
            Mode::Csv => ModeStatus::Csv { follows: bit_12 },
            Mode::Cst => ModeStatus::Cst { follows: bit_12 },
            Mode::Unknown(_) => ModeStatus::Other,
        }
    }
}

/// The mode-specific bits of a Controlword.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub(crate) enum ModeCommand {
    /// All bits are 0, as in all cyclic modes.
    #[default]
    Nothing,
    Pp {
        /// Bit 4, acts on its rising edge.
        new_set_point: bool,
        /// Bit 5: replace the active set-point instead of finishing it first.
        change_at_once: bool,
        /// Bit 6.
        relative: bool,
        /// Bit 8.
        halt: bool,
    },
    Pv {
        /// Bit 8.
        halt: bool,
    },
    Hm {
        /// Bit 4: homing continues while it is 1.
        start: bool,
        /// Bit 8.
        halt: bool,
    },
}

impl Controlword {
    /// Bit 4 in PP.
    pub(crate) const NEW_SET_POINT: Self = Self::from_bits_retain(1 << 4);
    /// Bit 4 in HM.
    pub(crate) const START_HOMING: Self = Self::from_bits_retain(1 << 4);
    /// Bit 5 in PP.
    pub(crate) const CHANGE_AT_ONCE: Self = Self::from_bits_retain(1 << 5);
    /// Bit 6 in PP.
    pub(crate) const RELATIVE: Self = Self::from_bits_retain(1 << 6);

    /// Replaces the mode-specific bits by those of `command`. Other bits remain.
    #[must_use]
    pub(crate) fn with(self, command: ModeCommand) -> Self {
        let set = |bit: Self, on: bool| if on { bit } else { Self::empty() };
        self | match command {
            ModeCommand::Nothing => Self::empty(),
            ModeCommand::Pp {
                new_set_point,
                change_at_once,
                relative,
                halt,
            } => {
                set(Self::NEW_SET_POINT, new_set_point)
                    | set(Self::CHANGE_AT_ONCE, change_at_once)
                    | set(Self::RELATIVE, relative)
                    | set(Self::HALT, halt)
            }
            ModeCommand::Pv { halt } => set(Self::HALT, halt),
            ModeCommand::Hm { start, halt } => {
                set(Self::START_HOMING, start) | set(Self::HALT, halt)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn statusword_bits_row_by_row() {
        use HomingState::*;
        let word = |bits: u16| Statusword::from_bits_retain(bits | 0x0237);
        for (on, bit) in [(false, 0), (true, 1)] {
            let at = |n: u32| word(bit << n);
            assert_eq!(
                at(10).in_mode(Mode::Pp),
                ModeStatus::Pp {
                    target_reached: on,
                    acknowledged: false,
                    following_error: false
                }
            );
            assert_eq!(
                at(12).in_mode(Mode::Pp),
                ModeStatus::Pp {
                    target_reached: false,
                    acknowledged: on,
                    following_error: false
                }
            );
            assert_eq!(
                at(13).in_mode(Mode::Pp),
                ModeStatus::Pp {
                    target_reached: false,
                    acknowledged: false,
                    following_error: on
                }
            );
            assert_eq!(
                at(10).in_mode(Mode::Pv),
                ModeStatus::Pv {
                    target_reached: on,
                    zero_speed: false,
                    slipping: false
                }
            );
            assert_eq!(
                at(12).in_mode(Mode::Pv),
                ModeStatus::Pv {
                    target_reached: false,
                    zero_speed: on,
                    slipping: false
                }
            );
            assert_eq!(
                at(13).in_mode(Mode::Pv),
                ModeStatus::Pv {
                    target_reached: false,
                    zero_speed: false,
                    slipping: on
                }
            );
            assert_eq!(
                at(12).in_mode(Mode::Csp),
                ModeStatus::Csp {
                    follows: on,
                    following_error: false
                }
            );
            assert_eq!(
                at(13).in_mode(Mode::Csp),
                ModeStatus::Csp {
                    follows: false,
                    following_error: on
                }
            );
            assert_eq!(at(12).in_mode(Mode::Csv), ModeStatus::Csv { follows: on });
            assert_eq!(at(12).in_mode(Mode::Cst), ModeStatus::Cst { follows: on });
        }
        for (bits, state) in [
            (0x0000, InProgress),
            (0x0400, NotStarted),
            (0x1000, AttainedNotReached),
            (0x1400, Completed),
            (0x2000, ErrorMoving),
            (0x2400, ErrorStanding),
            (0x3000, Reserved),
            (0x3400, Reserved),
        ] {
            assert_eq!(word(bits).in_mode(Mode::Hm), ModeStatus::Hm(state));
        }
        assert_eq!(word(0x3400).in_mode(Mode::Unknown(-1)), ModeStatus::Other);
    }

    /// Only the named bits affect the mode state, and none of them affects the power state.
    #[test]
    fn other_bits_do_not_affect_the_mode_status() {
        for bits in 0..=u16::MAX {
            let word = Statusword::from_bits_retain(bits);
            let bare = Statusword::from_bits_retain(bits & 0x3400);
            for mode in [
                Mode::Pp,
                Mode::Pv,
                Mode::Hm,
                Mode::Csp,
                Mode::Csv,
                Mode::Cst,
            ] {
                assert_eq!(word.in_mode(mode), bare.in_mode(mode));
            }
        }
    }

    #[test]
    fn controlword_bits_row_by_row() {
        let pp = |new_set_point, change_at_once, relative, halt| ModeCommand::Pp {
            new_set_point,
            change_at_once,
            relative,
            halt,
        };
        for (command, bits) in [
            (ModeCommand::Nothing, 0x000F),
            (pp(false, false, false, false), 0x000F),
            (pp(true, false, false, false), 0x001F),
            (pp(false, true, false, false), 0x002F),
            (pp(false, false, true, false), 0x004F),
            (pp(false, false, false, true), 0x010F),
            (pp(true, true, false, false), 0x003F),
            (ModeCommand::Pv { halt: false }, 0x000F),
            (ModeCommand::Pv { halt: true }, 0x010F),
            (
                ModeCommand::Hm {
                    start: true,
                    halt: false,
                },
                0x001F,
            ),
            (
                ModeCommand::Hm {
                    start: true,
                    halt: true,
                },
                0x011F,
            ),
        ] {
            let word = Controlword::ENABLE_OPERATION_COMMAND.with(command);
            assert_eq!(word.bits(), bits, "{command:?}");
        }
    }
}
