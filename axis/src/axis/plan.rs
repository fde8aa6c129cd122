//! The plan of an axis: it advances the set-point.

use super::stop::PowerGoal;
use super::{Axis, AxisConfig, ControlledQuantity};
use crate::HomingError;
use crate::cia402::{Mode, ModeStatus};
use crate::position_loop::bounded;
use crate::setpoint::{
    Goal, Hold, JerkLimited, Motion, MotionLimits, MoveRequest, Ramp, Rate, Setpoint,
    SetpointError, Source, Trapezoid, braking_velocity,
};
use crate::status::CommandError;

#[derive(Debug, Clone, Copy, PartialEq)]
#[allow(
    clippy::large_enum_variant,
    reason = "nothing is allocated in the cycle, and a plan is copied only where a command makes it"
)]
pub(super) enum Plan {
    Hold(Hold),
    Move(Trapezoid),
    Jerk(JerkLimited),
    Velocity(Ramp),
    Torque(Ramp),
    /// A profile of the drive, or homing.
    DriveProfile,
    /// External set-points, one per cycle; a cycle without one ends the plan.
    External,
}

impl Plan {
    /// Returns the plan that decelerates to rest in `mode`.
    pub(super) fn braking(config: &AxisConfig, mode: Mode) -> Self {
        let slope = config.limits.acceleration;
        match config.control(mode) {
            ControlledQuantity::Position => Self::Hold(Hold {
                acceleration: slope,
            }),
            ControlledQuantity::Velocity => Self::Velocity(Ramp { target: 0.0, slope }),
            ControlledQuantity::Drive => Self::DriveProfile,
            ControlledQuantity::Torque => Self::Torque(Ramp {
                target: 0.0,
                slope: config.torque_slope,
            }),
        }
    }

    /// Returns true if a mode with this controlled quantity can execute the plan.
    pub(super) fn fits(&self, control: ControlledQuantity) -> bool {
        match self {
            Self::Hold(_) | Self::Move(_) | Self::Jerk(_) | Self::External => {
                control == ControlledQuantity::Position
            }
            Self::Velocity(_) => matches!(
                control,
                ControlledQuantity::Position | ControlledQuantity::Velocity
            ),
            Self::Torque(_) | Self::DriveProfile => false,
        }
    }
}

impl Axis {
    /// Returns the commanded quantity. A mode with a position loop also accepts a torque. During a
    /// switch, the position is commanded as soon as the new mode requires it.
    pub(super) fn controlled_quantity(&self) -> ControlledQuantity {
        match self.plan {
            Plan::Torque(_) => return ControlledQuantity::Torque,
            Plan::DriveProfile => return ControlledQuantity::Drive,
            _ => {}
        }
        let now = self.config.control(self.mode);
        let next = self.switch.map(|switch| self.config.control(switch.to));
        if next == Some(ControlledQuantity::Position) {
            ControlledQuantity::Position
        } else {
            now
        }
    }

    /// Returns the actual velocity; 0 within the standstill window.
    pub(super) fn held_velocity(&self) -> f64 {
        if self.at_standstill() {
            0.0
        } else {
            self.actual.velocity()
        }
    }

    /// Returns the previous set-point that matches the reported position at `velocity`, dead time
    /// included. The next advance starts from it.
    pub(super) fn motion_at_actual(&self, velocity: f64) -> Motion {
        let velocity = bounded(velocity, self.config.limits.velocity);
        // The position reported now corresponds to the set-point of this cycle, one dead time
        // later.
        let late_s = self.config.dead_time_s - self.dt_s;
        Motion {
            position: self.actual.position() + velocity * late_s,
            velocity,
            acceleration: 0.0,
        }
    }

    /// Returns the set-point of this cycle that matches the actual motion.
    fn following(&self) -> Motion {
        let before = self.motion_at_actual(self.held_velocity());
        Motion {
            position: before.position + before.velocity * self.dt_s,
            ..before
        }
    }

    /// Returns the actual motion, for plans that do not command one. During a switch it includes
    /// the velocity, for the new mode.
    fn uncommanded(&self) -> Motion {
        if self.switch.is_some() {
            self.following()
        } else {
            Motion::at(self.actual.position())
        }
    }

    /// Returns the motion in progress as a source, for a motion on top of it.
    ///
    /// # Errors
    /// Fails if the axis commands no position, may not move, follows external set-points, or if a
    /// probe is to stop it: external set-points would go on after the edge.
    pub fn source(&self) -> Result<Source, CommandError> {
        self.check_control("a superimposed move", Mode::Csp, |c, _| {
            c == ControlledQuantity::Position
        })?;
        self.check_ready()?;
        if self.probes.may_stop() {
            return Err(CommandError::Probing);
        }
        let limits = &self.config.limits;
        Ok(match self.plan {
            Plan::Jerk(source) => Source::JerkLimited(source),
            Plan::Move(trapezoid) => Source::Trapezoid(trapezoid),
            Plan::Velocity(ramp) => {
                let request = MoveRequest {
                    goal: Goal::Velocity(ramp.target),
                    limits: MotionLimits {
                        acceleration: ramp.slope,
                        ..limits.motion()
                    },
                    ceiling: limits.motion(),
                    range: limits.position,
                };
                Source::JerkLimited(JerkLimited::new(request, self.motion, self.dt_s)?)
            }
            Plan::Hold(hold) => Source::Hold(hold),
            Plan::Torque(_) | Plan::DriveProfile | Plan::External => {
                return Err(CommandError::Following);
            }
        })
    }

    /// Prepares a position or velocity command after a torque: starts from the actual motion and
    /// torque.
    pub(super) fn engage(&mut self) {
        if self.follows() && self.controlled_quantity() == ControlledQuantity::Torque {
            self.motion = self.motion_at_actual(self.held_velocity());
            self.track_play();
            self.loop_state.take_over();
        }
    }

    /// Returns a jerk-limited plan from here. `part`: fraction of acceleration and jerk; more is
    /// used if the motion would otherwise overshoot.
    pub(super) fn jerk_limited(
        &self,
        goal: Goal,
        velocity: f64,
        part: f64,
    ) -> Result<JerkLimited, SetpointError> {
        let limits = &self.config.limits;
        let motion = if self.controlled_quantity() == ControlledQuantity::Torque {
            self.motion_at_actual(self.held_velocity())
        } else {
            self.motion
        };
        let ceiling = MotionLimits {
            velocity: limits.velocity,
            acceleration: limits.acceleration,
            jerk: limits.jerk(),
        };
        let order = MoveRequest {
            goal,
            limits: MotionLimits {
                velocity,
                acceleration: ceiling.acceleration * part,
                jerk: ceiling.jerk * part,
            },
            ceiling,
            range: limits
                .position
                .map(|[low, high]| [low.min(motion.position), high.max(motion.position)]),
        };
        match self.plan {
            Plan::Jerk(ref source) => source.redirect(order, motion, self.dt_s),
            _ => JerkLimited::new(order, motion, self.dt_s),
        }
    }

    /// Decelerates to rest, with any active plan.
    pub(super) fn brake(&mut self) {
        self.home.abort(HomingError::Aborted);
        self.forget_target();
        self.demand_rest();
        self.correction.completes = false;
        let braking = Plan::braking(&self.config, self.mode);
        if braking == Plan::DriveProfile {
            self.profile.halt();
        }
        match braking {
            Plan::Torque(_) => self.loop_state.take_limited(),
            Plan::DriveProfile => {}
            _ => self.engage(),
        }
        self.plan = braking;
    }

    /// Advances the set-point by one cycle. RT: O(1).
    pub(super) fn advance(&mut self, fresh: bool, dt_s: f64) {
        self.resume_after_loss();
        let before = self.motion;
        let grip = self.controlled_quantity();
        self.held_by_range &= matches!(self.plan, Plan::Velocity(_) | Plan::DriveProfile);
        match self.plan {
            // The drive shows the new mode but does not follow in it yet. A stop keeps its set-point.
            _ if grip == ControlledQuantity::Position
                && self.goal == PowerGoal::On
                && self.switch.is_some()
                && !self.follows_now() =>
            {
                self.motion = self.following();
                self.track_play();
            }
            Plan::Hold(hold) => self.motion = hold.brake(before, dt_s),
            Plan::Jerk(ref mut source) => {
                self.motion = source.advance(before, Rate::new(self.rate), dt_s);
            }
            Plan::Move(trapezoid) => {
                let velocity = bounded(trapezoid.velocity * self.rate, self.config.limits.velocity);
                let mut trapezoid = Trapezoid {
                    velocity,
                    ..trapezoid
                };
                // `velocity` has the override.
                self.motion = trapezoid.advance(before, Rate::WHOLE, dt_s);
            }
            Plan::Velocity(ramp) => self.motion = self.run(ramp, before, dt_s),
            Plan::Torque(ramp) => {
                let before = self.loop_state.limited_torque();
                // A held machine is not driven.
                let target = if self.rate == 0.0 { 0.0 } else { ramp.target };
                let ramp = Ramp { target, ..ramp };
                self.loop_state.torque = ramp.advance(self.loop_state.torque, dt_s);
                self.keep_speed(before, fresh, dt_s);
                self.motion = self.uncommanded();
            }
            Plan::DriveProfile => {
                if fresh
                    && let ModeStatus::Pp {
                        target_reached,
                        acknowledged,
                        ..
                    } = self.statusword.in_mode(self.mode)
                {
                    self.profile.set_rate(self.rate);
                    self.profile.step(acknowledged, target_reached, dt_s);
                }
                if fresh {
                    self.halt_inside_range();
                }
                self.motion = self.uncommanded();
            }
            Plan::External => match self.external_setpoint {
                Some(motion) => self.motion = motion,
                None => {
                    // The source has ended, or has lost its way.
                    self.correction.completes = before.velocity == 0.0;
                    let hold = Hold {
                        acceleration: self.config.limits.acceleration,
                    };
                    self.plan = Plan::Hold(hold);
                    self.motion = hold.brake(before, dt_s);
                }
            },
        }
        self.clamp_setpoint(grip, before, dt_s);
        self.take_up(before, true, dt_s);
        self.send_position(grip);
    }

    /// Stores the commanded position in counts; the actual position if no position is commanded.
    pub(super) fn send_position(&mut self, grip: ControlledQuantity) {
        if grip == ControlledQuantity::Velocity {
            self.motion.position = self.reported_load();
        }
        self.update_target(grip);
    }

    /// PV: halts a velocity that leads out of the range, while the drive can still stop inside it.
    fn halt_inside_range(&mut self) {
        let (Mode::Pv, Some(goal), Some([low, high])) =
            (self.mode, self.profile.goal(), self.config.limits.position)
        else {
            return;
        };
        let velocity = self.actual.velocity();
        let late_s = self.config.dead_time_s + 2.0 * self.dt_s;
        // A halt decelerates with the limit acceleration, which 0x6084 then contains.
        let braking = 2.0 * self.config.limits.acceleration;
        let way = velocity * (velocity.abs() / braking + late_s);
        let end = self.actual.position() + way;
        let outwards = goal.target > 0.0 && end >= high || goal.target < 0.0 && end <= low;
        if outwards && self.actual.counts().is_some() {
            self.profile.halt();
        }
        self.held_by_range = outwards;
    }

    /// Returns the ramp with the override.
    pub(super) fn at_rate(&self, ramp: Ramp) -> Ramp {
        Ramp {
            target: bounded(ramp.target * self.rate, self.config.limits.velocity),
            ..ramp
        }
    }

    /// True while the override holds a velocity.
    const fn holds(&self, velocity: f64) -> bool {
        self.rate == 0.0 && velocity != 0.0
    }

    fn run(&mut self, nominal: Ramp, before: Motion, dt_s: f64) -> Motion {
        let [lowest, highest] = self.allowed_by_range();
        let limits = self.config.limits;
        let ramp = self.at_rate(nominal);
        // In CSV the target 0 is also the stop, which is not slower for the jerk.
        let commands_position = self.controlled_quantity() == ControlledQuantity::Position;
        let smooth = self.config.jerk_limited && (commands_position || nominal.target != 0.0);
        let asked = if smooth {
            let velocity = before.velocity;
            let slope = if self.held_by_range {
                // The range decelerates more steeply than the ramp. Continued, this deceleration
                // would pass the target, and turn the axis.
                let left = ramp.target - velocity;
                let most = braking_velocity(left.abs(), limits.jerk(), dt_s);
                let towards = before.acceleration * left.signum();
                towards.max(0.0).min(most) * left.signum()
            } else {
                before.acceleration
            };
            let asked = ramp.advance_smoothly(velocity, slope, limits.jerk(), dt_s);
            // A motion taken over with a steep slope would pass the limit.
            bounded(asked, limits.velocity)
        } else {
            ramp.advance(before.velocity, dt_s)
        };
        // Braking at the end of the range may be steeper than the requested ramp.
        let wanted = asked.min(highest).max(lowest);
        self.held_by_range = wanted != asked || ramp.target > highest || ramp.target < lowest;
        let steepest = Ramp {
            target: wanted,
            slope: limits.acceleration,
        };
        let velocity = steepest.advance(before.velocity, dt_s);
        before.then(before.position + velocity * dt_s, velocity, dt_s)
    }

    /// Returns the velocity of a profile of the drive with the override.
    pub(super) fn profile_velocity(&self, velocity: f64) -> f64 {
        bounded(velocity * self.rate, self.config.limits.velocity)
    }

    /// Returns true if the drive's profile has ended, as far as it reports it.
    fn profile_arrived(&self) -> bool {
        match (self.mode, self.profile.goal()) {
            (Mode::Pp, Some(_)) => !self.profile.pending(),
            (Mode::Pp, None) if self.profile.pending() || self.profile.not_taken() => false,
            (Mode::Pv, Some(goal)) => {
                !self.holds(goal.target)
                    && self.velocity_reached(self.profile_velocity(goal.target))
            }
            _ => !self.home.running() && self.at_standstill(),
        }
    }

    pub(super) fn setpoint_at_rest(&self) -> bool {
        match self.plan {
            Plan::Torque(_) => {
                self.loop_state.torque == 0.0 && self.loop_state.limited_torque() == 0.0
            }
            Plan::DriveProfile => {
                // A drive that changes its mode without power only rests before the switch back.
                let leaves = self.config.mode_change_unpowered && self.home.leaves();
                let homes = self.home.running() && self.mode_cycle.is_none() && !leaves;
                !homes && self.at_standstill()
            }
            _ => self.motion.velocity == 0.0 && self.play_rests(),
        }
    }

    /// Returns true if the set-point has reached its goal.
    pub(super) fn setpoint_arrived(&self) -> bool {
        match self.plan {
            Plan::Hold(hold) => hold.finished(self.motion) && self.play_ended(),
            Plan::Move(trapezoid) => trapezoid.finished(self.motion) && self.play_arrived(),
            Plan::Jerk(ref source) => {
                let moves = matches!(source.request().goal, Goal::Position(_));
                let arrived = if moves {
                    self.play_arrived()
                } else {
                    self.play_rests()
                };
                source.finished(self.motion) && arrived
            }
            Plan::Velocity(ramp) => {
                !self.holds(ramp.target) && self.motion.velocity == self.at_rate(ramp).target
            }
            Plan::Torque(ramp) => self.loop_state.torque == ramp.target,
            Plan::DriveProfile => self.profile_arrived(),
            Plan::External => self.motion.velocity == 0.0 && self.play_ended(),
        }
    }
}
