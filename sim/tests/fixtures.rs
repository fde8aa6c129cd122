//! Every device of every available ESI file becomes a SubDevice. A MainDevice takes it from Init to
//! Op without the ESI.

use crate::main_device;
use std::path::{Path, PathBuf};

use crate::common::*;
use ecaxis_esi::model::Device;
use ecaxis_sim::{DeviceOptions, SimDevice};

fn files(folder: &Path, out: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        if path.is_dir() {
            files(&path, out);
        } else if path
            .extension()
            .is_some_and(|e| e.eq_ignore_ascii_case("xml"))
        {
            out.push(path);
        }
    }
}

#[test]
fn every_fixture_device_reaches_op() {
    if fixture("README.md").is_none() {
        return;
    }
    let (count, problems) = sweep(&fixtures().join("esi"));
    assert!(problems.is_empty(), "{}", problems.join("\n"));
    eprintln!("{count} devices");
    assert!(count > 370, "{count}");
}

#[test]
fn every_device_of_open_projects_reaches_op() {
    if fixture("../vendor-files/README.md").is_none() {
        return;
    }
    let (count, problems) = sweep(&fixtures().join("../vendor-files/esi"));
    assert_eq!(count, 26);
    // Its EEPROM enables device emulation. In PreOp its application, which has a mailbox, has not
    // filled the inputs yet; a device with emulation and without an application would have.
    let [problem] = &problems[..] else {
        panic!("{}", problems.join("\n"));
    };
    let expected = problem.contains("Orbita2d") && problem.contains("PreOp: working counter 2");
    assert!(expected, "{problem}");
}

#[test]
fn every_project_device_reaches_op() {
    let own = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/esi");
    let (count, problems) = sweep(&own);
    assert!(problems.is_empty(), "{}", problems.join("\n"));
    assert!(count >= 12, "{count}");
}

/// Takes each device of all files of a folder to Op. Returns their number and what failed.
fn sweep(folder: &Path) -> (usize, Vec<String>) {
    let mut paths = Vec::new();
    files(folder, &mut paths);
    paths.sort();
    let (mut count, mut problems) = (0, Vec::new());
    for path in paths {
        let file = match ecaxis_esi::parse(&std::fs::read(&path).unwrap()) {
            Ok(file) => file,
            Err(error) => {
                problems.push(format!("{}: {error}", path.display()));
                continue;
            }
        };
        for device in &file.devices {
            count += 1;
            let result = SimDevice::from_esi(device, &file.modules, DeviceOptions::default())
                .map_err(|error| error.to_string())
                .and_then(|sim| climb(device, sim));
            let (name, identity) = (&device.type_name, &device.identity);
            if let Err(problem) = result {
                problems.push(format!("{}: {name} {identity}: {problem}", path.display()));
            }
        }
    }
    (count, problems)
}

fn climb(device: &Device, sim: SimDevice) -> Result<(), String> {
    const S: u16 = 0x1001;
    let mut bus = Bus::new(vec![sim]);
    bus.address_all();
    let (learned, mapped) = main_device::bring_up(&mut bus, S)?;
    let identity = &device.identity;
    let found = [8, 10, 12].map(|word| main_device::number(&learned.image[word * 2..word * 2 + 4]));
    let wanted = [identity.vendor, identity.product, identity.revision].map(u64::from);
    if found != wanted {
        return Err(format!("EEPROM says {found:x?}"));
    }
    let has_pdos = device
        .rx_pdos
        .iter()
        .chain(&device.tx_pdos)
        .any(|pdo| pdo.sm.is_some() && pdo.bit_len() > 0);
    if has_pdos && mapped.len() == 0 {
        return Err("its process data were not found".into());
    }
    Ok(())
}
