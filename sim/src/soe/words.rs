//! Master control word (S-0-0134) and drive status word (S-0-0135), seen from the drive.

use crate::drive::State;

const ON: u16 = 1 << 15;
const ENABLE: u16 = 1 << 14;
const RESTART: u16 = 1 << 13;

/// The commands of the power stage.
const NO_VOLTAGE: u16 = 0x00;
const DECELERATE: u16 = 0x02;
const PREPARE: u16 = 0x06;
const CONNECT: u16 = 0x07;
const OPERATE: u16 = 0x0f;
const HALT: u16 = 1 << 8;

/// The drive follows its command values: bit 12 of the power stage's Statusword.
const STAGE_FOLLOWS: u16 = 1 << 12;
const STAGE_WARNS: u16 = 1 << 7;

/// The edge memory of one drive.
#[derive(Debug, Clone, Default)]
pub(super) struct Words {
    last: u16,
    /// A rising edge of "drive on" has switched the drive on.
    on: bool,
}

impl Words {
    /// Returns the command of the power stage. "Drive on" acts on its rising edge; an error, or the
    /// loss of "enable", demands another edge.
    pub(super) fn controlword(&mut self, word: u16, stage: State) -> u16 {
        let rose = word & !self.last & ON != 0;
        self.last = word;
        let is_fault = matches!(stage, State::Fault | State::FaultReactionActive);
        self.on = (self.on || rose) && word & ON != 0 && word & ENABLE != 0 && !is_fault;
        if word & ENABLE == 0 {
            return NO_VOLTAGE;
        }
        if !self.on {
            return match stage {
                State::OperationEnabled | State::QuickStopActive => DECELERATE,
                State::FaultReactionActive => PREPARE,
                _ => NO_VOLTAGE,
            };
        }
        match stage {
            State::SwitchOnDisabled => PREPARE,
            State::ReadyToSwitchOn => CONNECT,
            // The ramp of a falling edge ends first.
            State::QuickStopActive => DECELERATE,
            State::SwitchedOn | State::OperationEnabled if word & RESTART == 0 => OPERATE | HALT,
            State::SwitchedOn | State::OperationEnabled => OPERATE,
            _ => NO_VOLTAGE,
        }
    }

    /// Returns S-0-0135. `change`: the state of a procedure command has changed.
    pub(super) fn status_word(&self, stage: State, statusword: u16, change: bool) -> u16 {
        let mut word = match stage {
            State::NotReadyToSwitchOn => 0,
            State::SwitchOnDisabled | State::ReadyToSwitchOn | State::SwitchedOn => 2 << 14,
            State::OperationEnabled | State::QuickStopActive => 3 << 14,
            State::FaultReactionActive => 3 << 14 | 1 << 13,
            State::Fault => 2 << 14 | 1 << 13,
        };
        let halts = self.last & RESTART == 0;
        let follows = stage == State::OperationEnabled && statusword & STAGE_FOLLOWS != 0;
        for (set, bit) in [
            (follows && self.on && !halts, 3),
            (change, 5),
            (statusword & STAGE_WARNS != 0, 12),
        ] {
            word |= u16::from(set) << bit;
        }
        word
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// IEC 61800-7-204, S-0-0134: bits 13 to 15 in each state of the power stage.
    #[test]
    fn control_words_row_by_row() {
        use State as S;
        let rows = [
            (0x0000, S::OperationEnabled, NO_VOLTAGE),
            (0x2000, S::OperationEnabled, NO_VOLTAGE),
            (0xa000, S::OperationEnabled, NO_VOLTAGE),
            (0x6000, S::OperationEnabled, DECELERATE),
            (0x4000, S::OperationEnabled, DECELERATE),
            (0x6000, S::QuickStopActive, DECELERATE),
            (0x6000, S::SwitchOnDisabled, NO_VOLTAGE),
            (0xe000, S::SwitchOnDisabled, PREPARE),
            (0xe000, S::ReadyToSwitchOn, CONNECT),
            (0xe000, S::SwitchedOn, OPERATE),
            (0xe000, S::OperationEnabled, OPERATE),
            (0xc000, S::OperationEnabled, OPERATE | HALT),
            (0xe000, S::Fault, NO_VOLTAGE),
            (0x6000, S::FaultReactionActive, PREPARE),
        ];
        for (word, stage, expected) in rows {
            let mut words = Words::default();
            assert_eq!(
                words.controlword(word, stage),
                expected,
                "{word:#06x} {stage:?}"
            );
        }
    }

    #[test]
    fn drive_on_acts_on_its_edge() {
        let mut words = Words::default();
        assert_eq!(words.controlword(0xe000, State::OperationEnabled), OPERATE);
        // A fault: the word stays, and the drive stays off.
        words.controlword(0xe000, State::Fault);
        assert_eq!(
            words.controlword(0xe000, State::SwitchOnDisabled),
            NO_VOLTAGE
        );
        words.controlword(0x6000, State::SwitchOnDisabled);
        assert_eq!(words.controlword(0xe000, State::SwitchOnDisabled), PREPARE);
    }

    #[test]
    fn status_words_row_by_row() {
        let mut words = Words::default();
        words.controlword(0xe000, State::SwitchedOn);
        for (stage, statusword, change, expected) in [
            (State::NotReadyToSwitchOn, 0, false, 0x0000),
            (State::SwitchOnDisabled, 0, false, 0x8000),
            (State::SwitchedOn, STAGE_FOLLOWS, false, 0x8000),
            (State::OperationEnabled, 0, false, 0xc000),
            (State::OperationEnabled, STAGE_FOLLOWS, false, 0xc008),
            (State::QuickStopActive, STAGE_FOLLOWS, false, 0xc000),
            (State::FaultReactionActive, 0, false, 0xe000),
            (State::Fault, 0, true, 0xa020),
            (State::Fault, STAGE_WARNS, false, 0xb000),
        ] {
            assert_eq!(
                words.status_word(stage, statusword, change),
                expected,
                "{stage:?}"
            );
        }
        words.controlword(0xc000, State::OperationEnabled);
        assert_eq!(
            words.status_word(State::OperationEnabled, STAGE_FOLLOWS, false),
            0xc000
        );
    }
}
