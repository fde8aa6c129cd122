//! Zenoh sessions, queries with bounds, and signals.

use std::path::Path;
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};

use serde::de::DeserializeOwned;
use tokio::signal::unix::{SignalKind, signal};
use zenoh::Session;
use zenoh::Wait;
use zenoh::handlers::FifoChannelHandler;
use zenoh::pubsub::Subscriber;
use zenoh::query::{ConsolidationMode, Query, QueryTarget};
use zenoh::sample::{Locality, Sample};

use crate::config::{self, Role, ZenohFile};
use crate::error::{Error, Result};
use crate::keys::ALL_ALIVE;
use crate::options::Network;

/// The longest reply, and the longest fault report.
pub const MAX_REPLY: usize = 4 << 20;
/// The replies to a query that are taken.
const MAX_REPLIES: usize = 100_000;
/// The sum of their bytes. The states of 10,000 machines are 6 MB.
const MAX_BYTES: usize = 256 << 20;
/// The queries that wait for an answer.
const MAX_QUERIES: usize = 256;
/// The error that Zenoh adds to the replies when the time is over.
const TIMED_OUT: &str = "Timeout";

/// The time without a further program after which multicast has found all. A lost datagram or
/// connection request is repeated after 1 s.
const NO_MORE: Duration = Duration::from_millis(1200);
/// The looks in this time. They are counted: a computer that stalls has not looked.
const LOOKS: u32 = 20;
/// The longest time for multicast to find all.
const SCOUTING: Duration = Duration::from_secs(5);

/// What a subscription receives.
pub type Samples = Subscriber<FifoChannelHandler<Sample>>;

/// Opens a session. With a role other than a command, this lasts until something answers.
///
/// # Errors
/// Fails if the configuration is wrong, or a command finds no router.
pub async fn open(config: zenoh::Config) -> Result<Session> {
    zenoh::open(config).await.map_err(|error| {
        let text = error.to_string();
        // Zenoh appends the place in its source.
        let text = text.split(" at /").next().unwrap_or_default();
        let text: String = text.chars().take(200).collect();
        Error::new(format!("Zenoh: {text}"))
            .help("check `connect` and the certificates, and that the router runs")
    })
}

/// Subscribes to a key.
///
/// # Errors
/// Fails if the session is closed.
pub async fn subscribe(session: &Session, key: &str) -> Result<Samples> {
    let subscriber = session.declare_subscriber(key).await;
    subscriber.map_err(|error| Error::new(format!("Zenoh: subscribe: {error}")))
}

/// Subscribes to the tokens of all machines, also of those that are there already.
///
/// # Errors
/// Fails if the session is closed.
pub async fn subscribe_tokens(session: &Session) -> Result<Samples> {
    let tokens = session.liveliness().declare_subscriber(ALL_ALIVE);
    let subscriber = tokens.history(true).await;
    subscriber.map_err(|error| Error::new(format!("Zenoh: subscribe: {error}")))
}

/// Returns the configuration of a command.
fn command_config(network: &Network) -> Result<zenoh::Config> {
    let path = network.config.as_deref();
    let mut file: ZenohFile = path.map_or(Ok(ZenohFile::default()), config::read)?;
    if !network.connect.is_empty() {
        let endpoints = network.connect.iter().cloned().map(toml::Value::String);
        let connect = file
            .zenoh
            .entry("connect")
            .or_insert_with(|| toml::Table::new().into());
        if let Some(connect) = connect.as_table_mut() {
            connect.insert(
                "endpoints".to_owned(),
                toml::Value::Array(endpoints.collect()),
            );
        }
    }
    let path = path.unwrap_or(Path::new("the command line"));
    config::zenoh(&file.zenoh, path, Role::Command)
}

/// Opens the session of a command that need not wait for programs that multicast has not found yet:
/// it repeats an order until its machine answers, or subscribes.
///
/// # Errors
/// Fails if the file is wrong or no router answers.
pub async fn open_at_once(network: &Network) -> Result<Session> {
    open(command_config(network)?).await
}

/// Opens the session of a command that queries. Without a router, it waits until multicast has found
/// all programs.
///
/// # Errors
/// Fails if the file is wrong or no router answers.
pub async fn open_observer(network: &Network) -> Result<Session> {
    let config = command_config(network)?;
    let scouts = config.get_json("scouting/multicast/enabled");
    let session = open(config).await?;
    if scouts.is_ok_and(|scouts| scouts == "true") {
        find_programs(&session).await;
    }
    Ok(session)
}

/// Waits until multicast finds no further programs. Zenoh waits for the first ones only.
async fn find_programs(session: &Session) {
    let began = Instant::now();
    let (mut found, mut same) = (0, 0);
    while same < LOOKS && began.elapsed() < SCOUTING {
        tokio::time::sleep(NO_MORE / LOOKS).await;
        let info = session.info();
        let now = info.peers_zid().await.count() + info.routers_zid().await.count();
        same = if now == found { same + 1 } else { 0 };
        found = now;
    }
}

/// A reply: its key and its bytes.
#[derive(Debug, Clone)]
pub struct Reply {
    /// The key.
    pub key: String,
    /// The bytes.
    pub bytes: Vec<u8>,
}

impl Reply {
    /// Reads JSON; `None` for anything else.
    #[must_use]
    pub fn json<T: DeserializeOwned>(&self) -> Option<T> {
        serde_json::from_slice(&self.bytes).ok()
    }
}

/// The replies of all that answer.
#[derive(Debug, Clone, Default)]
pub struct Replies {
    /// The replies; errors are left out.
    pub all: Vec<Reply>,
    /// True if a reply was missing at the end of the time.
    pub incomplete: bool,
}

impl Replies {
    /// Warns if replies are missing.
    pub fn warn_if_incomplete(&self, what: &str, timeout: Duration) {
        if self.incomplete {
            tracing::warn!("{what}: not all have answered within {timeout:?}; some may be missing");
        }
    }
}

/// Asks all that answer to a selector, and returns what came in time.
///
/// # Errors
/// Fails if the session is closed or the selector is wrong.
pub async fn query(session: &Session, selector: &str, timeout: Duration) -> Result<Replies> {
    let failed = |error: zenoh::Error| Error::new(format!("query {selector}: {error}"));
    let replies = session
        .get(selector)
        .target(QueryTarget::All)
        .consolidation(ConsolidationMode::None)
        // An archive needs no answer from itself.
        .allowed_destination(Locality::Remote)
        .timeout(timeout)
        .await
        .map_err(failed)?;
    let (mut taken, mut bytes, mut incomplete) = (Vec::new(), 0, false);
    while let Ok(reply) = replies.recv_async().await {
        let sample = match reply.into_result() {
            Ok(sample) => sample,
            Err(error) => {
                incomplete |= error.payload().to_bytes() == TIMED_OUT.as_bytes();
                continue;
            }
        };
        let length = sample.payload().len();
        if length <= MAX_REPLY && taken.len() < MAX_REPLIES && bytes + length <= MAX_BYTES {
            bytes += length;
            taken.push(Reply {
                key: sample.key_expr().to_string(),
                bytes: sample.payload().to_bytes().into_owned(),
            });
        }
    }
    Ok(Replies {
        all: taken,
        incomplete,
    })
}

/// Starts a thread that answers queries, because replies and the disk block. It ends with the
/// returned callback of a queryable, which drops a query when too many wait.
///
/// # Errors
/// Fails if the system refuses a thread.
pub fn answer_queries(
    answer: impl Fn(Query) + Send + 'static,
) -> Result<impl Fn(Query) + Clone + Send + Sync + 'static> {
    let (queries, waiting) = mpsc::sync_channel(MAX_QUERIES);
    let named = thread::Builder::new().name("queries".to_owned());
    named
        .spawn(move || waiting.into_iter().for_each(answer))
        .map_err(|error| Error::new(format!("starting a thread: {error}")))?;
    Ok(move |query| {
        if queries.try_send(query).is_err() {
            tracing::debug!("a query is dropped: {MAX_QUERIES} wait");
        }
    })
}

/// Replies to a query. A session that is closed meanwhile needs no reply.
pub fn reply(query: &Query, key: &str, bytes: Vec<u8>) {
    if let Err(error) = query.reply(key, bytes).wait() {
        tracing::debug!("reply {key}: {error}");
    }
}

/// Waits for SIGINT or SIGTERM.
///
/// # Errors
/// Fails if the system refuses a handler.
pub async fn terminated() -> Result<()> {
    let failed = |error: std::io::Error| Error::new(format!("signals: {error}"));
    let mut terminate = signal(SignalKind::terminate()).map_err(failed)?;
    let mut interrupt = signal(SignalKind::interrupt()).map_err(failed)?;
    tokio::select! {
        _ = terminate.recv() => {}
        _ = interrupt.recv() => {}
    }
    Ok(())
}
