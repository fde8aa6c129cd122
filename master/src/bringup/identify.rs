//! Identifies the SubDevices on the bus and compares them with the machine file.

use std::ops::RangeInclusive;
use std::time::Duration;

use ecaxis_ecat::registers::DL_STATUS;
use ecaxis_esi::model::{Identification, Identity};
use ethercrab::error::{Error, TimeoutError};
use ethercrab::{MainDevice, SubDeviceIdentity};

use super::{Group, ScanFailure, Step, align, scan_error};
use crate::acyclic::device::read_sii;
use crate::acyclic::eeprom::EepromAccess;
use crate::acyclic::enumerate::{EnumeratedDevice, FIRST_STATION, count, read_device};
use crate::acyclic::{DeviceRef, al, enumerate, topology};
use crate::concurrent::try_join_all;
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
    failure: ScanFailure,
) -> report::Error {
    let Ok(count) = count(wire).await else {
        return Cause::NoAnswer { second_end: None }.into();
    };
    let (mut behind, mut unaddressed) = (None, None);
    let mut all = Vec::new();
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
        all.push(found.clone());
        let EnumeratedDevice { state, code, .. } = found;
        // The device has lost the station address that ethercrab assigned.
        if found.station != device.station {
            unaddressed.get_or_insert(device);
        } else if found.error && (code != 0 || !al::emulated(wire, device.station).await) {
            // Its mailbox may be in the damaged part.
            if code == al::INVALID_MAILBOX
                && let Some(damaged) = damaged_eeprom(wire, &device, state).await
            {
                return damaged;
            }
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
    if positions(machine).any(|(position, _)| position >= count) {
        let there = present(wire, machine, &all).await;
        let missing = missing_devices(machine, &there);
        return devices_missing(machine, usize::from(count), missing);
    }
    if matches!(failure, ScanFailure::Failed(Error::Topology))
        && let Some(at) = topology::reversed(all.iter().map(|found| found.dl_status))
    {
        let port = entry_port(all.get(at).map_or(0, |found| found.dl_status));
        let there = present(wire, machine, &all).await;
        return reversed(machine, at, port, &there);
    }
    let late = Error::Timeout(TimeoutError::StateTransition);
    if let (ScanFailure::Failed(error), Some((device, actual))) = (&failure, behind)
        && *error == late
    {
        let timeout = al::StateError::Timeout {
            wanted: al::AlState::PreOp,
            actual,
            code: 0,
            timeout: machine.pre_op_timeout(),
        };
        return timeout.with_device(&device);
    }
    // Not for errors of the wire: they have nothing to do with what an EEPROM contains.
    let by_content = !matches!(
        failure,
        ScanFailure::Failed(Error::Timeout(_) | Error::Pdu(_) | Error::WorkingCounter { .. })
    );
    for found in all.iter().filter(|_| by_content) {
        let device = found.named(name_at(machine, found.position));
        if let Some(damaged) = damaged_eeprom(wire, &device, found.state).await {
            return damaged;
        }
    }
    match failure {
        ScanFailure::Failed(error) => scan_error("scanning the segment and going to PreOp", &error),
        ScanFailure::Panicked(text) => Cause::Panicked(text).into(),
    }
}

/// Returns what is wrong with a device's EEPROM; `None` if nothing is, or it cannot be read.
pub(super) async fn damaged_eeprom(
    wire: &DatagramClient,
    device: &DeviceRef,
    state: al::AlState,
) -> Option<report::Error> {
    match read_sii(wire, device, EepromAccess::of(state)).await {
        Ok(sii) => {
            let damage = sii.damage.into_iter().next()?;
            Some(Cause::DamagedEeprom(damage).with_device(device))
        }
        Err(error) => matches!(*error.cause, Cause::Sii(_)).then_some(error),
    }
}

/// A product: vendor and product code. `None` if it is unknown.
type Product = Option<(u32, u32)>;

fn product(identity: Identity) -> Product {
    Some((identity.vendor, identity.product))
}

/// Reads the products of the SubDevices that the file does not locate by alias.
async fn present(
    wire: &DatagramClient,
    machine: &Machine,
    all: &[EnumeratedDevice],
) -> Vec<Product> {
    let by_alias = |alias| {
        machine
            .devices
            .iter()
            .any(|d| d.at == Locator::Alias(alias))
    };
    let mut products = Vec::new();
    for found in all.iter().filter(|found| !by_alias(found.alias)) {
        let device = found.named(name_at(machine, found.position));
        let sii = read_sii(wire, &device, EepromAccess::of(found.state)).await;
        products.push(sii.ok().and_then(|sii| product(sii.identity)));
    }
    products
}

/// Returns the port at which frames enter a device that they do not enter at port 0.
fn entry_port(dl_status: u16) -> u8 {
    let open = (0..).zip(topology::open_ports(dl_status)).skip(1);
    let mut open = open.into_iter();
    open.find_map(|(port, open)| open.then_some(port))
        .unwrap_or(0)
}

/// Returns the station addresses if a device with swapped IN and OUT does not matter: nothing uses
/// clocks, and no position in the file means another device because of it.
pub(super) async fn tolerate_reversed(
    wire: &DatagramClient,
    machine: &Machine,
    count: u16,
    progress: &dyn Fn(Step),
) -> Option<RangeInclusive<u16>> {
    let first = positions(machine).next().map(|(position, _)| position);
    let clocks = machine.devices.iter().any(|d| d.selection.dc.is_some());
    if clocks || first == Some(0) {
        return None;
    }
    let each = (0..count).map(|at| enumerate::at(wire, at, "reading its ports", DL_STATUS));
    let status = try_join_all(each).await.ok()?;
    let status: Vec<u16> = status.into_iter().map(u16::from_le_bytes).collect();
    let at = topology::reversed(status.iter().copied())?;
    if first.is_some_and(|first| usize::from(first) <= at) {
        return None;
    }
    let port = entry_port(status.get(at).copied().unwrap_or(0));
    progress(Step::Warning(format!(
        "IN and OUT are swapped at the device at position {at}: frames enter at its port {port} instead of port 0. \
         No device uses distributed clocks, so the run goes on"
    )));
    Some(stations(count))
}

/// Returns the station addresses that ethercrab's scan assigns.
pub(super) fn stations(count: u16) -> RangeInclusive<u16> {
    FIRST_STATION..=FIRST_STATION.saturating_add(count.saturating_sub(1))
}

/// Names the device whose IN and OUT are swapped. `at`: its index on the bus; `port`: the port at which
/// frames enter.
fn reversed(machine: &Machine, at: usize, port: u8, there: &[Product]) -> report::Error {
    let expected: Vec<_> = positions(machine).collect();
    let same = |wanted: usize, found: usize| is_product(expected.get(wanted), there.get(found));
    let places = align::moved_from(expected.len(), there.len(), at, same);
    let candidates = places.into_iter().filter_map(|index| expected.get(index));
    let cause = Cause::Reversed {
        position: u16::try_from(at).unwrap_or(u16::MAX),
        port,
        candidates: candidates.copied().map(named).collect(),
    };
    cause.into()
}

fn is_product(wanted: Option<&(u16, &DeviceConfig)>, found: Option<&Product>) -> bool {
    let Some((_, config)) = wanted else {
        return false;
    };
    found.is_some_and(|found| *found == product(config.selection.identity))
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
    progress: &dyn Fn(Step),
) -> Result<Vec<Option<u16>>, report::Error> {
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
    let mut elsewhere = Vec::new();
    let mut optional = Vec::new();
    let mut missing = false;
    for config in &machine.devices {
        let position = match config.at {
            Locator::Position(_) | Locator::Behind(..) => None,
            Locator::Alias(alias) => found.iter().position(|f| f.alias == alias),
            Locator::Id(id) => {
                let stations = found.iter().map(|f| {
                    let timeout = identification_timeout(machine, f.identity);
                    (f.station, timeout)
                });
                al::find_explicit_id(wire, stations, id).await
            }
        };
        let position = position.map(|position| u16::try_from(position).unwrap_or(u16::MAX));
        elsewhere.extend(position);
        optional.extend(position.filter(|_| config.optional));
        order.push(position);
        let locator = match config.at {
            Locator::Alias(alias) => format!("alias {alias}"),
            Locator::Id(id) => format!("device identification {id}"),
            Locator::Position(_) | Locator::Behind(..) => continue,
        };
        if position.is_none() && !config.optional {
            return Err(not_located(&config.name, locator));
        }
    }
    if let Some(segments) = segments(wire, machine, &order, found.len()).await? {
        for (order, place) in order.iter_mut().zip(segments) {
            elsewhere.extend(place);
            optional.extend(place);
            *order = order.or(place);
        }
    }
    // Positions do not count optional devices.
    let steady = (0_u16..)
        .take(found.len())
        .filter(|at| !optional.contains(at));
    let steady: Vec<_> = steady.collect();
    for (config, order) in machine.devices.iter().zip(&mut order) {
        if let Locator::Position(position) = config.at {
            *order = steady.get(usize::from(position)).copied();
            missing |= order.is_none();
        }
    }
    // The products at the positions that the file does not locate otherwise.
    let there: Vec<Product> = (0_u16..)
        .zip(&found)
        .filter(|(position, _)| !elsewhere.contains(position))
        .map(|(_, found)| product(found.identity))
        .collect();
    let is_shifted = is_shifted(machine, &there);
    let lacking = || {
        let missing = missing_devices(machine, &there);
        devices_missing(machine, found.len(), missing)
    };
    // Another device in the place of one is named first; it does not answer for those behind it.
    if missing && (is_shifted || !holds_others(machine, &there)) {
        return Err(lacking());
    }

    let located = machine.devices.iter().zip(&order);
    for (config, position) in located.filter_map(|(config, position)| Some((config, (*position)?)))
    {
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
        let is_product = product(expected) == product(identity);
        if !is_product && is_shifted && belongs_elsewhere(machine, identity) {
            let missing = missing_devices(machine, &there);
            if !missing.is_empty() {
                return Err(devices_missing(machine, found.len(), missing));
            }
        }
        compare(machine, config, (identity, serial), &device())?;
        if expected.revision != identity.revision {
            let (at, rule) = (device(), config.identity);
            let (found, described) = (identity.revision, expected.revision);
            progress(Step::Warning(format!(
                "{at}: revision 0x{found:08x} stands for 0x{described:08x} of its ESI (identity = \"{rule}\")"
            )));
        }
    }
    if missing {
        return Err(lacking());
    }
    for (position, ScannedDevice { identity, .. }) in found.iter().enumerate() {
        let position = u16::try_from(position).unwrap_or(u16::MAX);
        if !order.contains(&Some(position)) {
            let identity = known(machine, *identity);
            return Err(Cause::Unexpected { position, identity }.into());
        }
    }
    Ok(order)
}

/// Returns the positions of the devices behind the heads of segments. `None` if the file has none.
async fn segments(
    wire: &DatagramClient,
    machine: &Machine,
    order: &[Option<u16>],
    count: usize,
) -> Result<Option<Vec<Option<u16>>>, report::Error> {
    const STEP: &str = "reading the ports of segments";
    let behind = |config: &DeviceConfig| match config.at {
        Locator::Behind(head, place) => Some((head.locator(), place)),
        _ => None,
    };
    if machine
        .devices
        .iter()
        .all(|config| behind(config).is_none())
    {
        return Ok(None);
    }
    let count = u16::try_from(count).unwrap_or(u16::MAX);
    let status = enumerate::words(wire, count, STEP, DL_STATUS).await?;
    let status = (0..).zip(status);
    let parents = topology::parents(
        status.map(|(position, status)| topology::in_line(position, status, wire.ring())),
    );
    let located = || machine.devices.iter().zip(order);
    let place = |config: &DeviceConfig| {
        let (head, place) = behind(config)?;
        let (_, head) = located().find(|(other, _)| other.at == head)?;
        let (head, position) = ((*head)?, topology::nth_behind(&parents, (*head)?, place)?);
        // A device with a number of its own ends the segment.
        let mut between = (head + 1)..=position;
        between
            .all(|at| !order.contains(&Some(at)))
            .then_some(position)
    };
    Ok(Some(machine.devices.iter().map(place).collect()))
}

/// Returns true if the machine file accepts a device of this identity.
pub(crate) fn accepts(config: &DeviceConfig, identity: Identity) -> bool {
    let expected = config.selection.identity;
    let revision = config
        .identity
        .accepts(expected.revision, identity.revision);
    product(expected) == product(identity) && revision
}

/// Compares identity and serial number of a device with the machine file.
///
/// # Errors
/// [`Cause::Identity`], [`Cause::Serial`].
pub(crate) fn compare(
    machine: &Machine,
    config: &DeviceConfig,
    (identity, serial): (Identity, u32),
    at: &DeviceRef,
) -> Result<(), report::Error> {
    let expected = config.selection.identity;
    if !accepts(config, identity) {
        let is_product = product(expected) == product(identity);
        return Err(Cause::Identity {
            esi: config.esi_path.display().to_string(),
            expected: format!("{} ({expected})", config.selection.device_name),
            found: known(machine, identity),
            revisions: is_product.then_some((expected.revision, identity.revision)),
        }
        .with_device(at));
    }
    match config.serial.filter(|expected| *expected != serial) {
        Some(expected) => Err(Cause::Serial {
            expected,
            found: serial,
        }
        .with_device(at)),
        None => Ok(()),
    }
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

/// True if the file has a device of this product at a position.
fn belongs_elsewhere(machine: &Machine, identity: Identity) -> bool {
    positions(machine).any(|(_, config)| product(config.selection.identity) == product(identity))
}

/// Returns true if more devices are as in the file when some are moved along the segment: one is
/// missing in the middle, or one too many is there. Otherwise a device that differs is another one in
/// its place.
fn is_shifted(machine: &Machine, there: &[Product]) -> bool {
    let expected: Vec<_> = positions(machine).collect();
    let same = |wanted: usize, found: usize| is_product(expected.get(wanted), there.get(found));
    let in_place = (0..there.len()).filter(|at| same(*at, *at)).count();
    align::longest(expected.len(), there.len(), same).len() > in_place
}

/// Returns true if the device at a position is not the one of the file.
fn holds_others(machine: &Machine, there: &[Product]) -> bool {
    let mut pairs = positions(machine).zip(there);
    pairs.any(|(expected, found)| !is_product(Some(&expected), Some(found)))
}

/// Returns the devices of the file that are missing on the bus, as `compare` does. A device missing
/// in the middle shifts those behind it. If no product is known, the last ones are missing.
fn missing_devices(machine: &Machine, there: &[Product]) -> Vec<String> {
    let expected: Vec<_> = positions(machine).collect();
    let same = |wanted: usize, found: usize| is_product(expected.get(wanted), there.get(found));
    let missing = match there.iter().all(Option::is_none) {
        true => (there.len()..expected.len()).collect(),
        false => align::missing(expected.len(), there.len(), same),
    };
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
            Locator::Alias(_) | Locator::Id(_) | Locator::Behind(..) => None,
        })
        .collect();
    devices.sort_by_key(|(position, _)| *position);
    devices.into_iter()
}

fn named((position, config): (u16, &DeviceConfig)) -> String {
    format!("`{}` (position {position})", config.name)
}

fn not_located(name: &str, locator: String) -> report::Error {
    Cause::NotLocated { locator }.with_name(name)
}

fn devices_missing(machine: &Machine, found: usize, missing: Vec<String>) -> report::Error {
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
pub(crate) fn known(machine: &Machine, identity: Identity) -> String {
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
