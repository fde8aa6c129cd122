use super::*;
use crate::units::UserAcceleration;

/// 2000 counts and 5 mm per turn.
fn epos(unit: VelocityUnit) -> Scale {
    Scale::new(2000.0, 5.0).unwrap().with_velocity_unit(unit)
}

/// The defaults of EPOS4, with one contradiction at a time.
#[test]
fn contradictions_are_reported() {
    let scale = epos(VelocityUnit::RPM);
    let good = DriveUnits {
        encoder_resolution: Some([2000, 1]),
        gear_ratio: Some([1, 1]),
        feed_constant: Some([2000, 1]),
        position_unit: Some(0x00B5_0000),
        velocity_unit: Some(0x00B4_4700),
        acceleration_unit: Some(0x00C0_0300),
        rated_torque: Some(118_400),
        torque_constant: None,
        polarity: Some(0),
    };
    let torque = Some(118_350);
    assert_eq!(good.contradictions(&scale, torque), []);
    assert_eq!(DriveUnits::default().contradictions(&scale, torque), []);
    for (offered, object, text) in [
        (
            DriveUnits {
                feed_constant: None,
                encoder_resolution: Some([4096, 1]),
                ..good
            },
            (0x608F, 1),
            "4096 counts per motor turn, expected 2000",
        ),
        (
            DriveUnits {
                encoder_resolution: Some([2000, 0]),
                ..good
            },
            (0x608F, 2),
            "2000:0",
        ),
        (
            DriveUnits {
                gear_ratio: Some([0, 7]),
                ..good
            },
            (0x6091, 1),
            "0:7",
        ),
        (
            DriveUnits {
                feed_constant: None,
                gear_ratio: Some([4, 1]),
                ..good
            },
            (0x6091, 1),
            "500 counts",
        ),
        (
            DriveUnits {
                feed_constant: None,
                encoder_resolution: None,
                gear_ratio: Some([1, 4]),
                ..good
            },
            (0x6091, 1),
            "are 1:4: 2000 counts per motor turn need an encoder of 500; an encoder of 2000 makes 8000 counts",
        ),
        (
            DriveUnits {
                feed_constant: Some([36_000, 10]),
                ..good
            },
            (0x6092, 1),
            "3600 counts",
        ),
        (
            DriveUnits {
                feed_constant: Some([1, 0]),
                ..good
            },
            (0x6092, 2),
            "1:0",
        ),
        (
            DriveUnits {
                position_unit: Some(0x0041_0000),
                ..good
            },
            (0x60A8, 0),
            "0x00410000",
        ),
        (
            DriveUnits {
                velocity_unit: Some(0xFDB4_4700),
                ..good
            },
            (0x60A9, 0),
            "(mrpm), expected rpm",
        ),
        (
            DriveUnits {
                velocity_unit: Some(7),
                ..good
            },
            (0x60A9, 0),
            "is 0x00000007, expected rpm",
        ),
        (
            DriveUnits {
                acceleration_unit: Some(0x00B5_5700),
                ..good
            },
            (0x60AA, 0),
            "(counts/s²), expected rpm/s",
        ),
        (
            DriveUnits {
                rated_torque: Some(0),
                ..good
            },
            (0x6076, 0),
            "is 0",
        ),
        (
            DriveUnits {
                rated_torque: Some(119_000),
                ..good
            },
            (0x6076, 0),
            "is 119000, expected 118350",
        ),
        (
            DriveUnits {
                polarity: Some(0x80),
                ..good
            },
            (0x607E, 0),
            "0x80",
        ),
        (
            DriveUnits {
                polarity: Some(0x40),
                ..good
            },
            (0x607E, 0),
            "0x40",
        ),
        (
            DriveUnits {
                polarity: Some(0x20),
                ..good
            },
            (0x607E, 0),
            "0x20",
        ),
    ] {
        let found = offered.contradictions(&scale, torque);
        let [one] = found.as_slice() else {
            panic!("{offered:?}: {found:?}")
        };
        assert_eq!(one.object(), object, "{one}");
        assert!(one.to_string().contains(text), "{one}");
        assert!(one.to_string().starts_with(&format!("0x{:04x}:", object.0)));
        assert!(!one.advice().is_empty());
    }
    // Other bits of the polarity and a feed constant of 1 are ignored.
    let unused = DriveUnits {
        polarity: Some(0x1F),
        feed_constant: Some([1, 1]),
        ..good
    };
    assert_eq!(unused.contradictions(&scale, None), []);
    // A geared drive; the configuration contains the counts after the gear.
    let geared = Scale::new(500.0, 5.0)
        .unwrap()
        .with_velocity_unit(VelocityUnit::RPM);
    let offered = DriveUnits {
        feed_constant: None,
        gear_ratio: Some([4, 1]),
        ..good
    };
    assert_eq!(offered.contradictions(&geared, None), []);
    // All contradictions together.
    let all = DriveUnits {
        encoder_resolution: Some([0, 0]),
        gear_ratio: Some([2, 1]),
        feed_constant: Some([0, 1]),
        position_unit: Some(0),
        velocity_unit: Some(0),
        acceleration_unit: Some(0),
        rated_torque: Some(1),
        torque_constant: None,
        polarity: Some(0xFF),
    };
    assert_eq!(all.contradictions(&scale, torque).len(), 8);
}

/// An EPOS4 with velocities in thousandths of rpm and accelerations still in rpm/s.
#[test]
fn acceleration_unit_other_than_velocity_unit_is_reported() {
    let offered = DriveUnits {
        velocity_unit: Some(0xFDB4_4700),
        acceleration_unit: Some(0x00C0_0300),
        ..DriveUnits::default()
    };
    let scale = epos(VelocityUnit::MILLI_RPM);
    let found = offered.contradictions(&scale, None);
    assert!(
        matches!(found.as_slice(), [UnitMismatch::AccelerationUnit { .. }]),
        "{found:?}"
    );
    let reported = scale.with_acceleration_unit(AccelerationUnit::RPM_PER_SECOND);
    assert_eq!(offered.contradictions(&reported, None), []);
    // 1000 rpm/s, 5 mm per turn.
    assert_eq!(
        reported
            .acceleration_to_raw(UserAcceleration(1000.0 / 60.0 * 5.0))
            .0,
        1000
    );
}

/// Drives with 0x6091 but neither 0x608F nor 0x6092: the encoder's resolution is not reported.
#[test]
fn a_gear_alone_is_compared_with_resolutions_that_encoders_have() {
    let found = |gear, counts| {
        let offered = DriveUnits {
            gear_ratio: Some(gear),
            ..DriveUnits::default()
        };
        let scale = Scale::new(counts, 1.0).unwrap();
        offered.contradictions(&scale, None)
    };
    // 23 bits, of which 10,000 counts are made.
    assert_eq!(found([8_388_608, 10_000], 10_000.0), []);
    assert_eq!(found([10_000, 2_500], 2_500.0), []);
    assert_eq!(found([7, 7], 10_000.0), []);
    for (gear, counts, impossible) in [
        // The same ratio, reduced.
        ([524_288, 625], 10_000.0, false),
        // 24 bits, or 23 bits and half the counts.
        ([2, 1], 8_388_608.0, false),
        ([8_388_608, 10_000], 8_388_608.0, true),
        ([3, 1], 2_000.0, true),
    ] {
        let [one] = found(gear, counts)[..] else {
            panic!("{gear:?} {counts}")
        };
        assert_eq!(one.object(), (0x6091, 1));
        assert_eq!(one.is_impossible_gear(), impossible, "{one}");
    }
}

#[test]
fn velocity_units_parse_as_they_are_written() {
    let rpm = |code: u32| VelocityUnit::from_si_code(code).unwrap();
    for (text, code) in [
        ("rpm", 0x00B4_4700),
        ("mrpm", 0xFDB4_4700),
        ("0.1rpm", 0xFFB4_4700),
        ("0.1 rpm", 0xFFB4_4700),
        ("0.01rpm", 0xFEB4_4700),
        ("0.00001 rpm", 0xFBB4_4700),
        ("10^-5 rpm", 0xFBB4_4700),
        ("10 counts/s", 0x01B5_0300),
        ("0.001turns/s", 0xFDB4_0300),
    ] {
        let unit: VelocityUnit = text.parse().unwrap();
        assert_eq!(unit, rpm(code), "{text}");
        assert_eq!(unit.to_string().parse(), Ok(unit), "{unit}");
    }
    for text in ["", "0.2rpm", "10^12 rpm", "1.0rpm", "rps", "0.1", "x rpm"] {
        assert!(text.parse::<VelocityUnit>().is_err(), "{text}");
    }
}
