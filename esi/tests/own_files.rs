//! The ESI files of ecaxis have the expected contents and cause no warnings.

use std::path::Path;

use ecaxis_esi::{
    DeviceQuery, EsiFile, Mode, SelectError, SelectOptions, Selection, Writable, find_device,
    offered_modes, parse, select, sii,
};

const MODES: [Mode; 3] = [Mode::Csp, Mode::Csv, Mode::Cst];

fn file(name: &str) -> EsiFile {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../configs/esi")
        .join(name);
    let file = parse(&std::fs::read(path).unwrap()).unwrap();
    assert!(file.warnings.is_empty(), "{:?}", file.warnings);
    file
}

fn choose(file: &EsiFile, mode: Option<Mode>) -> Selection {
    let device = find_device(file, &DeviceQuery::default()).unwrap();
    select(
        file,
        device,
        &SelectOptions {
            mode,
            cycle_ns: 1_000_000,
            ..SelectOptions::default()
        },
    )
    .unwrap()
}

fn value(selection: &Selection, index: u16, sub: u8) -> Option<Vec<u8>> {
    selection
        .startup
        .iter()
        .rev()
        .find(|sdo| (sdo.index, sdo.sub) == (index, sub))
        .map(|sdo| sdo.data.clone())
}

#[test]
fn epos4_modes_are_modules() {
    let file = file("EPOS4.xml");
    let device = &file.devices[0];
    assert_eq!(
        offered_modes(&file, device),
        [Mode::Pp, Mode::Pv, Mode::Csp, Mode::Csv, Mode::Cst]
    );
    for mode in MODES {
        let selection = choose(&file, Some(mode));
        let ident = selection.modules[0].ident;
        assert_eq!(
            value(&selection, 0xf030, 1),
            Some(ident.to_le_bytes().to_vec())
        );
        assert_eq!(
            value(&selection, 0x6060, 0),
            Some(vec![mode.code().to_le_bytes()[0]])
        );
        assert_eq!(selection.dc.as_ref().unwrap().assign_activate, 0x300);
        assert!(selection.notes.is_empty(), "{mode}: {:?}", selection.notes);
        for index in [0x6040, mode.target_object().unwrap()] {
            assert!(
                selection.layout.rx_field(index, 0).is_some(),
                "{mode} 0x{index:04x}"
            );
        }
        for index in [0x6041, 0x6061, mode.actual_object()] {
            assert!(
                selection.layout.tx_field(index, 0).is_some(),
                "{mode} 0x{index:04x}"
            );
        }
    }
    let csp = choose(&file, Some(Mode::Csp));
    assert_eq!((csp.layout.rx_bytes(), csp.layout.tx_bytes()), (12, 13));
    assert_eq!(
        (value(&csp, 0x60c2, 1), value(&csp, 0x60c2, 2)),
        (Some(vec![1]), Some(vec![0xfd]))
    );
    // Without a mode, the slot's default module applies.
    assert_eq!(choose(&file, None).modules[0].type_name, "CSP");
}

#[test]
fn idx_modes_are_pdo_sets() {
    let file = file("IDX.xml");
    for (mode, rx, tx) in [
        (Mode::Csp, 0x1600, 0x1a00),
        (Mode::Csv, 0x1601, 0x1a00),
        (Mode::Cst, 0x1602, 0x1a00),
    ] {
        let selection = choose(&file, Some(mode));
        assert_eq!((selection.rx.len(), selection.tx.len()), (1, 1));
        assert_eq!(
            (selection.rx[0].index, selection.tx[0].index),
            (rx, tx),
            "{mode}"
        );
        assert_eq!(
            value(&selection, 0x1c12, 1),
            Some(rx.to_le_bytes().to_vec())
        );
        // SM-synchronous is first in the file, but a synchronous mode requires the clock.
        assert_eq!(selection.dc.as_ref().unwrap().name, "DC");
        let cleared = (0x1600u16..0x1604).filter(|pdo| *pdo != rx);
        assert!(
            cleared
                .into_iter()
                .all(|pdo| value(&selection, pdo, 0) == Some(vec![0])),
            "{mode}"
        );
    }
}

#[test]
fn io8_maps_bits_without_a_mailbox() {
    let selection = choose(&file("IO8.xml"), None);
    assert!(selection.startup.is_empty() && selection.dc.is_none());
    assert_eq!(
        (selection.layout.rx_bytes(), selection.layout.tx_bytes()),
        (1, 1)
    );
    let offsets: Vec<u32> = selection
        .layout
        .rx
        .iter()
        .map(|field| field.bit_offset)
        .collect();
    assert_eq!(offsets, [0, 1, 2, 3, 4, 5, 6, 7]);
}

#[test]
fn own_images_fit_their_eeproms() {
    for name in ["EPOS4.xml", "IDX.xml", "IO8.xml"] {
        let file = file(name);
        let image = sii::emit(&file.devices[0], &file.modules, &sii::SiiOptions::default());
        assert_eq!(image.len(), 2048, "{name}");
        let sii = sii::parse(&image).unwrap();
        assert_eq!(sii.identity, file.devices[0].identity);
        let layout = choose(&file, None).layout;
        for sm in layout.outputs.iter().chain(&layout.inputs) {
            assert_eq!(
                sii.sync_managers[usize::from(sm.sm)].len,
                sm.len,
                "{name} SM{}",
                sm.sm
            );
        }
    }
}

#[test]
fn a_read_only_mode_is_not_written() {
    let mut file = file("IDX.xml");
    let items = file.devices[0].dictionary.objects.iter_mut();
    for object in items.filter(|object| object.index == 0x6060) {
        object.items[0].access.write = Writable::Never;
    }
    let selection = choose(&file, Some(Mode::Csp));
    assert_eq!(value(&selection, 0x6060, 0), None);
    let noted = |note: &String| note.contains("0x6060 is read-only");
    assert!(selection.notes.iter().any(noted), "{:?}", selection.notes);
}

#[test]
fn sync_managers_must_lie_in_device_memory() {
    let with = |sm: usize, start: u16| {
        let mut file = file("IDX.xml");
        file.devices[0].sync_managers[sm].start_address = start;
        let choice = SelectOptions {
            mode: Some(Mode::Csp),
            cycle_ns: 1_000_000,
            ..SelectOptions::default()
        };
        let position = file.devices[0].sync_managers[sm].position;
        (select(&file, &file.devices[0], &choice), position)
    };
    let fits = choose(&file("IDX.xml"), Some(Mode::Csp)).layout.outputs[0].len;
    // Three buffers that end at the last byte of the address space.
    let last = u16::try_from(0x1_0000 - 3 * u32::from(fits)).unwrap();
    assert!(with(2, last).0.is_ok());
    for (sm, start) in [(2, last + 1), (2, 0x0800), (0, 0xfff0), (1, 0x0120)] {
        let (result, position) = with(sm, start);
        let error = result.unwrap_err();
        assert!(
            matches!(error, SelectError::SyncManagerOutside { sm: n, start: at, .. }
                if usize::from(n) == sm && at == start),
            "{error}"
        );
        assert!(position.line > 0 && error.to_string().contains(&format!("Sm at {position} ")));
    }
}

#[test]
fn profile_number_is_read_from_profile_or_channel() {
    let file = |device: &str, module: &str| {
        let text = format!(
            "<EtherCATInfo><Vendor><Id>1</Id></Vendor><Descriptions><Devices><Device>\
             <Type ProductCode=\"1\">D</Type><Profile>{device}</Profile></Device></Devices>\
             <Modules><Module><Type ModuleIdent=\"1\">M</Type><Profile>{module}</Profile></Module>\
             </Modules></Descriptions></EtherCATInfo>"
        );
        let file = parse(text.as_bytes()).unwrap();
        (file.devices[0].profile, file.modules[0].profile)
    };
    let no = |n: u32| format!("<ProfileNo>{n}</ProfileNo>");
    let channel = |n: u32| format!("<ChannelInfo>{}</ChannelInfo>", no(n));
    assert_eq!(
        file(&no(5001), &(channel(402) + &channel(401))),
        (Some(5001), Some(402))
    );
    assert_eq!(
        file(&(channel(402) + &no(5001)), ""),
        (Some(5001), None),
        "the device's own number wins"
    );
}

/// Counts above 255 are cut; the device itself rejects such an image.
#[test]
fn image_cuts_counts_above_a_byte() {
    let mut file = file("IDX.xml");
    let device = &mut file.devices[0];
    let sm = device.sync_managers[2].clone();
    device.sync_managers.resize(300, sm);
    device.fmmus.resize(300, device.fmmus[0]);
    let mut entry = device.rx_pdos[0].entries[0].clone();
    entry.bit_len = 1;
    device.rx_pdos[0].entries.resize(300, entry);
    let choice = SelectOptions {
        mode: Some(Mode::Csp),
        cycle_ns: 1_000_000,
        ..SelectOptions::default()
    };
    let selection = select(&file, &file.devices[0], &choice).unwrap();
    assert_eq!(value(&selection, 0x1600, 0), Some(vec![255]));
    let options = sii::SiiOptions::default();
    assert!(sii::parse(&sii::emit(&file.devices[0], &file.modules, &options)).is_ok());
}

#[test]
fn dictionary_keeps_backup_setting_and_unit_of_each_object() {
    let file = file("../../tests/judges/esi/mailbox.xml");
    let dictionary = &file.devices[0].dictionary;
    for (index, backup, setting, unit) in [
        (0x2020, true, true, 0xfd01_0000),
        (0x2002, true, false, 0),
        (0x2025, false, false, 0),
    ] {
        let item = dictionary.item(index, 0).unwrap();
        let reported = (item.backup, item.setting, item.unit);
        assert_eq!(reported, (backup, setting, unit), "0x{index:04x}");
    }
}
