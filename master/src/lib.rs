//! An EtherCAT master application for CiA 402 drives in the cyclic synchronous modes.
//!
//! The layers, outermost first:
//!
//! - [`config`]: the machine file as written, then validated.
//! - [`mailbox`]: CoE over raw datagrams, beside the cyclic loop.
//! - [`link`]: what carries Ethernet frames.

pub mod al_status;
pub mod config;
pub mod link;
pub mod mailbox;
