//! The tests of `ecaxis-sim`.

#![allow(clippy::print_stderr, reason = "tests print counts and what they skip")]

mod aborts;
mod allocations;
mod captures;
mod clocks;
mod coe;
mod commands;
mod common;
mod controller;
#[path = "../../axis/tests/counting/mod.rs"]
mod counting;
mod delays;
mod drives;
mod eeprom;
mod eoe;
mod firmware;
mod fixtures;
mod foe;
mod frame_faults;
mod fuzz;
mod gateway;
mod hostile;
mod images;
mod lossy;
mod mailbox;
mod main_device;
mod memory;
mod modules;
mod motion;
mod network;
mod network_properties;
mod quirks;
mod registers;
mod sdo_info;
mod selection;
mod startup;
mod supervision;
mod sync;
mod terminals;
