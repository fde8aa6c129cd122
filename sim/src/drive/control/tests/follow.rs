//! Profiles and interpolated set-points: feed-forward, and the effect of 0x60C2 on a move.

#![allow(clippy::print_stdout, reason = "prints the roughness of the moves")]

use super::*;

/// Returns the largest deviations from a ramp to 1000 rpm in profile velocity mode, as a share of
/// the speed: motor from ramp, and motor from reference.
fn ramp(case: &Case) -> (f64, f64) {
    let (mut rig, gains) = case.rig(3);
    rig.set(0x3000, 2, structure(true));
    rig.run_ms(20);
    let speed = 1000.0 * TAU / 60.0;
    // 0x6083, 10,000 rpm/s.
    let acceleration = 10.0 * speed;
    rig.set(0x60ff, 0, 1000);
    let got = respond(&mut rig, 0.3);
    let profile = |t: f64| {
        if t < 0.1 {
            (acceleration * t, acceleration)
        } else {
            (speed, 0.0)
        }
    };
    let model = Model {
        plant: case.plant,
        gains,
        asked: Asked::Velocity {
            speed: &profile,
            fed: true,
            observed: true,
        },
        load: 0.0,
    };
    let off = |(n, s): (usize, &Sample)| {
        let t = CONTROL_STEP * f64::from(u32::try_from(n).unwrap());
        (s.speed - profile(t).0).abs() / speed
    };
    let lag = got.iter().enumerate().map(off).fold(0.0, f64::max);
    (lag, deviation(&got, &model.run(0.3), speed, |s| s.speed))
}

#[test]
fn feed_forward_lets_velocity_follow_a_ramp() {
    let mut case = cases()[0];
    // Enough friction for the velocity part to matter.
    case.plant.viscous_friction = 3e-4;
    let tuned = as_tuned(&case.plant);
    let with = |velocity: f64, acceleration: f64| {
        let mut gains = tuned;
        gains.velocity[2] *= velocity;
        gains.velocity[3] *= acceleration;
        let case = Case {
            gains: Some(gains),
            ..case
        };
        let (lag, off) = ramp(&case);
        println!(
            "FF ω × {velocity}, α × {acceleration}: lag {:.2} %, off the reference {:.2} %",
            100.0 * lag,
            100.0 * off
        );
        assert!(off < TOLERANCE, "{off}");
        lag
    };
    let none = with(0.0, 0.0);
    let acceleration = with(0.0, 1.0);
    let both = with(1.0, 1.0);
    let excess = with(1.5, 1.5);
    assert!(4.0 * acceleration < none && 4.0 * both < none && 2.0 * both < excess);
}

/// 2.3.4: feed-forward acts in profile modes. In CSP the same gains change nothing.
#[test]
fn position_feed_forward_acts_only_in_profile_position_mode() {
    let worst = |mode: i64, scale: i64| {
        let mut rig = Rig::new(PlantParams::default());
        for sub in [4, 5] {
            let gain = rig.store.get(rig.slot(0x30a1, sub));
            rig.set(0x30a1, sub, scale * gain);
        }
        rig.run_ms(20);
        rig.enable(mode);
        rig.set(0x607a, 0, 4000);
        rig.set(0x6040, 0, 0x1f);
        let (mut worst, mut sum) = (0, 0);
        for n in 0..700 {
            if mode == 8 {
                rig.set(0x607a, 0, (10 * n).min(4000));
            }
            rig.run_ms(1);
            worst = worst.max(rig.get(0x60f4).abs());
            sum += rig.get(0x6077);
        }
        assert!((rig.get(0x6064) - 4000).abs() <= 1);
        (worst, sum)
    };
    assert!(2 * worst(1, 1).0 < worst(1, 0).0);
    assert_eq!(worst(8, 1), worst(8, 0));
}

/// Returns the roughness of a move: the rms change of the torque (‰ of rated) per control cycle,
/// and the rms jerk of the shaft in rev/s³.
fn roughness(mode: i64, cycle_ms: u64, interpolation: i64) -> (f64, f64) {
    let mut rig = Rig::new(PlantParams::default());
    rig.set(0x60c2, 1, interpolation);
    // Thousandths of rpm: whole rpm would add steps.
    rig.set(0x60a9, 0, 0xfdb4_4700);
    rig.enable(mode);
    let (mut torque, mut speed) = ([0.0; 2], [0.0; 3]);
    let (mut changes, mut jerks, mut samples) = (0.0, 0.0, 0.0);
    let mut bus_us = 0;
    // 0.6 s up to 15 rev/s and down again, with a control cycle every 400 µs.
    for control in 0..1500 {
        let now_us = 400 * control;
        while bus_us <= now_us {
            let t = f64::from(u32::try_from(bus_us).unwrap()) * 1e-6;
            let phase = TAU * t / 0.6;
            let position = 2000.0 * 7.5 * (t - 0.6 / TAU * phase.sin());
            let velocity = 60_000.0 * 7.5 * (1.0 - phase.cos());
            let target = if mode == 8 { position } else { velocity };
            let object = if mode == 8 { 0x607a } else { 0x60ff };
            #[expect(clippy::cast_possible_truncation)]
            rig.set(object, 0, target.round() as i64);
            rig.drive.sync(&rig.store);
            bus_us += 1000 * cycle_ms;
        }
        rig.drive.control(&mut rig.store, true);
        torque = [torque[1], float(rig.get(0x6077))];
        speed = [speed[1], speed[2], rig.drive.velocity_rev_s()];
        if control > 2 {
            let change: f64 = torque[1] - torque[0];
            let jerk = (speed[2] - 2.0 * speed[1] + speed[0]) / (CONTROL_STEP * CONTROL_STEP);
            changes += change * change;
            jerks += jerk * jerk;
            samples += 1.0;
        }
    }
    ((changes / samples).sqrt(), (jerks / samples).sqrt())
}

/// 6.6 and 6.7, note b: a value of 0 makes the motion "interrupted and noisy" at cycles of 1 ms and
/// more.
#[test]
fn interpolation_smooths_cyclic_moves() {
    for mode in [8, 9] {
        for cycle_ms in [1_u64, 2] {
            let right = roughness(mode, cycle_ms, i64::try_from(cycle_ms).unwrap());
            let zero = roughness(mode, cycle_ms, 0);
            let ratio = (zero.0 / right.0, zero.1 / right.1);
            println!(
                "mode {mode}, {cycle_ms} ms: torque {:.1} against {:.1} ‰ a control cycle, {:.1} \
                 times; jerk {:.0} against {:.0} rev/s³, {:.1} times",
                zero.0, right.0, ratio.0, zero.1, right.1, ratio.1
            );
            // A step in speed causes less jerk than a step in position.
            let least = if mode == 8 { 5.0 } else { 1.5 };
            assert!(
                ratio.0 > least && ratio.1 > least,
                "mode {mode}, {cycle_ms} ms"
            );
        }
    }
}
