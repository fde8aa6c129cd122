//! One device of an ENI as a `[[device]]` section.

use std::net::Ipv4Addr;
use std::path::Path;

use ecaxis_ecat::data_type::{DataType, Kind};
use ecaxis_ecat::mailbox::eoe::{
    IpParameters, MacAddress, MacFilter, Message, Service, format_mac,
};
use ecaxis_ecat::mailbox::soe::Idn;
use ecaxis_ecat::registers;
use ecaxis_ecat::sii::control;
use ecaxis_esi as esi;
use ecaxis_esi::model::{ObjectItem, Writable};
use ecaxis_esi::{Mode, Position, SelectOptions, Selection, UserSdo, address};
use ecaxis_master::config::keys_of_idn;
use ecaxis_master::text::quoted;

use super::super::command::{CoeCommand, EcatCommand, Payload, SoeCommand, Validate, code};
use super::super::network::NetworkDevice;
use super::layout::{DeviceKeys, WantedLayout, find, is_layout_object};
use super::{Described, Unsent, unsent};
use crate::scan::write::{MARK, TomlWriter, esi_keys};

/// Configured station alias.
const ALIAS: u16 = registers::STATION_ADDRESS + 2;
/// The word of the serial number in the EEPROM.
const SERIAL_WORD: u16 = 0x0e;

/// A device, and the keys that the machine file gets.
#[derive(Debug)]
pub(super) struct ImportedDevice<'n> {
    pub network: &'n NetworkDevice,
    pub name: String,
    described: Described<'n>,
    keys: Option<DeviceKeys>,
    /// The process data is that of the ENI.
    same_layout: bool,
    selection: Option<Selection>,
    /// The entries of `sdo` and of `idn`.
    sdos: Vec<String>,
    idns: Vec<String>,
    /// The keys of `eoe` with their values.
    eoe: Vec<(&'static str, String)>,
    /// What the SDOs and the clock of the ENI do and this device does not.
    pub unsent: Vec<Unsent>,
    cycle_ns: u64,
}

impl<'n> ImportedDevice<'n> {
    pub fn new(
        network: &'n NetworkDevice,
        described: Described<'n>,
        name: String,
        cycle_ns: u64,
    ) -> Self {
        let mut device = Self {
            network,
            name,
            described,
            keys: None,
            same_layout: described.is_none(),
            selection: None,
            sdos: Vec::new(),
            idns: Vec::new(),
            eoe: Vec::new(),
            unsent: Vec::new(),
            cycle_ns,
        };
        if let Some(described) = described {
            let dc = device.clock_mode();
            let (keys, same) = find(network, described, dc.as_ref(), cycle_ns);
            let selection = keys
                .as_ref()
                .map(|keys| keys.select(described, cycle_ns, &[]));
            device.selection = selection.and_then(Result::ok);
            (device.keys, device.same_layout) = (keys, same);
        }
        device.start_up();
        device.start_up_idns();
        device.hot_connect();
        device
    }

    pub fn has_other_layout(&self) -> bool {
        !self.same_layout
    }

    fn add_unsent(&mut self, position: Position, command: String, reason: impl Into<String>) {
        self.unsent.push(Unsent {
            position,
            device: Some(self.name.clone()),
            command,
            reason: reason.into(),
        });
    }

    /// Returns the `dc` key: the OpMode with the AssignActivate and the times of the ENI.
    fn clock_mode(&mut self) -> Option<String> {
        let described = self.described?;
        let activate = self.assign_activate();
        let modes = &described.device.dc_modes;
        let Some((activate, position)) = activate else {
            // Without a key, the first OpMode applies.
            let first = modes.first().is_some_and(|mode| mode.assign_activate != 0);
            return first.then(|| "off".to_owned());
        };
        let times = self.network.clock;
        let settings = |name: &str| {
            let options = SelectOptions {
                dc_mode: Some(name),
                cycle_ns: self.cycle_ns,
                ..SelectOptions::default()
            };
            let selection = esi::select(&described.file, &described.device, &options);
            selection.ok().and_then(|selection| selection.dc)
        };
        let fits = |mode: &&esi::DcMode| {
            let dc = settings(&mode.name);
            let own = dc.map(|dc| (dc.sync0_cycle_ns, dc.sync1_delay_ns, dc.sync0_shift_ns));
            mode.assign_activate == activate && (times.is_none() || own.is_none() || own == times)
        };
        if let Some(mode) = modes.iter().find(fits) {
            return Some(mode.name.clone());
        }
        let command = match times {
            Some((first, second, shift)) => format!(
                "AssignActivate 0x{activate:04x} with SYNC0 every {first} ns, SYNC1 {second} ns, shift {shift} ns"
            ),
            None => format!("AssignActivate 0x{activate:04x}"),
        };
        let same = modes.iter().find(|mode| mode.assign_activate == activate);
        let name = same.map(|mode| mode.name.clone());
        let reason = match &name {
            Some(name) => format!("the OpMode {name:?} of the ESI has other times"),
            None => "no OpMode of the ESI has this AssignActivate".to_owned(),
        };
        self.add_unsent(position, command, reason);
        name
    }

    /// Returns what the ENI writes to 0x0980 on the way to SafeOp, if it is not 0.
    fn assign_activate(&self) -> Option<(u16, Position)> {
        let commands = self.network.commands.iter();
        let commands = commands.filter(|(_, command)| unsent::is_upwards(command));
        let mut written = commands.filter_map(|(position, command)| {
            let value = match (&command.payload, unsent::written_register(command)?) {
                (Payload::Data(data), registers::DC_CYCLIC_CONTROL) => {
                    let mut word = [0; 2];
                    word.iter_mut().zip(data).for_each(|(to, from)| *to = *from);
                    u16::from_le_bytes(word)
                }
                (Payload::Data(data), registers::DC_ACTIVATION) => u16::from(*data.first()?) << 8,
                _ => return None,
            };
            (value != 0).then_some((value, *position))
        });
        written.next_back()
    }

    fn hot_connect(&mut self) {
        if let Some(position) = self.network.hot_connect {
            let reason =
                "a device that may be absent needs `optional`, `alias` and a [[stop.group]]";
            self.add_unsent(position, "HotConnect".to_owned(), reason);
        }
        for (position, protocol, data) in &self.network.others {
            if let ("EoE", Some(keys)) = (*protocol, eoe_keys(data)) {
                // The last of several requests counts.
                self.eoe
                    .retain(|(key, _)| keys.iter().all(|(new, _)| new != key));
                self.eoe.extend(keys);
                continue;
            }
            let reason = format!("ecaxis has no start-up commands of {protocol}");
            self.add_unsent(*position, format!("{protocol} init command"), reason);
        }
    }

    /// Sorts the SDOs of the ENI: those that the ESI brings, those for `sdo`, and the others.
    fn start_up(&mut self) {
        let network = self.network;
        for (position, sdo) in &network.sdos {
            if sdo.disabled {
                continue;
            }
            let command = describe(sdo);
            match self.entry(sdo) {
                Ok(None) => {}
                Ok(Some(entry)) => {
                    self.sdos.push(entry);
                    if !sdo
                        .transitions
                        .iter()
                        .any(|t| matches!(t.as_str(), "IP" | "PS"))
                    {
                        let reason = "kept as `sdo`, which is sent from PreOp to SafeOp instead";
                        self.add_unsent(*position, command, reason);
                    }
                }
                Err(reason) => self.add_unsent(*position, command, reason),
            }
        }
    }

    /// Sorts the IDNs of the ENI alike.
    fn start_up_idns(&mut self) {
        let network = self.network;
        for (position, command) in network.idns.iter().filter(|(_, c)| !c.disabled) {
            let selection = self.selection.as_ref();
            let own = selection.map(|s| s.startup_idns.as_slice());
            match idn_entry(command, own.unwrap_or_default()) {
                Ok(entry) => self.idns.extend(entry),
                Err(reason) => {
                    let idn = Idn(command.idn);
                    let text = format!("SoE write of {idn}, drive {}", command.drive);
                    self.add_unsent(*position, text, reason);
                }
            }
        }
    }

    /// Returns the entry of `sdo`; `Ok(None)` if the device gets the value without one.
    fn entry(&self, sdo: &CoeCommand) -> Result<Option<String>, String> {
        let upwards = |t: &String| matches!(t.as_str(), "IP" | "PS" | "SO");
        if !sdo.transitions.iter().any(upwards) {
            return Err("ecaxis sends SDOs on the way to Op only".to_owned());
        }
        if sdo.data.is_empty() {
            return Err("it writes nothing".to_owned());
        }
        let own = self
            .selection
            .iter()
            .flat_map(|selection| &selection.startup);
        let same = |own: &esi::StartupSdo| {
            (own.index, own.sub, own.complete_access, &own.data)
                == (sdo.index, sdo.sub, sdo.complete_access, &sdo.data)
        };
        if own.clone().any(same) {
            return Ok(None);
        }
        if is_layout_object(sdo.index) {
            return match (self.described, self.same_layout) {
                (Some(_), true) => Ok(None),
                (Some(_), false) => {
                    Err("the process data of the ESI differs from the ENI's".to_owned())
                }
                (None, _) => Err("without an ESI file, the process data is not known".to_owned()),
            };
        }
        if matches!(sdo.index, 0x1010 | 0x1011) {
            return Err(
                "storing or restoring at every start wears the memory: use `ecaxis sdo store`"
                    .to_owned(),
            );
        }
        if sdo.complete_access {
            return Err("`sdo` writes one subindex, and this one all of them".to_owned());
        }
        let item = self.selection.as_ref();
        let item = item.and_then(|s| s.dictionary.item(sdo.index, sdo.sub));
        let (value, data_type) = value(&sdo.data, item)?;
        if let (Some(described), Some(keys)) = (self.described, &self.keys) {
            let user = UserSdo {
                index: sdo.index,
                sub: sdo.sub,
                data: sdo.data.clone(),
            };
            let selected = keys.select(described, self.cycle_ns, &[user]);
            selected.map_err(|error| error.to_string())?;
        }
        let sub = match sdo.sub {
            0 => String::new(),
            sub => format!("sub = {sub}, "),
        };
        let data_type =
            data_type.map_or_else(String::new, |name| format!(", type = {}", quoted(&name)));
        Ok(Some(format!(
            "{{ index = 0x{:04x}, {sub}value = {value}{data_type} }}",
            sdo.index
        )))
    }

    /// Returns the section of the machine file. Paths are relative to `folder`.
    pub fn section(&self, folder: &Path) -> String {
        let mut lines = TomlWriter::default();
        lines.header("[[device]]");
        let other_name = Some(&self.network.name).filter(|name| **name != self.name);
        let other_name = other_name.map_or("", String::as_str);
        lines.add("name", &quoted(&self.name), other_name);
        esi_keys(
            self.network.identity,
            self.described,
            None,
            folder,
            &mut lines,
        );
        match self.checked_alias() {
            Some(alias) => lines.add("alias", &alias.to_string(), ""),
            None => lines.add("position", &self.network.place.to_string(), ""),
        }
        match (self.checked_serial(), self.network.serial) {
            (Some(serial), _) => lines.add("serial", &serial.to_string(), ""),
            (None, 0) => {}
            (None, serial) => lines.comment(&format!(
                "serial = {serial} would take this very device only"
            )),
        }
        let keys = self.keys.clone().unwrap_or_default();
        if let Some(dc) = &keys.dc {
            lines.add("dc", &quoted(dc), "");
        }
        if let Some(modules) = &keys.modules {
            let list: Vec<_> = modules.iter().map(|name| quoted(name)).collect();
            lines.add("modules", &format!("[{}]", list.join(", ")), "");
        }
        if let Some(assignment) = &keys.assignment {
            lines.add("assignment", &quoted(assignment), "");
        }
        for (key, list) in [("pdo.rx", &keys.rx), ("pdo.tx", &keys.tx)] {
            let Some(list) = list else { continue };
            let entry = |&(index, sub): &(u16, u8)| match sub {
                0 => format!("\"0x{index:04x}\""),
                sub => format!("\"0x{index:04x}:{sub:02x}\""),
            };
            let list: Vec<_> = list.iter().map(entry).collect();
            lines.add(key, &format!("[{}]", list.join(", ")), "");
        }
        if !self.same_layout {
            lines.comment(&format!(
                "{MARK} the process data differs from that of the ENI"
            ));
        }
        if let Some(modes) = self.cyclic_modes() {
            lines.comment(&format!(
                "{MARK} a drive: `mode` ({modes}) and a [device.axis] give it power"
            ));
        }
        if !self.eoe.is_empty() {
            let keys = self
                .eoe
                .iter()
                .map(|(key, value)| format!("{key} = {value}"));
            let keys = keys.collect::<Vec<_>>().join(", ");
            lines.add("eoe", &format!("{{ {keys} }}"), "");
        }
        let mut text = lines.text();
        for (key, entries) in [("sdo", &self.sdos), ("idn", &self.idns)] {
            if !entries.is_empty() {
                let lines = entries.iter().map(|entry| format!("    {entry},\n"));
                text += &format!("{key} = [\n{}]\n", lines.collect::<String>());
            }
        }
        text
    }

    fn cyclic_modes(&self) -> Option<String> {
        let described = self.described?;
        let modes = esi::offered_modes(&described.file, &described.device);
        let modes: Vec<_> = modes
            .into_iter()
            .filter(|mode| mode.is_cyclic())
            .map(Mode::name)
            .collect();
        (!modes.is_empty()).then(|| modes.join(", "))
    }

    /// Returns the alias that a command of the ENI insists on.
    fn checked_alias(&self) -> Option<u16> {
        let mut commands = self.network.commands.iter().map(|(_, command)| command);
        let alias = commands.find_map(|command| {
            let validate = validated(command, ALIAS)?;
            Some(u16::from_le_bytes(*validate.data.first_chunk()?))
        });
        alias.filter(|alias| *alias != 0)
    }

    /// Returns the serial number that the commands of the ENI insist on.
    fn checked_serial(&self) -> Option<u32> {
        let pairs = self.network.commands.windows(2);
        let mut pairs = pairs.map(|pair| (&pair[0].1, &pair[1].1));
        pairs.find_map(|(request, check)| {
            let asked = requested_word(request) == Some(SERIAL_WORD);
            let validate = validated(check, registers::EEPROM_DATA).filter(|_| asked)?;
            Some(u32::from_le_bytes(*validate.data.first_chunk()?))
        })
    }

    /// Returns how a machine file names bits of the inputs or outputs: an object, or whole bytes.
    pub fn place(&self, inputs: bool, first: u32, bits: u32) -> Option<String> {
        let layout = &self.selection.as_ref()?.layout;
        let fields = if inputs { &layout.tx } else { &layout.rx };
        let is_field = |f: &&esi::Field| (f.bit_offset, u32::from(f.bit_len)) == (first, bits);
        if let Some(field) = fields.iter().find(is_field) {
            return Some(address(field.index, field.sub).to_string());
        }
        let whole = first.is_multiple_of(8) && bits.is_multiple_of(8);
        whole.then(|| format!("bytes.{}..{}", first / 8, (first + bits) / 8))
    }

    /// Returns true if the PDOs of the ENI are known to be those of the machine file.
    pub fn knows_layout(&self) -> bool {
        let wanted = self.described.map(|d| WantedLayout::new(self.network, d));
        self.same_layout && !matches!(wanted, None | Some(WantedLayout::Unknown))
    }
}

/// Returns the word of the EEPROM that a command asks for.
pub(super) fn requested_word(request: &EcatCommand) -> Option<u16> {
    let Payload::Data(data) = &request.payload else {
        return None;
    };
    let [r0, r1, w0, w1, ..] = data[..] else {
        return None;
    };
    let asks = unsent::written_register(request) == Some(registers::EEPROM_CONTROL)
        && u16::from_le_bytes([r0, r1]) == control::READ;
    asks.then(|| u16::from_le_bytes([w0, w1]))
}

/// Returns what a read of this register must bring.
pub(super) fn validated(command: &EcatCommand, register: u16) -> Option<&Validate> {
    let read = matches!(command.command, code::APRD | code::FPRD);
    let at = unsent::register(command).filter(|_| read)?;
    command.validate.as_ref().filter(|_| at == register)
}

/// Returns the keys of a request of EoE that sets an address or the MAC filter.
fn eoe_keys(data: &[u8]) -> Option<Vec<(&'static str, String)>> {
    const TYPE_EOE: u8 = 2;
    let [low, high] = u16::try_from(data.len()).ok()?.to_le_bytes();
    let mut mailbox = vec![low, high, 0, 0, 0, TYPE_EOE];
    mailbox.extend_from_slice(data);
    match Message::parse(&mailbox).ok()?.service {
        Service::SetIp(parameters) if parameters.ip.is_some() => Some(ip_keys(&parameters)),
        Service::SetFilter(filter) => Some(filter_keys(&filter)),
        _ => None,
    }
}

fn filter_keys(filter: &MacFilter) -> Vec<(&'static str, String)> {
    let list = |addresses: &[MacAddress]| {
        let each = addresses.iter().map(|mac| quoted(&format_mac(*mac)));
        format!("[{}]", each.collect::<Vec<_>>().join(", "))
    };
    let mut keys = vec![("filters", list(&filter.filters))];
    if !filter.masks.is_empty() {
        keys.push(("filter_masks", list(&filter.masks)));
    }
    if filter.no_broadcasts {
        keys.push(("broadcasts", "false".to_owned()));
    }
    keys
}

/// Returns IP parameters as keys. Addresses of zeros are those that a request does not set.
fn ip_keys(parameters: &IpParameters) -> Vec<(&'static str, String)> {
    let address = |address: Option<Ipv4Addr>| {
        let set = address.filter(|address| !address.is_unspecified());
        set.map(|address| address.to_string())
    };
    let name = parameters.name.map(|name| {
        let text: Vec<u8> = name.into_iter().take_while(|byte| *byte != 0).collect();
        String::from_utf8_lossy(&text).into_owned()
    });
    let keys = [
        ("ip", address(parameters.ip)),
        ("netmask", address(parameters.netmask)),
        ("gateway", address(parameters.gateway)),
        ("dns", address(parameters.dns)),
        ("name", name.filter(|name| !name.is_empty())),
        ("mac", parameters.mac.map(format_mac)),
    ];
    let keys = keys.into_iter();
    keys.filter_map(|(key, value)| Some((key, quoted(&value?))))
        .collect()
}

/// Returns the entry of `idn`; `Ok(None)` if the drive gets the value without one.
fn idn_entry(command: &SoeCommand, own: &[esi::StartupIdn]) -> Result<Option<String>, String> {
    let idn = Idn(command.idn);
    if (command.op_code, command.elements) != (SoeCommand::WRITE, SoeCommand::VALUE) {
        return Err("`idn` writes the value of an IDN only".to_owned());
    }
    let upwards = |t: &String| matches!(t.as_str(), "PS" | "SO");
    if !command.transitions.iter().any(upwards) {
        return Err("ecaxis writes IDNs on the way to Op only".to_owned());
    }
    let same = |own: &esi::StartupIdn| {
        let value = esi::IdnValue::Bytes(command.data.clone());
        (own.idn, own.drive, &own.value) == (idn, command.drive, &value)
    };
    if own.iter().any(same) {
        return Ok(None);
    }
    if let Some(keys) = keys_of_idn(idn) {
        return Err(format!("it follows from {keys}"));
    }
    let bytes: Vec<_> = command.data.iter().map(u8::to_string).collect();
    let drive = match command.drive {
        0 => String::new(),
        drive => format!("drive = {drive}, "),
    };
    let value = bytes.join(", ");
    Ok(Some(format!(
        "{{ idn = \"{idn}\", {drive}value = [{value}] }}"
    )))
}

fn describe(sdo: &CoeCommand) -> String {
    let whole = if sdo.complete_access {
        " (complete access)"
    } else {
        ""
    };
    let data = super::super::command::hex(sdo.data.get(..16).unwrap_or(&sdo.data));
    let more = if sdo.data.len() > 16 { "…" } else { "" };
    format!("SDO {}{whole} = {data}{more}", address(sdo.index, sdo.sub))
}

/// Returns a value as TOML, and its type if the ESI does not know the object.
fn value(data: &[u8], item: Option<&ObjectItem>) -> Result<(String, Option<String>), String> {
    let bytes = || {
        let list: Vec<_> = data.iter().map(u8::to_string).collect();
        format!("[{}]", list.join(", "))
    };
    let own_type = item.and_then(|item| {
        let data_type = DataType::named(&item.type_name, item.bit_len)?;
        Some((item, data_type))
    });
    let Some((item, data_type)) = own_type else {
        let name = match data.len() {
            1 => "u8".to_owned(),
            2 => "u16".to_owned(),
            4 => "u32".to_owned(),
            len => return Ok((bytes(), Some(format!("OCTET_STRING({len})")))),
        };
        return Ok((little_endian(data, false).to_string(), Some(name)));
    };
    let closed = match item.access.write {
        Writable::Never => true,
        Writable::Always => false,
        Writable::Only { pre_op, .. } => !pre_op,
    };
    if closed {
        return Err("the ESI says that it cannot be written in PreOp".to_owned());
    }
    let signed = data_type.kind == Kind::Signed;
    let numeric = matches!(data_type.kind, Kind::Signed | Kind::Unsigned) && data.len() <= 8;
    let number = little_endian(data, signed);
    if !numeric || i64::try_from(number).is_err() {
        return Ok((bytes(), None));
    }
    let low = item.min.as_deref().map(|min| little_endian(min, signed));
    let high = item.max.as_deref().map(|max| little_endian(max, signed));
    if low.is_some_and(|low| number < low) || high.is_some_and(|high| number > high) {
        return Err(format!("{number} is outside what the ESI allows"));
    }
    Ok((number.to_string(), None))
}

fn little_endian(bytes: &[u8], signed: bool) -> i128 {
    let negative = signed && bytes.last().is_some_and(|byte| byte & 0x80 != 0);
    let mut all = [if negative { 0xff } else { 0 }; 16];
    for (to, from) in all.iter_mut().zip(bytes) {
        *to = *from;
    }
    i128::from_le_bytes(all)
}
