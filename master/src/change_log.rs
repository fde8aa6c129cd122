//! A log of what changed a machine: one JSON object per line, only ever appended to. Several programs
//! may write to the same file.

use std::fs::{File, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use rustix::fs::{FlockOperation, OFlags, flock};
use rustix::io::Errno;
use serde_json::{Map, Value, json};

/// The environment variable with the path of the log.
pub const VARIABLE: &str = "ECAXIS_CHANGE_LOG";
/// The log without that variable, where its folder exists.
const DEFAULT: &str = "/var/log/ecaxis/changes.jsonl";
/// A longer file is renamed: `changes.jsonl.1` is the newest of the old ones.
const MAX_BYTES: u64 = 10 << 20;
/// The longest wait for another writer.
const LOCK_TIMEOUT: Duration = Duration::from_secs(1);
/// The old files that are kept.
const KEPT: u32 = 9;

/// The log of this computer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ChangeLog {
    path: PathBuf,
    max_bytes: u64,
}

impl ChangeLog {
    /// Returns the log that the environment names, or the default one if its folder exists.
    #[must_use]
    pub fn of_environment() -> Option<Self> {
        let path = match std::env::var_os(VARIABLE) {
            Some(path) if path.is_empty() => return None,
            Some(path) => PathBuf::from(path),
            None => PathBuf::from(DEFAULT),
        };
        let wanted = path != Path::new(DEFAULT) || path.parent().is_some_and(Path::is_dir);
        wanted.then(|| Self::new(path))
    }

    #[must_use]
    pub fn new(path: PathBuf) -> Self {
        Self {
            path,
            max_bytes: MAX_BYTES,
        }
    }

    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Appends an entry with the time, the user and the process. MAY BLOCK.
    ///
    /// # Errors
    /// Fails if the file cannot be written.
    pub fn append(&self, entry: Map<String, Value>) -> io::Result<()> {
        let now = SystemTime::now().duration_since(UNIX_EPOCH);
        let mut line = Map::new();
        line.insert(
            "unix_time".to_owned(),
            json!(now.unwrap_or_default().as_secs_f64()),
        );
        let uid = rustix::process::getuid().as_raw();
        line.insert("uid".to_owned(), json!(uid));
        if let Ok(user) = std::env::var("SUDO_USER") {
            line.insert("sudo_user".to_owned(), json!(user));
        }
        line.insert("pid".to_owned(), json!(std::process::id()));
        line.insert("version".to_owned(), json!(crate::VERSION));
        line.extend(entry);
        let mut text = Value::Object(line).to_string();
        text.push('\n');
        let mut file = self.open_locked()?;
        if file.metadata()?.len().saturating_add(text.len() as u64) > self.max_bytes {
            self.rotate()?;
            file = self.open_locked()?;
        }
        file.write_all(text.as_bytes())
    }

    /// Opens the file and locks it. The lock ends with the value.
    fn open_locked(&self) -> io::Result<File> {
        loop {
            let mut options = OpenOptions::new();
            // Without it, opening a pipe would wait for its reader.
            options.custom_flags(OFlags::NONBLOCK.bits().cast_signed());
            let file = options
                .create(true)
                .append(true)
                .mode(0o640)
                .open(&self.path)?;
            lock(&file)?;
            // Another program may have renamed it meanwhile.
            match std::fs::metadata(&self.path) {
                Ok(now) if now.ino() == file.metadata()?.ino() => return Ok(file),
                Ok(_) => {}
                Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                Err(error) => return Err(error),
            }
        }
    }

    /// Renames the files. The caller holds the lock.
    fn rotate(&self) -> io::Result<()> {
        let old = |number: u32| {
            let mut name = self.path.clone().into_os_string();
            name.push(format!(".{number}"));
            PathBuf::from(name)
        };
        for number in (1..KEPT).rev() {
            match std::fs::rename(old(number), old(number + 1)) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
        }
        std::fs::rename(&self.path, old(1))
    }
}

/// Locks a file. Waits for other writers, but not for one that hangs.
fn lock(file: &File) -> io::Result<()> {
    let end = Instant::now() + LOCK_TIMEOUT;
    loop {
        match flock(file, FlockOperation::NonBlockingLockExclusive) {
            Err(Errno::WOULDBLOCK) if Instant::now() < end => {
                std::thread::sleep(Duration::from_millis(1));
            }
            done => return Ok(done?),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neither_a_pipe_nor_a_writer_that_hangs_is_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe");
        let mode = rustix::fs::Mode::from_raw_mode(0o600);
        rustix::fs::mknodat(rustix::fs::CWD, &pipe, rustix::fs::FileType::Fifo, mode, 0).unwrap();
        assert!(ChangeLog::new(pipe).append(entry(1)).is_err());
        let log = ChangeLog::new(folder.path().join("changes.jsonl"));
        let held = log.open_locked().unwrap();
        assert!(log.append(entry(1)).is_err());
        drop(held);
        log.append(entry(2)).unwrap();
    }

    fn entry(number: usize) -> Map<String, Value> {
        let mut entry = Map::new();
        entry.insert("number".to_owned(), json!(number));
        entry
    }

    fn numbers(text: &str) -> Vec<u64> {
        let value = |line| serde_json::from_str::<Value>(line).expect("JSON");
        let number = |line| value(line)["number"].as_u64().expect("a number");
        text.lines().map(number).collect()
    }

    #[test]
    fn several_writers_lose_nothing_while_files_are_renamed() {
        let folder = tempfile::tempdir().unwrap();
        let log = ChangeLog {
            max_bytes: 4096,
            ..ChangeLog::new(folder.path().join("changes.jsonl"))
        };
        std::thread::scope(|scope| {
            for writer in 0..4 {
                let log = &log;
                scope.spawn(move || {
                    (0..50).for_each(|n| log.append(entry(writer * 50 + n)).unwrap());
                });
            }
        });
        let files = std::fs::read_dir(folder.path()).unwrap();
        let files: Vec<_> = files.map(|file| file.unwrap().path()).collect();
        assert!(files.len() > 3, "{files:?}");
        let mut all = Vec::new();
        for file in &files {
            let text = std::fs::read_to_string(file).unwrap();
            assert!(text.len() <= 4096);
            all.extend(numbers(&text));
        }
        all.sort_unstable();
        assert_eq!(all, (0..200).collect::<Vec<_>>());
    }

    #[test]
    fn the_oldest_files_go() {
        let folder = tempfile::tempdir().unwrap();
        let log = ChangeLog {
            max_bytes: 300,
            ..ChangeLog::new(folder.path().join("changes.jsonl"))
        };
        (0..60).for_each(|n| log.append(entry(n)).unwrap());
        let count = std::fs::read_dir(folder.path()).unwrap().count();
        assert_eq!(count, KEPT as usize + 1);
        let newest = std::fs::read_to_string(log.path()).unwrap();
        assert_eq!(numbers(&newest).last(), Some(&59));
    }
}
