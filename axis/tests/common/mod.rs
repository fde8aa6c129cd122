//! Reference drive for these tests: transitions of the standard, an ideal motor, one cycle of delay
//! in each direction.

use ecaxis_axis::setpoint::{Hold, Motion, Ramp, Rate, Setpoint, Trapezoid};
use ecaxis_axis::{
    Axis, AxisConfig, AxisStatus, Command, FeedForward, Inputs, Limits, Loops, Mode, Modes,
    Outputs, PositionPid, Scale, State, VelocityLoop, VelocityUnit,
};

pub const DT: f64 = 0.001;

pub const LIMITS: Limits = Limits {
    position: Some([-50.0, 50.0]),
    velocity: 200.0,
    acceleration: 2000.0,
    jerk: None,
    torque: 100.0,
    following_error: Some(1.0),
};

/// 2000 counts and 5 mm per turn, velocities in mrpm.
pub fn scale() -> Scale {
    Scale::new(2000.0, 5.0)
        .unwrap()
        .with_velocity_unit(VelocityUnit::MILLI_RPM)
}

pub fn axis(mode: Mode) -> Axis {
    Axis::new(AxisConfig::new(mode, scale(), LIMITS)).unwrap()
}

#[derive(Debug, Clone)]
pub struct Drive {
    pub state: State,
    pub mode: i8,
    pub position: f64,
    pub velocity: f64,
    pub torque: i16,
    /// Quick stop option code 6 (stays in Quick stop active) or 2 (continues to Switch on
    /// disabled).
    pub quick_stop_stays: bool,
    /// The motor does not move.
    pub blocked: bool,
    /// Faults return at once after a reset.
    pub stubborn: bool,
    pub resets: u32,
    /// Cycles from a received mode until it is active and displayed. `None`: it never changes
    /// again.
    pub mode_delay: Option<u32>,
    mode_waits: u32,
    /// The mode changes without power only.
    pub mode_unpowered: bool,
    /// Shutdown has no effect in Operation enabled.
    pub ignores_shutdown: bool,
    /// Cycles in Operation enabled until the mode is shown. `None`: it is always shown.
    pub shown_after: Option<u32>,
    enabled_cycles: u32,
    /// Torque of the load in torque mode, per mille.
    pub load: f64,
    /// Position of the home switch, counts before homing. `None`: never found.
    pub home_at: Option<f64>,
    /// Position after homing, counts.
    pub home_is: f64,
    pub homing_error: bool,
    /// Never acknowledges a set-point.
    pub deaf: bool,
    /// Obeys no halt (bit 8).
    pub ignores_halt: bool,
    /// Cycles of a homing in which bits 12 and 10 are those of an earlier one.
    pub stale_attained: u32,
    /// The drive has found its home switch.
    pub homing_searched: bool,
    pub homing: Homing,
    set_point: Option<f64>,
    acknowledged: bool,
    reached: bool,
    controlword: u16,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Homing {
    NotStarted,
    Searching,
    Done,
    Error,
}

impl Drive {
    pub fn at(position: i32) -> Self {
        Self {
            state: State::NotReadyToSwitchOn,
            mode: 0,
            position: f64::from(position),
            velocity: 0.0,
            torque: 0,
            quick_stop_stays: true,
            blocked: false,
            stubborn: false,
            resets: 0,
            mode_delay: Some(0),
            mode_waits: 0,
            mode_unpowered: false,
            ignores_shutdown: false,
            shown_after: None,
            enabled_cycles: 0,
            load: 0.0,
            home_at: Some(-2000.0),
            home_is: 0.0,
            homing_error: false,
            deaf: false,
            ignores_halt: false,
            stale_attained: 0,
            homing_searched: false,
            homing: Homing::NotStarted,
            set_point: None,
            acknowledged: false,
            reached: true,
            controlword: 0,
        }
    }

    pub fn statusword(&self) -> u16 {
        match self.state {
            State::NotReadyToSwitchOn => 0x0000,
            State::SwitchOnDisabled => 0x0240,
            State::ReadyToSwitchOn => 0x0231,
            State::SwitchedOn => 0x0233,
            State::OperationEnabled => 0x0237 | self.mode_bits(),
            State::QuickStopActive => 0x0217,
            State::FaultReactionActive => 0x021F,
            State::Fault => 0x0218,
            State::Unknown(word) => word,
        }
    }

    fn mode_bits(&self) -> u16 {
        let bit = |on: bool, n: u32| u16::from(on) << n;
        match self.mode {
            1 => bit(self.acknowledged, 12) | bit(self.reached, 10),
            3 => bit(self.velocity == 0.0, 12) | bit(self.reached, 10),
            6 if self.stale_attained > 0 => 0x1400,
            6 => match self.homing {
                Homing::NotStarted => 0x0400,
                Homing::Searching => 0x0000,
                Homing::Done => 0x1400,
                Homing::Error => bit(true, 13) | bit(self.velocity == 0.0, 10),
            },
            _ => 0x1000,
        }
    }

    /// PP, PV and HM. `rose`: rising edge of bit 4.
    fn profile(&mut self, out: &Outputs, rose: bool, dt: f64) {
        let halt = out.controlword & 0x100 != 0 && !self.ignores_halt;
        let start = out.controlword & 0x10 != 0;
        let mrpm = 2000.0 / 60_000.0;
        let slope = f64::from(out.profile_acceleration) * mrpm;
        let rest = Hold {
            acceleration: slope,
        };
        if self.mode == 1 {
            if rose && !self.deaf {
                self.set_point = Some(f64::from(out.target_position));
                (self.acknowledged, self.reached) = (true, false);
            }
            self.acknowledged &= start;
        }
        if self.mode == 6 {
            self.stale_attained = self.stale_attained.saturating_sub(1);
            self.homing = match self.homing {
                _ if !start && self.homing != Homing::Done => Homing::NotStarted,
                _ if rose => Homing::Searching,
                Homing::Searching if self.homing_error => Homing::Error,
                Homing::Searching if self.home_at.is_some_and(|at| self.position <= at) => {
                    self.homing_searched = true;
                    (self.position, self.velocity) = (self.home_is, 0.0);
                    Homing::Done
                }
                same => same,
            };
        }
        let here = Motion {
            position: self.position,
            velocity: self.velocity,
            acceleration: 0.0,
        };
        let next = match (self.mode, self.set_point, self.homing) {
            _ if halt => rest.brake(here, dt),
            (1, Some(target), _) => Trapezoid {
                target,
                velocity: f64::from(out.profile_velocity) * mrpm,
                acceleration: slope,
                braking: slope,
            }
            .advance(here, Rate::WHOLE, dt),
            (3, _, _) => {
                let ramp = Ramp {
                    target: f64::from(out.target_velocity) * mrpm,
                    slope,
                };
                let velocity = ramp.advance(self.velocity, dt);
                here.then(self.position + velocity * dt, velocity, dt)
            }
            (6, _, Homing::Searching) => here.then(self.position - 8.0, -8.0 / dt, dt),
            _ => rest.brake(here, dt),
        };
        (self.position, self.velocity) = (next.position, next.velocity);
        self.reached = match self.mode {
            _ if halt => self.velocity == 0.0,
            1 => self.set_point.is_none_or(|at| next.stands_at(at)),
            _ => self.velocity == f64::from(out.target_velocity) * mrpm,
        };
    }

    pub fn raw_position(&self) -> i32 {
        (self.position.round() as i64) as i32
    }

    fn mode_shown(&self) -> i8 {
        match self.shown_after {
            Some(cycles) if self.enabled_cycles <= cycles => 0,
            _ => self.mode,
        }
    }

    pub fn inputs(&self) -> Inputs {
        Inputs {
            statusword: self.statusword(),
            position: Some(self.raw_position()),
            velocity: Some((self.velocity / 2000.0 * 60_000.0).round() as i32),
            torque: Some(self.torque),
            mode_display: Some(self.mode_shown()),
            fresh: true,
            ..Inputs::default()
        }
    }

    pub fn fault(&mut self) {
        self.state = State::FaultReactionActive;
    }

    /// Receives the outputs and moves for one cycle.
    pub fn cycle(&mut self, out: &Outputs, dt: f64) {
        let rose = out.controlword & !self.controlword & 0x10 != 0;
        let edge = out.controlword & !self.controlword & 0x80 != 0;
        self.controlword = out.controlword;
        self.mode_waits = if out.mode == self.mode {
            0
        } else {
            self.mode_waits + 1
        };
        let powered = matches!(
            self.state,
            State::SwitchedOn | State::OperationEnabled | State::QuickStopActive
        );
        let changes = self.mode_delay.is_some_and(|delay| self.mode_waits > delay);
        if changes && !(self.mode_unpowered && powered) {
            self.mode = out.mode;
            self.mode_waits = 0;
            (self.set_point, self.acknowledged, self.reached) = (None, false, true);
        }
        let w = out.controlword & 0x0F;
        self.state = match self.state {
            State::NotReadyToSwitchOn => State::SwitchOnDisabled,
            State::SwitchOnDisabled if w & 7 == 6 => State::ReadyToSwitchOn,
            State::ReadyToSwitchOn if w & 7 == 7 => State::SwitchedOn,
            State::ReadyToSwitchOn if w & 2 == 0 || w & 6 == 2 => State::SwitchOnDisabled,
            State::SwitchedOn if w == 0x0F => State::OperationEnabled,
            State::SwitchedOn if w & 7 == 6 => State::ReadyToSwitchOn,
            State::SwitchedOn if w & 2 == 0 || w & 6 == 2 => State::SwitchOnDisabled,
            State::OperationEnabled if w == 7 => State::SwitchedOn,
            State::OperationEnabled if w & 7 == 6 && !self.ignores_shutdown => {
                State::ReadyToSwitchOn
            }
            State::OperationEnabled if w & 2 == 0 => State::SwitchOnDisabled,
            State::OperationEnabled if w & 6 == 2 => State::QuickStopActive,
            State::QuickStopActive if w & 2 == 0 => State::SwitchOnDisabled,
            State::QuickStopActive if w == 0x0F => State::OperationEnabled,
            State::QuickStopActive if self.velocity == 0.0 && !self.quick_stop_stays => {
                State::SwitchOnDisabled
            }
            State::FaultReactionActive => State::Fault,
            State::Fault if edge => {
                self.resets += 1;
                if self.stubborn {
                    State::Fault
                } else {
                    State::SwitchOnDisabled
                }
            }
            other => other,
        };
        self.enabled_cycles = match self.state {
            State::OperationEnabled => self.enabled_cycles + 1,
            _ => 0,
        };
        let before = self.position;
        self.torque = 0;
        match self.state {
            _ if self.blocked => self.velocity = 0.0,
            State::OperationEnabled => match self.mode {
                8 => {
                    let step = out.target_position.wrapping_sub(self.raw_position());
                    self.position += f64::from(step);
                    // After lost frames the set-point steps; a real motor would not reach that
                    // velocity.
                    self.velocity = ((self.position - before) / dt).clamp(-100_000.0, 100_000.0);
                }
                9 => {
                    self.velocity = f64::from(out.target_velocity) / 60_000.0 * 2000.0;
                    self.position += self.velocity * dt;
                }
                1 | 3 | 6 => self.profile(out, rose, dt),
                _ => {
                    self.torque = out.target_torque;
                    self.velocity += (f64::from(out.target_torque) + self.load) * 100.0 * dt;
                    self.position += self.velocity * dt;
                }
            },
            // Braking, or friction.
            _ => {
                let less = 1_600_000.0 * dt;
                self.velocity -= self.velocity.clamp(-less, less);
                self.position += self.velocity * dt;
            }
        }
    }
}

/// Time from the step of the axis to the inputs that show it, in this rig.
pub const DEAD_TIME_S: f64 = 2.0 * DT;

/// All cyclic modes, with loops tuned for [`Drive`].
pub fn looped(mode: Mode, limits: Limits) -> AxisConfig {
    AxisConfig {
        modes: Modes::only(Mode::Csp).with(Mode::Csv).with(Mode::Cst),
        loops: Loops {
            csp: FeedForward::default(),
            csv: Some(VelocityLoop {
                kv: 20.0,
                feed_forward: 1.0,
            }),
            // A torque of 1 % accelerates by 2.5 mm/s².
            cst: Some(PositionPid {
                kp: 1000.0,
                tn_s: Some(0.1),
                tv_s: 0.04,
                acceleration: 0.4,
            }),
        },
        dead_time_s: DEAD_TIME_S,
        ..AxisConfig::new(mode, scale(), limits)
    }
}

/// All modes.
pub fn all(mode: Mode, limits: Limits) -> AxisConfig {
    let looped = looped(mode, limits);
    AxisConfig {
        modes: looped.modes.with(Mode::Pp).with(Mode::Pv).with(Mode::Hm),
        ..looped
    }
}

/// An axis and its drive, with one cycle of delay from the drive's inputs to the effect of the
/// outputs.
#[derive(Debug, Clone)]
pub struct Rig {
    pub axis: Axis,
    pub drive: Drive,
    pub out: Outputs,
}

impl Rig {
    pub fn new(axis: Axis, drive: Drive) -> Self {
        let mut rig = Self {
            axis,
            drive,
            out: Outputs::default(),
        };
        let inputs = rig.drive.inputs();
        rig.out = rig.axis.step(&inputs, DT);
        rig
    }

    pub fn of(mode: Mode) -> Self {
        Self::new(axis(mode), Drive::at(0))
    }

    /// Returns a rig with an enabled axis.
    pub fn enabled(mode: Mode) -> Self {
        let mut rig = Self::of(mode);
        rig.axis.command(Command::Enable).unwrap();
        rig.until(|s| s.ready, 100);
        rig
    }

    pub fn cycle(&mut self) -> AxisStatus {
        self.cycle_with(true)
    }

    pub fn cycle_with(&mut self, fresh: bool) -> AxisStatus {
        let mut inputs = self.drive.inputs();
        inputs.fresh = fresh;
        if fresh {
            self.drive.cycle(&self.out, DT);
        }
        self.out = self.axis.step(&inputs, DT);
        self.axis.status()
    }

    pub fn run(&mut self, cycles: u32) -> AxisStatus {
        for _ in 0..cycles {
            self.cycle();
        }
        self.axis.status()
    }

    #[track_caller]
    pub fn until(&mut self, done: impl Fn(&AxisStatus) -> bool, cycles: u32) -> AxisStatus {
        for _ in 0..cycles {
            let status = self.cycle();
            if done(&status) {
                return status;
            }
        }
        panic!(
            "not after {cycles} cycles: {:#?}\n{:#?}",
            self.axis.status(),
            self.drive
        );
    }
}
