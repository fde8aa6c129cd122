//! How frames are received.

use std::fmt;

/// How frames are received from a network interface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum SocketKind {
    /// From a ring in memory that the kernel shares.
    #[default]
    Ring,
    /// By one system call per frame.
    Packet,
}

impl SocketKind {
    pub const ALL: &[Self] = &[Self::Ring, Self::Packet];

    /// Returns the name in the machine file.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Ring => "ring",
            Self::Packet => "packet",
        }
    }
}

impl fmt::Display for SocketKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}
