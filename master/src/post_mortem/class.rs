//! The class of causes that an error can have.

use super::evidence::{Evidence, Lateness};
use crate::acyclic::{AlState, DeviceRef, StateError};
use crate::mailbox::CoeCause;
use crate::report::{Cause, Error};
use crate::rt::setpoint_generator::GeneratorError;
use ecaxis_ecat::al_status_code::{
    INVALID_PRE_OP_MAILBOX, INVALID_STATE_CHANGE, SYNC_LOST, SYNC_MANAGER_WATCHDOG,
};

/// The class of causes that an error can have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Class {
    /// Frames, cables, missing devices, watchdogs.
    Bus,
    /// The arrival time of frames.
    Timing,
    /// One device, drive or axis, or the machine file.
    Device,
}

impl Class {
    pub(super) fn of(error: &Error, evidence: &Evidence) -> Self {
        match &*error.cause {
            Cause::BusLost { .. }
            | Cause::Gone
            | Cause::LeftOpBriefly { .. }
            | Cause::NoProcessData { .. } => Self::Bus,
            Cause::DriveFault {
                code: Some(code), ..
            } => match code {
                0x7500..=0x75ff | 0x8100..=0x81ff | 0x8250 | 0x8280..=0x82ff => {
                    Self::said_by_device(evidence)
                }
                0x8700..=0x87ff => Self::Timing,
                _ => Self::Device,
            },
            Cause::LeftOp {
                state,
                code: SYNC_MANAGER_WATCHDOG,
            } if *state != AlState::Op => Self::of_watchdog(error.device(), evidence),
            Cause::LeftOp { state, code } => Self::of_state(*state, *code, evidence),
            Cause::State(error) => Self::of_change(error, evidence),
            Cause::NoAnswer { .. }
            | Cause::Silent { .. }
            | Cause::Datagram(_)
            | Cause::NotTaken { .. }
            | Cause::Scan(_)
            | Cause::Missing { .. }
            | Cause::Reversed { .. } => Self::Bus,
            Cause::StartUp { source, .. }
            | Cause::StartUpIdn { source, .. }
            | Cause::Sdo(source) => match source.cause {
                CoeCause::Gone | CoeCause::Wire(_) => Self::Bus,
                // A device that another MainDevice sets to Init loses its mailbox.
                CoeCause::Timeout { .. } if evidence.other_frames() > 0 => Self::Bus,
                _ => Self::Device,
            },
            Cause::FollowLost {
                reason: Some(GeneratorError::Delayed),
                ..
            } => Self::Bus,
            Cause::NoStart
            | Cause::ClockDoesNotFollow
            | Cause::PhaseNotLocked { .. }
            | Cause::ClockNotSettled { .. } => Self::Timing,
            _ => Self::Device,
        }
    }

    /// Returns the class of an error by which a device blames the bus. The cycle must have seen
    /// trouble on the bus as well.
    fn said_by_device(evidence: &Evidence) -> Self {
        let Lateness { missed, longest } = evidence.lateness();
        let late = missed > 0 || longest > evidence.cycle_ns;
        let seen = late
            || evidence.without_data() > evidence.cycle_ns
            || evidence.other_frames() > 0
            || evidence.stop.is_none();
        if seen { Self::Bus } else { Self::Device }
    }

    /// Returns the class of a watchdog error. A watchdog expires only if process data was missing
    /// for about its time.
    fn of_watchdog(device: Option<&DeviceRef>, evidence: &Evidence) -> Self {
        let found = device.and_then(|device| evidence.named(&device.name));
        let look = found.and_then(|found| found.look.watchdog);
        let enough = look.map_or(0, |watchdog| watchdog.time_ns / 2);
        let without = evidence.without_data().max(evidence.lateness().longest);
        if without > 0 && without >= enough {
            Self::Bus
        } else {
            Self::Device
        }
    }

    fn of_change(error: &StateError, evidence: &Evidence) -> Self {
        // Another MainDevice may have set the device to Init during bring-up.
        const SENT_ELSEWHERE: [u16; 2] = [INVALID_STATE_CHANGE, INVALID_PRE_OP_MAILBOX];
        let others = evidence.other_frames() > 0;
        match error {
            StateError::Gone { .. } | StateError::Wire { .. } => Self::Bus,
            StateError::Refused { code, .. } if others && SENT_ELSEWHERE.contains(code) => {
                Self::Bus
            }
            StateError::Refused { actual, code, .. } => Self::of_state(*actual, *code, evidence),
            StateError::Timeout { wanted, actual, .. } => {
                // The bring-up itself never leaves a device in Init.
                let moved = *wanted == AlState::Op && *actual != AlState::SafeOp;
                if others && (moved || *actual == AlState::Init) {
                    Self::Bus
                } else {
                    Self::Device
                }
            }
        }
    }

    fn of_state(state: AlState, code: u16, evidence: &Evidence) -> Self {
        if code == 0 || code == SYNC_MANAGER_WATCHDOG {
            Self::Bus
        } else if !SYNC_LOST.contains(&code) || state != AlState::SafeOp {
            Self::Device
        } else if evidence.stop.is_some() && evidence.without_data() > evidence.cycle_ns {
            Self::Bus
        } else {
            Self::Timing
        }
    }
}
