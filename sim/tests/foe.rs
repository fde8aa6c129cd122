//! File access (ETG.1000.6 §5.8), in Bootstrap and in the other states.

use crate::common::*;
use ecaxis_sim::{DeviceOptions, FaultScript, FoeOptions, MailboxOptions};
use proptest::prelude::*;

const S: u16 = 0x1001;
const FOE: u8 = 4;

const NOT_FOUND: u32 = 0x8001;
const ACCESS_DENIED: u32 = 0x8002;
const DISK_FULL: u32 = 0x8003;
const ILLEGAL: u32 = 0x8004;
const PACKET_NUMBER: u32 = 0x8005;
const BOOTSTRAP_ONLY: u32 = 0x8008;
const NO_RIGHTS: u32 = 0x800a;

fn bus(len: u16, foe: FoeOptions) -> Bus {
    let mailbox = MailboxOptions {
        foe,
        ..MailboxOptions::default()
    };
    mailbox_bus(
        len,
        DeviceOptions {
            mailbox,
            ..DeviceOptions::default()
        },
    )
}

fn boot(foe: FoeOptions) -> Bus {
    let mut bus = bus(48, foe);
    to_boot(&mut bus);
    bus
}

/// Goes to Bootstrap with the mailboxes of EEPROM words 0x14 to 0x17.
fn to_boot(bus: &mut Bus) {
    bus.to(S, INIT);
    let sii = bus.segment.device(0).unwrap().sii();
    let word = |n: usize| u16::from_le_bytes([sii[2 * n], sii[2 * n + 1]]);
    bus.mailboxes = [(word(0x14), word(0x15)), (word(0x16), word(0x17))];
    disable_mailboxes(bus);
    bus.start_mailboxes(S);
    bus.to(S, BOOT);
}

fn disable_mailboxes(bus: &mut Bus) {
    bus.write(S, 0x806, &[0]);
    bus.write(S, 0x80e, &[0]);
}

/// The device's answer.
#[derive(Debug, PartialEq)]
enum Said {
    Data(u32, Vec<u8>),
    Ack(u32),
    Error(u32),
    Busy,
    Nothing,
}

fn say(bus: &mut Bus, opcode: u8, number: u32, data: &[u8]) -> Said {
    let mut payload = vec![opcode, 0];
    payload.extend_from_slice(&number.to_le_bytes());
    payload.extend_from_slice(data);
    bus.send_mailbox(S, FOE, &payload);
    bus.wait(1_000_000);
    let Some((kind, reply)) = bus.fetch(S) else {
        return Said::Nothing;
    };
    assert_eq!((kind, reply[1]), (FOE, 0));
    let number = u32::from_le_bytes(reply[2..6].try_into().unwrap());
    match reply[0] {
        3 => Said::Data(number, reply[6..].to_vec()),
        4 => Said::Ack(number),
        5 => Said::Error(number),
        6 => {
            assert!(number & 0xffff <= number >> 16, "done of entire");
            Said::Busy
        }
        other => panic!("opcode {other}"),
    }
}

fn read(bus: &mut Bus, name: &str, password: u32) -> Result<Vec<u8>, u32> {
    let full = usize::from(bus.mailboxes[1].1) - 12;
    let mut file = Vec::new();
    let mut said = say(bus, 1, password, name.as_bytes());
    for packet in 1.. {
        match said {
            Said::Data(number, data) => {
                assert_eq!(number, packet);
                assert!(data.len() <= full);
                file.extend_from_slice(&data);
                said = say(bus, 4, packet, &[]);
                if data.len() < full {
                    assert_eq!(said, Said::Nothing, "the last acknowledgement");
                    return Ok(file);
                }
            }
            Said::Error(code) => return Err(code),
            other => panic!("{other:?}"),
        }
    }
    unreachable!()
}

/// Writes a file, and repeats packets while the device is busy. Returns the number of repetitions.
fn write(bus: &mut Bus, name: &str, password: u32, file: &[u8]) -> Result<u32, u32> {
    let full = usize::from(bus.mailboxes[0].1) - 12;
    let mut busy = 0;
    match say(bus, 2, password, name.as_bytes()) {
        Said::Ack(0) => {}
        Said::Error(code) => return Err(code),
        other => panic!("{other:?}"),
    }
    // An empty packet follows a file that fills its last packet.
    for (packet, at) in (1..).zip((0..=file.len()).step_by(full)) {
        let data = &file[at..file.len().min(at + full)];
        loop {
            match say(bus, 3, packet, data) {
                Said::Ack(number) => break assert_eq!(number, packet),
                Said::Busy => busy += 1,
                Said::Error(code) => return Err(code),
                other => panic!("{other:?}"),
            }
        }
    }
    Ok(busy)
}

fn bytes(len: usize) -> Vec<u8> {
    (0..len).map(|n| (n * 31 + n / 251) as u8).collect()
}

#[test]
fn files_of_every_length_read_back_equal() {
    // 48-byte mailboxes carry 36 bytes of a file.
    for mailbox in [16, 48, 256, 1486] {
        let mut bus = bus(mailbox, FoeOptions::default());
        let full = usize::from(mailbox) - 12;
        for len in [0, 1, full - 1, full, full + 1, 3 * full, 3 * full + 1] {
            let file = bytes(len);
            assert_eq!(write(&mut bus, "f", 0, &file), Ok(0));
            assert_eq!(read(&mut bus, "f", 0), Ok(file.clone()));
            let device = bus.segment.device(0).unwrap();
            assert_eq!(device.foe_files().get("f"), Some(&file[..]));
        }
    }
}

#[test]
fn bootstrap_has_its_own_mailboxes_and_only_foe() {
    let mut bus = boot(FoeOptions::default());
    assert_eq!(bus.mailboxes, [(0x1000, 256), (0x1600, 256)]);
    let firmware = bytes(5000);
    write(&mut bus, "firmware.bin", 0, &firmware).unwrap();
    assert_eq!(read(&mut bus, "firmware.bin", 0), Ok(firmware));
    let upload = [0, 0x20, 0x40, 0x25, 0x20, 0, 0, 0, 0, 0];
    assert_eq!(bus.mailbox(S, 3, &upload), (0, vec![1, 0, 2, 0]));
    let script = "[[fault]]\nkind = \"emergency\"\ncode = 0x8110\n";
    bus.segment.set_faults(FaultScript::parse(script).unwrap());
    bus.wait(1_000_000);
    assert_eq!(bus.fetch(S), None, "no emergencies either");
    // Back to PreOp with the standard mailboxes.
    bus.to(S, INIT);
    disable_mailboxes(&mut bus);
    bus.mailboxes = [(0x1000, 48), (0x1600, 48)];
    bus.preop(S);
    assert_eq!(read(&mut bus, "firmware.bin", 0).unwrap().len(), 5000);
}

#[test]
fn firmware_is_written_in_bootstrap_while_flash_is_erased() {
    let options = FoeOptions {
        bootstrap_only: vec!["firmware.bin".into()],
        busy_every: 4,
        ..FoeOptions::default()
    };
    let mut bus = bus(48, options);
    let firmware = bytes(5000);
    assert_eq!(
        write(&mut bus, "firmware.bin", 0, &firmware),
        Err(BOOTSTRAP_ONLY)
    );
    assert_eq!(read(&mut bus, "firmware.bin", 0), Err(BOOTSTRAP_ONLY));
    to_boot(&mut bus);
    // 21 packets of 244 bytes.
    assert_eq!(write(&mut bus, "firmware.bin", 0, &firmware), Ok(5));
    assert_eq!(read(&mut bus, "firmware.bin", 0), Ok(firmware));
    let device = bus.segment.device_mut(0).unwrap();
    assert_eq!(device.take_written_file().as_deref(), Some("firmware.bin"));
    assert_eq!(device.take_written_file(), None);
}

#[test]
fn foe_refusals_row_by_row() {
    let options = FoeOptions {
        password: 0x1234,
        read_only: vec!["serial".into()],
        capacity: 100,
        ..FoeOptions::default()
    };
    let mut bus = bus(48, options);
    let device = bus.segment.device_mut(0).unwrap();
    assert!(device.put_file("serial", b"4711"));
    assert!(!device.put_file("large", &[0; 100]));
    let p = 0x1234;
    assert_eq!(read(&mut bus, "none", p), Err(NOT_FOUND));
    assert_eq!(read(&mut bus, "", p), Err(NOT_FOUND));
    assert_eq!(read(&mut bus, "serial", 0x1235), Err(NO_RIGHTS));
    assert_eq!(write(&mut bus, "f", 0, &[]), Err(NO_RIGHTS));
    assert_eq!(read(&mut bus, "serial", p), Ok(b"4711".to_vec()));
    assert_eq!(write(&mut bus, "serial", p, b"0815"), Err(ACCESS_DENIED));
    assert_eq!(write(&mut bus, "", p, &[]), Err(ILLEGAL));
    // "serial" and its contents take 10 bytes, "f" takes one.
    assert_eq!(write(&mut bus, "f", p, &bytes(90)), Err(DISK_FULL));
    assert_eq!(
        read(&mut bus, "f", p),
        Err(NOT_FOUND),
        "nothing of it is kept"
    );
    write(&mut bus, "f", p, &bytes(89)).unwrap();
    assert_eq!(write(&mut bus, "f", p, &bytes(90)), Err(DISK_FULL));
    assert_eq!(read(&mut bus, "f", p), Ok(bytes(89)), "the old one stays");
    assert_eq!(write(&mut bus, "g", p, &[]), Err(DISK_FULL));
    // Opcodes at the wrong time, and invalid opcodes.
    for opcode in [0, 3, 4, 6, 7, 255] {
        assert_eq!(
            say(&mut bus, opcode, 1, &[]),
            Said::Error(ILLEGAL),
            "{opcode}"
        );
    }
    assert_eq!(say(&mut bus, 5, 0x8000, b"never mind"), Said::Nothing);
    assert_eq!(bus.mailbox(S, FOE, &[1, 0, 0, 0, 0]), (0, vec![1, 0, 6, 0]));
}

#[test]
fn wrong_packet_number_ends_the_transfer() {
    let mut bus = bus(48, FoeOptions::default());
    assert_eq!(say(&mut bus, 2, 0, b"f"), Said::Ack(0));
    assert_eq!(say(&mut bus, 3, 1, &bytes(36)), Said::Ack(1));
    assert_eq!(say(&mut bus, 3, 3, &bytes(36)), Said::Error(PACKET_NUMBER));
    assert_eq!(say(&mut bus, 3, 2, &bytes(36)), Said::Error(ILLEGAL));
    bus.segment
        .device_mut(0)
        .unwrap()
        .put_file("f", &bytes(100));
    assert_eq!(say(&mut bus, 1, 0, b"f"), Said::Data(1, bytes(36)));
    assert_eq!(say(&mut bus, 4, 0, &[]), Said::Error(PACKET_NUMBER));
    assert_eq!(say(&mut bus, 4, 1, &[]), Said::Error(ILLEGAL));
}

#[test]
fn busy_client_gets_the_packet_again() {
    let mut bus = bus(48, FoeOptions::default());
    bus.segment.device_mut(0).unwrap().put_file("f", &bytes(40));
    let file = bytes(40);
    for _ in 0..3 {
        let first = if let Said::Data(1, data) = say(&mut bus, 1, 0, b"f\0\0") {
            data
        } else {
            panic!("no data")
        };
        assert_eq!(first, file[..36]);
        assert_eq!(say(&mut bus, 6, 0, &[]), Said::Data(1, first));
        assert_eq!(say(&mut bus, 4, 1, &[]), Said::Data(2, file[36..].to_vec()));
        assert_eq!(say(&mut bus, 6, 0, &[]), Said::Data(2, file[36..].to_vec()));
        // The last acknowledgement or an abort ends the transfer.
        assert_eq!(say(&mut bus, 5, 0x8000, &[]), Said::Nothing);
    }
    assert_eq!(
        say(&mut bus, 1, 0, b"f"),
        Said::Data(1, file[..36].to_vec())
    );
    assert_eq!(
        say(&mut bus, 1, 0, b"f"),
        Said::Error(ILLEGAL),
        "one at a time"
    );
}

#[test]
fn transfer_ends_on_state_change_and_files_survive_a_power_cycle() {
    let mut bus = bus(48, FoeOptions::default());
    write(&mut bus, "kept", 0, b"kept").unwrap();
    assert_eq!(say(&mut bus, 2, 0, b"half"), Said::Ack(0));
    assert_eq!(say(&mut bus, 3, 1, &bytes(36)), Said::Ack(1));
    bus.to(S, INIT);
    bus.to(S, PREOP);
    assert_eq!(say(&mut bus, 3, 2, &[]), Said::Error(ILLEGAL));
    assert_eq!(read(&mut bus, "half", 0), Err(NOT_FOUND));
    let absent = "[[fault]]\nkind = \"absent\"\nfor = \"1ms\"\n";
    bus.segment.set_faults(FaultScript::parse(absent).unwrap());
    bus.wait(1_000_000_000);
    bus.address_all();
    bus.preop(S);
    assert_eq!(read(&mut bus, "kept", 0), Ok(b"kept".to_vec()));
}

#[test]
fn file_access_needs_the_esi_flag() {
    let mut device = mailbox_device();
    device.mailbox.as_mut().unwrap().foe = false;
    for (has_foe, expected) in [(None, 0), (Some(true), FOE)] {
        let mailbox = MailboxOptions {
            has_foe,
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
        assert_eq!(bus.mailbox(S, FOE, &[1, 0, 0, 0, 0, 0, b'f']).0, expected);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]
    #[test]
    fn written_files_read_back_equal(
        mailbox in 16u16..300, busy_every in 0u32..4,
        file in prop::collection::vec(any::<u8>(), 0..2000), name in "[a-zA-Z0-9._-]{1,4}",
    ) {
        let mut bus = bus(mailbox, FoeOptions { busy_every, ..FoeOptions::default() });
        prop_assert!(write(&mut bus, &name, 0, &file).is_ok());
        prop_assert_eq!(read(&mut bus, &name, 0), Ok(file));
    }
}
