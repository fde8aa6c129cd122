//! One SDO transfer: its object, the answers that belong to it, and its end.

use super::MailboxLayout;
use ecaxis_ecat::mailbox::coe::Answer;

use super::error::{CoeCause, SdoError, Subject};
use super::transport::{Deadline, Port, TransportError};
use ecaxis_ecat::object::NamedObject;

#[derive(Debug)]
pub(super) struct Transfer {
    pub(super) station: u16,
    pub(super) index: u16,
    pub(super) sub: u8,
    pub(super) complete: bool,
    pub(super) deadline: Deadline,
    /// [`Port::forgotten`] at the start of the transfer.
    pub(super) forgotten: u64,
}

/// Why a transfer ended, and the abort code for the device if it still waits.
#[derive(Debug)]
pub(super) struct TransferFailure {
    pub(super) error: SdoError,
    pub(super) abort: Option<u32>,
}

impl From<SdoError> for TransferFailure {
    fn from(error: SdoError) -> Self {
        Self { error, abort: None }
    }
}

impl TransferFailure {
    pub(super) fn with_abort_code(self, code: u32) -> Self {
        Self {
            abort: Some(code),
            ..self
        }
    }
}

impl Transfer {
    /// True if an answer belongs to this transfer. With complete access, devices differ in the
    /// subindex.
    pub(super) fn fits(&self, answer: &Answer<'_>) -> bool {
        match *answer {
            Answer::Upload { index, sub, .. } | Answer::Download { index, sub } => {
                index == self.index && (sub == self.sub || self.complete)
            }
            Answer::UploadSegment { .. } | Answer::DownloadSegment { .. } => true,
            Answer::Abort { .. } => false,
        }
    }

    /// True if an abort of this object answers this transfer, although an earlier answer may still
    /// arrive. Slave stacks that write the command as a 16-bit word clear the low byte of the index,
    /// so the late abort of a neighbouring object with the same subindex is taken, too. Some
    /// leave the subindex 0, and with complete access they differ in it.
    pub(super) const fn may_abort_with(&self, index: u16, sub: u8) -> bool {
        let is_index = index == self.index || index == self.index & 0xff00;
        is_index && (sub == self.sub || sub == 0 || self.complete)
    }

    pub(super) fn trouble(&self, port: &Port, trouble: TransportError) -> TransferFailure {
        let set_aside = port.forgotten.saturating_sub(self.forgotten);
        self.failure(explain(port, trouble, set_aside))
    }

    pub(super) fn failure(&self, cause: CoeCause) -> TransferFailure {
        let (index, sub) = (self.index, self.sub);
        TransferFailure::from(SdoError {
            station: self.station,
            asked: Subject::Object(NamedObject { index, sub }),
            cause,
        })
    }

    pub(super) fn malformed(&self, what: impl ToString) -> TransferFailure {
        self.failure(CoeCause::Malformed(what.to_string()))
    }
}

/// Converts a transport error. Meanwhile `set_aside` messages arrived that belong to something
/// else.
pub(super) fn explain(port: &Port, trouble: TransportError, set_aside: u64) -> CoeCause {
    let MailboxLayout {
        out_len, in_len, ..
    } = port.layout;
    match trouble {
        TransportError::Timeout(phase) => CoeCause::Timeout {
            phase,
            after: port.timeouts.of(phase),
            set_aside,
        },
        TransportError::Gone => CoeCause::Gone,
        TransportError::Wire(error) => CoeCause::Wire(error),
        TransportError::Layout => CoeCause::Mailbox { out_len, in_len },
    }
}

/// Converts an error while emptying a mailbox. Emptying waits for no answer, so a timeout means
/// that the device is gone.
pub(super) fn drain_error(port: &Port, trouble: TransportError) -> SdoError {
    SdoError {
        station: port.layout.station,
        asked: Subject::Emptying,
        cause: match trouble {
            TransportError::Timeout(_) => CoeCause::Gone,
            trouble => explain(port, trouble, 0),
        },
    }
}
