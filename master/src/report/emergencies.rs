//! Log of emergency messages: reports each message once and keeps the first ones for the summary.

use std::fmt;
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use serde::Serialize;

use super::Progress;
use crate::clock::Nanos;
use crate::mailbox::worker::EmergencySink;
use crate::mailbox::{Emergencies, Emergency};
use crate::rt::exchange::BusStatus;

/// The number of emergencies kept for the summary of a run. Further ones are reported and counted.
const KEPT: usize = 64;

/// One emergency message as the observer receives it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EmergencyReport {
    /// The device's name.
    pub device: String,
    pub emergency: Emergency,
    /// The time at which the message was read, on the session's clock.
    pub at: Nanos,
    /// The DC system time in ns when the message was read. `None` without distributed clocks and
    /// until the cycle has received them.
    pub dc_time: Option<u64>,
}

impl fmt::Display for EmergencyReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "`{}`: {}", self.device, self.emergency)
    }
}

/// One emergency message in the summary.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EmergencyLine {
    pub device: String,
    /// The time since the first cycle in s; negative during bring-up.
    pub at_s: f64,
    /// The DC system time in ns.
    pub dc_time_ns: Option<u64>,
    /// The error code, as in 0x603F.
    pub code: u16,
    /// The meaning of the code.
    pub text: String,
    /// The error register (0x1001).
    pub register: u8,
    /// The manufacturer-specific part.
    pub data: [u8; 5],
}

impl EmergencyReport {
    pub(crate) fn line(&self, started: Nanos) -> EmergencyLine {
        let Emergency {
            code,
            register,
            data,
            ..
        } = self.emergency;
        EmergencyLine {
            device: self.device.clone(),
            at_s: (self.at as f64 - started as f64) * 1e-9,
            dc_time_ns: self.dc_time,
            code,
            text: self.emergency.text().to_owned(),
            register,
            data,
        }
    }
}

/// The log for the emergencies of all devices. Clones share the same log.
#[derive(Debug, Clone)]
pub struct EmergencyLog {
    reported: Sender<Progress>,
    kept: Arc<Mutex<EmergencyStore>>,
    /// The status of the cycle; empty until the cycle exists.
    bus_status: Arc<OnceLock<Arc<BusStatus>>>,
}

#[derive(Debug, Default)]
struct EmergencyStore {
    first: Vec<EmergencyReport>,
    /// The last messages of each device, newest last.
    last: Vec<EmergencyReport>,
    more: u64,
    /// The number of messages lost because a device's queue was full, by device name.
    lost: Vec<(String, u64)>,
}

/// The number of messages of one device that its fault report shows.
const LAST: usize = 4;

impl EmergencyLog {
    #[must_use]
    pub fn new(reported: Sender<Progress>) -> Self {
        Self {
            reported,
            kept: Arc::default(),
            bus_status: Arc::default(),
        }
    }

    /// Sets the bus status; later emergencies carry the DC time.
    pub fn set_bus_status(&self, bus_status: Arc<BusStatus>) {
        let _ = self.bus_status.set(bus_status);
    }

    fn kept(&self) -> MutexGuard<'_, EmergencyStore> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Counts messages lost because the device's queue was full.
    fn lose(&self, device: &str, lost: u64) {
        if lost > 0 && self.kept().lose(device, lost) {
            let text = format!("`{device}`: {lost} emergencies found the queue full and are lost");
            let _ = self.reported.send(Progress::Warning(text));
        }
    }

    /// Returns the first emergencies of all devices and the number of further ones.
    pub(crate) fn lines(&self, started: Nanos) -> (Vec<EmergencyLine>, u64) {
        let kept = self.kept();
        let lines = kept.first.iter().map(|report| report.line(started));
        let mut lost = kept.lost.iter().map(|(_, lost)| *lost);
        let more = lost.try_fold(kept.more, u64::checked_add);
        (lines.collect(), more.unwrap_or(u64::MAX))
    }

    /// Returns the last emergencies of a device since `since`, oldest first.
    #[must_use]
    pub fn last_of(&self, device: &str, since: Nanos) -> Vec<EmergencyReport> {
        let kept = self.kept();
        let of_it = kept
            .last
            .iter()
            .filter(|r| r.device == device && r.at >= since);
        of_it.cloned().collect()
    }
}

impl EmergencySink for EmergencyLog {
    /// Reports the messages in a device's queue and empties the queue.
    fn listen(&self, device: &str, emergencies: &Emergencies) {
        for received in emergencies.take() {
            let bus_status = self.bus_status.get();
            let report = EmergencyReport {
                device: device.to_owned(),
                emergency: received.emergency,
                at: received.at,
                dc_time: bus_status.and_then(|bus_status| bus_status.system_time(received.at)),
            };
            tracing::debug!(dc_time = report.dc_time, "{report}");
            self.kept().keep(&report);
            // A closed channel does not stop the run.
            let _ = self.reported.send(Progress::Emergency(report));
        }
        self.lose(device, emergencies.lost());
    }
}

impl EmergencyStore {
    fn keep(&mut self, report: &EmergencyReport) {
        if self.first.len() < KEPT {
            self.first.push(report.clone());
        } else {
            self.more = self.more.saturating_add(1);
        }
        self.last.push(report.clone());
        let of_it = |other: &EmergencyReport| other.device == report.device;
        if self.last.iter().filter(|other| of_it(other)).count() > LAST
            && let Some(oldest) = self.last.iter().position(of_it)
        {
            self.last.remove(oldest);
        }
    }

    /// Returns `true` if the number has grown.
    fn lose(&mut self, device: &str, lost: u64) -> bool {
        let Some((_, before)) = self.lost.iter_mut().find(|(name, _)| name == device) else {
            self.lost.push((device.to_owned(), lost));
            return true;
        };
        std::mem::replace(before, lost) != lost
    }
}
