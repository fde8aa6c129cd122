//! Machines of several features, with two faults at random moments: every program is made of the
//! steps that its axes and devices permit, each from rest to rest.

use std::fmt::Write as _;

use super::esi;
use super::faults::{Effect, Fault};
use super::foreign;
use super::generate::Draft;
use super::scenes::random_fault;
use super::shaft::Feed;
use super::view::{Axis, CSP, Switch};
use super::wire::{Place, Profile, packed};

/// An axis with the steps that it permits.
#[derive(Debug, Clone)]
struct Member {
    /// The index of the axis.
    index: usize,
    name: String,
    endless: bool,
    /// The set-points of every cycle reach the drive.
    plain: bool,
    every_mode: bool,
    homes: bool,
    /// Every change of mode removes the power.
    cycles_power: bool,
    /// The group of axes that stop together; 0: the rest of the machine.
    group: usize,
}

/// The features that a program combines. The first eight are motions of any axes.
const FEATURES: [&str; 16] = [
    "line",
    "gear",
    "cam",
    "superimpose",
    "path",
    "table",
    "sine",
    "velocity",
    "gantry",
    "position output",
    "second encoder",
    "probe",
    "profile modes",
    "gateway axis",
    "Sercos",
    "hold",
];

/// The range of every axis with a range, in units to both sides.
pub const REACH: f64 = 100.0;
/// Objects and gear of the axes here.
const PER_TURN: f64 = 5.0;

/// Keys of an axis under construction.
#[derive(Default)]
pub struct Keys {
    pub esi: &'static str,
    encoder: u32,
    rpm: bool,
    /// Outputs and inputs of the file, or those of the ESI.
    outputs: Vec<u16>,
    inputs: Vec<u16>,
    mapped: bool,
    pub endless: bool,
    /// The drive shows its mode in Operation enabled only, or changes it without power only.
    pub hides_mode: bool,
    pub cycles_power: bool,
    /// Keys of `[[device]]`.
    pub device: String,
    pub axis: String,
    pub sim: String,
}

/// Quirks of simulated drives with their values (`docs/drive.md`, "Quirks").
const QUIRKS: [(&str, &[&str]); 33] = [
    ("quirk bit12_never", &["true"]),
    ("quirk bit12_late", &["\"5ms\"", "\"40ms\"", "\"300ms\""]),
    ("quirk bit12_lost_at_rest", &["\"20ms\"", "\"200ms\""]),
    ("quirk homed_before", &["\"10ms\"", "\"100ms\""]),
    (
        "quirk unlisted_statusword",
        &["\"2ms\"", "\"8ms\"", "\"100ms\""],
    ),
    (
        "quirk zero_statusword",
        &["\"2ms\"", "\"8ms\"", "\"100ms\""],
    ),
    ("quirk zero_inputs", &["\"4ms\"", "\"50ms\""]),
    ("quirk halt_ignored", &["true"]),
    ("quirk quick_stop_ignored", &["true"]),
    ("quirk quick_stop_removes_power", &["true"]),
    ("quirk shutdown_ignored", &["true"]),
    ("quirk reset_held", &["\"20ms\""]),
    ("quirk mode_shown_late", &["\"20ms\"", "\"200ms\""]),
    ("quirk mode_shown_enabled", &["true"]),
    ("quirk mode_without_power", &["true"]),
    ("quirk unsupported_modes", &["[\"pp\", \"pv\"]"]),
    ("quirk velocity_factor", &["0.1", "10.0", "60.0"]),
    ("quirk shift_after_enable", &["0.01", "2.5", "-40.0"]),
    ("quirk shift_after_homing", &["0.5", "-30.0"]),
    ("quirk home_offset_negated", &["true"]),
    ("quirk absolute_encoder", &["true"]),
    ("quirk load_torque", &["0.01", "-0.02"]),
    ("quirk brake", &["\"4ms\"", "\"60ms\""]),
    ("quirk abort_index_word", &["true"]),
    ("quirk complete_access_refused", &["true"]),
    ("quirk mailbox_slow", &["\"5ms\"", "\"80ms\""]),
    ("quirk mailbox_late", &["\"20ms\"", "\"300ms\""]),
    ("quirk unsolicited_emergencies", &["true"]),
    ("quirk unsolicited_requests", &["true"]),
    ("quirk last_subindex_missing", &["true"]),
    ("quirk assignment_subindices_missing", &["true"]),
    ("quirk exact_control_byte", &["true"]),
    ("quirk error_bit_missing", &["true"]),
];

const CSP_OUTPUTS: [u16; 4] = [0x6040, 0x607a, 0x60b1, 0x60b2];
const SV1_OUTPUTS: [u16; 4] = [0x6040, 0x607a, 0x60ff, 0x6071];
const DEFAULT_INPUTS: [u16; 5] = [0x6041, 0x6064, 0x606c, 0x6077, 0x6061];
const EVERY_MODE: [u16; 8] = [
    0x6040, 0x6060, 0x607a, 0x60ff, 0x6071, 0x6081, 0x6083, 0x6084,
];
const MODE_INPUTS: [u16; 5] = [0x6041, 0x6061, 0x6064, 0x606c, 0x6077];

fn list(objects: &[u16]) -> String {
    let each: Vec<String> = objects.iter().map(|of| format!("\"0x{of:04X}\"")).collect();
    each.join(", ")
}

/// The limits that all axes here have: velocity, acceleration and jerk in units.
fn limits(draft: &mut Draft) -> (f64, f64, f64) {
    let velocity = draft.random.pick(&[50.0, 80.0, 100.0]);
    let acceleration = velocity * draft.random.pick(&[5.0, 10.0, 20.0]);
    let jerk = acceleration * draft.random.pick(&[0.0, 20.0, 50.0]);
    (velocity, acceleration, jerk)
}

/// Adds a drive of CiA 402 and returns the index of its axis.
fn axis(draft: &mut Draft, keys: &Keys) -> usize {
    let name = format!("a{}", draft.machine.axes.len());
    let position = draft.place();
    let (velocity, acceleration, jerk) = limits(draft);
    let text = &mut draft.devices;
    let _ = write!(
        text,
        "\n[[device]]\nname = \"{name}\"\nesi = \"{}\"\nposition = {position}\nmode = \"csp\"\n\
         sdo = [{{ index = 0x6065, value = {} }}]\n{}",
        keys.esi,
        keys.encoder * 20,
        keys.device
    );
    if keys.mapped {
        let (outputs, inputs) = (list(&keys.outputs), list(&keys.inputs));
        let inputs = inputs.replace("\"0x60E4\"", "\"0x60E4:01\"");
        let _ = write!(text, "pdo.rx = [{outputs}]\npdo.tx = [{inputs}]\n");
    }
    let mut limits = format!("velocity = {velocity:?}, acceleration = {acceleration:?}");
    limits += ", torque = 100.0";
    if jerk > 0.0 {
        let _ = write!(limits, ", jerk = {jerk:?}");
    }
    if !keys.endless {
        let _ = write!(limits, ", position = [{:?}, {REACH:?}]", -REACH);
    }
    if draft.random.chance(0.5) {
        limits += ", following_error = 4.0";
    }
    let _ = write!(
        text,
        "[device.axis]\nunit = \"mm\"\nencoder = {}\nper_turn = {PER_TURN:?}\nlimits = {{ {limits} }}\n{}",
        keys.encoder,
        keys.axis.replace("NAME", &name)
    );
    let mut sim = keys.sim.clone();
    let has_quirk = sim.contains("quirks");
    let quirk = (!has_quirk && draft.random.chance(draft.quirks)).then(|| {
        let (kind, values) = draft.random.pick(&QUIRKS);
        let value = draft.random.pick(values);
        let key = kind.trim_start_matches("quirk ");
        let _ = write!(sim, "\nquirks = {{ {key} = {value} }}");
        kind
    });
    if !sim.is_empty() {
        let _ = writeln!(text, "[device.sim]\n{}", sim.trim_start());
    }
    if let Some(kind) = quirk {
        let fault = Fault::new(kind, 0.0, Effect::Open).device(position, vec![name.clone()]);
        draft.faults.push(fault);
        draft.features.push("quirk");
    }
    let counts = f64::from(keys.encoder) / PER_TURN;
    let rpm = 60.0 / PER_TURN;
    draft.machine.axes.push(Axis {
        name,
        position,
        mode: CSP,
        profile: Profile::Cia402,
        outputs: packed(&keys.outputs, 0),
        inputs: packed(&keys.inputs, 0),
        period: 1,
        enables: 1,
        shows_mode: !keys.hides_mode,
        follows_bit: true,
        goal: None,
        counts,
        velocity_scale: if keys.rpm { rpm } else { counts },
        acceleration_scale: if keys.rpm { rpm } else { 0.0 },
        velocity,
        acceleration,
        jerk: if jerk > 0.0 {
            jerk
        } else {
            acceleration / 0.05
        },
        torque: 100.0,
        range: (!keys.endless).then_some((-REACH * counts, REACH * counts)),
        loops: false,
        may_lose_power: false,
        disturbed: false,
        node: false,
        node_fails: false,
        alone: false,
    });
    draft.machine.axes.len() - 1
}

fn member(draft: &Draft, index: usize) -> Member {
    let axis = &draft.machine.axes[index];
    Member {
        index,
        name: axis.name.clone(),
        endless: axis.range.is_none(),
        plain: axis.period == 1,
        every_mode: false,
        homes: false,
        cycles_power: false,
        group: 0,
    }
}

/// Adds an axis in CSP without special objects.
fn plain(draft: &mut Draft, endless: bool) -> Member {
    let keys = match draft.random.below(3) {
        0 => Keys {
            esi: "esi/SV1.xml",
            encoder: 131_072,
            outputs: SV1_OUTPUTS.to_vec(),
            inputs: DEFAULT_INPUTS.to_vec(),
            endless,
            ..Keys::default()
        },
        of => Keys {
            esi: ["esi/EPOS4.xml", "esi/IDX.xml"][of - 1],
            encoder: draft.random.pick(&[2000, 4096, 10_000]),
            rpm: true,
            outputs: CSP_OUTPUTS.to_vec(),
            inputs: DEFAULT_INPUTS.to_vec(),
            endless,
            ..Keys::default()
        },
    };
    let index = axis(draft, &keys);
    member(draft, index)
}

/// Adds an axis that may change its mode, and may be homed: certainly with `homes`.
fn every_mode(draft: &mut Draft, homes: bool) -> Member {
    let endless = draft.random.chance(0.5);
    let mut homes = draft.random.chance(0.5) || homes;
    let mut keys = Keys {
        esi: "esi/EPOS4.xml",
        encoder: 2000,
        rpm: true,
        outputs: EVERY_MODE.to_vec(),
        inputs: MODE_INPUTS.to_vec(),
        mapped: true,
        endless,
        ..Keys::default()
    };
    if homes {
        let method = draft.random.pick(&[37, 34, 33]);
        keys.axis = format!(
            "homing = {{ method = {method}, search = 10.0, zero = 5.0, acceleration = 200.0, timeout = \"60s\" }}\n"
        );
    }
    let is_foreign = draft.random.chance(draft.foreign);
    if is_foreign {
        homes |= foreign::draw(draft, &mut keys);
    }
    let index = axis(draft, &keys);
    Member {
        every_mode: true,
        homes,
        cycles_power: keys.cycles_power,
        ..member(draft, index)
    }
}

/// Adds an axis with an encoder at its load, which is compared after homing.
fn second_encoder(draft: &mut Draft) -> Member {
    let mut inputs = MODE_INPUTS.to_vec();
    inputs.push(0x60e4);
    let keys = Keys {
        esi: "load.xml",
        encoder: 2000,
        rpm: true,
        outputs: EVERY_MODE.to_vec(),
        inputs,
        mapped: true,
        axis: "homing = { method = 37, timeout = \"10s\" }\n\
               second_encoder = { input = \"NAME.0x60E4:01\", counts_per_unit = 400.0, max_difference = 1.0 }\n"
            .to_string(),
        ..Keys::default()
    };
    let index = axis(draft, &keys);
    draft
        .files
        .push(("load.xml".to_string(), esi::with_load_position()));
    let found = Member {
        homes: true,
        ..member(draft, index)
    };
    draft.step(&format!("home = [\"{}\"]", found.name));
    found
}

/// Adds an axis with a sensor along its way.
fn probe(draft: &mut Draft) -> Member {
    let keys = Keys {
        esi: "esi/EPOS4.xml",
        encoder: 2000,
        rpm: true,
        outputs: vec![0x6040, 0x607a, 0x60b8],
        inputs: vec![0x6041, 0x6064, 0x606c, 0x60b9, 0x60ba],
        mapped: true,
        sim: "track = { probe1 = [31.25, 34.0] }".to_string(),
        ..Keys::default()
    };
    let index = axis(draft, &keys);
    member(draft, index)
}

/// Adds two axes that carry one beam. Returns the first half.
fn gantry(draft: &mut Draft) -> Member {
    let keys = Keys {
        esi: "esi/EPOS4.xml",
        encoder: 2000,
        rpm: true,
        outputs: CSP_OUTPUTS.to_vec(),
        inputs: DEFAULT_INPUTS.to_vec(),
        ..Keys::default()
    };
    let halves = [axis(draft, &keys), axis(draft, &keys)];
    let [first, second] = halves.map(|half| draft.machine.axes[half].clone());
    // Both have the lower ones of their limits.
    let velocity = first.velocity.min(second.velocity);
    let acceleration = first.acceleration.min(second.acceleration);
    for half in halves {
        let axis = &mut draft.machine.axes[half];
        (axis.velocity, axis.acceleration) = (velocity, acceleration);
        axis.jerk = first.jerk.min(second.jerk);
    }
    let _ = write!(
        draft.tables,
        "\n[[gantry]]\naxes = [\"{}\", \"{}\"]\nmax_skew = 8.0\n",
        first.name, second.name
    );
    draft.machine.gantries.push(halves);
    member(draft, halves[0])
}

/// Adds one or two drives behind a gateway.
fn gateway(draft: &mut Draft) -> Vec<Member> {
    const SYNC_NS: u64 = 4_000_000;
    // The axes step with SYNC, the others in every cycle.
    draft.machine.cycle_ns = draft.machine.cycle_ns.min(SYNC_NS / 2);
    let position = draft.place();
    let _ = write!(
        draft.devices,
        "\n[[device]]\nname = \"gateway\"\nesi = \"esi/gateway.xml\"\ntype = \"GW64\"\nposition = {position}\n\
         [device.can]\nbit_rate = 1_000_000\nsync = \"4ms\"\n"
    );
    draft.passive.push((position, "gateway".to_string()));
    draft.machine.lost_frames = draft.machine.lost_frames.max(8);
    let mut members = Vec::new();
    for node in 0..1 + draft.random.below(2) {
        let name = format!("a{}", draft.machine.axes.len());
        let at = 2 + node * 9;
        let (id, model) = (node + 1, ["EPOS 24/1", "EPOS 24/5"][node]);
        let word = |word: &str, value: &str| {
            format!(
                "{{ pdo = 1, at = {at}, objects = [\"{word}\", \"{value}\"] }}, {{ pdo = 3, at = {} }}",
                at + 6
            )
        };
        let (outputs, inputs) = (word("0x6040", "0x2062"), word("0x6041", "0x6064"));
        let _ = write!(
            draft.devices,
            "\n[[device.node]]\nid = {id}\ndrive = \"{model}\"\noutputs = [{outputs}]\ninputs = [{inputs}]\n\
             [device.node.axis]\nname = \"{name}\"\nunit = \"mm\"\nencoder = 2000\nper_turn = {PER_TURN:?}\n\
             limits = {{ position = [{:?}, {REACH:?}], velocity = 50.0, acceleration = 250.0, following_error = 2.0 }}\n",
            -REACH
        );
        let place = |object: u16, at: usize| Place { object, at };
        draft.machine.axes.push(Axis {
            name,
            position,
            mode: CSP,
            profile: Profile::Cia402,
            outputs: vec![place(0x6040, at), place(0x2062, at + 2)],
            inputs: vec![place(0x6041, at), place(0x6064, at + 2)],
            period: (SYNC_NS / draft.machine.cycle_ns).max(1) as usize,
            enables: 1,
            shows_mode: true,
            follows_bit: false,
            goal: None,
            counts: 400.0,
            velocity_scale: 12.0,
            acceleration_scale: 12.0,
            velocity: 50.0,
            acceleration: 250.0,
            jerk: 250.0 / 0.05,
            torque: 100.0,
            range: Some((-REACH * 400.0, REACH * 400.0)),
            loops: false,
            may_lose_power: false,
            disturbed: false,
            node: true,
            node_fails: false,
            alone: false,
        });
        members.push(member(draft, draft.machine.axes.len() - 1));
    }
    members
}

/// Adds a Sercos drive with two channels.
fn sercos(draft: &mut Draft) -> Vec<Member> {
    let position = draft.place();
    let _ = write!(
        draft.devices,
        "\n[[device]]\nname = \"sercos\"\nesi = \"esi/SC2.xml\"\nposition = {position}\nmode = \"csp\"\n\
         idn = [{{ idn = \"S-0-0091\", value = \"1500\" }}, {{ idn = \"S-0-0091\", drive = 1, value = \"1500\" }}]\n"
    );
    draft.passive.push((position, "sercos".to_string()));
    let mut members = Vec::new();
    for channel in 0..2 {
        let name = format!("a{}", draft.machine.axes.len());
        let _ = write!(
            draft.devices,
            "[[device.axis]]\nname = \"{name}\"\nunit = \"mm\"\nencoder = 65536\nper_turn = {PER_TURN:?}\n\
             velocity_unit = \"mrpm\"\n\
             limits = {{ position = [{:?}, {REACH:?}], velocity = 100.0, acceleration = 1000.0, following_error = 4.0 }}\n",
            -REACH
        );
        let counts = 65_536.0 / PER_TURN;
        draft.machine.axes.push(Axis {
            name,
            position,
            mode: CSP,
            profile: Profile::Sercos,
            outputs: packed(&[0x6040, 0x607a], channel * 6),
            inputs: packed(&[0x6041, 0x6064], channel * 10),
            period: 1,
            enables: 1,
            shows_mode: true,
            follows_bit: true,
            goal: None,
            counts,
            velocity_scale: 12_000.0,
            acceleration_scale: 0.0,
            velocity: 100.0,
            acceleration: 1000.0,
            jerk: 1000.0 / 0.05,
            torque: 100.0,
            range: Some((-REACH * counts, REACH * counts)),
            loops: false,
            may_lose_power: false,
            disturbed: false,
            node: false,
            node_fails: false,
            alone: false,
        });
        members.push(member(draft, draft.machine.axes.len() - 1));
    }
    members
}

/// Returns a position within a third of the range.
fn place(draft: &mut Draft) -> f64 {
    draft.random.between(-0.3, 0.3) * REACH
}

fn speed(draft: &mut Draft) -> String {
    match draft.random.below(3) {
        0 => String::new(),
        _ => format!("\nspeed = {:.2}", draft.random.between(0.2, 1.0)),
    }
}

/// Picks two different axes of which the first fits.
fn two(draft: &mut Draft, from: &[Member], fits: impl Fn(&Member) -> bool) -> Option<[Member; 2]> {
    let first: Vec<Member> = from.iter().filter(|of| fits(of)).cloned().collect();
    if first.is_empty() || from.len() < 2 {
        return None;
    }
    let first = draft.random.pick(&first);
    let rest: Vec<Member> = from
        .iter()
        .filter(|of| of.index != first.index && of.group == first.group)
        .cloned()
        .collect();
    (!rest.is_empty()).then(|| [first, draft.random.pick(&rest)])
}

/// Returns the largest ratio at which an axis follows another one with half of its limits.
fn ratio(draft: &Draft, follower: &Member, master: &Member) -> f64 {
    let [one, other] = [follower, master].map(|of| &draft.machine.axes[of.index]);
    let ratio = (one.velocity / other.velocity).min(one.acceleration / other.acceleration);
    (ratio * 0.5).min(0.7)
}

/// Adds the steps of a feature; false if the machine does not permit them.
fn steps(draft: &mut Draft, feature: &str, pool: &[Member]) -> bool {
    let plain: Vec<Member> = pool.iter().filter(|of| of.plain).cloned().collect();
    match feature {
        "line" => {
            let Some([one, other]) = two(draft, pool, |_| true) else {
                return false;
            };
            let (to, and) = (place(draft), place(draft));
            let speed = speed(draft);
            let (one, other) = (one.name, other.name);
            draft.step(&format!(
                "line = {{ {one} = {to:.3}, {other} = {and:.3} }}{speed}"
            ));
        }
        "gear" => {
            let Some([follower, master]) = two(draft, &plain, |_| true) else {
                return false;
            };
            let sign = draft.random.pick(&[1.0, -1.0]);
            let ratio = ratio(draft, &follower, &master) * draft.random.between(0.2, 1.0) * sign;
            let extra = draft
                .random
                .pick(&["", "", ", actual = true", ", smoothing = \"5ms\""]);
            let (follower, master) = (follower.name, master.name);
            draft.step(&format!(
                "gear = {{ {follower} = {{ to = \"{master}\", ratio = {ratio:.4}{extra} }} }}"
            ));
            let (to, speed) = (place(draft), speed(draft));
            draft.step(&format!("move = {{ {master} = {to:.3} }}{speed}"));
            if draft.random.chance(0.3) {
                draft.step(&format!("phase = {{ {follower} = 2.0 }}"));
            }
            draft.step(&format!("stop = [\"{follower}\"]"));
        }
        "cam" => {
            let Some([follower, master]) = two(draft, &plain, |_| true) else {
                return false;
            };
            let [one, other] = [&follower, &master].map(|of| draft.machine.axes[of.index].clone());
            // poly5 has the slope 1.875 and the curvature 5.78 of its rise.
            let way: f64 = 40.0;
            let steep = 0.3 * one.velocity / (1.875 * other.velocity) * way;
            let curved = 0.2 * one.acceleration / (5.78 * other.velocity.powi(2)) * way * way;
            let slope = 0.2 * one.acceleration / (1.875 * other.acceleration) * way;
            let rise = steep.min(curved).min(slope).min(20.0);
            let name = format!("cam{}", draft.files.len() + draft.tables.len());
            let _ = write!(
                draft.tables,
                "\n[[cam]]\nname = \"{name}\"\nrepeat = true\n\
                 points = [[0.0, 0.0], [{way:?}, {rise:.3}], [{:?}, 0.0]]\n",
                2.0 * way
            );
            let (follower, master) = (follower.name, master.name);
            draft.step(&format!(
                "gear = {{ {follower} = {{ to = \"{master}\", cam = \"{name}\" }} }}"
            ));
            let (to, speed) = (place(draft), speed(draft));
            draft.step(&format!("move = {{ {master} = {to:.3} }}{speed}"));
            draft.step(&format!("stop = [\"{follower}\"]"));
        }
        "superimpose" => {
            let endless: Vec<Member> = plain.iter().filter(|of| of.endless).cloned().collect();
            let Some(axis) = (!endless.is_empty()).then(|| draft.random.pick(&endless)) else {
                return false;
            };
            let velocity =
                draft.machine.axes[axis.index].velocity * draft.random.between(-0.4, 0.4);
            let name = axis.name;
            draft.step(&format!("velocity = {{ {name} = {velocity:.3} }}"));
            draft.step(&format!("superimpose = {{ {name} = 5.0 }}"));
            draft.step(&format!("stop = [\"{name}\"]"));
        }
        "velocity" => {
            let endless: Vec<Member> = pool.iter().filter(|of| of.endless).cloned().collect();
            let Some(axis) = (!endless.is_empty()).then(|| draft.random.pick(&endless)) else {
                return false;
            };
            let velocity =
                draft.machine.axes[axis.index].velocity * draft.random.between(-0.9, 0.9);
            draft.step(&format!("velocity = {{ {} = {velocity:.3} }}", axis.name));
            draft.step("dwell = \"150ms\"");
            draft.step(&format!("stop = [\"{}\"]", axis.name));
        }
        "path" => {
            let Some([one, other]) = two(draft, &plain, |_| true) else {
                return false;
            };
            let name = format!("path{}", draft.tables.len());
            let points: Vec<String> = (0..4)
                .map(|_| format!("[{:.2}, {:.2}]", place(draft), place(draft)))
                .collect();
            let _ = write!(
                draft.tables,
                "\n[[path]]\nname = \"{name}\"\naxes = [\"{}\", \"{}\"]\ntolerance = 0.5\npoints = [{}]\n",
                one.name,
                other.name,
                points.join(", ")
            );
            draft.step(&format!("path = \"{name}\""));
        }
        "table" => {
            let axis = draft.random.pick(pool);
            let file = format!("t{}.csv", draft.files.len());
            let mut rows = String::from("0.000, 0.00000\n");
            for row in 1..5 {
                let at = draft.random.between(-3.0, 3.0);
                let _ = writeln!(rows, "{:.3}, {at:.5}", f64::from(row) * 0.4);
            }
            draft.files.push((file.clone(), rows));
            draft.step(&format!(
                "table = {{ {} = \"{file}\" }}\nspeed = 0.5",
                axis.name
            ));
        }
        "sine" => {
            let Some(axis) = (!plain.is_empty()).then(|| draft.random.pick(&plain)) else {
                return false;
            };
            let of = &draft.machine.axes[axis.index];
            let omega = std::f64::consts::TAU * 2.0;
            let most = (of.velocity / omega)
                .min(of.acceleration / omega.powi(2))
                .min(of.jerk / omega.powi(3));
            let amplitude = (0.4 * most).min(10.0);
            draft.step(&format!(
                "sine = {{ {} = {{ amplitude = {amplitude:.4}, frequency = 2.0, periods = 2 }} }}",
                axis.name
            ));
        }
        "profile modes" => {
            let multi: Vec<Member> = pool.iter().filter(|of| of.every_mode).cloned().collect();
            let Some(axis) = (!multi.is_empty()).then(|| draft.random.pick(&multi)) else {
                return false;
            };
            let name = &axis.name;
            if axis.homes && draft.random.chance(0.5) {
                draft.step(&format!("home = [\"{name}\"]"));
            }
            if axis.endless && draft.random.chance(0.5) {
                let velocity = draft.machine.axes[axis.index].velocity * 0.6;
                draft.step(&format!("mode = {{ {name} = \"pv\" }}"));
                draft.step(&format!("velocity = {{ {name} = {velocity:.2} }}"));
                draft.step(&format!("stop = [\"{name}\"]"));
            } else {
                draft.step(&format!("mode = {{ {name} = \"pp\" }}"));
                let (to, speed) = (place(draft), speed(draft));
                draft.step(&format!("move = {{ {name} = {to:.3} }}{speed}"));
            }
            draft.step(&format!("mode = {{ {name} = \"csp\" }}"));
        }
        _ => return false,
    }
    true
}

/// The step of a probe: its sensor is between 31.25 and 34 mm.
fn probe_steps(draft: &mut Draft, axis: &Member) {
    let name = &axis.name;
    draft.step(&format!("move = {{ {name} = 25.0 }}"));
    draft.step(&format!(
        "probe = {{ {name} = {{ to = 50.0 }} }}\nspeed = 0.3"
    ));
    draft.step(&format!("move_by = {{ {name} = -15.0 }}"));
}

/// Adds outputs that are on where an axis is.
fn position_outputs(draft: &mut Draft, io: u16, axis: &Member) {
    let terminal = draft.machine.terminals.iter().position(|of| *of == io);
    let counts = draft.machine.axes[axis.index].counts;
    for bit in 0..1 + draft.random.below(2) {
        let low = place(draft);
        let high = low + draft.random.between(5.0, 30.0);
        let lead_ms = draft.random.pick(&[0, 0, 3]);
        let _ = write!(
            draft.tables,
            "\n[[position_output]]\noutput = \"{}.Output {}\"\naxis = \"{}\"\nranges = [[{low:.3}, {high:.3}]]\nlead = \"{lead_ms}ms\"\n",
            draft.name(io),
            bit + 1,
            axis.name,
        );
        draft.machine.switches.push(Switch {
            terminal: terminal.expect("a terminal"),
            bit: bit as u8,
            axis: axis.index,
            ranges: vec![[low * counts, high * counts]],
            lead_s: lead_ms as f64 * 1e-3,
            homes: axis.homes,
        });
    }
}

/// Presses an input of the terminal that holds the machine.
fn hold(draft: &mut Draft, io: u16) {
    let name = draft.name(io);
    let terminal = draft.machine.terminals.iter().position(|of| *of == io);
    let at = draft.random.between(0.3, 3.0);
    let lasts = draft.random.pick(&[0.05, 0.3, 1.0, 3.0]);
    let _ = write!(
        draft.tables,
        "\n[override]\nhold = {{ {name}.\"Input 7\" = true }}\n\
         \n[sim]\ninputs = [{{ at = \"{:.0}ms\", for = \"{:.0}ms\", set = {{ {name}.\"Input 7\" = true }} }}]\n",
        at * 1e3,
        lasts * 1e3
    );
    draft.machine.hold = terminal.map(|terminal| (terminal, 6));
}

fn group(draft: &mut Draft, pool: &mut [Member]) {
    let gantries = draft.machine.gantries.concat();
    let free = |of: &Member| of.plain && !gantries.contains(&of.index);
    let sercos = |axis: &Axis| axis.profile == Profile::Sercos;
    let chosen: Vec<usize> = pool
        .iter()
        .enumerate()
        .filter(|(_, of)| free(of) && !sercos(&draft.machine.axes[of.index]))
        .map(|(at, _)| at)
        .take(1 + draft.random.below(2))
        .collect();
    if chosen.is_empty() || chosen.len() == pool.len() {
        return;
    }
    let alone = draft.random.chance(0.6);
    let names: Vec<String> = chosen
        .iter()
        .map(|at| format!("\"{}\"", pool[*at].name))
        .collect();
    let _ = write!(
        draft.stop,
        "\n[[stop.group]]\nname = \"g\"\naxes = [{}]\noutside = \"{}\"\n",
        names.join(", "),
        if alone { "continue" } else { "stop" }
    );
    for at in chosen {
        pool[at].group = 1;
        draft.machine.axes[pool[at].index].alone = alone;
    }
}

/// Adds one of the faults that the other scenes have, or one of a node behind a gateway.
fn any_fault(draft: &mut Draft, at: f64) -> Fault {
    let gateway = draft.passive.iter().find(|of| of.1 == "gateway").cloned();
    if let Some((position, _)) = gateway
        && draft.random.chance(0.4)
    {
        let kind = draft.random.pick(&[
            "node-silent",
            "heartbeat-lost",
            "node-error",
            "can-open",
            "gateway-reset",
            "control-ignored",
        ]);
        let fault = draft.strike(kind, at, position, Effect::Open).lasting(0.5);
        return match kind {
            "node-silent" | "heartbeat-lost" | "node-error" => fault.key("node", 1),
            _ => fault,
        };
    }
    let mut fault = random_fault(draft, at);
    // Two faults may merge, and the drive may be without power in between.
    if fault.effect == Effect::Failure || fault.kind == "frame-loss" {
        fault.effect = Effect::Open;
    }
    fault
}

/// Draws a machine whose program has this feature.
fn with(draft: &mut Draft, wanted: &'static str) {
    draft.quirks = if wanted == "quirk" { 0.6 } else { 0.07 };
    draft.foreign = if wanted == "foreign drive" { 1.0 } else { 0.2 };
    let chosen = |draft: &mut Draft, feature: &str, chance: f64| {
        wanted == feature || draft.random.chance(chance)
    };
    let mut features = vec![wanted];
    let mut pool = Vec::new();
    let endless = matches!(wanted, "superimpose" | "velocity");
    for axis in 0..1 + draft.random.below(3) {
        let endless = endless && axis == 0 || draft.random.chance(0.4);
        pool.push(plain(draft, endless));
    }
    if matches!(wanted, "line" | "gear" | "cam" | "path") && pool.len() < 2 {
        pool.push(plain(draft, false));
    }
    let mut note = |feature: &'static str| {
        if feature != wanted {
            features.push(feature);
        }
    };
    if chosen(draft, "gantry", 0.2) {
        note("gantry");
        pool.push(gantry(draft));
    }
    let is_foreign = wanted == "foreign drive";
    if chosen(draft, "profile modes", 0.25) || is_foreign {
        note("profile modes");
        pool.push(every_mode(draft, false));
    }
    if chosen(draft, "gateway axis", 0.15) {
        note("gateway axis");
        pool.extend(gateway(draft));
    }
    if chosen(draft, "Sercos", 0.15) {
        note("Sercos");
        pool.extend(sercos(draft));
    }
    let encoder = chosen(draft, "second encoder", 0.15);
    if encoder {
        note("second encoder");
        pool.push(second_encoder(draft));
    }
    let sensor = chosen(draft, "probe", 0.15).then(|| probe(draft));
    if let Some(sensor) = &sensor {
        note("probe");
        pool.push(sensor.clone());
    }
    let outputs = chosen(draft, "position output", 0.25);
    let holds = chosen(draft, "hold", 0.15);
    if outputs || holds || draft.random.chance(0.3) {
        let io = draft.io();
        if outputs {
            note("position output");
            let plain: Vec<Member> = pool
                .iter()
                .filter(|of| of.plain && !of.homes)
                .cloned()
                .collect();
            let mut axis = draft.random.pick(&plain);
            if wanted == "position output" && draft.random.chance(0.4) {
                note("profile modes");
                axis = every_mode(draft, true);
                pool.push(axis.clone());
                draft.step(&format!("home = [\"{}\"]", axis.name));
            }
            position_outputs(draft, io, &axis);
        }
        if holds {
            note("hold");
            hold(draft, io);
        }
    }
    if draft.random.chance(0.3) {
        group(draft, &mut pool);
    }
    // The wanted feature comes first, so that a fault finds it in motion.
    let motions = &FEATURES[..8];
    if let Some(sensor) = &sensor {
        probe_steps(draft, sensor);
    }
    let first = if is_foreign { "profile modes" } else { wanted };
    steps(draft, first, &pool);
    for _ in 0..2 + draft.random.below(4) {
        let feature = if draft.random.chance(0.3) {
            "profile modes"
        } else {
            draft.random.pick(motions)
        };
        if steps(draft, feature, &pool) {
            note(feature);
        }
        if draft.random.chance(0.1) {
            let percent = draft.random.pick(&[30, 60, 100, 120]);
            draft.step(&format!("override = {percent}"));
        }
    }
    // Every axis ends at a known place.
    let mut goals = Vec::new();
    for member in &pool {
        let to = (place(draft) * 100.0).round() / 100.0;
        goals.push(format!("{} = {to:?}", member.name));
        draft.machine.axes[member.index].goal = Some(to);
    }
    let speed = speed(draft);
    draft.step(&format!("move = {{ {} }}{speed}", goals.join(", ")));
    draft.features.extend(features);
    draft.features.sort_unstable();
    draft.features.dedup();
    ending(draft);
    for member in pool.iter().filter(|of| of.cycles_power) {
        let count = |step: String| draft.steps.matches(&step).count();
        let homings = count(format!("home = [\"{}\"]", member.name));
        // A homing that is held ends, and begins again after the hold.
        let held = usize::from(draft.machine.hold.is_some() && homings > 0);
        let switches = count(format!("mode = {{ {} = ", member.name)) + 2 * (homings + held);
        let enables = if draft.once { 1 + switches } else { usize::MAX };
        draft.machine.axes[member.index].enables = enables;
    }
    if !draft.once {
        draft
            .machine
            .axes
            .iter_mut()
            .for_each(|axis| axis.goal = None);
    }
}

/// Adds the time limit, and the faults.
fn ending(draft: &mut Draft) {
    draft.once = draft.random.chance(0.5);
    draft.ends_at = draft.random.between(1.0, 12.0);
    let until = draft.ends_at.min(6.0) + 0.5;
    let count = draft.random.pick(&[0, 1, 2, 2, 2, 2]);
    for _ in 0..count {
        let at = draft.random.between(0.25, until);
        let fault = any_fault(draft, at);
        draft.fault(fault);
    }
}

/// Axes in gear with a master on another machine, whose messages get lost or end.
pub fn line_shaft(draft: &mut Draft) {
    draft.features = vec!["line shaft"];
    draft.machine.cycle_ns = draft.machine.cycle_ns.max(1_000_000);
    let ends = draft.random.between(3.5, 9.0);
    draft.tables = "\n[[line_shaft]]\nname = \"shaft\"\nunit = \"mm\"\nvelocity = 60.0\nacceleration = 400.0\ntimeout = \"100ms\"\n".to_string();
    let mut gears = Vec::new();
    for _ in 0..1 + draft.random.below(3) {
        let follower = plain(draft, true);
        let of = draft.machine.axes[follower.index].clone();
        let most = (of.velocity / 61.0).min(of.acceleration / 410.0).min(1.0);
        let ratio = most * draft.random.between(0.3, 0.95) * draft.random.pick(&[1.0, -1.0]);
        gears.push((follower.name, ratio));
    }
    // Common time needs pairs of at least 1 s.
    draft.step("dwell = \"2500ms\"");
    for (name, ratio) in gears {
        draft.step(&format!(
            "gear = {{ {name} = {{ to = \"shaft\", ratio = {ratio:.4} }} }}"
        ));
    }
    draft.step("dwell = \"60s\"");
    draft.ends_at = ends;
    draft.shaft = Some(Feed {
        velocity: draft.random.between(20.0, 50.0),
        acceleration: draft.random.between(50.0, 180.0),
        begin_s: draft.random.between(3.0, 4.5),
        rest_s: draft.random.between(5.0, 8.0),
        loss: draft.random.pick(&[0.0, 0.05, 0.3]),
        end_s: draft
            .random
            .chance(0.3)
            .then(|| draft.random.between(3.2, 8.0)),
    });
    draft.may_fail = draft.shaft.is_some_and(|feed| feed.end_s.is_some());
    for _ in 0..draft.random.pick(&[0, 1, 2, 2]) {
        let at = draft.random.between(0.5, ends + 0.5);
        let fault = any_fault(draft, at);
        draft.fault(fault);
    }
}

macro_rules! scene {
    ($function:ident, $feature:expr) => {
        pub fn $function(draft: &mut Draft) {
            with(draft, $feature);
        }
    };
}

scene!(line, "line");
scene!(gear, "gear");
scene!(cam, "cam");
scene!(superimpose, "superimpose");
scene!(path, "path");
scene!(table, "table");
scene!(gantries, "gantry");
scene!(position_output, "position output");
scene!(encoder, "second encoder");
scene!(touch_probe, "probe");
scene!(profile_modes, "profile modes");
scene!(gateway_axis, "gateway axis");
scene!(sercos_axes, "Sercos");
scene!(held, "hold");
scene!(quirks, "quirk");
scene!(foreign_drives, "foreign drive");
