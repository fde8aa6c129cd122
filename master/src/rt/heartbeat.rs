//! Detects a supervisor thread that no longer runs. Without the supervisor, no step of the program
//! ends, no device is polled and no operator can stop the machine.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::clock::Nanos;

/// Longer than a busy computer delays a thread without real-time priority.
const TIMEOUT: Nanos = 2_000_000_000;

/// The counter that the supervisor increments at every poll.
#[derive(Debug, Clone, Default)]
pub struct Heartbeat(Arc<AtomicU64>);

impl Heartbeat {
    pub fn beat(&self) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

/// The cycle's view of the heartbeat.
#[derive(Debug, Default)]
pub(super) struct Watch {
    last: u64,
    /// The cycle time accumulated since the last beat. A suspended process runs no cycles.
    silent_ns: Nanos,
}

impl Watch {
    /// Call once per cycle. Returns true once the heartbeat was missing for too long. Before the
    /// first beat, there is no supervisor to miss.
    pub fn is_silent(&mut self, heartbeat: &Heartbeat, cycle_ns: Nanos) -> bool {
        let beats = heartbeat.0.load(Ordering::Relaxed);
        if beats == self.last {
            self.silent_ns = self.silent_ns.saturating_add(cycle_ns);
        } else {
            *self = Self {
                last: beats,
                silent_ns: 0,
            };
        }
        beats > 0 && self.silent_ns > TIMEOUT
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heartbeat_is_silent_only_after_a_first_beat() {
        const CYCLE: Nanos = 1_000_000;
        let (heartbeat, mut watch) = (Heartbeat::default(), Watch::default());
        let silent = |watch: &mut Watch, cycles: u64| {
            let each = (0..cycles).map(|_| watch.is_silent(&heartbeat, CYCLE));
            each.filter(|silent| *silent).count()
        };
        assert_eq!(silent(&mut watch, 5000), 0, "no heartbeat yet");
        heartbeat.beat();
        assert_eq!(silent(&mut watch, 2001), 0);
        assert_eq!(silent(&mut watch, 10), 10);
        heartbeat.beat();
        assert_eq!(silent(&mut watch, 2001), 0, "it is back");
    }
}
