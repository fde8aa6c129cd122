//! Fault reports on disk. A report is a file whose name is the SHA-256 of its content, so it cannot
//! be there twice; it is complete or it is not there.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime};

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use crate::keys::MachineId;
use crate::session::MAX_REPLY;

/// The longest headline of a summary, in characters.
const MAX_HEADLINE: usize = 200;
/// The reports of a list.
pub(crate) const MAX_LIST: usize = 1000;

/// The SHA-256 of a report, in hexadecimal digits.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String")]
pub struct ReportId(String);

impl ReportId {
    /// The digits of an id.
    pub const DIGITS: usize = 64;

    /// Returns the id of a report.
    #[must_use]
    pub fn of(bytes: &[u8]) -> Self {
        let digest = Sha256::digest(bytes);
        Self(digest.iter().map(|byte| format!("{byte:02x}")).collect())
    }

    /// Returns the digits.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl TryFrom<String> for ReportId {
    type Error = &'static str;

    fn try_from(text: String) -> Result<Self, &'static str> {
        let digit = |byte: u8| byte.is_ascii_digit() || (b'a'..=b'f').contains(&byte);
        match text.len() == Self::DIGITS && text.bytes().all(digit) {
            true => Ok(Self(text)),
            false => Err("not a SHA-256"),
        }
    }
}

/// What a list says of a report.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// The SHA-256 of the report.
    pub id: ReportId,
    /// The machine.
    #[serde(flatten)]
    pub machine: MachineId,
    /// The number of the event of the server.
    pub event: u64,
    /// The time in s since 1970; none in virtual time.
    pub unix_time: Option<u64>,
    /// The first line of the report.
    pub headline: String,
}

/// Returns the bytes of a report: JSON with sorted keys. The same report always has the same id.
#[must_use]
pub fn encode(machine: &MachineId, event: u64, report: &Value) -> Vec<u8> {
    let document = json!({
        "site": machine.site, "machine": machine.machine, "event": event, "report": report,
    });
    document.to_string().into_bytes()
}

/// Returns the summary of a report; `None` if the bytes are not one.
#[must_use]
pub fn summarize(bytes: &[u8]) -> Option<Summary> {
    #[derive(Deserialize)]
    struct Document {
        #[serde(flatten)]
        machine: MachineId,
        event: u64,
        report: Report,
    }
    #[derive(Deserialize)]
    struct Report {
        headline: String,
        unix_time: Option<u64>,
    }
    let document: Document = serde_json::from_slice(bytes).ok()?;
    Some(Summary {
        id: ReportId::of(bytes),
        machine: document.machine,
        event: document.event,
        unix_time: document.report.unix_time,
        headline: document
            .report
            .headline
            .chars()
            .take(MAX_HEADLINE)
            .collect(),
    })
}

#[derive(Debug)]
struct Kept {
    stored: SystemTime,
    /// Read when a list needs it.
    summary: Option<Summary>,
}

/// The reports of one machine in a folder. The oldest go when there are too many.
#[derive(Debug)]
pub struct ReportStore {
    folder: PathBuf,
    max_reports: usize,
    kept: Mutex<BTreeMap<ReportId, Kept>>,
}

impl ReportStore {
    /// Opens a folder, or makes it. Files that an ended process has left half-written are deleted.
    ///
    /// # Errors
    /// Fails if the folder cannot be read.
    pub fn open(folder: &Path, max_reports: usize) -> io::Result<Self> {
        fs::create_dir_all(folder)?;
        let mut kept = BTreeMap::new();
        for entry in fs::read_dir(folder)? {
            let entry = entry?;
            let name = entry.file_name();
            let name = name.to_string_lossy();
            if name.starts_with(".new-") {
                fs::remove_file(entry.path())?;
            } else if let Some(id) = name.strip_suffix(".json")
                && let Ok(id) = ReportId::try_from(id.to_owned())
            {
                let stored = entry.metadata()?.modified()?;
                kept.insert(
                    id,
                    Kept {
                        stored,
                        summary: None,
                    },
                );
            }
        }
        Ok(Self {
            folder: folder.to_owned(),
            max_reports: max_reports.max(1),
            kept: Mutex::new(kept),
        })
    }

    /// Writes a report unless it is there. Returns the summary of a new one.
    ///
    /// # Errors
    /// Fails if the bytes are not a report, or the disk refuses them.
    pub fn add(&self, bytes: &[u8]) -> io::Result<Option<Summary>> {
        let wrong = |what| io::Error::new(io::ErrorKind::InvalidData, what);
        if bytes.len() > MAX_REPLY {
            return Err(wrong("the report is too long"));
        }
        let summary = summarize(bytes).ok_or_else(|| wrong("not a fault report"))?;
        let mut kept = self.lock();
        if kept.contains_key(&summary.id) {
            return Ok(None);
        }
        // The newest one, also after the clock was set back.
        let newest = kept.values().map(|report| report.stored).max();
        let after = newest.and_then(|newest| newest.checked_add(Duration::from_nanos(1)));
        let stored = after.map_or_else(SystemTime::now, |after| after.max(SystemTime::now()));
        let temporary = self.folder.join(format!(".new-{}", summary.id.as_str()));
        let written = File::create(&temporary).and_then(|mut file| {
            file.write_all(bytes)?;
            file.set_modified(stored)?;
            file.sync_all()?;
            fs::rename(&temporary, self.path(&summary.id))
        });
        written.inspect_err(|_| drop(fs::remove_file(&temporary)))?;
        File::open(&self.folder)?.sync_all()?;
        kept.insert(
            summary.id.clone(),
            Kept {
                stored,
                summary: Some(summary.clone()),
            },
        );
        while kept.len() > self.max_reports {
            let oldest = kept.iter().min_by_key(|(_, report)| report.stored);
            let Some(id) = oldest.map(|(id, _)| id.clone()) else {
                break;
            };
            kept.remove(&id);
            fs::remove_file(self.path(&id))?;
        }
        Ok(Some(summary))
    }

    /// Returns true if the report is there.
    #[must_use]
    pub fn contains(&self, id: &ReportId) -> bool {
        self.lock().contains_key(id)
    }

    /// Returns the number of reports.
    #[must_use]
    pub fn len(&self) -> usize {
        self.lock().len()
    }

    /// Returns true without reports.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the bytes of a report. A damaged file counts as none.
    #[must_use]
    pub fn get(&self, id: &ReportId) -> Option<Vec<u8>> {
        let mut bytes = Vec::new();
        let file = File::open(self.path(id)).ok()?;
        file.take(MAX_REPLY as u64).read_to_end(&mut bytes).ok()?;
        (ReportId::of(&bytes) == *id).then_some(bytes)
    }

    /// Returns the newest reports, newest first.
    #[must_use]
    pub fn list(&self) -> Vec<Summary> {
        let mut kept = self.lock();
        let mut order: Vec<_> = kept.iter().map(|(id, r)| (r.stored, id.clone())).collect();
        order.sort_unstable_by(|a, b| b.cmp(a));
        order.truncate(MAX_LIST);
        let mut summaries = Vec::new();
        for (_, id) in order {
            if let Some(report) = kept.get_mut(&id) {
                if report.summary.is_none() {
                    report.summary = self.get(&id).as_deref().and_then(summarize);
                }
                match &report.summary {
                    Some(summary) => summaries.push(summary.clone()),
                    // Damaged: it may come again.
                    None => drop(kept.remove(&id)),
                }
            }
        }
        summaries
    }

    fn path(&self, id: &ReportId) -> PathBuf {
        self.folder.join(format!("{}.json", id.as_str()))
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<ReportId, Kept>> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(number: u64) -> Vec<u8> {
        let machine = "hall/press".parse().unwrap();
        let report = json!({"headline": "`x` is out of reach", "unix_time": 1_795_600_000});
        encode(&machine, number, &report)
    }

    #[test]
    fn a_report_is_kept_once_across_restarts() {
        let folder = tempfile::tempdir().unwrap();
        let store = ReportStore::open(folder.path(), 10).unwrap();
        let summary = store.add(&report(1)).unwrap().unwrap();
        assert_eq!(store.add(&report(1)).unwrap(), None);
        fs::write(folder.path().join(".new-half"), "half").unwrap();
        let again = ReportStore::open(folder.path(), 10).unwrap();
        assert_eq!(again.add(&report(1)).unwrap(), None);
        assert_eq!(again.list(), std::slice::from_ref(&summary));
        assert_eq!(again.get(&summary.id), Some(report(1)));
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn the_oldest_go_first() {
        let folder = tempfile::tempdir().unwrap();
        let store = ReportStore::open(folder.path(), 3).unwrap();
        for number in 0..5 {
            store.add(&report(number)).unwrap().unwrap();
        }
        let events: Vec<_> = store.list().iter().map(|summary| summary.event).collect();
        assert_eq!(events, [4, 3, 2]);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 3);
    }

    #[test]
    fn a_new_report_stays_after_the_clock_was_set_back() {
        let folder = tempfile::tempdir().unwrap();
        let store = ReportStore::open(folder.path(), 2).unwrap();
        let future = SystemTime::now() + Duration::from_secs(86_400);
        for number in 0..2 {
            let id = store.add(&report(number)).unwrap().unwrap().id;
            let file = File::options().write(true).open(store.path(&id)).unwrap();
            file.set_modified(future + Duration::from_secs(number))
                .unwrap();
        }
        for number in 2..4 {
            let store = ReportStore::open(folder.path(), 2).unwrap();
            let id = store.add(&report(number)).unwrap().unwrap().id;
            assert!(store.get(&id).is_some());
            assert_eq!(store.list()[0].event, number);
            assert_eq!(store.list()[1].event, number - 1);
        }
    }

    #[test]
    fn a_damaged_file_is_no_report_and_may_come_again() {
        let folder = tempfile::tempdir().unwrap();
        let store = ReportStore::open(folder.path(), 3).unwrap();
        let id = store.add(&report(1)).unwrap().unwrap().id;
        fs::write(store.path(&id), "damaged").unwrap();
        let again = ReportStore::open(folder.path(), 3).unwrap();
        assert_eq!(again.get(&id), None);
        assert_eq!(again.list(), []);
        assert!(again.add(&report(1)).unwrap().is_some());
        assert_eq!(again.get(&id), Some(report(1)));
    }

    #[test]
    fn a_report_that_the_disk_refuses_leaves_no_file_and_may_come_again() {
        let folder = tempfile::tempdir().unwrap();
        let store = ReportStore::open(folder.path(), 3).unwrap();
        let obstacle = store.path(&ReportId::of(&report(1)));
        fs::create_dir(&obstacle).unwrap();
        store.add(&report(1)).unwrap_err();
        fs::remove_dir(&obstacle).unwrap();
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
        assert!(store.add(&report(1)).unwrap().is_some());
    }

    #[test]
    fn what_is_not_a_report_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let store = ReportStore::open(folder.path(), 3).unwrap();
        for bytes in [
            &b""[..],
            b"{}",
            b"[]",
            b"\xff",
            b"{\"site\":\"..\",\"machine\":\"b\"}",
        ] {
            assert!(store.add(bytes).is_err());
        }
        assert!(store.is_empty());
    }
}
