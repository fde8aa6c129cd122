//! The end of sleeping and the start of spinning before a release.

use super::exchange::ExchangeMode;
use crate::clock::Nanos;

/// How long before a release the real-time thread is awake.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Spin {
    /// Adapts to the measured wake-up lateness.
    #[default]
    Auto,
    /// A fixed time in ns; 0 means sleep only.
    For(u64),
}

/// Spinning begins at least this long before the release. It never begins earlier than `LONGEST` or
/// a share of the cycle.
const SHORTEST: Nanos = 20_000;
const LONGEST: Nanos = 200_000;

/// Returns the maximum spin time in percent of the cycle. A quarter of a 250 µs cycle is too little
/// on a busy host. Pipelined mode exists to save CPU time, so its share is smaller.
const fn share(mode: ExchangeMode) -> Nanos {
    match mode {
        ExchangeMode::SameCycle => 40,
        ExchangeMode::Pipelined => 16,
    }
}

/// The initial spin time.
const FIRST: Nanos = 100_000;

/// A late wake-up adds `RISE`, however late it was; one in time subtracts `FALL`. The spin time is
/// in balance when one wake-up in a thousand is late.
const RISE: Nanos = 10_000;
const FALL: Nanos = RISE / 999;

impl Spin {
    /// Returns the upper bound of the spin time.
    #[must_use]
    pub fn longest(self, cycle: Nanos, mode: ExchangeMode) -> Nanos {
        match self {
            Self::Auto => LONGEST.min(cycle / 100 * share(mode)),
            Self::For(fixed) => fixed,
        }
    }
}

/// The current spin time. With [`Spin::Auto`] it follows the 99.9th percentile of the wake-up
/// lateness in steps of constant size. One outlier of any size moves it by 10 µs, ten in a row by
/// 100 µs.
#[derive(Debug, Clone, Copy)]
pub struct SpinWindow {
    now: Nanos,
    /// The bounds; `None` for a fixed time.
    bounds: Option<(Nanos, Nanos)>,
}

impl SpinWindow {
    #[must_use]
    pub fn new(spin: Spin, cycle: Nanos, mode: ExchangeMode) -> Self {
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

    /// Returns the spin time before the release in ns. RT.
    #[must_use]
    pub fn get(&self) -> Nanos {
        self.now
    }

    /// Processes the lateness of a wake-up; `None` if the thread did not sleep. RT: O(1).
    pub fn record_wakeup(&mut self, late: Option<Nanos>) {
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

    /// Returns the spin times over a sequence of wake-ups.
    fn course(lates: impl Iterator<Item = Nanos>) -> Vec<Nanos> {
        let mut margin = SpinWindow::new(Spin::Auto, MS, ExchangeMode::SameCycle);
        lates
            .map(|late| {
                margin.record_wakeup(Some(late));
                margin.get()
            })
            .collect()
    }

    /// Every `each`th wake-up is late by `rare`, the others by `usual`.
    fn lates(usual: Nanos, rare: Nanos, each: usize) -> impl Iterator<Item = Nanos> {
        (1_usize..).map(move |n| if n.is_multiple_of(each) { rare } else { usual })
    }

    #[test]
    fn spin_window_is_small_on_a_quiet_machine() {
        let course = course(lates(5_000, 15_000, 100).take(20_000));
        assert_eq!(course.last(), Some(&SHORTEST));
    }

    #[test]
    fn spin_window_covers_one_late_wakeup_in_a_hundred() {
        let course = course(lates(5_000, 60_000, 100).take(60_000));
        let settled = &course[30_000..];
        let covered = settled.iter().filter(|margin| **margin >= 60_000).count();
        assert!(covered * 10 > settled.len() * 8, "{covered}");
        assert!(settled.iter().all(|margin| *margin <= 75_000));
    }

    #[test]
    fn spin_window_ignores_one_late_wakeup_in_ten_thousand() {
        let course = course(lates(5_000, 5_000_000, 10_000).take(100_000));
        assert!(
            course[50_000..]
                .iter()
                .all(|margin| *margin <= SHORTEST + RISE)
        );
    }

    #[test]
    fn spin_window_grows_one_step_per_outlier_and_adapts_within_a_second() {
        let mut margin = SpinWindow::new(Spin::Auto, MS, ExchangeMode::SameCycle);
        (0..20_000).for_each(|_| margin.record_wakeup(Some(1_000)));
        assert_eq!(margin.get(), SHORTEST);
        margin.record_wakeup(Some(50 * MS));
        assert_eq!(margin.get(), SHORTEST + RISE);
        for late in lates(10_000, 150_000, 20).take(1_000) {
            margin.record_wakeup(Some(late));
        }
        assert!(margin.get() >= 150_000);
    }

    #[test]
    fn spin_window_is_bounded_in_short_cycles() {
        for (cycle, same_cycle, pipelined) in [
            (62_500, 25_000, 10_000),
            (125_000, 50_000, 20_000),
            (250_000, 100_000, 40_000),
            (MS, 200_000, 160_000),
            (10 * MS, 200_000, 200_000),
        ] {
            for (mode, longest) in [
                (ExchangeMode::SameCycle, same_cycle),
                (ExchangeMode::Pipelined, pipelined),
            ] {
                assert_eq!(Spin::Auto.longest(cycle, mode), longest);
                let mut margin = SpinWindow::new(Spin::Auto, cycle, mode);
                (0..100).for_each(|_| margin.record_wakeup(Some(MS)));
                assert_eq!(margin.get(), longest);
            }
        }
    }

    #[test]
    fn fixed_spin_window_never_changes() {
        let mut margin = SpinWindow::new(Spin::For(0), MS, ExchangeMode::SameCycle);
        margin.record_wakeup(Some(MS));
        assert_eq!(margin.get(), 0);
    }

    proptest! {
        #[test]
        fn spin_window_stays_within_bounds(
            cycle in 50_000_u64..100_000_000,
            mode in prop::sample::select(vec![ExchangeMode::SameCycle, ExchangeMode::Pipelined]),
            lates in prop::collection::vec(prop::option::of(0_u64..1_000_000), 0..500),
        ) {
            let mut margin = SpinWindow::new(Spin::Auto, cycle, mode);
            let high = Spin::Auto.longest(cycle, mode);
            let low = SHORTEST.min(high);
            prop_assert!((low..=high).contains(&margin.get()));
            for late in lates {
                let before = margin.get();
                margin.record_wakeup(late);
                prop_assert!((low..=high).contains(&margin.get()));
                prop_assert!(margin.get().abs_diff(before) <= RISE);
            }
        }
    }
}
