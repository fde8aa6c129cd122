//! `[[step]]` as written: one verb each, with its parameters.

use std::ops::RangeInclusive;

use ecaxis_axis::Edge;
use toml::Spanned;
use toml::de::DeValue;

use super::super::fields::{
    Domain, Field, Key, Ns, Read, Table, TableKey, Value, Written, array, unquoted,
};
use super::super::problem::{Problems, Span, list};
use super::super::schema::{self, Schema};
use super::condition::{Levels, RawWhen};
use super::number::RawNumber;

mod definition;

/// Axes with a parameter each.
pub(crate) type Named<T> = Vec<(Spanned<String>, Spanned<T>)>;

/// Axes by name; `None`: all.
pub(crate) type RawAxes = Option<Vec<Spanned<String>>>;

#[derive(Debug)]
pub(crate) struct RawStep {
    pub span: Span,
    pub action: RawAction,
    pub speed: Key<RawNumber>,
    pub ramp: Key<RawNumber>,
}

#[derive(Debug)]
pub(crate) enum RawAction {
    Enable(RawAxes),
    Disable(RawAxes),
    Reset(RawAxes),
    Stop(RawAxes),
    Home(RawAxes),
    Couple {
        axes: RawAxes,
        coupled: bool,
    },
    Move {
        relative: bool,
        targets: Named<RawNumber>,
        together: bool,
    },
    Probe(Spanned<String>, RawProbe),
    Line {
        relative: bool,
        targets: Named<RawNumber>,
    },
    Wave {
        square: bool,
        axis: Spanned<String>,
        wave: RawWave,
    },
    Table(Named<String>),
    Path(Spanned<String>),
    Gear(Spanned<String>, RawGear),
    Phase(Named<RawNumber>),
    Superimpose(Named<RawNumber>),
    Velocity(Named<RawNumber>),
    Torque {
        targets: Named<RawNumber>,
        ramp: Option<Ns>,
    },
    Mode(Named<String>),
    Dwell(Spanned<RawNumber<Ns>>),
    Wait {
        when: RawWhen,
        timeout: Option<TimeLimit>,
    },
    Set(Levels),
    /// Groups and their override in percent.
    Override(Named<f64>),
    Assign {
        add: bool,
        values: Named<RawNumber>,
    },
    Message(String),
    Alarm(String),
    Repeat {
        /// `None`: without end.
        times: Option<u32>,
        until: Option<RawWhen>,
        steps: Vec<RawStep>,
    },
    While {
        when: RawWhen,
        steps: Vec<RawStep>,
    },
    If {
        when: RawWhen,
        steps: Vec<RawStep>,
        otherwise: Vec<RawStep>,
    },
    Call {
        name: String,
        steps: Vec<RawStep>,
    },
    Parallel(Vec<Vec<RawStep>>),
}

/// The time-out of `wait`; `None`: without limit.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TimeLimit(pub Option<Ns>);

impl Read for TimeLimit {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        match value.get_ref() {
            DeValue::String(word) if word == NONE => Some(Self(None)),
            DeValue::String(word) if !word.starts_with(|c: char| c.is_ascii_digit()) => {
                let hint = format!("write a time such as \"5s\", or \"{NONE}\"");
                p.add_hint(value.span(), format!("`{key}` cannot be \"{word}\""), hint);
                None
            }
            _ => TIMEOUTS.read(value, key, p).map(|ns| Self(Some(ns))),
        }
    }
}

table! { "a wave",
    table RawWave {
        /// Amplitude (unit)
        amplitude: Key<f64> = "1.0",
        /// Frequency (Hz)
        frequency: Key<f64> = "2.0",
        /// Number of periods (1 to 1,000,000)
        periods: Key<u32> [1..=1_000_000] = "5",
    }
}

table! { "a gear",
    table RawGear {
        /// Axis or line shaft that is followed
        to: Key<String> = "\"x\"",
        /// Motion of this axis per motion of the other; negative reverses the direction (default 1)
        ratio: Key<f64>,
        /// If true, the axis follows the reported position instead of the set-point (default false)
        actual: Key<bool>,
        /// Distance to the followed axis (unit; default where the axis is)
        offset: Key<f64>,
        /// Cam between both axes; `ratio` is then the way on the cam per way of the followed axis (name;
        /// default none)
        cam: Key<String>,
        /// Time constant of the followed motion (time; default 0, `"10ms"` with `actual`)
        smoothing: Key<Ns>,
    }
}

const EDGES: [(&str, Edge); 2] = [("rising", Edge::Positive), ("falling", Edge::Negative)];

table! { "a probe",
    /// Exactly one of `to` and `by` is given.
    table RawProbe {
        /// Position up to which the axis searches (unit)
        to: Key<f64>,
        /// Distance over which the axis searches (unit)
        by: Key<f64>,
        /// Touch probe of the drive (1 or 2; default 1)
        input: Key<u8> [1..=2],
        /// Edge (`"rising"`, `"falling"`; default `"rising"`)
        edge: Key<Edge> [EDGES],
    }
}

/// The verbs, each with an example and the keys that go with it. The key of a step that is a verb
/// defines the action.
#[rustfmt::skip] // one row per verb
const VERBS: [(&str, &str, &[&str]); 35] = [
    ("enable", "enable = [\"x\"]", &[]),
    ("disable", "disable = true", &[]),
    ("reset", "reset = [\"x\"]", &[]),
    ("stop", "stop = [\"x\"]", &[]),
    ("home", "home = [\"x\"]", &[]),
    ("couple", "couple = [\"x1\"]", &[]),
    ("decouple", "decouple = [\"x1\"]", &[]),
    ("move", "move = { x = 50.0 }", &["speed", "ramp", "arrive"]),
    ("move_by", "move_by = { x = -5.0 }", &["speed", "ramp", "arrive"]),
    ("probe", "probe = { x = { to = 50.0, input = 1 } }", &["speed", "ramp"]),
    ("line", "line = { x = 50.0, y = 20.0 }", &["speed", "ramp"]),
    ("line_by", "line_by = { x = 5.0, y = -2.0 }", &["speed", "ramp"]),
    ("sine", "sine = { x = { amplitude = 1.0, frequency = 2.0, periods = 5 } }", &[]),
    ("square", "square = { x = { amplitude = 1.0, frequency = 0.5, periods = 5 } }", &[]),
    ("table", "table = { x = \"points.csv\" }", &["speed", "ramp"]),
    ("path", "path = \"outline\"", &["speed", "ramp"]),
    ("gear", "gear = { y = { to = \"x\", ratio = 2.0 } }", &[]),
    ("phase", "phase = { y = 5.0 }", &[]),
    ("superimpose", "superimpose = { x = 0.5 }", &[]),
    ("velocity", "velocity = { v = 100.0 }", &["ramp"]),
    ("torque", "torque = { t = 10.0 }", &["ramp"]),
    ("mode", "mode = { x = \"csv\" }", &[]),
    ("dwell", "dwell = \"500ms\"", &[]),
    ("wait", "wait = { io.\"Input 1\" = true }", &["timeout"]),
    ("set", "set = { io.\"Output 1\" = true }", &[]),
    ("override", "override = 50", &[]),
    ("let", "let = { parts = 0 }", &[]),
    ("add", "add = { parts = 1 }", &[]),
    ("message", "message = \"load the magazine\"", &[]),
    ("alarm", "alarm = \"no part in the gripper\"", &[]),
    ("call", "call = \"pick\"", &["with", "step"]),
    ("parallel", "parallel = [{ step = [{ move = { x = 5.0 } }] }, { step = [{ move = { y = 5.0 } }] }]", &[]),
    ("repeat", "repeat = 3", &["step", "until"]),
    ("while", "while = { io.\"Input 1\" = true }", &["step"]),
    ("if", "if = { io.\"Input 1\" = true }", &["step", "else"]),
];

/// Keys that go with verbs, each with its description.
#[rustfmt::skip] // one row per key
const COMPANIONS: [(&str, &str); 8] = [
    ("speed", "Fraction of each axis' velocity limit (above 0, up to 1; default 1)"),
    ("ramp", "Fraction of the acceleration limit (above 0, up to 1); with `torque`: the time to the new torque"),
    ("arrive", "If `\"together\"`, all axes arrive in the same cycle (`\"each\"`, `\"together\"`; default `\"each\"`)"),
    ("timeout", "Time after which the step fails (time, 1 ms to a week, or `\"none\"`; default `\"10s\"`)"),
    ("step", "The steps that are repeated, or run if the condition holds"),
    ("with", "The values of the subprogram's parameters"),
    ("until", "Condition that ends the repetition after a round"),
    ("else", "The steps that run if the condition does not hold"),
];

const ARRIVALS: [(&str, bool); 2] = [("each", false), ("together", true)];

const NONE: &str = "none";
const FOREVER: &str = "forever";

/// The timeouts of `wait`: at most half an hour more than a week.
const TIMEOUTS: RangeInclusive<Ns> = 1_000_000..=606_600_000_000_000;

/// The maximum depth of nested steps.
const DEEPEST: usize = 8;
/// The maximum number of branches that run at the same time.
const MOST_BRANCHES: usize = 8;

impl Read for RawStep {
    const LIST: &'static str = "[[step]] with two brackets";

    fn read(value: Value<'_>, _: &str, p: &mut Problems<'_>) -> Option<Self> {
        read(value, 0, p)
    }
}

fn read(value: Value<'_>, depth: usize, p: &mut Problems<'_>) -> Option<RawStep> {
    let keys = VERBS.iter().map(|(verb, ..)| *verb);
    let keys = keys.chain(COMPANIONS.map(|(key, _)| key));
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
    let wrong = COMPANIONS.iter().map(|(key, _)| key);
    for key in wrong.filter(|key| !companions.contains(key)) {
        if let Some(value) = table.get(key) {
            let with = VERBS.iter().filter(|(.., keys)| keys.contains(key));
            let hint = format!("`{key}` goes with {}", list(with.map(|(verb, ..)| *verb)));
            p.add_hint(
                value.span(),
                format!("`{key}` does not go with `{verb}`"),
                hint,
            );
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
            "couple" | "decouple" => RawAction::Couple {
                axes: axes(value, verb, p)?,
                coupled: verb == "couple",
            },
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
            "table" => RawAction::Table(self.named(value, p)?),
            "path" => RawAction::Path(Spanned::read(value, verb, p)?),
            "gear" => {
                let (axis, gear) = self.only(value, p)?;
                RawAction::Gear(axis, gear)
            }
            "phase" => RawAction::Phase(self.named(value, p)?),
            "superimpose" => RawAction::Superimpose(self.named(value, p)?),
            "velocity" => RawAction::Velocity(self.named(value, p)?),
            "torque" => RawAction::Torque {
                ramp: self.table.read("ramp", p),
                targets: self.named(value, p)?,
            },
            "mode" => RawAction::Mode(self.named(value, p)?),
            "dwell" => RawAction::Dwell(Spanned::read(value, verb, p)?),
            "wait" => {
                let timeout = self.table.get("timeout");
                RawAction::Wait {
                    timeout: timeout.and_then(|v| TimeLimit::read(v, "timeout", p)),
                    when: RawWhen::read(value, verb, p)?,
                }
            }
            "set" => RawAction::Set(Levels::read(value, verb, p)?),
            "override" => RawAction::Override(match value.get_ref() {
                DeValue::Table(_) => self.named(value, p)?,
                _ => {
                    let machine = Spanned::new(value.span(), "machine".to_owned());
                    vec![(machine, Spanned::read(value, verb, p)?)]
                }
            }),
            "let" | "add" => RawAction::Assign {
                add: verb == "add",
                values: self.named(value, p)?,
            },
            "message" => RawAction::Message(String::read(value, verb, p)?),
            "alarm" => RawAction::Alarm(String::read(value, verb, p)?),
            "call" => RawAction::Call {
                name: String::read(value, verb, p)?,
                steps: self.inner(self.table.get("step")?, p)?,
            },
            "parallel" => RawAction::Parallel(self.branches(value, p)?),
            "while" => {
                let (when, steps) = (RawWhen::read(value, verb, p), self.steps(value, "step", p));
                RawAction::While {
                    when: when?,
                    steps: steps?,
                }
            }
            "if" => {
                let (when, steps) = (RawWhen::read(value, verb, p), self.steps(value, "step", p));
                let otherwise = self.table.get("else");
                let otherwise = otherwise.map(|_| self.steps(value, "else", p));
                RawAction::If {
                    when: when?,
                    steps: steps?,
                    otherwise: otherwise.unwrap_or_else(|| Some(Vec::new()))?,
                }
            }
            _ => {
                let times = match value.get_ref() {
                    DeValue::String(word) if word == FOREVER => Some(None),
                    DeValue::String(word) if unquoted(word).is_none() => {
                        let message = format!("`repeat` cannot be \"{word}\"");
                        let hint = format!("write a number, or \"{FOREVER}\"");
                        p.add_hint(value.span(), message, hint);
                        None
                    }
                    _ => (1..=1_000_000).read(value, verb, p).map(Some),
                };
                let until = self.table.get("until");
                let until = until.map(|until| RawWhen::read(until, "until", p));
                let steps = self.steps(value, "step", p);
                RawAction::Repeat {
                    times: times?,
                    until: until.map_or(Some(None), |until| until.map(Some))?,
                    steps: steps?,
                }
            }
        })
    }

    /// Reads the steps inside the step.
    fn steps(&self, value: Value<'d>, key: &str, p: &mut Problems<'_>) -> Option<Vec<RawStep>> {
        let empty =
            |value: &Value<'d>| matches!(value.get_ref(), DeValue::Array(all) if all.is_empty());
        let Some(inner) = self.table.get(key).filter(|value| !empty(value)) else {
            let hint = "write the steps below it under [[step.step]], or as `step = [ … ]`";
            let message = match self.verb {
                "if" => "`if` has no steps",
                _ => "nothing is repeated",
            };
            p.add_hint(value.span(), message, hint);
            return None;
        };
        array(p, inner, &format!("[[step.{key}]] with two brackets"))?;
        self.inner(inner, p)
    }

    /// Reads a list of steps.
    fn inner(&self, inner: Value<'d>, p: &mut Problems<'_>) -> Option<Vec<RawStep>> {
        let depth = self.depth + 1;
        if depth >= DEEPEST {
            let message = format!("steps in steps go {DEEPEST} levels deep at most");
            p.add_hint(
                inner.span(),
                message,
                "write the inner ones as steps of their own",
            );
            return None;
        }
        let inner = array(p, inner, RawStep::LIST)?.into_iter();
        Some(inner.filter_map(|v| read(v, depth, p)).collect())
    }

    /// Reads the branches of `parallel`.
    fn branches(&self, value: Value<'d>, p: &mut Problems<'_>) -> Option<Vec<Vec<RawStep>>> {
        let all = array(p, value, "[[step.parallel]] with two brackets")?;
        if !(2..=MOST_BRANCHES).contains(&all.len()) {
            let message = format!(
                "`parallel` has 2 to {MOST_BRANCHES} branches, not {}",
                all.len()
            );
            p.add_hint(
                value.span(),
                message,
                "write each branch under [[step.parallel]]",
            );
            return None;
        }
        let branches: Vec<_> = all.into_iter().map(|v| self.branch(v, p)).collect();
        branches.into_iter().collect()
    }

    fn branch(&self, value: Value<'d>, p: &mut Problems<'_>) -> Option<Vec<RawStep>> {
        const KEYS: [TableKey; 1] = [("step", Some("[{ move = { x = 5.0 } }]"))];
        let table = Table::of(value, "[[step.parallel]]", &KEYS, p)?;
        let steps = table.get("step").and_then(|steps| self.inner(steps, p));
        table.done(p);
        if steps.as_ref().is_some_and(Vec::is_empty) {
            let hint = "write its steps under [[step.parallel.step]]";
            p.add_hint(value.span(), "this branch has no steps", hint);
            return None;
        }
        steps
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
