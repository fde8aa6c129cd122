//! The required and permitted keys of each kind of fault.

use super::script::{Fault, FaultKind, FrameSelection, NewIdentity, RawFault};
use crate::Nanos;
use crate::device::InputFault;
use crate::drive::State;
use crate::esc::al::AlState;
use crate::esc::ports::PORTS;
use crate::gateway::GatewayFault;

/// Every kind with its keys, in addition to `at`, `for` and `kind`.
const KINDS: &[(&str, &[&str])] = &[
    ("frame-loss", &["count", "probability"]),
    ("frame-duplicate", &["count", "probability"]),
    ("frame-delay", &["count", "probability", "delay"]),
    ("frame-corrupt", &["count", "probability", "device", "port"]),
    ("drive-fault", &["device", "code"]),
    ("emergency", &["device", "code"]),
    ("sdo-abort", &["device", "index", "sub", "code"]),
    ("sdo-ignored", &["device", "index", "sub"]),
    ("mailbox-silent", &["device"]),
    ("eoe-flood", &["device"]),
    ("eoe-fragments", &["device"]),
    ("watchdog", &["device"]),
    ("sync-late", &["device", "delay"]),
    ("clock-ignored", &["device"]),
    ("other-main-device", &["count", "probability", "state"]),
    ("refuse-state", &["device", "state", "code"]),
    ("stuck", &["device", "state"]),
    ("load", &["device", "torque"]),
    ("blocked", &["device"]),
    ("statusword", &["device", "value", "mask", "count"]),
    ("zero-inputs", &["device", "count"]),
    ("position-shift", &["device", "value"]),
    ("sto", &["device"]),
    ("enable-input", &["device"]),
    ("identity", &["device", "vendor", "product", "revision"]),
    (
        "swap",
        &["device", "vendor", "product", "revision", "serial", "alias"],
    ),
    ("power-off", &["device"]),
    ("absent", &["device"]),
    ("link-break", &["device", "port"]),
    ("node-silent", &["device", "node"]),
    ("input", &["device", "index", "sub", "value"]),
    ("heartbeat-lost", &["device", "node"]),
    ("node-error", &["device", "node"]),
    ("can-open", &["device"]),
    ("gateway-reset", &["device"]),
    ("control-ignored", &["device"]),
    ("silent", &[]),
];

pub(super) fn check(raw: &RawFault, line: u32) -> Result<Fault, String> {
    let name = raw.kind.get_ref().as_str();
    let Some((known, allowed)) = KINDS.iter().find(|(kind, _)| *kind == name) else {
        let known: Vec<&str> = KINDS.iter().map(|(kind, _)| *kind).collect();
        return Err(format!("unknown; known are {}", known.join(", ")));
    };
    if let Some((key, _)) = given(raw)
        .iter()
        .find(|(key, given)| *given && !allowed.contains(key))
    {
        return Err(match allowed {
            [] => format!("`{key}` is unknown here: this kind takes no keys"),
            _ => format!("`{key}` is unknown here; known: `{}`", allowed.join("`, `")),
        });
    }
    Ok(Fault {
        at: raw.at.as_deref().map_or(Ok(0), duration)?,
        duration: raw.duration.as_deref().map(duration).transpose()?,
        device: raw.device.unwrap_or(0),
        kind: kind(name, raw)?,
        line,
        name: known,
    })
}

fn given(raw: &RawFault) -> [(&'static str, bool); 18] {
    [
        ("device", raw.device.is_some()),
        ("port", raw.port.is_some()),
        ("node", raw.node.is_some()),
        ("count", raw.count.is_some()),
        ("probability", raw.probability.is_some()),
        ("delay", raw.delay.is_some()),
        ("code", raw.code.is_some()),
        ("index", raw.index.is_some()),
        ("sub", raw.sub.is_some()),
        ("state", raw.state.is_some()),
        ("vendor", raw.vendor.is_some()),
        ("product", raw.product.is_some()),
        ("revision", raw.revision.is_some()),
        ("serial", raw.serial.is_some()),
        ("alias", raw.alias.is_some()),
        ("torque", raw.torque.is_some()),
        ("value", raw.value.is_some()),
        ("mask", raw.mask.is_some()),
    ]
}

fn kind(name: &str, raw: &RawFault) -> Result<FaultKind, String> {
    let code16 = || {
        let code = raw.code.ok_or("`code` is missing")?;
        u16::try_from(code).map_err(|_| format!("`code` 0x{code:x} does not fit 16 bits"))
    };
    let state = || raw.state.as_deref().ok_or("`state` is missing");
    Ok(match name {
        "frame-loss" => FaultKind::FrameLoss { hits: hits(raw)? },
        "frame-duplicate" => FaultKind::FrameDuplicate { hits: hits(raw)? },
        "frame-delay" => FaultKind::FrameDelay {
            hits: hits(raw)?,
            delay: duration(raw.delay.as_deref().ok_or("`delay` is missing")?)?,
        },
        "frame-corrupt" => {
            if raw.device.is_none() && raw.port.is_some() {
                return Err("`port` needs the `device` it is a port of".into());
            }
            let port = port(raw)?;
            FaultKind::FrameCorrupt {
                hits: hits(raw)?,
                at: raw.device.map(|device| (device, port)),
            }
        }
        "drive-fault" => FaultKind::DriveFault { code: code16()? },
        "emergency" => FaultKind::Emergency { code: code16()? },
        "sdo-abort" => FaultKind::SdoAbort {
            index: raw.index.ok_or("`index` is missing")?,
            sub: raw.sub.unwrap_or(0),
            code: raw.code.ok_or("`code` is missing")?,
        },
        "sdo-ignored" => FaultKind::SdoIgnored {
            index: raw.index.ok_or("`index` is missing")?,
            sub: raw.sub.unwrap_or(0),
        },
        "mailbox-silent" => FaultKind::MailboxSilent,
        "eoe-flood" => FaultKind::EoeFlood,
        "eoe-fragments" => FaultKind::EoeFragments,
        "watchdog" => FaultKind::Watchdog,
        "sync-late" => FaultKind::SyncLate {
            delay: duration(raw.delay.as_deref().ok_or("`delay` is missing")?)?,
        },
        "clock-ignored" => FaultKind::ClockIgnored,
        "other-main-device" => FaultKind::OtherMainDevice {
            hits: hits(raw)?,
            state: raw.state.as_deref().map(al_state).transpose()?,
        },
        "refuse-state" => FaultKind::RefuseState {
            state: al_state(state()?)?,
            code: code16()?,
        },
        "stuck" => FaultKind::Stuck {
            state: drive_state(state()?)?,
        },
        "load" => {
            let torque = raw.torque.ok_or("`torque` (N·m) is missing")?;
            if !torque.is_finite() {
                return Err(format!("`torque` {torque} is not a number of N·m"));
            }
            FaultKind::Load { torque }
        }
        "blocked" => FaultKind::Blocked,
        "statusword" => {
            let value = raw.value.ok_or("`value` is missing")?;
            FaultKind::Inputs(InputFault {
                zero: false,
                statusword: u16::try_from(value)
                    .map_err(|_| format!("`value` {value} does not fit 16 bits"))?,
                mask: raw.mask.unwrap_or(u16::MAX),
                left: raw.count.unwrap_or(u32::MAX),
            })
        }
        "zero-inputs" => FaultKind::Inputs(InputFault {
            zero: true,
            left: raw.count.unwrap_or(u32::MAX),
            ..InputFault::default()
        }),
        "position-shift" => FaultKind::PositionShift {
            counts: i32::try_from(raw.value.ok_or("`value` (counts) is missing")?)
                .map_err(|_| "`value` does not fit 32 bits")?
                .into(),
        },
        "sto" => FaultKind::Sto,
        "enable-input" => FaultKind::EnableInput,
        "identity" => {
            if raw.vendor.or(raw.product).or(raw.revision).is_none() {
                return Err("needs `vendor`, `product` or `revision`".into());
            }
            FaultKind::Identity(identity(raw))
        }
        // A new device has no alias yet.
        "swap" => FaultKind::Swap(NewIdentity {
            alias: Some(raw.alias.unwrap_or(0)),
            ..identity(raw)
        }),
        "link-break" => FaultKind::LinkBreak { port: port(raw)? },
        "input" => FaultKind::Input {
            index: raw.index.ok_or("`index` is missing")?,
            sub: raw.sub.unwrap_or(0),
            value: raw.value.ok_or("`value` is missing")?,
        },
        "node-silent" => FaultKind::Gateway(GatewayFault::NodeSilent(node(raw)?)),
        "heartbeat-lost" => FaultKind::Gateway(GatewayFault::HeartbeatLost(node(raw)?)),
        "node-error" => FaultKind::Gateway(GatewayFault::NodeError(node(raw)?)),
        "can-open" => FaultKind::Gateway(GatewayFault::CanOpen),
        "gateway-reset" => FaultKind::Gateway(GatewayFault::Reset),
        "control-ignored" => FaultKind::Gateway(GatewayFault::ControlIgnored),
        "silent" => FaultKind::Silent,
        // `power-off` and `absent`: the last kinds in the table above.
        _ => FaultKind::PowerOff,
    })
}

fn node(raw: &RawFault) -> Result<u8, String> {
    let node = raw.node.ok_or("`node` is missing")?;
    match node {
        1..=127 => Ok(node),
        _ => Err(format!("`node` {node}: nodes are 1 to 127")),
    }
}

fn identity(raw: &RawFault) -> NewIdentity {
    NewIdentity {
        vendor: raw.vendor,
        product: raw.product,
        revision: raw.revision,
        serial: raw.serial,
        alias: raw.alias,
    }
}

fn hits(raw: &RawFault) -> Result<FrameSelection, String> {
    match (raw.count, raw.probability) {
        (Some(count), None) => Ok(FrameSelection::Next(count)),
        (None, Some(p)) if (0.0..=1.0).contains(&p) => Ok(FrameSelection::Each(p)),
        (None, Some(_)) => Err("`probability` must lie between 0 and 1".into()),
        _ => Err("needs either `count` or `probability`".into()),
    }
}

fn port(raw: &RawFault) -> Result<u8, String> {
    match raw.port {
        Some(port) if usize::from(port) >= PORTS => Err(format!("`port` {port}: ports are 0 to 3")),
        port => Ok(port.unwrap_or(0)),
    }
}

fn duration(text: &str) -> Result<Nanos, String> {
    let bad = || format!("`{text}` is not a duration such as \"1.5s\", \"250ms\" or \"10us\"");
    let split = text
        .find(|c: char| c.is_ascii_alphabetic())
        .ok_or_else(bad)?;
    let (number, unit) = text.split_at(split);
    let factor = match unit {
        "ns" => 1.0,
        "us" => 1e3,
        "ms" => 1e6,
        "s" => 1e9,
        "min" => 60e9,
        _ => return Err(bad()),
    };
    let value: f64 = number.trim().parse().map_err(|_| bad())?;
    let ns = value * factor;
    if (0.0..1e18).contains(&ns) {
        Ok(ns.round() as Nanos)
    } else {
        Err(bad())
    }
}

/// Parses an AL state in any spelling: `SafeOp`, `safe-op`, `safeop`.
pub(super) fn al_state(name: &str) -> Result<AlState, String> {
    Ok(match name.to_ascii_lowercase().replace('-', "").as_str() {
        "init" => AlState::Init,
        "preop" => AlState::PreOp,
        "boot" => AlState::Boot,
        "safeop" => AlState::SafeOp,
        "op" => AlState::Op,
        _ => return Err(format!("`{name}` is not init, preop, boot, safeop or op")),
    })
}

fn drive_state(name: &str) -> Result<State, String> {
    Ok(match name {
        "not-ready-to-switch-on" => State::NotReadyToSwitchOn,
        "switch-on-disabled" => State::SwitchOnDisabled,
        "ready-to-switch-on" => State::ReadyToSwitchOn,
        "switched-on" => State::SwitchedOn,
        "operation-enabled" => State::OperationEnabled,
        "quick-stop-active" => State::QuickStopActive,
        "fault-reaction-active" => State::FaultReactionActive,
        "fault" => State::Fault,
        _ => {
            return Err(format!(
                "`{name}` is not a CiA 402 state such as switch-on-disabled"
            ));
        }
    })
}
