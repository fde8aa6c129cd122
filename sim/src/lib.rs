//! A simulated EtherCAT segment: SubDevices made from ESI files, cabled, with their own clocks.
//! Deterministic under virtual time; shares no code with any MainDevice, so that one misreading
//! cannot pass on both sides.
//!
//! From the wire inwards:
//!
//! * [`network`]: ports, cables, delays, loss; [`Segment`] is where frames go in
//! * [`frame`]: the datagram codec
//! * [`esc`]: the SubDevice controller: registers, FMMUs, SyncManagers, EEPROM, distributed clocks
//! * [`device`]: the controller and the application behind it: state machine, mailbox, process data
//! * [`coe`]: object dictionary, SDO server, SDO Information
//! * [`foe`]: a device's files
//! * [`firmware`]: its program memory and its boot loader
//! * [`drive`]: a CiA 402 drive down to the motor shaft
//! * [`gateway`]: a CANopen gateway and the network behind it
//! * [`faults`]: what goes wrong on purpose
//! * [`serve`]: the segment on a real network interface, for any MainDevice

mod bits;
pub mod coe;
pub mod device;
pub mod drive;
pub mod esc;
pub mod faults;
pub mod firmware;
pub mod foe;
pub mod frame;
pub mod gateway;
pub mod network;
mod random;
pub mod serve;

pub use device::{DeviceOptions, MailboxOptions, SimDevice, SimError};
pub use drive::{PlantParams, Track};
pub use esc::al::AlState;
pub use esc::info::EscInfo;
pub use esc::ports::Medium;
pub use faults::{FaultReport, FaultScript, ScriptError};
pub use firmware::{FirmwareHeader, FirmwareOptions};
pub use foe::{FileStore, FoeOptions};
pub use network::topology::{SecondPort, Topology, TopologyError, Uplink, Wish};
pub use network::{Nic, Segment, SegmentOptions, Transit};
pub use serve::{ServeError, ServeStats, Server};

/// True time of the simulated world, in nanoseconds. Every device's own clock drifts from it.
pub type Nanos = u64;
