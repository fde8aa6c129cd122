//! The fault script as written and as checked against the bus.

use serde::Deserialize;
use toml::Spanned;

use super::kinds;
use crate::Nanos;
use crate::drive::State;
use crate::esc::al::AlState;
use crate::network::topology::Topology;

#[derive(Debug, Clone, Default, PartialEq)]
pub struct FaultScript {
    pub seed: Option<u64>,
    pub faults: Vec<Fault>,
}

impl FaultScript {
    /// Everything happens `by` later.
    pub(crate) fn delay(&mut self, by: Nanos) {
        for fault in &mut self.faults {
            fault.at = fault.at.saturating_add(by);
        }
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct Fault {
    pub at: Nanos,
    /// `None`: for good.
    pub duration: Option<Nanos>,
    /// 0 where the kind concerns no device.
    pub device: usize,
    pub kind: FaultKind,
    /// Line of the script.
    pub line: u32,
    /// The kind as the script names it.
    pub name: &'static str,
}

/// Which of the frames sent while a fault lasts it strikes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Hits {
    /// The next so many.
    Next(u32),
    /// Each with this probability.
    Each(f64),
}

/// What a device is known by; `None`: as before.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct NewIdentity {
    pub vendor: Option<u32>,
    pub product: Option<u32>,
    pub revision: Option<u32>,
    pub serial: Option<u32>,
    pub alias: Option<u16>,
}

#[derive(Debug, Clone, PartialEq)]
pub enum FaultKind {
    /// Frames vanish, on the way out or on the way back.
    FrameLoss {
        hits: Hits,
    },
    /// Frames arrive at the MainDevice twice.
    FrameDuplicate {
        hits: Hits,
    },
    /// Frames come back later than they should; others overtake them.
    FrameDelay {
        hits: Hits,
        delay: Nanos,
    },
    /// A bit of the frame is turned over on its way to the port of the device named, or to any. From
    /// there on devices ignore and count it; the MainDevice never sees it.
    FrameCorrupt {
        hits: Hits,
        at: Option<(usize, u8)>,
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
    /// The SDO server confirms what one subindex is written with, and keeps the old value.
    SdoIgnored {
        index: u16,
        sub: u8,
    },
    /// Requests stay in the device's mailbox; nobody fetches or answers them.
    MailboxSilent,
    /// The watchdog of the process data expires, whatever comes.
    Watchdog,
    /// SYNC0 begins so much later than its start time says.
    SyncLate {
        delay: Nanos,
    },
    /// Another MainDevice sends a frame behind ours: it reads AL status, or sends everybody to a state.
    OtherMainDevice {
        hits: Hits,
        state: Option<AlState>,
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
    /// Pulls the shaft towards negative positions, N·m.
    Load {
        torque: f64,
    },
    /// The shaft does not turn, whatever the motor does.
    Blocked,
    /// EEPROM and 0x1018 name another device.
    Identity(NewIdentity),
    /// Without power: its neighbours lose their link, what is behind it or fed by it through the
    /// E-bus is out of reach; it comes back in Init. `absent` is another name for it: nobody on
    /// the bus can tell the two apart.
    PowerOff,
    /// Another device takes its place and starts in Init; when the fault ends, the old one is back.
    Swap(NewIdentity),
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

impl Fault {
    /// The device and port that must be there.
    fn place(&self) -> Option<(usize, Option<u8>)> {
        match self.kind {
            FaultKind::FrameLoss { .. }
            | FaultKind::FrameDuplicate { .. }
            | FaultKind::FrameDelay { .. }
            | FaultKind::OtherMainDevice { .. }
            | FaultKind::Silent => None,
            FaultKind::FrameCorrupt { at, .. } => at.map(|(device, port)| (device, Some(port))),
            FaultKind::LinkBreak { port } => Some((self.device, Some(port))),
            _ => Some((self.device, None)),
        }
    }
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
    #[error("line {line}: nothing is connected to port {port} of device {device}")]
    NoCable { line: u32, device: usize, port: u8 },
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
pub(super) struct RawFault {
    pub at: Option<String>,
    #[serde(rename = "for")]
    pub duration: Option<String>,
    pub device: Option<usize>,
    pub port: Option<u8>,
    pub node: Option<u8>,
    pub kind: Spanned<String>,
    pub count: Option<u32>,
    pub probability: Option<f64>,
    pub torque: Option<f64>,
    pub delay: Option<String>,
    pub code: Option<u32>,
    pub index: Option<u16>,
    pub sub: Option<u8>,
    pub state: Option<String>,
    pub vendor: Option<u32>,
    pub product: Option<u32>,
    pub revision: Option<u32>,
    pub serial: Option<u32>,
    pub alias: Option<u16>,
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
            kinds::check(&fault, number).map_err(|problem| ScriptError::Fault {
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

    /// Whether the bus has every device and every cable that the script names.
    pub fn check(&self, bus: &Topology) -> Result<(), ScriptError> {
        for fault in &self.faults {
            let (line, devices) = (fault.line, bus.len());
            match fault.place() {
                Some((device, _)) if device >= devices => {
                    return Err(ScriptError::NoSuchDevice {
                        line,
                        device,
                        devices,
                    });
                }
                Some((device, Some(port))) if !bus.has_cable(device, port) => {
                    return Err(ScriptError::NoCable { line, device, port });
                }
                _ => {}
            }
        }
        Ok(())
    }
}
