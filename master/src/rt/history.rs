//! The last cycles as they were, every axis in each: a ring of fixed size that stands still soon after a stop, so that
//! what happened around it can be looked at in peace.

use ecaxis_axis::AxisStatus;
use serde::Serialize;

use super::exchange::Answer;
use crate::clock::Nanos;

/// Cycles that are kept.
pub const KEPT: usize = 200;
/// So many of them are from the stop on.
pub const AFTER: u32 = 50;
/// What happened longer before a stop has nothing to do with it.
pub const WINDOW: Nanos = 1_000_000_000;
/// Error counters are kept as they were one to two of these before a stop.
pub const COUNTER_WINDOW: Nanos = 250_000_000;

/// One cycle.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Cycle {
    pub number: u64,
    /// When it was due.
    pub time: Nanos,
    /// How late the thread woke up.
    pub late: Nanos,
    /// Every frame came back.
    pub complete: bool,
    /// Sum of the working counters seen, of those expected.
    pub wkc: (u16, u16),
    /// AL status of all SubDevices or-ed together, and how many answered.
    pub al_status: Option<(u8, u16)>,
    /// Against SYNC0, nanoseconds.
    pub phase_error: i64,
}

impl Cycle {
    #[must_use]
    pub fn new(number: u64, time: Nanos, late: Nanos, answer: &Answer, phase_error: i64) -> Self {
        Self {
            number,
            time,
            late,
            complete: answer.complete,
            wkc: answer.wkc,
            al_status: answer.al_status,
            phase_error,
        }
    }
}

/// One axis in one cycle, in user units.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct AxisCycle {
    pub statusword: u16,
    pub controlword: u16,
    /// 0x6060.
    pub mode: i8,
    /// Its inputs are of this cycle.
    pub fresh: bool,
    pub target_position: f64,
    pub position: f64,
    pub following_error: f64,
    pub target_velocity: f64,
    pub velocity: f64,
    /// Percent of rated torque.
    pub torque: f64,
}

impl From<&AxisStatus> for AxisCycle {
    fn from(status: &AxisStatus) -> Self {
        Self {
            statusword: status.statusword,
            controlword: status.controlword,
            mode: status.mode.code(),
            fresh: status.stale_cycles == 0,
            target_position: status.target_position,
            position: status.position,
            following_error: status.following_error,
            target_velocity: status.target_velocity,
            velocity: status.velocity,
            torque: status.torque,
        }
    }
}

/// Around what the ring is to stand still.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Anchor {
    /// A stop that was asked for.
    Requested,
    /// A failure.
    Failure,
}

/// The ring.
#[derive(Debug, Clone, Default)]
pub struct History {
    cycles: Box<[Cycle]>,
    /// Those of the first cycle's axes, then those of the second …
    axes: Box<[AxisCycle]>,
    axis_count: usize,
    /// Cycles ever kept.
    made: u64,
    anchor: Option<(Anchor, u32)>,
}

impl History {
    #[must_use]
    #[allow(
        clippy::disallowed_macros,
        clippy::disallowed_methods,
        reason = "prepares"
    )]
    pub fn new(axes: usize) -> Self {
        // Written to, so that no page of it is met for the first time in a cycle.
        let written = AxisCycle {
            mode: -1,
            ..AxisCycle::default()
        };
        let cycle = Cycle {
            number: u64::MAX,
            ..Cycle::default()
        };
        Self {
            cycles: vec![cycle; KEPT].into_boxed_slice(),
            axes: vec![written; KEPT * axes].into_boxed_slice(),
            axis_count: axes,
            made: 0,
            anchor: None,
        }
    }

    /// RT: O(axes).
    pub fn keep<'a>(&mut self, cycle: Cycle, axes: impl Iterator<Item = &'a AxisStatus>) {
        match &mut self.anchor {
            Some((_, 0)) => return,
            Some((_, left)) => *left -= 1,
            None => {}
        }
        let place = (self.made % KEPT as u64) as usize;
        let Some(to) = self.cycles.get_mut(place) else {
            return;
        };
        *to = cycle;
        let first = place * self.axis_count;
        let room = self.axes.get_mut(first..first + self.axis_count);
        for (to, status) in room.into_iter().flatten().zip(axes) {
            *to = status.into();
        }
        self.made += 1;
    }

    /// A stop has begun: it stands still [`AFTER`] cycles from now. A failure outweighs a stop that was asked for; apart from that
    /// the first one counts. RT: O(1).
    pub fn stopping(&mut self, why: Anchor) {
        if self.anchor.is_none_or(|(before, _)| before < why) {
            self.anchor = Some((why, AFTER));
        }
    }

    /// Those kept, oldest first, with their axes.
    pub fn cycles(&self) -> impl Iterator<Item = (&Cycle, &[AxisCycle])> {
        let kept = self.made.min(KEPT as u64);
        (self.made - kept..self.made).filter_map(|n| {
            let place = (n % KEPT as u64) as usize;
            let first = place * self.axis_count;
            let axes = self.axes.get(first..first + self.axis_count)?;
            Some((self.cycles.get(place)?, axes))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn keep(history: &mut History, numbers: std::ops::Range<u64>) {
        for number in numbers {
            let cycle = Cycle {
                number,
                ..Cycle::default()
            };
            history.keep(cycle, std::iter::empty());
        }
    }

    fn numbers(history: &History) -> (u64, u64, usize) {
        let all: Vec<u64> = history.cycles().map(|(cycle, _)| cycle.number).collect();
        assert!(all.is_sorted());
        (all[0], all[all.len() - 1], all.len())
    }

    #[test]
    fn the_cycles_around_a_failure_are_kept() {
        let mut history = History::new(0);
        keep(&mut history, 0..1000);
        history.stopping(Anchor::Failure);
        keep(&mut history, 1000..2000);
        // A later one is a consequence.
        history.stopping(Anchor::Failure);
        history.stopping(Anchor::Requested);
        keep(&mut history, 2000..3000);
        assert_eq!(numbers(&history), (850, 1049, KEPT));
    }

    #[test]
    fn a_failure_on_the_way_to_rest_outweighs_the_order_to_stop() {
        let mut history = History::new(0);
        keep(&mut history, 0..1000);
        history.stopping(Anchor::Requested);
        keep(&mut history, 1000..1300);
        assert_eq!(numbers(&history), (850, 1049, KEPT));
        history.stopping(Anchor::Failure);
        keep(&mut history, 1300..1400);
        // What was kept before it, then what came with it.
        assert_eq!(numbers(&history), (900, 1349, KEPT));
    }

    #[test]
    fn fewer_than_the_room_for_them() {
        let mut history = History::new(0);
        assert_eq!(history.cycles().count(), 0);
        keep(&mut history, 5..8);
        assert_eq!(numbers(&history), (5, 7, 3));
    }
}
