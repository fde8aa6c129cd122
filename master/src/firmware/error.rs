//! What failed at which step, and how the device was left.

use std::fmt;
use std::time::Duration;

use ecaxis_esi::sii::SiiError;

use super::{Runs, Via};
use crate::bringup::al::{self, AlState};
use crate::bringup::{DeviceRef, StateError};
use crate::mailbox::{FoeError, SdoError};
use crate::service::{Datagrams, ServiceError, station};

/// Part of an update.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    /// To Init, from wherever it is.
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

impl fmt::Display for Step {
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
pub enum Cause {
    #[error(transparent)]
    Foe(#[from] FoeError),
    #[error(transparent)]
    Sdo(#[from] SdoError),
    #[error(transparent)]
    State(#[from] StateError),
    #[error(transparent)]
    Service(#[from] ServiceError),
    /// 0x1F51 does not become what it should.
    #[error("0x1F51:01 is not {wanted} within {after:?}: {last}{}", Refusal(refused.as_deref()))]
    Control {
        wanted: u8,
        after: Duration,
        /// What was read last, or why nothing.
        last: String,
        /// What the device answered when it was told, if it did.
        refused: Option<Box<SdoError>>,
    },
    #[error("interrupted")]
    Interrupted,
    #[error("what the device hands out differs from the file from byte {at} on")]
    Differs { at: usize },
    #[error("after {after:?} it is in {state} and {runs}")]
    NotRunning {
        state: AlState,
        runs: Runs,
        after: Duration,
    },
    #[error("after {after:?} it is not back: {error}")]
    NotBack {
        error: Box<FirmwareError>,
        after: Duration,
    },
}

struct Refusal<'a>(Option<&'a SdoError>);

impl fmt::Display for Refusal<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            Some(error @ SdoError::Abort { .. }) => write!(f, "; {error}"),
            _ => Ok(()),
        }
    }
}

/// How a device was left.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Left {
    In { state: AlState, code: u16 },
    Silent,
}

impl fmt::Display for Left {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::In { state, code: 0 } => write!(f, "the device is in {state}"),
            Self::In { state, code } => {
                let text = crate::al_status::al_status_text(*code);
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
    Service(#[from] ServiceError),
    #[error("{device}: its EEPROM: {source}")]
    Eeprom { device: DeviceRef, source: SiiError },
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
    #[error("{device}: is in Op: somebody drives it")]
    Driven { device: DeviceRef },
    #[error("{device}: does not offer {via}: {reason}")]
    NotOffered {
        device: DeviceRef,
        via: Via,
        reason: &'static str,
    },
    #[error("{device}: offers no way: {foe}, and {program}")]
    NoWay {
        device: DeviceRef,
        foe: &'static str,
        program: &'static str,
    },
    #[error("{device}: `{name}` is no name for a file in it: 1 to {room} bytes")]
    Name {
        device: DeviceRef,
        name: String,
        room: usize,
    },
    #[error("the file is empty")]
    Empty,
    /// From the moment on at which the device was touched.
    #[error("{device}: {step}: {cause}; {left}")]
    Failed {
        device: DeviceRef,
        step: Step,
        cause: Cause,
        left: Left,
    },
}

/// A step that failed.
#[derive(Debug)]
pub(super) struct Broken {
    step: Step,
    cause: Cause,
}

impl Step {
    pub(super) fn failed(self, cause: impl Into<Cause>) -> Broken {
        Broken {
            step: self,
            cause: cause.into(),
        }
    }
}

impl Broken {
    /// With a look at how the device is left. It may have another address than it had.
    pub(super) async fn at(self, wire: &Datagrams, device: &DeviceRef) -> FirmwareError {
        let seen = station::at(wire, device.position, "looking after it", al::AL_STATUS).await;
        let left = match seen {
            Ok([status, _, _, _, c0, c1]) => Left::In {
                state: AlState::from_status(status),
                code: u16::from_le_bytes([c0, c1]),
            },
            Err(_) => Left::Silent,
        };
        FirmwareError::Failed {
            device: device.clone(),
            step: self.step,
            cause: self.cause,
            left,
        }
    }
}
