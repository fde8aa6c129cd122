//! The process data of every device of every recorded vendor file, for each choice in its ESI. The
//! snapshots in `snapshots/` are reviewed against the XML.
//!
//! `ECAXIS_UPDATE_SNAPSHOTS=1 cargo test -p ecaxis-esi --test main layouts` writes the snapshots
//! again. The difference then needs the same review. Snapshots contain only numbers: a device is
//! its identity and line, a module its identity, an OpMode or assignment its index in the file.

mod choices;
mod text;

use crate::common;
use std::path::{Path, PathBuf};

use ecaxis_esi::{
    EntryRef, EsiFile, IdnValue, Mode, Pdo, SelectOptions, Severity, UserSdo, lint, parse, select,
};

/// Files with more devices get one line with a digest per choice.
const MANY_DEVICES: usize = 12;
const UPDATE: &str = "ECAXIS_UPDATE_SNAPSHOTS";

fn snapshot_of(path: &Path) -> PathBuf {
    let slug: String = path
        .file_stem()
        .unwrap()
        .to_string_lossy()
        .chars()
        .map(|c| {
            if c.is_ascii_alphanumeric() {
                c.to_ascii_lowercase()
            } else {
                '-'
            }
        })
        .collect();
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("tests/snapshots")
        .join(format!("{slug}.txt"))
}

#[test]
fn every_layout_matches_its_reviewed_snapshot() {
    let files = common::files("esi", &["xml"]);
    let update = std::env::var_os(UPDATE).is_some();
    let mut wrong = Vec::new();
    for path in &files {
        let file = parse(&std::fs::read(path).unwrap())
            .unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let now = choices::of_file(&file, file.devices.len() <= MANY_DEVICES);
        let kept = snapshot_of(path);
        if update {
            std::fs::create_dir_all(kept.parent().unwrap()).unwrap();
            std::fs::write(&kept, &now).unwrap();
            continue;
        }
        let before = std::fs::read_to_string(&kept).unwrap_or_default();
        if before != now {
            wrong.push(format!(
                "{}\n{}",
                kept.display(),
                text::difference(&before, &now)
            ));
        }
    }
    assert!(
        wrong.is_empty(),
        "layouts differ from the reviewed ones ({UPDATE}=1 takes the new ones):\n{}",
        wrong.join("\n")
    );
    if common::fixtures().is_some() {
        assert!(files.len() >= 30, "only {} files", files.len());
    }
}

/// Every drive with SoE has a layout in each mode: the word of the drive, then what the mode needs; the
/// start-up IDNs list the same.
#[test]
fn soe_drives_have_layouts_and_start_up_idns() {
    let Some(bytes) = common::read("esi/beckhoff/Beckhoff AX5xxx.xml") else {
        return;
    };
    let file: EsiFile = parse(&bytes).unwrap();
    assert_eq!(file.devices.len(), 147);
    let (mut two, mut commands) = (0, 0);
    for device in &file.devices {
        let soe = device.soe_only().expect("SoE");
        commands += soe.init_cmds.len();
        let drives = u16::from(soe.channel_count.unwrap_or(1));
        two += usize::from(drives == 2);
        let axes: Vec<u16> = (0..drives).collect();
        for (mode, command, feedback, code) in [
            (Mode::Csp, 47, vec![51], 0x0b),
            (Mode::Csv, 36, vec![51, 40], 0x02),
            (Mode::Cst, 80, vec![51, 84], 0x01),
        ] {
            let choice = SelectOptions {
                mode: Some(mode),
                axes: &axes,
                cycle_ns: 2_000_000,
                ..SelectOptions::default()
            };
            let selection = select(&file, device, &choice).unwrap();
            for &axis in &axes {
                let drive = u8::try_from(axis).unwrap();
                let of = |pdos: &[Pdo]| -> Vec<u16> {
                    let own = pdos.iter().filter(|pdo| pdo.drive() == drive);
                    own.flat_map(|pdo| &pdo.entries)
                        .map(|entry| entry.index)
                        .collect()
                };
                assert_eq!(of(&selection.rx), [134, command], "{} {mode}", device.name);
                let inputs = of(&selection.tx);
                assert_eq!(inputs[0], 135);
                assert!(
                    feedback.iter().all(|idn| inputs.contains(idn)),
                    "{inputs:?}"
                );
                let view = selection.layout.of_axis(axis);
                assert!(view.rx_field(0x6040, 0).is_some() && view.tx_field(0x6041, 0).is_some());
                assert_eq!(view.rx.len(), 2);
                assert!(view.rx_field(mode.target_object().unwrap(), 0).is_some());
                let written = |idn: u16| {
                    let mut all = selection.startup_idns.iter();
                    let idn = all.find(|own| (own.drive, own.idn.0) == (drive, idn));
                    match idn.map(|idn| &idn.value) {
                        Some(IdnValue::Bytes(bytes)) => bytes.clone(),
                        other => panic!("{other:?}"),
                    }
                };
                assert_eq!(written(15), [7, 0]);
                let [low, high] = command.to_le_bytes();
                assert_eq!(written(24), [2, 0, 2, 0, low, high]);
                assert_eq!(written(16).len(), 4 + 2 * (inputs.len() - 1));
                // 49 and 60 InitCmds of the file ask for velocity control: the mode decides.
                assert_eq!(u16::from(written(32)[0] & 7), code & 7, "{}", device.name);
            }
            let cycle = selection.startup_idns.iter().filter(|idn| idn.idn.0 <= 2);
            let expected = IdnValue::Bytes(2000_u16.to_le_bytes().to_vec());
            assert!(cycle.clone().all(|idn| idn.value == expected));
            assert_eq!(cycle.count(), 2);
            let layout = &selection.layout;
            assert_eq!(
                layout.rx_bytes(),
                selection
                    .rx
                    .iter()
                    .map(|pdo| pdo.bit_len() as usize / 8)
                    .sum()
            );
        }
    }
    assert_eq!((two, commands), (45, 565));
    assert!(lint(&file).iter().all(|f| f.severity != Severity::Error));
}

#[test]
fn soe_drives_reject_what_they_cannot_do() {
    let Some(bytes) = common::read("esi/beckhoff/Beckhoff AX5xxx.xml") else {
        return;
    };
    let file: EsiFile = parse(&bytes).unwrap();
    let device = &file.devices[0];
    let base = SelectOptions {
        mode: Some(Mode::Csp),
        cycle_ns: 1_000_000,
        ..SelectOptions::default()
    };
    let sdo = [UserSdo {
        index: 0x6065,
        sub: 0,
        data: vec![1],
    }];
    let unknown = [EntryRef { index: 300, sub: 0 }];
    for (choice, text) in [
        (
            SelectOptions {
                mode: Some(Mode::Pp),
                ..base
            },
            "csp, csv and cst by S-0-0032",
        ),
        (SelectOptions { axes: &[1], ..base }, "axis 2"),
        (
            SelectOptions {
                cycle_ns: 62_500,
                ..base
            },
            "S-0-0001",
        ),
        (
            SelectOptions {
                cycle_ns: 70_000_000,
                ..base
            },
            "1 to 65535",
        ),
        (
            SelectOptions { sdo: &sdo, ..base },
            "it has no object 0x6065:00",
        ),
        (
            SelectOptions {
                tx: Some(&unknown),
                ..base
            },
            "pdo.tx",
        ),
    ] {
        let error = select(&file, device, &choice).unwrap_err().to_string();
        assert!(error.contains(text), "{error}");
    }
}
