//! The time that computers have in common, and the bus.
//!
//! Common time is `CLOCK_REALTIME` of the host, which linuxptp or NTP synchronizes. Each cycle
//! gives a pair: common time as the frame was sent, and the system time at which it passed the
//! reference clock. A line through these pairs gives offset and drift. The line is fitted with
//! expanding memory, later with fading memory (Brookner, Tracking and Kalman Filtering Made Easy,
//! 1.2.10), so it needs no initial values and a constant time per pair.
//!
//! A clock of the host that jumps discards the line. Nothing here moves SYNC0 because of it.
//!
//! With alignment, the offset of the reference clock (0x0920) receives a small addition every
//! cycle, the same in each, so that the pulses stay equally spaced. The addition compensates the
//! drift, and approaches the phase at no more than `Limits::slew`. The other clocks follow the
//! reference clock as always.

use ecaxis_ecat::index::DeviceIndex;

use super::phase::{ClockPlan, extend};
use crate::clock::{self, Nanos};

/// The time between two readings of common time.
const READING_PERIOD: Nanos = 10_000_000;
/// A larger change of common time between two readings is a jump.
const JUMP: i64 = 10_000;
/// The memory of the line, and the time from its begin until it counts.
const MEMORY: Nanos = 4_000_000_000;
const LOCK_TIME: Nanos = 1_000_000_000;
/// The part of the cycle that one pair may deviate from the line; the rest is not used.
const OUTLIER_DIVISOR: f64 = 20.0;
/// Cycles in a row without a time after which the reference clock may have been set again.
const MISSING_CYCLES: u32 = 10;
/// The distance of SYNC0 from the multiples of the cycle within which it counts as aligned.
const ALIGNED: f64 = 1_000.0;
/// The uncertainty of the line's rate with which the reference clock is corrected, and the number
/// of pairs from which it is known.
const KNOWN_RATE: f64 = 1e-6;
const FEW_PAIRS: f64 = 64.0;
/// The largest correction of the rate. Crystals of devices are within 100 ppm.
const MAX_RATE: f64 = 300e-6;

/// How fast SYNC0 moves in common time.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Limits {
    /// The largest deviation of the rate while SYNC0 approaches its place.
    slew: f64,
    /// The time constant of the approach in s.
    approach_s: f64,
    /// The largest change of the correction of the drift per s.
    ramp: f64,
}

impl Limits {
    /// No drive uses SYNC0 yet.
    const BEFORE_OP: Self = Self {
        slew: 100e-6,
        approach_s: 0.3,
        ramp: f64::INFINITY,
    };
    const IN_OP: Self = Self {
        slew: 1e-6,
        approach_s: 8.0,
        ramp: 100e-6,
    };
}

/// A straight line through pairs that arrive one after another.
#[derive(Debug, Clone, Copy, Default)]
struct Line {
    /// The number of pairs, at most that of the memory.
    count: f64,
    /// The integer part of the values.
    base: i64,
    /// The value at `at`, without `base`.
    value: f64,
    /// The change of the value per ns.
    rate: f64,
    at: Nanos,
    /// The mean deviation of a pair.
    jitter: f64,
}

impl Line {
    fn add(&mut self, value: i64, at: Nanos, memory: f64, outlier: f64) {
        let dt = at.saturating_sub(self.at) as f64;
        self.at = at;
        if self.count == 0.0 {
            (self.count, self.base, self.value) = (1.0, value, 0.0);
            return;
        }
        let predicted = self.value + self.rate * dt;
        let error = value.wrapping_sub(self.base) as f64 - predicted;
        let error = error.clamp(-outlier, outlier);
        let k = (self.count + 1.0).min(memory.max(2.0));
        self.count = k;
        self.value = predicted + 2.0 * (2.0 * k - 1.0) / (k * (k + 1.0)) * error;
        if dt > 0.0 {
            self.rate += 6.0 / (k * (k + 1.0)) * error / dt;
        }
        self.jitter += (error.abs() - self.jitter) / k.min(FEW_PAIRS);
    }

    /// True if the rate is known well enough: its standard deviation for pairs a cycle apart.
    fn rate_is_known(&self, cycle: f64) -> bool {
        let deviation = 12.0_f64.sqrt() * self.jitter / (self.count.powf(1.5) * cycle);
        self.count >= FEW_PAIRS && deviation <= KNOWN_RATE
    }
}

/// What other threads see.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct CommonTimeStatus {
    /// Offset and drift are known.
    pub locked: bool,
    /// Common time minus system time of the bus, in ns.
    pub offset_ns: i64,
    /// The rate of common time against the time of the bus.
    pub drift_ppm: f64,
    /// The mean deviation of a measurement from the line.
    pub jitter_ns: f64,
    /// Common time minus session clock, in ns.
    pub host_offset_ns: i64,
    /// Jumps of common time so far.
    pub jumps: u64,
    /// `None` without alignment.
    pub alignment: Option<Alignment>,
}

/// The place of SYNC0.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Alignment {
    /// The time from a multiple of the cycle in common time to SYNC0.
    pub sync0_ns: f64,
    /// The correction of the reference clock.
    pub correction_ppm: f64,
    /// SYNC0 is at its place, and the reference clock is corrected.
    pub aligned: bool,
}

/// The measurement of one bus, and its alignment.
#[derive(Debug)]
pub struct CommonTime {
    cycle: f64,
    /// A pulse of SYNC0, and whether the pulses are aligned; `None` without distributed clocks.
    plan: Option<ClockPlan>,
    /// Common time minus session clock; `None` before the first reading.
    host: Option<i64>,
    /// The time of the next reading.
    next_reading: Nanos,
    jumps: u64,
    line: Line,
    /// The last system time, and the session clock's time.
    last: (u64, Nanos),
    missing: u32,
    limits: Limits,
    correction: Correction,
}

/// The correction of the reference clock.
#[derive(Debug, Default)]
struct Correction {
    /// The clock and its offset (0x0920) before the first correction; `None`: not known.
    of: Option<(DeviceIndex, u64)>,
    /// The sum of the corrections in ns.
    sum: f64,
    /// The rate of the corrections, and the clock that needs it.
    rate: f64,
    rate_of: Option<DeviceIndex>,
    /// The rate that compensates the drift alone, once it is known.
    drift: Option<f64>,
}

/// The cycle's view of its clocks.
#[derive(Debug, Clone, Copy)]
pub struct Observed {
    pub reference: Option<DeviceIndex>,
    /// The time of the reference clock; `None` if it did not answer.
    pub system_time: Option<u64>,
    /// The reference clock has taken its offset.
    pub offset_taken: bool,
    /// The session clock's time at which the frame was sent.
    pub sent_at: Nanos,
}

/// A jump of common time, while it was locked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Jump {
    pub by_ns: i64,
}

impl CommonTime {
    #[must_use]
    pub fn new(cycle_ns: u64, plan: Option<&ClockPlan>) -> Self {
        Self {
            cycle: cycle_ns.max(1) as f64,
            plan: plan.copied(),
            host: None,
            next_reading: 0,
            jumps: 0,
            line: Line::default(),
            last: plan.map_or((0, 0), |plan| {
                let before = plan.release_after();
                let at = plan.release_at.saturating_sub(before);
                (plan.sync0, at)
            }),
            missing: 0,
            limits: Limits::BEFORE_OP,
            correction: Correction::default(),
        }
    }

    /// From now on, drives use SYNC0.
    pub fn enter_op(&mut self) {
        self.limits = Limits::IN_OP;
    }

    /// Processes one cycle. Returns a jump of a locked common time. RT: O(1), reads clocks.
    pub fn update(&mut self, observed: &Observed) -> Option<Jump> {
        if observed.offset_taken {
            self.correction.sum += self.correction.rate * self.cycle;
        }
        let at = observed.sent_at;
        let jump = self.read_host(at);
        let Some(host) = self.host else {
            return jump;
        };
        let system_time = match self.plan {
            // Without distributed clocks, the time of the bus is that of its cycle.
            None => Some(at),
            Some(_) => observed.system_time,
        };
        let Some(system_time) = system_time else {
            self.missing = self.missing.saturating_add(1);
            if self.missing >= MISSING_CYCLES {
                self.correction.of = None;
            }
            return jump;
        };
        self.missing = 0;
        // The upper half of a clock of 32 bits is that of the plan.
        let expected = self.last.0.wrapping_add(at.wrapping_sub(self.last.1));
        let system_time = extend(system_time, expected);
        self.last = (system_time, at);
        let common = at.wrapping_add_signed(host);
        let offset = common.wrapping_sub(system_time).cast_signed();
        let memory = MEMORY as f64 / self.cycle;
        let outlier = self.cycle / OUTLIER_DIVISOR;
        self.line.add(offset, at, memory, outlier);
        self.correct(observed);
        jump
    }

    /// Reads common time once in a while.
    fn read_host(&mut self, at: Nanos) -> Option<Jump> {
        if at < self.next_reading {
            return None;
        }
        let read = clock::common_offset()?;
        self.next_reading = at.saturating_add(READING_PERIOD);
        let Some(known) = self.host else {
            self.host = Some(read);
            return None;
        };
        let by_ns = read.saturating_sub(known);
        if by_ns.abs() <= JUMP {
            self.host = Some(known + by_ns / 8);
            return None;
        }
        let was_locked = self.locked();
        self.host = Some(read);
        self.line = Line::default();
        self.jumps += 1;
        was_locked.then_some(Jump { by_ns })
    }

    /// Returns true if common time is known well enough for a start.
    #[must_use]
    pub fn locked(&self) -> bool {
        self.line.count >= LOCK_TIME as f64 / self.cycle && self.is_steady()
    }

    fn is_steady(&self) -> bool {
        self.line.jitter <= self.cycle / OUTLIER_DIVISOR / 2.0
    }

    /// Returns the time from a multiple of the cycle in common time to SYNC0, in ns.
    fn sync0(&self, plan: &ClockPlan) -> f64 {
        let cycle = i64::try_from(plan.cycle_ns).unwrap_or(i64::MAX).max(1);
        let pulse = plan.sync0.wrapping_add_signed(self.line.base);
        let whole = pulse % plan.cycle_ns.max(1);
        let within = whole as f64 + self.line.value;
        let cycle = cycle as f64;
        (within + cycle / 2.0).rem_euclid(cycle) - cycle / 2.0
    }

    fn correct(&mut self, observed: &Observed) {
        let Some(plan) = self.plan.filter(|plan| plan.align) else {
            return;
        };
        let correction = &mut self.correction;
        if correction.of.map(|(of, _)| of) != observed.reference {
            correction.of = None;
            return;
        }
        let limits = self.limits;
        let usable = match (limits == Limits::IN_OP, self.correction.drift) {
            (false, _) => true,
            (true, None) => self.is_steady(),
            // After a jump, the drift is known well enough to wait for a better one.
            (true, Some(_)) => self.locked(),
        };
        let known = usable && self.line.rate_is_known(self.cycle);
        let mut wanted = 0.0;
        if known {
            wanted = self.sync0(&plan) * 1e-9 / limits.approach_s;
            wanted = wanted.clamp(-limits.slew, limits.slew);
            // The line's rate is that of common time against the corrected clock.
            let measured = self.correction.rate + self.line.rate;
            let change = limits.ramp * self.cycle * 1e-9;
            self.correction.drift = Some(match self.correction.drift {
                Some(drift) => drift + (measured - drift).clamp(-change, change),
                None => measured,
            });
        }
        let correction = &mut self.correction;
        let Some(drift) = correction.drift else {
            return;
        };
        let rate = (drift + wanted).clamp(-MAX_RATE, MAX_RATE);
        self.line.rate -= rate - correction.rate;
        correction.rate = rate;
    }

    /// Takes the offset (0x0920) of a clock. One that has followed another clock has about its
    /// rate, so the line begins again.
    pub fn take_offset(&mut self, of: DeviceIndex, offset: u64) {
        let correction = &mut self.correction;
        // A second reading is older than the corrections since the first one.
        if correction.of.is_some_and(|(known, _)| known == of) {
            return;
        }
        if correction.rate_of != Some(of) {
            (correction.rate, correction.drift) = (0.0, None);
            correction.rate_of = Some(of);
            self.line = Line::default();
        }
        (correction.of, correction.sum) = (Some((of, offset)), 0.0);
    }

    /// Returns the clock whose offset is needed: the reference clock, while it answers.
    #[must_use]
    pub fn wanted_offset(&self, reference: Option<DeviceIndex>) -> Option<DeviceIndex> {
        let aligns = self.plan.is_some_and(|plan| plan.align);
        let needed = aligns && self.correction.of.is_none() && self.missing == 0;
        reference.filter(|_| needed)
    }

    /// Returns the value for 0x0920 of the reference clock.
    #[must_use]
    pub fn offset(&self, reference: Option<DeviceIndex>) -> Option<u64> {
        let (of, offset) = self.correction.of?;
        let sum = self.correction.sum.round() as i64;
        (Some(of) == reference).then(|| offset.wrapping_add_signed(sum))
    }

    /// Returns the common time of the pulse of SYNC0 before a planned release. Without distributed
    /// clocks it is that of the release.
    #[must_use]
    pub fn pulse_before(&self, release: Nanos) -> Option<u64> {
        let after = self.plan.map_or(0, |plan| plan.release_after());
        let common = release.wrapping_add_signed(self.host?);
        Some(common.saturating_sub(after))
    }

    /// Returns the common time at which set-points take effect that a cycle with this planned
    /// release stages: they leave with the next frame, and the pulse of SYNC0 after it takes them.
    /// Without distributed clocks it is that next release. `None`: common time is not locked.
    #[must_use]
    pub fn effect_of(&self, release: Nanos) -> Option<u64> {
        if !self.locked() {
            return None;
        }
        let next = self.pulse_before(release.saturating_add(self.cycle as Nanos))?;
        let Some(plan) = self.plan else {
            return Some(next);
        };
        let pulse = next.saturating_add(plan.cycle_ns);
        // The release has the jitter of the phase controller. The line knows the pulses better.
        let passed = release.saturating_sub(self.last.1) as f64 + 2.0 * self.cycle;
        let phase = (pulse % plan.cycle_ns.max(1)) as f64;
        let off = phase - self.sync0(&plan) - self.line.rate * passed;
        let half = self.cycle / 2.0;
        let off = (off + half).rem_euclid(self.cycle) - half;
        Some(pulse.saturating_add_signed(-off.round() as i64))
    }

    #[must_use]
    pub fn status(&self) -> CommonTimeStatus {
        let alignment = self.plan.filter(|plan| plan.align).map(|plan| {
            let sync0_ns = self.sync0(&plan);
            let corrected = self.correction.of.is_some();
            Alignment {
                sync0_ns,
                correction_ppm: self.correction.rate * 1e6,
                aligned: self.locked() && corrected && sync0_ns.abs() <= ALIGNED,
            }
        });
        CommonTimeStatus {
            locked: self.locked(),
            offset_ns: self.line.base.wrapping_add(self.line.value.round() as i64),
            drift_ppm: self.line.rate * 1e6,
            jitter_ns: self.line.jitter,
            host_offset_ns: self.host.unwrap_or(0),
            jumps: self.jumps,
            alignment,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::{Clock, set_common_offset};

    const CYCLE: u64 = 1_000_000;
    const REFERENCE: Option<DeviceIndex> = Some(DeviceIndex(0));

    fn plan(align: bool) -> ClockPlan {
        ClockPlan {
            reference: 0x1000,
            cycle_ns: CYCLE,
            release: 4_500_000,
            release_at: 1_004_500_000,
            window_ns: 10_000,
            sync0: 4_000_000,
            align,
        }
    }

    /// A clock that is `ppm` fast, and frames that pass it up to `jitter` after they were sent.
    /// Returns the status every second. `common` changes the clock of the host.
    fn follow(
        align: bool,
        (ppm, jitter, bits): (f64, u64, u64),
        seconds: u64,
        common: impl Fn(u64) -> Option<i64> + Send + 'static,
    ) -> Vec<CommonTimeStatus> {
        let run = move || {
            Clock::Virtual.enter();
            set_common_offset(1_700_000_000_000_000_000);
            let mut time = CommonTime::new(CYCLE, Some(&plan(align)));
            time.take_offset(DeviceIndex(0), 0);
            let mut seen = Vec::new();
            for cycle in 0..seconds * 1_000 {
                let at = 1_005_000_000 + cycle * CYCLE;
                Clock::Virtual.sleep_until(at, 0);
                if let Some(offset) = common(cycle) {
                    set_common_offset(offset);
                }
                let passed = at - 1_000_000_000 + cycle.wrapping_mul(7_919) % jitter.max(1);
                let offset = time.offset(REFERENCE).unwrap_or(0);
                let local = passed as f64 * (1.0 + ppm * 1e-6);
                let system_time = (local as u64).wrapping_add(offset) & bits;
                if cycle == 6_000 {
                    time.enter_op();
                }
                time.update(&Observed {
                    reference: REFERENCE,
                    system_time: Some(system_time),
                    offset_taken: align,
                    sent_at: at,
                });
                if cycle % 1_000 == 999 {
                    seen.push(time.status());
                }
            }
            seen
        };
        std::thread::spawn(run).join().expect("no panic")
    }

    /// Clocks of 32 bits wrap every 4.3 s.
    #[test]
    fn drift_and_offset_are_those_of_the_clock() {
        for bits in [u64::MAX, u64::from(u32::MAX)] {
            let seen = follow(false, (-37.0, 20_000, bits), 12, |_| None);
            for status in &seen[4..] {
                assert!(status.locked, "{status:?}");
                assert!((status.drift_ppm - 37.0).abs() < 0.5, "{status:?}");
                assert_eq!(status.alignment, None);
            }
            let rate = (seen[11].offset_ns - seen[5].offset_ns) as f64 / 6_000.0;
            assert!((rate - 37.0).abs() < 1.0, "{rate} ppm");
        }
    }

    #[test]
    fn sync0_comes_to_the_multiples_of_the_cycle_and_stays() {
        for ppm in [-80.0, 0.0, 55.0] {
            let seen = follow(true, (ppm, 2_000, u64::MAX), 40, |_| None);
            for (second, status) in seen.iter().enumerate().skip(8) {
                let place = status.alignment.expect("aligns");
                assert!(place.aligned, "{ppm} ppm, {second} s: {status:?}");
                assert!((place.correction_ppm + ppm).abs() < 0.5, "{place:?}");
            }
        }
    }

    /// The clock of the host is set: the line begins again, and the correction keeps its rate.
    #[test]
    fn a_jump_unlocks_for_a_second_and_keeps_the_rate() {
        let set = |cycle| (cycle == 12_500).then_some(1_700_000_001_000_030_000);
        let seen = follow(true, (40.0, 500, u64::MAX), 30, set);
        assert!(seen[11].locked && seen[11].jumps == 0);
        assert!(!seen[12].locked && seen[12].jumps == 1, "{:?}", seen[12]);
        assert!(seen[14].locked, "{:?}", seen[14]);
        for status in &seen[12..] {
            let rate = status.alignment.expect("aligns").correction_ppm;
            assert!((rate + 40.0).abs() < 1.2, "at most 1 ppm: {status:?}");
        }
        let place = |second: usize| seen[second].alignment.expect("aligns").sync0_ns;
        assert!((25_000.0..31_000.0).contains(&place(14)), "{}", place(14));
        assert!(place(29) < place(14) - 12_000.0, "{}", place(29));
    }

    /// A small step of the clock of the host looks like drift for a while.
    #[test]
    fn a_step_below_a_jump_moves_sync0_slowly() {
        let set = |cycle| (cycle == 12_500).then_some(1_700_000_000_000_009_000);
        let seen = follow(true, (40.0, 500, u64::MAX), 40, set);
        let rates = seen[12..]
            .iter()
            .map(|s| s.alignment.expect("aligns").correction_ppm + 40.0);
        let most = rates.fold(0.0, |most: f64, rate| most.max(rate.abs()));
        assert!(most < 3.5, "{most} ppm");
        assert!(seen.iter().all(|status| status.jumps == 0));
        assert!(seen[39].alignment.expect("aligns").aligned);
    }
}
