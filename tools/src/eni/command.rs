//! The init commands of an ENI: datagrams and SDO downloads, each with its transitions.

use super::xml::Element;

/// A datagram that a MainDevice sends at state transitions (`ECatCmdType`).
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct EcatCommand {
    /// `IP`, `PS`, `SO` …
    pub transitions: Vec<String>,
    /// Before the commands of the devices.
    pub before_slave: bool,
    pub comment: String,
    /// The number of the datagram's command, such as 5 for FPWR.
    pub command: u8,
    pub target: CommandTarget,
    /// What is written, or the length of what is read.
    pub payload: Payload,
    /// The expected working counter.
    pub cnt: Option<u16>,
    pub retries: Option<u32>,
    /// What must come back.
    pub validate: Option<Validate>,
}

/// The place that a datagram addresses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum CommandTarget {
    /// `Adp`, `Ado`.
    Physical(u16, u16),
    /// `Addr`.
    Logical(u32),
}

impl Default for CommandTarget {
    fn default() -> Self {
        Self::Physical(0, 0)
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Payload {
    Data(Vec<u8>),
    /// Zeros.
    Length(u32),
}

impl Default for Payload {
    fn default() -> Self {
        Self::Length(0)
    }
}

/// A command is repeated until this comes back.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Validate {
    pub data: Vec<u8>,
    /// Empty: all bits count.
    pub mask: Vec<u8>,
    pub timeout_ms: u32,
}

/// The commands of datagrams (ETG.1000.4).
pub(super) mod code {
    pub const APRD: u8 = 1;
    pub const APWR: u8 = 2;
    pub const FPRD: u8 = 4;
    pub const FPWR: u8 = 5;
    pub const BRD: u8 = 7;
    pub const BWR: u8 = 8;
    pub const LRD: u8 = 10;
    pub const LWR: u8 = 11;
    pub const LRW: u8 = 12;
    pub const FRMW: u8 = 14;
}

impl EcatCommand {
    pub fn new(transitions: &[&str], comment: &str, command: u8, adp: u16, ado: u16) -> Self {
        Self {
            transitions: transitions.iter().map(|&t| t.to_owned()).collect(),
            comment: comment.to_owned(),
            command,
            target: CommandTarget::Physical(adp, ado),
            retries: Some(3),
            ..Self::default()
        }
    }

    pub fn data(self, data: &[u8]) -> Self {
        Self {
            payload: Payload::Data(data.to_vec()),
            ..self
        }
    }

    pub fn length(self, len: u32) -> Self {
        Self {
            payload: Payload::Length(len),
            ..self
        }
    }

    pub fn cnt(self, cnt: u16) -> Self {
        Self {
            cnt: Some(cnt),
            ..self
        }
    }

    pub fn before_slave(self) -> Self {
        Self {
            before_slave: true,
            ..self
        }
    }

    pub fn validate(self, data: &[u8], mask: &[u8], timeout_ms: u32) -> Self {
        let validate = Some(Validate {
            data: data.to_vec(),
            mask: mask.to_vec(),
            timeout_ms,
        });
        Self { validate, ..self }
    }

    pub fn to_element(&self, name: &str) -> Element {
        let mut element = Element::new(name);
        for transition in &self.transitions {
            element = element.with("Transition", transition);
        }
        element = element
            .with_some("BeforeSlave", self.before_slave.then_some(1))
            .with_some("Comment", Some(&self.comment).filter(|c| !c.is_empty()))
            // One command a frame: each depends on the one before.
            .with("Requires", "cycle")
            .with("Cmd", self.command);
        element = with_target(element, self.target);
        element = match &self.payload {
            Payload::Data(data) => element.with("Data", hex(data)),
            Payload::Length(len) => element.with("DataLength", len),
        };
        let element = element
            .with_some("Cnt", self.cnt)
            .with_some("Retries", self.retries);
        let Some(validate) = &self.validate else {
            return element;
        };
        let mask = Some(&validate.mask).filter(|mask| !mask.is_empty());
        element.child(
            Element::new("Validate")
                .with("Data", hex(&validate.data))
                .with_some("DataMask", mask.map(|mask| hex(mask)))
                .with("Timeout", validate.timeout_ms),
        )
    }
}

/// Adds the address of a datagram.
pub(super) fn with_target(element: Element, target: CommandTarget) -> Element {
    match target {
        CommandTarget::Physical(adp, ado) => element.with("Adp", adp).with("Ado", ado),
        CommandTarget::Logical(addr) => element.with("Addr", signed(addr)),
    }
}

/// An SDO transfer at state transitions (`CoE/InitCmds/InitCmd`).
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct CoeCommand {
    pub transitions: Vec<String>,
    pub comment: String,
    pub timeout_ms: u32,
    pub index: u16,
    pub sub: u8,
    pub complete_access: bool,
    /// Empty: an upload.
    pub data: Vec<u8>,
    /// Part of the file, but not sent.
    pub disabled: bool,
}

/// `Ccs` of a download: the client command specifier of CiA 301.
const DOWNLOAD: u8 = 1;

impl CoeCommand {
    pub fn to_element(&self) -> Element {
        let mut element = start(&self.transitions, &self.comment, self.timeout_ms);
        if self.complete_access {
            // Some readers know no other spelling of true.
            element = element.with_attribute("CompleteAccess", 1);
        }
        element
            .with("Ccs", DOWNLOAD)
            .with("Index", self.index)
            .with("SubIndex", self.sub)
            .with("Data", hex(&self.data))
            .with_some("Disabled", self.disabled.then_some(1))
    }
}

/// A write of an IDN at state transitions (`SoE/InitCmds/InitCmd`).
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct SoeCommand {
    pub transitions: Vec<String>,
    pub comment: String,
    pub timeout_ms: u32,
    pub op_code: u8,
    pub drive: u8,
    pub idn: u16,
    /// The flags of the elements.
    pub elements: u8,
    pub data: Vec<u8>,
    /// Part of the file, but not sent.
    pub disabled: bool,
}

impl SoeCommand {
    /// `OpCode` of a write request (ETG.1000.6 clause 5.7).
    pub const WRITE: u8 = 3;
    /// The element of the value.
    pub const VALUE: u8 = 1 << 6;

    pub fn to_element(&self) -> Element {
        start(&self.transitions, &self.comment, self.timeout_ms)
            .with("OpCode", self.op_code)
            .with("DriveNo", self.drive)
            .with("IDN", self.idn)
            .with("Elements", self.elements)
            .with("Attribute", 0)
            .with("Data", hex(&self.data))
            .with_some("Disabled", self.disabled.then_some(1))
    }
}

/// Returns an `InitCmd` with a message of a mailbox (`MailboxCmdType`). `data` begins after the
/// mailbox header.
pub(super) fn mailbox_command(
    transitions: &[String],
    comment: &str,
    timeout_ms: u32,
    data: &[u8],
) -> Element {
    start(transitions, comment, timeout_ms).with("Data", hex(data))
}

/// Returns an `InitCmd` with what each mailbox command begins with.
fn start(transitions: &[String], comment: &str, timeout_ms: u32) -> Element {
    let mut element = Element::new("InitCmd");
    for transition in transitions {
        element = element.with("Transition", transition);
    }
    element
        .with_some("Comment", Some(comment).filter(|c| !c.is_empty()))
        .with("Timeout", timeout_ms)
}

/// Returns `xs:hexBinary`.
pub(super) fn hex(data: &[u8]) -> String {
    data.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Returns 32 bits as `xs:int`.
pub(super) fn signed(value: u32) -> i32 {
    i32::from_ne_bytes(value.to_ne_bytes())
}
