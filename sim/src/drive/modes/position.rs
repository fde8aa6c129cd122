//! Profile position: set-points by handshake, one move after the other.

use super::{Cycle, Motion, PositionFrame};
use crate::drive::objects::float;
use crate::drive::profile::Dynamics;

#[derive(Debug, Clone, Copy, PartialEq)]
struct Move {
    target: i64,
    dynamics: Dynamics,
    /// The axis does not stop there if another target waits.
    passing: bool,
}

/// The active set-point and the waiting one.
#[derive(Debug, Clone)]
pub(super) struct PointToPoint {
    active: Option<Move>,
    next: Option<Move>,
    /// The last accepted target.
    target: i64,
    acknowledged: bool,
    settled_cycles: u32,
}

impl PointToPoint {
    pub(super) fn at(counts: i64) -> Self {
        Self {
            active: None,
            next: None,
            target: counts,
            acknowledged: false,
            settled_cycles: 0,
        }
    }

    /// Returns Statusword bit 12. It stays set while the buffer is full, independent of Controlword
    /// bit 4.
    pub(super) fn acknowledged(&self) -> bool {
        self.acknowledged
    }
}

impl Motion {
    /// Runs the handshake of Controlword bit 4 and Statusword bit 12, also while the axis is
    /// halted.
    pub(super) fn take_set_point(&mut self, cycle: &Cycle, frame: &PositionFrame) {
        let full = self.point_to_point.next.is_some();
        if cycle.start && (!full || cycle.set_points.change_at_once()) {
            self.accept(cycle, frame);
        }
        if !cycle.set_points.starts() && self.point_to_point.next.is_none() {
            self.point_to_point.acknowledged = false;
        }
    }

    pub(super) fn profile_position(&mut self, cycle: &Cycle) {
        let p = cycle.parameters;
        let Some(active) = self.point_to_point.active else {
            self.profile
                .ramp(0.0, p.profile.acceleration, p.profile.deceleration);
            self.reached |= self.profile.velocity == 0.0;
            return;
        };
        let target = float(active.target);
        if let Some(next) = self.point_to_point.next.filter(|_| active.passing) {
            if self.pass(target, &active.dynamics) {
                self.point_to_point.next = None;
                self.point_to_point.active = Some(next);
            }
            return;
        }
        if !self.profile.approach(target, &active.dynamics) {
            self.point_to_point.settled_cycles = 0;
            self.reached = false;
            return;
        }
        let buffer = &mut self.point_to_point;
        let settled = match p.position_window {
            None => true,
            Some(window) => {
                let inside = (target - float(cycle.counts)).abs() <= window;
                buffer.settled_cycles = if inside {
                    buffer.settled_cycles.saturating_add(1)
                } else {
                    0
                };
                inside && buffer.settled_cycles > p.position_window_time
            }
        };
        match buffer.next.take() {
            Some(next) => {
                buffer.active = Some(next);
                self.reached = false;
            }
            None if settled => {
                buffer.active = None;
                self.reached = true;
            }
            None => {}
        }
    }

    /// Moves towards a target at full speed. True once it is passed.
    fn pass(&mut self, target: f64, dynamics: &Dynamics) -> bool {
        let way = (target - self.profile.position).signum();
        self.profile.ramp(
            way * dynamics.velocity,
            dynamics.acceleration,
            dynamics.deceleration,
        );
        (target - self.profile.position) * way <= 0.0
    }

    fn accept(&mut self, cycle: &Cycle, frame: &PositionFrame) {
        let (p, set) = (cycle.parameters, cycle.set_points);
        let last = self.point_to_point.target;
        let target = if set.relative() {
            last + set.position
        } else {
            last + frame.way(frame.show(last), set.position)
        };
        let within = match p.software_limits {
            Some((min, max)) => target.clamp(min - frame.shift, max - frame.shift),
            None => target,
        };
        self.cut = within != target;
        let accepted = Move {
            target: within,
            dynamics: p.profile,
            passing: false,
        };
        let buffer = &mut self.point_to_point;
        buffer.acknowledged = true;
        buffer.target = within;
        buffer.settled_cycles = 0;
        match &mut buffer.active {
            Some(active) if !set.change_at_once() => {
                active.passing = set.change_on_set_point();
                buffer.next = Some(accepted);
            }
            active => {
                *active = Some(accepted);
                buffer.next = None;
                self.reached = false;
            }
        }
    }
}
