//! A connection that stays: requests in, answers, events, states and samples out.

use std::collections::HashSet;
use std::sync::Arc;
use std::time::Duration;

use ecaxis_axis::setpoint::LineShaftPoint;
use ecaxis_ecat::index::AxisIndex;
use ecaxis_master::samples::Samples;
use serde_json::{Map, Value, json};
use tokio::sync::broadcast::error::RecvError;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio::time::{Interval, MissedTickBehavior, interval};

use crate::client::{Answer, Client};
use crate::command::{Op, Request, SetpointPoint, Topic};
use crate::error::{ErrorCode, OpError};
use crate::hub::{Hub, stream_text};
use crate::state;
use crate::tokens::Tokens;

/// The messages that may wait for a slow reader.
const OUTGOING: usize = 32;
/// The bytes of memory that the waiting messages of a client may have.
const BUDGET: usize = 1 << 20;
/// The requests whose answers may wait: for an outcome, or for a slow reader.
const WAITING: usize = 256;
/// With more messages waiting, the client gets no state and no samples.
const BACKLOG: usize = 4;
/// The rows of one batch.
const BATCH: u64 = 4096;
/// The values of one batch: 256 KB.
const BATCH_VALUES: u64 = 1 << 15;

/// A message that waits for its client, and its part of the budget.
pub type Waiting = (Outgoing, OwnedSemaphorePermit);

/// Takes messages to a client, as fast as it reads them.
#[derive(Debug, Clone)]
struct Queue {
    messages: mpsc::Sender<Waiting>,
    budget: Arc<Semaphore>,
}

impl Queue {
    fn new() -> (Self, mpsc::Receiver<Waiting>) {
        let (messages, receiver) = mpsc::channel(OUTGOING);
        let budget = Arc::new(Semaphore::new(BUDGET));
        (Self { messages, budget }, receiver)
    }

    /// Adds a message once there is room for it. False if the client has left.
    async fn send(&self, message: Outgoing) -> bool {
        let bytes = message.bytes().min(BUDGET) as u32;
        let Ok(room) = Arc::clone(&self.budget).acquire_many_owned(bytes).await else {
            return false;
        };
        self.messages.send((message, room)).await.is_ok()
    }

    /// Returns whether a slow client gets neither states nor samples.
    fn is_behind(&self) -> bool {
        self.messages.max_capacity() - self.messages.capacity() > BACKLOG
    }
}

/// A message to the client.
#[derive(Debug)]
pub enum Outgoing {
    Answer(Answer),
    Object(Map<String, Value>),
    Samples(Batch),
}

impl Outgoing {
    /// Returns about how much memory the message has.
    fn bytes(&self) -> usize {
        match self {
            Self::Answer(Answer { body, .. }) | Self::Object(body) => bytes_of_map(body),
            Self::Samples(batch) => {
                let columns = 2 + batch.signals.len();
                columns * batch.rows.len() * size_of::<u64>()
            }
        }
    }
}

fn bytes_of_map(map: &Map<String, Value>) -> usize {
    let entry = |(key, value): (&String, &Value)| key.len() + size_of::<String>() + bytes_of(value);
    map.iter().map(entry).sum()
}

fn bytes_of(value: &Value) -> usize {
    let inner = match value {
        Value::String(text) => text.len(),
        Value::Array(values) => values.iter().map(bytes_of).sum(),
        Value::Object(map) => bytes_of_map(map),
        Value::Null | Value::Bool(_) | Value::Number(_) => 0,
    };
    size_of::<Value>() + inner
}

/// Rows of some signals.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Batch {
    pub first: u64,
    /// Rows missed since the last batch.
    pub missed: u64,
    pub rows: Vec<u64>,
    pub times_ns: Vec<u64>,
    /// The values of each signal.
    pub signals: Vec<Vec<f64>>,
}

impl Batch {
    /// Reads at most `count` rows from `next` on.
    #[must_use]
    pub fn read(samples: &Samples, words: &[usize], next: &mut u64, count: u64) -> Self {
        let mut batch = Self {
            first: *next,
            signals: vec![Vec::new(); words.len()],
            ..Self::default()
        };
        let end = samples.written().min(next.saturating_add(count));
        let mut row = Vec::new();
        while *next < end {
            let oldest = samples.written().saturating_sub(samples.capacity());
            if *next < oldest {
                batch.missed += oldest - *next;
                *next = oldest;
                continue;
            }
            if samples.read(*next, &mut row) {
                batch.rows.push(*next);
                batch.times_ns.push(row[1]);
                for (values, word) in batch.signals.iter_mut().zip(words) {
                    let bits = row.get(*word).copied().unwrap_or_default();
                    values.push(f64::from_bits(bits));
                }
            } else {
                batch.missed += 1;
            }
            *next += 1;
        }
        batch.first = batch.rows.first().copied().unwrap_or(*next);
        batch
    }

    /// Returns the binary frame, see docs/server.md.
    #[must_use]
    pub fn frame(&self) -> Vec<u8> {
        let (rows, signals) = (self.rows.len(), self.signals.len());
        let mut frame = Vec::with_capacity(32 + 8 * rows * (signals + 2));
        let count = |n: usize| u32::try_from(n).unwrap_or(u32::MAX).to_le_bytes();
        frame.extend([1, 0, 0, 0]);
        frame.extend(count(rows));
        frame.extend(count(signals));
        frame.extend([0; 4]);
        frame.extend(self.first.to_le_bytes());
        frame.extend(self.missed.to_le_bytes());
        for number in self.rows.iter().chain(&self.times_ns) {
            frame.extend(number.to_le_bytes());
        }
        for value in self.signals.iter().flatten() {
            frame.extend(value.to_le_bytes());
        }
        frame
    }

    /// Returns the batch as an object with one array for each row.
    #[must_use]
    pub fn object(&self) -> Map<String, Value> {
        let row = |row: usize| -> Vec<Value> {
            // A number that does not exist becomes null.
            let values = self.signals.iter().map(|values| json!(values.get(row)));
            values.collect()
        };
        let rows: Vec<_> = (0..self.rows.len()).map(row).collect();
        let mut object = Map::new();
        object.insert("event".to_owned(), json!("samples"));
        object.insert("first".to_owned(), json!(self.first));
        object.insert("missed".to_owned(), json!(self.missed));
        object.insert("time_ns".to_owned(), json!(self.times_ns));
        object.insert("rows".to_owned(), json!(rows));
        object
    }
}

/// Returns the words of signals; all without names.
///
/// # Errors
/// Fails if a name is unknown.
pub fn signal_words(samples: &Samples, names: Option<&[String]>) -> Result<Vec<usize>, OpError> {
    let layout = samples.layout();
    let Some(names) = names else {
        return Ok(layout.signals.iter().map(|signal| signal.word).collect());
    };
    let word = |name: &String| {
        layout
            .signal(name)
            .map(|signal| signal.word)
            .ok_or_else(|| {
                let message = format!("no signal is called `{name}`");
                OpError::new(ErrorCode::UnknownName, message)
                    .help("`machine` lists them under `samples`")
            })
    };
    names.iter().map(word).collect()
}

#[derive(Debug)]
struct SampleSubscription {
    words: Vec<usize>,
    next: u64,
    timer: Interval,
}

/// The set-points of axes for other machines.
#[derive(Debug)]
struct SetpointSubscription {
    /// Each axis, and the instant of the last point that was sent.
    axes: Vec<(AxisIndex, u64)>,
    timer: Interval,
}

#[derive(Debug)]
enum Change {
    Subscribe {
        topics: Vec<Topic>,
        axis: Option<AxisIndex>,
        interval: Duration,
        words: Vec<usize>,
        /// The first sample to send.
        next: u64,
    },
    Unsubscribe(Vec<Topic>),
}

/// The end that takes requests. Dropping it ends the connection.
#[derive(Debug)]
pub struct Connection {
    client: Arc<Client>,
    changes: mpsc::UnboundedSender<Change>,
    outgoing: Queue,
    waiting: Arc<Semaphore>,
    tokens: Option<Arc<Tokens>>,
}

impl Connection {
    /// Starts a connection. A client that names one of the `tokens` gets its rights.
    #[must_use]
    pub fn start(
        client: Arc<Client>,
        tokens: Option<Arc<Tokens>>,
    ) -> (Self, mpsc::Receiver<Waiting>) {
        let (outgoing, receiver) = Queue::new();
        let (changes, changed) = mpsc::unbounded_channel();
        tokio::spawn(publish(Arc::clone(&client), changed, outgoing.clone()));
        let connection = Self {
            client,
            changes,
            outgoing,
            waiting: Arc::new(Semaphore::new(WAITING)),
            tokens,
        };
        (connection, receiver)
    }

    /// Takes one message of the client. The answer follows over the receiver.
    pub async fn take(&self, text: &[u8]) {
        self.take_request(Request::parse(text)).await;
    }

    /// Answers that a message was too long.
    pub async fn refuse(&self, error: OpError) {
        let op = Err(error);
        let (id, wait, lease) = (None, None, None);
        self.take_request(Request {
            id,
            wait,
            lease,
            op,
        })
        .await;
    }

    async fn take_request(&self, request: Request) {
        let Request {
            id,
            wait,
            lease,
            op,
        } = request;
        let op = match op {
            Ok(Op::Token { token }) => self.check_token(&token).map(|()| Op::Hello { name: None }),
            Ok(Op::Subscribe {
                topics,
                interval_ms,
                axis,
                signals,
            }) => self
                .subscribe(topics, interval_ms, axis.as_deref(), signals.as_deref())
                .map(|()| Op::Hello { name: None }),
            Ok(Op::Unsubscribe { topics }) => {
                let _ = self.changes.send(Change::Unsubscribe(topics));
                Ok(Op::Hello { name: None })
            }
            other => other,
        };
        let request = Request {
            id,
            wait,
            lease,
            op,
        };
        let waits = request.wait == Some(true)
            || matches!(
                request.op,
                Ok(Op::Await { .. }
                    | Op::SdoRead { .. }
                    | Op::SdoWrite { .. }
                    | Op::Advance { .. }
                    | Op::StreamOpen { .. }
                    | Op::StreamPush { .. }
                    | Op::StreamClose { .. })
            );
        if !waits {
            let answer = self.client.answer(request).await;
            let _ = self.outgoing.send(Outgoing::Answer(answer)).await;
            return;
        }
        let Ok(place) = Arc::clone(&self.waiting).try_acquire_owned() else {
            let error = OpError::new(ErrorCode::Busy, "too many requests of this client wait")
                .help("wait for the outcome of earlier ones");
            let request = Request {
                op: Err(error),
                ..request
            };
            let answer = self.client.answer(request).await;
            let _ = self.outgoing.send(Outgoing::Answer(answer)).await;
            return;
        };
        // Polled once at once, so that commands keep their order.
        let (client, outgoing) = (Arc::clone(&self.client), self.outgoing.clone());
        let mut work = Box::pin(async move {
            let answer = client.answer(request).await;
            let _ = outgoing.send(Outgoing::Answer(answer)).await;
            drop(place);
        });
        let first =
            std::future::poll_fn(|context| std::task::Poll::Ready(work.as_mut().poll(context)));
        if first.await.is_pending() {
            tokio::spawn(work);
        }
    }

    fn check_token(&self, token: &str) -> Result<(), OpError> {
        if let Some(tokens) = &self.tokens
            && let Some(rights) = tokens.rights(token)
        {
            self.client.set_blind(false);
            self.client.set_refusal(tokens.refusal(rights));
            return Ok(());
        }
        Err(OpError::new(ErrorCode::NoToken, "the token is wrong")
            .help("use the address that the server printed"))
    }

    fn subscribe(
        &self,
        topics: Vec<Topic>,
        interval_ms: u64,
        axis: Option<&str>,
        signals: Option<&[String]>,
    ) -> Result<(), OpError> {
        let setpoints = topics.contains(&Topic::Setpoints);
        let range = match setpoints {
            true => 1..=1_000,
            false => 10..=10_000,
        };
        if !range.contains(&interval_ms) {
            let (least, most) = (range.start(), range.end());
            let message = format!("`interval_ms` is {interval_ms}: it must be {least} to {most}");
            return Err(OpError::new(ErrorCode::BadRequest, message));
        }
        self.client.check_read()?;
        if setpoints != axis.is_some() || setpoints && topics.len() > 1 {
            let message = "`setpoints` needs an `axis`, and no other topic";
            return Err(OpError::new(ErrorCode::BadRequest, message)
                .help("subscribe to other topics with another message"));
        }
        let axis = axis.map(|name| self.client.axis(name)).transpose()?;
        let words = signal_words(&self.client.hub.samples, signals)?;
        let _ = self.changes.send(Change::Subscribe {
            topics,
            axis,
            interval: Duration::from_millis(interval_ms),
            words,
            // The first cycle after the answer belongs to the client.
            next: self.client.hub.samples.written(),
        });
        Ok(())
    }
}

/// Sends what the client has subscribed to.
async fn publish(
    client: Arc<Client>,
    mut changes: mpsc::UnboundedReceiver<Change>,
    outgoing: Queue,
) {
    let hub = Arc::clone(&client.hub);
    drop(client);
    let mut events = hub.subscribe();
    let mut topics: HashSet<u8> = HashSet::new();
    let mut states: Option<Interval> = None;
    let mut samples: Option<SampleSubscription> = None;
    let mut setpoints: Option<SetpointSubscription> = None;
    loop {
        let message = tokio::select! {
            biased;
            change = changes.recv() => {
                match change {
                    None => return,
                    Some(Change::Unsubscribe(ended)) => for topic in ended {
                        topics.remove(&(topic as u8));
                        match topic {
                            Topic::State => states = None,
                            Topic::Samples => samples = None,
                            Topic::Setpoints => setpoints = None,
                            Topic::Events => {}
                        }
                    },
                    Some(Change::Subscribe { topics: begun, axis, interval, words, next }) => {
                        for topic in begun {
                            topics.insert(topic as u8);
                            match topic {
                                Topic::State => states = Some(timer(interval)),
                                Topic::Samples => samples = Some(SampleSubscription {
                                    words: words.clone(),
                                    next,
                                    timer: timer(interval),
                                }),
                                Topic::Setpoints => {
                                    let mut axes = setpoints.map_or(Vec::new(), |s| s.axes);
                                    axes.retain(|(known, _)| Some(*known) != axis);
                                    axes.extend(axis.map(|axis| (axis, 0)));
                                    let timer = timer(interval);
                                    setpoints = Some(SetpointSubscription { axes, timer });
                                }
                                Topic::Events => {}
                            }
                        }
                    }
                }
                continue;
            }
            event = events.recv() => match event {
                Ok(event) if topics.contains(&(Topic::Events as u8)) => {
                    Outgoing::Object(event.body.clone())
                }
                Err(RecvError::Lagged(missed)) if topics.contains(&(Topic::Events as u8)) => {
                    let mut object = Map::new();
                    object.insert("event".to_owned(), json!("missed"));
                    object.insert("count".to_owned(), json!(missed));
                    Outgoing::Object(object)
                }
                Err(RecvError::Closed) => return,
                _ => continue,
            },
            // A set-point that waits is of no use: before all that takes longer.
            () = tick(&mut setpoints) => {
                let Some(subscription) = &mut setpoints else { continue };
                for (axis, last) in &mut subscription.axes {
                    let point = hub.setpoint(*axis).filter(|point| point.at_ns != *last);
                    let Some(point) = point else { continue };
                    if outgoing.is_behind() {
                        break;
                    }
                    *last = point.at_ns;
                    let message = Outgoing::Object(setpoints_event(&hub, *axis, &point));
                    if !outgoing.send(message).await {
                        return;
                    }
                }
                continue;
            }
            () = tick(&mut states) => {
                if outgoing.is_behind() {
                    continue;
                }
                let mut object = match state::state(&hub) {
                    Value::Object(object) => object,
                    _ => Map::new(),
                };
                object.insert("event".to_owned(), json!("state"));
                Outgoing::Object(object)
            }
            () = tick(&mut samples) => {
                let Some(subscription) = &mut samples else { continue };
                if outgoing.is_behind() {
                    continue;
                }
                let columns = subscription.words.len().max(1) as u64;
                let rows = (BATCH_VALUES / columns).clamp(1, BATCH);
                let batch = Batch::read(
                    &hub.samples, &subscription.words, &mut subscription.next, rows,
                );
                if hub.samples.written() > subscription.next {
                    // More than a batch waits.
                    subscription.timer.reset_immediately();
                }
                Outgoing::Samples(batch)
            }
        };
        if !outgoing.send(message).await {
            return;
        }
    }
}

fn setpoints_event(hub: &Hub, axis: AxisIndex, point: &LineShaftPoint) -> Map<String, Value> {
    let name = hub.machine.axes.get(axis).map(|axis| &axis.name);
    let motion = point.motion;
    let point_object = SetpointPoint {
        unix_ns: point.at_ns,
        position: motion.position,
        velocity: motion.velocity,
        acceleration: motion.acceleration,
    };
    let mut object = Map::new();
    object.insert("event".to_owned(), json!("setpoints"));
    object.insert("axis".to_owned(), json!(name));
    object.insert("stream".to_owned(), json!(stream_text(point.stream)));
    object.insert("points".to_owned(), json!([point_object]));
    object
}

fn timer(period: Duration) -> Interval {
    let mut timer = interval(period);
    timer.set_missed_tick_behavior(MissedTickBehavior::Delay);
    timer
}

trait Timer {
    fn timer(&mut self) -> &mut Interval;
}

impl Timer for Interval {
    fn timer(&mut self) -> &mut Interval {
        self
    }
}

impl Timer for SampleSubscription {
    fn timer(&mut self) -> &mut Interval {
        &mut self.timer
    }
}

impl Timer for SetpointSubscription {
    fn timer(&mut self) -> &mut Interval {
        &mut self.timer
    }
}

/// Ends at the next tick; never without a timer.
async fn tick<T: Timer>(timer: &mut Option<T>) {
    match timer {
        Some(timer) => {
            timer.timer().tick().await;
        }
        None => std::future::pending().await,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_of_a_client_that_does_not_read_have_a_budget() {
        let runtime = tokio::runtime::Builder::new_current_thread().build();
        runtime.expect("a runtime").block_on(async {
            let (queue, mut receiver) = Queue::new();
            let message = |bytes: usize| {
                let mut object = Map::new();
                object.insert("text".to_owned(), json!("x".repeat(bytes)));
                Outgoing::Object(object)
            };
            let mut sent = 0;
            let now = |bytes: usize| {
                let queue = queue.clone();
                let message = message(bytes);
                let send = tokio::spawn(async move { queue.send(message).await });
                async move {
                    tokio::task::yield_now().await;
                    send.is_finished()
                }
            };
            while now(BUDGET / 4).await {
                sent += 1;
            }
            assert_eq!(sent, 3);
            // A larger message than the budget waits for all others, and later ones keep their order.
            assert!(!now(2 * BUDGET).await);
            assert!(!now(1).await);
            let mut lengths = Vec::new();
            for _ in 0..6 {
                let (message, _room) = receiver.recv().await.expect("a message");
                let Outgoing::Object(object) = message else {
                    panic!("an object")
                };
                lengths.push(object["text"].as_str().map_or(0, str::len));
            }
            let quarter = BUDGET / 4;
            assert_eq!(lengths, [quarter, quarter, quarter, quarter, 2 * BUDGET, 1]);
        });
    }
}
