//! What a Sercos drive says about a failure.

use std::fmt;

use ecaxis_ecat::mailbox::soe::class_1_texts;

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
