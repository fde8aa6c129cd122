#![doc = include_str!("../README.md")]
//!
//! # Modules
//!
//! Time arrives as `dt_s`, process data as plain integers. Functions that allocate say so; `RT`
//! marks functions of the cycle. From the bottom up:
//!
//! | module | contents |
//! |---|---|
//! | [`units`] | newtypes for drive-side and user-side quantities |
//! | [`scale`] | counts ↔ user units, drive units (0x60A9, 0x60AA), polarity, modulo, torque |
//! | [`cia402`] | Statusword, Controlword, power state machine, modes, error codes |
//! | [`compensation`] | backlash and pitch error between drive and load |
//! | [`supervision`] | limits that trip the axis, reaction to a trip, brake, fault reset |
//! | [`homing`] | homing by the drive: methods and parameters |
//! | [`setpoint`] | hold, moves, ramps, streams, tables, gears; advanced once per cycle |
//! | [`group`] | several axes: straight lines, synchronous arrival |
//! | [`status`] | status of an axis, trips, reasons for a rejected command |
//!
//! [`Axis`] connects them: commands in, limited set-points out. [`Limits`] holds in every cycle;
//! [`Loops`] closes position loops in CSV and CST.

#![deny(missing_docs)]
#![forbid(unsafe_code)]

mod axis;
pub mod cia402;
pub mod compensation;
pub mod group;
pub mod homing;
mod limits;
mod position_loop;
mod profile_mode;
pub mod scale;
pub mod sercos;
pub mod setpoint;
pub mod status;
pub mod supervision;
mod touch_probe;
pub mod units;

pub use axis::{
    Axis, AxisConfig, Command, ConfigError, Delivery, HomeReference, Inputs, Losses, MAX_RATE,
    MIN_RATE, Outputs, SecondEncoder,
};
pub use cia402::{Controlword, HaltOption, Mode, Modes, QuickStopOption, State, Statusword};
pub use compensation::Compensation;
pub use homing::{Homing, HomingError};
pub use limits::{LimitError, Limits};
pub use position_loop::{FeedForward, Loops, PositionPid, VelocityLoop};
pub use scale::{AccelerationUnit, Scale, ScaleError, VelocityBase, VelocityUnit};
pub use sercos::{ControlOutput, DriveWords, SercosWords};
pub use status::{
    AxisStatus, CommandError, DriveFault, EnableBlocker, HomingStatus, PositionValidity,
    PowerLossCause, StopPhase, StopStatus, Trip,
};
pub use supervision::{Brake, FaultReset, StopMethod, Supervision, TorqueWatch};
pub use touch_probe::{Edge, Probe, ProbeStatus, Source};
