//! Datagrams (ETG.1000.4 clause 5.4): commands and headers.
//!
//! ```
//! use ecaxis_ecat::datagram::{Command, Header};
//!
//! let command = Command::FPRD;
//! let header = Header { command, index: 7, address: 0x0130_1001, len: 2, more: false };
//! assert_eq!(Header::parse(&header.emit()), header);
//! assert_eq!(header.command.name(), "FPRD");
//! ```

/// The EtherType of EtherCAT.
pub const ETHERTYPE: u16 = 0x88a4;
/// The length in bytes of a datagram's header.
pub const HEADER: usize = 10;
/// The length in bytes of the working counter behind the data.
pub const WORKING_COUNTER: usize = 2;

/// Commands of datagrams (ETG.1000.4 Table 12 and the following).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Command(pub u8);

impl Command {
    /// No operation: no device processes the datagram.
    pub const NOP: Self = Self(0);
    /// Auto-increment physical read.
    pub const APRD: Self = Self(1);
    /// Auto-increment physical write.
    pub const APWR: Self = Self(2);
    /// Auto-increment physical read and write.
    pub const APRW: Self = Self(3);
    /// Configured-address physical read.
    pub const FPRD: Self = Self(4);
    /// Configured-address physical write.
    pub const FPWR: Self = Self(5);
    /// Configured-address physical read and write.
    pub const FPRW: Self = Self(6);
    /// Broadcast read.
    pub const BRD: Self = Self(7);
    /// Broadcast write.
    pub const BWR: Self = Self(8);
    /// Broadcast read and write.
    pub const BRW: Self = Self(9);
    /// Logical memory read.
    pub const LRD: Self = Self(10);
    /// Logical memory write.
    pub const LWR: Self = Self(11);
    /// Logical memory read and write.
    pub const LRW: Self = Self(12);
    /// Auto-increment physical read, multiple write.
    pub const ARMW: Self = Self(13);
    /// Configured-address physical read, multiple write.
    pub const FRMW: Self = Self(14);

    /// Returns its abbreviation; empty for unknown commands.
    #[must_use]
    pub const fn name(self) -> &'static str {
        const NAMES: [&str; 15] = [
            "NOP", "APRD", "APWR", "APRW", "FPRD", "FPWR", "FPRW", "BRD", "BWR", "BRW", "LRD",
            "LWR", "LRW", "ARMW", "FRMW",
        ];
        if (self.0 as usize) < NAMES.len() {
            NAMES[self.0 as usize]
        } else {
            "?"
        }
    }

    /// True if it has one 32-bit address instead of two 16-bit addresses.
    #[must_use]
    pub const fn is_logical(self) -> bool {
        matches!(self, Self::LRD | Self::LWR | Self::LRW)
    }

    /// True if SubDevices increment the address.
    #[must_use]
    pub const fn is_positional(self) -> bool {
        matches!(
            self,
            Self::APRD | Self::APWR | Self::APRW | Self::ARMW | Self::BRD | Self::BWR | Self::BRW
        )
    }

    /// True if SubDevices put data into the datagram.
    #[must_use]
    pub const fn reads(self) -> bool {
        !matches!(
            self,
            Self(0) | Self::APWR | Self::FPWR | Self::BWR | Self::LWR
        )
    }

    /// True if SubDevices take data from the datagram. ARMW and FRMW read from one device and write
    /// to the others; they count as reading.
    #[must_use]
    pub const fn writes(self) -> bool {
        matches!(
            self,
            Self::APWR
                | Self::APRW
                | Self::FPWR
                | Self::FPRW
                | Self::BWR
                | Self::BRW
                | Self::LWR
                | Self::LRW
        )
    }
}

/// The header of one datagram.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Header {
    /// The command.
    pub command: Command,
    /// Chosen by the MainDevice; SubDevices return it unchanged.
    pub index: u8,
    /// Low half: position or station address; high half: register. One number for logical commands.
    pub address: u32,
    /// The length of the data in bytes, at most 2047.
    pub len: u16,
    /// True if another datagram follows in the frame.
    pub more: bool,
}

impl Header {
    /// Parses a header. Every content is valid.
    #[must_use]
    pub const fn parse(bytes: &[u8; HEADER]) -> Self {
        let [command, index, a0, a1, a2, a3, l0, l1, ..] = *bytes;
        let len = u16::from_le_bytes([l0, l1]);
        Self {
            command: Command(command),
            index,
            address: u32::from_le_bytes([a0, a1, a2, a3]),
            len: len & 0x07ff,
            more: len & 0x8000 != 0,
        }
    }

    /// Returns the bytes, with an empty event field.
    #[must_use]
    pub const fn emit(&self) -> [u8; HEADER] {
        let [a0, a1, a2, a3] = self.address.to_le_bytes();
        let [l0, l1] = (self.len & 0x07ff | if self.more { 0x8000 } else { 0 }).to_le_bytes();
        [self.command.0, self.index, a0, a1, a2, a3, l0, l1, 0, 0]
    }
}
