//! Failures for the user: exit code, message and hints.

use ecaxis_master::report::Cause;

/// Exit code: the machine or the bus failed.
pub(crate) const FAILED: u8 = 1;
/// Exit code: the file or the command line is wrong.
pub(crate) const WRONG: u8 = 2;
/// Exit code: a signal ended the work without another failure (128 + SIGINT).
pub(crate) const INTERRUPTED: u8 = 130;

#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Failure {
    pub code: u8,
    /// The complete message. A list of problems is already formatted.
    pub message: String,
    pub hints: Vec<String>,
    /// A line printed after the hints.
    pub after: Option<String>,
}

impl Failure {
    pub fn new(code: u8, message: impl Into<String>) -> Self {
        Self {
            code,
            message: message.into(),
            hints: Vec::new(),
            after: None,
        }
    }

    /// The failure of work that a signal ended.
    pub fn interrupted() -> Self {
        Self::new(INTERRUPTED, Cause::Interrupted.to_string())
    }

    pub fn hint(mut self, hint: impl Into<String>) -> Self {
        self.hints.push(hint.into());
        self
    }
}
