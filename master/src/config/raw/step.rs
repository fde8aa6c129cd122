//! `[[step]]` as written: one verb each, with its parameters.

use toml::Spanned;
use toml::de::DeValue;

use super::super::fields::{self, Fields};
use super::super::problem::{Problems, Span};
use super::motion::{self, RawProbe};
use super::{Value, tables};

#[derive(Debug)]
pub(crate) struct RawStep {
    pub span: Span,
    pub action: RawAction,
}

#[derive(Debug)]
pub(crate) struct RawTarget {
    pub axis: Spanned<String>,
    pub value: Spanned<f64>,
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
    pub equal: Option<Spanned<f64>>,
    pub above: Option<Spanned<f64>>,
    pub below: Option<Spanned<f64>>,
}

#[derive(Debug)]
pub(crate) enum RawAction {
    /// `None`: all axes.
    Enable(Option<Vec<Spanned<String>>>),
    Disable(Option<Vec<Spanned<String>>>),
    Reset(Option<Vec<Spanned<String>>>),
    Stop(Option<Vec<Spanned<String>>>),
    Home(Option<Vec<Spanned<String>>>),
    Move {
        relative: bool,
        targets: Vec<RawTarget>,
        speed: Option<Spanned<f64>>,
        ramp: Option<Spanned<f64>>,
        arrive: Option<Spanned<String>>,
    },
    Probe(RawProbe),
    Line {
        relative: bool,
        targets: Vec<RawTarget>,
        speed: Option<Spanned<f64>>,
        ramp: Option<Spanned<f64>>,
    },
    Wave {
        square: bool,
        axis: Spanned<String>,
        amplitude: Option<Spanned<f64>>,
        frequency: Option<Spanned<f64>>,
        periods: Option<Spanned<u32>>,
    },
    Table {
        axis: Spanned<String>,
        file: Spanned<String>,
        speed: Option<Spanned<f64>>,
        ramp: Option<Spanned<f64>>,
    },
    Gear {
        axis: Spanned<String>,
        to: Option<Spanned<String>>,
        ratio: Option<Spanned<f64>>,
        actual: Option<Spanned<bool>>,
        offset: Option<Spanned<f64>>,
        smoothing: Option<Spanned<u64>>,
    },
    Velocity {
        targets: Vec<RawTarget>,
        ramp: Option<Spanned<f64>>,
    },
    Torque {
        targets: Vec<RawTarget>,
        ramp: Option<Spanned<u64>>,
    },
    /// Axes and modes by name.
    Mode(Vec<(Spanned<String>, Spanned<String>)>),
    Dwell(Spanned<u64>),
    Wait {
        conditions: Vec<RawCondition>,
        timeout: Option<Spanned<u64>>,
    },
    Set(Vec<(RawSignal, Spanned<f64>)>),
    Repeat {
        times: Spanned<u32>,
        steps: Vec<RawStep>,
    },
}

/// The verbs, each with an example. The first key of a step that is a verb defines the action.
const VERBS: [(&str, &str); 21] = [
    ("enable", "enable = [\"x\"]"),
    ("disable", "disable = true"),
    ("reset", "reset = [\"x\"]"),
    ("stop", "stop = [\"x\"]"),
    ("home", "home = [\"x\"]"),
    ("move", "move = { x = 50.0 }"),
    ("move_by", "move_by = { x = -5.0 }"),
    ("probe", "probe = { x = { to = 50.0, input = 1 } }"),
    ("line", "line = { x = 50.0, y = 20.0 }"),
    ("line_by", "line_by = { x = 5.0, y = -2.0 }"),
    (
        "sine",
        "sine = { x = { amplitude = 1.0, frequency = 2.0, periods = 5 } }",
    ),
    (
        "square",
        "square = { x = { amplitude = 1.0, frequency = 0.5, periods = 5 } }",
    ),
    ("table", "table = { x = \"points.csv\" }"),
    ("gear", "gear = { y = { to = \"x\", ratio = 2.0 } }"),
    ("velocity", "velocity = { v = 100.0 }"),
    ("torque", "torque = { t = 10.0 }"),
    ("mode", "mode = { x = \"csv\" }"),
    ("dwell", "dwell = \"500ms\""),
    ("wait", "wait = { io.\"Input 1\" = true }"),
    ("set", "set = { io.\"Output 1\" = true }"),
    ("repeat", "repeat = 3"),
];

/// Keys that may follow a verb.
const COMPANIONS: [&str; 5] = ["speed", "ramp", "arrive", "timeout", "step"];

/// The maximum depth of nested steps.
const DEEPEST: usize = 8;

pub(super) fn read(f: Fields<'_>, span: Span, p: &mut Problems<'_>) -> Option<RawStep> {
    read_at(f, span, 0, p)
}

fn read_at(mut f: Fields<'_>, span: Span, depth: usize, p: &mut Problems<'_>) -> Option<RawStep> {
    let mut said = VERBS
        .into_iter()
        .filter_map(|(verb, _)| Some((verb, f.get(verb)?)));
    let (first, second) = (said.next(), said.next());
    let Some((verb, value)) = first else {
        for key in COMPANIONS {
            f.get(key);
        }
        if f.unknown() {
            // The unknown key was probably meant as a verb.
            f.done(p);
        } else {
            let examples = VERBS.map(|(_, example)| format!("`{example}`")).join(", ");
            let hint = format!("a step has one of {examples}");
            p.add_hint(span, "this step does nothing", hint);
        }
        return None;
    };
    if let Some((other, at)) = second {
        let message = format!("this step does more than one thing: `{verb}` and `{other}`");
        p.add_hint(at.span(), message, "write a [[step]] for each");
        return None;
    }
    let action = action(verb, value, &mut f, depth, p);
    for key in COMPANIONS {
        if !f.asked(key)
            && let Some(value) = f.get(key)
        {
            p.add(value.span(), format!("`{key}` does not go with `{verb}`"));
        }
    }
    f.done(p);
    Some(RawStep {
        span,
        action: action?,
    })
}

fn action(
    verb: &str,
    value: Value<'_>,
    f: &mut Fields<'_>,
    depth: usize,
    p: &mut Problems<'_>,
) -> Option<RawAction> {
    let mut number = |key| f.get(key).and_then(|v| fields::number(p, v));
    Some(match verb {
        "enable" => RawAction::Enable(axes(value, p)?),
        "disable" => RawAction::Disable(axes(value, p)?),
        "reset" => RawAction::Reset(axes(value, p)?),
        "stop" => RawAction::Stop(axes(value, p)?),
        "home" => RawAction::Home(axes(value, p)?),
        "move" | "move_by" => {
            let (speed, ramp) = (number("speed"), number("ramp"));
            let arrive = f.get("arrive").and_then(|v| fields::string(p, v));
            RawAction::Move {
                relative: verb == "move_by",
                targets: targets(value, p)?,
                speed,
                ramp,
                arrive,
            }
        }
        "line" | "line_by" => {
            let (speed, ramp) = (number("speed"), number("ramp"));
            RawAction::Line {
                relative: verb == "line_by",
                targets: targets(value, p)?,
                speed,
                ramp,
            }
        }
        "sine" | "square" => motion::wave(verb == "square", value, p)?,
        "probe" => motion::probe(value, f, p)?,
        "table" => {
            let (speed, ramp) = (number("speed"), number("ramp"));
            let (axis, value) = only(value, "{ x = \"points.csv\" }", p)?;
            RawAction::Table {
                speed,
                ramp,
                axis,
                file: fields::string(p, value)?,
            }
        }
        "gear" => motion::gear(value, p)?,
        "velocity" => {
            let ramp = number("ramp");
            RawAction::Velocity {
                targets: targets(value, p)?,
                ramp,
            }
        }
        "torque" => {
            let ramp = f.get("ramp").and_then(|v| fields::duration(p, v));
            RawAction::Torque {
                targets: targets(value, p)?,
                ramp,
            }
        }
        "mode" => RawAction::Mode(named(value, "{ x = \"csv\" }", fields::string, p)?),
        "dwell" => RawAction::Dwell(fields::duration(p, value)?),
        "wait" => {
            let timeout = f.get("timeout").and_then(|v| fields::duration(p, v));
            RawAction::Wait {
                conditions: conditions(value, p)?,
                timeout,
            }
        }
        "set" => RawAction::Set(
            signals(value, p)?
                .into_iter()
                .filter_map(|(signal, value)| Some((signal, level(value, p)?)))
                .collect(),
        ),
        _ => {
            let times = fields::integer(p, value, 1, 1_000_000);
            let Some(inner) = f.get("step") else {
                let hint = "write the steps below it under [[step.step]], or as `step = [ … ]`";
                p.add_hint(value.span(), "nothing is repeated", hint);
                return None;
            };
            if depth + 1 >= DEEPEST {
                p.add(
                    inner.span(),
                    format!("steps in steps go {DEEPEST} levels deep at most"),
                );
                return None;
            }
            let mut steps = Vec::new();
            for (value, span) in tables(p, Some(inner), "[[step.step]]") {
                if let Some(fields) = fields::table(p, value, "[[step]]") {
                    steps.extend(read_at(fields, span, depth + 1, p));
                }
            }
            RawAction::Repeat {
                times: times?,
                steps,
            }
        }
    })
}

/// Reads `true`, a name, or a list of names.
#[allow(clippy::option_option, reason = "invalid, or all axes")]
fn axes(value: Value<'_>, p: &mut Problems<'_>) -> Option<Option<Vec<Spanned<String>>>> {
    let named = |v: Value<'_>, p: &mut Problems<'_>| fields::string(p, v);
    match value.get_ref() {
        DeValue::Boolean(true) => Some(None),
        DeValue::String(_) => Some(Some(vec![named(value, p)?])),
        DeValue::Array(names) if !names.is_empty() => {
            let names: Vec<_> = names.iter().filter_map(|v| named(v, p)).collect();
            Some(Some(names))
        }
        _ => {
            let hint = "write `true` for every axis, or a list such as [\"x\", \"y\"]";
            p.add_hint(value.span(), "no axis is named", hint);
            None
        }
    }
}

fn targets(value: Value<'_>, p: &mut Problems<'_>) -> Option<Vec<RawTarget>> {
    let named = named(value, "{ x = 50.0 }", fields::number, p)?;
    let targets = named.into_iter();
    Some(
        targets
            .map(|(axis, value)| RawTarget { axis, value })
            .collect(),
    )
}

/// Reads one axis and its parameter.
pub(super) fn only<'d>(
    value: Value<'d>,
    example: &str,
    p: &mut Problems<'_>,
) -> Option<(Spanned<String>, Value<'d>)> {
    if let DeValue::Table(table) = value.get_ref()
        && table.len() == 1
        && let Some((key, inner)) = table.iter().next()
    {
        return Some((Spanned::new(key.span(), key.get_ref().to_string()), inner));
    }
    let hint = format!("write `{example}`");
    p.add_hint(value.span(), "expected one axis", hint);
    None
}

/// Reads axes and a parameter for each.
fn named<T>(
    value: Value<'_>,
    example: &str,
    read: impl Fn(&mut Problems<'_>, Value<'_>) -> Option<Spanned<T>>,
    p: &mut Problems<'_>,
) -> Option<Vec<(Spanned<String>, Spanned<T>)>> {
    let DeValue::Table(table) = value.get_ref() else {
        let hint = format!("write `{example}`");
        p.add_hint(value.span(), "expected axes and targets", hint);
        return None;
    };
    let mut all = Vec::new();
    for (key, value) in table {
        let axis = Spanned::new(key.span(), key.get_ref().to_string());
        all.extend(read(p, value).map(|value| (axis, value)));
    }
    if table.is_empty() {
        let hint = format!("write `{example}`");
        p.add_hint(value.span(), "no axis is named", hint);
    }
    Some(all)
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
fn level(value: Value<'_>, p: &mut Problems<'_>) -> Option<Spanned<f64>> {
    match value.get_ref() {
        DeValue::Boolean(on) => Some(Spanned::new(value.span(), f64::from(u8::from(*on)))),
        _ => fields::number(p, value),
    }
}

pub(super) fn conditions(value: Value<'_>, p: &mut Problems<'_>) -> Option<Vec<RawCondition>> {
    let mut conditions = Vec::new();
    for (signal, value) in signals(value, p)? {
        let mut condition = RawCondition {
            signal,
            equal: None,
            above: None,
            below: None,
        };
        if let DeValue::Table(_) = value.get_ref() {
            let Some(mut f) = fields::table(p, value, "a condition") else {
                continue;
            };
            condition.above = f.get("above").and_then(|v| fields::number(p, v));
            condition.below = f.get("below").and_then(|v| fields::number(p, v));
            let unknown = f.unknown();
            f.done(p);
            if condition.above.is_none() && condition.below.is_none() {
                if !unknown {
                    let hint = "write `true`, a number, or `{ above = 100 }`";
                    p.add_hint(value.span(), "this waits for nothing", hint);
                }
                continue;
            }
        } else {
            condition.equal = Some(level(value, p)?);
        }
        conditions.push(condition);
    }
    Some(conditions)
}
