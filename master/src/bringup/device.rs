//! The steps of one SubDevice from PreOp to SafeOp.

use ecaxis_ecat::registers;
use ecaxis_esi::layout::SmLayout;
use ecaxis_esi::{StartupSdo, address};

use super::{BusDevice, Step};
use crate::acyclic::{DeviceRef, Registers};
use crate::config::{DeviceConfig, StartupOptions};
use crate::mailbox::{CoeClient, MailboxTransport, NamedObject, SdoError, object_name};
use crate::report::{Cause, Error};
use crate::rt::image::DeviceRegion;

const FMMU_SIZE: u16 = 16;
/// An FMMU that maps nothing, as after a reset.
const OFF: [u8; FMMU_SIZE as usize] = [0; FMMU_SIZE as usize];
const STATUS: u16 = 5;
/// The activation bytes of a SyncManager and of an FMMU.
const SM_ACTIVATE: u16 = 6;
const FMMU_ACTIVATE: u16 = 12;

/// The state in which start-up SDOs are sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StartupPhase {
    /// Before SafeOp is requested. This includes those of Init → PreOp, which need the mailbox.
    InPreOp,
    /// Before Op is requested.
    InSafeOp,
}

/// Downloads the start-up SDOs of one phase in order. The mailbox is emptied first, because the
/// device may have sent emergencies before.
pub(super) async fn start_up(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    device: &mut BusDevice,
    moment: StartupPhase,
    progress: &mut dyn FnMut(Step),
) -> Result<(), Error> {
    let due = |transition: &str| (transition == "SO") == (moment == StartupPhase::InSafeOp);
    let list: Vec<_> = config
        .selection
        .startup
        .iter()
        .filter(|sdo| due(sdo.transition))
        .collect();
    if list.is_empty() && moment == StartupPhase::InSafeOp {
        return Ok(());
    }
    let Some(coe) = device.coe.as_mut() else {
        return Ok(());
    };
    coe.drain(wire).await.map_err(|source| {
        Cause::Sdo(source)
            .with_device(&device.at)
            .with_action("emptying the mailbox")
    })?;
    let mut held = 0;
    for (done, sdo) in list.iter().enumerate() {
        let way = config.startup.way(sdo.index, sdo.sub);
        match write_startup_sdo(wire, &device.at, coe, sdo, way).await? {
            SdoOutcome::Held => held += 1,
            SdoOutcome::Unreadable => progress(Step::Warning(format!(
                "{}: {} cannot be read, so it is not verified",
                device.at,
                object(sdo)
            ))),
            SdoOutcome::Written => {}
        }
        progress(Step::StartUp {
            device: config.name.clone(),
            done: done + 1,
            of: list.len(),
        });
    }
    if held > 0 {
        progress(Step::Held {
            device: config.name.clone(),
            held,
            of: list.len(),
        });
    }
    Ok(())
}

/// The result of one start-up SDO.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SdoOutcome {
    /// Written, and verified if requested.
    Written,
    /// The device already had the value.
    Held,
    /// Written, but not verified: the object cannot be read.
    Unreadable,
}

/// Writes one start-up SDO, unless the device already has the value and that suffices. Reads it
/// back if requested.
///
/// # Errors
/// Names the device and the object.
pub async fn write_startup_sdo(
    wire: &impl MailboxTransport,
    at: &DeviceRef,
    coe: &mut CoeClient,
    sdo: &StartupSdo,
    way: StartupOptions,
) -> Result<SdoOutcome, Error> {
    if way.skip_equal
        && let Some(now) = read_back(wire, at, coe, sdo).await?
        && holds(sdo, &now)
    {
        tracing::debug!(device = %at, "{} is held already", object(sdo));
        return Ok(SdoOutcome::Held);
    }
    download(wire, at, coe, sdo).await?;
    if !way.verify {
        return Ok(SdoOutcome::Written);
    }
    match read_back(wire, at, coe, sdo).await? {
        None => Ok(SdoOutcome::Unreadable),
        Some(now) if holds(sdo, &now) => Ok(SdoOutcome::Written),
        Some(now) => Err(Cause::NotHeld {
            object: object(sdo),
            value: format_value(&sdo.data),
            origin: sdo.origin.clone(),
            holds: format_value(&now),
        }
        .with_device(at)),
    }
}

/// Returns the device's value; `None` if the object cannot be read.
async fn read_back(
    wire: &impl MailboxTransport,
    at: &DeviceRef,
    coe: &mut CoeClient,
    sdo: &StartupSdo,
) -> Result<Option<Vec<u8>>, Error> {
    coe.upload_optional(wire, sdo.index, sdo.sub, sdo.complete_access)
        .await
        .map_err(|source| failed(at, sdo, source))
}

/// True if the device has the value. By complete access, a device may return more than was written.
fn holds(sdo: &StartupSdo, now: &[u8]) -> bool {
    if sdo.complete_access {
        now.starts_with(&sdo.data)
    } else {
        now == sdo.data
    }
}

/// Formats `0x6065:00 (Following error window)`, with the ESI's name if there is one.
fn object(sdo: &StartupSdo) -> String {
    let (index, sub) = (sdo.index, sdo.sub);
    if sdo.name.is_empty() {
        return NamedObject { index, sub }.to_string();
    }
    format!("{} ({})", address(index, sub), sdo.name)
}

fn failed(at: &DeviceRef, sdo: &StartupSdo, source: SdoError) -> Error {
    let known = || {
        object_name(sdo.index, sdo.sub)
            .unwrap_or_default()
            .to_owned()
    };
    Cause::StartUp {
        index: sdo.index,
        sub: sdo.sub,
        name: if sdo.name.is_empty() {
            known()
        } else {
            sdo.name.clone()
        },
        value: format_value(&sdo.data),
        origin: sdo.origin.clone(),
        source,
    }
    .with_device(at)
}

/// Downloads one start-up SDO.
pub(super) async fn download(
    wire: &impl MailboxTransport,
    at: &DeviceRef,
    coe: &mut CoeClient,
    sdo: &StartupSdo,
) -> Result<(), Error> {
    coe.download(wire, sdo.index, sdo.sub, sdo.complete_access, &sdo.data)
        .await
        .map_err(|source| failed(at, sdo, source))?;
    tracing::debug!(
        device = %at,
        "SDO {} {} = {} ({})",
        address(sdo.index, sdo.sub), sdo.name, format_value(&sdo.data), sdo.origin
    );
    Ok(())
}

/// Formats little-endian bytes as a number.
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

/// Configures the SyncManagers of the process data with one FMMU each, and the FMMU of the mailbox
/// status at `status`. Outputs and inputs start at the same logical address. What the ESI enables in
/// Op only stays disabled.
pub(super) async fn map_process_data(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    device: &mut BusDevice,
    region: Option<DeviceRegion>,
    status: Option<u32>,
) -> Result<(), Error> {
    const READ: u8 = 1;
    const WRITE: u8 = 2;

    let layout = &config.selection.layout;
    let mut fmmus = Vec::new();
    let mut op_only_fmmus = Vec::new();
    device.op_only.clear();
    for (sms, kind) in [(&layout.outputs, WRITE), (&layout.inputs, READ)] {
        let mut logical = region.map_or(0, |region| region.logical);
        for sm in sms {
            let register = registers::SYNC_MANAGER + registers::SYNC_MANAGER_LEN * u16::from(sm.sm);
            let step = "configuring SyncManagers";
            let op_only = config.device.op_only(sm);
            let mut manager = sync_manager(sm);
            if op_only.sync_manager && sm.len > 0 {
                manager[usize::from(SM_ACTIVATE)] = 0;
                device.op_only.push(register + SM_ACTIVATE);
            }
            write(wire, &device.at, step, register, &manager).await?;
            if sm.len > 0 {
                let mut mapped = fmmu(logical, sm.start_address, sm.len, kind);
                if op_only.fmmu {
                    mapped[usize::from(FMMU_ACTIVATE)] = 0;
                    op_only_fmmus.push(fmmus.len());
                }
                fmmus.push(mapped);
                logical = logical.saturating_add(u32::from(sm.len));
            }
        }
    }
    if let (Some(logical), Some((number, sm))) = (status, config.device.mailbox_status_fmmu()) {
        // The ESI's number, unless the process data already uses it.
        let number = usize::from(number).max(fmmus.len());
        fmmus.resize(number, OFF);
        let register =
            registers::SYNC_MANAGER + registers::SYNC_MANAGER_LEN * u16::from(sm) + STATUS;
        fmmus.push(fmmu(logical, register, 1, READ));
    }
    for (i, fmmu) in fmmus.iter().enumerate().filter(|(_, fmmu)| **fmmu != OFF) {
        let register =
            registers::FMMU + FMMU_SIZE * u16::try_from(i).unwrap_or(u16::MAX / FMMU_SIZE);
        write(wire, &device.at, "configuring FMMUs", register, fmmu).await?;
        if op_only_fmmus.contains(&i) {
            device.op_only.push(register + FMMU_ACTIVATE);
        }
    }
    Ok(())
}

/// Enables what is enabled in Op only, SyncManagers before FMMUs, or disables it in reverse order:
/// no output passes an FMMU to memory without a SyncManager.
pub(crate) async fn enable_op_only(
    wire: &impl MailboxTransport,
    device: &BusDevice,
    enable: bool,
) -> Result<(), Error> {
    let step = if enable {
        "enabling OpOnly SyncManagers"
    } else {
        "disabling OpOnly SyncManagers"
    };
    let write =
        async |register: u16| write(wire, &device.at, step, register, &[u8::from(enable)]).await;
    if enable {
        for register in &device.op_only {
            write(*register).await?;
        }
    } else {
        for register in device.op_only.iter().rev() {
            write(*register).await?;
        }
    }
    Ok(())
}

/// A SyncManager without data stays disabled: devices reject an active one of length 0.
fn sync_manager(sm: &SmLayout) -> [u8; registers::SYNC_MANAGER_LEN as usize] {
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

/// Writes a register; fails if the device does not answer.
pub(super) async fn write(
    wire: &impl MailboxTransport,
    device: &DeviceRef,
    step: &'static str,
    register: u16,
    data: &[u8],
) -> Result<(), Error> {
    let registers = Registers { wire, device, step };
    registers.write(register, data).await
}

/// Reads a register; fails if the device does not answer.
pub(super) async fn read<const N: usize>(
    wire: &impl MailboxTransport,
    device: &DeviceRef,
    step: &'static str,
    register: u16,
) -> Result<[u8; N], Error> {
    let registers = Registers { wire, device, step };
    registers.read(register).await
}
