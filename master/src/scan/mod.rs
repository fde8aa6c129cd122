//! Who is on a segment, and what they are: position, identity, state, ports, clocks, mailbox, and on request what drives say of
//! themselves. MAY BLOCK AND ALLOCATE.
//!
//! A segment that another MainDevice drives stays as it is: registers are read, EEPROMs where nobody holds them; states and mailboxes
//! are left alone unless [`Options::intrude`] says otherwise.
//!
//! - [`registers`]: what the controller's registers mean;
//! - [`tree`]: who hangs at whose port, and how far away in time;
//! - [`others`]: signs of another MainDevice;
//! - [`answers`]: what a device says over its mailbox;
//! - [`described`]: the ESI files that fit;
//! - [`write`]: the machine file that follows from all that.

use std::time::Duration;

use ecaxis_esi::Identity;
use ecaxis_esi::sii::{self, General, Protocols, Sii};

use crate::bringup::DeviceRef;
use crate::bringup::al::{self, AlState};
use crate::mailbox::Wire;
use crate::service::device::with_mailbox;
use crate::service::eeprom::{Claim, with_eeprom};
use crate::service::station::{self, Found};
use crate::service::{Datagrams, ServiceError};

pub mod answers;
pub mod described;
pub mod others;
pub mod registers;
#[cfg(test)]
mod tests;
pub mod tree;
pub mod write;

pub use answers::{Answers, DriveAnswers};
pub use described::Described;
pub use others::Sign;
use registers::{CONTROLLER_BYTES, Controller};
pub use tree::Uplink;

/// Another MainDevice shows within this time.
const WATCH: Duration = Duration::from_millis(50);
/// Receive times are latched so often; the delays are averaged.
const LATCHES: u32 = 8;

const CONTROLLER: u16 = 0x0000;
const DL_STATUS: u16 = 0x0110;
const RECEIVE_TIMES: u16 = 0x0900;
const SYSTEM_TIME: u16 = 0x0910;
const SYSTEM_TIME_DELAY: u16 = 0x0928;

/// How far a scan goes.
#[derive(Debug, Clone, Copy, Default)]
pub struct Options {
    /// Devices are asked over their mailboxes; those in Init are in PreOp meanwhile.
    pub ask: bool,
    /// Even where another MainDevice drives the segment.
    pub intrude: bool,
    /// Frames of others that the interface heard before anything was sent.
    pub heard: u64,
}

/// What is being done, for the user to see: a device of so many.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Step {
    pub what: &'static str,
    pub position: u16,
    pub of: usize,
}

/// A segment as it was found.
#[derive(Debug, Clone, Default)]
pub struct Scan {
    /// In the order of the segment.
    pub devices: Vec<Device>,
    /// What tells of another MainDevice; empty where there is none.
    pub others: Vec<Sign>,
    /// The devices were asked over their mailboxes.
    pub asked: bool,
    /// Propagation delays were measured; otherwise they are what another MainDevice wrote.
    pub measured: bool,
}

/// A SubDevice as it was found.
#[derive(Debug, Clone)]
pub struct Device {
    pub found: Found,
    pub controller: Controller,
    /// DL status (0x0110).
    pub dl_status: u16,
    /// The port that it hangs at; `None`: the MainDevice's.
    pub uplink: Option<Uplink>,
    /// From the first device, nanoseconds, one way.
    pub delay_ns: Option<u32>,
    /// It has a system time: not every one that says so in 0x0008 has it switched on.
    pub dc: bool,
    /// What its EEPROM says, or why that is not known.
    pub sii: Result<Sii, String>,
    /// Explicit device identification, where it has one and could be asked.
    pub id: Option<u16>,
    /// What it says over CoE; `Err`: why it did not.
    pub answers: Option<Result<Answers, String>>,
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

    /// As its EEPROM calls it: by its type, or by a longer name.
    #[must_use]
    pub fn own_name(&self) -> Option<String> {
        let general = self.sii.as_ref().ok()?.general.as_ref()?;
        let name = [&general.order, &general.name]
            .into_iter()
            .find(|name| !name.is_empty())?;
        Some(name.chars().filter(|c| !c.is_control()).collect())
    }

    /// Names of its mailbox protocols.
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

    /// By what it says itself: device type (0x1000) or the Controlword in its EEPROM's PDOs.
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
        // A bit of a terminal may have the number, too.
        entries.any(|entry| entry.index == CONTROLWORD && entry.bit_len == 16)
    }
}

/// Looks at everybody on the segment.
///
/// # Errors
/// [`ServiceError::NoAnswer`], and devices that leave meanwhile. What one device alone keeps to itself is told of that device.
pub async fn scan(
    wire: &Datagrams,
    options: Options,
    tell: &mut dyn FnMut(Step),
) -> Result<Scan, ServiceError> {
    let mut found = station::census(wire).await?;
    let others = others::look(wire, &found, options.heard, WATCH).await?;
    let quiet = others.is_empty();
    // One that is bringing the segment up gives out addresses and reads EEPROMs itself.
    let shared = others.iter().any(Sign::is_live) && !options.intrude;
    if !shared {
        station::address(wire, &mut found).await?;
    }

    let of = found.len();
    let stations: Vec<u16> = found.iter().map(|found| found.station).collect();
    let mut devices = Vec::with_capacity(of);
    for found in found {
        let same = stations.iter().filter(|other| **other == found.station);
        let addressed = found.station != 0 && same.count() == 1;
        let readable = addressed && !(shared && found.state == AlState::Init);
        let position = found.position;
        tell(Step {
            what: "reading",
            position,
            of,
        });
        devices.push(look_at(wire, found, readable).await?);
    }
    place(&mut devices);
    delays(wire, &mut devices, quiet).await?;

    let mut scan = Scan {
        devices,
        others,
        asked: false,
        measured: quiet,
    };
    if quiet || options.intrude {
        for device in &mut scan.devices {
            device.id = explicit_id(wire, device).await?;
        }
    }
    if options.ask && (quiet || options.intrude) {
        scan.asked = true;
        for device in &mut scan.devices {
            let position = device.position();
            tell(Step {
                what: "asking",
                position,
                of,
            });
            device.answers = ask(wire, device).await;
        }
    }
    Ok(scan)
}

/// Registers and EEPROM; nothing that a state machine would notice.
async fn look_at(wire: &Datagrams, found: Found, readable: bool) -> Result<Device, ServiceError> {
    const STEP: &str = "reading what its controller is";
    let position = found.position;
    let controller: [u8; CONTROLLER_BYTES] = station::at(wire, position, STEP, CONTROLLER).await?;
    let dl_status: [u8; 2] = station::at(wire, position, STEP, DL_STATUS).await?;
    let controller = Controller::from_registers(controller);
    let mut time = [0; 4];
    let dc = controller.has_receive_times()
        && matches!(
            wire.read_at(position, SYSTEM_TIME, &mut time).await,
            Ok(1..)
        );
    let at = found.named(format!("position {position}"));
    let sii = if readable {
        read_eeprom(wire, &at).await
    } else {
        Err(format!(
            "{at}: its EEPROM was left alone: another master may be reading it"
        ))
    };
    Ok(Device {
        found,
        controller,
        dl_status: u16::from_le_bytes(dl_status),
        uplink: None,
        delay_ns: None,
        dc,
        sii,
        id: None,
        answers: None,
    })
}

/// Only where nobody holds it.
async fn read_eeprom(wire: &Datagrams, at: &DeviceRef) -> Result<Sii, String> {
    const STEP: &str = "reading the EEPROM";
    let read = with_eeprom(wire, at, STEP, Claim::IfFree, async |eeprom| {
        eeprom.image(&mut |_, _| {}).await
    });
    let image: Result<Vec<u8>, ServiceError> = read.await;
    let image = image.map_err(|error| error.to_string())?;
    sii::parse(&image).map_err(|error| format!("EEPROM: {error}"))
}

/// Finds every device's parent.
fn place(devices: &mut [Device]) {
    let open: Vec<[bool; 4]> = devices
        .iter()
        .map(|device| registers::open_ports(device.dl_status))
        .collect();
    for (device, uplink) in devices.iter_mut().zip(tree::uplinks(&open)) {
        device.uplink = uplink;
    }
}

/// Measures how long frames take to each device. Latching the receive times disturbs nobody but one who measures, too; where there is
/// another MainDevice, what it has written is taken.
async fn delays(wire: &Datagrams, devices: &mut [Device], quiet: bool) -> Result<(), ServiceError> {
    const STEP: &str = "measuring propagation delays";
    if !quiet {
        for device in devices.iter_mut().filter(|device| device.dc) {
            let bytes = station::at(wire, device.position(), STEP, SYSTEM_TIME_DELAY).await?;
            device.delay_ns = Some(u32::from_le_bytes(bytes));
        }
        return Ok(());
    }
    let places: Vec<_> = devices
        .iter()
        .map(|device| tree::Place {
            open: registers::open_ports(device.dl_status),
            uplink: device.uplink,
        })
        .collect();
    let mut sums = vec![0_i64; devices.len()];
    let mut measured = vec![false; devices.len()];
    for _ in 0..LATCHES {
        wire.write_all(RECEIVE_TIMES, &[0; 4])
            .await
            .map_err(|source| ServiceError::Segment { step: STEP, source })?;
        let mut times = Vec::with_capacity(devices.len());
        for device in devices.iter() {
            times.push(if device.controller.has_receive_times() {
                let bytes: [u8; 16] =
                    station::at(wire, device.position(), STEP, RECEIVE_TIMES).await?;
                Some(registers::receive_times(bytes))
            } else {
                None
            });
        }
        let delays = tree::delays(&places, &times);
        for ((sum, measured), delay) in sums.iter_mut().zip(&mut measured).zip(delays) {
            if let Some(delay) = delay {
                *sum += delay;
                *measured = true;
            }
        }
    }
    for ((device, sum), measured) in devices.iter_mut().zip(sums).zip(measured) {
        let mean = sum / i64::from(LATCHES);
        device.delay_ns = measured.then(|| u32::try_from(mean.max(0)).unwrap_or(u32::MAX));
    }
    Ok(())
}

/// Where the EEPROM says that there is one. Asked in AL control, with the state as it is.
async fn explicit_id(wire: &Datagrams, device: &Device) -> Result<Option<u16>, ServiceError> {
    const STEP: &str = "reading its device identification";
    let Ok(Sii {
        general: Some(general),
        ..
    }) = &device.sii
    else {
        return Ok(None);
    };
    if general.flags & General::IDENTIFICATION_AL_STATUS != 0 && !device.found.error {
        let id = al::read_explicit_id(wire, device.found.station).await;
        return id.map_err(|source| ServiceError::Segment { step: STEP, source });
    }
    if general.flags & General::IDENTIFICATION_ADDRESS != 0 {
        let mut bytes = [0; 2];
        let register = general.identification_address;
        let answer = wire.read(device.found.station, register, &mut bytes).await;
        return Ok(matches!(answer, Ok(1..)).then(|| u16::from_le_bytes(bytes)));
    }
    Ok(None)
}

/// Everything that is asked over CoE; `None` where there is no such mailbox.
async fn ask(wire: &Datagrams, device: &Device) -> Option<Result<Answers, String>> {
    let sii = device.sii.as_ref().ok()?;
    if !sii.protocols.has(Protocols::COE) {
        return None;
    }
    let at = device
        .found
        .named(format!("position {}", device.position()));
    let answers = with_mailbox(wire, &at, sii, "asking it who it is", async |lent| {
        let answers = answers::ask(wire, &mut lent.coe, device).await;
        answers.map_err(|source| ServiceError::Sdo {
            device: at.clone(),
            source,
        })
    });
    Some(answers.await.map_err(|error| error.to_string()))
}
