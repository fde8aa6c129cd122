//! Mailbox messages (ETG.1000.4 clause 5.6, ETG.1000.6 clause 5.6), assembled to transfers.

use std::collections::BTreeMap;

use ecaxis_ecat::mailbox::abort_code::is_no_such_object;
use ecaxis_ecat::mailbox::coe::{Answer, Fragment, Message, Request};
use ecaxis_ecat::mailbox::{self, TYPE_COE, TYPE_ERROR, TYPE_FOE, TYPE_SOE, foe};
use ecaxis_master::mailbox::Emergency;

use super::soe::{IdnOutcome, IdnTransfer, SoeMailbox};

/// The maximum number of stored bytes of an object; the full length is counted.
const KEPT: usize = 1024;
/// The maximum number of stored dictionary names of one device.
const NAMES: usize = 20_000;

/// The direction of a transfer, seen from the MainDevice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TransferDirection {
    /// SDO upload.
    Read,
    /// SDO download.
    Write,
}

/// The outcome of a transfer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TransferOutcome {
    Done,
    Aborted {
        code: u32,
        by_device: bool,
    },
    /// The device's mailbox refused the request.
    Refused(u16),
    /// Another transfer began, or the recording ended.
    Unanswered,
}

/// An SDO transfer with all its segments.
#[derive(Debug, Clone)]
pub struct Transfer {
    /// The time in ns since 1970.
    pub began: u64,
    pub ended_at: u64,
    pub way: TransferDirection,
    pub index: u16,
    pub sub: u8,
    pub complete: bool,
    /// The stored part of the data.
    pub data: Vec<u8>,
    /// The number of transferred bytes.
    pub len: usize,
    pub segments: u32,
    pub ended: TransferOutcome,
}

impl Transfer {
    /// True if the object does not exist. MainDevices detect optional objects in this way.
    pub fn is_absent(&self) -> bool {
        let absent = matches!(
            self.ended,
            TransferOutcome::Aborted { code, .. } if is_no_such_object(code)
        );
        absent && self.way == TransferDirection::Read
    }

    /// True if the transfer failed.
    pub fn is_trouble(&self) -> bool {
        self.ended != TransferOutcome::Done && !self.is_absent()
    }
}

/// A file transfer over FoE.
#[derive(Debug, Clone)]
pub struct FileTransfer {
    pub began: u64,
    pub ended_at: u64,
    pub way: TransferDirection,
    pub name: String,
    pub len: usize,
    /// The code and text of an error.
    pub error: Option<(u32, String)>,
}

/// The result of a message.
#[derive(Debug, Clone)]
pub enum MailboxEvent {
    Transfer(Transfer),
    Emergency(Emergency),
    File(FileTransfer),
    Idn(IdnTransfer),
    /// An object list with this number of objects.
    ObjectList(usize),
    /// The mailbox refused a message other than an SDO request.
    Refused(u16),
    /// SDO Information refused a request.
    NoInformation(u32),
}

/// The mailboxes of one device.
#[derive(Debug, Default, Clone)]
pub struct Mailbox {
    transfer: Option<Pending>,
    file: Option<FileTransfer>,
    soe: SoeMailbox,
    last_request: Vec<u8>,
    /// The number of objects in an incomplete list.
    listed: usize,
    /// Names from SDO Information by index; subindex 0xffff is the object itself.
    pub names: BTreeMap<(u16, u16), String>,
    /// The number of messages by type, in both directions.
    pub messages: [u64; 16],
}

#[derive(Debug, Clone)]
struct Pending {
    transfer: Transfer,
    /// The announced size.
    size: usize,
    last_sent: bool,
}

fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_le_bytes(*bytes.get(at..)?.first_chunk()?))
}

fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|b| *b == 0).unwrap_or(bytes.len());
    let text = String::from_utf8_lossy(bytes.get(..end).unwrap_or_default());
    text.chars().filter(|c| !c.is_control()).take(200).collect()
}

/// True if bytes look like a mailbox message. Used if the recording does not show the SyncManager
/// configuration.
pub fn plausible(bytes: &[u8]) -> bool {
    let Ok(mailbox) = mailbox::Mailbox::parse(bytes) else {
        return false;
    };
    let head = u16_at(mailbox.body, 0);
    match mailbox.protocol {
        TYPE_COE => head.is_some_and(|head| matches!(head >> 12, 1..=8)),
        TYPE_ERROR => mailbox.body.len() == 4 && head == Some(1),
        1..=5 | 15 => mailbox.body.len() >= 2,
        _ => false,
    }
}

impl Mailbox {
    /// Processes a complete mailbox. Returns the completed events.
    pub fn message(&mut self, at: u64, to_device: bool, bytes: &[u8]) -> Vec<MailboxEvent> {
        let mut reported = Vec::new();
        let Ok(mailbox) = mailbox::Mailbox::parse(bytes) else {
            return reported;
        };
        if to_device {
            let whole = bytes
                .get(..mailbox::HEADER + mailbox.body.len())
                .unwrap_or_default();
            // A repeated request after a lost answer has the same counter.
            if mailbox.counter != 0 && self.last_request == whole {
                return reported;
            }
            self.last_request.clear();
            self.last_request.extend_from_slice(whole);
        }
        if let Some(count) = self.messages.get_mut(usize::from(mailbox.protocol)) {
            *count += 1;
        }
        match mailbox.protocol {
            TYPE_COE if to_device => self.request(at, bytes, &mut reported),
            TYPE_COE => self.response(at, bytes, &mut reported),
            TYPE_FOE => self.foe(at, to_device, bytes, &mut reported),
            TYPE_SOE => self.soe.message(at, bytes, &mut reported),
            TYPE_ERROR => {
                let code = mailbox.error_code().unwrap_or(0);
                if self.transfer.is_some() {
                    self.close(at, TransferOutcome::Refused(code), &mut reported);
                } else if self.soe.is_waiting() {
                    self.soe.end(at, IdnOutcome::Mailbox(code), &mut reported);
                } else {
                    reported.push(MailboxEvent::Refused(code));
                }
            }
            _ => {}
        }
        reported
    }

    /// Ends the recording.
    pub fn end(&mut self, at: u64) -> Vec<MailboxEvent> {
        let mut reported = Vec::new();
        self.close(at, TransferOutcome::Unanswered, &mut reported);
        self.soe.end(at, IdnOutcome::Unanswered, &mut reported);
        if let Some(mut file) = self.file.take() {
            file.ended_at = at;
            reported.push(MailboxEvent::File(file));
        }
        reported
    }

    fn close(&mut self, at: u64, ended: TransferOutcome, reported: &mut Vec<MailboxEvent>) {
        if let Some(mut pending) = self.transfer.take() {
            pending.transfer.ended_at = at;
            pending.transfer.ended = ended;
            reported.push(MailboxEvent::Transfer(pending.transfer));
        }
    }

    fn abort(&mut self, at: u64, code: u32, by_device: bool, reported: &mut Vec<MailboxEvent>) {
        self.close(at, TransferOutcome::Aborted { code, by_device }, reported);
    }

    fn request(&mut self, at: u64, bytes: &[u8], reported: &mut Vec<MailboxEvent>) {
        let Ok(Some(request)) = Request::parse(bytes) else {
            return;
        };
        let (way, index, sub, complete, size, data) = match request {
            Request::Upload {
                index,
                sub,
                complete,
            } => (TransferDirection::Read, index, sub, complete, 0, &[][..]),
            Request::DownloadExpedited { index, sub, data } => (
                TransferDirection::Write,
                index,
                sub,
                false,
                data.len(),
                data,
            ),
            Request::Download {
                index,
                sub,
                complete,
                size,
                data,
            } => {
                let size = size as usize;
                let data = data.get(..size).unwrap_or(data);
                (TransferDirection::Write, index, sub, complete, size, data)
            }
            Request::DownloadSegment { last, data, .. } => {
                if let Some(pending) = &mut self.transfer {
                    pending.add_segment(data);
                    pending.last_sent = last;
                }
                return;
            }
            Request::Abort { code, .. } => return self.abort(at, code, false, reported),
            Request::Information { .. } => {
                self.listed = 0;
                return;
            }
            Request::UploadSegment { .. } => return,
        };
        self.close(at, TransferOutcome::Unanswered, reported);
        let mut pending = Pending {
            transfer: Transfer {
                began: at,
                ended_at: at,
                way,
                index,
                sub,
                complete,
                data: Vec::new(),
                len: 0,
                segments: 0,
                ended: TransferOutcome::Unanswered,
            },
            size,
            last_sent: false,
        };
        pending.add(data);
        self.transfer = Some(pending);
    }

    fn response(&mut self, at: u64, bytes: &[u8], reported: &mut Vec<MailboxEvent>) {
        let answer = match Message::parse(bytes) {
            Ok(Message::Sdo(answer)) => answer,
            Ok(Message::Information(fragment)) => return self.information(&fragment, reported),
            Ok(Message::Emergency(bytes)) => {
                return reported.push(MailboxEvent::Emergency(Emergency::from_bytes(*bytes)));
            }
            _ => return,
        };
        let Some(pending) = &mut self.transfer else {
            return;
        };
        let transfer = &pending.transfer;
        let (way, expected) = (transfer.way, transfer.index);
        let done = match (answer, way) {
            (Answer::Abort { code, .. }, _) => return self.abort(at, code, true, reported),
            (
                Answer::Upload {
                    index, size, data, ..
                },
                TransferDirection::Read,
            ) if index == expected => {
                pending.size = size;
                pending.add(data);
                pending.transfer.len >= size
            }
            (Answer::UploadSegment { last, data, .. }, TransferDirection::Read) => {
                pending.add_segment(data);
                last
            }
            (Answer::Download { index, .. }, TransferDirection::Write) if index == expected => {
                transfer.len >= pending.size
            }
            (Answer::DownloadSegment { .. }, TransferDirection::Write) => pending.last_sent,
            _ => false,
        };
        if done {
            self.close(at, TransferOutcome::Done, reported);
        }
    }

    fn information(&mut self, fragment: &Fragment<'_>, reported: &mut Vec<MailboxEvent>) {
        let body = fragment.data;
        match fragment.opcode {
            2 => {
                self.listed += body.len() / 2;
                if fragment.left == 0 {
                    // The first word is the list type.
                    reported.push(MailboxEvent::ObjectList(self.listed.saturating_sub(1)));
                }
            }
            4 => {
                if let (Some(index), Some(name)) = (u16_at(body, 0), body.get(6..)) {
                    self.name(index, u16::MAX, name);
                }
            }
            6 => {
                if let (Some(index), Some(sub), Some(name)) =
                    (u16_at(body, 0), body.get(2), body.get(10..))
                    // Only if no other fields precede the name.
                    && body.get(3).is_some_and(|info| info & 0x78 == 0)
                {
                    self.name(index, u16::from(*sub), name);
                }
            }
            7 => {
                let code = body
                    .first_chunk()
                    .map_or(0, |code| u32::from_le_bytes(*code));
                reported.push(MailboxEvent::NoInformation(code));
            }
            _ => {}
        }
    }

    fn name(&mut self, index: u16, sub: u16, name: &[u8]) {
        let name = text(name);
        if !name.is_empty() && self.names.len() < NAMES {
            self.names.insert((index, sub), name);
        }
    }

    fn foe(&mut self, at: u64, to_device: bool, bytes: &[u8], reported: &mut Vec<MailboxEvent>) {
        match foe::Message::parse(bytes) {
            Ok(foe::Message::Read { name, .. }) if to_device => {
                self.begin_file(at, TransferDirection::Read, name, reported);
            }
            Ok(foe::Message::Write { name, .. }) if to_device => {
                self.begin_file(at, TransferDirection::Write, name, reported);
            }
            Ok(foe::Message::Data { data, .. }) => {
                if let Some(file) = &mut self.file {
                    file.ended_at = at;
                    file.len += data.len();
                }
            }
            Ok(foe::Message::Error { code, text: reason }) => {
                if let Some(mut file) = self.file.take() {
                    file.ended_at = at;
                    file.error = Some((code, text(reason)));
                    reported.push(MailboxEvent::File(file));
                }
            }
            _ => {}
        }
    }

    fn begin_file(
        &mut self,
        at: u64,
        way: TransferDirection,
        name: &[u8],
        reported: &mut Vec<MailboxEvent>,
    ) {
        let started = FileTransfer {
            began: at,
            ended_at: at,
            way,
            name: text(name),
            len: 0,
            error: None,
        };
        if let Some(mut file) = self.file.replace(started) {
            file.ended_at = at;
            reported.push(MailboxEvent::File(file));
        }
    }
}

impl Pending {
    fn add(&mut self, data: &[u8]) {
        self.transfer.len += data.len();
        let room = KEPT.saturating_sub(self.transfer.data.len());
        let kept = data.get(..room.min(data.len())).unwrap_or_default();
        self.transfer.data.extend_from_slice(kept);
    }

    fn add_segment(&mut self, data: &[u8]) {
        self.add(data);
        self.transfer.segments += 1;
    }
}
