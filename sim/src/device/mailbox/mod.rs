//! The device side of the mailbox (ETG.1000.4 §5.6). It processes requests one at a time and sends
//! answers and emergencies in order.
//!
//! * `queue`: outgoing messages, counters, repetition
//! * `options`: mailbox properties that the ESI leaves open
//!
//! [`crate::coe`], [`crate::foe`] and [`crate::eoe`] implement the protocols. A request stays in its SyncManager
//! until the device fetches it. While the device processes a request or too many answers wait, the
//! next request stays there and the mailbox is full.

mod options;
mod queue;

pub use options::MailboxOptions;
use queue::{Class, Queue};

use super::SimDevice;
use crate::coe::{self, CoeServer, CoeServices, Dictionary, ParameterCommand};
use crate::drive::Emergency;
use crate::eoe::{EoeFaults, EoeServer};
use crate::esc::al::AlState;
use crate::esc::registers as reg;
use crate::foe::{FoeRequest, FoeServer, Target};

/// The time in ns from the arrival of a request until the device fetches it.
const FETCH_NS: u64 = 100_000;
const HEADER: usize = 6;
/// The error code of emergencies that precede an answer: specific to the device (CiA 301).
const OWN_EMERGENCY: u16 = 0xff00;

/// Mailbox types (ETG.1000.4 table 29).
mod protocol {
    pub(super) const ERROR: u8 = 0;
    pub(super) const EOE: u8 = 2;
    pub(super) const COE: u8 = 3;
    pub(super) const FOE: u8 = 4;
    pub(super) const SOE: u8 = 5;
}

/// Mailbox error details (ETG.1000.4 table 30).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Detail {
    /// Error in the mailbox header itself.
    Syntax = 1,
    UnsupportedProtocol = 2,
    InvalidChannel = 3,
    ServiceNotSupported = 4,
    /// Error in the header of the protocol.
    InvalidHeader = 5,
    TooShort = 6,
    NoMoreMemory = 7,
    InvalidSize = 8,
}

/// The answer of a protocol to a request. Messages lack the mailbox header.
#[derive(Debug)]
pub(crate) enum Answer {
    None,
    One(Vec<u8>),
    Parts(Vec<Vec<u8>>),
    Error(Detail),
}

/// Maximum bytes of a message without the mailbox header.
#[derive(Debug, Clone, Copy)]
pub(crate) struct MailboxCapacity {
    /// Capacity for messages from the MainDevice.
    pub(crate) receive: usize,
    /// Capacity for messages to the MainDevice.
    pub(crate) send: usize,
}

#[derive(Debug, Clone)]
pub(super) struct Mailbox {
    /// The SyncManager numbers.
    pub(super) receive: usize,
    pub(super) send: usize,
    queue: Queue,
    /// Local times; `u64::MAX`: not due.
    fetch_due: u64,
    answer_due: u64,
    transfer_due: u64,
    /// The local time before which the device fetches no request.
    silent_until: u64,
    /// The request in progress.
    request: Vec<u8>,
    coe: CoeServer,
    foe: FoeServer,
    /// `None`: the device has no EoE.
    pub(super) eoe: Option<Box<EoeServer>>,
}

impl Mailbox {
    pub(super) fn new(receive: usize, send: usize) -> Self {
        Self {
            receive,
            send,
            queue: Queue::default(),
            fetch_due: u64::MAX,
            answer_due: u64::MAX,
            transfer_due: u64::MAX,
            silent_until: 0,
            request: Vec::new(),
            coe: CoeServer::default(),
            foe: FoeServer::default(),
            eoe: None,
        }
    }

    /// Drops all pending work, as entering or leaving Init does.
    pub(super) fn reset(&mut self) {
        let eoe = self.eoe.as_ref().map(|eoe| Box::new(eoe.restarted()));
        *self = Self {
            eoe,
            ..Self::new(self.receive, self.send)
        };
    }

    /// Lets requests wait until this local time.
    pub(super) fn be_silent_until(&mut self, local: u64) {
        self.silent_until = local;
    }

    /// Postpones all work to this local time or later.
    pub(super) fn rest_until(&mut self, local: u64) {
        for due in [
            &mut self.fetch_due,
            &mut self.answer_due,
            &mut self.transfer_due,
        ] {
            *due = (*due).max(local);
        }
    }

    /// Returns the local time of the next work for [`SimDevice::serve_mailbox`].
    pub(super) fn due(&self) -> u64 {
        let eoe = self.eoe.as_ref().map_or(u64::MAX, |eoe| eoe.due());
        let own = self.fetch_due.min(self.answer_due);
        own.min(self.transfer_due).min(eoe)
    }

    fn is_working(&self) -> bool {
        self.answer_due != u64::MAX
    }
}

impl SimDevice {
    /// Handles mailbox events of the MainDevice: a mailbox was filled or emptied, or a repeat
    /// requested.
    pub(super) fn mailbox_events(
        &mut self,
        written: u8,
        read: u8,
        repeat: Option<bool>,
        local: u64,
    ) {
        // In Init no application services the mailboxes.
        let Some(mailbox) = self
            .mailbox
            .as_mut()
            .filter(|_| self.al.state != AlState::Init)
        else {
            return;
        };
        if written >> mailbox.receive & 1 != 0 {
            let is_working = mailbox.is_working();
            mailbox.queue.written(is_working);
        }
        let n = mailbox.send;
        if read >> n & 1 != 0 {
            mailbox.queue.fetched();
        }
        if let Some(toggle) = repeat
            && let Some(sm) = self.esc.sms.get_mut(n)
            && mailbox.queue.repeat(toggle, sm.full)
        {
            sm.reset();
            let acknowledge = reg::SM + u16::try_from(n).unwrap_or(0) * 8 + 7;
            self.esc.put(acknowledge, &[u8::from(toggle) << 1]);
        }
        self.pump_mailbox();
        self.plan_fetch(local);
    }

    /// Schedules the fetch of a waiting request once the queue has room for its answer.
    pub(super) fn plan_fetch(&mut self, local: u64) {
        let Some(mailbox) = &mut self.mailbox else {
            return;
        };
        let sm = self.esc.sms.get(mailbox.receive);
        let lies_there = sm.is_some_and(|sm| sm.full);
        if lies_there
            && mailbox.fetch_due == u64::MAX
            && !mailbox.is_working()
            && mailbox.queue.takes_requests()
        {
            let fetch = local.saturating_add(FETCH_NS);
            mailbox.fetch_due = fetch.max(mailbox.silent_until);
        }
    }

    /// Moves the next message into the send SyncManager if that is empty.
    pub(super) fn pump_mailbox(&mut self) {
        if self.is_restarting() {
            return;
        }
        let room = self.room();
        let Some(mailbox) = &mut self.mailbox else {
            return;
        };
        let n = mailbox.send;
        let Some(sm) = self
            .esc
            .sms
            .get_mut(n)
            .filter(|sm| sm.is_open() && !sm.full)
        else {
            return;
        };
        if mailbox.queue.is_empty()
            && let Some(eoe) = &mut mailbox.eoe
            && let Some(message) = eoe.next_message(room)
        {
            mailbox.queue.push(protocol::EOE, &message, Class::Notice);
        }
        let Some(message) = mailbox.queue.next(usize::from(sm.len)) else {
            return;
        };
        sm.full = true;
        let (start, len) = (sm.start, sm.len);
        let area = self.esc.bytes_mut(start, len);
        area.fill(0);
        for (to, from) in area.iter_mut().zip(message) {
            *to = *from;
        }
        self.esc.refresh_sm(n);
    }

    /// Performs due work: a request to fetch, an answer, or the time-out of a segmented transfer.
    pub(super) fn serve_mailbox(&mut self, local: u64) {
        let Some(mailbox) = &mut self.mailbox else {
            return;
        };
        if mailbox.fetch_due <= local {
            mailbox.fetch_due = u64::MAX;
            self.fetch_request(local);
        } else if mailbox.answer_due <= local {
            mailbox.answer_due = u64::MAX;
            let request = std::mem::take(&mut mailbox.request);
            self.answer(&request);
            self.watch_transfer(local);
        } else if mailbox.transfer_due > local {
            self.work_ethernet(local);
        } else {
            mailbox.transfer_due = u64::MAX;
            if let Some(message) = mailbox.coe.expire() {
                mailbox.queue.push(protocol::COE, &message, Class::Notice);
            }
        }
        self.pump_mailbox();
        self.plan_fetch(local);
    }

    /// Schedules overdue work for now, after a time without mailbox service.
    pub(super) fn resume_mailbox(&mut self) {
        let now = self.local;
        let Some(mailbox) = &mut self.mailbox else {
            return;
        };
        for due in [
            &mut mailbox.fetch_due,
            &mut mailbox.answer_due,
            &mut mailbox.transfer_due,
        ] {
            *due = (*due).max(now);
        }
        self.plan_fetch(now);
    }

    fn fetch_request(&mut self, local: u64) {
        let Some(mailbox) = &mut self.mailbox else {
            return;
        };
        let n = mailbox.receive;
        let Some(sm) = self.esc.sms.get_mut(n).filter(|sm| sm.full) else {
            return;
        };
        sm.full = false;
        let (start, len) = (sm.start, sm.len);
        self.esc.refresh_sm(n);
        mailbox.request = self.esc.bytes(start, len).to_vec();
        mailbox.answer_due = local.saturating_add(self.mailbox_options.processing_ns);
        mailbox.transfer_due = u64::MAX;
    }

    fn watch_transfer(&mut self, local: u64) {
        if let Some(mailbox) = &mut self.mailbox
            && let Some(timeout) = self.mailbox_options.sdo_timeout_ns
            && mailbox.coe.is_waiting()
        {
            mailbox.transfer_due = local.saturating_add(timeout);
        }
    }

    fn answer(&mut self, request: &[u8]) {
        let room = self.room();
        let Some(mailbox) = &mut self.mailbox else {
            return;
        };
        let Some((&[low, high, _, _, channel, kind], rest)) = request.split_first_chunk() else {
            return;
        };
        let len = usize::from(u16::from_le_bytes([low, high]));
        let message = request.get(..HEADER + len).unwrap_or(request);
        if mailbox.queue.is_repeated(kind >> 4 & 7, message) {
            return;
        }
        let Some(payload) = rest.get(..len) else {
            return mailbox.queue.error(Detail::InvalidSize);
        };
        if kind & 0x80 != 0 {
            return mailbox.queue.error(Detail::Syntax);
        }
        // Six bits of channel, two of priority.
        if channel & 0x3f != 0 {
            return mailbox.queue.error(Detail::InvalidChannel);
        }
        if mailbox.queue.is_last_place() {
            return mailbox.queue.error(Detail::NoMoreMemory);
        }
        let protocol = kind & 0x0f;
        let answer = self.protocol_answer(protocol, payload, room);
        if self.obey_program_control() {
            return;
        }
        if !matches!(answer, Answer::None) {
            self.send_unsolicited();
        }
        let Some(mailbox) = &mut self.mailbox else {
            return;
        };
        match answer {
            Answer::None => {}
            Answer::One(message) => mailbox.queue.push(protocol, &message, Class::Answer),
            Answer::Parts(parts) => mailbox.queue.push_parts(protocol, &parts),
            Answer::Error(detail) => mailbox.queue.error(detail),
        }
    }

    /// Queues what the device sends before an answer. Only the application sends, not a boot loader.
    fn send_unsolicited(&mut self) {
        let options = &self.mailbox_options;
        let Some(mailbox) = &mut self.mailbox else {
            return;
        };
        if !self.has_coe || self.al.state == AlState::Boot {
            return;
        }
        let queue = &mut mailbox.queue;
        if options.sends_emergencies {
            let message = coe::emergency(OWN_EMERGENCY, 1, [0; 5]);
            queue.push(protocol::COE, &message, Class::Emergency);
        }
        if options.sends_requests {
            queue.push(protocol::COE, &coe::own_request(), Class::Notice);
        }
    }

    fn protocol_answer(&mut self, protocol: u8, payload: &[u8], room: MailboxCapacity) -> Answer {
        let (state, system) = (self.al.state, self.system_time_at(self.local));
        let options = &self.mailbox_options;
        let Some(mailbox) = &mut self.mailbox else {
            return Answer::None;
        };
        match protocol {
            // Bootstrap supports only FoE.
            protocol::COE if self.has_coe && state != AlState::Boot => {
                let services = CoeServices {
                    sdo_info: options.sdo_info.unwrap_or(self.sdo_info),
                    segmented: options.segmented,
                    abort_index_word: options.abort_index_word,
                    buffer: self
                        .processor
                        .as_ref()
                        .map_or(0, |processor| processor.flash.capacity())
                        .max(options.sdo_buffer),
                };
                let mut dictionary = Dictionary {
                    store: &mut self.store,
                    pdo: &mut self.pdo,
                    state,
                    complete_access: options.complete_access.unwrap_or(self.complete_access),
                    startup: &self.startup,
                    refuse_mapped: options.refuse_mapped,
                    forced: &self.forced_aborts,
                    ignored: &self.ignored_writes,
                    missing: options.missing,
                    command: None,
                    processor: self.processor.as_mut(),
                };
                let coe = &mut mailbox.coe;
                let answer = coe.request(&mut dictionary, services, payload, room);
                match dictionary.command {
                    Some(ParameterCommand::Store) => self.store_parameters(),
                    Some(ParameterCommand::Restore) => self.restore_parameters(),
                    None => {}
                }
                answer
            }
            // As in Bootstrap, an application without a network is in Init.
            protocol::EOE if state != AlState::Boot && mailbox.eoe.is_some() => {
                match &mut mailbox.eoe {
                    Some(eoe) => eoe.request(payload, room, self.local, system),
                    None => Answer::Error(Detail::UnsupportedProtocol),
                }
            }
            protocol::FOE if self.has_foe => {
                let bootstrap = state == AlState::Boot;
                let target = match &mut self.processor {
                    Some(processor) if bootstrap => Target::Program(&mut processor.flash),
                    _ => Target::Files(&mut self.files),
                };
                let request = FoeRequest {
                    options: &options.foe,
                    bootstrap,
                    now: self.local,
                    message: payload,
                    room,
                };
                mailbox.foe.request(target, request)
            }
            protocol::SOE if state != AlState::Boot => match &mut self.sercos {
                Some(sercos) => {
                    let now = (state, self.local);
                    sercos.request(&mut self.store, now, payload, room)
                }
                None => Answer::Error(Detail::UnsupportedProtocol),
            },
            _ => Answer::Error(Detail::UnsupportedProtocol),
        }
    }

    /// Sends a message of SoE without a request.
    pub(super) fn queue_soe(&mut self, message: &[u8]) {
        if matches!(self.al.state, AlState::Init | AlState::Boot) {
            return;
        }
        if let Some(mailbox) = &mut self.mailbox {
            mailbox.queue.push(protocol::SOE, message, Class::Emergency);
        }
        self.pump_mailbox();
    }

    /// Returns the system time at a local time, without distributed clocks the local time.
    fn system_time_at(&self, local: u64) -> u64 {
        self.esc.dc.as_ref().map_or(local, |dc| dc.system(local))
    }

    /// Lets the IP host behind the mailbox work.
    fn work_ethernet(&mut self, local: u64) {
        let eoe = self.mailbox.as_mut().and_then(|mailbox| mailbox.eoe.take());
        let Some(mut eoe) = eoe else { return };
        eoe.work(local, self.system_time_at(local), &|| self.web_page());
        if let Some(mailbox) = &mut self.mailbox {
            mailbox.eoe = Some(eoe);
        }
    }

    /// Disturbs the Ethernet traffic of the device.
    pub(crate) fn disturb_ethernet(&mut self, faults: EoeFaults) {
        let local = self.local;
        if let Some(eoe) = self
            .mailbox
            .as_mut()
            .and_then(|mailbox| mailbox.eoe.as_mut())
        {
            eoe.disturb(faults, local);
        }
    }

    /// Returns the web page of the device.
    fn web_page(&self) -> String {
        let mut rows = format!("<tr><td>state</td><td>{:?}</td></tr>\n", self.al.state);
        for (n, drive) in (1..).zip(self.axes()) {
            rows += &format!(
                "<tr><td>axis {n}</td><td>{:?}</td></tr>\n<tr><td>position</td><td>{}</td></tr>\n",
                drive.state(),
                drive.position_counts()
            );
        }
        format!(
            "<!DOCTYPE html>\n<html><head><title>{name}</title></head><body>\n<h1>{name}</h1>\n\
             <table>\n<tr><td>serial number</td><td>{}</td></tr>\n{rows}</table>\n</body></html>\n",
            self.serial,
            name = self.name
        )
    }

    fn room(&self) -> MailboxCapacity {
        let room = |n: Option<usize>| {
            let sm = n.and_then(|n| self.esc.sms.get(n));
            sm.map_or(0, |sm| usize::from(sm.len).saturating_sub(HEADER))
        };
        MailboxCapacity {
            receive: room(self.mailbox.as_ref().map(|mailbox| mailbox.receive)),
            send: room(self.mailbox.as_ref().map(|mailbox| mailbox.send)),
        }
    }

    pub(super) fn queue_emergency(&mut self, emergency: &Emergency) {
        if matches!(self.al.state, AlState::Init | AlState::Boot) || !self.has_coe {
            return;
        }
        let time = self
            .esc
            .dc
            .as_ref()
            .map_or(self.local, |dc| dc.system(self.local));
        coe::history::add(&mut self.store, emergency.code, time);
        if let Some(mailbox) = &mut self.mailbox {
            let message = coe::emergency(emergency.code, emergency.register, emergency.data);
            mailbox
                .queue
                .push(protocol::COE, &message, Class::Emergency);
        }
        self.pump_mailbox();
    }
}
