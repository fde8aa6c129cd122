//! From an unknown bus to a running machine: `scan`, `scan --write`, `check`, `run` and `compare`
//! from the user's view.
//!
//! The tests run the commands of docs/first-steps.md twice: on the simulated bus in the process,
//! and over a veth pair (requires root). `ECAXIS_UPDATE_SNAPSHOTS=1` writes `tests/snapshots/scan`
//! again; review the difference.

#![allow(clippy::print_stdout, reason = "a skipped test says why")]

#[path = "commissioning/bench.rs"]
mod bench;
#[path = "commissioning/compare.rs"]
mod compare;
#[path = "commissioning/scan.rs"]
mod scan;
#[path = "commissioning/story.rs"]
mod story;
#[path = "common/wire.rs"]
mod wire;
