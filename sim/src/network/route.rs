//! The path of a frame through ports and processing units. It is computed on each change of links
//! or loops, so a frame only follows it.

use super::topology::SecondPort;
use super::wiring::{End, Nic, Wiring};
use crate::Nanos;
use crate::device::SimDevice;
use crate::esc::ports::{Medium, PORTS};

/// The delay through a device and out of a port with a PHY in ns, with both PHYs of the cable.
const MII_NS: u64 = 500;
/// The delay through a device and out of an E-bus port in ns. Captures of a coupler with terminals
/// show 145 to 155 ns from one device to the next.
const EBUS_NS: u64 = 150;

/// A pass through the processing unit of a device, `after` ns after the frame was sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Visit {
    pub(super) device: usize,
    pub(super) after: Nanos,
    /// True if port 0 has lost its link. A second pass then ends the frame.
    pub(super) marks_circulating: bool,
}

/// An arrival at a port, `after` ns after the frame was sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct PortPass {
    pub(super) device: usize,
    pub(super) port: u8,
    pub(super) after: Nanos,
    /// True if the frame enters the processing unit.
    pub(super) processed: bool,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) enum Destination {
    /// Out of an open port without a link.
    #[default]
    Nowhere,
    Back(Nic),
    /// At a port with a closed loop.
    Closed {
        device: usize,
        port: u8,
    },
}

#[derive(Debug, Default)]
pub(super) struct Route {
    pub(super) visits: Vec<Visit>,
    pub(super) passes: Vec<PortPass>,
    pub(super) goal: Destination,
    /// The time in ns from the first bit out to the first bit in.
    pub(super) time: Nanos,
    /// True if the visits are to the first devices in order, once each, without a circulating mark.
    pub(super) straight: bool,
    /// True if a device on the path destroys frames other than EtherCAT and marks the others.
    pub(super) ethercat_only: bool,
}

/// Returns the next port in the order of processing.
fn next(port: u8) -> u8 {
    match port {
        0 => 3,
        3 => 1,
        1 => 2,
        _ => 0,
    }
}

impl Route {
    pub(super) fn trace(&mut self, from: Nic, wiring: &Wiring, devices: &[SimDevice]) {
        self.follow(from, wiring, devices);
        let mut visits = self.visits.iter().enumerate();
        self.straight = visits.all(|(n, visit)| visit.device == n && !visit.marks_circulating);
    }

    fn follow(&mut self, from: Nic, wiring: &Wiring, devices: &[SimDevice]) {
        self.visits.clear();
        self.passes.clear();
        self.ethercat_only = false;
        self.time = 0;
        self.goal = Destination::Nowhere;
        if from == Nic::Secondary && wiring.second == SecondPort::Reflects {
            // The second port has no sender.
            return;
        }
        let mut leaves = End::MainDevice(from);
        // No port is reached twice: each port has one cable, and each loop has one path.
        for _ in 0..=PORTS * devices.len() + 2 {
            let Some((arrives, ns)) = wiring.other_end(leaves) else {
                return;
            };
            self.time = self.time.saturating_add(ns);
            leaves = match arrives {
                End::MainDevice(Nic::Secondary) if wiring.second == SecondPort::Reflects => arrives,
                End::MainDevice(nic) => {
                    self.goal = Destination::Back(nic);
                    return;
                }
                End::Port { device, port } => {
                    let Some(esc) = devices.get(device).map(|d| d.esc()) else {
                        return;
                    };
                    if !esc.port_open(port) {
                        self.goal = Destination::Closed { device, port };
                        return;
                    }
                    self.through(device, port, devices)
                }
            };
        }
        self.goal = Destination::Nowhere;
    }

    /// Follows the frame through a device to its next open port.
    fn through(&mut self, device: usize, arrived: u8, devices: &[SimDevice]) -> End {
        let pass = self.passes.len();
        self.passes.push(PortPass {
            device,
            port: arrived,
            after: self.time,
            processed: false,
        });
        let Some(sim) = devices.get(device) else {
            return End::Port {
                device,
                port: arrived,
            };
        };
        let mut processed = 0;
        let mut port = arrived;
        loop {
            if port == 0 {
                if let Some(pass) = self.passes.get_mut(pass) {
                    pass.processed = true;
                }
                self.visits.push(Visit {
                    device,
                    after: self.time,
                    marks_circulating: sim.esc().marks_circulating(),
                });
                self.ethercat_only |= sim.esc().destroys_foreign();
                processed = sim.delays.processing_ns;
            }
            port = next(port);
            if port == arrived || sim.esc().port_open(port) {
                break;
            }
        }
        let usual = match sim.esc().media().get(usize::from(port)) {
            Some(Medium::Ebus) => EBUS_NS,
            _ => MII_NS,
        };
        let delay = sim.delays.forwarding_ns.unwrap_or(usual);
        let sooner = sim.esc().fifo_reduction_ns(arrived);
        let through = delay.saturating_add(processed).saturating_sub(sooner);
        self.time = self.time.saturating_add(through);
        End::Port { device, port }
    }
}
