//! The SDO server, accessed over the wire.

use crate::common::*;
use Refusal::Abort;
use ecaxis_sim::{DeviceOptions, FaultScript};

const S: u16 = 0x1001;

fn preop() -> Bus {
    let mut bus = Bus::new(vec![sim(&coe_device())]);
    bus.address_all();
    bus.preop(S);
    bus
}

#[test]
fn values_transfer_in_both_directions_in_every_transfer_type() {
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
fn segmented_transfers_may_end_at_any_byte() {
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
    assert_eq!(bus.upload_with(S, 0x50, 0x2004, 2), Err(Abort(0x0601_0000)));
    // A mapping in one transfer: count, padding, two entries.
    let map = [2, 0, 0x10, 2, 0x10, 0x70, 0x10, 1, 0x10, 0x70];
    bus.download_with(S, 0x10, 0x1600, 0, &map).unwrap();
    assert_eq!(bus.upload_with(S, 0x50, 0x1600, 0).unwrap(), map);
}

#[test]
fn refusals_carry_the_standard_abort_codes() {
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
fn pdo_mapping_is_checked_against_the_dictionary() {
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

fn octets() -> Vec<u8> {
    (0..500).map(|n| (7 * n + n / 256) as u8).collect()
}

#[test]
fn long_objects_transfer_with_every_mailbox_size() {
    for len in [16, 17, 23, 24, 48, 128, 256, 510, 511, 1024, 1486] {
        let mut bus = mailbox_bus(len, DeviceOptions::default());
        assert_eq!(bus.upload(S, 0x2000, 0).unwrap(), octets(), "{len} bytes");
        let data: Vec<u8> = (0..64).map(|n| n ^ len as u8).collect();
        bus.download(S, 0x2001, 0, &data).unwrap();
        assert_eq!(bus.upload(S, 0x2001, 0).unwrap(), data, "{len} bytes");
    }
}

/// Requests and answers byte by byte, as in the standard's tables.
#[test]
fn transfer_types_match_the_standard_byte_by_byte() {
    let mut bus = mailbox_bus(16, DeviceOptions::default());
    let mut sdo = |request: &[u8]| {
        let mut payload = vec![0, 0x20];
        payload.extend_from_slice(request);
        let (kind, reply) = bus.mailbox(S, 3, &payload);
        assert_eq!((kind, &reply[..2]), (3, &[0, 0x30][..]));
        reply[2..].to_vec()
    };
    // Expedited, one to four bytes, size indicated.
    assert_eq!(
        sdo(&[0x40, 0x27, 0x20, 0, 0, 0, 0, 0]),
        [0x4f, 0x27, 0x20, 0, 1, 0, 0, 0]
    );
    assert_eq!(
        sdo(&[0x40, 0x25, 0x20, 0, 0, 0, 0, 0]),
        [0x4b, 0x25, 0x20, 0, 0xfe, 0xca, 0, 0]
    );
    assert_eq!(
        sdo(&[0x40, 0x18, 0x10, 1, 0, 0, 0, 0]),
        [0x43, 0x18, 0x10, 1, 0x0a, 0x0e, 0, 0]
    );
    assert_eq!(
        sdo(&[0x2b, 0x26, 0x20, 0, 5, 0, 0, 0]),
        [0x60, 0x26, 0x20, 0, 0, 0, 0, 0]
    );
    // Size not indicated: the object's own size applies.
    assert_eq!(
        sdo(&[0x22, 0x26, 0x20, 0, 6, 0, 9, 9]),
        [0x60, 0x26, 0x20, 0, 0, 0, 0, 0]
    );
    assert_eq!(sdo(&[0x40, 0x26, 0x20, 0, 0, 0, 0, 0])[4..6], [6, 0]);
    // Four bytes by normal transfer, then five: too many for one mailbox of 16.
    let five = sdo(&[0x40, 0x08, 0x10, 0, 0, 0, 0, 0]);
    assert_eq!(five, [0x41, 0x08, 0x10, 0, 13, 0, 0, 0]);
    assert_eq!(sdo(&[0x60, 0, 0, 0, 0, 0, 0, 0]), *b"\x00Mailbox");
    assert_eq!(
        sdo(&[0x70, 0, 0, 0, 0, 0, 0, 0]),
        *b"\x13 judge\0",
        "6 of 7, the last"
    );
    // A segmented download with one byte unused at the end.
    assert_eq!(
        sdo(&[0x21, 2, 0x20, 0, 13, 0, 0, 0]),
        [0x60, 2, 0x20, 0, 0, 0, 0, 0]
    );
    assert_eq!(sdo(b"\x00segment"), [0x20, 0, 0, 0, 0, 0, 0, 0]);
    assert_eq!(sdo(b"\x13ed one\0"), [0x30, 0, 0, 0, 0, 0, 0, 0]);
    // Without an announced size.
    assert_eq!(sdo(&[0x20, 2, 0x20, 0, 0, 0, 0, 0])[0], 0x60);
    assert_eq!(sdo(b"\x00ABCDEFG")[0], 0x20);
    assert_eq!(sdo(b"\x1dH\0\0\0\0\0\0")[0], 0x30);
    assert_eq!(bus.upload(S, 0x2002, 0).unwrap(), *b"ABCDEFGH");
}

#[test]
fn complete_access_spans_bits_and_gaps() {
    let mut bus = mailbox_bus(48, DeviceOptions::default());
    // 7, padding; 1 and 5 in four bits; 0x1234; a byte of padding; -2; 2 and the device's own bit.
    let all = [7, 0, 0x0b, 0x34, 0x12, 0, 0xfe, 0xff, 0xff, 0xff, 0x06];
    assert_eq!(bus.upload_with(S, 0x50, 0x2010, 0).unwrap(), all);
    assert_eq!(bus.upload_with(S, 0x50, 0x2010, 1).unwrap(), all[2..]);
    // Read-only items keep their value; gaps store nothing.
    let written = [0xff, 0xff, 0xf4, 0x78, 0x56, 0xff, 1, 0, 0, 0, 0x01];
    bus.download_with(S, 0x10, 0x2010, 0, &written).unwrap();
    let now = [7, 0, 0x04, 0x78, 0x56, 0, 1, 0, 0, 0, 0x05];
    assert_eq!(bus.upload_with(S, 0x50, 0x2010, 0).unwrap(), now);
    assert_eq!(bus.upload(S, 0x2010, 2).unwrap(), [2]);
    // A download that ends between two items leaves the rest unchanged. One that ends inside an
    // item writes nothing.
    bus.download_with(S, 0x10, 0x2010, 1, &[0x01, 0, 0])
        .unwrap();
    assert_eq!(
        bus.upload_with(S, 0x50, 0x2010, 1).unwrap(),
        [1, 0, 0, 0, 1, 0, 0, 0, 0x05]
    );
    let torn = bus.download_with(S, 0x10, 0x2010, 1, &[0x0f, 9, 9, 9, 9, 9]);
    assert_eq!(torn, Err(Abort(0x0607_0013)));
    assert_eq!(bus.upload(S, 0x2010, 1).unwrap(), [1]);
    let long = bus.download_with(S, 0x10, 0x2010, 0, &[0; 12]);
    assert_eq!(long, Err(Abort(0x0607_0012)));
    // An array, a variable, an object of constants only.
    let words = bus.upload_with(S, 0x50, 0x2011, 0).unwrap();
    assert_eq!((words.len(), &words[..6]), (18, &[8, 0, 1, 1, 2, 2][..]));
    assert_eq!(bus.upload_with(S, 0x50, 0x2025, 0).unwrap(), [0xfe, 0xca]);
    assert_eq!(
        bus.download_with(S, 0x10, 0x1018, 0, &[4, 0, 1]),
        Err(Abort(0x0607_0013))
    );
    assert_eq!(
        bus.download_with(S, 0x10, 0x1018, 0, &[4, 0]),
        Err(Abort(0x0601_0002))
    );
    assert_eq!(bus.upload_with(S, 0x50, 0x5fff, 0), Err(Abort(0x0602_0000)));
}

#[test]
fn complete_access_write_must_match_its_count() {
    let mut bus = mailbox_bus(48, DeviceOptions::default());
    assert_eq!(
        bus.download_with(S, 0x10, 0x1c12, 0, &[1, 0]),
        Err(Abort(0x0607_0013))
    );
    bus.download_with(S, 0x10, 0x1c12, 0, &[0, 0]).unwrap();
    assert_eq!(bus.upload_with(S, 0x50, 0x1c12, 0).unwrap(), [0, 0]);
    bus.download_with(S, 0x10, 0x1c12, 0, &[1, 0, 0, 0x16])
        .unwrap();
    assert_eq!(
        bus.upload_with(S, 0x50, 0x1c12, 0).unwrap(),
        [1, 0, 0, 0x16]
    );
}

#[test]
fn texts_end_at_their_length() {
    let mut bus = mailbox_bus(48, DeviceOptions::default());
    assert_eq!(bus.upload(S, 0x2002, 0).unwrap(), *b"text");
    bus.download(S, 0x2002, 0, b"a longer text, of 33 characters..")
        .unwrap();
    bus.download(S, 0x2002, 0, b"short").unwrap();
    assert_eq!(bus.upload(S, 0x2002, 0).unwrap(), *b"short");
    assert_eq!(bus.upload(S, 0x2003, 0).unwrap().len(), 95);
}

#[test]
fn stored_parameters_survive_a_power_cycle_until_restored() {
    let mut bus = mailbox_bus(48, DeviceOptions::default());
    let cycle = |bus: &mut Bus, command: Option<(u16, &[u8])>| {
        if let Some((index, signature)) = command {
            bus.download(S, index, 1, signature).unwrap();
        }
        let absent = "[[fault]]\nkind = \"absent\"\nfor = \"1ms\"\n";
        bus.segment.set_faults(FaultScript::parse(absent).unwrap());
        bus.wait(2_000_000_000);
        assert_eq!(bus.address_all(), 1);
        bus.preop(S);
        let value = |bus: &mut Bus, index| bus.upload(S, index, 0).unwrap()[0];
        (value(bus, 0x2020), value(bus, 0x2028))
    };
    bus.download(S, 0x2020, 0, &[9, 0, 0, 0]).unwrap();
    assert_eq!(cycle(&mut bus, None), (0, 2));
    bus.download(S, 0x2020, 0, &[9, 0, 0, 0]).unwrap();
    bus.download(S, 0x2028, 0, &[9, 0]).unwrap();
    assert_eq!(
        cycle(&mut bus, Some((0x1010, b"save"))),
        (9, 2),
        "only what is marked"
    );
    assert_eq!(cycle(&mut bus, Some((0x1011, b"load"))), (0, 2));
}

#[test]
fn mapping_entry_is_always_32_bits_long() {
    let mut device = coe_device();
    let entry = device.rx_pdos[0].entries[0].mapping();
    let mut object = device.dictionary.objects[0].clone();
    object.index = device.rx_pdos[0].index;
    let write = ecaxis_esi::model::Writable::Never;
    object.items = vec![item(0, 8, 0, write, &[1]), item(1, 16, 16, write, &[])];
    device.dictionary.objects.push(object);
    let mut bus = Bus::new(vec![sim(&device)]);
    bus.address_all();
    bus.preop(S);
    assert_eq!(bus.upload(S, 0x1600, 1).unwrap(), entry.to_le_bytes());
}
