//! The socket and the cyclic area of `ecaxis serve` (docs/server.md).

mod area;
mod connection;

pub use area::{Commands, Samples};
pub use connection::Connection;
