//! Small steps: the motor's response against the transfer functions.

#![allow(
    clippy::print_stdout,
    reason = "prints the largest deviation of the responses"
)]

use super::*;

#[test]
fn current_steps_like_its_transfer_function() {
    for case in cases() {
        let (mut rig, gains) = case.rig(10);
        // A tenth of rated torque.
        rig.set(0x6071, 0, 100);
        let step = 0.1 * case.plant.nominal_current;
        let got = respond(&mut rig, 0.05);
        let wanted = |_| step;
        let model = Model {
            plant: case.plant,
            gains,
            asked: Asked::Current(&wanted),
            load: 0.0,
        };
        let worst = deviation(&got, &model.run(0.05), step, |s| s.current);
        println!("{}: {:.2} %", case.name, 100.0 * worst);
        assert!(worst < TOLERANCE, "{}: {worst}", case.name);
    }
}

/// The response at the current loop's sample rate. Most of it lies between two control cycles.
#[test]
fn current_steps_like_its_transfer_function_at_every_sample() {
    for case in cases() {
        for integral in [0.3, 1.0, 3.0] {
            let (rig, mut gains) = case.rig(10);
            let mut tuned = rig.drive.tuning.gains.current;
            tuned.i *= integral;
            gains.current[1] *= integral;
            let mut current_loop = CurrentLoop::new(&tuned, case.plant.supply_voltage);
            let mut plant = Plant::new(&case.plant);
            let wanted = |_| 0.5;
            let model = Model {
                plant: case.plant,
                gains,
                asked: Asked::Current(&wanted),
                load: 0.0,
            };
            let mut worst = 0.0_f64;
            for ideal in model.run(0.01) {
                plant.drive(current_loop.step(0.5, plant.current()));
                worst = worst.max((plant.current() - ideal.current).abs() / 0.5);
            }
            println!("{}, I × {integral}: {:.2} %", case.name, 100.0 * worst);
            assert!(worst < TOLERANCE, "{}: {worst}", case.name);
        }
    }
}

#[test]
fn velocity_steps_like_its_transfer_function() {
    for case in cases() {
        for observed in [false, true] {
            let (mut rig, gains) = case.rig(9);
            rig.set(0x3000, 2, structure(observed));
            rig.run_ms(20);
            // rad/s: the current loop stays far from its limits.
            let rpm = 20;
            let step = f64::from(rpm) * TAU / 60.0;
            rig.set(0x60ff, 0, i64::from(rpm));
            let got = respond(&mut rig, 0.25);
            let speed = |_| (step, 0.0);
            let model = Model {
                plant: case.plant,
                gains,
                asked: Asked::Velocity {
                    speed: &speed,
                    fed: false,
                    observed,
                },
                load: 0.0,
            };
            let worst = deviation(&got, &model.run(0.25), step, |s| s.speed);
            println!("{}, observer {observed}: {:.2} %", case.name, 100.0 * worst);
            assert!(worst < TOLERANCE, "{}: {worst}", case.name);
        }
    }
}

#[test]
fn position_steps_like_its_transfer_function() {
    for case in cases() {
        let (mut rig, gains) = case.rig(8);
        let counts = 4000_i64;
        let step = float(counts) / f64::from(COUNTS) * TAU;
        let target = rig.get(0x6064) + counts;
        rig.set(0x607a, 0, target);
        let got = respond(&mut rig, 0.5);
        let wanted = |_| step;
        let model = Model {
            plant: case.plant,
            gains,
            asked: Asked::Position(&wanted),
            load: 0.0,
        };
        let worst = deviation(&got, &model.run(0.5), step, |s| s.angle);
        println!("{}: {:.2} %", case.name, 100.0 * worst);
        assert!(worst < TOLERANCE, "{}: {worst}", case.name);
    }
}

/// A load of 0.3 of the rated torque acts on a motor at speed zero. The observer's model has two
/// thirds of the real inertia.
#[test]
fn velocity_yields_to_a_load_like_its_transfer_function() {
    for mut case in cases() {
        for observed in [false, true] {
            let gains = case.gains.get_or_insert_with(|| as_tuned(&case.plant));
            gains.observer[4] = 1e10 * case.plant.inertia / 1.5;
            let (mut rig, gains) = case.rig(9);
            rig.set(0x3000, 2, structure(observed));
            rig.run_ms(20);
            let load = 0.3 * case.plant.rated_torque();
            rig.drive.set_load_torque(load);
            // The load acts already in the first control cycle.
            let mut got = respond(&mut rig, 0.25);
            got.insert(0, got[0]);
            let speed = |_| (0.0, 0.0);
            let model = Model {
                plant: case.plant,
                gains,
                asked: Asked::Velocity {
                    speed: &speed,
                    fed: false,
                    observed,
                },
                load,
            };
            let reference = model.run(0.25);
            let dip = reference.iter().fold(0.0_f64, |d, s| d.max(s.speed.abs()));
            let worst = deviation(&got, &reference, dip, |s| s.speed);
            println!("{}, observer {observed}: {:.2} %", case.name, 100.0 * worst);
            assert!(worst < TOLERANCE, "{}: {worst}", case.name);
        }
    }
}

/// The current exceeds the nominal current until the winding is warm: `1 − e^(−t/τ)` of the square.
#[test]
fn overload_lasts_until_the_winding_is_warm() {
    let plant = PlantParams {
        thermal_time_constant: 2.0,
        ..PlantParams::default()
    };
    let mut rig = Rig::new(plant);
    rig.enable(10);
    rig.drive.set_blocked(true);
    rig.set(0x6071, 0, 2500);
    let mut ms = 0;
    while ms < 5 || rig.get(0x6077) > 1200 {
        rig.run_ms(1);
        ms += 1;
    }
    // 2 s · ln(6.25 / 5.25)
    assert!((345..353).contains(&ms), "{ms}");
    assert_ne!(rig.get(0x6041) & 1 << 11, 0, "internal limit");
    rig.run_ms(2000);
    assert_eq!(rig.get(0x6077), 1000);
    // After a rest the overload is possible again.
    rig.set(0x6071, 0, 0);
    rig.run_ms(2000);
    rig.set(0x6071, 0, 2500);
    rig.run_ms(10);
    assert_eq!(rig.get(0x6077), 2500);
}
