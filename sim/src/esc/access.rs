//! Reads and writes of datagrams. RAM is written at once. Register writes wait until the frame has
//! been received without errors (shadow buffers, Beckhoff ESC data sheet, section I, 3.4);
//! `datagram` then applies them.

use super::Esc;
use super::registers as reg;
use super::sm::BufferOwner;

/// The effect of a read on the bytes of the datagram.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ReadCombine {
    Replace,
    Or,
}

/// The register writes of the current frame.
#[derive(Debug, Clone, Default)]
pub(super) struct Shadow {
    bytes: Vec<u8>,
    /// Address and length of each write.
    spans: Vec<(u16, u16)>,
}

impl Shadow {
    pub(super) fn with_capacity() -> Self {
        Self {
            bytes: Vec::with_capacity(1536),
            spans: Vec::with_capacity(128),
        }
    }

    fn push(&mut self, start: usize, bytes: &[u8]) {
        if let (Ok(start), Ok(len)) = (u16::try_from(start), u16::try_from(bytes.len())) {
            self.bytes.extend_from_slice(bytes);
            self.spans.push((start, len));
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.spans.is_empty()
    }

    pub(super) fn clear(&mut self) {
        self.bytes.clear();
        self.spans.clear();
    }

    /// Returns address and bytes of each write, in order.
    pub(super) fn writes(&self) -> impl Iterator<Item = (usize, &[u8])> {
        let mut rest = self.bytes.as_slice();
        self.spans.iter().map_while(move |(start, len)| {
            let (bytes, after) = rest.split_at_checked(usize::from(*len))?;
            rest = after;
            Some((usize::from(*start), bytes))
        })
    }
}

impl Esc {
    /// Reads into `out`. Returns false if no byte is readable.
    pub(super) fn read(&mut self, start: u16, out: &mut [u8], combine: ReadCombine) -> bool {
        let start = usize::from(start);
        let end = start + out.len();
        let mut any = false;
        let mut at = start;
        while at < end {
            let (len, place) = self.readable(at, end);
            let (from, to) = (at - start, at - start + len);
            if let (Some(place), Some(to)) = (place, out.get_mut(from..to))
                && let Some(from) = self.mem.get(place..place + len)
            {
                match combine {
                    ReadCombine::Replace => to.copy_from_slice(from),
                    ReadCombine::Or => to.iter_mut().zip(from).for_each(|(to, from)| *to |= from),
                }
                any = true;
            }
            at += len;
        }
        any
    }

    /// Returns the length and location of the next bytes from `at` (below `end`) with equal read
    /// access. Without read access, the location is `None`.
    pub(super) fn readable(&mut self, at: usize, end: usize) -> (usize, Option<usize>) {
        if at >= reg::ADDRESS_SPACE {
            return self.stretch(at, end, BufferOwner::ByDevice);
        }
        let end = end.min(reg::ADDRESS_SPACE);
        let answers = self.map.readable(at, end);
        if answers {
            self.before_read(at, end);
        }
        (end - at, answers.then_some(at))
    }

    /// Updates the registers that are computed on a read, and notes the events that the read
    /// acknowledges.
    fn before_read(&mut self, start: usize, end: usize) {
        let read = |first: u16, len: usize| overlaps(start, end, first, len);
        if end > usize::from(reg::DC_RECEIVE_TIMES) {
            self.before_dc_read(start, end);
        }
        if read(reg::ECAT_EVENT, 0x14) || read(reg::SM, 0x40) {
            self.show_sms();
        }
        for (register, event) in [
            (reg::AL_STATUS, super::event::AL_STATUS),
            (reg::DL_STATUS, super::event::DL_STATUS),
        ] {
            if read(register, 2) {
                self.frame.acknowledged |= event;
            }
        }
    }

    /// Reading the first byte freezes a value of several bytes.
    fn before_dc_read(&mut self, start: usize, end: usize) {
        let Some(dc) = &self.dc else { return };
        let first = |register: u16| (start..end).contains(&usize::from(register));
        let read = |first: u16, len: usize| overlaps(start, end, first, len);
        if read(reg::DC_SYSTEM_TIME, 8) {
            let time = dc.local_copy(self.frame.stamp);
            self.put(reg::DC_SYSTEM_TIME, &time.to_le_bytes());
        }
        let Some(dc) = &self.dc else { return };
        if first(reg::DC_DIFFERENCE) {
            let difference = dc.difference_register();
            self.put(reg::DC_DIFFERENCE, &difference.to_le_bytes());
        }
        let Some(dc) = &self.dc else { return };
        if read(reg::DC_SPEED_DIFF, 2) {
            let speed = dc.speed_register();
            self.put(reg::DC_SPEED_DIFF, &speed.to_le_bytes());
        }
        let Some(dc) = &self.dc else { return };
        if end <= usize::from(reg::DC_ACTIVATION) {
            return;
        }
        let (next0, next1) = (dc.sync.next_sync0(), dc.sync.next_sync1());
        let status = dc.sync.status();
        let waits = [dc.sync.waits(0), dc.sync.waits(1)].map(u8::from);
        let latches = dc.latches;
        self.put(reg::DC_ACTIVATION_STATUS, &[status]);
        self.put(reg::DC_SYNC_STATUS, &waits);
        if first(reg::DC_START_TIME) {
            self.put(reg::DC_START_TIME, &next0.to_le_bytes());
        }
        if first(reg::DC_NEXT_SYNC1) {
            self.put(reg::DC_NEXT_SYNC1, &next1.to_le_bytes());
        }
        self.put(reg::DC_LATCH_STATUS, &latches.map(|latch| latch.status()));
        for n in 0..4_u16 {
            let at = reg::DC_LATCH_TIMES + n * 8;
            let latch = latches.get(usize::from(n / 2));
            if let Some(latch) = latch.filter(|_| first(at)) {
                self.put(at, &latch.time(usize::from(n % 2)).to_le_bytes());
            }
            if read(at, 8) {
                self.frame.latches_read |= 1 << n;
            }
        }
    }

    /// Returns the length and memory location of the next RAM bytes from `at` (below `end`) with
    /// one owner. The location is `None` without access for the MainDevice. It reads bytes that the
    /// device fills, and writes bytes that it fills itself (`filled`).
    pub(super) fn stretch(
        &mut self,
        at: usize,
        end: usize,
        filled: BufferOwner,
    ) -> (usize, Option<usize>) {
        let memory = self.mem.len();
        if at >= memory || at >= reg::PROCESS_RAM && !self.loaded {
            return (end - at, None);
        }
        let mut end = end.min(memory);
        for n in 0..self.sms.len() {
            let Some(sm) = self.sms.get_mut(n).filter(|sm| sm.guards()) else {
                continue;
            };
            let area = sm.area();
            if area.contains(&at) {
                let len = area.end.min(end) - at;
                let (len, place) = sm.access(filled, at - area.start, len, memory);
                if place.is_some() {
                    self.frame.touched |= 1 << n;
                }
                return (len, place);
            }
            if area.start > at {
                end = end.min(area.start);
            }
        }
        if at < reg::PROCESS_RAM {
            let write = filled == BufferOwner::ByMainDevice;
            let (len, can) = self.map.run(at, end.min(reg::PROCESS_RAM), write);
            return (len, can.then_some(at));
        }
        (end - at, Some(at))
    }

    /// Writes `data`. Returns false if no byte is accepted.
    pub(super) fn write(&mut self, start: u16, data: &[u8]) -> bool {
        let start = usize::from(start);
        let end = start + data.len();
        if !self.may_write(start, end) {
            return false;
        }
        let mut any = false;
        let mut at = start;
        while at < end {
            if at < reg::ADDRESS_SPACE {
                let stop = end.min(reg::ADDRESS_SPACE);
                if let Some(bytes) = data.get(at - start..stop - start) {
                    any |= self.write_registers(at, bytes);
                }
                at = stop;
                continue;
            }
            let (len, place) = self.stretch(at, end, BufferOwner::ByMainDevice);
            let (from, to) = (at - start, at - start + len);
            if let (Some(place), Some(from)) = (place, data.get(from..to))
                && let Some(to) = self.mem.get_mut(place..place + len)
            {
                to.copy_from_slice(from);
                any = true;
            }
            at += len;
        }
        any
    }

    /// True if write protection permits a write.
    pub(super) fn may_write(&self, start: usize, end: usize) -> bool {
        let protected = |register| self.byte_at(register) & 1 != 0;
        let registers = protected(reg::WRITE_PROTECTION);
        let all = protected(reg::ESC_WRITE_PROTECTION);
        self.guard.allows(start, end, registers, all)
    }

    /// Stores the permitted writes in the shadow buffer. Returns false if there are none.
    pub(super) fn write_registers(&mut self, start: usize, data: &[u8]) -> bool {
        self.guard.note(start, data);
        if start == usize::from(reg::DC_SYSTEM_TIME) && self.dc.is_some() {
            return self.write_system_time(data);
        }
        if self.map.freely_writable(start, start + data.len()) {
            self.shadow.push(start, data);
            return !data.is_empty();
        }
        let mut any = false;
        let mut at = 0;
        while at < data.len() {
            let accepted = (at..data.len())
                .take_while(|n| self.accepts(start + n))
                .count();
            if let Some(bytes) = data.get(at..at + accepted).filter(|b| !b.is_empty()) {
                self.shadow.push(start + at, bytes);
                any = true;
            }
            at += accepted + 1;
        }
        any
    }

    /// Passes four bytes to the control loop. Bytes that were not written come from the local copy.
    fn write_system_time(&mut self, data: &[u8]) -> bool {
        let Some(dc) = self.dc.as_ref().filter(|dc| !dc.ignores_time) else {
            return false;
        };
        let mut received = (dc.local_copy(self.frame.stamp) as u32).to_le_bytes();
        for (to, from) in received.iter_mut().zip(data) {
            *to = *from;
        }
        self.frame.received = Some(u32::from_le_bytes(received));
        if let Some(rest) = data.get(8..).filter(|rest| !rest.is_empty()) {
            self.write_registers(usize::from(reg::DC_RECEIVE_TIME_PU), rest);
        }
        !data.is_empty()
    }

    fn accepts(&self, at: usize) -> bool {
        self.map.writable(at) && (!self.map.conditional(at) || self.condition(at))
    }

    /// True if other registers permit a write to this one.
    fn condition(&self, at: usize) -> bool {
        let within = |first: u16, len: usize| overlaps(at, at + 1, first, len);
        let cyclic_control = || self.byte_at(reg::DC_CYCLIC_CONTROL);
        if within(reg::AL_CONTROL, 2) {
            return !self.al_locked;
        }
        if within(reg::EEPROM_CONTROL, 14) {
            return !self.eeprom.is_busy() && !self.device_has_eeprom();
        }
        if within(reg::SM, 0x80) {
            let n = (at - usize::from(reg::SM)) / 8;
            return self.sms.get(n).is_some_and(|sm| !sm.enabled);
        }
        // SYNC1 may belong to the other side than SYNC0.
        if within(reg::DC_SYNC1_CYCLE, 4) {
            return matches!(cyclic_control() & 3, 0 | 3);
        }
        if within(reg::DC_LATCH_CONTROL, 1) {
            return cyclic_control() & 0x10 == 0;
        }
        if within(reg::DC_LATCH_CONTROL + 1, 1) {
            return cyclic_control() & 0x20 == 0;
        }
        cyclic_control() & 1 == 0
    }
}

/// True if `start..end` overlaps the `len` bytes from `first` on.
pub(super) fn overlaps(start: usize, end: usize, first: u16, len: usize) -> bool {
    let first = usize::from(first);
    start < first + len && first < end
}
