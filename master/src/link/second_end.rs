//! Finds the second interface of a ring of SubDevices of which only one interface is named.
//!
//! In a ring, the frames of one interface arrive at the other one. Without `redundant`, no
//! program receives them, and the bus looks silent.

use std::fmt;
use std::time::{Duration, Instant};

use ecaxis_ecat::datagram::{Command, HEADER, Header, WORKING_COUNTER};
use ecaxis_ecat::registers::AL_STATUS;

use super::interface::{self, ETHERTYPE};
use super::joined_frame::FRAME_HEADER;
use super::{MAX_FRAME, source_address};
use crate::sys::packet::PacketSocket;
use crate::text::pluralize;

/// The frames that are sent, and the listening time after each of them.
const ATTEMPTS: u8 = 3;
const LISTEN: Duration = Duration::from_millis(20);
/// The offset of the EtherType, and the length of the shortest frame without FCS.
const ETHERTYPE_AT: usize = 12;
const MIN_FRAME: usize = 60;

/// The interface at which the frames of another one arrive.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SecondEnd {
    /// The interface that sent the frames.
    pub nic: String,
    /// The interface at which they arrived; nothing was sent on it.
    pub second: String,
    /// The SubDevices that processed a frame; 0 if it crossed the ring against its direction, or if
    /// the ring has no SubDevices.
    pub processed_by: u16,
}

impl fmt::Display for SecondEnd {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { nic, second, .. } = self;
        write!(f, "the frames of `{nic}` arrive at `{second}`, ")?;
        match self.processed_by {
            0 => f.write_str("and no SubDevice has processed them"),
            count => {
                let devices = pluralize(usize::from(count), "SubDevice");
                write!(f, "processed by {devices}")
            }
        }
    }
}

/// Sends broadcast reads on `nic` and listens on all other interfaces with a link. Returns the one
/// at which they arrive. Returns `None` also where raw sockets are not permitted. Blocks.
#[must_use]
pub fn find_second_end(nic: &str) -> Option<SecondEnd> {
    let sender = bound_socket(nic)?;
    let peer = interface::peer_index(nic);
    let others = interface::interfaces().into_iter();
    let others = others.filter(|other| {
        // The other end of a virtual cable receives every frame, also without a ring.
        other != nic && interface::check(other).is_ok_and(|index| Some(index) != peer)
    });
    let listeners = others.filter_map(|other| Some((bound_socket(&other)?, other)));
    let listeners: Vec<_> = listeners.collect();
    if listeners.is_empty() {
        return None;
    }
    let mut best: Option<SecondEnd> = None;
    for attempt in 0..ATTEMPTS {
        let frame = probe_frame(attempt);
        sender.send(&frame).ok()?;
        let end = Instant::now() + LISTEN;
        while Instant::now() < end {
            for (socket, second) in &listeners {
                let Some(processed_by) = received_probe(socket, &frame) else {
                    continue;
                };
                if best
                    .as_ref()
                    .is_none_or(|best| best.processed_by < processed_by)
                {
                    best = Some(SecondEnd {
                        nic: nic.to_owned(),
                        second: second.clone(),
                        processed_by,
                    });
                }
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        if best.is_some() {
            break;
        }
    }
    best
}

fn bound_socket(nic: &str) -> Option<PacketSocket> {
    let index = interface::index(nic).ok()?;
    let socket = interface::socket(nic).ok()?;
    interface::bind(nic, &socket, index).ok()?;
    Some(socket)
}

/// Returns a frame with one broadcast read of the AL status.
fn probe_frame(index: u8) -> [u8; MIN_FRAME] {
    let header = Header {
        command: Command::BRD,
        index,
        address: u32::from(AL_STATUS) << 16,
        len: 2,
        more: false,
    };
    let mut frame = [0; MIN_FRAME];
    frame[..6].fill(0xff);
    frame[6..12].copy_from_slice(&source_address::acyclic_address(std::process::id()));
    frame[ETHERTYPE_AT..ETHERTYPE_AT + 2].copy_from_slice(&ETHERTYPE.to_be_bytes());
    let datagram = HEADER + usize::from(header.len) + WORKING_COUNTER;
    // The type 1 of the EtherCAT header: datagrams.
    let length = 0x1000 | datagram as u16;
    frame[ETHERTYPE_AT + 2..FRAME_HEADER].copy_from_slice(&length.to_le_bytes());
    frame[FRAME_HEADER..FRAME_HEADER + HEADER].copy_from_slice(&header.emit());
    frame
}

/// Returns the working counter of the probe frame, if the socket has received it.
fn received_probe(socket: &PacketSocket, sent: &[u8; MIN_FRAME]) -> Option<u16> {
    let mut buf = [0; MAX_FRAME];
    while let Ok(Some(received)) = socket.receive(&mut buf) {
        if received.packet_type == libc::PACKET_OUTGOING {
            continue;
        }
        if let Some(count) = buf
            .get(..received.len)
            .and_then(|frame| working_counter(frame, sent))
        {
            return Some(count);
        }
    }
    None
}

/// Returns the working counter of a frame if it is the sent one. SubDevices change the first byte
/// of the source address and increment the position.
fn working_counter(frame: &[u8], sent: &[u8; MIN_FRAME]) -> Option<u16> {
    const COUNTER: usize = FRAME_HEADER + HEADER + 2;
    let is_same = |range: std::ops::Range<usize>| frame.get(range.clone()) == sent.get(range);
    // Command and index; then the register, without the position.
    let is_ours = is_same(7..FRAME_HEADER + 2) && is_same(FRAME_HEADER + 4..FRAME_HEADER + 6);
    let counter = frame.get(COUNTER..COUNTER + WORKING_COUNTER)?;
    is_ours.then(|| u16::from_le_bytes([counter[0], counter[1]]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn working_counter_is_that_of_the_sent_frame() {
        let sent = probe_frame(1);
        assert_eq!(working_counter(&sent, &sent), Some(0));
        let mut processed = sent;
        processed[6] |= 0x02;
        processed[18] = 3; // The position.
        processed[26] = 0x02; // The AL status.
        processed[28] = 3;
        assert_eq!(working_counter(&processed, &sent), Some(3));
        assert_eq!(working_counter(&probe_frame(2), &sent), None);
        let mut other = processed;
        other[10] = !other[10];
        assert_eq!(working_counter(&other, &sent), None);
        assert_eq!(working_counter(&processed[..20], &sent), None);
    }

    #[test]
    fn unknown_interface_has_no_second_end() {
        assert_eq!(find_second_end("no-such-nic"), None);
    }
}
