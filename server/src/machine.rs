//! The thread that keeps the machine up: one run after another, until the server ends.

use std::sync::Arc;

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock;
use ecaxis_master::report::{Home, Observer, Progress};
use ecaxis_master::session::{self, Attachments, Options, RetryDelay};
use serde_json::json;

use crate::external::{Hold, external};
use crate::hub::{BusState, BusStatus, Count, Describe, Hub, RunningStep};
use crate::operator::ServerOperator;

/// Runs the machine until the server ends. Blocks.
pub fn keep_up(hub: &Arc<Hub>, options: &Options, stop: &Arc<CancelToken>, describe: &Describe) {
    let mut delay = RetryDelay::default();
    while hub.await_wanted() && !stop.is_cancelled() {
        hub.set_bus(status(BusState::Starting));
        let hold = hub.options.virtual_time.then(|| {
            let hub = Arc::clone(hub);
            Box::new(move || hub.hold_virtual_time(clock::now())) as Hold
        });
        let (controller, client) = external(&hub.machine, &hub.area, hold);
        let attachments = Attachments {
            control: Arc::default(),
            controller: Some(Box::new(controller)),
            operator: Some(Box::new(ServerOperator::new(Arc::clone(hub), client))),
            samples: hub.samples.writer(),
            link: None,
            ethernet: None,
            setpoints: hub.setpoints(),
        };
        let machine = (*hub.machine).clone();
        let mut observer = Reporter {
            hub,
            up_since: None,
        };
        let stop_run = Arc::clone(stop);
        let outcome = session::run_attached(
            machine,
            options.clone(),
            stop_run,
            &mut observer,
            attachments,
        );
        let up_since = observer.up_since;
        if let Some(report) = &outcome.fault_report {
            hub.keep_fault_report(report);
        }
        let Err(error) = outcome.result else {
            hub.fail_all("a client or the end of the server has stopped it");
            hub.set_bus(status(BusState::Down));
            continue;
        };
        let (message, help) = describe(&error);
        tracing::error!(%message, "the run has ended");
        hub.fail_all(&message);
        let up_ns = up_since.map(|since| clock::now().saturating_sub(since));
        let retry = delay.after_failure(up_ns);
        hub.set_bus(BusStatus {
            error: Some(message),
            help,
            retry_s: Some(retry.as_secs_f64()),
            ..status(BusState::Failed)
        });
        if stop.is_cancelled() {
            break;
        }
        hub.await_retry(retry);
    }
}

fn status(state: BusState) -> BusStatus {
    BusStatus {
        state,
        error: None,
        help: None,
        retry_s: None,
        up_since_ns: None,
    }
}

/// Turns the progress of a run into events.
struct Reporter<'h> {
    hub: &'h Hub,
    up_since: Option<u64>,
}

impl Observer for Reporter<'_> {
    fn progress(&mut self, progress: &Progress) {
        let hub = self.hub;
        match progress {
            Progress::Topology(places) => hub.set_places(places.clone()),
            Progress::RingStatus(ring) => hub.set_ring(ring),
            Progress::Mailboxes(mailboxes) => hub.set_mailboxes(mailboxes.clone()),
            Progress::Step(ecaxis_master::bringup::Step::State(
                ecaxis_master::acyclic::AlState::Op,
            )) => {
                let now = hub.now();
                self.up_since = Some(clock::now());
                hub.set_bus(BusStatus {
                    up_since_ns: Some(now),
                    ..status(BusState::Op)
                });
            }
            Progress::Stopping => hub.set_bus(status(BusState::Stopping)),
            Progress::Program { run, step, what } => {
                hub.set_step(RunningStep {
                    step: Some(step.number.clone()),
                    run: *run,
                });
                hub.event(json!({
                    "event": "program", "step": step.number, "line": step.line,
                    "what": what, "run": run,
                }));
            }
            Progress::Captured { capture, .. } => hub.event(json!({
                "event": "captured", "axis": capture.axis, "input": capture.input,
                "position": capture.position,
            })),
            Progress::Emergency(report) => {
                hub.count(Count::Emergency, &report.device);
                hub.event(json!({
                    "event": "emergency", "device": report.device, "text": report.to_string(),
                }));
            }
            Progress::GroupStopped { group, cause } => {
                hub.count(Count::Stop, group);
                hub.event(json!({
                    "event": "group_stopped", "group": group, "why": cause.to_string(),
                }));
            }
            Progress::GroupReleased { group } => {
                hub.event(json!({"event": "group_released", "group": group}));
            }
            Progress::DeviceLost { device, parent } => {
                let parent = parent.as_ref();
                hub.event(json!({
                    "event": "device_lost", "device": device.name,
                    "parent": parent.map(|(name, _)| name), "port": parent.map(|(_, port)| port),
                }));
            }
            Progress::DeviceReturned {
                device,
                after_ns,
                restarted,
                home,
                first,
                ..
            } => hub.event(json!({
                "event": "device_returned", "device": device.name, "after_s": *after_ns as f64 * 1e-9,
                "restarted": restarted, "home_lost": *home == Some(Home::Lost), "first": first,
            })),
            Progress::Ring { text, broken } => {
                hub.event(json!({"event": "ring", "broken": broken, "text": text}));
            }
            Progress::GroupWaits { group } => {
                hub.event(json!({"event": "group_waits", "group": group}));
            }
            Progress::UnknownDevice(device) => {
                let parent = device.parent.as_ref();
                hub.event(json!({
                    "event": "unknown_device", "text": device.to_string(),
                    "identity": device.identity, "serial": device.serial,
                    "parent": parent.map(|(name, _)| name), "port": parent.map(|(_, port)| port),
                    "closed": device.closed,
                }));
            }
            Progress::MailboxGateway { address, write } => hub.event(json!({
                "event": "mailbox_gateway", "address": address.to_string(), "write": write,
            })),
            Progress::Tap(tap) => hub.event(json!({
                "event": "tap", "name": tap.name,
                "address": tap.address.map(|(address, prefix)| format!("{address}/{prefix}")),
            })),
            Progress::Warning(text) => warning(hub, text),
            Progress::Denied(denied) => warning(hub, &denied.to_string()),
            Progress::Overload(risk) => warning(hub, &risk.to_string()),
            Progress::Concern(concern) => warning(hub, &concern.to_string()),
            Progress::Step(_)
            | Progress::PhaseLocked
            | Progress::BringUpTimes(_)
            | Progress::Enabled { .. }
            | Progress::Status(_) => {}
        }
    }
}

fn warning(hub: &Hub, text: &str) {
    hub.event(json!({"event": "warning", "text": text}));
}
