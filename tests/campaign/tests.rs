//! Tests of the judge with recordings assembled byte by byte: one with no violation, and one with a
//! single violation per rule.

use super::by_hand::{CYCLE, INPUTS, OUTPUTS, Row, recording};
use super::judge::{Finding, Report, judge};
use super::pcapng::{self, Packet};
use super::view::{Axis, CSP, CSV, Machine, Moment, Switch, views};
use super::wire::{self, Profile, packed};

const ENABLED: u16 = 0x1237;

/// Returns a machine of one drive with 2000 counts per turn, 50 turn/s, 500 turn/s², at 1 ms. This
/// gives a step of 100 counts and a change of 1 count per cycle.
fn machine() -> Machine {
    Machine {
        cycle_ns: CYCLE,
        lost_frames: 3,
        pipelined: false,
        axes: vec![Axis {
            name: "x".to_string(),
            position: 1,
            mode: CSP,
            profile: Profile::Cia402,
            outputs: packed(&OUTPUTS, 0),
            inputs: packed(&INPUTS, 0),
            period: 1,
            enables: 1,
            shows_mode: true,
            follows_bit: true,
            goal: None,
            counts: 2000.0,
            velocity_scale: 60.0,
            acceleration_scale: 60.0,
            velocity: 50.0,
            acceleration: 500.0,
            jerk: 10_000.0,
            torque: 100.0,
            range: None,
            loops: false,
            may_lose_power: false,
            disturbed: false,
            node: false,
            node_fails: false,
            alone: false,
        }],
        terminals: Vec::new(),
        gantries: Vec::new(),
        switches: Vec::new(),
        hold: None,
    }
}

/// Returns the rows of a drive that is enabled, accelerates to `speed` counts per cycle, turns,
/// stops and loses power. Its recording violates no rule.
fn fault_report(speed: i32) -> Vec<Row> {
    let row = |controlword, position, statusword, actual| Row {
        controlword,
        mode: CSP,
        position,
        velocity: 0,
        torque: 0,
        answer: Some((statusword, CSP, actual)),
        back: 10_000,
        incomplete: false,
    };
    let mut rows = Vec::new();
    for (controlword, statusword) in [
        (0, 0x0250),
        (0x06, 0x0231),
        (0x06, 0x0231),
        (0x07, 0x0233),
        (0x0f, 0x0233),
    ] {
        rows.push(row(controlword, 500, statusword, 500));
    }
    let mut position = 500;
    let speeds = (0..5)
        .map(|_| 0)
        .chain(0..speed)
        .chain((0..20).map(|_| speed))
        .chain((0..speed).rev())
        .chain((0..150).map(|_| 0));
    for step in speeds {
        let actual = position;
        position += step;
        rows.push(row(0x0f, position, ENABLED, actual));
    }
    for statusword in [ENABLED, 0x0231, 0x0231] {
        rows.push(row(0x06, position, statusword, position));
    }
    rows
}

/// Returns the first cycle at the greatest speed.
fn turning(speed: i32) -> usize {
    10 + speed as usize + 5
}

/// Returns the first cycle of deceleration.
fn braking(speed: i32) -> usize {
    10 + speed as usize + 20
}

struct Case {
    machine: Machine,
    rows: Vec<Row>,
    al_control: Vec<(usize, u8)>,
    report: Report,
}

impl Case {
    /// Creates a case with motion and without faults.
    fn new(speed: i32) -> Self {
        Self {
            machine: machine(),
            rows: fault_report(speed),
            al_control: Vec::new(),
            report: Report::default(),
        }
    }

    fn findings(&self) -> Vec<Finding> {
        let file = recording(&self.rows, &self.al_control);
        let packets: Vec<Packet<'_>> = pcapng::packets(&file).expect("a recording");
        let layout = self.machine.axes[0].layout();
        let wire = wire::read(&packets, &[layout], &[]);
        assert_eq!(wire.cycles.len(), self.rows.len());
        judge(&self.machine, &wire, &self.report)
    }

    #[track_caller]
    fn breaks(&self, rule: &str) {
        let findings = self.findings();
        let broken = findings.iter().any(|finding| finding.rule == rule);
        assert!(broken, "{rule} is not seen: {findings:#?}");
    }

    #[track_caller]
    fn is_clean(&self) {
        let findings = self.findings();
        assert!(findings.is_empty(), "{findings:#?}");
    }

    /// Marks the run as failed, with a report that names the axis.
    fn failed(mut self) -> Self {
        self.report.exit = 1;
        self.report.text = "`x` (position 1): drive fault".to_string();
        self
    }

    /// Converts the axis to CSV: velocities instead of steps, 60 per 1000 counts/s.
    fn in_csv(mut self) -> Self {
        self.machine.axes[0].mode = CSV;
        let mut last = self.rows[0].position;
        for row in &mut self.rows {
            row.mode = CSV;
            row.velocity = (row.position - last) * 30;
            last = row.position;
            if let Some(answer) = &mut row.answer {
                answer.1 = CSV;
                row.position = answer.2;
            }
        }
        self
    }
}

#[test]
fn judge_accepts_a_correct_run() {
    Case::new(40).is_clean();
    Case::new(100).is_clean();
    Case::new(40).in_csv().is_clean();
}

#[test]
fn judge_finds_a_step_above_the_velocity_limit() {
    Case::new(103).breaks("csp-step");
    let mut jump = Case::new(40);
    for row in &mut jump.rows[turning(40)..] {
        row.position += 200;
    }
    jump.breaks("csp-step");
    jump.breaks("csp-acceleration");
}

#[test]
fn judge_accepts_a_freeze_only_with_a_reason() {
    let freeze = |answered: bool, back: u64| {
        let mut case = Case::new(40);
        case.machine.lost_frames = 10;
        let from = turning(40);
        let held = case.rows[from + 2].position;
        for row in &mut case.rows[from..from + 4] {
            row.back = back;
            if !answered {
                row.answer = None;
            }
        }
        // The set-point freezes after two cycles and starts from rest.
        let mut position = held;
        for (number, row) in case.rows[from + 3..].iter_mut().enumerate() {
            let step = (number as i32 - 3).clamp(0, 10);
            position += step;
            row.position = position;
            if row.controlword != 0x0f {
                row.position = position - step;
            }
            row.answer = row.answer.map(|of| (of.0, of.1, row.position));
        }
        case.rows.truncate(from + 12);
        case.findings()
            .iter()
            .any(|finding| finding.rule == "csp-acceleration")
    };
    assert!(!freeze(false, 10_000), "nothing came back");
    assert!(freeze(true, 10_000), "everything came back");
    assert!(freeze(true, 850_000), "everything came back, late");
}

#[test]
fn judge_finds_a_target_far_from_the_last_one_before_a_gap() {
    let mut case = Case::new(100);
    case.machine.lost_frames = 10;
    let from = turning(100);
    for row in &mut case.rows[from..from + 5] {
        row.answer = None;
    }
    // The set-point continued over the whole gap.
    case.breaks("csp-gap");
}

#[test]
fn judge_finds_a_far_target_after_csp_is_requested_again() {
    let mut case = Case::new(40);
    case.machine.lost_frames = 10;
    let from = turning(40);
    for row in &mut case.rows[from..from + 3] {
        (row.mode, row.answer) = (CSV, None);
    }
    for row in &mut case.rows[from + 3..] {
        row.position += 400;
    }
    case.breaks("csp-gap");
}

#[test]
fn judge_finds_a_velocity_step() {
    let mut case = Case::new(40).in_csv();
    case.rows[turning(40)].velocity += 100;
    case.breaks("csv-acceleration");
}

#[test]
fn judge_finds_targets_above_the_limits() {
    let mut velocity = Case::new(10).in_csv();
    velocity.rows[turning(10)].velocity = 3002;
    velocity.breaks("limit");
    let mut torque = Case::new(10);
    torque.rows[turning(10)].torque = -1002;
    torque.breaks("limit");
    let mut position = Case::new(40);
    position.machine.axes[0].range = Some((0.0, 1000.0));
    position.breaks("position-limit");
}

#[test]
fn judge_finds_targets_before_operation_enabled() {
    let mut position = Case::new(10);
    position.rows[3].position = 501;
    position.breaks("target-before-operation");
    let mut velocity = Case::new(10);
    velocity.rows[3].velocity = 1;
    velocity.breaks("target-before-operation");
}

#[test]
fn judge_finds_a_controlword_in_the_wrong_state() {
    let mut early = Case::new(10);
    early.rows[2].controlword = 0x0f;
    early.breaks("controlword");
    let mut reset = Case::new(10);
    reset.rows[2].controlword = 0x80;
    reset.breaks("controlword");
    let mut fault = Case::new(10).failed();
    let from = turning(10);
    for row in &mut fault.rows[from..] {
        row.answer = row.answer.map(|of| (0x0218, of.1, of.2));
    }
    fault.breaks("controlword");
}

#[test]
fn judge_finds_operation_requested_in_another_mode() {
    let mut case = Case::new(10);
    for row in &mut case.rows[..8] {
        row.answer = row.answer.map(|of| (of.0, 10, of.2));
    }
    case.breaks("mode-before-operation");
}

#[test]
fn judge_finds_a_target_while_the_drive_does_not_follow() {
    let mut case = Case::new(40);
    for row in &mut case.rows {
        row.answer = row.answer.map(|of| (of.0 & !0x1000, of.1, 500));
    }
    case.breaks("drive-does-not-follow");
}

#[test]
fn judge_finds_speed_gained_after_a_stop() {
    // The stop starts during acceleration, and the acceleration continues.
    let mut reported = Case::new(40);
    reported.report.stop_s = Some(0.020);
    reported.breaks("speed-gained-after-stop");
    let mut csv = Case::new(40).in_csv();
    csv.report.stop_s = Some(0.020);
    csv.breaks("speed-gained-after-stop");
    let mut braking_then = Case::new(40);
    braking_then.report.stop_s = Some(braking(40) as f64 * 1e-3);
    braking_then.is_clean();
}

#[test]
fn judge_finds_a_stop_longer_than_its_ramp() {
    let mut case = Case::new(40);
    // Longer than 0.1 s of ramp, 0.05 s of jerk and 0.15 s of settling.
    let row = case.rows[turning(40)];
    let rest = case.rows.split_off(turning(40));
    for number in 1..400 {
        let position = row.position + 40 * number;
        let answer = Some((ENABLED, CSP, position - 40));
        case.rows.push(Row {
            position,
            answer,
            ..row
        });
    }
    case.report.stop_s = Some(0.020);
    case.rows.extend(rest.iter().map(|row| Row {
        position: row.position + 40 * 399,
        ..*row
    }));
    case.breaks("stop-too-slow");
}

#[test]
fn judge_finds_a_drive_enabled_again_after_a_stop() {
    let mut case = Case::new(40);
    case.report.stop_s = Some(braking(40) as f64 * 1e-3);
    let last = case.rows.len() - 1;
    for number in 0..4 {
        let mut row = case.rows[last];
        row.controlword = if number == 3 { 0x0f } else { 0x07 };
        row.answer = row.answer.map(|of| (0x0233, of.1, of.2));
        case.rows.push(row);
    }
    case.breaks("enabled-after-stop");
}

/// Returns the drive's quick stop from full speed, at one count per cycle, until `cut`.
fn quick_stop(cut: usize) -> Case {
    let mut case = Case::new(40);
    case.rows.truncate(turning(40));
    let row = case.rows[turning(40) - 1];
    let mut actual = row.position;
    for number in 0..60 {
        let controlword = if number < cut { 0x02 } else { 0 };
        let statusword = if number < cut { 0x0217 } else { 0x0250 };
        let position = actual;
        actual += (40 - number as i32).max(0);
        let answer = Some((statusword, CSP, actual));
        case.rows.push(Row {
            controlword,
            position,
            answer,
            ..row
        });
    }
    case
}

#[test]
fn judge_finds_power_off_while_the_drive_turns() {
    let mut cut = quick_stop(10);
    cut.report.exit = 1;
    cut.report.text = "`io` (position 2): no longer answers".to_string();
    cut.breaks("power-cut-while-turning");
    quick_stop(10).failed().is_clean();
    let mut at_rest = quick_stop(55);
    at_rest.report = cut.report.clone();
    at_rest.is_clean();
}

#[test]
fn judge_finds_a_quick_stop_at_speed_without_a_failure() {
    quick_stop(55).breaks("quick-stop-without-failure");
}

#[test]
fn judge_finds_op_left_while_the_drive_turns() {
    let mut case = Case::new(40);
    case.report.exit = 1;
    case.al_control = vec![(turning(40), 4)];
    case.breaks("op-left-while-turning");
    case.al_control = vec![(turning(40), 8), (case.rows.len() - 1, 4)];
    case.is_clean();
}

#[test]
fn judge_finds_a_drive_enabled_on_a_silent_bus() {
    let mut case = Case::new(40).failed();
    let from = turning(40);
    for row in &mut case.rows[from..] {
        row.answer = None;
    }
    case.breaks("enabled-on-silent-bus");
}

#[test]
fn judge_finds_power_at_the_end() {
    let mut case = Case::new(40);
    case.rows.truncate(turning(40));
    case.breaks("power-at-the-end");
}

#[test]
fn judge_finds_unreported_failures() {
    let mut fault = Case::new(40);
    let from = turning(40);
    for (number, row) in fault.rows[from..].iter_mut().enumerate() {
        row.controlword = if number < 2 { 0x0f } else { 0 };
        row.answer = row.answer.map(|of| (0x0218, of.1, of.2));
        row.position = row.answer.map_or(0, |of| of.2);
    }
    fault.breaks("exit-0-after-failure");
    let mut silent = Case::new(40);
    for row in &mut silent.rows[from..from + 6] {
        row.answer = None;
    }
    silent.breaks("exit-0-after-failure");
}

#[test]
fn judge_finds_power_without_a_command() {
    let mut lost = Case::new(40);
    let from = turning(40);
    for row in &mut lost.rows[from..from + 30] {
        row.answer = row.answer.map(|of| (0x0250, of.1, of.2));
    }
    lost.breaks("operation-requested-without-power");
    lost.breaks("exit-0-after-power-loss");
    let mut again = Case::new(40).failed();
    for (number, row) in again.rows[from..from + 30].iter_mut().enumerate() {
        row.controlword = if number < 26 { 0x06 } else { 0x0f };
        row.answer = row.answer.map(|of| (0x0231, of.1, of.2));
    }
    again.breaks("power-without-command");
    again.machine.axes[0].enables = 2;
    let rules = again.findings();
    assert!(rules.iter().all(|of| of.rule != "power-without-command"));
}

#[test]
fn judge_finds_a_program_that_ends_elsewhere() {
    let mut case = Case::new(40);
    case.report.completed = true;
    let position = case.rows.iter().rev().find(|row| row.controlword == 0x0f);
    let position = f64::from(position.expect("enabled").position);
    case.machine.axes[0].goal = Some(position / 2000.0);
    case.is_clean();
    case.machine.axes[0].goal = Some((position + 20.0) / 2000.0);
    case.breaks("done-elsewhere");
}

/// Returns views of two halves: the second one is `offset` counts off from a cycle on.
fn halves(offset: i32, from: usize) -> (Machine, Vec<Vec<Moment>>) {
    let case = Case::new(40);
    let file = recording(&case.rows, &[]);
    let packets = pcapng::packets(&file).expect("a recording");
    let wire = wire::read(&packets, &[case.machine.axes[0].layout()], &[]);
    let view = views(&case.machine, &wire).swap_remove(0);
    let mut other = view.clone();
    for moment in &mut other[from..] {
        moment.sent.position = moment.sent.position.map(|position| position + offset);
    }
    let mut machine = machine();
    machine.axes.push(machine.axes[0].clone());
    machine.gantries = vec![[0, 1]];
    (machine, vec![view, other])
}

fn relations(machine: &Machine, views: &[Vec<Moment>]) -> Vec<&'static str> {
    let wire = wire::Wire::default();
    let found = super::relations::check(machine, &wire, views, None, &Report::default());
    found.iter().map(|finding| finding.rule).collect()
}

#[test]
fn judge_finds_halves_of_a_gantry_that_part() {
    let (machine, views) = halves(100, 0);
    assert!(relations(&machine, &views).is_empty());
    let (machine, views) = halves(2, turning(40));
    assert_eq!(relations(&machine, &views), ["gantry-apart"]);
    let (machine, mut views) = halves(0, 0);
    for moment in &mut views[1][turning(40)..] {
        moment.sent.controlword = 0x02;
    }
    assert_eq!(relations(&machine, &views), ["gantry-half-alone"]);
}

/// Returns what the rules say of an output that is on in these cycles, for a range that the axis
/// passes. `homes`: its positions are undefined before it is homed.
fn switched(homes: bool, on: impl Fn(usize, &Moment) -> bool) -> Vec<&'static str> {
    let (mut machine, mut views) = halves(0, 0);
    machine.gantries.clear();
    (machine.axes, views) = (vec![machine.axes[0].clone()], vec![views.swap_remove(0)]);
    machine.terminals = vec![2];
    machine.switches = vec![Switch {
        terminal: 0,
        bit: 3,
        axis: 0,
        ranges: vec![[900.0, 1700.0]],
        lead_s: 0.0,
        homes,
    }];
    let mut wire = wire::Wire::default();
    for moment in &views[0] {
        let sent = Some(u8::from(on(moment.cycle, moment)) << 3);
        wire.cycles.push(wire::Cycle {
            at: moment.at,
            back: None,
            complete: true,
            drives: Vec::new(),
            terminals: vec![wire::Terminal { sent, heard: None }],
        });
    }
    let found = super::relations::check(&machine, &wire, &views, None, &Report::default());
    found.iter().map(|finding| finding.rule).collect()
}

#[test]
fn judge_finds_outputs_that_are_wrong() {
    let inside = |moment: &Moment| (900..1700).contains(&moment.sent.position.unwrap_or(0));
    let powered = |moment: &Moment| moment.requests_operation();
    let right = |_: usize, moment: &Moment| inside(moment) && powered(moment);
    assert!(switched(false, right).is_empty());
    assert!(switched(true, |_, _| false).is_empty());
    assert_eq!(switched(true, right), ["output-undefined"]);
    assert_eq!(switched(false, |_, _| false), ["output-missing"]);
    assert_eq!(
        switched(false, |cycle, _| cycle == 1),
        ["output-without-power"]
    );
    let late = |_: usize, moment: &Moment| powered(moment) && moment.sent.position > Some(900);
    assert_eq!(switched(false, late), ["output-outside"]);
}

#[test]
fn judge_does_not_read_outputs_as_inputs_of_a_missing_device() {
    let mut case = Case::new(40);
    // Another device is missing: the working counter is wrong, but the drive's inputs are valid.
    let from = turning(40);
    for row in &mut case.rows[from..from + 1] {
        row.incomplete = true;
    }
    case.is_clean();
    // The device wrote nothing: the bytes came back unchanged.
    let row = &mut case.rows[from];
    row.answer = Some((row.controlword, row.mode, row.position));
    let file = recording(&case.rows, &[]);
    let packets = pcapng::packets(&file).expect("a recording");
    let wire = wire::read(&packets, &[case.machine.axes[0].layout()], &[]);
    assert!(wire.cycles[from].drives[0].expect("sent").heard.is_none());
    assert!(!wire.cycles[from].complete);
}

#[test]
fn damaged_recordings_are_refused_and_never_panic() {
    let file = recording(&fault_report(10), &[]);
    for end in 0..file.len().min(2000) {
        if let Ok(packets) = pcapng::packets(&file[..end]) {
            wire::read(&packets, &[], &[]);
        }
    }
    assert!(pcapng::packets(&file[..file.len() - 1]).is_err());
}

#[test]
fn a_seed_gives_the_same_plan_every_time() {
    let plans = |seed| super::generate::plan(seed, None);
    for seed in 0..50 {
        let (one, other) = (plans(seed), plans(seed));
        assert_eq!(one.machine_file, other.machine_file);
        assert_eq!(one.fault_script, other.fault_script);
    }
    assert_ne!(plans(1).machine_file, plans(2).machine_file);
}
