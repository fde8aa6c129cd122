//! Quirks of any device (`docs/drive.md`, "Quirks"): each in the messages and working counters that a
//! MainDevice receives.

use crate::common::*;
use ecaxis_sim::{DeviceOptions, Quirks};

const S: u16 = 0x1001;
const COE: u8 = 3;
const FOE: u8 = 4;
const MAILBOX: u16 = 128;

const NO_SUBINDEX: Refusal = Refusal::Abort(0x0609_0011);
/// The first bytes of CoE messages of the device: an emergency, an SDO request, an SDO response.
const EMERGENCY: [u8; 4] = [0, 0x10, 0x00, 0xff];
const REQUEST: [u8; 4] = [0, 0x20, 0x40, 0x00];
const UPLOADED: [u8; 4] = [0, 0x30, 0x43, 0x00];

fn options(key: &str, value: f64) -> DeviceOptions {
    let mut quirks = Quirks::default();
    let quirk = Quirks::TABLE.iter().find(|quirk| quirk.key == key);
    quirk.unwrap().set(&mut quirks, value);
    DeviceOptions {
        quirks,
        ..DeviceOptions::default()
    }
}

/// Returns the device for mailbox tests with one quirk, in PreOp.
fn bus(key: &str, value: f64) -> Bus {
    mailbox_bus(MAILBOX, options(key, value))
}

/// Returns the starts of all messages that follow the request to upload 0x1000:00.
fn answers(bus: &mut Bus) -> Vec<[u8; 4]> {
    bus.send_mailbox(S, COE, &[0, 0x20, 0x40, 0x00, 0x10, 0, 0, 0, 0, 0]);
    bus.wait(1_000_000);
    let messages = std::iter::from_fn(|| bus.fetch(S));
    messages.map(|(_, m)| m[..4].try_into().unwrap()).collect()
}

#[test]
fn messages_of_the_device_precede_each_answer() {
    for (key, first) in [
        ("unsolicited_emergencies", EMERGENCY),
        ("unsolicited_requests", REQUEST),
    ] {
        let mut bus = bus(key, 1.0);
        for _ in 0..3 {
            assert_eq!(answers(&mut bus), [first, UPLOADED], "{key}");
        }
    }
}

#[test]
fn mailbox_is_silent_after_init_and_answers_later() {
    let mut bus = bus("mailbox_late", 50e6);
    assert_eq!(answers(&mut bus), [[0; 4]; 0]);
    bus.wait(50_000_000);
    let (_, answer) = bus.fetch(S).expect("the answer to the first request");
    assert_eq!(answer[..4], UPLOADED);
    assert_eq!(answers(&mut bus), [UPLOADED]);
    // Only a change from Init begins the time again.
    bus.to(S, INIT);
    bus.preop(S);
    assert_eq!(answers(&mut bus), [[0; 4]; 0]);
}

#[test]
fn last_subindex_is_counted_and_missing() {
    let mut bus = bus("last_subindex_missing", 1.0);
    let count = bus.upload(S, 0x1018, 0).unwrap()[0];
    assert_eq!(count, 4);
    assert_eq!(bus.upload(S, 0x1018, 3).unwrap().len(), 4);
    assert_eq!(bus.upload(S, 0x1018, 4), Err(NO_SUBINDEX));
    // Complete access ends before it; PDOs and their assignment keep it.
    let whole = bus.upload_with(S, 0x50, 0x1018, 0).unwrap();
    assert_eq!(whole.len(), 2 + 3 * 4);
    for list in [0x1c12, 0x1a00] {
        let count = bus.upload(S, list, 0).unwrap()[0];
        assert!(count > 0 && bus.upload(S, list, count).is_ok(), "{list:#x}");
    }
}

#[test]
fn assignment_has_subindex_0_only() {
    let mut bus = bus("assignment_subindices_missing", 1.0);
    for index in [0x1c12, 0x1c13] {
        assert!(bus.upload(S, index, 0).unwrap()[0] > 0, "{index:#x}");
        assert_eq!(bus.upload(S, index, 1), Err(NO_SUBINDEX));
        assert_eq!(bus.download(S, index, 1, &[0, 0x16]), Err(NO_SUBINDEX));
    }
    assert!(bus.upload(S, 0x1a00, 1).is_ok());
}

/// Sends a message of FoE. Returns opcode and number of the answer.
fn say(bus: &mut Bus, opcode: u8, number: u32, data: &[u8]) -> (u8, u32) {
    let mut payload = vec![opcode, 0];
    payload.extend_from_slice(&number.to_le_bytes());
    payload.extend_from_slice(data);
    let (kind, answer) = bus.mailbox(S, FOE, &payload);
    assert_eq!(kind, FOE);
    let number = answer[2..6].try_into().unwrap();
    (answer[0], u32::from_le_bytes(number))
}

#[test]
fn file_transfers_are_refused_or_busy() {
    const READ: u8 = 1;
    const WRITE: u8 = 2;
    const DATA: u8 = 3;
    const ACK: u8 = 4;
    const ERROR: u8 = 5;
    let mut full = bus("foe_disk_full", 1.0);
    assert_eq!(say(&mut full, WRITE, 0, b"a"), (ACK, 0));
    assert_eq!(say(&mut full, DATA, 1, &[7; 9]), (ERROR, 0x8003));
    assert!(
        full.segment
            .device(0)
            .unwrap()
            .foe_files()
            .get("a")
            .is_none()
    );

    let mut illegal = bus("foe_illegal", 1.0);
    assert_eq!(say(&mut illegal, WRITE, 0, b"a"), (ERROR, 0x8004));
    assert_eq!(say(&mut illegal, READ, 0, b"a"), (ERROR, 0x8004));

    let mut busy = bus("foe_busy", 5e6);
    assert_eq!(say(&mut busy, WRITE, 0, b"a"), (ACK, 0));
    let mut busy_answers = 0;
    while say(&mut busy, DATA, 1, &[7; 9]) != (ACK, 1) {
        busy_answers += 1;
        assert!(busy_answers < 20, "the answers have an end");
    }
    // Each answer takes 1 ms here.
    assert!((4..=6).contains(&busy_answers), "{busy_answers}");
    let files = busy.segment.device(0).unwrap().foe_files();
    assert_eq!(files.get("a"), Some(&[7; 9][..]));
}

/// The working counter of a logical read and write is 3 with inputs, 2 without.
#[test]
fn unfilled_inputs_have_no_share_of_the_working_counter() {
    for (key, counter) in [("inputs_unfilled", 2), ("error_bit_missing", 3)] {
        let mut bus = Bus::new(vec![sim_with(&coe_device(), options(key, 1.0))]);
        bus.address_all();
        bus.preop(S);
        bus.sm(S, 2, 0x1100, 4, 0x64);
        bus.sm(S, 3, 0x1200, 4, 0x20);
        bus.fmmu(S, 0, 0, 4, 0x1100, 2);
        bus.fmmu(S, 1, 0, 4, 0x1200, 1);
        bus.to(S, SAFEOP);
        assert_eq!(bus.logical(12, 0, &[0; 4]).1, counter, "{key}");
        bus.to(S, OP);
        for _ in 0..3 {
            bus.wait(1_000_000);
            assert_eq!(bus.logical(12, 0, &[0; 4]).1, counter, "{key}");
        }
    }
}
