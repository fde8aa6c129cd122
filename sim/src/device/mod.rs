//! A SubDevice: an ESC, its application and the time of the device.
//!
//! * `application`: the application behind the controller
//! * `build`: devices from an ESI
//! * `from_sii`: devices from an EEPROM image
//! * `esm`: state changes and their requirements
//! * `mailbox`: requests and answers
//! * `parameters`: data that survives a power cycle
//! * `process`: process data and objects
//! * `program`: program and boot loader
//! * `supervision`: synchronisation of outputs and SYNC0
//! * `time`: timed events of a device
//!
//! All actions of a device without a frame run in `time`, in the order of the device clock.

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

use ecaxis_esi::model::Access;

use crate::Nanos;
use crate::coe::object_dictionary::ObjectStore;
use crate::coe::pdo::PdoRules;
use crate::coe::startup::StartupWrites;
use crate::drive::{Drive, Emergency, State};
use crate::esc::Esc;
use crate::esc::al::AlState;
use crate::esc::dc::sync::Edges;
use crate::firmware::BootLoader;
use crate::foe::FileStore;
use crate::frame::Datagram;
use crate::quirks::Quirks;
use crate::soe::Sercos;
use application::Application;
pub use build::{DeviceOptions, SimError};
use esm::Al;
use mailbox::Mailbox;
pub use mailbox::MailboxOptions;
pub(crate) use process::InputFault;
use process::ProcessData;
use supervision::Supervision;
pub(crate) use time::Rest;

/// Number of events in [`SimDevice::sync0_log`] and the similar logs.
const LOG: usize = 64;

/// True times of the last events of one kind.
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

    /// Returns the last events, oldest first.
    fn last(&self) -> impl Iterator<Item = Nanos> + '_ {
        let kept = self.count.min(LOG as u64);
        (self.count - kept..self.count)
            .filter_map(|n| self.times.get((n % LOG as u64) as usize))
            .copied()
    }
}

/// The permitted location of a mailbox SyncManager.
#[derive(Debug, Clone, Copy, Default)]
struct MailboxLimits {
    start: u16,
    min: u16,
    max: u16,
}

/// The state at power-on, restored by a power cycle.
#[derive(Debug, Clone)]
struct PowerOnState {
    store: ObjectStore,
    application: Application,
    sercos: Option<Box<Sercos>>,
}

/// Delays through the device, from the first bit in to the first bit out.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Delays {
    /// The delay from one port to the next in ns. `None`: the default of the port that the frame
    /// leaves.
    pub(crate) forwarding_ns: Option<u64>,
    /// The additional delay of the processing unit in ns.
    pub(crate) processing_ns: u64,
}

/// The identity of a device, as far as it is known or to be changed.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Identification {
    /// Vendor, product, revision and serial number: SII words 8, 10, 12 and 14, 0x1018:01 to 04.
    pub(crate) numbers: [Option<u32>; 4],
    /// The alias, SII word 4.
    pub(crate) alias: Option<u16>,
}

/// The effects of a frame on a device that concern the network.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct FrameEffects {
    /// True if every port that the frame passes latches its receive time.
    pub(crate) latches: bool,
    /// True if DL control was written.
    pub(crate) dl_control: bool,
}

/// A simulated SubDevice: the controller and its application.
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
    /// The Sercos side of the drives.
    sercos: Option<Box<Sercos>>,
    mailbox: Option<Mailbox>,
    mailbox_limits: [MailboxLimits; 8],
    boot_mailbox: ((u16, u16), (u16, u16)),
    has_coe: bool,
    has_foe: bool,
    has_boot: bool,
    sdo_info: bool,
    complete_access: bool,
    mailbox_options: MailboxOptions,
    quirks: Quirks,
    startup: StartupWrites,
    files: FileStore,
    al: Al,
    serial: u32,
    /// The local time of the next action of the application.
    tick: u64,
    /// The last SYNC0 and SYNC1 pulses.
    pulses: [EventLog; 2],
    /// The last arrivals of outputs.
    arrivals: EventLog,
    /// The local time of the current event.
    local: u64,
    /// True while the application hangs; the controller continues.
    hangs: bool,
    /// The processor of a device with replaceable program, the program data while only the boot
    /// loader runs, and the local time of the end of a restart.
    processor: Option<BootLoader>,
    parked: Option<Box<(PdoRules, Vec<ProcessData>)>>,
    restarts_until: Option<u64>,
    /// True if the device has reset its controller since the last frame.
    was_reset: bool,
    fresh: Box<PowerOnState>,
    pub(crate) refusals: Vec<(AlState, u16)>,
    pub(crate) forced_aborts: Vec<(u16, u8, u32)>,
    pub(crate) ignored_writes: Vec<(u16, u8)>,
    input_fault: InputFault,
    mailbox_silent: bool,
    sync0_before_safe_op: bool,
    /// The values of 0x0981 that the OpModes of the ESI have.
    activations: Vec<u8>,
}

impl SimDevice {
    /// Returns the type name of the ESI.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the state of the EtherCAT state machine.
    #[must_use]
    pub fn al_state(&self) -> AlState {
        self.al.state
    }

    /// Returns the AL status code; 0 without an error.
    #[must_use]
    pub fn al_status_code(&self) -> u16 {
        self.al.code
    }

    /// Returns the configured station address, 0x0010.
    #[must_use]
    pub fn station_address(&self) -> u16 {
        self.esc.station_address()
    }

    pub(crate) fn esc(&self) -> &Esc {
        &self.esc
    }

    /// Returns `len` bytes of registers or RAM from the device's side, without effects of a read.
    /// Empty if the range exceeds the address space.
    #[must_use]
    pub fn registers(&self, start: u16, len: u16) -> &[u8] {
        self.esc.bytes(start, len)
    }

    /// Takes or releases the EEPROM for the device (0x0501). The device gets only an EEPROM that
    /// the MainDevice offers (0x0500). Returns true if the device owns it afterwards.
    pub fn claim_eeprom(&mut self, claim: bool) -> bool {
        self.esc.claim_eeprom(claim)
    }

    /// Acknowledges the events of LATCH0 (0) or LATCH1 (1), as the device does after it read the
    /// times. Applies only to units that the device controls (0x0980).
    pub fn acknowledge_latch(&mut self, n: usize) {
        self.esc.acknowledge_latch(n);
    }

    /// Returns the value of an object as an upload would, without access checks.
    #[must_use]
    pub fn object(&self, index: u16, sub: u8) -> Option<Vec<u8>> {
        let slot = self.store.slot(index, sub)?;
        if self.axes().is_empty() {
            return Some(crate::coe::read_item(&self.store, slot));
        }
        let mut store = self.store.clone();
        for drive in self.axes() {
            drive.show_in(&mut store);
        }
        Some(crate::coe::read_item(&store, slot))
    }

    /// Adds an object to the dictionary. An existing object keeps its length, access and value.
    pub fn add_object(&mut self, index: u16, sub: u8, access: Access, value: &[u8]) {
        let bits = u32::try_from(value.len() * 8).unwrap_or(u32::MAX);
        self.store.ensure(index, sub, "", bits, access, value);
    }

    /// Returns the contents of the EEPROM.
    #[must_use]
    pub fn sii(&self) -> &[u8] {
        self.esc.eeprom.image()
    }

    /// Returns the system time (0x0910) at a true time; `None` without distributed clocks.
    #[must_use]
    pub fn system_time(&self, now: Nanos) -> Option<u64> {
        self.esc
            .dc
            .as_ref()
            .map(|dc| dc.system(self.esc.clock.local(now)))
    }

    /// Returns the number of SYNC0 pulses since power-on.
    #[must_use]
    pub fn sync0_count(&self) -> u64 {
        self.pulses[0].count
    }

    /// Returns the true times of the last SYNC0 pulses, oldest first.
    pub fn sync0_log(&self) -> impl Iterator<Item = Nanos> + '_ {
        self.pulses[0].last()
    }

    /// Returns the true times of the last SYNC1 pulses, oldest first.
    pub fn sync1_log(&self) -> impl Iterator<Item = Nanos> + '_ {
        self.pulses[1].last()
    }

    /// Returns the true times at which the last frames with outputs began, oldest first.
    pub fn outputs_log(&self) -> impl Iterator<Item = Nanos> + '_ {
        self.arrivals.last()
    }

    /// Sets the level of an input wired to LATCH0 (0) or LATCH1 (1) at this true time.
    pub fn set_latch(&mut self, n: usize, level: bool, now: Nanos) {
        let local = self.esc.clock.local(now);
        self.esc.latch_input(n, level, local);
    }

    /// Makes the device refuse SafeOp until SYNC0 has fired, as some do.
    pub fn require_sync0_in_safe_op(&mut self) {
        self.sync0_before_safe_op = true;
    }

    /// Stops the application, like a crashed processor with a running controller, or resumes it. A
    /// stopped application does not trigger the PDI watchdog.
    pub fn set_hanging(&mut self, hangs: bool, now: Nanos) {
        if hangs == self.hangs {
            return;
        }
        self.advance(now);
        let local = self.esc.clock.local(now);
        self.hangs = hangs;
        self.esc.pdi_stops(hangs, local);
        if !hangs {
            // Clears the interrupts that arrived in the meantime.
            self.esc.acknowledge_sync(0);
            self.esc.acknowledge_sync(1);
            self.start_ticking(local);
        }
    }

    /// True if the application runs. It never starts without a valid configuration in the EEPROM.
    fn application_runs(&self) -> bool {
        !self.hangs && self.esc.is_loaded() && !self.is_restarting()
    }

    fn start_ticking(&mut self, local: u64) {
        let period = self.application.period();
        self.tick = period.map_or(u64::MAX, |period| local + period);
    }

    /// Switches the power off. [`SimDevice::power_on`] clears the volatile state.
    pub(crate) fn power_off(&mut self) {
        self.powered = false;
    }

    /// True if the device is switched on.
    #[must_use]
    pub fn has_power(&self) -> bool {
        self.powered
    }

    /// Lets the unpowered motor turn until friction stops it. True while the motor turns.
    fn coast(&mut self, now: Nanos) -> bool {
        let local = self.esc.clock.local(now);
        while self.tick <= local {
            self.start_ticking(self.tick);
            for drive in self.axes_mut() {
                drive.coast();
            }
            if self.axes().is_empty() {
                return false;
            }
        }
        self.axes().iter().any(Drive::turns_without_power)
    }

    /// Switches the power on. Volatile data are lost and objects return to their defaults.
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

    /// Handles rising edges of the SYNC outputs.
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
            self.continue_to_op();
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
        self.act_sercos(at);
        self.send_emergencies();
        self.watch_sync0();
        let alone = self.outputs_are_none() || self.application.samples_when_acting();
        if alone && !self.sync0_decides() {
            self.latch_inputs();
        }
    }

    fn send_emergencies(&mut self) {
        loop {
            let mut drives = (0..).zip(self.application.drives_mut());
            let emergency = drives.find_map(|(n, drive)| Some((n, drive.take_emergency()?)));
            let Some((drive, emergency)) = emergency else {
                break;
            };
            match self.sercos {
                Some(_) => {
                    if let Some(message) = Sercos::emergency(drive, &emergency) {
                        self.queue_soe(&message);
                    }
                }
                None => self.queue_emergency(&emergency),
            }
        }
    }

    /// Advances the procedure commands of Sercos drives and sends their notifications.
    fn act_sercos(&mut self, local: u64) {
        let Some(sercos) = &mut self.sercos else {
            return;
        };
        for message in sercos.act(self.application.drives_mut(), local) {
            self.queue_soe(&message);
        }
    }

    /// Makes Sercos drives refuse each access to these IDNs: drive, IDN, error code.
    pub(crate) fn refuse_idns(&mut self, idns: &[(u8, u16, u16)]) {
        if let Some(sercos) = &mut self.sercos {
            sercos.forced.clear();
            sercos.forced.extend_from_slice(idns);
        }
    }

    /// True without outputs. Only the device time can then trigger latching of inputs.
    fn outputs_are_none(&self) -> bool {
        !self
            .process
            .iter()
            .any(|d| d.len > 0 && d.direction == ecaxis_esi::model::Direction::Rx)
    }

    /// Processes a frame whose first byte arrives at `now`.
    pub(crate) fn process(
        &mut self,
        bytes: &mut [u8],
        datagrams: &[Datagram],
        now: Nanos,
    ) -> FrameEffects {
        let local = self.esc.begin_frame(now);
        self.local = local;
        if self.application.samples_at_frames() && !self.sync0_decides() {
            // Digital inputs are sampled when a frame begins.
            self.latch_inputs();
        }
        for datagram in datagrams {
            self.esc.execute(bytes, datagram);
        }
        self.esc.end_frame();
        let raised = self.esc.take_raised();
        if raised.reset {
            self.reset_at(now);
            return FrameEffects {
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
        FrameEffects {
            latches: self.esc.take_latch(),
            dl_control: self.esc.dl_control_changed() | std::mem::take(&mut self.was_reset),
        }
    }

    /// True if outputs arrived and take effect at once instead of at SYNC0.
    fn follows_sm(&self, written: u8) -> bool {
        self.al.state >= AlState::SafeOp
            && !self.sync0_decides()
            && self.process.iter().any(|d| written >> d.sm & 1 != 0)
    }

    fn sync0_decides(&self) -> bool {
        self.esc.dc.as_ref().is_some_and(|dc| dc.sync.sync0_on())
    }

    /// Returns the number of SYNC0 pulses since activation.
    fn sync0_pulses(&self) -> u64 {
        self.esc.dc.as_ref().map_or(0, |dc| dc.sync.pulses)
    }

    /// Returns the identity in EEPROM and object 0x1018, for fault injection.
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

    /// Lets the process data watchdog expire now.
    pub(crate) fn expire_watchdog(&mut self) {
        if self.powered {
            self.watchdog_expired();
        }
    }

    /// Stops the service of the mailbox, or resumes it.
    pub(crate) fn silence_mailbox(&mut self, silent: bool) {
        if std::mem::replace(&mut self.mailbox_silent, silent) && !silent {
            self.resume_mailbox();
        }
    }

    /// Delays the first SYNC0 by `late` ns, from the next start on. If `ignored`, the clock takes no
    /// system time.
    pub(crate) fn disturb_clock(&mut self, late: Nanos, ignored: bool) {
        if let Some(dc) = &mut self.esc.dc {
            dc.sync.late = late;
            dc.ignores_time = ignored;
        }
    }

    pub(crate) fn hold_drive_in(&mut self, state: Option<State>) {
        for drive in self.axes_mut() {
            drive.hold_in(state);
        }
    }
}
