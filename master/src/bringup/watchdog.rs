//! The watchdogs of a SubDevice (ETG.1000.4, tables 52 to 56): a drive that receives no outputs
//! leaves Op by itself. The settings of a drive's watchdog are read back: without the watchdog,
//! nothing stops the drive if this host fails.

use super::device::restore_control_bytes;
use super::process_data::ControlBytes;
use super::{BusDevice, Step};
use crate::acyclic::{AlState, al};
use crate::config::{Bus, DeviceConfig, WatchdogTrigger};
use crate::mailbox::{DatagramError, MailboxTransport};
use crate::report::{Cause, Error};
use ecaxis_ecat::{al_status_code, registers};
use ecaxis_esi::layout::SmLayout;

/// The ControlByte of a SyncManager.
const CONTROL: u16 = 4;

const STEP: &str = "setting the watchdogs";

/// Writes the watchdog times and reads them back.
///
/// # Errors
/// Fails if an axis' device does not keep its divider or its process data time, or a device the
/// trigger that it must have.
pub(super) async fn set(
    wire: &impl MailboxTransport,
    bus: &Bus,
    config: &DeviceConfig,
    device: &mut BusDevice,
    progress: &dyn Fn(Step),
) -> Result<(), Error> {
    let has_axis = config.selection.mode.is_some();
    let required = has_axis || config.watchdog_trigger == WatchdogTrigger::Required;
    let outputs = &config.selection.layout.outputs;
    let is_watched = outputs.iter().any(SmLayout::has_trigger);
    for (register, what, value) in watchdog_registers(bus) {
        let wanted = value.to_le_bytes();
        let at = device.at.station;
        let written = wire.write(at, register, &wanted).await;
        written.map_err(|source| lost(device, source))?;
        let found: Option<[u8; 2]> = read(wire, device, register).await?;
        let differs = Cause::Watchdog {
            register,
            wanted: format!("0x{value:04x}"),
            found: found.map_or("nothing".to_owned(), |found| {
                format!("0x{:04x}", u16::from_le_bytes(found))
            }),
        }
        .with_device(&device.at)
        .with_action(what);
        if found == Some(wanted) {
            continue;
        }
        // The PDI watchdog reports a hung processor but stops nothing.
        if required && register != registers::WATCHDOG_TIME_PDI {
            return Err(differs);
        }
        // A controller without these registers has no watchdog, and one without a trigger never
        // starts.
        if found.is_some() && is_watched {
            progress(Step::Warning(differs.to_string()));
        }
    }
    if device.control_bytes == ControlBytes::Esi {
        return Ok(());
    }
    for sm in outputs.iter().filter(|sm| sm.watched) {
        let register =
            registers::SYNC_MANAGER + registers::SYNC_MANAGER_LEN * u16::from(sm.sm) + CONTROL;
        let found: Option<[u8; 1]> = read(wire, device, register).await?;
        let kept = found.is_some_and(|[control]| control & SmLayout::WATCHDOG_TRIGGER != 0);
        if kept {
            continue;
        }
        let found = found.map_or("nothing".to_owned(), |[control]| format!("0x{control:02x}"));
        if may_be_its_own(config, device) {
            let why = format!("register 0x{register:04x} holds {found}");
            restore_control_bytes(wire, config, device).await?;
            warn_of_own_watchdog(device, &why, progress);
            return Ok(());
        }
        return Err(Cause::Watchdog {
            register,
            wanted: format!("0x{:02x}", sm.control()),
            found,
        }
        .with_device(&device.at)
        .with_action("the watchdog trigger of its outputs (bit 6 of the ControlByte)"));
    }
    Ok(())
}

/// Requests SafeOp. A device that may need SYNC0 before it is asked again after `pulses`. One that
/// refuses its outputs although only the watchdog trigger differs from its ESI is asked again with
/// the ESI's ControlBytes: some firmware compares them (SOES, `ESC_SM2_smc`).
///
/// # Errors
/// The device refuses SafeOp.
pub(super) async fn to_safe_op(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    device: &mut BusDevice,
    pulses: impl AsyncFn(),
    progress: &dyn Fn(Step),
) -> Result<(), Error> {
    let mut may_wait = config.selection.dc.is_some();
    let mut restored = false;
    loop {
        let transition = [device.transition(AlState::SafeOp, false)];
        let changed = al::change_states(wire, &transition, AlState::SafeOp).await;
        let Err(error) = changed else {
            if restored {
                warn_of_own_watchdog(device, "it refuses SafeOp (0x001d)", progress);
            }
            return Ok(());
        };
        if al::awaits_sync(&error) && std::mem::take(&mut may_wait) {
            tracing::debug!("{error}; requested again once SYNC0 runs");
            pulses().await;
        } else if refuses_outputs(&error) && may_be_its_own(config, device) {
            restore_control_bytes(wire, config, device).await?;
            restored = true;
        } else {
            return Err(error);
        }
    }
}

fn refuses_outputs(error: &Error) -> bool {
    let code = al_status_code::INVALID_OUTPUT_CONFIGURATION;
    matches!(&*error.cause, Cause::State(error) if error.code() == code)
}

/// True if the device has another ControlByte than in its ESI, and may have that of its ESI.
fn may_be_its_own(config: &DeviceConfig, device: &BusDevice) -> bool {
    let mut outputs = config.selection.layout.outputs.iter();
    config.watchdog_trigger == WatchdogTrigger::Preferred
        && device.control_bytes == ControlBytes::Watched
        && outputs.any(|sm| sm.control() != sm.control_byte)
}

/// Warns of a device that has the ControlBytes of its ESI.
fn warn_of_own_watchdog(device: &BusDevice, why: &str, progress: &dyn Fn(Step)) {
    progress(Step::Warning(format!(
        "{}: its outputs have the ControlByte of its ESI, without the watchdog trigger (bit 6), because {why} with it. \
         If the outputs fail, only a watchdog of the device's own stops it: pull its cable to test that, \
         then write `watchdog_trigger = \"esi\"`",
        device.at
    )));
}

/// Returns the watchdog registers of every SubDevice, each with its name and value.
#[must_use]
pub fn watchdog_registers(bus: &Bus) -> [(u16, &'static str, u16); 3] {
    [
        (
            registers::WATCHDOG_DIVIDER,
            "the watchdogs' divider",
            Bus::WATCHDOG_DIVIDER,
        ),
        (
            registers::WATCHDOG_TIME_PDI,
            "the PDI watchdog's time",
            Bus::PDI_WATCHDOG,
        ),
        (
            registers::WATCHDOG_TIME_PROCESS_DATA,
            "the process data watchdog's time",
            bus.process_data_watchdog(),
        ),
    ]
}

/// Returns `None` if the device has no such register.
async fn read<const N: usize>(
    wire: &impl MailboxTransport,
    device: &BusDevice,
    register: u16,
) -> Result<Option<[u8; N]>, Error> {
    let mut data = [0; N];
    let answered = wire.read(device.at.station, register, &mut data).await;
    let answered = answered.map_err(|source| lost(device, source))?;
    Ok((answered == 1).then_some(data))
}

fn lost(device: &BusDevice, source: DatagramError) -> Error {
    Cause::Datagram(source)
        .with_device(&device.at)
        .with_action(STEP)
}
