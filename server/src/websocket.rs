//! The WebSocket of the page: requests, answers, events, states and samples.

use std::sync::Arc;
use std::time::Duration;

use axum::body::Bytes;
use axum::extract::State;
use axum::extract::ws::{Message, WebSocket, WebSocketUpgrade};
use axum::http::HeaderMap;
use axum::response::Response;
use futures_util::{SinkExt, StreamExt};
use serde_json::json;

use crate::client::{Answer, Client};
use crate::connection::{Connection, Outgoing};
use crate::error::{ErrorCode, OpError};
use crate::http::Shared;
use crate::socket::LINE;
use crate::tokens::Tokens;

/// The silence after which a WebSocket client is asked for a sign of life.
pub const PING: Duration = Duration::from_secs(10);

/// The time for a client that needs a token to send it.
const TOKEN: Duration = Duration::from_secs(10);

/// Connects a client.
pub async fn upgrade(
    State(http): Shared,
    headers: HeaderMap,
    upgrade: WebSocketUpgrade,
) -> Response {
    let rights = http.tokens.rights_of(&headers);
    let blind = !http.is_loopback() && rights.is_none();
    let refusal = match rights {
        Some(rights) => http.tokens.refusal(rights),
        None => http.without_token.refusal(),
    };
    let client = Client::new(Arc::clone(&http.hub), "websocket", refusal, false);
    client.set_blind(blind);
    let tokens = Some(Arc::clone(&http.tokens));
    upgrade
        .max_message_size(LINE)
        .max_frame_size(LINE)
        .on_upgrade(move |socket| serve(socket, Arc::new(client), tokens))
}

async fn serve(socket: WebSocket, client: Arc<Client>, tokens: Option<Arc<Tokens>>) {
    let (id, hub) = (client.id, Arc::clone(&client.hub));
    hub.event(json!({"event": "client", "client": id, "connected": true}));
    let (connection, mut outgoing) = Connection::start(Arc::clone(&client), tokens);
    let (mut sink, mut stream) = socket.split();
    // A client that may not even read names its token soon, or leaves its place.
    let stranger = async {
        tokio::time::sleep(TOKEN).await;
        if client.check_read().is_ok() {
            std::future::pending::<()>().await;
        }
    };
    let read = async {
        loop {
            match stream.next().await {
                Some(Ok(Message::Text(text))) => connection.take(text.as_bytes()).await,
                Some(Ok(Message::Binary(_))) => {
                    let error = OpError::new(ErrorCode::BadRequest, "requests are text frames");
                    connection.refuse(error).await;
                }
                Some(Ok(Message::Ping(_) | Message::Pong(_))) => {}
                Some(Ok(Message::Close(_)) | Err(_)) | None => return,
            }
        }
    };
    let write = async {
        let mut ping = tokio::time::interval(PING);
        loop {
            let (frame, _room) = tokio::select! {
                message = outgoing.recv() => match message {
                    Some((Outgoing::Answer(Answer { body, .. }) | Outgoing::Object(body), room)) => {
                        let text = serde_json::to_string(&body).unwrap_or_default();
                        (Message::Text(text.into()), Some(room))
                    }
                    Some((Outgoing::Samples(batch), room)) => {
                        (Message::Binary(batch.frame().into()), Some(room))
                    }
                    None => return,
                },
                _ = ping.tick() => (Message::Ping(Bytes::new()), None),
            };
            if sink.send(frame).await.is_err() {
                return;
            }
        }
    };
    // Apart, so that a reader whose answers wait does not wait for itself.
    tokio::select! {
        () = read => {}
        () = write => {}
        () = stranger => {}
    }
    drop(connection);
    client.leave();
    hub.event(json!({"event": "client", "client": id, "connected": false}));
}
