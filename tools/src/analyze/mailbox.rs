//! Mailbox messages (ETG.1000.4 clause 5.6, ETG.1000.6 clause 5.6), assembled to transfers.

use std::collections::BTreeMap;

use ecaxis_master::mailbox::Emergency;

const HEADER: usize = 6;
const TYPE_ERROR: u8 = 0;
const TYPE_COE: u8 = 3;
const TYPE_FOE: u8 = 4;

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
            TransferOutcome::Aborted {
                code: 0x0602_0000 | 0x0609_0011,
                ..
            }
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

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_le_bytes(*bytes.get(at..)?.first_chunk()?))
}

fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|b| *b == 0).unwrap_or(bytes.len());
    let text = String::from_utf8_lossy(bytes.get(..end).unwrap_or_default());
    text.chars().filter(|c| !c.is_control()).take(200).collect()
}

/// True if bytes look like a mailbox message. Used if the recording does not show the SyncManager
/// configuration.
pub fn plausible(bytes: &[u8]) -> bool {
    let (Some(len), Some(kind)) = (u16_at(bytes, 0), bytes.get(5)) else {
        return false;
    };
    let fits = len >= 2 && HEADER + usize::from(len) <= bytes.len();
    let coe = || u16_at(bytes, HEADER).is_some_and(|head| matches!(head >> 12, 1..=8));
    fits && match kind & 0x0f {
        TYPE_COE => coe(),
        TYPE_ERROR => len == 4 && u16_at(bytes, HEADER) == Some(1),
        1..=5 | 15 => true,
        _ => false,
    }
}

impl Mailbox {
    /// Processes a complete mailbox. Returns the completed events.
    pub fn message(&mut self, at: u64, to_device: bool, bytes: &[u8]) -> Vec<MailboxEvent> {
        let mut reported = Vec::new();
        let (Some(len), Some(kind)) = (u16_at(bytes, 0), bytes.get(5).copied()) else {
            return reported;
        };
        let Some(body) = bytes.get(HEADER..HEADER + usize::from(len)) else {
            return reported;
        };
        if to_device {
            let whole = bytes.get(..HEADER + body.len()).unwrap_or_default();
            // A repeated request after a lost answer has the same counter.
            if kind >> 4 & 7 != 0 && self.last_request == whole {
                return reported;
            }
            self.last_request.clear();
            self.last_request.extend_from_slice(whole);
        }
        if let Some(count) = self.messages.get_mut(usize::from(kind & 0x0f)) {
            *count += 1;
        }
        match kind & 0x0f {
            TYPE_COE => self.coe(at, to_device, body, &mut reported),
            TYPE_FOE => self.foe(at, to_device, body, &mut reported),
            TYPE_ERROR => {
                let code = u16_at(body, 2).unwrap_or(0);
                if self.transfer.is_some() {
                    self.close(at, TransferOutcome::Refused(code), &mut reported);
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

    fn coe(&mut self, at: u64, to_device: bool, body: &[u8], reported: &mut Vec<MailboxEvent>) {
        let (Some(head), Some(content)) = (u16_at(body, 0), body.get(2..)) else {
            return;
        };
        match head >> 12 {
            1 => reported.extend(Emergency::parse(content).map(MailboxEvent::Emergency)),
            2 | 3 if content.first() == Some(&0x80) => {
                let code = u32_at(content, 4).unwrap_or(0);
                let by_device = !to_device;
                self.close(at, TransferOutcome::Aborted { code, by_device }, reported);
            }
            2 if to_device => self.request(at, content, reported),
            3 => self.response(at, content, reported),
            8 => self.information(to_device, content, reported),
            _ => {}
        }
    }

    fn request(&mut self, at: u64, content: &[u8], reported: &mut Vec<MailboxEvent>) {
        let Some((&command, rest)) = content.split_first() else {
            return;
        };
        let way = match command >> 5 {
            0 => {
                if let Some(pending) = &mut self.transfer {
                    pending.add(segment(command, rest));
                    pending.transfer.segments += 1;
                    pending.last_sent = command & 1 != 0;
                }
                return;
            }
            1 => TransferDirection::Write,
            2 => TransferDirection::Read,
            _ => return,
        };
        self.close(at, TransferOutcome::Unanswered, reported);
        let (Some(index), Some(sub)) = (u16_at(rest, 0), rest.get(2).copied()) else {
            return;
        };
        let mut pending = Pending {
            transfer: Transfer {
                began: at,
                ended_at: at,
                way,
                index,
                sub,
                complete: command & 0x10 != 0,
                data: Vec::new(),
                len: 0,
                segments: 0,
                ended: TransferOutcome::Unanswered,
            },
            size: 0,
            last_sent: false,
        };
        if way == TransferDirection::Write {
            let (size, data) = initiated(command, rest.get(3..).unwrap_or_default());
            pending.size = size;
            pending.add(data);
        }
        self.transfer = Some(pending);
    }

    fn response(&mut self, at: u64, content: &[u8], reported: &mut Vec<MailboxEvent>) {
        let (Some((&command, rest)), Some(pending)) = (content.split_first(), &mut self.transfer)
        else {
            return;
        };
        let transfer = &pending.transfer;
        let same = u16_at(rest, 0) == Some(transfer.index);
        let done = match (command >> 5, transfer.way) {
            (2, TransferDirection::Read) if same => {
                let (size, data) = initiated(command, rest.get(3..).unwrap_or_default());
                pending.size = size;
                pending.add(data);
                pending.transfer.len >= size
            }
            (0, TransferDirection::Read) => {
                pending.add(segment(command, rest));
                pending.transfer.segments += 1;
                command & 1 != 0
            }
            (3, TransferDirection::Write) if same => transfer.len >= pending.size,
            (1, TransferDirection::Write) => pending.last_sent,
            _ => false,
        };
        if done {
            self.close(at, TransferOutcome::Done, reported);
        }
    }

    /// Processes SDO Information: opcode, fragments left, content.
    fn information(&mut self, to_device: bool, content: &[u8], reported: &mut Vec<MailboxEvent>) {
        let (Some(&opcode), Some(left), Some(body)) =
            (content.first(), u16_at(content, 2), content.get(4..))
        else {
            return;
        };
        if to_device {
            self.listed = 0;
            return;
        }
        match opcode & 0x7f {
            2 => {
                self.listed += body.len() / 2;
                if left == 0 {
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
            7 => reported.push(MailboxEvent::NoInformation(u32_at(body, 0).unwrap_or(0))),
            _ => {}
        }
    }

    fn name(&mut self, index: u16, sub: u16, name: &[u8]) {
        let name = text(name);
        if !name.is_empty() && self.names.len() < NAMES {
            self.names.insert((index, sub), name);
        }
    }

    fn foe(&mut self, at: u64, to_device: bool, body: &[u8], reported: &mut Vec<MailboxEvent>) {
        let (Some(&opcode), Some(rest)) = (body.first(), body.get(2..)) else {
            return;
        };
        match opcode {
            1 | 2 if to_device => {
                if let Some(mut file) = self.file.take() {
                    file.ended_at = at;
                    reported.push(MailboxEvent::File(file));
                }
                self.file = Some(FileTransfer {
                    began: at,
                    ended_at: at,
                    way: if opcode == 1 {
                        TransferDirection::Read
                    } else {
                        TransferDirection::Write
                    },
                    name: text(rest.get(4..).unwrap_or_default()),
                    len: 0,
                    error: None,
                });
            }
            3 => {
                if let Some(file) = &mut self.file {
                    file.ended_at = at;
                    file.len += rest.len().saturating_sub(4);
                }
            }
            5 => {
                if let Some(mut file) = self.file.take() {
                    file.ended_at = at;
                    let code = u32_at(rest, 0).unwrap_or(0);
                    file.error = Some((code, text(rest.get(4..).unwrap_or_default())));
                    reported.push(MailboxEvent::File(file));
                }
            }
            _ => {}
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
}

/// Returns the announced size and the first data after command, index and subindex.
fn initiated(command: u8, rest: &[u8]) -> (usize, &[u8]) {
    if command & 0x02 != 0 {
        let unused = if command & 1 != 0 {
            usize::from(command >> 2 & 3)
        } else {
            0
        };
        let size = 4 - unused;
        return (size, rest.get(..size).unwrap_or(rest));
    }
    let size = u32_at(rest, 0).map_or(0, |size| size as usize);
    let data = rest.get(4..).unwrap_or_default();
    (size, data.get(..size).unwrap_or(data))
}

/// Returns the data of a segment. Short segments are padded to the size of a CAN frame.
fn segment(command: u8, data: &[u8]) -> &[u8] {
    if data.len() > 7 {
        return data;
    }
    let used = 7 - usize::from(command >> 1 & 7);
    data.get(..used).unwrap_or(data)
}
