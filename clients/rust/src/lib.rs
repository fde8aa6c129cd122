#![doc = include_str!("../README.md")]
#![deny(missing_docs)]

mod connection;
mod cyclic;
mod error;
pub mod layout;
mod machine;
mod memory;
mod samples;
mod subscription;

pub use connection::Request;
pub use cyclic::{AxisNumber, Counters, Cyclic, SetPoint};
pub use error::{Error, ErrorKind};
pub use machine::{AxisInfo, AxisState, Limits, Machine, Options};
pub use samples::{Samples, Signal};
pub use subscription::Subscription;

/// The result of an operation of a client.
pub type Result<T> = std::result::Result<T, Error>;
