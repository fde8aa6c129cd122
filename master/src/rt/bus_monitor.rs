//! Counts bad cycles and decides when they stop the machine or a group.

use ecaxis_axis::State;
use ecaxis_ecat::al_state::AlState;
use ecaxis_ecat::index::{AxisIndex, DeviceIndex, GroupIndex, IndexVec};

use super::exchange::{AlStatusPolls, CycleResult, DeviceAnswer, GroupResult};
use super::gateway::NodeState;

/// AL status that every SubDevice must show while the machine runs.
pub const OP: u8 = AlState::Op.code();
/// Cycles for which the AL status may differ before the machine stops: one lost broadcast is not a
/// fault.
const AL_CYCLES: u32 = 2;
/// Reads in a row that a device leaves unanswered before it counts as missing.
const MISSED_READS: u32 = 2;

/// The cause of a stop.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum StopCause {
    /// A stop was requested.
    Requested,
    /// The drive of this axis reported a fault.
    DriveFault { axis: AxisIndex },
    /// The axis stopped itself.
    Trip {
        axis: AxisIndex,
        trip: ecaxis_axis::Trip,
    },
    /// This number of cycles in a row had no valid answer.
    BusLost {
        cycles: u32,
        last_wkc: (u16, u16),
        answered: bool,
    },
    /// An emergency stop condition of the machine file is true.
    EmergencyStop,
    /// The node of this axis behind a gateway is not Operational any more.
    NodeLost { axis: AxisIndex, state: NodeState },
    /// The axis can no longer follow its master or its set-point source.
    FollowLost { axis: AxisIndex },
    /// The user's controller panicked.
    Controller,
    /// The cycle itself panicked.
    Panicked,
    /// The supervisor thread no longer runs.
    Unsupervised,
    /// The drive of this axis keeps power although it was commanded to remove it.
    Powered { axis: AxisIndex },
    /// The drive of this axis left Operation enabled, and no cause is recorded.
    PowerLost { axis: AxisIndex, state: State },
    /// At least one SubDevice is no longer in Op.
    LeftOp { al_status: u8 },
    /// An optional device was absent as the machine started.
    Absent,
}

impl StopCause {
    /// Returns the axis that caused the stop.
    #[must_use]
    pub fn axis(&self) -> Option<AxisIndex> {
        match *self {
            Self::DriveFault { axis }
            | Self::Trip { axis, .. }
            | Self::FollowLost { axis }
            | Self::NodeLost { axis, .. }
            | Self::Powered { axis }
            | Self::PowerLost { axis, .. } => Some(axis),
            _ => None,
        }
    }

    /// True unless the stop was requested.
    #[must_use]
    pub fn is_failure(&self) -> bool {
        !matches!(self, Self::Requested)
    }
}

/// Counts consecutive bad cycles of each group and each device.
#[derive(Debug, Clone)]
pub struct BusMonitor {
    lost_frames: u32,
    groups: IndexVec<GroupIndex, GroupCounters>,
    /// For each device, the cycles in which its own answer was missing.
    missing: IndexVec<DeviceIndex, u32>,
    /// Cycles in which AL status was wrong and no group's working counter identified the device.
    al: u32,
    /// Cycles in which fewer SubDevices answered than the working counters and the reads of single
    /// devices explain.
    absent: u32,
    /// The reads of each device's AL status that it did not answer.
    missed: IndexVec<DeviceIndex, MissedReads>,
    /// True while a device is searched that does not answer.
    searches: bool,
    /// The cycles so far in which the frame with AL status returned.
    cycles: u64,
    al_status: u8,
    /// The group of each device.
    group_of: IndexVec<DeviceIndex, GroupIndex>,
    /// True if AL status of the bus says nothing, because devices may be outside Op: those of a
    /// stopped group, or devices that are not in the machine file. Each device is then judged by
    /// its own status. Also true while it is not known whose group is concerned.
    judges_each: bool,
    /// Cycles until an AL status that no device is found for stops the machine.
    al_cycles: u32,
    /// Cycles until a missing answer that no device is found for stops the machine.
    absent_cycles: u32,
}

/// The reads of one device's AL status since its last answer.
#[derive(Debug, Clone, Copy, Default)]
struct MissedReads {
    count: u32,
    /// The cycle of the first one.
    since: u64,
}

#[derive(Debug, Clone, Copy, Default)]
struct GroupCounters {
    /// The number of devices that must answer.
    devices: u16,
    /// Cycles without the group's process data.
    bad: u32,
    /// Cycles in which both AL status and the group's working counter were wrong.
    al: u32,
    /// True while one of its devices answers no read of its AL status.
    absent: bool,
    last: GroupResult,
}

impl BusMonitor {
    /// Creates a monitor that stops a group after `lost_frames` bad cycles in a row. `groups` holds
    /// the group of each SubDevice.
    #[must_use]
    #[allow(clippy::disallowed_macros, reason = "runs before the loop")]
    pub fn new(lost_frames: u32, groups: &[GroupIndex]) -> Self {
        // The first group exists even without SubDevices.
        let count = groups.iter().max().map_or(1, |last| last.0 + 1);
        let lost_frames = lost_frames.max(1);
        // Each device is asked once, one every other cycle; answers take two cycles.
        let devices = u32::try_from(groups.len()).unwrap_or(u32::MAX);
        let search = devices.saturating_mul(2).saturating_add(2);
        let mut watches = IndexVec::from(vec![GroupCounters::default(); count]);
        for &group in groups {
            watches[group].devices = watches[group].devices.saturating_add(1);
        }
        Self {
            lost_frames,
            groups: watches,
            missing: vec![0; groups.len()].into(),
            al: 0,
            absent: 0,
            missed: vec![MissedReads::default(); groups.len()].into(),
            searches: false,
            cycles: 0,
            al_status: OP,
            group_of: groups.to_vec().into(),
            judges_each: false,
            al_cycles: match count {
                1 => AL_CYCLES,
                _ => search.saturating_add(AL_CYCLES),
            },
            absent_cycles: match count {
                1 => lost_frames,
                _ => lost_frames.saturating_add(search.saturating_mul(MISSED_READS)),
            },
        }
    }

    /// Returns true if AL status of the bus does not show which device left Op.
    #[must_use]
    pub fn judges_each(&self) -> bool {
        self.judges_each && self.al_status != OP
    }

    /// Returns how often AL status of each device must be read.
    #[must_use]
    pub fn al_status_polls(&self) -> AlStatusPolls {
        match (self.judges_each(), self.al) {
            _ if self.searches => AlStatusPolls::Only,
            (false, _) => AlStatusPolls::InTurn,
            (true, 0) => AlStatusPolls::EveryOther,
            (true, _) => AlStatusPolls::Only,
        }
    }

    /// Takes whether a device has answered the read of its AL status, before
    /// [`BusMonitor::update`] of the same cycle. RT.
    pub fn take_read(&mut self, device: DeviceIndex, answered: bool) {
        if let Some(missed) = self.missed.get_mut(device) {
            *missed = match (answered, missed.count) {
                (true, _) => MissedReads::default(),
                (false, 0) => MissedReads {
                    count: 1,
                    since: self.cycles,
                },
                (false, count) => MissedReads {
                    count: count.saturating_add(1),
                    ..*missed
                },
            };
        }
    }

    /// Evaluates each device's own AL status (`None`: unknown), unless its group has stopped. RT:
    /// O(devices).
    pub fn update_each(
        &mut self,
        stopped: impl Fn(GroupIndex) -> bool,
        al_status: impl Iterator<Item = Option<u8>>,
    ) {
        for (&group, status) in self.group_of.iter().zip(al_status) {
            if let (Some(status), Some(watch)) = (status, self.groups.get_mut(group))
                && status != OP
                && !stopped(group)
            {
                self.al_status = status;
                watch.al = AL_CYCLES;
            }
        }
    }

    /// Evaluates one cycle. `any_stopped`: the machine continues without a group. RT: O(groups +
    /// devices).
    pub fn update(
        &mut self,
        answer: &CycleResult,
        groups: &[GroupResult],
        devices: &[DeviceAnswer],
        any_stopped: bool,
    ) {
        for (watch, result) in self.groups.iter_mut().zip(groups) {
            watch.last = *result;
            watch.bad = if result.fresh {
                0
            } else {
                watch.bad.saturating_add(1)
            };
        }
        for (missing, answer) in self.missing.iter_mut().zip(devices) {
            *missing = match answer {
                DeviceAnswer::Fresh => 0,
                DeviceAnswer::Unknown => *missing,
                DeviceAnswer::Missing => missing.saturating_add(1),
            };
        }
        let Some((status, answering)) = answer.al_status else {
            return;
        };
        self.al_status = status;
        self.cycles += 1;
        let unanswered = self.find_absent();
        let devices = |groups: &mut dyn Iterator<Item = &GroupCounters>| -> u16 {
            groups.map(|g| g.devices).fold(0, u16::saturating_add)
        };
        let expected = devices(&mut self.groups.iter());
        // A device outside Op ignores its outputs, and an absent device processes nothing. The bad
        // groups can explain at most as many missing answers as they have devices.
        let bad = devices(&mut self.groups.iter().filter(|g| g.bad > 0));
        let accounted = answering >= expected.saturating_sub(bad);
        let known = bad > 0 && accounted;
        let excused = any_stopped || answering > expected;
        let left_op = status != OP && !excused;
        for watch in &mut self.groups {
            let guilty = left_op && known && watch.bad > 0;
            watch.al = if guilty {
                watch.al.saturating_add(1)
            } else {
                0
            };
        }
        self.judges_each = excused || (self.groups.len() > 1 && left_op && !known);
        self.al = if left_op && !known {
            self.al.saturating_add(1)
        } else {
            0
        };
        // A missing answer counts as a lost frame until the limit is reached. A device without process
        // data is found by its own reads.
        let accounted = answering >= expected.saturating_sub(bad.saturating_add(unanswered));
        self.absent = if accounted {
            0
        } else {
            self.absent.saturating_add(1)
        };
        self.searches |= self.absent > 0 && self.groups.len() > 1;
    }

    /// Marks the groups with a device that answers no read. Returns the number of devices that have
    /// not answered their last read although the working counter of their group is right. RT:
    /// O(groups + devices).
    fn find_absent(&mut self) -> u16 {
        let mut unanswered: u16 = 0;
        self.searches = false;
        for watch in &mut self.groups {
            watch.absent = false;
        }
        for (missed, &group) in self.missed.iter().zip(&self.group_of) {
            let Some(watch) = self.groups.get_mut(group).filter(|_| missed.count > 0) else {
                continue;
            };
            let lasts = self.cycles.saturating_sub(missed.since) >= u64::from(self.lost_frames);
            let absent = missed.count >= MISSED_READS && lasts;
            watch.absent |= absent;
            self.searches |= !absent;
            unanswered = unanswered.saturating_add(u16::from(watch.bad == 0));
        }
        self.searches &= self.groups.len() > 1;
        unanswered
    }

    /// Returns the cause to stop the whole machine: SubDevices left Op or do not answer, and neither a
    /// working counter nor a read of their own AL status identifies them.
    #[must_use]
    pub fn left_op(&self) -> Option<StopCause> {
        let al_status = self.al_status;
        let left = self.al >= self.al_cycles || self.absent >= self.absent_cycles;
        left.then_some(StopCause::LeftOp { al_status })
    }

    /// Returns the devices of a group.
    pub fn devices_of(&self, group: GroupIndex) -> impl Iterator<Item = DeviceIndex> + '_ {
        let devices = self.group_of.enumerate();
        devices.filter_map(move |(device, of)| (*of == group).then_some(device))
    }

    /// Returns the cause to stop a group.
    #[must_use]
    pub fn lost(&self, group: GroupIndex) -> Option<StopCause> {
        let watch = self.groups.get(group)?;
        if watch.bad >= self.lost_frames {
            return Some(StopCause::BusLost {
                cycles: watch.bad,
                last_wkc: watch.last.wkc,
                answered: watch.last.answered,
            });
        }
        let al_status = self.al_status;
        (watch.al >= AL_CYCLES || watch.absent).then_some(StopCause::LeftOp { al_status })
    }

    /// True once the device has been missing for too long: it may not receive its outputs.
    #[must_use]
    pub fn device_lost(&self, device: DeviceIndex) -> bool {
        self.missing
            .get(device)
            .is_some_and(|missing| *missing >= self.lost_frames)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: GroupResult = GroupResult::new(true, true, (3, 3));
    const BAD: GroupResult = GroupResult::new(true, false, (0, 3));
    const GONE: GroupResult = GroupResult::new(false, false, (0, 3));

    fn answer(al_status: Option<(u8, u16)>) -> CycleResult {
        CycleResult {
            al_status,
            ..CycleResult::default()
        }
    }

    fn good() -> CycleResult {
        answer(Some((OP, 2)))
    }

    #[test]
    fn bus_monitor_tolerates_fewer_bad_cycles_than_the_limit() {
        let mut guard = BusMonitor::new(3, &[GroupIndex(0); 2]);
        for _ in 0..10 {
            for result in [GONE, GONE, GOOD] {
                let back = result.answered.then_some((OP, 2));
                guard.update(&answer(back), &[result], &[], false);
                assert_eq!((guard.lost(GroupIndex(0)), guard.left_op()), (None, None));
            }
        }
        guard.update(&answer(None), &[GONE], &[], false);
        guard.update(&answer(None), &[GONE], &[], false);
        guard.update(&answer(None), &[GONE], &[], false);
        let lost = StopCause::BusLost {
            cycles: 3,
            last_wkc: (0, 3),
            answered: false,
        };
        assert_eq!(
            (guard.lost(GroupIndex(0)), guard.left_op()),
            (Some(lost), None)
        );
    }

    /// A device outside Op stops the machine after two cycles, an absent one after the limit of
    /// lost frames.
    #[test]
    fn a_device_that_leaves_op_stops_the_machine() {
        for (al, cycles) in [((0x1c, 2), AL_CYCLES), ((OP, 1), 5)] {
            let mut guard = BusMonitor::new(5, &[GroupIndex(0); 2]);
            for _ in 1..cycles {
                guard.update(&answer(Some(al)), &[GOOD], &[], false);
                assert_eq!(guard.left_op(), None);
            }
            guard.update(&answer(Some(al)), &[GOOD], &[], false);
            let left = Some(StopCause::LeftOp { al_status: al.0 });
            assert_eq!((guard.lost(GroupIndex(0)), guard.left_op()), (None, left));
            guard.update(&good(), &[GOOD], &[], false);
            assert_eq!(guard.left_op(), None);
        }
    }

    #[test]
    fn device_is_lost_only_by_its_own_answers() {
        let mut guard = BusMonitor::new(2, &[GroupIndex(0); 3]);
        for unknown in [DeviceAnswer::Unknown; 5] {
            guard.update(
                &good(),
                &[BAD],
                &[unknown, DeviceAnswer::Missing, DeviceAnswer::Fresh],
                false,
            );
        }
        let lost = [0, 1, 2].map(|device| guard.device_lost(DeviceIndex(device)));
        assert_eq!(lost, [false, true, false]);
        guard.update(&good(), &[GOOD], &[DeviceAnswer::Fresh; 3], false);
        assert!(!guard.device_lost(DeviceIndex(1)));
    }

    /// Devices 0, 1 and 2 are in groups 0, 1 and 2. The wrong working counter identifies whose AL
    /// status is wrong.
    #[test]
    fn wrong_al_status_is_attributed_to_the_group_with_a_wrong_counter() {
        let left = |al_status| Some(StopCause::LeftOp { al_status });
        for (al, results, groups, machine) in [
            ((0x1c, 3), [GOOD, BAD, GOOD], [None, left(0x1c), None], None),
            // More devices left Op than the group has.
            ((0x1c, 1), [GOOD, GOOD, BAD], [None, None, None], left(0x1c)),
            // An absent device counts by its process data.
            ((OP, 2), [GOOD, GOOD, BAD], [None, None, None], None),
            ((OP, 1), [GOOD, BAD, BAD], [None, None, None], None),
            ((OP, 3), [GOOD, BAD, GOOD], [None, None, None], None),
        ] {
            let mut guard = BusMonitor::new(20, &[0, 1, 2].map(GroupIndex));
            // Three devices are asked in six cycles.
            for _ in 0..AL_CYCLES + 8 {
                guard.update(&answer(Some(al)), &results, &[], false);
            }
            let found = [0, 1, 2].map(|group| guard.lost(GroupIndex(group)));
            assert_eq!((found, guard.left_op()), (groups, machine), "{al:?}");
        }
    }

    /// A device without process data changes no working counter: it is missing once it answers no
    /// read of its own. The machine stopped although its group may stop alone.
    #[test]
    fn device_without_process_data_stops_its_group_alone() {
        let groups = [0, 1, 2].map(GroupIndex);
        let mut guard = BusMonitor::new(3, &groups);
        let lost = |guard: &BusMonitor| groups.map(|group| guard.lost(group));
        let left = Some(StopCause::LeftOp { al_status: OP });
        let mut stopped = [None; 3];
        for cycle in 0..200 {
            // One read every other cycle; the group of device 1 has stopped once it is missing.
            if cycle % 2 == 0 {
                let device = cycle / 2 % 3;
                guard.take_read(DeviceIndex(device), device != 1);
            }
            let any_stopped = stopped[1].is_some();
            guard.update(&answer(Some((OP, 2))), &[GOOD; 3], &[], any_stopped);
            stopped = lost(&guard);
            if stopped[1].is_none() {
                assert_eq!(guard.al_status_polls(), AlStatusPolls::Only);
            }
            assert_eq!(guard.left_op(), None, "cycle {cycle}");
            assert_eq!((stopped[0], stopped[2]), (None, None));
            // The second read of device 1.
            assert_eq!(stopped[1], left.filter(|_| cycle >= 8), "cycle {cycle}");
        }
        // Device 2 is missing as well.
        for cycle in 0..200 {
            if cycle % 2 == 0 {
                let device = cycle / 2 % 3;
                guard.take_read(DeviceIndex(device), device == 0);
            }
            guard.update(&answer(Some((OP, 1))), &[GOOD; 3], &[], true);
            assert_eq!(guard.left_op(), None, "cycle {cycle}");
        }
        assert_eq!(lost(&guard), [None, left, left]);
        for device in 0..3 {
            guard.take_read(DeviceIndex(device), true);
        }
        guard.update(&answer(Some((OP, 3))), &[GOOD; 3], &[], true);
        assert_eq!(lost(&guard), [None; 3]);
    }

    /// A device that misses fewer cycles than the limit stops nothing, and one that no read finds
    /// stops the machine.
    #[test]
    fn missing_answers_stop_the_machine_if_no_read_finds_the_device() {
        let groups = [0, 1].map(GroupIndex);
        let mut guard = BusMonitor::new(20, &groups);
        for device in [1, 0, 1, 0] {
            guard.take_read(DeviceIndex(device), device == 0);
            guard.update(&answer(Some((OP, 1))), &[GOOD; 2], &[], false);
            assert_eq!(groups.map(|group| guard.lost(group)), [None; 2]);
        }
        guard.take_read(DeviceIndex(1), true);
        let mut cycles = 0;
        while guard.left_op().is_none() {
            guard.take_read(DeviceIndex(cycles % 2), true);
            guard.update(&answer(Some((OP, 1))), &[GOOD; 2], &[], false);
            cycles += 1;
            assert!(cycles < 100, "never found");
        }
        assert!(cycles >= 20, "{cycles}");
        assert_eq!(groups.map(|group| guard.lost(group)), [None; 2]);
    }

    /// A stopped group and a device that is not in the file need not be in Op. Another device that
    /// leaves Op stops its own group.
    #[test]
    fn devices_are_judged_one_by_one_if_some_may_be_outside_op() {
        for (any_stopped, answering) in [(true, 3), (false, 4)] {
            let mut guard = BusMonitor::new(20, &[0, 1, 2].map(GroupIndex));
            let lost = |guard: &BusMonitor| [0, 1, 2].map(|group| guard.lost(GroupIndex(group)));
            let stopped = |group| any_stopped && group == GroupIndex(1);
            let own = if any_stopped { 2 } else { OP };
            for _ in 0..5 {
                let seen = answer(Some((0x0a, answering)));
                guard.update(&seen, &[GOOD; 3], &[], any_stopped);
                assert!(guard.judges_each());
                guard.update_each(stopped, [Some(OP), Some(own), None].into_iter());
                assert_eq!((lost(&guard), guard.left_op()), ([None; 3], None));
            }
            let seen = answer(Some((0x1e, answering)));
            guard.update(&seen, &[GOOD; 3], &[], any_stopped);
            guard.update_each(stopped, [Some(0x14), Some(own), Some(OP)].into_iter());
            let left = Some(StopCause::LeftOp { al_status: 0x14 });
            assert_eq!((lost(&guard), guard.left_op()), ([left, None, None], None));
            for _ in 0..AL_CYCLES + 8 {
                guard.update(&answer(Some((0x0a, 3))), &[GOOD; 3], &[], false);
            }
            assert!(guard.left_op().is_some(), "all should be in Op again");
        }
    }

    /// A search that ended after 200 cycles stopped the whole machine if it had more than about 100
    /// devices.
    #[test]
    fn device_of_a_large_machine_stops_its_group_alone() {
        let groups: Vec<_> = (0..300).map(GroupIndex).collect();
        let mut guard = BusMonitor::new(3, &groups);
        let results = [GOOD; 300];
        for cycle in 0..600 {
            guard.update(&answer(Some((0x0c, 300))), &results, &[], false);
            assert_eq!(guard.al_status_polls(), AlStatusPolls::Only);
            let read = |device| {
                if device == 299 && cycle == 599 {
                    0x04
                } else {
                    OP
                }
            };
            guard.update_each(|_| false, (0..300).map(|device| Some(read(device))));
            assert_eq!(guard.left_op(), None, "cycle {cycle}");
        }
        let left = Some(StopCause::LeftOp { al_status: 0x04 });
        assert_eq!(guard.lost(GroupIndex(299)), left);
        assert!((0..299).all(|group| guard.lost(GroupIndex(group)).is_none()));
    }

    #[test]
    fn a_group_without_its_process_data_is_lost_alone() {
        let mut guard = BusMonitor::new(2, &[GroupIndex(1)]);
        for _ in 0..2 {
            guard.update(&answer(Some((OP, 1))), &[GOOD, BAD], &[], false);
        }
        assert_eq!(guard.lost(GroupIndex(0)), None);
        assert!(matches!(
            guard.lost(GroupIndex(1)),
            Some(StopCause::BusLost {
                cycles: 2,
                last_wkc: (0, 3),
                answered: true
            })
        ));
    }
}
