//! Matches answers with requests. A recording may contain both or one of them, or begin in between.

use std::collections::{HashMap, HashSet, VecDeque};
use std::hash::{DefaultHasher, Hash, Hasher};

use ecaxis_ecat::datagram::Command;
use ecaxis_master::recording::Direction;
use ecaxis_master::recording::frame::Frame;

/// The maximum round-trip time in ns; later requests count as unanswered.
pub const TIMEOUT_NS: u64 = 250_000_000;
/// The maximum number of pending requests.
const UNDER_WAY: usize = 2048;
/// The number of frames read before the first is classified, so that both directions were seen.
const LOOK_AHEAD: usize = 64;
/// The maximum number of MainDevices in a recording.
const SOURCES: usize = 256;

/// A frame as sent and as received.
#[derive(Debug)]
pub struct FrameExchange {
    pub sent: Option<Frame>,
    pub back: Option<Frame>,
    /// True if the recording ends before the answer could arrive.
    pub open: bool,
}

/// One datagram of a [`FrameExchange`].
#[derive(Debug, Clone, Copy)]
pub struct DatagramExchange<'a> {
    pub command: Command,
    /// The transmitted address if known; SubDevices increment positions.
    pub address: u32,
    /// The transmission time in ns since 1970; the reception time if only that is known.
    pub at: u64,
    pub back_at: Option<u64>,
    pub sent: Option<&'a [u8]>,
    pub back: Option<&'a [u8]>,
    /// `None`: no answer.
    pub wkc: Option<u16>,
}

impl<'a> DatagramExchange<'a> {
    /// Returns the data written by write commands. SubDevices forward them unchanged unless the
    /// command also reads.
    pub fn written(&self) -> Option<&'a [u8]> {
        self.sent.or(self.back)
    }

    pub fn adp(&self) -> u16 {
        (self.address & 0xffff) as u16
    }

    pub fn ado(&self) -> u16 {
        (self.address >> 16) as u16
    }
}

/// Returns data and working counter of a datagram.
fn nth(frame: &Frame, n: usize) -> Option<(&[u8], u16)> {
    let datagram = frame.datagrams.get(n)?;
    Some((frame.data(datagram), datagram.wkc))
}

impl FrameExchange {
    /// Returns the transmission time, or the reception time if only that is known.
    pub fn at(&self) -> u64 {
        let frame = self.sent.as_ref().or(self.back.as_ref());
        frame.map_or(0, |frame| frame.at)
    }

    pub fn datagrams(&self) -> impl Iterator<Item = DatagramExchange<'_>> {
        let one = self.sent.as_ref().or(self.back.as_ref());
        let count = one.map_or(0, |frame| frame.datagrams.len());
        (0..count).filter_map(move |n| {
            let sent = self.sent.as_ref().and_then(|frame| nth(frame, n));
            let back = self.back.as_ref().and_then(|frame| nth(frame, n));
            let head = one?.datagrams.get(n)?;
            Some(DatagramExchange {
                command: head.command,
                address: head.address,
                at: self.at(),
                back_at: self.back.as_ref().map(|frame| frame.at),
                sent: sent.map(|(data, _)| data),
                back: back.map(|(data, _)| data),
                wkc: back.map(|(_, wkc)| wkc),
            })
        })
    }
}

/// Matches frames. Exchanges are returned in transmission order: an unanswered one delays the later
/// ones.
#[derive(Debug, Default)]
pub struct Pairing {
    ahead: VecDeque<Frame>,
    /// Source addresses without the bit that SubDevices set.
    senders: HashSet<[u8; 6]>,
    /// Counts of addresses with that bit: answers without a request, and with one.
    answers: HashMap<[u8; 6], (u64, u64)>,
    under_way: VecDeque<Waiting>,
    latest: u64,
    longest_round_trip: u64,
    answered: bool,
    done: VecDeque<FrameExchange>,
}

#[derive(Debug)]
struct Waiting {
    key: u64,
    sent: Option<Frame>,
    back: Option<Frame>,
}

/// The number of answers without a request after which the recording counts as answers only.
const ONE_SIDED: u64 = 4;

/// Bit 1 of the first byte is set by the first SubDevice that a frame passes.
const PASSED: u8 = 0x02;

fn sender(source: [u8; 6]) -> [u8; 6] {
    let [first, rest @ ..] = source;
    let [a, b, c, d, e] = rest;
    [first & !PASSED, a, b, c, d, e]
}

/// Returns a hash of the parts that request and answer share.
fn key(frame: &Frame) -> u64 {
    let mut hasher = DefaultHasher::new();
    for datagram in &frame.datagrams {
        let address = if datagram.command.is_positional() {
            datagram.address & 0xffff_0000
        } else {
            datagram.address
        };
        let len = datagram.data.len();
        (datagram.command, datagram.index, address, len).hash(&mut hasher);
    }
    sender(frame.source).hash(&mut hasher);
    hasher.finish()
}

impl Pairing {
    /// Adds the next frame of the recording.
    pub fn push(&mut self, frame: Frame) {
        if frame.source[0] & PASSED == 0 && self.senders.len() < SOURCES {
            self.senders.insert(frame.source);
        }
        self.ahead.push_back(frame);
        if self.ahead.len() > LOOK_AHEAD
            && let Some(frame) = self.ahead.pop_front()
        {
            self.judge(frame);
        }
    }

    /// Returns the next complete exchange.
    pub fn next(&mut self) -> Option<FrameExchange> {
        self.done.pop_front()
    }

    /// Ends the input.
    pub fn end(&mut self) {
        while let Some(frame) = self.ahead.pop_front() {
            self.judge(frame);
        }
        // Sent so close to the end that its answer cannot have been recorded.
        let end = self
            .latest
            .saturating_sub(self.longest_round_trip.saturating_mul(2));
        for Waiting { sent, back, .. } in std::mem::take(&mut self.under_way) {
            let late = sent.as_ref().is_some_and(|frame| frame.at >= end);
            let open = self.answered && late && back.is_none();
            self.done.push_back(FrameExchange { sent, back, open });
        }
    }

    fn judge(&mut self, frame: Frame) {
        self.latest = self.latest.max(frame.at);
        let key = key(&frame);
        let mut waiting = self.under_way.iter_mut().rev();
        let mine = waiting.find(|other| other.key == key && other.back.is_none());
        let awaited = mine.is_some();
        let seen = self.answers.get(&frame.source).copied().unwrap_or_default();
        let passed = frame.source[0] & PASSED != 0;
        let worked = frame.datagrams.iter().any(|datagram| datagram.wkc > 0);
        // A MainDevice's own address may have the bit. The recorded direction or earlier frames
        // then decide.
        let is_answer = passed
            && (self.senders.contains(&sender(frame.source))
                || match frame.direction {
                    Some(direction) => direction == Direction::In,
                    None => awaited || worked || seen.0 >= ONE_SIDED && seen.1 == 0,
                });
        if is_answer {
            if self.answers.len() < SOURCES || self.answers.contains_key(&frame.source) {
                let (alone, paired) = self.answers.entry(frame.source).or_default();
                *alone += u64::from(!awaited);
                *paired += u64::from(awaited);
            }
            self.answered = true;
            if let Some(mine) = mine {
                let sent_at = mine.sent.as_ref().map_or(frame.at, |sent| sent.at);
                let took = frame.at.saturating_sub(sent_at);
                self.longest_round_trip = self.longest_round_trip.max(took);
                mine.back = Some(frame);
            } else {
                self.under_way.push_back(Waiting {
                    key,
                    sent: None,
                    back: Some(frame),
                });
            }
        } else {
            self.under_way.push_back(Waiting {
                key,
                sent: Some(frame),
                back: None,
            });
        }
        self.give_up();
    }

    /// Releases exchanges that are complete or timed out.
    fn give_up(&mut self) {
        while let Some(first) = self.under_way.front() {
            let waits = |sent: &Frame| self.latest.saturating_sub(sent.at) <= TIMEOUT_NS;
            if first.back.is_none()
                && first.sent.as_ref().is_some_and(waits)
                && self.under_way.len() <= UNDER_WAY
            {
                break;
            }
            let Some(Waiting { sent, back, .. }) = self.under_way.pop_front() else {
                break;
            };
            let open = false;
            self.done.push_back(FrameExchange { sent, back, open });
        }
    }
}
