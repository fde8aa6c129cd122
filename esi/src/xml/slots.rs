//! `Slots`: the places for modules. Slots inside a `SlotGroup` element are treated as direct
//! elements of the list.

use super::cursor::{Cursor, Element};
use super::text::Names;
use crate::error::EsiError;
use crate::model::{Increments, ModulePdoGroup, Slot, Slots};

pub(super) fn read<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Slots, EsiError> {
    let mut slots = Slots {
        position: c.position(element),
        max_count: c.attribute_number(element, "MaxSlotCount")?,
        increments: Increments {
            pdo: increment(c, element, "SlotPdoIncrement")?,
            index: increment(c, element, "SlotIndexIncrement")?,
            group_pdo: increment(c, element, "SlotGroupPdoIncrement")?,
            group_index: increment(c, element, "SlotGroupIndexIncrement")?,
        },
        download_module_ident_list: c.attribute_flag(element, "DownloadModuleIdentList")?,
        slots: Vec::new(),
        pdo_groups: Vec::new(),
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
        "ModulePdoGroup" => {
            slots.pdo_groups.push(ModulePdoGroup {
                alignment: c.attribute_number(el, "Alignment")?.unwrap_or_default(),
                rx_pdo: c.attribute_number(el, "RxPdo")?,
                tx_pdo: c.attribute_number(el, "TxPdo")?,
                name: c.text(el)?,
            });
            Ok(())
        }
        _ => Ok(()),
    })?;
    Ok(slots)
}

fn increment(c: &Cursor<'_>, element: &Element<'_>, name: &'static str) -> Result<u16, EsiError> {
    Ok(c.attribute_number(element, name)?.unwrap_or_default())
}

fn slot<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Slot, EsiError> {
    let mut slot = Slot {
        position: c.position(element),
        name: String::new(),
        group: c.attribute_number(element, "SlotGroup")?,
        pdo_increment: c.attribute_number(element, "SlotPdoIncrement")?,
        index_increment: c.attribute_number(element, "SlotIndexIncrement")?,
        min_instances: c
            .attribute_number(element, "MinInstances")?
            .unwrap_or_default(),
        max_instances: c.attribute_number(element, "MaxInstances")?.unwrap_or(1),
        module_idents: Vec::new(),
        module_classes: Vec::new(),
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
            "ModuleClass" => c.children(el, |c, el| {
                if el.name == "Class" {
                    slot.module_classes.push(c.text(el)?);
                }
                Ok(())
            })?,
            _ => {}
        }
        Ok(())
    })?;
    slot.name = names.take().into_owned();
    Ok(slot)
}
