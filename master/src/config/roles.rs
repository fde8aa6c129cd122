//! The roles of process data: the one owner of each output bit, and what each input decides.
//!
//! The registry is built once from the machine file. `check` refuses a second owner of a bit, and an
//! input whose loss would go unseen. The cycle asks which outputs are off after their device has
//! returned. Controllers and clients claim outputs before they set them.

use std::ops::Range;

use ecaxis_ecat::index::{AxisIndex, DeviceIndex, IndexVec};
use ecaxis_esi as esi;
use ecaxis_esi::layout::Field;

use super::copy::bits_of;
use super::problem::{Problems, Span};
use super::signal::{self, SignalDirection};
use super::steps::{ResolvedAxis, ResolvedDevice};
use super::{BitRange, DeviceConfig, GroupStopScope, NodeSetup, Signal, StopSetup};
use crate::rt::config::ProcessDataCopy;

/// Objects that only the axes write (CiA 402, ETG.6010).
const AXIS_OUTPUTS: [u16; 11] = [
    0x6040, 0x6060, 0x6071, 0x607a, 0x6081, 0x6083, 0x6084, 0x60b1, 0x60b2, 0x60b8, 0x60ff,
];
/// The position offset adds to the target position; the axis keeps it at zero.
const POSITION_OFFSET: u16 = 0x60b0;
/// Digital outputs of a node's drive: the object of EPOS 24 and 70, and that of CiA 402.
const NODE_DIGITAL_OUTPUTS: [u16; 2] = [0x2078, 0x60fe];
/// The control word of a CANopen gateway and its node, in bits.
const CONTROL_WORD: Range<u32> = 0..16;

/// The kind of an owner of outputs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum OwnerKind {
    /// An object that the axis of a drive writes.
    Axis,
    /// An object that adds to the target of an axis.
    AxisOffset,
    /// An object of an axis that the machine file does not use.
    UnusedAxis,
    /// The output that opens the brake of an axis.
    Brake,
    /// An output PDO of a node with an axis, behind a gateway.
    Node,
    /// The control word of a CANopen gateway.
    ControlWord,
    /// An object that another PDO of the device maps as well.
    Repetition,
    PositionOutput,
    Copy,
    /// A copy of the frames of a safety connection.
    SafetyCopy,
    /// Steps `set` of the program.
    Step,
    Controller,
    /// The request `output` of a client.
    Client,
}

/// What an output of a returned device does until the reset of its group.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ReturnRule {
    /// Its owner has its own rule.
    Owner,
    /// It has its value from the start of the run: off.
    Off,
    /// The value passes; its receiver judges it.
    Pass,
}

/// One row of the documented table: the owner, and its outputs while the device is lost, after its
/// return, and after the reset of its group.
pub type OwnerRow = [&'static str; 4];

impl OwnerKind {
    pub const ALL: [Self; 13] = [
        Self::Axis,
        Self::AxisOffset,
        Self::UnusedAxis,
        Self::Brake,
        Self::Node,
        Self::ControlWord,
        Self::Repetition,
        Self::PositionOutput,
        Self::Copy,
        Self::SafetyCopy,
        Self::Step,
        Self::Controller,
        Self::Client,
    ];

    /// Returns true for program, controllers and clients: one of them commands the machine at a
    /// time, so they are one owner.
    const fn commands(self) -> bool {
        matches!(self, Self::Step | Self::Controller | Self::Client)
    }

    /// Returns the rule for a device that has returned, until its group is reset.
    #[must_use]
    pub const fn on_return(self) -> ReturnRule {
        match self {
            Self::Axis
            | Self::AxisOffset
            | Self::UnusedAxis
            | Self::Brake
            | Self::Node
            | Self::ControlWord
            | Self::Repetition => ReturnRule::Owner,
            Self::PositionOutput | Self::Copy | Self::Step | Self::Controller | Self::Client => {
                ReturnRule::Off
            }
            Self::SafetyCopy => ReturnRule::Pass,
        }
    }

    /// Returns the row of `docs/stops.md`.
    #[must_use]
    pub const fn row(self) -> OwnerRow {
        const WATCHDOG: &str = "as its device decides (watchdog)";
        match self {
            Self::Axis => [
                "axis",
                "`stop.bus_lost`",
                "no power",
                "no power until `enable`",
            ],
            Self::AxisOffset => ["position offset of an axis (0x60B0)", "0", "0", "0"],
            Self::UnusedAxis => ["axis of a drive that is not used", "0", "0", "0"],
            Self::Brake => [
                "brake of an axis",
                "closed",
                "closed",
                "closed until the axis holds its position",
            ],
            Self::Node => [
                "node with an axis, behind a gateway",
                "`stop.bus_lost`",
                "no power",
                "no power until `enable`",
            ],
            Self::ControlWord => [
                "control word of a gateway",
                "no command",
                "starts the nodes",
                "asks for their states",
            ],
            Self::Repetition => [
                "second PDO with the same object",
                "as the first",
                "as the first",
                "as the first",
            ],
            Self::PositionOutput => ["`[[position_output]]`", WATCHDOG, "off", "by the position"],
            Self::Copy => ["`[[copy]]`", WATCHDOG, "off", "its input"],
            Self::SafetyCopy => ["`[[copy]]` with `fsoe`", WATCHDOG, "its input", "its input"],
            Self::Step => ["step `set`", WATCHDOG, "off", "off until it is set again"],
            Self::Controller => ["controller", WATCHDOG, "off", "off until it is set again"],
            Self::Client => [
                "request `output` of a client",
                WATCHDOG,
                "off",
                "off until it is set again",
            ],
        }
    }
}

/// The owner of outputs, with its place in the machine file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OutputOwner {
    pub kind: OwnerKind,
    /// The axis, the node or the object; empty if the kind says it all.
    subject: String,
    /// The line in the machine file; `None` for a controller or a client.
    line: Option<u32>,
}

impl OutputOwner {
    pub(super) fn new(kind: OwnerKind, subject: impl Into<String>, line: u32) -> Self {
        Self {
            kind,
            subject: subject.into(),
            line: Some(line),
        }
    }

    fn without_line(kind: OwnerKind) -> Self {
        Self {
            kind,
            subject: String::new(),
            line: None,
        }
    }

    fn place(&self) -> String {
        self.line
            .map_or_else(String::new, |line| format!(" in line {line}"))
    }

    /// Returns what the owner does with the output, to follow its name.
    fn predicate(&self) -> String {
        let (of, at) = (&self.subject, self.place());
        match self.kind {
            OwnerKind::Axis => format!("is written by the axis `{of}`{at}"),
            OwnerKind::AxisOffset => {
                format!("adds to the target of the axis `{of}`{at}, past its limits")
            }
            OwnerKind::UnusedAxis => format!("belongs to an axis of `{of}`{at} that is not used"),
            OwnerKind::Brake => format!("opens the brake of `{of}`{at}"),
            OwnerKind::Node => format!("carries {of}{at}"),
            OwnerKind::ControlWord => format!("is the control word of `{of}`{at}"),
            OwnerKind::Repetition => format!("repeats the object of PDO {of}, of the device{at}"),
            OwnerKind::PositionOutput => format!("is switched by the position_output{at}"),
            OwnerKind::Copy | OwnerKind::SafetyCopy => format!("is written by the copy{at}"),
            OwnerKind::Step => format!("is set by the step{at}"),
            OwnerKind::Controller => "is set by the controller".to_owned(),
            OwnerKind::Client => "is set by clients".to_owned(),
        }
    }

    /// Returns the owner as the subject of a sentence.
    fn noun(&self) -> String {
        let (of, at) = (&self.subject, self.place());
        match self.kind {
            OwnerKind::Axis | OwnerKind::AxisOffset => format!("the axis `{of}`{at}"),
            OwnerKind::UnusedAxis => format!("an unused axis of `{of}`{at}"),
            OwnerKind::Brake => format!("the brake of `{of}`{at}"),
            OwnerKind::Node => format!("{of}{at}"),
            OwnerKind::ControlWord => format!("the control word of `{of}`{at}"),
            OwnerKind::Repetition => format!("the repetition of PDO {of}, of the device{at}"),
            OwnerKind::PositionOutput => format!("the position_output{at}"),
            OwnerKind::Copy | OwnerKind::SafetyCopy => format!("the copy{at}"),
            OwnerKind::Step => format!("the step{at}"),
            OwnerKind::Controller => "a controller".to_owned(),
            OwnerKind::Client => "a client".to_owned(),
        }
    }

    fn hint(&self) -> &'static str {
        match self.kind {
            OwnerKind::Axis | OwnerKind::UnusedAxis | OwnerKind::Node => {
                "give the axis a command instead"
            }
            OwnerKind::AxisOffset => {
                "give the axis a command instead; `csp.velocity_offset` and `csp.torque_offset` act in CSP"
            }
            OwnerKind::Brake => "the axis opens and closes its brake",
            OwnerKind::ControlWord => {
                "ecaxis commands the gateway; the request `node` starts, stops or resets a node"
            }
            OwnerKind::Repetition => "write the object by its name: both PDOs then carry the value",
            _ => "an output has one owner: remove one of both, or write another output",
        }
    }
}

/// Output bits with their owner.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OwnedOutput {
    pub output: BitRange,
    pub owner: OutputOwner,
}

/// An output has another owner.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct OwnerConflict {
    pub message: String,
    pub hint: &'static str,
}

/// What an input decides.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InputUse {
    /// A condition of `stop.emergency`.
    Emergency,
    /// A condition of `override.hold`.
    Hold,
    /// `override.input`.
    Override,
    /// `program.pause`.
    Pause,
    /// `program.step`.
    Step,
    /// `second_encoder` of an axis.
    SecondEncoder,
    /// A condition of a step.
    Condition,
    /// The source of a copy.
    CopySource,
}

impl InputUse {
    pub const ALL: [Self; 8] = [
        Self::Emergency,
        Self::Hold,
        Self::Override,
        Self::Pause,
        Self::Step,
        Self::SecondEncoder,
        Self::Condition,
        Self::CopySource,
    ];

    /// Returns what would happen without the stop of the machine; `None` if the input may be lost
    /// while the machine goes on.
    const fn danger(self) -> Option<&'static str> {
        match self {
            Self::Emergency => Some("an emergency would go unseen"),
            Self::Hold => Some("a hold would go unseen"),
            Self::Override => Some("the override would keep its last value"),
            Self::Pause => Some("a pause would go unseen"),
            Self::Step => Some("a button would go unseen"),
            Self::SecondEncoder => Some("the axis would move without its encoder"),
            Self::Condition | Self::CopySource => None,
        }
    }

    /// Returns the row of `docs/stops.md`: the input, its group, what its loss does, and what
    /// follows the return and the reset.
    #[must_use]
    pub const fn row(self) -> [&'static str; 5] {
        const MACHINE: &str = "one whose loss stops the machine";
        const STOPS: &str = "the machine stops";
        const ENDS: &str = "the run has ended";
        match self {
            Self::Emergency => ["condition of `stop.emergency`", MACHINE, STOPS, ENDS, ENDS],
            Self::Hold => ["condition of `override.hold`", MACHINE, STOPS, ENDS, ENDS],
            Self::Override => ["`override.input`", MACHINE, STOPS, ENDS, ENDS],
            Self::Pause => ["`program.pause`", MACHINE, STOPS, ENDS, ENDS],
            Self::Step => ["`program.step`", MACHINE, STOPS, ENDS, ENDS],
            Self::SecondEncoder => [
                "`second_encoder`",
                "that of its axis",
                "the group stops",
                "its zero is taken again",
                "it is compared again",
            ],
            Self::Condition => [
                "condition of a step",
                "any",
                "keeps its last value",
                "valid",
                "valid",
            ],
            Self::CopySource => [
                "source of a copy",
                "any",
                "the target holds its last value",
                "valid",
                "valid",
            ],
        }
    }
}

/// An input with its use.
#[derive(Debug, Clone, PartialEq)]
pub struct InputRole {
    pub input: BitRange,
    pub usage: InputUse,
}

/// An input that the machine file uses, with its place there.
#[derive(Debug, Clone)]
pub(crate) struct UsedInput {
    pub usage: InputUse,
    pub signal: Signal,
    pub place: Span,
}

/// The roles of all process data of a machine.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ProcessDataRoles {
    outputs: Vec<OwnedOutput>,
    inputs: Vec<InputRole>,
    /// The inputs that nodes behind gateways report.
    node_inputs: Vec<(BitRange, u8)>,
}

impl ProcessDataRoles {
    /// Returns the registry with the outputs that the devices themselves assign: to axes, nodes and
    /// gateways.
    pub(super) fn of_devices(
        devices: &IndexVec<DeviceIndex, ResolvedDevice<'_>>,
        axes: &IndexVec<AxisIndex, ResolvedAxis<'_>>,
    ) -> Self {
        let mut roles = Self::default();
        for (index, resolved) in devices.enumerate() {
            let Some(device) = resolved.device else {
                continue;
            };
            let setups = axes.iter().filter(|axis| axis.device == index);
            let setups: Vec<_> = setups.filter_map(|axis| axis.setup).collect();
            for (first, field) in device.selection.layout.repeated_outputs() {
                let subject = format!("0x{:04x}", first.pdo);
                let owner = OutputOwner::new(OwnerKind::Repetition, subject, device.line);
                roles.assign(index, device, field, owner);
            }
            for field in &device.selection.layout.rx {
                let own = |number| {
                    let named = setups
                        .iter()
                        .find(|s| s.node.is_none() && s.number == number);
                    named.map(|setup| setup.name.clone())
                };
                if let Some((kind, number)) = axis_role(field, device) {
                    let subject = own(number).unwrap_or_else(|| device.name.clone());
                    let owner = OutputOwner::new(kind, subject, device.line);
                    roles.assign(index, device, field, owner);
                }
            }
            roles.add_gateway(index, device, |node| {
                setups.iter().any(|setup| setup.node == Some(node))
            });
        }
        roles
    }

    /// Adds an output of a device's own layout, unless it repeats another one.
    fn assign(
        &mut self,
        index: DeviceIndex,
        device: &DeviceConfig,
        field: &Field,
        owner: OutputOwner,
    ) {
        let output = BitRange {
            device: index,
            name: name_of(field, device),
            bits: bits_of(field),
        };
        if self.owner_of(&output).is_none() {
            self.outputs.push(OwnedOutput { output, owner });
        }
    }

    /// Adds the control word of a gateway and the PDOs of its nodes with an axis: without one, ecaxis
    /// does not command the gateway.
    fn add_gateway(
        &mut self,
        index: DeviceIndex,
        device: &DeviceConfig,
        has_axis: impl Fn(usize) -> bool,
    ) {
        let Some(gateway) = &device.gateway else {
            return;
        };
        let nodes = gateway.nodes.iter().enumerate();
        let mut commanded = nodes.filter(|(n, _)| has_axis(*n)).peekable();
        if commanded.peek().is_some() {
            let owner = OutputOwner::new(OwnerKind::ControlWord, &device.name, device.line);
            let output = BitRange {
                device: index,
                name: String::new(),
                bits: CONTROL_WORD,
            };
            self.outputs.push(OwnedOutput { output, owner });
        }
        for (_, node) in commanded {
            self.add_node(index, node);
        }
        for node in &gateway.nodes {
            let fields = node.selection.layout.tx.iter();
            self.node_inputs.extend(fields.map(|field| {
                let bits = bits_of(field);
                let name = String::new();
                let device = index;
                (BitRange { device, name, bits }, node.id)
            }));
        }
    }

    fn add_node(&mut self, device: DeviceIndex, node: &NodeSetup) {
        for field in &node.selection.layout.rx {
            if NODE_DIGITAL_OUTPUTS.contains(&field.index) {
                continue;
            }
            let subject = format!("0x{:04X} of node {}", field.index, node.id);
            let owner = OutputOwner::new(OwnerKind::Node, subject, node.line);
            let output = BitRange {
                device,
                name: String::new(),
                bits: bits_of(field),
            };
            self.outputs.push(OwnedOutput { output, owner });
        }
    }

    /// Returns the first owner of a part of these outputs.
    fn owner_of(&self, output: &BitRange) -> Option<&OwnedOutput> {
        let mut known = self.outputs.iter();
        known.find(|known| known.output.overlaps(output.device, &output.bits))
    }

    /// Returns the first other owner of a part of these outputs.
    fn conflict(&self, output: &BitRange, owner: &OutputOwner) -> Option<OwnerConflict> {
        let mut known = self.outputs.iter();
        let other = known.find(|known| {
            let one = known.owner.kind.commands() && owner.kind.commands();
            !one && known.output.overlaps(output.device, &output.bits)
        })?;
        let name = match &other.output.name {
            name if name.is_empty() || *name == output.name => format!("`{}`", output.name),
            name => format!("`{name}` in `{}`", output.name),
        };
        let (predicate, noun) = (other.owner.predicate(), owner.noun());
        Some(OwnerConflict {
            message: format!("{name} {predicate}; {noun} may not write it"),
            hint: other.owner.hint(),
        })
    }

    /// Makes `owner` the only owner of these outputs.
    pub(super) fn claim(
        &mut self,
        output: BitRange,
        owner: OutputOwner,
    ) -> Result<(), OwnerConflict> {
        match self.conflict(&output, &owner) {
            Some(conflict) => Err(conflict),
            None => {
                let owned = OwnedOutput { output, owner };
                if !self.outputs.contains(&owned) {
                    self.outputs.push(owned);
                }
                Ok(())
            }
        }
    }

    /// Makes `owner` the only owner of an output of the machine file. Returns false after it has
    /// reported another owner.
    pub(super) fn claim_at(
        &mut self,
        output: BitRange,
        owner: OutputOwner,
        place: Span,
        p: &mut Problems<'_>,
    ) -> bool {
        match self.claim(output, owner) {
            Ok(()) => true,
            Err(conflict) => {
                p.add_hint(place, conflict.message, conflict.hint);
                false
            }
        }
    }

    /// Claims an output for a controller or a client.
    pub(super) fn claim_command(
        &mut self,
        signal: &Signal,
        kind: OwnerKind,
    ) -> Result<(), OwnerConflict> {
        self.claim(BitRange::of(signal), OutputOwner::without_line(kind))
    }

    /// Returns the other owner of an output for a controller or a client.
    pub(super) fn command_conflict(
        &self,
        signal: &Signal,
        kind: OwnerKind,
    ) -> Option<OwnerConflict> {
        self.conflict(&BitRange::of(signal), &OutputOwner::without_line(kind))
    }

    /// Returns all outputs with an owner.
    pub fn outputs(&self) -> impl Iterator<Item = &OwnedOutput> {
        self.outputs.iter()
    }

    /// Returns all inputs with a use.
    pub fn inputs(&self) -> impl Iterator<Item = &InputRole> {
        self.inputs.iter()
    }

    /// Returns the outputs that are off from the loss of their device to the reset of its group.
    pub(super) fn output_locks(&self) -> Vec<ProcessDataCopy> {
        let off = |owned: &&OwnedOutput| owned.owner.kind.on_return() == ReturnRule::Off;
        let off = self.outputs.iter().filter(off);
        off.map(|owned| {
            let place = (owned.output.device, owned.output.bits.start as usize);
            ProcessDataCopy {
                from: place,
                to: place,
                bits: owned.output.bits.len(),
            }
        })
        .collect()
    }

    /// Returns the devices with an input whose loss must stop the machine.
    pub(crate) fn watched_devices(&self) -> impl Iterator<Item = DeviceIndex> {
        let watched = |role: &&InputRole| {
            role.usage.danger().is_some() && role.usage != InputUse::SecondEncoder
        };
        let inputs = self.inputs.iter().filter(watched);
        inputs.map(|role| role.input.device)
    }

    /// Adds an input. Reports one whose loss would go unseen: in a group without which the machine
    /// goes on, or in a PDO of a node, whose last value a gateway keeps. `axis`: the device of the
    /// axis that alone needs the input.
    pub(super) fn add_input(
        &mut self,
        used: &UsedInput,
        axis: Option<DeviceIndex>,
        stop: &StopSetup,
        p: &mut Problems<'_>,
    ) {
        let input = BitRange::of(&used.signal);
        if let Some(danger) = used.usage.danger() {
            let mut nodes = self.node_inputs.iter();
            let node = nodes.find(|(known, _)| known.overlaps(input.device, &input.bits));
            if let Some((_, id)) = node {
                let message = format!(
                    "`{}` comes from node {id}, whose last value its gateway keeps: {danger}",
                    input.name
                );
                p.add_hint(used.place.clone(), message, "use an input on EtherCAT");
            } else if let Some(group) = stop.group_alone(input.device, axis) {
                let message = format!(
                    "`{}` is in the group `{group}`, without which the machine goes on: {danger}",
                    input.name
                );
                let hint = "leave its device out of the group, or write `outside = \"stop\"`";
                p.add_hint(used.place.clone(), message, hint);
            }
        }
        let usage = used.usage;
        self.push_input(InputRole { input, usage });
    }

    /// Adds the source of a copy.
    pub(super) fn add_source(&mut self, input: BitRange) {
        let usage = InputUse::CopySource;
        self.push_input(InputRole { input, usage });
    }

    fn push_input(&mut self, role: InputRole) {
        if !self.inputs.contains(&role) {
            self.inputs.push(role);
        }
    }
}

impl StopSetup {
    /// Returns the name of the group of a device, if the group stops alone and `other` goes on.
    /// `other`: a device of another axis; `None` for the machine.
    pub(super) fn group_alone(
        &self,
        device: DeviceIndex,
        other: Option<DeviceIndex>,
    ) -> Option<&str> {
        let of = |device| self.groups.iter().find(|g| g.devices.contains(&device));
        let own = of(device).filter(|group| group.outside == GroupStopScope::Continue)?;
        let same = other
            .and_then(of)
            .is_some_and(|group| group.name == own.name);
        (!same).then_some(own.name.as_str())
    }
}

/// Returns the axis of a drive that an output belongs to, and how.
fn axis_role(field: &Field, device: &DeviceConfig) -> Option<(OwnerKind, u16)> {
    let selection = &device.selection;
    selection.mode?;
    let (axis, same) = match selection.layout.idns {
        true => (field.sub.into(), esi::axis::same_as_idn(field.index)?),
        false => esi::axis::of(field.index)?,
    };
    let kind = if same != POSITION_OFFSET && !AXIS_OUTPUTS.contains(&same) {
        return None;
    } else if !selection.axes.contains(&axis) {
        OwnerKind::UnusedAxis
    } else if same == POSITION_OFFSET {
        OwnerKind::AxisOffset
    } else {
        OwnerKind::Axis
    };
    Some((kind, axis))
}

/// Returns the name of an output with its device's name.
fn name_of(field: &Field, device: &DeviceConfig) -> String {
    let address = esi::address(field.index, field.sub).to_string();
    let name = signal::field(&address, SignalDirection::Out, device).map(|(_, name)| name);
    format!("{}.{}", device.name, name.unwrap_or(address))
}

#[cfg(test)]
#[path = "roles_tests.rs"]
mod tests;
