//! The frames of a cycle: FRMW of the system time, an LRW of each group's process data (LWR and LRD where a SubDevice
//! knows no LRW), one BRD of AL status and one read of the diagnostic slot; built once, refilled every cycle, sent back to back.
//!
//! Ours and ethercrab's frames are told apart by the last byte of the source MAC, because
//! ethercrab uses all 256 datagram indices. The byte before it numbers the frames of a cycle, and
//! the datagram index numbers the cycle, so that late and repeated frames are recognised.

use std::sync::Arc;

use super::image::{Access, ImagePlan};
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
use frame::{DATAGRAM_HEADER, Frame, MAC_TAIL, Place, WKC, clear_wkc, push, write_header};
pub use probe::{Diagnosis, ErrorCounters, Probe};
pub use rota::LONGEST_LOOK;
use rota::{Look, Rota};
pub use sights::Sights;

const FPRD: u8 = 4;
const BRD: u8 = 7;
const LRD: u8 = 10;
const LWR: u8 = 11;
const LRW: u8 = 12;
const FRMW: u8 = 14;

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
    clock: Option<Place>,
    /// Index of the reference clock among the members.
    reference: usize,
    /// What a clock is set to if the reference before it does not answer: its own time, nearly.
    expected_time: u64,
    cycle_ns: u64,
    process_data: Vec<ProcessDatagram>,
    al_status: Place,
    sights: Arc<Sights>,
    probe_at: usize,
    shares: Vec<Share>,
    diagnoses: Vec<Diagnosis>,
    rota: Rota,
    cycle: u8,
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
        let mut places = None;
        let flights = (0..mode.flights())
            .map(|_| {
                let mut flight = Flight::new(plan.frames());
                places = Some(Places::fill(&mut flight.frames, plan, clock));
                flight
            })
            .collect();
        let Some(places) = places else {
            unreachable!("there is a flight in every mode");
        };
        // The first group is there without members, too.
        let groups = plan.groups.iter().max().map_or(1, |last| last + 1);
        let mut shares = vec![Share::default(); groups];
        for (member, &group) in members.iter().zip(&plan.groups) {
            shares[group].clocks += u16::from(member.clock);
        }
        for datagram in &places.process_data {
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
            clock: places.clock,
            reference: reference.unwrap_or(0),
            expected_time: 0,
            cycle_ns: clock.map_or(0, |clock| clock.cycle_ns),
            process_data: places.process_data,
            al_status: places.al_status,
            sights: Arc::new(Sights::new(members.len())),
            probe_at: places.probe_at,
            shares,
            diagnoses: vec![Diagnosis::default(); members.len()],
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

    /// What the diagnostic slot has found, in the order of the members.
    #[must_use]
    pub fn diagnoses(&self) -> &[Diagnosis] {
        &self.diagnoses
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
        self.restage();
        let time = self.expected_time;
        let Some(flight) = self.flights.get_mut(self.staged) else {
            return;
        };
        let first = &mut flight.frames[0].bytes;
        flight.turn = self.rota.next();
        if let Some(turn) = flight.turn {
            // The last datagram of its frame, so its length may change; within the capacity of the frame.
            let data = self.probe_at + DATAGRAM_HEADER;
            first.truncate(data);
            first.resize(data + turn.len, Sights::UNSEEN);
            first.resize(data + turn.len + WKC, 0);
            write_header(first, self.probe_at, turn.command, turn.address, turn.len);
        }
        if let Some(place) = self.clock {
            first[place.data()].copy_from_slice(&time.to_le_bytes());
            clear_wkc(first, place);
        }
        first[self.al_status.data()].fill(0);
        clear_wkc(first, self.al_status);
        flight.stage(self.cycle);
        self.expected_time = time.wrapping_add(self.cycle_ns);
    }

    /// Outputs have changed since the frames were filled, and before they are sent. RT: O(image).
    pub fn restage(&mut self) {
        let Some(flight) = self.flights.get_mut(self.staged) else {
            return;
        };
        for datagram in &self.process_data {
            let place = datagram.place;
            let frame = &mut flight.frames[place.frame].bytes;
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
        let number = frame.get(10).map_or(usize::MAX, |n| usize::from(*n));
        let frames = self.flights.first().map_or(0, |f| f.frames.len());
        if number >= frames {
            return Received::Foreign;
        }
        let mut flights = self.flights.iter_mut();
        if flights.any(|flight| flight.receive(number, frame)) {
            Received::Current
        } else {
            Received::Late
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
        let first = flight.answer(0);
        for share in &mut self.shares {
            let alive = share.wkc.1 > 0 || first.is_some();
            (share.answered, share.fresh, share.wkc.0) = (alive, alive, 0);
        }
        for datagram in &self.process_data {
            let Some(share) = self.shares.get_mut(datagram.group) else {
                continue;
            };
            let place = datagram.place;
            let answer = flight.answer(place.frame);
            let wkc = answer.map_or(0, |answer| place.wkc(answer));
            let right = answer.is_some() && wkc == datagram.expected_wkc;
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
            .get(self.al_status.data())
            .and_then(|data| Some((*data.first()?, self.al_status.wkc(first))));
        if let Some(turn) = flight.turn {
            let place = Place {
                frame: 0,
                offset: self.probe_at,
                len: turn.len,
            };
            let data = first.get(place.data()).unwrap_or_default();
            match turn.look {
                Look::At { device, probe } => {
                    if let Some(to) = self.diagnoses.get_mut(device) {
                        to.answers = place.wkc(first) == 1;
                        if to.answers {
                            to.take(probe, data);
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
        answer.system_time = self.system_time(first);
        if let Some(time) = answer.system_time {
            self.sights.set_clock(flight.sent_at, time);
            // Of the flight that is staged next; those under way lie between.
            let ahead = self.cycle_ns.saturating_mul(self.flights.len() as u64);
            self.expected_time = time.wrapping_add(ahead);
        }
        answer
    }

    /// If the reference clock has given it: where clocks are missing, only those of groups that are, and it was seen lately.
    fn system_time(&self, first: &[u8]) -> Option<u64> {
        let place = self.clock?;
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
            .flat_map(|flight| flight.frames.iter().map(|frame| frame.bytes.len()))
    }
}

/// Where the datagrams of a cycle lie in its frames.
struct Places {
    clock: Option<Place>,
    process_data: Vec<ProcessDatagram>,
    al_status: Place,
    probe_at: usize,
}

impl Places {
    /// Puts all datagrams but the diagnostic one into empty frames.
    #[allow(clippy::disallowed_methods, reason = "prepares")]
    fn fill(frames: &mut [Frame], plan: &ImagePlan, clock: Option<&ClockPlan>) -> Self {
        let clock = clock.map(|clock| {
            let address = u32::from(SYSTEM_TIME) << 16 | u32::from(clock.reference);
            push(&mut frames[0], 0, FRMW, address, 8)
        });
        let process_data = plan.datagrams.iter().map(|datagram| {
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
