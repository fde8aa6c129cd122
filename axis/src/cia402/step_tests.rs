//! The transitions row by row against a reference drive, then every Statusword × every request.

use super::*;

/// A reference drive: the transition table of the standard, by number.
fn drive(state: State, word: Controlword, edge_of_bit_7: bool) -> Option<(u8, State)> {
    let w = word.bits() & 0x000F;
    let is = |mask: u16, value: u16| w & mask == value;
    let disable_voltage = is(0x02, 0x00);
    let quick_stop = is(0x06, 0x02);
    let shutdown = is(0x07, 0x06);
    let switch_on = is(0x0F, 0x07);
    let enable = is(0x0F, 0x0F);
    Some(match state {
        State::SwitchOnDisabled if shutdown => (2, State::ReadyToSwitchOn),
        State::ReadyToSwitchOn if switch_on || enable => (3, State::SwitchedOn),
        State::ReadyToSwitchOn if disable_voltage || quick_stop => (7, State::SwitchOnDisabled),
        State::SwitchedOn if enable => (4, State::OperationEnabled),
        State::SwitchedOn if shutdown => (6, State::ReadyToSwitchOn),
        State::SwitchedOn if disable_voltage || quick_stop => (10, State::SwitchOnDisabled),
        State::OperationEnabled if switch_on => (5, State::SwitchedOn),
        State::OperationEnabled if shutdown => (8, State::ReadyToSwitchOn),
        State::OperationEnabled if disable_voltage => (9, State::SwitchOnDisabled),
        State::OperationEnabled if quick_stop => (11, State::QuickStopActive),
        State::QuickStopActive if disable_voltage => (12, State::SwitchOnDisabled),
        State::QuickStopActive if enable => (16, State::OperationEnabled),
        State::FaultReactionActive => (14, State::Fault),
        State::Fault if edge_of_bit_7 => (15, State::SwitchOnDisabled),
        _ => return None,
    })
}

fn word_of(state: State) -> Statusword {
    Statusword::from_bits_retain(match state {
        State::NotReadyToSwitchOn => 0x0000,
        State::SwitchOnDisabled => 0x0240,
        State::ReadyToSwitchOn => 0x0231,
        State::SwitchedOn => 0x0233,
        State::OperationEnabled => 0x0237,
        State::QuickStopActive => 0x0217,
        State::FaultReactionActive => 0x021F,
        State::Fault => 0x0218,
        State::Unknown(word) => word,
    })
}

const POWERS: [Power; 4] = [
    Power::Disabled,
    Power::Enabled,
    Power::QuickStop,
    Power::Off,
];

fn request(power: Power) -> Request {
    Request {
        power,
        ..Request::default()
    }
}

/// Every state × every request: the Controlword and the resulting transition.
#[test]
fn table_row_by_row() {
    use Power::{Disabled, Enabled, Off, QuickStop};
    use State::*;
    let rows = [
        // The drive makes 0 and 1 itself.
        (NotReadyToSwitchOn, Disabled, 0x0000, None),
        (NotReadyToSwitchOn, Enabled, 0x0000, None),
        (NotReadyToSwitchOn, QuickStop, 0x0000, None),
        (SwitchOnDisabled, Disabled, 0x0000, None),
        (SwitchOnDisabled, Enabled, 0x0006, Some(2)),
        (SwitchOnDisabled, QuickStop, 0x0000, None),
        (ReadyToSwitchOn, Disabled, 0x0000, Some(7)),
        (ReadyToSwitchOn, Enabled, 0x0007, Some(3)),
        (ReadyToSwitchOn, QuickStop, 0x0002, Some(7)),
        (SwitchedOn, Disabled, 0x0006, Some(6)),
        (SwitchedOn, Enabled, 0x000F, Some(4)),
        (SwitchedOn, QuickStop, 0x0002, Some(10)),
        (OperationEnabled, Disabled, 0x0006, Some(8)),
        (OperationEnabled, Enabled, 0x000F, None),
        (OperationEnabled, QuickStop, 0x0002, Some(11)),
        (QuickStopActive, Disabled, 0x0000, Some(12)),
        (QuickStopActive, Enabled, 0x000F, Some(16)),
        (QuickStopActive, QuickStop, 0x0002, None),
        // 13 is a fault; the drive makes 14 itself, with any Controlword.
        (FaultReactionActive, Disabled, 0x0006, Some(14)),
        (FaultReactionActive, Enabled, 0x0006, Some(14)),
        (FaultReactionActive, QuickStop, 0x0006, Some(14)),
        (Fault, Disabled, 0x0000, None),
        (Fault, Enabled, 0x0000, None),
        (Fault, QuickStop, 0x0000, None),
        (NotReadyToSwitchOn, Off, 0x0000, None),
        (SwitchOnDisabled, Off, 0x0000, None),
        (ReadyToSwitchOn, Off, 0x0000, Some(7)),
        (SwitchedOn, Off, 0x0000, Some(10)),
        (OperationEnabled, Off, 0x0000, Some(9)),
        (QuickStopActive, Off, 0x0000, Some(12)),
        (FaultReactionActive, Off, 0x0006, Some(14)),
        (Fault, Off, 0x0000, None),
    ];
    for (state, power, bits, transition) in rows {
        let (_, out) = step(PowerState::new(), word_of(state), request(power), 0.001);
        assert_eq!(out.state, state);
        assert_eq!(out.controlword.bits(), bits, "{state} × {power:?}");
        let taken = drive(state, out.controlword, false).map(|(number, _)| number);
        assert_eq!(taken, transition, "{state} × {power:?}");
    }
}

/// Steps until nothing changes. Returns the transitions and the final state.
fn walk(mut state: State, power: Power, allow_16: bool) -> (Vec<u8>, State) {
    let mut memory = PowerState::new();
    let mut taken = vec![];
    for _ in 0..2000 {
        let (next, out) = step(memory, word_of(state), request(power), 0.001);
        memory = next;
        if let Some((number, after)) = drive(state, out.controlword, false)
            && (number != 16 || allow_16)
        {
            taken.push(number);
            state = after;
        }
    }
    (taken, state)
}

#[test]
fn transitions_lead_to_each_requested_power() {
    use Power::{Disabled, Enabled, QuickStop};
    use State::*;
    for (from, power, path, end) in [
        (SwitchOnDisabled, Enabled, vec![2, 3, 4], OperationEnabled),
        (OperationEnabled, Disabled, vec![8, 7], SwitchOnDisabled),
        (SwitchedOn, Disabled, vec![6, 7], SwitchOnDisabled),
        (QuickStopActive, Disabled, vec![12], SwitchOnDisabled),
        (OperationEnabled, QuickStop, vec![11], QuickStopActive),
        (QuickStopActive, Enabled, vec![16], OperationEnabled),
        (FaultReactionActive, Enabled, vec![14], Fault),
    ] {
        assert_eq!(walk(from, power, true), (path, end), "{from} {power:?}");
    }
    // A drive without transition 16 takes the longer path.
    assert_eq!(
        walk(QuickStopActive, Enabled, false),
        (vec![12, 2, 3, 4], OperationEnabled)
    );
}

#[test]
fn option_code_without_transition_16_skips_it() {
    let ask = Request {
        power: Power::Enabled,
        without_transition_16: true,
        ..Request::default()
    };
    let word = word_of(State::QuickStopActive);
    let (_, out) = step(PowerState::new(), word, ask, 0.001);
    let way = drive(State::QuickStopActive, out.controlword, false);
    assert_eq!(way, Some((12, State::SwitchOnDisabled)));
}

/// Runs a reset with a drive that stays in Fault until it has seen `edges` rising edges.
fn reset_run(edges: u32, dt_s: f64) -> (u32, PowerProgress, Controlword) {
    let mut memory = PowerState::new();
    let mut seen = 0;
    let mut before = Controlword::FAULT_RESET;
    let mut state = State::Fault;
    let mut last = (PowerProgress::Pending, before);
    for _ in 0..10_000 {
        let ask = Request {
            power: Power::Disabled,
            reset_fault: true,
            ..Request::default()
        };
        let (next, out) = step(memory, word_of(state), ask, dt_s);
        memory = next;
        let high = out.controlword.contains(Controlword::FAULT_RESET);
        if high && !before.contains(Controlword::FAULT_RESET) {
            seen += 1;
            if seen == edges {
                state = State::SwitchOnDisabled;
            }
        }
        before = out.controlword;
        last = (out.progress, out.controlword);
    }
    (seen, last.0, last.1)
}

/// Transition 15: at most three edges, each followed by a low bit.
#[test]
fn fault_reset_is_a_bounded_train_of_edges() {
    let low = Controlword::DISABLE_VOLTAGE_COMMAND;
    for dt_s in [0.000_25, 0.001, 0.01, 0.2] {
        assert_eq!(
            reset_run(1, dt_s),
            (1, PowerProgress::Reached, low),
            "{dt_s}"
        );
        assert_eq!(
            reset_run(3, dt_s),
            (3, PowerProgress::Reached, low),
            "{dt_s}"
        );
        assert_eq!(
            reset_run(u32::MAX, dt_s),
            (3, PowerProgress::ResetFailed, low),
            "{dt_s}"
        );
    }
}

#[test]
fn fault_without_reset_stays_low() {
    let mut memory = PowerState::new();
    for _ in 0..1000 {
        let (next, out) = step(
            memory,
            word_of(State::Fault),
            request(Power::Enabled),
            0.001,
        );
        memory = next;
        assert_eq!(out.controlword.bits(), 0);
        assert_eq!(out.progress, PowerProgress::Faulted);
    }
}

#[test]
fn a_second_reset_request_starts_over() {
    let ask = |reset_fault| Request {
        power: Power::Disabled,
        reset_fault,
        ..Request::default()
    };
    let fault = word_of(State::Fault);
    let mut memory = PowerState::new();
    for _ in 0..10 {
        memory = step(memory, fault, ask(true), 0.1).0;
    }
    assert_eq!(
        step(memory, fault, ask(true), 0.1).1.progress,
        PowerProgress::ResetFailed
    );
    memory = step(memory, fault, ask(false), 0.1).0;
    assert_eq!(
        step(memory, fault, ask(true), 0.1).1.progress,
        PowerProgress::ResettingFault
    );
}

#[test]
fn time_in_state_restarts_with_the_state() {
    let mut memory = PowerState::new();
    let word = word_of(State::SwitchedOn);
    for _ in 0..=1000 {
        memory = step(memory, word, request(Power::Disabled), 0.001).0;
    }
    assert!((memory.in_state_s() - 1.0).abs() < 1e-9);
    // Another request does not change the time in the state.
    memory = step(memory, word, request(Power::Enabled), 0.001).0;
    assert!(memory.in_state_s() > 1.0);
    memory = step(
        memory,
        word_of(State::Fault),
        request(Power::Enabled),
        0.001,
    )
    .0;
    assert_eq!(memory.in_state_s(), 0.0);
}

/// All 65,536 Statuswords × every request × unusual times: no panic, and no power without a
/// request.
#[test]
fn no_word_gets_power_without_request() {
    let powering = Controlword::SWITCH_ON | Controlword::ENABLE_OPERATION;
    for bits in 0..=u16::MAX {
        let word = Statusword::from_bits_retain(bits);
        for power in POWERS {
            for reset_fault in [false, true] {
                let ask = Request {
                    power,
                    reset_fault,
                    without_transition_16: bits & 1 == 0,
                    quick_stop_ends: bits & 2 == 0,
                    hold: false,
                };
                let mut memory = PowerState::new();
                for dt_s in [0.001, 0.06, 0.6, f64::NAN, -1.0, f64::INFINITY] {
                    let (next, out) = step(memory, word, ask, dt_s);
                    memory = next;
                    if power != Power::Enabled {
                        assert!(!out.controlword.intersects(powering), "{bits:#06x} {ask:?}");
                    }
                    if !(out.state == State::Fault && reset_fault) {
                        assert!(!out.controlword.contains(Controlword::FAULT_RESET));
                    }
                    let enabling = Controlword::ENABLE_OPERATION;
                    if out.controlword.contains(enabling) {
                        assert!(matches!(
                            out.state,
                            State::SwitchedOn | State::OperationEnabled | State::QuickStopActive
                        ));
                    }
                }
            }
        }
    }
}
