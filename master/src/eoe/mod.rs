//! Ethernet over EtherCAT (ETG.1000.6 clause 5.7): a virtual switch between the mailboxes of
//! devices and one interface of the operating system.
//!
//! All of this runs with the mailbox workers, never in the cycle. May allocate; takes a lock only
//! for the copy of a frame. Never panics on data of a device or of the network.
//!
//! | file | contents |
//! |---|---|
//! | `switch.rs` | addresses, and where a frame goes |
//! | `network.rs` | the ports with their queues |
//! | `interface.rs` | the port of the operating system |

use std::fmt;

use crate::clock::Nanos;

mod interface;
mod network;
pub mod switch;

pub use crate::sys::tap::TapStep;
pub use interface::Ethernet;
pub use network::{
    EoeNetwork, EoePort, EthernetCounters, FRAMES_PER_PORT, FrameDelay, HostPort, Turn,
};

/// A network interface: the far side of the switch's port for the operating system.
pub trait EthernetInterface: fmt::Debug + Send {
    /// Receives one frame from the interface; returns its length. `None` if none waits. Does not
    /// block.
    fn receive(&mut self, now: Nanos, buffer: &mut [u8]) -> Option<usize>;

    /// Sends a frame; returns false if the interface has no room. Does not block.
    fn send(&mut self, now: Nanos, frame: &[u8]) -> bool;
}
