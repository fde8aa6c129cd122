//! The drive on the dictionaries of real devices.

use std::path::PathBuf;

use ecaxis_esi::model::{Dictionary, EsiFile};

use super::*;
use crate::{DeviceOptions, SimDevice};

/// Reads an ESI file from `ECAXIS_FIXTURES`, or from `../shared/fixtures` next to the workspace. A
/// missing file is reported; on CI it is a failure.
fn esi(path: &str) -> Option<EsiFile> {
    let root = std::env::var_os("ECAXIS_FIXTURES").map_or_else(
        || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../shared/fixtures"),
        PathBuf::from,
    );
    let path = root.join("esi").join(path);
    match std::fs::read(&path) {
        Ok(bytes) => Some(ecaxis_esi::parse(&bytes).unwrap()),
        Err(error) => {
            assert!(std::env::var_os("CI").is_none(), "{path:?}: {error}");
            None
        }
    }
}

fn rig_of(dictionaries: &[&Dictionary]) -> Rig {
    let mut store = ObjectStore::from_dictionary(dictionaries);
    let drive = Drive::new(&mut store, PlantParams::default());
    let mut rig = rig();
    (rig.store, rig.drive) = (store, drive);
    rig.set(0x60c2, 1, 1);
    rig
}

fn moves_a_turn(rig: &mut Rig) {
    rig.enable(8);
    let start = rig.get(0x6064);
    for n in 1..=200 {
        rig.set(0x607a, 0, start + 10 * n);
        rig.cycle();
    }
    rig.run_ms(200);
    assert_eq!(rig.drive.state(), State::OperationEnabled);
    assert!((rig.get(0x6064) - start - 2000).abs() <= 1);
}

#[test]
fn epos4_moves_with_its_csp_module() {
    let Some(file) = esi("maxon/maxon_motor_EPOS4_0170h_6950h_0000h_0000h_ESI.xml") else {
        return;
    };
    let device = file.devices.first().unwrap();
    let module = file
        .modules
        .iter()
        .find(|module| module.name.contains("CSP") || module.type_name.contains("CSP"))
        .unwrap();
    let mut rig = rig_of(&[&device.dictionary, &module.dictionary]);
    let value = |rig: &Rig, index, sub| rig.store.get(rig.slot(index, sub));
    for (index, sub, expected) in [
        (0x6065, 0, 2000),
        (0x6085, 0, 10_000),
        (0x605a, 0, 6),
        (0x60a9, 0, 0x00b4_4700),
        (0x6076, 0, 118_400),
        (0x3001, 1, 3200),
        (0x3001, 2, 9600),
        (0x3000, 2, 0x0001_0111),
        (0x3000, 5, 2000),
        (0x3001, 4, 300),
        (0x3001, 5, 37_000),
        (0x3010, 1, 500),
        // 0.46 mH and 0.6 Ω at 2000 rad/s, µV/A and µV/(A·ms).
        (0x30a0, 1, 920_000),
        (0x30a0, 2, 1_200_000),
        (0x30a1, 5, 973),
        (0x30a2, 3, 541),
        (0x30a3, 5, 360_000),
        (0x60c2, 1, 1),
    ] {
        assert_eq!(value(&rig, index, sub), expected, "0x{index:04x}:{sub}");
    }
    moves_a_turn(&mut rig);
    assert!(rig.drive.objects.velocity_averaged.is_some());
    let choices = |index| rig.store.item(rig.slot(index, 0)).unwrap().choices;
    assert_eq!(choices(0x60a9).map(<[_]>::len), Some(7));
}

#[test]
fn drives_of_other_vendors_move() {
    for path in [
        "elmo/Elmo_ECAT_00010420_V11.xml",
        "synapticon/SOMANET_CiA_402_v4.xml",
        "stepperonline/STEPPERONLINE_A6_Servo_V0.02.xml",
        "inovance/SV660_EOE_1Axis_V9.12.xml",
    ] {
        let Some(file) = esi(path) else {
            return;
        };
        let device = file.devices.first().unwrap();
        let mut rig = rig_of(&[&device.dictionary]);
        moves_a_turn(&mut rig);
        // Only one of them has 0x60A9; the others use counts per second.
        let rpm = rig.store.slot(0x60a9, 0).is_some();
        assert_eq!(rpm, path.starts_with("synapticon"), "{path}");
        rig.set(0x60ff, 0, if rpm { 600 } else { 20_000 });
        rig.set(0x6060, 0, 9);
        rig.run_ms(300);
        assert!((rig.drive.velocity_rev_s() - 10.0).abs() < 0.1, "{path}");
    }
}

/// An ESI without factory values: the limits are those of the power stage, three times the rated
/// torque of the simulated motor.
#[test]
fn torque_limits_without_a_factory_value_are_the_peak() {
    let Some(file) = esi("elmo/Elmo_ECAT_00010420_V11.xml") else {
        return;
    };
    let described = |device: &&ecaxis_esi::Device| device.dictionary.object(0x6072).is_some();
    let device = file.devices.iter().find(described).unwrap();
    let rig = rig_of(&[&device.dictionary]);
    let value = |index| rig.store.get(rig.slot(index, 0));
    assert_eq!((value(0x6072), value(0x6073)), (3000, 3000));
}

/// 0x6065 at power-on is the `DefaultValue` or `DefaultData` of the vendor's ESI. Without one, it is
/// 0xFFFFFFFF: the supervision is off (CiA 402-2, following error window); maxon's drives have 2000
/// (EPOS4 firmware specification).
#[test]
fn following_error_window_has_its_factory_value() {
    for (path, expected) in [
        ("inovance/SV660_EOE_1Axis_V9.12.xml", 0x01a3_6ae7),
        (
            "stepperonline/STEPPERONLINE_A6_Servo_V0.02.xml",
            0x0010_0000,
        ),
        ("synapticon/SOMANET_CiA_402_v4.xml", 0xffff_ffff),
        ("elmo/Elmo_ECAT_00010420_V11.xml", 0xffff_ffff),
    ] {
        let Some(file) = esi(path) else {
            return;
        };
        let device = file.devices.first().unwrap();
        let options = DeviceOptions::default();
        let sim = SimDevice::from_esi(device, &file.modules, options).unwrap();
        let value = sim.object(0x6065, 0).unwrap();
        assert_eq!(value, u32::to_le_bytes(expected), "{path}");
    }
    let own = rig();
    assert_eq!(own.store.get(own.slot(0x6065, 0)), 2000);
}

/// The factory limits (0x607D, 7,129,736 to 9,713,015) exclude the position 0 of the axis.
#[test]
fn factory_limits_that_exclude_the_position_are_widened() {
    let Some(file) = esi("myactuator/MT-Device_250702.xml") else {
        return;
    };
    let dictionary = &file.devices.first().unwrap().dictionary;
    let limit = |sub| dictionary.item(0x607d, sub).unwrap().default.to_vec();
    assert_eq!(limit(1), 7_129_736_i32.to_le_bytes());
    assert_eq!(limit(2), 9_713_015_i32.to_le_bytes());
    moves_a_turn(&mut rig_of(&[dictionary]));
}

#[test]
fn drive_without_unit_objects_has_the_same_dynamics_in_counts() {
    let mut store = ObjectStore::default();
    Drive::new(&mut store, PlantParams::default());
    let value = |index| store.get(store.slot(index, 0).unwrap());
    // 10,000 rpm/s, 1000 rpm.
    assert_eq!((value(0x6085), value(0x6081)), (333_333, 33_333));
}
