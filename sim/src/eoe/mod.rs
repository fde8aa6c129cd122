//! Ethernet over EtherCAT (ETG.1000.6 §5.7): a device with an IP host behind its mailbox.
//!
//! * `message`: fragments and IP parameters as bytes
//! * `host`: ARP, ICMP echo, TCP, and the web page of the device
//!
//! The host answers once the MainDevice has set an IP address. Each fragment leaves when the
//! mailbox is empty, so that answers of other protocols pass in between.

mod host;
mod message;

use std::collections::VecDeque;

use crate::device::mailbox::{Answer, Detail, MailboxCapacity};
use host::Host;
use message::{Assembly, Header, Parameters};

/// Maximum number of frames that wait for the MainDevice; the host drops further ones, as a network
/// interface with a full queue does.
const FRAMES: usize = 16;
/// The period in ns of frames without a request, if a fault sends them.
const FLOOD_NS: u64 = 1_000_000;
/// Results of requests.
const RESULT_OK: u16 = 0;
const RESULT_UNSUPPORTED_TYPE: u16 = 2;
const RESULT_NO_FILTER: u16 = 0x0401;

/// Faults of the Ethernet traffic of a device.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct EoeFaults {
    /// The device sends broadcasts without end.
    pub(crate) flood: bool,
    /// The fragments of the device are lost, repeated, out of order or contradictory.
    pub(crate) fragments: bool,
}

/// EoE of a device.
#[derive(Debug, Clone)]
pub(crate) struct EoeServer {
    serial: u32,
    parameters: Parameters,
    host: Host,
    assembly: Assembly,
    /// Frames to the MainDevice, and the offset in the first one.
    frames: VecDeque<Vec<u8>>,
    offset: usize,
    fragment: u16,
    frame_number: u16,
    pub(crate) faults: EoeFaults,
    /// The number of fragments sent.
    sent: u64,
    /// The local time of the next work of the host.
    due: u64,
}

impl EoeServer {
    pub(crate) fn new(serial: u32) -> Self {
        Self {
            serial,
            parameters: Parameters::default(),
            host: Host::new(serial),
            assembly: Assembly::default(),
            frames: VecDeque::new(),
            offset: 0,
            fragment: 0,
            frame_number: 0,
            faults: EoeFaults::default(),
            sent: 0,
            due: u64::MAX,
        }
    }

    /// Returns the server after a restart of the device.
    pub(crate) fn restarted(&self) -> Self {
        Self {
            faults: self.faults,
            ..Self::new(self.serial)
        }
    }

    /// Returns the local time of the next work.
    pub(crate) fn due(&self) -> u64 {
        self.due
    }

    /// Changes the faults.
    pub(crate) fn disturb(&mut self, faults: EoeFaults, local: u64) {
        if faults.flood && !self.faults.flood {
            self.due = local;
        }
        self.faults = faults;
    }

    /// Processes a message of the MainDevice.
    pub(crate) fn request(&mut self, body: &[u8], room: MailboxCapacity, local: u64) -> Answer {
        let Some((header, data)) = Header::parse(body) else {
            return Answer::Error(Detail::TooShort);
        };
        let reply = |kind: u8, result: u16, data: &[u8]| {
            let mut reply = header.reply(kind, result);
            reply.extend_from_slice(data);
            match reply.len() <= room.send {
                true => Answer::One(reply),
                false => Answer::Error(Detail::InvalidSize),
            }
        };
        match header.kind {
            message::FRAGMENT => {
                if let Some(frame) = self.assembly.add(&header, data) {
                    self.host.receive(frame);
                    self.due = local;
                }
                Answer::None
            }
            message::SET_IP => match Parameters::parse(data) {
                Some(new) => {
                    self.parameters.update(&new);
                    self.host.configure(&self.parameters, local);
                    reply(message::SET_IP_RESPONSE, RESULT_OK, &[])
                }
                None => Answer::Error(Detail::TooShort),
            },
            message::GET_IP => {
                let parameters = self.parameters.to_bytes();
                reply(message::GET_IP_RESPONSE, RESULT_OK, &parameters)
            }
            message::SET_FILTER => reply(message::SET_FILTER_RESPONSE, RESULT_NO_FILTER, &[]),
            message::GET_FILTER => reply(message::GET_FILTER_RESPONSE, RESULT_NO_FILTER, &[]),
            kind => reply(kind.wrapping_add(1) & 0x0f, RESULT_UNSUPPORTED_TYPE, &[]),
        }
    }

    /// Lets the host work. `page` returns the web page of the device.
    pub(crate) fn work(&mut self, local: u64, page: &dyn Fn() -> String) {
        self.due = self.host.work(local, page);
        while let Some(frame) = self.host.take_frame() {
            if self.frames.len() < FRAMES {
                self.frames.push_back(frame);
            }
        }
        if self.faults.flood {
            if self.frames.is_empty() {
                self.frames.push_back(host::broadcast(self.serial));
            }
            self.due = self.due.min(local.saturating_add(FLOOD_NS));
        }
    }

    /// Returns the next fragment for a mailbox with this capacity.
    pub(crate) fn next_fragment(&mut self, room: MailboxCapacity) -> Option<Vec<u8>> {
        let frame = self.frames.front()?;
        let rest = frame.get(self.offset..)?;
        let capacity = room.send.saturating_sub(message::HEADER);
        let last = rest.len() <= capacity;
        let length = match last {
            true => rest.len(),
            false => capacity / message::UNIT * message::UNIT,
        };
        if length == 0 {
            self.frames.clear();
            self.offset = 0;
            return None;
        }
        if self.fragment == 0 {
            self.frame_number = (self.frame_number + 1) % 16;
        }
        let bytes = match self.fragment {
            0 => frame.len(),
            _ => self.offset,
        };
        let mut header = Header {
            kind: message::FRAGMENT,
            port: 0,
            last,
            time_appended: false,
            fragment: self.fragment,
            units: u16::try_from(bytes.div_ceil(message::UNIT)).unwrap_or(0),
            frame: self.frame_number,
        };
        let mut data = rest.get(..length).unwrap_or_default().to_vec();
        self.sent += 1;
        let mut skips = true;
        if self.faults.fragments {
            // Every seventh fragment is right, so that some frames arrive.
            match self.sent % 7 {
                0 => header.units = header.units.wrapping_add(1) & 0x3f,
                1 => header.fragment = (header.fragment + 1) & 0x3f,
                2 => skips = false,
                3 => header.frame = (header.frame + 5) % 16,
                4 => header.units = 0x3f,
                5 => data.truncate(1),
                _ => {}
            }
        }
        if skips {
            self.offset += length;
            self.fragment += 1;
            if last {
                self.frames.pop_front();
                (self.offset, self.fragment) = (0, 0);
            }
        }
        let mut body = header.to_bytes().to_vec();
        body.extend_from_slice(&data);
        Some(body)
    }
}
