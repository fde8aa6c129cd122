//! One run: the files, the program, its recording and its result.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use super::generate::Plan;
use super::judge::{self, Finding};
use super::pcapng;
use super::verdict;
use super::view::{self, Axis};
use super::wire::{self, DriveLayout};

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

fn binary() -> PathBuf {
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
    let wire = wire::read(&packets, &layouts(plan));
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
    let esi = esi().canonicalize().expect("configs/esi");
    let machine = plan
        .machine_file
        .replace("\"esi/", &format!("\"{}/", esi.display()));
    std::fs::write(file("machine.toml"), machine).expect("machine.toml");
    std::fs::write(file("faults.toml"), &plan.fault_script).expect("faults.toml");
    _ = std::fs::remove_file(file("run.pcapng"));
    let output = |name: &str| std::fs::File::create(file(name)).expect("an output");
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
        .args(["--for", &format!("{:.0}ms", plan.ends_at * 1e3)])
        .env_remove("RUST_LOG")
        .stdin(Stdio::null())
        .stdout(output("out.json"))
        .stderr(output("messages.txt"))
        .spawn()
        .expect("the program starts");
    let start = Instant::now();
    let exit = loop {
        match child.try_wait().expect("the program is ours") {
            Some(status) => break status.code(),
            None if start.elapsed() > TIMEOUT => {
                _ = child.kill();
                _ = child.wait();
                break None;
            }
            None => std::thread::sleep(Duration::from_millis(2)),
        }
    };
    let read = |name: &str| std::fs::read(file(name)).unwrap_or_default();
    let text = |name: &str| String::from_utf8_lossy(&read(name)).into_owned();
    let (result, messages) = (text("out.json"), text("messages.txt"));
    let mut outcome = Outcome {
        exit: exit.unwrap_or(-1),
        ..Outcome::default()
    };
    if !matches!(exit, Some(0 | 1)) || messages.contains("panicked") {
        let detail = format!("exit {exit:?}: {messages} {result}");
        outcome.findings.push(verdict::finding("exit-code", detail));
        return outcome;
    }
    let result = match serde_json::from_str(&result) {
        Ok(result) => result,
        Err(error) => {
            outcome
                .findings
                .push(verdict::finding("result", error.to_string()));
            return outcome;
        }
    };
    let recording = read("run.pcapng");
    let packets = match pcapng::packets(&recording) {
        Ok(packets) => packets,
        Err(error) => {
            outcome.findings.push(verdict::finding("recording", error));
            return outcome;
        }
    };
    let wire = wire::read(&packets, &layouts(plan));
    (outcome.seconds, outcome.cycles) = (wire.seconds, wire.cycles.len());
    let report = verdict::report(outcome.exit, &result, &mut outcome);
    outcome.stop_s = report.stop_s;
    outcome
        .findings
        .append(&mut judge::judge(&plan.machine, &wire, &report));
    verdict::check(plan, &wire, &report, &result, &mut outcome);
    outcome
}

fn layouts(plan: &Plan) -> Vec<DriveLayout> {
    let layout = |axis: &Axis| DriveLayout {
        position: axis.position,
        outputs: axis.outputs.clone(),
        inputs: axis.inputs.clone(),
    };
    plan.machine.axes.iter().map(layout).collect()
}

/// Formats the data of a finding's drive around that cycle, one line per cycle.
pub fn around(plan: &Plan, folder: &Path, finding: &Finding) -> String {
    let recording = std::fs::read(folder.join("run.pcapng")).unwrap_or_default();
    let packets = pcapng::packets(&recording).unwrap_or_default();
    let wire = wire::read(&packets, &layouts(plan));
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
    let moments = view::moments(&plan.machine, &wire, drive);
    for moment in moments.iter().filter(|moment| near.contains(&moment.cycle)) {
        let answered = wire.cycles[moment.cycle].drives[drive].and_then(|of| of.heard);
        let _ = writeln!(text, "  {moment}, answered {}", answered.is_some());
    }
    text
}
