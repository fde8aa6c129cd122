//! A SubDevice: an ESC, the application behind it and the device's own time.
//!
//! * `application`: what stands behind the controller
//! * `build`: from an ESI device
//! * `from_sii`: from an EEPROM image
//! * `esm`: state changes and what they demand
//! * `mailbox`: requests and replies
//! * `parameters`: what outlives a power cycle
//! * `process`: process data and objects
//! * `program`: with and without a program
//! * `supervision`: whether they come in time
//! * `time`: what a device does by itself, and until when it does nothing
//!
//! Everything a device does by itself happens in `time`, in the order of its clock.

mod application;
mod build;
mod esm;
mod from_sii;
pub(crate) mod mailbox;
mod parameters;
mod process;
mod program;
mod supervision;
mod time;

use crate::Nanos;
use crate::coe::pdo::PdoRules;
use crate::coe::store::ObjectStore;
use crate::drive::{Emergency, State};
use crate::esc::Esc;
use crate::esc::al::AlState;
use crate::esc::dc::sync::Edges;
use crate::firmware::Processor;
use crate::foe::FileStore;
use crate::frame::Datagram;
use application::Application;
pub use build::{DeviceOptions, SimError};
use esm::Al;
use mailbox::Mailbox;
pub use mailbox::MailboxOptions;
use process::ProcessData;
use supervision::Supervision;
pub(crate) use time::Rest;

/// Events remembered by [`SimDevice::sync0_log`] and its like.
const LOG: usize = 64;

/// True times of the last events of a kind.
#[derive(Debug, Clone)]
struct EventLog {
    count: u64,
    times: [Nanos; LOG],
}

impl Default for EventLog {
    fn default() -> Self {
        Self {
            count: 0,
            times: [0; LOG],
        }
    }
}

impl EventLog {
    fn push(&mut self, at: Nanos) {
        if let Some(entry) = self.times.get_mut((self.count % LOG as u64) as usize) {
            *entry = at;
        }
        self.count += 1;
    }

    /// The last ones, oldest first.
    fn last(&self) -> impl Iterator<Item = Nanos> + '_ {
        let kept = self.count.min(LOG as u64);
        (self.count - kept..self.count)
            .filter_map(|n| self.times.get((n % LOG as u64) as usize))
            .copied()
    }
}

/// Where a mailbox SyncManager must lie.
#[derive(Debug, Clone, Copy, Default)]
struct MailboxLimits {
    start: u16,
    min: u16,
    max: u16,
}

/// State at power-on, to return to after a power cycle.
#[derive(Debug, Clone)]
struct Fresh {
    store: ObjectStore,
    application: Application,
}

/// Through the device, from the first bit in to the first bit out.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Delays {
    /// From one port to the next; `None`: as usual for the port it leaves at.
    pub(crate) forwarding_ns: Option<u64>,
    /// What the processing unit adds.
    pub(crate) processing_ns: u64,
}

/// What a device is known by, as far as it is known or to be changed.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Identification {
    /// Vendor, product, revision and serial number: SII words 8, 10, 12 and 14, 0x1018:01 to 04.
    pub(crate) numbers: [Option<u32>; 4],
    /// SII word 4.
    pub(crate) alias: Option<u16>,
}

/// What a frame has done to a device that concerns the network.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Seen {
    /// Receive times are to be latched at every port it passes.
    pub(crate) latches: bool,
    /// DL control was written.
    pub(crate) dl_control: bool,
}

#[derive(Debug, Clone)]
pub struct SimDevice {
    name: String,
    pub(crate) delays: Delays,
    pub(crate) powered: bool,
    state_change_ns: Nanos,
    state_notice_ns: Nanos,
    pub(crate) esc: Esc,
    store: ObjectStore,
    pdo: PdoRules,
    process: Vec<ProcessData>,
    supervision: Supervision,
    application: Application,
    mailbox: Option<Mailbox>,
    mailbox_limits: [MailboxLimits; 8],
    boot_mailbox: ((u16, u16), (u16, u16)),
    has_coe: bool,
    has_foe: bool,
    has_boot: bool,
    sdo_info: bool,
    complete_access: bool,
    mailbox_options: MailboxOptions,
    files: FileStore,
    al: Al,
    serial: u32,
    /// Local time at which the application acts next.
    tick: u64,
    /// SYNC0 and SYNC1.
    pulses: [EventLog; 2],
    /// Outputs came.
    arrivals: EventLog,
    /// Local time of what is going on.
    local: u64,
    /// The application hangs; its controller does not.
    hangs: bool,
    /// One that can have another program; what belongs to the program while only the boot loader runs; and the local time until
    /// which it restarts.
    processor: Option<Processor>,
    parked: Option<Box<(PdoRules, Vec<ProcessData>)>>,
    restarts_until: Option<u64>,
    /// It has reset its controller since the last frame.
    was_reset: bool,
    fresh: Box<Fresh>,
    pub(crate) refusals: Vec<(AlState, u16)>,
    pub(crate) forced_aborts: Vec<(u16, u8, u32)>,
    pub(crate) ignored_writes: Vec<(u16, u8)>,
    mailbox_silent: bool,
}

impl SimDevice {
    /// The ESI's type name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    #[must_use]
    pub fn al_state(&self) -> AlState {
        self.al.state
    }

    /// 0 while there is no error.
    #[must_use]
    pub fn al_status_code(&self) -> u16 {
        self.al.code
    }

    #[must_use]
    pub fn station_address(&self) -> u16 {
        self.esc.station_address()
    }

    #[must_use]
    pub fn esc(&self) -> &Esc {
        &self.esc
    }

    /// The controller as the device's own side has it.
    pub fn esc_mut(&mut self) -> &mut Esc {
        &mut self.esc
    }

    /// An object's value as an upload would carry it, access rights aside.
    #[must_use]
    pub fn object(&self, index: u16, sub: u8) -> Option<Vec<u8>> {
        let slot = self.store.slot(index, sub)?;
        let Some(drive) = self.drive() else {
            return Some(crate::coe::read_item(&self.store, slot));
        };
        let mut store = self.store.clone();
        drive.show_in(&mut store);
        Some(crate::coe::read_item(&store, slot))
    }

    /// The objects; those by which a drive shows its state may be up to a frame old ([`SimDevice::object`] has them as they
    /// are).
    #[must_use]
    pub fn store(&self) -> &ObjectStore {
        &self.store
    }

    pub fn store_mut(&mut self) -> &mut ObjectStore {
        self.show();
        &mut self.store
    }

    /// The EEPROM's contents.
    #[must_use]
    pub fn sii(&self) -> &[u8] {
        self.esc.eeprom.image()
    }

    /// System time (0x0910) at a true time; `None` without distributed clocks.
    #[must_use]
    pub fn system_time(&self, now: Nanos) -> Option<u64> {
        self.esc
            .dc
            .as_ref()
            .map(|dc| dc.system(self.esc.clock.local(now)))
    }

    /// SYNC0 pulses since power-on.
    #[must_use]
    pub fn sync0_count(&self) -> u64 {
        self.pulses[0].count
    }

    /// True times of the last SYNC0 pulses, oldest first.
    pub fn sync0_log(&self) -> impl Iterator<Item = Nanos> + '_ {
        self.pulses[0].last()
    }

    /// True times of the last SYNC1 pulses, oldest first.
    pub fn sync1_log(&self) -> impl Iterator<Item = Nanos> + '_ {
        self.pulses[1].last()
    }

    /// True times at which the last frames that brought outputs began, oldest first.
    pub fn outputs_log(&self) -> impl Iterator<Item = Nanos> + '_ {
        self.arrivals.last()
    }

    /// An input wired to LATCH0 (0) or LATCH1 (1) has this level at this true time.
    pub fn set_latch(&mut self, n: usize, level: bool, now: Nanos) {
        let local = self.esc.clock.local(now);
        self.esc.latch_input(n, level, local);
    }

    /// The application stops, as a crashed processor does, while its controller goes on; or starts again where
    /// it was. Nobody triggers the watchdog of the process data interface meanwhile.
    pub fn set_hanging(&mut self, hangs: bool, now: Nanos) {
        if hangs == self.hangs {
            return;
        }
        self.advance(now);
        let local = self.esc.clock.local(now);
        self.hangs = hangs;
        self.esc.pdi_stops(hangs, local);
        if !hangs {
            // Interrupts that have waited.
            self.esc.acknowledge_sync(0);
            self.esc.acknowledge_sync(1);
            self.start_ticking(local);
        }
    }

    /// An application without a sound configuration in its EEPROM never starts.
    fn application_runs(&self) -> bool {
        !self.hangs && self.esc.is_loaded() && !self.is_restarting()
    }

    fn start_ticking(&mut self, local: u64) {
        let period = self.application.period();
        self.tick = period.map_or(u64::MAX, |period| local + period);
    }

    /// Without power nothing happens in it any more; it keeps what [`SimDevice::power_on`] clears.
    pub(crate) fn power_off(&mut self) {
        self.powered = false;
    }

    #[must_use]
    pub fn has_power(&self) -> bool {
        self.powered
    }

    /// A motor without power turns on until friction has stopped it; `true` while it does.
    fn coast(&mut self, now: Nanos) -> bool {
        let local = self.esc.clock.local(now);
        while self.tick <= local {
            self.start_ticking(self.tick);
            let Some(drive) = self.drive_mut() else {
                return false;
            };
            drive.coast();
        }
        self.drive_mut()
            .is_some_and(|drive| drive.velocity_rev_s() != 0.0)
    }

    /// Everything volatile is lost; objects return to their defaults.
    pub(crate) fn power_on(&mut self, now: Nanos) {
        self.powered = true;
        self.esc.power_on(now);
        self.restart_application(now);
        self.boot(false);
        self.restarts_until = None;
        self.al = Al::default();
        if let Some(mailbox) = &mut self.mailbox {
            mailbox.reset();
        }
        self.lay_out();
        self.close_process_data(true);
        self.hangs = false;
        self.local = self.esc.clock.local(now);
        self.start_ticking(self.local);
        self.pulses = Default::default();
        self.arrivals = EventLog::default();
    }

    /// SYNC outputs rose.
    fn synchronized(&mut self, edges: Edges) {
        let at = self.esc.clock.true_time(self.local);
        for (log, rose) in self.pulses.iter_mut().zip([edges.sync0, edges.sync1]) {
            if rose {
                log.push(at);
            }
        }
        if !self.application_runs() {
            return;
        }
        if edges.sync1 {
            self.esc.acknowledge_sync(1);
        }
        if edges.sync0 {
            self.esc.acknowledge_sync(0);
            self.first_sync_seen();
            self.count_sync0();
            self.exchange();
        }
    }

    fn eeprom_finished(&mut self, local: u64) {
        let was_loaded = self.esc.is_loaded();
        self.esc.finish_eeprom();
        if !was_loaded && self.esc.is_loaded() {
            self.close_process_data(true);
            self.start_ticking(local);
        }
    }

    fn tick(&mut self) {
        let at = self.tick;
        self.start_ticking(at);
        let in_op = self.al.state == AlState::Op;
        let now = || self.esc.clock.true_time(at);
        self.application.act(&mut self.store, in_op, now);
        self.send_emergencies();
        self.watch_sync0();
        let alone = self.outputs_are_none() || self.application.samples_when_acting();
        if alone && !self.sync0_decides() {
            self.latch_inputs();
        }
    }

    fn send_emergencies(&mut self) {
        while let Application::Drive(drive) = &mut self.application
            && let Some(emergency) = drive.take_emergency()
        {
            self.queue_emergency(&emergency);
        }
    }

    /// Nothing but the device's own time can make it latch inputs.
    fn outputs_are_none(&self) -> bool {
        !self
            .process
            .iter()
            .any(|d| d.len > 0 && d.direction == ecaxis_esi::model::Direction::Rx)
    }

    /// Processes a frame whose first byte arrives at `now`.
    pub(crate) fn process(&mut self, bytes: &mut [u8], datagrams: &[Datagram], now: Nanos) -> Seen {
        let local = self.esc.begin_frame(now);
        self.local = local;
        if self.application.samples_at_frames() && !self.sync0_decides() {
            // As digital inputs do: sampled when a frame begins.
            self.latch_inputs();
        }
        for datagram in datagrams {
            self.esc.execute(bytes, datagram);
        }
        self.esc.end_frame();
        let raised = self.esc.take_raised();
        if raised.reset {
            self.reset_at(now);
            return Seen {
                latches: false,
                dl_control: true,
            };
        }
        if let Some(control) = raised.al_control {
            self.al_requested(control, local);
        }
        if raised.sm_written | raised.sm_read != 0 || raised.repeat_request.is_some() {
            self.mailbox_events(
                raised.sm_written,
                raised.sm_read,
                raised.repeat_request,
                local,
            );
        }
        if raised.sm_configured || raised.sync_changed {
            self.configuration_changed(raised.sm_configured, raised.sync_changed);
        }
        if raised.ping != Edges::default() {
            self.esc.note_sync(raised.ping);
            self.synchronized(raised.ping);
        }
        if raised.sm_written != 0 {
            self.outputs_came(raised.sm_written);
        }
        if raised.sm_written != 0 && self.follows_sm(raised.sm_written) {
            self.exchange();
        }
        Seen {
            latches: self.esc.take_latch(),
            dl_control: self.esc.dl_control_changed() | std::mem::take(&mut self.was_reset),
        }
    }

    /// Outputs arrived and no SYNC0 decides when they count.
    fn follows_sm(&self, written: u8) -> bool {
        self.al.state >= AlState::SafeOp
            && !self.sync0_decides()
            && self.process.iter().any(|d| written >> d.sm & 1 != 0)
    }

    fn sync0_decides(&self) -> bool {
        self.esc.dc.as_ref().is_some_and(|dc| dc.sync.sync0_on())
    }

    /// SYNC0 pulses since it was activated.
    fn sync0_pulses(&self) -> u64 {
        self.esc.dc.as_ref().map_or(0, |dc| dc.sync.pulses)
    }

    /// Fault injection: what EEPROM and object 0x1018 say.
    pub(crate) fn identification(&self) -> Identification {
        let rom = &self.esc.eeprom;
        let number = |word| u32::from(rom.word(word)) | u32::from(rom.word(word + 1)) << 16;
        Identification {
            numbers: [8, 10, 12, 14].map(|word| Some(number(word))),
            alias: Some(rom.word(4)),
        }
    }

    pub(crate) fn identify(&mut self, new: &Identification) {
        for ((word, sub), value) in [(8, 1), (10, 2), (12, 3), (14, 4)]
            .into_iter()
            .zip(new.numbers)
        {
            let Some(value) = value else { continue };
            self.esc.eeprom.patch(word, value);
            for store in [&mut self.store, &mut self.fresh.store] {
                if let Some(slot) = store.slot(0x1018, sub) {
                    store.set(slot, i64::from(value));
                }
            }
        }
        if let Some(alias) = new.alias {
            self.esc.eeprom.patch_alias(alias);
        }
    }

    pub(crate) fn inject_emergency(&mut self, code: u16) {
        self.queue_emergency(&Emergency {
            code,
            register: 1,
            data: [0; 5],
        });
    }

    /// The watchdog of the process data expires now.
    pub(crate) fn expire_watchdog(&mut self) {
        if self.powered {
            self.watchdog_expired();
        }
    }

    /// Whoever looks after the mailbox does not, or does again.
    pub(crate) fn silence_mailbox(&mut self, silent: bool) {
        if std::mem::replace(&mut self.mailbox_silent, silent) && !silent {
            self.resume_mailbox();
        }
    }

    /// SYNC0 begins so much later than its start time says, from the next start on.
    pub(crate) fn delay_sync(&mut self, late: Nanos) {
        if let Some(dc) = &mut self.esc.dc {
            dc.sync.late = late;
        }
    }

    pub(crate) fn hold_drive_in(&mut self, state: Option<State>) {
        if let Some(drive) = self.drive_mut() {
            drive.hold_in(state);
        }
    }
}
