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
        let mut refused = self.spool(&machine, None)?;
        self.take_events(&machine)?;
        let mut due = Instant::now();
        loop {
            let rest = due.saturating_duration_since(Instant::now());
            if rest.is_zero() {
                let state = machine.request("state", json!({}))?;
                if absent.take().is_some() {
                    tracing::info!(machine = %self.id, "server present");
                }
                // A full disk may have space again.
                if refused.is_some() {
                    refused = self.spool(&machine, refused)?;
                }
                self.publish_state(Some(Serve::read(&hello, &description, &state)));
                due = (due + INTERVAL).max(Instant::now());
            } else if let Some(event) = events.next_within(rest)? {
                let missed = event["event"] == "missed";
                if event["event"] == "fault_report" || missed {
                    refused = self.spool(&machine, refused)?;
                }
                match missed {
                    true => self.take_events(&machine)?,
                    false => self.take_event(&event),
                }
            }
        }
    }

    /// Takes the newest events of the server, of which some may be new.
    fn take_events(&self, machine: &Machine) -> Result<(), ecaxis_client::Error> {
        let answer = machine.request("events", json!({"after": 0}))?;
        for event in answer["events"].as_array().into_iter().flatten() {
            self.take_event(event);
        }
        Ok(())
    }

    fn take_event(&self, event: &Value) {
        if self.events.add(event) {
            self.send(Update::Event(event.clone()));
        }
    }

    /// Takes the reports of the server to the disk, then announces the new ones. Returns the first
    /// refusal of the disk; the log has it unless it is the one before.
    fn spool(
        &self,
        machine: &Machine,
        before: Option<String>,
    ) -> Result<Option<String>, ecaxis_client::Error> {
        let mut refused = None;
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
                    refused.get_or_insert_with(|| format!("report of event {event}: {error}"));
                }
            }
        }
        if let Some(text) = refused.as_ref().filter(|_| refused != before) {
            tracing::error!(machine = %self.id, "spool: {text}");
        }
        Ok(refused)
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

#[cfg(test)]
mod tests {
    use std::io::{BufRead, BufReader, Write};
    use std::os::unix::net::{UnixListener, UnixStream};
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    /// Answers as a server does whose subscription to events misses two of three.
    fn answer(stream: &UnixStream, lists: &AtomicUsize) {
        let event = |n: u64| json!({"event": "fault", "number": n, "time_ns": n});
        let mut stream = stream;
        for line in BufReader::new(stream)
            .lines()
            .map_while(std::io::Result::ok)
        {
            let request: Value = serde_json::from_str(&line).unwrap();
            let mut answer = json!({"id": request["id"], "ok": true, "axes": [], "bus": {}});
            match request["op"].as_str().unwrap() {
                "hello" => answer["protocol"] = json!(1),
                "events" if lists.fetch_add(1, Ordering::SeqCst) > 0 => {
                    answer["events"] = json!([event(1), event(2), event(3)]);
                }
                _ => {}
            }
            writeln!(stream, "{answer}").unwrap();
            if request["op"] == "subscribe" {
                for event in [json!({"event": "missed", "count": 2}), event(3)] {
                    writeln!(stream, "{event}").unwrap();
                }
            }
        }
    }

    #[test]
    fn missed_events_are_read_from_the_list() {
        let folder = tempfile::tempdir().unwrap();
        let socket = folder.path().join("m.sock");
        let listener = UnixListener::bind(&socket).unwrap();
        thread::spawn(move || {
            let lists = Arc::new(AtomicUsize::new(0));
            for stream in listener.incoming().flatten() {
                let lists = Arc::clone(&lists);
                thread::spawn(move || answer(&stream, &lists));
            }
        });
        let (updates, mut published) = tokio::sync::mpsc::channel(64);
        let reader = Reader {
            id: "hall/m1".parse().unwrap(),
            socket,
            page: None,
            store: Arc::new(ReportStore::open(&folder.path().join("spool"), 10).unwrap()),
            events: Arc::default(),
            updates,
        };
        thread::spawn(move || reader.run());
        let (begin, mut numbers) = (Instant::now(), Vec::new());
        while numbers.len() < 3 && begin.elapsed() < Duration::from_secs(20) {
            // At least a state each second.
            if let Update::Event(event) = published.blocking_recv().unwrap() {
                numbers.push(event["number"].as_u64().unwrap());
            }
        }
        assert_eq!(numbers, [1, 2, 3]);
    }
}
