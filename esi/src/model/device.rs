//! A device: its identity, the revisions that it covers, and its properties.

use std::fmt;

use super::{
    DcMode, Dictionary, Direction, Fmmu, FmmuUse, LocalName, Mailbox, Pdo, Position, Slots,
    SmMapping, SmUse, Soe, SyncManager, SyncUnit,
};
use ecaxis_ecat::vendor::VendorId;

use crate::layout::SmLayout;

/// Identity object 0x1018 without the serial number.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct Identity {
    /// The vendor ID, 0x1018:01.
    pub vendor: u32,
    /// The product code, 0x1018:02.
    pub product: u32,
    /// The revision number, 0x1018:03.
    pub revision: u32,
}

impl fmt::Display for Identity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "vendor {}, product 0x{:08x}, revision 0x{:08x}",
            VendorId(self.vendor),
            self.product,
            self.revision
        )
    }
}

/// The identity and the names of a device, without its content.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeviceHeader {
    /// The number of the `Device` element in the file, from 1.
    pub number: u32,
    /// Vendor, product code and revision.
    pub identity: Identity,
    /// Text of `Type`.
    pub type_name: String,
    /// As [`Device::name`].
    pub name: String,
}

/// One `Device` of an ESI file (ETG.2000).
#[derive(Debug, Clone, Default)]
pub struct Device {
    /// The position of the element.
    pub position: Position,
    /// Element path, as in [`super::Warning`].
    pub path: String,
    /// The number of the `Device` element in the file, from 1.
    pub number: u32,
    /// Vendor, product code and revision.
    pub identity: Identity,
    /// Text of `Type`, e.g. `EPOS4`.
    pub type_name: String,
    /// The English `Name` (LcId 1033) if there are several, otherwise the first.
    pub name: String,
    /// Every `Name`, in file order.
    pub names: Vec<LocalName>,
    /// `GroupType`: the group of the device.
    pub group: String,
    /// `Invisible`: configurators do not offer this device.
    pub invisible: bool,
    /// `HideType`: revisions that this device replaces.
    pub hides: Vec<HiddenType>,
    /// `CheckRevisionNo`: the revisions on the bus that this device description accepts.
    pub revision_check: RevisionCheck,
    /// `UseLrdLwr`: the device cannot process LRW.
    pub use_lrd_lwr: bool,
    /// `Info`: electrical properties, time-outs.
    pub info: Info,
    /// `Physics`: one letter per port, Y = MII, K = E-bus (`"YY"`, `"YKKY"`).
    pub physics: String,
    /// `Profile/ProfileNo` or `Profile/ChannelInfo/ProfileNo`: 402 for drives, 5001 for modular
    /// devices.
    pub profile: Option<u32>,
    /// `Fmmu` in file order.
    pub fmmus: Vec<Fmmu>,
    /// `Sm` in file order.
    pub sync_managers: Vec<SyncManager>,
    /// `Su` in file order.
    pub sync_units: Vec<SyncUnit>,
    /// `RxPdo`: PDOs with outputs.
    pub rx_pdos: Vec<Pdo>,
    /// `TxPdo`: PDOs with inputs.
    pub tx_pdos: Vec<Pdo>,
    /// `AlternativeSmMapping`: named PDO assignments.
    pub sm_mappings: Vec<SmMapping>,
    /// `Mailbox`; `None`: the device has no mailbox.
    pub mailbox: Option<Mailbox>,
    /// `Dc/OpMode` in file order. The first one is the default.
    pub dc_modes: Vec<DcMode>,
    /// `Slots` of a modular device.
    pub slots: Option<Slots>,
    /// The objects of `Profile/Dictionary`.
    pub dictionary: Dictionary,
    /// `DiagMessage` in file order.
    pub diag_messages: Vec<DiagMessage>,
    /// `Eeprom`: parts of the EEPROM image.
    pub eeprom: Eeprom,
    /// `ESC`: register values for Init.
    pub registers: InitialRegisters,
}

impl Device {
    /// Returns the properties of SoE (Sercos over EtherCAT) of a device without CoE, where IDNs define
    /// the process data.
    #[must_use]
    pub fn soe_only(&self) -> Option<&Soe> {
        let mailbox = self.mailbox.as_ref()?;
        mailbox.soe.as_ref().filter(|_| mailbox.coe.is_none())
    }

    /// Numbers the entries of a device with SoE only: each gets its drive as subindex.
    pub(crate) fn number_drives(&mut self) {
        if self.soe_only().is_none() {
            return;
        }
        for pdo in self.rx_pdos.iter_mut().chain(&mut self.tx_pdos) {
            let drive = pdo.drive();
            pdo.entries.iter_mut().for_each(|entry| entry.sub = drive);
        }
    }

    /// Decides what each SyncManager carries, once its PDOs are known. Returns the SyncManagers whose
    /// text says something else.
    pub(crate) fn resolve_sync_managers(&mut self) -> Vec<(u8, SmUse)> {
        let mut contradicted = Vec::new();
        for (number, sm) in (0..=u8::MAX).zip(&mut self.sync_managers) {
            let pdos = self.rx_pdos.iter().chain(&self.tx_pdos);
            let own = pdos.filter(|pdo| pdo.sm == Some(number));
            let resolved = sm.resolved(own.map(|pdo| pdo.direction));
            let text = std::mem::replace(&mut sm.usage, resolved);
            if text != SmUse::Other && text != resolved {
                contradicted.push((number, text));
            }
        }
        contradicted
    }

    /// Returns the SyncManager that carries a direction unless a PDO names another one.
    #[must_use]
    pub fn primary_sm(&self, direction: Direction) -> Option<u8> {
        let usage = SmUse::from(direction);
        let mut all = self.sync_managers.iter();
        u8::try_from(all.position(|sm| sm.usage == usage && !sm.virtual_)?).ok()
    }

    /// Returns the SyncManager through which the MainDevice reads the mailbox.
    #[must_use]
    pub fn mailbox_in(&self) -> Option<u8> {
        self.mailbox.as_ref()?;
        let mut all = self.sync_managers.iter();
        u8::try_from(all.position(|sm| sm.usage == SmUse::MBoxIn)?).ok()
    }

    /// Returns which parts of process data are enabled in Op only: the SyncManager, and the FMMU, also
    /// where only its own element says so.
    #[must_use]
    pub fn op_only(&self, sm: &SmLayout) -> OpOnly {
        let manager = self.sync_managers.get(usize::from(sm.sm));
        let sync_manager = manager.is_some_and(|sm| sm.op_only);
        let fmmu = sm
            .fmmu
            .and_then(|number| self.fmmus.get(usize::from(number)));
        OpOnly {
            sync_manager,
            fmmu: sync_manager || fmmu.is_some_and(|fmmu| fmmu.op_only),
        }
    }

    /// Returns the FMMU that maps the mailbox status into the process image (`Fmmu` of
    /// `MBoxState`), and the SyncManager whose status it maps.
    #[must_use]
    pub fn mailbox_status_fmmu(&self) -> Option<(u8, u8)> {
        let sm = self.mailbox_in()?;
        let mut all = self.fmmus.iter();
        let fmmu = all.position(|fmmu| fmmu.usage == FmmuUse::MBoxState)?;
        Some((u8::try_from(fmmu).ok()?, sm))
    }
}

/// The parts of process data that are enabled in Op only.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct OpOnly {
    /// The SyncManager.
    pub sync_manager: bool,
    /// The FMMU.
    pub fmmu: bool,
}

/// `HideType`. Without a product code in the file, the device's own product code applies.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct HiddenType {
    /// The product code; `None`: same as the device.
    pub product: Option<u32>,
    /// The revision number.
    pub revision: u32,
}

/// Rule to compare a revision on the bus (`found`) with that of the ESI; ETG.2000,
/// `CheckRevisionNo`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub enum RevisionCheck {
    /// The file contains no rule. Configurators accept an equal or newer revision.
    #[default]
    Unstated,
    /// Any revision.
    None,
    /// The same revision.
    Equal,
    /// An equal or newer revision.
    EqualOrGreater,
    /// The same low word.
    LowEqual,
    /// The same low word, an equal or greater high word.
    LowEqualHighEqualOrGreater,
    /// The same high word.
    HighEqual,
    /// The same high word, an equal or greater low word.
    HighEqualLowEqualOrGreater,
}

impl RevisionCheck {
    /// True if a device of revision `found` matches an ESI of revision `described`.
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

/// `Info`. Times in ms; `None`: not in the file.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Info {
    /// Init → PreOp and Init → Bootstrap.
    pub preop_timeout_ms: Option<u32>,
    /// PreOp → SafeOp and SafeOp → Op.
    pub safeop_op_timeout_ms: Option<u32>,
    /// Any state → Init.
    pub back_to_init_timeout_ms: Option<u32>,
    /// Op → SafeOp.
    pub back_to_safeop_timeout_ms: Option<u32>,
    /// `StartToSafeopNoSync`.
    pub start_to_safeop_no_sync: bool,
    /// The time until the device has read a request.
    pub mailbox_request_timeout_ms: Option<u32>,
    /// The time until the device has written its response.
    pub mailbox_response_timeout_ms: Option<u32>,
    /// The source of the explicit device identification.
    pub identification: Identification,
    /// The E-bus current that the device consumes, in mA. Negative: the device supplies current.
    pub ebus_current_ma: Option<i32>,
    /// `Port` in file order.
    pub ports: Vec<Port>,
    /// The size of the process RAM in bytes.
    pub dpram_bytes: Option<u32>,
    /// The number of SyncManagers.
    pub sm_count: Option<u32>,
    /// The number of FMMUs.
    pub fmmu_count: Option<u32>,
}

/// The source of the explicit device identification (a switch, or a number that the user sets).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub enum Identification {
    /// The device has none.
    #[default]
    No,
    /// AL control bit 5 requests the identification; register 0x0134 contains it.
    Reg134,
    /// This register or input contains the identification.
    Ado(u16),
}

/// `Info/Port`, port 0 first.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Port {
    /// The medium.
    pub kind: PortKind,
    /// The label at the socket.
    pub label: String,
    /// The delay from the socket to the controller in ns.
    pub rx_delay_ns: Option<u32>,
    /// The delay from the controller to the socket in ns.
    pub tx_delay_ns: Option<u32>,
}

/// The medium of a port.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub enum PortKind {
    /// The port does not exist or is not configured.
    #[default]
    None,
    /// Ethernet through a PHY.
    Mii,
    /// E-bus (LVDS).
    EBus,
}

/// `DiagMessage`: the text of a text ID in the diagnosis history (0x10F3).
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct DiagMessage {
    /// The text ID.
    pub text_id: u16,
    /// The text.
    pub text: String,
}

/// `ESC`: register values that the vendor requires in Init.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct InitialRegisters {
    /// Physical read/write offset.
    pub reg0108: Option<u16>,
    /// Watchdog divider.
    pub reg0400: Option<u16>,
    /// PDI watchdog time.
    pub reg0410: Option<u16>,
    /// Process data watchdog time.
    pub reg0420: Option<u16>,
}

/// `Eeprom`: the parts of an EEPROM image.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Eeprom {
    /// The size in bytes.
    pub byte_size: u32,
    /// Words 0–6 of the SII (PDI control, configuration, …), as in the file.
    pub config_data: Vec<u8>,
    /// Words 0x14–0x17: bootstrap mailbox offsets and sizes.
    pub bootstrap: Vec<u8>,
    /// Further categories that the vendor adds to the image.
    pub categories: Vec<EepromCategory>,
    /// `Data`: the whole image, if the file contains it instead of its parts.
    pub image: Vec<u8>,
    /// The device's processor owns the image. The MainDevice assigns EEPROM access to the PDI.
    pub assign_to_pdi: bool,
}

/// `Eeprom/Category`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct EepromCategory {
    /// The category type (ETG.2010).
    pub number: u16,
    /// The contents.
    pub data: Vec<u8>,
    /// Writing an image keeps the category that the device already contains.
    pub preserve: bool,
}
