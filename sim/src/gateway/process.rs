//! The gateway's own PDOs, between frames of the secondary network and the buffers (manual §6.2.4).

use super::Gateway;
use super::anybus::{BUFFER, buffer_place};
use super::can::CanFrame;
use super::nmt::NmtState;
use super::pdo::{self, Pdo};

const PDOS: u16 = 128;
const MS: u64 = 1_000_000;
/// PDO not processed due to length error; PDO length exceeded.
const TOO_SHORT: u16 = 0x8210;
const TOO_LONG: u16 = 0x8220;

/// A PDO whose objects are offsets in a buffer.
type Mapped = Pdo<usize>;

#[derive(Debug, Clone)]
pub(super) struct Receive {
    pdo: Mapped,
    /// A received frame that waits for the next SYNC.
    waiting: Option<CanFrame>,
}

#[derive(Debug, Clone)]
pub(super) struct Transmit {
    pdo: Mapped,
    sent: [u8; 8],
    /// True if sent since the gateway entered Operational.
    fresh: bool,
    /// SYNCs since the last transmission.
    syncs: u8,
    /// The end of the inhibit time, and the expiry of the event timer.
    allowed: u64,
    event: u64,
}

impl Gateway {
    /// Reloads the PDO parameters.
    pub(super) fn load_pdos(&mut self) {
        let place = |receive: bool| {
            move |index, sub| {
                let (area, at, _) = buffer_place(index, sub)?;
                (area == receive).then_some(at)
            }
        };
        let all = 0..PDOS;
        let pdos = all.clone();
        self.receive = pdos
            .filter_map(|n| Pdo::load(&self.d, pdo::RECEIVE, n, place(true)))
            .map(|pdo| Receive { pdo, waiting: None })
            .collect();
        self.transmit = all
            .filter_map(|n| Pdo::load(&self.d, pdo::TRANSMIT, n, place(false)))
            .map(|pdo| Transmit {
                pdo,
                sent: [0; 8],
                fresh: false,
                syncs: 0,
                allowed: 0,
                event: u64::MAX,
            })
            .collect();
    }

    /// Enters Operational. Every event-driven PDO is sent once.
    pub(super) fn start_pdos(&mut self) {
        for receive in &mut self.receive {
            receive.waiting = None;
        }
        for transmit in &mut self.transmit {
            (transmit.fresh, transmit.syncs) = (false, 0);
            (transmit.allowed, transmit.event) = (0, u64::MAX);
        }
    }

    /// Handles a frame that may be a receive PDO.
    pub(super) fn take_pdo(&mut self, frame: &CanFrame, now: u64) {
        if self.nmt != NmtState::Operational {
            return;
        }
        let mut error = None;
        for receive in &mut self.receive {
            if receive.pdo.cob != frame.id {
                continue;
            }
            match frame.data().len().cmp(&receive.pdo.len) {
                std::cmp::Ordering::Less => {
                    error = Some(TOO_SHORT);
                    continue;
                }
                std::cmp::Ordering::Greater => error = Some(TOO_LONG),
                std::cmp::Ordering::Equal => {}
            }
            if receive.pdo.is_synchronous() {
                receive.waiting = Some(*frame);
            } else {
                unpack(&receive.pdo, frame, &mut self.inputs);
            }
        }
        if let Some(code) = error {
            self.emergency(code, 0, now);
        }
    }

    /// Sends event-driven PDOs with changed data or an expired event timer.
    pub(super) fn poll_events(&mut self, now: u64) {
        if self.nmt != NmtState::Operational {
            return;
        }
        for transmit in &mut self.transmit {
            if transmit.pdo.is_synchronous() {
                continue;
            }
            let data = pack(&transmit.pdo, &self.outputs);
            let changed = !transmit.fresh || data != transmit.sent || transmit.event <= now;
            if changed && transmit.allowed <= now {
                let frame = transmit.send(data, now);
                self.bus.send(self.options.node_id, frame, now);
            }
        }
    }

    /// Handles a SYNC on the bus.
    pub(super) fn synchronise(&mut self, now: u64) {
        if self.nmt != NmtState::Operational {
            return;
        }
        for receive in &mut self.receive {
            if let Some(frame) = receive.waiting.take() {
                unpack(&receive.pdo, &frame, &mut self.inputs);
            }
        }
        for transmit in &mut self.transmit {
            if !transmit.pdo.is_synchronous() {
                continue;
            }
            let data = pack(&transmit.pdo, &self.outputs);
            transmit.syncs = transmit.syncs.saturating_add(1);
            let due = match transmit.pdo.kind {
                0 => !transmit.fresh || data != transmit.sent,
                every => transmit.syncs >= every,
            };
            if due {
                let frame = transmit.send(data, now);
                self.bus.send(self.options.node_id, frame, now);
            }
        }
    }
}

impl Transmit {
    fn send(&mut self, data: [u8; 8], now: u64) -> CanFrame {
        self.sent = data;
        self.fresh = true;
        self.syncs = 0;
        self.allowed = now + u64::from(self.pdo.inhibit) * (MS / 10);
        self.event = match self.pdo.event_timer {
            0 => u64::MAX,
            ms => now + u64::from(ms) * MS,
        };
        CanFrame::new(self.pdo.cob, data.get(..self.pdo.len).unwrap_or(&data))
    }
}

fn pack(pdo: &Mapped, buffer: &[u8; BUFFER]) -> [u8; 8] {
    let mut data = [0; 8];
    let mut at = 0;
    for (offset, len) in &pdo.map {
        for n in 0..usize::from(*len) {
            // The last 32-bit object extends beyond the buffer; the missing bytes are zero.
            let byte = buffer.get(offset + n).copied().unwrap_or(0);
            if let Some(to) = data.get_mut(at) {
                *to = byte;
            }
            at += 1;
        }
    }
    data
}

fn unpack(pdo: &Mapped, frame: &CanFrame, buffer: &mut [u8; BUFFER]) {
    let mut bytes = frame.data().iter();
    for (offset, len) in &pdo.map {
        for n in 0..usize::from(*len) {
            if let (Some(to), Some(from)) = (buffer.get_mut(offset + n), bytes.next()) {
                *to = *from;
            }
        }
    }
}
