//! Reasons why a choice does not fit the ESI file.

use crate::address;
use crate::mode::Mode;
use crate::model::Position;

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SelectError {
    #[error("the ESI file describes no device")]
    NoDevices,
    #[error("no device in the ESI file matches {query}; it contains {available}{unreadable}")]
    NoSuchDevice {
        query: String,
        available: String,
        /// Skipped devices with the reason.
        unreadable: String,
    },
    #[error("{query} matches several devices: {available}")]
    Ambiguous { query: String, available: String },
    #[error("{device} offers no mode {mode}; the ESI offers {offered}")]
    ModeNotOffered {
        device: String,
        mode: Mode,
        offered: String,
    },
    #[error(
        "{device}, slot {slot:?} needs a module and the ESI marks none as default; it offers {offered}"
    )]
    ModuleNeeded {
        device: String,
        slot: String,
        offered: String,
    },
    #[error("{device}, slot {slot:?} takes no module {wanted:?}; the ESI offers {offered}")]
    NoSuchModule {
        device: String,
        slot: String,
        wanted: String,
        offered: String,
    },
    #[error("{device}: {given} modules are listed, there are {places} places for modules")]
    TooManyModules {
        device: String,
        given: usize,
        places: usize,
    },
    #[error("{device} has no PDO assignment {wanted:?}; the ESI offers {offered}")]
    NoSuchAssignment {
        device: String,
        wanted: String,
        offered: String,
    },
    #[error(
        "assignment {name:?} of {device} names PDO 0x{pdo:04x}, which the ESI does not describe"
    )]
    UnknownPdo {
        device: String,
        name: String,
        pdo: u16,
    },
    #[error(
        "PDO 0x{pdo:04x} of {device} would be assigned to SyncManager {sm}, which its ESI excludes"
    )]
    ExcludedSyncManager { device: String, pdo: u16, sm: u8 },
    #[error(
        "slot {slot:?} (line {}) names module 0x{ident:08x}, which neither the ESI file nor a file that it refers to describes",
        position.line
    )]
    UnknownModule {
        slot: String,
        position: Position,
        ident: u32,
    },
    #[error(
        "the modules in the {places} places of {device} (Slots on line {}) take more than {limit} bytes, which no device needs",
        position.line
    )]
    ModulesTooLarge {
        device: String,
        position: Position,
        places: usize,
        limit: usize,
    },
    #[error("{device} has no DC mode {wanted:?}; the ESI offers {offered}")]
    NoSuchDcMode {
        device: String,
        wanted: String,
        offered: String,
    },
    #[error(
        "DC mode {mode:?} at a bus cycle of {cycle_ns} ns gives {what} that does not fit its register"
    )]
    DcOutOfRange {
        mode: String,
        cycle_ns: u64,
        what: &'static str,
    },
    #[error(
        "PDO 0x{pdo:04x} is not assigned to a SyncManager and {device} has none for {direction}"
    )]
    NoSyncManager {
        device: String,
        pdo: u16,
        direction: &'static str,
    },
    #[error(
        "{list}: object {} is neither in the dictionary nor in a PDO of the ESI, so its length is unknown", address(*index, *sub)
    )]
    UnknownEntry {
        list: &'static str,
        index: u16,
        sub: u8,
    },
    #[error("{list}: object {} ({name}) cannot be mapped into a {direction}", address(*index, *sub))]
    NotMappable {
        list: &'static str,
        index: u16,
        sub: u8,
        name: String,
        direction: &'static str,
    },
    #[error(
        "{list}: {device} does not let its PDOs be configured (CoE PdoConfig is not set, or all are Fixed)"
    )]
    NotConfigurable { list: &'static str, device: String },
    #[error("{list}: {count} entries, PDO 0x{pdo:04x} takes at most {max}")]
    TooManyEntries {
        list: &'static str,
        pdo: u16,
        count: usize,
        max: usize,
    },
    #[error("{list}: mode {mode} needs 0x{index:04x} in it")]
    MissingEntry {
        list: &'static str,
        mode: Mode,
        index: u16,
    },
    #[error(
        "{device} does not let its PDO assignment be changed (CoE PdoAssign is not set) and its default is {default}, not {wanted}"
    )]
    AssignmentFixed {
        device: String,
        default: String,
        wanted: String,
    },
    #[error(
        "PDO 0x{pdo:04x} of {device} would need other contents, which CoE PdoConfig does not allow"
    )]
    ContentsFixed { device: String, pdo: u16 },
    #[error(
        "{factor} samples of PDO 0x{pdo:04x} (line {}) are more than {}",
        position.line,
        max.map_or("a cycle can carry".to_owned(), |max| format!("its OSMax of {max}"))
    )]
    TooManySamples {
        pdo: u16,
        position: Position,
        factor: u16,
        max: Option<u16>,
    },
    #[error("SyncManager {sm} would carry {len} bytes of {direction}, it takes at most {max}")]
    SyncManagerFull {
        sm: u8,
        direction: &'static str,
        len: u32,
        max: u32,
    },
    #[error(
        "SyncManager {sm} (0x{start:04x}, {len} bytes, three buffers) reaches into SyncManager {other} at 0x{other_start:04x}"
    )]
    SyncManagersOverlap {
        sm: u8,
        start: u16,
        len: u16,
        other: u8,
        other_start: u16,
    },
    #[error(
        "SyncManager {sm} (Sm at {position} of the ESI, 0x{start:04x}, {len} bytes) does not lie in a SubDevice's memory, 0x0900 to 0xffff"
    )]
    SyncManagerOutside {
        sm: u8,
        position: Position,
        start: u16,
        /// The length in bytes, with all buffers.
        len: u32,
    },
    #[error(
        "a cycle of {cycle_ns} ns cannot be written to 0x60C2 (value {min}..{max} times a power of ten); nearest are {nearest}"
    )]
    CycleNotExpressible {
        cycle_ns: u64,
        min: u8,
        max: u8,
        nearest: String,
    },
    #[error(
        "start-up SDO {} ({name}) has {given} bytes, the object has {expected}", address(*index, *sub)
    )]
    SdoLength {
        index: u16,
        sub: u8,
        name: String,
        given: usize,
        expected: usize,
    },
    #[error(
        "{device} speaks SoE and not CoE: what its process data contains is set by SoE IDNs, which ecaxis does not speak"
    )]
    SoeOnly { device: String },
    #[error("{device} has no CoE mailbox, so {what} cannot be written")]
    NoCoe { device: String, what: &'static str },
}

impl SelectError {
    /// Returns position and name of the faulty element, if it is not the device itself.
    #[must_use]
    pub fn element(&self) -> Option<(Position, &'static str)> {
        match self {
            Self::UnknownModule { position, .. } => Some((*position, "Slot")),
            Self::ModulesTooLarge { position, .. } => Some((*position, "Slots")),
            Self::SyncManagerOutside { position, .. } => Some((*position, "Sm")),
            Self::TooManySamples { position, .. } => Some((*position, "Pdo")),
            _ => None,
        }
    }
}
