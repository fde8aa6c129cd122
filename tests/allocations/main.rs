//! Counts allocations of the real-time path: none in 100,000 cycles, which include a lost frame and
//! a drive fault.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::pin::{Pin, pin};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::channel;
use std::task::{Context, Poll, Waker};

use ecaxis_axis::Command;
use ecaxis_axis::setpoint::{Interpolation, Knot, MotionLimits, StreamConfig};
use ecaxis_ecat::index::AxisIndex;
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::{self, Clock, Nanos};
use ecaxis_master::config::{AxisRef, Machine};
use ecaxis_master::link::capture::{Recorder, WriterMode};
use ecaxis_master::link::filter::LinkStats;
use ecaxis_master::link::redundant::{End, RedundantLink, RingEnds};
use ecaxis_master::link::sim::{SimLink, SimRing};
use ecaxis_master::link::{Link, LinkError, MAX_FRAME};
use ecaxis_master::mailbox::DeviceMailbox;
use ecaxis_master::recording::Direction;
use ecaxis_master::rt::controller::{Controller, CycleContext};
use ecaxis_master::rt::cycle::{Engine, EngineReport};
use ecaxis_master::samples::{SampleLayout, Samples};
use ecaxis_master::session::{
    Attachments, Cause, Error, Options, Prepared, Progress, RunBuilder, simulated_bus,
    simulated_link,
};
use ecaxis_master::sys::shared_memory::SharedMemory;
use ecaxis_server::external::{
    AreaCounters, External, ExternalClient, Message, Report, StreamPoint, command_area, external,
    words,
};
use ecaxis_sim::SecondPort;
use ecaxis_test_support::{axes, faults, load, machine, virtual_time};

mod common_time;
mod corrections;
mod line_shaft;

/// The machine time whose samples are kept.
const SAMPLES_NS: u64 = 1_000_000_000;

thread_local! {
    static METERED: Cell<bool> = const { Cell::new(false) };
    static COUNT: Cell<u64> = const { Cell::new(0) };
}

/// Counts allocations, reallocations and frees of metered threads.
struct Counting;

fn count() {
    // A thread in teardown has no counters left and is not metered.
    let _ = METERED.try_with(|metered| {
        if metered.get() {
            let _ = COUNT.try_with(|count| count.set(count.get() + 1));
        }
    });
}

// SAFETY: every call goes unchanged to the system allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller upholds the contract.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, ptr: *mut u8, layout: Layout) {
        count();
        // SAFETY: the caller upholds the contract.
        unsafe { System.dealloc(ptr, layout) }
    }

    unsafe fn realloc(&self, ptr: *mut u8, layout: Layout, new_size: usize) -> *mut u8 {
        count();
        // SAFETY: the caller upholds the contract.
        unsafe { System.realloc(ptr, layout, new_size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// The simulated bus stands for the wire and the devices. Its allocations do not count for the
/// cycle.
#[derive(Debug)]
struct Unmetered(Box<dyn Link>);

fn unmetered<T>(work: impl FnOnce() -> T) -> T {
    let before = METERED.replace(false);
    let result = work();
    METERED.set(before);
    result
}

impl Link for Unmetered {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        unmetered(|| self.0.send(frame))
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        unmetered(|| self.0.recv(buf))
    }

    fn next_arrival(&self) -> Option<Nanos> {
        self.0.next_arrival()
    }
}

/// Both ends of a simulated ring, unmetered.
#[derive(Debug)]
struct UnmeteredEnds(SimRing);

impl RingEnds for UnmeteredEnds {
    fn send(&mut self, from: End, frame: &[u8]) -> Result<(), LinkError> {
        unmetered(|| self.0.send(from, frame))
    }

    fn recv(&mut self, at: End, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        unmetered(|| self.0.recv(at, buf))
    }

    fn next_arrival(&self) -> Option<Nanos> {
        self.0.next_arrival()
    }

    fn main_devices(&self) -> u64 {
        self.0.main_devices()
    }

    fn stats(&mut self) -> LinkStats {
        self.0.stats()
    }
}

#[test]
fn the_counter_counts_allocations() {
    METERED.set(true);
    let boxed = std::hint::black_box(Box::new(1));
    METERED.set(false);
    drop(boxed);
    assert_eq!(COUNT.get(), 1);
}

/// The bus and its recorder above are unmetered. The recorder of a real-time run is not part of the
/// bus, so this test meters it.
#[test]
fn recording_in_the_cycle_allocates_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.pcapng");
    let mut recorder =
        Recorder::create(&path, WriterMode::Background, None, "").expect("a recording");
    let frame = [0x5a; MAX_FRAME];
    COUNT.set(0);
    METERED.set(true);
    for at in 0..1_000 {
        recorder.frame(Direction::Out, at, &frame[..128]);
        recorder.frame(Direction::In, at, &frame);
    }
    METERED.set(false);
    let counted = COUNT.get();
    let stats = recorder.finish().expect("written");
    assert_eq!(stats.written + stats.dropped, 2_000);
    assert!(stats.written > 0);
    assert_eq!(counted, 0);
}

type Ended = Option<Result<(), Error>>;

/// Runs the cycle with its supervisor. Returns the allocations of the cycles, the bytes still
/// allocated, and the supervisor's result.
fn metered(
    machine: Machine,
    options: &Options,
    controller: Option<Box<dyn Controller>>,
    cycles: u64,
) -> (u64, EngineReport, Ended) {
    let attachments = Attachments {
        controller,
        ..Attachments::default()
    };
    let (counted, remains, ended, _) =
        metered_among_users(machine, options, attachments, cycles, 0);
    (counted, remains, ended)
}

/// Returns the simulated bus of a machine. With cable redundancy, only the bus behind both interfaces
/// is not metered.
fn unmetered_bus(machine: &Machine, options: &Options) -> Box<dyn Link> {
    let (seed, faults) = (options.seed, options.faults.as_ref());
    if machine.bus.redundant.is_none() {
        let link = simulated_link(machine, seed, faults).expect("a bus");
        return Box::new(Unmetered(link));
    }
    let bus = simulated_bus(machine, seed, faults, Some(SecondPort::Listens)).expect("a ring");
    let ends = UnmeteredEnds(SimRing(SimLink::new(bus)));
    Box::new(RedundantLink::new(Box::new(ends), machine.bus.cycle_ns / 2))
}

/// Same as `metered`, with repeated mailbox reads of the first devices. Returns the number of
/// transfers as well.
fn metered_among_users(
    machine: Machine,
    options: &Options,
    attachments: Attachments,
    cycles: u64,
    asked: usize,
) -> (u64, EngineReport, Ended, u64) {
    options.clock.enter();
    let (progress, reported) = channel();
    let stop = Arc::<CancelToken>::default();
    // Every cycle also writes its sample.
    let samples = Samples::create(SampleLayout::new(&machine), SAMPLES_NS).expect("memory");
    let link = unmetered_bus(&machine, options);
    let job = RunBuilder {
        machine: &Arc::new(machine),
        options,
        stop,
        progress,
        attachments: Attachments {
            samples: samples.writer(),
            ..attachments
        },
    };
    let Prepared { parts, supervisor } = job.prepare_on(link).expect("comes up");
    let mut engine = Engine::new(parts);
    let mut during = pin!(supervisor.run());
    let mut context = Context::from_waker(Waker::noop());
    let mut result = None;
    let done = Cell::new(0);
    let mut users: Vec<Pin<Box<dyn Future<Output = ()> + '_>>> = Vec::new();

    COUNT.set(0);
    for _ in 0..cycles {
        METERED.set(true);
        engine.cycle();
        METERED.set(false);
        if result.is_none()
            && let Poll::Ready((_, ended)) = during.as_mut().poll(&mut context)
        {
            result = Some(ended);
        }
        for said in reported.try_iter() {
            if let Progress::Mailboxes(mailboxes) = said {
                let names = mailboxes.names().take(asked);
                let each = names.filter_map(|name| mailboxes.device(name).ok());
                users = each.map(|mailbox| reading(mailbox, &done)).collect();
            }
        }
        users.retain_mut(|user| user.as_mut().poll(&mut context).is_pending());
    }
    drop(users);
    (COUNT.get(), engine.finish(), result, done.get())
}

/// Reads expedited and segmented objects until mailbox access closes.
fn reading(mailbox: DeviceMailbox, done: &Cell<u64>) -> Pin<Box<dyn Future<Output = ()> + '_>> {
    Box::pin(async move {
        for (index, sub) in [(0x6041, 0), (0x1008, 0), (0x6064, 0)].into_iter().cycle() {
            if mailbox.upload(index, sub).await.is_err() {
                return;
            }
            done.set(done.get() + 1);
        }
    })
}

#[test]
fn a_hundred_thousand_cycles_allocate_nothing() {
    const CYCLES: u64 = 100_000;
    let script = "[[fault]]\nkind = \"frame-loss\"\nat = \"20s\"\ncount = 2\n\
                  [[fault]]\nkind = \"drive-fault\"\ndevice = 1\nat = \"60s\"\ncode = 0x8611\n";
    let options = Options {
        repeat: Some(1_000_000),
        ..faults(script)
    };
    let (counted, remains, result) = metered(machine(&axes(3)), &options, None, CYCLES);
    assert_eq!(remains.stats.counters.cycles, CYCLES);
    assert!(
        remains.stats.counters.lost_frames >= 1,
        "{:?}",
        remains.stats.counters
    );
    assert!(
        matches!(
            &result,
            Some(Err(Error { cause, .. }))
                if matches!(**cause, Cause::DriveFault { code: Some(0x8611), .. })
        ),
        "{result:?}"
    );
    assert!(remains.axes.iter().all(|slot| slot.last_enabled.is_some()));
    assert_eq!(counted, 0, "allocations in {CYCLES} cycles");
}

#[test]
fn mailbox_transfers_cause_no_allocation_in_the_cycle() {
    let options = Options {
        repeat: Some(1_000_000),
        ..virtual_time()
    };
    let bus = machine(&axes(4));
    let (counted, remains, _, done) =
        metered_among_users(bus, &options, Attachments::default(), 20_000, 3);
    assert!(done > 1_000, "{done} transfers");
    assert_eq!(remains.stats.counters.wkc_errors, 0);
    assert_eq!(counted, 0, "allocations during {done} transfers");
}

/// Covers mode switches, homing, profiles, lines, gears, tables, waves, gantries, cams, inputs and outputs.
#[test]
fn programs_of_every_kind_allocate_nothing() {
    for file in [
        "together.toml",
        "probe.toml",
        "gantry.toml",
        "labeller.toml",
        "outline.toml",
        "profiles.toml",
        "loops.toml",
        "program.toml",
        "mixed.toml",
        "web.toml",
        "sercos.toml",
    ] {
        let machine = Machine {
            repeat: 1,
            ..load(file)
        };
        let (counted, _, result) = metered(machine, &virtual_time(), None, 30_000);
        assert!(matches!(result, Some(Ok(()))), "{file}: {result:?}");
        assert_eq!(counted, 0, "allocations in {file}");
    }
}

/// Copies of single bits, of a PDO and of bytes, while frames are lost and a source is missing.
#[test]
fn copies_allocate_nothing() {
    let device = |name: &str, position: usize| {
        format!("[[device]]\nname = \"{name}\"\nesi = \"esi/IO8.xml\"\nposition = {position}\n")
    };
    let copy = |from: &str, to: &str| format!("[[copy]]\nfrom = \"{from}\"\nto = \"{to}\"\n");
    let text = axes(1)
        + &["i", "j", "k"]
            .map(|name| device(name, usize::from(name.as_bytes()[0] - b'h')))
            .concat()
        + &copy("k.Input 2", "i.Output 7")
        + &copy("a0.bytes.1..2", "j.bytes.0..1")
        + &copy("j.pdo.0x1A00", "k.pdo.0x1600");
    let script = "[[fault]]\nkind = \"frame-loss\"\nat = \"1s\"\ncount = 2\n\
                  [[fault]]\nkind = \"absent\"\ndevice = 3\nat = \"2s\"\n";
    let (counted, remains, result) = metered(machine(&text), &faults(script), None, 10_000);
    assert!(matches!(result, Some(Err(_))), "{result:?}");
    assert!(remains.stats.counters.lost_frames >= 1);
    assert!(remains.axes.iter().all(|slot| slot.last_enabled.is_some()));
    assert_eq!(counted, 0);
}

struct Swing(AxisRef, f64);

impl Controller for Swing {
    fn cycle(&mut self, machine: &mut CycleContext<'_>) {
        if machine.axis(self.0).ready {
            self.1 += machine.dt_s();
            let _ = machine.set_point(self.0, 5.0 - 5.0 * self.1.cos());
        }
    }
}

#[test]
fn a_controller_is_called_without_an_allocation() {
    let machine = load("controller.toml");
    let x = machine.axis("x").expect("an axis");
    let controller = Box::new(Swing(x, 0.0));
    let (counted, remains, _) = metered(machine, &virtual_time(), Some(controller), 5_000);
    assert!(remains.axes[AxisIndex(0)].axis.status().enabled);
    assert_eq!(counted, 0);
}

struct Stalls(AxisRef, u32);

impl Controller for Stalls {
    fn cycle(&mut self, machine: &mut CycleContext<'_>) {
        if !machine.axis(self.0).ready {
            return;
        }
        self.1 += 1;
        if self.1 == 1 {
            let (velocity, ramp) = (5.0, 1.0);
            let _ = machine.command(self.0, Command::Velocity { velocity, ramp });
        } else if self.1.is_multiple_of(500) {
            Clock::Virtual.relax(clock::now() + 40_000_000);
        }
    }
}

/// The handling of skipped cycles does not allocate either.
#[test]
fn skipped_cycles_allocate_nothing() {
    let machine = load("controller.toml");
    let x = machine.axis("x").expect("an axis");
    let controller = Box::new(Stalls(x, 0));
    let (counted, remains, _) = metered(machine, &virtual_time(), Some(controller), 5_000);
    let counters = remains.stats.counters;
    assert!(counters.overruns > 200, "{counters:?}");
    assert!(remains.axes[AxisIndex(0)].axis.status().enabled);
    assert_eq!(counted, 0);
}

/// A device loses its power and returns, while another one moves.
#[test]
fn the_return_of_a_device_allocates_nothing_in_the_cycle() {
    let bus = axes(2);
    let (devices, _) = bus.split_once("\n[[step]]").expect("steps");
    let text = format!(
        "{devices}\n[[stop.group]]\nname = \"g\"\naxes = [\"a1\"]\noutside = \"continue\"\n\
         [[step]]\nenable = true\n[[step]]\nmove = {{ a0 = 80.0 }}\n[[step]]\nmove = {{ a0 = 0.0 }}\n\
         [[step]]\nreset = [\"a1\"]\n[[step]]\nenable = [\"a1\"]\n[[step]]\nmove = {{ a1 = 1.0 }}\n"
    );
    let off = "[[fault]]\nkind = \"power-off\"\ndevice = 1\nat = \"1s\"\nfor = \"500ms\"\n";
    let (counted, remains, result) = metered(machine(&text), &faults(off), None, 20_000);
    assert!(matches!(result, Some(Ok(()))), "{result:?}");
    assert!(remains.stats.counters.wkc_errors > 500);
    assert_eq!(counted, 0);
}

/// A cable of a ring breaks and is repaired.
#[test]
fn a_broken_ring_allocates_nothing_in_the_cycle() {
    let text = axes(4).replace("nic = \"sim\"", "nic = \"sim\"\nredundant = \"sim2\"");
    assert!(text.contains("redundant"));
    let cut =
        "[[fault]]\nkind = \"link-break\"\ndevice = 2\nport = 0\nat = \"1s\"\nfor = \"500ms\"\n";
    let (counted, remains, result) = metered(machine(&text), &faults(cut), None, 20_000);
    assert!(matches!(result, Some(Ok(()))), "{result:?}");
    assert!(remains.stats.counters.lost_frames <= 1);
    assert_eq!(counted, 0);
}

/// Stops of the machine do not allocate either: an emergency, a lost gear, a lost bus, and a group.
#[test]
fn stopping_allocates_nothing() {
    let gear =
        "[[step]]\ngear = { a1 = { to = \"a0\", ratio = 3.0 } }\n[[step]]\nmove = { a0 = 80.0 }\n";
    let emergency = "[stop]\nemergency = { a0.\"0x6064\" = { above = 20000 } }\n";
    let lost = "[[fault]]\nkind = \"silent\"\nat = \"1s\"\n";
    let group = "[[stop.group]]\nname = \"g\"\naxes = [\"a0\"]\noutside = \"continue\"\n\
                 [[step]]\nmove = { a1 = 0.0 }\n[[step]]\nreset = [\"a0\"]\n[[step]]\nmove = { a0 = 0.0 }\n";
    let fault = "[[fault]]\nkind = \"drive-fault\"\ndevice = 0\nat = \"1s\"\ncode = 0x8611\n";
    let bus = axes(2);
    let (devices, _) = bus.split_once("\n[[step]]").expect("steps");
    for (text, options) in [
        (format!("{devices}\n{gear}"), virtual_time()),
        (format!("{bus}\n{emergency}"), virtual_time()),
        (bus.clone(), faults(lost)),
        (
            format!(
                "{devices}\n[[step]]\nvelocity = {{ a0 = 10.0 }}\n[[step]]\nmove = {{ a1 = 80.0 }}\n{group}"
            ),
            faults(fault),
        ),
    ] {
        let (counted, remains, result) = metered(machine(&text), &options, None, 20_000);
        assert!(matches!(result, Some(Err(_))), "{result:?}");
        assert!(remains.axes.iter().all(|slot| slot.last_enabled.is_some()));
        assert_eq!(counted, 0, "{result:?}");
    }
}

/// Set-points of clients: shared memory that is attached, late, refused, stale and replaced, and a
/// stream of points.
struct Clients {
    external: External,
    client: ExternalClient,
    counters: Arc<AreaCounters>,
    memory: Arc<SharedMemory>,
    y: AxisRef,
    cycle: u64,
    ended: Arc<AtomicU64>,
}

impl Clients {
    fn write(&self, kind: u64, position: f64) {
        let words = self.memory.words();
        let values = [
            (words::COUNTER, self.cycle),
            (words::HEADER, kind),
            (words::HEADER + 1, position.to_bits()),
        ];
        words[words::SEQUENCE].fetch_add(1, Ordering::Relaxed);
        for (at, value) in values {
            words[at].store(value, Ordering::Relaxed);
        }
        words[words::SEQUENCE].fetch_add(1, Ordering::Release);
    }

    /// Does what clients and the operator do outside the cycle.
    fn act(&mut self, ready: bool) {
        while let Ok(report) = self.client.reports.pop() {
            if matches!(
                report,
                Report::StreamEnded { .. } | Report::AreaStopped { .. }
            ) {
                self.ended.fetch_add(1, Ordering::Relaxed);
            }
        }
        if !ready {
            return;
        }
        self.cycle += 1;
        let mut send = |message| self.client.messages.push(message).expect("room");
        match self.cycle % 2_000 {
            1 => {
                self.memory = Arc::new(command_area(2).expect("memory"));
                send(Message::Attach(Arc::clone(&self.memory)));
                let config = StreamConfig {
                    interpolation: Interpolation::Linear,
                    interval_s: 0.01,
                    prefill: 1,
                    limits: MotionLimits {
                        velocity: 0.0,
                        acceleration: 0.0,
                        jerk: 0.0,
                    },
                    range: None,
                    dt_s: 0.001,
                };
                let (ticket, axis) = (self.cycle, 1);
                send(Message::Open {
                    ticket,
                    axis,
                    config,
                });
                let knot = Knot {
                    position: 0.0,
                    velocity: 0.0,
                };
                let points = vec![StreamPoint { knot, torque: 1.0 }; 20].into();
                send(Message::Push {
                    ticket,
                    axis,
                    points,
                });
                send(Message::Close { ticket, axis });
            }
            // A sine with late sets, then one that stays away, then a jump.
            phase @ 2..1_000 if phase % 50 > 3 => {
                let t = phase as f64 * 1e-3 * std::f64::consts::TAU;
                self.write(1, 0.1 * (1.0 - t.cos()));
            }
            1_100 => self.write(0, 0.0),
            1_200 => self.write(1, 1e9),
            1_300 => self.write(9, f64::NAN),
            1_900 => send(Message::Release(None)),
            1_901 => {
                self.counters.leases_ended.fetch_add(1, Ordering::Release);
                send(Message::Detach);
            }
            _ => {}
        }
    }
}

impl Controller for Clients {
    fn cycle(&mut self, machine: &mut CycleContext<'_>) {
        let ready = machine.axis(self.y).ready;
        unmetered(|| self.act(ready));
        self.external.cycle(machine);
    }
}

#[test]
fn set_points_of_clients_allocate_nothing_in_the_cycle() {
    let machine = load("controller.toml");
    let y = machine.axis("y").expect("an axis");
    let counters = Arc::<AreaCounters>::default();
    let (external, client) = external(&machine, &counters, None);
    let ended = Arc::<AtomicU64>::default();
    let clients = Clients {
        external,
        client,
        counters: Arc::clone(&counters),
        memory: Arc::new(command_area(2).expect("memory")),
        y,
        cycle: 0,
        ended: Arc::clone(&ended),
    };
    let (counted, remains, _) = metered(machine, &virtual_time(), Some(Box::new(clients)), 10_000);
    assert!(remains.axes[AxisIndex(0)].axis.status().enabled);
    let load = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
    assert!(load(&counters.used) > 3_000, "{counters:?}");
    assert!(load(&counters.late) > 100, "{counters:?}");
    assert!(load(&counters.refused) > 2, "{counters:?}");
    assert!(load(&ended) > 6, "streams and areas ended: {ended:?}");
    assert_eq!(counted, 0);
}
