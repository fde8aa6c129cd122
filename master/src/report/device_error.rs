//! Errors of one SubDevice: its AL state and its EEPROM.

use std::fmt;
use std::time::Duration;

use ecaxis_ecat::al_state::AlState;
use ecaxis_ecat::al_status_code::al_status_text;

use super::{Cause, Error};
use crate::mailbox::DatagramError;

/// The timeout for one word; a write takes at most 10 ms.
pub(crate) const EEPROM_TIMEOUT: Duration = Duration::from_secs(1);

/// The SubDevice that an error refers to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeviceRef {
    pub name: String,
    pub position: u16,
    pub station: u16,
}

impl DeviceRef {
    /// The position of an optional device that is absent.
    pub(crate) const ABSENT: u16 = u16::MAX;
}

impl fmt::Display for DeviceRef {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (name, station) = (&self.name, self.station);
        match self.position {
            Self::ABSENT => write!(f, "`{name}` (absent, station 0x{station:04x})"),
            position => write!(f, "`{name}` (position {position}, station 0x{station:04x})"),
        }
    }
}

/// A SubDevice that did not reach the requested state.
#[derive(Debug, thiserror::Error)]
pub enum StateError {
    #[error(
        "refused {wanted}: stays in {actual}, AL status code 0x{code:04x} ({})",
        al_status_text(*code)
    )]
    Refused {
        wanted: AlState,
        actual: AlState,
        code: u16,
    },
    #[error(
        "did not reach {wanted} within {} ms, is in {actual}{}",
        timeout.as_millis(), code_of_timeout(*code)
    )]
    Timeout {
        wanted: AlState,
        actual: AlState,
        /// Some devices set the AL status code, and not the error bit.
        code: u16,
        timeout: Duration,
    },
    #[error("no longer answers while it should go to {wanted}")]
    Gone { wanted: AlState },
    #[error("changing to {wanted}: {source}")]
    Wire {
        wanted: AlState,
        source: DatagramError,
    },
}

fn code_of_timeout(code: u16) -> String {
    match code {
        0 => String::new(),
        code => format!(
            "; AL status code 0x{code:04x} ({}), without the error bit",
            al_status_text(code)
        ),
    }
}

impl StateError {
    /// Returns the AL status code of a device that did not reach the state; 0: none.
    pub(crate) const fn code(&self) -> u16 {
        match self {
            Self::Refused { code, .. } | Self::Timeout { code, .. } => *code,
            Self::Gone { .. } | Self::Wire { .. } => 0,
        }
    }

    pub(crate) fn with_device(self, device: &DeviceRef) -> Error {
        Cause::State(self).with_device(device)
    }
}

/// An error of the EEPROM interface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum EepromError {
    #[error("the device's own processor is using it")]
    InUse,
    #[error("word 0x{word:04x}: still busy after {} ms", EEPROM_TIMEOUT.as_millis())]
    Busy { word: u32 },
    #[error("word 0x{word:04x}: the chip does not acknowledge (status 0x{status:04x})")]
    NotAcknowledged { word: u32, status: u16 },
    #[error("word 0x{word:04x}: writing is not permitted (status 0x{status:04x})")]
    WriteProtected { word: u32, status: u16 },
    /// The chip is smaller than the image: reads beyond its end return its beginning.
    #[error("the image is longer than the chip, which holds {bytes} bytes")]
    Smaller { bytes: usize },
    #[error("word 0x{word:04x}: 0x{wanted:04x} was written, 0x{found:04x} is there")]
    NotKept { word: u32, wanted: u16, found: u16 },
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An absent device was "at position 65535".
    #[test]
    fn absent_device_has_no_position() {
        let device = |position| DeviceRef {
            name: "x".into(),
            position,
            station: 0x2001,
        };
        let text = device(DeviceRef::ABSENT).to_string();
        assert_eq!(text, "`x` (absent, station 0x2001)");
        assert_eq!(device(3).to_string(), "`x` (position 3, station 0x2001)");
    }
}
