//! CiA 402 (IEC 61800-7-201): Controlword, Statusword, power state machine, modes and error codes.
//!
//! Every item is a table or a pure function of a table. Unknown words and codes keep their value.
//!
//! ```
//! use ecaxis_axis::cia402::{Power, PowerState, Request, Statusword, step};
//!
//! let mut drive = PowerState::new();
//! let request = Request { power: Power::Enabled, ..Request::default() };
//! // Switch on disabled → Ready to switch on → Switched on → Operation enabled.
//! let words = [0x0250, 0x0231, 0x0233].map(|word| {
//!     let statusword = Statusword::from_bits_retain(word);
//!     let (next, step) = step(drive, statusword, request, 0.001);
//!     drive = next;
//!     step.controlword.bits()
//! });
//! assert_eq!(words, [0x0006, 0x0007, 0x000f]);
//! ```

mod bits;
mod fault;
mod mode;
mod option;
mod state;
mod step;
mod words;

pub(crate) use bits::{HomingState, ModeCommand, ModeStatus};
pub use fault::{Description, describe};
pub use mode::{Mode, Modes};
pub use option::{Deceleration, HaltOption, QuickStopOption};
pub use state::State;
pub(crate) use step::step_in;
pub use step::{Power, PowerProgress, PowerState, Request, Step, step};
pub use words::{Controlword, Statusword};
