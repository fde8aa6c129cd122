//! SDO Information (ETG.1000.6 §5.6.3): a device's own description must match its ESI.

use crate::common::*;
use ecaxis_esi::model::{ObjectCode, Writable};
use ecaxis_sim::{DeviceOptions, MailboxOptions};

const S: u16 = 0x1001;

fn bus(len: u16) -> Bus {
    mailbox_bus(len, DeviceOptions::default())
}

/// Sends a request and joins the fragments. Returns the abort code of an SDO Info error.
fn ask(bus: &mut Bus, opcode: u8, body: &[u8]) -> Result<Vec<u8>, u32> {
    let mut payload = vec![0, 0x80, opcode, 0, 0, 0];
    payload.extend_from_slice(body);
    bus.send_mailbox(S, 3, &payload);
    bus.wait(1_000_000);
    let mut data = Vec::new();
    let mut expected = None;
    loop {
        let (kind, part) = bus.fetch(S).expect("a fragment");
        assert_eq!((kind, &part[..2], part[3]), (3, &[0, 0x80][..], 0));
        let left = u16::from_le_bytes([part[4], part[5]]);
        assert_eq!(part[2] & 0x80 != 0, left > 0, "incomplete");
        assert_eq!(expected.unwrap_or(left), left, "counts down");
        expected = left.checked_sub(1);
        data.extend_from_slice(&part[6..]);
        match part[2] & 0x7f {
            7 => return Err(u32::from_le_bytes(data[..].try_into().unwrap())),
            reply => assert_eq!(reply, opcode + 1),
        }
        if left == 0 {
            assert_eq!(bus.fetch(S), None);
            return Ok(data);
        }
    }
}

fn list(bus: &mut Bus, kind: u16) -> Result<Vec<u16>, u32> {
    let data = ask(bus, 1, &kind.to_le_bytes())?;
    assert_eq!(data[..2], kind.to_le_bytes());
    let words = data[2..].chunks_exact(2);
    Ok(words.map(|w| u16::from_le_bytes([w[0], w[1]])).collect())
}

#[derive(Debug)]
struct Entry {
    info: u8,
    data_type: u16,
    bits: u16,
    access: u16,
    rest: Vec<u8>,
}

fn entry(bus: &mut Bus, index: u16, sub: u8, asked: u8) -> Result<Entry, u32> {
    let [low, high] = index.to_le_bytes();
    let data = ask(bus, 5, &[low, high, sub, asked])?;
    assert_eq!(data[..3], [low, high, sub]);
    let word = |n: usize| u16::from_le_bytes([data[n], data[n + 1]]);
    Ok(Entry {
        info: data[3],
        data_type: word(4),
        bits: word(6),
        access: word(8),
        rest: data[10..].to_vec(),
    })
}

#[test]
fn esi_objects_are_listed_and_described() {
    let device = mailbox_device();
    for len in [16, 18, 48, 1486] {
        let mut bus = bus(len);
        let all = list(&mut bus, 1).unwrap();
        assert!(all.is_sorted() && all.windows(2).all(|w| w[0] != w[1]));
        for object in &device.dictionary.objects {
            assert!(all.contains(&object.index), "0x{:04x}", object.index);
            let [low, high] = object.index.to_le_bytes();
            let data = ask(&mut bus, 3, &[low, high]).unwrap();
            assert_eq!(data[..2], [low, high]);
            let code = match object.code {
                ObjectCode::Var => 7,
                ObjectCode::Array => 8,
                ObjectCode::Record => 9,
            };
            assert_eq!((data[4], data[5]), (object.items.last().unwrap().sub, code));
            assert_eq!(data[6..], *object.name.as_bytes());
            for item in &object.items {
                let got = entry(&mut bus, object.index, item.sub, 0).unwrap();
                assert_eq!(u32::from(got.bits), item.bit_len);
                let read = if item.access.read { 0x07 } else { 0 };
                let write = match item.access.write {
                    Writable::Never => 0,
                    Writable::Always => 0x38,
                    Writable::Only {
                        pre_op,
                        safe_op,
                        op,
                    } => u16::from(pre_op) << 3 | u16::from(safe_op) << 4 | u16::from(op) << 5,
                };
                assert_eq!(
                    got.access & 0x3f,
                    read | write,
                    "0x{:04x}:{}",
                    object.index,
                    item.sub
                );
                assert_eq!(
                    got.access >> 8 & 3,
                    u16::from(item.backup) | u16::from(item.setting) << 1
                );
                assert_eq!(got.rest, item.name.as_bytes());
            }
        }
        // Assignments are the device's own.
        assert!(
            [0x1c12, 0x1c13, 0x1600, 0x1a00]
                .iter()
                .all(|i| all.contains(i))
        );
    }
}

#[test]
fn object_lists_have_the_lengths_of_list_0() {
    let mut bus = bus(48);
    let lengths = list(&mut bus, 0).unwrap();
    let lists: Vec<_> = (1..=5).map(|kind| list(&mut bus, kind).unwrap()).collect();
    assert_eq!(
        lengths,
        lists.iter().map(|l| l.len() as u16).collect::<Vec<_>>()
    );
    assert_eq!(lists[1], [0x7000], "RxPDOs");
    assert_eq!(lists[2], [0x6000], "TxPDOs");
    assert_eq!(lists[3], [0x2001, 0x2002, 0x2020, 0x2021], "backup");
    assert_eq!(lists[4], [0x2001, 0x2020, 0x2021], "settings");
}

#[test]
fn object_types_match_the_standard() {
    let mut bus = bus(48);
    for (index, data_type) in [
        (0x1000_u16, 0x07_u16),
        (0x1008, 0x09),
        (0x1018, 0x23),
        (0x1600, 0x21),
        (0x1c12, 0x06),
        (0x2000, 0x0a),
        (0x2010, 0x2a),
        (0x2011, 0x06),
        (0x2021, 0x08),
        (0x2022, 0x11),
        (0x2023, 0x1b),
    ] {
        let data = ask(&mut bus, 3, &index.to_le_bytes()).unwrap();
        assert_eq!(data[2..4], data_type.to_le_bytes(), "0x{index:04x}");
    }
    let mut name = |index: u16| ask(&mut bus, 3, &index.to_le_bytes()).unwrap()[6..].to_vec();
    assert_eq!(name(0x1c00), b"SyncManager types");
    assert_eq!(name(0x1c12), b"SyncManager 2 PDO assignment");
    assert_eq!(name(0x1600), b"Outputs", "the PDO's");
    for (sub, data_type) in [(1, 0x01), (2, 0x32), (3, 0x06), (5, 0x04), (6, 0x31)] {
        assert_eq!(
            entry(&mut bus, 0x2010, sub, 0).unwrap().data_type,
            data_type
        );
    }
}

#[test]
fn entry_descriptions_contain_requested_known_values() {
    let mut bus = bus(48);
    let all = entry(&mut bus, 0x2020, 0, 0x7f).unwrap();
    assert_eq!(all.info, 0x7f);
    let mut expected = 0xfd01_0000_u32.to_le_bytes().to_vec();
    for value in [0, -1000, 1000_i32] {
        expected.extend_from_slice(&value.to_le_bytes());
    }
    expected.extend_from_slice(b"Signed with limits");
    assert_eq!(all.rest, expected);
    let maximum = entry(&mut bus, 0x2020, 0, 0x40).unwrap();
    assert_eq!(
        (maximum.info, &maximum.rest[..4]),
        (0x40, &1000_i32.to_le_bytes()[..])
    );
    let gap = entry(&mut bus, 0x2010, 5, 0x10).unwrap();
    assert_eq!(
        (gap.info, &gap.rest[..4]),
        (0x10, &(-2_i32).to_le_bytes()[..])
    );
    // The default value is the vendor's, not the present value.
    bus.download(S, 0x2020, 0, &[7, 0, 0, 0]).unwrap();
    assert_eq!(entry(&mut bus, 0x2020, 0, 0x10).unwrap().rest[..4], [0; 4]);
    let no_unit = entry(&mut bus, 0x2021, 0, 0x7f).unwrap();
    assert_eq!(no_unit.info, 0x77);
    assert_eq!(no_unit.rest[..4], 0.5_f32.to_le_bytes());
}

#[test]
fn refusals_are_sdo_information_errors() {
    let mut bus = bus(48);
    assert_eq!(list(&mut bus, 6), Err(0x0601_0000));
    assert_eq!(ask(&mut bus, 3, &[0xff, 0x5f]), Err(0x0602_0000));
    assert_eq!(entry(&mut bus, 0x5fff, 0, 0).unwrap_err(), 0x0602_0000);
    assert_eq!(entry(&mut bus, 0x2010, 4, 0).unwrap_err(), 0x0609_0011);
    for opcode in [0, 2, 4, 6, 8, 0x7f] {
        assert_eq!(
            ask(&mut bus, opcode, &[0; 4]),
            Err(0x0504_0001),
            "opcode {opcode}"
        );
    }
    for (opcode, body) in [(1, &[1][..]), (3, &[0]), (5, &[0, 0x20, 0])] {
        let mut payload = vec![0, 0x80, opcode, 0, 0, 0];
        payload.extend_from_slice(body);
        assert_eq!(bus.mailbox(S, 3, &payload), (0, vec![1, 0, 6, 0]));
    }
}

#[test]
fn new_request_replaces_unfetched_fragments() {
    let mut bus = bus(16);
    bus.mailbox(S, 3, &[0, 0x80, 1, 0, 0, 0, 1, 0]);
    // The second fragment is in the mailbox; the others are never sent.
    bus.send_mailbox(S, 3, &[0, 0x80, 3, 0, 0, 0, 0x25, 0x20]);
    bus.wait(1_000_000);
    assert_eq!(bus.fetch(S).unwrap().1[2], 0x82);
    assert_eq!(bus.fetch(S).unwrap().1[2], 0x84);
}

#[test]
fn esi_flag_enables_sdo_info_unless_an_option_overrides_it() {
    let list = [0, 0x80, 1, 0, 0, 0, 1, 0];
    for (esi, option, expected) in [
        (false, None, 0),
        (false, Some(true), 3),
        (true, None, 3),
        (true, Some(false), 0),
    ] {
        let mut device = mailbox_device();
        let coe = device.mailbox.as_mut().unwrap().coe.as_mut().unwrap();
        coe.sdo_info = esi;
        let mailbox = MailboxOptions {
            sdo_info: option,
            ..MailboxOptions::default()
        };
        let options = DeviceOptions {
            mailbox,
            ..DeviceOptions::default()
        };
        let mut bus = Bus::new(vec![sim_with(&device, options)]);
        bus.mailboxes = [(0x1000, 48), (0x1600, 48)];
        bus.address_all();
        bus.preop(S);
        assert_eq!(bus.mailbox(S, 3, &list).0, expected);
    }
}
