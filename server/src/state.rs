//! The objects `machine` and `state` of the protocol.

use std::collections::BTreeMap;
use std::sync::atomic::Ordering;

use ecaxis_axis::setpoint::LineShaftState;
use ecaxis_axis::{AxisStatus, Controlword, Mode, Statusword};
use ecaxis_ecat::al_status_code::al_status_text;
use ecaxis_ecat::index::{AxisIndex, DeviceIndex};
use ecaxis_esi::address;
use ecaxis_master::acyclic::AlState;
use ecaxis_master::acyclic::topology::ports;
use ecaxis_master::clock::COMMON_CLOCK;
use ecaxis_master::config::{AxisSetup, Machine, Nic, Signal, si_factor};
use ecaxis_master::link::redundant::{RingState, RingStatus};
use ecaxis_master::report::events::describe_stop;
use ecaxis_master::rt::common_time::CommonTimeStatus;
use ecaxis_master::rt::exchange::{DiagnosticRegister, SubDeviceDiagnostics};
use ecaxis_master::rt::line_shaft::LineShaftStatus;
use ecaxis_master::rt::overrides::Override;
use ecaxis_master::rt::samples::CYCLE_COLUMNS;
use ecaxis_master::supervise::operator::MAX_MANUAL_SPEED;
use serde_json::{Map, Value, json};

use crate::hub::{Hub, Latest, stream_text};
use crate::lease::ClientId;

/// Returns the object `machine`.
#[must_use]
pub fn machine(hub: &Hub) -> Value {
    let machine = &*hub.machine;
    let name = machine.path.file_stem().map(|name| name.to_string_lossy());
    let axes: Vec<_> = machine.axes.enumerate().collect();
    let axes: Vec<_> = axes
        .iter()
        .map(|(i, axis)| axis_setup(machine, *i, axis))
        .collect();
    let devices = machine.devices.enumerate().map(|(index, device)| {
        let axes = machine.axes_of(index).map(|(_, axis)| &axis.name);
        json!({
            "name": device.name,
            "at": device.at.to_string(),
            "product": device.device.type_name.to_string(),
            "axes": axes.collect::<Vec<_>>(),
            "dc": device.selection.dc.is_some(),
        })
    });
    let signal = |signal: &Signal| {
        let (device, name) = split(machine, signal);
        json!({"device": device, "name": name, "bits": signal.field.bit_len,
               "address": address(signal.field.index, signal.field.sub).to_string()})
    };
    let simulated = machine.bus.nic == Nic::Sim;
    let sim_inputs = machine.named_inputs().filter(|_| simulated);
    let sim_inputs = sim_inputs.map(|(name, input)| {
        let mut input = signal(&input);
        input["input"] = json!(name);
        input
    });
    let line_shafts = machine.line_shafts.iter().map(|setup| {
        let config = &setup.config;
        json!({"name": setup.name, "unit": setup.unit, "velocity": config.velocity,
               "acceleration": config.acceleration, "timeout_s": config.timeout_s,
               "smoothing_s": config.smoothing_s, "max_error": config.max_error})
    });
    let steps = machine.steps.iter().enumerate().map(|(index, step)| {
        json!({"number": (index + 1).to_string(), "line": step.line,
               "text": machine.describe_step(step)})
    });
    json!({
        "name": name,
        "sha256": machine.sha256.to_string(),
        "cycle_ns": machine.bus.cycle_ns,
        "clock_window_ns": machine.bus.clock_window_ns,
        "virtual": hub.options.virtual_time,
        "control": hub.options.control,
        "stale_cycles": machine.server.stale_cycles,
        "lease_ms": machine.server.lease_ns / 1_000_000,
        "axes": axes,
        "devices": devices.collect::<Vec<_>>(),
        "inputs": machine.inputs.iter().map(signal).collect::<Vec<_>>(),
        "outputs": hub.outputs.iter().map(|(_, output)| signal(output)).collect::<Vec<_>>(),
        "sim_inputs": sim_inputs.collect::<Vec<_>>(),
        "steps": steps.collect::<Vec<_>>(),
        "line_shafts": line_shafts.collect::<Vec<_>>(),
        "samples": hub.samples.layout(),
    })
}

/// Returns the names of a signal's device and of the signal there.
#[must_use]
pub fn split<'s>(machine: &'s Machine, signal: &'s Signal) -> (&'s str, &'s str) {
    let device = machine.devices.get(signal.device);
    let device = device.map_or("?", |device| device.name.as_str());
    let name = signal.name.strip_prefix(device);
    let name = name.and_then(|name| name.strip_prefix('.'));
    (device, name.unwrap_or(&signal.name))
}

/// Returns the modes that the machine file prepares for an axis.
pub fn modes(axis: &AxisSetup) -> impl Iterator<Item = Mode> {
    const ALL: [Mode; 6] = [
        Mode::Csp,
        Mode::Csv,
        Mode::Cst,
        Mode::Pp,
        Mode::Pv,
        Mode::Hm,
    ];
    let config = &axis.config;
    let offered = |mode: &Mode| *mode == config.mode || config.modes.contains(*mode);
    ALL.into_iter().filter(offered)
}

fn axis_setup(machine: &Machine, index: AxisIndex, axis: &AxisSetup) -> Value {
    let (config, limits) = (&axis.config, &axis.config.limits);
    let modes = modes(axis).map(|mode| mode.to_string().to_lowercase());
    let group = machine.group_of_axis(index);
    let device = machine.devices.get(axis.device);
    json!({
        "name": axis.name,
        "device": device.map(|device| &device.name),
        "unit": axis.unit,
        "velocity_unit": format!("{}/s", axis.unit),
        "torque_unit": "%",
        "si": si_factor(&axis.unit),
        "modes": modes.collect::<Vec<_>>(),
        "homing": axis.homing.is_some(),
        "limits": {
            "position": limits.position,
            "velocity": limits.velocity,
            "acceleration": limits.acceleration,
            "jerk": limits.jerk,
            "torque": limits.torque,
            "following_error": limits.following_error,
        },
        "torque_limit_note": axis.torque_limit.note(),
        "jog_velocity": MAX_MANUAL_SPEED * limits.velocity,
        "modulo": config.scale.modulo(),
        "group": machine.group_name(group),
    })
}

/// Returns the object `state`.
#[must_use]
pub fn state(hub: &Hub) -> Value {
    let latest = hub.latest();
    let latest = latest.as_deref();
    let machine = &*hub.machine;
    let owner = hub.owner();
    let rest = owner.as_ref().and_then(|(_, rest)| *rest);
    let owner = owner.map(|(owner, _)| owner);
    let step = hub.step();
    let axes: Vec<_> = machine
        .axes
        .enumerate()
        .map(|(index, setup)| axis_state(machine, index, setup, latest))
        .collect();
    let places = hub.places();
    let devices: Vec<_> = machine
        .devices
        .enumerate()
        .map(|(index, device)| {
            let found = latest.and_then(|latest| latest.snapshot.diagnoses.get(index));
            let mut state = device_state(&device.name, device.selection.dc.is_some(), found);
            let place = places.get(index);
            let parent = place.and_then(|place| {
                let (device, port) = place.parent?;
                let name = &machine.devices.get(device)?.name;
                Some(json!({"device": name, "port": port}))
            });
            state["position"] = json!(place.map(|place| place.position));
            state["parent"] = json!(parent);
            state
        })
        .collect();
    let inputs = machine.inputs.iter().enumerate().map(|(index, input)| {
        let (device, name) = split(machine, input);
        let value = latest.and_then(|latest| latest.snapshot.inputs.get(index));
        json!({"device": device, "name": name, "value": value})
    });
    let values = hub.output_values();
    let outputs = hub.outputs.iter().zip(values).map(|((_, output), value)| {
        let (device, name) = split(machine, output);
        json!({"device": device, "name": name, "value": value})
    });
    let groups = latest
        .iter()
        .flat_map(|latest| latest.snapshot.groups.enumerate());
    let mut overrides: Vec<_> = groups
        .map(|(group, status)| {
            let Override { factor, held } = status.rate;
            json!({"group": machine.group_name(group), "factor": factor, "held": held})
        })
        .collect();
    let rate = (!overrides.is_empty()).then(|| overrides.remove(0));
    let rate = rate.unwrap_or_else(|| json!({"factor": 1.0, "held": false}));
    let program = latest.map(|latest| &latest.program);
    let names = CYCLE_COLUMNS.map(|(name, _)| name);
    let timing: Map<String, Value> = names
        .into_iter()
        .zip(hub.sampler.percentiles())
        .map(|(name, percentiles)| (name.to_owned(), json!(percentiles)))
        .collect();
    let line_shafts = machine.line_shafts.enumerate().map(|(index, setup)| {
        let status = latest.and_then(|latest| latest.snapshot.line_shafts.get(index));
        line_shaft_state(&setup.name, status, hub.feeder(index))
    });
    let count = |counter: &std::sync::atomic::AtomicU64| counter.load(Ordering::Relaxed);
    let time = latest.map(|latest| latest.snapshot.time);
    json!({
        "time_ns": time.unwrap_or_else(|| hub.now()),
        "events": hub.last_event(),
        "bus": bus_state(hub, latest),
        "lease": {"owner": owner, "remaining_ms": rest},
        "override": rate["factor"],
        "held": rate["held"],
        "overrides": overrides,
        "program": {
            "running": program.is_some_and(|program| program.running),
            "paused": program.is_some_and(|program| program.paused),
            "step": step.step,
            "run": step.run,
        },
        "axes": axes,
        "devices": devices,
        "inputs": inputs.collect::<Vec<_>>(),
        "outputs": outputs.collect::<Vec<_>>(),
        "timing": timing,
        "line_shafts": line_shafts.collect::<Vec<_>>(),
        "area": {
            "attached": count(&hub.area.attached) != 0,
            "used": count(&hub.area.used),
            "late": count(&hub.area.late),
            "refused": count(&hub.area.refused),
            "stopped": count(&hub.area.stopped),
        },
    })
}

fn bus_state(hub: &Hub, latest: Option<&Latest>) -> Value {
    let machine = &*hub.machine;
    let status = hub.bus().borrow().clone();
    let mut bus = match serde_json::to_value(status) {
        Ok(Value::Object(bus)) => bus,
        _ => Map::new(),
    };
    if let Some(Latest { snapshot, .. }) = latest {
        let counters = &snapshot.counters;
        let phase = snapshot.phase.map(|phase| {
            let reference = phase.reference.and_then(|index| machine.devices.get(index));
            json!({"locked": phase.locked, "error_ns": phase.error_ns,
                   "drift_ppm": phase.drift_ppm, "reference": reference.map(|d| &d.name)})
        });
        let stopping = snapshot.stopping.map(|cause| describe_stop(cause, machine));
        for (key, value) in [
            ("cycles", json!(counters.cycles)),
            ("lost_frames", json!(counters.lost_frames)),
            ("late_frames", json!(counters.late_frames)),
            ("wkc_errors", json!(counters.wkc_errors)),
            ("overruns", json!(counters.overruns)),
            ("inputs_fresh", json!(snapshot.inputs_fresh)),
            ("stopping", json!(stopping)),
            ("phase", json!(phase)),
            ("common_time", common_time(&snapshot.common_time)),
            ("ring", hub.ring().map_or(Value::Null, ring_state)),
        ] {
            bus.insert(key.to_owned(), value);
        }
    }
    Value::Object(bus)
}

fn line_shaft_state(
    name: &str,
    status: Option<&LineShaftStatus>,
    feeder: Option<ClientId>,
) -> Value {
    let status = status.copied().unwrap_or_default();
    let runs = status.state == LineShaftState::Running;
    let moves = status.state != LineShaftState::Waiting;
    json!({
        "name": name,
        "state": state_name(status.state),
        "why": (!runs).then(|| status.end.to_string()),
        "position": moves.then_some(status.motion.position),
        "velocity": moves.then_some(status.motion.velocity),
        "age_ns": status.age_ns,
        "error": runs.then_some(status.error),
        "stream": runs.then(|| stream_text(status.newest.stream)),
        "client": feeder,
    })
}

/// Returns the name of the state of a line shaft in the protocol.
#[must_use]
pub fn state_name(state: LineShaftState) -> &'static str {
    match state {
        LineShaftState::Waiting => "waiting",
        LineShaftState::Running => "running",
        LineShaftState::Stopping => "stopping",
    }
}

fn common_time(common: &CommonTimeStatus) -> Value {
    let (alignment, locked) = (common.alignment, common.locked);
    json!({
        "clock": COMMON_CLOCK,
        "locked": locked,
        "offset_ns": locked.then_some(common.offset_ns),
        "drift_ppm": locked.then_some(common.drift_ppm),
        "jitter_ns": common.jitter_ns,
        "jumps": common.jumps,
        "aligned": alignment.map(|alignment| alignment.aligned),
        "sync0_ns": alignment.filter(|_| locked).map(|alignment| alignment.sync0_ns),
        "correction_ppm": alignment.map(|alignment| alignment.correction_ppm),
    })
}

fn ring_state(ring: &RingStatus) -> Value {
    let state = match ring.get() {
        RingState::Closed => "closed",
        RingState::Broken { .. } => "broken",
        RingState::OneDirection => "one-direction",
        RingState::Silent => "silent",
    };
    let (breaks, _) = ring.breaks();
    json!({"state": state, "behind": ring.get().split(), "breaks": breaks,
           "links": ring.links().collect::<BTreeMap<_, _>>()})
}

fn axis_state(
    machine: &Machine,
    index: AxisIndex,
    setup: &AxisSetup,
    latest: Option<&Latest>,
) -> Value {
    let status = latest.and_then(|latest| latest.snapshot.axes.get(index));
    let (Some(latest), Some(status)) = (latest, status) else {
        return json!({"name": setup.name, "state": "unknown", "enabled": false, "ready": false,
                      "powered": false, "position_validity": "unknown", "power_loss": Value::Null,
                      "mode": Value::Null, "position": Value::Null, "velocity": Value::Null,
                      "torque": Value::Null, "target_position": Value::Null,
                      "target_velocity": Value::Null, "target_torque": Value::Null,
                      "following_error": Value::Null, "statusword": Value::Null,
                      "statusword_text": Value::Null, "controlword": Value::Null,
                      "controlword_text": Value::Null, "waiting": Value::Null,
                      "fault": Value::Null, "trip": Value::Null, "stop": Value::Null,
                      "stopped": Value::Null});
    };
    let group = machine.group_of_axis(index);
    let group = latest.snapshot.groups.get(group);
    let stopped = group.and_then(|group| group.stopped);
    let doing = latest.hands.get(index).map(|hand| hand.doing.to_string());
    let mut value = known_state(setup, status);
    if let Some(object) = value.as_object_mut() {
        let stopped = stopped.map(|cause| describe_stop(cause, machine));
        object.insert("stopped".to_owned(), json!(stopped));
        object.insert("doing".to_owned(), json!(doing));
    }
    value
}

fn known_state(setup: &AxisSetup, status: &AxisStatus) -> Value {
    let text = |part: Option<String>| part;
    let stop = status
        .stop
        .map(|stop| format!("{} for {:.2} s", describe_phase(stop.phase), stop.elapsed_s));
    // Without the position loop, numbers may be unknown (NaN), which JSON shows as null.
    json!({
        "name": setup.name,
        "state": status.state.to_string(),
        "time_in_state_s": status.time_in_state_s,
        "powered": status.powered,
        "enabled": status.enabled,
        "ready": status.ready,
        "mode": status.mode.to_string().to_lowercase(),
        "moving": status.moving,
        "at_rest": status.at_rest,
        "in_target": status.in_target,
        "homed": status.homed(),
        "position_validity": status.validity.to_string(),
        "position": status.position,
        "velocity": status.velocity,
        "torque": status.torque,
        "target_position": status.target_position,
        "target_velocity": status.target_velocity,
        "target_torque": status.target_torque,
        "following_error": status.following_error,
        "max_following_error": status.max_following_error,
        "encoder_difference": status.encoder_difference,
        "statusword": status.statusword,
        "statusword_text": Statusword::from_bits_retain(status.statusword).to_string(),
        "controlword": status.controlword,
        "controlword_text": Controlword::from_bits_retain(status.controlword).to_string(),
        "stale_cycles": status.stale_cycles,
        "waiting": text(status.waiting.map(|waiting| waiting.to_string())),
        "fault": text(status.fault.map(|fault| fault.to_string())),
        "trip": text(status.trip.map(|trip| trip.to_string())),
        "stop": text(stop),
        "power_loss": text(status.power_loss_cause.map(|cause| cause.to_string())),
        "internal_limit": status.internal_limit,
    })
}

fn describe_phase(phase: ecaxis_axis::status::StopPhase) -> &'static str {
    use ecaxis_axis::status::StopPhase;
    match phase {
        StopPhase::Decelerating => "slows down",
        StopPhase::Standstill => "stands, the brake closes",
        StopPhase::RemovingPower => "power is being removed",
        StopPhase::PowerKept => "the drive keeps power",
        StopPhase::Silent => "the drive does not answer",
        _ => "stops",
    }
}

fn device_state(name: &str, dc: bool, found: Option<&SubDeviceDiagnostics>) -> Value {
    let Some(found) = found else {
        return json!({"name": name, "al_state": "unknown", "al_code": 0, "al_text": Value::Null,
                      "answers": false, "clock_difference_ns": Value::Null, "ports": []});
    };
    let grown = found.grown();
    let links = found
        .has_read(DiagnosticRegister::DlStatus)
        .then(|| ports(found.dl_status));
    let ports = (0..4_usize).map(|port| {
        let link = links.map(|links| links[port]);
        json!({"link": link.map(|link| link.link), "open": link.map(|link| link.open),
               "invalid_frames": grown.invalid_frames[port], "rx_errors": grown.rx_errors[port],
               "forwarded_errors": grown.forwarded[port], "lost_links": grown.lost_links[port]})
    });
    let text = (found.al_code != 0).then(|| al_status_text(found.al_code));
    json!({
        "name": name,
        "al_state": AlState::from_status(found.al_status).to_string(),
        "al_code": found.al_code,
        "al_text": text,
        "answers": found.answers,
        "clock_difference_ns": dc.then_some(found.clock_difference),
        "processing_errors": grown.processing,
        "pdi_errors": grown.pdi,
        "ports": ports.collect::<Vec<_>>(),
    })
}

/// Returns the index of the device with this name.
#[must_use]
pub fn device_named(machine: &Machine, name: &str) -> Option<DeviceIndex> {
    let mut devices = machine.devices.enumerate();
    devices
        .find(|(_, d)| d.name == name)
        .map(|(index, _)| index)
}
