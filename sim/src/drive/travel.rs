//! The travel of the axis: switches, touch probe targets, index pulses, mechanical ends.

/// The travel of an axis. All positions are in encoder counts as 0x6064 shows them at power-on,
/// before any homing. A switch is on from its first count to its last, both included. The default
/// is a rotary axis without switches and with one index pulse per turn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Track {
    /// On at this count and everywhere below.
    pub negative_limit: Option<i32>,
    /// On at this count and everywhere above.
    pub positive_limit: Option<i32>,
    /// The count range in which the home switch is on.
    pub home: Option<(i32, i32)>,
    /// Count ranges in which the inputs of touch probes 1 and 2 are on.
    pub probes: [Option<(i32, i32)>; 2],
    /// The index pulse lies at this count and every turn from it. `None`: an encoder without index.
    pub index: Option<i32>,
    /// The positions of the mechanical ends.
    pub ends: Option<(i32, i32)>,
    /// Bits of 0x60FD with normally closed contacts.
    pub normally_closed: u32,
}

impl Default for Track {
    fn default() -> Self {
        Self {
            negative_limit: None,
            positive_limit: None,
            home: None,
            probes: [None; 2],
            index: Some(0),
            ends: None,
            normally_closed: 0,
        }
    }
}

/// The range of counts in which a switch is on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Span {
    pub first: i64,
    pub last: i64,
}

/// An edge that the axis passed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Edge {
    pub on: bool,
    /// The first count behind the edge, in the direction of motion.
    pub counts: i64,
}

impl Span {
    const NOWHERE: Self = Self { first: 1, last: 0 };

    fn between(range: Option<(i32, i32)>) -> Self {
        range.map_or(Self::NOWHERE, |(first, last)| Self {
            first: first.into(),
            last: last.into(),
        })
    }

    pub(super) fn holds(self, counts: i64) -> bool {
        self.first <= counts && counts <= self.last
    }

    /// Returns the edges from `from` to `to`, in the order in which the axis passes them.
    pub(super) fn edges(self, from: i64, to: i64) -> [Option<Edge>; 2] {
        if self.first > self.last {
            return [None; 2];
        }
        let edge = |on, counts: Option<i64>| counts.map(|counts| Edge { on, counts });
        if to > from {
            let passed = |at: i64| (from < at && at <= to).then_some(at);
            [
                edge(true, passed(self.first)),
                edge(false, passed(self.last.saturating_add(1))),
            ]
        } else {
            let passed = |at: i64| (to <= at && at < from).then_some(at);
            [
                edge(true, passed(self.last)),
                edge(false, passed(self.first.saturating_sub(1))),
            ]
        }
    }
}

impl Track {
    /// Returns the spans in the order of [`super::io::SWITCHES`].
    pub(super) fn spans(&self) -> [Span; 5] {
        let [first, second] = self.probes;
        [
            Span {
                first: i64::MIN,
                last: self.negative_limit.map_or(i64::MIN, i64::from),
            },
            Span {
                first: self.positive_limit.map_or(i64::MAX, i64::from),
                last: i64::MAX,
            },
            Span::between(self.home),
            Span::between(first),
            Span::between(second),
        ]
    }

    /// Returns the first index pulse behind `from` in the direction of `to`.
    pub(super) fn index_between(&self, turn: i64, from: i64, to: i64) -> Option<i64> {
        let offset = i64::from(self.index?);
        let turn = turn.max(1);
        // Whole turns from the offset, rounded in the direction of motion.
        let found = if to > from {
            offset + ((from - offset).div_euclid(turn) + 1) * turn
        } else {
            offset + (from - 1 - offset).div_euclid(turn) * turn
        };
        let (low, high) = (from.min(to), from.max(to));
        (low <= found && found <= high && found != from).then_some(found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spans_report_edges_at_their_first_and_last_count() {
        let span = Span {
            first: 10,
            last: 12,
        };
        let on = |counts| Some(Edge { on: true, counts });
        let off = |counts| Some(Edge { on: false, counts });
        let rows = [
            (0, 9, [None, None]),
            (0, 10, [on(10), None]),
            (10, 12, [None, None]),
            (10, 13, [None, off(13)]),
            (9, 20, [on(10), off(13)]),
            (20, 13, [None, None]),
            (20, 12, [on(12), None]),
            (12, 10, [None, None]),
            (12, 9, [None, off(9)]),
            (13, 0, [on(12), off(9)]),
            (11, 11, [None, None]),
        ];
        for (from, to, edges) in rows {
            assert_eq!(span.edges(from, to), edges, "{from} to {to}");
            let (mut state, end) = (span.holds(from), span.holds(to));
            for edge in edges.into_iter().flatten() {
                assert_ne!(state, edge.on, "{from} to {to}");
                state = edge.on;
            }
            assert_eq!(state, end, "{from} to {to}");
        }
        assert_eq!(Span::NOWHERE.edges(-5, 5), [None; 2]);
    }

    #[test]
    fn missing_limit_switches_are_never_on() {
        let [negative, positive, ..] = Track::default().spans();
        for counts in [i64::from(i32::MIN) * 4, 0, i64::from(i32::MAX) * 4] {
            assert!(!negative.holds(counts) && !positive.holds(counts));
        }
    }

    #[test]
    fn index_pulses_repeat_every_turn() {
        let track = Track {
            index: Some(-250),
            ..Track::default()
        };
        let rows = [
            (0, 1749, None),
            (0, 1750, Some(1750)),
            (1750, 1751, None),
            (1750, 3750, Some(3750)),
            (0, -249, None),
            (0, -250, Some(-250)),
            (-250, -2249, None),
            (-250, -5000, Some(-2250)),
            (-251, -249, Some(-250)),
            (7, 7, None),
        ];
        for (from, to, index) in rows {
            assert_eq!(track.index_between(2000, from, to), index, "{from} to {to}");
        }
        let none = Track {
            index: None,
            ..track
        };
        assert_eq!(none.index_between(2000, 0, 10_000), None);
    }
}
