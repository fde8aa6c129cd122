//! A drive's behaviour as its MainDevice sees it over the bus.

mod common;

use common::*;
use ecaxis_sim::drive::input;
use ecaxis_sim::{DeviceOptions, SimDevice};

const EPOS4: &str = "esi/maxon/maxon_motor_EPOS4_0170h_6950h_0000h_0000h_ESI.xml";
const VALUE_RANGE: u32 = 0x0609_0030;

/// The smallest dictionary, and what every drive adds to it.
fn drive() -> SimDevice {
    let mut device = coe_device();
    device.profile = Some(402);
    sim(&device)
}

#[test]
fn option_codes_outside_the_standards_tables_are_refused() {
    let mut bus = Bus::new(vec![drive()]);
    bus.address_all();
    bus.preop(0x1001);
    let rows = [
        (0x605a, 0..=8),
        (0x605b, 0..=1),
        (0x605c, 0..=1),
        (0x605e, 0..=4),
        (0x6007, 0..=3),
    ];
    for (index, known) in rows {
        for code in [-32_768_i16, -1, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 0x100, 0x7fff] {
            let answer = bus.download(0x1001, index, 0, &code.to_le_bytes());
            if known.contains(&code) {
                answer.unwrap();
                let value = bus.upload(0x1001, index, 0).unwrap();
                assert_eq!(value, code.to_le_bytes());
            } else {
                let refusal = answer.unwrap_err();
                assert_eq!(
                    refusal,
                    Refusal::Abort(VALUE_RANGE),
                    "0x{index:04x} = {code}"
                );
            }
        }
    }
    for method in i8::MIN..=i8::MAX {
        let known = [-4, -3, -2, -1, 1, 2, 7, 11, 17, 18, 23, 27, 33, 34, 35, 37].contains(&method);
        let answer = bus.download(0x1001, 0x6098, 0, &method.to_le_bytes());
        assert_eq!(answer.is_ok(), known, "homing method {method}");
    }
}

#[test]
fn an_epos4_lists_its_homing_methods() {
    let Some(xml) = fixture(EPOS4) else {
        return;
    };
    let file = ecaxis_esi::parse(&xml).unwrap();
    let options = DeviceOptions::default();
    let device = SimDevice::from_esi(&file.devices[0], &file.modules, options).unwrap();
    let count = device.object(0x60e3, 0).unwrap()[0];
    let mut listed: Vec<i8> = (1..=count)
        .map(|sub| device.object(0x60e3, sub).unwrap()[0].cast_signed())
        .collect();
    listed.sort_unstable();
    assert_eq!(
        listed,
        [-4, -3, -2, -1, 1, 2, 7, 11, 17, 18, 23, 27, 33, 34, 37]
    );
}

#[test]
fn inputs_and_outputs_are_wired_to_the_device() {
    let mut bus = Bus::new(vec![drive()]);
    bus.address_all();
    bus.preop(0x1001);
    let now = bus.now;
    let device = bus.segment.device_mut(0).unwrap();
    assert!(device.set_digital_input(now, input::HOME, true));
    assert!(device.set_digital_input(now, input::GENERAL + 3, true));
    bus.wait(1_000_000);
    let value = bus.upload(0x1001, 0x60fd, 0).unwrap();
    assert_eq!(value, 0x0008_0004_u32.to_le_bytes());
    bus.download(0x1001, 0x60fe, 1, &0x0001_0000_u32.to_le_bytes())
        .unwrap();
    let device = bus.segment.device_mut(0).unwrap();
    assert_eq!(device.digital_outputs(), Some(0x0001_0000));

    let mut terminal = sim(&coe_device());
    assert!(!terminal.set_digital_input(0, input::HOME, true));
    assert_eq!(terminal.digital_outputs(), None);
}
