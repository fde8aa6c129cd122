//! The state of a machine in the fleet: the object `state` of the server, made small.

use std::time::{SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::events::EventIdentity;
use crate::keys::MachineId;

/// The axes with a fault that are listed, and the length of a text in characters.
const MAX_FAULTS: usize = 16;
const MAX_TEXT: usize = 200;

/// What an agent publishes once a second.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct State {
    /// The machine.
    #[serde(flatten)]
    pub id: MachineId,
    /// The time of the agent's clock in s since 1970.
    pub unix_time: f64,
    /// The version of the agent.
    pub agent: String,
    /// The address of the machine's own page.
    pub page: Option<String>,
    /// The fault reports that the agent keeps.
    pub reports: usize,
    /// The newest event that the agent has.
    pub last_event: Option<EventIdentity>,
    /// `present`, or `absent`: nothing answers at the socket.
    pub server: Server,
    /// What the server says.
    #[serde(flatten)]
    pub serve: Option<Serve>,
}

/// Whether the server answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Server {
    /// It answers.
    Present,
    /// Nothing answers at the socket.
    Absent,
}

/// What a server says of itself.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Serve {
    /// The version of ecaxis.
    pub version: String,
    /// The name in the machine file.
    pub name: String,
    /// The SHA-256 of the machine's files.
    pub sha256: String,
    /// The bus.
    pub bus: Bus,
    /// The number of axes, of those enabled, and of those in motion.
    pub axes: usize,
    /// Axes with power.
    pub enabled: usize,
    /// Axes that do not stand.
    pub moving: usize,
    /// Axes with a fault or a trip; at most 16.
    pub faults: Vec<AxisFault>,
    /// The number of devices.
    pub devices: usize,
    /// The device that needs attention first.
    pub worst_device: Option<WorstDevice>,
    /// The wake-up of the cycle in ns: the 99.9th percentile, and the maximum.
    pub jitter_p99_9_ns: Option<u64>,
    /// The maximum.
    pub jitter_max_ns: Option<u64>,
    /// The owner of the motion.
    pub owner: Option<String>,
}

/// The bus.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Bus {
    /// `down`, `starting`, `op`, `stopping` or `failed`.
    pub state: String,
    /// Why it failed.
    pub error: Option<String>,
    /// Cycles since the bus came up.
    pub cycles: u64,
    /// Frames that did not return.
    pub lost_frames: u64,
    /// Wrong working counters.
    pub wkc_errors: u64,
    /// Cycles that began too late.
    pub overruns: u64,
}

/// An axis with a fault or a trip.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AxisFault {
    /// The axis.
    pub axis: String,
    /// The fault or the trip.
    pub why: String,
}

/// The device that is not in Op, or whose ports have counted most errors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WorstDevice {
    /// The device.
    pub name: String,
    /// Its AL state.
    pub al_state: Option<String>,
    /// The errors at all its ports.
    pub errors: u64,
    /// The difference of its clock to the reference clock in ns.
    pub clock_difference_ns: Option<i64>,
}

/// Returns the time in s since 1970.
#[must_use]
pub fn unix_time() -> f64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    since.unwrap_or_default().as_secs_f64()
}

fn text(value: &Value) -> Option<String> {
    value
        .as_str()
        .map(|text| text.chars().take(MAX_TEXT).collect())
}

fn number(value: &Value) -> u64 {
    value.as_u64().unwrap_or_default()
}

fn list(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

impl Serve {
    /// Reads the answers to `hello`, `machine` and `state`. What is missing is empty.
    #[must_use]
    pub fn read(hello: &Value, machine: &Value, state: &Value) -> Self {
        let bus = &state["bus"];
        let axes = list(&state["axes"]);
        let count = |key: &str| axes.iter().filter(|axis| axis[key] == true).count();
        let fault = |axis: &Value| {
            let why = text(&axis["fault"]).or_else(|| text(&axis["trip"]))?;
            let axis = text(&axis["name"])?;
            Some(AxisFault { axis, why })
        };
        let wake_up = &state["timing"]["wake_up"];
        Self {
            version: text(&hello["version"]).unwrap_or_default(),
            name: text(&machine["name"]).unwrap_or_default(),
            sha256: text(&machine["sha256"]).unwrap_or_default(),
            bus: Bus {
                state: text(&bus["state"]).unwrap_or_default(),
                error: text(&bus["error"]),
                cycles: number(&bus["cycles"]),
                lost_frames: number(&bus["lost_frames"]),
                wkc_errors: number(&bus["wkc_errors"]),
                overruns: number(&bus["overruns"]),
            },
            axes: axes.len(),
            enabled: count("enabled"),
            moving: axes.iter().filter(|axis| axis["at_rest"] == false).count(),
            faults: axes.iter().filter_map(fault).take(MAX_FAULTS).collect(),
            devices: list(&state["devices"]).len(),
            worst_device: worst(list(&state["devices"])),
            jitter_p99_9_ns: wake_up["p99_9_ns"].as_u64(),
            jitter_max_ns: wake_up["max_ns"].as_u64(),
            owner: text(&state["lease"]["owner"]["name"]),
        }
    }
}

fn worst(devices: &[Value]) -> Option<WorstDevice> {
    const COUNTERS: [&str; 4] = [
        "invalid_frames",
        "rx_errors",
        "forwarded_errors",
        "lost_links",
    ];
    let errors = |device: &Value| -> u64 {
        let ports = list(&device["ports"]).iter();
        let of_port = |port: &Value| COUNTERS.map(|key| number(&port[key])).iter().sum::<u64>();
        ports.map(of_port).sum()
    };
    let device = devices.iter().max_by_key(|device| {
        let difference = device["clock_difference_ns"].as_i64().unwrap_or_default();
        let not_in_op = device["al_state"] != "Op";
        (not_in_op, errors(device), difference.unsigned_abs())
    })?;
    Some(WorstDevice {
        name: text(&device["name"]).unwrap_or_default(),
        al_state: text(&device["al_state"]),
        errors: errors(device),
        clock_difference_ns: device["clock_difference_ns"].as_i64(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn the_worst_device_is_not_in_op_then_has_errors() {
        let port = |errors: u64| json!([{"rx_errors": errors, "invalid_frames": null}]);
        let device = |name: &str, al: &str, errors: u64, clock: i64| {
            json!({"name": name, "al_state": al, "ports": port(errors),
                   "clock_difference_ns": clock})
        };
        let name = |devices: &[Value]| worst(devices).map(|device| device.name);
        let (a, b) = (device("a", "Op", 3, 9), device("b", "Op", 3, -12));
        assert_eq!(name(&[a.clone(), b.clone()]).as_deref(), Some("b"));
        let c = device("c", "SafeOp", 0, 0);
        assert_eq!(name(&[a, c, b]).as_deref(), Some("c"));
        assert_eq!(name(&[]), None);
    }

    #[test]
    fn any_answer_is_a_state() {
        for value in [
            json!(null),
            json!([]),
            json!({"axes": 3, "bus": [], "devices": {}}),
        ] {
            let serve = Serve::read(&value, &value, &value);
            assert_eq!((serve.axes, serve.devices), (0, 0));
        }
        let axes = json!({"axes": vec![json!({"name": "x", "trip": "t", "at_rest": false}); 40]});
        let serve = Serve::read(&json!({}), &json!({}), &axes);
        assert_eq!(
            (serve.axes, serve.moving, serve.faults.len()),
            (40, 40, MAX_FAULTS)
        );
    }

    #[test]
    fn a_state_is_read_as_it_was_written() {
        let state = State {
            id: "hall/press".parse().unwrap(),
            unix_time: 1.5,
            agent: "0.1.0".to_owned(),
            page: None,
            reports: 2,
            last_event: None,
            server: Server::Absent,
            serve: None,
        };
        let text = serde_json::to_string(&state).unwrap();
        assert!(text.contains("\"server\":\"absent\""), "{text}");
        assert_eq!(serde_json::from_str::<State>(&text).unwrap(), state);
        let null = json!(null);
        let serve = Some(Serve::read(&null, &null, &null));
        let present = State {
            server: Server::Present,
            serve,
            ..state
        };
        let text = serde_json::to_string(&present).unwrap();
        assert_eq!(serde_json::from_str::<State>(&text).unwrap(), present);
    }
}
