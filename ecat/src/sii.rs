//! The EEPROM of a SubDevice (SII): its words, its categories, and its interface (ETG.1000.4,
//! ETG.2010).
//!
//! ```
//! use ecaxis_ecat::sii::{FIRST_CATEGORY, HEADER_BYTES, category};
//!
//! assert_eq!(usize::from(2 * FIRST_CATEGORY), HEADER_BYTES);
//! assert_eq!(category::STRINGS, 10);
//! ```

/// The word address of the size, in KiBit minus one.
pub const SIZE: u16 = 0x3e;
/// The word address of the first category.
pub const FIRST_CATEGORY: u16 = 0x40;
/// The length in bytes of the part before the categories.
pub const HEADER_BYTES: usize = 0x80;

/// Category types.
pub mod category {
    /// Texts, which other categories refer to by number.
    pub const STRINGS: u16 = 10;
    /// Name, group, protocols.
    pub const GENERAL: u16 = 30;
    /// The use of each FMMU.
    pub const FMMU: u16 = 40;
    /// The SyncManagers.
    pub const SYNC_MANAGER: u16 = 41;
    /// The SyncManager that each FMMU maps.
    pub const FMMU_DETAILS: u16 = 42;
    /// Sync units.
    pub const SYNC_UNIT: u16 = 43;
    /// Inputs.
    pub const TX_PDO: u16 = 50;
    /// Outputs.
    pub const RX_PDO: u16 = 51;
    /// Distributed clocks.
    pub const DC: u16 = 60;
    /// The mark after the last category.
    pub const END: u16 = 0xffff;
}

/// The bits of [`EEPROM_CONTROL`](crate::registers::EEPROM_CONTROL).
pub mod control {
    /// Permits the write of this command.
    pub const WRITE_ENABLE: u16 = 0x0001;
    /// A read returns eight bytes, otherwise four.
    pub const EIGHT_BYTES: u16 = 0x0040;
    /// The bits of the command.
    pub const COMMAND: u16 = 0x0700;
    /// The command that reads.
    pub const READ: u16 = 0x0100;
    /// The command that writes a word.
    pub const WRITE: u16 = 0x0200;
    /// The command that loads the configuration area again.
    pub const RELOAD: u16 = 0x0400;
    /// The configuration area has a wrong checksum.
    pub const WRONG_CHECKSUM: u16 = 0x0800;
    /// The configuration area is not loaded.
    pub const NOT_LOADED: u16 = 0x1000;
    /// The chip did not acknowledge, or the command is invalid.
    pub const REFUSED: u16 = 0x2000;
    /// A write without [`WRITE_ENABLE`].
    pub const NOT_ENABLED: u16 = 0x4000;
    /// A command is in progress.
    pub const BUSY: u16 = 0x8000;
    /// All errors.
    pub const ERRORS: u16 = WRONG_CHECKSUM | NOT_LOADED | REFUSED | NOT_ENABLED;
}
