use proptest::prelude::*;

use super::*;

fn epos(unit: VelocityUnit) -> Scale {
    Scale::new(2000.0, 5.0).unwrap().with_velocity_unit(unit)
}

#[test]
fn velocity_units_follow_the_si_codes() {
    for (code, unit, text) in [
        (0x00B4_4700, VelocityUnit::RPM, "rpm"),
        (0xFDB4_4700, VelocityUnit::MILLI_RPM, "mrpm"),
        (0x00B5_0300, VelocityUnit::COUNTS_PER_SECOND, "counts/s"),
        (0x00B4_0300, VelocityUnit::TURNS_PER_SECOND, "turns/s"),
    ] {
        assert_eq!(VelocityUnit::from_si_code(code), Some(unit));
        assert_eq!(unit.si_code(), code);
        assert_eq!(unit.to_string(), text);
    }
    assert_eq!(
        VelocityUnit::from_si_code(0xFEB4_4700).unwrap().to_string(),
        "0.01 rpm"
    );
    // An acceleration, a position, invalid codes.
    for code in [0x00C0_0300, 0x00B5_0000, 0, u32::MAX, 0x80B4_4700] {
        assert_eq!(VelocityUnit::from_si_code(code), None, "{code:#010x}");
    }
}

#[test]
fn velocities_convert_in_each_unit() {
    // 5 mm per turn: 200 mm/s is 40 turns/s.
    for (unit, raw) in [
        (VelocityUnit::RPM, 2400),
        (VelocityUnit::MILLI_RPM, 2_400_000),
        (VelocityUnit::COUNTS_PER_SECOND, 80_000),
        (VelocityUnit::TURNS_PER_SECOND, 40),
    ] {
        let scale = epos(unit);
        assert_eq!(
            scale.velocity_to_raw(UserVelocity(200.0)),
            RawVelocity(raw),
            "{unit}"
        );
        assert_eq!(
            scale.velocity_to_user(RawVelocity(raw)),
            UserVelocity(200.0)
        );
        assert_eq!(
            scale.acceleration_to_raw(UserAcceleration(200.0)).0,
            raw.unsigned_abs()
        );
    }
}

#[test]
fn positions_round_to_nearest() {
    let scale = Scale::new(1.0, 1.0).unwrap();
    for (user, counts) in [(0.4, 0), (0.6, 1), (-0.4, 0), (-0.6, -1), (2.5, 3)] {
        assert_eq!(scale.position_to_counts(UserUnits(user)), Counts(counts));
    }
    assert_eq!(scale.torque_to_raw(Percent(12.36)), PerMille(124));
}

#[test]
fn scale_applies_inversion_and_offset() {
    let scale = epos(VelocityUnit::RPM)
        .with_invert(true)
        .with_offset(10.0)
        .unwrap();
    assert_eq!(scale.position_to_counts(UserUnits(15.0)), Counts(-2000));
    assert_eq!(scale.position_to_user(Counts(-2000)), UserUnits(15.0));
    assert_eq!(scale.velocity_to_raw(UserVelocity(5.0)), RawVelocity(-60));
    assert_eq!(scale.torque_to_raw(Percent(5.0)), PerMille(-50));
    assert_eq!(scale.torque_to_user(PerMille(-50)), Percent(5.0));
    assert!(scale.counts_per_unit() > 0.0);
}

#[test]
fn invalid_scales_are_rejected() {
    for (counts, units) in [
        (0.0, 1.0),
        (-1.0, 1.0),
        (f64::NAN, 1.0),
        (1.0, 0.0),
        (1.0, f64::INFINITY),
        (1e300, 1e-300),
    ] {
        assert!(Scale::new(counts, units).is_err(), "{counts} {units}");
    }
    assert!(Scale::new(1.0, 1.0).unwrap().with_offset(f64::NAN).is_err());
}

proptest! {
    #[test]
    fn counts_round_trip(
        counts in -(1i64 << 40)..(1i64 << 40),
        per_turn in 1.0..1e7f64,
        units in 1e-3..1e3f64,
        invert: bool,
        offset in -1e3..1e3f64,
    ) {
        let scale = Scale::new(per_turn, units).unwrap().with_invert(invert).with_offset(offset).unwrap();
        prop_assert_eq!(scale.position_to_counts(scale.position_to_user(Counts(counts))), Counts(counts));
    }

    #[test]
    fn any_code_survives(code: u32) {
        if let Some(unit) = VelocityUnit::from_si_code(code) {
            prop_assert_eq!(unit.si_code(), code);
        }
    }

    #[test]
    fn any_value_converts(bits: u64) {
        let value = f64::from_bits(bits);
        let scale = epos(VelocityUnit::RPM);
        let _ = scale.position_to_counts(UserUnits(value));
        let _ = scale.velocity_to_raw(UserVelocity(value));
        let _ = scale.acceleration_to_raw(UserAcceleration(value));
        let _ = scale.torque_to_raw(Percent(value));
    }
}

#[test]
fn acceleration_units_follow_the_si_codes() {
    for (code, text, raw) in [
        // 5 mm per turn of 2000 counts: 200 mm/s² is 40 turns/s².
        (0x00C0_0300, "rpm/s", 2400),
        (0xFDC0_0300, "10^-3 rpm/s", 2_400_000),
        (0x00B4_5700, "turns/s²", 40),
        (0x00B5_5700, "counts/s²", 80_000),
    ] {
        let unit = AccelerationUnit::from_si_code(code).unwrap();
        assert_eq!((unit.si_code(), unit.to_string()), (code, text.to_owned()));
        let scale = epos(VelocityUnit::MILLI_RPM).with_acceleration_unit(unit);
        let scale = scale.with_invert(true);
        assert_eq!(scale.acceleration_to_raw(UserAcceleration(200.0)).0, raw);
        let back = scale.acceleration_to_user(RawAcceleration(raw));
        assert!((back.0 - 200.0).abs() < 1e-9);
    }
    // Velocities, a position, invalid codes.
    for code in [0x00B4_4700, 0x00B4_0300, 0x00B5_0000, 0, u32::MAX] {
        assert_eq!(AccelerationUnit::from_si_code(code), None, "{code:#010x}");
    }
    // The default is the velocity unit per second.
    let unit = epos(VelocityUnit::RPM).acceleration_unit();
    assert_eq!(unit, AccelerationUnit::RPM_PER_SECOND);
}

#[test]
fn scale_follows_the_drivetrain() {
    // An encoder with 500 lines, a gear 66:5, a spindle with 2 mm lead.
    let drivetrain = Drivetrain {
        encoder: [2000, 1],
        gear: [66, 5],
        feed: 2.0,
    };
    let scale = Scale::of_drivetrain(&drivetrain).unwrap();
    assert_eq!(scale.counts_per_turn(), 2000.0);
    // Five turns of the shaft are 66 turns of the motor.
    assert_eq!(scale.position_to_counts(UserUnits(10.0)), Counts(132_000));
    // 2^20 increments per three turns.
    let resolver = Scale::of_drivetrain(&Drivetrain {
        encoder: [1 << 20, 3],
        gear: [1, 1],
        feed: 1.0,
    });
    assert_eq!(
        resolver.unwrap().position_to_counts(UserUnits(3.0)),
        Counts(1 << 20)
    );
    for bad in [
        Drivetrain {
            encoder: [0, 1],
            ..drivetrain
        },
        Drivetrain {
            encoder: [1, 0],
            ..drivetrain
        },
        Drivetrain {
            gear: [0, 1],
            ..drivetrain
        },
        Drivetrain {
            gear: [1, 0],
            ..drivetrain
        },
        Drivetrain {
            feed: 0.0,
            ..drivetrain
        },
        Drivetrain {
            feed: f64::NAN,
            ..drivetrain
        },
    ] {
        assert!(Scale::of_drivetrain(&bad).is_err(), "{bad:?}");
    }
}

#[test]
fn torque_converts_from_newton_metres_and_amperes() {
    use crate::units::{Amperes, NewtonMetres};

    // 118.4 mNm, 26.3 mNm/A.
    let motor = TorqueScale::new(Some(0.1184), Some(0.0263)).unwrap();
    let near = |a: f64, b: f64| (a - b).abs() < 1e-9;
    assert!(near(
        motor.of_newton_metres(NewtonMetres(0.0592)).unwrap().0,
        50.0
    ));
    assert!(near(
        motor.to_newton_metres(Percent(-50.0)).unwrap().0,
        -0.0592
    ));
    assert!(near(
        motor.to_amperes(Percent(100.0)).unwrap().0,
        0.1184 / 0.0263
    ));
    assert!(near(
        motor.of_amperes(Amperes(1.0)).unwrap().0,
        2.63 / 0.1184
    ));
    let rated = TorqueScale::new(Some(0.1184), None).unwrap();
    assert!(rated.of_newton_metres(NewtonMetres(1.0)).is_ok());
    let error = rated.of_amperes(Amperes(1.0)).unwrap_err();
    assert_eq!(
        error.to_string(),
        "the motor's torque constant is not known, which a torque in A needs"
    );
    assert!(
        TorqueScale::default()
            .to_newton_metres(Percent(1.0))
            .is_err()
    );
    for value in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(TorqueScale::new(Some(value), None).is_err());
        assert!(TorqueScale::new(None, Some(value)).is_err());
    }
}

/// A turntable of 360°: start, target, expected absolute position.
#[test]
fn modulo_directions_row_by_row() {
    use ModuloDirection::{AsGiven, Negative, Positive, Shortest};
    let scale = Scale::new(3600.0, 360.0)
        .unwrap()
        .with_modulo(360.0)
        .unwrap();
    for (from, to, way, at) in [
        (10.0, 350.0, Shortest, -10.0),
        (10.0, 350.0, Positive, 350.0),
        (10.0, 350.0, Negative, -10.0),
        (10.0, 350.0, AsGiven, 350.0),
        (350.0, 10.0, Shortest, 370.0),
        (350.0, 10.0, Positive, 370.0),
        (350.0, 10.0, Negative, 10.0),
        (730.0, 5.0, Shortest, 725.0),
        (730.0, 5.0, Positive, 1085.0),
        (730.0, 5.0, Negative, 725.0),
        (-725.0, 5.0, Shortest, -715.0),
        (0.0, 180.0, Shortest, 180.0),
        (180.0, 0.0, Shortest, 360.0),
        (0.0, 725.0, Positive, 5.0),
        (0.0, 725.0, AsGiven, 725.0),
        // Already at the target within the rounding to counts.
        (89.96, 90.0, Negative, 90.0),
        (90.04, 90.0, Positive, 90.0),
        (359.97, 0.0, Negative, 360.0),
        (0.03, 360.0, Positive, 0.0),
        (90.0, 90.0, Positive, 90.0),
    ] {
        let destination = scale.destination(UserUnits(from), UserUnits(to), way);
        assert!(
            (destination.0 - at).abs() < 1e-9,
            "{from} {to} {way:?}: {destination:?}"
        );
    }
    assert_eq!(scale.place(UserUnits(-10.0)), UserUnits(350.0));
    assert_eq!(scale.place(UserUnits(-1e-20)), UserUnits(0.0));
    let straight = Scale::new(3600.0, 360.0).unwrap();
    assert_eq!(
        straight.destination(UserUnits(10.0), UserUnits(725.0), Shortest),
        UserUnits(725.0)
    );
    for length in [0.0, -360.0, 0.1, 1e9, f64::NAN, f64::INFINITY] {
        assert!(straight.with_modulo(length).is_err(), "{length}");
    }
}

fn way() -> impl Strategy<Value = ModuloDirection> {
    prop::sample::select(vec![
        ModuloDirection::Shortest,
        ModuloDirection::Positive,
        ModuloDirection::Negative,
        ModuloDirection::AsGiven,
    ])
}

proptest! {
    /// The destination is equivalent to the target and within the bounds of the direction. An axis
    /// at the target stays there.
    #[test]
    fn modulo_destinations_reach_the_target(
        counts in -(1i64 << 36)..(1i64 << 36), to in -1e4..1e4f64, way in way(),
        per_turn in 100.0..1e6f64, units in 0.1..1e3f64, modulo in 0.5..2e3f64, offset in -1e3..1e3f64,
    ) {
        let scale = Scale::new(per_turn, units).unwrap().with_offset(offset).unwrap();
        let Ok(scale) = scale.with_modulo(modulo) else { return Ok(()); };
        let from = scale.position_to_user(Counts(counts));
        let destination = scale.destination(from, UserUnits(to), way);
        let count = scale.units_of_counts(1.0);
        let apart = (scale.place(destination).0 - scale.place(UserUnits(to)).0).abs();
        let rounding = from.0.abs() * 1e-15 + 1e-9;
        prop_assert!(apart.min((modulo - apart).abs()) <= rounding, "{:?}", destination);
        let by = destination.0 - from.0;
        match way {
            ModuloDirection::Shortest => prop_assert!(by.abs() <= modulo / 2.0 + rounding),
            ModuloDirection::Positive => prop_assert!((-count..modulo + rounding).contains(&by)),
            ModuloDirection::Negative => prop_assert!((-modulo - rounding..=count).contains(&by)),
            ModuloDirection::AsGiven => prop_assert_eq!(destination.0, to),
        }
    }

    /// Repeated moves by a third of a turn do not drift by one count.
    #[test]
    fn modulo_moves_do_not_drift(gear in prop::sample::select(vec![[3u32, 1u32], [7, 3], [66, 5], [1, 7]]), turns in 1i64..10_000_000) {
        let drivetrain = Drivetrain { encoder: [2048, 1], gear, feed: 360.0 };
        let scale = Scale::of_drivetrain(&drivetrain).unwrap().with_modulo(360.0).unwrap();
        let [motor, shaft] = gear.map(i128::from);
        let exact = |thirds: i128| (thirds * 2048 * motor * 2 + 3 * shaft) / (2 * 3 * shaft);
        let before = i128::from(turns) * 3;
        let mut at = UserUnits(turns as f64 * 360.0);
        for thirds in 1..=3i128 {
            let place = UserUnits([0.0, 120.0, 240.0][(thirds % 3) as usize]);
            at = scale.destination(at, place, ModuloDirection::Positive);
            let Counts(counts) = scale.position_to_counts(at);
            prop_assert!((i128::from(counts) - exact(before + thirds)).abs() <= i128::from(gear == [1, 7]) , "{} {}", counts, exact(before + thirds));
            at = scale.position_to_user(Counts(counts));
        }
    }

    #[test]
    fn homing_sets_the_given_position(counts in -(1i64 << 40)..(1i64 << 40), position in -1e6..1e6f64, invert: bool) {
        let scale = epos(VelocityUnit::RPM).with_invert(invert).homed(Counts(counts), UserUnits(position)).unwrap();
        prop_assert_eq!(scale.position_to_counts(UserUnits(position)), Counts(counts));
        prop_assert!((scale.position_to_user(Counts(counts)).0 - position).abs() < 1e-5);
    }

    #[test]
    fn any_number_gives_a_scale_or_an_error(numbers in prop::array::uniform4(any::<f64>()), ratios in prop::array::uniform4(any::<u32>()), counts: i64, way in way()) {
        let [a, b, c, d] = numbers;
        let [e, f, g, h] = ratios;
        let drivetrain = Drivetrain { encoder: [e, f], gear: [g, h], feed: a };
        for scale in [Scale::of_drivetrain(&drivetrain), Scale::new(a.abs(), b.abs())].into_iter().flatten() {
            let _ = scale.homed(Counts(counts), UserUnits(c));
            let scale = scale.with_modulo(d.abs()).unwrap_or(scale);
            let _ = scale.place(UserUnits(c));
            let _ = scale.position_to_counts(scale.destination(UserUnits(c), UserUnits(d), way));
            let _ = scale.position_to_user(Counts(counts));
            let offered = DriveUnits { encoder_resolution: Some([e, f]), gear_ratio: Some([g, h]), position_unit: Some(e), velocity_unit: Some(f),
                acceleration_unit: Some(g), rated_torque: Some(h), ..DriveUnits::default() };
            for found in offered.contradictions(&scale, Some(e)) {
                prop_assert!(!found.to_string().is_empty());
            }
        }
        let _ = TorqueScale::new(Some(a), Some(b)).map(|motor| motor.of_amperes(crate::units::Amperes(c)));
    }
}
