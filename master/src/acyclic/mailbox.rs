//! The mailboxes of one SubDevice, in the state in which it is found.

use ecaxis_ecat::registers;
use ecaxis_esi::model::SmUse;
use ecaxis_esi::sii::{MailboxAreas, Protocols, Sii};

use super::Registers;
use crate::acyclic::al::{self, AlState};
use crate::acyclic::{DeviceRef, StateError};
use crate::mailbox::{CoeClient, MailboxLayout, MailboxTransport};
use crate::report::{Cause, Error};

/// The control bytes of mailboxes: one buffer each. The MainDevice writes one, with an interrupt to
/// the device, and reads the other.
const MAILBOX_OUT: u8 = 0x26;
const MAILBOX_IN: u8 = 0x22;
const ENABLED: u8 = 1;

pub use crate::config::state_timeouts::PRE_OP_TIMEOUT;

/// A mailbox with CoE or SoE, and the state to which its device returns afterwards.
#[derive(Debug)]
pub struct MailboxSession {
    pub coe: CoeClient,
    pub device: DeviceRef,
    /// The device's state before the session.
    pub found: AlState,
}

/// Opens the mailbox of a device. Takes a device from Init to PreOp, with the settings in its
/// EEPROM.
///
/// # Errors
/// [`Cause::NoMailbox`], [`Cause::WrongState`] in Bootstrap, [`Cause::State`]
/// if the device refuses PreOp.
pub async fn open(
    wire: &impl MailboxTransport,
    device: &DeviceRef,
    sii: &Sii,
) -> Result<MailboxSession, Error> {
    let registers = Registers {
        wire,
        device,
        step: "opening the mailbox",
    };
    let status = al::read_status(wire, device.station).await;
    let status = status.map_err(|error| registers.error(Cause::Datagram(error)))?;
    let found = status.map_or(AlState::Unknown(0), |(status, _)| {
        AlState::from_status(status)
    });
    let coe = match found {
        AlState::PreOp | AlState::SafeOp | AlState::Op => {
            let layout = configured(&registers).await?;
            let has = |protocol| sii.protocols.has(protocol);
            match has(Protocols::SOE) && !has(Protocols::COE) {
                true => CoeClient::joining_soe(layout),
                false => CoeClient::joining(layout),
            }
        }
        AlState::Init => {
            let layout = configure(&registers, sii, sii.mailbox).await?;
            let devices = std::slice::from_ref(device);
            let there = al::change_state(wire, devices, AlState::PreOp, PRE_OP_TIMEOUT).await;
            if let Err(error) = there {
                // After a timeout the device may still change its state later.
                if !matches!(*error.cause, Cause::State(StateError::Refused { .. })) {
                    let _ = al::change_state(wire, devices, AlState::Init, al::BACK_TIMEOUT).await;
                }
                return Err(error);
            }
            CoeClient::new(layout)
        }
        state => return Err(Cause::WrongState { state }.with_device(device)),
    };
    Ok(MailboxSession {
        coe,
        device: device.clone(),
        found,
    })
}

impl MailboxSession {
    /// Returns the device to Init if it came from there.
    ///
    /// # Errors
    /// [`Cause::State`] if the device does not change its state.
    pub async fn close(self, wire: &impl MailboxTransport) -> Result<(), Error> {
        if self.found == AlState::Init {
            let devices = std::slice::from_ref(&self.device);
            al::change_state(wire, devices, AlState::Init, al::BACK_TIMEOUT).await?;
        }
        Ok(())
    }
}

/// Returns the mailbox layout from SyncManagers 0 and 1.
async fn configured<W: MailboxTransport>(
    registers: &Registers<'_, W>,
) -> Result<MailboxLayout, Error> {
    let out: [u8; 8] = registers.read(registers::SYNC_MANAGER).await?;
    let inp: [u8; 8] = registers.read(registers::SYNC_MANAGER + 8).await?;
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
        _ => Err(Cause::NoMailbox.with_device(registers.device)),
    }
}

/// Configures SyncManagers 0 and 1 for mailboxes in these areas. The device must be in Init.
///
/// # Errors
/// [`Cause::NoMailbox`] if an area is empty.
pub async fn configure<W: MailboxTransport>(
    registers: &Registers<'_, W>,
    sii: &Sii,
    areas: MailboxAreas,
) -> Result<MailboxLayout, Error> {
    let MailboxAreas {
        receive_offset,
        receive_size,
        send_offset,
        send_size,
    } = areas;
    if receive_size == 0 || send_size == 0 {
        return Err(Cause::NoMailbox.with_device(registers.device));
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
    for (register, (address, len, control)) in
        [registers::SYNC_MANAGER, registers::SYNC_MANAGER + 8]
            .into_iter()
            .zip(sms)
    {
        // The SyncManager is disabled while it changes.
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
