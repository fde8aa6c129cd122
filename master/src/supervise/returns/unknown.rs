//! Devices that are not in the machine file and appear during the run. Each is reported once, and the
//! port that leads to it is closed, unless the file says otherwise.

use ecaxis_ecat::index::DeviceIndex;
use ecaxis_ecat::registers::{DL_CONTROL_LOOPS, DL_STATUS};

use super::identify::DeviceNumbers;
use super::{RunningSegment, failed};
use crate::acyclic::topology::has_link;
use crate::bringup::known_identity;
use crate::clock::{self, Nanos};
use crate::config::UnknownDeviceRule;
use crate::mailbox::MailboxTransport;
use crate::report::{Error, Progress, UnknownDevice};

/// The pause before the first look again. It doubles with each look, because a port that opens may
/// cost a frame.
const FIRST_PAUSE: Nanos = 1_000_000_000;
const MAX_PAUSE: Nanos = 10_000_000_000;

/// A port that leads away from the MainDevice; `None`: in front of the first device.
type Place = Option<(DeviceIndex, u8)>;

#[derive(Debug, Clone, Copy)]
struct Entry {
    place: Place,
    numbers: Option<DeviceNumbers>,
    closed: bool,
    /// Not identified again before this time.
    not_before: Nanos,
    pause: Nanos,
    /// The current survey has found a device here.
    seen: bool,
}

/// The unknown devices of the segment.
#[derive(Debug, Default)]
pub(super) struct UnknownDevices {
    entries: Vec<Entry>,
    /// The number of devices that the last survey has found.
    count: u16,
}

/// Loop control of a port (0x0101, two bits each): open with a link, and closed.
const AUTO: u8 = 0;
const CLOSED: u8 = 3;

impl UnknownDevices {
    /// Returns true if more devices answer than those of the machine, and a survey would show more
    /// than the last one.
    pub fn look_again(&mut self, segment: &RunningSegment, lost: &[DeviceIndex]) -> bool {
        let answering = segment.bus_status.answering();
        let present = segment.devices.len() - lost.len();
        if usize::from(answering) <= present {
            self.entries.retain(|entry| entry.closed);
            self.count = answering;
            return false;
        }
        answering != self.count || self.entries.iter().any(Entry::is_due)
    }

    pub fn begin_survey(&mut self, count: u16) {
        self.count = count;
        self.entries.iter_mut().for_each(|entry| entry.seen = false);
    }

    /// Forgets devices that have left.
    pub fn end_survey(&mut self) {
        self.entries.retain(|entry| entry.closed || entry.seen);
    }

    /// Returns true if the device at a place has to be identified.
    pub fn is_due(&mut self, place: Place) -> bool {
        let entry = self.entries.iter_mut().find(|entry| entry.place == place);
        entry.is_none_or(|entry| {
            entry.seen = true;
            entry.is_due()
        })
    }

    pub fn remove(&mut self, place: Place) {
        self.entries.retain(|entry| entry.place != place);
    }

    /// Reports a device, unless it is known already, and closes the port that leads to it.
    pub async fn add(
        &mut self,
        segment: &RunningSegment,
        place: Place,
        numbers: Option<DeviceNumbers>,
        leads_on: bool,
    ) -> Result<(), Error> {
        let before = self.entries.iter().find(|entry| entry.place == place);
        let reported = before.is_some_and(|entry| entry.numbers == numbers);
        let pause = before.filter(|_| reported).map_or(FIRST_PAUSE, |entry| {
            entry.pause.saturating_mul(2).min(MAX_PAUSE)
        });
        let rule = segment.machine.bus.unknown_devices;
        let closes = rule == UnknownDeviceRule::Close && !leads_on;
        let closed = match place.filter(|_| closes) {
            Some((device, port)) => segment.set_loop(device, port, CLOSED).await?,
            None => false,
        };
        self.remove(place);
        self.entries.push(Entry {
            place,
            numbers,
            closed,
            not_before: clock::now().saturating_add(pause),
            pause,
            seen: true,
        });
        if !reported {
            let named = numbers.map(|found| known_identity(&segment.machine, found.identity));
            let parent = segment.name_port(place);
            segment.report(Progress::UnknownDevice(UnknownDevice {
                identity: named,
                serial: numbers.map(|found| found.serial),
                parent,
                closed,
            }));
        }
        Ok(())
    }

    /// Opens all closed ports at the end of the run, as far as the devices answer.
    pub async fn open_ports(&self, segment: &RunningSegment) {
        for entry in self.entries.iter().filter(|entry| entry.closed) {
            if let Some((device, port)) = entry.place
                && let Err(error) = segment.set_loop(device, port, AUTO).await
            {
                tracing::debug!("{error}");
            }
        }
    }

    /// Opens the closed ports whose device has left, and each one from time to time while devices are
    /// missing: the device behind it may have been exchanged.
    pub async fn reopen_ports(
        &mut self,
        segment: &RunningSegment,
        lost: &[DeviceIndex],
    ) -> Result<(), Error> {
        // A device that had no power has forgotten its loop control; one that was unplugged has not.
        let is_lost = |entry: &Entry| {
            entry
                .place
                .is_some_and(|(device, _)| lost.contains(&device))
        };
        self.entries.retain(|entry| entry.closed || !is_lost(entry));
        for entry in &mut self.entries {
            let Some((device, port)) = entry.place.filter(|_| entry.closed) else {
                continue;
            };
            let mut status = [0; 2];
            let station = segment.devices[device].at.station;
            let read = segment.wire.read(station, DL_STATUS, &mut status).await;
            if read.map_err(failed)? != 1 {
                continue;
            }
            let left = !has_link(u16::from_le_bytes(status), port);
            if left || (!lost.is_empty() && entry.is_due()) {
                entry.closed = !segment.set_loop(device, port, AUTO).await?;
                // The next survey does not know a device that has left.
                entry.numbers = entry.numbers.filter(|_| !left);
            }
        }
        Ok(())
    }
}

impl Entry {
    fn is_due(&self) -> bool {
        clock::now() >= self.not_before
    }
}

impl RunningSegment {
    /// Sets loop control of a port. Returns false if the device does not answer.
    async fn set_loop(&self, device: DeviceIndex, port: u8, control: u8) -> Result<bool, Error> {
        let station = self.devices[device].at.station;
        let mut loops = [0];
        let read = self.wire.read(station, DL_CONTROL_LOOPS, &mut loops).await;
        if read.map_err(failed)? != 1 || port > 3 {
            return Ok(false);
        }
        let shift = 2 * port;
        let [before] = loops;
        let value = before & !(3 << shift) | control << shift;
        let written = self.wire.write(station, DL_CONTROL_LOOPS, &[value]).await;
        written.map(|count| count == 1).map_err(failed)
    }
}
