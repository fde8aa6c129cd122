//! The data that one drive received, and the data that its MainDevice could know at that time.

use super::wire::{Cycle, DriveLayout, Inputs, Outputs, Place, Profile, Wire};

/// CiA 402 modes of operation (IEC 61800-7-201, table 41).
pub const CSP: i8 = 8;
pub const CSV: i8 = 9;
pub const CST: i8 = 10;
pub const PP: i8 = 1;
pub const PV: i8 = 3;
pub const HOMING: i8 = 6;

/// Cycles in which a report that a drive cannot mean does not count.
const DOUBTED: usize = 5;

/// The number of kept reports.
pub const RECENT: usize = 12;

/// The machine as the generator wrote it.
#[derive(Debug, Clone)]
pub struct Machine {
    pub cycle_ns: u64,
    pub lost_frames: usize,
    pub pipelined: bool,
    pub axes: Vec<Axis>,
    /// The positions of devices without a drive.
    pub terminals: Vec<u16>,
    /// The halves of gantries, as indices of axes.
    pub gantries: Vec<[usize; 2]>,
    pub switches: Vec<Switch>,
    /// The input that holds the machine: index of the terminal, and bit.
    pub hold: Option<(usize, u8)>,
}

/// An output that is on while the target of an axis is in a range.
#[derive(Debug, Clone)]
pub struct Switch {
    /// The index of the terminal.
    pub terminal: usize,
    pub bit: u8,
    /// The index of the axis.
    pub axis: usize,
    /// Ranges in counts, from inclusive to exclusive.
    pub ranges: Vec<[f64; 2]>,
    pub lead_s: f64,
    /// The positions of the axis are undefined until it is homed.
    pub homes: bool,
}

#[derive(Debug, Clone)]
pub struct Axis {
    pub name: String,
    pub position: u16,
    pub mode: i8,
    pub profile: Profile,
    pub outputs: Vec<Place>,
    pub inputs: Vec<Place>,
    /// The cycles of a set-point: 1, or those of the gateway's SYNC.
    pub period: usize,
    /// How often the program may give power.
    pub enables: usize,
    /// The drive shows its mode before Operation enabled.
    pub shows_mode: bool,
    /// The drive serves Statusword bit 12, or the file says so.
    pub follows_bit: bool,
    /// The position in units at which the program ends, if it ends.
    pub goal: Option<f64>,
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
    /// The axis is a node behind a gateway.
    pub node: bool,
    /// A fault of the script concerns the gateway of the axis or its node: what it reports is not of the
    /// node in every cycle.
    pub node_fails: bool,
    /// The axis is in a group that stops alone.
    pub alone: bool,
}

impl Axis {
    /// Returns the counts per cycle at the velocity limit.
    pub fn velocity_step(&self, machine: &Machine) -> f64 {
        self.velocity * self.counts * machine.seconds()
    }

    /// Returns the counts per set-point at the velocity limit.
    pub fn set_point_step(&self, machine: &Machine) -> f64 {
        self.velocity_step(machine) * self.period as f64
    }

    /// Returns the change of the step per set-point at the acceleration limit.
    pub fn acceleration_step(&self, machine: &Machine) -> f64 {
        let seconds = machine.seconds() * self.period as f64;
        self.acceleration * self.counts * seconds.powi(2)
    }

    pub fn layout(&self) -> DriveLayout {
        DriveLayout {
            position: self.position,
            profile: self.profile,
            outputs: self.outputs.clone(),
            inputs: self.inputs.clone(),
        }
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
    /// A report in [`RECENT`] cycles had values that the drive cannot mean.
    pub doubtful: bool,
    /// The last reports, newest first; only the first `heard` are valid.
    recent: [Inputs; RECENT],
    heard: usize,
    /// The last report in time.
    pub in_time: Option<Inputs>,
    /// Cycles since the last answer in time; 0: fresh.
    pub age: usize,
    /// Consecutive cycles without any answer, even a late one.
    pub silent: usize,
    /// Likewise of the other half of a gantry, whose set-points wait together (`docs/motion.md`,
    /// gantries).
    pub half_silent: usize,
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

    /// The last report shows that the drive follows its targets, if it shows that at all.
    pub fn follows(&self, axis: &Axis) -> bool {
        let shown = |report: &Inputs| report.statusword & 0x1000 != 0;
        !axis.follows_bit || self.last().is_some_and(shown)
    }

    /// One of the last reports shows that: a drive may lose the bit for ten cycles.
    pub fn has_followed(&self, axis: &Axis) -> bool {
        let shown = |report: &Inputs| report.statusword & 0x1000 != 0;
        !axis.follows_bit || self.recent().iter().any(shown)
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

    /// True for a state of the table (IEC 61800-7-201, table 29).
    pub fn is_listed(&self) -> bool {
        matches!(self.statusword & 0x4f, 0x00 | 0x40 | 0x0f | 0x08)
            || matches!(self.statusword & 0x6f, 0x21 | 0x23 | 0x27 | 0x07)
    }

    /// Not ready to switch on.
    fn is_starting(&self) -> bool {
        self.statusword & 0x4f == 0
    }

    pub fn is_quick_stop(&self) -> bool {
        self.statusword & 0x6f == 0x07
    }

    pub fn is_fault(&self) -> bool {
        self.statusword & 0x08 != 0
    }
}

/// Returns every cycle in which the drive was in the process data.
fn moments(machine: &Machine, wire: &Wire, drive: usize) -> Vec<Moment> {
    let mut moments: Vec<Moment> = Vec::new();
    let period = machine.axes[drive].period;
    let delay = machine.answer_to_outputs();
    let mut reports = Reports::default();
    let (mut age, mut silent, mut in_time) = (0, 0, None);
    for (number, cycle) in wire.cycles.iter().enumerate() {
        if let Some(due) = number.checked_sub(delay) {
            let answer = wire.cycles[due].drives[drive].and_then(|of| of.heard);
            match answer {
                Some((back, inputs)) if machine.is_in_time(&wire.cycles[due], back) => {
                    reports.add(period, due, inputs);
                    (age, in_time) = (0, Some(inputs));
                }
                _ => age += 1,
            }
            // The MainDevice computes outputs when the previous cycle has stopped waiting.
            let made = cycle.at.saturating_sub(machine.cycle_ns * 6 / 25);
            silent = silent_cycles(wire, drive, due, made, silent);
            reports.add_late(wire, (drive, period), due, cycle.at);
        }
        let Some(exchange) = cycle.drives[drive] else {
            continue;
        };
        let previous = number
            .checked_sub(1)
            .map_or(cycle.at, |of| wire.cycles[of].at);
        let gap = (cycle.at - previous + machine.cycle_ns / 2) / machine.cycle_ns;
        let mut recent = [Inputs::default(); RECENT];
        let newest = reports.list.iter().rev().map(|(_, inputs)| *inputs);
        for (to, inputs) in recent.iter_mut().zip(newest) {
            *to = inputs;
        }
        moments.push(Moment {
            cycle: number,
            at: cycle.at,
            sent: exchange.sent,
            doubtful: reports
                .doubted_at
                .is_some_and(|at| number < at + RECENT * period),
            recent,
            heard: reports.list.len().min(RECENT),
            in_time,
            age,
            silent,
            half_silent: 0,
            left_out: (gap as usize).saturating_sub(1),
            speed: speed(&reports.list),
        });
    }
    moments
}

/// Returns the moments of every drive.
pub fn views(machine: &Machine, wire: &Wire) -> Vec<Vec<Moment>> {
    let mut views: Vec<Vec<Moment>> = (0..machine.axes.len())
        .map(|drive| moments(machine, wire, drive))
        .collect();
    for [first, second] in &machine.gantries {
        for (own, other) in [(*first, *second), (*second, *first)] {
            let silences: Vec<(usize, usize)> =
                views[other].iter().map(|m| (m.cycle, m.silent)).collect();
            for moment in &mut views[own] {
                let at = silences.binary_search_by_key(&moment.cycle, |(cycle, _)| *cycle);
                moment.half_silent = at.map_or(0, |at| silences[at].1);
            }
        }
    }
    views
}

/// Returns the moments that bring a set-point. Behind a gateway, the outputs stay for a SYNC: the
/// moments in which they change, and others where they do not change for longer.
pub fn set_points(axis: &Axis, moments: &[Moment]) -> Vec<Moment> {
    let mut kept: Vec<Moment> = Vec::new();
    for moment in moments {
        let stays = kept.last().is_some_and(|last| {
            last.sent == moment.sent && moment.cycle < last.cycle + 2 * axis.period
        });
        if axis.period == 1 || !stays {
            kept.push(*moment);
        }
    }
    kept
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

/// The reports of a drive, each with its cycle.
#[derive(Default)]
struct Reports {
    list: Vec<(usize, Inputs)>,
    /// The cycle after that of the last report, also of one that does not count.
    next: usize,
    started: bool,
    doubted: usize,
    doubted_at: Option<usize>,
}

impl Reports {
    /// Adds each late report once.
    fn add_late(&mut self, wire: &Wire, (drive, period): (usize, usize), due: usize, now: u64) {
        for number in self.next.max(due.saturating_sub(8))..=due {
            let answer = wire.cycles[number].drives[drive].and_then(|of| of.heard);
            if let Some((_, inputs)) = answer.filter(|(back, _)| *back < now) {
                self.add(period, number, inputs);
            }
        }
    }

    /// Adds a report, unless a gateway repeats it until the next SYNC, or the drive cannot mean it: an
    /// unlisted Statusword, or Not ready to switch on after the start, for up to five cycles
    /// (`docs/axis.md`).
    fn add(&mut self, period: usize, number: usize, inputs: Inputs) {
        self.next = number + 1;
        self.started |= !inputs.is_starting();
        let doubtful = self.started && inputs.is_starting() || !inputs.is_listed();
        if doubtful {
            self.doubted_at = Some(number);
        }
        if doubtful && self.doubted < DOUBTED * period {
            self.doubted += 1;
            return;
        }
        self.doubted = 0;
        let repeats = |last: &(usize, Inputs)| last.1 == inputs && number < last.0 + period;
        if period == 1 || !self.list.last().is_some_and(repeats) {
            self.list.push((number, inputs));
        }
    }
}

fn speed(reports: &[(usize, Inputs)]) -> f64 {
    let Some(last) = reports.last_chunk::<4>() else {
        return 0.0;
    };
    // Homing changes the positions.
    if last.iter().any(|(_, report)| report.mode == Some(HOMING)) {
        return 0.0;
    }
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
