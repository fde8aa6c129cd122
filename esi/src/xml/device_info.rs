//! `Device/Info`: properties of a device, and the alternative PDO assignments below it.

use super::cursor::{Cursor, Element};
use super::sync;
use crate::error::EsiError;
use crate::model::{Identification, Info, Port, PortKind, SmMapping};

pub(super) fn read<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
    mappings: &mut Vec<SmMapping>,
) -> Result<Info, EsiError> {
    let mut info = Info::default();
    c.children(element, |c, el| {
        match el.name {
            "Electrical" => c.children(el, |c, el| {
                if el.name == "EBusCurrent" {
                    info.ebus_current_ma = c.optional_number(el, "EBusCurrent")?;
                }
                Ok(())
            })?,
            "StateMachine" => state_machine(c, el, &mut info)?,
            "Mailbox" => c.children(el, |c, el| match el.name {
                "Timeout" => c.children(el, |c, el| {
                    match el.name {
                        "RequestTimeout" => {
                            info.mailbox_request_timeout_ms = c.optional_number(el, "timeout")?;
                        }
                        "ResponseTimeout" => {
                            info.mailbox_response_timeout_ms = c.optional_number(el, "timeout")?;
                        }
                        _ => {}
                    }
                    Ok(())
                }),
                _ => Ok(()),
            })?,
            "EtherCATController" => c.children(el, |c, el| {
                match el.name {
                    "DpramSize" => info.dpram_bytes = c.optional_number(el, "DpramSize")?,
                    "SmCount" => info.sm_count = c.optional_number(el, "SmCount")?,
                    "FmmuCount" => info.fmmu_count = c.optional_number(el, "FmmuCount")?,
                    _ => {}
                }
                Ok(())
            })?,
            "Port" => info.ports.push(port(c, el)?),
            "IdentificationReg134" if c.flag(el)? => {
                info.identification = Identification::Reg134;
            }
            "IdentificationReg134" => {}
            "IdentificationAdo" => {
                info.identification = Identification::Ado(c.number(el, "IdentificationAdo")?);
            }
            "VendorSpecific" => vendor_specific(c, el, mappings)?,
            _ => {}
        }
        Ok(())
    })?;
    Ok(info)
}

fn state_machine<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
    info: &mut Info,
) -> Result<(), EsiError> {
    c.children(element, |c, el| match el.name {
        "Timeout" => c.children(el, |c, el| {
            let time = match el.name {
                "PreopTimeout" => &mut info.preop_timeout_ms,
                "SafeopOpTimeout" => &mut info.safeop_op_timeout_ms,
                "BackToInitTimeout" => &mut info.back_to_init_timeout_ms,
                "BackToSafeopTimeout" => &mut info.back_to_safeop_timeout_ms,
                _ => return Ok(()),
            };
            *time = c.optional_number(el, "timeout in milliseconds")?;
            Ok(())
        }),
        "Behavior" => {
            info.start_to_safeop_no_sync = c.attribute_flag(el, "StartToSafeopNoSync")?;
            Ok(())
        }
        _ => Ok(()),
    })
}

fn port<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<Port, EsiError> {
    let mut port = Port::default();
    c.children(element, |c, el| {
        match el.name {
            "Type" => {
                port.kind = match c.text(el)?.to_ascii_uppercase().as_str() {
                    "MII" => PortKind::Mii,
                    "EBUS" => PortKind::EBus,
                    _ => PortKind::None,
                }
            }
            "Label" => port.label = c.text(el)?,
            "RxDelay" => port.rx_delay_ns = c.optional_number(el, "RxDelay")?,
            "TxDelay" => port.tx_delay_ns = c.optional_number(el, "TxDelay")?,
            _ => {}
        }
        Ok(())
    })?;
    Ok(port)
}

/// Reads the one vendor-specific section that contains generally used data. Other vendor sections
/// are for configurators only.
pub(super) fn vendor_specific<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
    mappings: &mut Vec<SmMapping>,
) -> Result<(), EsiError> {
    c.children(element, |c, el| match el.name {
        "TwinCAT" => c.children(el, |c, el| match el.name {
            "AlternativeSmMapping" => append_sm_mapping(c, el, mappings),
            _ => Ok(()),
        }),
        _ => Ok(()),
    })
}

/// Reads one more assignment and skips an unreadable one.
pub(super) fn append_sm_mapping<'a>(
    c: &mut Cursor<'a>,
    element: &Element<'a>,
    to: &mut Vec<SmMapping>,
) -> Result<(), EsiError> {
    let read = sm_mapping(c, element).map(|mapping| to.push(mapping));
    c.leave_out(element, read)
}

fn sm_mapping<'a>(c: &mut Cursor<'a>, element: &Element<'a>) -> Result<SmMapping, EsiError> {
    let mut mapping = SmMapping {
        position: c.position(element),
        path: c.path_of(element),
        default: c.attribute_flag(element, "Default")?,
        ..SmMapping::default()
    };
    c.children(element, |c, el| {
        match el.name {
            "Name" => mapping.name = c.text(el)?,
            "Sm" => {
                let (sm, oversampling) = sync::assignment(c, el)?;
                mapping.sync_managers.extend(sm);
                mapping.oversampling.extend(oversampling);
            }
            _ => {}
        }
        Ok(())
    })?;
    Ok(mapping)
}
