//! One run of a machine: opens the link, brings the bus up (`prepare`), runs the cycle
//! (`cycle_thread`) and sums up (`summary`).
//!
//! One thread owns the link. In real time it becomes the real-time thread, and a second thread runs
//! the supervisor. In virtual time it alternates between both, so a run is reproducible.

use std::io::Write as _;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::{Sender, channel};
use std::thread;

use ecaxis_sim::FaultScript;

use crate::cancel::CancelToken;
use crate::clock::{Clock, Nanos};
use crate::config::Machine;
use crate::eoe::EthernetInterface;
use crate::link::Link;
use crate::mailbox_gateway::{BoundGateway, GatewayThread};
use crate::post_mortem::FaultReport;
use crate::rt::controller::Controller;
use crate::rt::cycle::EngineReport;
use crate::rt::samples::SampleWriter;
use crate::rt::setpoint_cell::SetpointCells;
use crate::rt::stats::Stats;
use crate::supervise::operator::{self, Operator};
use crate::supervise::{ProgramControl, Supervisor};

mod bus;
mod cycle_thread;
mod fault_evidence;
mod open;
mod prepare;
mod retry;
mod signals;

use crate::report::events;
use crate::report::summary::{self, SummaryInputs};
pub use crate::report::{
    AxisLine, AxisSummary, Cause, DeviceErrors, DiagnosisKind, DiagnosisMessage, DriveReport,
    EmergencyLine, EmergencyLog, EmergencyReport, Error, EventLine, GatewaySummary, GroupStop,
    NodeSummary, Observer, ProbeCapture, Progress, Status, StepRef, Summary, ThreadSummary,
};
use crate::sys::rights;
use crate::sys::tap::{TapError, TapInterface};
use crate::text::panic_text;
pub use bus::{run_on_link, with_bus};
use cycle_thread::CycleRun;
use fault_evidence::{BringUpEvidence, RunEvidence};
pub use open::{recorded, recording_comment, ring, simulated_bus, simulated_link, topology};
pub use prepare::{Prepared, RunBuilder};
use prepare::{broadcast_init, prefer_replay_end};
pub use retry::RetryDelay;
pub use signals::{SignalReport, stop_on_signals};

/// The stack size in bytes of the thread that owns the link. ethercrab's futures hold its tables by
/// value.
const STACK: usize = 16 * 1024 * 1024;

/// The name of the thread that owns the link.
const RT_THREAD: &str = "ecaxis-rt";
/// The maximum number of panics of that thread that are reported.
const REPORTED_PANICS: u32 = 10;

/// Options of a run.
#[derive(Debug, Clone)]
pub struct Options {
    pub clock: Clock,
    /// The time limit of the program. The program repeats until then.
    pub limit: Option<Nanos>,
    /// The number of program runs; overrides the machine file.
    pub repeat: Option<u32>,
    /// The seed of the simulated bus.
    pub seed: u64,
    pub faults: Option<FaultScript>,
    /// The file to which every frame is recorded.
    pub record: Option<PathBuf>,
    /// The size limit of a recording. The newest frames are kept, see [`crate::link::capture`].
    pub record_limit: Option<u64>,
    /// The recording that answers instead of a bus.
    pub replay: Option<PathBuf>,
    /// Enables the axes and runs the program. Otherwise the bus stays in Op without drive power.
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

/// The result of a run. A summary exists once the cycle has run.
#[derive(Debug)]
pub struct Outcome {
    pub summary: Option<Summary>,
    pub result: Result<(), Error>,
    /// The statistics behind the summary.
    pub stats: Option<Box<Stats>>,
    /// The fault report of a bus failure, or of a group that stopped and was not reset.
    pub fault_report: Option<Box<FaultReport>>,
}

impl From<Error> for Outcome {
    fn from(error: Error) -> Self {
        Self {
            summary: None,
            result: Err(error),
            stats: None,
            fault_report: None,
        }
    }
}

/// What takes part in a run besides the machine file.
#[derive(Debug, Default)]
pub struct Attachments {
    /// User code in the cycle. Without an operator it replaces the program of the file.
    pub controller: Option<Box<dyn Controller>>,
    /// The operator replaces the program of the file, and may start it.
    pub operator: Option<Box<dyn Operator>>,
    /// The writer of every cycle's values.
    pub samples: Option<SampleWriter>,
    /// The link in place of the file's `nic`.
    pub link: Option<Box<dyn Link>>,
    /// Pauses the program and steps it.
    pub control: Arc<ProgramControl>,
    /// The interface at the virtual switch in place of the file's `tap`.
    pub ethernet: Option<Box<dyn EthernetInterface>>,
    /// The set-points of the axes for other machines, and those of other machines.
    pub setpoints: SetpointCells,
}

/// Runs a machine until its program, its time limit, `stop` ([`stop_on_signals`]) or an error ends
/// the run. Blocks, and reports progress to the observer. If the observer panics, the machine stops
/// before the panic resumes.
pub fn run(
    machine: Machine,
    options: Options,
    stop: Arc<CancelToken>,
    observer: &mut dyn Observer,
) -> Outcome {
    run_attached(machine, options, stop, observer, Attachments::default())
}

/// Like [`run`], on the given link instead of the file's `nic`.
pub fn run_on(
    link: Box<dyn Link>,
    machine: Machine,
    options: Options,
    stop: Arc<CancelToken>,
    observer: &mut dyn Observer,
) -> Outcome {
    let attachments = Attachments {
        link: Some(link),
        ..Attachments::default()
    };
    run_attached(machine, options, stop, observer, attachments)
}

/// Like [`run`], with the given controller instead of the file's program. All axes are enabled,
/// then the controller moves them. The run ends when it calls
/// [`crate::rt::controller::CycleContext::finish`] or anything else ends the run.
pub fn run_with(
    machine: Machine,
    options: Options,
    stop: Arc<CancelToken>,
    observer: &mut dyn Observer,
    controller: Box<dyn Controller>,
) -> Outcome {
    let attachments = Attachments {
        controller: Some(controller),
        ..Attachments::default()
    };
    run_attached(machine, options, stop, observer, attachments)
}

/// Like [`run`], with an operator instead of the file's program. Axes are enabled and moved on
/// request until the operator leaves or anything else ends the run.
/// [`operator::for_manual_mode`] lists what differs from the machine file.
pub fn run_with_operator(
    machine: Machine,
    options: Options,
    stop: Arc<CancelToken>,
    observer: &mut dyn Observer,
    operator: Box<dyn Operator>,
) -> Outcome {
    let attachments = Attachments {
        operator: Some(operator),
        ..Attachments::default()
    };
    run_attached(machine, options, stop, observer, attachments)
}

/// Like [`run`], with attachments. With an operator, the changes of [`run_with_operator`] apply.
pub fn run_attached(
    mut machine: Machine,
    mut options: Options,
    stop: Arc<CancelToken>,
    observer: &mut dyn Observer,
    attachments: Attachments,
) -> Outcome {
    if attachments.operator.is_some() {
        machine = operator::for_manual_mode(machine);
        options.enable = true;
    }
    report_panics_briefly();
    let (progress, reported) = channel();
    let stopped = Arc::clone(&stop);
    let owner = thread::Builder::new()
        .name(RT_THREAD.to_owned())
        .stack_size(STACK)
        .spawn(move || {
            run_on_link_thread(&Arc::new(machine), &options, stop, progress, attachments)
        });
    let owner = match owner {
        Ok(owner) => owner,
        Err(error) => return Error::from(Cause::Thread(error.to_string())).into(),
    };
    rights::drop_capabilities_after_start();
    let observed = catch_unwind(AssertUnwindSafe(|| {
        for progress in reported {
            observer.progress(&progress);
        }
    }));
    // A panic of the observer may end the process, so the axes stop first.
    if observed.is_err() {
        stopped.cancel();
    }
    let outcome = owner
        .join()
        .unwrap_or_else(|panic| Error::from(Cause::Panicked(panic_text(&*panic))).into());
    observed.map_or_else(|panic| resume_unwind(panic), |()| outcome)
}

/// Prints a panic of the real-time thread as one line without a backtrace. Symbol lookup takes
/// longer than the drives' watchdogs.
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

/// Binds the mailbox gateway before the first frame. `None` without the key, and in virtual time.
fn bind_gateway(
    machine: &Machine,
    options: &Options,
    progress: &Sender<Progress>,
) -> Result<Option<BoundGateway>, Error> {
    let Some(setup) = machine.mailbox_gateway else {
        return Ok(None);
    };
    if options.clock == Clock::Virtual {
        let text = "virtual time has no mailbox gateway: clients wait in real time";
        let _ = progress.send(Progress::Warning(text.to_owned()));
        return Ok(None);
    }
    let bound = BoundGateway::bind(setup).map_err(|error| Cause::MailboxGateway {
        address: setup.bind,
        why: error.to_string(),
    })?;
    Ok(Some(bound))
}

/// Opens the TAP interface before the first frame. `None` without the key, and in virtual time.
fn open_tap(
    machine: &Machine,
    options: &Options,
    progress: &Sender<Progress>,
) -> Result<Option<Box<dyn EthernetInterface>>, Error> {
    let Some(setup) = &machine.tap else {
        return Ok(None);
    };
    if options.clock == Clock::Virtual {
        let text = "virtual time has no TAP interface: programs of this computer wait in real time";
        let _ = progress.send(Progress::Warning(text.to_owned()));
        return Ok(None);
    }
    let tap = TapInterface::open(&setup.name, setup.address);
    let tap = tap.map_err(|TapError { step, source }| Cause::Tap {
        name: setup.name.clone(),
        step,
        source,
    })?;
    let _ = progress.send(Progress::Tap(setup.clone()));
    Ok(Some(Box::new(tap)))
}

fn serve_gateway(bound: BoundGateway, supervisor: &mut Supervisor) -> Result<GatewayThread, Error> {
    let failed = |error: std::io::Error| Error::from(Cause::Thread(error.to_string()));
    let (address, write) = (bound.address().map_err(failed)?, bound.write());
    let served = bound.serve(
        &supervisor.machine,
        &supervisor.bus,
        supervisor.mailboxes.clone(),
    );
    let (thread, publisher) = served.map_err(failed)?;
    supervisor.mailbox_gateway = Some(publisher);
    let progress = &supervisor.progress;
    let _ = progress.send(Progress::MailboxGateway { address, write });
    Ok(thread)
}

fn run_on_link_thread(
    machine: &Arc<Machine>,
    options: &Options,
    stop: Arc<CancelToken>,
    progress: Sender<Progress>,
    mut attachments: Attachments,
) -> Outcome {
    options.clock.enter();
    let reported = progress.clone();
    let gateway = match bind_gateway(machine, options, &progress) {
        Ok(gateway) => gateway,
        Err(error) => return error.into(),
    };
    match open_tap(machine, options, &progress) {
        Ok(None) => {}
        Ok(tap) => attachments.ethernet = attachments.ethernet.or(tap),
        Err(error) => return error.into(),
    }
    let mut seen = BringUpEvidence::default();
    let link = attachments.link.take();
    let job = RunBuilder {
        machine,
        options,
        stop,
        progress,
        attachments,
    };
    let prepared = match link {
        Some(link) => job.prepare_with(link, &mut seen),
        None => job.prepare_with_evidence(&mut seen),
    };
    let Prepared {
        parts,
        mut supervisor,
    } = match prepared {
        Ok(prepared) => prepared,
        Err(error) => {
            return Outcome {
                fault_report: fault_evidence::of_bring_up(machine, options, &error, seen),
                ..error.into()
            };
        }
    };
    // Dropped at the end of the run: its port is free for the next one.
    let _gateway = match gateway.map(|bound| serve_gateway(bound, &mut supervisor)) {
        Some(Err(error)) => return error.into(),
        Some(Ok(thread)) => Some(thread),
        None => None,
    };
    let wire = supervisor.wire;
    let places = fault_evidence::places(&supervisor.bus);
    let log = supervisor.log.clone();
    let device_log = supervisor.device_log.clone();
    let ethernet = supervisor.ethernet.network.clone();
    let machine = &Arc::clone(&supervisor.machine);
    let CycleRun {
        remains,
        result: (mut ended, result),
        used,
    } = match options.clock {
        Clock::Virtual => cycle_thread::in_virtual_time(parts, supervisor),
        Clock::Real => match cycle_thread::in_real_time(parts, supervisor, &machine.bus, &reported)
        {
            Ok(done) => done,
            Err(error) => return error.into(),
        },
    };
    let EngineReport {
        mut link,
        mut port,
        axes,
        gateways,
        stats,
        spin_ns,
        diagnoses,
        windows,
        started,
        history,
        stops,
    } = remains;
    let result = result.map_err(|error| prefer_replay_end(error, link.as_ref(), "the run does"));
    if result.is_err() {
        broadcast_init(options.clock, wire.main_device(), link.as_mut(), &mut port);
    }
    let seen = link.stats();
    for remark in link.notices() {
        let _ = reported.send(Progress::Warning(remark));
    }
    let (record, result) = match link.finish() {
        Ok(record) => (record, result),
        Err(error) => (
            None,
            result.and(Err(Cause::Record(error.to_string()).into())),
        ),
    };
    let thread = used.map(|(used, wall_ns)| ThreadSummary::new(used, wall_ns, spin_ns, &stats));
    let mut events = events::lines(&stats.journal, started, machine);
    device_log.add_to(&mut events, started, machine.bus.cycle_ns);
    let (unreleased, then) = ended.left.take().unzip();
    let failed = result.as_ref().err().or(unreleased.as_deref());
    let witnessed = ended.witnessed.take().or(then).unwrap_or_default();
    let fault_report = failed.and_then(|error| {
        let left = RunEvidence {
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
        fault_evidence::of_run(machine, options, error, left)
    });
    let aside = SummaryInputs {
        program_runs: ended.runs,
        interrupted: ended.interrupted,
        captures: ended.captures,
        group_stops: ended.group_stops,
        link: seen,
        thread,
        record,
        errors: summary::device_errors(machine, &diagnoses),
        gateways: summary::gateways(machine, &gateways),
        ethernet: ethernet.counters(),
        events,
        emergencies: log.lines(started),
        started,
        stops,
    };
    let summary = Summary::new(machine, options.clock, &axes, &stats, aside);
    Outcome {
        summary: Some(summary),
        result,
        stats: Some(Box::new(stats)),
        fault_report,
    }
}
