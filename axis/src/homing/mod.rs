//! Homing by the drive (mode 6): handshake and parameters.
//!
//! [`Sequence`] is the handshake, which is the same for all methods. [`Homing`] contains the
//! parameters to write before homing: 0x6098, 0x6099, 0x609A, 0x607C; maxon: 0x30B0, 0x30B1,
//! 0x30B2.

mod parameters;
mod state_machine;

pub use parameters::{Homing, HomingObject, METHODS, Method, Needs, ParameterError, method};
pub use state_machine::{HomingError, HomingInputs, HomingOutputs, Outcome, Sequence};
