//! The line of devices: a frame's way through all of them and back, with the time it takes.

use crate::Nanos;
use crate::device::SimDevice;
use crate::faults::{FaultScript, Faults};
use crate::frame;

#[derive(Debug, Clone)]
pub struct SegmentOptions {
    /// Seed of everything random, unless the fault script brings its own.
    pub seed: u64,
    /// Propagation on each cable, one way.
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
    /// Completely received by the MainDevice at this time.
    Back {
        at: Nanos,
    },
}

/// A line of SubDevices; time starts with the first frame or step.
#[derive(Debug)]
pub struct Segment {
    devices: Vec<SimDevice>,
    cable_ns: u64,
    faults: Faults,
    /// The caller's time that is this world's 0.
    epoch: Option<Nanos>,
    /// A frame cannot leave before the one in front of it has.
    wire_free: Nanos,
    latest: Nanos,
    /// Arrival at port 0 of each device, of the frame under way.
    arrivals: Vec<Nanos>,
    latched: Vec<bool>,
    reach: usize,
}

impl Segment {
    #[must_use]
    pub fn new(devices: Vec<SimDevice>, options: SegmentOptions) -> Self {
        let n = devices.len();
        let mut segment = Self {
            cable_ns: options.cable_ns,
            faults: Faults::new(options.seed),
            epoch: None,
            wire_free: 0,
            latest: 0,
            arrivals: vec![0; n],
            latched: vec![false; n],
            reach: n,
            devices,
        };
        segment.update_links();
        segment
    }

    /// Replaces the faults; times in the script count from the segment's first frame or step.
    pub fn set_faults(&mut self, script: FaultScript) {
        self.faults.set(script);
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
        self.devices.get_mut(position)
    }

    /// The caller's time as true time of the simulated world.
    #[must_use]
    pub fn world_time(&self, now: Nanos) -> Nanos {
        now.saturating_sub(self.epoch.unwrap_or(now))
    }

    /// Lets devices, clocks and faults run up to `now`.
    pub fn advance(&mut self, now: Nanos) {
        let epoch = *self.epoch.get_or_insert(now);
        let to = now.saturating_sub(epoch).max(self.latest);
        // Faults strike at their own time, not at the next frame.
        while let Some(at) = self.faults.next_change(self.latest, to) {
            self.run_to(at);
            self.apply_faults(at);
        }
        self.run_to(to);
    }

    fn run_to(&mut self, to: Nanos) {
        for device in &mut self.devices {
            device.advance(to);
        }
        self.latest = self.latest.max(to);
    }

    fn apply_faults(&mut self, at: Nanos) {
        self.faults.apply(at, &mut self.devices);
        self.update_links();
    }

    /// How far the line reaches, and each device's port 1.
    fn update_links(&mut self) {
        let present = self.faults.present(self.devices.len());
        for (n, device) in self.devices.iter_mut().enumerate() {
            device.esc.set_link(n + 1 < present);
        }
        let closed = self
            .devices
            .iter()
            .position(|device| device.esc.port1_forced_closed());
        self.reach = closed.map_or(present, |n| present.min(n + 1));
    }

    /// The frame's walk through every device and back, sent at `now` (never decreasing). In place.
    pub fn transit(&mut self, bytes: &mut [u8], now: Nanos) -> Transit {
        self.advance(now);
        let epoch = self.epoch.unwrap_or(now);
        let start = now.saturating_sub(epoch).max(self.wire_free);
        let wire = frame::wire_time(bytes.len());
        self.wire_free = start + wire;
        let loss = self.faults.lose();
        if loss.on_the_way_out || self.reach == 0 {
            return Transit::Lost;
        }
        let back = self.walk(bytes, start);
        if loss.on_the_way_back {
            return Transit::Lost;
        }
        // SubDevices mark what they pass on: the source address becomes a local one.
        if let Some(source) = bytes.get_mut(6) {
            *source |= 0x02;
        }
        Transit::Back {
            at: epoch + back + wire,
        }
    }

    /// First byte sent at `start`; returns when it comes back.
    fn walk(&mut self, bytes: &mut [u8], start: Nanos) -> Nanos {
        let valid = frame::is_valid(bytes);
        let mut at = start + self.cable_ns;
        let reach = self.reach;
        for (n, device) in self.devices.iter_mut().enumerate().take(reach) {
            device.advance(at);
            let latched = valid && device.process(bytes, at);
            if let (Some(arrival), Some(latch)) =
                (self.arrivals.get_mut(n), self.latched.get_mut(n))
            {
                (*arrival, *latch) = (at, latched);
            }
            at += device.delay_ns + if n + 1 < reach { self.cable_ns } else { 0 };
        }
        // The way back: only port 1 receive times are left to note.
        for n in (0..reach).rev() {
            if n + 1 < reach {
                at += self.cable_ns;
                if self.latched.get(n) == Some(&true)
                    && let Some(device) = self.devices.get_mut(n)
                {
                    device.esc.latch_return(at);
                }
                at += self.devices.get(n).map_or(0, |device| device.delay_ns);
            }
        }
        let mut changed = false;
        for device in &mut self.devices {
            changed |= device.esc.take_loop_control();
        }
        if changed {
            self.update_links();
        }
        at + self.cable_ns
    }
}
