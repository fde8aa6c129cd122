//! The set-points of an axis, for the line shafts of other machines.

use std::convert::Infallible;
use std::path::PathBuf;
use std::thread;
use std::time::{Duration, Instant};

use ecaxis_client::Machine;
use serde_json::{Value, json};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Session, Wait};

use super::reader::attach_options;
use crate::error::{Error, Result};
use crate::keys::{MachineId, Name};

/// The time between two tries to reach the server, and between two looks for subscribers.
const RETRY: Duration = Duration::from_millis(300);

/// Publishes the set-points of one axis.
#[derive(Debug)]
pub struct SetPoints {
    pub session: Session,
    pub id: MachineId,
    pub socket: PathBuf,
    pub axis: Name,
    pub interval: Duration,
}

/// Returns the last chunks of the key of an axis.
#[must_use]
pub fn suffix(axis: &Name) -> String {
    format!("setpoints/{axis}")
}

impl SetPoints {
    /// Publishes until the process ends.
    pub fn run(&self) {
        let mut known = None;
        loop {
            let error = match self.publish() {
                Ok(ended) => match ended {},
                Err(error) => error.to_string(),
            };
            if known.as_ref() != Some(&error) {
                tracing::warn!(axis = %self.axis, "set-points: {error}");
                known = Some(error);
            }
            thread::sleep(RETRY);
        }
    }

    fn publish(&self) -> Result<Infallible> {
        let failed = |error: zenoh::Error| Error::new(format!("Zenoh: {error}"));
        // An old point is worth nothing: better dropped than late.
        let publisher = self
            .session
            .declare_publisher(self.id.key(&suffix(&self.axis)))
            .priority(Priority::RealTime)
            .congestion_control(CongestionControl::Drop)
            .express(true)
            .wait()
            .map_err(failed)?;
        let wanted = || {
            let status = publisher.matching_status().wait();
            status.map(|status| status.matching()).map_err(failed)
        };
        loop {
            while !wanted()? {
                thread::sleep(RETRY);
            }
            let machine = Machine::attach(&self.socket, attach_options());
            let points = machine.and_then(|m| m.setpoints(&self.axis.to_string(), self.interval));
            let points = points.map_err(|e| Error::new(e.to_string()))?;
            tracing::info!(axis = %self.axis, "set-points: a line shaft follows");
            let mut looked = Instant::now();
            while looked.elapsed() < RETRY || wanted()? {
                if looked.elapsed() >= RETRY {
                    looked = Instant::now();
                }
                let next = |timeout| {
                    let next = points.next_within(timeout);
                    next.map_err(|e| Error::new(e.to_string()))
                };
                let Some(mut message) = next(RETRY)? else {
                    continue;
                };
                while let Some(newer) = next(Duration::ZERO)? {
                    message = newer;
                }
                if let Some(bytes) = published(&message) {
                    publisher.put(bytes).wait().map_err(failed)?;
                }
            }
            tracing::info!(axis = %self.axis, "set-points: no line shaft follows");
        }
    }
}

/// Returns what is published of a message of the server.
fn published(message: &Value) -> Option<Vec<u8>> {
    if message["event"] != "setpoints" {
        return None;
    }
    let value = json!({"stream": message["stream"], "points": message["points"]});
    Some(value.to_string().into_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_alone_are_published() {
        let point = json!({"unix_ns": 1_795_600_000_000_000_001_u64, "position": 0.1});
        let message = json!({"event": "setpoints", "axis": "x", "stream": "ab", "points": [point]});
        let bytes = published(&message).unwrap();
        let read: Value = serde_json::from_slice(&bytes).unwrap();
        assert_eq!(read, json!({"stream": "ab", "points": [point]}));
        assert_eq!(published(&json!({"event": "missed", "count": 3})), None);
        assert_eq!(published(&json!([])), None);
    }
}
