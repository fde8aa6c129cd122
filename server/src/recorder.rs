//! Records the samples of every cycle to an MCAP file, in a thread of its own.

use std::fs::File;
use std::io::{self, BufWriter};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use ecaxis_master::ros2::mcap::{McapError, McapFile};
use ecaxis_master::sys::rights;
use serde_json::json;

use crate::diagnostics::diagnostics;
use crate::hub::Hub;

/// The period at which samples are written.
const PERIOD: Duration = Duration::from_millis(20);
/// The period of diagnostics and of complete parts of the file.
const FLUSH: Duration = Duration::from_secs(1);

/// The recording failed.
#[derive(Debug, thiserror::Error)]
#[error("the recording {}: {source}", path.display())]
pub struct RecordError {
    path: PathBuf,
    source: McapError,
}

/// A recording under way.
#[derive(Debug)]
pub struct Recorder {
    end: Arc<AtomicBool>,
    thread: JoinHandle<Result<(), RecordError>>,
}

impl Recorder {
    /// Begins a recording with the next sample. Overwrites the file.
    ///
    /// # Errors
    /// Fails if the file cannot be written, or the system refuses the thread.
    pub fn start(path: PathBuf, hub: &Arc<Hub>) -> Result<Self, RecordError> {
        let failed = |path: &PathBuf, source| RecordError {
            path: path.clone(),
            source,
        };
        let io_failed = |path, error: io::Error| failed(path, McapError::Io(error));
        let file = File::create(&path).map_err(|error| io_failed(&path, error))?;
        let topics = Arc::clone(&hub.topics);
        let file = McapFile::new(BufWriter::new(file), topics, |_| true)
            .map_err(|error| failed(&path, error))?;
        let end = Arc::<AtomicBool>::default();
        let (ended, hub, name) = (Arc::clone(&end), Arc::clone(hub), path.clone());
        let next = hub.samples.written();
        let work = move || {
            let recorded = record(&hub, file, next, &ended);
            recorded.map_err(|source| {
                let error = failed(&name, source);
                tracing::error!(%error, "the recording has ended");
                hub.event(json!({"event": "warning", "text": error.to_string()}));
                error
            })
        };
        let builder = thread::Builder::new().name("ecaxis-record".to_owned());
        let thread = builder
            .spawn(move || {
                rights::drop_capabilities();
                work()
            })
            .map_err(|error| io_failed(&path, error))?;
        Ok(Self { end, thread })
    }

    /// Writes the last samples and completes the file.
    ///
    /// # Errors
    /// Fails if the file could not be written.
    pub fn finish(self) -> Result<(), RecordError> {
        self.end.store(true, Ordering::Release);
        match self.thread.join() {
            Ok(recorded) => recorded,
            Err(panic) => std::panic::resume_unwind(panic),
        }
    }
}

fn record(
    hub: &Hub,
    mut file: McapFile<BufWriter<File>>,
    mut next: u64,
    end: &AtomicBool,
) -> Result<(), McapError> {
    let mut flushed = Instant::now();
    loop {
        let ends = end.load(Ordering::Acquire);
        write_new(hub, &mut file, &mut next)?;
        if ends || flushed.elapsed() >= FLUSH {
            flushed = Instant::now();
            let time = hub.topics.unix_time(hub.now());
            file.write_diagnostics(time, &diagnostics(hub))?;
            file.flush()?;
        }
        if ends {
            let file = file.finish()?.into_inner();
            file.map_err(io::IntoInnerError::into_error)?.sync_all()?;
            return Ok(());
        }
        thread::sleep(PERIOD);
    }
}

/// Writes the rows from `next` on.
fn write_new(
    hub: &Hub,
    file: &mut McapFile<BufWriter<File>>,
    next: &mut u64,
) -> Result<(), McapError> {
    let mut written = Ok(());
    let mut expected = *next;
    hub.samples.read_new(next, |number, row| {
        file.miss(number - expected);
        expected = number + 1;
        if written.is_ok() {
            written = file.write_row(row);
        }
    });
    file.miss(*next - expected);
    written
}
