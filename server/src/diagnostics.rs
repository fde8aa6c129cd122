//! The state of bus, devices and axes as ROS diagnostics.

use ecaxis_axis::{AxisStatus, Controlword, Statusword};
use ecaxis_ecat::al_status_code::al_status_text;
use ecaxis_master::acyclic::AlState;
use ecaxis_master::config::{AxisSetup, DeviceConfig};
use ecaxis_master::report::events::describe_stop;
use ecaxis_master::ros2::topics::{Diagnostic, DiagnosticLevel};
use ecaxis_master::rt::exchange::SubDeviceDiagnostics;
use serde_json::{Map, Value, json};

use crate::hub::{BusState, Hub, Latest};

/// Returns the state of the bus, of each device and of each axis.
#[must_use]
pub fn diagnostics(hub: &Hub) -> Vec<Diagnostic> {
    let latest = hub.latest();
    let latest = latest.as_deref();
    let machine = &*hub.machine;
    let devices = machine.devices.enumerate().map(|(index, config)| {
        let found = latest.and_then(|latest| latest.snapshot.diagnoses.get(index));
        device(config, found)
    });
    let axes = machine.axes.enumerate().map(|(index, setup)| {
        let name = machine.devices.get(setup.device);
        let name = name.map_or("", |device| device.name.as_str());
        let status = latest.and_then(|latest| latest.snapshot.axes.get(index));
        axis(setup, name, status)
    });
    std::iter::once(bus(hub, latest))
        .chain(devices)
        .chain(axes)
        .collect()
}

/// Returns the same as JSON.
#[must_use]
pub fn diagnostics_as_json(hub: &Hub) -> Value {
    let diagnostics = diagnostics(hub).into_iter().map(|diagnostic| {
        let values = diagnostic.values.into_iter();
        let values: Map<_, _> = values
            .map(|(key, text)| (key.to_owned(), json!(text)))
            .collect();
        json!({
            "level": diagnostic.level as u8, "name": diagnostic.name, "message": diagnostic.message,
            "hardware_id": diagnostic.hardware_id, "values": values,
        })
    });
    diagnostics.collect()
}

fn bus(hub: &Hub, latest: Option<&Latest>) -> Diagnostic {
    let status = hub.bus().borrow().clone();
    let machine = &*hub.machine;
    let stopping = latest.and_then(|latest| latest.snapshot.stopping);
    let stopping = stopping.map(|cause| describe_stop(cause, machine));
    let level = match (status.state, &stopping) {
        (BusState::Op, None) => DiagnosticLevel::Ok,
        (BusState::Failed, _) => DiagnosticLevel::Error,
        _ => DiagnosticLevel::Warn,
    };
    let message = status.error.or(stopping);
    let values = latest.map(|latest| {
        let counters = &latest.snapshot.counters;
        [
            ("cycles", counters.cycles),
            ("lost frames", counters.lost_frames),
            ("late frames", counters.late_frames),
            ("working counter errors", counters.wkc_errors),
            ("overruns", counters.overruns),
        ]
        .map(|(key, count)| (key, count.to_string()))
    });
    let name = machine.path.file_stem().unwrap_or_default();
    Diagnostic {
        level,
        name: "bus".to_owned(),
        message: message.unwrap_or_else(|| status.state.name().to_owned()),
        hardware_id: name.to_string_lossy().into_owned(),
        values: values.into_iter().flatten().collect(),
    }
}

fn device(config: &DeviceConfig, found: Option<&SubDeviceDiagnostics>) -> Diagnostic {
    let name = &config.name;
    let (level, message, values) = match found {
        None => (DiagnosticLevel::Stale, "unknown".to_owned(), Vec::new()),
        Some(found) => {
            let state = AlState::from_status(found.al_status);
            let (level, message) = match (found.answers, found.al_code) {
                (false, _) => (DiagnosticLevel::Error, "does not answer".to_owned()),
                (true, 0) if state == AlState::Op => (DiagnosticLevel::Ok, state.to_string()),
                (true, 0) => (DiagnosticLevel::Warn, state.to_string()),
                (true, code) => {
                    let text = al_status_text(code);
                    (
                        DiagnosticLevel::Error,
                        format!("{state}: {code:#06x}, {text}"),
                    )
                }
            };
            let grown = found.grown();
            let sum = |ports: [u16; 4]| ports.iter().map(|n| u32::from(*n)).sum::<u32>();
            let mut values = vec![
                (
                    "invalid frames",
                    sum(grown.invalid_frames.map(Into::into)).to_string(),
                ),
                (
                    "receive errors",
                    sum(grown.rx_errors.map(Into::into)).to_string(),
                ),
                (
                    "lost links",
                    sum(grown.lost_links.map(Into::into)).to_string(),
                ),
            ];
            if config.selection.dc.is_some() {
                values.push(("clock difference in ns", found.clock_difference.to_string()));
            }
            (level, message, values)
        }
    };
    Diagnostic {
        level,
        name: format!("device {name}"),
        message,
        hardware_id: name.clone(),
        values,
    }
}

fn axis(setup: &AxisSetup, device: &str, status: Option<&AxisStatus>) -> Diagnostic {
    let (level, message, values) = match status {
        None => (DiagnosticLevel::Stale, "unknown".to_owned(), Vec::new()),
        Some(status) => {
            let fault = status.fault.map(|fault| fault.to_string());
            let fault = fault.or(status.trip.map(|trip| trip.to_string()));
            let waiting = status.waiting.map(|waiting| waiting.to_string());
            let (level, message) = match (fault, waiting) {
                (Some(fault), _) => (DiagnosticLevel::Error, fault),
                (None, Some(waiting)) => (DiagnosticLevel::Warn, waiting),
                (None, None) => (DiagnosticLevel::Ok, status.state.to_string()),
            };
            let statusword = Statusword::from_bits_retain(status.statusword);
            let controlword = Controlword::from_bits_retain(status.controlword);
            let values = vec![
                ("state", status.state.to_string()),
                ("mode", status.mode.to_string()),
                (
                    "statusword",
                    format!("{:#06x}: {statusword}", statusword.bits()),
                ),
                (
                    "controlword",
                    format!("{:#06x}: {controlword}", controlword.bits()),
                ),
                ("homed", status.homed().to_string()),
            ];
            (level, message, values)
        }
    };
    Diagnostic {
        level,
        name: format!("axis {}", setup.name),
        message,
        hardware_id: device.to_owned(),
        values,
    }
}
