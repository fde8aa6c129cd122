//! What can go wrong.

use std::fmt;

use serde_json::Value;

/// An operation was not carried out.
#[derive(Clone, PartialEq, Eq, Default)]
pub struct Error {
    /// The code of `docs/server.md`; also `lost`, `protocol` and `system`.
    pub code: Box<str>,
    /// The axis or device; empty without one.
    pub device: Box<str>,
    /// The operation, such as `move`.
    pub step: Box<str>,
    /// Why.
    pub cause: Box<str>,
    /// What to do, if the server knows it.
    pub help: Option<Box<str>>,
    /// The abort code of an SDO transfer.
    pub abort_code: Option<u32>,
}

/// The kinds of errors that a program may handle differently.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ErrorKind {
    /// The machine has refused a command. Nothing has changed.
    Refused,
    /// A command has begun and did not reach its end, or another one has replaced it.
    Failed,
    /// Another client owns the motion, or the lease has ended.
    NotOwner,
    /// The bus is not in Op.
    NotUp,
    /// A device has aborted an SDO transfer.
    Aborted,
    /// No outcome in time.
    TimedOut,
    /// The connection is of no use any more: attach again.
    Lost,
    /// A mistake of this program, such as an unknown name.
    Invalid,
}

impl Error {
    pub(crate) fn new(code: &str, cause: impl Into<Box<str>>) -> Self {
        Self {
            code: code.into(),
            cause: cause.into(),
            ..Self::default()
        }
    }

    pub(crate) fn lost(cause: impl Into<Box<str>>) -> Self {
        Self::new("lost", cause).help("attach again")
    }

    pub(crate) fn protocol(cause: impl Into<Box<str>>) -> Self {
        Self::new("protocol", cause).help("attach again")
    }

    pub(crate) fn help(mut self, help: &str) -> Self {
        self.help = Some(help.into());
        self
    }

    /// Adds where it happened.
    pub(crate) fn at(mut self, step: &str, device: &str) -> Self {
        self.step = step.into();
        self.device = device.into();
        self
    }

    /// Reads the object `error` of an answer.
    pub(crate) fn of_answer(error: &Value) -> Self {
        let text = |key: &str| error.get(key).and_then(Value::as_str).map(Into::into);
        let abort_code = error.get("abort_code").and_then(Value::as_u64);
        Self {
            code: text("code").unwrap_or_else(|| "protocol".into()),
            cause: text("message").unwrap_or_else(|| "the server gives no reason".into()),
            help: text("help"),
            abort_code: abort_code.and_then(|code| u32::try_from(code).ok()),
            ..Self::default()
        }
    }

    /// Returns the kind of the error.
    #[must_use]
    pub fn kind(&self) -> ErrorKind {
        match &*self.code {
            "refused" => ErrorKind::Refused,
            "failed" | "replaced" => ErrorKind::Failed,
            "no_lease" | "not_owner" => ErrorKind::NotOwner,
            "not_up" => ErrorKind::NotUp,
            "aborted" => ErrorKind::Aborted,
            "timeout" => ErrorKind::TimedOut,
            "lost" | "protocol" | "system" => ErrorKind::Lost,
            _ => ErrorKind::Invalid,
        }
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !self.device.is_empty() {
            write!(f, "{}: ", self.device)?;
        }
        write!(f, "{}: {} ({})", self.step, self.cause, self.code)?;
        match &self.help {
            Some(help) => write!(f, "\nhelp: {help}"),
            None => Ok(()),
        }
    }
}

/// As `Display`: a `main` that returns the error prints it so.
impl fmt::Debug for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl std::error::Error for Error {}
