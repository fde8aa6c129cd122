//! Fault stories: what stopped a run, on which device, and what was seen around it.
//!
//! - [`look`]: asks the SubDevices over the wire, after a stop and before they are sent to Init; bounded in time;
//! - [`evidence`]: everything that is known then, as plain data;
//! - [`ports`]: who is connected to which port of whom;
//! - [`cause`]: what stops a run, and how it is told;
//! - [`diagnose`]: which device, which cause: a pure function of the evidence;
//! - [`page`]: the whole story as data for a file.
//!
//! What to do about a cause is the command line's to say.

pub mod cause;
pub mod diagnose;
pub mod evidence;
pub mod look;
pub mod page;
pub mod ports;

pub use cause::{Cause, Diagnosis};
pub use diagnose::diagnose;
pub use evidence::{DeviceEvidence, Evidence};
pub use look::{Look, Witnessed};
pub use page::Story;
