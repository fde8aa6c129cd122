//! Every datagram command: addressing, data and exact working counters (ETG.1000.4, 5.4; Beckhoff
//! ESC data sheet, section I, tables 5 to 7).

use crate::common::*;
use ecaxis_sim::frame::{self, FrameBuilder};

const DEVICES: u16 = 3;
/// Output and input SyncManager, RAM without a SyncManager, and an address without memory.
const WRITE_ONLY: u16 = 0x1000;
const READ_ONLY: u16 = 0x1100;
const BOTH: u16 = 0x13e0;
const NEITHER: u16 = 0x0e00;

/// Returns three terminals in SafeOp with 16 bits out and in.
fn terminals() -> Bus {
    let mut bus = Bus::new((0..DEVICES).map(|_| sim(&io_device())).collect());
    assert_eq!(bus.address_all(), DEVICES);
    for station in 0x1001..=0x1003 {
        bus.to(station, PREOP);
        bus.sm(station, 0, WRITE_ONLY, 2, 0x04);
        bus.sm(station, 1, READ_ONLY, 2, 0x00);
        bus.to(station, SAFEOP);
    }
    bus
}

#[derive(Debug, Clone, Copy)]
enum Kind {
    Nothing,
    Read,
    Write,
    ReadWrite,
    /// Reads from the addressed device, writes to all others.
    ReadMultipleWrite,
}

/// (code, kind, address that reaches the second device, number of addressed devices)
const PHYSICAL: [(u8, Kind, u16, u16); 12] = [
    (1, Kind::Read, 0xffff, 1),
    (2, Kind::Write, 0xffff, 1),
    (3, Kind::ReadWrite, 0xffff, 1),
    (4, Kind::Read, 0x1002, 1),
    (5, Kind::Write, 0x1002, 1),
    (6, Kind::ReadWrite, 0x1002, 1),
    (7, Kind::Read, 0, DEVICES),
    (8, Kind::Write, 0, DEVICES),
    (9, Kind::ReadWrite, 0, DEVICES),
    (13, Kind::ReadMultipleWrite, 0xffff, 1),
    (14, Kind::ReadMultipleWrite, 0x1002, 1),
    (0, Kind::Nothing, 0, 0),
];

fn expected(kind: Kind, addressed: u16, readable: bool, writable: bool) -> u16 {
    let (r, w) = (u16::from(readable), u16::from(writable));
    match kind {
        Kind::Nothing => 0,
        Kind::Read => addressed * r,
        Kind::Write => addressed * w,
        Kind::ReadWrite => addressed * (r + 2 * w),
        Kind::ReadMultipleWrite => addressed * r + (DEVICES - addressed) * w,
    }
}

#[test]
fn physical_commands_count_reads_and_writes_that_succeed() {
    let places = [
        (READ_ONLY, true, false),
        (WRITE_ONLY, false, true),
        (BOTH, true, true),
        (NEITHER, false, false),
        // Registers: AL status is read only, the watchdog divider is not.
        (0x0130, true, false),
        (0x0400, true, true),
    ];
    let mut bus = terminals();
    for (code, kind, adp, addressed) in PHYSICAL {
        for (ado, readable, writable) in places {
            assert_eq!(
                bus.datagram(code, adp, ado, &[1, 2]).1,
                expected(kind, addressed, readable, writable),
                "{kind:?} {code} at 0x{ado:04x}"
            );
        }
    }
}

#[test]
fn unaddressed_devices_count_only_read_multiple_write() {
    let mut bus = terminals();
    for (code, kind, adp, _) in PHYSICAL {
        // No device has this address. Broadcasts ignore the address.
        let no_one = if adp == 0xffff { 5 } else { 0x7777 };
        let broadcast = matches!(code, 7..=9);
        let addressed = if broadcast { DEVICES } else { 0 };
        assert_eq!(
            bus.datagram(code, no_one, BOTH, &[1, 2]).1,
            expected(kind, addressed, true, true),
            "{kind:?} {code}"
        );
    }
}

#[test]
fn logical_commands_count_once_per_device_and_direction() {
    // (read, write) FMMUs of the three devices; working counters of LRD, LWR, LRW.
    let rows = [
        ([(true, false); 3], [3, 0, 3]),
        ([(false, true); 3], [0, 3, 6]),
        ([(true, true); 3], [3, 3, 9]),
        ([(true, true), (true, false), (false, true)], [2, 2, 6]),
        ([(false, false); 3], [0, 0, 0]),
    ];
    for (fmmus, expected) in rows {
        let mut bus = terminals();
        for (station, (read, write)) in (0x1001..).zip(fmmus) {
            let at = u32::from(station & 0xff) * 16;
            if write {
                bus.fmmu(station, 0, at, 2, WRITE_ONLY, 2);
            }
            if read {
                bus.fmmu(station, 1, at, 2, READ_ONLY, 1);
                // A second FMMU elsewhere still counts as one read.
                bus.fmmu(station, 2, at + 4, 2, BOTH, 1);
            }
        }
        let counters = [10, 11, 12].map(|code| bus.logical(code, 0x10, &[0; 48]).1);
        assert_eq!(counters, expected, "{fmmus:?}");
        assert_eq!(bus.logical(12, 0x1000, &[0; 8]).1, 0, "no device is mapped");
    }
}

#[test]
fn read_write_commands_exchange_data() {
    let mut bus = terminals();
    bus.write(0x1002, BOTH, &[0x11, 0x22]);
    let rows = [(3, 0xffff), (6, 0x1002)];
    for (code, adp) in rows {
        assert_eq!(
            bus.datagram(code, adp, BOTH, &[0x33, 0x44]),
            (vec![0x11, 0x22], 3),
            "what was there comes back"
        );
        assert_eq!(bus.read(0x1002, BOTH, 2), [0x33, 0x44]);
        bus.write(0x1002, BOTH, &[0x11, 0x22]);
    }
    // BRW: the previous values of all devices, ORed with the datagram's data.
    bus.datagram(8, 0, BOTH, &[0x10, 0]);
    bus.write(0x1003, BOTH, &[0x02, 0]);
    assert_eq!(bus.datagram(9, 0, BOTH, &[0x80, 0]), (vec![0x92, 0], 9));
    // Each device writes the value that the devices before it have ORed together.
    assert_eq!(bus.read(0x1001, BOTH, 1), [0x80]);
    assert_eq!(bus.read(0x1002, BOTH, 1), [0x90]);
    assert_eq!(bus.read(0x1003, BOTH, 1), [0x90]);
}

#[test]
fn read_write_offset_separates_the_addresses() {
    let mut bus = terminals();
    bus.write(0x1002, 0x108, &[8, 0]);
    bus.write(0x1002, BOTH, &[1, 2]);
    assert_eq!(
        bus.datagram(6, 0x1002, BOTH, &[3, 4]),
        (vec![1, 2], 3),
        "reads here"
    );
    assert_eq!(bus.read(0x1002, BOTH, 2), [1, 2]);
    assert_eq!(bus.read(0x1002, BOTH + 8, 2), [3, 4], "writes there");
}

#[test]
fn read_multiple_write_carries_a_value_to_later_devices() {
    let mut bus = terminals();
    bus.write(0x1001, BOTH, &[0xaa]);
    bus.write(0x1002, BOTH, &[0xbb]);
    for (code, adp) in [(13, 0xffff), (14, 0x1002)] {
        assert_eq!(bus.datagram(code, adp, BOTH, &[0x77]), (vec![0xbb], 3));
        // Devices before the one that is read write the datagram's own byte.
        let values = [0x1001, 0x1002, 0x1003].map(|s| bus.read(s, BOTH, 1)[0]);
        assert_eq!(values, [0x77, 0xbb, 0xbb]);
        bus.write(0x1003, BOTH, &[0]);
    }
}

#[test]
fn position_addresses_count_up_and_others_stay() {
    let mut bus = terminals();
    for (code, _, _, _) in PHYSICAL {
        for address in [0u16, 5, 0xfffe] {
            let bytes = bus
                .frame(
                    FrameBuilder::default()
                        .datagram(code, address, BOTH, &[0])
                        .build(),
                )
                .unwrap();
            let counts = matches!(code, 1..=3 | 7..=9 | 13);
            let expected = address.wrapping_add(if counts { DEVICES } else { 0 });
            let datagram = frame::next(&bytes, None).unwrap();
            assert_eq!(datagram.adp(&bytes), expected, "command {code}");
            assert_eq!(datagram.ado(&bytes), BOTH);
        }
    }
    let bytes = bus
        .frame(
            FrameBuilder::default()
                .logical(12, 0x0102_0304, &[0])
                .build(),
        )
        .unwrap();
    let datagram = frame::next(&bytes, None).unwrap();
    assert_eq!(datagram.logical(&bytes), 0x0102_0304);
}

#[test]
fn undefined_commands_pass_unchanged() {
    let mut bus = terminals();
    for code in [0, 15, 16, 0x80, 0xff] {
        let request = FrameBuilder::default()
            .datagram(code, 0, BOTH, &[1, 2, 3])
            .build();
        let mut expected = request.clone();
        expected[6] |= 0x02;
        assert_eq!(bus.frame(request).unwrap(), expected, "command {code}");
    }
}

#[test]
fn datagram_counts_with_one_accessible_byte() {
    let mut bus = terminals();
    // (address, length, reads, writes): across the ends of registers, SyncManagers and memory.
    let rows = [
        (0x0008, 4, 1, 0),
        (0x000a, 4, 0, 0),
        (0x03fe, 4, 1, 1),
        (0x0130, 6, 1, 0),
        (0x0132, 2, 0, 0),
        (0x0eff, 2, 1, 1),
        (WRITE_ONLY, 6, 1, 1),
        (WRITE_ONLY, 2, 0, 1),
        (READ_ONLY, 2, 1, 0),
        (READ_ONLY, 6, 1, 1),
        (0x13ff, 2, 1, 1),
        (0x1400, 2, 0, 0),
        (0xffff, 1, 0, 0),
    ];
    for (ado, len, reads, writes) in rows {
        let zeros = vec![0; len];
        let counters = [4, 5].map(|code| bus.datagram(code, 0x1001, ado, &zeros).1);
        assert_eq!(counters, [reads, writes], "0x{ado:04x}, {len} bytes");
    }
}

#[test]
fn inaccessible_bytes_stay_unchanged() {
    let mut bus = terminals();
    // The outputs are not readable, the RAM behind them is.
    bus.write(0x1001, 0x1006, &[5, 6]);
    let (data, wkc) = bus.datagram(4, 0x1001, WRITE_ONLY, &[0xee; 8]);
    assert_eq!(
        (&data[..2], &data[6..], wkc),
        (&[0xee; 2][..], &[5, 6][..], 1)
    );
}

#[test]
fn registers_change_at_the_end_of_the_frame() {
    let mut bus = terminals();
    let bytes = bus
        .frame(
            FrameBuilder::default()
                .datagram(5, 0x1001, 0x10, &[0x05, 0x20])
                .datagram(4, 0x2005, 0, &[0])
                .datagram(4, 0x1001, 0x10, &[0, 0])
                .build(),
        )
        .unwrap();
    let mut counters = Vec::new();
    let mut at = frame::next(&bytes, None);
    while let Some(datagram) = at {
        counters.push(datagram.wkc(&bytes));
        at = frame::next(&bytes, Some(&datagram));
    }
    assert_eq!(
        counters,
        [1, 0, 1],
        "the new address counts from the next frame on"
    );
    assert_eq!(bus.read_u16(0x2005, 0x10), 0x2005);
}
