//! Taking up backlash: its limits, override and speed, ends of motions, lost cycles, mode switches.

use crate::common::{DT, LIMITS};
use crate::compensation::{BACKLASH, COUNTS, Rig};
use ecaxis_axis::compensation::{Compensation, Mechanics, ReferenceFlank};
use ecaxis_axis::{
    Axis, AxisConfig, Command, Inputs, Limits, Mode, Modes, Scale, SecondEncoder, Trip,
};

const JERK: f64 = 40_000.0;

fn backlash() -> Compensation {
    let mechanics = Mechanics {
        backlash: Some(BACKLASH),
        ..Mechanics::default()
    };
    let limits = Limits {
        jerk: Some(JERK),
        ..LIMITS
    };
    Compensation::new(&mechanics, &limits).unwrap()
}

fn rig(jerk_limited: bool) -> Rig {
    let config = |config: &mut AxisConfig| {
        config.jerk_limited = jerk_limited;
        config.limits.jerk = backlash().load_limits(&LIMITS).jerk;
    };
    let mut rig = Rig::new(backlash(), config, ReferenceFlank::Positive);
    rig.load.pitch = false;
    rig
}

fn target(rig: &Rig) -> f64 {
    f64::from(rig.out.target_position) / COUNTS
}

fn to(position: f64, speed: f64) -> Command {
    let ramp = 1.0;
    Command::MoveTo {
        position,
        speed,
        ramp,
    }
}

/// Steps until the play is half taken up.
fn until_half_taken_up(rig: &mut Rig) {
    for _ in 0..1000 {
        let status = rig.cycle(true);
        let play = status.target_position - target(rig);
        if (0.3..0.7).contains(&(play / BACKLASH)) {
            return;
        }
    }
    panic!("{:#?}", rig.axis.status());
}

/// Velocity, acceleration and jerk of the drive stay within its limits over reversals.
#[test]
fn the_drive_of_a_jerk_limited_axis_keeps_its_jerk_limit() {
    let mut rig = rig(true);
    let mut targets = Vec::new();
    for (position, speed) in [
        (10.0, 1.0),
        (9.98, 1.0),
        (20.0, 0.3),
        (3.0, 1.0),
        (3.01, 0.05),
    ] {
        rig.axis.command(to(position, speed)).unwrap();
        for _ in 0..1500 {
            rig.cycle(true);
            targets.push(target(&rig));
        }
        assert!(
            (rig.real - position).abs() < 1e-5,
            "{position}: {}",
            rig.real
        );
    }
    let count = 1.0 / COUNTS;
    for w in targets.windows(4) {
        let jerk = (w[3] - 3.0 * w[2] + 3.0 * w[1] - w[0]) / DT.powi(3);
        assert!(jerk.abs() <= JERK + 4.0 * count / DT.powi(3), "{jerk}");
    }
}

/// The play is not taken up faster than the motion is asked to be, with the override.
#[test]
fn speed_and_override_apply_to_the_play() {
    for jerk_limited in [false, true] {
        for (speed, rate) in [(0.004, 1.0), (0.02, 0.2), (1.0, 0.004)] {
            let mut rig = rig(jerk_limited);
            rig.move_to(1.0, 1.0);
            rig.largest = [0.0; 2];
            rig.axis.set_rate(rate);
            rig.axis.command(to(0.98, speed)).unwrap();
            let asked = LIMITS.velocity * speed * rate;
            rig.until(|s| !s.moving && s.in_target);
            // The load and the play move at once.
            let fastest = rig.largest[0];
            assert!(
                fastest <= 2.0 * asked + 1.0 / COUNTS / DT,
                "{fastest} {asked}"
            );
            assert!((rig.real - 0.98).abs() < 1e-5);
        }
        // A hold ends the ramp, and the motion goes on after it.
        let mut rig = rig(jerk_limited);
        rig.move_to(1.0, 1.0);
        rig.axis.command(to(0.9, 1.0)).unwrap();
        until_half_taken_up(&mut rig);
        rig.axis.set_rate(0.0);
        for _ in 0..200 {
            rig.cycle(true);
        }
        let held = rig.out.target_position;
        for _ in 0..200 {
            rig.cycle(true);
            assert_eq!(rig.out.target_position, held);
        }
        rig.axis.set_rate(1.0);
        rig.until(|s| !s.moving && s.in_target);
        assert!((rig.real - 0.9).abs() < 1e-5);
    }
}

/// A held source stands still within the play, and completes it after the hold.
#[test]
fn a_hold_of_set_points_from_outside_ends_the_ramp() {
    for jerk_limited in [false, true] {
        let mut rig = rig(jerk_limited);
        rig.move_to(1.0, 1.0);
        let mut position = 1.0;
        for part in [1.0, 2.0, 2.0, 1.0] {
            position -= 0.0005 * part;
            rig.axis.set_point(position).unwrap();
            rig.cycle(true);
        }
        rig.axis.set_rate(0.0);
        let mut targets = Vec::new();
        for _ in 0..300 {
            rig.axis.set_point(position).unwrap();
            rig.cycle(true);
            targets.push(rig.out.target_position);
        }
        assert!(targets[100..].iter().all(|target| *target == targets[100]));
        let short = target(&rig) - (position - BACKLASH);
        assert!(short > BACKLASH * 0.1, "the play is taken up: {short}");
        rig.axis.set_rate(1.0);
        for _ in 0..1000 {
            rig.axis.set_point(position).unwrap();
            rig.cycle(true);
        }
        assert!((rig.real - position).abs() < 1e-5);
    }
}

/// A line that ends within the take-up completes it; one that loses its way does not.
#[test]
fn set_points_from_outside_end_on_their_flank() {
    for jerk_limited in [false, true] {
        for ends in [true, false] {
            let mut rig = rig(jerk_limited);
            rig.move_to(1.0, 1.0);
            let mut position = 1.0;
            let steps = [1.0, 2.0, 2.0, 1.0].map(|part: f64| part * 0.0005);
            let last = if ends { 4 } else { 2 };
            for step in steps.iter().take(last) {
                position -= step;
                rig.axis.set_point(position).unwrap();
                rig.cycle(true);
            }
            if ends {
                rig.axis.set_point(position).unwrap();
                rig.cycle(true);
                rig.until(|s| !s.moving && s.in_target);
                for _ in 0..5 {
                    rig.cycle(true);
                }
                let status = rig.cycle(true);
                assert!((status.position - position).abs() < 1e-5, "{status:?}");
                assert!((rig.real - position).abs() < 1e-5);
                continue;
            }
            for _ in 0..100 {
                rig.cycle(true);
            }
            let stands = rig.out.target_position;
            let status = rig.cycle(true);
            assert_eq!(rig.out.target_position, stands);
            assert!(
                (status.position - 1.0).abs() < 1e-5,
                "the load has not moved"
            );
        }
    }
}

/// After a stop within the play the drive is at its target, and the load stands.
#[test]
fn a_stop_within_the_play_is_in_target() {
    for jerk_limited in [false, true] {
        let mut rig = rig(jerk_limited);
        rig.move_to(1.0, 1.0);
        rig.axis.command(to(0.5, 0.05)).unwrap();
        until_half_taken_up(&mut rig);
        rig.axis.command(Command::Stop).unwrap();
        let status = rig.until(|s| !s.moving && s.in_target);
        assert!(status.position - target(&rig) > 0.2 * BACKLASH);
        let stands = rig.out.target_position;
        for _ in 0..100 {
            rig.cycle(true);
            assert_eq!(rig.out.target_position, stands);
        }
    }
}

/// While the play is taken up, the load stands: its reported velocity is 0.
#[test]
fn the_reported_velocity_is_that_of_the_load() {
    let mut rig = rig(true);
    rig.move_to(1.0, 1.0);
    rig.axis.command(to(-5.0, 0.5)).unwrap();
    let (mut within, mut beyond) = (0, 0);
    for _ in 0..1000 {
        let before = rig.real;
        let status = rig.cycle(true);
        let turns = status.position - rig.drive.position / COUNTS;
        if rig.real == before && turns > 0.05 * BACKLASH && turns < 0.95 * BACKLASH {
            within += 1;
            assert_eq!(status.velocity, 0.0);
        }
        beyond += u32::from(status.velocity < -50.0);
    }
    assert!(within > 5 && beyond > 20, "{within} {beyond}");
}

/// A reversal whose target was never sent has not happened: the same position moves nothing.
#[test]
fn a_skipped_cycle_takes_its_reversal_back() {
    let mut rig = rig(false);
    rig.move_to(1.0, 1.0);
    let before = rig.out.target_position;
    rig.axis.command(to(0.5, 1.0)).unwrap();
    rig.cycle(true);
    assert_ne!(rig.out.target_position, before);
    rig.out = rig.axis.skipped(5);
    assert_eq!(rig.out.target_position, before);
    rig.axis.command(to(1.0, 1.0)).unwrap();
    for _ in 0..200 {
        rig.cycle(true);
        assert_eq!(rig.out.target_position, before);
    }
}

/// CSP to CSV in every phase of a take-up: the drive goes on with the velocity that it has.
#[test]
fn a_mode_switch_within_the_take_up_keeps_the_velocity() {
    let config = |config: &mut AxisConfig| {
        config.modes = Modes::only(Mode::Csp).with(Mode::Csv);
        config.scale = config
            .scale
            .with_velocity_unit(ecaxis_axis::VelocityUnit::MILLI_RPM);
    };
    // One unit of the velocity is 5 mm in 60 000 s; the drive counts in 0x607A.
    let unit = 5.0 / 60_000.0;
    for cycles in (1..40).step_by(3) {
        let mut rig = Rig::new(backlash(), config, ReferenceFlank::Positive);
        rig.move_to(1.0, 1.0);
        rig.axis
            .command(Command::Velocity {
                velocity: -2.0,
                ramp: 0.05,
            })
            .unwrap();
        for _ in 0..cycles {
            rig.cycle(true);
        }
        let mut last = target(&rig);
        rig.axis.command(Command::SetMode(Mode::Csv)).unwrap();
        let mut velocity = 0.0;
        let mut switched = false;
        for _ in 0..100 {
            let status = rig.cycle(true);
            let now = match status.mode {
                Mode::Csv => f64::from(rig.out.target_velocity) * unit,
                _ => (target(&rig) - last) / DT,
            };
            last = target(&rig);
            if velocity != 0.0 {
                let change = (now - velocity).abs();
                let most = LIMITS.acceleration * DT + unit + 1.0 / COUNTS / DT;
                assert!(change <= most, "after {cycles}: {velocity} to {now}");
            }
            velocity = now;
            switched |= status.mode == Mode::Csv;
        }
        assert!(switched);
    }
}

/// A position after a torque begins where the drive stands, within its play as well.
#[test]
fn a_position_after_a_torque_takes_the_present_play() {
    use ecaxis_axis::{Loops, PositionPid};
    let config = |config: &mut AxisConfig| {
        config.mode = Mode::Cst;
        config.modes = Modes::only(Mode::Cst);
        config.dead_time_s = DT;
        config.loops = Loops {
            cst: Some(PositionPid {
                kp: 1.0,
                tn_s: None,
                tv_s: 0.0,
                acceleration: 0.0,
            }),
            ..Loops::default()
        };
    };
    let mut rig = Rig::new(backlash(), config, ReferenceFlank::Positive);
    let push = Command::Torque {
        percent: -5.0,
        ramp_s: 0.0,
    };
    rig.axis.command(push).unwrap();
    let mut before = rig.axis.status();
    for _ in 0..1000 {
        // A hand turns the drive through its play.
        rig.drive.position -= 0.1 * BACKLASH * COUNTS;
        rig.drive.velocity = 0.0;
        before = rig.cycle(true);
        if rig.drive.position / COUNTS < -0.4 * BACKLASH {
            break;
        }
    }
    rig.drive.position -= 0.1 * BACKLASH * COUNTS;
    let mut inputs = rig.drive.inputs();
    inputs.velocity = None;
    rig.axis.observe(&inputs, DT);
    rig.axis
        .command(Command::Velocity {
            velocity: 0.0,
            ramp: 1.0,
        })
        .unwrap();
    rig.axis.act();
    rig.axis.observe(&inputs, DT);
    let error = rig.axis.status().following_error;
    assert!(error.abs() < 0.05 * BACKLASH, "{error}: {before:?}");
}

/// The counts of a UDINT above 2³¹ are not negative.
#[test]
fn an_unsigned_encoder_has_large_counts() {
    let raw = 3_000_000_000_u32;
    for unsigned in [true, false] {
        let config = |config: &mut AxisConfig| {
            config.absolute = true;
            config.second_encoder = Some(SecondEncoder {
                counts_per_unit: 1000.0,
                max_difference: 0.1,
                offset: Some(-3_000_000.0),
                unsigned,
            });
        };
        let mut rig = Rig::new(Compensation::default(), config, ReferenceFlank::Positive);
        rig.second = Some(raw.cast_signed());
        let status = rig.cycle(true);
        if unsigned {
            assert_eq!(status.encoder_difference, Some(0.0));
            // On to the end of 32 bits, and beyond.
            rig.second = Some(raw.cast_signed() + 50);
            let difference = rig.cycle(true).encoder_difference.unwrap();
            assert!((difference + 0.05).abs() < 1e-6, "{difference}");
        } else {
            assert!(matches!(status.trip, Some(Trip::EncoderDifference { .. })));
        }
    }
}

/// The drive's 32 bits wrap; a start cannot know how often, a return of the same drive can.
#[test]
fn home_of_an_absolute_encoder_survives_wraps_while_the_axis_exists() {
    let axis = |absolute_start: bool| {
        let scale = Scale::new(8_388_608.0, 1.0).unwrap();
        let limits = Limits {
            position: None,
            velocity: 10.0,
            ..LIMITS
        };
        let mut config = AxisConfig::new(Mode::Csp, scale, limits);
        config.absolute = true;
        config.absolute_start = absolute_start;
        Axis::new(config).unwrap()
    };
    assert!(axis(true).status().homed());
    let mut axis = axis(false);
    assert!(!axis.status().homed());
    let at = |axis: &mut Axis, position: i32| {
        let inputs = Inputs {
            statusword: 0x0250,
            position: Some(position),
            fresh: true,
            ..Inputs::default()
        };
        axis.observe(&inputs, DT);
        axis.status().position
    };
    // 255 turns, then one more than 256.
    at(&mut axis, 255 << 23);
    assert!((at(&mut axis, i32::MIN + (1 << 23)) - 257.0).abs() < 1e-9);
    for (same, expected) in [(true, 257.0), (false, -255.0)] {
        axis.restarted(same);
        let position = at(&mut axis, i32::MIN + (1 << 23));
        assert!((position - expected).abs() < 1e-9, "{same}: {position}");
    }
}
