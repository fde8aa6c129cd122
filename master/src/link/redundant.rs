//! Cable redundancy: two interfaces at both ends of a ring of SubDevices, as one [`Link`].
//!
//! Every frame leaves on both interfaces at the same time. SubDevices process a frame on its way
//! from port 0 to the others only:
//!
//! - in a closed ring all of them process the copy of the first interface, which arrives at the
//!   second one; the copy of the second interface passes them unprocessed, in the other direction;
//! - a broken ring is two lines. Each copy returns to its own interface, processed by its line.
//!
//! Each SubDevice therefore processes one copy. `merge` combines both to the answer of a line. The
//! rest of the program does not notice which of the two it was.

use ecaxis_ecat::datagram::{Command, HEADER, Header, WORKING_COUNTER};

use super::filter::LinkStats;
use super::joined_frame::FRAME_HEADER;
use super::{Link, LinkError, MAX_FRAME, Nanos};
use crate::clock;

mod status;

pub use status::{CopyPath, RingState, RingStatus};

/// The interface of the ring at which a frame leaves or arrives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum End {
    First,
    Second,
}

impl End {
    pub const BOTH: [Self; 2] = [Self::First, Self::Second];

    const fn swapped(self, swapped: bool) -> Self {
        match (self, swapped) {
            (Self::First, false) | (Self::Second, true) => Self::First,
            (Self::Second, false) | (Self::First, true) => Self::Second,
        }
    }
}

/// Both interfaces of a ring. RT: as [`Link`].
pub trait RingEnds: std::fmt::Debug + Send {
    /// Sends one whole Ethernet frame from an interface.
    ///
    /// # Errors
    /// As [`Link::send`].
    fn send(&mut self, from: End, frame: &[u8]) -> Result<(), LinkError>;

    /// Copies the next frame that an interface has received to the front of `buf`.
    ///
    /// # Errors
    /// As [`Link::recv`].
    fn recv(&mut self, at: End, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError>;

    /// As [`Link::next_arrival`].
    fn next_arrival(&self) -> Option<Nanos>;

    /// As [`Link::main_devices`].
    fn main_devices(&self) -> u64;

    /// As [`Link::stats`], the sum of both interfaces.
    fn stats(&mut self) -> LinkStats;

    /// As [`Link::take_sim_inputs`].
    fn take_sim_inputs(&mut self) -> Option<super::sim::SimInputSender> {
        None
    }
}

/// Two network interfaces.
#[derive(Debug)]
pub struct Interfaces(pub [Box<dyn Link>; 2]);

impl RingEnds for Interfaces {
    fn send(&mut self, from: End, frame: &[u8]) -> Result<(), LinkError> {
        self.0[from as usize].send(frame)
    }

    fn recv(&mut self, at: End, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        self.0[at as usize].recv(buf)
    }

    fn next_arrival(&self) -> Option<Nanos> {
        None
    }

    fn main_devices(&self) -> u64 {
        self.0.iter().map(|link| link.main_devices()).sum()
    }

    fn stats(&mut self) -> LinkStats {
        let [first, second] = &mut self.0;
        first.stats().plus(second.stats())
    }
}

/// The frames whose answers may still be under way: ethercrab's and those of some cycles.
const SLOTS: usize = 128;
/// The bytes of the source address that identify a frame, and the byte that marks the copy of the
/// second interface. The filter of an interface accepts both values.
const SOURCE_END: std::ops::Range<usize> = 10..12;
const MARK_AT: usize = 9;
pub(super) const MARK: u8 = 0x80;
/// The byte in which the first SubDevice marks a frame.
const PROCESSED_AT: usize = 6;
/// The last byte of the source address of the cycle's frames. All others are repeated if lost.
const CYCLIC: u8 = 0x20;
/// A copy that has been missing so often in a row has no way back. Fewer than the attempts of
/// `enumerate::count`.
const MAX_MISSED: u32 = 4;
/// A copy that arrives this time after sending, in ns, is dropped: ethercrab uses its indices again.
const MAX_AGE: Nanos = 20_000_000;
/// The frames taken in one call; other traffic must not hold the cycle.
const FRAMES_AT_ONCE: usize = 32;

/// A frame that was sent, and what has come back of it.
#[derive(Debug)]
struct Slot {
    /// The length of the frame that was given, and with a broadcast of our own ([`add_broadcast`]).
    given: usize,
    len: usize,
    sent: [u8; MAX_FRAME],
    /// The answer so far: the sent frame with the changes of each copy.
    answer: [u8; MAX_FRAME],
    sent_at: Nanos,
    /// The path of each copy that has arrived.
    copies: [Option<CopyPath>; 2],
    /// True once the answer was delivered that no later copy makes more complete.
    complete: bool,
}

/// A ring as one link. RT: as [`Link`].
#[derive(Debug)]
pub struct RedundantLink {
    ends: Box<dyn RingEnds>,
    slots: Box<[Slot]>,
    /// The number of the next frame, and of the oldest one that may be waiting. Their remainders are
    /// the slots.
    next: usize,
    oldest: usize,
    /// How long the second copy is awaited after sending.
    copy_timeout: Nanos,
    /// How often each copy has been missing in a row.
    missed: [u32; 2],
    /// How many devices have met the last frame of which both copies came back.
    all_devices: u16,
    status: &'static RingStatus,
    scratch: Box<[u8; MAX_FRAME]>,
}

impl RedundantLink {
    /// Joins both ends of a ring. A copy that has not arrived `copy_timeout` after it was sent is not
    /// awaited any longer: less than the time that a cycle waits for its frames. Allocates; the status
    /// lives as long as the process.
    #[must_use]
    pub fn new(ends: Box<dyn RingEnds>, copy_timeout: Nanos) -> Self {
        let slot = || Slot {
            given: 0,
            len: 0,
            sent: [0; MAX_FRAME],
            answer: [0; MAX_FRAME],
            sent_at: 0,
            copies: [None; 2],
            complete: true,
        };
        Self {
            ends,
            slots: std::iter::repeat_with(slot).take(SLOTS).collect(),
            next: 0,
            oldest: 0,
            copy_timeout,
            missed: [0; 2],
            all_devices: 0,
            status: Box::leak(Box::default()),
            scratch: Box::new([0; MAX_FRAME]),
        }
    }

    /// Takes what both interfaces have received. Returns the slot of an answer to deliver.
    fn collect(&mut self) -> Result<Option<usize>, LinkError> {
        let mut failures = 0;
        for at in End::BOTH {
            for _ in 0..FRAMES_AT_ONCE {
                let interface = at.swapped(self.status.swapped());
                match self.ends.recv(interface, &mut self.scratch) {
                    Ok(Some(len)) => {
                        let ready = self.take(at, len);
                        if ready.is_some() {
                            return Ok(ready);
                        }
                    }
                    Ok(None) => break,
                    // An interface that goes down reports it once; the other one carries on.
                    Err(error) => {
                        failures += 1;
                        if failures == End::BOTH.len() {
                            return Err(error);
                        }
                        break;
                    }
                }
            }
        }
        Ok(None)
    }

    /// Adds a copy to its answer. Returns its slot if the answer is complete, or more complete than
    /// one that was delivered late.
    fn take(&mut self, at: End, len: usize) -> Option<usize> {
        let now = clock::now();
        let copy = self.scratch.get_mut(..len)?;
        let from = match copy.get(MARK_AT)? & MARK {
            0 => End::First,
            _ => End::Second,
        };
        copy[MARK_AT] &= !MARK;
        let slots = &self.slots;
        let mut newest_first = (0..self.next).rev().take(SLOTS).map(|n| n % SLOTS);
        let index = newest_first.find(|index| slots[*index].sent_as(copy))?;
        let slot = &mut self.slots[index];
        let own = from as usize;
        if slot.copies[own].is_some() || now > slot.sent_at.saturating_add(MAX_AGE) {
            return None;
        }
        let len = slot.len;
        let returned = at == from;
        let other = slot.copies[1 - own];
        // A ring that closes under a frame: the copy that crosses has met all devices, and some of
        // them have processed the one that returns as well.
        let twice = match from {
            End::First => !returned && other.is_some_and(|other| other.returned),
            End::Second => returned && other.is_some_and(|other| !other.returned),
        };
        if twice && from == End::First {
            let (sent, answer) = (&slot.sent[..len], &mut slot.answer[..len]);
            answer.copy_from_slice(sent);
        }
        let devices = match twice && from == End::Second {
            true => None,
            false => merge(&slot.sent[..len], copy, &mut slot.answer[..len]),
        };
        slot.copies[own] = Some(CopyPath { returned, devices });
        self.missed[own] = 0;
        if let Some(devices) = devices {
            self.status.set(from, Some((returned, devices)));
        }
        let crossed = |copy: &Option<CopyPath>| copy.is_some_and(|copy| !copy.returned);
        if slot.copies.iter().all(crossed)
            && let [Some(0), Some(1..)] = slot.copies.map(|copy| copy?.devices)
        {
            // All devices process the copy that enters at the first device.
            self.status.swap();
        }
        if let [Some(first), Some(second)] = slot.copies.map(|copy| copy?.devices) {
            self.all_devices = first.saturating_add(second);
        }
        let both = other.is_some();
        // A copy that crosses without any device shows that the other one can cross as well.
        let idle = !returned && devices.is_none_or(|devices| devices == 0);
        let alone = self.missed[1 - own] >= MAX_MISSED && !idle;
        // In a closed ring, the copy of the second interface carries nothing.
        let whole = from == End::First && !returned && self.status.second_is_idle();
        let before = slot.complete;
        slot.complete |= both || alone || whole || twice;
        (slot.complete && !before).then_some(index)
    }

    /// Gives up waiting for copies that are late. Returns the slot of an answer with one copy.
    fn expire(&mut self, now: Nanos) -> Option<usize> {
        while self.oldest < self.next {
            let index = self.oldest % SLOTS;
            let slot = &mut self.slots[index];
            if now < slot.sent_at.saturating_add(self.copy_timeout) {
                return None;
            }
            self.oldest += 1;
            for (from, copy) in End::BOTH.into_iter().zip(slot.copies) {
                let count = &mut self.missed[from as usize];
                if copy.is_none() {
                    *count = count.saturating_add(1);
                    if *count >= MAX_MISSED {
                        self.status.set(from, None);
                    }
                }
            }
            if !slot.complete && slot.is_useful(self.all_devices) {
                return Some(index);
            }
        }
        None
    }

    fn deliver(&self, index: usize, buf: &mut [u8; MAX_FRAME]) -> usize {
        let slot = &self.slots[index];
        let frame = &mut buf[..slot.given];
        frame.copy_from_slice(&slot.answer[..slot.given]);
        if slot.len > slot.given {
            set_end(frame);
        }
        slot.given
    }
}

impl Slot {
    /// True if a frame is an answer to this one: the same datagrams, but for addresses that count
    /// devices, and for datagrams that were taken out.
    fn sent_as(&self, frame: &[u8]) -> bool {
        let same = |range: std::ops::Range<usize>| frame.get(range.clone()) == self.sent.get(range);
        if self.len <= FRAME_HEADER
            || frame.len() < self.len
            || !same(SOURCE_END)
            || !same(FRAME_HEADER - 2..FRAME_HEADER)
        {
            return false;
        }
        datagrams(&self.sent[..self.len]).all(|datagram| {
            let at = datagram.start;
            let command = datagram.header.command;
            let counts = command.is_positional();
            let taken_out = counts && frame[at] == NOP;
            let address = if counts { at + 4 } else { at + 2 };
            (frame[at] == command.0 || taken_out)
                && same(at + 1..at + 2)
                && same(address..at + 7)
                && (frame[at + 7] ^ self.sent[at + 7]) & 0x87 == 0
        })
    }

    /// True if one copy is worth an answer. The cycle takes what some device has processed. All other
    /// frames are repeated if they are lost, so each of their datagrams must have met its device.
    /// Broadcasts must meet `all` devices.
    fn is_useful(&self, all: u16) -> bool {
        let cyclic = self.sent[SOURCE_END.end - 1] == CYCLIC;
        let mut copies = self.copies.iter().flatten();
        if cyclic {
            let met = |copy: &CopyPath| copy.returned || copy.devices.is_some_and(|n| n > 0);
            return copies.any(met);
        }
        let answer = &self.answer[..self.given];
        let met = copies.find_map(|copy| copy.devices) == Some(all);
        datagrams(answer).all(|datagram| {
            let counter = &answer[datagram.data.end..datagram.data.end + WORKING_COUNTER];
            let broadcast = is_broadcast(datagram.header.command);
            counter != [0; WORKING_COUNTER] && (met || !broadcast)
        })
    }
}

impl Link for RedundantLink {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        if frame.len() > MAX_FRAME {
            return Err(LinkError::TooLong(frame.len()));
        }
        let index = self.next % SLOTS;
        self.next += 1;
        self.oldest = self.oldest.max(self.next.saturating_sub(SLOTS));
        let before = self.status.before();
        let slot = &mut self.slots[index];
        slot.sent[..frame.len()].copy_from_slice(frame);
        slot.given = frame.len();
        slot.len = add_broadcast(&mut slot.sent, frame.len());
        slot.answer[..slot.len].copy_from_slice(&slot.sent[..slot.len]);
        slot.sent_at = clock::now();
        slot.copies = [None; 2];
        slot.complete = false;
        let mut sent = Ok(());
        let mut failures = 0;
        for from in End::BOTH {
            let copy = &mut self.scratch[..slot.len];
            copy.copy_from_slice(&slot.sent[..slot.len]);
            address(copy, from, before);
            // An interface without a cable may refuse the frame; the other one carries on.
            let interface = from.swapped(self.status.swapped());
            if let Err(error) = self.ends.send(interface, copy) {
                failures += 1;
                sent = Err(error);
            }
        }
        match failures {
            2 => sent,
            _ => Ok(()),
        }
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        let ready = match self.collect()? {
            Some(index) => Some(index),
            None => self.expire(clock::now()),
        };
        Ok(ready.map(|index| self.deliver(index, buf)))
    }

    fn next_arrival(&self) -> Option<Nanos> {
        let waiting = (self.oldest..self.next).map(|number| &self.slots[number % SLOTS]);
        let waiting = waiting.filter(|slot| !slot.complete);
        let expiry = waiting.map(|slot| slot.sent_at.saturating_add(self.copy_timeout));
        expiry.chain(self.ends.next_arrival()).min()
    }

    fn main_devices(&self) -> u64 {
        self.ends.main_devices()
    }

    fn stats(&mut self) -> LinkStats {
        self.ends.stats()
    }

    fn ring(&self) -> Option<&'static RingStatus> {
        Some(self.status)
    }

    fn take_sim_inputs(&mut self) -> Option<super::sim::SimInputSender> {
        self.ends.take_sim_inputs()
    }
}

/// The command of a datagram that no device processes.
const NOP: u8 = 0;

const fn is_broadcast(command: Command) -> bool {
    matches!(command, Command::BRD | Command::BWR | Command::BRW)
}

/// A datagram in a frame.
struct Datagram {
    header: Header,
    start: usize,
    data: std::ops::Range<usize>,
}

/// Returns the datagrams of a frame, up to the first that exceeds it. RT.
fn datagrams(frame: &[u8]) -> impl Iterator<Item = Datagram> {
    let mut next = Some(FRAME_HEADER);
    std::iter::from_fn(move || {
        let start = next?;
        let header = Header::parse(frame.get(start..)?.first_chunk::<HEADER>()?);
        let data = start + HEADER..start + HEADER + usize::from(header.len);
        let end = data.end + WORKING_COUNTER;
        next = header.more.then_some(end);
        (end <= frame.len()).then_some(Datagram {
            header,
            start,
            data,
        })
    })
}

/// Adds a broadcast read to a frame that has none and has room: it shows how many devices a copy has
/// met. Returns the length of the frame.
fn add_broadcast(frame: &mut [u8; MAX_FRAME], len: usize) -> usize {
    const DATA: usize = 1;
    const ADDED: usize = HEADER + DATA + WORKING_COUNTER;
    let known = datagrams(&frame[..len]).any(|datagram| is_broadcast(datagram.header.command));
    let Some(last) = datagrams(&frame[..len]).last() else {
        return len;
    };
    // Padding, or a frame that is cut: its datagrams do not end where it ends.
    let whole = last.data.end + WORKING_COUNTER == len && !last.header.more;
    if known || !whole || len + ADDED > MAX_FRAME {
        return len;
    }
    let header = Header {
        command: Command::BRD,
        index: last.header.index,
        address: 0,
        len: DATA as u16,
        more: false,
    };
    frame[last.start + 7] |= 0x80;
    let added = &mut frame[len..len + ADDED];
    added.fill(0);
    added[..HEADER].copy_from_slice(&header.emit());
    set_length(&mut frame[..len + ADDED]);
    len + ADDED
}

/// Ends a frame with its last whole datagram.
fn set_end(frame: &mut [u8]) {
    if let Some(last) = datagrams(frame).last() {
        frame[last.start + 7] &= !0x80;
    }
    set_length(frame);
}

/// Writes the length of the datagrams to the EtherCAT header.
fn set_length(frame: &mut [u8]) {
    let [low, high] = ((frame.len() - FRAME_HEADER) as u16).to_le_bytes();
    frame[FRAME_HEADER - 2] = low;
    frame[FRAME_HEADER - 1] = frame[FRAME_HEADER - 1] & 0xf0 | high & 0x07;
}

/// Prepares the copy of an interface. That of the first interface passes `before` devices. Positions
/// count from the begin of each line, so a datagram to a position is addressed in one copy only. ARMW
/// then writes to one line only; nothing here uses it.
fn address(copy: &mut [u8], from: End, before: u16) {
    if from == End::Second {
        copy[MARK_AT] |= MARK;
    }
    let mut start = FRAME_HEADER;
    while let Some(head) = copy
        .get_mut(start..)
        .and_then(<[u8]>::first_chunk_mut::<HEADER>)
    {
        let header = Header::parse(head);
        if matches!(
            header.command,
            Command::APRD | Command::APWR | Command::APRW | Command::ARMW
        ) {
            let position = 0_u16.wrapping_sub(header.address as u16);
            match (from, position < before) {
                (End::First, true) => {}
                (End::Second, false) => {
                    let there = before.wrapping_sub(position).to_le_bytes();
                    head[2..4].copy_from_slice(&there);
                }
                _ => head[0] = NOP,
            }
        }
        if !header.more {
            return;
        }
        start += HEADER + usize::from(header.len) + WORKING_COUNTER;
    }
}

/// Adds the changes that SubDevices have made to a copy of a frame to the answer, which begins as
/// the sent frame. Returns how many have processed the copy, if a broadcast shows it. RT.
///
/// Each bit is changed in one copy only, by the device that it belongs to, so both changes are added
/// by exclusive or. Devices add their bits to a broadcast by or. Working counters and addresses are
/// sums.
fn merge(sent: &[u8], copy: &[u8], answer: &mut [u8]) -> Option<u16> {
    let mut devices = None;
    answer[PROCESSED_AT] |= copy[PROCESSED_AT] & 0x02;
    for datagram in datagrams(sent) {
        let command = datagram.header.command;
        let broadcast = is_broadcast(command);
        let word = |frame: &[u8], at: usize| u16::from_le_bytes([frame[at], frame[at + 1]]);
        let mut add = |at: usize, more: u16| {
            let sum = word(answer, at).wrapping_add(more);
            answer[at..at + 2].copy_from_slice(&sum.to_le_bytes());
        };
        // Devices increment the address of a broadcast. That of a position is not evaluated.
        if broadcast {
            let at = datagram.start + 2;
            let passed = word(copy, at).wrapping_sub(word(sent, at));
            devices = Some(passed);
            add(at, passed);
        }
        let counter = datagram.data.end;
        add(counter, word(copy, counter));
        // The event field.
        for at in datagram.start + 8..datagram.start + HEADER {
            answer[at] |= copy[at];
        }
        let changes = datagram.data.map(|at| (at, copy[at] ^ sent[at]));
        for (at, change) in changes {
            match broadcast {
                true => answer[at] |= copy[at],
                false => answer[at] ^= change,
            }
        }
    }
    devices
}

#[cfg(test)]
mod tests;
