//! `Fmmu` and `Sm`.

use super::cursor::{Cursor, Element};
use crate::error::{EsiError, EsiProblem};
use crate::model::{Fmmu, FmmuUse, SmUse, SyncManager, SyncUnit};

pub(super) fn fmmu<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Fmmu, EsiError> {
    Ok(Fmmu {
        sm: c.attribute_number(element, "Sm")?,
        su: c.attribute_number(element, "Su")?,
        op_only: c.attribute_flag(element, "OpOnly")?,
        usage: match c.text(element)?.to_ascii_lowercase().as_str() {
            "outputs" => FmmuUse::Outputs,
            "inputs" => FmmuUse::Inputs,
            "mboxstate" => FmmuUse::MBoxState,
            _ => FmmuUse::Other,
        },
    })
}

pub(super) fn sync_unit<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
) -> Result<SyncUnit, EsiError> {
    Ok(SyncUnit {
        separate: c.attribute_flag(element, "SeparateSu")?,
        separate_frame: c.attribute_flag(element, "SeparateFrame")?,
        depends_on_input_state: c.attribute_flag(element, "DependOnInputState")?,
        frame_repeat: c.attribute_flag(element, "FrameRepeatSupport")?,
        name: c.text(element)?,
    })
}

/// A SyncManager's number with its PDOs, and the oversampling factors by PDO.
pub(super) type Assignment = (Option<(u8, Vec<u16>)>, Vec<(u16, u16)>);

/// Reads `Sm No="2"` with its `Pdo`s in an OpMode or an AlternativeSmMapping. Returns no
/// SyncManager without a number.
pub(super) fn assignment<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
) -> Result<Assignment, EsiError> {
    let mut oversampling = Vec::new();
    let number = c.attribute_number(element, "No")?;
    let mut pdos = Vec::new();
    c.children(element, |c, el| {
        if el.name == "Pdo" {
            let factor = c.attribute_number(el, "OSFac")?;
            let index = c.number(el, "PDO index")?;
            oversampling.extend(factor.map(|factor| (index, factor)));
            pdos.push(index);
        }
        Ok(())
    })?;
    Ok((number.map(|number| (number, pdos)), oversampling))
}

pub(super) fn sync_manager<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
) -> Result<SyncManager, EsiError> {
    let start_address = c.attribute_number(element, "StartAddress")?;
    let Some(start_address) = start_address else {
        return Err(c.error_at(
            element,
            EsiProblem::Missing {
                what: "StartAddress",
            },
        ));
    };
    // ETG.2000: bit 0 of Enable means enabled; the higher bits only declare that the value is
    // changeable.
    let enable: Option<u8> = match c.attribute(element, "Enable")?.as_deref().map(str::trim) {
        Some("true") => Some(1),
        Some("false") => Some(0),
        _ => c.attribute_number(element, "Enable")?,
    };
    let mut sm = SyncManager {
        position: c.position(element),
        usage: SmUse::Other,
        start_address,
        default_size: c
            .attribute_number(element, "DefaultSize")?
            .unwrap_or_default(),
        min_size: c.attribute_number(element, "MinSize")?,
        max_size: c.attribute_number(element, "MaxSize")?,
        control_byte: c
            .attribute_number(element, "ControlByte")?
            .unwrap_or_default(),
        enable: enable.is_some_and(|bits| bits & 1 != 0),
        virtual_: c.attribute_flag(element, "Virtual")?,
        op_only: c.attribute_flag(element, "OpOnly")?,
        watchdog: c.attribute_optional_flag(element, "Watchdog")?,
    };
    sm.usage = match c.text(element)?.to_ascii_lowercase().as_str() {
        "mboxout" => SmUse::MBoxOut,
        "mboxin" => SmUse::MBoxIn,
        "outputs" => SmUse::Outputs,
        "inputs" => SmUse::Inputs,
        _ => SmUse::Other,
    };
    Ok(sm)
}
