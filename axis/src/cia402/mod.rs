//! CiA 402 (IEC 61800-7-201): Controlword, Statusword, power state machine, modes and error codes.
//!
//! Every item is a table or a pure function of a table. Unknown words and codes keep their value.

pub mod bits;
pub mod fault;
pub mod mode;
pub mod option;
pub mod state;
pub mod step;
pub mod words;

pub use bits::{HomingState, ModeCommand, ModeStatus};
pub use fault::{Description, describe};
pub use mode::{Mode, Modes};
pub use option::{Deceleration, HaltOption, QuickStopOption};
pub use state::State;
pub use step::{Power, PowerProgress, PowerState, Request, Step, step, step_in};
pub use words::{Controlword, Statusword};
