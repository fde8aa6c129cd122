//! Skipped cycles: no frame was sent, and the drive holds its last outputs.

use crate::common::{DT, Drive, LIMITS, Rig, all};
use ecaxis_axis::{Axis, AxisConfig, Command, Limits, Mode, State};

const COUNTS_PER_UNIT: f64 = 400.0;
const SPEED: f64 = 100.0;
const WAY: f64 = SPEED * DT * COUNTS_PER_UNIT;

/// Tight: half a cycle of velocity more than the delay alone causes.
const TIGHT: Limits = Limits {
    position: None,
    following_error: Some(0.5),
    ..LIMITS
};

fn under_way(config: AxisConfig) -> Rig {
    let mut rig = Rig::new(Axis::new(config).unwrap(), Drive::at(0));
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 100);
    let velocity = Command::Velocity {
        velocity: SPEED,
        // A torque that the motor reaches.
        ramp: if config.mode == Mode::Cst { 0.1 } else { 1.0 },
    };
    rig.axis.command(velocity).unwrap();
    rig.run(2000);
    rig
}

/// Simulates a gap of `cycles` in the cycle and prepares the outputs after it.
fn gap(rig: &mut Rig, cycles: u32) {
    for _ in 0..cycles {
        let drive = &mut rig.drive;
        if drive.state == State::OperationEnabled && drive.mode == Mode::Csp.code() {
            drive.velocity = 0.0;
        }
        drive.position += drive.velocity * DT;
    }
    rig.out = rig.axis.skipped(cycles);
}

#[test]
fn csp_continues_from_rest_after_skipped_cycles() {
    for cycles in [3, 4, 40, 1000] {
        let mut rig = under_way(all(Mode::Csp, TIGHT));
        gap(&mut rig, cycles);
        assert_eq!(rig.out.target_position, rig.drive.raw_position());
        let mut before = 0.0;
        for n in 0..100 {
            let status = rig.cycle();
            let change = status.target_velocity - before;
            assert!(
                change <= LIMITS.acceleration * DT + 1e-6,
                "cycle {n}: {change}"
            );
            assert_eq!(status.trip, None);
            before = status.target_velocity;
        }
        assert!((before - SPEED).abs() < 1e-6, "{before}");
    }
}

/// The same as with lost frames, and combined with them.
#[test]
fn one_or_two_skipped_cycles_do_not_stop_the_motion() {
    for (lost, left_out, rests) in [(0, 1, false), (0, 2, false), (1, 1, false), (1, 2, true)] {
        let mut rig = under_way(all(Mode::Csp, TIGHT));
        for _ in 0..lost {
            rig.cycle_with(false);
        }
        gap(&mut rig, left_out);
        let status = rig.axis.status();
        assert_eq!(status.target_velocity == 0.0, rests, "{lost}, {left_out}");
        assert_eq!(rig.cycle().trip, None);
    }
}

/// A drive that keeps its velocity has moved on: the set-point starts from its present position.
#[test]
fn velocity_continues_after_skipped_cycles() {
    for mode in [Mode::Csv, Mode::Cst] {
        let mut rig = under_way(all(mode, TIGHT));
        gap(&mut rig, 40);
        for n in 0..100 {
            let before = rig.drive.position;
            let status = rig.cycle();
            let step = rig.drive.position - before;
            assert!((step - WAY).abs() < 2.0, "{mode}, cycle {n}: {step} counts");
            assert_eq!(status.trip, None, "{mode}, cycle {n}");
            assert!(status.following_error.abs() < 0.15, "{mode}, cycle {n}");
        }
    }
}

/// A velocity derived from positions covers the whole time between them.
#[test]
fn derived_velocity_ignores_skipped_cycles() {
    let mut rig = under_way(all(Mode::Csv, TIGHT));
    let step = |rig: &mut Rig| {
        let mut inputs = rig.drive.inputs();
        inputs.velocity = None;
        rig.drive.cycle(&rig.out, DT);
        rig.out = rig.axis.step(&inputs, DT);
        let status = rig.axis.status();
        assert_eq!(status.trip, None);
        assert!((status.velocity - SPEED).abs() < 5.0, "{}", status.velocity);
    };
    for _ in 0..100 {
        step(&mut rig);
    }
    gap(&mut rig, 40);
    for _ in 0..100 {
        step(&mut rig);
    }
}

/// The pending outputs request another mode, with targets from before the gap.
#[test]
fn mode_switch_waits_during_skipped_cycles() {
    let mut rig = under_way(all(Mode::Csv, TIGHT));
    rig.axis.command(Command::SetMode(Mode::Csp)).unwrap();
    rig.cycle();
    assert_eq!(rig.out.mode, Mode::Csp.code());
    gap(&mut rig, 40);
    assert_eq!(rig.out.mode, Mode::Csv.code());
    for n in 0..100 {
        let before = rig.drive.position;
        let status = rig.cycle();
        let step = rig.drive.position - before;
        assert!(step.abs() <= 3.0 * WAY + 2.0, "cycle {n}: {step} counts");
        assert_eq!(status.trip, None, "cycle {n}");
    }
    assert_eq!(rig.axis.status().mode, Mode::Csp);

    let mut rig = under_way(all(Mode::Csp, TIGHT));
    rig.axis.command(Command::SetMode(Mode::Csv)).unwrap();
    rig.cycle();
    assert!(rig.out.target_velocity > 1_000_000);
    gap(&mut rig, 40);
    assert_eq!(rig.out.target_velocity, 0, "the drive stands");
    rig.until(
        |s| s.mode == Mode::Csv && (s.velocity - SPEED).abs() < 0.5,
        200,
    );
}

/// With answers one cycle late, the first answer is from before the gap.
#[test]
fn answers_from_before_skipped_cycles_are_ignored() {
    let config = AxisConfig {
        answers_late: 1,
        dead_time_s: 3.0 * DT,
        ..all(Mode::Csv, TIGHT)
    };
    let mut rig = under_way(config);
    let old = rig.drive.inputs();
    gap(&mut rig, 40);
    rig.drive.cycle(&rig.out, DT);
    rig.out = rig.axis.step(&old, DT);
    assert!(rig.axis.status().stale_cycles > 40);
    let status = rig.cycle();
    assert_eq!((status.stale_cycles, status.trip), (0, None));
    let ahead = status.target_position - rig.drive.position / COUNTS_PER_UNIT;
    assert!(ahead.abs() < 0.5, "{ahead}");
}
