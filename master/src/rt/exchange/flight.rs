//! One cycle's frames, from staging until their answers are judged.

use super::frame::{FIRST_DATAGRAM, Frame, frame_number, frame_tag, number, same_headers};
use super::rota::Turn;
use crate::clock::{self, Nanos};
use crate::link::{Link, LinkError};

#[derive(Debug)]
pub(super) struct Flight {
    /// Of each form.
    forms: Vec<Vec<Frame>>,
    /// The one that is used.
    pub form: usize,
    /// Number of its cycle; the low byte is every datagram's index.
    cycle: u32,
    /// After the planned release; `None`: not sent yet.
    pub sent_late: Option<Nanos>,
    /// When it was sent, by the session's clock.
    pub sent_at: Nanos,
    /// The diagnostic slot's turn that it carries.
    pub turn: Option<Turn>,
}

impl Flight {
    pub fn new(forms: Vec<Vec<Frame>>) -> Self {
        Self {
            forms,
            form: 0,
            cycle: 0,
            sent_late: None,
            sent_at: 0,
            turn: None,
        }
    }

    pub fn form_frames(&self, form: usize) -> &[Frame] {
        self.forms.get(form).map_or(&[], Vec::as_slice)
    }

    pub fn frames(&self) -> &[Frame] {
        self.form_frames(self.form)
    }

    pub fn frames_mut(&mut self) -> &mut [Frame] {
        self.forms
            .get_mut(self.form)
            .map_or(&mut [], Vec::as_mut_slice)
    }

    /// Ready to be sent, its data being in place.
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

    pub fn send(&mut self, link: &mut dyn Link, late: Nanos) -> Result<(), LinkError> {
        self.sent_late = Some(late);
        self.sent_at = clock::now();
        for frame in self.frames() {
            link.send(&frame.bytes)?;
        }
        Ok(())
    }

    /// Keeps an answer to one of its frames, unless it is one already known, of another cycle, or of other datagrams.
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

    /// The answer to a frame, if it came.
    pub fn answer(&self, number: usize) -> Option<&[u8]> {
        let frame = self.frames().get(number).filter(|frame| frame.answered)?;
        frame.answer.get(..frame.bytes.len())
    }
}
