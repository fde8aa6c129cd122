//! An EtherCAT master application for CiA 402 drives in the cyclic synchronous modes.
//!
//! The layers, from the file to the wire:
//!
//! - [`library`]: ESI files on disk, one or a folder of them;
//! - [`config`]: the machine file as written, then validated;
//! - [`session`]: one run of a machine, from the file to the summary;
//! - [`story`]: what stopped a run, and on which device;
//! - [`supervise`]: everything beside the cycle while the machine runs;
//! - [`bringup`]: from a silent wire to SafeOp; may block and allocate;
//! - [`rt`]: the cycle; must not block or allocate;
//! - [`mailbox`]: CoE over raw datagrams, beside the cycle;
//! - [`service`]: a bus without a cycle, taken as it is found;
//! - [`scan`]: who is on a segment, and the machine file that follows from it;
//! - [`compare`]: a machine file against a bus;
//! - [`firmware`]: another program for a device;
//! - [`parameters`]: what a device's objects are called and hold; in files, compared, restored;
//! - [`link`]: what carries Ethernet frames;
//! - [`doctor`]: what in this computer keeps a cycle from being on time;
//! - [`bench`]: what measuring needs;
//! - [`recording`]: recordings as files, ours and others';
//! - [`analyze`]: what a recording tells;
//! - [`stop`]: ending a piece of work early;
//! - [`clock`]: monotonic or virtual time;
//! - [`words`]: numbers and nouns;
//! - [`os`]: system calls; all unsafe code.

#![deny(unsafe_code)]

pub mod al_status;
pub mod analyze;
pub mod bench;
pub mod bringup;
pub mod clock;
pub mod compare;
pub mod config;
pub mod doctor;
pub mod file;
pub mod firmware;
pub mod library;
pub mod link;
pub mod mailbox;
pub mod os;
mod page;
pub mod parameters;
pub mod recording;
pub mod rt;
pub mod scan;
pub mod service;
pub mod session;
pub mod stop;
pub mod story;
pub mod supervise;
mod wire;
pub mod words;
