//! Starts the program of a machine.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use serde_json::json;

use super::executor::{Ended, OrderExecutor};
use super::order::Status;
use super::server;
use crate::error::Error;

const POLL: Duration = Duration::from_millis(50);

impl OrderExecutor {
    /// Starts the program and holds the lease until its end: if the agent ends, the axes stop.
    /// `stop` ends it.
    pub(super) fn start(
        &self,
        at_unix_ns: Option<u64>,
        sender: &str,
        stop: &AtomicBool,
        progress: &mut dyn FnMut(Status, String),
    ) -> Result<String, Ended> {
        let machine = server::connect(&self.socket, sender).map_err(server::text)?;
        machine.take(false).map_err(server::text)?;
        let mut keys = json!({"action": "start"});
        if let Some(at) = at_unix_ns {
            keys["at_unix_ns"] = json!(at);
        }
        if stop.load(Ordering::SeqCst) {
            return Err(Error::new("an order `stop` came first").into());
        }
        let request = machine.command("program", "", keys).map_err(server::text)?;
        let state = match at_unix_ns {
            Some(_) => "the program waits for its instant",
            None => "the program runs",
        };
        let mut started = false;
        loop {
            // On this connection, it cannot overtake the start.
            if stop.swap(false, Ordering::SeqCst) {
                let stopped = machine.stop().map_err(server::text);
                stopped.map_err(Ended::Failed)?;
            }
            match machine.is_done(request) {
                Ok(true) => return Ok("the program has ended".to_owned()),
                Ok(false) => {}
                Err(error) if started => return Err(Ended::Failed(server::text(error))),
                Err(error) => return Err(Ended::Refused(server::text(error))),
            }
            if !started {
                let now = machine.request("state", json!({}));
                // The server may have started the program.
                let now = now.map_err(|error| Ended::Failed(server::text(error)))?;
                if now["program"]["running"] == json!(true) {
                    started = true;
                    progress(Status::Started, state.to_owned());
                }
            }
            let kept = machine.sleep(POLL);
            kept.map_err(|error| {
                let what = format!("the connection during the program: {error}");
                Ended::Failed(Error::new(what))
            })?;
        }
    }
}
