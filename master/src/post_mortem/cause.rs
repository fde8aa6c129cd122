//! Causes that stop a run, with their texts.

use std::fmt;

use serde::Serialize;

use crate::clock::Nanos;
use crate::config::duration;
use ecaxis_ecat::al_status_code::al_status_text;

/// The cause that stopped a run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Diagnosis {
    pub cause: DiagnosedCause,
    /// Other observations that may be related.
    pub also: Vec<DiagnosedCause>,
}

/// A cause. Its text names the device first.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "cause", rename_all = "kebab-case")]
pub enum DiagnosedCause {
    /// This computer was too late.
    Overload {
        missed: u64,
        longest_ns: Nanos,
        /// The consequence, if a device noticed the delay.
        then: Option<String>,
    },
    /// Another MainDevice sends EtherCAT frames on this segment.
    OtherMainDevice {
        frames: u64,
        /// A device that the other MainDevice set to another state.
        device: Option<String>,
        state: Option<String>,
    },
    /// The network interface refused to send or receive `refused` times.
    Interface { refused: u64 },
    /// No frame returns.
    #[serde(rename = "nobody-answers")]
    NoResponse { first: Option<String> },
    /// Frames return, but in a later cycle.
    LateFrames { late: u64, cycle_ns: Nanos },
    /// No frame returned for a while, then all devices answered again.
    #[serde(rename = "silence")]
    TemporaryOutage { silence_ns: Nanos },
    /// This device and those behind it are out of reach.
    OutOfReach {
        device: String,
        behind: usize,
        /// The port to which the device is connected.
        upstream: String,
        /// Whether that port has a link; `None` if unknown.
        link: Option<bool>,
    },
    /// A device lost its power and restarted.
    Restarted { device: String, behind: usize },
    /// Damaged frames arrive at a port.
    DamagedFrames {
        device: String,
        port: u8,
        /// The device at the other end of the cable.
        partner: Option<String>,
        count: u8,
    },
    /// A port temporarily lost its link.
    #[serde(rename = "loose-link")]
    LinkFlapping {
        device: String,
        port: u8,
        partner: Option<String>,
        count: u8,
    },
    /// The process data was missing for longer than the device's watchdog allows.
    Watchdog {
        device: String,
        others: usize,
        /// The longest time without an answer at the MainDevice.
        silence_ns: Nanos,
        watchdog_ns: Option<Nanos>,
    },
    /// A device in Op does not accept its outputs: its watchdog has expired and does not restart.
    OutputsNotTaken { device: String, watchdog_ns: Nanos },
    /// SYNC0 does not arrive when the device needs it.
    Sync {
        device: String,
        /// The AL status code. 0: the device waits without an error.
        code: u16,
        refused: bool,
        activation: Option<u8>,
        next_ns: Option<i64>,
    },
    /// A device left Op by itself or on request.
    LeftOp {
        device: String,
        state: String,
        code: u16,
    },
    /// The drive's interpolation time differs from the cycle time.
    Interpolation {
        device: String,
        drive_ns: Nanos,
        cycle_ns: Nanos,
        then: String,
    },
    /// The mailbox of a device does not answer.
    Mailbox { device: String, doing: String },
    /// The device's revision differs from the ESI file's.
    Revision {
        device: String,
        expected: u32,
        found: u32,
        esi: String,
    },
    /// The error itself is the explanation.
    #[serde(rename = "as-told")]
    Unexplained { text: String },
}

impl fmt::Display for DiagnosedCause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let time = |ns: &Nanos| about(*ns);
        match self {
            Self::Overload {
                missed,
                longest_ns,
                then,
            } => {
                let cycles = if *missed == 1 { "cycle" } else { "cycles" };
                write!(
                    f,
                    "this computer was too late: {missed} {cycles} left out, up to {} without a frame",
                    time(longest_ns)
                )?;
                write_consequence(f, then.as_deref())
            }
            Self::OtherMainDevice {
                frames,
                device,
                state,
            } => {
                write!(
                    f,
                    "another MainDevice is on this wire: {frames} EtherCAT frames that are not ours"
                )?;
                match (device, state) {
                    (Some(device), Some(state)) => write!(f, "; {device} was sent to {state}"),
                    _ => Ok(()),
                }
            }
            Self::Interface { refused } => write!(
                f,
                "this computer's network interface refused to send or to receive, {refused} times"
            ),
            Self::NoResponse { first } => {
                f.write_str("no frame comes back: the cable from this computer")?;
                match first {
                    Some(first) => write!(f, " to {first} is broken, or {first} has no power"),
                    None => f.write_str(" is broken, or the first device has no power"),
                }
            }
            Self::LateFrames { late, cycle_ns } => write!(
                f,
                "frames come back too late for a cycle of {}: {late} came in a later one",
                time(cycle_ns)
            ),
            Self::TemporaryOutage { silence_ns } => write!(
                f,
                "no frame came back for {}, then all devices answered again: the first cable, or this computer's interface",
                time(silence_ns)
            ),
            Self::OutOfReach {
                device,
                behind,
                upstream,
                link,
            } => {
                write!(f, "{device} is out of reach")?;
                write_downstream_count(f, *behind)?;
                match link {
                    Some(false) => write!(
                        f,
                        ": {upstream} has no link; the cable is broken, or the device has no power"
                    ),
                    Some(true) => {
                        write!(
                            f,
                            ": {upstream} has a link, but no device behind it answers"
                        )
                    }
                    None => write!(f, ": it is connected to {upstream}"),
                }
            }
            Self::Restarted { device, behind } => {
                write!(f, "{device} has been without power")?;
                if *behind > 0 {
                    write!(f, ", which cut off {behind} behind it")?;
                }
                f.write_str(": it is back in Init and has lost its station address")
            }
            Self::DamagedFrames {
                device,
                port,
                partner,
                count,
            } => {
                write!(
                    f,
                    "{device}: frames arrive damaged at its port {port}: {} CRC errors",
                    at_most(*count)
                )?;
                partner
                    .as_ref()
                    .map_or(Ok(()), |partner| write!(f, " on the cable from {partner}"))
            }
            Self::LinkFlapping {
                device,
                port,
                partner,
                count,
            } => {
                let times = match count {
                    1 => "once".to_owned(),
                    n => format!("{n} times"),
                };
                write!(f, "{device}: its port {port} lost the link {times}")?;
                partner
                    .as_ref()
                    .map_or(Ok(()), |partner| write!(f, ", on the cable to {partner}"))
            }
            Self::Watchdog {
                device,
                others,
                silence_ns,
                watchdog_ns,
            } => {
                write!(f, "{device} left Op by its process data watchdog")?;
                if let Some(allowed) = watchdog_ns.filter(|ns| *ns > 0) {
                    write!(f, " of {}", time(&allowed))?;
                }
                match silence_ns {
                    0 => f.write_str(", though every frame came back")?,
                    ns => write!(f, ": no frame came back for {}", time(ns))?,
                }
                match others {
                    0 => Ok(()),
                    1 => f.write_str("; so did 1 other device"),
                    n => write!(f, "; so did {n} other devices"),
                }
            }
            Self::OutputsNotTaken {
                device,
                watchdog_ns,
            } => write!(
                f,
                "{device} does not take its outputs: its process data watchdog of {} has expired (0x0440)",
                time(watchdog_ns)
            ),
            Self::Sync {
                device,
                code,
                refused,
                activation,
                next_ns,
            } => {
                let what = if *refused { "refused Op" } else { "left Op" };
                match code {
                    0 => write!(f, "{device} did not reach Op")?,
                    code => write!(
                        f,
                        "{device} {what}, AL status code 0x{code:04x} ({})",
                        al_status_text(*code)
                    )?,
                }
                match (activation, next_ns) {
                    (Some(activation), _) if activation & 3 != 3 => {
                        f.write_str(": its SYNC0 is not switched on")
                    }
                    (_, Some(next @ i64::MIN..0)) => {
                        write!(f, ": its SYNC0 was due {} ago", time(&next.unsigned_abs()))
                    }
                    (_, Some(next)) if *next > SOON || *code == 0 => write!(
                        f,
                        ": its SYNC0 only begins in {}",
                        time(&next.unsigned_abs())
                    ),
                    _ => Ok(()),
                }
            }
            Self::LeftOp {
                device,
                state,
                code: 0,
            } => write!(
                f,
                "{device} is in {state} without an error: another program requested it, or the device restarted"
            ),
            Self::LeftOp {
                device,
                state,
                code,
            } => write!(
                f,
                "{device} left Op for {state}, AL status code 0x{code:04x} ({})",
                al_status_text(*code)
            ),
            Self::Interpolation {
                device,
                drive_ns,
                cycle_ns,
                then,
            } => {
                let cycle = time(cycle_ns);
                match drive_ns {
                    0 => write!(
                        f,
                        "{device}: the drive did not receive the cycle of {cycle} (0x60C2 is 0)"
                    )?,
                    ns => write!(
                        f,
                        "{device}: the drive counts on a cycle of {} (0x60C2), it is {cycle}",
                        time(ns)
                    )?,
                }
                write_consequence(f, Some(then))
            }
            Self::Mailbox { device, doing } => {
                write!(f, "{device}: its mailbox does not answer ({doing})")
            }
            Self::Revision {
                device,
                expected,
                found,
                esi,
            } => write!(
                f,
                "{device} has revision 0x{found:08x}, the file `{esi}` describes revision 0x{expected:08x}"
            ),
            Self::Unexplained { text } => f.write_str(text),
        }
    }
}

/// Returns the time with three significant digits.
#[must_use]
pub fn about(ns: Nanos) -> String {
    let digits = ns.checked_ilog10().unwrap_or(0);
    let step = 10u64.pow(digits.saturating_sub(2));
    duration::show(ns.saturating_add(step / 2) / step * step)
}

/// The limit in ns; a SYNC0 further in the future counts as late.
const SOON: i64 = 1_000_000_000;

fn write_consequence(f: &mut fmt::Formatter<'_>, then: Option<&str>) -> fmt::Result {
    then.map_or(Ok(()), |then| write!(f, "; then: {then}"))
}

fn write_downstream_count(f: &mut fmt::Formatter<'_>, behind: usize) -> fmt::Result {
    match behind {
        0 => Ok(()),
        n => write!(f, ", with {n} behind it"),
    }
}

/// Returns the count as text. Counters stop at 255.
fn at_most(count: u8) -> String {
    if count == u8::MAX {
        "255 or more".to_owned()
    } else {
        count.to_string()
    }
}
