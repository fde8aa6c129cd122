//! Keeps the release of frames in phase with SYNC0.
//!
//! The phase error is the time within the SYNC0 cycle at which the frame passed the reference
//! clock, minus the planned time. A PI controller turns the error into the length of the next
//! cycle. Its integral is the drift between the host clock and the reference clock. The measured
//! wake-up lateness is subtracted first, so that a late thread does not shift the phase, even if it
//! is late by several cycles.
//!
//! Only the low 32 bits of the system time count, because some clocks have no more. They wrap every
//! 4.3 s, in the middle of a cycle. The host clock bridges the time since the last measurement, or
//! since the plan; it would need hours to be wrong by half a wrap.
//!
//! Before the first lock no device is in Op, and one cycle of odd length does no harm. The phase is
//! therefore set at once, not approached.

use crate::clock::Nanos;

/// The shares of the error that go into the next cycle and into the drift.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gains {
    pub proportional: f64,
    pub integral: f64,
}

impl Gains {
    /// A tenth of the error per cycle, critically damped: Ki = Kp² ∕ 4.
    pub const DEFAULT: Self = Self {
        proportional: 0.1,
        integral: 0.0025,
    };
    /// The whole error goes into the next cycle, as in a loop that sleeps for what it measures. For
    /// comparison only.
    pub const RAW: Self = Self {
        proportional: 1.0,
        integral: 0.0,
    };
}

/// The score at which the phase counts as locked. A measurement inside the window adds one, one
/// outside subtracts one. A single late answer on a busy host therefore does not restart the count.
const LOCKED_SCORE: u32 = 20;
/// The highest score. From here, 21 more measurements outside than inside unlock the phase.
const BEST_SCORE: u32 = 40;
/// Measurements after the phase was set that may belong to frames released before.
const UNDER_WAY: u8 = 2;

/// The parameters with which the cyclic exchange distributes time and keeps its phase.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClockPlan {
    /// Station address of the reference clock.
    pub reference: u16,
    pub cycle_ns: u64,
    /// The low 32 bits of a system time at which a frame should pass the reference clock, repeating
    /// every cycle.
    pub release: u32,
    /// The session clock's time at that system time, to a second.
    pub release_at: Nanos,
    /// The largest difference to the reference clock with which a clock may replace it.
    pub window_ns: u64,
    /// The system time of a pulse of SYNC0, before the shifts of devices; the pulses repeat every
    /// cycle.
    pub sync0: u64,
    /// True if SYNC0 is kept on whole multiples of the cycle in common time.
    pub align: bool,
}

impl ClockPlan {
    /// Returns the time from a pulse of SYNC0 until the frames pass the reference clock, in ns.
    #[must_use]
    pub fn release_after(&self) -> u64 {
        let after = u64::from(self.release.wrapping_sub(self.sync0 as u32));
        after % self.cycle_ns.max(1)
    }
}

/// Returns the time next to `near` with the low 32 bits of `time`. All clocks have these bits in
/// common. Some clocks have no others, so the higher ones of two clocks may differ.
#[must_use]
pub fn extend(time: u64, near: u64) -> u64 {
    let ahead = (time as u32).wrapping_sub(near as u32).cast_signed();
    near.wrapping_add_signed(i64::from(ahead))
}

/// The phase controller of one segment.
#[derive(Debug, Clone)]
pub struct Phase {
    gains: Gains,
    cycle: i64,
    /// The last planned passing time: the system time, and the session clock's time.
    planned: (u32, Nanos),
    /// The drift in ns per cycle.
    drift: f64,
    locked: bool,
    /// True once the phase was locked for the first time.
    acquired: bool,
    score: u32,
    /// The number of measurements still to ignore.
    under_way: u8,
}

/// The result of one measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PhaseStep {
    /// The actual passing time minus the planned one, including the wake-up lateness.
    pub error: i64,
    /// The correction to add to the length of the next cycle.
    pub adjust: i64,
}

impl Phase {
    #[must_use]
    pub fn new(plan: &ClockPlan) -> Self {
        Self::with_gains(plan, Gains::DEFAULT)
    }

    #[must_use]
    pub fn with_gains(plan: &ClockPlan, gains: Gains) -> Self {
        let cycle = i64::try_from(plan.cycle_ns).unwrap_or(i64::MAX).max(1);
        Self {
            gains,
            cycle,
            planned: (plan.release, plan.release_at),
            drift: 0.0,
            locked: false,
            acquired: false,
            score: 0,
            under_way: 0,
        }
    }

    #[must_use]
    pub fn locked(&self) -> bool {
        self.locked
    }

    /// Returns the drift of the reference clock against the host clock, in parts per million.
    #[must_use]
    pub fn drift_ppm(&self) -> f64 {
        self.drift / self.cycle as f64 * 1e6
    }

    /// Processes one measurement. RT.
    ///
    /// `system_time` is the reference clock's time as the frame passed, of which the low 32 bits
    /// count. The frame was sent at `sent_at`, `lateness` after its planned release.
    pub fn update(&mut self, system_time: u64, sent_at: Nanos, lateness: Nanos) -> PhaseStep {
        let passed = self.advance(system_time as u32, sent_at);
        let error = self.wrap(passed);
        let lateness = i64::try_from(lateness).unwrap_or(0);
        let planned = self.wrap(error.saturating_sub(lateness));
        if self.under_way > 0 {
            self.under_way -= 1;
            let adjust = self.holdover();
            return PhaseStep { error, adjust };
        }
        self.judge(planned);
        let near = planned.abs() <= self.cycle / 50;
        if !self.acquired && !near {
            self.under_way = UNDER_WAY;
            let adjust = self.holdover() - planned;
            return PhaseStep { error, adjust };
        }
        // A single outlier may shift a locked phase by a 1000th of a cycle, an unlocked one by a
        // 50th. The drives would see faster changes as jitter.
        let bound = self.cycle as f64 / if self.locked { 100.0 } else { 5.0 };
        let bounded = (planned as f64).clamp(-bound, bound);
        // An error far from the target contains no information about drift.
        if near {
            self.drift += self.gains.integral * bounded;
            let most = self.cycle as f64 * 1e-3;
            self.drift = self.drift.clamp(-most, most);
        }
        let adjust = -(self.gains.proportional * bounded + self.drift);
        PhaseStep {
            error,
            adjust: adjust.round() as i64,
        }
    }

    /// Returns the correction without a measurement: the estimated drift. RT.
    #[must_use]
    pub fn holdover(&self) -> i64 {
        -self.drift.round() as i64
    }

    fn judge(&mut self, error: i64) {
        let window = if self.locked {
            self.cycle / 8
        } else {
            self.cycle / 25
        };
        self.score = if error.abs() <= window {
            (self.score + 1).min(BEST_SCORE)
        } else {
            self.score.saturating_sub(1)
        };
        self.locked = self.score >= LOCKED_SCORE;
        self.acquired |= self.locked;
    }

    /// Advances the planned passing time to the last one before this system time. Returns the time
    /// since then.
    fn advance(&mut self, system_time: u32, at: Nanos) -> i64 {
        let (planned, planned_at) = self.planned;
        let by_host = at.wrapping_sub(planned_at).cast_signed();
        let expected = planned.wrapping_add(by_host as u32);
        let difference = system_time.wrapping_sub(expected).cast_signed();
        let passed = (by_host + i64::from(difference)).rem_euclid(self.cycle);
        self.planned = (
            system_time.wrapping_sub(passed as u32),
            at.wrapping_add_signed(-passed),
        );
        passed
    }

    /// Wraps a value into ± half a cycle.
    fn wrap(&self, value: i64) -> i64 {
        (value + self.cycle / 2).rem_euclid(self.cycle) - self.cycle / 2
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plan(cycle_ns: u64, release: u32) -> ClockPlan {
        ClockPlan {
            reference: 0x1000,
            cycle_ns,
            release,
            release_at: u64::from(release),
            window_ns: 10_000,
            sync0: 0,
            align: false,
        }
    }

    #[test]
    fn extend_finds_the_nearest_time_across_a_wrap() {
        const WRAP: u64 = 1 << 32;
        for (time, near, expected) in [
            (5, WRAP - 5, WRAP + 5),
            (WRAP - 5, 5 * WRAP + 5, 5 * WRAP - 5),
            (7 * WRAP + 9, 3, 9),
            (1 << 30, 9 * WRAP, 9 * WRAP + (1 << 30)),
        ] {
            assert_eq!(extend(time, near), expected, "{time} {near}");
        }
    }

    #[test]
    fn a_clock_of_32_bits_keeps_its_phase_when_it_wraps() {
        let mut phase = Phase::new(&plan(1_000_000, 0));
        for k in 0..10_000_u64 {
            let time = k * 1_000_000;
            let step = phase.update(time & 0xffff_ffff, time, 0);
            assert_eq!(step.error, 0, "cycle {k}");
        }
    }

    /// 2^32 ns is not a multiple of these cycles. The first measurement, or the next one after a broken
    /// cable, may come several wraps later; the host clock has a drift of 100 ppm.
    #[test]
    fn a_clock_of_32_bits_keeps_its_phase_over_a_long_pause() {
        for cycle in [250_000, 1_000_000, 2_000_000, 4_000_000] {
            let start = u64::from(u32::MAX) - 3 * cycle;
            let mut phase = Phase::new(&plan(cycle, start as u32));
            let mut time = start;
            for pause in [0, 1, 4_000, 100_000, 3_000_000] {
                time += pause * cycle;
                let host = start + (time - start) / 10_000 * 10_001;
                let step = phase.update(time, host + 123_000, 123_000);
                assert_eq!(step.error, 0, "{cycle} ns, after {pause} cycles");
            }
        }
    }

    /// ESC data sheet, section I, 9.2.3: SYNC0 goes on without frames, so its pulses stay where
    /// they were, however many cycles the host slept.
    #[test]
    fn a_wake_up_several_cycles_late_does_not_move_the_phase() {
        let mut phase = Phase::new(&plan(1_000_000, 0));
        for k in 1..200 {
            phase.update(k * 1_000_000, k * 1_000_000, 0);
        }
        for late in [400_000, 1_300_000, 2_700_000, 7_500_000] {
            let step = phase.update(300_000_000 + late, 300_000_000 + late, late);
            assert_eq!(step.adjust, 0, "{late} ns late");
            assert!(phase.locked());
        }
    }

    /// Returns the cycles until lock, and the largest error in the 1000 cycles after it.
    fn run(cycle: u64, offset: u64, ppm: f64, late: impl Fn(u64) -> u64) -> (u64, i64) {
        let mut phase = Phase::new(&plan(cycle, 7_000_000));
        let mut release = 50_000_000_u64;
        let mut locked_at = None;
        let mut largest = 0;
        for k in 0..20_000 {
            let lateness = late(k);
            let local = (release + lateness) as f64;
            let system_time = (local * (1.0 + ppm * 1e-6)) as u64 + offset;
            let step = phase.update(system_time, release + lateness, lateness);
            release = release.wrapping_add_signed(cycle as i64 + step.adjust);
            match locked_at {
                None if phase.locked() => locked_at = Some(k),
                Some(at) if k > at + 2000 => {
                    largest = largest.max((step.error - lateness as i64).abs());
                }
                _ => {}
            }
        }
        (locked_at.expect("locks"), largest)
    }

    #[test]
    fn locks_from_any_phase_against_drift() {
        for cycle in [250_000, 1_000_000, 4_000_000] {
            for offset in [0, 1, cycle / 3, cycle / 2, cycle - 1] {
                for ppm in [-100.0, 0.0, 80.0] {
                    let (at, largest) = run(cycle, offset, ppm, |_| 0);
                    assert!(
                        at < 1_000,
                        "{cycle} {offset} {ppm}: locked after {at} cycles"
                    );
                    assert!(largest < 100, "{cycle} {offset} {ppm}: {largest} ns");
                }
            }
        }
    }

    /// Answers may belong to frames that were released before the phase was set.
    #[test]
    fn before_the_first_lock_the_phase_is_set_at_once() {
        for lag in [0_usize, 1] {
            let mut phase = Phase::new(&plan(20_000_000, 0));
            let mut releases = vec![7_300_000_u64];
            for k in 0_usize..60 {
                let last = releases[k];
                let step = k
                    .checked_sub(lag)
                    .map(|k| phase.update(releases[k], releases[k], 0).adjust);
                releases.push(last.wrapping_add_signed(20_000_000 + step.unwrap_or(0)));
            }
            assert!(phase.locked(), "lag {lag}");
            let error = (releases[5] % 20_000_000) as i64;
            assert_eq!(error, 0, "lag {lag}");
        }
    }

    #[test]
    fn a_late_thread_does_not_move_the_phase() {
        let (_, largest) = run(1_000_000, 0, 30.0, |k| {
            if k % 97 == 0 { 300_000 } else { 2_000 }
        });
        assert!(largest < 500, "{largest} ns");
    }

    #[test]
    fn unlocks_only_after_a_run_of_bad_measurements() {
        let mut phase = Phase::new(&plan(1_000_000, 500_000));
        for _ in 0..200 {
            phase.update(500_000, 500_000, 0);
        }
        assert!(phase.locked());
        for _ in 0..BEST_SCORE - LOCKED_SCORE {
            phase.update(0, 0, 0);
        }
        assert!(phase.locked());
        phase.update(0, 0, 0);
        assert!(!phase.locked());
    }
}
