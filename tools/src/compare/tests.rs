//! Comparisons of scans that no simulated bus produces.

use std::path::Path;

use super::{Difference, compare};
use crate::scan::Options;
use crate::scan::tests::{on, scanned};
use ecaxis_ecat::index::DeviceIndex;
use ecaxis_master::config;

/// Beckhoff ESC data sheet, section I, 3.1: a frame that enters at port 1 passes the devices behind
/// port 0 first. The first of two devices then comes second, with two open ports.
#[test]
fn a_device_with_swapped_in_and_out_is_named() {
    const PORT_0: u16 = 1 << 4 | 1 << 9;
    const PORT_1: u16 = 1 << 5 | 1 << 11;
    let (mut scan, _) = on("demo.toml", async |wire| {
        scanned(&wire, Options::default()).await
    });
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/demo.toml");
    let machine = config::load(&path).expect("a machine");
    assert_eq!(compare(&machine, &scan).differences, []);
    scan.devices.reverse();
    let status = [PORT_0, PORT_0 | PORT_1];
    for ((position, device), status) in (0..).zip(&mut scan.devices).zip(status) {
        device.found.position = position;
        device.found.dl_status = status;
    }
    let found = compare(&machine, &scan).differences;
    let expected = Difference::Reversed {
        devices: vec![DeviceIndex(0)],
        position: 1,
    };
    assert_eq!(found, [expected]);
    assert_eq!(
        found[0].display(&machine, &scan).to_string(),
        "`x`: IN and OUT are swapped, frames reach it at position 1"
    );
}
