//! The ordered list of SDOs that a device receives between PreOp and SafeOp.
//!
//! The order: module identities, clearing of the PDO assignment, PDO contents, PDO assignment,
//! interpolation time, InitCmds of device and module, mode of operation, user-defined SDOs. Objects
//! that the CoE flags declare read-only are not written. The ESI's defaults must then match the
//! selection.
//!
//! ```
//! use ecaxis_esi::{SelectOptions, select};
//!
//! # let bytes = include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/io.xml"));
//! # let file = ecaxis_esi::parse(bytes)?;
//! let selection = select(&file, &file.devices[0], &SelectOptions::default())?;
//! let objects: Vec<u16> = selection.startup.iter().map(|sdo| sdo.index).collect();
//! assert!(objects.contains(&0x1c12)); // the PDO assignment of SyncManager 2
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod interpolation;
mod pdo;

use std::collections::HashMap;

use ecaxis_ecat::mailbox::soe::Idn;

use crate::axis;
use crate::layout::Layout;
use crate::model::{Device, InitCmd, Object, ObjectItem, Writable};
use crate::select::{SelectError, SelectOptions, SelectedModule, Selection};
use crate::xml::literal::slice;
use crate::{Dictionary, Mode, address};

/// One SDO download.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StartupSdo {
    /// The transition: `PS`, or `IP` (once PreOp is reached) or `SO` (before Op) from an InitCmd.
    /// The list is sorted in the order `IP`, `PS`, `SO`.
    pub transition: &'static str,
    /// The index.
    pub index: u16,
    /// The subindex.
    pub sub: u8,
    /// True to write all subindices at once, from `sub` on.
    pub complete_access: bool,
    /// The value.
    pub data: Vec<u8>,
    /// The name of the object; empty if the ESI has none.
    pub name: String,
    /// The element or key from which the SDO originates.
    pub origin: String,
    /// True if the device may refuse the SDO and keep its own value.
    pub optional: bool,
}

impl StartupSdo {
    /// Returns true if the SDO only clears a PDO assignment or the module list, which may remain
    /// from another configuration. A device without the object has nothing to clear.
    #[must_use]
    pub fn clears_list(&self) -> bool {
        let list = matches!(self.index, 0x1c10..=0x1c2f | MODULE_LIST);
        self.optional && list && self.sub == 0 && is_zero(&self.data)
    }

    /// Returns the SDOs of single subindices that together write what this SDO writes by complete
    /// access. `None` if neither the dictionary nor the kind of the object shows their lengths.
    #[must_use]
    pub fn by_subindex(&self, dictionary: &Dictionary) -> Option<Vec<Self>> {
        // Subindex 0 occupies two bytes (ETG.1000.6).
        const COUNT: usize = 2;
        let part = |sub, data: &[u8]| Self {
            sub,
            complete_access: false,
            data: data.to_vec(),
            origin: format!("{}; complete access was refused", self.origin),
            ..self.clone()
        };
        if !self.complete_access {
            return None;
        }
        let start = if self.sub == 0 { 0 } else { COUNT };
        let width = match self.index {
            0x1c10..=0x1c2f => Some(2),
            0x1600..=0x17ff | 0x1a00..=0x1bff | MODULE_LIST => Some(4),
            _ => None,
        };
        let (mut parts, mut is_list) = (Vec::new(), width.is_some());
        if let Some(width) = width {
            let elements = self.data.get(COUNT - start..)?.chunks_exact(width);
            parts.extend(
                (1..=u8::MAX)
                    .zip(elements)
                    .map(|(sub, data)| part(sub, data)),
            );
        } else {
            let mut block = vec![0; start];
            block.extend(&self.data);
            for item in &dictionary.object(self.index)?.items {
                let is_writable = item.access.write != Writable::Never;
                is_list |= item.sub == 0 && is_writable;
                let value = slice(&block, item.bit_offset, item.bit_len);
                if let Some(value) = value.filter(|_| item.sub > 0 && is_writable) {
                    parts.push(part(item.sub, &value));
                }
            }
        }
        // The elements of a list are writable while its count is zero.
        if let Some(count) = self.data.get(..1).filter(|_| is_list && self.sub == 0) {
            parts.insert(0, part(0, &[0]));
            if count != [0] {
                parts.push(part(0, count));
            }
        }
        (!parts.is_empty()).then_some(parts)
    }
}

/// [`StartupSdo::origin`] of an `sdo` entry.
pub const SDO_OF_MACHINE_FILE: &str = "sdo of the machine file";

/// One IDN to write (SoE).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StartupIdn {
    /// The transition, as in [`StartupSdo`].
    pub transition: &'static str,
    /// The drive of the device, from 0.
    pub drive: u8,
    /// The IDN.
    pub idn: Idn,
    /// The value.
    pub value: IdnValue,
    /// The element or key from which the IDN originates.
    pub origin: String,
}

/// The value of a start-up IDN.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum IdnValue {
    /// The bytes; lists contain their lengths.
    Bytes(Vec<u8>),
    /// A text whose bytes follow from the attribute that the drive reports.
    Text(String),
}

/// The transitions up to Op, in order.
const UPWARDS: [&str; 3] = ["IP", "PS", "SO"];

const MODES_OF_OPERATION: u16 = 0x6060;
const MODES_OF_OPERATION_DISPLAY: u16 = 0x6061;
const INTERPOLATION_TIME: u16 = 0x60c2;
const MODULE_LIST: u16 = 0xf030;

/// Builds the list. `selection` has an empty dictionary; `dictionary` contains its objects.
pub(crate) fn list(
    device: &Device,
    selection: &mut Selection,
    dictionary: &Dictionary,
    choice: &SelectOptions<'_>,
) -> Result<Vec<StartupSdo>, SelectError> {
    let Some(coe) = device
        .mailbox
        .as_ref()
        .and_then(|mailbox| mailbox.coe.as_ref())
    else {
        return without_coe(device, selection, choice);
    };
    let objects = Objects::new(dictionary);
    let mut list = List::new(&objects);
    module_list(device, selection, &mut list);
    pdo::configure(device, coe, selection, choice, &mut list)?;
    for axis in selection.axes.clone() {
        interpolation_time(selection, axis, choice, &mut list)?;
    }
    // A module's command replaces a device's command for the same object, if that one is
    // replaceable.
    let replaced = |cmd: &InitCmd| {
        let mut own = selection.modules.iter().flat_map(|m| &m.init_cmds);
        cmd.overwritten_by_module && own.any(|own| (own.index, own.sub) == (cmd.index, cmd.sub))
    };
    let of_device: Vec<InitCmd> = coe
        .init_cmds
        .iter()
        .filter(|cmd| !replaced(cmd))
        .cloned()
        .collect();
    init_cmds(&of_device, "device", selection, &mut list);
    for module in selection.modules.clone() {
        let origin = format!("module {:?}", module.type_name);
        init_cmds(&module.init_cmds, &origin, selection, &mut list);
    }
    for axis in selection.axes.clone() {
        mode(selection, axis, &mut list);
    }
    user(choice, selection, &mut list)?;
    // The stable sort by transition keeps the order above within a transition.
    list.sdos.sort_by_key(|sdo| {
        UPWARDS
            .iter()
            .position(|transition| *transition == sdo.transition)
    });
    Ok(list.sdos)
}

/// Handles devices without CoE: they receive no SDOs. Fails if the selection requires CoE.
fn without_coe(
    device: &Device,
    selection: &mut Selection,
    choice: &SelectOptions<'_>,
) -> Result<Vec<StartupSdo>, SelectError> {
    if !choice.sdo.is_empty() {
        return Err(SelectError::NoCoe {
            device: device.name.clone(),
            what: "start-up SDOs",
        });
    }
    pdo::check_unchanged(device, selection)?;
    if selection.mode.is_some() {
        selection
            .notes
            .push("the device has no CoE mailbox; its mode of operation is not written".to_owned());
    }
    Ok(Vec::new())
}

/// An index over the dictionary for repeated lookups.
struct Objects<'d> {
    dictionary: &'d Dictionary,
    by_index: HashMap<u16, &'d Object>,
}

impl<'d> Objects<'d> {
    fn new(dictionary: &'d Dictionary) -> Self {
        let mut by_index = HashMap::with_capacity(dictionary.objects.len());
        for object in &dictionary.objects {
            by_index.entry(object.index).or_insert(object);
        }
        Self {
            dictionary,
            by_index,
        }
    }

    fn is_empty(&self) -> bool {
        self.by_index.is_empty()
    }

    fn object(&self, index: u16) -> Option<&'d Object> {
        self.by_index.get(&index).copied()
    }

    fn item(&self, index: u16, sub: u8) -> Option<&'d ObjectItem> {
        self.object(index)?
            .items
            .iter()
            .find(|item| item.sub == sub)
    }
}

/// The list under construction.
struct List<'d> {
    objects: &'d Objects<'d>,
    sdos: Vec<StartupSdo>,
    /// The objects 0x60C2 that the list contains, derived from cycle and mode.
    periods: Vec<u16>,
}

impl<'d> List<'d> {
    fn new(objects: &'d Objects<'d>) -> Self {
        Self {
            objects,
            sdos: Vec::new(),
            periods: Vec::new(),
        }
    }

    fn push(&mut self, index: u16, sub: u8, data: Vec<u8>, origin: &str) {
        self.sdos.push(StartupSdo {
            transition: "PS",
            index,
            sub,
            complete_access: false,
            data,
            name: self.name(index, sub),
            origin: origin.to_owned(),
            optional: false,
        });
    }

    /// Adds an SDO that the device may refuse.
    fn push_optional(&mut self, index: u16, sub: u8, data: Vec<u8>, origin: &str) {
        self.push(index, sub, data, origin);
        if let Some(sdo) = self.sdos.last_mut() {
            sdo.optional = true;
        }
    }

    /// Adds a complete access download of the whole object from subindex 0, which occupies two
    /// bytes.
    fn push_whole(&mut self, index: u16, data: Vec<u8>, origin: &str, optional: bool) {
        self.push(index, 0, data, origin);
        if let Some(sdo) = self.sdos.last_mut() {
            sdo.complete_access = true;
            sdo.optional = optional;
        }
    }

    fn name(&self, index: u16, sub: u8) -> String {
        let Some(object) = self.objects.object(index) else {
            return String::new();
        };
        match object.items.iter().find(|item| item.sub == sub) {
            Some(item) if object.items.len() > 1 && item.name != object.name => {
                format!("{} / {}", object.name, item.name)
            }
            _ => object.name.to_string(),
        }
    }
}

fn module_list(device: &Device, selection: &Selection, list: &mut List<'_>) {
    let wanted = device
        .slots
        .as_ref()
        .is_some_and(|slots| slots.download_module_ident_list);
    if !wanted {
        return;
    }
    let Some(last) = selection.modules.iter().map(|m| m.place).max() else {
        // The list of an earlier configuration does not remain.
        list.push_optional(MODULE_LIST, 0, vec![0], "no module");
        return;
    };
    let origin = |module: &SelectedModule| {
        format!(
            "module {:?} (line {})",
            module.type_name, module.position.line
        )
    };
    let count = u8::try_from(last + 1).unwrap_or(u8::MAX);
    let whole = selection.modules.first().map(origin).unwrap_or_default();
    list.push(MODULE_LIST, 0, vec![0], &whole);
    for place in 0..count {
        let module = selection
            .modules
            .iter()
            .find(|m| m.place == usize::from(place));
        // An empty place between modules has identity 0.
        let ident = module.map_or(0, |m| m.ident);
        let origin = module.map_or_else(|| "empty slot".to_owned(), origin);
        list.push(
            MODULE_LIST,
            place.saturating_add(1),
            ident.to_le_bytes().to_vec(),
            &origin,
        );
    }
    list.push(MODULE_LIST, 0, vec![count], &whole);
}

/// Adds 0x60C2, which the device may refuse. CSP and CSV interpolate set-points over the bus cycle,
/// and an axis may switch to them from every mode. In CST alone, the EPOS4 application notes set
/// the time to zero, so a stored time does not remain. Zero is written only if the dictionary
/// permits zero.
fn interpolation_time(
    selection: &mut Selection,
    axis: u16,
    choice: &SelectOptions<'_>,
    list: &mut List<'_>,
) -> Result<(), SelectError> {
    let Some(mode) = selection.mode else {
        return Ok(());
    };
    let interpolates = interpolates(mode, &selection.layout.of_axis(axis));
    if !interpolates && mode != Mode::Cst {
        return Ok(());
    }
    let objects = list.objects;
    let index = axis::object(INTERPOLATION_TIME, axis);
    let item = objects.item(index, 1);
    let writable = match item {
        Some(item) => item.access.write != Writable::Never,
        None => objects.is_empty() && interpolates,
    };
    if !writable {
        if interpolates {
            selection.notes.push(format!(
                "the dictionary has no writable 0x{index:04X}; the drive does not receive the cycle of {} µs",
                choice.cycle_ns / 1000
            ));
        }
        return Ok(());
    }
    if !interpolates {
        let zero_allowed = item.is_some_and(|item| {
            item.min
                .as_ref()
                .map_or(item.has_default && is_zero(&item.default), |min| {
                    is_zero(min)
                })
        });
        if zero_allowed {
            list.push_optional(index, 1, vec![0], "mode cst");
            list.periods.push(index);
        }
        return Ok(());
    }
    let (value, exponent) =
        interpolation::interpolation_time(&objects.dictionary.of_axis(axis), choice.cycle_ns)?;
    list.push_optional(index, 1, vec![value], "bus.cycle");
    list.push_optional(index, 2, exponent.to_le_bytes().to_vec(), "bus.cycle");
    list.periods.push(index);
    Ok(())
}

/// True if the mode interpolates set-points, or if the process data contain the mode, its display
/// and an interpolated target.
fn interpolates(mode: Mode, layout: &Layout) -> bool {
    let mapped = |index| layout.rx_field(index, 0).is_some();
    if matches!(mode, Mode::Csp | Mode::Csv) {
        return true;
    }
    mapped(MODES_OF_OPERATION)
        && layout.tx_field(MODES_OF_OPERATION_DISPLAY, 0).is_some()
        && [Mode::Csp, Mode::Csv]
            .into_iter()
            .any(|mode| mode.target_object().is_some_and(mapped))
}

fn is_zero(bytes: &[u8]) -> bool {
    bytes.iter().all(|&byte| byte == 0)
}

/// Adds the InitCmds for the way up to Op. Skips a command that sets a mode other than the selected
/// one. Skips a command that would overwrite the interpolation time of this bus with that of the
/// vendor's default cycle.
fn init_cmds(commands: &[InitCmd], origin: &str, selection: &mut Selection, list: &mut List<'_>) {
    for cmd in commands {
        let upwards = UPWARDS
            .into_iter()
            .find(|t| cmd.transitions.iter().any(|own| own == t));
        let Some(transition) = upwards else { continue };
        let sets = cmd.data.first().map(|&byte| i8::from_le_bytes([byte]));
        if axis::of(cmd.index).is_some_and(|(axis, same)| {
            same == MODES_OF_OPERATION && selection.axes.contains(&axis)
        }) && selection.mode.is_some_and(|mode| sets != Some(mode.code()))
        {
            selection.notes.push(format!(
                "InitCmd of {origin} (line {}) sets another mode of operation and is left out",
                cmd.position.line
            ));
            continue;
        }
        let is_configured = matches!(cmd.index, 0x1600..=0x17ff | 0x1a00..=0x1bff | 0x1c10..=0x1c2f | MODULE_LIST)
            && list.sdos.iter().any(|sdo| sdo.index == cmd.index);
        if cmd.adapts && is_configured {
            selection.notes.push(format!(
                "InitCmd of {origin} (line {}) writes 0x{:04x} as it is by default; it follows from the choice and is left out",
                cmd.position.line, cmd.index
            ));
            continue;
        }
        if list.periods.contains(&cmd.index) {
            selection.notes.push(format!(
                "InitCmd of {origin} (line {}) writes {}, which follows from cycle and mode; it is left out",
                cmd.position.line,
                address(cmd.index, cmd.sub)
            ));
            continue;
        }
        // The lists of PDOs and modules are often missing in dictionaries.
        if !matches!(cmd.index, 0x1600..=0x17ff | 0x1a00..=0x1bff | 0x1c10..=0x1c2f | MODULE_LIST)
            && let Some(how) = list.objects.dictionary.contradiction(
                (cmd.index, cmd.sub),
                &cmd.data,
                cmd.complete_access,
            )
        {
            selection.notes.push(format!(
                "InitCmd of {origin} (line {}): {} {how}; it is sent all the same",
                cmd.position.line,
                address(cmd.index, cmd.sub)
            ));
        }
        list.sdos.push(StartupSdo {
            transition,
            index: cmd.index,
            sub: cmd.sub,
            complete_access: cmd.complete_access,
            data: cmd.data.clone(),
            name: list.name(cmd.index, cmd.sub),
            origin: format!("{origin} InitCmd (line {})", cmd.position.line),
            optional: false,
        });
    }
}

fn mode(selection: &mut Selection, axis: u16, list: &mut List<'_>) {
    let Some(mode) = selection.mode else { return };
    let index = axis::object(MODES_OF_OPERATION, axis);
    if list
        .sdos
        .iter()
        .any(|sdo| sdo.index == index && sdo.transition == "PS")
    {
        return;
    }
    let objects = list.objects;
    let item = objects.item(index, 0);
    let why = if !objects.is_empty() && objects.object(index).is_none() {
        Some(format!("the dictionary has no 0x{index:04x}"))
    } else if item.is_some_and(|item| item.access.write == Writable::Never) {
        Some(format!("0x{index:04x} is read-only in the dictionary"))
    } else {
        None
    };
    if let Some(why) = why {
        let note = format!("{why}; the mode of operation is not written");
        selection.notes.push(note);
        return;
    }
    list.push(
        index,
        0,
        mode.code().to_le_bytes().to_vec(),
        &format!("mode {mode}"),
    );
}

fn user(
    choice: &SelectOptions<'_>,
    selection: &mut Selection,
    list: &mut List<'_>,
) -> Result<(), SelectError> {
    for sdo in choice.sdo {
        match list.objects.item(sdo.index, sdo.sub) {
            Some(item) => {
                if item.access.write == Writable::Never {
                    selection.notes.push(format!(
                        "start-up SDO {} is read-only in the ESI's dictionary",
                        address(sdo.index, sdo.sub)
                    ));
                }
                let expected = item.default.len();
                let text = item.type_name.contains("STRING") || item.type_name.contains("ARRAY");
                if expected != 0 && expected != sdo.data.len() && !text {
                    return Err(SelectError::SdoLength {
                        index: sdo.index,
                        sub: sdo.sub,
                        name: list.name(sdo.index, sdo.sub),
                        given: sdo.data.len(),
                        expected,
                    });
                }
            }
            None if !list.objects.is_empty() => selection.notes.push(format!(
                "start-up SDO {} is not in the ESI's dictionary",
                address(sdo.index, sdo.sub)
            )),
            None => {}
        }
        list.push(sdo.index, sdo.sub, sdo.data.clone(), SDO_OF_MACHINE_FILE);
    }
    Ok(())
}
