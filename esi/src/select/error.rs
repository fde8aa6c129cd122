//! Reasons why a choice does not fit the ESI file.

use crate::address;
use crate::mode::Mode;
use crate::model::Position;

/// A choice does not fit the ESI file.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SelectError {
    /// The file contains no device.
    #[error("the ESI file describes no device")]
    NoDevices,
    /// No device matches the query.
    #[error("no device in the ESI file matches {query}; it contains {available}{unreadable}")]
    NoSuchDevice {
        /// The query as text.
        query: String,
        /// The devices of the file as text.
        available: String,
        /// Skipped devices with the reason.
        unreadable: String,
    },
    /// Several devices match the query.
    #[error("{query} matches several devices: {available}")]
    Ambiguous {
        /// The query as text.
        query: String,
        /// The devices of the file as text.
        available: String,
    },
    /// No PDO of the device carries the objects of the mode.
    #[error(
        "{device} offers no mode {mode}{}; the ESI offers {offered}",
        missing.map_or_else(String::new, |index| format!(": no PDO has 0x{index:04X}"))
    )]
    ModeNotOffered {
        /// The object that the mode needs and that no PDO carries.
        missing: Option<u16>,
        /// The type name of the device.
        device: String,
        /// The mode.
        mode: Mode,
        /// The choices in the ESI as text.
        offered: String,
    },
    /// PDOs of the device have the set-point of the mode, but no Controlword.
    #[error("{device} has no mode {mode}: no RxPdo of the ESI has the Controlword 0x6040")]
    NoControlword {
        /// The type name of the device.
        device: String,
        /// The mode.
        mode: Mode,
    },
    /// A PDO maps a value of CiA 402 under a subindex that the value does not have.
    #[error(
        "{device}: mode {mode} needs 0x{index:04X}:00; {} maps 0x{index:04X}:{sub:02X}",
        position.origin()
    )]
    SubindexOfValue {
        /// The type name of the device.
        device: String,
        /// The position of the `Entry`.
        position: Position,
        /// The mode.
        mode: Mode,
        /// The index of the object.
        index: u16,
        /// The subindex in the ESI.
        sub: u8,
    },
    /// No PDO of the device carries the Controlword of an axis.
    #[error("{device} has no axis {number}: no RxPdo of the ESI has its Controlword 0x{index:04X}")]
    NoSuchAxis {
        /// The type name of the device.
        device: String,
        /// The number of the axis, from 1.
        number: u16,
        /// The index of the Controlword.
        index: u16,
    },
    /// A slot needs a module, and none is the default.
    #[error(
        "{device}, slot {slot:?} needs a module and the ESI marks none as default; it offers {offered}"
    )]
    ModuleNeeded {
        /// The type name of the device.
        device: String,
        /// The name of the slot.
        slot: String,
        /// The choices in the ESI as text.
        offered: String,
    },
    /// A slot does not accept the module.
    #[error("{device}, slot {slot:?} takes no module {wanted:?}; the ESI offers {offered}")]
    NoSuchModule {
        /// The type name of the device.
        device: String,
        /// The name of the slot.
        slot: String,
        /// The choice.
        wanted: String,
        /// The choices in the ESI as text.
        offered: String,
    },
    /// More modules are chosen than places exist.
    #[error("{device}: {given} modules are listed, there are {places} places for modules")]
    TooManyModules {
        /// The type name of the device.
        device: String,
        /// The chosen number.
        given: usize,
        /// The number of places.
        places: usize,
    },
    /// A named module is for another mode.
    #[error("{device}: module {module:?} is not for mode {mode}")]
    ModuleMode {
        /// The type name of the device.
        device: String,
        /// The module's type.
        module: String,
        /// The chosen mode.
        mode: Mode,
    },
    /// The device has no PDO assignment with this name.
    #[error("{device} has no PDO assignment {wanted:?}; the ESI offers {offered}")]
    NoSuchAssignment {
        /// The type name of the device.
        device: String,
        /// The choice.
        wanted: String,
        /// The choices in the ESI as text.
        offered: String,
    },
    /// An assignment names a PDO that the file does not contain.
    #[error(
        "assignment {name:?} of {device} names PDO 0x{pdo:04x}, which the ESI does not describe"
    )]
    UnknownPdo {
        /// The type name of the device.
        device: String,
        /// The name of the element or object.
        name: String,
        /// The index of the PDO.
        pdo: u16,
    },
    /// The PDO cannot be assigned to this SyncManager.
    #[error(
        "PDO 0x{pdo:04x} of {device} would be assigned to SyncManager {sm}, which its ESI excludes"
    )]
    ExcludedSyncManager {
        /// The type name of the device.
        device: String,
        /// The index of the PDO.
        pdo: u16,
        /// The SyncManager number.
        sm: u8,
    },
    /// A slot names a module that no file describes.
    #[error(
        "slot {slot:?} (line {}) names module 0x{ident:08x}, which neither the ESI file nor a file that it refers to describes",
        position.line
    )]
    UnknownModule {
        /// The name of the slot.
        slot: String,
        /// The position of the element.
        position: Position,
        /// The module identity.
        ident: u32,
    },
    /// The modules exceed a limit of the reader.
    #[error(
        "the modules in the {places} places of {device} (Slots on line {}) take more than {limit} bytes, which no device needs",
        position.line
    )]
    ModulesTooLarge {
        /// The type name of the device.
        device: String,
        /// The position of the element.
        position: Position,
        /// The number of places.
        places: usize,
        /// The limit in bytes.
        limit: usize,
    },
    /// The device has no DC mode with this name.
    #[error("{device} has no DC mode {wanted:?}; the ESI offers {offered}")]
    NoSuchDcMode {
        /// The type name of the device.
        device: String,
        /// The choice.
        wanted: String,
        /// The choices in the ESI as text.
        offered: String,
    },
    /// A time of the DC mode exceeds its register.
    #[error(
        "DC mode {mode:?} at a bus cycle of {cycle_ns} ns gives {what} that does not fit its register"
    )]
    DcOutOfRange {
        /// The name of the DC mode.
        mode: String,
        /// The bus cycle in ns.
        cycle_ns: u64,
        /// The value that does not fit.
        what: &'static str,
    },
    /// No SyncManager carries PDOs of this direction.
    #[error(
        "PDO 0x{pdo:04x} is not assigned to a SyncManager and {device} has none for {direction}"
    )]
    NoSyncManager {
        /// The type name of the device.
        device: String,
        /// The index of the PDO.
        pdo: u16,
        /// The direction as text.
        direction: &'static str,
    },
    /// The length of an entry is unknown.
    #[error(
        "{list}: object {} is neither in the dictionary nor in a PDO of the ESI, so its length is unknown", address(*index, *sub)
    )]
    UnknownEntry {
        /// The list of entries, as the user names it.
        list: &'static str,
        /// The index.
        index: u16,
        /// The subindex.
        sub: u8,
    },
    /// The object cannot be mapped in this direction.
    #[error("{list}: object {} ({name}) cannot be mapped into a {direction}", address(*index, *sub))]
    NotMappable {
        /// The list of entries, as the user names it.
        list: &'static str,
        /// The index.
        index: u16,
        /// The subindex.
        sub: u8,
        /// The name of the element or object.
        name: String,
        /// The direction as text.
        direction: &'static str,
    },
    /// The device has fixed PDO contents.
    #[error(
        "{list}: {device} does not let its PDOs be configured (CoE PdoConfig is not set, or all are Fixed)"
    )]
    NotConfigurable {
        /// The list of entries, as the user names it.
        list: &'static str,
        /// The type name of the device.
        device: String,
    },
    /// The PDO does not take so many entries.
    #[error("{list}: {count} entries, PDO 0x{pdo:04x} takes at most {max}")]
    TooManyEntries {
        /// The list of entries, as the user names it.
        list: &'static str,
        /// The index of the PDO.
        pdo: u16,
        /// The number of entries.
        count: usize,
        /// The largest number of entries.
        max: usize,
    },
    /// The list lacks an object that the mode needs.
    #[error("{list}: mode {mode} needs 0x{index:04x} in it")]
    MissingEntry {
        /// The list of entries, as the user names it.
        list: &'static str,
        /// The mode.
        mode: Mode,
        /// The index.
        index: u16,
    },
    /// The device has a fixed PDO assignment, which differs from the choice.
    #[error(
        "{device} does not let its PDO assignment be changed (CoE PdoAssign is not set) and its default is {default}, not {wanted}"
    )]
    AssignmentFixed {
        /// The type name of the device.
        device: String,
        /// The fixed assignment as text.
        default: String,
        /// The choice.
        wanted: String,
    },
    /// The choice needs other PDO contents, and the device has fixed ones.
    #[error(
        "PDO 0x{pdo:04x} of {device} would need other contents, which CoE PdoConfig does not allow"
    )]
    ContentsFixed {
        /// The type name of the device.
        device: String,
        /// The index of the PDO.
        pdo: u16,
    },
    /// The oversampling factor is too large.
    #[error(
        "{factor} samples of PDO 0x{pdo:04x} (line {}) are more than {}",
        position.line,
        max.map_or("a cycle can carry".to_owned(), |max| format!("its OSMax of {max}"))
    )]
    TooManySamples {
        /// The index of the PDO.
        pdo: u16,
        /// The position of the element.
        position: Position,
        /// The factor.
        factor: u16,
        /// The largest factor in the ESI.
        max: Option<u16>,
    },
    /// The process data exceed the SyncManager.
    #[error("SyncManager {sm} would carry {len} bytes of {direction}, it takes at most {max}")]
    SyncManagerFull {
        /// The SyncManager number.
        sm: u8,
        /// The direction as text.
        direction: &'static str,
        /// The length in bytes.
        len: u32,
        /// The largest length in bytes.
        max: u32,
    },
    /// The buffers of a SyncManager reach into another one.
    #[error(
        "SyncManager {sm} (0x{start:04x}, {len} bytes, three buffers) reaches into SyncManager {other} at 0x{other_start:04x}"
    )]
    SyncManagersOverlap {
        /// The SyncManager number.
        sm: u8,
        /// The physical start address.
        start: u16,
        /// The length in bytes.
        len: u16,
        /// The number of the other SyncManager.
        other: u8,
        /// The start address of the other SyncManager.
        other_start: u16,
    },
    /// A SyncManager is outside the memory for process data.
    #[error(
        "SyncManager {sm} (Sm at {position} of the ESI, 0x{start:04x}, {len} bytes) does not lie in a SubDevice's memory, 0x0900 to 0xffff"
    )]
    SyncManagerOutside {
        /// The SyncManager number.
        sm: u8,
        /// The position of the element.
        position: Position,
        /// The physical start address.
        start: u16,
        /// The length in bytes, with all buffers.
        len: u32,
    },
    /// 0x60C2 cannot express the bus cycle.
    #[error(
        "a cycle of {cycle_ns} ns cannot be written to 0x60C2 (value {min}..{max} times a power of ten); nearest are {nearest}"
    )]
    CycleNotExpressible {
        /// The bus cycle in ns.
        cycle_ns: u64,
        /// The smallest value of 0x60C2:01.
        min: u8,
        /// The largest value of 0x60C2:01.
        max: u8,
        /// The nearest possible cycles as text.
        nearest: String,
    },
    /// A start-up SDO has another length than its object.
    #[error(
        "start-up SDO {} ({name}) has {given} bytes, the object has {expected}", address(*index, *sub)
    )]
    SdoLength {
        /// The index.
        index: u16,
        /// The subindex.
        sub: u8,
        /// The name of the element or object.
        name: String,
        /// The length of the SDO in bytes.
        given: usize,
        /// The length of the object in bytes.
        expected: usize,
    },
    /// An object of CoE is to be written to a device with SoE only.
    #[error(
        "{device} speaks SoE and not CoE: it has no object {}; write IDNs (`idn`) instead of `sdo`", address(*index, *sub)
    )]
    SoeOnly {
        /// The type name of the device.
        device: String,
        /// The index.
        index: u16,
        /// The subindex.
        sub: u8,
    },
    /// S-0-0001 and S-0-0002 cannot express the bus cycle.
    #[error(
        "{device}: a cycle of {cycle_ns} ns cannot be written to S-0-0001 and S-0-0002, which hold 1 to 65535 µs"
    )]
    SoeCycle {
        /// The type name of the device.
        device: String,
        /// The bus cycle in ns.
        cycle_ns: u64,
    },
    /// The choice needs a CoE mailbox, and the device has none.
    #[error("{device} has no CoE mailbox, so {what} cannot be written")]
    NoCoe {
        /// The type name of the device.
        device: String,
        /// The object or setting that cannot be written.
        what: &'static str,
    },
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
