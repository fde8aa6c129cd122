//! Reports when a cable of the ring breaks, and when the ring is closed again.

use super::Supervisor;
use crate::clock::{self, Nanos};
use crate::link::redundant::RingState;
use crate::report::Progress;

/// A plug bounces: a state that rests for this time, in ns, is reported.
const SETTLING_TIME: Nanos = 20_000_000;

/// The state of the ring that was reported last, and a later one with the time of its begin.
#[derive(Debug, Default)]
pub(crate) struct RingWatch {
    reported: Option<RingState>,
    next: Option<(RingState, Nanos)>,
}

impl RingWatch {
    /// Returns a state that has rested for [`SETTLING_TIME`] and is another one than the last. The
    /// first state is known from the bring-up.
    fn changed(&mut self, state: RingState, now: Nanos) -> Option<RingState> {
        let reported = *self.reported.get_or_insert(state);
        if state == reported {
            self.next = None;
            return None;
        }
        match self.next {
            Some((next, since)) if next == state => {
                let rests = now.saturating_sub(since) >= SETTLING_TIME;
                let changed = rests.then_some(state)?;
                (self.reported, self.next) = (Some(changed), None);
                Some(changed)
            }
            _ => {
                self.next = Some((state, now));
                None
            }
        }
    }
}

impl Supervisor {
    pub(super) fn follow_ring(&mut self) {
        let Some(state) = self.wire.ring() else {
            return;
        };
        let Some(state) = self.ring.changed(state, clock::now()) else {
            return;
        };
        let name = |position| {
            let devices = &mut self.bus.devices.iter();
            let device = devices.find(|device| device.at.position == position);
            device.map_or_else(|| format!("device {position}"), |d| d.at.name.clone())
        };
        let text = state.text(self.bus.devices.len(), name);
        let broken = state != RingState::Closed;
        self.report(Progress::Ring { text, broken });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_state_that_rests_is_reported_once() {
        let broken = RingState::Broken {
            behind: 2,
            devices: 4,
        };
        let mut watch = RingWatch::default();
        let ms = 1_000_000;
        let table = [
            (0, RingState::Closed, None),
            (1, broken, None),
            (2, RingState::Closed, None),
            (3, broken, None),
            (22, broken, None),
            (23, broken, Some(broken)),
            (24, broken, None),
            (30, RingState::Closed, None),
            (50, RingState::Closed, Some(RingState::Closed)),
            (90, RingState::Closed, None),
        ];
        for (at, state, expected) in table {
            assert_eq!(watch.changed(state, at * ms), expected, "{at} ms");
        }
    }
}
