//! What a failed drive reports in addition to its error code.

use std::fmt;

use ecaxis_ecat::mailbox::soe::class_1_texts;

use super::{DiagnosisMessage, EmergencyReport};
use crate::config::LimitConflict;

/// What a Sercos drive says about a failure. `None`: it did not answer in time.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SercosDiagnosis {
    /// S-0-0390.
    pub number: Option<u32>,
    /// S-0-0095.
    pub message: Option<String>,
    /// S-0-0011.
    pub class_1: Option<u16>,
}

impl fmt::Display for SercosDiagnosis {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(number) = self.number {
            write!(f, "; diagnostic number {number:#x} (S-0-0390)")?;
        }
        if let Some(message) = &self.message {
            write!(f, "; it says \"{message}\" (S-0-0095)")?;
        }
        if let Some(class_1) = self.class_1.filter(|bits| *bits != 0) {
            let texts: Vec<_> = class_1_texts(class_1).collect();
            write!(f, "; class 1: {} (S-0-0011)", texts.join(", "))?;
        }
        Ok(())
    }
}

/// What a failed device reports in addition to its error code.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct DriveReport {
    /// The device's last emergencies, oldest first.
    pub emergencies: Vec<EmergencyReport>,
    /// The device's diagnosis messages (0x10F3), newest first.
    pub history: Vec<DiagnosisMessage>,
    /// The drive's own limits that the machine file exceeds.
    pub limits: Vec<LimitConflict>,
    /// What a Sercos drive says.
    pub sercos: Option<SercosDiagnosis>,
}

impl fmt::Display for DriveReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for report in &self.emergencies {
            write!(f, "; {}", report.emergency)?;
        }
        for message in &self.history {
            write!(f, "; diagnosis history: {message}")?;
        }
        if let Some(sercos) = &self.sercos {
            sercos.fmt(f)?;
        }
        Ok(())
    }
}
