use super::*;
use crate::units::UserAcceleration;

/// 2000 counts and 5 mm per turn.
fn epos(unit: VelocityUnit) -> Scale {
    Scale::new(2000.0, 5.0).unwrap().with_velocity_unit(unit)
}

/// What EPOS4 says by default, and one thing at a time that contradicts.
#[test]
fn contradictions() {
    let scale = epos(VelocityUnit::RPM);
    let good = Offered {
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
    assert_eq!(Offered::default().contradictions(&scale, torque), []);
    for (offered, object, text) in [
        (
            Offered {
                feed_constant: None,
                encoder_resolution: Some([4096, 1]),
                ..good
            },
            (0x608F, 1),
            "4096 counts per motor turn, expected 2000",
        ),
        (
            Offered {
                encoder_resolution: Some([2000, 0]),
                ..good
            },
            (0x608F, 2),
            "2000:0",
        ),
        (
            Offered {
                gear_ratio: Some([0, 7]),
                ..good
            },
            (0x6091, 1),
            "0:7",
        ),
        (
            Offered {
                feed_constant: None,
                gear_ratio: Some([4, 1]),
                ..good
            },
            (0x6091, 1),
            "500 counts",
        ),
        (
            Offered {
                feed_constant: None,
                encoder_resolution: None,
                gear_ratio: Some([1, 4]),
                ..good
            },
            (0x6091, 1),
            "8000 counts",
        ),
        (
            Offered {
                feed_constant: Some([36_000, 10]),
                ..good
            },
            (0x6092, 1),
            "3600 counts",
        ),
        (
            Offered {
                feed_constant: Some([1, 0]),
                ..good
            },
            (0x6092, 2),
            "1:0",
        ),
        (
            Offered {
                position_unit: Some(0x0041_0000),
                ..good
            },
            (0x60A8, 0),
            "0x00410000",
        ),
        (
            Offered {
                velocity_unit: Some(0xFDB4_4700),
                ..good
            },
            (0x60A9, 0),
            "(mrpm), expected rpm",
        ),
        (
            Offered {
                velocity_unit: Some(7),
                ..good
            },
            (0x60A9, 0),
            "is 0x00000007, expected rpm",
        ),
        (
            Offered {
                acceleration_unit: Some(0x00B5_5700),
                ..good
            },
            (0x60AA, 0),
            "(counts/s²), expected rpm/s",
        ),
        (
            Offered {
                rated_torque: Some(0),
                ..good
            },
            (0x6076, 0),
            "is 0",
        ),
        (
            Offered {
                rated_torque: Some(119_000),
                ..good
            },
            (0x6076, 0),
            "is 119000, expected 118350",
        ),
        (
            Offered {
                polarity: Some(0x80),
                ..good
            },
            (0x607E, 0),
            "0x80",
        ),
        (
            Offered {
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
    // Other bits of the polarity, and a feed of 1, mean nothing here.
    let unused = Offered {
        polarity: Some(0x3F),
        feed_constant: Some([1, 1]),
        ..good
    };
    assert_eq!(unused.contradictions(&scale, None), []);
    // A geared drive that the file describes as it counts.
    let geared = Scale::new(500.0, 5.0)
        .unwrap()
        .with_velocity_unit(VelocityUnit::RPM);
    let offered = Offered {
        feed_constant: None,
        gear_ratio: Some([4, 1]),
        ..good
    };
    assert_eq!(offered.contradictions(&geared, None), []);
    // All at once.
    let all = Offered {
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

/// EPOS4 whose velocities have been set to thousandths: its accelerations have not.
#[test]
fn an_acceleration_unit_that_did_not_follow() {
    let offered = Offered {
        velocity_unit: Some(0xFDB4_4700),
        acceleration_unit: Some(0x00C0_0300),
        ..Offered::default()
    };
    let scale = epos(VelocityUnit::MILLI_RPM);
    let found = offered.contradictions(&scale, None);
    assert!(
        matches!(found.as_slice(), [Contradiction::AccelerationUnit { .. }]),
        "{found:?}"
    );
    let told = scale.with_acceleration_unit(AccelerationUnit::RPM_PER_SECOND);
    assert_eq!(offered.contradictions(&told, None), []);
    // 1000 rpm/s, 5 mm per turn.
    assert_eq!(
        told.acceleration_to_raw(UserAcceleration(1000.0 / 60.0 * 5.0))
            .0,
        1000
    );
}
