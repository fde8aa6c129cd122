//! The gateway as NMT master of the secondary network (CiA 302-2). It boots its slaves (identity,
//! configuration, error control), monitors them and executes the control word.
//!
//! * here: the data of each node, NMT services, states
//! * `boot`, `watch`: a slave's boot; error control
//! * `lss`: numbers for nodes without DIP switches
//! * `requests`: SDO transfers

mod boot;
mod lss;
mod requests;
mod watch;

use std::collections::VecDeque;

use super::can::CanFrame;
use super::control::Target;
use super::nmt::{NmtCommand, NmtState};
use super::options::Setting;
use super::sdo::Client;
use super::{Abort, Gateway};

/// The control word does not permit OPERATIONAL (slave mode).
const NOT_PERMITTED: u16 = 0xff10;

#[derive(Debug, Clone, Default, PartialEq, Eq)]
enum Boot {
    #[default]
    Waiting,
    /// Resets the node to its factory values.
    Factory,
    /// Compares this line of the configuration's date and time.
    Configured(usize),
    /// Reads this line of the identity.
    Identity(usize),
    /// Writes this setting.
    Settings(usize),
    Ready,
    Refused,
}

#[derive(Debug, Clone)]
struct Guard {
    period: u64,
    /// Unanswered requests until the node fails.
    retries: u8,
    unanswered: u8,
    next: u64,
    /// The toggle bit of the next answer. `None` accepts either value.
    toggle: Option<bool>,
}

/// One node number.
#[derive(Debug, Clone)]
struct Slave {
    boot: Boot,
    settings: Vec<Setting>,
    /// The heartbeat consumer time. 0: no heartbeat is expected.
    consumer: u64,
    deadline: u64,
    guard: Option<Guard>,
    /// The last reported state.
    state: Option<u8>,
    error: bool,
    /// The node has its factory values.
    restored: bool,
}

impl Default for Slave {
    fn default() -> Self {
        Self {
            boot: Boot::Waiting,
            settings: Vec::new(),
            consumer: 0,
            deadline: u64::MAX,
            guard: None,
            state: None,
            error: false,
            restored: false,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Purpose {
    Boot,
    /// A transfer of [`Gateway::request_sdo`].
    Tool,
}

#[derive(Debug, Clone)]
struct Request {
    node: u8,
    index: u16,
    sub: u8,
    data: Option<Vec<u8>>,
    purpose: Purpose,
}

/// A finished SDO transfer with a node.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct SdoResult {
    /// The node number.
    pub node: u8,
    /// The index of the object.
    pub index: u16,
    /// The subindex of the object.
    pub sub: u8,
    /// The data of an upload; empty after a download.
    pub data: Result<Vec<u8>, Abort>,
}

#[derive(Debug, Clone)]
pub(super) struct Master {
    slaves: Vec<Slave>,
    queue: VecDeque<Request>,
    active: Option<(Request, Client, u64)>,
    pub(super) results: VecDeque<SdoResult>,
    lss: lss::Lss,
}

impl Default for Master {
    fn default() -> Self {
        Self {
            slaves: vec![Slave::default(); 128],
            queue: VecDeque::new(),
            active: None,
            results: VecDeque::new(),
            lss: lss::Lss::default(),
        }
    }
}

impl Master {
    /// Returns the common state of all assigned slaves, as in 0x1F82: missing if one is missing,
    /// unknown if they differ.
    fn common(states: impl Iterator<Item = u8>) -> u8 {
        let mut common = None;
        for state in states {
            match (common, state) {
                (_, 1) => return 1,
                (None, _) => common = Some(state),
                (Some(known), _) if known != state => common = Some(0),
                _ => {}
            }
        }
        common.unwrap_or(0)
    }

    pub(super) fn due(&self) -> u64 {
        let sdo = self.active.as_ref().map_or(u64::MAX, |(.., at)| *at);
        let slaves = self.slaves.iter().map(|slave| {
            let guard = slave.guard.as_ref().map_or(u64::MAX, |guard| guard.next);
            slave.deadline.min(guard)
        });
        slaves.fold(sdo.min(self.lss.due), u64::min)
    }

    fn slave(&mut self, node: u8) -> Option<&mut Slave> {
        self.slaves.get_mut(usize::from(node))
    }

    /// Returns the lowest node in error, or 0.
    pub(super) fn error_node(&self) -> u8 {
        let first = self.slaves.iter().position(|slave| slave.error);
        first.map_or(0, |node| node as u8)
    }

    /// Drops the states and boot requests of nodes that are being reset.
    fn forget(&mut self, node: Option<u8>) {
        for (n, slave) in self.slaves.iter_mut().enumerate() {
            if node.is_none_or(|node| usize::from(node) == n) {
                slave.boot = Boot::Waiting;
                (slave.deadline, slave.state, slave.guard) = (u64::MAX, None, None);
            }
        }
        let own = |request: &Request| node.is_none_or(|node| request.node == node);
        self.queue
            .retain(|request| request.purpose == Purpose::Tool || !own(request));
        self.active
            .take_if(|(request, ..)| request.purpose == Purpose::Boot && own(request));
    }
}

impl Gateway {
    fn assignment(&self, node: u8) -> u32 {
        self.d.get(0x1f81, node) as u32
    }

    fn start_up(&self) -> u32 {
        self.d.get(0x1f80, 0) as u32
    }

    pub(super) fn is_master(&self) -> bool {
        self.start_up() & 1 != 0
    }

    fn nmt(&mut self, command: NmtCommand, node: u8, now: u64) {
        let frame = CanFrame::new(0, &[command.specifier(), node]);
        self.bus.send(self.options.node_id, frame, now);
        if command.leads_to() == NmtState::Initialising {
            self.master.forget(Some(node).filter(|node| *node != 0));
        }
    }

    /// Boots all slaves after the initialisation.
    pub(super) fn start_network(&mut self, now: u64) {
        self.load_consumers();
        if self.is_master() {
            self.nmt(NmtCommand::ResetCommunication, 0, now);
            self.start_boot_time(now);
        }
    }

    /// Returns the state of a node as in 0x1F82. Only monitored nodes have a state.
    pub(super) fn node_state(&self, node: u8) -> u8 {
        if node == self.options.node_id {
            return self.nmt.code();
        }
        match self.master.slaves.get(usize::from(node)) {
            Some(slave) if slave.error => 1,
            Some(slave) if slave.consumer > 0 || slave.guard.is_some() => slave.state.unwrap_or(0),
            _ => 0,
        }
    }

    /// Returns the state of the whole network.
    pub(super) fn network_state(&self) -> u8 {
        let assigned = (1..=127).filter(|node| self.assignment(*node) & 1 != 0);
        Master::common(assigned.map(|node| self.node_state(node)))
    }

    pub(super) fn is_guarded(&self, node: u8) -> bool {
        let slave = self.master.slaves.get(usize::from(node));
        slave.is_some_and(|slave| slave.guard.is_some())
    }

    /// Executes an NMT service for the module, one node or all nodes. Returns false if the service
    /// is not permitted now.
    pub(super) fn set_state(&mut self, command: NmtCommand, target: Target, now: u64) -> bool {
        if self.nmt == NmtState::Initialising {
            return false;
        }
        match target {
            Target::Module if !self.is_master() => match command {
                NmtCommand::Start => self.permit(true, now),
                NmtCommand::EnterPreOperational | NmtCommand::Stop => self.permit(false, now),
                reset => self.change_own(reset, now),
            },
            Target::Module => self.change_own(command, now),
            // A module that is not the master can command only itself.
            _ if !self.is_master() => return false,
            Target::Node(node) if node == self.options.node_id => self.change_own(command, now),
            Target::Node(node) => self.nmt(command, node, now),
            Target::Network => {
                if command == NmtCommand::Start && !self.mandatory_ready() {
                    return false;
                }
                self.nmt(command, 0, now);
                self.change_own(command, now);
            }
        }
        true
    }

    fn change_own(&mut self, command: NmtCommand, now: u64) {
        match command {
            NmtCommand::ResetNode | NmtCommand::ResetCommunication => {
                self.restart(command == NmtCommand::ResetNode, now);
            }
            _ => {
                let before = self.nmt;
                self.nmt = command.leads_to();
                if self.nmt == NmtState::Operational && before != self.nmt {
                    self.start_pdos();
                    self.start_slaves(now);
                }
            }
        }
    }

    /// Slave mode: the control word permits or forbids OPERATIONAL.
    pub(super) fn permit(&mut self, permitted: bool, now: u64) {
        self.permitted = permitted;
        if !permitted && self.nmt == NmtState::Operational {
            self.nmt = NmtState::PreOperational;
            self.emergency(NOT_PERMITTED, 0, now);
        }
    }

    /// Slave mode: handles a command of the NMT master.
    pub(super) fn nmt_service(&mut self, specifier: u8, node: u8, now: u64) {
        let own = node == 0 || node == self.options.node_id;
        let Some(command) = NmtCommand::from_specifier(specifier) else {
            return;
        };
        match command {
            _ if self.is_master() || !own => {}
            NmtCommand::Start if !self.permitted => self.emergency(NOT_PERMITTED, 0, now),
            command => {
                let permitted = self.permitted;
                self.change_own(command, now);
                // The control word outlasts a reset over the secondary network.
                self.permitted = permitted;
            }
        }
    }

    fn mandatory_ready(&self) -> bool {
        (1..=127).all(|node| {
            let ready = |slave: &Slave| slave.boot == Boot::Ready;
            self.assignment(node) & 0b1001 != 0b1001
                || self.master.slaves.get(usize::from(node)).is_some_and(ready)
        })
    }

    /// Starts booted slaves together with the master, unless the MainDevice starts them.
    fn start_slaves(&mut self, now: u64) {
        let allowed = self.nmt == NmtState::Operational
            && self.is_master()
            && self.start_up() & 1 << 3 == 0
            && self.mandatory_ready();
        if !allowed {
            return;
        }
        if self.start_up() & 1 << 1 != 0 {
            return self.nmt(NmtCommand::Start, 0, now);
        }
        for node in 1..=127 {
            let slave = self.master.slaves.get(usize::from(node));
            let starts = slave.is_some_and(|slave| {
                slave.boot == Boot::Ready && slave.state != Some(NmtState::Operational.code())
            });
            if starts {
                self.nmt(NmtCommand::Start, node, now);
            }
        }
    }
}
