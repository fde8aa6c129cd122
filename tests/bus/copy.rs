//! `[[copy]]`: inputs that become outputs of another device, on the whole bus.

use std::sync::{Arc, Mutex};

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::config::Machine;
use ecaxis_master::session::{Options, Outcome, run_on};
use ecaxis_sim::{AlState, Segment};
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::wire::{WatchedBus, Watcher, miss_working_counter};
use ecaxis_test_support::{Heard, faults, run_well, virtual_time};

/// An I/O device with two input words and two output words, in two PDOs each.
pub(crate) const WORDS: &str = r##"<?xml version="1.0" encoding="UTF-8"?>
<EtherCATInfo><Vendor><Id>#x00000E0B</Id><Name>ecaxis demonstration devices, second vendor</Name></Vendor>
<Descriptions><Groups><Group><Type>IO</Type><Name>I/O blocks</Name></Group></Groups><Devices>
<Device Physics="YY"><Type ProductCode="#x57440002" RevisionNo="#x00010000">WD2</Type>
<Name>2 words in, 2 words out</Name><GroupType>IO</GroupType>
<Fmmu>Outputs</Fmmu><Fmmu>Inputs</Fmmu>
<Sm DefaultSize="5" StartAddress="#x1000" ControlByte="#x44" Enable="1">Outputs</Sm>
<Sm DefaultSize="5" StartAddress="#x1100" ControlByte="#x00" Enable="1">Inputs</Sm>
<RxPdo Fixed="1" Mandatory="1" Sm="0"><Index>#x1600</Index><Name>First outputs</Name>
<Entry><Index>#x7000</Index><SubIndex>1</SubIndex><BitLen>16</BitLen><Name>Output word 1</Name><DataType>UINT</DataType></Entry>
<Entry><Index>0</Index><BitLen>3</BitLen></Entry></RxPdo>
<RxPdo Fixed="1" Mandatory="1" Sm="0"><Index>#x1601</Index><Name>More outputs</Name>
<Entry><Index>#x7000</Index><SubIndex>2</SubIndex><BitLen>16</BitLen><Name>Output word 2</Name><DataType>UINT</DataType></Entry></RxPdo>
<TxPdo Fixed="1" Mandatory="1" Sm="1"><Index>#x1A00</Index><Name>First inputs</Name>
<Entry><Index>#x6000</Index><SubIndex>1</SubIndex><BitLen>16</BitLen><Name>Input word 1</Name><DataType>UINT</DataType></Entry></TxPdo>
<TxPdo Fixed="1" Mandatory="1" Sm="1"><Index>#x1A01</Index><Name>More inputs</Name>
<Entry><Index>0</Index><BitLen>5</BitLen></Entry>
<Entry><Index>#x6000</Index><SubIndex>2</SubIndex><BitLen>16</BitLen><Name>Input word 2</Name><DataType>UINT</DataType></Entry></TxPdo>
<Eeprom><ByteSize>2048</ByteSize><ConfigData>0401000000000000000000000000</ConfigData></Eeprom>
</Device></Devices></Descriptions></EtherCATInfo>
"##;

/// The target is the first device, so that it stays reachable without the source.
fn machine(bus: &str, copies: &str) -> Machine {
    let bench = Bench::new();
    bench.write("words.xml", WORDS);
    let device = |name: &str, position: usize| {
        format!("[[device]]\nname = \"{name}\"\nesi = \"words.xml\"\nposition = {position}\n")
    };
    let text = format!(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n{bus}\n{}{}{copies}[[step]]\ndwell = \"1s\"\n",
        device("target", 0),
        device("source", 1),
    );
    bench.machine(&text)
}

const WORD_1: &str = "[[copy]]\nfrom = \"source.Input word 1\"\nto = \"target.Output word 1\"\n";

/// One cycle: what the source showed, what the target had received behind the frame, and whether
/// the answer of the frame was right.
#[derive(Debug, Clone, Copy)]
struct Cycle {
    shown: [u16; 2],
    received: [u16; 2],
    target: AlState,
    source_answers: bool,
}

/// Shows other inputs in every cycle and records what arrives. `wrong` judges each answer.
struct Recorder<F> {
    cycles: Arc<Mutex<Vec<Cycle>>>,
    wrong: F,
}

fn output_words(segment: &Segment) -> [u16; 2] {
    let bytes = segment.device(0).expect("the target").outputs();
    let bits = bytes
        .iter()
        .rev()
        .fold(0_u64, |all, &b| all << 8 | u64::from(b));
    // A gap of three bits separates the words.
    [bits as u16, (bits >> 19) as u16]
}

impl<F: FnMut(usize, &mut [u8]) -> Option<bool> + Send> Watcher for Recorder<F> {
    fn before(&mut self, segment: &mut Segment) {
        let mut cycles = self.cycles.lock().expect("no panic");
        let n = cycles.len() as u16;
        let shown = [n.wrapping_mul(3), n.wrapping_mul(0x0101)];
        let source = segment.device_mut(1).expect("the source");
        for (sub, value) in (1..).zip(shown) {
            assert!(source.set_input(0x6000, sub, value.into()));
        }
        cycles.push(Cycle {
            shown,
            received: [0; 2],
            target: AlState::Init,
            source_answers: true,
        });
    }

    fn after(&mut self, segment: &mut Segment) {
        let mut cycles = self.cycles.lock().expect("no panic");
        let cycle = cycles.last_mut().expect("it has begun");
        cycle.received = output_words(segment);
        cycle.target = segment.device(0).expect("the target").al_state();
    }

    fn answer(&mut self, frame: &mut [u8]) -> bool {
        let mut cycles = self.cycles.lock().expect("no panic");
        let number = cycles.len() - 1;
        let right = (self.wrong)(number, frame);
        if let Some(cycle) = cycles.last_mut() {
            cycle.source_answers = right == Some(true);
        }
        right.is_some()
    }
}

/// Runs the machine. `judge` returns `None` for an answer that is lost, and false after it has
/// falsified the answer of the source.
fn record(
    machine: Machine,
    options: Options,
    judge: impl FnMut(usize, &mut [u8]) -> Option<bool> + Send + 'static,
) -> (Outcome, Vec<Cycle>) {
    let cycles = Arc::<Mutex<Vec<Cycle>>>::default();
    let recorder = Recorder {
        cycles: Arc::clone(&cycles),
        wrong: judge,
    };
    let link = Box::new(WatchedBus::new(&machine, &options, recorder));
    let mut heard = Heard::default();
    let stop = Arc::<CancelToken>::default();
    let outcome = run_on(link, machine, options, stop, &mut heard);
    let cycles = std::mem::take(&mut *cycles.lock().expect("no panic"));
    (outcome, cycles)
}

fn in_op(cycles: &[Cycle]) -> std::ops::Range<usize> {
    let first = cycles.iter().position(|c| c.target == AlState::Op);
    let last = cycles.iter().rposition(|c| c.target == AlState::Op);
    first.expect("it was in Op")..last.expect("it was in Op") + 1
}

/// ETG.1500, feature 1201: the MainDevice copies within at most two cycles. The first outputs in Op
/// are already the inputs of the cycle before; every later one follows.
#[test]
fn a_value_arrives_one_cycle_later_or_two_with_a_pipelined_exchange() {
    let copies =
        format!("{WORD_1}[[copy]]\nfrom = \"source.0x6000:02\"\nto = \"target.pdo.0x1601\"\n");
    for (exchange, delay) in [("same-cycle", 1), ("pipelined", 2)] {
        let machine = machine(&format!("exchange = \"{exchange}\""), &copies);
        let (outcome, cycles) = record(machine, virtual_time(), |_, _| Some(true));
        outcome.result.expect("runs");
        let in_op = in_op(&cycles);
        assert!(in_op.len() > 900, "{in_op:?}");
        // It begins in SafeOp.
        let safe_op = cycles.iter().position(|c| c.target == AlState::SafeOp);
        let first = safe_op.expect("it was in SafeOp") + 5;
        assert!(first < in_op.start, "{first}, {in_op:?}");
        for n in first..in_op.end {
            assert_eq!(
                cycles[n].received,
                cycles[n - delay].shown,
                "{exchange}, cycle {n}"
            );
        }
    }
}

/// ETG.1500, feature 1201: the copied parts are configured. Whole PDOs and byte ranges have the
/// same bits, gaps included.
#[test]
fn copies_of_bytes_and_pdos_are_exact() {
    let copies = "[[copy]]\nfrom = \"source.bytes.0..2\"\nto = \"target.bytes.0..2\"\n";
    let machine = machine("", copies);
    let (outcome, cycles) = record(machine, virtual_time(), |_, _| Some(true));
    outcome.result.expect("runs");
    for n in in_op(&cycles) {
        assert_eq!(cycles[n].received, [cycles[n - 1].shown[0], 0], "cycle {n}");
    }
}

/// The model of a target: it has the inputs of the last cycle in which the source answered.
#[track_caller]
fn assert_held(cycles: &[Cycle]) -> usize {
    let in_op = in_op(cycles);
    let mut expected = cycles[in_op.start].received[0];
    let mut held = 0;
    for n in in_op.start + 1..in_op.end {
        if cycles[n - 1].source_answers {
            expected = cycles[n - 1].shown[0];
        } else {
            held += 1;
        }
        assert_eq!(cycles[n].received[0], expected, "cycle {n}");
    }
    held
}

/// ETG.1000.4, working counter: inputs are new only if their datagram came back with the expected
/// counter. Otherwise the target keeps its value.
#[test]
fn the_target_holds_its_value_while_answers_are_lost() {
    let machine = machine("lost_frames = 20", WORD_1);
    let lost = |n: usize, _: &mut [u8]| (n < 300 || n % 50 >= 7).then_some(true);
    let (outcome, cycles) = record(machine, virtual_time(), lost);
    outcome.result.expect("runs");
    let held = assert_held(&cycles);
    assert!(held > 50, "{held}");
}

/// ETG.1000.4, working counter, as above. The first wrong counter is that of the datagram that both
/// devices share, the next ones are the source's own.
#[test]
fn the_target_holds_its_value_while_the_working_counter_of_the_source_is_wrong() {
    let machine = machine("lost_frames = 20", WORD_1);
    let own = Arc::new(Mutex::new(0));
    let counted = Arc::clone(&own);
    let wrong = move |n: usize, frame: &mut [u8]| {
        if n < 300 || n % 50 >= 7 {
            return Some(true);
        }
        // With separate datagrams, the source's is the second.
        let all = miss_working_counter(&mut frame.to_vec(), 0);
        *counted.lock().expect("no panic") += all - 1;
        miss_working_counter(frame, all - 1);
        Some(false)
    };
    let (outcome, cycles) = record(machine, virtual_time(), wrong);
    outcome.result.expect("runs");
    let held = assert_held(&cycles);
    let own = *own.lock().expect("no panic");
    assert!(held > 50 && own > 40, "{held}, {own}");
    assert!(outcome.summary.expect("a summary").counters.wkc_errors > 50);
}

/// A wrong working counter of the target alone does not hold the value.
#[test]
fn the_working_counter_of_the_target_does_not_matter() {
    let machine = machine("lost_frames = 20", WORD_1);
    let wrong = move |n: usize, frame: &mut [u8]| {
        let wrong = n >= 300 && n % 50 < 7;
        let shared = wrong && miss_working_counter(frame, 0) == 1;
        Some(!shared)
    };
    let (outcome, cycles) = record(machine, virtual_time(), wrong);
    outcome.result.expect("runs");
    let held = assert_held(&cycles);
    assert!((1..5).contains(&held), "{held}");
}

/// ETG.1000.4, working counter, as above.
#[test]
fn the_target_holds_its_value_when_the_source_disappears() {
    let machine = machine("lost_frames = 150\nwatchdog = \"1s\"", WORD_1);
    let script = "[[fault]]\nkind = \"absent\"\ndevice = 1\nat = \"800ms\"\n";
    let (outcome, cycles) = record(machine, faults(script), |_, _| Some(true));
    let error = outcome.result.expect_err("a device is missing").to_string();
    assert!(error.contains("`source`"), "{error}");
    let in_op = in_op(&cycles);
    let last = cycles[in_op.end - 1].received[0];
    let moving = in_op.clone().rev().find(|&n| cycles[n].received[0] != last);
    let held = in_op.end - moving.expect("it changed before");
    assert!(held >= 150, "{held} cycles");
    // The held value is the last that the source has shown.
    let shown = cycles[in_op].iter().any(|c| c.shown[0] == last);
    assert!(shown && last != 0, "{last}");
}

/// The simulated I/O devices show their outputs as inputs, so a value travels back and forth.
#[test]
fn the_sample_runs() {
    run_well(ecaxis_test_support::load("copy.toml"), virtual_time());
}
