//! Operations on one device of a segment: locating it, reading its EEPROM, opening its mailbox.

use ecaxis_esi::sii::{self, General, Sii};

use super::DatagramClient;
use super::eeprom::{EepromAccess, EepromError, with_eeprom};
use super::enumerate::{EnumeratedDevice, address, enumerate, select};
use super::mailbox::{self, MailboxSession};
use super::topology::{nth_behind, parents};
use crate::acyclic::{AlState, DeviceRef, al};
use crate::config::Locator;
use crate::mailbox::MailboxTransport;
use crate::report::{Cause, Error};

/// Returns the requested device with its present station address. Every device has one afterwards.
///
/// # Errors
/// [`Cause::NotFound`], [`Cause::Ambiguous`]; as [`enumerate`].
pub async fn locate(
    wire: &DatagramClient,
    at: Locator,
    name: Option<&str>,
) -> Result<(EnumeratedDevice, DeviceRef), Error> {
    let mut all = enumerate(wire).await?;
    address(wire, &mut all).await?;
    let (wanted, place) = match at {
        Locator::Behind(head, place) => (head.locator(), place),
        at => (at, 0),
    };
    let wanted = match wanted {
        Locator::Id(id) => {
            let found = find_explicit_id(wire, &all, id).await;
            found.map_or(wanted, |found| Locator::Position(found.position))
        }
        wanted => wanted,
    };
    let mut found = select(&all, wanted)?;
    if place > 0 {
        let parents = parents(all.iter().map(|found| found.dl_status));
        let behind = nth_behind(&parents, found.position, place);
        let behind = behind.and_then(|position| all.get(usize::from(position)));
        found = behind.ok_or_else(|| {
            let head = found.position;
            Error::from(Cause::NotFound {
                wanted: at.to_string(),
                found: format!("the segment at position {head} is shorter"),
            })
        })?;
    }
    let name = name.map_or_else(|| format!("device {}", found.position), ToOwned::to_owned);
    Ok((found.clone(), found.named(name)))
}

/// Returns the device with this identification. Devices that do not answer at once are asked again,
/// with more time, if their EEPROM says that they have one.
async fn find_explicit_id<'f>(
    wire: &DatagramClient,
    all: &'f [EnumeratedDevice],
    id: u16,
) -> Option<&'f EnumeratedDevice> {
    let short = al::SHORT_IDENTIFICATION_TIMEOUT;
    let stations = all.iter().map(|found| (found.station, short));
    if let Some(index) = al::find_explicit_id(wire, stations, id).await {
        return all.get(index);
    }
    for found in all {
        let device = found.named(format!("device {}", found.position));
        let sii = read_sii(wire, &device, EepromAccess::of(found.state)).await;
        let general = sii.ok().and_then(|sii| sii.general);
        let answers =
            general.is_some_and(|general| general.flags & General::IDENTIFICATION_AL_STATUS != 0);
        let long = al::IDENTIFICATION_TIMEOUT;
        if answers && al::read_explicit_id(wire, found.station, long).await == Ok(Some(id)) {
            return Some(found);
        }
    }
    None
}

/// Reads the content of a device's EEPROM.
///
/// # Errors
/// [`Cause::Eeprom`], [`Cause::Sii`].
pub async fn read_sii(
    wire: &impl MailboxTransport,
    device: &DeviceRef,
    access: EepromAccess,
) -> Result<Sii, Error> {
    let image = read_image(wire, device, access).await?;
    sii::parse(&image).map_err(|error| Cause::Sii(error).with_device(device))
}

/// Reads the image in a device's EEPROM up to the end of its categories.
///
/// # Errors
/// [`Cause::Eeprom`].
pub async fn read_image(
    wire: &impl MailboxTransport,
    device: &DeviceRef,
    access: EepromAccess,
) -> Result<Vec<u8>, Error> {
    with_eeprom(wire, device, "reading its EEPROM", access, async |eeprom| {
        eeprom.image(&mut |_, _| {}).await
    })
    .await
}

/// Reads the content of a device's EEPROM; `None` if the PDI is using the EEPROM and the mailbox is
/// already configured: the mailbox does not need it then.
///
/// # Errors
/// As [`read_sii`].
pub async fn read_sii_unless_in_use(
    wire: &impl MailboxTransport,
    found: &EnumeratedDevice,
    device: &DeviceRef,
    access: EepromAccess,
) -> Result<Option<Sii>, Error> {
    let has_mailbox = matches!(found.state, AlState::PreOp | AlState::SafeOp | AlState::Op);
    match read_sii(wire, device, access).await {
        Err(error) if has_mailbox && matches!(*error.cause, Cause::Eeprom(EepromError::InUse)) => {
            Ok(None)
        }
        sii => sii.map(Some),
    }
}

/// Runs `work` on a device's CoE mailbox. A device in Init is in PreOp meanwhile and returns to
/// Init afterwards, even after an error. `step` describes the operation.
///
/// # Errors
/// As [`mailbox::open`] and [`mailbox::MailboxSession::close`]; [`Cause::Interrupted`]. Errors
/// of the work take precedence.
pub async fn with_mailbox<T, E: From<Error>>(
    wire: &DatagramClient,
    device: &DeviceRef,
    sii: &Sii,
    step: &'static str,
    work: impl AsyncFnOnce(&mut MailboxSession) -> Result<T, E>,
) -> Result<T, E> {
    let stop = wire.stop();
    let whole = async {
        let mut lent = mailbox::open(wire, device, sii).await?;
        let done = match stop.run_until_cancelled(work(&mut lent)).await {
            Some(done) => done,
            None => {
                // A device that keeps its state must not wait for the rest of a transfer.
                let _ = lent.coe.abort_transfer(wire).await;
                Err(Cause::Interrupted
                    .with_device(device)
                    .with_action(step)
                    .into())
            }
        };
        let back = lent.close(wire).await;
        let done = done?;
        back?;
        Ok(done)
    };
    stop.shield(whole).await
}
