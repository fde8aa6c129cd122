//! CoE, FoE and SoE over raw datagrams, also during operation. May wait and allocate. Never panics on
//! data from a device.
//!
//! - [`MailboxTransport`]: the datagrams, the delay and the clock that this module uses.
//! - `transport`: the mailbox SyncManagers: request and answer, lost answers, emergencies in
//!   between.
//! - `sdo`, `transfer`: [`CoeClient`], SDO upload and download.
//! - `sdo_info`: the object dictionary as reported by the device (SDO Information).
//! - [`foe`]: [`FoeClient`], file transfer.
//! - `soe`: IDNs and procedure commands of Sercos drives, also by [`CoeClient`].
//! - `eoe`: Ethernet frames between the requests of others.
//! - `raw`: messages of any protocol from other programs.
//! - `worker`: [`Mailboxes`], transfers from any thread while workers serve the mailboxes.
//! - `error`, `emergency`, `object_names`: error types and texts.

use std::time::Duration;

use crate::cancel::CancelToken;

mod emergency;
mod eoe;
mod error;
pub mod foe;
mod raw;
mod sdo;
mod sdo_info;
mod soe;
mod transfer;
mod transport;
pub mod worker;

pub use crate::rt::exchange::MailboxStatus;
pub use ecaxis_ecat::mailbox::{abort_text, mailbox_error_text};
pub use ecaxis_ecat::object::{NamedObject, object_name};
pub use emergency::{EMERGENCY_QUEUE, Emergencies, Emergency, EmergencySource, Received};
pub use eoe::{EoeError, EoeSetting};
pub use error::{CoeCause, CoeError, InfoError, Phase, SdoError, Subject};
pub use foe::{FoeCause, FoeClient, FoeError};
pub use raw::{RawAnswer, RawMessage};
pub use sdo::{CoeClient, MAX_OBJECT};
pub use sdo_info::{EntryDescription, InfoRequest, ObjectDescription, ObjectList};
pub use soe::IdnElement;
pub use worker::{DeviceMailbox, MailboxError, MailboxSession, Mailboxes};

/// Datagrams to a SubDevice, and time. This module has no other access to the outside.
#[allow(async_fn_in_trait)]
pub trait MailboxTransport {
    /// Reads by configured address (FPRD). Returns the working counter.
    async fn read(&self, station: u16, register: u16, buf: &mut [u8])
    -> Result<u16, DatagramError>;

    /// Writes by configured address (FPWR). Returns the working counter.
    async fn write(&self, station: u16, register: u16, data: &[u8]) -> Result<u16, DatagramError>;

    async fn delay(&self, duration: Duration);

    /// Returns the time in ns of a monotonic clock that [`MailboxTransport::delay`] advances.
    fn now(&self) -> u64;

    /// Returns the last status of the SubDevice's input mailbox that the cycle has read; `None`
    /// without a cycle.
    fn seen(&self) -> Option<MailboxStatus> {
        None
    }

    /// Returns this status only if it is so recent that it need not be read again.
    fn seen_lately(&self) -> Option<MailboxStatus> {
        self.seen()
    }

    /// Returns the token that cancels operations on this transport.
    fn stop(&self) -> &CancelToken {
        CancelToken::never()
    }
}

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DatagramError {
    /// The frame or its answer was lost.
    #[error("station {station:#06x}, register {register:#06x}: no frame came back")]
    Timeout { station: u16, register: u16 },
    #[error("{0}")]
    Other(String),
}

/// The positions of a SubDevice's mailboxes, as configured in its SyncManagers.
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

/// Timeouts of mailbox transfers. The defaults of `request` and `answer` are those of ETG.2000 for
/// devices whose ESI specifies none.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timeouts {
    /// Until the SubDevice has fetched the previous message from its mailbox.
    pub request: Duration,
    /// Until the SubDevice answers one message.
    pub answer: Duration,
    /// For one whole transfer with all its segments.
    pub transfer: Duration,
}

impl Timeouts {
    fn of(&self, phase: Phase) -> Duration {
        match phase {
            Phase::Request | Phase::Repeat => self.request,
            Phase::Answer | Phase::Fragment => self.answer,
            Phase::Transfer | Phase::Command => self.transfer,
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
