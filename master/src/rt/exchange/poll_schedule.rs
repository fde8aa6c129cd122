//! The schedule of the diagnostic slot. If mailboxes are polled, every other read is theirs. The
//! cost per cycle does not depend on the number of mailboxes.

use super::ExchangeDevice;
use super::diagnostics::DiagnosticRegister;
use super::frame::{DATAGRAM_HEADER, WKC};
use crate::rt::image::MailboxPlan;
use ecaxis_ecat::datagram::Command;
use ecaxis_ecat::index::DeviceIndex;
use ecaxis_ecat::registers;

/// Data bytes of the longest read.
const MAX_POLL_DATA: usize = 8;
/// Bytes of the longest datagram in the diagnostic slot.
pub const MAX_POLL_DATAGRAM: usize = DATAGRAM_HEADER + MAX_POLL_DATA + WKC;

/// The target of one read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum PollTarget {
    /// A register block of one member.
    Registers {
        device: DeviceIndex,
        block: DiagnosticRegister,
    },
    /// The status of mailboxes, a byte each, starting at this index of
    /// [`PollSchedule::mailbox_devices`].
    Mailboxes { first: usize },
}

/// One read of the diagnostic slot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct PollDatagram {
    pub target: PollTarget,
    pub command: Command,
    pub address: u32,
    pub len: usize,
}

/// The share of AL status in the diagnosis reads.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum AlStatusPolls {
    /// Each register block in turn.
    #[default]
    InTurn,
    /// Every other read, because devices are judged by their own AL status.
    EveryOther,
    /// Every read, because a device that left Op is searched.
    Only,
}

/// The sequence of reads.
#[derive(Debug)]
pub(super) struct PollSchedule {
    diagnosis: Box<[PollDatagram]>,
    mailboxes: Box<[PollDatagram]>,
    /// The devices whose status the mailbox reads contain, in order.
    pub mailbox_devices: Box<[DeviceIndex]>,
    /// The next diagnosis read, the next mailbox read and the next read of AL status between the
    /// others.
    next: (usize, usize, usize),
    mailbox_is_next: bool,
    al_status_is_next: bool,
    /// The number of members: the first diagnosis reads are those of AL status.
    members: usize,
    pub al_status_polls: AlStatusPolls,
}

impl PollSchedule {
    /// Creates the schedule: each register block of all members in turn, and the status of
    /// mailboxes. One read covers up to eight mailboxes where an FMMU maps them.
    #[allow(clippy::disallowed_methods, reason = "runs before the loop")]
    pub fn new(members: &[ExchangeDevice], mapped: Option<&MailboxPlan>) -> Self {
        let registers =
            |station: u16, register: u16| u32::from(register) << 16 | u32::from(station);
        let diagnosis = DiagnosticRegister::ALL.iter().flat_map(|&block| {
            let (register, len) = block.register_and_len();
            (0..)
                .map(DeviceIndex)
                .zip(members)
                .map(move |(device, member)| PollDatagram {
                    target: PollTarget::Registers { device, block },
                    command: Command::FPRD,
                    address: registers(member.station, register),
                    len,
                })
        });
        let mut mailbox_devices = mapped.map_or_else(Vec::new, |plan| plan.devices.clone());
        let mut mailboxes: Vec<PollDatagram> = mailbox_devices
            .chunks(MAX_POLL_DATA)
            .scan(0, |at, window| {
                let first = *at;
                *at += window.len();
                Some((first, window.len()))
            })
            .map(|(first, len)| PollDatagram {
                target: PollTarget::Mailboxes { first },
                command: Command::LRD,
                address: mapped.map_or(0, |plan| plan.address(first)),
                len,
            })
            .collect();
        for (device, member) in (0..).map(DeviceIndex).zip(members) {
            if let Some(sm) = member.mailbox
                && !mapped.is_some_and(|plan| plan.devices.contains(&device))
            {
                mailboxes.push(PollDatagram {
                    target: PollTarget::Mailboxes {
                        first: mailbox_devices.len(),
                    },
                    command: Command::FPRD,
                    address: registers(
                        member.station,
                        registers::SYNC_MANAGER_STATUS + 8 * u16::from(sm),
                    ),
                    len: 1,
                });
                mailbox_devices.push(device);
            }
        }
        Self {
            diagnosis: diagnosis.collect(),
            mailboxes: mailboxes.into(),
            mailbox_devices: mailbox_devices.into(),
            next: (0, 0, 0),
            mailbox_is_next: false,
            al_status_is_next: false,
            members: members.len(),
            al_status_polls: AlStatusPolls::InTurn,
        }
    }

    /// Returns the next read; `None` without members. RT.
    pub fn next(&mut self) -> Option<PollDatagram> {
        let mailbox = self.mailbox_is_next && !self.mailboxes.is_empty();
        self.mailbox_is_next = !mailbox;
        let al_status = !mailbox
            && match self.al_status_polls {
                AlStatusPolls::InTurn => false,
                AlStatusPolls::EveryOther => {
                    self.al_status_is_next = !self.al_status_is_next;
                    self.al_status_is_next
                }
                AlStatusPolls::Only => true,
            };
        let (polls, next) = if mailbox {
            (&self.mailboxes[..], &mut self.next.1)
        } else if al_status {
            let al_status = self.diagnosis.get(..self.members);
            (al_status.unwrap_or_default(), &mut self.next.2)
        } else {
            (&self.diagnosis[..], &mut self.next.0)
        };
        if *next >= polls.len() {
            *next = 0;
        }
        let poll = polls.get(*next).copied();
        *next = if *next + 1 < polls.len() {
            *next + 1
        } else {
            0
        };
        poll
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn members(mailboxes: &[Option<u8>]) -> Vec<ExchangeDevice> {
        let each = mailboxes
            .iter()
            .zip(1001..)
            .map(|(&mailbox, station)| ExchangeDevice {
                station,
                clock: true,
                mailbox,
            });
        each.collect()
    }

    #[test]
    fn poll_schedule_reads_mailboxes_every_other_cycle() {
        let members = members(&[Some(1), None, Some(3)]);
        let mut schedule = PollSchedule::new(&members, None);
        let polls: Vec<PollDatagram> = std::iter::from_fn(|| schedule.next()).take(64).collect();
        let mut blocks = Vec::new();
        let mut mailboxes = Vec::new();
        for (n, poll) in polls.iter().enumerate() {
            match poll.target {
                PollTarget::Registers { device, block } => {
                    assert_eq!(n % 2, 0);
                    assert_eq!(poll.address & 0xffff, 1001 + device.0 as u32);
                    blocks.push((block, device));
                }
                PollTarget::Mailboxes { first } => {
                    mailboxes.push((schedule.mailbox_devices[first], poll.address, poll.len));
                }
            }
        }
        let first = (DeviceIndex(0), 0x080d_03e9, 1);
        let second = (DeviceIndex(2), 0x081d_03eb, 1);
        assert_eq!(mailboxes[..4], [first, second, first, second]);
        assert_eq!(
            blocks[..4].iter().map(|p| p.1.0).collect::<Vec<_>>(),
            [0, 1, 2, 0]
        );
        // The schedule has visited all members and starts again.
        assert_eq!(blocks[0], blocks[18]);
        for block in DiagnosticRegister::ALL {
            assert_eq!(blocks[..18].iter().filter(|p| p.0 == block).count(), 3);
        }
    }

    #[test]
    fn poll_schedule_reads_eight_mapped_mailboxes_at_once() {
        let members = members(&[Some(1); 12]);
        let plan = MailboxPlan {
            logical: 0x0001_0100,
            devices: (0..12).filter(|n| *n != 4).map(DeviceIndex).collect(),
        };
        let mut schedule = PollSchedule::new(&members, Some(&plan));
        let polls = std::iter::from_fn(|| schedule.next())
            .take(8)
            .collect::<Vec<_>>();
        let mailboxes: Vec<_> = polls
            .iter()
            .filter_map(|poll| match poll.target {
                PollTarget::Mailboxes { first } => {
                    Some((first, poll.command, poll.address, poll.len))
                }
                PollTarget::Registers { .. } => None,
            })
            .collect();
        let expected = [
            (0, Command::LRD, 0x0001_0100, 8),
            (8, Command::LRD, 0x0001_0108, 3),
            (11, Command::FPRD, 0x080d_03ed, 1),
            (0, Command::LRD, 0x0001_0100, 8),
        ];
        assert_eq!(mailboxes, expected);
        assert_eq!(schedule.mailbox_devices[11], DeviceIndex(4));
    }

    /// A refused device that stayed outside Op made the slot read AL status alone: error counters
    /// and clock differences were not read any more.
    #[test]
    fn poll_schedule_reads_al_status_alone_or_between_the_others() {
        let members = members(&[None; 3]);
        let mut schedule = PollSchedule::new(&members, None);
        let blocks = |schedule: &mut PollSchedule, count| -> Vec<_> {
            let polls = std::iter::from_fn(|| schedule.next()).take(count);
            let blocks = polls.map(|poll| match poll.target {
                PollTarget::Registers { device, block } => (block, device.0),
                PollTarget::Mailboxes { .. } => panic!("no mailboxes"),
            });
            blocks.collect()
        };
        let status = |device| (DiagnosticRegister::AlStatus, device);
        blocks(&mut schedule, 8);
        schedule.al_status_polls = AlStatusPolls::Only;
        assert_eq!(blocks(&mut schedule, 5), [0, 1, 2, 0, 1].map(status));
        schedule.al_status_polls = AlStatusPolls::EveryOther;
        let all = blocks(&mut schedule, 36);
        let each: Vec<_> = all.iter().copied().step_by(2).collect();
        assert_eq!(each[..4], [2, 0, 1, 2].map(status));
        for block in DiagnosticRegister::ALL {
            let read = all.iter().skip(1).step_by(2).filter(|p| p.0 == block);
            assert_eq!(read.count(), 3, "{block:?}");
        }
        schedule.al_status_polls = AlStatusPolls::InTurn;
        assert_eq!(
            blocks(&mut schedule, 1),
            [(DiagnosticRegister::ClockDifference, 2)]
        );
    }

    #[test]
    fn poll_datagrams_fit_the_diagnostic_slot() {
        for members in [members(&[None]), members(&[Some(1); 20])] {
            let mut schedule = PollSchedule::new(&members, None);
            for _ in 0..200 {
                assert!(schedule.next().expect("a poll").len <= MAX_POLL_DATA);
            }
        }
        assert_eq!(PollSchedule::new(&[], None).next(), None);
    }
}
