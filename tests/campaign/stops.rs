//! The end of motion: rules for the time after a stop of an axis.

use super::judge::{Findings, Report};
use super::view::{Axis, CSP, CST, CSV, Machine, Moment, set_points};
use super::wire::Wire;

/// The cycles from the cause to the outputs that respond to it.
const REACTION: usize = 2;
/// The rounding error in counts per cycle.
const ROUNDING: i64 = 2;
/// An axis turns from this share of its velocity limit on; standstill is 1 %
/// (`docs/machine-file.md`, `supervise.standstill`).
const TURNS: f64 = 0.05;
/// Additional time after the ramp: settling (0.1 s, `docs/motion.md`, "Groups") and dead time.
const SETTLES_S: f64 = 0.15;
const OP: u8 = 8;
/// The cycles in which a command to enable may last without power.
const UNPOWERED: usize = 20;

/// The reason for a stop and its first cycle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stop {
    pub cycle: usize,
    pub why: &'static str,
}

fn earlier(one: Option<Stop>, other: Option<Stop>) -> Option<Stop> {
    match (one, other) {
        (Some(one), Some(other)) => Some(if other.cycle < one.cycle { other } else { one }),
        (one, other) => one.or(other),
    }
}

/// Finds the cause by which one drive stops its group: a fault while enabled, or no process data
/// for `lost_frames` cycles (`docs/motion.md`, "Groups").
fn seen(machine: &Machine, axis: &Axis, view: &[Moment]) -> Option<Stop> {
    // An axis behind a gateway takes a report with its next set-point.
    let later = 2 * (axis.period - 1);
    let mut enabled = false;
    for moment in view {
        let fault = moment.last().is_some_and(|report| report.is_fault());
        if enabled && fault {
            return Some(Stop {
                cycle: moment.cycle + later,
                why: "drive fault",
            });
        }
        let missing = moment.silent >= machine.lost_frames;
        if enabled && missing && moment.requests_operation() {
            return Some(Stop {
                cycle: moment.cycle + later,
                why: "no process data",
            });
        }
        enabled = moment.requests_operation() && (enabled || moment.is_operation_enabled());
    }
    None
}

/// Finds the stop of the machine: on the wire, or reported by the run (end of its time, failed
/// step).
pub fn machine_stop(
    machine: &Machine,
    wire: &Wire,
    report: &Report,
    views: &[Vec<Moment>],
) -> Option<Stop> {
    let cycle = report.stop_s.and_then(|seconds| {
        let start = wire.cycles.first()?.at as f64 * 1e-9;
        let after = |cycle: &super::wire::Cycle| cycle.at as f64 * 1e-9 > start + seconds;
        wire.cycles.iter().position(after)
    });
    let reported = cycle.map(|cycle| Stop {
        cycle,
        why: "the run's report",
    });
    let mut stop = reported;
    for (axis, view) in machine.axes.iter().zip(views) {
        if !axis.alone {
            stop = earlier(stop, seen(machine, axis, view));
        }
    }
    stop
}

pub fn check(
    machine: &Machine,
    axis: &Axis,
    view: &[Moment],
    wire: &Wire,
    stop: Option<Stop>,
    report: &Report,
    findings: &mut Findings<'_>,
) {
    let sent = &set_points(axis, view)[..];
    if let Some(stop) = stop {
        speeds(machine, axis, sent, stop, findings);
        duration(machine, axis, sent, stop, findings);
        enabled_again(axis, view, stop, findings);
    }
    power(machine, axis, view, report, findings);
    power_lost(axis, view, report, findings);
    enabled_too_often(axis, view, findings);
    op_left(machine, axis, view, wire, report, findings);
    silence(machine, axis, view, findings);
    reported(machine, axis, view, report, findings);
    end(view, findings);
}

fn turns(machine: &Machine, axis: &Axis, moment: &Moment) -> bool {
    moment.speed > (axis.velocity_step(machine) * TURNS).max(2.0)
}

/// No axis gains speed after a stop (`docs/stops.md`; the README's "Safety").
fn speeds(
    machine: &Machine,
    axis: &Axis,
    view: &[Moment],
    stop: Stop,
    findings: &mut Findings<'_>,
) {
    let from = stop.cycle + REACTION * axis.period + machine.answer_to_outputs();
    let mut slowest: Option<(i8, i64)> = None;
    let rounding = axis.velocity_scale * axis.velocity * 0.001;
    for pair in view.windows(2).filter(|pair| pair[0].cycle >= from) {
        let [before, now] = pair else { continue };
        if !now.requests_operation() || !before.requests_operation() {
            return;
        }
        let mode = now.asked(axis);
        if mode != now.shown(axis) || mode != before.asked(axis) || !now.is_operation_enabled() {
            slowest = None;
            continue;
        }
        let speed = |moment: &Moment| match mode {
            CSP => {
                let step = moment.sent.position?.wrapping_sub(before.sent.position?);
                Some((i64::from(step), ROUNDING))
            }
            CSV if !axis.loops => Some((moment.sent.velocity?.into(), 1 + rounding as i64)),
            CST if !axis.loops => Some((moment.sent.torque?.into(), 1)),
            _ => None,
        };
        let Some((speed, rounding)) = speed(now) else {
            slowest = None;
            continue;
        };
        let least = slowest.filter(|of| of.0 == mode).map_or(speed, |of| of.1);
        let turned = speed * least < 0 && speed.abs() > rounding;
        if speed.abs() > least.abs() + rounding || turned {
            let detail = format!(
                "mode {mode}: {least} → {speed}, {} cycles after a stop by {}",
                now.cycle - stop.cycle,
                stop.why
            );
            findings.add("speed-gained-after-stop", now, detail);
        }
        let slower = if speed.abs() < least.abs() {
            speed
        } else {
            least
        };
        slowest = Some((mode, slower));
    }
}

/// A stop uses the limits of the file: velocity / acceleration + acceleration / jerk
/// (`docs/machine-file.md`, "Limits").
fn duration(
    machine: &Machine,
    axis: &Axis,
    view: &[Moment],
    stop: Stop,
    findings: &mut Findings<'_>,
) {
    let ramp = axis.velocity / axis.acceleration + axis.acceleration / axis.jerk;
    let cycles = (ramp + SETTLES_S) / machine.seconds();
    let last = stop.cycle + cycles as usize + REACTION * axis.period + machine.answer_to_outputs();
    let Some(after) = view.iter().position(|moment| moment.cycle >= last) else {
        return;
    };
    for pair in view[after..].windows(2) {
        let [before, now] = pair else { continue };
        if !now.requests_operation() || now.age > 0 {
            return;
        }
        let moves = match now.shown(axis) {
            CSP => before.sent.position != now.sent.position,
            CSV if !axis.loops => now.sent.velocity != Some(0),
            _ => false,
        };
        if moves && turns(machine, axis, now) {
            let detail = format!(
                "{:.1} counts a cycle {:.3} s after a stop by {}; its ramp takes {ramp:.3} s",
                now.speed,
                (now.cycle - stop.cycle) as f64 * machine.seconds(),
                stop.why
            );
            findings.add("stop-too-slow", now, detail);
            return;
        }
    }
}

/// After a stop of the machine nothing is enabled again (`docs/motion.md`, "Groups").
fn enabled_again(axis: &Axis, view: &[Moment], stop: Stop, findings: &mut Findings<'_>) {
    let from = stop.cycle + REACTION * axis.period;
    let mut lost = None;
    for moment in view
        .iter()
        .filter(|moment| moment.cycle >= from && !axis.alone)
    {
        match (moment.requests_operation(), lost) {
            (false, None) => lost = Some(moment.cycle),
            (true, Some(lost)) => {
                let detail = format!("disabled in cycle {lost} after a stop by {}", stop.why);
                findings.add("enabled-after-stop", moment, detail);
                return;
            }
            _ => {}
        }
    }
}

/// Power stays until a responding drive is at rest; otherwise the run fails and names the drive. A
/// quick stop at speed on a responding bus fails the run as well (`docs/stops.md`).
fn power(
    machine: &Machine,
    axis: &Axis,
    view: &[Moment],
    report: &Report,
    findings: &mut Findings<'_>,
) {
    for pair in view.windows(2) {
        let [before, now] = pair else { continue };
        let Some(state) = now.last() else { continue };
        let powered = state.is_operation_enabled() || state.is_quick_stop();
        let answers = now.age == 0 && before.age == 0;
        if !powered || !answers || !turns(machine, axis, now) {
            continue;
        }
        let (was, word) = (before.sent.controlword, now.sent.controlword);
        let cut = |word: u16| word & 0x02 == 0 || word & 0x07 == 0x06 && word & 0x8f != 0x0f;
        if cut(word) && !cut(was) && !axis.may_lose_power && !report.names(&axis.name) {
            let detail = format!(
                "Controlword {was:04x} → {word:04x} at {:.1} counts a cycle, Statusword {:04x}; \
                 exit {}, not named",
                now.speed, state.statusword, report.exit
            );
            findings.add("power-cut-while-turning", now, detail);
        }
        let quick = |word: u16| word & 0x86 == 0x02;
        if quick(word) && before.requests_operation() && report.exit == 0 && !axis.alone {
            let detail = format!(
                "Controlword {was:04x} → {word:04x} at {:.1} counts",
                now.speed
            );
            findings.add("quick-stop-without-failure", now, detail);
        }
    }
}

/// A device leaves Op only when its drive is at rest (`docs/stops.md`).
fn op_left(
    machine: &Machine,
    axis: &Axis,
    view: &[Moment],
    wire: &Wire,
    report: &Report,
    findings: &mut Findings<'_>,
) {
    for request in wire.al_requests.iter().filter(|request| request.state < OP) {
        if request
            .position
            .is_some_and(|position| position != axis.position)
        {
            continue;
        }
        let Some(moment) = view.iter().rev().find(|moment| moment.at <= request.at) else {
            continue;
        };
        let state = moment.last().map_or(0, |report| report.statusword & 0x6f);
        let powered = matches!(state, 0x27 | 0x07);
        let cycles_ago = (request.at - moment.at) / machine.cycle_ns;
        let answers = moment.age < 3 && cycles_ago < 10;
        let excused = axis.may_lose_power || axis.disturbed || report.names(&axis.name);
        if powered && answers && turns(machine, axis, moment) && !excused {
            let detail = format!(
                "AL control {} at {:.1} counts a cycle, Statusword {state:02x}",
                request.state, moment.speed
            );
            findings.add("op-left-while-turning", moment, detail);
            return;
        }
    }
}

/// Operation enabled is no longer requested from a drive without answers for `lost_frames` cycles
/// (`docs/machine-file.md`, `stop.bus_lost`).
fn silence(machine: &Machine, axis: &Axis, view: &[Moment], findings: &mut Findings<'_>) {
    let most = machine.lost_frames + REACTION * axis.period;
    let silent = |moment: &&Moment| moment.silent > most && moment.requests_operation();
    if let Some(moment) = view.iter().find(silent) {
        let detail = format!("without an answer for {} cycles", moment.silent);
        findings.add("enabled-on-silent-bus", moment, detail);
    }
}

/// The run fails if an enabled drive faults, or stops responding while it turns, even during a stop
/// (`docs/architecture.md`, "A run", 5; README "Exit codes").
fn reported(
    machine: &Machine,
    axis: &Axis,
    view: &[Moment],
    report: &Report,
    findings: &mut Findings<'_>,
) {
    if report.exit != 0 || axis.alone {
        return;
    }
    let mut enabled = false;
    for moment in view {
        let fault = moment.last().is_some_and(|report| report.is_fault());
        let silent = moment.silent > machine.lost_frames && turns(machine, axis, moment);
        if enabled && (fault || silent) {
            let what = if fault {
                "fault while enabled"
            } else {
                "silent while it turned"
            };
            findings.add("exit-0-after-failure", moment, what.to_string());
            return;
        }
        let state = moment.last().map_or(0, |report| report.statusword & 0x6f);
        enabled = matches!(state, 0x27 | 0x07);
    }
}

/// A drive that was in Operation enabled and reports another state has lost its power: the axis takes
/// the command to enable back, and a run that goes on without the axis does not end well. An
/// unlisted Statusword says nothing about the power (`docs/stops.md`).
fn power_lost(axis: &Axis, view: &[Moment], report: &Report, findings: &mut Findings<'_>) {
    let mut since: Option<usize> = None;
    let mut enabled = false;
    for moment in view {
        let state = moment.last().map_or(0, |report| report.statusword & 0x6f);
        let listed = matches!(state, 0x00 | 0x20 | 0x40 | 0x60 | 0x21 | 0x23);
        let lost = enabled && moment.requests_operation() && listed;
        if moment.age > 0 {
            continue;
        }
        since = if lost {
            since.or(Some(moment.cycle))
        } else {
            None
        };
        let cycles = since.map_or(0, |since| moment.cycle - since);
        if cycles > UNPOWERED * axis.period {
            let detail = format!("Statusword {state:02x} for {cycles} cycles while enabled");
            findings.add("operation-requested-without-power", moment, detail);
            return;
        }
        if lost && report.exit == 0 && !axis.alone && !axis.node_fails {
            findings.add(
                "exit-0-after-power-loss",
                moment,
                format!("Statusword {state:02x}"),
            );
        }
        enabled = moment.requests_operation() && (enabled || moment.is_operation_enabled());
    }
}

/// Power returns by a command only: the program has as many as the drive gets power.
fn enabled_too_often(axis: &Axis, view: &[Moment], findings: &mut Findings<'_>) {
    let mut count = 0;
    let mut powered = false;
    for moment in view.iter().filter(|moment| moment.age == 0) {
        let Some(report) = moment.last() else {
            continue;
        };
        let enabled = report.is_operation_enabled();
        // A gateway that restarts shows a powered drive again, without a command to it.
        count += usize::from(enabled && !powered && moment.requests_operation());
        // A quick stop that ends in motion continues the same power.
        powered = enabled || powered && report.is_quick_stop();
        if count > axis.enables && !axis.node_fails {
            let detail = format!("{count} times, the program has {}", axis.enables);
            findings.add("power-without-command", moment, detail);
            return;
        }
    }
}

/// All drives are without power at the end (`docs/architecture.md`, "A run", 5).
fn end(view: &[Moment], findings: &mut Findings<'_>) {
    if let Some(last) = view.last().filter(|last| last.requests_operation()) {
        let detail = format!("last Controlword {:04x}", last.sent.controlword);
        findings.add("power-at-the-end", last, detail);
    }
}
