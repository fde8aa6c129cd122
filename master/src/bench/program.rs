//! Another MainDevice on the same interface, as a program of its own: `PROGRAM --nic IF --bytes N --cycle-ns N --cycles N
//! --cpu N --priority N` exchanges so many bytes of process data and prints what [`Told`] reads.

use std::io;
use std::path::Path;
use std::process::{Command, Stdio};

use serde::Deserialize;

use crate::os::process::ThreadUse;
use crate::rt::stats::Times;

/// How often, and where.
#[derive(Debug, Clone, Copy)]
pub struct Exchange<'a> {
    pub nic: &'a str,
    pub bytes: usize,
    pub cycle_ns: u64,
    pub cycles: u64,
    pub cpu: usize,
    pub priority: u8,
}

/// What the program prints, as JSON.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Told {
    pub name: String,
    pub cycles: u64,
    pub lost: u64,
    /// Cycles left out.
    pub overruns: u64,
    /// Wake-up to the answer, so that a late wake-up is not held against the exchange: nanoseconds and how often.
    pub release_to_input: Vec<(u64, u64)>,
    /// Planned release to the wake-up.
    pub wake_up_lateness: Vec<(u64, u64)>,
    pub cpu_ns: u64,
    pub voluntary_switches: u64,
    pub involuntary_switches: u64,
    pub minor_faults: u64,
    pub major_faults: u64,
}

impl Told {
    #[must_use]
    pub fn used(&self) -> ThreadUse {
        ThreadUse {
            cpu_ns: self.cpu_ns,
            minor_faults: self.minor_faults,
            major_faults: self.major_faults,
            voluntary_switches: self.voluntary_switches,
            involuntary_switches: self.involuntary_switches,
        }
    }
}

/// Adds a histogram that has been told.
pub fn add(times: &mut Times, told: &[(u64, u64)]) {
    for &(nanos, count) in told {
        times.record_n(nanos, count);
    }
}

/// Runs it. Blocks.
///
/// # Errors
/// Where it cannot be run, fails, or prints something else.
pub fn run(program: &Path, exchange: Exchange<'_>) -> io::Result<Told> {
    let named = |what: String| io::Error::other(format!("{}: {what}", program.display()));
    let output = Command::new(program)
        .args(["--nic", exchange.nic])
        .args(["--bytes", &exchange.bytes.to_string()])
        .args(["--cycle-ns", &exchange.cycle_ns.to_string()])
        .args(["--cycles", &exchange.cycles.to_string()])
        .args(["--cpu", &exchange.cpu.to_string()])
        .args(["--priority", &exchange.priority.to_string()])
        .stdin(Stdio::null())
        .output()
        .map_err(|e| named(e.to_string()))?;
    if !output.status.success() {
        let told = String::from_utf8_lossy(&output.stderr);
        return Err(named(format!("{}: {}", output.status, told.trim())));
    }
    serde_json::from_slice(&output.stdout).map_err(|e| named(format!("its result: {e}")))
}
