//! `status`: all machines, whether they are there, and how they are.

use std::collections::BTreeMap;

use serde::Serialize;
use serde_json::{Value, json};
use zenoh::Session;

use super::{TIMEOUT, print};
use crate::agent::state::{Server, State, unix_time};
use crate::error::{Error, Result};
use crate::keys::{ALL_ALIVE, ALL_STATES, MachineId};
use crate::options::Network;
use crate::session::{self, Reply};

/// A machine as this observer sees it.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Seen {
    /// Its liveliness token is there: the agent is reached.
    pub alive: bool,
    /// The newest state that an agent or an archive has.
    pub state: Option<State>,
    /// The age of the state in s, by the clock of this computer.
    pub age_s: Option<f64>,
}

impl Seen {
    /// Computes the age of the state.
    pub fn set_age(&mut self) {
        let age_s = |state: &State| (unix_time() - state.unix_time).max(0.0);
        self.age_s = self.state.as_ref().map(age_s);
    }
}

/// Returns all machines.
///
/// # Errors
/// Fails if the session is closed.
pub async fn look(session: &Session) -> Result<BTreeMap<MachineId, Seen>> {
    let failed = |error: zenoh::Error| Error::new(format!("query {ALL_ALIVE}: {error}"));
    let tokens = session.liveliness().get(ALL_ALIVE).timeout(TIMEOUT);
    let tokens = tokens.await.map_err(failed)?;
    let mut machines: BTreeMap<MachineId, Seen> = BTreeMap::new();
    while let Ok(reply) = tokens.recv_async().await {
        let key = reply
            .result()
            .ok()
            .map(|sample| sample.key_expr().to_string());
        if let Some((id, "alive")) = key.as_deref().and_then(MachineId::of_key) {
            machines.entry(id).or_default().alive = true;
        }
    }
    let replies = session::query(session, ALL_STATES, TIMEOUT).await?;
    replies.warn_if_incomplete("status", TIMEOUT);
    for reply in replies.all {
        if let Some(state) = state_of(&reply) {
            let seen = machines.entry(state.id.clone()).or_default();
            let newer = |old: &State| old.unix_time < state.unix_time;
            if seen.state.as_ref().is_none_or(newer) {
                seen.state = Some(state);
                seen.set_age();
            }
        }
    }
    Ok(machines)
}

/// Reads a state; `None` unless it is that of its key.
#[must_use]
pub fn state_of(reply: &Reply) -> Option<State> {
    let (id, suffix) = MachineId::of_key(&reply.key)?;
    let state: State = reply.json()?;
    (suffix == "state" && state.id == id).then_some(state)
}

/// Returns all machines as JSON.
#[must_use]
pub fn to_json(machines: &BTreeMap<MachineId, Seen>) -> Value {
    let machines = machines.iter().map(|(id, seen)| {
        json!({"site": id.site, "machine": id.machine, "alive": seen.alive,
               "age_s": seen.age_s, "state": seen.state})
    });
    machines.collect()
}

/// Prints all machines.
///
/// # Errors
/// Fails if no router is reached.
pub async fn run(network: &Network, as_json: bool) -> Result<()> {
    let session = session::open_observer(network).await?;
    let machines = look(&session).await?;
    if machines.is_empty() {
        tracing::warn!("no machine answers: check that agents run, and `--connect`");
    }
    if as_json {
        print(&to_json(&machines).to_string())?;
    } else {
        let rows: Vec<_> = machines.iter().map(|(id, seen)| row(id, seen)).collect();
        print(&table(&rows))?;
    }
    let failed = |error: zenoh::Error| Error::new(format!("closing the session: {error}"));
    session.close().await.map_err(failed)
}

const COLUMNS: [&str; 8] = [
    "MACHINE",
    "BUS",
    "FAULTS",
    "VERSION",
    "FILES",
    "JITTER",
    "WORST DEVICE",
    "AGE",
];

fn row(id: &MachineId, seen: &Seen) -> [String; 8] {
    let none = || "-".to_owned();
    let serve = seen.state.as_ref().and_then(|state| state.serve.as_ref());
    let bus = match (&seen.state, serve) {
        _ if !seen.alive => "gone".to_owned(),
        (Some(state), _) if state.server == Server::Absent => "server: absent".to_owned(),
        (_, Some(serve)) => serve.bus.state.clone(),
        _ => none(),
    };
    let faults = serve.map_or_else(none, |serve| match serve.faults.as_slice() {
        [] => "0".to_owned(),
        [first, ..] => format!("{}: {} {}", serve.faults.len(), first.axis, first.why),
    });
    let jitter = serve.and_then(|serve| serve.jitter_p99_9_ns);
    let worst = serve.and_then(|serve| serve.worst_device.as_ref());
    let worst = worst.map(|device| {
        let state = device.al_state.as_deref().unwrap_or("?");
        format!("{} {state}, {} errors", device.name, device.errors)
    });
    [
        id.to_string(),
        bus,
        faults,
        serve.map_or_else(none, |serve| serve.version.clone()),
        serve.map_or_else(none, |serve| serve.sha256.chars().take(8).collect()),
        jitter.map_or_else(none, |ns| format!("{:.1} µs", ns as f64 / 1000.0)),
        worst.unwrap_or_else(none),
        seen.age_s.map_or_else(none, |age| format!("{age:.1} s")),
    ]
}

/// Returns rows below the names of their columns. The texts come from the network: what is not
/// printable is escaped.
fn table(rows: &[[String; 8]]) -> String {
    let rows = rows.iter().map(|row| {
        row.each_ref().map(|cell| {
            let short: String = cell.chars().take(40).collect();
            short
                .chars()
                .map(|c| if c.is_control() { '?' } else { c })
                .collect::<String>()
        })
    });
    let all: Vec<_> = [COLUMNS.map(str::to_owned)]
        .into_iter()
        .chain(rows)
        .collect();
    let width = |n: usize| {
        all.iter()
            .map(|row| row[n].chars().count())
            .max()
            .unwrap_or(0)
    };
    let lines = all.iter().map(|row| {
        let cells = row
            .iter()
            .enumerate()
            .map(|(n, cell)| format!("{cell:<0$}", width(n)));
        cells.collect::<Vec<_>>().join("  ").trim_end().to_owned()
    });
    lines.collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_has_no_control_characters() {
        let mut cells = ["a", "op", "0", "0.1.0", "5f1c", "1 µs", "x", "0.1 s"].map(str::to_owned);
        cells[6] = "\u{1b}[2Jx\n".to_owned();
        let text = table(&[cells]);
        assert_eq!(text.lines().count(), 2, "{text}");
        assert!(!text.contains('\u{1b}'), "{text}");
    }

    #[test]
    fn a_machine_that_is_not_reached_is_gone() {
        let id = "hall/press".parse().unwrap();
        assert_eq!(row(&id, &Seen::default())[1], "gone");
    }
}
