//! What chip an ESC is: the information registers 0x0000–0x0009 and what follows from them. Neither an
//! ESI nor an EEPROM image names it; [`EscInfo::fitting`] takes the smallest of the common ones that can do what they
//! ask for, and no more: a MainDevice that relies on more meets its limits here first.

/// Bits of the feature register 0x0008.
pub mod feature {
    /// Distributed clocks: receive times, and system time where the device enables it.
    pub const DC: u16 = 0x0004;
    /// Distributed clocks count 64 bits.
    pub const DC_64_BIT: u16 = 0x0008;
    /// LRW passes unprocessed.
    pub const NO_LRW: u16 = 0x0200;
    /// Auto-activation and plausibility check of SYNC0 (0x0981 bits 3 to 7, 0x0984).
    pub const ENHANCED_SYNC: u16 = 0x0100;
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

    /// EtherCAT IP core 3.0.10 in an FPGA: as many units as the device was built with, no E-bus.
    pub const IP_CORE: Self = Self {
        kind: 0x04,
        revision: 3,
        build: 0x000a,
        features: 0x0180 | feature::DC | feature::DC_64_BIT,
        eeprom: 0,
        eeprom_read_ns: 300_000,
        receive_times: [[0; 4]; 4],
        ..Self::ET1100
    };

    /// The smallest chip in which a device fits, with an EEPROM of `eeprom_bytes` that is read quickly, so that many
    /// devices are brought up in little time.
    #[must_use]
    pub fn fitting(needs: &Needs, eeprom_bytes: usize) -> Self {
        let port = |n: u8| needs.ports >> (2 * n) & 3;
        let ports = (0..4).filter(|n| port(*n) != 0).count();
        let ebus = (0..4).any(|n| port(n) == 2);
        let small = ports <= 3 && needs.fmmus <= 3 && needs.sync_managers <= 4;
        let mii = (0..4).filter(|n| port(*n) == 3).count();
        let et1200 = ebus && mii <= 1 && port(2) == 0;
        let mut info = if et1200 && small && needs.ram_kib <= Self::ET1200.ram_kib {
            // Its third port is number 3 and may be left unused.
            Self {
                ports: Some(needs.ports | u8::from(port(3) == 0) << 6),
                ..Self::ET1200
            }
        } else if ebus {
            Self::ET1100
        } else if small && needs.clock && needs.ram_kib <= Self::LAN9252.ram_kib {
            Self {
                ports: Some(needs.ports | u8::from(port(2) == 0) << 4),
                ..Self::LAN9252
            }
        } else {
            let clock = if needs.clock {
                0
            } else {
                feature::DC | feature::DC_64_BIT
            };
            Self {
                fmmus: needs.fmmus.max(1),
                sync_managers: needs.sync_managers,
                ram_kib: needs.ram_kib.max(1).next_power_of_two().min(60),
                features: Self::IP_CORE.features & !clock,
                ..Self::IP_CORE
            }
        };
        info.ram_kib = info.ram_kib.max(needs.ram_kib);
        if needs.sync {
            info.features |= feature::ENHANCED_SYNC;
        }
        if needs.no_lrw {
            info.features |= feature::NO_LRW;
        }
        if eeprom_bytes > 2048 {
            info.eeprom |= eeprom::TWO_BYTE_ADDRESS;
        }
        Self {
            eeprom_read_ns: QUICK_EEPROM_NS,
            ..info
        }
    }

    #[must_use]
    pub fn has(&self, feature: u16) -> bool {
        self.features & feature == feature
    }
}

const QUICK_EEPROM_NS: u64 = 50_000;

/// What a device asks of its chip.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Needs {
    /// Two bits a port as in 0x0007.
    pub ports: u8,
    pub fmmus: u8,
    pub sync_managers: u8,
    pub ram_kib: u8,
    /// A system time.
    pub clock: bool,
    /// SYNC0 for its application; that a newer chip has the enhanced activation is taken for granted.
    pub sync: bool,
    /// It is known not to process LRW.
    pub no_lrw: bool,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_gets_the_smallest_chip_that_does() {
        let needs = |ports, fmmus, sync_managers, ram_kib, clock| Needs {
            ports,
            fmmus,
            sync_managers,
            ram_kib,
            clock,
            sync: false,
            no_lrw: false,
        };
        // Needs, then 0x0000 and 0x0004–0x0009 of the chip (port descriptor 0: as the device has it).
        let rows = [
            (needs(0x3b, 0, 0, 0, true), 0x11, [8, 8, 8, 0, 0xfc, 0]),
            (needs(0x0a, 1, 1, 1, false), 0x12, [3, 4, 1, 0x4a, 0xfc, 0]),
            (needs(0x0f, 3, 4, 4, true), 0xc0, [3, 4, 4, 0x1f, 0xcc, 1]),
            (needs(0x0a, 3, 4, 2, true), 0x11, [8, 8, 8, 0, 0xfc, 0]),
            (needs(0xaa, 1, 1, 1, true), 0x11, [8, 8, 8, 0, 0xfc, 0]),
            (needs(0x0f, 5, 6, 20, true), 0x04, [5, 6, 32, 0, 0x8c, 1]),
            (needs(0x0f, 2, 2, 1, false), 0x04, [2, 2, 1, 0, 0x80, 1]),
            (needs(0x0f, 0, 0, 0, false), 0x04, [1, 0, 1, 0, 0x80, 1]),
        ];
        for (needs, kind, expected) in rows {
            let info = EscInfo::fitting(&needs, 2048);
            let [low, high] = info.features.to_le_bytes();
            let ports = info.ports.unwrap_or(0);
            let seen = [
                info.fmmus,
                info.sync_managers,
                info.ram_kib,
                ports,
                low,
                high,
            ];
            assert_eq!((info.kind, seen), (kind, expected), "{needs:?}");
        }
        let with_sync = Needs {
            sync: true,
            ..needs(0x0a, 3, 4, 1, true)
        };
        let info = EscInfo::fitting(&with_sync, 4096);
        assert_eq!((info.features, info.eeprom), (0x01fc, 0x00c0));
    }
}
