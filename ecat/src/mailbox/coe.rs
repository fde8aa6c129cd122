//! CoE messages (ETG.1000.6 clause 5.6): SDO, SDO Information, emergencies.
//!
//! ```
//! use ecaxis_ecat::mailbox::Encode;
//! use ecaxis_ecat::mailbox::coe::{Message, Request};
//!
//! let request = Request::Upload { index: 0x6041, sub: 0, complete: false };
//! let mut bytes = Vec::new();
//! request.emit(1, 32, &mut bytes);
//! // The header of ETG.1000.4: 10 bytes follow, type CoE, counter 1; then the command of an upload.
//! assert_eq!(bytes[..6], [10, 0, 0, 0, 0, 0x13]);
//! assert_eq!(bytes[8..12], [0x40, 0x41, 0x60, 0]);
//! assert_eq!(Request::parse(&bytes), Ok(Some(request)));
//! assert!(Message::parse(&bytes[..4]).is_err());
//! ```

use alloc::vec::Vec;

use super::{DecodeError, Encode, HEADER, Mailbox, TYPE_COE, TYPE_ERROR};

/// CoE header plus SDO header: service, command, index, subindex.
const COE_SDO_HEADER: usize = 6;
/// The header of a segment: CoE header and command.
const SEGMENT_HEADER: usize = 3;
/// A segment is padded to this many data bytes, as on CAN. Only then the command contains the
/// number of unused bytes.
pub(super) const SEGMENT_MIN: usize = 7;

const SERVICE_EMERGENCY: u16 = 1;
pub(super) const SERVICE_SDO_REQUEST: u16 = 2;
pub(super) const SERVICE_SDO_RESPONSE: u16 = 3;
pub(super) const SERVICE_SDO_INFORMATION: u16 = 8;

const COMPLETE_ACCESS: u8 = 0x10;
pub(super) const TOGGLE: u8 = 0x10;
pub(super) const EXPEDITED: u8 = 0x02;
pub(super) const SIZE_INDICATED: u8 = 0x01;
pub(super) const ABORT: u8 = 0x80;

/// Returns the data bytes that fit into a download request with a size field.
pub fn download_room(mailbox: u16) -> usize {
    usize::from(mailbox).saturating_sub(HEADER + COE_SDO_HEADER + 4)
}

/// Returns the data bytes that fit into a download segment.
pub fn segment_room(mailbox: u16) -> usize {
    usize::from(mailbox).saturating_sub(HEADER + SEGMENT_HEADER)
}

/// A message to a SubDevice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs, reason = "the fields are those of the standard")]
pub enum Request<'a> {
    /// Requests an object.
    Upload { index: u16, sub: u8, complete: bool },
    /// Requests the next segment.
    UploadSegment { toggle: bool },
    /// Writes one to four bytes.
    DownloadExpedited { index: u16, sub: u8, data: &'a [u8] },
    /// Writes an object: `size` is its whole size, `data` its beginning.
    Download {
        index: u16,
        sub: u8,
        complete: bool,
        size: u32,
        data: &'a [u8],
    },
    /// Writes the next segment.
    DownloadSegment {
        toggle: bool,
        last: bool,
        data: &'a [u8],
    },
    /// Ends a transfer.
    Abort { index: u16, sub: u8, code: u32 },
    /// SDO Information; requests fit into one fragment.
    Information { opcode: u8, body: &'a [u8] },
}

impl Encode for Request<'_> {
    fn emit(&self, counter: u8, mailbox: u16, out: &mut Vec<u8>) {
        super::emit(TYPE_COE, counter, mailbox, out, |out| self.emit_body(out));
    }
}

impl Request<'_> {
    fn emit_body(&self, out: &mut Vec<u8>) {
        let service = match self {
            Self::Information { .. } => SERVICE_SDO_INFORMATION,
            _ => SERVICE_SDO_REQUEST,
        };
        out.extend_from_slice(&(service << 12).to_le_bytes());
        let initiate = |out: &mut Vec<u8>, command: u8, complete: bool, index: u16, sub: u8| {
            out.push(if complete {
                command | COMPLETE_ACCESS
            } else {
                command
            });
            out.extend_from_slice(&index.to_le_bytes());
            out.push(sub);
        };
        match *self {
            Self::Upload {
                index,
                sub,
                complete,
            } => {
                initiate(out, 0x40, complete, index, sub);
                out.extend_from_slice(&[0; 4]);
            }
            Self::UploadSegment { toggle } => {
                out.push(if toggle { 0x60 | TOGGLE } else { 0x60 });
                out.extend_from_slice(&[0; SEGMENT_MIN]);
            }
            Self::DownloadExpedited { index, sub, data } => {
                initiate(out, 0x23 | unused(4, data.len()) << 2, false, index, sub);
                out.extend_from_slice(data);
                out.resize(HEADER + COE_SDO_HEADER + 4, 0);
            }
            Self::Download {
                index,
                sub,
                complete,
                size,
                data,
            } => {
                initiate(out, 0x21, complete, index, sub);
                out.extend_from_slice(&size.to_le_bytes());
                out.extend_from_slice(data);
            }
            Self::DownloadSegment { toggle, last, data } => {
                out.push(
                    unused(SEGMENT_MIN, data.len()) << 1
                        | u8::from(last)
                        | if toggle { TOGGLE } else { 0 },
                );
                out.extend_from_slice(data);
                let shortest = HEADER + SEGMENT_HEADER + SEGMENT_MIN;
                out.resize(out.len().max(shortest), 0);
            }
            Self::Abort { index, sub, code } => {
                initiate(out, ABORT, false, index, sub);
                out.extend_from_slice(&code.to_le_bytes());
            }
            Self::Information { opcode, body } => {
                out.extend_from_slice(&[opcode, 0, 0, 0]);
                out.extend_from_slice(body);
            }
        }
    }
}

impl<'a> Request<'a> {
    /// Parses one whole mailbox to a SubDevice. `None` if it holds no request of CoE's SDO
    /// services.
    ///
    /// # Errors
    /// [`DecodeError`] if the message is inconsistent.
    pub fn parse(mailbox: &'a [u8]) -> Result<Option<Self>, DecodeError> {
        let mailbox = Mailbox::parse(mailbox)?;
        if mailbox.protocol != TYPE_COE {
            return Ok(None);
        }
        let (service, content) = service(mailbox.body)?;
        match service {
            SERVICE_SDO_REQUEST => parse_request(content).map(Some),
            SERVICE_SDO_INFORMATION => fragment(content).map(|request| {
                Some(Self::Information {
                    opcode: request.opcode,
                    body: request.data,
                })
            }),
            _ => Ok(None),
        }
    }
}

/// Returns how many of `room` bytes are unused; 0 if `used` reaches or exceeds `room`.
pub(super) fn unused(room: usize, used: usize) -> u8 {
    u8::try_from(room.saturating_sub(used)).unwrap_or(0)
}

/// A message from a SubDevice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Message<'a> {
    /// An emergency: error code, error register, five bytes of the vendor (Table 50).
    Emergency(&'a [u8; 8]),
    /// An SDO answer.
    Sdo(Answer<'a>),
    /// A part of an SDO Information answer.
    Information(Fragment<'a>),
    /// The SubDevice's mailbox rejected a message, with this code.
    Refused(u16),
    /// Any other message: another protocol or another CoE service.
    Other,
}

/// An SDO answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs, reason = "the fields are those of the standard")]
pub enum Answer<'a> {
    /// The transfer ended.
    Abort { index: u16, sub: u8, code: u32 },
    /// `size` is the size of the whole object; segments follow if it exceeds `data`.
    Upload {
        index: u16,
        sub: u8,
        size: usize,
        data: &'a [u8],
    },
    /// The next segment of an upload.
    UploadSegment {
        toggle: bool,
        last: bool,
        data: &'a [u8],
    },
    /// The device took the beginning of a download.
    Download { index: u16, sub: u8 },
    /// The device took a segment.
    DownloadSegment { toggle: bool },
}

/// One message of an SDO Information answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fragment<'a> {
    /// 2, 4 or 6 for an answer, 7 for an error (ETG.1000.6 clause 5.6.3).
    pub opcode: u8,
    /// The number of fragments that follow.
    pub left: u16,
    /// The part of the answer.
    pub data: &'a [u8],
}

impl<'a> Message<'a> {
    /// Parses one whole mailbox from a SubDevice.
    ///
    /// # Errors
    /// [`DecodeError`] if the message is inconsistent.
    pub fn parse(mailbox: &'a [u8]) -> Result<Self, DecodeError> {
        let mailbox = Mailbox::parse(mailbox)?;
        match mailbox.protocol {
            TYPE_COE => parse_coe(mailbox.body),
            TYPE_ERROR => mailbox.error_code().map(Message::Refused),
            _ => Ok(Message::Other),
        }
    }
}

/// Splits a CoE message into its service and the rest.
fn service(body: &[u8]) -> Result<(u16, &[u8]), DecodeError> {
    match body {
        [low, high, content @ ..] => Ok((u16::from_le_bytes([*low, *high]) >> 12, content)),
        _ => Err(short("a CoE message", body)),
    }
}

const fn short(what: &'static str, body: &[u8]) -> DecodeError {
    DecodeError::Short {
        what,
        length: body.len(),
    }
}

fn parse_coe(body: &[u8]) -> Result<Message<'_>, DecodeError> {
    let (service, content) = service(body)?;
    match service {
        SERVICE_EMERGENCY => content
            .first_chunk()
            .map(Message::Emergency)
            .ok_or(short("an emergency", body)),
        SERVICE_SDO_RESPONSE => parse_sdo(content).map(Message::Sdo),
        // Devices send an abort with either service.
        SERVICE_SDO_REQUEST if content.first().is_some_and(|command| is_abort(*command)) => {
            parse_sdo(content).map(Message::Sdo)
        }
        SERVICE_SDO_INFORMATION => fragment(content).map(Message::Information),
        _ => Ok(Message::Other),
    }
}

/// True for an abort. Bits 0 to 4 are reserved (ETG.1000.6 clause 5.6.2.7); some devices set them.
const fn is_abort(command: u8) -> bool {
    command >> 5 == ABORT >> 5
}

fn fragment(content: &[u8]) -> Result<Fragment<'_>, DecodeError> {
    match content {
        [opcode, _, low, high, data @ ..] => Ok(Fragment {
            // The highest bit repeats that fragments follow.
            opcode: opcode & 0x7f,
            left: u16::from_le_bytes([*low, *high]),
            data,
        }),
        _ => Err(short("an SDO Information message", content)),
    }
}

/// Returns index, subindex and the rest.
fn address(rest: &[u8]) -> Option<(u16, u8, &[u8])> {
    match rest {
        [low, high, sub, rest @ ..] => Some((u16::from_le_bytes([*low, *high]), *sub, rest)),
        _ => None,
    }
}

/// Returns the length of the data in an expedited transfer.
fn expedited_len(command: u8) -> usize {
    match command & SIZE_INDICATED {
        0 => 4,
        _ => 4 - usize::from(command >> 2 & 3),
    }
}

fn parse_request(content: &[u8]) -> Result<Request<'_>, DecodeError> {
    let short = short("an SDO request", content);
    let (&command, rest) = content.split_first().ok_or(short)?;
    let toggle = command & TOGGLE != 0;
    let complete = command & COMPLETE_ACCESS != 0;
    match command >> 5 {
        0 => {
            return Ok(Request::DownloadSegment {
                toggle,
                last: command & 1 != 0,
                data: segment_data(command, rest),
            });
        }
        3 => return Ok(Request::UploadSegment { toggle }),
        1 | 2 | 4 => {}
        _ => return Err(DecodeError::Command(command)),
    }
    let (index, sub, rest) = address(rest).ok_or(short)?;
    if command >> 5 == 2 {
        return Ok(Request::Upload {
            index,
            sub,
            complete,
        });
    }
    let (field, data) = rest.split_first_chunk::<4>().ok_or(short)?;
    let number = u32::from_le_bytes(*field);
    Ok(match command >> 5 {
        4 => Request::Abort {
            index,
            sub,
            code: number,
        },
        _ if command & EXPEDITED != 0 => Request::DownloadExpedited {
            index,
            sub,
            data: rest.get(..expedited_len(command)).unwrap_or_default(),
        },
        _ => Request::Download {
            index,
            sub,
            complete,
            size: number,
            data,
        },
    })
}

fn parse_sdo(content: &[u8]) -> Result<Answer<'_>, DecodeError> {
    let short = short("an SDO answer", content);
    let (&command, rest) = content.split_first().ok_or(short)?;
    let toggle = command & TOGGLE != 0;
    match command >> 5 {
        0 => Ok(Answer::UploadSegment {
            toggle,
            last: command & 1 != 0,
            data: segment_data(command, rest),
        }),
        1 => Ok(Answer::DownloadSegment { toggle }),
        specifier @ 2..=4 => {
            let (index, sub, rest) = address(rest).ok_or(short)?;
            if specifier == 3 {
                return Ok(Answer::Download { index, sub });
            }
            let (field, data) = rest.split_first_chunk::<4>().ok_or(short)?;
            let number = u32::from_le_bytes(*field);
            if specifier == 4 {
                return Ok(Answer::Abort {
                    index,
                    sub,
                    code: number,
                });
            }
            if command & EXPEDITED != 0 {
                let size = expedited_len(command);
                return Ok(Answer::Upload {
                    index,
                    sub,
                    size,
                    data: field.get(..size).unwrap_or(field),
                });
            }
            let size = usize::try_from(number).unwrap_or(usize::MAX);
            // Some devices pad data shorter than a CAN frame.
            let data = data.get(..size).unwrap_or(data);
            Ok(Answer::Upload {
                index,
                sub,
                size,
                data,
            })
        }
        _ => Err(DecodeError::Command(command)),
    }
}

fn segment_data(command: u8, data: &[u8]) -> &[u8] {
    if data.len() > SEGMENT_MIN {
        return data;
    }
    let used = SEGMENT_MIN - usize::from(command >> 1 & 7);
    data.get(..used).unwrap_or(data)
}
