//! Messages by the tables of ETG.1000.6 clause 5.7, fragments with every flaw, and properties.

use proptest::prelude::*;

use super::*;

fn emitted(message: &Message<'_>, mailbox: u16) -> Vec<u8> {
    let mut out = vec![0xa5; 7];
    message.emit(3, mailbox, &mut out);
    assert_eq!(out.len(), usize::from(mailbox));
    out
}

fn named(text: &[u8]) -> [u8; NAME] {
    let mut name = [0; NAME];
    name[..text.len()].copy_from_slice(text);
    name
}

fn every_parameter() -> IpParameters {
    IpParameters {
        mac: Some([0x02, 0, 0, 0, 0x10, 1]),
        ip: Some(Ipv4Addr::new(192, 168, 7, 11)),
        netmask: Some(Ipv4Addr::new(255, 255, 255, 0)),
        gateway: Some(Ipv4Addr::new(192, 168, 7, 1)),
        dns: Some(Ipv4Addr::UNSPECIFIED),
        name: Some(named(b"x")),
    }
}

/// Type, last fragment, result or frame number at their places: one row per frame type.
#[test]
fn headers_have_the_bits_of_the_standard() {
    let fragment = Fragment {
        frame: 5,
        number: 3,
        units: 9,
        last: true,
        time: Some(0x0403_0201),
        time_requested: true,
        data: &[0xee; 3],
    };
    let parameters = IpParameters::default();
    let filter = MacFilter::default();
    let rows = [
        (Service::Fragment(fragment), 0x0700, 0x5243, 4 + 3 + 4),
        (Service::TimeStamp { frame: 9, time: 7 }, 0x0101, 0x9000, 8),
        (Service::SetIp(parameters), 0x0102, 0, 8),
        (Service::SetIpResponse(0x0201), 0x0103, 0x0201, 4),
        (Service::SetFilter(filter.clone()), 0x0104, 0, 4 + 122),
        (Service::SetFilterResponse(0x0401), 0x0105, 0x0401, 4),
        (Service::GetIp, 0x0106, 0, 4),
        (
            Service::GetIpResponse {
                result: 0,
                parameters,
            },
            0x0107,
            0,
            8,
        ),
        (Service::GetFilter, 0x0108, 0, 4),
        (
            Service::GetFilterResponse { result: 0, filter },
            0x0109,
            0,
            4 + 122,
        ),
    ];
    for (service, first, second, length) in rows {
        let message = Message { port: 2, service };
        let bytes = emitted(&message, 160);
        let word = |at: usize| u16::from_le_bytes([bytes[at], bytes[at + 1]]);
        assert_eq!(
            (word(0), word(6), word(8)),
            (length, first | 0x20, second),
            "{message:?}"
        );
        assert_eq!(bytes[5], 0x32, "type and counter");
        assert_eq!(Message::parse(&bytes), Ok(message));
    }
}

#[test]
fn ip_parameters_are_little_endian_in_their_order() {
    let service = Service::SetIp(every_parameter());
    let bytes = emitted(&service.into(), 128);
    assert_eq!(usize::from(bytes[0]), 4 + 58);
    assert_eq!(bytes[10..14], [0x3f, 0, 0, 0]);
    assert_eq!(bytes[14..20], [0x02, 0, 0, 0, 0x10, 1]);
    assert_eq!(bytes[20..24], [11, 7, 168, 192]);
    assert_eq!(bytes[24..28], [0, 255, 255, 255]);
    assert_eq!(bytes[28..32], [1, 7, 168, 192]);
    assert_eq!(bytes[36..38], [b'x', 0]);
}

/// Devices may answer with parameters at fixed places, or only with those that they have.
#[test]
fn ip_parameters_are_read_at_fixed_places_and_in_sequence() {
    let gateway = Ipv4Addr::new(10, 0, 0, 1);
    let only = IpParameters {
        gateway: Some(gateway),
        name: Some(named(b"drive")),
        ..IpParameters::default()
    };
    let mut fixed = vec![0x28, 0, 0, 0];
    fixed.extend([0; 6 + 8]);
    fixed.extend([1, 0, 0, 10, 0, 0, 0, 0]);
    fixed.extend(named(b"drive"));
    let mut sequence = vec![0x28, 0, 0, 0, 1, 0, 0, 10];
    sequence.extend(named(b"drive"));
    let mut short_name = vec![0x28, 0, 0, 0, 1, 0, 0, 10];
    short_name.extend(b"drive");
    for body in [&fixed, &sequence, &short_name] {
        assert_eq!(IpParameters::parse(body), Ok(only), "{body:02x?}");
    }
    for length in 0..8 {
        assert!(IpParameters::parse(&sequence[..length]).is_err());
    }
}

#[test]
fn refusals_and_other_protocols_are_no_eoe() {
    let mut bytes = vec![4, 0, 0, 0, 0, 0, 1, 0, 2, 0];
    let refused = Message::from(Service::Refused(2));
    assert_eq!(Message::parse(&bytes), Ok(refused));
    bytes[5] = 3;
    assert_eq!(Message::parse(&bytes), Ok(Service::Other.into()));
    let unknown = [4, 0, 0, 0, 0, 2, 0x1b, 0, 0, 0];
    let message = Message {
        port: 1,
        service: Service::Unknown(11),
    };
    assert_eq!(Message::parse(&unknown), Ok(message));
    for length in 0..4 {
        let mut short = vec![length, 0, 0, 0, 0, 2];
        short.resize(usize::from(6 + length), 0);
        assert!(Message::parse(&short).is_err());
    }
    // A refusal without parameters.
    let refusal = [4, 0, 0, 0, 0, 2, 7, 1, 1, 2];
    let service = Service::GetIpResponse {
        result: 0x0201,
        parameters: IpParameters::default(),
    };
    assert_eq!(Message::parse(&refusal), Ok(service.into()));
    assert!(result_text(0x0201).contains("IP"));
}

fn fragments(frame: &[u8], number: u8, mailbox: u16) -> Vec<Fragment<'_>> {
    Fragments::new(frame, number, mailbox).collect()
}

#[test]
fn fragments_are_multiples_of_32_bytes() {
    let frame = [7; 250];
    // 118 bytes fit, of which three units are used.
    let all = fragments(&frame, 18, 128);
    let seen: Vec<_> = all
        .iter()
        .map(|f| (f.frame, f.number, f.units, f.last, f.data.len()))
        .collect();
    assert_eq!(
        seen,
        [
            (2, 0, 8, false, 96),
            (2, 1, 3, false, 96),
            (2, 2, 6, true, 58)
        ]
    );
    // The last fragment may use the whole mailbox.
    assert_eq!(fragments(&frame[..118], 0, 128).len(), 1);
    assert_eq!(fragments(&frame[..119], 0, 128).len(), 2);
    assert_eq!(fragments(&[0; MAX_FRAME], 0, 42).len(), 48);
    for (length, mailbox) in [(200, 41), (13, 128), (MAX_FRAME + 1, 1486), (0, 128)] {
        assert!(fragments(&vec![0; length], 0, mailbox).is_empty());
    }
}

#[test]
fn flaws_are_counted_and_the_next_frame_passes() {
    let (old, new) = ([1; 330], [2; 330]);
    let (first, second) = (fragments(&old, 1, 128), fragments(&new, 2, 128));
    assert_eq!(first.len(), 4);
    let none = ReassemblyCounters::default();
    let wrong = |change: &dyn Fn(&mut Fragment<'_>)| {
        let mut fragment = first[1];
        change(&mut fragment);
        fragment
    };
    let rows: [(&str, Vec<Fragment<'_>>, ReassemblyCounters); 10] = [
        ("gap", vec![first[0], first[2], first[3]], {
            // What follows a gap has no beginning.
            ReassemblyCounters { gaps: 2, ..none }
        }),
        ("without a beginning", vec![first[1]], {
            ReassemblyCounters { gaps: 1, ..none }
        }),
        ("repeated", vec![first[0], first[1], first[1], first[0]], {
            ReassemblyCounters {
                repeats: 2,
                interrupted: 1,
                ..none
            }
        }),
        ("interrupted", vec![first[0], first[1]], {
            ReassemblyCounters {
                interrupted: 1,
                ..none
            }
        }),
        (
            "of another frame",
            vec![first[0], wrong(&|f| f.frame = 9)],
            ReassemblyCounters {
                interrupted: 1,
                ..none
            },
        ),
        (
            "another offset",
            vec![first[0], wrong(&|f| f.units += 1)],
            ReassemblyCounters {
                malformed: 1,
                ..none
            },
        ),
        (
            "a part of a unit",
            vec![first[0], wrong(&|f| f.data = &f.data[1..])],
            ReassemblyCounters {
                malformed: 1,
                ..none
            },
        ),
        (
            "empty",
            vec![first[0], wrong(&|f| f.data = &[])],
            ReassemblyCounters {
                malformed: 1,
                ..none
            },
        ),
        (
            "longer than announced",
            vec![
                Fragment {
                    units: 3,
                    ..first[0]
                },
                first[1],
            ],
            ReassemblyCounters {
                malformed: 1,
                ..none
            },
        ),
        (
            "too long",
            vec![Fragment {
                units: 49,
                ..first[0]
            }],
            ReassemblyCounters {
                malformed: 1,
                ..none
            },
        ),
    ];
    for (what, flawed, mut expected) in rows {
        let mut reassembler = Reassembler::default();
        for fragment in &flawed {
            assert_eq!(reassembler.add(fragment), None, "{what}");
        }
        let mut complete = None;
        for fragment in &second {
            complete = reassembler.add(fragment).map(<[u8]>::to_vec);
        }
        assert_eq!(complete.as_deref(), Some(&new[..]), "{what}");
        expected.frames = 1;
        assert_eq!(reassembler.counters(), expected, "{what}");
    }
}

#[test]
fn a_time_stamp_is_no_part_of_the_frame() {
    let frame = [3; 100];
    let [first, mut last] = fragments(&frame, 1, 96)[..] else {
        panic!("two fragments");
    };
    last.time = Some(42);
    let bytes = emitted(&Service::Fragment(last).into(), 96);
    let Ok(Message {
        service: Service::Fragment(parsed),
        ..
    }) = Message::parse(&bytes)
    else {
        panic!("{bytes:02x?}");
    };
    let mut reassembler = Reassembler::default();
    assert_eq!(reassembler.add(&first), None);
    assert_eq!(reassembler.add(&parsed), Some(&frame[..]));
    assert_eq!(parsed.time, Some(42));
    reassembler.reset();
    assert_eq!(reassembler.counters().interrupted, 0);
    reassembler.add(&first);
    reassembler.reset();
    assert_eq!(reassembler.counters().interrupted, 1);
}

/// A generator of damage: xorshift, so that a million fragments take a second.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    fn below(&mut self, bound: usize) -> usize {
        usize::try_from(self.next() % bound as u64).unwrap()
    }
}

/// Mailboxes with changed bytes and lengths neither panic nor grow the buffer, and frames without
/// damage still arrive.
#[test]
fn a_million_damaged_fragments() {
    let mut random = Random(0x2545_f491_4f6c_dd1d);
    let mut reassembler = Reassembler::default();
    let (mut done, mut intact, mut bytes) = (0, 0_u64, Vec::new());
    let mut frame = vec![0; MAX_FRAME];
    let mut number = 0_u8;
    while done < 1_000_000 {
        let length = MIN_FRAME + random.below(MAX_FRAME - MIN_FRAME + 1);
        frame[0] = number;
        number = number.wrapping_add(1);
        let spoil = random.below(4) != 0;
        let mut complete = false;
        for fragment in Fragments::new(&frame[..length], number, 128) {
            Message::from(Service::Fragment(fragment)).emit(1, 128, &mut bytes);
            if spoil && random.below(4) == 0 {
                for _ in 0..=random.below(3) {
                    let at = random.below(16);
                    bytes[at] ^= 1 << random.below(8);
                }
                bytes.truncate(random.below(bytes.len() + 1));
            }
            done += 1;
            if let Ok(message) = Message::parse(&bytes)
                && let Service::Fragment(fragment) = message.service
            {
                let frame = reassembler.add(&fragment);
                assert!(frame.is_none_or(|f| (MIN_FRAME..=MAX_FRAME).contains(&f.len())));
                complete = frame.is_some_and(|f| f.len() == length);
            }
        }
        if !spoil {
            assert!(complete);
            intact += 1;
        }
    }
    let counters = reassembler.counters();
    assert!(counters.frames >= intact && intact > 1000, "{counters:?}");
    let each = [counters.gaps, counters.interrupted, counters.malformed];
    assert!(each.iter().all(|count| *count > 1000), "{counters:?}");
}

fn parameters() -> impl Strategy<Value = IpParameters> {
    let address = || proptest::option::of(any::<u32>().prop_map(Ipv4Addr::from_bits));
    let mac = proptest::option::of(any::<MacAddress>());
    let name = proptest::option::of(any::<[u8; NAME]>());
    let all = (mac, address(), address(), address(), address(), name);
    all.prop_map(|(mac, ip, netmask, gateway, dns, name)| IpParameters {
        mac,
        ip,
        netmask,
        gateway,
        dns,
        name,
    })
}

fn filter() -> impl Strategy<Value = MacFilter> {
    let addresses = |max| proptest::collection::vec(any::<MacAddress>(), 0..=max);
    let all = (
        addresses(MAX_FILTERS.0),
        addresses(MAX_FILTERS.1),
        any::<bool>(),
    );
    all.prop_map(|(filters, masks, no_broadcasts)| MacFilter {
        filters,
        masks,
        no_broadcasts,
    })
}

fn service() -> impl Strategy<Value = Service<'static>> {
    prop_oneof![
        (0..16_u8, any::<u32>()).prop_map(|(frame, time)| Service::TimeStamp { frame, time }),
        parameters().prop_map(Service::SetIp),
        any::<u16>().prop_map(Service::SetIpResponse),
        filter().prop_map(Service::SetFilter),
        any::<u16>().prop_map(Service::SetFilterResponse),
        Just(Service::GetIp),
        (any::<u16>(), parameters())
            .prop_map(|(result, parameters)| Service::GetIpResponse { result, parameters }),
        Just(Service::GetFilter),
        (any::<u16>(), filter())
            .prop_map(|(result, filter)| Service::GetFilterResponse { result, filter }),
    ]
}

proptest! {
    #[test]
    fn messages_survive_their_bytes(service in service(), port in 0..16_u8) {
        let message = Message { port, service };
        let bytes = emitted(&message, 200);
        prop_assert_eq!(Message::parse(&bytes), Ok(message));
    }

    #[test]
    fn frames_survive_their_fragments(
        frame in proptest::collection::vec(any::<u8>(), MIN_FRAME..=MAX_FRAME),
        number in any::<u8>(),
        mailbox in 42..=1486_u16,
    ) {
        let mut reassembler = Reassembler::default();
        let mut complete = None;
        for fragment in Fragments::new(&frame, number, mailbox) {
            prop_assert!(complete.is_none());
            let bytes = emitted(&Service::Fragment(fragment).into(), mailbox);
            let parsed = Message::parse(&bytes);
            let expected = Ok(Service::Fragment(fragment).into());
            prop_assert_eq!(&parsed, &expected);
            complete = reassembler.add(&fragment).map(<[u8]>::to_vec);
        }
        prop_assert_eq!(complete, Some(frame));
    }

    /// What is understood means the same after it is written and read again.
    #[test]
    fn any_bytes_are_parsed_or_rejected(
        mut bytes in proptest::collection::vec(any::<u8>(), 0..200),
        length in any::<Option<u8>>(),
        service in 0..10_u8,
    ) {
        let right = u8::try_from(bytes.len().saturating_sub(6)).unwrap();
        if let [low, high, _, _, _, kind, of, ..] = bytes.as_mut_slice() {
            (*low, *high, *kind, *of) = (length.unwrap_or(right), 0, 2, *of & 0xf0 | service);
        }
        let Ok(message) = Message::parse(&bytes) else { return Ok(()) };
        prop_assert!(!matches!(message.service, Service::Unknown(_)));
        if !matches!(message.service, Service::Other | Service::Refused(_)) {
            let again = emitted(&message, 300);
            prop_assert_eq!(Message::parse(&again), Ok(message));
        }
    }
}
