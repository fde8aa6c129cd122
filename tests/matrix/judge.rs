//! The rules of the matrix. They see the recording, the machine as the builder wrote it, and the
//! text that the user reads. They share no code with the packages of this workspace.

use super::drive::{Moment, Power};
use super::features::{Axis, Feature, Profile, Role};

/// The time of a cycle in s.
const DT: f64 = 0.001;
/// Reported speeds are means over these cycles.
const MEAN: usize = 8;
/// Cycles from the report of a cause to the outputs that respond to it.
pub const REACTION: usize = 2;
/// Cycles within which the speed of a drive follows its targets.
const LAG: usize = 12;
/// The time at rest before the power goes (`docs/motion.md`, "Groups"), with the dead time.
const SETTLES_S: f64 = 0.15;
/// A quick stop uses the ramp of the drive (0x6085).
const QUICK_STOP_S: f64 = 1.0;
/// The power goes this time after rest at the latest.
const POWER_OFF_S: f64 = 0.5;

/// What an axis must do because of a cause (`docs/stops.md`, "What each drive receives").
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Expect {
    /// It receives what it receives without the cause.
    Undisturbed,
    /// Likewise until the program fails; then it decelerates within its limits.
    UntilProgramFails,
    /// It decelerates within its limits, then loses its power.
    Ramp,
    /// Likewise; later it is reset and enabled, and stays where it is.
    RampThenReset,
    /// Its drive stops it, then it loses its power.
    QuickStop,
    /// It receives quick stop; its drive may be out of reach.
    Lost,
    /// The drive's own reaction to its fault.
    OwnFault,
    /// It comes to rest on its way, and goes on when the hold ends.
    Hold,
}

/// The rules. For each, `tampered` changes a recording so that the rule is violated.
pub const RULES: [&str; 27] = [
    "acceleration-limit",
    "another-end",
    "another-motion",
    "cause-not-named",
    "differs-before-the-cause",
    "disturbed",
    "does-not-continue",
    "moves-after-a-reset",
    "moves-in-a-hold",
    "no-cause",
    "no-halt",
    "no-stop",
    "not-a-quick-stop",
    "not-at-rest",
    "output",
    "power-again",
    "power-at-the-end",
    "power-begins-with-a-step",
    "power-removed-in-motion",
    "power-stays",
    "profile-limit",
    "quick-stop-is-late",
    "relation",
    "run-failed",
    "run-succeeded",
    "speed-gained",
    "velocity-limit",
];

/// A violated rule.
#[derive(Debug, Clone)]
pub struct Finding {
    pub rule: &'static str,
    pub axis: usize,
    pub cycle: usize,
    pub detail: String,
    /// The number of violations.
    pub count: usize,
}

/// What a run has shown.
#[derive(Debug, Clone, Default)]
pub struct Run {
    /// The axes in the order of [`Feature::all_axes`].
    pub axes: Vec<Vec<Moment>>,
    /// The inputs of the terminal `io`, and the output at positions.
    pub inputs: Vec<Option<u8>>,
    pub output: Vec<Option<u8>>,
    /// An input of the device that is lost, and the node in error of a gateway.
    pub lost: Vec<Option<u8>>,
    pub node: Vec<Option<u8>>,
    /// The motion of the feature ends at a position of the program.
    pub ends_at_target: bool,
    /// The first two axes are the halves of a gantry.
    pub halves: bool,
    pub error: Option<String>,
    /// Everything that the user reads.
    pub said: String,
}

/// Collects the findings of one axis.
struct Findings {
    axis: usize,
    list: Vec<Finding>,
}

impl Findings {
    fn add(&mut self, rule: &'static str, cycle: usize, detail: String) {
        assert!(RULES.contains(&rule), "{rule}");
        if let Some(first) = self.list.iter_mut().find(|finding| finding.rule == rule) {
            first.count += 1;
            return;
        }
        self.list.push(Finding {
            rule,
            axis: self.axis,
            cycle,
            detail,
            count: 1,
        });
    }
}

fn operates(moment: &Moment) -> bool {
    moment.sent.is_some_and(|sent| sent.power == Power::Operate)
}

/// Returns the target of a cycle in which the drive is to operate.
fn target(moment: &Moment) -> Option<i32> {
    let sent = moment.sent.filter(|sent| sent.power == Power::Operate)?;
    sent.position
}

/// Returns the reported speed in counts per cycle before this cycle.
pub fn speed(moments: &[Moment], cycle: usize) -> Option<f64> {
    let from = cycle.checked_sub(MEAN + 1)?;
    let all = moments.get(from..cycle)?;
    let [first, last] = [all.first()?, all.last()?].map(|moment| moment.report);
    let way = last?.position.wrapping_sub(first?.position);
    Some(f64::from(way).abs() / (all.len() - 1) as f64)
}

impl Axis {
    /// Returns the counts per cycle at the velocity limit.
    pub fn step(&self) -> f64 {
        self.velocity * self.counts * DT
    }

    /// Returns the counts per cycle below which the axis is at rest: twice the default of
    /// `supervise.standstill`.
    pub fn rest(&self) -> f64 {
        self.step() * 0.02 + 0.5
    }
}

fn cycles(seconds: f64) -> usize {
    (seconds / DT) as usize
}

/// The cycles of a cause.
#[derive(Debug, Clone, Copy)]
pub struct Times {
    /// The first cycle that shows it.
    pub shows: usize,
    /// The cycle in which it counts: after `lost_frames` cycles, for what is missing.
    pub counts: usize,
    /// The end of a hold.
    pub ends: usize,
    /// The cycle whose outputs respond.
    pub responds: usize,
}

/// Judges an axis of a run against the reference without a cause.
pub fn judge(
    (number, axis): (usize, &Axis),
    run: &Run,
    reference: &Run,
    expect: Expect,
    times: Times,
) -> Vec<Finding> {
    let mut findings = Findings {
        axis: number,
        list: Vec::new(),
    };
    let (moments, before) = (&run.axes[number], &reference.axes[number]);
    let (from, until) = (times.counts.min(moments.len()), times.ends);
    let respond = times.responds;
    let rule = "differs-before-the-cause";
    same(moments, before, times.shows, rule, &mut findings);
    power_begins_at_rest(axis, moments, &mut findings);
    // The set-points of a gantry wait for both halves.
    let mut answered: Vec<bool> = moments
        .iter()
        .map(|moment| moment.report.is_some())
        .collect();
    if axis.role == Role::Half || run.halves && number == 0 {
        for (answered, other) in answered.iter_mut().zip(&run.axes[1 - number]) {
            *answered &= other.report.is_some();
        }
    }
    limits(axis, moments, &answered, &mut findings);
    match expect {
        Expect::Undisturbed => {
            // The program may end later: what stops meanwhile is explained first.
            let end = program_end(reference.axes.last().expect("the witness"));
            same(moments, before, end, "disturbed", &mut findings);
            let rule = "power-removed-in-motion";
            power_ends_at_rest(
                axis,
                moments,
                0,
                &[Power::QuickStop, Power::Off],
                rule,
                &mut findings,
            );
        }
        Expect::UntilProgramFails => {
            let differs = |n: &usize| moments[*n].sent != before.get(*n).and_then(|of| of.sent);
            let fails = (from..moments.len()).find(differs).unwrap_or(moments.len());
            stops(axis, moments, fails, fails, Expect::Ramp, &mut findings);
        }
        Expect::Hold => {
            let ends_at_target = run.ends_at_target && axis.role != Role::Witness;
            hold(
                axis,
                moments,
                before,
                [from, until],
                ends_at_target,
                &mut findings,
            );
        }
        _ => stops(axis, moments, from, respond, expect, &mut findings),
    }
    if let Some(last) = moments.last()
        && let Some(sent) = last.sent.filter(|sent| sent.power != Power::Off)
    {
        let detail = format!("the last word is {:04x}", sent.word);
        findings.add("power-at-the-end", moments.len() - 1, detail);
    }
    findings.list
}

/// The drive receives the same as in the reference.
fn same(
    moments: &[Moment],
    reference: &[Moment],
    end: usize,
    rule: &'static str,
    findings: &mut Findings,
) {
    if moments.len() < end {
        let detail = format!("the run ends after {} cycles, not {end}", moments.len());
        findings.add(rule, moments.len() - 1, detail);
    }
    for (cycle, (now, before)) in moments.iter().zip(reference).enumerate().take(end) {
        if now.sent != before.sent {
            findings.add(
                rule,
                cycle,
                format!("{:x?}, not {:x?}", now.sent, before.sent),
            );
        }
    }
}

/// The first target with power is the reported position.
fn power_begins_at_rest(axis: &Axis, moments: &[Moment], findings: &mut Findings) {
    for (cycle, pair) in moments.windows(2).enumerate() {
        if operates(&pair[0]) || !operates(&pair[1]) || axis.profile == Profile::Goals {
            continue;
        }
        let (Some(target), Some(report)) = (target(&pair[1]), pair[0].report) else {
            continue;
        };
        let step = f64::from(target.wrapping_sub(report.position)).abs();
        if step > axis.rest() + 2.0 {
            let detail = format!("target {target}, actual {}", report.position);
            findings.add("power-begins-with-a-step", cycle + 1, detail);
        }
    }
}

/// Set-points keep the limits of the file while the drive operates.
fn limits(axis: &Axis, moments: &[Moment], answered: &[bool], findings: &mut Findings) {
    if axis.profile == Profile::Goals {
        return goals(axis, moments, findings);
    }
    if axis.steps > 1 {
        return staircase(axis, moments, findings);
    }
    let targets: Vec<Option<i32>> = moments.iter().map(target).collect();
    let step = |cycle: usize| {
        let way = targets[cycle]?.wrapping_sub(targets[cycle - 1]?);
        Some(f64::from(way))
    };
    let steps: Vec<Option<f64>> = (0..targets.len())
        .map(|cycle| step(cycle.max(1).min(targets.len() - 1)))
        .collect();
    for (cycle, now) in steps.iter().enumerate() {
        let most = axis.step() + 1.0;
        if let Some(now) = now.filter(|now| now.abs() > most) {
            findings.add(
                "velocity-limit",
                cycle,
                format!("a step of {now}, at most {most:.1}"),
            );
        }
    }
    // The mean acceleration over any of these times.
    for window in [1, 4, 16] {
        let most = axis.acceleration * axis.counts * DT * DT * window as f64 + 2.0;
        let mut gap: usize = 0;
        for (cycle, answered) in answered.iter().enumerate() {
            // Where frames are lost, the set-point waits, then begins again from rest.
            gap = if *answered {
                gap.saturating_sub(1)
            } else {
                window + 4
            };
            if cycle < window || gap > 0 || steps[cycle - window..cycle].iter().any(Option::is_none)
            {
                continue;
            }
            let (Some(now), Some(before)) = (steps[cycle], steps[cycle - window]) else {
                continue;
            };
            if (now - before).abs() > most {
                let detail =
                    format!("steps {before} → {now} in {window} cycles, at most {most:.1}");
                findings.add("acceleration-limit", cycle, detail);
            }
        }
    }
}

/// The drive makes the profile: goal and profile keep the limits.
fn goals(axis: &Axis, moments: &[Moment], findings: &mut Findings) {
    // rpm and rpm/s.
    let [velocity, acceleration] = [axis.velocity, axis.acceleration].map(|limit| limit * 60.0);
    for (cycle, moment) in moments.iter().enumerate() {
        let Some(sent) = moment.sent.filter(|sent| sent.power == Power::Operate) else {
            continue;
        };
        let goal = sent.velocity.map_or(0.0, |value| f64::from(value).abs());
        let profile = sent.profile_velocity.map_or(0.0, f64::from);
        let ramps = sent.ramps.map(|ramp| ramp.map_or(0.0, f64::from));
        if goal.max(profile) > velocity + 1.0 || ramps[0].max(ramps[1]) > acceleration + 1.0 {
            findings.add("profile-limit", cycle, format!("{sent:?}"));
        }
        let most = axis.step() * 1.2;
        if let Some(speed) = speed(moments, cycle).filter(|speed| *speed > most) {
            findings.add(
                "velocity-limit",
                cycle,
                format!("{speed:.1} counts a cycle"),
            );
        }
    }
}

/// Each set-point of a node holds for a SYNC period.
fn staircase(axis: &Axis, moments: &[Moment], findings: &mut Findings) {
    let period = axis.steps as f64 * DT;
    let (velocity, acceleration) = (
        axis.velocity * axis.counts * period + 1.0,
        axis.acceleration * axis.counts * period * period + 2.0,
    );
    let (mut last, mut before, mut gap) = (None::<(usize, i32)>, 0.0, 0);
    for (cycle, moment) in moments.iter().enumerate() {
        gap = if moment.report.is_none() {
            4 * axis.steps
        } else {
            gap.saturating_sub(1)
        };
        let Some(now) = target(moment) else {
            (last, before) = (None, 0.0);
            continue;
        };
        let Some((then, previous)) = last else {
            last = Some((cycle, now));
            continue;
        };
        if now == previous {
            continue;
        }
        let step = f64::from(now.wrapping_sub(previous));
        if cycle - then > axis.steps * 8 / 5 {
            before = 0.0;
        }
        if step.abs() > velocity || gap == 0 && (step - before).abs() > acceleration {
            let detail = format!(
                "steps {before} → {step}, at most {velocity:.1} and {acceleration:.1} more"
            );
            findings.add("acceleration-limit", cycle, detail);
        }
        (last, before) = (Some((cycle, now)), step);
    }
}

/// Power is not replaced by one of these commands while the drive reports motion.
fn power_ends_at_rest(
    axis: &Axis,
    moments: &[Moment],
    from: usize,
    commands: &[Power],
    rule: &'static str,
    findings: &mut Findings,
) {
    for cycle in from.max(1)..moments.len() {
        let [before, now] = [cycle - 1, cycle].map(|n| moments[n].sent.map(|sent| sent.power));
        let (Some(before), Some(now)) = (before, now) else {
            continue;
        };
        let worse = before != now && commands.contains(&now);
        let powered = moments[cycle - 1]
            .report
            .is_some_and(|report| report.powered);
        if let Some(speed) = speed(moments, cycle)
            && worse
            && powered
            && speed > axis.rest()
        {
            let detail = format!("{before:?} → {now:?} at {speed:.1} counts a cycle");
            findings.add(rule, cycle, detail);
        }
    }
}

/// A stop: no gain of speed, rest in time, then no power, and never again.
fn stops(
    axis: &Axis,
    moments: &[Moment],
    from: usize,
    respond: usize,
    expect: Expect,
    findings: &mut Findings,
) {
    let ends = match expect {
        Expect::Ramp | Expect::RampThenReset => &[Power::QuickStop, Power::Off][..],
        Expect::QuickStop => &[Power::Off],
        _ => &[],
    };
    let rule = "power-removed-in-motion";
    power_ends_at_rest(axis, moments, from, ends, rule, findings);
    let moved = (from..moments.len()).find(|cycle| !operates(&moments[*cycle]));
    let ramp = matches!(expect, Expect::Ramp | Expect::RampThenReset);
    if ramp && axis.profile == Profile::Goals {
        halts(
            axis,
            moments,
            [respond, moved.unwrap_or(moments.len())],
            findings,
        );
    }
    match (expect, moved) {
        (Expect::QuickStop | Expect::Lost, Some(cycle)) => {
            let power = moments[cycle].sent.map(|sent| sent.power);
            if power != Some(Power::QuickStop) && cycle > from {
                findings.add(
                    "not-a-quick-stop",
                    cycle,
                    format!("{:?}", moments[cycle].sent),
                );
            }
            let late = axis.steps + usize::from(axis.steps > 1) * 4;
            if expect == Expect::QuickStop && cycle > respond + late - 1 {
                let detail = format!("{} cycles after the cause", cycle - from);
                findings.add("quick-stop-is-late", cycle, detail);
            }
        }
        (_, None) => findings.add("no-stop", from, "operates to the end".to_owned()),
        _ => {}
    }
    gains(axis, moments, from, respond, findings);
    let (rest_s, off_s) = match expect {
        Expect::Ramp | Expect::RampThenReset => (
            axis.ramp_s() + SETTLES_S,
            axis.ramp_s() + SETTLES_S + POWER_OFF_S,
        ),
        _ => (
            axis.ramp_s() + QUICK_STOP_S,
            axis.ramp_s() + QUICK_STOP_S + POWER_OFF_S,
        ),
    };
    for cycle in from + cycles(rest_s)..moments.len() {
        if let Some(speed) = speed(moments, cycle).filter(|speed| *speed > axis.rest()) {
            let detail = format!("{speed:.1} counts a cycle after {rest_s:.2} s");
            findings.add("not-at-rest", cycle, detail);
        }
    }
    // A short run ends at rest as well.
    if !matches!(expect, Expect::Lost | Expect::OwnFault)
        && let Some(speed) = (0..=moments.len())
            .rev()
            .find_map(|cycle| speed(moments, cycle))
        && speed > axis.rest()
    {
        let detail = format!("{speed:.1} counts a cycle at the end");
        findings.add("not-at-rest", moments.len() - 1, detail);
    }
    if expect == Expect::RampThenReset {
        return reset(axis, moments, moved.unwrap_or(from), findings);
    }
    let off = from + cycles(off_s);
    if let Some(cycle) = (off..moments.len()).find(|cycle| operates(&moments[*cycle])) {
        let detail = format!(
            "operates {:.2} s after the cause",
            (cycle - from) as f64 * DT
        );
        findings.add("power-stays", cycle, detail);
    }
    if let Some(moved) = moved
        && let Some(again) = (moved..moments.len()).find(|cycle| operates(&moments[*cycle]))
    {
        findings.add(
            "power-again",
            again,
            format!("power was off in cycle {moved}"),
        );
    }
}

/// An axis that is enabled again stays where it is: nothing has commanded a motion.
fn reset(axis: &Axis, moments: &[Moment], off: usize, findings: &mut Findings) {
    let Some(again) = (off..moments.len()).find(|cycle| operates(&moments[*cycle])) else {
        findings.add(
            "does-not-continue",
            off,
            "it is not enabled again".to_owned(),
        );
        return;
    };
    let position = |cycle: usize| moments[cycle].report.map(|report| report.position);
    let (at, most) = (position(again), (axis.rest() * 2.0 + 2.0) as u32);
    for cycle in again..moments.len() {
        // The first targets are the actual positions.
        let moved = at
            .zip(position(cycle))
            .is_some_and(|(at, now)| at.abs_diff(now) > most);
        if moved {
            findings.add(
                "moves-after-a-reset",
                cycle,
                format!("{} → {}", moments[again], moments[cycle]),
            );
        }
    }
}

/// A drive that makes the profile is halted by bit 8 of the Controlword, or by a velocity of 0.
fn halts(axis: &Axis, moments: &[Moment], [from, to]: [usize; 2], findings: &mut Findings) {
    for (cycle, moment) in moments.iter().enumerate().take(to).skip(from + axis.steps) {
        let Some(sent) = moment.sent else { continue };
        if sent.word & 0x0100 == 0 && sent.velocity != Some(0) {
            findings.add("no-halt", cycle, format!("{sent:x?}"));
        }
    }
}

/// After the cause neither the set-points nor the drive gain speed.
fn gains(axis: &Axis, moments: &[Moment], from: usize, respond: usize, findings: &mut Findings) {
    let mut least = f64::INFINITY;
    let window = axis.steps.max(1) * if axis.steps > 1 { 2 } else { 1 };
    for cycle in (respond + window).max(from + window + 1)..moments.len() {
        if axis.profile == Profile::Goals {
            break;
        }
        let (Some(now), Some(before)) = (target(&moments[cycle]), target(&moments[cycle - window]))
        else {
            break;
        };
        let speed = f64::from(now.wrapping_sub(before)).abs();
        if speed > least + 2.0 {
            let detail = format!("set-points: {least} → {speed} counts a cycle");
            findings.add("speed-gained", cycle, detail);
        }
        least = least.min(speed);
    }
    let mut least = f64::INFINITY;
    for cycle in respond + LAG + MEAN..moments.len() {
        let Some(speed) = speed(moments, cycle) else {
            continue;
        };
        if speed > least + axis.step() * 0.03 + 1.0 {
            let detail = format!("the drive: {least:.1} → {speed:.1} counts a cycle");
            findings.add("speed-gained", cycle, detail);
        }
        least = least.min(speed);
    }
}

/// A held axis comes to rest, does not move, and goes on afterwards.
fn hold(
    axis: &Axis,
    moments: &[Moment],
    reference: &[Moment],
    [from, until]: [usize; 2],
    ends_at_target: bool,
    findings: &mut Findings,
) {
    let rests = from + cycles(axis.ramp_s() + SETTLES_S) + axis.steps;
    let position = |cycle: usize| moments.get(cycle)?.report.map(|report| report.position);
    let (Some(at), Some(sent)) = (position(rests), moments.get(rests).map(target)) else {
        findings.add("does-not-continue", from, "the run ends before".to_owned());
        return;
    };
    let most = (axis.rest() * 2.0 + 2.0) as u32;
    for cycle in rests..until.min(moments.len()) {
        let moved = position(cycle).is_some_and(|now| now.abs_diff(at) > most);
        let commanded = axis.profile == Profile::Positions && target(&moments[cycle]) != sent;
        if moved || commanded {
            let detail = format!("{} → {}", moments[rests], moments[cycle]);
            findings.add("moves-in-a-hold", cycle, detail);
        }
    }
    let ends = |moments: &[Moment]| {
        let last = moments.iter().rposition(operates)?;
        moments[..=last]
            .iter()
            .rev()
            .find_map(|moment| moment.report)
    };
    let moved = |moments: &[Moment], from: usize| {
        let first = moments.get(from)?.report?.position;
        Some(ends(moments)?.position.abs_diff(first))
    };
    // What the reference does after the same cycle, the held axis does after the hold.
    let blocked = |moment: &&Moment| target(moment).is_some();
    let [goal, wanted] =
        [moments, reference].map(|moments| moments.iter().rev().find(blocked).and_then(target));
    if ends_at_target && goal != wanted {
        findings.add("another-end", until, format!("{goal:?}, not {wanted:?}"));
    }
    let idle = moved(reference, from).is_none_or(|way| way <= most);
    if !idle && moved(moments, until).is_none_or(|way| way <= most) {
        findings.add("does-not-continue", until, format!("stands at {at}"));
    }
    let rule = "power-removed-in-motion";
    power_ends_at_rest(
        axis,
        moments,
        from,
        &[Power::QuickStop, Power::Off],
        rule,
        findings,
    );
}

/// The relation between the set-points of the feature's axes, in each cycle in which all operate.
/// It ends where one of them stops alone; the halves of a gantry never part.
pub fn relation(feature: &Feature, run: &Run, stop: usize) -> Vec<Finding> {
    let mut findings = Findings {
        axis: 0,
        list: Vec::new(),
    };
    let Some(relation) = feature.relation else {
        return Vec::new();
    };
    let all = run.axes[0].len();
    let end = if feature.is_gantry() {
        all
    } else {
        stop.min(all)
    };
    for cycle in 0..end {
        let targets = (0..feature.axes.len()).map(|axis| target(&run.axes[axis][cycle]));
        if let Some(targets) = targets.collect::<Option<Vec<i32>>>()
            && let Err(detail) = relation(&targets)
        {
            findings.add("relation", cycle, detail);
        }
    }
    findings.list
}

/// The output is on in its ranges, one cycle late at most, and off without power. From a stop of the
/// group of its axis on it is off. Once its terminal was lost, it stays off where the terminal can
/// receive it, because nothing is reset.
pub fn output(feature: &Feature, run: &Run, stop: usize, lost: Option<usize>) -> Vec<Finding> {
    let mut findings = Findings {
        axis: 0,
        list: Vec::new(),
    };
    let Some((_, [period, low, high])) = feature.output else {
        return Vec::new();
    };
    let inside = |cycle: usize| {
        let at = target(&run.axes[0][cycle])?.rem_euclid(period);
        Some((low..high).contains(&at))
    };
    let mut again = false;
    for cycle in 2..run.output.len() {
        let Some(bits) = run.output[cycle] else {
            continue;
        };
        let on = bits & 1 != 0;
        let places = [cycle - 2, cycle - 1, cycle].map(inside);
        let gone = lost.is_some_and(|lost| cycle >= lost);
        if gone && run.lost[cycle].is_none() {
            continue;
        }
        // Enabled by command after the stop, it may be on again.
        let stopped = cycle >= stop && !again;
        again |= cycle > stop + REACTION && places[1].is_none() && places[2].is_some();
        let off = stopped && cycle >= stop + REACTION || places[2].is_none() || gone;
        let all = |inside: bool| places.iter().all(|place| *place == Some(inside));
        let wrong = match off {
            true => on,
            false if again => on && all(false),
            false => cycle + REACTION < stop && all(!on),
        };
        if wrong {
            findings.add(
                "output",
                cycle,
                format!("on: {on}, in its range: {places:?}"),
            );
        }
    }
    findings.list
}

/// Returns the last cycle in which the witness has its velocity: the program ends there.
pub fn program_end(witness: &[Moment]) -> usize {
    let targets: Vec<Option<i32>> = witness.iter().map(target).collect();
    let steps = targets
        .windows(2)
        .map(|pair| Some(pair[1]?.wrapping_sub(pair[0]?)));
    let steps: Vec<i32> = steps.map(|step| step.unwrap_or(0)).collect();
    let most = steps.iter().copied().max().unwrap_or(0);
    steps.iter().rposition(|step| *step == most).unwrap_or(0) + 1
}

/// The motion is that of the reference, some cycles later: one can be laid over the other so that
/// their steps differ by a rounding (discrete Fréchet distance).
pub fn same_motion((number, axis): (usize, &Axis), run: &Run, reference: &Run) -> Vec<Finding> {
    const LATER: usize = 20;
    const ROUNDING: i32 = 2;
    let mut findings = Findings {
        axis: number,
        list: Vec::new(),
    };
    let steps = |run: &Run| {
        let end = program_end(run.axes.last().expect("the witness"));
        let goal = |moment: &Moment| {
            let sent = moment.sent.filter(|sent| sent.power == Power::Operate)?;
            sent.position.or(sent.velocity)
        };
        let goals: Vec<i32> = run.axes[number].iter().take(end).filter_map(goal).collect();
        goals
            .windows(2)
            .map(|pair| pair[1].wrapping_sub(pair[0]))
            .collect::<Vec<i32>>()
    };
    let (now, before) = (steps(run), steps(reference));
    if now.len().abs_diff(before.len()) > LATER {
        let detail = format!("{}: {} cycles, not {}", axis.name, now.len(), before.len());
        findings.add("another-motion", 0, detail);
        return findings.list;
    }
    // The least largest difference up to each pair, in a band around equal times.
    let mut row = vec![i32::MAX; before.len()];
    for (at, now) in now.iter().enumerate() {
        let last = std::mem::replace(&mut row, vec![i32::MAX; before.len()]);
        let band = at.saturating_sub(LATER)..(at + LATER + 1).min(before.len());
        for other in band {
            let left = other.checked_sub(1);
            let before_both = left.map_or(i32::MAX, |left| last[left].min(row[left]));
            let least = match (at, other) {
                (0, 0) => 0,
                _ => last[other].min(before_both),
            };
            row[other] = least.max((now - before[other]).abs());
        }
        if row.iter().all(|least| *least > ROUNDING) {
            let detail = format!("{}: a step of {now} has no counterpart", axis.name);
            findings.add("another-motion", at, detail);
            return findings.list;
        }
    }
    findings.list
}
