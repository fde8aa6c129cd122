//! Advice for work on a bus without a cycle.

use std::path::Path;

use ecaxis_master::acyclic::ServiceError;
use ecaxis_master::acyclic::eeprom::EepromError;
use ecaxis_master::acyclic::image::WriteError;
use ecaxis_master::config::Nic;
use ecaxis_master::mailbox::{InfoError, SdoError};
use ecaxis_tools::parameters::restore::RestoreError;

use super::{FAILED, Failure, INTERRUPTED, WRONG, interfaces, sdo, state};

pub(super) const FRAMES: &str = "frames are lost or a device restarts: check cables and supply";

/// Maps the error of acyclic work to a failure.
pub(crate) fn service(error: &ServiceError, nic: &Nic) -> Failure {
    let code = match error {
        ServiceError::Stopped { .. } => INTERRUPTED,
        _ => FAILED,
    };
    let failure = Failure::new(code, message(error));
    let hint = match error {
        ServiceError::NoAnswer => {
            return match nic {
                Nic::Interface(name) => failure
                    .hint(format!("is `{name}` the right interface? {}", interfaces()))
                    .hint("check that the first SubDevice has power and its IN port is connected"),
                Nic::Sim => failure.hint("check the fault script: it may silence the bus"),
            };
        }
        ServiceError::Silent { .. }
        | ServiceError::Segment { .. }
        | ServiceError::Wire { .. }
        | ServiceError::NotTaken { .. } => FRAMES.to_owned(),
        ServiceError::NotFound { .. } | ServiceError::Ambiguous { .. } => {
            return Failure::new(WRONG, error.to_string())
                .hint("`ecaxis scan` shows the devices on the bus");
        }
        ServiceError::Eeprom { source, .. } => match source {
            EepromError::InUse => {
                "another MainDevice or the device itself is using it: try again in Init".to_owned()
            }
            EepromError::Smaller { .. } => {
                "use an image for this device: its word 0x3E is the EEPROM size".to_owned()
            }
            EepromError::WriteProtected { .. } => {
                "the device protects its EEPROM; see its manual for the release".to_owned()
            }
            _ => "the EEPROM is defective, or the device writes to it: switch it off and on"
                .to_owned(),
        },
        ServiceError::Sii { .. } => {
            "the image in its EEPROM is damaged: `ecaxis eeprom verify` shows the problems, `ecaxis esi sii` generates an image from an ESI file".to_owned()
        }
        ServiceError::Information { source, .. } => match source.as_ref() {
            InfoError::Gone { .. } | InfoError::Wire { .. } => FRAMES.to_owned(),
            source if source.is_refusal() => {
                "the device does not support SDO Information: name its ESI file in a machine file or with `--esi`".to_owned()
            }
            _ => "the device's answers are late or damaged: name its ESI file in a machine file or with `--esi`".to_owned(),
        },
        ServiceError::NoMailbox { .. } => {
            "devices without a mailbox, such as digital terminals, have no parameters".to_owned()
        }
        ServiceError::WrongState { .. } => {
            "bring it to Init first, or switch it off and on".to_owned()
        }
        ServiceError::Stopped { .. } => {
            "the device is back in its original state; the same command starts again"
                .to_owned()
        }
        ServiceError::Sdo { source, .. } => parameter(source),
        ServiceError::State(error) => state(error),
    };
    failure.hint(hint)
}

/// Maps the error of an incomplete parameter restore to a failure.
pub(crate) fn restore(error: &RestoreError, nic: &Nic) -> Failure {
    let source = service(&error.source, nic);
    let failure = Failure {
        message: format!("{}{}", source.message, error.left()),
        ..source
    };
    if error.written == 0 && error.emptied.is_empty() {
        return failure;
    }
    failure.hint("run the same command again; or switch the device off and on: nothing was stored")
}

/// Maps the error of an incomplete EEPROM write to a failure. The old image is in `backup`.
pub(crate) fn image(error: &WriteError, backup: &Path, nic: &Nic) -> Failure {
    let source = service(&error.source, nic);
    let backup = backup.display();
    let failure = Failure {
        message: format!(
            "{}{}; the old image is in {backup}",
            source.message,
            error.remaining_state()
        ),
        ..source
    };
    if error.written == 0 {
        return failure;
    }
    failure.hint(format!(
        "before the device is switched off: the same command writes the rest, `ecaxis eeprom write` with {backup} restores the old image"
    ))
}

/// Replaces the hints if another MainDevice is active: it takes mailbox answers away, and a drive
/// that it moves must not be switched off.
pub(crate) fn with_other_main_device(failure: Failure, error: &ServiceError) -> Failure {
    // A refusal is an answer of the device, so no answer was lost.
    let lost = match error {
        ServiceError::Sdo { source, .. } => source.abort_code().is_none(),
        ServiceError::Information { source, .. } => !source.is_refusal(),
        _ => false,
    };
    if !lost {
        return failure;
    }
    let hints = [
        "the other MainDevice uses the same mailbox and takes the answers away: stop it, or use it to read and write",
        "leave the drive switched on while it is being moved",
    ];
    Failure {
        hints: hints.map(str::to_owned).to_vec(),
        ..failure
    }
}

/// Returns the error text with the device address once. The source error repeats it.
fn message(error: &ServiceError) -> String {
    let text = error.to_string();
    let (device, source) = match error {
        ServiceError::Sdo { device, source } => (device, source.to_string()),
        ServiceError::Information { device, source } => (device, source.to_string()),
        _ => return text,
    };
    let short = source.strip_prefix(&format!("station {:#06x}", device.station));
    match (short, text.strip_suffix(&source)) {
        (Some(short), Some(head)) => head.to_owned() + short.trim_start_matches(':').trim_start(),
        _ => text,
    }
}

/// Returns the hint for an object that the user requested.
fn parameter(error: &SdoError) -> String {
    let hint = match error.abort_code() {
        Some(0x0602_0000 | 0x0609_0011) => "`ecaxis sdo list` shows its objects",
        Some(0x0601_0001 | 0x0601_0002) => "`ecaxis sdo list` shows what can be read and written",
        Some(0x0601_0000 | 0x0601_0004 | 0x0601_0005) => "read or write its subindices one by one",
        Some(0x0609_0030..=0x0609_0036) => {
            "`ecaxis esi objects` shows the range if the ESI file contains it"
        }
        Some(0x0607_0010..=0x0607_0013) => {
            "the device has another type than its ESI file: set it with `--type`"
        }
        Some(0x0601_0006 | 0x0800_0020..=0x0800_0022) => {
            "the device forbids it in its present state: disable the axis or stop the program that drives the bus, then try again"
        }
        _ => return sdo(error, "the device"),
    };
    hint.to_owned()
}
