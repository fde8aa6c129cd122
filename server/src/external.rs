//! Set-points of clients in the cycle: the cyclic area and the streams.
//!
//! RT: neither allocates nor frees nor blocks. Memory comes and goes through bounded queues.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering, fence};

use ecaxis_axis::setpoint::{Motion, MotionLimits, Setpoint, Stream, StreamConfig, StreamState};
use ecaxis_axis::{AxisStatus, Command};
use ecaxis_master::config::{AxisRef, Machine};
use ecaxis_master::rt::controller::{Controller, CycleContext};
use ecaxis_master::sys::shared_memory::SharedMemory;

use follower::{Follower, Wanted};
pub use messages::{
    AreaCounters, AreaStop, Message, Report, StreamEnd, StreamError, StreamPoint, words,
};

mod follower;
mod messages;

/// The number of points that a stream keeps.
pub const STREAM_POINTS: usize = 256;
/// The messages handled in one cycle.
pub const MESSAGES_PER_CYCLE: usize = 64;
/// The capacity of the queues. A report has room if its message was taken.
const QUEUE: usize = 256;
/// The reports that one cycle may write besides the answers to messages, for each axis.
const REPORTS_PER_AXIS: usize = 1;
/// The most cycles between two sets that count.
const MOST_STEPS: u32 = 1000;
/// The cycles after which an axis that has caught up follows the set-points themselves.
const REGULAR: u32 = 10;
/// Steps at the limit are accepted although they are rounded.
const ROUNDING: f64 = 1.0 + 1e-9;
/// The attempts to read a complete set in one cycle.
const ATTEMPTS: usize = 4;

/// What an axis follows.
#[derive(Debug)]
enum Source {
    /// `blocked`: until the client writes kind 0.
    Nothing {
        blocked: bool,
    },
    Area(Follower),
    /// `path` is the motion of the stream.
    Stream(Follower),
}

#[derive(Debug)]
struct FollowedAxis {
    axis: AxisRef,
    limits: MotionLimits,
    range: Option<[f64; 2]>,
    source: Source,
    stream: Option<Stream<STREAM_POINTS>>,
}

/// The controller of clients' set-points.
pub struct External {
    messages: rtrb::Consumer<Message>,
    reports: rtrb::Producer<Report>,
    counters: Arc<AreaCounters>,
    memory: Option<Arc<SharedMemory>>,
    /// The memory is that of the owner.
    reads: bool,
    /// Kind and value of each axis in the last complete set.
    set: Box<[[u64; 2]]>,
    scratch: Box<[[u64; 2]]>,
    counter: u64,
    leases_ended: u64,
    /// Cycles since the last new set.
    missing: u32,
    /// Cycles, or sets of the client if more, from the set before to the present one.
    steps: u32,
    stale_cycles: u32,
    axes: Box<[FollowedAxis]>,
    /// Blocks while virtual time must stand.
    hold: Option<Hold>,
}

/// Blocks while virtual time must stand.
pub type Hold = Box<dyn FnMut() + Send>;

/// The ends of [`External`] outside the cycle.
#[derive(Debug)]
pub struct ExternalClient {
    pub messages: rtrb::Producer<Message>,
    pub reports: rtrb::Consumer<Report>,
}

impl ExternalClient {
    /// Returns the number of messages that the cycle has not taken yet.
    #[must_use]
    pub fn waiting(&self) -> usize {
        QUEUE - self.messages.slots()
    }
}

/// Creates the controller of a run and its ends outside. In virtual time, `hold` blocks each cycle
/// while time must stand.
#[must_use]
pub fn external(
    machine: &Machine,
    counters: &Arc<AreaCounters>,
    hold: Option<Hold>,
) -> (External, ExternalClient) {
    let (message_in, message_out) = rtrb::RingBuffer::new(QUEUE);
    let reports = QUEUE + machine.axes.len() * REPORTS_PER_AXIS;
    let (report_in, report_out) = rtrb::RingBuffer::new(reports);
    let axes: Box<[_]> = machine
        .axes
        .iter()
        .filter_map(|setup| {
            let limits = &setup.config.limits;
            Some(FollowedAxis {
                axis: machine.axis(&setup.name).ok()?,
                limits: MotionLimits {
                    velocity: limits.velocity,
                    acceleration: limits.acceleration,
                    jerk: limits.jerk(),
                },
                range: limits.position,
                source: Source::Nothing { blocked: false },
                stream: None,
            })
        })
        .collect();
    let controller = External {
        messages: message_out,
        reports: report_in,
        counters: Arc::clone(counters),
        memory: None,
        reads: false,
        set: vec![[0; 2]; axes.len()].into(),
        scratch: vec![[0; 2]; axes.len()].into(),
        counter: 0,
        leases_ended: counters.leases_ended.load(Ordering::Acquire),
        missing: 0,
        steps: 1,
        stale_cycles: machine.server.stale_cycles,
        axes,
        hold,
    };
    let client = ExternalClient {
        messages: message_in,
        reports: report_out,
    };
    (controller, client)
}

/// Creates the memory of a client's commands.
///
/// # Errors
/// Fails if the system refuses the memory.
pub fn command_area(axes: usize) -> std::io::Result<SharedMemory> {
    let memory = SharedMemory::create("ecaxis-commands", words::HEADER + axes * words::OF_AXIS)?;
    let values = [
        (words::VERSION_AT, words::VERSION),
        (words::AXES_AT, words::HEADER as u64),
        (words::AXIS_WORDS, words::OF_AXIS as u64),
        (words::AXES, axes as u64),
        (0, u64::from_ne_bytes(words::MAGIC)),
    ];
    for (at, value) in values {
        memory.words()[at].store(value, Ordering::Relaxed);
    }
    Ok(memory)
}

impl Controller for External {
    fn cycle(&mut self, machine: &mut CycleContext<'_>) {
        if let Some(hold) = self.hold.as_mut().filter(|_| machine.in_op()) {
            hold();
        }
        let ended = self.counters.leases_ended.load(Ordering::Acquire);
        if std::mem::replace(&mut self.leases_ended, ended) != ended {
            self.end_lease(machine);
        }
        self.take_messages(machine);
        let before = self.counter;
        let fresh = self.read_area();
        self.missing = self.missing.saturating_add(1);
        if fresh {
            let sets = u32::try_from(self.counter.wrapping_sub(before)).unwrap_or(u32::MAX);
            self.steps = sets.max(self.missing).clamp(1, MOST_STEPS);
            self.missing = 0;
        }
        let (mut follows, mut blocked, mut refused) = (false, 0_u64, 0_u64);
        for index in 0..self.axes.len() {
            let stop = match self.axes[index].source {
                Source::Stream(follower) => {
                    self.follow_stream(index, follower, machine);
                    continue;
                }
                Source::Area(_) => {
                    follows = true;
                    self.follow_area(index, fresh, machine)
                }
                Source::Nothing { blocked } => self.begin(index, blocked, fresh, machine),
            };
            if let Err(cause) = stop {
                refused += u64::from(!matches!(cause, AreaStop::Stale(_)));
                self.axes[index].source = Source::Nothing { blocked: true };
                self.counters.stopped.fetch_add(1, Ordering::Relaxed);
                let report = Report::AreaStopped { axis: index, cause };
                let _ = self.reports.push(report);
            }
            if matches!(self.axes[index].source, Source::Nothing { blocked: true }) {
                blocked |= 1 << index.min(63);
            }
        }
        self.publish(fresh, follows, blocked, refused);
    }
}

impl External {
    /// The axes follow no client, and no memory is in use.
    fn end_lease(&mut self, machine: &mut CycleContext<'_>) {
        for axis in &mut self.axes {
            if let Source::Area(_) = axis.source {
                // A velocity or torque would go on.
                let _ = machine.command(axis.axis, Command::Stop);
            }
            axis.release();
        }
        // `Detach` follows and takes the memory away.
        self.reads = false;
    }

    fn take_messages(&mut self, machine: &mut CycleContext<'_>) {
        for _ in 0..MESSAGES_PER_CYCLE {
            // Each message has at most one report.
            if self.reports.slots() <= self.axes.len() * REPORTS_PER_AXIS {
                return;
            }
            let Ok(message) = self.messages.pop() else {
                return;
            };
            match message {
                Message::Release(None) => {
                    for axis in &mut self.axes {
                        axis.release();
                    }
                }
                Message::Release(Some(index)) => {
                    if let Some(axis) = self.axes.get_mut(index) {
                        axis.release();
                    }
                }
                Message::Attach(memory) => {
                    self.counters.attached.store(1, Ordering::Relaxed);
                    self.exchange(Some(memory), machine);
                }
                Message::Detach => {
                    self.counters.attached.store(0, Ordering::Relaxed);
                    self.exchange(None, machine);
                }
                Message::Open {
                    ticket,
                    axis,
                    config,
                } => {
                    let result = self.open(axis, config, machine);
                    let _ = self.reports.push(Report::Opened { ticket, result });
                }
                Message::Push {
                    ticket,
                    axis,
                    points,
                } => self.push(ticket, axis, points),
                Message::Close { ticket, axis } => {
                    let stream = self.axes.get_mut(axis).and_then(|a| a.stream.as_mut());
                    let result = stream.map_or(Err(StreamError::NotOpen), |s| Ok(s.close()?));
                    let _ = self.reports.push(Report::Closed { ticket, result });
                }
            }
        }
    }

    fn exchange(&mut self, memory: Option<Arc<SharedMemory>>, machine: &mut CycleContext<'_>) {
        self.reads = memory.is_some();
        let old = std::mem::replace(&mut self.memory, memory);
        // A set of the previous client is not one of the next.
        self.set.fill([0; 2]);
        self.counter = 0;
        for axis in &mut self.axes {
            match axis.source {
                Source::Stream(_) => continue,
                Source::Area(_) => {
                    let _ = machine.command(axis.axis, Command::Stop);
                }
                Source::Nothing { .. } => {}
            }
            axis.source = Source::Nothing { blocked: false };
        }
        if let Some(old) = old {
            let _ = self.reports.push(Report::Detached(old));
        }
    }

    fn open(
        &mut self,
        index: usize,
        config: StreamConfig,
        machine: &CycleContext<'_>,
    ) -> Result<(), StreamError> {
        let axis = self.axes.get_mut(index).ok_or(StreamError::NotOpen)?;
        if matches!(axis.source, Source::Area(_)) {
            return Err(StreamError::Follows);
        }
        let status = machine.axis(axis.axis);
        if !status.ready {
            return Err(StreamError::NotReady);
        }
        let motion = motion_of(&status);
        let config = StreamConfig {
            limits: axis.limits,
            range: axis.range,
            ..config
        };
        axis.stream = Some(Stream::new(config, motion)?);
        axis.source = Source::Stream(Follower::new(motion));
        Ok(())
    }

    fn push(&mut self, ticket: u64, index: usize, points: Box<[StreamPoint]>) {
        let (mut accepted, mut free, mut error) = (0, 0, None);
        match self.axes.get_mut(index).and_then(|a| a.stream.as_mut()) {
            None => error = Some(StreamError::NotOpen),
            Some(stream) => {
                for point in &points {
                    let pushed = stream.push_with_torque(point.knot, point.torque);
                    if let Err(refused) = pushed {
                        error = Some(refused.into());
                        break;
                    }
                    accepted += 1;
                }
                free = stream.free();
            }
        }
        let _ = self.reports.push(Report::Pushed {
            ticket,
            accepted,
            free,
            error,
            points,
        });
    }

    /// Copies a complete set. Returns true if it is new.
    fn read_area(&mut self) -> bool {
        let Some(memory) = self.memory.as_ref().filter(|_| self.reads) else {
            return false;
        };
        let area = memory.words();
        for _ in 0..ATTEMPTS {
            let before = area[words::SEQUENCE].load(Ordering::Acquire);
            if before % 2 != 0 {
                continue;
            }
            let counter = area[words::COUNTER].load(Ordering::Relaxed);
            let axes = area[words::HEADER..].chunks_exact(words::OF_AXIS);
            for (to, from) in self.scratch.iter_mut().zip(axes) {
                *to = [0, 1].map(|word: usize| from[word].load(Ordering::Relaxed));
            }
            fence(Ordering::Acquire);
            if area[words::SEQUENCE].load(Ordering::Relaxed) == before {
                if counter == self.counter {
                    return false;
                }
                self.counter = counter;
                self.set.copy_from_slice(&self.scratch);
                return true;
            }
        }
        false
    }

    /// Lets an axis follow the area from the first set-point on.
    fn begin(
        &mut self,
        index: usize,
        blocked: bool,
        fresh: bool,
        machine: &mut CycleContext<'_>,
    ) -> Result<(), AreaStop> {
        if !fresh {
            return Ok(());
        }
        let [kind, value] = self.set[index];
        let axis = &mut self.axes[index];
        if kind == 0 {
            axis.source = Source::Nothing { blocked: false };
            return Ok(());
        }
        if blocked {
            return Ok(());
        }
        let wanted = Wanted::new(kind, value)?;
        let status = machine.axis(axis.axis);
        if !status.ready || status.moving || status.target_velocity != 0.0 {
            return Err(AreaStop::NotReady);
        }
        let path = motion_of(&status);
        let mut source = Follower::new(path);
        source.apply(axis, wanted, 1, machine)?;
        axis.source = Source::Area(source);
        Ok(())
    }

    fn follow_area(
        &mut self,
        index: usize,
        fresh: bool,
        machine: &mut CycleContext<'_>,
    ) -> Result<(), AreaStop> {
        let [kind, value] = self.set[index];
        let axis = &mut self.axes[index];
        let Source::Area(mut source) = axis.source else {
            return Ok(());
        };
        if self.missing > self.stale_cycles {
            let _ = machine.command(axis.axis, Command::Stop);
            return Err(AreaStop::Stale(self.missing));
        }
        let result = if !machine.axis(axis.axis).ready {
            // Otherwise the axis would move again as soon as it is enabled again.
            Err(AreaStop::NotReady)
        } else if fresh {
            match Wanted::new(kind, value) {
                Ok(Wanted::Nothing) => {
                    axis.source = Source::Nothing { blocked: false };
                    let _ = machine.command(axis.axis, Command::Stop);
                    return Ok(());
                }
                Ok(wanted) if wanted.same_kind(source.last) => {
                    source.apply(axis, wanted, self.steps, machine)
                }
                Ok(_) => Err(AreaStop::KindChanged),
                Err(cause) => Err(cause),
            }
        } else {
            source.extrapolate(axis, machine)
        };
        match result {
            Ok(()) => axis.source = Source::Area(source),
            Err(_) => {
                let _ = machine.command(axis.axis, Command::Stop);
            }
        }
        result
    }

    fn follow_stream(
        &mut self,
        index: usize,
        mut follower: Follower,
        machine: &mut CycleContext<'_>,
    ) {
        let axis = &mut self.axes[index];
        let Some(stream) = &mut axis.stream else {
            axis.source = Source::Nothing { blocked: true };
            return;
        };
        let rate = machine.rate(axis.axis);
        let next = stream.advance(follower.path, rate, machine.dt_s());
        let end = match stream.state() {
            StreamState::Underrun => Some(StreamEnd::Underrun),
            _ if stream.finished(next) && follower.gear.is_none() => Some(StreamEnd::Done),
            _ => None,
        };
        let torque = stream.torque();
        follower.path = next;
        let at = motion_of(&machine.axis(axis.axis));
        let refused = match follower.follow(axis, at, machine) {
            Err(AreaStop::Refused(error)) => Some(StreamEnd::Refused(error)),
            _ => None,
        };
        machine.set_torque_feedforward(axis.axis, torque);
        let end = refused.or(end);
        axis.source = Source::Stream(follower);
        if let Some(end) = end {
            // Without a set-point the axis decelerates and holds.
            axis.release();
            let _ = self.reports.push(Report::StreamEnded { axis: index, end });
        }
    }

    /// Writes the state of the area for the client and for others.
    fn publish(&self, fresh: bool, follows: bool, blocked: u64, refused: u64) {
        let (used, late) = (u64::from(fresh), u64::from(follows && !fresh));
        let counters = &self.counters;
        let add = |counter: &AtomicU64, more: u64| {
            counter
                .fetch_add(more, Ordering::Relaxed)
                .wrapping_add(more)
        };
        let used = add(&counters.used, used);
        let late = add(&counters.late, late);
        let refused = add(&counters.refused, refused);
        if let Some(memory) = &self.memory {
            let values = [
                (words::LAST_USED, self.counter),
                (words::USED, used),
                (words::LATE, late),
                (words::REFUSED, refused),
                (words::BLOCKED, blocked),
            ];
            for (at, value) in values {
                memory.words()[at].store(value, Ordering::Relaxed);
            }
        }
    }
}

impl FollowedAxis {
    /// The axis follows no client. One that has followed stays so until the client writes kind 0 or
    /// opens a stream.
    fn release(&mut self) {
        self.stream = None;
        if !matches!(self.source, Source::Nothing { .. }) {
            self.source = Source::Nothing { blocked: true };
        }
    }
}

fn motion_of(status: &AxisStatus) -> Motion {
    Motion {
        position: status.target_position,
        velocity: status.target_velocity,
        acceleration: status.target_acceleration,
    }
}

impl fmt::Debug for External {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("External")
            .field("axes", &self.axes)
            .field("attached", &self.memory.is_some())
            .finish_non_exhaustive()
    }
}
