//! The side of Zenoh: the liveliness token, publications, and one queryable for all keys of the
//! machine.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use ecaxis_client::Machine;
use serde::Serialize;
use serde_json::{Value, json};
use tokio::runtime::Handle;
use tokio::sync::Semaphore;
use tokio::sync::mpsc::Receiver;
use zenoh::Session;
use zenoh::Wait;
use zenoh::query::Query;

use super::events::{EventIdentity, Events};
use super::reader::{Update, attach_options};
use crate::error::{Error, Result};
use crate::keys::MachineId;
use crate::orders::executor::OrderExecutor;
use crate::orders::order::{MAX_ORDER, OrderReply, Status};
use crate::reports::{ReportId, ReportStore};
use crate::session::{MAX_REPLY, answer_queries, reply};

/// The longest request for samples, and the most bytes of rows and signals in its answer.
const MAX_SAMPLES: Duration = Duration::from_secs(10);
const MAX_ROW_BYTES: usize = MAX_REPLY - (64 << 10);
/// The shortest time between two batches of samples.
const MIN_INTERVAL: Duration = Duration::from_millis(10);
const MAX_SIGNALS: usize = 32;
/// The requests to the server at the same time. More of them are refused.
const REQUESTS: usize = 4;
/// The orders that are checked at the same time. A sender repeats one without an answer.
const ORDERS: usize = 4;

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
    checks: Arc<Semaphore>,
    /// The last state, as it was published.
    state: Mutex<Option<Vec<u8>>>,
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
            checks: Arc::new(Semaphore::new(ORDERS)),
            state: Mutex::default(),
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
    pub async fn run(self, mut updates: Receiver<Update>) -> Result<()> {
        let failed = |error: zenoh::Error| Error::new(format!("Zenoh: {error}"));
        let publisher = Arc::new(self);
        let (answering, runtime) = (Arc::clone(&publisher), Handle::current());
        let answer = answer_queries(move |query| answering.answer(query, &runtime))?;
        publisher.serve(&mut updates, answer).await.map_err(failed)
    }

    async fn serve(
        &self,
        updates: &mut Receiver<Update>,
        answer: impl Fn(Query) + Send + Sync + 'static,
    ) -> zenoh::Result<()> {
        let queries = self.session.declare_queryable(self.id.key("**"));
        let _queries = queries.callback(answer).await?;
        let token = self
            .session
            .liveliness()
            .declare_token(self.id.key("alive"));
        let _token = token.await?;
        while let Some(update) = updates.recv().await {
            self.publish(update).await;
            if self.session.is_closed() {
                return Err("the session is closed".into());
            }
        }
        Ok(())
    }

    fn state(&self) -> std::sync::MutexGuard<'_, Option<Vec<u8>>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    async fn publish(&self, update: Update) {
        let (suffix, value) = match update {
            Update::State(state) => {
                let bytes = json!(*state).to_string().into_bytes();
                *self.state() = Some(bytes.clone());
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

    fn answer(&self, query: Query, runtime: &Handle) {
        let keys = query.key_expr();
        let asks = |suffix: &str| {
            let key = zenoh::key_expr::KeyExpr::try_from(self.id.key(suffix));
            key.is_ok_and(|key| keys.intersects(&key))
        };
        if asks("state")
            && let Some(state) = self.state().clone()
        {
            reply(&query, &self.id.key("state"), state);
        }
        if asks("reports") {
            let list = json!(self.store.list()).to_string();
            reply(&query, &self.id.key("reports"), list.into_bytes());
        }
        // Only whole keys: a wildcard shall cause neither work of the server nor an order.
        match MachineId::of_key(keys.as_str()) {
            Some((id, "order")) if id == self.id => {
                let Ok(permit) = Arc::clone(&self.checks).try_acquire_owned() else {
                    return;
                };
                let (orders, key) = (self.orders.clone(), self.id.key("order"));
                // The log of orders is written before the answer.
                runtime.spawn_blocking(move || {
                    let _permit = permit;
                    let refused = |text: String| OrderReply::new(Status::Refused, text);
                    let order = query.payload().filter(|order| order.len() <= MAX_ORDER);
                    let answer = match (orders, order) {
                        (Some(orders), Some(order)) => orders.receive(&order.to_bytes()),
                        (Some(_), None) => {
                            refused(format!("no order of at most {MAX_ORDER} bytes"))
                        }
                        (None, _) => refused(
                            "this machine takes no orders: its agent has no table `orders`"
                                .to_owned(),
                        ),
                    };
                    reply(&query, &key, json!(answer).to_string().into_bytes());
                });
            }
            Some((id, "events")) if id == self.id => {
                let number = |name| query.parameters().get(name).and_then(|n| n.parse().ok());
                let known = number("time_ns").zip(number("number"));
                let known = known.map(|(time_ns, number)| EventIdentity { time_ns, number });
                let events = json!({"events": self.events.after(known)}).to_string();
                reply(&query, &self.id.key("events"), events.into_bytes());
            }
            Some((id, "samples")) if id == self.id => self.read_samples(query, runtime),
            Some((id, suffix)) if id == self.id => {
                let report = suffix.strip_prefix("report/");
                let report = report.and_then(|id| ReportId::try_from(id.to_owned()).ok());
                if let Some(bytes) = report.and_then(|report| self.store.get(&report)) {
                    reply(&query, &self.id.key(suffix), bytes);
                }
            }
            _ => {}
        }
    }

    /// Asks the server in a thread, because its client blocks.
    fn read_samples(&self, query: Query, runtime: &Handle) {
        let key = self.id.key("samples");
        let permit = Arc::clone(&self.requests).try_acquire_owned();
        let busy = permit.is_err();
        let socket = self.socket.clone();
        let work = move || {
            let answer = match (permit, socket) {
                (Err(_), _) => Err(refusal("busy", "too many requests wait")),
                (_, None) => Err(refusal("absent", "the server is absent")),
                (Ok(_permit), Some(socket)) => {
                    let parameters = query.parameters();
                    let signals = parameters.get("signals").unwrap_or_default();
                    let seconds = parameters.get("seconds").and_then(|s| s.parse().ok());
                    let answer = Machine::attach(&socket, attach_options()).and_then(|machine| {
                        read_samples(&machine, signals, seconds.unwrap_or(1.0))
                    });
                    answer.map_err(|error| refusal(&error.code, &error.cause))
                }
            };
            match answer {
                Ok(answer) => reply(&query, &key, answer.to_string().into_bytes()),
                Err(error) => drop(query.reply_err(error.to_string()).wait()),
            }
        };
        // A busy machine is refused here: these threads are bounded.
        match busy {
            true => work(),
            false => drop(runtime.spawn_blocking(work)),
        }
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
    let mut answer = SampleRows::default();
    while answer.complete {
        let rest = end.saturating_duration_since(Instant::now());
        if rest.is_zero() {
            break;
        }
        let Some(batch) = subscription.next_within(rest)? else {
            break;
        };
        answer.add(batch, MAX_ROW_BYTES);
    }
    let mut answer = json!(answer);
    answer["signals"] = json!(signals);
    Ok(answer)
}

/// The samples of an answer.
#[derive(Debug, Serialize)]
struct SampleRows {
    time_ns: Vec<Value>,
    rows: Vec<Value>,
    missed: u64,
    /// False if the time was too long for one answer.
    complete: bool,
    #[serde(skip)]
    bytes: usize,
}

impl Default for SampleRows {
    fn default() -> Self {
        Self {
            time_ns: Vec::new(),
            rows: Vec::new(),
            missed: 0,
            complete: true,
            bytes: 0,
        }
    }
}

impl SampleRows {
    /// Takes the rows of a batch that fit into the bytes of an answer.
    fn add(&mut self, mut batch: Value, max_bytes: usize) {
        self.missed += batch["missed"].as_u64().unwrap_or_default();
        if let (Value::Array(times), Value::Array(rows)) =
            (batch["time_ns"].take(), batch["rows"].take())
        {
            for (time, row) in times.into_iter().zip(rows) {
                // With a comma each.
                let bytes = time.to_string().len() + row.to_string().len() + 2;
                if self.bytes + bytes > max_bytes {
                    self.complete = false;
                    return;
                }
                self.bytes += bytes;
                self.time_ns.push(time);
                self.rows.push(row);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_fit_into_a_reply() {
        let mut answer = SampleRows::default();
        let row = vec![-0.123_456_789_012_345; MAX_SIGNALS];
        let mut batches = 0;
        while answer.complete {
            let times = vec![1_795_600_000_000_000_000_u64; 100];
            let batch = json!({"time_ns": times, "rows": vec![row.clone(); 100], "missed": 1});
            answer.add(batch, MAX_ROW_BYTES);
            batches += 1;
        }
        assert_eq!(answer.missed, batches);
        assert_eq!(answer.rows.len(), answer.time_ns.len());
        let length = json!(answer).to_string().len();
        assert!((MAX_REPLY / 2..MAX_REPLY).contains(&length), "{length}");
    }
}
