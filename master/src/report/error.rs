//! Errors of the master: step, place and cause. Hints for the user come from the command line.

use std::borrow::Borrow;
use std::fmt;
use std::net::SocketAddr;
use std::sync::Arc;

use ecaxis_axis::setpoint::LineShaftEnd;
use ecaxis_axis::{CommandError, EnableBlocker, Mode, State, Statusword, Trip};

use crate::config::duration::show;
use crate::config::{LimitConflict, UnitProblem};
use crate::link::second_end::SecondEnd;
use crate::link::{LinkError, OpenError};
use crate::mailbox::{DatagramError, EoeError, EoeSetting, IdnElement, InfoError, SdoError};
use crate::rt::gateway::NodeState;
use crate::rt::image::{NotMapped, TooLarge};
use crate::rt::setpoint_generator::GeneratorError;
use crate::text::rounded;

use super::cause_text::{al_note, blocker_note, by, code_note, list, lost, lost_note};
use super::error_place::{FailedStep, Location};
use super::{DeviceRef, DriveReport, EepromError, StateError};
use ecaxis_ecat::al_state::AlState;
use ecaxis_ecat::al_status_code::al_status_text;
use ecaxis_ecat::mailbox::soe::ValueError;
use ecaxis_esi::address;
use ecaxis_esi::sii::{SiiError, SiiWarning};

/// Modules that differ, as names of the `modules` key.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ModuleDifference {
    pub expected: Vec<String>,
    pub found: Vec<String>,
}

/// An error of the master: the step and the place at which it occurred, and its cause.
#[derive(Debug, thiserror::Error)]
#[error("{}{}{}{cause}", Prefix(step), Prefix(at), Prefix(action))]
pub struct Error {
    pub step: Option<FailedStep>,
    pub at: Option<Location>,
    /// What the master was doing there.
    pub action: Option<&'static str>,
    #[source]
    pub cause: Box<Cause>,
}

struct Prefix<'a, T>(&'a Option<T>);

impl<T: fmt::Display> fmt::Display for Prefix<'_, T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.as_ref().map_or(Ok(()), |part| write!(f, "{part}: "))
    }
}

/// Why something failed.
#[derive(Debug, thiserror::Error)]
pub enum Cause {
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
    #[error("the mailbox gateway cannot listen at {address}: {why}")]
    MailboxGateway { address: SocketAddr, why: String },
    #[error("the link failed: {0}")]
    Link(#[source] LinkError),
    #[error(transparent)]
    TooLarge(TooLarge),
    #[error(transparent)]
    NotMapped(NotMapped),
    #[error(transparent)]
    Axis(ecaxis_axis::ConfigError),
    #[error(
        "no SubDevice answers{}",
        second_end.as_ref().map_or_else(String::new, |end| format!("; {end}"))
    )]
    NoAnswer {
        /// The interface at which the frames arrive instead.
        second_end: Option<SecondEnd>,
    },
    #[error("the units of the drive are not those with which the machine has started")]
    OtherUnits,
    #[error(
        "output 0x{index:04x}:{sub:02x} limits motions, and no axis drives it: it would stay zero"
    )]
    HeldOutput { index: u16, sub: u8 },
    #[error("an optional device of the group is absent")]
    Absent,
    #[error("the SubDevice at position {position} stopped answering while {action}")]
    Silent { position: u16, action: &'static str },
    #[error(transparent)]
    Datagram(DatagramError),
    #[error("register 0x{register:04x} is not answered")]
    NotTaken { register: u16 },
    #[error("no SubDevice has {wanted}; {found}")]
    NotFound { wanted: String, found: String },
    #[error("{count} SubDevices have {wanted}: at positions {positions}")]
    Ambiguous {
        wanted: String,
        count: usize,
        positions: String,
    },
    #[error(transparent)]
    Eeprom(EepromError),
    #[error("its EEPROM: {0}")]
    Sii(#[source] SiiError),
    #[error("its EEPROM is damaged: {0}")]
    DamagedEeprom(SiiWarning),
    #[error("its EEPROM changed during the scan")]
    EepromChanged,
    #[error("the EEPROM describes no mailbox")]
    NoMailbox,
    #[error("is in {state}, where it has no CoE mailbox")]
    WrongState { state: AlState },
    #[error("{}", .0.without_station())]
    Sdo(#[source] SdoError),
    #[error("{setting} by EoE ({values}): {source}")]
    Eoe {
        setting: EoeSetting,
        values: String,
        source: EoeError,
    },
    #[error("the TAP interface `{name}`: {step}: {source}")]
    Tap {
        name: String,
        step: crate::eoe::TapStep,
        source: std::io::Error,
    },
    #[error("{}", .0.without_station())]
    Information(#[source] InfoError),
    /// The scan failed, and no device explains it.
    #[error("{0}")]
    Scan(String),
    #[error(
        "scanning: {found}{} {}; missing: {}",
        if found < expected { format!(" of {expected}") } else { String::new() },
        match (*found, found < expected) {
            (1, true) => "SubDevices answers",
            (1, false) => "SubDevice answers",
            _ => "SubDevices answer",
        },
        crate::text::few(missing)
    )]
    Missing {
        expected: usize,
        found: usize,
        /// Names with positions, in the order of the segment.
        missing: Vec<String>,
    },
    /// Frames do not enter a SubDevice at port 0.
    #[error(
        "scanning: IN and OUT are swapped at {}: frames enter at its port {port} instead of port 0 \
         and reach it at position {position}",
        reversed(candidates)
    )]
    Reversed {
        /// Its position on the bus, after the devices behind it.
        position: u16,
        /// The port at which frames enter.
        port: u8,
        /// Devices of the file that may be the one, with positions.
        candidates: Vec<String>,
    },
    #[error("the SubDevice at position {position} ({identity}) is not in the machine file")]
    Unexpected { position: u16, identity: String },
    #[error(
        "{refusal}; it detects the modules [{}] (0xF050), the file configures [{}]",
        modules.found.join(", "),
        modules.expected.join(", ")
    )]
    Modules {
        modules: ModuleDifference,
        refusal: Box<Cause>,
    },
    #[error("{cause}; it was not ready within {}", show(*timeout_ns))]
    NotReady { timeout_ns: u64, cause: Box<Cause> },
    #[error("identify: the file `{esi}` describes {expected}, the device is {found}")]
    Identity {
        esi: String,
        expected: String,
        found: String,
        /// The expected and the found revision, if nothing else differs.
        revisions: Option<(u32, u32)>,
    },
    #[error("identify: the machine file names serial number {expected}, the device has {found}")]
    Serial { expected: u32, found: u32 },
    #[error(
        "its settings cannot become those of {file}: {}",
        crate::text::few(problems)
    )]
    Settings { file: String, problems: Vec<String> },
    #[error(
        "{object} is {found}, in {file} it is {expected}: its parameters are of another firmware or model"
    )]
    OtherFirmware {
        object: String,
        file: String,
        expected: String,
        found: String,
    },
    #[error("no SubDevice has {locator}")]
    NotLocated { locator: String },
    #[error("start-up SDO {} {name} = {value} (from {origin}): {}", address(*index, *sub), source.cause)]
    StartUp {
        index: u16,
        sub: u8,
        name: String,
        value: String,
        origin: String,
        source: SdoError,
    },
    /// A start-up IDN of a Sercos drive.
    #[error("start-up IDN {at} = {value} (from {origin}): {}", source.cause)]
    StartUpIdn {
        at: IdnElement,
        value: String,
        origin: String,
        source: SdoError,
    },
    /// The value of a start-up IDN does not fit the attribute that the drive reports.
    #[error("start-up IDN {at} (from {origin}): {problem}")]
    IdnValue {
        at: IdnElement,
        origin: String,
        problem: ValueError,
    },
    /// `verify` in the machine file.
    #[error(
        "start-up SDO {object} = {value} (from {origin}) was taken, but the device holds {holds}"
    )]
    NotHeld {
        object: String,
        value: String,
        origin: String,
        holds: String,
    },
    #[error(
        "reading the PDO mapping back: {} holds {actual}, the ESI's layout has {expected}",
        address(*index, *sub)
    )]
    Mapping {
        index: u16,
        sub: u8,
        expected: String,
        actual: String,
    },
    #[error(
        "the drive's units are not those of the machine file: {}",
        list(problems)
    )]
    Units { problems: Vec<UnitProblem> },
    #[error("register 0x{register:04x} holds {found}, wanted is {wanted}")]
    Watchdog {
        register: u16,
        wanted: String,
        found: String,
    },
    #[error("the ESI asks for SYNC0, the device has no distributed clock")]
    NoClock,
    #[error(
        "its clock does not take the time of the reference clock (0x0910), so SYNC0 would drift"
    )]
    ClockDoesNotFollow,
    #[error(
        "starting SYNC0: writing the start time to all devices takes longer than the time until the start"
    )]
    NoStart,
    #[error(
        "its process data need {needed} FMMUs, the controller has {available} (register 0x0004)"
    )]
    Fmmus { needed: usize, available: usize },
    #[error("the device has mailboxes {actual}, the ESI {expected}")]
    MailboxMoved { expected: String, actual: String },
    #[error("no process data comes back in SafeOp: {}", al_note(*al_status))]
    NoProcessData { al_status: Option<(u8, u16)> },
    /// A buffered SyncManager without data does not answer reads, and the working counter is lower.
    #[error(
        "going to Op: does not fill its inputs: SyncManager {sm} (0x{start:04x}, {len} bytes) has no \
         data, so the working counter is too low"
    )]
    NoInputs { sm: u8, start: u16, len: u16 },
    #[error("the release of frames does not lock to SYNC0: phase error {error_ns} ns")]
    PhaseNotLocked { error_ns: i64 },
    #[error(transparent)]
    State(StateError),
    #[error(
        "does not reach Operation enabled within {timeout_ms} ms: stays in {state} \
         (Statusword 0x{statusword:04x}: {}){}{}",
        Statusword::from_bits_retain(*statusword), blocker_note(*waiting), code_note(*code)
    )]
    NotEnabled {
        state: State,
        statusword: u16,
        /// What the axis waits for, if it knows more than the state.
        waiting: Option<EnableBlocker>,
        code: Option<u16>,
        timeout_ms: u64,
    },
    #[error(
        "does not reach Operation enabled within {timeout_ms} ms: node {id} on its CAN network is {state}"
    )]
    NodeNotOperational {
        id: u8,
        state: NodeState,
        timeout_ms: u64,
    },
    #[error(
        "modes of operation display (0x6061) is {}, expected {}",
        Mode::from_code(*display), Mode::from_code(*expected)
    )]
    WrongMode { expected: i8, display: i8 },
    #[error(
        "drive fault (Statusword 0x{statusword:04x}: {}){}{report}",
        Statusword::from_bits_retain(*statusword), code_note(*code)
    )]
    DriveFault {
        code: Option<u16>,
        statusword: u16,
        report: Box<DriveReport>,
    },
    #[error("{trip}")]
    Trip {
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
        "left Op for {state}, AL status code 0x{code:04x} ({})",
        al_status_text(*code)
    )]
    LeftOp { state: AlState, code: u16 },
    #[error("node {id} on its CAN network is {state}")]
    NodeLost { id: u8, state: NodeState },
    #[error("no longer answers")]
    Gone,
    #[error("a SubDevice left Op (AL status 0x{al_status:02x}) and was back when it was asked")]
    LeftOpBriefly { al_status: u8 },
    #[error("command refused: {reason}")]
    Refused {
        reason: String,
        /// The axis's error if the axis refused the command.
        #[source]
        by_axis: Option<Box<CommandError>>,
    },
    #[error(
        "the target of {} {unit} is not reached, the axis is at {actual:.4} {unit}",
        rounded(*target)
    )]
    NotReached {
        /// The target; like `actual` in `unit`.
        target: f64,
        actual: f64,
        unit: String,
    },
    #[error("touch probe {input} is not armed within {timeout_ms} ms (0x60B8, 0x60B9)")]
    ProbeNotArmed { input: u8, timeout_ms: u64 },
    #[error(
        "no {edge} edge came at the input of touch probe {input} on the way to {} {unit}",
        rounded(*target)
    )]
    NotProbed {
        input: u8,
        edge: &'static str,
        target: f64,
        unit: String,
    },
    #[error("`{what}` is not done after {timeout_ms} ms: the drive is in {state}")]
    StepTimeout {
        what: String,
        state: State,
        timeout_ms: u64,
    },
    #[error("modes of operation display (0x6061) does not become {mode}")]
    NotSwitched { mode: Mode },
    #[error("{error}, by {}", by(*method))]
    NotHomed {
        /// The homing method (0x6098).
        method: i8,
        #[source]
        error: ecaxis_axis::homing::HomingError,
    },
    /// A step `alarm` of the program.
    #[error("alarm: {text}")]
    Alarm { text: String },
    #[error("the program did not start at its instant: {why}")]
    StartMissed { why: String },
    #[error("the variable `{name}` would be {value}, outside its range, {low} to {high}")]
    VariableRange {
        name: String,
        value: f64,
        low: f64,
        high: f64,
    },
    #[error(
        "{condition} did not come within {timeout_ms} ms{}",
        if value.is_nan() { String::new() } else { format!(": it is {value}") }
    )]
    WaitTimeout {
        condition: String,
        value: f64,
        timeout_ms: u64,
    },
    #[error("the clock does not settle: {difference_ns} ns from the reference")]
    ClockNotSettled { difference_ns: i32 },
    #[error("could not be brought to rest and disabled: stays in {state}")]
    NotDisabled { state: State },
    #[error(
        "the drive has left Operation enabled for {state}, and no command, stop, trip or fault is recorded"
    )]
    PowerLostWithoutCause { state: State },
    #[error("emergency stop: {condition}")]
    EmergencyStop { condition: String },
    #[error(
        "no longer follows: {}{}",
        reason.map_or_else(|| "another command took over".to_owned(), |reason| reason.to_string()),
        cause.as_ref().map_or_else(String::new, |cause| format!(": {cause}"))
    )]
    FollowLost {
        /// `None`: another command took over the axis.
        reason: Option<GeneratorError>,
        /// The error that stopped the group of the axis it followed.
        #[source]
        cause: Option<Arc<Error>>,
    },
    #[error("cannot follow the line shaft `{name}`, which does not run: {end}")]
    LineShaftWaits { name: String, end: LineShaftEnd },
    #[error("has stopped with the line shaft `{name}`: {end}")]
    LineShaftEnded { name: String, end: LineShaftEnd },
    #[error("is not enabled: {reason}")]
    EnableRefused { reason: String },
    #[error("stopped with its group `{group}`: {cause}")]
    GroupStopped {
        group: String,
        /// The error that stopped the group.
        #[source]
        cause: Arc<Error>,
    },
    #[error("the controller panicked")]
    Controller,
    #[error(
        "the supervisor thread (`ecaxis-services`) did not run for 2 s: the machine was stopped"
    )]
    Unsupervised,
    /// The user stopped the work. Changed states of devices have been restored.
    #[error("interrupted")]
    Interrupted,
    #[error("internal error: {0}")]
    Panicked(String),
}

impl Cause {
    /// Returns the error with this cause at a device.
    #[must_use]
    pub fn with_device(self, device: impl Borrow<DeviceRef>) -> Error {
        Error {
            at: Some(Location::Device(device.borrow().clone())),
            ..self.into()
        }
    }

    /// Returns the error with this cause at a device or signal of the machine file.
    pub(crate) fn with_name(self, name: &str) -> Error {
        Error {
            at: Some(Location::Name(name.to_owned())),
            ..self.into()
        }
    }
}

impl From<Cause> for Error {
    fn from(cause: Cause) -> Self {
        Self {
            step: None,
            at: None,
            action: None,
            cause: Box::new(cause),
        }
    }
}

impl From<OpenError> for Error {
    fn from(error: OpenError) -> Self {
        Cause::Open(error).into()
    }
}

impl Error {
    /// Adds the step.
    pub(crate) fn with_step(self, step: impl Into<FailedStep>) -> Self {
        Self {
            step: Some(step.into()),
            ..self
        }
    }

    /// Adds what the master was doing.
    #[must_use]
    pub fn with_action(self, action: &'static str) -> Self {
        Self {
            action: Some(action),
            ..self
        }
    }

    /// Replaces the cause.
    #[must_use]
    pub(crate) fn map_cause(self, map: impl FnOnce(Box<Cause>) -> Cause) -> Self {
        Self {
            cause: Box::new(map(self.cause)),
            ..self
        }
    }

    /// Removes the device if the error is part of a text that names it.
    #[must_use]
    pub fn without_device(self, device: &DeviceRef) -> Self {
        Self {
            at: (self.device() != Some(device)).then_some(self.at).flatten(),
            ..self
        }
    }

    /// Returns the text without the bring-up as its step.
    pub(crate) fn without_bring_up(&self) -> String {
        let text = self.to_string();
        let prefix = format!("{}: ", FailedStep::BringUp);
        text.strip_prefix(&prefix)
            .map_or(text.clone(), str::to_owned)
    }

    /// `true` if the bus did not come up.
    #[must_use]
    pub fn is_in_bring_up(&self) -> bool {
        self.step == Some(FailedStep::BringUp)
    }

    /// Returns `true` if devices or their power or cable are absent, so that a later attempt to
    /// bring the bus up may succeed.
    #[must_use]
    pub fn is_absence(&self) -> bool {
        match &*self.cause {
            Cause::NoAnswer { second_end } => second_end.is_none(),
            Cause::Open(OpenError::NoCarrier { .. } | OpenError::Down { .. })
            | Cause::Missing { .. } => true,
            // A device that is switched on during the scan, or off again.
            Cause::Silent { .. } | Cause::NotLocated { .. } => self.is_in_bring_up(),
            _ => false,
        }
    }

    /// Returns the device of the error.
    #[must_use]
    pub fn device(&self) -> Option<&DeviceRef> {
        match self.at.as_ref()? {
            Location::Device(device) => Some(device),
            Location::Name(_) => None,
        }
    }

    /// `true` if a signal ended the work.
    #[must_use]
    pub fn is_interruption(&self) -> bool {
        matches!(*self.cause, Cause::Interrupted)
    }

    /// Returns the error that caused this one.
    #[must_use]
    pub fn origin(&self) -> Option<&Self> {
        self.shared_origin().map(Arc::as_ref)
    }

    pub(crate) fn shared_origin(&self) -> Option<&Arc<Self>> {
        match &*self.cause {
            Cause::GroupStopped { cause, .. } => Some(cause),
            Cause::FollowLost { cause, .. } => cause.as_ref(),
            _ => None,
        }
    }

    /// `true` if the machine had not reached Op yet.
    pub(crate) fn is_on_the_way_to_op(&self) -> bool {
        matches!(
            *self.cause,
            Cause::State(_)
                | Cause::NoProcessData { .. }
                | Cause::NoInputs { .. }
                | Cause::PhaseNotLocked { .. }
                | Cause::ClockNotSettled { .. }
        )
    }

    /// `true` if the cycle stopped the machine because of this error.
    pub(crate) fn is_of_cycle(&self) -> bool {
        matches!(
            *self.cause,
            Cause::BusLost { .. }
                | Cause::LeftOp { .. }
                | Cause::LeftOpBriefly { .. }
                | Cause::Gone
                | Cause::DriveFault { .. }
                | Cause::Trip { .. }
                | Cause::FollowLost { .. }
                | Cause::LineShaftEnded { .. }
                | Cause::NodeLost { .. }
                | Cause::EmergencyStop { .. }
                | Cause::Controller
                | Cause::NotDisabled { .. }
                | Cause::PowerLostWithoutCause { .. }
        )
    }
}

fn reversed(candidates: &[String]) -> String {
    match candidates {
        [] => "a SubDevice".to_owned(),
        [device] => device.clone(),
        several => format!("one of {}", several.join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mailbox::{CoeCause, Subject};

    /// Returns the texts of an error's sources, outermost first.
    fn sources(error: &dyn std::error::Error) -> Vec<String> {
        let chain = std::iter::successors(error.source(), |error| error.source());
        chain.map(ToString::to_string).collect()
    }

    #[test]
    fn source_leads_to_the_error_that_began_it() {
        let errno = rustix::io::Errno::NETDOWN;
        let link = Error::from(Cause::Link(LinkError::Send(errno)));
        let end = sources(&link).pop();
        assert_eq!(end, Some(errno.to_string()));
        let abort = CoeCause::Abort(0x0601_0002);
        let sdo = SdoError {
            station: 0x1001,
            asked: Subject::Emptying,
            cause: abort.clone(),
        };
        let sdo = Error::from(Cause::Sdo(sdo));
        assert_eq!(sources(&sdo).pop(), Some(abort.to_string()));
    }
}
