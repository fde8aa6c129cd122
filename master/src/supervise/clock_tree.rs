//! Measures the propagation delays again after ports have opened or closed during operation
//! (ETG.1500, feature 1102). A frame reaches the devices after a branch earlier once that branch is
//! gone, and their clocks would run ahead by its round-trip delay.

use std::future::Future;
use std::sync::{Arc, PoisonError};
use std::time::Duration;

use ecaxis_ecat::index::{DeviceIndex, IndexVec};
use ecaxis_ecat::registers;
use tokio::sync::{Mutex, watch};

use super::Supervisor;
use crate::acyclic::topology::open_ports;
use crate::acyclic::{delays, enumerate};
use crate::bringup::RingDelays;
use crate::bringup::ring::measure_once;
use crate::clock;
use crate::datagram::DatagramClient;
use crate::link::redundant::RingState;
use crate::mailbox::MailboxTransport;
use crate::report::{Cause, Error};
use crate::rt::channel::Snapshot;
use crate::rt::exchange::DiagnosticRegister;

const STEP: &str = "measuring propagation delays";
/// A plug bounces: the ports must rest for this time.
const SETTLING_TIME: Duration = Duration::from_millis(100);
/// A difference in ns below this is noise of the receive times, and no delay is written.
const NOISE_NS: u32 = 40;

/// What the propagation delays depend on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ClockTree {
    /// The ports that forward frames.
    open: IndexVec<DeviceIndex, [bool; 4]>,
    /// In a ring: the number of devices in front of the break, if there is one.
    split: Option<u16>,
    reference: Option<DeviceIndex>,
}

impl Supervisor {
    /// Returns a task that measures the delays whenever [`ClockTree`] changes. It ends when
    /// [`Supervisor::clock_tree`] is dropped.
    pub(super) fn keep_delays(
        &mut self,
        latch: Arc<Mutex<()>>,
    ) -> impl Future<Output = ()> + use<> {
        let devices = self.bus.devices.iter();
        let tree = ClockTree {
            open: devices.map(|device| open_ports(device.dl_status)).collect(),
            split: self.bus.ring.and_then(RingState::split),
            reference: None,
        };
        let changes = self.bus.dc.as_ref().map(|_| {
            let (sender, changes) = watch::channel(tree);
            self.clock_tree = Some(sender);
            changes
        });
        let delays = self.delays(latch);
        async move {
            if let Some(changes) = changes {
                follow(&delays, changes).await;
            }
        }
    }

    pub(super) fn delays(&self, latch: Arc<Mutex<()>>) -> Delays {
        let devices = self.bus.devices.iter();
        Delays {
            wire: self.wire,
            clocks: devices
                .map(|device| (device.at.station, device.follows))
                .collect(),
            ring: self.ring_delays.clone(),
            latch,
        }
    }

    /// Passes on what the cycle has read of the ports.
    pub(super) fn follow_clock_tree(&self, snapshot: &Snapshot) {
        let Some(tree) = &self.clock_tree else {
            return;
        };
        let reference = snapshot.phase.and_then(|phase| phase.reference);
        tree.send_if_modified(|now| {
            let last = now.reference;
            now.reference = reference.or(last);
            let mut changed = last.is_some() && last != now.reference;
            if let Some(ring) = self.wire.ring() {
                // The ports open and close with it, and the last one for each measurement.
                return changed | (std::mem::replace(&mut now.split, ring.split()) != ring.split());
            }
            for (open, found) in now.open.iter_mut().zip(&snapshot.diagnoses) {
                if found.answers && found.has_read(DiagnosticRegister::DlStatus) {
                    let read = open_ports(found.dl_status);
                    changed |= std::mem::replace(open, read) != read;
                }
            }
            changed
        });
    }
}

/// The propagation delays in the devices.
#[derive(Debug)]
pub(super) struct Delays {
    wire: DatagramClient,
    /// The station address of each device, and whether its clock follows the reference clock.
    clocks: IndexVec<DeviceIndex, (u16, bool)>,
    /// Known in a ring: a measurement opens it.
    ring: Option<Arc<std::sync::Mutex<RingDelays>>>,
    /// Held while the receive times of all devices belong to one frame.
    latch: Arc<Mutex<()>>,
}

/// Updates the delays after each change, until the sender is dropped.
async fn follow(delays: &Delays, mut changes: watch::Receiver<ClockTree>) {
    while changes.changed().await.is_ok() {
        if delays.ring.is_none() {
            clock::delay(SETTLING_TIME).await;
        }
        if changes.has_changed().unwrap_or(true) {
            continue;
        }
        let reference = changes.borrow().reference;
        let still_valid = || !changes.has_changed().unwrap_or(true);
        let Some(reference) = reference else {
            continue;
        };
        match delays.update(reference, still_valid).await {
            Ok(true) => {}
            // A port may have changed and changed back between two reads of the cycle.
            Ok(false) => changes.mark_changed(),
            // The next change starts another update.
            Err(error) => tracing::info!("{error}"),
        }
    }
}

impl Delays {
    /// Determines all delays and writes those that have changed. Returns false, and writes nothing
    /// more, if the ports of a device have changed meanwhile: a plug bounces, and the delays belong
    /// to no topology.
    pub(super) async fn update(
        &self,
        reference: DeviceIndex,
        still_valid: impl Fn() -> bool,
    ) -> Result<bool, Error> {
        let Some(&(reference, _)) = self.clocks.get(reference) else {
            return Ok(true);
        };
        let wire = &self.wire;
        let (stations, measured) = match &self.ring {
            None => {
                let before = delays::devices(wire).await?;
                let measured = {
                    let _held = self.latch.lock().await;
                    delays::measure(wire, &before.1).await?
                };
                if delays::devices(wire).await? != before {
                    return Ok(false);
                }
                (before.0, measured)
            }
            Some(ring) => match self.delays_of_ring(ring).await? {
                Some(delays) => delays.into_iter().unzip(),
                None => return Ok(false),
            },
        };
        let measured = || stations.iter().copied().zip(&measured);
        let find = |wanted| measured().find(|(station, _)| *station == wanted);
        let Some((_, Some(first))) = find(reference) else {
            return Ok(true);
        };
        for (station, delay) in measured() {
            let follows = self.clocks.contains(&(station, true));
            let (Some(delay), true) = (delay, follows && station != reference) else {
                continue;
            };
            let delay = delay.saturating_sub(*first);
            let failed = |error| Error::from(Cause::Datagram(error)).with_action(STEP);
            let mut written = [0; 4];
            let register = registers::DC_SYSTEM_TIME_DELAY;
            let read = wire.read(station, register, &mut written).await;
            let written = u32::from_le_bytes(written);
            if read.map_err(failed)? == 0 || written.abs_diff(delay) <= NOISE_NS {
                continue;
            }
            // A later change may have moved the devices.
            if !still_valid() {
                return Ok(false);
            }
            tracing::info!(
                "station 0x{station:04x}: propagation delay {written} ns, now {delay} ns"
            );
            let write = wire.write(station, register, &delay.to_le_bytes()).await;
            write.map_err(failed)?;
        }
        Ok(true)
    }
    /// Returns the delays in the ring as it is. They are measured only if other devices are in it than
    /// before. Returns `None` if it has changed meanwhile.
    async fn delays_of_ring(
        &self,
        ring: &std::sync::Mutex<RingDelays>,
    ) -> Result<Option<RingDelays>, Error> {
        let wire = &self.wire;
        let count = enumerate::count(wire).await?;
        let there = enumerate::words(wire, count, STEP, registers::STATION_ADDRESS).await?;
        let lock = || ring.lock().unwrap_or_else(PoisonError::into_inner);
        let known = lock().clone();
        let stations = || known.iter().map(|(station, _)| *station);
        let own = |station: &u16| {
            self.clocks
                .iter()
                .any(|(of_device, _)| of_device == station)
        };
        let state = wire.ring();
        let new = there
            .iter()
            .any(|station| own(station) && !stations().any(|s| s == *station));
        // Devices in a gap of a broken ring are expected back.
        let left = state == Some(RingState::Closed) && !stations().eq(there.iter().copied());
        if new || left {
            let _held = self.latch.lock().await;
            let measured = measure_once(wire).await?;
            return Ok(measured.map(|measured| {
                *lock() = measured.closed;
                measured.now
            }));
        }
        let closed: Vec<_> = known.iter().map(|(_, delay)| *delay).collect();
        let now = match state {
            Some(RingState::Broken { behind, devices }) => {
                let missing = closed.len().saturating_sub(usize::from(devices));
                delays::split(&closed, usize::from(behind) + missing)
            }
            _ => closed,
        };
        Ok(Some(stations().zip(now).collect()))
    }
}
