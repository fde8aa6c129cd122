//! Advice for a firmware update that was refused or interrupted.

use ecaxis_master::acyclic::AlState;
use ecaxis_master::config::Nic;
use ecaxis_master::mailbox::{FoeCause, FoeError};
use ecaxis_master::report;
use ecaxis_tools::firmware::{FinalDeviceState, FirmwareError, UpdateCause, UpdateMethod};

use super::{FAILED, Failure, INTERRUPTED, WRONG, state};

/// The failure if another MainDevice is active: a firmware update needs the bus alone.
pub(crate) fn shared_bus() -> Failure {
    let message = "another MainDevice is active on this bus: nothing was written";
    Failure::new(FAILED, message).hint("end the program that drives the bus, then try again")
}

pub(crate) fn firmware(error: &FirmwareError, nic: &Nic) -> Failure {
    let code = match error {
        FirmwareError::Failed { cause, .. } if matches!(**cause, UpdateCause::Interrupted) => {
            INTERRUPTED
        }
        _ => FAILED,
    };
    let failure = Failure::new(code, error.to_string());
    match error {
        FirmwareError::Service(error) => super::failure(error, nic),
        FirmwareError::Identity { .. } => failure
            .hint("`ecaxis firmware info` shows the device; select the intended one")
            .hint("if this is the right one, name its ESI file in the machine file, or `--expect-product`"),
        FirmwareError::Changed { .. } => failure
            .hint("the file was made for another device: write the one for this device"),
        FirmwareError::Driven { .. } => {
            failure.hint("end the program that drives the bus, then try again")
        }
        FirmwareError::NotOffered { via, .. } => failure.hint(match via {
            UpdateMethod::Foe => "use the other method: `--via program`",
            UpdateMethod::Program => "use the other method: `--via foe`",
        }),
        FirmwareError::NoWay { .. } => {
            failure.hint("this device cannot be updated over EtherCAT; use its vendor's tools")
        }
        FirmwareError::Name { .. } => wrong(failure)
            .hint("set the file name that the vendor specifies with `--name`"),
        FirmwareError::Empty => wrong(failure).hint("name a firmware file from the device's vendor"),
        FirmwareError::Failed { cause, left, .. } => {
            let failure = match self::cause(cause) {
                Some(hint) => failure.hint(hint),
                None => failure,
            };
            failure.hint(again(*left))
        }
    }
}

fn wrong(failure: Failure) -> Failure {
    Failure {
        code: WRONG,
        ..failure
    }
}

fn cause(cause: &UpdateCause) -> Option<String> {
    let hint = match cause {
        UpdateCause::Foe(error) => foe(error)?,
        UpdateCause::Sdo(_) => {
            "the device refuses this file or this order: use the file that its vendor specifies"
        }
        UpdateCause::Service(error) => match &*error.cause {
            report::Cause::State(error) => return Some(state(error)),
            _ => return None,
        },
        UpdateCause::Control { .. } => {
            "the device ignores 0x1F51: check whether it supports `--via foe`"
        }
        UpdateCause::Differs { .. } => {
            "the device did not store the sent data; its program memory may be worn"
        }
        UpdateCause::NotRunning { .. } => {
            "the device took the file but does not run it: switch it off and on, then run `ecaxis firmware info`"
        }
        UpdateCause::NotBack { .. } => {
            "switch the device off and on, then run `ecaxis firmware info`"
        }
        UpdateCause::Interrupted => return None,
    };
    Some(hint.to_owned())
}

fn foe(error: &FoeError) -> Option<&'static str> {
    match error.cause {
        FoeCause::Refused { code, .. } => Some(match code {
            0x8001 | 0x8006 | 0x8009 => {
                "the device expects another file name: set it with `--name`"
            }
            0x8002 | 0x8007 | 0x800a => {
                "the device wants a password or another name: `--password`, `--name`"
            }
            0x8003 => "the file is larger than the device's program memory",
            0x8004 => {
                "the device takes no file this way: try `--via program`, or ask its vendor for another"
            }
            0x800b | 0x8011 => {
                "the device could not write its program memory: try again, then ask its vendor"
            }
            _ => {
                "the file is damaged or for another device: use the file that its vendor specifies"
            }
        }),
        FoeCause::Busy { .. } | FoeCause::Timeout { .. } => {
            Some("the device stopped responding: switch it off and on")
        }
        FoeCause::Gone { .. } | FoeCause::Wire { .. } => {
            Some("check the device's power and the cable to it")
        }
        _ => None,
    }
}

fn again(left: FinalDeviceState) -> String {
    match left {
        FinalDeviceState::In { state, .. } if state != AlState::Bootstrap => {
            "`ecaxis firmware info` shows the program that it runs; the same command tries again"
                .to_owned()
        }
        FinalDeviceState::In { .. } => {
            "its boot loader waits for a program; the same command tries again from there"
                .to_owned()
        }
        FinalDeviceState::Silent => {
            "when it answers again, at least its boot loader runs; the same command tries again"
                .to_owned()
        }
    }
}
