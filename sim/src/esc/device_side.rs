//! The controller on the side of the device (PDI): registers without access rights, buffers,
//! states, SYNC pulses, and inputs with time stamps.

use super::al::{self, AlState};
use super::dc::sync::Edges;
use super::eeprom::{self, Finished};
use super::registers as reg;
use super::sm::{BufferOwner, SyncManager};
use super::{Esc, event};

impl Esc {
    /// Returns the contents of registers or RAM.
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

    /// True if the configuration in the EEPROM was valid. Without it, no application runs.
    #[must_use]
    pub fn is_loaded(&self) -> bool {
        self.loaded
    }

    /// True with device emulation (0x0141 bit 0): there is no application, and AL status follows AL
    /// control. Simple I/O terminals use this mode.
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

    /// Notes that the device read AL control; the MainDevice may write it again.
    pub(crate) fn read_al_control(&mut self) {
        self.al_locked = false;
        self.al_event(event::AL_CONTROL, false);
    }

    /// Sets AL status and its code for the application.
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

    /// True if 0x0500 assigns the EEPROM to the device, or the device has taken it.
    pub(super) fn device_has_eeprom(&self) -> bool {
        (self.byte_at(reg::EEPROM_CONFIG) | self.byte_at(reg::EEPROM_PDI_ACCESS)) & 1 != 0
    }

    /// Takes or releases the EEPROM for the device (0x0501). The device gets only an offered
    /// EEPROM. Returns true if the device owns it afterwards.
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

    /// Ends the current EEPROM job.
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

    /// Marks a SyncManager as filled or emptied. A read updates the registers.
    pub(crate) fn refresh_sm(&mut self, n: usize) {
        if let Some(sm) = self.sms.get_mut(n) {
            sm.note_full();
            self.sms_stale = true;
        }
    }

    /// Updates the registers with the SyncManager status and the resulting events.
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

    /// Opens or closes a SyncManager (0x0807 bit 0). Both empty it.
    pub(crate) fn close_sm(&mut self, n: usize, closed: bool) {
        if let Some(sm) = self.sms.get_mut(n) {
            sm.close(closed);
            self.refresh_sm(n);
        }
    }

    /// Returns the buffer that the device fills next, if it may fill the SyncManager.
    pub(crate) fn fill_buffer(&mut self, n: usize) -> Option<&mut [u8]> {
        let memory = self.mem.len();
        let fills =
            |sm: &&SyncManager| sm.is_open() && sm.filled == BufferOwner::ByDevice && !sm.full;
        let sm = self.sms.get(n).filter(fills)?;
        let (at, len) = (sm.device_writes_at(memory), usize::from(sm.len));
        self.mem.get_mut(at..at + len)
    }

    /// Completes the buffer of [`Self::fill_buffer`] at this local time.
    pub(crate) fn filled_buffer(&mut self, n: usize, local: u64) {
        if let Some(sm) = self.sms.get_mut(n) {
            sm.device_wrote();
            self.sms_stale = true;
            self.stamp_device_access(n, local);
        }
    }

    /// Returns the last complete data of the MainDevice, or `None` without data.
    pub(crate) fn fetch_buffer(&mut self, n: usize, local: u64) -> Option<&[u8]> {
        let memory = self.mem.len();
        let fetches =
            |sm: &&mut SyncManager| sm.filled == BufferOwner::ByMainDevice && sm.has_data();
        let sm = self.sms.get_mut(n).filter(fetches)?;
        let (at, len) = (sm.device_reads_at(memory), usize::from(sm.len));
        self.sms_stale = true;
        self.stamp_device_access(n, local);
        self.mem.get(at..at + len)
    }

    /// Returns the last complete contents without fetching them.
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

    /// Sets 0x09F8 and 0x09FC if the SyncManager requests it.
    fn stamp_device_access(&mut self, n: usize, local: u64) {
        let activate = self.byte_at(reg::SM + n as u16 * 8 + 6);
        if activate & 0x80 != 0 && self.dc.is_some() {
            let local = (local as u32).to_le_bytes();
            self.put(reg::DC_PDI_BUFFER_START, &local);
            self.put(reg::DC_PDI_BUFFER_CHANGE, &local);
        }
    }

    // Watchdogs

    /// Expires the process data watchdog.
    pub(crate) fn expire_watchdog(&mut self) {
        self.watchdog.expire();
        self.put(reg::WD_STATUS, &[0]);
        self.count_up(reg::WD_COUNTER);
        self.al_event(event::WATCHDOG, true);
    }

    /// Increments an error counter, which stops at 255.
    pub(super) fn count_up(&mut self, register: u16) {
        let count = self.byte_at(register).saturating_add(1);
        self.put(register, &[count]);
    }

    /// True if a process data interface exists and is in use.
    pub(super) fn pdi_runs(&self) -> bool {
        self.loaded && self.byte_at(reg::PDI_CONTROL) != 0 && !self.pdi_watchdog.expired()
    }

    /// Stops or resumes the device side at this local time. A stopped one does not trigger the PDI
    /// watchdog.
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

    /// Fires the SYNC pulses due at this local time.
    pub(crate) fn fire_sync(&mut self, local: u64) -> Edges {
        let Some(dc) = &mut self.dc else {
            return Edges::default();
        };
        let edges = dc.sync.fire(local);
        self.note_sync(edges);
        edges
    }

    /// Sets the device events of the pulses, if 0x0151 maps them.
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

    /// Acknowledges a pulse of SYNC0 (0) or SYNC1 (1) for the application: 0x098E, 0x098F.
    pub(crate) fn acknowledge_sync(&mut self, n: u8) {
        if let Some(dc) = &mut self.dc {
            dc.sync.acknowledge(n);
            self.al_event(event::SYNC0 << n, false);
        }
    }

    /// Sets the level of the LATCH0 (0) or LATCH1 (1) input at this local time.
    pub fn latch_input(&mut self, n: usize, level: bool, local: u64) {
        let Some(dc) = &mut self.dc else { return };
        let system = dc.system(local);
        if let Some(latch) = dc.latches.get_mut(n) {
            latch.input(level, system);
        }
        self.refresh_latch_events();
    }

    /// Acknowledges latch events after the device read the times. Applies only to units that the
    /// device controls.
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

    /// Updates the latch events for the side that controls the unit (0x0980 bits 4 and 5).
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
