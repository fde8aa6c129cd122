//! "save" and "load" (CiA 301, objects 0x1010 and 0x1011): stores the parameters or restores the
//! defaults.

use std::time::Duration;

use crate::acyclic::DeviceRef;
use crate::mailbox::{CoeClient, MailboxTransport, Timeouts};
use crate::report::{Cause, Error};

/// The time-out of the command. A device answers when it is done; flash memories take tens of
/// seconds.
pub const WAIT: Duration = Duration::from_secs(60);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Command {
    /// 0x1010:01 = "save".
    Store,
    /// 0x1011:01 = "load"; effective after the next start.
    Defaults,
}

impl Command {
    fn object(self) -> (u16, &'static [u8; 4]) {
        match self {
            Self::Store => (0x1010, b"save"),
            Self::Defaults => (0x1011, b"load"),
        }
    }

    /// Sends the command and waits until the device has completed it.
    ///
    /// # Errors
    /// [`Cause::Sdo`] with the device's reason.
    pub async fn give(
        self,
        coe: &mut CoeClient,
        wire: &impl MailboxTransport,
        device: &DeviceRef,
    ) -> Result<(), Error> {
        let (index, signature) = self.object();
        let patient = Timeouts {
            answer: WAIT,
            transfer: 2 * WAIT,
            ..Timeouts::default()
        };
        let usual = coe.set_timeouts(patient);
        let done = coe.download(wire, index, 1, false, signature).await;
        coe.set_timeouts(usual);
        done.map_err(|error| Cause::Sdo(error).with_device(device))
    }
}
