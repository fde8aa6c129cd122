//! What a run reports: errors, progress, events and the summary, as plain data. No I/O.
//!
//! - [`Error`]: step, place and [`Cause`] of a failure;
//! - [`Progress`], [`Status`]: what an [`Observer`] receives during a run;
//! - [`EventLine`], [`EmergencyLine`], [`DiagnosisMessage`]: what the cycle and the devices
//!   reported;
//! - [`Summary`]: the result.

pub mod bring_up;
mod cause_text;
mod device_error;
mod device_log;
mod diagnosis_message;
mod drive_report;
mod emergencies;
mod error;
mod error_place;
pub mod events;
mod progress;
pub(crate) mod summary;

pub(crate) use device_error::EEPROM_TIMEOUT;
pub use device_error::{DeviceRef, EepromError, StateError};
pub use device_log::DeviceLog;
pub use diagnosis_message::{DiagnosisKind, DiagnosisMessage};
pub use drive_report::{DriveReport, SercosDiagnosis};
pub use emergencies::{EmergencyLine, EmergencyLog, EmergencyReport};
pub use error::{Cause, Error, ModuleDifference};
pub use error_place::{FailedStep, Location};
pub use events::EventLine;
pub use progress::{
    AxisLine, DevicePlace, Home, Observer, ProbeCapture, Progress, Status, StepRef, UnknownDevice,
};
pub use summary::{
    AxisSummary, DeviceErrors, GatewaySummary, GroupStop, NodeSummary, Summary, ThreadSummary,
};
