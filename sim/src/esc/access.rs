//! Physical reads and writes with their side effects.

use super::registers as reg;
use super::sm::{Access, Filled, Mode};
use super::{Esc, al};
use crate::Nanos;

/// What happens to the datagram's bytes on a read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Combine {
    Replace,
    Or,
}

impl Esc {
    /// Reads into `out`; false where the access is not answered.
    pub(super) fn read(
        &mut self,
        start: u16,
        out: &mut [u8],
        combine: Combine,
        local: u64,
    ) -> bool {
        let (start, len) = (usize::from(start), out.len());
        if !self.begin_read(start, len, local) {
            return false;
        }
        let Some(from) = self.mem.get(start..start + len) else {
            return false;
        };
        match combine {
            Combine::Replace => out.copy_from_slice(from),
            Combine::Or => out.iter_mut().zip(from).for_each(|(to, from)| *to |= from),
        }
        self.end_read(start, len);
        true
    }

    pub(super) fn begin_read(&mut self, start: usize, len: usize, local: u64) -> bool {
        if len == 0 || start + len > self.mem.len() {
            return false;
        }
        if start < reg::ADDRESS_SPACE {
            if start + len > reg::ADDRESS_SPACE || !self.map.readable(start, len) {
                return false;
            }
            if let Some(dc) = &self.dc
                && overlaps(start, len, reg::DC_SYSTEM_TIME, 8)
            {
                let time = dc.local_copy(local);
                self.put(reg::DC_SYSTEM_TIME, &time.to_le_bytes());
            }
            return true;
        }
        !self
            .sms
            .iter()
            .any(|sm| sm.overlaps(start, len) && sm.may_read(start, len) == Access::Denied)
    }

    pub(super) fn end_read(&mut self, start: usize, len: usize) {
        if start < reg::ADDRESS_SPACE {
            for (register, event) in [(reg::AL_STATUS, 0x08_u16), (reg::DL_STATUS, 0x04)] {
                if overlaps(start, len, register, 2) {
                    let events = self.u16_at(reg::ECAT_EVENT) & !event;
                    self.put(reg::ECAT_EVENT, &events.to_le_bytes());
                }
            }
            return;
        }
        for n in 0..self.sms.len() {
            let sm = &mut self.sms[n];
            if sm.mode == Mode::Mailbox && sm.overlaps(start, len) {
                let access = sm.may_read(start, len);
                sm.did_read(access);
                if access == Access::Completes {
                    self.raised.sm_read |= 1 << n;
                    self.refresh_sm(n);
                }
            }
        }
    }

    /// Writes `data`; false where the access is not accepted.
    pub(super) fn write(&mut self, start: u16, data: &[u8], now: Nanos, local: u64) -> bool {
        let (start, len) = (usize::from(start), data.len());
        if start < reg::ADDRESS_SPACE {
            return self.write_registers(start, data, now, local);
        }
        if !self.begin_write(start, len) {
            return false;
        }
        if let Some(to) = self.mem.get_mut(start..start + len) {
            to.copy_from_slice(data);
        }
        self.end_write(start, len, local);
        true
    }

    /// Whether process RAM takes these bytes.
    pub(super) fn begin_write(&self, start: usize, len: usize) -> bool {
        len > 0
            && start >= reg::ADDRESS_SPACE
            && start + len <= self.mem.len()
            && !self
                .sms
                .iter()
                .any(|sm| sm.overlaps(start, len) && sm.may_write(start, len) == Access::Denied)
    }

    pub(super) fn end_write(&mut self, start: usize, len: usize, local: u64) {
        for n in 0..self.sms.len() {
            let sm = &mut self.sms[n];
            if !sm.overlaps(start, len) {
                continue;
            }
            let access = sm.may_write(start, len);
            sm.did_write(access);
            if access == Access::Completes {
                let watchdog = sm.watchdog && sm.mode == Mode::Buffered;
                self.raised.sm_written |= 1 << n;
                self.refresh_sm(n);
                if watchdog {
                    let divider = self.u16_at(reg::WD_DIVIDER);
                    let count = self.u16_at(reg::WD_PROCESS_DATA);
                    self.watchdog.trigger(local, divider, count);
                    self.put(reg::WD_STATUS, &[1]);
                }
            }
        }
    }

    fn write_registers(&mut self, start: usize, data: &[u8], now: Nanos, local: u64) -> bool {
        let len = data.len();
        if len == 0
            || start + len > reg::ADDRESS_SPACE
            || !self.map.writable(start, len)
            || self.eeprom_locked(start, len)
        {
            return false;
        }
        if overlaps(start, len, reg::AL_CONTROL, 2) {
            // The upper byte is optional.
            let low = byte_at(start, data, reg::AL_CONTROL).unwrap_or(0);
            let control = u16::from(low) & (0x0f | al::ERROR | al::DEVICE_ID);
            self.put(reg::AL_CONTROL, &control.to_le_bytes());
            self.raised.al_control = Some(control);
        }
        if overlaps(start, len, reg::DC_RECEIVE_TIMES, 4) {
            self.latch_arrival(local);
        }
        if overlaps(start, len, reg::DC_SYSTEM_TIME, 4) {
            let skip = usize::from(reg::DC_SYSTEM_TIME).saturating_sub(start);
            if let (Some(Ok(raw)), Some(dc)) = (
                data.get(skip..skip + 4).map(<[u8; 4]>::try_from),
                &mut self.dc,
            ) {
                dc.compare(&mut self.clock, now, local, u32::from_le_bytes(raw));
                let (difference, speed) = (dc.difference_register(), dc.speed_register());
                self.put(reg::DC_DIFFERENCE, &difference.to_le_bytes());
                self.put(reg::DC_SPEED_DIFF, &speed.to_le_bytes());
            }
        }
        for (address, value) in (start..).zip(data) {
            let special = (usize::from(reg::DC_RECEIVE_TIMES)..0x0918).contains(&address)
                || overlaps(address, 1, reg::RX_ERRORS, 0x14)
                || overlaps(address, 1, reg::AL_CONTROL, 2);
            if !special && self.map.writable(address, 1) {
                self.mem[address] = *value;
            }
        }
        self.after_register_write(start, data, now, local);
        true
    }

    /// The device's side owns the EEPROM: only 0x0500 still answers to writes.
    fn eeprom_locked(&self, start: usize, len: usize) -> bool {
        start > usize::from(reg::EEPROM_CONFIG)
            && overlaps(start, len, reg::EEPROM_CONTROL, 14)
            && self
                .bytes(reg::EEPROM_CONFIG, 1)
                .first()
                .is_some_and(|b| b & 1 != 0)
    }

    fn latch_arrival(&mut self, local: u64) {
        if self.dc.is_some() {
            self.put(reg::DC_RECEIVE_TIME_PU, &local.to_le_bytes());
        }
        self.latch = true;
    }

    fn after_register_write(&mut self, start: usize, data: &[u8], now: Nanos, local: u64) {
        let len = data.len();
        let touched = |first: u16, n: usize| overlaps(start, len, first, n);
        if touched(reg::STATION_ADDRESS, 2) {
            self.station = self.u16_at(reg::STATION_ADDRESS);
        }
        if touched(reg::DL_CONTROL, 4) {
            self.dl_control_written(touched(reg::DL_CONTROL + 1, 1));
            let enabled = self.u32_at(reg::DL_CONTROL) & 0x0100_0000 != 0;
            self.alias = enabled.then(|| self.u16_at(reg::STATION_ALIAS));
        }
        self.clear_counters(touched);
        if touched(reg::WD_COUNTER, 2) {
            self.put(reg::WD_COUNTER, &[0; 2]);
        }
        if touched(reg::EEPROM_CONTROL, 2) {
            let word = |at: u16| self.u16_at(at);
            let written = byte_at(start, data, reg::EEPROM_CONTROL + 1).map_or(0, u16::from);
            let control = word(reg::EEPROM_CONTROL) & 0xff | written << 8;
            let data = word(reg::EEPROM_DATA).to_le_bytes();
            self.eeprom
                .command(control, self.u32_at(reg::EEPROM_ADDRESS), data, local);
            self.put(reg::EEPROM_CONTROL, &[0, 0]);
            self.refresh_eeprom();
        }
        if touched(reg::FMMU, 0x80) {
            self.parse_fmmus();
        }
        if touched(reg::SM, 0x40) {
            self.parse_sms(start, len);
        }
        if self.dc.is_some() && start >= usize::from(reg::DC_SYSTEM_TIME) {
            self.after_dc_write(start, len, now, local);
        }
    }

    fn parse_fmmus(&mut self) {
        for (fmmu, r) in self
            .fmmus
            .iter_mut()
            .zip(self.mem[usize::from(reg::FMMU)..].chunks_exact(16))
        {
            *fmmu = r.try_into().ok().and_then(super::Fmmu::from_registers);
        }
    }

    fn parse_sms(&mut self, start: usize, len: usize) {
        for n in 0..self.sms.len() {
            let base = reg::SM + n as u16 * 8;
            if !overlaps(start, len, base, 8) {
                continue;
            }
            let Ok(r) = <[u8; 8]>::try_from(self.bytes(base, 8)) else {
                continue;
            };
            let sm = &mut self.sms[n];
            let was_enabled = sm.enabled;
            sm.configure(&r);
            if was_enabled {
                // An enabled SyncManager kept its configuration; show what counts.
                let (start, len) = (sm.start.to_le_bytes(), sm.len.to_le_bytes());
                let kept = [start[0], start[1], len[0], len[1], sm.control];
                self.put(base, &kept);
            }
            self.refresh_sm(n);
            self.raised.sm_configured = true;
            let sm = &self.sms[n];
            if sm.mode == Mode::Mailbox && sm.filled == Filled::ByDevice && sm.enabled {
                self.raised.repeat_request = Some(r[6] & 2 != 0);
            }
        }
    }

    fn after_dc_write(&mut self, start: usize, len: usize, now: Nanos, local: u64) {
        let touched = |first: u16, n: usize| overlaps(start, len, first, n);
        let offset = self.u64_at(reg::DC_OFFSET);
        let delay = self.u32_at(reg::DC_DELAY);
        let depth = self.bytes(reg::DC_FILTER, 1).first().copied().unwrap_or(0);
        let activation = self
            .bytes(reg::DC_ACTIVATION, 1)
            .first()
            .copied()
            .unwrap_or(0);
        let start_time = self.u64_at(reg::DC_START_TIME);
        let cycle = self.u32_at(reg::DC_SYNC0_CYCLE);
        let Some(dc) = &mut self.dc else { return };
        dc.offset = offset;
        dc.delay = delay;
        if touched(reg::DC_SPEED_START, 2) || touched(reg::DC_FILTER, 2) {
            dc.reset_loop(&mut self.clock, now, depth);
        }
        if touched(reg::DC_ACTIVATION, 1) {
            dc.activate(activation, start_time, cycle, local);
            self.raised.sync_changed = true;
        }
    }
}

pub(super) fn overlaps(start: usize, len: usize, first: u16, n: usize) -> bool {
    let first = usize::from(first);
    start < first + n && first < start + len
}

fn byte_at(start: usize, data: &[u8], address: u16) -> Option<u8> {
    data.get(usize::from(address).checked_sub(start)?).copied()
}
