//! Names of objects in messages, for devices without an ESI.

use std::fmt;

use ecaxis_esi::{Address, address};

/// index:subindex; displayed with its name if it is known here.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct NamedObject {
    pub index: u16,
    pub sub: u8,
}

impl NamedObject {
    /// Returns the address without the name.
    #[must_use]
    pub fn number(self) -> Address {
        address(self.index, self.sub)
    }
}

impl fmt::Display for NamedObject {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.number())?;
        match object_name(self.index, self.sub) {
            Some(name) => write!(f, " ({name})"),
            None => Ok(()),
        }
    }
}

/// Returns the name of an object of CiA 301, CiA 402, ETG.1000.6 or ETG.5001 that bring-up and
/// drives use.
pub fn object_name(index: u16, sub: u8) -> Option<&'static str> {
    Some(match (index, sub) {
        (0x1000, 0) => "Device type",
        (0x1001, 0) => "Error register",
        (0x1003, _) => "Error history",
        (0x1008, 0) => "Device name",
        (0x1009, 0) => "Hardware version",
        (0x100a, 0) => "Software version",
        (0x1010, _) => "Store parameters",
        (0x1011, _) => "Restore default parameters",
        (0x1018, 1) => "Vendor ID",
        (0x1018, 2) => "Product code",
        (0x1018, 3) => "Revision number",
        (0x1018, 4) => "Serial number",
        (0x1018, _) => "Identity",
        (0x10f0, _) => "Backup parameters",
        (0x10f1, 1) => "Local error reaction",
        (0x10f1, 2) => "Sync error counter limit",
        (0x10f1, _) => "Error settings",
        (0x10f3, _) => "Diagnosis history",
        (0x10f8, _) => "Timestamp",
        (0x1600..=0x17ff, 0) => "RxPDO mapping, number of entries",
        (0x1600..=0x17ff, _) => "RxPDO mapping",
        (0x1a00..=0x1bff, 0) => "TxPDO mapping, number of entries",
        (0x1a00..=0x1bff, _) => "TxPDO mapping",
        (0x1c00, _) => "SyncManager communication types",
        (0x1c12, 0) => "RxPDO assignment, number of PDOs",
        (0x1c12, _) => "RxPDO assignment",
        (0x1c13, 0) => "TxPDO assignment, number of PDOs",
        (0x1c13, _) => "TxPDO assignment",
        (0x1c32, sub) => return Some(sync_parameter(sub, "output")),
        (0x1c33, sub) => return Some(sync_parameter(sub, "input")),
        (0x6040, 0) => "Controlword",
        (0x6041, 0) => "Statusword",
        (0x603f, 0) => "Error code",
        (0x605a, 0) => "Quick stop option code",
        (0x605b, 0) => "Shutdown option code",
        (0x605c, 0) => "Disable operation option code",
        (0x605d, 0) => "Halt option code",
        (0x605e, 0) => "Fault reaction option code",
        (0x6060, 0) => "Modes of operation",
        (0x6061, 0) => "Modes of operation display",
        (0x6062, 0) => "Position demand value",
        (0x6064, 0) => "Position actual value",
        (0x6065, 0) => "Following error window",
        (0x6066, 0) => "Following error timeout",
        (0x6067, 0) => "Position window",
        (0x6068, 0) => "Position window time",
        (0x606b, 0) => "Velocity demand value",
        (0x606c, 0) => "Velocity actual value",
        (0x6071, 0) => "Target torque",
        (0x6072, 0) => "Max torque",
        (0x6073, 0) => "Max current",
        (0x6074, 0) => "Torque demand",
        (0x6075, 0) => "Motor rated current",
        (0x6076, 0) => "Motor rated torque",
        (0x6077, 0) => "Torque actual value",
        (0x6078, 0) => "Current actual value",
        (0x6079, 0) => "DC link circuit voltage",
        (0x607a, 0) => "Target position",
        (0x607c, 0) => "Home offset",
        (0x607d, 1) => "Min position limit",
        (0x607d, 2) => "Max position limit",
        (0x607d, _) => "Software position limit",
        (0x607e, 0) => "Polarity",
        (0x607f, 0) => "Max profile velocity",
        (0x6080, 0) => "Max motor speed",
        (0x6081, 0) => "Profile velocity",
        (0x6083, 0) => "Profile acceleration",
        (0x6084, 0) => "Profile deceleration",
        (0x6085, 0) => "Quick stop deceleration",
        (0x6086, 0) => "Motion profile type",
        (0x608f, _) => "Position encoder resolution",
        (0x6091, _) => "Gear ratio",
        (0x6098, 0) => "Homing method",
        (0x6099, _) => "Homing speeds",
        (0x609a, 0) => "Homing acceleration",
        (0x60a9, 0) => "SI unit velocity",
        (0x60b0, 0) => "Position offset",
        (0x60b1, 0) => "Velocity offset",
        (0x60b2, 0) => "Torque offset",
        (0x60b8, 0) => "Touch probe function",
        (0x60b9, 0) => "Touch probe status",
        (0x60c2, 1) => "Interpolation time period value",
        (0x60c2, 2) => "Interpolation time index",
        (0x60c2, _) => "Interpolation time period",
        (0x60c5, 0) => "Max acceleration",
        (0x60c6, 0) => "Max deceleration",
        (0x60e0, 0) => "Positive torque limit value",
        (0x60e1, 0) => "Negative torque limit value",
        (0x60f4, 0) => "Following error actual value",
        (0x60fd, 0) => "Digital inputs",
        (0x60fe, _) => "Digital outputs",
        (0x60ff, 0) => "Target velocity",
        (0x6402, 0) => "Motor type",
        (0x6502, 0) => "Supported drive modes",
        (0xf000, _) => "Modular device profile",
        (0xf010, _) => "Module profile list",
        (0xf030, _) => "Configured module ident list",
        (0xf050, _) => "Detected module ident list",
        _ => return None,
    })
}

/// 0x1C32 and 0x1C33 (ETG.1020).
fn sync_parameter(sub: u8, direction: &'static str) -> &'static str {
    match (sub, direction) {
        (1, "output") => "Output sync mode",
        (1, _) => "Input sync mode",
        (2, _) => "Cycle time",
        (3, _) => "Shift time",
        (4, _) => "Supported sync modes",
        (5, _) => "Minimum cycle time",
        (6, _) => "Calc and copy time",
        (9, _) => "Delay time",
        (10, _) => "SYNC0 cycle time",
        (11, _) => "Missed SyncManager events",
        (12, _) => "Cycle time too small",
        (32, _) => "Sync error",
        (_, "output") => "Output SyncManager parameter",
        _ => "Input SyncManager parameter",
    }
}
