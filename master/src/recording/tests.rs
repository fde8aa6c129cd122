use super::frame::{Content, Encapsulation, content};
use super::*;

fn all(bytes: &[u8]) -> (Vec<Packet>, Vec<ReadIssue>) {
    let mut reader = Reader::new(bytes);
    let packets = std::iter::from_fn(|| reader.next()).collect();
    (packets, reader.remarks().to_vec())
}

fn number(big: bool, value: u32, out: &mut Vec<u8>) {
    out.extend(if big {
        value.to_be_bytes()
    } else {
        value.to_le_bytes()
    });
}

fn short(big: bool, value: u16, out: &mut Vec<u8>) {
    out.extend(if big {
        value.to_be_bytes()
    } else {
        value.to_le_bytes()
    });
}

fn pcap(big: bool, nanos: bool, packets: &[(u32, u32, Vec<u8>)]) -> Vec<u8> {
    let mut out = Vec::new();
    number(big, if nanos { 0xa1b2_3c4d } else { 0xa1b2_c3d4 }, &mut out);
    for word in [0x0002_0004, 0, 0, 65_535, 1] {
        number(big, word, &mut out);
    }
    for (seconds, fraction, data) in packets {
        let len = data.len() as u32;
        for word in [*seconds, *fraction, len, len] {
            number(big, word, &mut out);
        }
        out.extend(data);
    }
    out
}

fn block(big: bool, kind: u32, body: &[u8], out: &mut Vec<u8>) {
    let padded = body.len().next_multiple_of(4);
    let len = 12 + padded as u32;
    number(big, kind, out);
    number(big, len, out);
    out.extend(body);
    out.resize(out.len() + padded - body.len(), 0);
    number(big, len, out);
}

/// Returns a section with one interface per `if_tsresol`, and packets: interface, timestamp, data,
/// flags.
fn pcapng(big: bool, resolutions: &[Option<u8>], packets: &[(u32, u64, &[u8], u32)]) -> Vec<u8> {
    let mut out = Vec::new();
    let mut body = Vec::new();
    number(big, 0x1a2b_3c4d, &mut body);
    short(big, 1, &mut body);
    short(big, 0, &mut body);
    body.extend([0xff; 8]);
    block(big, pcapng::SECTION, &body, &mut out);
    for resolution in resolutions {
        let mut body = Vec::new();
        short(big, 1, &mut body);
        body.extend([0; 6]);
        if let Some(resolution) = resolution {
            short(big, 9, &mut body);
            short(big, 1, &mut body);
            body.extend([*resolution, 0, 0, 0]);
        }
        block(big, 1, &body, &mut out);
    }
    for (interface, stamp, data, flags) in packets {
        let mut body = Vec::new();
        for word in [
            *interface,
            (stamp >> 32) as u32,
            *stamp as u32,
            data.len() as u32,
            99,
        ] {
            number(big, word, &mut body);
        }
        body.extend(*data);
        body.resize(body.len().next_multiple_of(4), 0);
        short(big, 2, &mut body);
        short(big, 4, &mut body);
        number(big, *flags, &mut body);
        block(big, 6, &body, &mut out);
    }
    out
}

#[test]
fn pcap_supports_both_byte_orders_and_resolutions() {
    for (big, nanos) in [(false, false), (false, true), (true, false), (true, true)] {
        let file = pcap(
            big,
            nanos,
            &[(7, 123_456, vec![1; 60]), (8, 0, vec![2; 61])],
        );
        let (packets, remarks) = all(&file);
        assert_eq!(remarks, []);
        let unit = if nanos { 1 } else { 1_000 };
        let seen: Vec<_> = packets
            .iter()
            .map(|p| (p.number, p.at, p.data.len()))
            .collect();
        let at = 7_000_000_000 + 123_456 * unit;
        assert_eq!(seen, [(1, Some(at), 60), (2, Some(8_000_000_000), 61)]);
    }
}

#[test]
fn pcapng_returns_timestamps_interfaces_and_directions() {
    let two_to_minus_10 = 0x80 | 10;
    for big in [false, true] {
        let resolutions = [None, Some(9), Some(two_to_minus_10), Some(12), Some(127)];
        let packets: [(u32, u64, &[u8], u32); 7] = [
            (0, 5_000_001, &[1; 5], 0),
            (1, 1 << 40, &[2; 60], 1),
            (2, 3 * 1024 + 512, &[3; 61], 2),
            (3, 7_123_456_789_000, &[4; 62], 3),
            (4, 9, &[5; 63], 0),
            // An interface without a description.
            (9, 9, &[6; 64], 0),
            (1, 42, &[], 0),
        ];
        let (read, remarks) = all(&pcapng(big, &resolutions, &packets));
        assert_eq!(remarks, []);
        let at: Vec<_> = read.iter().map(|p| p.at.unwrap()).collect();
        assert_eq!(
            at,
            [
                5_000_001_000,
                1 << 40,
                3_500_000_000,
                7_123_456_789,
                0,
                0,
                42
            ]
        );
        let ways: Vec<_> = read.iter().take(4).map(|p| p.direction).collect();
        assert_eq!(
            ways,
            [None, Some(Direction::In), Some(Direction::Out), None]
        );
        assert!(read.iter().all(|p| p.original_len == 99));
        let data: Vec<_> = read.iter().map(|p| p.data.len()).collect();
        assert_eq!(data, [5, 60, 61, 62, 63, 64, 0]);
        assert_eq!((read[0].link_type, read[5].link_type), (1, u16::MAX));
    }
}

#[test]
fn pcapng_supports_both_byte_orders_in_one_file() {
    let mut file = pcapng(false, &[Some(9)], &[(0, 1, &[1; 20], 0)]);
    // A name resolution block, which is skipped.
    block(false, 4, &[0; 40], &mut file);
    file.extend(pcapng(true, &[Some(9)], &[(0, 2, &[2; 20], 0)]));
    let (packets, remarks) = all(&file);
    assert_eq!(remarks, []);
    let at: Vec<_> = packets.iter().map(|p| p.at).collect();
    assert_eq!(at, [Some(1), Some(2)]);
}

#[test]
fn reader_rejects_other_files() {
    for (file, what) in [
        (&b""[..], "an empty file"),
        (b"[bus]\nnic = \"sim\"\n", "a text file"),
        (b"\x1f\x8b\x08\x00", "gzip"),
        (b"PK\x03\x04", "zip"),
        (b"\x7fELF\x02\x01\x01\x00", "some other file"),
    ] {
        let (packets, remarks) = all(file);
        assert!(packets.is_empty());
        assert!(
            matches!(&remarks[..], [ReadIssue::Foreign(is)] if is.contains(what)),
            "{remarks:?}"
        );
    }
}

#[test]
fn reader_skips_damaged_data() {
    let packets: Vec<_> = (0..20).map(|n| (n, 0, vec![n as u8; 60])).collect();
    let mut old = pcap(false, true, &packets);
    // The length of the tenth packet.
    let at = 24 + 9 * 76 + 8;
    old[at..at + 4].fill(0xee);
    let new: Vec<_> = (0..20_u64).map(|n| (0, n, &[7; 60][..], 0)).collect();
    let mut new = pcapng(false, &[Some(9)], &new);
    // Blocks of 100 bytes.
    let at = new.len() - 5 * 100 - 4;
    // The second length of one block, the first of the next.
    new[at..at + 4].fill(0xee);
    let at = at - 5 * 100 - 92;
    new[at..at + 4].fill(0xee);
    for (file, kept, places) in [(old, 19, 1), (new, 18, 2)] {
        let (packets, remarks) = all(&file);
        assert_eq!(packets.len(), kept);
        let damaged =
            |r: &ReadIssue| matches!(r, ReadIssue::Damaged { skipped, .. } if *skipped < 200);
        assert_eq!(remarks.len(), places, "{remarks:?}");
        assert!(remarks.iter().all(damaged), "{remarks:?}");
    }
}

#[test]
fn reader_accepts_files_cut_at_any_byte() {
    let packets: Vec<_> = (0..6).map(|n| (n, 0, vec![n as u8; 40])).collect();
    let ng: Vec<_> = (0..6_u64).map(|n| (0, n, &[7; 40][..], 0)).collect();
    for file in [pcap(true, false, &packets), pcapng(false, &[None], &ng)] {
        let (whole, _) = all(&file);
        for end in 0..file.len() {
            let (read, remarks) = all(&file[..end]);
            assert_eq!(read, whole[..read.len()], "cut at {end}");
            assert!(remarks.len() <= 1, "{remarks:?}");
        }
    }
}

#[test]
fn read_error_becomes_an_issue() {
    struct Broken(Vec<u8>);
    impl Read for Broken {
        fn read(&mut self, to: &mut [u8]) -> io::Result<usize> {
            if self.0.is_empty() {
                return Err(io::Error::other("no such sector"));
            }
            let n = to.len().min(self.0.len());
            to[..n].copy_from_slice(&self.0[..n]);
            self.0.drain(..n);
            Ok(n)
        }
    }
    let mut reader = Reader::new(Broken(pcap(false, false, &[(1, 0, vec![0; 60])])));
    assert!(reader.peek().is_some() && reader.next().is_some() && reader.next().is_none());
    let remarks = reader.remarks();
    assert!(
        matches!(remarks, [ReadIssue::Unreadable { error, .. }] if error.contains("sector")),
        "{remarks:?}"
    );
}

/// One BRD of two bytes.
const ETHERCAT: [u8; 16] = [14, 0x10, 7, 0x33, 0, 0, 0x30, 0x01, 2, 0, 0, 0, 8, 0, 3, 0];

fn packet(link_type: u16, data: Vec<u8>) -> Packet {
    Packet {
        number: 1,
        at: Some(5),
        interface: 0,
        link_type,
        direction: None,
        original_len: data.len(),
        data,
    }
}

fn ethernet(between: &[u8], payload: &[u8]) -> Vec<u8> {
    [
        &[0xff; 6][..],
        &[0x12, 0x10, 0x10, 0x10, 0x10, 0x10],
        between,
        payload,
    ]
    .concat()
}

fn ipv4(protocol: u8, port: u16, fragment: u16) -> Vec<u8> {
    let mut ip = vec![0x08, 0x00, 0x46, 0, 0, 60, 0, 0];
    ip.extend(fragment.to_be_bytes());
    ip.extend([64, protocol, 0, 0]);
    ip.extend([0; 8]);
    // One word of options.
    ip.extend([0; 4]);
    ip.extend(1_u16.to_be_bytes());
    ip.extend(port.to_be_bytes());
    ip.extend([0; 4]);
    ip
}

#[test]
fn content_finds_ethercat_in_any_encapsulation() {
    let sll = |protocol: &[u8]| {
        [
            &[0, 4, 0, 1, 0, 6, 0x12, 1, 1, 1, 1, 1, 0, 0][..],
            protocol,
            &ETHERCAT,
        ]
        .concat()
    };
    let sll2 = [
        &[
            0x88, 0xa4, 0, 0, 0, 0, 0, 1, 0, 1, 0, 6, 0x12, 1, 1, 1, 1, 1, 0, 0,
        ][..],
        &ETHERCAT,
    ]
    .concat();
    let padded = [&ETHERCAT[..], &[0; 28]].concat();
    for (link, bytes, carrier) in [
        (1, ethernet(&[0x88, 0xa4], &padded), Encapsulation::Ethernet),
        (
            1,
            ethernet(&[0x81, 0, 0x20, 5, 0x88, 0xa4], &ETHERCAT),
            Encapsulation::Vlan(5),
        ),
        (
            1,
            ethernet(&[0x88, 0xa8, 0, 9, 0x81, 0, 0, 7, 0x88, 0xa4], &ETHERCAT),
            Encapsulation::Vlan(7),
        ),
        (
            1,
            ethernet(&ipv4(17, 0x88a4, 0), &ETHERCAT),
            Encapsulation::Udp,
        ),
        (113, sll(&[0x88, 0xa4]), Encapsulation::Ethernet),
        (276, sll2, Encapsulation::Ethernet),
    ] {
        let whole = bytes.len();
        let Content::Frame(frame) = content(packet(link, bytes.clone())) else {
            panic!("{carrier:?} is EtherCAT");
        };
        assert_eq!(
            (frame.carrier, frame.source[0], frame.cut),
            (carrier, 0x12, false)
        );
        let [datagram] = &frame.datagrams[..] else {
            panic!("{frame:?}");
        };
        assert_eq!((datagram.command.name(), datagram.index), ("BRD", 0x33));
        assert_eq!(
            (datagram.adp(), datagram.ado(), datagram.wkc),
            (0, 0x0130, 3)
        );
        assert_eq!(frame.data(datagram), [8, 0]);
        let sent = (link != 1).then_some(if link == 113 {
            Direction::Out
        } else {
            Direction::In
        });
        assert_eq!(frame.direction, sent);
        // A cut packet has fewer datagrams and never panics.
        for end in 0..whole {
            match content(packet(link, bytes[..end].to_vec())) {
                Content::Frame(frame) => assert!(frame.cut || end >= whole - 28),
                Content::Other => {}
                Content::OtherEthercat(kind) => panic!("type {kind}"),
            }
        }
    }
}

#[test]
fn content_ignores_other_protocols() {
    let gateway = [&[4, 0x50][..], &[0; 40]].concat();
    for (link, bytes) in [
        (1, ethernet(&[0x08, 0x06], &ETHERCAT)),
        (1, ethernet(&ipv4(6, 0x88a4, 0), &ETHERCAT)),
        (1, ethernet(&ipv4(17, 53, 0), &ETHERCAT)),
        (1, ethernet(&ipv4(17, 0x88a4, 100), &ETHERCAT)),
        (101, ethernet(&[0x88, 0xa4], &ETHERCAT)),
        (1, vec![0x88, 0xa4]),
    ] {
        assert_eq!(content(packet(link, bytes)), Content::Other);
    }
    let other = content(packet(1, ethernet(&[0x88, 0xa4], &gateway)));
    assert_eq!(other, Content::OtherEthercat(5));
}
