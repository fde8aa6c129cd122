use alloc::format;
use alloc::string::ToString;
use alloc::vec::Vec;

use proptest::prelude::*;

use super::super::{Encode, error_body};
use super::*;

fn emitted(telegram: &Telegram<'_>, counter: u8) -> Vec<u8> {
    let mut out = alloc::vec![0xa5; 9];
    telegram.emit(counter, 128, &mut out);
    out
}

/// The bytes that SOEM (`ecx_SoEread`, `ecx_SoEwrite`) and TwinCAT (its start-up list) send.
#[test]
fn requests_match_those_of_other_main_devices() {
    let read = Telegram::read_request(0, Element::Value, Idn(15));
    assert_eq!(
        emitted(&read, 1)[..10],
        [4, 0, 0, 0, 0, 0x15, 1, 0x40, 15, 0]
    );
    let list = [2, 0, 2, 0, 0x33, 0];
    let write = Telegram {
        operation: Operation::WriteRequest,
        incomplete: false,
        error: false,
        drive: 1,
        elements: Element::Value.bit(),
        idn_or_left: 16,
        data: &list,
    };
    let bytes = emitted(&write, 2);
    assert_eq!(bytes[..6], [10, 0, 0, 0, 0, 0x25]);
    assert_eq!(bytes[6..16], [0x23, 0x40, 16, 0, 2, 0, 2, 0, 0x33, 0]);
}

#[test]
fn a_fragment_has_no_idn() {
    let mut bytes = emitted(&Telegram::read_request(7, Element::Name, Idn(3)), 1);
    bytes[6] |= INCOMPLETE;
    let Ok(Message::Telegram(part)) = Message::parse(&bytes) else {
        panic!("a telegram")
    };
    assert_eq!((part.drive, part.idn(), part.left()), (7, None, 3));
}

#[test]
fn the_error_code_is_the_last_word() {
    let message = |data: &'static [u8]| Telegram {
        operation: Operation::ReadResponse,
        incomplete: false,
        error: true,
        drive: 0,
        elements: 0x40,
        idn_or_left: 47,
        data,
    };
    assert_eq!(message(&[1, 0x10]).error_code(), Some(0x1001));
    assert_eq!(message(&[9, 9, 9, 9, 4, 0x70]).error_code(), Some(0x7004));
    let short = emitted(&message(&[1]), 1);
    assert!(Message::parse(&short).is_err());
    let refused = [&[4, 0, 0, 0, 0, 0x10][..], &error_body(2)].concat();
    assert_eq!(Message::parse(&refused), Ok(Message::Refused(2)));
}

/// ETG.1000.6: every code has a text of its own; codes are sorted.
#[test]
fn every_error_code_has_a_text() {
    assert_eq!(ERROR_CODES.len(), 54);
    for pair in ERROR_CODES.windows(2) {
        assert!(pair[0].0 < pair[1].0, "{pair:x?}");
    }
    for (n, (code, text)) in ERROR_CODES.iter().enumerate() {
        assert_eq!(soe_error_text(*code), *text);
        assert!(
            ERROR_CODES[..n].iter().all(|(_, other)| other != text),
            "{text}"
        );
    }
    assert_eq!(soe_error_text(0xc001), "unknown SoE error code");
}

#[test]
fn idns_are_texts_and_back() {
    for (number, text) in [
        (0, "S-0-0000"),
        (47, "S-0-0047"),
        (0x0fff, "S-0-4095"),
        (0x1064, "S-1-0100"),
        (0x8096, "P-0-0150"),
        (0x800a, "P-0-0010"),
        (0xffff, "P-7-4095"),
    ] {
        assert_eq!(Idn(number).to_string(), text);
        assert_eq!(text.parse(), Ok(Idn(number)));
    }
    assert_eq!("s-0-47".parse(), Ok(Idn(47)));
    for wrong in [
        "",
        "S",
        "S-0",
        "S-8-0001",
        "S-0-4096",
        "S-0-00001",
        "T-0-0001",
        "S-0-1-1",
        "S-0--1",
        "S-0-+1",
        "47",
    ] {
        assert_eq!(wrong.parse::<Idn>(), Err(IdnError), "{wrong}");
    }
    for number in 0..=u16::MAX {
        assert_eq!(Idn(number).to_string().parse(), Ok(Idn(number)));
    }
}

#[test]
fn names_are_sorted_and_those_of_all_parameter_sets() {
    for pair in IDN_NAMES.windows(2) {
        assert!(pair[0].0 < pair[1].0, "{pair:?}");
    }
    assert_eq!(Idn(0x3064).name(), Idn(100).name());
    assert_eq!(Idn(0x8064).name(), None);
    assert_eq!(
        Idn(134).named().to_string(),
        "S-0-0134 (Master control word)"
    );
    assert_eq!(Idn(0x8096).named().to_string(), "P-0-0150");
}

#[test]
fn attribute_bits_row_by_row() {
    use DataLength::{Fixed, List, Reserved};
    for (code, length) in [
        (0, Reserved),
        (1, Fixed(2)),
        (2, Fixed(4)),
        (3, Fixed(8)),
        (4, List(1)),
        (5, List(2)),
        (6, List(4)),
        (7, List(8)),
    ] {
        assert_eq!(Attribute(code << 16).length(), length);
        let new = Attribute::new(length, Display::Time);
        assert_eq!((new.length(), new.display()), (length, Display::Time));
    }
    use Display as D;
    let displays = [
        D::Binary,
        D::Unsigned,
        D::Signed,
        D::Hexadecimal,
        D::Text,
        D::Idn,
        D::Float,
        D::Time,
    ];
    for (code, display) in (0..).zip(displays) {
        assert_eq!(Attribute(code << 20).display(), display);
    }
    assert!(Attribute(1 << 19).is_command());
    assert_eq!(Attribute(0x0500_1234).decimals(), 5);
    assert_eq!(Attribute(0x0500_1234).factor(), 0x1234);
    for bit in 0..3 {
        let mut expected = [false; 3];
        expected[bit] = true;
        assert_eq!(Attribute(1 << (28 + bit)).write_protection(), expected);
    }
    assert_eq!(
        Attribute(0x7322_0001).to_string(),
        "4 bytes, signed, 3 decimals, read-only"
    );
    assert_eq!(
        Attribute(0x0009_0001).to_string(),
        "2 bytes, binary, procedure command"
    );
}

#[test]
fn data_states_row_by_row() {
    use CommandState::*;
    for (bits, state) in [
        (0x0, Cleared),
        (0x1, Interrupted),
        (0x3, Executed),
        (0x5, Interrupted),
        (0x7, Running),
        (0xf, Failed),
        (0xb, Failed),
    ] {
        assert_eq!(DataState(bits).command(), state);
        assert!(DataState(bits).is_valid());
    }
    assert!(!DataState(0x100).is_valid());
}

#[test]
fn values_are_shown_and_read_by_attribute() {
    let fixed = |width, display, decimals: u32| {
        Attribute(Attribute::new(DataLength::Fixed(width), display).0 | decimals << 24)
    };
    let list = |width, display| Attribute::new(DataLength::List(width), display);
    for (attribute, bytes, text) in [
        (fixed(2, Display::Unsigned, 0), &[0xd0, 7][..], "2000"),
        (fixed(2, Display::Unsigned, 3), &[0xd0, 7], "2.000"),
        (
            fixed(4, Display::Signed, 4),
            &[0xff, 0xff, 0xff, 0xff],
            "-0.0001",
        ),
        (
            fixed(4, Display::Signed, 0),
            &[0, 0, 0, 0x80],
            "-2147483648",
        ),
        (
            fixed(2, Display::Binary, 0),
            &[0x0b, 0],
            "0b0000000000001011",
        ),
        (
            fixed(4, Display::Hexadecimal, 0),
            &[1, 0, 0, 0xc0],
            "0xc0000001",
        ),
        (fixed(2, Display::Idn, 0), &[47, 0x80], "P-0-0047"),
        (fixed(4, Display::Float, 0), &[0, 0, 0xc0, 0x3f], "1.5"),
        (
            list(2, Display::Idn),
            &[4, 0, 8, 0, 51, 0, 189, 0],
            "S-0-0051, S-0-0189",
        ),
        (list(1, Display::Text), b"\x03\0\x10\0mm\n", "mm"),
        (list(4, Display::Signed), &[0, 0, 8, 0], ""),
    ] {
        assert_eq!(format_value(attribute, bytes), text);
    }
    // Lengths that contradict the attribute.
    assert_eq!(
        format_value(fixed(4, Display::Signed, 0), &[1, 2]),
        "[01 02]"
    );
    assert_eq!(
        format_value(list(2, Display::Idn), &[3, 0, 3, 0, 1, 2, 3]),
        "[03 00 03 00 01 02 03]"
    );
    for (attribute, text, bytes) in [
        (fixed(2, Display::Unsigned, 0), "2000", &[0xd0, 7][..]),
        (fixed(2, Display::Unsigned, 3), "2", &[0xd0, 7]),
        (fixed(4, Display::Signed, 4), "-0.0001", &[0xff; 4]),
        (fixed(2, Display::Binary, 0), "0b1011", &[0x0b, 0]),
        (fixed(2, Display::Signed, 0), "0xffff", &[0xff; 2]),
        (
            list(2, Display::Idn),
            "S-0-0051, P-0-0001",
            &[4, 0, 4, 0, 51, 0, 1, 0x80],
        ),
        (list(1, Display::Text), "mm", &[2, 0, 2, 0, b'm', b'm']),
    ] {
        assert_eq!(parse_value(attribute, text).as_deref(), Ok(bytes), "{text}");
    }
    let wrong = |attribute, text: &str| parse_value(attribute, text).expect_err(text).to_string();
    let word = fixed(2, Display::Unsigned, 1);
    assert_eq!(wrong(word, "7000"), "`7000` does not fit into 2 bytes");
    assert_eq!(wrong(word, "1.23"), "`1.23` is not a number");
    assert_eq!(wrong(word, "x"), "`x` is not a number");
    assert_eq!(
        wrong(list(2, Display::Idn), "S-9-1"),
        "`S-9-1` is not an IDN (S-0-0047)"
    );
    assert_eq!(
        wrong(Attribute(0), "1"),
        "the drive reports no length of the value"
    );
    let long = "1 ".repeat(9000);
    assert_eq!(
        wrong(list(8, Display::Unsigned), &long),
        "72000 bytes are more than a list holds (65535)"
    );
}

fn telegrams() -> impl Strategy<Value = (u8, bool, bool, u8, u8, u16, Vec<u8>)> {
    (
        1_u8..7,
        any::<bool>(),
        any::<bool>(),
        0_u8..8,
        any::<u8>(),
        any::<u16>(),
        prop::collection::vec(any::<u8>(), 2..100),
    )
}

proptest! {
    #[test]
    fn emitted_telegrams_are_parsed_again((operation, incomplete, error, drive, elements, idn, data) in telegrams(), counter in 1_u8..8) {
        let telegram = Telegram { operation: Operation::from_bits(operation), incomplete, error, drive, elements, idn_or_left: idn, data: &data };
        let bytes = emitted(&telegram, counter);
        prop_assert_eq!(bytes.len(), 128);
        prop_assert_eq!(Message::parse(&bytes), Ok(Message::Telegram(telegram)));
    }

    /// A value that is shown and read again is the same value.
    #[test]
    fn shown_values_are_read_again(raw: u64, length in 1_u32..8, display in 0_u32..7, decimals in 0_u32..16, elements in 0_usize..5) {
        let attribute = Attribute(length << 16 | display << 20 | decimals << 24);
        prop_assume!(!matches!(attribute.display(), Display::Text | Display::Float));
        let bytes = raw.to_le_bytes();
        let value = match attribute.length() {
            DataLength::Fixed(width) => bytes[..width].to_vec(),
            DataLength::List(width) => {
                let data = bytes[..width].repeat(elements);
                let max = u16::try_from(data.len()).unwrap();
                [&List { max, data: &data }.header()[..], &data].concat()
            }
            DataLength::Reserved => return Ok(()),
        };
        let text = format_value(attribute, &value);
        prop_assert_eq!(parse_value(attribute, &text), Ok(value), "{}", text);
    }

    #[test]
    fn reading_any_text_or_bytes_never_panics(attribute: u32, text in ".{0,40}", bytes in prop::collection::vec(any::<u8>(), 0..40)) {
        let _ = parse_value(Attribute(attribute), &text);
        let _ = format_value(Attribute(attribute), &bytes);
        let _ = format!("{} {}", Attribute(attribute), text.parse::<Idn>().is_ok());
    }
}

/// A million telegrams with flipped, cut and inserted bytes.
#[test]
fn mutated_telegrams_never_panic() {
    let list = [4, 0, 8, 0, 51, 0, 189, 0];
    let base = [1, 2, 3, 4, 5, 6, 0, 7].map(|operation| {
        emitted(
            &Telegram {
                operation: Operation::from_bits(operation),
                incomplete: operation == 3,
                error: operation == 4,
                drive: 1,
                elements: 0x46,
                idn_or_left: 16,
                data: &list,
            },
            3,
        )
    });
    let mut random = 0x9e37_79b9_7f4a_7c15_u64;
    let mut next = move || {
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        random as usize
    };
    let mut parsed = 0_u32;
    for _ in 0..1_000_000 {
        let mut bytes = base[next() % base.len()].clone();
        bytes.truncate(next() % 40);
        for _ in 0..next() % 4 {
            let len = bytes.len();
            if let Some(byte) = bytes.get_mut(next() % len.max(1)) {
                *byte ^= 1 << (next() % 8);
            }
        }
        let Ok(Message::Telegram(telegram)) = Message::parse(&bytes) else {
            continue;
        };
        parsed += 1;
        let attribute = Attribute(next() as u32);
        let _ = format_value(attribute, telegram.data);
        let _ = List::split(telegram.data);
        let _ = (telegram.error_code(), telegram.idn(), telegram.left());
    }
    assert!(parsed > 100_000, "{parsed}");
}
