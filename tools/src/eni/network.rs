//! An ENI as read: its devices with their process data and commands, and its cycle.

use std::borrow::Cow;

use ecaxis_esi::{Direction, Identity, Position};

use super::command::{CoeCommand, CommandTarget, EcatCommand, Payload, SoeCommand, Validate};
use super::value::error;
use super::xml::{Element, EniError};

/// The content of an ENI that matters to a machine file.
#[derive(Debug, Clone, Default)]
pub(super) struct Network {
    /// The commands for all devices.
    pub commands: Vec<(Position, EcatCommand)>,
    pub devices: Vec<NetworkDevice>,
    /// The shortest cycle in µs.
    pub cycle_us: Option<u32>,
    pub cyclic: Vec<(Position, EcatCommand)>,
    pub copies: Vec<CopyInfo>,
}

/// One `Slave`.
#[derive(Debug, Clone, Default)]
pub(super) struct NetworkDevice {
    pub name: String,
    /// The place on the bus, from 0.
    pub place: u16,
    pub identity: Identity,
    pub serial: u32,
    /// The bits of the image, as (first, length).
    pub outputs: Vec<(u32, u32)>,
    pub inputs: Vec<(u32, u32)>,
    /// The PDOs with a SyncManager, in the order of the assignment.
    pub pdos: Vec<NetworkPdo>,
    pub sdos: Vec<(Position, CoeCommand)>,
    pub idns: Vec<(Position, SoeCommand)>,
    /// Init commands of other mailbox protocols, with their data behind the mailbox header.
    pub others: Vec<(Position, &'static str, Vec<u8>)>,
    pub commands: Vec<(Position, EcatCommand)>,
    /// Cycle 0, cycle 1 and shift in ns.
    pub clock: Option<(u32, u32, i32)>,
    pub hot_connect: Option<Position>,
}

/// An assigned PDO.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct NetworkPdo {
    pub direction: Direction,
    pub index: u16,
    pub sm: u8,
    /// Index, subindex and length in bits.
    pub entries: Vec<(u16, u8, u16)>,
}

/// Bits that a MainDevice copies from the input image to the output image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct CopyInfo {
    pub position: Position,
    pub from: u32,
    pub to: u32,
    pub bits: u32,
}

/// The remedy for another root.
const NOT_AN_ENI: &str =
    "an ENI has the root <EtherCATConfig>: export it from the configuration tool";

impl Network {
    pub fn parse(bytes: &[u8]) -> Result<Self, EniError> {
        let text: Cow<'_, str> = ecaxis_esi::decode_text(bytes);
        let root = Element::parse(&text)?;
        // Some tools put the configuration into a document of their own.
        let root = match root.name.as_str() {
            "EtherCATConfig" => &root,
            _ => root.get("EtherCATConfig").ok_or_else(|| {
                let name = super::xml::shorten(&root.name);
                root.error(format!("the root element is <{name}>"), NOT_AN_ENI)
            })?,
        };
        let config = root.get("Config");
        let config =
            config.ok_or_else(|| root.error("<Config> is missing".to_owned(), NOT_AN_ENI))?;
        let mut network = Self {
            commands: ecat_commands(config, &["Master", "InitCmds", "InitCmd"])?,
            ..Self::default()
        };
        for (place, slave) in (0..).zip(config.all("Slave")) {
            network.devices.push(NetworkDevice::read(slave, place)?);
        }
        for cyclic in config.all("Cyclic") {
            let cycle: Option<u32> = cyclic.number_of("CycleTime")?;
            let known = network
                .cycle_us
                .into_iter()
                .chain(cycle.filter(|us| *us > 0));
            network.cycle_us = known.min();
            network
                .cyclic
                .extend(ecat_commands(cyclic, &["Frame", "Cmd"])?);
            for copy in cyclic.at(&["Frame", "Cmd", "CopyInfos", "CopyInfo"]) {
                network.copies.push(CopyInfo {
                    position: copy.position,
                    from: copy.needed("SrcBitOffs")?,
                    to: copy.needed("DstBitOffs")?,
                    bits: copy.needed("BitSize")?,
                });
            }
        }
        Ok(network)
    }
}

impl NetworkDevice {
    fn read(slave: &Element, order: u16) -> Result<Self, EniError> {
        let missing = || {
            let message = "<Slave> has no <Info>".to_owned();
            slave.error(
                message,
                "ETG.2100 requires the element: export the file again",
            )
        };
        let info = slave.get("Info").ok_or_else(missing)?;
        let bits = |name: &str| Ok(info.bits_of(name)?.unwrap_or(0));
        let auto_increment = info.bits_of("AutoIncAddr")?;
        let mut device = Self {
            name: info.text_of("Name").to_owned(),
            // 0, -1, -2 …, as 16 bits.
            place: auto_increment.map_or(order, |address| 0_u16.wrapping_sub(address as u16)),
            identity: Identity {
                vendor: bits("VendorId")?,
                product: bits("ProductCode")?,
                revision: bits("RevisionNo")?,
            },
            serial: bits("SerialNo")?,
            commands: ecat_commands(slave, &["InitCmds", "InitCmd"])?,
            hot_connect: slave.get("HotConnect").map(|element| element.position),
            ..Self::default()
        };
        if let Some(data) = slave.get("ProcessData") {
            device.outputs = windows(data, "Send")?;
            device.inputs = windows(data, "Recv")?;
            device.pdos = pdos(data)?;
        }
        if let Some(mailbox) = slave.get("Mailbox") {
            for command in mailbox.at(&["CoE", "InitCmds", "InitCmd"]) {
                let read = CoeCommand::read(command)?;
                device.sdos.push((command.position, read));
            }
            for command in mailbox.at(&["SoE", "InitCmds", "InitCmd"]) {
                device
                    .idns
                    .push((command.position, SoeCommand::read(command)?));
            }
            for protocol in ["AoE", "EoE", "FoE", "VoE"] {
                for command in mailbox.at(&[protocol, "InitCmds", "InitCmd"]) {
                    let data = command.bytes_of("Data")?.unwrap_or_default();
                    if !command.is_set("Disabled") {
                        device.others.push((command.position, protocol, data));
                    }
                }
            }
        }
        if let Some(clock) = slave.get("DC") {
            let shift = clock.number_of("ShiftTime")?.unwrap_or(0);
            let cycles = ["CycleTime0", "CycleTime1"].map(|name| clock.bits_of(name));
            let [first, second] = cycles;
            device.clock = Some((first?.unwrap_or(0), second?.unwrap_or(0), shift));
        }
        Ok(device)
    }
}

fn windows(data: &Element, name: &str) -> Result<Vec<(u32, u32)>, EniError> {
    let window = |window: &Element| Ok((window.needed("BitStart")?, window.needed("BitLength")?));
    data.all(name).map(window).collect()
}

/// Returns the PDOs with a SyncManager: in the order of its `Pdo` list, otherwise in file order.
fn pdos(data: &Element) -> Result<Vec<NetworkPdo>, EniError> {
    let mut pdos = Vec::new();
    for (name, direction) in [("RxPdo", Direction::Rx), ("TxPdo", Direction::Tx)] {
        for element in data.all(name) {
            let Some(sm) = element.attribute_number("Sm") else {
                continue;
            };
            let mut entries = Vec::new();
            for entry in element.all("Entry") {
                let sub = entry.number_of("SubIndex")?.unwrap_or(0);
                entries.push((entry.needed("Index")?, sub, entry.needed("BitLen")?));
            }
            pdos.push(NetworkPdo {
                direction,
                index: element.needed("Index")?,
                sm,
                entries,
            });
        }
    }
    let mut order = Vec::new();
    for number in 0..16_u8 {
        if let Some(sm) = data.get(&format!("Sm{number}")) {
            for pdo in sm.all("Pdo") {
                let index: u16 = pdo.number()?;
                order.push((number, index));
            }
        }
    }
    let place = |pdo: &NetworkPdo| {
        let listed = order.iter().position(|known| *known == (pdo.sm, pdo.index));
        (pdo.sm, listed.unwrap_or(usize::MAX))
    };
    pdos.sort_by_key(place);
    Ok(pdos)
}

fn ecat_commands(root: &Element, path: &[&str]) -> Result<Vec<(Position, EcatCommand)>, EniError> {
    let commands = root.at(path);
    let read = |command: &&Element| Ok((command.position, EcatCommand::read(command)?));
    commands.iter().map(read).collect()
}

fn transitions(element: &Element) -> Vec<String> {
    let all = element.all("Transition").chain(element.all("State"));
    all.map(|t| t.text.trim().to_owned()).collect()
}

impl EcatCommand {
    pub fn read(element: &Element) -> Result<Self, EniError> {
        let target = match element.bits_of("Addr")? {
            Some(address) => CommandTarget::Logical(address),
            None => {
                // Positions are negative numbers.
                let adp = element.number_of::<i64>("Adp")?.unwrap_or(0);
                let ado = element.number_of("Ado")?.unwrap_or(0);
                CommandTarget::Physical(low_word(element, adp)?, ado)
            }
        };
        let payload = match element.bytes_of("Data")? {
            Some(data) => Payload::Data(data),
            None => Payload::Length(element.number_of("DataLength")?.unwrap_or(0)),
        };
        let validate = match element.get("Validate") {
            Some(validate) => Some(Validate {
                data: validate.bytes_of("Data")?.unwrap_or_default(),
                mask: validate.bytes_of("DataMask")?.unwrap_or_default(),
                timeout_ms: validate.number_of("Timeout")?.unwrap_or(0),
            }),
            None => None,
        };
        Ok(Self {
            transitions: transitions(element),
            before_slave: element.is_set("BeforeSlave"),
            comment: element.text_of("Comment").to_owned(),
            command: element.needed("Cmd")?,
            target,
            payload,
            cnt: element.number_of("Cnt")?,
            retries: element.number_of("Retries")?,
            validate,
        })
    }
}

fn low_word(element: &Element, number: i64) -> Result<u16, EniError> {
    let unsigned = u16::try_from(number);
    let signed = || i16::try_from(number).map(|n| u16::from_ne_bytes(n.to_ne_bytes()));
    unsigned.or_else(|_| signed()).map_err(|_| {
        let message = format!("<Adp> {number} does not fit 16 bits");
        error(element.position, message, "correct the address")
    })
}

impl CoeCommand {
    pub fn read(element: &Element) -> Result<Self, EniError> {
        Ok(Self {
            transitions: transitions(element),
            comment: element.text_of("Comment").to_owned(),
            timeout_ms: element.number_of("Timeout")?.unwrap_or(0),
            index: element.needed("Index")?,
            sub: element.number_of("SubIndex")?.unwrap_or(0),
            complete_access: element.has_flag("CompleteAccess"),
            data: element.bytes_of("Data")?.unwrap_or_default(),
            disabled: element.is_set("Disabled"),
        })
    }
}

impl SoeCommand {
    pub fn read(element: &Element) -> Result<Self, EniError> {
        Ok(Self {
            transitions: transitions(element),
            comment: element.text_of("Comment").to_owned(),
            timeout_ms: element.number_of("Timeout")?.unwrap_or(0),
            op_code: element.needed("OpCode")?,
            drive: element.needed("DriveNo")?,
            idn: element.needed("IDN")?,
            elements: element.needed("Elements")?,
            data: element.bytes_of("Data")?.unwrap_or_default(),
            disabled: element.is_set("Disabled"),
        })
    }
}
