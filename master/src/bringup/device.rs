//! The steps of one SubDevice from PreOp to SafeOp.

use ecaxis_ecat::mailbox::abort_code::is_no_such_object;
use ecaxis_ecat::mailbox::eoe::Service;
use ecaxis_ecat::registers;
use ecaxis_esi::{Dictionary, StartupSdo, address};

use super::process_data::{ControlBytes, ProcessDataPlan, SM_ACTIVATE};
use super::{BusDevice, Step, modules};
use crate::acyclic::{DeviceRef, Registers};
use crate::config::duration::show;
use crate::config::{DeviceConfig, StartupOptions};
use crate::mailbox::{
    CoeClient, EoeSetting, MailboxTransport, NamedObject, SdoError, abort_text, object_name,
};
use crate::report::{Cause, Error};
use crate::rt::image::DeviceRegion;

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
    progress: &dyn Fn(Step),
) -> Result<(), Error> {
    super::soe::start_up(wire, config, device, moment, progress).await?;
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
    let mut in_parts: Vec<(&StartupSdo, u32)> = Vec::new();
    let mut refused: Vec<(&StartupSdo, u32)> = Vec::new();
    for (done, sdo) in list.iter().enumerate() {
        let way = config.startup.way(sdo.index, sdo.sub);
        let dictionary = &config.selection.dictionary;
        let timeout = device.timeouts.safe_op_op;
        let end = modules::deadline(wire, timeout);
        let outcome = loop {
            match write_startup_sdo(wire, &device.at, coe, sdo, way, dictionary).await {
                Err(error)
                    if (!sdo.optional || sdo.clears_list())
                        && modules::rejects_for_now(config, &error) =>
                {
                    if wire.now() >= end {
                        return Err(modules::not_ready(error, timeout));
                    }
                    wire.delay(modules::RETRY).await;
                }
                outcome => break outcome,
            }
        };
        let outcome = match outcome {
            Err(error) if sdo.clears_list() && matches!(*error.cause, Cause::NotHeld { .. }) => {
                progress(Step::Warning(error.to_string()));
                continue;
            }
            Err(error) if sdo.optional => {
                let code = abort_code(&error).ok_or(error)?;
                if !(sdo.clears_list() && is_no_such_object(code)) {
                    refused.push((sdo, code));
                }
                continue;
            }
            outcome => outcome?,
        };
        match outcome {
            SdoOutcome::Held => held += 1,
            SdoOutcome::Unreadable => progress(Step::Warning(format!(
                "{}: {} cannot be read, so it is not verified",
                device.at,
                object(sdo)
            ))),
            SdoOutcome::BySubindex(code) => in_parts.push((sdo, code)),
            SdoOutcome::Written => {}
        }
        progress(Step::StartUp {
            device: config.name.clone(),
            done: done + 1,
            of: list.len(),
        });
    }
    if let Some((_, code)) = in_parts.first() {
        let objects = in_parts
            .iter()
            .map(|(sdo, _)| format!("0x{:04X}", sdo.index));
        progress(Step::Warning(format!(
            "{}: refuses complete access, {}; the subindices of {} were written one by one",
            device.at,
            abort_text(*code),
            objects.collect::<Vec<_>>().join(", ")
        )));
    }
    let (periods, others): (Vec<_>, Vec<_>) =
        refused.into_iter().partition(|(sdo, _)| is_period(sdo));
    for (sdo, code) in others {
        let effect = match sdo.clears_list() {
            true => format!(
                "it keeps the list of an earlier configuration ({})",
                sdo.origin
            ),
            false => format!("{} has no effect", sdo.origin),
        };
        progress(Step::Warning(format!(
            "{}: refuses {}, {}: {effect}",
            device.at,
            object(sdo),
            abort_text(code)
        )));
    }
    if let Some((_, code)) = periods.first().copied() {
        let wanted = list.iter().filter(|sdo| sdo.optional && is_period(sdo));
        let wanted: Vec<_> = wanted.copied().collect();
        if let Some(kept) = kept_period(wire, &device.at, coe, &wanted, code).await? {
            progress(Step::Warning(format!(
                "{}: refuses the interpolation time of this cycle (0x60C2), {}; it keeps {kept}",
                device.at,
                abort_text(code)
            )));
        }
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

/// Sets the IP parameters and the MAC filter of a device with EoE, if the machine file has them.
pub(super) async fn set_ethernet(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    device: &mut BusDevice,
) -> Result<(), Error> {
    let (Some(eoe), Some(coe)) = (&config.eoe, device.coe.as_mut()) else {
        return Ok(());
    };
    let filter = eoe.filter.as_ref();
    let requests = [
        (eoe.parameters.map(Service::SetIp), EoeSetting::IpParameters),
        (
            filter.cloned().map(Service::SetFilter),
            EoeSetting::MacFilter,
        ),
    ];
    for (request, setting) in requests {
        let Some(request) = request else { continue };
        let set = coe.set_ethernet(wire, request).await;
        set.map_err(|source| {
            let values = eoe.to_string();
            Cause::Eoe {
                setting,
                values,
                source,
            }
            .with_device(&device.at)
        })?;
    }
    Ok(())
}

/// True for the interpolation time of an axis.
fn is_period(sdo: &StartupSdo) -> bool {
    const INTERPOLATION_TIME: u16 = 0x60c2;
    ecaxis_esi::axis::of(sdo.index).is_some_and(|(_, same)| same == INTERPOLATION_TIME)
}

fn abort_code(error: &Error) -> Option<u32> {
    match &*error.cause {
        Cause::StartUp { source, .. } => source.abort_code(),
        _ => None,
    }
}

/// Returns the interpolation time that a device keeps after it has refused another one. `None` if it
/// is the wanted one, or if the device has no such object.
async fn kept_period(
    wire: &impl MailboxTransport,
    at: &DeviceRef,
    coe: &mut CoeClient,
    wanted: &[&StartupSdo],
    code: u32,
) -> Result<Option<String>, Error> {
    if is_no_such_object(code) {
        return Ok(None);
    }
    let mut same = true;
    let (mut value, mut exponent) = (None, Some(-3));
    for sdo in wanted {
        let found = read_back(wire, at, coe, sdo).await?;
        same &= found.as_ref().is_some_and(|now| holds(sdo, now));
        let byte = found.and_then(|now| now.first().copied());
        match sdo.sub {
            1 => value = byte,
            _ => exponent = byte.map(|byte| i8::from_le_bytes([byte])),
        }
    }
    let ns = value.zip(exponent).and_then(|(value, exponent)| {
        let power = u32::try_from(9 + i32::from(exponent)).ok()?;
        10_u64.checked_pow(power)?.checked_mul(u64::from(value))
    });
    let kept = ns.map_or_else(|| "its own".to_owned(), show);
    Ok((!same).then_some(kept))
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
    /// Written by its subindices, because the device has refused complete access with this code.
    BySubindex(u32),
}

/// Writes one start-up SDO, unless the device already has the value and that suffices. Reads it
/// back if requested. If the device refuses complete access, writes the subindices instead; the
/// dictionary is that of the device.
///
/// # Errors
/// Names the device and the object.
pub async fn write_startup_sdo(
    wire: &impl MailboxTransport,
    at: &DeviceRef,
    coe: &mut CoeClient,
    sdo: &StartupSdo,
    way: StartupOptions,
    dictionary: &Dictionary,
) -> Result<SdoOutcome, Error> {
    let refused = match write_one(wire, at, coe, sdo, way).await {
        Err(error) if sdo.complete_access => error,
        outcome => return outcome,
    };
    let code = abort_code(&refused).filter(|code| !is_no_such_object(*code));
    let (Some(code), Some(parts)) = (code, sdo.by_subindex(dictionary)) else {
        return Err(refused);
    };
    let mut outcome = SdoOutcome::BySubindex(code);
    for part in &parts {
        if write_one(wire, at, coe, part, way).await? == SdoOutcome::Unreadable {
            outcome = SdoOutcome::Unreadable;
        }
    }
    Ok(outcome)
}

/// As [`write_startup_sdo`], in one transfer.
async fn write_one(
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

/// Writes the SyncManagers and FMMUs of [`ProcessDataPlan`]. What the ESI enables in Op only stays
/// disabled.
///
/// # Errors
/// [`Cause::Fmmus`] if the controller has too few FMMUs.
pub(super) async fn map_process_data(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    device: &mut BusDevice,
    region: Option<DeviceRegion>,
    status: Option<u32>,
) -> Result<(), Error> {
    let plan = ProcessDataPlan::new(config, device.control_bytes, region, status);
    device.op_only.clear();
    for block in &plan.sync_managers {
        device.op_only.extend(block.op_only);
        let step = "configuring SyncManagers";
        write(wire, &device.at, step, block.register, &block.data).await?;
    }
    let step = "configuring FMMUs";
    if !plan.needs_fmmus() {
        return Ok(());
    }
    let [available] = read(wire, &device.at, step, registers::FMMU_COUNT).await?;
    let fmmus = plan.fmmus(usize::from(available));
    let fmmus = fmmus.map_err(|cause| cause.with_device(&device.at).with_action(step))?;
    for block in fmmus {
        write(wire, &device.at, step, block.register, &block.data).await?;
        device.op_only.extend(block.op_only);
    }
    Ok(())
}

/// Writes the ControlBytes of the ESI in PreOp. A controller takes them only while the SyncManager is
/// disabled (ETG.1000.4, table 58).
pub(super) async fn restore_control_bytes(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    device: &mut BusDevice,
) -> Result<(), Error> {
    const STEP: &str = "restoring the ControlBytes of the ESI";
    device.control_bytes = ControlBytes::Esi;
    let plan = ProcessDataPlan::new(config, device.control_bytes, None, None);
    for block in &plan.sync_managers {
        let activate = block.register + SM_ACTIVATE;
        write(wire, &device.at, STEP, activate, &[0]).await?;
        write(wire, &device.at, STEP, block.register, &block.data).await?;
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
