//! CoE and FoE over raw datagrams, beside the cyclic loop. May wait and allocate; never panics on what a device sends.
//!
//! - [`Wire`]: the two datagrams, the delay and the clock that everything here is made of.
//! - `port`: the mailbox SyncManagers: taking turns, lost answers, emergencies in between.
//! - `coe`: the bytes of mailbox, CoE and SDO headers (ETG.1000.4, ETG.1000.6).
//! - `sdo`, `transfer`: [`CoeClient`], SDO upload and download.
//! - `info`: what objects a device has, as it says itself (SDO Information).
//! - [`foe`]: [`FoeClient`], files.
//! - `desk`: [`Mailboxes`], transfers for everybody while somebody else looks after the mailboxes.
//! - `error`, `abort`, `emergency`, `objects`: what is said when something goes wrong.

use std::time::Duration;

use crate::stop::Stop;

mod abort;
mod coe;
pub mod desk;
mod emergency;
mod error;
pub mod foe;
mod info;
mod objects;
mod port;
mod sdo;
#[cfg(test)]
pub(crate) mod tests;
mod transfer;

pub use abort::{abort_text, mailbox_error_text};
pub use desk::{DeviceMailbox, MailboxError, Mailboxes};
pub use emergency::{EMERGENCY_QUEUE, Emergencies, Emergency, Received};
pub use error::{About, Phase, SdoError};
pub use foe::{FoeClient, FoeError};
pub use info::{Asked, EntryDescription, InfoError, ObjectDescription, ObjectList};
pub use objects::{ObjectAddress, object_name};
pub use sdo::{CoeClient, MAX_OBJECT};

/// Datagrams to one SubDevice, and time. Nothing else of the outside world is used here.
#[allow(async_fn_in_trait)]
pub trait Wire {
    /// One configured-address read (FPRD). Returns the working counter.
    async fn read(&self, station: u16, register: u16, buf: &mut [u8]) -> Result<u16, WireError>;

    /// One configured-address write (FPWR). Returns the working counter.
    async fn write(&self, station: u16, register: u16, data: &[u8]) -> Result<u16, WireError>;

    async fn delay(&self, duration: Duration);

    /// Nanoseconds of a clock that never goes back and that [`Wire::delay`] advances.
    fn now(&self) -> u64;

    /// What somebody else has last seen of the SubDevice's mailbox, the one that is read; `None` where nobody looks.
    fn seen(&self) -> Option<Seen> {
        None
    }

    /// The same, where it is so new that nobody else needs to look.
    fn seen_lately(&self) -> Option<Seen> {
        self.seen()
    }

    /// Who may end what is done with it.
    fn stop(&self) -> &Stop {
        Stop::never()
    }
}

/// A mailbox as the cycle saw it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Seen {
    /// On [`Wire::now`]'s clock; the mailbox was looked at then or later.
    pub at: u64,
    /// A message waits in it.
    pub full: bool,
}

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    /// The frame, or its answer, was lost.
    #[error("station {station:#06x}, register {register:#06x}: no frame came back")]
    Timeout { station: u16, register: u16 },
    #[error("{0}")]
    Other(String),
}

/// Where a SubDevice's mailboxes are, as its SyncManagers were configured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MailboxLayout {
    pub station: u16,
    /// MainDevice to SubDevice.
    pub out_address: u16,
    pub out_len: u16,
    /// SubDevice to MainDevice.
    pub in_address: u16,
    pub in_len: u16,
    /// SyncManager numbers, usually 0 and 1.
    pub out_sm: u8,
    pub in_sm: u8,
}

/// How long to wait. The defaults of `request` and `answer` are those of ETG.2000 for devices whose ESI says nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timeouts {
    /// Until the SubDevice has taken the previous message out of its mailbox.
    pub request: Duration,
    /// Until it answers one message.
    pub answer: Duration,
    /// For one whole transfer with all its segments.
    pub transfer: Duration,
}

impl Timeouts {
    fn of(&self, phase: Phase) -> Duration {
        match phase {
            Phase::Request | Phase::Repeat => self.request,
            Phase::Answer => self.answer,
            Phase::Transfer => self.transfer,
        }
    }
}

impl Default for Timeouts {
    fn default() -> Self {
        Self {
            request: Duration::from_millis(100),
            answer: Duration::from_secs(6),
            transfer: Duration::from_secs(60),
        }
    }
}
