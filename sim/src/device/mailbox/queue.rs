//! The queue of messages to the MainDevice.

use std::collections::VecDeque;

use super::{Detail, HEADER, protocol};

/// Maximum number of waiting emergencies; later ones are lost.
const EMERGENCIES: usize = 16;
/// Maximum number of requests with waiting answers. The last place is for the "no more memory"
/// error.
const ANSWERS: usize = 4;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Class {
    /// The only answer to the last request.
    Answer,
    /// One of several answers to the last request.
    Part,
    /// The error reply that the queue has no room for an answer.
    Full,
    /// A message without a request.
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
    /// The number of the request that the message answers.
    request: u64,
    bytes: Vec<u8>,
}

#[derive(Debug, Clone, Default)]
pub(super) struct Queue {
    waiting: VecDeque<Message>,
    /// The message in the send SyncManager.
    current: Option<Message>,
    /// The last fetched message, which a repeat request sends again.
    previous: Option<Message>,
    /// The counter of the last message.
    counter: u8,
    repeat: bool,
    /// Header and contents of the last request. The counter in it identifies a repetition.
    last_request: Vec<u8>,
    /// The answers to the last request.
    last_answer: Vec<Message>,
    requests: u64,
    /// True if the last answer was fetched before the next request was written.
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
        // Counters run from 1 to 7; 0 means "no counter".
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

    /// Adds an answer in parts. It replaces the unfetched parts of an earlier answer.
    pub(super) fn push_parts(&mut self, kind: u8, parts: &[Vec<u8>]) {
        self.waiting.retain(|message| message.class != Class::Part);
        for part in parts {
            self.push(kind, part, Class::Part);
        }
    }

    /// True if no message waits.
    pub(super) fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    pub(super) fn error(&mut self, detail: Detail) {
        let class = match detail {
            Detail::NoMoreMemory => Class::Full,
            _ => Class::Answer,
        };
        let [low, high] = (detail as u16).to_le_bytes();
        self.push(protocol::ERROR, &[1, 0, low, high], class);
    }

    /// Returns the number of requests with waiting answers.
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

    /// True unless the queue has reported that it is full and is still full.
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

    /// Notes the arrival of a request, and whether its sender can have seen the last answer.
    pub(super) fn written(&mut self, is_working: bool) {
        self.answer_was_fetched = !is_working && !self.has_answer_on_the_way();
    }

    /// True for a repetition of the last request: the same counter, except 0 (no counter). The
    /// device must not execute it twice. If the answer was already fetched, it got lost and is sent
    /// again. Otherwise the pending answer is enough.
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

    /// Returns the next message for a mailbox of `room` bytes; longer messages are dropped.
    pub(super) fn next(&mut self, room: usize) -> Option<&[u8]> {
        loop {
            let message = self.waiting.pop_front()?;
            if message.bytes.len() <= room {
                return Some(&self.current.insert(message).bytes);
            }
        }
    }

    /// Handles that the MainDevice emptied the mailbox.
    pub(super) fn fetched(&mut self) {
        if let Some(message) = self.current.take() {
            self.previous = Some(message);
        }
    }

    /// Sets the repeat bit (0x080E.1). True if the change requests the last message again. An
    /// unread message in the mailbox follows after that message.
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
