//! One transfer: what it is about, which answers are to it, and how it ends.

use super::MailboxLayout;
use super::coe::Answer;
use super::error::{About, Phase, SdoError};
use super::objects::ObjectAddress;
use super::port::{Deadline, Port, Trouble};

#[derive(Debug)]
pub(super) struct Transfer {
    pub(super) station: u16,
    pub(super) index: u16,
    pub(super) sub: u8,
    pub(super) complete: bool,
    pub(super) deadline: Deadline,
    /// [`Port::forgotten`] at its beginning.
    pub(super) forgotten: u64,
}

/// Why a transfer ended, and what the device is told where it still waits for more.
#[derive(Debug)]
pub(super) struct Ended {
    pub(super) error: SdoError,
    pub(super) abort: Option<u32>,
}

impl From<SdoError> for Ended {
    fn from(error: SdoError) -> Self {
        Self { error, abort: None }
    }
}

impl Ended {
    pub(super) fn telling(self, code: u32) -> Self {
        Self {
            abort: Some(code),
            ..self
        }
    }
}

impl Transfer {
    /// Whether an answer is to this transfer, as far as it says. With complete access devices differ in the subindex.
    pub(super) fn fits(&self, answer: &Answer<'_>) -> bool {
        match *answer {
            Answer::Upload { index, sub, .. } | Answer::Download { index, sub } => {
                index == self.index && (sub == self.sub || self.complete)
            }
            Answer::UploadSegment { .. } | Answer::DownloadSegment { .. } => true,
            Answer::Abort { .. } => false,
        }
    }

    pub(super) fn trouble(&self, port: &Port, trouble: Trouble) -> Ended {
        let Self {
            station,
            index,
            sub,
            ..
        } = *self;
        let asked = About::Object(ObjectAddress { index, sub });
        Ended::from(explain(port, trouble, asked, |phase| SdoError::Timeout {
            station,
            index,
            sub,
            phase,
            after: port.timeouts.of(phase),
            set_aside: port.forgotten.saturating_sub(self.forgotten),
        }))
    }

    pub(super) fn aborted(&self, code: u32) -> Ended {
        let Self {
            station,
            index,
            sub,
            ..
        } = *self;
        Ended::from(SdoError::Abort {
            station,
            index,
            sub,
            code,
        })
    }

    pub(super) fn refused(&self, code: u16) -> Ended {
        let Self {
            station,
            index,
            sub,
            ..
        } = *self;
        Ended::from(SdoError::Refused {
            station,
            index,
            sub,
            code,
        })
    }

    pub(super) fn malformed(&self, what: impl ToString) -> Ended {
        let Self {
            station,
            index,
            sub,
            ..
        } = *self;
        Ended::from(SdoError::Malformed {
            station,
            index,
            sub,
            what: what.to_string(),
        })
    }

    pub(super) fn too_large(&self, size: usize) -> Ended {
        let Self {
            station,
            index,
            sub,
            ..
        } = *self;
        Ended::from(SdoError::TooLarge {
            station,
            index,
            sub,
            size,
        })
    }
}

/// The mailbox's trouble with the SubDevice's address and what was asked; `timeout` says what a timeout means.
pub(super) fn explain(
    port: &Port,
    trouble: Trouble,
    asked: About,
    timeout: impl FnOnce(Phase) -> SdoError,
) -> SdoError {
    let MailboxLayout {
        station,
        out_len,
        in_len,
        ..
    } = port.layout;
    match trouble {
        Trouble::Timeout(phase) => timeout(phase),
        Trouble::Gone => SdoError::Gone { station, asked },
        Trouble::Wire(source) => SdoError::Wire {
            station,
            asked,
            source,
        },
        Trouble::Layout => SdoError::Mailbox {
            station,
            asked,
            out_len,
            in_len,
        },
    }
}

/// Trouble with a mailbox that is emptied. That waits for no answer, so only the device itself can be missing.
pub(super) fn emptying(port: &Port, trouble: Trouble) -> SdoError {
    let (station, asked) = (port.layout.station, About::Emptying);
    explain(port, trouble, asked, |_| SdoError::Gone { station, asked })
}
