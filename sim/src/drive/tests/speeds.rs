//! Profile velocity: target speed reached, zero speed, slippage.

use super::*;

const WINDOWS: [Extra; 6] = [
    (0x3003, 3, 32, "Max gear input speed"),
    (0x606d, 0, 16, "Velocity window"),
    (0x606e, 0, 16, "Velocity window time"),
    (0x606f, 0, 16, "Velocity threshold"),
    (0x6070, 0, 16, "Velocity threshold time"),
    (0x60f8, 0, 32, "Max slippage"),
];

const REACHED: i64 = 1 << 10;
const ZERO: i64 = 1 << 12;
const SLIPS: i64 = 1 << 13;

fn profile_velocity(values: &[(u16, i64)]) -> Rig {
    let mut rig = Rig::with(PlantParams::default(), &WINDOWS);
    for (index, value) in values {
        rig.set(*index, 0, *value);
    }
    rig.enable(3);
    rig
}

/// Returns the milliseconds from the new target until a bit changes.
fn until(rig: &mut Rig, bit: i64, on: bool) -> u32 {
    let mut ms = 0;
    while (rig.word() & bit != 0) != on {
        rig.cycle();
        ms += 1;
        assert!(ms < 2000, "0x{:04x}", rig.word());
    }
    ms
}

#[test]
fn speed_is_reached_after_its_time_in_the_window() {
    for (window, time, expected) in [(50, 0, 95..110), (50, 200, 295..310), (1, 0, 100..130)] {
        let mut rig = profile_velocity(&[(0x606d, window), (0x606e, time)]);
        rig.run_ms(300);
        rig.set(0x60ff, 0, 1000);
        until(&mut rig, REACHED, false);
        let ms = until(&mut rig, REACHED, true);
        assert!(expected.contains(&ms), "{window} rpm, {time} ms: {ms}");
    }
}

#[test]
fn speed_is_zero_below_the_threshold_and_for_its_time_above() {
    // 100 rpm take 10 ms.
    for (threshold, time, expected) in [(100, 0, 8..16), (100, 50, 58..66), (500, 0, 48..58)] {
        let mut rig = profile_velocity(&[(0x606f, threshold), (0x6070, time)]);
        rig.run_ms(10);
        assert_ne!(rig.word() & ZERO, 0);
        rig.set(0x60ff, 0, 1000);
        let ms = until(&mut rig, ZERO, false);
        assert!(expected.contains(&ms), "{threshold} rpm, {time} ms: {ms}");
        rig.run_ms(300);
        rig.set(0x60ff, 0, 0);
        until(&mut rig, ZERO, true);
        let rpm = rig.drive.velocity_rev_s() * 60.0;
        let threshold = f64::from(i32::try_from(threshold).unwrap());
        assert!((rpm - threshold).abs() < 25.0, "{rpm}");
    }
}

#[test]
fn slippage_shows_in_bit_13() {
    let mut rig = profile_velocity(&[(0x60f8, 100)]);
    rig.set(0x60ff, 0, 1000);
    rig.run_ms(300);
    assert_eq!(rig.word() & SLIPS, 0);
    rig.drive.set_blocked(true);
    rig.run_ms(20);
    assert_ne!(rig.word() & SLIPS, 0);
    assert_eq!(rig.word() & REACHED, 0);
    let mut rig = profile_velocity(&[]);
    rig.set(0x60ff, 0, 1000);
    rig.drive.set_blocked(true);
    rig.run_ms(300);
    assert_eq!(rig.word() & SLIPS, 0, "no limit, no slippage");
}

#[test]
fn profile_speeds_are_limited_by_0x607f_0x6080_and_the_gear() {
    for (max_profile, max_motor, max_gear, rpm) in [
        (500, 6000, 0, 500),
        (5000, 800, 9000, 800),
        (5000, 800, 700, 700),
    ] {
        let mut rig = profile_velocity(&[(0x607f, max_profile), (0x6080, max_motor)]);
        rig.set(0x3003, 3, max_gear);
        rig.run_ms(5);
        for target in [2000, -2000] {
            rig.set(0x60ff, 0, target);
            rig.run_ms(400);
            let expected = f64::from(rpm * i32::try_from(target.signum()).unwrap());
            assert!((rig.drive.velocity_rev_s() * 60.0 - expected).abs() < 10.0);
            assert_ne!(rig.word() & 1 << 11, 0, "internal limit active");
            assert_ne!(rig.word() & REACHED, 0, "of the speed that is allowed");
        }
    }
}
