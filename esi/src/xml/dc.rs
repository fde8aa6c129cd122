//! `Dc/OpMode`.

use super::cursor::{Cursor, Element};
use super::sync;
use super::text::Names;
use crate::error::EsiError;
use crate::model::{DcMode, SyncTime};

pub(super) fn read<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Vec<DcMode>, EsiError> {
    let mut modes = Vec::new();
    c.children(element, |c, el| {
        if el.name == "OpMode" {
            let read = op_mode(c, el).map(|mode| modes.push(mode));
            return c.leave_out(el, read);
        }
        Ok(())
    })?;
    Ok(modes)
}

fn op_mode<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<DcMode, EsiError> {
    let mut mode = DcMode {
        position: c.position(element),
        ..DcMode::default()
    };
    let mut descriptions = Names::default();
    c.children(element, |c, el| {
        match el.name {
            "Name" => mode.name = c.text(el)?,
            "Desc" => descriptions.add(c, el)?,
            "AssignActivate" => mode.assign_activate = c.number(el, "AssignActivate")?,
            "CycleTimeSync0" => cycle(c, el, &mut mode.sync0)?,
            "ShiftTimeSync0" => shift(c, el, &mut mode.sync0)?,
            "CycleTimeSync1" => cycle(c, el, &mut mode.sync1)?,
            "ShiftTimeSync1" => shift(c, el, &mut mode.sync1)?,
            "Sm" => {
                let (sm, oversampling) = sync::assignment(c, el)?;
                mode.sync_managers.extend(sm);
                mode.oversampling.extend(oversampling);
            }
            _ => {}
        }
        Ok(())
    })?;
    mode.description = descriptions.take().into_owned();
    Ok(mode)
}

fn cycle<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
    sync: &mut SyncTime,
) -> Result<(), EsiError> {
    sync.factor = c.attribute_number(element, "Factor")?.unwrap_or_default();
    sync.cycle_ns = time(c, element)?;
    Ok(())
}

fn shift<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
    sync: &mut SyncTime,
) -> Result<(), EsiError> {
    sync.shift_factor = c.attribute_number(element, "Factor")?.unwrap_or_default();
    sync.shift_input = c.attribute_flag(element, "Input")?;
    sync.shift_ns = time(c, element)?;
    Ok(())
}

/// Returns a time in ns; an empty element means 0.
fn time<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<i64, EsiError> {
    c.optional_number(element, "time in nanoseconds")
        .map(Option::unwrap_or_default)
}
