//! Ethernet over EtherCAT (ETG.1000.6 §5.7): a device with an IP host behind its mailbox.
//!
//! * `message`: fragments, IP parameters and MAC filters as bytes
//! * `host`: ARP, ICMP echo, TCP, and the web page of the device
//!
//! The host answers once the MainDevice has set an IP address. Each fragment leaves when the
//! mailbox is empty, so that answers of other protocols pass in between.

mod host;
mod message;

use std::collections::VecDeque;

use crate::device::mailbox::{Answer, Detail, MailboxCapacity};
use host::Host;
use message::{Assembly, Filter, Header, Parameters};

/// Maximum number of frames that wait for the MainDevice; the host drops further ones, as a network
/// interface with a full queue does.
const FRAMES: usize = 16;
/// The period in ns of frames without a request, if a fault sends them.
const FLOOD_NS: u64 = 1_000_000;
/// Results of requests.
const RESULT_OK: u16 = 0;
const RESULT_UNSUPPORTED_TYPE: u16 = 2;

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
    /// The device has time stamps.
    time_stamps: bool,
    parameters: Parameters,
    filter: Option<Filter>,
    host: Host,
    assembly: Assembly,
    /// Frames to the MainDevice with the system time of their arrival, and the offset in the first
    /// one.
    frames: VecDeque<(u64, Vec<u8>)>,
    /// Times that the MainDevice has requested.
    times: VecDeque<Vec<u8>>,
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
    pub(crate) fn new(serial: u32, time_stamps: bool) -> Self {
        Self {
            serial,
            time_stamps,
            parameters: Parameters::default(),
            filter: None,
            host: Host::new(serial),
            assembly: Assembly::default(),
            frames: VecDeque::new(),
            times: VecDeque::new(),
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
            ..Self::new(self.serial, self.time_stamps)
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

    /// Returns true if the host receives a frame: those for its own address always.
    fn passes(&self, frame: &[u8]) -> bool {
        let to = frame.get(..6).unwrap_or_default();
        let own = self.parameters.mac.is_some_and(|mac| mac == *to);
        own || self.filter.as_ref().is_none_or(|filter| filter.passes(to))
    }

    /// Processes a message of the MainDevice. `local` is the local time, `system` the system time.
    pub(crate) fn request(
        &mut self,
        body: &[u8],
        room: MailboxCapacity,
        local: u64,
        system: u64,
    ) -> Answer {
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
                    if self.time_stamps && header.time_requested && self.times.len() < FRAMES {
                        self.times.push_back(time_stamp(&header, system));
                    }
                    if self.passes(&frame) {
                        self.host.receive(frame);
                    }
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
            message::SET_FILTER => match Filter::parse(data) {
                Some(filter) => {
                    self.filter = Some(filter);
                    reply(message::SET_FILTER_RESPONSE, RESULT_OK, &[])
                }
                None => Answer::Error(Detail::TooShort),
            },
            message::GET_FILTER => {
                let filter = self.filter.as_ref().map_or(&[][..], Filter::to_bytes);
                reply(message::GET_FILTER_RESPONSE, RESULT_OK, filter)
            }
            kind => reply(kind.wrapping_add(1) & 0x0f, RESULT_UNSUPPORTED_TYPE, &[]),
        }
    }

    /// Lets the host work. `page` returns the web page of the device.
    pub(crate) fn work(&mut self, local: u64, system: u64, page: &dyn Fn() -> String) {
        self.due = self.host.work(local, page);
        while let Some(frame) = self.host.take_frame() {
            if self.frames.len() < FRAMES {
                self.frames.push_back((system, frame));
            }
        }
        if self.faults.flood {
            if self.frames.is_empty() {
                self.frames
                    .push_back((system, host::broadcast(self.serial)));
            }
            self.due = self.due.min(local.saturating_add(FLOOD_NS));
        }
    }

    /// Returns the next message for a mailbox with this capacity: a time stamp or a fragment. The
    /// last fragment has the time at which the host has sent the frame.
    pub(crate) fn next_message(&mut self, room: MailboxCapacity) -> Option<Vec<u8>> {
        if let Some(time) = self.times.pop_front() {
            return Some(time);
        }
        let (arrived, frame) = self.frames.front()?;
        let rest = frame.get(self.offset..)?;
        let stamp = match self.time_stamps {
            true => arrived.to_le_bytes().first_chunk::<4>().copied(),
            false => None,
        };
        let reserved = message::HEADER + stamp.map_or(0, |stamp| stamp.len());
        let capacity = room.send.saturating_sub(reserved);
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
            time_appended: last && stamp.is_some(),
            time_requested: false,
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
        body.extend(stamp.filter(|_| header.time_appended).iter().flatten());
        Some(body)
    }
}

/// Returns the time stamp of a frame that has left the port.
fn time_stamp(of: &Header, system: u64) -> Vec<u8> {
    let header = Header {
        kind: message::TIME_STAMP,
        last: true,
        fragment: 0,
        units: 0,
        time_requested: false,
        ..*of
    };
    let mut body = header.to_bytes().to_vec();
    body.extend(
        system
            .to_le_bytes()
            .first_chunk::<4>()
            .iter()
            .copied()
            .flatten(),
    );
    body
}
