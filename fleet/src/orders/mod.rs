//! Orders from the fleet to a machine: bundles, firmware, parameters and starts.
//!
//! | module | |
//! |---|---|
//! | [`order`], [`signing`] | what a sender orders, and who that is |
//! | [`manifest`], [`bundle`] | the files of a machine, signed |
//! | [`store`] | files on their way and under their digests |
//! | [`slots`], `switch` | the current and the previous bundle |
//! | `update`, `start` | the other orders |
//! | [`executor`], [`journal`] | executes each order once |
//! | [`sender`], [`commands`], [`together`] | the other end: the commands |

pub mod bundle;
pub mod commands;
pub mod digest;
pub mod executor;
mod files;
pub mod journal;
pub mod manifest;
pub mod order;
mod program;
pub mod sender;
mod server;
pub mod signing;
pub mod slots;
mod start;
pub mod store;
mod switch;
#[cfg(test)]
mod tests;
pub mod together;
mod update;

use std::path::{Path, PathBuf};

/// Returns the path of the signature of a file: `FILE.minisig`.
fn signature_path(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".minisig");
    name.into()
}
