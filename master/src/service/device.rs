//! One device of a segment: found, with what its EEPROM says, and with its mailbox open.

use ecaxis_esi::sii::{self, Sii};

use super::eeprom::{Claim, EepromError, with_eeprom};
use super::mailbox::{self, Lent};
use super::station::{Found, Which, address, census};
use super::{Datagrams, ServiceError};
use crate::bringup::al::read_explicit_id;
use crate::bringup::{AlState, DeviceRef};
use crate::config::Locator;
use crate::mailbox::Wire;

/// A device that was asked for, with the station address that it has now.
///
/// # Errors
/// [`ServiceError::NotFound`], [`ServiceError::Ambiguous`]; of the segment.
pub async fn locate(
    wire: &Datagrams,
    at: Locator,
    name: Option<&str>,
) -> Result<(Found, DeviceRef), ServiceError> {
    let mut all = census(wire).await?;
    address(wire, &mut all).await?;
    let found = match at {
        Locator::Position(position) => Which::Position(position).among(&all)?,
        Locator::Alias(alias) => Which::Alias(alias).among(&all)?,
        Locator::Id(id) => by_id(wire, &all, id).await?,
    };
    let name = name.map_or_else(|| format!("device {}", found.position), ToOwned::to_owned);
    Ok((found.clone(), found.named(name)))
}

/// By its explicit device identification (ETG.1020), as it tells it itself.
async fn by_id<'f>(wire: &Datagrams, all: &'f [Found], id: u16) -> Result<&'f Found, ServiceError> {
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

/// What its EEPROM says. Where the device itself is using it and has its mailbox already, nothing: the mailbox does
/// without.
///
/// # Errors
/// [`ServiceError::Eeprom`], [`ServiceError::Sii`].
pub async fn information(
    wire: &impl Wire,
    found: &Found,
    device: &DeviceRef,
) -> Result<Sii, ServiceError> {
    let has_mailbox = matches!(found.state, AlState::PreOp | AlState::SafeOp | AlState::Op);
    let claim = Claim::of(found.state);
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

/// Does a piece of work on a device's CoE mailbox. A device in Init is in PreOp meanwhile and in Init again afterwards,
/// however the work ends. `step` says what is done.
///
/// # Errors
/// Of [`mailbox::lend`] and of going back; [`ServiceError::Stopped`]; the work's own come first.
pub async fn with_mailbox<T, E: From<ServiceError>>(
    wire: &Datagrams,
    device: &DeviceRef,
    sii: &Sii,
    step: &'static str,
    work: impl AsyncFnOnce(&mut Lent) -> Result<T, E>,
) -> Result<T, E> {
    let stop = wire.stop();
    let whole = async {
        let mut lent = mailbox::lend(wire, device, sii).await?;
        let done = match stop.unless(work(&mut lent)).await {
            Some(done) => done,
            None => {
                // One that stays in its state must not wait for the rest of a transfer.
                let _ = lent.coe.give_up(wire).await;
                let device = device.clone();
                Err(ServiceError::Stopped { device, step }.into())
            }
        };
        let back = lent.give_back(wire).await;
        let done = done?;
        back?;
        Ok(done)
    };
    stop.hold(whole).await
}
