//! Another MainDevice on the same interface as a separate program. `PROGRAM --nic IF --bytes N
//! --cycle-ns N --cycles N --cpu N --priority N` exchanges N bytes of process data and prints a
//! [`PeerResult`].

use std::io;
use std::path::Path;
use std::process::{Command, Stdio};

use serde::Deserialize;

use ecaxis_master::rt::stats::LatencyHistogram;
use ecaxis_master::sys::process::ThreadUsage;

/// The parameters of the exchange.
#[derive(Debug, Clone, Copy)]
pub struct Exchange<'a> {
    pub nic: &'a str,
    pub bytes: usize,
    pub cycle_ns: u64,
    pub cycles: u64,
    pub cpu: usize,
    pub priority: u8,
}

/// The output of the program as JSON.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PeerResult {
    pub name: String,
    pub cycles: u64,
    pub lost: u64,
    /// Skipped cycles.
    pub overruns: u64,
    /// Wake-up to the answer in ns and its count. It excludes the wake-up latency.
    pub release_to_input: Vec<(u64, u64)>,
    /// Planned release to the wake-up in ns and its count.
    pub wake_up_lateness: Vec<(u64, u64)>,
    pub cpu_ns: u64,
    pub voluntary_switches: u64,
    pub involuntary_switches: u64,
    pub minor_faults: u64,
    pub major_faults: u64,
}

impl PeerResult {
    #[must_use]
    pub fn used(&self) -> ThreadUsage {
        ThreadUsage {
            cpu_ns: self.cpu_ns,
            minor_faults: self.minor_faults,
            major_faults: self.major_faults,
            voluntary_switches: self.voluntary_switches,
            involuntary_switches: self.involuntary_switches,
        }
    }
}

/// Adds the histogram of a program.
pub fn add(times: &mut LatencyHistogram, reported: &[(u64, u64)]) {
    for &(nanos, count) in reported {
        times.record_n(nanos, count);
    }
}

/// Runs the program. Blocks.
///
/// # Errors
/// Fails if it cannot be run, fails, or prints an invalid result.
pub fn run(program: &Path, exchange: Exchange<'_>) -> io::Result<PeerResult> {
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
        let reported = String::from_utf8_lossy(&output.stderr);
        return Err(named(format!("{}: {}", output.status, reported.trim())));
    }
    serde_json::from_slice(&output.stdout).map_err(|e| named(format!("its result: {e}")))
}
