//! CANopen over EtherCAT: the object dictionary and the server that answers for it.
//!
//! * `store`: every object as a slot in one arena
//! * `objects`: reading and writing with access rights, ranges and complete access
//! * `pdo`: PDO assignment and mapping, modules
//! * `sdo`: the SDO server: expedited, normal and segmented transfers

mod abort;
mod objects;
pub mod pdo;
mod sdo;
pub mod store;

pub use abort::Abort;
pub(crate) use objects::{Dictionary, read_item};
pub(crate) use sdo::SdoServer;

/// CoE services (the header's upper four bits).
pub(crate) mod service {
    pub(crate) const EMERGENCY: u8 = 1;
    pub(crate) const SDO_REQUEST: u8 = 2;
    pub(crate) const SDO_RESPONSE: u8 = 3;
    pub(crate) const SDO_INFORMATION: u8 = 8;
}

/// CoE header: number 0 and the service.
pub(crate) fn header(service: u8) -> [u8; 2] {
    (u16::from(service) << 12).to_le_bytes()
}
