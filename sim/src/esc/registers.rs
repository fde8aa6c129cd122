//! The register map: addresses, which bytes exist and which the MainDevice may write.

use super::info::{EscInfo, feature};

/// Registers end here; digital outputs (0x0F00), user RAM (0x0F80) and process RAM follow.
pub const ADDRESS_SPACE: usize = 0x0f00;

/// FMMUs and SyncManagers that the simulator can hold.
pub const MAX_UNITS: u8 = 8;

pub const TYPE: u16 = 0x0000;
pub const STATION_ADDRESS: u16 = 0x0010;
pub const STATION_ALIAS: u16 = 0x0012;
pub const DL_CONTROL: u16 = 0x0100;
pub const DL_STATUS: u16 = 0x0110;
pub const AL_CONTROL: u16 = 0x0120;
pub const AL_STATUS: u16 = 0x0130;
pub const AL_STATUS_CODE: u16 = 0x0134;
pub const PDI_CONTROL: u16 = 0x0140;
pub const PDI_CONFIG: u16 = 0x0150;
pub const ECAT_EVENT_MASK: u16 = 0x0200;
pub const ECAT_EVENT: u16 = 0x0210;
pub const AL_EVENT: u16 = 0x0220;
/// Invalid frame and RX error counter of each port, then forwarded RX errors.
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
pub const EEPROM_CONFIG: u16 = 0x0500;
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
pub const DC_START_TIME: u16 = 0x0990;
pub const DC_NEXT_SYNC1: u16 = 0x0998;
pub const DC_SYNC0_CYCLE: u16 = 0x09a0;
pub const DC_SYNC1_CYCLE: u16 = 0x09a4;

/// (first, last, writable) of the registers every chip here has.
const BASE: &[(u16, u16, bool)] = &[
    (0x0000, 0x0009, false),
    (0x0010, 0x0011, true),
    (0x0012, 0x0013, false),
    (0x0020, 0x0021, true),
    (0x0030, 0x0031, true),
    (0x0040, 0x0041, true),
    (0x0100, 0x0103, true),
    (0x0108, 0x0109, true),
    (0x0110, 0x0111, false),
    (0x0120, 0x0121, true),
    (0x0130, 0x0131, false),
    (0x0134, 0x0135, false),
    (0x0138, 0x0139, false),
    (0x0140, 0x0141, false),
    (0x0150, 0x0153, false),
    (0x0200, 0x0201, true),
    (0x0204, 0x0207, false),
    (0x0210, 0x0211, false),
    (0x0220, 0x0223, false),
    (0x0300, 0x0313, true),
    (0x0400, 0x0401, true),
    (0x0410, 0x0411, true),
    (0x0420, 0x0421, true),
    (0x0440, 0x0441, false),
    (0x0442, 0x0443, true),
    (0x0500, 0x0500, true),
    (0x0501, 0x0501, false),
    (0x0502, 0x050f, true),
];

/// Receive times: in every chip with distributed clocks, used or not.
const RECEIVE_TIMES: &[(u16, u16, bool)] = &[(0x0900, 0x0903, true), (0x0904, 0x090f, false)];

/// System time and SYNC units.
const DC: &[(u16, u16, bool)] = &[
    (0x0910, 0x0917, true),
    (0x0918, 0x091f, false),
    (0x0920, 0x0927, true),
    (0x0928, 0x092b, true),
    (0x092c, 0x092f, false),
    (0x0930, 0x0931, true),
    (0x0932, 0x0933, false),
    (0x0934, 0x0935, true),
    (0x0980, 0x0981, true),
    (0x0982, 0x0984, false),
    (0x098e, 0x098f, false),
    (0x0990, 0x0997, true),
    (0x0998, 0x099f, false),
    (0x09a0, 0x09a7, true),
    (0x09a8, 0x09a9, true),
    (0x09ae, 0x09cf, false),
];

/// Per byte: bit 0 exists, bit 1 writable.
#[derive(Debug, Clone)]
pub struct RegisterMap(Vec<u8>);

impl RegisterMap {
    #[must_use]
    pub fn new(info: &EscInfo, with_dc: bool) -> Self {
        let mut map = vec![0; ADDRESS_SPACE];
        let (receive_times, dc) = match (info.has(feature::DC), with_dc) {
            (true, true) => (RECEIVE_TIMES, DC),
            (true, false) => (RECEIVE_TIMES, &[] as &[_]),
            (false, _) => (&[] as &[_], &[] as &[_]),
        };
        for (first, last, writable) in BASE.iter().chain(receive_times).chain(dc) {
            let range = usize::from(*first)..=usize::from(*last);
            map[range].fill(if *writable { 3 } else { 1 });
        }
        let fmmus = usize::from(info.fmmus.min(MAX_UNITS)) * 16;
        map[usize::from(FMMU)..][..fmmus].fill(3);
        // Status and PDI control of each SyncManager belong to the device.
        let sms = usize::from(info.sync_managers.min(MAX_UNITS)) * 8;
        for sm in map[usize::from(SM)..][..sms].chunks_exact_mut(8) {
            sm.copy_from_slice(&[3, 3, 3, 3, 3, 1, 3, 1]);
        }
        Self(map)
    }

    /// Any byte of the range exists.
    #[must_use]
    pub fn readable(&self, start: usize, len: usize) -> bool {
        self.any(start, len, 1)
    }

    #[must_use]
    pub fn writable(&self, start: usize, len: usize) -> bool {
        self.any(start, len, 2)
    }

    fn any(&self, start: usize, len: usize, bit: u8) -> bool {
        self.0
            .get(start..start + len)
            .is_some_and(|r| r.iter().any(|b| b & bit != 0))
    }
}
