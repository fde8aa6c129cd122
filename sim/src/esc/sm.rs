//! SyncManagers: who may touch process RAM, and when a buffer or mailbox changes hands (Beckhoff ESC data
//! sheet, section I, 8; section II, 2.14).

/// How a SyncManager hands its area over.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Mode {
    /// Three buffers: the consumer always gets the last complete one.
    #[default]
    Buffered,
    /// One buffer, written and read in turn.
    Mailbox,
    /// Control codes 1 and 3.
    Reserved,
}

impl Mode {
    #[must_use]
    pub fn from_control(control: u8) -> Self {
        match control & 3 {
            0 => Self::Buffered,
            2 => Self::Mailbox,
            _ => Self::Reserved,
        }
    }
}

/// Who fills the area.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Filled {
    /// The device writes, the MainDevice reads (inputs, mailbox in).
    #[default]
    ByDevice,
    ByMainDevice,
}

/// Three buffers go round: the producer has one, the consumer has one, the third holds the last complete
/// data or is free.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Rotation {
    producer: u8,
    between: u8,
    consumer: u8,
    /// `between` is newer than what the consumer has.
    fresh: bool,
    /// Last complete buffer; 3: none yet.
    last: u8,
}

impl Default for Rotation {
    fn default() -> Self {
        Self {
            producer: 0,
            between: 1,
            consumer: 2,
            fresh: false,
            last: NONE_WRITTEN,
        }
    }
}

/// Status bits 5:4 before the first buffer is complete.
const NONE_WRITTEN: u8 = 3;

impl Rotation {
    fn produced(&mut self) {
        self.last = self.producer;
        std::mem::swap(&mut self.producer, &mut self.between);
        self.fresh = true;
    }

    fn consume(&mut self) {
        if std::mem::take(&mut self.fresh) {
            std::mem::swap(&mut self.consumer, &mut self.between);
        }
    }
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SyncManager {
    pub start: u16,
    pub len: u16,
    /// Register byte 4, as last accepted.
    pub control: u8,
    pub mode: Mode,
    pub filled: Filled,
    pub watchdog: bool,
    /// The MainDevice enabled it (byte 6, bit 0).
    pub enabled: bool,
    /// The device holds it closed (byte 7, bit 0), as in states below SafeOp.
    pub closed_by_device: bool,
    /// A mailbox with a message in it.
    pub full: bool,
    was_full: bool,
    rotation: Rotation,
    /// An access of the MainDevice began with the first byte and has not reached the last.
    open: bool,
    /// The frame under way reached the last byte.
    closing: bool,
    interrupt_write: bool,
    interrupt_read: bool,
}

impl SyncManager {
    /// The five configuration bytes and the activation byte, as registers hold them. True if it was
    /// enabled or disabled by that.
    pub fn configure(&mut self, r: &[u8; 8]) -> bool {
        let enable = r[6] & 1 != 0;
        if !self.enabled {
            self.start = u16::from_le_bytes([r[0], r[1]]);
            self.len = u16::from_le_bytes([r[2], r[3]]);
            self.control = r[4];
            self.mode = Mode::from_control(r[4]);
            self.filled = if r[4] >> 2 & 3 == 1 {
                Filled::ByMainDevice
            } else {
                Filled::ByDevice
            };
            self.watchdog = r[4] & 0x40 != 0;
        }
        let changed = enable != self.enabled;
        if changed {
            self.enabled = enable;
            self.reset();
        }
        changed
    }

    /// Empties it, as enabling, disabling and closing do.
    pub fn reset(&mut self) {
        (self.full, self.was_full) = (false, false);
        self.rotation = Rotation::default();
        (self.open, self.closing) = (false, false);
        (self.interrupt_write, self.interrupt_read) = (false, false);
    }

    /// Opened or closed by the device.
    pub fn close(&mut self, closed: bool) {
        if closed != self.closed_by_device {
            self.closed_by_device = closed;
            self.reset();
        }
    }

    /// Whether it has a say over its area. One without a length has none.
    #[must_use]
    pub fn guards(&self) -> bool {
        self.len > 0 && (self.enabled || self.closed_by_device)
    }

    #[must_use]
    pub fn area(&self) -> std::ops::Range<usize> {
        let start = usize::from(self.start);
        start..start + usize::from(self.len)
    }

    /// Bytes of memory it takes: three buffers in process RAM, one for mailboxes and for the digital
    /// outputs in front of it.
    #[must_use]
    pub fn footprint(&self) -> usize {
        let three = self.mode == Mode::Buffered && self.start >= 0x1000;
        usize::from(self.len) * if three { 3 } else { 1 }
    }

    #[must_use]
    pub fn is_open(&self) -> bool {
        self.enabled && !self.closed_by_device && self.mode != Mode::Reserved
    }

    /// Buffered, and something was written to it.
    #[must_use]
    pub fn has_data(&self) -> bool {
        self.rotation.last != NONE_WRITTEN
    }

    /// A single byte needs no buffers and passes; it still triggers watchdog and events.
    fn passes(&self) -> bool {
        self.len <= 1
    }

    fn buffer(&self, n: u8, memory: usize) -> usize {
        let start = usize::from(self.start);
        let three = self.mode == Mode::Buffered && !self.passes() && self.start >= 0x1000;
        if three && start + self.footprint() <= memory {
            start + usize::from(n) * usize::from(self.len)
        } else {
            start
        }
    }

    /// Where in memory the MainDevice reads or writes (`filled`: by whom the area must be filled) from this
    /// offset on, and how many of the `len` bytes; `None` where it may not.
    pub fn access(
        &mut self,
        filled: Filled,
        offset: usize,
        len: usize,
        memory: usize,
    ) -> (usize, Option<usize>) {
        if !self.is_open() {
            return (len, None);
        }
        let last = usize::from(self.len).saturating_sub(1);
        if self.passes() {
            self.closing |= self.filled == filled;
            return (len, Some(self.buffer(0, memory)));
        }
        let allowed = match (self.mode, filled) {
            (Mode::Mailbox, Filled::ByDevice) => self.full,
            (Mode::Mailbox, Filled::ByMainDevice) => !self.full,
            (Mode::Buffered, Filled::ByDevice) => self.has_data(),
            (Mode::Buffered, Filled::ByMainDevice) => true,
            (Mode::Reserved, _) => false,
        };
        if filled != self.filled || !allowed || !(self.open || offset == 0) {
            return (len, None);
        }
        let ends = offset + len > last;
        if ends && self.closing {
            // The last byte is accessed once in a frame.
            return if offset == last {
                (len, None)
            } else {
                let buffer = self.opened_by_main_device(filled, memory);
                (len - 1, Some(buffer + offset))
            };
        }
        if offset == 0 && !self.open {
            match filled {
                Filled::ByDevice => {
                    self.rotation.consume();
                    self.interrupt_write = false;
                }
                Filled::ByMainDevice => self.interrupt_read = false,
            }
        }
        self.open = true;
        self.closing |= ends;
        (
            len,
            Some(self.opened_by_main_device(filled, memory) + offset),
        )
    }

    fn opened_by_main_device(&self, filled: Filled, memory: usize) -> usize {
        match filled {
            Filled::ByDevice => self.buffer(self.rotation.consumer, memory),
            Filled::ByMainDevice => self.buffer(self.rotation.producer, memory),
        }
    }

    /// The frame is over and was good; true if the area changed hands in it.
    pub fn end_frame(&mut self) -> bool {
        if !std::mem::take(&mut self.closing) {
            return false;
        }
        self.open = false;
        match self.filled {
            Filled::ByMainDevice => self.produced(),
            Filled::ByDevice => self.consumed(),
        }
        true
    }

    fn produced(&mut self) {
        match self.mode {
            Mode::Mailbox if !self.passes() => self.full = true,
            _ => self.rotation.produced(),
        }
        self.note_full();
        self.interrupt_write = true;
    }

    fn consumed(&mut self) {
        self.full = false;
        self.note_full();
        (self.interrupt_write, self.interrupt_read) = (false, true);
    }

    /// A mailbox that was filled or emptied since the last call shows it in its event bits.
    pub fn note_full(&mut self) {
        if self.full != self.was_full {
            self.was_full = self.full;
            (self.interrupt_write, self.interrupt_read) = (self.full, !self.full);
        }
    }

    /// Where the device writes next. It does so at once, so nothing is ever half written.
    #[must_use]
    pub fn device_writes_at(&self, memory: usize) -> usize {
        self.buffer(self.rotation.producer, memory)
    }

    /// The device filled a buffer or the mailbox.
    pub fn device_wrote(&mut self) {
        self.interrupt_read = false;
        self.produced();
    }

    /// Where the device finds the last complete data.
    pub fn device_reads_at(&mut self, memory: usize) -> usize {
        self.rotation.consume();
        (self.interrupt_write, self.interrupt_read) = (false, true);
        self.buffer(self.rotation.consumer, memory)
    }

    /// Where the last complete data are, without fetching them.
    #[must_use]
    pub fn latest_at(&self, memory: usize) -> usize {
        let n = if self.has_data() {
            self.rotation.last
        } else {
            0
        };
        self.buffer(n, memory)
    }

    /// Register byte 5.
    #[must_use]
    pub fn status(&self) -> u8 {
        let opened = match (self.open, self.filled) {
            (false, _) => 0,
            (true, Filled::ByDevice) => 0x40,
            (true, Filled::ByMainDevice) => 0x80,
        };
        let events = u8::from(self.interrupt_write) | u8::from(self.interrupt_read) << 1;
        let state = match self.mode {
            Mode::Mailbox => u8::from(self.full) << 3,
            _ => self.rotation.last << 4,
        };
        state | events | opened
    }

    /// Whether it shows in the MainDevice's event register 0x0210: what the other side did, if asked for.
    #[must_use]
    pub fn main_device_event(&self) -> bool {
        let event = match self.filled {
            Filled::ByDevice => self.interrupt_write,
            Filled::ByMainDevice => self.interrupt_read,
        };
        event && self.enabled && self.control & 0x10 != 0
    }

    /// Whether it shows in the device's event register 0x0220.
    #[must_use]
    pub fn device_event(&self) -> bool {
        let event = match self.filled {
            Filled::ByDevice => self.interrupt_read,
            Filled::ByMainDevice => self.interrupt_write,
        };
        event && self.enabled && self.control & 0x20 != 0
    }
}
