//! Every device of every ESI file at hand becomes a SubDevice that reaches Op.

#![allow(clippy::print_stderr, reason = "tests say what they did")]

mod common;

use std::path::{Path, PathBuf};

use common::*;
use ecaxis_esi::model::{Device, SmUse, SyncManager};
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

/// Configures the SyncManagers as the ESI has them and climbs to Op; what the device objected to.
fn climb(device: &Device, sim: SimDevice) -> Result<(), String> {
    const S: u16 = 0x1001;
    let mut bus = Bus::new(vec![sim]);
    bus.address_all();
    let step = |bus: &mut Bus, state: u16| match bus.request(S, state) {
        (status, 0) if status == state => Ok(()),
        (_, code) => Err(format!("state {state} refused with 0x{code:04x}")),
    };
    let sms = || (0u16..).zip(&device.sync_managers).take(8);
    for (n, sm) in sms() {
        if device.mailbox.is_some() && matches!(sm.usage, SmUse::MBoxOut | SmUse::MBoxIn) {
            bus.sm(S, n, sm.start_address, sm.default_size, sm.control_byte);
        }
    }
    step(&mut bus, 2)?;
    for (n, sm) in sms() {
        let len = bus
            .segment
            .device(0)
            .map_or(0, |d| d.pdo_len(usize::from(n)));
        if matches!(sm.usage, SmUse::Outputs | SmUse::Inputs) && len > 0 {
            bus.sm(S, n, sm.start_address, len as u16, sm.control_byte);
        }
    }
    step(&mut bus, 4)?;
    step(&mut bus, 8)?;
    bus.wait(20_000_000);
    step(&mut bus, 8)
}

#[test]
fn every_device_reaches_op() {
    let Some(readme) = fixture("README.md") else {
        return;
    };
    drop(readme);
    let mut paths = Vec::new();
    files(&fixtures().join("esi"), &mut paths);
    paths.sort();
    let (mut count, mut problems) = (0, Vec::new());
    for path in paths {
        let Ok(file) = ecaxis_esi::parse(&std::fs::read(&path).unwrap()) else {
            continue;
        };
        for device in &file.devices {
            // One maker writes inputs that the MainDevice would have to fill.
            let nonsense =
                |sm: &SyncManager| sm.usage == SmUse::Inputs && sm.control_byte & 0x0c == 0x04;
            if device.sync_managers.iter().any(nonsense) {
                continue;
            }
            count += 1;
            let result = SimDevice::from_esi(device, &file.modules, DeviceOptions::default())
                .map_err(|error| error.to_string())
                .and_then(|sim| climb(device, sim));
            if let Err(problem) = result {
                problems.push(format!(
                    "{}: {}: {problem}",
                    path.display(),
                    device.type_name
                ));
            }
        }
    }
    eprintln!("{count} devices");
    assert!(problems.is_empty(), "{}", problems.join("\n"));
}
