//! Switching modes, at rest and in motion.

mod common;

use common::{DT, Drive, LIMITS, Rig, looped, scale};
use ecaxis_axis::{Axis, AxisConfig, Command, Limits, Loops, Mode, Modes, Refused, State, Trip};

const COUNTS_PER_UNIT: f64 = 400.0;

/// This drive's torque at the limit of [`LIMITS`] would not do 2000 mm/s².
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

/// The same modes without loops.
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

/// In motion, at constant velocity, once around: neither the set-point nor what the drive makes of it steps.
#[test]
fn once_around_in_motion() {
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
                Err(Refused::Switching { to: mode })
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
                // One cycle of the acceleration limit, and rounding to counts.
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

/// A cycle too early or too late is a step of 0.06 mm. The command may come before the inputs or after them.
#[test]
fn a_position_begins_where_the_axis_will_be() {
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

/// A mode without a loop cannot carry out a move: it comes to rest, from the velocity or torque that there is.
#[test]
fn into_modes_without_loops() {
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
        Err(Refused::WrongMode { .. })
    ));
    rig.axis.command(run_at(30.0)).unwrap();
    rig.until(|s| s.in_target, 500);

    // Torque starts with the torque that the drive has, and goes away.
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

    // Back to positions, still turning: from where the axis is, at its velocity, to rest.
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
    // The acceleration changes sign, and the torque with it; the integral starts where it was.
    assert!((status.target_torque - torque_before).abs() <= 0.4 * SLOW.acceleration + 1.0);
    let status = rig.until(|s| s.in_target && s.at_rest, 2000);
    assert_eq!(status.trip, None);
    assert!(status.max_following_error < 0.2);
}

#[test]
fn a_mode_that_does_not_show_leaves_the_old_one() {
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
    // Another try may do better.
    rig.drive.mode_delay = Some(3);
    rig.axis.command(Command::SetMode(Mode::Csv)).unwrap();
    let status = rig.until(|s| s.mode == Mode::Csv, 20);
    assert_eq!((status.switch_failed, status.trip), (None, None));
}

#[test]
fn a_third_mode_is_a_trip() {
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
fn modes_are_refused_with_a_reason() {
    let mut rig = enabled(AxisConfig::new(Mode::Csp, scale(), SLOW));
    for mode in [Mode::Csv, Mode::Unknown(-3), Mode::Unknown(0)] {
        assert_eq!(
            rig.axis.command(Command::SetMode(mode)),
            Err(Refused::ModeNotOffered { mode })
        );
    }
    assert_eq!(rig.axis.command(Command::SetMode(Mode::Csp)), Ok(()));
    let mut rig = enabled(looped(Mode::Csp, SLOW));
    let mut inputs = rig.drive.inputs();
    inputs.mode_display = None;
    rig.axis.step(&inputs, DT);
    assert_eq!(
        rig.axis.command(Command::SetMode(Mode::Csv)),
        Err(Refused::NoModeDisplay)
    );
    rig.axis.command(Command::QuickStop).unwrap();
    assert_eq!(
        rig.axis.command(Command::SetMode(Mode::Csv)),
        Err(Refused::Stopping)
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
fn power_lost_during_a_switch() {
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
    rig.axis.command(Command::Enable).unwrap();
    let status = rig.until(|s| s.ready, 400);
    assert_eq!(status.mode, Mode::Cst);
    assert_eq!(rig.run(100).trip, None);
}

#[test]
fn no_voltage_at_once() {
    let mut rig = enabled(looped(Mode::Csp, SLOW));
    rig.axis.command(run_at(60.0)).unwrap();
    rig.run(300);
    rig.axis.command(Command::DisableVoltage).unwrap();
    rig.cycle();
    assert_eq!(rig.out.controlword, 0);
    let status = rig.until(|s| s.state == State::SwitchOnDisabled, 5);
    assert_eq!(status.trip, None);
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 20);
}
