//! `ecaxis jog`: a machine in somebody's hands.
//!
//! | file | |
//! |---|---|
//! | here | arguments, the run, and what stands between terminal and machine |
//! | `terminal` | the terminal: taken, read, drawn on, given back |
//! | `keys` | bytes → keys |
//! | `ui` | keys → requests |
//! | `panel`, `draw` | the machine → rows |
//! | `lines` | the same without a terminal: commands as lines |
//!
//! The terminal has a thread of its own, the machine is asked beside the cycle, and what goes to and fro never waits: a
//! terminal that hangs cannot hold the machine up, and is missed after half a second.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use ecaxis::clock::{Clock, Nanos};
use ecaxis::config::{Machine, Nic};
use ecaxis::session::{self, Observer, Options, Outcome, Progress, RunError};
use ecaxis::supervise::manual::{LET_GO, Operator, Presence, Request, Turn, View};

use super::{Failure, hints, record, report, result, run, signals, style};
use draw::Picture;
use keys::Keys;
use panel::{Messages, Panel};
use terminal::Terminal;
use ui::{Ask, Ui};

mod draw;
mod keys;
mod lines;
mod panel;
pub(super) mod terminal;
mod ui;

/// Nothing heard of the terminal for so long: nobody is there.
const AWAY: Nanos = 500_000_000;
/// What has waited for longer, while devices were asked or this computer stalled, is no longer what somebody wants, unless it
/// stops something.
const TOO_OLD: Duration = Duration::from_nanos(LET_GO);
/// How often what is shown is looked at anew.
const SHOWN: Nanos = 50_000_000;
/// How long a key is waited for, milliseconds; also what may lie between the bytes of one.
const WAIT: u32 = 40;

const EXAMPLES: &str = "\
Examples:
  ecaxis jog m.toml --sim          try it on the simulated bus
  ecaxis jog m.toml                on the file's interface: THE MACHINE MOVES
  ecaxis jog m.toml --lines        commands as lines on standard input;
                                   `help` lists them
  ecaxis jog m.toml --lines < script.txt

An axis jogs only while the key is held down: a key that has not come again for
0.3 s lets the axis brake, as does a terminal that hangs, closes or loses the
focus. No motion is faster than a quarter of the velocity limit. This is not a
safety function: emergency stop belongs into hardware of its own.";

/// Enable, jog, move and home axes by hand, in a terminal
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Machine file; its program is not run
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Use this network interface instead of the file's
    #[arg(long, value_name = "IF", conflicts_with = "sim")]
    nic: Option<String>,
    /// Use the simulated bus instead of the file's interface
    #[arg(long)]
    sim: bool,
    /// Take commands as lines from standard input
    #[arg(long)]
    lines: bool,
    /// With --lines: in virtual time, which stands still until the next line is there (simulated bus only)
    #[arg(long = "virtual", requires = "lines")]
    virtual_time: bool,
    /// With --lines: answer in JSON, an object a line
    #[arg(long, requires = "lines")]
    json: bool,
    /// Fault script for the simulated bus
    #[arg(long, value_name = "FILE")]
    faults: Option<PathBuf>,
    /// Keep every frame in this pcapng file
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let machine = run::load(&args.file, args.nic.as_deref(), args.sim)
        .map_err(|e| hints::config(&args.file, &e))?;
    if !machine.devices.iter().any(|device| device.axis.is_some()) {
        let message = format!("{} has no axis", args.file.display());
        return Err(Failure::new(hints::WRONG, message).hint("add a [device.axis]"));
    }
    let options = options(args, &machine)?;
    let nic = machine.bus.nic.clone();
    let stop = Arc::new(AtomicBool::new(false));
    if args.lines {
        signals::stop_on_interrupt(&stop);
        return lines::run(machine, options, stop, args.json);
    }
    let terminal = Terminal::take().map_err(no_terminal)?;
    signals::stop_quietly(&stop);
    let shared = Arc::new(Shared::default());
    let Outcome {
        summary,
        result: ended,
        ..
    } = on(terminal, machine, options, &stop, args, &shared);
    let left = shared.left.load(Ordering::Relaxed);
    let text = summary.as_ref().map(report::summary).unwrap_or_default();
    let written = result(&text);
    match ended {
        // Whoever leaves with a key has not been interrupted; a terminal that closes interrupts.
        Ok(()) | Err(RunError::Interrupted) if left => written,
        Ok(()) => Err(Failure::interrupted()),
        Err(error) => Err(hints::run(&error, &nic)),
    }
}

fn no_terminal(error: terminal::NoTerminal) -> Failure {
    Failure::new(hints::WRONG, error.to_string())
        .hint("`--lines` takes commands from standard input, without a terminal")
}

fn options(args: &Args, machine: &Machine) -> Result<Options, Failure> {
    let needs_sim = [
        (args.virtual_time, "--virtual"),
        (args.faults.is_some(), "--faults"),
    ];
    if let Nic::Interface(nic) = &machine.bus.nic
        && let Some((_, option)) = needs_sim.iter().find(|(given, _)| *given)
    {
        let message = format!("{option} needs the simulated bus, the machine is on `{nic}`");
        return Err(Failure::new(hints::WRONG, message).hint("add --sim"));
    }
    let script = args.faults.as_deref();
    let faults = script.map(|path| run::faults(path, machine)).transpose()?;
    if let Some(path) = &args.record {
        record::check(path, machine, script)?;
    }
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

/// Runs the machine with the terminal beside it.
fn on(
    terminal: Terminal,
    machine: Machine,
    options: Options,
    stop: &Arc<AtomicBool>,
    args: &Args,
    shared: &Arc<Shared>,
) -> Outcome {
    let bus = match &machine.bus.nic {
        Nic::Sim => "the simulated bus".to_owned(),
        Nic::Interface(nic) => nic.clone(),
    };
    let title = format!("jog  {}  {bus}", args.file.display());
    let (asks, asked) = channel();
    let hands = Hands {
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
        let seat = Seat {
            terminal,
            asks,
            shared,
            stop,
            title: &title,
        };
        let seat = thread::Builder::new()
            .name("terminal".to_owned())
            .spawn_scoped(scope, move || seat.serve());
        if let Err(error) = seat {
            return RunError::Thread(error.to_string()).into();
        }
        let outcome = session::run_by_hand(
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

/// What both ends see.
#[derive(Debug, Default)]
struct Shared {
    seen: Mutex<Seen>,
    over: AtomicBool,
    /// The user has left with a key.
    left: AtomicBool,
}

#[derive(Debug, Clone, Default)]
struct Seen {
    panel: Option<Panel>,
    messages: Messages,
}

impl Shared {
    /// What is in it is whole whoever panicked.
    fn seen(&self) -> MutexGuard<'_, Seen> {
        self.seen.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn tell(&self, text: impl Into<String>, bad: bool) {
        self.seen().messages.tell(text.into(), bad);
    }
}

/// The machine's end: asked beside the cycle.
#[derive(Debug)]
struct Hands {
    asked: Receiver<(Instant, Ask)>,
    shared: Arc<Shared>,
    /// When the terminal last gave a sign of life.
    heard: Option<Nanos>,
    shown: Option<Nanos>,
    began: Option<Nanos>,
    away: bool,
    gone: bool,
}

impl Hands {
    /// What has been asked for since the last turn, as far as it still counts.
    fn hear(&mut self, now: Nanos) -> Vec<Request> {
        let mut requests = Vec::new();
        let mut too_late = false;
        while !self.gone {
            let (age, ask) = match self.asked.try_recv() {
                Ok((at, ask)) => (at.elapsed(), ask),
                Err(TryRecvError::Empty) => break,
                Err(TryRecvError::Disconnected) => (Duration::ZERO, Ask::Leave),
            };
            match ask {
                Ask::Alive => {
                    let age = u64::try_from(age.as_nanos()).unwrap_or(u64::MAX);
                    let at = now.saturating_sub(age);
                    self.heard = Some(self.heard.map_or(at, |heard| heard.max(at)));
                }
                Ask::For(request) if age < TOO_OLD || request.stops() => requests.push(request),
                Ask::For(_) => too_late = true,
                Ask::Leave => self.gone = true,
            }
        }
        if too_late {
            self.shared
                .tell("too late, not done: keys from before", true);
        }
        let away = now.saturating_sub(*self.heard.get_or_insert(now)) > AWAY;
        if away && !self.away {
            self.shared.tell("the terminal hangs: axes brake", true);
        }
        self.away = away;
        requests
    }
}

impl Operator for Hands {
    fn turn(&mut self, view: &View<'_>) -> Turn {
        let now = view.now;
        let requests = self.hear(now);
        for news in view.news {
            let text = format!("{}: {news}", view.name(news.axis()));
            self.shared.tell(text, news.bad());
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
        Turn { presence, requests }
    }
}

/// Progress as messages.
struct Listener {
    shared: Arc<Shared>,
    nic: Nic,
}

impl Observer for Listener {
    fn progress(&mut self, progress: &Progress) {
        let (text, bad) = match progress {
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
                let hint = hints::run(cause, &self.nic).hints.into_iter().next();
                let group = format!("the group `{group}` stops: {cause}");
                self.shared.tell(group, true);
                (hint.unwrap_or_else(|| "r resets it".to_owned()), false)
            }
            Progress::GroupReleased { group } => {
                let text = format!("the group `{group}` has been reset: e enables");
                (text, false)
            }
            _ => return,
        };
        self.shared.tell(text, bad);
    }
}

/// The terminal's end.
struct Seat<'s> {
    terminal: Terminal,
    asks: Sender<(Instant, Ask)>,
    shared: &'s Shared,
    stop: &'s AtomicBool,
    title: &'s str,
}

impl Seat<'_> {
    /// Until the run is over, or the terminal is gone.
    fn serve(mut self) {
        let began = Instant::now();
        let (mut keys, mut ui) = (Keys::default(), Ui::default());
        let colours = style::on_stdout();
        while !self.shared.over.load(Ordering::Relaxed) {
            // A panic elsewhere has given it back.
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
            self.send(Ask::Alive);
            for key in typed {
                for ask in ui.key(key, now, panel.as_ref()) {
                    self.ask(ask, panel.is_some());
                }
            }
            let picture = Picture {
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
        // Whoever listens takes the silence for leaving; nobody listens before the bus is up.
        if !self.shared.over.load(Ordering::Relaxed) && self.shared.seen().panel.is_none() {
            self.stop.store(true, Ordering::Relaxed);
        }
    }

    fn ask(&self, ask: Ask, attended: bool) {
        if ask == Ask::Leave {
            self.shared.left.store(true, Ordering::Relaxed);
            if !attended {
                self.stop.store(true, Ordering::Relaxed);
            }
        }
        self.send(ask);
    }

    fn send(&self, ask: Ask) {
        let _ = self.asks.send((Instant::now(), ask));
    }
}

#[cfg(test)]
#[path = "hands_tests.rs"]
mod tests;
