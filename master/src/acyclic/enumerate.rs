//! Enumerates the SubDevices of a segment and assigns station addresses.

use std::fmt;

use super::ServiceError;
use crate::bringup::{AlState, DeviceRef};
use crate::datagram::DatagramClient;
use crate::mailbox::DatagramError;
use ecaxis_ecat::registers;

/// The number of broadcasts without an answer after which a segment counts as silent.
const TRIES: u32 = 5;
/// The first station address assigned, as in ethercrab.
const FIRST_STATION: u16 = 0x1000;

const ERROR: u8 = 0x10;

/// A SubDevice as its registers describe it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EnumeratedDevice {
    pub position: u16,
    /// The station address; 0: not assigned.
    pub station: u16,
    /// The station alias that the controller loaded from the EEPROM at power-on.
    pub alias: u16,
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

/// Selects a SubDevice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DeviceSelector {
    /// The position; the first device has 0.
    Position(u16),
    Alias(u16),
    Station(u16),
}

impl fmt::Display for DeviceSelector {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Position(position) => write!(f, "position {position}"),
            Self::Alias(alias) => write!(f, "alias {alias}"),
            Self::Station(station) => write!(f, "station address 0x{station:04x}"),
        }
    }
}

impl DeviceSelector {
    fn fits(self, found: &EnumeratedDevice) -> bool {
        match self {
            Self::Position(position) => found.position == position,
            Self::Alias(alias) => found.alias == alias,
            Self::Station(station) => found.station == station,
        }
    }

    /// Returns the selected device.
    ///
    /// # Errors
    /// [`ServiceError::NotFound`], [`ServiceError::Ambiguous`].
    pub fn select_from(
        self,
        found: &[EnumeratedDevice],
    ) -> Result<&EnumeratedDevice, ServiceError> {
        let mut fitting = found.iter().filter(|found| self.fits(found));
        let Some(first) = fitting.next() else {
            return Err(ServiceError::NotFound {
                wanted: self.to_string(),
                found: match (self, found.len()) {
                    (_, 1) => "1 answers, at position 0".to_owned(),
                    (Self::Alias(_), n) if found.iter().all(|f| f.alias == 0) => {
                        format!("none of the {n} has one")
                    }
                    (Self::Alias(_), _) => format!("their aliases are {}", aliases(found)),
                    (_, n) => format!("{n} answer, at positions 0 to {}", n.saturating_sub(1)),
                },
            });
        };
        let more: Vec<&EnumeratedDevice> = fitting.collect();
        if more.is_empty() {
            return Ok(first);
        }
        let all = std::iter::once(first).chain(more);
        let positions: Vec<String> = all.map(|found| found.position.to_string()).collect();
        Err(ServiceError::Ambiguous {
            wanted: self.to_string(),
            count: positions.len(),
            positions: positions.join(", "),
        })
    }
}

fn aliases(found: &[EnumeratedDevice]) -> String {
    let each: Vec<String> = found.iter().map(|f| f.alias.to_string()).collect();
    each.join(", ")
}

/// Returns all SubDevices in segment order. Only reads.
///
/// # Errors
/// [`ServiceError::NoAnswer`]; [`ServiceError::Silent`] if a device leaves meanwhile.
pub async fn enumerate(wire: &DatagramClient) -> Result<Vec<EnumeratedDevice>, ServiceError> {
    const STEP: &str = "asking who is there";
    let mut found = Vec::new();
    for position in 0..count(wire).await? {
        let addresses = at(wire, position, STEP, registers::STATION_ADDRESS).await?;
        let [s0, s1, a0, a1] = addresses;
        let [status, _, _, _, c0, c1] = at(wire, position, STEP, registers::AL_STATUS).await?;
        found.push(EnumeratedDevice {
            position,
            station: u16::from_le_bytes([s0, s1]),
            alias: u16::from_le_bytes([a0, a1]),
            state: AlState::from_status(status),
            error: status & ERROR != 0,
            code: u16::from_le_bytes([c0, c1]),
        });
    }
    Ok(found)
}

/// Returns the number of devices that answer a broadcast; at least 1.
async fn count(wire: &DatagramClient) -> Result<u16, ServiceError> {
    for _ in 0..TRIES {
        match wire.count().await {
            Ok(0) | Err(DatagramError::Timeout { .. }) => {}
            Ok(count) => return Ok(count),
            Err(source) => {
                return Err(ServiceError::Segment {
                    step: "asking who is there",
                    source,
                });
            }
        }
    }
    Err(ServiceError::NoAnswer)
}

/// Reads bytes of a device by its position.
///
/// # Errors
/// [`ServiceError::Silent`] if no device answers.
pub async fn at<const N: usize>(
    wire: &DatagramClient,
    position: u16,
    step: &'static str,
    register: u16,
) -> Result<[u8; N], ServiceError> {
    let mut bytes = [0; N];
    match wire.read_at(position, register, &mut bytes).await {
        Ok(1) => Ok(bytes),
        Ok(_) | Err(DatagramError::Timeout { .. }) => Err(ServiceError::Silent { position, step }),
        Err(source) => Err(ServiceError::Segment { step, source }),
    }
}

/// Assigns a station address to every device without one or with a duplicate. All others keep
/// theirs, because another program may be using it.
///
/// # Errors
/// [`ServiceError::Silent`] if a device does not accept its address.
pub async fn address(
    wire: &DatagramClient,
    found: &mut [EnumeratedDevice],
) -> Result<(), ServiceError> {
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
            Ok(_) | Err(DatagramError::Timeout { .. }) => {
                return Err(ServiceError::Silent {
                    position,
                    step: STEP,
                });
            }
            Err(source) => return Err(ServiceError::Segment { step: STEP, source }),
        }
        device.station = next;
        taken.push(next);
    }
    Ok(())
}
