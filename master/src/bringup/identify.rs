//! Identifies the SubDevices on the bus and compares them with the machine file.

use std::time::Duration;

use ecaxis_esi::model::{Identification, Identity};
use ethercrab::error::{Error, TimeoutError};
use ethercrab::{MainDevice, SubDeviceIdentity};

use super::{Group, Step, scan_error};
use crate::acyclic::enumerate::{EnumeratedDevice, FIRST_STATION, count, read_device};
use crate::acyclic::{DeviceRef, al};
use crate::config::{DeviceConfig, Locator, Machine};
use crate::datagram::DatagramClient;
use crate::report::{self, Cause};

/// A scanned SubDevice.
struct ScannedDevice {
    identity: Identity,
    serial: u32,
    alias: u16,
    station: u16,
}

/// Finds the device that did not reach PreOp, and the reason. ethercrab reports neither.
pub(super) async fn explain_scan(
    wire: &DatagramClient,
    machine: &Machine,
    error: Error,
) -> report::Error {
    let Ok(count) = count(wire).await else {
        return Cause::NoAnswer.into();
    };
    let (mut behind, mut unaddressed) = (None, None);
    for position in 0..count {
        let device = DeviceRef {
            name: name_at(machine, position),
            position,
            station: FIRST_STATION.saturating_add(position),
        };
        let found = match read_device(wire, position).await {
            Ok(found) => found,
            // It was counted, but no longer answers.
            Err(error) if matches!(*error.cause, Cause::Silent { .. }) => {
                unaddressed.get_or_insert(device);
                continue;
            }
            Err(_) => continue,
        };
        let EnumeratedDevice { state, code, .. } = found;
        // The device has lost the station address that ethercrab assigned.
        if found.station != device.station {
            unaddressed.get_or_insert(device);
        } else if found.error && (code != 0 || !al::emulated(wire, device.station).await) {
            let refused = al::StateError::Refused {
                wanted: al::AlState::PreOp,
                actual: state,
                code,
            };
            return refused.with_device(&device);
        } else if state != al::AlState::PreOp && behind.is_none() {
            behind = Some((device, state));
        }
    }
    if let Some(device) = unaddressed {
        let wanted = al::AlState::PreOp;
        return al::StateError::Gone { wanted }.with_device(&device);
    }
    let missing = positions(machine).filter(|(position, _)| *position >= count);
    let missing: Vec<_> = missing.map(named).collect();
    if !missing.is_empty() {
        let found = usize::from(count);
        return not_all(machine, found, missing);
    }
    match (error, behind) {
        (Error::Timeout(TimeoutError::StateTransition), Some((device, actual))) => {
            let timeout = al::StateError::Timeout {
                wanted: al::AlState::PreOp,
                actual,
                timeout: machine.pre_op_timeout(),
            };
            timeout.with_device(&device)
        }
        (error, _) => scan_error("scanning the segment and going to PreOp", &error),
    }
}

/// Returns the name of the device that the machine file assigns to `position`, or a generic name.
pub(crate) fn name_at(machine: &Machine, position: u16) -> String {
    let device = machine
        .devices
        .iter()
        .find(|d| d.at == Locator::Position(position));
    device.map_or_else(|| format!("device {position}"), |d| d.name.clone())
}

/// Returns the bus position of each device in the machine file. Every SubDevice must be named there
/// and match its ESI.
pub(super) async fn assign(
    wire: &DatagramClient,
    main_device: &MainDevice<'static>,
    group: &Group,
    machine: &Machine,
    progress: &mut dyn FnMut(Step),
) -> Result<Vec<u16>, report::Error> {
    let mut found = Vec::with_capacity(group.len());
    for sub_device in group.iter(main_device) {
        found.push(ScannedDevice {
            identity: identity(sub_device.identity()),
            serial: sub_device.identity().serial,
            alias: sub_device.alias_address(),
            station: sub_device.configured_address(),
        });
    }

    let mut order = Vec::with_capacity(machine.devices.len());
    let mut missing = false;
    for config in &machine.devices {
        let position = match config.at {
            Locator::Position(position) => {
                (usize::from(position) < found.len()).then_some(usize::from(position))
            }
            Locator::Alias(alias) => found.iter().position(|f| f.alias == alias),
            Locator::Id(id) => {
                let stations = found.iter().map(|f| {
                    let timeout = identification_timeout(machine, f.identity);
                    (f.station, timeout)
                });
                al::find_explicit_id(wire, stations, id).await
            }
        };
        match position {
            Some(position) => order.push(u16::try_from(position).unwrap_or(u16::MAX)),
            None => match config.at {
                Locator::Position(_) => missing = true,
                Locator::Alias(alias) => {
                    return Err(not_located(&config.name, format!("alias {alias}")));
                }
                Locator::Id(id) => {
                    return Err(not_located(
                        &config.name,
                        format!("device identification {id}"),
                    ));
                }
            },
        }
    }
    if missing {
        let missing = missing_devices(machine, &found);
        return Err(not_all(machine, found.len(), missing));
    }

    for (config, &position) in machine.devices.iter().zip(&order) {
        let &ScannedDevice {
            identity,
            serial,
            station,
            ..
        } = &found[usize::from(position)];
        let expected = config.selection.identity;
        let device = || DeviceRef {
            name: config.name.clone(),
            position,
            station,
        };
        let product = (expected.vendor, expected.product) == (identity.vendor, identity.product);
        let rule = config.identity;
        if !product || !rule.accepts(expected.revision, identity.revision) {
            return Err(Cause::Identity {
                esi: config.esi_path.display().to_string(),
                expected: format!("{} ({expected})", config.selection.device_name),
                found: known(machine, identity),
                revisions: product.then_some((expected.revision, identity.revision)),
            }
            .with_device(device()));
        }
        if expected.revision != identity.revision {
            let at = device();
            let (found, described) = (identity.revision, expected.revision);
            progress(Step::Warning(format!(
                "{at}: revision 0x{found:08x} stands for 0x{described:08x} of its ESI (identity = \"{rule}\")"
            )));
        }
        if let Some(expected) = config.serial.filter(|expected| *expected != serial) {
            return Err(Cause::Serial {
                expected,
                found: serial,
            }
            .with_device(device()));
        }
    }
    for (position, ScannedDevice { identity, .. }) in found.iter().enumerate() {
        let position = u16::try_from(position).unwrap_or(u16::MAX);
        if !order.contains(&position) {
            let identity = known(machine, *identity);
            return Err(Cause::Unexpected { position, identity }.into());
        }
    }
    Ok(order)
}

/// Returns the time in which a device answers the request of its identification. It is long only if
/// an ESI of the machine says that the device has one.
fn identification_timeout(machine: &Machine, found: Identity) -> Duration {
    let model = |identity: Identity| (identity.vendor, identity.product);
    let mut same = machine
        .devices
        .iter()
        .filter(|config| model(config.selection.identity) == model(found));
    if same.any(|config| config.device.info.identification == Identification::Reg134) {
        al::IDENTIFICATION_TIMEOUT
    } else {
        al::SHORT_IDENTIFICATION_TIMEOUT
    }
}

/// Returns the devices whose positions are missing on the bus. A device missing in the middle of a
/// tree shifts those behind it. If the found models match the file in order, the gaps are the
/// missing devices. Otherwise the last ones are missing.
fn missing_devices(machine: &Machine, found: &[ScannedDevice]) -> Vec<String> {
    let expected: Vec<_> = positions(machine).collect();
    let models = |identity: &Identity| (identity.vendor, identity.product);
    let wanted = expected
        .iter()
        .map(|(_, config)| models(&config.selection.identity));
    let there: Vec<_> = found
        .iter()
        .map(|present| models(&present.identity))
        .collect();
    let missing = lacking(&wanted.collect::<Vec<_>>(), &there);
    let missing = missing.into_iter().filter_map(|index| expected.get(index));
    missing.copied().map(named).collect()
}

/// Returns the devices that the file identifies by position, in the order of the segment.
fn positions(machine: &Machine) -> impl Iterator<Item = (u16, &DeviceConfig)> {
    let mut devices: Vec<_> = machine
        .devices
        .iter()
        .filter_map(|config| match config.at {
            Locator::Position(position) => Some((position, config)),
            Locator::Alias(_) | Locator::Id(_) => None,
        })
        .collect();
    devices.sort_by_key(|(position, _)| *position);
    devices.into_iter()
}

fn named((position, config): (u16, &DeviceConfig)) -> String {
    format!("`{}` (position {position})", config.name)
}

/// Returns the indices of `wanted` that are missing in `there`.
fn lacking<T: PartialEq>(wanted: &[T], there: &[T]) -> Vec<usize> {
    let mut rest = there.iter().peekable();
    let mut lacking = Vec::new();
    for (index, one) in wanted.iter().enumerate() {
        if rest.next_if_eq(&one).is_none() {
            lacking.push(index);
        }
    }
    match rest.next() {
        None => lacking,
        Some(_) => (there.len()..wanted.len()).collect(),
    }
}

fn not_located(name: &str, locator: String) -> report::Error {
    Cause::NotLocated { locator }.with_name(name)
}

fn not_all(machine: &Machine, found: usize, missing: Vec<String>) -> report::Error {
    let expected = machine.devices.len();
    let cause = Cause::Missing {
        expected,
        found,
        missing,
    };
    cause.into()
}

fn identity(from: SubDeviceIdentity) -> Identity {
    Identity {
        vendor: from.vendor_id,
        product: from.product_id,
        revision: from.revision,
    }
}

/// Returns an identity with the name from one of the machine's ESI files.
fn known(machine: &Machine, identity: Identity) -> String {
    machine
        .devices
        .iter()
        .flat_map(|d| d.esi.headers())
        .find(|(described, ..)| *described == identity)
        .map_or_else(
            || identity.to_string(),
            |(.., name)| format!("{name} ({identity})"),
        )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lacking_returns_the_missing_devices() {
        for (there, expected) in [
            ("caab", &[][..]),
            ("cab", &[2]),
            ("ca", &[2, 3]),
            ("cb", &[1, 2]),
            ("aab", &[0]),
            ("", &[0, 1, 2, 3]),
            // The bus has an unexpected device: the last ones count as missing.
            ("cx", &[2, 3]),
        ] {
            let there = there.as_bytes();
            assert_eq!(lacking(b"caab", there), expected, "{there:?}");
        }
    }
}
