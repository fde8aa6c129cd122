//! The CAN bus: data frames of 11-bit identifiers, arbitration, and the time of each frame on the
//! wire.

/// The largest transmit queue. A controller that cannot send drops the newest frames.
const QUEUE: usize = 256;
/// Error flag, its echo, delimiter and intermission after a frame without acknowledgement (ISO
/// 11898-1).
const ERROR_BITS: u64 = 6 + 6 + 8 + 3;

/// A frame with up to eight bytes, or a remote request for one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CanFrame {
    /// The 11-bit identifier.
    pub id: u16,
    /// True for a remote request.
    pub remote: bool,
    len: u8,
    data: [u8; 8],
}

impl CanFrame {
    /// Returns a data frame with the low 11 bits of the identifier and the first eight bytes of
    /// data.
    #[must_use]
    pub fn new(id: u16, bytes: &[u8]) -> Self {
        let mut data = [0; 8];
        for (to, from) in data.iter_mut().zip(bytes) {
            *to = *from;
        }
        Self {
            id: id & 0x7ff,
            remote: false,
            len: bytes.len().min(8) as u8,
            data,
        }
    }

    /// Returns a remote request for the frame with this identifier.
    #[must_use]
    pub fn request(id: u16) -> Self {
        Self {
            remote: true,
            ..Self::new(id, &[])
        }
    }

    /// Returns the data.
    #[must_use]
    pub fn data(&self) -> &[u8] {
        self.data.get(..usize::from(self.len)).unwrap_or_default()
    }

    /// Returns all eight bytes, zero beyond the frame's end.
    #[must_use]
    pub fn padded(&self) -> [u8; 8] {
        self.data
    }

    /// Returns the bits from start of frame to the end of the intermission, stuff bits included.
    #[must_use]
    pub fn wire_bits(&self) -> u64 {
        let mut stuffed = Stuffer::default();
        stuffed.push(0, 1);
        stuffed.push(u32::from(self.id), 11);
        // Remote request, identifier extension, reserved.
        stuffed.push(u32::from(self.remote) << 2, 3);
        stuffed.push(u32::from(self.len), 4);
        for byte in self.data() {
            stuffed.push(u32::from(*byte), 8);
        }
        let crc = stuffed.crc;
        stuffed.push(u32::from(crc), 15);
        // CRC delimiter, acknowledge slot and delimiter, end of frame, intermission.
        stuffed.bits + 1 + 1 + 1 + 7 + 3
    }

    /// The lower value wins. A data frame wins over a remote request with the same identifier.
    fn priority(&self) -> u16 {
        self.id << 1 | u16::from(self.remote)
    }
}

/// Counts bits. An opposite bit follows five equal ones.
#[derive(Default)]
struct Stuffer {
    bits: u64,
    last: bool,
    run: u32,
    crc: u16,
}

impl Stuffer {
    fn push(&mut self, value: u32, bits: u32) {
        for n in (0..bits).rev() {
            let bit = value >> n & 1 != 0;
            let high = self.crc & 0x4000 != 0;
            self.crc = self.crc << 1 & 0x7fff;
            if bit != high {
                self.crc ^= 0x4599;
            }
            self.put(bit);
            if self.run == 5 {
                self.put(!bit);
            }
        }
    }

    fn put(&mut self, bit: bool) {
        self.run = if bit == self.last && self.bits > 0 {
            self.run + 1
        } else {
            1
        };
        self.last = bit;
        self.bits += 1;
    }
}

#[derive(Debug, Clone, Copy)]
struct Queued {
    frame: CanFrame,
    from: u8,
    ready: u64,
    order: u64,
}

/// A frame that has been on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sent {
    pub frame: CanFrame,
    /// The sender's node number.
    pub from: u8,
    /// No node acknowledged the frame; it is sent again.
    pub failed: bool,
}

/// One CAN bus. The caller of `step` provides the time, in ns.
#[derive(Debug, Clone)]
pub struct CanBus {
    bit_ns: u64,
    queue: Vec<Queued>,
    /// The frame on the wire, and its end.
    current: Option<(Queued, u64)>,
    free: u64,
    order: u64,
    /// The number of frames that found the queue full.
    pub lost: u64,
}

impl CanBus {
    /// Creates a bus with this bit rate in bit/s.
    #[must_use]
    pub fn new(bit_rate: u32) -> Self {
        Self {
            bit_ns: 1_000_000_000 / u64::from(bit_rate.max(1)),
            queue: Vec::with_capacity(QUEUE),
            current: None,
            free: 0,
            order: 0,
            lost: 0,
        }
    }

    /// Hands a frame to its sender's controller.
    pub fn send(&mut self, from: u8, frame: CanFrame, now: u64) {
        if self.queue.len() >= QUEUE {
            self.lost += 1;
            return;
        }
        self.order += 1;
        self.queue.push(Queued {
            frame,
            from,
            ready: now,
            order: self.order,
        });
    }

    /// Drops all frames that a node still had to send.
    pub fn forget(&mut self, from: u8) {
        self.queue.retain(|queued| queued.from != from);
        self.current.take_if(|(queued, _)| queued.from == from);
    }

    /// Returns the time of the next event: an arbitration, or the end of a frame.
    #[must_use]
    pub fn due(&self) -> u64 {
        match &self.current {
            Some((_, end)) => *end,
            None => {
                let first = self.queue.iter().map(|queued| queued.ready).min();
                first.map_or(u64::MAX, |ready| ready.max(self.free))
            }
        }
    }

    /// Handles that event. `heard` returns true if another node acknowledges a node's frames.
    pub fn step(&mut self, heard: impl Fn(u8) -> bool) -> Option<Sent> {
        let now = self.due();
        if now == u64::MAX {
            return None;
        }
        if let Some((queued, end)) = self.current.take() {
            let failed = !heard(queued.from);
            self.free = end;
            if failed {
                self.free += ERROR_BITS * self.bit_ns;
                self.queue.push(queued);
            }
            return Some(Sent {
                frame: queued.frame,
                from: queued.from,
                failed,
            });
        }
        let winner = self
            .queue
            .iter()
            .enumerate()
            .filter(|(_, queued)| queued.ready <= now)
            .min_by_key(|(_, queued)| (queued.frame.priority(), queued.order))
            .map(|(n, _)| n)?;
        let queued = self.queue.swap_remove(winner);
        self.current = Some((queued, now + queued.frame.wire_bits() * self.bit_ns));
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn run(bus: &mut CanBus, until: u64) -> Vec<(u64, u16)> {
        let mut log = Vec::new();
        while bus.due() <= until {
            let at = bus.due();
            if let Some(sent) = bus.step(|_| true) {
                log.push((at, sent.frame.id));
            }
        }
        log
    }

    #[test]
    fn frame_length_includes_stuff_bits() {
        // In identifier 0x555 and alternating data only the control field has a run of five.
        let short = CanFrame::new(0x555, &[]);
        assert!(
            (47..=55).contains(&short.wire_bits()),
            "{}",
            short.wire_bits()
        );
        let worst = CanFrame::new(0, &[0; 8]);
        assert!(worst.wire_bits() > 47 + 64 + 12, "{}", worst.wire_bits());
    }

    #[test]
    fn crc_uses_the_standard_polynomial() {
        // x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1 over a single one bit.
        let mut stuffer = Stuffer::default();
        stuffer.push(1, 1);
        assert_eq!(stuffer.crc, 0x4599);
    }

    #[test]
    fn arbitration_picks_the_lowest_identifier_without_interrupting_a_frame() {
        let mut bus = CanBus::new(1_000_000);
        bus.send(1, CanFrame::new(0x700, &[0]), 0);
        bus.send(2, CanFrame::new(0x181, &[0; 8]), 10);
        bus.send(3, CanFrame::new(0x080, &[]), 20);
        bus.send(4, CanFrame::request(0x080), 20);
        let log = run(&mut bus, 1_000_000);
        let ids: Vec<u16> = log.iter().map(|(_, id)| *id).collect();
        assert_eq!(ids, [0x700, 0x080, 0x080, 0x181]);
        assert_eq!(log[0].0, CanFrame::new(0x700, &[0]).wire_bits() * 1000);
        assert_eq!(
            log[1].0 - log[0].0,
            CanFrame::new(0x080, &[]).wire_bits() * 1000
        );
    }

    #[test]
    fn frame_without_acknowledgement_is_repeated() {
        let mut bus = CanBus::new(125_000);
        bus.send(1, CanFrame::new(0x701, &[0]), 0);
        let mut tries = 0;
        while bus.due() < 10_000_000 {
            tries += u32::from(bus.step(|_| false).is_some_and(|sent| sent.failed));
        }
        assert!((14..=16).contains(&tries), "{tries}");
        assert_eq!(run(&mut bus, 20_000_000).len(), 1);
        assert_eq!(bus.due(), u64::MAX);
    }

    #[test]
    fn full_queue_drops_the_newest_frame() {
        let mut bus = CanBus::new(1_000_000);
        for _ in 0..QUEUE + 3 {
            bus.send(1, CanFrame::new(1, &[]), 0);
        }
        assert_eq!(bus.lost, 3);
        bus.forget(1);
        assert_eq!(bus.due(), u64::MAX);
    }

    proptest! {
        #[test]
        fn frame_length_stays_within_the_standard(
            id in 0u16..0x800, data in prop::collection::vec(any::<u8>(), 0..=8),
        ) {
            let frame = CanFrame::new(id, &data);
            let n = data.len() as u64 * 8;
            let least = 47 + n;
            // One stuff bit after the first five bits, then at most one every four.
            let most = least + (34 + n - 1) / 4;
            prop_assert!((least..=most).contains(&frame.wire_bits()));
        }
    }
}
