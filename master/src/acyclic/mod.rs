//! Bus access without a cycle, for scanning, parameters, EEPROMs and firmware. MAY BLOCK AND
//! ALLOCATE.
//!
//! The segment is used as found. Nothing here resets it, and each operation touches a device only
//! as far as needed: another MainDevice may be driving it.
//!
//! - [`al`]: AL states;
//! - [`delays`]: propagation delays;
//! - [`enumerate`]: the devices of a segment and their addresses;
//! - [`device`]: finds one device by its locator;
//! - [`eeprom`]: the EEPROM interface of one device;
//! - [`image`]: EEPROM images, and how to write them;
//! - [`mailbox`]: the mailboxes of one device, and the state they need;
//! - [`parameters`]: the parameters of one device;
//! - [`topology`]: how the devices are connected.

use crate::mailbox::{DatagramError, MailboxTransport};
use crate::report::{Cause, Error};

pub use crate::config::StateTimeouts;
pub use crate::datagram::DatagramClient;
pub use crate::report::DeviceRef;
pub use al::{AlState, StateError, Transition};

pub mod al;
pub mod delays;
pub mod device;
pub mod eeprom;
pub mod enumerate;
pub mod image;
pub mod mailbox;
pub mod parameters;
#[cfg(test)]
mod tests;
pub mod topology;

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
    /// [`Cause::Datagram`], [`Cause::NotTaken`].
    pub async fn read<const N: usize>(&self, register: u16) -> Result<[u8; N], Error> {
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
    pub async fn write(&self, register: u16, bytes: &[u8]) -> Result<(), Error> {
        let answer = self.wire.write(self.device.station, register, bytes).await;
        self.taken(register, answer)
    }

    fn taken(&self, register: u16, answer: Result<u16, DatagramError>) -> Result<(), Error> {
        let cause = match answer {
            Ok(1..) => return Ok(()),
            Ok(0) => Cause::NotTaken { register },
            Err(error) => Cause::Datagram(error),
        };
        Err(self.error(cause))
    }

    /// Returns the error with this cause.
    pub(crate) fn error(&self, cause: Cause) -> Error {
        cause.with_device(self.device).with_action(self.step)
    }
}
