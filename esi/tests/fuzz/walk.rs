//! Passes an ESI file through all steps: parse → every choice → layout and start-up list → EEPROM
//! image → parse again. Used by `cargo test` and the coverage-guided fuzz target.

use ecaxis_esi::{
    Device, EntryRef, EsiFile, Field, Mode, SelectOptions, Selection, SmLayout, lint,
    offered_modes, parse, parse_where, select, sii,
};

/// Counters of the inputs that reached each step.
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
pub struct Reached {
    pub files: u64,
    pub read: u64,
    pub choices: u64,
    pub selected: u64,
    pub images: u64,
}

/// Panics if a property fails. Errors in the file itself are accepted.
pub fn walk(bytes: &[u8], reached: &mut Reached) {
    reached.files += 1;
    let file = match parse(bytes) {
        Ok(file) => file,
        Err(error) => {
            assert!(error.position().line >= 1 && error.position().column >= 1);
            assert!(!error.to_string().is_empty());
            return;
        }
    };
    reached.read += 1;
    let none = parse_where(bytes, &|_| false).expect("a readable file");
    assert!(none.devices.is_empty() && none.skipped.len() >= file.devices.len());
    for finding in lint(&file) {
        assert!(!finding.path.is_empty() && !finding.message.is_empty());
    }
    for device in file.devices.iter().take(3) {
        choices(&file, device, reached);
        image(&file, device, reached);
    }
}

fn choices(file: &EsiFile, device: &Device, reached: &mut Reached) {
    let plain = SelectOptions {
        cycle_ns: 1_000_000,
        ..SelectOptions::default()
    };
    let mut own: Vec<EntryRef> = Vec::new();
    let mut all = vec![plain];
    let modes = offered_modes(file, device).into_iter();
    let modes: Vec<Mode> = modes.collect();
    all.extend(modes.iter().map(|&mode| SelectOptions {
        mode: Some(mode),
        cycle_ns: 125_000,
        ..plain
    }));
    all.extend(
        device
            .sm_mappings
            .iter()
            .take(3)
            .map(|mapping| SelectOptions {
                assignment: Some(&mapping.name),
                ..plain
            }),
    );
    all.extend(device.dc_modes.iter().take(4).map(|mode| SelectOptions {
        dc_mode: Some(&mode.name),
        cycle_ns: 3_333_333,
        ..plain
    }));
    let idents: Vec<String> = file
        .modules
        .iter()
        .take(3)
        .map(|module| format!("0x{:x}", module.ident))
        .collect();
    let modules: Vec<[&str; 3]> = idents
        .iter()
        .flat_map(|ident| {
            [
                [ident.as_str(), "-", "-"],
                ["-", ident, ident],
                [ident.as_str(); 3],
            ]
        })
        .collect();
    all.extend(modules.iter().map(|modules| SelectOptions {
        modules: Some(modules),
        ..plain
    }));
    for pdo in device.rx_pdos.iter().chain(&device.tx_pdos).take(4) {
        own.extend(pdo.entries.iter().take(4).map(|entry| EntryRef {
            index: entry.index,
            sub: entry.sub,
        }));
    }
    let (rx, tx) = (Some(own.as_slice()), Some(own.as_slice()));
    all.extend([SelectOptions { rx, ..plain }, SelectOptions { tx, ..plain }]);
    for choice in &all {
        reached.choices += 1;
        if let Ok(selection) = select(file, device, choice) {
            reached.selected += 1;
            holds(&selection);
        }
    }
}

fn holds(selection: &Selection) {
    let layout = &selection.layout;
    direction(&layout.outputs, &layout.rx);
    direction(&layout.inputs, &layout.tx);
    for pdo in selection.rx.iter().chain(&selection.tx) {
        assert!(pdo.sm.is_some(), "a chosen PDO has its SyncManager");
    }
    let order = ["IP", "PS", "SO"];
    let at = |transition| order.iter().position(|t| *t == transition);
    let steps: Vec<_> = selection.startup.iter().map(|s| at(s.transition)).collect();
    assert!(steps.is_sorted() && steps.iter().all(Option::is_some));
}

/// Checks that fields are consecutive and end inside the SyncManagers.
fn direction(sms: &[SmLayout], fields: &[Field]) {
    let mut end = 0;
    for field in fields {
        assert!(field.bit_offset >= end, "fields overlap");
        end = field.bit_offset + u32::from(field.bit_len);
    }
    let bytes: u32 = sms.iter().map(|sm| u32::from(sm.len)).sum();
    assert!(end <= bytes * 8, "a field lies outside");
}

fn image(file: &EsiFile, device: &Device, reached: &mut Reached) {
    let image = sii::emit(device, &file.modules, &sii::SiiOptions::default());
    let Ok(parsed) = sii::parse(&image) else {
        panic!("an emitted image cannot be read");
    };
    // A complete image in the file contains its own identity.
    if device.eeprom.image.is_empty() {
        assert_eq!(parsed.identity, device.identity);
    }
    reached.images += 1;
}
