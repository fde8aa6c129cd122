//! `[[step]]` as written: one verb each, with its parameters.

use std::ops::RangeInclusive;

use ecaxis_axis::Edge;
use toml::Spanned;
use toml::de::DeValue;

use super::super::fields::{Domain, Field, Key, Ns, Read, Table, TableKey, Value, Written, array};
use super::super::problem::{Problems, Span};

/// Axes with a parameter each.
pub(crate) type Named<T> = Vec<(Spanned<String>, Spanned<T>)>;

/// Axes by name; `None`: all.
pub(crate) type RawAxes = Option<Vec<Spanned<String>>>;

#[derive(Debug)]
pub(crate) struct RawStep {
    pub span: Span,
    pub action: RawAction,
    pub speed: Key<f64>,
    pub ramp: Key<f64>,
}

#[derive(Debug)]
pub(crate) enum RawAction {
    Enable(RawAxes),
    Disable(RawAxes),
    Reset(RawAxes),
    Stop(RawAxes),
    Home(RawAxes),
    Move {
        relative: bool,
        targets: Named<f64>,
        together: bool,
    },
    Probe(Spanned<String>, RawProbe),
    Line {
        relative: bool,
        targets: Named<f64>,
    },
    Wave {
        square: bool,
        axis: Spanned<String>,
        wave: RawWave,
    },
    Table {
        axis: Spanned<String>,
        file: Spanned<String>,
    },
    Gear(Spanned<String>, RawGear),
    Velocity(Named<f64>),
    Torque {
        targets: Named<f64>,
        ramp: Option<Ns>,
    },
    Mode(Named<String>),
    Dwell(Ns),
    Wait {
        conditions: Vec<RawCondition>,
        timeout: Option<Ns>,
    },
    Set(Vec<(RawSignal, Spanned<f64>)>),
    Repeat {
        times: u32,
        steps: Vec<RawStep>,
    },
}

/// `io."Input 3"`: a device and one of its signals.
#[derive(Debug)]
pub(crate) struct RawSignal {
    pub device: Spanned<String>,
    pub name: Spanned<String>,
}

#[derive(Debug)]
pub(crate) struct RawCondition {
    pub signal: RawSignal,
    pub equal: Key<f64>,
    pub above: Key<f64>,
    pub below: Key<f64>,
}

table! { "a condition",
    table Bounds {
        above: Key<f64>,
        below: Key<f64>,
    }
}

table! { "a wave",
    table RawWave {
        amplitude: Key<f64> = "1.0",
        frequency: Key<f64> = "2.0",
        periods: Key<u32> [1..=1_000_000] = "5",
    }
}

table! { "a gear",
    table RawGear {
        to: Key<String> = "\"x\"",
        ratio: Key<f64>,
        actual: Key<bool>,
        offset: Key<f64>,
        smoothing: Key<Ns>,
    }
}

const EDGES: [(&str, Edge); 2] = [("rising", Edge::Positive), ("falling", Edge::Negative)];

table! { "a probe",
    /// Exactly one of `to` and `by` is given.
    table RawProbe {
        to: Key<f64>,
        by: Key<f64>,
        input: Key<u8> [1..=2],
        edge: Key<Edge> [EDGES],
    }
}

/// The verbs, each with an example and the keys that go with it. The key of a step that is a verb
/// defines the action.
#[rustfmt::skip] // one row per verb
const VERBS: [(&str, &str, &[&str]); 21] = [
    ("enable", "enable = [\"x\"]", &[]),
    ("disable", "disable = true", &[]),
    ("reset", "reset = [\"x\"]", &[]),
    ("stop", "stop = [\"x\"]", &[]),
    ("home", "home = [\"x\"]", &[]),
    ("move", "move = { x = 50.0 }", &["speed", "ramp", "arrive"]),
    ("move_by", "move_by = { x = -5.0 }", &["speed", "ramp", "arrive"]),
    ("probe", "probe = { x = { to = 50.0, input = 1 } }", &["speed", "ramp"]),
    ("line", "line = { x = 50.0, y = 20.0 }", &["speed", "ramp"]),
    ("line_by", "line_by = { x = 5.0, y = -2.0 }", &["speed", "ramp"]),
    ("sine", "sine = { x = { amplitude = 1.0, frequency = 2.0, periods = 5 } }", &[]),
    ("square", "square = { x = { amplitude = 1.0, frequency = 0.5, periods = 5 } }", &[]),
    ("table", "table = { x = \"points.csv\" }", &["speed", "ramp"]),
    ("gear", "gear = { y = { to = \"x\", ratio = 2.0 } }", &[]),
    ("velocity", "velocity = { v = 100.0 }", &["ramp"]),
    ("torque", "torque = { t = 10.0 }", &["ramp"]),
    ("mode", "mode = { x = \"csv\" }", &[]),
    ("dwell", "dwell = \"500ms\"", &[]),
    ("wait", "wait = { io.\"Input 1\" = true }", &["timeout"]),
    ("set", "set = { io.\"Output 1\" = true }", &[]),
    ("repeat", "repeat = 3", &["step"]),
];

/// Keys that go with verbs.
const COMPANIONS: [&str; 5] = ["speed", "ramp", "arrive", "timeout", "step"];

const ARRIVALS: [(&str, bool); 2] = [("each", false), ("together", true)];

/// The timeouts of `wait`: at most half an hour more than a week.
const TIMEOUTS: RangeInclusive<Ns> = 1_000_000..=606_600_000_000_000;

/// The maximum depth of nested steps.
const DEEPEST: usize = 8;

impl Read for RawStep {
    const LIST: &'static str = "[[step]] with two brackets";

    fn read(value: Value<'_>, _: &str, p: &mut Problems<'_>) -> Option<Self> {
        read(value, 0, p)
    }
}

fn read(value: Value<'_>, depth: usize, p: &mut Problems<'_>) -> Option<RawStep> {
    let keys = VERBS.iter().map(|(verb, ..)| *verb).chain(COMPANIONS);
    let keys: Vec<TableKey> = keys.map(|key| (key, None)).collect();
    let table = Table::of(value, "[[step]]", &keys, p)?;
    let mut said = VERBS
        .iter()
        .filter_map(|verb| Some((verb, table.get(verb.0)?)));
    let (first, second) = (said.next(), said.next());
    let Some(((verb, example, companions), argument)) = first else {
        if table.written(p).unknown {
            // The unknown key was probably meant as a verb.
            table.done(p);
        } else {
            let examples = VERBS
                .map(|(_, example, _)| format!("`{example}`"))
                .join(", ");
            let hint = format!("a step has one of {examples}");
            p.add_hint(value.span(), "this step does nothing", hint);
        }
        return None;
    };
    if let Some(((other, ..), at)) = second {
        let message = format!("this step does more than one thing: `{verb}` and `{other}`");
        p.add_hint(at.span(), message, "write a [[step]] for each");
        return None;
    }
    for key in COMPANIONS.iter().filter(|key| !companions.contains(key)) {
        if let Some(value) = table.get(key) {
            p.add(value.span(), format!("`{key}` does not go with `{verb}`"));
        }
    }
    let fraction = |key, p: &mut Problems<'_>| {
        let goes = companions.contains(&key) && *verb != "torque";
        goes.then(|| table.read(key, p)).flatten()
    };
    let (speed, ramp) = (fraction("speed", p), fraction("ramp", p));
    let step = Step {
        table: &table,
        verb,
        example,
        depth,
    };
    let action = step.action(argument, p);
    table.done(p);
    let (span, action) = (value.span(), action?);
    Some(RawStep {
        span,
        action,
        speed,
        ramp,
    })
}

/// A step while its action is read.
struct Step<'s, 'd> {
    table: &'s Table<'d>,
    verb: &'static str,
    example: &'static str,
    depth: usize,
}

impl<'d> Step<'_, 'd> {
    fn action(&self, value: Value<'d>, p: &mut Problems<'_>) -> Option<RawAction> {
        let verb = self.verb;
        Some(match verb {
            "enable" => RawAction::Enable(axes(value, verb, p)?),
            "disable" => RawAction::Disable(axes(value, verb, p)?),
            "reset" => RawAction::Reset(axes(value, verb, p)?),
            "stop" => RawAction::Stop(axes(value, verb, p)?),
            "home" => RawAction::Home(axes(value, verb, p)?),
            "move" | "move_by" => {
                let arrive = self.table.get("arrive");
                let together = arrive.and_then(|v| ARRIVALS.read(v, "arrive", p));
                RawAction::Move {
                    relative: verb == "move_by",
                    targets: self.named(value, p)?,
                    together: together.unwrap_or_default(),
                }
            }
            "line" | "line_by" => RawAction::Line {
                relative: verb == "line_by",
                targets: self.named(value, p)?,
            },
            "sine" | "square" => {
                let (axis, wave) = self.only(value, p)?;
                let square = verb == "square";
                RawAction::Wave { square, axis, wave }
            }
            "probe" => {
                let (axis, probe): (_, RawProbe) = self.only(value, p)?;
                probe.distance(p)?;
                RawAction::Probe(axis, probe)
            }
            "table" => {
                let (axis, file) = self.only(value, p)?;
                RawAction::Table { axis, file }
            }
            "gear" => {
                let (axis, gear) = self.only(value, p)?;
                RawAction::Gear(axis, gear)
            }
            "velocity" => RawAction::Velocity(self.named(value, p)?),
            "torque" => RawAction::Torque {
                ramp: self.table.read("ramp", p),
                targets: self.named(value, p)?,
            },
            "mode" => RawAction::Mode(self.named(value, p)?),
            "dwell" => RawAction::Dwell(Ns::read(value, verb, p)?),
            "wait" => {
                let timeout = self.table.get("timeout");
                RawAction::Wait {
                    timeout: timeout.and_then(|v| TIMEOUTS.read(v, "timeout", p)),
                    conditions: Conditions::read(value, verb, p)?.0,
                }
            }
            "set" => {
                let signals = signals(value, p)?.into_iter();
                let levels = signals.filter_map(|(signal, v)| Some((signal, level(v, verb, p)?)));
                RawAction::Set(levels.collect())
            }
            _ => self.repeat(value, p)?,
        })
    }

    fn repeat(&self, value: Value<'d>, p: &mut Problems<'_>) -> Option<RawAction> {
        let times = (1..=1_000_000).read(value, self.verb, p);
        let Some(inner) = self.table.get("step") else {
            let hint = "write the steps below it under [[step.step]], or as `step = [ … ]`";
            p.add_hint(value.span(), "nothing is repeated", hint);
            return None;
        };
        let depth = self.depth + 1;
        if depth >= DEEPEST {
            let message = format!("steps in steps go {DEEPEST} levels deep at most");
            p.add(inner.span(), message);
            return None;
        }
        let inner = array(p, inner, "[[step.step]] with two brackets")?.into_iter();
        let steps = inner.filter_map(|v| read(v, depth, p)).collect();
        Some(RawAction::Repeat {
            times: times?,
            steps,
        })
    }

    /// Reads one axis and its parameter.
    fn only<T: Read>(
        &self,
        value: Value<'d>,
        p: &mut Problems<'_>,
    ) -> Option<(Spanned<String>, T)> {
        if let DeValue::Table(table) = value.get_ref()
            && table.len() == 1
            && let Some((key, inner)) = table.iter().next()
        {
            let axis = Spanned::new(key.span(), key.get_ref().to_string());
            return Some((axis, T::read(inner, self.verb, p)?));
        }
        p.add_hint(value.span(), "expected one axis", self.hint());
        None
    }

    /// Reads axes and a parameter for each.
    fn named<T: Read>(&self, value: Value<'d>, p: &mut Problems<'_>) -> Option<Named<T>> {
        let DeValue::Table(table) = value.get_ref() else {
            p.add_hint(value.span(), "expected axes and targets", self.hint());
            return None;
        };
        if table.is_empty() {
            p.add_hint(value.span(), "no axis is named", self.hint());
        }
        let named = table.iter().filter_map(|(key, value)| {
            let axis = Spanned::new(key.span(), key.get_ref().to_string());
            Some((axis, Spanned::read(value, self.verb, p)?))
        });
        Some(named.collect())
    }

    fn hint(&self) -> String {
        format!("write `{}`", self.example)
    }
}

impl RawProbe {
    /// Checks that the way to search is given once.
    fn distance(&self, p: &mut Problems<'_>) -> Option<()> {
        let (message, hint) = match [self.written.has("to"), self.written.has("by")] {
            [true, true] => {
                let message = "`to` and `by` both say how far to search";
                (message, "leave one of them out")
            }
            [false, false] if self.written.unknown => return None,
            [false, false] => (
                "the distance to search for the edge is missing",
                "add `to = 50.0`, a position, or `by = 10.0`, a way from where the axis is",
            ),
            _ => return Some(()),
        };
        p.add_hint(self.span.clone(), message, hint);
        None
    }
}

/// Reads `true`, a name, or a list of names.
fn axes(value: Value<'_>, verb: &str, p: &mut Problems<'_>) -> Option<RawAxes> {
    match value.get_ref() {
        DeValue::Boolean(true) => Some(None),
        DeValue::String(_) => Some(Some(vec![Spanned::read(value, verb, p)?])),
        DeValue::Array(names) if !names.is_empty() => Some(Some(Vec::read(value, verb, p)?)),
        _ => {
            let hint = "write `true` for every axis, or a list such as [\"x\", \"y\"]";
            p.add_hint(value.span(), "no axis is named", hint);
            None
        }
    }
}

/// Reads `{ io."Input 3" = … }`: by device, then by signal.
fn signals<'d>(value: Value<'d>, p: &mut Problems<'_>) -> Option<Vec<(RawSignal, Value<'d>)>> {
    let example = "write `{ io.\"Input 1\" = true }`: device, signal, value";
    let DeValue::Table(devices) = value.get_ref() else {
        p.add_hint(value.span(), "expected devices and their signals", example);
        return None;
    };
    let mut all = Vec::new();
    for (device, inner) in devices {
        let DeValue::Table(inner) = inner.get_ref() else {
            let message = format!("no signal of `{}` is named", device.get_ref());
            p.add_hint(inner.span(), message, example);
            continue;
        };
        for (name, value) in inner {
            let signal = RawSignal {
                device: Spanned::new(device.span(), device.get_ref().to_string()),
                name: Spanned::new(name.span(), name.get_ref().to_string()),
            };
            all.push((signal, value));
        }
    }
    if all.is_empty() {
        p.add_hint(value.span(), "no signal is named", example);
    }
    Some(all)
}

/// Reads a number; `true` is 1.
fn level(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Key<f64> {
    match value.get_ref() {
        DeValue::Boolean(on) => Some(Spanned::new(value.span(), f64::from(u8::from(*on)))),
        _ => Spanned::read(value, key, p),
    }
}

#[derive(Debug)]
pub(crate) struct Conditions(pub Vec<RawCondition>);

impl Read for Conditions {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        let signals = signals(value, p)?.into_iter();
        Some(Self(
            signals
                .filter_map(|(signal, v)| condition(signal, v, key, p))
                .collect(),
        ))
    }
}

fn condition(
    signal: RawSignal,
    value: Value<'_>,
    key: &str,
    p: &mut Problems<'_>,
) -> Option<RawCondition> {
    let bounds = match value.get_ref() {
        DeValue::Table(_) => Bounds::read(value, key, p)?,
        _ => {
            let (equal, above, below) = (Some(level(value, key, p)?), None, None);
            return Some(RawCondition {
                signal,
                equal,
                above,
                below,
            });
        }
    };
    let Bounds {
        above,
        below,
        written,
        ..
    } = bounds;
    if above.is_none() && below.is_none() {
        if !written.unknown {
            let hint = "write `true`, a number, or `{ above = 100 }`";
            p.add_hint(value.span(), "this waits for nothing", hint);
        }
        return None;
    }
    Some(RawCondition {
        signal,
        equal: None,
        above,
        below,
    })
}
