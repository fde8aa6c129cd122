//! Builds devices from an EEPROM image alone, like a MainDevice without the ESI sees them.
//!
//! The image is converted to the ESI model, so both sources share one way to build a device.

use ecaxis_esi::model::{Access, Device, Object, ObjectItem};
use ecaxis_esi::sii;

use super::{DeviceOptions, SimDevice, SimError};

impl SimDevice {
    /// Creates the device that the EEPROM image describes, powered on and in Init. Serial number
    /// and alias come from the image. The chip is `options.esc`, or the smallest chip that fits the
    /// device.
    ///
    /// A device with a CoE mailbox has the objects 0x1000, 0x1008, 0x1018, 0x1C00, PDO assignment
    /// and mapping. Other mailboxes report an unknown protocol. A device without a mailbox is a
    /// plain I/O terminal.
    ///
    /// # Errors
    ///
    /// Fails if a category or a PDO is longer than its image or category, or a SyncManager lies
    /// outside the address space.
    pub fn from_sii(image: &[u8], options: DeviceOptions) -> Result<Self, SimError> {
        let sii = sii::parse(image)?;
        if let Some(damage) = sii.damage.first() {
            return Err(SimError::DamagedImage(damage.clone()));
        }
        let options = DeviceOptions {
            serial: sii.serial,
            alias: sii.alias,
            sii: Some(image.to_vec()),
            ..options
        };
        let mut device = sii.to_device();
        name_object(&mut device);
        Self::from_esi(&device, &[], options)
    }
}

/// Adds the device name to the dictionary of a device with CoE. Identity, SyncManagers and PDOs are
/// added for every device.
fn name_object(device: &mut Device) {
    let mailbox = device.mailbox.as_ref();
    if mailbox.is_none_or(|mailbox| mailbox.coe.is_none()) {
        return;
    }
    let name = device.type_name.clone().into_bytes();
    device.dictionary.objects.push(Object {
        index: 0x1008,
        name: "Device name".into(),
        items: vec![ObjectItem {
            sub: 0,
            name: "SubIndex 000".into(),
            type_name: format!("STRING({})", name.len()).as_str().into(),
            bit_len: u32::try_from(name.len() * 8).unwrap_or(0),
            default: name.into(),
            has_default: true,
            access: Access::default(),
            ..ObjectItem::default()
        }],
        ..Object::default()
    });
}

#[cfg(test)]
#[path = "from_sii_tests.rs"]
mod tests;
