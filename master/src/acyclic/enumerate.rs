//! Enumerates the SubDevices of a segment and assigns station addresses.

use crate::acyclic::{AlState, DeviceRef};
use crate::concurrent::try_join_all;
use crate::config::Locator;
use crate::datagram::DatagramClient;
use crate::mailbox::DatagramError;
use crate::report::{Cause, Error};
use ecaxis_ecat::registers;

/// The number of broadcasts without an answer after which a segment counts as silent.
const MAX_ATTEMPTS: u32 = 5;
/// The first station address assigned, as in ethercrab.
pub const FIRST_STATION: u16 = 0x1000;

const STEP: &str = "looking for SubDevices";

/// A SubDevice as its registers describe it.
///
/// Only [`enumerate`] reads all devices. Callers read further data for the devices that need it:
/// [`super::device::read_sii`] the EEPROM, [`super::device::with_mailbox`] objects.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EnumeratedDevice {
    pub position: u16,
    /// The station address; 0: not assigned.
    pub station: u16,
    /// The station alias that the controller loaded from the EEPROM at power-on.
    pub alias: u16,
    /// DL status (0x0110).
    pub dl_status: u16,
    pub state: AlState,
    /// `true` if the device has an unacknowledged error.
    pub error: bool,
    /// The AL status code.
    pub code: u16,
}

impl EnumeratedDevice {
    /// Returns a reference to the device with a name.
    #[must_use]
    pub fn named(&self, name: impl Into<String>) -> DeviceRef {
        DeviceRef {
            name: name.into(),
            position: self.position,
            station: self.station,
        }
    }
}

/// DL status, AL status and AL status code, read by one datagram.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct StatusRegisters {
    pub dl_status: u16,
    pub al_status: u8,
    pub al_code: u16,
}

impl StatusRegisters {
    /// The first register, and the number of bytes.
    pub const START: u16 = registers::DL_STATUS;
    pub const LEN: usize = (registers::AL_STATUS_CODE + 2 - Self::START) as usize;

    pub fn parse(bytes: &[u8; Self::LEN]) -> Self {
        let offset = |register: u16| usize::from(register - Self::START);
        let word = |register: u16| {
            let at = offset(register);
            u16::from_le_bytes([bytes[at], bytes[at + 1]])
        };
        Self {
            dl_status: word(registers::DL_STATUS),
            al_status: bytes[offset(registers::AL_STATUS)],
            al_code: word(registers::AL_STATUS_CODE),
        }
    }
}

/// Returns the device at a position or with an alias. Identifications are not in a snapshot:
/// [`super::device::locate`] reads them.
///
/// # Errors
/// [`Cause::NotFound`], [`Cause::Ambiguous`].
pub fn select(all: &[EnumeratedDevice], at: Locator) -> Result<&EnumeratedDevice, Error> {
    let fits = |found: &&EnumeratedDevice| match at {
        Locator::Position(position) => found.position == position,
        Locator::Alias(alias) => found.alias == alias,
        Locator::Id(_) | Locator::Behind(..) => false,
    };
    let fitting: Vec<&EnumeratedDevice> = all.iter().filter(fits).collect();
    let list = |values: &mut dyn Iterator<Item = u16>| {
        let each: Vec<String> = values.map(|value| value.to_string()).collect();
        each.join(", ")
    };
    match *fitting {
        [one] => Ok(one),
        [] => Err(Error::from(Cause::NotFound {
            wanted: at.to_string(),
            found: match (at, all.len()) {
                (Locator::Id(_) | Locator::Behind(..), n) => format!("{n} were asked"),
                (_, 1) => "1 answers, at position 0".to_owned(),
                (Locator::Alias(_), n) if all.iter().all(|found| found.alias == 0) => {
                    format!("none of the {n} has one")
                }
                (Locator::Alias(_), _) => {
                    let aliases = list(&mut all.iter().map(|found| found.alias));
                    format!("their aliases are {aliases}")
                }
                (Locator::Position(_), n) => {
                    format!("{n} answer, at positions 0 to {}", n.saturating_sub(1))
                }
            },
        })),
        _ => Err(Error::from(Cause::Ambiguous {
            wanted: at.to_string(),
            count: fitting.len(),
            positions: list(&mut fitting.iter().map(|found| found.position)),
        })),
    }
}

/// Returns all SubDevices in segment order. Only reads.
///
/// # Errors
/// [`Cause::NoAnswer`]; [`Cause::Silent`] if a device leaves meanwhile.
pub async fn enumerate(wire: &DatagramClient) -> Result<Vec<EnumeratedDevice>, Error> {
    let mut found = Vec::new();
    for position in 0..count(wire).await? {
        found.push(read_device(wire, position).await?);
    }
    Ok(found)
}

/// Reads the registers of one SubDevice by its position.
///
/// # Errors
/// [`Cause::Silent`] if no device answers.
pub async fn read_device(wire: &DatagramClient, position: u16) -> Result<EnumeratedDevice, Error> {
    let addresses = at(wire, position, STEP, registers::STATION_ADDRESS).await?;
    let [s0, s1, a0, a1] = addresses;
    let status = at(wire, position, STEP, StatusRegisters::START).await?;
    let status = StatusRegisters::parse(&status);
    Ok(EnumeratedDevice {
        position,
        station: u16::from_le_bytes([s0, s1]),
        alias: u16::from_le_bytes([a0, a1]),
        dl_status: status.dl_status,
        state: AlState::from_status(status.al_status),
        error: AlState::has_error(status.al_status),
        code: status.al_code,
    })
}

/// Returns the number of devices that answer a broadcast; at least 1.
///
/// # Errors
/// [`Cause::NoAnswer`], with the second interface of the ring if there is one;
/// [`Cause::Datagram`].
pub async fn count(wire: &DatagramClient) -> Result<u16, Error> {
    for _ in 0..MAX_ATTEMPTS {
        match wire.count().await {
            Ok(0) | Err(DatagramError::Timeout { .. }) => {}
            Ok(count) => return Ok(count),
            Err(error) => return Err(Error::from(Cause::Datagram(error)).with_action(STEP)),
        }
    }
    let second_end = wire.find_second_end();
    Err(Cause::NoAnswer { second_end }.into())
}

/// Reads bytes of a device by its position.
///
/// # Errors
/// [`Cause::Silent`] if no device answers.
pub async fn at<const N: usize>(
    wire: &DatagramClient,
    position: u16,
    step: &'static str,
    register: u16,
) -> Result<[u8; N], Error> {
    let mut bytes = [0; N];
    match wire.read_at(position, register, &mut bytes).await {
        Ok(1) => Ok(bytes),
        answer => Err(no_answer(position, step, answer)),
    }
}

/// Reads a register of all devices at once, in the order of the segment.
///
/// # Errors
/// [`Cause::Silent`] if a device does not answer.
pub(crate) async fn words(
    wire: &DatagramClient,
    count: u16,
    step: &'static str,
    register: u16,
) -> Result<Vec<u16>, Error> {
    let word = async |position| {
        let bytes = at(wire, position, step, register).await?;
        Ok::<_, Error>(u16::from_le_bytes(bytes))
    };
    try_join_all((0..count).map(word)).await
}

/// Returns the error of a device that should have answered.
pub(super) fn no_answer(
    position: u16,
    action: &'static str,
    answer: Result<u16, DatagramError>,
) -> Error {
    match answer {
        Ok(_) | Err(DatagramError::Timeout { .. }) => Cause::Silent { position, action }.into(),
        Err(error) => Error::from(Cause::Datagram(error)).with_action(action),
    }
}

/// Assigns a station address to every device without one or with a duplicate. All others keep
/// theirs, because another program may be using it.
///
/// # Errors
/// [`Cause::Silent`] if a device does not accept its address.
pub async fn address(wire: &DatagramClient, found: &mut [EnumeratedDevice]) -> Result<(), Error> {
    const STEP: &str = "giving out station addresses";
    let mut taken: Vec<u16> = Vec::with_capacity(found.len());
    let mut without = Vec::new();
    for (n, device) in found.iter().enumerate() {
        if device.station == 0 || found.iter().filter(|f| f.station == device.station).count() > 1 {
            without.push(n);
        } else {
            taken.push(device.station);
        }
    }
    let mut next = FIRST_STATION;
    for n in without {
        while taken.contains(&next) {
            next = next.checked_add(1).unwrap_or(1);
        }
        let Some(device) = found.get_mut(n) else {
            continue;
        };
        let position = device.position;
        match wire
            .write_at(position, registers::STATION_ADDRESS, &next.to_le_bytes())
            .await
        {
            Ok(1) => {}
            answer => return Err(no_answer(position, STEP, answer)),
        }
        device.station = next;
        taken.push(next);
    }
    Ok(())
}
