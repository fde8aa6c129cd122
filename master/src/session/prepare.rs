//! Brings the segment from a machine file to SafeOp and prepares everything that the cycle needs.

use std::collections::VecDeque;
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use ecaxis_axis::{Axis, DriveWords, SercosWords};
use ecaxis_ecat::index::{AxisIndex, DeviceIndex, IndexVec};
use ecaxis_ecat::registers;
use ethercrab::MainDevice;

use super::fault_evidence::BringUpEvidence;
use super::{Attachments, Cause, EmergencyLog, Error, Options, Progress, open, panic_text};
use crate::acyclic::{AlState, al};
use crate::bringup::{Bus, Step, bring_up};
use crate::cancel::CancelToken;
use crate::clock::{self, Clock, Nanos};
use crate::config::{Machine, Signal};
use crate::datagram::{CyclicMailboxTransport, DatagramClient};
use crate::eoe::{EoeNetwork, Ethernet};
use crate::link::Link;
use crate::link::pdu_loop::{PduLoop, drive_pdu_loop, main_device};
use crate::mailbox::Mailboxes;
use crate::mailbox::worker::{self, EmergencySink, MailboxWorker, WorkerConfig};
use crate::post_mortem::DeviceSnapshot;
use crate::post_mortem::snapshot::{self, Depth};
use crate::report::{DeviceLog, FailedStep};
use crate::rt::axis::RtAxis;
use crate::rt::channel::channel;
use crate::rt::common_time::CommonTime;
use crate::rt::cycle::{EngineConfig, Signals, first_snapshot};
use crate::rt::exchange::{Exchange, ExchangeDevice};
use crate::rt::gateway::{Gateway, GatewayConfig, NodePlace};
use crate::rt::image::{self, AxisBits, BitField, DeviceRegion, ImagePlan, NotMapped, SignalBits};
use crate::rt::phase::Phase;
use crate::rt::position_output::PositionOutput;
use crate::supervise::{Buttons, MissedTargets, ReportedLimits, RingWatch, Supervisor};

/// A segment in SafeOp with everything that the cycle needs.
#[derive(Debug)]
pub struct Prepared {
    pub parts: EngineConfig,
    pub supervisor: Supervisor,
}

/// The inputs of a run.
#[derive(Debug)]
pub struct RunBuilder<'a> {
    pub machine: &'a Arc<Machine>,
    pub options: &'a Options,
    /// The token that stops the run.
    pub stop: Arc<CancelToken>,
    /// The receiver of progress reports.
    pub progress: Sender<Progress>,
    pub attachments: Attachments,
}

impl RunBuilder<'_> {
    /// Opens the link and brings the bus to SafeOp, on the calling thread and its clock
    /// ([`Clock::enter`]).
    pub fn prepare(self) -> Result<Prepared, Error> {
        self.prepare_with_evidence(&mut BringUpEvidence::default())
    }

    /// Like `prepare`; fills `seen` if the bus does not come up.
    pub(super) fn prepare_with_evidence(
        self,
        seen: &mut BringUpEvidence,
    ) -> Result<Prepared, Error> {
        // Errors that need no bus are found before the link opens.
        plan(self.machine)?;
        let link = open::link(self.machine, self.options, |concern| {
            let _ = self.progress.send(Progress::Concern(concern));
        })?;
        self.prepare_with(link, seen)
    }

    /// Like [`RunBuilder::prepare`], on the given link instead of the file's `nic`.
    pub fn prepare_on(self, link: Box<dyn Link>) -> Result<Prepared, Error> {
        self.prepare_with(link, &mut BringUpEvidence::default())
    }

    pub(super) fn prepare_with(
        self,
        mut link: Box<dyn Link>,
        seen: &mut BringUpEvidence,
    ) -> Result<Prepared, Error> {
        let Self {
            machine,
            options,
            stop,
            progress,
            attachments,
        } = self;
        let image = plan(machine)?.image;
        let (main_device, mut port) = main_device(machine.bus.cycle_ns, machine.pre_op_timeout());
        let carried = BringUpIo {
            clock: options.clock,
            stop: &stop,
            link: link.as_mut(),
            port: &mut port,
        };
        let log = EmergencyLog::new(progress.clone());
        match bring_up_catching_panics(machine, main_device, image, carried, &progress, &log) {
            Ok(mut bus) => {
                let machine = &apply_drive_units(machine, &bus);
                let CyclePlan {
                    axes: slots,
                    gateways,
                    signals,
                    image: _,
                } = plan(machine)?;
                let wire = DatagramClient::new(main_device).in_ring(link.ring());
                let config = machine.rt_config();
                let clock = options.clock;
                let members = bus.devices.iter().map(|device| ExchangeDevice {
                    station: device.at.station,
                    clock: device.follows,
                    mailbox: device.client().map(|client| client.layout().in_sm),
                });
                let members: Vec<_> = members.collect();
                let (rt_end, outer) = channel(&first_snapshot(
                    &slots,
                    (config.groups.len(), config.line_shafts.len()),
                    &signals,
                    members.len(),
                ));
                let mut exchange =
                    Exchange::new(&bus.image, bus.dc.as_ref(), &members, config.exchange);
                preset_outputs(machine, &bus, &mut exchange);
                exchange.keep_initial_outputs();
                exchange.stage();
                let bus_status = exchange.bus_status();
                for (device, _) in bus.devices.enumerate().filter(|(_, d)| !d.present) {
                    bus_status.set_presence(device, false, true);
                }
                log.set_bus_status(Arc::clone(&bus_status));
                let network = connect(machine, &mut bus);
                let (mailboxes, workers) =
                    mailbox_workers(&mut bus, wire, &exchange, machine.bus.cycle_ns, &log);
                let _ = progress.send(Progress::Topology(bus.places()));
                if let Some(ring) = wire.ring_status() {
                    let _ = progress.send(Progress::RingStatus(ring));
                }
                let _ = progress.send(Progress::Mailboxes(mailboxes.clone()));
                let Attachments {
                    controller,
                    operator,
                    samples,
                    link: _,
                    control,
                    ethernet,
                    setpoints,
                } = attachments;
                let sim_inputs = link.take_sim_inputs();
                let controlled = controller.is_some();
                let parts = EngineConfig {
                    clock,
                    config,
                    link,
                    port,
                    exchange,
                    axes: slots,
                    gateways,
                    signals,
                    controller,
                    samples,
                    tables: machine.tables.clone().into(),
                    setpoints,
                    phase: bus.dc.as_ref().map(Phase::new),
                    common: CommonTime::new(machine.bus.cycle_ns, bus.dc.as_ref()),
                    end: rt_end,
                };
                let ring = RingWatch::new(bus.ring);
                let ring_delays = bus.ring_delays.clone();
                let ring_delays = ring_delays.map(|delays| Arc::new(Mutex::new(delays)));
                let supervisor = Supervisor {
                    machine: Arc::clone(machine),
                    bus,
                    wire,
                    mailboxes,
                    workers,
                    log,
                    outer,
                    stop,
                    progress,
                    repeat: options.repeat.unwrap_or(machine.repeat),
                    limit: options.limit,
                    enable: options.enable,
                    controlled,
                    operator,
                    attendance: None,
                    seen: Vec::new(),
                    limited: vec![ReportedLimits::default(); machine.axes.len()].into(),
                    missed: MissedTargets::default(),
                    commands_sent: 0,
                    refused: VecDeque::new(),
                    captures: Vec::new(),
                    stopped: Vec::new(),
                    last_status: clock::now(),
                    witnessed: None,
                    bus_status,
                    clock_tree: None,
                    returns: None,
                    ring,
                    start: None,
                    variables: Vec::new(),
                    control,
                    sim_inputs,
                    buttons: Buttons::default(),
                    mailbox_gateway: None,
                    resets: None,
                    inquiries: None,
                    inquired: None,
                    ethernet: Ethernet::new(
                        network,
                        ethernet,
                        machine.tap.as_ref().map_or("interface", |tap| &tap.name),
                    ),
                    ring_delays,
                    device_log: DeviceLog::default(),
                };
                Ok(Prepared { parts, supervisor })
            }
            Err(error) => {
                let error = prefer_replay_end(error, link.as_ref(), "bring-up is over");
                seen.on_the_bus = true;
                // A panic may have left the link in any state.
                if !matches!(
                    *error.cause,
                    Cause::Interrupted | Cause::Panicked(_) | Cause::Link(_)
                ) {
                    seen.looks = vec![DeviceSnapshot::default(); machine.devices.len()];
                    let wire = DatagramClient::without_cycle(main_device).in_ring(link.ring());
                    let stations: Vec<_> = (crate::acyclic::enumerate::FIRST_STATION..)
                        .take(machine.devices.len())
                        .collect();
                    let look =
                        snapshot::read_registers(&wire, &stations, &mut seen.looks, Depth::Whole);
                    let _ = drive_pdu_loop(&mut port, link.as_mut(), options.clock, look);
                }
                broadcast_init(options.clock, main_device, link.as_mut(), &mut port);
                seen.link = link.stats();
                for remark in link.notices() {
                    let _ = progress.send(Progress::Warning(remark));
                }
                // The error of the bring-up takes precedence.
                let _ = link.finish();
                Err(error)
            }
        }
    }
}

/// Connects the mailboxes of the devices with EoE with the virtual switch.
fn connect(machine: &Machine, bus: &mut Bus) -> EoeNetwork {
    let network = EoeNetwork::default();
    for (config, device) in machine.devices.iter().zip(bus.devices.iter_mut()) {
        if let (Some(eoe), Some(coe)) = (&config.eoe, device.coe.as_mut()) {
            coe.connect(network.add_device(&config.name, eoe.time_stamps));
        }
    }
    network
}

/// Creates a mailbox worker for every device of the bus.
fn mailbox_workers(
    bus: &mut Bus,
    wire: DatagramClient,
    exchange: &Exchange,
    cycle_ns: Nanos,
    log: &EmergencyLog,
) -> (Mailboxes, Vec<MailboxWorker<CyclicMailboxTransport>>) {
    let wires =
        CyclicMailboxTransport::all(wire, &exchange.bus_status(), bus.devices.len(), cycle_ns);
    let openings = bus.devices.iter_mut().zip(wires).map(|(device, wire)| {
        let mailbox = device.take_client().map(|client| (wire, client));
        let name = device.at.name.clone();
        WorkerConfig { name, mailbox }
    });
    let listener: Arc<dyn EmergencySink> = Arc::new(log.clone());
    worker::open(openings, &listener)
}

/// Returns the machine with its axes in the drives' own units. The absolute encoder of a device that
/// has taken the place of another has no home.
fn apply_drive_units(machine: &Machine, bus: &Bus) -> Arc<Machine> {
    let mut machine = machine.clone();
    for axis in &mut *machine.axes {
        let kept = machine.devices[axis.device].parameters.as_ref();
        let serial = bus.devices[axis.device].serial;
        axis.config.absolute &= kept.is_none_or(|kept| kept.is_of(serial));
    }
    for (axis, adopted) in bus.devices.iter().flat_map(|found| &found.adopted) {
        machine.adopt(*axis, adopted);
    }
    Arc::new(machine)
}

/// The process image, the axes and gateways with their offsets in it, and the signals.
struct CyclePlan {
    image: ImagePlan,
    axes: IndexVec<AxisIndex, RtAxis>,
    gateways: Box<[Gateway]>,
    signals: Signals,
}

/// Returns the process image and the axes with their offsets in it.
fn plan(machine: &Machine) -> Result<CyclePlan, Error> {
    let name = |index: DeviceIndex| machine.devices[index].name.as_str();
    let image = image::of(&machine.rt_config()).map_err(|error| {
        let device = error.device;
        Cause::TooLarge(error).with_name(name(device))
    })?;
    let (mut slots, mut gateways) = (Vec::new(), Vec::new());
    for setup in &*machine.axes {
        let index = setup.device;
        let layout = &machine.devices[index].selection_of(setup).layout;
        // Without process data, nothing is mapped there.
        let region = image.regions[index].unwrap_or(DeviceRegion::EMPTY);
        let bits = AxisBits::new(layout, &region)
            .map_err(|error| Cause::NotMapped(error).with_name(&setup.name))?;
        let mut config = setup.config;
        // A feedback value belongs to the set-point of an earlier cycle.
        config.answers_late = machine.bus.exchange.frame_sets() - 1;
        config.dead_time_s += f64::from(config.answers_late) * machine.bus.cycle_ns as f64 * 1e-9;
        let axis = Axis::compensated(config, setup.compensation.clone())
            .map_err(|error| Cause::Axis(error).with_name(&setup.name))?;
        let mut slot = RtAxis::new(axis, bits, index, image.groups[index]);
        if let Some(soe) = machine.devices[index].device.soe_only() {
            slot.words = DriveWords::Sercos(SercosWords::new(soe.follows_bit));
        }
        if let Some(node) = setup.node {
            let gateway = gateways.iter().position(|g: &Gateway| g.device() == index);
            let number = gateway.unwrap_or(gateways.len());
            if gateway.is_none() {
                gateways.push(Gateway::new(gateway_config(machine, index, &region)));
            }
            let place = NodePlace {
                gateway: number,
                node,
            };
            slot.cycles = gateways.get(number).map_or(1, Gateway::sync_cycles);
            slot.node = Some(place);
        }
        slots.push(slot);
    }
    let bits = |signal: &Signal, output: bool| {
        let region = image.regions.get(signal.device)?.as_ref()?;
        let len = if output {
            region.out_len
        } else {
            region.in_len
        };
        let bits = BitField::new(&signal.field, region.offset, len)?;
        let kind = signal.kind();
        Some(SignalBits { bits, kind })
    };
    let all = |signals: &[Signal], output: bool| {
        let each = signals.iter().map(|signal| {
            bits(signal, output).ok_or_else(|| {
                let (index, sub) = (signal.field.index, signal.field.sub);
                Cause::NotMapped(NotMapped { index, sub }).with_name(&signal.name)
            })
        });
        each.collect::<Result<Vec<_>, _>>()
    };
    let signals = Signals {
        inputs: all(&machine.inputs, false)?,
        outputs: all(&machine.outputs, true)?,
        positions: machine
            .position_outputs
            .iter()
            .map(|setup| {
                let bits = all(std::slice::from_ref(&setup.output), true)?;
                Ok(bits.into_iter().map(|output| PositionOutput {
                    output,
                    trigger: setup.trigger.clone(),
                }))
            })
            .collect::<Result<Vec<_>, Error>>()?
            .into_iter()
            .flatten()
            .collect(),
    };
    for (slot, setup) in slots.iter_mut().zip(&machine.axes) {
        slot.brake = all(setup.brake_output.as_slice(), true)?.pop();
        let encoder = all(setup.second_encoder.as_slice(), false)?.pop();
        let device = setup.second_encoder.as_ref().map(|input| input.device);
        slot.second_encoder = encoder.zip(device);
    }
    Ok(CyclePlan {
        image,
        axes: slots.into(),
        gateways: gateways.into(),
        signals,
    })
}

/// The time within which a gateway acknowledges a command, in ns. It does so within two of its
/// cycles of 1 ms.
const ACKNOWLEDGE_NS: u64 = 50_000_000;

fn gateway_config(machine: &Machine, device: DeviceIndex, region: &DeviceRegion) -> GatewayConfig {
    let cycle_ns = machine.bus.cycle_ns;
    let cycles = |ns: u64| u32::try_from(ns / cycle_ns).unwrap_or(u32::MAX);
    let setup = machine.devices[device].gateway.as_ref();
    let nodes = setup.map_or(&[][..], |gateway| &gateway.nodes);
    GatewayConfig {
        device,
        inputs: region.offset..region.offset + region.in_len,
        outputs: region.offset..region.offset + region.out_len,
        sync_cycles: cycles(setup.map_or(cycle_ns, |gateway| gateway.sync_ns)),
        nodes: nodes.iter().map(|node| node.id).collect(),
        timeout_cycles: cycles(ACKNOWLEDGE_NS).max(20),
    }
}

/// Sets the outputs that no axis drives to the values that their drives hold.
fn preset_outputs(machine: &Machine, bus: &Bus, exchange: &mut Exchange) {
    let devices = machine.devices.iter().zip(&bus.devices);
    for ((config, device), region) in devices.zip(&bus.image.regions) {
        let Some(region) = region else { continue };
        for &(index, sub, value) in &device.held {
            let field = config.selection.layout.rx_field(index, sub);
            if let Some(bits) = field.and_then(|f| BitField::new(f, region.offset, region.out_len))
            {
                bits.set(exchange.outputs_mut(), value);
            }
        }
    }
}

/// Returns the end of the recording as the error if a replay has run out of frames.
pub(super) fn prefer_replay_end(error: Error, link: &dyn Link, before: &str) -> Error {
    match link.exhausted_reason() {
        Some(why) => Cause::Replay(format!("{why} before {before}")).into(),
        None => error,
    }
}

/// The I/O of a bring-up and its stop conditions.
struct BringUpIo<'a> {
    clock: Clock,
    stop: &'a CancelToken,
    link: &'a mut dyn Link,
    port: &'a mut PduLoop,
}

fn bring_up_catching_panics(
    machine: &Machine,
    main_device: &'static MainDevice<'static>,
    image: ImagePlan,
    carried: BringUpIo<'_>,
    progress: &Sender<Progress>,
    log: &EmergencyLog,
) -> Result<Bus, Error> {
    let report = |step| {
        let _ = progress.send(match step {
            Step::Warning(text) => Progress::Warning(text),
            step => Progress::Step(step),
        });
    };
    let BringUpIo {
        clock,
        stop,
        link,
        port,
    } = carried;
    // ethercrab panics on some wire content, for example on a SubDevice without an open port.
    let run = std::panic::AssertUnwindSafe(|| {
        let answers = port.scan_answers.clone();
        // ethercrab's tables make the future large: nothing holds it on the stack.
        let wire = DatagramClient::without_cycle(main_device)
            .in_ring(link.ring())
            .on_interface(link.nic());
        let bring_up = Box::pin(bring_up(wire, &answers, machine, image, &report, log));
        drive_pdu_loop(port, link, clock, stop.run_until_requested(bring_up))
    });
    match std::panic::catch_unwind(run) {
        Ok(Ok(Some(Ok(bus)))) => Ok(bus),
        Ok(Ok(Some(Err(error)))) => Err(error.with_step(FailedStep::BringUp)),
        Ok(Ok(None)) => Err(Cause::Interrupted.into()),
        Ok(Err(error)) => Err(Cause::Link(error).into()),
        Err(panic) => Err(Cause::Panicked(panic_text(&*panic)).into()),
    }
}

/// Requests Init from all SubDevices and switches SYNC0 off, in any state. Errors are acknowledged
/// one by one: a device with device emulation must not receive the acknowledge bit.
pub(super) fn broadcast_init(
    clock: Clock,
    main_device: &'static MainDevice<'static>,
    link: &mut dyn Link,
    port: &mut PduLoop,
) {
    /// The delay until SYNC0 is switched off. A device in Op reports a missing SYNC0 until it has
    /// read the request.
    const TO_INIT: Duration = Duration::from_millis(20);
    let wire = DatagramClient::without_cycle(main_device);
    let silence = async {
        let init = [AlState::Init.code(), 0];
        let _ = wire.write_all(registers::AL_CONTROL, &init).await;
        clock::delay(TO_INIT).await;
        al::acknowledge_errors_in_init(&wire).await;
        let _ = wire.write_all(registers::DC_CYCLIC_CONTROL, &[0, 0]).await;
    };
    let _ = drive_pdu_loop(port, link, clock, silence);
}
