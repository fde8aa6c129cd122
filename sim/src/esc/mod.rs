//! An EtherCAT SubDevice controller: 4 KiB of registers, process RAM, and what register accesses
//! set in motion. Knows nothing of CoE or drives; it raises events for the device around it.

pub mod al;
pub mod dc;
pub mod eeprom;
pub mod fmmu;
pub mod info;
pub mod ports;
pub mod registers;
pub mod sm;
pub mod watchdog;

mod access;
mod execute;

use crate::Nanos;
use al::AlState;
use dc::{Clock, Dc};
use eeprom::Eeprom;
use fmmu::Fmmu;
pub use info::EscInfo;
use ports::Ports;
use registers as reg;
use registers::RegisterMap;
use sm::SyncManager;
use watchdog::Watchdog;

/// What the MainDevice's accesses mean to the device's application; taken after every frame.
#[derive(Debug, Clone, Copy, Default)]
pub struct Raised {
    pub al_control: Option<u16>,
    /// Bit per SyncManager: filled to its last byte by the MainDevice.
    pub sm_written: u8,
    /// Bit per SyncManager: mailbox emptied by the MainDevice.
    pub sm_read: u8,
    /// The activation byte of the mailbox-in SyncManager asks to repeat.
    pub repeat_request: Option<bool>,
    /// SyncManager configuration changed.
    pub sm_configured: bool,
    /// 0x0981 changed.
    pub sync_changed: bool,
}

/// Where process RAM starts.
const PROCESS_RAM: usize = 0x1000;
const MAX_RAM_KIB: u8 = 60;

/// Fixed properties of an ESC.
#[derive(Debug, Clone, Copy)]
pub struct EscConfig {
    pub info: EscInfo,
    /// Two bits a port: 0 none, 1 not configured, 2 EBUS, 3 MII; counts where `info` leaves it open.
    pub ports: u8,
    /// System time and SYNC units (0x0910–0x09FF) are switched on; the chip needs distributed clocks.
    pub with_dc: bool,
    pub clock_offset_ns: u64,
    pub clock_drift_ppm: f64,
}

#[derive(Debug, Clone)]
pub struct Esc {
    config: EscConfig,
    mem: Vec<u8>,
    map: RegisterMap,
    fmmus: [Option<Fmmu>; 8],
    pub(crate) sms: [SyncManager; 8],
    pub(crate) clock: Clock,
    pub(crate) dc: Option<Dc>,
    pub(crate) eeprom: Eeprom,
    pub(crate) watchdog: Watchdog,
    raised: Raised,
    station: u16,
    alias: Option<u16>,
    latch: bool,
    ports: Ports,
}

impl Esc {
    #[must_use]
    pub fn new(config: EscConfig, sii: Vec<u8>) -> Self {
        let mut esc = Self {
            mem: vec![0; PROCESS_RAM + usize::from(config.info.ram_kib.min(MAX_RAM_KIB)) * 1024],
            map: RegisterMap::new(&config.info, config.with_dc),
            fmmus: [None; 8],
            sms: [SyncManager::default(); 8],
            clock: Clock::new(0, config.clock_offset_ns, config.clock_drift_ppm),
            dc: None,
            eeprom: Eeprom::new(sii, &config.info),
            watchdog: Watchdog::default(),
            raised: Raised::default(),
            station: 0,
            alias: None,
            latch: false,
            ports: Ports::new(config.info.ports.unwrap_or(config.ports)),
            config,
        };
        esc.power_on(0);
        esc
    }

    /// Everything volatile back to its reset value.
    pub fn power_on(&mut self, now: Nanos) {
        self.mem.fill(0);
        self.fmmus = [None; 8];
        self.sms = [SyncManager::default(); 8];
        self.clock = Clock::new(
            now,
            self.config.clock_offset_ns,
            self.config.clock_drift_ppm,
        );
        let EscConfig { info, with_dc, .. } = self.config;
        self.dc = (with_dc && info.has(info::feature::DC)).then(Dc::default);
        self.watchdog = Watchdog::default();
        self.raised = Raised::default();
        (self.station, self.alias, self.latch) = (0, None, false);

        let ([b0, b1], [f0, f1]) = (info.build.to_le_bytes(), info.features.to_le_bytes());
        let ports = info.ports.unwrap_or(self.config.ports);
        self.put(reg::TYPE, &[info.kind, info.revision, b0, b1]);
        self.put(reg::TYPE + 4, &[info.fmmus, info.sync_managers]);
        self.put(reg::TYPE + 6, &[info.ram_kib, ports, f0, f1]);
        let alias = self.eeprom.word(4);
        self.put(reg::STATION_ALIAS, &alias.to_le_bytes());
        self.put(reg::PDI_CONTROL, &self.eeprom.word(0).to_le_bytes());
        self.put(reg::PDI_CONFIG, &self.eeprom.word(1).to_le_bytes());
        self.put(reg::DL_CONTROL, &[0x01, 0, 0x07, 0]);
        self.put(reg::WD_DIVIDER, &watchdog::DEFAULT_DIVIDER.to_le_bytes());
        self.put(reg::WD_PDI, &watchdog::DEFAULT_COUNT.to_le_bytes());
        self.put(reg::WD_PROCESS_DATA, &watchdog::DEFAULT_COUNT.to_le_bytes());
        self.put(reg::WD_STATUS, &[1]);
        if info.has(info::feature::DC) {
            self.put(reg::DC_RECEIVE_TIMES, info.receive_times.as_flattened());
        }
        if self.dc.is_some() {
            self.put(reg::DC_SPEED_START, &[0x00, 0x10]);
            self.put(reg::DC_FILTER, &[0x04, 0x0c]);
            self.put(reg::DC_PULSE_LENGTH, &self.eeprom.word(2).to_le_bytes());
            if let Some(dc) = &mut self.dc {
                dc.reset_loop(&mut self.clock, now, 4);
            }
        }
        self.refresh_eeprom();
        self.set_al(AlState::Init, 0);
        self.ports = Ports::new(ports);
        // EEPROM loaded, PDI watchdog not expired.
        self.put(reg::DL_STATUS, &[0x03, 0]);
        self.show_ports();
    }

    /// End of process RAM.
    #[must_use]
    pub fn memory(&self) -> usize {
        self.mem.len()
    }

    /// Register or RAM contents as the device's own side sees them.
    #[must_use]
    pub fn bytes(&self, start: u16, len: u16) -> &[u8] {
        let start = usize::from(start);
        self.mem
            .get(start..start + usize::from(len))
            .unwrap_or_default()
    }

    /// Writes from the device's own side.
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

    pub(crate) fn u16_at(&self, at: u16) -> u16 {
        self.bytes(at, 2).try_into().map_or(0, u16::from_le_bytes)
    }

    pub(crate) fn u32_at(&self, at: u16) -> u32 {
        self.bytes(at, 4).try_into().map_or(0, u32::from_le_bytes)
    }

    pub(crate) fn u64_at(&self, at: u16) -> u64 {
        self.bytes(at, 8).try_into().map_or(0, u64::from_le_bytes)
    }

    /// AL status and its code, as the application sets them.
    pub(crate) fn set_al(&mut self, state: AlState, code: u16) {
        let error = if code == 0 { 0 } else { al::ERROR };
        let status = u16::from(state.code()) | error;
        self.put(reg::AL_STATUS, &status.to_le_bytes());
        self.put(reg::AL_STATUS_CODE, &code.to_le_bytes());
        self.ecat_event(0x08);
    }

    pub(crate) fn ecat_event(&mut self, bits: u16) {
        let events = self.u16_at(reg::ECAT_EVENT) | bits;
        self.put(reg::ECAT_EVENT, &events.to_le_bytes());
    }

    /// Device emulation (bit 0 of 0x0141): nobody stands behind the controller, and AL status follows AL
    /// control by itself.
    #[must_use]
    pub fn emulates_device(&self) -> bool {
        self.u16_at(reg::PDI_CONTROL) & 0x0100 != 0
    }

    #[must_use]
    pub fn station_address(&self) -> u16 {
        self.station
    }

    /// Whether the frame just seen asked to latch receive times; the network fills them in.
    pub(crate) fn take_latch(&mut self) -> bool {
        std::mem::take(&mut self.latch)
    }

    pub(crate) fn take_raised(&mut self) -> Raised {
        std::mem::take(&mut self.raised)
    }

    pub(crate) fn refresh_eeprom(&mut self) {
        let write_enable = self.u16_at(reg::EEPROM_CONTROL) & eeprom::WRITE_ENABLE;
        let status = self.eeprom.status() | write_enable;
        self.put(reg::EEPROM_CONTROL, &status.to_le_bytes());
    }

    pub(crate) fn finish_eeprom(&mut self) {
        if let Some((data, len)) = self.eeprom.finish() {
            self.put(reg::EEPROM_DATA, data.get(..len).unwrap_or(&data));
        }
        self.refresh_eeprom();
    }

    pub(crate) fn refresh_sm(&mut self, n: usize) {
        let Some(status) = self.sms.get(n).map(SyncManager::status) else {
            return;
        };
        if let Some(byte) = self.mem.get_mut(usize::from(reg::SM) + n * 8 + 5) {
            *byte = status;
        }
    }

    pub(crate) fn expire_watchdog(&mut self) {
        self.watchdog.expire();
        self.put(reg::WD_STATUS, &[0]);
        let count = self
            .bytes(reg::WD_COUNTER, 1)
            .first()
            .map_or(0, |c| c.saturating_add(1));
        self.put(reg::WD_COUNTER, &[count]);
    }

    /// SYNC0 fired: count on, show the next pulse in 0x0990.
    pub(crate) fn fire_sync0(&mut self) {
        if let Some(dc) = &mut self.dc {
            dc.fire();
            if let dc::Sync0::Armed { next, .. } = dc.sync0 {
                self.put(reg::DC_START_TIME, &next.to_le_bytes());
            }
        }
    }
}
