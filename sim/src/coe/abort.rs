//! SDO abort codes (CiA 301 table 22, ETG.1000.6 table 41).

use std::fmt;

/// An SDO abort code (CiA 301 table 22, ETG.1000.6 table 41).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Abort(pub u32);

impl Abort {
    pub(crate) const TOGGLE: Self = Self(0x0503_0000);
    pub(crate) const TIMEOUT: Self = Self(0x0504_0000);
    pub(crate) const COMMAND: Self = Self(0x0504_0001);
    pub(crate) const OUT_OF_MEMORY: Self = Self(0x0504_0005);
    pub(crate) const UNSUPPORTED_ACCESS: Self = Self(0x0601_0000);
    pub(crate) const WRITE_ONLY: Self = Self(0x0601_0001);
    pub(crate) const READ_ONLY: Self = Self(0x0601_0002);
    /// Entries may change only while subindex 0 is 0.
    pub(crate) const COUNT_NOT_ZERO: Self = Self(0x0601_0003);
    /// Objects of variable length do not support complete access.
    pub(crate) const VARIABLE_LENGTH: Self = Self(0x0601_0004);
    pub(crate) const EXCEEDS_MAILBOX: Self = Self(0x0601_0005);
    /// Process data write the object.
    pub(crate) const MAPPED: Self = Self(0x0601_0006);
    pub(crate) const NO_OBJECT: Self = Self(0x0602_0000);
    pub(crate) const NOT_MAPPABLE: Self = Self(0x0604_0041);
    pub(crate) const MAPPING_TOO_LONG: Self = Self(0x0604_0042);
    pub(crate) const INCOMPATIBLE: Self = Self(0x0604_0043);
    /// The data length differs from the announced length.
    pub(crate) const LENGTH: Self = Self(0x0607_0010);
    pub(crate) const TOO_LONG: Self = Self(0x0607_0012);
    pub(crate) const TOO_SHORT: Self = Self(0x0607_0013);
    pub(crate) const NO_SUBINDEX: Self = Self(0x0609_0011);
    pub(crate) const VALUE: Self = Self(0x0609_0030);
    pub(crate) const VALUE_TOO_HIGH: Self = Self(0x0609_0031);
    pub(crate) const VALUE_TOO_LOW: Self = Self(0x0609_0032);
    pub(crate) const NOT_STORED: Self = Self(0x0800_0020);
    pub(crate) const WRONG_STATE: Self = Self(0x0800_0022);
}

impl fmt::Display for Abort {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "SDO abort 0x{:08x}", self.0)
    }
}
