//! One cycle's frames, from staging until their answers are judged.

use super::frame::{FIRST_DATAGRAM, Frame, new_frame, number, same_headers};
use super::rota::Turn;
use crate::clock::{self, Nanos};
use crate::link::{Link, LinkError};

#[derive(Debug)]
pub(super) struct Flight {
    pub frames: Vec<Frame>,
    /// Number of its cycle, which is every datagram's index.
    cycle: u8,
    /// After the planned release; `None`: not sent yet.
    pub sent_late: Option<Nanos>,
    /// When it was sent, by the session's clock.
    pub sent_at: Nanos,
    /// The diagnostic slot's turn that it carries.
    pub turn: Option<Turn>,
}

impl Flight {
    #[allow(clippy::disallowed_methods, reason = "prepares")]
    pub fn new(frames: usize) -> Self {
        let frames = (0..frames).map(|i| new_frame(u8::try_from(i).unwrap_or(u8::MAX)));
        Self {
            frames: frames.collect(),
            cycle: 0,
            sent_late: None,
            sent_at: 0,
            turn: None,
        }
    }

    /// Ready to be sent, its data being in place.
    pub fn stage(&mut self, cycle: u8) {
        self.cycle = cycle;
        self.sent_late = None;
        for frame in &mut self.frames {
            frame.answered = false;
            number(&mut frame.bytes, cycle);
        }
    }

    pub fn send(&mut self, link: &mut dyn Link, late: Nanos) -> Result<(), LinkError> {
        self.sent_late = Some(late);
        self.sent_at = clock::now();
        for frame in &self.frames {
            link.send(&frame.bytes)?;
        }
        Ok(())
    }

    /// Keeps an answer to the frame of this number, unless it is one already known, of another cycle, or of other datagrams.
    pub fn receive(&mut self, number: usize, answer: &[u8]) -> bool {
        let awaited =
            self.sent_late.is_some() && answer.get(FIRST_DATAGRAM + 1) == Some(&self.cycle);
        let Some(frame) = self
            .frames
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
        self.frames.iter().all(|frame| frame.answered)
    }

    /// The answer to a frame, if it came.
    pub fn answer(&self, number: usize) -> Option<&[u8]> {
        let frame = self.frames.get(number).filter(|frame| frame.answered)?;
        frame.answer.get(..frame.bytes.len())
    }
}
