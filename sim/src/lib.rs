//! A simulated EtherCAT segment: SubDevices built from ESI files, with cables and drifting clocks.
//!
//! The simulation is deterministic under virtual time. It shares no protocol code with any
//! MainDevice, so a misread standard cannot pass on both sides.
//!
//! From the wire inwards:
//!
//! * [`network`]: ports, cables, delays and frame loss; [`Segment`] takes the frames
//! * [`frame`]: the datagram codec
//! * [`esc`]: the SubDevice controller: registers, FMMUs, SyncManagers, EEPROM, distributed clocks
//! * [`device`]: the controller and its application: state machine, mailbox, process data
//! * [`coe`]: object dictionary, SDO server, SDO Information
//! * [`foe`]: the files of a device
//! * [`firmware`]: program memory and boot loader
//! * [`drive`]: a CiA 402 drive down to the motor shaft
//! * [`gateway`]: a CANopen gateway and the network behind it
//! * [`faults`]: scripted faults
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
pub use esc::chip::EscInfo;
pub use esc::ports::Medium;
pub use faults::{FaultReport, FaultScript, ScriptError};
pub use firmware::{FirmwareHeader, FirmwareOptions};
pub use foe::{FileStore, FoeOptions};
pub use network::topology::{PortRequest, SecondPort, Topology, TopologyError, Uplink};
pub use network::{FrameOutcome, Nic, Segment, SegmentOptions};
pub use serve::{ServeError, ServeStats, Server};

/// True time of the simulation in ns. Each device clock drifts from the true time.
pub type Nanos = u64;
