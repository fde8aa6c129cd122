//! Errors of a run: what failed, where, with which code. Hints for the user come from the command
//! line.

use std::fmt;
use std::sync::Arc;

use ecaxis_axis::cia402::describe;
use ecaxis_axis::{CommandError, Mode, State, Trip};

use crate::acyclic::{AlState, DeviceRef, StateError};
use crate::bringup::BringUpError;
use crate::config::LimitConflict;
use crate::link::{LinkError, OpenError};
use crate::rt::image::{NotMapped, TooLarge};
use crate::text::{pluralize, rounded};

use super::{DiagnosisMessage, EmergencyReport, StepRef};
use ecaxis_ecat::al_status_code::al_status_text;

/// A failure of the machine or the bus.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    #[error(transparent)]
    Open(#[from] OpenError),
    #[error("the simulated bus: {0}")]
    Sim(String),
    #[error("the recording: {0}")]
    Record(String),
    #[error("the replay: {0}")]
    Replay(String),
    #[error("starting a thread: {0}")]
    Thread(String),
    #[error("the link failed: {0}")]
    Link(LinkError),
    #[error("bring-up: {0}")]
    BringUp(#[from] Box<BringUpError>),
    #[error("`{name}`: {source}")]
    TooLarge { name: String, source: TooLarge },
    #[error("`{name}`: {source}")]
    NotMapped { name: String, source: NotMapped },
    #[error("`{name}`: {source}")]
    Axis {
        name: String,
        source: ecaxis_axis::ConfigError,
    },
    #[error("no process data comes back in SafeOp: {}", al_note(*al_status))]
    NoProcessData { al_status: Option<(u8, u16)> },
    #[error("the release of frames does not lock to SYNC0: phase error {error_ns} ns")]
    PhaseNotLocked { error_ns: i64 },
    #[error(transparent)]
    State(StateError),
    #[error(
        "{device}: does not reach Operation enabled within {timeout_ms} ms: stays in {state} \
         (Statusword 0x{statusword:04x}){}{}",
        mode_note(*mode_confirmed), code_note(*code)
    )]
    NotEnabled {
        device: DeviceRef,
        state: State,
        statusword: u16,
        mode_confirmed: bool,
        code: Option<u16>,
        timeout_ms: u64,
    },
    #[error(
        "{device}: modes of operation display (0x6061) is {}, expected {}",
        Mode::from_code(*display), Mode::from_code(*expected)
    )]
    WrongMode {
        device: DeviceRef,
        expected: i8,
        display: i8,
    },
    #[error("{device}: drive fault (Statusword 0x{statusword:04x}){}{report}", code_note(*code))]
    DriveFault {
        device: DeviceRef,
        code: Option<u16>,
        statusword: u16,
        report: Box<DriveReport>,
    },
    #[error("{device}: {trip}")]
    Trip {
        device: DeviceRef,
        trip: Trip,
        /// The drive's own limits that the machine file exceeds.
        limits: Vec<LimitConflict>,
    },
    #[error(
        "{}: {cycles} cycles in a row {}",
        lost(group.as_deref()), lost_note(*answered, *wkc)
    )]
    BusLost {
        /// The reaction group whose process data was lost; `None` for the whole machine.
        group: Option<String>,
        cycles: u32,
        wkc: (u16, u16),
        answered: bool,
    },
    #[error(
        "{device}: left Op for {state}, AL status code 0x{code:04x} ({})",
        al_status_text(*code)
    )]
    LeftOp {
        device: DeviceRef,
        state: AlState,
        code: u16,
    },
    #[error("{device}: no longer answers")]
    Gone { device: DeviceRef },
    #[error("a SubDevice left Op (AL status 0x{al_status:02x}) and was back when it was asked")]
    LeftOpBriefly { al_status: u8 },
    #[error("{step}: {device}: command refused: {reason}")]
    Refused {
        device: DeviceRef,
        step: StepRef,
        reason: String,
        /// The axis's error if the axis refused the command.
        by_axis: Option<Box<CommandError>>,
    },
    #[error(
        "{step}: {device}: the target of {} {unit} is not reached, the axis is at {actual:.4} {unit}",
        rounded(*target)
    )]
    NotReached {
        device: DeviceRef,
        step: StepRef,
        /// The target; like `actual` in `unit`.
        target: f64,
        actual: f64,
        unit: String,
    },
    #[error(
        "{step}: {device}: touch probe {input} is not armed within {timeout_ms} ms (0x60B8, 0x60B9)"
    )]
    ProbeNotArmed {
        device: DeviceRef,
        step: StepRef,
        input: u8,
        timeout_ms: u64,
    },
    #[error(
        "{step}: {device}: no {edge} edge came at the input of touch probe {input} on the way to {} {unit}",
        rounded(*target)
    )]
    NotProbed {
        device: DeviceRef,
        step: StepRef,
        input: u8,
        edge: &'static str,
        target: f64,
        unit: String,
    },
    #[error(
        "{step}: {device}: `{what}` is not done after {timeout_ms} ms: the drive is in {state}"
    )]
    StepTimeout {
        device: DeviceRef,
        step: StepRef,
        what: String,
        state: State,
        timeout_ms: u64,
    },
    #[error("{step}: {device}: modes of operation display (0x6061) does not become {mode}")]
    NotSwitched {
        device: DeviceRef,
        step: StepRef,
        mode: Mode,
    },
    #[error("{step}: {device}: {error}, by {}", by(*method))]
    NotHomed {
        device: DeviceRef,
        step: StepRef,
        /// The homing method (0x6098).
        method: i8,
        error: ecaxis_axis::homing::HomingError,
    },
    #[error("{step}: {condition} did not come within {timeout_ms} ms: it is {value}")]
    WaitTimeout {
        step: StepRef,
        condition: String,
        value: f64,
        timeout_ms: u64,
    },
    #[error("{device}: the clock does not settle: {difference_ns} ns from the reference")]
    ClockNotSettled {
        device: DeviceRef,
        difference_ns: i32,
    },
    #[error("{device}: could not be brought to rest and disabled: stays in {state}")]
    NotDisabled { device: DeviceRef, state: State },
    #[error("emergency stop: {condition}")]
    EmergencyStop { condition: String },
    #[error(
        "{device}: follows no longer: {reason}{}",
        cause.as_ref().map_or_else(String::new, |cause| format!(": {cause}"))
    )]
    FollowLost {
        device: DeviceRef,
        reason: String,
        /// The error that stopped the group of the axis it followed.
        cause: Option<Arc<RunError>>,
    },
    #[error("{device}: is not enabled: {reason}")]
    EnableRefused { device: DeviceRef, reason: String },
    #[error("{}{device}: stopped with its group `{group}`: {cause}", at(step.as_ref()))]
    GroupStopped {
        device: DeviceRef,
        step: Option<StepRef>,
        group: String,
        /// The error that stopped the group.
        cause: Arc<RunError>,
    },
    #[error("the controller panicked")]
    Controller,
    #[error(
        "the supervisor thread (`ecaxis-mailbox`) did not run for 2 s: the machine was stopped"
    )]
    Unsupervised,
    #[error("interrupted")]
    Interrupted,
    #[error("internal error: {0}")]
    Panicked(String),
}

impl RunError {
    /// Returns the error that caused this one.
    #[must_use]
    pub fn cause(&self) -> Option<&Self> {
        self.shared_cause().map(Arc::as_ref)
    }

    pub(crate) fn shared_cause(&self) -> Option<&Arc<Self>> {
        match self {
            Self::GroupStopped { cause, .. } => Some(cause),
            Self::FollowLost { cause, .. } => cause.as_ref(),
            _ => None,
        }
    }

    /// `true` if the machine had not reached Op yet.
    pub(crate) fn is_on_the_way_to_op(&self) -> bool {
        matches!(
            self,
            Self::State(_)
                | Self::NoProcessData { .. }
                | Self::PhaseNotLocked { .. }
                | Self::ClockNotSettled { .. }
        )
    }

    /// `true` if the cycle stopped the machine because of this error.
    pub(crate) fn is_of_cycle(&self) -> bool {
        matches!(
            self,
            Self::BusLost { .. }
                | Self::LeftOp { .. }
                | Self::LeftOpBriefly { .. }
                | Self::Gone { .. }
                | Self::DriveFault { .. }
                | Self::Trip { .. }
                | Self::FollowLost { .. }
                | Self::EmergencyStop { .. }
                | Self::Controller
                | Self::NotDisabled { .. }
        )
    }
}

/// What a failed device reports in addition to its error code.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct DriveReport {
    /// The device's last emergencies, oldest first.
    pub emergencies: Vec<EmergencyReport>,
    /// The device's diagnosis messages (0x10F3), newest first.
    pub history: Vec<DiagnosisMessage>,
    /// The drive's own limits that the machine file exceeds.
    pub limits: Vec<LimitConflict>,
}

impl fmt::Display for DriveReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for report in &self.emergencies {
            write!(f, "; {}", report.emergency)?;
        }
        for message in &self.history {
            write!(f, "; diagnosis history: {message}")?;
        }
        Ok(())
    }
}

fn al_note(al_status: Option<(u8, u16)>) -> String {
    match al_status {
        Some((status, count)) => {
            let answer = if count == 1 { "answers" } else { "answer" };
            format!(
                "the working counter is wrong; {} {answer}, AL status 0x{status:02x}",
                pluralize(usize::from(count), "SubDevice")
            )
        }
        None => "cyclic frames do not return in time".to_owned(),
    }
}

fn mode_note(confirmed: bool) -> &'static str {
    if confirmed {
        ""
    } else {
        ", the drive has not taken over the mode of operation"
    }
}

fn code_note(code: Option<u16>) -> String {
    match code {
        Some(code) => format!(
            ", error code (0x603F) 0x{code:04x}: {}",
            describe(code).text
        ),
        None => String::new(),
    }
}

fn at(step: Option<&StepRef>) -> String {
    step.map_or_else(String::new, |step| format!("{step}: "))
}

fn lost(group: Option<&str>) -> String {
    match group {
        Some(group) => format!("the process data of the group `{group}` is lost"),
        None => "the bus is lost".to_owned(),
    }
}

fn lost_note(answered: bool, (seen, expected): (u16, u16)) -> String {
    if answered {
        format!("with working counter {seen} instead of {expected}")
    } else {
        "without an answer".to_owned()
    }
}

/// Returns the homing method in words.
fn by(method: i8) -> String {
    match ecaxis_axis::homing::method(method) {
        Some(known) => format!("method {method} ({})", known.text),
        None => format!("method {method}"),
    }
}

/// Returns the message of a panic.
pub(crate) fn panic_text(panic: &(dyn std::any::Any + Send)) -> String {
    panic
        .downcast_ref::<String>()
        .cloned()
        .or_else(|| panic.downcast_ref::<&str>().map(|text| (*text).to_owned()))
        .unwrap_or_else(|| "unknown cause".to_owned())
}
