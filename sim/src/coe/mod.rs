//! CANopen over EtherCAT: the object dictionary and its servers.
//!
//! * `object_dictionary`: every object as an entry in one byte arena
//! * `word`: the location of a value in the arena
//! * `datatype`: data types, their codes and ranges
//! * `objects`: reading and writing with access rights and complete access
//! * `pdo`: PDO assignment and mapping, modules
//! * `startup`: start-up downloads that are accepted whatever the dictionary says
//! * `sdo`: the SDO server: expedited, normal and segmented transfers
//! * `info`: SDO Information: the list of objects
//! * `history`: the diagnosis history
//!
//! This module maps CoE messages to answers. [`crate::device`] handles mailboxes, counters and
//! queues.

mod abort;
mod datatype;
pub(crate) mod history;
mod info;
pub mod object_dictionary;
mod objects;
pub mod pdo;
mod sdo;
pub mod startup;
mod word;

pub use abort::Abort;
pub use objects::MissingSubindices;
pub(crate) use objects::{Dictionary, ParameterCommand, read_item};

use crate::device::mailbox::{Answer, Detail, MailboxCapacity};
use sdo::SdoServer;

/// CoE services (the header's upper four bits).
mod service {
    pub(super) const EMERGENCY: u8 = 1;
    pub(super) const SDO_REQUEST: u8 = 2;
    pub(super) const SDO_RESPONSE: u8 = 3;
    pub(super) const RXPDO_REMOTE_REQUEST: u8 = 7;
    pub(super) const SDO_INFORMATION: u8 = 8;
}

/// The CoE services that a client may use.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CoeServices {
    pub(crate) sdo_info: bool,
    pub(crate) segmented: bool,
    /// An abort has the index without its low byte.
    pub(crate) abort_index_word: bool,
    /// Maximum bytes of a segmented transfer.
    pub(crate) buffer: usize,
}

#[derive(Debug, Clone, Default)]
pub(crate) struct CoeServer {
    sdo: SdoServer,
}

impl CoeServer {
    /// Answers one CoE message.
    pub(crate) fn request(
        &mut self,
        dictionary: &mut Dictionary<'_>,
        services: CoeServices,
        message: &[u8],
        room: MailboxCapacity,
    ) -> Answer {
        let Some((&[low, high], body)) = message.split_first_chunk() else {
            return Answer::Error(Detail::TooShort);
        };
        match (u16::from_le_bytes([low, high]) >> 12) as u8 {
            service::SDO_REQUEST => self.sdo.request(dictionary, services, body, room),
            service::SDO_INFORMATION if services.sdo_info => info::request(dictionary, body, room),
            service::EMERGENCY..=service::RXPDO_REMOTE_REQUEST | service::SDO_INFORMATION => {
                Answer::Error(Detail::ServiceNotSupported)
            }
            _ => Answer::Error(Detail::InvalidHeader),
        }
    }

    /// True while a segmented transfer waits for the client.
    pub(crate) fn is_waiting(&self) -> bool {
        self.sdo.is_waiting()
    }

    /// Ends a transfer whose client timed out, and returns the abort message.
    pub(crate) fn expire(&mut self) -> Option<Vec<u8>> {
        self.sdo.expire()
    }
}

/// Returns a request of the device: the upload of 0x1000.
pub(crate) fn own_request() -> Vec<u8> {
    let mut message = header(service::SDO_REQUEST).to_vec();
    message.extend_from_slice(&[0x40, 0x00, 0x10, 0, 0, 0, 0, 0]);
    message
}

pub(crate) fn emergency(code: u16, register: u8, data: [u8; 5]) -> Vec<u8> {
    let mut message = header(service::EMERGENCY).to_vec();
    message.extend_from_slice(&code.to_le_bytes());
    message.push(register);
    message.extend_from_slice(&data);
    message
}

/// Returns the CoE header: number 0 and the service.
fn header(service: u8) -> [u8; 2] {
    (u16::from(service) << 12).to_le_bytes()
}
