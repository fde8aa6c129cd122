//! One run: the files, the program, its recording and its result.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use super::generate::Plan;
use super::judge::{self, Finding};
use super::pcapng;
use super::shaft;
use super::verdict;
use super::view::{self, Axis};
use super::wire::{self, DriveLayout, Wire};

/// The limit of real time for a run; much longer than any run takes.
const TIMEOUT: Duration = Duration::from_secs(300);

#[derive(Debug, Clone, Default)]
pub struct Outcome {
    pub findings: Vec<Finding>,
    pub exit: i32,
    pub error: String,
    pub headline: String,
    /// True if the report names a fault of the script; `None`: not checked.
    pub right: Option<bool>,
    /// The start of the stop, counted from the first cycle.
    pub stop_s: Option<f64>,
    pub seconds: f64,
    pub cycles: usize,
}

pub fn binary() -> PathBuf {
    std::env::var_os("ECAXIS_CAMPAIGN_BINARY").map_or_else(
        || PathBuf::from(env!("CARGO_BIN_EXE_ecaxis")),
        PathBuf::from,
    )
}

fn esi() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/esi")
}

/// Returns the plan with all fault times. The times of mode changes and of the stop come from a run
/// without faults.
pub fn placed(plan: &Plan, folder: &Path) -> Plan {
    if plan.faults.iter().all(|fault| fault.after.is_none()) {
        return plan.clone();
    }
    let outcome = run(&plan.placed(&[], None), folder);
    let recording = std::fs::read(folder.join("run.pcapng")).unwrap_or_default();
    let packets = pcapng::packets(&recording).unwrap_or_default();
    let wire = read(plan, &packets);
    // The mode of an axis while Operation enabled is requested.
    let mode = |cycle: &wire::Cycle| {
        let sent = cycle.drives.first()?.as_ref()?.sent;
        sent.mode.filter(|_| sent.controlword & 0x0f == 0x0f)
    };
    let changes = wire.cycles.windows(2).filter(|pair| {
        mode(&pair[0]).is_some() && mode(&pair[1]).is_some() && mode(&pair[0]) != mode(&pair[1])
    });
    let times: Vec<f64> = changes.map(|pair| pair[1].at as f64 * 1e-9).collect();
    let first = wire.cycles.first().map(|cycle| cycle.at as f64 * 1e-9);
    let stop = outcome.stop_s.zip(first).map(|(stop, first)| first + stop);
    plan.placed(&times, stop)
}

/// Runs the plan in the folder and judges it.
pub fn run(plan: &Plan, folder: &Path) -> Outcome {
    let file = |name: &str| folder.join(name);
    write(plan, folder);
    let mut outcome = Outcome::default();
    let (exit, result, messages) = match plan.shaft {
        Some(feed) => {
            let (exit, result, messages) = shaft::run(plan, feed, folder);
            (Some(exit), Ok(result), messages)
        }
        None => {
            let exit = run_program(plan, folder);
            let text = |name: &str| {
                let bytes = std::fs::read(file(name)).unwrap_or_default();
                String::from_utf8_lossy(&bytes).into_owned()
            };
            (
                exit,
                serde_json::from_str(&text("out.json")),
                text("messages.txt"),
            )
        }
    };
    outcome.exit = exit.unwrap_or(-1);
    if !matches!(exit, Some(0 | 1)) || messages.contains("panicked") {
        let detail = format!("exit {exit:?}: {messages} {result:?}");
        outcome.findings.push(verdict::finding("exit-code", detail));
        return outcome;
    }
    let result = match result {
        Ok(result) => result,
        Err(error) => {
            outcome
                .findings
                .push(verdict::finding("result", error.to_string()));
            return outcome;
        }
    };
    let recording = std::fs::read(file("run.pcapng")).unwrap_or_default();
    let packets = match pcapng::packets(&recording) {
        Ok(packets) => packets,
        Err(error) => {
            outcome.findings.push(verdict::finding("recording", error));
            return outcome;
        }
    };
    let wire = read(plan, &packets);
    (outcome.seconds, outcome.cycles) = (wire.seconds, wire.cycles.len());
    let mut report = verdict::report(outcome.exit, &result, &mut outcome);
    // What a failed run printed about further axes.
    let messages = std::fs::read_to_string(file("messages.txt")).unwrap_or_default();
    let warnings = messages
        .lines()
        .filter(|line| line.starts_with("warning: "));
    for line in warnings.filter(|_| outcome.exit != 0) {
        report.text.push('\n');
        report.text.push_str(line);
    }
    outcome.stop_s = report.stop_s;
    outcome
        .findings
        .append(&mut judge::judge(&plan.machine, &wire, &report));
    verdict::check(plan, &wire, &report, &result, &mut outcome);
    outcome
}

/// Writes the files of a plan into the folder.
pub fn write(plan: &Plan, folder: &Path) {
    let esi = esi().canonicalize().expect("configs/esi");
    let machine = plan
        .machine_file
        .replace("\"esi/", &format!("\"{}/", esi.display()));
    let file = |name: &str, text: &str| std::fs::write(folder.join(name), text).expect("written");
    file("machine.toml", &machine);
    file("faults.toml", &plan.fault_script);
    for (name, text) in &plan.files {
        file(name, text);
    }
    _ = std::fs::remove_file(folder.join("run.pcapng"));
}

/// Runs the program on the files in the folder. `None`: it did not end in time.
fn run_program(plan: &Plan, folder: &Path) -> Option<i32> {
    let output = |name: &str| std::fs::File::create(folder.join(name)).expect("an output");
    let limit = format!("{:.0}ms", plan.ends_at * 1e3);
    let limit = ["--for", &limit];
    let mut child = Command::new(binary())
        .current_dir(folder)
        .args([
            "run",
            "machine.toml",
            "--sim",
            "--virtual",
            "--json",
            "--no-fault-report",
        ])
        .args(["--faults", "faults.toml", "--record", "run.pcapng"])
        .args(["--seed", &plan.seed.to_string()])
        .args(limit.iter().filter(|_| !plan.once))
        .env_remove("RUST_LOG")
        .stdin(Stdio::null())
        .stdout(output("out.json"))
        .stderr(output("messages.txt"))
        .spawn()
        .expect("the program starts");
    let start = Instant::now();
    loop {
        match child.try_wait().expect("the program is ours") {
            Some(status) => return status.code(),
            None if start.elapsed() > TIMEOUT => {
                _ = child.kill();
                _ = child.wait();
                return None;
            }
            None => std::thread::sleep(Duration::from_millis(2)),
        }
    }
}

/// Writes and runs the plan, and returns the recording.
pub fn record(plan: &Plan, folder: &Path) -> Vec<u8> {
    write(plan, folder);
    match plan.shaft {
        Some(feed) => _ = shaft::run(plan, feed, folder),
        None => _ = run_program(plan, folder),
    }
    std::fs::read(folder.join("run.pcapng")).expect("a recording")
}

fn read(plan: &Plan, packets: &[pcapng::Packet<'_>]) -> Wire {
    let layouts: Vec<DriveLayout> = plan.machine.axes.iter().map(Axis::layout).collect();
    wire::read(packets, &layouts, &plan.machine.terminals)
}

/// Formats the data of a finding's drive around that cycle, one line per cycle.
pub fn around(plan: &Plan, folder: &Path, finding: &Finding) -> String {
    let recording = std::fs::read(folder.join("run.pcapng")).unwrap_or_default();
    let packets = pcapng::packets(&recording).unwrap_or_default();
    let wire = read(plan, &packets);
    let drive = plan
        .machine
        .axes
        .iter()
        .position(|axis| axis.name == finding.axis);
    let Some(drive) = drive else {
        return String::new();
    };
    let near = finding.cycle.saturating_sub(12)..finding.cycle + 5;
    let mut text = format!("{finding}\n");
    let moments = view::views(&plan.machine, &wire).swap_remove(drive);
    for moment in moments.iter().filter(|moment| near.contains(&moment.cycle)) {
        let answered = wire.cycles[moment.cycle].drives[drive].and_then(|of| of.heard);
        let _ = writeln!(text, "  {moment}, answered {}", answered.is_some());
    }
    text
}
