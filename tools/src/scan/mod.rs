//! Enumerates the SubDevices of a segment: identity, state, ports, clocks, mailbox, and on request
//! the parameters of drives. MAY BLOCK AND ALLOCATE.
//!
//! A segment that another MainDevice drives is not disturbed. Registers are read, and EEPROMs if
//! they are free. States and mailboxes are not used unless [`Options::intrude`] is set.
//!
//! - [`registers`]: the controller's registers;
//! - [`other_main_device`]: evidence of another MainDevice;
//! - [`coe_info`]: answers over the CoE mailbox;
//! - [`esi_match`]: matching ESI files;
//! - [`mod@write`]: generates a machine file.

use std::time::Duration;

use ecaxis_ecat::registers as esc;
use ecaxis_esi::Identity;
use ecaxis_esi::sii::{self, General, Protocols, Sii};

use ecaxis_master::acyclic::DatagramClient;
use ecaxis_master::acyclic::al::{self, AlState};
use ecaxis_master::acyclic::delays::{self, MeasuredDevice};
use ecaxis_master::acyclic::device::{read_image, with_mailbox};
use ecaxis_master::acyclic::eeprom::EepromAccess;
use ecaxis_master::acyclic::enumerate::{self, EnumeratedDevice};
use ecaxis_master::acyclic::topology::{ParentPort, parents};
use ecaxis_master::config::{Locator, Machine};
use ecaxis_master::mailbox::MailboxTransport;
use ecaxis_master::report::{Cause, Error};

pub mod coe_info;
pub mod esi_match;
pub mod other_main_device;
pub mod registers;
#[cfg(test)]
pub(crate) mod tests;
pub mod write;

pub use coe_info::{CoeInfo, DriveInfo, GatewayInfo};
pub use esi_match::EsiMatch;
pub use other_main_device::MainDeviceEvidence;
use registers::{CONTROLLER_BYTES, Controller};

/// The time to detect another MainDevice.
const WATCH: Duration = Duration::from_millis(50);

/// The extent of a scan.
#[derive(Debug, Clone, Copy, Default)]
pub struct Options {
    /// Use the mailboxes of the devices; those in Init are in PreOp meanwhile.
    pub ask: bool,
    /// Use the mailboxes even if another MainDevice drives the segment.
    pub intrude: bool,
    /// Request the identification of each device, even if its EEPROM does not say that it has one.
    pub identify: bool,
    /// Foreign frames that the interface received before the first transmission.
    pub heard: u64,
}

/// Returns true if a machine locates devices by their identification.
#[must_use]
pub fn needs_identification(machine: &Machine) -> bool {
    let mut devices = machine.devices.iter();
    devices.any(|device| matches!(device.at, Locator::Id(_)))
}

/// The progress of the scan for display.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ScanStep {
    pub what: &'static str,
    pub position: u16,
    pub of: usize,
}

/// The result of a scan.
#[derive(Debug, Clone, Default)]
pub struct Scan {
    /// The devices in segment order.
    pub devices: Vec<Device>,
    /// Evidence of another MainDevice; empty if there is none.
    pub others: Vec<MainDeviceEvidence>,
    /// True if the mailboxes were used.
    pub asked: bool,
    /// True if the propagation delays were measured; otherwise they are those that another
    /// MainDevice wrote.
    pub measured: bool,
}

/// A SubDevice of the scan.
#[derive(Debug, Clone)]
pub struct Device {
    pub found: EnumeratedDevice,
    pub controller: Controller,
    /// The port that it is connected to; `None`: the MainDevice.
    pub uplink: Option<ParentPort>,
    /// The one-way delay from the first device in ns.
    pub delay_ns: Option<u32>,
    /// True if it has a running system time. Not every device with DC support in 0x0008 has it
    /// enabled.
    pub dc: bool,
    /// The content of its EEPROM, or why it is unknown.
    pub sii: Result<Sii, String>,
    /// The bytes of its EEPROM up to the end of the categories; empty if unknown.
    pub image: Vec<u8>,
    /// The explicit device identification, if supported and readable.
    pub id: Option<u16>,
    /// The answers over CoE, or why there are none.
    pub answers: Option<Result<CoeInfo, String>>,
}

impl Device {
    #[must_use]
    pub fn position(&self) -> u16 {
        self.found.position
    }

    #[must_use]
    pub fn identity(&self) -> Option<Identity> {
        self.sii.as_ref().ok().map(|sii| sii.identity)
    }

    #[must_use]
    pub fn serial(&self) -> Option<u32> {
        self.sii.as_ref().ok().map(|sii| sii.serial)
    }

    /// Returns the type from its EEPROM, or its longer name.
    #[must_use]
    pub fn own_name(&self) -> Option<String> {
        let general = self.sii.as_ref().ok()?.general.as_ref()?;
        let name = [&general.order, &general.name]
            .into_iter()
            .find(|name| !name.is_empty())?;
        Some(name.chars().filter(|c| !c.is_control()).collect())
    }

    /// Returns the names of its mailbox protocols.
    #[must_use]
    pub fn protocols(&self) -> Vec<&'static str> {
        const NAMES: [(u16, &str); 6] = [
            (Protocols::COE, "CoE"),
            (Protocols::FOE, "FoE"),
            (Protocols::EOE, "EoE"),
            (Protocols::AOE, "AoE"),
            (Protocols::SOE, "SoE"),
            (Protocols::VOE, "VoE"),
        ];
        let has = self.sii.as_ref().map(|sii| sii.protocols);
        let has = has.unwrap_or_default();
        let named = NAMES.iter().filter(|(bit, _)| has.has(*bit));
        named.map(|(_, name)| *name).collect()
    }

    /// True if its device type (0x1000) or a Controlword in its EEPROM's PDOs marks it as a drive.
    #[must_use]
    pub fn says_drive(&self) -> bool {
        const CIA_402: u32 = 402;
        const CONTROLWORD: u16 = 0x6040;
        let answered = match &self.answers {
            Some(Ok(answers)) => answers.device_type,
            _ => None,
        };
        if let Some(device_type) = answered
            && device_type & 0xffff == CIA_402
        {
            return true;
        }
        let pdos = self.sii.as_ref().map(|sii| sii.rx_pdos.as_slice());
        let mut entries = pdos.unwrap_or_default().iter().flat_map(|pdo| &pdo.entries);
        // A single bit of a terminal may have the same index.
        entries.any(|entry| entry.index == CONTROLWORD && entry.bit_len == 16)
    }
}

/// Scans all devices on the segment.
///
/// # Errors
/// [`Cause::NoAnswer`], or a device that leaves during the scan. Failures of one device are
/// stored in its result.
pub async fn scan(
    wire: &DatagramClient,
    options: Options,
    report: &mut dyn FnMut(ScanStep),
) -> Result<Scan, Error> {
    let mut found = enumerate::enumerate(wire).await?;
    let others = other_main_device::look(wire, &found, options.heard, WATCH).await?;
    let quiet = others.is_empty();
    // A MainDevice in bring-up assigns addresses and reads EEPROMs.
    let shared = others.iter().any(MainDeviceEvidence::is_live) && !options.intrude;
    if !shared {
        enumerate::address(wire, &mut found).await?;
    }

    let of = found.len();
    let stations: Vec<u16> = found.iter().map(|found| found.station).collect();
    let mut devices = Vec::with_capacity(of);
    for found in found {
        let same = stations.iter().filter(|other| **other == found.station);
        let addressed = found.station != 0 && same.count() == 1;
        let readable = addressed && !(shared && found.state == AlState::Init);
        let position = found.position;
        report(ScanStep {
            what: "reading",
            position,
            of,
        });
        devices.push(look_at(wire, found, readable).await?);
    }
    let uplinks = parents(devices.iter().map(|device| device.found.dl_status));
    for (device, uplink) in devices.iter_mut().zip(uplinks) {
        device.uplink = uplink;
    }
    measure_delays(wire, &mut devices, quiet).await?;

    let mut scan = Scan {
        devices,
        others,
        asked: false,
        measured: quiet,
    };
    if quiet || options.intrude {
        for device in &mut scan.devices {
            device.id = explicit_id(wire, device, options.identify).await?;
        }
    }
    if options.ask && (quiet || options.intrude) {
        scan.asked = true;
        for device in &mut scan.devices {
            let position = device.position();
            report(ScanStep {
                what: "asking",
                position,
                of,
            });
            device.answers = ask(wire, device).await;
        }
    }
    Ok(scan)
}

/// Reads registers and EEPROM without any effect on the state machine.
async fn look_at(
    wire: &DatagramClient,
    found: EnumeratedDevice,
    readable: bool,
) -> Result<Device, Error> {
    const STEP: &str = "reading what its controller is";
    let position = found.position;
    let controller: [u8; CONTROLLER_BYTES] = enumerate::at(wire, position, STEP, esc::TYPE).await?;
    let controller = Controller::from_registers(controller);
    let mut time = [0; 4];
    let dc = controller.has_receive_times()
        && matches!(
            wire.read_at(position, esc::DC_SYSTEM_TIME, &mut time).await,
            Ok(1..)
        );
    let at = found.named(format!("position {position}"));
    let image = if readable {
        let image = read_image(wire, &at, EepromAccess::of(found.state)).await;
        image.map_err(|error| error.to_string())
    } else {
        Err(format!(
            "{at}: its EEPROM was left alone: another master may be reading it"
        ))
    };
    let (sii, image) = match image {
        Ok(image) => (
            sii::parse(&image).map_err(|error| Cause::Sii(error).with_device(&at).to_string()),
            image,
        ),
        Err(problem) => (Err(problem), Vec::new()),
    };
    Ok(Device {
        found,
        controller,
        uplink: None,
        delay_ns: None,
        dc,
        sii,
        image,
        id: None,
        answers: None,
    })
}

/// Measures propagation delays. Latching receive times only disturbs another measurement. With
/// another MainDevice, its written delays are used.
async fn measure_delays(
    wire: &DatagramClient,
    devices: &mut [Device],
    quiet: bool,
) -> Result<(), Error> {
    const STEP: &str = "measuring propagation delays";
    if !quiet {
        for device in devices.iter_mut().filter(|device| device.dc) {
            let bytes =
                enumerate::at(wire, device.position(), STEP, esc::DC_SYSTEM_TIME_DELAY).await?;
            device.delay_ns = Some(u32::from_le_bytes(bytes));
        }
        return Ok(());
    }
    let measured: Vec<_> = devices
        .iter()
        .map(|device| MeasuredDevice {
            position: device.position(),
            dl_status: device.found.dl_status,
            receive_times: device.controller.has_receive_times(),
        })
        .collect();
    let delays = delays::measure(wire, &measured).await?;
    for (device, delay) in devices.iter_mut().zip(delays) {
        device.delay_ns = delay;
    }
    Ok(())
}

/// Reads the explicit device identification if the EEPROM declares it, or `always`. It is requested by AL
/// control in the present state.
async fn explicit_id(
    wire: &DatagramClient,
    device: &Device,
    always: bool,
) -> Result<Option<u16>, Error> {
    const STEP: &str = "reading its device identification";
    let read = async |timeout| {
        let id = al::read_explicit_id(wire, device.found.station, timeout).await;
        id.map_err(|error| Error::from(Cause::Datagram(error)).with_action(STEP))
    };
    let Ok(Sii {
        general: Some(general),
        ..
    }) = &device.sii
    else {
        return Ok(None);
    };
    if general.flags & General::IDENTIFICATION_AL_STATUS != 0 && !device.found.error {
        return read(al::IDENTIFICATION_TIMEOUT).await;
    }
    if general.flags & General::IDENTIFICATION_ADDRESS != 0 {
        let mut bytes = [0; 2];
        let register = general.identification_address;
        let answer = wire.read(device.found.station, register, &mut bytes).await;
        return Ok(matches!(answer, Ok(1..)).then(|| u16::from_le_bytes(bytes)));
    }
    if always && !device.found.error {
        return read(al::SHORT_IDENTIFICATION_TIMEOUT).await;
    }
    Ok(None)
}

/// Reads all CoE objects of the scan; `None` without a CoE mailbox.
async fn ask(wire: &DatagramClient, device: &Device) -> Option<Result<CoeInfo, String>> {
    let sii = device.sii.as_ref().ok()?;
    if !sii.protocols.has(Protocols::COE) {
        return None;
    }
    let at = device
        .found
        .named(format!("position {}", device.position()));
    let answers = with_mailbox(wire, &at, sii, "reading its identity", async |lent| {
        let answers = coe_info::ask(wire, &mut lent.coe, device).await;
        answers.map_err(|error| Cause::Sdo(error).with_device(&at))
    });
    Some(answers.await.map_err(|error| error.to_string()))
}
