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

    /// Returns the problem at that position.
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
            Self::Missing { .. }
                | Self::UnknownPdoReference(_)
                | Self::Number { .. }
                | Self::HexBytes { .. }
        )
    }
}

/// The problem of an unusable ESI file.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum EsiProblem {
    /// The text is not well-formed XML.
    #[error("not well-formed XML: {0}")]
    Syntax(String),
    /// The file ends inside this element.
    #[error("the file ends inside <{0}>")]
    Truncated(String),
    /// The file ends inside a tag.
    #[error("the file ends inside a tag or a comment")]
    TruncatedTag,
    /// The root element is not `EtherCATInfo`; contains its name.
    #[error(
        "the root element is <{0}>, an ESI file starts with <EtherCATInfo>, a file of modules with <EtherCATModule>"
    )]
    NotEsi(String),
    /// The file does not begin with a tag.
    #[error("not XML: there is no < at the start")]
    NotXml,
    /// The file has no element.
    #[error("there is no XML element in the file")]
    Empty,
    /// A mandatory element or attribute is missing.
    #[error("{what} is missing")]
    Missing {
        /// The element or attribute.
        what: &'static str,
    },
    /// No PDO of the file has this `RefName`.
    #[error("no PDO of this file has the RefName {0:?}")]
    UnknownPdoReference(String),
    /// A number is malformed or out of range.
    #[error("{what} {text:?} is not a number that fits ({min} to {max})")]
    Number {
        /// The element or attribute.
        what: &'static str,
        /// The text in the file.
        text: String,
        /// The smallest accepted value.
        min: i128,
        /// The largest accepted value.
        max: i128,
    },
    /// A text is not a sequence of hexadecimal bytes.
    #[error("{what} {text:?} is not a sequence of hexadecimal bytes")]
    HexBytes {
        /// The element or attribute.
        what: &'static str,
        /// The text in the file.
        text: String,
    },
    /// The elements are nested too deeply.
    #[error("elements are nested deeper than {limit}")]
    TooDeep {
        /// The limit of the reader.
        limit: usize,
    },
    /// The contents exceed a limit of the reader.
    #[error("{what} exceed {limit}, which no device needs")]
    TooLarge {
        /// The element or attribute.
        what: &'static str,
        /// The limit of the reader.
        limit: usize,
    },
}
