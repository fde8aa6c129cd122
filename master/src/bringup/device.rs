//! The steps of one SubDevice on its way from PreOp to SafeOp.

use ecaxis_esi::StartupSdo;
use ecaxis_esi::layout::SmLayout;

use super::{BringUpError, BusDevice, DeviceRef, Step};
use crate::config::{Bus, DeviceConfig};
use crate::mailbox::{CoeClient, Wire};
use crate::rt::image::Region;

/// FMMU registers (ETG.1000.4, Table 56): 16 bytes each.
const FMMU: u16 = 0x0600;
const FMMU_SIZE: u16 = 16;
/// One that maps nothing, as all are after a reset.
const OFF: [u8; FMMU_SIZE as usize] = [0; FMMU_SIZE as usize];
/// SyncManager registers (ETG.1000.4, Table 58): 8 bytes each.
pub(super) const SYNC_MANAGER: u16 = 0x0800;
pub(super) const SYNC_MANAGER_SIZE: u16 = 8;
const STATUS: u16 = 5;
const WATCHDOG_DIVIDER: u16 = 0x0400;
const WATCHDOG_PROCESS_DATA: u16 = 0x0420;
/// (2498 + 2) × 40 ns: the process-data watchdog counts in 100 µs.
const DIVIDER_100_US: u16 = 2498;

/// When start-up SDOs are sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Moment {
    /// Before SafeOp is asked for: those of Init → PreOp too, which a mailbox can only take now.
    InPreOp,
    /// Before Op is asked for.
    InSafeOp,
}

/// Downloads the start-up SDOs of one moment in order. The mailbox is emptied before, because a device may have
/// sent emergencies while nobody listened.
pub(super) async fn start_up(
    wire: &impl Wire,
    config: &DeviceConfig,
    device: &mut BusDevice,
    moment: Moment,
    progress: &mut dyn FnMut(Step),
) -> Result<(), BringUpError> {
    let due = |transition: &str| (transition == "SO") == (moment == Moment::InSafeOp);
    let list: Vec<_> = config
        .selection
        .startup
        .iter()
        .filter(|sdo| due(sdo.transition))
        .collect();
    if list.is_empty() && moment == Moment::InSafeOp {
        return Ok(());
    }
    let Some(coe) = device.coe.as_mut() else {
        return Ok(());
    };
    coe.drain(wire)
        .await
        .map_err(|source| BringUpError::Mailbox {
            device: device.at.clone(),
            source,
        })?;
    for (done, sdo) in list.iter().enumerate() {
        download(wire, &device.at, coe, sdo).await?;
        progress(Step::StartUp {
            device: config.name.clone(),
            done: done + 1,
            of: list.len(),
        });
    }
    Ok(())
}

/// Downloads one start-up SDO.
pub(super) async fn download(
    wire: &impl Wire,
    at: &DeviceRef,
    coe: &mut CoeClient,
    sdo: &StartupSdo,
) -> Result<(), BringUpError> {
    coe.download(wire, sdo.index, sdo.sub, sdo.complete_access, &sdo.data)
        .await
        .map_err(|source| BringUpError::StartUp {
            device: at.clone(),
            index: sdo.index,
            sub: sdo.sub,
            name: sdo.name.clone(),
            value: format_value(&sdo.data),
            origin: sdo.origin.clone(),
            source,
        })?;
    tracing::debug!(
        device = %at,
        "SDO 0x{:04x}:{:02x} {} = {} ({})",
        sdo.index, sdo.sub, sdo.name, format_value(&sdo.data), sdo.origin
    );
    Ok(())
}

/// Little-endian bytes as a user writes the number.
fn format_value(data: &[u8]) -> String {
    if data.len() > 8 {
        return format!("{} bytes", data.len());
    }
    let value = data
        .iter()
        .rev()
        .fold(0_u64, |value, &byte| value << 8 | u64::from(byte));
    format!("0x{value:0width$x}", width = data.len() * 2)
}

/// Configures the SyncManagers of the process data, and one FMMU for each; and the one of the mailbox's status, to be read at
/// `status`. Outputs and inputs start at the same logical address.
pub(super) async fn map_process_data(
    wire: &impl Wire,
    config: &DeviceConfig,
    device: &BusDevice,
    region: Option<Region>,
    status: Option<u32>,
) -> Result<(), BringUpError> {
    const READ: u8 = 1;
    const WRITE: u8 = 2;

    let layout = &config.selection.layout;
    let mut fmmus = Vec::new();
    for (sms, kind) in [(&layout.outputs, WRITE), (&layout.inputs, READ)] {
        let mut logical = region.map_or(0, |region| region.logical);
        for sm in sms {
            let register = SYNC_MANAGER + SYNC_MANAGER_SIZE * u16::from(sm.sm);
            write(
                wire,
                device,
                "configuring SyncManagers",
                register,
                &sync_manager(sm),
            )
            .await?;
            if sm.len > 0 {
                fmmus.push(fmmu(logical, sm.start_address, sm.len, kind));
                logical = logical.saturating_add(u32::from(sm.len));
            }
        }
    }
    if let (Some(logical), Some((number, sm))) = (status, config.device.mailbox_status_fmmu()) {
        // The ESI's number, unless the process data has taken that.
        let number = usize::from(number).max(fmmus.len());
        fmmus.resize(number, OFF);
        let register = SYNC_MANAGER + SYNC_MANAGER_SIZE * u16::from(sm) + STATUS;
        fmmus.push(fmmu(logical, register, 1, READ));
    }
    for (i, fmmu) in fmmus.iter().enumerate().filter(|(_, fmmu)| **fmmu != OFF) {
        let register = FMMU + FMMU_SIZE * u16::try_from(i).unwrap_or(u16::MAX / FMMU_SIZE);
        write(wire, device, "configuring FMMUs", register, fmmu).await?;
    }
    Ok(())
}

/// A SyncManager without data stays off: a device refuses an active one of length 0.
fn sync_manager(sm: &SmLayout) -> [u8; SYNC_MANAGER_SIZE as usize] {
    let [p0, p1] = sm.start_address.to_le_bytes();
    let [n0, n1] = sm.len.to_le_bytes();
    [p0, p1, n0, n1, sm.control_byte, 0, u8::from(sm.len > 0), 0]
}

fn fmmu(logical: u32, physical: u16, len: u16, kind: u8) -> [u8; FMMU_SIZE as usize] {
    let [l0, l1, l2, l3] = logical.to_le_bytes();
    let [n0, n1] = len.to_le_bytes();
    let [p0, p1] = physical.to_le_bytes();
    // Start bit 0 to stop bit 7; physical start bit 0; enabled.
    [l0, l1, l2, l3, n0, n1, 0, 7, p0, p1, 0, kind, 1, 0, 0, 0]
}

/// A device without its outputs for longer than this leaves Op by itself.
pub(super) async fn set_watchdog(
    wire: &impl Wire,
    bus: &Bus,
    device: &BusDevice,
) -> Result<(), BringUpError> {
    const STEP: &str = "setting the process-data watchdog";
    let ticks = u16::try_from(bus.watchdog_ns / 100_000)
        .unwrap_or(u16::MAX)
        .max(1);
    // A controller without these registers watches nothing; that is not an error.
    for (register, value) in [
        (WATCHDOG_DIVIDER, DIVIDER_100_US),
        (WATCHDOG_PROCESS_DATA, ticks),
    ] {
        wire.write(device.at.station, register, &value.to_le_bytes())
            .await
            .map_err(|source| BringUpError::Wire {
                device: device.at.clone(),
                step: STEP,
                source,
            })?;
    }
    Ok(())
}

/// A register write that the device must take.
pub(super) async fn write(
    wire: &impl Wire,
    device: &BusDevice,
    step: &'static str,
    register: u16,
    data: &[u8],
) -> Result<(), BringUpError> {
    taken(
        wire.write(device.at.station, register, data).await,
        device,
        step,
        register,
    )
}

/// A register read that the device must answer.
pub(super) async fn read(
    wire: &impl Wire,
    device: &BusDevice,
    step: &'static str,
    register: u16,
    data: &mut [u8],
) -> Result<(), BringUpError> {
    taken(
        wire.read(device.at.station, register, data).await,
        device,
        step,
        register,
    )
}

fn taken(
    result: Result<u16, crate::mailbox::WireError>,
    device: &BusDevice,
    step: &'static str,
    register: u16,
) -> Result<(), BringUpError> {
    match result {
        Ok(1) => Ok(()),
        Ok(_) => Err(BringUpError::NotTaken {
            device: device.at.clone(),
            step,
            register,
        }),
        Err(source) => Err(BringUpError::Wire {
            device: device.at.clone(),
            step,
            source,
        }),
    }
}
