//! The binary from the user's view: exit codes, messages, output and files.

mod bench;
mod change_log;
mod complaints;
mod conformance;
mod doctor;
mod esi;
mod identity;
mod messages;
mod terminal;
