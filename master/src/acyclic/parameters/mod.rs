//! The parameters of one device: read, compared and restored. MAY BLOCK AND ALLOCATE.
//!
//! - [`dictionary`]: the dictionary from the device (SDO Information), in the form of ESI
//!   dictionaries;
//! - [`upload`]: reads every readable object;
//! - [`restore_order`]: orders the writes of a restore;
//! - [`compare`], [`restore`]: compares two sets of values, writes one to a device;
//! - [`command`]: "save" and "load" (0x1010, 0x1011).

pub mod command;
pub mod compare;
pub mod dictionary;
pub mod restore;
pub mod restore_order;
pub mod upload;
