//! The positions of a device's mailboxes, as ethercrab has configured them from the EEPROM,
//! compared with the ESI. A mailbox whose length differs from its SyncManager's never becomes full.

use std::future::{Future, poll_fn};
use std::pin::pin;
use std::task::Poll;
use std::time::Duration;

use ecaxis_ecat::registers;
use ecaxis_esi::model::SmUse;

use super::device::read;
use super::name_at;
use crate::acyclic::enumerate::FIRST_STATION;
use crate::acyclic::{AlState, DeviceRef, al};
use crate::config::{DeviceConfig, Machine};
use crate::datagram::DatagramClient;
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

/// Runs ethercrab's `scan` and enables mailbox SyncManagers meanwhile if an ESI does not
/// (`Enable="0"`). ethercrab enables a SyncManager only if the EEPROM does, but no device with a
/// mailbox reaches PreOp without it (ETG.1000.6, 6.4).
pub(super) async fn enable_during<T>(
    wire: &DatagramClient,
    machine: &Machine,
    scan: impl Future<Output = T>,
) -> T {
    let disabled = disabled(machine);
    if disabled.is_empty() {
        return scan.await;
    }
    let mut scan = pin!(scan);
    let mut enabling = pin!(enable(wire, machine, &disabled));
    poll_fn(|context| {
        if let Poll::Ready(done) = scan.as_mut().poll(context) {
            return Poll::Ready(done);
        }
        // It never ends.
        let _ = enabling.as_mut().poll(context);
        Poll::Pending
    })
    .await
}

/// A mailbox SyncManager: its number and its start address.
type MailboxSm = (u8, u16);

/// Returns the mailbox SyncManagers that ESI files do not enable.
fn disabled(machine: &Machine) -> Vec<MailboxSm> {
    let mut all = Vec::new();
    for config in &machine.devices {
        if config.device.mailbox.is_none() {
            continue;
        }
        for (number, sm) in (0..=u8::MAX).zip(&config.device.sync_managers) {
            let mailbox = matches!(sm.usage, SmUse::MBoxOut | SmUse::MBoxIn);
            if mailbox && !sm.enable && !all.contains(&(number, sm.start_address)) {
                all.push((number, sm.start_address));
            }
        }
    }
    all
}

/// Enables these SyncManagers wherever they are configured and disabled. A device that has refused
/// PreOp meanwhile is asked again.
async fn enable(wire: &DatagramClient, machine: &Machine, disabled: &[MailboxSm]) {
    const PERIOD: Duration = Duration::from_millis(1);
    /// Invalid mailbox configuration in PreOp.
    const INVALID_MAILBOX: u16 = 0x0016;
    let count = u16::try_from(machine.devices.len()).unwrap_or(u16::MAX);
    loop {
        for position in 0..count {
            let station = FIRST_STATION.saturating_add(position);
            let mut enabled = false;
            for &(number, start) in disabled {
                let register =
                    registers::SYNC_MANAGER + registers::SYNC_MANAGER_LEN * u16::from(number);
                let mut sm = [0; registers::SYNC_MANAGER_LEN as usize];
                let read = wire.read(station, register, &mut sm).await;
                let [a0, a1, n0, n1, _, _, activate, _] = sm;
                let configured = u16::from_le_bytes([a0, a1]) == start && (n0, n1) != (0, 0);
                if read == Ok(1) && configured {
                    if activate & 1 == 0 {
                        let _ = wire.write(station, register + 6, &[1]).await;
                    }
                    enabled = true;
                }
            }
            let status = al::read_status(wire, station).await;
            if enabled
                && let Ok(Some((status, INVALID_MAILBOX))) = status
                && AlState::from_status(status) == AlState::Init
            {
                let device = DeviceRef {
                    name: name_at(machine, position),
                    position,
                    station,
                };
                tracing::debug!(%device, "its mailbox is enabled, requesting PreOp again");
                let _ = al::request(wire, &device, AlState::PreOp).await;
            }
        }
        wire.delay(PERIOD).await;
    }
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
