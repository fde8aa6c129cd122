//! The cables between ports and their links.

use super::topology::{SecondPort, Topology};
use crate::device::SimDevice;
use crate::esc::ports::{Medium, PORTS};
use crate::faults::Cut;

/// A port of the MainDevice.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Nic {
    /// The first port.
    Primary,
    /// The port at the other end of a ring.
    Secondary,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum End {
    MainDevice(Nic),
    Port { device: usize, port: u8 },
}

impl Cut {
    /// True if the cable at this end loses its link.
    pub(super) fn hits(self, end: End) -> bool {
        match (self.device, end) {
            (None, End::MainDevice(nic)) => nic == Nic::Primary,
            (Some(cut), End::Port { device, port }) => {
                cut == device && self.port.is_none_or(|cut| cut == port)
            }
            _ => false,
        }
    }
}

#[derive(Debug, Clone)]
pub(super) struct Cable {
    pub(super) ends: [End; 2],
    pub(super) ns: u64,
    /// True if the cable was unplugged by [`super::Segment::plug`], independent of faults.
    pub(super) pulled: bool,
    /// True if both ends have a link.
    pub(super) up: bool,
}

#[derive(Debug)]
pub(super) struct Wiring {
    pub(super) cables: Vec<Cable>,
    /// The cables at each port of each device; several at a shared port.
    at: Vec<[Vec<usize>; PORTS]>,
    nics: [Option<usize>; 2],
    pub(super) second: SecondPort,
}

/// The one-way delay between two E-bus contacts in ns.
const EBUS_NS: u64 = 5;

impl Wiring {
    pub(super) fn new(topology: &Topology, devices: &[SimDevice], cable_ns: u64) -> Self {
        let mut wiring = Self {
            cables: Vec::new(),
            at: vec![Default::default(); devices.len()],
            nics: [None; 2],
            second: SecondPort::Listens,
        };
        let ebus = |device: usize| {
            let device = devices.get(device);
            device.is_some_and(|d| d.esc().media()[0] == Medium::Ebus)
        };
        for (device, uplink) in topology.uplinks.iter().enumerate().take(devices.len()) {
            let upper = match uplink {
                Some(up) => End::Port {
                    device: up.device,
                    port: up.port,
                },
                None if device == 0 => End::MainDevice(Nic::Primary),
                None => continue,
            };
            let usual = if ebus(device) && uplink.is_some() {
                EBUS_NS
            } else {
                cable_ns
            };
            let own = topology.cable_ns.get(device).copied().flatten();
            let port = topology.inlets.get(device).copied().unwrap_or(0);
            wiring.lay(upper, End::Port { device, port }, own.unwrap_or(usual));
        }
        if let Some((last, second)) = topology.ring {
            let last = End::Port {
                device: last.device,
                port: last.port,
            };
            wiring.lay(last, End::MainDevice(Nic::Secondary), cable_ns);
            wiring.second = second;
        }
        wiring
    }

    fn lay(&mut self, a: End, b: End, ns: u64) {
        let n = self.cables.len();
        self.cables.push(Cable {
            ends: [a, b],
            ns,
            pulled: false,
            up: false,
        });
        for end in [a, b] {
            match end {
                End::MainDevice(nic) => self.nics[nic as usize] = Some(n),
                End::Port { device, port } => {
                    if let Some(at) = self
                        .at
                        .get_mut(device)
                        .and_then(|ports| ports.get_mut(usize::from(port)))
                    {
                        at.push(n);
                    }
                }
            }
        }
    }

    /// Returns the number of the cable at an end. Of several at a shared port, the one with a link.
    pub(super) fn cable(&self, end: End) -> Option<usize> {
        match end {
            End::MainDevice(nic) => self.nics[nic as usize],
            End::Port { device, port } => {
                let at = self.at.get(device)?.get(usize::from(port))?;
                let up = |n: &&usize| self.cables.get(**n).is_some_and(|cable| cable.up);
                at.iter().find(up).or(at.first()).copied()
            }
        }
    }

    /// Returns the destination of a frame that leaves at `end`, and the delay in ns.
    pub(super) fn other_end(&self, end: End) -> Option<(End, u64)> {
        let cable = self.cables.get(self.cable(end)?)?;
        let [a, b] = cable.ends;
        cable.up.then_some((if a == end { b } else { a }, cable.ns))
    }
}
