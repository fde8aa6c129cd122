//! A bus without a cycle.

use std::path::Path;

use ecaxis::bringup::BringUpError;
use ecaxis::config::Nic;
use ecaxis::mailbox::{InfoError, SdoError};
use ecaxis::parameters::restore::RestoreError;
use ecaxis::service::ServiceError;
use ecaxis::service::eeprom::EepromError;
use ecaxis::service::image::WriteError;

use super::{FAILED, Failure, INTERRUPTED, WRONG, bring_up, sdo, state};

const FRAMES: &str = "frames are lost or a device restarts: check cables and supply";

/// Work on devices that were taken as they were found.
pub(crate) fn service(error: &ServiceError, nic: &Nic) -> Failure {
    let code = match error {
        ServiceError::Stopped { .. } => INTERRUPTED,
        _ => FAILED,
    };
    let failure = Failure::new(code, message(error));
    let hint = match error {
        ServiceError::NoAnswer => return bring_up(failure, &BringUpError::NoAnswer, nic),
        ServiceError::Silent { .. }
        | ServiceError::Segment { .. }
        | ServiceError::Wire { .. }
        | ServiceError::NotTaken { .. } => FRAMES.to_owned(),
        ServiceError::NotFound { .. } | ServiceError::Ambiguous { .. } => {
            return Failure::new(WRONG, error.to_string())
                .hint("`ecaxis scan` shows who is on the bus");
        }
        ServiceError::Eeprom { source, .. } => match source {
            EepromError::InUse => {
                "another MainDevice or the device itself is using it: try again in Init".to_owned()
            }
            EepromError::Smaller { .. } => {
                "take an image that is made for this device: its word 0x3E says how long it is".to_owned()
            }
            EepromError::WriteProtected { .. } => {
                "the device protects its EEPROM; its manual tells how to release it".to_owned()
            }
            _ => "the EEPROM is defective, or the device writes to it: switch it off and on"
                .to_owned(),
        },
        ServiceError::Sii { .. } => {
            "the image in its EEPROM is damaged: `ecaxis eeprom verify` says how, `ecaxis esi sii` makes one from an ESI file".to_owned()
        }
        ServiceError::Information { source, .. } => match source.as_ref() {
            InfoError::Gone { .. } | InfoError::Wire { .. } => FRAMES.to_owned(),
            source if source.is_refusal() => {
                "the device does not tell about its objects: give its ESI file, by a machine file or with `--esi`".to_owned()
            }
            _ => "the device answers too slowly or damaged: give its ESI file, by a machine file or with `--esi`".to_owned(),
        },
        ServiceError::NoMailbox { .. } => {
            "devices without a mailbox, such as digital terminals, have no parameters".to_owned()
        }
        ServiceError::WrongState { .. } => {
            "lead it to Init first, or switch it off and on".to_owned()
        }
        ServiceError::Stopped { .. } => {
            "the device is in the state again in which it was found; the same command begins anew"
                .to_owned()
        }
        ServiceError::Sdo { source, .. } => parameter(source),
        ServiceError::State(error) => state(error),
    };
    failure.hint(hint)
}

/// Settings that a device was not given to the end.
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

/// An image that a device was not given to the end; the old one is kept.
pub(crate) fn image(error: &WriteError, backup: &Path, nic: &Nic) -> Failure {
    let source = service(&error.source, nic);
    let backup = backup.display();
    let failure = Failure {
        message: format!(
            "{}{}; the old image is in {backup}",
            source.message,
            error.left()
        ),
        ..source
    };
    if error.written == 0 {
        return failure;
    }
    failure.hint(format!(
        "before the device is switched off: the same command writes the rest, `ecaxis eeprom write` with {backup} brings the old image back"
    ))
}

/// Where another MainDevice is at work: it takes answers away, and a drive that it moves must not be switched off.
pub(crate) fn beside_another(failure: Failure, error: &ServiceError) -> Failure {
    // What the device refused it has refused to us.
    let lost = match error {
        ServiceError::Sdo { source, .. } => source.abort_code().is_none(),
        ServiceError::Information { source, .. } => !source.is_refusal(),
        _ => false,
    };
    if !lost {
        return failure;
    }
    let hints = [
        "the other MainDevice uses the same mailbox and takes the answers away: stop it, or have it read and write",
        "leave the drive switched on while somebody moves it",
    ];
    Failure {
        hints: hints.map(str::to_owned).to_vec(),
        ..failure
    }
}

/// The error's text, with the device's address once: what its mailbox says carries it, too.
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

/// An object that somebody asked for.
fn parameter(error: &SdoError) -> String {
    let hint = match error.abort_code() {
        Some(0x0602_0000 | 0x0609_0011) => "`ecaxis sdo list` shows what it has",
        Some(0x0601_0001 | 0x0601_0002) => "`ecaxis sdo list` shows what can be read and written",
        Some(0x0601_0000 | 0x0601_0004 | 0x0601_0005) => "read or write its subindices one by one",
        Some(0x0609_0030..=0x0609_0036) => {
            "`ecaxis esi objects` shows the range, where the ESI file says it"
        }
        Some(0x0607_0010..=0x0607_0013) => {
            "the device has another type there than its ESI file: give the value with `--type`"
        }
        Some(0x0601_0006 | 0x0800_0020..=0x0800_0022) => {
            "the device forbids it in its present state: disable the axis or end what drives the bus, then try again"
        }
        _ => return sdo(error, "the device"),
    };
    hint.to_owned()
}
