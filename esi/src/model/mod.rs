//! What an ESI file says, as data. Names follow ETG.2000; every element that can be the origin of a
//! derived value keeps the line it stands on.
//!
//! * `device`: identity, revisions, what the device says of itself, EEPROM
//! * `sync`: FMMUs, SyncManagers, sync units, DC operation modes
//! * `pdo`: PDOs and their entries
//! * `mailbox`: protocols and InitCmds
//! * `slots`: slots and the modules that go there
//! * `dictionary`: objects, types resolved
//! * `text`: names and types that many of them share; `bytes`: values of objects

mod bytes;
mod device;
mod dictionary;
mod mailbox;
mod pdo;
mod slots;
mod sync;
mod text;

use std::fmt;

pub use bytes::Bytes;
pub use device::*;
pub use dictionary::*;
pub use mailbox::*;
pub use pdo::*;
pub(crate) use slots::Place;
pub use slots::*;
pub use sync::*;
pub use text::Text;

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
    pub groups: Vec<Group>,
    pub devices: Vec<Device>,
    pub modules: Vec<Module>,
    /// `InfoReference`: other files, usually of root `EtherCATModule`, that hold further modules.
    pub references: Vec<String>,
    /// What was odd, and what could not be read and was left out.
    pub warnings: Vec<Warning>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Warning {
    /// Name of the file, where it is one that the file at hand refers to.
    pub file: Option<String>,
    pub position: Position,
    /// Element path, `EtherCATInfo/Descriptions/Devices/Device[1]/Sm[3]`.
    pub path: String,
    /// It could not be read and is not in the model; `false`: it was odd and read all the same.
    pub left_out: bool,
    pub message: String,
}

#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Vendor {
    pub id: u32,
    pub name: String,
}

/// `Group`: how a configurator sorts devices; [`Device::group`] names its `Type`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Group {
    pub type_name: String,
    pub name: String,
}

/// A name in one language.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct LocalName {
    /// Windows locale, 1033 English, 1031 German.
    pub lcid: Option<u32>,
    pub text: String,
}
