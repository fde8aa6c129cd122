//! The side of Zenoh: the liveliness token, publications, and one queryable for all keys of the
//! machine.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use ecaxis_client::Machine;
use serde_json::{Value, json};
use tokio::sync::Semaphore;
use tokio::sync::mpsc::Receiver;
use zenoh::Session;
use zenoh::query::Query;

use super::events::{EventIdentity, Events};
use super::reader::{Update, attach_options};
use crate::error::{Error, Result};
use crate::keys::MachineId;
use crate::orders::executor::OrderExecutor;
use crate::orders::order::{OrderReply, Status};
use crate::reports::{ReportId, ReportStore};
use crate::session::reply;

/// The longest request for samples, and the most rows and signals in its answer.
const MAX_SAMPLES: Duration = Duration::from_secs(10);
/// The shortest time between two batches of samples.
const MIN_INTERVAL: Duration = Duration::from_millis(10);
const MAX_ROWS: usize = 20_000;
const MAX_SIGNALS: usize = 32;
/// The requests to the server at the same time. More of them are refused.
const REQUESTS: usize = 4;

/// A machine on Zenoh.
#[derive(Debug)]
pub struct Publisher {
    session: Session,
    id: MachineId,
    store: Arc<ReportStore>,
    events: Arc<Events>,
    socket: Option<PathBuf>,
    /// Without it, the agent only reads.
    orders: Option<Arc<OrderExecutor>>,
    requests: Arc<Semaphore>,
    /// The last state, as it was published.
    state: Option<Vec<u8>>,
}

impl Publisher {
    /// Publishes a machine. Without a socket, only what comes as an update exists.
    #[must_use]
    pub fn new(
        session: Session,
        id: MachineId,
        store: Arc<ReportStore>,
        events: Arc<Events>,
        socket: Option<PathBuf>,
    ) -> Self {
        Self {
            session,
            id,
            store,
            events,
            socket,
            orders: None,
            requests: Arc::new(Semaphore::new(REQUESTS)),
            state: None,
        }
    }

    /// Executes orders, if there is an executor.
    #[must_use]
    pub fn with_orders(self, orders: Option<Arc<OrderExecutor>>) -> Self {
        Self { orders, ..self }
    }

    /// Publishes until the reader ends.
    ///
    /// # Errors
    /// Fails if the session is closed.
    pub async fn run(mut self, mut updates: Receiver<Update>) -> Result<()> {
        let failed = |error: zenoh::Error| Error::new(format!("Zenoh: {error}"));
        let queries = self.session.declare_queryable(self.id.key("**"));
        let queries = queries.await.map_err(failed)?;
        let token = self
            .session
            .liveliness()
            .declare_token(self.id.key("alive"));
        let _token = token.await.map_err(failed)?;
        loop {
            tokio::select! {
                update = updates.recv() => match update {
                    Some(update) => self.publish(update).await,
                    None => return Ok(()),
                },
                query = queries.recv_async() => match query {
                    Ok(query) => self.answer(query).await,
                    Err(_) => return Err(Error::new("Zenoh: the session is closed")),
                },
            }
        }
    }

    async fn publish(&mut self, update: Update) {
        let (suffix, value) = match update {
            Update::State(state) => {
                let bytes = json!(*state).to_string().into_bytes();
                self.state = Some(bytes.clone());
                ("state".to_owned(), bytes)
            }
            Update::Event(event) => {
                let number = event["number"].as_u64().unwrap_or_default();
                (format!("event/{number}"), event.to_string().into_bytes())
            }
            Update::Report(summary) => {
                let bytes = json!(summary).to_string().into_bytes();
                (format!("report/{}", summary.id.as_str()), bytes)
            }
        };
        if let Err(error) = self.session.put(self.id.key(&suffix), value).await {
            tracing::debug!(machine = %self.id, "put {suffix}: {error}");
        }
    }

    async fn answer(&self, query: Query) {
        let keys = query.key_expr();
        let asks = |suffix: &str| {
            let key = zenoh::key_expr::KeyExpr::try_from(self.id.key(suffix));
            key.is_ok_and(|key| keys.intersects(&key))
        };
        if asks("state")
            && let Some(state) = &self.state
        {
            reply(&query, &self.id.key("state"), state.clone()).await;
        }
        if asks("reports") {
            let list = json!(self.store.list()).to_string();
            reply(&query, &self.id.key("reports"), list.into_bytes()).await;
        }
        // Only whole keys: a wildcard shall cause neither work of the server nor an order.
        match MachineId::of_key(keys.as_str()) {
            Some((id, "order")) if id == self.id => {
                let order = query.payload().map(|payload| payload.to_bytes());
                let order = order.unwrap_or_default().into_owned();
                let (orders, key) = (self.orders.clone(), self.id.key("order"));
                // The log of orders is written before the answer.
                tokio::spawn(async move {
                    let receive = move || match orders {
                        Some(orders) => orders.receive(&order),
                        None => OrderReply::new(
                            Status::Refused,
                            "this machine takes no orders: its agent has no table `orders`",
                        ),
                    };
                    if let Ok(answer) = tokio::task::spawn_blocking(receive).await {
                        reply(&query, &key, json!(answer).to_string().into_bytes()).await;
                    }
                });
            }
            Some((id, "events")) if id == self.id => {
                let number = |name| query.parameters().get(name).and_then(|n| n.parse().ok());
                let known = number("time_ns").zip(number("number"));
                let known = known.map(|(time_ns, number)| EventIdentity { time_ns, number });
                let events = json!({"events": self.events.after(known)}).to_string();
                reply(&query, &self.id.key("events"), events.into_bytes()).await;
            }
            Some((id, "samples")) if id == self.id => self.read_samples(query.clone()),
            Some((id, suffix)) if id == self.id => {
                let report = suffix.strip_prefix("report/");
                let report = report.and_then(|id| ReportId::try_from(id.to_owned()).ok());
                if let Some(bytes) = report.and_then(|report| self.store.get(&report)) {
                    reply(&query, &self.id.key(suffix), bytes).await;
                }
            }
            _ => {}
        }
    }

    /// Asks the server in a thread, because its client blocks.
    fn read_samples(&self, query: Query) {
        let key = self.id.key("samples");
        let permit = Arc::clone(&self.requests).try_acquire_owned();
        let socket = self.socket.clone();
        tokio::spawn(async move {
            let answer = match (permit, socket) {
                (Err(_), _) => Err(refusal("busy", "too many requests wait")),
                (_, None) => Err(refusal("absent", "the server is absent")),
                (Ok(permit), Some(socket)) => {
                    let parameters = query.parameters();
                    let signals = parameters.get("signals").unwrap_or_default().to_owned();
                    let seconds = parameters.get("seconds").and_then(|s| s.parse().ok());
                    let work = move || {
                        let _permit = permit;
                        let machine = Machine::attach(&socket, attach_options())?;
                        read_samples(&machine, &signals, seconds.unwrap_or(1.0))
                    };
                    let error = |error: ecaxis_client::Error| refusal(&error.code, &error.cause);
                    match tokio::task::spawn_blocking(work).await {
                        Ok(answer) => answer.map_err(error),
                        Err(_) => Err(refusal("failed", "the request has no answer")),
                    }
                }
            };
            match answer {
                Ok(answer) => reply(&query, &key, answer.to_string().into_bytes()).await,
                Err(error) => drop(query.reply_err(error.to_string()).await),
            }
        });
    }
}

fn refusal(code: &str, message: &str) -> Value {
    json!({"ok": false, "error": {"code": code, "message": message}})
}

/// Reads every cycle's values for some time.
fn read_samples(
    machine: &Machine,
    signals: &str,
    seconds: f64,
) -> std::result::Result<Value, ecaxis_client::Error> {
    let signals: Vec<&str> = signals.split(',').take(MAX_SIGNALS).collect();
    let time = Duration::try_from_secs_f64(seconds).unwrap_or(MAX_SAMPLES);
    let end = Instant::now() + time.min(MAX_SAMPLES);
    let interval = (time / 4).clamp(MIN_INTERVAL, 10 * MIN_INTERVAL);
    let subscription = machine.samples(&signals, interval)?;
    let (mut times, mut rows, mut missed) = (Vec::new(), Vec::new(), 0);
    while rows.len() < MAX_ROWS {
        let rest = end.saturating_duration_since(Instant::now());
        if rest.is_zero() {
            break;
        }
        let Some(mut batch) = subscription.next_within(rest)? else {
            break;
        };
        if let (Value::Array(new_times), Value::Array(new_rows)) =
            (batch["time_ns"].take(), batch["rows"].take())
        {
            times.extend(new_times);
            rows.extend(new_rows);
            missed += batch["missed"].as_u64().unwrap_or_default();
        }
    }
    times.truncate(MAX_ROWS);
    rows.truncate(MAX_ROWS);
    Ok(json!({"signals": signals, "time_ns": times, "rows": rows, "missed": missed}))
}
