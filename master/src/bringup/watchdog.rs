//! The watchdogs of a SubDevice (ETG.1000.4, tables 52 to 56): a drive that receives no outputs
//! leaves Op by itself. The settings of a drive's watchdog are read back: without the watchdog,
//! nothing stops the drive if this host fails.

use super::{BusDevice, Step};
use crate::config::{Bus, DeviceConfig};
use crate::mailbox::{DatagramError, MailboxTransport};
use crate::report::{Cause, Error};
use ecaxis_ecat::registers;

/// ControlByte of a SyncManager, and its bit 6: writing its area triggers the watchdog.
const CONTROL: u16 = 4;
const TRIGGER: u8 = 0x40;

const STEP: &str = "setting the watchdogs";

/// Writes the watchdog times and reads them back.
///
/// # Errors
/// Fails if an axis' device does not keep its divider, its process data time or its trigger.
pub(super) async fn set(
    wire: &impl MailboxTransport,
    bus: &Bus,
    config: &DeviceConfig,
    device: &BusDevice,
    progress: &dyn Fn(Step),
) -> Result<(), Error> {
    let has_axis = config.selection.mode.is_some();
    let outputs = &config.selection.layout.outputs;
    let is_watched = outputs.iter().any(|sm| sm.control_byte & TRIGGER != 0);
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
        if has_axis && register != registers::WATCHDOG_TIME_PDI {
            return Err(differs);
        }
        // A controller without these registers has no watchdog, and one without a trigger never
        // starts.
        if found.is_some() && is_watched {
            progress(Step::Warning(differs.to_string()));
        }
    }
    if !has_axis {
        return Ok(());
    }
    for sm in outputs {
        let register =
            registers::SYNC_MANAGER + registers::SYNC_MANAGER_LEN * u16::from(sm.sm) + CONTROL;
        let found: Option<[u8; 1]> = read(wire, device, register).await?;
        if found.is_none_or(|[control]| control & TRIGGER == 0) {
            return Err(Cause::Watchdog {
                register,
                wanted: format!("0x{:02x}", sm.control_byte),
                found: found.map_or("nothing".to_owned(), |[control]| format!("0x{control:02x}")),
            }
            .with_device(&device.at)
            .with_action("the watchdog trigger of its outputs (bit 6 of the ControlByte)"));
        }
    }
    Ok(())
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
