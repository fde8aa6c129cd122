//! CiA 402 axes in process data: the location of their objects, and their motion.

use ecaxis_axis::{Controlword, Mode, State, Statusword};
use ecaxis_esi::Layout;

use super::events::EventKind;
use super::match_frames::DatagramExchange;
use super::objects::{Mapped, Objects};
use super::registers::Registers;
use super::rows::Rows;

/// The maximum number of points per curve; twice as many are merged in pairs.
const POINTS: usize = 1500;
/// The maximum number of stored state, mode and error changes per axis.
const CHANGES: usize = 2000;
/// The maximum number of objects per device.
const PLACES: usize = 256;
/// The maximum number of axes per device; each has 0x800 objects.
const AXES: u16 = 8;

/// An object of an axis. The values are indices of the first axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Signal {
    Controlword,
    Statusword,
    Mode,
    ModeDisplay,
    ErrorCode,
    TargetPosition,
    ActualPosition,
    TargetVelocity,
    ActualVelocity,
    TargetTorque,
    ActualTorque,
}

impl Signal {
    fn of(index: u16) -> Option<Self> {
        Some(match index {
            0x6040 => Self::Controlword,
            0x6041 => Self::Statusword,
            0x6060 => Self::Mode,
            0x6061 => Self::ModeDisplay,
            0x603f => Self::ErrorCode,
            0x607a => Self::TargetPosition,
            0x6064 => Self::ActualPosition,
            0x60ff => Self::TargetVelocity,
            0x606c => Self::ActualVelocity,
            0x6071 => Self::TargetTorque,
            0x6077 => Self::ActualTorque,
            _ => return None,
        })
    }
}

/// A curve with a bounded number of points, each with minimum and maximum of several cycles.
#[derive(Debug, Default, Clone)]
pub struct Curve {
    /// The time of the first cycle in ns since 1970, minimum, maximum.
    pub points: Vec<(u64, f64, f64)>,
    /// The number of cycles per point.
    every: u64,
    left: u64,
}

impl Curve {
    fn add(&mut self, at: u64, value: f64) {
        match self.points.last_mut().filter(|_| self.left > 0) {
            Some((_, least, greatest)) => {
                (*least, *greatest) = (least.min(value), greatest.max(value));
                self.left -= 1;
            }
            None => {
                self.points.push((at, value, value));
                self.left = self.every;
            }
        }
        if self.points.len() >= 2 * POINTS {
            let pairs = self.points.chunks(2).filter_map(|pair| {
                let (first, last) = (pair.first()?, pair.last()?);
                Some((first.0, first.1.min(last.1), first.2.max(last.2)))
            });
            self.points = pairs.collect();
            self.every = 2 * self.every + 1;
            self.left = 0;
        }
    }

    /// Returns minimum and maximum of all points.
    #[must_use]
    pub fn range(&self) -> Option<(f64, f64)> {
        let (_, least, greatest) = *self.points.first()?;
        let both = self
            .points
            .iter()
            .fold((least, greatest), |(l, g), p| (l.min(p.1), g.max(p.2)));
        Some(both)
    }
}

/// One axis of a device.
#[derive(Debug, Default)]
pub struct Axis {
    /// 0 is the axis at 0x6000.
    pub number: u8,
    /// The axis in the machine file.
    pub index: Option<usize>,
    pub cycles: u64,
    pub state: Option<State>,
    /// The states and their start times.
    pub states: Vec<(u64, State)>,
    /// The modes and their start times, from 0x6061, or from 0x6060 if 0x6061 is not mapped.
    pub modes: Vec<(u64, Mode)>,
    pub error: Option<u16>,
    /// True if a Controlword enabled the operation.
    pub commanded: bool,
    /// Target and actual value. The target is that of a mode that uses it, in Operation enabled.
    pub position: (Curve, Curve),
    pub velocity: (Curve, Curve),
    pub torque: (Curve, Curve),
    /// The largest difference between target and actual position in counts, in CSP while Operation
    /// enabled.
    pub largest_error: Option<i64>,
    /// The same difference with its sign.
    pub following_error: Curve,
    shows_mode: bool,
}

#[derive(Debug, Clone, Copy)]
struct MappedSignal {
    axis: usize,
    signal: Signal,
    /// The logical address in bits.
    bit: u64,
    bits: u8,
    output: bool,
}

/// The axes of one device.
#[derive(Debug, Default)]
pub struct Axes {
    pub axes: Vec<Axis>,
    signals: Vec<MappedSignal>,
}

impl Axes {
    /// Locates the objects: from the PDOs in the recording, else from a layout.
    pub fn locate(&mut self, registers: &Registers, objects: &Objects, layout: Option<&Layout>) {
        self.signals.clear();
        let fmmus: Vec<_> = registers.fmmus().collect();
        for sm in registers.sync_managers().filter(|sm| !sm.mailbox) {
            let mapped = objects
                .mapping(sm.number)
                .or_else(|| Some(of_layout(layout?, sm.number)))
                .unwrap_or_default();
            for entry in mapped {
                let physical = u64::from(sm.start) * 8 + u64::from(entry.bit);
                let mut logical = fmmus
                    .iter()
                    .filter(|fmmu| if sm.output { fmmu.output } else { fmmu.input })
                    .filter_map(|fmmu| {
                        let from =
                            u64::from(fmmu.physical) * 8 + u64::from(fmmu.physical_start_bit);
                        let offset = physical.checked_sub(from)?;
                        let within = offset + u64::from(entry.bits) <= u64::from(fmmu.len) * 8;
                        let base = u64::from(fmmu.logical) * 8 + u64::from(fmmu.logical_start_bit);
                        within.then_some(base + offset)
                    });
                if let Some(bit) = logical.next() {
                    self.place(entry, bit, sm.output);
                }
            }
        }
        // An axis has a Statusword or a Controlword.
        let is_word =
            |p: &MappedSignal| matches!(p.signal, Signal::Controlword | Signal::Statusword);
        let words: Vec<usize> = self
            .signals
            .iter()
            .filter(|p| is_word(p))
            .map(|p| p.axis)
            .collect();
        self.signals.retain(|place| words.contains(&place.axis));
        let shown = |n| {
            self.signals
                .iter()
                .any(|p| p.axis == n && p.signal == Signal::ModeDisplay)
        };
        let shown: Vec<bool> = (0..self.axes.len()).map(shown).collect();
        for (axis, shown) in self.axes.iter_mut().zip(shown) {
            axis.shows_mode = shown;
        }
    }

    fn place(&mut self, entry: Mapped, bit: u64, output: bool) {
        let Some(number) = entry
            .index
            .checked_sub(0x6000)
            .map(|offset| offset / 0x0800)
        else {
            return;
        };
        let signal = Signal::of(entry.index.wrapping_sub(number * 0x0800));
        let (Some(signal), true) = (signal, number < AXES && self.signals.len() < PLACES) else {
            return;
        };
        let number = number as u8;
        let axis = self
            .axes
            .iter()
            .position(|axis| axis.number == number)
            .unwrap_or_else(|| {
                self.axes.push(Axis {
                    number,
                    ..Axis::default()
                });
                self.axes.len() - 1
            });
        self.signals.push(MappedSignal {
            axis,
            signal,
            bit,
            bits: entry.bits,
            output,
        });
    }

    /// Processes one process data datagram.
    pub fn process_data(
        &mut self,
        passed: &DatagramExchange<'_>,
        rows: &mut Option<Rows>,
        mut report: impl FnMut(EventKind),
    ) {
        let start = u64::from(passed.address) * 8;
        let mut targets = [None; AXES as usize];
        for place in &self.signals {
            let data = if place.output {
                passed.written().filter(|_| passed.command.writes())
            } else {
                passed.back.filter(|_| passed.command.reads())
            };
            let value = data.and_then(|data| bits(data, place.bit.checked_sub(start)?, place.bits));
            let (Some(value), Some(axis)) = (value, self.axes.get_mut(place.axis)) else {
                continue;
            };
            if place.signal == Signal::TargetPosition
                && let Some(target) = targets.get_mut(place.axis)
            {
                *target = Some(value.1);
            }
            axis.takes(place.signal, passed.at, value, &mut report);
            let hidden = place.signal == Signal::Mode && axis.shows_mode;
            if let (Some(rows), Some(index), false) = (rows.as_mut(), axis.index, hidden) {
                rows.take(index, place.signal, value);
            }
            if place.signal == Signal::ActualPosition
                && let Some(Some(target)) = targets.get(place.axis)
            {
                axis.follows(passed.at, *target, value.1);
            }
        }
    }

    /// Iterates over the axes with data.
    pub fn seen(&self) -> impl Iterator<Item = &Axis> {
        self.axes.iter().filter(|axis| axis.cycles > 0)
    }
}

impl Axis {
    fn takes(
        &mut self,
        signal: Signal,
        at: u64,
        value: (u64, i64),
        report: &mut impl FnMut(EventKind),
    ) {
        let (raw, signed) = value;
        let number = signed as f64;
        match signal {
            Signal::Controlword => {
                let enable = Controlword::ENABLE_OPERATION | Controlword::SWITCH_ON;
                self.commanded |= Controlword::from_bits_retain(raw as u16).contains(enable);
            }
            Signal::Statusword => {
                self.cycles += 1;
                let state = State::from_statusword(Statusword::from_bits_retain(raw as u16));
                if self.state != Some(state) {
                    self.state = Some(state);
                    self.commanded |= state == State::OperationEnabled;
                    if self.states.len() < CHANGES {
                        self.states.push((at, state));
                        report(EventKind::Axis {
                            axis: self.number,
                            state,
                        });
                    }
                }
            }
            Signal::Mode if self.shows_mode => {}
            Signal::Mode | Signal::ModeDisplay => {
                let mode = Mode::from_code(signed as i8);
                if self.modes.last().map(|last| last.1) != Some(mode) && self.modes.len() < CHANGES
                {
                    self.modes.push((at, mode));
                }
            }
            Signal::ErrorCode => {
                let code = raw as u16;
                if self.error.unwrap_or(0) != code {
                    report(EventKind::AxisError {
                        axis: self.number,
                        code,
                    });
                }
                self.error = Some(code);
            }
            Signal::TargetPosition | Signal::TargetVelocity | Signal::TargetTorque
                if !self.uses(signal) => {}
            Signal::TargetPosition => self.position.0.add(at, number),
            Signal::ActualPosition => self.position.1.add(at, number),
            Signal::TargetVelocity => self.velocity.0.add(at, number),
            Signal::ActualVelocity => self.velocity.1.add(at, number),
            Signal::TargetTorque => self.torque.0.add(at, number),
            Signal::ActualTorque => self.torque.1.add(at, number),
        }
    }

    /// True if the axis follows this target now. Without a known mode, it may.
    fn uses(&self, target: Signal) -> bool {
        let mode = self.modes.last().map(|(_, mode)| *mode);
        let used = mode.is_none_or(|mode| match target {
            Signal::TargetPosition => matches!(mode, Mode::Csp | Mode::Pp),
            Signal::TargetVelocity => matches!(mode, Mode::Csv | Mode::Pv),
            _ => matches!(mode, Mode::Cst),
        });
        used && self.state == Some(State::OperationEnabled)
    }

    fn follows(&mut self, at: u64, target: i64, actual: i64) {
        let csp = self.modes.last().is_none_or(|(_, mode)| *mode == Mode::Csp);
        if csp && self.state == Some(State::OperationEnabled) {
            let error = target.saturating_sub(actual);
            self.largest_error = self.largest_error.max(Some(error.saturating_abs()));
            self.following_error.add(at, error as f64);
        }
    }
}

/// Returns the objects of a SyncManager from a layout, with offsets in the SyncManager.
fn of_layout(layout: &Layout, number: u8) -> Vec<Mapped> {
    let both = [(&layout.outputs, &layout.rx), (&layout.inputs, &layout.tx)];
    for (managers, fields) in both {
        let mut from = 0;
        for sm in managers {
            let to = from + u32::from(sm.len) * 8;
            if sm.sm == number {
                let own = fields.iter().filter(|f| (from..to).contains(&f.bit_offset));
                let mapped = own.map(|field| Mapped {
                    index: field.index,
                    sub: field.sub,
                    bit: field.bit_offset - from,
                    bits: u8::try_from(field.bit_len).unwrap_or(u8::MAX),
                });
                return mapped.collect();
            }
            from = to;
        }
    }
    Vec::new()
}

/// Returns up to 64 bits of process data, unsigned and signed.
fn bits(data: &[u8], at: u64, len: u8) -> Option<(u64, i64)> {
    let len = u32::from(len);
    if !(1..=64).contains(&len) {
        return None;
    }
    let first = usize::try_from(at / 8).ok()?;
    let shift = (at % 8) as u32;
    let bytes = usize::try_from((shift + len).div_ceil(8)).ok()?;
    let bytes = data.get(first..first.checked_add(bytes)?)?;
    let wide = bytes
        .iter()
        .rev()
        .fold(0_u128, |n, byte| n << 8 | u128::from(*byte))
        >> shift;
    let raw = (wide as u64) << (64 - len);
    Some((raw >> (64 - len), (raw as i64) >> (64 - len)))
}
