use super::*;
use crate::link::MAX_FRAME;
use crate::rt::image::{ProcessData, plan};
use ecaxis_ecat::datagram::Command;
use ecaxis_ecat::index::{DeviceIndex, GroupIndex};
use proptest::prelude::*;

use super::frame::FIRST_DATAGRAM;

/// A link that discards all frames.
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

/// Sends the cycle's frames and returns the answer to frame `number`, as if all SubDevices were
/// present.
pub(super) fn reflect(exchange: &mut Exchange, number: usize, input: u8) -> Vec<u8> {
    exchange.send(&mut Nowhere, 0).expect("nowhere takes all");
    let sent = &exchange.frame_sets[exchange.staged];
    let system_time = sent.sent_at + 0x7777_7777;
    let mut frame = sent.frames()[number].bytes.clone();
    frame[6] |= 0x02;
    let mut at = FIRST_DATAGRAM;
    while at + DATAGRAM_HEADER <= frame.len() {
        let len = usize::from(u16::from_le_bytes([frame[at + 6], frame[at + 7] & 7]));
        let data = at + DATAGRAM_HEADER;
        let layout = exchange.frame_sets[exchange.staged].layout;
        let expected = exchange.layouts[layout]
            .process_data
            .iter()
            .find(|d| (d.slot.frame, d.slot.offset) == (number, at));
        let wkc = expected.map_or(1, |d| d.expected_wkc);
        match Command(frame[at]) {
            Command::LWR => {}
            Command::FRMW => frame[data..data + len].copy_from_slice(&system_time.to_le_bytes()),
            _ => frame[data..data + len].fill(input),
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
        group: GroupIndex(group),
        lrw: true,
        mailbox: false,
        op_only: Default::default(),
    }
}

fn axes(count: usize) -> Exchange {
    exchange(&vec![axis(0); count], ExchangeMode::SameCycle)
}

/// Creates an exchange with one axis in each of the groups.
fn grouped(groups: &[usize]) -> Exchange {
    let devices: Vec<_> = groups.iter().map(|&group| axis(group)).collect();
    exchange(&devices, ExchangeMode::SameCycle)
}

/// Creates an exchange; the first device has a clock.
fn exchange(devices: &[ProcessData], mode: ExchangeMode) -> Exchange {
    exchange_with(devices, 1, mode)
}

/// Creates an exchange of axes that all have a clock.
pub(super) fn clocks(count: usize, mode: ExchangeMode) -> Exchange {
    exchange_with(&vec![axis(0); count], count, mode)
}

fn exchange_with(devices: &[ProcessData], clocks: usize, mode: ExchangeMode) -> Exchange {
    let plan = plan(devices).expect("fits");
    let members: Vec<_> = (0..devices.len())
        .map(|i| ExchangeDevice {
            station: 0x1000 + i as u16,
            clock: i < clocks,
            mailbox: None,
        })
        .collect();
    let clock = ClockPlan {
        reference: 0x1000,
        cycle_ns: 1_000_000,
        release: 0,
        release_at: 0,
        window_ns: 10_000,
        sync0: 0,
        align: false,
    };
    Exchange::new(&plan, Some(&clock), &members, mode)
}

#[test]
fn frame_bytes_for_8_32_and_100_axes() {
    for (count, cyclic) in [(8, 158), (32, 446), (100, 1262)] {
        let exchange = axes(count);
        let lengths: Vec<_> = exchange.frame_lengths().collect();
        assert_eq!(lengths.len(), 1, "{count} axes in one frame");
        assert_eq!(exchange.layouts[0].diagnostic_at, cyclic);
        assert!(
            lengths[0] <= cyclic + 20,
            "the diagnostic datagram takes at most 20 bytes"
        );
    }
}

#[test]
fn exchange_accepts_an_answer_once_and_only_in_its_cycle() {
    let mut exchange = axes(2);
    let first = reflect(&mut exchange, 0, 0x5a);
    assert_eq!(exchange.receive(&first), Received::Current);
    assert!(exchange.complete());
    assert_eq!(exchange.receive(&first), Received::Late, "a duplicate");
    let answer = exchange.evaluate();
    assert!(answer.complete && answer.inputs_fresh);
    assert_eq!(answer.wkc, (6, 6));
    assert_eq!(answer.system_time, Some(answer.sent_at + 0x7777_7777));
    assert_eq!(answer.al_status, Some((0x5a, 1)));
    assert_eq!(exchange.inputs(), [0x5a; 24]);

    exchange.stage();
    assert_eq!(
        exchange.receive(&first),
        Received::Late,
        "an answer of the cycle before"
    );
    assert!(!exchange.evaluate().complete);
}

#[test]
fn pipelined_answers_are_evaluated_in_the_next_cycle() {
    let mut exchange = exchange(&[axis(0); 2], ExchangeMode::Pipelined);
    let first = reflect(&mut exchange, 0, 1);
    assert!(!exchange.complete(), "nothing was asked before");
    // It comes back at once but is evaluated in the next cycle.
    assert_eq!(exchange.receive(&first), Received::Current);
    assert!(!exchange.evaluate().complete);
    assert_eq!(exchange.inputs(), [0; 24]);
    exchange.stage();

    let second = reflect(&mut exchange, 0, 2);
    assert!(exchange.complete());
    assert_eq!(exchange.receive(&first), Received::Late, "a duplicate");
    let answer = exchange.evaluate();
    assert!(answer.complete && answer.inputs_fresh);
    assert_eq!(answer.system_time, Some(answer.sent_at + 0x7777_7777));
    assert_eq!(exchange.inputs(), [1; 24]);
    exchange.stage();

    // The second answer arrives after the third cycle was sent.
    let third = reflect(&mut exchange, 0, 3);
    assert_eq!(exchange.receive(&second), Received::Current);
    assert!(exchange.evaluate().complete);
    assert_eq!(exchange.inputs(), [2; 24]);
    exchange.stage();

    // The third answer does not arrive within the fourth cycle.
    let fourth = reflect(&mut exchange, 0, 4);
    let answer = exchange.evaluate();
    assert!(!answer.complete && !answer.inputs_fresh);
    assert_eq!(exchange.inputs(), [2; 24]);
    exchange.stage();
    reflect(&mut exchange, 0, 5);
    assert_eq!(exchange.receive(&third), Received::Late);
    assert_eq!(exchange.receive(&fourth), Received::Current);
    assert!(exchange.evaluate().complete);
    assert_eq!(exchange.inputs(), [4; 24]);
}

#[test]
fn cycle_result_contains_the_send_delay() {
    for (mode, expected) in [
        (ExchangeMode::SameCycle, [10, 20, 30]),
        (ExchangeMode::Pipelined, [0, 10, 20]),
    ] {
        let mut exchange = exchange(&[axis(0)], mode);
        for (late, expected) in [10, 20, 30].into_iter().zip(expected) {
            exchange
                .send(&mut Nowhere, late)
                .expect("nowhere takes all");
            assert_eq!(exchange.evaluate().sent_late, expected, "{mode:?}");
            exchange.stage();
        }
    }
}

#[test]
fn device_without_lrw_exchanges_data_in_two_datagrams() {
    let without = ProcessData {
        out_len: 4,
        in_len: 6,
        lrw: false,
        ..axis(0)
    };
    let mut exchange = exchange(&[axis(0), without], ExchangeMode::SameCycle);
    exchange.outputs_mut().fill(0x77);
    exchange.stage();
    let sent = exchange.frame_sets[0].frames()[0].bytes.clone();
    let commands: Vec<(u8, bool)> = exchange.layouts[0]
        .process_data
        .iter()
        .map(|d| {
            (
                sent[d.slot.offset],
                sent[d.slot.data()].iter().all(|b| *b == 0x77),
            )
        })
        .collect();
    assert_eq!(
        commands,
        [
            (Command::LRW.0, true),
            (Command::LWR.0, true),
            (Command::LRD.0, false)
        ]
    );
    let answer = reflect(&mut exchange, 0, 0x11);
    assert_eq!(exchange.receive(&answer), Received::Current);
    let answer = exchange.evaluate();
    assert_eq!((answer.wkc, answer.inputs_fresh), ((5, 5), true));
    assert_eq!(exchange.inputs(), [0x11; 18]);
}

#[test]
fn wrong_working_counter_keeps_the_last_inputs() {
    let mut exchange = axes(1);
    let mut frame = reflect(&mut exchange, 0, 0x11);
    let wkc = exchange.layouts[0].process_data[0].slot.data().end;
    frame[wkc] = 2;
    assert_eq!(exchange.receive(&frame), Received::Current);
    let answer = exchange.evaluate();
    assert!(answer.complete && !answer.inputs_fresh);
    assert_eq!(answer.wkc, (2, 3));
    assert_eq!(exchange.inputs(), [0; 12]);
}

#[test]
fn diagnostic_slot_reads_all_registers_of_all_devices() {
    let mut exchange = axes(2);
    let mut seen = Vec::new();
    for _ in 0..2 * DiagnosticRegister::ALL.len() {
        let poll = exchange.frame_sets[0].poll.expect("there are members");
        let PollTarget::Registers { device, block } = poll.target else {
            panic!("no device has a mailbox");
        };
        seen.push((device.0, block as usize));
        let frame = reflect(&mut exchange, 0, 1);
        exchange.receive(&frame);
        exchange.evaluate();
        exchange.stage();
    }
    let expected: Vec<_> = (0..DiagnosticRegister::ALL.len())
        .flat_map(|p| [(0, p), (1, p)])
        .collect();
    assert_eq!(seen, expected);
    let found = exchange.diagnoses()[DeviceIndex(1)];
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
fn mailbox_status_is_read_every_other_cycle_at_the_cost_of_a_diagnostic_read() {
    let mut devices = vec![axis(0); 11];
    for device in &mut devices {
        device.mailbox = true;
    }
    let mut exchange = exchange(&devices, ExchangeMode::SameCycle);
    let bus_status = exchange.bus_status();
    let without = axes(11).frame_lengths().next().expect("a frame") - 18;
    for cycle in 0..8 {
        let frame = reflect(&mut exchange, 0, 0x08);
        assert!(frame.len() - without <= 20, "{}", frame.len());
        exchange.receive(&frame);
        exchange.evaluate();
        exchange.stage();
        // Eight mailboxes in the second cycle, three in the fourth.
        let seen = |n: usize| {
            bus_status
                .mailbox(DeviceIndex(n))
                .is_some_and(|seen| seen.full)
        };
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
    assert!(exchange.evaluate().inputs_fresh);
}

proptest! {
    #[test]
    fn receive_never_panics(mut frame in proptest::collection::vec(any::<u8>(), 0..1600), ours: bool) {
        let mut exchange = axes(3);
        if ours && frame.len() > 20 {
            let template = reflect(&mut exchange, 0, 0);
            let n = frame.len().min(30);
            frame[..n].copy_from_slice(&template[..n]);
        }
        exchange.receive(&frame);
        let _ = exchange.evaluate();
    }
}

/// 12 bytes per group; the rest of the machine is in no group.
#[test]
fn each_group_has_its_own_working_counter() {
    let mut exchange = grouped(&[1, 0, 2, 1]);
    assert_eq!(
        exchange.layouts[0].diagnostic_at,
        axes(4).layouts[0].diagnostic_at + 2 * 12
    );
    let mut frame = reflect(&mut exchange, 0, 0x11);
    let of_first_group = exchange.layouts[0].process_data[1].slot.data().end;
    frame[of_first_group] = 4;
    assert_eq!(exchange.receive(&frame), Received::Current);
    let answer = exchange.evaluate();
    assert!(answer.complete && !answer.inputs_fresh);
    assert_eq!(answer.wkc, (10, 12));
    let group_results: Vec<_> = exchange
        .group_results()
        .iter()
        .map(|group| (group.answered, group.fresh, group.wkc))
        .collect();
    assert_eq!(
        group_results,
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

/// A lost frame affects only the groups in it.
#[test]
fn lost_frame_affects_only_its_groups() {
    let groups: Vec<usize> = (0..200).map(|i| usize::from(i >= 100)).collect();
    let mut exchange = grouped(&groups);
    assert_eq!(exchange.frame_lengths().count(), 2);
    let frame = reflect(&mut exchange, 0, 7);
    exchange.receive(&frame);
    let answer = exchange.evaluate();
    assert!(!answer.complete && !answer.inputs_fresh);
    let [rest, second] = **exchange.group_results() else {
        panic!("two groups")
    };
    assert!(rest.fresh && !second.answered && !second.fresh);
}

/// After a wrong shared counter, each device has its own datagram, until all were right for long
/// enough.
#[test]
fn missing_device_does_not_change_the_answers_of_others() {
    for mode in [ExchangeMode::SameCycle, ExchangeMode::Pipelined] {
        let mut exchange = exchange(&[axis(0); 3], mode);
        exchange.expect_op(true);
        let missing_second = |exchange: &mut Exchange, input: u8| {
            let mut frame = reflect(exchange, 0, input);
            let layout = exchange.frame_sets[exchange.staged].layout;
            let at = exchange.layouts[layout].process_data[layout]
                .slot
                .data()
                .end;
            frame[at] = if layout == 0 { 6 } else { 0 };
            assert_eq!(exchange.receive(&frame), Received::Current);
            exchange.evaluate();
            let device_answers = exchange.device_answers().to_vec();
            exchange.stage();
            device_answers
        };
        let unknown = [DeviceAnswer::Unknown; 3];
        let first = missing_second(&mut exchange, 1);
        if mode == ExchangeMode::SameCycle {
            assert_eq!(first, unknown);
        } else {
            assert_eq!(
                first,
                [DeviceAnswer::Missing; 3],
                "nothing was asked before"
            );
            assert_eq!(missing_second(&mut exchange, 1), unknown);
            assert_eq!(missing_second(&mut exchange, 1), unknown);
        }
        let own = [
            DeviceAnswer::Fresh,
            DeviceAnswer::Missing,
            DeviceAnswer::Fresh,
        ];
        for _ in 0..300 {
            assert_eq!(missing_second(&mut exchange, 2), own);
        }
        assert_eq!(exchange.inputs()[..12], [2; 12]);
        // The device is back; after a while the datagrams are shared again.
        for cycle in 0..=SEPARATE_CYCLES + 2 {
            let frame = reflect(&mut exchange, 0, 3);
            assert_eq!(exchange.receive(&frame), Received::Current);
            exchange.evaluate();
            if cycle > 1 {
                assert_eq!(**exchange.device_answers(), [DeviceAnswer::Fresh; 3]);
            }
            exchange.stage();
        }
        assert_eq!(exchange.frame_sets[exchange.staged].layout, 0);
    }
}

#[test]
fn late_answer_proves_delivery_but_an_old_one_does_not() {
    let mut exchange = axes(2);
    let first = reflect(&mut exchange, 0, 1);
    exchange.evaluate();
    assert_eq!(**exchange.device_answers(), [DeviceAnswer::Missing; 2]);
    exchange.stage();
    assert_eq!(exchange.delivery(DeviceIndex(0)), Delivery::Unknown);
    assert_eq!(exchange.receive(&first), Received::Late);
    for device in [0, 1].map(DeviceIndex) {
        assert_eq!(exchange.delivery(device), Delivery::Earlier);
    }
    exchange.stage();
    assert_eq!(
        exchange.delivery(DeviceIndex(0)),
        Delivery::Unknown,
        "it is of one cycle"
    );
    // An answer of a device that did not process it, or of another frame.
    let mut without = reflect(&mut exchange, 0, 1);
    let wkc = exchange.layouts[0].process_data[0].slot.data().end;
    without[wkc] = 3;
    exchange.stage();
    assert_eq!(exchange.receive(&without), Received::Late);
    assert_eq!(exchange.delivery(DeviceIndex(0)), Delivery::Unknown);
    for cut in 0..first.len() {
        exchange.receive(&first[..cut]);
    }
    for _ in 0..10 {
        exchange.stage();
    }
    assert_eq!(exchange.receive(&first), Received::Late);
    assert_eq!(
        exchange.delivery(DeviceIndex(0)),
        Delivery::Unknown,
        "too old"
    );
}

/// A device that the frame did not reach leaves its place as it was sent.
#[test]
fn wrong_shared_counter_shows_which_devices_took_their_outputs() {
    let mut exchange = axes(3);
    exchange.expect_op(true);
    exchange.outputs_mut().fill(7);
    exchange.refresh_outputs();
    let data = exchange.layouts[0].process_data[0].slot.data();
    let mut frame = reflect(&mut exchange, 0, 1);
    frame[data.start + 12..data.start + 24].fill(7);
    frame[data.end] = 6;
    assert_eq!(exchange.receive(&frame), Received::Current);
    exchange.evaluate();
    assert_eq!(**exchange.device_answers(), [DeviceAnswer::Unknown; 3]);
    let delivery = |n| exchange.delivery(DeviceIndex(n));
    let expected = [Delivery::Now, Delivery::Unknown, Delivery::Now];
    assert_eq!([0, 1, 2].map(delivery), expected);
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
    assert!(!exchange.evaluate().inputs_fresh);
}

/// The exchange itself copies: outputs follow the inputs when the next frames are staged.
#[test]
fn copies_and_repeats_are_in_the_next_frames() {
    let device = axis(0);
    let mut plan = plan(&[device; 2]).expect("fits");
    let source = DeviceIndex(1);
    plan.copies = vec![(
        source,
        BitCopy {
            from: 12 * 8,
            to: 8,
            bits: 12,
        },
    )];
    plan.repeats = vec![BitCopy {
        from: 8,
        to: 50,
        bits: 12,
    }];
    let members = [1, 2].map(|station| ExchangeDevice {
        station,
        clock: true,
        mailbox: None,
    });
    let clock = ClockPlan {
        reference: 1,
        cycle_ns: 1_000_000,
        release: 0,
        release_at: 0,
        window_ns: 10_000,
        sync0: 0,
        align: false,
    };
    let mut exchange = Exchange::new(&plan, Some(&clock), &members, ExchangeMode::SameCycle);
    exchange.outputs_mut().fill(0xff);
    let answer = reflect(&mut exchange, 0, 0xa5);
    assert_eq!(exchange.receive(&answer), Received::Current);
    assert!(exchange.evaluate().inputs_fresh);
    exchange.stage();
    let outputs = exchange.outputs_mut().to_vec();
    // 0x5a5 from bit 8, and again from bit 50; all other bits are unchanged.
    let image = outputs
        .iter()
        .take(8)
        .rev()
        .fold(0_u64, |all, &byte| all << 8 | u64::from(byte));
    let expected = !(0xfff << 8 | 0xfff << 50) | 0x5a5 << 8 | 0x5a5 << 50;
    assert_eq!(image, expected, "{image:#018x}");

    // Without an answer, a copy holds its value. Outputs are repeated all the same.
    exchange.outputs_mut()[1] = 0x11;
    exchange.send(&mut Nowhere, 0).expect("nowhere takes all");
    exchange.evaluate();
    exchange.stage();
    assert_eq!(exchange.outputs_mut()[1], 0x11);
    assert_eq!(exchange.outputs_mut()[6] >> 2, 0x11 & 0x3f);
}

/// ETG.1000.4, FPWR and NOP: without an offset, no device processes the datagram.
#[test]
fn offset_is_written_to_the_reference_clock_only_if_it_is_known() {
    let plan = plan(&[axis(0)]).expect("fits");
    let members = [ExchangeDevice {
        station: 0x1000,
        clock: true,
        mailbox: None,
    }];
    let clock = ClockPlan {
        reference: 0x1000,
        cycle_ns: 1_000_000,
        release: 0,
        release_at: 0,
        window_ns: 10_000,
        sync0: 0,
        align: true,
    };
    let mut exchange = Exchange::new(&plan, Some(&clock), &members, ExchangeMode::SameCycle);
    let slot = exchange.layouts[0].clock_offset.expect("aligns");
    for (offset, command, station) in [(None, 0, 0), (Some(0x1122_3344_5566_7788), 5, 0x1000)] {
        exchange.set_reference_offset(offset);
        exchange.stage();
        let mut frame = reflect(&mut exchange, 0, 0);
        let staged = &exchange.frame_sets[exchange.staged].frames()[0].bytes;
        let sent = &staged[slot.offset..];
        assert_eq!(sent[0], command);
        assert_eq!(u16::from_le_bytes([sent[2], sent[3]]), station);
        assert_eq!(sent[4..6], [0x20, 0x09]);
        assert_eq!(sent[10..18], offset.unwrap_or(0).to_le_bytes());
        frame[slot.data().end] = u8::from(offset.is_some());
        exchange.receive(&frame);
        assert_eq!(exchange.evaluate().offset_taken, offset.is_some());
    }
}
