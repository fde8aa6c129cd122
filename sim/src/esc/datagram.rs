//! The start and end of a frame: register writes take effect, buffers change owner, events are
//! acknowledged.

use super::access::overlaps;
use super::dc::sync::Edges;
use super::registers as reg;
use super::{Esc, al, event, fmmu};
use crate::Nanos;

/// The state of the current frame.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Frame {
    now: Nanos,
    local: u64,
    /// The local time stamp of the first byte of the frame.
    pub(super) stamp: u64,
    /// The event request that every datagram receives.
    pub(super) irq: u16,
    /// Event bits that a read acknowledged.
    pub(super) acknowledged: u16,
    /// Bit per latch time register that was read.
    pub(super) latches_read: u8,
    /// Bit per SyncManager that permitted an access.
    pub(super) touched: u8,
    /// The value written to 0x0910. The control loop compares it with the time at the start of the
    /// frame.
    pub(super) received: Option<u32>,
    /// True if BWR or FPWR wrote 0x0900: all ports then latch their receive times.
    pub(super) latches_ports: bool,
}

impl Esc {
    /// Returns station address and alias if frames to other addresses neither change this device
    /// nor are changed by it.
    pub(crate) fn addresses(&self) -> Option<(u16, Option<u16>)> {
        let quiet = self.u16_at(reg::ECAT_EVENT_MASK) == 0
            && self.jitter.is_none()
            && self.guard.is_idle()
            && !self.eeprom_write_enable
            && !self.dl_control_changed();
        quiet.then_some((self.station, self.alias))
    }

    /// Starts a frame whose first byte arrives at `now`. All datagrams use this time. Returns it as
    /// local time.
    pub fn begin_frame(&mut self, now: Nanos) -> u64 {
        let local = self.clock.local(now);
        let mask = self.u16_at(reg::ECAT_EVENT_MASK);
        if mask & event::SYNC_MANAGERS != 0 {
            self.show_sms();
        }
        self.frame = Frame {
            now,
            local,
            stamp: self.jitter.stamp(local),
            irq: self.u16_at(reg::ECAT_EVENT) & mask,
            ..Frame::default()
        };
        self.guard.begin_frame();
        self.end_eeprom_write_enable();
        local
    }

    /// Ends a frame that was received without errors.
    pub fn end_frame(&mut self) {
        let frame = self.frame;
        if let (Some(received), Some(dc)) = (frame.received, &mut self.dc) {
            dc.compare(&mut self.clock, frame.now, frame.stamp, received);
        }
        if !self.shadow.is_empty() {
            let mut shadow = std::mem::take(&mut self.shadow);
            for (start, data) in shadow.writes() {
                self.apply(start, data);
            }
            shadow.clear();
            self.shadow = shadow;
        }
        if frame.touched != 0 {
            self.hand_over(frame.touched);
        }
        if frame.acknowledged != 0 {
            let events = self.u16_at(reg::ECAT_EVENT) & !frame.acknowledged;
            self.put(reg::ECAT_EVENT, &events.to_le_bytes());
        }
        if frame.latches_read != 0 {
            self.acknowledge_latches(frame.latches_read);
        }
        if let Some(progress) = self.guard.end_frame() {
            self.put(reg::RESET, &[progress & 3]);
            self.raised.reset |= progress == 3;
        }
    }

    /// Hands over buffers and mailboxes whose last byte was accessed.
    fn hand_over(&mut self, touched: u8) {
        self.sms_stale = true;
        let mut timed = false;
        let mut left = touched;
        while left != 0 {
            let n = left.trailing_zeros() as u8;
            left &= left - 1;
            let Some(sm) = self.sms.get_mut(usize::from(n)) else {
                continue;
            };
            if !sm.end_frame() {
                continue;
            }
            let written = sm.filled == super::sm::BufferOwner::ByMainDevice;
            let triggers = written && sm.watchdog;
            timed |= self.byte_at(reg::SM + u16::from(n) * 8 + 6) & 0x40 != 0;
            if written {
                self.raised.sm_written |= 1 << n;
            } else {
                self.raised.sm_read |= 1 << n;
            }
            if triggers {
                let divider = self.u16_at(reg::WD_DIVIDER);
                let count = self.u16_at(reg::WD_PROCESS_DATA);
                self.watchdog.trigger(self.frame.local, divider, count);
                self.put(reg::WD_STATUS, &[1]);
            }
        }
        if timed && self.dc.is_some() {
            let stamp = self.frame.stamp as u32;
            self.put(reg::DC_BUFFER_CHANGE, &stamp.to_le_bytes());
        }
    }

    /// Applies one register write.
    fn apply(&mut self, start: usize, data: &[u8]) {
        let end = start + data.len();
        let touched = |first: u16, len: usize| overlaps(start, end, first, len);
        if start >= usize::from(reg::DC_RECEIVE_TIMES) {
            return self.apply_dc(start, data);
        }
        // The written value does not matter for counters.
        let counters = overlaps(start, end, reg::RX_ERRORS, 0x14);
        if let Some(to) = self.mem.get_mut(start..end).filter(|_| !counters) {
            to.copy_from_slice(data);
        }
        match start {
            // In the order of addresses; a write may span several.
            0x0000..0x0200 => {
                if touched(reg::STATION_ADDRESS, 2) {
                    self.station = self.u16_at(reg::STATION_ADDRESS);
                }
                for register in [reg::WRITE_ENABLE, reg::ESC_WRITE_ENABLE, reg::RESET] {
                    if touched(register, 1) {
                        self.put(register, &[0]);
                    }
                }
                if touched(reg::DL_CONTROL, 4) {
                    self.dl_control_written(touched(reg::DL_CONTROL + 1, 1));
                    self.take_alias();
                }
                if touched(reg::AL_CONTROL, 2) {
                    self.al_control();
                }
            }
            0x0200..0x0500 => {
                self.clear_counters(touched);
                if touched(reg::WD_PROCESS_DATA, 2) && self.u16_at(reg::WD_PROCESS_DATA) == 0 {
                    self.watchdog.stop();
                    self.put(reg::WD_STATUS, &[1]);
                }
                if touched(reg::WD_COUNTER, 2) {
                    self.put(reg::WD_COUNTER, &[0; 2]);
                }
            }
            0x0500..0x0600 => self.apply_eeprom(start, data),
            0x0600..0x0800 => {
                let all = 16 * fmmu::COUNT;
                let from = usize::from(reg::FMMU);
                let registers = self.mem.get(from..from + all).unwrap_or_default();
                self.fmmus.configure(registers);
            }
            _ => self.apply_sms(start, end),
        }
    }

    /// Applies the alias in 0x0012, which is valid while DL control bit 24 is set.
    pub(super) fn take_alias(&mut self) {
        let enabled = self.u32_at(reg::DL_CONTROL) & 0x0100_0000 != 0;
        self.alias = enabled.then(|| self.u16_at(reg::STATION_ALIAS));
    }

    fn al_control(&mut self) {
        let control = self.u16_at(reg::AL_CONTROL) & (0x0f | al::ERROR | al::DEVICE_ID);
        self.put(reg::AL_CONTROL, &control.to_le_bytes());
        self.raised.al_control = Some(control);
        if self.emulates_device() {
            // With device emulation, the controller answers itself and copies all bits.
            self.put_al_status(control);
        } else {
            self.al_locked = true;
            self.al_event(event::AL_CONTROL, true);
        }
    }

    fn apply_eeprom(&mut self, start: usize, data: &[u8]) {
        let end = start + data.len();
        let touched = |first: u16, len: usize| overlaps(start, end, first, len);
        if touched(reg::EEPROM_CONFIG, 1) && self.byte_at(reg::EEPROM_CONFIG) & 2 != 0 {
            self.put(reg::EEPROM_PDI_ACCESS, &[0]);
        }
        if touched(reg::EEPROM_CONTROL, 1) {
            self.eeprom_write_enable = self.byte_at(reg::EEPROM_CONTROL) & 1 != 0;
        }
        if touched(reg::EEPROM_CONTROL + 1, 1) {
            let command = u16::from(self.byte_at(reg::EEPROM_CONTROL + 1)) << 8;
            let control = command | u16::from(self.eeprom_write_enable);
            let word = self.u16_at(reg::EEPROM_DATA).to_le_bytes();
            let address = self.u32_at(reg::EEPROM_ADDRESS);
            self.eeprom
                .command(control, address, word, self.frame.local);
        }
        self.refresh_eeprom();
    }

    fn apply_sms(&mut self, start: usize, end: usize) {
        for n in 0..self.sms.len() {
            let base = reg::SM + n as u16 * 8;
            if !overlaps(start, end, base, 8) {
                continue;
            }
            let Ok(r) = <[u8; 8]>::try_from(self.bytes(base, 8)) else {
                continue;
            };
            let Some(sm) = self.sms.get_mut(n) else {
                continue;
            };
            sm.configure(&r);
            let asks = sm.enabled && sm.mode == super::sm::Mode::Mailbox;
            if asks && sm.filled == super::sm::BufferOwner::ByDevice {
                self.raised.repeat_request = Some(r[6] & 2 != 0);
            }
            self.refresh_sm(n);
            self.raised.sm_configured = true;
            if overlaps(start, end, base + 6, 1) {
                self.al_event(event::SM_ACTIVATION, true);
            }
        }
    }

    fn apply_dc(&mut self, start: usize, data: &[u8]) {
        let end = start + data.len();
        let touched = |first: u16, len: usize| overlaps(start, end, first, len);
        let Frame { now, local, .. } = self.frame;
        if touched(reg::DC_RECEIVE_TIMES, 4) {
            return self.latch_arrival();
        }
        if let Some(to) = self.mem.get_mut(start..end) {
            to.copy_from_slice(data);
        }
        let offset = self.u64_at(reg::DC_OFFSET);
        let delay = self.u32_at(reg::DC_DELAY);
        let speed_start = self.u16_at(reg::DC_SPEED_START);
        let filters = [
            self.byte_at(reg::DC_FILTER),
            self.byte_at(reg::DC_FILTER + 1),
        ];
        let activation = self.byte_at(reg::DC_ACTIVATION);
        let start_time = self.u64_at(reg::DC_START_TIME);
        let cycles = [reg::DC_SYNC0_CYCLE, reg::DC_SYNC1_CYCLE].map(|at| self.u32_at(at));
        let latch_control = self.u16_at(reg::DC_LATCH_CONTROL).to_le_bytes();
        let enhanced = self.config.info.has(super::chip::feature::ENHANCED_SYNC);
        let Some(dc) = &mut self.dc else { return };
        dc.delay = delay;
        dc.set_offset(offset, local);
        if touched(reg::DC_SPEED_START, 2) {
            dc.restart(&mut self.clock, now, speed_start);
        }
        if touched(reg::DC_FILTER, 2) {
            dc.set_filters(filters);
        }
        [dc.sync.cycle0, dc.sync.cycle1] = cycles;
        for (latch, control) in dc.latches.iter_mut().zip(latch_control) {
            latch.control = control & 3;
        }
        let system = dc.system(local);
        let mut edges = Edges::default();
        if touched(reg::DC_ACTIVATION, 1) {
            edges = dc
                .sync
                .write_activation(activation, enhanced, local, system);
        }
        if touched(reg::DC_START_TIME, 8) {
            let low = touched(reg::DC_START_TIME + 3, 1);
            let complete = touched(reg::DC_START_TIME + 7, 1);
            dc.sync
                .write_start(start_time, low, complete, local, system);
        }
        let activation = dc.sync.activation();
        self.put(reg::DC_ACTIVATION, &[activation]);
        if touched(reg::DC_ACTIVATION, 1) || touched(reg::DC_START_TIME, 8) {
            self.raised.sync_changed = true;
            self.raised.ping = edges;
        }
    }

    /// Latches the receive time at the processing unit, on every write. For BWR and FPWR, the
    /// network also latches the times at the ports.
    fn latch_arrival(&mut self) {
        self.latch |= self.frame.latches_ports;
        if self.dc.is_some() {
            let stamp = self.frame.stamp;
            self.put(reg::DC_RECEIVE_TIME_PU, &stamp.to_le_bytes());
        }
    }

    /// Returns the time stamp of an arrival at `now`. The current frame has its own stamp.
    pub(super) fn stamp(&mut self, now: Nanos) -> u64 {
        if now == self.frame.now {
            return self.frame.stamp;
        }
        let local = self.clock.local(now);
        self.jitter.stamp(local)
    }

    /// Acknowledges latch events after the MainDevice read the latch times (bit per register).
    /// Applies only to units that the MainDevice controls.
    fn acknowledge_latches(&mut self, read: u8) {
        let control = self.byte_at(reg::DC_CYCLIC_CONTROL);
        let Some(dc) = &mut self.dc else { return };
        for n in (0..4).filter(|n| read >> n & 1 != 0) {
            let unit = n / 2;
            if let Some(latch) = dc.latches.get_mut(unit)
                && control >> (4 + unit) & 1 == 0
            {
                latch.acknowledge(n % 2);
            }
        }
        self.refresh_latch_events();
    }
}
