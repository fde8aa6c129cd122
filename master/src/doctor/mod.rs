//! Examines a computer for what keeps a cycle from being released on time: what was found, what it
//! costs, and the command that mends it.
//!
//! - [`host`]: the files that tell, in this computer or in a folder;
//! - [`kernel`], [`cpu`], [`interrupts`], [`threads`], [`permission`], [`nic`]: the examinations;
//! - [`ethtool`]: what only the network driver knows;
//! - [`mend`]: how things are changed on the system at hand;
//! - [`wakeup`]: measures how late this computer wakes a thread;
//! - [`text`]: the result for people.
//!
//! Nothing is changed. What cannot be seen is no finding.

mod cpu;
pub mod ethtool;
mod host;
mod interrupts;
mod kernel;
mod mend;
mod nic;
mod permission;
mod text;
mod threads;
pub mod wakeup;

use std::path::PathBuf;

use serde::Serialize;

use crate::config::Bus;
use crate::rt::margin::Spin;
use crate::rt::thread::Denied;

use host::Cpus;
pub use host::Host;
use kernel::Kernel;
pub use mend::Mend;
use wakeup::WakeUp;

/// How much a finding matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Worth knowing; costs little.
    Note,
    /// Costs timing.
    Warning,
    /// A bus does not run like this, or loses cycles all the time.
    Bad,
}

/// Something to mend.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    pub severity: Severity,
    /// What it is about, the same in every release: `preemption`, `throttling` …
    pub id: &'static str,
    pub found: String,
    /// What it costs not to mend it.
    pub cost: String,
    pub mend: Vec<Mend>,
}

/// Something that is as it should be, or cannot be otherwise.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Fact {
    pub name: &'static str,
    pub value: String,
}

/// What is going to run here.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Intent {
    pub nic: Option<String>,
    /// `None`: not pinned.
    pub cpu: Option<usize>,
    /// SCHED_FIFO priority of the cycle.
    pub priority: u8,
    pub cycle_ns: u64,
    #[serde(skip)]
    pub spin: Spin,
    /// The program that needs the rights.
    pub program: PathBuf,
}

impl Intent {
    /// What a machine file without any of the keys means.
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

/// What was tried or asked beyond files.
#[derive(Debug, Clone, Default)]
pub struct Tried {
    /// What the network driver says; `None` where there is no interface to ask.
    pub nic: Option<ethtool::Answers>,
    pub wake_up: Option<WakeUp>,
}

/// The whole result. Findings: worst first.
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    pub intent: Intent,
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

/// Collects what the examinations say.
#[derive(Debug, Default)]
struct Notes {
    facts: Vec<Fact>,
    findings: Vec<Finding>,
}

impl Notes {
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
        mend: Vec<Mend>,
    ) {
        self.findings.push(Finding {
            severity,
            id,
            found: text::clean(&found.into()),
            cost: cost.into(),
            mend,
        });
    }
}

/// What several examinations need to know.
#[derive(Debug)]
struct Context<'a> {
    host: &'a Host,
    intent: &'a Intent,
    kernel: Kernel,
    online: Cpus,
    isolated: Cpus,
    /// The CPU of the cycle: as intended, or else the first isolated one.
    cpu: Option<usize>,
    /// In a container, what belongs to the computer cannot be changed.
    container: bool,
    threads: Vec<threads::Thread>,
}

impl<'a> Context<'a> {
    fn new(host: &'a Host, intent: &'a Intent) -> Self {
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
            container: mend::in_container(host),
            threads: threads::all(host),
        }
    }

    /// A CPU for everything that must not share the cycle's.
    fn elsewhere(&self) -> Option<usize> {
        let cpu = self.cpu?;
        let others = self.online.without(&Cpus::only(cpu));
        others.without(&self.isolated).first().or(others.first())
    }
}

/// The CPU that a cycle with this intent runs on: the intended one, or else the first isolated one.
#[must_use]
pub fn cycle_cpu(host: &Host, intent: &Intent) -> Option<usize> {
    let isolated = || host.cpus("sys/devices/system/cpu/isolated")?.first();
    intent.cpu.or_else(isolated)
}

/// Looks at everything.
#[must_use]
pub fn examine(host: &Host, intent: &Intent, tried: Tried) -> Report {
    let context = Context::new(host, intent);
    let denied: &[Denied] = tried.wake_up.as_ref().map_or(&[], |w| &w.denied);
    let mut notes = Notes::default();
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
