//! Meaning of the controller's registers (ETG.1000.4; Beckhoff ESC data sheet, section II).

use std::fmt;

use ecaxis_master::acyclic::delays::has_receive_times;

/// The size of registers 0x0000 to 0x0009.
pub const CONTROLLER_BYTES: usize = 10;

/// Bits of 0x0008.
const DC_64_BIT: u16 = 0x0008;
const NO_LRW: u16 = 0x0200;

/// The controller information.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Controller {
    /// 0x0000: 0x04 IP core, 0x11 ET1100, 0x12 ET1200, 0xc0 LAN9252 …
    pub kind: u8,
    pub revision: u8,
    pub build: u16,
    pub fmmus: u8,
    pub sync_managers: u8,
    /// Process RAM in KiB.
    pub ram_kib: u8,
    pub ports: [PortKind; 4],
    /// 0x0008.
    pub features: u16,
}

/// The physical type of a port (0x0007).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum PortKind {
    #[default]
    None,
    NotConfigured,
    Ebus,
    Mii,
}

impl fmt::Display for PortKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::None => "none",
            Self::NotConfigured => "not configured",
            Self::Ebus => "E-bus",
            Self::Mii => "MII",
        })
    }
}

impl Controller {
    #[must_use]
    pub fn from_registers(bytes: [u8; CONTROLLER_BYTES]) -> Self {
        let [
            kind,
            revision,
            b0,
            b1,
            fmmus,
            sync_managers,
            ram_kib,
            ports,
            f0,
            f1,
        ] = bytes;
        let port = |n: u8| match ports >> (2 * n) & 3 {
            0 => PortKind::None,
            1 => PortKind::NotConfigured,
            2 => PortKind::Ebus,
            _ => PortKind::Mii,
        };
        Self {
            kind,
            revision,
            build: u16::from_le_bytes([b0, b1]),
            fmmus,
            sync_managers,
            ram_kib,
            ports: [port(0), port(1), port(2), port(3)],
            features: u16::from_le_bytes([f0, f1]),
        }
    }

    /// True if it supports distributed clocks, or at least receive times.
    #[must_use]
    pub fn has_receive_times(&self) -> bool {
        has_receive_times(self.features)
    }

    /// Returns the size of the distributed clock in bits.
    #[must_use]
    pub fn clock_bits(&self) -> u8 {
        if self.features & DC_64_BIT != 0 {
            64
        } else {
            32
        }
    }

    #[must_use]
    pub fn knows_lrw(&self) -> bool {
        self.features & NO_LRW == 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn controller_parses_an_et1100() {
        // ET1100 with two MII ports.
        let bytes = [0x11, 0, 2, 0, 8, 8, 8, 0x0f, 0xfc, 0x00];
        let controller = Controller::from_registers(bytes);
        assert_eq!(controller.kind, 0x11);
        assert_eq!(controller.build, 2);
        assert_eq!(
            controller.ports,
            [PortKind::Mii, PortKind::Mii, PortKind::None, PortKind::None]
        );
        assert!(controller.has_receive_times() && controller.knows_lrw());
        assert_eq!(controller.clock_bits(), 64);
        let without = Controller::from_registers([0x12, 0, 0, 0, 3, 4, 1, 0x8a, 0x00, 0x02]);
        assert!(!without.has_receive_times() && !without.knows_lrw());
        assert_eq!(without.ports[3], PortKind::Ebus);
        assert_eq!(without.clock_bits(), 32);
    }
}
