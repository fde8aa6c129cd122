//! A CANopen gateway in the cycle: its control and status word, the states of its nodes, and the
//! phase of its SYNC.
//!
//! An axis behind a gateway is an ordinary axis. Its objects lie at other offsets of the gateway's
//! process data, it steps once per SYNC, and its inputs are fresh while its node is Operational.
//!
//! The control word (Anybus X-gateway, manual §6.2.1) carries a toggle bit, a command and a node.
//! The gateway echoes toggle bit and command in the status word. The first command starts the
//! gateway; the commands after it ask for its general status and the state of one node after
//! another. A node that waits to be started gets a command of its own. The last command leads all
//! nodes to PRE-OPERATIONAL, in which they exchange no process data.

use std::ops::Range;

use ecaxis_ecat::index::DeviceIndex;

/// The set-up of a gateway's part in the cycle.
#[derive(Debug, Clone)]
pub struct GatewayConfig {
    pub device: DeviceIndex,
    /// The bytes of its inputs and outputs in the image.
    pub inputs: Range<usize>,
    pub outputs: Range<usize>,
    /// The SYNC period in cycles.
    pub sync_cycles: u32,
    /// The node-IDs of its axes.
    pub nodes: Vec<u8>,
    /// The cycles within which a command must be acknowledged.
    pub timeout_cycles: u32,
}

/// The location of an axis behind a gateway.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NodePlace {
    /// The index of the gateway in the cycle.
    pub gateway: usize,
    /// The index of the node in [`GatewayConfig::nodes`].
    pub node: usize,
}

/// The state of a node as the gateway reports it (manual §6.2.2), or why it is not known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum NodeState {
    PreOperational,
    Operational,
    Resetting,
    Stopped,
    /// Not monitored, or not heard yet.
    #[default]
    Unknown,
    /// Its heartbeat is missing.
    Missing,
    /// The status word names it as the node in error.
    InError,
    /// The gateway does not acknowledge commands.
    NoAcknowledgement,
    /// A reserved code.
    Other(u8),
}

impl NodeState {
    const fn from_code(code: u8) -> Self {
        match code {
            0 => Self::PreOperational,
            1 => Self::Operational,
            2 | 3 => Self::Resetting,
            4 => Self::Stopped,
            5 => Self::Unknown,
            6 => Self::Missing,
            other => Self::Other(other),
        }
    }
}

impl std::fmt::Display for NodeState {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::PreOperational => "PRE-OPERATIONAL",
            Self::Operational => "OPERATIONAL",
            Self::Resetting => "in reset",
            Self::Stopped => "STOPPED",
            Self::Unknown => "in no known state",
            Self::Missing => "missing: its heartbeat has failed",
            Self::InError => "in error: the gateway names it in its status word",
            Self::NoAcknowledgement => {
                "unreachable: the gateway does not acknowledge its control word"
            }
            Self::Other(code) => return write!(f, "in reserved state {code}"),
        })
    }
}

/// A command for the NMT state of a node (CiA 301), with its code in the control word.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum NodeCommand {
    PreOperational = 0,
    Start = 1,
    Reset = 2,
    Stop = 4,
}

impl NodeCommand {
    /// Returns true for a state in which the node stays until another command.
    const fn rests(self) -> bool {
        matches!(self, Self::PreOperational | Self::Stop)
    }
}

const TOGGLE: u8 = 0x80;
const COMMAND: u8 = 0x70;
const EXTENSION: u8 = 0x0f;
const SET_STATE: u8 = 0x00;
/// Set NMT state OPERATIONAL, of the gateway itself. It then starts its nodes.
const START: [u8; 2] = [0x01, 0];
/// Set NMT state PRE-OPERATIONAL, of all nodes and the gateway.
const END: [u8; 2] = [0x00, 128];
const GET_NODE_STATE: u8 = 0x10;
const GET_GENERAL_STATUS: u8 = 0x20;

/// The general status of the CANopen module (manual §6.2.2).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct GeneralStatus(pub u8);

impl GeneralStatus {
    /// The bits and their meaning.
    const BITS: [(u8, &'static str); 4] = [
        (1 << 0, "CAN bus off"),
        (1 << 1, "CAN error passive"),
        (1 << 2, "node guarding or heartbeat error"),
        (1 << 3, "SYNC error"),
    ];

    /// Returns the meaning of each bit that is set.
    pub fn texts(self) -> impl Iterator<Item = &'static str> {
        Self::BITS
            .into_iter()
            .filter(move |(bit, _)| self.0 & bit != 0)
            .map(|(_, text)| text)
    }
}

/// The part of a run that a gateway is in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum Stage {
    /// The module is not started yet.
    #[default]
    Starting,
    Running,
    /// The last command or the command to all nodes waits for its acknowledgement.
    Ending,
    Ended,
}

/// A gateway in the cycle. All functions: RT, O(nodes + bytes).
#[derive(Debug)]
pub struct Gateway {
    config: GatewayConfig,
    /// The control word that waits for its acknowledgement. `None` before the first command.
    command: Option<[u8; 2]>,
    /// Cycles since the command was issued.
    waiting: u32,
    stage: Stage,
    states: Box<[NodeState]>,
    /// The nodes that have been Operational in this Op.
    reached: Box<[bool]>,
    /// The times that each node was lost.
    losses: Box<[u32]>,
    /// The last command to each node: until it is acknowledged, or as long as the node rests by it.
    commanded: Box<[Option<NodeCommand>]>,
    /// The nodes whose command is not acknowledged yet.
    pending: Box<[bool]>,
    /// The node of the next question; beyond the last: the general status, then the module.
    asked: usize,
    /// The general status at the last answer, and all bits of this run.
    general: GeneralStatus,
    general_seen: GeneralStatus,
    previous: Box<[u8]>,
    sync: SyncPhase,
}

impl Gateway {
    #[must_use]
    #[allow(
        clippy::disallowed_methods,
        clippy::disallowed_macros,
        reason = "runs before the loop"
    )]
    pub fn new(config: GatewayConfig) -> Self {
        Self {
            command: None,
            waiting: 0,
            stage: Stage::default(),
            states: vec![NodeState::default(); config.nodes.len()].into(),
            reached: vec![false; config.nodes.len()].into(),
            losses: vec![0; config.nodes.len()].into(),
            commanded: vec![None; config.nodes.len()].into(),
            pending: vec![false; config.nodes.len()].into(),
            asked: 0,
            general: GeneralStatus::default(),
            general_seen: GeneralStatus::default(),
            previous: vec![0; config.inputs.len()].into(),
            sync: SyncPhase::new(config.sync_cycles),
            config,
        }
    }

    #[must_use]
    pub fn device(&self) -> DeviceIndex {
        self.config.device
    }

    #[must_use]
    pub fn sync_cycles(&self) -> u32 {
        self.config.sync_cycles
    }

    /// Returns the state of a node.
    #[must_use]
    pub fn state(&self, node: usize) -> NodeState {
        self.states.get(node).copied().unwrap_or_default()
    }

    /// Returns the node-IDs with their states and the times that each was lost.
    pub fn nodes(&self) -> impl Iterator<Item = (u8, NodeState, u32)> {
        let counts = self.states.iter().zip(&self.losses);
        let nodes = self.config.nodes.iter().zip(counts);
        nodes.map(|(id, (state, losses))| (*id, *state, *losses))
    }

    /// Returns the general status at the last answer.
    #[must_use]
    pub fn general(&self) -> GeneralStatus {
        self.general
    }

    /// Returns all bits of the general status in this run.
    #[must_use]
    pub fn general_seen(&self) -> GeneralStatus {
        self.general_seen
    }

    /// Commands the NMT state of a node. The caller has checked that its axis has no power. The node
    /// is not lost until it is Operational again.
    pub fn command(&mut self, node: usize, command: NodeCommand) {
        let pending = self.pending.get_mut(node);
        let known = pending.zip(self.commanded.get_mut(node));
        if let Some((pending, commanded)) = known {
            (*pending, *commanded) = (true, Some(command));
        }
        if let Some(reached) = self.reached.get_mut(node) {
            *reached = false;
        }
    }

    /// Takes the acknowledgement of an NMT command to a node.
    fn take_command(&mut self, node: usize, code: u8) {
        let Some(command) = self.commanded.get(node).copied().flatten() else {
            return;
        };
        if command as u8 != code {
            return;
        }
        if let Some(pending) = self.pending.get_mut(node) {
            *pending = false;
        }
        if let Some(commanded) = self.commanded.get_mut(node).filter(|_| !command.rests()) {
            *commanded = None;
        }
        self.set_state(
            node,
            match command {
                NodeCommand::PreOperational => NodeState::PreOperational,
                NodeCommand::Stop => NodeState::Stopped,
                NodeCommand::Reset => NodeState::Resetting,
                NodeCommand::Start => NodeState::Unknown,
            },
        );
    }

    /// Ends the exchange of process data with all nodes. The commands to the drives must have
    /// arrived before.
    pub fn end(&mut self) {
        self.stage = match self.stage {
            Stage::Starting => Stage::Ended,
            Stage::Running => Stage::Ending,
            ending => ending,
        };
    }

    /// True once the gateway has acknowledged the end, or if it was never started.
    #[must_use]
    pub fn has_ended(&self) -> bool {
        self.stage == Stage::Ended
    }

    /// Returns the state of a node that was Operational before and is not now.
    #[must_use]
    pub fn lost(&self, node: usize) -> Option<NodeState> {
        if matches!(self.stage, Stage::Ending | Stage::Ended) {
            return None;
        }
        let reached = self.reached.get(node).copied().unwrap_or(false);
        Some(self.state(node)).filter(|state| reached && *state != NodeState::Operational)
    }

    /// True in the cycle in which the gateway's axes step.
    #[must_use]
    pub fn is_due(&self) -> bool {
        self.sync.is_due()
    }

    /// Reads the status word and the phase of SYNC. `running`: the bus is in Op. `powered`: an axis
    /// of the gateway has power, so its steps keep their distance.
    pub fn observe(&mut self, image: &[u8], fresh: bool, running: bool, powered: bool) {
        let data = image.get(self.config.inputs.clone()).unwrap_or_default();
        let own = data.len().min(2);
        let changed = fresh && data.get(own..) != self.previous.get(own..);
        if changed && let Some(previous) = self.previous.get_mut(..data.len()) {
            previous.copy_from_slice(data);
        }
        self.sync.step(changed, powered);
        if !running {
            (self.command, self.waiting) = (None, 0);
            self.reached.fill(false);
            self.commanded.fill(None);
            self.pending.fill(false);
            // The states at the end of a run stay for its summary.
            if self.stage != Stage::Ended {
                self.stage = Stage::Starting;
                self.states.fill(NodeState::Unknown);
            }
            return;
        }
        self.waiting = self.waiting.saturating_add(1);
        let Some(&[status, error]) = data.get(..2).filter(|_| fresh) else {
            return;
        };
        self.take_status(status, error);
    }

    fn take_status(&mut self, status: u8, error: u8) {
        match (self.command, self.stage) {
            (_, Stage::Ended) => return,
            (None, _) => self.issue(START, status),
            (Some([byte, node]), _) if acknowledges(byte, status) => {
                self.take_answer([byte & COMMAND, node], status);
            }
            (Some(_), Stage::Running) if self.waiting > self.config.timeout_cycles => {
                self.lose_all();
            }
            // The status word may acknowledge the command before: then the gateway has ignored this
            // one, because its toggle bit is not new.
            (Some([byte, _]), Stage::Ending)
                if (byte ^ status) & TOGGLE == 0 || self.waiting > self.config.timeout_cycles =>
            {
                self.issue(END, status);
            }
            // The gateway has acknowledged a command of an earlier run, and has ignored this one.
            (Some([byte, _]), Stage::Starting) if (byte ^ status) & TOGGLE == 0 => {
                self.issue(START, status);
            }
            (Some(_), _) => {}
        }
        // Faster than the question, but it names the lowest node only.
        let mut nodes = self.config.nodes.iter();
        if let Some(node) = nodes.position(|node| *node == error)
            && self.state(node) == NodeState::Operational
        {
            self.set_state(node, NodeState::InError);
        }
        let nodes = self.states.iter().zip(&self.commanded);
        for (reached, (state, commanded)) in self.reached.iter_mut().zip(nodes) {
            *reached |= *state == NodeState::Operational && commanded.is_none();
        }
    }

    /// Takes an acknowledged command and issues the next one.
    fn take_answer(&mut self, [command, of]: [u8; 2], status: u8) {
        let code = status & EXTENSION;
        let state = NodeState::from_code(code);
        let waits = matches!(state, NodeState::PreOperational | NodeState::Stopped);
        let mut start = None;
        match (self.stage, command) {
            // A command that replaces an unacknowledged one would have its toggle bit.
            (Stage::Ending, _) if of != END[1] => return self.issue(END, status),
            (Stage::Ending, _) => {
                self.stage = Stage::Ended;
                for state in &mut self.states {
                    if *state == NodeState::Operational {
                        *state = NodeState::PreOperational;
                    }
                }
                return;
            }
            // The module itself, after a reset.
            (Stage::Running, GET_NODE_STATE) if of == 0 => {
                start = Some(START).filter(|_| waits);
                self.asked = 0;
            }
            (Stage::Running, GET_NODE_STATE) => {
                // The gateway starts most nodes itself: only a node that stays there is started.
                let stays = waits && self.state(self.asked) == state;
                let rests = self.commanded.get(self.asked).is_some_and(Option::is_some);
                start = Some([NodeCommand::Start as u8, of]).filter(|_| stays && !rests);
                self.set_state(self.asked, state);
                self.asked += 1;
            }
            (Stage::Running, GET_GENERAL_STATUS) => {
                self.general = GeneralStatus(code);
                self.general_seen.0 |= self.general.0;
                self.asked += 1;
            }
            (Stage::Running, _) => {
                if let Some(node) = self.config.nodes.iter().position(|node| *node == of) {
                    self.take_command(node, code);
                }
            }
            _ => self.stage = Stage::Running,
        }
        let mut nodes = self
            .config
            .nodes
            .iter()
            .zip(&self.commanded)
            .zip(&self.pending);
        let commanded = nodes.find_map(|((node, commanded), pending)| {
            let command = commanded.filter(|_| *pending)?;
            Some([command as u8, *node])
        });
        let next = match self.config.nodes.get(self.asked) {
            Some(node) => [GET_NODE_STATE, *node],
            None if self.asked == self.config.nodes.len() => [GET_GENERAL_STATUS, 0],
            None => [GET_NODE_STATE, 0],
        };
        self.issue(commanded.or(start).unwrap_or(next), status);
    }

    fn set_state(&mut self, node: usize, state: NodeState) {
        let reached = self.reached.get(node).copied().unwrap_or(false);
        let Some(before) = self.states.get_mut(node) else {
            return;
        };
        let begins = *before == NodeState::Operational && state != NodeState::Operational;
        *before = state;
        if let Some(losses) = self.losses.get_mut(node).filter(|_| reached && begins) {
            *losses = losses.saturating_add(1);
        }
    }

    fn lose_all(&mut self) {
        for node in 0..self.states.len() {
            self.set_state(node, NodeState::NoAcknowledgement);
        }
    }

    /// Issues a command with the toggle bit that differs from the status word's.
    fn issue(&mut self, [byte, node]: [u8; 2], status: u8) {
        self.command = Some([byte | !status & TOGGLE, node]);
        self.waiting = 0;
    }

    /// Writes the control word; leaves the outputs unchanged before the first command.
    pub fn write(&self, image: &mut [u8]) {
        if let Some(command) = self.command
            && let Some(outputs) = image.get_mut(self.config.outputs.clone())
            && let Some(to) = outputs.first_chunk_mut()
        {
            *to = command;
        }
    }
}

/// Returns true if the status word acknowledges a control word with this first byte. The answer to
/// "Set NMT state" also repeats the extension (manual §6.2.2).
const fn acknowledges(byte: u8, status: u8) -> bool {
    let extension = match byte & COMMAND {
        SET_STATE => EXTENSION,
        _ => 0,
    };
    (byte ^ status) & (TOGGLE | COMMAND | extension) == 0
}

/// The phase of SYNC in the cycle, seen from the inputs that change after it.
///
/// The axes step in the cycle that first shows the inputs of a SYNC. A single change at another
/// time moves nothing, because the clocks of gateway and bus differ and a reading may be a cycle
/// early or late.
#[derive(Debug, Clone, Copy)]
struct SyncPhase {
    cycles: u32,
    phase: u32,
    /// Cycles since the inputs changed.
    quiet: u32,
    /// Changes in a row that came late (positive) or early.
    votes: i32,
    /// The phase stays for one cycle.
    hold: bool,
}

/// The changes in a row that move the phase by one cycle.
const VOTES: i32 = 3;

impl SyncPhase {
    const fn new(cycles: u32) -> Self {
        Self {
            cycles: if cycles == 0 { 1 } else { cycles },
            phase: 0,
            quiet: u32::MAX,
            votes: 0,
            hold: false,
        }
    }

    const fn is_due(&self) -> bool {
        self.phase == 0
    }

    fn step(&mut self, changed: bool, powered: bool) {
        if !std::mem::take(&mut self.hold) {
            self.phase = (self.phase + 1) % self.cycles;
        }
        self.quiet = self.quiet.saturating_add(1);
        if !changed {
            return;
        }
        // The nodes answer one SYNC in one or two cycles; the first of them counts.
        let first = self.quiet > self.cycles / 2;
        if !first {
            return;
        }
        self.quiet = 0;
        if self.phase == 0 {
            self.votes = 0;
        } else if !powered {
            self.phase = 0;
        } else {
            let late = self.phase <= self.cycles / 2;
            let vote = if late { 1 } else { -1 };
            self.votes = if self.votes.signum() == vote {
                self.votes + vote
            } else {
                vote
            };
            if self.votes.abs() >= VOTES {
                self.votes = 0;
                if late {
                    self.hold = true;
                } else {
                    self.phase = (self.phase + 1) % self.cycles;
                }
            }
        }
    }
}

#[cfg(test)]
#[path = "gateway_tests.rs"]
mod tests;
