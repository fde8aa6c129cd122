//! The step and the place of an error.

use std::fmt;

use super::{DeviceRef, StepRef};
use crate::config::Step;

/// The step of a run in which an error occurred.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum FailedStep {
    BringUp,
    /// A step of the machine file's program.
    Program(StepRef),
}

impl From<&Step> for FailedStep {
    fn from(step: &Step) -> Self {
        Self::Program(step.into())
    }
}

impl fmt::Display for FailedStep {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::BringUp => f.write_str("bring-up"),
            Self::Program(step) => step.fmt(f),
        }
    }
}

/// The place of an error.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Location {
    Device(DeviceRef),
    /// A device or signal of the machine file, before the bus is known.
    Name(String),
}

impl fmt::Display for Location {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Device(device) => device.fmt(f),
            Self::Name(name) => write!(f, "`{name}`"),
        }
    }
}
