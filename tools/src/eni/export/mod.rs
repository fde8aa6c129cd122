//! Machine → ENI: what the bring-up and the cycle of this machine send, for other MainDevices.
//!
//! - `device` describes one SubDevice: identity, process data, mailbox, clock;
//! - `commands` lists its init commands;
//! - `cyclic` lists the frames of a cycle and the process image.

mod commands;
mod cyclic;
mod device;

use ecaxis_ecat::index::DeviceIndex;
use ecaxis_esi::IdnValue;
use ecaxis_master::acyclic::enumerate::FIRST_STATION;
use ecaxis_master::config::{DeviceConfig, Locator, Machine, MailboxSource, SegmentHead};
use ecaxis_master::esi_library::RevisionMatch;
use ecaxis_master::report::Cause;
use ecaxis_master::rt::image::{self, ImagePlan, TooLarge};

use super::command::EcatCommand;
use super::xml::Element;

/// An ENI, and what it cannot say about the machine.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Export {
    pub text: String,
    pub notes: Vec<String>,
}

/// Why a machine has no ENI.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    #[error("a cycle of {0} ns is not a whole number of µs, and an ENI has no other unit")]
    Cycle(u64),
    #[error("`{device}`: {source}")]
    TooLarge { device: String, source: TooLarge },
    #[error("`{device}`: {source}")]
    Fmmus { device: String, source: Box<Cause> },
}

/// A SubDevice with its place on the bus.
struct PlacedDevice<'m> {
    index: DeviceIndex,
    config: &'m DeviceConfig,
    position: u16,
    commands: Vec<EcatCommand>,
}

impl PlacedDevice<'_> {
    fn station(&self) -> u16 {
        FIRST_STATION.saturating_add(self.position)
    }

    /// Returns the auto-increment address: 0, -1, -2 … as 16 bits.
    fn auto_increment(&self) -> u16 {
        0_u16.wrapping_sub(self.position)
    }

    /// Returns true if the device has a clock by its ESI.
    fn has_clock(&self) -> bool {
        !self.config.device.dc_modes.is_empty()
    }
}

/// A machine with everything that the parts of an ENI need.
struct Network<'m> {
    machine: &'m Machine,
    image: ImagePlan,
    /// In the order of the bus.
    devices: Vec<PlacedDevice<'m>>,
    /// The station of the reference clock, if SYNC signals are used.
    reference: Option<u16>,
}

/// Returns the ENI of a machine (schema 1.3).
///
/// # Errors
/// Fails if an ENI cannot express the machine.
pub fn export(machine: &Machine) -> Result<Export, ExportError> {
    let network = Network::new(machine)?;
    let config = Element::new("Config")
        .child(network.main_device())
        .with_children(
            network
                .devices
                .iter()
                .map(|device| device.element(&network)),
        )
        .child(network.cyclic())
        .child(network.process_image());
    let root = Element::new("EtherCATConfig")
        .with_attribute("Version", "1.3")
        .child(config);
    Ok(Export {
        text: root.to_document(),
        notes: network.notes(),
    })
}

/// Returns the datagrams that the bring-up of a machine sends to each device, in the order of the
/// machine file.
pub(super) fn device_commands(machine: &Machine) -> Result<Vec<Vec<EcatCommand>>, ExportError> {
    let mut network = Network::new(machine)?;
    network.devices.sort_by_key(|device| device.index);
    let devices = network.devices.into_iter();
    Ok(devices.map(|device| device.commands).collect())
}

impl<'m> Network<'m> {
    fn new(machine: &'m Machine) -> Result<Self, ExportError> {
        let cycle_ns = machine.bus.cycle_ns;
        if !cycle_ns.is_multiple_of(1000) {
            return Err(ExportError::Cycle(cycle_ns));
        }
        let image = image::of(&machine.rt_config()).map_err(|source| ExportError::TooLarge {
            device: machine.devices[source.device].name.clone(),
            source,
        })?;
        let mut devices: Vec<_> = positions(machine)
            .map(|(index, config, position)| PlacedDevice {
                index,
                config,
                position,
                commands: Vec::new(),
            })
            .collect();
        devices.sort_by_key(|device| device.position);
        for device in &mut devices {
            let commands = device.init_commands(&machine.bus, &image);
            device.commands = commands.map_err(|source| ExportError::Fmmus {
                device: device.config.name.clone(),
                source: Box::new(source),
            })?;
        }
        let used = devices.iter().any(|d| d.config.selection.dc.is_some());
        let reference = devices.iter().find(|device| device.has_clock() && used);
        Ok(Self {
            machine,
            image,
            reference: reference.map(PlacedDevice::station),
            devices,
        })
    }

    /// Returns the number of devices, unless some of them may be absent.
    fn device_count(&self) -> Option<u16> {
        let optional = self.devices.iter().any(|device| device.config.optional);
        u16::try_from(self.devices.len()).ok().filter(|_| !optional)
    }

    /// Returns what the ENI does not contain.
    fn notes(&self) -> Vec<String> {
        let mut notes = Vec::new();
        for device in &self.devices {
            let (config, position) = (device.config, device.position);
            let mut add = |what: &str| notes.push(format!("`{}`: {what}", config.name));
            match config.at {
                Locator::Position(_) => {}
                Locator::Alias(alias) => add(&format!(
                    "located by its alias {alias}; the ENI assumes position {position} and checks the alias there"
                )),
                Locator::Id(id) => add(&format!(
                    "located by its identification {id}, which an ENI of schema 1.3 cannot check; it assumes position {position}"
                )),
                Locator::Behind(..) => add(&format!(
                    "located behind the head of its segment; the ENI assumes position {position}"
                )),
            }
            if config.optional {
                add("optional here; the working counters of the process data include it");
            }
            if matches!(
                config.identity,
                RevisionMatch::Newer | RevisionMatch::Ignore
            ) {
                add("the ENI does not check its revision");
            }
            if config.mailbox == MailboxSource::Eeprom {
                add("`mailbox = \"eeprom\"`; the ENI has the mailboxes of the ESI");
            }
            if config.parameters.is_some() {
                add("its parameter file is not part of the ENI");
            }
            let mut startup = config.selection.startup.iter();
            if startup.any(|sdo| sdo.optional && !sdo.clears_list()) {
                add("it may refuse 0x60C2; another MainDevice may stop there");
            }
            for idn in &config.selection.startup_idns {
                if let IdnValue::Text(text) = &idn.value {
                    add(&format!(
                        "{} = {text} is not part of the ENI: its bytes follow from the attribute that the drive reports; write them as a list",
                        idn.idn
                    ));
                }
            }
            let numbers = self.image.regions.get(device.index).into_iter().flatten();
            if numbers.count() > 0 && device.high_sync_managers() {
                add("schema 1.3 describes SyncManagers 0 to 3; the others have init commands only");
            }
        }
        if !self.image.repeats.is_empty() {
            notes.push(
                "outputs that several PDOs map carry one value here; the ENI does not repeat it"
                    .to_owned(),
            );
        }
        if !self.machine.axes.is_empty() {
            notes.push(
                "limits, supervision and stops of the axes are not part of an ENI: the other MainDevice's program is responsible for the motion"
                    .to_owned(),
            );
        }
        notes
    }
}

/// Returns each device with its position. Devices with another locator take the free positions in
/// the order of the file, optional ones last.
fn positions(machine: &Machine) -> impl Iterator<Item = (DeviceIndex, &DeviceConfig, u16)> {
    let fixed = |config: &DeviceConfig| match config.at {
        Locator::Position(position) => Some(position),
        _ => None,
    };
    let taken: Vec<u16> = machine.devices.iter().filter_map(fixed).collect();
    let mut others: Vec<_> = machine
        .devices
        .enumerate()
        .filter(|(_, config)| fixed(config).is_none())
        .collect();
    others.sort_by_key(|(_, config)| config.optional);
    let free = (0..=u16::MAX).filter(move |position| !taken.contains(position));
    let others = others.into_iter().zip(free);
    let others = others.map(|((index, config), position)| (index, config, position));
    let located = machine.devices.enumerate();
    let located = located.filter_map(move |(index, config)| Some((index, config, fixed(config)?)));
    located.chain(others)
}

/// Returns the alias that a device must have.
fn alias(config: &DeviceConfig) -> Option<u16> {
    match config.at {
        Locator::Alias(alias) => Some(alias),
        _ => None,
    }
}

/// Returns the number of devices behind the head of a segment.
fn followers(machine: &Machine, head: u16) -> usize {
    let behind = |config: &&DeviceConfig| matches!(config.at, Locator::Behind(SegmentHead::Alias(alias), _) if alias == head);
    machine.devices.iter().filter(behind).count()
}
