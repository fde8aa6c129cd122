//! `watch`: machines that appear and vanish, events and fault reports, as they happen.

use serde_json::{Value, json};
use zenoh::sample::{Sample, SampleKind};

use super::print;
use crate::agent::state::unix_time;
use crate::error::{Error, Result};
use crate::keys::{EACH_EVENT, EACH_REPORT, MachineId};
use crate::options::Network;
use crate::session;

/// The longest line of text, in characters.
const MAX_LINE: usize = 300;

/// Prints until SIGINT or SIGTERM.
///
/// # Errors
/// Fails if no router is reached, or the session is closed.
pub async fn run(network: &Network, as_json: bool) -> Result<()> {
    let session = session::open_at_once(network).await?;
    let tokens = session::subscribe_tokens(&session).await?;
    let events = session::subscribe(&session, EACH_EVENT).await?;
    let reports = session::subscribe(&session, EACH_REPORT).await?;
    let terminated = session::terminated();
    tokio::pin!(terminated);
    loop {
        let closed = |_| Error::new("Zenoh: the session is closed");
        let line = tokio::select! {
            ended = &mut terminated => return ended,
            sample = tokens.recv_async() => token(&sample.map_err(closed)?),
            sample = events.recv_async() => message("event", &sample.map_err(closed)?),
            sample = reports.recv_async() => message("report", &sample.map_err(closed)?),
        };
        let Some((id, what, body)) = line else {
            continue;
        };
        if as_json {
            let time = unix_time();
            let line = json!({"unix_time": time, "site": id.site, "machine": id.machine,
                              "what": what, "body": body});
            print(&line.to_string())?;
        } else {
            let text = match body {
                Value::Null => String::new(),
                body => body.to_string(),
            };
            let text: String = text.chars().take(MAX_LINE).collect();
            print(format!("{id} {what} {text}").trim_end())?;
        }
    }
}

fn token(sample: &Sample) -> Option<(MachineId, &'static str, Value)> {
    let (id, _) = MachineId::of_key(sample.key_expr().as_str())?;
    let what = match sample.kind() {
        SampleKind::Put => "appears",
        SampleKind::Delete => "vanishes",
    };
    Some((id, what, Value::Null))
}

fn message(what: &'static str, sample: &Sample) -> Option<(MachineId, &'static str, Value)> {
    let (id, _) = MachineId::of_key(sample.key_expr().as_str())?;
    let body = serde_json::from_slice(&sample.payload().to_bytes()).ok()?;
    Some((id, what, body))
}
