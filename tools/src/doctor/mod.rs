//! Finds host settings that delay the cycle: each finding with its effect and the command that
//! fixes it.
//!
//! - `kernel`, `cpu`, `interrupts`, `threads`, `permission`, `nic`: the checks;
//! - [`ethtool`]: settings known only to the network driver;
//! - `fix`: commands for the present system;
//! - [`wakeup`]: measures wake-up latency;
//! - `text`: the report as text.
//!
//! The checks change nothing. Unreadable settings produce no finding.

mod cpu;
pub mod ethtool;
mod fix;
mod interrupts;
mod kernel;
mod nic;
mod permission;
mod text;
mod threads;
pub mod wakeup;

use std::path::PathBuf;

use serde::Serialize;

use crate::host::{Cpus, Fact, Host};
use ecaxis_master::config::Bus;
use ecaxis_master::rt::spin::Spin;
use ecaxis_master::sys::rt_thread::RtSetupError;

pub use fix::Fix;
use kernel::Kernel;
use wakeup::WakeUp;

/// The severity of a finding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Information with little effect on timing.
    Note,
    /// Degrades timing.
    Warning,
    /// The bus does not run, or loses cycles permanently.
    Bad,
}

/// A setting that should be fixed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    pub severity: Severity,
    /// The identifier, stable across releases: `preemption`, `throttling` …
    pub id: &'static str,
    pub found: String,
    /// The effect on the cycle if it is not fixed.
    pub cost: String,
    pub fix: Vec<Fix>,
}

/// The intended configuration of the run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct RunProfile {
    pub nic: Option<String>,
    /// `None`: not pinned.
    pub cpu: Option<usize>,
    /// The SCHED_FIFO priority of the cycle.
    pub priority: u8,
    pub cycle_ns: u64,
    #[serde(skip)]
    pub spin: Spin,
    /// The program that needs the permissions.
    pub program: PathBuf,
}

impl RunProfile {
    /// Returns the defaults of a machine file.
    #[must_use]
    pub fn new(program: PathBuf) -> Self {
        let bus = Bus::default();
        Self {
            nic: None,
            cpu: bus.cpu,
            priority: bus.priority,
            cycle_ns: bus.cycle_ns,
            spin: bus.spin,
            program,
        }
    }
}

/// Results of system calls and measurements.
#[derive(Debug, Clone, Default)]
pub struct Measurements {
    /// The network driver's answers; `None` without an interface.
    pub nic: Option<ethtool::Answers>,
    pub wake_up: Option<WakeUp>,
}

/// The complete result. Findings are sorted, worst first.
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    pub intent: RunProfile,
    /// Settings that are correct or cannot be changed.
    pub facts: Vec<Fact>,
    pub findings: Vec<Finding>,
    pub wake_up: Option<WakeUp>,
}

impl Report {
    #[must_use]
    pub fn count(&self, severity: Severity) -> usize {
        let all = self.findings.iter();
        all.filter(|f| f.severity == severity).count()
    }
}

/// Collects findings and facts.
#[derive(Debug, Default)]
struct ReportBuilder {
    facts: Vec<Fact>,
    findings: Vec<Finding>,
}

impl ReportBuilder {
    fn fact(&mut self, name: &'static str, value: impl Into<String>) {
        let value = text::clean(&value.into());
        self.facts.push(Fact { name, value });
    }

    fn find(
        &mut self,
        severity: Severity,
        id: &'static str,
        found: impl Into<String>,
        cost: impl Into<String>,
        fix: Vec<Fix>,
    ) {
        self.findings.push(Finding {
            severity,
            id,
            found: text::clean(&found.into()),
            cost: cost.into(),
            fix,
        });
    }
}

/// The inputs of the checks.
#[derive(Debug)]
struct Context<'a> {
    host: &'a Host,
    intent: &'a RunProfile,
    kernel: Kernel,
    online: Cpus,
    isolated: Cpus,
    /// The CPU of the cycle: the configured one, else the first isolated one.
    cpu: Option<usize>,
    /// True in a container, where host settings cannot be changed.
    container: bool,
    threads: Vec<threads::Thread>,
}

impl<'a> Context<'a> {
    fn new(host: &'a Host, intent: &'a RunProfile) -> Self {
        let online = host.cpus("sys/devices/system/cpu/online");
        let online = online.unwrap_or_else(|| cpu::counted(host));
        let isolated = host.cpus("sys/devices/system/cpu/isolated");
        let isolated = isolated.unwrap_or_default();
        Self {
            host,
            intent,
            kernel: Kernel::of(host),
            cpu: intent.cpu.or_else(|| isolated.first()),
            online,
            isolated,
            container: fix::in_container(host),
            threads: threads::all(host),
        }
    }

    /// Returns a CPU for work that must not run on the cycle's CPU.
    fn elsewhere(&self) -> Option<usize> {
        let cpu = self.cpu?;
        let others = self.online.without(&Cpus::only(cpu));
        others.without(&self.isolated).first().or(others.first())
    }
}

/// Returns the CPU of the cycle: the configured one, else the first isolated one.
#[must_use]
pub fn cycle_cpu(host: &Host, intent: &RunProfile) -> Option<usize> {
    let isolated = || host.cpus("sys/devices/system/cpu/isolated")?.first();
    intent.cpu.or_else(isolated)
}

/// Runs all checks.
#[must_use]
pub fn examine(host: &Host, intent: &RunProfile, tried: Measurements) -> Report {
    let context = Context::new(host, intent);
    let denied: &[RtSetupError] = tried.wake_up.as_ref().map_or(&[], |w| &w.denied);
    let mut notes = ReportBuilder::default();
    kernel::examine(&context, &mut notes);
    cpu::examine(&context, &mut notes);
    permission::examine(&context, denied, &mut notes);
    threads::examine(&context, &mut notes);
    let nic_interrupts = intent.nic.as_deref().map(|nic| {
        let answers = tried.nic.unwrap_or_default();
        nic::examine(&context, nic, &answers, &mut notes);
        interrupts::of(host, nic)
    });
    interrupts::examine(&context, nic_interrupts.as_deref(), &mut notes);
    if let Some(wake_up) = &tried.wake_up {
        wakeup::examine(wake_up, &mut notes);
    }
    notes
        .findings
        .sort_by_key(|f| std::cmp::Reverse(f.severity));
    Report {
        intent: intent.clone(),
        facts: notes.facts,
        findings: notes.findings,
        wake_up: tried.wake_up,
    }
}
