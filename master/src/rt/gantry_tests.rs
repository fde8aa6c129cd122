//! Explores both halves of a gantry, each with a drive that may answer anything. Drives, rules and
//! search are those of the axis (`axis/tests/explorer`).

#[path = "../../../axis/tests/explorer/drive.rs"]
mod drive;
#[allow(dead_code, reason = "only its keys and traces are used here")]
#[path = "../../../axis/tests/explorer/machine.rs"]
mod machine;
#[path = "../../../axis/tests/explorer/monitor.rs"]
mod monitor;
#[path = "../../../axis/tests/explorer/search.rs"]
mod search;

use std::collections::hash_map::DefaultHasher;
use std::hash::{Hash, Hasher};

use ecaxis_axis::{Limits, Outputs, Scale, StopMethod, Supervision, VelocityUnit};
use ecaxis_ecat::index::{DeviceIndex, GroupIndex};
use ecaxis_esi::layout::Field;

use super::*;
use crate::rt::image::{AxisBits, BitField};
use crate::rt::overrides::check_hold;
use drive::{CHANGES, COUNTS_PER_UNIT, Change, DT, Drive};
use machine::{MOVE, WAITS};
use monitor::{Cycle, Monitor};
use search::{Bounds, System, Violation, explore};

const MAX_SKEW: f64 = 2.0;

const ALIKE: &str = "g1 both halves stop alike";
const APART: &str = "g2 beyond the skew both halves stop";
const TOGETHER: &str = "g3 both set-points move together";
const HELD: &str = "g4 a held gantry comes to rest";

/// Cycles in which the Controlwords of both halves may differ.
const DIFFERENT_CYCLES: u8 = 2;

/// Cycles in which a held gantry comes to rest: three times the ramp from full speed.
const RAMP_CYCLES: u16 = 30;

/// The largest number of deviations of both drives.
const DEVIATIONS: usize = 2;

#[derive(Debug, Clone, Copy)]
enum Action {
    Wait(u16),
    Command(Command),
    /// Of the first or second drive.
    Change(usize, Change),
    /// The override 0, or 1.
    Hold(bool),
}

#[derive(Debug, Clone)]
struct Pair {
    axes: [Axis; 2],
    drives: [Drive; 2],
    out: [Outputs; 2],
    monitors: [Monitor; 2],
    coupling: Coupling,
    offset: Motion,
    square: f64,
    squares: bool,
    different: u8,
    held: bool,
    /// Cycles of the hold without a lost frame, and the last set-points of coupled halves.
    held_cycles: u16,
    targets: Option<[f64; 2]>,
    /// The offset of the set-points in the last cycle, once both follow.
    apart: Option<f64>,
    /// The halves with a trip or fault in the last cycle: their group stops.
    causes: [bool; 2],
}

/// `absolute`: homed from the start.
fn axis(absolute: bool) -> Axis {
    let limits = Limits {
        position: Some([-50.0, 50.0]),
        velocity: 200.0,
        acceleration: 2000.0,
        jerk: None,
        torque: 100.0,
        following_error: Some(1.0),
    };
    let scale = Scale::new(COUNTS_PER_UNIT * 5.0, 5.0).unwrap();
    let scale = scale.with_velocity_unit(VelocityUnit::MILLI_RPM);
    let config = AxisConfig {
        modes: ecaxis_axis::Modes::only(Mode::Csp).with(Mode::Hm),
        dead_time_s: DT,
        mode_time_s: 0.2,
        absolute,
        absolute_start: absolute,
        supervision: Supervision {
            reaction: StopMethod::QuickStop,
            ..Supervision::default()
        },
        ..AxisConfig::new(Mode::Csp, scale, limits)
    };
    Axis::new(config).unwrap()
}

fn bits() -> AxisBits {
    let word = Field {
        pdo: 0,
        index: 0,
        sub: 0,
        bit_offset: 0,
        bit_len: 16,
        name: String::new(),
        data_type: String::new(),
    };
    let word = BitField::new(&word, 0, 2).unwrap();
    AxisBits {
        controlword: word,
        statusword: word,
        mode: None,
        mode_display: None,
        target_position: None,
        target_velocity: None,
        target_torque: None,
        velocity_offset: None,
        torque_offset: None,
        error_code: None,
        profile_velocity: None,
        profile_acceleration: None,
        profile_deceleration: None,
        touch_probe_function: None,
        touch_probe_status: None,
        touch_probe_positions: [None; 4],
        position: None,
        velocity: None,
        torque: None,
    }
}

impl Pair {
    fn new(second_at: f64, absolute: bool) -> Self {
        let axes = [axis(absolute), axis(absolute)];
        let [first, mut second] = [0, 1].map(|half| Drive::new(axes[half].config()));
        second.position = second_at * COUNTS_PER_UNIT;
        Self {
            axes,
            drives: [first, second],
            out: [Outputs::default(); 2],
            monitors: [Monitor::new(), Monitor::new()],
            coupling: Coupling::Pending,
            offset: Motion::at(0.0),
            square: 0.0,
            squares: false,
            different: 0,
            held: false,
            held_cycles: 0,
            targets: None,
            apart: None,
            causes: [false; 2],
        }
    }

    #[track_caller]
    fn after(mut self, actions: &[Action]) -> Self {
        for &action in actions {
            let mut text = String::new();
            if let Err(violation) = self.apply(action, Some(&mut text)) {
                panic!("{action:?}: {violation:?}\n{text}");
            }
        }
        self
    }

    /// Runs one cycle, in the order of the engine.
    fn cycle(&mut self, command: Option<Command>) -> Result<(), Violation> {
        let inputs = [0, 1].map(|half| {
            self.drives[half].cycle(&self.out[half]);
            let inputs = self.drives[half].inputs();
            self.axes[half].observe(&inputs, DT);
            inputs
        });
        let axes = [AxisIndex(0), AxisIndex(1)];
        let config = GantryConfig {
            axes,
            max_skew: MAX_SKEW,
            max_homing_skew: MAX_SKEW,
        };
        let mut gantry = Gantry {
            coupling: self.coupling,
            offset: self.offset,
            square: self.square,
            squares: self.squares,
            ..Gantry::new(config)
        };
        let [first, second] = self.axes.clone();
        let slot = |axis| RtAxis::new(axis, bits(), DeviceIndex(0), GroupIndex(0));
        let [mut first, mut second] = [slot(first), slot(second)];
        let rate = if self.held { Rate::HELD } else { Rate::WHOLE };
        for slot in [&mut first, &mut second] {
            slot.rates.own = rate;
            slot.axis.set_rate(rate.value());
        }
        let stopped = self.causes.contains(&true);
        let starts = |c: &Command| matches!(c, Command::MoveTo { .. } | Command::Home { .. });
        let command = command.filter(|command| {
            let halves = [&mut first, &mut second];
            let permitted = !(stopped && starts(command)) && check_hold(rate, *command).is_ok();
            permitted && gantry.command(halves, AxisIndex(0), *command).is_ok()
        });
        if stopped {
            first.stop_by(StopMethod::Ramp);
            second.stop_by(StopMethod::Ramp);
        }
        gantry.update([&mut first, &mut second], DT);
        self.out[0] = first.axis.act();
        if let Some(leader) = second.leader {
            let status = first.axis.status();
            second
                .axis
                .follow(leader.set_point(&status), status.takes_up);
        }
        self.out[1] = second.axis.act();
        (self.coupling, self.offset, self.square) = (gantry.coupling, gantry.offset, gantry.square);
        self.squares = gantry.squares;
        self.axes = [first.axis, second.axis];
        self.check(command, &inputs)
    }

    fn check(
        &mut self,
        command: Option<Command>,
        inputs: &[ecaxis_axis::Inputs; 2],
    ) -> Result<(), Violation> {
        let status = [self.axes[0].status(), self.axes[1].status()];
        let causes = status.map(|s| s.trip.is_some() || s.fault.is_some() && !s.resetting);
        let before = std::mem::replace(&mut self.causes, causes);
        for half in [0, 1] {
            // A move is one of the first half.
            let own = command.filter(|c| half == 0 || !matches!(c, Command::MoveTo { .. }));
            self.monitors[half].check(&Cycle {
                config: self.axes[half].config(),
                inputs: &inputs[half],
                command: own,
                set_point: half == 1 && command.is_some() && own.is_none(),
                outside: [before[1 - half], causes[1 - half]],
                status: &status[half],
                out: &self.out[half],
            })?;
        }
        if self.coupling == Coupling::Decoupled {
            return Ok(());
        }
        let [a, b] = &status;
        let words = self.out.map(|out| out.controlword & 0x0F);
        let powered = self
            .monitors
            .iter()
            .all(|m| m.shown == monitor::Shown::Enabled);
        let heard = a.stale_cycles == 0 && b.stale_cycles == 0;
        let differ = powered && heard && words[0] != words[1] && words.contains(&0x0F);
        let was_together = self.different > 0 || self.apart.is_some();
        self.different = if differ && was_together {
            self.different.saturating_add(1)
        } else {
            0
        };
        if self.different > DIFFERENT_CYCLES {
            return Err(Violation {
                rule: ALIKE,
                detail: format!("Controlwords {:#06x} and {:#06x}", words[0], words[1]),
            });
        }
        let leads = matches!(self.coupling, Coupling::Coupled | Coupling::Squaring(_));
        let skew = b.position - a.position - self.square;
        if leads && heard && skew.abs() > MAX_SKEW && words.contains(&0x0F) {
            return Err(Violation {
                rule: APART,
                detail: format!("skew {skew}, Controlwords {words:#06x?}"),
            });
        }
        let apart = b.target_position - a.target_position;
        let follow = leads && a.enabled && b.enabled && words == [0x0F; 2];
        if let (Some(before), true) = (self.apart, follow) {
            let limits = &self.axes[0].config().limits;
            let most = match self.coupling {
                Coupling::Squaring(_) => limits.velocity * SQUARING * DT,
                _ => 0.0,
            };
            if (apart - before).abs() > most + 2.0 / COUNTS_PER_UNIT {
                return Err(Violation {
                    rule: TOGETHER,
                    detail: format!("offset {before} to {apart}"),
                });
            }
        }
        self.apart = follow.then_some(apart);
        let targets = follow.then_some([a.target_position, b.target_position]);
        let before = std::mem::replace(&mut self.targets, targets);
        // Lost frames let both set-points wait, which delays the ramp.
        self.held_cycles = match self.held && heard {
            true => self.held_cycles.saturating_add(1),
            false => 0,
        };
        let moves = before.is_some() && targets.is_some() && before != targets;
        let stops = a.stop.is_some() || b.stop.is_some();
        if self.held_cycles > RAMP_CYCLES && moves && !stops {
            return Err(Violation {
                rule: HELD,
                detail: format!("{before:?} to {targets:?} in cycle {}", self.held_cycles),
            });
        }
        Ok(())
    }
}

impl System for Pair {
    type Action = Action;

    fn actions(&self, list: &mut Vec<Action>) {
        list.extend(WAITS.map(Action::Wait));
        list.extend(
            [
                Command::Enable,
                Command::Disable,
                Command::ResetFault,
                Command::Stop,
                Command::QuickStop,
                Command::EmergencyStop,
                Command::DisableVoltage,
                Command::Home { timeout_s: 1.0 },
                MOVE,
            ]
            .map(Action::Command),
        );
        list.push(Action::Hold(!self.held));
        for half in [0, 1] {
            for change in CHANGES {
                let mut drive = self.drives[half].clone();
                let other = self.drives[1 - half].settings.deviations();
                if drive.change(change) && drive.settings.deviations() + other <= DEVIATIONS {
                    list.push(Action::Change(half, change));
                }
            }
        }
    }

    fn apply(&mut self, action: Action, mut text: Option<&mut String>) -> Result<(), Violation> {
        let (command, cycles) = match action {
            Action::Wait(cycles) => (None, cycles),
            Action::Command(command) => (Some(command), 1),
            Action::Change(half, change) => {
                self.drives[half].change(change);
                (None, 1)
            }
            Action::Hold(held) => {
                self.held = held;
                (None, 1)
            }
        };
        for _ in 0..cycles {
            let result = self.cycle(command);
            if let Some(text) = text.as_deref_mut() {
                for (half, name) in ["first ", "second "].into_iter().enumerate() {
                    let status = self.axes[half].status();
                    machine::trace(text, name, &status, &self.drives[half], &self.out[half]);
                }
            }
            result?;
        }
        Ok(())
    }

    fn key(&self) -> u64 {
        let mut hasher = DefaultHasher::new();
        for half in [0, 1] {
            let axis = &self.axes[half];
            let (drive, out) = (&self.drives[half], &self.out[half]);
            machine::reduce(axis.config(), &axis.status(), drive, out, &mut hasher);
            self.monitors[half].reduce(&mut hasher);
        }
        std::mem::discriminant(&self.coupling).hash(&mut hasher);
        let rests = self.held_cycles > RAMP_CYCLES;
        (self.different, self.apart.is_some(), self.causes).hash(&mut hasher);
        (self.held, rests, self.squares).hash(&mut hasher);
        hasher.finish()
    }
}

/// Homed, out of square, held, without power.
fn racked() -> Pair {
    let racked = Pair::new(1.0, true).after(&[Action::Wait(5)]);
    racked.after(&[Action::Hold(true), Action::Wait(60)])
}

#[test]
fn a_stop_keeps_the_squaring_from_beginning_until_it_is_commanded_again() {
    let apart = |pair: &Pair| pair.out[1].target_position - pair.out[0].target_position;
    let enabling = [
        Action::Command(Command::Enable),
        Action::Command(Command::Stop),
    ];
    let stopped = racked()
        .after(&enabling)
        .after(&[Action::Hold(false), Action::Wait(100)]);
    assert!(stopped.axes.iter().all(|axis| axis.status().enabled));
    let counts = COUNTS_PER_UNIT.round() as i32;
    assert_eq!(apart(&stopped), counts);
    let square = stopped.after(&[Action::Command(Command::Enable), Action::Wait(400)]);
    assert_eq!(apart(&square), 0);
}

#[test]
fn a_half_that_moves_without_the_other_trips() {
    let falls = Change::Moves(drive::Moves::Falls);
    let pair = racked().after(&[
        Action::Command(Command::Enable),
        Action::Change(0, Change::Word(drive::Word::Zero)),
        Action::Wait(3),
        Action::Change(1, falls),
        Action::Wait(1),
    ]);
    let trip = pair.axes[1].status().trip;
    assert!(matches!(trip, Some(Trip::HalfMoves { .. })), "{trip:?}");
}

#[test]
fn both_halves_stay_in_their_ranges_with_any_offset() {
    let ready = Pair::new(-30.0, false).after(&[Action::Wait(5)]);
    let coupled = ready.after(&[Action::Command(Command::Enable), Action::Wait(12)]);
    assert_eq!(coupled.coupling, Coupling::Coupled);
    let at = |pair: &Pair| {
        pair.out
            .map(|out| f64::from(out.target_position) / COUNTS_PER_UNIT)
    };
    let target = |pair: &Pair, position: f64| {
        let order = Command::MoveTo {
            position,
            speed: 1.0,
            ramp: 1.0,
        };
        let pair = pair
            .clone()
            .after(&[Action::Command(order), Action::Wait(200)]);
        at(&pair)
    };
    assert_eq!(target(&coupled, -20.0), [-20.0, -50.0]);
    assert_eq!(
        target(&coupled, -25.0),
        at(&coupled),
        "the second half would be at -55"
    );
    // Apart, each half has its own range.
    let mut apart = coupled;
    apart.coupling = Coupling::Decoupled;
    let away = target(&apart.after(&[Action::Wait(1)]), -25.0);
    assert_eq!(away, [-25.0, -30.0]);
}

#[test]
fn home_that_one_half_rejects_has_no_effect_on_the_other() {
    let lost = Change::Frames(drive::Frames::Lost);
    let ready = Pair::new(0.25, false).after(&[Action::Wait(5)]);
    let ready = ready.after(&[Action::Command(Command::Enable), Action::Wait(12)]);
    let moved = ready.after(&[
        Action::Command(MOVE),
        Action::Wait(8),
        Action::Change(1, lost),
        Action::Wait(3),
    ]);
    let before = moved.axes[0].status().commanded_target;
    let after = moved.after(&[Action::Command(Command::Home { timeout_s: 1.0 })]);
    assert_eq!(after.axes[0].status().commanded_target, before);
}

#[test]
fn explored_halves_keep_the_rules() {
    let enable = [Action::Command(Command::Enable), Action::Wait(12)];
    let home = Action::Command(Command::Home { timeout_s: 1.0 });
    let idle = Pair::new(0.25, false).after(&[Action::Wait(5)]);
    let ready = idle.clone().after(&enable);
    let moving = ready
        .clone()
        .after(&[Action::Command(MOVE), Action::Wait(8)]);
    let roots = [
        ("held out of square", racked()),
        ("without power", idle),
        ("coupled", ready.clone()),
        ("in motion", moving.clone()),
        ("at the target", moving.after(&[Action::Wait(60)])),
        ("homing", ready.clone().after(&[home, Action::Wait(3)])),
        ("homed", ready.after(&[home, Action::Wait(60)])),
    ];
    let transitions = std::env::var("ECAXIS_EXPLORER_TRANSITIONS");
    let bounds = Bounds {
        depth: 8,
        transitions: transitions.map_or(60_000, |text| text.parse().unwrap()),
        width: 100_000,
    };
    let summary = explore(&roots, bounds);
    assert!(summary.states > 1000, "{} states", summary.states);
    let mut text = String::new();
    for example in summary.found.iter().take(40) {
        let rule = example.violation.rule;
        text.push_str(&format!(
            "\n{rule}: {} times, {}",
            example.count, example.trace
        ));
    }
    assert!(
        summary.found.is_empty(),
        "{} kinds of violation{text}",
        summary.found.len()
    );
}
