//! The SDO server (ETG.1000.6 §5.6.2). It maps requests to responses, independent of the mailbox.

use super::{Abort, CoeServices, Dictionary, service};
use crate::device::mailbox::{Answer, Detail, MailboxCapacity};

/// Bytes of an initiate request: command, index, subindex, four data bytes.
const INITIATE: usize = 8;
/// Bytes of the CoE header in front of every message.
const COE: usize = 2;
/// The minimum segment data: that of a CAN frame.
const MIN_SEGMENT: usize = 7;

const COMPLETE: u8 = 0x10;
const TOGGLE: u8 = 0x10;
const EXPEDITED: u8 = 0x02;
const SIZE_INDICATED: u8 = 0x01;
const LAST: u8 = 0x01;

type Address = (u16, u8);

#[derive(Debug, Clone)]
struct Transfer {
    address: Address,
    toggle: u8,
    data: Vec<u8>,
    kind: Kind,
}

#[derive(Debug, Clone, Copy)]
enum Kind {
    Upload {
        /// Bytes already sent.
        at: usize,
    },
    Download {
        complete: bool,
        /// The announced size.
        size: Option<usize>,
        /// Maximum bytes that the object accepts.
        capacity: usize,
    },
}

#[derive(Debug, Clone, Default)]
pub(super) struct SdoServer {
    transfer: Option<Transfer>,
}

enum Refusal {
    Abort(Abort),
    Mailbox(Detail),
}

impl From<Abort> for Refusal {
    fn from(abort: Abort) -> Self {
        Self::Abort(abort)
    }
}

type Reply = Result<Vec<u8>, Refusal>;

impl SdoServer {
    pub(super) fn is_waiting(&self) -> bool {
        self.transfer.is_some()
    }

    pub(super) fn expire(&mut self) -> Option<Vec<u8>> {
        let transfer = self.transfer.take()?;
        Some(abort(Abort::TIMEOUT, transfer.address))
    }

    /// Answers one request. `request` starts behind the CoE header. A client abort has no answer.
    pub(super) fn request(
        &mut self,
        dictionary: &mut Dictionary<'_>,
        services: CoeServices,
        request: &[u8],
        room: MailboxCapacity,
    ) -> Answer {
        let Some((&command, segment)) = request.split_first() else {
            return Answer::Error(Detail::TooShort);
        };
        let specifier = command >> 5;
        // A segment's data may be shorter than an initiate request.
        let address = match segment {
            _ if specifier == 0 => (0, 0),
            [low, high, sub, _, _, _, _, ..] => (u16::from_le_bytes([*low, *high]), *sub),
            _ => return Answer::Error(Detail::TooShort),
        };
        let under_way = self.transfer.take();
        let of_transfer = under_way.as_ref().map_or((0, 0), |t| t.address);
        let (address, result) = match specifier {
            0 => {
                let reply = self.download_segment(dictionary, under_way, command, segment);
                (of_transfer, reply)
            }
            1 => (
                address,
                self.download(dictionary, services, command, address, request),
            ),
            2 if request.len() > INITIATE => (address, Err(Refusal::Mailbox(Detail::InvalidSize))),
            2 => (
                address,
                self.upload(dictionary, services, command, address, room),
            ),
            3 => {
                let reply = self.upload_segment(under_way, command, room);
                (of_transfer, reply)
            }
            4 => return Answer::None,
            _ => (address, Err(Abort::COMMAND.into())),
        };
        match result {
            Ok(reply) => Answer::One(reply),
            Err(Refusal::Abort(code)) => {
                let (index, sub) = address;
                let kept = if services.abort_index_word {
                    0xff00
                } else {
                    0xffff
                };
                Answer::One(abort(code, (index & kept, sub)))
            }
            Err(Refusal::Mailbox(detail)) => Answer::Error(detail),
        }
    }

    fn upload(
        &mut self,
        dictionary: &Dictionary<'_>,
        services: CoeServices,
        command: u8,
        address @ (index, sub): Address,
        room: MailboxCapacity,
    ) -> Reply {
        let complete = command & COMPLETE;
        let data = dictionary.read(index, sub, complete != 0)?;
        if (1..=4).contains(&data.len()) {
            let unused = (4 - data.len()) as u8;
            let specifier = 0x40 | complete | unused << 2 | EXPEDITED | SIZE_INDICATED;
            return Ok(initiate(specifier, address, &data));
        }
        let len = u32::try_from(data.len()).map_err(|_| Abort::OUT_OF_MEMORY)?;
        let specifier = 0x40 | complete | SIZE_INDICATED;
        let mut out = initiate(specifier, address, &len.to_le_bytes());
        let now = data.len().min(room.send.saturating_sub(COE + INITIATE));
        out.extend_from_slice(data.get(..now).unwrap_or_default());
        if now < data.len() {
            check_segmented(services, data.len())?;
            self.transfer = Some(Transfer {
                address,
                toggle: 0,
                data,
                kind: Kind::Upload { at: now },
            });
        }
        Ok(out)
    }

    fn upload_segment(
        &mut self,
        transfer: Option<Transfer>,
        command: u8,
        room: MailboxCapacity,
    ) -> Reply {
        let Some(mut transfer) = transfer else {
            return Err(Abort::COMMAND.into());
        };
        let Kind::Upload { at } = &mut transfer.kind else {
            return Err(Abort::COMMAND.into());
        };
        if command & TOGGLE != transfer.toggle {
            return Err(Abort::TOGGLE.into());
        }
        let rest = transfer.data.get(*at..).unwrap_or_default();
        let now = rest.len().min(room.send.saturating_sub(COE + 1));
        let last = now == rest.len();
        let unused = MIN_SEGMENT.saturating_sub(now) as u8;
        let mut out = super::header(service::SDO_RESPONSE).to_vec();
        out.push(transfer.toggle | unused << 1 | if last { LAST } else { 0 });
        out.extend_from_slice(rest.get(..now).unwrap_or_default());
        out.resize(out.len().max(COE + 1 + MIN_SEGMENT), 0);
        *at += now;
        transfer.toggle ^= TOGGLE;
        if !last {
            self.transfer = Some(transfer);
        }
        Ok(out)
    }

    fn download(
        &mut self,
        dictionary: &mut Dictionary<'_>,
        services: CoeServices,
        command: u8,
        address @ (index, sub): Address,
        request: &[u8],
    ) -> Reply {
        let complete = command & COMPLETE != 0;
        let capacity = dictionary.capacity(index, sub, complete)?;
        let value = request.get(4..INITIATE).unwrap_or_default();
        let rest = request.get(INITIATE..).unwrap_or_default();
        let sized = command & SIZE_INDICATED != 0;
        if command & EXPEDITED != 0 {
            if !rest.is_empty() {
                return Err(Refusal::Mailbox(Detail::InvalidSize));
            }
            let len = match sized {
                true => 4 - usize::from(command >> 2 & 3),
                // Without a size, the length of the object applies.
                false => capacity.min(4),
            };
            let data = value.get(..len).unwrap_or_default();
            check_capacity(data.len(), capacity)?;
            dictionary.write(index, sub, complete, data)?;
        } else {
            let size = <[u8; 4]>::try_from(value).map_or(0, u32::from_le_bytes);
            let size = usize::try_from(size).unwrap_or(usize::MAX);
            // A correct complete size counts even if the size bit is not set.
            let size = Some(size).filter(|size| sized || (*size > 0 && *size == rest.len()));
            check_capacity(size.unwrap_or(rest.len()), capacity)?;
            if size.is_some_and(|size| rest.len() > size) {
                return Err(Refusal::Mailbox(Detail::InvalidSize));
            }
            if size == Some(rest.len()) {
                dictionary.write(index, sub, complete, rest)?;
            } else {
                check_segmented(services, size.unwrap_or(capacity))?;
                let kind = Kind::Download {
                    complete,
                    size,
                    capacity,
                };
                self.transfer = Some(Transfer {
                    address,
                    toggle: 0,
                    data: rest.to_vec(),
                    kind,
                });
            }
        }
        Ok(initiate(0x60 | command & COMPLETE, address, &[]))
    }

    fn download_segment(
        &mut self,
        dictionary: &mut Dictionary<'_>,
        transfer: Option<Transfer>,
        command: u8,
        segment: &[u8],
    ) -> Reply {
        let Some(mut transfer) = transfer else {
            return Err(Abort::COMMAND.into());
        };
        let Kind::Download {
            complete,
            size,
            capacity,
        } = transfer.kind
        else {
            return Err(Abort::COMMAND.into());
        };
        if command & TOGGLE != transfer.toggle {
            return Err(Abort::TOGGLE.into());
        }
        let unused = match segment.len() {
            ..=MIN_SEGMENT => usize::from(command >> 1 & 7),
            _ => 0,
        };
        let used = segment.len().saturating_sub(unused);
        let so_far = transfer.data.len() + used;
        if size.is_some_and(|size| so_far > size) {
            return Err(Abort::LENGTH.into());
        }
        check_capacity(so_far, capacity)?;
        transfer
            .data
            .extend_from_slice(segment.get(..used).unwrap_or_default());
        let mut out = super::header(service::SDO_RESPONSE).to_vec();
        out.push(0x20 | transfer.toggle);
        out.resize(COE + INITIATE, 0);
        if command & LAST == 0 {
            transfer.toggle ^= TOGGLE;
            self.transfer = Some(transfer);
            return Ok(out);
        }
        if size.is_some_and(|size| so_far < size) {
            return Err(Abort::LENGTH.into());
        }
        let (index, sub) = transfer.address;
        dictionary.write(index, sub, complete, &transfer.data)?;
        Ok(out)
    }
}

fn check_capacity(len: usize, capacity: usize) -> Result<(), Abort> {
    if len > capacity {
        Err(Abort::TOO_LONG)
    } else {
        Ok(())
    }
}

/// Checks that a transfer of `len` bytes may continue in segments.
fn check_segmented(services: CoeServices, len: usize) -> Result<(), Abort> {
    if !services.segmented {
        Err(Abort::EXCEEDS_MAILBOX)
    } else if len > services.buffer {
        Err(Abort::OUT_OF_MEMORY)
    } else {
        Ok(())
    }
}

/// Builds an initiate response with up to four data bytes.
fn initiate(command: u8, (index, sub): Address, data: &[u8]) -> Vec<u8> {
    let mut out = super::header(service::SDO_RESPONSE).to_vec();
    out.push(command);
    out.extend_from_slice(&index.to_le_bytes());
    out.push(sub);
    out.extend_from_slice(data);
    out.resize(COE + INITIATE, 0);
    out
}

/// Builds an abort. Aborts are sent as SDO requests in both directions.
fn abort(abort: Abort, (index, sub): Address) -> Vec<u8> {
    let mut out = super::header(service::SDO_REQUEST).to_vec();
    out.push(0x80);
    out.extend_from_slice(&index.to_le_bytes());
    out.push(sub);
    out.extend_from_slice(&abort.0.to_le_bytes());
    out
}
