//! The EEPROM image (SII, ETG.2010): the self-description of a SubDevice, readable without its ESI.
//!
//! `image` derives the contents from an ESI device, `device` a device from the contents. `emit`
//! writes the bytes and `parse` reads them. `strings` helps both. `warning` lists problems in one image, `compare` lists differences between
//! two images.
//!
//! [`Sii`] is the common type. `parse(emit(sii))` returns the same value if its texts are ASCII
//! with at most 63 characters.
//!
//! ```
//! use ecaxis_esi::sii::{SiiOptions, emit, inspect};
//!
//! # let bytes = include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/io.xml"));
//! # let file = ecaxis_esi::parse(bytes)?;
//! let options = SiiOptions { serial: 7, ..SiiOptions::default() };
//! let image = emit(&file.devices[0], &file.modules, &options);
//! let (sii, warnings) = inspect(&image)?;
//! assert_eq!((sii.identity.product, sii.serial), (2, 7));
//! assert!(warnings.is_empty());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod compare;
mod device;
mod emit;
mod image;
mod parse;
mod strings;
mod warning;

pub use compare::{Difference, DifferenceKind, compare};
pub use device::MailboxDifference;
pub use emit::checksum;
pub use image::SiiOptions;
pub use parse::SiiError;
pub use warning::{SiiWarning, WarningKind};

use ecaxis_ecat::sii::{HEADER_BYTES, category};

use crate::model::{Device, FmmuUse, Identity, Module, SmUse};

/// The contents of an EEPROM image (ETG.2010).
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Sii {
    /// Words 0–3, 5 and 6: PDI control, PDI configuration, pulse length, extended PDI
    /// configuration, reserved.
    pub config: [u8; 14],
    /// The configured station alias (word 4, part of `config`).
    pub alias: u16,
    /// True if the checksum of `config` is correct. A controller ignores an image with a wrong
    /// checksum.
    pub checksum_ok: bool,
    /// Vendor, product code and revision, words 8 to 13.
    pub identity: Identity,
    /// The serial number, words 14 and 15.
    pub serial: u32,
    /// The mailbox in Bootstrap, words 0x14 to 0x17.
    pub bootstrap: MailboxAreas,
    /// The mailbox in the other states, words 0x18 to 0x1B.
    pub mailbox: MailboxAreas,
    /// The mailbox protocols, word 0x1C.
    pub protocols: Protocols,
    /// The EEPROM size in bytes that the image states.
    pub byte_size: u32,
    /// Category 30.
    pub general: Option<General>,
    /// Category 40, one usage per FMMU.
    pub fmmus: Vec<FmmuUse>,
    /// Category 41.
    pub sync_managers: Vec<SiiSyncManager>,
    /// Category 50.
    pub tx_pdos: Vec<SiiPdo>,
    /// Category 51.
    pub rx_pdos: Vec<SiiPdo>,
    /// Category 60.
    pub dc: Vec<SiiDc>,
    /// Extended FMMU settings (category 42), one per FMMU. Empty if the image has none.
    pub fmmu_details: Vec<SiiFmmuDetail>,
    /// Four flags per sync unit (category 43): bit 0 separate, 1 separate frame, 2 depends on the
    /// input state, 3 frames may be repeated.
    pub sync_units: Vec<u8>,
    /// Uninterpreted categories in raw form: data types, dictionaries, vendor-specific categories.
    pub others: Vec<(u16, Vec<u8>)>,
    /// True if the image has an end mark.
    pub ended: bool,
    /// Damaged categories and PDOs, which are ignored.
    pub damage: Vec<SiiWarning>,
}

/// Mailbox areas from the SubDevice's view: MainDevice → SubDevice (`receive`) and SubDevice →
/// MainDevice (`send`).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct MailboxAreas {
    /// The address of the mailbox that the device receives.
    pub receive_offset: u16,
    /// Its size in bytes.
    pub receive_size: u16,
    /// The address of the mailbox that the device sends.
    pub send_offset: u16,
    /// Its size in bytes.
    pub send_size: u16,
}

/// Word 0x1C.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Protocols(pub u16);

impl Protocols {
    /// ADS over EtherCAT.
    pub const AOE: u16 = 0x01;
    /// Ethernet over EtherCAT.
    pub const EOE: u16 = 0x02;
    /// CANopen over EtherCAT.
    pub const COE: u16 = 0x04;
    /// File access over EtherCAT.
    pub const FOE: u16 = 0x08;
    /// Servo drive profile over EtherCAT.
    pub const SOE: u16 = 0x10;
    /// Vendor-specific protocol over EtherCAT.
    pub const VOE: u16 = 0x20;

    /// True if one of these bits is set.
    #[must_use]
    pub fn has(self, protocol: u16) -> bool {
        self.0 & protocol != 0
    }
}

/// Category 30: names and properties.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct General {
    /// The type of the device group.
    pub group: String,
    /// The name of the picture.
    pub image: String,
    /// The order number (type name).
    pub order: String,
    /// The name.
    pub name: String,
    /// Bit 0 SDO, 1 SDO Info, 2 PDO assign, 3 PDO configuration, 4 PDO upload, 5 complete access.
    pub coe_details: u8,
    /// True if FoE is enabled.
    pub foe: bool,
    /// True if EoE is enabled.
    pub eoe: bool,
    /// Bit 0: SafeOp is allowed, bit 1: no LRW, bit 2: mailbox data link layer, bit 3:
    /// identification in the AL status code register, bit 4: identification at
    /// `identification_address`.
    pub flags: u8,
    /// The E-bus current in mA; negative: the device supplies current.
    pub ebus_ma: i16,
    /// Four bits per port: 0 none, 1 MII, 3 E-bus, 4 fast hot connect.
    pub ports: u16,
    /// The address of the explicit identification.
    pub identification_address: u16,
}

impl General {
    /// Bit of `flags`: the device cannot process LRW.
    pub const NO_LRW: u8 = 0x02;
    /// Bit of `flags`: the mailbox repeats lost reads.
    pub const DATA_LINK_LAYER: u8 = 0x04;
    /// Bit of `flags`: identification in the AL status code register.
    pub const IDENTIFICATION_AL_STATUS: u8 = 0x08;
    /// Bit of `flags`: identification at `identification_address`.
    pub const IDENTIFICATION_ADDRESS: u8 = 0x10;
}

/// Category 42: four bytes per FMMU.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SiiFmmuDetail {
    /// Enabled in Op only.
    pub op_only: bool,
    /// The SyncManager of the FMMU.
    pub sm: Option<u8>,
    /// The sync unit of the FMMU.
    pub su: Option<u8>,
}

/// Category 41: one SyncManager.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SiiSyncManager {
    /// The physical start address.
    pub start_address: u16,
    /// The length in bytes.
    pub len: u16,
    /// The control byte.
    pub control: u8,
    /// Bit 0 enabled, bit 1 fixed contents, bit 2 virtual, bit 3 in Op only.
    pub enable: u8,
    /// The usage.
    pub usage: SmUse,
}

/// Categories 50 and 51: one PDO.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SiiPdo {
    /// The index.
    pub index: u16,
    /// The name.
    pub name: String,
    /// `None`: not assigned by default.
    pub sm: Option<u8>,
    /// The synchronization, an index of category 60.
    pub synchronization: u8,
    /// Bit 0 mandatory, 4 fixed, 5 virtual.
    pub flags: u16,
    /// The entries in order.
    pub entries: Vec<SiiEntry>,
}

/// One entry of a PDO.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SiiEntry {
    /// The index.
    pub index: u16,
    /// The subindex.
    pub sub: u8,
    /// The name.
    pub name: String,
    /// The index of the base type in the object dictionary's type area (ETG.1020).
    pub data_type: u8,
    /// The length in bits.
    pub bit_len: u8,
    /// Reserved; ETG.2010 demands 0.
    pub flags: u16,
}

/// Category 60: one DC mode. Times in ns.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SiiDc {
    /// The name.
    pub name: String,
    /// The description.
    pub description: String,
    /// Low byte → 0x0980, high byte → 0x0981.
    pub assign_activate: u16,
    /// The SYNC0 cycle time.
    pub cycle0_ns: u32,
    /// The SYNC0 shift.
    pub shift0_ns: i32,
    /// The SYNC1 shift.
    pub shift1_ns: i32,
    /// `CycleTimeSync0/@Factor` of the ESI.
    pub sync0_factor: i16,
    /// `CycleTimeSync1/@Factor` of the ESI.
    pub sync1_factor: i16,
}

impl SiiPdo {
    /// Returns the length in bits.
    #[must_use]
    pub fn bit_len(&self) -> u32 {
        self.entries
            .iter()
            .map(|entry| u32::from(entry.bit_len))
            .sum()
    }
}

/// Returns the EEPROM image of a device from its ESI. A modular device contains its default module.
#[must_use]
pub fn emit(device: &Device, modules: &[Module], options: &SiiOptions) -> Vec<u8> {
    Sii::from_device(device, modules, options).to_bytes()
}

/// Returns the length of the chip if `bytes` were read from a device beyond its end, where its
/// beginning repeats; else the number of bytes.
#[must_use]
pub fn chip_length(bytes: &[u8]) -> usize {
    parse::chip_length(bytes)
}

/// Reads an EEPROM image. Damaged categories are ignored, see [`Sii::damage`].
pub fn parse(bytes: &[u8]) -> Result<Sii, SiiError> {
    parse::image(bytes).map(|(sii, _)| sii)
}

/// Reads an EEPROM image and returns its problems as well, if the image is readable.
pub fn inspect(bytes: &[u8]) -> Result<(Sii, Vec<SiiWarning>), SiiError> {
    parse::image(bytes)
}

fn fmmu_code(usage: FmmuUse) -> u8 {
    match usage {
        FmmuUse::Outputs => 1,
        FmmuUse::Inputs => 2,
        FmmuUse::MBoxState => 3,
        FmmuUse::Other => 0,
    }
}

fn fmmu_use(code: u8) -> FmmuUse {
    match code {
        1 => FmmuUse::Outputs,
        2 => FmmuUse::Inputs,
        3 => FmmuUse::MBoxState,
        _ => FmmuUse::Other,
    }
}

fn sm_code(usage: SmUse) -> u8 {
    match usage {
        SmUse::MBoxOut => 1,
        SmUse::MBoxIn => 2,
        SmUse::Outputs => 3,
        SmUse::Inputs => 4,
        SmUse::Other => 0,
    }
}

fn sm_use(code: u8) -> SmUse {
    match code {
        1 => SmUse::MBoxOut,
        2 => SmUse::MBoxIn,
        3 => SmUse::Outputs,
        4 => SmUse::Inputs,
        _ => SmUse::Other,
    }
}
