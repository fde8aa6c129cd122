//! The commands that read.

pub mod report;
pub mod samples;
pub mod status;
pub mod watch;

use std::io::{self, Write};
use std::time::Duration;

use crate::error::{Error, Result};

/// The time for replies of one machine, and of all machines.
pub const TIMEOUT: Duration = Duration::from_secs(5);

/// Prints a line. A closed pipe ends the command without an error.
///
/// # Errors
/// Fails if the output cannot be written.
pub fn print(line: &str) -> Result<()> {
    let mut out = io::stdout().lock();
    match writeln!(out, "{line}").and_then(|()| out.flush()) {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => std::process::exit(0),
        done => done.map_err(|error| Error::new(format!("output: {error}"))),
    }
}
