//! Samples as ROS 2 messages, for viewers and tools that read ROS 2 topics or MCAP files.
//!
//! - [`cdr`]: the encoding of messages;
//! - [`schema`]: their definitions;
//! - [`topics`]: the topics of a machine, and messages from the samples of a cycle;
//! - [`mcap`]: MCAP files with these topics.

pub mod cdr;
pub mod mcap;
pub mod schema;
pub mod topics;
