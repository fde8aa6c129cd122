//! A device that its EEPROM image describes equals the device that the ESI file describes, wherever
//! an image can express it (ETG.2010).

use crate::common;
use ecaxis_esi::layout::SmLayout;
use ecaxis_esi::sii::{self, SiiOptions};
use ecaxis_esi::{Device, EsiFile, SelectOptions, Selection, parse, select};

fn selection(file: &EsiFile, device: &Device) -> Option<Selection> {
    let options = SelectOptions {
        cycle_ns: 1_000_000,
        ..SelectOptions::default()
    };
    select(file, device, &options).ok()
}

type Object = (u16, u16, u8, u32, u16);
type Area = (u8, u16, u16, u8, Option<u8>);

/// Returns what a MainDevice configures.
fn process_data(selection: &Selection) -> (Vec<Object>, Vec<Area>) {
    let layout = &selection.layout;
    let fields = layout.rx.iter().chain(&layout.tx);
    let objects = fields.map(|f| (f.pdo, f.index, f.sub, f.bit_offset, f.bit_len));
    let sms = layout.outputs.iter().chain(&layout.inputs);
    let area = |sm: &SmLayout| (sm.sm, sm.start_address, sm.len, sm.control_byte, sm.fmmu);
    (objects.collect(), sms.map(area).collect())
}

/// Returns an image's device, unless the ESI says more of the process data than an image can: modules,
/// assignments of OpModes, PDOs that exclude others.
fn from_image(file: &EsiFile, device: &Device) -> Option<EsiFile> {
    let pdos = || device.rx_pdos.iter().chain(&device.tx_pdos);
    let wide = pdos().flat_map(|pdo| &pdo.entries);
    let expressible = device.slots.is_none()
        && device
            .dc_modes
            .iter()
            .all(|mode| mode.sync_managers.is_empty())
        && pdos().all(|pdo| pdo.exclude.is_empty() && pdo.entries.len() <= 255)
        && { wide }.all(|entry| entry.bit_len <= 255);
    let image = sii::emit(device, &file.modules, &SiiOptions::default());
    let parsed = sii::parse(&image).expect("an image");
    expressible.then(|| parsed.to_esi_file())
}

#[test]
fn device_of_an_image_is_configured_like_that_of_its_esi() {
    let (mut same, mut other) = (0, Vec::new());
    let own = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/esi");
    let own = std::fs::read_dir(own)
        .expect("our files")
        .flatten()
        .map(|entry| entry.path());
    for path in common::files("esi", &["xml"]).into_iter().chain(own) {
        let Ok(file) = parse(&std::fs::read(&path).expect("readable")) else {
            continue;
        };
        for device in &file.devices {
            let (Some(expected), Some(image)) =
                (selection(&file, device), from_image(&file, device))
            else {
                continue;
            };
            let described = &image.devices[0];
            let actual = selection(&image, described);
            let name = format!("{} {}", path.display(), device.type_name);
            assert_eq!(described.identity, device.identity, "{name}");
            let dc = |s: &Selection| {
                let dc = s.dc.as_ref()?;
                Some((
                    dc.assign_activate,
                    dc.sync0_cycle_ns,
                    dc.sync0_shift_ns,
                    dc.sync1_delay_ns,
                ))
            };
            let alike = actual.as_ref().is_some_and(|actual| {
                process_data(actual) == process_data(&expected) && dc(actual) == dc(&expected)
            });
            let mailbox = |d: &Device| {
                d.mailbox
                    .as_ref()
                    .map(|m| (m.coe.is_some(), m.foe, m.eoe.is_some()))
            };
            if alike && mailbox(described) == mailbox(device) {
                same += 1;
            } else {
                other.push(format!("{name} {:08x}", device.identity.revision));
            }
        }
    }
    println!("{same} devices alike, {} differ: {other:#?}", other.len());
    // Those of our own files, at least.
    assert!(same >= 12, "{same}");
    assert_eq!(other, Vec::<String>::new());
}
