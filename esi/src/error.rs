//! Errors in an ESI file.

use crate::model::Position;

/// An ESI file cannot be used. Displays as `line:column path: problem`.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{} {}: {}", .0.position, .0.path, .0.problem)]
pub struct EsiError(Box<ErrorInner>);

/// Boxed to keep results small: every step of the reader may return an error, and few do.
#[derive(Debug, Clone, PartialEq, Eq)]
struct ErrorInner {
    position: Position,
    path: String,
    problem: EsiProblem,
}

impl EsiError {
    pub(crate) fn new(position: Position, path: String, problem: EsiProblem) -> Self {
        Self(Box::new(ErrorInner {
            position,
            path,
            problem,
        }))
    }

    /// Returns line and column of the faulty element.
    #[must_use]
    pub fn position(&self) -> Position {
        self.0.position
    }

    /// Returns the element path, such as `EtherCATInfo/Descriptions/Devices/Device[1]/Sm[3]`.
    #[must_use]
    pub fn path(&self) -> &str {
        &self.0.path
    }

    #[must_use]
    pub fn problem(&self) -> &EsiProblem {
        &self.0.problem
    }
}

impl EsiProblem {
    /// True if the problem invalidates one element only: the surrounding text is readable, and no
    /// limit is exceeded.
    pub(crate) fn is_of_one_element(&self) -> bool {
        matches!(
            self,
            Self::Missing { .. } | Self::Number { .. } | Self::HexBytes { .. }
        )
    }
}

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum EsiProblem {
    #[error("not well-formed XML: {0}")]
    Syntax(String),
    #[error("the file ends inside <{0}>")]
    Truncated(String),
    #[error("the file ends inside a tag or a comment")]
    TruncatedTag,
    #[error(
        "the root element is <{0}>, an ESI file starts with <EtherCATInfo>, a file of modules with <EtherCATModule>"
    )]
    NotEsi(String),
    #[error("there is no XML element in the file")]
    Empty,
    #[error("{what} is missing")]
    Missing { what: &'static str },
    #[error("{what} {text:?} is not a number that fits ({min} to {max})")]
    Number {
        what: &'static str,
        text: String,
        min: i128,
        max: i128,
    },
    #[error("{what} {text:?} is not a sequence of hexadecimal bytes")]
    HexBytes { what: &'static str, text: String },
    #[error("elements are nested deeper than {limit}")]
    TooDeep { limit: usize },
    #[error("{what} exceed {limit}, which no device needs")]
    TooLarge { what: &'static str, limit: usize },
}
