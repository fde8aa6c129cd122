//! The frames of a cycle: FRMW of the system time, an LRW of each group's process data (LWR and LRD where a SubDevice
//! knows no LRW), one BRD of AL status and one read of the diagnostic slot; built once, refilled every cycle, sent back to back.
//!
//! Ours and ethercrab's frames are told apart by the last byte of the source MAC, because
//! ethercrab uses all 256 datagram indices. The byte before it numbers the frames of a cycle; what it has left and the
//! datagram index number the cycle, so that late and repeated frames are recognised.
//!
//! Devices share datagrams and so working counters. After a wrong counter each device gets a datagram of its own, so that
//! a device that is missing leaves the evidence of the others alone.

use std::sync::Arc;

use super::image::plan::frames as frames_of;
use super::image::{Access, DatagramPlan, ImagePlan};
use super::phase::ClockPlan;
use crate::clock::Nanos;
use crate::link::port::ETHERCAT;
use crate::link::{Link, LinkError, MAX_FRAME};

mod flight;
mod frame;
mod probe;
mod rota;
mod sights;

use flight::Flight;
use frame::{
    DATAGRAM_HEADER, FIRST_DATAGRAM, Frame, MAC_TAIL, Place, WKC, clear_wkc, frame_number,
    frame_tag, new_frames, push, same_datagram, write_header,
};
pub use probe::{Diagnosis, ErrorCounters, Probe, Window};
pub use rota::LONGEST_LOOK;
use rota::{Look, Rota};
pub use sights::Sights;

const FPRD: u8 = 4;
const BRD: u8 = 7;
const LRD: u8 = 10;
const LWR: u8 = 11;
const LRW: u8 = 12;
const FRMW: u8 = 14;

/// After a wrong working counter each device has a datagram of its own until so many cycles in a row were right.
const SEPARATE_CYCLES: u16 = 100;

const SYSTEM_TIME: u16 = 0x0910;
const AL_STATUS: u16 = 0x0130;

#[derive(Debug, Clone, Copy)]
struct ProcessDatagram {
    place: Place,
    access: Access,
    group: usize,
    /// Offset in the image.
    image: usize,
    expected_wkc: u16,
    /// Its devices: the first and one behind the last in [`Exchange::order`].
    devices: (usize, usize),
}

/// A SubDevice as the exchange sees it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Member {
    pub station: u16,
    /// It takes the system time.
    pub clock: bool,
    /// The SyncManager through which its mailbox is read; `None` where it has none.
    pub mailbox: Option<u8>,
}

/// What came back of one group's process data in a cycle.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Share {
    /// Every frame with a part of it came back; for a group without process data, the first.
    pub answered: bool,
    /// And every working counter was as expected: its part of the input image is this cycle's.
    pub fresh: bool,
    /// Sum of the working counters seen, of those expected.
    pub wkc: (u16, u16),
    /// SubDevices that take the system time.
    clocks: u16,
}

#[cfg(test)]
impl Share {
    pub(super) const fn new(answered: bool, fresh: bool, wkc: (u16, u16)) -> Self {
        Self {
            answered,
            fresh,
            wkc,
            clocks: 0,
        }
    }
}

/// What a cycle's answers say of one device.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Evidence {
    /// Its own working counter, or one that it shares, was right: it took its outputs, and its inputs are this cycle's.
    Fresh,
    /// A working counter that it shares with others was wrong.
    #[default]
    Unknown,
    /// Its own working counter was wrong, or no answer came.
    Missing,
}

/// What a received frame turned out to be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Received {
    /// One of this cycle's frames.
    Current,
    /// One of ours, but of another cycle or a second time.
    Late,
    /// Not ours.
    Foreign,
}

/// The result of a cycle's exchange.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Answer {
    /// Every frame came back.
    pub complete: bool,
    /// Every working counter was as expected; the whole input image is this cycle's.
    pub inputs_fresh: bool,
    /// Sum of the working counters seen, of those expected.
    pub wkc: (u16, u16),
    /// System time of the reference clock as the frame passed it.
    pub system_time: Option<u64>,
    /// AL status of all SubDevices or-ed together, and how many answered.
    pub al_status: Option<(u8, u16)>,
    /// How long after their planned release these frames were sent.
    pub sent_late: Nanos,
}

/// When answers are taken.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Mode {
    /// In the cycle that asks; the thread waits for them.
    #[default]
    SameCycle,
    /// In the next; they have long arrived, and nobody waits.
    Pipelined,
}

impl Mode {
    /// Cycles whose frames are under way at once.
    #[must_use]
    pub const fn flights(self) -> u8 {
        match self {
            Self::SameCycle => 1,
            Self::Pipelined => 2,
        }
    }
}

/// The exchange of process data.
#[derive(Debug)]
pub struct Exchange {
    /// The one that is staged or was sent in this cycle, and those sent before.
    flights: Vec<Flight>,
    staged: usize,
    /// Where the datagrams lie: with shared ones, and with one for each device.
    forms: Vec<Places>,
    /// The form of each of the last cycles, by the low byte of its number.
    form_of: [u8; 256],
    /// Cycles for which each device still has a datagram of its own.
    separate_cycles: u16,
    /// Devices are in Op: a wrong counter says that one is missing.
    op_expected: bool,
    /// Devices as the image lies.
    order: Vec<usize>,
    evidence: Vec<Evidence>,
    /// Devices for which a late answer has come since the last cycle.
    late: Vec<bool>,
    /// Index of the reference clock among the members.
    reference: usize,
    /// What a clock is set to if the reference before it does not answer: its own time, nearly.
    expected_time: u64,
    cycle_ns: u64,
    sights: Arc<Sights>,
    shares: Vec<Share>,
    diagnoses: Vec<Diagnosis>,
    windows: Vec<Window>,
    /// Of each member.
    groups: Vec<usize>,
    rota: Rota,
    cycle: u32,
    outputs: Vec<u8>,
    inputs: Vec<u8>,
}

impl Exchange {
    /// Builds the frames. `members` are the plan's devices, in the same order; they are reported in it.
    #[must_use]
    #[allow(
        clippy::disallowed_methods,
        clippy::disallowed_macros,
        reason = "prepares"
    )]
    pub fn new(
        plan: &ImagePlan,
        clock: Option<&ClockPlan>,
        members: &[Member],
        mode: Mode,
    ) -> Self {
        let mut order: Vec<usize> = (0..plan.regions.len()).collect();
        order.retain(|&device| plan.regions[device].is_some());
        order.sort_by_key(|&device| plan.regions[device].map_or(0, |region| region.offset));
        let mut datagrams = vec![&plan.datagrams];
        if plan.separate.len() > plan.datagrams.len() {
            datagrams.push(&plan.separate);
        }
        let mut forms = Vec::new();
        let mut flights = Vec::new();
        for flight in 0..mode.flights() {
            let mut frames = Vec::new();
            for datagrams in &datagrams {
                let mut form = new_frames(frames_of(datagrams));
                let places = Places::fill(&mut form, plan, datagrams, &order, clock);
                frames.push(form);
                if flight == 0 {
                    forms.push(places);
                }
            }
            flights.push(Flight::new(frames));
        }
        // The first group is there without members, too.
        let groups = plan.groups.iter().max().map_or(1, |last| last + 1);
        let mut shares = vec![Share::default(); groups];
        for (member, &group) in members.iter().zip(&plan.groups) {
            shares[group].clocks += u16::from(member.clock);
        }
        for datagram in &forms[0].process_data {
            shares[datagram.group].wkc.1 += datagram.expected_wkc;
        }
        let reference = clock.and_then(|clock| {
            members
                .iter()
                .position(|member| member.station == clock.reference)
        });
        let mut exchange = Self {
            flights,
            staged: 0,
            forms,
            form_of: [0; 256],
            separate_cycles: 0,
            op_expected: false,
            order,
            evidence: vec![Evidence::Unknown; members.len()],
            late: vec![false; members.len()],
            reference: reference.unwrap_or(0),
            expected_time: 0,
            cycle_ns: clock.map_or(0, |clock| clock.cycle_ns),
            sights: Arc::new(Sights::new(members.len())),
            shares,
            diagnoses: vec![Diagnosis::default(); members.len()],
            windows: vec![Window::default(); members.len()],
            groups: plan.groups.clone(),
            rota: Rota::new(members, plan.mailboxes.as_ref()),
            cycle: 0,
            outputs: vec![0; plan.len],
            inputs: vec![0; plan.len],
        };
        exchange.stage();
        exchange
    }

    /// When answers are taken.
    #[must_use]
    pub fn mode(&self) -> Mode {
        if self.flights.len() == 1 {
            Mode::SameCycle
        } else {
            Mode::Pipelined
        }
    }

    /// Outputs of the next cycle.
    pub fn outputs_mut(&mut self) -> &mut [u8] {
        &mut self.outputs
    }

    /// Inputs of the last cycle whose working counters were right.
    #[must_use]
    pub fn inputs(&self) -> &[u8] {
        &self.inputs
    }

    /// What came back of each group's process data, as of the last [`Exchange::answer`].
    #[must_use]
    pub fn shares(&self) -> &[Share] {
        &self.shares
    }

    /// What this cycle's answers say of each device, as of the last [`Exchange::answer`]; in the order of the members.
    #[must_use]
    pub fn evidence(&self) -> &[Evidence] {
        &self.evidence
    }

    /// Whether an answer to an earlier cycle's frame has come late since the last cycle, in which this device took part.
    #[must_use]
    pub fn came_late(&self, device: usize) -> bool {
        self.late.get(device).copied().unwrap_or(false)
    }

    /// On their way to Op and back, devices answer one after the other, and share their datagrams. Those
    /// that have datagrams of their own keep them until all answer.
    pub fn expect_op(&mut self, expected: bool) {
        self.op_expected = expected;
    }

    /// What the diagnostic slot has found, in the order of the members.
    #[must_use]
    pub fn diagnoses(&self) -> &[Diagnosis] {
        &self.diagnoses
    }

    /// What the error counters were around the stop, in the order of the members.
    #[must_use]
    pub fn windows(&self) -> &[Window] {
        &self.windows
    }

    /// A window of what the error counters grow by begins. RT: O(members).
    pub fn begin_windows(&mut self) {
        for (window, found) in self.windows.iter_mut().zip(&self.diagnoses) {
            window.begin(&found.errors);
        }
    }

    /// The windows of a group stand still at its stop and end with the next read; `None`: all groups. RT: O(members).
    pub fn stop_windows(&mut self, group: Option<usize>) {
        for (window, own) in self.windows.iter_mut().zip(&self.groups) {
            if group.is_none_or(|group| group == *own) {
                window.stop();
            }
        }
    }

    /// A group has been reset. RT: O(members).
    pub fn release_windows(&mut self, group: usize) {
        let members = self.windows.iter_mut().zip(&self.diagnoses);
        for ((window, found), own) in members.zip(&self.groups) {
            if group == *own {
                window.release(&found.errors);
            }
        }
    }

    /// What the cycle sees of mailboxes and of time, for everybody beside it.
    #[must_use]
    pub fn sights(&self) -> Arc<Sights> {
        Arc::clone(&self.sights)
    }

    /// Whose clock difference the answers of this cycle have brought.
    #[must_use]
    pub fn clock_read(&self) -> Option<(usize, i32)> {
        let flight = self.flights.get(self.due())?;
        let Look::At { device, probe } = flight.turn?.look else {
            return None;
        };
        flight.answer(0)?;
        let found = self.diagnoses.get(device)?;
        let read = probe == Probe::ClockDifference && found.answers;
        read.then_some((device, found.clock_difference))
    }

    /// The flight whose answers this cycle takes: the oldest.
    fn due(&self) -> usize {
        (self.staged + 1) % self.flights.len()
    }

    /// Fills the frames of the next cycle. RT: O(image).
    pub fn stage(&mut self) {
        self.cycle = self.cycle.wrapping_add(1);
        self.staged = self.due();
        self.late.fill(false);
        let separate = self.separate_cycles > 0 && self.forms.len() > 1;
        self.separate_cycles = self.separate_cycles.saturating_sub(1);
        let form = usize::from(separate);
        self.form_of[(self.cycle & 0xff) as usize] = u8::from(separate);
        if let Some(flight) = self.flights.get_mut(self.staged) {
            flight.form = form;
        }
        self.restage();
        let time = self.expected_time;
        let (Some(flight), Some(places)) =
            (self.flights.get_mut(self.staged), self.forms.get(form))
        else {
            return;
        };
        let first = &mut flight.frames_mut()[0].bytes;
        let turn = self.rota.next();
        if let Some(turn) = turn {
            // The last datagram of its frame, so its length may change; within the capacity of the frame.
            let data = places.probe_at + DATAGRAM_HEADER;
            first.truncate(data);
            first.resize(data + turn.len, Sights::UNSEEN);
            first.resize(data + turn.len + WKC, 0);
            write_header(first, places.probe_at, turn.command, turn.address, turn.len);
        }
        if let Some(place) = places.clock {
            first[place.data()].copy_from_slice(&time.to_le_bytes());
            clear_wkc(first, place);
        }
        first[places.al_status.data()].fill(0);
        clear_wkc(first, places.al_status);
        flight.turn = turn;
        flight.stage(self.cycle);
        self.expected_time = time.wrapping_add(self.cycle_ns);
    }

    /// Outputs have changed since the frames were filled, and before they are sent. RT: O(image).
    pub fn restage(&mut self) {
        let Some(flight) = self.flights.get_mut(self.staged) else {
            return;
        };
        let Some(places) = self.forms.get(flight.form) else {
            return;
        };
        for datagram in &places.process_data {
            let place = datagram.place;
            let frame = &mut flight.frames_mut()[place.frame].bytes;
            if datagram.access != Access::Inputs {
                let from = datagram.image..datagram.image + place.len;
                frame[place.data()].copy_from_slice(&self.outputs[from]);
            }
            clear_wkc(frame, place);
        }
    }

    /// Sends all frames of the cycle back to back, `late` after their planned release. RT: blocks on the wire only.
    pub fn send(&mut self, link: &mut dyn Link, late: Nanos) -> Result<(), LinkError> {
        match self.flights.get_mut(self.staged) {
            Some(flight) => flight.send(link, late),
            None => Ok(()),
        }
    }

    /// Keeps an answer until its flight is due. RT: O(frame).
    pub fn receive(&mut self, frame: &[u8]) -> Received {
        if frame.get(12..14) != Some(&ETHERCAT[..]) || frame.get(11) != Some(&MAC_TAIL) {
            return Received::Foreign;
        }
        let mut flights = self.flights.iter_mut();
        if flights.any(|flight| flight.receive(frame)) {
            Received::Current
        } else {
            self.receive_late(frame);
            Received::Late
        }
    }

    /// A frame of an earlier cycle that reached its devices all the same. RT: O(devices).
    fn receive_late(&mut self, frame: &[u8]) {
        let (Some(&low), Some(&tag)) = (frame.get(FIRST_DATAGRAM + 1), frame.get(10)) else {
            return;
        };
        let form = usize::from(self.form_of[usize::from(low)]);
        let (Some(places), Some(flight)) = (self.forms.get(form), self.flights.first()) else {
            return;
        };
        let age = self.cycle.wrapping_sub(u32::from(low)) & 0xff;
        let sent = flight.form_frames(form);
        let number = frame_number(tag, sent.len());
        let same_tag = tag == frame_tag(number, sent.len(), self.cycle.wrapping_sub(age));
        let recent = age > 0 && age <= self.flights.len() as u32 + 1;
        let Some(sent) = sent.get(number).filter(|_| recent && same_tag) else {
            return;
        };
        // The diagnostic datagram may have another length; those before it have not.
        let known = if number == 0 {
            places.probe_at
        } else {
            sent.bytes.len()
        };
        if frame.len() < known {
            return;
        }
        for datagram in &places.process_data {
            let place = datagram.place;
            if place.frame == number
                && same_datagram(&sent.bytes, frame, place)
                && place.wkc(frame) == datagram.expected_wkc
            {
                let (first, end) = datagram.devices;
                for &device in self.order.get(first..end).unwrap_or_default() {
                    if let Some(late) = self.late.get_mut(device) {
                        *late = true;
                    }
                }
            }
        }
    }

    /// Whether every frame that this cycle judges has come back.
    #[must_use]
    pub fn complete(&self) -> bool {
        self.flights.get(self.due()).is_some_and(Flight::complete)
    }

    /// Judges the answers that are due, for all groups and for each, and takes their inputs. RT: O(image).
    pub fn answer(&mut self) -> Answer {
        let due = self.due();
        let Some(flight) = self.flights.get(due) else {
            return Answer::default();
        };
        let Some(places) = self.forms.get(flight.form) else {
            return Answer::default();
        };
        let first = flight.answer(0);
        let alone = if first.is_some() {
            Evidence::Fresh
        } else {
            Evidence::Missing
        };
        self.evidence.fill(alone);
        let mut ambiguous = false;
        let mut all_right = true;
        for share in &mut self.shares {
            let alive = share.wkc.1 > 0 || first.is_some();
            (share.answered, share.fresh, share.wkc.0) = (alive, alive, 0);
        }
        for datagram in &places.process_data {
            let Some(share) = self.shares.get_mut(datagram.group) else {
                continue;
            };
            let place = datagram.place;
            let answer = flight.answer(place.frame);
            let wkc = answer.map_or(0, |answer| place.wkc(answer));
            let right = answer.is_some() && wkc == datagram.expected_wkc;
            let (begin, end) = datagram.devices;
            let evidence = match answer {
                None => Evidence::Missing,
                Some(_) if right => Evidence::Fresh,
                Some(_) if end - begin > 1 => Evidence::Unknown,
                Some(_) => Evidence::Missing,
            };
            ambiguous |= evidence == Evidence::Unknown;
            all_right &= right;
            for &device in self.order.get(begin..end).unwrap_or_default() {
                if let Some(of) = self.evidence.get_mut(device)
                    && evidence != Evidence::Fresh
                {
                    *of = evidence;
                }
            }
            share.answered &= answer.is_some();
            share.fresh &= right;
            share.wkc.0 = share.wkc.0.saturating_add(wkc);
            if let Some(data) = answer.and_then(|answer| answer.get(place.data()))
                && right
                && datagram.access != Access::Outputs
            {
                self.inputs[datagram.image..datagram.image + data.len()].copy_from_slice(data);
            }
        }
        if (ambiguous && self.op_expected) || (self.separate_cycles > 0 && !all_right) {
            self.separate_cycles = SEPARATE_CYCLES;
        }
        let mut answer = Answer {
            complete: flight.complete(),
            inputs_fresh: self.shares.iter().all(|share| share.fresh),
            wkc: self.shares.iter().fold((0, 0), |sum, share| {
                let (seen, expected) = share.wkc;
                (sum.0.saturating_add(seen), sum.1.saturating_add(expected))
            }),
            system_time: None,
            al_status: None,
            sent_late: flight.sent_late.unwrap_or(0),
        };
        let Some(first) = first else {
            return answer;
        };
        answer.al_status = first
            .get(places.al_status.data())
            .and_then(|data| Some((*data.first()?, places.al_status.wkc(first))));
        if let Some(turn) = flight.turn {
            let place = Place {
                frame: 0,
                offset: places.probe_at,
                len: turn.len,
            };
            let data = first.get(place.data()).unwrap_or_default();
            match turn.look {
                Look::At { device, probe } => {
                    if let Some(to) = self.diagnoses.get_mut(device) {
                        to.answers = place.wkc(first) == 1;
                        if to.answers {
                            let first = !to.has_read(probe);
                            to.take(probe, data);
                            if let Some(window) = self.windows.get_mut(device) {
                                window.take(probe, &to.errors, first);
                            }
                        }
                    }
                }
                Look::Mailboxes { first } => {
                    let devices = self.rota.mailbox_devices.iter().skip(first);
                    for (&device, &status) in devices.zip(data) {
                        self.sights.see(device, flight.sent_at, status);
                    }
                }
            }
        }
        answer.system_time = self.system_time(first, places.clock);
        if let Some(time) = answer.system_time {
            self.sights.set_clock(flight.sent_at, time);
            // Of the flight that is staged next; those under way lie between.
            let ahead = self.cycle_ns.saturating_mul(self.flights.len() as u64);
            self.expected_time = time.wrapping_add(ahead);
        }
        answer
    }

    /// If the reference clock has given it: where clocks are missing, only those of groups that are, and it was seen lately.
    fn system_time(&self, first: &[u8], place: Option<Place>) -> Option<u64> {
        let place = place?;
        let time = u64::from_le_bytes(first.get(place.data())?.try_into().ok()?);
        let wkc = place.wkc(first);
        let clocks = |shares: &mut dyn Iterator<Item = &Share>| -> u16 {
            shares
                .map(|share| share.clocks)
                .fold(0, u16::saturating_add)
        };
        let seen = self.diagnoses.get(self.reference);
        let all = wkc == clocks(&mut self.shares.iter());
        let others = seen.is_some_and(|seen| seen.answers)
            && wkc >= clocks(&mut self.shares.iter().filter(|share| share.fresh));
        (all || others).then_some(time)
    }

    /// Bytes of each frame as staged, without FCS.
    pub fn frame_lengths(&self) -> impl Iterator<Item = usize> + '_ {
        let staged = self.flights.get(self.staged);
        staged
            .into_iter()
            .flat_map(|flight| flight.frames().iter().map(|frame| frame.bytes.len()))
    }
}

/// Where the datagrams of a cycle lie in its frames.
#[derive(Debug)]
struct Places {
    clock: Option<Place>,
    process_data: Vec<ProcessDatagram>,
    al_status: Place,
    probe_at: usize,
}

impl Places {
    /// Puts all datagrams but the diagnostic one into empty frames.
    #[allow(clippy::disallowed_methods, reason = "prepares")]
    fn fill(
        frames: &mut [Frame],
        plan: &ImagePlan,
        datagrams: &[DatagramPlan],
        order: &[usize],
        clock: Option<&ClockPlan>,
    ) -> Self {
        let clock = clock.map(|clock| {
            let address = u32::from(SYSTEM_TIME) << 16 | u32::from(clock.reference);
            push(&mut frames[0], 0, FRMW, address, 8)
        });
        let offset = |device: &usize| plan.regions[*device].map_or(0, |region| region.offset);
        let process_data = datagrams.iter().map(|datagram| {
            let first = order.partition_point(|device| offset(device) < datagram.offset);
            let behind = datagram.offset + datagram.len;
            let end = order.partition_point(|device| offset(device) < behind);
            let frame = datagram.frame;
            let command = match datagram.access {
                Access::Both => LRW,
                Access::Inputs => LRD,
                Access::Outputs => LWR,
            };
            let (logical, len) = (datagram.logical, datagram.len);
            ProcessDatagram {
                place: push(&mut frames[frame], frame, command, logical, len),
                access: datagram.access,
                group: datagram.group,
                image: datagram.offset,
                expected_wkc: datagram.expected_wkc,
                devices: (first, end),
            }
        });
        let process_data = process_data.collect();
        let al_status = push(&mut frames[0], 0, BRD, u32::from(AL_STATUS) << 16, 2);
        let probe_at = frames[0].bytes.len();
        debug_assert!(probe_at + LONGEST_LOOK <= MAX_FRAME);
        Self {
            clock,
            process_data,
            al_status,
            probe_at,
        }
    }
}

#[cfg(test)]
#[path = "exchange_tests.rs"]
mod tests;
