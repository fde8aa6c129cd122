//! A recording in place of a bus. It answers each request as it was answered in the recording, and
//! reports where a run diverges from it.
//!
//! For tests and for repeating a run in virtual time; it allocates. A run that repeats the recorded
//! one gets the same bytes after the same times, so its outcome is the same.

use std::collections::VecDeque;
use std::fmt;
use std::io::{self, Read};

use super::redundant::RingStatus;
use super::{Link, LinkError, MAX_FRAME, Nanos};
use crate::clock;
use crate::recording::frame::{Content, Frame, content};
use crate::recording::{Direction, Reader};

/// The number of recorded frames that are searched for a sent one; the frames before it were
/// skipped.
const AHEAD: usize = 256;
/// Divergences kept in full; further ones are only counted.
const DEVIATIONS: usize = 16;
/// The maximum bytes of a recording held in memory.
const LIMIT: usize = 1 << 30;

/// Bytes from a datagram's index to its data.
const INDEX: usize = 9;

/// A difference between the run and the recording.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Divergence {
    /// A recorded frame was sent with other data; it is answered as recorded.
    Data {
        frame: u64,
        datagram: usize,
        offset: usize,
        sent: u8,
        recorded: u8,
    },
    /// Recorded frames that were not sent now: the first, and how many.
    LeftOut { frame: u64, count: usize },
    /// A frame that is not in the recording: it gets no answer. `expected` is the number of the
    /// recorded frame in its place.
    Other {
        sent: String,
        recorded: String,
        expected: u64,
    },
    /// All recorded frames have been sent; further frames get no answer.
    Beyond { sent: String },
}

impl fmt::Display for Divergence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Data {
                frame,
                datagram,
                offset,
                sent,
                recorded,
            } => write!(
                f,
                "frame {frame} of the recording, datagram {datagram}: byte {offset} of the data is 0x{sent:02x}, recorded is 0x{recorded:02x}"
            ),
            Self::LeftOut { frame, count } => {
                let plural = if *count == 1 { " was" } else { "s were" };
                write!(
                    f,
                    "{count} frame{plural} not sent that the recording has, frame {frame} first"
                )
            }
            Self::Other {
                sent,
                recorded,
                expected,
            } => write!(
                f,
                "{sent} was sent where the recording has {recorded} (frame {expected}); it gets no answer"
            ),
            Self::Beyond { sent } => {
                write!(
                    f,
                    "{sent} was sent after the recording's last frame; it gets no answer"
                )
            }
        }
    }
}

/// A sent frame and its answers.
#[derive(Debug)]
struct RecordedExchange {
    frame: Frame,
    /// Each answer with its delay after sending, in ns.
    answers: Vec<(Nanos, Vec<u8>)>,
}

/// Answers from a recording.
#[derive(Debug)]
pub struct Replay {
    /// Recorded frames not sent yet, in order.
    left: VecDeque<RecordedExchange>,
    /// Arrival times and answers, the next one first.
    under_way: VecDeque<(Nanos, Vec<u8>)>,
    deviations: Vec<Divergence>,
    more: u64,
    too_long: bool,
    /// A frame was sent after the last recorded one.
    beyond: bool,
    ring: Option<&'static RingStatus>,
}

impl Replay {
    /// Sets that the recording is of a ring. A recording has each frame once, as of a closed ring.
    #[must_use]
    pub fn in_ring(self) -> Self {
        Self {
            ring: Some(RingStatus::closed()),
            ..self
        }
    }

    /// Reads a recording that contains both directions.
    ///
    /// # Errors
    /// Fails if the recording contains no answers or is too long for memory.
    pub fn new<R: Read>(mut reader: Reader<R>) -> io::Result<Self> {
        let mut sent: Vec<RecordedExchange> = Vec::new();
        let (mut bytes, mut answered) = (0, false);
        while let Some(packet) = reader.next() {
            let Content::Frame(frame) = content(packet) else {
                continue;
            };
            bytes += frame.bytes.len();
            if bytes > LIMIT {
                return Err(io::Error::other("the recording is longer than 1 GiB"));
            }
            let is_answer = match frame.direction {
                Some(direction) => direction == Direction::In,
                None => frame.source[0] & 0x02 != 0,
            };
            if !is_answer {
                sent.push(RecordedExchange {
                    frame,
                    answers: Vec::new(),
                });
                continue;
            }
            // The request of this answer, or else the last frame sent before it.
            let index =
                |frame: &Frame| -> Vec<u8> { frame.datagrams.iter().map(|d| d.index).collect() };
            let indices = index(&frame);
            let fits = |sent: &&mut RecordedExchange| {
                index(&sent.frame) == indices && same_shape(&sent.frame, &frame)
            };
            // No answer comes at once: that of a frame sent in the same moment is one to a frame that
            // was sent before and repeated.
            let earlier = |sent: &RecordedExchange| sent.frame.at < frame.at;
            let recent = sent.iter_mut().rev().take(AHEAD);
            let own = recent.filter(|sent| earlier(sent)).find(fits);
            let own = match own {
                Some(own) => Some(own),
                None => sent.last_mut(),
            };
            if let Some(own) = own {
                own.answers
                    .push((frame.at.saturating_sub(own.frame.at), frame.bytes));
                answered = true;
            }
        }
        if !answered {
            let message = "the recording has no frame that came back";
            return Err(io::Error::new(io::ErrorKind::InvalidData, message));
        }
        Ok(Self {
            left: sent.into(),
            under_way: VecDeque::new(),
            deviations: Vec::new(),
            more: 0,
            too_long: false,
            beyond: false,
            ring: None,
        })
    }

    fn report_divergence(&mut self, deviation: Divergence) {
        if self.deviations.len() < DEVIATIONS {
            self.deviations.push(deviation);
        } else {
            self.more += 1;
        }
    }

    /// Returns the first divergences of this run.
    #[must_use]
    pub fn deviations(&self) -> &[Divergence] {
        &self.deviations
    }

    /// Queues the answers to `sent`, with the indices of the frame that was sent now.
    fn answer(&mut self, sent: RecordedExchange, now_sent: &Frame) {
        let now = clock::now();
        for (after, mut bytes) in sent.answers {
            for (old, new) in sent.frame.datagrams.iter().zip(&now_sent.datagrams) {
                let place = old.data.start.checked_sub(INDEX);
                if let Some(index) = place.and_then(|at| bytes.get_mut(at))
                    && *index == old.index
                {
                    *index = new.index;
                }
            }
            let at = now.saturating_add(after);
            let place = self.under_way.partition_point(|(other, _)| *other <= at);
            self.under_way.insert(place, (at, bytes));
        }
    }

    fn take(&mut self, n: usize) -> Option<RecordedExchange> {
        if n > 0 {
            let frame = self.left.front().map_or(0, |sent| sent.frame.number);
            self.report_divergence(Divergence::LeftOut { frame, count: n });
            self.left.drain(..n);
        }
        self.left.pop_front()
    }
}

/// True if both frames have the same commands, addresses and lengths.
fn same_shape(a: &Frame, b: &Frame) -> bool {
    let key = |frame: &Frame| {
        let of = |d: &crate::recording::frame::Datagram| {
            let address = if d.command.is_positional() {
                d.address & 0xffff_0000
            } else {
                d.address
            };
            (d.command, address, d.data.len())
        };
        frame.datagrams.iter().map(of).collect::<Vec<_>>()
    };
    a.source.get(1..) == b.source.get(1..) && key(a) == key(b)
}

/// Returns the datagrams of a frame in short form.
fn short(frame: &Frame) -> String {
    let one = |d: &crate::recording::frame::Datagram| {
        if d.command.is_logical() {
            format!("{} 0x{:08x}", d.command.name(), d.address)
        } else {
            format!("{} 0x{:04x}:0x{:04x}", d.command.name(), d.adp(), d.ado())
        }
    };
    frame
        .datagrams
        .iter()
        .take(3)
        .map(one)
        .collect::<Vec<_>>()
        .join(" + ")
}

fn parsed(bytes: &[u8]) -> Option<Frame> {
    let packet = crate::recording::Packet {
        number: 0,
        at: Some(0),
        interface: 0,
        link_type: 1,
        direction: Some(Direction::Out),
        data: bytes.to_vec(),
        original_len: bytes.len(),
    };
    match content(packet) {
        Content::Frame(frame) => Some(frame),
        _ => None,
    }
}

impl Link for Replay {
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        if bytes.len() > MAX_FRAME {
            return Err(LinkError::TooLong(bytes.len()));
        }
        let Some(frame) = parsed(bytes) else {
            return Ok(());
        };
        // Recordings may contain padding.
        let equal = |sent: &RecordedExchange| sent.frame.bytes.starts_with(bytes);
        let alike = |sent: &RecordedExchange| same_shape(&sent.frame, &frame);
        let equal = self.left.iter().take(AHEAD).position(equal);
        let near = equal.or_else(|| self.left.iter().take(AHEAD).position(alike));
        if let Some(sent) = near.and_then(|n| self.take(n)) {
            if let Some(deviation) = difference(&sent.frame, &frame) {
                self.report_divergence(deviation);
            }
            self.answer(sent, &frame);
        } else {
            let sent = short(&frame);
            let deviation = match self.left.front() {
                Some(next) => Divergence::Other {
                    sent,
                    recorded: short(&next.frame),
                    expected: next.frame.number,
                },
                None => {
                    self.beyond = true;
                    Divergence::Beyond { sent }
                }
            };
            self.report_divergence(deviation);
        }
        Ok(())
    }

    fn ring(&self) -> Option<&'static RingStatus> {
        self.ring
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        if self.next_arrival().is_none_or(|at| at > clock::now()) {
            return Ok(None);
        }
        let Some((_, bytes)) = self.under_way.pop_front() else {
            return Ok(None);
        };
        let Some(room) = buf.get_mut(..bytes.len()) else {
            self.too_long = true;
            return Ok(None);
        };
        room.copy_from_slice(&bytes);
        Ok(Some(bytes.len()))
    }

    fn next_arrival(&self) -> Option<Nanos> {
        self.under_way.front().map(|(at, _)| *at)
    }

    fn exhausted_reason(&self) -> Option<&'static str> {
        self.beyond.then_some("the recording ends")
    }

    /// Reports the first divergence in full, because most of the others follow from it.
    fn notices(&mut self) -> Vec<String> {
        let mut remarks: Vec<String> = Vec::new();
        if let Some(first) = self.deviations.first() {
            remarks.push(format!("the run deviates from the recording: {first}"));
        }
        let more = self.deviations.len().saturating_sub(1);
        match self
            .more
            .saturating_add(u64::try_from(more).unwrap_or(u64::MAX))
        {
            0 => {}
            1 => remarks.push("1 further deviation from the recording".to_owned()),
            more => remarks.push(format!("{more} further deviations from the recording")),
        }
        if self.too_long {
            remarks.push("the recording has frames that no link can carry".to_owned());
        }
        if !self.left.is_empty() {
            remarks.push(match self.left.len() {
                1 => "1 frame of the recording was not sent".to_owned(),
                n => format!("{n} frames of the recording were not sent"),
            });
        }
        remarks
    }
}

/// Returns the first difference in the data of two frames of the same shape. Indices may differ:
/// they are chosen by the MainDevice.
fn difference(recorded: &Frame, sent: &Frame) -> Option<Divergence> {
    for (n, (old, new)) in recorded.datagrams.iter().zip(&sent.datagrams).enumerate() {
        let both = recorded.data(old).iter().zip(sent.data(new));
        if let Some((offset, (old, new))) = both.enumerate().find(|(_, (old, new))| old != new) {
            return Some(Divergence::Data {
                frame: recorded.number,
                datagram: n + 1,
                offset,
                sent: *new,
                recorded: *old,
            });
        }
    }
    None
}
