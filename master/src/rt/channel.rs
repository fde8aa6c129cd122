//! The only paths into and out of the real-time thread: bounded and wait-free.

use ecaxis_axis::{AxisStatus, Command, CommandError};
use ecaxis_ecat::index::{AxisIndex, DeviceIndex, GroupIndex, IndexVec, LineShaftIndex};

use super::bus_monitor::StopCause;
use super::common_time::CommonTimeStatus;
use super::controller::OutputRef;
use super::cycle::StartState;
use super::exchange::SubDeviceDiagnostics;
use super::gateway::{NodeCommand, NodeState};
use super::heartbeat::Heartbeat;
use super::line_shaft::LineShaftStatus;
use super::reaction_group::GroupStatus;
use super::setpoint_generator::{GeneratorRequest, GeneratorState};
use super::stats::Counters;
use crate::clock::Nanos;

/// Capacity of the command queue; a batch holds at most one command per axis.
const ORDERS: usize = 512;
/// Commands taken per cycle; one batch never exceeds this.
pub const COMMANDS_PER_CYCLE: usize = 256;
/// Capacity of the event queue; events beyond it are counted and dropped.
const EVENTS: usize = 256;

/// A command to the cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
#[expect(
    clippy::large_enum_variant,
    reason = "a box would have to be freed in the cycle"
)]
pub enum RtCommand {
    Axis {
        axis: AxisIndex,
        command: Command,
    },
    /// Starts set-point generation for an axis.
    Generate {
        axis: AxisIndex,
        start: GeneratorRequest,
    },
    /// Sets an output that no axis drives.
    Output {
        output: OutputRef,
        value: f64,
    },
    /// Shifts a follower against its master.
    Shift {
        axis: AxisIndex,
        distance: f64,
        /// Adds the distance to any motion instead.
        superimpose: bool,
    },
    /// Couples the halves of a gantry, or decouples them.
    Couple {
        gantry: usize,
        coupled: bool,
    },
    /// Sets the override of the machine (the first group) or of a group.
    Override {
        group: GroupIndex,
        /// From 0 to [`ecaxis_axis::MAX_RATE`].
        factor: f64,
    },
    /// Holds the machine or a group on its way, or lets it continue.
    Hold {
        group: GroupIndex,
        held: bool,
    },
    /// SYNC0 moves slowly from now on: drives go to Op.
    EnterOp,
    /// Starts the bus monitor: from now on too many bad cycles stop the machine.
    StartBusMonitor,
    /// Stops a group that waits for an optional device.
    Absent {
        group: GroupIndex,
    },
    /// Stops the bus monitor: the segment is about to leave Op, so wrong working counters are
    /// expected.
    StopBusMonitor,
    /// Commands the NMT state of a node behind a gateway. Refused while its axis has power.
    Node {
        gateway: DeviceIndex,
        /// The index of the node in its gateway.
        node: usize,
        command: NodeCommand,
    },
    /// Ends the exchange of process data between gateways and their nodes.
    EndGateways,
    /// Brings every axis of the machine to rest within its limits, then disables it.
    Stop,
    /// Reports a drive's error code that was read outside the cycle.
    ErrorCode {
        axis: AxisIndex,
        code: u16,
    },
    /// The next `count` commands, of the same batch, take effect in the cycle of this instant of
    /// common time.
    Defer {
        at: u64,
        count: usize,
    },
    /// Drops the commands that wait for an instant.
    CancelStart,
    /// Ends the loop after this cycle.
    Halt,
}

/// An event reported by the cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Event {
    Refused {
        cycle: u64,
        axis: AxisIndex,
        reason: CommandError,
    },
    /// A Sercos drive needs the procedure command S-0-0099 to clear its errors.
    ResetDrive {
        cycle: u64,
        axis: AxisIndex,
    },
    /// The machine begins to stop.
    Stopping {
        cycle: u64,
        cause: StopCause,
    },
    /// A group begins to stop; the machine continues.
    GroupStopping {
        cycle: u64,
        group: GroupIndex,
        cause: StopCause,
    },
    /// A stopped group was reset and may be enabled again.
    GroupReleased {
        cycle: u64,
        group: GroupIndex,
    },
    PhaseLocked {
        cycle: u64,
    },
    PhaseLost {
        cycle: u64,
    },
    /// The clock of a SubDevice differs from the reference clock by more than the window.
    ClockOff {
        cycle: u64,
        device: DeviceIndex,
        /// Own clock minus reference.
        difference_ns: i32,
    },
    /// Common time has jumped.
    CommonTimeJumped {
        cycle: u64,
        by_ns: i64,
    },
    /// The reference clock no longer answers; this SubDevice is the reference clock from now on.
    ReferenceReplaced {
        cycle: u64,
        device: DeviceIndex,
    },
}

/// The state of the machine after one cycle.
#[derive(Debug, Clone)]
pub struct Snapshot {
    pub time: Nanos,
    pub counters: Counters,
    /// Wake-ups later than a quarter of the cycle: the drives may miss the target of that cycle.
    pub late_wake_ups: u64,
    /// `None` without distributed clocks.
    pub phase: Option<PhaseStatus>,
    pub common_time: CommonTimeStatus,
    /// What has become of commands for an instant of common time.
    pub start: StartState,
    pub inputs_fresh: bool,
    pub al_status: Option<(u8, u16)>,
    pub axes: IndexVec<AxisIndex, AxisStatus>,
    /// The state of the node of each axis behind a gateway.
    pub nodes: IndexVec<AxisIndex, Option<NodeState>>,
    pub generators: IndexVec<AxisIndex, GeneratorState>,
    pub line_shafts: IndexVec<LineShaftIndex, LineShaftStatus>,
    /// The program's input signals, in the order of [`super::cycle::Signals::inputs`]. Each value
    /// is from the last cycle in which it was fresh.
    pub inputs: Vec<f64>,
    /// The controller has called `finish`.
    pub finished: bool,
    pub diagnoses: IndexVec<DeviceIndex, SubDeviceDiagnostics>,
    /// For each device, true from its loss to the reset of its group: its outputs are off.
    pub locked_outputs: IndexVec<DeviceIndex, bool>,
    /// The first cause, once the machine is stopping.
    pub stopping: Option<StopCause>,
    /// A failure during a requested stop.
    pub failure: Option<StopCause>,
    /// True once the stop has ended for every axis: the cycle can do nothing more.
    pub stop_ended: bool,
    pub groups: IndexVec<GroupIndex, GroupStatus>,
    /// Events dropped because the queue was full.
    pub events_lost: u64,
    /// True if no gateway exchanges process data with its nodes any more.
    pub gateways_ended: bool,
    /// Commands taken so far.
    pub commands_taken: u64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PhaseStatus {
    pub reference: Option<DeviceIndex>,
    pub locked: bool,
    pub error_ns: i64,
    pub drift_ppm: f64,
}

/// The real-time end.
#[derive(Debug)]
pub struct RtEndpoint {
    pub commands: rtrb::Consumer<RtCommand>,
    pub events: rtrb::Producer<Event>,
    pub snapshots: triple_buffer::Input<Snapshot>,
    pub heartbeat: Heartbeat,
}

/// The end of all other threads.
#[derive(Debug)]
pub struct HostEndpoint {
    pub commands: rtrb::Producer<RtCommand>,
    pub events: rtrb::Consumer<Event>,
    pub snapshots: triple_buffer::Output<Snapshot>,
    pub heartbeat: Heartbeat,
}

/// Creates both ends. `first` determines the size of the snapshots.
#[must_use]
pub fn channel(first: &Snapshot) -> (RtEndpoint, HostEndpoint) {
    let (command_in, command_out) = rtrb::RingBuffer::new(ORDERS);
    let (event_in, event_out) = rtrb::RingBuffer::new(EVENTS);
    let (snapshot_in, snapshot_out) = triple_buffer::triple_buffer(first);
    let heartbeat = Heartbeat::default();
    (
        RtEndpoint {
            commands: command_out,
            events: event_in,
            snapshots: snapshot_in,
            heartbeat: heartbeat.clone(),
        },
        HostEndpoint {
            commands: command_in,
            events: event_out,
            snapshots: snapshot_out,
            heartbeat,
        },
    )
}
