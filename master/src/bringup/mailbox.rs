//! The positions of a device's mailboxes, as ethercrab has configured them from the EEPROM,
//! compared with the ESI. A mailbox whose length differs from its SyncManager's never becomes full.

use ecaxis_esi::model::SmUse;

use super::{BringUpError, DeviceRef};
use crate::config::DeviceConfig;
use crate::mailbox::{MailboxLayout, MailboxTransport};

/// Returns `None` if the ESI declares no CoE mailbox.
pub(super) async fn open(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    device: &DeviceRef,
) -> Result<Option<MailboxLayout>, BringUpError> {
    let coe = config.device.mailbox.as_ref().and_then(|m| m.coe.as_ref());
    let (true, Some((out_sm, out)), Some((in_sm, inp))) = (
        coe.is_some(),
        find(config, SmUse::MBoxOut),
        find(config, SmUse::MBoxIn),
    ) else {
        return Ok(None);
    };
    for (sm, expected) in [(out_sm, out), (in_sm, inp)] {
        let actual = read(wire, device, sm).await?;
        if actual != expected {
            let show = |(address, len): (u16, u16)| format!("0x{address:04x}, {len} bytes");
            return Err(BringUpError::MailboxMoved {
                device: device.clone(),
                expected: show(expected),
                actual: show(actual),
            });
        }
    }
    Ok(Some(MailboxLayout {
        station: device.station,
        out_address: out.0,
        out_len: out.1,
        in_address: inp.0,
        in_len: inp.1,
        out_sm,
        in_sm,
    }))
}

/// Returns number, address and length of the first SyncManager with this use.
fn find(config: &DeviceConfig, usage: SmUse) -> Option<(u8, (u16, u16))> {
    let sms = &config.device.sync_managers;
    let (number, sm) = sms.iter().enumerate().find(|(_, sm)| sm.usage == usage)?;
    Some((
        u8::try_from(number).ok()?,
        (sm.start_address, sm.default_size),
    ))
}

async fn read(
    wire: &impl MailboxTransport,
    device: &DeviceRef,
    sm: u8,
) -> Result<(u16, u16), BringUpError> {
    const STEP: &str = "reading the mailbox SyncManagers";
    let register = ecaxis_ecat::registers::SYNC_MANAGER
        + ecaxis_ecat::registers::SYNC_MANAGER_LEN * u16::from(sm);
    let mut bytes = [0; 4];
    match wire.read(device.station, register, &mut bytes).await {
        Ok(1) => {
            let [a0, a1, l0, l1] = bytes;
            Ok((u16::from_le_bytes([a0, a1]), u16::from_le_bytes([l0, l1])))
        }
        Ok(_) => Err(BringUpError::NotTaken {
            device: device.clone(),
            step: STEP,
            register,
        }),
        Err(source) => Err(BringUpError::Wire {
            device: device.clone(),
            step: STEP,
            source,
        }),
    }
}
