//! Compares a machine file with a bus: missing, added, and displaced devices. Pure, except
//! [`parameters`].
//!
//! - this module: assigns bus devices to file devices, and compares each pair;
//! - `parameters`: compares the start-up SDO values;
//! - `text`: the differences in words;
//! - [`apply`]: rewrites the file to match the bus.

use ecaxis_ecat::index::{DeviceIndex, IndexVec};
use ecaxis_esi::Mode;

use crate::scan::{Device, Scan};
use ecaxis_master::acyclic::topology;
use ecaxis_master::bringup::{align, module_difference};
use ecaxis_master::config::{DeviceConfig, Locator, Machine};
use ecaxis_master::report::ModuleDifference;

pub mod apply;
mod parameters;
#[cfg(test)]
mod tests;
mod text;

pub use parameters::parameters;

/// A difference between bus and file. File devices are indices into [`Machine::devices`], bus
/// devices are positions.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Difference {
    /// No device on the bus matches this one.
    Missing { device: DeviceIndex },
    /// The file does not contain this device.
    Added { position: u16 },
    /// Two devices are in each other's position.
    Swapped {
        devices: [DeviceIndex; 2],
        positions: [u16; 2],
    },
    /// The device is in another position; those in between may have moved as well.
    Moved {
        device: DeviceIndex,
        from: u16,
        to: u16,
    },
    /// Frames do not enter the device at port 0, so it comes after the devices behind it. Several
    /// devices of one model may be the one.
    Reversed {
        devices: Vec<DeviceIndex>,
        position: u16,
    },
    /// A revision that the device's `identity` does not accept.
    Revision {
        device: DeviceIndex,
        position: u16,
        expected: u32,
        found: u32,
    },
    /// The device has another alias or device identification.
    Alias {
        device: DeviceIndex,
        position: u16,
        expected: Locator,
        found: u16,
    },
    Serial {
        device: DeviceIndex,
        position: u16,
        expected: u32,
        found: u32,
    },
    /// Module names by slot.
    Modules {
        device: DeviceIndex,
        position: u16,
        expected: Vec<String>,
        found: Vec<String>,
    },
    /// A start-up SDO value and the value in the device.
    Parameter {
        device: DeviceIndex,
        position: u16,
        index: u16,
        sub: u8,
        name: String,
        expected: Vec<u8>,
        found: Vec<u8>,
    },
}

/// The result of a comparison.
#[derive(Debug, Clone, Default)]
pub struct Comparison {
    pub differences: Vec<Difference>,
    /// The bus position of each file device.
    pub places: Positions,
    /// Optional devices that are not there; no difference.
    pub absent: Vec<DeviceIndex>,
    /// Items that could not be compared.
    pub unknown: Vec<String>,
}

/// Compares a machine with a scanned bus.
#[must_use]
pub fn compare(machine: &Machine, scan: &Scan) -> Comparison {
    let mut comparison = Comparison {
        places: vec![None; machine.devices.len()].into(),
        ..Comparison::default()
    };
    let mut free: Vec<bool> = vec![true; scan.devices.len()];
    by_serial(machine, scan, &mut comparison.places, &mut free);
    by_alias(machine, scan, &mut comparison.places, &mut free);
    by_segment(machine, scan, &mut comparison.places, &mut free);
    by_order(machine, scan, &mut comparison.places, &mut free);
    match_moved(machine, scan, &mut comparison, &mut free);

    for (device, config) in machine.devices.enumerate() {
        if comparison.places.get(device) != Some(&None) {
            continue;
        }
        // A segment is absent as a whole.
        let incomplete =
            head(machine, config).is_some_and(|head| comparison.places[head].is_some());
        if config.optional && !incomplete {
            comparison.absent.push(device);
        } else {
            comparison.differences.push(Difference::Missing { device });
        }
    }
    for (device, _) in scan.devices.iter().zip(&free).filter(|(_, free)| **free) {
        let position = device.position();
        comparison.differences.push(Difference::Added { position });
    }
    match reversed(machine, scan) {
        Some(reversed) => comparison.differences.push(reversed),
        None => order(machine, &mut comparison),
    }
    for (index, config) in machine.devices.enumerate() {
        let place = comparison.places.get(index).copied().flatten();
        if let Some(device) = place.and_then(|at| scan.devices.get(usize::from(at))) {
            compare_device(index, config, device, scan.asked, &mut comparison);
        }
    }
    comparison
}

fn is_product(config: &DeviceConfig, device: &Device) -> bool {
    let ours = config.selection.identity;
    device
        .identity()
        .is_some_and(|i| (i.vendor, i.product) == (ours.vendor, ours.product))
}

/// The bus position of each device of a machine file.
type Positions = IndexVec<DeviceIndex, Option<u16>>;

/// Assigns devices by serial number, which is always unique.
fn by_serial(machine: &Machine, scan: &Scan, places: &mut Positions, free: &mut [bool]) {
    assign(machine, scan, places, free, |config, device| {
        config.serial.is_some() && config.serial == device.serial()
    });
}

fn by_alias(machine: &Machine, scan: &Scan, places: &mut Positions, free: &mut [bool]) {
    assign(machine, scan, places, free, |config, device| {
        match config.at {
            Locator::Position(_) | Locator::Behind(..) => false,
            Locator::Alias(alias) => device.found.alias == alias,
            Locator::Id(id) => device.id == Some(id),
        }
    });
}

/// Returns the head of the segment of a device.
fn head(machine: &Machine, config: &DeviceConfig) -> Option<DeviceIndex> {
    let Locator::Behind(head, _) = config.at else {
        return None;
    };
    let mut all = machine.devices.enumerate();
    let found = all.find(|(_, other)| other.at == head.locator());
    found.map(|(index, _)| index)
}

/// Assigns the devices behind the heads of segments.
fn by_segment(machine: &Machine, scan: &Scan, places: &mut Positions, free: &mut [bool]) {
    let parents: Vec<_> = scan.devices.iter().map(|device| device.uplink).collect();
    for (index, config) in machine.devices.enumerate() {
        let (Locator::Behind(_, place), None) = (config.at, places[index]) else {
            continue;
        };
        let head = head(machine, config).and_then(|head| places[head]);
        let at = head.and_then(|head| topology::nth_behind(&parents, head, place));
        let found = at.and_then(|at| Some((at, free.get_mut(usize::from(at)).filter(|f| **f)?)));
        if let Some((at, free)) = found
            && is_product(config, &scan.devices[usize::from(at)])
        {
            *free = false;
            places[index] = Some(at);
        }
    }
}

/// Assigns each remaining file device the first free bus device that has its product and satisfies
/// `fits`.
fn assign(
    machine: &Machine,
    scan: &Scan,
    places: &mut Positions,
    free: &mut [bool],
    fits: impl Fn(&DeviceConfig, &Device) -> bool,
) {
    for (config, place) in machine.devices.iter().zip(places) {
        if place.is_some() {
            continue;
        }
        let mut all = scan.devices.iter().zip(free.iter_mut());
        let found =
            all.find(|(device, free)| **free && is_product(config, device) && fits(config, device));
        if let Some((device, free)) = found {
            *free = false;
            *place = Some(device.position());
        }
    }
}

/// Assigns devices by the longest common subsequence, so that a missing or added device only shifts
/// the others.
fn by_order(machine: &Machine, scan: &Scan, places: &mut Positions, free: &mut [bool]) {
    let mut expected: Vec<(u16, DeviceIndex)> = machine
        .devices
        .enumerate()
        .filter_map(|(index, config)| match config.at {
            Locator::Position(position) => Some((position, index)),
            _ => None,
        })
        .filter(|(_, index)| places.get(*index).is_some_and(Option::is_none))
        .collect();
    expected.sort_unstable();
    let there: Vec<usize> = (0..scan.devices.len())
        .filter(|at| free.get(*at).copied().unwrap_or(false))
        .collect();
    let same = |e: usize, t: usize| {
        let config = expected.get(e).and_then(|(_, i)| machine.devices.get(*i));
        let device = there.get(t).and_then(|at| scan.devices.get(*at));
        config
            .zip(device)
            .is_some_and(|(config, device)| is_product(config, device))
    };
    for (e, t) in align::longest(expected.len(), there.len(), same) {
        let (Some((_, index)), Some(at)) = (expected.get(e), there.get(t)) else {
            continue;
        };
        if let (Some(place), Some(free)) = (places.get_mut(*index), free.get_mut(*at)) {
            *place = u16::try_from(*at).ok();
            *free = false;
        }
    }
}

/// Assigns the remaining devices of a product to other positions or aliases.
fn match_moved(machine: &Machine, scan: &Scan, comparison: &mut Comparison, free: &mut [bool]) {
    let before = comparison.places.clone();
    // An optional device is known by its own number only.
    assign(machine, scan, &mut comparison.places, free, |config, _| {
        !config.optional
    });
    for (index, config) in machine.devices.enumerate() {
        let now = comparison.places.get(index).copied().flatten();
        let (Some(None), Some(position)) = (before.get(index), now) else {
            continue;
        };
        let device = scan.devices.get(usize::from(position));
        let found = match (config.at, device) {
            (Locator::Alias(_), Some(device)) => device.found.alias,
            (Locator::Id(_), Some(device)) => device.id.unwrap_or(0),
            _ => continue,
        };
        comparison.differences.push(Difference::Alias {
            device: index,
            position,
            expected: config.at,
            found,
        });
    }
}

/// Reports devices that are located by position and have another order.
fn order(machine: &Machine, comparison: &mut Comparison) {
    let mut all: Vec<(u16, u16, DeviceIndex)> = machine
        .devices
        .enumerate()
        .zip(&comparison.places)
        .filter_map(|((index, config), place)| match config.at {
            Locator::Position(position) => Some((position, (*place)?, index)),
            _ => None,
        })
        .collect();
    all.sort_unstable();
    // Use ranks, so that missing or added devices do not count as moves.
    let mut places: Vec<u16> = all.iter().map(|(_, place, _)| *place).collect();
    places.sort_unstable();
    let rank = |place: u16| places.iter().position(|other| *other == place);
    let ranks: Vec<Option<usize>> = all.iter().map(|(_, place, _)| rank(*place)).collect();
    for (n, ((from, to, device), found)) in all.iter().zip(&ranks).enumerate() {
        let Some(found) = *found else { continue };
        if found == n {
            continue;
        }
        let back = ranks.get(found).copied().flatten() == Some(n);
        match all.get(found) {
            Some((_, other_to, other)) if back => {
                // Reported once, by the first of the two.
                if found > n {
                    comparison.differences.push(Difference::Swapped {
                        devices: [*device, *other],
                        positions: [*to, *other_to],
                    });
                }
            }
            _ => comparison.differences.push(Difference::Moved {
                device: *device,
                from: *from,
                to: *to,
            }),
        }
    }
}

/// Finds the device whose IN and OUT are swapped; it is not also reported as moved.
fn reversed(machine: &Machine, scan: &Scan) -> Option<Difference> {
    let status = scan.devices.iter().map(|device| device.found.dl_status);
    let at = topology::reversed(status)?;
    let mut expected: Vec<(u16, DeviceIndex)> = machine
        .devices
        .enumerate()
        .filter_map(|(index, config)| match config.at {
            Locator::Position(position) => Some((position, index)),
            _ => None,
        })
        .collect();
    expected.sort_unstable();
    let same = |e: usize, t: usize| {
        let config = expected.get(e).and_then(|(_, i)| machine.devices.get(*i));
        let pair = config.zip(scan.devices.get(t));
        pair.is_some_and(|(config, device)| is_product(config, device))
    };
    let places = align::moved_from(expected.len(), scan.devices.len(), at, same);
    let devices = places.iter().filter_map(|e| expected.get(*e));
    Some(Difference::Reversed {
        devices: devices.map(|(_, index)| *index).collect(),
        position: u16::try_from(at).unwrap_or(u16::MAX),
    })
}

/// Compares a device that was found.
fn compare_device(
    index: DeviceIndex,
    config: &DeviceConfig,
    device: &Device,
    asked: bool,
    comparison: &mut Comparison,
) {
    let position = device.position();
    let expected = config.selection.identity.revision;
    if let Some(found) = device.identity().map(|i| i.revision)
        && !config.identity.accepts(expected, found)
    {
        comparison.differences.push(Difference::Revision {
            device: index,
            position,
            expected,
            found,
        });
    }
    if let (Some(expected), Some(found)) = (config.serial, device.serial())
        && expected != found
    {
        comparison.differences.push(Difference::Serial {
            device: index,
            position,
            expected,
            found,
        });
    }
    modules(index, config, device, asked, comparison);
}

/// Compares the modules, unless the mode selects the module.
fn modules(
    index: DeviceIndex,
    config: &DeviceConfig,
    device: &Device,
    asked: bool,
    comparison: &mut Comparison,
) {
    let by_mode = config.selection.mode.is_some_and(Mode::is_cyclic);
    if config.device.slots.is_none() || by_mode {
        return;
    }
    let detected = match &device.answers {
        Some(Ok(answers)) => answers.detected.as_ref(),
        _ => None,
    };
    let Some(detected) = detected else {
        if !asked {
            let text = format!("`{}`: its modules, which it was not asked for", config.name);
            comparison.unknown.push(text);
        }
        return;
    };
    let Some(ModuleDifference { expected, found }) = module_difference(config, detected) else {
        return;
    };
    comparison.differences.push(Difference::Modules {
        device: index,
        position: device.position(),
        expected,
        found,
    });
}
