//! SyncManagers: access to process RAM, and the handover of buffers and mailboxes (Beckhoff ESC
//! data sheet, section I, 8; section II, 2.14).

/// The handover mode of a SyncManager.
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

/// The side that fills the area.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum BufferOwner {
    /// The device writes, the MainDevice reads (inputs, mailbox in).
    #[default]
    ByDevice,
    ByMainDevice,
}

/// Rotation of three buffers: one of the producer, one of the consumer, and one that is free or has
/// the last complete data.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct TripleBuffer {
    producer: u8,
    between: u8,
    consumer: u8,
    /// True if `between` is newer than the buffer of the consumer.
    fresh: bool,
    /// Last complete buffer; 3: none yet.
    last: u8,
}

impl Default for TripleBuffer {
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

impl TripleBuffer {
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
    pub filled: BufferOwner,
    pub watchdog: bool,
    /// The MainDevice enabled it (byte 6, bit 0).
    pub enabled: bool,
    /// The device holds it closed (byte 7, bit 0), as in states below SafeOp.
    pub closed_by_device: bool,
    /// True if the mailbox contains a message.
    pub full: bool,
    was_full: bool,
    rotation: TripleBuffer,
    /// True if the MainDevice has accessed the first byte and not yet the last.
    open: bool,
    /// True if the current frame reached the last byte.
    closing: bool,
    interrupt_write: bool,
    interrupt_read: bool,
}

impl SyncManager {
    /// Configures the SyncManager from its eight register bytes. Returns true if that enabled or
    /// disabled it.
    pub fn configure(&mut self, r: &[u8; 8]) -> bool {
        let enable = r[6] & 1 != 0;
        if !self.enabled {
            self.start = u16::from_le_bytes([r[0], r[1]]);
            self.len = u16::from_le_bytes([r[2], r[3]]);
            self.control = r[4];
            self.mode = Mode::from_control(r[4]);
            self.filled = if r[4] >> 2 & 3 == 1 {
                BufferOwner::ByMainDevice
            } else {
                BufferOwner::ByDevice
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

    /// Empties the SyncManager. Enabling, disabling and closing do so.
    pub fn reset(&mut self) {
        (self.full, self.was_full) = (false, false);
        self.rotation = TripleBuffer::default();
        (self.open, self.closing) = (false, false);
        (self.interrupt_write, self.interrupt_read) = (false, false);
    }

    /// Opens or closes the SyncManager for the device.
    pub fn close(&mut self, closed: bool) {
        if closed != self.closed_by_device {
            self.closed_by_device = closed;
            self.reset();
        }
    }

    /// True if it controls its area. A SyncManager without a length controls none.
    #[must_use]
    pub fn guards(&self) -> bool {
        self.len > 0 && (self.enabled || self.closed_by_device)
    }

    #[must_use]
    pub fn area(&self) -> std::ops::Range<usize> {
        let start = usize::from(self.start);
        start..start + usize::from(self.len)
    }

    /// Returns the bytes of memory in use: three buffers in process RAM, one for mailboxes and for
    /// digital outputs.
    #[must_use]
    pub fn footprint(&self) -> usize {
        let three = self.mode == Mode::Buffered && self.start >= 0x1000;
        usize::from(self.len) * if three { 3 } else { 1 }
    }

    #[must_use]
    pub fn is_open(&self) -> bool {
        self.enabled && !self.closed_by_device && self.mode != Mode::Reserved
    }

    /// True if a buffer was written.
    #[must_use]
    pub fn has_data(&self) -> bool {
        self.rotation.last != NONE_WRITTEN
    }

    /// True for a single byte, which needs no buffers. Its accesses still trigger watchdog and
    /// events.
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

    /// Returns the accessible bytes of `len` from this offset on, and their memory location. The
    /// location is `None` without access. `filled` is the side that must fill the area: the device
    /// for reads, the MainDevice for writes.
    pub fn access(
        &mut self,
        filled: BufferOwner,
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
            (Mode::Mailbox, BufferOwner::ByDevice) => self.full,
            (Mode::Mailbox, BufferOwner::ByMainDevice) => !self.full,
            (Mode::Buffered, BufferOwner::ByDevice) => self.has_data(),
            (Mode::Buffered, BufferOwner::ByMainDevice) => true,
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
                BufferOwner::ByDevice => {
                    self.rotation.consume();
                    self.interrupt_write = false;
                }
                BufferOwner::ByMainDevice => self.interrupt_read = false,
            }
        }
        self.open = true;
        self.closing |= ends;
        (
            len,
            Some(self.opened_by_main_device(filled, memory) + offset),
        )
    }

    fn opened_by_main_device(&self, filled: BufferOwner, memory: usize) -> usize {
        match filled {
            BufferOwner::ByDevice => self.buffer(self.rotation.consumer, memory),
            BufferOwner::ByMainDevice => self.buffer(self.rotation.producer, memory),
        }
    }

    /// Ends a valid frame. Returns true if it handed over the area.
    pub fn end_frame(&mut self) -> bool {
        if !std::mem::take(&mut self.closing) {
            return false;
        }
        self.open = false;
        match self.filled {
            BufferOwner::ByMainDevice => self.produced(),
            BufferOwner::ByDevice => self.consumed(),
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

    /// Updates the event bits after the mailbox was filled or emptied.
    pub fn note_full(&mut self) {
        if self.full != self.was_full {
            self.was_full = self.full;
            (self.interrupt_write, self.interrupt_read) = (self.full, !self.full);
        }
    }

    /// Returns the address of the next device write. A device write is atomic.
    #[must_use]
    pub fn device_writes_at(&self, memory: usize) -> usize {
        self.buffer(self.rotation.producer, memory)
    }

    /// Handles that the device filled a buffer or the mailbox.
    pub fn device_wrote(&mut self) {
        self.interrupt_read = false;
        self.produced();
    }

    /// Fetches the last complete data and returns their address.
    pub fn device_reads_at(&mut self, memory: usize) -> usize {
        self.rotation.consume();
        (self.interrupt_write, self.interrupt_read) = (false, true);
        self.buffer(self.rotation.consumer, memory)
    }

    /// Returns the address of the last complete data without fetching them.
    #[must_use]
    pub fn latest_at(&self, memory: usize) -> usize {
        let n = if self.has_data() {
            self.rotation.last
        } else {
            0
        };
        self.buffer(n, memory)
    }

    /// Returns register byte 5.
    #[must_use]
    pub fn status(&self) -> u8 {
        let opened = match (self.open, self.filled) {
            (false, _) => 0,
            (true, BufferOwner::ByDevice) => 0x40,
            (true, BufferOwner::ByMainDevice) => 0x80,
        };
        let events = u8::from(self.interrupt_write) | u8::from(self.interrupt_read) << 1;
        let state = match self.mode {
            Mode::Mailbox => u8::from(self.full) << 3,
            _ => self.rotation.last << 4,
        };
        state | events | opened
    }

    /// True if the event register 0x0210 of the MainDevice reports an access of the device.
    #[must_use]
    pub fn main_device_event(&self) -> bool {
        let event = match self.filled {
            BufferOwner::ByDevice => self.interrupt_write,
            BufferOwner::ByMainDevice => self.interrupt_read,
        };
        event && self.enabled && self.control & 0x10 != 0
    }

    /// True if the event register 0x0220 of the device reports an access of the MainDevice.
    #[must_use]
    pub fn device_event(&self) -> bool {
        let event = match self.filled {
            BufferOwner::ByDevice => self.interrupt_read,
            BufferOwner::ByMainDevice => self.interrupt_write,
        };
        event && self.enabled && self.control & 0x20 != 0
    }
}
