//! "save" and "load" (CiA 301, objects 0x1010 and 0x1011): a device keeps its parameters over power cycles, or forgets them.

use std::time::Duration;

use crate::bringup::DeviceRef;
use crate::mailbox::{CoeClient, Timeouts, Wire};
use crate::service::ServiceError;

/// A device answers when it is done. EEPROMs of drives take seconds, flash memories tens of them.
pub const WAIT: Duration = Duration::from_secs(60);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Command {
    /// 0x1010:01 = "save".
    Store,
    /// 0x1011:01 = "load"; counts from the next start on.
    Defaults,
}

impl Command {
    fn object(self) -> (u16, &'static [u8; 4]) {
        match self {
            Self::Store => (0x1010, b"save"),
            Self::Defaults => (0x1011, b"load"),
        }
    }

    /// Waits until the device says that it is done.
    ///
    /// # Errors
    /// [`ServiceError::Sdo`], with the device's own reason.
    pub async fn give(
        self,
        coe: &mut CoeClient,
        wire: &impl Wire,
        device: &DeviceRef,
    ) -> Result<(), ServiceError> {
        let (index, signature) = self.object();
        let patient = Timeouts {
            answer: WAIT,
            transfer: 2 * WAIT,
            ..Timeouts::default()
        };
        let usual = coe.set_timeouts(patient);
        let done = coe.download(wire, index, 1, false, signature).await;
        coe.set_timeouts(usual);
        done.map_err(|source| ServiceError::Sdo {
            device: device.clone(),
            source,
        })
    }
}
