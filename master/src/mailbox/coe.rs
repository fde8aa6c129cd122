//! The bytes of mailbox, CoE and SDO messages. Parsing borrows, and accepts unknown services as
//! [`Message::Other`]. Only an inconsistent message is a [`DecodeError`].

use super::emergency::Emergency;
use super::transport::Encode;

/// Mailbox header (ETG.1000.4 Table 29): length, address, channel and priority, type and counter.
pub(super) const MAILBOX_HEADER: usize = 6;
/// CoE header plus SDO header: service, command, index, subindex.
const COE_SDO_HEADER: usize = 6;
/// The header of a segment: CoE header and command.
const SEGMENT_HEADER: usize = 3;
/// A segment is padded to this many data bytes, as on CAN. Only then the command contains the
/// number of unused bytes.
const SEGMENT_MIN: usize = 7;
/// The shortest mailbox that holds an expedited transfer and a segment.
pub(super) const MAILBOX_MIN: u16 = 16;

pub(super) const TYPE_ERROR: u8 = 0;
const TYPE_COE: u8 = 3;

const SERVICE_EMERGENCY: u16 = 1;
const SERVICE_SDO_REQUEST: u16 = 2;
const SERVICE_SDO_RESPONSE: u16 = 3;
const SERVICE_SDO_INFORMATION: u16 = 8;

const COMPLETE_ACCESS: u8 = 0x10;
const TOGGLE: u8 = 0x10;

/// Returns the data bytes that fit into a download request with a size field.
pub(super) fn download_room(mailbox: u16) -> usize {
    usize::from(mailbox).saturating_sub(MAILBOX_HEADER + COE_SDO_HEADER + 4)
}

/// Returns the data bytes that fit into a download segment.
pub(super) fn segment_room(mailbox: u16) -> usize {
    usize::from(mailbox).saturating_sub(MAILBOX_HEADER + SEGMENT_HEADER)
}

/// A message from this client.
#[derive(Debug, Clone, Copy)]
pub(super) enum Request<'a> {
    Upload {
        index: u16,
        sub: u8,
        complete: bool,
    },
    UploadSegment {
        toggle: bool,
    },
    /// One to four bytes.
    DownloadExpedited {
        index: u16,
        sub: u8,
        data: &'a [u8],
    },
    /// `size` is the size of the whole object, `data` its beginning.
    Download {
        index: u16,
        sub: u8,
        complete: bool,
        size: u32,
        data: &'a [u8],
    },
    DownloadSegment {
        toggle: bool,
        last: bool,
        data: &'a [u8],
    },
    Abort {
        index: u16,
        sub: u8,
        code: u32,
    },
    /// SDO Information; requests fit into one fragment.
    Information {
        opcode: u8,
        body: &'a [u8],
    },
}

impl Encode for Request<'_> {
    fn emit(&self, counter: u8, mailbox: u16, out: &mut Vec<u8>) {
        out.clear();
        out.extend_from_slice(&[0, 0, 0, 0, 0, TYPE_COE | counter << 4]);
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
                out.resize(MAILBOX_HEADER + COE_SDO_HEADER + 4, 0);
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
                let shortest = MAILBOX_HEADER + SEGMENT_HEADER + SEGMENT_MIN;
                out.resize(out.len().max(shortest), 0);
            }
            Self::Abort { index, sub, code } => {
                initiate(out, 0x80, false, index, sub);
                out.extend_from_slice(&code.to_le_bytes());
            }
            Self::Information { opcode, body } => {
                out.extend_from_slice(&[opcode, 0, 0, 0]);
                out.extend_from_slice(body);
            }
        }
        let length = u16::try_from(out.len() - MAILBOX_HEADER).unwrap_or(u16::MAX);
        for (to, from) in out.iter_mut().zip(length.to_le_bytes()) {
            *to = from;
        }
        out.resize(usize::from(mailbox), 0);
    }
}

/// Returns how many of `room` bytes are unused; 0 if `used` reaches or exceeds `room`.
fn unused(room: usize, used: usize) -> u8 {
    u8::try_from(room.saturating_sub(used)).unwrap_or(0)
}

/// A message from a SubDevice.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Message<'a> {
    Emergency(Emergency),
    Sdo(Answer<'a>),
    Information(Fragment<'a>),
    /// The SubDevice's mailbox rejected a message, with this code.
    Refused(u16),
    /// Any other message: another protocol or another CoE service.
    Other,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Answer<'a> {
    Abort {
        index: u16,
        sub: u8,
        code: u32,
    },
    /// `size` is the size of the whole object; segments follow if it exceeds `data`.
    Upload {
        index: u16,
        sub: u8,
        size: usize,
        data: &'a [u8],
    },
    UploadSegment {
        toggle: bool,
        last: bool,
        data: &'a [u8],
    },
    Download {
        index: u16,
        sub: u8,
    },
    DownloadSegment {
        toggle: bool,
    },
}

/// One message of an SDO Information answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Fragment<'a> {
    pub(super) opcode: u8,
    /// The number of fragments that follow.
    pub(super) left: u16,
    pub(super) data: &'a [u8],
}

/// How a message is inconsistent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(super) enum DecodeError {
    #[error("its length field says {length}, the mailbox holds {room}")]
    Oversized { length: usize, room: usize },
    #[error("{what} of {length} bytes is too short")]
    Short { what: &'static str, length: usize },
    #[error("FoE opcode {0} is none that a SubDevice sends")]
    Opcode(u8),
    #[error("SDO command {0:#04x} is none")]
    Command(u8),
}

/// Returns type and contents of one whole mailbox.
pub(super) fn open(mailbox: &[u8]) -> Result<(u8, &[u8]), DecodeError> {
    let [len_low, len_high, _, _, _, kind, body @ ..] = mailbox else {
        return Err(DecodeError::Short {
            what: "a mailbox",
            length: mailbox.len(),
        });
    };
    let length = usize::from(u16::from_le_bytes([*len_low, *len_high]));
    let Some(body) = body.get(..length) else {
        return Err(DecodeError::Oversized {
            length,
            room: body.len(),
        });
    };
    Ok((kind & 0x0f, body))
}

/// Parses one whole mailbox.
pub(super) fn parse(mailbox: &[u8]) -> Result<Message<'_>, DecodeError> {
    match open(mailbox)? {
        (TYPE_COE, body) => parse_coe(body),
        (TYPE_ERROR, body) => refused(body).map(Message::Refused),
        _ => Ok(Message::Other),
    }
}

/// Returns the code of a mailbox error (ETG.1000.4 Table 30).
pub(super) fn refused(body: &[u8]) -> Result<u16, DecodeError> {
    match body {
        [_, _, low, high, ..] => Ok(u16::from_le_bytes([*low, *high])),
        _ => Err(DecodeError::Short {
            what: "a mailbox error",
            length: body.len(),
        }),
    }
}

fn parse_coe(body: &[u8]) -> Result<Message<'_>, DecodeError> {
    let [low, high, content @ ..] = body else {
        return Err(DecodeError::Short {
            what: "a CoE message",
            length: body.len(),
        });
    };
    match u16::from_le_bytes([*low, *high]) >> 12 {
        SERVICE_EMERGENCY => {
            Emergency::parse(content)
                .map(Message::Emergency)
                .ok_or(DecodeError::Short {
                    what: "an emergency",
                    length: body.len(),
                })
        }
        SERVICE_SDO_RESPONSE => parse_sdo(content).map(Message::Sdo),
        // Devices send an abort with either service.
        SERVICE_SDO_REQUEST if content.first() == Some(&0x80) => {
            parse_sdo(content).map(Message::Sdo)
        }
        SERVICE_SDO_INFORMATION => match content {
            [opcode, _, low, high, data @ ..] => Ok(Message::Information(Fragment {
                // The highest bit repeats that fragments follow.
                opcode: opcode & 0x7f,
                left: u16::from_le_bytes([*low, *high]),
                data,
            })),
            _ => Err(DecodeError::Short {
                what: "an SDO Information answer",
                length: content.len(),
            }),
        },
        _ => Ok(Message::Other),
    }
}

fn parse_sdo(content: &[u8]) -> Result<Answer<'_>, DecodeError> {
    let short = DecodeError::Short {
        what: "an SDO answer",
        length: content.len(),
    };
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
            let [low, high, sub, rest @ ..] = rest else {
                return Err(short);
            };
            let (index, sub) = (u16::from_le_bytes([*low, *high]), *sub);
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
            let expedited = command & 0x02 != 0;
            let size_told = command & 0x01 != 0;
            if expedited {
                let size = if size_told {
                    4 - usize::from(command >> 2 & 3)
                } else {
                    4
                };
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
