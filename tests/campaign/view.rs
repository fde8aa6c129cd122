//! The data that one drive received, and the data that its MainDevice could know at that time.

use super::wire::{Cycle, Inputs, Outputs, Wire};

/// CiA 402 modes of operation (IEC 61800-7-201, table 41).
pub const CSP: i8 = 8;
pub const CSV: i8 = 9;
pub const CST: i8 = 10;
pub const PP: i8 = 1;
pub const PV: i8 = 3;

/// The number of kept reports: outputs may follow any of the last ones.
const RECENT: usize = 4;

/// The machine as the generator wrote it.
#[derive(Debug, Clone)]
pub struct Machine {
    pub cycle_ns: u64,
    pub lost_frames: usize,
    pub pipelined: bool,
    pub axes: Vec<Axis>,
}

#[derive(Debug, Clone)]
pub struct Axis {
    pub name: String,
    pub position: u16,
    pub mode: i8,
    pub outputs: Vec<u16>,
    pub inputs: Vec<u16>,
    /// Counts per unit, and the values of 0x60FF and 0x6083 for one unit/s and one unit/s².
    pub counts: f64,
    pub velocity_scale: f64,
    pub acceleration_scale: f64,
    /// Limits of the file, in units; torque in percent.
    pub velocity: f64,
    pub acceleration: f64,
    pub jerk: f64,
    pub torque: f64,
    pub range: Option<(f64, f64)>,
    /// True with a position loop over 0x60FF or 0x6071.
    pub loops: bool,
    /// A key of the file or a fault of the script may remove power while the axis turns.
    pub may_lose_power: bool,
    /// The script applies a torque to the shaft.
    pub disturbed: bool,
    /// The axis is in a group that stops alone.
    pub alone: bool,
}

impl Axis {
    /// Returns the counts per cycle at the velocity limit.
    pub fn velocity_step(&self, machine: &Machine) -> f64 {
        self.velocity * self.counts * machine.seconds()
    }

    /// Returns the change of the step per cycle at the acceleration limit.
    pub fn acceleration_step(&self, machine: &Machine) -> f64 {
        self.acceleration * self.counts * machine.seconds().powi(2)
    }
}

impl Machine {
    pub fn seconds(&self) -> f64 {
        self.cycle_ns as f64 * 1e-9
    }

    /// Returns the cycles from an answer to the first outputs that may depend on it.
    pub fn answer_to_outputs(&self) -> usize {
        if self.pipelined { 2 } else { 1 }
    }

    /// True if an answer is in time: the cycle waits for three quarters of its length
    /// (`docs/architecture.md`, "The life of a cycle").
    fn is_in_time(&self, cycle: &Cycle, back: u64) -> bool {
        let later = if self.pipelined { self.cycle_ns } else { 0 };
        back <= cycle.at + self.cycle_ns * 19 / 25 + later
    }
}

/// The outputs of one cycle and the knowledge at the time of sending.
#[derive(Debug, Clone, Copy)]
pub struct Moment {
    pub cycle: usize,
    pub at: u64,
    pub sent: Outputs,
    /// The last reports, newest first; only the first `heard` are valid.
    recent: [Inputs; RECENT],
    heard: usize,
    /// The last report in time.
    pub in_time: Option<Inputs>,
    /// Cycles since the last answer in time; 0: fresh.
    pub age: usize,
    /// Consecutive cycles without any answer, even a late one.
    pub silent: usize,
    /// Whole cycles that were skipped before this one.
    pub left_out: usize,
    /// The reported speed in counts per cycle: the least of the last three, 0 if their signs
    /// differ.
    pub speed: f64,
}

impl Moment {
    pub fn recent(&self) -> &[Inputs] {
        &self.recent[..self.heard]
    }

    pub fn last(&self) -> Option<&Inputs> {
        self.recent().first()
    }

    /// "Operation enabled" is requested (IEC 61800-7-201, table 27).
    pub fn requests_operation(&self) -> bool {
        self.sent.controlword & 0x8f == 0x0f
    }

    /// The last report shows Operation enabled (IEC 61800-7-201, table 29).
    pub fn is_operation_enabled(&self) -> bool {
        self.last()
            .is_some_and(|report| report.is_operation_enabled())
    }

    pub fn asked(&self, axis: &Axis) -> i8 {
        self.sent.mode.unwrap_or(axis.mode)
    }

    pub fn shown(&self, axis: &Axis) -> i8 {
        self.last()
            .and_then(|report| report.mode)
            .unwrap_or(axis.mode)
    }
}

impl Inputs {
    pub fn is_operation_enabled(&self) -> bool {
        self.statusword & 0x6f == 0x27
    }

    pub fn is_quick_stop(&self) -> bool {
        self.statusword & 0x6f == 0x07
    }

    pub fn is_fault(&self) -> bool {
        self.statusword & 0x08 != 0
    }
}

/// Returns every cycle in which the drive was in the process data.
pub fn moments(machine: &Machine, wire: &Wire, drive: usize) -> Vec<Moment> {
    let mut moments: Vec<Moment> = Vec::new();
    let delay = machine.answer_to_outputs();
    let mut reports: Vec<(usize, Inputs)> = Vec::new();
    let (mut age, mut silent, mut in_time) = (0, 0, None);
    for (number, cycle) in wire.cycles.iter().enumerate() {
        if let Some(due) = number.checked_sub(delay) {
            let answer = wire.cycles[due].drives[drive].and_then(|of| of.heard);
            match answer {
                Some((back, inputs)) if machine.is_in_time(&wire.cycles[due], back) => {
                    reports.push((due, inputs));
                    (age, in_time) = (0, Some(inputs));
                }
                _ => age += 1,
            }
            // The MainDevice computes outputs when the previous cycle has stopped waiting.
            let made = cycle.at.saturating_sub(machine.cycle_ns * 6 / 25);
            silent = silent_cycles(wire, drive, due, made, silent);
            late_reports(wire, drive, due, cycle.at, &mut reports);
        }
        let Some(exchange) = cycle.drives[drive] else {
            continue;
        };
        let previous = number
            .checked_sub(1)
            .map_or(cycle.at, |of| wire.cycles[of].at);
        let gap = (cycle.at - previous + machine.cycle_ns / 2) / machine.cycle_ns;
        let mut recent = [Inputs::default(); RECENT];
        let newest = reports.iter().rev().map(|(_, inputs)| *inputs);
        for (to, inputs) in recent.iter_mut().zip(newest) {
            *to = inputs;
        }
        moments.push(Moment {
            cycle: number,
            at: cycle.at,
            sent: exchange.sent,
            recent,
            heard: reports.len().min(RECENT),
            in_time,
            age,
            silent,
            left_out: (gap as usize).saturating_sub(1),
            speed: speed(&reports),
        });
    }
    moments
}

fn silent_cycles(wire: &Wire, drive: usize, due: usize, now: u64, before: usize) -> usize {
    // A late answer ends the silence from its cycle on.
    (0..=before)
        .find(|back| {
            let answer = due
                .checked_sub(*back)
                .and_then(|of| wire.cycles[of].drives[drive]);
            answer
                .and_then(|of| of.heard)
                .is_some_and(|(at, _)| at < now)
        })
        .unwrap_or(before + 1)
}

/// Adds each late report once.
fn late_reports(
    wire: &Wire,
    drive: usize,
    due: usize,
    now: u64,
    reports: &mut Vec<(usize, Inputs)>,
) {
    let newest = reports.last().map_or(0, |report| report.0 + 1);
    for number in newest.max(due.saturating_sub(8))..=due {
        let answer = wire.cycles[number].drives[drive].and_then(|of| of.heard);
        if let Some((_, inputs)) = answer.filter(|(back, _)| *back < now) {
            reports.push((number, inputs));
        }
    }
}

fn speed(reports: &[(usize, Inputs)]) -> f64 {
    let Some(last) = reports.last_chunk::<4>() else {
        return 0.0;
    };
    let mut slowest = f64::INFINITY;
    let mut direction = 0.0;
    for pair in last.windows(2) {
        let way = f64::from(pair[1].1.position.wrapping_sub(pair[0].1.position));
        let speed = way / (pair[1].0 - pair[0].0) as f64;
        if speed * direction < 0.0 {
            return 0.0;
        }
        direction = speed;
        slowest = slowest.min(speed.abs());
    }
    slowest
}

impl std::fmt::Display for Moment {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            cycle,
            sent,
            age,
            silent,
            speed,
            ..
        } = self;
        write!(f, "{cycle}: Controlword {:04x}", sent.controlword)?;
        let targets = [
            ("0x607A", sent.position),
            ("0x60FF", sent.velocity),
            ("0x6071", sent.torque.map(i32::from)),
            ("0x6060", sent.mode.map(i32::from)),
        ];
        for (object, value) in targets {
            if let Some(value) = value {
                write!(f, " {object} {value}")?;
            }
        }
        if let Some(report) = self.last() {
            let Inputs {
                statusword,
                position,
                mode,
            } = report;
            write!(
                f,
                " | Statusword {statusword:04x} 0x6064 {position} 0x6061 {mode:?}"
            )?;
        }
        write!(f, " | age {age}, silent {silent}, speed {speed:.1}")
    }
}
