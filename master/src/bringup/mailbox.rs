//! The positions of a device's mailboxes, as ethercrab has configured them from the EEPROM,
//! compared with the ESI. A mailbox whose length differs from its SyncManager's never becomes full.

use ecaxis_ecat::registers;
use ecaxis_esi::model::SmUse;

use super::device::read;
use crate::acyclic::DeviceRef;
use crate::config::DeviceConfig;
use crate::mailbox::{MailboxLayout, MailboxTransport};
use crate::report::{Cause, Error};

/// Returns `None` if the ESI declares no CoE mailbox.
pub(super) async fn open(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    device: &DeviceRef,
) -> Result<Option<MailboxLayout>, Error> {
    let coe = config.device.mailbox.as_ref().and_then(|m| m.coe.as_ref());
    let (true, Some((out_sm, out)), Some((in_sm, inp))) = (
        coe.is_some(),
        find(config, SmUse::MBoxOut),
        find(config, SmUse::MBoxIn),
    ) else {
        return Ok(None);
    };
    for (sm, expected) in [(out_sm, out), (in_sm, inp)] {
        let register = registers::SYNC_MANAGER + registers::SYNC_MANAGER_LEN * u16::from(sm);
        let step = "reading the mailbox SyncManagers";
        let [a0, a1, l0, l1] = read(wire, device, step, register).await?;
        let actual = (u16::from_le_bytes([a0, a1]), u16::from_le_bytes([l0, l1]));
        if actual != expected {
            let show = |(address, len): (u16, u16)| format!("0x{address:04x}, {len} bytes");
            return Err(Cause::MailboxMoved {
                expected: show(expected),
                actual: show(actual),
            }
            .with_device(device));
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
