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
            "8000 counts",
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
        polarity: Some(0x3F),
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
