//! A learning switch (IEEE 802.1D, without spanning tree: its ports form no loop). Pure: it decides
//! to which ports a frame goes.

use std::collections::BTreeMap;

use ecaxis_ecat::mailbox::eoe::{MAX_FRAME, MIN_FRAME, MacAddress};

use crate::clock::Nanos;

/// The maximum number of addresses that the switch knows. The oldest makes room.
pub const MAX_ADDRESSES: usize = 1024;
/// An address that was silent for this time in ns is forgotten (IEEE 802.1D: 300 s).
pub const AGEING: Nanos = 300_000_000_000;

/// The number of a port.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct PortNumber(pub usize);

/// Where a frame goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Destination {
    /// To all ports but that of its arrival: a broadcast, a multicast, or an unknown address.
    Others,
    /// To one port.
    Port(PortNumber),
    /// Nowhere: its receiver is at the port of its arrival, or it is for the switch itself.
    Nowhere,
}

/// What is wrong with a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct InvalidFrame;

#[derive(Debug, Clone, Copy)]
struct Place {
    port: PortNumber,
    seen: Nanos,
}

/// The addresses that a switch has learned.
#[derive(Debug, Clone, Default)]
pub struct Switch {
    addresses: BTreeMap<MacAddress, Place>,
}

/// Returns true for the address of a group: a multicast or broadcast.
fn is_group(address: MacAddress) -> bool {
    address[0] & 1 != 0
}

impl Switch {
    /// Learns the sender of a frame that has arrived at a port, and returns where the frame goes.
    ///
    /// # Errors
    /// [`InvalidFrame`] for a frame with a wrong length or sender.
    pub fn forward(
        &mut self,
        now: Nanos,
        from: PortNumber,
        frame: &[u8],
    ) -> Result<Destination, InvalidFrame> {
        if !(MIN_FRAME..=MAX_FRAME).contains(&frame.len()) {
            return Err(InvalidFrame);
        }
        let addresses = frame.first_chunk::<6>().zip(frame.get(6..12));
        let (to, sender) = addresses.ok_or(InvalidFrame)?;
        let sender: MacAddress = sender.try_into().map_err(|_| InvalidFrame)?;
        if is_group(sender) || sender == [0; 6] {
            return Err(InvalidFrame);
        }
        self.learn(now, from, sender);
        if is_link_local(*to) {
            return Ok(Destination::Nowhere);
        }
        if is_group(*to) {
            return Ok(Destination::Others);
        }
        let known = self.addresses.get(to).filter(|place| is_fresh(place, now));
        Ok(match known {
            None => Destination::Others,
            Some(place) if place.port == from => Destination::Nowhere,
            Some(place) => Destination::Port(place.port),
        })
    }

    /// Forgets the addresses behind a port whose device has left.
    pub fn forget(&mut self, port: PortNumber) {
        self.addresses.retain(|_, place| place.port != port);
    }

    /// Returns how many addresses the switch knows.
    #[must_use]
    pub fn len(&self) -> usize {
        self.addresses.len()
    }

    /// Returns true if the switch knows no address.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.addresses.is_empty()
    }

    fn learn(&mut self, now: Nanos, port: PortNumber, sender: MacAddress) {
        if self.addresses.len() >= MAX_ADDRESSES && !self.addresses.contains_key(&sender) {
            self.addresses.retain(|_, place| is_fresh(place, now));
            if self.addresses.len() >= MAX_ADDRESSES {
                let oldest = self.addresses.iter().min_by_key(|(_, place)| place.seen);
                if let Some(oldest) = oldest.map(|(address, _)| *address) {
                    self.addresses.remove(&oldest);
                }
            }
        }
        self.addresses.insert(sender, Place { port, seen: now });
    }
}

fn is_fresh(place: &Place, now: Nanos) -> bool {
    now.saturating_sub(place.seen) < AGEING
}

/// Returns true for 01-80-C2-00-00-00 to -0F, which no switch forwards (IEEE 802.1D, Table 7-10).
fn is_link_local(address: MacAddress) -> bool {
    matches!(address, [0x01, 0x80, 0xc2, 0, 0, 0..=0x0f])
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const BROADCAST: u8 = 0xff;

    /// Returns the address of a host; `BROADCAST` is that of all.
    fn address(host: u8) -> MacAddress {
        match host {
            BROADCAST => [0xff; 6],
            host => [0x02, 0, 0, 0, 0, host],
        }
    }

    fn frame(to: MacAddress, from: MacAddress) -> Vec<u8> {
        let mut frame = [to, from].concat();
        frame.resize(60, 0);
        frame
    }

    #[test]
    fn rows_of_learning_and_flooding() {
        let mut switch = Switch::default();
        let (a, b) = (PortNumber(0), PortNumber(1));
        let mut sent = |now, port, to, from| {
            let frame = frame(address(to), address(from));
            switch.forward(now, port, &frame).unwrap()
        };
        // An unknown address is at any port.
        assert_eq!(sent(0, a, 2, 1), Destination::Others);
        assert_eq!(sent(1, b, 1, 2), Destination::Port(a));
        assert_eq!(sent(2, a, 2, 1), Destination::Port(b));
        assert_eq!(sent(3, a, BROADCAST, 1), Destination::Others);
        // A neighbour behind the same port.
        assert_eq!(sent(4, a, 1, 3), Destination::Nowhere);
        // A host has moved.
        assert_eq!(sent(5, b, 3, 1), Destination::Port(a));
        assert_eq!(sent(6, a, 1, 3), Destination::Port(b));
        // Its last frame was at 5.
        assert_eq!(sent(4 + AGEING, a, 1, 3), Destination::Port(b));
        assert_eq!(sent(5 + AGEING, a, 1, 3), Destination::Others);
        switch.forget(a);
        assert!(switch.addresses.values().all(|place| place.port == b));
    }

    #[test]
    fn invalid_and_link_local_frames_go_nowhere() {
        let mut switch = Switch::default();
        let port = PortNumber(0);
        let long = |length| {
            let mut frame = frame(address(1), address(2));
            frame.resize(length, 0);
            frame
        };
        let invalid = [
            Vec::new(),
            long(13),
            long(MAX_FRAME + 1),
            frame(address(1), address(BROADCAST)),
            frame(address(1), [0x01, 0, 0x5e, 0, 0, 1]),
            frame(address(1), [0; 6]),
        ];
        for frame in invalid {
            assert_eq!(switch.forward(0, port, &frame), Err(InvalidFrame));
        }
        assert!(switch.is_empty());
        for last in 0..=0x10 {
            let to = [0x01, 0x80, 0xc2, 0, 0, last];
            let expected = match last {
                0x10 => Destination::Others,
                _ => Destination::Nowhere,
            };
            assert_eq!(
                switch.forward(0, port, &frame(to, address(2))),
                Ok(expected)
            );
        }
        let lengths = [MIN_FRAME, MAX_FRAME].map(long);
        assert!(lengths.iter().all(|f| switch.forward(0, port, f).is_ok()));
    }

    #[test]
    fn addresses_are_bounded_and_the_oldest_goes() {
        let mut switch = Switch::default();
        for number in 0..MAX_ADDRESSES + 500 {
            let [.., high, low] = number.to_be_bytes();
            let frame = frame(address(1), [0x02, 1, 0, 0, high, low]);
            let now = number as Nanos;
            switch.forward(now, PortNumber(number % 3), &frame).unwrap();
            assert!(switch.len() <= MAX_ADDRESSES);
        }
        assert!(!switch.addresses.contains_key(&[0x02, 1, 0, 0, 0, 0]));
        let [.., high, low] = (MAX_ADDRESSES + 499).to_be_bytes();
        assert!(switch.addresses.contains_key(&[0x02, 1, 0, 0, high, low]));
    }

    proptest! {
        /// A frame never returns to its port, and a known receiver gets it exactly once: with ports
        /// that form no loop there is none.
        #[test]
        fn no_frame_returns_to_its_port(
            frames in proptest::collection::vec((0..4_usize, 0..6_u8, 0..6_u8), 1..200),
        ) {
            let mut switch = Switch::default();
            let mut places = BTreeMap::new();
            for (now, (port, to, from)) in (0..).zip(frames) {
                let from_port = PortNumber(port);
                let frame = frame(address(to), address(from));
                let destination = switch.forward(now, from_port, &frame).unwrap();
                places.insert(from, from_port);
                let expected = match places.get(&to) {
                    None => Destination::Others,
                    Some(place) if *place == from_port => Destination::Nowhere,
                    Some(place) => Destination::Port(*place),
                };
                prop_assert_eq!(destination, expected);
                prop_assert!(destination != Destination::Port(from_port));
            }
        }
    }
}
