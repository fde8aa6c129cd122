//! The boot loader of simulated devices: program control (CiA 302-3) row by row, a device without
//! its program, and persistence over a power cycle. The tests use no client.

use crate::common::*;
use ecaxis_sim::{DeviceOptions, FirmwareHeader, FirmwareOptions};
use proptest::prelude::*;

const S: u16 = 0x1001;

const WRITE_ONLY: u32 = 0x0601_0001;
const NO_OBJECT: u32 = 0x0602_0000;
const TOO_LONG: u32 = 0x0607_0012;
const VALUE: u32 = 0x0609_0030;
const NOT_STORED: u32 = 0x0800_0020;
const WRONG_STATE: u32 = 0x0800_0022;
const NO_VALID_FIRMWARE: u16 = 0x0014;

const STOP: u8 = 0;
const START: u8 = 1;
const RESET: u8 = 2;
const CLEAR: u8 = 3;

const HEADER: FirmwareHeader = FirmwareHeader {
    vendor: 0xe0a,
    product: 0x4550_0004,
    revision: 0x0002_0000,
    version: *b"2.00",
};

/// Returns the EPOS4 of the demonstration, in PreOp.
fn drive() -> Bus {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../configs/esi/EPOS4.xml");
    let esi = ecaxis_esi::parse(&std::fs::read(path).unwrap()).unwrap();
    let firmware = FirmwareOptions {
        erase_ns: 0,
        capacity: 10_000,
        ..FirmwareOptions::default()
    };
    let options = DeviceOptions {
        serial: 7,
        firmware: Some(firmware),
        ..DeviceOptions::default()
    };
    let mut bus = Bus::new(vec![
        ecaxis_sim::SimDevice::from_esi(&esi.devices[0], &esi.modules, options).unwrap(),
    ]);
    bus.mailboxes = [(0x1000, 48), (0x1040, 48)];
    bus.address_all();
    bus.preop(S);
    bus
}

fn number(bus: &mut Bus, index: u16, sub: u8) -> Result<u32, Refusal> {
    let bytes = bus.upload(S, index, sub)?;
    Ok(bytes.iter().rev().fold(0, |v, b| v << 8 | u32::from(*b)))
}

fn control(bus: &mut Bus, command: u8) -> Result<(), Refusal> {
    bus.download(S, 0x1f51, 1, &[command])
}

/// Sends a command that restarts the processor. It is not answered.
fn order(bus: &mut Bus, command: u8) {
    bus.send_mailbox(S, 3, &[0, 0x20, 0x2f, 0x51, 0x1f, 1, command, 0, 0, 0]);
    for _ in 0..100 {
        bus.wait(10_000_000);
        assert_eq!(bus.fetch(S), None);
    }
}

fn power_cycle(bus: &mut Bus) {
    bus.segment.power(0, false);
    bus.wait(1_000_000);
    bus.segment.power(0, true);
    bus.wait(1_000_000);
    bus.address_all();
    bus.preop(S);
}

#[test]
fn program_control_row_by_row() {
    let abort = |code| Err(Refusal::Abort(code));
    let mut bus = drive();
    assert_eq!(number(&mut bus, 0x1f51, 1), Ok(1));
    assert_eq!(control(&mut bus, START), Ok(()), "it runs already");
    assert_eq!(control(&mut bus, CLEAR), abort(WRONG_STATE));
    assert_eq!(control(&mut bus, 4), abort(VALUE));
    assert_eq!(bus.download(S, 0x1f50, 1, &[0; 9]), abort(WRONG_STATE));
    assert_eq!(bus.upload(S, 0x1f50, 1), Err(Refusal::Abort(WRITE_ONLY)));

    order(&mut bus, STOP);
    assert_eq!(number(&mut bus, 0x1f51, 1), Ok(0));
    assert_eq!(control(&mut bus, STOP), Ok(()), "it is stopped already");
    assert_eq!(control(&mut bus, RESET), abort(WRONG_STATE));
    assert_eq!(control(&mut bus, 4), abort(VALUE));
    // Only a cleared memory accepts a program.
    let file = HEADER.file(&[1; 500]);
    assert_eq!(bus.download(S, 0x1f50, 1, &file), abort(WRONG_STATE));
    // The old program is still there.
    order(&mut bus, START);
    assert_eq!(number(&mut bus, 0x1f51, 1), Ok(1));
    assert_eq!(number(&mut bus, 0x1018, 3), Ok(0x0001_0000));

    order(&mut bus, STOP);
    assert_eq!(control(&mut bus, CLEAR), Ok(()));
    bus.wait(1_000_000);
    assert_eq!(
        control(&mut bus, START),
        abort(WRONG_STATE),
        "nothing there"
    );
    assert_eq!(bus.download(S, 0x1f50, 1, &[0; 10_001]), abort(TOO_LONG));
    assert_eq!(bus.download(S, 0x1f50, 1, &[0; 500]), abort(VALUE));
    let mut damaged = file.clone();
    damaged[400] ^= 1;
    assert_eq!(bus.download(S, 0x1f50, 1, &damaged), abort(NOT_STORED));
    assert_eq!(bus.download(S, 0x1f50, 1, &file), Ok(()));
    assert_eq!(number(&mut bus, 0x1018, 3), Ok(0), "it does not run yet");
    order(&mut bus, START);
    assert_eq!(number(&mut bus, 0x1018, 3), Ok(0x0002_0000));
    assert_eq!(bus.upload(S, 0x100a, 0), Ok(b"2.00".to_vec()));
    let checksum = u32::from_le_bytes(file[28..32].try_into().unwrap());
    assert_eq!(number(&mut bus, 0x1f56, 1), Ok(checksum));
    order(&mut bus, RESET);
    assert_eq!(number(&mut bus, 0x1f51, 1), Ok(1));
}

#[test]
fn device_without_a_program_stays_in_the_boot_loader() {
    let mut bus = drive();
    order(&mut bus, STOP);
    for (index, sub, expected) in [
        (0x1000, 0, Ok(0x0000_012e)),
        (0x1018, 1, Ok(0xe0a)),
        (0x1018, 2, Ok(0x4550_0000)),
        (0x1018, 3, Ok(0)),
        (0x1018, 4, Ok(7)),
        (0x6041, 0, Err(Refusal::Abort(NO_OBJECT))),
        (0x1c12, 0, Err(Refusal::Abort(NO_OBJECT))),
    ] {
        assert_eq!(number(&mut bus, index, sub), expected, "{index:#06x}");
    }
    assert_eq!(bus.upload(S, 0x1008, 0), Ok(b"EPOS4".to_vec()));
    let refused = bus.request(S, u16::from(SAFEOP));
    assert_eq!(refused, (0x12, NO_VALID_FIRMWARE));
    let acknowledged = bus.request(S, u16::from(PREOP) | 0x10);
    assert_eq!(acknowledged, (u16::from(PREOP), 0));
    // Stopped but not cleared: the device starts with its program.
    assert!(bus.segment.device(0).unwrap().is_stopped());
    power_cycle(&mut bus);
    assert!(!bus.segment.device(0).unwrap().is_stopped());
    assert_eq!(number(&mut bus, 0x1000, 0), Ok(0x0002_0192));
    assert!(number(&mut bus, 0x6041, 0).is_ok());

    order(&mut bus, STOP);
    assert_eq!(control(&mut bus, CLEAR), Ok(()));
    for _ in 0..2 {
        power_cycle(&mut bus);
        assert_eq!(number(&mut bus, 0x1f51, 1), Ok(0));
        assert_eq!(number(&mut bus, 0x1f56, 1), Ok(0));
    }
    let file = HEADER.file(&[]);
    assert_eq!(bus.download(S, 0x1f50, 1, &file), Ok(()));
    power_cycle(&mut bus);
    assert_eq!(number(&mut bus, 0x1018, 3), Ok(0x0002_0000));
    assert_eq!(bus.segment.device(0).unwrap().firmware(), Some(&file[..]));
}

#[test]
fn program_control_needs_preop() {
    let mut bus = drive();
    bus.to(S, INIT);
    bus.send_mailbox(S, 3, &[0, 0x20, 0x2f, 0x51, 0x1f, 1, STOP, 0, 0, 0]);
    bus.wait(1_000_000_000);
    assert!(!bus.segment.device(0).unwrap().is_stopped());
    bus.to(S, PREOP);
    assert_eq!(number(&mut bus, 0x1f51, 1), Ok(1));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]
    /// Commands in any order: the device answers afterwards, and runs only a program that it has
    /// accepted.
    #[test]
    fn device_survives_program_commands_in_any_order(orders in prop::collection::vec((0u8..6, 0usize..4), 1..12)) {
        let files = [HEADER.file(&[3; 100]), HEADER.file(&[]), vec![0; 60], Vec::new()];
        let mut bus = drive();
        for (command, file) in orders {
            if command == 5 {
                let _ = bus.download(S, 0x1f50, 1, &files[file]);
            } else {
                bus.send_mailbox(S, 3, &[0, 0x20, 0x2f, 0x51, 0x1f, 1, command, 0, 0, 0]);
                bus.wait(1_000_000_000);
                let _ = bus.fetch(S);
            }
            let runs = number(&mut bus, 0x1f51, 1);
            prop_assert!(matches!(runs, Ok(0 | 1)), "{runs:?}");
            let device = bus.segment.device(0).unwrap();
            prop_assert_eq!(device.is_stopped(), runs == Ok(0));
            if let Some(file) = device.firmware() {
                prop_assert!(files[..2].iter().any(|good| good == file));
            }
        }
    }
}
