//! Sercos drives (SoE): the contents of MDT and AT, and the IDNs that are written at start-up.
//!
//! The process data of a drive begin with its control word (S-0-0134) or status word (S-0-0135).
//! Telegram type 7 lets S-0-0024 (MDT) and S-0-0016 (AT) list what follows. Bits 12 to 14 of a PDO's
//! index number the drive within the device; its entries have that number as subindex.

use ecaxis_ecat::mailbox::soe::{Idn, List};

use super::{EntryRef, SelectError, SelectOptions, Selection, dc, left_out};
use crate::layout::Layout;
use crate::mode::Mode;
use crate::model::{Device, Dictionary, Direction, Entry, EsiFile, Pdo, Position, Soe};
use crate::startup::{IdnValue, StartupIdn};

/// The IDNs that drives carry in process data: number, bits, data type and name.
const CYCLIC: [(Idn, u16, &str, &str); 12] = [
    (Idn::MASTER_CONTROL_WORD, 16, "UINT", "Master control word"),
    (Idn::DRIVE_STATUS_WORD, 16, "UINT", "Drive status word"),
    (Idn::VELOCITY_COMMAND, 32, "DINT", "Velocity command value"),
    (
        Idn::standard(37),
        32,
        "DINT",
        "Additive velocity command value",
    ),
    (
        Idn::VELOCITY_FEEDBACK,
        32,
        "DINT",
        "Velocity feedback value 1",
    ),
    (Idn::POSITION_COMMAND, 32, "DINT", "Position command value"),
    (
        Idn::POSITION_FEEDBACK,
        32,
        "DINT",
        "Position feedback value 1",
    ),
    (Idn::standard(53), 32, "DINT", "Position feedback value 2"),
    (Idn::TORQUE_COMMAND, 16, "INT", "Torque command value"),
    (
        Idn::standard(81),
        16,
        "INT",
        "Additive torque command value",
    ),
    (Idn::TORQUE_FEEDBACK, 16, "INT", "Torque feedback value"),
    (Idn::standard(189), 32, "DINT", "Following distance"),
];

/// The command values; the operation mode selects one of them.
const COMMANDS: [Idn; 3] = [
    Idn::POSITION_COMMAND,
    Idn::VELOCITY_COMMAND,
    Idn::TORQUE_COMMAND,
];

/// Command, feedback and S-0-0032 of a mode. The low three bits of S-0-0032 are the control type; bit 3
/// is position control without following distance.
fn mode_idns(mode: Mode) -> Option<(Idn, Idn, u16)> {
    match mode {
        Mode::Csp => Some((Idn::POSITION_COMMAND, Idn::POSITION_FEEDBACK, 0x000b)),
        Mode::Csv => Some((Idn::VELOCITY_COMMAND, Idn::VELOCITY_FEEDBACK, 0x0002)),
        Mode::Cst => Some((Idn::TORQUE_COMMAND, Idn::TORQUE_FEEDBACK, 0x0001)),
        _ => None,
    }
}

/// True if two values of S-0-0032 name the same controlled quantity: 3 to 5 are position.
fn same_control(a: u16, b: u16) -> bool {
    let quantity = |mode: u16| match mode & 7 {
        3..=5 => 3,
        other => other,
    };
    quantity(a) == quantity(b)
}

pub(super) fn select(
    file: &EsiFile,
    device: &Device,
    soe: &Soe,
    choice: &SelectOptions<'_>,
) -> Result<Selection, SelectError> {
    let axes = match choice.axes {
        [] => &[0],
        axes => axes,
    };
    if let Some(first) = choice.sdo.first() {
        return Err(SelectError::SoeOnly {
            device: device.name.clone(),
            index: first.index,
            sub: first.sub,
        });
    }
    let mut notes = left_out(file, &device.path);
    let dc_mode = dc::choose(
        device,
        choice.dc_mode,
        None,
        choice.mode.is_some_and(Mode::is_cyclic),
    )?;
    let selector = Selector {
        device,
        choice,
        axes,
    };
    let rx = selector.pdos(Direction::Rx)?;
    let tx = selector.pdos(Direction::Tx)?;
    let mut layout = Layout::new(device, &rx, &tx)?;
    layout.idns = true;
    if choice.mode.is_some() {
        let mut drives: Vec<_> = rx.iter().map(Pdo::drive).collect();
        drives.dedup();
        for drive in drives.iter().filter(|d| !axes.contains(&u16::from(**d))) {
            notes.push(format!(
                "drive {drive} of the device is not used: its control word stays zero, it gets no power"
            ));
        }
    }
    let dc = dc_mode
        .filter(|mode| mode.assign_activate != 0)
        .map(|mode| dc::settings(mode, choice.cycle_ns))
        .transpose()?;
    let startup_idns = startup(device, soe, choice, axes, &rx, &tx)?;
    Ok(Selection {
        identity: device.identity,
        device_name: device.name.clone(),
        modules: Vec::new(),
        mode: choice.mode,
        axes: axes.to_vec(),
        assignment: None,
        rx,
        tx,
        dictionary: Dictionary::default(),
        dc,
        layout,
        startup: Vec::new(),
        startup_idns,
        notes,
    })
}

struct Selector<'a> {
    device: &'a Device,
    choice: &'a SelectOptions<'a>,
    axes: &'a [u16],
}

impl Selector<'_> {
    /// Returns the telegrams of one direction. Drives that are in use carry what the mode needs; others
    /// carry what the ESI lists, because their telegrams are mandatory.
    fn pdos(&self, direction: Direction) -> Result<Vec<Pdo>, SelectError> {
        let (offered, own, word) = match direction {
            Direction::Rx => (
                &self.device.rx_pdos,
                self.choice.rx,
                Idn::MASTER_CONTROL_WORD,
            ),
            Direction::Tx => (&self.device.tx_pdos, self.choice.tx, Idn::DRIVE_STATUS_WORD),
        };
        let primary = self.device.primary_sm(direction);
        let mut pdos = Vec::new();
        for pdo in offered.iter().filter(|p| p.sm.is_some() || p.mandatory) {
            let mut pdo = pdo.clone();
            pdo.sm = pdo.sm.or(primary);
            if self.axes.contains(&u16::from(pdo.drive())) {
                self.fill(&mut pdo, word, own)?;
            }
            pdos.push(pdo);
        }
        let drives: Vec<u16> = pdos.iter().map(|pdo| u16::from(pdo.drive())).collect();
        let missing = self.axes.iter().find(|axis| !drives.contains(axis));
        if let (Some(missing), Some(_)) = (missing, self.choice.mode) {
            return Err(SelectError::NoSuchAxis {
                device: self.device.name.clone(),
                number: missing.saturating_add(1),
                index: missing << 12 | word.0,
            });
        }
        Ok(pdos)
    }

    fn fill(&self, pdo: &mut Pdo, word: Idn, own: Option<&[EntryRef]>) -> Result<(), SelectError> {
        let drive = pdo.drive();
        let of_file: Vec<Idn> = pdo.entries.iter().map(|entry| Idn(entry.index)).collect();
        let mut idns = match own {
            Some(list) => list.iter().map(|entry| Idn(entry.index)).collect(),
            None => of_file,
        };
        if let Some(mode) = self.choice.mode {
            let (command, feedback, _) =
                mode_idns(mode).ok_or_else(|| SelectError::ModeNotOffered {
                    missing: None,
                    device: self.device.name.clone(),
                    mode,
                    offered: "csp, csv and cst by S-0-0032".to_owned(),
                })?;
            let needed: &[Idn] = match pdo.direction {
                Direction::Rx => &[command],
                Direction::Tx => &[Idn::POSITION_FEEDBACK, feedback],
            };
            if own.is_none() {
                idns.retain(|idn| !COMMANDS.contains(idn));
            }
            for idn in needed {
                if !idns.contains(idn) {
                    idns.push(*idn);
                }
            }
        }
        // The word comes first, whatever the lists say.
        idns.retain(|idn| *idn != word);
        idns.insert(0, word);
        let entries = idns.into_iter().map(|idn| self.entry(pdo, idn, drive));
        pdo.entries = entries.collect::<Result<_, _>>()?;
        Ok(())
    }

    fn entry(&self, pdo: &Pdo, idn: Idn, drive: u8) -> Result<Entry, SelectError> {
        let of_file = pdo.entries.iter().find(|entry| entry.index == idn.0);
        if let Some(entry) = of_file {
            return Ok(entry.clone());
        }
        let (_, bit_len, data_type, name) = CYCLIC
            .into_iter()
            .find(|(known, ..)| *known == idn)
            .ok_or(SelectError::UnknownEntry {
                list: match pdo.direction {
                    Direction::Rx => "pdo.rx",
                    Direction::Tx => "pdo.tx",
                },
                index: idn.0,
                sub: drive,
            })?;
        Ok(Entry {
            position: Position::default(),
            index: idn.0,
            sub: drive,
            bit_len,
            name: name.into(),
            data_type: data_type.into(),
            depends_on: crate::model::SlotDependence::default(),
        })
    }
}

const UPWARDS: [&str; 3] = ["IP", "PS", "SO"];

/// Returns the IDNs to write: those of the ESI, with cycle times and modes of this configuration, the
/// lists of MDT and AT, and those of the user last.
fn startup(
    device: &Device,
    soe: &Soe,
    choice: &SelectOptions<'_>,
    axes: &[u16],
    rx: &[Pdo],
    tx: &[Pdo],
) -> Result<Vec<StartupIdn>, SelectError> {
    let mut list: Vec<StartupIdn> = Vec::new();
    let mut push = |transition, drive, idn: Idn, data: Vec<u8>, origin: String| {
        list.push(StartupIdn {
            transition,
            drive,
            idn,
            value: IdnValue::Bytes(data),
            origin,
        });
    };
    // Without a bus cycle, the ESI's own stays.
    let cycle = match choice.cycle_ns {
        0 => None,
        ns => Some(
            u16::try_from(ns / 1000)
                .ok()
                .filter(|cycle| *cycle > 0 && ns % 1000 == 0)
                .ok_or_else(|| SelectError::SoeCycle {
                    device: device.name.clone(),
                    cycle_ns: ns,
                })?,
        ),
    };
    let mode = choice.mode.and_then(mode_idns);
    let derived = |idn: Idn| {
        matches!(idn, Idn::TELEGRAM_TYPE | Idn::AT_LIST | Idn::MDT_LIST)
            || idn == Idn::OPERATION_MODE && mode.is_some()
            || matches!(idn, Idn::CONTROL_CYCLE | Idn::COMMUNICATION_CYCLE) && cycle.is_some()
    };
    for cmd in soe.init_cmds.iter().filter(|cmd| !derived(cmd.idn)) {
        let mut upwards = UPWARDS.into_iter();
        let upwards = upwards.find(|t| cmd.transitions.iter().any(|own| own == t));
        if let Some(transition) = upwards {
            let origin = format!("InitCmd ({})", cmd.position.origin());
            push(transition, cmd.drive, cmd.idn, cmd.data.clone(), origin);
        }
    }
    for idn in [Idn::CONTROL_CYCLE, Idn::COMMUNICATION_CYCLE] {
        if let Some(cycle) = cycle {
            let data = cycle.to_le_bytes().to_vec();
            push("PS", 0, idn, data, "bus.cycle".to_owned());
        }
    }
    let mut drives: Vec<u8> = rx.iter().chain(tx).map(Pdo::drive).collect();
    drives.sort_unstable();
    drives.dedup();
    for drive in drives {
        let origin = "process data".to_owned();
        push("PS", drive, Idn::TELEGRAM_TYPE, vec![7, 0], origin);
        for (idn, word, pdos) in [
            (Idn::AT_LIST, Idn::DRIVE_STATUS_WORD, tx),
            (Idn::MDT_LIST, Idn::MASTER_CONTROL_WORD, rx),
        ] {
            let own = pdos.iter().filter(|pdo| pdo.drive() == drive);
            let mut data = Vec::new();
            let mut origin = String::new();
            for pdo in own {
                let entries = pdo.entries.iter().map(|entry| entry.index);
                let entries = entries.filter(|index| *index != word.0 && *index != 0);
                data.extend(entries.flat_map(u16::to_le_bytes));
                origin = format!("PDO 0x{:04x} ({})", pdo.index, pdo.position.origin());
            }
            let max = u16::try_from(data.len()).unwrap_or(u16::MAX);
            let header = List { max, data: &data }.header();
            push("PS", drive, idn, [&header[..], &data].concat(), origin);
        }
        if let (Some((.., default)), true) = (mode, axes.contains(&u16::from(drive))) {
            let of_file = soe.init_cmds.iter().find_map(|cmd| {
                let same = cmd.drive == drive && cmd.idn == Idn::OPERATION_MODE;
                let value = u16::from_le_bytes(cmd.data.as_slice().try_into().ok()?);
                (same && same_control(value, default)).then_some((value, cmd.position))
            });
            let (value, origin) = match of_file {
                Some((value, position)) => (value, format!("InitCmd ({})", position.origin())),
                None => (default, "mode".to_owned()),
            };
            push(
                "PS",
                drive,
                Idn::OPERATION_MODE,
                value.to_le_bytes().to_vec(),
                origin,
            );
        }
    }
    list.extend(choice.idns.iter().cloned());
    // The stable sort keeps the order above within a transition.
    list.sort_by_key(|idn| UPWARDS.iter().position(|t| *t == idn.transition));
    Ok(list)
}
