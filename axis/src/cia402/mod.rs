//! CiA 402 (IEC 61800-7-201): the words, the power state machine, the modes and the error codes.
//!
//! Everything is a table or a pure function of a table. Words and codes this crate does not know survive as themselves.

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
pub use step::{Memory, Power, Progress, Request, Step, step, step_in};
pub use words::{Controlword, Statusword};
