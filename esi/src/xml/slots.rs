//! `Slots`: where modules go. Slot groups are read as if their slots stood in the list.

use super::cursor::{Cursor, Element};
use super::text::Names;
use crate::error::EsiError;
use crate::model::{Slot, Slots};

pub(super) fn read<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Slots, EsiError> {
    let mut slots = Slots {
        position: element.position,
        max_count: c.attribute_number(element, "MaxSlotCount")?,
        pdo_increment: c
            .attribute_number(element, "SlotPdoIncrement")?
            .unwrap_or_default(),
        index_increment: c
            .attribute_number(element, "SlotIndexIncrement")?
            .unwrap_or_default(),
        download_module_ident_list: c.attribute_flag(element, "DownloadModuleIdentList")?,
        slots: Vec::new(),
    };
    c.children(element, |c, el| match el.name {
        "Slot" => {
            slots.slots.push(slot(c, el)?);
            Ok(())
        }
        "SlotGroup" => c.children(el, |c, el| {
            if el.name == "Slot" {
                slots.slots.push(slot(c, el)?);
            }
            Ok(())
        }),
        _ => Ok(()),
    })?;
    Ok(slots)
}

fn slot<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Slot, EsiError> {
    let mut slot = Slot {
        position: element.position,
        name: String::new(),
        min_instances: c
            .attribute_number(element, "MinInstances")?
            .unwrap_or_default(),
        max_instances: c.attribute_number(element, "MaxInstances")?.unwrap_or(1),
        module_idents: Vec::new(),
    };
    let mut names = Names::default();
    c.children(element, |c, el| {
        match el.name {
            "Name" => names.add(c, el)?,
            "ModuleIdent" => {
                let default = c.attribute_flag(el, "Default")?;
                slot.module_idents
                    .push((c.number(el, "ModuleIdent")?, default));
            }
            _ => {}
        }
        Ok(())
    })?;
    slot.name = names.take();
    Ok(slot)
}
