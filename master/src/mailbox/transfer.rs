//! One SDO transfer: its object, the answers that belong to it, and its end.

use super::MailboxLayout;
use ecaxis_ecat::mailbox::coe::Answer;

use super::error::{Phase, SdoError, Subject};
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

    pub(super) fn trouble(&self, port: &Port, trouble: TransportError) -> TransferFailure {
        let Self {
            station,
            index,
            sub,
            ..
        } = *self;
        let asked = Subject::Object(NamedObject { index, sub });
        TransferFailure::from(explain(port, trouble, asked, |phase| SdoError::Timeout {
            station,
            index,
            sub,
            phase,
            after: port.timeouts.of(phase),
            set_aside: port.forgotten.saturating_sub(self.forgotten),
        }))
    }

    pub(super) fn aborted(&self, code: u32) -> TransferFailure {
        let Self {
            station,
            index,
            sub,
            ..
        } = *self;
        TransferFailure::from(SdoError::Abort {
            station,
            index,
            sub,
            code,
        })
    }

    pub(super) fn refused(&self, code: u16) -> TransferFailure {
        let Self {
            station,
            index,
            sub,
            ..
        } = *self;
        TransferFailure::from(SdoError::Refused {
            station,
            index,
            sub,
            code,
        })
    }

    pub(super) fn malformed(&self, what: impl ToString) -> TransferFailure {
        let Self {
            station,
            index,
            sub,
            ..
        } = *self;
        TransferFailure::from(SdoError::Malformed {
            station,
            index,
            sub,
            what: what.to_string(),
        })
    }

    pub(super) fn too_large(&self, size: usize) -> TransferFailure {
        let Self {
            station,
            index,
            sub,
            ..
        } = *self;
        TransferFailure::from(SdoError::TooLarge {
            station,
            index,
            sub,
            size,
        })
    }
}

/// Converts a transport error to an SDO error with the SubDevice's address and the request.
/// `timeout` creates the error for a timeout.
pub(super) fn explain(
    port: &Port,
    trouble: TransportError,
    asked: Subject,
    timeout: impl FnOnce(Phase) -> SdoError,
) -> SdoError {
    let MailboxLayout {
        station,
        out_len,
        in_len,
        ..
    } = port.layout;
    match trouble {
        TransportError::Timeout(phase) => timeout(phase),
        TransportError::Gone => SdoError::Gone { station, asked },
        TransportError::Wire(source) => SdoError::Wire {
            station,
            asked,
            source,
        },
        TransportError::Layout => SdoError::Mailbox {
            station,
            asked,
            out_len,
            in_len,
        },
    }
}

/// Converts an error while emptying a mailbox. Emptying waits for no answer, so a timeout means
/// that the device is gone.
pub(super) fn drain_error(port: &Port, trouble: TransportError) -> SdoError {
    let (station, asked) = (port.layout.station, Subject::Emptying);
    explain(port, trouble, asked, |_| SdoError::Gone { station, asked })
}
