use super::super::tests::{GOOD, with_esi};
use super::*;
use ecaxis_ecat::index::{AxisIndex, DeviceIndex};

const MILLI_RPM: u32 = 0xfdb4_4700;
const RPM: u32 = 0x00b4_4700;

fn axis(keys: &str) -> AxisSetup {
    let text = GOOD.replace("unit = \"mm\"", keys);
    with_esi(&text).unwrap().axes[AxisIndex(0)].clone()
}

fn offered() -> DriveUnits {
    DriveUnits {
        velocity_unit: Some(MILLI_RPM),
        ..DriveUnits::default()
    }
}

#[test]
fn adopt_keeps_the_setup_of_a_matching_drive() {
    for offered in [offered(), DriveUnits::default()] {
        let axis = axis("");
        let adopted = axis.adopt(&offered);
        assert_eq!(adopted.setup.config, axis.config);
        assert!(
            adopted.taken.is_empty() && adopted.wrong.is_empty() && adopted.doubtful.is_empty()
        );
    }
}

#[test]
#[rustfmt::skip] // one row per answer
fn adopt_reports_wrong_and_doubtful_units() {
    let file = "velocity_unit = \"mrpm\"";
    let nm = "torque_unit = \"Nm\"";
    let said = "torque_unit = \"Nm\"\nrated_torque = 100.0";
    let none = DriveUnits::default;
    for (keys, offered, wrong, doubtful) in [
        ("", DriveUnits { velocity_unit: Some(RPM), ..none() }, 0, 0),
        (file, DriveUnits { velocity_unit: Some(RPM), ..none() }, 1, 0),
        (file, DriveUnits { velocity_unit: Some(0x1234_5600), ..none() }, 0, 1),
        ("", DriveUnits { velocity_unit: Some(0x1234_5600), ..none() }, 1, 0),
        ("", DriveUnits { velocity_unit: Some(0), ..none() }, 0, 1),
        ("", DriveUnits { encoder_resolution: Some([4000, 2]), ..offered() }, 0, 0),
        ("", DriveUnits { encoder_resolution: Some([4000, 1]), ..offered() }, 1, 0),
        ("", DriveUnits { encoder_resolution: Some([0, 0]), ..offered() }, 0, 1),
        ("", DriveUnits { gear_ratio: Some([3, 1]), ..offered() }, 1, 0),
        ("", DriveUnits { position_unit: Some(0x00b5_0000), ..offered() }, 0, 0),
        ("", DriveUnits { position_unit: Some(0xfd01_0000), ..offered() }, 1, 0),
        ("", DriveUnits { position_unit: Some(0), ..offered() }, 0, 1),
        // EPOS4's rpm/s together with mrpm.
        ("", DriveUnits { acceleration_unit: Some(0x00c0_0300), ..offered() }, 0, 0),
        ("", DriveUnits { acceleration_unit: Some(0x1234_5600), ..offered() }, 0, 1),
        ("", DriveUnits { rated_torque: Some(0), ..offered() }, 0, 1),
        ("", DriveUnits { rated_torque: Some(7), ..offered() }, 0, 0),
        (nm, DriveUnits { rated_torque: Some(100_000), ..offered() }, 0, 0),
        (nm, DriveUnits { rated_torque: Some(0), ..offered() }, 1, 0),
        (nm, offered(), 1, 0),
        // 100 Nm at a rated torque of 1 Nm exceed 16 bits.
        (nm, DriveUnits { rated_torque: Some(1_000), ..offered() }, 1, 0),
        (said, DriveUnits { rated_torque: Some(7), ..offered() }, 0, 1),
        (said, offered(), 0, 0),
        ("", DriveUnits { polarity: Some(0xc0), ..offered() }, 0, 1),
        ("", DriveUnits { polarity: Some(0x80), ..offered() }, 1, 0),
        ("", DriveUnits { polarity: Some(0x00), ..offered() }, 0, 0),
    ] {
        let adopted = axis(keys).adopt(&offered);
        let found = (adopted.wrong.len(), adopted.doubtful.len());
        assert_eq!(found, (wrong, doubtful), "{keys} {offered:?}: {adopted:?}");
        for wrong in &adopted.wrong {
            assert!(wrong.to_string().contains("0x6"), "{wrong}");
        }
    }
}

#[test]
fn adopt_keeps_torques_in_nm() {
    let keys = "torque_unit = \"Nm\"\nsupervise = { torque = 50.0 }";
    let axis = axis(keys);
    // 200 Nm in mNm.
    let adopted = axis.adopt(&DriveUnits {
        rated_torque: Some(200_000),
        ..offered()
    });
    let setup = &adopted.setup;
    let near = |a: f64, b: f64| assert!((a - b).abs() < 1e-9, "{a} {b}");
    near(setup.config.limits.torque, 50.0);
    near(setup.torque.shown(setup.config.limits.torque), 100.0);
    near(setup.config.supervision.torque.unwrap().percent, 25.0);
    near(setup.config.torque_slope, 500.0);
    near(adopted.torque_factor, 0.5);
    assert_eq!(
        adopted.taken,
        ["a rated torque of 200 Nm, as the drive says in 0x6076"]
    );
}

#[test]
fn adopt_rescales_program_and_homing() {
    let mut machine = with_esi(GOOD).unwrap();
    let torque = |targets: &[(usize, f64)]| Action::Torque {
        targets: targets.iter().map(|&(n, x)| (AxisIndex(n), x)).collect(),
        ramp_ns: 0,
    };
    let step = |action| Step {
        number: "1".to_owned(),
        line: 1,
        uses: Vec::new(),
        action,
    };
    machine.steps = vec![
        step(torque(&[(0, 8.0), (1, 8.0)])),
        step(Action::Repeat {
            times: Some(2),
            until: None,
            steps: vec![step(torque(&[(0, 4.0)]))],
        }),
    ];
    let homing = ecaxis_axis::Homing {
        search_velocity: Some(5.0),
        acceleration: Some(50.0),
        ..ecaxis_axis::Homing::by(37)
    };
    let setup = &mut machine.axes[AxisIndex(0)];
    let sdo = |(index, sub, value): (u16, u8, u32)| esi::StartupSdo {
        transition: "PS",
        index,
        sub,
        complete_access: false,
        data: value.to_le_bytes().to_vec(),
        name: String::new(),
        origin: String::new(),
        optional: false,
    };
    // 1 turn/s in mrpm, 10 turns/s² in mrpm/s.
    let startup: Vec<_> = [(0x6099, 1, 60_000), (0x609a, 0, 600_000)].map(sdo).into();
    setup.homing = Some(HomingSetup {
        homing,
        startup: startup.clone(),
        timeout_ns: 1,
    });
    machine.devices[DeviceIndex(0)]
        .selection
        .startup
        .extend(startup);
    let setup = machine.axes[AxisIndex(0)].clone();
    let mut adopted = setup.adopt(&DriveUnits {
        velocity_unit: Some(RPM),
        acceleration_unit: Some(0x00c0_0300),
        ..DriveUnits::default()
    });
    assert_eq!(adopted.wrong, []);
    assert_eq!(adopted.taken.len(), 1, "{:?}", adopted.taken);
    let changed = adopted.changed(&machine.devices[DeviceIndex(0)].selection.startup);
    let values: Vec<_> = changed.iter().map(|s| (s.index, s.data.clone())).collect();
    let rpm = |n: u32| n.to_le_bytes().to_vec();
    assert_eq!(values, [(0x6099, rpm(60)), (0x609a, rpm(600))]);
    adopted.torque_factor = 0.25;
    machine.adopt(AxisIndex(0), &adopted);
    assert!(
        adopted
            .changed(&machine.devices[DeviceIndex(0)].selection.startup)
            .is_empty()
    );
    assert_eq!(machine.steps[0].action, torque(&[(0, 2.0), (1, 8.0)]));
    let Action::Repeat { steps, .. } = &machine.steps[1].action else {
        panic!("{:?}", machine.steps)
    };
    assert_eq!(steps[0].action, torque(&[(0, 1.0)]));
}
