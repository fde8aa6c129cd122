//! One run of a machine: opens the link, brings the bus up, turns the cycle, and sums up.
//!
//! One thread owns the link. In real time it becomes the real-time thread and a second one runs
//! the supervisor beside it; in virtual time it does both in turn, so that a run can be repeated.

use std::future::Future;
use std::path::PathBuf;
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::{Sender, channel};
use std::task::{Context, Poll, Waker};
use std::thread;

use ecaxis_axis::Axis;
use ecaxis_sim::FaultScript;
use ethercrab::{Command as Datagram, MainDevice};

use crate::bringup::{Bus, Step, bring_up};
use crate::clock::{Clock, Nanos};
use crate::config::{self, Machine, Signal};
use crate::link::Link;
use crate::link::port::{Port, main_device, pump};
use crate::rt::controller::Controller;
use crate::rt::exchange::Exchange;
use crate::rt::guard::Guard;
use crate::rt::handover::ends;
use crate::rt::image::{self, AxisBits, Bits, ImagePlan, NotMapped, SignalBits};
use crate::rt::phase::Phase;
use crate::rt::slot::AxisSlot;
use crate::rt::{
    self,
    cycle::{Engine, Parts, Remains, Signals, Timing, first_snapshot},
};
use crate::supervise::{Ended, Supervisor, executor, interruptible};
use crate::wire::Datagrams;

mod error;
mod open;
mod progress;
mod summary;

pub use error::RunError;
pub use open::{simulated_bus, topology};
pub use progress::{AxisLine, Observer, Progress, Status, StepRef};
pub use summary::{AxisSummary, Summary};

/// Stack of the thread that owns the link; ethercrab's futures hold its tables by value.
const STACK: usize = 16 * 1024 * 1024;

/// How a machine is run.
#[derive(Debug, Clone)]
pub struct Options {
    pub clock: Clock,
    /// Time limit of the program; it is repeated until then.
    pub limit: Option<Nanos>,
    /// Runs of the program instead of the file's.
    pub repeat: Option<u32>,
    /// Of the simulated bus.
    pub seed: u64,
    pub faults: Option<FaultScript>,
    /// Keep every frame here.
    pub record: Option<PathBuf>,
    /// Enable the axes and run the program; otherwise stay in Op without power.
    pub enable: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            clock: Clock::Real,
            limit: None,
            repeat: None,
            seed: 1,
            faults: None,
            record: None,
            enable: true,
        }
    }
}

/// How a run ended. There is a summary as soon as the cycle has run.
#[derive(Debug)]
pub struct Outcome {
    pub summary: Option<Summary>,
    pub result: Result<(), RunError>,
}

impl From<RunError> for Outcome {
    fn from(error: RunError) -> Self {
        Self {
            summary: None,
            result: Err(error),
        }
    }
}

/// Runs a machine until its program, its time limit, `stop` or an error ends it. Blocks; tells the
/// observer meanwhile.
pub fn run(
    machine: Machine,
    options: Options,
    stop: Arc<AtomicBool>,
    observer: &mut dyn Observer,
) -> Outcome {
    start(machine, options, stop, observer, None)
}

/// Like [`run`], with a controller of one's own in the place of the file's program: all axes are enabled, then they are
/// its until it calls [`rt::controller::Cycle::finish`], or something else ends the run.
pub fn run_with(
    machine: Machine,
    options: Options,
    stop: Arc<AtomicBool>,
    observer: &mut dyn Observer,
    controller: Box<dyn Controller>,
) -> Outcome {
    start(machine, options, stop, observer, Some(controller))
}

fn start(
    machine: Machine,
    options: Options,
    stop: Arc<AtomicBool>,
    observer: &mut dyn Observer,
    controller: Option<Box<dyn Controller>>,
) -> Outcome {
    let (progress, told) = channel();
    let owner = thread::Builder::new()
        .name("ecaxis-rt".to_owned())
        .stack_size(STACK)
        .spawn(move || own_the_link(&Arc::new(machine), &options, stop, progress, controller));
    let owner = match owner {
        Ok(owner) => owner,
        Err(error) => return RunError::Thread(error.to_string()).into(),
    };
    for progress in told {
        observer.progress(&progress);
    }
    owner
        .join()
        .unwrap_or_else(|panic| RunError::Panicked(panic_text(&*panic)).into())
}

fn panic_text(panic: &(dyn std::any::Any + Send)) -> String {
    panic
        .downcast_ref::<String>()
        .cloned()
        .or_else(|| panic.downcast_ref::<&str>().map(|text| (*text).to_owned()))
        .unwrap_or_else(|| "unknown cause".to_owned())
}

/// A segment in SafeOp, with everything in place that turns its cycle.
#[derive(Debug)]
pub struct Prepared {
    pub parts: Parts,
    pub supervisor: Supervisor,
}

/// Opens the link and brings the bus to SafeOp, on the calling thread and its clock
/// ([`Clock::enter`]).
pub fn prepare(
    machine: &Arc<Machine>,
    options: &Options,
    stop: Arc<AtomicBool>,
    progress: Sender<Progress>,
    controller: Option<Box<dyn Controller>>,
) -> Result<Prepared, RunError> {
    // Whatever can be known to fail without a bus fails before there is one.
    let (image, ..) = plan(machine)?;
    let mut link = open::link(machine, options)?;
    let (main_device, mut port) = main_device(machine.bus.cycle_ns);
    let carried = Carried {
        clock: options.clock,
        stop: &stop,
        link: link.as_mut(),
        port: &mut port,
    };
    match come_up(machine, main_device, image, carried, &progress) {
        Ok(bus) => {
            let machine = &as_the_drives_say(machine, &bus);
            let (_, slots, axes, signals) = plan(machine)?;
            let wire = Datagrams::new(main_device);
            let timing = Timing {
                cycle_ns: machine.bus.cycle_ns,
                spin_ns: machine.bus.spin_ns,
                stop_patience_ns: stop_patience(machine),
            };
            let clock = options.clock;
            let stations: Vec<u16> = bus.devices.iter().map(|d| d.at.station).collect();
            let (rt_end, outer) = ends(&first_snapshot(&slots, &signals, stations.len()));
            let mut exchange = Exchange::new(&bus.image, bus.dc.as_ref(), &stations);
            hold_outputs(machine, &bus, &mut exchange);
            exchange.stage();
            let controlled = controller.is_some();
            let parts = Parts {
                clock,
                timing,
                link,
                port,
                exchange,
                axes: slots,
                signals,
                controller,
                tables: machine.tables.iter().map(|t| t.table.clone()).collect(),
                stop: machine.stop.clone(),
                phase: bus.dc.as_ref().map(Phase::new),
                guard: Guard::new(
                    machine.bus.lost_frames,
                    u16::try_from(stations.len()).unwrap_or(u16::MAX),
                ),
                end: rt_end,
            };
            let supervisor = Supervisor {
                machine: Arc::clone(machine),
                bus,
                wire,
                outer,
                stop,
                progress,
                repeat: options.repeat.unwrap_or(machine.repeat),
                limit: options.limit,
                enable: options.enable,
                controlled,
                axes,
                stop_patience: timing.stop_patience_ns,
                orders_given: 0,
                refused: None,
                last_status: crate::clock::now(),
                listened: (crate::clock::now(), 0),
            };
            Ok(Prepared { parts, supervisor })
        }
        Err(error) => {
            go_silent(options.clock, main_device, link.as_mut(), &mut port);
            // The bring-up's error is the one to report.
            let _ = link.finish();
            Err(error)
        }
    }
}

/// The machine with its axes in the drives' own units.
fn as_the_drives_say(machine: &Machine, bus: &Bus) -> Arc<Machine> {
    let mut machine = machine.clone();
    for (device, found) in bus.devices.iter().enumerate() {
        if let Some(adopted) = &found.adopted {
            machine.adopt(device, adopted);
        }
    }
    Arc::new(machine)
}

type Plan = (ImagePlan, Vec<AxisSlot>, Vec<usize>, Signals);

/// The process image, and every axis with its place in it.
fn plan(machine: &Machine) -> Result<Plan, RunError> {
    let layouts = machine.devices.iter().map(|d| &d.selection.layout);
    let sizes: Vec<_> = layouts.map(|l| (l.rx_bytes(), l.tx_bytes())).collect();
    let name = |index: usize| machine.devices[index].name.clone();
    let image = image::plan(&sizes).map_err(|source| RunError::TooLarge {
        name: name(source.device),
        source,
    })?;
    let mut slots = Vec::new();
    let mut axes = Vec::new();
    for (index, (device, region)) in machine.devices.iter().zip(&image.regions).enumerate() {
        let (Some(setup), Some(region)) = (&device.axis, region) else {
            continue;
        };
        let bits = AxisBits::new(&device.selection.layout, region).map_err(|source| {
            RunError::NotMapped {
                name: name(index),
                source,
            }
        })?;
        let axis = Axis::new(setup.config).map_err(|source| RunError::Axis {
            name: name(index),
            source,
        })?;
        slots.push(AxisSlot::new(axis, bits));
        axes.push(index);
    }
    let bits = |signal: &Signal, output: bool| {
        let region = image.regions.get(signal.device)?.as_ref()?;
        let len = if output {
            region.out_len
        } else {
            region.in_len
        };
        let bits = Bits::new(&signal.field, region.offset, len)?;
        let kind = signal.kind();
        Some(SignalBits { bits, kind })
    };
    let all = |signals: &[Signal], output: bool| {
        let each = signals.iter().map(|signal| {
            bits(signal, output).ok_or_else(|| RunError::NotMapped {
                name: signal.name.clone(),
                source: NotMapped {
                    index: signal.field.index,
                    sub: signal.field.sub,
                },
            })
        });
        each.collect::<Result<Vec<_>, _>>()
    };
    let signals = Signals {
        inputs: all(&machine.inputs, false)?,
        outputs: all(&machine.outputs, true)?,
    };
    Ok((image, slots, axes, signals))
}

/// From full speed to rest within the limits of the slowest axis, and a second for the drive.
fn stop_patience(machine: &Machine) -> Nanos {
    let setups = machine.devices.iter().filter_map(|d| d.axis.as_ref());
    let slowest = setups
        .map(|setup| setup.config.limits.velocity / setup.config.limits.acceleration)
        .fold(0.0, f64::max);
    // Longer than an hour is as good as for ever; the cast saturates.
    1_000_000_000 + (slowest.min(3600.0) * 1e9) as Nanos
}

/// Puts the outputs that no axis drives to the values that their drives hold.
fn hold_outputs(machine: &Machine, bus: &Bus, exchange: &mut Exchange) {
    let devices = machine.devices.iter().zip(&bus.devices);
    for ((config, device), region) in devices.zip(&bus.image.regions) {
        let Some(region) = region else { continue };
        for &(index, sub, value) in &device.held {
            let field = config.selection.layout.rx_field(index, sub);
            if let Some(bits) = field.and_then(|f| Bits::new(f, region.offset, region.out_len)) {
                bits.set(exchange.outputs_mut(), value);
            }
        }
    }
}

fn own_the_link(
    machine: &Arc<Machine>,
    options: &Options,
    stop: Arc<AtomicBool>,
    progress: Sender<Progress>,
    controller: Option<Box<dyn Controller>>,
) -> Outcome {
    options.clock.enter();
    let told = progress.clone();
    let Prepared { parts, supervisor } = match prepare(machine, options, stop, progress, controller)
    {
        Ok(prepared) => prepared,
        Err(error) => return error.into(),
    };
    let wire = supervisor.wire;
    let machine = &Arc::clone(&supervisor.machine);
    let (remains, (ended, result)) = match options.clock {
        Clock::Virtual => turn_in_virtual_time(parts, supervisor),
        Clock::Real => match turn_in_real_time(parts, supervisor, &machine.bus, &told) {
            Ok(done) => done,
            Err(error) => return error.into(),
        },
    };
    let Remains {
        mut link,
        mut port,
        axes,
        stats,
    } = remains;
    if result.is_err() {
        go_silent(options.clock, wire.main_device(), link.as_mut(), &mut port);
    }
    let (record, result) = match link.finish() {
        Ok(record) => (record, result),
        Err(error) => (None, result.and(Err(RunError::Record(error.to_string())))),
    };
    let summary = Summary::new(machine, options.clock, &axes, &stats, ended, record);
    Outcome {
        summary: Some(summary),
        result,
    }
}

/// What carries the bring-up's frames, and what may end it.
struct Carried<'a> {
    clock: Clock,
    stop: &'a AtomicBool,
    link: &'a mut dyn Link,
    port: &'a mut Port,
}

fn come_up(
    machine: &Machine,
    main_device: &'static MainDevice<'static>,
    image: ImagePlan,
    carried: Carried<'_>,
    progress: &Sender<Progress>,
) -> Result<Bus, RunError> {
    let mut tell = |step| {
        let _ = progress.send(match step {
            Step::Warning(text) => Progress::Warning(text),
            step => Progress::Step(step),
        });
    };
    let Carried {
        clock,
        stop,
        link,
        port,
    } = carried;
    // ethercrab panics on some things a wire can carry (a SubDevice without an open port, say).
    let run = std::panic::AssertUnwindSafe(|| {
        let bring_up = Box::pin(bring_up(main_device, machine, image, &mut tell));
        pump(port, link, clock, interruptible(stop, bring_up))
    });
    match std::panic::catch_unwind(run) {
        Ok(Ok(Some(Ok(bus)))) => Ok(bus),
        Ok(Ok(Some(Err(error)))) => Err(RunError::BringUp(Box::new(error))),
        Ok(Ok(None)) => Err(RunError::Interrupted),
        Ok(Err(error)) => Err(RunError::Link(error)),
        Err(panic) => Err(RunError::Panicked(panic_text(&*panic))),
    }
}

/// Every SubDevice that listens back to Init, whatever it is doing.
fn go_silent(
    clock: Clock,
    main_device: &'static MainDevice<'static>,
    link: &mut dyn Link,
    port: &mut Port,
) {
    let init = Datagram::bwr(0x0120)
        .ignore_wkc()
        .send(main_device, 0x0011_u16);
    let _ = pump(port, link, clock, init);
}

type Turned = (Remains, (Ended, Result<(), RunError>));

/// The supervisor gets its turn after every cycle.
fn turn_in_virtual_time(parts: Parts, supervisor: Supervisor) -> Turned {
    let mut engine = Engine::new(parts);
    let mut beside = pin!(supervisor.run());
    let mut context = Context::from_waker(Waker::noop());
    let mut result = None;
    while !engine.halted() {
        engine.cycle();
        if result.is_none()
            && let Poll::Ready(done) = beside.as_mut().poll(&mut context)
        {
            result = Some(done);
        }
    }
    (engine.into_remains(), result.unwrap_or_else(died))
}

fn turn_in_real_time(
    parts: Parts,
    supervisor: Supervisor,
    config: &config::Bus,
    told: &Sender<Progress>,
) -> Result<Turned, RunError> {
    // Started first, because a thread inherits the scheduling class and CPU of its parent.
    let beside = thread::Builder::new()
        .name("ecaxis-mailbox".to_owned())
        .spawn(move || executor::block_on(supervisor.run()))
        .map_err(|error| RunError::Thread(error.to_string()))?;
    for denied in rt::thread::prepare(config.priority, config.cpu) {
        let _ = told.send(Progress::Denied(denied));
    }
    // Locking the memory takes milliseconds; the first cycle is due one cycle from here.
    let mut engine = Engine::new(parts);
    while !engine.halted() {
        engine.cycle();
    }
    let result = match beside.join() {
        Ok(Ok(result)) => result,
        Ok(Err(error)) => (Ended::default(), Err(RunError::Thread(error.to_string()))),
        Err(panic) => (
            Ended::default(),
            Err(RunError::Panicked(panic_text(&*panic))),
        ),
    };
    Ok((engine.into_remains(), result))
}

fn died() -> (Ended, Result<(), RunError>) {
    (
        Ended::default(),
        Err(RunError::Panicked("the supervisor ended early".to_owned())),
    )
}
