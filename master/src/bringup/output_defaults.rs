//! Outputs in the process data that no axis drives.
//!
//! Zero is correct for offsets, digital outputs and the targets of other modes. It is wrong for
//! objects that limit a motion: a maximum torque or velocity of zero blocks the drive. Such objects
//! keep the drive's own value, read before its process data becomes valid.

use ecaxis_esi::address;
use ecaxis_esi::layout::Field;

use super::BusDevice;
use crate::config::{DeviceConfig, further_axis};
use crate::mailbox::MailboxTransport;
use crate::report::{Cause, Error};

/// Objects for which zero is a normal value, or the only safe one.
const ZERO_IS_SAFE: [u16; 11] = [
    0x6040, 0x6060, 0x6071, 0x607a, 0x60b0, 0x60b1, 0x60b2, 0x60b8, 0x60fe, 0x60ff, 0x0000,
];

/// True if the output limits a motion. Outputs of a drive's further axes do not: without a
/// Controlword, these axes do not move.
fn bounds(field: &Field, rx: &[Field]) -> bool {
    let Some((axis, same)) = further_axis(field) else {
        return !ZERO_IS_SAFE.contains(&field.index);
    };
    let has_controlword = rx.iter().any(|f| further_axis(f) == Some((axis, 0x6040)));
    !has_controlword && !ZERO_IS_SAFE.contains(&same)
}

/// Reads the values to keep into `device.held`.
pub(super) async fn read(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    device: &mut BusDevice,
) -> Result<(), Error> {
    if config.axis.is_none() {
        return Ok(());
    }
    let rx = &config.selection.layout.rx;
    for field in rx.iter().filter(|field| bounds(field, rx)) {
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
