//! Mode switches, at rest and in motion.

use crate::common::{DT, Drive, LIMITS, Rig, looped, scale};
use ecaxis_axis::{
    Axis, AxisConfig, Command, CommandError, Limits, Loops, Mode, Modes, State, Trip,
};

const COUNTS_PER_UNIT: f64 = 400.0;

/// Lower limits: with torque at the limit of [`LIMITS`] this drive would not reach 2000 mm/s².
const SLOW: Limits = Limits {
    position: None,
    velocity: 200.0,
    acceleration: 100.0,
    torque: 100.0,
    following_error: Some(1.0),
    ..LIMITS
};

fn enabled(config: AxisConfig) -> Rig {
    let mut rig = Rig::new(Axis::new(config).unwrap(), Drive::at(1000));
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 100);
    rig
}

/// The same modes without position loops.
fn plain(mode: Mode, limits: Limits) -> AxisConfig {
    AxisConfig {
        loops: Loops::default(),
        ..looped(mode, limits)
    }
}

const fn to(position: f64) -> Command {
    Command::MoveTo {
        position,
        speed: 1.0,
        ramp: 1.0,
    }
}

const fn run_at(velocity: f64) -> Command {
    Command::Velocity {
        velocity,
        ramp: 1.0,
    }
}

/// At constant velocity through all modes: neither the set-point nor the drive's motion steps.
#[test]
fn velocity_continues_through_all_modes() {
    for delay in [0, 1, 7, 40] {
        let mut rig = enabled(looped(Mode::Csp, SLOW));
        rig.drive.mode_delay = Some(delay);
        rig.axis.command(run_at(60.0)).unwrap();
        rig.until(|s| s.in_target, 2000);
        let (mut before, mut velocity) = (rig.axis.status(), 60.0);
        let mut switches = 0;
        for mode in [
            Mode::Csv,
            Mode::Cst,
            Mode::Csp,
            Mode::Cst,
            Mode::Csv,
            Mode::Csp,
        ] {
            rig.axis.command(Command::SetMode(mode)).unwrap();
            assert_eq!(
                rig.axis.command(to(0.0)),
                Err(CommandError::Switching { to: mode })
            );
            for _ in 0..300 {
                let real = rig.drive.position;
                let status = rig.cycle();
                let step = status.target_position - before.target_position;
                assert!(
                    (step / DT - 60.0).abs() < 1e-6,
                    "{mode}: set-point steps by {step}"
                );
                let moved = (rig.drive.position - real) / COUNTS_PER_UNIT / DT;
                // One cycle of the acceleration limit, plus rounding to counts.
                let most = SLOW.acceleration * DT + 2.0 / COUNTS_PER_UNIT / DT;
                assert!(
                    (moved - velocity).abs() <= most,
                    "{mode}: from {velocity} to {moved}"
                );
                velocity = moved;
                switches += u32::from(status.mode != before.mode);
                before = status;
            }
            let status = rig.axis.status();
            assert_eq!(
                (status.mode, status.switching, status.trip),
                (mode, None, None)
            );
            assert!(status.in_target && status.guarded_cycles == 0);
        }
        assert_eq!(switches, 6);
    }
}

#[test]
fn a_move_goes_on_through_a_switch() {
    let mut rig = enabled(looped(Mode::Csp, SLOW));
    rig.axis.command(to(80.0)).unwrap();
    rig.run(700);
    for mode in [Mode::Cst, Mode::Csv, Mode::Csp] {
        rig.axis.command(Command::SetMode(mode)).unwrap();
        rig.run(100);
    }
    let status = rig.until(|s| s.in_target && s.at_rest, 3000);
    assert_eq!((status.mode, status.trip), (Mode::Csp, None));
    assert_eq!(status.final_error_counts, Some(0));
}

/// One cycle too early or too late would be a step of 0.06 mm. The command may arrive before or
/// after the inputs.
#[test]
fn position_starts_where_the_axis_will_be() {
    for before_the_inputs in [false, true] {
        let mut rig = enabled(plain(Mode::Csv, SLOW));
        rig.axis.command(run_at(60.0)).unwrap();
        rig.until(|s| s.in_target, 2000);
        let switch = Command::SetMode(Mode::Csp);
        if before_the_inputs {
            rig.axis.command(switch).unwrap();
        } else {
            let inputs = rig.drive.inputs();
            rig.drive.cycle(&rig.out, DT);
            rig.axis.observe(&inputs, DT);
            rig.axis.command(switch).unwrap();
            rig.out = rig.axis.act();
        }
        for _ in 0..20 {
            let status = rig.run(1);
            assert!(status.following_error.abs() < 0.02, "{status:?}");
        }
        assert_eq!(rig.axis.status().mode, Mode::Csp);
    }
}

/// A mode without a position loop cannot execute a move: the axis decelerates from its velocity or
/// torque.
#[test]
fn modes_without_loops_end_a_move() {
    let mut rig = enabled(plain(Mode::Csp, SLOW));
    rig.axis.command(to(80.0)).unwrap();
    rig.run(500);
    rig.axis.command(Command::SetMode(Mode::Csv)).unwrap();
    let status = rig.until(|s| s.mode == Mode::Csv, 10);
    assert!((status.target_velocity - 50.0).abs() < 1.0);
    assert!(
        rig.out.target_velocity > 49 * 12_000,
        "the axis brakes from where it is"
    );
    assert!(matches!(
        rig.axis.command(to(0.0)),
        Err(CommandError::WrongMode { .. })
    ));
    rig.axis.command(run_at(30.0)).unwrap();
    rig.until(|s| s.in_target, 500);

    // The torque starts at the drive's torque and decreases.
    let mut inputs = rig.drive.inputs();
    rig.axis.command(Command::SetMode(Mode::Cst)).unwrap();
    inputs.torque = Some(150);
    rig.out = rig.axis.step(&inputs, DT);
    assert_eq!(rig.out.target_torque, 150);
    assert_eq!(rig.out.target_velocity, 30 * 12_000, "still in force");
    inputs.mode_display = Some(Mode::Cst.code());
    rig.out = rig.axis.step(&inputs, DT);
    assert_eq!(rig.out.target_torque, 140);
    assert_eq!(
        (rig.out.target_velocity, rig.axis.status().mode),
        (0, Mode::Cst)
    );
    rig.run(20);
    assert_eq!(rig.out.target_torque, 0);

    // Back to positions in motion: from the present position and velocity to rest.
    rig.axis.command(Command::SetMode(Mode::Csp)).unwrap();
    let mut last = rig.drive.position;
    let mut velocity = rig.drive.velocity / COUNTS_PER_UNIT;
    while rig.axis.status().moving || rig.axis.status().switching.is_some() {
        let status = rig.cycle();
        let moved = (rig.drive.position - last) / COUNTS_PER_UNIT / DT;
        let most = SLOW.acceleration * DT + 2.0 / COUNTS_PER_UNIT / DT;
        assert!(
            (moved - velocity).abs() <= most,
            "from {velocity} to {moved}"
        );
        (last, velocity) = (rig.drive.position, moved);
        assert_eq!(status.trip, None);
    }
    assert!(rig.run(10).at_rest);
}

#[test]
fn a_stop_ends_a_torque_at_the_position_it_led_to() {
    let mut rig = enabled(looped(Mode::Cst, SLOW));
    let torque = Command::Torque {
        percent: 20.0,
        ramp_s: 0.1,
    };
    rig.axis.command(torque).unwrap();
    let status = rig.run(1000);
    assert!(status.velocity > 30.0 && status.in_target);
    let torque_before = status.target_torque;
    rig.axis.command(Command::Stop).unwrap();
    let status = rig.cycle();
    assert!((status.target_velocity - status.velocity).abs() < 1.0);
    // Acceleration and torque change their sign; the integral keeps its start value.
    assert!((status.target_torque - torque_before).abs() <= 0.4 * SLOW.acceleration + 1.0);
    let status = rig.until(|s| s.in_target && s.at_rest, 2000);
    assert_eq!(status.trip, None);
    assert!(status.max_following_error < 0.2);
}

#[test]
fn mode_that_is_not_displayed_keeps_the_old_mode() {
    let mut rig = enabled(looped(Mode::Csp, SLOW));
    rig.axis.command(to(80.0)).unwrap();
    rig.run(100);
    rig.drive.mode_delay = None;
    rig.axis.command(Command::SetMode(Mode::Csv)).unwrap();
    let status = rig.run(999);
    assert_eq!(status.switching, Some(Mode::Csv));
    assert_eq!(rig.out.mode, 9);
    let status = rig.run(10);
    assert_eq!(
        (status.switching, status.switch_failed),
        (None, Some(Mode::Csv))
    );
    assert_eq!((status.mode, rig.out.mode), (Mode::Csp, 8));
    rig.until(|s| s.in_target, 3000);
    // A second attempt may succeed.
    rig.drive.mode_delay = Some(3);
    rig.axis.command(Command::SetMode(Mode::Csv)).unwrap();
    let status = rig.until(|s| s.mode == Mode::Csv, 20);
    assert_eq!((status.switch_failed, status.trip), (None, None));
}

#[test]
fn third_mode_trips() {
    let mut rig = enabled(looped(Mode::Csp, SLOW));
    rig.axis.command(Command::SetMode(Mode::Csv)).unwrap();
    let mut inputs = rig.drive.inputs();
    inputs.mode_display = Some(1);
    rig.axis.step(&inputs, DT);
    assert!(matches!(
        rig.axis.status().trip,
        Some(Trip::ModeLost {
            display: Mode::Pp,
            ..
        })
    ));
}

#[test]
fn rejected_modes_give_a_reason() {
    let mut rig = enabled(AxisConfig::new(Mode::Csp, scale(), SLOW));
    for mode in [Mode::Csv, Mode::Unknown(-3), Mode::Unknown(0)] {
        assert_eq!(
            rig.axis.command(Command::SetMode(mode)),
            Err(CommandError::ModeNotOffered { mode })
        );
    }
    assert_eq!(rig.axis.command(Command::SetMode(Mode::Csp)), Ok(()));
    let mut rig = enabled(looped(Mode::Csp, SLOW));
    let mut inputs = rig.drive.inputs();
    inputs.mode_display = None;
    rig.axis.step(&inputs, DT);
    assert_eq!(
        rig.axis.command(Command::SetMode(Mode::Csv)),
        Err(CommandError::NoModeDisplay)
    );
    rig.axis.command(Command::QuickStop).unwrap();
    assert_eq!(
        rig.axis.command(Command::SetMode(Mode::Csv)),
        Err(CommandError::Stopping)
    );
}

#[test]
fn a_mode_may_be_chosen_before_enabling() {
    let config = AxisConfig {
        modes: Modes::only(Mode::Csp).with(Mode::Csv),
        ..AxisConfig::new(Mode::Csp, scale(), LIMITS)
    };
    let mut rig = Rig::new(Axis::new(config).unwrap(), Drive::at(0));
    rig.axis.command(Command::SetMode(Mode::Csv)).unwrap();
    rig.axis.command(Command::Enable).unwrap();
    let status = rig.until(|s| s.ready, 20);
    assert_eq!((status.mode, rig.out.mode), (Mode::Csv, 9));
}

#[test]
fn fault_during_a_switch_ends_the_switch() {
    let mut rig = enabled(looped(Mode::Csp, SLOW));
    rig.axis.command(run_at(60.0)).unwrap();
    rig.run(500);
    rig.drive.mode_delay = Some(20);
    rig.axis.command(Command::SetMode(Mode::Cst)).unwrap();
    rig.run(5);
    rig.drive.fault();
    let status = rig.until(|s| s.state == State::Fault, 5);
    assert_eq!((status.switching, status.enabled), (None, false));
    assert_eq!((rig.out.target_velocity, rig.out.target_torque), (0, 0));
    rig.axis.command(Command::ResetFault).unwrap();
    // It still coasts.
    rig.run(50);
    rig.axis.command(Command::Enable).unwrap();
    let status = rig.until(|s| s.ready, 400);
    assert_eq!(status.mode, Mode::Cst);
    assert_eq!(rig.run(100).trip, None);
}

#[test]
fn disable_voltage_acts_at_once() {
    let mut rig = enabled(looped(Mode::Csp, SLOW));
    rig.axis.command(run_at(60.0)).unwrap();
    rig.run(300);
    rig.axis.command(Command::DisableVoltage).unwrap();
    rig.cycle();
    assert_eq!(rig.out.controlword, 0);
    let status = rig.until(|s| s.state == State::SwitchOnDisabled, 5);
    assert_eq!(status.trip, None);
    let coasts = rig.axis.command(Command::Enable);
    assert!(matches!(coasts, Err(CommandError::StillMoving { .. })));
    rig.run(50);
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 20);
}
