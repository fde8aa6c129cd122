//! The frames of one cycle, from staging until their answers are evaluated.

use std::ops::Range;

use super::frame::{
    DatagramSlot, FIRST_DATAGRAM, Frame, frame_number, frame_tag, number, same_headers,
};
use super::poll_schedule::PollDatagram;
use crate::clock::Nanos;
use crate::link::{Link, LinkError};

#[derive(Debug)]
pub(super) struct FrameSet {
    /// The frames of each layout.
    layouts: Vec<Vec<Frame>>,
    /// The layout in use.
    pub layout: usize,
    /// The number of its cycle; the low byte is the index of every datagram.
    cycle: u32,
    /// The delay after the planned release; `None` until sent.
    pub sent_late: Option<Nanos>,
    /// The session clock's time when it was sent.
    pub sent_at: Nanos,
    /// The diagnostic read that it carries.
    pub poll: Option<PollDatagram>,
}

impl FrameSet {
    pub fn new(layouts: Vec<Vec<Frame>>) -> Self {
        Self {
            layouts,
            layout: 0,
            cycle: 0,
            sent_late: None,
            sent_at: 0,
            poll: None,
        }
    }

    pub fn layout_frames(&self, layout: usize) -> &[Frame] {
        self.layouts.get(layout).map_or(&[], Vec::as_slice)
    }

    pub fn frames(&self) -> &[Frame] {
        self.layout_frames(self.layout)
    }

    pub fn frames_mut(&mut self) -> &mut [Frame] {
        self.layouts
            .get_mut(self.layout)
            .map_or(&mut [], Vec::as_mut_slice)
    }

    /// Marks the frames as ready to send; their data is already in place.
    pub fn stage(&mut self, cycle: u32) {
        self.cycle = cycle;
        self.sent_late = None;
        let frames = self.frames_mut();
        let count = frames.len();
        for (index, frame) in frames.iter_mut().enumerate() {
            frame.answered = false;
            number(&mut frame.bytes, frame_tag(index, count, cycle), cycle);
        }
    }

    /// Sends the frames now, `late` after their planned release.
    pub fn send(&mut self, link: &mut dyn Link, now: Nanos, late: Nanos) -> Result<(), LinkError> {
        self.sent_late = Some(late);
        self.sent_at = now;
        for frame in self.frames() {
            link.send(&frame.bytes)?;
        }
        Ok(())
    }

    /// Stores an answer to one of its frames. Rejects repeated answers and answers of another cycle
    /// or with other datagrams.
    pub fn receive(&mut self, answer: &[u8]) -> bool {
        let count = self.frames().len();
        let tag = answer.get(10).copied().unwrap_or(0);
        let number = frame_number(tag, count);
        let awaited = self.sent_late.is_some()
            && answer.get(FIRST_DATAGRAM + 1) == Some(&(self.cycle as u8))
            && tag == frame_tag(number, count, self.cycle);
        let Some(frame) = self
            .frames_mut()
            .get_mut(number)
            .filter(|f| awaited && !f.answered)
        else {
            return false;
        };
        let Some(answer) = answer.get(..frame.bytes.len()) else {
            return false;
        };
        if !same_headers(&frame.bytes, answer) {
            return false;
        }
        let Some(kept) = frame.answer.get_mut(..answer.len()) else {
            return false;
        };
        kept.copy_from_slice(answer);
        frame.answered = true;
        true
    }

    pub fn complete(&self) -> bool {
        self.frames().iter().all(|frame| frame.answered)
    }

    /// Returns the answer to a frame, if it has arrived.
    pub fn answer(&self, number: usize) -> Option<&[u8]> {
        let frame = self.frames().get(number).filter(|frame| frame.answered)?;
        frame.answer.get(..frame.bytes.len())
    }

    /// True if a part of a datagram's data came back otherwise than it was sent.
    pub fn differs(&self, slot: DatagramSlot, part: Range<usize>) -> bool {
        let sent = self.frames().get(slot.frame).map(|frame| &frame.bytes[..]);
        let Some((sent, answer)) = sent.zip(self.answer(slot.frame)) else {
            return false;
        };
        let (sent, answer) = (sent.get(slot.data()), answer.get(slot.data()));
        let sent = sent.and_then(|data| data.get(part.clone()));
        sent != answer.and_then(|data| data.get(part))
    }

    /// Returns the answer of a datagram of eight bytes; `None` if the low 32 bits came back as they
    /// were sent.
    pub fn changed(&self, slot: DatagramSlot) -> Option<u64> {
        let sent = self.frames().get(slot.frame)?.bytes.get(slot.data())?;
        let answer = self.answer(slot.frame)?.get(slot.data())?;
        let time = u64::from_le_bytes(answer.try_into().ok()?);
        (sent.first_chunk::<4>() != answer.first_chunk()).then_some(time)
    }
}
