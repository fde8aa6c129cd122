//! Answers cyclic frames like a bus. Each reply is delayed by the time on the wire.
//!
//! - [`Bus`]: from the peer interface and on another CPU; spins only while a frame is due;
//! - [`InProcess`]: on the thread of the cycle, without an interface: measures the work of a cycle,
//!   but no exchange.

use std::io;
use std::num::NonZeroU64;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};

use serde::Serialize;

use super::segment::BenchSegment;
use super::veth::{self, VethPair};
use ecaxis_master::clock::{self, Clock, Nanos};
use ecaxis_master::link::{self, FrameQueue, Link, LinkError, MAX_FRAME, SocketKind};
use ecaxis_master::sys::process;
use ecaxis_master::sys::rt_thread;
use ecaxis_sim::frame::{Kind, wire_time};

/// The maximum time in ns that sleeping ends early; at most a quarter of a cycle.
const LONGEST_MARGIN: Nanos = 150_000;
/// The maximum gap between frames of one cycle in ns.
const BACK_TO_BACK: Nanos = 10_000;
/// The polling period in ns if no frame is expected.
const IDLE: Nanos = 50_000;
/// A frame read or sent later than this in ns was delayed by this computer, not by the bus.
const HELD_UP: Nanos = 10_000;

/// The capacity for delayed replies.
const MAX_REPLIES: usize = 32;

/// The delay of a reply.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ReplyDelay {
    /// A fixed delay in ns.
    Fixed(Nanos),
    /// The time of the frame on a 100 Mbit/s wire through its SubDevices.
    Wire,
}

/// Faults injected into replies.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct FaultInjection {
    /// Every n-th reply is dropped.
    pub drop_every: Option<NonZeroU64>,
    /// Every n-th reply is delayed by additional ns.
    pub late_every: Option<(NonZeroU64, Nanos)>,
}

#[derive(Debug, Clone, Copy)]
pub struct Options {
    pub hold: ReplyDelay,
    /// The cycle time in ns, which avoids spinning between frames.
    pub cycle_ns: Nanos,
    pub mischief: FaultInjection,
    pub priority: u8,
    pub cpu: Option<usize>,
    /// The delay in ns beyond which a cycle can be lost.
    pub slack_ns: Nanos,
}

/// Counters of the bus.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Counts {
    pub frames: u64,
    pub replies: u64,
    pub malformed: u64,
    /// Frames that are not EtherCAT.
    pub foreign: u64,
    /// Replies dropped by fault injection.
    pub dropped: u64,
    /// Replies delayed by fault injection.
    pub delayed: u64,
    /// Replies that the interface refused, or for which the queue was full.
    pub not_sent: u64,
    /// Replies delayed noticeably by this computer, because another program or the hypervisor had
    /// the CPU.
    pub held_up: u64,
    /// Those of `held_up` that were certainly too late.
    pub too_late: u64,
}

impl Counts {
    /// Returns the increments since `before`.
    #[must_use]
    pub fn since(&self, before: &Self) -> Self {
        self.zip(before, |now, before| now - before)
    }

    #[must_use]
    pub fn plus(&self, other: &Self) -> Self {
        self.zip(other, |one, other| one + other)
    }

    fn zip(&self, other: &Self, f: fn(u64, u64) -> u64) -> Self {
        Self {
            frames: f(self.frames, other.frames),
            replies: f(self.replies, other.replies),
            malformed: f(self.malformed, other.malformed),
            foreign: f(self.foreign, other.foreign),
            dropped: f(self.dropped, other.dropped),
            delayed: f(self.delayed, other.delayed),
            not_sent: f(self.not_sent, other.not_sent),
            held_up: f(self.held_up, other.held_up),
            too_late: f(self.too_late, other.too_late),
        }
    }
}

/// A running bus; dropping it stops the thread.
#[derive(Debug)]
pub struct Bus {
    stop: Arc<AtomicBool>,
    /// The bus thread publishes without waiting for readers.
    counts: Mutex<triple_buffer::Output<Counts>>,
    thread: Option<JoinHandle<()>>,
}

/// Opens the link on the thread of the bus.
pub(super) type ThreadSetup = Box<dyn FnOnce() -> io::Result<Box<dyn Link>> + Send>;

impl Bus {
    /// Starts the thread; `open` runs on it. Returns when frames are answered.
    ///
    /// # Errors
    /// Fails if `open` fails or no thread can be started.
    pub fn start(open: ThreadSetup, segment: BenchSegment, options: Options) -> io::Result<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let (published, counts) = triple_buffer::triple_buffer(&Counts::default());
        let (ready, started): (Sender<io::Result<()>>, Receiver<_>) = channel();
        let stopped = Arc::clone(&stop);
        let thread =
            thread::Builder::new()
                .name("ecaxis-bus".to_owned())
                .spawn(move || match open() {
                    Ok(link) => {
                        // A missing permission shows in the number of delayed replies.
                        let _ = rt_thread::become_realtime(options.priority, options.cpu);
                        let _ = ready.send(Ok(()));
                        Worker::new(link, segment, options, published).serve(&stopped);
                    }
                    Err(error) => {
                        let _ = ready.send(Err(error));
                    }
                })?;
        let bus = Self {
            stop,
            counts: Mutex::new(counts),
            thread: Some(thread),
        };
        started
            .recv()
            .unwrap_or_else(|_| Err(io::Error::other("the bus ended early")))?;
        Ok(bus)
    }

    /// Starts a bus on the far end of a pair. If permitted, that end moves to a separate network
    /// namespace; then the kernel removes the pair with this process.
    ///
    /// # Errors
    /// Fails if the interface cannot be moved, brought up or opened.
    pub fn on(pair: &VethPair, segment: BenchSegment, options: Options) -> io::Result<Self> {
        let (report, reported): (Sender<Option<i32>>, Receiver<_>) = channel();
        let (go, gone): (Sender<()>, Receiver<()>) = channel();
        let nic = pair.b.clone();
        let open = Box::new(move || -> io::Result<Box<dyn Link>> {
            let away = process::own_network().ok();
            let _ = report.send(away);
            gone.recv()
                .map_err(|_| io::Error::other("the interface cannot be moved"))?;
            if away.is_some() {
                veth::up_here(&nic)?;
            }
            let (link, _) = link::open(&nic, SocketKind::default()).map_err(io::Error::other)?;
            Ok(link)
        });
        let bus = thread::scope(|scope| {
            let starting = scope.spawn(|| Self::start(open, segment, options));
            let moved = match reported.recv() {
                Ok(Some(thread)) => pair.move_b(thread),
                _ => Ok(()),
            };
            match &moved {
                Ok(()) => {
                    let _ = go.send(());
                }
                Err(_) => drop(go),
            }
            let started = starting
                .join()
                .unwrap_or_else(|_| Err(io::Error::other("the bus panicked")));
            moved.and(started)
        })?;
        pair.wait_for_link()?;
        Ok(bus)
    }

    #[must_use]
    pub fn counts(&self) -> Counts {
        let mut counts = self.counts.lock().unwrap_or_else(PoisonError::into_inner);
        *counts.read()
    }
}

impl Drop for Bus {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

struct Worker {
    link: Box<dyn Link>,
    segment: BenchSegment,
    options: Options,
    counts: Counts,
    published: triple_buffer::Input<Counts>,
    held: FrameQueue,
    /// The buffer for a frame if the queue is full.
    spare: [u8; MAX_FRAME],
    /// The time when the wire is free for the next frame.
    free: Nanos,
    looked: Nanos,
}

impl Worker {
    fn new(
        link: Box<dyn Link>,
        segment: BenchSegment,
        options: Options,
        published: triple_buffer::Input<Counts>,
    ) -> Self {
        Self {
            link,
            segment,
            options,
            counts: Counts::default(),
            published,
            held: FrameQueue::new(MAX_REPLIES),
            spare: [0; MAX_FRAME],
            free: 0,
            looked: clock::now(),
        }
    }

    fn serve(&mut self, stop: &AtomicBool) {
        let cycle = self.options.cycle_ns;
        let margin = LONGEST_MARGIN.min(cycle / 4);
        // The first frame of the last cycle, and the last frame.
        let (mut began, mut last) = (0, 0);
        while !stop.load(Ordering::Relaxed) {
            let now = clock::now();
            let unseen = now.saturating_sub(self.looked);
            if self.take(now) {
                if now.saturating_sub(began) > cycle / 2 {
                    // Frames that arrived during sleep may have arrived together: wake up earlier
                    // next time.
                    began = if unseen > BACK_TO_BACK {
                        self.looked
                    } else {
                        now
                    };
                }
                last = now;
            }
            self.looked = now;
            self.send(now);
            let now = clock::now();
            if now.saturating_sub(last) < BACK_TO_BACK {
                std::hint::spin_loop();
                continue;
            }
            let expected = began + cycle;
            let frame = if expected + cycle < now {
                now + margin + IDLE
            } else {
                expected
            };
            let next = self.held.next_due().map_or(frame, |due| due.min(frame));
            if next > now + margin {
                Clock::Real.sleep_until(next - margin, 0);
            } else {
                std::hint::spin_loop();
            }
        }
    }

    /// Takes a frame if one has arrived. `now` is the time before the poll.
    fn take(&mut self, now: Nanos) -> bool {
        let mut place = self.held.vacant();
        let buf = place
            .as_mut()
            .map_or(&mut self.spare, |slot| &mut slot.bytes);
        let Ok(Some(len)) = self.link.recv(buf) else {
            return false;
        };
        match self.segment.answer(&mut buf[..len], now) {
            Kind::EtherCat => {}
            Kind::Malformed => {
                self.counts.malformed += 1;
                return false;
            }
            Kind::Foreign => {
                self.counts.foreign += 1;
                return false;
            }
        }
        self.counts.frames += 1;
        let nth = |every: NonZeroU64| self.counts.frames.is_multiple_of(every.get());
        if self.options.mischief.drop_every.is_some_and(nth) {
            self.counts.dropped += 1;
            self.publish();
            return true;
        }
        let mut due = match self.options.hold {
            ReplyDelay::Fixed(hold) => now + hold,
            ReplyDelay::Wire => {
                let start = now.max(self.free);
                self.free = start + wire_time(len);
                start + self.segment.wire_ns(len)
            }
        };
        if let Some((every, longer)) = self.options.mischief.late_every
            && nth(every)
        {
            self.counts.delayed += 1;
            due += longer;
        }
        if let Some(slot) = self.held.vacant() {
            slot.len = len;
            slot.unseen = now.saturating_sub(self.looked);
            self.held.push(due);
        } else {
            self.counts.not_sent += 1;
        }
        self.publish();
        true
    }

    fn send(&mut self, now: Nanos) {
        while let Some((due, reply)) = self.held.pop_due(now) {
            let late = reply.unseen.saturating_add(now - due);
            match self.link.send(&reply.bytes[..reply.len]) {
                Ok(()) => self.counts.replies += 1,
                Err(_) => self.counts.not_sent += 1,
            }
            self.counts.held_up += u64::from(late > HELD_UP);
            self.counts.too_late += u64::from(late > self.options.slack_ns);
            self.publish();
        }
    }

    fn publish(&mut self) {
        self.published.write(self.counts);
    }
}

/// A link to a [`BenchSegment`] on the same thread.
#[derive(Debug)]
pub struct InProcess {
    segment: BenchSegment,
    hold: ReplyDelay,
    held: FrameQueue,
}

impl InProcess {
    #[must_use]
    pub fn new(segment: BenchSegment, hold: ReplyDelay) -> Self {
        Self {
            segment,
            hold,
            held: FrameQueue::new(MAX_REPLIES),
        }
    }
}

impl Link for InProcess {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        let now = clock::now();
        let hold = match self.hold {
            ReplyDelay::Fixed(hold) => hold,
            ReplyDelay::Wire => self.segment.wire_ns(frame.len()),
        };
        let slot = self.held.store(frame)?;
        if self.segment.answer(slot.frame(), now) == Kind::EtherCat {
            self.held.push(now + hold);
        }
        Ok(())
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        Ok(self.held.receive(clock::now(), buf))
    }

    fn next_arrival(&self) -> Option<Nanos> {
        self.held.next_due()
    }
}
