//! EtherCAT SubDevice Information: bytes in, data out. No I/O, no clock, no unsafe.
//!
//! - [`Address`]: index and subindex of an object
//! - [`model`]: what an ESI file says, as data; every origin of a derived value keeps its line
//! - [`parse`] (`xml/`): the file's bytes → model
//! - [`select`](mod@select): the user's choice of device, module, PDOs and DC mode
//! - [`layout`]: that choice → bit offsets
//! - [`startup`]: that choice → the SDOs to send before SafeOp
//! - [`sii`]: the EEPROM image, from an ESI device or from bytes
//! - [`lint`](mod@lint): what is wrong with a file that can be read

#![forbid(unsafe_code)]

mod address;
mod error;
pub mod layout;
pub mod lint;
mod mode;
pub mod model;
pub mod select;
pub mod sii;
pub mod startup;
mod xml;

pub use address::{Address, address};
pub use error::{EsiError, EsiProblem};
pub use layout::{Field, Layout, SmLayout};
pub use lint::{Finding, Severity, lint};
pub use mode::{Mode, UnknownMode};
pub use model::*;
pub use select::{
    Choice, DcSettings, DeviceQuery, EntryRef, SelectError, SelectedModule, Selection, UserSdo,
    find_device, offered_modes, select,
};
pub use startup::StartupSdo;
pub use xml::parse;
