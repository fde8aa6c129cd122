//! `ecaxis jog`: manual operation of the axes.
//!
//! | file | |
//! |---|---|
//! | `mod` | arguments, the run, and the channel between terminal and machine |
//! | `terminal` | the terminal: set-up, input, output, restoring |
//! | `keys` | bytes → keys |
//! | `ui` | keys → requests |
//! | `panel`, `draw` | the machine → rows |
//! | `lines` | operation without a terminal: commands as lines |
//!
//! The terminal has its own thread; the machine polls requests outside the cycle. Neither side
//! waits for the other: a terminal that hangs cannot block the machine, and the axes stop after 0.5
//! s without it.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use ecaxis_master::bringup::Step;
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::{Clock, Nanos};
use ecaxis_master::config::{Machine, Nic};
use ecaxis_master::post_mortem::FaultReport;
use ecaxis_master::session::{self, Cause, Error, Observer, Options, Outcome, Progress};
use ecaxis_master::supervise::operator::{
    HOLD_TO_RUN_TIMEOUT, Operator, OperatorInput, Presence, Request, RequestEvent, View,
};
use ecaxis_master::sys::rights::drop_capabilities;

use crate::access::{rights, signals};
use crate::args::LogArgs;
use crate::args::bus::BusArgs;
use crate::args::files::{Inputs, check_output};
use crate::args::report::ReportArgs;
use crate::hints;
use crate::hints::Failure;
use crate::render::fault_report::{self, ReportDestination};
use crate::render::note;
use crate::render::print;
use crate::render::progress::{device_appeared, device_returned};
use crate::render::report;
use crate::render::style;
use draw::Screen;
use keys::Keys;
use panel::{Messages, Panel};
use terminal::Terminal;
use ui::{Ui, UiAction};

mod draw;
mod keys;
mod lines;
mod panel;
mod terminal;
mod ui;

/// The maximum silence of the terminal in ns; then the operator counts as absent.
const AWAY: Nanos = 500_000_000;
/// The maximum age of a request. Older ones, from a stall of a device or of the computer, are
/// dropped unless they stop something.
const TOO_OLD: Duration = Duration::from_nanos(HOLD_TO_RUN_TIMEOUT);
/// The refresh period of the display in ns.
const SHOWN: Nanos = 50_000_000;
/// The time to wait for a key in ms; also the maximum gap between the bytes of one key.
const WAIT: u32 = 40;

const EXAMPLES: &str = "\
Examples:
  ecaxis jog m.toml --sim          try it on the simulated bus
  ecaxis jog m.toml                on the file's interface: THE MACHINE MOVES
  ecaxis jog m.toml --lines        commands as lines on standard input;
                                   `help` lists them
  ecaxis jog m.toml --lines < script.txt

An axis jogs only while the key is held down: a key that does not repeat for
0.3 s stops the axis, as does a terminal that hangs, closes or loses the
focus. No motion is faster than a quarter of the velocity limit. This is not a
safety function: implement emergency stop in dedicated safety hardware.";

/// Enable, jog, move and home axes by hand in a terminal
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Machine file; its program does not run
    #[arg(value_name = "FILE")]
    file: PathBuf,
    #[command(flatten)]
    bus: BusArgs,
    /// Read commands as lines from standard input
    #[arg(long)]
    lines: bool,
    /// With --lines: use virtual time, which stands still until the next line arrives (simulated
    /// bus only)
    #[arg(long = "virtual", requires = "lines")]
    virtual_time: bool,
    /// With --lines: answer in JSON, one object per line
    #[arg(long, requires = "lines")]
    json: bool,
    /// Record all frames to this pcapng file
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    #[command(flatten)]
    report: ReportArgs,
    /// Overwrite existing output files
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    pub log: LogArgs,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let loaded = args.bus.load(&args.file);
    let machine = loaded.map_err(|e| hints::config(&args.file, &e))?;
    if machine.axes.is_empty() {
        let message = format!("{} has no axis", args.file.display());
        return Err(Failure::new(hints::WRONG, message).hint("add a [device.axis]"));
    }
    let options = options(args, &machine)?;
    let needed = rights::of_machine(&machine);
    let outputs = args.report.files(&machine.bus.nic);
    rights::limit(&rights::with_outputs(
        needed,
        args.record.iter().chain(&outputs),
    ))?;
    let nic = machine.bus.nic.clone();
    let stop = Arc::<CancelToken>::default();
    if args.lines {
        signals::stop_on_interrupt(&stop);
        let destination = args.report.destination(&nic);
        return lines::run(machine, options, stop, args.json, destination);
    }
    let terminal = Terminal::take().map_err(no_terminal)?;
    signals::stop_quietly(&stop, terminal::restore);
    let shared = Arc::new(Shared::default());
    let Outcome {
        summary,
        result: ended,
        fault_report,
        ..
    } = on(terminal, machine, options, &stop, args, &shared);
    let left = shared.left.load(Ordering::Relaxed);
    let document = summary.as_ref().map(report::summary).unwrap_or_default();
    let written = print(&document);
    let ended = match ended {
        Err(error) if left && error.is_interruption() => Ok(()),
        ended => ended,
    };
    report_end(
        ended,
        fault_report.as_deref(),
        args.report.destination(&nic),
        &nic,
    )?;
    // Leaving with a key is not an interruption; closing the terminal is.
    match left {
        true => written,
        false => Err(Failure::interrupted()),
    }
}

/// Prints and keeps the fault report, also of a group that stopped while the others went on.
fn report_end(
    ended: Result<(), Error>,
    fault_report: Option<&FaultReport>,
    destination: ReportDestination,
    nic: &Nic,
) -> Result<(), Failure> {
    let mut failure = ended.err().map(|error| hints::failure(&error, nic));
    if let Some(report) = fault_report {
        let mut advice = Vec::new();
        let advice = failure
            .as_mut()
            .map_or(&mut advice, |failure| &mut failure.hints);
        let kept = fault_report::print(report, advice, &destination, true);
        match (&mut failure, kept) {
            (Some(failure), kept) => failure.after = kept,
            (None, Some(kept)) => note(&kept),
            (None, None) => {}
        }
    }
    failure.map_or(Ok(()), Err)
}

fn no_terminal(error: terminal::NoTerminal) -> Failure {
    Failure::new(hints::WRONG, error.to_string())
        .hint("`--lines` takes commands from standard input, without a terminal")
}

fn options(args: &Args, machine: &Machine) -> Result<Options, Failure> {
    let needs_sim = [(args.virtual_time, "--virtual")];
    let faults = args.bus.script(machine, &needs_sim)?;
    let inputs = Inputs::from_machine(machine).with("the fault script", &args.bus.faults);
    if let Some(path) = &args.record {
        check_output("--record", path, args.force, &inputs)?;
    }
    args.report.check(args.force, &inputs)?;
    let defaults = Options::default();
    Ok(Options {
        clock: if args.virtual_time {
            Clock::Virtual
        } else {
            Clock::Real
        },
        seed: faults
            .as_ref()
            .and_then(|f| f.seed)
            .unwrap_or(defaults.seed),
        faults,
        record: args.record.clone(),
        ..defaults
    })
}

/// Runs the machine and, on another thread, the terminal.
fn on(
    terminal: Terminal,
    machine: Machine,
    options: Options,
    stop: &Arc<CancelToken>,
    args: &Args,
    shared: &Arc<Shared>,
) -> Outcome {
    let bus = match &machine.bus.nic {
        Nic::Sim => "the simulated bus".to_owned(),
        Nic::Interface(nic) => nic.clone(),
    };
    let title = format!("jog  {}  {bus}", args.file.display());
    let (asks, asked) = channel();
    let hands = MachineSide {
        asked,
        shared: Arc::clone(shared),
        heard: None,
        shown: None,
        began: None,
        away: false,
        gone: false,
    };
    let mut listener = Listener {
        shared: Arc::clone(shared),
        nic: machine.bus.nic.clone(),
    };
    thread::scope(|scope| {
        let terminal = TerminalSide {
            terminal,
            asks,
            shared,
            stop,
            title: &title,
        };
        let terminal = thread::Builder::new()
            .name("terminal".to_owned())
            .spawn_scoped(scope, move || {
                drop_capabilities();
                terminal.serve();
            });
        if let Err(error) = terminal {
            return Error::from(Cause::Thread(error.to_string())).into();
        }
        let outcome = session::run_with_operator(
            machine,
            options,
            Arc::clone(stop),
            &mut listener,
            Box::new(hands),
        );
        shared.over.store(true, Ordering::Relaxed);
        outcome
    })
}

/// State shared by both sides.
#[derive(Debug, Default)]
struct Shared {
    seen: Mutex<Seen>,
    over: AtomicBool,
    /// True after the user has left with a key.
    left: AtomicBool,
}

#[derive(Debug, Clone, Default)]
struct Seen {
    panel: Option<Panel>,
    messages: Messages,
}

impl Shared {
    /// Locks the state. It is consistent even after a panic of the other side.
    fn seen(&self) -> MutexGuard<'_, Seen> {
        self.seen.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn show(&self, text: impl Into<String>, bad: bool) {
        self.seen().messages.show(text.into(), bad);
    }
}

/// The machine's side, polled outside the cycle.
#[derive(Debug)]
struct MachineSide {
    asked: Receiver<(Instant, UiAction)>,
    shared: Arc<Shared>,
    /// The time of the last sign of life of the terminal.
    heard: Option<Nanos>,
    shown: Option<Nanos>,
    began: Option<Nanos>,
    away: bool,
    gone: bool,
}

impl MachineSide {
    /// Returns the requests since the last poll that are still valid.
    fn hear(&mut self, now: Nanos) -> Vec<Request> {
        let mut requests = Vec::new();
        let mut too_late = false;
        while !self.gone {
            let (age, ask) = match self.asked.try_recv() {
                Ok((at, ask)) => (at.elapsed(), ask),
                Err(TryRecvError::Empty) => break,
                Err(TryRecvError::Disconnected) => (Duration::ZERO, UiAction::Leave),
            };
            match ask {
                UiAction::Alive => {
                    let age = u64::try_from(age.as_nanos()).unwrap_or(u64::MAX);
                    let at = now.saturating_sub(age);
                    self.heard = Some(self.heard.map_or(at, |heard| heard.max(at)));
                }
                UiAction::For(request) if age < TOO_OLD || request.stops() => {
                    requests.push(request)
                }
                UiAction::For(_) => too_late = true,
                UiAction::Leave => self.gone = true,
            }
        }
        if too_late {
            self.shared
                .show("too late, not done: keys from before", true);
        }
        let away = now.saturating_sub(*self.heard.get_or_insert(now)) > AWAY;
        if away && !self.away {
            self.shared.show("the terminal hangs: axes brake", true);
        }
        self.away = away;
        requests
    }
}

impl Operator for MachineSide {
    fn turn(&mut self, view: &View<'_>) -> OperatorInput {
        let now = view.now;
        let requests = self.hear(now);
        let replaced = |event: &&RequestEvent| matches!(event, RequestEvent::Replaced { .. });
        for news in view.news.iter().filter(|event| !replaced(event)) {
            let text = format!("{}: {news}", view.name(news.axis().unwrap_or_default()));
            self.shared.show(text, news.is_failure());
        }
        let shown = self
            .shown
            .is_none_or(|last| now.saturating_sub(last) >= SHOWN);
        if shown || self.gone {
            self.shown = Some(now);
            let began = *self.began.get_or_insert(now);
            let panel = Panel::new(view, began);
            self.shared.seen().panel = Some(panel);
        }
        let presence = match (self.gone, self.away) {
            (true, _) => Presence::Gone,
            (_, true) => Presence::Away,
            _ => Presence::Here,
        };
        OperatorInput { presence, requests }
    }
}

/// Shows progress as messages.
struct Listener {
    shared: Arc<Shared>,
    nic: Nic,
}

impl Observer for Listener {
    fn progress(&mut self, progress: &Progress) {
        let (text, bad) = match progress {
            // One message per device is enough.
            Progress::Step(Step::StartUp { done, of, .. }) if done < of => return,
            Progress::Step(step) => (step.to_string(), false),
            Progress::PhaseLocked => ("frames leave in phase with SYNC0".to_owned(), false),
            Progress::Stopping => {
                let text = "stopping: axes to rest, power off, bus to Init";
                (text.to_owned(), false)
            }
            Progress::Warning(text) => (text.clone(), true),
            Progress::Denied(denied) => (denied.to_string(), true),
            Progress::Overload(overload) => (overload.to_string(), true),
            Progress::Concern(concern) => (concern.to_string(), true),
            Progress::GroupStopped { group, cause } => {
                let hint = hints::failure(cause, &self.nic).hints.into_iter().next();
                let group = format!("the group `{group}` stops: {cause}");
                self.shared.show(group, true);
                (hint.unwrap_or_else(|| "r resets it".to_owned()), false)
            }
            Progress::DeviceReturned {
                device,
                after_ns,
                home,
                first: false,
                has_axes,
                ..
            } => (device_returned(device, *after_ns, *home, *has_axes), false),
            Progress::Ring { text, broken } => (text.clone(), *broken),
            Progress::DeviceReturned {
                device, has_axes, ..
            } => (device_appeared(device, *has_axes), false),
            Progress::UnknownDevice(device) => (device.to_string(), true),
            Progress::GroupReleased { group } => {
                let text = format!("the group `{group}` has been reset: e enables");
                (text, false)
            }
            _ => return,
        };
        self.shared.show(text, bad);
    }
}

/// The terminal's side.
struct TerminalSide<'s> {
    terminal: Terminal,
    asks: Sender<(Instant, UiAction)>,
    shared: &'s Shared,
    stop: &'s CancelToken,
    title: &'s str,
}

impl TerminalSide<'_> {
    /// Runs until the run is over or the terminal is gone.
    fn serve(mut self) {
        let began = Instant::now();
        let (mut keys, mut ui) = (Keys::default(), Ui::default());
        let colours = style::on_stdout();
        while !self.shared.over.load(Ordering::Relaxed) {
            // A panic elsewhere has restored the terminal.
            let Ok(bytes) = self.terminal.read(WAIT) else {
                break;
            };
            if !terminal::ours() {
                break;
            }
            let mut typed = keys.take(&bytes);
            if bytes.is_empty() {
                typed.extend(keys.flush());
            }
            let Seen { panel, messages } = self.shared.seen().clone();
            let now = u64::try_from(began.elapsed().as_millis()).unwrap_or(u64::MAX);
            self.send(UiAction::Alive);
            for key in typed {
                for ask in ui.key(key, now, panel.as_ref()) {
                    self.ask(ask, panel.is_some());
                }
            }
            let picture = Screen {
                title: self.title,
                panel: panel.as_ref(),
                messages: &messages,
                ui: &ui,
                now,
                size: self.terminal.size(),
                colours,
            };
            let rows = picture.rows();
            if self.terminal.show(rows).is_err() {
                break;
            }
        }
        // The machine detects a missing terminal itself, but only after the bus is up.
        if !self.shared.over.load(Ordering::Relaxed) && self.shared.seen().panel.is_none() {
            self.stop.cancel();
        }
    }

    fn ask(&self, ask: UiAction, attended: bool) {
        if ask == UiAction::Leave {
            self.shared.left.store(true, Ordering::Relaxed);
            if !attended {
                self.stop.cancel();
            }
        }
        self.send(ask);
    }

    fn send(&self, ask: UiAction) {
        let _ = self.asks.send((Instant::now(), ask));
    }
}

#[cfg(test)]
mod tests;
