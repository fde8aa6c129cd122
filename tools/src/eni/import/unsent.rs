//! The datagrams of an ENI that ecaxis would not send, each with its reason.
//!
//! The datagrams that ecaxis sends are those of the exported machine file, so a register counts as
//! written only if bring-up writes the same bytes.

use ecaxis_ecat::registers;

use super::super::command::{CommandTarget, EcatCommand, Payload, code, hex};
use super::super::network::Network;
use super::Unsent;
use super::device::{ImportedDevice, requested_word, validated};

const TRANSITIONS_UP: [&str; 3] = ["IP", "PS", "SO"];
/// The commands of datagrams, by number.
const NAMES: [&str; 15] = [
    "NOP", "APRD", "APWR", "APRW", "FPRD", "FPWR", "FPRW", "BRD", "BWR", "BRW", "LRD", "LWR",
    "LRW", "ARMW", "FRMW",
];
const ARMW: u8 = 13;

/// Returns true if a command belongs to the way to Op.
pub(super) fn is_upwards(command: &EcatCommand) -> bool {
    let mut all = command.transitions.iter();
    all.any(|t| TRANSITIONS_UP.contains(&t.as_str()))
}

/// Returns the register that a datagram addresses.
pub(super) fn register(command: &EcatCommand) -> Option<u16> {
    match command.target {
        CommandTarget::Physical(_, ado) => Some(ado),
        CommandTarget::Logical(_) => None,
    }
}

/// Returns the register that a datagram writes.
pub(super) fn written_register(command: &EcatCommand) -> Option<u16> {
    let writes = matches!(
        command.command,
        code::APWR | code::FPWR | code::BWR | 3 | 6 | 9
    );
    register(command).filter(|_| writes)
}

/// Returns the commands for all devices, and the cyclic ones, that ecaxis does not send.
pub(super) fn of_network(network: &Network) -> Vec<Unsent> {
    let initial = network.commands.iter().filter_map(|(position, command)| {
        let reason = reason_of_broadcast(command)?;
        Some(unsent(*position, None, command, reason))
    });
    let cyclic = network.cyclic.iter().filter_map(|(position, command)| {
        let reason = reason_of_cyclic(command)?;
        Some(unsent(*position, None, command, reason))
    });
    initial.chain(cyclic).collect()
}

fn unsent(
    position: ecaxis_esi::Position,
    device: Option<String>,
    command: &EcatCommand,
    reason: String,
) -> Unsent {
    Unsent {
        position,
        device,
        command: describe(command),
        reason,
    }
}

/// Formats `FPWR 0x0981 = 03 (activate)`.
fn describe(command: &EcatCommand) -> String {
    let name = NAMES.get(usize::from(command.command));
    let name = name.map_or_else(
        || format!("command {}", command.command),
        |n| (*n).to_owned(),
    );
    let target = match command.target {
        CommandTarget::Physical(_, ado) => format!("0x{ado:04x}"),
        CommandTarget::Logical(address) => format!("logical 0x{address:08x}"),
    };
    let data = match &command.payload {
        Payload::Data(data) if written_register(command).is_some() => {
            let more = if data.len() > 16 { "…" } else { "" };
            format!(" = {}{more}", hex(data.get(..16).unwrap_or(data)))
        }
        _ => String::new(),
    };
    let comment: String = command
        .comment
        .chars()
        .filter(|c| !c.is_control())
        .take(60)
        .collect();
    match comment.as_str() {
        "" => format!("{name} {target}{data}"),
        comment => format!("{name} {target}{data} ({comment})"),
    }
}

fn reason_of_broadcast(command: &EcatCommand) -> Option<String> {
    let Some(register) = written_register(command) else {
        return reason_of_read(command);
    };
    match register {
        // The scan writes these to all devices as well.
        registers::STATION_ADDRESS
        | registers::AL_CONTROL
        | registers::EEPROM_CONFIGURATION..=0x050f
        | registers::FMMU..=0x06ff
        | registers::SYNC_MANAGER..=0x08ff
        | registers::DC_RECEIVE_TIME..=0x09ff => None,
        _ => Some("ecaxis does not write this register of all devices".to_owned()),
    }
}

/// Returns why a read has no counterpart: another result than the expected one must be noticed.
fn reason_of_read(command: &EcatCommand) -> Option<String> {
    let Some(register) = register(command) else {
        return Some("ecaxis sends logical commands in the cycle only".to_owned());
    };
    match register {
        // States, their codes, identity and alias are compared during bring-up.
        registers::AL_STATUS..=registers::AL_STATUS_CODE
        | registers::EEPROM_CONFIGURATION..=0x050f
        | registers::STATION_ADDRESS..=0x0013 => None,
        _ if command.validate.is_some() => {
            Some("ecaxis does not wait for a value of this register".to_owned())
        }
        // A read without a check has no effect on the device.
        _ => None,
    }
}

fn reason_of_cyclic(command: &EcatCommand) -> Option<String> {
    match (command.command, register(command)) {
        (code::LRD | code::LWR | code::LRW, _)
        | (code::BRD, Some(registers::AL_STATUS))
        | (code::FRMW | ARMW, Some(registers::DC_SYSTEM_TIME))
        | (0, _) => None,
        _ => Some("ecaxis has its own diagnosis in the cycle".to_owned()),
    }
}

/// Returns the commands of one device that ecaxis does not send. `own`: the datagrams of its
/// bring-up, if the machine file has no problems.
pub(super) fn of_device(device: &ImportedDevice<'_>, own: Option<&[EcatCommand]>) -> Vec<Unsent> {
    // Vendor, product, revision and serial number.
    const IDENTITY: [u16; 4] = [0x08, 0x0a, 0x0c, 0x0e];
    let commands = device.network.commands.iter();
    let mut word = None;
    let each = commands.filter_map(|(position, command)| {
        word = requested_word(command).or(word);
        let unknown = word.is_some_and(|word| !IDENTITY.contains(&word));
        let reason = match validated(command, registers::EEPROM_DATA) {
            Some(_) if unknown => "ecaxis does not compare this word of the EEPROM".to_owned(),
            _ => reason(command, device, own)?,
        };
        Some(unsent(
            *position,
            Some(device.name.clone()),
            command,
            reason,
        ))
    });
    each.collect()
}

fn reason(
    command: &EcatCommand,
    device: &ImportedDevice<'_>,
    own: Option<&[EcatCommand]>,
) -> Option<String> {
    if !is_upwards(command) {
        let boot = command.transitions.iter().any(|t| t == "IB");
        // Ways back: ecaxis has its own, and every start begins with Init.
        return boot.then(|| "Bootstrap is part of `ecaxis firmware`".to_owned());
    }
    let Some(register) = written_register(command) else {
        return reason_of_read(command);
    };
    let Payload::Data(data) = &command.payload else {
        return None;
    };
    let zeros = data.iter().all(|byte| *byte == 0);
    match register {
        registers::STATION_ADDRESS
        | registers::AL_CONTROL
        | registers::EEPROM_CONFIGURATION..=0x050f => None,
        // ecaxis has its own logical addresses; the clocks are set in every bring-up.
        registers::FMMU..=0x06ff if zeros || device.knows_layout() => None,
        registers::DC_RECEIVE_TIME..=0x093f | registers::DC_START_TIME..=0x0997 => None,
        // Every start begins with cleared SyncManagers and without SYNC signals.
        registers::SYNC_MANAGER..=0x08ff | registers::DC_CYCLIC_CONTROL..=0x09ff if zeros => None,
        _ => {
            let Some(own) = own else {
                return Some(
                    "the machine file has problems, so its datagrams are not known".to_owned(),
                );
            };
            match is_written(own, register, data) {
                true => None,
                false => Some(different(own, register)),
            }
        }
    }
}

/// Returns true if the last bytes that `own` writes from this register on are these.
fn is_written(own: &[EcatCommand], register: u16, data: &[u8]) -> bool {
    (register..=u16::MAX)
        .zip(data)
        .all(|(at, byte)| byte_at(own, at) == Some(*byte))
}

/// Returns the byte that the commands to Op leave at a register.
fn byte_at(own: &[EcatCommand], at: u16) -> Option<u8> {
    let mut written = own
        .iter()
        .filter(|command| is_upwards(command))
        .filter_map(|command| {
            let offset = at.checked_sub(written_register(command)?)?;
            match &command.payload {
                Payload::Data(data) => data.get(usize::from(offset)).copied(),
                Payload::Length(len) => (u32::from(offset) < *len).then_some(0),
            }
        });
    written.next_back()
}

fn different(own: &[EcatCommand], register: u16) -> String {
    let mut bytes = Vec::new();
    for at in register..register.saturating_add(8) {
        match byte_at(own, at) {
            Some(byte) => bytes.push(byte),
            None => break,
        }
    }
    match bytes.is_empty() {
        true => "ecaxis does not write this register".to_owned(),
        false => format!("ecaxis writes {} there", hex(&bytes)),
    }
}
