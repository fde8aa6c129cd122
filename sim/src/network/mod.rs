//! The network: devices, cables between their ports, and the path of frames.
//!
//! * [`topology`]: which port leads to which device
//! * `wiring`: the cables and their links
//! * `route`: the path of a frame, computed on each change of links or loops
//! * `walk`: the processing of a frame in device after device
//!
//! A frame is processed in one call, with the time of its arrival at each device. Its effects take
//! place in that order.
//!
//! ```
//! use ecaxis_sim::frame::FrameBuilder;
//! use ecaxis_sim::{DeviceOptions, FrameOutcome, Segment, SegmentOptions, SimDevice};
//!
//! let esi = ecaxis_esi::Device { physics: "YY".into(), ..Default::default() };
//! let device = SimDevice::from_esi(&esi, &[], DeviceOptions::default()).unwrap();
//! let mut segment = Segment::new(vec![device.clone(), device], SegmentOptions::default());
//! let frame = FrameBuilder::default().datagram(7, 0, 0x0130, &[0; 2]).build();
//!
//! let mut whole = frame.clone();
//! assert!(matches!(segment.transit(&mut whole, 0), FrameOutcome::Back { .. }));
//! assert_eq!(whole[whole.len() - 2..], [2, 0]); // working counter
//!
//! // Without the cable between the two, the first device returns the frame.
//! assert!(segment.plug(1, 0, false));
//! let mut broken = frame;
//! segment.transit(&mut broken, 1_000_000);
//! assert_eq!(broken[broken.len() - 2..], [1, 0]);
//! ```

mod route;
pub mod topology;
mod walk;
mod wiring;

use crate::Nanos;
use crate::device::{Rest, SimDevice};
use crate::esc::al::AlState;
use crate::esc::ports::Medium;
use crate::esc::registers as reg;
use crate::faults::{FaultProgress, FaultScript, Faults};
use crate::frame::{self, Datagram, FrameBuilder};
use route::{Destination, Route};
use topology::Topology;
pub use wiring::Nic;
use wiring::{End, Wiring};

/// The properties of a segment as a whole.
#[derive(Debug, Clone)]
pub struct SegmentOptions {
    /// The seed of all randomness, unless the fault script contains a seed.
    pub seed: u64,
    /// The one-way delay of each cable in ns, unless the topology defines one. E-bus contacts take
    /// 5 ns.
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

/// The result of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameOutcome {
    /// The frame does not return.
    Lost,
    /// The frame returns.
    Back {
        /// The time at which the MainDevice has received the complete frame.
        at: Nanos,
        /// The port of the MainDevice that received it.
        nic: Nic,
        /// The time at which the same frame arrives again.
        again: Option<Nanos>,
    },
}

/// The maximum number of datagrams in a frame.
const DATAGRAMS: usize = 128;

/// A segment of SubDevices. Its time starts with the first frame or step.
#[derive(Debug)]
pub struct Segment {
    devices: Vec<SimDevice>,
    topology: Topology,
    wiring: Wiring,
    /// The routes from the first and the second port of the MainDevice.
    routes: [Route; 2],
    /// Devices switched off by [`Segment::power`], independent of faults.
    off: Vec<bool>,
    faults: Faults,
    /// The caller's time at time 0 of the simulation.
    epoch: Option<Nanos>,
    /// Per port: the time at which the previous frame has left.
    wire_free: [Nanos; 2],
    latest: Nanos,
    /// The time of the next change of the network itself.
    next_change: Nanos,
    /// Per device.
    rests: Vec<Rest>,
    /// The datagrams of the current frame.
    datagrams: Vec<Datagram>,
    /// Per device: the current frame latches receive times.
    latches: Vec<bool>,
    /// True if the current frame wrote DL control.
    settles: bool,
    /// The frame of another MainDevice on its way to ours, and its arrival time.
    overheard: Option<(Nanos, Vec<u8>)>,
}

impl Segment {
    /// Creates a segment with the devices at the ports of [`Topology::by_order`]. A device without
    /// a suitable port stays unconnected.
    #[must_use]
    pub fn new(devices: Vec<SimDevice>, options: SegmentOptions) -> Self {
        let topology = Topology::possible(&topology::media(&devices));
        Self::with_topology(devices, topology, options)
    }

    /// Creates a segment with these connections. The topology has as many devices.
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

    /// Replaces the faults. Times in the script count from the first frame or step of the segment.
    pub fn set_faults(&mut self, script: FaultScript) {
        self.faults.set(script);
        self.schedule();
    }

    /// Replaces the faults. Times in the script count from the caller's `now`.
    pub fn start_faults(&mut self, mut script: FaultScript, now: Nanos) {
        let begin = self.world_time(now).max(self.latest);
        script.delay(begin);
        self.set_faults(script);
    }

    /// Returns the progress of every fault of the script.
    pub fn fault_progress(&self) -> impl Iterator<Item = FaultProgress> + '_ {
        self.faults.reports()
    }

    /// Returns the number of devices.
    #[must_use]
    pub fn len(&self) -> usize {
        self.devices.len()
    }

    /// True without devices.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.devices.is_empty()
    }

    /// Returns the device at this position, counted from 0.
    #[must_use]
    pub fn device(&self, position: usize) -> Option<&SimDevice> {
        self.devices.get(position)
    }

    /// Returns the device at this position to change it.
    pub fn device_mut(&mut self, position: usize) -> Option<&mut SimDevice> {
        let device = self.devices.get_mut(position)?;
        device.disturb(self.rests.get_mut(position)?);
        Some(device)
    }

    /// Returns the connections of the devices.
    #[must_use]
    pub fn topology(&self) -> &Topology {
        &self.topology
    }

    /// Returns the delay of a frame from the first port of the MainDevice to the processing unit of
    /// a device, first bit to first bit. `None` if the frame does not reach the device.
    #[must_use]
    pub fn delay_ns(&self, device: usize) -> Option<Nanos> {
        let route = self.routes.first()?;
        let visit = route.visits.iter().find(|visit| visit.device == device);
        visit.map(|visit| visit.after)
    }

    /// Unplugs the cable at a port, or plugs it in again. Returns false without a cable.
    pub fn plug(&mut self, device: usize, port: u8, plugged: bool) -> bool {
        let cable = self.wiring.cable(End::Port { device, port });
        let Some(cable) = cable.and_then(|n| self.wiring.cables.get_mut(n)) else {
            return false;
        };
        cable.pulled = !plugged;
        self.relink();
        true
    }

    /// Unplugs the cable at a port of the MainDevice, or plugs it in again.
    pub fn plug_main_device(&mut self, nic: Nic, plugged: bool) {
        let cable = self.wiring.cable(End::MainDevice(nic));
        let Some(cable) = cable.and_then(|n| self.wiring.cables.get_mut(n)) else {
            return;
        };
        if cable.pulled == plugged {
            cable.pulled = !plugged;
            self.relink();
        }
    }

    /// Switches a device off or on. A device that is switched on starts in Init. Devices that it
    /// powers through the E-bus follow.
    pub fn power(&mut self, device: usize, on: bool) {
        if let Some(off) = self.off.get_mut(device) {
            *off = !on;
            self.relink();
        }
    }

    /// Replaces a device by another, powered on, and returns the old one.
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

    /// Converts the caller's time to true time of the simulation.
    #[must_use]
    pub fn world_time(&self, now: Nanos) -> Nanos {
        now.saturating_sub(self.epoch.unwrap_or(now))
    }

    /// Advances devices, clocks and faults to `now`.
    pub fn advance(&mut self, now: Nanos) {
        let to = self.strike(now);
        self.run_to(to);
    }

    /// Applies faults and other network changes up to `now`. The devices advance only to the last
    /// change. Returns `now` as true time.
    fn strike(&mut self, now: Nanos) -> Nanos {
        let epoch = *self.epoch.get_or_insert(now);
        let to = now.saturating_sub(epoch).max(self.latest);
        // Faults occur at their own time, not at the next frame.
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

    /// Drops the cached facts about all devices.
    fn disturb(&mut self) {
        for (device, rest) in self.devices.iter_mut().zip(&mut self.rests) {
            device.disturb(rest);
        }
    }

    /// Starts and ends faults, and ends temporary loop settings.
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

    /// Updates power, then links, then routes from cables and switches.
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
        let mut linked = Vec::new();
        for cable in &mut self.wiring.cables {
            let cut = cable.ends.iter().any(|end| match *end {
                End::MainDevice(nic) => nic == Nic::Primary && faults.is_silent(),
                End::Port { device, port } => faults.is_cut(device, port),
            });
            let powered = cable.ends.iter().all(|end| match *end {
                End::MainDevice(_) => true,
                End::Port { device, .. } => self.devices.get(device).is_some_and(|d| d.powered),
            });
            // At a shared port, the first of the devices has the link.
            let taken = cable.ends.iter().any(|end| linked.contains(end));
            cable.up = powered && !cut && !cable.pulled && !taken;
            if cable.up {
                linked.extend(cable.ends);
            }
        }
        for end in self.wiring.cables.iter().flat_map(|cable| cable.ends) {
            if let End::Port { device, port } = end
                && let Some(device) = self.devices.get_mut(device)
            {
                device.esc.set_link(port, linked.contains(&end));
            }
        }
        self.reroute();
    }

    fn reroute(&mut self) {
        for (route, nic) in self.routes.iter_mut().zip([Nic::Primary, Nic::Secondary]) {
            route.trace(nic, &self.wiring, &self.devices);
        }
    }

    /// Sends a frame at `now` (never decreasing) through all devices and back, in place.
    pub fn transit(&mut self, bytes: &mut [u8], now: Nanos) -> FrameOutcome {
        self.transit_from(Nic::Primary, bytes, now)
    }

    /// Like [`Segment::transit`], from either port of the MainDevice. From the second port, the
    /// frame is lost if that port does not exist or does not listen.
    pub fn transit_from(&mut self, nic: Nic, bytes: &mut [u8], now: Nanos) -> FrameOutcome {
        let to = self.strike(now);
        let epoch = self.epoch.unwrap_or(now);
        let free = &mut self.wire_free[nic as usize];
        let start = now.saturating_sub(epoch).max(*free);
        let wire = frame::wire_time(bytes.len());
        *free = start + wire;
        let fate = self.faults.fate();
        if fate.lost_on_the_way_out {
            self.run_to(to);
            return FrameOutcome::Lost;
        }
        let corrupted = fate.corrupted.and_then(|at| self.corrupted_pass(nic, at));
        let cut = self.cut_pass(nic, start, wire);
        let first = [corrupted, cut].into_iter().flatten().min();
        let came_through = match first {
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
            && let Destination::Closed { device, port } = goal
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
            Destination::Back(nic) if came_through && !fate.lost_on_the_way_back => {
                let at = (epoch + back).saturating_add(fate.delay);
                FrameOutcome::Back {
                    at,
                    nic,
                    again: fate.twice.then(|| at.saturating_add(wire)),
                }
            }
            _ => FrameOutcome::Lost,
        }
    }

    /// Sends a frame of another MainDevice at the same end of the segment, as soon as the wire is
    /// free. It reads AL status of all devices, or requests a state from all.
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
        let returns = came_through && matches!(route.goal, Destination::Back(_));
        self.settle(back);
        self.overheard = returns.then_some((epoch + back, frame));
    }

    /// Returns the last frame of another MainDevice that passes the port of the MainDevice, and the
    /// time of its complete reception.
    pub fn take_overheard(&mut self) -> Option<(Nanos, Vec<u8>)> {
        self.overheard.take()
    }

    /// Applies a write to DL control after the end of the frame.
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

/// The source address of the other MainDevice: an individual address, unlike that of most
/// MainDevices.
const OTHER: [u8; 6] = [0x00, 0x1b, 0x21, 0x0e, 0xca, 0x75];
const BRD: u8 = 7;
const BWR: u8 = 8;
