//! Assigns modules to slots and computes the indices of a module in its slot.

use std::collections::HashMap;
use std::rc::Rc;

use super::SelectError;
use crate::axis;
use crate::mode::Mode;
use crate::model::{Device, Module, Slot, SlotPosition, Slots};

const CONTROLWORD: u16 = 0x6040;
const MODES_OF_OPERATION: u16 = 0x6060;
/// The name of a place without a module in `modules`.
const EMPTY_PLACE: &str = "-";
/// The maximum size in bytes of the modules in all places together, with their objects. A selection
/// copies them.
const MAX_SIZE: usize = 24 << 20;

/// A module in its slot, with the indices that apply in this slot.
#[derive(Debug, Clone)]
pub(super) struct PluggedModule<'m> {
    /// The place, counted from 0 over all slots and their instances, including empty ones.
    pub place: usize,
    pub slot_name: String,
    /// The module without its dictionary.
    pub module: Module,
    pub at: SlotPosition,
    /// The module as in the file.
    pub source: &'m Module,
}

/// Returns the names of module identities as in [`SelectOptions::modules`], for lists as in 0xF030
/// and 0xF050. Empty places at the end of the list are omitted.
///
/// [`SelectOptions::modules`]: super::SelectOptions::modules
#[must_use]
pub fn module_names(modules: &[Module], idents: &[u32]) -> Vec<String> {
    // A name that other modules have as well does not select one.
    let own = |module: &Module| {
        let mut others = modules.iter().filter(|other| other.ident != module.ident);
        let name = (!others.any(|other| is_called(other, &module.type_name)))
            .then(|| module.type_name.to_string());
        name.filter(|name| !name.is_empty())
    };
    let name = |ident: &u32| match modules.iter().find(|module| module.ident == *ident) {
        _ if *ident == 0 => EMPTY_PLACE.to_owned(),
        module => module
            .and_then(own)
            .unwrap_or_else(|| format!("0x{ident:08x}")),
    };
    plugged_modules(idents).iter().map(name).collect()
}

/// Returns the places of a list as in 0xF030 and 0xF050 up to the last module.
#[must_use]
pub fn plugged_modules(idents: &[u32]) -> &[u32] {
    let last = idents.iter().rposition(|ident| *ident != 0);
    let len = last.map_or(0, |last| last + 1);
    idents.get(..len).unwrap_or_default()
}

fn is_called(module: &Module, name: &str) -> bool {
    module.type_name.eq_ignore_ascii_case(name) || module.name.eq_ignore_ascii_case(name)
}

/// One instance of a slot.
struct Instance<'a> {
    slot: &'a Slot,
    /// All modules that the slot accepts.
    offered: Rc<[&'a Module]>,
    name: String,
    required: bool,
}

/// Returns the selected modules. The list is empty if the device has no slots or its optional slots
/// stay empty.
///
/// `wanted` is [`SelectOptions::modules`](super::SelectOptions::modules). A mode fills each place
/// that `wanted` does not name and that is required or holds an axis in use.
pub(super) fn choose<'m>(
    modules: &'m [Module],
    device: &'m Device,
    mode: Option<(Mode, &[u16])>,
    wanted: Option<&[&str]>,
) -> Result<Vec<PluggedModule<'m>>, SelectError> {
    let Some(slots) = device.slots.as_ref() else {
        return match wanted.map_or(0, <[_]>::len) {
            0 => Ok(Vec::new()),
            given => Err(SelectError::TooManyModules {
                device: device.name.clone(),
                given,
                places: 0,
            }),
        };
    };
    let places = places(modules, slots)?;
    let named_places = wanted.unwrap_or_default();
    if named_places.len() > places.len() {
        return Err(SelectError::TooManyModules {
            device: device.name.clone(),
            given: named_places.len(),
            places: places.len(),
        });
    }
    let (mut chosen, mut size) = (Vec::new(), 0usize);
    for (number, place) in places.iter().enumerate() {
        let by_name = named_places.get(number).map(|name| name.trim());
        let at = SlotPosition::new(slots, place.slot, number);
        let takes_mode = |axes: &[u16]| place.required || place.holds_axis(number, &at, axes);
        let module = match (by_name, mode) {
            (Some(name), _) => {
                let module = named(device, place, name)?;
                let modes = mode.filter(|(_, axes)| takes_mode(axes));
                if let (Some(module), Some((mode, _))) = (module, modes)
                    && is_of_other_mode(module, mode)
                {
                    return Err(SelectError::ModuleMode {
                        device: device.name.clone(),
                        module: module.type_name.to_string(),
                        mode,
                    });
                }
                module
            }
            (None, Some((mode, axes))) if takes_mode(axes) => for_mode(device, place, mode)?,
            // The user's list is complete, so the places after its end stay empty.
            (None, _) if wanted.is_some() && !place.required => None,
            _ => default_module(place),
        };
        let Some(module) = module else {
            if place.required {
                return Err(SelectError::ModuleNeeded {
                    device: device.name.clone(),
                    slot: place.name.clone(),
                    offered: describe(&place.offered),
                });
            }
            continue;
        };
        size = size.saturating_add(module.size());
        if size > MAX_SIZE {
            return Err(SelectError::ModulesTooLarge {
                device: device.name.clone(),
                position: slots.position,
                places: places.len(),
                limit: MAX_SIZE,
            });
        }
        chosen.push(PluggedModule {
            place: number,
            slot_name: place.name.clone(),
            module: module.without_objects_at(device, &at),
            at,
            source: module,
        });
    }
    Ok(chosen)
}

impl Instance<'_> {
    /// True if a module here, at place `number`, commands one of these axes. Modules without a
    /// Controlword leave open which: then the places count as the axes do.
    fn holds_axis(&self, number: usize, at: &SlotPosition, axes: &[u16]) -> bool {
        let pdos = self.offered.iter().flat_map(|module| &module.rx_pdos);
        let entries = pdos.flat_map(|pdo| &pdo.entries);
        let mut commanded = entries
            .filter_map(|entry| axis::of(at.object_index(entry.index, entry.depends_on)))
            .filter(|(_, object)| *object == CONTROLWORD)
            .map(|(axis, _)| axis)
            .peekable();
        match commanded.peek() {
            Some(_) => commanded.any(|axis| axes.contains(&axis)),
            None => axes.iter().any(|&axis| usize::from(axis) == number),
        }
    }
}

fn places<'a>(modules: &'a [Module], slots: &'a Slots) -> Result<Vec<Instance<'a>>, SelectError> {
    // If a file describes a module several times, the first description applies.
    let mut by_ident: HashMap<u32, &Module> = HashMap::new();
    for module in modules {
        by_ident.entry(module.ident).or_insert(module);
    }
    let mut places = Vec::new();
    let mut last: Option<(&Slot, Rc<[&Module]>)> = None;
    for (slot, instance) in slots.places() {
        let offered = match last.take().filter(|(same, _)| std::ptr::eq(*same, slot)) {
            Some((_, offered)) => offered,
            None => offered(modules, &by_ident, slot)?,
        };
        last = Some((slot, Rc::clone(&offered)));
        let name = match slot.instances() {
            1 => slot.name.clone(),
            _ => format!("{} {}", slot.name, instance + 1),
        };
        places.push(Instance {
            slot,
            offered,
            name,
            required: instance < slot.min_instances,
        });
    }
    Ok(places)
}

fn named<'a>(
    device: &Device,
    place: &Instance<'a>,
    name: &str,
) -> Result<Option<&'a Module>, SelectError> {
    if name.is_empty() || name == EMPTY_PLACE {
        return Ok(None);
    }
    let ident = name
        .strip_prefix("0x")
        .or(name.strip_prefix("0X"))
        .map_or_else(
            || name.parse().ok(),
            |hex| u32::from_str_radix(hex, 16).ok(),
        );
    let all = &place.offered;
    let found = all
        .iter()
        .copied()
        .find(|module| is_called(module, name) || ident == Some(module.ident));
    match found {
        Some(module) => Ok(Some(module)),
        None => Err(SelectError::NoSuchModule {
            device: device.name.clone(),
            slot: place.name.clone(),
            wanted: name.to_owned(),
            offered: describe(all),
        }),
    }
}

/// Returns the module of this mode. A slot without drive modules gets its default.
fn for_mode<'a>(
    device: &Device,
    place: &Instance<'a>,
    mode: Mode,
) -> Result<Option<&'a Module>, SelectError> {
    let all = &place.offered;
    let by_command = |module: &&&Module| commanded_mode(module) == Some(mode.code());
    let by_name = |module: &&&Module| {
        commanded_mode(module).is_none()
            && (mode.is_named_in(&module.type_name) || mode.is_named_in(&module.name))
    };
    let found = all
        .iter()
        .find(by_command)
        .or_else(|| all.iter().find(by_name));
    match found {
        Some(module) => Ok(Some(module)),
        None if all.iter().any(|module| mode_of(module).is_some()) => {
            Err(SelectError::ModeNotOffered {
                missing: None,
                device: device.name.clone(),
                mode,
                offered: describe(all),
            })
        }
        None => Ok(default_module(place)),
    }
}

/// Returns the modules that one slot accepts.
fn offered<'a>(
    modules: &'a [Module],
    by_ident: &HashMap<u32, &'a Module>,
    slot: &Slot,
) -> Result<Rc<[&'a Module]>, SelectError> {
    let mut all = Vec::new();
    for &(ident, _) in &slot.module_idents {
        let found = by_ident.get(&ident).copied();
        all.push(found.ok_or_else(|| SelectError::UnknownModule {
            slot: slot.name.clone(),
            position: slot.position,
            ident,
        })?);
    }
    let of_class = |module: &&Module| {
        let class = module.class.as_ref();
        class.is_some_and(|class| slot.module_classes.contains(class))
    };
    all.extend(modules.iter().filter(of_class));
    Ok(all.into())
}

fn default_module<'a>(place: &Instance<'a>) -> Option<&'a Module> {
    let all = &place.offered;
    let marked = place
        .slot
        .module_idents
        .iter()
        .find(|(_, default)| *default);
    match (marked, &all[..]) {
        (Some((ident, _)), _) => all.iter().copied().find(|module| module.ident == *ident),
        (None, [only]) if place.required => Some(only),
        _ => None,
    }
}

/// Returns the mode that the module's own InitCmd writes.
fn commanded_mode(module: &Module) -> Option<i8> {
    let command = module
        .init_cmds
        .iter()
        .find(|cmd| cmd.index == MODES_OF_OPERATION)?;
    command.data.first().map(|&byte| i8::from_le_bytes([byte]))
}

/// True if a module is for other modes: by the mode that its InitCmd commands, otherwise by name.
fn is_of_other_mode(module: &Module, mode: Mode) -> bool {
    let is_named =
        |mode: Mode| mode.is_named_in(&module.type_name) || mode.is_named_in(&module.name);
    match commanded_mode(module) {
        Some(commanded) => commanded != mode.code(),
        None => !is_named(mode) && Mode::ALL.into_iter().any(is_named),
    }
}

pub(super) fn mode_of(module: &Module) -> Option<Mode> {
    commanded_mode(module)
        .and_then(Mode::from_code)
        .or_else(|| {
            Mode::ALL
                .into_iter()
                .find(|mode| mode.is_named_in(&module.type_name) || mode.is_named_in(&module.name))
        })
}

fn describe(modules: &[&Module]) -> String {
    const SHOWN: usize = 12;
    let more = modules.len().saturating_sub(SHOWN);
    let more = (more > 0).then(|| format!("and {more} more"));
    let texts: Vec<String> = modules
        .iter()
        .take(SHOWN)
        .map(|module| match mode_of(module) {
            Some(mode) => format!("{mode} (module {:?})", module.type_name),
            None => format!("module {:?}", module.type_name),
        })
        .chain(more)
        .collect();
    if texts.is_empty() {
        "no module".to_owned()
    } else {
        texts.join(", ")
    }
}
