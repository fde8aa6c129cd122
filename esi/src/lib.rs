#![doc = include_str!("../README.md")]
//!
//! # Modules
//!
//! - [`Address`]: index and subindex of an object
//! - [`model`]: the contents of an ESI file; the origin of each derived value keeps its line
//! - [`parse`] (`xml/`): file bytes → model
//! - [`select`](mod@select): the user's choice of device, module, PDOs and DC mode
//! - [`layout`]: that choice → bit offsets
//! - [`startup`]: that choice → the SDOs to send before SafeOp
//! - [`sii`]: the EEPROM image, from an ESI device or from bytes
//! - [`lint`](mod@lint): problems in a readable file

#![deny(missing_docs)]
#![forbid(unsafe_code)]

pub mod axis;
mod error;
pub mod layout;
pub mod lint;
mod mode;
pub mod model;
pub mod select;
pub mod sii;
pub mod startup;
mod xml;

pub use ecaxis_ecat::object::{Address, address};
pub use error::{EsiError, EsiProblem};
pub use layout::{Field, Layout, SmLayout};
pub use lint::{Finding, Severity, lint};
pub use mode::{Mode, UnknownMode};
pub use model::*;
pub use select::{
    DcSettings, DeviceQuery, EntryRef, SelectError, SelectOptions, SelectedModule, Selection,
    UserSdo, find_device, module_names, offered_modes, plugged_modules, select,
};
pub use startup::{IdnValue, SDO_OF_MACHINE_FILE, StartupIdn, StartupSdo};
pub use xml::{decode_text, parse, parse_where};
