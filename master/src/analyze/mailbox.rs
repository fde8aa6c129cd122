//! Mailbox messages as they pass (ETG.1000.4 clause 5.6, ETG.1000.6 clause 5.6), put together to transfers.

use std::collections::BTreeMap;

use crate::mailbox::Emergency;

const HEADER: usize = 6;
const TYPE_ERROR: u8 = 0;
const TYPE_COE: u8 = 3;
const TYPE_FOE: u8 = 4;

/// What of an object is kept; its length is counted.
const KEPT: usize = 1024;
/// Names and entries of dictionaries that are kept of one device.
const NAMES: usize = 20_000;

/// Which way a transfer goes, seen from the MainDevice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Way {
    /// SDO upload.
    Read,
    /// SDO download.
    Write,
}

/// How a transfer ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ended {
    Done,
    Aborted {
        code: u32,
        by_device: bool,
    },
    /// The device's mailbox refused the request.
    Refused(u16),
    /// Another one began, or the recording ended.
    Unanswered,
}

/// An SDO transfer with all its segments.
#[derive(Debug, Clone)]
pub struct Transfer {
    /// Nanoseconds since 1970.
    pub began: u64,
    pub ended_at: u64,
    pub way: Way,
    pub index: u16,
    pub sub: u8,
    pub complete: bool,
    /// As long as is kept.
    pub data: Vec<u8>,
    /// Bytes that passed.
    pub len: usize,
    pub segments: u32,
    pub ended: Ended,
}

impl Transfer {
    /// Asked for an object that is not there: how one finds out what a device has.
    pub fn is_absent(&self) -> bool {
        let absent = matches!(
            self.ended,
            Ended::Aborted {
                code: 0x0602_0000 | 0x0609_0011,
                ..
            }
        );
        absent && self.way == Way::Read
    }

    /// Did not end as it should.
    pub fn is_trouble(&self) -> bool {
        self.ended != Ended::Done && !self.is_absent()
    }
}

/// A file over FoE.
#[derive(Debug, Clone)]
pub struct FileTransfer {
    pub began: u64,
    pub ended_at: u64,
    pub way: Way,
    pub name: String,
    pub len: usize,
    /// Code and text of an error.
    pub error: Option<(u32, String)>,
}

/// What came out of a message.
#[derive(Debug, Clone)]
pub enum Told {
    Transfer(Transfer),
    Emergency(Emergency),
    File(FileTransfer),
    /// A list of objects, how many.
    ObjectList(usize),
    /// The mailbox refused something that was no SDO request.
    Refused(u16),
    /// SDO Information refused a question.
    NoInformation(u32),
}

/// The mailboxes of one device.
#[derive(Debug, Default, Clone)]
pub struct Mailbox {
    transfer: Option<Pending>,
    file: Option<FileTransfer>,
    last_request: Vec<u8>,
    /// Objects of a list that is still coming.
    listed: usize,
    /// Names that SDO Information told, by index; subindex 0xffff is the object's own.
    pub names: BTreeMap<(u16, u16), String>,
    /// Messages by type: both ways.
    pub messages: [u64; 16],
}

#[derive(Debug, Clone)]
struct Pending {
    transfer: Transfer,
    /// As announced.
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

/// Whether bytes begin like a mailbox message, for recordings that do not show how SyncManagers were set.
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
    /// A message, whole as in the mailbox. Returns what it completes.
    pub fn message(&mut self, at: u64, to_device: bool, bytes: &[u8]) -> Vec<Told> {
        let mut told = Vec::new();
        let (Some(len), Some(kind)) = (u16_at(bytes, 0), bytes.get(5).copied()) else {
            return told;
        };
        let Some(body) = bytes.get(HEADER..HEADER + usize::from(len)) else {
            return told;
        };
        if to_device {
            let whole = bytes.get(..HEADER + body.len()).unwrap_or_default();
            // Sent again, because its answer was lost: the counter tells.
            if kind >> 4 & 7 != 0 && self.last_request == whole {
                return told;
            }
            self.last_request.clear();
            self.last_request.extend_from_slice(whole);
        }
        if let Some(count) = self.messages.get_mut(usize::from(kind & 0x0f)) {
            *count += 1;
        }
        match kind & 0x0f {
            TYPE_COE => self.coe(at, to_device, body, &mut told),
            TYPE_FOE => self.foe(at, to_device, body, &mut told),
            TYPE_ERROR => {
                let code = u16_at(body, 2).unwrap_or(0);
                if self.transfer.is_some() {
                    self.close(at, Ended::Refused(code), &mut told);
                } else {
                    told.push(Told::Refused(code));
                }
            }
            _ => {}
        }
        told
    }

    /// The recording ends.
    pub fn end(&mut self, at: u64) -> Vec<Told> {
        let mut told = Vec::new();
        self.close(at, Ended::Unanswered, &mut told);
        if let Some(mut file) = self.file.take() {
            file.ended_at = at;
            told.push(Told::File(file));
        }
        told
    }

    fn close(&mut self, at: u64, ended: Ended, told: &mut Vec<Told>) {
        if let Some(mut pending) = self.transfer.take() {
            pending.transfer.ended_at = at;
            pending.transfer.ended = ended;
            told.push(Told::Transfer(pending.transfer));
        }
    }

    fn coe(&mut self, at: u64, to_device: bool, body: &[u8], told: &mut Vec<Told>) {
        let (Some(head), Some(content)) = (u16_at(body, 0), body.get(2..)) else {
            return;
        };
        match head >> 12 {
            1 => told.extend(Emergency::parse(content).map(Told::Emergency)),
            2 | 3 if content.first() == Some(&0x80) => {
                let code = u32_at(content, 4).unwrap_or(0);
                let by_device = !to_device;
                self.close(at, Ended::Aborted { code, by_device }, told);
            }
            2 if to_device => self.request(at, content, told),
            3 => self.response(at, content, told),
            8 => self.information(to_device, content, told),
            _ => {}
        }
    }

    fn request(&mut self, at: u64, content: &[u8], told: &mut Vec<Told>) {
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
            1 => Way::Write,
            2 => Way::Read,
            _ => return,
        };
        self.close(at, Ended::Unanswered, told);
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
                ended: Ended::Unanswered,
            },
            size: 0,
            last_sent: false,
        };
        if way == Way::Write {
            let (size, data) = initiated(command, rest.get(3..).unwrap_or_default());
            pending.size = size;
            pending.add(data);
        }
        self.transfer = Some(pending);
    }

    fn response(&mut self, at: u64, content: &[u8], told: &mut Vec<Told>) {
        let (Some((&command, rest)), Some(pending)) = (content.split_first(), &mut self.transfer)
        else {
            return;
        };
        let transfer = &pending.transfer;
        let same = u16_at(rest, 0) == Some(transfer.index);
        let done = match (command >> 5, transfer.way) {
            (2, Way::Read) if same => {
                let (size, data) = initiated(command, rest.get(3..).unwrap_or_default());
                pending.size = size;
                pending.add(data);
                pending.transfer.len >= size
            }
            (0, Way::Read) => {
                pending.add(segment(command, rest));
                pending.transfer.segments += 1;
                command & 1 != 0
            }
            (3, Way::Write) if same => transfer.len >= pending.size,
            (1, Way::Write) => pending.last_sent,
            _ => false,
        };
        if done {
            self.close(at, Ended::Done, told);
        }
    }

    /// SDO Information: opcode, fragments left, content.
    fn information(&mut self, to_device: bool, content: &[u8], told: &mut Vec<Told>) {
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
                    // The first word says which list it is.
                    told.push(Told::ObjectList(self.listed.saturating_sub(1)));
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
                    // Nothing else in front of the name.
                    && body.get(3).is_some_and(|info| info & 0x78 == 0)
                {
                    self.name(index, u16::from(*sub), name);
                }
            }
            7 => told.push(Told::NoInformation(u32_at(body, 0).unwrap_or(0))),
            _ => {}
        }
    }

    fn name(&mut self, index: u16, sub: u16, name: &[u8]) {
        let name = text(name);
        if !name.is_empty() && self.names.len() < NAMES {
            self.names.insert((index, sub), name);
        }
    }

    fn foe(&mut self, at: u64, to_device: bool, body: &[u8], told: &mut Vec<Told>) {
        let (Some(&opcode), Some(rest)) = (body.first(), body.get(2..)) else {
            return;
        };
        match opcode {
            1 | 2 if to_device => {
                if let Some(mut file) = self.file.take() {
                    file.ended_at = at;
                    told.push(Told::File(file));
                }
                self.file = Some(FileTransfer {
                    began: at,
                    ended_at: at,
                    way: if opcode == 1 { Way::Read } else { Way::Write },
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
                    told.push(Told::File(file));
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

/// Announced size and first data of what follows command, index and subindex.
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

/// The data of a segment; what is shorter than a CAN frame is padded.
fn segment(command: u8, data: &[u8]) -> &[u8] {
    if data.len() > 7 {
        return data;
    }
    let used = 7 - usize::from(command >> 1 & 7);
    data.get(..used).unwrap_or(data)
}
