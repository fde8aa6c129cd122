//! The archive: last states, and the history of fault reports and events. It pulls what it lacks by
//! content. It may end at any time, and loses or doubles nothing.

pub mod events;
pub mod machine;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use serde_json::{Value, json};
use tokio::sync::mpsc::{self, Receiver, Sender};
use tokio::task::JoinSet;
use tokio::time::MissedTickBehavior;
use zenoh::Session;
use zenoh::key_expr::KeyExpr;
use zenoh::query::Query;
use zenoh::sample::{Sample, SampleKind};

use crate::config::{self, ArchiveFile, Role};
use crate::error::{Error, Result};
use crate::keys::{ALL_REPORTS, ALL_STATES, EACH_EVENT, EACH_REPORT, MachineId, Name};
use crate::reports::{MAX_LIST, ReportId, Summary};
use crate::session::{self, Reply};
use events::MAX_EVENT;
use machine::ArchivedMachine;

/// The machines of an archive.
const MAX_MACHINES: usize = 10_000;
/// An agent offers at most 500 reports, another archive 1,000: a smaller archive would fetch what
/// it has deleted.
const MIN_REPORTS: usize = 1000;
/// The longest state.
const MAX_STATE: usize = 64 << 10;
/// The queries at the same time.
const WORKERS: usize = 16;
/// The work that waits for them. More of it is dropped: the next query of all machines finds it.
const MAX_WORK: usize = 1024;
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
}

/// What an archive may lack.
#[derive(Debug)]
enum Work {
    /// What a machine has that appears.
    Machine(MachineId),
    Report(MachineId, ReportId),
    Events(MachineId),
}

/// Runs what blocks by the disk.
async fn on_disk<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Option<T> {
    let done = tokio::task::spawn_blocking(work).await;
    done.inspect_err(|error| tracing::error!("archive: {error}"))
        .ok()
}

/// Returns the machine and the id of `…/report/ID`.
fn report_of(key: &KeyExpr<'_>) -> Option<(MachineId, ReportId)> {
    let (id, suffix) = MachineId::of_key(key.as_str())?;
    let report = suffix.strip_prefix("report/")?.to_owned();
    Some((id, ReportId::try_from(report).ok()?))
}

/// Returns the list of an answer to `…/events`; `None` if it has none.
fn events_of(mut answer: Value) -> Option<Vec<Value>> {
    match answer.get_mut("events")?.take() {
        Value::Array(events) => Some(events),
        _ => None,
    }
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
        let archive = Arc::clone(&self);
        let answer = session::answer_queries(move |query| archive.answer(&query))?;
        let mut queryables = Vec::new();
        for key in [ALL_STATES, ALL_REPORTS, EACH_REPORT] {
            let queryable = session.declare_queryable(key).callback(answer.clone());
            queryables.push(queryable.await.map_err(failed)?);
        }
        let states = session::subscribe(session, ALL_STATES).await?;
        let reports = session::subscribe(session, EACH_REPORT).await?;
        let events = session::subscribe(session, EACH_EVENT).await?;
        let tokens = session::subscribe_tokens(session).await?;
        tracing::info!(folder = %self.folder.display(), "archive");
        let (work, waiting) = mpsc::channel(MAX_WORK);
        let waiting = Arc::new(tokio::sync::Mutex::new(waiting));
        let mut tasks = JoinSet::new();
        for _ in 0..WORKERS {
            tasks.spawn(Arc::clone(&self).work(Arc::clone(&waiting), work.clone()));
        }
        tasks.spawn(Arc::clone(&self).query_all(interval, work.clone()));
        let offer = |item| {
            if work.try_send(item).is_err() {
                tracing::debug!("{MAX_WORK} queries wait: one more is left to the next interval");
            }
        };
        loop {
            let closed = |_| Error::new("Zenoh: the session is closed");
            tokio::select! {
                sample = states.recv_async() => self.take_state(sample.map_err(closed)?).await,
                sample = reports.recv_async() => {
                    if let Some((id, report)) = report_of(sample.map_err(closed)?.key_expr())
                        && !self.has(&id, &report)
                    {
                        offer(Work::Report(id, report));
                    }
                },
                sample = events.recv_async() => self.take_event(sample.map_err(closed)?).await,
                sample = tokens.recv_async() => {
                    let sample = sample.map_err(closed)?;
                    let id = MachineId::of_key(sample.key_expr().as_str()).map(|(id, _)| id);
                    if let (SampleKind::Put, Some(id)) = (sample.kind(), id) {
                        offer(Work::Machine(id));
                    }
                },
                Some(ended) = tasks.join_next() => {
                    let why = ended.err().map_or_else(String::new, |error| error.to_string());
                    return Err(Error::new(format!("a task of the archive has ended: {why}")));
                }
            }
        }
    }

    /// Does what waits, until the archive ends.
    async fn work(
        self: Arc<Self>,
        waiting: Arc<tokio::sync::Mutex<Receiver<Work>>>,
        more: Sender<Work>,
    ) {
        loop {
            let next = waiting.lock().await.recv().await;
            match next {
                Some(Work::Machine(id)) => {
                    self.query_events(&id).await;
                    for (id, report) in self.query_reports(&id.key("reports")).await {
                        // What is dropped is found by the next query of all machines.
                        let _ = more.try_send(Work::Report(id, report));
                    }
                }
                Some(Work::Report(id, report)) => self.fetch(&id, &report).await,
                Some(Work::Events(id)) => self.query_events(&id).await,
                None => return,
            }
        }
    }

    /// Returns true if the archive has the report.
    fn has(&self, id: &MachineId, report: &ReportId) -> bool {
        let machine = self.known(id);
        machine.is_some_and(|machine| machine.reports.contains(report))
    }

    fn known(&self, id: &MachineId) -> Option<Arc<ArchivedMachine>> {
        let machines = self.machines.lock().unwrap_or_else(PoisonError::into_inner);
        machines.get(id).map(Arc::clone)
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

    async fn take_state(self: &Arc<Self>, sample: Sample) {
        if sample.payload().len() > MAX_STATE {
            return;
        }
        let archive = Arc::clone(self);
        on_disk(move || {
            let reply = Reply {
                key: sample.key_expr().to_string(),
                bytes: sample.payload().to_bytes().into_owned(),
            };
            if let Some(state) = crate::observe::status::state_of(&reply)
                && let Some(machine) = archive.machine(&state.id)
            {
                machine.set_state(state);
            }
        })
        .await;
    }

    async fn take_event(self: &Arc<Self>, sample: Sample) {
        if sample.payload().len() > MAX_EVENT {
            return;
        }
        let archive = Arc::clone(self);
        on_disk(move || {
            if let Some((id, _)) = MachineId::of_key(sample.key_expr().as_str())
                && let Ok(event) = serde_json::from_slice::<Value>(&sample.payload().to_bytes())
                && let Some(machine) = archive.machine(&id)
            {
                machine.add_event(&id, event);
            }
        })
        .await;
    }

    /// Finds what was neither announced nor there when a machine appeared.
    async fn query_all(self: Arc<Self>, interval: Duration, work: Sender<Work>) {
        let mut ticks = tokio::time::interval(interval);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            ticks.tick().await;
            let events = self.all().into_iter().filter(|(_, m)| m.lacks_events());
            let events: Vec<_> = events.map(|(id, _)| Work::Events(id)).collect();
            let reports = self.query_reports(ALL_REPORTS).await;
            let reports = reports.into_iter().map(|(id, r)| Work::Report(id, r));
            for item in events.into_iter().chain(reports) {
                if work.send(item).await.is_err() {
                    return;
                }
            }
        }
    }

    /// Returns the reports that others have and this archive lacks, of each machine not more than a
    /// list has.
    async fn query_reports(&self, selector: &str) -> BTreeSet<(MachineId, ReportId)> {
        let replies = session::query(&self.session, selector, TIMEOUT).await;
        let (mut lacking, mut counts) = (BTreeSet::new(), BTreeMap::<_, usize>::new());
        for reply in replies.unwrap_or_default().all {
            let Some((id, "reports")) = MachineId::of_key(&reply.key) else {
                continue;
            };
            let machine = self.known(&id);
            for summary in reply.json::<Vec<Summary>>().unwrap_or_default() {
                let known = machine.as_ref();
                let count = counts.entry(id.clone()).or_default();
                if *count < MAX_LIST
                    && !known.is_some_and(|machine| machine.reports.contains(&summary.id))
                    && lacking.insert((id.clone(), summary.id))
                {
                    *count += 1;
                }
            }
        }
        lacking
    }

    /// Fetches a report unless it is there. Its content proves its id.
    async fn fetch(self: &Arc<Self>, id: &MachineId, report: &ReportId) {
        if self.has(id, report) {
            return;
        }
        let key = id.key(&format!("report/{}", report.as_str()));
        let replies = session::query(&self.session, &key, TIMEOUT).await;
        let mut replies = replies.unwrap_or_default().all.into_iter();
        let Some(whole) = replies.find(|reply| ReportId::of(&reply.bytes) == *report) else {
            return;
        };
        let (archive, id) = (Arc::clone(self), id.clone());
        on_disk(move || {
            if let Some(machine) = archive.machine(&id) {
                machine.add_report(&id, &whole.bytes);
            }
        })
        .await;
    }

    /// Fetches the events that the agent has after the last known one.
    async fn query_events(self: &Arc<Self>, id: &MachineId) {
        let known = self.known(id).and_then(|machine| machine.complete_to());
        let known = known.map_or(String::new(), |known| {
            format!("?time_ns={};number={}", known.time_ns, known.number)
        });
        let selector = id.key(&format!("events{known}"));
        let replies = session::query(&self.session, &selector, TIMEOUT).await;
        let answer = replies
            .ok()
            .and_then(|replies| replies.all.first()?.json::<Value>());
        if let Some(events) = answer.and_then(events_of) {
            let (archive, id) = (Arc::clone(self), id.clone());
            on_disk(move || {
                if let Some(machine) = archive.machine(&id) {
                    machine.complete_events(&id, events);
                }
            })
            .await;
        }
    }

    fn answer(&self, query: &Query) {
        let keys = query.key_expr();
        if let Some((id, report)) = report_of(keys) {
            let kept = self.known(&id);
            if let Some(bytes) = kept.and_then(|machine| machine.reports.get(&report)) {
                let key = id.key(&format!("report/{}", report.as_str()));
                session::reply(query, &key, bytes);
            }
            return;
        }
        let asks = |key: &str| {
            let key = KeyExpr::try_from(key);
            key.is_ok_and(|key| keys.intersects(&key))
        };
        for (id, machine) in self.all() {
            let key = id.key("state");
            if asks(&key)
                && let Some(state) = machine.state()
            {
                session::reply(query, &key, json!(state).to_string().into_bytes());
            }
            let key = id.key("reports");
            if asks(&key) && !machine.reports.is_empty() {
                let list = json!(machine.reports.list()).to_string();
                session::reply(query, &key, list.into_bytes());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn any_answer_has_events_or_none() {
        for answer in [json!([]), json!(1), json!("x"), json!(null), json!({})] {
            assert_eq!(events_of(answer), None);
        }
        assert_eq!(events_of(json!({"events": 1})), None);
        assert_eq!(events_of(json!({"events": [1]})), Some(vec![json!(1)]));
    }
}
