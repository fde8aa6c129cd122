//! The failed step and the final state of the device.

use std::fmt;
use std::time::Duration;

use super::{RunningProgram, UpdateMethod};
use ecaxis_master::acyclic::al::AlState;
use ecaxis_master::acyclic::enumerate::{EnumeratedDevice, read_device};
use ecaxis_master::acyclic::{DatagramClient, DeviceRef};
use ecaxis_master::mailbox::{FoeCause, FoeError, SdoError};
use ecaxis_master::report::Error;

/// A step of an update.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UpdateStep {
    /// To Init from any state.
    Prepare,
    Bootstrap,
    Send,
    ReadBack,
    Leave,
    PreOp,
    Stop,
    Clear,
    Download,
    Start,
    Check,
}

impl fmt::Display for UpdateStep {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Prepare => "going to Init",
            Self::Bootstrap => "going to Bootstrap",
            Self::Send => "sending the file",
            Self::ReadBack => "reading the file back",
            Self::Leave => "leaving Bootstrap",
            Self::PreOp => "going to PreOp",
            Self::Stop => "stopping the program (0x1F51)",
            Self::Clear => "clearing the program (0x1F51)",
            Self::Download => "downloading the program (0x1F50)",
            Self::Start => "starting the program (0x1F51)",
            Self::Check => "waiting for the device to run its program",
        })
    }
}

/// Why a step failed.
#[derive(Debug, thiserror::Error)]
pub enum UpdateCause {
    #[error("{}", .0.without_station())]
    Foe(#[from] FoeError),
    #[error("{}", .0.without_station())]
    Sdo(#[from] SdoError),
    #[error(transparent)]
    Service(#[from] Error),
    /// 0x1F51 did not reach the expected value.
    #[error("0x1F51:01 is not {wanted} within {after:?}: {last}{}", Refusal(refused.as_deref()))]
    Control {
        wanted: u8,
        after: Duration,
        /// The last value, or why it was not readable.
        last: String,
        /// The device's answer to the command, if any.
        #[source]
        refused: Option<Box<SdoError>>,
    },
    #[error("interrupted")]
    Interrupted,
    #[error("the file read back differs from byte {at} on")]
    Differs { at: usize },
    #[error("after {after:?} it is in {state} and {runs}")]
    NotRunning {
        state: AlState,
        runs: RunningProgram,
        after: Duration,
    },
    #[error("after {after:?} it is not back: {error}")]
    NotBack {
        #[source]
        error: Error,
        after: Duration,
    },
}

struct Refusal<'a>(Option<&'a SdoError>);

impl fmt::Display for Refusal<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            Some(error) if error.abort_code().is_some() => {
                write!(f, "; {}", error.without_station())
            }
            _ => Ok(()),
        }
    }
}

/// The final state of a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FinalDeviceState {
    In { state: AlState, code: u16 },
    Silent,
}

impl fmt::Display for FinalDeviceState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::In { state, code: 0 } => write!(f, "the device is in {state}"),
            Self::In { state, code } => {
                let text = ecaxis_ecat::al_status_code::al_status_text(*code);
                write!(
                    f,
                    "the device is in {state}, AL status code {code:#06x} ({text})"
                )
            }
            Self::Silent => f.write_str("the device does not answer"),
        }
    }
}

#[derive(Debug, thiserror::Error)]
pub enum FirmwareError {
    #[error(transparent)]
    Service(#[from] Error),
    #[error("{device}: is {found} by {by}, {expected} is meant")]
    Identity {
        device: DeviceRef,
        by: &'static str,
        expected: String,
        found: String,
    },
    #[error("{device}: was {before} and is {now} after the update")]
    Changed {
        device: DeviceRef,
        before: String,
        now: String,
    },
    #[error("{device}: is in Op: another MainDevice drives it")]
    Driven { device: DeviceRef },
    #[error("{device}: does not offer {via}: {reason}")]
    NotOffered {
        device: DeviceRef,
        via: UpdateMethod,
        reason: &'static str,
    },
    #[error("{device}: no firmware update method available: {foe}, and {program}")]
    NoWay {
        device: DeviceRef,
        foe: &'static str,
        program: &'static str,
    },
    #[error("{device}: `{name}` is not a valid file name: 1 to {room} bytes")]
    Name {
        device: DeviceRef,
        name: String,
        room: usize,
    },
    #[error("the file is empty")]
    Empty,
    /// Any failure after the first change.
    #[error("{device}: {step}: {cause}; {left}")]
    Failed {
        device: DeviceRef,
        step: UpdateStep,
        #[source]
        cause: Box<UpdateCause>,
        left: FinalDeviceState,
    },
}

impl FirmwareError {
    /// Returns the error of a step. The error names the device, its cause does not.
    #[must_use]
    pub fn from_step(
        device: &DeviceRef,
        step: UpdateStep,
        cause: UpdateCause,
        left: FinalDeviceState,
    ) -> Self {
        let cause = match cause {
            UpdateCause::Service(error) => UpdateCause::Service(error.without_device(device)),
            UpdateCause::NotBack { error, after } => UpdateCause::NotBack {
                error: error.without_device(device),
                after,
            },
            cause => cause,
        };
        Self::Failed {
            device: device.clone(),
            step,
            cause: Box::new(cause),
            left,
        }
    }
}

/// A failed step.
#[derive(Debug)]
pub(super) struct StepFailure {
    step: UpdateStep,
    cause: UpdateCause,
}

impl UpdateStep {
    pub(super) fn failed(self, cause: impl Into<UpdateCause>) -> StepFailure {
        StepFailure {
            step: self,
            cause: cause.into(),
        }
    }
}

impl StepFailure {
    /// True if the device refused the file.
    pub(super) fn is_refusal(&self) -> bool {
        match &self.cause {
            UpdateCause::Foe(error) => matches!(error.cause, FoeCause::Refused { .. }),
            UpdateCause::Sdo(error) => error.abort_code().is_some(),
            _ => false,
        }
    }

    /// Adds the final state of the device, whose address may have changed.
    pub(super) async fn at(self, wire: &DatagramClient, device: &DeviceRef) -> FirmwareError {
        let left = match read_device(wire, device.position).await {
            Ok(EnumeratedDevice { state, code, .. }) => FinalDeviceState::In { state, code },
            Err(_) => FinalDeviceState::Silent,
        };
        FirmwareError::from_step(device, self.step, self.cause, left)
    }
}
