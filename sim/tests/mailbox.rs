//! The mailbox protocol: headers and their errors, counters, repetitions, order.

use crate::common::*;
use ecaxis_sim::{DeviceOptions, FaultScript, MailboxOptions};

const S: u16 = 0x1001;
const UPLOAD: [u8; 10] = [0, 0x20, 0x40, 3, 0x20, 0, 0, 0, 0, 0];

fn preop() -> Bus {
    let mut bus = Bus::new(vec![sim(&coe_device())]);
    bus.address_all();
    bus.preop(S);
    bus
}

fn with(mailbox: MailboxOptions) -> DeviceOptions {
    DeviceOptions {
        mailbox,
        ..DeviceOptions::default()
    }
}

/// Returns a CoE message with this counter.
fn counted(counter: u8, payload: &[u8]) -> Vec<u8> {
    let len = payload.len() as u8;
    message(48, [len, 0, 0, 0, 0, 3 | counter << 4], payload)
}

#[test]
fn mailbox_is_locked_until_it_is_read() {
    let mut bus = preop();
    let upload = [0, 0x20, 0x40, 3, 0x20, 0, 0, 0, 0, 0];
    assert_eq!(bus.fetch(S), None, "nothing to read");
    bus.send_mailbox(S, 3, &upload);
    assert_eq!(bus.read(S, 0x805, 1), [9], "full, written");
    assert_eq!(bus.datagram(5, S, 0x1000, &[0; 48]).1, 0, "still full");
    bus.wait(1_000_000);
    assert_eq!(
        (bus.read(S, 0x805, 1), bus.read(S, 0x80d, 1)),
        (vec![2], vec![9]),
        "read by the device; full, written by it"
    );
    assert_eq!(
        bus.datagram(4, S, 0x1050, &[0; 16]).1,
        0,
        "not from its first byte"
    );
    let (kind, reply) = bus.fetch(S).unwrap();
    assert_eq!((kind, &reply[..3]), (3, &[0, 0x30, 0x43][..]));
    assert_eq!(bus.fetch(S), None);
    assert_eq!(bus.read(S, 0x80d, 1), [2], "empty, read");
}

#[test]
fn fmmu_shows_a_waiting_reply() {
    let mut bus = preop();
    // Bit 3 of 0x080D at bit 2 of logical 0x500.
    bus.write(
        S,
        0x620,
        &[0, 5, 0, 0, 1, 0, 2, 2, 0x0d, 8, 3, 1, 1, 0, 0, 0],
    );
    assert_eq!(bus.logical(10, 0x500, &[0]), (vec![0], 1));
    bus.send_mailbox(S, 3, &[0, 0x20, 0x40, 3, 0x20, 0, 0, 0, 0, 0]);
    bus.wait(1_000_000);
    assert_eq!(bus.logical(10, 0x500, &[0]), (vec![4], 1));
    bus.fetch(S).unwrap();
    assert_eq!(bus.logical(10, 0x500, &[0]), (vec![0], 1));
}

#[test]
fn mailboxes_are_not_served_in_init() {
    let mut bus = Bus::new(vec![sim(&coe_device())]);
    bus.address_all();
    bus.sm(S, 0, 0x1000, 48, 0x26);
    bus.sm(S, 1, 0x1030, 48, 0x22);
    bus.send_mailbox(S, 3, &[0, 0x20, 0x40, 3, 0x20, 0, 0, 0, 0, 0]);
    bus.wait(1_000_000);
    assert_eq!(bus.fetch(S), None);
    assert_eq!(bus.read(S, 0x805, 1), [9], "full, written");
    bus.to(S, PREOP);
    assert_eq!(bus.read(S, 0x805, 1), [0], "forgotten on the way to PreOp");
}

#[test]
fn return_to_init_clears_the_mailbox() {
    let mut bus = preop();
    bus.send_mailbox(S, 3, &[0, 0x20, 0x40, 3, 0x20, 0, 0, 0, 0, 0]);
    bus.wait(1_000_000);
    bus.to(S, INIT);
    bus.write(S, 0x806, &[0]);
    bus.write(S, 0x80e, &[0]);
    bus.preop(S);
    assert_eq!(bus.fetch(S), None);
    assert_eq!(bus.upload(S, 0x2003, 0).unwrap(), [7, 0, 0, 0]);
}

#[test]
fn lost_reply_is_repeated_on_request() {
    let mut bus = preop();
    let first = bus.mailbox(S, 3, &[0, 0x20, 0x40, 3, 0x20, 0, 0, 0, 0, 0]);
    for toggle in [2, 0] {
        bus.write(S, 0x80e, &[1 | toggle]);
        bus.wait(1_000_000);
        assert_eq!(bus.read(S, 0x80f, 1), [toggle]);
        assert_eq!(bus.fetch(S), Some(first.clone()));
        assert_eq!(bus.fetch(S), None);
    }
}

#[test]
fn header_errors_row_by_row() {
    let sdo = &UPLOAD[..];
    let rows: [(u16, &str, [u8; 6], &[u8]); 17] = [
        (1, "reserved bit set", [10, 0, 0, 0, 0, 0x83], sdo),
        (2, "AoE", [10, 0, 0, 0, 0, 1], sdo),
        (2, "EoE", [10, 0, 0, 0, 0, 2], sdo),
        (
            2,
            "FoE, which this device has not",
            [10, 0, 0, 0, 0, 4],
            sdo,
        ),
        (2, "SoE", [10, 0, 0, 0, 0, 5], sdo),
        (2, "VoE", [10, 0, 0, 0, 0, 15], sdo),
        (2, "unassigned", [10, 0, 0, 0, 0, 9], sdo),
        (3, "channel 1", [10, 0, 0, 0, 1, 3], sdo),
        (3, "channel 63, priority 3", [10, 0, 0, 0, 0xff, 3], sdo),
        (4, "TxPDO", [10, 0, 0, 0, 0, 3], &[0, 0x40, 0, 0]),
        (4, "SDO response", [10, 0, 0, 0, 0, 3], &[0, 0x30, 0, 0]),
        (
            4,
            "SDO information off",
            [8, 0, 0, 0, 0, 3],
            &[0, 0x80, 1, 0, 0, 0, 1, 0],
        ),
        (5, "CoE service 0", [10, 0, 0, 0, 0, 3], &[0, 0]),
        (5, "CoE service 9", [10, 0, 0, 0, 0, 3], &[0, 0x90]),
        (6, "no CoE header", [1, 0, 0, 0, 0, 3], sdo),
        (6, "half an SDO request", [6, 0, 0, 0, 0, 3], sdo),
        (8, "longer than the mailbox", [43, 0, 0, 0, 0, 3], sdo),
    ];
    let mut bus = preop();
    for (detail, what, header, payload) in rows {
        bus.write(S, 0x1000, &message(48, header, payload));
        bus.wait(1_000_000);
        let [low, high] = detail.to_le_bytes();
        assert_eq!(bus.fetch(S), Some((0, vec![1, 0, low, high])), "{what}");
    }
    for (what, header, payload) in [
        ("an upload request with data", [11, 0, 0, 0, 0, 3], sdo),
        (
            "expedited, with more data",
            [11, 0, 0, 0, 0, 3],
            &[0, 0x20, 0x23, 0, 0x20, 0, 5, 0, 0, 0][..],
        ),
        (
            "more data than announced",
            [13, 0, 0, 0, 0, 3],
            &[0, 0x20, 0x21, 2, 0x20, 0, 2, 0, 0, 0][..],
        ),
    ] {
        bus.write(S, 0x1000, &message(48, header, payload));
        bus.wait(1_000_000);
        assert_eq!(bus.fetch(S), Some((0, vec![1, 0, 8, 0])), "{what}");
    }
    assert_eq!(bus.fetch(S), None);
}

#[test]
fn mailbox_priorities_are_accepted() {
    let mut bus = preop();
    bus.write(S, 0x1000, &message(48, [10, 0, 0, 0, 0xc0, 3], &UPLOAD));
    bus.wait(1_000_000);
    assert_eq!(bus.fetch(S).unwrap().0, 3);
}

#[test]
fn client_that_never_fetches_gets_an_error_and_is_then_blocked() {
    let mut bus = preop();
    // One answer in the mailbox, three in the queue, the error message, and a request that stays in
    // the mailbox.
    for n in 0..6 {
        bus.send_mailbox(S, 3, &UPLOAD);
        bus.wait(1_000_000);
        assert_eq!(
            bus.read(S, 0x805, 1),
            [if n < 5 { 2 } else { 9 }],
            "request {n}"
        );
    }
    let kinds: Vec<_> = std::iter::from_fn(|| {
        let answer = bus.fetch(S);
        bus.wait(1_000_000);
        answer
    })
    .collect();
    let sdo = (3, vec![0, 0x30, 0x43, 3, 0x20, 0, 7, 0, 0, 0]);
    let full = (0, vec![1, 0, 7, 0]);
    let expected = [&sdo, &sdo, &sdo, &sdo, &full, &sdo];
    assert_eq!(kinds.iter().collect::<Vec<_>>(), expected);
}

/// Starts a segmented upload. Executing a segment request twice would be a toggle error.
fn first_segment(bus: &mut Bus) -> Vec<u8> {
    bus.write(
        S,
        0x1000,
        &counted(1, &[0, 0x20, 0x40, 2, 0x20, 0, 0, 0, 0, 0]),
    );
    bus.wait(1_000_000);
    bus.fetch_raw(S).unwrap();
    counted(2, &[0, 0x20, 0x60, 0, 0, 0, 0, 0, 0, 0])
}

#[test]
fn repeated_request_is_executed_once_and_answered_until_fetched() {
    let mut bus = preop();
    let request = first_segment(&mut bus);
    bus.write(S, 0x1000, &request);
    assert_eq!(bus.datagram(5, S, 0x1000, &request).1, 0, "not fetched yet");
    bus.wait(1_000_000);
    // The answer is in the mailbox: the repetition changes nothing.
    bus.write(S, 0x1000, &request);
    bus.wait(1_000_000);
    let answer = bus.fetch_raw(S).unwrap();
    assert_eq!(bus.fetch_raw(S), None);
    assert_eq!(answer[8], 0, "first segment");
    // The answer was fetched and lost: the device sends it again unchanged, including the counter.
    for _ in 0..3 {
        bus.write(S, 0x1000, &request);
        bus.wait(1_000_000);
        assert_eq!(bus.fetch_raw(S), Some(answer.clone()));
        assert_eq!(bus.fetch_raw(S), None);
    }
    bus.write(
        S,
        0x1000,
        &counted(3, &[0, 0x20, 0x70, 0, 0, 0, 0, 0, 0, 0]),
    );
    bus.wait(1_000_000);
    assert_eq!(bus.fetch_raw(S).unwrap()[8], 0x10, "second segment");
}

#[test]
fn answer_read_after_the_repetition_is_sent_once() {
    let mut bus = preop();
    let request = first_segment(&mut bus);
    bus.write(S, 0x1000, &request);
    bus.wait(1_000_000);
    bus.write(S, 0x1000, &request);
    assert!(bus.fetch_raw(S).is_some());
    bus.wait(1_000_000);
    assert_eq!((bus.fetch_raw(S), bus.read(S, 0x805, 1)), (None, vec![2]));
}

#[test]
fn different_request_with_the_last_counter_is_dropped() {
    let mut bus = preop();
    bus.write(S, 0x1000, &counted(5, &UPLOAD));
    bus.wait(1_000_000);
    assert!(bus.fetch(S).is_some());
    bus.write(
        S,
        0x1000,
        &counted(5, &[0, 0x20, 0x2f, 0, 0x20, 0, 3, 0, 0, 0]),
    );
    bus.wait(1_000_000);
    assert_eq!((bus.fetch(S), bus.read(S, 0x805, 1)), (None, vec![2]));
}

#[test]
fn requests_without_a_counter_are_never_repetitions() {
    let mut bus = preop();
    first_segment(&mut bus);
    let request = counted(0, &[0, 0x20, 0x60, 0, 0, 0, 0, 0, 0, 0]);
    for expected in [0, 0x80] {
        bus.write(S, 0x1000, &request);
        bus.wait(1_000_000);
        assert_eq!(
            bus.fetch_raw(S).unwrap()[8],
            expected,
            "segment, then toggle error"
        );
    }
}

#[test]
fn request_repeated_during_processing_is_answered_once() {
    let options = MailboxOptions {
        processing_ns: 20_000_000,
        ..MailboxOptions::default()
    };
    let mut bus = Bus::new(vec![sim_with(&coe_device(), with(options))]);
    bus.address_all();
    bus.preop(S);
    let request = counted(1, &UPLOAD);
    bus.write(S, 0x1000, &request);
    bus.wait(1_000_000);
    assert_eq!(bus.read(S, 0x805, 1), [2], "fetched");
    bus.write(S, 0x1000, &request);
    bus.wait(15_000_000);
    assert_eq!(bus.read(S, 0x805, 1), [9], "busy with the first");
    assert_eq!(bus.fetch(S), None);
    bus.wait(50_000_000);
    assert!(bus.fetch(S).is_some());
    bus.wait(50_000_000);
    assert_eq!(bus.fetch(S), None);
}

#[test]
fn answers_and_emergencies_share_a_counter_from_1_to_7() {
    let mut bus = preop();
    let script = "[[fault]]\nat = \"3ms\"\nkind = \"emergency\"\ncode = 0x8110\n";
    bus.segment.set_faults(FaultScript::parse(script).unwrap());
    let mut counters = Vec::new();
    for _ in 0..10 {
        bus.send_mailbox(S, 3, &UPLOAD);
        bus.wait(500_000);
        while let Some(message) = bus.fetch_raw(S) {
            counters.push(message[5] >> 4);
        }
    }
    let expected: Vec<u8> = (0..11).map(|n| n % 7 + 1).collect();
    assert_eq!(counters, expected);
}

#[test]
fn unfetched_message_follows_the_repeated_one() {
    let mut bus = preop();
    bus.send_mailbox(S, 3, &UPLOAD);
    bus.wait(1_000_000);
    let first = bus.fetch_raw(S).unwrap();
    bus.send_mailbox(S, 3, &[0, 0x20, 0x40, 1, 0x20, 0, 0, 0, 0, 0]);
    bus.wait(1_000_000);
    bus.write(S, 0x80e, &[3]);
    assert_eq!(bus.read(S, 0x80f, 1), [2]);
    assert_eq!(bus.fetch_raw(S), Some(first));
    let second = bus.fetch_raw(S).unwrap();
    assert_eq!(second[9..11], [1, 0x20]);
    assert_eq!(bus.fetch_raw(S), None);
    bus.write(S, 0x80e, &[1]);
    assert_eq!(bus.fetch_raw(S), Some(second));
}

#[test]
fn repeat_request_before_any_message_has_no_effect() {
    let mut bus = preop();
    bus.write(S, 0x80e, &[3]);
    bus.wait(1_000_000);
    assert_eq!((bus.read(S, 0x80f, 1), bus.fetch(S)), (vec![2], None));
}

#[test]
fn full_emergency_queue_drops_the_newest() {
    let mut bus = preop();
    let script: String = (0..20)
        .map(|n| {
            format!(
                "[[fault]]\nat = \"{}ms\"\nkind = \"emergency\"\ncode = {}\n",
                n + 1,
                0x8100 + n
            )
        })
        .collect();
    bus.segment.set_faults(FaultScript::parse(&script).unwrap());
    bus.wait(30_000_000);
    bus.send_mailbox(S, 3, &UPLOAD);
    bus.wait(1_000_000);
    // One in the mailbox, sixteen in the queue.
    for n in 0..17 {
        let (kind, emergency) = bus.fetch(S).unwrap();
        assert_eq!((kind, &emergency[..4]), (3, &[0, 0x10, n, 0x81][..]));
    }
    assert_eq!(bus.fetch(S).unwrap().1[1], 0x30, "the answer");
    assert_eq!(bus.fetch(S), None);
}

#[test]
fn transfer_survives_safe_op_but_not_init() {
    let mut bus = mailbox_bus(48, DeviceOptions::default());
    let start = [0, 0x20, 0x40, 0, 0x20, 0, 0, 0, 0, 0];
    let segment = |toggle: u8| [0, 0x20, 0x60 | toggle, 0, 0, 0, 0, 0, 0, 0];
    bus.mailbox(S, 3, &start);
    bus.sm(S, 2, 0x1c00, 6, 0x64);
    bus.sm(S, 3, 0x1d00, 6, 0x20);
    bus.to(S, SAFEOP);
    assert_eq!(bus.mailbox(S, 3, &segment(0)).1[2], 0);
    bus.to(S, PREOP);
    assert_eq!(bus.mailbox(S, 3, &segment(0x10)).1[2], 0x10);
    bus.to(S, INIT);
    bus.to(S, PREOP);
    let (_, reply) = bus.mailbox(S, 3, &segment(0));
    assert_eq!(reply, [0, 0x20, 0x80, 0, 0, 0, 1, 0, 4, 5]);
}

#[test]
fn mailbox_is_served_in_every_state_except_init() {
    let mut bus = mailbox_bus(64, DeviceOptions::default());
    bus.sm(S, 2, 0x1c00, 6, 0x64);
    bus.sm(S, 3, 0x1d00, 6, 0x20);
    for state in [SAFEOP, OP] {
        bus.to(S, state);
        assert_eq!(bus.upload(S, 0x2025, 0).unwrap(), [0xfe, 0xca]);
    }
}
