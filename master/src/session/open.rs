//! Opens the link that the machine file's `nic` names, and records it on request.

use std::borrow::Cow;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use ecaxis_esi::sii::{self, SiiOptions};
use ecaxis_esi::{Device, SDO_OF_MACHINE_FILE, Slots, StartupSdo};

use ecaxis_sim::{
    DeviceOptions, FaultScript, FirmwareOptions, PlantParams, SecondPort, Segment, SegmentOptions,
    SimDevice, StartupWrite, Topology,
};

use super::{Cause, Error, Options};
use crate::acyclic::eeprom::size_of;
use crate::acyclic::image::with_alias;
use crate::clock::{self, Clock, Nanos};
use crate::config::sim::{self, bus_order};
use crate::config::{DeviceConfig, Locator, Machine, Nic, SwitchedInput};
use crate::link::capture::{CapturingLink, Recorder, WriterMode};
use crate::link::interface::Carrier;
use crate::link::redundant::{Interfaces, RedundantLink, RingEnds};
use crate::link::replay::Replay;
use crate::link::sim::{SimLink, SimRing};
use crate::link::{self, Link, NicWarning, OpenError};
use crate::recording;
use crate::sys::rt_thread;

/// Opens the link of the machine. Blocks.
///
/// # Errors
/// [`Cause::Open`], also if another MainDevice is active; [`Cause::Sim`],
/// [`Cause::Record`], [`Cause::Link`].
pub fn link(
    machine: &Machine,
    options: &Options,
    mut report: impl FnMut(NicWarning),
) -> Result<Box<dyn Link>, Error> {
    let link: Box<dyn Link> = match (&options.replay, &machine.bus.nic) {
        (Some(path), _) => {
            let failed = |error| Cause::Replay(format!("{}: {error}", path.display()));
            let reader = recording::open(path).map_err(failed)?;
            let replay = Replay::new(reader).map_err(failed)?;
            Box::new(match machine.bus.redundant {
                None => replay,
                Some(_) => replay.in_ring(),
            })
        }
        (None, Nic::Sim) => simulated_link(machine, options.seed, options.faults.as_ref())?,
        (None, Nic::Interface(nic)) => {
            let mut open = |nic: &String| -> Result<Box<dyn Link>, Error> {
                let (mut link, concerns) = match machine.bus.redundant {
                    None => link::open_exclusive(nic, machine.bus.link)?,
                    Some(_) => link::open_end_exclusive(nic, machine.bus.link)?,
                };
                let opened = Instant::now();
                // Meanwhile; `become_realtime` repeats it and reports what is denied.
                let _ = rt_thread::lock_memory();
                // The first frame would set another MainDevice's drives to Init.
                let frames = link::sniff_foreign_frames(link.as_mut(), opened);
                let frames = frames.map_err(Cause::Link)?;
                if frames > 0 {
                    let nic = nic.clone();
                    return Err(OpenError::Driven { nic, frames }.into());
                }
                concerns.into_iter().for_each(&mut report);
                Ok(link)
            };
            let link = open(nic)?;
            match &machine.bus.redundant {
                None => link,
                Some(second) => {
                    let ring = ring(link, open(second)?, copy_timeout(machine));
                    let carriers = Carrier::open(nic).zip(Carrier::open(second));
                    if let (Some(status), Some(carriers)) = (ring.ring(), carriers) {
                        status.watch(carriers.into());
                    }
                    ring
                }
            }
        }
    };
    recorded(link, options, &recording_comment(machine))
}

/// Returns the links at both ends of a ring as one link, which waits so long for the second copy of a
/// frame.
#[must_use]
pub fn ring(first: Box<dyn Link>, second: Box<dyn Link>, copy_timeout: Nanos) -> Box<dyn Link> {
    redundant(Interfaces([first, second]), copy_timeout)
}

fn redundant(ends: impl RingEnds + 'static, copy_timeout: Nanos) -> Box<dyn Link> {
    Box::new(RedundantLink::new(Box::new(ends), copy_timeout))
}

/// How long the cycle waits for the second copy of a frame: it waits three quarters of a cycle for
/// its answers.
fn copy_timeout(machine: &Machine) -> Nanos {
    machine.bus.cycle_ns / 2
}

/// Returns a link to the simulated bus of the machine file.
///
/// # Errors
/// As [`simulated_bus`].
pub fn simulated_link(
    machine: &Machine,
    seed: u64,
    faults: Option<&FaultScript>,
) -> Result<Box<dyn Link>, Error> {
    let ring = machine.bus.redundant.as_ref().map(|_| SecondPort::Listens);
    let link = SimLink::new(simulated_bus(machine, seed, faults, ring)?);
    Ok(match ring {
        None => Box::new(link),
        Some(_) => redundant(SimRing(link), copy_timeout(machine)),
    })
}

/// Returns the comment at the begin of a machine's recordings.
#[must_use]
pub fn recording_comment(machine: &Machine) -> String {
    let (file, sha256) = (machine.path.display(), machine.sha256);
    format!("machine file {file}, sha256 {sha256}")
}

/// Adds the recording that `options` request to a link. The file begins with the comment.
///
/// # Errors
/// [`Cause::Record`].
pub fn recorded(
    link: Box<dyn Link>,
    options: &Options,
    comment: &str,
) -> Result<Box<dyn Link>, Error> {
    let Some(path) = &options.record else {
        return Ok(link);
    };
    let (mode, epoch) = match options.clock {
        // In virtual time a recording must be reproducible, and the run may wait for the disk.
        Clock::Virtual => (WriterMode::Inline, 0),
        Clock::Real => (
            WriterMode::Background,
            since_1970().saturating_sub(clock::now()),
        ),
    };
    let recorder = Recorder::create(path, mode, options.record_limit, comment)
        .map_err(|error| Cause::Record(format!("{}: {error}", path.display())))?;
    Ok(Box::new(CapturingLink::new(link, recorder, epoch)))
}

fn since_1970() -> u64 {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .ok()
        .and_then(|since| u64::try_from(since.as_nanos()).ok())
        .unwrap_or(0)
}

/// Builds the simulated bus of the machine file. Every device uses its own ESI. With `ring`, the
/// last open port leads back to a second port of the MainDevice.
pub fn simulated_bus(
    machine: &Machine,
    seed: u64,
    faults: Option<&FaultScript>,
    ring: Option<SecondPort>,
) -> Result<Segment, Error> {
    let topology = topology(machine, ring)?;
    let mut devices = Vec::with_capacity(machine.devices.len());
    for device in bus_order(&machine.devices) {
        devices.push(sim_device(machine, device, devices.len(), seed)?);
    }
    let options = SegmentOptions {
        seed,
        ..SegmentOptions::default()
    };
    let mut segment = Segment::with_topology(devices, topology, options);
    let mut faults = faults.cloned().unwrap_or_default();
    for switched in &machine.switched {
        let SwitchedInput {
            at_ns,
            for_ns,
            input,
            value,
        } = switched;
        // The check has seen that the input can have the value.
        if let Ok(input) = machine.sim_input(input, *value) {
            let object = (input.position, input.index, input.sub);
            faults.add_input(object, input.value, (*at_ns, *for_ns));
        }
    }
    segment.set_faults(faults);
    Ok(segment)
}

/// Returns the cabling of the simulated bus. With `ring`, the last open port leads back to a second
/// port of the MainDevice.
///
/// # Errors
/// [`Cause::Sim`] if a device or the ring finds no free port.
pub fn topology(machine: &Machine, ring: Option<SecondPort>) -> Result<Topology, Error> {
    let line = sim::topology(&machine.devices).map_err(|errors| {
        let reported = errors
            .iter()
            .map(|error| sim::topology_message(error, &machine.devices).0);
        Cause::Sim(reported.collect::<Vec<_>>().join("; "))
    })?;
    let Some(second) = ring else {
        return Ok(line);
    };
    let media = sim::media(&bus_order(&machine.devices));
    let closed = line.closed(&media, second);
    closed.map_err(|error| Cause::Sim(error.to_string()).into())
}

/// The clock drifts of the simulated devices in ppm, as in real devices. Without drift a defective
/// clock control would go unnoticed.
const DRIFTS_PPM: [f64; 4] = [18.0, -23.0, 7.0, -11.0];

/// The vendor ID of the demonstration devices. Their boot loaders accept only their own firmware
/// files. Other simulated devices store a file written in Bootstrap like any other file.
const DEMONSTRATION: u32 = 0x0e0a;

/// Returns the device with the modules that the file puts into its slots. If a mode selects the
/// module, the device is returned unchanged: it takes the configured module list.
fn with_plugged_modules(device: &DeviceConfig) -> Cow<'_, Device> {
    let Some(slots) = &device.device.slots else {
        return Cow::Borrowed(&device.device);
    };
    let selection = &device.selection;
    let plugged = match &device.sim.modules {
        Some(modules) => modules.clone(),
        None if selection.mode.is_none() && device.modules_named => {
            let configured = selection.modules.iter();
            configured.map(|m| (m.place, m.ident)).collect()
        }
        None => return Cow::Borrowed(&device.device),
    };
    let mut hardware = Device::clone(&device.device);
    let mut places = Vec::new();
    for slot in &slots.slots {
        let count = usize::try_from(slot.max_instances.clamp(1, 254)).unwrap_or(1);
        for _ in 0..count {
            let mut place = slot.clone();
            place.max_instances = 1;
            place.min_instances = place.min_instances.min(1);
            let module = plugged.iter().find(|(at, _)| *at == places.len());
            place.module_idents.iter_mut().for_each(|(_, d)| *d = false);
            if let Some((_, module)) = module {
                // The module may fit only by its class, so its ident is added.
                place.module_idents.retain(|(ident, _)| ident != module);
                place.module_idents.push((*module, true));
            }
            places.push(place);
        }
    }
    hardware.slots = Some(Slots {
        slots: places,
        ..slots.clone()
    });
    Cow::Owned(hardware)
}

/// Returns the image with this serial number and station alias.
fn with_own_numbers(image: &[u8], serial: u32, alias: u16) -> Vec<u8> {
    const SERIAL: usize = 0x1c;
    let mut image = image.to_vec();
    // A file ends with the categories, a chip does not.
    image.resize(image.len().max(size_of(&image)), 0xff);
    if let Some(area) = image.first_chunk_mut() {
        *area = with_alias(*area, alias);
    }
    if let Some(field) = image.get_mut(SERIAL..SERIAL + 4) {
        field.copy_from_slice(&serial.to_le_bytes());
    }
    image
}

fn startup_write(sdo: &StartupSdo) -> StartupWrite {
    StartupWrite {
        index: sdo.index,
        sub: sdo.sub,
        complete_access: sdo.complete_access,
        data: sdo.data.clone(),
    }
}

fn sim_device(
    machine: &Machine,
    device: &DeviceConfig,
    position: usize,
    seed: u64,
) -> Result<SimDevice, Error> {
    let place = u32::try_from(position).unwrap_or(0);
    let usual = DeviceOptions::default();
    let state_change_ns = device.sim.state_change_ns;
    let mut options = DeviceOptions {
        serial: device.serial.unwrap_or(1000 + place),
        clock_drift_ppm: device
            .sim
            .drift_ppm
            .unwrap_or(DRIFTS_PPM[position % DRIFTS_PPM.len()]),
        clock_offset_ns: device.sim.offset_ns,
        clock_jitter_ns: device.sim.jitter_ns,
        jitter_seed: seed.wrapping_add(u64::from(place)),
        state_change_ns: state_change_ns.unwrap_or(usual.state_change_ns),
        // A slow device also reads AL control soon.
        state_notice_ns: Some(usual.state_change_ns / 4),
        gateway: device.sim.gateway.clone(),
        quirks: device.sim.quirks,
        firmware: (device.device.identity.vendor == DEMONSTRATION).then(FirmwareOptions::default),
        ..usual
    };
    match device.at {
        Locator::Position(_) | Locator::Behind(..) => {}
        Locator::Alias(alias) | Locator::Id(alias) => options.alias = alias,
    }
    let mut plants = vec![PlantParams::default()];
    for axis in machine.axes.iter() {
        if machine.devices[axis.device].name != device.name || axis.node.is_some() {
            continue;
        }
        let number = usize::from(axis.number);
        plants.resize(plants.len().max(number + 1), PlantParams::default());
        // The configuration check ensures a positive value that fits.
        plants[number].counts_per_turn = axis.config.scale.counts_per_turn().round() as u32;
        if number == 0 {
            plants[0].initial_position = device.sim.track.start;
            plants[0].track = device.sim.track.track;
        }
        device.sim.motor.apply(&mut plants[number]);
        plants[number].quirks = device.sim.quirks;
    }
    options.plant = plants.remove(0);
    options.further_plants = plants;
    let hardware = with_plugged_modules(device);
    options.modules_are_hardware = matches!(hardware, Cow::Owned(_));
    let own = device.selection.startup.iter();
    let own = own.filter(|sdo| sdo.origin == SDO_OF_MACHINE_FILE);
    options.startup = own.map(startup_write).collect();
    if let Some(image) = &device.sii {
        options.serial = device.serial.unwrap_or(image.sii.serial);
        options.sii = Some(with_own_numbers(
            &image.bytes,
            options.serial,
            options.alias,
        ));
    } else if let Cow::Owned(_) = hardware {
        // The EEPROM has its factory content, whatever modules are plugged in.
        let own = SiiOptions {
            serial: options.serial,
            alias: options.alias,
        };
        options.sii = Some(sii::emit(&device.device, &device.esi.modules, &own));
    }
    SimDevice::from_esi(&hardware, &device.esi.modules, options)
        .map_err(|error| Cause::Sim(format!("`{}`: {error}", device.name)).into())
}
