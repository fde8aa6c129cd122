//! Machines, programs and fault scripts from a seed, as text that a user could have written
//! (`docs/machine-file.md`, `docs/network.md`).

use std::fmt::Write as _;

use super::faults::{Effect, Fault, Moment, script};
use super::random::Random;
use super::scenes;
use super::shaft::Feed;
use super::view::{Axis, CSP, CST, CSV, Machine, PP, PV};
use super::wire::{Profile, packed};

/// A planned run with the facts that the judge needs.
#[derive(Debug, Clone)]
pub struct Plan {
    pub seed: u64,
    pub scene: &'static str,
    pub machine: Machine,
    pub faults: Vec<Fault>,
    /// `--for`, in seconds.
    pub ends_at: f64,
    /// The program runs once, without a limit of time.
    pub once: bool,
    /// The machine file itself may cause a failure.
    pub may_fail: bool,
    pub machine_file: String,
    pub fault_script: String,
    /// Other files in the folder of the machine file.
    pub files: Vec<(String, String)>,
    /// The features of this run, for the statistics.
    pub features: Vec<&'static str>,
    /// The master on another machine.
    pub shaft: Option<Feed>,
}

/// A drive of `configs/esi`: its default process data and its velocity unit.
#[derive(Debug, Clone, Copy)]
struct DriveKind {
    esi: &'static str,
    /// User-defined process data can be mapped.
    free: bool,
    /// 0x60A9: rpm, otherwise counts/s.
    rpm: bool,
    encoder: u32,
}

const EPOS4: DriveKind = DriveKind {
    esi: "esi/EPOS4.xml",
    free: true,
    rpm: true,
    encoder: 2000,
};
const IDX: DriveKind = DriveKind {
    esi: "esi/IDX.xml",
    free: true,
    rpm: true,
    encoder: 4096,
};
const SV1: DriveKind = DriveKind {
    esi: "esi/SV1.xml",
    free: false,
    rpm: false,
    encoder: 131_072,
};

/// Outputs and inputs that allow every change of mode.
const EVERY_MODE: [u16; 8] = [
    0x6040, 0x6060, 0x607a, 0x60ff, 0x6071, 0x6081, 0x6083, 0x6084,
];
const INPUTS: [u16; 5] = [0x6041, 0x6061, 0x6064, 0x606c, 0x6077];
/// The outputs of the SV1, fixed in its ESI.
const SV1_OUTPUTS: [u16; 4] = [0x6040, 0x607a, 0x60ff, 0x6071];
const SV1_INPUTS: [u16; 5] = [0x6041, 0x6064, 0x606c, 0x6077, 0x6061];

/// A machine under construction, with program and faults.
pub struct Draft {
    pub random: Random,
    pub machine: Machine,
    pub faults: Vec<Fault>,
    pub ends_at: f64,
    pub may_fail: bool,
    /// Names of I/O devices by position.
    pub passive: Vec<(u16, String)>,
    pub devices: String,
    /// Keys of `[bus]`.
    pub bus: String,
    /// Tables between the devices and the program.
    pub tables: String,
    pub once: bool,
    /// The probability that a drive has a quirk.
    pub quirks: f64,
    /// The probability that a drive of every mode needs keys of its own.
    pub foreign: f64,
    pub files: Vec<(String, String)>,
    pub features: Vec<&'static str>,
    pub shaft: Option<Feed>,
    pub stop: String,
    /// `on_emergency` of axes that are added later.
    pub on_emergency: &'static str,
    pub steps: String,
    next_position: u16,
}

/// The requirements of a scene for an axis; other properties are random.
#[derive(Debug, Clone, Copy, Default)]
pub struct Wanted {
    pub mode: Option<i8>,
    /// Every mode is mapped.
    pub every_mode: bool,
    /// Seconds from full speed to rest.
    pub ramp_s: Option<f64>,
    /// Acceleration / jerk in seconds; `Some(0)`: no limit of jerk.
    pub jerk_s: Option<f64>,
    /// Quick stop deceleration 0x6085 in rpm/s.
    pub quick_stop: Option<u32>,
    /// Without a range.
    pub endless: bool,
}

impl Draft {
    fn new(seed: u64) -> Self {
        let mut random = Random::new(seed);
        let cycle_us = random.pick(&[500, 1000, 1000, 1000, 2000, 2000, 2000, 4000]);
        Self {
            machine: Machine {
                cycle_ns: cycle_us * 1000,
                lost_frames: random.pick(&[2, 3, 3, 3, 5, 8]),
                pipelined: random.chance(0.2),
                axes: Vec::new(),
                terminals: Vec::new(),
                gantries: Vec::new(),
                switches: Vec::new(),
                hold: None,
            },
            random,
            faults: Vec::new(),
            ends_at: 2.0,
            may_fail: false,
            passive: Vec::new(),
            devices: String::new(),
            bus: String::new(),
            tables: String::new(),
            once: false,
            quirks: 0.0,
            foreign: 0.0,
            files: Vec::new(),
            features: Vec::new(),
            shaft: None,
            stop: String::new(),
            on_emergency: "quick-stop",
            steps: String::new(),
            next_position: 0,
        }
    }

    pub fn seconds(&self) -> f64 {
        self.machine.seconds()
    }

    pub fn drive(&mut self, wanted: Wanted) -> usize {
        let random = &mut self.random;
        // The SV1 has its own range and lacks the objects that a scene may require.
        let free = wanted.every_mode || wanted.quick_stop.is_some();
        let kind = if free || wanted.endless {
            random.pick(&[EPOS4, EPOS4, IDX])
        } else {
            random.pick(&[EPOS4, EPOS4, IDX, SV1])
        };
        let mode = wanted
            .mode
            .unwrap_or_else(|| random.pick(&[CSP, CSP, CSP, CSV]));
        let every_mode = kind.free && (wanted.every_mode || random.chance(0.5));
        let per_turn = random.pick(&[1.0, 1.0, 5.0, 360.0]);
        let velocity = random.pick(&[10.0, 20.0, 30.0, 45.0]) * per_turn;
        let ramp_s = wanted
            .ramp_s
            .unwrap_or_else(|| random.pick(&[0.1, 0.1, 0.2, 0.5]));
        let acceleration = velocity / ramp_s;
        let jerk_s = wanted
            .jerk_s
            .unwrap_or_else(|| random.pick(&[0.0, 0.0, 0.05, 0.2]));
        let endless = wanted.endless || kind.free && random.chance(0.6);
        let reach = velocity * 1.5;
        let loops = every_mode;
        let name = format!("a{}", self.machine.axes.len());
        let position = self.place();

        let text = &mut self.devices;
        let mode_name = mode_name(mode);
        let _ = write!(
            text,
            "\n[[device]]\nname = \"{name}\"\nesi = \"{}\"\nposition = {position}\n\
             mode = \"{mode_name}\"\n",
            kind.esi
        );
        let mut sdo = vec![format!(
            "{{ index = 0x6065, value = {} }}",
            kind.encoder * 20
        )];
        if let Some(quick_stop) = wanted.quick_stop {
            sdo.push(format!("{{ index = 0x6085, value = {quick_stop} }}"));
        }
        let _ = writeln!(text, "sdo = [{}]", sdo.join(", "));
        if every_mode {
            let list = |objects: &[u16]| {
                let each: Vec<String> = objects
                    .iter()
                    .map(|index| format!("\"{index:#06X}\""))
                    .collect();
                each.join(", ").replace("0X", "0x")
            };
            let _ = writeln!(text, "pdo.rx = [{}]", list(&EVERY_MODE));
            let _ = writeln!(text, "pdo.tx = [{}]", list(&INPUTS));
        }
        let _ = write!(
            text,
            "[device.axis]\nunit = \"{}\"\nencoder = {}\nper_turn = {per_turn:?}\n",
            if per_turn == 1.0 {
                "turn"
            } else if per_turn == 360.0 {
                "deg"
            } else {
                "mm"
            },
            kind.encoder
        );
        let mut limits = vec![
            format!("velocity = {velocity:?}"),
            format!("acceleration = {acceleration:?}"),
            "torque = 100.0".to_string(),
        ];
        if jerk_s > 0.0 {
            limits.push(format!("jerk = {:?}", acceleration / jerk_s));
        }
        if !endless {
            limits.push(format!("position = [{:?}, {reach:?}]", -reach));
        }
        let _ = writeln!(text, "limits = {{ {} }}", limits.join(", "));
        if self.on_emergency != "quick-stop" {
            let _ = writeln!(text, "on_emergency = \"{}\"", self.on_emergency);
        }
        if loops {
            let dead_time = self.machine.cycle_ns * 3 / 1000 + 300;
            let _ = write!(
                text,
                "dead_time = \"{dead_time}us\"\ncsv = {{ kv = 20.0, feed_forward = 1.0 }}\n"
            );
            if per_turn == 1.0 {
                text.push_str("cst = { kp = 400.0, tn = \"40ms\", tv = \"12ms\" }\n");
            }
        }
        let counts = f64::from(kind.encoder) / per_turn;
        let rpm = 60.0 / per_turn;
        let (outputs, inputs): (&[u16], &[u16]) = match (every_mode, kind.free) {
            (true, _) => (&EVERY_MODE, &INPUTS),
            (false, false) => (&SV1_OUTPUTS, &SV1_INPUTS),
            (false, true) => (default_outputs(mode), &SV1_INPUTS),
        };
        self.machine.axes.push(Axis {
            name,
            position,
            mode,
            profile: Profile::Cia402,
            outputs: packed(outputs, 0),
            inputs: packed(inputs, 0),
            period: 1,
            enables: 1,
            shows_mode: true,
            follows_bit: true,
            goal: None,
            counts,
            velocity_scale: if kind.rpm { rpm } else { counts },
            acceleration_scale: if kind.rpm { rpm } else { 0.0 },
            velocity,
            acceleration,
            jerk: if jerk_s > 0.0 {
                acceleration / jerk_s
            } else {
                acceleration / 0.05
            },
            torque: 100.0,
            range: (!endless).then_some((-reach * counts, reach * counts)),
            loops,
            may_lose_power: false,
            disturbed: false,
            node: false,
            node_fails: false,
            alone: false,
        });
        self.machine.axes.len() - 1
    }

    /// Returns the position of the next device.
    pub fn place(&mut self) -> u16 {
        self.next_position += 1;
        self.next_position - 1
    }

    pub fn io(&mut self) -> u16 {
        let position = self.place();
        self.machine.terminals.push(position);
        let name = format!("io{position}");
        let _ = write!(
            self.devices,
            "\n[[device]]\nname = \"{name}\"\nesi = \"esi/IO8.xml\"\nposition = {position}\n"
        );
        self.passive.push((position, name));
        position
    }

    pub fn devices(&self) -> usize {
        usize::from(self.next_position)
    }

    /// Returns the names of the device at a position and of its axes.
    fn names(&self, position: u16) -> Vec<String> {
        let axes = self.machine.axes.iter();
        let axes = axes.filter(|axis| axis.position == position);
        let passive = self.passive.iter().filter(|of| of.0 == position);
        let names = axes.map(|axis| axis.name.clone());
        names.chain(passive.map(|of| of.1.clone())).collect()
    }

    /// Name of the device at a position.
    pub fn name(&self, position: u16) -> String {
        self.names(position).into_iter().next().unwrap_or_default()
    }

    pub fn step(&mut self, lines: &str) {
        let _ = write!(self.steps, "\n[[step]]\n{lines}\n");
    }

    /// Turns every axis until the run ends.
    pub fn turn(&mut self, share: f64) {
        self.run_up(share);
        self.step("dwell = \"60s\"");
    }

    /// Adds steps that turn every axis at this share of its velocity limit, within its range.
    pub fn run_up(&mut self, share: f64) {
        let mut moves = Vec::new();
        for axis in self.machine.axes.clone() {
            let sign = if self.random.chance(0.5) { 1.0 } else { -1.0 };
            if axis.range.is_none() {
                let velocity = axis.velocity * share * sign;
                self.step(&format!("velocity = {{ {} = {velocity:?} }}", axis.name));
            } else if axis.mode == CSP || axis.loops {
                moves.push(format!("{} = {:?}", axis.name, axis.velocity * 1.4 * sign));
            }
        }
        if !moves.is_empty() {
            self.step(&format!(
                "move = {{ {} }}\nspeed = {share:?}",
                moves.join(", ")
            ));
        }
    }

    pub fn fault(&mut self, fault: Fault) {
        if let Some((position, _)) = &fault.device
            && matches!(fault.kind, "load" | "blocked" | "stuck")
        {
            let axes = self.machine.axes.iter_mut();
            let axes = axes.filter(|axis| axis.position == *position);
            axes.for_each(|axis| axis.disturbed = true);
        }
        if let Some((position, _)) = &fault.device {
            let axes = self.machine.axes.iter_mut();
            let nodes = axes.filter(|axis| axis.position == *position && axis.node);
            nodes.for_each(|axis| axis.node_fails = true);
        }
        self.faults.push(fault);
    }

    /// Creates a fault of the device at a position.
    pub fn strike(&mut self, kind: &'static str, at: f64, position: u16, effect: Effect) -> Fault {
        Fault::new(kind, at, effect).device(position, self.names(position))
    }

    fn finish(self, seed: u64, scene: &'static str) -> Plan {
        let machine = &self.machine;
        let mut file = format!(
            "[bus]\nnic = \"sim\"\ncycle = \"{}us\"\nlost_frames = {}\n",
            machine.cycle_ns / 1000,
            machine.lost_frames
        );
        if machine.pipelined {
            file.push_str("exchange = \"pipelined\"\n");
        }
        file.push_str(&self.bus);
        file.push_str(&self.devices);
        file.push_str(&self.tables);
        if !self.stop.is_empty() {
            let _ = write!(file, "\n[stop]\n{}", self.stop);
        }
        file.push_str(&self.steps);
        Plan {
            seed,
            scene,
            fault_script: script(seed, &self.faults),
            machine_file: file,
            machine: self.machine,
            faults: self.faults,
            ends_at: self.ends_at,
            once: self.once,
            may_fail: self.may_fail,
            files: self.files,
            features: self.features,
            shaft: self.shaft,
        }
    }
}

impl Plan {
    /// Returns the plan with fault times from the mode changes and the stop, in seconds. Faults
    /// without a matching event are dropped.
    pub fn placed(&self, changes: &[f64], stop: Option<f64>) -> Self {
        let mut plan = self.clone();
        plan.faults.retain_mut(|fault| {
            let moment = match fault.after {
                Some(Moment::ModeChange(number)) => changes.get(number).copied(),
                Some(Moment::Stop) => stop,
                None => Some(0.0),
            };
            fault.at += moment.unwrap_or_default();
            moment.is_some()
        });
        plan.fault_script = script(plan.seed, &plan.faults);
        plan
    }
}

pub fn mode_name(mode: i8) -> &'static str {
    match mode {
        CSV => "csv",
        CST => "cst",
        PP => "pp",
        PV => "pv",
        _ => "csp",
    }
}

/// The outputs of EPOS4 and IDX in the modules and PDOs of their ESI, by mode.
fn default_outputs(mode: i8) -> &'static [u16] {
    match mode {
        CSV => &[0x6040, 0x60ff, 0x60b2],
        CST => &[0x6040, 0x6071, 0x60b2],
        _ => &[0x6040, 0x607a, 0x60b1, 0x60b2],
    }
}

/// Returns the plan for a seed. Each scene gets about a tenth of the seeds.
pub fn plan(seed: u64, only: Option<&str>) -> Plan {
    let mut draft = Draft::new(seed);
    let scenes: Vec<_> = scenes::SCENES
        .iter()
        .filter(|scene| only.is_none_or(|name| name == scene.0))
        .collect();
    assert!(!scenes.is_empty(), "no scene {only:?}");
    let (name, draw) = *draft.random.pick(&scenes);
    draw(&mut draft);
    draft.finish(seed, name)
}
