//! Invariants that no mailbox message may break.

use crate::common::*;
use ecaxis_sim::{DeviceOptions, FoeOptions, MailboxOptions};
use proptest::prelude::*;

const S: u16 = 0x1001;
const UPLOAD: [u8; 10] = [0, 0x20, 0x40, 3, 0x20, 0, 0, 0, 0, 0];

/// A message that resembles a request more or less.
fn any_message() -> impl Strategy<Value = (Vec<u8>, Option<u16>)> {
    let index = prop_oneof![
        Just(0x2000u16),
        Just(0x2001),
        Just(0x2002),
        Just(0x2003),
        Just(0x2010),
        Just(0x2011),
        Just(0x1600),
        Just(0x1c12),
        Just(0x1010),
        Just(0x1018),
        any::<u16>(),
    ];
    let sdo = (
        any::<u8>(),
        index,
        0u8..4,
        any::<u32>(),
        prop::collection::vec(any::<u8>(), 0..80),
    )
        .prop_map(|(command, index, sub, value, rest)| {
            let mut out = vec![3, 0, 0x20, command];
            out.extend_from_slice(&index.to_le_bytes());
            out.push(sub);
            out.extend_from_slice(&(value & 0x1ff).to_le_bytes());
            out.extend_from_slice(&rest);
            out
        });
    let info = (0u8..9, 0u16..8, any::<u16>(), any::<u8>(), any::<u8>()).prop_map(
        |(opcode, list, index, sub, asked)| {
            let mut out = vec![3, 0, 0x80, opcode, 0, 0, 0];
            let subject = if opcode == 1 {
                list
            } else {
                0x2000 | index & 0x3f
            };
            out.extend_from_slice(&subject.to_le_bytes());
            out.extend_from_slice(&[sub & 7, asked]);
            out
        },
    );
    let name = prop_oneof![
        Just(b"a".to_vec()),
        Just(b"b\0".to_vec()),
        prop::collection::vec(any::<u8>(), 0..40)
    ];
    let foe = (
        0u8..8,
        0u32..4,
        name,
        prop::collection::vec(any::<u8>(), 0..1500),
    )
        .prop_map(|(opcode, number, name, data)| {
            let mut out = vec![4, opcode, 0];
            out.extend_from_slice(&number.to_le_bytes());
            out.extend_from_slice(if opcode < 3 { &name } else { &data });
            out
        });
    let anything = prop::collection::vec(any::<u8>(), 1..64);
    let wrong_len = prop_oneof![4 => Just(None), 1 => any::<u16>().prop_map(Some)];
    (
        prop_oneof![4 => sdo, 2 => info, 3 => foe, 1 => anything],
        wrong_len,
    )
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]
    /// Answers come one by one with a correct length, and the device continues to answer.
    #[test]
    fn mailbox_survives_any_message_with_correct_lengths(
        len in prop_oneof![Just(16u16), Just(48), 16u16..=1486],
        boot in any::<bool>(),
        messages in prop::collection::vec((any_message(), any::<u8>(), 0usize..4), 1..40),
    ) {
        let options = MailboxOptions {
            sdo_timeout_ns: Some(2_000_000),
            foe: FoeOptions { capacity: 5000, busy_every: 3, ..FoeOptions::default() },
            ..MailboxOptions::default()
        };
        let mut bus = Bus::new(vec![sim_with(&mailbox_device(), DeviceOptions { mailbox: options, ..DeviceOptions::default() })]);
        bus.address_all();
        let len = if boot { 256 } else { len };
        bus.mailboxes = [(0x1000, len), (0x1600, len)];
        bus.start_mailboxes(S);
        bus.to(S, if boot { BOOT } else { PREOP });
        let room = usize::from(len);
        for ((content, wrong_len), header, fetches) in messages {
            let payload = &content[1..content.len().min(room - 5)];
            let claimed = wrong_len.unwrap_or(payload.len() as u16).to_le_bytes();
            let kind = content[0] & 0x0f | header & 0xf0;
            let whole = message(room, [claimed[0], claimed[1], 0, 0, u8::from(header & 7 == 0), kind], payload);
            // The device refuses the write while too many answers wait to be fetched.
            bus.datagram(5, S, 0x1000, &whole);
            bus.wait(400_000);
            for _ in 0..fetches {
                if let Some(answer) = bus.fetch_raw(S) {
                    prop_assert!(usize::from(u16::from_le_bytes([answer[0], answer[1]])) + 6 <= room);
                    prop_assert!(matches!(answer[5] & 0x8f, 0 | 3 | 4));
                    prop_assert!((1..=7).contains(&(answer[5] >> 4)));
                }
            }
        }
        // When all answers are fetched the device answers again, in Bootstrap with a refusal.
        for _ in 0..10_000 {
            bus.wait(400_000);
            if bus.fetch_raw(S).is_none() && bus.read(S, 0x805, 1)[0] & 8 == 0 {
                break;
            }
        }
        // A fresh counter: two requests cannot both be repetitions.
        for counter in [1, 2] {
            bus.write(S, 0x1000, &message(room, [10, 0, 0, 0, 0, 3 | counter << 4], &UPLOAD));
            bus.wait(400_000);
            if let Some(answer) = bus.fetch_raw(S) {
                prop_assert_eq!(answer[5] & 0x0f, if boot { 0 } else { 3 });
                return Ok(());
            }
        }
        prop_assert!(false, "no answer any more");
    }
}
