//! The SubDevices of a recording, reconstructed from its datagrams.

use ecaxis_ecat::datagram::Command;
use ecaxis_ecat::registers;
use ecaxis_master::acyclic::AlState;

use super::axes::Axes;
use super::clocks::Clocks;
use super::context::Context;
use super::cycle::{Cycle, Key, key};
use super::eeprom::Eeprom;
use super::events::{EVENTS, Event, EventKind, EventScope};
use super::mailbox::{self, Mailbox, MailboxEvent};
use super::match_frames::{DatagramExchange, FrameExchange};
use super::objects::Objects;
use super::registers::{Registers, part, part_u16};
use super::rows::Rows;

/// The maximum number of devices.
const DEVICES: usize = 1024;

const EEPROM: std::ops::Range<u16> = registers::EEPROM_CONFIGURATION..0x0510;
const PROCESS_MEMORY: u16 = 0x1000;
/// The registers of FMMUs and SyncManagers.
const MAPPING: std::ops::Range<u16> = registers::FMMU..0x0880;

/// A SubDevice.
#[derive(Debug, Default)]
pub struct Device {
    pub position: Option<u16>,
    pub station: Option<u16>,
    pub registers: Registers,
    /// The registers in the highest state, before a MainDevice cleared them.
    pub configured: Option<(AlState, Registers)>,
    pub eeprom: Eeprom,
    pub mailbox: Mailbox,
    pub objects: Objects,
    pub state: Option<AlState>,
    pub error: bool,
    pub code: Option<u16>,
    /// The last requested state, and whether the request acknowledged errors.
    asked: Option<(AlState, bool)>,
    /// The transmission time of the frame that last acknowledged errors.
    acknowledged_at: Option<u64>,
    /// True if AL status has the error bit, including copied acknowledgements.
    flagged: bool,
    /// The states in order, without consecutive repetitions.
    pub reached: Vec<AlState>,
    pub axes: Axes,
}

impl Device {
    /// Returns the configuration in the highest state, else the present registers.
    pub fn configuration(&self) -> &Registers {
        self.configured.as_ref().map_or(&self.registers, |(_, r)| r)
    }
}

/// A bus and its events.
#[derive(Debug, Default)]
pub struct RecordedSegment {
    pub devices: Vec<Device>,
    /// The highest working counter of a broadcast read.
    pub answering: Option<u16>,
    now_answering: Option<u16>,
    pub events: Vec<Event>,
    pub more_events: u64,
    pub cycle: Cycle,
    pub clocks: Clocks,
    pub sent: u64,
    pub answered: u64,
    pub unanswered: u64,
    pub unasked: u64,
    pub open: u64,
    /// The number of devices beyond the maximum.
    pub unfollowed: u64,
    /// The last state requested of all devices, and whether the request acknowledged errors.
    asked: Option<(AlState, bool)>,
    /// True if the last broadcast read of AL status had the error bit.
    flagged: bool,
    /// The index of an error event whose device is not known yet.
    unattributed: Option<usize>,
    /// Incremented when the mapping of process data changes.
    version: u64,
    located: Option<u64>,
    pub known: Context,
    /// The values of each cycle, if they are wanted.
    pub rows: Option<Rows>,
    last: u64,
}

impl RecordedSegment {
    pub fn new(known: Context) -> Self {
        Self {
            known,
            ..Self::default()
        }
    }

    fn event(&mut self, at: u64, of: EventScope, what: EventKind) {
        if self.events.len() < EVENTS {
            self.events.push(Event { at, of, what });
        } else {
            self.more_events += 1;
        }
    }

    pub fn exchange(&mut self, exchange: &FrameExchange) {
        self.sent += u64::from(exchange.sent.is_some());
        self.answered += u64::from(exchange.back.is_some());
        match (&exchange.sent, &exchange.back) {
            (Some(_), None) if exchange.open => self.open += 1,
            (Some(_), None) => self.unanswered += 1,
            (None, Some(_)) => self.unasked += 1,
            _ => {}
        }
        self.last = self.last.max(exchange.at());
        for passed in exchange.datagrams() {
            if passed.command.is_logical() {
                let key = key(&passed);
                let valid = self.cycle.passed(key, &passed, exchange.open);
                if let Some(rows) = &mut self.rows {
                    rows.begin(&key, &passed, valid);
                }
                if valid {
                    self.process_data(key, &passed);
                }
            } else {
                self.datagram(&passed);
            }
        }
    }

    /// Ends the recording.
    pub fn end(&mut self) {
        if let Some(rows) = &mut self.rows {
            rows.end();
        }
        for device in 0..self.devices.len() {
            let at = self.last;
            let reported = self.devices.get_mut(device).map(|d| d.mailbox.end(at));
            self.record_mailbox_events(at, device, reported.unwrap_or_default());
        }
        self.events.sort_by_key(|event| event.at);
    }

    fn datagram(&mut self, passed: &DatagramExchange<'_>) {
        let command = passed.command;
        match command {
            Command::BRD | Command::BRW | Command::BWR => self.broadcast(passed),
            Command::APRD | Command::APWR | Command::APRW | Command::ARMW => {
                // The answer alone does not contain the original position.
                let position = passed.sent.map(|_| 0_u16.wrapping_sub(passed.adp()));
                let device = position.and_then(|p| self.at_position(p, passed.wkc));
                if let Some(device) = device {
                    self.addressed(device, passed);
                }
            }
            Command::FPRD | Command::FPWR | Command::FPRW | Command::FRMW => {
                if let Some(device) = self.at_station(passed.adp(), passed.wkc) {
                    self.addressed(device, passed);
                }
            }
            _ => {}
        }
    }

    /// Returns the device at a position; adds one if it answered.
    fn at_position(&mut self, position: u16, wkc: Option<u16>) -> Option<usize> {
        let known = self
            .devices
            .iter()
            .position(|d| d.position == Some(position));
        known.or_else(|| self.add(wkc, |device| device.position = Some(position)))
    }

    fn at_station(&mut self, station: u16, wkc: Option<u16>) -> Option<usize> {
        let known = self.devices.iter().position(|d| d.station == Some(station));
        known.or_else(|| self.add(wkc, |device| device.station = Some(station)))
    }

    fn add(&mut self, wkc: Option<u16>, set: impl FnOnce(&mut Device)) -> Option<usize> {
        if wkc.is_none_or(|wkc| wkc == 0) {
            return None;
        }
        if self.devices.len() >= DEVICES {
            self.unfollowed += 1;
            return None;
        }
        let mut device = Device {
            asked: self.asked,
            ..Device::default()
        };
        set(&mut device);
        self.devices.push(device);
        Some(self.devices.len() - 1)
    }

    /// Assigns a station address, from a write or read of its register, to the device at a
    /// position.
    fn named(&mut self, at: u64, device: usize, station: u16) {
        let before = self.devices.get(device).and_then(|d| d.station);
        if before == Some(station) {
            return;
        }
        for other in self
            .devices
            .iter_mut()
            .filter(|d| d.station == Some(station))
        {
            other.station = None;
        }
        if let Some(device) = self.devices.get_mut(device) {
            device.station = Some(station);
        }
        self.event(at, EventScope::Device(device), EventKind::Station(station));
    }

    fn broadcast(&mut self, passed: &DatagramExchange<'_>) {
        let (register, at) = (passed.ado(), passed.at);
        if passed.command == Command::BRD
            && matches!(register, 0x0000..0x0010 | registers::AL_CONTROL..0x0138)
            && let Some(wkc) = passed.wkc
            && self.now_answering != Some(wkc)
        {
            self.now_answering = Some(wkc);
            self.answering = self.answering.max(Some(wkc));
            self.event(at, EventScope::Bus, EventKind::Answering(wkc));
        }
        if passed.command.writes()
            && let Some(data) = passed.written()
        {
            if let Some(control) =
                part_u16(register, data, registers::AL_CONTROL).or_else(|| low(register, data))
            {
                self.asked = Some(asked(control));
                for device in &mut self.devices {
                    device.request(asked(control), at);
                }
                self.event(at, EventScope::Bus, requested(control));
            }
            if passed.wkc.is_some_and(|wkc| wkc > 0) {
                self.version += u64::from(touches(register, data));
                for device in &mut self.devices {
                    device.registers.set(register, data);
                    device.eeprom.written(register, data);
                }
            }
        }
        if passed.command == Command::BRD
            && let (Some(data), Some(wkc)) = (passed.back, passed.wkc)
            && let Some([status]) = part(register, data, registers::AL_STATUS, 1)
        {
            self.error_bit(at, *status);
            self.everybody(at, *status, wkc);
        }
    }

    /// Reports an error bit in the AL status of all devices, combined by OR. The device becomes
    /// known when its own AL status is read.
    fn error_bit(&mut self, at: u64, status: u8) {
        let flagged = status & 0x10 != 0;
        let new = flagged && !self.flagged;
        self.flagged = flagged;
        // Devices without a processor copy the acknowledge bit.
        let asked = self.devices.iter().map(|device| device.asked);
        let mut asked = asked.chain([self.asked]).flatten();
        if !new || asked.any(|(_, acknowledged)| acknowledged) {
            return;
        }
        if !self.devices.iter().any(|device| device.error) {
            self.unattributed = (self.events.len() < EVENTS).then_some(self.events.len());
            self.event(at, EventScope::Bus, EventKind::ErrorBit);
        }
    }

    /// Evaluates the AL status of all devices, combined by OR. It is unambiguous if all have the
    /// same state.
    fn everybody(&mut self, at: u64, status: u8, wkc: u16) {
        let state = AlState::from_status(status);
        let same = matches!(status & 0x1f, 1 | 2 | 4 | 8) && Some(wkc) == self.answering;
        if !same || usize::from(wkc) < self.devices.len() {
            return;
        }
        let fresh = self
            .devices
            .iter()
            .any(|d| d.state != Some(state) || d.error);
        for device in &mut self.devices {
            device.enters(state, false, None);
        }
        if fresh {
            let what = EventKind::State {
                state,
                error: false,
                code: None,
            };
            self.event(at, EventScope::Bus, what);
        }
    }

    /// Processes a datagram to one device.
    fn addressed(&mut self, index: usize, passed: &DatagramExchange<'_>) {
        let (register, at) = (passed.ado(), passed.at);
        let executed = passed.wkc.is_some_and(|wkc| wkc > 0);
        let written = passed.written().filter(|_| passed.command.writes());
        if let Some(data) = written
            && let Some(control) =
                part_u16(register, data, registers::AL_CONTROL).or_else(|| low(register, data))
        {
            if let Some(device) = self.devices.get_mut(index) {
                device.request(asked(control), at);
            }
            self.event(at, EventScope::Device(index), requested(control));
        }
        if !executed {
            return;
        }
        if let Some(data) = written {
            if let Some(station) = part_u16(register, data, registers::STATION_ADDRESS) {
                self.named(at, index, station);
            }
            if touches(register, data) {
                self.version += 1;
            }
            if let Some(device) = self.devices.get_mut(index) {
                if register < PROCESS_MEMORY {
                    device.registers.set(register, data);
                }
                if EEPROM.contains(&register) {
                    device.eeprom.written(register, data);
                }
            }
            self.mail(index, at, true, register, data);
        }
        if let Some(data) = passed.back.filter(|_| passed.command.reads()) {
            let back_at = passed.back_at.unwrap_or(at);
            self.read(index, back_at, passed, data);
        }
    }

    fn read(&mut self, index: usize, at: u64, passed: &DatagramExchange<'_>, data: &[u8]) {
        let register = passed.ado();
        let Some(device) = self.devices.get_mut(index) else {
            return;
        };
        if register < PROCESS_MEMORY {
            device.registers.set(register, data);
        }
        if EEPROM.contains(&register) {
            device.eeprom.read(register, data);
        }
        let station = device.station.unwrap_or(0);
        if let Some(read) =
            part_u16(register, data, registers::STATION_ADDRESS).filter(|read| *read != 0)
        {
            self.named(at, index, read);
        }
        if let Some([status]) = part(register, data, registers::AL_STATUS, 1) {
            self.status(
                (passed.at, at),
                index,
                *status,
                part_u16(register, data, registers::AL_STATUS_CODE),
            );
        } else if let Some(code) = part_u16(register, data, registers::AL_STATUS_CODE) {
            self.code((passed.at, at), index, code);
        }
        if let Some(time) = part(register, data, registers::DC_SYSTEM_TIME, 8)
            .or_else(|| part(register, data, registers::DC_SYSTEM_TIME, 4))
            .filter(|_| matches!(passed.command, Command::FRMW | Command::ARMW))
        {
            // The transmission time is closest to the time of the read.
            self.clocks.reference(station, passed.at, time);
        }
        if let Some(raw) = part(register, data, registers::DC_SYSTEM_TIME_DIFFERENCE, 4)
            .and_then(<[u8]>::first_chunk)
        {
            self.clocks.difference(station, u32::from_le_bytes(*raw));
        }
        if !matches!(passed.command, Command::FRMW | Command::ARMW) {
            self.mail(index, at, false, register, data);
        }
    }

    /// Processes the AL status of one device. `sent_at`: the transmission time of the frame.
    fn status(&mut self, (sent_at, at): (u64, u64), index: usize, status: u8, code: Option<u16>) {
        let Some(device) = self.devices.get_mut(index) else {
            return;
        };
        let state = AlState::from_status(status);
        device.flagged = status & 0x10 != 0;
        if !device.flagged && device.asked == Some((state, true)) {
            // An error bit after this one is not copied.
            device.asked = Some((state, false));
        }
        // Devices without a processor copy AL control, including the acknowledge bit.
        let copied = device.asked == Some((state, true)) && code.is_none_or(|code| code == 0);
        // The device has not yet processed an acknowledgement in the same frame.
        let acknowledged = device.acknowledged_at == Some(sent_at);
        // A known error lasts until the bit is cleared.
        let lasts = device.error && device.state == Some(state);
        let error = device.flagged && (lasts || !copied && !acknowledged);
        let code = code.filter(|_| error);
        if device.enters(state, error, code) {
            let what = EventKind::State { state, error, code };
            let of = EventScope::Device(index);
            let earlier = self.unattributed.take_if(|_| error);
            match earlier.and_then(|earlier| self.events.get_mut(earlier)) {
                Some(event) => (event.of, event.what) = (of, what),
                None => self.event(at, of, what),
            }
        }
    }

    fn code(&mut self, (sent_at, at): (u64, u64), index: usize, code: u16) {
        let Some(device) = self.devices.get_mut(index) else {
            return;
        };
        if !device.flagged || code == 0 || device.code == Some(code) {
            return;
        }
        if !device.error && device.acknowledged_at == Some(sent_at) {
            return;
        }
        let copied = !device.error;
        (device.error, device.code) = (true, Some(code));
        if let (true, Some(state)) = (copied, device.state) {
            let what = EventKind::State {
                state,
                error: true,
                code: Some(code),
            };
            self.event(at, EventScope::Device(index), what);
        } else {
            // Add the code to the earlier state event.
            let state = self.events.iter_mut().rev().find(|event| {
                event.of == EventScope::Device(index)
                    && matches!(event.what, EventKind::State { .. })
            });
            match state.map(|event| &mut event.what) {
                Some(EventKind::State {
                    error: true,
                    code: reported @ None,
                    ..
                }) => *reported = Some(code),
                _ => self.event(at, EventScope::Device(index), EventKind::Code(code)),
            }
        }
    }

    /// Processes a message if the address is a mailbox.
    fn mail(&mut self, index: usize, at: u64, to_device: bool, address: u16, data: &[u8]) {
        let Some(device) = self.devices.get_mut(index) else {
            return;
        };
        if address < PROCESS_MEMORY {
            return;
        }
        let (mut known, mut fits) = (false, false);
        for sm in device.registers.sync_managers().filter(|sm| sm.mailbox) {
            known = true;
            fits |= sm.start == address && sm.output == to_device;
        }
        if fits || !known && mailbox::plausible(data) {
            let reported = device.mailbox.message(at, to_device, data);
            self.record_mailbox_events(at, index, reported);
        }
    }

    fn record_mailbox_events(&mut self, at: u64, index: usize, reported: Vec<MailboxEvent>) {
        for reported in reported {
            let (at, what) = match reported {
                MailboxEvent::Transfer(transfer) => {
                    if let Some(device) = self.devices.get_mut(index)
                        && device.objects.learn(&transfer)
                    {
                        self.version += 1;
                    }
                    (transfer.began, EventKind::Transfer(Box::new(transfer)))
                }
                MailboxEvent::Emergency(emergency) => (at, EventKind::Emergency(emergency)),
                MailboxEvent::File(file) => (file.began, EventKind::File(Box::new(file))),
                MailboxEvent::Idn(idn) => (idn.began, EventKind::Idn(Box::new(idn))),
                MailboxEvent::ObjectList(count) => (at, EventKind::ObjectList(count)),
                MailboxEvent::NoInformation(code) => (at, EventKind::NoInformation(code)),
                MailboxEvent::Refused(code) => (at, EventKind::Refused(code)),
            };
            self.event(at, EventScope::Device(index), what);
        }
    }

    /// Evaluates the axes in process data.
    fn process_data(&mut self, key: Key, passed: &DatagramExchange<'_>) {
        if self.located != Some(self.version) {
            self.located = Some(self.version);
            for device in &mut self.devices {
                device.locate(&mut self.known);
            }
        }
        let mut happened = Vec::new();
        for (index, device) in self.devices.iter_mut().enumerate() {
            device
                .axes
                .process_data(passed, &mut self.rows, |what| happened.push((index, what)));
        }
        if let Some(rows) = &mut self.rows {
            let in_op = |device: &Device| device.state.is_none_or(|state| state == AlState::Op);
            rows.end_datagram(key, self.devices.iter().all(in_op));
        }
        for (index, what) in happened {
            self.event(passed.at, EventScope::Device(index), what);
        }
    }
}

impl Device {
    /// Stores the requested state, and when errors were acknowledged.
    fn request(&mut self, asked: (AlState, bool), at: u64) {
        self.asked = Some(asked);
        if asked.1 {
            self.acknowledged_at = Some(at);
        }
    }

    /// Updates the state. Returns true if it changed.
    fn enters(&mut self, state: AlState, error: bool, code: Option<u16>) -> bool {
        let fresh =
            (self.state, self.error) != (Some(state), error) || code.is_some() && self.code != code;
        (self.state, self.error) = (Some(state), error);
        if code.is_some() || !error {
            self.code = code;
        }
        if self.reached.last() != Some(&state) && self.reached.len() < 64 {
            self.reached.push(state);
        }
        let higher = self
            .configured
            .as_ref()
            .is_none_or(|(s, _)| s.code() <= state.code());
        if fresh && higher {
            self.configured = Some((state, self.registers.clone()));
        }
        fresh
    }

    fn locate(&mut self, known: &mut Context) {
        let eeprom = &self.eeprom;
        let identity = self.objects.identity();
        let vendor = eeprom.vendor().or(identity.0);
        let product = eeprom.product().or(identity.1);
        let revision = eeprom.revision().or(identity.2);
        let layout = known.layout(self.position, vendor, product, revision);
        self.axes
            .locate(&self.registers, &self.objects, layout.as_deref());
        for axis in &mut self.axes.axes {
            let number = usize::from(axis.number);
            axis.index = known.axis_index(self.position, product, number);
        }
    }
}

/// True if a write changes the mapping of process data.
fn touches(register: u16, data: &[u8]) -> bool {
    let end = usize::from(register) + data.len();
    usize::from(register) < usize::from(MAPPING.end) && end > usize::from(MAPPING.start)
}

/// Returns AL control even if only its low byte was written.
fn low(register: u16, data: &[u8]) -> Option<u16> {
    part(register, data, registers::AL_CONTROL, 1)?
        .first()
        .map(|byte| u16::from(*byte))
}

/// Returns the state requested by AL control, and whether it acknowledges errors.
fn asked(control: u16) -> (AlState, bool) {
    (AlState::from_status(control as u8), control & 0x10 != 0)
}

fn requested(control: u16) -> EventKind {
    let (state, acknowledge) = asked(control);
    EventKind::Requested { state, acknowledge }
}
