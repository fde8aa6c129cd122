//! CiA 402 transitions 0–16 and the Statusword's masks, row by row.

use super::*;
use State as S;

/// Returns a drive in the state, with the option codes written, ready for the next Controlword.
fn brought_to(state: State, options: &[(u16, i64)]) -> Rig {
    let mut rig = Rig::new(PlantParams {
        enable_cycles: 0,
        ..PlantParams::default()
    });
    for (index, value) in options {
        rig.set(*index, 0, *value);
    }
    if state == S::NotReadyToSwitchOn {
        return rig;
    }
    for _ in 0..10 {
        rig.step(0x00);
    }
    let words: &[i64] = match state {
        S::SwitchOnDisabled => &[],
        S::ReadyToSwitchOn => &[0x06],
        S::SwitchedOn => &[0x06, 0x07],
        S::OperationEnabled => &[0x06, 0x07, 0x0f],
        S::QuickStopActive => &[0x06, 0x07, 0x0f, 0x0b],
        _ => {
            rig.drive.inject_fault(0x2310);
            assert_eq!(rig.drive.state(), S::FaultReactionActive);
            &[0x00]
        }
    };
    for word in words {
        rig.step(*word);
    }
    assert_eq!(rig.drive.state(), state);
    rig
}

#[test]
fn transitions_row_by_row() {
    let rows = [
        (2, S::SwitchOnDisabled, 0x06, S::ReadyToSwitchOn),
        (3, S::ReadyToSwitchOn, 0x07, S::SwitchedOn),
        (3, S::ReadyToSwitchOn, 0x0f, S::SwitchedOn),
        (4, S::SwitchedOn, 0x0f, S::OperationEnabled),
        (6, S::SwitchedOn, 0x06, S::ReadyToSwitchOn),
        (7, S::ReadyToSwitchOn, 0x00, S::SwitchOnDisabled),
        (7, S::ReadyToSwitchOn, 0x02, S::SwitchOnDisabled),
        (8, S::OperationEnabled, 0x06, S::ReadyToSwitchOn),
        (9, S::OperationEnabled, 0x00, S::SwitchOnDisabled),
        (10, S::SwitchedOn, 0x00, S::SwitchOnDisabled),
        (10, S::SwitchedOn, 0x02, S::SwitchOnDisabled),
        (11, S::OperationEnabled, 0x02, S::QuickStopActive),
        (11, S::OperationEnabled, 0x0b, S::QuickStopActive),
        (12, S::QuickStopActive, 0x00, S::SwitchOnDisabled),
        (15, S::Fault, 0x80, S::SwitchOnDisabled),
        (16, S::QuickStopActive, 0x0f, S::OperationEnabled),
    ];
    for (number, from, word, to) in rows {
        let mut rig = brought_to(from, &[]);
        assert_eq!(rig.step(word), to, "transition {number} by 0x{word:02x}");
    }
}

#[test]
fn transition_1_follows_the_self_test_and_5_its_ramp() {
    let mut rig = rig();
    assert_eq!(rig.drive.state(), S::NotReadyToSwitchOn);
    assert_eq!(rig.word() & 0x4f, 0x00);
    for _ in 0..5 {
        rig.step(0x06);
    }
    assert_eq!(rig.drive.state(), S::SwitchOnDisabled);

    let mut rig = brought_to(S::OperationEnabled, &[]);
    assert_eq!(rig.step(0x07), S::OperationEnabled);
    for _ in 0..3 {
        rig.step(0x07);
    }
    assert_eq!(rig.drive.state(), S::SwitchedOn);
}

#[test]
fn transitions_13_and_14_from_every_state() {
    for from in [
        S::NotReadyToSwitchOn,
        S::SwitchOnDisabled,
        S::ReadyToSwitchOn,
        S::SwitchedOn,
        S::OperationEnabled,
        S::QuickStopActive,
    ] {
        let mut rig = brought_to(from, &[]);
        rig.drive.inject_fault(0x4210);
        assert_eq!(rig.drive.state(), S::FaultReactionActive, "{from:?}");
        for _ in 0..4 {
            rig.step(0x0f);
        }
        assert_eq!(rig.drive.state(), S::Fault, "{from:?}");
        assert_eq!(rig.word() & 0x4f, 0x08);
    }
}

#[test]
fn state_machine_ignores_other_controlwords() {
    let stays = [
        (S::SwitchOnDisabled, 0x00),
        (S::SwitchOnDisabled, 0x02),
        (S::SwitchOnDisabled, 0x07),
        (S::SwitchOnDisabled, 0x0f),
        (S::SwitchOnDisabled, 0x86),
        (S::ReadyToSwitchOn, 0x06),
        (S::ReadyToSwitchOn, 0x8f),
        (S::SwitchedOn, 0x07),
        (S::OperationEnabled, 0x0f),
        (S::QuickStopActive, 0x02),
        (S::QuickStopActive, 0x06),
        (S::Fault, 0x0f),
        (S::Fault, 0x00),
        (S::Fault, 0x06),
    ];
    for (state, word) in stays {
        let mut rig = brought_to(state, &[]);
        assert_eq!(rig.step(word), state, "0x{word:02x}");
        assert_eq!(rig.step(word), state, "0x{word:02x} again");
    }
}

#[test]
fn statusword_matches_mask_and_value_in_every_state() {
    let rows = [
        (S::NotReadyToSwitchOn, 0x4f, 0x00),
        (S::SwitchOnDisabled, 0x4f, 0x40),
        (S::ReadyToSwitchOn, 0x6f, 0x21),
        (S::SwitchedOn, 0x6f, 0x23),
        (S::OperationEnabled, 0x6f, 0x27),
        (S::QuickStopActive, 0x6f, 0x07),
        (S::Fault, 0x4f, 0x08),
    ];
    for (state, mask, value) in rows {
        let rig = brought_to(state, &[]);
        assert_eq!(rig.word() & mask, value, "{state:?}");
    }
}

/// Bits 4 (voltage enabled), 7 (warning), 9 (remote) and 11 (internal limit).
#[test]
fn statusword_other_bits_by_state() {
    let rows = [
        (S::NotReadyToSwitchOn, 0),
        (S::SwitchOnDisabled, 0),
        (S::ReadyToSwitchOn, 0),
        (S::SwitchedOn, 1 << 4),
        (S::OperationEnabled, 1 << 4),
        (S::QuickStopActive, 1 << 4),
        (S::Fault, 0),
    ];
    for (state, voltage) in rows {
        let mut rig = brought_to(state, &[]);
        rig.drive.control(&mut rig.store, true);
        assert_eq!(rig.drive.state(), state);
        assert_eq!(rig.word() & 0x0a90, voltage | 1 << 9, "{state:?}");
        rig.drive.control(&mut rig.store, false);
        assert_eq!(rig.word() & 1 << 9, 0, "{state:?}: not remote");
    }
}

#[test]
fn quick_stop_options() {
    for (option, end) in [
        (1, S::SwitchOnDisabled),
        (2, S::SwitchOnDisabled),
        (5, S::QuickStopActive),
        (6, S::QuickStopActive),
    ] {
        let mut rig = brought_to(S::OperationEnabled, &[(0x605a, option)]);
        assert_eq!(rig.step(0x02), S::QuickStopActive, "option {option}");
        for _ in 0..5 {
            rig.step(0x02);
        }
        assert_eq!(rig.drive.state(), end, "option {option}");
        assert_eq!(rig.drive.power_on(), end == S::QuickStopActive);
    }
}

#[test]
fn held_states_are_never_left() {
    let mut rig = brought_to(S::SwitchOnDisabled, &[]);
    rig.drive.hold_in(Some(S::SwitchOnDisabled));
    for word in [0x06, 0x07, 0x0f] {
        assert_eq!(rig.step(word), S::SwitchOnDisabled);
    }
    rig.drive.inject_fault(0x2310);
    assert_eq!(rig.step(0x06), S::SwitchOnDisabled);
    assert_eq!(rig.get(0x603f), 0);
    rig.drive.hold_in(None);
    assert_eq!(rig.step(0x06), S::ReadyToSwitchOn);

    let mut rig = brought_to(S::SwitchedOn, &[]);
    rig.drive.hold_in(Some(S::OperationEnabled));
    assert_eq!(rig.step(0x0f), S::OperationEnabled);
    for word in [0x00, 0x02, 0x06] {
        assert_eq!(rig.step(word), S::OperationEnabled);
    }
}

#[test]
fn enabling_waits_for_the_output_stage() {
    let mut rig = rig();
    for word in [0, 0, 0, 0, 0, 0x06, 0x07] {
        rig.step(word);
    }
    let waited = (0..100).take_while(|_| rig.step(0x0f) != S::OperationEnabled);
    assert_eq!(waited.count(), 10);
}
