//! What an exchange reports of a cycle.

use super::ExchangeMode;
use crate::clock::Nanos;

/// A SubDevice in the exchange.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ExchangeDevice {
    pub station: u16,
    /// True if it follows the reference clock, or is the reference clock.
    pub clock: bool,
    /// The SyncManager through which its mailbox is read; `None` without a mailbox.
    pub mailbox: Option<u8>,
}

/// The result of one group's process data in a cycle.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct GroupResult {
    /// True if every frame with a part of the group came back. For a group without process data,
    /// this refers to the first frame.
    pub answered: bool,
    /// True if every working counter was also as expected: the group's inputs are from this cycle.
    pub fresh: bool,
    /// Sums of the working counters seen and of those expected.
    pub wkc: (u16, u16),
}

#[cfg(test)]
impl GroupResult {
    pub(in crate::rt) const fn new(answered: bool, fresh: bool, wkc: (u16, u16)) -> Self {
        Self {
            answered,
            fresh,
            wkc,
        }
    }
}

/// What the answers of a cycle show about one device.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum DeviceAnswer {
    /// Its working counter, own or shared, was right: it processed its outputs, and its inputs are
    /// from this cycle.
    Fresh,
    /// A working counter that it shares with other devices was wrong.
    #[default]
    Unknown,
    /// Its own working counter was wrong, or its frame did not come back.
    Missing,
}

/// The classification of a received frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Received {
    /// A frame of this cycle.
    Current,
    /// A frame of this exchange, but of another cycle or received twice.
    Late,
    /// Not a frame of this exchange.
    NotOurs,
}

/// The result of a cycle's exchange.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct CycleResult {
    /// True if every frame came back.
    pub complete: bool,
    /// True if every working counter was as expected: the whole input image is from this cycle.
    pub inputs_fresh: bool,
    /// Sums of the working counters seen and of those expected.
    pub wkc: (u16, u16),
    /// System time of the reference clock as the frame passed it; the low 32 bits, if the clock has
    /// no more.
    pub system_time: Option<u64>,
    /// The reference clock has taken its offset.
    pub offset_taken: bool,
    /// AL status of all SubDevices, or-ed, and the number of answers.
    pub al_status: Option<(u8, u16)>,
    /// The delay from the planned release of these frames until they were sent.
    pub sent_late: Nanos,
    /// The session clock's time when they were sent.
    pub sent_at: Nanos,
}

impl ExchangeMode {
    /// Returns how many cycles have frames in flight at once.
    #[must_use]
    pub const fn frame_sets(self) -> u8 {
        match self {
            Self::SameCycle => 1,
            Self::Pipelined => 2,
        }
    }
}
