//! Rules between the axes and the terminals of a machine: gantries, outputs at positions, the hold,
//! and the end of the program.

use super::judge::{Finding, Report};
use super::stops::Stop;
use super::view::{Axis, CSP, HOMING, Machine, Moment, Switch};
use super::wire::{Inputs, Wire};

/// The cycles in which the second half of a gantry follows a stop of the first one.
const TOGETHER: usize = 2;
/// The shortest time in cycles for which a rule about a constant state needs it.
const STEADY: usize = 10;

pub fn check(
    machine: &Machine,
    wire: &Wire,
    views: &[Vec<Moment>],
    stop: Option<Stop>,
    report: &Report,
) -> Vec<Finding> {
    let mut findings = Vec::new();
    for halves in &machine.gantries {
        findings.extend(gantry_apart(machine, views, *halves));
        findings.extend(gantry_half_alone(machine, views, *halves));
    }
    for switch in &machine.switches {
        findings.extend(output(machine, wire, views, stop, switch));
    }
    if let Some((terminal, bit)) = machine.hold {
        for (axis, view) in machine.axes.iter().zip(views) {
            findings.extend(held(machine, wire, (terminal, bit), axis, view));
        }
    }
    for (axis, view) in machine.axes.iter().zip(views) {
        findings.extend(goal(axis, view, report));
    }
    findings
}

fn finding(rule: &'static str, axis: &Axis, moment: &Moment, detail: String) -> Option<Finding> {
    Some(Finding {
        rule,
        axis: axis.name.clone(),
        cycle: moment.cycle,
        at: moment.at as f64 * 1e-9,
        detail,
        count: 1,
    })
}

/// True if the drive follows positions of the cycle.
fn follows(axis: &Axis, moment: &Moment) -> bool {
    let commanded = moment.requests_operation() && moment.asked(axis) == CSP;
    commanded && moment.is_operation_enabled() && moment.has_followed(axis)
}

/// Pairs the moments of two axes by their cycles.
fn pairs(
    views: &[Vec<Moment>],
    [first, second]: [usize; 2],
) -> impl Iterator<Item = (&Moment, &Moment)> {
    let second = &views[second];
    views[first].iter().filter_map(move |one| {
        let at = second.partition_point(|other| other.cycle < one.cycle);
        let other = second.get(at).filter(|other| other.cycle == one.cycle)?;
        Some((one, other))
    })
}

/// Both halves receive the same motion (`docs/motion.md`, "Gantries").
fn gantry_apart(machine: &Machine, views: &[Vec<Moment>], halves: [usize; 2]) -> Option<Finding> {
    let [first, second] = halves.map(|half| &machine.axes[half]);
    let mut distance: Option<i64> = None;
    for (one, other) in pairs(views, halves) {
        if !follows(first, one) || !follows(second, other) {
            distance = None;
            continue;
        }
        let (Some(left), Some(right)) = (one.sent.position, other.sent.position) else {
            return None;
        };
        let apart = i64::from(right.wrapping_sub(left));
        if let Some(before) = distance.filter(|before| (before - apart).abs() > 1) {
            let detail = format!("the halves were {before} counts apart, now {apart}");
            return finding("gantry-apart", second, other, detail);
        }
        distance = distance.or(Some(apart));
    }
    None
}

/// No half moves for long after the other one has lost its power (`docs/motion.md`, "Gantries"). A
/// half at rest holds its position until its stop ends.
fn gantry_half_alone(
    machine: &Machine,
    views: &[Vec<Moment>],
    halves: [usize; 2],
) -> Option<Finding> {
    let mut alone = 0;
    let mut both = false;
    for (one, other) in pairs(views, halves) {
        let powered = [one, other].map(Moment::requests_operation);
        let moves = (powered[0] && one.speed > 2.0) || (powered[1] && other.speed > 2.0);
        both = powered == [true; 2] || both && powered != [false; 2];
        alone = if both && moves && powered[0] != powered[1] {
            alone + 1
        } else {
            0
        };
        if alone > TOGETHER {
            let (half, moment) = if powered[0] { (0, one) } else { (1, other) };
            let axis = &machine.axes[halves[half]];
            let detail = format!("enabled for {alone} cycles after the other half");
            return finding("gantry-half-alone", axis, moment, detail);
        }
    }
    None
}

/// The output is off while the axis has no power, while its positions are undefined and after its
/// stop, off away from its ranges, and on inside (`docs/motion.md`, "Outputs at positions").
fn output(
    machine: &Machine,
    wire: &Wire,
    views: &[Vec<Moment>],
    stop: Option<Stop>,
    switch: &Switch,
) -> Option<Finding> {
    let axis = &machine.axes[switch.axis];
    let view = &views[switch.axis];
    let lead = switch.lead_s + 2.0 * machine.seconds();
    let mut inside = 0;
    let mut homed = !switch.homes;
    for pair in view.windows(2) {
        let [before, now] = pair else { continue };
        let in_homing = now.requests_operation() && now.asked(axis) == HOMING;
        // Bits 10 and 12: a drive that keeps its mode is homed before it leaves it.
        let attained = |report: &Inputs| report.statusword & 0x1400 == 0x1400;
        let ended = now.last().is_some_and(attained) && now.sent.controlword & 0x10 == 0;
        let homing = in_homing && !ended;
        homed |= in_homing;
        let terminal = wire.cycles[now.cycle].terminals[switch.terminal];
        let Some(on) = terminal.sent.map(|byte| byte >> switch.bit & 1 != 0) else {
            continue;
        };
        let powered = now.requests_operation() && now.is_operation_enabled() && now.follows(axis);
        if on && !now.requests_operation() {
            let detail = format!("Controlword {:04x}", now.sent.controlword);
            return finding("output-without-power", axis, now, detail);
        }
        if on && (homing || !homed) {
            let why = if homing { "during" } else { "before" };
            return finding("output-undefined", axis, now, format!("on {why} homing"));
        }
        let stopped = stop.filter(|stop| now.cycle > stop.cycle + STEADY);
        if let Some(stop) = stopped.filter(|_| on && !axis.alone) {
            let detail = format!(
                "{} cycles after a stop by {}",
                now.cycle - stop.cycle,
                stop.why
            );
            return finding("output-after-stop", axis, now, detail);
        }
        let (Some(from), Some(to)) = (before.sent.position, now.sent.position) else {
            return None;
        };
        if !powered || now.asked(axis) != CSP || !before.requests_operation() {
            inside = 0;
            continue;
        }
        let step = f64::from(to.wrapping_sub(from)).abs() / machine.seconds();
        let change = axis.acceleration * axis.counts;
        let margin = step * lead + change * lead * lead / 2.0 + 2.0;
        let at = f64::from(to);
        let near = |[low, high]: &[f64; 2]| at > low - margin && at < high + margin;
        let within = |[low, high]: &[f64; 2]| at > low + margin && at < high - margin;
        if on && !switch.ranges.iter().any(near) {
            return finding("output-outside", axis, now, format!("on at {at} counts"));
        }
        let expected = switch.ranges.iter().any(within)
            && now.age == 0
            && stop.is_none_or(|stop| now.cycle < stop.cycle);
        inside = if expected && !on { inside + 1 } else { 0 };
        // A homing that fails leaves the positions undefined.
        if inside > STEADY && !axis.alone && !switch.homes {
            return finding("output-missing", axis, now, format!("off at {at} counts"));
        }
    }
    None
}

/// A held machine does not move, whatever moves it (`docs/motion.md`, "Override and hold").
fn held(
    machine: &Machine,
    wire: &Wire,
    (terminal, bit): (usize, u8),
    axis: &Axis,
    view: &[Moment],
) -> Option<Finding> {
    // A hold decelerates with the limits of the motion, a wave or path as its shape allows.
    let ramp = 4.0 * (axis.velocity / axis.acceleration + axis.acceleration / axis.jerk) + 0.5;
    let ramp = (ramp / machine.seconds()) as usize;
    let mut since: Option<usize> = None;
    for pair in view.windows(2) {
        let [before, now] = pair else { continue };
        let pressed = wire.cycles[now.cycle].terminals[terminal].heard;
        match pressed.map(|byte| byte >> bit & 1 != 0) {
            Some(true) => since = since.or(Some(now.cycle)),
            Some(false) => since = None,
            None => {}
        }
        let cycles = since.map_or(0, |since| now.cycle - since);
        let both = follows(axis, before) && follows(axis, now);
        if cycles > ramp && both && now.sent.position != before.sent.position {
            let detail = format!(
                "{:?} → {:?}, {cycles} cycles after the hold",
                before.sent.position, now.sent.position
            );
            return finding("moves-while-held", axis, now, detail);
        }
    }
    None
}

/// A program that ends without a failure has brought each axis where its last move leads.
fn goal(axis: &Axis, view: &[Moment], report: &Report) -> Option<Finding> {
    let goal = axis.goal.filter(|_| report.exit == 0 && report.completed)? * axis.counts;
    let last = view.iter().rev().find(|moment| follows(axis, moment))?;
    let target = f64::from(last.sent.position?);
    if (target - goal).abs() > 1.5 {
        let detail = format!("the last target is {target}, the program ends at {goal:.1}");
        return finding("done-elsewhere", axis, last, detail);
    }
    None
}
