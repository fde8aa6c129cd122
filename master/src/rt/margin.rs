//! When sleeping ends and spinning begins.

use super::exchange::Mode;
use crate::clock::Nanos;

/// Spinning never begins later than this before the release, nor earlier than `LONGEST` or a share of the cycle.
const SHORTEST: Nanos = 20_000;
const LONGEST: Nanos = 200_000;

/// What may be spun of a cycle, in hundredths. A quarter of a cycle of 250 µs is less than busy computers need. Who takes answers a
/// cycle later does so to save processor time, and a short cycle must not spend that again.
const fn share(mode: Mode) -> Nanos {
    match mode {
        Mode::SameCycle => 40,
        Mode::Pipelined => 16,
    }
}

/// Where the margin begins before anything is known.
const FIRST: Nanos = 100_000;

/// What one late wake-up adds, however late it was, and what one in time takes away. The margin is at rest where late ones
/// are as rare as the one is smaller than the other: one in a thousand.
const RISE: Nanos = 10_000;
const FALL: Nanos = RISE / 999;

/// How long before a release the thread is awake.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Spin {
    /// As long as the sleep itself turns out to need.
    #[default]
    Auto,
    /// So long; 0 is sleeping alone.
    For(Nanos),
}

impl Spin {
    /// The longest that is ever spun.
    #[must_use]
    pub fn longest(self, cycle: Nanos, mode: Mode) -> Nanos {
        match self {
            Self::Auto => LONGEST.min(cycle / 100 * share(mode)),
            Self::For(fixed) => fixed,
        }
    }
}

/// The margin as it is. With [`Spin::Auto`] it follows the 99.9th percentile of how late sleeping ends, by steps of
/// constant size: a single outlier moves it by 10 µs whatever its size, and ten in a row by 100 µs.
#[derive(Debug, Clone, Copy)]
pub struct Margin {
    now: Nanos,
    /// `None` where it is fixed.
    bounds: Option<(Nanos, Nanos)>,
}

impl Margin {
    #[must_use]
    pub fn new(spin: Spin, cycle: Nanos, mode: Mode) -> Self {
        match spin {
            Spin::For(now) => Self { now, bounds: None },
            Spin::Auto => {
                let high = spin.longest(cycle, mode);
                Self {
                    now: FIRST.min(high),
                    bounds: Some((SHORTEST.min(high), high)),
                }
            }
        }
    }

    /// Nanoseconds before the release. RT.
    #[must_use]
    pub fn get(&self) -> Nanos {
        self.now
    }

    /// Takes in how late a sleep ended; `None` where there was nothing to sleep. RT: O(1).
    pub fn slept(&mut self, late: Option<Nanos>) {
        if let (Some(late), Some((low, high))) = (late, self.bounds) {
            let next = if late > self.now {
                self.now + RISE
            } else {
                self.now.saturating_sub(FALL)
            };
            self.now = next.clamp(low, high);
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const MS: Nanos = 1_000_000;

    /// The margin's course over a day like this.
    fn course(lates: impl Iterator<Item = Nanos>) -> Vec<Nanos> {
        let mut margin = Margin::new(Spin::Auto, MS, Mode::SameCycle);
        lates
            .map(|late| {
                margin.slept(Some(late));
                margin.get()
            })
            .collect()
    }

    /// Every `each`th one is late by `rare`, the others by `usual`.
    fn lates(usual: Nanos, rare: Nanos, each: usize) -> impl Iterator<Item = Nanos> {
        (1_usize..).map(move |n| if n.is_multiple_of(each) { rare } else { usual })
    }

    #[test]
    fn a_quiet_machine_spins_little() {
        let course = course(lates(5_000, 15_000, 100).take(20_000));
        assert_eq!(course.last(), Some(&SHORTEST));
    }

    #[test]
    fn what_is_late_one_time_in_a_hundred_is_covered() {
        let course = course(lates(5_000, 60_000, 100).take(60_000));
        let settled = &course[30_000..];
        let covered = settled.iter().filter(|margin| **margin >= 60_000).count();
        assert!(covered * 10 > settled.len() * 8, "{covered}");
        assert!(settled.iter().all(|margin| *margin <= 75_000));
    }

    #[test]
    fn what_is_late_one_time_in_ten_thousand_is_not_waited_for() {
        let course = course(lates(5_000, 5_000_000, 10_000).take(100_000));
        assert!(
            course[50_000..]
                .iter()
                .all(|margin| *margin <= SHORTEST + RISE)
        );
    }

    #[test]
    fn one_outlier_is_one_step_and_a_worse_machine_is_met_within_a_second() {
        let mut margin = Margin::new(Spin::Auto, MS, Mode::SameCycle);
        (0..20_000).for_each(|_| margin.slept(Some(1_000)));
        assert_eq!(margin.get(), SHORTEST);
        margin.slept(Some(50 * MS));
        assert_eq!(margin.get(), SHORTEST + RISE);
        for late in lates(10_000, 150_000, 20).take(1_000) {
            margin.slept(Some(late));
        }
        assert!(margin.get() >= 150_000);
    }

    #[test]
    fn short_cycles_are_not_spent_on_spinning() {
        for (cycle, same_cycle, pipelined) in [
            (62_500, 25_000, 10_000),
            (125_000, 50_000, 20_000),
            (250_000, 100_000, 40_000),
            (MS, 200_000, 160_000),
            (10 * MS, 200_000, 200_000),
        ] {
            for (mode, longest) in [(Mode::SameCycle, same_cycle), (Mode::Pipelined, pipelined)] {
                assert_eq!(Spin::Auto.longest(cycle, mode), longest);
                let mut margin = Margin::new(Spin::Auto, cycle, mode);
                (0..100).for_each(|_| margin.slept(Some(MS)));
                assert_eq!(margin.get(), longest);
            }
        }
    }

    #[test]
    fn a_fixed_margin_stays() {
        let mut margin = Margin::new(Spin::For(0), MS, Mode::SameCycle);
        margin.slept(Some(MS));
        assert_eq!(margin.get(), 0);
    }

    proptest! {
        #[test]
        fn never_out_of_bounds(
            cycle in 50_000_u64..100_000_000,
            mode in prop::sample::select(vec![Mode::SameCycle, Mode::Pipelined]),
            lates in prop::collection::vec(prop::option::of(0_u64..1_000_000), 0..500),
        ) {
            let mut margin = Margin::new(Spin::Auto, cycle, mode);
            let high = Spin::Auto.longest(cycle, mode);
            let low = SHORTEST.min(high);
            prop_assert!((low..=high).contains(&margin.get()));
            for late in lates {
                let before = margin.get();
                margin.slept(late);
                prop_assert!((low..=high).contains(&margin.get()));
                prop_assert!(margin.get().abs_diff(before) <= RISE);
            }
        }
    }
}
