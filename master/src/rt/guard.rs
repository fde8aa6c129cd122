//! How many bad cycles the machine rides through, and what stops it.

use super::exchange::{Answer, Evidence, Share};

/// AL status that every SubDevice must show while the machine runs.
pub const OP: u8 = 0x08;
/// Cycles that AL status may differ before the machine stops: one lost broadcast is not a fault.
const AL_CYCLES: u32 = 2;

/// Why the machine stops.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum StopCause {
    /// Asked to.
    Requested,
    /// The drive of this axis reported a fault.
    DriveFault { axis: usize },
    /// This axis stopped itself.
    Trip {
        axis: usize,
        trip: ecaxis_axis::Trip,
    },
    /// So many cycles in a row without a valid answer.
    BusLost {
        cycles: u32,
        last_wkc: (u16, u16),
        answered: bool,
    },
    /// A condition of the machine file for it holds.
    EmergencyStop,
    /// This axis can no longer follow what it was geared to, or led along.
    FollowLost { axis: usize },
    /// The user's controller panicked.
    Controller,
    /// The cycle itself panicked.
    Panicked,
    /// The thread beside the cycle does not run any more.
    Unsupervised,
    /// The drive of this axis keeps its power after its removal was requested.
    Powered { axis: usize },
    /// At least one SubDevice is no longer in Op.
    LeftOp { al_status: u8 },
}

impl StopCause {
    /// The machine did not stop because it was asked to.
    #[must_use]
    pub fn is_failure(&self) -> bool {
        !matches!(self, Self::Requested)
    }
}

/// Counts bad cycles in a row, of each group and each device.
#[derive(Debug, Clone)]
pub struct Guard {
    lost_frames: u32,
    groups: Vec<Watch>,
    /// Cycles in which each device was missing by its own evidence.
    missing: Vec<u32>,
    /// Cycles in which AL status was wrong and no group's working counter said whose.
    al: u32,
    /// Cycles in which fewer SubDevices answered than the working counters account for.
    absent: u32,
    al_status: u8,
}

#[derive(Debug, Clone, Copy, Default)]
struct Watch {
    /// That must answer.
    devices: u16,
    /// Cycles without its process data.
    bad: u32,
    /// Cycles in which AL status was wrong, and its working counter, too.
    al: u32,
    last: Share,
}

impl Guard {
    /// `lost_frames` bad cycles in a row stop a group; `groups` are those of the SubDevices.
    #[must_use]
    #[allow(clippy::disallowed_macros, reason = "prepares")]
    pub fn new(lost_frames: u32, groups: &[usize]) -> Self {
        // The first group is there without SubDevices, too.
        let count = groups.iter().max().map_or(1, |last| last + 1);
        let mut watches = vec![Watch::default(); count];
        for &group in groups {
            watches[group].devices = watches[group].devices.saturating_add(1);
        }
        Self {
            lost_frames: lost_frames.max(1),
            groups: watches,
            missing: vec![0; groups.len()],
            al: 0,
            absent: 0,
            al_status: OP,
        }
    }

    /// Looks at one cycle. RT: O(groups + devices).
    pub fn look(&mut self, answer: &Answer, shares: &[Share], evidence: &[Evidence]) {
        for (watch, share) in self.groups.iter_mut().zip(shares) {
            watch.last = *share;
            watch.bad = if share.fresh {
                0
            } else {
                watch.bad.saturating_add(1)
            };
        }
        for (missing, evidence) in self.missing.iter_mut().zip(evidence) {
            *missing = match evidence {
                Evidence::Fresh => 0,
                Evidence::Unknown => *missing,
                Evidence::Missing => missing.saturating_add(1),
            };
        }
        let Some((status, answering)) = answer.al_status else {
            return;
        };
        self.al_status = status;
        let devices = |groups: &mut dyn Iterator<Item = &Watch>| -> u16 {
            groups.map(|g| g.devices).fold(0, u16::saturating_add)
        };
        let expected = devices(&mut self.groups.iter());
        // Who is not in Op does not take outputs, and who is not there takes nothing. That accounts for no more than they are.
        let bad = devices(&mut self.groups.iter().filter(|g| g.bad > 0));
        let accounted = answering >= expected.saturating_sub(bad);
        let known = bad > 0 && accounted;
        let left_op = status != OP;
        for watch in &mut self.groups {
            let guilty = left_op && known && watch.bad > 0;
            watch.al = if guilty {
                watch.al.saturating_add(1)
            } else {
                0
            };
        }
        self.al = if left_op && !known {
            self.al.saturating_add(1)
        } else {
            0
        };
        // A SubDevice that does not answer is a lost frame until there are too many of them.
        self.absent = if accounted {
            0
        } else {
            self.absent.saturating_add(1)
        };
    }

    /// Why the whole machine has to stop: SubDevices are not in Op or do not answer, and no working counter says which.
    #[must_use]
    pub fn left_op(&self) -> Option<StopCause> {
        let al_status = self.al_status;
        let left = self.al >= AL_CYCLES || self.absent >= self.lost_frames;
        left.then_some(StopCause::LeftOp { al_status })
    }

    /// Why a group has to stop.
    #[must_use]
    pub fn lost(&self, group: usize) -> Option<StopCause> {
        let watch = self.groups.get(group)?;
        if watch.bad >= self.lost_frames {
            return Some(StopCause::BusLost {
                cycles: watch.bad,
                last_wkc: watch.last.wkc,
                answered: watch.last.answered,
            });
        }
        let al_status = self.al_status;
        (watch.al >= AL_CYCLES).then_some(StopCause::LeftOp { al_status })
    }

    /// The device has been missing for too long: what is sent to its drive cannot be relied on.
    #[must_use]
    pub fn device_lost(&self, device: usize) -> bool {
        self.missing
            .get(device)
            .is_some_and(|missing| *missing >= self.lost_frames)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHARE: Share = Share::new(true, true, (3, 3));
    const BAD: Share = Share::new(true, false, (0, 3));
    const GONE: Share = Share::new(false, false, (0, 3));

    fn answer(al_status: Option<(u8, u16)>) -> Answer {
        Answer {
            al_status,
            ..Answer::default()
        }
    }

    fn good() -> Answer {
        answer(Some((OP, 2)))
    }

    #[test]
    fn rides_through_fewer_bad_cycles_than_the_limit() {
        let mut guard = Guard::new(3, &[0, 0]);
        for _ in 0..10 {
            for share in [GONE, GONE, SHARE] {
                let back = share.answered.then_some((OP, 2));
                guard.look(&answer(back), &[share], &[]);
                assert_eq!((guard.lost(0), guard.left_op()), (None, None));
            }
        }
        guard.look(&answer(None), &[GONE], &[]);
        guard.look(&answer(None), &[GONE], &[]);
        guard.look(&answer(None), &[GONE], &[]);
        let lost = StopCause::BusLost {
            cycles: 3,
            last_wkc: (0, 3),
            answered: false,
        };
        assert_eq!((guard.lost(0), guard.left_op()), (Some(lost), None));
    }

    /// Not in Op: after two cycles. Not there: after as many as frames may be lost.
    #[test]
    fn a_device_that_leaves_op_stops_the_machine() {
        for (al, cycles) in [((0x1c, 2), AL_CYCLES), ((OP, 1), 5)] {
            let mut guard = Guard::new(5, &[0, 0]);
            for _ in 1..cycles {
                guard.look(&answer(Some(al)), &[SHARE], &[]);
                assert_eq!(guard.left_op(), None);
            }
            guard.look(&answer(Some(al)), &[SHARE], &[]);
            let left = Some(StopCause::LeftOp { al_status: al.0 });
            assert_eq!((guard.lost(0), guard.left_op()), (None, left));
            guard.look(&good(), &[SHARE], &[]);
            assert_eq!(guard.left_op(), None);
        }
    }

    #[test]
    fn a_device_is_lost_by_its_own_evidence_alone() {
        let mut guard = Guard::new(2, &[0, 0, 0]);
        for evidence in [Evidence::Unknown; 5] {
            guard.look(
                &good(),
                &[BAD],
                &[evidence, Evidence::Missing, Evidence::Fresh],
            );
        }
        let lost = [0, 1, 2].map(|device| guard.device_lost(device));
        assert_eq!(lost, [false, true, false]);
        guard.look(&good(), &[SHARE], &[Evidence::Fresh; 3]);
        assert!(!guard.device_lost(1));
    }

    /// Devices 0, 1 and 2 are in groups 0, 1 and 2; the wrong working counter says whose AL status it is.
    #[test]
    fn a_group_answers_for_its_own_devices() {
        let left = |al_status| Some(StopCause::LeftOp { al_status });
        for (al, shares, groups, machine) in [
            (
                (0x1c, 3),
                [SHARE, BAD, SHARE],
                [None, left(0x1c), None],
                None,
            ),
            // One more is out of Op than the group has.
            (
                (0x1c, 1),
                [SHARE, SHARE, BAD],
                [None, None, None],
                left(0x1c),
            ),
            // A device that does not answer is counted with its process data.
            ((OP, 2), [SHARE, SHARE, BAD], [None, None, None], None),
            ((OP, 1), [SHARE, BAD, BAD], [None, None, None], None),
            ((OP, 3), [SHARE, BAD, SHARE], [None, None, None], None),
        ] {
            let mut guard = Guard::new(10, &[0, 1, 2]);
            for _ in 0..AL_CYCLES {
                guard.look(&answer(Some(al)), &shares, &[]);
            }
            let found = [0, 1, 2].map(|group| guard.lost(group));
            assert_eq!((found, guard.left_op()), (groups, machine), "{al:?}");
        }
    }

    #[test]
    fn a_group_without_its_process_data_is_lost_alone() {
        let mut guard = Guard::new(2, &[1]);
        for _ in 0..2 {
            guard.look(&answer(Some((OP, 1))), &[SHARE, BAD], &[]);
        }
        assert_eq!(guard.lost(0), None);
        assert!(matches!(
            guard.lost(1),
            Some(StopCause::BusLost {
                cycles: 2,
                last_wkc: (0, 3),
                answered: true
            })
        ));
    }
}
