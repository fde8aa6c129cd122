//! An axis that follows the set-points of the cyclic area.

use ecaxis_axis::setpoint::{Gear, GearConfig, GearInMode, Master, Motion, Rate, Setpoint};
use ecaxis_axis::{Command, CommandError};
use ecaxis_master::rt::controller::CycleContext;

use super::{AreaStop, FollowedAxis, REGULAR, ROUNDING, motion_of};

/// The kind of a set-point, and its value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Wanted {
    Nothing,
    Position(f64),
    Velocity(f64),
    Torque(f64),
}

impl Wanted {
    pub(super) fn new(kind: u64, bits: u64) -> Result<Self, AreaStop> {
        let value = f64::from_bits(bits);
        let wanted = match kind {
            0 => return Ok(Self::Nothing),
            1 => Self::Position(value),
            2 => Self::Velocity(value),
            3 => Self::Torque(value),
            other => return Err(AreaStop::Kind(other)),
        };
        if value.is_finite() {
            Ok(wanted)
        } else {
            Err(AreaStop::NotFinite)
        }
    }

    pub(super) fn same_kind(self, other: Self) -> bool {
        std::mem::discriminant(&self) == std::mem::discriminant(&other)
    }
}

/// An axis that follows set-points of a client.
#[derive(Debug, Clone, Copy)]
pub(super) struct Follower {
    /// The last set-point of the cyclic area.
    pub(super) last: Wanted,
    /// The set-points of the client: the last position and its velocity.
    pub(super) path: Motion,
    /// Catches up after missing set-points or lost frames.
    pub(super) gear: Option<Gear>,
    /// Cycles in which the gear was engaged since the last irregular set.
    pub(super) regular: u32,
    /// The last accepted set-point of the axis.
    pub(super) commanded: f64,
}

impl Follower {
    pub(super) fn new(path: Motion) -> Self {
        Self {
            last: Wanted::Nothing,
            path,
            gear: None,
            regular: 0,
            commanded: path.position,
        }
    }

    /// Gives the axis a new set-point of the client, `steps` cycles after the one before.
    pub(super) fn apply(
        &mut self,
        axis: &FollowedAxis,
        wanted: Wanted,
        steps: u32,
        machine: &mut CycleContext<'_>,
    ) -> Result<(), AreaStop> {
        let previous = std::mem::replace(&mut self.last, wanted);
        let command = match wanted {
            Wanted::Nothing => return Ok(()),
            Wanted::Position(position) => {
                let (at, dt_s) = (motion_of(&machine.axis(axis.axis)), machine.dt_s());
                if steps > 1 {
                    self.catch_up(axis, at);
                }
                if self.gear.is_some() {
                    self.check_after_gap(axis, previous, position, f64::from(steps) * dt_s)?;
                }
                let from = match previous {
                    Wanted::Position(from) => from,
                    _ => at.position,
                };
                let velocity = (position - from) / (f64::from(steps) * dt_s);
                self.path = self.path.then(position, velocity, dt_s);
                return self.follow(axis, at, machine);
            }
            Wanted::Velocity(velocity) => Command::Velocity {
                velocity,
                ramp: 1.0,
            },
            Wanted::Torque(percent) => Command::Torque {
                percent,
                ramp_s: 0.0,
            },
        };
        if previous == wanted {
            return Ok(());
        }
        machine
            .command(axis.axis, command)
            .map_err(AreaStop::Refused)
    }

    /// Checks a position that does not follow the one before in the next cycle: the axis catches up
    /// within its limits, so it would reach any position.
    fn check_after_gap(
        &self,
        axis: &FollowedAxis,
        previous: Wanted,
        position: f64,
        time_s: f64,
    ) -> Result<(), AreaStop> {
        let Wanted::Position(from) = previous else {
            return Ok(());
        };
        let (step, most) = (position - from, axis.limits.velocity * time_s);
        if step.abs() > most * ROUNDING {
            return Err(AreaStop::Refused(CommandError::Step { step, most }));
        }
        match axis.range {
            Some([low, high]) if !(low..=high).contains(&position) => {
                Err(AreaStop::Refused(CommandError::OutsideRange {
                    position,
                    low,
                    high,
                }))
            }
            _ => Ok(()),
        }
    }

    /// Continues a position at its last velocity. A velocity or torque needs nothing.
    pub(super) fn extrapolate(
        &mut self,
        axis: &FollowedAxis,
        machine: &mut CycleContext<'_>,
    ) -> Result<(), AreaStop> {
        if !matches!(self.last, Wanted::Position(_)) {
            return Ok(());
        }
        let (path, dt_s) = (self.path, machine.dt_s());
        let at = motion_of(&machine.axis(axis.axis));
        let mut position = path.position + path.velocity * dt_s;
        if let Some([low, high]) = axis.range {
            // Not `clamp`: it panics if a bound is NaN.
            position = position.max(low).min(high);
        }
        let velocity = (position - path.position) / dt_s;
        self.path = path.then(position, velocity, dt_s);
        // The next set-point of the client may need some cycles to be reached.
        self.catch_up(axis, at);
        self.follow(axis, at, machine)
    }

    pub(super) fn catch_up(&mut self, axis: &FollowedAxis, at: Motion) {
        self.regular = 0;
        if self.gear.is_none() {
            let config = GearConfig {
                ratio: 1.0,
                engage: GearInMode::At { offset: 0.0 },
                smoothing_s: 0.0,
                limits: axis.limits,
                range: axis.range,
            };
            self.gear = Gear::new(config, self.path, at).ok();
        }
    }

    pub(super) fn follow(
        &mut self,
        axis: &FollowedAxis,
        at: Motion,
        machine: &mut CycleContext<'_>,
    ) -> Result<(), AreaStop> {
        // Without frames, the axis may not have followed.
        if at.position != self.commanded {
            self.catch_up(axis, at);
        }
        let position = match &mut self.gear {
            None => self.path.position,
            Some(gear) => {
                let master = Master {
                    motion: self.path,
                    comes_to_rest: false,
                };
                // A held axis refuses the set-point.
                let mut following = gear.with_master(master);
                let next = following.advance(at, Rate::WHOLE, machine.dt_s());
                self.regular += u32::from(gear.engaged());
                // The velocity of the set-points is regular again, too.
                if gear.engaged() && self.regular >= REGULAR {
                    self.gear = None;
                }
                next.position
            }
        };
        match machine.set_point(axis.axis, position) {
            Ok(()) => {
                self.commanded = position;
                Ok(())
            }
            Err(CommandError::FramesLost) => {
                self.catch_up(axis, at);
                Ok(())
            }
            Err(error) => Err(AreaStop::Refused(error)),
        }
    }
}
