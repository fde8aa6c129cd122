//! Bus access without a cycle, for scanning, parameters, EEPROMs and firmware. MAY BLOCK AND
//! ALLOCATE.
//!
//! The segment is used as found. Nothing here resets it, and each operation touches a device only
//! as far as needed: another MainDevice may be driving it.
//!
//! - [`al`]: AL states;
//! - [`enumerate`]: the devices of a segment and their addresses;
//! - [`device`]: finds one device by its locator;
//! - [`eeprom`]: the EEPROM interface of one device;
//! - [`image`]: EEPROM images, and how to write them;
//! - [`mailbox`]: the mailboxes of one device, and the state they need;
//! - [`topology`]: how the devices are connected.

use std::fmt;

use ecaxis_esi::sii::SiiError;

use crate::mailbox::{DatagramError, InfoError, MailboxTransport, SdoError};

pub use crate::datagram::DatagramClient;
pub use al::{AlState, StateError};

pub mod al;
pub mod device;
pub mod eeprom;
pub mod enumerate;
pub mod image;
pub mod mailbox;
#[cfg(test)]
mod tests;
pub mod topology;

/// The SubDevice that an error refers to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeviceRef {
    pub name: String,
    pub position: u16,
    pub station: u16,
}

impl fmt::Display for DeviceRef {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "`{}` (position {}, station 0x{:04x})",
            self.name, self.position, self.station
        )
    }
}

/// An error of an operation on a device.
#[derive(Debug, thiserror::Error)]
pub enum ServiceError {
    #[error("no SubDevice answers")]
    NoAnswer,
    #[error("the SubDevice at position {position} stopped answering while {step}")]
    Silent { position: u16, step: &'static str },
    #[error("{step}: {source}")]
    Segment {
        step: &'static str,
        source: DatagramError,
    },
    #[error("no SubDevice has {wanted}; {found}")]
    NotFound { wanted: String, found: String },
    #[error("{count} SubDevices have {wanted}: at positions {positions}")]
    Ambiguous {
        wanted: String,
        count: usize,
        positions: String,
    },
    #[error("{device}: {step}: {source}")]
    Wire {
        device: DeviceRef,
        step: &'static str,
        source: DatagramError,
    },
    #[error("{device}: {step}: register 0x{register:04x} is not answered")]
    NotTaken {
        device: DeviceRef,
        step: &'static str,
        register: u16,
    },
    #[error("{device}: {step}: {source}")]
    Eeprom {
        device: DeviceRef,
        step: &'static str,
        source: eeprom::EepromError,
    },
    #[error("{device}: its EEPROM: {source}")]
    Sii { device: DeviceRef, source: SiiError },
    #[error("{device}: the EEPROM says nothing of a mailbox")]
    NoMailbox { device: DeviceRef },
    #[error("{device}: is in {state}, where it has no CoE mailbox")]
    WrongState { device: DeviceRef, state: String },
    /// The user stopped the operation. Changed states have been restored.
    #[error("{device}: {step}: interrupted")]
    Stopped {
        device: DeviceRef,
        step: &'static str,
    },
    #[error("{device}: {source}")]
    Sdo { device: DeviceRef, source: SdoError },
    #[error("{device}: {source}")]
    Information {
        device: DeviceRef,
        source: Box<InfoError>,
    },
    #[error(transparent)]
    State(#[from] StateError),
}

/// The registers of a device. Every error names the device.
#[derive(Debug)]
pub struct Registers<'a, W> {
    pub wire: &'a W,
    pub device: &'a DeviceRef,
    /// The current operation, for errors.
    pub step: &'static str,
}

impl<W: MailboxTransport> Registers<'_, W> {
    /// Reads a register.
    ///
    /// # Errors
    /// [`ServiceError::Wire`], [`ServiceError::NotTaken`].
    pub async fn read<const N: usize>(&self, register: u16) -> Result<[u8; N], ServiceError> {
        let mut bytes = [0; N];
        let answer = self
            .wire
            .read(self.device.station, register, &mut bytes)
            .await;
        self.taken(register, answer).map(|()| bytes)
    }

    /// Writes a register.
    ///
    /// # Errors
    /// As [`Registers::read`].
    pub async fn write(&self, register: u16, bytes: &[u8]) -> Result<(), ServiceError> {
        let answer = self.wire.write(self.device.station, register, bytes).await;
        self.taken(register, answer)
    }

    fn taken(&self, register: u16, answer: Result<u16, DatagramError>) -> Result<(), ServiceError> {
        let (device, step) = (self.device.clone(), self.step);
        match answer {
            Ok(1..) => Ok(()),
            Ok(0) => Err(ServiceError::NotTaken {
                device,
                step,
                register,
            }),
            Err(source) => Err(ServiceError::Wire {
                device,
                step,
                source,
            }),
        }
    }
}
