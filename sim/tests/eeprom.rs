//! The EEPROM behind 0x0500–0x050F, and the values that the controller loads: alias, configuration.

use crate::common::*;
use ecaxis_sim::frame::{self, FrameBuilder};
use ecaxis_sim::{DeviceOptions, EscInfo, FaultScript, SimDevice};

const S: u16 = 0x1001;

fn one(device: SimDevice) -> Bus {
    let mut bus = Bus::new(vec![device]);
    assert_eq!(bus.address_all(), 1);
    bus
}

fn drive_like() -> Bus {
    one(sim(&coe_device()))
}

/// Sends several datagrams in one frame. Returns their working counters.
fn together(bus: &mut Bus, datagrams: &[(u8, u16, &[u8])]) -> Vec<u16> {
    let frame = datagrams
        .iter()
        .fold(FrameBuilder::default(), |frame, (command, ado, data)| {
            frame.datagram(*command, S, *ado, data)
        });
    let bytes = bus.frame(frame.build()).unwrap();
    let mut counters = Vec::new();
    let mut at = frame::next(&bytes, None);
    while let Some(datagram) = at {
        counters.push(datagram.wkc(&bytes));
        at = frame::next(&bytes, Some(&datagram));
    }
    counters
}

fn crc(bytes: &[u8]) -> u8 {
    bytes.iter().fold(0xff, |crc, byte| {
        (0..8).fold(crc ^ byte, |crc: u8, _| {
            crc << 1 ^ if crc & 0x80 != 0 { 7 } else { 0 }
        })
    })
}

/// Issues a command, waits, and returns the status.
fn command(bus: &mut Bus, command: u8, word: u32) -> u16 {
    let mut request = vec![0, command];
    request.extend_from_slice(&word.to_le_bytes());
    bus.write(S, 0x502, &request);
    bus.wait(1_000_000);
    bus.read_u16(S, 0x502)
}

fn write_word(bus: &mut Bus, word: u32, value: u16) {
    bus.write(S, 0x508, &value.to_le_bytes());
    let mut request = vec![1, 2];
    request.extend_from_slice(&word.to_le_bytes());
    bus.write(S, 0x502, &request);
    bus.wait(1_000_000);
    assert_eq!(bus.read_u16(S, 0x502) & 0xe000, 0);
}

fn power_cycle(bus: &mut Bus) {
    let at = bus.now / 1_000_000 + 1;
    let script =
        format!("[[fault]]\nat = \"{at}ms\"\nfor = \"1ms\"\ndevice = 0\nkind = \"absent\"\n");
    bus.segment.set_faults(FaultScript::parse(&script).unwrap());
    bus.wait(5_000_000);
    bus.address_all();
}

#[test]
fn busy_eeprom_interface_shows_its_command_and_ignores_writes() {
    let mut bus = drive_like();
    bus.write(S, 0x502, &[0, 1, 8, 0, 0, 0]);
    assert_eq!(bus.read_u16(S, 0x502) & 0x8700, 0x8100);
    for (at, len) in [(0x502, 2), (0x504, 4), (0x508, 2)] {
        assert_eq!(bus.datagram(5, S, at, &vec![0; len]).1, 0, "0x{at:04x}");
    }
    bus.wait(1_000_000);
    assert_eq!(bus.read_u16(S, 0x502) & 0x8700, 0);
    assert_eq!(bus.read(S, 0x508, 4), 0x333_u32.to_le_bytes());
}

#[test]
fn write_enable_bit_is_valid_only_in_its_frame() {
    let mut bus = drive_like();
    let enable: (u8, u16, &[u8]) = (5, 0x502, &[1]);
    let write: (u8, u16, &[u8]) = (5, 0x503, &[2, 4, 0, 0, 0]);
    let word = |bus: &Bus| {
        let sii = bus.segment.device(0).unwrap().sii();
        [sii[8], sii[9]]
    };
    bus.write(S, 0x508, &[0x78, 0x56]);
    together(&mut bus, &[enable]);
    assert_eq!(bus.read_u16(S, 0x502) & 1, 0, "clears itself");
    together(&mut bus, &[write]);
    assert_eq!(
        bus.read_u16(S, 0x502) & 0xe000,
        0x4000,
        "write enable error"
    );
    assert_ne!(word(&bus), [0x78, 0x56]);
    assert_eq!(together(&mut bus, &[enable, write]), [1, 1]);
    bus.wait(1_000_000);
    assert_eq!(bus.read_u16(S, 0x502) & 0xe000, 0);
    assert_eq!(word(&bus), [0x78, 0x56]);
    assert_eq!(command(&mut bus, 3, 0) & 0xe000, 0x2000, "no such command");
    assert_eq!(command(&mut bus, 0, 0) & 0xe000, 0, "cleared");
}

#[test]
fn eeprom_is_owned_by_the_maindevice_or_the_device() {
    let mut bus = drive_like();
    let claim = |bus: &mut Bus, claim| {
        let device = bus.segment.device_mut(0).unwrap();
        device.claim_eeprom(claim)
    };
    assert!(!claim(&mut bus, true), "not offered");
    bus.write(S, 0x500, &[1]);
    assert!(claim(&mut bus, true));
    bus.write(S, 0x500, &[0]);
    assert_eq!(bus.read(S, 0x500, 2), [0, 1], "the device has it still");
    assert_eq!(bus.datagram(5, S, 0x502, &[0, 1, 0, 0, 0, 0]).1, 0);
    assert_eq!(bus.read_u16(S, 0x502) & 1, 1, "and may write");
    assert!(!claim(&mut bus, false));
    assert_eq!(bus.datagram(5, S, 0x502, &[0, 1, 0, 0, 0, 0]).1, 1);
    bus.wait(1_000_000);
    // A device that does not release the EEPROM is forced to.
    bus.write(S, 0x500, &[1]);
    assert!(claim(&mut bus, true));
    bus.write(S, 0x500, &[2]);
    assert_eq!(bus.read(S, 0x500, 2), [2, 0]);
    assert!(!claim(&mut bus, true));
    bus.write(S, 0x500, &[0]);
    assert_eq!(command(&mut bus, 1, 0) & 0xe000, 0);
    assert_eq!(
        bus.datagram(5, S, 0x501, &[0]).1,
        0,
        "the device's own register"
    );
}

#[test]
fn reload_applies_a_valid_configuration() {
    let mut bus = drive_like();
    assert_eq!(bus.read_u16(S, 0x982), 0);
    write_word(&mut bus, 2, 0x1234);
    assert_eq!(command(&mut bus, 4, 0) & 0x0800, 0x0800, "checksum");
    assert_eq!(bus.read_u16(S, 0x982), 0, "kept");
    assert_eq!(bus.read(S, 0x110, 1)[0] & 1, 1, "and still running");
    let crc = crc(&bus.segment.device(0).unwrap().sii()[..14]);
    write_word(&mut bus, 7, u16::from(crc));
    assert_eq!(command(&mut bus, 4, 0) & 0x1800, 0);
    assert_eq!(bus.read_u16(S, 0x982), 0x1234);
}

#[test]
fn device_with_a_bad_checksum_stays_unconfigured_until_it_is_fixed() {
    let mut bus = drive_like();
    write_word(&mut bus, 7, 0);
    power_cycle(&mut bus);
    assert_eq!(
        bus.read_u16(S, 0x502) & 0x1800,
        0x1800,
        "checksum, not loaded"
    );
    assert_eq!(
        bus.read(S, 0x110, 1)[0] & 3,
        0,
        "no interface to an application"
    );
    assert_eq!(bus.read_u16(S, 0x140), 0);
    assert_eq!(bus.datagram(4, S, 0x1000, &[0; 16]).1, 0, "no process RAM");
    assert_eq!(bus.datagram(4, S, 0x0f80, &[0; 16]).1, 1, "but user RAM");
    bus.write(S, 0x120, &[2, 0]);
    bus.wait(1_000_000_000);
    assert_eq!(bus.read_u16(S, 0x130), 1, "no application answers");
    let crc = crc(&bus.segment.device(0).unwrap().sii()[..14]);
    write_word(&mut bus, 7, u16::from(crc));
    assert_eq!(command(&mut bus, 4, 0) & 0x1800, 0);
    assert_eq!(bus.read(S, 0x110, 1)[0] & 3, 3);
    assert_eq!(bus.datagram(4, S, 0x1000, &[0; 16]).1, 1);
    bus.wait(1_000_000);
    assert_eq!(
        bus.read_u16(S, 0x130),
        0x11,
        "PreOp refused: no mailbox yet"
    );
}

#[test]
fn alias_is_loaded_from_the_eeprom_and_used_when_enabled() {
    let options = DeviceOptions {
        alias: 0x0abc,
        ..DeviceOptions::default()
    };
    let mut bus = one(sim_with(&coe_device(), options));
    assert_eq!(bus.read_u16(S, 0x12), 0x0abc);
    assert_eq!(bus.datagram(5, S, 0x12, &[1, 2]).1, 0, "read only");
    let alias_answers = |bus: &mut Bus| bus.datagram(4, 0x0abc, 0, &[0]).1;
    assert_eq!(alias_answers(&mut bus), 0);
    bus.write(S, 0x103, &[1]);
    assert_eq!(alias_answers(&mut bus), 1);
    assert_eq!(
        bus.read_u16(S, 0x10),
        S,
        "and the station address still does"
    );
    assert_eq!(bus.datagram(14, 0x0abc, 0x918, &[0; 8]).1, 1, "FRMW reads");
    bus.write(S, 0x103, &[0]);
    assert_eq!(alias_answers(&mut bus), 0);
    // A new alias in the EEPROM takes effect at the next power-on, not at a reload.
    write_word(&mut bus, 4, 0x0def);
    let crc = crc(&bus.segment.device(0).unwrap().sii()[..14]);
    write_word(&mut bus, 7, u16::from(crc));
    command(&mut bus, 4, 0);
    assert_eq!(bus.read_u16(S, 0x12), 0x0abc);
    power_cycle(&mut bus);
    assert_eq!(bus.read_u16(S, 0x12), 0x0def);
}

/// Beckhoff ESC data sheet, section II, 0x0502 bit 7: EEPROMs above 16 KiBit need two address
/// bytes. Sizes of EEPROM chips are powers of two (Atmel AT24C01 to AT24C512).
#[test]
fn image_fits_its_chip() {
    let text = "x".repeat(60);
    let mut device = coe_device();
    device.eeprom.byte_size = 2048;
    let small = sim(&device).sii().len();
    assert_eq!(small, 2048);
    device.eeprom.categories = vec![ecaxis_esi::model::EepromCategory {
        number: 0x0801,
        data: text.repeat(40).into_bytes(),
        ..Default::default()
    }];
    for esc in [None, Some(EscInfo::ET1100), Some(EscInfo::ET1200)] {
        let options = DeviceOptions {
            esc,
            ..DeviceOptions::default()
        };
        let sim = SimDevice::from_esi(&device, &[], options).unwrap();
        let image = sim.sii().to_vec();
        assert_eq!(image.len(), 4096);
        assert_eq!(image[0x7c..0x7e], [31, 0], "the size in KiBit minus one");
        let mut bus = one(sim);
        let status = command(&mut bus, 1, 0x480);
        assert_eq!(status & 0x0080, 0x0080, "two address bytes");
        assert_eq!(bus.read(S, 0x508, 4), image[0x900..0x904]);
    }
}
