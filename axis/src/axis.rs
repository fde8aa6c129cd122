//! One axis: commands in, guarded set-points out, supervision in between.
//!
//! The order of a cycle is that of [`Axis::step`]: read the inputs, judge them, decide where the power goes, advance the
//! set-point, guard it, close the loops. A command only changes what the next cycle does. Targets follow actual values in
//! every cycle in which the drive is not enabled by us, so that enabling never starts with a step.
//!
//! There is one set-point, in user units, whatever the mode. A mode is a law by which it becomes the drive's targets; so a
//! switch of modes changes the law and leaves the set-point where it is.
//!
//! | file | |
//! |---|---|
//! | `config`, `io` | what an axis is made with; what it gets and gives in a cycle |
//! | `command` | what may be ordered, and when it is refused |
//! | `plan` | where the set-point goes |
//! | `law` | from the set-point to the drive's targets |
//! | `switch` | from one mode to another |
//! | `home` | homing |
//! | `stop` | where the power goes, and the way to standstill |
//! | `actual`, `supervise` | what the drive reports, and what is made of it |
//! | `blind` | lost frames, and cycles that were left out |
//! | `report` | the status |

use crate::cia402::{self, Controlword, Memory, Mode, Power, Progress, Request, State, Statusword};
use crate::probe::Probes;
use crate::profile::Profile;
use crate::setpoint::Motion;
use crate::status::{DriveFault, Refused, Trip};
use crate::units::Counts;

mod actual;
mod blind;
mod command;
mod config;
mod home;
mod io;
mod law;
mod plan;
mod report;
mod stop;
mod supervise;
mod switch;

pub use command::Command;
pub use config::{AxisConfig, ConfigError};
pub use io::{Inputs, Outputs};

use actual::Actual;
use config::Control;
use home::Home;
use law::Given;
use plan::Plan;
use stop::PowerGoal;
use switch::Switch;

/// Less is no cycle at all; it would only make quotients overflow.
const SHORTEST_CYCLE_S: f64 = 1e-6;

/// Longest cycle taken at face value. A longer one would be a jump of the set-point, not a cycle.
const LONGEST_CYCLE_S: f64 = 0.1;

#[derive(Debug, Clone)]
pub struct Axis {
    config: AxisConfig,
    /// The mode whose targets count.
    mode: Mode,
    switch: Option<Switch>,
    switch_failed: Option<Mode>,
    memory: Memory,
    statusword: Statusword,
    state: State,
    mode_display: Option<i8>,
    controlword: Controlword,
    goal: PowerGoal,
    reset: bool,
    reset_failed: bool,
    actual: Actual,
    /// Set-points come from `plan`; otherwise they follow `actual`.
    active: bool,
    plan: Plan,
    motion: Motion,
    given: Given,
    fixed: law::Fixed,
    profile: Profile,
    home: Home,
    probes: Probes,
    probe_mapped: bool,
    brake_state: stop::BrakeState,
    resets: stop::Resets,
    /// In target, and at rest, for so long.
    settled_s: f64,
    rested_s: f64,
    /// The set-point's position as of the last cycle; the actual one where no position is commanded.
    sent: Counts,
    sent_before: Counts,
    dt_s: f64,
    /// Of the inputs of this cycle.
    fresh: bool,
    watch: supervise::Watch,
    held_by_range: bool,
    guarded_cycles: u32,
    stale_cycles: u32,
    /// Answers still to come that are older than a gap in the cycle.
    overdue: u8,
    /// Cycles since the last frame that is known to have reached the drive.
    undelivered_cycles: u32,
    /// Fresh cycles in a row without Statusword bit 12.
    unfollowed_cycles: u8,
    /// Nothing was planned for some cycles: the set-point goes on from what the drive has done meanwhile.
    interrupted: bool,
    /// Set-point for this cycle from outside.
    fed: Option<Motion>,
    fault: Option<DriveFault>,
    trip: Option<Trip>,
}

impl Axis {
    pub fn new(config: AxisConfig) -> Result<Self, ConfigError> {
        config.check()?;
        Ok(Self {
            memory: Memory::new(),
            statusword: Statusword::empty(),
            state: State::NotReadyToSwitchOn,
            mode_display: None,
            controlword: Controlword::DISABLE_VOLTAGE_COMMAND,
            goal: PowerGoal::Off,
            reset: false,
            reset_failed: false,
            actual: Actual::new(config.supervision.acceleration.is_some()),
            active: false,
            mode: config.mode,
            switch: None,
            switch_failed: None,
            plan: Plan::braking(&config, config.mode),
            motion: Motion::default(),
            given: Given::default(),
            fixed: law::Fixed::new(&config),
            profile: Profile::new(),
            home: Home::default(),
            probes: Probes::new(),
            probe_mapped: false,
            brake_state: stop::BrakeState::default(),
            resets: stop::Resets::default(),
            settled_s: 0.0,
            rested_s: 0.0,
            sent: Counts::default(),
            sent_before: Counts::default(),
            dt_s: 0.0,
            fresh: false,
            watch: supervise::Watch::default(),
            held_by_range: false,
            guarded_cycles: 0,
            stale_cycles: 0,
            overdue: 0,
            undelivered_cycles: 0,
            unfollowed_cycles: 0,
            interrupted: false,
            fed: None,
            fault: None,
            trip: None,
            config,
        })
    }

    #[must_use]
    pub const fn config(&self) -> &AxisConfig {
        &self.config
    }

    /// Adds the drive's error code to the fault that is being reported; ignored where none is. The first code stays. RT: O(1).
    pub fn note_error_code(&mut self, code: u16) {
        if let Some(fault) = &mut self.fault
            && code != 0
        {
            fault.code.get_or_insert(code);
        }
    }

    /// Takes a command for the next cycle, or refuses it and changes nothing. RT: O(1), never blocks or allocates.
    pub fn command(&mut self, command: Command) -> Result<(), Refused> {
        self.take(command)
    }

    /// The set-point's position in the coming cycle, from outside: for groups, streams and controllers of one's own. To be
    /// called before every [`Axis::step`], or between its halves; after a cycle without it the axis decelerates and holds. Refused, and so
    /// decelerated, where it steps further than the velocity limit allows, changes the velocity by more than the acceleration
    /// limit allows, or leaves the range. RT: O(1), never blocks or allocates.
    pub fn set_point(&mut self, position: f64) -> Result<(), Refused> {
        self.take_set_point(position)
    }

    /// One cycle of `dt_s` seconds (the nominal cycle time, 1 µs to 0.1 s; what is not is cut down to it, or no time at all).
    /// RT: O(1), never blocks or allocates.
    pub fn step(&mut self, inputs: &Inputs, dt_s: f64) -> Outputs {
        self.observe(inputs, dt_s);
        self.act()
    }

    /// The first half of [`Axis::step`]: takes the inputs in and judges them, so that [`Axis::status`] is of this cycle and
    /// commands can answer it. RT: O(1), never blocks or allocates.
    pub fn observe(&mut self, inputs: &Inputs, dt_s: f64) {
        let dt_s = if dt_s >= SHORTEST_CYCLE_S {
            dt_s.min(LONGEST_CYCLE_S)
        } else {
            0.0
        };
        self.dt_s = dt_s;
        self.fresh = inputs.fresh && self.overdue == 0;
        self.overdue = self.overdue.saturating_sub(1);
        if self.fresh {
            self.read(inputs);
            self.judge();
        } else {
            self.stale_cycles = self.stale_cycles.saturating_add(1);
            self.undelivered_cycles = self.undelivered_cycles.saturating_add(1);
            if inputs.late {
                let under_way = 1 + u32::from(self.config.answers_late);
                self.undelivered_cycles = self.undelivered_cycles.min(under_way);
            }
            self.watch.lost(self.sent_before);
        }
        self.actual.pass(dt_s);
    }

    /// The second half: from the inputs and commands to the outputs. RT: O(1), never blocks or allocates.
    pub fn act(&mut self) -> Outputs {
        let (fresh, dt_s) = (self.fresh, self.dt_s);
        self.settle_stop(fresh, dt_s);
        self.settle_reset(dt_s);
        self.settle_mode(fresh, dt_s);
        self.settle_homing(fresh, dt_s);
        self.switch_power(fresh, dt_s);
        if fresh {
            self.update_active();
        }
        let sent = self.sent;
        if !self.active {
            self.follow();
        } else if self.frozen() {
            self.freeze();
        } else if self.stale_cycles > blind::RIDE_THROUGH_CYCLES {
            self.slow_down(dt_s);
        } else {
            self.advance(fresh, dt_s);
            self.close_loops(fresh, dt_s);
        }
        self.settle_brake();
        self.fed = None;
        self.sent_before = sent;
        self.dwell(dt_s);
        self.outputs()
    }

    fn read(&mut self, inputs: &Inputs) {
        self.stale_cycles = 0;
        self.undelivered_cycles = 0;
        self.statusword = Statusword::from_bits_retain(inputs.statusword);
        self.mode_display = inputs.mode_display;
        // Homing moves the origin.
        let fastest = if self.mode == Mode::Hm {
            self.config.limits.velocity * 2.0
        } else {
            f64::INFINITY
        };
        self.actual.read(inputs, &self.config.scale, fastest);
        self.probe_mapped = inputs.touch_probe_status.is_some();
        if let Some(status) = inputs.touch_probe_status {
            let (actual, scale) = (&self.actual, &self.config.scale);
            let stop = self.probes.step(status, |slot| {
                let raw = inputs.touch_probe_positions.get(slot).copied().flatten()?;
                let near = actual.counts().unwrap_or_default();
                Some(scale.position_to_user(near.unwrap_next(raw)).0)
            });
            // Homing has a way of its own.
            if stop && !self.home.running() {
                self.stop();
            }
        }
        if let Some(code) = inputs.error_code {
            self.note_error_code(code);
        }
    }

    fn switch_power(&mut self, fresh: bool, dt_s: f64) {
        let blind = self.blind();
        let power = match self.goal {
            PowerGoal::On if !blind => Power::Enabled,
            PowerGoal::On | PowerGoal::Off => Power::Disabled,
            PowerGoal::Stopping(stop) => stop.power(),
        };
        let request = Request {
            power,
            reset_fault: self.reset,
            hold: !self.mode_confirmed(),
            no_return: self.config.quick_stop.is_some_and(|option| !option.stays()),
        };
        // While frames are lost, no time passes for the drive's state and the reset pulses.
        let dt_s = if fresh { dt_s } else { 0.0 };
        let (memory, step) = cia402::step_in(self.memory, self.state, request, dt_s);
        self.memory = memory;
        self.controlword = step.controlword;
        if step.progress == Progress::ResetFailed {
            self.reset = false;
            self.reset_failed = true;
            self.goal = PowerGoal::Off;
        }
    }

    /// There is nothing a position set-point could follow.
    fn blind(&self) -> bool {
        self.config.control(self.mode) == Control::Position && self.actual.counts().is_none()
    }

    fn update_active(&mut self) {
        let possible = self.state == State::OperationEnabled
            && self.mode_confirmed()
            && self.reported_to_follow()
            && !self.blind();
        if !possible {
            self.active = false;
            self.end_switch();
        } else if !self.active && self.goal == PowerGoal::On {
            self.active = true;
            self.follow();
            self.watch = supervise::Watch::starting_at(self.actual.position(), &self.config.limits);
        }
    }

    /// Targets are what the drive reports: no step when it is enabled, whenever that is.
    fn follow(&mut self) {
        self.sent = self.actual.counts().unwrap_or_default();
        self.motion = Motion::at(self.config.scale.position_to_user(self.sent).0);
        self.given = Given::default();
        self.profile = Profile::new();
        self.plan = Plan::braking(&self.config, self.mode);
        self.held_by_range = false;
        self.interrupted = false;
    }
}
