//! The FoE transfer: packets count from 1, and each is acknowledged. The first packet shorter than
//! the mailbox ends the transfer; it may be empty.

use super::{FileStore, FoeError, FoeOptions};
use crate::Nanos;
use crate::device::mailbox::{Answer, Detail, MailboxCapacity};
use crate::firmware::Flash;

/// Bytes of opcode, a reserved byte, and password, packet number, error code or progress.
const HEADER: usize = 6;

mod opcode {
    pub(super) const READ: u8 = 1;
    pub(super) const WRITE: u8 = 2;
    pub(super) const DATA: u8 = 3;
    pub(super) const ACK: u8 = 4;
    pub(super) const ERROR: u8 = 5;
    pub(super) const BUSY: u8 = 6;
}

#[derive(Debug, Clone)]
enum Transfer {
    Read {
        data: Vec<u8>,
        /// The start of the packet that waits for its acknowledgement.
        at: usize,
        packet: u32,
    },
    Write {
        name: String,
        data: Vec<u8>,
        /// The number of the next packet.
        packet: u32,
        /// The local time of the first BUSY answer to the packet.
        busy_since: Option<Nanos>,
    },
}

#[derive(Debug, Clone, Default)]
pub(crate) struct FoeServer {
    transfer: Option<Transfer>,
}

/// A request and its context.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FoeRequest<'a> {
    pub(crate) options: &'a FoeOptions,
    pub(crate) bootstrap: bool,
    /// The local time of the device.
    pub(crate) now: Nanos,
    /// The message without the mailbox header.
    pub(crate) message: &'a [u8],
    pub(crate) room: MailboxCapacity,
}

/// The source or destination of files.
#[derive(Debug)]
pub(crate) enum Target<'a> {
    Files(&'a mut FileStore),
    /// The program memory. Files of any name are firmware.
    Program(&'a mut Flash),
}

impl Target<'_> {
    fn get(&self, name: &str) -> Option<&[u8]> {
        match self {
            Self::Files(files) => files.get(name),
            Self::Program(flash) => flash.file(),
        }
    }

    fn has_room(&self, name: &str, len: usize, options: &FoeOptions) -> bool {
        match self {
            Self::Files(files) => files.has_room(name, len, options.capacity),
            Self::Program(flash) => len <= flash.capacity(),
        }
    }

    fn put(&mut self, name: String, data: Vec<u8>) -> Result<(), FoeError> {
        match self {
            Self::Files(files) => {
                files.write(name, data);
                Ok(())
            }
            Self::Program(flash) => flash.finish(data),
        }
    }
}

type Reply = Result<Option<Vec<u8>>, FoeError>;

impl FoeServer {
    pub(crate) fn request(&mut self, mut target: Target<'_>, request: FoeRequest<'_>) -> Answer {
        let Some((&[opcode, _, a, b, c, d], rest)) = request.message.split_first_chunk() else {
            return Answer::Error(Detail::TooShort);
        };
        if request.room.send <= HEADER || request.room.receive <= HEADER {
            return Answer::Error(Detail::NoMoreMemory);
        }
        let number = u32::from_le_bytes([a, b, c, d]);
        let reply = match (opcode, self.transfer.take()) {
            (opcode::READ, None) => self.read(&target, request, number, rest),
            (opcode::WRITE, None) => self.write(&mut target, request, number, rest),
            (opcode::DATA, Some(transfer @ Transfer::Write { .. })) => {
                self.data(&mut target, request, transfer, number, rest)
            }
            (opcode::ACK, Some(transfer @ Transfer::Read { .. })) => {
                self.acknowledged(transfer, number, request.room)
            }
            (opcode::BUSY, Some(transfer @ Transfer::Read { .. })) => {
                self.send(transfer, request.room)
            }
            // The client cancels; there is no answer.
            (opcode::ERROR, _) => Ok(None),
            // This includes a new request during a transfer; the transfer ends.
            _ => Err(FoeError::Illegal),
        };
        match reply {
            Ok(None) => Answer::None,
            Ok(Some(message)) => Answer::One(message),
            Err(error) => {
                let mut out = message(opcode::ERROR, error as u32);
                out.extend_from_slice(error.text().as_bytes());
                out.truncate(request.room.send);
                Answer::One(out)
            }
        }
    }

    fn read(
        &mut self,
        files: &Target<'_>,
        request: FoeRequest<'_>,
        password: u32,
        name: &[u8],
    ) -> Reply {
        let name = allowed(request, password, name)?;
        let data = files.get(&name).ok_or(FoeError::NotFound)?.to_vec();
        let first = Transfer::Read {
            data,
            at: 0,
            packet: 1,
        };
        self.send(first, request.room)
    }

    /// Sends the current packet, for the first time or again.
    fn send(&mut self, transfer: Transfer, room: MailboxCapacity) -> Reply {
        let Transfer::Read { data, at, packet } = &transfer else {
            return Err(FoeError::Illegal);
        };
        let mut out = message(opcode::DATA, *packet);
        let rest = data.get(*at..).unwrap_or_default();
        let len = rest.len().min(room.send - HEADER);
        out.extend_from_slice(rest.get(..len).unwrap_or_default());
        self.transfer = Some(transfer);
        Ok(Some(out))
    }

    fn acknowledged(
        &mut self,
        mut transfer: Transfer,
        number: u32,
        room: MailboxCapacity,
    ) -> Reply {
        let Transfer::Read { data, at, packet } = &mut transfer else {
            return Err(FoeError::Illegal);
        };
        if number != *packet {
            return Err(FoeError::PacketNumber);
        }
        let full = room.send - HEADER;
        if data.len().saturating_sub(*at) < full {
            return Ok(None);
        }
        *at += full;
        *packet = packet.wrapping_add(1);
        self.send(transfer, room)
    }

    fn write(
        &mut self,
        files: &mut Target<'_>,
        request: FoeRequest<'_>,
        password: u32,
        name: &[u8],
    ) -> Reply {
        let name = allowed(request, password, name)?;
        if name.is_empty() {
            return Err(FoeError::Illegal);
        }
        if request.options.read_only.contains(&name) {
            return Err(FoeError::AccessDenied);
        }
        if !files.has_room(&name, 0, request.options) {
            return Err(FoeError::DiskFull);
        }
        if let Target::Program(flash) = files {
            flash.begin();
        }
        self.transfer = Some(Transfer::Write {
            name,
            data: Vec::new(),
            packet: 1,
            busy_since: None,
        });
        Ok(Some(message(opcode::ACK, 0)))
    }

    fn data(
        &mut self,
        files: &mut Target<'_>,
        request: FoeRequest<'_>,
        transfer: Transfer,
        number: u32,
        bytes: &[u8],
    ) -> Reply {
        let Transfer::Write {
            name,
            mut data,
            packet,
            busy_since,
        } = transfer
        else {
            return Err(FoeError::Illegal);
        };
        if number != packet {
            return Err(FoeError::PacketNumber);
        }
        let (options, now) = (request.options, request.now);
        if options.is_full || !files.has_room(&name, data.len() + bytes.len(), options) {
            return Err(FoeError::DiskFull);
        }
        let is_last = bytes.len() < request.room.receive - HEADER;
        let every = options.busy_every;
        let is_selected = every > 0 && packet.is_multiple_of(every) && busy_since.is_none();
        let busy_since = busy_since.unwrap_or(now);
        let is_erasing = packet == 1 && now - busy_since < options.busy_ns;
        let busy = match files {
            // The reported progress is 50 of 100.
            _ if is_selected || is_erasing => Some((50, 100)),
            Target::Files(_) => None,
            Target::Program(flash) => flash.take(&data, bytes, is_last, now)?,
        };
        if let Some((done, entire)) = busy {
            self.transfer = Some(Transfer::Write {
                name,
                data,
                packet,
                busy_since: Some(busy_since),
            });
            let progress = u32::from(entire) << 16 | u32::from(done);
            return Ok(Some(message(opcode::BUSY, progress)));
        }
        data.extend_from_slice(bytes);
        if is_last {
            files.put(name, data)?;
        } else {
            self.transfer = Some(Transfer::Write {
                name,
                data,
                packet: packet.wrapping_add(1),
                busy_since: None,
            });
        }
        Ok(Some(message(opcode::ACK, packet)))
    }
}

/// Returns the file name if the request may access the file. A trailing zero byte is removed;
/// invalid UTF-8 is replaced.
fn allowed(request: FoeRequest<'_>, password: u32, name: &[u8]) -> Result<String, FoeError> {
    let options = request.options;
    if options.is_illegal {
        return Err(FoeError::Illegal);
    }
    if options.password != 0 && password != options.password {
        return Err(FoeError::NoRights);
    }
    let name = name.split(|b| *b == 0).next().unwrap_or_default();
    let name = String::from_utf8_lossy(name).into_owned();
    if !request.bootstrap && options.bootstrap_only.contains(&name) {
        return Err(FoeError::BootstrapOnly);
    }
    Ok(name)
}

fn message(opcode: u8, number: u32) -> Vec<u8> {
    let mut out = vec![opcode, 0];
    out.extend_from_slice(&number.to_le_bytes());
    out
}
