//! Homing by the drive (mode 6): handshake and parameters.
//!
//! `Sequence` is the handshake, which is the same for all methods. [`Homing`] contains the
//! parameters to write before homing: 0x6098, 0x6099, 0x609A, 0x607C; maxon: 0x30B0, 0x30B1,
//! 0x30B2.
//!
//! ```
//! use ecaxis_axis::homing::{Homing, method};
//!
//! // Method 35 takes the present position.
//! let homing = Homing::by(35);
//! assert!(!method(homing.method).unwrap().needs.home_switch);
//! ```

mod parameters;
mod state_machine;

pub use parameters::{Homing, HomingObject, METHODS, Method, Needs, ParameterError, method};
pub use state_machine::HomingError;
pub(crate) use state_machine::{HomingInputs, HomingOutputs, Outcome, Sequence};
