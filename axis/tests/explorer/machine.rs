//! One axis with its drive, its rules and the actions that are explored.

use std::collections::hash_map::DefaultHasher;
use std::hash::{Hash, Hasher};
use std::mem::discriminant;
use std::rc::Rc;

use ecaxis_axis::{Axis, AxisConfig, AxisStatus, Command, Mode, Outputs};

use super::drive::{CHANGES, COUNTS_PER_UNIT, Change, DT, Drive};
use super::monitor::{Cycle, Monitor};
use super::search::{System, Violation};

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Order {
    Command(Command),
    /// External set-points that accelerate by the limit, in every cycle, or none.
    Stream(bool),
    /// The override 0, or 1.
    Hold(bool),
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Action {
    Wait(u16),
    Order(Order),
    Change(Change),
}

/// Cycles of a wait: the next one, more than a ride-through of lost frames, more than the cycles
/// until a missing bit 12 counts, and more than the time-out of a stop.
pub const WAITS: [u16; 4] = [1, 3, 12, 250];

/// What is explored.
#[derive(Debug)]
pub struct Setup {
    pub config: AxisConfig,
    pub orders: Vec<Order>,
    pub changes: Vec<Change>,
    /// The largest number of simultaneous deviations of the drive.
    pub deviations: usize,
}

pub const MOVE: Command = Command::MoveTo {
    position: 10.0,
    speed: 1.0,
    ramp: 1.0,
};
pub const AWAY: Command = Command::MoveTo {
    position: -40.0,
    speed: 1.0,
    ramp: 1.0,
};
/// A slow move: an axis that ignores the halt stays within the range until the time-out.
pub const AWAY_SLOWLY: Command = Command::MoveTo {
    position: -40.0,
    speed: 0.1,
    ramp: 1.0,
};
pub const RUN: Command = Command::Velocity {
    velocity: 100.0,
    ramp: 1.0,
};
pub const RUN_SLOWLY: Command = Command::Velocity {
    velocity: 20.0,
    ramp: 1.0,
};
pub const PUSH: Command = Command::Torque {
    percent: 10.0,
    ramp_s: 0.0,
};
pub const HOME: Command = Command::Home { timeout_s: 1.0 };

impl Setup {
    pub fn new(config: AxisConfig, modes: &[Mode], deviations: usize) -> Rc<Self> {
        let mut orders: Vec<Order> = [
            Command::Enable,
            Command::Disable,
            Command::ResetFault,
            Command::Stop,
            Command::QuickStop,
            Command::EmergencyStop,
            Command::DisableVoltage,
            MOVE,
            AWAY,
            RUN,
            PUSH,
            HOME,
        ]
        .map(Order::Command)
        .to_vec();
        orders.extend(
            modes
                .iter()
                .map(|&mode| Order::Command(Command::SetMode(mode))),
        );
        orders.extend([true, false].map(Order::Stream));
        orders.extend([true, false].map(Order::Hold));
        Rc::new(Self {
            config,
            orders,
            changes: CHANGES.to_vec(),
            deviations,
        })
    }
}

#[derive(Debug, Clone)]
pub struct Machine {
    setup: Rc<Setup>,
    pub axis: Axis,
    pub drive: Drive,
    pub out: Outputs,
    monitor: Monitor,
    stream: bool,
    held: bool,
}

impl Machine {
    pub fn new(setup: &Rc<Setup>) -> Self {
        let mut machine = Self {
            setup: Rc::clone(setup),
            axis: Axis::new(setup.config).unwrap(),
            drive: Drive::new(&setup.config),
            out: Outputs::default(),
            monitor: Monitor::new(),
            stream: false,
            held: false,
        };
        machine.run(5);
        machine
    }

    /// Runs cycles that must keep the rules.
    pub fn run(&mut self, cycles: u16) {
        self.apply(Action::Wait(cycles), None).unwrap();
    }

    /// Executes an action that must keep the rules, and returns the machine.
    #[track_caller]
    pub fn after(mut self, actions: &[Action]) -> Self {
        for &action in actions {
            let mut text = String::new();
            if let Err(violation) = self.apply(action, Some(&mut text)) {
                panic!("{action:?}: {violation:?}\n{text}");
            }
        }
        self
    }

    pub fn status(&self) -> AxisStatus {
        self.axis.status()
    }

    fn cycle(&mut self, order: Option<Order>) -> Result<(), Violation> {
        self.drive.cycle(&self.out);
        let inputs = self.drive.inputs();
        self.axis.observe(&inputs, DT);
        let mut command = None;
        match order {
            Some(Order::Command(order)) => {
                command = self.axis.command(order).is_ok().then_some(order);
                self.stream &= matches!(order, Command::Enable | Command::ResetFault);
            }
            Some(Order::Stream(on)) => self.stream = on,
            Some(Order::Hold(on)) => self.held = on,
            None => {}
        }
        self.axis.set_rate(if self.held { 0.0 } else { 1.0 });
        let mut set_point = false;
        if self.stream {
            let status = self.axis.status();
            let limits = &self.setup.config.limits;
            let velocity = (status.target_velocity + limits.acceleration * DT * 0.5)
                .min(limits.velocity * 0.5);
            let position = status.target_position + velocity * DT;
            set_point = self.axis.set_point(position).is_ok();
            self.stream = set_point;
        }
        self.out = self.axis.act();
        self.monitor.check(&Cycle {
            config: &self.setup.config,
            inputs: &inputs,
            command,
            set_point,
            outside: [false; 2],
            status: &self.axis.status(),
            out: &self.out,
        })
    }
}

impl System for Machine {
    type Action = Action;

    fn actions(&self, list: &mut Vec<Action>) {
        let setup = &self.setup;
        list.extend(WAITS.map(Action::Wait));
        for &order in &setup.orders {
            let changes = match order {
                Order::Stream(on) => on != self.stream,
                Order::Hold(on) => on != self.held,
                Order::Command(_) => true,
            };
            if changes {
                list.push(Action::Order(order));
            }
        }
        for &change in &setup.changes {
            let mut drive = self.drive.clone();
            if drive.change(change) && drive.settings.deviations() <= setup.deviations {
                list.push(Action::Change(change));
            }
        }
    }

    fn apply(&mut self, action: Action, mut text: Option<&mut String>) -> Result<(), Violation> {
        let (order, cycles) = match action {
            Action::Wait(cycles) => (None, cycles),
            Action::Order(order) => (Some(order), 1),
            Action::Change(change) => {
                self.drive.change(change);
                (None, 1)
            }
        };
        for _ in 0..cycles {
            let result = self.cycle(order);
            if let Some(text) = text.as_deref_mut() {
                trace(text, "", &self.axis.status(), &self.drive, &self.out);
            }
            result?;
        }
        Ok(())
    }

    fn key(&self) -> u64 {
        let mut hasher = DefaultHasher::new();
        let status = self.status();
        (self.stream, self.held).hash(&mut hasher);
        reduce(
            &self.setup.config,
            &status,
            &self.drive,
            &self.out,
            &mut hasher,
        );
        self.monitor.reduce(&mut hasher);
        hasher.finish()
    }
}

/// Returns the number of bounds below a value, and its sign.
fn class(value: f64, bounds: &[f64]) -> (usize, bool) {
    let rank = bounds.iter().filter(|&&bound| value.abs() > bound).count();
    (rank, rank > 0 && value < 0.0)
}

/// Adds the reduced state of an axis and its drive to a key: every state of the status and the
/// drive, and the class of every number.
pub fn reduce(
    config: &AxisConfig,
    status: &AxisStatus,
    drive: &Drive,
    out: &Outputs,
    hasher: &mut impl Hasher,
) {
    let limits = &config.limits;
    let speeds = [0.0, 0.02, 0.6, 1.3].map(|part| part * limits.velocity);
    let ahead = status.target_position - status.position;
    (
        (drive.settings, drive.state, drive.mode, drive.homing),
        class(drive.velocity / COUNTS_PER_UNIT, &speeds),
        (out.controlword, out.mode, out.brake_open),
    )
        .hash(hasher);
    (
        (
            status.mode,
            status.switching,
            status.switch_failed,
            status.state,
        ),
        (status.enabled, status.ready, status.mode_confirmed),
        (status.moving, status.in_target, status.at_rest),
        (status.homed(), discriminant(&status.homing)),
        (
            status.trip.map(|trip| discriminant(&trip)),
            status.fault.is_some(),
        ),
        (status.resetting, status.reset_failed, status.held_by_range),
        status.waiting.map(|waiting| discriminant(&waiting)),
        status.final_error_counts.is_some(),
    )
        .hash(hasher);
    (
        status.stop.map(|stop| {
            let share = stop.elapsed_s / stop.timeout_s;
            (stop.method, stop.phase, class(share, &[0.05, 0.5, 1.0]))
        }),
        class(status.target_velocity, &speeds),
        class(status.target_torque, &[0.0, limits.torque * 0.5]),
        class(ahead, &[1.0 / COUNTS_PER_UNIT, 1.0]),
        class(status.position, &[5.0, 45.0, 50.0]),
        class(f64::from(status.stale_cycles), &[0.0, 2.0, 100.0]),
        class(status.time_in_state_s, &[0.0, 0.1, 0.5]),
    )
        .hash(hasher);
}

/// Adds a line to a trace: the answer of the drive, the outputs and the status.
pub fn trace(text: &mut String, name: &str, status: &AxisStatus, drive: &Drive, out: &Outputs) {
    let inputs = drive.inputs();
    let line = format!(
        "  {name}{:#06x} {} mode {} at {} v {:.0}{} -> {:#06x} mode {} pos {} vel {} trq {} \
         |{}{}{}{}{}{}{}\n",
        inputs.statusword,
        status.state,
        inputs.mode_display.unwrap_or_default(),
        inputs.position.unwrap_or_default(),
        drive.velocity,
        if inputs.fresh { "" } else { " not fresh" },
        out.controlword,
        out.mode,
        out.target_position,
        out.target_velocity,
        out.target_torque,
        if status.enabled { " enabled" } else { "" },
        if status.moving { " moving" } else { "" },
        if status.in_target { " in target" } else { "" },
        if status.homed() { " homed" } else { "" },
        status.stop.map_or(String::new(), |s| format!(
            " stop {:?} {:?}",
            s.method, s.phase
        )),
        status
            .trip
            .map_or(String::new(), |trip| format!(" trip: {trip}")),
        status
            .fault
            .map_or(String::new(), |fault| format!(" {fault}")),
    );
    // A long wait repeats its lines.
    let repeated = text.lines().last() == line.lines().next();
    if !repeated {
        text.push_str(&line);
    }
}
