//! The register map: addresses, existing bytes and write access of the MainDevice (Beckhoff ESC
//! data sheet, section II; ETG.1000.4, 6). `access` and `datagram` implement the effects of an
//! access.

use super::chip::{EscInfo, feature};
use super::dc::Width;

/// End of the registers. Digital outputs (0x0F00), user RAM (0x0F80) and process RAM follow.
pub const ADDRESS_SPACE: usize = 0x0f00;
pub const USER_RAM: usize = 0x0f80;
pub const PROCESS_RAM: usize = 0x1000;

/// Maximum number of FMMUs and SyncManagers in the simulator.
pub const MAX_UNITS: u8 = 8;

pub const TYPE: u16 = 0x0000;
pub const STATION_ADDRESS: u16 = 0x0010;
pub const STATION_ALIAS: u16 = 0x0012;
pub const WRITE_ENABLE: u16 = 0x0020;
pub const WRITE_PROTECTION: u16 = 0x0021;
pub const ESC_WRITE_ENABLE: u16 = 0x0030;
pub const ESC_WRITE_PROTECTION: u16 = 0x0031;
pub const RESET: u16 = 0x0040;
pub const DL_CONTROL: u16 = 0x0100;
pub const READ_WRITE_OFFSET: u16 = 0x0108;
pub const DL_STATUS: u16 = 0x0110;
pub const AL_CONTROL: u16 = 0x0120;
pub const AL_STATUS: u16 = 0x0130;
pub const AL_STATUS_CODE: u16 = 0x0134;
pub const PDI_CONTROL: u16 = 0x0140;
pub const ESC_CONFIGURATION: u16 = 0x0141;
pub const PDI_CONFIG: u16 = 0x0150;
pub const SYNC_CONFIG: u16 = 0x0151;
pub const PDI_CONFIG_EXTENDED: u16 = 0x0152;
pub const ECAT_EVENT_MASK: u16 = 0x0200;
pub const AL_EVENT_MASK: u16 = 0x0204;
pub const ECAT_EVENT: u16 = 0x0210;
pub const AL_EVENT: u16 = 0x0220;
/// Counters of invalid frames and RX errors per port, then forwarded RX errors.
pub const RX_ERRORS: u16 = 0x0300;
pub const FORWARDED_ERRORS: u16 = 0x0308;
pub const PROCESSING_UNIT_ERRORS: u16 = 0x030c;
pub const PDI_ERRORS: u16 = 0x030d;
pub const LOST_LINK: u16 = 0x0310;
pub const WD_DIVIDER: u16 = 0x0400;
pub const WD_PDI: u16 = 0x0410;
pub const WD_PROCESS_DATA: u16 = 0x0420;
pub const WD_STATUS: u16 = 0x0440;
pub const WD_COUNTER: u16 = 0x0442;
pub const WD_COUNTER_PDI: u16 = 0x0443;
pub const EEPROM_CONFIG: u16 = 0x0500;
pub const EEPROM_PDI_ACCESS: u16 = 0x0501;
pub const EEPROM_CONTROL: u16 = 0x0502;
pub const EEPROM_ADDRESS: u16 = 0x0504;
pub const EEPROM_DATA: u16 = 0x0508;
pub const FMMU: u16 = 0x0600;
pub const SM: u16 = 0x0800;
pub const DC_RECEIVE_TIMES: u16 = 0x0900;
pub const DC_SYSTEM_TIME: u16 = 0x0910;
pub const DC_RECEIVE_TIME_PU: u16 = 0x0918;
pub const DC_OFFSET: u16 = 0x0920;
pub const DC_DELAY: u16 = 0x0928;
pub const DC_DIFFERENCE: u16 = 0x092c;
pub const DC_SPEED_START: u16 = 0x0930;
pub const DC_SPEED_DIFF: u16 = 0x0932;
pub const DC_FILTER: u16 = 0x0934;
pub const DC_CYCLIC_CONTROL: u16 = 0x0980;
pub const DC_ACTIVATION: u16 = 0x0981;
pub const DC_PULSE_LENGTH: u16 = 0x0982;
pub const DC_ACTIVATION_STATUS: u16 = 0x0984;
pub const DC_SYNC_STATUS: u16 = 0x098e;
pub const DC_START_TIME: u16 = 0x0990;
pub const DC_NEXT_SYNC1: u16 = 0x0998;
pub const DC_SYNC0_CYCLE: u16 = 0x09a0;
pub const DC_SYNC1_CYCLE: u16 = 0x09a4;
pub const DC_LATCH_CONTROL: u16 = 0x09a8;
pub const DC_LATCH_STATUS: u16 = 0x09ae;
/// Positive and negative edge of LATCH0, then of LATCH1, eight bytes each.
pub const DC_LATCH_TIMES: u16 = 0x09b0;
pub const DC_BUFFER_CHANGE: u16 = 0x09f0;
pub const DC_PDI_BUFFER_START: u16 = 0x09f8;
pub const DC_PDI_BUFFER_CHANGE: u16 = 0x09fc;

const EXISTS: u8 = 1;
const WRITABLE: u8 = 2;
/// Writable only while another register permits it.
const CONDITIONAL: u8 = 4;

const RO: u8 = EXISTS;
const RW: u8 = EXISTS | WRITABLE;
const RC: u8 = EXISTS | WRITABLE | CONDITIONAL;

type Ranges = &'static [(u16, u16, u8)];

/// (first, last, access) of the registers of every controller.
const BASE: Ranges = &[
    (0x0000, 0x0009, RO),
    (0x0010, 0x0011, RW),
    (0x0012, 0x0013, RO),
    (0x0020, 0x0021, RW),
    (0x0030, 0x0031, RW),
    (0x0040, 0x0040, RW),
    (0x0041, 0x0041, RO),
    (0x0100, 0x0103, RW),
    (0x0108, 0x0109, RW),
    (0x0110, 0x0111, RO),
    (0x0120, 0x0121, RC),
    (0x0130, 0x0131, RO),
    (0x0134, 0x0135, RO),
    (0x0140, 0x0141, RO),
    (0x0150, 0x0153, RO),
    (0x0200, 0x0201, RW),
    (0x0204, 0x0207, RO),
    (0x0210, 0x0211, RO),
    (0x0220, 0x0223, RO),
    (0x0300, 0x0313, RW),
    (0x0400, 0x0401, RW),
    (0x0410, 0x0411, RW),
    (0x0420, 0x0421, RW),
    (0x0440, 0x0441, RO),
    (0x0442, 0x0443, RW),
    (0x0500, 0x0500, RW),
    (0x0501, 0x0501, RO),
    (0x0502, 0x0509, RC),
    (0x050a, 0x050b, RO),
    (0x0f00, 0x0f03, RW),
    (0x0f10, 0x0f17, RW),
    (0x0f18, 0x0f1f, RO),
    (0x0f80, 0x0fff, RW),
];

/// The second half of the EEPROM data, for reads of eight bytes.
const WIDE_EEPROM: Ranges = &[(0x050c, 0x050f, RO)];

/// Receive times. Every controller with distributed clocks has them.
const RECEIVE_TIMES: Ranges = &[(0x0900, 0x0903, RW), (0x0904, 0x090f, RO)];

/// System time, SYNC and latch units.
const DC: Ranges = &[
    (0x0910, 0x0913, RW),
    (0x0918, 0x091f, RO),
    (0x0920, 0x0923, RW),
    (0x0928, 0x092b, RW),
    (0x092c, 0x092f, RO),
    (0x0930, 0x0931, RW),
    (0x0932, 0x0933, RO),
    (0x0934, 0x0935, RW),
    (0x0980, 0x0980, RW),
    (0x0981, 0x0981, RC),
    (0x0982, 0x0983, RO),
    (0x098e, 0x098f, RO),
    (0x0990, 0x0993, RC),
    (0x0998, 0x099b, RO),
    (0x09a0, 0x09a9, RC),
    (0x09ae, 0x09b3, RO),
    (0x09b8, 0x09bb, RO),
    (0x09c0, 0x09c3, RO),
    (0x09c8, 0x09cb, RO),
    (0x09f0, 0x09f3, RO),
    (0x09f8, 0x09ff, RO),
];

/// The upper halves of 64-bit clocks. Writes to 0x0914 have no effect.
const DC_64_BIT: Ranges = &[
    (0x0914, 0x0917, RO),
    (0x0924, 0x0927, RW),
    (0x0994, 0x0997, RC),
    (0x099c, 0x099f, RO),
    (0x09b4, 0x09b7, RO),
    (0x09bc, 0x09bf, RO),
    (0x09c4, 0x09c7, RO),
    (0x09cc, 0x09cf, RO),
];

/// Enhanced SYNC activation.
const ACTIVATION_STATUS: Ranges = &[(0x0984, 0x0984, RO)];

/// The access rights of each byte below process RAM.
#[derive(Debug, Clone)]
pub struct RegisterMap(Vec<u8>);

impl RegisterMap {
    /// Creates the map. `dc` is the clock width if system time, SYNC and latch units exist.
    #[must_use]
    pub fn new(info: &EscInfo, dc: Option<Width>) -> Self {
        let when = |condition: bool, ranges: Ranges| if condition { ranges } else { &[] };
        let mut map = vec![0; PROCESS_RAM];
        let parts = [
            BASE,
            when(
                info.eeprom & super::chip::eeprom::EIGHT_BYTES != 0,
                WIDE_EEPROM,
            ),
            when(info.has(feature::DC), RECEIVE_TIMES),
            when(dc.is_some(), DC),
            when(dc == Some(Width::Bits64), DC_64_BIT),
            when(
                dc.is_some() && info.has(feature::ENHANCED_SYNC),
                ACTIVATION_STATUS,
            ),
        ];
        for (first, last, access) in parts.into_iter().flatten() {
            map[usize::from(*first)..=usize::from(*last)].fill(*access);
        }
        let fmmus = usize::from(info.fmmus.min(MAX_UNITS)) * 16;
        map[usize::from(FMMU)..][..fmmus].fill(RW);
        // Status and PDI control of each SyncManager are writable only for the device.
        let sms = usize::from(info.sync_managers.min(MAX_UNITS)) * 8;
        for sm in map[usize::from(SM)..][..sms].chunks_exact_mut(8) {
            sm.copy_from_slice(&[RC, RC, RC, RC, RC, RO, RW, RO]);
        }
        Self(map)
    }

    /// True if any byte of the range exists.
    #[must_use]
    pub fn readable(&self, start: usize, end: usize) -> bool {
        self.0
            .get(start..end)
            .is_some_and(|range| range.iter().any(|b| b & EXISTS != 0))
    }

    /// True if every byte of the range is writable regardless of other registers.
    #[must_use]
    pub fn freely_writable(&self, start: usize, end: usize) -> bool {
        self.0
            .get(start..end)
            .is_some_and(|range| range.iter().all(|b| *b == RW))
    }

    #[must_use]
    pub fn writable(&self, at: usize) -> bool {
        self.0.get(at).is_some_and(|b| b & WRITABLE != 0)
    }

    #[must_use]
    pub fn conditional(&self, at: usize) -> bool {
        self.0.get(at).is_some_and(|b| b & CONDITIONAL != 0)
    }

    /// Returns the number of bytes from `at` (below `end`) with equal access, and that access.
    /// `write` selects write or read access.
    #[must_use]
    pub fn run(&self, at: usize, end: usize, write: bool) -> (usize, bool) {
        let bit = if write { WRITABLE } else { EXISTS };
        let can = |at: usize| self.0.get(at).is_some_and(|b| b & bit != 0);
        let first = can(at);
        let len = (at..end).take_while(|at| can(*at) == first).count();
        (len.max(1), first)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn register_map_contains_the_registers_of_each_chip() {
        let et1100 = RegisterMap::new(&EscInfo::ET1100, Some(Width::Bits64));
        let et1200 = RegisterMap::new(&EscInfo::ET1200, None);
        let lan9252 = RegisterMap::new(&EscInfo::LAN9252, Some(Width::Bits32));
        // (first, last, ET1100 with clock, ET1200 without, LAN9252 with a clock of 32 bits)
        let rows = [
            (0x0000, 0x0009, [true, true, true]),
            (0x000a, 0x000f, [false, false, false]),
            (0x0508, 0x050b, [true, true, true]),
            (0x050c, 0x050f, [true, true, false]),
            (0x0620, 0x062f, [true, true, true]),
            (0x0630, 0x063f, [true, false, false]),
            (0x0680, 0x06ff, [false, false, false]),
            (0x0818, 0x081f, [true, true, true]),
            (0x0820, 0x0827, [true, false, false]),
            (0x0840, 0x087f, [false, false, false]),
            (0x0900, 0x090f, [true, true, true]),
            (0x0910, 0x0913, [true, false, true]),
            (0x0914, 0x0917, [true, false, false]),
            (0x0918, 0x091f, [true, false, true]),
            (0x0984, 0x0984, [false, false, true]),
            (0x0e00, 0x0eff, [false, false, false]),
        ];
        for (first, last, expected) in rows {
            let answers = [&et1100, &et1200, &lan9252].map(|map| map.readable(first, last + 1));
            assert_eq!(answers, expected, "0x{first:04x}");
        }
    }
}
