//! Events of a machine in a file, a JSON object per line, each once.

use std::collections::{BTreeSet, VecDeque};
use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::agent::events::EventIdentity;

/// The length of a file; the one before it is kept, too.
const MAX_FILE: u64 = 4 << 20;
/// The longest event.
pub(super) const MAX_EVENT: usize = 16 << 10;
/// The events that are recognized; a server has 1,000.
const MAX_KNOWN: usize = 4000;

/// The file of the events. It is open only during an append: an archive has many machines.
#[derive(Debug)]
pub struct EventLog {
    path: PathBuf,
    older: PathBuf,
    /// The length of the whole lines.
    length: u64,
    known: Known,
}

/// Events in the order of the file: after a restart of the computer, times begin again.
#[derive(Debug, Default)]
struct Known {
    set: BTreeSet<EventIdentity>,
    order: VecDeque<EventIdentity>,
}

impl Known {
    fn add(&mut self, identity: EventIdentity) {
        if !self.set.insert(identity) {
            return;
        }
        self.order.push_back(identity);
        if self.order.len() > MAX_KNOWN
            && let Some(oldest) = self.order.pop_front()
        {
            self.set.remove(&oldest);
        }
    }
}

impl EventLog {
    /// Reads the file in a folder. The next append removes an incomplete last line.
    ///
    /// # Errors
    /// Fails if the disk refuses.
    pub fn open(folder: &Path) -> io::Result<Self> {
        let path = folder.join("events.jsonl");
        let older = folder.join("events.1.jsonl");
        let mut known = Known::default();
        let mut read = |path: &Path| -> io::Result<usize> {
            let mut text = Vec::new();
            match File::open(path) {
                Ok(file) => drop(file.take(2 * MAX_FILE).read_to_end(&mut text)?),
                Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(0),
                Err(error) => return Err(error),
            }
            let whole = text
                .iter()
                .rposition(|b| *b == b'\n')
                .map_or(0, |at| at + 1);
            for line in text[..whole].split(|byte| *byte == b'\n') {
                let event = serde_json::from_slice(line).ok();
                if let Some(identity) = event.as_ref().and_then(EventIdentity::of) {
                    known.add(identity);
                }
            }
            Ok(whole)
        };
        read(&older)?;
        let length = read(&path)? as u64;
        Ok(Self {
            path,
            older,
            length,
            known,
        })
    }

    /// Appends the events that are not there. What is not an event is left out.
    ///
    /// # Errors
    /// Fails if the disk refuses.
    pub fn add(&mut self, events: impl IntoIterator<Item = Value>) -> io::Result<()> {
        let mut opened = None;
        for event in events {
            let Some(identity) = EventIdentity::of(&event) else {
                continue;
            };
            let line = format!("{event}\n");
            if line.len() > MAX_EVENT || self.known.set.contains(&identity) {
                continue;
            }
            if self.length > MAX_FILE {
                fs::rename(&self.path, &self.older)?;
                self.length = 0;
                opened = None;
            }
            let file = match &mut opened {
                Some(file) => file,
                None => opened.insert(self.open_end()?),
            };
            file.write_all(line.as_bytes())?;
            self.length += line.len() as u64;
            self.known.add(identity);
        }
        Ok(())
    }

    /// Opens the file after its last whole line. A failed append may have left a part of one.
    fn open_end(&self) -> io::Result<File> {
        let file = OpenOptions::new()
            .create(true)
            .append(true)
            .open(&self.path)?;
        if file.metadata()?.len() > self.length {
            file.set_len(self.length)?;
        }
        Ok(file)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn event(number: u64) -> Value {
        json!({"event": "fault", "number": number, "time_ns": number * 1000})
    }

    #[test]
    fn an_event_is_written_once_across_restarts() {
        let folder = tempfile::tempdir().unwrap();
        let mut log = EventLog::open(folder.path()).unwrap();
        log.add([event(1), event(2), json!({"event": "missed"}), json!(null)])
            .unwrap();
        let path = folder.path().join("events.jsonl");
        let mut file = OpenOptions::new().append(true).open(&path).unwrap();
        file.write_all(b"{\"event\":\"fau").unwrap();
        let mut again = EventLog::open(folder.path()).unwrap();
        again.add([event(1), event(3)]).unwrap();
        // The computer has restarted.
        let mut first = event(1);
        first["time_ns"] = json!(7);
        again.add([first.clone()]).unwrap();
        let text = fs::read_to_string(&path).unwrap();
        let events: Vec<Value> = text
            .lines()
            .map(|l| serde_json::from_str(l).unwrap())
            .collect();
        assert_eq!(events, [event(1), event(2), event(3), first]);
    }

    #[test]
    fn an_event_comes_again_after_a_failed_append() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("events.jsonl");
        let mut log = EventLog::open(folder.path()).unwrap();
        fs::create_dir(&path).unwrap();
        log.add([event(1)]).unwrap_err();
        fs::remove_dir(&path).unwrap();
        log.add([event(1)]).unwrap();
        // What an append on a full disk leaves.
        let mut file = OpenOptions::new().append(true).open(&path).unwrap();
        file.write_all(b"{\"event\":\"fau").unwrap();
        log.add([event(1), event(2)]).unwrap();
        let text = fs::read_to_string(&path).unwrap();
        assert_eq!(text, format!("{}\n{}\n", event(1), event(2)));
    }

    #[test]
    fn the_files_are_bounded() {
        let folder = tempfile::tempdir().unwrap();
        let mut log = EventLog::open(folder.path()).unwrap();
        for number in 0..1000 {
            let mut event = event(number);
            event["text"] = json!("t".repeat(MAX_EVENT - 200));
            log.add([event]).unwrap();
        }
        for entry in fs::read_dir(folder.path()).unwrap() {
            let length = entry.unwrap().metadata().unwrap().len();
            assert!(length <= MAX_FILE + MAX_EVENT as u64, "{length}");
        }
        let known = EventLog::open(folder.path()).unwrap().known;
        let last = EventIdentity {
            time_ns: 999_000,
            number: 999,
        };
        assert_eq!(known.order.back(), Some(&last));
    }
}
