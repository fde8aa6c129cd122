//! Set-points of clients in the cycle: the cyclic area and the streams.
//!
//! RT: neither allocates nor frees nor blocks. Memory comes and goes through bounded queues.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering, fence};

use ecaxis_axis::setpoint::{
    Gear, GearConfig, GearInMode, Knot, Motion, MotionLimits, Setpoint, SetpointError, Stream,
    StreamConfig, StreamState,
};
use ecaxis_axis::{AxisStatus, Command, CommandError};
use ecaxis_master::config::{AxisRef, Machine};
use ecaxis_master::rt::controller::{Controller, CycleContext};
use ecaxis_master::sys::shared_memory::SharedMemory;

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

/// The words of the commands, see docs/server.md.
pub mod words {
    pub const MAGIC: [u8; 8] = *b"ECAXCMDS";
    pub const VERSION: u64 = 1;
    pub const VERSION_AT: usize = 1;
    pub const AXES_AT: usize = 2;
    pub const AXIS_WORDS: usize = 3;
    pub const AXES: usize = 4;
    pub const SEQUENCE: usize = 5;
    pub const COUNTER: usize = 6;
    pub const LAST_USED: usize = 8;
    pub const USED: usize = 9;
    pub const LATE: usize = 10;
    pub const REFUSED: usize = 11;
    pub const BLOCKED: usize = 12;
    pub const HEADER: usize = 16;
    /// The words of one axis.
    pub const OF_AXIS: usize = 4;
}

/// A point of a stream.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StreamPoint {
    pub knot: Knot,
    /// Torque feed-forward in percent of rated torque.
    pub torque: f64,
}

/// A message to the cycle.
#[derive(Debug)]
pub enum Message {
    /// The axes follow no client from now on; `None`: all axes.
    Release(Option<usize>),
    /// The memory of the client that owns the motion.
    Attach(Arc<SharedMemory>),
    /// No client writes set-points.
    Detach,
    Open {
        ticket: u64,
        axis: usize,
        config: StreamConfig,
    },
    Push {
        ticket: u64,
        axis: usize,
        points: Box<[StreamPoint]>,
    },
    Close {
        ticket: u64,
        axis: usize,
    },
}

/// A report of the cycle.
#[derive(Debug)]
pub enum Report {
    Opened {
        ticket: u64,
        result: Result<(), StreamError>,
    },
    Pushed {
        ticket: u64,
        accepted: usize,
        free: usize,
        error: Option<StreamError>,
        /// Returned to be freed outside the cycle.
        points: Box<[StreamPoint]>,
    },
    Closed {
        ticket: u64,
        result: Result<(), StreamError>,
    },
    StreamEnded {
        axis: usize,
        end: StreamEnd,
    },
    AreaStopped {
        axis: usize,
        cause: AreaStop,
    },
    /// Memory that is no longer used, to be freed outside the cycle.
    Detached(Arc<SharedMemory>),
}

/// Why a request to a stream was refused.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum StreamError {
    #[error("the axis is not ready: enable it first")]
    NotReady,
    #[error("the axis has no open stream")]
    NotOpen,
    #[error("the axis follows set-points of the cyclic area")]
    Follows,
    #[error(transparent)]
    Setpoint(#[from] SetpointError),
}

/// How a stream has ended.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum StreamEnd {
    /// The axis stands at the last point.
    Done,
    /// The points ran out.
    Underrun,
    /// The axis refused a set-point.
    Refused(CommandError),
}

/// Why an axis no longer follows the cyclic area.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum AreaStop {
    #[error("no new set-point came for {0} cycles")]
    Stale(u32),
    #[error("a set-point was refused: {0}")]
    Refused(CommandError),
    #[error("a set-point is not a finite number")]
    NotFinite,
    #[error("{0} is not a kind of set-point")]
    Kind(u64),
    #[error("the kind of set-point has changed without 0 between")]
    KindChanged,
    #[error("the axis is not ready, or moves: enable it and wait until it stands")]
    NotReady,
}

/// What the area has done so far, for everybody outside the cycle.
#[derive(Debug, Default)]
pub struct AreaCounters {
    /// Leases that have ended. The axes then follow no client, also if the supervisor is busy.
    pub leases_ended: AtomicU64,
    /// 1 while memory is attached.
    pub attached: AtomicU64,
    /// Sets that were used.
    pub used: AtomicU64,
    /// Cycles without a new set while an axis follows.
    pub late: AtomicU64,
    /// Refused set-points.
    pub refused: AtomicU64,
    /// Axes that were stopped because set-points were late or refused.
    pub stopped: AtomicU64,
}

/// The kind of a set-point, and its value.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Wanted {
    Nothing,
    Position(f64),
    Velocity(f64),
    Torque(f64),
}

impl Wanted {
    fn new(kind: u64, bits: u64) -> Result<Self, AreaStop> {
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

    fn same_kind(self, other: Self) -> bool {
        std::mem::discriminant(&self) == std::mem::discriminant(&other)
    }
}

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

/// An axis that follows set-points of a client.
#[derive(Debug, Clone, Copy)]
struct Follower {
    /// The last set-point of the cyclic area.
    last: Wanted,
    /// The set-points of the client: the last position and its velocity.
    path: Motion,
    /// Catches up after missing set-points or lost frames.
    gear: Option<Gear>,
    /// Cycles in which the gear was engaged since the last irregular set.
    regular: u32,
    /// The last accepted set-point of the axis.
    commanded: f64,
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
        // The report of each message has its own room.
        if self.reports.slots() > self.axes.len() * REPORTS_PER_AXIS {
            self.exchange(None, machine);
        }
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
        let Some(memory) = &self.memory else {
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
        let result = if fresh {
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
        let next = stream.advance(follower.path, machine.dt_s());
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

impl Follower {
    fn new(path: Motion) -> Self {
        Self {
            last: Wanted::Nothing,
            path,
            gear: None,
            regular: 0,
            commanded: path.position,
        }
    }

    /// Gives the axis a new set-point of the client, `steps` cycles after the one before.
    fn apply(
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
    fn extrapolate(
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

    fn catch_up(&mut self, axis: &FollowedAxis, at: Motion) {
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

    fn follow(
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
                let next = gear.advance(self.path, at, machine.dt_s());
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
