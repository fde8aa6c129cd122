//! Gantries: two axes that move as one.
//!
//! The first half has the plan. While the gantry is coupled, the second half takes the set-point of
//! the first in the same cycle, plus a constant offset. The offset is the one at the coupling. If
//! both halves are homed, it is reduced to 0 first: the gantry is squared, at the override of the
//! axes. While they are held, it waits.
//!
//! Both halves always stop by the same method, the harder one of both. The skew is compared with its
//! limit in every cycle, as it is and as it will be when the faster half has stopped.

use ecaxis_axis::setpoint::{Goal, JerkLimited, Motion, MotionLimits, MoveRequest, Rate, Setpoint};
use ecaxis_axis::{
    Axis, AxisConfig, AxisStatus, Command, CommandError, EnableBlocker, HomingError, HomingStatus,
    Mode, State, StopMethod, Trip,
};
use ecaxis_ecat::index::{AxisIndex, IndexVec};

use super::axis::RtAxis;
use super::setpoint_generator::commanded;

/// The settings of a gantry. Positions in user units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GantryConfig {
    /// The first and the second half.
    pub axes: [AxisIndex; 2],
    pub max_skew: f64,
    /// The largest difference of the ways of both halves while they are homed.
    pub max_homing_skew: f64,
}

/// A half that moves by itself during homing.
#[derive(Debug, Clone, Copy, PartialEq)]
struct HomingHalf {
    position: f64,
    /// Cycles since `position` was reported.
    age: u32,
}

#[derive(Debug, Clone, Copy, PartialEq)]
#[allow(
    clippy::large_enum_variant,
    reason = "nothing is allocated in the cycle, and a gantry is not copied"
)]
enum Coupling {
    /// By command: each half moves alone.
    Decoupled,
    /// Couples when both halves are ready and at rest.
    Pending,
    /// The drives search home. `skew` is the difference of the ways so far.
    Homing {
        halves: [HomingHalf; 2],
        skew: f64,
    },
    /// The offset is reduced to 0, or stops on the way.
    Squaring(JerkLimited),
    Coupled,
}

/// The first half and the offset of a second half that follows it in this cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Leader {
    pub axis: AxisIndex,
    offset: Motion,
}

impl Leader {
    /// Returns the set-point of the second half. RT.
    pub(super) fn set_point(&self, first: &AxisStatus) -> Motion {
        let first = commanded(first);
        Motion {
            position: first.position + self.offset.position,
            velocity: first.velocity + self.offset.velocity,
            acceleration: first.acceleration + self.offset.acceleration,
        }
    }
}

/// Two axes that move as one.
#[derive(Debug)]
pub struct Gantry {
    config: GantryConfig,
    coupling: Coupling,
    /// Set-point of the second half minus that of the first.
    offset: Motion,
    /// The difference of positions that counts as skew 0.
    square: f64,
    /// The lower override of both halves.
    rate: Rate,
    /// The halves may be squared: no stop has followed the command that couples them.
    squares: bool,
}

/// The part of the limits with which a gantry is squared.
const SQUARING: f64 = 0.1;

/// The part of the limit that the skew at rest may reach before both halves stop. The rest is for
/// drives that overshoot the end of a stop.
const AT_REST: f64 = 0.9;

impl Gantry {
    #[must_use]
    pub const fn new(config: GantryConfig) -> Self {
        Self {
            config,
            coupling: Coupling::Pending,
            offset: Motion {
                position: 0.0,
                velocity: 0.0,
                acceleration: 0.0,
            },
            square: 0.0,
            rate: Rate::WHOLE,
            squares: false,
        }
    }

    pub(super) const fn axes(&self) -> [AxisIndex; 2] {
        self.config.axes
    }

    /// Couples or decouples the halves, at rest. RT: O(1).
    pub(super) fn couple(
        &mut self,
        [first, second]: [&RtAxis; 2],
        coupled: bool,
    ) -> Result<(), CommandError> {
        let held = |slot: &RtAxis| {
            let status = slot.axis.status();
            let stands = status.target_velocity == 0.0 && !status.moving;
            let homes = matches!(status.homing, HomingStatus::Running);
            (!stands || homes).then_some(CommandError::StillMoving {
                velocity: status.target_velocity,
            })
        };
        let following = first.generator.runs() || second.generator.runs();
        if following {
            return Err(CommandError::Following);
        }
        if let Some(reason) = held(first).or(held(second)) {
            return Err(reason);
        }
        match (self.coupling, coupled) {
            (Coupling::Coupled, true) => {}
            (_, true) => {
                self.coupling = Coupling::Pending;
                self.squares = true;
            }
            (_, false) => self.coupling = Coupling::Decoupled,
        }
        Ok(())
    }

    /// Returns whether a half may start a motion of its own.
    fn check_motion(&self, axis: AxisIndex) -> Result<(), CommandError> {
        match self.coupling {
            Coupling::Decoupled => Ok(()),
            _ if axis != self.config.axes[0] => Err(CommandError::SecondHalf),
            Coupling::Coupled => Ok(()),
            _ => Err(CommandError::NotCoupled),
        }
    }

    /// Gives a command to one half or to both. RT: O(1).
    fn command(
        &mut self,
        [first, second]: [&mut RtAxis; 2],
        axis: AxisIndex,
        command: Command,
    ) -> Result<(), CommandError> {
        let own = if axis == self.config.axes[0] {
            &mut *first
        } else {
            &mut *second
        };
        if matches!(self.coupling, Coupling::Decoupled) {
            return own.command(command);
        }
        match command {
            Command::ArmProbe { stop: false, .. } | Command::DisarmProbe { .. } => {
                own.command(command)
            }
            Command::SetMode(Mode::Csp) => own.command(command),
            Command::SetMode(_) => Err(CommandError::Coupled),
            Command::Enable => {
                second.check(command)?;
                first.command(command)?;
                second.command(command)?;
                // Continues a squaring that was stopped.
                self.squares = true;
                Ok(())
            }
            Command::ResetFault
            | Command::Disable
            | Command::QuickStop
            | Command::EmergencyStop
            | Command::DisableVoltage => {
                let result = first.command(command);
                result.and(second.command(command))
            }
            Command::Stop | Command::HoldHoming => {
                self.squares &= command != Command::Stop;
                let result = first.command(command);
                result.and(second.command(command))
            }
            Command::Home { .. } => {
                self.check_motion(axis)?;
                second.check(command)?;
                first.command(command)?;
                second.command(command)?;
                self.squares = true;
                let halves = [&*first, &*second].map(|half| HomingHalf {
                    position: half.axis.status().position,
                    age: 0,
                });
                self.coupling = Coupling::Homing { halves, skew: 0.0 };
                Ok(())
            }
            Command::ArmProbe { .. }
            | Command::MoveTo { .. }
            | Command::MoveBy { .. }
            | Command::Velocity { .. }
            | Command::Torque { .. } => {
                self.check_motion(axis)?;
                own.command(command)
            }
        }
    }

    /// Advances the coupling, stops both halves by the same method and supervises the skew. Call it
    /// after the commands and before the axes act. RT: O(1).
    pub(super) fn update(&mut self, [first, second]: [&mut RtAxis; 2], dt_s: f64) {
        second.leader = None;
        self.rate = first.rates.own.min(second.rates.own).min(Rate::WHOLE);
        let status = [first.axis.status(), second.axis.status()];
        let [a, b] = &status;
        if let Coupling::Squaring(_) | Coupling::Coupled = self.coupling
            && !a.enabled
            && !b.enabled
        {
            self.coupling = Coupling::Pending;
        }
        match &mut self.coupling {
            Coupling::Decoupled => {
                first.axis.share_range(None);
                return;
            }
            Coupling::Pending if can_couple(a) && can_couple(b) => {
                if let Err(trip) = self.begin(&status, first.axis.config().limits.motion(), dt_s) {
                    second.axis.trip_by(trip, StopMethod::Ramp);
                }
            }
            Coupling::Pending => {}
            Coupling::Homing { halves, skew } => {
                *skew += homing_way(&mut halves[1], b, &second.axis, dt_s)
                    - homing_way(&mut halves[0], a, &first.axis, dt_s);
                let runs = |s: &AxisStatus| s.enabled && s.homing == HomingStatus::Running;
                let failed = |s: &AxisStatus| !s.enabled || s.homing.is_failed();
                let limit = self.config.max_homing_skew;
                if skew.abs() > limit {
                    let trip = Trip::HomingSkew { skew: *skew, limit };
                    second.axis.trip_by(trip, StopMethod::QuickStop);
                }
                for (half, other) in [(&mut *first, b), (&mut *second, a)] {
                    if failed(other) && half.axis.status().homing == HomingStatus::Running {
                        let _ = half.command(Command::Stop);
                    }
                }
                if !runs(a) && !runs(b) {
                    self.coupling = Coupling::Pending;
                }
            }
            Coupling::Squaring(_) | Coupling::Coupled => {}
        }
        stop_alike([first, second], &status);
        if matches!(self.coupling, Coupling::Squaring(_) | Coupling::Coupled) {
            self.watch_skew([first, second], &status, dt_s);
            self.lead([first, second], &status, dt_s);
        }
        self.share_range([first, second]);
    }

    /// Limits the plan of the first half to positions at which the second one is in its range too.
    fn share_range(&self, [first, second]: [&mut RtAxis; 2]) {
        let offset = self.offset.position;
        let range = second
            .axis
            .own_range()
            .map(|range| range.map(|end| end - offset));
        let coupled = matches!(self.coupling, Coupling::Coupled);
        first.axis.share_range(range.filter(|_| coupled));
    }

    /// Couples the halves where they are. Fails if they are homed and too far apart.
    fn begin(
        &mut self,
        [a, b]: &[AxisStatus; 2],
        limits: MotionLimits,
        dt_s: f64,
    ) -> Result<(), Trip> {
        let offset = b.target_position - a.target_position;
        let limit = self.config.max_skew;
        self.offset = Motion::at(offset);
        if !(a.homed() && b.homed()) {
            self.square = offset;
            self.coupling = Coupling::Coupled;
            return Ok(());
        }
        self.square = 0.0;
        let order = MoveRequest::within(Goal::Position(0.0), limits.scaled(SQUARING));
        let plan = JerkLimited::new(order, self.offset, dt_s).ok();
        match plan.filter(|_| offset.abs() <= limit) {
            Some(plan) => {
                self.coupling = match offset {
                    0.0 => Coupling::Coupled,
                    _ => Coupling::Squaring(plan),
                };
                Ok(())
            }
            None => Err(Trip::Skew {
                skew: offset,
                at_rest: offset,
                limit,
            }),
        }
    }

    /// Ends a squaring where its offset comes to rest.
    fn stop_squaring(&mut self, limits: MotionLimits, dt_s: f64) {
        let Coupling::Squaring(plan) = &mut self.coupling else {
            return;
        };
        let order = MoveRequest::within(Goal::Velocity(0.0), limits);
        if plan.request().goal == order.goal {
            return;
        }
        // A stop gains no speed.
        let stop = if self.offset.acceleration * self.offset.velocity > 0.0 {
            self.offset.acceleration = 0.0;
            JerkLimited::new(order, self.offset, dt_s)
        } else {
            plan.redirect(order, self.offset, dt_s)
        };
        if let Ok(stop) = stop {
            *plan = stop;
        }
    }

    /// Prepares the set-point of the second half.
    fn lead(&mut self, [first, second]: [&mut RtAxis; 2], status: &[AxisStatus; 2], dt_s: f64) {
        let [a, b] = status;
        let (mut losses, of_second) = (first.axis.losses(), second.axis.losses());
        second.axis.share_losses(losses);
        first.axis.share_losses(of_second);
        losses = first.axis.losses();
        if losses.delay_setpoints() {
            let [a, b] = [a, b].map(commanded);
            self.offset = Motion {
                position: b.position - a.position,
                velocity: b.velocity - a.velocity,
                acceleration: 0.0,
            };
        } else if matches!(self.coupling, Coupling::Squaring(_)) {
            let stops = |half: &RtAxis| half.axis.status().stop.is_some();
            self.squares &= !stops(first) && !stops(second);
            if !self.squares {
                self.stop_squaring(first.axis.config().limits.motion(), dt_s);
            }
            if let Coupling::Squaring(plan) = &mut self.coupling {
                self.offset = plan.advance(self.offset, self.rate, dt_s);
                let ends = plan.request().goal == Goal::Velocity(0.0);
                if self.offset.stands_at(0.0) {
                    self.coupling = Coupling::Coupled;
                } else if self.squares && ends && self.offset.velocity == 0.0 {
                    self.coupling = Coupling::Pending;
                }
            }
        } else {
            // A loss may have left a velocity.
            self.offset = Motion::at(self.offset.position);
        }
        // Without set-points of its own, the first half shows where it is: perhaps a load that falls.
        let leads = a.enabled && a.state == State::OperationEnabled;
        second.leader = leads.then_some(Leader {
            axis: self.config.axes[0],
            offset: self.offset,
        });
    }

    /// Stops both halves if their skew exceeds its limit, or will. The half that is farther from its
    /// set-point is the cause.
    fn watch_skew(&self, [first, second]: [&mut RtAxis; 2], status: &[AxisStatus; 2], dt_s: f64) {
        let [a, b] = status;
        if a.stale_cycles + b.stale_cycles > 0 {
            return;
        }
        let limit = self.config.max_skew;
        let skew = b.position - a.position - self.square;
        let parting = b.velocity - a.velocity;
        let at_rest = skew + stopping_way(first.axis.config(), parting, dt_s);
        let parts = at_rest.abs() > limit * AT_REST && at_rest.abs() > skew.abs();
        if skew.abs() <= limit && !parts {
            return;
        }
        let cause = if a.following_error.abs() > b.following_error.abs() {
            &mut first.axis
        } else {
            &mut second.axis
        };
        let method = if skew.abs() > limit {
            StopMethod::QuickStop
        } else {
            StopMethod::Ramp
        };
        if a.trip.is_none() && b.trip.is_none() && a.fault.is_none() && b.fault.is_none() {
            cause.trip_by(
                Trip::Skew {
                    skew,
                    at_rest,
                    limit,
                },
                method,
            );
        }
        first.stop_by(method);
        second.stop_by(method);
    }

    /// Shows the state of the gantry in the status of its first half. RT: O(1).
    pub(super) fn publish(&self, axes: &mut [AxisStatus]) {
        let [AxisIndex(first), AxisIndex(second)] = self.config.axes;
        let (Some(second), Some(status)) = (axes.get(second).copied(), axes.get_mut(first)) else {
            return;
        };
        let busy = match &self.coupling {
            Coupling::Decoupled => return,
            Coupling::Coupled => false,
            _ => true,
        };
        status.ready &= !busy && second.ready;
        let squares = match &self.coupling {
            Coupling::Squaring(plan) => {
                self.offset.velocity != 0.0 || plan.request().goal != Goal::Velocity(0.0)
            }
            _ => false,
        };
        status.moving |= squares;
        if squares && self.rate.is_held() {
            status.waiting = Some(EnableBlocker::Held);
        }
        // A second half is not in a target of its own while the gantry has a velocity.
        status.in_target &= !status.moving;
        status.in_target &= status.target_velocity != 0.0 || second.in_target;
        status.at_rest &= second.at_rest;
        if status.homed() {
            status.validity = second.validity;
        }
        // The other half is aborted as a consequence.
        let cause = |homing: &HomingStatus| {
            homing.is_failed() && *homing != HomingStatus::Failed(HomingError::Aborted)
        };
        let both = [status.homing, second.homing];
        let failed = both.into_iter().find(cause);
        status.homing = match failed.or(both.into_iter().find(HomingStatus::is_failed)) {
            Some(failed) => failed,
            None if status.homing == HomingStatus::Attained && busy && status.enabled => {
                HomingStatus::Running
            }
            None => status.homing,
        };
    }
}

/// Gives a command to an axis, or to both halves of its gantry. RT: O(gantries).
pub(super) fn command(
    axes: &mut IndexVec<AxisIndex, RtAxis>,
    gantries: &mut [Gantry],
    axis: AxisIndex,
    command: Command,
) -> Result<(), CommandError> {
    if let Some(gantry) = of_axis(gantries, axis)
        && let Some(halves) = halves(axes, gantry.config.axes)
    {
        return gantry.command(halves, axis, command);
    }
    axes.get_mut(axis)
        .map_or(Ok(()), |slot| slot.command(command))
}

/// Returns whether a half of a gantry may start a motion of its own. RT: O(gantries).
pub(super) fn check_motion(gantries: &[Gantry], axis: AxisIndex) -> Result<(), CommandError> {
    let gantry = gantries.iter().find(|g| g.config.axes.contains(&axis));
    gantry.map_or(Ok(()), |gantry| gantry.check_motion(axis))
}

fn of_axis(gantries: &mut [Gantry], axis: AxisIndex) -> Option<&mut Gantry> {
    gantries.iter_mut().find(|g| g.config.axes.contains(&axis))
}

/// Returns both halves for changes.
pub(super) fn halves(
    axes: &mut IndexVec<AxisIndex, RtAxis>,
    both: [AxisIndex; 2],
) -> Option<[&mut RtAxis; 2]> {
    axes.get_disjoint_mut(both.map(|AxisIndex(n)| n)).ok()
}

/// True if an axis stands with power and without a motion, so that it can be coupled.
fn can_couple(status: &AxisStatus) -> bool {
    status.ready
        && status.mode == Mode::Csp
        && status.switching.is_none()
        && status.homing != HomingStatus::Running
        && status.target_velocity == 0.0
        && status.at_rest
}

/// Stops each half by the method of the other. A half that moves without the other, which has lost
/// its power, stops by quick stop.
fn stop_alike([first, second]: [&mut RtAxis; 2], [a, b]: &[AxisStatus; 2]) {
    let ended = [second.power.has_ended(), first.power.has_ended()];
    for ((half, own, other), ended) in [(first, a, b), (second, b, a)].into_iter().zip(ended) {
        // A half has no cause of its own: without one of the other half, its loss of power fails
        // the machine.
        if ended {
            half.power.end();
        }
        if !own.powered {
            continue;
        }
        if let Some(stop) = other.stop {
            half.stop_by(stop.method);
        } else if !other.powered && !own.at_rest {
            let explained = own.stop.is_some() || other.trip.is_some() || other.fault.is_some();
            if !explained {
                let velocity = own.velocity;
                half.axis
                    .trip_by(Trip::HalfMoves { velocity }, StopMethod::QuickStop);
            }
            half.stop_by(StopMethod::QuickStop);
        }
    }
}

/// Returns the highest velocity from which one half stops before the skew reaches its limit, if the
/// other half is blocked.
#[must_use]
pub fn safe_velocity(config: &AxisConfig, max_skew: f64, dt_s: f64) -> f64 {
    let (mut low, mut high) = (0.0, config.limits.velocity);
    if stopping_way(config, high, dt_s) <= max_skew * AT_REST {
        return high;
    }
    for _ in 0..60 {
        let middle = f64::midpoint(low, high);
        if stopping_way(config, middle, dt_s) <= max_skew * AT_REST {
            low = middle;
        } else {
            high = middle;
        }
    }
    low
}

/// Returns the way by which a relative velocity still changes the skew: until its feedback has an
/// effect, and until a stop within the limits has ended.
fn stopping_way(config: &AxisConfig, velocity: f64, dt_s: f64) -> f64 {
    let MotionLimits {
        acceleration, jerk, ..
    } = config.limits.motion();
    let speed = velocity.abs();
    let time = if !config.jerk_limited {
        speed / acceleration
    } else if speed * jerk >= acceleration * acceleration {
        speed / acceleration + acceleration / jerk
    } else {
        2.0 * (speed / jerk).sqrt()
    };
    velocity * (time / 2.0 + config.dead_time_s + 2.0 * dt_s)
}

/// Returns the way of a half since the last report. The drive sets its position at home: a change
/// that the velocity does not explain is not a way.
fn homing_way(half: &mut HomingHalf, status: &AxisStatus, axis: &Axis, dt_s: f64) -> f64 {
    half.age = half.age.saturating_add(1);
    if status.stale_cycles > 0 {
        return 0.0;
    }
    let way = status.position - half.position;
    let time = dt_s * f64::from(half.age);
    let possible = (2.0 * status.velocity.abs() + 0.02 * axis.config().limits.velocity) * time;
    *half = HomingHalf {
        position: status.position,
        age: 0,
    };
    if way.abs() <= possible { way } else { 0.0 }
}

#[cfg(test)]
#[path = "gantry_tests.rs"]
mod tests;
