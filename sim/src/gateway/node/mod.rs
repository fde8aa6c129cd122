//! A CANopen node: an EPOS 24/1, 24/5 or 70/10 with its dictionary, NMT state, SDO server and PDOs,
//! in front of a CiA 402 drive with motor.
//!
//! * here: states and communication on the bus
//! * `epos`: its objects, and their connection to the drive
//! * `lss`: its number and bit rate by layer setting services
//! * `objects`: access by SDO clients

mod epos;
mod lss;
mod objects;
#[cfg(test)]
mod tests;

pub use epos::Epos;
pub(super) use epos::{RECEIVABLE, RECEIVE_COBS, TRANSMIT_COBS, TRANSMITTABLE};
pub(super) use objects::{LOAD, SAVE};

use super::can::{CanBus, CanFrame};
use super::dictionary::{Dictionary, Handle};
use super::lss::UNNUMBERED;
use super::nmt::{NmtCommand, NmtState};
use super::pdo::{self, Pdo};
use super::sdo::Server;
use crate::Nanos;
use crate::coe::object_dictionary::ObjectStore;
use crate::drive::{CONTROL_PERIOD_NS, Drive, PlantParams};
use epos::{ObjectBindings, error_code};

/// The time from power-on or a reset to the boot-up message, in ns.
const BOOT_NS: Nanos = 50_000_000;
/// The time from a communication reset to the boot-up message, in ns.
const COMMUNICATION_BOOT_NS: Nanos = 5_000_000;
/// CAN life guard error.
pub(super) const LIFE_GUARD: u16 = 0x8130;
const MS: u64 = 1_000_000;
const HISTORY: u8 = 5;

/// The parameters of a node.
#[derive(Debug, Clone)]
pub(super) struct Settings {
    pub(super) id: u8,
    pub(super) drive: Epos,
    pub(super) plant: PlantParams,
    pub(super) serial: u32,
    /// The bit rate in bit/s.
    pub(super) bit_rate: u32,
    /// The DIP switches are at 0: the node gets its number by layer setting services.
    pub(super) lss: bool,
}

/// An EPOS drive as a CANopen node.
#[derive(Debug, Clone)]
pub struct Node {
    settings: Settings,
    /// Its number on the network, and that at power-on.
    number: u8,
    stored_number: u8,
    lss: lss::Lss,
    nmt: NmtState,
    /// The node has power and is connected.
    alive: bool,
    /// The CAN controller runs: it acknowledges frames, also while the communication is reset.
    online: bool,
    /// The end of the initialisation.
    ready: u64,
    d: Dictionary,
    /// The dictionary at power-on: factory values, or those of "save".
    stored: Dictionary,
    store: ObjectStore,
    drive: Drive,
    ties: ObjectBindings,
    receive: [Option<Pdo<Handle>>; 3],
    transmit: [Option<Pdo<Handle>>; 3],
    /// Synchronous PDOs that wait for the next SYNC.
    waiting: [Option<CanFrame>; 3],
    sdo: Server,
    /// The times of the next control cycle, the next heartbeat, the end of life time without
    /// guarding, and a missing heartbeat.
    tick: u64,
    heartbeat: u64,
    life: u64,
    master: u64,
    guard_toggle: bool,
    bit_rate: u32,
    /// The node sends no heartbeat.
    muted: bool,
}

impl Node {
    pub(super) fn new(settings: Settings) -> Self {
        let factory = epos::dictionary(
            settings.drive,
            settings.id,
            settings.serial,
            settings.bit_rate,
        );
        let mut store = epos::store();
        let drive = Drive::new(&mut store, settings.plant);
        let ties = ObjectBindings::new(&factory, &store, &settings.plant);
        let number = if settings.lss {
            UNNUMBERED
        } else {
            settings.id
        };
        let mut node = Self {
            number: settings.id,
            stored_number: number,
            lss: lss::Lss::default(),
            nmt: NmtState::Initialising,
            alive: true,
            online: false,
            ready: 0,
            d: factory.clone(),
            stored: factory,
            store,
            drive,
            ties,
            receive: [None, None, None],
            transmit: [None, None, None],
            waiting: [None; 3],
            sdo: Server::default(),
            tick: u64::MAX,
            heartbeat: u64::MAX,
            life: u64::MAX,
            master: u64::MAX,
            guard_toggle: false,
            bit_rate: settings.bit_rate,
            muted: false,
            settings,
        };
        node.power_on(0);
        node
    }

    /// Returns the node number in the settings.
    #[must_use]
    pub fn id(&self) -> u8 {
        self.settings.id
    }

    /// Returns the model.
    #[must_use]
    pub fn model(&self) -> Epos {
        self.settings.drive
    }

    /// Returns the NMT state.
    #[must_use]
    pub fn nmt_state(&self) -> NmtState {
        self.nmt
    }

    /// Returns the drive.
    #[must_use]
    pub fn drive(&self) -> &Drive {
        &self.drive
    }

    /// Returns the drive to change it.
    pub fn drive_mut(&mut self) -> &mut Drive {
        &mut self.drive
    }

    /// Returns an object's number regardless of access rights; 0 if it does not exist.
    #[must_use]
    pub fn object(&self, index: u16, sub: u8) -> i64 {
        self.d.get(index, sub)
    }

    /// True if the CAN controller takes part in the traffic.
    pub(super) fn is_on_bus(&self, bit_rate: u32) -> bool {
        self.alive && self.online && self.bit_rate == bit_rate
    }

    /// Switches the power on: all volatile values are those at the last "save".
    pub(super) fn power_on(&mut self, now: u64) {
        (self.alive, self.online) = (true, false);
        self.d = self.stored.clone();
        self.lss = lss::Lss::default();
        self.set_number(self.stored_number);
        self.store = epos::store();
        self.drive = Drive::new(&mut self.store, self.settings.plant);
        self.tick = now + CONTROL_PERIOD_NS;
        let rate = usize::try_from(self.d.get(0x2001, 0)).unwrap_or(0);
        self.bit_rate = epos::BIT_RATES.get(rate).copied().unwrap_or(1_000_000);
        self.initialise(now + BOOT_NS);
    }

    /// Switches the power off or disconnects the node. Queued frames are dropped.
    pub(super) fn power_off(&mut self, bus: &mut CanBus) {
        self.alive = false;
        bus.forget(self.settings.id);
    }

    fn initialise(&mut self, ready: u64) {
        self.nmt = NmtState::Initialising;
        self.ready = ready;
        self.sdo.reset();
        self.waiting = [None; 3];
        (self.heartbeat, self.life, self.master) = (u64::MAX, u64::MAX, u64::MAX);
        self.guard_toggle = false;
        self.take_number();
        self.load_pdos();
    }

    fn load_pdos(&mut self) {
        for n in 0..3u16 {
            let load = |kind| Pdo::load(&self.d, kind, n, |index, sub| self.d.find(index, sub));
            let (receive, transmit) = (load(pdo::RECEIVE), load(pdo::TRANSMIT));
            self.receive[usize::from(n)] = receive;
            self.transmit[usize::from(n)] = transmit;
        }
    }

    pub(super) fn due(&self) -> u64 {
        if !self.alive {
            return u64::MAX;
        }
        let ready = if self.nmt == NmtState::Initialising {
            self.ready
        } else {
            u64::MAX
        };
        ready
            .min(self.tick)
            .min(self.heartbeat)
            .min(self.life)
            .min(self.master)
            .min(self.lss.due())
    }

    /// Handles all events that are due at `now`.
    pub(super) fn step(&mut self, now: u64, bus: &mut CanBus) {
        if self.tick <= now {
            self.tick += CONTROL_PERIOD_NS;
            self.control(bus, now);
        }
        self.step_lss(now);
        if self.nmt == NmtState::Initialising {
            if self.ready <= now && self.number == UNNUMBERED {
                // Nothing but layer setting services.
                (self.online, self.ready) = (true, u64::MAX);
            } else if self.ready <= now {
                self.nmt = NmtState::PreOperational;
                self.online = true;
                self.send(bus, 0x700, &[0], now);
                self.start_heartbeat(now);
            }
            return;
        }
        if self.heartbeat <= now {
            let state = self.nmt.code();
            self.send(bus, 0x700, &[state], now);
            self.start_heartbeat(now);
        }
        if self.life <= now || self.master <= now {
            (self.life, self.master) = (u64::MAX, u64::MAX);
            self.drive.inject_fault(LIFE_GUARD);
        }
    }

    /// Ends or restarts the heartbeat.
    pub(super) fn mute(&mut self, muted: bool, now: u64) {
        self.muted = muted;
        if self.nmt != NmtState::Initialising {
            self.start_heartbeat(now);
        }
    }

    fn start_heartbeat(&mut self, now: u64) {
        let period = self.d.get(0x1017, 0).cast_unsigned() * MS;
        self.heartbeat = if period > 0 && !self.muted {
            now + period
        } else {
            u64::MAX
        };
    }

    fn control(&mut self, bus: &mut CanBus, now: u64) {
        self.ties.command(&self.d, &mut self.store);
        self.drive.control(&mut self.store, true);
        let operational = self.nmt == NmtState::Operational;
        self.ties.publish(&self.store, &mut self.d, operational);
        while let Some(emergency) = self.drive.take_emergency() {
            let code = error_code(emergency.code);
            if code != 0 {
                self.record(code);
            }
            if matches!(self.nmt, NmtState::PreOperational | NmtState::Operational) {
                let [low, high] = code.to_le_bytes();
                let cob = self.d.get(0x1014, 0) as u16;
                let data = [low, high, emergency.register, 0, 0, 0, 0, 0];
                bus.send(self.settings.id, CanFrame::new(cob, &data), now);
            }
        }
    }

    /// Adds a code to the error history, newest first.
    fn record(&mut self, code: u16) {
        for sub in (1..HISTORY).rev() {
            let older = self.d.get(0x1003, sub);
            self.d.set(0x1003, sub + 1, older);
        }
        self.d.set(0x1003, 1, i64::from(code));
        let count = (self.d.get(0x1003, 0) + 1).min(i64::from(HISTORY));
        self.d.set(0x1003, 0, count);
    }

    /// Sends a frame with the node's own number in the identifier.
    fn send(&mut self, bus: &mut CanBus, base: u16, data: &[u8], now: u64) {
        let id = base + u16::from(self.number);
        bus.send(self.settings.id, CanFrame::new(id, data), now);
    }

    /// Handles a frame from another node.
    pub(super) fn receive(&mut self, frame: &CanFrame, now: u64, bus: &mut CanBus) {
        self.lss_request(frame, now, bus);
        if self.nmt == NmtState::Initialising {
            return;
        }
        let own = u16::from(self.number);
        let operational = self.nmt == NmtState::Operational;
        match (frame.id, frame.remote) {
            (0, false) => self.network_management(frame, now, bus),
            (id, true) if id == 0x700 + own => self.guarded(now, bus),
            (id, true) if operational => self.requested(id, now, bus),
            (id, false) if id == 0x600 + own => self.sdo_request(frame, now, bus),
            (id, false) if operational && i64::from(id) == self.d.get(0x1005, 0) & 0x7ff => {
                self.synchronise(now, bus);
            }
            (id, false) if (0x701..0x780).contains(&id) => self.heard_heartbeat(id - 0x700, now),
            (id, false) if operational => self.take_pdo(id, frame),
            _ => {}
        }
    }

    fn network_management(&mut self, frame: &CanFrame, now: u64, bus: &mut CanBus) {
        let &[specifier, node] = frame.data() else {
            return;
        };
        if node != 0 && node != self.number {
            return;
        }
        let command = NmtCommand::from_specifier(specifier);
        if command.is_some_and(|command| command.leads_to() == NmtState::Initialising) {
            // The CAN controller restarts and drops its queued frames.
            bus.forget(self.settings.id);
        }
        match command {
            Some(NmtCommand::ResetNode) => self.power_on(now),
            Some(NmtCommand::ResetCommunication) => {
                self.d.restore(&self.stored.clone(), 0x1000..=0x1fff);
                self.initialise(now + COMMUNICATION_BOOT_NS);
            }
            Some(command) => {
                self.nmt = command.leads_to();
                self.waiting = [None; 3];
            }
            None => {}
        }
    }

    /// Handles a guarding request of the master.
    fn guarded(&mut self, now: u64, bus: &mut CanBus) {
        // A node with a heartbeat ignores guarding requests.
        if self.d.get(0x1017, 0) > 0 {
            return;
        }
        let state = self.nmt.code() | u8::from(self.guard_toggle) << 7;
        self.guard_toggle = !self.guard_toggle;
        self.send(bus, 0x700, &[state], now);
        let life = (self.d.get(0x100c, 0) * self.d.get(0x100d, 0)).cast_unsigned() * MS;
        self.life = if life > 0 { now + life } else { u64::MAX };
    }

    fn heard_heartbeat(&mut self, node: u16, now: u64) {
        let consumer = self.d.get(0x1016, 1).cast_unsigned();
        let (watched, time) = (consumer >> 16 & 0x7f, consumer & 0xffff);
        if watched == u64::from(node) && time > 0 {
            self.master = now + time * MS;
        }
    }

    fn sdo_request(&mut self, frame: &CanFrame, now: u64, bus: &mut CanBus) {
        let serves = matches!(self.nmt, NmtState::PreOperational | NmtState::Operational);
        if !serves || frame.data().len() != 8 {
            return;
        }
        let mut server = std::mem::take(&mut self.sdo);
        let heartbeat = self.d.get(0x1017, 0);
        let response = server.request(self, &frame.padded());
        self.sdo = server;
        if self.d.get(0x1017, 0) != heartbeat {
            self.start_heartbeat(now);
        }
        if let Some(response) = response {
            self.send(bus, 0x580, &response, now);
        }
    }

    fn take_pdo(&mut self, id: u16, frame: &CanFrame) {
        for n in 0..self.receive.len() {
            let Some(pdo) = self.receive[n].as_ref().filter(|pdo| pdo.cob == id) else {
                continue;
            };
            if frame.data().len() < pdo.len {
                // PDO length error.
                self.drive.inject_fault(0x8210);
            } else if pdo.is_synchronous() {
                self.waiting[n] = Some(*frame);
            } else {
                self.apply(n, frame);
            }
        }
    }

    fn apply(&mut self, n: usize, frame: &CanFrame) {
        let Some(pdo) = &self.receive[n] else {
            return;
        };
        let mut rest = frame.data();
        for (handle, len) in &pdo.map {
            let (own, next) = rest.split_at(rest.len().min(usize::from(*len)));
            let value = own
                .iter()
                .rev()
                .fold(0i64, |value, byte| value << 8 | i64::from(*byte));
            self.d.put(*handle, value);
            rest = next;
        }
        self.take_set_points();
    }

    /// Applies the written set-points.
    fn take_set_points(&mut self) {
        self.ties.command(&self.d, &mut self.store);
        self.drive.sync(&self.store);
    }

    fn synchronise(&mut self, now: u64, bus: &mut CanBus) {
        for n in 0..self.waiting.len() {
            if let Some(frame) = self.waiting[n].take() {
                self.apply(n, &frame);
            }
        }
        for n in 0..self.transmit.len() {
            if self.transmit[n].as_ref().is_some_and(Pdo::is_synchronous) {
                self.transmit(n, now, bus);
            }
        }
    }

    /// Sends asynchronous PDOs, which go on request only.
    fn requested(&mut self, id: u16, now: u64, bus: &mut CanBus) {
        for n in 0..self.transmit.len() {
            let asked = self.transmit[n]
                .as_ref()
                .is_some_and(|pdo| pdo.cob == id && !pdo.is_synchronous());
            if asked {
                self.transmit(n, now, bus);
            }
        }
    }

    fn transmit(&self, n: usize, now: u64, bus: &mut CanBus) {
        let Some(pdo) = &self.transmit[n] else {
            return;
        };
        let mut data = [0; 8];
        let mut at = 0;
        for (handle, len) in &pdo.map {
            let len = usize::from(*len);
            let value = self.d.at(*handle).to_le_bytes();
            for (to, from) in data.iter_mut().skip(at).take(len).zip(value) {
                *to = from;
            }
            at += len;
        }
        let used = data.get(..pdo.len).unwrap_or_default();
        bus.send(self.settings.id, CanFrame::new(pdo.cob, used), now);
    }
}
