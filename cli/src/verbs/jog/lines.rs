//! Commands as lines, for scripts and without a terminal.

use std::io::{self, BufRead, IsTerminal, Read, Write};
use std::sync::mpsc::{Receiver, RecvError, Sender, TryRecvError, channel, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;

use ecaxis_axis::Mode;
use ecaxis_ecat::index::AxisIndex;
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::{Clock, Nanos};
use ecaxis_master::config::{Machine, duration, nearest};
use ecaxis_master::session::{self, Observer, Options, Progress};
use ecaxis_master::supervise::operator::{
    MAX_MANUAL_SPEED, Operator, OperatorInput, Presence, Request, RequestEvent, View,
};
use ecaxis_master::sys::rights::drop_capabilities;
use serde_json::json;

use super::panel::{AxisPanel, Panel, number};
use crate::hints;
use crate::hints::Failure;
use crate::render::fault_report::ReportDestination;
use crate::render::progress::ProgressPrinter;
use crate::render::show_failure;

/// The number of lines read ahead; then the writer blocks.
const AHEAD: usize = 64;
/// The maximum length of a line in bytes.
const LONGEST: usize = 1_000;
const SPEED: f64 = 0.05;

const HELP: &str = "\
enable [AXIS…]            disable [AXIS…]         all axes where none is named
jog AXIS VELOCITY         for 0.3 s; again and again for longer
by AXIS DISTANCE          move AXIS POSITION
speed PERCENT             of moves, of the velocity limit: first 5, at most 25
home AXIS                 mode AXIS MODE          reset [AXIS…]
stop [AXIS…]              brake and hold
press INPUT               release INPUT           of the simulated bus
set INPUT = VALUE         an input of the simulated bus, such as io.Input 1
estop                     emergency stop: no motion and no power
status                    how the axes are
wait                      until everything asked for is done
wait DURATION             such as 500ms
quit                      or the end of the input: stop, disable, bus down";

const VERBS: [&str; 18] = [
    "enable", "disable", "reset", "stop", "estop", "home", "jog", "by", "move", "mode", "speed",
    "wait", "status", "help", "quit", "press", "release", "set",
];

/// A parsed line.
#[derive(Debug, Clone, PartialEq)]
enum Line {
    For(Vec<Request>),
    Speed(f64),
    Status,
    Help,
    /// `None`: until all requests are done.
    Wait(Option<Nanos>),
    Quit,
    Nothing,
}

pub(super) fn run(
    machine: Machine,
    options: Options,
    stop: Arc<CancelToken>,
    json: bool,
    destination: ReportDestination,
) -> Result<(), Failure> {
    let (lines, read) = sync_channel(AHEAD);
    let (say, said) = channel::<String>();
    // The thread ends with the process, because reading may block forever.
    thread::Builder::new()
        .name("lines".to_owned())
        .spawn(move || {
            drop_capabilities();
            let mut input = io::stdin().lock();
            while let Some(line) = next_line(&mut input) {
                if lines.send(line).is_err() {
                    return;
                }
            }
        })
        .map_err(|e| Failure::new(hints::FAILED, format!("starting a thread: {e}")))?;
    // A slow reader of stdout must not block the machine.
    let printer = thread::Builder::new()
        .name("answers".to_owned())
        .spawn(move || {
            drop_capabilities();
            let mut out = io::stdout().lock();
            for text in said {
                // A closed stdout does not stop the machine.
                let _ = writeln!(out, "{text}").and_then(|()| out.flush());
            }
        })
        .map_err(|e| Failure::new(hints::FAILED, format!("starting a thread: {e}")))?;
    let failure = Arc::default();
    let nic = machine.bus.nic.clone();
    let mut teller = QuietObserver(ProgressPrinter::new(options.clock, &machine.bus, true));
    let script = Script {
        lines: read,
        patient: options.clock == Clock::Virtual,
        answers: Answers { say, json },
        // A script must stop at the first error; an interactive user may go on.
        strict: !io::stdin().is_terminal(),
        failure: Arc::clone(&failure),
        speed: SPEED,
        waiting: None,
        began: None,
        read: 0,
    };
    let outcome = session::run_with_operator(machine, options, stop, &mut teller, Box::new(script));
    drop(teller);
    let _ = printer.join();
    let fault_report = outcome.fault_report.as_deref();
    super::report_end(outcome.result, fault_report, destination, &nic)?;
    let mut failure = failure.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(failure) = failure.take() {
        return Err(failure);
    }
    match outcome.summary {
        Some(summary) if summary.interrupted => Err(Failure::interrupted()),
        _ => Ok(()),
    }
}

/// Returns the next line, or `None` at the end of input. An overlong line is split, and no part is
/// accepted.
fn next_line(input: &mut impl BufRead) -> Option<String> {
    let mut bytes = Vec::new();
    let mut part = input.take(LONGEST as u64 + 2);
    match part.read_until(b'\n', &mut bytes) {
        Ok(1..) => Some(String::from_utf8_lossy(&bytes).into_owned()),
        Ok(0) | Err(_) => None,
    }
}

/// Progress of a run without the status lines, which the command `status` prints.
struct QuietObserver(ProgressPrinter);

impl Observer for QuietObserver {
    fn progress(&mut self, progress: &Progress) {
        if !matches!(progress, Progress::Status(_)) {
            self.0.progress(progress);
        }
    }
}

/// The printer of answers.
#[derive(Debug)]
struct Answers {
    say: Sender<String>,
    json: bool,
}

impl Answers {
    fn say(&self, text: &str) {
        let _ = self.say.send(text.to_owned());
    }

    fn news(&self, axis: &str, text: &str, bad: bool) {
        self.say(&if self.json {
            json!({ "axis": axis, "ok": !bad, "what": text }).to_string()
        } else {
            format!("{axis}: {text}")
        });
    }

    /// Prints the inputs that the program reads.
    fn inputs(&self, view: &View<'_>) {
        for (input, value) in view.machine.inputs.iter().zip(&view.snapshot.inputs) {
            self.say(&if self.json {
                json!({ "input": input.name, "value": value }).to_string()
            } else {
                format!("{} = {value}", input.name)
            });
        }
    }

    fn status(&self, panel: &Panel) {
        for axis in &panel.axes {
            let AxisPanel {
                name,
                unit,
                position,
                velocity,
                torque,
                torque_unit,
                ..
            } = axis;
            self.say(&if self.json {
                json!({
                    "axis": name, "state": axis.state.to_string(), "mode": axis.mode.to_string(),
                    "enabled": axis.enabled, "doing": axis.doing(), "unit": unit,
                    "position": position, "velocity": velocity, "target": axis.target,
                    "following_error": axis.following_error, "torque": torque,
                    "torque_unit": torque_unit.sign(), "homed": axis.homed,
                    "trouble": axis.trouble, "limits": axis.limits,
                })
                .to_string()
            } else {
                let [position, velocity, torque] = [position, velocity, torque].map(|x| number(*x));
                let trouble = axis.trouble.as_ref().map(|t| format!("; {t}"));
                format!(
                    "{name}: {}, {}, {position} {unit}, {velocity} {unit}/s, {torque} {torque_unit}, {}{}",
                    axis.state,
                    axis.mode,
                    axis.doing(),
                    trouble.unwrap_or_default(),
                )
            });
        }
    }
}

/// Executes lines one by one. A waiting line delays the following lines.
#[derive(Debug)]
struct Script {
    lines: Receiver<String>,
    /// True if time stands still until the next line arrives.
    patient: bool,
    answers: Answers,
    strict: bool,
    failure: Arc<Mutex<Option<Failure>>>,
    /// The fraction of the velocity limit.
    speed: f64,
    /// The time until which it waits; `Some(None)`: until all requests are done.
    waiting: Option<Option<Nanos>>,
    began: Option<Nanos>,
    /// The number of lines read.
    read: u64,
}

impl Script {
    /// Handles a failed line. Returns `true` if the run must end.
    fn fail(&self, code: u8, message: String) -> bool {
        let failure = Failure::new(code, message);
        if self.strict {
            let mut first = self.failure.lock().unwrap_or_else(PoisonError::into_inner);
            first.get_or_insert(failure);
        } else {
            show_failure(&failure);
        }
        self.strict
    }

    /// Returns the next line, `None` if it has not arrived, or an error at the end of input.
    fn next(&self) -> Option<Result<String, RecvError>> {
        if self.patient {
            return Some(self.lines.recv());
        }
        match self.lines.try_recv() {
            Ok(line) => Some(Ok(line)),
            Err(TryRecvError::Empty) => None,
            Err(TryRecvError::Disconnected) => Some(Err(RecvError)),
        }
    }
}

impl Operator for Script {
    fn turn(&mut self, view: &View<'_>) -> OperatorInput {
        let mut turn = OperatorInput::default();
        let gone = OperatorInput {
            presence: Presence::Gone,
            requests: Vec::new(),
        };
        let began = *self.began.get_or_insert(view.now);
        let replaced = |event: &&RequestEvent| matches!(event, RequestEvent::Replaced { .. });
        for news in view.news.iter().filter(|event| !replaced(event)) {
            let (axis, text) = match news {
                RequestEvent::Signal { result: Ok(()), .. } => continue,
                RequestEvent::Signal { .. } => ("signal", news.to_string()),
                _ => (view.name(news.axis().unwrap_or_default()), news.to_string()),
            };
            self.answers.news(axis, &text, news.is_failure());
            if news.is_failure() && self.fail(hints::FAILED, format!("{axis}: {text}")) {
                return gone;
            }
        }
        loop {
            let waits = match self.waiting {
                Some(None) => !view.idle(),
                Some(Some(until)) => view.now < until,
                None => false,
            };
            // Interactive input ends the wait.
            if waits && self.strict {
                return turn;
            }
            let line = match self.next() {
                None => return turn,
                Some(Err(RecvError)) => return gone,
                Some(Ok(line)) => line,
            };
            self.read = self.read.saturating_add(1);
            self.waiting = None;
            // The next line is checked after this one took effect.
            match parse(&line, view, self.speed) {
                Ok(Line::For(requests)) => {
                    turn.requests.extend(requests);
                    return turn;
                }
                Ok(Line::Speed(speed)) => self.speed = speed,
                Ok(Line::Status) => {
                    self.answers.status(&Panel::new(view, began));
                    self.answers.inputs(view);
                }
                Ok(Line::Help) => self.answers.say(HELP),
                Ok(Line::Wait(time)) => {
                    self.waiting = Some(time.map(|time| view.now.saturating_add(time)));
                    // Interactive input is not awaited in this cycle.
                    return turn;
                }
                Ok(Line::Quit) => return gone,
                Ok(Line::Nothing) => {}
                Err(why) => {
                    let number = self.read;
                    let message = format!("line {number}: `{}`: {why}", line.trim());
                    if self.fail(hints::WRONG, message) {
                        return gone;
                    }
                }
            }
        }
    }
}

fn parse(line: &str, view: &View<'_>, speed: f64) -> Result<Line, String> {
    if line.trim_end().len() > LONGEST {
        return Err("the line is too long".to_owned());
    }
    let line = line.split('#').next().unwrap_or_default();
    let words: Vec<&str> = line.split_whitespace().collect();
    let Some((&verb, rest)) = words.split_first() else {
        return Ok(Line::Nothing);
    };
    if let Some(input) = view.machine.parse_input_line(line) {
        return Ok(Line::For(vec![Request::SimInput(input?)]));
    }
    let axis = |name: &str| {
        let mut axes = view.machine.axes.indices();
        axes.find(|&axis| view.name(axis) == name).ok_or_else(|| {
            let all = view.machine.axes.indices().map(|axis| view.name(axis));
            match nearest(name, all.clone()) {
                Some(near) => format!("no axis is named `{name}`; did you mean `{near}`?"),
                None => format!(
                    "no axis is named `{name}`; there are {}",
                    all.collect::<Vec<_>>().join(", ")
                ),
            }
        })
    };
    // Without names, the command applies to all axes.
    let each = |request: fn(AxisIndex) -> Request| -> Result<Line, String> {
        let named: Result<Vec<AxisIndex>, String> = rest.iter().map(|name| axis(name)).collect();
        let mut axes = named?;
        if axes.is_empty() {
            axes = view.machine.axes.indices().collect();
        }
        Ok(Line::For(axes.into_iter().map(request).collect()))
    };
    let one = || match rest {
        [name] => axis(name),
        _ => Err(format!("`{verb}` takes the name of an axis")),
    };
    let with_number = || match rest {
        [name, value] => {
            let number = value.parse::<f64>().ok().filter(|n| n.is_finite());
            let number = number.ok_or_else(|| format!("`{value}` is not a number"))?;
            Ok((axis(name)?, number))
        }
        _ => Err(format!("`{verb}` takes the name of an axis and a number")),
    };
    let alone = |line: Line| {
        if rest.is_empty() {
            return Ok(line);
        }
        Err(format!("`{verb}` stands alone"))
    };
    match verb {
        "enable" => each(|axis| Request::Enable { axis }),
        "disable" => each(|axis| Request::Disable { axis }),
        "reset" => each(|axis| Request::Reset { axis }),
        "stop" if rest.is_empty() => Ok(Line::For(vec![Request::StopAll])),
        "stop" => each(|axis| Request::Stop { axis }),
        "estop" => alone(Line::For(vec![Request::EmergencyStop])),
        "home" => Ok(Line::For(vec![Request::Home { axis: one()? }])),
        "jog" => {
            let (axis, velocity) = with_number()?;
            Ok(Line::For(vec![Request::Jog { axis, velocity }]))
        }
        "by" => {
            let (axis, distance) = with_number()?;
            Ok(Line::For(vec![Request::MoveBy {
                axis,
                distance,
                speed,
            }]))
        }
        "move" => {
            let (axis, position) = with_number()?;
            Ok(Line::For(vec![Request::MoveTo {
                axis,
                position,
                speed,
            }]))
        }
        "mode" => match rest {
            [name, mode] => {
                let mode = mode_named(mode).ok_or_else(|| {
                    format!("`{mode}` is not a mode; use csp, csv, cst, pp or pv")
                })?;
                let axis = axis(name)?;
                Ok(Line::For(vec![Request::SetMode { axis, mode }]))
            }
            _ => Err("`mode` takes the name of an axis and a mode".to_owned()),
        },
        "press" | "release" | "set" => Err(format!("`{verb}` takes the name of an input")),
        "speed" => {
            let percent = match rest {
                [value] => value.trim_end_matches('%').parse::<f64>().ok(),
                _ => None,
            };
            let part = percent.map(|percent| percent / 100.0);
            let part = part.filter(|part| *part > 0.0 && *part <= MAX_MANUAL_SPEED);
            part.map(Line::Speed).ok_or_else(|| {
                let most = MAX_MANUAL_SPEED * 100.0;
                format!("`speed` takes percent of the velocity limit, above 0 and up to {most}")
            })
        }
        "wait" => match rest {
            [] => Ok(Line::Wait(None)),
            [time] => duration::parse(time)
                .map(|time| Line::Wait(Some(time)))
                .map_err(|e| e.to_string()),
            _ => Err("`wait` takes a duration, or nothing".to_owned()),
        },
        "status" => alone(Line::Status),
        "help" => alone(Line::Help),
        "quit" => alone(Line::Quit),
        _ => Err(match nearest(verb, VERBS) {
            Some(near) => format!("not understood; did you mean `{near}`?"),
            None => "not understood; `help` lists what is".to_owned(),
        }),
    }
}

fn mode_named(name: &str) -> Option<Mode> {
    [Mode::Csp, Mode::Csv, Mode::Cst, Mode::Pp, Mode::Pv]
        .into_iter()
        .find(|mode| mode.to_string().eq_ignore_ascii_case(name))
}
