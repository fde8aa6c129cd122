//! What an ESI file says, as data. Names follow ETG.2000; every element that can be the origin of a
//! derived value keeps the line it stands on.

use std::fmt;

/// Where in the file an element starts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct Position {
    pub line: u32,
    pub column: u32,
}

impl fmt::Display for Position {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.line, self.column)
    }
}

/// A whole ESI file (`EtherCATInfo`).
#[derive(Debug, Clone, Default)]
pub struct EsiFile {
    pub vendor: Vendor,
    pub devices: Vec<Device>,
    pub modules: Vec<Module>,
    /// What was odd but could be read all the same.
    pub warnings: Vec<Warning>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Warning {
    pub position: Position,
    /// Element path, `EtherCATInfo/Descriptions/Devices/Device[1]/Sm[3]`.
    pub path: String,
    pub message: String,
}

#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Vendor {
    pub id: u32,
    pub name: String,
}

/// Identity object 0x1018 without the serial number.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct Identity {
    pub vendor: u32,
    pub product: u32,
    pub revision: u32,
}

impl fmt::Display for Identity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "vendor 0x{:08x}, product 0x{:08x}, revision 0x{:08x}",
            self.vendor, self.product, self.revision
        )
    }
}

#[derive(Debug, Clone, Default)]
pub struct Device {
    pub position: Position,
    pub identity: Identity,
    /// Text of `Type`, e.g. `EPOS4`.
    pub type_name: String,
    /// English `Name` where there are several (LcId 1033), else the first.
    pub name: String,
    /// `Physics`: one letter a port, Y = MII/EBUS as the device has it (`"YY"`, `"YKKY"`).
    pub physics: String,
    /// `Profile/ProfileNo` or `Profile/ChannelInfo/ProfileNo`: 402 for drives, 5001 for modular devices.
    pub profile: Option<u32>,
    pub fmmus: Vec<FmmuUse>,
    pub sync_managers: Vec<SyncManager>,
    pub rx_pdos: Vec<Pdo>,
    pub tx_pdos: Vec<Pdo>,
    pub mailbox: Option<Mailbox>,
    /// `Dc/OpMode`, in file order; the first is the default.
    pub dc_modes: Vec<DcMode>,
    pub slots: Option<Slots>,
    pub dictionary: Dictionary,
    pub eeprom: Eeprom,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum FmmuUse {
    Outputs,
    Inputs,
    MBoxState,
    /// Empty or unknown text.
    Other,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SmUse {
    MBoxOut,
    MBoxIn,
    Outputs,
    Inputs,
    /// Empty or unknown text.
    Other,
}

/// One `Sm` element; its place in `Device::sync_managers` is its number.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SyncManager {
    pub position: Position,
    pub usage: SmUse,
    pub start_address: u16,
    /// Bytes; 0 where the file gives none.
    pub default_size: u16,
    pub min_size: Option<u16>,
    pub max_size: Option<u16>,
    pub control_byte: u8,
    pub enable: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Direction {
    /// MainDevice → SubDevice (outputs, 0x16xx, 0x1C12).
    Rx,
    /// SubDevice → MainDevice (inputs, 0x1Axx, 0x1C13).
    Tx,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Pdo {
    pub position: Position,
    pub direction: Direction,
    pub index: u16,
    pub name: String,
    /// SyncManager it is assigned to by default; `None`: not in the default assignment.
    pub sm: Option<u8>,
    /// The contents cannot be changed.
    pub fixed: bool,
    pub mandatory: bool,
    pub virtual_: bool,
    /// A slot's module replaces this PDO's contents.
    pub overwritten_by_module: bool,
    pub exclude: Vec<u16>,
    pub entries: Vec<Entry>,
}

impl Pdo {
    #[must_use]
    pub fn bit_len(&self) -> u32 {
        self.entries.iter().map(|e| u32::from(e.bit_len)).sum()
    }
}

/// A mapped object, or a gap where `index` is 0.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Entry {
    pub position: Position,
    pub index: u16,
    pub sub: u8,
    pub bit_len: u16,
    pub name: String,
    /// ETG.2000 base type name (`UINT`, `DINT`, `BOOL` …), empty for a gap.
    pub data_type: String,
}

impl Entry {
    #[must_use]
    pub fn is_gap(&self) -> bool {
        self.index == 0
    }

    /// The UDINT that stands in 0x16xx/0x1Axx for this entry: index, subindex, bit length.
    /// Entries longer than 255 bits keep the low byte of their length.
    #[must_use]
    pub fn mapping(&self) -> u32 {
        u32::from(self.index) << 16 | u32::from(self.sub) << 8 | u32::from(self.bit_len & 0xff)
    }
}

#[derive(Debug, Clone, Default)]
pub struct Mailbox {
    pub data_link_layer: bool,
    pub coe: Option<Coe>,
    pub foe: bool,
    pub eoe: bool,
    pub soe: bool,
    pub aoe: bool,
    pub voe: bool,
}

#[derive(Debug, Clone, Default)]
pub struct Coe {
    pub sdo_info: bool,
    /// PDO assignment (0x1C12/0x1C13) may be written.
    pub pdo_assign: bool,
    /// PDO contents (0x16xx/0x1Axx) may be written.
    pub pdo_config: bool,
    pub pdo_upload: bool,
    pub complete_access: bool,
    pub segmented_sdo: bool,
    pub diag_history: bool,
    pub init_cmds: Vec<InitCmd>,
}

/// `InitCmd`: an SDO download that the device's maker wants sent at a transition.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InitCmd {
    pub position: Position,
    /// `IP`, `PS`, `SO` …; one command may name several.
    pub transitions: Vec<String>,
    pub index: u16,
    pub sub: u8,
    pub complete_access: bool,
    pub data: Vec<u8>,
    pub comment: String,
}

/// `Dc/OpMode`. Times in nanoseconds.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct DcMode {
    pub position: Position,
    pub name: String,
    pub description: String,
    /// Low byte → 0x0980, high byte → 0x0981.
    pub assign_activate: u16,
    pub sync0: SyncTime,
    pub sync1: SyncTime,
}

/// Cycle and shift of one SYNC signal as written; `Factor` relates it to the bus cycle.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SyncTime {
    /// Absolute cycle in nanoseconds; 0: derive from the factor.
    pub cycle_ns: i64,
    /// > 0: bus cycle × factor, < 0: bus cycle ÷ |factor|, 0: none.
    pub factor: i32,
    pub shift_ns: i64,
    pub shift_factor: i32,
    /// `Input="1"`: shift relative to the input event.
    pub shift_input: bool,
}

#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Slots {
    pub position: Position,
    pub max_count: Option<u32>,
    pub pdo_increment: u16,
    pub index_increment: u16,
    /// 0xF030 must be written with the configured module identities.
    pub download_module_ident_list: bool,
    pub slots: Vec<Slot>,
}

#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Slot {
    pub position: Position,
    pub name: String,
    pub min_instances: u32,
    pub max_instances: u32,
    /// (module identity, is the default)
    pub module_idents: Vec<(u32, bool)>,
}

#[derive(Debug, Clone, Default)]
pub struct Module {
    pub position: Position,
    pub ident: u32,
    pub type_name: String,
    pub name: String,
    /// As [`Device::profile`].
    pub profile: Option<u32>,
    pub rx_pdos: Vec<Pdo>,
    pub tx_pdos: Vec<Pdo>,
    pub init_cmds: Vec<InitCmd>,
    /// `DcOpModeName`: which OpMode of the device the module wants.
    pub dc_mode: Option<String>,
    pub dictionary: Dictionary,
}

/// Objects in file order, types resolved: every readable subindex is an item of its object.
#[derive(Debug, Clone, Default)]
pub struct Dictionary {
    pub objects: Vec<Object>,
}

impl Dictionary {
    #[must_use]
    pub fn object(&self, index: u16) -> Option<&Object> {
        self.objects.iter().find(|o| o.index == index)
    }

    #[must_use]
    pub fn item(&self, index: u16, sub: u8) -> Option<&ObjectItem> {
        self.object(index)?.items.iter().find(|i| i.sub == sub)
    }
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum ObjectCode {
    #[default]
    Var,
    Array,
    Record,
}

#[derive(Debug, Clone, Default)]
pub struct Object {
    pub position: Position,
    pub index: u16,
    pub name: String,
    pub code: ObjectCode,
    /// Name of the type as the file writes it.
    pub type_name: String,
    /// Subindex 0 first. A simple variable has exactly one item, with subindex 0.
    pub items: Vec<ObjectItem>,
}

#[derive(Debug, Clone, Default)]
pub struct ObjectItem {
    pub sub: u8,
    pub name: String,
    /// Base type name (`USINT`, `DINT`, `STRING(5)`, `ARRAY [0..15] OF BYTE`).
    pub type_name: String,
    pub bit_len: u32,
    /// Offset inside the object as complete access sees it, subindex 0 padded to 16 bits.
    pub bit_offset: u32,
    /// Little-endian, exactly `bit_len.div_ceil(8)` bytes; zero where the file gives no default.
    pub default: Vec<u8>,
    pub has_default: bool,
    pub min: Option<Vec<u8>>,
    pub max: Option<Vec<u8>>,
    pub access: Access,
    pub pdo_mapping: PdoMapping,
    /// `Backup`: kept over a power cycle once parameters are stored.
    pub backup: bool,
    /// `Setting`: belongs to what a machine configures at start-up.
    pub setting: bool,
    /// `Unit`, coded as in ETG.1004; 0 where the file gives none.
    pub unit: u32,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Access {
    pub read: bool,
    pub write: Writable,
}

impl Default for Access {
    fn default() -> Self {
        Self {
            read: true,
            write: Writable::Never,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Writable {
    Never,
    Always,
    /// `WriteRestrictions` name the states in which it may be written.
    Only {
        pre_op: bool,
        safe_op: bool,
        op: bool,
    },
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PdoMapping {
    pub rx: bool,
    pub tx: bool,
}

#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Eeprom {
    /// Bytes.
    pub byte_size: u32,
    /// Words 0–6 of the SII (PDI control, configuration …), as written.
    pub config_data: Vec<u8>,
    /// Words 0x14–0x17: bootstrap mailbox offsets and sizes.
    pub bootstrap: Vec<u8>,
}
