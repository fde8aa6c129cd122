//! The topology of a segment, from the ports of its devices (DL status, 0x0110).
//!
//! A frame that arrives at port 0 leaves the other ports in the order 3, 1, 2 (Beckhoff ESC data
//! sheet, section I, 3.1). The device order is therefore a depth-first walk of the tree. Frames are
//! assumed to enter at port 0, as with correct cabling.

use crate::link::redundant::RingState;

/// The order in which frames pass the ports.
pub const PORT_ORDER: [u8; 4] = [0, 3, 1, 2];

/// The state of a port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Port {
    /// The cable, or the E-bus neighbour, is connected: bits 4 to 7.
    pub link: bool,
    /// Frames are forwarded and return: communication without a loop, two bits each from bit 8.
    pub open: bool,
}

/// A port that leads away from the MainDevice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ParentPort {
    /// The position of the device.
    pub device: u16,
    pub port: u8,
}

/// Returns the state of each port.
#[must_use]
pub fn ports(dl_status: u16) -> [Port; 4] {
    [0, 1, 2, 3].map(|n: u16| {
        let looped = dl_status >> (8 + 2 * n) & 1 != 0;
        let communicates = dl_status >> (9 + 2 * n) & 1 != 0;
        Port {
            link: dl_status >> (4 + n) & 1 != 0,
            open: !looped && communicates,
        }
    })
}

#[must_use]
pub fn open_ports(dl_status: u16) -> [bool; 4] {
    ports(dl_status).map(|port| port.open)
}

/// Returns `true` if the port has a physical link.
#[must_use]
pub fn has_link(dl_status: u16, port: u8) -> bool {
    ports(dl_status)
        .get(usize::from(port))
        .is_some_and(|port| port.link)
}

/// Returns the port that each device is connected to, in segment order. `None` for the first
/// device, and for devices without a free port, where the port states contradict each other.
#[must_use]
pub fn parents(dl_status: impl IntoIterator<Item = u16>) -> Vec<Option<ParentPort>> {
    let mut waiting: Vec<ParentPort> = Vec::new();
    let mut parents = Vec::new();
    for (device, status) in (0_u16..).zip(dl_status) {
        parents.push(waiting.pop());
        let open = open_ports(status);
        // `pop` takes the last port first, so the ports are pushed in reverse order.
        let behind = PORT_ORDER.into_iter().skip(1).rev();
        let behind = behind.filter(|port| open.get(usize::from(*port)) == Some(&true));
        waiting.extend(behind.map(|port| ParentPort { device, port }));
    }
    parents
}

/// Returns the position of the n-th device behind another one, on the same branch, in segment order.
#[must_use]
pub fn nth_behind(parents: &[Option<ParentPort>], head: u16, nth: u16) -> Option<u16> {
    let position = head.checked_add(nth)?;
    is_behind(parents, position, head).then_some(position)
}

/// Returns true if frames pass another device on their way to the one at a position.
#[must_use]
pub fn is_behind(parents: &[Option<ParentPort>], position: u16, other: u16) -> bool {
    let above = |at: u16| Some(parents.get(usize::from(at)).copied()??.device);
    // A parent is always nearer to the MainDevice.
    std::iter::successors(above(position), |at| above(*at)).any(|at| at == other)
}

/// Returns the DL status of the device at a position as if a broken ring were a line: the ports at
/// the break are open. The port in front of it is taken to be the usual one.
#[must_use]
pub fn in_line(position: u16, dl_status: u16, ring: Option<RingState>) -> u16 {
    let Some(RingState::Broken { behind, devices }) = ring else {
        return dl_status;
    };
    let open = |port: u16| dl_status & !(1 << (8 + 2 * port)) | 1 << (9 + 2 * port);
    if behind == 0 || behind >= devices {
        dl_status
    } else if position == behind {
        open(0)
    } else if position + 1 == behind {
        let closed = open_ports(dl_status).map(|open| !open);
        let port = [1, 2, 3]
            .into_iter()
            .find(|port| closed[usize::from(*port)]);
        port.map_or(dl_status, open)
    } else {
        dl_status
    }
}

/// Returns the open port that no device is connected to: in a closed ring, the one that leads to the
/// second interface. `None` if there are several.
#[must_use]
pub fn ring_end(dl_status: impl IntoIterator<Item = u16> + Clone) -> Option<ParentPort> {
    let parents = parents(dl_status.clone());
    let open = (0..).zip(dl_status).flat_map(|(device, status)| {
        let ports = (0..).zip(open_ports(status)).skip(1);
        ports.filter_map(move |(port, open)| open.then_some(ParentPort { device, port }))
    });
    let mut free = open.filter(|port| !parents.contains(&Some(*port)));
    free.next().filter(|_| free.next().is_none())
}

/// Returns the position of a device whose IN and OUT are swapped, so that frames enter it at
/// another port than port 0. Frames are then processed on their way back: the device comes after
/// those behind it, where no port is left for it. `None` if the ports do not show it.
#[must_use]
pub fn reversed(dl_status: impl IntoIterator<Item = u16>) -> Option<usize> {
    let parents = parents(dl_status);
    let alone = parents.iter().skip(1).position(Option::is_none)?;
    // More devices without a parent contradict one swapped device.
    let after = parents.get(alone + 2..).unwrap_or_default();
    after.is_empty().then_some(alone + 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Beckhoff ESC data sheet, section I, 3.1: the processing unit is between port 0 and port 3. A
    /// frame that enters at port 1 passes port 0 and all devices behind it first.
    #[test]
    fn reversed_returns_the_device_that_comes_after_those_behind_it() {
        let table: [(&[&[u8]], Option<usize>); 6] = [
            (&[], None),
            (&[&[0]], None),
            (&[&[0, 1], &[0, 1], &[0]], None),
            // The second of three is reversed.
            (&[&[0, 1], &[0], &[0, 1]], Some(2)),
            // The first of four.
            (&[&[0, 1], &[0, 1], &[0], &[0, 1]], Some(3)),
            (&[&[0], &[0], &[0]], None),
        ];
        for (devices, expected) in table {
            let found = reversed(devices.iter().map(|ports| open(ports)));
            assert_eq!(found, expected, "{devices:?}");
        }
    }

    /// Returns the DL status of a device with these ports open.
    fn open(ports: &[u8]) -> u16 {
        ports.iter().fold(0, |status, port| {
            status | 1 << (9 + 2 * port) | 1 << (4 + port)
        })
    }

    #[test]
    fn parents_finds_lines_and_junctions() {
        type Parent = Option<(u16, u8)>;
        let table: [(&[&[u8]], &[Parent]); 6] = [
            (&[], &[]),
            (&[&[0]], &[None]),
            (
                &[&[0, 1], &[0, 1], &[0]],
                &[None, Some((0, 1)), Some((1, 1))],
            ),
            // A junction: port 3 first, then 1, then 2.
            (
                &[&[0, 1, 2, 3], &[0, 1], &[0], &[0], &[0]],
                &[None, Some((0, 3)), Some((1, 1)), Some((0, 1)), Some((0, 2))],
            ),
            // Fewer open ports than devices.
            (&[&[0], &[0, 1]], &[None, None]),
            (&[&[0, 1], &[0], &[0]], &[None, Some((0, 1)), None]),
        ];
        for (devices, expected) in table {
            let found = parents(devices.iter().map(|ports| open(ports)));
            let found: Vec<Parent> = found
                .iter()
                .map(|p| p.map(|p| (p.device, p.port)))
                .collect();
            assert_eq!(found, expected, "{devices:?}");
        }
    }

    /// Rows of the table "DL status": link, loop, communication.
    #[test]
    fn ports_are_open_if_communicating_without_loop() {
        for (status, link, open) in [
            (0x5530, [true, true, false, false], [false; 4]),
            (
                0x5a30,
                [true, true, false, false],
                [true, true, false, false],
            ),
            (
                0x5610,
                [true, false, false, false],
                [true, false, false, false],
            ),
            (
                0x99b0,
                [true, true, false, true],
                [false, true, false, true],
            ),
        ] {
            assert_eq!(ports(status).map(|p| p.link), link, "0x{status:04x}");
            assert_eq!(open_ports(status), open, "0x{status:04x}");
        }
        assert!(has_link(0x0080, 3) && !has_link(0xff0f, 1) && !has_link(0xffff, 4));
    }
}
