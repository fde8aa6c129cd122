//! Machines as text, and their runs in virtual time.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::Clock;
use ecaxis_master::config::{self, Machine};
use ecaxis_master::session::{self, Observer, Options, Outcome, Progress, Summary};
use ecaxis_sim::FaultScript;

use crate::root;

/// Parses a machine file given as text; its paths are relative to `configs/`.
pub fn machine(text: &str) -> Machine {
    match config::parse(&root().join("configs/test.toml"), text) {
        Ok(machine) => machine,
        Err(error) => panic!("{error}"),
    }
}

/// Loads one of the project's machine files.
pub fn load(name: &str) -> Machine {
    match config::load(&root().join("configs").join(name)) {
        Ok(machine) => machine,
        Err(error) => panic!("{error}"),
    }
}

/// Returns the text with absolute paths to the project's ESI files, for a machine file elsewhere.
pub fn with_our_esi(text: &str) -> String {
    let esi = root().join("configs/esi");
    text.replace("\"esi/", &format!("\"{}/", esi.display()))
}

/// Returns the demonstration, with a bus that tolerates a stalling test computer.
pub fn tolerant_demo() -> String {
    let demo = std::fs::read_to_string(root().join("configs/demo.toml")).expect("our file");
    tolerant(&with_our_esi(&demo))
}

/// Returns the machine file with a tolerance for stalls of a test computer, which are longer than a
/// machine tolerates. Other values of `lost_frames` disappear.
#[track_caller]
pub fn tolerant(text: &str) -> String {
    let (before, bus) = text.split_once("[bus]\n").expect("a machine file");
    let rest: String = bus
        .split_inclusive('\n')
        .filter(|line| !line.starts_with("lost_frames"))
        .collect();
    format!("{before}[bus]\nlost_frames = 1000\nwatchdog = \"6s\"\n{rest}")
}

#[derive(Debug, Default)]
pub struct Heard(pub Vec<Progress>);

impl Observer for Heard {
    fn progress(&mut self, progress: &Progress) {
        self.0.push(progress.clone());
    }
}

impl Heard {
    /// Returns all warnings, including unsolicited device reports.
    pub fn warnings(&self) -> Vec<String> {
        self.0
            .iter()
            .filter_map(|p| match p {
                Progress::Warning(text) => Some(text.clone()),
                Progress::Emergency(report) => Some(report.to_string()),
                _ => None,
            })
            .collect()
    }
}

pub fn virtual_time() -> Options {
    Options {
        clock: Clock::Virtual,
        ..Options::default()
    }
}

pub fn faults(script: &str) -> Options {
    let faults = FaultScript::parse(script).unwrap_or_else(|error| panic!("{error}"));
    Options {
        faults: Some(faults),
        ..virtual_time()
    }
}

/// Returns the options with a recording in the folder, and its path.
pub fn recorded(options: Options, folder: &Path) -> (Options, PathBuf) {
    let path = folder.join("run.pcapng");
    let record = Some(path.clone());
    (Options { record, ..options }, path)
}

pub fn run(machine: Machine, options: Options) -> (Outcome, Heard) {
    let mut heard = Heard::default();
    let outcome = session::run(machine, options, Arc::<CancelToken>::default(), &mut heard);
    (outcome, heard)
}

/// Runs a machine that must complete its whole program.
pub fn run_well(machine: Machine, options: Options) -> Summary {
    let (outcome, heard) = run(machine, options);
    if let Err(error) = outcome.result {
        panic!("{error}; warnings: {:?}", heard.warnings());
    }
    outcome.summary.expect("a summary")
}

/// Runs a machine that must fail. Returns the error text, and the summary if the cycle ran.
pub fn run_badly(machine: Machine, options: Options) -> (String, Option<Summary>) {
    let (outcome, _) = run(machine, options);
    match outcome.result {
        Err(error) => (error.to_string(), outcome.summary),
        Ok(()) => panic!("the run must fail; it ended with {:#?}", outcome.summary),
    }
}

/// Returns a machine of `count` CSP axes `a0`, `a1`, … at 1 ms that move 80 turns and back, 1.7 s
/// each.
pub fn axes(count: usize) -> String {
    let mut text = String::from("[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n");
    for i in 0..count {
        text += &format!(
            r#"
[[device]]
name = "a{i}"
esi = "esi/EPOS4.xml"
position = {i}
mode = "csp"
[device.axis]
unit = "turn"
per_turn = 1.0
encoder = 2000
limits = {{ position = [-100.0, 100.0], velocity = 50.0, acceleration = 500.0, torque = 100.0, following_error = 1.0 }}
"#
        );
    }
    for target in [80.0, 0.0] {
        text += "\n[[step]]\nmove = { ";
        text += &(0..count)
            .map(|i| format!("a{i} = {target}"))
            .collect::<Vec<_>>()
            .join(", ");
        text += " }\n";
    }
    text
}

/// Returns the ESI of the EPOS4 with a position of the load (0x60E4:01).
pub fn with_load_encoder(epos4: &str) -> String {
    let item = |sub, name, kind, bits, at| {
        format!(
            "<SubItem><SubIdx>{sub}</SubIdx><Name>{name}</Name><Type>{kind}</Type><BitSize>{bits}</BitSize>\
             <BitOffs>{at}</BitOffs><Flags><Access>ro</Access><PdoMapping>T</PdoMapping></Flags></SubItem>"
        )
    };
    let kind = format!(
        "<DataType><Name>DT60E4</Name><BitSize>48</BitSize>{}{}</DataType><DataType><Name>BOOL</Name>",
        item(0, "Highest subindex", "USINT", 8, 0),
        item(1, "Position of the load", "DINT", 32, 16)
    );
    let object = "<Object><Index>#x60E4</Index><Name>Additional position actual value</Name><Type>DT60E4</Type>\
        <BitSize>48</BitSize><Info><SubItem><Name>Highest subindex</Name><Info><DefaultValue>1</DefaultValue></Info></SubItem>\
        </Info><Flags><Access>ro</Access><PdoMapping>T</PdoMapping></Flags></Object>\n              <Object>\n                <Index>#x6065</Index>";
    let text = epos4.replacen("<DataType><Name>BOOL</Name>", &kind, 1);
    text.replacen("<Object>\n                <Index>#x6065</Index>", object, 1)
}
