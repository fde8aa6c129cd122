//! Restores the settings of a device that takes the place of another: its serial number is not that of
//! the parameter file.

use super::{BusDevice, Step};
use crate::acyclic::parameters::restore::{Restored, restore};
use crate::config::DeviceConfig;
use crate::mailbox::{MailboxTransport, abort_text};
use crate::parameters::class::CopyRule;
use crate::report::{Cause, Error};
use crate::text::pluralize;

const STEP: &str = "comparing it with its parameter file";

/// Writes the settings that differ. The device is in PreOp.
///
/// # Errors
/// Fails if the device has another firmware, or does not take a setting.
pub(super) async fn restore_to(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    device: &mut BusDevice,
    progress: &dyn Fn(Step),
) -> Result<(), Error> {
    let Some(kept) = &config.parameters else {
        return Ok(());
    };
    let Some(coe) = device.coe.as_mut().filter(|_| !kept.is_of(device.serial)) else {
        return Ok(());
    };
    let at = &device.at;
    let sdo = |source| Cause::Sdo(source).with_device(at).with_action(STEP);
    let file = kept.path.display().to_string();
    coe.drain(wire).await.map_err(sdo)?;
    for expected in kept.model() {
        let (index, sub) = (expected.at.index, expected.at.sub);
        let found = coe.upload(wire, index, sub, false).await.map_err(sdo)?;
        if found != expected.value {
            let (object, expected, found) = (
                format!("{} {}", expected.at.number(), expected.name),
                expected.shown(),
                expected.data_type.show(&found),
            );
            return Err(Cause::OtherFirmware {
                object,
                file,
                expected,
                found,
            }
            .with_device(at));
        }
    }
    let values = (
        kept.dump.parameters.as_slice(),
        CopyRule::to_other_unit(kept.dump.device.vendor),
    );
    let done = restore(coe, wire, at, None, values, &mut |_, _| {}).await;
    let done = done.map_err(|error| error.source.with_action(STEP))?;
    if !done.complete() {
        let problems = problems(&done);
        return Err(Cause::Settings { file, problems }.with_device(at));
    }
    if done.written.is_empty() && done.skipped.iter().all(|skipped| skipped.kept.is_none()) {
        return Ok(());
    }
    let result = match done.written.len() {
        0 => format!("its {} settings have their value", done.same),
        written => format!(
            "{} restored, {} had their value. They are not stored in the device; `ecaxis sdo store` does",
            pluralize(written, "setting"),
            done.same
        ),
    };
    progress(Step::Warning(format!(
        "{at}: has the serial number {}, {file} is of {}: {result}",
        device.serial, kept.dump.device.serial
    )));
    for line in done.lines_of_written().chain(done.lines_of_skipped()) {
        progress(Step::Warning(format!("{at}: {line}")));
    }
    Ok(())
}

fn problems(done: &Restored) -> Vec<String> {
    let refused = done
        .refused
        .iter()
        .map(|(at, code)| format!("{at} is refused ({code:#010x}: {})", abort_text(*code)));
    let differing = done.differing.iter().map(|difference| {
        let (left, right) = (&difference.left, &difference.right);
        let or_none = |value: &Option<String>| value.clone().unwrap_or_default();
        format!(
            "{} stays {} instead of {}",
            difference.at,
            or_none(right),
            or_none(left)
        )
    });
    refused.chain(differing).collect()
}
