//! Stops of drives in motion after failures of the program, the host or the bus: over a veth pair
//! (root), judged by the motion of the simulated drives (`ecaxis sim --trace`). Prints the time to
//! standstill and the means of each trial.
//!
//! `ECAXIS_TRIALS=20` repeats every trial. `ECAXIS_TRIAL=TEXT` runs only trials whose name contains
//! the text.

mod freeze;
mod library;
mod trace;

use std::cell::RefCell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::thread::sleep;
use std::time::Duration;

use super::veth::can_be_kept_apart;
use ecaxis_test_support::host::over_a_pair;
use ecaxis_test_support::program::{ProgramOutput, ecaxis};
use ecaxis_test_support::with_our_esi;
use ecaxis_tools::bench::veth::VethPair;
use library::{Injected, Library};
use rustix::process::Signal;
use trace::{Stop, Table, Trace};

/// The speed of both axes in turns/s.
const SPEED: f64 = 20.0;
/// A timeout longer than every permitted stop.
const TIMEOUT: Duration = Duration::from_secs(6);

/// Two drives, one in CSP and one in CSV, and an I/O block behind them.
const MACHINE: &str = r#"
[bus]
nic = "sim"
cycle = "1ms"
lost_frames = 30
CPU

[[device]]
name = "csp"
esi = "esi/EPOS4.xml"
position = 0
mode = "csp"
[device.axis]
unit = "turn"
encoder = 2000
limits = { position = [-500000.0, 500000.0], velocity = 50.0, acceleration = 500.0, torque = 100.0, following_error = 5.0 }

[[device]]
name = "csv"
esi = "esi/EPOS4.xml"
position = 1
mode = "csv"
[device.axis]
unit = "turn"
encoder = 2000
limits = { velocity = 50.0, acceleration = 500.0, torque = 100.0 }

[[device]]
name = "io"
esi = "esi/IO8.xml"
position = 2

[[step]]
velocity = { csp = SPEED, csv = SPEED }
[[step]]
dwell = "10min"
"#;

/// The event during motion.
#[derive(Debug, Clone, Copy)]
enum Event {
    /// A signal to the process that drives the axes.
    Signal(Signal),
    /// An ignored signal; SIGTERM stops the machine afterwards.
    Ignored(Signal),
    /// The fault script starts, and the axes stop by themselves.
    Fault,
    /// The fault script starts but stops nothing; SIGTERM stops the machine afterwards.
    Tolerated,
    /// The thread next to the cycle is frozen.
    Frozen,
    /// A panic in the process of this test, through the library.
    Library(Injected),
}

struct Trial {
    name: &'static str,
    event: Event,
    /// The script's only fault, which starts with the event.
    fault: Option<&'static str>,
    /// The program's exit code; `None`: it is killed.
    exit: Option<i32>,
    /// The number of drives, from the first, that are still reached by frames and stop by
    /// set-points.
    ramped: usize,
}

const fn trial(name: &'static str, event: Event, exit: Option<i32>, ramped: usize) -> Trial {
    Trial {
        name,
        event,
        fault: None,
        exit,
        ramped,
    }
}

const fn fault(name: &'static str, script: &'static str, ramped: usize) -> Trial {
    Trial {
        name,
        event: Event::Fault,
        fault: Some(script),
        exit: Some(1),
        ramped,
    }
}

const TRIALS: &[Trial] = &[
    trial("kill -9", Event::Signal(Signal::KILL), None, 0),
    trial("SIGTERM", Event::Signal(Signal::TERM), Some(130), 2),
    trial("SIGHUP", Event::Signal(Signal::HUP), Some(130), 2),
    trial(
        "SIGTSTP, then SIGTERM",
        Event::Ignored(Signal::TSTP),
        Some(130),
        2,
    ),
    // SIGCONT follows when the axes are at rest.
    trial("SIGSTOP", Event::Signal(Signal::STOP), Some(1), 0),
    trial("frozen mailbox thread", Event::Frozen, Some(1), 2),
    trial(
        "panic in a controller",
        Event::Library(Injected::Controller),
        Some(1),
        2,
    ),
    trial(
        "panic in the cycle",
        Event::Library(Injected::Cycle { times: 1 }),
        Some(1),
        2,
    ),
    trial(
        "panic in the cycle and its stop",
        Event::Library(Injected::Cycle { times: 2 }),
        Some(1),
        0,
    ),
    trial(
        "panic in every frame",
        Event::Library(Injected::Cycle { times: usize::MAX }),
        Some(1),
        0,
    ),
    fault(
        "power loss of `csp`",
        "kind = \"power-off\"\ndevice = 0\n",
        0,
    ),
    fault(
        "power loss of `csv`",
        "kind = \"power-off\"\ndevice = 1\n",
        1,
    ),
    fault(
        "power loss of `io`",
        "kind = \"power-off\"\ndevice = 2\n",
        2,
    ),
    fault(
        "cable break before `csp`",
        "kind = \"link-break\"\ndevice = 0\n",
        0,
    ),
    fault(
        "cable break before `csv`",
        "kind = \"link-break\"\ndevice = 1\n",
        1,
    ),
    fault(
        "cable break before `io`",
        "kind = \"link-break\"\ndevice = 2\n",
        2,
    ),
    Trial {
        name: "silent mailbox, then SIGTERM",
        event: Event::Tolerated,
        fault: Some("kind = \"mailbox-silent\"\ndevice = 0\n"),
        exit: Some(130),
        ramped: 2,
    },
];

/// The simulated bus of a trial.
struct Bus {
    process: ProgramOutput,
    trace: Trace,
}

struct Bench<'p> {
    pair: &'p VethPair,
    folder: tempfile::TempDir,
    /// True if both ends have separate processors. Both spin with real-time priority.
    apart: bool,
}

impl<'p> Bench<'p> {
    fn new(pair: &'p VethPair) -> Self {
        let apart = can_be_kept_apart();
        let bench = Self {
            pair,
            folder: tempfile::tempdir().expect("a folder"),
            apart,
        };
        let text = with_our_esi(MACHINE)
            .replace("CPU", if apart { "cpu = 1" } else { "" })
            .replace("SPEED", &format!("{SPEED:.1}"));
        std::fs::write(bench.file(), text).expect("written");
        bench
    }

    fn file(&self) -> PathBuf {
        self.path("m.toml")
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn ecaxis(&self, cpu_0: bool) -> Command {
        let program = ecaxis();
        let mut command = match cpu_0 && self.apart {
            true => {
                let mut command = Command::new("taskset");
                command.args(["-c", "0"]).arg(program);
                command
            }
            false => Command::new(program),
        };
        command.current_dir(self.folder.path());
        command.stdin(Stdio::null()).stdout(Stdio::null());
        command
    }

    fn serve(&self, fault: Option<&str>) -> Bus {
        let trace = self.path("trace.csv");
        let _ = std::fs::remove_file(&trace);
        let mut command = self.ecaxis(true);
        command
            .args(["sim", "m.toml", "--nic", &self.pair.a, "--trace"])
            .arg(&trace);
        if let Some(fault) = fault {
            std::fs::write(self.path("f.toml"), format!("[[fault]]\n{fault}")).expect("written");
            command.args(["--faults", "f.toml", "--faults-on-signal"]);
        }
        let mut process = ProgramOutput::start(&mut command);
        process.says("answer");
        Bus {
            process,
            trace: Trace::open(&trace),
        }
    }

    fn run(&self) -> ProgramOutput {
        let mut command = self.ecaxis(false);
        ProgramOutput::start(command.args([
            "run",
            "m.toml",
            "--no-fault-report",
            "--nic",
            &self.pair.b,
        ]))
    }

    fn perform(&self, trial: &Trial, bus: &mut Bus) -> Stop {
        if let Event::Library(injected) = trial.event {
            let run = Library::start(&self.file(), &self.pair.b, injected);
            bus.trace.await_speed(SPEED);
            let began = bus.trace.now();
            run.inject();
            let stop = bus.trace.await_standstill(began, trial.ramped);
            let failed = run.end();
            assert_eq!(Some(i32::from(failed)), trial.exit, "{}", trial.name);
            return bus.trace.stays(stop);
        }
        let run = self.run();
        bus.trace.await_speed(SPEED);
        let mut began = bus.trace.now();
        let mut frozen = None;
        match trial.event {
            Event::Signal(signal) => run.signal(signal),
            Event::Fault => bus.process.signal(Signal::USR1),
            Event::Frozen => frozen = Some(freeze::thread(run.id(), "ecaxis-services")),
            Event::Ignored(_) | Event::Tolerated => {
                match trial.event {
                    Event::Ignored(signal) => run.signal(signal),
                    _ => bus.process.signal(Signal::USR1),
                }
                sleep(Duration::from_millis(300));
                bus.trace.await_speed(SPEED);
                began = bus.trace.now();
                run.signal(Signal::TERM);
            }
            Event::Library(_) => unreachable!("above"),
        }
        let stop = bus.trace.await_standstill(began, trial.ramped);
        drop(frozen);
        if matches!(trial.event, Event::Signal(Signal::STOP)) {
            run.signal(Signal::CONT);
        }
        let output = run.end();
        let reported = String::from_utf8_lossy(&output.stderr);
        if trial.exit.is_some() {
            assert_eq!(
                output.status.code(),
                trial.exit,
                "{}: {reported}",
                trial.name
            );
        }
        // No axis turns again, whatever the program did before it ended.
        bus.trace.stays(stop)
    }
}

fn repetitions() -> usize {
    let wanted = std::env::var("ECAXIS_TRIALS").ok();
    wanted.and_then(|n| n.parse().ok()).unwrap_or(1)
}

fn chosen() -> Vec<&'static Trial> {
    let part = std::env::var("ECAXIS_TRIAL").unwrap_or_default();
    let each = TRIALS.iter().filter(|trial| trial.name.contains(&part));
    each.collect()
}

/// Runs a trial over its own interface pair and bus. Returns `None` without interfaces, or if the
/// computer stalled in every try.
fn perform(trial: &Trial) -> Option<Stop> {
    let done = RefCell::new(None);
    over_a_pair(|pair| {
        let bench = Bench::new(&pair);
        let mut bus = bench.serve(trial.fault);
        *done.borrow_mut() = Some(bench.perform(trial, &mut bus));
    });
    done.into_inner()
}

#[test]
fn every_drive_comes_to_rest() {
    let mut table = Table::default();
    let mut failed = Vec::new();
    for trial in chosen() {
        for _ in 0..repetitions() {
            match catch_unwind(AssertUnwindSafe(|| perform(trial))) {
                Ok(Some(stop)) => table.add(trial.name, &stop),
                Ok(None) => {}
                Err(_) => failed.push(trial.name),
            }
        }
    }
    println!("{table}");
    assert!(failed.is_empty(), "{failed:?}");
}
