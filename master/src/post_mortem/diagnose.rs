//! Finds the device and the cause. The error that ended a run says what was noticed; the evidence
//! may reveal the cause.

use std::path::Path;

use ecaxis_axis::Trip;

use ecaxis_esi::address;

use super::cause::{DiagnosedCause, Diagnosis};
use super::class::Class;
use super::evidence::{DeviceEvidence, Evidence, Lateness, place};
use super::snapshot::SyncSnapshot;
use crate::acyclic::{AlState, DeviceRef, StateError};
use crate::report::{self, Error};
use ecaxis_ecat::al_state::ERROR as AL_ERROR;
use ecaxis_ecat::al_status_code::{SYNC_LOST, SYNC_MANAGER_WATCHDOG, al_status_text};

/// AL status Init: the state of a device after a power cycle.
const INIT: u8 = AlState::Init.code();
const OP: u8 = AlState::Op.code();
/// Error codes for a following error (CiA 402), used by drives of all vendors.
const FOLLOWING_ERROR: [u16; 2] = [0x8611, 0x8600];

/// An observation, and whether it explains what stopped the run.
struct Seen {
    cause: DiagnosedCause,
    explains: bool,
}

impl Seen {
    fn when(explains: bool, cause: DiagnosedCause) -> Self {
        Self { cause, explains }
    }
}

/// Returns the diagnosis of an error. A pure function: the same error and evidence give the same
/// answer.
#[must_use]
pub fn diagnose(error: &Error, evidence: &Evidence) -> Diagnosis {
    if let Some(origin) = error.origin() {
        return diagnose(origin, evidence);
    }
    let class = Class::of(error, evidence);
    let on_the_bus = class == Class::Bus;
    // Certain causes come first. Occasional trouble also occurs in good runs: late wake-ups,
    // damaged frames. It counts only if it explains what stopped the run.
    let seen = [
        interface(evidence, class),
        restarted(evidence, class),
        out_of_reach(error, evidence, class),
        other_main_device(error, evidence, class),
        no_response(error, evidence),
        overload(error, evidence, class),
        damaged_frames(error, evidence, class),
        loose_link(error, evidence, class),
        late_frames(error, evidence),
        silence(error, evidence).filter(|_| on_the_bus),
    ];
    let mut seen: Vec<Seen> = seen.into_iter().flatten().collect();
    let cause = match seen.iter().position(|seen| seen.explains) {
        Some(first) => {
            let cause = seen.remove(first).cause;
            // A missing device takes its link with it.
            if matches!(
                cause,
                DiagnosedCause::Restarted { .. } | DiagnosedCause::OutOfReach { .. }
            ) {
                let follows = |c: &DiagnosedCause| {
                    matches!(
                        c,
                        DiagnosedCause::OutOfReach { .. } | DiagnosedCause::LinkFlapping { .. }
                    )
                };
                seen.retain(|seen| !follows(&seen.cause));
            }
            cause
        }
        None => device_cause(error, evidence).unwrap_or_else(|| DiagnosedCause::Unexplained {
            text: error.without_bring_up(),
        }),
    };
    // The other observations imply the outage.
    seen.retain(|seen| !matches!(seen.cause, DiagnosedCause::TemporaryOutage { .. }));
    Diagnosis {
        cause,
        also: seen.into_iter().map(|seen| seen.cause).collect(),
    }
}

/// `true` if no frame came back.
fn is_silent(error: &Error) -> bool {
    matches!(
        *error.cause,
        report::Cause::BusLost {
            answered: false,
            ..
        }
    )
}

/// Finds skipped cycles, or wake-ups so late that a device must have noticed.
fn overload(error: &Error, evidence: &Evidence, class: Class) -> Option<Seen> {
    // The default number of lost cycles that the bus monitor tolerates.
    const MISSED: u64 = 3;
    let late = |found: &Lateness| found.missed >= MISSED || found.longest > evidence.cycle_ns;
    let found = evidence.lateness();
    let explains = match class {
        Class::Bus => late(&evidence.lateness_at_stop()),
        Class::Timing => true,
        Class::Device => false,
    };
    late(&found).then(|| {
        let then = explains.then(|| short(error));
        let Lateness { missed, longest } = found;
        Seen::when(
            explains,
            DiagnosedCause::Overload {
                missed,
                longest_ns: longest,
                then,
            },
        )
    })
}

fn other_main_device(error: &Error, evidence: &Evidence, class: Class) -> Option<Seen> {
    let frames = evidence.other_frames();
    if frames == 0 {
        return None;
    }
    // A device that was set to another state has no error; one that left Op by itself has one.
    let sent = |device: &&DeviceEvidence| {
        device
            .look
            .al_status
            // A device in Init may have an error, because it rejected later requests.
            .is_some_and(|status| {
                status & AL_ERROR == 0 && status != OP || status & !AL_ERROR == INIT
            })
            && device.look.station != Some(0)
    };
    let sent = evidence
        .devices
        .iter()
        .find(sent)
        .filter(|_| class == Class::Bus && !evidence.all_in_op());
    let silent = is_silent(error);
    Some(Seen::when(
        class == Class::Bus && (sent.is_some() || !silent),
        DiagnosedCause::OtherMainDevice {
            frames,
            device: sent.map(DeviceEvidence::place),
            state: sent
                .and_then(|device| device.look.al_status)
                .map(|status| AlState::from_status(status).to_string()),
        },
    ))
}

/// Finds a device that lost power: in Init, without an error and without its station address.
fn restarted(evidence: &Evidence, class: Class) -> Option<Seen> {
    let mut devices = evidence.devices.iter().enumerate();
    let (index, device) = devices.find(|(_, device)| {
        let look = &device.look;
        look.station == Some(0) && look.al_status.is_some_and(|status| status & 0x0f == INIT)
    })?;
    // If no device has an address, the bring-up has not assigned any yet.
    let addressed = |device: &DeviceEvidence| device.look.station.is_some_and(|at| at != 0);
    let all = !evidence.devices.iter().any(addressed) && evidence.notes.is_empty();
    let cause = || DiagnosedCause::Restarted {
        device: device.place(),
        behind: downstream(evidence, index).count(),
    };
    (!all).then(|| Seen::when(class == Class::Bus && !evidence.all_in_op(), cause()))
}

fn damaged_frames(error: &Error, evidence: &Evidence, class: Class) -> Option<Seen> {
    // Without a cycle, the counters may hold old errors.
    let some = if evidence.stop.is_none() { 8 } else { 1 };
    let devices = evidence.devices.iter().enumerate();
    let ports = devices.flat_map(|(index, device)| {
        (0..4u8).map(move |port| (device.damaged(usize::from(port)), index, port))
    });
    // Of equal counts, the port nearest to the MainDevice wins.
    let (count, index, port) =
        ports.max_by_key(|(count, index, port)| (*count, std::cmp::Reverse((*index, *port))))?;
    let device = evidence.devices.get(index)?;
    // A single error may be a disturbance. A bad cable damages one frame per lost cycle.
    let enough = match &*error.cause {
        report::Cause::BusLost { .. } => u64::from(count) >= evidence.lost_at_stop(),
        _ => count > 1,
    };
    let cause = || DiagnosedCause::DamagedFrames {
        device: device.place(),
        port,
        partner: evidence.partner(index, port),
        count,
    };
    let explains = class == Class::Bus && (enough || count == u8::MAX);
    (count >= some).then(|| Seen::when(explains, cause()))
}

/// Finds devices that do not process frames although the frames return.
fn out_of_reach(error: &Error, evidence: &Evidence, class: Class) -> Option<Seen> {
    let missing = |device: &DeviceEvidence| device.look.absent || device.look.came_back;
    let mut devices = evidence.devices.iter().enumerate();
    let (index, device) = devices.find(|(_, device)| missing(device))?;
    // Before station addresses are assigned, devices behind a missing one move up by one position.
    let known = match &*error.cause {
        report::Cause::Missing { missing, .. } => missing.first() == Some(&device.place()),
        _ => true,
    };
    if !known {
        return None;
    }
    let link = device.parent.and_then(|(parent, port)| {
        let status = evidence.devices.get(parent)?.look.dl_status?;
        Some(crate::acyclic::topology::has_link(status, port))
    });
    Some(Seen::when(
        class == Class::Bus && !evidence.all_in_op(),
        DiagnosedCause::OutOfReach {
            device: device.place(),
            behind: downstream(evidence, index).filter(|d| missing(d)).count(),
            upstream: evidence.upstream(device),
            link: link.filter(|_| !device.look.came_back),
        },
    ))
}

/// Finds a dead bus: no frame to any device returned.
fn no_response(error: &Error, evidence: &Evidence) -> Option<Seen> {
    let silent = is_silent(error) || matches!(*error.cause, report::Cause::Gone);
    let unknown = |device: &DeviceEvidence| !device.look.answers && !device.look.absent;
    let first = evidence.devices.first()?;
    let cause = || DiagnosedCause::NoResponse {
        first: Some(first.place()),
    };
    (silent && evidence.devices.iter().all(unknown)).then(|| Seen::when(true, cause()))
}

/// Finds frames that return a cycle late: most of those missing at the stop arrived afterwards.
fn late_frames(error: &Error, evidence: &Evidence) -> Option<Seen> {
    let silent = is_silent(error) || matches!(*error.cause, report::Cause::NoProcessData { .. });
    let late = evidence.late_at_stop();
    (late > 0).then(|| {
        Seen::when(
            silent && late * 2 >= evidence.lost_at_stop(),
            DiagnosedCause::LateFrames {
                late,
                cycle_ns: evidence.cycle_ns,
            },
        )
    })
}

/// Finds a temporary outage: all devices answered when asked after the stop.
fn silence(error: &Error, evidence: &Evidence) -> Option<Seen> {
    let silent = match &*error.cause {
        report::Cause::BusLost { answered, .. } => !answered,
        // The AL status code says that the device noticed the outage.
        report::Cause::LeftOp { code, .. } => SYNC_LOST.contains(code),
        _ => false,
    };
    let silence_ns = evidence.silence();
    let back = !evidence.devices.is_empty() && evidence.devices.iter().all(|d| d.look.answers);
    let there = silent && silence_ns > 0 && (back || evidence.all_in_op());
    there.then(|| Seen::when(true, DiagnosedCause::TemporaryOutage { silence_ns }))
}

/// Finds refusals of the network interface.
fn interface(evidence: &Evidence, class: Class) -> Option<Seen> {
    // A few refusals may come from a full queue.
    const SOME: u64 = 3;
    let refused = match evidence.stop {
        Some(_) => evidence.refused(),
        None => evidence.counters.link_errors,
    };
    (refused >= SOME)
        .then(|| Seen::when(class == Class::Bus, DiagnosedCause::Interface { refused }))
}

fn loose_link(error: &Error, evidence: &Evidence, class: Class) -> Option<Seen> {
    let devices = evidence.devices.iter().enumerate();
    let mut ports = devices.flat_map(|(index, device)| {
        let counters = device.recent.lost_links.into_iter().zip(0u8..);
        counters.map(move |(count, port)| (count, index, port))
    });
    let (count, index, port) = ports.find(|(count, ..)| *count > 0)?;
    // A lost link behind the first device shortens the path of the frames, but they still return.
    let silent = is_silent(error);
    let first_cable = (index, port) == (0, 0);
    Some(Seen::when(
        class == Class::Bus && (first_cable || !silent || evidence.lost_at_stop() <= 2),
        DiagnosedCause::LinkFlapping {
            device: evidence.devices.get(index)?.place(),
            port,
            partner: evidence.partner(index, port),
            count,
        },
    ))
}

/// Returns all devices behind this device.
fn downstream(evidence: &Evidence, index: usize) -> impl Iterator<Item = &DeviceEvidence> {
    let hangs = move |device: &&DeviceEvidence| {
        let mut at = device.parent;
        // A parent always precedes its children.
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

fn device_cause(error: &Error, evidence: &Evidence) -> Option<DiagnosedCause> {
    let (device, action) = (error.device(), error.action);
    match &*error.cause {
        report::Cause::LeftOp { state, code } => Some(left_op(device?, *state, *code, evidence)),
        report::Cause::State(StateError::Refused { code, .. }) => {
            sync(device?, *code, true, evidence)
        }
        report::Cause::State(StateError::Timeout {
            wanted: AlState::Op,
            actual: AlState::SafeOp,
            ..
        }) => late_sync(device?, evidence),
        report::Cause::BusLost { .. } | report::Cause::LeftOpBriefly { .. }
            if evidence.all_in_op() =>
        {
            None
        }
        report::Cause::BusLost { .. } | report::Cause::LeftOpBriefly { .. } => {
            let bad = |device: &&DeviceEvidence| {
                let look = &device.look;
                look.al_status.is_some_and(|status| status != OP)
            };
            let device = evidence.devices.iter().find(bad)?;
            let state = AlState::from_status(device.look.al_status?);
            let code = device.look.al_code.unwrap_or(0);
            // A watchdog error is a consequence of a lost bus.
            let cause = code != SYNC_MANAGER_WATCHDOG || evidence.silence() == 0;
            cause.then(|| left_op(&device.at, state, code, evidence))
        }
        report::Cause::Trip {
            trip: Trip::FollowingError { .. },
            ..
        } => interpolation(device?, error, evidence),
        report::Cause::DriveFault {
            code: Some(code), ..
        } if FOLLOWING_ERROR.contains(code) => interpolation(device?, error, evidence),
        // The fault may be in the process data before the AL status is read.
        report::Cause::DriveFault {
            code: Some(0x8100..=0x81ff | 0x8250),
            ..
        } => {
            let device = device?;
            let code = evidence.named(&device.name)?.look.al_code?;
            let expired = code == SYNC_MANAGER_WATCHDOG;
            expired.then(|| left_op(device, AlState::SafeOp, code, evidence))
        }
        report::Cause::NotEnabled { .. } => {
            let device = device?;
            let watchdog = evidence.named(&device.name)?.look.watchdog?;
            let expired = watchdog.time_ns > 0 && watchdog.expired > 0 && !watchdog.in_time;
            expired.then(|| DiagnosedCause::OutputsNotTaken {
                device: place(device),
                watchdog_ns: watchdog.time_ns,
            })
        }
        report::Cause::StartUp {
            index,
            sub,
            name,
            source,
            ..
        } if source.is_timeout() => Some(DiagnosedCause::Mailbox {
            device: place(device?),
            doing: format!("start-up SDO {} {name}", address(*index, *sub)),
        }),
        report::Cause::Sdo(error) if error.is_timeout() => Some(DiagnosedCause::Mailbox {
            device: place(device?),
            doing: action?.to_owned(),
        }),
        report::Cause::Identity {
            esi,
            revisions: Some((expected, found)),
            ..
        } => Some(DiagnosedCause::Revision {
            device: place(device?),
            expected: *expected,
            found: *found,
            esi: Path::new(esi)
                .file_name()
                .map_or_else(|| esi.clone(), |name| name.to_string_lossy().into_owned()),
        }),
        _ => None,
    }
}

fn left_op(device: &DeviceRef, state: AlState, code: u16, evidence: &Evidence) -> DiagnosedCause {
    if code == SYNC_MANAGER_WATCHDOG {
        let others = evidence.devices.iter().filter(|other| {
            other.at.position != device.position
                && other.look.al_code == Some(SYNC_MANAGER_WATCHDOG)
        });
        let look = evidence.named(&device.name).map(|found| &found.look);
        return DiagnosedCause::Watchdog {
            device: place(device),
            others: others.count(),
            silence_ns: evidence.silence(),
            watchdog_ns: look.and_then(|look| Some(look.watchdog?.time_ns)),
        };
    }
    sync(device, code, false, evidence).unwrap_or_else(|| DiagnosedCause::LeftOp {
        device: place(device),
        state: state.to_string(),
        code,
    })
}

fn sync(
    device: &DeviceRef,
    code: u16,
    refused: bool,
    evidence: &Evidence,
) -> Option<DiagnosedCause> {
    if !SYNC_LOST.contains(&code) {
        return None;
    }
    let look = evidence.named(&device.name).map(|found| &found.look);
    let sync = look.and_then(|look| look.sync);
    Some(DiagnosedCause::Sync {
        device: place(device),
        code,
        refused,
        activation: sync.map(|sync| sync.activation),
        next_ns: sync.map(|SyncSnapshot { next_ns, .. }| next_ns),
    })
}

/// Finds a device that waits for a SYNC0 that never arrives.
fn late_sync(device: &DeviceRef, evidence: &Evidence) -> Option<DiagnosedCause> {
    let sync = evidence.named(&device.name)?.look.sync?;
    let cycle = i64::from(sync.cycle_ns);
    let off = sync.activation & 3 != 3 || sync.next_ns < 0 || sync.next_ns > 2 * cycle;
    (cycle > 0 && off).then(|| DiagnosedCause::Sync {
        device: place(device),
        code: 0,
        refused: true,
        activation: Some(sync.activation),
        next_ns: Some(sync.next_ns),
    })
}

fn interpolation(device: &DeviceRef, error: &Error, evidence: &Evidence) -> Option<DiagnosedCause> {
    let drive_ns = evidence.named(&device.name)?.look.interpolation_ns?;
    (drive_ns != evidence.cycle_ns).then(|| DiagnosedCause::Interpolation {
        device: place(device),
        drive_ns,
        cycle_ns: evidence.cycle_ns,
        then: short(error),
    })
}

/// Returns the error's text without its address.
fn short(error: &Error) -> String {
    let name = error.device().map_or("", |device| &device.name);
    match &*error.cause {
        report::Cause::LeftOp { state, code } => format!(
            "`{name}` left Op for {state}, AL status code 0x{code:04x} ({})",
            al_status_text(*code)
        ),
        report::Cause::Trip { trip, .. } => format!("`{name}`: {trip}"),
        report::Cause::BusLost {
            answered: true,
            cycles,
            ..
        } => {
            format!("{cycles} cycles in a row without all of the process data")
        }
        report::Cause::BusLost { cycles, .. } => {
            format!("{cycles} cycles in a row without an answer")
        }
        _ => error.to_string(),
    }
}

#[cfg(test)]
#[path = "diagnose_tests.rs"]
mod tests;
