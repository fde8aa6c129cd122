//! The modules of a modular device: those that it detects (0xF050) against those of the file, and
//! couplers that are not ready yet.

use std::time::Duration;

use ecaxis_ecat::al_status_code;
use ecaxis_ecat::mailbox::abort_code;
use ecaxis_esi::{self as esi, Mode};

use super::{BusDevice, Step, watchdog};
use crate::config::DeviceConfig;
use crate::config::duration::show;
use crate::mailbox::MailboxTransport;
use crate::report::{Cause, Error, ModuleDifference};

/// The list of detected modules, place by place.
pub const DETECTED_MODULES: u16 = 0xf050;
/// The pause before a device that is not ready is asked again.
pub(super) const RETRY: Duration = Duration::from_millis(100);

/// Compares the detected modules with those of the file. `None` if they are equal, or if a mode
/// selects the modules: they are software then.
#[must_use]
pub fn difference(config: &DeviceConfig, detected: &[u32]) -> Option<ModuleDifference> {
    let selection = &config.selection;
    if config.device.slots.is_none() || selection.mode.is_some_and(Mode::is_cyclic) {
        return None;
    }
    let names = |idents: &[u32]| esi::module_names(&config.esi.modules, idents);
    let configured = selection.module_idents();
    let differs = esi::plugged_modules(&configured) != esi::plugged_modules(detected);
    differs.then(|| ModuleDifference {
        expected: names(&configured),
        found: names(detected),
    })
}

/// Returns true if so few modules were detected that the device may still look for others.
fn may_change(selection: &esi::Selection, detected: &[u32]) -> bool {
    let found = detected.iter().filter(|ident| **ident != 0).count();
    found < selection.modules.len()
}

/// Warns of modules that differ, although the device has not refused them.
pub(super) async fn compare(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    device: &mut BusDevice,
    progress: &dyn Fn(Step),
) -> Result<(), Error> {
    let detected = detect(wire, config, device).await?;
    // A device that detects nothing has an empty list.
    let detected = detected.filter(|idents| idents.iter().any(|ident| *ident != 0));
    let found = detected.and_then(|idents| difference(config, &idents));
    if let Some(ModuleDifference { expected, found }) = found {
        progress(Step::Warning(format!(
            "{}: it detects the modules [{}] (0xF050), the file configures [{}]",
            device.at,
            found.join(", "),
            expected.join(", ")
        )));
    }
    Ok(())
}

/// Reads the detected modules; `None` if the device has no such list or no slots.
async fn detect(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    device: &mut BusDevice,
) -> Result<Option<Vec<u32>>, Error> {
    let (Some(coe), Some(_)) = (device.coe.as_mut(), &config.device.slots) else {
        return Ok(None);
    };
    let list = coe.upload_list(wire, DETECTED_MODULES).await;
    list.map_err(|source| {
        Cause::Sdo(source)
            .with_device(&device.at)
            .with_action("reading its modules (0xF050)")
    })
}

/// Requests SafeOp as [`watchdog::to_safe_op`], and again while the device is not ready, for the
/// time-out of the change.
///
/// # Errors
/// [`Cause::Modules`] if the device refuses its modules and detects others.
pub(super) async fn enter_safe_op(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    device: &mut BusDevice,
    pulses: impl AsyncFn(),
    progress: &dyn Fn(Step),
) -> Result<(), Error> {
    let timeout = device.timeouts.safe_op_op;
    let end = deadline(wire, timeout);
    let (mut asked, mut warned) = (0_u32, false);
    loop {
        let change = watchdog::to_safe_op(wire, config, device, &pulses, progress);
        let Err(error) = change.await else {
            return Ok(());
        };
        asked = asked.saturating_add(1);
        // A request without an answer lasts as long as the whole wait.
        let is_over = wire.now() >= end && asked > 1;
        let Cause::State(state) = &*error.cause else {
            return Err(error);
        };
        let code = state.code();
        if code == al_status_code::MODULES_DIFFER {
            // Without a list of detected modules, the device may still look for them.
            let detected = detect(wire, config, device).await?;
            let is_final =
                |detected: &Vec<u32>| is_over || !may_change(&config.selection, detected);
            let detected = detected.filter(is_final);
            if let Some(modules) = detected.and_then(|found| difference(config, &found)) {
                return Err(error.map_cause(|refusal| Cause::Modules { modules, refusal }));
            }
        } else if code != al_status_code::HARDWARE_NOT_READY {
            return Err(error);
        }
        if is_over {
            return Err(not_ready(error, timeout));
        }
        if !std::mem::replace(&mut warned, true) {
            progress(Step::Warning(format!(
                "{error}; it is asked again for {}",
                show(nanoseconds(timeout))
            )));
        }
        wire.delay(RETRY).await;
    }
}

/// Returns true if a modular device rejects an SDO in its present state. Couplers do so while they
/// look for their modules.
pub(super) fn rejects_for_now(config: &DeviceConfig, error: &Error) -> bool {
    let code = match &*error.cause {
        Cause::StartUp { source, .. } => source.abort_code(),
        _ => None,
    };
    config.device.slots.is_some() && code == Some(abort_code::DEVICE_STATE)
}

/// Returns the error of a device that was not ready in time.
pub(super) fn not_ready(error: Error, timeout: Duration) -> Error {
    let timeout_ns = nanoseconds(timeout);
    error.map_cause(|cause| Cause::NotReady { timeout_ns, cause })
}

pub(super) fn deadline(wire: &impl MailboxTransport, timeout: Duration) -> u64 {
    wire.now().saturating_add(nanoseconds(timeout))
}

fn nanoseconds(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}
