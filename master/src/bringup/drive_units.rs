//! The units of a drive (0x608F, 0x6091, 0x6092, 0x60A8–0x60AA, 0x6076, 0x607E; maxon's 0x3001:05).
//! They are read after the start-up SDOs and before the first target is sent.

use ecaxis_axis::scale::DriveUnits;
use ecaxis_ecat::index::AxisIndex;

use super::{BusDevice, Step, device};
use crate::config::{AxisSetup, DeviceConfig, TorqueUnit, is_maxon};
use crate::mailbox::{CoeClient, MailboxTransport, SdoError};
use crate::report::{Cause, Error};

/// Adopts the drive's units where the configuration only assumed them. Rejects units that would
/// move the axis wrongly.
pub(super) async fn compare(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    (index, axis): (AxisIndex, &AxisSetup),
    device: &mut BusDevice,
    progress: &dyn Fn(Step),
) -> Result<(), Error> {
    let Some(coe) = device.coe.as_mut() else {
        return Ok(());
    };
    let torque = &axis.torque;
    let constant = torque.unit == TorqueUnit::Amperes || torque.constant.is_some();
    let constant = constant && is_maxon(&config.selection);
    let offered = ask(wire, coe, axis.number, constant)
        .await
        .map_err(|source| {
            Cause::Sdo(source)
                .with_device(&device.at)
                .with_action("reading the drive's units")
        })?;
    tracing::debug!(device = %device.at, "{offered:?}");
    let adopted = axis.adopt(&offered);
    if !adopted.wrong.is_empty() {
        return Err(Cause::Units {
            problems: adopted.wrong,
        }
        .with_device(&device.at));
    }
    for what in &adopted.taken {
        progress(Step::Adopted {
            device: axis.name.clone(),
            what: what.clone(),
        });
    }
    for found in &adopted.doubtful {
        progress(Step::Warning(format!(
            "{}: {found}: {}",
            device.at,
            found.advice()
        )));
    }
    if let Some(note) = adopted.setup.assumed_velocity_unit() {
        progress(Step::Warning(format!("{}: {note}", device.at)));
    }
    for sdo in adopted.changed(&config.selection.startup) {
        device::download(wire, &device.at, coe, &sdo).await?;
    }
    device.adopted.push((index, adopted));
    Ok(())
}

/// Reads the units of an axis of a drive, counted from 0. If `constant`, also reads the motor's
/// torque constant.
pub async fn ask(
    wire: &impl MailboxTransport,
    coe: &mut CoeClient,
    axis: u16,
    constant: bool,
) -> Result<DriveUnits, SdoError> {
    let object = |index| ecaxis_esi::axis::object(index, axis);
    Ok(DriveUnits {
        encoder_resolution: ratio(wire, coe, object(0x608f)).await?,
        gear_ratio: ratio(wire, coe, object(0x6091)).await?,
        feed_constant: ratio(wire, coe, object(0x6092)).await?,
        position_unit: coe.upload_integer(wire, object(0x60a8), 0).await?,
        velocity_unit: coe.upload_integer(wire, object(0x60a9), 0).await?,
        acceleration_unit: coe.upload_integer(wire, object(0x60aa), 0).await?,
        rated_torque: coe.upload_integer(wire, object(0x6076), 0).await?,
        torque_constant: match constant {
            true => coe.upload_integer(wire, 0x3001, 5).await?,
            false => None,
        },
        polarity: coe
            .upload_integer(wire, object(0x607e), 0)
            .await?
            .map(|n| n.to_le_bytes()[0]),
    })
}

async fn ratio(
    wire: &impl MailboxTransport,
    coe: &mut CoeClient,
    index: u16,
) -> Result<Option<[u32; 2]>, SdoError> {
    let Some(above) = coe.upload_integer(wire, index, 1).await? else {
        return Ok(None);
    };
    let below = coe.upload_integer(wire, index, 2).await?;
    Ok(below.map(|below| [above, below]))
}
