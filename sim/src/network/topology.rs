//! The connections between ports and devices.
//!
//! Frames pass the ports of a device in the order 0, 3, 1, 2 and back to 0. The order of devices
//! therefore is the order of the branches of a tree. Contradicting connections are rejected.
//!
//! ```
//! use ecaxis_sim::Medium::{Mii, None as Missing};
//! use ecaxis_sim::network::topology::{Topology, Uplink};
//!
//! // Ports 0, 1 and 2 of a junction, then two devices with two ports.
//! let end = [Mii, Mii, Missing, Missing];
//! let media = [[Mii, Mii, Mii, Missing], end, end];
//! let topology = Topology::by_order(&media).unwrap();
//! assert_eq!(topology.uplink(0), None); // the MainDevice
//! assert_eq!(topology.uplink(2), Some(Uplink { device: 1, port: 1 }));
//! ```

use crate::device::SimDevice;
use crate::esc::ports::{DOWNSTREAM, Medium, PORTS};

/// The media of the four ports of a device.
pub type Media = [Medium; PORTS];

/// The requested position of a device. Without a port, the topology selects one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PortRequest {
    /// The device to connect to.
    pub after: usize,
    /// The port of that device.
    pub port: Option<u8>,
    /// Other devices may be connected to the same port, one at a time.
    pub shared: bool,
}

/// A port that leads away from the MainDevice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Uplink {
    /// The device with the port, counted from 0.
    pub device: usize,
    /// The port of that device.
    pub port: u8,
}

/// A tree of devices. Port 0 of each device connects to an earlier device, that of the first to the
/// MainDevice. A device with swapped cables has another port there.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Topology {
    pub(super) uplinks: Vec<Option<Uplink>>,
    /// The port that leads to the MainDevice.
    pub(super) inlets: Vec<u8>,
    /// One-way delay of the cable at that port in ns; `None`: the default of all cables.
    pub(super) cable_ns: Vec<Option<u64>>,
    pub(super) ring: Option<(Uplink, SecondPort)>,
}

/// The end of a ring.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SecondPort {
    /// A second port of the MainDevice, which receives frames from the ring.
    Listens,
    /// No receiver. Frames at the end return through the ring, past all processing units, and
    /// arrive at the first port. For a MainDevice that supports only one port.
    Reflects,
}

/// The devices cannot be connected as requested. Devices count from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum TopologyError {
    /// The device to connect to does not come earlier.
    #[error("device {device} cannot be connected to device {after}, which does not come before it")]
    NotBefore {
        /// The device that cannot be connected.
        device: usize,
        /// The device to connect to.
        after: usize,
    },
    /// The requested port leads to the MainDevice.
    #[error("device {device}: port 0 of device {after} leads to the MainDevice")]
    Upstream {
        /// The device that cannot be connected.
        device: usize,
        /// The device to connect to.
        after: usize,
    },
    /// The requested port does not exist.
    #[error("device {device}: device {after} has no port {port}")]
    NoSuchPort {
        /// The device that cannot be connected.
        device: usize,
        /// The device to connect to.
        after: usize,
        /// The requested port.
        port: u8,
    },
    /// Another device is connected to the requested port.
    #[error("device {device}: port {port} of device {after} is taken by device {by}")]
    Taken {
        /// The device that cannot be connected.
        device: usize,
        /// The device to connect to.
        after: usize,
        /// The requested port.
        port: u8,
        /// The other device.
        by: usize,
    },
    /// The order of devices contradicts the order in which frames pass the ports.
    #[error(
        "device {device}: frames pass port {port} of device {after} before they reach device {by}, \
         so what is connected there must come before device {by}"
    )]
    OutOfOrder {
        /// The device that cannot be connected.
        device: usize,
        /// The device to connect to.
        after: usize,
        /// The requested port.
        port: u8,
        /// The other device.
        by: usize,
    },
    /// The two ports have different media.
    #[error("device {device}: port {port} of device {after} is of another medium")]
    OtherMedium {
        /// The device that cannot be connected.
        device: usize,
        /// The device to connect to.
        after: usize,
        /// The requested port.
        port: u8,
    },
    /// The device to connect to has no free port.
    #[error("device {device}: device {after} has no port left for it")]
    NoPortAt {
        /// The device that cannot be connected.
        device: usize,
        /// The device to connect to.
        after: usize,
    },
    /// No earlier device has a free port.
    #[error("device {device}: no device before it has a port left")]
    NoPort {
        /// The device that cannot be connected.
        device: usize,
    },
    /// A device with one port has no cables to swap.
    #[error("device {device}: it has no second port to swap its cables")]
    NoSecondPort {
        /// The device.
        device: usize,
    },
    /// No free port can close the ring.
    #[error("no port is left to close the ring at")]
    NoPortForRing,
}

impl TopologyError {
    /// Returns the device that cannot be connected as requested.
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
            | Self::NoPort { device }
            | Self::NoSecondPort { device } => Some(device),
            Self::NoPortForRing => None,
        }
    }
}

/// The devices with downstream ports still to be passed: the path to the latest device.
#[derive(Debug, Default)]
struct FreePorts {
    /// Device and number of its [`DOWNSTREAM`] ports already passed.
    path: Vec<(usize, usize)>,
}

impl FreePorts {
    /// Returns the open ports of one entry of the path, in the order of frames.
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

    /// Uses a port. The ports that frames pass before it are no longer available.
    fn take(&mut self, entry: usize, nth: usize) {
        self.path.truncate(entry + 1);
        if let Some((_, passed)) = self.path.last_mut() {
            *passed = nth + 1;
        }
    }
}

impl Topology {
    /// Connects every device, in processing order, to the deepest open port with a matching medium.
    /// Without such a port, for example behind a media converter, it uses the deepest open port.
    ///
    /// # Errors
    /// Fails if no port is left.
    pub fn by_order(media: &[Media]) -> Result<Self, Vec<TopologyError>> {
        Self::connect(media, &[])
    }

    /// Like [`Topology::by_order`], with the n-th request for the n-th device.
    ///
    /// # Errors
    /// Returns all requests that cannot be fulfilled.
    pub fn connect(
        media: &[Media],
        requests: &[Option<PortRequest>],
    ) -> Result<Self, Vec<TopologyError>> {
        let (topology, errors) = Self::build(media, requests);
        if errors.is_empty() {
            Ok(topology)
        } else {
            Err(errors)
        }
    }

    /// Connects as many devices as possible. A device without a suitable port stays unconnected.
    pub(super) fn possible(media: &[Media]) -> Self {
        Self::build(media, &[]).0
    }

    fn build(media: &[Media], requests: &[Option<PortRequest>]) -> (Self, Vec<TopologyError>) {
        let mut errors = Vec::new();
        let mut uplinks: Vec<Option<Uplink>> = Vec::with_capacity(media.len());
        let mut open = FreePorts::default();
        for device in 0..media.len() {
            let request = requests.get(device).copied().flatten();
            let shared = request
                .filter(|request| request.shared)
                .and_then(|request| {
                    let (device, port) = (request.after, request.port?);
                    Some(Uplink { device, port })
                });
            if let Some(uplink) = shared.filter(|_| uplinks.contains(&shared)) {
                uplinks.push(shared);
                // The devices behind it follow.
                let entry = open.path.iter().position(|(d, _)| *d == uplink.device);
                open.path.truncate(entry.map_or(0, |entry| entry + 1));
                open.path.push((device, 0));
                continue;
            }
            let granted = match request {
                Some(request) => grant(device, request, media, &uplinks, &open)
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
            inlets: vec![0; uplinks.len()],
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
        let mut open = FreePorts::default();
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

    /// Swaps the cables at IN (port 0) and OUT of a device. OUT is the port of the next device, or
    /// the first port that frames pass. Frames then reach the device after those behind it.
    ///
    /// # Errors
    /// [`TopologyError::NoSecondPort`]
    pub fn reversed(mut self, media: &[Media], device: usize) -> Result<Self, TopologyError> {
        let there = media.get(device).copied().unwrap_or_default();
        let fits = |port: &u8| there.get(usize::from(*port)) == Some(&there[0]);
        let used = |port: &u8| self.has_cable(device, *port);
        let ports = || DOWNSTREAM.into_iter().filter(fits);
        let out = ports().find(used).or_else(|| ports().next());
        let out = out.ok_or(TopologyError::NoSecondPort { device })?;
        let end = Uplink { device, port: out };
        let next = self.uplinks.iter_mut().flatten();
        let ring = self.ring.iter_mut().map(|(last, _)| last);
        for upper in next.chain(ring).filter(|upper| **upper == end) {
            upper.port = 0;
        }
        if let Some(inlet) = self.inlets.get_mut(device) {
            *inlet = out;
        }
        Ok(self)
    }

    /// Sets the one-way delay of the cable from a device towards the MainDevice.
    #[must_use]
    pub fn with_cable(mut self, device: usize, ns: u64) -> Self {
        if let Some(cable) = self.cable_ns.get_mut(device) {
            *cable = Some(ns);
        }
        self
    }

    /// Returns the number of devices.
    #[must_use]
    pub fn len(&self) -> usize {
        self.uplinks.len()
    }

    /// True without devices.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.uplinks.is_empty()
    }

    /// True if a cable is connected to the port.
    #[must_use]
    pub fn has_cable(&self, device: usize, port: u8) -> bool {
        if self.inlets.get(device) == Some(&port) {
            return device == 0 || self.uplink(device).is_some();
        }
        let end = Uplink { device, port };
        self.uplinks.contains(&Some(end)) || self.ring.is_some_and(|(last, _)| last == end)
    }

    /// Returns the port that a device connects to towards the MainDevice; `None` for the device at
    /// the MainDevice.
    #[must_use]
    pub fn uplink(&self, device: usize) -> Option<Uplink> {
        self.uplinks.get(device).copied().flatten()
    }
}

fn grant(
    device: usize,
    request: PortRequest,
    media: &[Media],
    uplinks: &[Option<Uplink>],
    open: &FreePorts,
) -> Result<(usize, usize, Uplink), TopologyError> {
    use TopologyError as E;
    let after = request.after;
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
    if let Some(port) = request.port {
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
    let fits = |port: u8, medium: Medium| match request.port {
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
    // Find a port that would fit if frames had not passed it.
    let passed = DOWNSTREAM.into_iter().find(|port| {
        let medium = there.get(usize::from(*port)).copied().unwrap_or_default();
        medium != Medium::None && taken(*port).is_none() && fits(*port, medium)
    });
    // Report the device that frames reach only after the port: the next one outside the branch of
    // `after`.
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

/// Returns the first device that frames reach after the port.
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

/// Returns the media of the ports of each device, in order.
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
    fn by_order_connects_each_device_to_the_expected_port() {
        for (physics, expected) in [
            (&["YY", "YY", "YY"][..], &[(0, 1), (1, 1)][..]),
            // A coupler with terminals, a drive at its second socket, and another drive behind
            // that.
            (&["YKY", "KK", "KK", "YY", "YY"], &[(0, 1), (1, 1), (0, 2), (3, 1)]),
            // Two couplers, each with a terminal.
            (&["YKY", "KK", "YKY", "KK"], &[(0, 1), (0, 2), (2, 1)]),
            // Port 3 comes before port 1.
            (&["YYYY", "YY", "YY", "Y", "Y"], &[(0, 3), (1, 1), (2, 1), (0, 1)]),
            // A terminal with an E-bus port 3 behind an Ethernet port 1.
            (&["YY K", "KK", "YY"], &[(0, 3), (0, 1)]),
            // A junction terminal: first its sockets, then the terminals behind it.
            (&["YKY", "KYKY", "YY", "YY", "KK", "YY"], &[(0, 1), (1, 3), (2, 1), (1, 2), (0, 2)]),
            // No medium matches, like behind a media converter.
            (&["YY", "KK", "YY"], &[(0, 1), (1, 1)]),
        ] {
            let topology = Topology::by_order(&list(physics)).unwrap();
            assert_eq!(uplinks(&topology), expected, "{physics:?}");
        }
    }

    #[test]
    fn by_order_names_a_device_without_a_port() {
        let errors = Topology::by_order(&list(&["YY", "Y", "YY"])).unwrap_err();
        assert_eq!(errors, [TopologyError::NoPort { device: 2 }]);
    }

    #[test]
    #[rustfmt::skip] // one row a mistake
    fn connect_fulfils_requests_or_returns_the_reason() {
        use TopologyError as E;
        let bus = list(&["YKY", "KK", "YY", "KK", "YY"]);
        let request = |device: usize, after: usize, port: Option<u8>| {
            let mut requests = vec![None; 5];
            requests[device] = Some(PortRequest { after, port, shared: false });
            Topology::connect(&bus, &requests)
        };
        assert_eq!(uplinks(&request(2, 0, Some(2)).unwrap())[1], (0, 2));
        assert_eq!(uplinks(&request(2, 0, None).unwrap())[1], (0, 2));
        for (wished, error) in [
            (request(2, 2, Some(1)), E::NotBefore { device: 2, after: 2 }),
            (request(2, 9, None), E::NotBefore { device: 2, after: 9 }),
            (request(2, 0, Some(0)), E::Upstream { device: 2, after: 0 }),
            (request(2, 0, Some(3)), E::NoSuchPort { device: 2, after: 0, port: 3 }),
            (request(2, 0, Some(77)), E::NoSuchPort { device: 2, after: 0, port: 77 }),
            (request(3, 0, Some(1)), E::Taken { device: 3, after: 0, port: 1, by: 1 }),
            (request(2, 1, Some(1)), E::OtherMedium { device: 2, after: 1, port: 1 }),
            (request(2, 1, None), E::NoPortAt { device: 2, after: 1 }),
            // Frames pass the port of the terminal before the drive at the second socket of the
            // coupler.
            (request(3, 1, Some(1)), E::OutOfOrder { device: 3, after: 1, port: 1, by: 2 }),
        ] {
            assert_eq!(wished.unwrap_err(), [error]);
        }
    }

    #[test]
    #[rustfmt::skip] // one row a request
    fn connect_returns_every_invalid_request() {
        let bus = list(&["YY", "YY", "YY"]);
        let request = |after, port| Some(PortRequest { after, port, shared: false });
        let errors =
            Topology::connect(&bus, &[None, request(0, Some(2)), request(0, Some(0))]).unwrap_err();
        assert_eq!(errors.len(), 2);
    }

    #[test]
    fn closed_connects_the_ring_at_the_last_port() {
        let end = |physics: &[&str]| {
            let bus = list(physics);
            let topology = Topology::by_order(&bus).unwrap();
            topology.closed(&bus, SecondPort::Listens).map(|t| t.ring)
        };
        let at = |device, port| Ok(Some((Uplink { device, port }, SecondPort::Listens)));
        assert_eq!(end(&["YY", "YY"]), at(1, 1));
        // Behind E-bus terminals, the way back leads through the coupler.
        assert_eq!(end(&["YKY", "KK"]), at(0, 2));
        assert_eq!(end(&["YY", "Y"]), Err(TopologyError::NoPortForRing));
    }
}
