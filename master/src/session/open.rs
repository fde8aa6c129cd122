//! Opens what the machine file's `nic` names, with a recording around it where one is asked for.

use std::borrow::Cow;
use std::time::{SystemTime, UNIX_EPOCH};

use ecaxis_esi::sii::{self, SiiOptions};
use ecaxis_esi::{Device, Slots};

use ecaxis_sim::network::topology::media;
use ecaxis_sim::{
    DeviceOptions, FaultScript, FirmwareOptions, SecondPort, Segment, SegmentOptions, SimDevice,
    Topology,
};

use super::{Options, RunError};
use crate::clock::{self, Clock};
use crate::config::sim::{self, bus_order};
use crate::config::{DeviceConfig, Locator, Machine, Nic};
use crate::link::capture::{Mode, Recorder};
use crate::link::recorded::Recorded;
use crate::link::replay::Replay;
use crate::link::sim::SimLink;
use crate::link::{self, Concern, Link, OpenError};
use crate::recording;

/// Blocks.
///
/// # Errors
/// [`RunError::Open`], also where another MainDevice is heard; [`RunError::Sim`], [`RunError::Record`], [`RunError::Link`].
pub fn link(
    machine: &Machine,
    options: &Options,
    mut tell: impl FnMut(Concern),
) -> Result<Box<dyn Link>, RunError> {
    let link: Box<dyn Link> = match (&options.replay, &machine.bus.nic) {
        (Some(path), _) => {
            let failed = |error| RunError::Replay(format!("{}: {error}", path.display()));
            let reader = recording::open(path).map_err(failed)?;
            Box::new(Replay::new(reader).map_err(failed)?)
        }
        (None, Nic::Sim) => Box::new(SimLink::new(simulated_bus(
            machine,
            options.seed,
            options.faults.as_ref(),
            None,
        )?)),
        (None, Nic::Interface(nic)) => {
            let (mut link, concerns) = link::open_alone(nic, machine.bus.link)?;
            // The first thing sent would take its drives to Init.
            let frames = link::heard(link.as_mut()).map_err(RunError::Link)?;
            if frames > 0 {
                let nic = nic.clone();
                return Err(OpenError::Driven { nic, frames }.into());
            }
            concerns.into_iter().for_each(&mut tell);
            link
        }
    };
    recorded(link, options)
}

/// A link with the recording around it that is asked for, if one is.
///
/// # Errors
/// [`RunError::Record`].
pub fn recorded(link: Box<dyn Link>, options: &Options) -> Result<Box<dyn Link>, RunError> {
    let Some(path) = &options.record else {
        return Ok(link);
    };
    let (mode, epoch) = match options.clock {
        // A run in virtual time is to be recorded the same every time, and may wait for the disk.
        Clock::Virtual => (Mode::Inline, 0),
        Clock::Real => (Mode::Background, since_1970().saturating_sub(clock::now())),
    };
    let recorder = Recorder::create(path, mode, options.record_limit)
        .map_err(|error| RunError::Record(format!("{}: {error}", path.display())))?;
    Ok(Box::new(Recorded::new(link, recorder, epoch)))
}

fn since_1970() -> u64 {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .ok()
        .and_then(|since| u64::try_from(since.as_nanos()).ok())
        .unwrap_or(0)
}

/// The simulated bus that the machine file describes: every device from its own ESI. With `ring`, the last open port
/// leads back to a second port of the MainDevice.
pub fn simulated_bus(
    machine: &Machine,
    seed: u64,
    faults: Option<&FaultScript>,
    ring: Option<SecondPort>,
) -> Result<Segment, RunError> {
    let mut topology = topology(machine)?;
    let mut devices = Vec::with_capacity(machine.devices.len());
    for device in bus_order(&machine.devices) {
        devices.push(sim_device(device, devices.len(), seed)?);
    }
    if let Some(second) = ring {
        let closed = topology.closed(&media(&devices), second);
        topology = closed.map_err(|error| RunError::Sim(error.to_string()))?;
    }
    let options = SegmentOptions {
        seed,
        ..SegmentOptions::default()
    };
    let mut segment = Segment::with_topology(devices, topology, options);
    if let Some(faults) = faults {
        segment.set_faults(faults.clone());
    }
    Ok(segment)
}

/// How the simulated bus is cabled.
///
/// # Errors
/// [`RunError::Sim`] where a device finds no port.
pub fn topology(machine: &Machine) -> Result<Topology, RunError> {
    sim::topology(&machine.devices).map_err(|errors| {
        let told = errors
            .iter()
            .map(|error| sim::told(error, &machine.devices).0);
        RunError::Sim(told.collect::<Vec<_>>().join("; "))
    })
}

/// Clocks of real devices differ by some tens of ppm; a simulated bus without drift would hide a
/// clock control that does nothing.
const DRIFTS_PPM: [f64; 4] = [18.0, -23.0, 7.0, -11.0];

/// Vendor of the demonstration devices. They have boot loaders, which take nothing but their own firmware files; other devices keep a file that is
/// written in Bootstrap as any other.
const DEMONSTRATION: u32 = 0x0e0a;

/// The device with the modules that the file names in its slots. Where a mode picks the module it is no hardware: the device takes what it is told.
fn plugged(device: &DeviceConfig) -> Cow<'_, Device> {
    let selection = &device.selection;
    let Some(slots) = &device.device.slots else {
        return Cow::Borrowed(&device.device);
    };
    if selection.mode.is_some() || !device.modules_named {
        return Cow::Borrowed(&device.device);
    }
    let mut hardware = Device::clone(&device.device);
    let mut places = Vec::new();
    for slot in &slots.slots {
        let count = usize::try_from(slot.max_instances.clamp(1, 254)).unwrap_or(1);
        for _ in 0..count {
            let mut place = slot.clone();
            place.max_instances = 1;
            place.min_instances = place.min_instances.min(1);
            let module = selection.modules.iter().find(|m| m.place == places.len());
            place.module_idents.iter_mut().for_each(|(_, d)| *d = false);
            if let Some(module) = module {
                // It may fit by its class alone.
                place
                    .module_idents
                    .retain(|(ident, _)| *ident != module.ident);
                place.module_idents.push((module.ident, true));
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

fn sim_device(device: &DeviceConfig, position: usize, seed: u64) -> Result<SimDevice, RunError> {
    let place = u32::try_from(position).unwrap_or(0);
    let mut options = DeviceOptions {
        serial: device.serial.unwrap_or(1000 + place),
        clock_drift_ppm: device
            .sim
            .drift_ppm
            .unwrap_or(DRIFTS_PPM[position % DRIFTS_PPM.len()]),
        clock_offset_ns: device.sim.offset_ns,
        clock_jitter_ns: device.sim.jitter_ns,
        jitter_seed: seed.wrapping_add(u64::from(place)),
        gateway: device.sim.gateway.clone(),
        firmware: (device.device.identity.vendor == DEMONSTRATION).then(FirmwareOptions::default),
        ..DeviceOptions::default()
    };
    match device.at {
        Locator::Position(_) => {}
        Locator::Alias(alias) | Locator::Id(alias) => options.alias = alias,
    }
    if let Some(axis) = &device.axis {
        // Validated as a positive number that fits.
        options.plant.counts_per_turn = axis.config.scale.counts_per_turn().round() as u32;
        options.plant.initial_position = device.sim.track.start;
        options.plant.track = device.sim.track.track;
    }
    let hardware = plugged(device);
    if let Cow::Owned(_) = hardware {
        // Whatever is plugged, the EEPROM is as it left the factory.
        let own = SiiOptions {
            serial: options.serial,
            alias: options.alias,
        };
        options.sii = Some(sii::emit(&device.device, &device.esi.modules, &own));
    }
    SimDevice::from_esi(&hardware, &device.esi.modules, options)
        .map_err(|error| RunError::Sim(format!("`{}`: {error}", device.name)))
}
