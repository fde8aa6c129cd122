//! What carries Ethernet frames. Nothing here knows EtherCAT beyond its EtherType.

use std::fmt;

pub mod capture;
pub mod packet;
pub mod port;
pub mod recorded;
pub mod sim;

pub use crate::clock::Nanos;

/// Largest frame without FCS.
pub const MAX_FRAME: usize = 1514;

/// A place to send frames to and receive them from. RT: no method blocks or allocates.
pub trait Link: fmt::Debug + Send {
    /// Hands one whole Ethernet frame (without FCS) to the wire.
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError>;

    /// The next frame that has arrived, copied to the front of `buf`; `None` where there is none.
    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError>;

    /// When the next frame will arrive, where the link can know it (it simulates). Lets virtual
    /// time jump instead of spin.
    fn next_arrival(&self) -> Option<Nanos> {
        None
    }

    /// Ends a recording that goes on in this link, if there is one. Blocks.
    fn finish(self: Box<Self>) -> std::io::Result<Option<capture::RecordStats>> {
        Ok(None)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum LinkError {
    #[error("sending failed: {0}")]
    Send(rustix::io::Errno),
    #[error("receiving failed: {0}")]
    Receive(rustix::io::Errno),
    #[error("a frame of {0} bytes exceeds what the link carries")]
    TooLong(usize),
}
