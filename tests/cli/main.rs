//! The binary from the user's view: exit codes, messages, output and files.

mod bench;
mod change_log;
mod complaints;
mod completions;
mod conformance;
mod doctor;
mod documents;
mod eni;
mod esi;
mod findings;
mod identity;
mod init;
mod messages;
mod mistakes;
mod output;
mod rights;
mod signatures;
mod terminal;
mod tokens;
mod tune;
