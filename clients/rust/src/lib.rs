#![doc = include_str!("../README.md")]
#![deny(missing_docs)]

mod connection;
mod cyclic;
mod error;
pub mod layout;
mod machine;
mod memory;

pub use connection::Request;
pub use cyclic::{AxisNumber, Counters, Cyclic, SetPoint, Signal};
pub use error::{Error, ErrorKind};
pub use machine::{AxisInfo, AxisState, Limits, Machine, Options};

/// The result of an operation of a client.
pub type Result<T> = std::result::Result<T, Error>;
