//! How a device is located on the bus.

use std::fmt;

/// How a device is located on the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Locator {
    /// The position; the first device after the MainDevice has 0.
    Position(u16),
    /// The configured station alias (register 0x0012).
    Alias(u16),
    /// The explicit device identification (requested through AL control, or ID switch).
    Id(u16),
    /// The place behind the head of a segment; the next device has 1.
    Behind(SegmentHead, u16),
}

/// How the first device of a segment is located.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SegmentHead {
    Alias(u16),
    Id(u16),
}

impl SegmentHead {
    #[must_use]
    pub const fn locator(self) -> Locator {
        match self {
            Self::Alias(alias) => Locator::Alias(alias),
            Self::Id(id) => Locator::Id(id),
        }
    }
}

impl fmt::Display for Locator {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Position(n) => write!(f, "position {n}"),
            Self::Alias(n) => write!(f, "alias {n}"),
            Self::Id(n) => write!(f, "id {n}"),
            Self::Behind(head, n) => write!(f, "place {n} behind {}", head.locator()),
        }
    }
}
