//! One run of a machine: opens the link and brings the bus up (`prepare`), turns the cycle (`turn`), and sums up (`summary`).
//!
//! One thread owns the link. In real time it becomes the real-time thread and a second one runs
//! the supervisor beside it; in virtual time it does both in turn, so that a run can be repeated.

use std::io::Write as _;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::mpsc::{Sender, channel};
use std::thread;

use ecaxis_sim::FaultScript;

use crate::clock::{Clock, Nanos};
use crate::config::Machine;
use crate::link::Link;
use crate::rt::controller::Controller;
use crate::rt::cycle::Remains;
use crate::rt::stats::Stats;
use crate::story::Story;
use crate::supervise::manual::{self, Operator};

mod emergencies;
mod error;
mod events;
mod open;
mod prepare;
mod progress;
mod signals;
mod story;
mod summary;
mod turn;

pub use crate::supervise::history::{DiagnosisKind, DiagnosisMessage};
pub use emergencies::{EmergencyLine, EmergencyReport, Log};
pub use error::{DriveReport, RunError};
pub use events::EventLine;
pub(crate) use events::clock_off;
pub use open::{recorded, simulated_bus, topology};
pub use prepare::{Job, Prepared};
use prepare::{go_silent, lacking};
pub use progress::{AxisLine, Capture, Observer, Progress, Status, StepRef};
pub use signals::{SignalReport, stop_on_signals};
use story::{Left, Seen};
use summary::Aside;
pub use summary::{AxisSummary, DeviceErrors, GroupStop, Summary, ThreadSummary};
use turn::Turned;

/// Stack of the thread that owns the link; ethercrab's futures hold its tables by value.
const STACK: usize = 16 * 1024 * 1024;

/// The thread that owns the link.
const RT_THREAD: &str = "ecaxis-rt";
/// Panics of that thread that are reported.
const REPORTED_PANICS: u32 = 10;

/// How a machine is run.
#[derive(Debug, Clone)]
pub struct Options {
    pub clock: Clock,
    /// Time limit of the program; it is repeated until then.
    pub limit: Option<Nanos>,
    /// Runs of the program instead of the file's.
    pub repeat: Option<u32>,
    /// Of the simulated bus.
    pub seed: u64,
    pub faults: Option<FaultScript>,
    /// Keep every frame here.
    pub record: Option<PathBuf>,
    /// Of a recording; the newest frames are kept, see [`crate::link::capture`].
    pub record_limit: Option<u64>,
    /// Answer from this recording in the place of a bus.
    pub replay: Option<PathBuf>,
    /// Enable the axes and run the program; otherwise stay in Op without power.
    pub enable: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            clock: Clock::Real,
            limit: None,
            repeat: None,
            seed: 1,
            faults: None,
            record: None,
            record_limit: None,
            replay: None,
            enable: true,
        }
    }
}

/// How a run ended. There is a summary as soon as the cycle has run.
#[derive(Debug)]
pub struct Outcome {
    pub summary: Option<Summary>,
    pub result: Result<(), RunError>,
    /// What the summary is of.
    pub stats: Option<Box<Stats>>,
    /// Of a failure on the bus, or of a group that stopped and was not reset.
    pub story: Option<Box<Story>>,
}

impl From<RunError> for Outcome {
    fn from(error: RunError) -> Self {
        Self {
            summary: None,
            result: Err(error),
            stats: None,
            story: None,
        }
    }
}

/// Runs a machine until its program, its time limit, `stop` ([`stop_on_signals`]) or an error ends it. Blocks; tells the
/// observer meanwhile. Where the observer panics, the panic goes on once the machine has been stopped.
pub fn run(
    machine: Machine,
    options: Options,
    stop: Arc<AtomicBool>,
    observer: &mut dyn Observer,
) -> Outcome {
    start(machine, options, stop, observer, Instead::Nobody, None)
}

/// Like [`run`], on a link of one's own in the place of the file's `nic`.
pub fn run_on(
    link: Box<dyn Link>,
    machine: Machine,
    options: Options,
    stop: Arc<AtomicBool>,
    observer: &mut dyn Observer,
) -> Outcome {
    start(
        machine,
        options,
        stop,
        observer,
        Instead::Nobody,
        Some(link),
    )
}

/// Like [`run`], with a controller of one's own in the place of the file's program: all axes are enabled, then they are
/// its until it calls [`rt::controller::Cycle::finish`], or something else ends the run.
pub fn run_with(
    machine: Machine,
    options: Options,
    stop: Arc<AtomicBool>,
    observer: &mut dyn Observer,
    controller: Box<dyn Controller>,
) -> Outcome {
    let controller = Instead::Controller(controller);
    start(machine, options, stop, observer, controller, None)
}

/// Like [`run`], with somebody in the file's program's place: axes are enabled and moved when they ask for it, until they
/// leave or something else ends the run. See [`manual::by_hand`] for what of the file is different.
pub fn run_by_hand(
    machine: Machine,
    options: Options,
    stop: Arc<AtomicBool>,
    observer: &mut dyn Observer,
    operator: Box<dyn Operator>,
) -> Outcome {
    let machine = manual::by_hand(machine);
    let options = Options {
        enable: true,
        ..options
    };
    let operator = Instead::Operator(operator);
    start(machine, options, stop, observer, operator, None)
}

/// Who takes the place of the file's program.
enum Instead {
    Nobody,
    Controller(Box<dyn Controller>),
    Operator(Box<dyn Operator>),
}

fn start(
    machine: Machine,
    options: Options,
    stop: Arc<AtomicBool>,
    observer: &mut dyn Observer,
    instead: Instead,
    link: Option<Box<dyn Link>>,
) -> Outcome {
    report_panics_briefly();
    let (progress, told) = channel();
    let stopped = Arc::clone(&stop);
    let owner = thread::Builder::new()
        .name(RT_THREAD.to_owned())
        .stack_size(STACK)
        .spawn(move || own_the_link(&Arc::new(machine), &options, stop, progress, instead, link));
    let owner = match owner {
        Ok(owner) => owner,
        Err(error) => return RunError::Thread(error.to_string()).into(),
    };
    let observed = catch_unwind(AssertUnwindSafe(|| {
        for progress in told {
            observer.progress(&progress);
        }
    }));
    // The process may end with an observer that panics: the axes come to rest before.
    if observed.is_err() {
        stopped.store(true, Ordering::Relaxed);
    }
    let outcome = owner
        .join()
        .unwrap_or_else(|panic| RunError::Panicked(panic_text(&*panic)).into());
    observed.map_or_else(|panic| resume_unwind(panic), |()| outcome)
}

/// A panic of the real-time thread is one line, and no backtrace: looking up its symbols takes longer than the drives' watchdogs.
fn report_panics_briefly() {
    static ONCE: std::sync::Once = std::sync::Once::new();
    static REPORTED: AtomicU32 = AtomicU32::new(0);
    ONCE.call_once(|| {
        let hook = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            if thread::current().name() != Some(RT_THREAD) {
                hook(panic);
            } else if REPORTED.fetch_add(1, Ordering::Relaxed) < REPORTED_PANICS {
                let _ = writeln!(std::io::stderr(), "{RT_THREAD}: {panic}");
            }
        }));
    });
}

pub(crate) fn panic_text(panic: &(dyn std::any::Any + Send)) -> String {
    panic
        .downcast_ref::<String>()
        .cloned()
        .or_else(|| panic.downcast_ref::<&str>().map(|text| (*text).to_owned()))
        .unwrap_or_else(|| "unknown cause".to_owned())
}

fn own_the_link(
    machine: &Arc<Machine>,
    options: &Options,
    stop: Arc<AtomicBool>,
    progress: Sender<Progress>,
    instead: Instead,
    link: Option<Box<dyn Link>>,
) -> Outcome {
    options.clock.enter();
    let told = progress.clone();
    let mut seen = Seen::default();
    let (controller, operator) = match instead {
        Instead::Nobody => (None, None),
        Instead::Controller(controller) => (Some(controller), None),
        Instead::Operator(operator) => (None, Some(operator)),
    };
    let job = Job {
        machine,
        options,
        stop,
        progress,
        controller,
    };
    let prepared = match link {
        Some(link) => job.prepare_with(link, &mut seen),
        None => job.prepare_seeing(&mut seen),
    };
    let Prepared {
        parts,
        mut supervisor,
    } = match prepared {
        Ok(prepared) => prepared,
        Err(error) => {
            return Outcome {
                story: story::of_bring_up(machine, options, &error, seen),
                ..error.into()
            };
        }
    };
    supervisor.operator = operator;
    let wire = supervisor.wire;
    let places = story::places(&supervisor.bus);
    let log = supervisor.log.clone();
    let machine = &Arc::clone(&supervisor.machine);
    let Turned {
        remains,
        result: (mut ended, result),
        used,
    } = match options.clock {
        Clock::Virtual => turn::in_virtual_time(parts, supervisor),
        Clock::Real => match turn::in_real_time(parts, supervisor, &machine.bus, &told) {
            Ok(done) => done,
            Err(error) => return error.into(),
        },
    };
    let Remains {
        mut link,
        mut port,
        axes,
        stats,
        spin_ns,
        diagnoses,
        windows,
        started,
        history,
        stops,
    } = remains;
    let result = result.map_err(|error| lacking(error, link.as_ref(), "the run does"));
    if result.is_err() {
        go_silent(options.clock, wire.main_device(), link.as_mut(), &mut port);
    }
    let seen = link.stats();
    for remark in link.remarks() {
        let _ = told.send(Progress::Warning(remark));
    }
    let (record, result) = match link.finish() {
        Ok(record) => (record, result),
        Err(error) => (None, result.and(Err(RunError::Record(error.to_string())))),
    };
    let thread = used.map(|(used, wall_ns)| ThreadSummary::new(used, wall_ns, spin_ns, &stats));
    let events = events::lines(&stats.journal, started, machine);
    let (unreleased, then) = ended.left.take().unzip();
    let failed = result.as_ref().err().or(unreleased.as_deref());
    let witnessed = ended.witnessed.take().or(then).unwrap_or_default();
    let story = failed.and_then(|error| {
        let left = Left {
            places,
            witnessed,
            diagnoses: &diagnoses,
            windows: &windows,
            stats: &stats,
            axes: &axes,
            history: &history,
            started,
            link: seen,
            events: &events,
        };
        story::of_run(machine, options, error, left)
    });
    let aside = Aside {
        link: seen,
        thread,
        record,
        errors: summary::device_errors(machine, &diagnoses),
        events,
        emergencies: log.lines(started),
        started,
        stops,
    };
    let summary = Summary::new(machine, options.clock, &axes, &stats, ended, aside);
    Outcome {
        summary: Some(summary),
        result,
        stats: Some(Box::new(stats)),
        story,
    }
}
