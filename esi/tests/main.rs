//! The tests of `ecaxis-esi` that do not measure their own process; `memory.rs` holds the others.

#![allow(clippy::print_stdout, reason = "tests print counts and what they skip")]

mod common;
mod damage;
mod element_cache;
mod fuzz;
mod layouts;
mod oddities;
mod own_files;
mod partial;
mod selection;
mod sii;
mod sii_device;
mod sii_vs_recorded;
mod sync_managers;
mod vendor_files;
mod warnings;
