//! Control laws: conversion of the set-point to the drive's targets in each mode.

use super::feedback::FILTER_S;
use super::{Axis, AxisConfig, ControlledQuantity, Outputs, Plan};
use crate::cia402::{Controlword, Mode, ModeCommand};
use crate::position_loop::{Deviation, Integral, bounded};
use crate::scale::Scale;
use crate::setpoint::Ramp;
use crate::units::{
    PerMille, Percent, RawAcceleration, RawVelocity, UserAcceleration, UserUnits, UserVelocity,
};

/// The least share of the torque limit that shows how strong a motor is, and the most that it may
/// exceed its limits.
const LEAST_TORQUE: f64 = 0.05;
const MOST_STRENGTH: f64 = 10.0;

/// The last outputs of the loops, user units and percent.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct LoopState {
    velocity: f64,
    /// The part of `velocity` added by the position loop. Only its own change is limited, by the
    /// acceleration limit. A limit on the sum would leave no correction while the set-point
    /// accelerates at the limit.
    correction: f64,
    pub(super) torque: f64,
    integral: Integral,
    /// The part of a commanded torque that the velocity limit takes away.
    reduction: f64,
    /// The torque that keeps the axis at the velocity limit, in the direction of the command.
    holding: f64,
    /// The torque with the delay of the reported acceleration.
    filtered_torque: f64,
    /// True: the PID loop continues from `torque`.
    takes_over: bool,
    velocity_offset: f64,
}

/// Values derived from the configuration and needed in every cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct DerivedConstants {
    /// 0x6081 and 0x6083 without a goal.
    speed: u32,
    acceleration: u32,
    /// Error from the resolution of a velocity, user units per second: of reported velocities, and
    /// of velocities derived from positions.
    pub(super) slack: [f64; 2],
}

impl DerivedConstants {
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

impl LoopState {
    /// Lets the loops continue from the last outputs.
    pub(super) fn take_over(&mut self) {
        self.take_limited();
        self.takes_over = true;
    }

    /// Makes the torque that was sent the commanded one.
    pub(super) fn take_limited(&mut self) {
        self.torque = self.limited_torque();
        self.release_speed();
    }

    /// Returns the commanded torque within the velocity limit.
    pub(super) fn limited_torque(&self) -> f64 {
        self.torque - self.reduction
    }

    /// Ends the reduction of the torque.
    pub(super) const fn release_speed(&mut self) {
        self.reduction = 0.0;
        self.holding = 0.0;
    }

    /// Enters a mode: the velocity prepared for the switch contains no correction.
    pub(super) const fn enter(&mut self) {
        self.correction = 0.0;
        self.release_speed();
        self.takes_over = true;
    }
}

impl Axis {
    /// Returns the drive position that a drive without following error would report now. `late_s`:
    /// time since the set-point left.
    pub(super) fn expected(&self, late_s: f64) -> f64 {
        let motion = self.drive_motion();
        let late_s = late_s.max(0.0);
        motion.position - (motion.velocity - motion.acceleration * late_s * 0.5) * late_s
    }

    /// Closes the loops of the active mode, after the set-point has advanced. RT: O(1).
    pub(super) fn close_loops(&mut self, fresh: bool, dt_s: f64) {
        let limits = self.config.limits;
        let loops = self.config.loops;
        let switch = self.other_mode();
        let velocity = self.drive_motion().velocity;
        match self.mode {
            Mode::Csp if switch.is_none() => {
                let ramp = Ramp {
                    target: loops.csp.velocity * velocity,
                    slope: limits.acceleration,
                };
                self.loop_state.velocity_offset =
                    ramp.advance(self.loop_state.velocity_offset, dt_s);
            }
            Mode::Csv => match loops.csv {
                None => self.loop_state.velocity = velocity,
                Some(law) => {
                    if fresh {
                        let error = self.expected(self.config.dead_time_s) - self.actual.drive();
                        let ramp = Ramp {
                            target: bounded(law.correction(error), limits.velocity),
                            slope: limits.acceleration,
                        };
                        self.loop_state.correction = ramp.advance(self.loop_state.correction, dt_s);
                    }
                    let wanted = law.feed_forward * velocity + self.loop_state.correction;
                    let most = self.compensation.drive_velocity(limits.velocity);
                    self.loop_state.velocity = bounded(wanted, most);
                }
            },
            Mode::Cst if fresh && !matches!(self.plan, Plan::Torque(_)) => self.close_torque(dt_s),
            _ => {}
        }
        if self.mode != Mode::Csp || switch.is_some() {
            self.loop_state.velocity_offset = 0.0;
        }
        self.preload_next_mode();
    }

    /// Sets the targets of the other mode of a switch. Runs also while frames are lost, because the
    /// drive may already have changed its mode.
    pub(super) fn preload_next_mode(&mut self) {
        let limits = self.config.limits;
        match self.other_mode() {
            Some(Mode::Csv | Mode::Pv) if self.mode != Mode::Csv => {
                let most = self.compensation.drive_velocity(limits.velocity);
                self.loop_state.velocity = bounded(self.drive_motion().velocity, most);
            }
            Some(Mode::Cst) => {
                self.loop_state.torque = bounded(self.actual.torque(), limits.torque)
            }
            _ => {}
        }
    }

    /// Reduces a commanded torque so that the speed stays at the velocity limit. A PI controller of
    /// the speed asks for torque, and the smaller torque counts. Its gain assumes that the torque
    /// limit gives the acceleration limit. The torque changes by the configured slope at most, so it
    /// falls early enough to end at the limit. `before`: the torque of the last cycle. RT: O(1).
    pub(super) fn keep_speed(&mut self, before: f64, fresh: bool, dt_s: f64) {
        let limits = self.config.limits;
        let (torque, slope) = (self.loop_state.torque, self.config.torque_slope);
        let (wanted, direction) = (torque.abs(), torque.signum());
        let filter_s = match self.actual.velocity_is_measured() {
            true => 0.0,
            false => FILTER_S,
        };
        let late_s = self.config.dead_time_s + filter_s;
        let strength = self.note_strength(before, late_s, dt_s);
        if wanted == 0.0 {
            // A braking torque ends with the slope as well.
            let next = Ramp { target: 0.0, slope }.advance(before, dt_s);
            (self.loop_state.holding, self.loop_state.reduction) = (0.0, torque - next);
            return;
        }
        // A quarter of the delay's bandwidth; the integral part is eight times slower.
        let bandwidth = 0.25 / (late_s + 2.0 * dt_s);
        let per_acceleration = limits.torque / limits.acceleration;
        let room = limits.velocity - self.actual.velocity() * direction;
        // A torque t accelerates by s·t during the delay, and while it falls to 0: with the slope k,
        // s·t·delay + s·t²/2k is the room.
        let delay = (late_s + 2.0 * dt_s) * slope;
        let last = (delay * delay + 2.0 * slope * room.max(0.0) / strength).sqrt() - delay;
        let linear = bandwidth * per_acceleration * room;
        let direct = linear.min(last);
        let state = &mut self.loop_state;
        if direct >= wanted {
            state.holding = 0.0;
        }
        let allowed = (direct + state.holding).clamp(-limits.torque, wanted);
        let target = allowed * direction;
        let next = Ramp { target, slope }.advance(before, dt_s);
        // While the slope limits the torque, the sum must not grow.
        if direct < wanted && direct == linear && fresh && next == target {
            let holding = state.holding + direct * bandwidth * 0.125 * dt_s;
            state.holding = holding.clamp(-limits.torque, wanted);
        }
        state.reduction = torque - next;
    }

    /// Returns the acceleration per torque that the axis shows, at least that of its limits. `late_s`:
    /// the age of the reported velocity.
    fn note_strength(&mut self, torque: f64, late_s: f64, dt_s: f64) -> f64 {
        let limits = &self.config.limits;
        let nominal = limits.acceleration / limits.torque;
        let state = &mut self.loop_state;
        // The torque that caused the filtered acceleration.
        let weight = dt_s / (dt_s + late_s + FILTER_S);
        state.filtered_torque += (torque - state.filtered_torque) * weight;
        if state.filtered_torque.abs() < limits.torque * LEAST_TORQUE {
            return nominal;
        }
        let shown = self.actual.acceleration() / state.filtered_torque;
        shown.max(nominal).min(nominal * MOST_STRENGTH)
    }

    fn close_torque(&mut self, dt_s: f64) {
        let Some(pid) = self.config.loops.cst else {
            return;
        };
        let limit = self.config.limits.torque;
        let motion = self.drive_motion();
        let seen = Deviation {
            position: self.expected(self.config.dead_time_s) - self.actual.drive(),
            velocity: motion.velocity - self.actual.drive_velocity(),
            acceleration: motion.acceleration,
        };
        if core::mem::take(&mut self.loop_state.takes_over) {
            self.loop_state.integral = pid.starting_with(self.loop_state.torque, seen);
        }
        let slope = self.config.torque_slope;
        (self.loop_state.integral, self.loop_state.torque) =
            pid.advance(self.loop_state.integral, seen, limit, slope, dt_s);
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
            profile_velocity: self.derived.speed,
            profile_acceleration: self.derived.acceleration,
            ..Outputs::default()
        };
        if !self.follows() {
            return out;
        }
        if self.mode_command_counts() {
            self.profile_outputs(&mut out);
        }
        let counts = |wanted: Mode| self.mode == wanted || mode == wanted;
        if counts(Mode::Csp) && self.controlled_quantity() == ControlledQuantity::Position {
            out.target_position = self.sent.wrapped();
        } else if mode == Mode::Csp {
            out.target_position = self.drive_counts(self.motion.position).wrapped();
        }
        if counts(Mode::Csv) || (mode == Mode::Pv && self.mode != Mode::Pv) {
            let RawVelocity(raw) = scale.velocity_to_raw(UserVelocity(self.loop_state.velocity));
            out.target_velocity = raw;
        }
        if counts(Mode::Cst) {
            let PerMille(raw) = scale.torque_to_raw(Percent(self.loop_state.limited_torque()));
            out.target_torque = raw;
        }
        if self.mode == Mode::Csp && self.switch.is_none() {
            let loops = self.config.loops.csp;
            if loops.velocity != 0.0 {
                let offset = UserVelocity(self.loop_state.velocity_offset);
                out.velocity_offset = scale.velocity_to_raw(offset).0;
            }
            if loops.acceleration != 0.0 || self.torque_feedforward != 0.0 {
                let torque = loops.acceleration * self.drive_motion().acceleration;
                let torque = torque + self.torque_feedforward;
                let torque = Percent(bounded(torque, self.config.limits.torque));
                out.torque_offset = scale.torque_to_raw(torque).0;
            }
        }
        out
    }

    /// True if mode-specific bits may be set: only together with "enable operation".
    fn mode_command_counts(&self) -> bool {
        self.controlword == Controlword::ENABLE_OPERATION_COMMAND
    }

    /// Sets the bits and goals of PP, PV and HM.
    fn profile_outputs(&self, out: &mut Outputs) {
        let scale = &self.config.scale;
        let goal = self.profile.goal();
        let command = match self.mode {
            Mode::Pp => {
                if let Some(goal) = goal {
                    let target = scale.position_to_counts(UserUnits(goal.target));
                    out.target_position = target.wrapped();
                    // A held profile keeps its velocity: the drive accepts no other.
                    let velocity = match self.rate {
                        0.0 => goal.velocity,
                        _ => self.profile_velocity(goal.velocity),
                    };
                    out.profile_velocity = speed(scale, velocity);
                }
                self.profile.position_bits()
            }
            Mode::Pv => {
                if let Some(goal) = goal {
                    let velocity = self.profile_velocity(goal.target);
                    out.target_velocity = scale.velocity_to_raw(UserVelocity(velocity)).0;
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

/// Returns the profile velocity. At least 1, because 0 would prevent any motion.
fn speed(scale: &Scale, velocity: f64) -> u32 {
    let RawVelocity(raw) = scale.velocity_to_raw(UserVelocity(velocity));
    raw.unsigned_abs().max(1)
}

fn acceleration(scale: &Scale, acceleration: f64) -> u32 {
    let RawAcceleration(raw) = scale.acceleration_to_raw(UserAcceleration(acceleration));
    raw.max(1)
}
