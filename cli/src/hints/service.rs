//! Advice for work on a bus without a cycle.

use std::io::ErrorKind;
use std::path::Path;

use ecaxis_ecat::mailbox::abort_code as abort;
use ecaxis_master::acyclic::eeprom::EepromError;
use ecaxis_master::acyclic::image::WriteError;
use ecaxis_master::acyclic::parameters::restore::RestoreError;
use ecaxis_master::config::Nic;
use ecaxis_master::eoe::TapStep;
use ecaxis_master::mailbox::{CoeCause, EoeError, InfoError, SdoError};
use ecaxis_master::report::{Cause, Error};

use super::{Failure, ORDER_OF_A_LIST, failure, sdo};

pub(super) const FRAMES: &str = "frames are lost or a device restarts: check cables and supply";

/// Returns the hint for an error of the EEPROM interface.
pub(super) fn eeprom(error: EepromError) -> &'static str {
    match error {
        EepromError::InUse => {
            "another MainDevice or the device itself is using it: try again in Init"
        }
        EepromError::Smaller { .. } => {
            "use an image for this device: its word 0x3E is the EEPROM size"
        }
        EepromError::WriteProtected { .. } => {
            "the device protects its EEPROM; see its manual for the release"
        }
        _ => "the EEPROM is defective, or the device writes to it: switch it off and on",
    }
}

/// Returns the hint for an error of the SDO Information service.
pub(super) fn information(error: &InfoError) -> &'static str {
    match error.cause {
        CoeCause::Gone | CoeCause::Wire(_) => FRAMES,
        CoeCause::Abort(_) | CoeCause::Refused(_) => {
            "the device does not support SDO Information: name its ESI file in a machine file or with `--esi`"
        }
        _ => {
            "the device's answers are late or damaged: name its ESI file in a machine file or with `--esi`"
        }
    }
}

/// Maps the error of an incomplete parameter restore to a failure.
pub(crate) fn restore(error: &RestoreError, nic: &Nic) -> Failure {
    let source = failure(&error.source, nic);
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
    let source = failure(&error.source, nic);
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
pub(crate) fn with_other_main_device(failure: Failure, error: &Error) -> Failure {
    // A refusal is an answer of the device, so no answer was lost.
    let lost = match &*error.cause {
        Cause::Sdo(source) => source.abort_code().is_none(),
        Cause::Information(source) => !source.is_refusal(),
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

/// Returns the hint for an object that the user requested.
pub(super) fn parameter(error: &SdoError) -> String {
    let hint = match error.abort_code() {
        Some(code) if abort::is_no_such_object(code) => "`ecaxis sdo list` shows its objects",
        Some(abort::WRITE_ONLY | abort::READ_ONLY) => {
            "`ecaxis sdo list` shows what can be read and written"
        }
        Some(abort::SUBINDEX_0_NOT_ZERO) => ORDER_OF_A_LIST,
        Some(abort::INCOMPATIBLE_PARAMETERS | abort::INTERNAL_INCOMPATIBILITY) => {
            "the value contradicts another setting of the device: write that one first"
        }
        Some(
            abort::UNSUPPORTED_ACCESS | abort::NO_COMPLETE_ACCESS | abort::LONGER_THAN_MAILBOX,
        ) => "read or write its subindices one by one",
        Some(abort::OUT_OF_RANGE..=abort::MAX_BELOW_MIN) => {
            "`ecaxis esi objects` shows the range if the ESI file contains it"
        }
        Some(abort::TYPE_MISMATCH..=abort::DATA_TOO_SHORT) => {
            "the device has another type than its ESI file: set it with `--type`"
        }
        Some(abort::MAPPED_TO_RX_PDO | abort::NOT_STORED..=abort::DEVICE_STATE) => {
            "the device forbids it in its present state: disable the axis or stop the program that drives the bus, then try again"
        }
        _ => return sdo(error, "the device"),
    };
    hint.to_owned()
}

/// Returns the hint for IP parameters that a device has not taken.
pub(super) fn eoe(error: &EoeError) -> String {
    match error {
        EoeError::Result(_) => {
            "remove what the device does not support from `eoe`, or write `eoe = {}`: it keeps its own parameters".to_owned()
        }
        EoeError::TooLong { .. } => {
            "omit `filters`, or use an ESI file with a longer mailbox".to_owned()
        }
        EoeError::Mailbox(CoeCause::Refused(_)) => {
            "the device has no EoE: omit `eoe`, or use the ESI file of its firmware".to_owned()
        }
        EoeError::Mailbox(_) => FRAMES.to_owned(),
    }
}

/// Returns the hint for a TAP interface that cannot be opened.
pub(super) fn tap(error: &std::io::Error, step: TapStep, name: &str) -> String {
    // A device file without its module: ENODEV has no kind of its own.
    let no_module = rustix::io::Errno::NODEV.raw_os_error();
    let missing = error.kind() == ErrorKind::NotFound || error.raw_os_error() == Some(no_module);
    match (step, error.kind()) {
        (TapStep::Open, _) if missing => "load the module: `modprobe tun`".to_owned(),
        (TapStep::Open, _) => "give this user access to /dev/net/tun (docs/eoe.md)".to_owned(),
        (TapStep::Create, ErrorKind::PermissionDenied) => format!(
            "grant CAP_NET_ADMIN (docs/eoe.md), or create it beforehand: `ip tuntap add {name} mode tap user $USER`"
        ),
        (TapStep::Create, ErrorKind::ResourceBusy) => {
            "another program uses it: write another name for `tap`".to_owned()
        }
        (TapStep::Address | TapStep::Netmask, ErrorKind::PermissionDenied) => format!(
            "grant CAP_NET_ADMIN (docs/eoe.md), or omit `address` and set it beforehand: `ip addr add ADDRESS dev {name}`"
        ),
        (TapStep::SwitchOn, ErrorKind::PermissionDenied) => format!(
            "grant CAP_NET_ADMIN (docs/eoe.md), or switch it on beforehand: `ip link set {name} up`"
        ),
        _ => format!("an interface `{name}` of another kind may exist: `ip link show {name}`"),
    }
}
