//! Operations on one device of a segment: locating it, reading its EEPROM, opening its mailbox.

use ecaxis_esi::sii::{self, Sii};

use super::eeprom::{EepromAccess, EepromError, with_eeprom};
use super::enumerate::{DeviceSelector, EnumeratedDevice, address, enumerate};
use super::mailbox::{self, MailboxSession};
use super::{DatagramClient, ServiceError};
use crate::bringup::al::read_explicit_id;
use crate::bringup::{AlState, DeviceRef};
use crate::config::Locator;
use crate::mailbox::MailboxTransport;

/// Returns the requested device with its present station address.
///
/// # Errors
/// [`ServiceError::NotFound`], [`ServiceError::Ambiguous`]; as [`enumerate`].
pub async fn locate(
    wire: &DatagramClient,
    at: Locator,
    name: Option<&str>,
) -> Result<(EnumeratedDevice, DeviceRef), ServiceError> {
    let mut all = enumerate(wire).await?;
    address(wire, &mut all).await?;
    let found = match at {
        Locator::Position(position) => DeviceSelector::Position(position).select_from(&all)?,
        Locator::Alias(alias) => DeviceSelector::Alias(alias).select_from(&all)?,
        Locator::Id(id) => by_id(wire, &all, id).await?,
    };
    let name = name.map_or_else(|| format!("device {}", found.position), ToOwned::to_owned);
    Ok((found.clone(), found.named(name)))
}

/// Finds a device by its explicit device identification (ETG.1020), read from the device itself.
async fn by_id<'f>(
    wire: &DatagramClient,
    all: &'f [EnumeratedDevice],
    id: u16,
) -> Result<&'f EnumeratedDevice, ServiceError> {
    for found in all {
        if matches!(read_explicit_id(wire, found.station).await, Ok(Some(actual)) if actual == id) {
            return Ok(found);
        }
    }
    Err(ServiceError::NotFound {
        wanted: format!("device identification {id}"),
        found: format!("{} were asked", all.len()),
    })
}

/// Returns the EEPROM content. Empty if the PDI is using the EEPROM and the mailbox is already
/// configured: the mailbox does not need it then.
///
/// # Errors
/// [`ServiceError::Eeprom`], [`ServiceError::Sii`].
pub async fn information(
    wire: &impl MailboxTransport,
    found: &EnumeratedDevice,
    device: &DeviceRef,
) -> Result<Sii, ServiceError> {
    let has_mailbox = matches!(found.state, AlState::PreOp | AlState::SafeOp | AlState::Op);
    let claim = EepromAccess::of(found.state);
    let image = with_eeprom(wire, device, "reading its EEPROM", claim, async |eeprom| {
        eeprom.image(&mut |_, _| {}).await
    });
    let image: Vec<u8> = match image.await {
        Err(ServiceError::Eeprom {
            source: EepromError::InUse,
            ..
        }) if has_mailbox => return Ok(Sii::default()),
        image => image?,
    };
    sii::parse(&image).map_err(|source| ServiceError::Sii {
        device: device.clone(),
        source,
    })
}

/// Runs `work` on a device's CoE mailbox. A device in Init is in PreOp meanwhile and returns to
/// Init afterwards, even after an error. `step` describes the operation.
///
/// # Errors
/// As [`mailbox::open`] and [`mailbox::MailboxSession::close`]; [`ServiceError::Stopped`]. Errors
/// of the work take precedence.
pub async fn with_mailbox<T, E: From<ServiceError>>(
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
                let device = device.clone();
                Err(ServiceError::Stopped { device, step }.into())
            }
        };
        let back = lent.close(wire).await;
        let done = done?;
        back?;
        Ok(done)
    };
    stop.shield(whole).await
}
