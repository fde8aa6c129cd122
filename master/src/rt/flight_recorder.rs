//! The state of the last cycles, with every axis. The ring has a fixed size and freezes soon after
//! a stop, so that the cycles around the stop can be analysed.

use ecaxis_axis::AxisStatus;
use serde::Serialize;

use super::exchange::CycleResult;
use crate::clock::Nanos;

/// Capacity in cycles.
pub const KEPT: usize = 200;
/// The number of cycles recorded from the stop on.
pub const AFTER: u32 = 50;
/// Events earlier than this before a stop are unrelated to it.
pub const WINDOW: Nanos = 1_000_000_000;
/// The snapshot of the error counters is one to two of these windows older than the stop.
pub const COUNTER_WINDOW: Nanos = 250_000_000;

/// One cycle.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Cycle {
    pub number: u64,
    /// Due time of the cycle.
    pub time: Nanos,
    /// Wake-up lateness.
    pub late: Nanos,
    /// True if every frame came back.
    pub complete: bool,
    /// Sums of the working counters seen and of those expected.
    pub wkc: (u16, u16),
    /// AL status of all SubDevices, or-ed, and the number of answers.
    pub al_status: Option<(u8, u16)>,
    /// Phase error against SYNC0, ns.
    pub phase_error: i64,
}

impl Cycle {
    #[must_use]
    pub fn new(
        number: u64,
        time: Nanos,
        late: Nanos,
        answer: &CycleResult,
        phase_error: i64,
    ) -> Self {
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
    /// Modes of operation (0x6060).
    pub mode: i8,
    /// True if the axis' inputs are from this cycle.
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

/// The event around which the ring freezes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Trigger {
    /// A requested stop.
    Requested,
    /// A failure.
    Failure,
}

/// The ring.
#[derive(Debug, Clone, Default)]
pub struct FlightRecorder {
    cycles: Box<[Cycle]>,
    /// The axes of the first cycle, then those of the second, and so on.
    axes: Box<[AxisCycle]>,
    axis_count: usize,
    /// The number of cycles ever recorded.
    made: u64,
    anchor: Option<(Trigger, u32)>,
}

impl FlightRecorder {
    #[must_use]
    #[allow(
        clippy::disallowed_macros,
        clippy::disallowed_methods,
        reason = "runs before the loop"
    )]
    pub fn new(axes: usize) -> Self {
        // Written here, so that no page of it faults in a cycle.
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

    /// Records one cycle. RT: O(axes).
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

    /// Starts the freeze: recording ends [`AFTER`] cycles from now. A failure overrides a requested
    /// stop; otherwise the first trigger counts. RT: O(1).
    pub fn stopping(&mut self, why: Trigger) {
        if self.anchor.is_none_or(|(before, _)| before < why) {
            self.anchor = Some((why, AFTER));
        }
    }

    /// Returns the recorded cycles with their axes, oldest first.
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

    fn keep(history: &mut FlightRecorder, numbers: std::ops::Range<u64>) {
        for number in numbers {
            let cycle = Cycle {
                number,
                ..Cycle::default()
            };
            history.keep(cycle, std::iter::empty());
        }
    }

    fn numbers(history: &FlightRecorder) -> (u64, u64, usize) {
        let all: Vec<u64> = history.cycles().map(|(cycle, _)| cycle.number).collect();
        assert!(all.is_sorted());
        (all[0], all[all.len() - 1], all.len())
    }

    #[test]
    fn flight_recorder_keeps_cycles_around_a_failure() {
        let mut history = FlightRecorder::new(0);
        keep(&mut history, 0..1000);
        history.stopping(Trigger::Failure);
        keep(&mut history, 1000..2000);
        // Later triggers are consequences.
        history.stopping(Trigger::Failure);
        history.stopping(Trigger::Requested);
        keep(&mut history, 2000..3000);
        assert_eq!(numbers(&history), (850, 1049, KEPT));
    }

    #[test]
    fn failure_overrides_requested_stop() {
        let mut history = FlightRecorder::new(0);
        keep(&mut history, 0..1000);
        history.stopping(Trigger::Requested);
        keep(&mut history, 1000..1300);
        assert_eq!(numbers(&history), (850, 1049, KEPT));
        history.stopping(Trigger::Failure);
        keep(&mut history, 1300..1400);
        // The cycles before the failure, then those after it.
        assert_eq!(numbers(&history), (900, 1349, KEPT));
    }

    #[test]
    fn flight_recorder_returns_fewer_cycles_than_its_capacity() {
        let mut history = FlightRecorder::new(0);
        assert_eq!(history.cycles().count(), 0);
        keep(&mut history, 5..8);
        assert_eq!(numbers(&history), (5, 7, 3));
    }
}
