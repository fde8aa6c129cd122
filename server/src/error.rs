//! Errors that clients receive.

use std::fmt;

use serde::Serialize;
use serde_json::{Map, Value, json};

use crate::lease::{LeaseError, Owner};

/// The kind of an error.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ErrorCode {
    BadRequest,
    UnknownOp,
    UnknownName,
    NoToken,
    ReadOnly,
    WrongOrigin,
    NoLease,
    NotOwner,
    NotUp,
    Refused,
    Failed,
    Replaced,
    Aborted,
    Timeout,
    TooLarge,
    Busy,
}

impl ErrorCode {
    /// Returns the HTTP status.
    #[must_use]
    pub fn status(self) -> u16 {
        match self {
            Self::BadRequest => 400,
            Self::NoToken => 401,
            Self::ReadOnly | Self::WrongOrigin => 403,
            Self::UnknownOp | Self::UnknownName => 404,
            Self::NoLease
            | Self::NotOwner
            | Self::NotUp
            | Self::Refused
            | Self::Failed
            | Self::Replaced
            | Self::Aborted => 409,
            Self::TooLarge => 413,
            Self::Busy => 429,
            Self::Timeout => 504,
        }
    }
}

/// An operation was not carried out.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct OpError {
    pub code: ErrorCode,
    pub message: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub help: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub owner: Option<Owner>,
    /// Further keys.
    #[serde(flatten)]
    pub more: Map<String, Value>,
}

impl OpError {
    #[must_use]
    pub fn new(code: ErrorCode, message: impl Into<String>) -> Self {
        Self {
            code,
            message: message.into(),
            help: None,
            owner: None,
            more: Map::new(),
        }
    }

    #[must_use]
    pub fn help(mut self, help: impl Into<String>) -> Self {
        self.help = Some(help.into());
        self
    }

    /// Adds a key.
    #[must_use]
    pub fn with(mut self, key: &str, value: impl Into<Value>) -> Self {
        self.more.insert(key.to_owned(), value.into());
        self
    }

    /// Returns the answer.
    #[must_use]
    pub fn answer(&self) -> Map<String, Value> {
        let mut answer = Map::new();
        answer.insert("ok".to_owned(), Value::Bool(false));
        answer.insert("error".to_owned(), json!(self));
        answer
    }
}

impl fmt::Display for OpError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for OpError {}

impl From<LeaseError> for OpError {
    fn from(error: LeaseError) -> Self {
        match error {
            LeaseError::NoLease => Self::new(ErrorCode::NoLease, "the motion has no owner")
                .help("take the lease with `take`"),
            LeaseError::Expired { silent, ttl } => {
                let (silent, ttl) = (silent.as_secs_f64(), ttl.as_secs_f64());
                let message = format!(
                    "the lease has expired: it was renewed {silent:.1} s ago, and lasts {ttl} s"
                );
                Self::new(ErrorCode::NoLease, message)
                    .help("take it again with `take`, and renew it in time with `renew`")
            }
            LeaseError::NotOwner(owner) => Self {
                owner: Some(owner.clone()),
                ..Self::new(
                    ErrorCode::NotOwner,
                    format!("`{}` owns the motion", owner.name),
                )
                .help("take the lease with `take` and \"force\": true")
            },
        }
    }
}
