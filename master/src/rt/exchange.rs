//! The frames of a cycle. They are built once, refilled every cycle and sent back to back. They
//! carry:
//!
//! - an FRMW of the system time;
//! - an LRW of each group's process data, or LWR and LRD where a SubDevice has no LRW;
//! - one BRD of AL status;
//! - one read of the diagnostic slot.
//!
//! The last byte of the source MAC distinguishes these frames from ethercrab's, because ethercrab
//! uses all 256 datagram indices. The byte before it holds the number of the frame in the cycle.
//! Its remaining bits and the datagram index hold the number of the cycle. Late and repeated frames
//! are therefore recognised.
//!
//! Devices share datagrams and therefore working counters. After a wrong counter each device gets
//! its own datagram, so that a missing device does not hide the state of the others.

use std::sync::Arc;

use ecaxis_axis::Delivery;
use ecaxis_ecat::index::{DeviceIndex, GroupIndex, IndexVec};

pub use super::config::ExchangeMode;
use super::image::plan::frames as frames_of;
use super::image::{Access, BitCopy, ImagePlan};
use super::phase::ClockPlan;
use crate::clock::{self, Nanos};
use crate::link::pdu_loop::ETHERCAT;
use crate::link::{Link, LinkError};

mod bus_status;
mod diagnostics;
mod frame;
mod frame_set;
mod poll_schedule;
mod reference;
mod result;
mod slots;

pub use bus_status::{BusStatus, MailboxStatus};
pub(crate) use diagnostics::sign_magnitude;
pub use diagnostics::{DiagnosticRegister, ErrorCounters, SubDeviceDiagnostics, Window};
use frame::{
    DATAGRAM_HEADER, DatagramSlot, FIRST_DATAGRAM, MAC_TAIL, WKC, clear_wkc, frame_number,
    frame_tag, new_frames, same_datagram, write_header, write_station,
};
use frame_set::FrameSet;
pub use poll_schedule::{AlStatusPolls, MAX_POLL_DATAGRAM};
use poll_schedule::{PollSchedule, PollTarget};
use reference::ReferenceClock;
pub use result::{CycleResult, DeviceAnswer, ExchangeDevice, GroupResult, Received};
use slots::{DatagramSlots, write_clock_offset};

/// After a wrong working counter each device has its own datagram, until this many cycles in a row
/// were right.
const SEPARATE_CYCLES: u16 = 100;

/// The exchange of process data.
#[derive(Debug)]
pub struct Exchange {
    /// The frame set that is staged or was sent in this cycle, and those sent before.
    frame_sets: Vec<FrameSet>,
    staged: usize,
    /// The positions of the datagrams: with shared datagrams, and with one for each device.
    layouts: Vec<DatagramSlots>,
    /// The layout of each of the last cycles, by the low byte of the cycle's number.
    layout_of_cycle: [u8; 256],
    /// The number of cycles for which each device still has its own datagram.
    separate_cycles: u16,
    /// True while devices are in Op: a wrong counter then means that a device is missing.
    op_expected: bool,
    /// The devices in the order of their data in the image.
    order: Vec<DeviceIndex>,
    device_answers: IndexVec<DeviceIndex, DeviceAnswer>,
    /// For each device, whether it processed a frame whose inputs do not count: a late answer has
    /// arrived since the last cycle, or a counter that it shares was wrong and its inputs are there.
    deliveries: IndexVec<DeviceIndex, Delivery>,
    /// The place of each device's inputs in the image: offset and length.
    input_places: IndexVec<DeviceIndex, (usize, usize)>,
    reference: ReferenceClock,
    /// The value for 0x0920 of the reference clock, if SYNC0 is aligned.
    reference_offset: Option<u64>,
    /// The largest difference to the reference clock with which a clock may replace it.
    clock_window_ns: u64,
    bus_status: Arc<BusStatus>,
    group_results: IndexVec<GroupIndex, GroupResult>,
    diagnoses: IndexVec<DeviceIndex, SubDeviceDiagnostics>,
    windows: IndexVec<DeviceIndex, Window>,
    groups: IndexVec<DeviceIndex, GroupIndex>,
    schedule: PollSchedule,
    cycle: u32,
    outputs: Vec<u8>,
    inputs: Vec<u8>,
    /// Copies of inputs to outputs, each with the device of the inputs.
    copies: Vec<(DeviceIndex, BitCopy)>,
    /// The outputs at the start of the run.
    initial_outputs: Vec<u8>,
    /// The devices whose outputs have their initial values, as `output_locks` lists them.
    locked: IndexVec<DeviceIndex, bool>,
    output_locks: Vec<(DeviceIndex, BitCopy)>,
    /// Copies of outputs to outputs.
    repeats: Vec<BitCopy>,
}

impl Exchange {
    /// Builds the frames. `members` are the devices of the plan, in the same order. Results have
    /// this order too.
    #[must_use]
    #[allow(
        clippy::disallowed_methods,
        clippy::disallowed_macros,
        reason = "runs before the loop"
    )]
    pub fn new(
        plan: &ImagePlan,
        clock: Option<&ClockPlan>,
        members: &[ExchangeDevice],
        mode: ExchangeMode,
    ) -> Self {
        let mut order: Vec<_> = plan.regions.indices().collect();
        order.retain(|&device| plan.regions[device].is_some());
        order.sort_by_key(|&device| plan.regions[device].map_or(0, |region| region.offset));
        let mut datagrams = vec![&plan.datagrams];
        if plan.separate.len() > plan.datagrams.len() {
            datagrams.push(&plan.separate);
        }
        let mut layouts = Vec::new();
        let mut frame_sets = Vec::new();
        for number in 0..mode.frame_sets() {
            let mut frames = Vec::new();
            for datagrams in &datagrams {
                let mut filled = new_frames(frames_of(datagrams));
                let slots = DatagramSlots::fill(&mut filled, plan, datagrams, &order, clock);
                frames.push(filled);
                if number == 0 {
                    layouts.push(slots);
                }
            }
            frame_sets.push(FrameSet::new(frames));
        }
        // The first group exists even without members.
        let groups = plan.groups.iter().max().map_or(1, |last| last.0 + 1);
        let mut group_results = IndexVec::from(vec![GroupResult::default(); groups]);
        for datagram in &layouts[0].process_data {
            group_results[datagram.group].wkc.1 += datagram.expected_wkc;
        }
        let mut exchange = Self {
            frame_sets,
            staged: 0,
            layouts,
            layout_of_cycle: [0; 256],
            separate_cycles: 0,
            op_expected: false,
            order,
            device_answers: vec![DeviceAnswer::Unknown; members.len()].into(),
            deliveries: vec![Delivery::Unknown; members.len()].into(),
            input_places: plan
                .regions
                .iter()
                .map(|region| region.map_or((0, 0), |region| (region.offset, region.in_len)))
                .collect::<Vec<_>>()
                .into(),
            reference: ReferenceClock::new(members, clock),
            reference_offset: None,
            clock_window_ns: clock.map_or(0, |clock| clock.window_ns),
            bus_status: Arc::new(BusStatus::new(members.len())),
            group_results,
            diagnoses: vec![SubDeviceDiagnostics::default(); members.len()].into(),
            windows: vec![Window::default(); members.len()].into(),
            groups: plan.groups.clone(),
            schedule: PollSchedule::new(members, plan.mailboxes.as_ref()),
            cycle: 0,
            outputs: vec![0; plan.len],
            inputs: vec![0; plan.len],
            initial_outputs: vec![0; plan.len],
            locked: vec![false; members.len()].into(),
            copies: plan.copies.clone(),
            output_locks: plan.output_locks.clone(),
            repeats: plan.repeats.clone(),
        };
        exchange.stage();
        exchange
    }

    /// Returns when answers are evaluated.
    #[must_use]
    pub fn mode(&self) -> ExchangeMode {
        if self.frame_sets.len() == 1 {
            ExchangeMode::SameCycle
        } else {
            ExchangeMode::Pipelined
        }
    }

    /// Takes the present outputs as their initial values. Call it before the first cycle.
    #[allow(clippy::disallowed_methods, reason = "runs before the loop")]
    pub fn keep_initial_outputs(&mut self) {
        self.initial_outputs.clone_from(&self.outputs);
    }

    /// Gives the outputs of a lost device their initial values, until its group is reset. RT.
    pub fn lock_outputs(&mut self, device: DeviceIndex) {
        if let Some(locked) = self.locked.get_mut(device) {
            *locked = true;
        }
    }

    /// Gives the outputs of a group back to their owners. RT: O(members).
    pub fn unlock_outputs(&mut self, group: GroupIndex) {
        for (locked, own) in self.locked.iter_mut().zip(&self.groups) {
            *locked &= *own != group;
        }
    }

    /// Returns for each device whether its outputs are locked.
    #[must_use]
    pub fn locked(&self) -> &IndexVec<DeviceIndex, bool> {
        &self.locked
    }

    /// Returns the outputs of the next cycle.
    pub fn outputs_mut(&mut self) -> &mut [u8] {
        &mut self.outputs
    }

    /// Returns the inputs; each part is from the last cycle in which its working counter was right.
    #[must_use]
    pub fn inputs(&self) -> &[u8] {
        &self.inputs
    }

    /// Returns the result of each group's process data as of the last [`Exchange::evaluate`].
    #[must_use]
    pub fn group_results(&self) -> &IndexVec<GroupIndex, GroupResult> {
        &self.group_results
    }

    /// Returns what the answers show about each device as of the last [`Exchange::evaluate`], in
    /// the order of the members.
    #[must_use]
    pub fn device_answers(&self) -> &IndexVec<DeviceIndex, DeviceAnswer> {
        &self.device_answers
    }

    /// Returns what shows that a device took its outputs although it is not
    /// [`DeviceAnswer::Fresh`].
    #[must_use]
    pub fn delivery(&self, device: DeviceIndex) -> Delivery {
        self.deliveries.get(device).copied().unwrap_or_default()
    }

    /// Sets whether devices are expected in Op. On the way to Op and back, devices begin to answer
    /// one by one and share their datagrams. Devices that already have their own datagrams keep
    /// them until all answer.
    pub fn expect_op(&mut self, expected: bool) {
        self.op_expected = expected;
    }

    /// Returns the results of the diagnostic slot, in the order of the members.
    #[must_use]
    pub fn diagnoses(&self) -> &IndexVec<DeviceIndex, SubDeviceDiagnostics> {
        &self.diagnoses
    }

    /// Returns the error counters around the stop, in the order of the members.
    #[must_use]
    pub fn windows(&self) -> &IndexVec<DeviceIndex, Window> {
        &self.windows
    }

    /// Begins a window for the increments of the error counters. RT: O(members).
    pub fn begin_windows(&mut self) {
        for (window, found) in self.windows.iter_mut().zip(&self.diagnoses) {
            window.begin(&found.errors);
        }
    }

    /// Freezes the windows of a group at its stop; they end with the next read. `None`: all groups.
    /// RT: O(members).
    pub fn stop_windows(&mut self, group: Option<GroupIndex>) {
        for (window, own) in self.windows.iter_mut().zip(&self.groups) {
            if group.is_none_or(|group| group == *own) {
                window.stop();
            }
        }
    }

    /// Restarts the windows of a group that was reset. RT: O(members).
    pub fn release_windows(&mut self, group: GroupIndex) {
        let members = self.windows.iter_mut().zip(&self.diagnoses);
        for ((window, found), own) in members.zip(&self.groups) {
            if group == *own {
                window.release(&found.errors);
            }
        }
    }

    /// Returns the status of mailboxes and the bus time, for the other threads.
    #[must_use]
    pub fn bus_status(&self) -> Arc<BusStatus> {
        Arc::clone(&self.bus_status)
    }

    /// Returns the device and the clock difference that the answers of this cycle contain.
    #[must_use]
    pub fn clock_read(&self) -> Option<(DeviceIndex, i32)> {
        let (device, block) = self.register_read()?;
        let found = self.diagnoses.get(device)?;
        let read = block == DiagnosticRegister::ClockDifference && found.has_read(block);
        (read && found.answers).then_some((device, found.clock_difference))
    }

    /// Returns the device whose AL status the frames of this cycle asked for, and whether it answered.
    #[must_use]
    pub fn al_status_read(&self) -> Option<(DeviceIndex, bool)> {
        let (device, block) = self.register_read()?;
        let found = self.diagnoses.get(device)?;
        (block == DiagnosticRegister::AlStatus).then_some((device, found.answers))
    }

    /// Returns the device and the registers that the frames of this cycle asked for.
    fn register_read(&self) -> Option<(DeviceIndex, DiagnosticRegister)> {
        let frame_set = self.frame_sets.get(self.due())?;
        let PollTarget::Registers { device, block } = frame_set.poll?.target else {
            return None;
        };
        frame_set.answer(0).map(|_| (device, block))
    }

    /// Returns the reference clock; `None` without distributed clocks.
    #[must_use]
    pub fn reference(&self) -> Option<DeviceIndex> {
        self.reference.device()
    }

    /// Returns the index of the oldest frame set, which is evaluated in this cycle.
    fn due(&self) -> usize {
        (self.staged + 1) % self.frame_sets.len()
    }

    /// Fills the frames of the next cycle. RT: O(image).
    pub fn stage(&mut self) {
        self.cycle = self.cycle.wrapping_add(1);
        self.staged = self.due();
        self.deliveries.fill(Delivery::Unknown);
        let separate = self.separate_cycles > 0 && self.layouts.len() > 1;
        self.separate_cycles = self.separate_cycles.saturating_sub(1);
        let layout = usize::from(separate);
        self.layout_of_cycle[(self.cycle & 0xff) as usize] = u8::from(separate);
        if let Some(frame_set) = self.frame_sets.get_mut(self.staged) {
            frame_set.layout = layout;
        }
        self.refresh_outputs();
        let (Some(frame_set), Some(slots)) = (
            self.frame_sets.get_mut(self.staged),
            self.layouts.get(layout),
        ) else {
            return;
        };
        let first = &mut frame_set.frames_mut()[0].bytes;
        let poll = self.schedule.next();
        if let Some(poll) = poll {
            // The diagnostic datagram is the last of its frame, so its length may change within the
            // capacity of the frame.
            let data = slots.diagnostic_at + DATAGRAM_HEADER;
            first.truncate(data);
            first.resize(data + poll.len, BusStatus::UNSEEN);
            first.resize(data + poll.len + WKC, 0);
            write_header(
                first,
                slots.diagnostic_at,
                poll.command,
                poll.address,
                poll.len,
            );
        }
        if let (Some(slot), Some(station)) = (slots.clock, self.reference.station()) {
            write_station(first, slot, station);
            clear_wkc(first, slot);
        }
        if let Some(slot) = slots.clock_offset {
            write_clock_offset(first, slot, self.reference.station(), self.reference_offset);
        }
        first[slots.al_status.data()].fill(0);
        clear_wkc(first, slots.al_status);
        frame_set.poll = poll;
        frame_set.stage(self.cycle);
    }

    /// Copies outputs that have changed since [`Exchange::stage`] into the frames. Call before
    /// [`Exchange::send`]. RT: O(image).
    pub fn refresh_outputs(&mut self) {
        self.copy_process_data();
        let Some(frame_set) = self.frame_sets.get_mut(self.staged) else {
            return;
        };
        let Some(slots) = self.layouts.get(frame_set.layout) else {
            return;
        };
        for datagram in &slots.process_data {
            let slot = datagram.slot;
            let frame = &mut frame_set.frames_mut()[slot.frame].bytes;
            if datagram.access != Access::Inputs {
                let from = datagram.image..datagram.image + slot.len;
                frame[slot.data()].copy_from_slice(&self.outputs[from]);
            }
            clear_wkc(frame, slot);
        }
    }

    /// Copies inputs to outputs, locks the outputs of lost devices, then copies outputs to those that
    /// repeat them. A copy whose source device has not answered in this cycle holds its last value.
    fn copy_process_data(&mut self) {
        for &(source, copy) in &self.copies {
            if self.device_answers.get(source) == Some(&DeviceAnswer::Fresh) {
                copy.apply(&self.inputs, &mut self.outputs);
            }
        }
        for &(device, lock) in &self.output_locks {
            if self.locked.get(device) == Some(&true) {
                lock.apply(&self.initial_outputs, &mut self.outputs);
            }
        }
        for repeat in &self.repeats {
            repeat.apply_within(&mut self.outputs);
        }
    }

    /// Sends all frames of the cycle back to back, `late` after their planned release. RT: blocks
    /// on the wire only.
    pub fn send(&mut self, link: &mut dyn Link, late: Nanos) -> Result<(), LinkError> {
        let Some(frame_set) = self.frame_sets.get_mut(self.staged) else {
            return Ok(());
        };
        let now = clock::now();
        let slots = self.layouts.get(frame_set.layout);
        if let Some(slot) = slots.and_then(|slots| slots.clock) {
            // Other low bits every cycle, so that no clock shows the value by chance several times
            // in a row.
            let varied = u64::from(self.cycle.wrapping_mul(0x9e37_79b1) >> 26);
            let time = self.reference.expected(now) ^ varied;
            frame_set.frames_mut()[0].bytes[slot.data()].copy_from_slice(&time.to_le_bytes());
        }
        frame_set.send(link, now, late)
    }

    /// Stores an answer until its frame set is evaluated. RT: O(frame).
    pub fn receive(&mut self, frame: &[u8]) -> Received {
        if frame.get(12..14) != Some(&ETHERCAT[..]) || frame.get(11) != Some(&MAC_TAIL) {
            return Received::NotOurs;
        }
        let mut frame_sets = self.frame_sets.iter_mut();
        if frame_sets.any(|frame_set| frame_set.receive(frame)) {
            Received::Current
        } else {
            self.receive_late(frame);
            Received::Late
        }
    }

    /// Processes a late frame of an earlier cycle: it proves that its devices received their
    /// outputs. RT: O(devices).
    fn receive_late(&mut self, frame: &[u8]) {
        let (Some(&low), Some(&tag)) = (frame.get(FIRST_DATAGRAM + 1), frame.get(10)) else {
            return;
        };
        let layout = usize::from(self.layout_of_cycle[usize::from(low)]);
        let (Some(slots), Some(frame_set)) = (self.layouts.get(layout), self.frame_sets.first())
        else {
            return;
        };
        let age = self.cycle.wrapping_sub(u32::from(low)) & 0xff;
        let sent = frame_set.layout_frames(layout);
        let number = frame_number(tag, sent.len());
        let same_tag = tag == frame_tag(number, sent.len(), self.cycle.wrapping_sub(age));
        let recent = age > 0 && age <= self.frame_sets.len() as u32 + 1;
        let Some(sent) = sent.get(number).filter(|_| recent && same_tag) else {
            return;
        };
        // The diagnostic datagram may have another length; the datagrams before it have not.
        let known = if number == 0 {
            slots.diagnostic_at
        } else {
            sent.bytes.len()
        };
        if frame.len() < known {
            return;
        }
        for datagram in &slots.process_data {
            let slot = datagram.slot;
            if slot.frame == number
                && same_datagram(&sent.bytes, frame, slot)
                && slot.wkc(frame) == datagram.expected_wkc
            {
                let (first, end) = datagram.devices;
                for &device in self.order.get(first..end).unwrap_or_default() {
                    if let Some(delivery) = self.deliveries.get_mut(device) {
                        *delivery = Delivery::Earlier;
                    }
                }
            }
        }
    }

    /// True if every frame that is evaluated in this cycle has come back.
    #[must_use]
    pub fn complete(&self) -> bool {
        self.frame_sets
            .get(self.due())
            .is_some_and(FrameSet::complete)
    }

    /// Evaluates the due answers per device, per group and in total, and copies their inputs. RT:
    /// O(image).
    pub fn evaluate(&mut self) -> CycleResult {
        let due = self.due();
        let Some(frame_set) = self.frame_sets.get(due) else {
            return CycleResult::default();
        };
        let Some(slots) = self.layouts.get(frame_set.layout) else {
            return CycleResult::default();
        };
        let first = frame_set.answer(0);
        let alone = if first.is_some() {
            DeviceAnswer::Fresh
        } else {
            DeviceAnswer::Missing
        };
        self.device_answers.fill(alone);
        let op_expected = self.op_expected;
        let mut ambiguous = false;
        let mut all_right = true;
        for group in &mut self.group_results {
            let alive = group.wkc.1 > 0 || first.is_some();
            (group.answered, group.fresh, group.wkc.0) = (alive, alive, 0);
        }
        for datagram in &slots.process_data {
            let Some(group) = self.group_results.get_mut(datagram.group) else {
                continue;
            };
            let slot = datagram.slot;
            let answer = frame_set.answer(slot.frame);
            let wkc = answer.map_or(0, |answer| slot.wkc(answer));
            let right = answer.is_some()
                && (wkc == datagram.expected_wkc
                    || !op_expected && wkc == datagram.expected_wkc_before_op);
            let (begin, end) = datagram.devices;
            let device_answer = match answer {
                None => DeviceAnswer::Missing,
                Some(_) if right => DeviceAnswer::Fresh,
                Some(_) if end - begin > 1 => DeviceAnswer::Unknown,
                Some(_) => DeviceAnswer::Missing,
            };
            ambiguous |= device_answer == DeviceAnswer::Unknown;
            all_right &= right;
            let devices = self.order.get(begin..end).unwrap_or_default();
            for &device in devices.iter().filter(|_| !right) {
                if let Some(of) = self.device_answers.get_mut(device) {
                    *of = device_answer;
                }
                // A device that the frame did not reach leaves its place as it was sent.
                let (offset, len) = self.input_places.get(device).copied().unwrap_or_default();
                let from = offset.saturating_sub(datagram.image);
                if device_answer == DeviceAnswer::Unknown
                    && frame_set.differs(slot, from..from + len)
                    && let Some(delivery) = self.deliveries.get_mut(device)
                {
                    *delivery = Delivery::Now;
                }
            }
            group.answered &= answer.is_some();
            group.fresh &= right;
            group.wkc.0 = group.wkc.0.saturating_add(wkc);
            if let Some(data) = answer.and_then(|answer| answer.get(slot.data()))
                && right
                && datagram.access != Access::Outputs
            {
                self.inputs[datagram.image..datagram.image + data.len()].copy_from_slice(data);
            }
        }
        if (ambiguous && self.op_expected) || (self.separate_cycles > 0 && !all_right) {
            self.separate_cycles = SEPARATE_CYCLES;
        }
        let mut answer = CycleResult {
            complete: frame_set.complete(),
            inputs_fresh: self.group_results.iter().all(|group| group.fresh),
            wkc: self.group_results.iter().fold((0, 0), |sum, group| {
                let (seen, expected) = group.wkc;
                (sum.0.saturating_add(seen), sum.1.saturating_add(expected))
            }),
            system_time: None,
            offset_taken: false,
            al_status: None,
            sent_late: frame_set.sent_late.unwrap_or(0),
            sent_at: frame_set.sent_at,
        };
        let Some(first) = first else {
            return answer;
        };
        answer.offset_taken = slots.clock_offset.is_some_and(|slot| slot.wkc(first) > 0);
        answer.al_status = first
            .get(slots.al_status.data())
            .and_then(|data| Some((*data.first()?, slots.al_status.wkc(first))));
        if let Some(poll) = frame_set.poll {
            let slot = DatagramSlot {
                frame: 0,
                offset: slots.diagnostic_at,
                len: poll.len,
            };
            let data = first.get(slot.data()).unwrap_or_default();
            match poll.target {
                PollTarget::Registers { device, block } => {
                    if let Some(to) = self.diagnoses.get_mut(device) {
                        let answered = slot.wkc(first) == 1;
                        to.note_answer(block, answered);
                        if answered {
                            let first = !to.has_read(block);
                            to.take(block, data);
                            if let Some(window) = self.windows.get_mut(device) {
                                window.take(block, &to.errors, first);
                            }
                        }
                    }
                }
                PollTarget::Mailboxes { first } => {
                    let devices = self.schedule.mailbox_devices.iter().skip(first);
                    for (&device, &status) in devices.zip(data) {
                        self.bus_status
                            .store_mailbox_status(device, frame_set.sent_at, status);
                    }
                }
            }
        }
        let Some(clock) = slots.clock else {
            return answer;
        };
        let sent_at = frame_set.sent_at;
        answer.system_time = frame_set
            .changed(clock)
            .and_then(|time| self.reference.take(time, sent_at));
        if let Some(time) = answer.system_time {
            self.bus_status.set_clock(sent_at, time);
        } else {
            let (answers, diagnoses) = (&self.device_answers, &self.diagnoses);
            let window = self.clock_window_ns;
            self.reference.miss(|device| {
                answers.get(device) != Some(&DeviceAnswer::Missing)
                    && diagnoses
                        .get(device)
                        .is_some_and(|d| d.clock_within(window))
            });
        }
        answer
    }

    /// Returns the bytes of each staged frame without FCS.
    pub fn frame_lengths(&self) -> impl Iterator<Item = usize> + '_ {
        let staged = self.frame_sets.get(self.staged);
        staged
            .into_iter()
            .flat_map(|frame_set| frame_set.frames().iter().map(|frame| frame.bytes.len()))
    }
}

#[cfg(test)]
#[path = "exchange_tests.rs"]
mod tests;
