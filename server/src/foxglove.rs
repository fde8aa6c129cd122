//! The Foxglove WebSocket protocol, for viewers that exist already: Foxglove, Lichtblick,
//! PlotJuggler. It only reads.
//!
//! A viewer that reads slowly waits in this module, not in memory: it misses cycles.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use axum::body::Bytes;
use axum::extract::State;
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::extract::ws::{Message, WebSocket, WebSocketUpgrade};
use axum::http::{HeaderMap, Uri, header};
use axum::response::Response;
use ecaxis_master::ros2::topics::{Source, encode_diagnostics};
use futures_util::{SinkExt, StreamExt};
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, MissedTickBehavior, interval, timeout};

use crate::diagnostics::diagnostics;
use crate::error::{ErrorCode, OpError};
use crate::http::{Shared, refusal};
use crate::hub::Hub;
use crate::page;
use crate::socket::LINE;
use crate::websocket::PING;

/// The subprotocols, which differ only in name here.
const PROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];
/// The viewers at the same time.
const VIEWERS: usize = 16;
/// The period at which samples are sent.
const PERIOD: Duration = Duration::from_millis(20);
/// The period of the diagnostics.
const DIAGNOSTICS: Duration = Duration::from_secs(1);
/// The most messages in a second of a channel, and of a viewer.
const CHANNEL_RATE: u64 = 1000;
const VIEWER_RATE: u64 = 20_000;
/// The time after which a viewer that takes no data is disconnected.
const TIMEOUT: Duration = Duration::from_secs(30);
/// The first byte of a message with data.
const MESSAGE_DATA: u8 = 1;

/// The viewers of a server.
#[derive(Debug)]
pub struct Viewers {
    places: Arc<Semaphore>,
    /// Differs for each start, so that viewers notice a new server.
    session: String,
}

impl Viewers {
    #[must_use]
    pub fn new() -> Self {
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        Self {
            places: Arc::new(Semaphore::new(VIEWERS)),
            session: now.unwrap_or_default().as_nanos().to_string(),
        }
    }
}

impl Default for Viewers {
    fn default() -> Self {
        Self::new()
    }
}

/// Returns whether a request asks for this protocol instead of the page.
#[must_use]
pub fn is_asked_for(headers: &HeaderMap, address: &Uri) -> bool {
    address.path() == "/" && headers.contains_key(header::SEC_WEBSOCKET_PROTOCOL)
}

/// Answers at `/`: a viewer is connected, a browser gets the page.
pub async fn index(
    State(http): Shared,
    headers: HeaderMap,
    address: Uri,
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
) -> Response {
    let Ok(upgrade) = upgrade else {
        return page::index();
    };
    let upgrade = upgrade.protocols(PROTOCOLS);
    if upgrade.selected_protocol().is_none() {
        let message = format!("the subprotocols here are {}", PROTOCOLS.join(" and "));
        let error = OpError::new(ErrorCode::BadRequest, message);
        return refusal(&error.help("the WebSocket of the page is /api/ws"));
    }
    let named = http.tokens.rights_of(&headers).is_some() || http.tokens.are_in(&address);
    if !http.is_loopback() && !named {
        let error = OpError::new(ErrorCode::NoToken, "this needs the token");
        return refusal(&error.help("add ?token=TOKEN to the address"));
    }
    let Ok(place) = Arc::clone(&http.viewers.places).try_acquire_owned() else {
        let error = OpError::new(ErrorCode::Busy, format!("{VIEWERS} viewers are connected"));
        return refusal(&error.help("close one of them"));
    };
    let (hub, session) = (Arc::clone(&http.hub), http.viewers.session.clone());
    upgrade
        .max_message_size(LINE)
        .max_frame_size(LINE)
        .on_upgrade(move |socket| serve(socket, hub, session, place))
}

async fn serve(socket: WebSocket, hub: Arc<Hub>, session: String, place: OwnedSemaphorePermit) {
    let mut viewer = Viewer::new(hub, socket);
    // An error is the end of the connection.
    let _ = viewer.serve(session).await;
    drop(place);
}

/// A message of a viewer.
#[derive(Debug, Deserialize)]
#[serde(tag = "op", rename_all = "camelCase", rename_all_fields = "camelCase")]
enum Request {
    Subscribe {
        subscriptions: Vec<Subscription>,
    },
    Unsubscribe {
        subscription_ids: Vec<u32>,
    },
    ClientInfo,
    #[serde(other)]
    Other,
}

#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Subscription {
    id: u32,
    channel_id: u32,
}

/// The connection to a viewer has ended.
struct Disconnected;

impl From<axum::Error> for Disconnected {
    fn from(_: axum::Error) -> Self {
        Self
    }
}

struct Viewer {
    hub: Arc<Hub>,
    socket: WebSocket,
    /// The subscriptions with the sources of their messages; at most one for each channel.
    subscriptions: Vec<(Subscription, Source)>,
    /// The next row.
    next: u64,
    /// Rows that the viewer missed before the next one, and those that were not reported to it.
    gap: u64,
    unreported: u64,
    reported_at: Option<Instant>,
    diagnostics_at: Option<Instant>,
}

impl Viewer {
    fn new(hub: Arc<Hub>, socket: WebSocket) -> Self {
        Self {
            next: hub.samples.written(),
            hub,
            socket,
            subscriptions: Vec::new(),
            gap: 0,
            unreported: 0,
            reported_at: None,
            diagnostics_at: None,
        }
    }

    async fn serve(&mut self, session: String) -> Result<(), Disconnected> {
        self.send(self.server_info(session)).await?;
        self.send(self.advertisement()).await?;
        let mut ping = interval(PING);
        let mut timer = interval(PERIOD);
        timer.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                message = self.socket.next() => match message {
                    Some(Ok(Message::Text(text))) => self.take(&text).await?,
                    Some(Ok(Message::Binary(_))) => self.warn("this server only reads").await?,
                    Some(Ok(Message::Ping(_) | Message::Pong(_))) => {}
                    Some(Ok(Message::Close(_)) | Err(_)) | None => return Err(Disconnected),
                },
                _ = ping.tick() => {
                    timeout(TIMEOUT, self.socket.send(Message::Ping(Bytes::new())))
                        .await
                        .map_err(|_| Disconnected)??;
                }
                _ = timer.tick() => {
                    timeout(TIMEOUT, self.publish()).await.map_err(|_| Disconnected)??;
                }
            }
        }
    }

    fn server_info(&self, session: String) -> Value {
        let machine = self.hub.machine.path.file_stem().unwrap_or_default();
        json!({
            "op": "serverInfo",
            "name": format!("ecaxis {}", env!("CARGO_PKG_VERSION")),
            "capabilities": [],
            "supportedEncodings": [],
            "metadata": {
                "machine": machine.to_string_lossy(),
                "epoch_ns": self.hub.topics.epoch().to_string(),
            },
            "sessionId": session,
        })
    }

    fn advertisement(&self) -> Value {
        let topics = self.hub.topics.list().iter();
        let channels = (1_u32..).zip(topics).map(|(id, topic)| {
            json!({
                "id": id,
                "topic": topic.name,
                "encoding": "cdr",
                "schemaName": topic.schema.name,
                "schema": topic.schema.text,
                "schemaEncoding": "ros2msg",
            })
        });
        json!({"op": "advertise", "channels": channels.collect::<Vec<_>>()})
    }

    async fn send(&mut self, object: Value) -> Result<(), Disconnected> {
        let message = Message::Text(object.to_string().into());
        let sent = timeout(TIMEOUT, self.socket.send(message)).await;
        sent.map_err(|_| Disconnected)??;
        Ok(())
    }

    async fn warn(&mut self, message: &str) -> Result<(), Disconnected> {
        let status = json!({"op": "status", "level": 1, "message": message});
        self.send(status).await
    }

    /// Carries out a message of the viewer. Each has at most one answer.
    async fn take(&mut self, text: &str) -> Result<(), Disconnected> {
        let refused = match serde_json::from_str(text) {
            Ok(Request::Subscribe { subscriptions }) => {
                let refused = subscriptions.iter().filter(|s| !self.subscribe(**s));
                refused.count() > 0
            }
            Ok(Request::Unsubscribe { subscription_ids }) => {
                let known = |id: &u32| self.subscriptions.iter().any(|(s, _)| s.id == *id);
                let refused = !subscription_ids.iter().all(known);
                self.subscriptions
                    .retain(|(s, _)| !subscription_ids.contains(&s.id));
                refused
            }
            Ok(Request::ClientInfo) => false,
            Ok(Request::Other) => return self.warn("this server only reads").await,
            Err(error) => return self.warn(&format!("not a message: {error}")).await,
        };
        if refused {
            self.warn("an unknown channel or subscription, or one that is in use")
                .await?;
        }
        Ok(())
    }

    fn subscribe(&mut self, wanted: Subscription) -> bool {
        let index = usize::try_from(wanted.channel_id).ok();
        let topic = index.and_then(|id| self.hub.topics.list().get(id.checked_sub(1)?));
        let mut present = self.subscriptions.iter();
        let used = present.any(|(s, _)| s.id == wanted.id || s.channel_id == wanted.channel_id);
        let Some(topic) = topic.filter(|_| !used) else {
            return false;
        };
        if topic.source == Source::Diagnostics {
            self.diagnostics_at = None;
        }
        self.subscriptions.push((wanted, topic.source));
        true
    }

    /// Sends the new samples, and diagnostics once a second.
    async fn publish(&mut self) -> Result<(), Disconnected> {
        let diagnosed = self.diagnostics_at;
        if diagnosed.is_none_or(|at| at.elapsed() >= DIAGNOSTICS) {
            self.diagnostics_at = Some(Instant::now());
            self.publish_diagnostics().await?;
        }
        self.publish_samples().await?;
        self.socket.flush().await?;
        if self.unreported > 0
            && self
                .reported_at
                .is_none_or(|at| at.elapsed() >= DIAGNOSTICS)
        {
            self.reported_at = Some(Instant::now());
            let missed = std::mem::take(&mut self.unreported);
            let message = format!("this viewer reads too slowly: it missed {missed} cycles");
            self.warn(&message).await?;
        }
        Ok(())
    }

    async fn publish_diagnostics(&mut self) -> Result<(), Disconnected> {
        let mut subscriptions = self.subscriptions.iter();
        let found = subscriptions.find(|(_, source)| *source == Source::Diagnostics);
        let Some((subscription, _)) = found else {
            return Ok(());
        };
        let time = self.hub.topics.unix_time(self.hub.now());
        let mut frame = frame(subscription.id, time);
        encode_diagnostics(time, &diagnostics(&self.hub), &mut frame);
        self.socket.feed(Message::Binary(frame.into())).await?;
        Ok(())
    }

    async fn publish_samples(&mut self) -> Result<(), Disconnected> {
        let hub = Arc::clone(&self.hub);
        let (samples, topics) = (&hub.samples, &hub.topics);
        let end = samples.written();
        let rates = self.subscriptions.len() as u64;
        if rates == 0 {
            (self.next, self.gap) = (end, 0);
            return Ok(());
        }
        let second = (1_000_000_000 / hub.machine.bus.cycle_ns.max(1)).max(1);
        // Every n-th row keeps both rates.
        let step = (second.div_ceil(CHANNEL_RATE)).max((rates * second).div_ceil(VIEWER_RATE));
        // A viewer that is a second behind goes on with the newest samples.
        if end.saturating_sub(self.next) > second {
            let skipped = end - self.next;
            (self.next, self.gap) = (end, self.gap + skipped);
            self.unreported += skipped;
        }
        let mut row = Vec::new();
        while self.next < end {
            let number = self.next;
            self.next += 1;
            if !number.is_multiple_of(step) {
                continue;
            }
            if !samples.read(number, &mut row) {
                self.gap += 1;
                continue;
            }
            let time = topics.unix_time(row.get(1).copied().unwrap_or_default());
            let gap = std::mem::take(&mut self.gap);
            for at in 0..self.subscriptions.len() {
                let (subscription, source) = self.subscriptions[at];
                let mut frame = frame(subscription.id, time);
                if topics.encode(source, &row, gap, &mut frame) {
                    self.socket.feed(Message::Binary(frame.into())).await?;
                }
            }
        }
        Ok(())
    }
}

/// Begins a message with data: its payload follows.
fn frame(subscription: u32, time: u64) -> Vec<u8> {
    let mut frame = vec![MESSAGE_DATA];
    frame.extend(subscription.to_le_bytes());
    frame.extend(time.to_le_bytes());
    frame
}
