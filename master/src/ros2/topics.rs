//! The topics of a machine. Messages are made from a row of samples; diagnostics from their parts.

use std::ops::Range;

use ecaxis_axis::{State, Statusword};

use super::cdr::CdrEncoder;
use super::schema::{self, Schema};
use crate::clock::Nanos;
use crate::config::{Machine, si_factor};
use crate::rt::samples::{AXIS_COLUMNS, COUNT_COLUMNS, CYCLE_COLUMNS, flags};

/// The first word of the axes in a row.
const AXES_AT: usize = COUNT_COLUMNS.len() + CYCLE_COLUMNS.len();

/// Where the values of a topic come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Source {
    /// All axes, in SI units.
    JointStates,
    Diagnostics,
    Bus,
    Inputs,
    /// The axis with this index.
    Axis(usize),
}

/// A topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Topic {
    pub name: String,
    pub schema: Schema,
    pub source: Source,
}

/// The state of a part of the machine (`diagnostic_msgs/DiagnosticStatus`).
#[derive(Debug, Clone, PartialEq)]
pub struct Diagnostic {
    pub level: DiagnosticLevel,
    pub name: String,
    pub message: String,
    pub hardware_id: String,
    pub values: Vec<(&'static str, String)>,
}

/// The level of a [`Diagnostic`], as in ROS.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum DiagnosticLevel {
    Ok = 0,
    Warn = 1,
    Error = 2,
    Stale = 3,
}

#[derive(Debug, Clone, PartialEq)]
struct TopicAxis {
    name: String,
    /// The SI units in one unit of the axis.
    si: f64,
}

/// The topics of a machine.
#[derive(Debug, Clone, PartialEq)]
pub struct Topics {
    topics: Vec<Topic>,
    axes: Vec<TopicAxis>,
    inputs: usize,
    /// The time in ns since 1970 at which the clock of the samples was 0.
    epoch: Nanos,
}

/// The values of a row of samples.
struct Row<'r>(&'r [u64]);

impl Row<'_> {
    fn count(&self, at: usize) -> u64 {
        self.0.get(at).copied().unwrap_or_default()
    }

    fn value(&self, at: usize) -> f64 {
        self.0
            .get(at)
            .map_or(f64::NAN, |bits| f64::from_bits(*bits))
    }

    fn axis(&self, axis: usize) -> [f64; AXIS_COLUMNS.len()] {
        let at = AXES_AT + axis * AXIS_COLUMNS.len();
        std::array::from_fn(|column| self.value(at + column))
    }
}

impl Topics {
    /// Returns the topics of a machine. `epoch`: the time in ns since 1970 at which the clock of
    /// the samples was 0.
    #[must_use]
    pub fn new(machine: &Machine, epoch: Nanos) -> Self {
        let axes = machine.axes.iter().map(|axis| TopicAxis {
            name: axis.name.clone(),
            si: si_factor(&axis.unit).unwrap_or(1.0),
        });
        let axes: Vec<_> = axes.collect();
        let inputs: Vec<_> = machine
            .inputs
            .iter()
            .map(|input| input.name.clone())
            .collect();
        let mut topics = Vec::new();
        let mut add = |name: String, schema, source| {
            let used: Vec<&str> = topics.iter().map(|topic: &Topic| &*topic.name).collect();
            let name = schema::unique(&name, &used);
            topics.push(Topic {
                name,
                schema,
                source,
            });
        };
        add(
            "/joint_states".into(),
            schema::JOINT_STATE,
            Source::JointStates,
        );
        add(
            "/diagnostics".into(),
            schema::DIAGNOSTIC_ARRAY,
            Source::Diagnostics,
        );
        add("/ecaxis/bus".into(), schema::BUS, Source::Bus);
        if !inputs.is_empty() {
            add(
                "/ecaxis/inputs".into(),
                schema::inputs(&inputs),
                Source::Inputs,
            );
        }
        for (index, axis) in axes.iter().enumerate() {
            let name = format!("/ecaxis/axis/{}", token(&axis.name));
            add(name, schema::AXIS, Source::Axis(index));
        }
        Self {
            topics,
            axes,
            inputs: inputs.len(),
            epoch,
        }
    }

    #[must_use]
    pub fn list(&self) -> &[Topic] {
        &self.topics
    }

    /// Returns the words of a row from which the messages of a topic are made.
    #[must_use]
    pub fn words(&self, source: Source) -> Range<usize> {
        let axis = |index: usize| AXES_AT + index * AXIS_COLUMNS.len();
        let end = axis(self.axes.len());
        match source {
            Source::Diagnostics => 0..0,
            Source::Bus => COUNT_COLUMNS.len()..AXES_AT,
            Source::JointStates => AXES_AT..end,
            Source::Axis(index) => axis(index)..axis(index + 1),
            Source::Inputs => end..end + self.inputs,
        }
    }

    /// Returns the time in ns since 1970 at which the clock of the samples was 0.
    #[must_use]
    pub fn epoch(&self) -> Nanos {
        self.epoch
    }

    /// Returns the time in ns since 1970 of a time of the samples.
    #[must_use]
    pub fn unix_time(&self, time: Nanos) -> Nanos {
        self.epoch.saturating_add(time)
    }

    /// Appends the message of a topic for a row of samples. `missed`: the rows before this one that
    /// the receiver did not get. Returns false for topics that do not come from rows.
    pub fn encode(&self, source: Source, row: &[u64], missed: u64, bytes: &mut Vec<u8>) -> bool {
        let row = Row(row);
        let time = self.unix_time(row.count(1));
        // Word 0 is the number plus 1.
        let number = row.count(0).saturating_sub(1);
        match source {
            Source::Diagnostics => return false,
            Source::JointStates => self.joint_states(time, &row, bytes),
            Source::Bus => bus(time, &row, number, missed, bytes),
            Source::Inputs => self.inputs(time, &row, bytes),
            Source::Axis(index) => {
                let name = self.axes.get(index).map_or("", |axis| &axis.name);
                axis(time, name, number, row.axis(index), bytes);
            }
        }
        true
    }

    fn joint_states(&self, time: Nanos, row: &Row<'_>, bytes: &mut Vec<u8>) {
        let mut to = CdrEncoder::new(bytes);
        header(&mut to, time, "");
        to.length(self.axes.len());
        for axis in &self.axes {
            to.string(&axis.name);
        }
        for column in 0..2 {
            to.length(self.axes.len());
            for (index, axis) in self.axes.iter().enumerate() {
                to.f64(row.axis(index)[column] * axis.si);
            }
        }
        // The torque at the joint is not known.
        to.length(0);
    }

    fn inputs(&self, time: Nanos, row: &Row<'_>, bytes: &mut Vec<u8>) {
        let mut to = CdrEncoder::new(bytes);
        header(&mut to, time, "");
        for word in self.words(Source::Inputs) {
            to.f64(row.value(word));
        }
    }
}

/// Appends the message of [`Source::Diagnostics`]. `time` is in ns since 1970.
pub fn encode_diagnostics(time: Nanos, diagnostics: &[Diagnostic], bytes: &mut Vec<u8>) {
    let mut to = CdrEncoder::new(bytes);
    header(&mut to, time, "");
    to.length(diagnostics.len());
    for diagnostic in diagnostics {
        to.u8(diagnostic.level as u8);
        to.string(&diagnostic.name);
        to.string(&diagnostic.message);
        to.string(&diagnostic.hardware_id);
        to.length(diagnostic.values.len());
        for (key, value) in &diagnostic.values {
            to.string(key);
            to.string(value);
        }
    }
}

/// Appends a `std_msgs/Header`.
fn header(to: &mut CdrEncoder<'_>, time: Nanos, frame_id: &str) {
    const SECOND: Nanos = 1_000_000_000;
    to.i32(i32::try_from(time / SECOND).unwrap_or(i32::MAX));
    to.u32((time % SECOND) as u32);
    to.string(frame_id);
}

fn bus(time: Nanos, row: &Row<'_>, number: u64, missed: u64, bytes: &mut Vec<u8>) {
    let mut to = CdrEncoder::new(bytes);
    header(&mut to, time, "");
    to.u64(number);
    to.u64(missed);
    to.u64(row.count(2));
    for flag in [
        flags::FRESH,
        flags::IN_OP,
        flags::STOPPING,
        flags::PHASE_LOCKED,
    ] {
        to.bool(row.count(3) & flag != 0);
    }
    for column in 0..CYCLE_COLUMNS.len() {
        to.f64(row.value(COUNT_COLUMNS.len() + column));
    }
}

fn axis(
    time: Nanos,
    name: &str,
    number: u64,
    values: [f64; AXIS_COLUMNS.len()],
    bytes: &mut Vec<u8>,
) {
    let [numbers @ .., statusword, controlword, mode, difference] = values;
    let state = match statusword.is_nan() {
        true => u8::MAX,
        false => state_code(State::from_statusword(Statusword::from_bits_retain(
            statusword as u16,
        ))),
    };
    let mut to = CdrEncoder::new(bytes);
    header(&mut to, time, name);
    to.u64(number);
    for value in numbers.into_iter().chain([difference]) {
        to.f64(value);
    }
    // `as` saturates, and maps NaN to 0.
    to.u16(statusword as u16);
    to.u16(controlword as u16);
    to.i8(mode as i8);
    to.u8(state);
}

/// Returns the constant of `ecaxis_msgs/Axis`.
fn state_code(state: State) -> u8 {
    match state {
        State::NotReadyToSwitchOn => 0,
        State::SwitchOnDisabled => 1,
        State::ReadyToSwitchOn => 2,
        State::SwitchedOn => 3,
        State::OperationEnabled => 4,
        State::QuickStopActive => 5,
        State::FaultReactionActive => 6,
        State::Fault => 7,
        State::Unknown(_) => u8::MAX,
    }
}

/// Returns a name as part of a topic, which has letters, digits and `_`.
fn token(name: &str) -> String {
    let plain = |c: char| if c.is_ascii_alphanumeric() { c } else { '_' };
    name.chars().map(plain).collect()
}
