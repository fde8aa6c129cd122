//! Reads the server: its state once a second, its events and fault reports when they happen.

use std::path::PathBuf;
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use ecaxis_client::{Machine, Options};
use serde_json::{Value, json};
use tokio::sync::mpsc::Sender;

use super::events::Events;
use super::state::{Serve, Server, State, unix_time};
use crate::keys::MachineId;
use crate::reports::{self, ReportStore, Summary};

/// The time between two states, and between two attempts to reach the server.
const INTERVAL: Duration = Duration::from_secs(1);

/// Something to publish.
#[derive(Debug)]
pub enum Update {
    /// The state.
    State(Box<State>),
    /// An event of the server, as it says it.
    Event(Value),
    /// A new fault report.
    Report(Summary),
}

/// What the thread of the reader needs.
#[derive(Debug)]
pub struct Reader {
    /// The machine.
    pub id: MachineId,
    /// The control socket of the server.
    pub socket: PathBuf,
    /// The address of the machine's page.
    pub page: Option<String>,
    /// Where fault reports go.
    pub store: Arc<ReportStore>,
    /// The newest events.
    pub events: Arc<Events>,
    /// To Zenoh.
    pub updates: Sender<Update>,
}

/// Returns how the agent connects. It does not take the lease.
#[must_use]
pub fn attach_options() -> Options {
    Options {
        name: "fleet".to_owned(),
        timeout: Duration::ZERO,
        take: false,
        ..Options::default()
    }
}

impl Reader {
    /// Reads until the process ends. An absent server is a state.
    pub fn run(&self) {
        let mut absent = None;
        loop {
            let began = Instant::now();
            let error = match self.read(&mut absent) {
                Ok(ended) => match ended {},
                Err(error) => error.to_string(),
            };
            if absent.as_ref() != Some(&error) {
                tracing::warn!(machine = %self.id, "server absent: {error}");
                absent = Some(error);
            }
            self.publish_state(None);
            thread::sleep(INTERVAL.saturating_sub(began.elapsed()));
        }
    }

    fn read(
        &self,
        absent: &mut Option<String>,
    ) -> Result<std::convert::Infallible, ecaxis_client::Error> {
        let machine = Machine::attach(&self.socket, attach_options())?;
        let hello = machine.request("hello", json!({}))?;
        let description = machine.request("machine", json!({}))?;
        // From here on, no event is missed; those before it are in the lists of the server.
        let events = machine.events()?;
        let mut spooled = self.spool(&machine)?;
        let earlier = machine.request("events", json!({"after": 0}))?;
        for event in earlier["events"].as_array().into_iter().flatten() {
            self.take_event(event);
        }
        let mut due = Instant::now();
        loop {
            let rest = due.saturating_duration_since(Instant::now());
            if rest.is_zero() {
                let state = machine.request("state", json!({}))?;
                if absent.take().is_some() {
                    tracing::info!(machine = %self.id, "server present");
                }
                // A full disk may have space again.
                if !spooled {
                    spooled = self.spool(&machine)?;
                }
                self.publish_state(Some(Serve::read(&hello, &description, &state)));
                due = (due + INTERVAL).max(Instant::now());
            } else if let Some(event) = events.next_within(rest)? {
                // Reports behind a missed event are found, too.
                if event["event"] == "fault_report" || event["event"] == "missed" {
                    spooled = self.spool(&machine)?;
                }
                self.take_event(&event);
            }
        }
    }

    fn take_event(&self, event: &Value) {
        if self.events.add(event) {
            self.send(Update::Event(event.clone()));
        }
    }

    /// Takes the reports of the server to the disk, then announces the new ones. Returns false if the
    /// disk did not take all.
    fn spool(&self, machine: &Machine) -> Result<bool, ecaxis_client::Error> {
        let mut spooled = true;
        let answer = machine.request("fault_reports", json!({}))?;
        for kept in answer["reports"].as_array().into_iter().flatten() {
            let Some(event) = kept["event"].as_u64() else {
                continue;
            };
            let bytes = reports::encode(&self.id, event, &kept["report"]);
            match self.store.add(&bytes) {
                Ok(Some(summary)) => {
                    tracing::info!(machine = %self.id, id = summary.id.as_str(), "fault report");
                    self.send(Update::Report(summary));
                }
                Ok(None) => {}
                Err(error) => {
                    spooled = false;
                    tracing::error!(machine = %self.id, event, "spool: {error}");
                }
            }
        }
        Ok(spooled)
    }

    fn publish_state(&self, serve: Option<Serve>) {
        self.send(Update::State(Box::new(State {
            id: self.id.clone(),
            unix_time: unix_time(),
            agent: env!("CARGO_PKG_VERSION").to_owned(),
            page: self.page.clone(),
            reports: self.store.len(),
            last_event: self.events.last(),
            server: match serve {
                Some(_) => Server::Present,
                None => Server::Absent,
            },
            serve,
        })));
    }

    /// Without Zenoh, updates are dropped.
    fn send(&self, update: Update) {
        let _ = self.updates.try_send(update);
    }
}
