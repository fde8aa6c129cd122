//! One axis: commands in, guarded set-points out, supervision in between.
//!
//! The order of a cycle is that of [`Axis::step`]: read the inputs, judge them, decide where the power goes, advance the
//! set-point, guard it. A command only changes what the next cycle does. Targets follow actual values in every cycle in which
//! the drive is not enabled by us, so that enabling never starts with a step.

use crate::cia402::{self, Controlword, Memory, Mode, Power, Progress, Request, State, Statusword};
use crate::limits::{LimitError, Limits};
use crate::scale::Scale;
use crate::setpoint::{Hold, Motion, Ramp, Trapezoid};
use crate::status::{AxisStatus, DriveFault, Refused, Trip};
use crate::units::{Counts, PerMille, Percent, RawVelocity, UserUnits, UserVelocity};

mod actual;
mod blind;
mod command;
mod supervise;
mod wish;

use actual::Actual;
use wish::Wish;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AxisConfig {
    /// CSP, CSV or CST.
    pub mode: Mode,
    pub scale: Scale,
    pub limits: Limits,
    /// A CSP move is in target when the reported position is this near, user units.
    pub target_window: f64,
    /// Steepest torque change in CST, percent per second; also how a stop takes torque away.
    pub torque_slope: f64,
}

impl AxisConfig {
    /// With a target window of a tenth of the following error limit (ten counts where there is none, never below two), and
    /// full torque in 0.1 s.
    #[must_use]
    pub fn new(mode: Mode, scale: Scale, limits: Limits) -> Self {
        let window = limits
            .following_error
            .map_or(scale.units_of_counts(10.0), |error| error * 0.1);
        Self {
            mode,
            scale,
            limits,
            target_window: window.max(scale.units_of_counts(2.0)),
            torque_slope: limits.torque * 10.0,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum ConfigError {
    #[error("mode {0} is not one of CSP, CSV, CST")]
    Mode(Mode),
    #[error(transparent)]
    Limit(#[from] LimitError),
    #[error("{what} is {value}: it must be a finite number above zero")]
    NotPositive { what: &'static str, value: f64 },
}

/// One cycle's inputs of one drive. `None`: not mapped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Inputs {
    /// 0x6041.
    pub statusword: u16,
    /// 0x6064.
    pub position: Option<i32>,
    /// 0x606C, in the unit of 0x60A9.
    pub velocity: Option<i32>,
    /// 0x6077.
    pub torque: Option<i16>,
    /// 0x6061.
    pub mode_display: Option<i8>,
    /// `false`: this cycle's frame was lost; the values are old and no decision is made on them. The set-point runs on for two
    /// such cycles in a row, then it waits.
    pub fresh: bool,
}

/// One cycle's outputs of one drive. Every field is always a safe value, whichever of them are mapped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Outputs {
    /// 0x6040.
    pub controlword: u16,
    /// 0x6060.
    pub mode: i8,
    /// 0x607A. Follows the actual position outside CSP.
    pub target_position: i32,
    /// 0x60FF. 0 outside CSV.
    pub target_velocity: i32,
    /// 0x6071. 0 outside CST.
    pub target_torque: i16,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Command {
    /// Take the drive to Operation enabled. Does not reset a fault.
    Enable,
    /// Decelerate, then take the power away.
    Disable,
    /// Acknowledge a trip, and reset the drive's fault if it is in one.
    ResetFault,
    /// Decelerate with the limit acceleration and hold; stays enabled. In CST: torque to zero.
    Stop,
    /// The drive's own quick stop; it then stays in Quick stop active if its option code says so.
    QuickStop,
    /// CSP.
    MoveTo {
        position: f64,
        /// Fraction of the velocity limit, above 0 and at most 1.
        speed: f64,
        /// Fraction of the acceleration limit, above 0 and at most 1.
        ramp: f64,
    },
    /// CSV.
    Velocity {
        velocity: f64,
        /// Fraction of the acceleration limit, above 0 and at most 1.
        ramp: f64,
    },
    /// CST.
    Torque {
        /// Of rated torque.
        percent: f64,
        /// Seconds from the present torque to the new one; never steeper than `torque_slope`.
        ramp_s: f64,
    },
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Plan {
    Hold(Hold),
    Move(Trapezoid),
    Velocity(Ramp),
    Torque(Ramp),
}

/// Less is no cycle at all; it would only make quotients overflow.
const SHORTEST_CYCLE_S: f64 = 1e-6;

/// Longest cycle taken at face value. A longer one would be a jump of the set-point, not a cycle.
const LONGEST_CYCLE_S: f64 = 0.1;

#[derive(Debug, Clone)]
pub struct Axis {
    config: AxisConfig,
    memory: Memory,
    statusword: Statusword,
    state: State,
    mode_display: Option<i8>,
    controlword: Controlword,
    wish: Wish,
    reset: bool,
    reset_failed: bool,
    actual: Actual,
    /// Set-points come from `plan`; otherwise they follow `actual`.
    active: bool,
    plan: Plan,
    motion: Motion,
    torque: f64,
    /// Target position as sent in the last cycle.
    sent: Counts,
    sent_before: Counts,
    dt_s: f64,
    watch: supervise::Watch,
    held_by_range: bool,
    guarded_cycles: u32,
    stale_cycles: u32,
    /// CSP: lost frames stopped a set-point that was moving, and none has come through since.
    cut_short: bool,
    fault: Option<DriveFault>,
    trip: Option<Trip>,
}

impl Axis {
    pub fn new(config: AxisConfig) -> Result<Self, ConfigError> {
        if !matches!(config.mode, Mode::Csp | Mode::Csv | Mode::Cst) {
            return Err(ConfigError::Mode(config.mode));
        }
        config.limits.check(&config.scale)?;
        for (what, value) in [
            ("target_window", config.target_window),
            ("torque_slope", config.torque_slope),
        ] {
            if !(value.is_finite() && value > 0.0) {
                return Err(ConfigError::NotPositive { what, value });
            }
        }
        Ok(Self {
            memory: Memory::new(),
            statusword: Statusword::empty(),
            state: State::NotReadyToSwitchOn,
            mode_display: None,
            controlword: Controlword::DISABLE_VOLTAGE_COMMAND,
            wish: Wish::Disabled,
            reset: false,
            reset_failed: false,
            actual: Actual::default(),
            active: false,
            plan: Plan::Hold(Hold {
                acceleration: config.limits.acceleration,
            }),
            motion: Motion::default(),
            torque: 0.0,
            sent: Counts::default(),
            sent_before: Counts::default(),
            dt_s: 0.0,
            watch: supervise::Watch::default(),
            held_by_range: false,
            guarded_cycles: 0,
            stale_cycles: 0,
            cut_short: false,
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

    /// One cycle of `dt_s` seconds (the nominal cycle time, 1 µs to 0.1 s; what is not is cut down to it, or no time at all).
    /// RT: O(1), never blocks or allocates.
    pub fn step(&mut self, inputs: &Inputs, dt_s: f64) -> Outputs {
        let dt_s = if dt_s >= SHORTEST_CYCLE_S {
            dt_s.min(LONGEST_CYCLE_S)
        } else {
            0.0
        };
        self.dt_s = dt_s;
        if inputs.fresh {
            self.read(inputs);
            self.judge();
        } else {
            self.stale_cycles = self.stale_cycles.saturating_add(1);
            self.watch.lost(self.sent_before);
        }
        self.actual.pass(dt_s);
        self.settle_wish(dt_s);
        self.switch_power(inputs.fresh, dt_s);
        if inputs.fresh {
            self.update_active();
        }
        let sent = self.sent;
        if !self.active {
            self.follow();
        } else if self.frozen() {
            self.freeze();
        } else {
            self.advance(dt_s);
        }
        self.sent_before = sent;
        self.outputs()
    }

    fn read(&mut self, inputs: &Inputs) {
        self.stale_cycles = 0;
        self.cut_short = false;
        self.statusword = Statusword::from_bits_retain(inputs.statusword);
        self.mode_display = inputs.mode_display;
        self.actual.read(inputs, &self.config.scale);
    }

    fn mode_confirmed(&self) -> bool {
        self.mode_display
            .is_none_or(|display| display == self.config.mode.code())
    }

    fn switch_power(&mut self, fresh: bool, dt_s: f64) {
        let blind = self.config.mode == Mode::Csp && self.actual.counts().is_none();
        let power = match self.wish {
            // There is nothing a position target could follow.
            Wish::Enabled | Wish::Disabling { .. } if blind => Power::Disabled,
            Wish::Enabled | Wish::Disabling { .. } => Power::Enabled,
            Wish::Disabled => Power::Disabled,
            Wish::QuickStop { .. } => Power::QuickStop,
        };
        let request = Request {
            power,
            reset_fault: self.reset,
        };
        // While frames are lost, no time passes for the drive's state and the reset pulses.
        let dt_s = if fresh { dt_s } else { 0.0 };
        let (memory, step) = cia402::step(self.memory, self.statusword, request, dt_s);
        self.memory = memory;
        self.controlword = step.controlword;
        if step.progress == Progress::ResetFailed {
            self.reset = false;
            self.reset_failed = true;
            self.wish = Wish::Disabled;
        }
    }

    fn update_active(&mut self) {
        let possible = self.state == State::OperationEnabled
            && self.mode_confirmed()
            && (self.config.mode != Mode::Csp || self.actual.counts().is_some());
        if !possible {
            self.active = false;
        } else if !self.active && self.wish == Wish::Enabled {
            self.active = true;
            self.follow();
            self.watch = supervise::Watch::starting_at(self.actual.position(), &self.config.limits);
        }
    }

    /// Targets are what the drive reports: no step when it is enabled, whenever that is.
    fn follow(&mut self) {
        self.sent = self.actual.counts().unwrap_or_default();
        self.motion = Motion::at(self.config.scale.position_to_user(self.sent).0);
        self.torque = 0.0;
        self.plan = self.braking();
        self.held_by_range = false;
    }

    fn braking(&self) -> Plan {
        match self.config.mode {
            Mode::Csv => Plan::Velocity(Ramp {
                target: 0.0,
                slope: self.config.limits.acceleration,
            }),
            Mode::Cst => Plan::Torque(Ramp {
                target: 0.0,
                slope: self.config.torque_slope,
            }),
            _ => Plan::Hold(Hold {
                acceleration: self.config.limits.acceleration,
            }),
        }
    }

    fn advance(&mut self, dt_s: f64) {
        let before = self.motion;
        match self.plan {
            Plan::Hold(hold) => self.motion = hold.advance(before, dt_s),
            Plan::Move(trapezoid) => self.motion = trapezoid.advance(before, dt_s),
            Plan::Velocity(ramp) => {
                let allowed = self.allowed_by_range(ramp.target);
                self.held_by_range = allowed != ramp.target;
                // Braking for the end of the range may be steeper than the ramp that was asked for.
                let slope = if self.held_by_range {
                    self.config.limits.acceleration
                } else {
                    ramp.slope
                };
                let ramp = Ramp {
                    target: allowed,
                    slope,
                };
                self.motion.velocity = ramp.advance(before.velocity, dt_s);
            }
            Plan::Torque(ramp) => self.torque = ramp.advance(self.torque, dt_s),
        }
        self.guard(before, dt_s);
        self.sent = if self.config.mode == Mode::Csp {
            self.config
                .scale
                .position_to_counts(UserUnits(self.motion.position))
        } else {
            let counts = self.actual.counts().unwrap_or_default();
            self.motion.position = self.config.scale.position_to_user(counts).0;
            counts
        };
    }

    fn outputs(&self) -> Outputs {
        let scale = &self.config.scale;
        let mut out = Outputs {
            controlword: self.controlword.bits(),
            mode: self.config.mode.code(),
            target_position: self.sent.wrapped(),
            target_velocity: 0,
            target_torque: 0,
        };
        if self.config.mode == Mode::Csv {
            let RawVelocity(raw) = scale.velocity_to_raw(UserVelocity(self.motion.velocity));
            out.target_velocity = raw;
        }
        if self.config.mode == Mode::Cst {
            let PerMille(raw) = scale.torque_to_raw(Percent(self.torque));
            out.target_torque = raw;
        }
        out
    }

    fn setpoint_at_rest(&self) -> bool {
        self.motion.velocity == 0.0 && self.torque == 0.0
    }

    /// The set-point has nowhere left to go.
    fn setpoint_arrived(&self) -> bool {
        match self.plan {
            Plan::Hold(_) => self.motion.velocity == 0.0,
            Plan::Move(trapezoid) => trapezoid.finished(self.motion),
            Plan::Velocity(ramp) => self.motion.velocity == ramp.target,
            Plan::Torque(ramp) => self.torque == ramp.target,
        }
    }

    /// RT: O(1).
    #[must_use]
    pub fn status(&self) -> AxisStatus {
        let arrived = self.active && self.setpoint_arrived();
        let error_counts = self
            .actual
            .counts()
            .map_or(0, |Counts(at)| self.sent.0.saturating_sub(at));
        let reached = match self.config.mode {
            Mode::Csp => {
                let error = self.motion.position - self.actual.position();
                error.abs() <= self.config.target_window
            }
            Mode::Csv => self.velocity_reached(),
            _ => true,
        };
        AxisStatus {
            mode: self.config.mode,
            state: self.state,
            time_in_state_s: self.memory.in_state_s(),
            statusword: self.statusword.bits(),
            controlword: self.controlword.bits(),
            enabled: self.active,
            ready: self.active && self.wish == Wish::Enabled,
            mode_confirmed: self.mode_confirmed(),
            moving: self.active && !arrived,
            in_target: arrived && reached,
            at_rest: self.motion.velocity == 0.0 && self.standing(),
            position: self.actual.position(),
            velocity: self.actual.velocity(),
            torque: self.actual.torque(),
            target_position: self.motion.position,
            target_velocity: self.motion.velocity,
            target_torque: self.torque,
            following_error: self.watch.following_error,
            max_following_error: self.watch.max_following_error,
            final_error_counts: (arrived && matches!(self.plan, Plan::Move(_)))
                .then_some(error_counts),
            held_by_range: self.held_by_range,
            guarded_cycles: self.guarded_cycles,
            stale_cycles: self.stale_cycles,
            fault: self.fault,
            trip: self.trip,
            resetting: self.reset,
            reset_failed: self.reset_failed,
        }
    }
}
