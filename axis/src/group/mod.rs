//! Several axes together.
//!
//! | module | contents |
//! |---|---|
//! | `line` | [`Line`]: a straight line through the positions of all axes, with one profile |
//! | `together` | [`arrive_together`]: separate moves that take the same time |
//!
//! This module owns no axis. A line gives each axis its own set-point source ([`LinePath`]). All
//! sources compute bit-identical results, so the axes stay synchronous without communication in the
//! cycle. Nothing allocates.

mod line;
mod together;

pub use line::{Line, LineAxis, LineError, LinePath};
pub use together::arrive_together;
