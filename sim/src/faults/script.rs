//! The fault script as written and as checked.

use serde::Deserialize;
use toml::Spanned;

use crate::Nanos;
use crate::drive::State;
use crate::esc::al::AlState;

#[derive(Debug, Clone, Default, PartialEq)]
pub struct FaultScript {
    pub seed: Option<u64>,
    pub faults: Vec<Fault>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Fault {
    pub at: Nanos,
    /// `None`: for good.
    pub duration: Option<Nanos>,
    pub device: usize,
    pub kind: FaultKind,
    /// Line of the script.
    pub line: u32,
}

#[derive(Debug, Clone, PartialEq)]
pub enum FaultKind {
    /// Frames vanish, on the way out or on the way back.
    FrameLoss {
        count: Option<u32>,
        probability: Option<f64>,
    },
    /// The drive detects this error itself.
    DriveFault {
        code: u16,
    },
    /// The SDO server answers one subindex with an abort.
    SdoAbort {
        index: u16,
        sub: u8,
        code: u32,
    },
    /// The device refuses to enter a state.
    RefuseState {
        state: AlState,
        code: u16,
    },
    /// The drive's power state machine does not leave a state.
    Stuck {
        state: State,
    },
    /// EEPROM and 0x1018 name another device.
    Identity {
        vendor: Option<u32>,
        product: Option<u32>,
        revision: Option<u32>,
    },
    /// Without power: its neighbours lose their link, what is behind it or fed by it through the
    /// E-bus is out of reach; it comes back in Init.
    Absent,
    /// The cable at the MainDevice is unplugged.
    Silent,
    /// The cable at the device's port carries nothing; both ends lose their link.
    LinkBreak {
        port: u8,
    },
    /// A node behind a gateway has no power; it boots again when it has.
    NodeSilent {
        node: u8,
    },
    Emergency {
        code: u16,
    },
}

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ScriptError {
    #[error("{0}")]
    Toml(String),
    #[error("line {line}: fault of kind `{kind}`: {problem}")]
    Fault {
        line: usize,
        kind: String,
        problem: String,
    },
    #[error("line {line}: there is no device {device}; the bus has {devices}, counted from 0")]
    NoSuchDevice {
        line: u32,
        device: usize,
        devices: usize,
    },
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawScript {
    seed: Option<u64>,
    #[serde(default)]
    fault: Vec<RawFault>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawFault {
    at: Option<String>,
    #[serde(rename = "for")]
    duration: Option<String>,
    device: Option<usize>,
    port: Option<u8>,
    node: Option<u8>,
    kind: Spanned<String>,
    count: Option<u32>,
    probability: Option<f64>,
    code: Option<u32>,
    index: Option<u16>,
    sub: Option<u8>,
    state: Option<String>,
    vendor: Option<u32>,
    product: Option<u32>,
    revision: Option<u32>,
}

impl FaultScript {
    pub fn parse(text: &str) -> Result<Self, ScriptError> {
        let raw: RawScript =
            toml::from_str(text).map_err(|error| ScriptError::Toml(error.to_string()))?;
        let faults = raw.fault.into_iter().map(|fault| {
            let at = fault.kind.span().start;
            let line = text.bytes().take(at).filter(|b| *b == b'\n').count() + 1;
            let kind = fault.kind.get_ref().clone();
            let number = u32::try_from(line).unwrap_or(u32::MAX);
            check(fault, number).map_err(|problem| ScriptError::Fault {
                line,
                kind,
                problem,
            })
        });
        Ok(Self {
            seed: raw.seed,
            faults: faults.collect::<Result<_, _>>()?,
        })
    }

    /// Whether a bus of so many devices has every device that the script names.
    pub fn check(&self, devices: usize) -> Result<(), ScriptError> {
        match self.faults.iter().find(|fault| {
            let whole_bus = matches!(fault.kind, FaultKind::FrameLoss { .. } | FaultKind::Silent);
            fault.device >= devices && !(whole_bus && fault.device == 0)
        }) {
            Some(fault) => Err(ScriptError::NoSuchDevice {
                line: fault.line,
                device: fault.device,
                devices,
            }),
            None => Ok(()),
        }
    }
}

fn check(raw: RawFault, line: u32) -> Result<Fault, String> {
    let name = raw.kind.get_ref().as_str();
    let code16 = || {
        let code = raw.code.ok_or("`code` is missing")?;
        u16::try_from(code).map_err(|_| format!("`code` 0x{code:x} does not fit 16 bits"))
    };
    let state = || raw.state.as_deref().ok_or("`state` is missing");
    let mut allowed: Vec<&str> = Vec::new();
    let kind = match name {
        "frame-loss" => {
            allowed.extend(["count", "probability"]);
            if raw.count.is_some() == raw.probability.is_some() {
                return Err("needs either `count` or `probability`".into());
            }
            if raw.probability.is_some_and(|p| !(0.0..=1.0).contains(&p)) {
                return Err("`probability` must lie between 0 and 1".into());
            }
            FaultKind::FrameLoss {
                count: raw.count,
                probability: raw.probability,
            }
        }
        "drive-fault" => {
            allowed.push("code");
            FaultKind::DriveFault { code: code16()? }
        }
        "emergency" => {
            allowed.push("code");
            FaultKind::Emergency { code: code16()? }
        }
        "sdo-abort" => {
            allowed.extend(["index", "sub", "code"]);
            FaultKind::SdoAbort {
                index: raw.index.ok_or("`index` is missing")?,
                sub: raw.sub.unwrap_or(0),
                code: raw.code.ok_or("`code` is missing")?,
            }
        }
        "refuse-state" => {
            allowed.extend(["state", "code"]);
            FaultKind::RefuseState {
                state: al_state(state()?)?,
                code: code16()?,
            }
        }
        "stuck" => {
            allowed.push("state");
            FaultKind::Stuck {
                state: drive_state(state()?)?,
            }
        }
        "identity" => {
            allowed.extend(["vendor", "product", "revision"]);
            if raw.vendor.or(raw.product).or(raw.revision).is_none() {
                return Err("needs `vendor`, `product` or `revision`".into());
            }
            FaultKind::Identity {
                vendor: raw.vendor,
                product: raw.product,
                revision: raw.revision,
            }
        }
        "absent" => FaultKind::Absent,
        "silent" => FaultKind::Silent,
        "link-break" => {
            allowed.push("port");
            let port = raw.port.unwrap_or(0);
            if port > 3 {
                return Err(format!("`port` {port}: ports are 0 to 3"));
            }
            FaultKind::LinkBreak { port }
        }
        "node-silent" => {
            allowed.push("node");
            let node = raw.node.ok_or("`node` is missing")?;
            if !(1..=127).contains(&node) {
                return Err(format!("`node` {node}: nodes are 1 to 127"));
            }
            FaultKind::NodeSilent { node }
        }
        _ => {
            return Err(
                "unknown; known are frame-loss, drive-fault, sdo-abort, refuse-state, stuck, \
                        identity, absent, silent, emergency, link-break, node-silent"
                    .into(),
            );
        }
    };
    let given = [
        ("port", raw.port.is_some()),
        ("node", raw.node.is_some()),
        ("count", raw.count.is_some()),
        ("probability", raw.probability.is_some()),
        ("code", raw.code.is_some()),
        ("index", raw.index.is_some()),
        ("sub", raw.sub.is_some()),
        ("state", raw.state.is_some()),
        ("vendor", raw.vendor.is_some()),
        ("product", raw.product.is_some()),
        ("revision", raw.revision.is_some()),
    ];
    if let Some((key, _)) = given
        .iter()
        .find(|(key, given)| *given && !allowed.contains(key))
    {
        return Err(format!("`{key}` means nothing here"));
    }
    Ok(Fault {
        at: raw.at.as_deref().map_or(Ok(0), duration)?,
        duration: raw.duration.as_deref().map(duration).transpose()?,
        device: raw.device.unwrap_or(0),
        kind,
        line,
    })
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

/// However people write it: `SafeOp`, `safe-op`, `safeop`.
fn al_state(name: &str) -> Result<AlState, String> {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_parses() {
        let script = FaultScript::parse(
            r#"
            seed = 9
            [[fault]]
            at = "1.5s"
            for = "20ms"
            kind = "frame-loss"
            count = 3
            [[fault]]
            device = 1
            kind = "drive-fault"
            code = 0x8611
            [[fault]]
            kind = "sdo-abort"
            index = 0x6065
            code = 0x06010002
            [[fault]]
            kind = "refuse-state"
            state = "safeop"
            code = 0x001e
            [[fault]]
            kind = "stuck"
            state = "switch-on-disabled"
            [[fault]]
            kind = "identity"
            product = 5
            [[fault]]
            kind = "absent"
            [[fault]]
            kind = "silent"
            [[fault]]
            kind = "emergency"
            code = 0x2310
            [[fault]]
            device = 3
            kind = "link-break"
            port = 1
            [[fault]]
            kind = "node-silent"
            node = 5
            "#,
        )
        .unwrap();
        assert_eq!(script.seed, Some(9));
        assert_eq!(script.faults.len(), 11);
        assert_eq!(script.faults[9].kind, FaultKind::LinkBreak { port: 1 });
        assert_eq!(script.faults[10].kind, FaultKind::NodeSilent { node: 5 });
        assert_eq!(script.faults[0].at, 1_500_000_000);
        assert_eq!(script.faults[0].duration, Some(20_000_000));
        assert_eq!(
            script.faults[1].kind,
            FaultKind::DriveFault { code: 0x8611 }
        );
    }

    #[test]
    fn errors_name_line_and_field() {
        let error = |text: &str| FaultScript::parse(text).unwrap_err().to_string();
        assert_eq!(
            error("[[fault]]\nkind = \"sdo-abort\"\ncode = 1\n"),
            "line 2: fault of kind `sdo-abort`: `index` is missing"
        );
        assert!(error("[[fault]]\nkind = \"absent\"\ncode = 1\n").contains("`code` means nothing"));
        assert!(error("[[fault]]\nkind = \"link-break\"\nport = 4\n").contains("ports are 0 to 3"));
        assert!(error("[[fault]]\nkind = \"node-silent\"\n").contains("`node` is missing"));
        assert!(error("[[fault]]\nkind = \"node-silent\"\nnode = 0\n").contains("1 to 127"));
        assert!(error("[[fault]]\nkind = \"melt\"\n").contains("known are frame-loss"));
        assert!(error("[[fault]]\nat = \"soon\"\nkind = \"absent\"\n").contains("not a duration"));
        assert!(error("[[fault]]\nkind = \"silent\"\nwhen = 1\n").contains("when"));
    }

    #[test]
    fn states_as_people_write_them() {
        for (state, spellings) in [
            (AlState::Init, &["init", "Init", "INIT"][..]),
            (AlState::PreOp, &["PreOp", "pre-op", "preop", "PRE-OP"]),
            (AlState::SafeOp, &["SafeOp", "safe-op", "safeop", "Safe-Op"]),
            (AlState::Op, &["Op", "op", "OP"]),
            (AlState::Boot, &["boot", "Boot"]),
        ] {
            for spelling in spellings {
                assert_eq!(al_state(spelling), Ok(state), "{spelling}");
            }
        }
        assert_eq!(
            al_state("Running").unwrap_err(),
            "`Running` is not init, preop, boot, safeop or op"
        );
    }

    #[test]
    fn a_device_that_is_not_there_is_named_with_its_line() {
        let script = FaultScript::parse(
            "[[fault]]\nkind = \"silent\"\n\n[[fault]]\ndevice = 2\nkind = \"absent\"\n",
        )
        .unwrap();
        let lines: Vec<u32> = script.faults.iter().map(|fault| fault.line).collect();
        assert_eq!(lines, [2, 6]);
        assert_eq!(script.check(3), Ok(()));
        assert_eq!(
            script.check(2).unwrap_err().to_string(),
            "line 6: there is no device 2; the bus has 2, counted from 0"
        );
        let silent = FaultScript::parse("[[fault]]\nkind = \"silent\"\n").unwrap();
        assert_eq!(silent.check(0), Ok(()));
    }
}
