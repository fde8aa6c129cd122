//! Opens what the machine file's `nic` names, with a recording around it where one is asked for.

use std::time::{SystemTime, UNIX_EPOCH};

use ecaxis_sim::{DeviceOptions, FaultScript, Segment, SegmentOptions, SimDevice};

use super::{Options, RunError};
use crate::clock::{self, Clock};
use crate::config::{DeviceConfig, Locator, Machine, Nic};
use crate::link::Link;
use crate::link::capture::{Mode, Recorder};
use crate::link::packet::PacketLink;
use crate::link::recorded::Recorded;
use crate::link::sim::SimLink;

pub(super) fn link(machine: &Machine, options: &Options) -> Result<Box<dyn Link>, RunError> {
    let link: Box<dyn Link> = match &machine.bus.nic {
        Nic::Sim => Box::new(SimLink::new(simulated_bus(
            machine,
            options.seed,
            options.faults.as_ref(),
        )?)),
        Nic::Interface(nic) => Box::new(PacketLink::open(nic)?),
    };
    let Some(path) = &options.record else {
        return Ok(link);
    };
    let (mode, epoch) = match options.clock {
        // A run in virtual time is to be recorded the same every time, and may wait for the disk.
        Clock::Virtual => (Mode::Inline, 0),
        Clock::Real => (Mode::Background, since_1970().saturating_sub(clock::now())),
    };
    let recorder = Recorder::create(path, mode)
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

/// The simulated bus that the machine file describes: every device from its own ESI.
pub fn simulated_bus(
    machine: &Machine,
    seed: u64,
    faults: Option<&FaultScript>,
) -> Result<Segment, RunError> {
    let mut placed: Vec<Option<&DeviceConfig>> = machine.devices.iter().map(|_| None).collect();
    for device in &machine.devices {
        if let Locator::Position(position) = device.at
            && let Some(place @ None) = placed.get_mut(usize::from(position))
        {
            *place = Some(device);
        }
    }
    // Devices found by alias or identification may stand anywhere: they fill the gaps in order.
    let mut others = machine
        .devices
        .iter()
        .filter(|d| !matches!(d.at, Locator::Position(_)));
    let mut devices = Vec::with_capacity(placed.len());
    for place in placed {
        let Some(device) = place.or_else(|| others.next()) else {
            continue;
        };
        devices.push(sim_device(device, devices.len())?);
    }
    let mut segment = Segment::new(
        devices,
        SegmentOptions {
            seed,
            ..SegmentOptions::default()
        },
    );
    if let Some(faults) = faults {
        segment.set_faults(faults.clone());
    }
    Ok(segment)
}

/// Clocks of real devices differ by some tens of ppm; a simulated bus without drift would hide a
/// clock control that does nothing.
const DRIFTS_PPM: [f64; 4] = [18.0, -23.0, 7.0, -11.0];

fn sim_device(device: &DeviceConfig, position: usize) -> Result<SimDevice, RunError> {
    let mut options = DeviceOptions {
        serial: 1000 + u32::try_from(position).unwrap_or(0),
        clock_drift_ppm: DRIFTS_PPM[position % DRIFTS_PPM.len()],
        gateway: device.sim.gateway.clone(),
        ..DeviceOptions::default()
    };
    match device.at {
        Locator::Position(_) => {}
        Locator::Alias(alias) | Locator::Id(alias) => options.alias = alias,
    }
    if let Some(axis) = &device.axis {
        // Validated as a positive number that fits.
        options.plant.counts_per_turn = axis.config.scale.counts_per_turn().round() as u32;
    }
    SimDevice::from_esi(&device.device, &device.esi.modules, options)
        .map_err(|error| RunError::Sim(format!("`{}`: {error}", device.name)))
}
