//! The chip of an ESC: the information registers 0x0000–0x0009 and derived properties.
//!
//! Neither an ESI nor an EEPROM image names the chip. The simulator selects the smallest
//! common chip with the required features and nothing more. A MainDevice that relies on further
//! features therefore fails in the simulation first.
//!
//! ```
//! use ecaxis_sim::{DeviceOptions, chip::EscInfo};
//!
//! let options = DeviceOptions { esc: Some(EscInfo::LAN9252), ..DeviceOptions::default() };
//! assert_eq!(options.esc.unwrap().sync_managers, 4);
//! ```

/// Bits of the feature register 0x0008.
pub(crate) mod feature {
    /// Distributed clocks: receive times, and system time if the device enables it.
    pub const DC: u16 = 0x0004;
    /// Distributed clocks have 64 bits.
    pub const DC_64_BIT: u16 = 0x0008;
    /// The chip does not process LRW.
    pub const NO_LRW: u16 = 0x0200;
    /// Auto-activation and plausibility check of SYNC0 (0x0981 bits 3 to 7, 0x0984).
    pub(crate) const ENHANCED_SYNC: u16 = 0x0100;
}

/// Bits of the EEPROM status 0x0502 that depend on the chip or its EEPROM.
pub mod eeprom {
    /// A read returns 8 bytes, otherwise 4.
    pub const EIGHT_BYTES: u16 = 0x0040;
    /// Word addresses take two bytes on the I²C bus: the EEPROM is larger than 16 Kibit.
    pub const TWO_BYTE_ADDRESS: u16 = 0x0080;
}

/// A type of ESC. Sizes above the limits of the simulator (8 FMMUs, 8 SyncManagers, 60 KiB) are
/// reduced.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EscInfo {
    /// Type, 0x0000.
    pub kind: u8,
    /// Revision, 0x0001.
    pub revision: u8,
    /// Build, 0x0002.
    pub build: u16,
    /// Number of FMMUs, 0x0004.
    pub fmmus: u8,
    /// Number of SyncManagers, 0x0005.
    pub sync_managers: u8,
    /// Process RAM in KiB, 0x0006.
    pub ram_kib: u8,
    /// Port descriptor 0x0007, two bits per port: 0 none, 1 not configured, 2 EBUS, 3 MII. `None`:
    /// from ESI or EEPROM image.
    pub ports: Option<u8>,
    /// Feature register 0x0008.
    pub features: u16,
    /// Chip bits of 0x0502, see [`eeprom`].
    pub eeprom: u16,
    /// The duration of an EEPROM read or reload in ns.
    pub eeprom_read_ns: u64,
    /// 0x0900–0x090F before any receive time was latched.
    pub receive_times: [[u8; 4]; 4],
}

impl EscInfo {
    /// Beckhoff ET1100.
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

    /// Beckhoff ET1200: two EBUS ports, small memory.
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

    /// EtherCAT IP core 3.0.10 in an FPGA. It has the number of units that the device needs, and no
    /// E-bus.
    pub(crate) const IP_CORE: Self = Self {
        kind: 0x04,
        revision: 3,
        build: 0x000a,
        features: 0x0180 | feature::DC | feature::DC_64_BIT,
        eeprom: 0,
        eeprom_read_ns: 300_000,
        receive_times: [[0; 4]; 4],
        ..Self::ET1100
    };

    /// Returns the smallest chip that fits the device, with an EEPROM of `eeprom_bytes`. EEPROM
    /// reads are fast, so many devices start up in a short time.
    #[must_use]
    pub(crate) fn fitting(needs: &ChipRequirements, eeprom_bytes: usize) -> Self {
        let port = |n: u8| needs.ports >> (2 * n) & 3;
        let ports = (0..4).filter(|n| port(*n) != 0).count();
        let ebus = (0..4).any(|n| port(n) == 2);
        let small = ports <= 3 && needs.fmmus <= 3 && needs.sync_managers <= 4;
        let mii = (0..4).filter(|n| port(*n) == 3).count();
        let et1200 = ebus && mii <= 1 && port(2) == 0;
        let mut info = if et1200 && small && needs.ram_kib <= Self::ET1200.ram_kib {
            // The third port has number 3 and may stay unused.
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
        Self {
            eeprom_read_ns: QUICK_EEPROM_NS,
            ..info.with_eeprom_of(eeprom_bytes)
        }
    }

    /// Returns the chip with an EEPROM that holds this many bytes.
    #[must_use]
    pub(crate) fn with_eeprom_of(mut self, bytes: usize) -> Self {
        if bytes > 2048 {
            self.eeprom |= eeprom::TWO_BYTE_ADDRESS;
        }
        self
    }

    #[must_use]
    pub(crate) fn has(&self, feature: u16) -> bool {
        self.features & feature == feature
    }
}

const QUICK_EEPROM_NS: u64 = 50_000;

/// The requirements of a device on its chip.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ChipRequirements {
    /// Port descriptor, two bits per port as in 0x0007.
    pub ports: u8,
    pub fmmus: u8,
    pub sync_managers: u8,
    pub ram_kib: u8,
    /// True if the device needs a system time.
    pub clock: bool,
    /// True if the application uses SYNC0. The chip then has the enhanced activation.
    pub sync: bool,
    /// True if the device is known not to process LRW.
    pub no_lrw: bool,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fitting_selects_the_smallest_sufficient_chip() {
        let needs = |ports, fmmus, sync_managers, ram_kib, clock| ChipRequirements {
            ports,
            fmmus,
            sync_managers,
            ram_kib,
            clock,
            sync: false,
            no_lrw: false,
        };
        // Requirements, then 0x0000 and 0x0004–0x0009 of the chip (port descriptor 0: as in the
        // device).
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
        let with_sync = ChipRequirements {
            sync: true,
            ..needs(0x0a, 3, 4, 1, true)
        };
        let info = EscInfo::fitting(&with_sync, 4096);
        assert_eq!((info.features, info.eeprom), (0x01fc, 0x00c0));
    }
}
