//! Fault reports: what stopped a run, on which device, and what was observed around it.
//!
//! - [`snapshot`]: reads the SubDevices after a stop and before they are set to Init; bounded in
//!   time;
//! - [`evidence`]: everything that is known then, as plain data;
//! - [`cause`]: the causes that stop a run, with their texts;
//! - [`mod@diagnose`]: finds device and cause, a pure function of the evidence;
//! - [`report`]: the whole fault report as data for a file.
//!
//! Hints for the user come from the command line.

pub mod cause;
mod class;
pub mod diagnose;
pub mod evidence;
pub mod report;
pub mod snapshot;

pub use cause::{DiagnosedCause, Diagnosis};
pub use diagnose::diagnose;
pub use evidence::{DeviceEvidence, Evidence};
pub use report::FaultReport;
pub use snapshot::{DeviceSnapshot, Witnessed};
