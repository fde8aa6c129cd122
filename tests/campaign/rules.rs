//! Data that must never reach a drive, in any cycle and after any fault. Each rule names its
//! document.

use super::judge::{Finding, Findings};
use super::view::{Axis, CSP, CST, CSV, HOMING, Machine, Moment, RECENT, set_points};
use super::wire::Inputs;

/// A velocity loop adds a bounded part of its own (`docs/axis.md`, "What holds on the wire").
const LOOP_SHARE: f64 = 2.0;
/// `torque_slope`: percent of the torque limit a second (`docs/axis.md`); 100 % in 0.1 s.
const TORQUE_SLOPE: f64 = 10.0;
/// The number of cycles that a set-point continues without an answer (`docs/architecture.md`, "A
/// lost frame").
const RUNS_ON: usize = 2;
/// The cycles for which a command may stay in a state that does not permit it.
const HELD: usize = 10;

pub fn check(machine: &Machine, axis: &Axis, moments: &[Moment], findings: &mut Findings<'_>) {
    let moments = &set_points(axis, moments)[..];
    let mut previous: Option<&Moment> = None;
    let mut held = 0;
    for moment in moments {
        // A command stays while the drive reports a state that it does not have for long.
        let stays = |last: &Moment| last.sent.controlword == moment.sent.controlword;
        held = match broken_controlword(moment) {
            None => 0,
            Some(_) => held + 1,
        };
        let fault = moment.last().is_some_and(Inputs::is_fault);
        // Words that CiA 402 does not list hold the command for a second.
        let most = match moment.last().is_some_and(is_unlisted) {
            true => HELD + usize::try_from(1_000_000_000 / machine.cycle_ns).unwrap_or(usize::MAX),
            false => HELD,
        };
        if held > 0 && (held > most || fault || !previous.is_some_and(stays)) {
            controlword(moment, findings);
        }
        mode_before_operation(axis, previous, moment, findings);
        at_rest_before_operation(axis, moment, findings);
        limits(axis, moment, findings);
        drive_follows(axis, moment, findings);
        previous = Some(moment);
    }
    positions(machine, axis, moments, findings);
    velocities(machine, axis, moments, findings);
    torques(machine, axis, moments, findings);
    range(machine, axis, moments, findings);
    gaps(machine, axis, moments, findings);
}

/// Controlword: a command is sent only in a state from which it causes a transition, as last
/// reported (IEC 61800-7-201, table 27 and figure 11).
fn controlword(moment: &Moment, findings: &mut Findings<'_>) {
    let Some(rule) = broken_controlword(moment) else {
        return;
    };
    let words: Vec<String> = reports(moment)
        .iter()
        .map(|report| format!("{:04x}", report.statusword))
        .collect();
    let word = moment.sent.controlword;
    let detail = format!("Controlword {word:04x} at Statusword {}", words.join(", "));
    findings.add(rule, moment, detail);
}

/// The newest reports may have come too late for this cycle.
fn reports(moment: &Moment) -> Vec<Inputs> {
    let recent = moment.recent().iter().take(2).copied();
    recent.chain(moment.in_time).collect()
}

/// Neither a state that lasts nor a fault (IEC 61800-7-201, table 30).
fn is_unlisted(report: &Inputs) -> bool {
    let lasting = [0x21, 0x23, 0x27, 0x07, 0x40, 0x60];
    !report.is_fault() && !lasting.contains(&(report.statusword & 0x6f))
}

fn broken_controlword(moment: &Moment) -> Option<&'static str> {
    let word = moment.sent.controlword;
    let reports = reports(moment);
    if reports.is_empty() {
        return (word != 0).then_some("controlword-before-report");
    }
    let any = |allowed: &[u16]| {
        reports
            .iter()
            .any(|report| allowed.contains(&(report.statusword & 0x6f)))
    };
    let fault = reports.iter().all(|report| report.is_fault());
    let (ready, on, enabled, quick) = (0x21, 0x23, 0x27, 0x07);
    let operation = moment.requests_operation() && (fault || !any(&[on, enabled, quick]));
    let switch_on = word & 0x8f == 0x07 && (fault || !any(&[ready, on, enabled]));
    let reset = word & 0x80 != 0 && !reports.iter().any(|report| report.is_fault());
    (operation || switch_on || reset).then_some("controlword")
}

/// Operation enabled is requested only after 0x6061 shows the mode (`docs/axis.md`).
fn mode_before_operation(
    axis: &Axis,
    previous: Option<&Moment>,
    moment: &Moment,
    findings: &mut Findings<'_>,
) {
    let requested = |moment: &Moment| moment.requests_operation();
    if !axis.shows_mode || !requested(moment) || previous.is_some_and(requested) {
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

/// Before Operation enabled, outputs may follow any of so many reports.
const FOLLOWED: usize = 4;

/// Before Operation enabled the target is one of the positions reported last, other targets are 0
/// (`docs/architecture.md`, "An axis never surprises").
fn at_rest_before_operation(axis: &Axis, moment: &Moment, findings: &mut Findings<'_>) {
    let reports = &moment.recent()[..moment.recent().len().min(FOLLOWED)];
    if moment.asked(axis) == HOMING || moment.shown(axis) == HOMING {
        return;
    }
    // A node that returns is known to be OPERATIONAL only after its reports; until then it gets a
    // quick stop.
    if axis.period > 1 && moment.sent.controlword & 0x06 != 0x06 {
        return;
    }
    // Bit 9: the drive processes the target.
    let moves = |report: &Inputs| {
        let remote = report.statusword & 0x0200 != 0;
        let listed = report.is_listed();
        report.is_operation_enabled() || report.is_quick_stop() || !remote || !listed
    };
    let certain = !reports.is_empty() && moment.age == 0 && !moment.doubtful && !axis.node_fails;
    if !certain || reports.iter().take(2).any(moves) {
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
/// the actual value (IEC 61800-7-201, 16.3, 17.3 and 18.3). A bit that is lost counts after ten
/// cycles (`docs/axis.md`).
fn drive_follows(axis: &Axis, moment: &Moment, findings: &mut Findings<'_>) {
    let reports = moment.recent();
    if !axis.follows_bit {
        return;
    }
    let ignores = |report: &Inputs| {
        let cyclic = matches!(report.mode.unwrap_or(axis.mode), CSP | CSV | CST);
        cyclic && report.is_operation_enabled() && report.statusword & 0x1000 == 0
    };
    let enough = reports.len() == RECENT && reports.iter().all(ignores);
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
        && now.has_followed(axis)
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
/// than two cycles without an answer, also of the other half of a gantry
/// (`docs/architecture.md`, "A lost frame"). Late answers count
/// as answers.
fn positions(machine: &Machine, axis: &Axis, moments: &[Moment], findings: &mut Findings<'_>) {
    let most = axis.set_point_step(machine) + 1.0;
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
        let waits = |moment: &Moment| {
            let silent = moment.silent.max(moment.half_silent);
            silent + moment.left_out > RUNS_ON * axis.period
        };
        let frozen = step == 0 && (waits(now) || axis.node_fails);
        // A frozen set-point starts again from rest. Behind a gateway, a set-point may stay for two
        // SYNCs because the answer that shows the first one was lost; it then goes on at its speed. An
        // answer in a SYNC counts for the whole of it.
        let left_out = axis.node && now.cycle > before.cycle + axis.period;
        let goes_on = last_step.filter(|_| left_out || axis.node && waits(before));
        if waits(before) || left_out {
            last_step = last_step.map(|_| 0);
        }
        let differs = [last_step, goes_on].into_iter().flatten();
        let differs = differs.map(|last| (step - last).abs()).min().unwrap_or(0);
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
fn range(machine: &Machine, axis: &Axis, moments: &[Moment], findings: &mut Findings<'_>) {
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
            // An axis that moves while it is enabled comes to rest within its limits.
            let braking = now.speed / (2.0 * axis.acceleration_step(machine));
            let way = now.speed * (4.0 + braking) + 2.0;
            (from, to) = (low.min(actual - way), high.max(actual + way));
        }
    }
}

/// A drive in CSP holds the target of the last received frame. The next received target is at most
/// three steps away, after any number of lost frames (`docs/architecture.md`, "A lost frame"). This
/// also applies if the requested mode changed and came back.
fn gaps(machine: &Machine, axis: &Axis, moments: &[Moment], findings: &mut Findings<'_>) {
    // A gateway holds a target for a SYNC, and its answer does not show what a node received.
    if axis.period > 1 {
        return;
    }
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
            // Until 0x6061 shows CSP, targets follow the reported positions.
            let reported = now.recent().windows(2).map(|pair| {
                let way = pair[0].position.wrapping_sub(pair[1].position);
                f64::from(way).abs()
            });
            let step = match now.shown(axis) {
                CSP => step,
                _ => reported.take(3).fold(step, f64::max),
            };
            let way = f64::from(target.wrapping_sub(last)).abs();
            // Both targets are rounded.
            let limit = cycles.min(most) as f64 * step + 2.0;
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
