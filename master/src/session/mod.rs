//! One run of a machine: opens the link, brings the bus up, turns the cycle, and sums up.
//!
//! One thread owns the link. In real time it becomes the real-time thread and a second one runs
//! the supervisor beside it; in virtual time it does both in turn, so that a run can be repeated.

use std::collections::VecDeque;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::{Sender, channel};
use std::thread;
use std::time::Duration;

use ecaxis_axis::Axis;
use ecaxis_sim::FaultScript;
use ethercrab::{Command as Datagram, MainDevice};

use crate::bringup::{Bus, Step, bring_up, clocks};
use crate::clock::{self, Clock, Nanos};
use crate::config::{Machine, Signal};
use crate::link::Link;
use crate::link::port::{Port, main_device, pump};
use crate::mailbox::Mailboxes;
use crate::mailbox::desk::{self, Desk, Listen, Opening};
use crate::rt::controller::Controller;
use crate::rt::cycle::{Parts, Remains, Signals, Timing, first_snapshot};
use crate::rt::exchange::{Exchange, Member};
use crate::rt::groups::Group;
use crate::rt::guard::Guard;
use crate::rt::handover::ends;
use crate::rt::image::{self, AxisBits, Bits, ImagePlan, NotMapped, SignalBits};
use crate::rt::phase::Phase;
use crate::rt::slot::AxisSlot;
use crate::rt::stats::Stats;
use crate::story::{Look, Story, look};
use crate::supervise::manual::{self, Operator};
use crate::supervise::{Supervisor, interruptible};
use crate::wire::{BesideCycle, Datagrams};

mod emergencies;
mod error;
mod events;
mod open;
mod progress;
mod story;
mod summary;
mod turn;

pub use crate::supervise::history::{DiagnosisKind, DiagnosisMessage};
pub use emergencies::{EmergencyLine, EmergencyReport, Log};
pub use error::{DriveReport, RunError};
pub use events::EventLine;
pub(crate) use events::clock_off;
pub use open::{recorded, simulated_bus, topology};
pub use progress::{AxisLine, Capture, Observer, Progress, Status, StepRef};
use story::{Left, Seen};
use summary::Aside;
pub use summary::{AxisSummary, DeviceErrors, GroupStop, Summary, ThreadSummary};
use turn::Turned;

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
    /// Of a recording; the newest frames are kept, see [`crate::link::capture`].
    pub record_limit: Option<u64>,
    /// Answer from this recording in the place of a bus.
    pub replay: Option<PathBuf>,
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
            record_limit: None,
            replay: None,
            enable: true,
        }
    }
}

/// How a run ended. There is a summary as soon as the cycle has run.
#[derive(Debug)]
pub struct Outcome {
    pub summary: Option<Summary>,
    pub result: Result<(), RunError>,
    /// What the summary is of.
    pub stats: Option<Box<Stats>>,
    /// Of a failure on the bus.
    pub story: Option<Box<Story>>,
}

impl From<RunError> for Outcome {
    fn from(error: RunError) -> Self {
        Self {
            summary: None,
            result: Err(error),
            stats: None,
            story: None,
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
    start(machine, options, stop, observer, Instead::Nobody)
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
    let controller = Instead::Controller(controller);
    start(machine, options, stop, observer, controller)
}

/// Like [`run`], with somebody in the file's program's place: axes are enabled and moved when they ask for it, until they
/// leave or something else ends the run. See [`manual::by_hand`] for what of the file is different.
pub fn run_by_hand(
    machine: Machine,
    options: Options,
    stop: Arc<AtomicBool>,
    observer: &mut dyn Observer,
    operator: Box<dyn Operator>,
) -> Outcome {
    let machine = manual::by_hand(machine);
    let options = Options {
        enable: true,
        ..options
    };
    let operator = Instead::Operator(operator);
    start(machine, options, stop, observer, operator)
}

/// Who takes the place of the file's program.
enum Instead {
    Nobody,
    Controller(Box<dyn Controller>),
    Operator(Box<dyn Operator>),
}

fn start(
    machine: Machine,
    options: Options,
    stop: Arc<AtomicBool>,
    observer: &mut dyn Observer,
    instead: Instead,
) -> Outcome {
    let (progress, told) = channel();
    let owner = thread::Builder::new()
        .name("ecaxis-rt".to_owned())
        .stack_size(STACK)
        .spawn(move || own_the_link(&Arc::new(machine), &options, stop, progress, instead));
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

pub(crate) fn panic_text(panic: &(dyn std::any::Any + Send)) -> String {
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
    let seen = &mut Seen::default();
    prepare_seeing(machine, options, stop, progress, controller, seen)
}

/// Likewise; `seen` is what a bus looked like that did not come up.
fn prepare_seeing(
    machine: &Arc<Machine>,
    options: &Options,
    stop: Arc<AtomicBool>,
    progress: Sender<Progress>,
    controller: Option<Box<dyn Controller>>,
    seen: &mut Seen,
) -> Result<Prepared, RunError> {
    // Whatever can be known to fail without a bus fails before there is one.
    plan(machine)?;
    let link = open::link(machine, options, |concern| {
        let _ = progress.send(Progress::Concern(concern));
    })?;
    prepare_with(link, machine, options, stop, progress, controller, seen)
}

/// Likewise, on a link of one's own in the place of the file's `nic`.
pub fn prepare_on(
    link: Box<dyn Link>,
    machine: &Arc<Machine>,
    options: &Options,
    stop: Arc<AtomicBool>,
    progress: Sender<Progress>,
    controller: Option<Box<dyn Controller>>,
) -> Result<Prepared, RunError> {
    let seen = &mut Seen::default();
    prepare_with(link, machine, options, stop, progress, controller, seen)
}

fn prepare_with(
    mut link: Box<dyn Link>,
    machine: &Arc<Machine>,
    options: &Options,
    stop: Arc<AtomicBool>,
    progress: Sender<Progress>,
    controller: Option<Box<dyn Controller>>,
    seen: &mut Seen,
) -> Result<Prepared, RunError> {
    let (image, ..) = plan(machine)?;
    let (main_device, mut port) = main_device(machine.bus.cycle_ns);
    let carried = Carried {
        clock: options.clock,
        stop: &stop,
        link: link.as_mut(),
        port: &mut port,
    };
    let log = Log::new(progress.clone());
    match come_up(machine, main_device, image, carried, &progress, &log) {
        Ok(mut bus) => {
            let machine = &as_the_drives_say(machine, &bus);
            let (_, slots, axes, signals) = plan(machine)?;
            let wire = Datagrams::new(main_device);
            let timing = Timing {
                cycle_ns: machine.bus.cycle_ns,
                clock_window_ns: machine.bus.clock_window_ns,
                spin: machine.bus.spin,
            };
            let groups = Group::all(machine);
            let patience = groups.iter().map(|group| group.patience).max();
            let clock = options.clock;
            let members = bus.devices.iter().map(|device| Member {
                station: device.at.station,
                clock: device.dc,
                mailbox: device.coe.as_ref().map(|coe| coe.layout().in_sm),
            });
            let members: Vec<_> = members.collect();
            let (rt_end, outer) = ends(&first_snapshot(
                &slots,
                groups.len(),
                &signals,
                members.len(),
            ));
            let mut exchange =
                Exchange::new(&bus.image, bus.dc.as_ref(), &members, machine.bus.exchange);
            hold_outputs(machine, &bus, &mut exchange);
            exchange.stage();
            log.set_sights(exchange.sights());
            let (mailboxes, desks) = desks(&mut bus, wire, &exchange, machine.bus.cycle_ns, &log);
            let _ = progress.send(Progress::Mailboxes(mailboxes.clone()));
            let controlled = controller.is_some();
            let parts = Parts {
                clock,
                timing,
                link,
                port,
                exchange,
                axes: slots,
                groups,
                signals,
                controller,
                tables: machine.tables.iter().map(|t| t.table.clone()).collect(),
                stop: machine.stop.clone(),
                phase: bus.dc.as_ref().map(Phase::new),
                guard: Guard::new(machine.bus.lost_frames, &bus.image.groups),
                end: rt_end,
            };
            let supervisor = Supervisor {
                machine: Arc::clone(machine),
                bus,
                wire,
                mailboxes,
                desks,
                log,
                outer,
                stop,
                progress,
                repeat: options.repeat.unwrap_or(machine.repeat),
                limit: options.limit,
                enable: options.enable,
                controlled,
                operator: None,
                seen: Vec::new(),
                axes,
                stop_patience: patience.unwrap_or(0),
                orders_given: 0,
                refused: VecDeque::new(),
                captures: Vec::new(),
                stopped: Vec::new(),
                last_status: clock::now(),
                looks: Vec::new(),
            };
            Ok(Prepared { parts, supervisor })
        }
        Err(error) => {
            let error = lacking(error, link.as_ref(), "bring-up is over");
            seen.on_the_bus = true;
            // What has panicked may have left anything behind.
            if !matches!(
                error,
                RunError::Interrupted | RunError::Panicked(_) | RunError::Link(_)
            ) {
                seen.looks = vec![Look::default(); machine.devices.len()];
                let wire = Datagrams::new(main_device);
                let look = look::at_registers(&wire, &mut seen.looks);
                let _ = pump(&mut port, link.as_mut(), options.clock, look);
            }
            go_silent(options.clock, main_device, link.as_mut(), &mut port);
            seen.link = link.stats();
            for remark in link.remarks() {
                let _ = progress.send(Progress::Warning(remark));
            }
            // The bring-up's error is the one to report.
            let _ = link.finish();
            Err(error)
        }
    }
}

/// A desk for every mailbox of the bus.
fn desks(
    bus: &mut Bus,
    wire: Datagrams,
    exchange: &Exchange,
    cycle_ns: Nanos,
    log: &Log,
) -> (Mailboxes, Vec<Desk<BesideCycle>>) {
    let wires = BesideCycle::all(wire, &exchange.sights(), bus.devices.len(), cycle_ns);
    let openings = bus.devices.iter_mut().zip(wires).map(|(device, wire)| {
        let mailbox = device.coe.take().map(|coe| (wire, coe));
        let name = device.at.name.clone();
        Opening { name, mailbox }
    });
    let listener: Arc<dyn Listen> = Arc::new(log.clone());
    desk::open(openings, &listener)
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
    let name = |index: usize| machine.devices[index].name.clone();
    let image = image::of(machine).map_err(|source| RunError::TooLarge {
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
        let mut config = setup.config;
        // A report is of the set-point of a cycle earlier.
        config.answers_late = machine.bus.exchange.flights() - 1;
        config.dead_time_s += f64::from(config.answers_late) * machine.bus.cycle_ns as f64 * 1e-9;
        let axis = Axis::new(config).map_err(|source| RunError::Axis {
            name: name(index),
            source,
        })?;
        slots.push(AxisSlot::new(axis, bits, image.groups[index]));
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
    instead: Instead,
) -> Outcome {
    options.clock.enter();
    let told = progress.clone();
    let mut seen = Seen::default();
    let (controller, operator) = match instead {
        Instead::Nobody => (None, None),
        Instead::Controller(controller) => (Some(controller), None),
        Instead::Operator(operator) => (None, Some(operator)),
    };
    let prepared = prepare_seeing(machine, options, stop, progress, controller, &mut seen);
    let Prepared {
        parts,
        mut supervisor,
    } = match prepared {
        Ok(prepared) => prepared,
        Err(error) => {
            return Outcome {
                story: story::of_bring_up(machine, options, &error, seen),
                ..error.into()
            };
        }
    };
    supervisor.operator = operator;
    let wire = supervisor.wire;
    let places = story::places(&supervisor.bus);
    let log = supervisor.log.clone();
    let machine = &Arc::clone(&supervisor.machine);
    let Turned {
        remains,
        result: (mut ended, result),
        used,
    } = match options.clock {
        Clock::Virtual => turn::in_virtual_time(parts, supervisor),
        Clock::Real => match turn::in_real_time(parts, supervisor, &machine.bus, &told) {
            Ok(done) => done,
            Err(error) => return error.into(),
        },
    };
    let Remains {
        mut link,
        mut port,
        axes,
        stats,
        spin_ns,
        diagnoses,
        started,
        history,
        stops,
    } = remains;
    let result = result.map_err(|error| lacking(error, link.as_ref(), "the run does"));
    if result.is_err() {
        go_silent(options.clock, wire.main_device(), link.as_mut(), &mut port);
    }
    let seen = link.stats();
    for remark in link.remarks() {
        let _ = told.send(Progress::Warning(remark));
    }
    let (record, result) = match link.finish() {
        Ok(record) => (record, result),
        Err(error) => (None, result.and(Err(RunError::Record(error.to_string())))),
    };
    let thread = used.map(|(used, wall_ns)| ThreadSummary::new(used, wall_ns, spin_ns, &stats));
    let events = events::lines(&stats.journal, started, machine);
    let story = result.as_ref().err().and_then(|error| {
        let left = Left {
            places,
            looks: std::mem::take(&mut ended.looks),
            diagnoses: &diagnoses,
            stats: &stats,
            axes: &axes,
            history: &history,
            started,
            link: seen,
            events: &events,
        };
        story::of_run(machine, options, error, left)
    });
    let aside = Aside {
        link: seen,
        thread,
        record,
        errors: summary::device_errors(machine, &diagnoses),
        events,
        emergencies: log.lines(started),
        started,
        stops,
    };
    let summary = Summary::new(machine, options.clock, &axes, &stats, ended, aside);
    Outcome {
        summary: Some(summary),
        result,
        stats: Some(Box::new(stats)),
        story,
    }
}

/// Where nothing more could come, that is the error.
fn lacking(error: RunError, link: &dyn Link, before: &str) -> RunError {
    match link.lacks() {
        Some(why) => RunError::Replay(format!("{why} before {before}")),
        None => error,
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
    log: &Log,
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
        let bring_up = Box::pin(bring_up(main_device, machine, image, &mut tell, log));
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

/// Every SubDevice that listens back to Init and without SYNC0, whatever it is doing.
fn go_silent(
    clock: Clock,
    main_device: &'static MainDevice<'static>,
    link: &mut dyn Link,
    port: &mut Port,
) {
    /// A device in Op takes a missing SYNC0 for an error until it has read the request.
    const TO_INIT: Duration = Duration::from_millis(20);
    let all = async |register: u16, value: u16| {
        let datagram = Datagram::bwr(register).ignore_wkc();
        let _ = datagram.send(main_device, value).await;
    };
    let silence = async {
        all(0x0120, 0x0011).await;
        clock::delay(TO_INIT).await;
        all(clocks::ACTIVATION, 0).await;
    };
    let _ = pump(port, link, clock, silence);
}
