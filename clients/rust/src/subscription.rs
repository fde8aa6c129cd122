//! Events and samples of a machine.

use std::path::Path;
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::Duration;

use serde_json::{Value, json};

use crate::connection::Connection;
use crate::{Error, Result};

/// The messages that are kept for the program.
const CAPACITY: usize = 256;

/// Messages of the server as they come, the objects of `docs/server.md`. As an iterator, it waits
/// for each and ends with the connection, which is its own.
#[derive(Debug)]
pub struct Subscription {
    messages: Receiver<Value>,
    _connection: Connection,
}

impl Subscription {
    pub(crate) fn open(path: &Path, name: &str, keys: Value) -> Result<Self> {
        let (sender, messages) = sync_channel(CAPACITY);
        let connection = Connection::open(path, Some(sender))?;
        connection.ask("hello", "", json!({"name": name}))?;
        connection.ask("subscribe", "", keys)?;
        Ok(Self {
            messages,
            _connection: connection,
        })
    }

    /// Waits for the next message; `None`: none came in time. Without time it does not wait.
    ///
    /// # Errors
    /// Fails once the connection is lost.
    pub fn next_within(&self, timeout: Duration) -> Result<Option<Value>> {
        match self.messages.recv_timeout(timeout) {
            Ok(message) => Ok(Some(message)),
            Err(RecvTimeoutError::Timeout) => Ok(None),
            Err(RecvTimeoutError::Disconnected) => {
                let cause = "the server has closed the connection";
                Err(Error::lost(cause).at("subscribe", ""))
            }
        }
    }
}

impl Iterator for Subscription {
    type Item = Value;

    fn next(&mut self) -> Option<Value> {
        self.messages.recv().ok()
    }
}
