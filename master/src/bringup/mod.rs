//! Bring-up, from power-up to SafeOp. MAY BLOCK AND ALLOCATE.
//!
//! ethercrab scans, addresses, reads the EEPROMs, sets up mailboxes, measures propagation delays
//! and requests PreOp. This module does the rest: it compares the bus with the machine file and
//! writes start-up SDOs. It also sets up the process data's SyncManagers and FMMUs, SYNC0,
//! watchdogs and the further states. These steps need the ESI or must name the device when they
//! fail.

#![allow(
    clippy::result_large_err,
    reason = "an error here carries the whole address and ends the run"
)]

use std::future::poll_fn;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::pin::pin;
use std::task::{Context, Poll};

use ecaxis_ecat::index::{AxisIndex, DeviceIndex, IndexVec};
use ecaxis_ecat::registers;
use ethercrab::{DcSupport, MainDevice, SubDeviceGroup};

use crate::acyclic::{AlState, DeviceRef, StateTimeouts, Transition, al, enumerate, topology};
use crate::clock;
use crate::concurrent::try_join_all;
use crate::config::state_timeouts::mailbox_timeouts;
use crate::config::{AdoptedUnits, DeviceConfig, LimitConflict, MAX_SUBDEVICES, Machine};
use crate::datagram::DatagramClient;
use crate::link::redundant::RingState;
use crate::link::scan_answers::{ScanAnswers, ScanFindings};
use crate::mailbox::CoeClient;
use crate::mailbox::worker::EmergencySink;
use crate::report::{Cause, DevicePlace, Error};
use crate::rt::image::{self, DeviceRegion, ImagePlan};
use crate::rt::phase::ClockPlan;
use crate::text::panic_text;

pub mod align;
pub(crate) mod clocks;
mod common_time;
mod device;
pub(crate) mod device_return;
pub mod drive_units;
mod eeproms;
mod identify;
mod kept_parameters;
mod limits;
mod mailbox;
mod mapping;
mod modules;
mod output_defaults;
pub mod process_data;
pub(crate) mod ring;
mod soe;
mod times;
pub(crate) use common_time::clock_offset;
pub(crate) use identify::{accepts, compare as compare_identity, known as known_identity, name_at};
mod watchdog;

pub use crate::report::bring_up::{Step, StepTime};
pub use clocks::pulse_registers;
use device::StartupPhase;
pub(crate) use device::enable_op_only;
pub use device::{SdoOutcome, write_startup_sdo};
pub use mailbox::mailbox_registers;
pub use modules::{DETECTED_MODULES, difference as module_difference};
use process_data::ControlBytes;
pub use ring::RingDelays;
pub use times::StepTimes;
pub use watchdog::watchdog_registers;

/// The size of ethercrab's own process image, which is not used.
const MAX_PDI: usize = 1;

type Group = SubDeviceGroup<MAX_SUBDEVICES, MAX_PDI>;

/// A SubDevice that was found and set up.
#[derive(Debug)]
pub struct BusDevice {
    pub at: DeviceRef,
    /// The time-outs of its state changes.
    pub timeouts: StateTimeouts,
    /// `None` without a CoE mailbox, and once a mailbox worker owns the mailbox.
    pub coe: Option<CoeClient>,
    /// Likewise of a device with SoE and without CoE.
    pub soe: Option<CoeClient>,
    /// True if the device has a system time: not every device that reports one in 0x0008 has it
    /// enabled.
    pub dc: bool,
    /// True if its clock follows the reference clock, or is the reference clock.
    pub follows: bool,
    /// Outputs that no axis drives and that must not be zero: index, subindex, value.
    pub held: Vec<(u16, u8, i64)>,
    /// For a drive: its axis in the drive's own units.
    pub adopted: Vec<(AxisIndex, AdoptedUnits)>,
    /// For a drive: its own limits that the machine file exceeds.
    pub limits: Vec<(AxisIndex, LimitConflict)>,
    /// False if it is optional and was absent.
    pub present: bool,
    /// The serial number in its EEPROM.
    pub serial: u32,
    /// The revision in its EEPROM; 0 if it was absent.
    pub revision: u32,
    /// Propagation delay from the reference clock in ns.
    pub propagation_delay: u32,
    /// DL status (0x0110) after the scan: which ports are in use.
    pub dl_status: u16,
    /// The ControlBytes that the device accepts.
    pub control_bytes: ControlBytes,
    /// The activation bytes that are 1 in Op only: SyncManagers, then FMMUs.
    pub op_only: Vec<u16>,
}

/// A segment in SafeOp, ready for cyclic exchange.
#[derive(Debug)]
pub struct Bus {
    /// In the order of the machine file.
    pub devices: IndexVec<DeviceIndex, BusDevice>,
    pub image: ImagePlan,
    pub dc: Option<ClockPlan>,
    /// True if all clocks had settled before SafeOp.
    pub clocks_settled: bool,
    /// The propagation delays in a closed ring, in the order of the segment; `None` without cable
    /// redundancy.
    pub ring_delays: Option<RingDelays>,
    /// The state of the ring when the delays were measured.
    pub ring: Option<RingState>,
    /// The durations of the steps so far.
    pub times: StepTimes,
}

impl Bus {
    /// Returns the place of each device.
    #[must_use]
    pub fn places(&self) -> IndexVec<DeviceIndex, DevicePlace> {
        let mut order: Vec<_> = self
            .devices
            .enumerate()
            .filter(|(_, d)| d.present)
            .collect();
        order.sort_by_key(|(_, device)| device.at.position);
        let parents = topology::parents(order.iter().map(|(_, device)| device.dl_status));
        let place = |(index, device): (DeviceIndex, &BusDevice)| {
            let at = order.iter().position(|(other, _)| *other == index);
            let parent = at.and_then(|at| *parents.get(at)?);
            let parent = parent.and_then(|parent| {
                let (device, _) = order.get(usize::from(parent.device))?;
                Some((*device, parent.port))
            });
            DevicePlace {
                position: device.at.position,
                parent,
            }
        };
        self.devices.enumerate().map(place).collect()
    }
}

impl Bus {
    /// Returns the position of the device in front of another one, on the way from the MainDevice. The
    /// number of devices stands for the second interface of a ring.
    pub(crate) fn in_front_of(&self, position: u16) -> Option<u16> {
        let present = self.devices.iter().filter(|device| device.present);
        let mut status: Vec<_> = present.map(|d| (d.at.position, d.dl_status)).collect();
        status.sort_unstable();
        let status = status.iter().map(|(_, status)| *status);
        match topology::parents(status.clone()).get(usize::from(position)) {
            Some(parent) => parent.map(|parent| parent.device),
            None => match topology::ring_end(status) {
                Some(end) => Some(end.device),
                None => position.checked_sub(1),
            },
        }
    }
}

/// Brings the segment from any state to SafeOp. Passes emergencies of the devices to the listener,
/// on success and on failure. `answers` are those of the MainDevice's PDU loop.
pub async fn bring_up(
    wire: DatagramClient,
    answers: &ScanAnswers,
    machine: &Machine,
    image: ImagePlan,
    progress: &dyn Fn(Step),
    listener: &dyn EmergencySink,
) -> Result<Bus, Error> {
    let main_device = wire.main_device();
    progress(Step::Scan);
    let times = StepTimes::default();
    let scan = async {
        let count = enumerate::count(&wire)
            .await
            .map_err(|error| match *error.cause {
                Cause::Datagram(_) => error.with_action("scanning"),
                _ => error,
            })?;
        if ring::enters_at_last_port(&wire).await? {
            wire.exchange_ends();
        }
        al::acknowledge_errors_in_init(&wire).await;
        let ahead = Box::pin(eeproms::read_ahead(&wire, machine, count));
        let mut ahead = times.measure("EEPROMs", None, ahead).await?;
        ahead.as_line = match wire.ring() {
            // ethercrab does not know rings; `ring::measure` measures them.
            Some(_) => Some(identify::stations(count)),
            None => identify::tolerate_reversed(&wire, machine, count, progress).await,
        };
        answers.replace(ahead);
        // ethercrab's tables are large, and futures hold them by value.
        let scan = Box::pin(main_device.init_single_group::<MAX_SUBDEVICES, MAX_PDI>(clock::now));
        let scan = caught(mailbox::repair_during(&wire, machine, scan)).await;
        let failure = match scan {
            Ok(Ok(group)) => return Ok(group),
            Ok(Err(error)) => ScanFailure::Failed(error),
            Err(panic) => ScanFailure::Panicked(panic),
        };
        answers.replace(ScanFindings::default());
        Err(identify::explain_scan(&wire, machine, failure).await)
    };
    let scan = times.measure("scan, PreOp", None, Box::pin(scan));
    let group = scan.await?;
    let ahead = answers.replace(ScanFindings::default());
    let assign = async {
        eeproms::compare(&wire, machine, &ahead).await?;
        identify::assign(&wire, main_device, &group, machine, progress).await
    };
    let order = times.measure("identification", None, assign).await?;
    progress(Step::Found {
        devices: order.iter().flatten().count(),
    });

    let found = machine
        .devices
        .iter()
        .zip(&order)
        .zip(0..)
        .map(|((config, &position), index)| {
            let (wire, group, times) = (&wire, &group, &times);
            async move {
                let Some(position) = position else {
                    return Ok(absent(config, index));
                };
                let device = describe(wire, main_device, group, config, position, progress);
                times.measure("mailbox", Some(&config.name), device).await
            }
        });
    let found = try_join_all(found).await?;
    // From here on, ethercrab only carries datagrams; see docs/decisions/0001.
    drop(group);
    let mut devices = found;
    let (mut ring, mut ring_delays) = (wire.ring(), None);
    if let Some(state) = ring {
        let measure = ring::measure(&wire, machine, state, &mut devices, progress);
        let measured = times.measure("propagation delays", None, measure).await?;
        (ring, ring_delays) = (Some(measured.state), Some(measured.closed));
    }
    let reference = clocks::reference(&devices);
    let set_up = Box::pin(set_up(
        &wire,
        machine,
        image,
        &mut devices,
        progress,
        &times,
    ));
    let set_up = clocks::distribute_during(&wire, reference.as_ref(), set_up).await;
    for device in &devices {
        device.report(listener);
    }
    let (image, dc, clocks_settled) = set_up?;
    for (config, device) in machine.devices.iter().zip(&mut devices) {
        if !device.present {
            device.dc = config.selection.dc.is_some();
            device.follows = device.dc && dc.is_some();
        }
    }
    let devices = devices.into();
    Ok(Bus {
        devices,
        image,
        dc,
        clocks_settled,
        ring_delays,
        ring,
        times,
    })
}

/// Reads what bring-up needs to know of one device.
async fn describe(
    wire: &DatagramClient,
    main_device: &'static MainDevice<'static>,
    group: &Group,
    config: &DeviceConfig,
    position: u16,
    progress: &dyn Fn(Step),
) -> Result<BusDevice, Error> {
    let sub_device = group
        .subdevice(main_device, usize::from(position))
        .map_err(|e| scan_error("reading the scan's result", &e))?;
    let at = DeviceRef {
        name: config.name.clone(),
        position,
        station: sub_device.configured_address(),
    };
    let propagation_delay = sub_device.propagation_delay();
    tracing::debug!(
        device = %at,
        "found {}, {:?}, {propagation_delay} ns behind the first clock",
        config.selection.device_name,
        sub_device.dc_support(),
    );
    let receive_times = !matches!(sub_device.dc_support(), DcSupport::None);
    let dc = receive_times && clocks::has_system_time(wire, &at).await?;
    let info = &config.device.info;
    let coe = mailbox::open(wire, config, &at, progress).await?;
    let status = enumerate::at(wire, position, "reading its ports", registers::DL_STATUS).await;
    // Used only for a later comparison; 0 if unreadable.
    let dl_status = status.map_or(0, u16::from_le_bytes);
    let client = coe.map(|layout| CoeClient::new(layout).with_timeouts(mailbox_timeouts(info)));
    let (coe, soe) = by_protocol(config, client);
    Ok(BusDevice {
        coe,
        soe,
        timeouts: StateTimeouts::new(info),
        at,
        held: Vec::new(),
        adopted: Vec::new(),
        limits: Vec::new(),
        dc,
        follows: false,
        present: true,
        serial: sub_device.identity().serial,
        revision: sub_device.identity().revision,
        propagation_delay,
        dl_status: topology::in_line(position, dl_status, wire.ring()),
        control_bytes: ControlBytes::default(),
        op_only: Vec::new(),
    })
}

/// Returns the client of a device as that of CoE, or of SoE.
fn by_protocol(
    config: &DeviceConfig,
    client: Option<CoeClient>,
) -> (Option<CoeClient>, Option<CoeClient>) {
    match config.device.soe_only() {
        Some(_) => (None, client),
        None => (client, None),
    }
}

/// Returns an optional device that is absent, with its future station address.
fn absent(config: &DeviceConfig, index: u16) -> BusDevice {
    /// Devices that are present have lower addresses.
    const FIRST_ABSENT: u16 = 0x2000;
    let info = &config.device.info;
    let at = DeviceRef {
        name: config.name.clone(),
        position: DeviceRef::ABSENT,
        station: FIRST_ABSENT + index,
    };
    let coe = mailbox::expected(config, &at);
    let client = coe.map(|layout| CoeClient::new(layout).with_timeouts(mailbox_timeouts(info)));
    let (coe, soe) = by_protocol(config, client);
    BusDevice {
        coe,
        soe,
        timeouts: StateTimeouts::new(info),
        at,
        held: Vec::new(),
        adopted: Vec::new(),
        limits: Vec::new(),
        dc: false,
        follows: false,
        present: false,
        serial: 0,
        revision: 0,
        propagation_delay: 0,
        dl_status: 0,
        control_bytes: ControlBytes::default(),
        op_only: Vec::new(),
    }
}

/// Takes the segment from PreOp to SafeOp. Devices are configured at the same time, and their clocks
/// settle meanwhile. Returns also whether all clocks have settled.
async fn set_up(
    wire: &DatagramClient,
    machine: &Machine,
    mut image: ImagePlan,
    devices: &mut [BusDevice],
    progress: &dyn Fn(Step),
    times: &StepTimes,
) -> Result<(ImagePlan, Option<ClockPlan>, bool), Error> {
    let start = clocks::set_offsets(wire, devices);
    times.measure("clock offsets", None, start).await?;
    let each = machine
        .devices
        .iter()
        .zip(&mut *devices)
        .zip(&image.regions);
    let each = (0..).map(DeviceIndex).zip(each);
    let each = each.filter(|(_, ((_, device), _))| device.present);
    let each = each.map(async |(index, ((config, device), region))| {
        let status = image.mailboxes.as_ref().and_then(|m| m.logical_of(index));
        configure(
            wire,
            machine,
            (index, config, device),
            (*region, status),
            progress,
            times,
        )
        .await
    });
    try_join_all(each).await?;
    if let Some(without) = without_lrw(wire, machine, devices).await? {
        image = without;
    }
    progress(Step::ProcessData {
        bytes: image.len,
        frames: image.frames(),
    });

    let settle = clocks::settle(wire, machine, devices);
    let clocks_settled = times.measure("clock settling", None, settle).await?;
    let dc = clocks::configure(wire, machine, devices, &image, progress);
    let dc = times.measure("SYNC0", None, dc).await?;

    let each = machine.devices.iter().zip(&mut *devices);
    let each = each.filter(|(_, device)| device.present);
    let plan = dc.as_ref();
    let changes = each.map(|(config, device)| {
        let pulses = async || {
            if let Some(plan) = plan {
                clocks::await_pulses(wire, plan).await;
            }
        };
        let name = &config.name;
        let change = modules::enter_safe_op(wire, config, device, pulses, progress);
        times.measure("SafeOp", Some(name), change)
    });
    try_join_all(changes).await?;
    progress(Step::State(AlState::SafeOp));
    let last = machine.devices.iter().zip(devices);
    let last = last.filter(|(_, device)| device.present);
    let last = last.map(|(config, device)| {
        let sdos = device::start_up(wire, config, device, StartupPhase::InSafeOp, progress);
        times.measure("start-up SDOs in SafeOp", Some(&config.name), sdos)
    });
    try_join_all(last).await?;
    Ok((image, dc, clocks_settled))
}

/// Configures one device in PreOp. `region` and `status`: its process data and the status of its
/// mailbox in the process image.
async fn configure(
    wire: &DatagramClient,
    machine: &Machine,
    (index, config, device): (DeviceIndex, &DeviceConfig, &mut BusDevice),
    (region, status): (Option<DeviceRegion>, Option<u32>),
    progress: &dyn Fn(Step),
    times: &StepTimes,
) -> Result<(), Error> {
    let name = Some(config.name.as_str());
    let step = kept_parameters::restore_to(wire, config, device, progress);
    times.measure("parameter file", name, step).await?;
    let step = device::set_ethernet(wire, config, device);
    times.measure("Ethernet (EoE)", name, step).await?;
    let step = device::start_up(wire, config, device, StartupPhase::InPreOp, progress);
    times.measure("start-up SDOs", name, step).await?;
    // Other modules explain another mapping, so they come first.
    let step = modules::compare(wire, config, device, progress);
    times.measure("modules", name, step).await?;
    let step = mapping::compare(wire, config, device);
    times.measure("mapping read back", name, step).await?;
    let step = async {
        // A gateway passes no SDO on to its nodes.
        let own = machine.axes_of(index);
        for axis in own.filter(|(_, axis)| axis.node.is_none()) {
            drive_units::compare(wire, config, axis, device, progress).await?;
            limits::compare(wire, config, axis, device, progress).await?;
        }
        output_defaults::read(wire, config, device).await
    };
    times.measure("units and limits", name, step).await?;
    let step = async {
        device::map_process_data(wire, config, device, region, status).await?;
        watchdog::set(wire, &machine.bus, config, device, progress).await
    };
    times.measure("process data, watchdogs", name, step).await
}

impl BusDevice {
    /// Returns the change to a state, up or back.
    pub(crate) fn transition(&self, wanted: AlState, back: bool) -> Transition<'_> {
        Transition {
            device: &self.at,
            timeout: self.timeouts.select(wanted, back),
        }
    }

    /// Returns the device without its mailbox, as before its configuration.
    pub(crate) fn without_mailbox(&self) -> Self {
        Self {
            at: self.at.clone(),
            coe: None,
            soe: None,
            held: Vec::new(),
            adopted: Vec::new(),
            limits: Vec::new(),
            op_only: self.op_only.clone(),
            ..*self
        }
    }

    /// Returns the client of the device's mailbox.
    pub(crate) fn client(&self) -> Option<&CoeClient> {
        self.coe.as_ref().or(self.soe.as_ref())
    }

    pub(crate) fn take_client(&mut self) -> Option<CoeClient> {
        self.coe.take().or_else(|| self.soe.take())
    }

    /// Gives the device the client of its mailbox.
    pub(crate) fn set_client(&mut self, config: &DeviceConfig, client: Option<CoeClient>) {
        (self.coe, self.soe) = by_protocol(config, client);
    }

    /// Passes the device's emergencies to the listener.
    fn report(&self, listener: &dyn EmergencySink) {
        if let Some(client) = self.client() {
            listener.listen(&self.at.name, &client.emergencies());
        }
    }
}

/// Returns the image without LRW for devices whose controllers report no LRW (0x0008 bit 9), in
/// addition to those declared by the ESI. Returns `None` if there are none. The positions in the
/// image do not change.
async fn without_lrw(
    wire: &DatagramClient,
    machine: &Machine,
    devices: &[BusDevice],
) -> Result<Option<ImagePlan>, Error> {
    const NO_LRW: u16 = 1 << 9;
    let features = devices.iter().map(async |device| {
        let step = "reading what its controller can do";
        match device.present {
            true => device::read(wire, &device.at, step, registers::FEATURES).await,
            false => Ok([0; 2]),
        }
    });
    let features = try_join_all(features).await?;
    let mut config = machine.rt_config();
    let mut more = false;
    for (features, data) in features.into_iter().zip(&mut config.devices) {
        if data.lrw && u16::from_le_bytes(features) & NO_LRW != 0 {
            data.lrw = false;
            more = true;
        }
    }
    if !more {
        return Ok(None);
    }
    let image = image::of(&config).map_err(|error| {
        let at = &devices[error.device.0].at;
        Cause::TooLarge(error).with_device(at)
    })?;
    Ok(Some(image))
}

/// Why ethercrab's scan failed.
enum ScanFailure {
    Failed(ethercrab::error::Error),
    /// ethercrab panics on some damaged EEPROMs.
    Panicked(String),
}

/// Returns the output of a future, or the text of its panic.
async fn caught<T>(future: impl Future<Output = T>) -> Result<T, String> {
    let mut future = pin!(future);
    let poll = |context: &mut Context<'_>| {
        let polled = catch_unwind(AssertUnwindSafe(|| future.as_mut().poll(context)));
        match polled {
            Ok(polled) => polled.map(Ok),
            Err(panic) => Poll::Ready(Err(panic_text(&*panic))),
        }
    };
    poll_fn(poll).await
}

fn scan_error(step: &'static str, error: &ethercrab::error::Error) -> Error {
    Error::from(Cause::Scan(error.to_string())).with_action(step)
}

impl Bus {
    /// Returns every device's address, in the order of the machine file.
    #[must_use]
    pub fn addresses(&self) -> Vec<DeviceRef> {
        self.devices.iter().map(|d| d.at.clone()).collect()
    }
}
