//! The processing of a frame in device after device.

use std::cmp::Ordering;

use super::route::{Destination, PortPass, Route};
use super::wiring::End;
use super::{Nic, Segment};
use crate::Nanos;
use crate::device::{FrameEffects, SimDevice};
use crate::faults::BitFlip;
use crate::frame::{self, Datagram, Kind};

/// Devices that advance together before the frame visits them. Their motors turn together, and
/// their data are still in the cache when the frame arrives.
const STRETCH: usize = 4;

impl Segment {
    /// Processes a frame whose first bit is sent at `start`. Returns false if a device destroys the
    /// frame. Devices without a visit advance to `to`.
    pub(super) fn walk(&mut self, nic: Nic, bytes: &mut [u8], start: Nanos, to: Nanos) -> bool {
        let kind = frame::kind(bytes);
        let straight = self.routes[nic as usize].straight && kind == Kind::EtherCat;
        if !straight {
            self.run_to(to);
        }
        self.latest = self.latest.max(to);
        let route = &self.routes[nic as usize];
        match kind {
            Kind::EtherCat => {}
            Kind::Foreign => return !route.ethercat_only,
            Kind::Malformed => {
                for visit in &route.visits {
                    if let Some(device) = self.devices.get_mut(visit.device) {
                        device.esc.count_processing_error();
                    }
                }
                mark(route, bytes);
                return true;
            }
        }
        self.read(bytes, kind);
        let latches = if straight {
            self.walk_straight(nic, bytes, start, to)
        } else {
            match self.walk_around(nic, bytes, start) {
                Some(latches) => latches,
                None => return false,
            }
        };
        let route = &self.routes[nic as usize];
        if latches {
            latch(&route.passes, &self.latches, &mut self.devices, start);
            self.latches.fill(false);
        }
        mark(route, bytes);
        true
    }

    /// Parses the datagrams of a frame.
    fn read(&mut self, bytes: &[u8], kind: Kind) {
        self.datagrams.clear();
        let mut datagram = frame::next(bytes, None).filter(|_| kind == Kind::EtherCat);
        while let Some(d) = datagram {
            datagram = frame::next(bytes, Some(&d));
            self.datagrams.push(d);
        }
    }

    /// Processes the frame in the devices in order. Returns true if receive times are to be
    /// latched.
    fn walk_straight(&mut self, nic: Nic, bytes: &mut [u8], start: Nanos, to: Nanos) -> bool {
        let visits = &self.routes[nic as usize].visits;
        let (visited, others) = self.devices.split_at_mut(visits.len());
        let (rests, other_rests) = self.rests.split_at_mut(visits.len());
        SimDevice::advance_together(others, other_rests, |_| to);
        let to_stations = self.datagrams.iter().all(Datagram::is_to_station);
        let mut latches = false;
        let stretches = visited
            .chunks_mut(STRETCH)
            .zip(rests.chunks_mut(STRETCH))
            .zip(visits.chunks(STRETCH));
        for ((devices, rests), visits) in stretches {
            SimDevice::advance_together(devices, rests, |n| {
                start + visits.get(n).map_or(0, |visit| visit.after)
            });
            for ((device, rest), visit) in devices.iter_mut().zip(rests).zip(visits) {
                let at = start + visit.after;
                if to_stations && device.is_passed(rest, bytes, &self.datagrams, at) {
                    continue;
                }
                device.disturb(rest);
                let seen = device.process(bytes, &self.datagrams, at);
                self.settles |= seen.dl_control;
                if seen.latches
                    && let Some(latch) = self.latches.get_mut(visit.device)
                {
                    (*latch, latches) = (true, true);
                }
            }
        }
        latches
    }

    /// Processes the frame in the devices along the cables. Returns true if receive times are to be
    /// latched, and `None` if a circulating frame was destroyed.
    fn walk_around(&mut self, nic: Nic, bytes: &mut [u8], start: Nanos) -> Option<bool> {
        let mut latches = false;
        for visit in &self.routes[nic as usize].visits {
            if visit.marks_circulating && !frame::circulate(bytes) {
                self.latches.fill(false);
                return None;
            }
            let Some(device) = self.devices.get_mut(visit.device) else {
                continue;
            };
            if let Some(rest) = self.rests.get_mut(visit.device) {
                device.disturb(rest);
            }
            let at = start + visit.after;
            device.advance(at);
            let seen = device.process(bytes, &self.datagrams, at);
            self.settles |= seen.dl_control;
            if seen.latches
                && let Some(latch) = self.latches.get_mut(visit.device)
            {
                (*latch, latches) = (true, true);
            }
        }
        Some(latches)
    }

    /// Returns the index of the port pass that detects the error first. The number of passes stands
    /// for the MainDevice itself. `None` if the frame does not pass the location.
    pub(super) fn corrupted_pass(&self, nic: Nic, at: BitFlip) -> Option<usize> {
        let passes = &self.routes[nic as usize].passes;
        match at {
            BitFlip::At { device, port } => passes
                .iter()
                .position(|pass| pass.device == device && pass.port == port),
            BitFlip::Somewhere(lot) => usize::try_from(lot % (passes.len() as u64 + 1)).ok(),
        }
    }

    /// Returns the index of the port pass at which a cable loses its link before the frame has passed
    /// it, as [`Segment::corrupted_pass`] does.
    pub(super) fn cut_pass(&self, nic: Nic, start: Nanos, wire: Nanos) -> Option<usize> {
        let route = &self.routes[nic as usize];
        let end = start + route.time + wire;
        if self.next_change >= end {
            return None;
        }
        let back = match route.goal {
            Destination::Back(nic) => Some((End::MainDevice(nic), route.time)),
            Destination::Nowhere | Destination::Closed { .. } => None,
        };
        let passes = route.passes.iter().map(|pass| {
            let (device, port) = (pass.device, pass.port);
            (End::Port { device, port }, pass.after)
        });
        let mut arrivals = passes.chain(back);
        let cuts = || self.faults.cuts_before(end);
        arrivals.position(|(at, after)| {
            let cable = self
                .wiring
                .cable(at)
                .and_then(|n| self.wiring.cables.get(n));
            let ends = cable.map_or(&[][..], |cable| &cable.ends);
            cuts().any(|cut| start + after + wire > cut.at && ends.iter().any(|end| cut.hits(*end)))
        })
    }

    /// Like [`Segment::walk`] up to port pass `first`. From there on, devices only count the frame.
    /// The first port marks it, so later ports count a forwarded error.
    pub(super) fn walk_corrupted(
        &mut self,
        nic: Nic,
        bytes: &mut [u8],
        start: Nanos,
        first: usize,
    ) {
        let kind = frame::kind(bytes);
        self.disturb();
        self.read(bytes, kind);
        let route = &self.routes[nic as usize];
        for (n, pass) in route.passes.iter().enumerate() {
            let Some(device) = self.devices.get_mut(pass.device) else {
                continue;
            };
            let at = start + pass.after;
            device.advance(at);
            match n.cmp(&first) {
                Ordering::Less => {}
                Ordering::Equal => device.esc.count_rx_error(pass.port),
                Ordering::Greater => device.esc.count_forwarded_error(pass.port),
            }
            let processed = pass.processed && kind == Kind::EtherCat && n < first;
            let seen = if processed {
                device.process(bytes, &self.datagrams, at)
            } else {
                FrameEffects::default()
            };
            if pass.processed && !processed {
                device.esc.count_processing_error();
            }
            self.settles |= seen.dl_control;
            if let Some(latch) = self.latches.get_mut(pass.device) {
                *latch |= seen.latches;
            }
        }
        let before = route.passes.get(..first).unwrap_or_default();
        latch(before, &self.latches, &mut self.devices, start);
        self.latches.fill(false);
    }
}

/// Marks the source address as locally administered, as SubDevices do.
fn mark(route: &Route, bytes: &mut [u8]) {
    if route.ethercat_only
        && let Some(source) = bytes.get_mut(6)
    {
        *source |= 0x02;
    }
}

/// Latches the receive times at the ports of the devices that the frame requested.
fn latch(passes: &[PortPass], latches: &[bool], devices: &mut [SimDevice], start: Nanos) {
    for pass in passes {
        if latches.get(pass.device) == Some(&true)
            && let Some(device) = devices.get_mut(pass.device)
        {
            let at = start + pass.after;
            device.esc.latch_port(pass.port, at, pass.processed);
        }
    }
}
