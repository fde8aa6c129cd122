//! What the cycle sees beside process data, for those who wait for it elsewhere: whether mailboxes are full, and what time it is on the
//! bus. Atomics, so that looking at them costs the cycle nothing.

use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};

use crate::clock::Nanos;
use crate::mailbox::Seen;

/// Bit 3 of a SyncManager's status.
const MAILBOX_FULL: u8 = 0x08;
/// No distributed clock has been heard.
const NO_CLOCK: i64 = i64::MIN;

#[derive(Debug)]
pub struct Sights {
    /// Of each member: when, shifted by one; bit 0: its mailbox was full. 0: never seen.
    mailboxes: Box<[AtomicU64]>,
    /// System time less session clock.
    clock: AtomicI64,
}

impl Sights {
    /// What every diagnostic read is sent filled with. No SyncManager has such a status, so that what comes back so was read by nobody.
    pub(super) const UNSEEN: u8 = 0xff;

    #[must_use]
    #[allow(clippy::disallowed_methods, reason = "prepares")]
    pub fn new(members: usize) -> Self {
        Self {
            mailboxes: (0..members).map(|_| AtomicU64::new(0)).collect(),
            clock: AtomicI64::new(NO_CLOCK),
        }
    }

    /// The status register of a mailbox as a frame sent at `at` brought it. RT: O(1).
    pub(super) fn see(&self, member: usize, at: Nanos, status: u8) {
        if status == Self::UNSEEN {
            return;
        }
        if let Some(seen) = self.mailboxes.get(member) {
            let full = u64::from(status & MAILBOX_FULL != 0);
            seen.store(at << 1 | full, Ordering::Relaxed);
        }
    }

    /// The system time as a frame sent at `at` passed the reference clock. RT: O(1).
    pub(super) fn set_clock(&self, at: Nanos, system_time: u64) {
        let offset = system_time.wrapping_sub(at) as i64;
        self.clock.store(offset, Ordering::Relaxed);
    }

    /// What was last seen of a member's mailbox.
    #[must_use]
    pub fn mailbox(&self, member: usize) -> Option<Seen> {
        let seen = self.mailboxes.get(member)?.load(Ordering::Relaxed);
        (seen != 0).then_some(Seen {
            at: seen >> 1,
            full: seen & 1 != 0,
        })
    }

    /// DC system time at a moment of the session's clock, nanoseconds; `None` without distributed clocks.
    #[must_use]
    pub fn system_time(&self, at: Nanos) -> Option<u64> {
        let offset = self.clock.load(Ordering::Relaxed);
        (offset != NO_CLOCK).then(|| at.wrapping_add_signed(offset))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_status_that_nobody_read_is_none() {
        let sights = Sights::new(2);
        assert_eq!(sights.mailbox(0), None);
        sights.see(0, 5_000, 0x48);
        sights.see(0, 6_000, Sights::UNSEEN);
        sights.see(7, 6_000, 0x08);
        let full = Seen {
            at: 5_000,
            full: true,
        };
        assert_eq!((sights.mailbox(0), sights.mailbox(1)), (Some(full), None));
        sights.see(0, 7_000, 0x40);
        assert!(sights.mailbox(0).is_some_and(|seen| !seen.full));
    }

    #[test]
    fn system_time_goes_on_between_frames() {
        let sights = Sights::new(0);
        assert_eq!(sights.system_time(5), None);
        sights.set_clock(1_000, 700_000_000);
        assert_eq!(sights.system_time(1_250), Some(700_000_250));
        sights.set_clock(9_000, 1_000);
        assert_eq!(sights.system_time(9_100), Some(1_100));
    }
}
