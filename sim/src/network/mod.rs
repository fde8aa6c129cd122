//! The network: devices, the cables between their ports, and a frame's way through them.
//!
//! * [`topology`]: which port leads to which device
//! * `wiring`: the cables, and whether they carry anything
//! * `route`: the way of a frame, worked out whenever links or loops change
//! * `walk`: a frame on its way from device to device
//!
//! A frame is followed from end to end at once, with the time at which it passes each device; what
//! it does there takes effect in that order.

mod route;
pub mod topology;
mod walk;
mod wiring;

use crate::Nanos;
use crate::device::{Rest, SimDevice};
use crate::esc::al::AlState;
use crate::esc::ports::Medium;
use crate::esc::registers as reg;
use crate::faults::{FaultReport, FaultScript, Faults};
use crate::frame::{self, Datagram, FrameBuilder};
use route::{Goal, Route};
use topology::Topology;
pub use wiring::Nic;
use wiring::{End, Wiring};

#[derive(Debug, Clone)]
pub struct SegmentOptions {
    /// Seed of everything random, unless the fault script brings its own.
    pub seed: u64,
    /// Propagation on each cable, one way, unless the topology says otherwise; contacts of the
    /// E-bus take 5 ns.
    pub cable_ns: u64,
}

impl Default for SegmentOptions {
    fn default() -> Self {
        Self {
            seed: 1,
            cable_ns: 25,
        }
    }
}

/// What became of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Transit {
    Lost,
    Back {
        /// Completely received by the MainDevice at this time.
        at: Nanos,
        /// The port of the MainDevice that received it.
        nic: Nic,
        /// The same frame arrives a second time.
        again: Option<Nanos>,
    },
}

/// As many as a frame can carry.
const DATAGRAMS: usize = 128;

/// A bus of SubDevices; time starts with the first frame or step.
#[derive(Debug)]
pub struct Segment {
    devices: Vec<SimDevice>,
    topology: Topology,
    wiring: Wiring,
    /// From the MainDevice's first and second port.
    routes: [Route; 2],
    /// Switched off by hand; faults do so on their own account.
    off: Vec<bool>,
    faults: Faults,
    /// The caller's time that is this world's 0.
    epoch: Option<Nanos>,
    /// At each port, a frame cannot leave before the one in front of it has.
    wire_free: [Nanos; 2],
    latest: Nanos,
    /// Nothing happens to the network by itself before.
    next_change: Nanos,
    /// Per device.
    rests: Vec<Rest>,
    /// Of the frame under way.
    datagrams: Vec<Datagram>,
    /// Per device: the frame under way latches receive times.
    latches: Vec<bool>,
    /// The frame under way wrote DL control.
    settles: bool,
    /// Another MainDevice's frame on its way to ours, and when it arrives.
    overheard: Option<(Nanos, Vec<u8>)>,
}

impl Segment {
    /// Devices at the ports that [`Topology::by_order`] finds for them; one that finds none is not
    /// connected.
    #[must_use]
    pub fn new(devices: Vec<SimDevice>, options: SegmentOptions) -> Self {
        let topology = Topology::possible(&topology::media(&devices));
        Self::with_topology(devices, topology, options)
    }

    #[must_use]
    pub fn with_topology(
        devices: Vec<SimDevice>,
        topology: Topology,
        options: SegmentOptions,
    ) -> Self {
        let n = devices.len();
        let mut segment = Self {
            wiring: Wiring::new(&topology, &devices, options.cable_ns),
            topology,
            routes: Default::default(),
            off: vec![false; n],
            faults: Faults::new(options.seed),
            epoch: None,
            wire_free: [0; 2],
            latest: 0,
            next_change: Nanos::MAX,
            rests: vec![Rest::default(); n],
            datagrams: Vec::with_capacity(DATAGRAMS),
            latches: vec![false; n],
            settles: false,
            overheard: None,
            devices,
        };
        segment.relink();
        segment
    }

    /// Replaces the faults; times in the script count from the segment's first frame or step.
    pub fn set_faults(&mut self, script: FaultScript) {
        self.faults.set(script);
        self.schedule();
    }

    /// Replaces the faults; times in the script count from the caller's `now`.
    pub fn start_faults(&mut self, mut script: FaultScript, now: Nanos) {
        let begin = self.world_time(now).max(self.latest);
        script.delay(begin);
        self.set_faults(script);
    }

    /// What has become of every fault of the script.
    pub fn fault_reports(&self) -> impl Iterator<Item = FaultReport> + '_ {
        self.faults.reports()
    }

    #[must_use]
    pub fn len(&self) -> usize {
        self.devices.len()
    }

    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.devices.is_empty()
    }

    #[must_use]
    pub fn device(&self, position: usize) -> Option<&SimDevice> {
        self.devices.get(position)
    }

    pub fn device_mut(&mut self, position: usize) -> Option<&mut SimDevice> {
        let device = self.devices.get_mut(position)?;
        device.disturb(self.rests.get_mut(position)?);
        Some(device)
    }

    #[must_use]
    pub fn topology(&self) -> &Topology {
        &self.topology
    }

    /// How long a frame takes from the MainDevice's first port to a device's processing unit, first
    /// bit to first bit; `None` where it does not come there.
    #[must_use]
    pub fn delay_ns(&self, device: usize) -> Option<Nanos> {
        let route = self.routes.first()?;
        let visit = route.visits.iter().find(|visit| visit.device == device);
        visit.map(|visit| visit.after)
    }

    /// Pulls the cable at a port, or plugs it in again; false where there is none.
    pub fn plug(&mut self, device: usize, port: u8, plugged: bool) -> bool {
        let cable = self.wiring.cable(End::Port { device, port });
        let Some(cable) = cable.and_then(|n| self.wiring.cables.get_mut(n)) else {
            return false;
        };
        cable.pulled = !plugged;
        self.relink();
        true
    }

    /// Takes a device's power, or gives it back: it starts in Init. Devices that it feeds through the
    /// E-bus go with it.
    pub fn power(&mut self, device: usize, on: bool) {
        if let Some(off) = self.off.get_mut(device) {
            *off = !on;
            self.relink();
        }
    }

    /// Puts another device in a device's place, powered on, and returns the old one.
    pub fn swap(&mut self, device: usize, other: SimDevice) -> Option<SimDevice> {
        let was_off = *self.off.get(device)?;
        self.power(device, false);
        let old = std::mem::replace(self.devices.get_mut(device)?, other);
        if let Some(new) = self.devices.get_mut(device) {
            new.power_off();
        }
        self.power(device, !was_off);
        Some(old)
    }

    /// The caller's time as true time of the simulated world.
    #[must_use]
    pub fn world_time(&self, now: Nanos) -> Nanos {
        now.saturating_sub(self.epoch.unwrap_or(now))
    }

    /// Lets devices, clocks and faults run up to `now`.
    pub fn advance(&mut self, now: Nanos) {
        let to = self.strike(now);
        self.run_to(to);
    }

    /// Lets everything up to `now` happen but what devices do after the last fault until then. Returns `now` as true
    /// time.
    fn strike(&mut self, now: Nanos) -> Nanos {
        let epoch = *self.epoch.get_or_insert(now);
        let to = now.saturating_sub(epoch).max(self.latest);
        // Faults strike at their own time, not at the next frame.
        while self.next_change <= to {
            let at = self.next_change.max(self.latest);
            self.run_to(at);
            self.change(at);
        }
        to
    }

    fn run_to(&mut self, to: Nanos) {
        SimDevice::advance_together(&mut self.devices, &mut self.rests, |_| to);
        self.latest = self.latest.max(to);
    }

    /// Whatever was known of devices at rest is known no longer.
    fn disturb(&mut self) {
        for (device, rest) in self.devices.iter_mut().zip(&mut self.rests) {
            device.disturb(rest);
        }
    }

    /// Faults begin or end, temporary settings run out.
    fn change(&mut self, at: Nanos) {
        self.disturb();
        self.faults.apply(at, &mut self.devices);
        for device in self.faults.take_replaced() {
            self.power_cycle(device);
        }
        for device in &mut self.devices {
            device.esc.revert_ports(at);
        }
        self.relink();
        self.schedule();
    }

    fn power_cycle(&mut self, device: usize) {
        let was_off = self.off.get(device).copied().unwrap_or(true);
        self.power(device, false);
        self.power(device, !was_off);
    }

    fn schedule(&mut self) {
        let reverts = self.devices.iter().filter_map(|d| d.esc.ports_due());
        let next = reverts.chain(self.faults.next_change()).min();
        self.next_change = next.unwrap_or(Nanos::MAX);
    }

    /// Power, then links, then the ways of frames follow from what is plugged in and switched on.
    fn relink(&mut self) {
        self.disturb();
        for n in 0..self.devices.len() {
            let switched = !self.off.get(n).is_none_or(|off| *off) && !self.faults.is_off(n);
            let fed = self.topology.uplink(n).is_none_or(|up| {
                let own = self.devices.get(n).map(|d| d.esc.media()[0]);
                let upper = self.devices.get(up.device);
                own != Some(Medium::Ebus) || upper.is_none_or(|upper| upper.powered)
            });
            let Some(device) = self.devices.get_mut(n) else {
                continue;
            };
            match (device.powered, switched && fed) {
                (true, false) => device.power_off(),
                (false, true) => device.power_on(self.latest),
                _ => {}
            }
        }
        let faults = &self.faults;
        for cable in &mut self.wiring.cables {
            let cut = cable.ends.iter().any(|end| match *end {
                End::MainDevice(nic) => nic == Nic::Primary && faults.is_silent(),
                End::Port { device, port } => faults.is_cut(device, port),
            });
            let powered = cable.ends.iter().all(|end| match *end {
                End::MainDevice(_) => true,
                End::Port { device, .. } => self.devices.get(device).is_some_and(|d| d.powered),
            });
            cable.up = powered && !cut && !cable.pulled;
            for end in cable.ends {
                if let End::Port { device, port } = end
                    && let Some(device) = self.devices.get_mut(device)
                {
                    device.esc.set_link(port, cable.up);
                }
            }
        }
        self.reroute();
    }

    fn reroute(&mut self) {
        for (route, nic) in self.routes.iter_mut().zip([Nic::Primary, Nic::Secondary]) {
            route.trace(nic, &self.wiring, &self.devices);
        }
    }

    /// The frame's walk through the devices and back, sent at `now` (never decreasing). In place.
    pub fn transit(&mut self, bytes: &mut [u8], now: Nanos) -> Transit {
        self.transit_from(Nic::Primary, bytes, now)
    }

    /// As [`Segment::transit`], sent from either port of the MainDevice; from the second it is lost where
    /// there is none or nobody listens.
    pub fn transit_from(&mut self, nic: Nic, bytes: &mut [u8], now: Nanos) -> Transit {
        let to = self.strike(now);
        let epoch = self.epoch.unwrap_or(now);
        let free = &mut self.wire_free[nic as usize];
        let start = now.saturating_sub(epoch).max(*free);
        let wire = frame::wire_time(bytes.len());
        *free = start + wire;
        let fate = self.faults.fate();
        if fate.lost_on_the_way_out {
            self.run_to(to);
            return Transit::Lost;
        }
        let came_through = match fate.corrupted.and_then(|at| self.corrupted_pass(nic, at)) {
            Some(pass) => {
                self.run_to(to);
                self.walk_corrupted(nic, bytes, start, pass);
                false
            }
            None => self.walk(nic, bytes, start, to),
        };
        let route = &self.routes[nic as usize];
        let (goal, back) = (route.goal, start + route.time + wire);
        if came_through
            && let Goal::Closed { device, port } = goal
            && let Some(device) = self.devices.get_mut(device)
        {
            device.esc.frame_at_closed_port(port);
            self.reroute();
        }
        self.settle(back);
        if let Some(state) = fate.other {
            self.other_main_device(nic, state, epoch);
        }
        match goal {
            Goal::Back(nic) if came_through && !fate.lost_on_the_way_back => {
                let at = (epoch + back).saturating_add(fate.delay);
                Transit::Back {
                    at,
                    nic,
                    again: fate.twice.then(|| at.saturating_add(wire)),
                }
            }
            _ => Transit::Lost,
        }
    }

    /// Another MainDevice at the same end of the wire sends a frame as soon as it is free: it reads AL status of all, or sends all to a
    /// state.
    fn other_main_device(&mut self, nic: Nic, state: Option<AlState>, epoch: Nanos) {
        let frame = FrameBuilder::from_source(OTHER);
        let mut frame = match state {
            Some(state) => frame.datagram(BWR, 0, reg::AL_CONTROL, &[state.code(), 0]),
            None => frame.datagram(BRD, 0, reg::AL_STATUS, &[0, 0]),
        }
        .build();
        let wire = frame::wire_time(frame.len());
        let free = &mut self.wire_free[nic as usize];
        let start = *free;
        *free = start + wire;
        let came_through = self.walk(nic, &mut frame, start, self.latest);
        let route = &self.routes[nic as usize];
        let back = start + route.time + wire;
        let returns = came_through && matches!(route.goal, Goal::Back(_));
        self.settle(back);
        self.overheard = returns.then_some((epoch + back, frame));
    }

    /// The last frame of another MainDevice that comes by the MainDevice's port, and when it is there completely.
    pub fn take_overheard(&mut self) -> Option<(Nanos, Vec<u8>)> {
        self.overheard.take()
    }

    /// DL control that the frame wrote takes effect when it is over.
    fn settle(&mut self, at: Nanos) {
        if !std::mem::take(&mut self.settles) {
            return;
        }
        for device in &mut self.devices {
            device.esc.settle_ports(at);
        }
        self.reroute();
        self.schedule();
    }
}

/// Another MainDevice's source address: its own, where others take one that says nothing.
const OTHER: [u8; 6] = [0x00, 0x1b, 0x21, 0x0e, 0xca, 0x75];
const BRD: u8 = 7;
const BWR: u8 = 8;
