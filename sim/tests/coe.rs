//! The mailbox and the SDO server, as seen over the wire with 48-byte mailboxes.

mod common;

use Refusal::Abort;
use common::*;
use ecaxis_sim::{DeviceOptions, FaultScript};

const S: u16 = 0x1001;

fn preop() -> Bus {
    let mut bus = Bus::new(vec![sim(&coe_device())]);
    bus.address_all();
    bus.preop(S);
    bus
}

#[test]
fn a_mailbox_is_locked_until_it_is_emptied() {
    let mut bus = preop();
    let upload = [0, 0x20, 0x40, 3, 0x20, 0, 0, 0, 0, 0];
    assert_eq!(bus.fetch(S), None, "nothing to read");
    bus.send_mailbox(S, 3, &upload);
    assert_eq!(bus.read(S, 0x805, 1), [8]);
    assert_eq!(bus.datagram(5, S, 0x1000, &[0; 48]).1, 0, "still full");
    bus.wait(1_000_000);
    assert_eq!(
        (bus.read(S, 0x805, 1), bus.read(S, 0x80d, 1)),
        (vec![0], vec![8])
    );
    assert_eq!(
        bus.datagram(4, S, 0x1050, &[0; 16]).1,
        0,
        "not from its first byte"
    );
    let (kind, reply) = bus.fetch(S).unwrap();
    assert_eq!((kind, &reply[..3]), (3, &[0, 0x30, 0x43][..]));
    assert_eq!(bus.fetch(S), None);
    assert_eq!(bus.read(S, 0x80d, 1), [0]);
}

#[test]
fn a_lost_reply_is_repeated_on_request() {
    let mut bus = preop();
    let first = bus.mailbox(S, 3, &[0, 0x20, 0x40, 3, 0x20, 0, 0, 0, 0, 0]);
    for toggle in [2, 0] {
        bus.write(S, 0x80e, &[1 | toggle]);
        bus.wait(1_000_000);
        assert_eq!(bus.read(S, 0x80f, 1), [toggle]);
        assert_eq!(bus.fetch(S), Some(first.clone()));
        assert_eq!(bus.fetch(S), None);
    }
}

#[test]
fn a_repeated_request_is_answered_once() {
    let mut bus = preop();
    let mut message = vec![0; 48];
    message[..8].copy_from_slice(&[10, 0, 0, 0, 0, 0x73, 0, 0x20]);
    message[8..12].copy_from_slice(&[0x40, 3, 0x20, 0]);
    for expected in [true, false] {
        bus.write(S, 0x1000, &message);
        bus.wait(1_000_000);
        assert_eq!(bus.fetch(S).is_some(), expected);
    }
}

#[test]
fn mailbox_errors_name_their_cause() {
    let mut bus = preop();
    assert_eq!(bus.mailbox(S, 4, &[0; 10]), (0, vec![1, 0, 2, 0]), "FoE");
    assert_eq!(bus.mailbox(S, 3, &[0]), (0, vec![1, 0, 6, 0]));
    assert_eq!(
        bus.mailbox(S, 3, &[0, 0x80, 1, 0, 0, 0, 1, 0]),
        (0, vec![1, 0, 4, 0])
    );
    assert_eq!(bus.mailbox(S, 3, &[0, 0x70, 1, 0]), (0, vec![1, 0, 5, 0]));
    let mut message = vec![0; 48];
    message[..6].copy_from_slice(&[43, 0, 0, 0, 0, 0x73]);
    bus.write(S, 0x1000, &message);
    bus.wait(1_000_000);
    assert_eq!(bus.fetch(S), Some((0, vec![1, 0, 8, 0])));
}

#[test]
fn values_go_both_ways_in_every_transfer_type() {
    let mut bus = preop();
    assert_eq!(bus.upload(S, 0x1018, 1).unwrap(), 0x333u32.to_le_bytes());
    assert_eq!(bus.upload(S, 0x2001, 0).unwrap(), [0x34, 0x12]);
    bus.download(S, 0x2001, 0, &[0xcd, 0xab]).unwrap();
    assert_eq!(bus.upload(S, 0x2001, 0).unwrap(), [0xcd, 0xab]);
    // 200 bytes: segmented in both directions.
    let long: Vec<u8> = (0..200).collect();
    assert_eq!(bus.upload(S, 0x2002, 0).unwrap()[..4], [1, 2, 3, 0]);
    bus.download(S, 0x2002, 0, &long).unwrap();
    assert_eq!(bus.upload(S, 0x2002, 0).unwrap(), long);
    assert_eq!(
        bus.segment.device(0).unwrap().object(0x2002, 0).unwrap(),
        long
    );
}

#[test]
fn segments_end_anywhere() {
    // 48-byte mailboxes carry 32 bytes first and 39 in each segment; the last may hold 1 to 39.
    for tail in [1u32, 6, 7, 8, 39] {
        let mut device = coe_device();
        let bits = (32 + 39 + tail) * 8;
        let write = ecaxis_esi::model::Writable::Always;
        device.dictionary.objects[2].items = vec![item(0, bits, 0, write, &[])];
        let mut bus = Bus::new(vec![sim(&device)]);
        bus.address_all();
        bus.preop(S);
        let data: Vec<u8> = (1..=(32 + 39 + tail) as u8).collect();
        bus.download(S, 0x2002, 0, &data).unwrap();
        assert_eq!(bus.upload(S, 0x2002, 0).unwrap(), data);
    }
}

#[test]
fn complete_access_pads_subindex_0() {
    let mut bus = preop();
    let all = bus.upload_with(S, 0x50, 0x2004, 0).unwrap();
    assert_eq!(all, [3, 0, 0x11, 0x22, 0, 0, 0, 0x33, 0]);
    assert_eq!(bus.upload_with(S, 0x50, 0x2004, 1).unwrap(), all[2..]);
    bus.download_with(S, 0x10, 0x2004, 1, &[9, 8, 7, 6, 5, 4, 3])
        .unwrap();
    assert_eq!(bus.upload(S, 0x2004, 2).unwrap(), [8, 7, 6, 5]);
    assert_eq!(bus.upload(S, 0x2004, 3).unwrap(), [4, 3]);
    assert_eq!(bus.upload_with(S, 0x50, 0x2004, 2), Err(Abort(0x0609_0011)));
    // A mapping in one go: count, padding, two entries.
    let map = [2, 0, 0x10, 2, 0x10, 0x70, 0x10, 1, 0x10, 0x70];
    bus.download_with(S, 0x10, 0x1600, 0, &map).unwrap();
    assert_eq!(bus.upload_with(S, 0x50, 0x1600, 0).unwrap(), map);
}

#[test]
fn refusals_carry_the_standards_codes() {
    let mut bus = preop();
    assert_eq!(bus.upload(S, 0x5555, 0), Err(Abort(0x0602_0000)));
    assert_eq!(bus.upload(S, 0x2004, 9), Err(Abort(0x0609_0011)));
    assert_eq!(
        bus.download(S, 0x2003, 0, &[1, 0, 0, 0]),
        Err(Abort(0x0601_0002))
    );
    assert_eq!(
        bus.download(S, 0x2001, 0, &[1, 2, 3]),
        Err(Abort(0x0607_0012))
    );
    assert_eq!(bus.download(S, 0x2001, 0, &[1]), Err(Abort(0x0607_0013)));
    assert_eq!(
        bus.download(S, 0x2000, 0, &[11, 0, 0, 0]),
        Err(Abort(0x0609_0031))
    );
    assert_eq!(
        bus.download(S, 0x2000, 0, &[1, 0, 0, 0]),
        Err(Abort(0x0609_0032))
    );
    bus.download(S, 0x2000, 0, &[10, 0, 0, 0]).unwrap();
    assert_eq!(
        bus.download(S, 0x2002, 0, &[0; 201]),
        Err(Abort(0x0607_0012))
    );
    let (_, reply) = bus.mailbox(S, 3, &[0, 0x20, 0x60, 0, 0, 0, 0, 0, 0, 0]);
    assert_eq!(
        reply,
        [0, 0x20, 0x80, 0, 0, 0, 1, 0, 4, 5],
        "no transfer under way"
    );
}

#[test]
fn pdo_mapping_is_checked_like_the_dictionary_says() {
    let mut bus = preop();
    let entry = |index: u16, sub: u8, bits: u8| {
        (u32::from(index) << 16 | u32::from(sub) << 8 | u32::from(bits)).to_le_bytes()
    };
    assert_eq!(
        bus.download(S, 0x1600, 1, &entry(0x7010, 1, 16)),
        Err(Abort(0x0601_0003))
    );
    bus.download(S, 0x1600, 0, &[0]).unwrap();
    assert_eq!(
        bus.download(S, 0x1600, 1, &entry(0x4444, 1, 16)),
        Err(Abort(0x0604_0041))
    );
    assert_eq!(
        bus.download(S, 0x1600, 1, &entry(0x7010, 1, 8)),
        Err(Abort(0x0604_0041))
    );
    bus.download(S, 0x1600, 1, &entry(0x7010, 2, 16)).unwrap();
    assert_eq!(bus.download(S, 0x1600, 0, &[20]), Err(Abort(0x0609_0031)));
    bus.download(S, 0x1600, 0, &[1]).unwrap();
    bus.download(S, 0x1c12, 0, &[0]).unwrap();
    assert_eq!(
        bus.download(S, 0x1c12, 1, &[0, 0x1a]),
        Err(Abort(0x0604_0041))
    );
    bus.download(S, 0x1c12, 1, &[0, 0x16]).unwrap();
    bus.download(S, 0x1c12, 0, &[1]).unwrap();
    // SM2 must now be two bytes long.
    bus.sm(S, 2, 0x1100, 2, 0x64);
    bus.sm(S, 3, 0x1200, 4, 0x20);
    bus.to(S, SAFEOP);
    assert_eq!(bus.download(S, 0x1c12, 0, &[0]), Err(Abort(0x0800_0022)));
    assert_eq!(bus.download(S, 0x2001, 0, &[0, 0]), Err(Abort(0x0800_0022)));
    bus.fmmu(S, 0, 0, 2, 0x1100, 2);
    bus.to(S, OP);
    bus.logical(11, 0, &[0x21, 0x43]);
    assert_eq!(bus.upload(S, 0x7010, 2).unwrap(), [0x21, 0x43]);
    assert_eq!(bus.upload(S, 0x7010, 1).unwrap(), [0, 0]);
}

#[test]
fn injected_aborts_and_emergencies_arrive() {
    let mut bus = preop();
    let script = "[[fault]]\nkind = \"sdo-abort\"\nindex = 0x2000\ncode = 0x06090030\n\
                  [[fault]]\nat = \"50ms\"\nkind = \"emergency\"\ncode = 0x2310\n";
    bus.segment.set_faults(FaultScript::parse(script).unwrap());
    assert_eq!(bus.upload(S, 0x2000, 0), Err(Abort(0x0609_0030)));
    bus.wait(50_000_000);
    assert_eq!(
        bus.fetch(S),
        Some((3, vec![0, 0x10, 0x10, 0x23, 1, 0, 0, 0, 0, 0]))
    );
}

#[test]
fn an_fmmu_shows_that_a_reply_waits() {
    let mut bus = preop();
    // Bit 3 of 0x080D at bit 2 of logical 0x500.
    bus.write(
        S,
        0x620,
        &[0, 5, 0, 0, 1, 0, 2, 2, 0x0d, 8, 3, 1, 1, 0, 0, 0],
    );
    assert_eq!(bus.logical(10, 0x500, &[0]), (vec![0], 1));
    bus.send_mailbox(S, 3, &[0, 0x20, 0x40, 3, 0x20, 0, 0, 0, 0, 0]);
    bus.wait(1_000_000);
    assert_eq!(bus.logical(10, 0x500, &[0]), (vec![4], 1));
    bus.fetch(S).unwrap();
    assert_eq!(bus.logical(10, 0x500, &[0]), (vec![0], 1));
}

#[test]
fn in_init_mailboxes_are_not_served() {
    let mut bus = Bus::new(vec![sim(&coe_device())]);
    bus.address_all();
    bus.sm(S, 0, 0x1000, 48, 0x26);
    bus.sm(S, 1, 0x1030, 48, 0x22);
    bus.send_mailbox(S, 3, &[0, 0x20, 0x40, 3, 0x20, 0, 0, 0, 0, 0]);
    bus.wait(1_000_000);
    assert_eq!(bus.fetch(S), None);
    assert_eq!(bus.read(S, 0x805, 1), [8]);
    bus.to(S, PREOP);
    assert_eq!(bus.read(S, 0x805, 1), [0], "forgotten on the way to PreOp");
}

#[test]
fn going_back_to_init_forgets_the_mailbox() {
    let mut bus = preop();
    bus.send_mailbox(S, 3, &[0, 0x20, 0x40, 3, 0x20, 0, 0, 0, 0, 0]);
    bus.wait(1_000_000);
    bus.to(S, INIT);
    bus.write(S, 0x806, &[0]);
    bus.write(S, 0x80e, &[0]);
    bus.preop(S);
    assert_eq!(bus.fetch(S), None);
    assert_eq!(bus.upload(S, 0x2003, 0).unwrap(), [7, 0, 0, 0]);
}

fn octets() -> Vec<u8> {
    (0..500).map(|n| (7 * n + n / 256) as u8).collect()
}

#[test]
fn long_objects_pass_mailboxes_of_every_size() {
    for len in [16, 17, 23, 24, 48, 128, 256, 510, 511, 1024, 1486] {
        let mut bus = mailbox_bus(len, DeviceOptions::default());
        assert_eq!(bus.upload(S, 0x2000, 0).unwrap(), octets(), "{len} bytes");
        let data: Vec<u8> = (0..64).map(|n| n ^ len as u8).collect();
        bus.download(S, 0x2001, 0, &data).unwrap();
        assert_eq!(bus.upload(S, 0x2001, 0).unwrap(), data, "{len} bytes");
    }
}
