//! Cable redundancy: a ring of drives in motion, with broken cables.

use std::sync::{Arc, Mutex};

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock;
use ecaxis_master::config::{AxisRef, Machine};
use ecaxis_master::link::filter::LinkStats;
use ecaxis_master::link::redundant::{End, RedundantLink, RingEnds};
use ecaxis_master::link::sim::{SimLink, SimRing};
use ecaxis_master::link::{LinkError, MAX_FRAME};
use ecaxis_master::rt::controller::{Controller, CycleContext};
use ecaxis_master::session::{Options, Progress, run_on, run_with, simulated_bus};
use ecaxis_sim::SecondPort;
use ecaxis_test_support::{Heard, axes, faults, machine, run, virtual_time};

use super::returns::{line_text, returned};

const DRIVES: usize = 8;
const CYCLE_NS: u64 = 1_000_000;
/// The phases of the cycle at which cables break.
const PHASES: u64 = 50;

fn ring() -> Machine {
    let one = "nic = \"sim\"\n";
    let text = axes(DRIVES).replacen(one, "nic = \"sim\"\nredundant = \"sim2\"\n", 1);
    machine(&text)
}

/// A place of the ring: the cable at port 0 of a drive, or the last one.
pub(super) fn break_at(cable: usize, at_ns: u64, for_ns: u64) -> String {
    let (device, port) = match cable {
        DRIVES => (DRIVES - 1, 1),
        cable => (cable, 0),
    };
    break_at_port((device, port), at_ns, for_ns)
}

pub(super) fn break_at_port((device, port): (usize, u8), at_ns: u64, for_ns: u64) -> String {
    let us = |ns: u64| ns / 1000;
    format!(
        "[[fault]]\nkind = \"link-break\"\ndevice = {device}\nport = {port}\nat = \"{}us\"\nfor = \"{}us\"\n",
        us(at_ns),
        us(for_ns)
    )
}

/// What the cycles of a run have shown.
#[derive(Debug, Default, Clone, PartialEq)]
pub(super) struct Seen {
    /// For each cycle, the set-points and Controlwords of all drives.
    pub commanded: Vec<u64>,
    /// The times, in ns since the start, of cycles without the inputs of all drives.
    pub stale: Vec<u64>,
    /// The first cycle.
    pub began: u64,
}

impl Seen {
    /// True if the inputs of this cycle, or of one shortly before it, are missing.
    pub fn is_stale_before(&self, cycle: usize) -> bool {
        let at = self.began + cycle as u64 * CYCLE_NS;
        let mut stale = self.stale.iter();
        stale.any(|stale| (*stale..stale + 4 * CYCLE_NS).contains(&at))
    }
}

struct Swing {
    axes: Vec<AxisRef>,
    cycles: usize,
    seen: Arc<Mutex<Seen>>,
}

impl Controller for Swing {
    fn cycle(&mut self, machine: &mut CycleContext<'_>) {
        let mut seen = self.seen.lock().expect("no panic while it is locked");
        let number = seen.commanded.len();
        let ready = self.axes.iter().all(|axis| machine.axis(*axis).ready);
        if machine.stopping() || (number == 0 && !ready) {
            return;
        }
        let now = clock::now();
        if number == 0 {
            seen.began = now;
        }
        if !machine.fresh() {
            seen.stale.push(now);
        }
        let mut hash = 0xcbf2_9ce4_8422_2325_u64;
        let mut add = |value: u64| hash = (hash ^ value).wrapping_mul(0x0000_0100_0000_01b3);
        for (index, &axis) in self.axes.iter().enumerate() {
            let status = machine.axis(axis);
            add(status.target_position.to_bits());
            add(u64::from(status.controlword));
            let turns = number as f64 * 1e-3 * 0.5 * (index + 1) as f64;
            let _ = machine.set_point(axis, 5.0 - 5.0 * turns.cos());
        }
        seen.commanded.push(hash);
        if number + 1 == self.cycles {
            machine.finish();
        }
    }
}

fn swing(options: Options, cycles: usize) -> (Seen, Heard) {
    swing_axes(ring(), DRIVES, options, cycles)
}

/// Moves the first `drives` axes of a machine.
pub(super) fn swing_axes(
    machine: Machine,
    drives: usize,
    options: Options,
    cycles: usize,
) -> (Seen, Heard) {
    let axes = (0..drives).map(|n| machine.axis(&format!("a{n}")).expect("an axis"));
    let seen = Arc::<Mutex<Seen>>::default();
    let controller = Swing {
        axes: axes.collect(),
        cycles,
        seen: Arc::clone(&seen),
    };
    let (mut heard, stop) = (Heard::default(), Arc::<CancelToken>::default());
    let outcome = run_with(machine, options, stop, &mut heard, Box::new(controller));
    let reports = reports(&heard);
    outcome
        .result
        .unwrap_or_else(|error| panic!("{error}; {reports:?}, {:?}", heard.warnings()));
    let seen = seen.lock().expect("no panic while it is locked").clone();
    (seen, heard)
}

pub(super) fn reports(heard: &Heard) -> Vec<String> {
    let ring = heard.0.iter().filter_map(|progress| match progress {
        Progress::Ring { text, .. } => Some(text.clone()),
        _ => None,
    });
    ring.collect()
}

/// A cable breaks at each place in each phase of the cycle, and is connected again.
#[test]
fn a_broken_cable_costs_at_most_one_cycle() {
    const FIRST: u64 = 2_000_000_000;
    const EACH: u64 = 300_000_000;
    const OUTAGE: u64 = 150_000_000;
    let cycles = 2_500 + (DRIVES + 1) * 300;
    let (calm, _) = swing(virtual_time(), cycles);
    assert_eq!(calm.stale, [0; 0]);
    assert!(calm.began < FIRST);
    // For each cable, the cycles lost by breaks and by repairs: how many phases, and the most.
    let mut table = vec![[(0, 0); 2]; DRIVES + 1];
    for phase in 0..PHASES {
        let times = (0..).map(|n| FIRST + n * EACH + phase * CYCLE_NS / PHASES);
        let breaks = (0..=DRIVES).zip(times.clone());
        let script: String = breaks
            .map(|(cable, at)| break_at(cable, at, OUTAGE))
            .collect();
        let (seen, heard) = swing(faults(&script), cycles);
        assert_eq!(
            seen.commanded, calm.commanded,
            "phase {phase}: a set-point differs"
        );
        let reports = reports(&heard);
        assert_eq!(reports.len(), 2 * (DRIVES + 1), "{reports:#?}");
        for (row, at) in table.iter_mut().zip(times) {
            for (cell, at) in row.iter_mut().zip([at, at + OUTAGE]) {
                let lost = seen
                    .stale
                    .iter()
                    .filter(|&&s| s + CYCLE_NS > at && s < at + OUTAGE);
                let lost = lost.count();
                cell.0 += usize::from(lost > 0);
                cell.1 = cell.1.max(lost);
            }
        }
    }
    println!("cable  phases of {PHASES} with a lost cycle: break, repair");
    for (cable, [broken, repaired]) in table.iter().enumerate() {
        println!("{cable:5}  {broken:?} {repaired:?}");
    }
    let most = table.iter().flatten().map(|(_, most)| *most).max();
    assert!(most <= Some(1), "{table:?}");
}

/// A second cable breaks before the first is repaired: the drives between are lost, and the machine
/// stops.
#[test]
fn a_second_break_stops_the_machine_and_names_the_drives_between() {
    let script = break_at(3, 2_000_000_000, 900_000_000) + &break_at(6, 2_300_000_000, 500_000_000);
    let (outcome, heard) = run(ring(), faults(&script));
    let error = outcome
        .result
        .expect_err("three drives are lost")
        .to_string();
    assert!(
        ["a3", "a4", "a5"].iter().any(|name| error.contains(name)),
        "{error}"
    );
    println!("{error}");
    let reports = reports(&heard);
    let first = "between `a2` and `a3`: every device is still reached";
    assert!(
        matches!(&reports[..], [text] if text.contains(first)),
        "{reports:?}"
    );
}

/// Where groups stop alone, the drives between two breaks return once a cable is repaired.
#[test]
fn drives_between_two_breaks_return() {
    let steps = "\n[[step]]\nenable = true\n\n[[step]]\nmove = { a0 = 80.0 }\n\n[[step]]\nmove = { a0 = -80.0 }\n\
        \n[[step]]\nreset = [\"a3\", \"a4\", \"a5\"]\n\n[[step]]\nenable = [\"a3\", \"a4\", \"a5\"]\n\
        \n[[step]]\nmove = { a0 = 1.0, a3 = 2.0, a5 = 3.0, a7 = 4.0 }\n";
    let text = line_text(DRIVES, steps);
    let text = text.replacen("nic = \"sim\"", "nic = \"sim\"\nredundant = \"sim2\"", 1);
    let script =
        break_at(3, 2_000_000_000, 1_500_000_000) + &break_at(6, 2_300_000_000, 500_000_000);
    let (outcome, heard) = run(machine(&text), faults(&script));
    let (warnings, reports) = (heard.warnings(), reports(&heard));
    outcome
        .result
        .unwrap_or_else(|error| panic!("{error}; {warnings:?}; {reports:?}"));
    let mut names: Vec<_> = returned(&heard)
        .into_iter()
        .map(|(name, ..)| name)
        .collect();
    names.sort_unstable();
    assert_eq!(names, ["a3", "a4", "a5"], "{warnings:?}");
    for (text, report) in [
        "between `a2` and `a3`: every device",
        "between `a2` and `a6`, and frames do not reach 3 of 8 devices",
        "between `a2` and `a3`: every device",
        "is closed",
    ]
    .into_iter()
    .zip(&reports)
    {
        assert!(report.contains(text), "{reports:#?}");
    }
    let summary = outcome.summary.expect("a summary");
    let at: Vec<_> = summary
        .axes
        .iter()
        .map(|axis| axis.target_position)
        .collect();
    assert_eq!([at[0], at[3], at[5], at[7]], [1.0, 2.0, 3.0, 4.0]);
}

/// The bus comes up with one cable out, whichever it is, and the ring is closed during the motion.
#[test]
fn a_broken_ring_comes_up_and_is_repaired_in_motion() {
    for cable in 0..=DRIVES {
        let script = break_at(cable, 0, 2_000_000_000);
        let (seen, heard) = swing(faults(&script), 4_000);
        assert!(seen.began < 2_000_000_000, "cable {cable}: {}", seen.began);
        assert!(seen.stale.len() <= 1, "cable {cable}: {:?}", seen.stale);
        let warnings = heard.warnings();
        let broken = warnings
            .iter()
            .filter(|text| text.contains("the ring is broken between"));
        assert_eq!(
            (broken.count(), warnings.len()),
            (1, 1),
            "cable {cable}: {warnings:?}"
        );
        let reports = reports(&heard);
        assert!(
            matches!(&reports[..], [text] if text.contains("is closed")),
            "cable {cable}: {reports:?}"
        );
    }
}

/// A simulated ring that keeps, for each cycle, how far apart the SYNC0 pulses of the drives are.
#[derive(Debug)]
pub(super) struct WatchedRing {
    pub ring: SimRing,
    pub spreads: Arc<Mutex<Vec<(u64, u64)>>>,
}

impl RingEnds for WatchedRing {
    fn send(&mut self, from: End, frame: &[u8]) -> Result<(), LinkError> {
        self.ring.send(from, frame)?;
        if from == End::First && frame.get(11) == Some(&0x20) {
            let segment = self.ring.0.segment();
            let pulse = |n| segment.device(n)?.sync0_log().last();
            if let Some(first) = pulse(0) {
                let apart =
                    (1..segment.len()).filter_map(|n| Some(pulse(n)?.abs_diff(first) % CYCLE_NS));
                let apart = apart.map(|ns| ns.min(CYCLE_NS - ns));
                let most = apart.max().unwrap_or(0);
                self.spreads
                    .lock()
                    .expect("one thread")
                    .push((clock::now(), most));
            }
        }
        Ok(())
    }

    fn recv(&mut self, at: End, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        self.ring.recv(at, buf)
    }

    fn next_arrival(&self) -> Option<u64> {
        self.ring.next_arrival()
    }

    fn main_devices(&self) -> u64 {
        self.ring.main_devices()
    }

    fn stats(&mut self) -> LinkStats {
        self.ring.stats()
    }
}

/// SYNC0 of the drives behind a break goes on in phase, without the reference clock.
#[test]
fn clocks_behind_a_break_stay_in_their_window() {
    const BEGIN: u64 = 1_500_000_000;
    const OUTAGE: u64 = 8_000_000_000;
    for cable in [1, 4, DRIVES - 1] {
        let options = Options {
            repeat: Some(5),
            ..faults(&break_at(cable, BEGIN, OUTAGE))
        };
        options.clock.enter();
        let machine = ring();
        let script = options.faults.as_ref();
        let bus = simulated_bus(&machine, 1, script, Some(SecondPort::Listens)).expect("a ring");
        let spreads = Arc::<Mutex<_>>::default();
        let ends = WatchedRing {
            ring: SimRing(SimLink::new(bus)),
            spreads: Arc::clone(&spreads),
        };
        let link = Box::new(RedundantLink::new(Box::new(ends), CYCLE_NS / 2));
        let (mut heard, stop) = (Heard::default(), Arc::<CancelToken>::default());
        let outcome = run_on(link, machine, options, stop, &mut heard);
        outcome.result.unwrap_or_else(|error| panic!("{error}"));
        assert_eq!(heard.warnings(), [""; 0], "cable {cable}");
        let spreads = spreads.lock().expect("one thread");
        let most = |from: u64, to: u64| {
            let during = spreads.iter().filter(|(at, _)| (from..to).contains(at));
            during.map(|(_, ns)| *ns).max().expect("cycles")
        };
        let settled = BEGIN + OUTAGE / 2;
        let [before, at_once, during, after] = [
            most(BEGIN - CYCLE_NS * 200, BEGIN),
            most(BEGIN, settled),
            most(settled, BEGIN + OUTAGE),
            most(BEGIN + OUTAGE + OUTAGE / 2, u64::MAX),
        ];
        println!(
            "cable {cable}: {before} ns before, {at_once} ns at once, {during} ns later, {after} ns repaired"
        );
        assert!(
            before < 200 && after < 200 && during < 500 && at_once < 10_000,
            "cable {cable}"
        );
    }
}

/// A ring whose cables are exchanged at the computer.
#[derive(Debug)]
struct Exchanged(SimRing);

const fn other(end: End) -> End {
    match end {
        End::First => End::Second,
        End::Second => End::First,
    }
}

impl RingEnds for Exchanged {
    fn send(&mut self, from: End, frame: &[u8]) -> Result<(), LinkError> {
        self.0.send(other(from), frame)
    }

    fn recv(&mut self, at: End, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        self.0.recv(other(at), buf)
    }

    fn next_arrival(&self) -> Option<u64> {
        self.0.next_arrival()
    }

    fn main_devices(&self) -> u64 {
        self.0.main_devices()
    }

    fn stats(&mut self) -> LinkStats {
        self.0.stats()
    }
}

/// Runs a ring whose cables are exchanged. Returns the target of the drive at each position.
fn run_exchanged(script: &str) -> (Vec<String>, Vec<String>) {
    let options = faults(script);
    options.clock.enter();
    let machine = ring();
    let script = options.faults.as_ref();
    let bus = simulated_bus(&machine, 1, script, Some(SecondPort::Listens)).expect("a ring");
    let ends = Exchanged(SimRing(SimLink::new(bus)));
    let link = Box::new(RedundantLink::new(Box::new(ends), CYCLE_NS / 2));
    let (mut heard, stop) = (Heard::default(), Arc::<CancelToken>::default());
    let outcome = run_on(link, machine, options, stop, &mut heard);
    let (warnings, reports) = (heard.warnings(), reports(&heard));
    outcome
        .result
        .unwrap_or_else(|error| panic!("{error}; {warnings:?}"));
    (warnings, reports)
}

#[test]
fn exchanged_cables_are_reported_and_do_not_matter() {
    let (warnings, reports) = run_exchanged(&break_at(3, 2_000_000_000, 500_000_000));
    assert!(
        matches!(&warnings[..], [text] if text.contains("are exchanged")),
        "{warnings:?}"
    );
    assert!(reports[0].contains("between `a2` and `a3`"), "{reports:?}");
    // Positions would begin at the break.
    for (cable, place) in [
        (0, "interface (`nic`) and `a0`"),
        (3, "between `a2` and `a3`"),
        (DRIVES, "between `a7` and the second interface"),
    ] {
        let (warnings, reports) = run_exchanged(&break_at(cable, 0, 2_000_000_000));
        assert!(
            warnings.iter().any(|text| text.contains(place)),
            "{cable}: {warnings:?}"
        );
        assert!(
            warnings.iter().any(|text| text.contains("are exchanged")),
            "{cable}: {warnings:?}"
        );
        assert!(
            matches!(&reports[..], [text] if text.contains("is closed")),
            "{cable}: {reports:?}"
        );
    }
}

/// Two drives lose their power together. The second one is reached before the first, and is not
/// taken for it.
#[test]
fn a_drive_behind_a_gap_does_not_return_in_place_of_another() {
    let steps = "\n[[step]]\nenable = true\n\n[[step]]\nmove = { a0 = 80.0 }\n\n[[step]]\nmove = { a0 = -80.0 }\n";
    for (order, expected) in [
        ([2_500, 60_000], &["a3"][..]),
        ([60_000, 2_500], &[]),
        ([3_200, 2_500], &["a3", "a4"]),
    ] {
        let text = line_text(DRIVES, steps);
        let text = text.replacen("nic = \"sim\"", "nic = \"sim\"\nredundant = \"sim2\"", 1);
        let script: String = [3, 4].into_iter().zip(order).map(|(device, back)| {
            format!("[[fault]]\nkind = \"power-off\"\ndevice = {device}\nat = \"2s\"\nfor = \"{}ms\"\n", back - 2_000)
        }).collect();
        let (outcome, heard) = run(machine(&text), faults(&script));
        let warnings = heard.warnings();
        assert!(outcome.summary.is_some(), "{warnings:?}");
        let mut names: Vec<_> = returned(&heard)
            .into_iter()
            .map(|(name, ..)| name)
            .collect();
        names.sort_unstable();
        assert_eq!(names, expected, "{order:?}: {warnings:?}");
        assert!(
            !warnings.iter().any(|text| text.contains("serial number")),
            "{warnings:?}"
        );
    }
}

/// A cable breaks at some time of the bring-up and stays out.
#[test]
fn a_break_during_the_bring_up_is_reported() {
    let mut failed = Vec::new();
    for cable in [0, 4, DRIVES] {
        for at_ms in 10..70 {
            let script = break_at(cable, at_ms * 1_000_000, 60_000_000_000);
            let (outcome, heard) = run(ring(), faults(&script));
            if let Err(error) = outcome.result {
                failed.push(format!("cable {cable} at {at_ms} ms: {error}"));
                continue;
            }
            let reports = [reports(&heard), heard.warnings()].concat();
            assert!(
                reports
                    .iter()
                    .any(|text| text.contains("is broken between")),
                "cable {cable} at {at_ms} ms: {reports:?}"
            );
        }
    }
    println!("{failed:#?}");
    assert!(failed.len() <= 6, "{failed:#?}");
}

/// A plug that bounces is reported, though each break is short.
#[test]
fn short_breaks_are_reported() {
    let script: String = (0..20)
        .map(|n| break_at(4, 2_000_000_000 + n * 20_000_000, 5_000_000))
        .collect();
    let (seen, heard) = swing(faults(&script), 3_000);
    assert!(seen.stale.len() <= 20, "{:?}", seen.stale);
    let warnings = heard.warnings();
    assert!(
        warnings
            .iter()
            .any(|text| text.contains("broken for short") && text.contains("behind `a3`")),
        "{warnings:?}"
    );
}
