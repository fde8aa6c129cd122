//! The newest events of the server, for queries.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};

use serde::{Deserialize, Serialize};
use serde_json::Value;

/// The events that are kept: as many as the server keeps.
const CAPACITY: usize = 1000;

/// What distinguishes an event. Numbers alone begin again with the server.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct EventIdentity {
    /// The time in ns of the server's clock.
    pub time_ns: u64,
    /// The number.
    pub number: u64,
}

impl EventIdentity {
    /// Returns the identity of an event; `None` if the value is none.
    #[must_use]
    pub fn of(event: &Value) -> Option<Self> {
        Some(Self {
            time_ns: event["time_ns"].as_u64()?,
            number: event["number"].as_u64()?,
        })
    }
}

/// The newest events. Those about the clients of the socket are left out: each query of samples
/// would cause some.
#[derive(Debug, Default)]
pub struct Events {
    kept: Mutex<VecDeque<(EventIdentity, Value)>>,
}

impl Events {
    /// Keeps an event. Returns true if it is new.
    pub fn add(&self, event: &Value) -> bool {
        let Some(identity) = EventIdentity::of(event) else {
            return false;
        };
        let mut kept = self.lock();
        if event["event"] == "client" || kept.iter().any(|(known, _)| *known == identity) {
            return false;
        }
        kept.push_back((identity, event.clone()));
        if kept.len() > CAPACITY {
            kept.pop_front();
        }
        true
    }

    /// Returns the identity of the newest event.
    #[must_use]
    pub fn last(&self) -> Option<EventIdentity> {
        self.lock().back().map(|(identity, _)| *identity)
    }

    /// Returns the events after one; all, if it is not here.
    #[must_use]
    pub fn after(&self, known: Option<EventIdentity>) -> Vec<Value> {
        let kept = self.lock();
        let at = kept
            .iter()
            .position(|(identity, _)| Some(*identity) == known);
        let later = kept.iter().skip(at.map_or(0, |at| at + 1));
        later.map(|(_, event)| event.clone()).collect()
    }

    fn lock(&self) -> MutexGuard<'_, VecDeque<(EventIdentity, Value)>> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn event(number: u64, time_ns: u64) -> Value {
        json!({"event": "fault", "number": number, "time_ns": time_ns})
    }

    #[test]
    fn events_after_one_are_found_across_restarts_of_the_server() {
        let events = Events::default();
        for (number, time_ns) in [(1, 10), (2, 20), (1, 30), (2, 20), (2, 40)] {
            events.add(&event(number, time_ns));
        }
        let identity = |number, time_ns| Some(EventIdentity { time_ns, number });
        assert_eq!(events.after(identity(2, 20)), [event(1, 30), event(2, 40)]);
        assert_eq!(events.after(identity(2, 21)).len(), 4);
        assert_eq!(events.after(None).len(), 4);
        assert_eq!(events.last(), identity(2, 40));
    }

    #[test]
    fn events_are_bounded_and_those_of_clients_left_out() {
        let events = Events::default();
        assert!(!events.add(&json!({"event": "client", "number": 1, "time_ns": 1})));
        assert!(!events.add(&json!({"event": "missed", "count": 1})));
        for number in 0..1100 {
            assert!(events.add(&event(number, number)));
        }
        assert_eq!(events.after(None).len(), CAPACITY);
    }
}
