use super::*;
use crate::rt::image::{ProcessData, plan};
use proptest::prelude::*;

use super::frame::FIRST_DATAGRAM;

/// Swallows what it is given.
#[derive(Debug)]
struct Nowhere;

impl Link for Nowhere {
    fn send(&mut self, _: &[u8]) -> Result<(), LinkError> {
        Ok(())
    }

    fn recv(&mut self, _: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        Ok(None)
    }
}

/// Sends the cycle's frames; what comes back of the one of this number, as from SubDevices that are all there.
fn reflect(exchange: &mut Exchange, number: usize, input: u8) -> Vec<u8> {
    exchange.send(&mut Nowhere, 0).expect("nowhere takes all");
    let mut frame = exchange.flights[exchange.staged].frames()[number]
        .bytes
        .clone();
    frame[6] |= 0x02;
    let mut at = FIRST_DATAGRAM;
    while at + DATAGRAM_HEADER <= frame.len() {
        let len = usize::from(u16::from_le_bytes([frame[at + 6], frame[at + 7] & 7]));
        let data = at + DATAGRAM_HEADER;
        let form = exchange.flights[exchange.staged].form;
        let expected = exchange.forms[form]
            .process_data
            .iter()
            .find(|d| (d.place.frame, d.place.offset) == (number, at));
        let wkc = expected.map_or(1, |d| d.expected_wkc);
        if frame[at] != LWR {
            frame[data..data + len].fill(input);
        }
        frame[data + len..data + len + 2].copy_from_slice(&wkc.to_le_bytes());
        at = data + len + WKC;
    }
    frame
}

fn axis(group: usize) -> ProcessData {
    ProcessData {
        out_len: 12,
        in_len: 12,
        group,
        lrw: true,
        mailbox: false,
    }
}

fn axes(count: usize) -> Exchange {
    exchange(&vec![axis(0); count], Mode::SameCycle)
}

/// An axis in each of the groups.
fn grouped(groups: &[usize]) -> Exchange {
    let devices: Vec<_> = groups.iter().map(|&group| axis(group)).collect();
    exchange(&devices, Mode::SameCycle)
}

/// The first with a clock.
fn exchange(devices: &[ProcessData], mode: Mode) -> Exchange {
    let plan = plan(devices).expect("fits");
    let members: Vec<_> = (0..devices.len())
        .map(|i| Member {
            station: 0x1000 + i as u16,
            clock: i == 0,
            mailbox: None,
        })
        .collect();
    let clock = ClockPlan {
        reference: 0x1000,
        cycle_ns: 1_000_000,
        release: 0,
    };
    Exchange::new(&plan, Some(&clock), &members, mode)
}

#[test]
fn frame_bytes_for_8_32_and_100_axes() {
    for (count, cyclic) in [(8, 158), (32, 446), (100, 1262)] {
        let exchange = axes(count);
        let lengths: Vec<_> = exchange.frame_lengths().collect();
        assert_eq!(lengths.len(), 1, "{count} axes in one frame");
        assert_eq!(exchange.forms[0].probe_at, cyclic);
        assert!(
            lengths[0] <= cyclic + 20,
            "the diagnostic datagram takes at most 20 bytes"
        );
    }
}

#[test]
fn an_answer_is_taken_once_and_only_in_its_cycle() {
    let mut exchange = axes(2);
    let first = reflect(&mut exchange, 0, 0x5a);
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
fn pipelined_answers_count_in_the_next_cycle_whenever_they_come() {
    let mut exchange = exchange(&[axis(0); 2], Mode::Pipelined);
    let first = reflect(&mut exchange, 0, 1);
    assert!(!exchange.complete(), "nothing was asked before");
    // It comes back at once, but its turn is the next cycle.
    assert_eq!(exchange.receive(&first), Received::Current);
    assert!(!exchange.answer().complete);
    assert_eq!(exchange.inputs(), [0; 24]);
    exchange.stage();

    let second = reflect(&mut exchange, 0, 2);
    assert!(exchange.complete());
    assert_eq!(exchange.receive(&first), Received::Late, "a duplicate");
    let answer = exchange.answer();
    assert!(answer.complete && answer.inputs_fresh);
    assert_eq!(answer.system_time, Some(0x0101_0101_0101_0101));
    assert_eq!(exchange.inputs(), [1; 24]);
    exchange.stage();
    // Two cycles after the one that was answered.
    assert_eq!(exchange.expected_time, 0x0101_0101_0101_0101 + 3_000_000);

    // The second comes after the third was sent.
    let third = reflect(&mut exchange, 0, 3);
    assert_eq!(exchange.receive(&second), Received::Current);
    assert!(exchange.answer().complete);
    assert_eq!(exchange.inputs(), [2; 24]);
    exchange.stage();

    // The third not within the fourth's cycle.
    let fourth = reflect(&mut exchange, 0, 4);
    let answer = exchange.answer();
    assert!(!answer.complete && !answer.inputs_fresh);
    assert_eq!(exchange.inputs(), [2; 24]);
    exchange.stage();
    reflect(&mut exchange, 0, 5);
    assert_eq!(exchange.receive(&third), Received::Late);
    assert_eq!(exchange.receive(&fourth), Received::Current);
    assert!(exchange.answer().complete);
    assert_eq!(exchange.inputs(), [4; 24]);
}

#[test]
fn an_answer_tells_how_late_its_frames_were_sent() {
    for (mode, expected) in [
        (Mode::SameCycle, [10, 20, 30]),
        (Mode::Pipelined, [0, 10, 20]),
    ] {
        let mut exchange = exchange(&[axis(0)], mode);
        for (late, expected) in [10, 20, 30].into_iter().zip(expected) {
            exchange
                .send(&mut Nowhere, late)
                .expect("nowhere takes all");
            assert_eq!(exchange.answer().sent_late, expected, "{mode:?}");
            exchange.stage();
        }
    }
}

#[test]
fn a_device_without_lrw_gets_and_gives_its_data_by_two_datagrams() {
    let without = ProcessData {
        out_len: 4,
        in_len: 6,
        lrw: false,
        ..axis(0)
    };
    let mut exchange = exchange(&[axis(0), without], Mode::SameCycle);
    exchange.outputs_mut().fill(0x77);
    exchange.stage();
    let sent = exchange.flights[0].frames()[0].bytes.clone();
    let commands: Vec<(u8, bool)> = exchange.forms[0]
        .process_data
        .iter()
        .map(|d| {
            (
                sent[d.place.offset],
                sent[d.place.data()].iter().all(|b| *b == 0x77),
            )
        })
        .collect();
    assert_eq!(commands, [(LRW, true), (LWR, true), (LRD, false)]);
    let answer = reflect(&mut exchange, 0, 0x11);
    assert_eq!(exchange.receive(&answer), Received::Current);
    let answer = exchange.answer();
    assert_eq!((answer.wkc, answer.inputs_fresh), ((5, 5), true));
    assert_eq!(exchange.inputs(), [0x11; 18]);
}

#[test]
fn a_wrong_working_counter_leaves_the_inputs_alone() {
    let mut exchange = axes(1);
    let mut frame = reflect(&mut exchange, 0, 0x11);
    let wkc = exchange.forms[0].process_data[0].place.data().end;
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
    for _ in 0..2 * Probe::ALL.len() {
        let turn = exchange.flights[0].turn.expect("there are members");
        let Look::At { device, probe } = turn.look else {
            panic!("nobody has a mailbox");
        };
        seen.push((device, probe as usize));
        let frame = reflect(&mut exchange, 0, 1);
        exchange.receive(&frame);
        exchange.answer();
        exchange.stage();
    }
    let expected: Vec<_> = (0..Probe::ALL.len())
        .flat_map(|p| [(0, p), (1, p)])
        .collect();
    assert_eq!(seen, expected);
    let found = exchange.diagnoses()[1];
    assert!(found.answers);
    assert_eq!((found.al_status, found.al_code), (1, 0x0101));
    assert_eq!(found.clock_difference, 0x0101_0101);
    let errors = ErrorCounters {
        invalid_frames: [1; 4],
        rx_errors: [1; 4],
        forwarded: [1; 4],
        processing: 1,
        pdi: 1,
        lost_links: [1; 4],
    };
    assert_eq!(found.errors, errors);
}

#[test]
fn the_status_of_mailboxes_comes_in_every_other_cycle_and_costs_no_more_than_a_probe() {
    let mut devices = vec![axis(0); 11];
    for device in &mut devices {
        device.mailbox = true;
    }
    let mut exchange = exchange(&devices, Mode::SameCycle);
    let sights = exchange.sights();
    let without = axes(11).frame_lengths().next().expect("a frame") - 18;
    for cycle in 0..8 {
        let frame = reflect(&mut exchange, 0, 0x08);
        assert!(frame.len() - without <= 20, "{}", frame.len());
        exchange.receive(&frame);
        exchange.answer();
        exchange.stage();
        // Eight of them in the second cycle, three in the fourth.
        let seen = |n: usize| sights.mailbox(n).is_some_and(|seen| seen.full);
        assert_eq!((seen(0), seen(7)), (cycle >= 1, cycle >= 1), "{cycle}");
        assert_eq!((seen(8), seen(10)), (cycle >= 3, cycle >= 3), "{cycle}");
    }
}

#[test]
fn large_images_take_several_frames() {
    let mut exchange = axes(300);
    assert_eq!(exchange.frame_lengths().count(), 3);
    assert!(exchange.frame_lengths().all(|len| len <= MAX_FRAME));
    for number in [2, 0, 1] {
        let frame = reflect(&mut exchange, number, 7);
        assert_eq!(exchange.receive(&frame), Received::Current);
    }
    assert!(exchange.answer().inputs_fresh);
}

proptest! {
    #[test]
    fn no_received_bytes_panic(mut frame in proptest::collection::vec(any::<u8>(), 0..1600), ours: bool) {
        let mut exchange = axes(3);
        if ours && frame.len() > 20 {
            let template = reflect(&mut exchange, 0, 0);
            let n = frame.len().min(30);
            frame[..n].copy_from_slice(&template[..n]);
        }
        exchange.receive(&frame);
        let _ = exchange.answer();
    }
}

/// 12 bytes a group; the rest of the machine is in none.
#[test]
fn each_group_has_a_working_counter_of_its_own() {
    let mut exchange = grouped(&[1, 0, 2, 1]);
    assert_eq!(
        exchange.forms[0].probe_at,
        axes(4).forms[0].probe_at + 2 * 12
    );
    let mut frame = reflect(&mut exchange, 0, 0x11);
    let of_first_group = exchange.forms[0].process_data[1].place.data().end;
    frame[of_first_group] = 4;
    assert_eq!(exchange.receive(&frame), Received::Current);
    let answer = exchange.answer();
    assert!(answer.complete && !answer.inputs_fresh);
    assert_eq!(answer.wkc, (10, 12));
    let shares: Vec<_> = exchange
        .shares()
        .iter()
        .map(|share| (share.answered, share.fresh, share.wkc))
        .collect();
    assert_eq!(
        shares,
        [
            (true, true, (3, 3)),
            (true, false, (4, 6)),
            (true, true, (3, 3))
        ]
    );
    let mut inputs = [0x11; 48];
    inputs[12..36].fill(0);
    assert_eq!(exchange.inputs(), inputs);
}

/// A clock that is missing with its group does not keep the others from their reference.
#[test]
fn the_system_time_is_the_reference_s_alone() {
    let mut exchange = grouped(&[0, 1]);
    exchange.shares[1].clocks = 1;
    let mut answer = |wkc: u8, fresh: bool| {
        exchange.stage();
        let mut frame = reflect(&mut exchange, 0, 1);
        let clock = exchange.forms[0].clock.expect("a clock").data().end;
        frame[clock] = wkc;
        let second = exchange.forms[0].process_data[1].place.data().end;
        frame[second] = if fresh { 3 } else { 0 };
        exchange.receive(&frame);
        exchange.answer().system_time.is_some()
    };
    assert!(answer(2, true), "both are there");
    assert!(!answer(1, true), "one is missing, and nobody knows which");
    assert!(answer(1, false), "it is the one whose group is missing");
    assert!(!answer(0, false));
}

/// Groups in frames of their own are lost with these alone.
#[test]
fn a_frame_that_is_lost_concerns_its_groups() {
    let groups: Vec<usize> = (0..200).map(|i| usize::from(i >= 100)).collect();
    let mut exchange = grouped(&groups);
    assert_eq!(exchange.frame_lengths().count(), 2);
    let frame = reflect(&mut exchange, 0, 7);
    exchange.receive(&frame);
    let answer = exchange.answer();
    assert!(!answer.complete && !answer.inputs_fresh);
    let [rest, second] = exchange.shares() else {
        panic!("two groups")
    };
    assert!(rest.fresh && !second.answered && !second.fresh);
}

/// After a wrong counter that devices share, each has a datagram and so evidence of its own, until all have been right for long.
#[test]
fn a_missing_device_leaves_the_evidence_of_the_others_alone() {
    for mode in [Mode::SameCycle, Mode::Pipelined] {
        let mut exchange = exchange(&[axis(0); 3], mode);
        exchange.expect_op(true);
        let missing_second = |exchange: &mut Exchange, input: u8| {
            let mut frame = reflect(exchange, 0, input);
            let form = exchange.flights[exchange.staged].form;
            let at = exchange.forms[form].process_data[form].place.data().end;
            frame[at] = if form == 0 { 6 } else { 0 };
            assert_eq!(exchange.receive(&frame), Received::Current);
            exchange.answer();
            let evidence = exchange.evidence().to_vec();
            exchange.stage();
            evidence
        };
        let unknown = [Evidence::Unknown; 3];
        let first = missing_second(&mut exchange, 1);
        if mode == Mode::SameCycle {
            assert_eq!(first, unknown);
        } else {
            assert_eq!(first, [Evidence::Missing; 3], "nothing was asked before");
            assert_eq!(missing_second(&mut exchange, 1), unknown);
            assert_eq!(missing_second(&mut exchange, 1), unknown);
        }
        let own = [Evidence::Fresh, Evidence::Missing, Evidence::Fresh];
        for _ in 0..300 {
            assert_eq!(missing_second(&mut exchange, 2), own);
        }
        assert_eq!(exchange.inputs()[..12], [2; 12]);
        // Back, and after a while with shared datagrams again.
        for cycle in 0..=SEPARATE_CYCLES + 2 {
            let frame = reflect(&mut exchange, 0, 3);
            assert_eq!(exchange.receive(&frame), Received::Current);
            exchange.answer();
            if cycle > 1 {
                assert_eq!(exchange.evidence(), [Evidence::Fresh; 3]);
            }
            exchange.stage();
        }
        assert_eq!(exchange.flights[exchange.staged].form, 0);
    }
}

#[test]
fn a_late_answer_proves_delivery_and_an_old_one_nothing() {
    let mut exchange = axes(2);
    let first = reflect(&mut exchange, 0, 1);
    exchange.answer();
    assert_eq!(exchange.evidence(), [Evidence::Missing; 2]);
    exchange.stage();
    assert!(!exchange.came_late(0));
    assert_eq!(exchange.receive(&first), Received::Late);
    assert!(exchange.came_late(0) && exchange.came_late(1));
    exchange.stage();
    assert!(!exchange.came_late(0), "it is of one cycle");
    // Of a device that did not take part, or of another frame.
    let mut without = reflect(&mut exchange, 0, 1);
    let wkc = exchange.forms[0].process_data[0].place.data().end;
    without[wkc] = 3;
    exchange.stage();
    assert_eq!(exchange.receive(&without), Received::Late);
    assert!(!exchange.came_late(0));
    for cut in 0..first.len() {
        exchange.receive(&first[..cut]);
    }
    for _ in 0..10 {
        exchange.stage();
    }
    assert_eq!(exchange.receive(&first), Received::Late);
    assert!(!exchange.came_late(0), "too old");
}

/// The number of a cycle is longer than the index of a datagram.
#[test]
fn an_answer_256_cycles_old_is_late() {
    let mut exchange = axes(2);
    let first = reflect(&mut exchange, 0, 1);
    for _ in 0..256 {
        exchange.stage();
        exchange.send(&mut Nowhere, 0).expect("nowhere takes all");
    }
    assert_eq!(exchange.receive(&first), Received::Late);
    assert!(!exchange.answer().inputs_fresh);
}
