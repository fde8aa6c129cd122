//! Digital inputs: from the track's switches and the wires outside to 0x60FD.

use super::plant::{Plant, PlantParams};
use super::track::{Edge, Span, Track};

/// Bits of 0x60FD (CiA 402-2, "digital inputs"); from 16 on they are the maker's own.
pub mod input {
    pub const NEGATIVE_LIMIT: u8 = 0;
    pub const POSITIVE_LIMIT: u8 = 1;
    pub const HOME: u8 = 2;
    /// The first of the general purpose inputs.
    pub const GENERAL: u8 = 16;
    pub const TOUCH_PROBE_1: u8 = 24;
    pub const TOUCH_PROBE_2: u8 = 25;
}

/// The bits of what [`Track::spans`] returns.
pub(super) const SWITCHES: [u8; 5] = [
    input::NEGATIVE_LIMIT,
    input::POSITIVE_LIMIT,
    input::HOME,
    input::TOUCH_PROBE_1,
    input::TOUCH_PROBE_2,
];

/// Changes from outside that are remembered with their time until the next control cycle.
const CHANGES: usize = 4;

#[derive(Debug, Clone, Copy)]
struct Change {
    bit: u8,
    on: bool,
    /// Share of the control period that had passed; once resolved, the position is in `counts`.
    after: f64,
    counts: i64,
}

#[derive(Debug, Clone)]
pub(super) struct Inputs {
    track: Track,
    spans: [Span; 5],
    /// Without a switch on the track nothing is looked for.
    any: bool,
    turn: i64,
    /// What the wires from outside carry.
    outside: u32,
    changes: [Option<Change>; CHANGES],
    /// Changes of the control cycle that has just passed.
    passed: [Option<Change>; CHANGES],
    /// Bits that read inverted: normally closed contacts, less what 0x3141:02 turns back.
    inverted: u32,
    /// Bits that some input is configured for.
    live: u32,
    from: i64,
    to: i64,
    /// Where the plant stood exactly.
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

    /// From outside, after this share of the control period under way.
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

    /// 0x3141:02 and 0x3142: bits whose polarity is inverted, bits that have an input.
    pub(super) fn configure(&mut self, polarity: u32, live: u32) {
        self.inverted = self.track.normally_closed ^ polarity;
        self.live = live;
    }

    /// Wires from outside are looked at.
    pub(super) fn refresh(&mut self) {
        self.on = self.levels();
    }

    /// The control cycle that has passed.
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

    /// 0x60FD, if it is not what was taken last.
    pub(super) fn take_change(&mut self) -> Option<u32> {
        let shown = self.shown.replace(self.on);
        (shown != Some(self.on)).then_some(self.on)
    }

    /// 0x60FD.
    pub(super) fn all(&self) -> u32 {
        self.on
    }

    pub(super) fn is_on(&self, bit: u8) -> bool {
        self.on & 1 << bit != 0
    }

    /// Went on in the control cycle that has passed.
    pub(super) fn rose(&self, bit: u8) -> bool {
        self.rose & 1 << bit != 0
    }

    /// What an input did in the control cycle that has passed, in order, and where.
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

    /// The index pulse that the control cycle that has passed went over.
    pub(super) fn index(&self) -> Option<i64> {
        self.index_since(self.from)
    }

    /// The first index pulse between a count and the present one.
    pub(super) fn index_since(&self, counts: i64) -> Option<i64> {
        self.track.index_between(self.turn, counts, self.to)
    }

    pub(super) fn turn(&self) -> i64 {
        self.turn
    }
}

#[expect(clippy::cast_possible_truncation, reason = "saturates, centuries away")]
fn whole_counts(position: f64) -> i64 {
    position.floor() as i64
}
