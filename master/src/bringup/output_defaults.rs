//! Outputs in the process data that no axis drives.
//!
//! Zero is correct for offsets, digital outputs and the targets of other modes. It is wrong for
//! objects that limit a motion: a maximum torque or velocity of zero blocks the drive. Such objects
//! keep the drive's own value, read before its process data becomes valid.

use ecaxis_esi::layout::Field;
use ecaxis_esi::{Selection, address, axis};

use super::BusDevice;
use crate::config::{DeviceConfig, unused_axis};
use crate::mailbox::MailboxTransport;
use crate::report::{Cause, Error};

/// Objects for which zero is a normal value, or the only safe one.
const ZERO_IS_SAFE: [u16; 11] = [
    0x6040, 0x6060, 0x6071, 0x607a, 0x60b0, 0x60b1, 0x60b2, 0x60b8, 0x60fe, 0x60ff, 0x0000,
];

/// True if the output limits a motion. Outputs of axes that are not used do not: without a
/// Controlword, these axes do not move.
fn bounds(field: &Field, selection: &Selection) -> bool {
    let (axis, same) = axis::of(field.index).unwrap_or((0, field.index));
    if ZERO_IS_SAFE.contains(&same) {
        return false;
    }
    let controlword = Some((axis, 0x6040));
    let mut rx = selection.layout.rx.iter();
    !rx.any(|field| unused_axis(field, selection) == controlword)
}

/// Reads the values to keep into `device.held`.
pub(super) async fn read(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    device: &mut BusDevice,
) -> Result<(), Error> {
    let selection = &config.selection;
    if selection.mode.is_none() {
        return Ok(());
    }
    let rx = selection.layout.rx.iter();
    for field in rx.filter(|field| bounds(field, selection)) {
        let Some(coe) = device.coe.as_mut() else {
            return Ok(());
        };
        let (index, sub) = (field.index, field.sub);
        let data = coe.upload_optional(wire, index, sub, false).await;
        let data = data.map_err(|source| {
            Cause::Sdo(source)
                .with_device(&device.at)
                .with_action("reading the values of its outputs")
        })?;
        // If an object cannot be read over CoE, the ESI's value is used.
        let data = data.unwrap_or_else(|| {
            let item = config.selection.dictionary.item(index, sub);
            item.map(|item| item.default.to_vec()).unwrap_or_default()
        });
        let value = data
            .iter()
            .take(8)
            .rev()
            .fold(0_i64, |value, byte| value << 8 | i64::from(*byte));
        tracing::debug!(device = %device.at, "{} is held at {value}", address(field.index, field.sub));
        device.held.push((field.index, field.sub, value));
    }
    Ok(())
}
