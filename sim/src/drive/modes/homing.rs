//! Homing, from the method's number to the home position.
//!
//! Every method consists of the same three steps, some of which may be skipped: search a switch or
//! an obstacle, leave it, move to the index pulse. The last position found is home.

use super::{Cycle, Motion, PositionFrame, bit};
use crate::drive::io::input;
use crate::drive::objects::float;
use crate::drive::profile::Dynamics;

/// The reference that ends the search.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum HomingReference {
    Input(u8),
    /// A current above 0x30B2.
    Obstacle,
}

/// The direction of motion, +1 or −1.
type Direction = i8;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Method {
    search: Option<(HomingReference, Direction)>,
    /// The direction away from the reference and to the index pulse. 0: the axis does not move.
    leave: Direction,
    index: bool,
}

/// CiA 402-2, "homing method". Negative methods are specific to maxon.
pub(in crate::drive) const METHODS: &[i64] =
    &[-4, -3, -2, -1, 1, 2, 7, 11, 17, 18, 23, 27, 33, 34, 35, 37];

fn method(code: i64) -> Option<Method> {
    use HomingReference::{Input, Obstacle};
    let (search, leave, index) = match code {
        -4 => (Some((Obstacle, -1)), 1, false),
        -3 => (Some((Obstacle, 1)), -1, false),
        -2 => (Some((Obstacle, -1)), 1, true),
        -1 => (Some((Obstacle, 1)), -1, true),
        1 => (Some((Input(input::NEGATIVE_LIMIT), -1)), 1, true),
        2 => (Some((Input(input::POSITIVE_LIMIT), 1)), -1, true),
        7 => (Some((Input(input::HOME), 1)), -1, true),
        11 => (Some((Input(input::HOME), -1)), 1, true),
        17 => (Some((Input(input::NEGATIVE_LIMIT), -1)), 1, false),
        18 => (Some((Input(input::POSITIVE_LIMIT), 1)), -1, false),
        23 => (Some((Input(input::HOME), 1)), -1, false),
        27 => (Some((Input(input::HOME), -1)), 1, false),
        33 => (None, -1, true),
        34 => (None, 1, true),
        35 | 37 => (None, 0, false),
        _ => return None,
    };
    Some(Method {
        search,
        leave,
        index,
    })
}

#[derive(Debug, Clone, Copy, Default, PartialEq)]
enum Phase {
    /// Not started, or interrupted.
    #[default]
    Idle,
    Search {
        mark: HomingReference,
        way: Direction,
        /// The axis has reversed at a limit switch. A second limit switch is an error.
        turned: bool,
    },
    Leave {
        mark: u8,
        /// The switch was on while the axis was not moving further into it.
        armed: bool,
    },
    Index {
        from: i64,
    },
    /// Home is known. The axis moves there, offset by 0x30B1.
    Travel {
        target: i64,
    },
    Attained,
    Failed,
}

/// Turns without an index pulse until homing fails.
const INDEX_TURNS: i64 = 2;

#[derive(Debug, Clone, Default)]
pub(super) struct Homing {
    phase: Phase,
    method: Option<Method>,
    settled_cycles: u32,
}

impl Homing {
    pub(super) fn runs(&self) -> bool {
        !matches!(self.phase, Phase::Idle | Phase::Attained | Phase::Failed)
    }

    /// Returns the status that remains after another function takes over the axis.
    pub(super) fn interrupted(&self) -> Self {
        match self.phase {
            Phase::Attained | Phase::Failed => self.clone(),
            _ => Self::default(),
        }
    }

    pub(super) fn fail(&mut self) {
        if self.runs() {
            self.phase = Phase::Failed;
        }
    }

    /// Returns Statusword bits 10, 12 and 13 (CiA 402-2, "definition of bit 10, 12 and 13" of
    /// homing mode). A halt interrupts homing.
    pub(super) fn bits(&self, stands: bool, halted: bool) -> u16 {
        let resting = if stands { bit::TARGET_REACHED } else { 0 };
        match self.phase {
            Phase::Idle => resting,
            _ if halted && self.runs() => resting,
            Phase::Attained => bit::MODE_12 | bit::TARGET_REACHED,
            Phase::Failed => bit::MODE_13 | resting,
            _ => 0,
        }
    }
}

impl Motion {
    /// Starts homing on a rising edge of Controlword bit 4.
    pub(super) fn begin_homing(&mut self, cycle: &Cycle, frame: &mut PositionFrame) {
        let method = method(cycle.homing.method);
        self.referenced = false;
        self.homing = Homing {
            method,
            ..Homing::default()
        };
        self.homing.phase = match method {
            None => Phase::Failed,
            Some(Method {
                search: Some((mark, way)),
                ..
            }) => Phase::Search {
                mark,
                way,
                turned: false,
            },
            Some(Method { leave: 0, .. }) => {
                self.take_as_home(cycle.counts, cycle, frame);
                Phase::Attained
            }
            Some(_) => Phase::Index { from: cycle.counts },
        };
    }

    /// Runs one control cycle of homing mode: moves the profile.
    pub(super) fn home(&mut self, cycle: &Cycle, frame: &mut PositionFrame) {
        if !cycle.set_points.starts() && self.homing.runs() {
            self.homing = Homing::default();
        }
        let h = cycle.homing;
        let limit = cycle.parameters.max_profile_speed;
        let (search, zero) = (h.search_speed.min(limit), h.zero_speed.min(limit));
        let leave = self.homing.method.map_or(0, |method| method.leave);
        let speed = match self.homing.phase {
            Phase::Search { way, .. } => f64::from(way) * search,
            Phase::Leave { .. } | Phase::Index { .. } => f64::from(leave) * zero,
            Phase::Travel { target } => {
                let dynamics = Dynamics {
                    velocity: search,
                    acceleration: h.acceleration,
                    deceleration: h.acceleration,
                };
                if self.profile.approach(float(target), &dynamics) {
                    self.settle_at_home(target, cycle);
                }
                return;
            }
            Phase::Idle | Phase::Attained | Phase::Failed => 0.0,
        };
        self.profile.ramp(speed, h.acceleration, h.acceleration);
        self.look_for_home(leave, cycle, frame);
    }

    fn look_for_home(&mut self, leave: Direction, cycle: &Cycle, frame: &mut PositionFrame) {
        let inputs = cycle.inputs;
        let index = self.homing.method.is_some_and(|method| method.index);
        let counts = cycle.counts;
        match self.homing.phase {
            Phase::Search { mark, way, turned } => {
                let there = match mark {
                    HomingReference::Input(bit) => inputs.is_on(bit),
                    HomingReference::Obstacle => {
                        cycle.current.abs() >= cycle.homing.current_threshold
                    }
                };
                if there {
                    match mark {
                        HomingReference::Input(mark) => {
                            self.homing.phase = Phase::Leave { mark, armed: false };
                        }
                        HomingReference::Obstacle if index => {
                            self.homing.phase = Phase::Index { from: counts };
                        }
                        HomingReference::Obstacle => self.found(counts, cycle, frame),
                    }
                } else if cycle.at_limit(way) {
                    self.homing.phase = if turned || mark != HomingReference::Input(input::HOME) {
                        Phase::Failed
                    } else {
                        Phase::Search {
                            mark,
                            way: -way,
                            turned: true,
                        }
                    };
                }
            }
            Phase::Leave { mark, armed } => {
                let on = inputs.is_on(mark);
                let inwards = self.profile.velocity * f64::from(leave) < 0.0;
                if armed && !on {
                    if index {
                        self.homing.phase = Phase::Index { from: counts };
                    } else {
                        self.found(counts, cycle, frame);
                    }
                } else if cycle.at_limit(leave) {
                    self.homing.phase = Phase::Failed;
                } else {
                    let armed = on && !inwards;
                    self.homing.phase = Phase::Leave { mark, armed };
                }
            }
            Phase::Index { from } => {
                let behind = (counts - from) * i64::from(leave) > 0;
                match inputs.index_since(from).filter(|_| behind) {
                    Some(index) => self.found(index, cycle, frame),
                    None if cycle.at_limit(leave)
                        || (counts - from).abs() > INDEX_TURNS * inputs.turn() =>
                    {
                        self.homing.phase = Phase::Failed;
                    }
                    None => {}
                }
            }
            Phase::Idle | Phase::Travel { .. } | Phase::Attained | Phase::Failed => {}
        }
    }

    fn found(&mut self, counts: i64, cycle: &Cycle, frame: &mut PositionFrame) {
        let target = counts.saturating_add(cycle.homing.distance);
        self.take_as_home(target, cycle, frame);
        self.homing.phase = Phase::Travel { target };
    }

    fn take_as_home(&mut self, counts: i64, cycle: &Cycle, frame: &mut PositionFrame) {
        frame.shift = cycle.homing.home_position - counts;
        self.referenced = true;
    }

    fn settle_at_home(&mut self, target: i64, cycle: &Cycle) {
        let off = (target - cycle.counts).abs();
        let p = cycle.parameters;
        let inside = p.position_window.is_none_or(|window| float(off) <= window);
        let cycles = &mut self.homing.settled_cycles;
        *cycles = if inside { cycles.saturating_add(1) } else { 0 };
        if *cycles > p.position_window_time {
            self.homing.phase = Phase::Attained;
        }
    }
}

impl Cycle<'_> {
    /// True if the limit switch in that direction is on.
    fn at_limit(&self, way: Direction) -> bool {
        self.inputs.is_on(if way > 0 {
            input::POSITIVE_LIMIT
        } else {
            input::NEGATIVE_LIMIT
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn homing_methods_are_supported_exactly_if_listed() {
        for code in i64::from(i8::MIN)..=i64::from(i8::MAX) {
            assert_eq!(method(code).is_some(), METHODS.contains(&code), "{code}");
        }
    }
}
