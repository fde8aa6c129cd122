//! The mailboxes of one SubDevice, in whatever state it is found.

use std::time::Duration;

use ecaxis_esi::model::SmUse;
use ecaxis_esi::sii::{MailboxAreas, Sii};

use super::{Registers, ServiceError};
use crate::bringup::al::{self, AlState};
use crate::bringup::{DeviceRef, StateError};
use crate::mailbox::{CoeClient, MailboxLayout, Wire};

/// SyncManager registers (ETG.1000.4, Table 58): 8 bytes each.
const SYNC_MANAGER: u16 = 0x0800;
/// Control bytes of mailboxes: one buffer, written by the MainDevice with an interrupt to the device, and read by it.
const MAILBOX_OUT: u8 = 0x26;
const MAILBOX_IN: u8 = 0x22;
const ENABLED: u8 = 1;

/// ETG.1020 default for Init → PreOp and Init → Bootstrap.
pub const PRE_OP_TIMEOUT: Duration = Duration::from_secs(3);

/// A CoE mailbox, and the state to which its device goes back afterwards.
#[derive(Debug)]
pub struct Lent {
    pub coe: CoeClient,
    pub device: DeviceRef,
    /// As it was found.
    pub found: AlState,
}

/// The mailbox of a device. One in Init is brought to PreOp for it, by what its EEPROM says.
///
/// # Errors
/// [`ServiceError::NoMailbox`], [`ServiceError::WrongState`] in Bootstrap, [`ServiceError::State`] where it refuses PreOp.
pub async fn lend(wire: &impl Wire, device: &DeviceRef, sii: &Sii) -> Result<Lent, ServiceError> {
    let registers = Registers {
        wire,
        device,
        step: "opening the mailbox",
    };
    let status = al::read_status(wire, device.station).await;
    let status = status.map_err(|source| ServiceError::Wire {
        device: device.clone(),
        step: registers.step,
        source,
    })?;
    let found = status.map_or(AlState::Unknown(0), |(status, _)| {
        AlState::from_status(status)
    });
    let coe = match found {
        AlState::PreOp | AlState::SafeOp | AlState::Op => {
            CoeClient::joining(configured(&registers).await?)
        }
        AlState::Init => {
            let layout = configure(&registers, sii, sii.mailbox).await?;
            let devices = std::slice::from_ref(device);
            let there = al::change_state(wire, devices, AlState::PreOp, PRE_OP_TIMEOUT).await;
            if let Err(error) = there {
                // It may be on its way all the same.
                if !matches!(error, StateError::Refused { .. }) {
                    let _ = al::change_state(wire, devices, AlState::Init, al::BACK_TIMEOUT).await;
                }
                return Err(error.into());
            }
            CoeClient::new(layout)
        }
        state => {
            return Err(ServiceError::WrongState {
                device: device.clone(),
                state: state.to_string(),
            });
        }
    };
    Ok(Lent {
        coe,
        device: device.clone(),
        found,
    })
}

impl Lent {
    /// Back to Init where it came from there.
    ///
    /// # Errors
    /// [`ServiceError::State`] where it does not go.
    pub async fn give_back(self, wire: &impl Wire) -> Result<(), ServiceError> {
        if self.found == AlState::Init {
            let devices = std::slice::from_ref(&self.device);
            al::change_state(wire, devices, AlState::Init, al::BACK_TIMEOUT).await?;
        }
        Ok(())
    }
}

/// As SyncManagers 0 and 1 are set up.
async fn configured<W: Wire>(registers: &Registers<'_, W>) -> Result<MailboxLayout, ServiceError> {
    let out: [u8; 8] = registers.read(SYNC_MANAGER).await?;
    let inp: [u8; 8] = registers.read(SYNC_MANAGER + 8).await?;
    let area = |sm: [u8; 8]| {
        let [a0, a1, n0, n1, _, _, activate, _] = sm;
        let on = activate & ENABLED != 0;
        on.then(|| (u16::from_le_bytes([a0, a1]), u16::from_le_bytes([n0, n1])))
    };
    match (area(out), area(inp)) {
        (Some((out_address, out_len)), Some((in_address, in_len))) => Ok(MailboxLayout {
            station: registers.device.station,
            out_address,
            out_len,
            in_address,
            in_len,
            out_sm: 0,
            in_sm: 1,
        }),
        _ => Err(ServiceError::NoMailbox {
            device: registers.device.clone(),
        }),
    }
}

/// Sets SyncManagers 0 and 1 up for mailboxes in these areas; the device is in Init.
///
/// # Errors
/// [`ServiceError::NoMailbox`] where an area is empty.
pub async fn configure<W: Wire>(
    registers: &Registers<'_, W>,
    sii: &Sii,
    areas: MailboxAreas,
) -> Result<MailboxLayout, ServiceError> {
    let MailboxAreas {
        receive_offset,
        receive_size,
        send_offset,
        send_size,
    } = areas;
    if receive_size == 0 || send_size == 0 {
        return Err(ServiceError::NoMailbox {
            device: registers.device.clone(),
        });
    }
    let control = |usage: SmUse, usual: u8| {
        let sm = sii.sync_managers.iter().find(|sm| sm.usage == usage);
        sm.map_or(usual, |sm| sm.control)
    };
    let sms = [
        (
            receive_offset,
            receive_size,
            control(SmUse::MBoxOut, MAILBOX_OUT),
        ),
        (send_offset, send_size, control(SmUse::MBoxIn, MAILBOX_IN)),
    ];
    for (register, (address, len, control)) in [SYNC_MANAGER, SYNC_MANAGER + 8].into_iter().zip(sms)
    {
        // Off while it changes.
        registers.write(register + 6, &[0]).await?;
        let [a0, a1] = address.to_le_bytes();
        let [n0, n1] = len.to_le_bytes();
        let sm = [a0, a1, n0, n1, control, 0, ENABLED, 0];
        registers.write(register, &sm).await?;
    }
    Ok(MailboxLayout {
        station: registers.device.station,
        out_address: receive_offset,
        out_len: receive_size,
        in_address: send_offset,
        in_len: send_size,
        out_sm: 0,
        in_sm: 1,
    })
}
