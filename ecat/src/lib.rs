#![doc = include_str!("../README.md")]
#![cfg_attr(not(test), no_std)]
#![deny(missing_docs)]

extern crate alloc;

pub mod al_state;
pub mod al_status_code;
mod codes;
pub mod data_type;
pub mod datagram;
pub mod index;
pub mod mailbox;
pub mod object;
mod object_names;
pub mod registers;
pub mod sii;
pub mod text;
pub mod value;
pub mod vendor;
