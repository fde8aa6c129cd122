//! Data that must never reach a drive, in any cycle and after any fault. Each rule names its
//! document.

use super::judge::{Finding, Findings};
use super::view::{Axis, CSP, CST, CSV, Machine, Moment};
use super::wire::Inputs;

/// A velocity loop adds a bounded part of its own (`docs/axis.md`, "What holds on the wire").
const LOOP_SHARE: f64 = 2.0;
/// `torque_slope`: percent of the torque limit a second (`docs/axis.md`); 100 % in 0.1 s.
const TORQUE_SLOPE: f64 = 10.0;
/// The number of cycles that a set-point continues without an answer (`docs/architecture.md`, "A
/// lost frame").
const RUNS_ON: usize = 2;

pub fn check(machine: &Machine, axis: &Axis, moments: &[Moment], findings: &mut Findings<'_>) {
    let mut previous: Option<&Moment> = None;
    for moment in moments {
        controlword(moment, findings);
        mode_before_operation(axis, previous, moment, findings);
        at_rest_before_operation(axis, moment, findings);
        limits(axis, moment, findings);
        drive_follows(axis, moment, findings);
        previous = Some(moment);
    }
    positions(machine, axis, moments, findings);
    velocities(machine, axis, moments, findings);
    torques(machine, axis, moments, findings);
    range(axis, moments, findings);
    gaps(machine, axis, moments, findings);
}

/// Controlword: a command is sent only in a state from which it causes a transition, as last
/// reported (IEC 61800-7-201, table 27 and figure 11).
fn controlword(moment: &Moment, findings: &mut Findings<'_>) {
    let word = moment.sent.controlword;
    // The newest reports may have come too late for this cycle.
    let reports: Vec<Inputs> = moment
        .recent()
        .iter()
        .take(2)
        .copied()
        .chain(moment.in_time)
        .collect();
    let any = |allowed: &[u16]| {
        reports
            .iter()
            .any(|report| allowed.contains(&(report.statusword & 0x6f)))
    };
    let detail = || {
        let words: Vec<String> = reports
            .iter()
            .map(|report| format!("{:04x}", report.statusword))
            .collect();
        format!("Controlword {word:04x} at Statusword {}", words.join(", "))
    };
    if reports.is_empty() {
        if word != 0 {
            findings.add("controlword-before-report", moment, detail());
        }
        return;
    }
    let fault = reports.iter().all(|report| report.is_fault());
    let (ready, on, enabled, quick) = (0x21, 0x23, 0x27, 0x07);
    if moment.requests_operation() && (fault || !any(&[on, enabled, quick])) {
        findings.add("controlword", moment, detail());
    }
    if word & 0x8f == 0x07 && (fault || !any(&[ready, on, enabled])) {
        findings.add("controlword", moment, detail());
    }
    if word & 0x80 != 0 && !reports.iter().any(|report| report.is_fault()) {
        findings.add("controlword", moment, detail());
    }
}

/// Operation enabled is requested only after 0x6061 shows the mode (`docs/axis.md`).
fn mode_before_operation(
    axis: &Axis,
    previous: Option<&Moment>,
    moment: &Moment,
    findings: &mut Findings<'_>,
) {
    let requested = |moment: &Moment| moment.requests_operation();
    if !requested(moment) || previous.is_some_and(requested) {
        return;
    }
    let asked = moment.asked(axis);
    let reports = &moment.recent()[..moment.recent().len().min(2)];
    if reports
        .iter()
        .all(|report| report.mode.is_some_and(|shown| shown != asked))
    {
        let detail = format!("0x6060 {asked}, 0x6061 {}", moment.shown(axis));
        findings.add("mode-before-operation", moment, detail);
    }
}

/// Before Operation enabled the target is one of the positions reported last, other targets are 0
/// (`docs/architecture.md`, "An axis never surprises").
fn at_rest_before_operation(axis: &Axis, moment: &Moment, findings: &mut Findings<'_>) {
    let reports = moment.recent();
    // Bit 9: the drive processes the target.
    let moves = |report: &Inputs| {
        let remote = report.statusword & 0x0200 != 0;
        report.is_operation_enabled() || report.is_quick_stop() || !remote
    };
    if reports.is_empty() || moment.age > 0 || reports.iter().take(2).any(moves) {
        return;
    }
    let sent = &moment.sent;
    if let Some(target) = sent.position
        && !reports.iter().any(|report| report.position == target)
    {
        let actual: Vec<i32> = reports.iter().map(|report| report.position).collect();
        findings.add(
            "target-before-operation",
            moment,
            format!("{target}, actual {actual:?}"),
        );
    }
    let velocity = sent.velocity.unwrap_or(0);
    let torque = sent.torque.unwrap_or(0);
    if velocity != 0 || torque != 0 {
        let detail = format!(
            "0x60FF {velocity}, 0x6071 {torque}, mode {}",
            moment.asked(axis)
        );
        findings.add("target-before-operation", moment, detail);
    }
}

/// In CSP, CSV and CST bit 12 says that the drive follows its target; until it does, the target is
/// the actual value (IEC 61800-7-201, 16.3, 17.3 and 18.3).
fn drive_follows(axis: &Axis, moment: &Moment, findings: &mut Findings<'_>) {
    let reports = moment.recent();
    let ignores = |report: &Inputs| {
        let cyclic = matches!(report.mode.unwrap_or(axis.mode), CSP | CSV | CST);
        cyclic && report.is_operation_enabled() && report.statusword & 0x1000 == 0
    };
    let enough = reports.len() > 3 && reports.iter().all(ignores);
    if !enough || !moment.requests_operation() || moment.age > 0 {
        return;
    }
    let sent = &moment.sent;
    let applies = match moment.shown(axis) {
        CSP => sent
            .position
            .is_some_and(|target| reports.iter().all(|of| of.position != target)),
        CSV => sent.velocity.is_some_and(|target| target != 0),
        _ => sent.torque.is_some_and(|target| target != 0),
    };
    if applies {
        let detail = format!("{sent:?} while Statusword bit 12 is 0");
        findings.add("drive-does-not-follow", moment, detail);
    }
}

/// Commanded values never exceed the limits of the file (`docs/machine-file.md`, "Limits").
fn limits(axis: &Axis, moment: &Moment, findings: &mut Findings<'_>) {
    let sent = &moment.sent;
    let velocity = axis.velocity * axis.velocity_scale + 1.0;
    let acceleration = axis.acceleration * axis.acceleration_scale + 1.0;
    let torque = axis.torque * 10.0 + 1.0;
    let mut hold = |what: &str, value: f64, limit: f64| {
        if value.abs() > limit {
            findings.add("limit", moment, format!("{what} {value}, limit {limit:.1}"));
        }
    };
    hold("0x60FF", f64::from(sent.velocity.unwrap_or(0)), velocity);
    hold("0x6071", f64::from(sent.torque.unwrap_or(0)), torque);
    if moment.requests_operation() {
        hold(
            "0x6081",
            f64::from(sent.profile_velocity.unwrap_or(0)),
            velocity,
        );
        hold(
            "0x6083",
            f64::from(sent.profile_acceleration.unwrap_or(0)),
            acceleration,
        );
        hold(
            "0x6084",
            f64::from(sent.profile_deceleration.unwrap_or(0)),
            acceleration,
        );
    }
}

/// Returns the mode that is definitely active: requested in two consecutive cycles, displayed, and
/// enabled.
fn in_force(axis: &Axis, pair: &[Moment]) -> Option<i8> {
    let [before, now] = pair else { return None };
    let asked = now.asked(axis);
    let certain = now.requests_operation()
        && before.requests_operation()
        && now.is_operation_enabled()
        && before.asked(axis) == asked
        && now.shown(axis) == asked;
    certain.then_some(asked)
}

fn step(pair: &[Moment]) -> Option<i64> {
    Some(
        pair[1]
            .sent
            .position?
            .wrapping_sub(pair[0].sent.position?)
            .into(),
    )
}

/// In CSP a target steps by at most velocity × cycle, and a step changes by at most acceleration ×
/// cycle² (`docs/axis.md`, "What holds on the wire"). The exception: a set-point freezes after more
/// than two cycles without an answer (`docs/architecture.md`, "A lost frame"). Late answers count
/// as answers.
fn positions(machine: &Machine, axis: &Axis, moments: &[Moment], findings: &mut Findings<'_>) {
    let most = axis.velocity_step(machine) + 1.0;
    let change = axis.acceleration_step(machine) + 2.0;
    let mut last_step: Option<i64> = None;
    for three in moments.windows(3) {
        let [_, before, now] = three else { continue };
        let both = in_force(axis, &three[..2]) == Some(CSP);
        if in_force(axis, &three[1..]) != Some(CSP) || !both {
            last_step = None;
            continue;
        }
        let Some(step) = step(&three[1..]) else {
            return;
        };
        let (from, to) = (before.sent.position, now.sent.position);
        if step.abs() as f64 > most {
            let detail = format!("{from:?} → {to:?}: {step} counts, limit {most:.2}");
            findings.add("csp-step", now, detail);
        }
        let frozen = step == 0 && now.silent + now.left_out > RUNS_ON;
        let differs = last_step.map_or(0, |last| (step - last).abs());
        if differs as f64 > change * (1.0 + 1e-6) && !frozen {
            let last = last_step.unwrap_or(0);
            let detail = format!(
                "steps {last} → {step}: {differs} counts, limit {change:.2}; without an answer \
                 for {} cycles, a late one counts as an answer",
                now.silent
            );
            findings.add("csp-acceleration", now, detail);
        }
        last_step = Some(if now.left_out > RUNS_ON { 0 } else { step });
    }
}

/// In CSV the velocity changes by at most acceleration × cycle, and by twice as much with a
/// position loop (`docs/axis.md`, "What holds on the wire").
fn velocities(machine: &Machine, axis: &Axis, moments: &[Moment], findings: &mut Findings<'_>) {
    let share = if axis.loops { LOOP_SHARE } else { 1.0 };
    let change = axis.acceleration * axis.velocity_scale * machine.seconds() * share + 1.5;
    for three in moments.windows(3) {
        let in_csv = |pair| in_force(axis, pair) == Some(CSV);
        if !in_csv(&three[..2]) || !in_csv(&three[1..]) {
            continue;
        }
        let velocity = |moment: &Moment| i64::from(moment.sent.velocity.unwrap_or(0));
        let (from, to) = (velocity(&three[1]), velocity(&three[2]));
        if (to - from).abs() as f64 > change * (1.0 + 1e-6) {
            let detail = format!("{from} → {to}, limit {change:.1}");
            findings.add("csv-acceleration", &three[2], detail);
        }
    }
}

/// In CST without a position loop the torque follows its slope (`docs/axis.md`, `torque_slope`).
fn torques(machine: &Machine, axis: &Axis, moments: &[Moment], findings: &mut Findings<'_>) {
    let change = axis.torque * 10.0 * TORQUE_SLOPE * machine.seconds() + 1.5;
    for three in moments.windows(3).filter(|_| !axis.loops) {
        let in_cst = |pair| in_force(axis, pair) == Some(CST);
        if !in_cst(&three[..2]) || !in_cst(&three[1..]) {
            continue;
        }
        let torque = |moment: &Moment| i32::from(moment.sent.torque.unwrap_or(0));
        let (from, to) = (torque(&three[1]), torque(&three[2]));
        if f64::from((to - from).abs()) > change * (1.0 + 1e-6) {
            let detail = format!("{from} → {to}, limit {change:.1}");
            findings.add("cst-slope", &three[2], detail);
        }
    }
}

/// Targets stay in `limits.position`. The range widens to the axis position at the time of enabling
/// or of motion in another mode (`docs/machine-file.md`, "Limits").
fn range(axis: &Axis, moments: &[Moment], findings: &mut Findings<'_>) {
    let Some((low, high)) = axis.range else {
        return;
    };
    let (mut from, mut to) = (low, high);
    for pair in moments.windows(2) {
        let now = &pair[1];
        let Some(target) = now.sent.position.map(f64::from) else {
            return;
        };
        if in_force(axis, pair) == Some(CSP) {
            if target < from - 1.0 || target > to + 1.0 {
                let detail = format!("target {target} outside {from:.0} to {to:.0}");
                findings.add("position-limit", now, detail);
            }
        } else if let Some(report) = now.last() {
            let actual = f64::from(report.position);
            (from, to) = (low.min(actual - 2.0), high.max(actual + 2.0));
        }
    }
}

/// A drive in CSP holds the target of the last received frame. The next received target is at most
/// three steps away, after any number of lost frames (`docs/architecture.md`, "A lost frame"). This
/// also applies if the requested mode changed and came back.
fn gaps(machine: &Machine, axis: &Axis, moments: &[Moment], findings: &mut Findings<'_>) {
    let step = axis.velocity_step(machine);
    let most = RUNS_ON + machine.answer_to_outputs();
    let mut held: Option<(usize, i32)> = None;
    for (number, now) in moments.iter().enumerate() {
        let Some(target) = now.sent.position else {
            return;
        };
        if !now.requests_operation() {
            held = None;
            continue;
        }
        let takes_csp = now.asked(axis) == CSP && now.is_operation_enabled();
        if !takes_csp {
            // The drive may have left CSP and turned since.
            if findings
                .answer(now)
                .is_some_and(|answer| answer.mode != Some(CSP))
            {
                held = None;
            }
            continue;
        }
        let Some(answer) = findings.answer(now) else {
            continue;
        };
        let in_csp = answer.mode.unwrap_or(axis.mode) == CSP && answer.is_operation_enabled();
        if let Some((before, last)) = held.filter(|_| in_csp) {
            let cycles = number - before;
            let way = f64::from(target.wrapping_sub(last)).abs();
            let limit = cycles.min(most) as f64 * step + 1.0;
            if way > limit {
                let detail = format!(
                    "{last} → {target}: {way} counts, limit {limit:.1}; the drive got the first \
                     {cycles} cycles before"
                );
                findings.add("csp-gap", now, detail);
            }
        }
        held = in_csp.then_some((number, target));
    }
}

impl std::fmt::Display for Finding {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            rule,
            axis,
            cycle,
            at,
            detail,
            count,
        } = self;
        write!(
            f,
            "{rule} ({count}×): {axis}, cycle {cycle}, {at:.4} s: {detail}"
        )
    }
}
