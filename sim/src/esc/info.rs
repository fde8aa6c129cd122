//! What chip an ESC is: the information registers 0x0000–0x0009 and what follows from them. Neither an
//! ESI nor an EEPROM image says so.

/// Bits of the feature register 0x0008.
pub mod feature {
    /// Distributed clocks: receive times, and system time where the device enables it.
    pub const DC: u16 = 0x0004;
    /// Distributed clocks count 64 bits.
    pub const DC_64_BIT: u16 = 0x0008;
}

/// Bits of the EEPROM status 0x0502 that belong to the chip or its EEPROM.
pub mod eeprom {
    /// Reads bring 8 bytes, otherwise 4.
    pub const EIGHT_BYTES: u16 = 0x0040;
    /// Word addresses are two bytes on the I²C bus: an EEPROM of more than 16 Kibit.
    pub const TWO_BYTE_ADDRESS: u16 = 0x0080;
}

/// A kind of ESC. Sizes beyond what the simulator holds (8 FMMUs, 8 SyncManagers, 60 KiB) are cut.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EscInfo {
    /// 0x0000.
    pub kind: u8,
    /// 0x0001.
    pub revision: u8,
    /// 0x0002.
    pub build: u16,
    /// 0x0004.
    pub fmmus: u8,
    /// 0x0005.
    pub sync_managers: u8,
    /// 0x0006, process RAM in KiB.
    pub ram_kib: u8,
    /// 0x0007, two bits a port: 0 none, 1 not configured, 2 EBUS, 3 MII; `None`: as ESI or EEPROM image say.
    pub ports: Option<u8>,
    /// 0x0008, see [`feature`].
    pub features: u16,
    /// 0x0502, see [`eeprom`].
    pub eeprom: u16,
    /// Time a read or reload takes.
    pub eeprom_read_ns: u64,
    /// 0x0900–0x090F before anything was latched.
    pub receive_times: [[u8; 4]; 4],
}

impl EscInfo {
    pub const ET1100: Self = Self {
        kind: 0x11,
        revision: 0,
        build: 2,
        fmmus: 8,
        sync_managers: 8,
        ram_kib: 8,
        ports: None,
        features: 0x00fc,
        eeprom: eeprom::EIGHT_BYTES,
        eeprom_read_ns: 700_000,
        receive_times: [*b"Beck", *b"hoff", [0; 4], *b"Verl"],
    };

    /// Two EBUS ports, small memory.
    pub const ET1200: Self = Self {
        kind: 0x12,
        build: 0,
        fmmus: 3,
        sync_managers: 4,
        ram_kib: 1,
        ..Self::ET1100
    };

    /// Microchip LAN9252.
    pub const LAN9252: Self = Self {
        kind: 0xc0,
        revision: 2,
        build: 0,
        fmmus: 3,
        sync_managers: 4,
        ram_kib: 4,
        ports: None,
        features: 0x01cc,
        eeprom: eeprom::TWO_BYTE_ADDRESS,
        eeprom_read_ns: 300_000,
        receive_times: [[0; 4]; 4],
    };

    #[must_use]
    pub fn has(&self, feature: u16) -> bool {
        self.features & feature == feature
    }
}

/// An ET1100 without E-bus features in front of a large and fast EEPROM, for devices of which nothing else is known.
impl Default for EscInfo {
    fn default() -> Self {
        Self {
            features: 0x00cc,
            eeprom: eeprom::EIGHT_BYTES | eeprom::TWO_BYTE_ADDRESS,
            eeprom_read_ns: 50_000,
            receive_times: [[0; 4]; 4],
            ..Self::ET1100
        }
    }
}
