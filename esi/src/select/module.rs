//! Which modules go into which slots, and what a module's indices become there.

use super::SelectError;
use crate::mode::Mode;
use crate::model::{Device, Module, Slot, Slots};

const MODES_OF_OPERATION: u16 = 0x6060;
/// 0xF030 has so many subindices.
const MAX_PLACES: usize = 254;

/// A module in its slot; its indices are those that it has there.
#[derive(Debug, Clone)]
pub(super) struct Placed {
    /// Counted from 0 over all slots and their instances, empty ones included.
    pub place: usize,
    pub slot_name: String,
    pub module: Module,
}

/// One instance of a slot.
struct Place<'a> {
    slot: &'a Slot,
    name: String,
    required: bool,
}

/// Empty where the device has no slots, or its optional slots stay empty.
///
/// `wanted` names modules place by place (type, name or identity; `-` for none). A mode fills every required
/// place that offers drive modes and is not named, or the first place where none is required.
pub(super) fn choose(
    modules: &[Module],
    device: &Device,
    mode: Option<Mode>,
    wanted: &[&str],
) -> Result<Vec<Placed>, SelectError> {
    let no_slots = Slots::default();
    let slots = device.slots.as_ref().unwrap_or(&no_slots);
    let places = places(slots);
    if wanted.len() > places.len() {
        return Err(SelectError::TooManyModules {
            device: device.name.clone(),
            given: wanted.len(),
            places: places.len(),
        });
    }
    let any_required = places.iter().any(|place| place.required);
    let mut chosen = Vec::new();
    for (number, place) in places.iter().enumerate() {
        let by_name = wanted.get(number).map(|name| name.trim());
        let takes_mode = place.required || (!any_required && number == 0);
        let module = match (by_name, mode) {
            (Some(name), _) => named(modules, device, place, name)?,
            (None, Some(mode)) if takes_mode => for_mode(modules, device, place, mode)?,
            _ => default_module(modules, place)?,
        };
        let Some(module) = module else {
            if place.required {
                return Err(SelectError::ModuleNeeded {
                    device: device.name.clone(),
                    slot: place.name.clone(),
                    offered: describe(&offered(modules, place.slot)?),
                });
            }
            continue;
        };
        chosen.push(Placed {
            place: number,
            slot_name: place.name.clone(),
            module: module.at(slots, place.slot, number),
        });
    }
    Ok(chosen)
}

fn places(slots: &Slots) -> Vec<Place<'_>> {
    let most = slots
        .max_count
        .and_then(|count| usize::try_from(count).ok())
        .filter(|count| *count > 0)
        .map_or(MAX_PLACES, |count| count.min(MAX_PLACES));
    let mut places = Vec::new();
    for slot in &slots.slots {
        let instances = slot.max_instances.max(slot.min_instances).max(1);
        for instance in 0..instances {
            if places.len() >= most {
                return places;
            }
            let name = if instances > 1 {
                format!("{} {}", slot.name, instance + 1)
            } else {
                slot.name.clone()
            };
            places.push(Place {
                slot,
                name,
                required: instance < slot.min_instances,
            });
        }
    }
    places
}

fn named<'a>(
    modules: &'a [Module],
    device: &Device,
    place: &Place<'_>,
    name: &str,
) -> Result<Option<&'a Module>, SelectError> {
    if name.is_empty() || name == "-" {
        return Ok(None);
    }
    let ident = name
        .strip_prefix("0x")
        .or(name.strip_prefix("0X"))
        .map_or_else(
            || name.parse().ok(),
            |hex| u32::from_str_radix(hex, 16).ok(),
        );
    let all = offered(modules, place.slot)?;
    let found = all.iter().copied().find(|module| {
        module.type_name.eq_ignore_ascii_case(name)
            || module.name.eq_ignore_ascii_case(name)
            || ident == Some(module.ident)
    });
    match found {
        Some(module) => Ok(Some(module)),
        None => Err(SelectError::NoSuchModule {
            device: device.name.clone(),
            slot: place.name.clone(),
            wanted: name.to_owned(),
            offered: describe(&all),
        }),
    }
}

/// The module of this mode; a slot without drive modules gets its default.
fn for_mode<'a>(
    modules: &'a [Module],
    device: &Device,
    place: &Place<'_>,
    mode: Mode,
) -> Result<Option<&'a Module>, SelectError> {
    let all = offered(modules, place.slot)?;
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
                device: device.name.clone(),
                mode,
                offered: describe(&all),
            })
        }
        None => default_module(modules, place),
    }
}

/// The modules that one slot takes.
fn offered<'a>(modules: &'a [Module], slot: &Slot) -> Result<Vec<&'a Module>, SelectError> {
    let mut all = Vec::new();
    for &(ident, _) in &slot.module_idents {
        let found = modules.iter().find(|module| module.ident == ident);
        all.push(found.ok_or_else(|| SelectError::UnknownModule {
            slot: slot.name.clone(),
            ident,
        })?);
    }
    let of_class = |module: &&Module| {
        let class = module.class.as_ref();
        class.is_some_and(|class| slot.module_classes.contains(class))
    };
    all.extend(modules.iter().filter(of_class));
    Ok(all)
}

fn default_module<'a>(
    modules: &'a [Module],
    place: &Place<'_>,
) -> Result<Option<&'a Module>, SelectError> {
    let all = offered(modules, place.slot)?;
    let marked = place
        .slot
        .module_idents
        .iter()
        .find(|(_, default)| *default);
    Ok(match (marked, all.as_slice()) {
        (Some((ident, _)), _) => all.iter().copied().find(|module| module.ident == *ident),
        (None, [only]) if place.required => Some(only),
        _ => None,
    })
}

/// The mode that a module's own InitCmd writes.
fn commanded_mode(module: &Module) -> Option<i8> {
    let command = module
        .init_cmds
        .iter()
        .find(|cmd| cmd.index == MODES_OF_OPERATION)?;
    command.data.first().map(|&byte| i8::from_le_bytes([byte]))
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
    let texts: Vec<String> = modules
        .iter()
        .map(|module| match mode_of(module) {
            Some(mode) => format!("{mode} (module {:?})", module.type_name),
            None => format!("module {:?}", module.type_name),
        })
        .collect();
    if texts.is_empty() {
        "no module".to_owned()
    } else {
        texts.join(", ")
    }
}
