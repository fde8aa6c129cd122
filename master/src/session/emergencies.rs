//! What becomes of emergencies: each is told once, and the first are kept.

use std::fmt;
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use serde::Serialize;

use super::Progress;
use crate::clock::Nanos;
use crate::mailbox::desk::Listen;
use crate::mailbox::{Emergencies, Emergency};
use crate::rt::exchange::Sights;

/// Emergencies of one run that are kept for its summary; more are told and counted.
const KEPT: usize = 64;

/// An emergency as it is told.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EmergencyReport {
    /// Its name.
    pub device: String,
    pub emergency: Emergency,
    /// When it was read, on the session's clock.
    pub at: Nanos,
    /// DC system time of that moment, nanoseconds; `None` without distributed clocks, and until the cycle has heard them.
    pub dc_time: Option<u64>,
}

impl fmt::Display for EmergencyReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "`{}`: {}", self.device, self.emergency)
    }
}

/// An emergency in the summary.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EmergencyLine {
    pub device: String,
    /// Seconds from the first cycle on; negative in bring-up.
    pub at_s: f64,
    /// DC system time, nanoseconds.
    pub dc_time_ns: Option<u64>,
    /// As in 0x603F.
    pub code: u16,
    /// What the code means.
    pub text: String,
    /// Error register, 0x1001.
    pub register: u8,
    /// The manufacturer's own.
    pub data: [u8; 5],
}

impl EmergencyReport {
    pub(super) fn line(&self, started: Nanos) -> EmergencyLine {
        let Emergency {
            code,
            register,
            data,
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

/// Where all devices' emergencies go. Clones are the same log.
#[derive(Debug, Clone)]
pub struct Log {
    told: Sender<Progress>,
    kept: Arc<Mutex<Kept>>,
    /// The cycle's, once there is one.
    sights: Arc<OnceLock<Arc<Sights>>>,
}

#[derive(Debug, Default)]
struct Kept {
    first: Vec<EmergencyReport>,
    /// The last of each device that has sent one, newest last.
    last: Vec<EmergencyReport>,
    more: u64,
    /// That found a device's queue full, by its name.
    lost: Vec<(String, u64)>,
}

/// Of one device, for the report of its fault.
const LAST: usize = 4;

impl Log {
    #[must_use]
    pub fn new(told: Sender<Progress>) -> Self {
        Self {
            told,
            kept: Arc::default(),
            sights: Arc::default(),
        }
    }

    /// From here on emergencies are stamped with DC time.
    pub fn set_sights(&self, sights: Arc<Sights>) {
        let _ = self.sights.set(sights);
    }

    fn kept(&self) -> MutexGuard<'_, Kept> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What found a device's queue full.
    fn lose(&self, device: &str, lost: u64) {
        if lost > 0 && self.kept().lose(device, lost) {
            let text = format!("`{device}`: {lost} emergencies found the queue full and are lost");
            let _ = self.told.send(Progress::Warning(text));
        }
    }

    /// The first of all devices, and how many more there were.
    pub(super) fn lines(&self, started: Nanos) -> (Vec<EmergencyLine>, u64) {
        let kept = self.kept();
        let lines = kept.first.iter().map(|report| report.line(started));
        let mut lost = kept.lost.iter().map(|(_, lost)| *lost);
        let more = lost.try_fold(kept.more, u64::checked_add);
        (lines.collect(), more.unwrap_or(u64::MAX))
    }

    /// The last few of a device since a moment, oldest first.
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

impl Listen for Log {
    /// Tells what waits in a device's queue, and empties it.
    fn listen(&self, device: &str, emergencies: &Emergencies) {
        for received in emergencies.take() {
            let sights = self.sights.get();
            let report = EmergencyReport {
                device: device.to_owned(),
                emergency: received.emergency,
                at: received.at,
                dc_time: sights.and_then(|sights| sights.system_time(received.at)),
            };
            tracing::debug!(dc_time = report.dc_time, "{report}");
            self.kept().keep(&report);
            // Nobody listening is no reason to stop.
            let _ = self.told.send(Progress::Emergency(report));
        }
        self.lose(device, emergencies.lost());
    }
}

impl Kept {
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

    /// `true` where there are more than before.
    fn lose(&mut self, device: &str, lost: u64) -> bool {
        let Some((_, before)) = self.lost.iter_mut().find(|(name, _)| name == device) else {
            self.lost.push((device.to_owned(), lost));
            return true;
        };
        std::mem::replace(before, lost) != lost
    }
}
