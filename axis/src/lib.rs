//! CiA 402 axes as pure functions: `(state, inputs, time) → (state, outputs)`.
//!
//! No I/O, no clock, no allocation, no panic: everything here may be called from the real-time cycle. Time arrives as
//! `dt_s`, process data as plain integers, and what leaves is the next Controlword and set-points.
//!
//! From the bottom up:
//!
//! | module | what lives there |
//! |---|---|
//! | [`units`] | newtypes for drive-side and user-side quantities |
//! | [`scale`] | counts ↔ user units, the drive's own units (0x60A9, 0x60AA), polarity, modulo, torque; what a drive says of them |
//! | [`limits`] | what an axis may never exceed; checked once, enforced every cycle |
//! | [`cia402`] | Statusword, Controlword, the power state machine, modes, error codes |
//! | [`loops`] | the position loops that the master closes in CSV and CST, and the offsets in CSP |
//! | [`supervision`] | what is supervised besides, what a trip does, brake, fault reset |
//! | [`probe`] | touch probes |
//! | [`profile`] | the drive's own profiles (PP, PV): the handshake |
//! | [`homing`] | homing through the drive: parameters, sequence |
//! | [`setpoint`] | hold, trapezoidal and jerk-limited moves, ramps; each advanced one cycle at a time |
//! | [`group`] | several axes: straight lines, arriving together, stopping together |
//! | [`axis`] | one axis: commands in, guarded set-points out, supervision in between |
//! | [`status`] | what an axis reports, and the reasons for which it stops or refuses |

#![forbid(unsafe_code)]

pub mod axis;
pub mod cia402;
pub mod group;
pub mod homing;
pub mod limits;
pub mod loops;
pub mod probe;
pub mod profile;
pub mod scale;
pub mod setpoint;
pub mod status;
pub mod supervision;
pub mod units;

pub use axis::{Axis, AxisConfig, Command, ConfigError, Inputs, Outputs};
pub use cia402::{
    Controlword, HaltOption, Mode, ModeStatus, Modes, QuickStopOption, State, Statusword,
};
pub use homing::{Homing, HomingError};
pub use limits::{LimitError, Limits};
pub use loops::{FeedForward, Loops, PositionPid, VelocityLoop};
pub use probe::{Edge, Probe, ProbeStatus, Source};
pub use scale::{AccelerationUnit, Scale, ScaleError, VelocityBase, VelocityUnit};
pub use status::{
    AxisStatus, DriveFault, HomingStatus, Refused, StopPhase, StopStatus, Trip, Waiting,
};
pub use supervision::{Brake, FaultReset, StopMethod, Supervision, TorqueWatch};
