//! Ethernet frames to fragments, and fragments to frames.

use alloc::vec::Vec;

use super::{EOE_HEADER, Fragment, UNIT};
use crate::mailbox::HEADER;

/// The length in bytes of the longest Ethernet frame without its check sequence: header, two VLAN
/// tags and 1500 bytes.
pub const MAX_FRAME: usize = 14 + 2 * 4 + 1500;
/// The length in bytes of the shortest Ethernet frame: a header.
pub const MIN_FRAME: usize = 14;

/// The fragments of one Ethernet frame. There are none if the frame is longer than [`MAX_FRAME`],
/// or if the mailbox cannot carry [`UNIT`] bytes.
#[derive(Debug, Clone)]
pub struct Fragments<'a> {
    frame: &'a [u8],
    frame_number: u8,
    /// The data bytes that fit into a mailbox.
    room: usize,
    offset: usize,
    number: u8,
}

impl<'a> Fragments<'a> {
    /// Returns the fragments of a frame with this number (modulo 16) for mailboxes of this size.
    #[must_use]
    pub fn new(frame: &'a [u8], frame_number: u8, mailbox: u16) -> Self {
        let room = usize::from(mailbox).saturating_sub(HEADER + EOE_HEADER);
        let fits = (MIN_FRAME..=MAX_FRAME).contains(&frame.len()) && room >= UNIT;
        Self {
            frame: if fits { frame } else { &[] },
            frame_number: frame_number & 0x0f,
            room,
            offset: 0,
            number: 0,
        }
    }
}

impl<'a> Iterator for Fragments<'a> {
    type Item = Fragment<'a>;

    fn next(&mut self) -> Option<Fragment<'a>> {
        let rest = self.frame.get(self.offset..)?;
        if rest.is_empty() {
            return None;
        }
        let (data, last) = match rest.split_at_checked(self.room) {
            Some((_, [_, ..])) => (rest.get(..self.room / UNIT * UNIT)?, false),
            _ => (rest, true),
        };
        let bytes = match self.number {
            0 => self.frame.len(),
            _ => self.offset,
        };
        let fragment = Fragment {
            frame: self.frame_number,
            number: self.number,
            units: u8::try_from(bytes.div_ceil(UNIT)).ok()?,
            last,
            time: None,
            time_requested: false,
            data,
        };
        self.offset += data.len();
        self.number += 1;
        Some(fragment)
    }
}

/// What a [`Reassembler`] has seen.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ReassemblyCounters {
    /// Complete frames.
    pub frames: u64,
    /// Frames dropped because a fragment is missing.
    pub gaps: u64,
    /// Fragments that came again; the frame continues.
    pub repeats: u64,
    /// Frames dropped because another frame began before their end.
    pub interrupted: u64,
    /// Fragments dropped, with their frame, because sizes or offsets contradict each other.
    pub malformed: u64,
}

impl ReassemblyCounters {
    /// Returns the number of frames and fragments that were dropped.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        [self.gaps, self.interrupted, self.malformed]
            .iter()
            .fold(0, |sum, count| sum.saturating_add(*count))
    }
}

/// A frame of which the first fragments have arrived.
#[derive(Debug, Clone, Copy)]
struct Assembly {
    frame: u8,
    /// The number of the next fragment.
    next: u8,
    /// The announced size in bytes, rounded up to units.
    size: usize,
}

/// Puts the fragments of one device together, one frame at a time. It keeps at most one frame of
/// [`MAX_FRAME`] bytes.
#[derive(Debug, Clone, Default)]
pub struct Reassembler {
    assembly: Option<Assembly>,
    buffer: Vec<u8>,
    counters: ReassemblyCounters,
}

/// Why a fragment does not continue the frame.
enum Flaw {
    Gap,
    Interrupted,
    Malformed,
}

impl Reassembler {
    /// Adds a fragment. Returns the frame if it is complete.
    pub fn add(&mut self, fragment: &Fragment<'_>) -> Option<&[u8]> {
        if let Some(assembly) = self.assembly
            && assembly.frame == fragment.frame
            && fragment.number < assembly.next
            && (fragment.number > 0 || self.begins_with(fragment))
        {
            self.counters.repeats += 1;
            return None;
        }
        match self.append(fragment) {
            Ok(true) => {
                self.assembly = None;
                self.counters.frames += 1;
                Some(&self.buffer)
            }
            Ok(false) => None,
            Err(flaw) => {
                self.assembly = None;
                match flaw {
                    Flaw::Gap => self.counters.gaps += 1,
                    Flaw::Interrupted => self.counters.interrupted += 1,
                    Flaw::Malformed => self.counters.malformed += 1,
                }
                None
            }
        }
    }

    /// Drops the frame in progress, for a device that has restarted.
    pub fn reset(&mut self) {
        if self.assembly.take().is_some() {
            self.counters.interrupted += 1;
        }
    }

    /// Returns what has been seen.
    #[must_use]
    pub fn counters(&self) -> ReassemblyCounters {
        self.counters
    }

    /// Returns true if the first fragment is the one with which the frame in progress began: frame
    /// numbers are the same every 16 frames.
    fn begins_with(&self, fragment: &Fragment<'_>) -> bool {
        self.buffer.starts_with(fragment.data)
    }

    /// Returns true if the frame is complete.
    fn append(&mut self, fragment: &Fragment<'_>) -> Result<bool, Flaw> {
        let bytes = usize::from(fragment.units) * UNIT;
        let assembly = match (fragment.number, self.assembly) {
            (0, before) => {
                if before.is_some() {
                    self.counters.interrupted += 1;
                }
                self.buffer.clear();
                if bytes > MAX_FRAME.next_multiple_of(UNIT) {
                    return Err(Flaw::Malformed);
                }
                Assembly {
                    frame: fragment.frame,
                    next: 0,
                    size: bytes,
                }
            }
            (_, None) => return Err(Flaw::Gap),
            (_, Some(before)) if before.frame != fragment.frame => return Err(Flaw::Interrupted),
            (number, Some(before)) if number != before.next => return Err(Flaw::Gap),
            (_, Some(_)) if bytes != self.buffer.len() => return Err(Flaw::Malformed),
            (_, Some(before)) => before,
        };
        let whole = !fragment.data.is_empty() && fragment.data.len().is_multiple_of(UNIT);
        let length = self.buffer.len() + fragment.data.len();
        if length > assembly.size.min(MAX_FRAME) || !fragment.last && !whole {
            return Err(Flaw::Malformed);
        }
        if fragment.last && length < MIN_FRAME {
            return Err(Flaw::Malformed);
        }
        self.buffer.extend_from_slice(fragment.data);
        self.assembly = Some(Assembly {
            next: assembly.next.saturating_add(1),
            ..assembly
        });
        Ok(fragment.last)
    }
}
