//! Rows of samples from recorded process data, as a run of the machine keeps them.

use ecaxis_axis::units::{Counts, PerMille, RawVelocity};
use ecaxis_axis::{Mode, Scale};
use ecaxis_master::config::Machine;
use ecaxis_master::rt::samples::{AXIS_COLUMNS, COUNT_COLUMNS, CYCLE_COLUMNS, flags, row_words};

use super::axes::Signal;
use super::cycle::Key;
use super::match_frames::DatagramExchange;

/// The first word of the axes.
const AXES_AT: usize = COUNT_COLUMNS.len() + CYCLE_COLUMNS.len();
/// The word of the time of the exchange.
const EXCHANGE: usize = COUNT_COLUMNS.len() + 1;
/// The columns of an axis.
const POSITION: usize = 0;
const VELOCITY: usize = 1;
const TORQUE: usize = 2;
const TARGET_POSITION: usize = 3;
const TARGET_VELOCITY: usize = 4;
const TARGET_TORQUE: usize = 5;
const FOLLOWING_ERROR: usize = 6;
const STATUSWORD: usize = 7;
const CONTROLWORD: usize = 8;
const MODE: usize = 9;

/// A row of samples, and the number of cycles without an answer before it.
pub type Row = (Vec<u64>, u64);

/// Collects the values of one cycle after another.
#[derive(Debug)]
pub struct Rows {
    scales: Vec<Scale>,
    /// The row of the present cycle. Empty: none has begun.
    row: Vec<u64>,
    words: usize,
    number: u64,
    missed: u64,
    /// The datagrams in the row that have values of axes, and all of the recording.
    begun: Vec<Key>,
    carriers: Vec<Key>,
    filled: bool,
    complete: Vec<Row>,
}

impl Rows {
    pub fn new(machine: &Machine) -> Self {
        Self {
            scales: machine.axes.iter().map(|axis| axis.config.scale).collect(),
            row: Vec::new(),
            words: row_words(machine.axes.len(), machine.inputs.len()),
            number: 0,
            missed: 0,
            begun: Vec::new(),
            carriers: Vec::new(),
            filled: false,
            complete: Vec::new(),
        }
    }

    /// Begins a datagram with process data. `valid`: its values follow.
    pub fn begin(&mut self, key: &Key, passed: &DatagramExchange<'_>, valid: bool) {
        if self.begun.contains(key) {
            self.end();
        }
        if !valid {
            // Of several datagrams of a cycle, one counts.
            self.missed += u64::from(self.carriers.first() == Some(key));
            return;
        }
        if self.row.is_empty() {
            self.row = vec![f64::NAN.to_bits(); self.words];
            self.row[1] = passed.at;
            if let (Some(back), Some(_)) = (passed.back_at, passed.sent) {
                let seconds = back.saturating_sub(passed.at) as f64 * 1e-9;
                self.row[EXCHANGE] = seconds.to_bits();
            }
        }
        self.filled = false;
    }

    /// Ends the datagram. `in_op`: all devices are in Op.
    pub fn end_datagram(&mut self, key: Key, in_op: bool) {
        if !self.filled {
            return;
        }
        self.begun.push(key);
        if !self.carriers.contains(&key) {
            self.carriers.push(key);
        }
        let op = if in_op { flags::IN_OP } else { 0 };
        self.row[3] = flags::FRESH | op;
    }

    /// Takes a value of an axis of the machine file, unsigned and signed.
    pub fn take(&mut self, axis: usize, signal: Signal, (raw, signed): (u64, i64)) {
        let Some(scale) = self.scales.get(axis) else {
            return;
        };
        let position = |counts| scale.position_to_user(Counts(counts)).0;
        let velocity = |raw: i64| {
            scale
                .velocity_to_user(RawVelocity(
                    raw.clamp(i32::MIN.into(), i32::MAX.into()) as i32
                ))
                .0
        };
        let torque = |raw: i64| {
            scale
                .torque_to_user(PerMille(raw.clamp(i16::MIN.into(), i16::MAX.into()) as i16))
                .0
        };
        let (column, value) = match signal {
            Signal::ActualPosition => (POSITION, position(signed)),
            Signal::ActualVelocity => (VELOCITY, velocity(signed)),
            Signal::ActualTorque => (TORQUE, torque(signed)),
            Signal::TargetPosition => (TARGET_POSITION, position(signed)),
            Signal::TargetVelocity => (TARGET_VELOCITY, velocity(signed)),
            Signal::TargetTorque => (TARGET_TORQUE, torque(signed)),
            Signal::Statusword => (STATUSWORD, f64::from(raw as u16)),
            Signal::Controlword => (CONTROLWORD, f64::from(raw as u16)),
            Signal::Mode | Signal::ModeDisplay => (MODE, f64::from(signed as i8)),
            Signal::ErrorCode => return,
        };
        if let Some(word) = self
            .row
            .get_mut(AXES_AT + axis * AXIS_COLUMNS.len() + column)
        {
            *word = value.to_bits();
            self.filled = true;
        }
    }

    /// Ends the present cycle.
    pub fn end(&mut self) {
        if self.begun.is_empty() {
            return;
        }
        self.begun.clear();
        let mut row = std::mem::take(&mut self.row);
        self.number += 1;
        (row[0], row[2]) = (self.number, self.number);
        for axis in row[AXES_AT..]
            .chunks_exact_mut(AXIS_COLUMNS.len())
            .take(self.scales.len())
        {
            let value = |column: usize| f64::from_bits(axis[column]);
            let mode = value(MODE);
            if mode.is_nan() || mode == f64::from(Mode::Csp.code()) {
                axis[FOLLOWING_ERROR] = (value(TARGET_POSITION) - value(POSITION)).to_bits();
            }
        }
        self.complete.push((row, std::mem::take(&mut self.missed)));
    }

    /// Returns the complete rows since the last call.
    pub fn drain(&mut self) -> impl Iterator<Item = Row> + '_ {
        self.complete.drain(..)
    }
}
