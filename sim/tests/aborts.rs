//! SDO aborts, ETG.1000.6 table 41 row by row.

use crate::common::*;
use Refusal::Abort;
use ecaxis_esi::model::{Device, Object, ObjectItem};
use ecaxis_sim::{DeviceOptions, FaultScript, MailboxOptions};

const S: u16 = 0x1001;

fn bus() -> Bus {
    mailbox_bus(48, DeviceOptions::default())
}

fn bus_with(mailbox: MailboxOptions) -> Bus {
    mailbox_bus(
        48,
        DeviceOptions {
            mailbox,
            ..DeviceOptions::default()
        },
    )
}

fn bus_of(device: &Device) -> Bus {
    let mut bus = Bus::new(vec![sim(device)]);
    bus.mailboxes = [(0x1000, 48), (0x1600, 48)];
    bus.address_all();
    bus.preop(S);
    bus
}

/// Sends a raw SDO request of up to eight bytes.
fn raw(bus: &mut Bus, request: &[u8]) -> Result<(), Refusal> {
    let mut payload = vec![0, 0x20];
    payload.extend_from_slice(request);
    payload.resize(10, 0);
    let (kind, reply) = bus.mailbox(S, 3, &payload);
    code_of(kind, &reply)
}

fn code_of(kind: u8, reply: &[u8]) -> Result<(), Refusal> {
    if kind == 3 && reply[2] == 0x80 {
        assert_eq!(reply[..2], [0, 0x20], "aborts travel as requests");
        return Err(Abort(u32::from_le_bytes(reply[6..10].try_into().unwrap())));
    }
    assert_eq!((kind, &reply[..2]), (3, &[0, 0x30][..]));
    Ok(())
}

fn to_safe_op(bus: &mut Bus) {
    bus.sm(S, 2, 0x1c00, 6, 0x64);
    bus.sm(S, 3, 0x1d00, 6, 0x20);
    bus.to(S, SAFEOP);
}

const START_UPLOAD: [u8; 4] = [0x40, 0, 0x20, 0];
/// 64 bytes announced, none sent.
const START_DOWNLOAD: [u8; 8] = [0x21, 1, 0x20, 0, 64, 0, 0, 0];

type Row = (u32, &'static str, fn() -> Result<(), Refusal>);

const ROWS: [Row; 27] = [
    (
        0x0503_0000,
        "segmented upload: toggle bit not changed",
        || {
            let mut bus = bus();
            raw(&mut bus, &START_UPLOAD)?;
            raw(&mut bus, &[0x60])?;
            raw(&mut bus, &[0x60])
        },
    ),
    (
        0x0503_0000,
        "segmented download: first toggle bit set",
        || {
            let mut bus = bus();
            raw(&mut bus, &START_DOWNLOAD)?;
            raw(&mut bus, &[0x10])
        },
    ),
    (0x0504_0000, "the client pauses for too long", || {
        let mut bus = bus_with(MailboxOptions {
            sdo_timeout_ns: Some(50_000_000),
            ..MailboxOptions::default()
        });
        raw(&mut bus, &START_UPLOAD)?;
        bus.wait(40_000_000);
        raw(&mut bus, &[0x60])?;
        bus.wait(51_000_000);
        let (kind, reply) = bus.fetch(S).unwrap();
        assert_eq!(reply[3..6], [0, 0x20, 0]);
        code_of(kind, &reply)
    }),
    (0x0504_0001, "command specifier 7", || {
        raw(&mut bus(), &[0xe0, 0, 0x20, 0])
    }),
    (0x0504_0001, "segment without a transfer", || {
        raw(&mut bus(), &[0x60])
    }),
    (0x0504_0001, "download segment in an upload", || {
        let mut bus = bus();
        raw(&mut bus, &START_UPLOAD)?;
        raw(&mut bus, &[0x00])
    }),
    (0x0504_0005, "longer than the device's buffer", || {
        let mut bus = bus_with(MailboxOptions {
            sdo_buffer: 499,
            ..MailboxOptions::default()
        });
        bus.upload(S, 0x2000, 0).map(drop)
    }),
    (0x0601_0000, "complete access from subindex 2", || {
        bus().upload_with(S, 0x50, 0x2010, 2).map(drop)
    }),
    (0x0601_0000, "a device without complete access", || {
        let mut device = mailbox_device();
        device
            .mailbox
            .as_mut()
            .unwrap()
            .coe
            .as_mut()
            .unwrap()
            .complete_access = false;
        bus_of(&device).upload_with(S, 0x50, 0x2010, 0).map(drop)
    }),
    (0x0601_0001, "reading what can only be written", || {
        bus().upload(S, 0x2024, 0).map(drop)
    }),
    (0x0601_0002, "writing what can only be read", || {
        bus().download(S, 0x2025, 0, &[0, 0])
    }),
    (
        0x0601_0003,
        "an element of a PDO mapping whose count is not 0",
        || bus().download(S, 0x1600, 1, &[16, 1, 0, 0x70]),
    ),
    (0x0601_0004, "complete access to an enumeration", || {
        let mut device = mailbox_device();
        device.dictionary.objects.push(Object {
            index: 0x0801,
            items: (0..3)
                .map(|sub| ObjectItem {
                    sub,
                    bit_len: 8,
                    ..ObjectItem::default()
                })
                .collect(),
            ..Object::default()
        });
        bus_of(&device).upload_with(S, 0x50, 0x0801, 0).map(drop)
    }),
    (0x0601_0005, "a device without segmented transfer", || {
        let mut bus = bus_with(MailboxOptions {
            segmented: false,
            ..MailboxOptions::default()
        });
        assert_eq!(
            bus.download(S, 0x2001, 0, &[0; 64]),
            Err(Abort(0x0601_0005))
        );
        bus.upload(S, 0x2000, 0).map(drop)
    }),
    (0x0601_0006, "an object in a PDO that is received", || {
        let mut bus = bus_with(MailboxOptions {
            refuse_mapped: true,
            ..MailboxOptions::default()
        });
        bus.download(S, 0x7000, 1, &[1, 0])?;
        to_safe_op(&mut bus);
        bus.download(S, 0x7000, 1, &[1, 0])
    }),
    (0x0602_0000, "no such object", || {
        bus().upload(S, 0x5fff, 0).map(drop)
    }),
    (0x0604_0041, "not mappable", || {
        let mut bus = bus();
        bus.download(S, 0x1600, 0, &[0])?;
        bus.download(S, 0x1600, 1, &[32, 0, 0, 0x10])
    }),
    (0x0604_0042, "the mapping exceeds the PDO", || {
        let mut bus = bus();
        bus.download(S, 0x1600, 0, &[0])?;
        for sub in 1..=9 {
            bus.download(S, 0x1600, sub, &[32, 2, 0, 0x70])?;
        }
        bus.download(S, 0x1600, 0, &[9])
    }),
    (0x0604_0043, "PDOs that exclude each other", || {
        let mut device = mailbox_device();
        let mut other = device.rx_pdos[0].clone();
        (other.index, other.sm, other.exclude) = (0x1601, None, vec![0x1600.into()]);
        device.rx_pdos.push(other);
        let mut bus = bus_of(&device);
        bus.download(S, 0x1c12, 0, &[0])?;
        bus.download(S, 0x1c12, 2, &[1, 0x16])?;
        bus.download(S, 0x1c12, 0, &[2])
    }),
    (0x0607_0010, "fewer bytes than announced", || {
        let mut bus = bus();
        raw(&mut bus, &START_DOWNLOAD)?;
        raw(&mut bus, &[0x01])
    }),
    (0x0607_0012, "too long", || {
        bus().download(S, 0x2001, 0, &[0; 65])
    }),
    (0x0607_0013, "too short", || {
        bus().download(S, 0x2001, 0, &[0; 63])
    }),
    (0x0609_0011, "no such subindex", || {
        bus().upload(S, 0x2010, 4).map(drop)
    }),
    (0x0609_0030, "not a value", || {
        bus().download(S, 0x2021, 0, &f32::NAN.to_le_bytes())
    }),
    (0x0609_0031, "too high", || {
        bus().download(S, 0x2020, 0, &1001_i32.to_le_bytes())
    }),
    (0x0609_0032, "too low", || {
        bus().download(S, 0x2020, 0, &(-1001_i32).to_le_bytes())
    }),
    (
        0x0800_0020,
        "a wrong signature does not store parameters",
        || bus().download(S, 0x1010, 1, b"sava"),
    ),
];

#[test]
fn device_sends_every_abort_with_a_cause() {
    for (code, what, provoke) in ROWS {
        assert_eq!(provoke(), Err(Abort(code)), "{what}");
    }
    let mut bus = bus();
    to_safe_op(&mut bus);
    assert_eq!(bus.download(S, 0x2026, 0, &[0, 0]), Err(Abort(0x0800_0022)));
    bus.download(S, 0x2028, 0, &[0, 0]).unwrap();
    bus.to(S, OP);
    assert_eq!(bus.download(S, 0x2028, 0, &[0, 0]), Err(Abort(0x0800_0022)));
}

#[test]
fn remaining_aborts_come_from_a_fault_script() {
    for code in [
        0x0604_0047_u32,
        0x0606_0000,
        0x0609_0036,
        0x0800_0000,
        0x0800_0021,
        0x0800_0023,
    ] {
        let mut bus = bus();
        let script = format!("[[fault]]\nkind = \"sdo-abort\"\nindex = 0x2020\ncode = {code}\n");
        bus.segment.set_faults(FaultScript::parse(&script).unwrap());
        assert_eq!(bus.download(S, 0x2020, 0, &[0; 4]), Err(Abort(code)));
        assert_eq!(bus.upload(S, 0x2020, 0), Err(Abort(code)));
    }
}

#[test]
fn number_ranges_hold_for_every_type() {
    let mut bus = bus();
    let (value, high, low) = (
        Err(Abort(0x0609_0030)),
        Err(Abort(0x0609_0031)),
        Err(Abort(0x0609_0032)),
    );
    for (index, data, expected) in [
        (0x2020, (-1000_i32).to_le_bytes().to_vec(), Ok(())),
        (0x2021, 1.5_f32.to_le_bytes().to_vec(), Ok(())),
        (0x2021, 1.6_f32.to_le_bytes().to_vec(), high),
        (0x2021, f32::NEG_INFINITY.to_le_bytes().to_vec(), low),
        (0x2022, 1.0_f64.to_le_bytes().to_vec(), Ok(())),
        (0x2022, 1.01_f64.to_le_bytes().to_vec(), high),
        (0x2022, f64::NAN.to_le_bytes().to_vec(), value),
        (0x2023, (1_u64 << 63).to_le_bytes().to_vec(), Ok(())),
        (0x2023, u64::MAX.to_le_bytes().to_vec(), high),
        (0x2023, 0_u64.to_le_bytes().to_vec(), low),
        (0x2027, vec![1], Ok(())),
        (0x2027, vec![2], value),
    ] {
        let before = bus.upload(S, index, 0).unwrap();
        assert_eq!(bus.download(S, index, 0, &data), expected, "0x{index:04x}");
        let after = bus.upload(S, index, 0).unwrap();
        assert_eq!(after, if expected.is_ok() { data } else { before });
    }
}

#[test]
fn abort_ends_the_transfer() {
    let mut bus = bus();
    // An abort by the device.
    raw(&mut bus, &START_UPLOAD).unwrap();
    assert_eq!(raw(&mut bus, &[0x70]), Err(Abort(0x0503_0000)));
    assert_eq!(raw(&mut bus, &[0x60]), Err(Abort(0x0504_0001)));
    // An abort by the client has no answer.
    raw(&mut bus, &START_UPLOAD).unwrap();
    bus.send_mailbox(S, 3, &[0, 0x20, 0x80, 0, 0x20, 0, 0, 0, 4, 5]);
    bus.wait(1_000_000);
    assert_eq!(bus.fetch(S), None);
    assert_eq!(raw(&mut bus, &[0x60]), Err(Abort(0x0504_0001)));
}

#[test]
fn new_request_replaces_an_active_transfer() {
    let mut bus = bus();
    raw(&mut bus, &START_UPLOAD).unwrap();
    raw(&mut bus, &START_DOWNLOAD).unwrap();
    assert_eq!(
        raw(&mut bus, &[0x60]),
        Err(Abort(0x0504_0001)),
        "no upload any more"
    );
    raw(&mut bus, &START_DOWNLOAD).unwrap();
    assert_eq!(bus.upload(S, 0x2025, 0).unwrap(), [0xfe, 0xca]);
    assert_eq!(
        raw(&mut bus, &[0x01]),
        Err(Abort(0x0504_0001)),
        "no download any more"
    );
}
