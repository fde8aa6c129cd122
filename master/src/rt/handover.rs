//! The only ways into and out of the real-time thread: bounded, wait-free.

use ecaxis_axis::{AxisStatus, Command, Refused};

use super::exchange::Diagnosis;
use super::feed::{FeedState, Start};
use super::groups::GroupStatus;
use super::guard::StopCause;
use super::heartbeat::Heartbeat;
use super::stats::Counters;
use crate::clock::Nanos;

/// Orders that may wait; a batch of them is one order an axis at most.
const ORDERS: usize = 512;
/// Orders taken in one cycle; what was handed over at once is within one batch.
pub const ORDERS_A_CYCLE: usize = 256;
/// Events that may wait; more are counted, not kept.
const EVENTS: usize = 256;

/// To the cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
#[expect(
    clippy::large_enum_variant,
    reason = "a box would have to be freed in the cycle"
)]
pub enum Order {
    Axis {
        axis: usize,
        command: Command,
    },
    /// What an axis is to follow.
    Feed {
        axis: usize,
        start: Start,
    },
    /// An output that no axis drives; an index into [`super::cycle::Signals::outputs`].
    Output {
        output: usize,
        value: f64,
    },
    /// From now on bad cycles are counted, and too many stop the machine.
    Guard,
    /// The segment is about to leave Op: wrong working counters are expected.
    Unguard,
    /// Bring every axis of the machine to rest within its limits, then disable it.
    Stop,
    /// A drive's error code, read beside the cycle.
    ErrorCode {
        axis: usize,
        code: u16,
    },
    /// End the loop after this cycle.
    Halt,
}

/// From the cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Event {
    Refused {
        cycle: u64,
        axis: usize,
        reason: Refused,
    },
    /// The machine begins to stop.
    Stopping {
        cycle: u64,
        cause: StopCause,
    },
    /// A group begins to stop, without the machine.
    GroupStopping {
        cycle: u64,
        group: usize,
        cause: StopCause,
    },
    /// A group that was stopped has been reset, and may be enabled again.
    GroupReleased {
        cycle: u64,
        group: usize,
    },
    PhaseLocked {
        cycle: u64,
    },
    PhaseLost {
        cycle: u64,
    },
    /// The clock of a SubDevice is outside the window around the reference's.
    ClockOff {
        cycle: u64,
        device: usize,
        /// Own minus reference.
        difference_ns: i32,
    },
}

/// The state of the machine after one cycle.
#[derive(Debug, Clone)]
pub struct Snapshot {
    pub time: Nanos,
    pub counters: Counters,
    /// `None` where no distributed clock is used.
    pub phase: Option<PhaseStatus>,
    pub inputs_fresh: bool,
    pub al_status: Option<(u8, u16)>,
    pub axes: Vec<AxisStatus>,
    pub feeds: Vec<FeedState>,
    /// What the program reads, in the order of [`super::cycle::Signals::inputs`]; each of the last cycle in which it was fresh.
    pub inputs: Vec<f64>,
    /// The controller's work is done.
    pub finished: bool,
    pub diagnoses: Vec<Diagnosis>,
    /// First cause, once the machine is stopping.
    pub stopping: Option<StopCause>,
    /// What failed while the machine was stopping because it was asked to.
    pub failure: Option<StopCause>,
    /// Nothing more can be done to stop any axis.
    pub stop_ended: bool,
    /// The first is the rest of the machine.
    pub groups: Vec<GroupStatus>,
    /// Events that did not fit into the queue.
    pub events_lost: u64,
    /// Orders taken so far.
    pub orders_taken: u64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PhaseStatus {
    pub locked: bool,
    pub error_ns: i64,
    pub drift_ppm: f64,
}

/// The real-time end.
#[derive(Debug)]
pub struct RtEnd {
    pub orders: rtrb::Consumer<Order>,
    pub events: rtrb::Producer<Event>,
    pub snapshots: triple_buffer::Input<Snapshot>,
    pub heartbeat: Heartbeat,
}

/// Everybody else's end.
#[derive(Debug)]
pub struct OuterEnd {
    pub orders: rtrb::Producer<Order>,
    pub events: rtrb::Consumer<Event>,
    pub snapshots: triple_buffer::Output<Snapshot>,
    pub heartbeat: Heartbeat,
}

/// Prepares both ends with room for what `first` holds.
#[must_use]
pub fn ends(first: &Snapshot) -> (RtEnd, OuterEnd) {
    let (order_in, order_out) = rtrb::RingBuffer::new(ORDERS);
    let (event_in, event_out) = rtrb::RingBuffer::new(EVENTS);
    let (snapshot_in, snapshot_out) = triple_buffer::triple_buffer(first);
    let heartbeat = Heartbeat::default();
    (
        RtEnd {
            orders: order_out,
            events: event_in,
            snapshots: snapshot_in,
            heartbeat: heartbeat.clone(),
        },
        OuterEnd {
            orders: order_in,
            events: event_out,
            snapshots: snapshot_out,
            heartbeat,
        },
    )
}
