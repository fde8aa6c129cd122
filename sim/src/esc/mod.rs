//! An EtherCAT SubDevice controller: 4 KiB of registers, process RAM, and the effects of accesses.
//! The controller knows neither CoE nor drives; it raises events for the device around it.
//!
//! From the wire inwards:
//!
//! * `execute`: one datagram; `access`: its reads and writes; `write_protection`: rejected writes
//! * `datagram`: start and end of a frame, and the effects of register writes
//! * `fmmu`, `sm`: mapping of logical addresses, and access to RAM
//! * `al`, `eeprom`, `watchdog`, `dc`: the functions behind registers
//! * `registers`, `chip`: the existing registers
//! * `ports`: links and loops
//! * `device_side`: the controller on the side of the device

pub(crate) mod al;
pub mod chip;
pub(crate) mod dc;
pub(crate) mod eeprom;
pub(crate) mod fmmu;
pub(crate) mod ports;
pub(crate) mod registers;
pub(crate) mod sm;
pub(crate) mod watchdog;

mod access;
mod datagram;
mod device_side;
mod execute;
#[cfg(test)]
mod sm_tests;
mod write_protection;

use crate::Nanos;
use crate::random::Jitter;
use access::Shadow;
use al::AlState;
pub use chip::EscInfo;
use datagram::Frame;
use dc::sync::Edges;
use dc::{Clock, Dc, Width};
use eeprom::Eeprom;
use fmmu::Fmmus;
use ports::Ports;
use registers as reg;
use registers::RegisterMap;
use sm::SyncManager;
use watchdog::Watchdog;
use write_protection::WriteProtection;

/// Bits of the event registers.
pub(crate) mod event {
    /// Events of the MainDevice, 0x0210; the SyncManagers start at bit 4.
    pub(crate) const DC_LATCH: u16 = 0x0001;
    pub(crate) const DL_STATUS: u16 = 0x0004;
    pub(crate) const AL_STATUS: u16 = 0x0008;
    pub(crate) const SYNC_MANAGERS: u16 = 0x0ff0;
    /// Events of the device, 0x0220; the SyncManagers start at bit 8.
    pub(crate) const AL_CONTROL: u32 = 0x0001;
    pub(crate) const DEVICE_DC_LATCH: u32 = 0x0002;
    pub(crate) const SYNC0: u32 = 0x0004;
    pub(crate) const SM_ACTIVATION: u32 = 0x0010;
    pub(crate) const WATCHDOG: u32 = 0x0040;
    pub(crate) const DEVICE_SYNC_MANAGERS: u32 = 0xff00;
}

/// The events that accesses of the MainDevice raise for the application, taken after every frame.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct PdiEvents {
    pub al_control: Option<u16>,
    /// Bit per SyncManager that the MainDevice filled to its last byte.
    pub sm_written: u8,
    /// Bit per SyncManager that the MainDevice read to its last byte.
    pub sm_read: u8,
    /// The repeat bit in the activation byte of the mailbox-in SyncManager.
    pub repeat_request: Option<bool>,
    /// The SyncManager configuration changed.
    pub sm_configured: bool,
    /// 0x0981 changed.
    pub sync_changed: bool,
    /// The SYNC outputs that a debug pulse raised.
    pub ping: Edges,
    /// The reset sequence is complete.
    pub reset: bool,
}

const MAX_RAM_KIB: u8 = 60;

/// The fixed properties of an ESC.
#[derive(Debug, Clone, Copy)]
pub(crate) struct EscConfig {
    pub info: EscInfo,
    /// Two bits per port: 0 none, 1 not configured, 2 EBUS, 3 MII. Applies if `info` leaves the
    /// ports open.
    pub ports: u8,
    /// True if system time and SYNC units (0x0910–0x09FF) are switched on. The chip must have
    /// distributed clocks.
    pub with_dc: bool,
    pub clock_offset_ns: u64,
    pub clock_drift_ppm: f64,
    /// The noise on time stamps in ± ns. Its seed follows.
    pub clock_jitter_ns: u32,
    pub jitter_seed: u64,
}

#[derive(Debug, Clone)]
pub(crate) struct Esc {
    config: EscConfig,
    mem: Vec<u8>,
    map: RegisterMap,
    fmmus: Fmmus,
    pub(crate) sms: [SyncManager; 8],
    pub(crate) clock: Clock,
    jitter: Jitter,
    pub(crate) dc: Option<Dc>,
    pub(crate) eeprom: Eeprom,
    /// Valid until the next frame begins.
    eeprom_write_enable: bool,
    /// True if the configuration was loaded from the EEPROM: application and process RAM are
    /// available.
    loaded: bool,
    pub(crate) watchdog: Watchdog,
    pdi_watchdog: Watchdog,
    guard: WriteProtection,
    /// True if SyncManagers changed since the last update of their registers.
    sms_stale: bool,
    frame: Frame,
    shadow: Shadow,
    scratch: Vec<u8>,
    register_bytes: Vec<u8>,
    raised: PdiEvents,
    station: u16,
    alias: Option<u16>,
    /// True if AL control was written and the device has not read it yet.
    al_locked: bool,
    latch: bool,
    ports: Ports,
}

impl Esc {
    #[must_use]
    pub fn new(config: EscConfig, sii: Vec<u8>) -> Self {
        let ram = usize::from(config.info.ram_kib.min(MAX_RAM_KIB)) * 1024;
        let mut esc = Self {
            mem: vec![0; reg::PROCESS_RAM + ram],
            map: RegisterMap::new(&config.info, clock_width(&config)),
            fmmus: Fmmus::with_capacity(),
            sms: [SyncManager::default(); 8],
            clock: Clock::new(0, config.clock_offset_ns, config.clock_drift_ppm),
            jitter: Jitter::new(config.clock_jitter_ns, config.jitter_seed),
            dc: None,
            eeprom: Eeprom::new(sii, &config.info),
            eeprom_write_enable: false,
            loaded: false,
            watchdog: Watchdog::default(),
            pdi_watchdog: Watchdog::default(),
            guard: WriteProtection::default(),
            sms_stale: false,
            frame: Frame::default(),
            shadow: Shadow::with_capacity(),
            scratch: Vec::with_capacity(1536),
            register_bytes: Vec::with_capacity(16),
            raised: PdiEvents::default(),
            station: 0,
            alias: None,
            al_locked: false,
            latch: false,
            ports: Ports::new(config.info.ports.unwrap_or(config.ports)),
            config,
        };
        esc.power_on(0);
        esc
    }

    /// Resets everything volatile and reads the EEPROM.
    pub fn power_on(&mut self, now: Nanos) {
        let EscConfig { info, .. } = self.config;
        self.mem.fill(0);
        self.fmmus.clear();
        self.sms = [SyncManager::default(); 8];
        self.clock = Clock::new(
            now,
            self.config.clock_offset_ns,
            self.config.clock_drift_ppm,
        );
        self.dc = clock_width(&self.config).map(|width| Dc::new(width, 0));
        (self.watchdog, self.pdi_watchdog) = (Watchdog::default(), Watchdog::default());
        self.guard = WriteProtection::default();
        self.frame = Frame::default();
        self.shadow.clear();
        self.raised = PdiEvents::default();
        (self.station, self.alias, self.latch) = (0, None, false);
        (self.al_locked, self.eeprom_write_enable) = (false, false);

        let ([b0, b1], [f0, f1]) = (info.build.to_le_bytes(), info.features.to_le_bytes());
        let ports = info.ports.unwrap_or(self.config.ports);
        self.put(reg::TYPE, &[info.kind, info.revision, b0, b1]);
        self.put(reg::TYPE + 4, &[info.fmmus, info.sync_managers]);
        self.put(reg::TYPE + 6, &[info.ram_kib, ports, f0, f1]);
        self.put(reg::DL_CONTROL, &[0x01, 0, 0x07, 0]);
        self.put(reg::AL_CONTROL, &[AlState::Init.code()]);
        self.put(reg::AL_STATUS, &[AlState::Init.code()]);
        self.put(reg::AL_EVENT_MASK, &[0x0f, 0xff, 0xff, 0x00]);
        self.put(reg::WD_DIVIDER, &watchdog::DEFAULT_DIVIDER.to_le_bytes());
        self.put(reg::WD_PDI, &watchdog::DEFAULT_COUNT.to_le_bytes());
        self.put(reg::WD_PROCESS_DATA, &watchdog::DEFAULT_COUNT.to_le_bytes());
        if info.has(chip::feature::DC) {
            self.put(reg::DC_RECEIVE_TIMES, info.receive_times.as_flattened());
        }
        if self.dc.is_some() {
            let start = dc::DEFAULT_SPEED_START.to_le_bytes();
            self.put(reg::DC_SPEED_START, &start);
            self.put(reg::DC_FILTER, &dc::DEFAULT_FILTERS);
        }
        self.sms_stale = true;
        self.eeprom.power_on();
        self.loaded = false;
        self.load_configuration();
        self.refresh_eeprom();
        self.ports = Ports::new(ports);
        self.show_ports();
    }

    /// Loads the configuration area if it is valid. The alias is loaded only once after power-on.
    fn load_configuration(&mut self) {
        let Some([a0, a1, a2, a3, a4, ..]) = self.eeprom.configuration() else {
            return;
        };
        self.put(reg::PDI_CONTROL, &a0.to_le_bytes());
        self.put(reg::PDI_CONFIG, &a1.to_le_bytes());
        self.put(reg::PDI_CONFIG_EXTENDED, &a3.to_le_bytes());
        if let Some(dc) = &mut self.dc {
            dc.sync.pulse_length = a2;
            self.put(reg::DC_PULSE_LENGTH, &a2.to_le_bytes());
        }
        if !self.loaded {
            self.loaded = true;
            self.put(reg::STATION_ALIAS, &a4.to_le_bytes());
            self.take_alias();
        }
    }

    /// Returns the end of process RAM.
    #[must_use]
    pub fn memory(&self) -> usize {
        self.mem.len()
    }

    /// Returns DL status without the ports.
    fn own_dl_status(&self) -> u16 {
        u16::from(self.loaded)
            | u16::from(self.pdi_runs()) << 1
            | u16::from(self.enhanced_link_detection()) << 2
    }

    #[must_use]
    pub fn station_address(&self) -> u16 {
        self.station
    }

    /// Returns true if the last frame requested latching of receive times. The network fills them
    /// in.
    pub(crate) fn take_latch(&mut self) -> bool {
        std::mem::take(&mut self.latch)
    }

    pub(crate) fn take_raised(&mut self) -> PdiEvents {
        std::mem::take(&mut self.raised)
    }
}

/// Returns the width of the clock if the chip has one and it is switched on.
fn clock_width(config: &EscConfig) -> Option<Width> {
    (config.with_dc && config.info.has(chip::feature::DC)).then(|| {
        if config.info.has(chip::feature::DC_64_BIT) {
            Width::Bits64
        } else {
            Width::Bits32
        }
    })
}
