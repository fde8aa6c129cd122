//! Messages on their way to the MainDevice.

use std::collections::VecDeque;

use super::{Detail, HEADER, protocol};

/// Emergencies kept for a MainDevice that does not fetch them; later ones are lost.
const EMERGENCIES: usize = 16;
/// Requests whose answers may wait. The last place is for saying that there is no more.
const ANSWERS: usize = 4;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Class {
    /// To the last request.
    Answer,
    /// One of several that answer the last request.
    Part,
    /// There is no room for an answer.
    Full,
    /// What nobody asked for.
    Notice,
    Emergency,
}

impl Class {
    fn is_answer(self) -> bool {
        matches!(self, Self::Answer | Self::Part | Self::Full)
    }
}

#[derive(Debug, Clone)]
struct Message {
    class: Class,
    /// Which request it answers.
    request: u64,
    bytes: Vec<u8>,
}

#[derive(Debug, Clone, Default)]
pub(super) struct Queue {
    waiting: VecDeque<Message>,
    /// In the send SyncManager now.
    current: Option<Message>,
    /// Fetched last: what a repeat request wants again.
    previous: Option<Message>,
    /// Of the last message.
    counter: u8,
    repeat: bool,
    /// Header and contents of the last request, where it has a counter by which a repetition is known.
    last_request: Vec<u8>,
    /// What the last request was answered with.
    last_answer: Vec<Message>,
    requests: u64,
    /// Before the request was written that is fetched next.
    answer_was_fetched: bool,
}

impl Queue {
    pub(super) fn push(&mut self, kind: u8, payload: &[u8], class: Class) {
        if class == Class::Emergency {
            let is_emergency = |m: &&Message| m.class == Class::Emergency;
            if self.waiting.iter().filter(is_emergency).count() >= EMERGENCIES {
                return;
            }
        }
        // 1 to 7; 0 means "no counter".
        self.counter = self.counter % 7 + 1;
        let mut bytes = Vec::with_capacity(HEADER + payload.len());
        bytes.extend_from_slice(&u16::try_from(payload.len()).unwrap_or(0).to_le_bytes());
        bytes.extend_from_slice(&[0, 0, 0, kind | self.counter << 4]);
        bytes.extend_from_slice(payload);
        let message = Message {
            class,
            request: self.requests,
            bytes,
        };
        if class.is_answer() {
            self.last_answer.push(message.clone());
        }
        self.waiting.push_back(message);
    }

    /// A new answer in parts takes the place of one that nobody has finished fetching.
    pub(super) fn push_parts(&mut self, kind: u8, parts: &[Vec<u8>]) {
        self.waiting.retain(|message| message.class != Class::Part);
        for part in parts {
            self.push(kind, part, Class::Part);
        }
    }

    pub(super) fn error(&mut self, detail: Detail) {
        let class = match detail {
            Detail::NoMoreMemory => Class::Full,
            _ => Class::Answer,
        };
        let [low, high] = (detail as u16).to_le_bytes();
        self.push(protocol::ERROR, &[1, 0, low, high], class);
    }

    /// Requests that still wait for (the rest of) their answers to be put into the mailbox.
    fn unanswered(&self) -> usize {
        let mut requests = 0;
        let mut last = None;
        for message in self.waiting.iter().filter(|m| m.class.is_answer()) {
            if last.replace(message.request) != Some(message.request) {
                requests += 1;
            }
        }
        requests
    }

    /// Not after it said that there is no room, until there is some.
    pub(super) fn takes_requests(&self) -> bool {
        let is_full = self.waiting.iter().any(|m| m.class == Class::Full);
        !(is_full && self.is_last_place())
    }

    pub(super) fn is_last_place(&self) -> bool {
        self.unanswered() + 1 >= ANSWERS
    }

    fn has_answer_on_the_way(&self) -> bool {
        let mut messages = self.waiting.iter().chain(&self.current);
        messages.any(|m| m.class.is_answer() && m.request == self.requests)
    }

    /// A request was written; whether its sender can have seen the last answer is known only now.
    pub(super) fn written(&mut self, is_working: bool) {
        self.answer_was_fetched = !is_working && !self.has_answer_on_the_way();
    }

    /// Whether this is the last request once more, as a MainDevice sends it that did not see it arrive: same counter
    /// (0: none, never a repetition). It must not be executed twice. If it came after its answer had been fetched, that
    /// got lost and goes out again; otherwise the answer on its way will do.
    pub(super) fn is_repeated(&mut self, counter: u8, message: &[u8]) -> bool {
        let before = self.last_request.get(HEADER - 1).map(|kind| kind >> 4 & 7);
        if counter == 0 || before != Some(counter) {
            self.last_request.clear();
            self.last_request.extend_from_slice(message);
            self.last_answer.clear();
            self.requests += 1;
            return false;
        }
        if self.answer_was_fetched && self.last_request == message {
            self.waiting.extend(self.last_answer.iter().cloned());
        }
        true
    }

    /// The next message for a mailbox of `room` bytes; those that never fit are left out.
    pub(super) fn next(&mut self, room: usize) -> Option<&[u8]> {
        loop {
            let message = self.waiting.pop_front()?;
            if message.bytes.len() <= room {
                return Some(&self.current.insert(message).bytes);
            }
        }
    }

    /// The MainDevice emptied the mailbox.
    pub(super) fn fetched(&mut self) {
        if let Some(message) = self.current.take() {
            self.previous = Some(message);
        }
    }

    /// The repeat bit (0x080E.1) has this value now; true if that asks for the last message again. What lies in the mailbox
    /// unread follows after it.
    pub(super) fn repeat(&mut self, toggle: bool, unread: bool) -> bool {
        if toggle == self.repeat {
            return false;
        }
        self.repeat = toggle;
        if let Some(message) = self.current.take().filter(|_| unread) {
            self.waiting.push_front(message);
        }
        if let Some(message) = self.previous.take() {
            self.waiting.push_front(message);
        }
        true
    }
}
