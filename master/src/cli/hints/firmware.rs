//! Advice for a firmware update that was refused or broke off.

use ecaxis::config::Nic;
use ecaxis::firmware::{Cause, FirmwareError, Left, Via};
use ecaxis::mailbox::FoeError;

use super::{FAILED, Failure, INTERRUPTED, WRONG, service, state};

/// Nobody else may be on the bus while a program is written.
pub(crate) fn shared_bus() -> Failure {
    let message = "another MainDevice is at work on this bus: nothing was written";
    Failure::new(FAILED, message).hint("end the program that drives the bus, then try again")
}

pub(crate) fn firmware(error: &FirmwareError, nic: &Nic) -> Failure {
    let code = match error {
        FirmwareError::Failed {
            cause: Cause::Interrupted,
            ..
        } => INTERRUPTED,
        _ => FAILED,
    };
    let failure = Failure::new(code, message(error));
    match error {
        FirmwareError::Service(error) => service(error, nic),
        FirmwareError::Eeprom { .. } => {
            failure.hint("the device's EEPROM is damaged: its maker's tools can write it anew")
        }
        FirmwareError::Identity { .. } => failure
            .hint("`ecaxis firmware info` shows what is there; name the device that is meant")
            .hint("where this is the right one, name its ESI file in the machine file, or `--expect-product`"),
        FirmwareError::Changed { .. } => failure
            .hint("the file was made for another device: write the one for this device"),
        FirmwareError::Driven { .. } => {
            failure.hint("end the program that drives the bus, then try again")
        }
        FirmwareError::NotOffered { via, .. } => failure.hint(match via {
            Via::Foe => "`--via program` takes the other way",
            Via::Program => "`--via foe` takes the other way",
        }),
        FirmwareError::NoWay { .. } => {
            failure.hint("this device cannot be updated over EtherCAT; its maker's tools may")
        }
        FirmwareError::Name { .. } => wrong(failure)
            .hint("`--name` says what the file is called in the device, as its maker has it"),
        FirmwareError::Empty => wrong(failure).hint("name the file that the device's maker made for it"),
        FirmwareError::Failed { cause, left, .. } => {
            let failure = match self::cause(cause) {
                Some(hint) => failure.hint(hint),
                None => failure,
            };
            failure.hint(again(*left))
        }
    }
}

/// The error's text, with the device once: what failed at it mostly names it, too.
fn message(error: &FirmwareError) -> String {
    let text = error.to_string();
    let FirmwareError::Failed { device, .. } = error else {
        return text;
    };
    let head = format!("{device}: ");
    let Some(rest) = text.strip_prefix(&head) else {
        return text;
    };
    let station = format!("station {:#06x}: ", device.station);
    head.clone() + &rest.replace(&head, "").replace(&station, "")
}

fn wrong(failure: Failure) -> Failure {
    Failure {
        code: WRONG,
        ..failure
    }
}

fn cause(cause: &Cause) -> Option<String> {
    let hint = match cause {
        Cause::Foe(error) => foe(error)?,
        Cause::Sdo(_) => {
            "the device refuses this file or this order: take the file that its maker names for it"
        }
        Cause::State(error) => return Some(state(error)),
        Cause::Control { .. } => {
            "the device does not obey 0x1F51: look whether `--via foe` is offered"
        }
        Cause::Differs { .. } => {
            "the device did not keep what it was sent; its program memory may be worn"
        }
        Cause::NotRunning { .. } => {
            "the device took the file but does not run it: switch it off and on, then look with `ecaxis firmware info`"
        }
        Cause::NotBack { .. } => {
            "switch the device off and on, then look with `ecaxis firmware info`"
        }
        Cause::Service(_) | Cause::Interrupted => return None,
    };
    Some(hint.to_owned())
}

fn foe(error: &FoeError) -> Option<&'static str> {
    match error {
        FoeError::Refused { code, .. } => Some(match code {
            0x8001 | 0x8006 | 0x8009 => {
                "the device expects another name: `--name` says what the file is called in it"
            }
            0x8002 | 0x8007 | 0x800a => {
                "the device wants a password or another name: `--password`, `--name`"
            }
            0x8003 => "the file is larger than the device's program memory",
            0x800b | 0x8011 => {
                "the device could not write its program memory: try again, then ask its maker"
            }
            _ => {
                "the file is damaged or made for another device: take the one that its maker names for it"
            }
        }),
        FoeError::Busy { .. } | FoeError::Timeout { .. } => {
            Some("the device did not go on: switch it off and on")
        }
        FoeError::Gone { .. } | FoeError::Wire { .. } => {
            Some("check the device's power and the cable to it")
        }
        _ => None,
    }
}

fn again(left: Left) -> String {
    match left {
        Left::In { .. } => {
            "its boot loader waits for a program; the same command tries again from there"
                .to_owned()
        }
        Left::Silent => {
            "once it answers again, it has its boot loader at least; the same command tries again"
                .to_owned()
        }
    }
}
