//! The contents of an ESI file as data. Names follow ETG.2000. Each element that can be the origin
//! of a derived value keeps its line.
//!
//! * `device`: identity, revisions, properties, EEPROM
//! * `sync`: FMMUs, SyncManagers, sync units, DC operation modes
//! * `pdo`: PDOs and their entries
//! * `mailbox`: protocols and InitCmds
//! * `slots`: slots and their modules
//! * `dictionary`: objects with resolved types
//! * `shared_str`: names and types that many elements share
//! * `small_bytes`: values of objects
//!
//! ```
//! # let bytes = include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/io.xml"));
//! # let file = ecaxis_esi::parse(bytes)?;
//! let device = &file.devices[0];
//! assert_eq!((file.vendors[0].id, device.identity.product), (1, 2));
//! assert_eq!(device.sync_managers[3].start_address, 0x1200);
//! assert_eq!(device.tx_pdos[0].entries[0].index, 0x6000);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod device;
mod dictionary;
mod mailbox;
mod pdo;
mod shared_str;
mod slots;
mod small_bytes;
mod sync;

use std::fmt;

pub use device::*;
pub use dictionary::*;
pub use mailbox::*;
pub use pdo::*;
pub use shared_str::Text;
pub(crate) use slots::SlotPosition;
pub use slots::*;
pub use small_bytes::Bytes;
pub use sync::*;

/// The position in the file at which an element starts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Position {
    /// The line, from 1.
    pub line: u32,
    /// The column, from 1.
    pub column: u32,
}

impl Position {
    /// Returns the line as text. A device that an EEPROM image describes has none.
    #[must_use]
    pub fn origin(self) -> String {
        match self.line {
            0 => "EEPROM".to_owned(),
            line => format!("line {line}"),
        }
    }
}

impl fmt::Display for Position {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.line, self.column)
    }
}

/// A whole ESI file (`EtherCATInfo`).
#[derive(Debug, Clone, Default)]
pub struct EsiFile {
    /// The vendor of each `EtherCATInfo` in file order: one, except in an `EtherCATInfoList`.
    pub vendors: Vec<Vendor>,
    /// The groups of devices.
    pub groups: Vec<Group>,
    /// The devices in file order.
    pub devices: Vec<Device>,
    /// The devices that the caller of [`parse_where`](crate::parse_where) did not want.
    pub skipped: Vec<DeviceHeader>,
    /// The modules in file order.
    pub modules: Vec<Module>,
    /// `InfoReference`: other files, usually with root `EtherCATModule`, that contain further
    /// modules.
    pub references: Vec<String>,
    /// Inconsistent elements, and unreadable elements that the reader skipped.
    pub warnings: Vec<Warning>,
}

impl EsiFile {
    /// Returns the name of a vendor in the file; empty if the file does not name it.
    #[must_use]
    pub fn vendor_name(&self, id: u32) -> &str {
        let vendor = self.vendors.iter().find(|vendor| vendor.id == id);
        vendor.map_or("", |vendor| &vendor.name)
    }

    /// Returns identity, type and name of each device, first of those built.
    pub fn headers(&self) -> impl Iterator<Item = (Identity, &str, &str)> {
        let built = self.devices.iter();
        let built = built.map(|d| (d.identity, d.type_name.as_str(), d.name.as_str()));
        let skipped = self.skipped.iter();
        built.chain(skipped.map(|d| (d.identity, d.type_name.as_str(), d.name.as_str())))
    }
}

/// A problem of one element that the reader skipped or replaced.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Warning {
    /// The name of the referenced file; `None`: the warning is in the main file.
    pub file: Option<String>,
    /// The position of the element.
    pub position: Position,
    /// Element path, such as `EtherCATInfo/Descriptions/Devices/Device[1]/Sm[3]`.
    pub path: String,
    /// True if the element is unreadable and missing in the model. False if the reader kept an
    /// inconsistent element.
    pub left_out: bool,
    /// The problem as text.
    pub message: String,
}

/// The vendor of an ESI file.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Vendor {
    /// The vendor ID (ETG).
    pub id: u32,
    /// The name.
    pub name: String,
}

/// `Group`: a group of devices in a configurator. [`Device::group`] contains its `Type`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Group {
    /// `Type`.
    pub type_name: String,
    /// `Name`.
    pub name: String,
}

/// A name in one language.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct LocalName {
    /// Windows locale: 1033 English, 1031 German.
    pub lcid: Option<u32>,
    /// The text.
    pub text: String,
}
