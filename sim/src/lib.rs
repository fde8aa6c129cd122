#![doc = include_str!("../README.md")]
//!
//! # Modules
//!
//! From the wire inwards:
//!
//! * [`network`]: ports, cables, delays and frame loss; [`Segment`] takes the frames
//! * [`frame`]: the datagram codec
//! * [`chip`]: the types of EtherCAT SubDevice controllers
//! * [`drive`]: a CiA 402 drive down to the motor shaft
//! * [`gateway`]: a CANopen gateway and the network behind it
//! * [`faults`]: scripted faults
//! * [`serve`]: the segment on a real network interface, for any MainDevice
//!
//! [`SimDevice`] connects the controller (`esc`) with the application: state machine, mailbox and
//! process data (`device`), object dictionary and SDO server (`coe`), files (`foe`), an IP host
//! (`eoe`), program memory and boot loader (`firmware`).

#![deny(missing_docs)]

mod bits;
mod coe;
mod device;
pub mod drive;
mod eoe;
mod esc;
pub mod faults;
mod firmware;
mod foe;
pub mod frame;
pub mod gateway;
pub mod network;
mod quirks;
mod random;
pub mod serve;
mod soe;

pub use coe::MissingSubindices;
pub use coe::startup::StartupWrite;
pub use device::{DeviceOptions, MailboxOptions, SimDevice, SimError};
pub use drive::{ElasticLoad, PitchError, PlantParams, Track};
pub use esc::al::AlState;
pub use esc::chip::{self, EscInfo};
pub use esc::ports::Medium;
pub use faults::{FaultProgress, FaultScript, ScriptError};
pub use firmware::{FirmwareHeader, FirmwareOptions};
pub use foe::{FileStore, FoeOptions};
pub use network::topology::{PortRequest, SecondPort, Topology, TopologyError, Uplink};
pub use network::{FrameOutcome, Nic, Segment, SegmentOptions};
pub use quirks::{Cycles, Delay, Quirk, QuirkPoint, QuirkValue, Quirks};
pub use serve::{ServeError, ServeStats, Server};

/// True time of the simulation in ns. Each device clock drifts from the true time.
pub type Nanos = u64;
