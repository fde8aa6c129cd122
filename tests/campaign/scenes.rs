//! Situations in which a stop, a mode change or a fault is critical. Each scene generates a
//! machine, a program and faults; times, sizes and phases are random.

use super::faults::{Effect, Fault, Moment};
use super::features;
use super::generate::{Draft, Wanted, mode_name};
use super::view::{CSP, CST, CSV, PP, PV};

/// A name and its generator.
pub type Scene = (&'static str, fn(&mut Draft));

/// All scenes. Mode changes appear most often, because they have the most phases.
pub const SCENES: [Scene; 33] = [
    ("anything", anything),
    ("two-faults", two_faults),
    ("device-missing", device_missing),
    ("jerk", jerk),
    ("gentle-ramp", gentle_ramp),
    ("slow-quick-stop", slow_quick_stop),
    ("mode-changes", mode_changes),
    ("mode-changes", mode_changes),
    ("late-replies", late_replies),
    ("fault-while-stopping", fault_while_stopping),
    ("fault-at-the-end", fault_at_the_end),
    ("short-break", short_break),
    ("other-mode", other_mode),
    ("groups", groups),
    ("emergency", emergency),
    ("no-fault", no_fault),
    ("line", features::line),
    ("gear", features::gear),
    ("cam", features::cam),
    ("superimpose", features::superimpose),
    ("path", features::path),
    ("table", features::table),
    ("gantry", features::gantries),
    ("position-output", features::position_output),
    ("second-encoder", features::encoder),
    ("probe", features::touch_probe),
    ("profile-modes", features::profile_modes),
    ("gateway-axis", features::gateway_axis),
    ("sercos", features::sercos_axes),
    ("hold", features::held),
    ("line-shaft", features::line_shaft),
    ("quirks", features::quirks),
    ("foreign-drives", features::foreign_drives),
];

/// An upper bound of the time from the first frame to motion: bring-up and enabling.
const MOVES_BY_S: f64 = 0.6;

/// Adds drives and I/O devices in any order, with at least one drive.
fn devices(draft: &mut Draft, wanted: Wanted) {
    let drives = draft.random.pick(&[1, 1, 2, 2, 3]);
    let others = draft.random.pick(&[0, 0, 1, 2]);
    let first_io = draft.random.below(drives + 1);
    for drive in 0..drives {
        if drive == first_io {
            (0..others).for_each(|_| _ = draft.io());
        }
        draft.drive(wanted);
    }
    if first_io == drives {
        (0..others).for_each(|_| _ = draft.io());
    }
}

/// Adds a program of moves, turns and mode changes that succeeds without faults.
fn program(draft: &mut Draft) {
    let axes = draft.machine.axes.clone();
    for _ in 0..2 + draft.random.below(3) {
        let axis = draft.random.pick(&axes);
        let name = &axis.name;
        let share = draft.random.between(0.3, 0.9);
        match draft.random.below(4) {
            0 if axis.mode == CSP || axis.loops && axis.mode == CSV => {
                let goal = axis.velocity * draft.random.between(-0.5, 0.5);
                draft.step(&format!(
                    "move = {{ {name} = {goal:.3} }}\nspeed = {share:.2}"
                ));
            }
            1 if axis.loops => {
                let mode = draft.random.pick(&[CSV, CSP, PV]);
                if mode != axis.mode {
                    draft.step(&format!("mode = {{ {name} = \"{}\" }}", mode_name(mode)));
                    draft.step("dwell = \"20ms\"");
                    let back = mode_name(axis.mode);
                    draft.step(&format!("mode = {{ {name} = \"{back}\" }}"));
                }
            }
            2 if axis.range.is_none() && axis.mode != CST => {
                let velocity = axis.velocity * share;
                draft.step(&format!("velocity = {{ {name} = {velocity:.3} }}"));
                draft.step("dwell = \"100ms\"");
                draft.step(&format!("stop = [\"{name}\"]"));
            }
            _ => draft.step("dwell = \"50ms\""),
        }
    }
    draft.turn(0.7);
}

pub fn random_fault(draft: &mut Draft, at: f64) -> Fault {
    let devices = draft.devices() as u16;
    let random = &mut draft.random;
    let any = random.below(usize::from(devices)) as u16;
    let drives: Vec<u16> = draft
        .machine
        .axes
        .iter()
        .map(|axis| axis.position)
        .collect();
    let drive = random.pick(&drives);
    let cycle = draft.machine.seconds();
    let lost = draft.machine.lost_frames;
    let open = Effect::Open;
    match random.below(20) {
        0 => {
            let count = random.pick(&[1, 2, lost - 1, lost, lost + 1, 60]);
            Fault::new(
                "frame-loss",
                at,
                if count < lost { Effect::None } else { open },
            )
            .key("count", count)
        }
        1 => Fault::new("frame-loss", at, open)
            .key("probability", random.pick(&[0.05, 0.3, 0.8]))
            .lasting(random.between(0.01, 0.2)),
        2 => Fault::new("frame-duplicate", at, Effect::None).key("count", random.pick(&[1, 5, 60])),
        3 => {
            let delay = random.pick(&[0.3, 0.9, 1.2, 2.5, 7.0]) * cycle * 1e6;
            let count = random.pick(&[1, 2, 10, 60]);
            Fault::new("frame-delay", at, open)
                .key("count", count)
                .key("delay", format!("\"{delay:.0}us\""))
        }
        4 => Fault::new("frame-corrupt", at, open).key("count", random.pick(&[1, 3, 30])),
        5 => {
            let lasts = random.pick(&[0.5 * cycle, 3.0 * cycle, 0.1, 10.0]);
            draft
                .strike("link-break", at, any, open)
                .key("port", 0)
                .lasting(lasts)
        }
        6 => Fault::new("silent", at, open).lasting(random.pick(&[0.002, 0.02, 0.3, 10.0])),
        7 => draft.strike("power-off", at, any, Effect::Failure),
        8 => draft.strike("absent", at, any, open).lasting(0.05),
        9 => draft.strike("watchdog", at, drive, Effect::Failure),
        10 | 11 => {
            let code = random.pick(&["0x8611", "0x3220", "0x2310", "0x7305"]);
            draft
                .strike("drive-fault", at, drive, Effect::Failure)
                .key("code", code)
        }
        12 => {
            let count = random.pick(&[1, 5, 30]);
            let fault = Fault::new("other-main-device", at, open).key("count", count);
            if random.chance(0.5) {
                fault.key(
                    "state",
                    random.pick(&["\"safeop\"", "\"preop\"", "\"init\""]),
                )
            } else {
                fault
            }
        }
        13 => draft
            .strike("emergency", at, drive, Effect::None)
            .key("code", "0x5000"),
        14 => draft.strike("sto", at, drive, open).lasting(0.1),
        15 => {
            let count = random.pick(&[1, 3, 8, 40]);
            draft
                .strike("zero-inputs", at, drive, open)
                .key("count", count)
        }
        16 => {
            let counts = random.pick(&["3", "400", "-90000"]);
            draft
                .strike("position-shift", at, drive, open)
                .key("value", counts)
        }
        17 => {
            let lasts = random.pick(&[0.02, 2.0]);
            draft.strike("blocked", at, drive, open).lasting(lasts)
        }
        _ => {
            let torque = random.pick(&[0.01, 0.05, -0.05]);
            draft
                .strike("load", at, drive, open)
                .key("torque", torque)
                .lasting(0.5)
        }
    }
}

fn anything(draft: &mut Draft) {
    devices(draft, Wanted::default());
    program(draft);
    draft.ends_at = draft.random.between(0.3, 3.0);
    for _ in 0..1 + draft.random.below(2) {
        let at = draft.random.between(MOVES_BY_S, draft.ends_at + 0.8);
        let fault = random_fault(draft, at);
        draft.fault(fault);
    }
}

/// Adds a second fault within 50 ms of the first.
fn two_faults(draft: &mut Draft) {
    devices(
        draft,
        Wanted {
            endless: true,
            ..Wanted::default()
        },
    );
    draft.turn(0.9);
    draft.ends_at = 2.5;
    let at = draft.random.between(1.2, 2.0);
    for after in [0.0, draft.random.between(0.0, 0.05)] {
        let mut fault = random_fault(draft, at + after);
        if fault.kind == "frame-loss" {
            // Two bursts may merge into one that is too long.
            fault.effect = Effect::Open;
        }
        draft.fault(fault);
    }
}

/// A device disappears while an axis with a long stop turns.
fn device_missing(draft: &mut Draft) {
    let mode = draft.random.pick(&[CSP, CSV, CSV]);
    let ramp_s = draft.random.pick(&[0.3, 1.0, 2.2]);
    let quick_stop = draft.random.pick(&[None, Some(500), Some(5000)]);
    let wanted = Wanted {
        mode: Some(mode),
        ramp_s: Some(ramp_s),
        jerk_s: Some(0.0),
        quick_stop,
        endless: true,
        ..Wanted::default()
    };
    draft.drive(wanted);
    let missing = if draft.random.chance(0.5) {
        draft.io()
    } else {
        draft.drive(wanted);
        1
    };
    draft.turn(0.9);
    draft.ends_at = MOVES_BY_S + 2.0 * ramp_s + 1.0;
    let at = MOVES_BY_S + draft.random.between(0.5, 2.0) * ramp_s + 0.3;
    let kind = draft.random.pick(&["absent", "power-off", "link-break"]);
    let fault = draft.strike(kind, at, missing, Effect::Failure);
    let fault = if kind == "link-break" {
        fault.key("port", 0)
    } else {
        fault
    };
    draft.fault(fault);
}

/// A jerk limit that takes as long as the ramp, and a stop during acceleration.
fn jerk(draft: &mut Draft) {
    let ramp_s = draft.random.pick(&[0.3, 0.5, 1.0]);
    let jerk_s = draft.random.pick(&[0.2, 0.5, 2.0]);
    let wanted = Wanted {
        mode: Some(CSP),
        ramp_s: Some(ramp_s),
        jerk_s: Some(jerk_s),
        endless: true,
        ..Wanted::default()
    };
    let mover = draft.drive(wanted);
    let axis = draft.machine.axes[mover].clone();
    let goal = axis.velocity * 20.0;
    draft.ends_at = draft.random.between(0.2, 1.5) * (ramp_s + jerk_s);
    if draft.random.chance(0.5) {
        draft.drive(Wanted {
            mode: Some(CSP),
            endless: true,
            ..Wanted::default()
        });
        let at = MOVES_BY_S + draft.ends_at;
        let fault = draft.strike("drive-fault", at, 1, Effect::Failure);
        draft.fault(fault.key("code", "0x3220"));
        draft.ends_at += 1.5;
    }
    draft.step(&format!("move = {{ {} = {goal:?} }}", axis.name));
}

/// The run ends in a jerk-limited move with a long ramp.
fn gentle_ramp(draft: &mut Draft) {
    let jerk_s = draft.random.pick(&[0.05, 0.2]);
    let wanted = Wanted {
        mode: Some(CSP),
        ramp_s: Some(0.1),
        jerk_s: Some(jerk_s),
        endless: true,
        ..Wanted::default()
    };
    let mover = draft.drive(wanted);
    let axis = draft.machine.axes[mover].clone();
    let goal = axis.velocity * 20.0;
    let ramp = draft.random.pick(&[0.02, 0.05, 0.1]);
    draft.step(&format!(
        "move = {{ {} = {goal:?} }}\nramp = {ramp:?}",
        axis.name
    ));
    draft.ends_at = draft.random.between(0.3, 1.5) * 0.1 / ramp;
}

/// A drive with a quick stop of several seconds, caused by another drive's fault or by its own
/// following error.
fn slow_quick_stop(draft: &mut Draft) {
    let quick_stop = draft.random.pick(&[200, 500, 1000]);
    let wanted = Wanted {
        quick_stop: Some(quick_stop),
        endless: true,
        ..Wanted::default()
    };
    let slow = draft.drive(wanted);
    draft.stop = "others = \"quick-stop\"\n".to_string();
    let other = draft.drive(wanted);
    draft.turn(0.9);
    draft.ends_at = 1.5;
    let at = draft.random.between(MOVES_BY_S, 1.4);
    let device = draft.machine.axes[draft.random.pick(&[slow, other])].position;
    let fault = draft.strike("drive-fault", at, device, Effect::Failure);
    draft.fault(fault.key("code", "0x3220"));
}

/// A mode change and the change back, in motion if both modes allow it. Bursts of lost frames,
/// shorter than `lost_frames`, occur at every phase.
fn mode_changes(draft: &mut Draft) {
    draft.machine.lost_frames = 10;
    let modes = [
        (CSV, CSP),
        (CSV, CSP),
        (CSV, CSP),
        (CSP, CSV),
        (CSP, PV),
        (CSV, PV),
        (CSP, PP),
        (CSV, PP),
        (CSP, CST),
    ];
    let (from, to) = draft.random.pick(&modes);
    let wanted = Wanted {
        mode: Some(from),
        every_mode: true,
        ramp_s: Some(draft.random.pick(&[0.1, 0.2])),
        endless: true,
        ..Wanted::default()
    };
    let index = draft.drive(wanted);
    let axis = draft.machine.axes[index].clone();
    let name = &axis.name;
    // PP is entered at rest, and in CST without a torque the axis coasts.
    if !matches!(to, PP | CST) {
        let velocity = axis.velocity * draft.random.between(0.5, 0.9);
        draft.step(&format!("velocity = {{ {name} = {velocity:.3} }}"));
    }
    for mode in [to, from] {
        draft.step(&format!("mode = {{ {name} = \"{}\" }}", mode_name(mode)));
        draft.step("dwell = \"100ms\"");
    }
    draft.step("dwell = \"60s\"");
    draft.ends_at = 0.8;
    let cycle = draft.seconds();
    // Only one change, because bursts shift later changes. The second burst occurs while the axis
    // still recovers from the first.
    let change = if to == CSP {
        0
    } else {
        draft.random.pick(&[0, 1, 1])
    };
    let close = draft.random.chance(0.5);
    let phases = if close { 6 } else { 16 };
    let mut after = draft.random.below(phases) as f64 - 3.0;
    for _ in 0..2 {
        let count = draft
            .random
            .pick(if close { &[3, 3, 4, 5] } else { &[1, 2, 3, 5] });
        let mut fault = Fault::new("frame-loss", after * cycle, Effect::None);
        fault.after = Some(Moment::ModeChange(change));
        draft.fault(fault.key("count", count));
        after += f64::from(
            count
                + draft
                    .random
                    .pick(if close { &[1, 2, 3] } else { &[1, 4, 8] }),
        );
    }
}

/// Replies that arrive after the cycle has stopped waiting, or twice.
fn late_replies(draft: &mut Draft) {
    draft.machine.lost_frames = 20;
    draft.machine.pipelined = false;
    let wanted = Wanted {
        mode: Some(CSP),
        endless: true,
        ..Wanted::default()
    };
    devices(draft, wanted);
    draft.turn(0.9);
    draft.ends_at = 1.5;
    let cycle = draft.seconds();
    let count = draft.random.pick(&[1, 3, 5, 10, 15]);
    let delay = draft.random.pick(&[0.8, 0.9, 0.95]) * cycle * 1e6;
    let at = draft.random.between(0.9, 1.5);
    let fault = Fault::new("frame-delay", at, Effect::None)
        .key("probability", 1.0)
        .key("delay", format!("\"{delay:.0}us\""))
        .lasting(f64::from(count) * cycle);
    draft.fault(fault);
    if draft.random.chance(0.5) {
        let at = at - 0.1;
        draft.fault(Fault::new("frame-duplicate", at, Effect::None).key("count", 30));
    }
}

/// A fault during the stop at the end of the run.
fn fault_while_stopping(draft: &mut Draft) {
    let ramp_s = draft.random.pick(&[0.8, 1.2]);
    let wanted = Wanted {
        ramp_s: Some(ramp_s),
        jerk_s: Some(draft.random.pick(&[0.0, 0.1])),
        endless: true,
        ..Wanted::default()
    };
    draft.drive(wanted);
    match draft.random.below(3) {
        0 => _ = draft.io(),
        1 => _ = draft.drive(wanted),
        _ => {}
    }
    draft.turn(0.9);
    let others = draft.devices() as f64;
    draft.ends_at = 2.2 * ramp_s * others;
    let stop = draft.ends_at + 0.35;
    let at = stop + draft.random.between(0.0, 0.5) * ramp_s;
    let lost = draft.machine.lost_frames;
    let device = draft.random.below(draft.devices()) as u16;
    let cycle = draft.seconds();
    let fault = match draft.random.below(5) {
        0 => Fault::new("frame-loss", at, Effect::Open).key("count", 3 * lost + 20),
        1 => draft.strike("power-off", at, device, Effect::Open),
        2 => draft
            .strike("link-break", at, device, Effect::Open)
            .key("port", 0),
        3 => Fault::new("silent", at, Effect::Open).lasting(cycle * (lost as f64 + 20.0)),
        _ => draft
            .strike("drive-fault", at, 0, Effect::Open)
            .key("code", "0x3220"),
    };
    draft.fault(fault);
}

/// A bus that fails at the end of the run, so that both events nearly coincide.
fn fault_at_the_end(draft: &mut Draft) {
    draft.drive(Wanted::default());
    draft.turn(0.3);
    draft.ends_at = 0.9;
    let cycle = draft.seconds();
    let cycles = draft.machine.lost_frames as f64 + draft.random.between(-6.0, 6.0);
    let mut fault = Fault::new("silent", -cycles * cycle, Effect::Open).lasting(0.3);
    fault.after = Some(Moment::Stop);
    draft.fault(fault);
}

/// A link break for fewer cycles than `lost_frames`.
fn short_break(draft: &mut Draft) {
    draft.machine.lost_frames = 20;
    devices(
        draft,
        Wanted {
            endless: true,
            ..Wanted::default()
        },
    );
    draft.turn(0.8);
    draft.ends_at = 1.5;
    let device = draft.random.below(draft.devices()) as u16;
    let cycle = draft.seconds();
    let lasts = draft.random.pick(&[1.0, 2.0, 4.0, 8.0]) * cycle;
    let at = draft.random.between(0.9, 1.5);
    let fault = draft.strike("link-break", at, device, Effect::None);
    draft.fault(fault.key("port", 0).lasting(lasts));
}

/// A drive that displays a mode other than the requested one.
fn other_mode(draft: &mut Draft) {
    let mode = draft.random.pick(&[CSP, CSV]);
    let wanted = Wanted {
        mode: Some(mode),
        endless: true,
        ..Wanted::default()
    };
    draft.drive(wanted);
    let fault = draft.strike("sdo-ignored", 0.0, 0, Effect::Open);
    draft.fault(fault.key("index", "0x6060").key("sub", 0));
    draft.turn(0.5);
    draft.may_fail = true;
    draft.ends_at = 0.8;
}

/// A group whose stop either stops the machine or not.
fn groups(draft: &mut Draft) {
    let wanted = Wanted {
        mode: Some(CSP),
        endless: true,
        ..Wanted::default()
    };
    for _ in 0..3 {
        draft.drive(wanted);
    }
    let alone = draft.random.chance(0.6);
    let outside = if alone { "continue" } else { "stop" };
    draft.stop = format!(
        "\n[[stop.group]]\nname = \"g\"\naxes = [\"a0\", \"a1\"]\noutside = \"{outside}\"\n"
    );
    for axis in &mut draft.machine.axes[..2] {
        axis.alone = alone;
    }
    draft.turn(0.8);
    draft.ends_at = 1.8;
    let at = draft.random.between(0.8, 2.0);
    let fault = if draft.random.chance(0.6) {
        let device = draft.random.below(2) as u16;
        draft
            .strike("drive-fault", at, device, Effect::Failure)
            .key("code", "0x8611")
    } else {
        random_fault(draft, at)
    };
    draft.fault(fault);
}

/// An emergency stop by an input. The simulated terminal copies the input from its output.
fn emergency(draft: &mut Draft) {
    let io = draft.io();
    let name = draft.name(io);
    let on = draft.random.pick(&["quick-stop", "no-power"]);
    draft.on_emergency = on;
    for _ in 0..1 + draft.random.below(2) {
        let axis = draft.drive(Wanted {
            endless: true,
            ..Wanted::default()
        });
        draft.machine.axes[axis].may_lose_power = on == "no-power";
    }
    draft.stop = format!("emergency = {{ {name}.\"Input 7\" = true }}\n");
    draft.run_up(0.8);
    let pause = draft.random.pick(&["1ms", "40ms", "300ms"]);
    draft.step(&format!("dwell = \"{pause}\""));
    draft.step(&format!("set = {{ {name}.\"Output 7\" = true }}"));
    draft.step("dwell = \"60s\"");
    draft.may_fail = true;
    draft.ends_at = 1.5;
    if draft.random.chance(0.5) {
        let at = draft.random.between(MOVES_BY_S, 1.5);
        let fault = random_fault(draft, at);
        draft.fault(fault);
    }
}

/// The run ends in any phase of motion, without a fault.
fn no_fault(draft: &mut Draft) {
    devices(draft, Wanted::default());
    program(draft);
    draft.ends_at = draft.random.between(0.05, 2.0);
}
