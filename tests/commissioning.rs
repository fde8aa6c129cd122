//! From an unknown bus to a running machine: `scan`, `scan --write`, `check`, `run`, `compare`, as a user meets them.
//!
//! What docs/first-steps.md shows is run, once on the simulated bus in the process and once over a veth pair (which needs root).
//! `ECAXIS_UPDATE_SNAPSHOTS=1` writes what is kept in `tests/snapshots/scan` anew; the difference then wants reviewing.

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
