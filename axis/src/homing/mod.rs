//! Homing through the drive (mode 6): how it is asked for, and what it is to do.
//!
//! [`Sequence`] is the handshake, the same for every method. [`Homing`] is the set of parameters that goes into the drive's
//! objects before (0x6098, 0x6099, 0x609A, 0x607C; maxon: 0x30B0, 0x30B1, 0x30B2).

mod parameters;
mod sequence;

pub use parameters::{Homing, HomingObject, METHODS, Method, Needs, ParameterError, method};
pub use sequence::{HomingError, Order, Outcome, Seen, Sequence};
