//! The start-up IDNs of a Sercos drive (SoE).

use ecaxis_ecat::mailbox::soe::{Attribute, DataLength, Element, Idn, List, parse_value};
use ecaxis_esi::{IdnValue, StartupIdn};

use super::device::StartupPhase;
use super::{BusDevice, Step};
use crate::acyclic::DeviceRef;
use crate::config::{DeviceConfig, StartupOptions};
use crate::mailbox::{CoeClient, IdnElement, MailboxTransport, SdoError};
use crate::report::{Cause, Error};

/// Writes the IDNs of one phase in order. The mailbox is emptied first, because the device may have
/// sent emergencies before.
pub(super) async fn start_up(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    device: &mut BusDevice,
    phase: StartupPhase,
    progress: &dyn Fn(Step),
) -> Result<(), Error> {
    let Some(client) = device.soe.as_mut() else {
        return Ok(());
    };
    client.drain(wire).await.map_err(|source| {
        Cause::Sdo(source)
            .with_device(&device.at)
            .with_action("emptying the mailbox")
    })?;
    let due = |transition: &str| (transition == "SO") == (phase == StartupPhase::InSafeOp);
    let list: Vec<_> = config
        .selection
        .startup_idns
        .iter()
        .filter(|idn| due(idn.transition))
        .collect();
    for (done, idn) in list.iter().enumerate() {
        write(wire, &device.at, client, idn, config.startup.of_idns()).await?;
        progress(Step::StartUp {
            device: config.name.clone(),
            done: done + 1,
            of: list.len(),
        });
    }
    Ok(())
}

/// Writes one IDN, unless the drive holds the value and that suffices. Reads it back if requested.
async fn write(
    wire: &impl MailboxTransport,
    device: &DeviceRef,
    client: &mut CoeClient,
    idn: &StartupIdn,
    options: StartupOptions,
) -> Result<(), Error> {
    let at = IdnElement::value(idn.drive, idn.idn);
    let failed = |source: SdoError| failure(device, idn, at, source);
    let (value, is_list) = match &idn.value {
        IdnValue::Bytes(bytes) => {
            let is_list = matches!(idn.idn, Idn::AT_LIST | Idn::MDT_LIST);
            (bytes.clone(), is_list)
        }
        IdnValue::Text(text) => {
            let attribute = client.read_idn(wire, at.with(Element::Attribute)).await;
            let attribute = attribute.map_err(failed)?;
            let attribute = attribute.first_chunk().map(|b| u32::from_le_bytes(*b));
            let attribute = Attribute(attribute.unwrap_or(0));
            let value = parse_value(attribute, text).map_err(|problem| {
                Cause::IdnValue {
                    at,
                    origin: idn.origin.clone(),
                    problem,
                }
                .with_device(device)
            })?;
            (value, matches!(attribute.length(), DataLength::List(_)))
        }
    };
    if options.skip_equal
        && let Some(now) = client.read_idn_optional(wire, at).await.map_err(failed)?
        && holds(&value, &now, is_list)
    {
        return Ok(());
    }
    client.write_idn(wire, at, &value).await.map_err(failed)?;
    tracing::debug!(%device, "{at} = {} ({})", show(idn), idn.origin);
    if !options.verify {
        return Ok(());
    }
    match client.read_idn_optional(wire, at).await.map_err(failed)? {
        Some(now) if !holds(&value, &now, is_list) => Err(Cause::NotHeld {
            object: at.to_string(),
            value: show(idn),
            origin: idn.origin.clone(),
            holds: bytes(&now),
        }
        .with_device(device)),
        _ => Ok(()),
    }
}

/// True if the drive holds a value. Lists may have another maximum length.
fn holds(value: &[u8], now: &[u8], is_list: bool) -> bool {
    let same_list = || match (List::parse(value), List::parse(now)) {
        (Some(a), Some(b)) => a.data == b.data,
        _ => false,
    };
    value == now || is_list && same_list()
}

fn failure(device: &DeviceRef, idn: &StartupIdn, at: IdnElement, source: SdoError) -> Error {
    Cause::StartUpIdn {
        at,
        value: show(idn),
        origin: idn.origin.clone(),
        source,
    }
    .with_device(device)
}

/// Returns the value as in the file, or its bytes.
fn show(idn: &StartupIdn) -> String {
    match &idn.value {
        IdnValue::Text(text) => text.clone(),
        IdnValue::Bytes(data) => bytes(data),
    }
}

fn bytes(data: &[u8]) -> String {
    const SHOWN: usize = 16;
    let shown: Vec<_> = data
        .iter()
        .take(SHOWN)
        .map(|b| format!("{b:02x}"))
        .collect();
    let more = if data.len() > SHOWN { " …" } else { "" };
    format!("[{}{more}]", shown.join(" "))
}
