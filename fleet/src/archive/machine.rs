//! What an archive keeps of one machine: a folder with `reports/`, `events.jsonl` and `state.json`.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use super::events::EventLog;
use crate::agent::events::EventIdentity;
use crate::agent::state::State;
use crate::keys::MachineId;
use crate::reports::{ReportStore, summarize};

/// The last state goes to the disk at most this often.
const WRITE_INTERVAL: Duration = Duration::from_secs(10);

/// The history of a machine.
#[derive(Debug)]
pub struct ArchivedMachine {
    /// Its fault reports.
    pub reports: ReportStore,
    folder: PathBuf,
    events: Mutex<EventLog>,
    /// Single events come earlier than those before them.
    complete_to: Mutex<Option<EventIdentity>>,
    state: Mutex<LastState>,
}

#[derive(Debug, Default)]
struct LastState {
    state: Option<State>,
    written: Option<Instant>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl ArchivedMachine {
    /// Opens the folder of a machine, or makes it.
    ///
    /// # Errors
    /// Fails if the disk refuses.
    pub fn open(folder: &Path, max_reports: usize) -> io::Result<Self> {
        let reports = ReportStore::open(&folder.join("reports"), max_reports)?;
        let state = fs::read(folder.join("state.json")).ok();
        let state = state.and_then(|bytes| serde_json::from_slice(&bytes).ok());
        Ok(Self {
            reports,
            folder: folder.to_owned(),
            events: Mutex::new(EventLog::open(folder)?),
            complete_to: Mutex::default(),
            state: Mutex::new(LastState {
                state,
                written: None,
            }),
        })
    }

    /// Returns the last state.
    #[must_use]
    pub fn state(&self) -> Option<State> {
        lock(&self.state).state.clone()
    }

    /// Takes the last state.
    pub fn set_state(&self, state: State) {
        let mut last = lock(&self.state);
        if last
            .written
            .is_none_or(|written| written.elapsed() > WRITE_INTERVAL)
        {
            last.written = Some(Instant::now());
            let new = self.folder.join(".new-state");
            let done = fs::write(&new, json!(state).to_string())
                .and_then(|()| fs::rename(&new, self.folder.join("state.json")));
            if let Err(error) = done {
                tracing::error!(machine = %state.id, "state: {error}");
            }
        }
        last.state = Some(state);
    }

    /// Writes a report if it is one of this machine.
    pub fn add_report(&self, id: &MachineId, bytes: &[u8]) {
        if summarize(bytes).is_none_or(|summary| summary.machine != *id) {
            tracing::warn!(machine = %id, "not a report of this machine");
            return;
        }
        match self.reports.add(bytes) {
            Ok(Some(summary)) => {
                tracing::info!(machine = %id, id = summary.id.as_str(), "fault report");
            }
            Ok(None) => {}
            Err(error) => tracing::error!(machine = %id, "report: {error}"),
        }
    }

    /// Writes an event unless it is there.
    pub fn add_event(&self, id: &MachineId, event: Value) {
        self.write_events(id, [event]);
    }

    /// Writes the events after [`Self::complete_to`] that are not there.
    pub fn complete_events(&self, id: &MachineId, events: Vec<Value>) {
        let last = events.last().and_then(EventIdentity::of);
        if self.write_events(id, events) && last.is_some() {
            *lock(&self.complete_to) = last;
        }
    }

    /// Returns the event up to which none is missing.
    #[must_use]
    pub fn complete_to(&self) -> Option<EventIdentity> {
        *lock(&self.complete_to)
    }

    /// Returns true if the agent may have an event that is not here.
    #[must_use]
    pub fn lacks_events(&self) -> bool {
        let last = self.state().and_then(|state| state.last_event);
        last.is_some() && last != self.complete_to()
    }

    fn write_events(&self, id: &MachineId, events: impl IntoIterator<Item = Value>) -> bool {
        let written = lock(&self.events).add(events);
        if let Err(error) = &written {
            tracing::error!(machine = %id, "events: {error}");
        }
        written.is_ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_are_complete_only_if_they_are_written() {
        let folder = tempfile::tempdir().unwrap();
        let machine = ArchivedMachine::open(folder.path(), 10).unwrap();
        let id = "hall/m1".parse().unwrap();
        let event = |n: u64| json!({"event": "fault", "number": n, "time_ns": n});
        let path = folder.path().join("events.jsonl");
        fs::create_dir(&path).unwrap();
        machine.complete_events(&id, vec![event(1), event(2)]);
        assert_eq!(machine.complete_to(), None);
        fs::remove_dir(&path).unwrap();
        machine.complete_events(&id, vec![event(1), event(2)]);
        assert_eq!(machine.complete_to(), EventIdentity::of(&event(2)));
        assert_eq!(fs::read_to_string(&path).unwrap().lines().count(), 2);
    }
}
