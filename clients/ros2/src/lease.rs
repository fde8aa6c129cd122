//! The lease and the cyclic area: a thread that gets them, keeps them, and gets them again.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::cycle::{Columns, Cycle, Message, Report};
use crate::follower::Follower;
use crate::joints::Joint;
use crate::options::Options;
use crate::server::{Commands, Connection, Samples};
use crate::services::LeaseRequest;
use crate::status::NodeStatus;

const TIMEOUT: Duration = Duration::from_secs(10);
/// The longest silence of the node.
const TTL_MS: u64 = 1000;
const RENEW: Duration = Duration::from_millis(250);
/// The pause before the next attempt.
const RETRY: Duration = Duration::from_millis(500);

/// The samples, and where the values of each joint are in a row.
pub type KnownSamples = (Samples, Arc<Vec<Columns>>);

/// What the thread shares with the others.
#[derive(Debug, Clone)]
pub struct Shared {
    pub connection: Arc<Connection>,
    pub joints: Arc<Vec<Joint>>,
    pub options: Arc<Options>,
    pub status: Arc<Mutex<NodeStatus>>,
    /// The samples and the columns of the joints, once they are known.
    pub samples: Arc<Mutex<Option<KnownSamples>>>,
    /// The node ends.
    pub ends: Arc<AtomicBool>,
}

impl Shared {
    /// Changes the state of the node.
    pub fn update(&self, change: impl FnOnce(&mut NodeStatus)) {
        change(&mut self.status.lock().unwrap_or_else(PoisonError::into_inner));
    }
}

/// Keeps the lease until the connection is lost or the node ends.
///
/// # Errors
/// Says why the connection is lost.
pub fn keep_lease(
    shared: &Shared,
    requests: &Receiver<LeaseRequest>,
    messages: Receiver<Message>,
    reports: &Sender<(usize, Report)>,
) -> Result<(), String> {
    // The messages go from one cycle to the next.
    let messages = Arc::new(Mutex::new(messages));
    let mut wanted = true;
    let mut force = false;
    let mut answer = None;
    while !shared.ends.load(Ordering::Relaxed) {
        if wanted {
            let result = attach(shared, force);
            force = false;
            if let Some(answer) = answer.take() {
                let answer: Sender<Result<(), String>> = answer;
                let _ = answer.send(result.as_ref().map(|_| ()).map_err(Clone::clone));
            }
            match result {
                Ok((samples, commands, columns)) => {
                    shared.update(|status| status.no_lease = None);
                    let dt_s = samples.cycle_ns as f64 * 1e-9;
                    let config =
                        |joint| Follower::new(Follower::config(joint, &shared.options, dt_s));
                    let followers = shared.joints.iter().map(config).collect();
                    let mut cycle = Cycle::new(
                        samples,
                        commands,
                        columns,
                        shared.joints.to_vec(),
                        followers,
                        reports.clone(),
                    );
                    let ended = Arc::new(AtomicBool::new(false));
                    let (stop, queue) = (Arc::clone(&ended), Arc::clone(&messages));
                    let thread = thread::Builder::new()
                        .name("cycle".to_owned())
                        .spawn(move || {
                            let queue = queue.lock().unwrap_or_else(PoisonError::into_inner);
                            // Commands from before do not count.
                            while queue.try_recv().is_ok() {}
                            cycle.run(&queue, &stop);
                        });
                    let thread = thread.map_err(|error| format!("no thread: {error}"))?;
                    let kept = keep(shared, requests, &thread);
                    ended.store(true, Ordering::Relaxed);
                    let _ = thread.join();
                    match kept {
                        Kept::Lost(why) => shared.update(|status| status.no_lease = Some(why)),
                        Kept::Take(sender) => (force, answer) = (true, Some(sender)),
                        Kept::Release(sender) => {
                            let released = request(shared, json!({"op": "release"}));
                            let _ = sender.send(released.map(|_| ()));
                            wanted = false;
                            let why = "the service release has given it back".to_owned();
                            shared.update(|status| status.no_lease = Some(why));
                        }
                    }
                    continue;
                }
                Err(why) => shared.update(|status| status.no_lease = Some(why)),
            }
        }
        match requests.recv_timeout(RETRY) {
            Ok(LeaseRequest::Take(sender)) => {
                (wanted, force, answer) = (true, true, Some(sender));
            }
            Ok(LeaseRequest::Release(sender)) => {
                wanted = false;
                let _ = sender.send(Ok(()));
            }
            Err(RecvTimeoutError::Timeout) => {
                // Without this, a lost connection would not be seen.
                request(shared, json!({"op": "hello"}))?;
            }
            Err(RecvTimeoutError::Disconnected) => return Ok(()),
        }
    }
    let _ = request(shared, json!({"op": "release"}));
    Ok(())
}

enum Kept {
    Lost(String),
    Take(Sender<Result<(), String>>),
    Release(Sender<Result<(), String>>),
}

fn request(shared: &Shared, request: Value) -> Result<Value, String> {
    shared
        .connection
        .request(request, TIMEOUT)
        .map_err(|error| error.to_string())
}

/// Gets the lease and the area.
fn attach(shared: &Shared, force: bool) -> Result<(Samples, Commands, Vec<Columns>), String> {
    let bus = request(shared, json!({"op": "state"}))?;
    if bus["bus"]["state"] != "op" {
        let error = bus["bus"]["error"]
            .as_str()
            .map(|error| format!(": {error}"));
        return Err(format!("the bus is not in Op{}", error.unwrap_or_default()));
    }
    let name = &shared.options.name;
    request(
        shared,
        json!({"op": "take", "name": name, "ttl_ms": TTL_MS, "force": force}),
    )?;
    request(shared, json!({"op": "area"}))?;
    let [samples, commands] = shared
        .connection
        .area()
        .ok_or("the server has sent no memory")?;
    let samples = Samples::map(&samples)?;
    let commands = Commands::map(&commands)?;
    let columns = Columns::of_joints(&samples, &shared.joints)?;
    let known = (samples.clone(), Arc::new(columns.clone()));
    *shared
        .samples
        .lock()
        .unwrap_or_else(PoisonError::into_inner) = Some(known);
    Ok((samples, commands, columns))
}

/// Renews the lease until it is lost.
fn keep(
    shared: &Shared,
    requests: &Receiver<LeaseRequest>,
    cycle: &thread::JoinHandle<()>,
) -> Kept {
    let mut next = Instant::now() + RENEW;
    loop {
        let now = Instant::now();
        match requests.recv_timeout(next.saturating_duration_since(now)) {
            Ok(LeaseRequest::Take(sender)) => return Kept::Take(sender),
            Ok(LeaseRequest::Release(sender)) => return Kept::Release(sender),
            Err(RecvTimeoutError::Disconnected) => return Kept::Lost("the node ends".to_owned()),
            Err(RecvTimeoutError::Timeout) => {}
        }
        if cycle.is_finished() {
            return Kept::Lost("the bus has no cycles".to_owned());
        }
        if shared.ends.load(Ordering::Relaxed) {
            return Kept::Lost("the node ends".to_owned());
        }
        if let Err(why) = request(shared, json!({"op": "renew"})) {
            return Kept::Lost(why);
        }
        next = Instant::now() + RENEW;
    }
}
