//! Digital inputs: the track's switches and external signals, shown in 0x60FD.

use super::plant::{Plant, PlantParams};
use super::travel::{Edge, Span, Track};

/// Bits of 0x60FD (CiA 402-2, "digital inputs"). Bits from 16 on are vendor-specific.
pub mod input {
    /// Negative limit switch.
    pub const NEGATIVE_LIMIT: u8 = 0;
    /// Positive limit switch.
    pub const POSITIVE_LIMIT: u8 = 1;
    /// Home switch.
    pub const HOME: u8 = 2;
    /// The first general-purpose input.
    pub const GENERAL: u8 = 16;
    /// The input of touch probe 1.
    pub const TOUCH_PROBE_1: u8 = 24;
    /// The input of touch probe 2.
    pub const TOUCH_PROBE_2: u8 = 25;
}

/// The bits of the spans of [`Track::spans`], in the same order.
pub(super) const SWITCHES: [u8; 5] = [
    input::NEGATIVE_LIMIT,
    input::POSITIVE_LIMIT,
    input::HOME,
    input::TOUCH_PROBE_1,
    input::TOUCH_PROBE_2,
];

/// Capacity for external changes, with their time, until the next control cycle.
const CHANGES: usize = 4;

#[derive(Debug, Clone, Copy)]
struct Change {
    bit: u8,
    on: bool,
    /// The fraction of the control period at which the change occurred.
    after: f64,
    counts: i64,
}

#[derive(Debug, Clone)]
pub(super) struct Inputs {
    track: Track,
    spans: [Span; 5],
    /// True if the track has a switch. Otherwise the spans are not searched.
    any: bool,
    turn: i64,
    /// The levels of the external signals.
    outside: u32,
    changes: [Option<Change>; CHANGES],
    /// The changes of the last control cycle.
    passed: [Option<Change>; CHANGES],
    /// Bits that read inverted: normally closed contacts, XOR the polarity of 0x3141:02.
    inverted: u32,
    /// Bits that have a configured input.
    live: u32,
    from: i64,
    to: i64,
    /// The plant's position at the end of the last cycle, with fraction.
    exact: f64,
    on: u32,
    rose: u32,
    shown: Option<u32>,
}

impl Inputs {
    pub(super) fn new(plant: &PlantParams, motor: &Plant) -> Self {
        let track = plant.track;
        Self {
            track,
            spans: track.spans(),
            any: track
                != Track {
                    index: track.index,
                    ends: track.ends,
                    ..Track::default()
                },
            turn: plant.counts_per_turn.max(1).into(),
            outside: 0,
            changes: [None; CHANGES],
            passed: [None; CHANGES],
            inverted: track.normally_closed,
            live: u32::MAX,
            from: motor.counts(),
            to: motor.counts(),
            exact: motor.position(),
            on: 0,
            rose: 0,
            shown: None,
        }
    }

    /// Sets an external signal at this fraction of the current control period.
    pub(super) fn set(&mut self, bit: u8, on: bool, after: f64) {
        let Some(mask) = 1_u32.checked_shl(bit.into()) else {
            return;
        };
        if (self.outside & mask != 0) == on {
            return;
        }
        self.outside ^= mask;
        if let Some(free) = self.changes.iter_mut().find(|change| change.is_none()) {
            *free = Some(Change {
                bit,
                on,
                after: after.clamp(0.0, 1.0),
                counts: 0,
            });
        }
    }

    /// Sets the inverted bits (0x3141:02) and the bits that have an input (0x3142).
    pub(super) fn configure(&mut self, polarity: u32, live: u32) {
        self.inverted = self.track.normally_closed ^ polarity;
        self.live = live;
    }

    /// Reads the external signals.
    pub(super) fn refresh(&mut self) {
        self.on = self.levels();
    }

    /// Evaluates the last control cycle.
    pub(super) fn advance(&mut self, motor: &Plant) {
        self.from = self.to;
        self.to = motor.counts();
        if self.changes[0].is_some() || self.passed[0].is_some() {
            let (from, to) = (self.exact, motor.position());
            self.passed = std::mem::take(&mut self.changes);
            for change in self.passed.iter_mut().flatten() {
                change.counts = whole_counts(from + change.after * (to - from));
            }
        }
        self.exact = motor.position();
        let before = self.on;
        self.on = self.levels();
        self.rose = self.on & !before;
    }

    fn levels(&self) -> u32 {
        let mut closed = self.outside;
        if self.any {
            for (span, bit) in self.spans.iter().zip(SWITCHES) {
                closed |= u32::from(span.holds(self.to)) << bit;
            }
        }
        (closed ^ self.inverted) & self.live
    }

    /// Returns 0x60FD if it changed since the last call.
    pub(super) fn take_change(&mut self) -> Option<u32> {
        let shown = self.shown.replace(self.on);
        (shown != Some(self.on)).then_some(self.on)
    }

    /// Returns 0x60FD.
    pub(super) fn all(&self) -> u32 {
        self.on
    }

    pub(super) fn is_on(&self, bit: u8) -> bool {
        self.on & 1 << bit != 0
    }

    /// True if the input switched on in the last control cycle.
    pub(super) fn rose(&self, bit: u8) -> bool {
        self.rose & 1 << bit != 0
    }

    /// Returns the edges of an input in the last control cycle, in order, with their positions.
    pub(super) fn edges(&self, bit: u8) -> impl Iterator<Item = Edge> + '_ {
        let inverted = self.inverted & 1 << bit != 0;
        let span = SWITCHES.iter().position(|&b| b == bit);
        let on_the_way = span
            .and_then(|n| self.spans.get(n))
            .map_or([None; 2], |span| span.edges(self.from, self.to));
        let from_outside = self.passed.iter().flatten().filter(move |c| c.bit == bit);
        on_the_way
            .into_iter()
            .flatten()
            .chain(from_outside.map(|change| Edge {
                on: change.on,
                counts: change.counts,
            }))
            .map(move |edge| Edge {
                on: edge.on != inverted,
                ..edge
            })
    }

    /// Returns the index pulse that the axis passed in the last control cycle.
    pub(super) fn index(&self) -> Option<i64> {
        self.index_since(self.from)
    }

    /// Returns the first index pulse between a count and the present one.
    pub(super) fn index_since(&self, counts: i64) -> Option<i64> {
        self.track.index_between(self.turn, counts, self.to)
    }

    pub(super) fn turn(&self) -> i64 {
        self.turn
    }
}

#[expect(
    clippy::cast_possible_truncation,
    reason = "saturates far beyond any axis"
)]
fn whole_counts(position: f64) -> i64 {
    position.floor() as i64
}
