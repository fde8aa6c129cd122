//! The matrix features × causes: each kind of motion and outputs with each cause of a stop, a hold
//! or a delay, generated from the two lists, in virtual time. A cell is judged from its recording,
//! by rules that share no code with the packages of this workspace.
//!
//! One cell, with the frames around each finding:
//!
//! ```sh
//! ECAXIS_MATRIX_CELL="gear × emergency" cargo test -p ecaxis --test matrix -- --nocapture
//! ```

#![allow(clippy::print_stdout, reason = "the table of the matrix")]

mod causes;
mod drive;
mod features;
mod judge;
#[path = "../campaign/pcapng.rs"]
mod pcapng;
mod shaft;
mod tampered;
mod wire;

use std::fmt::Write as _;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use causes::{BURST_MS, Bus, Cause, LOST_FRAMES};
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::Clock;
use ecaxis_master::rt::setpoint_cell::{SetpointCell, SetpointCells};
use ecaxis_master::session::{self, Attachments, Progress};
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::{Heard, faults, recorded};
use features::{EMERGENCY, Feature, HOLD, IO};
use judge::{Finding, Run, Times};

const THREADS: usize = 2;
const CYCLE_NS: u64 = 1_000_000;
/// Virtual time at the start of the bus.
const EPOCH: u64 = 1_000_000_000;
/// The moments of a cause: in cycles from half of the highest speed, while the axis accelerates, and
/// in ns from the frame of that cycle. Each moment has another bus.
const MOMENTS: [(usize, u64); 3] = [(0, 0), (150, 370_000), (290, 710_000)];

/// Cells that cannot exist, each with the reason.
const IMPOSSIBLE: [(&str, &str, &str); 0] = [];

/// Runs a machine and reads its recording.
fn run(
    feature: &Feature,
    bench: &Bench,
    (bus, last): (Bus, &str),
    script: &str,
    folder: &Path,
) -> Run {
    let machine = match bench.parse(&feature.text(bus.keys(), last)) {
        Ok(machine) => machine,
        Err(error) => {
            let error = Some(error);
            return Run {
                error,
                ..Run::default()
            };
        }
    };
    let (options, path) = recorded(faults(script), folder);
    let mut attachments = Attachments::default();
    if feature.shaft {
        options.clock.enter();
        let link = session::simulated_link(&machine, options.seed, options.faults.as_ref());
        let cell = Arc::new(SetpointCell::default());
        let link = Box::new(shaft::Leader {
            link: link.expect("a bus"),
            cell: Arc::clone(&cell),
            begin: 0,
            next: 0,
        });
        let comment = session::recording_comment(&machine);
        let link = session::recorded(link, &options, &comment).expect("a recording");
        Clock::Real.enter();
        attachments.link = Some(link);
        attachments.setpoints = SetpointCells {
            line_shafts: [cell].into(),
            ..SetpointCells::default()
        };
    }
    let mut heard = Heard::default();
    let stop = Arc::<CancelToken>::default();
    let outcome = session::run_attached(machine, options, stop, &mut heard, attachments);
    let mut error = outcome.result.err().map(|error| error.to_string());
    // A run that ends while a group is stopped has exit code 1.
    let stops = outcome
        .summary
        .into_iter()
        .flat_map(|summary| summary.group_stops);
    for stop in stops.filter(|stop| !stop.released) {
        error
            .get_or_insert_default()
            .push_str(&format!("\n{}: {}", stop.group, stop.cause));
    }
    let mut said = error.clone().unwrap_or_default();
    for progress in &heard.0 {
        match progress {
            Progress::Warning(text) | Progress::Ring { text, .. } => said += &format!("\n{text}"),
            Progress::GroupStopped { group, cause } => said += &format!("\n{group}: {cause}"),
            _ => {}
        }
    }
    let bytes = std::fs::read(&path).expect("a recording");
    let packets = pcapng::packets(&bytes).expect("pcapng");
    let cycles = wire::read(&packets, feature.devices_total).expect("EtherCAT");
    let in_time = CYCLE_NS * bus.later() as u64 + CYCLE_NS * 19 / 25;
    let axes = feature.all_axes();
    let axes = { axes.iter() }
        .map(|axis| axis.codec.moments(&cycles, axis.device, in_time))
        .collect();
    let bytes_of = |device: usize, answer: bool, byte: usize| {
        let each = cycles.iter().map(|cycle| {
            let exchange = cycle.devices[device].as_ref()?;
            match answer {
                true => exchange.answer.as_ref()?.1.get(byte).copied(),
                false => exchange.outputs.get(byte).copied(),
            }
        });
        each.collect::<Vec<Option<u8>>>()
    };
    Run {
        axes,
        inputs: bytes_of(IO, true, 0),
        output: feature
            .output
            .map_or(Vec::new(), |of| bytes_of(of.0, false, 0)),
        lost: bytes_of(feature.lost, true, 0),
        node: bytes_of(feature.axes[0].device, true, 1),
        ends_at_target: feature.ends_at_target,
        halves: feature.is_gantry(),
        error,
        said,
    }
}

/// Returns the cycle in which the first axis of the feature has half of its highest speed.
fn begin(run: &Run) -> usize {
    let speeds = (0..run.axes[0].len()).map(|cycle| judge::speed(&run.axes[0], cycle));
    let speeds: Vec<f64> = speeds.map(|speed| speed.unwrap_or(0.0)).collect();
    let most = speeds.iter().copied().fold(0.0, f64::max);
    let fast = speeds.iter().position(|speed| *speed > most / 2.0);
    fast.unwrap_or(0)
}

/// Runs a cell. Returns what it has shown, and the cycle of the cause.
fn strike(
    (feature, cause, moment): (&Feature, Cause, usize),
    bench: &Bench,
    reference: &Run,
    folder: &Path,
) -> (Run, usize) {
    let (later, phase) = MOMENTS[moment];
    let at = begin(reference) + later;
    let start = reference.axes[0][at].at - EPOCH + phase;
    let script = cause.script(feature, start, moment);
    let last = cause.steps(feature);
    let bus = (cause.buses()[moment], last.as_str());
    (run(feature, bench, bus, &script, folder), at)
}

/// Returns the times at which a cause shows, or why it does not.
fn times(
    (feature, cause, moment): (&Feature, Cause, usize),
    run: &Run,
    at: usize,
) -> Result<Times, String> {
    let count = run.inputs.len();
    let first = |from: usize, shows: &dyn Fn(usize) -> bool| {
        let found = (from..count).find(|cycle| shows(*cycle));
        found.ok_or_else(|| "the cause does not show in the recording".to_owned())
    };
    let input = |bit: u8, on: bool| {
        move |cycle: usize| run.inputs[cycle].is_some_and(|bits| (bits & bit != 0) == on)
    };
    let names: Vec<String> = feature
        .all_axes()
        .into_iter()
        .map(|axis| axis.name)
        .collect();
    let fault = |name: &str| {
        let axis = names.iter().position(|of| of == name).unwrap_or(0);
        move |cycle: usize| {
            run.axes[axis][cycle]
                .report
                .is_some_and(|report| report.fault)
        }
    };
    let later = judge::REACTION + cause.buses()[moment].later();
    let now = |shows: usize| Times {
        shows,
        counts: shows,
        ends: shows,
        responds: shows + later,
    };
    let missing = |shows: usize| Times {
        shows,
        ..now(shows + LOST_FRAMES)
    };
    let burst = at + (BURST_MS * 1_000_000 / CYCLE_NS) as usize;
    Ok(match cause {
        Cause::DriveFault => match feature.node {
            Some(node) => now(first(at - 2, &|cycle| run.node[cycle] == Some(node))?),
            None => {
                let victim = &feature.axes[Cause::victim(feature, moment)];
                now(first(at - 2, &fault(&victim.name))?)
            }
        },
        Cause::StoppedGroup | Cause::GroupReset => now(first(at - 2, &fault("b"))?),
        Cause::OtherGroupStopped => now(first(at - 2, &fault("w"))?),
        Cause::DeviceLost => missing(first(at - 2, &|cycle| run.lost[cycle].is_none())?),
        Cause::FramesLost | Cause::FramesLate => {
            let silent = |cycle: usize| run.axes.iter().all(|axis| axis[cycle].report.is_none());
            first(at - 2, &silent)?;
            missing(first(burst - 2, &silent)?)
        }
        Cause::Emergency => now(first(at - 2, &input(EMERGENCY, true))?),
        Cause::Hold => {
            let shows = first(at - 2, &input(HOLD, true))?;
            Times {
                ends: first(shows, &input(HOLD, false))?,
                ..now(shows)
            }
        }
        Cause::BrokenRing | Cause::Pipelined => now(at),
    })
}

/// Judges one run of a cell. Returns the findings and the text with the frames around them.
fn judge_run(
    (feature, cause, moment): (&Feature, Cause, usize),
    run: &Run,
    reference: &Run,
    at: usize,
) -> Vec<(Finding, String)> {
    let axes = feature.all_axes();
    let mut findings = Vec::new();
    let mut whole = |rule, detail| {
        assert!(judge::RULES.contains(&rule), "{rule}");
        findings.push(Finding {
            rule,
            axis: 0,
            cycle: 0,
            detail,
            count: 1,
        });
    };
    match cause.texts(feature, moment) {
        None => {
            if let Some(error) = &run.error {
                whole("run-failed", error.clone());
            }
        }
        Some(texts) => {
            if run.error.is_none() {
                whole(
                    "run-succeeded",
                    "although the machine has stopped".to_owned(),
                );
            }
            for text in texts.iter().filter(|text| !run.said.contains(*text)) {
                whole(
                    "cause-not-named",
                    format!("`{text}` is not in: {}", run.said),
                );
            }
        }
    }
    if cause == Cause::BrokenRing && !run.said.contains("broken") {
        whole(
            "cause-not-named",
            format!("no broken cable in: {}", run.said),
        );
    }
    let times = match times((feature, cause, moment), run, at) {
        Ok(times) => times,
        Err(detail) => {
            whole("no-cause", detail);
            return context(&findings, run);
        }
    };
    let lost_elsewhere = cause == Cause::DeviceLost && feature.lost_elsewhere;
    let witness_stops = cause == Cause::OtherGroupStopped || lost_elsewhere;
    let cell_stops =
        !witness_stops && !matches!(cause, Cause::Hold | Cause::BrokenRing | Cause::Pipelined);
    for (number, axis) in axes.iter().enumerate() {
        let expect = cause.expect(feature, axis, moment);
        findings.extend(match cause {
            Cause::Pipelined => judge::same_motion((number, axis), run, reference),
            _ => judge::judge((number, axis), run, reference, expect, times),
        });
    }
    // The end of the program is a stop as well.
    let timed = if witness_stops { reference } else { run };
    let end = judge::program_end(timed.axes.last().expect("the witness"));
    let stop = if cell_stops {
        times.counts.min(end)
    } else {
        end
    };
    // A hold of the followers does not reach the leader on another machine: they leave the gear.
    let leaves = feature.shaft && cause == Cause::Hold;
    let geared = if leaves { times.shows } else { stop };
    findings.extend(judge::relation(feature, run, geared));
    let lost = lost_elsewhere.then_some(times.counts);
    findings.extend(judge::output(feature, run, stop, lost));
    context(&findings, run)
}

/// Adds the frames around each finding.
fn context(findings: &[Finding], run: &Run) -> Vec<(Finding, String)> {
    let around = |finding: &Finding| {
        let moments = &run.axes[finding.axis];
        let mut text = String::new();
        if finding.cycle > 0 {
            let near = finding.cycle.saturating_sub(8)..(finding.cycle + 5).min(moments.len());
            for cycle in near {
                let mark = if cycle == finding.cycle { '>' } else { ' ' };
                let _ = writeln!(text, "  {mark} {cycle}: {}", moments[cycle]);
            }
        }
        (finding.clone(), text)
    };
    findings.iter().map(around).collect()
}

/// The result of a row: one text per cause, and what is wrong.
struct Row {
    cells: Vec<String>,
    wrong: String,
}

fn row(feature: &Feature, bench: &Bench) -> Row {
    let folder = tempfile::tempdir().expect("a folder");
    let asked = std::env::var("ECAXIS_MATRIX_CELL").ok();
    let mut row = Row {
        cells: Vec::new(),
        wrong: String::new(),
    };
    let mut references: Vec<(Bus, Run)> = Vec::new();
    for (name, causes) in causes::ALL {
        let cell = format!("{} × {name}", feature.name);
        if asked.as_ref().is_some_and(|asked| !cell.contains(asked)) {
            row.cells.push(String::new());
            continue;
        }
        let reason = IMPOSSIBLE
            .iter()
            .find(|of| (of.0, of.1) == (feature.name, name));
        if let Some((_, _, reason)) = reason {
            row.cells.push((*reason).to_owned());
            continue;
        }
        let mut wrong = Vec::new();
        let runs = causes.iter().flat_map(|cause| {
            let moments = 0..cause.buses().len();
            moments.map(move |moment| (*cause, moment))
        });
        for (cause, moment) in runs {
            // Only a program that goes on resets the group.
            if cause == Cause::GroupReset && feature.is_blocked(moment) {
                continue;
            }
            let like = cause.reference_bus(moment);
            if !references.iter().any(|of| of.0 == like) {
                let run = run(feature, bench, (like, ""), "", folder.path());
                references.push((like, run));
            }
            let reference = references.iter().find(|of| of.0 == like);
            let reference = &reference.expect("it has run").1;
            if let Some(error) = &reference.error {
                wrong.push("reference".to_owned());
                let _ = writeln!(row.wrong, "{cell}: the reference fails: {error}");
                break;
            }
            let (seen, at) = strike((feature, cause, moment), bench, reference, folder.path());
            for (finding, frames) in judge_run((feature, cause, moment), &seen, reference, at) {
                let Finding {
                    rule,
                    axis,
                    cycle,
                    detail,
                    count,
                } = finding;
                let axis = &feature.all_axes()[axis].name;
                let _ = writeln!(
                    row.wrong,
                    "{cell} ({cause:?}, moment {moment}): {rule} ({count}×), `{axis}`, cycle {cycle}: {detail}\n{frames}"
                );
                wrong.push(rule.to_owned());
            }
        }
        wrong.dedup();
        row.cells.push(match wrong.is_empty() {
            true => "ok".to_owned(),
            false => wrong.join(", "),
        });
    }
    row
}

#[test]
fn every_feature_meets_every_cause() {
    let features = features::all();
    assert_eq!((features.len(), causes::ALL.len()), (15, 9));
    // A cell without a run needs a reason, and a change of this number.
    assert_eq!(IMPOSSIBLE.len(), 0);
    let bench = features::files();
    let next = AtomicUsize::new(0);
    let rows: Mutex<Vec<Option<Row>>> = Mutex::new(features.iter().map(|_| None).collect());
    std::thread::scope(|scope| {
        for _ in 0..THREADS {
            scope.spawn(|| {
                loop {
                    let number = next.fetch_add(1, Ordering::Relaxed);
                    let Some(feature) = features.get(number) else {
                        break;
                    };
                    let row = row(feature, &bench);
                    rows.lock().expect("no panic")[number] = Some(row);
                }
            });
        }
    });
    let rows = rows.into_inner().expect("no panic");
    let head: Vec<&str> = causes::ALL.iter().map(|cause| cause.0).collect();
    println!("| | {} |", head.join(" | "));
    println!("|---|{}", "---|".repeat(head.len()));
    let mut wrong = String::new();
    for (feature, row) in features.iter().zip(rows) {
        let row = row.expect("a row");
        assert_eq!(row.cells.len(), head.len());
        println!("| {} | {} |", feature.name, row.cells.join(" | "));
        wrong += &row.wrong;
    }
    assert!(wrong.is_empty(), "{wrong}");
}
