//! The modules in the slots of a device against the configured ones.

use crate::common::*;
use ecaxis_esi::model::{Module, Slot, Slots};
use ecaxis_sim::{DeviceOptions, SimDevice};

const S: u16 = 0x1001;

/// ETG.5001.1: a device compares the modules in its slots with 0xF030. AL status code 0x0070.
#[test]
fn configured_modules_must_be_those_in_the_slots() {
    let mut device = coe_device();
    let slot = |default: u32| Slot {
        max_instances: 1,
        module_idents: [1, 2].map(|ident| (ident, ident == default)).to_vec(),
        ..Slot::default()
    };
    device.slots = Some(Slots {
        slots: vec![slot(1), slot(2)],
        ..Slots::default()
    });
    let modules = [1, 2].map(|ident| Module {
        ident,
        ..Module::default()
    });
    for (modules_are_hardware, configured, code) in [
        (true, [1, 2], 0),
        (true, [2, 1], 0x0070),
        (true, [1, 0], 0x0070),
        (false, [2, 1], 0),
    ] {
        let options = DeviceOptions {
            modules_are_hardware,
            ..DeviceOptions::default()
        };
        let sim = SimDevice::from_esi(&device, &modules, options).unwrap();
        let mut bus = Bus::new(vec![sim]);
        bus.address_all();
        bus.preop(S);
        bus.sm(S, 2, 0x1100, 4, 0x64);
        bus.sm(S, 3, 0x1200, 4, 0x20);
        for (sub, ident) in (1..).zip(configured) {
            bus.download(S, 0xf030, sub, &u32::to_le_bytes(ident))
                .unwrap();
        }
        let (_, found) = bus.request(S, SAFEOP.into());
        assert_eq!(found, code, "{configured:?}");
        let detected = if modules_are_hardware {
            [1, 2]
        } else {
            configured
        };
        for (sub, ident) in (1..).zip(detected) {
            assert_eq!(
                bus.upload(S, 0xf050, sub),
                Ok(u32::to_le_bytes(ident).to_vec())
            );
        }
    }
}
