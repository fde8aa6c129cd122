//! Recorded messages of real devices and MainDevices: an EK1914 and an EL3004 with ethercrab, a
//! LAN9252 with SOEM.

use proptest::prelude::*;

use super::coe::{Answer, Message, Request};
use super::{Encode, foe};

/// The mailbox header and CoE message, without the padding of the mailbox.
fn emitted(request: &Request<'_>, counter: u8) -> Vec<u8> {
    let mut out = vec![0xa5; 7];
    request.emit(counter, 128, &mut out);
    assert_eq!(out.len(), 128);
    let (message, padding) = out.split_at(16);
    assert!(padding.iter().all(|byte| *byte == 0));
    message.to_vec()
}

fn bytes(hex: &str) -> Vec<u8> {
    let digits: Vec<char> = hex.chars().filter(|c| !c.is_whitespace()).collect();
    let pair = |p: &[char]| u8::from_str_radix(&p.iter().collect::<String>(), 16).unwrap();
    digits.chunks(2).map(pair).collect()
}

#[test]
fn requests_match_recordings_of_other_main_devices() {
    let up = |index, sub, complete| Request::Upload {
        index,
        sub,
        complete,
    };
    let down = |index, sub, data| Request::DownloadExpedited { index, sub, data };
    for (request, counter, recorded) in [
        (
            up(0x1008, 0, false),
            1,
            "0a0000000013 0020 4008100000000000",
        ),
        (
            up(0x1c13, 4, false),
            4,
            "0a0000000043 0020 40131c0400000000",
        ),
        (up(0x1c12, 0, true), 2, "0a0000000023 0020 50121c0000000000"),
        (
            down(0x1c12, 0, &[0]),
            1,
            "0a0000000013 0020 2f121c0000000000",
        ),
        (
            down(0x1c13, 1, &[0, 0x1a]),
            3,
            "0a0000000033 0020 2b131c01001a0000",
        ),
        (
            down(0xf008, 0, &[1, 0, 0, 0]),
            2,
            "0a0000000023 0020 2308f00001000000",
        ),
    ] {
        assert_eq!(emitted(&request, counter), bytes(recorded), "{request:?}");
        assert_eq!(Request::parse(&bytes(recorded)), Ok(Some(request)));
    }
}

#[test]
fn answers_of_real_devices_are_parsed() {
    let up = |index, sub, size, data| Answer::Upload {
        index,
        sub,
        size,
        data,
    };
    for (recorded, answer) in [
        (
            "100000000013 0030 4108100006000000 454b31393134",
            up(0x1008, 0, 6, &b"EK1914"[..]),
        ),
        (
            "0a0000000013 0030 4b0a100030380000",
            up(0x100a, 0, 2, b"08"),
        ),
        (
            "0a0000000033 0030 4308f00001000000",
            up(0xf008, 0, 4, &[1, 0, 0, 0]),
        ),
        ("0a0000000053 0030 4f131c0004000000", up(0x1c13, 0, 1, &[4])),
        // Complete access: subindex 0 in 16 bits, then the elements.
        (
            "100000000013 0030 51001c0006000000 040001020304",
            up(0x1c00, 0, 6, &[4, 0, 1, 2, 3, 4]),
        ),
        (
            "0a0000000023 0030 53121c0001000116",
            up(0x1c12, 0, 4, &[1, 0, 1, 0x16]),
        ),
        // The answer to an expedited download echoes its data.
        (
            "0a0000000033 0030 60131c01001a0000",
            Answer::Download {
                index: 0x1c13,
                sub: 1,
            },
        ),
    ] {
        let mut mailbox = bytes(recorded);
        mailbox.resize(128, 0xa5);
        assert_eq!(Message::parse(&mailbox), Ok(Message::Sdo(answer)));
    }
}

/// ETG.1000.6 clause 5.6.2.7: the command specifier is in bits 5 to 7; bits 0 to 4 of an abort are
/// reserved.
#[test]
fn aborts_with_reserved_bits_are_aborts_with_their_code() {
    for (service, reserved) in [0x20, 0x30]
        .into_iter()
        .flat_map(|service| (0..0x20).map(move |reserved| (service, reserved)))
    {
        let mut mailbox = bytes("0a0000000013 0000 80126008 11000906");
        mailbox[7] = service;
        mailbox[8] |= reserved;
        let abort = Answer::Abort {
            index: 0x6012,
            sub: 8,
            code: 0x0609_0011,
        };
        let parsed = Message::parse(&mailbox);
        assert_eq!(parsed, Ok(Message::Sdo(abort)), "{reserved:#x}");
    }
}

fn requests(data: &[u8], flags: (bool, bool), numbers: (u16, u8, u32)) -> Vec<Request<'_>> {
    let ((first, second), (index, sub, number)) = (flags, numbers);
    let short = data.get(..data.len().min(4)).unwrap_or_default();
    let mut all = vec![
        Request::Upload {
            index,
            sub,
            complete: first,
        },
        Request::UploadSegment { toggle: first },
        Request::Download {
            index,
            sub,
            complete: first,
            size: number,
            data,
        },
        Request::DownloadSegment {
            toggle: first,
            last: second,
            data,
        },
        Request::Abort {
            index,
            sub,
            code: number,
        },
        Request::Information {
            opcode: sub & 0x7f,
            body: data,
        },
    ];
    if !short.is_empty() {
        all.push(Request::DownloadExpedited {
            index,
            sub,
            data: short,
        });
    }
    all
}

proptest! {
    #[test]
    fn emitted_requests_are_parsed_again(
        data in prop::collection::vec(any::<u8>(), 0..40),
        flags: (bool, bool),
        numbers: (u16, u8, u32),
        counter in 0_u8..8,
    ) {
        let mut out = vec![0xa5; 5];
        for request in requests(&data, flags, numbers) {
            request.emit(counter, 64, &mut out);
            prop_assert_eq!(out.len(), 64);
            prop_assert_eq!(Request::parse(&out), Ok(Some(request)));
        }
        for message in [
            foe::Message::Read { password: numbers.2, name: &data },
            foe::Message::Write { password: numbers.2, name: &data },
            foe::Message::Data { packet: numbers.2, data: &data },
            foe::Message::Ack { packet: numbers.2 },
            foe::Message::Error { code: numbers.2, text: &data },
            foe::Message::Busy { done: numbers.0, entire: !numbers.0 },
        ] {
            message.emit(counter, 64, &mut out);
            prop_assert_eq!(foe::Message::parse(&out), Ok(message));
        }
    }

    #[test]
    fn parsing_never_panics(bytes in prop::collection::vec(any::<u8>(), 0..64), kind in 0_u8..8) {
        let mut bytes = bytes;
        if let Some(protocol) = bytes.get_mut(5) {
            *protocol = kind;
        }
        if let [low, high, ..] = bytes.as_mut_slice() {
            (*low, *high) = (*low % 64, 0);
        }
        let _ = (Request::parse(&bytes), Message::parse(&bytes), foe::Message::parse(&bytes));
    }
}
