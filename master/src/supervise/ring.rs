//! Reports when a cable of the ring breaks, and when the ring is closed again.

use super::Supervisor;
use crate::clock::{self, Nanos};
use crate::link::redundant::RingState;
use crate::report::Progress;
use crate::text::pluralize;

/// A plug bounces: a state that rests for this time, in ns, is reported.
const SETTLING_TIME: Nanos = 20_000_000;

/// The period in ns in which short breaks are counted.
const COUNT_PERIOD: Nanos = 1_000_000_000;

/// The period in ns in which the links of the interfaces are read.
const LINK_PERIOD: Nanos = 100_000_000;

/// The state of the ring, and for each interface whether it has no link.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Seen {
    state: RingState,
    no_link: [bool; 2],
}

/// What was reported last, and what was seen later with the time of its begin.
#[derive(Debug, Default)]
pub(crate) struct RingWatch {
    reported: Option<Seen>,
    next: Option<(Seen, Nanos)>,
    /// The links, and when they are read again.
    no_link: [bool; 2],
    read_at: Nanos,
    /// The breaks that were counted up to the last report, and when they are counted again.
    breaks: u32,
    count_at: Nanos,
}

impl RingWatch {
    /// `state`: that of the bring-up, as it was reported.
    pub(crate) fn new(state: Option<RingState>) -> Self {
        Self {
            reported: state.map(|state| Seen {
                state,
                no_link: [false; 2],
            }),
            ..Self::default()
        }
    }

    /// Returns what has rested for [`SETTLING_TIME`] and was not reported last.
    fn changed(&mut self, seen: Seen, now: Nanos) -> Option<Seen> {
        let reported = *self.reported.get_or_insert(seen);
        if seen == reported {
            self.next = None;
            return None;
        }
        match self.next {
            Some((next, since)) if next == seen => {
                let rests = now.saturating_sub(since) >= SETTLING_TIME;
                let changed = rests.then_some(seen)?;
                (self.reported, self.next) = (Some(changed), None);
                Some(changed)
            }
            _ => {
                self.next = Some((seen, now));
                None
            }
        }
    }

    /// Returns the number of breaks in the last second that were too short for a report.
    fn short_breaks(&mut self, breaks: u32, reported: bool, now: Nanos) -> Option<u32> {
        if reported {
            self.breaks = breaks;
        }
        if now < self.count_at || self.next.is_some() {
            return None;
        }
        self.count_at = now.saturating_add(COUNT_PERIOD);
        let more = breaks.wrapping_sub(std::mem::replace(&mut self.breaks, breaks));
        (more > 0).then_some(more)
    }
}

impl Supervisor {
    pub(super) fn follow_ring(&mut self) {
        let Some(ring) = self.wire.ring_status() else {
            return;
        };
        if ring.is_open_for_measurement() {
            return;
        }
        let now = clock::now();
        if now >= self.ring.read_at {
            self.ring.read_at = now.saturating_add(LINK_PERIOD);
            for (no_link, (_, has_link)) in self.ring.no_link.iter_mut().zip(ring.links()) {
                *no_link = !has_link;
            }
        }
        let seen = Seen {
            state: ring.get(),
            no_link: self.ring.no_link,
        };
        let changed = self.ring.changed(seen, now);
        let (breaks, place) = self.wire.breaks();
        let short = self.ring.short_breaks(breaks, changed.is_some(), now);
        let name = |position| {
            let devices = &mut self.bus.devices.iter();
            let device = devices.find(|device| device.at.position == position);
            device.map_or_else(|| format!("device {position}"), |d| d.at.name.clone())
        };
        if let Some(count) = short {
            let behind = match self.bus.in_front_of(place) {
                Some(before) => format!("behind `{}`", name(before)),
                None => "in front of the first device".to_owned(),
            };
            let times = pluralize(count as usize, "time");
            self.report(Progress::Warning(format!(
                "the ring was broken for short {times}, last {behind}: look for a loose plug or a damaged cable"
            )));
        }
        let Some(Seen { state, no_link }) = changed else {
            return;
        };
        let in_front = |position| self.bus.in_front_of(position);
        let mut text = state.text(self.bus.devices.len(), name, in_front);
        for ((nic, _), _) in ring.links().zip(no_link).filter(|(_, no_link)| *no_link) {
            text += &format!("; `{nic}` has no link");
        }
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
        let seen = |state| Seen {
            state,
            no_link: [false; 2],
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
        assert_eq!(watch.short_breaks(1, true, 0), None);
        assert_eq!(watch.short_breaks(3, false, 1_000 * ms), Some(2));
        assert_eq!(watch.short_breaks(4, false, 1_001 * ms), None);
        assert_eq!(watch.short_breaks(4, false, 2_001 * ms), Some(1));
        for (at, state, expected) in table {
            assert_eq!(
                watch.changed(seen(state), at * ms),
                expected.map(seen),
                "{at} ms"
            );
        }
    }
}
