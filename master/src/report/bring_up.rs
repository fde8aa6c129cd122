//! The steps of a bring-up, and their times.

use std::fmt;

use ecaxis_ecat::al_state::AlState;
use serde::Serialize;

use crate::clock::Nanos;
use crate::text::pluralize;

/// A step of the bring-up, for display.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Step {
    Scan,
    Found {
        devices: usize,
    },
    StartUp {
        device: String,
        done: usize,
        of: usize,
    },
    /// Start-up SDOs whose values the device already had.
    Held {
        device: String,
        held: usize,
        of: usize,
    },
    ProcessData {
        bytes: usize,
        frames: usize,
    },
    Clocks {
        reference: String,
        devices: usize,
    },
    State(AlState),
    /// A unit taken over from the drive.
    Adopted {
        device: String,
        what: String,
    },
    /// The state of the ring, with cable redundancy.
    Ring(String),
    /// A warning; the bring-up continues.
    Warning(String),
}

impl fmt::Display for Step {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Scan => f.write_str("scanning the segment"),
            Self::Found { devices: 1 } => {
                f.write_str("1 SubDevice, as in the machine file; in PreOp")
            }
            Self::Found { devices } => {
                write!(
                    f,
                    "{devices} SubDevices, all as in the machine file; in PreOp"
                )
            }
            Self::StartUp { device, done, of } => write!(f, "`{device}`: start-up SDO {done}/{of}"),
            Self::Held { device, held, of } => {
                write!(
                    f,
                    "`{device}`: {held} of {of} start-up SDOs were held already"
                )
            }
            Self::ProcessData { bytes, frames } => {
                write!(
                    f,
                    "process image: {} in {}",
                    pluralize(*bytes, "byte"),
                    pluralize(*frames, "frame")
                )
            }
            Self::Clocks { reference, devices } => {
                write!(
                    f,
                    "distributed clocks: `{reference}` is the reference, SYNC0 on {}",
                    pluralize(*devices, "device")
                )
            }
            Self::State(state) => write!(f, "all SubDevices in {state}"),
            Self::Adopted { device, what } => write!(f, "`{device}`: {what}"),
            Self::Ring(text) | Self::Warning(text) => f.write_str(text),
        }
    }
}

/// A step of the bring-up. Devices run their steps at the same time, so steps may overlap.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct StepTime {
    pub name: &'static str,
    /// The time in ns from the start of the bring-up to the start of the first device.
    pub began_ns: Nanos,
    /// The time in ns from the start of the first device to the end of the last one.
    pub took_ns: Nanos,
    /// The device that took longest, and its time in ns.
    pub slowest: Option<(String, Nanos)>,
}
