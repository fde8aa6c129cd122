//! Cable redundancy: two interfaces at both ends of a ring of SubDevices, as one [`Link`].
//!
//! Every frame leaves on both interfaces at the same time. SubDevices process a frame on its way
//! from port 0 to the others only:
//!
//! - in a closed ring all of them process the copy of the first interface, which arrives at the
//!   second one; the copy of the second interface passes them unprocessed, in the other direction;
//! - a broken ring is two lines. Each copy returns to its own interface, processed by its line.
//!
//! Each SubDevice therefore processes one copy. [`merge`] combines both to the answer of a line. The
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
/// A copy that has been missing so often in a row has no way back.
const MAX_MISSED: u32 = 8;

/// A frame that was sent, and what has come back of it.
#[derive(Debug)]
struct Slot {
    len: usize,
    sent: [u8; MAX_FRAME],
    /// The answer so far: the sent frame with the changes of each copy.
    answer: [u8; MAX_FRAME],
    sent_at: Nanos,
    /// The path of each copy that has arrived.
    copies: [Option<CopyPath>; 2],
    /// True once the answer with the work of all devices was delivered.
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
    /// The devices that have processed either copy of the last frame.
    all_devices: u16,
    status: &'static RingStatus,
    scratch: Box<[u8; MAX_FRAME]>,
    spare: Box<[u8; MAX_FRAME]>,
}

impl RedundantLink {
    /// Joins both ends of a ring. A copy that has not arrived `copy_timeout` after it was sent is not
    /// awaited any longer: less than the time that a cycle waits for its frames. Allocates; the status
    /// lives as long as the process.
    #[must_use]
    pub fn new(ends: Box<dyn RingEnds>, copy_timeout: Nanos) -> Self {
        let slot = || Slot {
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
            spare: Box::new([0; MAX_FRAME]),
        }
    }

    /// Takes what both interfaces have received. Returns the slot of an answer that is complete.
    fn collect(&mut self) -> Result<Option<usize>, LinkError> {
        let mut failures = 0;
        for at in End::BOTH {
            loop {
                let interface = at.swapped(self.status.swapped());
                match self.ends.recv(interface, &mut self.scratch) {
                    Ok(Some(len)) => {
                        let complete = self.take(at, len);
                        if complete.is_some() {
                            return Ok(complete);
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
    /// one that was delivered.
    fn take(&mut self, at: End, len: usize) -> Option<usize> {
        let copy = self.scratch.get_mut(..len)?;
        let from = match copy.get(MARK_AT)? & MARK {
            0 => End::First,
            _ => End::Second,
        };
        copy[MARK_AT] &= !MARK;
        let mut newest_first = (0..self.next)
            .rev()
            .take(SLOTS)
            .map(|number| number % SLOTS);
        let index = newest_first.find(|index| self.slots[*index].sent_as(copy))?;
        let slot = &mut self.slots[index];
        let own = &mut slot.copies[from as usize];
        if own.is_some() {
            return None;
        }
        let len = slot.len;
        let answer = match slot.complete {
            // A broken ring may have just been closed: the devices have processed both copies.
            true => &mut self.spare[..len],
            false => &mut slot.answer[..len],
        };
        let devices = merge(&slot.sent[..len], copy, answer);
        let returned = at == from;
        let path = CopyPath { returned, devices };
        *own = Some(path);
        self.missed[from as usize] = 0;
        if let Some(devices) = devices {
            self.status.set(from, Some((returned, devices)));
        }
        let both = slot.copies.iter().all(Option::is_some);
        if let [Some(first), Some(second)] = slot.copies.map(|copy| copy?.devices) {
            self.all_devices = first.wrapping_add(second);
            let crossed = slot.copies.iter().flatten().all(|copy| !copy.returned);
            if crossed && first == 0 && second > 0 {
                // All devices process the copy that enters at the first device.
                self.status.swap();
            }
        }
        // Without a broadcast, the last copy on the same path shows how many have processed it.
        let processed = devices.or_else(|| self.status.devices(from, returned));
        let all = processed.is_some_and(|count| count > 0 && count == self.all_devices);
        let before = slot.complete;
        slot.complete |= both || all;
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
                }
                if *count == MAX_MISSED {
                    self.status.set(from, None);
                    // All that still answer have processed the other copy.
                    let other = 1 - from as usize;
                    self.all_devices = slot.copies[other]
                        .and_then(|copy| copy.devices)
                        .unwrap_or(self.all_devices);
                }
            }
            if !slot.complete && slot.is_useful() {
                return Some(index);
            }
        }
        None
    }

    fn deliver(&self, index: usize, buf: &mut [u8; MAX_FRAME]) -> usize {
        let slot = &self.slots[index];
        buf[..slot.len].copy_from_slice(&slot.answer[..slot.len]);
        slot.len
    }
}

impl Slot {
    /// True if a frame is an answer to this one.
    fn sent_as(&self, frame: &[u8]) -> bool {
        const INDEX: usize = FRAME_HEADER + 1;
        self.len > INDEX
            && frame.len() >= self.len
            && frame[SOURCE_END] == self.sent[SOURCE_END]
            && frame[FRAME_HEADER - 2..FRAME_HEADER] == self.sent[FRAME_HEADER - 2..FRAME_HEADER]
            && frame[INDEX] == self.sent[INDEX]
    }

    /// True if one copy is an answer: some device has processed it. A frame outside the cycle is
    /// better lost than incomplete, because it is repeated.
    fn is_useful(&self) -> bool {
        let cyclic = self.sent[SOURCE_END.end - 1] == CYCLIC;
        let mut copies = self.copies.iter().flatten();
        cyclic && copies.any(|copy| copy.returned || copy.devices.is_some_and(|count| count > 0))
    }
}

impl Link for RedundantLink {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        let index = self.next % SLOTS;
        self.next += 1;
        self.oldest = self.oldest.max(self.next.saturating_sub(SLOTS));
        let before = self.status.before();
        let slot = &mut self.slots[index];
        let place = slot.sent.get_mut(..frame.len());
        let place = place.ok_or(LinkError::TooLong(frame.len()))?;
        place.copy_from_slice(frame);
        slot.answer[..frame.len()].copy_from_slice(frame);
        slot.len = frame.len();
        slot.sent_at = clock::now();
        slot.copies = [None; 2];
        slot.complete = false;
        let mut sent = Ok(());
        let mut failures = 0;
        for from in End::BOTH {
            let copy = &mut self.scratch[..frame.len()];
            copy.copy_from_slice(frame);
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

/// Prepares the copy of an interface; the first one's passes `before` devices. Positions count from the begin of each line, so a datagram to
/// a position is addressed in one copy only. ARMW then writes to one line only; nothing here uses it.
fn address(copy: &mut [u8], from: End, before: u16) {
    const NOP: u8 = 0;
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
        let broadcast = matches!(command, Command::BRD | Command::BWR | Command::BRW);
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
