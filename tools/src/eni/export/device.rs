//! The `Slave` element: one SubDevice.

use ecaxis_ecat::mailbox::eoe::{Message, Service};
use ecaxis_ecat::mailbox::{Encode, HEADER};
use ecaxis_esi::model::{Direction, Entry, Pdo, SmUse, SyncManager};
use ecaxis_esi::{IdnValue, StartupIdn};
use ecaxis_master::bringup::mailbox_registers;
use ecaxis_master::config::state_timeouts::mailbox_timeouts;

use super::super::command::{CoeCommand, EcatCommand, SoeCommand, code, mailbox_command, signed};
use super::super::xml::Element;
use super::{Network, PlacedDevice, alias, followers};
use ecaxis_ecat::registers;

/// The `Sm` elements of schema 1.3.
const DESCRIBED_SYNC_MANAGERS: usize = 4;
/// How often a MainDevice looks for mailbox messages, in ms.
const POLL_TIME_MS: u16 = 5;

/// A mailbox that holds each request of EoE.
const MAX_REQUEST: u16 = 256;

impl PlacedDevice<'_> {
    pub(super) fn element(&self, network: &Network<'_>) -> Element {
        let commands = self.commands.iter();
        let commands = commands.map(|command| command.to_element("InitCmd"));
        let mut slave = Element::new("Slave").child(self.info());
        slave.children.extend(self.process_data(network));
        slave.children.extend(self.mailbox());
        slave = slave.child(Element::new("InitCmds").with_children(commands));
        slave.children.extend(self.hot_connect(network));
        slave.children.extend(self.clock(network));
        slave
    }

    fn info(&self) -> Element {
        let device = &self.config.device;
        let known = |c: &char| matches!(c, 'Y' | 'K' | 'B' | ' ');
        let physics: String = device.physics.chars().filter(known).take(4).collect();
        let identity = self.config.selection.identity;
        Element::new("Info")
            .with("Name", &self.config.name)
            .with("PhysAddr", self.station())
            .with("AutoIncAddr", self.auto_increment())
            .with("Physics", physics)
            .with("VendorId", signed(identity.vendor))
            .with("ProductCode", signed(identity.product))
            .with("RevisionNo", signed(identity.revision))
            .with("SerialNo", signed(self.config.serial.unwrap_or(0)))
            .with("ProductRevision", &device.type_name)
    }

    /// Returns true if process data uses SyncManagers that schema 1.3 does not describe.
    pub(super) fn high_sync_managers(&self) -> bool {
        let layout = &self.config.selection.layout;
        let mut sms = layout.outputs.iter().chain(&layout.inputs);
        sms.any(|sm| usize::from(sm.sm) >= DESCRIBED_SYNC_MANAGERS)
    }

    fn process_data(&self, network: &Network<'_>) -> Option<Element> {
        let region = network.image.regions.get(self.index)?.as_ref()?;
        let window = |name: &str, len: usize| {
            let window = Element::new(name).with("BitStart", region.offset * 8);
            (len > 0).then(|| window.with("BitLength", len * 8))
        };
        let mut element = Element::new("ProcessData");
        element.children.extend(window("Send", region.out_len));
        element.children.extend(window("Recv", region.in_len));
        let sms = self.config.device.sync_managers.iter().enumerate();
        let sms = sms.take(DESCRIBED_SYNC_MANAGERS);
        let sms = sms.filter_map(|(number, sm)| self.sync_manager(number, sm));
        let selection = &self.config.selection;
        let pdos = selection.rx.iter().chain(&selection.tx).map(pdo);
        Some(element.with_children(sms).with_children(pdos))
    }

    fn sync_manager(&self, number: usize, sm: &SyncManager) -> Option<Element> {
        let kind = match sm.usage {
            SmUse::MBoxOut => "MBoxOut",
            SmUse::MBoxIn => "MBoxIn",
            SmUse::Outputs => "Outputs",
            SmUse::Inputs => "Inputs",
            SmUse::Other => return None,
        };
        let selection = &self.config.selection;
        let layout = &selection.layout;
        let mut used = layout.outputs.iter().chain(&layout.inputs);
        let used = used.find(|used| usize::from(used.sm) == number);
        let mailbox = matches!(sm.usage, SmUse::MBoxOut | SmUse::MBoxIn);
        let size = used.map_or(sm.default_size, |used| used.len);
        let control = used.map_or(sm.control_byte, |used| used.control_byte);
        let pdos = selection.rx.iter().chain(&selection.tx);
        let pdos = pdos.filter(|pdo| pdo.sm.map(usize::from) == Some(number));
        let mut element = Element::new(&format!("Sm{number}"))
            .with("Type", kind)
            .with_some("MinSize", sm.min_size)
            .with_some("MaxSize", sm.max_size)
            .with("DefaultSize", size)
            .with("StartAddress", sm.start_address)
            .with("ControlByte", control)
            .with("Enable", u8::from(used.is_some() || mailbox))
            .with_some("Virtual", sm.virtual_.then_some(1));
        for pdo in pdos {
            element = element.with("Pdo", pdo.index);
        }
        Some(element)
    }

    fn mailbox(&self) -> Option<Element> {
        let [out, inp] = mailbox_registers(self.config)?;
        let mailbox = self.config.device.mailbox.as_ref()?;
        let window = |name: &str, [a0, a1, n0, n1]: [u8; 4]| {
            Element::new(name)
                .with("Start", u16::from_le_bytes([a0, a1]))
                .with("Length", u16::from_le_bytes([n0, n1]))
        };
        let area = |data: &[u8]| data.first_chunk().copied().unwrap_or_default();
        let mut element = Element::new("Mailbox");
        if mailbox.data_link_layer {
            element = element.with_attribute("DataLinkLayer", 1);
        }
        element = element
            .child(window("Send", area(&out.data)))
            .child(window("Recv", area(&inp.data)).with("PollTime", POLL_TIME_MS));
        if let Some([out, inp]) = self.bootstrap() {
            let areas = Element::new("BootStrap").child(window("Send", out));
            let inputs = window("Recv", inp).with("PollTime", POLL_TIME_MS);
            element = element.child(areas.child(inputs));
        }
        for (name, spoken) in [
            ("AoE", mailbox.aoe),
            ("EoE", mailbox.eoe.is_some()),
            ("CoE", mailbox.coe.is_some()),
            ("SoE", mailbox.soe.is_some()),
            ("FoE", mailbox.foe),
            ("VoE", mailbox.voe),
        ] {
            element = element.with_some("Protocol", spoken.then_some(name));
        }
        if mailbox.coe.is_some() {
            let commands = self.start_up().into_iter();
            let commands = commands.map(|command| command.to_element());
            let commands = Element::new("InitCmds").with_children(commands);
            element = element.child(Element::new("CoE").child(commands));
        }
        for (name, commands) in [("SoE", self.start_up_idns()), ("EoE", self.ethernet())] {
            if !commands.is_empty() {
                let commands = Element::new("InitCmds").with_children(commands);
                element = element.child(Element::new(name).child(commands));
            }
        }
        Some(element)
    }

    /// Returns address and length of the mailboxes in Bootstrap, out and in.
    pub(super) fn bootstrap(&self) -> Option<[[u8; 4]; 2]> {
        let (out, rest) = self.config.device.eeprom.bootstrap.split_first_chunk()?;
        let inp = rest.first_chunk()?;
        let filled = |area: &[u8; 4]| area[2] != 0 || area[3] != 0;
        (filled(out) && filled(inp)).then_some([*out, *inp])
    }

    /// Returns the time for a request and its answer.
    fn mailbox_timeout_ms(&self) -> u32 {
        let timeouts = mailbox_timeouts(&self.config.device.info);
        let timeout = timeouts.request + timeouts.answer;
        u32::try_from(timeout.as_millis()).unwrap_or(u32::MAX >> 1)
    }

    /// Returns the start-up IDNs whose bytes do not depend on what the drive reports.
    fn start_up_idns(&self) -> Vec<Element> {
        let command = |idn: &StartupIdn| {
            let IdnValue::Bytes(data) = &idn.value else {
                return None;
            };
            let command = SoeCommand {
                // The mailbox works from PreOp on; the schema has no other transition before.
                transitions: vec![idn.transition.replace("IP", "PS")],
                comment: format!("{}: {}", idn.idn, idn.origin),
                timeout_ms: self.mailbox_timeout_ms(),
                op_code: SoeCommand::WRITE,
                drive: idn.drive,
                idn: idn.idn.0,
                elements: SoeCommand::VALUE,
                data: data.clone(),
                disabled: false,
            };
            Some(command.to_element())
        };
        let list = self.config.selection.startup_idns.iter();
        list.filter_map(command).collect()
    }

    /// Returns the requests that set IP parameters and MAC filter.
    fn ethernet(&self) -> Vec<Element> {
        let Some(eoe) = &self.config.eoe else {
            return Vec::new();
        };
        let requests = [
            (eoe.parameters.map(Service::SetIp), "IP parameters"),
            (eoe.filter.clone().map(Service::SetFilter), "MAC filter"),
        ];
        let command = |(request, comment): (Option<Service<'_>>, &str)| {
            let mut bytes = Vec::new();
            Message::from(request?).emit(0, MAX_REQUEST, &mut bytes);
            let length = bytes.first_chunk().map_or(0, |n| u16::from_le_bytes(*n));
            bytes.truncate(HEADER + usize::from(length));
            Some(mailbox_command(
                &["PS".to_owned()],
                comment,
                self.mailbox_timeout_ms(),
                bytes.get(HEADER..).unwrap_or_default(),
            ))
        };
        requests.into_iter().filter_map(command).collect()
    }

    /// Returns the start-up SDOs.
    fn start_up(&self) -> Vec<CoeCommand> {
        let list = self.config.selection.startup.iter();
        let command = |sdo: &ecaxis_esi::StartupSdo| CoeCommand {
            transitions: vec![sdo.transition.to_owned()],
            comment: match sdo.name.is_empty() {
                true => sdo.origin.clone(),
                false => format!("{}: {}", sdo.name, sdo.origin),
            },
            timeout_ms: self.mailbox_timeout_ms(),
            index: sdo.index,
            sub: sdo.sub,
            complete_access: sdo.complete_access,
            data: sdo.data.clone(),
            // Another MainDevice stops at an object that the device lacks.
            disabled: sdo.clears_list() && sdo.name.is_empty(),
        };
        list.map(command).collect()
    }

    /// Returns the group of an optional device that its alias identifies.
    fn hot_connect(&self, network: &Network<'_>) -> Option<Element> {
        let alias = alias(self.config).filter(|_| self.config.optional)?;
        let members = 1 + followers(network.machine, alias);
        let adp = self.auto_increment();
        let identify = EcatCommand::new(&[], "check the alias", code::APRD, adp, ALIAS)
            .data(&[0, 0])
            .cnt(1)
            .validate(&alias.to_le_bytes(), &[], 100);
        Some(
            Element::new("HotConnect")
                .with("GroupMemberCnt", members)
                .child(identify.to_element("IdentifyCmd")),
        )
    }

    fn clock(&self, network: &Network<'_>) -> Option<Element> {
        let is_reference = network.reference == Some(self.station());
        let dc = self.config.selection.dc.as_ref();
        if dc.is_none() && !is_reference {
            return None;
        }
        let bits = |value: Option<u32>| signed(value.unwrap_or(0));
        Some(
            Element::new("DC")
                .with("ReferenceClock", u8::from(is_reference))
                .with("CycleTime0", bits(dc.map(|dc| dc.sync0_cycle_ns)))
                .with("CycleTime1", bits(dc.map(|dc| dc.sync1_delay_ns)))
                .with("ShiftTime", dc.map_or(0, |dc| dc.sync0_shift_ns)),
        )
    }
}

/// Configured station alias.
pub(super) const ALIAS: u16 = registers::STATION_ADDRESS + 2;

fn pdo(pdo: &Pdo) -> Element {
    let name = match pdo.direction {
        Direction::Rx => "RxPdo",
        Direction::Tx => "TxPdo",
    };
    let mut element = Element::new(name);
    for (name, set) in [("Fixed", pdo.fixed), ("Mandatory", pdo.mandatory)] {
        if set {
            element = element.with_attribute(name, 1);
        }
    }
    if let Some(sm) = pdo.sm {
        element = element.with_attribute("Sm", sm);
    }
    let label = match pdo.name.as_str() {
        "" => name,
        label => label,
    };
    element = element
        .with("Index", hex_dec(pdo.index))
        .with("Name", label);
    for excluded in &pdo.exclude {
        element = element.with("Exclude", hex_dec(excluded.index));
    }
    element.with_children(pdo.entries.iter().map(entry))
}

fn entry(entry: &Entry) -> Element {
    let mut element = Element::new("Entry").with("Index", hex_dec(entry.index));
    if entry.is_gap() {
        return element.with("BitLen", entry.bit_len);
    }
    element = element
        .with("SubIndex", entry.sub)
        .with("BitLen", entry.bit_len)
        .with("Name", object_name(&entry.name, entry.index, entry.sub));
    element.with_some(
        "DataType",
        Some(&*entry.data_type).filter(|t| !t.is_empty()),
    )
}

/// Returns the name of an object, or its address.
pub(super) fn object_name(name: &str, index: u16, sub: u8) -> String {
    match name {
        "" => ecaxis_esi::address(index, sub).to_string(),
        name => name.to_owned(),
    }
}

fn hex_dec(value: u16) -> String {
    format!("#x{value:04x}")
}
