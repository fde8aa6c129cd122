//! Applies the user's choice to the ESI: device, module, PDOs and DC mode.
//!
//! `device` finds the device in the file. `module` fills the slots. `pdo` assigns PDOs, and
//! `custom_pdo` handles user-defined contents. `oversampling` repeats oversampled PDOs. `dc`
//! selects the OpMode. [`select`] combines these results with layout and start-up list. Nothing in
//! this module communicates with a device.
//!
//! ```
//! use ecaxis_esi::{DeviceQuery, SelectOptions, find_device, select};
//!
//! # let bytes = include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/io.xml"));
//! # let file = ecaxis_esi::parse(bytes)?;
//! let query = DeviceQuery { product: Some(2), ..DeviceQuery::default() };
//! let device = find_device(&file, &query)?;
//! let selection = select(&file, device, &SelectOptions::default())?;
//! assert_eq!(selection.rx[0].index, 0x1600);
//!
//! let wrong = SelectOptions { dc_mode: Some("sync"), ..SelectOptions::default() };
//! assert!(select(&file, device, &wrong).is_err());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod custom_pdo;
mod dc;
mod device;
mod error;
mod module;
mod pdo;
mod soe;

pub use dc::DcSettings;
pub use device::{DeviceQuery, find_device};
pub use error::SelectError;
pub use module::{module_names, plugged_modules};

use std::collections::HashMap;

use crate::layout::Layout;
use crate::mode::Mode;
use crate::model::{
    Device, Dictionary, Direction, EsiFile, Identity, InitCmd, Module, Object, Pdo, Position,
    Warning,
};
use crate::startup::{self, StartupIdn, StartupSdo};

/// An object for a PDO mapping.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct EntryRef {
    /// The index.
    pub index: u16,
    /// The subindex.
    pub sub: u8,
}

/// A user-defined start-up SDO.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UserSdo {
    /// The index.
    pub index: u16,
    /// The subindex.
    pub sub: u8,
    /// The value in little-endian order, with the length of the object.
    pub data: Vec<u8>,
}

/// The user's choices for one device.
#[derive(Debug, Clone, Copy, Default)]
pub struct SelectOptions<'a> {
    /// The mode of operation; `None`: no requirement.
    pub mode: Option<Mode>,
    /// The axes in use, counted from 0; empty: the first one.
    pub axes: &'a [u16],
    /// User-defined contents of the output PDO.
    pub rx: Option<&'a [EntryRef]>,
    /// User-defined contents of the input PDO.
    pub tx: Option<&'a [EntryRef]>,
    /// Objects added to the output PDOs, which keep their own.
    pub more_rx: &'a [EntryRef],
    /// Objects added to the input PDOs, which keep their own.
    pub more_tx: &'a [EntryRef],
    /// The modules place by place (type, name or identity; `-` or an empty text for none). `None`:
    /// each place follows mode and default. The list is complete: a place after its end is empty,
    /// except for a required one and one that the mode fills.
    pub modules: Option<&'a [&'a str]>,
    /// The name of an `AlternativeSmMapping`.
    pub assignment: Option<&'a str>,
    /// The name or description of a `Dc/OpMode`, or `off`.
    pub dc_mode: Option<&'a str>,
    /// The bus cycle in ns.
    pub cycle_ns: u64,
    /// Start-up SDOs of the user, sent last.
    pub sdo: &'a [UserSdo],
    /// Start-up IDNs of the user (SoE), sent last.
    pub idns: &'a [StartupIdn],
}

/// The complete configuration of one device.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct Selection {
    /// Vendor, product code and revision.
    pub identity: Identity,
    /// The type name of the device.
    pub device_name: String,
    /// The modules in slot order.
    pub modules: Vec<SelectedModule>,
    /// The mode of operation.
    pub mode: Option<Mode>,
    /// The axes in use, counted from 0.
    pub axes: Vec<u16>,
    /// The named assignment that applies, from the user or from the DC mode.
    pub assignment: Option<String>,
    /// The PDOs on the wire in assignment order. `sm` is always set.
    pub rx: Vec<Pdo>,
    /// The TxPDOs (inputs) in assignment order.
    pub tx: Vec<Pdo>,
    /// The objects of device and modules. A module's object replaces the device's object of the
    /// same index.
    pub dictionary: Dictionary,
    /// `None`: free run or SyncManager-synchronous, without distributed clock.
    pub dc: Option<DcSettings>,
    /// The bit offsets of all objects.
    pub layout: Layout,
    /// The SDOs to send before SafeOp, in order.
    pub startup: Vec<StartupSdo>,
    /// The IDNs to write at start-up, in order (SoE).
    pub startup_idns: Vec<StartupIdn>,
    /// Decisions that the user may not expect.
    pub notes: Vec<String>,
}

impl Selection {
    /// Returns the module identities place by place, with 0 for an empty place, as in 0xF030.
    #[must_use]
    pub fn module_idents(&self) -> Vec<u32> {
        let count = self.modules.iter().map(|module| module.place + 1).max();
        let mut idents = vec![0; count.unwrap_or(0)];
        for module in &self.modules {
            if let Some(ident) = idents.get_mut(module.place) {
                *ident = module.ident;
            }
        }
        idents
    }

    /// Returns `true` if the device generates SYNC0 or SYNC1.
    #[must_use]
    pub fn activates_sync(&self) -> bool {
        self.dc.as_ref().is_some_and(DcSettings::activates_sync)
    }
}

/// A module in its slot.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct SelectedModule {
    /// The place, counted from 0 over all slots and their instances. In 0xF030 it has subindex
    /// `place + 1`.
    pub place: usize,
    /// The module identity.
    pub ident: u32,
    /// The type name.
    pub type_name: String,
    /// The name.
    pub name: String,
    /// The name of the slot.
    pub slot_name: String,
    /// The position of the `Module`.
    pub position: Position,
    /// Its commands, with the indices of this slot.
    pub init_cmds: Vec<InitCmd>,
    /// The indices of its PDOs in this slot.
    pub pdos: Vec<u16>,
}

/// Returns the read errors of the elements below `path`.
fn left_out(file: &EsiFile, path: &str) -> Vec<String> {
    let within = |warning: &&Warning| {
        let rest = warning.path.strip_prefix(path);
        warning.left_out && rest.is_some_and(|rest| rest.starts_with('/'))
    };
    let lost = file.warnings.iter().filter(within);
    lost.map(|w| format!("{} {} is left out: {}", w.position, w.path, w.message))
        .collect()
}

/// Selects the complete configuration of one device.
pub fn select(
    file: &EsiFile,
    device: &Device,
    choice: &SelectOptions<'_>,
) -> Result<Selection, SelectError> {
    if let Some(soe) = device.soe_only() {
        return soe::select(file, device, soe, choice);
    }
    let axes = match choice.axes {
        [] => &[0],
        axes => axes,
    };
    let mode = choice.mode.map(|mode| (mode, axes));
    let placed = module::choose(&file.modules, device, mode, choice.modules)?;
    let paths = placed.iter().map(|placed| &placed.module.path);
    let paths = std::iter::once(&device.path).chain(paths);
    let mut notes: Vec<_> = paths.flat_map(|path| left_out(file, path)).collect();
    let dictionary = merged(device, &placed);
    let dc_mode = dc::choose(
        device,
        choice.dc_mode,
        placed.iter().find_map(|p| p.module.dc_mode.as_deref()),
        choice.mode.is_some_and(Mode::is_cyclic),
    )?;
    let by_name = choice
        .assignment
        .map(|name| pdo::assignment(device, name))
        .transpose()?;
    let by_dc_mode = dc_mode
        .filter(|mode| !mode.sync_managers.is_empty())
        .map(|mode| pdo::Assignment {
            name: &mode.name,
            sync_managers: &mode.sync_managers,
            oversampling: &mode.oversampling,
            whole_direction: true,
        });
    let assignment = by_name.or(by_dc_mode);
    let chooser = |direction| pdo::PdoSelector {
        device,
        placed: &placed,
        dictionary: &dictionary,
        direction,
        assignment,
        axes,
    };
    let select = |direction, own, more, notes: &mut Vec<String>| {
        let selector = chooser(direction);
        let pdos = selector.choose(choice.mode, own, notes)?;
        selector.with_more_entries(pdos, more)
    };
    let rx = select(Direction::Rx, choice.rx, choice.more_rx, &mut notes)?;
    let tx = select(Direction::Tx, choice.tx, choice.more_tx, &mut notes)?;
    let layout = Layout::new(device, &rx, &tx)?;
    let dc = dc_mode
        .filter(|mode| mode.assign_activate != 0)
        .map(|mode| dc::settings(mode, choice.cycle_ns))
        .transpose()?;
    let modules = placed
        .into_iter()
        .map(|p| SelectedModule {
            pdos: p
                .module
                .rx_pdos
                .iter()
                .chain(&p.module.tx_pdos)
                .map(|pdo| pdo.index)
                .collect(),
            place: p.place,
            slot_name: p.slot_name,
            ident: p.module.ident,
            type_name: p.module.type_name,
            name: p.module.name,
            position: p.module.position,
            init_cmds: p.module.init_cmds,
        })
        .collect();
    let mut selection = Selection {
        identity: device.identity,
        device_name: device.name.clone(),
        modules,
        mode: choice.mode,
        axes: axes.to_vec(),
        assignment: assignment.map(|assignment| assignment.name.to_owned()),
        rx,
        tx,
        dictionary: Dictionary::default(),
        dc,
        layout,
        startup: Vec::new(),
        startup_idns: Vec::new(),
        notes,
    };
    selection.startup = startup::list(device, &mut selection, &dictionary, choice)?;
    selection.dictionary = dictionary;
    Ok(selection)
}

fn merged(device: &Device, placed: &[module::PluggedModule<'_>]) -> Dictionary {
    let mut dictionary = device.dictionary.clone();
    // The position of each object, and the module object that it copies. Slot-independent objects
    // of a module in several places are listed once.
    let mut known: HashMap<u16, (usize, Option<&Object>)> = HashMap::new();
    for (at, object) in dictionary.objects.iter().enumerate() {
        known.entry(object.index).or_insert((at, None));
    }
    for (index, source) in placed.iter().flat_map(|p| p.at.objects(p.source)) {
        let next = (dictionary.objects.len(), None);
        let (at, copied) = known.entry(index).or_insert(next);
        if copied.is_some_and(|before| std::ptr::eq(before, source)) {
            continue;
        }
        *copied = Some(source);
        let object = Object {
            index,
            ..source.clone()
        };
        match dictionary.objects.get_mut(*at) {
            Some(old) => *old = object,
            None => dictionary.objects.push(object),
        }
    }
    dictionary
}

/// Returns the modes that a device offers through its modules or PDO sets, for lists and error
/// texts.
#[must_use]
pub fn offered_modes(file: &EsiFile, device: &Device) -> Vec<Mode> {
    if device.soe_only().is_some() && !device.rx_pdos.is_empty() {
        return vec![Mode::Csp, Mode::Csv, Mode::Cst];
    }
    let has_slots = device
        .slots
        .as_ref()
        .is_some_and(|slots| !slots.slots.is_empty());
    Mode::ALL
        .into_iter()
        .filter(|&mode| {
            if has_slots {
                return module::choose(&file.modules, device, Some((mode, &[0])), None).is_ok_and(
                    |placed| placed.iter().any(|p| module::mode_of(&p.module).is_some()),
                );
            }
            let rx_pdos = &device.rx_pdos;
            // An empty mapping object takes any object that the dictionary maps.
            let mappable = |index| {
                let empty = |pdo: &Pdo| !pdo.fixed && pdo.entries.is_empty();
                let item = device.dictionary.item(index, 0);
                rx_pdos.iter().any(empty) && item.is_some_and(|i| i.pdo_mapping.rx)
            };
            let carries = |index| pdo::contains(rx_pdos, index) || mappable(index);
            mode.target_object().is_some_and(carries) && carries(pdo::CONTROLWORD)
        })
        .collect()
}

/// Returns all PDOs of one direction, including those of the default module, for images without a
/// choice.
pub(crate) fn default_pdos(device: &Device, modules: &[Module], direction: Direction) -> Vec<Pdo> {
    let placed = module::choose(modules, device, None, None).unwrap_or_default();
    pdo::PdoSelector {
        device,
        placed: &placed,
        dictionary: &device.dictionary,
        direction,
        assignment: None,
        axes: &[0],
    }
    .available()
}
