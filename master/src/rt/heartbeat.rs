//! Whether the thread beside the cycle still runs: without it no step ends, no device is asked, and nobody can stop the machine.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::clock::Nanos;

/// Longer than a busy computer keeps a thread without real-time priority waiting.
const TIMEOUT: Nanos = 2_000_000_000;

/// Beats as often as the supervisor is polled.
#[derive(Debug, Clone, Default)]
pub struct Heartbeat(Arc<AtomicU64>);

impl Heartbeat {
    pub fn beat(&self) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

/// The cycle's view of it.
#[derive(Debug, Default)]
pub(super) struct Watch {
    last: u64,
    /// Time of the cycles since the last beat. A suspended process turns no cycles.
    silent_ns: Nanos,
}

impl Watch {
    /// Looks once a cycle; true once it has been silent for too long. Before the first beat there is no supervisor.
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
    fn only_a_supervisor_that_has_run_falls_silent() {
        const CYCLE: Nanos = 1_000_000;
        let (heartbeat, mut watch) = (Heartbeat::default(), Watch::default());
        let silent = |watch: &mut Watch, cycles: u64| {
            let each = (0..cycles).map(|_| watch.is_silent(&heartbeat, CYCLE));
            each.filter(|silent| *silent).count()
        };
        assert_eq!(silent(&mut watch, 5000), 0, "nobody is there yet");
        heartbeat.beat();
        assert_eq!(silent(&mut watch, 2001), 0);
        assert_eq!(silent(&mut watch, 10), 10);
        heartbeat.beat();
        assert_eq!(silent(&mut watch, 2001), 0, "it is back");
    }
}
