//! A frame's way through ports and processing units, worked out whenever links or loops change, so
//! that a frame only has to follow it.

use super::topology::SecondPort;
use super::wiring::{End, Nic, Wiring};
use crate::Nanos;
use crate::device::SimDevice;
use crate::esc::ports::{Medium, PORTS};

/// Through a device and out of a port with a PHY at either end of the cable.
const MII_NS: u64 = 500;
/// Through a device and out of an E-bus port. Captured coupler and terminals, coupler included, take
/// 145 to 155 ns from one device to the next.
const EBUS_NS: u64 = 150;

/// A frame passes a device's processing unit, so long after it was sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Visit {
    pub(super) device: usize,
    pub(super) after: Nanos,
    /// Port 0 lost its link: the second pass is the last.
    pub(super) marks_circulating: bool,
}

/// A frame arrives at a port, so long after it was sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Pass {
    pub(super) device: usize,
    pub(super) port: u8,
    pub(super) after: Nanos,
    /// It goes on through the processing unit.
    pub(super) processed: bool,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) enum Goal {
    /// Out of an open port without a link.
    #[default]
    Nowhere,
    Back(Nic),
    /// At a port whose loop is closed.
    Closed {
        device: usize,
        port: u8,
    },
}

#[derive(Debug, Default)]
pub(super) struct Route {
    pub(super) visits: Vec<Visit>,
    pub(super) passes: Vec<Pass>,
    pub(super) goal: Goal,
    /// From the first bit out to the first bit in.
    pub(super) time: Nanos,
    /// The visits are to the first devices in their order, once each, and mark nothing.
    pub(super) straight: bool,
    /// A device on the way destroys frames that are not EtherCAT and marks the others.
    pub(super) ethercat_only: bool,
}

/// The port that follows in the order of processing.
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
        self.goal = Goal::Nowhere;
        if from == Nic::Secondary && wiring.second == SecondPort::Reflects {
            // Nobody is there to send.
            return;
        }
        let mut leaves = End::MainDevice(from);
        // No port is arrived at twice: every one has one cable, and every loop one way through.
        for _ in 0..=PORTS * devices.len() + 2 {
            let Some((arrives, ns)) = wiring.other_end(leaves) else {
                return;
            };
            self.time = self.time.saturating_add(ns);
            leaves = match arrives {
                End::MainDevice(Nic::Secondary) if wiring.second == SecondPort::Reflects => arrives,
                End::MainDevice(nic) => {
                    self.goal = Goal::Back(nic);
                    return;
                }
                End::Port { device, port } => {
                    let Some(esc) = devices.get(device).map(|d| d.esc()) else {
                        return;
                    };
                    if !esc.port_open(port) {
                        self.goal = Goal::Closed { device, port };
                        return;
                    }
                    self.through(device, port, devices)
                }
            };
        }
        self.goal = Goal::Nowhere;
    }

    /// From one open port to the next.
    fn through(&mut self, device: usize, arrived: u8, devices: &[SimDevice]) -> End {
        let pass = self.passes.len();
        self.passes.push(Pass {
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
