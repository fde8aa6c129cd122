//! The ports of the switch. Each has two bounded queues: if one is full, its oldest frame makes room.
//! Frames for an address behind the port precede floods, so that a device that broadcasts without end
//! does not delay the others.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ecaxis_ecat::mailbox::eoe::{Message, Reassembler, Service};
use ecaxis_ecat::mailbox::{ERROR_UNSUPPORTED_PROTOCOL, TYPE_EOE};
use serde::Serialize;

use super::switch::{Destination, PortNumber, Switch};
use crate::clock::Nanos;

/// The capacity of each queue of a port in frames.
pub const FRAMES_PER_PORT: usize = 32;
/// A frame whose next fragment has not come for this time in ns is incomplete.
const FRAGMENT_TIMEOUT: Nanos = 20_000_000;
/// The difference between two readings of the time of the bus in ns.
const MAX_INACCURACY: i32 = 1_000_000;

/// The frames of a port. `from` and `to` are as seen from the switch.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct EthernetCounters {
    /// The name of the device or of the interface.
    pub name: String,
    /// Frames that have arrived from the port.
    pub from_port: u64,
    /// Frames that have left to the port.
    pub to_port: u64,
    /// Frames dropped because the queue was full; the oldest ones.
    pub overflows: u64,
    /// Frames dropped because the device or interface did not take them.
    pub not_taken: u64,
    /// Mailbox errors of the device for fragments.
    pub refused: u64,
    /// A mailbox error said that the device has no EoE. It gets no frames until it restarts.
    pub unsupported: bool,
    /// Frames from the port with a wrong length or sender.
    pub invalid: u64,
    /// Frames from the port that were dropped because fragments were missing or contradictory.
    pub incomplete: u64,
    /// Fragments from the port that came again.
    pub repeated: u64,
    /// From the port of the device to the switch, by its time stamps.
    pub from_delay: FrameDelay,
    /// From the queue of the switch to the port of the device, by its time stamps.
    pub to_delay: FrameDelay,
}

/// The delay of frames with time stamps.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct FrameDelay {
    /// The number of frames.
    pub frames: u64,
    /// The sum of their delays in ns.
    pub total_ns: u64,
    /// The longest delay in ns.
    pub max_ns: u64,
}

impl FrameDelay {
    /// Adds a frame. The instants are the lower halves of system times.
    fn add(&mut self, from: u32, to: u32) {
        let delay = to.wrapping_sub(from).cast_signed();
        // Not that of this frame, or not the time of the bus.
        if delay < -MAX_INACCURACY {
            return;
        }
        let delay = u64::try_from(delay).unwrap_or(0);
        self.frames += 1;
        self.total_ns = self.total_ns.saturating_add(delay);
        self.max_ns = self.max_ns.max(delay);
    }

    /// Returns the mean delay in ns; `None` without frames.
    #[must_use]
    pub fn mean_ns(&self) -> Option<u64> {
        self.total_ns.checked_div(self.frames)
    }
}

#[derive(Debug, Default)]
struct Port {
    /// The frames for an address behind the port, then those for all ports.
    queues: [VecDeque<Vec<u8>>; 2],
    reassembler: Reassembler,
    /// The time of the last fragment while further ones are due.
    assembling: Option<Nanos>,
    /// The device sends time stamps.
    time_stamps: bool,
    /// When the switch gave frames, by their numbers, whose time stamps have not come.
    given: [Option<u32>; 16],
    counters: EthernetCounters,
}

impl Port {
    fn next_frame(&mut self) -> Option<Vec<u8>> {
        self.queues.iter_mut().find_map(VecDeque::pop_front)
    }

    fn waiting(&self) -> usize {
        self.queues.iter().map(VecDeque::len).sum()
    }

    fn count(&mut self, taken: bool) {
        match taken {
            true => self.counters.to_port += 1,
            false => self.counters.not_taken += 1,
        }
    }

    /// Drops the frames that wait, and counts them.
    fn clear(&mut self) {
        self.counters.not_taken += self.waiting() as u64;
        self.queues.iter_mut().for_each(VecDeque::clear);
    }

    fn enqueue(&mut self, flooded: bool, frame: &[u8]) {
        if self.counters.unsupported {
            self.counters.not_taken += 1;
            return;
        }
        let [own, floods] = &mut self.queues;
        let queue = if flooded { floods } else { own };
        if queue.len() >= FRAMES_PER_PORT {
            queue.pop_front();
            self.counters.overflows += 1;
        }
        queue.push_back(frame.to_vec());
    }
}

#[derive(Debug, Default)]
struct Network {
    switch: Switch,
    ports: Vec<Port>,
    /// System time of the bus minus session clock; `None` while it is unknown.
    system_offset: Option<u64>,
}

impl Network {
    /// Returns the lower half of the system time of the bus.
    fn system_time(&self, now: Nanos) -> Option<u32> {
        let time = now.wrapping_add(self.system_offset?);
        time.to_le_bytes()
            .first_chunk()
            .copied()
            .map(u32::from_le_bytes)
    }

    fn forward(&mut self, now: Nanos, from: PortNumber, frame: &[u8]) {
        let Some(port) = self.ports.get_mut(from.0) else {
            return;
        };
        port.counters.from_port += 1;
        match self.switch.forward(now, from, frame) {
            Ok(Destination::Nowhere) => {}
            Ok(Destination::Port(to)) => {
                if let Some(to) = self.ports.get_mut(to.0) {
                    to.enqueue(false, frame);
                }
            }
            Ok(Destination::Others) => {
                let ports = (0..).map(PortNumber).zip(&mut self.ports);
                for (_, to) in ports.filter(|(number, _)| *number != from) {
                    to.enqueue(true, frame);
                }
            }
            Err(_) => port.counters.invalid += 1,
        }
    }
}

/// The right to send one datagram of EoE; its end is that of the datagram.
pub type Turn = tokio::sync::OwnedMutexGuard<()>;

/// The virtual switch with its ports. Clones share it.
#[derive(Debug, Clone, Default)]
pub struct EoeNetwork {
    network: Arc<Mutex<Network>>,
    turn: Arc<tokio::sync::Mutex<()>>,
}

impl EoeNetwork {
    fn lock(&self) -> MutexGuard<'_, Network> {
        self.network.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn add_port(&self, name: &str) -> PortNumber {
        let mut network = self.lock();
        let number = PortNumber(network.ports.len());
        let mut port = Port::default();
        name.clone_into(&mut port.counters.name);
        network.ports.push(port);
        number
    }

    /// Adds a port for the mailbox of a device. `time_stamps`: the device is asked for the times of
    /// its frames.
    #[must_use]
    pub fn add_device(&self, name: &str, time_stamps: bool) -> EoePort {
        let number = self.add_port(name);
        self.with_port(number, |port| port.time_stamps = time_stamps);
        EoePort {
            network: self.clone(),
            number,
        }
    }

    /// Sets the system time of the bus minus the session clock, in ns.
    pub fn set_system_offset(&self, offset: Option<u64>) {
        self.lock().system_offset = offset;
    }

    /// Adds a port for an interface.
    #[must_use]
    pub fn add_host(&self, name: &str) -> HostPort {
        HostPort {
            network: self.clone(),
            number: self.add_port(name),
        }
    }

    /// Returns the counters of all ports.
    #[must_use]
    pub fn counters(&self) -> Vec<EthernetCounters> {
        let network = self.lock();
        let each = network.ports.iter().map(|port| {
            let seen = port.reassembler.counters();
            EthernetCounters {
                incomplete: seen.dropped(),
                repeated: seen.repeats,
                ..port.counters.clone()
            }
        });
        each.collect()
    }

    fn with_port<T: Default>(&self, number: PortNumber, work: impl FnOnce(&mut Port) -> T) -> T {
        self.lock()
            .ports
            .get_mut(number.0)
            .map(work)
            .unwrap_or_default()
    }
}

/// The switch's port of one device: frames in fragments.
#[derive(Debug, Clone)]
pub struct EoePort {
    network: EoeNetwork,
    number: PortNumber,
}

impl EoePort {
    /// Takes a message from the device's mailbox. Returns false if it is not EoE.
    pub fn receive(&self, now: Nanos, mailbox: &[u8]) -> bool {
        // The protocol is the lower half of the sixth byte, even if the rest makes no sense.
        if mailbox.get(5).is_none_or(|kind| kind & 0x0f != TYPE_EOE) {
            return false;
        }
        let mut network = self.network.lock();
        let time = network.system_time(now);
        let Some(port) = network.ports.get_mut(self.number.0) else {
            return true;
        };
        let Ok(message) = Message::parse(mailbox) else {
            port.counters.invalid += 1;
            return true;
        };
        let fragment = match message.service {
            Service::Fragment(fragment) => fragment,
            Service::TimeStamp { frame, time } => {
                let given = port
                    .given
                    .get_mut(usize::from(frame))
                    .and_then(Option::take);
                if let Some(given) = given {
                    port.counters.to_delay.add(given, time);
                }
                return true;
            }
            _ => return true,
        };
        port.assembling = (!fragment.last).then_some(now);
        if let Some(frame) = port.reassembler.add(&fragment).map(<[u8]>::to_vec) {
            if let (Some(at), Some(now), true) = (fragment.time, time, port.time_stamps) {
                port.counters.from_delay.add(at, now);
            }
            network.forward(now, self.number, &frame);
        }
        true
    }

    /// Returns true if a frame has begun and its next fragment is due. Drops a frame whose next
    /// fragment is late.
    #[must_use]
    pub fn is_assembling(&self, now: Nanos) -> bool {
        let recent = |at: Nanos| now.saturating_sub(at) < FRAGMENT_TIMEOUT;
        self.network.with_port(self.number, |port| {
            if port.assembling.take_if(|at| !recent(*at)).is_some() {
                port.reassembler.reset();
            }
            port.assembling.is_some()
        })
    }

    /// Returns the next frame for the device. It is sent with this number, 0 to 15.
    #[must_use]
    pub fn next_frame(&self, now: Nanos, number: u8) -> Option<Vec<u8>> {
        let mut network = self.network.lock();
        let time = network.system_time(now);
        let port = network.ports.get_mut(self.number.0)?;
        let frame = port.next_frame()?;
        if let Some(given) = port.given.get_mut(usize::from(number)) {
            *given = time.filter(|_| port.time_stamps);
        }
        Some(frame)
    }

    /// Returns true if the device is asked for the time of sending of its frames.
    #[must_use]
    pub fn has_time_stamps(&self) -> bool {
        self.network.with_port(self.number, |port| port.time_stamps)
    }

    /// Returns true if a frame waits for the device.
    #[must_use]
    pub fn has_frame(&self) -> bool {
        self.network
            .with_port(self.number, |port| port.waiting() > 0)
    }

    /// Counts a frame that the device has taken, or not.
    pub fn count(&self, taken: bool) {
        self.network
            .with_port(self.number, |port| port.count(taken));
    }

    /// Drops the frames for a device that takes none, and `begun` frames whose fragments it has seen
    /// in part. Its addresses are forgotten.
    pub fn drop_frames(&self, begun: u64) {
        self.network.with_port(self.number, |port| {
            port.counters.not_taken += begun;
            port.clear();
        });
        self.network.lock().switch.forget(self.number);
    }

    /// Counts a mailbox error of the device for a fragment. A device without EoE loses the frames
    /// that wait, and gets no more.
    pub fn refuse(&self, code: u16) {
        let lacks_eoe = code == ERROR_UNSUPPORTED_PROTOCOL;
        self.network.with_port(self.number, |port| {
            port.counters.refused += 1;
            port.counters.unsupported |= lacks_eoe;
        });
        if lacks_eoe {
            self.drop_frames(0);
        }
    }

    /// Returns true if the device has refused EoE as such.
    #[must_use]
    pub fn is_unsupported(&self) -> bool {
        self.network
            .with_port(self.number, |port| port.counters.unsupported)
    }

    /// Drops all frames and the addresses of a device that has restarted.
    pub fn restart(&self) {
        self.network.with_port(self.number, |port| {
            port.reassembler.reset();
            port.assembling = None;
            port.given = [None; 16];
            port.counters.unsupported = false;
            port.clear();
        });
        self.network.lock().switch.forget(self.number);
    }

    /// Takes the turn, unless another port has it: EoE has one datagram of the whole bus in flight, so that the
    /// requests of other mailboxes keep their share of each cycle.
    #[must_use]
    pub fn try_turn(&self) -> Option<Turn> {
        Arc::clone(&self.network.turn).try_lock_owned().ok()
    }
}

/// The switch's port of an interface.
#[derive(Debug)]
pub struct HostPort {
    network: EoeNetwork,
    number: PortNumber,
}

impl HostPort {
    /// Takes a frame from the interface.
    pub fn receive(&self, now: Nanos, frame: &[u8]) {
        self.network.lock().forward(now, self.number, frame);
    }

    /// Returns the next frame for the interface.
    #[must_use]
    pub fn next_frame(&self) -> Option<Vec<u8>> {
        self.network.with_port(self.number, Port::next_frame)
    }

    /// Counts a frame that the interface has taken, or not.
    pub fn count(&self, taken: bool) {
        self.network
            .with_port(self.number, |port| port.count(taken));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ecaxis_ecat::mailbox::Encode;
    use ecaxis_ecat::mailbox::eoe::Fragments;
    use proptest::prelude::*;

    fn frame(to: u8, from: u8, length: usize) -> Vec<u8> {
        let mut frame = vec![0x02, 0, 0, 0, 0, to, 0x02, 0, 0, 0, 0, from];
        frame.resize(length, from);
        frame
    }

    fn mailboxes(frame: &[u8], number: u8) -> Vec<Vec<u8>> {
        let each = Fragments::new(frame, number, 128).map(|fragment| {
            let mut bytes = Vec::new();
            Message::from(Service::Fragment(fragment)).emit(1, 128, &mut bytes);
            bytes
        });
        each.collect()
    }

    #[test]
    fn frames_pass_from_mailboxes_to_queues() {
        let network = EoeNetwork::default();
        let (x, y) = (
            network.add_device("x", false),
            network.add_device("y", false),
        );
        let host = network.add_host("ecat0");
        let sent = frame(9, 1, 300);
        for mailbox in mailboxes(&sent, 1) {
            assert!(x.receive(0, &mailbox));
        }
        // The receiver is not known.
        assert_eq!(y.next_frame(0, 0), Some(sent.clone()));
        assert_eq!(host.next_frame(), Some(sent));
        assert_eq!(x.next_frame(0, 0), None);
        let answer = frame(1, 9, 60);
        host.receive(1, &answer);
        assert!(x.has_frame() && !y.has_frame());
        assert_eq!(x.next_frame(0, 0), Some(answer));
        assert!(!x.receive(2, &[10, 0, 0, 0, 0, 0x13]), "CoE");
        assert!(x.receive(2, &[10, 0, 0, 0, 0, 0x12]), "damaged EoE");
        let counters = network.counters();
        assert_eq!(counters[0].from_port, 1);
        assert_eq!(counters[0].invalid, 1);
        assert_eq!(counters[2].from_port, 1);
    }

    #[test]
    fn a_queue_is_bounded_and_drops_the_oldest() {
        let network = EoeNetwork::default();
        let x = network.add_device("x", false);
        let host = network.add_host("ecat0");
        for n in 0..FRAMES_PER_PORT + 5 {
            host.receive(0, &frame(1, 2, 60 + n));
        }
        assert_eq!(x.next_frame(0, 0).map(|frame| frame.len()), Some(65));
        assert_eq!(network.counters()[0].overflows, 5);
        x.drop_frames(1);
        assert_eq!(x.next_frame(0, 0), None);
        assert_eq!(
            network.counters()[0].not_taken,
            FRAMES_PER_PORT as u64,
            "all but the one taken, and the one begun"
        );
    }

    #[test]
    fn own_frames_precede_floods() {
        let network = EoeNetwork::default();
        let (x, host) = (network.add_device("x", false), network.add_host("ecat0"));
        for mailbox in mailboxes(&frame(9, 1, 60), 1) {
            x.receive(0, &mailbox);
        }
        let (flood, own) = (frame(7, 2, 60), frame(1, 2, 61));
        host.receive(1, &flood);
        host.receive(2, &own);
        assert_eq!(x.next_frame(0, 0), Some(own));
        assert_eq!(x.next_frame(0, 0), Some(flood));
        assert_eq!(x.next_frame(0, 0), None);
    }

    #[test]
    fn a_restart_ends_the_frame_and_forgets_the_addresses() {
        let network = EoeNetwork::default();
        let (x, y) = (
            network.add_device("x", false),
            network.add_device("y", false),
        );
        for mailbox in mailboxes(&frame(9, 1, 60), 1) {
            x.receive(0, &mailbox);
        }
        let long = mailboxes(&frame(9, 1, 300), 2);
        x.receive(1, &long[0]);
        assert!(x.is_assembling(2));
        assert!(!x.is_assembling(2 + FRAGMENT_TIMEOUT));
        assert_eq!(network.counters()[0].incomplete, 1);
        x.receive(3, &long[0]);
        y.receive(4, &mailboxes(&frame(1, 9, 60), 1)[0]);
        assert!(x.has_frame());
        x.restart();
        assert!(!x.is_assembling(5) && !x.has_frame());
        x.receive(6, &long[1]);
        let counters = &network.counters()[0];
        assert_eq!((counters.incomplete, counters.not_taken), (3, 1));
        assert!(y.has_frame());
        y.restart();
        assert!(network.lock().switch.is_empty());
    }

    proptest! {
        /// Whatever arrives, queues stay bounded, and no frame comes back to its port.
        #[test]
        fn queues_are_bounded(
            frames in proptest::collection::vec((0..3_usize, 0..4_u8, 1..4_u8), 0..300),
        ) {
            let network = EoeNetwork::default();
            let ports = [0, 1, 2].map(|n| network.add_host(&n.to_string()));
            for (port, to, from) in frames {
                let sent = frame(to, from, 60);
                let before = network.lock().ports[port].waiting();
                ports[port].receive(0, &sent);
                let lengths: Vec<_> =
                    network.lock().ports.iter().map(Port::waiting).collect();
                prop_assert_eq!(lengths[port], before);
                prop_assert!(lengths.iter().all(|length| *length <= 2 * FRAMES_PER_PORT));
            }
        }
    }
}
