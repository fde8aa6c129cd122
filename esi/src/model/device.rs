//! A device: who it is, which revisions it stands for, what it says of itself.

use std::fmt;

use super::{
    DcMode, Dictionary, Fmmu, FmmuUse, LocalName, Mailbox, Pdo, Position, Slots, SmMapping, SmUse,
    SyncManager, SyncUnit,
};

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
    /// Element path, as in [`super::Warning`].
    pub path: String,
    pub identity: Identity,
    /// Text of `Type`, e.g. `EPOS4`.
    pub type_name: String,
    /// English `Name` where there are several (LcId 1033), else the first.
    pub name: String,
    /// Every `Name`, in file order.
    pub names: Vec<LocalName>,
    pub group: String,
    /// Not meant to be offered for choice: `Invisible`.
    pub invisible: bool,
    /// `HideType`: revisions that this device takes the place of.
    pub hides: Vec<HiddenType>,
    /// `CheckRevisionNo`: which revisions on the bus may stand for this one.
    pub revision_check: RevisionCheck,
    /// `UseLrdLwr`: the device cannot process LRW.
    pub use_lrd_lwr: bool,
    pub info: Info,
    /// `Physics`: one letter a port, Y = MII/EBUS as the device has it (`"YY"`, `"YKKY"`).
    pub physics: String,
    /// `Profile/ProfileNo` or `Profile/ChannelInfo/ProfileNo`: 402 for drives, 5001 for modular devices.
    pub profile: Option<u32>,
    pub fmmus: Vec<Fmmu>,
    pub sync_managers: Vec<SyncManager>,
    pub sync_units: Vec<SyncUnit>,
    pub rx_pdos: Vec<Pdo>,
    pub tx_pdos: Vec<Pdo>,
    /// `AlternativeSmMapping`: PDO assignments by name.
    pub sm_mappings: Vec<SmMapping>,
    pub mailbox: Option<Mailbox>,
    /// `Dc/OpMode`, in file order; the first is the default.
    pub dc_modes: Vec<DcMode>,
    pub slots: Option<Slots>,
    pub dictionary: Dictionary,
    pub diag_messages: Vec<DiagMessage>,
    pub eeprom: Eeprom,
    pub registers: InitialRegisters,
}

impl Device {
    /// SERCOS over EtherCAT without CoE: IDNs decide about its process data.
    #[must_use]
    pub fn speaks_soe_alone(&self) -> bool {
        let mailbox = self.mailbox.as_ref();
        mailbox.is_some_and(|mailbox| mailbox.soe && mailbox.coe.is_none())
    }

    /// The SyncManager through which its mailbox is read.
    #[must_use]
    pub fn mailbox_in(&self) -> Option<u8> {
        self.mailbox.as_ref()?;
        let mut all = self.sync_managers.iter();
        u8::try_from(all.position(|sm| sm.usage == SmUse::MBoxIn)?).ok()
    }

    /// The FMMU that brings the status of that SyncManager into the process image (`Fmmu` of `MBoxState`), and the SyncManager.
    #[must_use]
    pub fn mailbox_status_fmmu(&self) -> Option<(u8, u8)> {
        let sm = self.mailbox_in()?;
        let mut all = self.fmmus.iter();
        let fmmu = all.position(|fmmu| fmmu.usage == FmmuUse::MBoxState)?;
        Some((u8::try_from(fmmu).ok()?, sm))
    }
}

/// `HideType`. Where no product code is written, the device's own is meant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct HiddenType {
    pub product: Option<u32>,
    pub revision: u32,
}

/// How a revision on the bus (`found`) is compared with the ESI's; ETG.2000, `CheckRevisionNo`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub enum RevisionCheck {
    /// The file says nothing: equal or newer is what configurators take.
    #[default]
    Unstated,
    None,
    Equal,
    EqualOrGreater,
    LowEqual,
    LowEqualHighEqualOrGreater,
    HighEqual,
    HighEqualLowEqualOrGreater,
}

impl RevisionCheck {
    /// Whether a device of revision `found` may stand for an ESI of revision `described`.
    #[must_use]
    pub fn accepts(self, described: u32, found: u32) -> bool {
        let [low, high] = [|r: u32| r & 0xffff, |r: u32| r >> 16];
        match self {
            Self::None => true,
            Self::Equal => found == described,
            Self::Unstated | Self::EqualOrGreater => found >= described,
            Self::LowEqual => low(found) == low(described),
            Self::LowEqualHighEqualOrGreater => {
                low(found) == low(described) && high(found) >= high(described)
            }
            Self::HighEqual => high(found) == high(described),
            Self::HighEqualLowEqualOrGreater => {
                high(found) == high(described) && low(found) >= low(described)
            }
        }
    }
}

/// `Info`. Times in milliseconds; `None`: the file says nothing.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Info {
    /// Init → PreOp and Init → Bootstrap.
    pub preop_timeout_ms: Option<u32>,
    /// PreOp → SafeOp and SafeOp → Op.
    pub safeop_op_timeout_ms: Option<u32>,
    pub back_to_init_timeout_ms: Option<u32>,
    pub back_to_safeop_timeout_ms: Option<u32>,
    pub start_to_safeop_no_sync: bool,
    pub mailbox_request_timeout_ms: Option<u32>,
    pub mailbox_response_timeout_ms: Option<u32>,
    pub identification: Identification,
    /// What the device takes from the E-bus, mA; negative: supplies.
    pub ebus_current_ma: Option<i32>,
    pub ports: Vec<Port>,
    pub dpram_bytes: Option<u32>,
    pub sm_count: Option<u32>,
    pub fmmu_count: Option<u32>,
}

/// Where explicit device identification (a switch, a number set by the user) can be read.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub enum Identification {
    #[default]
    No,
    /// AL control bit 5 asks, 0x0134 answers.
    Reg134,
    /// In this register or input.
    Ado(u16),
}

/// `Info/Port`, port 0 first.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Port {
    pub kind: PortKind,
    pub label: String,
    pub rx_delay_ns: Option<u32>,
    pub tx_delay_ns: Option<u32>,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub enum PortKind {
    #[default]
    None,
    Mii,
    EBus,
}

/// `DiagMessage`: the text behind a text id of the diagnosis history (0x10F3).
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct DiagMessage {
    pub text_id: u16,
    pub text: String,
}

/// `ESC`: register values that the maker wants set in Init.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct InitialRegisters {
    pub reg0108: Option<u16>,
    pub reg0400: Option<u16>,
    pub reg0410: Option<u16>,
    pub reg0420: Option<u16>,
}

#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Eeprom {
    /// Bytes.
    pub byte_size: u32,
    /// Words 0–6 of the SII (PDI control, configuration …), as written.
    pub config_data: Vec<u8>,
    /// Words 0x14–0x17: bootstrap mailbox offsets and sizes.
    pub bootstrap: Vec<u8>,
    /// Further categories that the maker wants in the image.
    pub categories: Vec<EepromCategory>,
    /// `Data`: the whole image, where the file has that instead of its parts.
    pub image: Vec<u8>,
    /// The image belongs to the device's processor; a MainDevice hands it over.
    pub assign_to_pdi: bool,
}

/// `Eeprom/Category`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct EepromCategory {
    pub number: u16,
    pub data: Vec<u8>,
    /// What the device holds is kept when an image is written.
    pub preserve: bool,
}
