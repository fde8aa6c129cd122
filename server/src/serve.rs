//! The server: its threads, from the start to the end.

use std::io;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread;
use std::time::{Duration, Instant};

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::change_log::ChangeLog;
use ecaxis_master::clock::{Clock, Nanos};
use ecaxis_master::config::Machine;
use ecaxis_master::samples::{SampleLayout, Samples};
use ecaxis_master::session::Options;
use ecaxis_master::supervise::operator::for_manual_mode;
use ecaxis_master::sys::rights;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use sd_notify::NotifyState;
use serde_json::{Map, Value};
use tokio::runtime::Runtime;

use crate::http::{HttpOptions, HttpServer};
use crate::hub::{BusState, Describe, Hub, HubOptions};
use crate::machine::keep_up;
use crate::recorder::{RecordError, Recorder};
use crate::socket::Socket;

/// The period at which samples are taken over, and at which the end is noticed.
const PERIOD: Duration = Duration::from_millis(5);
/// The threads that serve clients of the socket, and those of HTTP.
const WORKERS: usize = 2;
/// The threads that read files and make large answers, at most.
const BLOCKING: usize = 64;
/// The nice value of the threads that serve HTTP: commands over the socket go first.
const HTTP_NICE: i32 = 5;
/// The entries of the change log that may wait for the disk.
const CHANGES: usize = 1024;
/// The size in bytes of a new token.
const TOKEN_BYTES: usize = 16;

/// Settings of the server.
#[derive(Debug, Clone)]
pub struct ServerOptions {
    /// The control socket and its file mode.
    pub socket: Option<(PathBuf, u32)>,
    pub http: Option<HttpOptions>,
    /// The time for which every cycle's samples are kept.
    pub keep_ns: Nanos,
    /// Receives the commands of all clients.
    pub change_log: Option<ChangeLog>,
    /// The MCAP file to which every cycle is recorded.
    pub record: Option<PathBuf>,
}

/// The addresses at which the server listens.
#[derive(Debug, Clone)]
pub struct Listening {
    pub socket: Option<PathBuf>,
    /// With the token, unless it is known.
    pub url: Option<String>,
}

/// The server cannot start or go on.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    #[error("cannot listen at {}: {source}", path.display())]
    Socket { path: PathBuf, source: io::Error },
    #[error("cannot listen at {address}: {source}")]
    Http {
        address: SocketAddr,
        source: io::Error,
    },
    #[error("the system gives no memory for the samples: {0}")]
    Memory(#[source] io::Error),
    #[error("starting a thread: {0}")]
    Thread(#[source] io::Error),
    #[error(transparent)]
    Record(#[from] RecordError),
}

/// The service manager that has started the server, if one has: sd_notify(3).
struct Service {
    /// The interval at which it wants to hear of the server.
    watchdog: Option<Duration>,
    heard: Instant,
    state: Option<BusState>,
}

impl Service {
    fn start() -> Self {
        notify(NotifyState::Ready);
        Self {
            // Half of the time after which the service manager ends the process.
            watchdog: sd_notify::watchdog_enabled().map(|time| time / 2),
            heard: Instant::now(),
            state: None,
        }
    }

    /// Reports the bus when its state changes, and resets the watchdog in time.
    fn alive(&mut self, state: BusState) {
        if self.state.replace(state) != Some(state) {
            notify(NotifyState::Status(&format!("bus: {}", state.name())));
        }
        if self
            .watchdog
            .is_some_and(|every| self.heard.elapsed() >= every)
        {
            self.heard = Instant::now();
            notify(NotifyState::Watchdog);
        }
    }

    fn stops(self) {
        notify(NotifyState::Stopping);
    }
}

/// Does nothing without a service manager.
fn notify(state: NotifyState<'_>) {
    if let Err(error) = sd_notify::notify(&[state]) {
        tracing::warn!(%error, "the service manager cannot be reached");
    }
}

/// Starts a thread that writes the change log: no client waits for the disk.
fn log_changes(log: ChangeLog) -> Result<SyncSender<Map<String, Value>>, ServeError> {
    let (sender, receiver) = sync_channel(CHANGES);
    let work = move || {
        rights::drop_capabilities();
        for entry in receiver {
            if let Err(error) = log.append(entry) {
                tracing::error!(%error, path = %log.path().display(), "the change log");
            }
        }
    };
    let thread = thread::Builder::new().name("ecaxis-changes".to_owned());
    thread.spawn(work).map_err(ServeError::Thread)?;
    Ok(sender)
}

/// Returns a new random token.
///
/// # Errors
/// Fails if the system has no random numbers.
pub fn new_token() -> io::Result<String> {
    let mut bytes = [0; TOKEN_BYTES];
    getrandom::fill(&mut bytes).map_err(io::Error::other)?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

/// Serves the machine until `stop` is cancelled. Blocks.
///
/// # Errors
/// Fails if the server cannot listen, or the recording failed. A failure of the machine is reported
/// to the clients instead.
pub fn serve(
    mut machine: Machine,
    run: Options,
    options: ServerOptions,
    stop: &Arc<CancelToken>,
    describe: Box<Describe>,
    ready: impl FnOnce(&Listening),
) -> Result<(), ServeError> {
    machine = for_manual_mode(machine);
    let outputs = machine.use_all_signals();
    let layout = SampleLayout::new(&machine);
    let samples = Samples::create(layout, options.keep_ns).map_err(ServeError::Memory)?;
    let hub_options = HubOptions {
        control: options.http.as_ref().is_some_and(|http| http.control),
        virtual_time: run.clock == Clock::Virtual,
        changes: options.change_log.clone().map(log_changes).transpose()?,
    };
    let hub = Arc::new(Hub::new(machine, outputs, samples, hub_options));
    raise_file_limit();
    let commands = runtime("ecaxis-commands", rights::drop_capabilities)?;
    let clients = runtime("ecaxis-clients", || {
        rights::drop_capabilities();
        // Without the right, nothing changes.
        let _ = rustix::process::setpriority_process(None, HTTP_NICE);
    })?;
    let socket = commands.block_on(bind_socket(&options))?;
    let http = clients.block_on(bind_http(&hub, &options))?;
    ready(&Listening {
        socket: options.socket.map(|(path, _)| path),
        url: http.as_ref().map(HttpServer::url),
    });
    let record = options.record;
    let recorder = record.map(|path| Recorder::start(path, &hub)).transpose()?;
    let keeper = {
        let (hub, stop) = (Arc::clone(&hub), Arc::clone(stop));
        let work = move || keep_up(&hub, &run, &stop, &describe);
        let thread = thread::Builder::new().name("ecaxis-machine".to_owned());
        thread.spawn(work).map_err(ServeError::Thread)?
    };
    // The keeper alone brings the bus up again.
    rights::drop_capabilities();
    let sampler = {
        let hub = Arc::clone(&hub);
        let work = move || {
            while !hub.is_shut_down() {
                hub.sampler.take_new(&hub.samples);
                thread::sleep(PERIOD);
            }
        };
        let thread = thread::Builder::new().name("ecaxis-samples".to_owned());
        thread.spawn(work).map_err(ServeError::Thread)?
    };
    if let Some(http) = http {
        clients.spawn(http.serve());
    }
    if let Some(socket) = socket {
        let hub = Arc::clone(&hub);
        commands.spawn(async move { socket.serve(&hub).await });
    }
    let mut service = Service::start();
    while !stop.is_cancelled() && !keeper.is_finished() {
        thread::sleep(PERIOD);
        // Also while no run calls the operator.
        hub.expire_lease();
        service.alive(hub.bus_state());
    }
    service.stops();
    hub.shut_down();
    let kept = keeper.join();
    let _ = sampler.join();
    // After the last cycle.
    let recorded = recorder.map_or(Ok(()), Recorder::finish);
    clients.shutdown_timeout(Duration::from_secs(1));
    commands.shutdown_timeout(Duration::from_secs(1));
    match kept {
        Ok(()) => Ok(recorded?),
        Err(panic) => std::panic::resume_unwind(panic),
    }
}

fn runtime(name: &str, start: impl Fn() + Send + Sync + 'static) -> Result<Runtime, ServeError> {
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(WORKERS)
        .max_blocking_threads(BLOCKING)
        .thread_name(name)
        .on_thread_start(start)
        .enable_all()
        .build()
        .map_err(ServeError::Thread)
}

/// Permits as many open files as the system does: none shall be missing for a stop or for the bus.
fn raise_file_limit() {
    let limit = getrlimit(Resource::Nofile);
    let raised = Rlimit {
        current: limit.maximum,
        ..limit
    };
    if let Err(error) = setrlimit(Resource::Nofile, raised) {
        tracing::debug!(%error, "the limit of open files stays");
    }
}

async fn bind_socket(options: &ServerOptions) -> Result<Option<Socket>, ServeError> {
    let Some((path, mode)) = &options.socket else {
        return Ok(None);
    };
    let bound = Socket::bind(path, *mode).map_err(|source| {
        let path = path.clone();
        ServeError::Socket { path, source }
    });
    bound.map(Some)
}

async fn bind_http(
    hub: &Arc<Hub>,
    options: &ServerOptions,
) -> Result<Option<HttpServer>, ServeError> {
    let Some(http) = &options.http else {
        return Ok(None);
    };
    let bound = HttpServer::bind(hub, http.clone()).await;
    let address = http.address;
    bound
        .map(Some)
        .map_err(|source| ServeError::Http { address, source })
}
