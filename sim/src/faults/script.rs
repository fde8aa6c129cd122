//! The fault script: parsing, and its check against the segment.

use serde::Deserialize;
use toml::Spanned;

use super::keys;
use crate::Nanos;
use crate::device::InputFault;
use crate::drive::State;
use crate::esc::al::AlState;
use crate::gateway::GatewayFault;
use crate::network::topology::Topology;

/// Faults with their times, parsed from TOML.
#[derive(Debug, Clone, Default, PartialEq)]
#[non_exhaustive]
pub struct FaultScript {
    /// The seed of random faults, in place of
    /// [`SegmentOptions::seed`](crate::SegmentOptions::seed).
    pub seed: Option<u64>,
    pub(crate) faults: Vec<Fault>,
}

impl FaultScript {
    /// Gives an input of an I/O device a value from `at` on; after `duration` it is 0.
    pub fn add_input(
        &mut self,
        (device, index, sub): (usize, u16, u8),
        value: i64,
        (at, duration): (Nanos, Option<Nanos>),
    ) {
        self.faults.push(Fault {
            at,
            duration,
            device,
            kind: FaultKind::Input { index, sub, value },
            name: "input",
            line: 0,
        });
    }

    /// Delays all faults by `by` ns.
    pub(crate) fn delay(&mut self, by: Nanos) {
        for fault in &mut self.faults {
            fault.at = fault.at.saturating_add(by);
        }
    }
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Fault {
    pub at: Nanos,
    /// The duration in ns; `None`: permanent.
    pub duration: Option<Nanos>,
    /// The device; 0 for kinds without a device.
    pub device: usize,
    pub kind: FaultKind,
    /// The line in the script.
    pub line: u32,
    /// The kind as written in the script.
    pub name: &'static str,
}

/// The frames that a fault affects while it lasts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum FrameSelection {
    /// The next frames, up to this number.
    Next(u32),
    /// Each frame with this probability.
    Each(f64),
}

/// The identity of a new device; `None`: unchanged.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct NewIdentity {
    pub vendor: Option<u32>,
    pub product: Option<u32>,
    pub revision: Option<u32>,
    pub serial: Option<u32>,
    pub alias: Option<u16>,
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) enum FaultKind {
    /// Frames are lost on the way out or on the way back.
    FrameLoss {
        hits: FrameSelection,
    },
    /// Frames arrive at the MainDevice twice.
    FrameDuplicate {
        hits: FrameSelection,
    },
    /// Frames return late; other frames overtake them.
    FrameDelay {
        hits: FrameSelection,
        delay: Nanos,
    },
    /// A bit of the frame flips in front of a port, or anywhere if no port is given. Devices behind
    /// that location ignore and count the frame. It never reaches the MainDevice.
    FrameCorrupt {
        hits: FrameSelection,
        at: Option<(usize, u8)>,
    },
    /// The drive detects this error itself.
    DriveFault {
        code: u16,
    },
    /// The SDO server aborts accesses to one subindex.
    SdoAbort {
        index: u16,
        sub: u8,
        code: u32,
    },
    /// The SDO server confirms writes to one subindex and keeps the old value.
    SdoIgnored {
        index: u16,
        sub: u8,
    },
    /// Requests stay in the mailbox of the device without an answer.
    MailboxSilent,
    /// The device sends Ethernet broadcasts without end.
    EoeFlood,
    /// Fragments of Ethernet frames are lost, repeated or contradictory.
    EoeFragments,
    /// The process data watchdog expires, despite outputs.
    Watchdog,
    /// SYNC0 starts `delay` ns after its start time.
    SyncLate {
        delay: Nanos,
    },
    /// The clock takes no system time.
    ClockIgnored,
    /// A frame of another MainDevice follows ours. It reads AL status, or requests a state from all
    /// devices.
    OtherMainDevice {
        hits: FrameSelection,
        state: Option<AlState>,
    },
    /// The device refuses to enter a state.
    RefuseState {
        state: AlState,
        code: u16,
    },
    /// The CiA 402 state machine of the drive does not leave a state.
    Stuck {
        state: State,
    },
    /// A torque in N·m pulls the shaft towards negative positions.
    Load {
        torque: f64,
    },
    /// The shaft does not turn, regardless of the motor torque.
    Blocked,
    /// Inputs of the drive are wrong.
    Inputs(InputFault),
    /// All positions of the drive shift by a number of counts.
    PositionShift {
        counts: i64,
    },
    /// Safe torque off is requested.
    Sto,
    /// The enable input is off.
    EnableInput,
    /// EEPROM and 0x1018 contain the identity of another device.
    Identity(NewIdentity),
    /// The device has no power. Its neighbours lose their link. Devices behind it, or powered by it
    /// through the E-bus, are unreachable. Afterwards it starts in Init. `absent` is a synonym,
    /// since both look the same on the bus.
    PowerOff,
    /// Another device replaces it and starts in Init. At the end of the fault, the old device
    /// returns.
    Swap(NewIdentity),
    /// The cable at the MainDevice is unplugged.
    Silent,
    /// The cable at the port of the device is broken; both ends lose their link.
    LinkBreak {
        port: u8,
    },
    /// Something on the CAN network behind a gateway.
    Gateway(GatewayFault),
    Emergency {
        code: u16,
    },
    /// An input of an I/O device has a value; after the fault it is 0.
    Input {
        index: u16,
        sub: u8,
        value: i64,
    },
}

impl Fault {
    /// Returns the device and port that must exist.
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

/// The fault script cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ScriptError {
    /// The text is not TOML of the expected structure; contains the parser's message.
    #[error("{0}")]
    Toml(String),
    /// A fault has an unknown kind, or a key is missing, superfluous or out of range.
    #[error("line {line}: fault of kind `{kind}`: {problem}")]
    Fault {
        /// The line in the script, from 1.
        line: usize,
        /// The kind as written.
        kind: String,
        /// The problem as text.
        problem: String,
    },
    /// The script names a device that the segment does not have.
    #[error("line {line}: there is no device {device}; the bus has {devices}, counted from 0")]
    NoSuchDevice {
        /// The line in the script, from 1.
        line: u32,
        /// The device, counted from 0.
        device: usize,
        /// The number of devices.
        devices: usize,
    },
    /// The script names a port without a cable.
    #[error("line {line}: nothing is connected to port {port} of device {device}")]
    NoCable {
        /// The line in the script, from 1.
        line: u32,
        /// The device, counted from 0.
        device: usize,
        /// The port, 0 to 3.
        port: u8,
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
    pub value: Option<i64>,
    pub mask: Option<u16>,
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
    /// Parses a script. Fails at the first error; [`Self::check`] then compares it with a segment.
    pub fn parse(text: &str) -> Result<Self, ScriptError> {
        let raw: RawScript =
            toml::from_str(text).map_err(|error| ScriptError::Toml(error.to_string()))?;
        let faults = raw.fault.into_iter().map(|fault| {
            let at = fault.kind.span().start;
            let line = text.bytes().take(at).filter(|b| *b == b'\n').count() + 1;
            let kind = fault.kind.get_ref().clone();
            let number = u32::try_from(line).unwrap_or(u32::MAX);
            keys::check(&fault, number).map_err(|problem| ScriptError::Fault {
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

    /// Checks that the segment has all devices and cables in the script.
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
