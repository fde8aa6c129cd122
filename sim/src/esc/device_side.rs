//! The controller as the device's own side (PDI) sees it: registers without access rights, buffers, states, pulses,
//! inputs with time stamps.

use super::al::{self, AlState};
use super::dc::sync::Edges;
use super::eeprom::{self, Finished};
use super::registers as reg;
use super::sm::{Filled, SyncManager};
use super::{Esc, event};

impl Esc {
    /// Register or RAM contents.
    #[must_use]
    pub fn bytes(&self, start: u16, len: u16) -> &[u8] {
        let start = usize::from(start);
        self.mem
            .get(start..start + usize::from(len))
            .unwrap_or_default()
    }

    pub(crate) fn put(&mut self, start: u16, bytes: &[u8]) {
        let start = usize::from(start);
        if let Some(to) = self.mem.get_mut(start..start + bytes.len()) {
            to.copy_from_slice(bytes);
        }
    }

    pub(crate) fn bytes_mut(&mut self, start: u16, len: u16) -> &mut [u8] {
        let start = usize::from(start);
        self.mem
            .get_mut(start..start + usize::from(len))
            .unwrap_or_default()
    }

    pub(crate) fn byte_at(&self, at: u16) -> u8 {
        self.mem.get(usize::from(at)).copied().unwrap_or(0)
    }

    pub(crate) fn u16_at(&self, at: u16) -> u16 {
        self.bytes(at, 2).try_into().map_or(0, u16::from_le_bytes)
    }

    pub(crate) fn u32_at(&self, at: u16) -> u32 {
        self.bytes(at, 4).try_into().map_or(0, u32::from_le_bytes)
    }

    pub(crate) fn u64_at(&self, at: u16) -> u64 {
        self.bytes(at, 8).try_into().map_or(0, u64::from_le_bytes)
    }

    /// Whether the EEPROM's configuration was sound: without it no application runs.
    #[must_use]
    pub fn is_loaded(&self) -> bool {
        self.loaded
    }

    /// Device emulation (0x0141 bit 0): nobody stands behind the controller, and AL status follows AL control by
    /// itself, as in simple I/O terminals.
    #[must_use]
    pub fn emulates_device(&self) -> bool {
        self.loaded && self.byte_at(reg::ESC_CONFIGURATION) & 1 != 0
    }

    pub(super) fn enhanced_link_detection(&self) -> bool {
        self.byte_at(reg::ESC_CONFIGURATION) & 0xf2 != 0
    }

    // Events

    pub(crate) fn ecat_event(&mut self, bits: u16) {
        let events = self.u16_at(reg::ECAT_EVENT) | bits;
        self.put(reg::ECAT_EVENT, &events.to_le_bytes());
    }

    pub(crate) fn al_event(&mut self, bits: u32, on: bool) {
        let events = self.u32_at(reg::AL_EVENT);
        let events = if on { events | bits } else { events & !bits };
        self.put(reg::AL_EVENT, &events.to_le_bytes());
    }

    // Application layer

    /// The device reads AL control, and the MainDevice may write it again.
    pub(crate) fn read_al_control(&mut self) {
        self.al_locked = false;
        self.al_event(event::AL_CONTROL, false);
    }

    /// AL status and its code, as the application sets them.
    pub(crate) fn set_al(&mut self, state: AlState, code: u16) {
        let error = if code == 0 { 0 } else { al::ERROR };
        self.put_al_status(u16::from(state.code()) | error);
        self.put(reg::AL_STATUS_CODE, &code.to_le_bytes());
    }

    pub(crate) fn put_al_status(&mut self, status: u16) {
        if self.u16_at(reg::AL_STATUS) != status {
            self.put(reg::AL_STATUS, &status.to_le_bytes());
            self.ecat_event(event::AL_STATUS);
        }
    }

    // EEPROM

    /// 0x0500 offers the EEPROM to the device, or the device has taken it.
    pub(super) fn device_has_eeprom(&self) -> bool {
        (self.byte_at(reg::EEPROM_CONFIG) | self.byte_at(reg::EEPROM_PDI_ACCESS)) & 1 != 0
    }

    /// The device takes or gives back the EEPROM (0x0501). It is given only what is offered; true if it has it
    /// afterwards.
    pub fn claim_eeprom(&mut self, claim: bool) -> bool {
        let forced_off = self.byte_at(reg::EEPROM_CONFIG) & 2 != 0;
        if self.device_has_eeprom() && !forced_off {
            self.put(reg::EEPROM_PDI_ACCESS, &[u8::from(claim)]);
        }
        self.refresh_eeprom();
        self.byte_at(reg::EEPROM_PDI_ACCESS) & 1 != 0
    }

    pub(super) fn end_eeprom_write_enable(&mut self) {
        if std::mem::take(&mut self.eeprom_write_enable) {
            self.refresh_eeprom();
        }
    }

    pub(super) fn refresh_eeprom(&mut self) {
        let not_loaded = if self.loaded { 0 } else { eeprom::NOT_LOADED };
        let enabled = self.eeprom_write_enable || self.device_has_eeprom();
        let enable = if enabled { eeprom::WRITE_ENABLE } else { 0 };
        let status = self.eeprom.status() | not_loaded | enable;
        self.put(reg::EEPROM_CONTROL, &status.to_le_bytes());
    }

    /// The job under way is over.
    pub(crate) fn finish_eeprom(&mut self) {
        match self.eeprom.finish() {
            Some(Finished::Read(data, len)) => {
                self.put(reg::EEPROM_DATA, data.get(..len).unwrap_or(&data));
            }
            Some(Finished::Reloaded) => {
                self.load_configuration();
                self.show_ports();
            }
            Some(Finished::Written) | None => {}
        }
        self.refresh_eeprom();
    }

    // SyncManagers

    /// A SyncManager was filled or emptied. Registers show it when they are read.
    pub(crate) fn refresh_sm(&mut self, n: usize) {
        if let Some(sm) = self.sms.get_mut(n) {
            sm.note_full();
            self.sms_stale = true;
        }
    }

    /// Shows the SyncManagers' status, and the events that follow from it, in the registers.
    pub(super) fn show_sms(&mut self) {
        if !std::mem::take(&mut self.sms_stale) {
            return;
        }
        let (mut main_device, mut device) = (0_u16, 0_u32);
        let base = usize::from(reg::SM);
        for (n, sm) in self.sms.iter().enumerate() {
            if let Some([status, _, control]) = self.mem.get_mut(base + n * 8 + 5..base + n * 8 + 8)
            {
                *status = sm.status();
                *control = *control & !1 | u8::from(sm.closed_by_device);
            }
            main_device |= u16::from(sm.main_device_event()) << (4 + n);
            device |= u32::from(sm.device_event()) << (8 + n);
        }
        let events = self.u16_at(reg::ECAT_EVENT) & !event::SYNC_MANAGERS | main_device;
        self.put(reg::ECAT_EVENT, &events.to_le_bytes());
        let events = self.u32_at(reg::AL_EVENT) & !event::DEVICE_SYNC_MANAGERS | device;
        self.put(reg::AL_EVENT, &events.to_le_bytes());
    }

    /// Opens or closes a SyncManager (0x0807 bit 0); either empties it.
    pub(crate) fn close_sm(&mut self, n: usize, closed: bool) {
        if let Some(sm) = self.sms.get_mut(n) {
            sm.close(closed);
            self.refresh_sm(n);
        }
    }

    /// The buffer that the device fills next, in a SyncManager that it may fill.
    pub(crate) fn fill_buffer(&mut self, n: usize) -> Option<&mut [u8]> {
        let memory = self.mem.len();
        let fills = |sm: &&SyncManager| sm.is_open() && sm.filled == Filled::ByDevice && !sm.full;
        let sm = self.sms.get(n).filter(fills)?;
        let (at, len) = (sm.device_writes_at(memory), usize::from(sm.len));
        self.mem.get_mut(at..at + len)
    }

    /// That buffer is complete, at this local time.
    pub(crate) fn filled_buffer(&mut self, n: usize, local: u64) {
        if let Some(sm) = self.sms.get_mut(n) {
            sm.device_wrote();
            self.sms_stale = true;
            self.stamp_device_access(n, local);
        }
    }

    /// What the MainDevice wrote last, completely; `None` where it has not.
    pub(crate) fn fetch_buffer(&mut self, n: usize, local: u64) -> Option<&[u8]> {
        let memory = self.mem.len();
        let fetches = |sm: &&mut SyncManager| sm.filled == Filled::ByMainDevice && sm.has_data();
        let sm = self.sms.get_mut(n).filter(fetches)?;
        let (at, len) = (sm.device_reads_at(memory), usize::from(sm.len));
        self.sms_stale = true;
        self.stamp_device_access(n, local);
        self.mem.get(at..at + len)
    }

    /// Last complete contents, without fetching them.
    #[must_use]
    pub fn latest_buffer(&self, n: usize) -> &[u8] {
        let Some(sm) = self.sms.get(n) else {
            return &[];
        };
        let at = sm.latest_at(self.mem.len());
        self.mem
            .get(at..at + usize::from(sm.len))
            .unwrap_or_default()
    }

    /// 0x09F8 and 0x09FC, where the SyncManager asks for it.
    fn stamp_device_access(&mut self, n: usize, local: u64) {
        let activate = self.byte_at(reg::SM + n as u16 * 8 + 6);
        if activate & 0x80 != 0 && self.dc.is_some() {
            let local = (local as u32).to_le_bytes();
            self.put(reg::DC_PDI_BUFFER_START, &local);
            self.put(reg::DC_PDI_BUFFER_CHANGE, &local);
        }
    }

    // Watchdogs

    /// The process data watchdog has expired.
    pub(crate) fn expire_watchdog(&mut self) {
        self.watchdog.expire();
        self.put(reg::WD_STATUS, &[0]);
        self.count_up(reg::WD_COUNTER);
        self.al_event(event::WATCHDOG, true);
    }

    /// Error counters stop at 255.
    pub(super) fn count_up(&mut self, register: u16) {
        let count = self.byte_at(register).saturating_add(1);
        self.put(register, &[count]);
    }

    /// There is a process data interface, and it is in use.
    pub(super) fn pdi_runs(&self) -> bool {
        self.loaded && self.byte_at(reg::PDI_CONTROL) != 0 && !self.pdi_watchdog.expired()
    }

    /// The device's own side stops at this local time, or goes on: nothing triggers the PDI watchdog.
    pub(crate) fn pdi_stops(&mut self, stops: bool, local: u64) {
        if stops {
            let divider = self.u16_at(reg::WD_DIVIDER);
            let count = self.u16_at(reg::WD_PDI);
            self.pdi_watchdog.trigger(local, divider, count);
        } else {
            self.pdi_watchdog.stop();
            self.show_ports();
        }
    }

    #[must_use]
    pub(crate) fn pdi_watchdog_due(&self) -> u64 {
        self.pdi_watchdog.due()
    }

    pub(crate) fn expire_pdi_watchdog(&mut self) {
        self.pdi_watchdog.expire();
        self.count_up(reg::WD_COUNTER_PDI);
        self.show_ports();
    }

    // Distributed clocks

    /// SYNC pulses due at this local time.
    pub(crate) fn fire_sync(&mut self, local: u64) -> Edges {
        let Some(dc) = &mut self.dc else {
            return Edges::default();
        };
        let edges = dc.sync.fire(local);
        self.note_sync(edges);
        edges
    }

    /// Shows pulses in the device's events, where 0x0151 maps them.
    pub(crate) fn note_sync(&mut self, edges: Edges) {
        let mapped = self.byte_at(reg::SYNC_CONFIG);
        if mapped & 0x88 == 0 {
            return;
        }
        for (n, rose) in [edges.sync0, edges.sync1].into_iter().enumerate() {
            if rose && mapped >> (3 + 4 * n) & 1 != 0 {
                self.al_event(event::SYNC0 << n, true);
            }
        }
    }

    /// The application has served a pulse of SYNC0 (0) or SYNC1 (1): 0x098E, 0x098F.
    pub(crate) fn acknowledge_sync(&mut self, n: u8) {
        if let Some(dc) = &mut self.dc {
            dc.sync.acknowledge(n);
            self.al_event(event::SYNC0 << n, false);
        }
    }

    /// The LATCH0 (0) or LATCH1 (1) input has this level at this local time.
    pub fn latch_input(&mut self, n: usize, level: bool, local: u64) {
        let Some(dc) = &mut self.dc else { return };
        let system = dc.system(local);
        if let Some(latch) = dc.latches.get_mut(n) {
            latch.input(level, system);
        }
        self.refresh_latch_events();
    }

    /// The device has read a latch unit's times; events of a unit that it controls are gone.
    pub fn acknowledge_latch(&mut self, n: usize) {
        let control = self.byte_at(reg::DC_CYCLIC_CONTROL);
        let Some(dc) = &mut self.dc else { return };
        if let Some(latch) = dc.latches.get_mut(n)
            && control >> (4 + n) & 1 != 0
        {
            latch.acknowledge(0);
            latch.acknowledge(1);
        }
        self.refresh_latch_events();
    }

    /// Latch events go to whoever controls the unit (0x0980 bits 4 and 5).
    pub(super) fn refresh_latch_events(&mut self) {
        let control = self.byte_at(reg::DC_CYCLIC_CONTROL);
        let Some(dc) = &self.dc else { return };
        let mut pending = [false; 2];
        for (n, latch) in dc.latches.iter().enumerate() {
            let side = usize::from(control >> (4 + n) & 1);
            if let Some(pending) = pending.get_mut(side) {
                *pending |= latch.pending();
            }
        }
        let [main_device, device] = pending;
        let events = self.u16_at(reg::ECAT_EVENT) & !event::DC_LATCH;
        let latch = if main_device { event::DC_LATCH } else { 0 };
        self.put(reg::ECAT_EVENT, &(events | latch).to_le_bytes());
        self.al_event(event::DEVICE_DC_LATCH, device);
    }
}
