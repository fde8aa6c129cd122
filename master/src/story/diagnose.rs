//! Which device, which cause. The error that ended a run says what was noticed; the evidence may say what it came from.

use std::path::Path;

use ecaxis_axis::Trip;

use ecaxis_esi::address;

use super::cause::{Cause, Diagnosis};
use super::evidence::{DeviceEvidence, Evidence, Lateness, place};
use super::look::SyncLook;
use crate::al_status::al_status_text;
use crate::bringup::{AlState, BringUpError, DeviceRef, StateError};
use crate::mailbox::SdoError;
use crate::rt::stats::Counters;
use crate::session::RunError;

/// AL status codes that a lost synchronization brings about (ETG.1020).
const SYNC_CODES: [u16; 5] = [0x001a, 0x002c, 0x002d, 0x0032, 0x0034];
const WATCHDOG: u16 = 0x001b;
/// Without Op requested by anybody else, a device that is not there shows this after a power cycle.
const INIT: u8 = 1;
const OP: u8 = 8;
const AL_ERROR: u8 = 0x10;
/// CiA 402: following error, in drives of all vendors.
const FOLLOWING_ERROR: [u16; 2] = [0x8611, 0x8600];

/// Pure: the same error and the same evidence give the same answer.
#[must_use]
pub fn diagnose(error: &RunError, evidence: &Evidence) -> Diagnosis {
    if let RunError::GroupStopped { cause, .. } = error {
        return diagnose(cause, evidence);
    }
    let class = Class::of(error);
    let mut seen: Vec<Cause> = Vec::new();
    // What is certain comes before what may be chance: computers are late and cables see sparks on good days, too.
    seen.extend(interface(evidence));
    seen.extend(other_main_device(evidence, class));
    seen.extend(restarted(evidence));
    seen.extend(out_of_reach(evidence, class));
    seen.extend(overload(error, evidence, class));
    seen.extend(damaged_frames(evidence));
    seen.extend(loose_link(evidence));
    seen.extend(late_frames(evidence));
    seen.extend(nobody_answers(error, evidence));
    if seen.is_empty() {
        seen.extend(silence(error, evidence));
    }
    let explains: fn(&Cause) -> bool = match class {
        Class::Bus => |_| true,
        Class::Timing => |cause| matches!(cause, Cause::Overload { .. }),
        Class::State => |cause| {
            matches!(
                cause,
                Cause::OtherMainDevice {
                    device: Some(_),
                    ..
                }
            )
        },
        // A device may say that the bus is the trouble; it does not say so of itself.
        Class::Device => |_| false,
    };
    if let Some(first) = seen.iter().position(explains) {
        let cause = seen.remove(first);
        // A device that is gone takes a link with it.
        if matches!(cause, Cause::Restarted { .. } | Cause::OutOfReach { .. }) {
            let follows =
                |c: &Cause| matches!(c, Cause::OutOfReach { .. } | Cause::LooseLink { .. });
            seen.retain(|cause| !follows(cause));
        }
        return Diagnosis { cause, also: seen };
    }
    let cause = of_one_device(error, evidence).unwrap_or_else(|| Cause::AsTold {
        text: match error {
            RunError::BringUp(error) => error.to_string(),
            error => error.to_string(),
        },
    });
    Diagnosis { cause, also: seen }
}

/// What an error can be a consequence of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Class {
    /// Frames, cables, devices that are gone, watchdogs.
    Bus,
    /// The moment at which frames come.
    Timing,
    /// A device that does not reach a state, or whose mailbox does not answer: it may have been sent to another state.
    State,
    /// One device, drive or axis, or the file.
    Device,
}

impl Class {
    fn of(error: &RunError) -> Self {
        match error {
            RunError::BusLost { .. }
            | RunError::Gone { .. }
            | RunError::LeftOpBriefly { .. }
            | RunError::NoProcessData { .. } => Self::Bus,
            RunError::DriveFault {
                code: Some(code), ..
            } => match code {
                0x7500..=0x75ff | 0x8100..=0x81ff | 0x8250 | 0x8280..=0x82ff => Self::Bus,
                0x8700..=0x87ff => Self::Timing,
                _ => Self::Device,
            },
            RunError::LeftOp { state, code, .. } => Self::of_state(*state, *code),
            RunError::State(error) => Self::of_change(error),
            RunError::BringUp(error) => match error.as_ref() {
                BringUpError::NoAnswer
                | BringUpError::Scan { .. }
                | BringUpError::Missing { .. }
                | BringUpError::Wire { .. }
                | BringUpError::NotTaken { .. } => Self::Bus,
                BringUpError::State(error) => Self::of_change(error),
                BringUpError::NoStart { .. } => Self::Timing,
                BringUpError::StartUp { source, .. }
                | BringUpError::Mailbox { source, .. }
                | BringUpError::ReadBack { source, .. }
                | BringUpError::ReadUnits { source, .. } => match source {
                    SdoError::Gone { .. } | SdoError::Wire { .. } => Self::Bus,
                    SdoError::Timeout { .. } => Self::State,
                    _ => Self::Device,
                },
                _ => Self::Device,
            },
            RunError::PhaseNotLocked { .. } | RunError::ClockNotSettled { .. } => Self::Timing,
            _ => Self::Device,
        }
    }

    fn of_change(error: &StateError) -> Self {
        match error {
            StateError::Gone { .. } | StateError::Wire { .. } => Self::Bus,
            StateError::Refused { actual, code, .. } => Self::of_state(*actual, *code),
            StateError::Timeout { .. } => Self::State,
        }
    }

    fn of_state(state: AlState, code: u16) -> Self {
        if code == 0 || code == WATCHDOG {
            Self::Bus
        } else if SYNC_CODES.contains(&code) && state == AlState::SafeOp {
            Self::Timing
        } else {
            Self::Device
        }
    }
}

/// Cycles that were left out, or wake-ups so late that a device must have noticed.
fn overload(error: &RunError, evidence: &Evidence, class: Class) -> Option<Cause> {
    // As many as the guard rides through at most by default.
    const MISSED: u64 = 3;
    let Lateness { missed, longest } = evidence.lateness();
    let late = missed >= MISSED || longest > evidence.cycle_ns;
    let then = matches!(class, Class::Bus | Class::Timing).then(|| short(error));
    late.then_some(Cause::Overload {
        missed,
        longest_ns: longest,
        then,
    })
}

fn other_main_device(evidence: &Evidence, class: Class) -> Option<Cause> {
    let frames = evidence.link.main_devices;
    if frames == 0 {
        return None;
    }
    // Whoever was sent to another state shows no error; one that fell by itself does. Before Op, Init alone is a state in which
    // no bring-up leaves a device.
    let elsewhere = |status: u8| match class {
        Class::Bus => status & AL_ERROR == 0 && status != OP,
        Class::State => status == INIT,
        Class::Timing | Class::Device => false,
    };
    let sent = |device: &&DeviceEvidence| {
        device.look.al_status.is_some_and(elsewhere) && device.look.station != Some(0)
    };
    let sent = evidence.devices.iter().find(sent);
    Some(Cause::OtherMainDevice {
        frames,
        device: sent.map(DeviceEvidence::place),
        state: sent
            .and_then(|device| device.look.al_status)
            .map(|status| AlState::from_status(status).to_string()),
    })
}

/// In Init, without an error, without the station address that it was given: it has been without power.
fn restarted(evidence: &Evidence) -> Option<Cause> {
    let mut devices = evidence.devices.iter().enumerate();
    let (index, device) = devices.find(|(_, device)| {
        let look = &device.look;
        look.station == Some(0) && look.al_status.is_some_and(|status| status & 0x0f == INIT)
    })?;
    // A bus of which nobody has an address has not been addressed yet.
    let addressed = |device: &DeviceEvidence| device.look.station.is_some_and(|at| at != 0);
    let all = !evidence.devices.iter().any(addressed) && evidence.notes.is_empty();
    (!all).then(|| Cause::Restarted {
        device: device.place(),
        behind: behind(evidence, index).count(),
    })
}

fn damaged_frames(evidence: &Evidence) -> Option<Cause> {
    // One may be a spark; a bad cable brings more.
    // Where no cycle ran, nobody knows since when.
    let some = if evidence.notes.is_empty() { 8 } else { 2 };
    let devices = evidence.devices.iter().enumerate();
    let ports = devices.flat_map(|(index, device)| {
        (0..4u8).map(move |port| (device.damaged(usize::from(port)), index, port))
    });
    // The first of equals is the one nearer to the MainDevice.
    let (count, index, port) =
        ports.max_by_key(|(count, index, port)| (*count, std::cmp::Reverse((*index, *port))))?;
    let device = evidence.devices.get(index)?;
    (count >= some).then(|| Cause::DamagedFrames {
        device: device.place(),
        port,
        partner: evidence.partner(index, port),
        count,
    })
}

/// Frames come back, and some devices have not touched them.
fn out_of_reach(evidence: &Evidence, class: Class) -> Option<Cause> {
    if class != Class::Bus {
        return None;
    }
    let missing = |device: &DeviceEvidence| device.look.absent || device.look.came_back;
    let mut devices = evidence.devices.iter().enumerate();
    let (index, device) = devices.find(|(_, device)| missing(device))?;
    let link = device.parent.and_then(|(parent, port)| {
        let status = evidence.devices.get(parent)?.look.dl_status?;
        Some(super::ports::has_link(status, port))
    });
    Some(Cause::OutOfReach {
        device: device.place(),
        behind: behind(evidence, index).filter(|d| missing(d)).count(),
        upstream: evidence.upstream(device),
        link: link.filter(|_| !device.look.came_back),
    })
}

/// They were asked, and no frame came back.
fn nobody_answers(error: &RunError, evidence: &Evidence) -> Option<Cause> {
    let silent = matches!(
        error,
        RunError::BusLost {
            answered: false,
            ..
        } | RunError::Gone { .. }
    );
    let unknown = |device: &DeviceEvidence| !device.look.answers && !device.look.absent;
    let first = evidence.devices.first()?;
    (silent && evidence.devices.iter().all(unknown)).then(|| Cause::NobodyAnswers {
        first: Some(first.place()),
    })
}

/// More than one in a row may come of one that was held up.
fn late_frames(evidence: &Evidence) -> Option<Cause> {
    const SOME: u64 = 3;
    let Counters {
        late_frames: late,
        lost_frames: lost,
        ..
    } = evidence.counters;
    // Most of what was missed has come after all.
    (late >= SOME && late >= lost / 2).then_some(Cause::LateFrames {
        late,
        cycle_ns: evidence.cycle_ns,
    })
}

/// They were asked later, and all of them answered.
fn silence(error: &RunError, evidence: &Evidence) -> Option<Cause> {
    let silent = matches!(
        error,
        RunError::BusLost {
            answered: false,
            ..
        }
    );
    let silence_ns = evidence.silence();
    let back = !evidence.devices.is_empty() && evidence.devices.iter().all(|d| d.look.answers);
    (silent && back && silence_ns > 0).then_some(Cause::Silence { silence_ns })
}

/// The network interface did not take frames.
fn interface(evidence: &Evidence) -> Option<Cause> {
    // Once may be a full queue.
    const SOME: u64 = 3;
    let refused = evidence.counters.link_errors;
    (refused >= SOME).then_some(Cause::Interface { refused })
}

fn loose_link(evidence: &Evidence) -> Option<Cause> {
    let devices = evidence.devices.iter().enumerate();
    let mut ports = devices.flat_map(|(index, device)| {
        let counters = device.grown.lost_links.into_iter().zip(0u8..);
        counters.map(move |(count, port)| (count, index, port))
    });
    let (count, index, port) = ports.find(|(count, ..)| *count > 0)?;
    Some(Cause::LooseLink {
        device: evidence.devices.get(index)?.place(),
        port,
        partner: evidence.partner(index, port),
        count,
    })
}

/// Everybody who hangs on this device.
fn behind(evidence: &Evidence, index: usize) -> impl Iterator<Item = &DeviceEvidence> {
    let hangs = move |device: &&DeviceEvidence| {
        let mut at = device.parent;
        // A parent always comes before its children.
        while let Some((parent, _)) = at {
            if parent == index {
                return true;
            }
            at = evidence.devices.get(parent).and_then(|d| d.parent);
        }
        false
    };
    evidence.devices.iter().filter(hangs)
}

fn of_one_device(error: &RunError, evidence: &Evidence) -> Option<Cause> {
    match error {
        RunError::LeftOp {
            device,
            state,
            code,
        } => Some(left_op(device, *state, *code, evidence)),
        RunError::State(StateError::Refused { device, code, .. }) => {
            sync(device, *code, true, evidence)
        }
        RunError::BusLost { .. } | RunError::LeftOpBriefly { .. } => {
            let bad = |device: &&DeviceEvidence| {
                let look = &device.look;
                look.al_status.is_some_and(|status| status != OP)
            };
            let device = evidence.devices.iter().find(bad)?;
            let state = AlState::from_status(device.look.al_status?);
            let code = device.look.al_code.unwrap_or(0);
            // A watchdog is what a lost bus leads to.
            let cause = code != WATCHDOG || evidence.silence() == 0;
            cause.then(|| left_op(&device.at, state, code, evidence))
        }
        RunError::Trip {
            device,
            trip: Trip::FollowingError { .. },
        } => interpolation(device, error, evidence),
        RunError::DriveFault {
            device,
            code: Some(code),
            ..
        } if FOLLOWING_ERROR.contains(code) => interpolation(device, error, evidence),
        RunError::BringUp(error) => bring_up(error, evidence),
        _ => None,
    }
}

fn left_op(device: &DeviceRef, state: AlState, code: u16, evidence: &Evidence) -> Cause {
    if code == WATCHDOG {
        let others = evidence.devices.iter().filter(|other| {
            other.at.position != device.position && other.look.al_code == Some(WATCHDOG)
        });
        let look = evidence.named(&device.name).map(|found| &found.look);
        return Cause::Watchdog {
            device: place(device),
            others: others.count(),
            silence_ns: evidence.silence(),
            watchdog_ns: look.and_then(|look| Some(look.watchdog?.time_ns)),
        };
    }
    sync(device, code, false, evidence).unwrap_or_else(|| Cause::LeftOp {
        device: place(device),
        state: state.to_string(),
        code,
    })
}

fn sync(device: &DeviceRef, code: u16, refused: bool, evidence: &Evidence) -> Option<Cause> {
    if !SYNC_CODES.contains(&code) {
        return None;
    }
    let look = evidence.named(&device.name).map(|found| &found.look);
    let sync = look.and_then(|look| look.sync);
    Some(Cause::Sync {
        device: place(device),
        code,
        refused,
        activation: sync.map(|sync| sync.activation),
        next_ns: sync.map(|SyncLook { next_ns, .. }| next_ns),
    })
}

fn interpolation(device: &DeviceRef, error: &RunError, evidence: &Evidence) -> Option<Cause> {
    let drive_ns = evidence.named(&device.name)?.look.interpolation_ns?;
    (drive_ns != evidence.cycle_ns).then(|| Cause::Interpolation {
        device: place(device),
        drive_ns,
        cycle_ns: evidence.cycle_ns,
        then: short(error),
    })
}

fn bring_up(error: &BringUpError, evidence: &Evidence) -> Option<Cause> {
    match error {
        BringUpError::StartUp {
            device,
            index,
            sub,
            name,
            source: SdoError::Timeout { .. },
            ..
        } => Some(Cause::Mailbox {
            device: place(device),
            doing: format!("start-up SDO {} {name}", address(*index, *sub)),
        }),
        BringUpError::Mailbox {
            device,
            source: SdoError::Timeout { .. },
        } => Some(Cause::Mailbox {
            device: place(device),
            doing: "emptying it".to_owned(),
        }),
        BringUpError::ReadBack {
            device,
            source: SdoError::Timeout { .. },
        } => Some(Cause::Mailbox {
            device: place(device),
            doing: "reading the PDO mapping back".to_owned(),
        }),
        BringUpError::ReadUnits {
            device,
            source: SdoError::Timeout { .. },
        } => Some(Cause::Mailbox {
            device: place(device),
            doing: "asking for its units".to_owned(),
        }),
        BringUpError::Identity {
            device,
            esi,
            revisions: Some((expected, found)),
            ..
        } => Some(Cause::Revision {
            device: place(device),
            expected: *expected,
            found: *found,
            esi: Path::new(esi)
                .file_name()
                .map_or_else(|| esi.clone(), |name| name.to_string_lossy().into_owned()),
        }),
        BringUpError::State(StateError::Refused { device, code, .. }) => {
            sync(device, *code, true, evidence)
        }
        _ => None,
    }
}

/// An error without the address that a person cannot use.
fn short(error: &RunError) -> String {
    match error {
        RunError::LeftOp {
            device,
            state,
            code,
        } => format!(
            "`{}` left Op for {state}, AL status code 0x{code:04x} ({})",
            device.name,
            al_status_text(*code)
        ),
        RunError::Trip { device, trip } => format!("`{}`: {trip}", device.name),
        RunError::BusLost {
            answered: true,
            cycles,
            ..
        } => {
            format!("{cycles} cycles in a row without all of the process data")
        }
        RunError::BusLost { cycles, .. } => format!("{cycles} cycles in a row without an answer"),
        other => other.to_string(),
    }
}

#[cfg(test)]
#[path = "diagnose_tests.rs"]
mod tests;
