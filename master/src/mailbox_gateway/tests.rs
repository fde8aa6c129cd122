//! Frames of clients without a bus: the objects of the MainDevice, and a million damaged frames.

use std::path::Path;
use std::pin::pin;
use std::task::{Context, Poll, Waker};

use ecaxis_ecat::index::{DeviceIndex, IndexVec};
use ecaxis_ecat::mailbox::coe::{Message, Request};
use ecaxis_ecat::mailbox::gateway::{FRAME_HEADER, MAX_FRAME, Telegram};
use ecaxis_ecat::mailbox::{Encode as _, HEADER, TYPE_COE, TYPE_FOE, TYPE_SOE};
use tokio::sync::watch;

use super::access::Access;
use super::client::Client;
use super::dictionary::Dictionary;
use super::live::{DeviceLive, Live};
use super::object::Object;
use super::server::next_frame;
use super::*;
use crate::config;
use crate::mailbox::{MailboxLayout, RawMessage};

const LAYOUT: MailboxLayout = MailboxLayout {
    station: 0x1000,
    out_address: 0x1000,
    out_len: 128,
    in_address: 0x1400,
    in_len: 128,
    out_sm: 0,
    in_sm: 1,
};

fn machine() -> Machine {
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs");
    config::load(&configs.join("terminals.toml")).unwrap()
}

/// Returns a gateway to no device, and what the cycle publishes.
fn gateway(write: bool) -> (Arc<Gateway>, watch::Sender<Live>) {
    let (sender, published) = watch::channel(Live::default());
    let (machine, mailboxes) = (machine(), Mailboxes::default());
    let (found, places) = (IndexVec::default(), IndexVec::default());
    let gateway = Gateway {
        access: Access::new(&machine, write, published.clone()),
        dictionary: Dictionary::new(&machine, &found, &places, &mailboxes, published),
        mailboxes,
    };
    (Arc::new(gateway), sender)
}

/// The MainDevice answers without waiting.
fn now<T>(future: impl Future<Output = T>) -> T {
    let mut context = Context::from_waker(Waker::noop());
    match pin!(future).poll(&mut context) {
        Poll::Ready(value) => value,
        Poll::Pending => panic!("it waits"),
    }
}

fn frame(station: u16, protocol: u8, body: &[u8]) -> Vec<u8> {
    let telegram = Telegram {
        station,
        channel: 0,
        protocol,
        counter: 3,
        body,
    };
    let mut frame = Vec::new();
    telegram.emit_frame(&mut frame);
    frame
}

fn sdo(request: &Request<'_>) -> Vec<u8> {
    let mut long = Vec::new();
    request.emit(0, 1400, &mut long);
    let length = usize::from(u16::from_le_bytes([long[0], long[1]]));
    frame(0, TYPE_COE, &long[HEADER..HEADER + length])
}

/// Returns the messages that answer a frame, as mailboxes.
fn ask(gateway: &Arc<Gateway>, frame: &[u8]) -> Vec<Vec<u8>> {
    let answers = now(Client::new(gateway).answer(frame));
    let answers = answers.into_iter().map(|answer| {
        assert!(answer.len() <= 1472, "a UDP datagram on Ethernet");
        assert_eq!(Telegram::parse(&answer).unwrap().counter, 3);
        answer[FRAME_HEADER..].to_vec()
    });
    answers.collect()
}

#[track_caller]
fn upload(gateway: &Arc<Gateway>, index: u16, sub: u8, complete: bool) -> Result<Vec<u8>, u32> {
    use ecaxis_ecat::mailbox::coe::Answer;
    let request = Request::Upload {
        index,
        sub,
        complete,
    };
    let answers = ask(gateway, &sdo(&request));
    let [answer] = &answers[..] else {
        panic!("{answers:?}")
    };
    match Message::parse(answer) {
        Ok(Message::Sdo(Answer::Upload { size, data, .. })) => {
            assert_eq!(size, data.len());
            Ok(data.to_vec())
        }
        Ok(Message::Sdo(Answer::Abort { code, .. })) => Err(code),
        other => panic!("{other:?}"),
    }
}

/// Returns the data of all fragments, or the abort code.
fn describe(gateway: &Arc<Gateway>, opcode: u8, body: &[u8]) -> Result<Vec<u8>, u32> {
    let answers = ask(gateway, &sdo(&Request::Information { opcode, body }));
    let mut data = Vec::new();
    let mut left = answers.len();
    for answer in &answers {
        let Ok(Message::Information(part)) = Message::parse(answer) else {
            panic!("{answer:?}")
        };
        left -= 1;
        assert_eq!(usize::from(part.left), left);
        if part.opcode == 7 {
            return Err(u32::from_le_bytes(part.data.try_into().unwrap()));
        }
        assert_eq!(part.opcode, opcode + 1);
        data.extend(part.data);
    }
    Ok(data)
}

#[test]
fn every_listed_object_has_a_description_and_the_described_values() {
    let (gateway, sender) = gateway(false);
    sender.send_modify(|live| live.devices = vec![DeviceLive::default(); 6]);
    let list = describe(&gateway, 1, &[1, 0]).unwrap();
    let indices: Vec<u16> = list[2..]
        .chunks(2)
        .map(|index| u16::from_le_bytes([index[0], index[1]]))
        .collect();
    // Six devices in three groups, five objects of the MainDevice, and 0xF002, 0xF020, 0xF120.
    assert_eq!(indices.len(), 3 * 6 + 5 + 3, "{indices:04x?}");
    assert!(indices.is_sorted());
    let lengths = describe(&gateway, 1, &[0, 0]).unwrap();
    assert_eq!(lengths[2..4], u16::to_le_bytes(26));
    for index in indices {
        let [low, high] = index.to_le_bytes();
        let object = describe(&gateway, 3, &[low, high]).unwrap();
        let (max_sub, code) = (object[4], object[5]);
        let mut complete = Vec::new();
        for sub in 0..=max_sub {
            let entry = describe(&gateway, 5, &[low, high, sub, 7]);
            let value = upload(&gateway, index, sub, false);
            let Ok(entry) = entry else {
                assert_eq!((entry, value), (Err(0x0609_0011), Err(0x0609_0011)));
                continue;
            };
            let (value, bits) = (value.unwrap(), u16::from_le_bytes([entry[6], entry[7]]));
            assert_eq!(value.len() * 8, usize::from(bits), "{index:#x}:{sub}");
            if complete.len() % 2 != 0 && (value.len() > 1 || sub == 1) {
                complete.push(0);
            }
            complete.extend(value);
        }
        let whole = upload(&gateway, index, 0, true);
        match code {
            7 => assert_eq!(whole, Err(0x0601_0000)),
            _ => assert_eq!(whole, Ok(complete), "{index:#x}"),
        }
    }
    assert_eq!(upload(&gateway, 0x8006, 1, false), Err(0x0602_0000));
    assert_eq!(describe(&gateway, 3, &[6, 0x80]), Err(0x0602_0000));
    assert_eq!(upload(&gateway, 0x8000, 2, true), Err(0x0601_0000));
    // CiA 402 behind five terminals; the name of the machine file.
    let device_type = upload(&gateway, 0x8005, 4, false).unwrap();
    assert_eq!(device_type, 0x0002_0192_u32.to_le_bytes());
    assert_eq!(upload(&gateway, 0x8005, 3, false).unwrap()[..2], *b"x\0");
    assert_eq!(
        upload(&gateway, 0xa005, 1, false).unwrap(),
        0_u16.to_le_bytes()
    );
}

#[test]
fn long_lists_come_in_fragments_and_texts_end_at_a_character() {
    struct Many;
    impl object::Objects for Many {
        fn indices(&self) -> Vec<u16> {
            (0..1600).collect()
        }
        fn object(&self, _: u16) -> Option<Object> {
            None
        }
    }
    let parts = object::information(&Many, 1, &[1, 0]);
    assert_eq!(parts.len(), 3);
    let left: Vec<u8> = parts.iter().map(|part| part.body[4]).collect();
    assert_eq!(left, [2, 1, 0]);
    let length: usize = parts.iter().map(|part| part.body.len() - 6).sum();
    assert_eq!(length, 2 + 3200);

    let text = Object::record(0x8000, "x".to_owned(), 3).string(3, "Name", 4, "äöü");
    assert_eq!(text.entries[1].value, "äö".as_bytes());
    let text = Object::record(0x8000, "x".to_owned(), 3).string(3, "Name", 5, "äöü");
    assert_eq!(text.entries[1].value, "äö\0".as_bytes());
}

/// Returns the refusal of a request to the drive of the machine, which is its last device.
fn refusal(gateway: &Gateway, request: &Request<'_>, in_transfer: bool) -> Option<RawMessage> {
    let request = sdo(request);
    let telegram = Telegram::parse(&request).unwrap();
    let message = RawMessage {
        channel: telegram.channel,
        protocol: telegram.protocol,
        body: telegram.body.to_vec(),
    };
    let access = &gateway.access;
    access.refusal(DeviceIndex(5), &LAYOUT, &message, in_transfer)
}

#[test]
fn with_power_a_drive_gets_no_write_that_moves_resets_or_limits_it() {
    let (gateway, sender) = gateway(true);
    let write = |index, sub, complete| {
        let request = match complete {
            false => Request::DownloadExpedited {
                index,
                sub,
                data: &[1, 0, 0, 0],
            },
            true => Request::Download {
                index,
                sub,
                complete,
                size: 8,
                data: &[1; 8],
            },
        };
        let refusal = refusal(&gateway, &request, false)?;
        // The abort names the object: 0x08000022, "in the present state".
        let [low, high] = index.to_le_bytes();
        assert_eq!(refusal.body[3..], [low, high, sub, 0x22, 0, 0, 8]);
        Some(refusal)
    };
    let machine_objects = [
        0x1010, 0x1011, 0x1023, 0x1f51, 0x2003, 0x6065, 0x6072, 0x607d, 0x607f, 0x6083, 0x6085,
        0x6098, 0x605a, 0x6091, 0x60fe,
    ];
    let cycle_objects = [0x6040, 0x6060, 0x6071, 0x607a, 0x60ff, 0x60b0, 0x1c12];
    // Before the first cycle, no axis is known to be without power.
    for power in [None, Some(true), Some(false)] {
        sender.send_modify(|live| live.power = power.into_iter().collect());
        let refused = power != Some(false);
        for index in machine_objects {
            assert_eq!(write(index, 1, false).is_some(), refused, "{index:#x}");
            assert_eq!(write(index, 0, true).is_some(), refused, "{index:#x}");
        }
        for index in cycle_objects {
            assert!(write(index, 0, false).is_some(), "{index:#x}");
        }
        for index in [0x60f9, 0x1003] {
            assert_eq!(write(index, 1, false), None, "{index:#x}");
        }
        // Complete access to a record of which one element is a command.
        assert_eq!(write(0x60c4, 1, true).is_some(), refused);
        let segment = Request::DownloadSegment {
            toggle: false,
            last: true,
            data: &[1; 7],
        };
        assert_eq!(refusal(&gateway, &segment, true).is_some(), refused);
        for reads in [
            Request::Upload {
                index: 0x6065,
                sub: 0,
                complete: false,
            },
            Request::Information {
                opcode: 1,
                body: &[1, 0],
            },
        ] {
            assert_eq!(refusal(&gateway, &reads, false), None);
        }
        for (protocol, body) in [
            (TYPE_FOE, &b"\x02\0\0\0\0\0firmware"[..]),
            (TYPE_SOE, &[3, 0, 1, 0, 1, 2]),
            (1, &[0; 8]),
            (2, &[0; 8]),
            (15, &[0; 8]),
        ] {
            let message = RawMessage {
                channel: 0,
                protocol,
                body: body.to_vec(),
            };
            let access = &gateway.access;
            let drive = access.refusal(DeviceIndex(5), &LAYOUT, &message, false);
            assert_eq!(drive.is_some(), refused, "{protocol}");
            // A terminal moves nothing.
            let terminal = access.refusal(DeviceIndex(2), &LAYOUT, &message, false);
            assert_eq!(terminal, None, "{protocol}");
        }
    }
}

#[test]
fn absences_and_unrequested_states_are_counted() {
    use crate::rt::exchange::SubDeviceDiagnostics;
    let state = |answers, al_status| {
        let mut found = SubDeviceDiagnostics::default();
        (found.answers, found.al_status) = (answers, al_status);
        found
    };
    let mut device = DeviceLive::default();
    let seen = [
        (state(true, 4), false),
        (state(true, 8), true),
        (state(false, 8), true),
        (state(true, 8), true),
        (state(true, 0x14), true),
        (state(true, 8), true),
        // On the way back, states change on request.
        (state(true, 4), false),
    ];
    for (now, in_op) in seen {
        device.follow(&now, in_op);
    }
    assert_eq!((device.absences, device.abnormal), (1, 1));
}

#[test]
fn a_million_damaged_frames_never_panic_and_never_write() {
    let gateways = [gateway(false), gateway(true)];
    for (_, sender) in &gateways {
        sender.send_modify(|live| live.devices = vec![DeviceLive::default(); 6]);
    }
    let read_only = &gateways[0].0;
    let mut good: Vec<Vec<u8>> = Vec::new();
    for index in [0x1018, 0x6040, 0x8005, 0xa001, 0xf002, 0xf020] {
        for request in [
            Request::Upload {
                index,
                sub: 0,
                complete: true,
            },
            Request::DownloadExpedited {
                index,
                sub: 1,
                data: &[1, 2],
            },
            Request::Download {
                index,
                sub: 0,
                complete: true,
                size: 8,
                data: &[7; 8],
            },
            Request::UploadSegment { toggle: true },
            Request::Information {
                opcode: 5,
                body: &[0x18, 0x10, 1, 7],
            },
        ] {
            good.push(sdo(&request));
        }
    }
    good.push(frame(0x1000, TYPE_FOE, b"\x02\0\0\0\0\0firmware"));
    good.push(frame(0x1000, TYPE_SOE, &[3, 0, 1, 0, 1, 2]));
    let mut state = 0x9e37_79b9_7f4a_7c15_u64;
    let mut random = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state
    };
    let below = |random: u64, bound: usize| usize::try_from(random >> 33).unwrap() % bound;
    let (mut parsed, mut answered, mut passed) = (0_u32, 0_u32, 0_u32);
    for round in 0..1_000_000_usize {
        let mut bytes = good[round % good.len()].clone();
        match round % 5 {
            0 => {
                bytes = (0..below(random(), 80))
                    .map(|_| random().to_le_bytes()[3])
                    .collect();
            }
            1 => bytes.truncate(below(random(), bytes.len())),
            _ => {
                for _ in 0..=below(random(), 3) {
                    let place = below(random(), bytes.len());
                    bytes[place] = random().to_le_bytes()[3];
                }
            }
        }
        if let Ok(Some(length)) = next_frame(&bytes) {
            assert!(length <= MAX_FRAME);
        }
        let Ok(telegram) = Telegram::parse(&bytes) else {
            continue;
        };
        parsed += 1;
        for (gateway, _) in &gateways {
            let answers = now(Client::new(gateway).answer(&bytes));
            answered += u32::from(!answers.is_empty());
            for answer in answers {
                let answer = Telegram::parse(&answer).unwrap();
                assert_eq!(
                    (answer.station, answer.counter),
                    (telegram.station, telegram.counter)
                );
            }
        }
        let message = RawMessage {
            channel: telegram.channel,
            protocol: telegram.protocol,
            body: telegram.body.to_vec(),
        };
        let access = &read_only.access;
        if access
            .refusal(DeviceIndex(5), &LAYOUT, &message, true)
            .is_none()
        {
            passed += 1;
            assert!(reads(&message), "{message:02x?}");
        }
    }
    assert!(parsed > 100_000 && answered > 100_000 && passed > 10_000);
}

/// Says independently of the code under test whether a message only reads.
fn reads(message: &RawMessage) -> bool {
    let body = &message.body[..];
    match message.protocol {
        // CoE: SDO request with upload, segment of an upload, abort; SDO Information.
        3 => match body[1] >> 4 {
            2 => matches!(body[2] >> 5, 2..=4),
            8 => matches!(body[2] & 0x7f, 1 | 3 | 5),
            _ => false,
        },
        // FoE: read, acknowledge, error, busy.
        4 => matches!(body[0], 1 | 4 | 5 | 6),
        5 => body[0] & 7 == 1,
        _ => false,
    }
}
