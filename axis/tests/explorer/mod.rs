//! Explores an axis against a drive that may answer anything, by breadth-first search.
//!
//! | file | contents |
//! |---|---|
//! | `search` | the search: the shortest trace to each kind of violation |
//! | `drive` | a drive of the standard, and everything in which it may deviate |
//! | `machine` | axis, drive and rules; the actions; the reduced state |
//! | `monitor` | the rules, judged from commands, inputs, outputs and status |
//!
//! An action is a command, a change of the drive, or a wait. A change is a deviation, its end, or an
//! event: any Statusword class, bits 10, 12 and 13, positions that stand, coast, fall, run away or
//! jump, a wrong velocity, a wrong mode, lost and late frames, a drive that ignores the Controlword.
//! A deviation lasts until another action ends it. Commands and changes take one cycle. Waits take
//! 1, 3, 12 or 250 cycles: the next cycle, more than a ride-through of lost frames, more than the
//! cycles without bit 12 that count, and more than the time-out of a stop. Every cycle is checked.
//!
//! **What is abstracted.** Axis, drive and rules run with all their numbers. Two states are the same
//! if their reduced states are: every state of the status, of the drive and of the rules, and the
//! class of every number. Classes of speeds are rest, standstill window, below the limit, near the
//! limit, above it. Classes of positions are inside, near the end, outside, and the distance between
//! set-point and axis within a count, within the following error, beyond. Classes of times are the
//! shares of a time-out. The first state of a class stands for all. So the search proves nothing
//! about the others; it visits each class once, from where it was reached first. The cycle is 10 ms,
//! commands have one or two values each, and at most two deviations last at the same time.
//!
//! **Why the depth suffices.** The roots are one state in each phase of an axis: without power,
//! coasting, ready, in motion, at the target, homing, homed. From there a defect needs a deviation,
//! the time until it counts, a second action that meets its effect, and the time until that counts:
//! four actions. The deepest counter-example of a known defect has four actions, most have two.
//! The default checks all sequences of two actions and some of three. A full run checks all of three
//! and some of four:
//!
//! `ECAXIS_EXPLORER_TRANSITIONS=1300000 cargo test -p ecaxis-axis --test main explorer -- --nocapture`
//!
//! `ECAXIS_EXPLORER_DEPTH` and `ECAXIS_EXPLORER_DEVIATIONS` change the other bounds.

mod drive;
mod machine;
mod monitor;
mod search;

use std::rc::Rc;

use ecaxis_axis::{
    AxisConfig, Brake, Command, FaultReset, HomeReference, Limits, Loops, Mode, PositionPid,
    StopMethod, Supervision,
};

use crate::common::{LIMITS, all};
use drive::{Change, DT, Moves};
use machine::{AWAY_SLOWLY, Action, HOME, MOVE, Machine, Order, PUSH, RUN, RUN_SLOWLY, Setup};
use search::{Bounds, explore};

const fn order(command: Command) -> Action {
    Action::Order(Order::Command(command))
}

const ENABLE: [Action; 2] = [order(Command::Enable), Action::Wait(12)];

fn config(mode: Mode) -> AxisConfig {
    let base = all(mode, LIMITS);
    AxisConfig {
        dead_time_s: DT,
        mode_time_s: 0.2,
        home: Some(HomeReference {
            position: Some(0.0),
            window: 1.0,
            moves: true,
        }),
        ..base
    }
}

/// A loop for the drive of this test and its cycle: 1 % accelerates by 25 units/s².
const PID: PositionPid = PositionPid {
    kp: 16.0,
    tn_s: None,
    tv_s: 0.1,
    acceleration: 0.04,
};

/// Returns the states from which the search begins.
fn roots(setup: &Rc<Setup>) -> Vec<(&'static str, Machine)> {
    let idle = Machine::new(setup);
    let ready = idle.clone().after(&ENABLE);
    let motion = match setup.config.mode {
        Mode::Pp => AWAY_SLOWLY,
        Mode::Pv => RUN_SLOWLY,
        Mode::Csv => RUN,
        Mode::Cst if setup.config.loops.cst.is_none() => PUSH,
        _ => MOVE,
    };
    // A velocity must not reach the end of the range.
    let arrival = Action::Wait(match setup.config.mode {
        Mode::Pp => 250,
        Mode::Csv => 20,
        _ => 60,
    });
    let moving = ready.clone().after(&[order(motion), Action::Wait(8)]);
    let lost = [
        Action::Change(Change::Moves(Moves::Coasts)),
        Action::Change(Change::State(ecaxis_axis::State::SwitchOnDisabled)),
        Action::Wait(1),
        order(Command::ResetFault),
    ];
    vec![
        ("without power", idle),
        ("ready", ready.clone()),
        ("in motion", moving.clone()),
        (
            "at the target",
            ready.clone().after(&[order(motion), arrival]),
        ),
        ("coasting without power", moving.after(&lost)),
        (
            "homing",
            ready.clone().after(&[order(HOME), Action::Wait(3)]),
        ),
        ("homed", ready.after(&[order(HOME), Action::Wait(60)])),
    ]
}

fn asked(name: &str) -> Option<u64> {
    std::env::var(name).ok()?.parse().ok()
}

fn search(name: &str, config: AxisConfig, modes: &[Mode]) {
    let deviations = asked("ECAXIS_EXPLORER_DEVIATIONS").unwrap_or(2) as usize;
    let setup = Setup::new(config, modes, deviations);
    let bounds = Bounds {
        depth: asked("ECAXIS_EXPLORER_DEPTH").unwrap_or(8) as usize,
        transitions: asked("ECAXIS_EXPLORER_TRANSITIONS").unwrap_or(200_000),
        width: 200_000,
    };
    let summary = explore(&roots(&setup), bounds);
    println!(
        "{name}: {} transitions, {} states, by depth {:?}{}",
        summary.transitions,
        summary.states,
        summary.levels,
        if summary.complete {
            ""
        } else {
            ", more remain"
        },
    );
    let mut text = String::new();
    for example in summary.found.iter().take(40) {
        text.push_str(&format!(
            "\n{}: {} times, {}",
            example.violation.rule, example.count, example.trace
        ));
    }
    assert!(
        summary.found.is_empty(),
        "{name}: {} kinds of violation{text}",
        summary.found.len()
    );
}

#[test]
fn csp() {
    search("CSP", config(Mode::Csp), &[Mode::Csv, Mode::Csp]);
}

#[test]
fn csp_with_ramps_and_a_brake() {
    let config = AxisConfig {
        supervision: Supervision {
            reaction: StopMethod::Ramp,
            emergency: StopMethod::DisableVoltage,
            ..Supervision::default()
        },
        brake: Brake {
            release_s: 0.05,
            engage_s: 0.05,
        },
        fault_reset: FaultReset::Automatic {
            tries: 2,
            delay_s: 0.05,
        },
        jerk_limited: true,
        limits: Limits {
            following_error: None,
            ..LIMITS
        },
        ..config(Mode::Csp)
    };
    search("CSP, ramp", config, &[Mode::Cst, Mode::Csp]);
}

fn without_loop(mode: Mode) {
    let config = AxisConfig {
        loops: Loops::default(),
        ..config(mode)
    };
    search(&format!("{mode}"), config, &[Mode::Csp, mode]);
}

#[test]
fn csv() {
    without_loop(Mode::Csv);
}

#[test]
fn cst() {
    without_loop(Mode::Cst);
}

#[test]
fn csv_with_a_loop() {
    search("CSV, loop", config(Mode::Csv), &[Mode::Csp, Mode::Csv]);
}

#[test]
fn cst_with_a_loop() {
    let base = config(Mode::Cst);
    let config = AxisConfig {
        loops: Loops {
            cst: Some(PID),
            ..base.loops
        },
        ..base
    };
    search("CST, loop", config, &[Mode::Csp, Mode::Cst]);
}

#[test]
fn pp() {
    search("PP", config(Mode::Pp), &[Mode::Csp, Mode::Pp]);
}

#[test]
fn pv() {
    search("PV", config(Mode::Pv), &[Mode::Csp, Mode::Pv]);
}

#[test]
fn drive_that_changes_its_mode_without_power_only() {
    let config = AxisConfig {
        mode_change_unpowered: true,
        ..config(Mode::Csp)
    };
    let modes = [Mode::Csv, Mode::Csp];
    search("CSP, modes without power", config, &modes);
}

#[test]
fn drive_that_shows_its_mode_in_operation_enabled_only() {
    let config = AxisConfig {
        mode_display_enabled: true,
        ..config(Mode::Csp)
    };
    let modes = [Mode::Csv, Mode::Csp];
    search("CSP, mode shown when enabled", config, &modes);
}
