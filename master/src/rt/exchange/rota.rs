//! Whose turn it is in the diagnostic slot. Where mailboxes are looked into, every other turn is theirs: what a cycle costs does
//! not depend on how many there are.

use super::frame::{DATAGRAM_HEADER, WKC};
use super::probe::Probe;
use super::{FPRD, LRD, Member};
use crate::rt::image::MailboxPlan;

/// A SyncManager's status register.
const STATUS: u16 = 0x0805;
/// Bytes that the longest look brings.
const LONGEST: usize = 8;
/// Bytes of the longest datagram of the diagnostic slot.
pub const LONGEST_LOOK: usize = DATAGRAM_HEADER + LONGEST + WKC;

/// What a turn is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Look {
    /// A register block of one member.
    At { device: usize, probe: Probe },
    /// Status of mailboxes, a byte each, from this one of [`Rota::mailbox_devices`] on.
    Mailboxes { first: usize },
}

/// One read of the diagnostic slot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Turn {
    pub look: Look,
    pub command: u8,
    pub address: u32,
    pub len: usize,
}

/// The turns, one after the other.
#[derive(Debug)]
pub(super) struct Rota {
    diagnosis: Box<[Turn]>,
    mailboxes: Box<[Turn]>,
    /// Whose status the looks at mailboxes bring, in their order.
    pub mailbox_devices: Box<[usize]>,
    /// The next of each.
    next: (usize, usize),
    mailbox_is_next: bool,
}

impl Rota {
    /// Each probe of all members, one after the other; and the status of mailboxes, up to eight at once where an FMMU maps it.
    #[allow(clippy::disallowed_methods, reason = "prepares")]
    pub fn new(members: &[Member], mapped: Option<&MailboxPlan>) -> Self {
        let registers =
            |station: u16, register: u16| u32::from(register) << 16 | u32::from(station);
        let diagnosis = Probe::ALL.iter().flat_map(|&probe| {
            let (register, len) = probe.register_and_len();
            members
                .iter()
                .enumerate()
                .map(move |(device, member)| Turn {
                    look: Look::At { device, probe },
                    command: FPRD,
                    address: registers(member.station, register),
                    len,
                })
        });
        let mut mailbox_devices = mapped.map_or_else(Vec::new, |plan| plan.devices.clone());
        let mut mailboxes: Vec<Turn> = mailbox_devices
            .chunks(LONGEST)
            .scan(0, |at, window| {
                let first = *at;
                *at += window.len();
                Some((first, window.len()))
            })
            .map(|(first, len)| Turn {
                look: Look::Mailboxes { first },
                command: LRD,
                address: mapped.map_or(0, |plan| plan.address(first)),
                len,
            })
            .collect();
        for (device, member) in members.iter().enumerate() {
            if let Some(sm) = member.mailbox
                && !mapped.is_some_and(|plan| plan.devices.contains(&device))
            {
                mailboxes.push(Turn {
                    look: Look::Mailboxes {
                        first: mailbox_devices.len(),
                    },
                    command: FPRD,
                    address: registers(member.station, STATUS + 8 * u16::from(sm)),
                    len: 1,
                });
                mailbox_devices.push(device);
            }
        }
        Self {
            diagnosis: diagnosis.collect(),
            mailboxes: mailboxes.into(),
            mailbox_devices: mailbox_devices.into(),
            next: (0, 0),
            mailbox_is_next: false,
        }
    }

    /// Whose turn it is; `None` without members. RT.
    pub fn next(&mut self) -> Option<Turn> {
        let mailbox = self.mailbox_is_next && !self.mailboxes.is_empty();
        self.mailbox_is_next = !mailbox;
        let (turns, next) = if mailbox {
            (&self.mailboxes, &mut self.next.1)
        } else {
            (&self.diagnosis, &mut self.next.0)
        };
        let turn = turns.get(*next).copied();
        *next = if *next + 1 < turns.len() {
            *next + 1
        } else {
            0
        };
        turn
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn members(mailboxes: &[Option<u8>]) -> Vec<Member> {
        let each = mailboxes
            .iter()
            .zip(1001..)
            .map(|(&mailbox, station)| Member {
                station,
                clock: true,
                mailbox,
            });
        each.collect()
    }

    #[test]
    fn every_other_turn_is_for_mailboxes() {
        let members = members(&[Some(1), None, Some(3)]);
        let mut rota = Rota::new(&members, None);
        let looks: Vec<Turn> = std::iter::from_fn(|| rota.next()).take(64).collect();
        let mut probes = Vec::new();
        let mut mailboxes = Vec::new();
        for (n, turn) in looks.iter().enumerate() {
            match turn.look {
                Look::At { device, probe } => {
                    assert_eq!(n % 2, 0);
                    assert_eq!(turn.address & 0xffff, 1001 + device as u32);
                    probes.push((probe, device));
                }
                Look::Mailboxes { first } => {
                    mailboxes.push((rota.mailbox_devices[first], turn.address, turn.len));
                }
            }
        }
        let first = (0, 0x080d_03e9, 1);
        let second = (2, 0x081d_03eb, 1);
        assert_eq!(mailboxes[..4], [first, second, first, second]);
        assert_eq!(
            probes[..4].iter().map(|p| p.1).collect::<Vec<_>>(),
            [0, 1, 2, 0]
        );
        // All of them, and then from the beginning.
        assert_eq!(probes[0], probes[15]);
        for probe in Probe::ALL {
            assert_eq!(probes[..15].iter().filter(|p| p.0 == probe).count(), 3);
        }
    }

    #[test]
    fn mapped_mailboxes_are_seen_eight_at_once() {
        let members = members(&[Some(1); 12]);
        let plan = MailboxPlan {
            logical: 0x0001_0100,
            devices: (0..12).filter(|n| *n != 4).collect(),
        };
        let mut rota = Rota::new(&members, Some(&plan));
        let looks = std::iter::from_fn(|| rota.next())
            .take(8)
            .collect::<Vec<_>>();
        let mailboxes: Vec<_> = looks
            .iter()
            .filter_map(|turn| match turn.look {
                Look::Mailboxes { first } => Some((first, turn.command, turn.address, turn.len)),
                Look::At { .. } => None,
            })
            .collect();
        let expected = [
            (0, LRD, 0x0001_0100, 8),
            (8, LRD, 0x0001_0108, 3),
            (11, FPRD, 0x080d_03ed, 1),
            (0, LRD, 0x0001_0100, 8),
        ];
        assert_eq!(mailboxes, expected);
        assert_eq!(rota.mailbox_devices[11], 4);
    }

    #[test]
    fn none_is_longer_than_the_room_for_it() {
        for members in [members(&[None]), members(&[Some(1); 20])] {
            let mut rota = Rota::new(&members, None);
            for _ in 0..200 {
                assert!(rota.next().expect("a turn").len <= LONGEST);
            }
        }
        assert_eq!(Rota::new(&[], None).next(), None);
    }
}
