//! All 65,536 Statuswords × every command × every mode: idle, enabled, and during a move, a mode
//! switch or a homing.

use crate::common::{DT, Drive, LIMITS, Rig, all};
use ecaxis_axis::{Axis, Command, Edge, Inputs, Mode, Probe, Source, State};

const MODES: [Mode; 5] = [Mode::Csp, Mode::Csv, Mode::Cst, Mode::Pp, Mode::Pv];

const COMMANDS: [Option<Command>; 17] = [
    None,
    Some(Command::Enable),
    Some(Command::Disable),
    Some(Command::ResetFault),
    Some(Command::Stop),
    Some(Command::QuickStop),
    Some(Command::EmergencyStop),
    Some(Command::DisableVoltage),
    Some(Command::SetMode(Mode::Csp)),
    Some(Command::SetMode(Mode::Cst)),
    Some(Command::SetMode(Mode::Pv)),
    Some(Command::Home { timeout_s: 1.0 }),
    Some(Command::ArmProbe {
        probe: Probe::Second,
        edge: Edge::Negative,
        source: Source::ZeroImpulse,
        stop: false,
    }),
    Some(Command::MoveTo {
        position: 10.0,
        speed: 1.0,
        ramp: 1.0,
    }),
    Some(Command::MoveBy {
        distance: -1.0,
        speed: 1.0,
        ramp: 1.0,
    }),
    Some(Command::Velocity {
        velocity: 10.0,
        ramp: 1.0,
    }),
    Some(Command::Torque {
        percent: 10.0,
        ramp_s: 0.1,
    }),
];

/// Bits 0 and 3: switch on, enable operation.
const POWERING: u16 = 0x0009;

fn idle(mode: Mode) -> Rig {
    Rig::new(Axis::new(all(mode, LIMITS)).unwrap(), Drive::at(0))
}

#[test]
fn no_power_without_a_command() {
    for mode in MODES {
        let rig = idle(mode);
        for command in COMMANDS {
            for statusword in 0..=u16::MAX {
                let mut axis = rig.axis.clone();
                let taken = command.is_none_or(|command| axis.command(command).is_ok());
                let inputs = Inputs {
                    statusword,
                    ..rig.drive.inputs()
                };
                for _ in 0..2 {
                    let out = axis.step(&inputs, DT);
                    if command != Some(Command::Enable) || !taken {
                        assert_eq!(
                            out.controlword & POWERING,
                            0,
                            "{mode} {statusword:#06x} {command:?}"
                        );
                    }
                }
            }
        }
    }
}

/// An enabled axis with any Statusword: power bits are sent only in Operation enabled; otherwise
/// targets equal the actual position.
#[test]
fn lost_power_is_not_requested_again() {
    for mode in MODES {
        let mut rig = idle(mode);
        rig.axis.command(Command::Enable).unwrap();
        rig.until(|s| s.ready, 100);
        for command in COMMANDS {
            for statusword in 0..=u16::MAX {
                let inputs = Inputs {
                    statusword,
                    ..rig.drive.inputs()
                };
                let mut axis = rig.axis.clone();
                let _ = command.map(|command| axis.command(command));
                let out = axis.step(&inputs, DT);
                if axis.status().state != State::OperationEnabled {
                    assert_eq!(
                        out.controlword & POWERING,
                        0,
                        "{mode} {statusword:#06x} {command:?}"
                    );
                    assert_eq!(Some(out.target_position), inputs.position);
                    assert_eq!((out.target_velocity, out.target_torque), (0, 0));
                }
            }
        }
    }
}

/// During a profile move, a mode switch and a homing.
#[test]
fn any_word_during_a_move_switch_or_homing_is_handled() {
    let under_way = |mode: Mode, command: Command, cycles: u32| {
        let mut rig = idle(mode);
        rig.axis.command(Command::Enable).unwrap();
        rig.until(|s| s.ready, 100);
        rig.drive.mode_delay = Some(5);
        rig.axis.command(command).unwrap();
        rig.run(cycles);
        rig
    };
    let go = Command::MoveTo {
        position: 40.0,
        speed: 1.0,
        ramp: 1.0,
    };
    let home = Command::Home { timeout_s: 5.0 };
    for rig in [
        under_way(Mode::Pp, go, 1),
        under_way(Mode::Pp, go, 100),
        under_way(Mode::Csp, Command::SetMode(Mode::Cst), 3),
        under_way(Mode::Csp, home, 3),
        under_way(Mode::Csp, home, 9),
        under_way(Mode::Csp, home, 100),
    ] {
        for statusword in 0..=u16::MAX {
            let inputs = Inputs {
                statusword,
                ..rig.drive.inputs()
            };
            let mut axis = rig.axis.clone();
            for _ in 0..4 {
                let out = axis.step(&inputs, DT);
                let status = axis.status();
                if status.state != State::OperationEnabled {
                    assert_eq!(out.controlword & POWERING, 0, "{statusword:#06x}");
                    assert_eq!(out.controlword & 0x0170, 0, "{statusword:#06x}");
                }
                // "Attained" alone has no effect before homing has started.
                assert!(!status.homed() || rig.drive.mode == Mode::Hm.code());
            }
        }
    }
}
