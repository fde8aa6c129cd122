//! The status of mailboxes and the bus time as the cycle sees them, for other threads. Atomics keep
//! the cost of reading them away from the cycle.

use std::sync::atomic::{AtomicI64, AtomicU8, AtomicU16, AtomicU64, AtomicUsize, Ordering};

use ecaxis_ecat::index::{DeviceIndex, GroupIndex, IndexVec};

use super::{AlStatusPolls, Exchange};
use crate::clock::Nanos;

/// Bit 3 of a SyncManager's status.
const MAILBOX_FULL: u8 = 0x08;
/// No distributed clock has answered yet.
const NO_CLOCK: i64 = i64::MIN;

/// The status of a mailbox as read by the cycle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MailboxStatus {
    /// The time on the session's clock at or after which the status was read.
    pub at: Nanos,
    /// True if a message waits in the mailbox.
    pub full: bool,
}

#[derive(Debug)]
pub struct BusStatus {
    /// For each member: the time of the last status, shifted left by one; bit 0: the mailbox was
    /// full. 0: never seen.
    mailboxes: IndexVec<DeviceIndex, AtomicU64>,
    /// System time minus session clock.
    clock: AtomicI64,
    /// For each member: [`STOPPED`] and [`OUT_OF_OP`].
    presence: IndexVec<DeviceIndex, AtomicU8>,
    /// For each member, a restart that the cycle does not know yet.
    restarts: IndexVec<DeviceIndex, AtomicU8>,
    /// The member that is the reference clock; `usize::MAX`: none.
    reference: AtomicUsize,
    /// The number of devices that answered the last broadcast.
    answering: AtomicU16,
    /// The member whose clock offset (0x0920) the cycle needs; `usize::MAX`: none.
    offset_wanted: AtomicUsize,
    /// The member whose offset was read, and the offset.
    offset_of: AtomicUsize,
    offset: AtomicU64,
}

/// A member that has restarted, and another device in its place.
const RESTARTED: u8 = 1;
const REPLACED: u8 = 2;
/// The member belongs to a stopped group.
const STOPPED: u8 = 1;
/// The member did not answer its last read, or was not in Op.
const OUT_OF_OP: u8 = 2;

impl BusStatus {
    /// The fill byte of every diagnostic read. No SyncManager has this status, so it marks data
    /// that no SubDevice wrote.
    pub(super) const UNSEEN: u8 = 0xff;

    #[must_use]
    #[allow(clippy::disallowed_methods, reason = "runs before the loop")]
    pub fn new(members: usize) -> Self {
        Self {
            mailboxes: (0..members).map(|_| AtomicU64::new(0)).collect(),
            clock: AtomicI64::new(NO_CLOCK),
            presence: (0..members).map(|_| AtomicU8::new(0)).collect(),
            restarts: (0..members).map(|_| AtomicU8::new(0)).collect(),
            reference: AtomicUsize::new(usize::MAX),
            answering: AtomicU16::new(0),
            offset_wanted: AtomicUsize::new(usize::MAX),
            offset_of: AtomicUsize::new(usize::MAX),
            offset: AtomicU64::new(0),
        }
    }

    /// Stores the status register of a mailbox, read by a frame sent at `at`. RT: O(1).
    pub(super) fn store_mailbox_status(&self, member: DeviceIndex, at: Nanos, status: u8) {
        if status == Self::UNSEEN {
            return;
        }
        if let Some(seen) = self.mailboxes.get(member) {
            let full = u64::from(status & MAILBOX_FULL != 0);
            seen.store(at << 1 | full, Ordering::Relaxed);
        }
    }

    /// Stores the system time at which a frame sent at `at` passed the reference clock. RT: O(1).
    pub(super) fn set_clock(&self, at: Nanos, system_time: u64) {
        let offset = system_time.wrapping_sub(at) as i64;
        self.clock.store(offset, Ordering::Relaxed);
    }

    /// Stores whether a member is in Op and whether its group has stopped. RT: O(1).
    pub fn set_presence(&self, member: DeviceIndex, in_op: bool, stopped: bool) {
        if let Some(seen) = self.presence.get(member) {
            let bits = (u8::from(stopped) * STOPPED) | (u8::from(!in_op) * OUT_OF_OP);
            seen.store(bits, Ordering::Relaxed);
        }
    }

    /// Reports that a member has restarted. `same`: it is the device that was there before.
    pub fn set_restarted(&self, member: DeviceIndex, same: bool) {
        if let Some(restart) = self.restarts.get(member) {
            let what = if same { RESTARTED } else { REPLACED };
            restart.store(what, Ordering::Relaxed);
        }
    }

    /// Returns `same` once after [`BusStatus::set_restarted`]. RT: O(1).
    pub(super) fn take_restart(&self, member: DeviceIndex) -> Option<bool> {
        let restart = self.restarts.get(member)?;
        if restart.load(Ordering::Relaxed) == 0 {
            return None;
        }
        let what = restart.swap(0, Ordering::Relaxed);
        (what != 0).then_some(what == RESTARTED)
    }

    /// Stores the reference clock. RT: O(1).
    pub(super) fn set_reference(&self, member: Option<DeviceIndex>) {
        let index = member.map_or(usize::MAX, |member| member.0);
        self.reference.store(index, Ordering::Relaxed);
    }

    /// Requests the clock offset (0x0920) of a member. RT: O(1).
    pub(super) fn want_offset(&self, member: Option<DeviceIndex>) {
        let index = member.map_or(usize::MAX, |member| member.0);
        self.offset_wanted.store(index, Ordering::Relaxed);
    }

    /// Returns the member whose clock offset the cycle needs.
    #[must_use]
    pub fn wanted_offset(&self) -> Option<DeviceIndex> {
        let index = self.offset_wanted.load(Ordering::Relaxed);
        (index != usize::MAX).then_some(DeviceIndex(index))
    }

    /// Passes the clock offset of a member to the cycle.
    pub fn set_offset(&self, member: DeviceIndex, offset: u64) {
        self.offset.store(offset, Ordering::Relaxed);
        self.offset_of.store(member.0, Ordering::Release);
    }

    /// Takes a clock offset and its member. RT: O(1).
    fn take_offset(&self) -> Option<(DeviceIndex, u64)> {
        let member = self.offset_of.swap(usize::MAX, Ordering::Acquire);
        let offset = self.offset.load(Ordering::Relaxed);
        (member != usize::MAX).then_some((DeviceIndex(member), offset))
    }

    /// Returns the number of devices that answered the last broadcast, in the machine file or not.
    #[must_use]
    pub fn answering(&self) -> u16 {
        self.answering.load(Ordering::Relaxed)
    }

    /// Returns the members of stopped groups that do not answer or are not in Op.
    pub fn lost(&self) -> impl Iterator<Item = DeviceIndex> + '_ {
        let lost = |seen: &AtomicU8| seen.load(Ordering::Relaxed) == STOPPED | OUT_OF_OP;
        let members = self.presence.enumerate();
        members.filter_map(move |(member, seen)| lost(seen).then_some(member))
    }

    /// Returns the member that is the reference clock.
    #[must_use]
    pub fn reference(&self) -> Option<DeviceIndex> {
        let index = self.reference.load(Ordering::Relaxed);
        (index != usize::MAX).then_some(DeviceIndex(index))
    }

    /// Returns the last status of a member's mailbox.
    #[must_use]
    pub fn mailbox(&self, member: DeviceIndex) -> Option<MailboxStatus> {
        let seen = self.mailboxes.get(member)?.load(Ordering::Relaxed);
        (seen != 0).then_some(MailboxStatus {
            at: seen >> 1,
            full: seen & 1 != 0,
        })
    }

    /// Returns the DC system time in ns at a time of the session's clock; `None` without
    /// distributed clocks.
    #[must_use]
    pub fn system_time(&self, at: Nanos) -> Option<u64> {
        let offset = self.clock.load(Ordering::Relaxed);
        (offset != NO_CLOCK).then(|| at.wrapping_add_signed(offset))
    }
}

impl Exchange {
    /// Sets how often the diagnostic slot reads AL status.
    pub fn poll_al_status(&mut self, polls: AlStatusPolls) {
        self.schedule.al_status_polls = polls;
    }

    /// Requests the clock offset of a member from other threads, or none. RT: O(1).
    pub fn want_offset(&self, member: Option<DeviceIndex>) {
        self.bus_status.want_offset(member);
    }

    /// Takes a clock offset that other threads have read, and its member. RT: O(1).
    #[must_use]
    pub fn take_offset(&self) -> Option<(DeviceIndex, u64)> {
        self.bus_status.take_offset()
    }

    /// Sets the offset that the frames write to the reference clock (0x0920) from the next staged
    /// one on; with `None` they write nothing. RT: O(1).
    pub fn set_reference_offset(&mut self, offset: Option<u64>) {
        self.reference_offset = offset;
    }

    /// Returns once after a member has restarted whether it is the same device as before. RT: O(1).
    pub fn take_restart(&self, member: DeviceIndex) -> Option<bool> {
        self.bus_status.take_restart(member)
    }

    /// Publishes how many devices answer and which members are in Op, for the other threads. RT:
    /// O(members).
    pub fn publish_presence(&self, answering: u16, stopped: impl Fn(GroupIndex) -> bool) {
        let seen = &self.bus_status.answering;
        seen.store(answering, Ordering::Relaxed);
        for ((member, found), group) in self.diagnoses.enumerate().zip(&self.groups) {
            // Until then, the presence is that of the bring-up.
            if found.judged {
                self.bus_status
                    .set_presence(member, found.is_in_op(), stopped(*group));
            }
        }
        self.bus_status.set_reference(self.reference());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unprocessed_mailbox_status_is_ignored() {
        let bus_status = BusStatus::new(2);
        assert_eq!(bus_status.mailbox(DeviceIndex(0)), None);
        bus_status.store_mailbox_status(DeviceIndex(0), 5_000, 0x48);
        bus_status.store_mailbox_status(DeviceIndex(0), 6_000, BusStatus::UNSEEN);
        bus_status.store_mailbox_status(DeviceIndex(7), 6_000, 0x08);
        let full = MailboxStatus {
            at: 5_000,
            full: true,
        };
        assert_eq!(
            (
                bus_status.mailbox(DeviceIndex(0)),
                bus_status.mailbox(DeviceIndex(1))
            ),
            (Some(full), None)
        );
        bus_status.store_mailbox_status(DeviceIndex(0), 7_000, 0x40);
        assert!(
            bus_status
                .mailbox(DeviceIndex(0))
                .is_some_and(|seen| !seen.full)
        );
    }

    #[test]
    fn system_time_advances_between_frames() {
        let bus_status = BusStatus::new(0);
        assert_eq!(bus_status.system_time(5), None);
        bus_status.set_clock(1_000, 700_000_000);
        assert_eq!(bus_status.system_time(1_250), Some(700_000_250));
        bus_status.set_clock(9_000, 1_000);
        assert_eq!(bus_status.system_time(9_100), Some(1_100));
    }

    #[test]
    fn lost_members_are_out_of_op_in_a_stopped_group() {
        let bus_status = BusStatus::new(4);
        for (member, in_op, stopped) in [(0, true, false), (1, true, true), (2, false, false)] {
            bus_status.set_presence(DeviceIndex(member), in_op, stopped);
        }
        bus_status.set_presence(DeviceIndex(3), false, true);
        assert_eq!(bus_status.lost().collect::<Vec<_>>(), [DeviceIndex(3)]);
        assert_eq!(bus_status.reference(), None);
        bus_status.set_reference(Some(DeviceIndex(2)));
        assert_eq!(bus_status.reference(), Some(DeviceIndex(2)));
    }
}
