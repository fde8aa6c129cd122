//! SoE messages (ETG.1000.6 clause 5.7), assembled to transfers of elements.

use std::fmt;

use crate::document::format::hex_bytes;
use ecaxis_ecat::mailbox::soe::{Element, Idn, Message, Operation, Telegram, soe_error_text};
use ecaxis_master::mailbox::{Emergency, mailbox_error_text};

use super::mailbox::{MailboxEvent, TransferDirection};

/// The maximum number of stored bytes of an element; the full length is counted.
const KEPT: usize = 64;

/// The outcome of a transfer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum IdnOutcome {
    Done,
    /// The drive refused it with an SoE error code.
    Refused(u16),
    /// The device's mailbox refused the request.
    Mailbox(u16),
    /// Another transfer began, or the recording ended.
    Unanswered,
}

/// A transfer of elements of one IDN with all its fragments.
#[derive(Debug, Clone)]
pub struct IdnTransfer {
    /// The time in ns since 1970.
    pub began: u64,
    pub ended_at: u64,
    pub way: TransferDirection,
    pub drive: u8,
    /// The bits of the elements.
    pub elements: u8,
    /// `None` until the last fragment of a write.
    pub idn: Option<Idn>,
    /// The stored part of the data.
    pub data: Vec<u8>,
    pub len: usize,
    pub fragments: u32,
    pub ended: IdnOutcome,
}

impl IdnTransfer {
    /// True if the transfer failed.
    pub fn is_trouble(&self) -> bool {
        self.ended != IdnOutcome::Done
    }

    fn new(at: u64, way: TransferDirection, telegram: &Telegram<'_>) -> Self {
        Self {
            began: at,
            ended_at: at,
            way,
            drive: telegram.drive,
            elements: telegram.elements,
            idn: telegram.idn(),
            data: Vec::new(),
            len: 0,
            fragments: 0,
            ended: IdnOutcome::Unanswered,
        }
    }

    fn add(&mut self, data: &[u8]) {
        let room = KEPT.saturating_sub(self.data.len());
        self.data.extend(data.iter().take(room));
        self.len += data.len();
        self.fragments += 1;
    }
}

/// Formats IDN, element, drive, fragments and outcome.
impl fmt::Display for IdnTransfer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self.way {
            TransferDirection::Read => "read ",
            TransferDirection::Write => "write ",
        })?;
        match Element::from_bits(self.elements) {
            Some(Element::Value) => {}
            Some(element) => write!(f, "{} of ", element.name())?,
            None => write!(f, "elements {:#04x} of ", self.elements)?,
        }
        match self.idn {
            Some(idn) => idn.named().fmt(f)?,
            None => f.write_str("an IDN")?,
        }
        if self.drive > 0 {
            write!(f, " of drive {}", self.drive)?;
        }
        match self.ended {
            IdnOutcome::Done => {
                let more = if self.len > self.data.len() {
                    " …"
                } else {
                    ""
                };
                write!(f, " = [{}{more}]", hex_bytes(self.data.iter(), " "))?;
                if self.fragments > 1 {
                    write!(f, ", {} bytes in {} fragments", self.len, self.fragments)?;
                }
                Ok(())
            }
            IdnOutcome::Refused(code) => {
                write!(f, ": refused with {code:#06x}, {}", soe_error_text(code))
            }
            IdnOutcome::Mailbox(code) => {
                write!(
                    f,
                    ": refused with {code:#06x}, {}",
                    mailbox_error_text(code)
                )
            }
            IdnOutcome::Unanswered => f.write_str(": no answer"),
        }
    }
}

/// The SoE transfer in progress of one device.
#[derive(Debug, Default, Clone)]
pub struct SoeMailbox {
    transfer: Option<IdnTransfer>,
}

impl SoeMailbox {
    /// True if a request has no answer yet.
    pub fn is_waiting(&self) -> bool {
        self.transfer.is_some()
    }

    /// Processes a whole mailbox with an SoE message.
    pub fn message(&mut self, at: u64, bytes: &[u8], reported: &mut Vec<MailboxEvent>) {
        let Ok(Message::Telegram(telegram)) = Message::parse(bytes) else {
            return;
        };
        match telegram.operation {
            Operation::ReadRequest => {
                self.end(at, IdnOutcome::Unanswered, reported);
                self.transfer = Some(IdnTransfer::new(at, TransferDirection::Read, &telegram));
            }
            Operation::WriteRequest => {
                let continues = self.transfer.as_ref().is_some_and(|transfer| {
                    transfer.way == TransferDirection::Write && transfer.idn.is_none()
                });
                if !continues {
                    self.end(at, IdnOutcome::Unanswered, reported);
                    let new = IdnTransfer::new(at, TransferDirection::Write, &telegram);
                    self.transfer = Some(new);
                }
                if let Some(transfer) = &mut self.transfer {
                    transfer.add(telegram.data);
                    transfer.idn = telegram.idn();
                }
            }
            Operation::ReadResponse | Operation::WriteResponse => {
                if let Some(code) = telegram.error_code() {
                    return self.end(at, IdnOutcome::Refused(code), reported);
                }
                if let Some(transfer) = &mut self.transfer
                    && telegram.operation == Operation::ReadResponse
                {
                    transfer.add(telegram.data);
                }
                if !telegram.incomplete {
                    self.end(at, IdnOutcome::Done, reported);
                }
            }
            Operation::Notification | Operation::Emergency => {
                reported.extend(Emergency::from_telegram(&telegram).map(MailboxEvent::Emergency));
            }
            Operation::Unknown(_) => {}
        }
    }

    /// Ends the transfer in progress.
    pub fn end(&mut self, at: u64, ended: IdnOutcome, reported: &mut Vec<MailboxEvent>) {
        if let Some(mut transfer) = self.transfer.take() {
            transfer.ended_at = at;
            transfer.ended = ended;
            reported.push(MailboxEvent::Idn(transfer));
        }
    }
}

#[cfg(test)]
mod tests {
    use ecaxis_ecat::mailbox::Encode;

    use super::*;

    fn text(events: &[MailboxEvent]) -> Vec<String> {
        let each = events.iter().map(|event| match event {
            MailboxEvent::Idn(transfer) => transfer.to_string(),
            MailboxEvent::Emergency(emergency) => emergency.to_string(),
            other => panic!("{other:?}"),
        });
        each.collect()
    }

    #[test]
    fn fragments_errors_and_notifications_are_assembled() {
        let telegram = |operation, incomplete, error, idn_or_left, data: &'static [u8]| Telegram {
            operation,
            incomplete,
            error,
            drive: 1,
            elements: Element::Value.bit(),
            idn_or_left,
            data,
        };
        use Operation as O;
        let sent = [
            telegram(O::ReadRequest, false, false, 51, &[]),
            telegram(O::ReadResponse, false, false, 51, &[1, 2, 3, 4]),
            telegram(O::WriteRequest, true, false, 1, &[4, 0, 4, 0]),
            telegram(O::WriteRequest, false, false, 16, &[51, 0, 40, 0]),
            telegram(O::WriteResponse, false, false, 16, &[]),
            telegram(O::WriteRequest, false, false, 91, &[0, 0]),
            telegram(O::WriteResponse, false, true, 91, &[2, 0x70]),
            telegram(O::Notification, false, false, 99, &[3, 0]),
            telegram(O::Emergency, false, false, 0, &[5, 0x73, 1, 0, 0, 0, 0, 0]),
            telegram(O::ReadRequest, false, false, 390, &[]),
        ];
        let (mut soe, mut reported) = (SoeMailbox::default(), Vec::new());
        let mut bytes = Vec::new();
        for telegram in sent {
            telegram.emit(1, 64, &mut bytes);
            soe.message(0, &bytes, &mut reported);
        }
        assert!(soe.is_waiting());
        soe.end(0, IdnOutcome::Unanswered, &mut reported);
        assert_eq!(
            text(&reported),
            [
                "read S-0-0051 (Position feedback value 1) of drive 1 = [01 02 03 04]",
                "write S-0-0016 (Configuration list of AT) of drive 1 = [04 00 04 00 33 00 28 00], 8 bytes in 2 fragments",
                "write S-0-0091 (Bipolar velocity limit value) of drive 1: refused with 0x7002, the value is too short",
                "notification of drive 1: S-0-0099 (Reset class 1 diagnostic) is executed",
                "SoE emergency of drive 1: 0x7305, data 01 00 00 00 00 00",
                "read S-0-0390 (Diagnostic number) of drive 1: no answer",
            ]
        );
    }
}
