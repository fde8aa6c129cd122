//! From a machine file to a segment in SafeOp, with everything in place that turns its cycle.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::Sender;
use std::time::Duration;

use ecaxis_axis::Axis;
use ethercrab::{Command as Datagram, MainDevice};

use super::story::Seen;
use super::{Log, Options, Progress, RunError, open, panic_text};
use crate::bringup::{Bus, Step, bring_up, clocks};
use crate::clock::{self, Clock, Nanos};
use crate::config::{Machine, Signal};
use crate::link::Link;
use crate::link::port::{Port, main_device, pump};
use crate::mailbox::Mailboxes;
use crate::mailbox::desk::{self, Desk, Listen, Opening};
use crate::rt::controller::Controller;
use crate::rt::cycle::{Parts, Signals, Timing, first_snapshot};
use crate::rt::exchange::{Exchange, Member};
use crate::rt::groups::Group;
use crate::rt::guard::Guard;
use crate::rt::handover::ends;
use crate::rt::image::{self, AxisBits, Bits, ImagePlan, NotMapped, SignalBits};
use crate::rt::phase::Phase;
use crate::rt::slot::AxisSlot;
use crate::story::Look;
use crate::story::look::{self, Depth};
use crate::supervise::{Supervisor, interruptible};
use crate::wire::{BesideCycle, Datagrams};

/// A segment in SafeOp, with everything in place that turns its cycle.
#[derive(Debug)]
pub struct Prepared {
    pub parts: Parts,
    pub supervisor: Supervisor,
}

/// A run that is to be prepared.
#[derive(Debug)]
pub struct Job<'a> {
    pub machine: &'a Arc<Machine>,
    pub options: &'a Options,
    /// Who may end it.
    pub stop: Arc<AtomicBool>,
    /// Who hears of it.
    pub progress: Sender<Progress>,
    /// In the place of the file's program.
    pub controller: Option<Box<dyn Controller>>,
}

impl Job<'_> {
    /// Opens the link and brings the bus to SafeOp, on the calling thread and its clock
    /// ([`Clock::enter`]).
    pub fn prepare(self) -> Result<Prepared, RunError> {
        self.prepare_seeing(&mut Seen::default())
    }

    /// Likewise; `seen` is what a bus looked like that did not come up.
    pub(super) fn prepare_seeing(self, seen: &mut Seen) -> Result<Prepared, RunError> {
        // Whatever can be known to fail without a bus fails before there is one.
        plan(self.machine)?;
        let link = open::link(self.machine, self.options, |concern| {
            let _ = self.progress.send(Progress::Concern(concern));
        })?;
        self.prepare_with(link, seen)
    }

    /// Likewise, on a link of one's own in the place of the file's `nic`.
    pub fn prepare_on(self, link: Box<dyn Link>) -> Result<Prepared, RunError> {
        self.prepare_with(link, &mut Seen::default())
    }

    pub(super) fn prepare_with(
        self,
        mut link: Box<dyn Link>,
        seen: &mut Seen,
    ) -> Result<Prepared, RunError> {
        let Self {
            machine,
            options,
            stop,
            progress,
            controller,
        } = self;
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
                let (mailboxes, desks) =
                    desks(&mut bus, wire, &exchange, machine.bus.cycle_ns, &log);
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
                    orders_given: 0,
                    refused: VecDeque::new(),
                    captures: Vec::new(),
                    stopped: Vec::new(),
                    limited: Vec::new(),
                    last_status: clock::now(),
                    witnessed: None,
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
                    let stations: Vec<_> = (crate::bringup::FIRST_STATION..)
                        .take(machine.devices.len())
                        .collect();
                    let look = look::at_registers(&wire, &stations, &mut seen.looks, Depth::Whole);
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
        slots.push(AxisSlot::new(axis, bits, index, image.groups[index]));
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
    for (slot, &device) in slots.iter_mut().zip(&axes) {
        let setup = machine.devices[device].axis.as_ref();
        let brake = setup.and_then(|setup| setup.brake_output.clone());
        slot.brake = all(brake.as_slice(), true)?.pop();
    }
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

/// Where nothing more could come, that is the error.
pub(super) fn lacking(error: RunError, link: &dyn Link, before: &str) -> RunError {
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
pub(super) fn go_silent(
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
