//! EtherCAT SubDevice Information: bytes in, data out. No I/O, no clock, no unsafe.
//!
//! - [`model`]: what an ESI file says, as data; every origin of a derived value keeps its line
//! - [`parse`] (`xml/`): the file's bytes → model

#![forbid(unsafe_code)]

mod error;
pub mod model;
mod xml;

pub use error::{EsiError, EsiProblem};
pub use model::*;
pub use xml::parse;
