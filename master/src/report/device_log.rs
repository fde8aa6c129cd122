//! Devices that were lost, returned or appeared during the run, for the summary and the fault report.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

use super::events::EventLine;
use super::progress::Progress;
use crate::clock::Nanos;

/// The newest entries are kept.
const CAPACITY: usize = 256;

/// The log of one run. Clones share it.
#[derive(Debug, Clone, Default)]
pub struct DeviceLog(Arc<Mutex<VecDeque<(Nanos, String)>>>);

impl DeviceLog {
    /// Adds what a progress report says about a device, if it does.
    pub fn add(&self, at: Nanos, progress: &Progress) {
        let what = match progress {
            Progress::DeviceLost { device, parent } => match parent {
                Some((name, port)) => format!("{device} is lost, behind port {port} of `{name}`"),
                None => format!("{device} is lost"),
            },
            Progress::DeviceReturned {
                device,
                first: true,
                ..
            } => format!("{device} has appeared and is in Op"),
            Progress::DeviceReturned {
                device, after_ns, ..
            } => {
                let after = *after_ns as f64 * 1e-9;
                format!("{device} is in Op again after {after:.2} s")
            }
            Progress::UnknownDevice(device) => device.to_string(),
            _ => return,
        };
        let mut entries = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if entries.len() == CAPACITY {
            entries.pop_front();
        }
        entries.push_back((at, what));
    }

    /// Adds the entries to the events of the cycle, by time.
    pub fn add_to(&self, events: &mut Vec<EventLine>, started: Nanos, cycle_ns: Nanos) {
        let entries = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        events.extend(entries.iter().map(|(at, what)| {
            let since = at.saturating_sub(started);
            let cycle = since / cycle_ns.max(1);
            EventLine {
                at_s: since as f64 * 1e-9,
                first_cycle: cycle,
                last_cycle: cycle,
                what: what.clone(),
                failure: false,
            }
        }));
        events.sort_by(|a, b| a.at_s.total_cmp(&b.at_s));
    }
}

#[cfg(test)]
mod tests {
    use super::super::DeviceRef;
    use super::*;

    #[test]
    fn device_log_keeps_the_newest_entries_in_the_order_of_time() {
        let log = DeviceLog::default();
        let device = DeviceRef {
            name: "a".to_owned(),
            position: 1,
            station: 0x1001,
        };
        for n in 0..CAPACITY as u64 + 10 {
            let parent = Some(("b".to_owned(), 1));
            let device = device.clone();
            log.add(n * 1_000_000, &Progress::DeviceLost { device, parent });
            log.add(n, &Progress::PhaseLocked);
        }
        let cycle = EventLine {
            at_s: 0.0205,
            first_cycle: 20,
            last_cycle: 20,
            what: "late".to_owned(),
            failure: false,
        };
        let mut events = vec![cycle];
        log.add_to(&mut events, 0, 1_000_000);
        assert_eq!(events.len(), CAPACITY + 1);
        assert_eq!(
            (events[0].first_cycle, events[11].what.as_str()),
            (10, "late")
        );
        assert!(events[12].what.ends_with("is lost, behind port 1 of `b`"));
    }
}
