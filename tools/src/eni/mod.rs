//! EtherCAT Network Information (ENI, ETG.2100): the configuration of a whole network as XML, as
//! configuration tools write it and MainDevices read it.
//!
//! [`export()`] writes what the bring-up of a machine sends, [`import()`] turns an ENI into a machine
//! file. `xml` is the element tree of both directions with its `value`s, `command` the datagrams and
//! SDOs in it, and `network` an ENI as read.

mod command;
pub mod export;
pub mod import;
mod network;
#[cfg(test)]
mod tests;
mod value;
mod xml;

pub use export::{Export, ExportError, export};
pub use import::{Import, Unsent, import};
pub use xml::{Element, EniError, MAX_BYTES};
