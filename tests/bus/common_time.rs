//! Buses with clocks of their own and a common time: the pulses of SYNC0 as the simulated devices
//! fire them, and the frames in which programs begin, both in common time.

use std::collections::VecDeque;
use std::pin::pin;
use std::sync::mpsc::channel;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, Waker};

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::{self, Nanos, set_common_offset};
use ecaxis_master::config::{CommonTimeUse, Machine};
use ecaxis_master::link::sim::SimLink;
use ecaxis_master::link::{Link, LinkError, MAX_FRAME};
use ecaxis_master::rt::common_time::CommonTimeStatus;
use ecaxis_master::rt::cycle::Engine;
use ecaxis_master::rt::setpoint_cell::SetpointCells;
use ecaxis_master::session::{
    self, Attachments, Options, Prepared, Progress, RunBuilder, simulated_bus,
};
use ecaxis_master::supervise::operator::{
    self, Operator, OperatorInput, Presence, ProgramRequest, Request, RequestEvent, View,
};
use ecaxis_test_support::random::Random;
use ecaxis_test_support::{Heard, faults, machine, virtual_time};

use crate::line_shaft::EachCycle;

pub(crate) const MS: u64 = 1_000_000;
pub(crate) const SECOND: u64 = 1_000 * MS;
/// 2026-11-26, in ns since 1970: the common time at which the runs begin, plus a part of a second.
pub(crate) const BEGIN: u64 = 1_795_651_200 * SECOND;

/// What the outside world sees of one bus, in common time.
#[derive(Debug, Default)]
pub(crate) struct Seen {
    /// The pulses of each device, in virtual time and in common time.
    pulses: Vec<Vec<(Nanos, u64)>>,
    /// The frames whose process data differs from that of the frame before.
    pub(crate) changes: Vec<u64>,
    outputs: Vec<u8>,
}

#[derive(Debug)]
struct Observed {
    bus: SimLink,
    start: Nanos,
    seen: Arc<Mutex<Seen>>,
    each_cycle: Option<EachCycle>,
}

/// Returns the process data of a cyclic frame.
fn process_data(frame: &[u8]) -> Option<&[u8]> {
    let mut at = 16;
    loop {
        let header = frame.get(at..at + 10)?;
        let len = usize::from(u16::from_le_bytes([header[6], header[7]]) & 0x07ff);
        if header[0] == 12 {
            return frame.get(at + 10..at + 10 + len);
        }
        at += 12 + len;
    }
}

impl Link for Observed {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        self.bus.send(frame)?;
        if frame.get(11) != Some(&0x20) {
            return Ok(());
        }
        let offset = clock::common_offset().expect("virtual time");
        let common = |at: Nanos| at.wrapping_add_signed(offset);
        let mut seen = self.seen.lock().expect("one thread");
        let seen = &mut *seen;
        for index in 0.. {
            let Some(device) = self.bus.segment().device(index) else {
                break;
            };
            if seen.pulses.len() <= index {
                seen.pulses.push(Vec::new());
            }
            let known = &mut seen.pulses[index];
            for pulse in device.sync0_log().map(|pulse| self.start + pulse) {
                if known.last().is_none_or(|(last, _)| pulse > *last) {
                    known.push((pulse, common(pulse)));
                }
            }
        }
        if let (Some(each), Some(data)) = (&mut self.each_cycle, process_data(frame)) {
            each.0(common(clock::now()), data);
        }
        if let Some(data) = process_data(frame)
            && data != seen.outputs
        {
            seen.outputs = data.to_vec();
            seen.changes.push(common(clock::now()));
        }
        Ok(())
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        self.bus.recv(buf)
    }

    fn next_arrival(&self) -> Option<Nanos> {
        self.bus.next_arrival()
    }
}

/// What happens at a common time.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Act {
    Request(Request),
    /// Common time is set: it advances by this.
    Set(i64),
}

/// Carries out a script, and keeps what comes back.
#[derive(Debug)]
struct Scripted {
    acts: VecDeque<(u64, Act)>,
    until: u64,
    kept: Arc<Mutex<Kept>>,
}

#[derive(Debug, Default)]
pub(crate) struct Kept {
    pub events: Vec<RequestEvent>,
    /// The state each 10 ms, with the common time.
    states: Vec<(u64, CommonTimeStatus)>,
}

impl Operator for Scripted {
    fn turn(&mut self, view: &View<'_>) -> OperatorInput {
        let now = || {
            view.now
                .wrapping_add_signed(clock::common_offset().unwrap())
        };
        let mut kept = self.kept.lock().expect("one thread");
        kept.events.extend(view.news.iter().cloned());
        if kept
            .states
            .last()
            .is_none_or(|(at, _)| at.abs_diff(now()) >= 10 * MS)
        {
            kept.states.push((now(), view.snapshot.common_time));
        }
        let mut requests = Vec::new();
        while self.acts.front().is_some_and(|(at, _)| *at <= now()) {
            match self.acts.pop_front().expect("there is one").1 {
                Act::Request(request) => requests.push(request),
                Act::Set(by) => set_common_offset(clock::common_offset().unwrap() + by),
            }
        }
        let presence = match now() < self.until {
            true => Presence::Here,
            false => Presence::Gone,
        };
        OperatorInput { presence, requests }
    }
}

impl Run {
    /// Returns the phases of a device's pulses from a common time on.
    fn phases(&self, device: usize, from: u64, cycle: u64) -> Vec<i64> {
        let pulses = self.seen.pulses[device].iter();
        let pulses = pulses.filter(|(_, common)| *common >= from);
        pulses.map(|(_, common)| phase(*common, cycle)).collect()
    }

    /// Returns the largest deviation of two intervals between pulses from the cycle.
    fn jitter(&self, device: usize, from: u64, cycle: u64) -> u64 {
        let pulses = self.seen.pulses[device].iter();
        let pulses: Vec<_> = pulses.filter(|(_, common)| *common >= from).collect();
        let intervals = pulses.windows(2).map(|pair| pair[1].0 - pair[0].0);
        intervals
            .map(|ns| ns.abs_diff(cycle))
            .max()
            .expect("pulses")
    }

    /// Returns the state at a common time.
    fn state(&self, at: u64) -> CommonTimeStatus {
        let mut states = self.kept.states.iter();
        states
            .find(|(time, _)| *time >= at)
            .expect("the run lasts as long")
            .1
    }

    /// Returns the results of the requests to the program.
    pub(crate) fn results(&self) -> Vec<Result<(), String>> {
        let events = self.kept.events.iter().filter_map(|event| match event {
            RequestEvent::Program { result, .. } => Some(result.clone()),
            _ => None,
        });
        events.collect()
    }
}

fn bounds(values: &[i64]) -> [i64; 2] {
    let (low, high) = (values.iter().min(), values.iter().max());
    [*low.expect("a value"), *high.expect("a value")]
}

/// The run of one bus.
pub(crate) struct Run {
    pub(crate) seen: Seen,
    pub kept: Kept,
    pub warnings: Vec<String>,
    pub error: Option<String>,
}

pub(crate) struct Plan {
    pub machine: Machine,
    pub options: Options,
    pub seed: u64,
    /// Common time as virtual time begins.
    pub begin: u64,
    pub acts: Vec<(u64, Act)>,
    pub until: u64,
    pub setpoints: SetpointCells,
    pub each_cycle: Option<EachCycle>,
}

pub(crate) fn run(plan: Plan) -> Run {
    let options = plan.options;
    options.clock.enter();
    set_common_offset(plan.begin.cast_signed() - clock::now().cast_signed());
    let machine = operator::for_manual_mode(plan.machine);
    let bus = simulated_bus(&machine, plan.seed, options.faults.as_ref(), None).expect("a bus");
    let seen = Arc::<Mutex<Seen>>::default();
    let kept = Arc::<Mutex<Kept>>::default();
    let link = Observed {
        bus: SimLink::new(bus),
        start: clock::now(),
        seen: Arc::clone(&seen),
        each_cycle: plan.each_cycle,
    };
    let operator = Scripted {
        acts: plan.acts.into(),
        until: plan.until,
        kept: Arc::clone(&kept),
    };
    let (progress, reported) = channel();
    let job = RunBuilder {
        machine: &Arc::new(machine),
        options: &options,
        stop: Arc::<CancelToken>::default(),
        progress,
        attachments: Attachments {
            operator: Some(Box::new(operator)),
            setpoints: plan.setpoints,
            ..Attachments::default()
        },
    };
    let Prepared { parts, supervisor } = job.prepare_on(Box::new(link)).expect("comes up");
    let mut engine = Engine::new(parts);
    let mut during = pin!(supervisor.run());
    let mut context = Context::from_waker(Waker::noop());
    let mut result = None;
    while !engine.halted() {
        engine.cycle();
        if result.is_none()
            && let Poll::Ready((_, done)) = during.as_mut().poll(&mut context)
        {
            result = Some(done);
        }
    }
    drop(engine);
    let warnings = reported.try_iter().filter_map(|progress| match progress {
        Progress::Warning(text) => Some(text),
        Progress::GroupStopped { cause, .. } => Some(cause.to_string()),
        _ => None,
    });
    let warnings = warnings.collect();
    let seen = std::mem::take(&mut *seen.lock().expect("one thread"));
    let kept = std::mem::take(&mut *kept.lock().expect("one thread"));
    let error = result.and_then(Result::err).map(|error| error.to_string());
    Run {
        seen,
        kept,
        warnings,
        error,
    }
}

/// A bus of drives with these drifts of their crystals, in ppm. The first is the reference clock.
fn drives(cycle: &str, bus: &str, drifts: &[f64]) -> String {
    let mut text = format!("[bus]\ncycle = \"{cycle}\"\n{bus}\n");
    for (n, drift) in drifts.iter().enumerate() {
        text += &format!(
            "[[device]]\nname = \"d{n}\"\nesi = \"esi/EPOS4.xml\"\nposition = {n}\nmode = \"csp\"\n[device.axis]\n\
             encoder = 2000\nlimits = {{ velocity = 10.0, acceleration = 500.0 }}\n[device.sim]\ndrift_ppm = {drift:?}\n"
        );
    }
    text + "[[step]]\nmove = { d0 = 3.0 }\n"
}

pub(crate) const ALIGN: &str = "common_time = \"align\"";

fn start_at(at_unix_ns: u64) -> Act {
    Act::Request(Request::Program(ProgramRequest::StartAt { at_unix_ns }))
}

/// Returns the distance of a time from the multiples of the cycle.
fn phase(at: u64, cycle: u64) -> i64 {
    let half = cycle.cast_signed() / 2;
    ((at % cycle).cast_signed() + half).rem_euclid(cycle.cast_signed()) - half
}

/// Returns the number of seeds.
fn seeds() -> u64 {
    let given = std::env::var("ECAXIS_COMMON_TIME_SEEDS");
    given.map_or(6, |seeds| seeds.parse().expect("a number"))
}

/// Two buses whose reference clocks are 50 ppm apart, on computers whose sessions begin at any
/// time: the pulses of both are within 1 µs after the lock, and the first set-point of both
/// programs leaves in the same cycle.
#[test]
fn two_buses_fire_and_start_together() {
    let (mut apart, mut spread) = (0_i64, 0_i64);
    for seed in 0..seeds() {
        let mut random = Random::new(seed + 1);
        let (cycle, cycle_ns) =
            [("1ms", MS), ("2ms", 2 * MS), ("4ms", 4 * MS)][random.below(3) as usize];
        let middle = random.below(50_000) as f64 / 1000.0 - 25.0;
        // Any instant: it need not be a multiple of the cycle.
        let at = BEGIN + 9 * SECOND + random.below(SECOND);
        let runs: Vec<_> = [-25.0, 25.0]
            .iter()
            .map(|drift| {
                let follower = random.below(200_000) as f64 / 1000.0 - 100.0;
                let text = drives(cycle, ALIGN, &[middle + drift, follower]);
                let asked = at - 500 * MS - random.below(SECOND);
                run(Plan {
                    machine: machine(&text),
                    options: virtual_time(),
                    seed: seed + 1,
                    begin: BEGIN + random.below(SECOND),
                    acts: vec![(asked, start_at(at))],
                    until: at + 300 * MS,
                    setpoints: SetpointCells::default(),
                    each_cycle: None,
                })
            })
            .collect();
        let (mut begins, mut all) = (Vec::new(), Vec::new());
        for run in &runs {
            assert_eq!(run.error, None, "seed {seed}: {:?}", run.warnings);
            let before = run.seen.changes.iter().filter(|t| **t > at - 100 * MS);
            begins.push(*before.copied().collect::<Vec<_>>().first().expect("starts"));
            for device in 0..2 {
                let phases = run.phases(device, at - 500 * MS, cycle_ns);
                assert!(phases.len() > 150, "seed {seed}: {}", phases.len());
                let [low, high] = bounds(&phases);
                spread = spread.max(high - low);
                all.push([low, high]);
            }
        }
        let low = all.iter().map(|[low, _]| *low).min().unwrap_or(0);
        let high = all.iter().map(|[_, high]| *high).max().unwrap_or(0);
        apart = apart.max(high - low);
        assert!(apart < 1_000, "seed {seed}: {all:?}");
        let cycles: Vec<_> = begins.iter().map(|at| at / cycle_ns).collect();
        assert_eq!(cycles[0], cycles[1], "seed {seed}: {begins:?}");
        // Outputs leave in the frame of the next cycle.
        let first = (at + cycle_ns / 2) / cycle_ns + 1;
        assert_eq!(cycles[0], first, "seed {seed}");
    }
    println!(
        "{} seeds: pulses of both buses within {apart} ns of each other, those of one device within \
         {spread} ns of its mean place; all starts in the same cycle",
        seeds()
    );
}

/// Returns a plan of a bus of two drives, with what happens after the begin of the run.
pub(crate) fn plan(bus: &str, acts: &[(u64, Act)], seconds: u64) -> Plan {
    let acts = acts.iter().map(|(after, act)| (BEGIN + after, *act));
    Plan {
        machine: machine(&drives("1ms", bus, &[40.0, -60.0])),
        options: virtual_time(),
        seed: 1,
        begin: BEGIN + 123_456,
        acts: acts.collect(),
        until: BEGIN + seconds * SECOND,
        setpoints: SetpointCells::default(),
        each_cycle: None,
    }
}

/// A second more or less, as a leap second or a daemon sets it, and a part of a cycle: the
/// measurement begins again and is reported, the pulses do not jump, and the program runs on. SYNC0
/// approaches its place again with at most 1 ppm.
#[test]
fn a_jump_of_common_time_moves_no_pulse() {
    let start = Act::Request(Request::Program(ProgramRequest::Start));
    let acts = [
        (8 * SECOND, start),
        (8 * SECOND + 50 * MS, Act::Set(1_000_000_000)),
        (14 * SECOND, Act::Set(-1_000_050_000)),
        (17 * SECOND, Act::Set(20)),
    ];
    let run = run(plan(ALIGN, &acts, 30));
    assert_eq!(run.error, None);
    assert_eq!(run.results(), [Ok(())]);
    let jumps = run
        .warnings
        .iter()
        .filter(|text| text.contains("has jumped"));
    assert_eq!(jumps.count(), 2, "{:?}", run.warnings);
    let aligned = |state: &CommonTimeStatus| state.alignment.expect("aligns").aligned;
    let before = run.state(BEGIN + 8 * SECOND);
    assert!(before.locked && aligned(&before), "{before:?}");
    let after = run.state(BEGIN + 9 * SECOND + 100 * MS);
    assert!(!after.locked && after.jumps == 1, "{after:?}");
    // Whole seconds are whole cycles.
    let again = run.state(BEGIN + 13 * SECOND);
    assert!(again.locked && aligned(&again), "{again:?}");
    let off = run.state(BEGIN + 16 * SECOND).alignment.expect("aligns");
    assert!((-50_000.0..-45_000.0).contains(&off.sync0_ns), "{off:?}");
    let later = run.state(BEGIN + 26 * SECOND).alignment.expect("aligns");
    let moved = later.sync0_ns - off.sync0_ns;
    assert!(
        (8_000.0..10_100.0).contains(&moved),
        "1 ppm for 10 s: {moved} ns"
    );
    // 1 ppm is 1 ns; the registers and the clock round to whole ones.
    let jitters = [0, 1].map(|device| run.jitter(device, BEGIN + 8 * SECOND, MS));
    println!("intervals of SYNC0 within {jitters:?} ns of the cycle");
    assert!(jitters[0] <= 5 && jitters[1] <= 60, "{jitters:?}");
}

/// The next clock already has the rate of the lost one, and holds its pulses. The device returns
/// and follows.
#[test]
fn sync0_stays_aligned_when_the_reference_clock_is_lost_and_returns() {
    let mut lost = plan(ALIGN, &[], 30);
    lost.machine = crate::clocks::branches();
    lost.machine.bus.common_time = CommonTimeUse::Align;
    lost.options =
        faults("[[fault]]\nkind = \"power-off\"\ndevice = 1\nat = \"9s\"\nfor = \"2s\"\n");
    let run = run(lost);
    assert_eq!(run.error, None, "{:?}", run.warnings);
    let replaced = run
        .warnings
        .iter()
        .filter(|text| text.contains("replaces it"));
    assert_eq!(replaced.count(), 1, "{:?}", run.warnings);
    let phases = [2, 3].map(|device| bounds(&run.phases(device, BEGIN + 9 * SECOND, MS)));
    let jitters = [2, 3].map(|device| run.jitter(device, BEGIN + 9 * SECOND, MS));
    println!("phases {phases:?} ns, intervals within {jitters:?} ns");
    for [low, high] in phases {
        assert!(low > -10_000 && high < 10_000, "{phases:?}");
    }
    assert!(jitters.iter().all(|ns| *ns <= 60), "{jitters:?}");
    let end = run.state(BEGIN + 28 * SECOND);
    assert!(
        end.locked && end.alignment.is_some_and(|a| a.aligned),
        "{end:?}"
    );
    let returned = bounds(&run.phases(1, BEGIN + 28 * SECOND, MS));
    assert!(returned[0] > -1_500 && returned[1] < 1_500, "{returned:?}");
}

/// In a ring, the frames that correct the reference clock reach it from either side.
#[test]
fn sync0_stays_aligned_in_a_ring_that_breaks() {
    for device in [0, 1] {
        let script =
            format!("[[fault]]\nkind = \"link-break\"\ndevice = {device}\nport = 0\nat = \"8s\"\n");
        let bus = format!("{ALIGN}\nredundant = \"sim2\"");
        let kept = Arc::<Mutex<Kept>>::default();
        let operator = Scripted {
            acts: VecDeque::new(),
            until: 16 * SECOND,
            kept: Arc::clone(&kept),
        };
        let attachments = Attachments {
            operator: Some(Box::new(operator)),
            ..Attachments::default()
        };
        let machine = machine(&drives("1ms", &bus, &[40.0, -60.0, 10.0]));
        let stop = Arc::<CancelToken>::default();
        let mut heard = Heard::default();
        let outcome =
            session::run_attached(machine, faults(&script), stop, &mut heard, attachments);
        assert!(outcome.result.is_ok(), "{:?}", outcome.result);
        let kept = kept.lock().expect("the run is over");
        let after = kept.states.iter().filter(|(at, _)| *at > 9 * SECOND);
        let places = after.map(|(_, state)| state.alignment.expect("aligns"));
        let places: Vec<_> = places.collect();
        assert!(places.len() > 500, "{}", places.len());
        let worst = places
            .iter()
            .map(|place| place.sync0_ns.abs())
            .fold(0.0, f64::max);
        println!("break at {device}: SYNC0 within {worst:.0} ns by the measurement");
        assert!(places.iter().all(|place| place.aligned), "{worst}");
    }
}

/// Without alignment, and without distributed clocks, the bus keeps its time, and it is measured.
#[test]
fn offset_and_drift_are_measured_without_alignment() {
    let with_clocks = run(plan("", &[], 10));
    let state = with_clocks.state(BEGIN + 9 * SECOND);
    // The reference clock is 40 ppm fast, so common time is slow against it.
    assert!(
        state.locked && (state.drift_ppm + 40.0).abs() < 0.1,
        "{state:?}"
    );
    assert_eq!(state.alignment, None);
    let mut without = plan("", &[], 6);
    let text = drives("1ms", "", &[40.0]).replace("mode = \"csp\"", "mode = \"csp\"\ndc = \"off\"");
    without.machine = machine(&text);
    let state = run(without).state(BEGIN + 5 * SECOND);
    assert!(state.locked && state.drift_ppm.abs() < 0.001, "{state:?}");
    let expected = BEGIN + 123_456 - SECOND;
    assert_eq!(state.offset_ns.cast_unsigned(), expected);
}

#[test]
fn common_starts_are_refused_cancelled_and_missed() {
    let hour = 3_600 * SECOND;
    let at = |after: u64| start_at(BEGIN + after);
    let stop = Act::Request(Request::StopAll);
    let cases: [(&[(u64, Act)], &str); 6] = [
        (&[(6 * SECOND, at(5 * SECOND))], "in the past"),
        (&[(6 * SECOND, at(7 * SECOND + hour))], "more than 1 h"),
        (&[(0, at(5 * SECOND))], "not locked"),
        (&[(6 * SECOND, at(6 * SECOND + 10 * MS))], "too late"),
        // Within and before the time in which the commands wait in the cycle.
        (
            &[(5 * SECOND, at(7 * SECOND)), (7 * SECOND - 20 * MS, stop)],
            "stopped",
        ),
        (
            &[(5 * SECOND, at(7 * SECOND)), (6 * SECOND, stop)],
            "stopped",
        ),
    ];
    for (acts, why) in cases {
        let run = run(plan("", acts, 9));
        let results = run.results();
        let refused =
            |result: &Result<(), String>| result.as_ref().is_err_and(|text| text.contains(why));
        assert!(results.iter().any(refused), "{why}: {results:?}");
        let after = BEGIN + 6 * SECOND + 900 * MS;
        let moves = run.seen.changes.iter();
        let moves = moves.filter(|at| (after..BEGIN + 8 * SECOND).contains(*at));
        assert_eq!(moves.count(), 0, "{why}: nothing moves");
    }
    for jump_at in [6 * SECOND, 7 * SECOND - 20 * MS] {
        let acts = [(5 * SECOND, at(7 * SECOND)), (jump_at, Act::Set(-300_000))];
        let results = run(plan("", &acts, 9)).results();
        assert_eq!(results.len(), 1);
        let text = results[0].as_ref().expect_err("missed");
        assert!(text.contains("has jumped"), "{text}");
    }
}

/// An instant may be requested again after a stop.
#[test]
fn a_cancelled_start_may_be_repeated() {
    let start = start_at(BEGIN + 7 * SECOND);
    let stop = Act::Request(Request::StopAll);
    let acts = [
        (5 * SECOND, start),
        (6 * SECOND + 850 * MS, stop),
        (6 * SECOND + 900 * MS, start),
    ];
    let run = run(plan("", &acts, 9));
    let moves = run.seen.changes.iter();
    let first = moves
        .filter(|at| **at > BEGIN + 6_950 * MS)
        .min()
        .expect("moves");
    let after = first - BEGIN - 7 * SECOND;
    assert!((MS..2 * MS).contains(&after), "{after}");
}

/// A program that waits first begins as soon as the instant is over.
#[test]
fn a_program_that_waits_first_starts_after_the_instant() {
    let mut waits = plan("", &[(5 * SECOND, start_at(BEGIN + 7 * SECOND))], 9);
    let text =
        drives("1ms", "", &[40.0]).replace("[[step]]", "[[step]]\ndwell = \"100ms\"\n[[step]]");
    waits.machine = machine(&text);
    let run = run(waits);
    let moves = run
        .seen
        .changes
        .iter()
        .filter(|at| **at > BEGIN + 6_900 * MS);
    let first = moves.min().expect("moves") - BEGIN - 7 * SECOND;
    assert!((100 * MS..110 * MS).contains(&first), "{first}");
}
