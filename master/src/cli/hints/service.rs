//! A bus without a cycle.

use ecaxis::bringup::BringUpError;
use ecaxis::config::Nic;
use ecaxis::service::ServiceError;
use ecaxis::service::eeprom::EepromError;

use super::{FAILED, Failure, WRONG, bring_up, sdo, state};

const FRAMES: &str = "frames are lost or a device restarts: check cables and supply";

/// Work on devices that were taken as they were found.
pub(crate) fn service(error: &ServiceError, nic: &Nic) -> Failure {
    let failure = Failure::new(FAILED, error.to_string());
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
            EepromError::WriteProtected { .. } => {
                "the device protects its EEPROM; its manual tells how to release it".to_owned()
            }
            _ => "the EEPROM is defective, or the device writes to it: switch it off and on"
                .to_owned(),
        },
        ServiceError::NoMailbox { .. } => {
            "devices without a mailbox, such as digital terminals, have no parameters".to_owned()
        }
        ServiceError::WrongState { .. } => {
            "lead it to Init first, or switch it off and on".to_owned()
        }
        ServiceError::Sdo { source, .. } => sdo(source, "the device"),
        ServiceError::State(error) => state(error),
    };
    failure.hint(hint)
}
