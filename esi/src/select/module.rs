//! Which module goes into the slot.

use super::SelectError;
use crate::mode::Mode;
use crate::model::{Device, Module, Slot};

const MODES_OF_OPERATION: u16 = 0x6060;

/// A module in its slot.
#[derive(Debug, Clone, Copy)]
pub(super) struct Placed<'a> {
    pub module: &'a Module,
    pub slot: &'a Slot,
}

/// `None`: the device has no slots, or an optional slot stays empty.
pub(super) fn choose<'a>(
    modules: &'a [Module],
    device: &'a Device,
    mode: Option<Mode>,
) -> Result<Option<Placed<'a>>, SelectError> {
    let Some(slots) = &device.slots else {
        return Ok(None);
    };
    let required = slots
        .slots
        .iter()
        .filter(|slot| slot.min_instances > 0)
        .count();
    if required > 1 {
        return Err(SelectError::SeveralSlots {
            device: device.name.clone(),
            count: required,
        });
    }
    let Some(slot) = slots
        .slots
        .iter()
        .find(|slot| slot.min_instances > 0)
        .or(slots.slots.first())
    else {
        return Ok(None);
    };
    let offered = modules_of(modules, slot)?;
    let found = match mode {
        Some(mode) => {
            let by_command = offered
                .iter()
                .find(|module| commanded_mode(module) == Some(mode.code()));
            let by_name = || {
                offered.iter().find(|module| {
                    commanded_mode(module).is_none()
                        && (mode.is_named_in(&module.type_name) || mode.is_named_in(&module.name))
                })
            };
            match by_command.or_else(by_name) {
                Some(module) => Some(*module),
                None => {
                    let offered = describe(&offered);
                    return Err(SelectError::ModeNotOffered {
                        device: device.name.clone(),
                        mode,
                        offered,
                    });
                }
            }
        }
        None => default_module(&slot.module_idents, &offered),
    };
    match found {
        Some(module) => Ok(Some(Placed { module, slot })),
        None if slot.min_instances == 0 => Ok(None),
        None => Err(SelectError::ModuleNeeded {
            device: device.name.clone(),
            slot: slot.name.clone(),
            offered: describe(&offered),
        }),
    }
}

/// The modules that one slot takes.
fn modules_of<'a>(modules: &'a [Module], slot: &Slot) -> Result<Vec<&'a Module>, SelectError> {
    slot.module_idents
        .iter()
        .map(|&(ident, _)| {
            modules
                .iter()
                .find(|module| module.ident == ident)
                .ok_or_else(|| SelectError::UnknownModule {
                    slot: slot.name.clone(),
                    ident,
                })
        })
        .collect()
}

fn default_module<'a>(idents: &[(u32, bool)], offered: &[&'a Module]) -> Option<&'a Module> {
    let marked = idents
        .iter()
        .find(|(_, default)| *default)
        .map(|(ident, _)| *ident);
    match (marked, offered) {
        (Some(ident), _) => offered.iter().copied().find(|module| module.ident == ident),
        (None, [only]) => Some(only),
        _ => None,
    }
}

/// The mode that a module's own InitCmd writes.
pub(super) fn commanded_mode(module: &Module) -> Option<i8> {
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
