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
    pub groups: Vec<Group>,
    pub devices: Vec<Device>,
    pub modules: Vec<Module>,
    /// `InfoReference`: other files, usually with root `EtherCATModule`, that contain further
    /// modules.
    pub references: Vec<String>,
    /// Inconsistent elements, and unreadable elements that the reader skipped.
    pub warnings: Vec<Warning>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Warning {
    /// The name of the referenced file; `None`: the warning is in the main file.
    pub file: Option<String>,
    pub position: Position,
    /// Element path, such as `EtherCATInfo/Descriptions/Devices/Device[1]/Sm[3]`.
    pub path: String,
    /// True if the element is unreadable and missing in the model. False if the reader kept an
    /// inconsistent element.
    pub left_out: bool,
    pub message: String,
}

#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Vendor {
    pub id: u32,
    pub name: String,
}

/// `Group`: a group of devices in a configurator. [`Device::group`] contains its `Type`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Group {
    pub type_name: String,
    pub name: String,
}

/// A name in one language.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct LocalName {
    /// Windows locale: 1033 English, 1031 German.
    pub lcid: Option<u32>,
    pub text: String,
}
