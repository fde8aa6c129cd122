use super::*;
use crate::link::MAX_FRAME;
use crate::rt::image::plan;
use proptest::prelude::*;

/// Answers as `devices` SubDevices would that carry `expected` working counters.
fn reflect(exchange: &Exchange, number: usize, input: u8) -> Vec<u8> {
    let mut frame = exchange.frames[number].bytes.clone();
    frame[6] |= 0x02;
    let mut at = FIRST_DATAGRAM;
    while at + DATAGRAM_HEADER <= frame.len() {
        let len = usize::from(u16::from_le_bytes([frame[at + 6], frame[at + 7] & 7]));
        let data = at + DATAGRAM_HEADER;
        let wkc = match frame[at] {
            LRW => {
                exchange
                    .lrws
                    .iter()
                    .find(|l| l.place.frame == number)
                    .expect("lrw")
                    .expected_wkc
            }
            _ => 1,
        };
        frame[data..data + len].fill(input);
        frame[data + len..data + len + 2].copy_from_slice(&wkc.to_le_bytes());
        at = data + len + WKC;
    }
    frame
}

fn axes(count: usize) -> Exchange {
    let plan = plan(&vec![(12, 12); count]).expect("fits");
    let stations: Vec<u16> = (0..count).map(|i| 0x1000 + i as u16).collect();
    let clock = ClockPlan {
        reference: 0x1000,
        clocks: 1,
        cycle_ns: 1_000_000,
        release: 0,
    };
    Exchange::new(&plan, Some(&clock), &stations)
}

#[test]
fn frame_bytes_for_8_32_and_100_axes() {
    for (count, cyclic) in [(8, 158), (32, 446), (100, 1262)] {
        let exchange = axes(count);
        let lengths: Vec<_> = exchange.frame_lengths().collect();
        assert_eq!(lengths.len(), 1, "{count} axes in one frame");
        assert_eq!(exchange.probe_at, cyclic);
        assert!(
            lengths[0] <= cyclic + 20,
            "the diagnostic datagram takes at most 20 bytes"
        );
    }
}

#[test]
fn an_answer_is_taken_once_and_only_in_its_cycle() {
    let mut exchange = axes(2);
    let first = reflect(&exchange, 0, 0x5a);
    assert_eq!(exchange.receive(&first), Received::Current);
    assert!(exchange.complete());
    assert_eq!(exchange.receive(&first), Received::Late, "a duplicate");
    let answer = exchange.answer();
    assert!(answer.complete && answer.inputs_fresh);
    assert_eq!(answer.wkc, (6, 6));
    assert_eq!(answer.system_time, Some(0x5a5a_5a5a_5a5a_5a5a));
    assert_eq!(answer.al_status, Some((0x5a, 1)));
    assert_eq!(exchange.inputs(), [0x5a; 24]);

    exchange.stage();
    assert_eq!(
        exchange.receive(&first),
        Received::Late,
        "an answer of the cycle before"
    );
    assert!(!exchange.answer().complete);
}

#[test]
fn a_wrong_working_counter_leaves_the_inputs_alone() {
    let mut exchange = axes(1);
    let mut frame = reflect(&exchange, 0, 0x11);
    let wkc = exchange.lrws[0].place.data().end;
    frame[wkc] = 2;
    assert_eq!(exchange.receive(&frame), Received::Current);
    let answer = exchange.answer();
    assert!(answer.complete && !answer.inputs_fresh);
    assert_eq!(answer.wkc, (2, 3));
    assert_eq!(exchange.inputs(), [0; 12]);
}

#[test]
fn the_diagnostic_slot_walks_through_devices_and_probes() {
    let mut exchange = axes(2);
    let mut seen = Vec::new();
    for _ in 0..6 {
        seen.push(exchange.probe);
        let frame = reflect(&exchange, 0, 1);
        exchange.receive(&frame);
        exchange.stage();
    }
    assert_eq!(seen, [(0, 0), (1, 0), (0, 1), (1, 1), (0, 2), (1, 2)]);
    assert_eq!(
        exchange.diagnoses()[1],
        Diagnosis {
            al_status: 1,
            al_code: 0x0101,
            clock_difference: 0x0101_0101,
            rx_errors: [1; 8],
        }
    );
}

#[test]
fn large_images_take_several_frames() {
    let mut exchange = axes(300);
    assert_eq!(exchange.frame_lengths().count(), 3);
    assert!(exchange.frame_lengths().all(|len| len <= MAX_FRAME));
    for number in [2, 0, 1] {
        let frame = reflect(&exchange, number, 7);
        assert_eq!(exchange.receive(&frame), Received::Current);
    }
    assert!(exchange.answer().inputs_fresh);
}

#[test]
fn the_difference_register_is_sign_and_magnitude() {
    assert_eq!(sign_magnitude(5), 5);
    assert_eq!(sign_magnitude(0x8000_0005), -5);
}

proptest! {
    #[test]
    fn no_received_bytes_panic(mut frame in proptest::collection::vec(any::<u8>(), 0..1600), ours: bool) {
        let mut exchange = axes(3);
        if ours && frame.len() > 20 {
            let template = reflect(&exchange, 0, 0);
            let n = frame.len().min(30);
            frame[..n].copy_from_slice(&template[..n]);
        }
        exchange.receive(&frame);
        let _ = exchange.answer();
    }
}
