//! Measurement tools for `benches/` and `ecaxis bench`: a temporary wire, a simulated peer, and the
//! real cycle of a machine. May block and allocate.
//!
//! - [`veth`]: a pair of connected virtual interfaces;
//! - [`segment`]: drives as seen by cyclic frames; [`bus`] answers with them, from another CPU or
//!   on the same thread;
//! - [`fixture`]: a machine of such axes, built from the parts of the real cycle;
//! - [`measure`]: runs and measures it;
//! - [`wakeup`]: wake-up latency by the cycle's clock and by cyclictest;
//! - [`exchange`]: the round-trip cost of a frame;
//! - [`plan`], [`run`]: the variants and their rounds; [`peer`]: another MainDevice; [`machine`]:
//!   the bus of a machine file; [`host`]: the computer;
//! - [`report`], [`caveats`], [`document`](fn@document): the result and its limits.

pub mod bus;
pub mod caveats;
mod document;
pub mod exchange;
pub mod fixture;
pub mod host;
pub mod machine;
pub mod measure;
pub mod peer;
pub mod plan;
pub mod report;
pub mod run;
pub mod segment;
pub mod veth;
pub mod wakeup;

pub use document::document;
