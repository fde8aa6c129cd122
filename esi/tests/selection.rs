//! From a vendor file and a choice to layout and start-up list.

mod eni;
mod modules;

use crate::common;
use ecaxis_esi::{
    DeviceQuery, EntryRef, EsiFile, Mode, SelectError, SelectOptions, Selection, StartupSdo,
    UserSdo, find_device, offered_modes, parse, select,
};

const MS: u64 = 1_000_000;

fn file(path: &str) -> Option<EsiFile> {
    common::read(path).map(|bytes| parse(&bytes).unwrap())
}

fn choose(file: &EsiFile, choice: &SelectOptions) -> Result<Selection, SelectError> {
    select(file, find_device(file, &DeviceQuery::default())?, choice)
}

fn for_mode(mode: Mode) -> SelectOptions<'static> {
    SelectOptions {
        mode: Some(mode),
        cycle_ns: MS,
        ..SelectOptions::default()
    }
}

/// Returns index, subindex and value, as in application notes and ENI files.
fn written(startup: &[StartupSdo]) -> Vec<(u16, u8, u64)> {
    startup
        .iter()
        .map(|sdo| {
            let mut bytes = [0; 8];
            bytes[..sdo.data.len()].copy_from_slice(&sdo.data);
            (sdo.index, sdo.sub, u64::from_le_bytes(bytes))
        })
        .collect()
}

/// The sequence of the vendor's set-up example, with the objects of this module.
#[test]
fn epos4_csp_starts_like_the_vendor_example() {
    let Some(file) = file(common::EPOS4) else {
        return;
    };
    let csp = choose(&file, &for_mode(Mode::Csp)).unwrap();
    assert_eq!(csp.modules[0].ident, 0x6800_000c);
    assert_eq!(
        written(&csp.startup),
        [
            (0xf030, 0, 0),
            (0xf030, 1, 0x6800_000c),
            (0xf030, 0, 1),
            (0x1c12, 0, 0),
            (0x1c13, 0, 0),
            (0x1a00, 0, 0),
            (0x1a00, 1, 0x6041_0010),
            (0x1a00, 2, 0x6064_0020),
            (0x1a00, 3, 0x606c_0020),
            (0x1a00, 4, 0x6077_0010),
            (0x1a00, 5, 0x6061_0008),
            (0x1a00, 6, 0x60fd_0020),
            (0x1a00, 0, 6),
            (0x1a01, 0, 0),
            (0x1a02, 0, 0),
            (0x1a03, 0, 0),
            (0x1600, 0, 0),
            (0x1600, 1, 0x6040_0010),
            (0x1600, 2, 0x607a_0020),
            (0x1600, 3, 0x60b0_0020),
            (0x1600, 4, 0x60b2_0010),
            (0x1600, 5, 0x6060_0008),
            (0x1600, 6, 0x60fe_0120),
            (0x1600, 0, 6),
            (0x1601, 0, 0),
            (0x1602, 0, 0),
            (0x1603, 0, 0),
            (0x1c12, 1, 0x1600),
            (0x1c12, 0, 1),
            (0x1c13, 1, 0x1a00),
            (0x1c13, 0, 1),
            (0x60c2, 1, 1),
            (0x60c2, 2, 0xfd),
            (0x6060, 0, 8),
        ]
    );
    assert!(
        csp.startup
            .iter()
            .all(|sdo| sdo.transition == "PS" && !sdo.origin.is_empty())
    );
    let layout = &csp.layout;
    assert_eq!((layout.rx_bytes(), layout.tx_bytes()), (17, 17));
    assert_eq!(layout.rx_field(0x607a, 0).unwrap().bit_offset, 16);
    assert_eq!(layout.tx_field(0x6061, 0).unwrap().bit_offset, 96);
    assert_eq!(
        (layout.outputs[0].start_address, layout.outputs[0].fmmu),
        (0x1060, Some(0))
    );
    let dc = csp.dc.unwrap();
    assert_eq!(
        (dc.assign_activate, dc.sync0_cycle_ns, dc.sync1_delay_ns),
        (0x300, 1_000_000, 0)
    );
    // 0x60A9 belongs to the device, 0x60C2 and 0x6065 to the module.
    for index in [0x60a9, 0x60c2, 0x6065] {
        assert!(csp.dictionary.object(index).is_some(), "0x{index:04x}");
    }
}

#[test]
fn epos4_torque_mode_writes_only_zero_as_interpolation_time() {
    let Some(file) = file(common::EPOS4) else {
        return;
    };
    let cst = choose(&file, &for_mode(Mode::Cst)).unwrap();
    let sdos = written(&cst.startup);
    assert!(sdos.contains(&(0x60c2, 1, 0)));
    assert!(!sdos.iter().any(|sdo| (sdo.0, sdo.1) == (0x60c2, 2)));
    assert!(sdos.contains(&(0x6060, 0, 10)));
}

#[test]
fn epos4_rejects_unsupported_choices() {
    let Some(file) = file(common::EPOS4) else {
        return;
    };
    let error = choose(&file, &for_mode(Mode::Hm)).unwrap_err().to_string();
    assert!(
        error.contains("hm") && error.contains("csp (module \"CSP Mode\")"),
        "{error}"
    );
    let device = find_device(&file, &DeviceQuery::default()).unwrap();
    assert_eq!(
        offered_modes(&file, device),
        [Mode::Pp, Mode::Pv, Mode::Csp, Mode::Csv, Mode::Cst]
    );
    let odd = SelectOptions {
        cycle_ns: 125_000,
        ..for_mode(Mode::Csp)
    };
    let error = choose(&file, &odd).unwrap_err().to_string();
    assert!(error.contains("120 µs and 130 µs"), "{error}");
    let dc = SelectOptions {
        dc_mode: Some("fast"),
        ..for_mode(Mode::Csp)
    };
    let error = choose(&file, &dc).unwrap_err().to_string();
    assert!(error.contains("\"Synchron\""), "{error}");
    let dc = SelectOptions {
        dc_mode: Some("synchron"),
        ..for_mode(Mode::Csp)
    };
    assert_eq!(choose(&file, &dc).unwrap().dc, None);
}

#[test]
fn user_entries_replace_module_entries() {
    let Some(file) = file(common::EPOS4) else {
        return;
    };
    let entry = |index| EntryRef { index, sub: 0 };
    let (rx, tx) = (
        [entry(0x6040), entry(0x607a)],
        [entry(0x6041), entry(0x6064)],
    );
    let own = SelectOptions {
        rx: Some(&rx),
        tx: Some(&tx),
        ..for_mode(Mode::Csp)
    };
    let selection = choose(&file, &own).unwrap();
    assert_eq!(
        (selection.layout.rx_bytes(), selection.layout.tx_bytes()),
        (6, 6)
    );
    let sdos = written(&selection.startup);
    let mapped: Vec<_> = sdos.iter().filter(|sdo| sdo.0 == 0x1600).collect();
    assert_eq!(
        mapped,
        [
            &(0x1600, 0, 0),
            &(0x1600, 1, 0x6040_0010),
            &(0x1600, 2, 0x607a_0020),
            &(0x1600, 0, 2)
        ]
    );

    let origin = &selection
        .startup
        .iter()
        .find(|sdo| sdo.index == 0x1600)
        .unwrap()
        .origin;
    assert!(
        origin.starts_with("pdo.rx in module \"CSP Mode\" RxPdo 0x1600 (line "),
        "{origin}"
    );

    let without_target = [entry(0x6040)];
    let error = choose(
        &file,
        &SelectOptions {
            rx: Some(&without_target),
            ..own
        },
    )
    .unwrap_err();
    assert!(
        matches!(error, SelectError::MissingEntry { index: 0x607a, .. }),
        "{error}"
    );
    let unmappable = [entry(0x6041), entry(0x6064), entry(0x1008)];
    let error = choose(
        &file,
        &SelectOptions {
            tx: Some(&unmappable),
            ..own
        },
    )
    .unwrap_err();
    assert!(
        matches!(error, SelectError::NotMappable { index: 0x1008, .. }),
        "{error}"
    );
    let unknown = [entry(0x6041), entry(0x6064), entry(0x5fff)];
    let error = choose(
        &file,
        &SelectOptions {
            tx: Some(&unknown),
            ..own
        },
    )
    .unwrap_err();
    assert!(
        matches!(error, SelectError::UnknownEntry { index: 0x5fff, .. }),
        "{error}"
    );
    let many = [entry(0x6040); 13];
    let error = choose(
        &file,
        &SelectOptions {
            rx: Some(&many),
            ..own
        },
    )
    .unwrap_err();
    assert!(
        matches!(error, SelectError::TooManyEntries { max: 12, .. }),
        "{error}"
    );
}

#[test]
fn user_sdos_come_last_and_must_have_the_right_size() {
    let Some(file) = file(common::EPOS4) else {
        return;
    };
    let window = UserSdo {
        index: 0x6065,
        sub: 0,
        data: vec![0xd0, 7, 0, 0],
    };
    let short = UserSdo {
        data: vec![1],
        ..window.clone()
    };
    let fits = [window];
    let selection = choose(
        &file,
        &SelectOptions {
            sdo: &fits,
            ..for_mode(Mode::Csp)
        },
    )
    .unwrap();
    let last = selection.startup.last().unwrap();
    assert_eq!(
        (last.index, last.name.as_str()),
        (0x6065, "Following error window")
    );
    let error = choose(
        &file,
        &SelectOptions {
            sdo: &[short],
            ..for_mode(Mode::Csp)
        },
    )
    .unwrap_err();
    assert!(
        matches!(
            error,
            SelectError::SdoLength {
                given: 1,
                expected: 4,
                ..
            }
        ),
        "{error}"
    );
}

/// Fixed PDOs exclude each other: the mode selects the assigned PDO, and no mapping is written.
#[test]
fn elmo_modes_select_their_fixed_pdo() {
    let Some(file) = file("esi/elmo/Elmo_ECAT_00010420_V11.xml") else {
        return;
    };
    let device = find_device(
        &file,
        &DeviceQuery {
            product: Some(0x0003_0924),
            ..DeviceQuery::default()
        },
    )
    .unwrap();
    assert_eq!(device.identity.revision, 0x0001_0420);
    for (mode, rx, tx) in [
        (Mode::Csp, 0x1600, 0x1a00),
        (Mode::Csv, 0x1601, 0x1a03),
        (Mode::Cst, 0x1602, 0x1a02),
    ] {
        let selection = select(&file, device, &for_mode(mode)).unwrap();
        let indices =
            |pdos: &[ecaxis_esi::Pdo]| pdos.iter().map(|pdo| pdo.index).collect::<Vec<_>>();
        assert_eq!(
            (indices(&selection.rx), indices(&selection.tx)),
            (vec![rx], vec![tx]),
            "{mode}"
        );
        assert!(
            !selection.startup.iter().any(|sdo| sdo.index == rx),
            "{mode}: fixed contents are not written"
        );
    }
    let any = DeviceQuery {
        name: Some("elmo drive"),
        ..DeviceQuery::default()
    };
    assert!(matches!(
        find_device(&file, &any),
        Err(SelectError::Ambiguous { .. })
    ));
    let none = DeviceQuery {
        revision: Some(7),
        ..DeviceQuery::default()
    };
    let error = find_device(&file, &none).unwrap_err().to_string();
    assert!(error.contains("0x00030925"), "{error}");
}

/// An InitCmd that sets mode 8 must not override the user's mode.
#[test]
fn a_device_mode_command_yields_to_the_user_mode() {
    let Some(file) = file("esi/stepperonline/STEPPERONLINE_A6_Servo_V0.02.xml") else {
        return;
    };
    let selection = choose(&file, &for_mode(Mode::Cst)).unwrap();
    assert_eq!(selection.rx[0].index, 0x1702);
    let modes: Vec<_> = written(&selection.startup)
        .into_iter()
        .filter(|sdo| sdo.0 == 0x6060)
        .collect();
    assert_eq!(modes, [(0x6060, 0, 10)]);
    assert!(
        selection
            .notes
            .iter()
            .any(|note| note.contains("another mode")),
        "{:?}",
        selection.notes
    );
}

/// The default of each vendor file is accepted, except for drives with SoE only.
#[test]
fn every_device_is_selectable_with_its_defaults() {
    let mut devices = 0;
    for path in common::files("esi", &["xml"]) {
        let file = parse(&std::fs::read(&path).unwrap()).unwrap();
        for device in &file.devices {
            let choice = SelectOptions {
                cycle_ns: MS,
                ..SelectOptions::default()
            };
            match select(&file, device, &choice) {
                Ok(selection) => {
                    let bits: u32 = selection.rx.iter().map(|pdo| pdo.bit_len()).sum();
                    assert!(
                        selection.layout.rx_bytes() * 8 >= bits as usize,
                        "{}",
                        device.name
                    );
                }
                Err(SelectError::ModuleNeeded { .. }) => {}
                Err(error) => panic!("{} {}: {error}", path.display(), device.name),
            }
            for mode in offered_modes(&file, device) {
                if let Err(error) = select(&file, device, &for_mode(mode)) {
                    println!("{} {mode}: {error}", device.name);
                }
            }
            devices += 1;
        }
    }
    println!("{devices} devices");
}

#[test]
fn a_coupler_terminal_has_bits_and_no_sdos() {
    let Some(file) = file("esi/beckhoff/Beckhoff EL1xxx.xml") else {
        return;
    };
    let device = find_device(
        &file,
        &DeviceQuery {
            name: Some("EL1008"),
            ..DeviceQuery::default()
        },
    )
    .unwrap();
    let selection = select(
        &file,
        device,
        &SelectOptions {
            cycle_ns: MS,
            ..SelectOptions::default()
        },
    )
    .unwrap();
    assert_eq!(
        (selection.layout.rx_bytes(), selection.layout.tx_bytes()),
        (0, 1)
    );
    assert_eq!(selection.layout.tx.len(), 8);
    assert!(selection.startup.is_empty());
}

/// Elmo's InitCmd sets 2 for its default cycle of 2 ms. The drive must receive the cycle of this
/// bus.
#[test]
fn a_device_interpolation_time_yields_to_the_bus_cycle() {
    let Some(file) = file("esi/elmo/Elmo_ECAT_00010420_V11.xml") else {
        return;
    };
    let commanded = |device: &&ecaxis_esi::Device| {
        let coe = device.mailbox.as_ref().and_then(|m| m.coe.as_ref());
        coe.is_some_and(|coe| coe.init_cmds.iter().any(|cmd| cmd.index == 0x60c2))
    };
    let device = file.devices.iter().find(commanded).unwrap();
    let fast = SelectOptions {
        cycle_ns: MS / 4,
        ..for_mode(Mode::Csp)
    };
    let selection = select(&file, device, &fast).unwrap();
    let times: Vec<_> = written(&selection.startup)
        .into_iter()
        .filter(|sdo| sdo.0 == 0x60c2)
        .collect();
    assert_eq!(times, [(0x60c2, 1, 25), (0x60c2, 2, 0xfb)]);
    let left_out = |selection: &Selection| {
        let notes = selection.notes.iter();
        notes.filter(|note| note.contains("0x60c2:01")).count()
    };
    assert_eq!(left_out(&selection), 1, "{:?}", selection.notes);
    // If no value follows from the cycle, the vendor's value stays.
    let any = SelectOptions {
        cycle_ns: MS / 4,
        ..SelectOptions::default()
    };
    let selection = select(&file, device, &any).unwrap();
    assert!(written(&selection.startup).contains(&(0x60c2, 1, 2)));
    assert_eq!(left_out(&selection), 0);
}

/// One `ChannelInfo` per axis also declares a drive.
#[test]
fn the_drive_profile_may_be_in_a_channel() {
    for path in [
        "esi/stepperonline/STEPPERONLINE_A6_Servo_V0.02.xml",
        "esi/inovance/SV660_EOE_1Axis_V9.12.xml",
        "esi/hpmicro/ECAT_CIA402.xml",
    ] {
        let Some(file) = file(path) else { return };
        assert_eq!(file.devices[0].profile, Some(402), "{path}");
        let selection = choose(&file, &for_mode(Mode::Csp)).unwrap();
        for index in [0x6040, 0x607a] {
            assert!(selection.layout.rx_field(index, 0).is_some(), "{path}");
        }
    }
}
