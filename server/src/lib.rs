//! Serves a machine to other programs and to people.
//!
//! - [`hub`]: the state that the machine and its clients share;
//! - [`machine`]: the thread that keeps the machine up;
//! - [`operator`]: carries commands to the machine and outcomes back;
//! - [`external`]: set-points of clients in the cycle;
//! - [`lease`]: who owns the motion;
//! - `admission`, [`bulk`]: what clients may take: connections, large answers;
//! - [`command`], [`error`]: the protocol;
//! - [`sampler`]: history and distribution of times;
//! - [`recorder`]: every cycle to an MCAP file;
//! - [`foxglove`]: the Foxglove WebSocket protocol, for viewers;
//! - [`diagnostics`]: the state as ROS diagnostics.

#![deny(unsafe_code)]

mod admission;
pub mod bulk;
pub mod client;
pub mod command;
pub mod connection;
pub mod diagnostics;
pub mod error;
pub mod export;
pub mod external;
pub mod foxglove;
pub mod http;
pub mod hub;
pub mod lease;
pub mod machine;
pub mod metrics;
pub mod openapi;
pub mod operator;
pub mod page;
pub mod recorder;
pub mod sampler;
pub mod serve;
pub mod socket;
pub mod state;
mod strict;
pub mod tokens;
pub mod websocket;
