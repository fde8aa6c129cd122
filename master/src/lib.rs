//! An EtherCAT master application for CiA 402 drives in the cyclic synchronous modes.
//!
//! The layers, from files to the wire:
//!
//! - [`esi_library`]: ESI files on disk, a single one or a folder;
//! - [`config`]: the machine file, first as written, then validated;
//! - [`session`]: one run of a machine, from the machine file to the summary;
//! - [`post_mortem`]: what stopped a run, and on which device;
//! - [`report`]: errors, progress and the summary of a run, as plain data;
//! - [`supervise`]: all work outside the cycle while the machine runs;
//! - [`bringup`]: the way from power-up to SafeOp; may block and allocate;
//! - [`rt`]: the cycle; must not block or allocate;
//! - [`samples`]: the values of every cycle, for other threads and processes;
//! - [`ros2`]: these values as ROS 2 messages and as MCAP files;
//! - [`mailbox`]: CoE and FoE over raw datagrams, also during operation;
//! - [`eoe`]: Ethernet over EtherCAT, with a virtual switch;
//! - [`acyclic`]: access to a bus without a cycle, in the state in which it is;
//! - [`parameters`]: object names and values; saved to files, compared, restored;
//! - [`link`]: transports for Ethernet frames;
//! - [`recording`]: recording files, in this project's format and others;
//! - [`change_log`]: who changed what on the machine, and when;
//! - [`cancel`]: cooperative cancellation;
//! - `concurrent`: the same work on many devices at the same time;
//! - [`clock`]: monotonic or virtual time;
//! - [`text`]: formatting of counts with nouns;
//! - [`mod@file`]: reads whole files of bounded length;
//! - [`file_digest`]: SHA-256 of the files that a machine is made of;
//! - [`signature`]: verifies the signatures of these files;
//! - [`sys`]: system calls; all unsafe code.

#![deny(unsafe_code)]

/// The version of the program.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");
/// The commit of a release build from a work tree.
pub const COMMIT: Option<&str> = option_env!("ECAXIS_COMMIT");

pub mod acyclic;
pub mod bringup;
pub mod cancel;
pub mod change_log;
pub mod clock;
mod concurrent;
pub mod config;
mod datagram;
pub mod eoe;
pub mod esi_library;
pub mod file;
pub mod file_digest;
pub mod link;
pub mod mailbox;
mod mailbox_gateway;
pub mod parameters;
pub mod post_mortem;
pub mod recording;
pub mod report;
pub mod ros2;
pub mod rt;
pub mod samples;
pub mod session;
pub mod signature;
pub mod supervise;
pub mod sys;
pub mod text;
