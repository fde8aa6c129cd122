//! What the node publishes: joint states, `/diagnostics`, inputs.

use std::sync::mpsc::Receiver;
use std::thread::sleep;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use ecaxis_client::Subscription;
use ros2_client::log::LogLevel;
use ros2_client::{NodeLoggingHandle, Publisher, rosout};
use rustix::time::{ClockId, clock_gettime};
use serde_json::{Value, json};

use crate::cycle::Report;
use crate::joints::Joint;
use crate::lease::{Shared, text};
use crate::messages::{DiagnosticArray, DiagnosticStatus, Header, JointState, Time, level};
use crate::options::Options;
use crate::signals::InputPublisher;
use crate::status::{describe, of_server};

/// The pause between two looks at inputs and problems, and between states without the area.
const PAUSE: Duration = Duration::from_millis(50);
/// The longest time between two diagnostics.
const DIAGNOSTICS: Duration = Duration::from_secs(1);

/// Returns the time of CLOCK_MONOTONIC in ns.
fn monotonic_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

/// Returns the header of a message. `monotonic` is its time in ns of CLOCK_MONOTONIC.
fn header(monotonic: u64) -> Header {
    let unix = || {
        let unix = SystemTime::now().duration_since(UNIX_EPOCH);
        u64::try_from(unix.unwrap_or_default().as_nanos()).unwrap_or(u64::MAX)
    };
    // The clocks are read together: a thread may lose its processor between two readings.
    let together = || {
        let (before, unix, after) = (monotonic_ns(), unix(), monotonic_ns());
        (after - before, unix.saturating_sub(after))
    };
    let nearest = (0..3).map(|_| together()).min();
    let epoch = nearest.map_or(0, |(_, epoch)| epoch);
    Header {
        stamp: Time::from_ns(epoch.saturating_add(monotonic)),
        frame_id: String::new(),
    }
}

/// Publishes the joint states until the node ends.
pub fn publish_states(shared: &Shared, states: &Publisher<JointState>) {
    let joints = &shared.joints;
    while !shared.ends() {
        let Some((mut samples, columns)) = shared.samples() else {
            if let Some(state) = state_of_server(shared) {
                let _ = states.publish(state);
            }
            sleep(PAUSE);
            continue;
        };
        let every = 1.0 / (shared.options.rate * samples.cycle_time().as_secs_f64());
        let every = every.round().max(1.0) as u64;
        let mut next = 0;
        // Without cycles the area may be another one.
        while !shared.ends() && samples.wait().is_ok() {
            if samples.next_cycle() < next {
                continue;
            }
            next = samples.next_cycle() + every;
            let mut state = joint_state(joints, samples.time_ns());
            for (joint, columns) in joints.iter().zip(columns.iter()) {
                let value = |signal| samples.value(signal);
                state.position.push(value(columns.position) * joint.scale);
                state.velocity.push(value(columns.velocity) * joint.scale);
                state.effort.push(joint.effort(value(columns.torque)));
            }
            let _ = states.publish(without_unknown_effort(state));
        }
    }
}

fn joint_state(joints: &[Joint], time_ns: u64) -> JointState {
    JointState {
        header: header(time_ns),
        name: joints.iter().map(|joint| joint.name.clone()).collect(),
        ..JointState::default()
    }
}

fn without_unknown_effort(mut state: JointState) -> JointState {
    if state.effort.iter().all(|effort| effort.is_nan()) {
        state.effort.clear();
    }
    state
}

/// Returns the joint states without the area: until the node has the lease for the first time.
fn state_of_server(shared: &Shared) -> Option<JointState> {
    let answer = shared.machine.request("state", json!({})).ok()?;
    let mut state = joint_state(&shared.joints, answer["time_ns"].as_u64()?);
    for joint in shared.joints.iter() {
        let axis = &answer["axes"][joint.index];
        state
            .position
            .push(axis["position"].as_f64()? * joint.scale);
        state
            .velocity
            .push(axis["velocity"].as_f64()? * joint.scale);
        state.effort.push(joint.effort(axis["torque"].as_f64()?));
    }
    Some(without_unknown_effort(state))
}

/// Publishes diagnostics and inputs until the node ends.
///
/// # Errors
/// Fails if the connection to the server is lost.
pub fn publish_diagnostics(
    shared: &Shared,
    publisher: &Publisher<DiagnosticArray>,
    mut inputs: Vec<InputPublisher>,
    log: &NodeLoggingHandle,
    events: &Subscription,
    reports: &Receiver<(usize, Report)>,
) -> Result<(), String> {
    let mut published = Instant::now() - DIAGNOSTICS;
    let mut said: Vec<DiagnosticStatus> = Vec::new();
    while !shared.ends() {
        let mut news = false;
        while let Ok((index, report)) = reports.try_recv() {
            take_report(shared, index, report);
            news = true;
        }
        while let Some(event) = events.next_within(Duration::ZERO).map_err(text)? {
            news |= take_event(shared, &event);
        }
        if !inputs.is_empty()
            && let Ok(state) = shared.machine.request("state", json!({}))
        {
            inputs.iter_mut().for_each(|input| input.publish(&state));
        }
        let node = shared.options.name.as_str();
        let own = shared.status().diagnostics(node, &shared.joints);
        news |= own != said;
        if news || published.elapsed() >= DIAGNOSTICS {
            published = Instant::now();
            log_changes(log, &said, &own);
            said.clone_from(&own);
            let parts = server_diagnostics(shared, node)
                .into_iter()
                .chain(own)
                .collect();
            let _ = publisher.publish(DiagnosticArray {
                header: header(monotonic_ns()),
                status: parts,
            });
        }
        sleep(PAUSE);
    }
    Ok(())
}

fn server_diagnostics(shared: &Shared, node: &str) -> Vec<DiagnosticStatus> {
    match shared.machine.request("diagnostics", json!({})) {
        Ok(answer) => {
            let parts = answer["diagnostics"].as_array().into_iter().flatten();
            parts.map(|part| of_server(node, part)).collect()
        }
        Err(error) => vec![DiagnosticStatus {
            level: level::ERROR,
            name: format!("{node}: server"),
            message: text(error),
            ..DiagnosticStatus::default()
        }],
    }
}

fn take_report(shared: &Shared, index: usize, report: Report) {
    let Some(joint) = shared.joints.get(index) else {
        return;
    };
    let Options {
        stale_ms,
        start_tolerance,
        ..
    } = *shared.options;
    let described = describe(report, joint, stale_ms, start_tolerance);
    shared.update(|status| {
        if let Some(state) = status.joints.get_mut(index) {
            *state = described;
        }
    });
}

/// Returns true if the event changes diagnostics.
fn take_event(shared: &Shared, event: &Value) -> bool {
    let kind = event["event"].as_str().unwrap_or_default();
    if kind == "area" {
        let axis = event["axis"].as_str().unwrap_or_default();
        let why = event["why"].as_str().unwrap_or_default();
        if let Some(index) = shared.joints.iter().position(|joint| joint.axis == axis) {
            shared.update(|status| {
                if let Some(state) = status.joints.get_mut(index) {
                    *state = (level::WARN, format!("stopped: {why}"));
                }
            });
        }
    }
    let changes = [
        "area",
        "bus",
        "fault",
        "lease",
        "device_lost",
        "device_returned",
        "done",
    ];
    changes.contains(&kind)
}

/// Logs problems that are new or over.
fn log_changes(log: &NodeLoggingHandle, before: &[DiagnosticStatus], now: &[DiagnosticStatus]) {
    for status in now {
        let old = before.iter().find(|old| old.name == status.name);
        if old.is_some_and(|old| old.message == status.message)
            || (old.is_none() && status.level == level::OK)
        {
            continue;
        }
        let text = format!("{}: {}", status.name, status.message);
        eprintln!("{text}");
        let level = if status.level == level::OK {
            LogLevel::Info
        } else {
            LogLevel::Warn
        };
        rosout!(*log, level, "{text}");
    }
}
