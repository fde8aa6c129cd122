//! Outputs that drives receive during failures until they stand, read from the recording only.

use std::collections::BTreeMap;
use std::future::Future;
use std::path::Path;
use std::pin::pin;
use std::sync::mpsc::channel;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, Waker};

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::Nanos;
use ecaxis_master::link::sim::SimLink;
use ecaxis_master::link::{Link, LinkError, MAX_FRAME};
use ecaxis_master::rt::cycle::Engine;
use ecaxis_master::session::{Attachments, Cause, Options, RunBuilder, simulated_bus};
use ecaxis_test_support::recordings::{FPWR, Frame, LRD, LRW, frames};
use ecaxis_test_support::{faults, machine, recorded, run, run_badly, run_well, virtual_time};

const COUNTS: f64 = 2000.0;
/// The bytes of an axis of the project's EPOS4.xml in the image.
const REGION: usize = 13;
const LOGICAL_BASE: usize = 0x1_0000;

/// The data of datagrams by logical address.
type Logical = BTreeMap<usize, Vec<u8>>;

/// One cycle of one axis: the outputs that its drive received, and the inputs if the reply arrived.
#[derive(Debug, Clone, Copy)]
struct Cycle {
    controlword: u16,
    target: i32,
    answer: Option<Answer>,
    /// True if an AL control request for a state below Op was sent to its station before.
    left_op: bool,
}

#[derive(Debug, Clone, Copy)]
struct Answer {
    statusword: u16,
    /// The motor speed in turns/s.
    speed: f64,
}

/// Returns logical reads and writes of a frame by logical address.
fn logical(frame: &Frame) -> Logical {
    let logical = frame
        .datagrams
        .iter()
        .filter(|d| (LRD..=LRW).contains(&d.command) && (d.working_counter > 0 || frame.sent));
    let by_address = logical.map(|d| (d.address as usize, d.data.clone()));
    by_address.collect()
}

fn bytes(map: &Logical, axis: usize) -> Option<&[u8]> {
    let at = LOGICAL_BASE + axis * REGION;
    let (start, data) = map.range(..=at).next_back()?;
    data.get(at - start..at - start + REGION)
}

/// Returns every cycle of the `axis`th device of the image, a drive of the project's EPOS4.xml in
/// CSP.
fn cycles(recording: &Path, axis: usize, mode: u8) -> Vec<Cycle> {
    let mut cycles: Vec<Cycle> = Vec::new();
    let mut left_op = false;
    let mut in_op = false;
    for frame in frames(recording) {
        let sent = frame.sent;
        let al_control = frame.datagrams.iter().filter(|d| {
            let here = usize::from(d.station()) == 0x1000 + axis;
            sent && here && d.command == FPWR && d.register() == 0x0120
        });
        for datagram in al_control {
            let state = datagram.data[0];
            in_op |= state & 0x0f == 8;
            left_op = in_op && state & 0x0f != 8;
        }
        let logical = logical(&frame);
        let Some(data) = bytes(&logical, axis).filter(|_| frame.cyclic) else {
            continue;
        };
        let int = |at: usize| i32::from_le_bytes(data[at..at + 4].try_into().expect("four"));
        let word = u16::from_le_bytes([data[0], data[1]]);
        if sent {
            cycles.push(Cycle {
                controlword: word,
                target: int(2),
                answer: None,
                left_op,
            });
        } else if let Some(last) = cycles.last_mut()
            && data[12] == mode
        {
            last.answer = Some(Answer {
                statusword: word,
                speed: f64::from(int(6)) / 60.0,
            });
        }
    }
    cycles
}

const CSP: u8 = 8;
const CSV: u8 = 9;

/// Checks that the drive decelerated to standstill at its own limits, then lost its power, then
/// left Op.
fn comes_to_rest(cycles: &[Cycle], fastest: f64) {
    let speeds = cycles
        .iter()
        .filter_map(|c| c.answer)
        .map(|a| a.speed.abs());
    let seen = speeds.fold(0.0, f64::max);
    assert!(seen > fastest, "it moved: {seen}");
    let mut speed = 0.0;
    let mut powered = false;
    for (n, cycle) in cycles.iter().enumerate() {
        if let Some(answer) = cycle.answer {
            speed = answer.speed.abs();
            powered = matches!(answer.statusword & 0x6f, 0x27 | 0x07);
        }
        let removes = matches!(cycle.controlword & 0x0f, 0x00 | 0x06);
        assert!(
            !(powered && removes && speed > 1.0),
            "cycle {n} of {}: {:#06x} at {speed} turns/s",
            cycles.len(),
            cycle.controlword
        );
        assert!(
            !(cycle.left_op && speed > 1.0),
            "cycle {n}: Op is left at {speed} turns/s"
        );
    }
    let last = cycles.iter().rev().find_map(|c| c.answer).expect("answers");
    assert!(
        !matches!(last.statusword & 0x6f, 0x27 | 0x07),
        "power is left"
    );
}

/// Returns the largest step of an enabled axis' target and the largest change of the step, in
/// turns/s and turns/s².
fn steepest(cycles: &[Cycle], dt: f64) -> (f64, f64) {
    let mut worst = (0.0f64, 0.0f64);
    for three in cycles.windows(3) {
        if three.iter().any(|c| c.controlword & 0x0f != 0x0f) {
            continue;
        }
        let step = |a: Cycle, b: Cycle| f64::from(b.target.wrapping_sub(a.target)) / COUNTS;
        let (first, second) = (step(three[0], three[1]), step(three[1], three[2]));
        worst.0 = worst.0.max((second - first).abs() / (dt * dt));
        worst.1 = worst.1.max(second.abs() / dt);
    }
    worst
}

const IO: &str = "\n[[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 1\n";

fn drive(name: &str, position: usize, mode: &str, limits: &str, more: &str) -> String {
    format!(
        "\n[[device]]\nname = \"{name}\"\nesi = \"esi/EPOS4.xml\"\nposition = {position}\nmode = \"{mode}\"\n{more}\
         [device.axis]\nencoder = 2000\nlimits = {{ {limits} }}\n"
    )
}

const BUS: &str = "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n";
const GENTLE: &str = "velocity = 50.0, acceleration = 20.0, torque = 100.0";

/// An I/O block disappears. The drive still responds, so set-points bring it to rest, and the cause
/// names the block.
#[test]
fn a_missing_io_block_does_not_shorten_the_stop_of_a_drive() {
    for exchange in ["same-cycle", "pipelined"] {
        let text = format!("{BUS}exchange = \"{exchange}\"\n")
            + &drive("x", 0, "csv", GENTLE, "")
            + IO
            + "[[step]]\nvelocity = { x = 45.0 }\n[[step]]\ndwell = \"10s\"\n";
        let folder = tempfile::tempdir().expect("a folder");
        let script = "[[fault]]\nkind = \"absent\"\ndevice = 1\nat = \"5s\"\n";
        let (options, path) = recorded(faults(script), folder.path());
        let (error, _) = run_badly(machine(&text), options);
        assert!(
            error.contains("`io`") && error.contains("no longer answers"),
            "{error}"
        );
        let cycles = cycles(&path, 0, CSV);
        comes_to_rest(&cycles, 40.0);
        let quick = cycles.iter().any(|c| c.controlword == 0x0002);
        assert!(!quick, "by set-points");
    }
}

/// One of two drives disappears; the other comes to rest within its limits.
#[test]
fn a_missing_drive_does_not_shorten_the_stop_of_another() {
    let text = BUS.to_owned()
        + &drive("x", 0, "csp", GENTLE, "")
        + &drive("y", 1, "csp", GENTLE, "")
        + "[[step]]\nmove = { x = 200.0, y = 200.0 }\n";
    let folder = tempfile::tempdir().expect("a folder");
    let script = "[[fault]]\nkind = \"absent\"\ndevice = 1\nat = \"4s\"\n";
    let (options, path) = recorded(faults(script), folder.path());
    let (error, _) = run_badly(machine(&text), options);
    assert!(
        error.contains("`y`") && error.contains("no longer answers"),
        "{error}"
    );
    let cycles = cycles(&path, 0, CSP);
    comes_to_rest(&cycles, 30.0);
    let (acceleration, speed) = steepest(&cycles, 0.001);
    assert!(acceleration <= 20.0 + 2.0 / COUNTS * 1e6, "{acceleration}");
    assert!(speed <= 50.5, "{speed}");
}

/// A drive's quick stop takes as long as its ramp (0x6085).
#[test]
fn a_long_quick_stop_ends_at_standstill() {
    let sdo = "sdo = [{ index = 0x6085, value = 500 }]\n";
    let text = BUS.to_owned()
        + &drive("x", 0, "csv", GENTLE, sdo)
        + "[[step]]\nvelocity = { x = 45.0 }\n[[step]]\ndwell = \"20s\"\n\
           [stop]\nemergency = { x.\"0x6064\" = { above = 300000 } }\n";
    let folder = tempfile::tempdir().expect("a folder");
    let (options, path) = recorded(virtual_time(), folder.path());
    let (error, _) = run_badly(machine(&text), options);
    assert!(error.contains("emergency stop"), "{error}");
    let cycles = cycles(&path, 0, CSV);
    comes_to_rest(&cycles, 40.0);
    let quick = cycles.iter().filter(|c| c.controlword == 0x0002).count();
    assert!(quick > 4500, "45 turns/s at 500 rpm/s: {quick} cycles");
}

/// Another drive faults while a jerk-limited axis accelerates. The axis must not accelerate
/// further.
#[test]
fn no_axis_gains_speed_after_a_stop() {
    let text = BUS.to_owned()
        + &drive(
            "a0",
            0,
            "csp",
            "velocity = 50.0, acceleration = 100.0, jerk = 200.0",
            "sdo = [{ index = 0x6065, value = 20000 }]\n",
        )
        + &drive("a1", 1, "csp", "velocity = 50.0, acceleration = 500.0", "")
        + "[[step]]\nmove = { a0 = 400.0 }\n";
    let folder = tempfile::tempdir().expect("a folder");
    let script = "[[fault]]\nkind = \"drive-fault\"\nat = \"700ms\"\ndevice = 1\ncode = 12832\n";
    let (options, path) = recorded(faults(script), folder.path());
    let (error, _) = run_badly(machine(&text), options);
    assert!(error.contains("`a1`"), "{error}");
    let other = cycles(&path, 1, CSP);
    let fault = |c: &Cycle| c.answer.is_some_and(|a| a.statusword & 0x08 != 0);
    let stop = other.iter().position(fault).expect("the fault") + 2;
    let cycles = cycles(&path, 0, CSP);
    comes_to_rest(&cycles, 10.0);
    let mut step = i32::MAX;
    for pair in cycles[stop..]
        .windows(2)
        .filter(|p| p[1].controlword == 0x0f)
    {
        let now = pair[1].target - pair[0].target;
        assert!(
            now <= step.saturating_add(1),
            "{step} then {now} counts a cycle"
        );
        step = step.min(now);
    }
}

/// The time-out of a stop includes the jerk.
#[test]
fn a_jerk_limited_stop_has_a_sufficient_time_out() {
    let text = BUS.to_owned()
        + &drive(
            "a0",
            0,
            "csp",
            "velocity = 50.0, acceleration = 100.0, jerk = 50.0",
            "sdo = [{ index = 0x6065, value = 20000 }]\n",
        )
        + "[[step]]\nmove = { a0 = 4000.0 }\n";
    for limit in [1_500_000_000, 2_500_000_000, 4_000_000_000] {
        let folder = tempfile::tempdir().expect("a folder");
        let options = Options {
            limit: Some(limit),
            ..virtual_time()
        };
        let (options, path) = recorded(options, folder.path());
        run_well(machine(&text), options);
        let cycles = cycles(&path, 0, CSP);
        comes_to_rest(&cycles, 5.0);
        assert!(
            cycles.iter().all(|c| c.controlword != 0x0002),
            "no quick stop"
        );
    }
}

/// Lost frames, and a device without power, while the machine comes to rest: both are failures of
/// the run.
#[test]
fn a_failure_during_the_stop_fails_the_run() {
    let text = BUS.to_owned()
        + &drive("a0", 0, "csp", "velocity = 50.0, acceleration = 50.0", "")
        + IO
        + "[[step]]\nvelocity = { a0 = 40.0 }\n[[step]]\ndwell = \"10s\"\n";
    for (script, words) in [
        (
            "[[fault]]\nkind = \"frame-loss\"\nat = \"1.5s\"\ncount = 50\n",
            "the bus is lost",
        ),
        (
            "[[fault]]\nkind = \"power-off\"\nat = \"1.5s\"\ndevice = 1\n",
            "`io`",
        ),
        (
            "[[fault]]\nkind = \"power-off\"\nat = \"1.5s\"\ndevice = 0\n",
            "the bus is lost",
        ),
    ] {
        let options = Options {
            limit: Some(1_200_000_000),
            ..faults(script)
        };
        let (error, _) = run_badly(machine(&text), options);
        assert!(error.contains(words), "{script}: {error}");
        assert!(!error.contains("obey"), "{error}");
    }
}

/// The bus is lost in the same cycles in which the machine is ordered to stop. The run fails in any
/// order of the two events.
#[test]
fn a_failure_at_the_end_of_a_run_fails_it() {
    let text = BUS.to_owned()
        + &drive("a0", 0, "csp", "velocity = 50.0, acceleration = 50.0", "")
        + "[[step]]\ndwell = \"10s\"\n";
    let mut failed = 0;
    for ms in 620..780 {
        let script = format!("[[fault]]\nkind = \"frame-loss\"\nat = \"{ms}ms\"\ncount = 50\n");
        let options = Options {
            limit: Some(500_000_000),
            ..faults(&script)
        };
        let (outcome, _) = run(machine(&text), options);
        let summary = outcome.summary.expect("a summary");
        let failure = summary.events.iter().find(|event| event.failure);
        assert!(
            failure.is_none() || outcome.result.is_err(),
            "{script}: {failure:?}"
        );
        failed += u32::from(failure.is_some());
    }
    assert!(failed > 10, "the script misses the end of the run");
}

/// The same rule applies to lost frames and to missing devices.
#[test]
fn a_short_link_break_is_tolerated() {
    let text = format!("{BUS}lost_frames = 20\n")
        + &drive(
            "x",
            0,
            "csp",
            "velocity = 50.0, acceleration = 500.0, torque = 100.0",
            "",
        )
        + "[[step]]\nmove = { x = 200.0 }\n";
    let script =
        "[[fault]]\nkind = \"link-break\"\ndevice = 1\nport = 0\nat = \"2.5s\"\nfor = \"1ms\"\n";
    let two = text.clone().replace(
        "[[step]]",
        &(drive("y", 1, "csp", "velocity = 50.0, acceleration = 500.0", "") + "[[step]]"),
    );
    for text in [text, two] {
        let script = if text.contains("\"y\"") {
            script.to_owned()
        } else {
            script.replace("device = 1", "device = 0")
        };
        run_well(machine(&text), faults(&script));
    }
}

/// Ten replies arrive 0.8 ms late but complete; targets ramp down and up again.
#[test]
fn late_replies_are_not_lost_replies() {
    let text = format!("{BUS}lost_frames = 20\n")
        + &drive(
            "x",
            0,
            "csp",
            "velocity = 50.0, acceleration = 500.0, torque = 100.0",
            "",
        )
        + "[[step]]\nmove = { x = 200.0 }\n";
    let folder = tempfile::tempdir().expect("a folder");
    let script = "[[fault]]\nkind = \"frame-delay\"\nat = \"2.5s\"\nfor = \"10ms\"\nprobability = 1.0\ndelay = \"800us\"\n";
    let (options, path) = recorded(faults(script), folder.path());
    let summary = run_well(machine(&text), options);
    assert!(summary.counters.lost_frames >= 9, "{:?}", summary.counters);
    let (acceleration, _) = steepest(&cycles(&path, 0, CSP), 0.001);
    assert!(acceleration <= 500.0 + 2.0 / COUNTS * 1e6, "{acceleration}");
}

/// Two bursts of lost frames during a change from CSV to CSP in motion, at every phase: no step
/// exceeds the limit.
#[test]
fn csv_to_csp_during_two_bursts_keeps_the_limits() {
    for place in 0..12 {
        let text = format!("{BUS}lost_frames = 5\n")
            + &drive(
                "a0",
                0,
                "csp",
                "velocity = 20.0, acceleration = 100.0",
                "sdo = [{ index = 0x6065, value = 20000, type = \"u32\" }]\n\
               pdo.rx = [\"0x6040\", \"0x607A\", \"0x60FF\", \"0x6060\"]\npdo.tx = [\"0x6041\", \"0x6064\", \"0x606C\", \"0x6077\", \"0x6061\"]\n",
            )
            + "csv = { kv = 30.0, feed_forward = 1.0 }\n\
               [[step]]\nvelocity = { a0 = 15.0 }\n[[step]]\nmode = { a0 = \"csv\" }\n[[step]]\ndwell = \"100ms\"\n\
               [[step]]\nmode = { a0 = \"csp\" }\n[[step]]\ndwell = \"200ms\"\n";
        // The change starts some time after the first velocity is reached, so the bursts cover
        // every phase.
        let folder = tempfile::tempdir().expect("a folder");
        let (options, path) = recorded(virtual_time(), folder.path());
        run_well(machine(&text), options);
        let quiet = cycles_by_mode(&path);
        let change = quiet.iter().rposition(|m| *m == 9).expect("CSV") as f64;
        let start = 0.001 * (change - 6.0 + f64::from(place));
        let script = format!(
            "[[fault]]\nkind = \"frame-loss\"\nat = \"{:.3}ms\"\ncount = 3\n[[fault]]\nkind = \"frame-loss\"\nat = \"{:.3}ms\"\ncount = 3\n",
            1e3 * start,
            1e3 * start + 5.0
        );
        let (options, path) = recorded(faults(&script), folder.path());
        run_well(machine(&text), options);
        let (_, speed) = steepest_csp(&path);
        assert!(speed <= 3.0 * 20.0 + 1.5, "{place}: {speed} turns/s");
    }
}

/// Returns 0x6060 of each cyclic frame of one axis with position and velocity mapped.
fn cycles_by_mode(path: &Path) -> Vec<u8> {
    images(path, true).iter().map(|data| data[10]).collect()
}

fn images(path: &Path, sent: bool) -> Vec<Vec<u8>> {
    let frames = frames(path).into_iter();
    let frames = frames.filter(|frame| frame.cyclic && frame.sent == sent);
    frames
        .filter_map(|frame| Some(bytes(&logical(&frame), 0)?.to_vec()))
        .collect()
}

/// Returns the largest step between targets while the drive displays CSP, in turns/s.
fn steepest_csp(path: &Path) -> (f64, f64) {
    let (sent, back) = (images(path, true), images(path, false));
    let int = |data: &[u8]| i32::from_le_bytes(data[2..6].try_into().expect("four"));
    let mut worst = 0.0f64;
    for pair in sent
        .windows(2)
        .filter(|p| p.iter().all(|d| d[10] == 8 && d[0] == 0x0f))
    {
        let step = f64::from(int(&pair[1]).wrapping_sub(int(&pair[0]))) / COUNTS;
        worst = worst.max(step.abs() / 0.001);
    }
    assert!(back.len() > 100);
    (0.0, worst)
}

/// A link whose `send` panics at one frame, or also at a later one. Records outputs and answers of
/// drive 0.
#[derive(Debug)]
struct Panicking {
    bus: SimLink,
    frames: u32,
    panics: &'static [u32],
    seen: Arc<Mutex<Vec<Cycle>>>,
}

impl Link for Panicking {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        if frame.get(11) == Some(&0x20) {
            self.frames += 1;
            assert!(!self.panics.contains(&self.frames), "a panic of the test");
            let logical = logical(&Frame::parse(frame));
            if let Some(data) = bytes(&logical, 0) {
                self.seen.lock().expect("one thread").push(Cycle {
                    controlword: u16::from_le_bytes([data[0], data[1]]),
                    target: i32::from_le_bytes(data[2..6].try_into().expect("four")),
                    answer: None,
                    left_op: false,
                });
            }
        }
        self.bus.send(frame)
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        let len = self.bus.recv(buf)?;
        if let Some(frame) = len.map(|len| &buf[..len])
            && frame.get(11) == Some(&0x20)
            && let logical = logical(&Frame::parse(frame))
            && let Some(data) = bytes(&logical, 0)
            && let Some(last) = self.seen.lock().expect("one thread").last_mut()
        {
            let speed = i32::from_le_bytes(data[6..10].try_into().expect("four"));
            last.answer = Some(Answer {
                statusword: u16::from_le_bytes([data[0], data[1]]),
                speed: f64::from(speed) / 60.0,
            });
        }
        Ok(len)
    }

    fn next_arrival(&self) -> Option<Nanos> {
        self.bus.next_arrival()
    }
}

/// A panic in the cycle stops the machine like any other failure; a second panic causes a quick
/// stop.
#[test]
fn a_panic_in_the_cycle_brings_the_axes_to_rest() {
    for (panics, quick) in [(&[2500][..], false), (&[2500, 2520][..], true)] {
        let text = BUS.to_owned()
            + &drive("x", 0, "csp", "velocity = 50.0, acceleration = 100.0", "")
            + "[[step]]\nmove = { x = 400.0 }\n";
        let machine = machine(&text);
        let options = virtual_time();
        options.clock.enter();
        let bus = simulated_bus(&machine, 1, None, None).expect("a bus");
        let seen = Arc::new(Mutex::new(Vec::new()));
        let link = Panicking {
            bus: SimLink::new(bus),
            frames: 0,
            panics,
            seen: Arc::clone(&seen),
        };
        let (progress, _receiver) = channel();
        let job = RunBuilder {
            machine: &Arc::new(machine),
            options: &options,
            stop: Arc::<CancelToken>::default(),
            progress,
            attachments: Attachments::default(),
        };
        let prepared = job.prepare_on(Box::new(link)).expect("comes up");
        let mut engine = Engine::new(prepared.parts);
        let mut during = pin!(prepared.supervisor.run());
        let mut context = Context::from_waker(Waker::noop());
        let mut result = None;
        for _ in 0..30_000 {
            if engine.halted() {
                break;
            }
            engine.cycle();
            if result.is_none()
                && let Poll::Ready(done) = during.as_mut().poll(&mut context)
            {
                result = Some(done);
            }
        }
        let (_, result) = result.expect("it ended");
        let error = result.expect_err("it panicked");
        assert!(matches!(*error.cause, Cause::Panicked(_)), "{error:?}");
        let seen = seen.lock().expect("one thread");
        comes_to_rest(&seen, 20.0);
        let words = seen.iter().any(|cycle| cycle.controlword == 0x0002);
        assert_eq!(words, quick, "{panics:?}");
    }
}
