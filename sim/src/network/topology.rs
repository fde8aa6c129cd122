//! Which port leads to which device. Frames pass a device's ports in the order 0, 3, 1, 2 and back
//! to 0, so that the order of devices is that of a tree's branches; connections that contradict it
//! are refused.

use crate::device::SimDevice;
use crate::esc::ports::{DOWNSTREAM, Medium, PORTS};

/// The media of a device's four ports.
pub type Media = [Medium; PORTS];

/// What somebody asks of a device's place; a port left open is chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Wish {
    /// The device that it is connected to.
    pub after: usize,
    /// Which port of that device.
    pub port: Option<u8>,
}

/// A port that leads away from the MainDevice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Uplink {
    pub device: usize,
    pub port: u8,
}

/// Every device with its port 0 at a port of a device in front of it, the first at the MainDevice.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Topology {
    pub(super) uplinks: Vec<Option<Uplink>>,
    /// Propagation to port 0, one way, where it is not that of all cables.
    pub(super) cable_ns: Vec<Option<u64>>,
    pub(super) ring: Option<(Uplink, SecondPort)>,
}

/// What a ring ends in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SecondPort {
    /// A second port of the MainDevice, which receives what comes out there.
    Listens,
    /// Nobody listens there: what comes out is sent back into the ring, past all processing units,
    /// and arrives at the first port. For a MainDevice that knows of one port only.
    Reflects,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum TopologyError {
    #[error("device {device} cannot be connected to device {after}, which does not come before it")]
    NotBefore { device: usize, after: usize },
    #[error("device {device}: port 0 of device {after} leads to the MainDevice")]
    Upstream { device: usize, after: usize },
    #[error("device {device}: device {after} has no port {port}")]
    NoSuchPort {
        device: usize,
        after: usize,
        port: u8,
    },
    #[error("device {device}: port {port} of device {after} is taken by device {by}")]
    Taken {
        device: usize,
        after: usize,
        port: u8,
        by: usize,
    },
    #[error(
        "device {device}: frames pass port {port} of device {after} before they reach device {by}, \
         so what is connected there must come before device {by}"
    )]
    OutOfOrder {
        device: usize,
        after: usize,
        port: u8,
        by: usize,
    },
    #[error("device {device}: port {port} of device {after} is of another medium")]
    OtherMedium {
        device: usize,
        after: usize,
        port: u8,
    },
    #[error("device {device}: device {after} has no port left for it")]
    NoPortAt { device: usize, after: usize },
    #[error("device {device}: no device before it has a port left")]
    NoPort { device: usize },
    #[error("no port is left to close the ring at")]
    NoPortForRing,
}

impl TopologyError {
    /// The device that cannot be where it is to be.
    #[must_use]
    pub fn device(&self) -> Option<usize> {
        match *self {
            Self::NotBefore { device, .. }
            | Self::Upstream { device, .. }
            | Self::NoSuchPort { device, .. }
            | Self::Taken { device, .. }
            | Self::OutOfOrder { device, .. }
            | Self::OtherMedium { device, .. }
            | Self::NoPortAt { device, .. }
            | Self::NoPort { device } => Some(device),
            Self::NoPortForRing => None,
        }
    }
}

/// The devices whose downstream ports are still to be passed: the way to the latest device.
#[derive(Debug, Default)]
struct Open {
    /// Device, and how many of its [`DOWNSTREAM`] ports are passed already.
    path: Vec<(usize, usize)>,
}

impl Open {
    /// Ports still open at one entry of the path, in the order frames pass them.
    fn ports<'a>(
        &self,
        entry: usize,
        media: &'a [Media],
    ) -> impl Iterator<Item = (usize, u8, Medium)> + 'a {
        let (device, passed) = self.path.get(entry).copied().unwrap_or((0, PORTS));
        DOWNSTREAM
            .into_iter()
            .enumerate()
            .skip(passed)
            .filter_map(move |(nth, port)| {
                let medium = *media.get(device)?.get(usize::from(port))?;
                (medium != Medium::None).then_some((nth, port, medium))
            })
    }

    fn find(
        &self,
        media: &[Media],
        fits: impl Fn(Medium) -> bool,
    ) -> Option<(usize, usize, Uplink)> {
        (0..self.path.len()).rev().find_map(|entry| {
            let (device, _) = *self.path.get(entry)?;
            let (nth, port, _) = self
                .ports(entry, media)
                .find(|(_, _, medium)| fits(*medium))?;
            Some((entry, nth, Uplink { device, port }))
        })
    }

    /// Takes the port, and leaves for good what frames pass before it.
    fn take(&mut self, entry: usize, nth: usize) {
        self.path.truncate(entry + 1);
        if let Some((_, passed)) = self.path.last_mut() {
            *passed = nth + 1;
        }
    }
}

impl Topology {
    /// Every device at the deepest port still open, in processing order, whose medium fits; where
    /// none fits, as through a media converter, at the deepest one that is open.
    ///
    /// # Errors
    /// Where no port is left at all.
    pub fn by_order(media: &[Media]) -> Result<Self, Vec<TopologyError>> {
        Self::connect(media, &[])
    }

    /// As [`Topology::by_order`], but for the n-th device as the n-th wish says.
    ///
    /// # Errors
    /// Every wish that cannot be met.
    pub fn connect(media: &[Media], wishes: &[Option<Wish>]) -> Result<Self, Vec<TopologyError>> {
        let (topology, errors) = Self::build(media, wishes);
        if errors.is_empty() {
            Ok(topology)
        } else {
            Err(errors)
        }
    }

    /// As far as possible; a device that finds no port is left unconnected.
    pub(super) fn possible(media: &[Media]) -> Self {
        Self::build(media, &[]).0
    }

    fn build(media: &[Media], wishes: &[Option<Wish>]) -> (Self, Vec<TopologyError>) {
        let mut errors = Vec::new();
        let mut uplinks: Vec<Option<Uplink>> = Vec::with_capacity(media.len());
        let mut open = Open::default();
        for device in 0..media.len() {
            let wish = wishes.get(device).copied().flatten();
            let granted = match wish {
                Some(wish) => grant(device, wish, media, &uplinks, &open)
                    .map_err(|error| errors.push(error))
                    .ok(),
                None => None,
            };
            let own = media.get(device).map_or(Medium::None, |own| own[0]);
            let place = granted
                .or_else(|| open.find(media, |medium| medium == own))
                .or_else(|| open.find(media, |_| true));
            match place {
                Some((entry, nth, _)) => open.take(entry, nth),
                None if device > 0 => errors.push(TopologyError::NoPort { device }),
                None => {}
            }
            if place.is_some() || device == 0 {
                open.path.push((device, 0));
            }
            uplinks.push(place.map(|(_, _, uplink)| uplink));
        }
        let topology = Self {
            cable_ns: vec![None; uplinks.len()],
            uplinks,
            ring: None,
        };
        (topology, errors)
    }

    /// Closes a ring: a cable from the last port that frames pass back to the MainDevice.
    ///
    /// # Errors
    /// [`TopologyError::NoPortForRing`]
    pub fn closed(mut self, media: &[Media], second: SecondPort) -> Result<Self, TopologyError> {
        let mut open = Open::default();
        for (device, uplink) in self.uplinks.iter().enumerate() {
            if let Some(uplink) = uplink {
                let entry = open.path.iter().position(|(d, _)| *d == uplink.device);
                let nth = DOWNSTREAM.iter().position(|port| *port == uplink.port);
                if let (Some(entry), Some(nth)) = (entry, nth) {
                    open.take(entry, nth);
                }
            }
            open.path.push((device, 0));
        }
        let found = open
            .find(media, |medium| medium == Medium::Mii)
            .or_else(|| open.find(media, |_| true))
            .ok_or(TopologyError::NoPortForRing)?;
        self.ring = Some((found.2, second));
        Ok(self)
    }

    /// Gives the cable to a device's port 0 a propagation time of its own, one way.
    #[must_use]
    pub fn with_cable(mut self, device: usize, ns: u64) -> Self {
        if let Some(cable) = self.cable_ns.get_mut(device) {
            *cable = Some(ns);
        }
        self
    }

    /// Number of devices.
    #[must_use]
    pub fn len(&self) -> usize {
        self.uplinks.len()
    }

    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.uplinks.is_empty()
    }

    /// Whether something is connected to the port.
    #[must_use]
    pub fn has_cable(&self, device: usize, port: u8) -> bool {
        if port == 0 {
            return device == 0 && !self.is_empty() || self.uplink(device).is_some();
        }
        let end = Uplink { device, port };
        self.uplinks.contains(&Some(end)) || self.ring.is_some_and(|(last, _)| last == end)
    }

    /// Where a device's port 0 leads; `None` for the one at the MainDevice.
    #[must_use]
    pub fn uplink(&self, device: usize) -> Option<Uplink> {
        self.uplinks.get(device).copied().flatten()
    }
}

fn grant(
    device: usize,
    wish: Wish,
    media: &[Media],
    uplinks: &[Option<Uplink>],
    open: &Open,
) -> Result<(usize, usize, Uplink), TopologyError> {
    use TopologyError as E;
    let after = wish.after;
    if after >= device {
        return Err(E::NotBefore { device, after });
    }
    let own = media.get(device).map_or(Medium::None, |own| own[0]);
    let there = media.get(after).copied().unwrap_or_default();
    let taken = |port: u8| {
        let uplink = Some(Uplink {
            device: after,
            port,
        });
        uplinks.iter().position(|other| *other == uplink)
    };
    if let Some(port) = wish.port {
        if port == 0 {
            return Err(E::Upstream { device, after });
        }
        let medium = there.get(usize::from(port)).copied().unwrap_or_default();
        if medium == Medium::None {
            return Err(E::NoSuchPort {
                device,
                after,
                port,
            });
        }
        if let Some(by) = taken(port) {
            return Err(E::Taken {
                device,
                after,
                port,
                by,
            });
        }
        if medium != own {
            return Err(E::OtherMedium {
                device,
                after,
                port,
            });
        }
    }
    let fits = |port: u8, medium: Medium| match wish.port {
        Some(wished) => port == wished,
        None => medium == own,
    };
    let entry = open.path.iter().position(|(d, _)| *d == after);
    let found = entry.and_then(|entry| {
        let mut ports = open.ports(entry, media);
        let (nth, port, _) = ports.find(|(_, port, medium)| fits(*port, *medium))?;
        Some((
            entry,
            nth,
            Uplink {
                device: after,
                port,
            },
        ))
    });
    if let Some(found) = found {
        return Ok(found);
    }
    // Which port would do, had it not been passed?
    let passed = DOWNSTREAM.into_iter().find(|port| {
        let medium = there.get(usize::from(*port)).copied().unwrap_or_default();
        medium != Medium::None && taken(*port).is_none() && fits(*port, medium)
    });
    // The device that frames reach only after the port: the next one beside `after`'s branch.
    match passed {
        Some(port) => Err(E::OutOfOrder {
            device,
            after,
            port,
            by: passed_by(after, port, uplinks),
        }),
        None => Err(E::NoPortAt { device, after }),
    }
}

/// The first device that frames reach after they have passed the port.
fn passed_by(after: usize, port: u8, uplinks: &[Option<Uplink>]) -> usize {
    let nth = |port: u8| DOWNSTREAM.iter().position(|p| *p == port);
    let (mut device, mut beyond) = (after, nth(port));
    loop {
        let next = uplinks
            .iter()
            .position(|u| u.is_some_and(|u| u.device == device && nth(u.port) > beyond));
        if let Some(next) = next {
            return next;
        }
        match uplinks.get(device).copied().flatten() {
            Some(up) => (device, beyond) = (up.device, nth(up.port)),
            None => return uplinks.len(),
        }
    }
}

/// The media of each device's ports, in order.
#[must_use]
pub fn media(devices: &[SimDevice]) -> Vec<Media> {
    devices.iter().map(|device| device.esc().media()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn list(physics: &[&str]) -> Vec<Media> {
        physics.iter().map(|p| Medium::from_physics(p)).collect()
    }

    fn uplinks(topology: &Topology) -> Vec<(usize, u8)> {
        let all = topology.uplinks.iter().skip(1);
        all.map(|u| u.map_or((99, 99), |u| (u.device, u.port)))
            .collect()
    }

    #[test]
    #[rustfmt::skip] // one row a bus
    fn devices_find_their_port_by_order() {
        for (physics, expected) in [
            (&["YY", "YY", "YY"][..], &[(0, 1), (1, 1)][..]),
            // A coupler with terminals, then a drive at its second socket, and one behind that.
            (&["YKY", "KK", "KK", "YY", "YY"], &[(0, 1), (1, 1), (0, 2), (3, 1)]),
            // Two couplers, each with a terminal.
            (&["YKY", "KK", "YKY", "KK"], &[(0, 1), (0, 2), (2, 1)]),
            // Port 3 comes before port 1.
            (&["YYYY", "YY", "YY", "Y", "Y"], &[(0, 3), (1, 1), (2, 1), (0, 1)]),
            // A terminal with an E-bus port 3 behind an Ethernet port 1.
            (&["YY K", "KK", "YY"], &[(0, 3), (0, 1)]),
            // A junction terminal: its sockets first, then the terminals behind it.
            (&["YKY", "KYKY", "YY", "YY", "KK", "YY"], &[(0, 1), (1, 3), (2, 1), (1, 2), (0, 2)]),
            // Nothing fits: as through a media converter.
            (&["YY", "KK", "YY"], &[(0, 1), (1, 1)]),
        ] {
            let topology = Topology::by_order(&list(physics)).unwrap();
            assert_eq!(uplinks(&topology), expected, "{physics:?}");
        }
    }

    #[test]
    fn a_device_without_a_port_for_it_is_named() {
        let errors = Topology::by_order(&list(&["YY", "Y", "YY"])).unwrap_err();
        assert_eq!(errors, [TopologyError::NoPort { device: 2 }]);
    }

    #[test]
    #[rustfmt::skip] // one row a mistake
    fn wishes_are_met_or_refused_with_the_reason() {
        use TopologyError as E;
        let bus = list(&["YKY", "KK", "YY", "KK", "YY"]);
        let wish = |device: usize, after: usize, port: Option<u8>| {
            let mut wishes = vec![None; 5];
            wishes[device] = Some(Wish { after, port });
            Topology::connect(&bus, &wishes)
        };
        assert_eq!(uplinks(&wish(2, 0, Some(2)).unwrap())[1], (0, 2));
        assert_eq!(uplinks(&wish(2, 0, None).unwrap())[1], (0, 2));
        for (wished, error) in [
            (wish(2, 2, Some(1)), E::NotBefore { device: 2, after: 2 }),
            (wish(2, 9, None), E::NotBefore { device: 2, after: 9 }),
            (wish(2, 0, Some(0)), E::Upstream { device: 2, after: 0 }),
            (wish(2, 0, Some(3)), E::NoSuchPort { device: 2, after: 0, port: 3 }),
            (wish(2, 0, Some(77)), E::NoSuchPort { device: 2, after: 0, port: 77 }),
            (wish(3, 0, Some(1)), E::Taken { device: 3, after: 0, port: 1, by: 1 }),
            (wish(2, 1, Some(1)), E::OtherMedium { device: 2, after: 1, port: 1 }),
            (wish(2, 1, None), E::NoPortAt { device: 2, after: 1 }),
            // The terminal's port is passed before the drive at the coupler's second socket.
            (wish(3, 1, Some(1)), E::OutOfOrder { device: 3, after: 1, port: 1, by: 2 }),
        ] {
            assert_eq!(wished.unwrap_err(), [error]);
        }
    }

    #[test]
    fn every_wrong_wish_is_reported() {
        let bus = list(&["YY", "YY", "YY"]);
        let wish = |after, port| Some(Wish { after, port });
        let errors =
            Topology::connect(&bus, &[None, wish(0, Some(2)), wish(0, Some(0))]).unwrap_err();
        assert_eq!(errors.len(), 2);
    }

    #[test]
    fn a_ring_is_closed_at_the_last_port() {
        let end = |physics: &[&str]| {
            let bus = list(physics);
            let topology = Topology::by_order(&bus).unwrap();
            topology.closed(&bus, SecondPort::Listens).map(|t| t.ring)
        };
        let at = |device, port| Ok(Some((Uplink { device, port }, SecondPort::Listens)));
        assert_eq!(end(&["YY", "YY"]), at(1, 1));
        // Behind E-bus terminals the way back leads through the coupler.
        assert_eq!(end(&["YKY", "KK"]), at(0, 2));
        assert_eq!(end(&["YY", "Y"]), Err(TopologyError::NoPortForRing));
    }
}
