//! The device's end of the mailbox: requests in, one reply at a time out, repeats on request.

use std::collections::VecDeque;

use super::SimDevice;
use crate::coe::{self, Dictionary, SdoServer, service};
use crate::drive::Emergency;
use crate::esc::al::AlState;

/// Between a request arriving and the device having worked on it.
const REQUEST_NS: u64 = 200_000;
const HEADER: usize = 6;
/// Messages kept for a MainDevice that does not fetch them.
const QUEUE: usize = 16;

const TYPE_ERROR: u8 = 0;
const TYPE_COE: u8 = 3;

/// Mailbox error details (ETG.1000.4 table 30).
mod detail {
    pub(super) const UNSUPPORTED_PROTOCOL: u16 = 2;
    pub(super) const SERVICE_NOT_SUPPORTED: u16 = 4;
    pub(super) const INVALID_HEADER: u16 = 5;
    pub(super) const TOO_SHORT: u16 = 6;
    pub(super) const INVALID_SIZE: u16 = 8;
}

#[derive(Debug, Clone)]
pub(super) struct Mailbox {
    /// SyncManager numbers.
    pub(super) receive: usize,
    pub(super) send: usize,
    queue: VecDeque<Vec<u8>>,
    /// In the send SyncManager now, or fetched last; what a repeat request wants again.
    current: Vec<u8>,
    previous: Vec<u8>,
    counter: u8,
    last_request: u8,
    repeat: bool,
    pub(super) due: u64,
    sdo: SdoServer,
}

impl Mailbox {
    pub(super) fn new(receive: usize, send: usize) -> Self {
        Self {
            receive,
            send,
            queue: VecDeque::with_capacity(QUEUE + 1),
            current: Vec::new(),
            previous: Vec::new(),
            counter: 0,
            last_request: 0,
            repeat: false,
            due: u64::MAX,
            sdo: SdoServer::default(),
        }
    }

    /// Leaving or entering Init forgets everything under way.
    pub(super) fn reset(&mut self) {
        self.queue.clear();
        self.current.clear();
        self.previous.clear();
        self.counter = 0;
        self.last_request = 0;
        self.repeat = false;
        self.due = u64::MAX;
        self.sdo.reset();
    }

    fn push(&mut self, kind: u8, payload: &[u8]) {
        if self.queue.len() >= QUEUE {
            return;
        }
        // 1 to 7; 0 means "no counter".
        self.counter = self.counter % 7 + 1;
        let mut message = Vec::with_capacity(HEADER + payload.len());
        message.extend_from_slice(&u16::try_from(payload.len()).unwrap_or(0).to_le_bytes());
        message.extend_from_slice(&[0, 0, 0, kind | self.counter << 4]);
        message.extend_from_slice(payload);
        self.queue.push_back(message);
    }

    fn error(&mut self, detail: u16) {
        let [low, high] = detail.to_le_bytes();
        self.push(TYPE_ERROR, &[1, 0, low, high]);
    }

    pub(super) fn emergency(&mut self, emergency: &Emergency) {
        let mut payload = [0; 10];
        payload[..2].copy_from_slice(&coe::header(service::EMERGENCY));
        payload[2..4].copy_from_slice(&emergency.code.to_le_bytes());
        payload[4] = emergency.register;
        payload[5..].copy_from_slice(&emergency.data);
        self.push(TYPE_COE, &payload);
    }
}

impl SimDevice {
    /// The MainDevice filled or emptied a mailbox, or asks for the last message again.
    pub(super) fn mailbox_events(
        &mut self,
        written: u8,
        read: u8,
        repeat: Option<bool>,
        local: u64,
    ) {
        // In Init nobody looks after mailboxes.
        let Some(mailbox) = self
            .mailbox
            .as_mut()
            .filter(|_| self.al.state != AlState::Init)
        else {
            return;
        };
        if written >> mailbox.receive & 1 != 0 {
            mailbox.due = local + REQUEST_NS;
        }
        if read >> mailbox.send & 1 != 0 {
            mailbox.previous = std::mem::take(&mut mailbox.current);
        }
        if let Some(repeat) = repeat.filter(|repeat| *repeat != mailbox.repeat) {
            mailbox.repeat = repeat;
            let send = mailbox.send;
            if self.esc.sms.get(send).is_some_and(|sm| sm.full) {
                mailbox
                    .queue
                    .push_front(std::mem::take(&mut mailbox.current));
            }
            if !mailbox.previous.is_empty() {
                mailbox.queue.push_front(mailbox.previous.clone());
            }
            if let Some(sm) = self.esc.sms.get_mut(send) {
                sm.reset();
            }
            let acknowledge = crate::esc::registers::SM + u16::try_from(send).unwrap_or(0) * 8 + 7;
            self.esc.put(acknowledge, &[u8::from(repeat) << 1]);
        }
        self.pump_mailbox();
    }

    /// Moves the next message into the send SyncManager if that is free.
    pub(super) fn pump_mailbox(&mut self) {
        let Some(mailbox) = &mut self.mailbox else {
            return;
        };
        let n = mailbox.send;
        let Some(sm) = self.esc.sms.get(n) else {
            return;
        };
        if !sm.is_open() || sm.full {
            return;
        }
        let (start, len) = (sm.start, sm.len);
        let Some(message) = mailbox.queue.pop_front() else {
            return;
        };
        let area = self.esc.bytes_mut(start, len);
        let fits = message.len().min(area.len());
        area.fill(0);
        if let (Some(to), Some(from)) = (area.get_mut(..fits), message.get(..fits)) {
            to.copy_from_slice(from);
        }
        mailbox.current = message;
        if let Some(sm) = self.esc.sms.get_mut(n) {
            sm.full = true;
        }
        self.esc.refresh_sm(n);
    }

    /// Works on the request in the receive SyncManager.
    pub(super) fn serve_mailbox(&mut self) {
        let Some(mailbox) = &mut self.mailbox else {
            return;
        };
        mailbox.due = u64::MAX;
        let n = mailbox.receive;
        let Some(sm) = self.esc.sms.get_mut(n) else {
            return;
        };
        if !sm.full {
            return;
        }
        let request = {
            let (start, len) = (sm.start, sm.len);
            sm.full = false;
            self.esc.refresh_sm(n);
            self.esc.bytes(start, len).to_vec()
        };
        let limit = self
            .esc
            .sms
            .get(mailbox.send)
            .map_or(0, |sm| usize::from(sm.len).saturating_sub(HEADER));
        self.answer(&request, limit);
        self.pump_mailbox();
    }

    fn answer(&mut self, request: &[u8], limit: usize) {
        let state = self.al.state;
        let Some(mailbox) = &mut self.mailbox else {
            return;
        };
        let Some(&[low, high, _, _, _, kind]) = request.get(..HEADER) else {
            return mailbox.error(detail::TOO_SHORT);
        };
        let len = usize::from(u16::from_le_bytes([low, high]));
        let counter = kind >> 4 & 7;
        if counter != 0 && counter == mailbox.last_request {
            // The same request once more: its first copy has been answered.
            return;
        }
        mailbox.last_request = counter;
        let Some(payload) = request.get(HEADER..HEADER + len) else {
            return mailbox.error(detail::INVALID_SIZE);
        };
        if kind & 0x0f != TYPE_COE || !self.has_coe || state == AlState::Boot {
            return mailbox.error(detail::UNSUPPORTED_PROTOCOL);
        }
        let (Some(&[c0, c1]), Some(body)) = (payload.get(..2), payload.get(2..)) else {
            return mailbox.error(detail::TOO_SHORT);
        };
        match (u16::from_le_bytes([c0, c1]) >> 12) as u8 {
            service::SDO_REQUEST
                if body.len() >= 4 || body.first().is_some_and(|c| c >> 5 == 0) =>
            {
                let mut dictionary = Dictionary {
                    store: &mut self.store,
                    pdo: &mut self.pdo,
                    state,
                    complete_access: self.complete_access,
                    forced: &self.forced_aborts,
                };
                if let Some(reply) = mailbox.sdo.request(&mut dictionary, body, limit) {
                    mailbox.push(TYPE_COE, &reply);
                }
            }
            service::SDO_REQUEST => mailbox.error(detail::TOO_SHORT),
            service::SDO_INFORMATION => mailbox.error(detail::SERVICE_NOT_SUPPORTED),
            _ => mailbox.error(detail::INVALID_HEADER),
        }
    }
}
