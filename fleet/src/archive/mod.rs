//! The archive: last states, and the history of fault reports and events. It pulls what it lacks by
//! content. It may end at any time, and loses or doubles nothing.

pub mod events;
pub mod machine;

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use serde_json::{Value, json};
use tokio::sync::Semaphore;
use tokio::time::MissedTickBehavior;
use zenoh::Session;
use zenoh::query::Query;
use zenoh::sample::{Sample, SampleKind};

use crate::config::{self, ArchiveFile, Role};
use crate::error::{Error, Result};
use crate::keys::{ALL_ALIVE, ALL_REPORTS, ALL_STATES, EACH_EVENT, EACH_REPORT, MachineId, Name};
use crate::reports::{ReportId, Summary};
use crate::session::{self, Reply};
use machine::ArchivedMachine;

/// The machines of an archive.
const MAX_MACHINES: usize = 10_000;
/// An agent offers at most 500 reports, another archive 1,000: a smaller archive would fetch what
/// it has deleted.
const MIN_REPORTS: usize = 1000;
/// The queries at the same time.
const QUERIES: usize = 16;
/// The time for an answer.
const TIMEOUT: Duration = Duration::from_secs(5);

/// Keeps the history until SIGINT or SIGTERM.
///
/// # Errors
/// Fails if the file is wrong or the folder cannot be read.
pub async fn run(path: &Path) -> Result<()> {
    let file: ArchiveFile = config::read(path)?;
    let mistake = |what: &str| Err(Error::new(format!("{}: {what}", path.display())));
    if file.max_reports < MIN_REPORTS {
        return mistake(&format!("`max_reports` is below {MIN_REPORTS}"));
    }
    if !(0.1..=86_400.0).contains(&file.query_interval_s) {
        return mistake("`query_interval_s` is not 0.1 to 86400");
    }
    let interval = Duration::from_secs_f64(file.query_interval_s);
    let zenoh = config::zenoh(&file.zenoh, path, Role::Service)?;
    let folder = config::resolve(path, &file.folder);
    let machines = load(&folder, file.max_reports).map_err(|error| {
        Error::new(format!("archive {}: {error}", folder.display()))
            .help("give the folder to the user of the archive")
    })?;
    tokio::select! {
        ended = async {
            let session = session::open(zenoh).await?;
            let archive = Arc::new(Archive {
                session,
                folder,
                max_reports: file.max_reports,
                machines: Mutex::new(machines),
                queries: Semaphore::new(QUERIES),
            });
            archive.keep(interval).await
        } => ended,
        ended = session::terminated() => ended,
    }
}

type Machines = BTreeMap<MachineId, Arc<ArchivedMachine>>;

#[derive(Debug)]
struct Archive {
    session: Session,
    folder: PathBuf,
    max_reports: usize,
    machines: Mutex<Machines>,
    queries: Semaphore,
}

/// Opens what an earlier process has kept.
fn load(folder: &Path, max_reports: usize) -> std::io::Result<Machines> {
    fs::create_dir_all(folder)?;
    let mut machines = Machines::new();
    for site in names(folder)? {
        let folder = folder.join(site.to_string());
        for machine in names(&folder)? {
            let folder = folder.join(machine.to_string());
            let site = site.clone();
            let opened = ArchivedMachine::open(&folder, max_reports)?;
            machines.insert(MachineId { site, machine }, Arc::new(opened));
        }
    }
    Ok(machines)
}

fn names(folder: &Path) -> std::io::Result<Vec<Name>> {
    let mut names = Vec::new();
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let name = Name::try_from(entry.file_name().to_string_lossy().into_owned());
        if entry.file_type()?.is_dir() {
            names.extend(name);
        }
    }
    Ok(names)
}

impl Archive {
    async fn keep(self: Arc<Self>, interval: Duration) -> Result<()> {
        let failed = |error: zenoh::Error| Error::new(format!("Zenoh: {error}"));
        let session = &self.session;
        // Replies to the keys below, with the same content as from the machines themselves.
        let mut queryables = Vec::new();
        for key in [ALL_STATES, ALL_REPORTS, EACH_REPORT] {
            let archive = Arc::clone(&self);
            let queryable = session.declare_queryable(key).callback(move |query| {
                tokio::spawn(Arc::clone(&archive).answer(query));
            });
            queryables.push(queryable.await.map_err(failed)?);
        }
        let states = session
            .declare_subscriber(ALL_STATES)
            .await
            .map_err(failed)?;
        let reports = session
            .declare_subscriber(EACH_REPORT)
            .await
            .map_err(failed)?;
        let events = session
            .declare_subscriber(EACH_EVENT)
            .await
            .map_err(failed)?;
        let tokens = session
            .liveliness()
            .declare_subscriber(ALL_ALIVE)
            .history(true);
        let tokens = tokens.await.map_err(failed)?;
        tracing::info!(folder = %self.folder.display(), "archive");
        let mut ticks = tokio::time::interval(interval);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            let closed = |_| Error::new("Zenoh: the session is closed");
            tokio::select! {
                sample = states.recv_async() => self.take_state(&sample.map_err(closed)?),
                sample = reports.recv_async() => self.take_report(&sample.map_err(closed)?),
                sample = events.recv_async() => self.take_event(&sample.map_err(closed)?),
                sample = tokens.recv_async() => {
                    let sample = sample.map_err(closed)?;
                    let id = MachineId::of_key(sample.key_expr().as_str()).map(|(id, _)| id);
                    if let (SampleKind::Put, Some(id)) = (sample.kind(), id) {
                        let archive = Arc::clone(&self);
                        tokio::spawn(async move {
                            archive.query_reports(&id.key("reports")).await;
                            archive.query_events(&id).await;
                        });
                    }
                },
                _ = ticks.tick() => {
                    tokio::spawn(Arc::clone(&self).query_all());
                }
            }
        }
    }

    /// Returns the machine, also a new one; `None` if there are too many, or the disk refuses.
    fn machine(&self, id: &MachineId) -> Option<Arc<ArchivedMachine>> {
        let mut machines = self.machines.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(machine) = machines.get(id) {
            return Some(Arc::clone(machine));
        }
        if machines.len() >= MAX_MACHINES {
            tracing::error!(machine = %id, "the archive has {MAX_MACHINES} machines already");
            return None;
        }
        let folder = self
            .folder
            .join(id.site.to_string())
            .join(id.machine.to_string());
        match ArchivedMachine::open(&folder, self.max_reports) {
            Ok(machine) => {
                let machine = Arc::new(machine);
                machines.insert(id.clone(), Arc::clone(&machine));
                Some(machine)
            }
            Err(error) => {
                tracing::error!(machine = %id, "{}: {error}", folder.display());
                None
            }
        }
    }

    fn all(&self) -> Vec<(MachineId, Arc<ArchivedMachine>)> {
        let machines = self.machines.lock().unwrap_or_else(PoisonError::into_inner);
        machines
            .iter()
            .map(|(id, m)| (id.clone(), Arc::clone(m)))
            .collect()
    }

    fn take_state(&self, sample: &Sample) {
        let reply = Reply {
            key: sample.key_expr().to_string(),
            bytes: sample.payload().to_bytes().into_owned(),
        };
        if let Some(state) = crate::observe::status::state_of(&reply)
            && let Some(machine) = self.machine(&state.id)
        {
            machine.set_state(state);
        }
    }

    fn take_event(&self, sample: &Sample) {
        if let Some((id, _)) = MachineId::of_key(sample.key_expr().as_str())
            && let Ok(event) = serde_json::from_slice::<Value>(&sample.payload().to_bytes())
            && let Some(machine) = self.machine(&id)
        {
            machine.add_event(&id, event);
        }
    }

    fn take_report(self: &Arc<Self>, sample: &Sample) {
        if let Some((id, suffix)) = MachineId::of_key(sample.key_expr().as_str())
            && let Some(report) = suffix.strip_prefix("report/")
            && let Ok(report) = ReportId::try_from(report.to_owned())
        {
            let archive = Arc::clone(self);
            tokio::spawn(async move { archive.fetch(&id, &report).await });
        }
    }

    /// Finds what was neither announced nor there when a machine appeared.
    async fn query_all(self: Arc<Self>) {
        self.query_reports(ALL_REPORTS).await;
        for (id, machine) in self.all() {
            if machine.lacks_events() {
                self.query_events(&id).await;
            }
        }
    }

    async fn query_reports(&self, selector: &str) {
        let replies = {
            let Ok(_permit) = self.queries.acquire().await else {
                return;
            };
            session::query(&self.session, selector, TIMEOUT).await
        };
        for reply in replies.unwrap_or_default() {
            let Some((id, "reports")) = MachineId::of_key(&reply.key) else {
                continue;
            };
            for summary in reply.json::<Vec<Summary>>().unwrap_or_default() {
                self.fetch(&id, &summary.id).await;
            }
        }
    }

    /// Fetches a report unless it is there. Its content proves its id.
    async fn fetch(&self, id: &MachineId, report: &ReportId) {
        let Some(machine) = self.machine(id) else {
            return;
        };
        if machine.reports.contains(report) {
            return;
        }
        let Ok(_permit) = self.queries.acquire().await else {
            return;
        };
        let key = id.key(&format!("report/{}", report.as_str()));
        let replies = session::query(&self.session, &key, TIMEOUT).await;
        let mut replies = replies.unwrap_or_default().into_iter();
        let Some(whole) = replies.find(|reply| ReportId::of(&reply.bytes) == *report) else {
            return;
        };
        // The disk blocks.
        let id = id.clone();
        let added = tokio::task::spawn_blocking(move || machine.add_report(&id, &whole.bytes));
        if let Err(error) = added.await {
            tracing::error!("report: {error}");
        }
    }

    /// Fetches the events that the agent has after the last known one.
    async fn query_events(&self, id: &MachineId) {
        let (Some(machine), Ok(_permit)) = (self.machine(id), self.queries.acquire().await) else {
            return;
        };
        let known = machine.complete_to().map_or(String::new(), |known| {
            format!("?time_ns={};number={}", known.time_ns, known.number)
        });
        let selector = id.key(&format!("events{known}"));
        let replies = session::query(&self.session, &selector, TIMEOUT).await;
        let answer = replies
            .ok()
            .and_then(|replies| replies.first()?.json::<Value>());
        if let Some(Value::Array(events)) = answer.map(|mut answer| answer["events"].take()) {
            machine.complete_events(id, events);
        }
    }

    async fn answer(self: Arc<Self>, query: Query) {
        let keys = query.key_expr().clone();
        let reports = MachineId::of_key(keys.as_str()).and_then(|(id, suffix)| {
            let report = ReportId::try_from(suffix.strip_prefix("report/")?.to_owned()).ok()?;
            Some((id, report))
        });
        if let Some((id, report)) = reports {
            let kept = self.all().into_iter().find(|(other, _)| *other == id);
            if let Some(bytes) = kept.and_then(|(_, machine)| machine.reports.get(&report)) {
                session::reply(
                    &query,
                    &id.key(&format!("report/{}", report.as_str())),
                    bytes,
                )
                .await;
            }
            return;
        }
        let asks = |key: &str| {
            let key = zenoh::key_expr::KeyExpr::try_from(key);
            key.is_ok_and(|key| keys.intersects(&key))
        };
        for (id, machine) in self.all() {
            let key = id.key("state");
            if asks(&key)
                && let Some(state) = machine.state()
            {
                session::reply(&query, &key, json!(state).to_string().into_bytes()).await;
            }
            let key = id.key("reports");
            if asks(&key) && !machine.reports.is_empty() {
                let list = json!(machine.reports.list()).to_string();
                session::reply(&query, &key, list.into_bytes()).await;
            }
        }
    }
}
