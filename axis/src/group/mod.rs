//! Several axes together.
//!
//! | module | what lives there |
//! |---|---|
//! | `line` | [`Line`]: a straight line through all axes' positions, on one profile |
//! | `together` | [`arrive_together`]: moves of their own that take the same time |
//!
//! Nothing here owns an axis. A line hands each axis a set-point source of its own ([`Along`]); all of them make the same
//! calculation, to the last bit, so the axes stay together without speaking to each other in the cycle. No allocation anywhere.

mod line;
mod together;

pub use line::{Along, Line, LineAxis, LineError};
pub use together::arrive_together;
