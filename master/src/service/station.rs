//! Who answers on a segment, and under which station address.

use std::fmt;

use super::ServiceError;
use crate::bringup::{AlState, DeviceRef};
use crate::mailbox::WireError;
use crate::wire::Datagrams;

/// Broadcasts tried before a segment is called silent.
const TRIES: u32 = 5;
/// Station addresses are given out from here on, as ethercrab does.
const FIRST_STATION: u16 = 0x1000;

/// Configured station address, configured station alias (ETG.1000.4, Table 31).
const STATION: u16 = 0x0010;
const AL_STATUS: u16 = 0x0130;
const ERROR: u8 = 0x10;

/// A SubDevice as its registers show it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Found {
    pub position: u16,
    /// 0: nobody has given it one.
    pub station: u16,
    /// As its controller read it from the EEPROM when it was switched on.
    pub alias: u16,
    pub state: AlState,
    /// It holds an error that nobody has acknowledged.
    pub error: bool,
    /// AL status code.
    pub code: u16,
}

impl Found {
    /// The device under a name.
    #[must_use]
    pub fn named(&self, name: impl Into<String>) -> DeviceRef {
        DeviceRef {
            name: name.into(),
            position: self.position,
            station: self.station,
        }
    }
}

/// Which SubDevice is meant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Which {
    /// The first one is 0.
    Position(u16),
    Alias(u16),
    Station(u16),
}

impl fmt::Display for Which {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Position(position) => write!(f, "position {position}"),
            Self::Alias(alias) => write!(f, "alias {alias}"),
            Self::Station(station) => write!(f, "station address 0x{station:04x}"),
        }
    }
}

impl Which {
    fn fits(self, found: &Found) -> bool {
        match self {
            Self::Position(position) => found.position == position,
            Self::Alias(alias) => found.alias == alias,
            Self::Station(station) => found.station == station,
        }
    }

    /// The one that is meant.
    ///
    /// # Errors
    /// [`ServiceError::NotFound`], [`ServiceError::Ambiguous`].
    pub fn among(self, found: &[Found]) -> Result<&Found, ServiceError> {
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
        let more: Vec<&Found> = fitting.collect();
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

fn aliases(found: &[Found]) -> String {
    let each: Vec<String> = found.iter().map(|f| f.alias.to_string()).collect();
    each.join(", ")
}

/// Everybody on the segment, in its order. Reads only.
///
/// # Errors
/// [`ServiceError::NoAnswer`]; [`ServiceError::Silent`] where one leaves meanwhile.
pub async fn census(wire: &Datagrams) -> Result<Vec<Found>, ServiceError> {
    const STEP: &str = "asking who is there";
    let mut found = Vec::new();
    for position in 0..count(wire).await? {
        let addresses = at(wire, position, STEP, STATION).await?;
        let [s0, s1, a0, a1] = addresses;
        let [status, _, _, _, c0, c1] = at(wire, position, STEP, AL_STATUS).await?;
        found.push(Found {
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

/// How many answer a broadcast; 1 at least.
async fn count(wire: &Datagrams) -> Result<u16, ServiceError> {
    for _ in 0..TRIES {
        match wire.count().await {
            Ok(0) | Err(WireError::Timeout { .. }) => {}
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

/// Some bytes of a device by its position.
///
/// # Errors
/// [`ServiceError::Silent`] where nobody is there.
pub async fn at<const N: usize>(
    wire: &Datagrams,
    position: u16,
    step: &'static str,
    register: u16,
) -> Result<[u8; N], ServiceError> {
    let mut bytes = [0; N];
    match wire.read_at(position, register, &mut bytes).await {
        Ok(1) => Ok(bytes),
        Ok(_) | Err(WireError::Timeout { .. }) => Err(ServiceError::Silent { position, step }),
        Err(source) => Err(ServiceError::Segment { step, source }),
    }
}

/// Gives a station address to everybody who has none or one that another has too. All others keep theirs: somebody may be using it.
///
/// # Errors
/// [`ServiceError::Silent`] where one does not take it.
pub async fn address(wire: &Datagrams, found: &mut [Found]) -> Result<(), ServiceError> {
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
        match wire.write_at(position, STATION, &next.to_le_bytes()).await {
            Ok(1) => {}
            Ok(_) | Err(WireError::Timeout { .. }) => {
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
