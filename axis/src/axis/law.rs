//! From the set-point to the drive's targets, by the law of each mode.

use super::actual::FILTER_S;
use super::{Axis, AxisConfig, Control, Outputs, Plan};
use crate::cia402::{Controlword, Mode, ModeCommand};
use crate::loops::{Deviation, Integral, bounded};
use crate::scale::Scale;
use crate::setpoint::Ramp;
use crate::units::{
    PerMille, Percent, RawAcceleration, RawVelocity, UserAcceleration, UserUnits, UserVelocity,
};

/// What the loops gave last, user units and percent.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Given {
    velocity: f64,
    /// Of `velocity`, what the position loop added. Changes by no more than the acceleration limit allows, apart from what
    /// the set-point does: were the sum limited, a set-point at the limit would leave nothing to correct with.
    correction: f64,
    pub(super) torque: f64,
    integral: Integral,
    /// The PID loop is to go on from `torque`.
    takes_over: bool,
    velocity_offset: f64,
}

/// What follows from the configuration and is needed in every cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Fixed {
    /// 0x6081 and 0x6083 where no goal says more.
    speed: u32,
    acceleration: u32,
    /// What the last digit of a velocity may be wrong by, user units per second: as reported, and as made from positions.
    pub(super) slack: [f64; 2],
}

impl Fixed {
    pub(super) fn new(config: &AxisConfig) -> Self {
        let scale = &config.scale;
        Self {
            speed: speed(scale, config.limits.velocity),
            acceleration: acceleration(scale, config.limits.acceleration),
            slack: [
                2.0 * scale.velocity_resolution(),
                scale.units_of_counts(2.0) / FILTER_S,
            ],
        }
    }
}

impl Given {
    /// The loops go on from what was given last.
    pub(super) const fn take_over(&mut self) {
        self.takes_over = true;
    }

    /// Into a mode: of the shadow's velocity nothing is a correction.
    pub(super) const fn enter(&mut self) {
        self.correction = 0.0;
        self.takes_over = true;
    }
}

impl Axis {
    /// The set-point as the position reported now would show it, had the drive no error. `late_s`: since the set-point left.
    pub(super) fn expected(&self, late_s: f64) -> f64 {
        let motion = &self.motion;
        let late_s = late_s.max(0.0);
        motion.position - (motion.velocity - motion.acceleration * late_s * 0.5) * late_s
    }

    /// After the set-point has advanced. RT: O(1).
    pub(super) fn close_loops(&mut self, fresh: bool, dt_s: f64) {
        let limits = self.config.limits;
        let loops = self.config.loops;
        let switch = self.other_mode();
        let velocity = self.motion.velocity;
        match self.mode {
            Mode::Csp if switch.is_none() => {
                let ramp = Ramp {
                    target: loops.csp.velocity * velocity,
                    slope: limits.acceleration,
                };
                self.given.velocity_offset = ramp.advance(self.given.velocity_offset, dt_s);
            }
            Mode::Csv => match loops.csv {
                None => self.given.velocity = velocity,
                Some(law) => {
                    if fresh {
                        let error = self.expected(self.config.dead_time_s) - self.actual.position();
                        let ramp = Ramp {
                            target: bounded(law.correction(error), limits.velocity),
                            slope: limits.acceleration,
                        };
                        self.given.correction = ramp.advance(self.given.correction, dt_s);
                    }
                    let wanted = law.feed_forward * velocity + self.given.correction;
                    self.given.velocity = bounded(wanted, limits.velocity);
                }
            },
            Mode::Cst if fresh && !matches!(self.plan, Plan::Torque(_)) => self.close_torque(dt_s),
            _ => {}
        }
        if self.mode != Mode::Csp || switch.is_some() {
            self.given.velocity_offset = 0.0;
        }
        self.shadow();
    }

    /// The targets of the mode that is being switched to. Also while frames are lost: the drive may have got the new mode.
    pub(super) fn shadow(&mut self) {
        let limits = self.config.limits;
        match self.other_mode() {
            Some(Mode::Csv | Mode::Pv) if self.mode != Mode::Csv => {
                self.given.velocity = bounded(self.motion.velocity, limits.velocity);
            }
            Some(Mode::Cst) => self.given.torque = bounded(self.actual.torque(), limits.torque),
            _ => {}
        }
    }

    fn close_torque(&mut self, dt_s: f64) {
        let Some(pid) = self.config.loops.cst else {
            return;
        };
        let limit = self.config.limits.torque;
        let seen = Deviation {
            position: self.expected(self.config.dead_time_s) - self.actual.position(),
            velocity: self.motion.velocity - self.actual.velocity(),
            acceleration: self.motion.acceleration,
        };
        if core::mem::take(&mut self.given.takes_over) {
            self.given.integral = pid.starting_with(self.given.torque, seen);
        }
        let slope = self.config.torque_slope;
        (self.given.integral, self.given.torque) =
            pid.advance(self.given.integral, seen, limit, slope, dt_s);
    }

    pub(super) fn outputs(&self) -> Outputs {
        let scale = &self.config.scale;
        let mode = self.other_mode().unwrap_or(self.mode);
        let actual = self.actual.counts().unwrap_or_default();
        let mut out = Outputs {
            controlword: self.controlword.bits(),
            mode: self.mode_asked().code(),
            target_position: actual.wrapped(),
            touch_probe_function: if self.probe_mapped {
                self.probes.function()
            } else {
                0
            },
            brake_open: self.brake_state.open,
            profile_velocity: self.fixed.speed,
            profile_acceleration: self.fixed.acceleration,
            ..Outputs::default()
        };
        if !self.active {
            return out;
        }
        if self.mode_command_counts() {
            self.profile_outputs(&mut out);
        }
        let counts = |wanted: Mode| self.mode == wanted || mode == wanted;
        if counts(Mode::Csp) && self.grip() == Control::Position {
            out.target_position = self.sent.wrapped();
        } else if mode == Mode::Csp {
            out.target_position = scale
                .position_to_counts(UserUnits(self.motion.position))
                .wrapped();
        }
        if counts(Mode::Csv) || (mode == Mode::Pv && self.mode != Mode::Pv) {
            let RawVelocity(raw) = scale.velocity_to_raw(UserVelocity(self.given.velocity));
            out.target_velocity = raw;
        }
        if counts(Mode::Cst) {
            let PerMille(raw) = scale.torque_to_raw(Percent(self.given.torque));
            out.target_torque = raw;
        }
        if self.mode == Mode::Csp && self.switch.is_none() {
            let loops = self.config.loops.csp;
            if loops.velocity != 0.0 {
                let offset = UserVelocity(self.given.velocity_offset);
                out.velocity_offset = scale.velocity_to_raw(offset).0;
            }
            if loops.acceleration != 0.0 {
                let torque = loops.acceleration * self.motion.acceleration;
                let torque = Percent(bounded(torque, self.config.limits.torque));
                out.torque_offset = scale.torque_to_raw(torque).0;
            }
        }
        out
    }

    /// The bits of a mode belong beside "enable operation" alone.
    fn mode_command_counts(&self) -> bool {
        self.controlword == Controlword::ENABLE_OPERATION_COMMAND
    }

    /// PP, PV and HM: bits and goals.
    fn profile_outputs(&self, out: &mut Outputs) {
        let scale = &self.config.scale;
        let goal = self.profile.goal();
        let command = match self.mode {
            Mode::Pp => {
                if let Some(goal) = goal {
                    let target = scale.position_to_counts(UserUnits(goal.target));
                    out.target_position = target.wrapped();
                    out.profile_velocity = speed(scale, goal.velocity);
                }
                self.profile.position_bits()
            }
            Mode::Pv => {
                if let Some(goal) = goal {
                    out.target_velocity = scale.velocity_to_raw(UserVelocity(goal.target)).0;
                }
                self.profile.velocity_bits()
            }
            Mode::Hm => self.home.bits(),
            _ => ModeCommand::Nothing,
        };
        if let (Mode::Pp | Mode::Pv, Some(goal)) = (self.mode, goal) {
            out.profile_acceleration = acceleration(scale, goal.acceleration);
        }
        out.controlword = self.controlword.with(command).bits();
    }
}

/// 0 would be no motion at all.
fn speed(scale: &Scale, velocity: f64) -> u32 {
    let RawVelocity(raw) = scale.velocity_to_raw(UserVelocity(velocity));
    raw.unsigned_abs().max(1)
}

fn acceleration(scale: &Scale, acceleration: f64) -> u32 {
    let RawAcceleration(raw) = scale.acceleration_to_raw(UserAcceleration(acceleration));
    raw.max(1)
}
