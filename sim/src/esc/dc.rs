//! Distributed clocks: a crystal that drifts, the loop that disciplines it, and SYNC0.

use crate::Nanos;

/// Fixed point: 2^-40 ns per ns resolves a rate of 10^-12.
const FRACTION: u32 = 40;
const ONE: f64 = (1_u64 << FRACTION) as f64;

/// The proportional part closes this share of a difference per second, the integral part is
/// critically damped against it.
const KP: f64 = 50.0;
const KI: f64 = KP * KP / 4.0;
/// A clock is never bent by more than this, so a wrong offset never converges in useful time;
/// the same holds for real hardware.
const MAX_BEND: f64 = 500e-6;
const MAX_LEARNT: f64 = 300e-6;

/// A device's own clock as a function of true time; counts nanoseconds since power-on.
#[derive(Debug, Clone)]
pub struct Clock {
    base_true: Nanos,
    base_local: i128,
    crystal: i64,
    correction: i64,
}

impl Clock {
    #[must_use]
    pub fn new(now: Nanos, offset_ns: u64, drift_ppm: f64) -> Self {
        Self {
            base_true: now,
            base_local: i128::from(offset_ns) << FRACTION,
            crystal: (drift_ppm * 1e-6 * ONE) as i64,
            correction: 0,
        }
    }

    fn rate(&self) -> i128 {
        (1_i128 << FRACTION) + i128::from(self.crystal) + i128::from(self.correction)
    }

    fn fixed(&self, now: Nanos) -> i128 {
        self.base_local + i128::from(now.saturating_sub(self.base_true)) * self.rate()
    }

    /// Local time at a true time.
    #[must_use]
    pub fn local(&self, now: Nanos) -> u64 {
        (self.fixed(now) >> FRACTION) as u64
    }

    /// The first true time at which the clock shows `local`.
    #[must_use]
    pub fn true_time(&self, local: u64) -> Nanos {
        let ahead = (i128::from(local) << FRACTION) - self.base_local;
        let ns = ahead.max(0).div_euclid(self.rate().max(1));
        self.base_true
            .saturating_add(u64::try_from(ns).unwrap_or(u64::MAX))
    }

    fn bend(&mut self, now: Nanos, correction: f64) {
        self.base_local = self.fixed(now);
        self.base_true = self.base_true.max(now);
        self.correction = (correction * ONE) as i64;
    }
}

/// SYNC0 generation.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Sync0 {
    #[default]
    Off,
    /// Next pulse in system time; a cycle of 0 is a single shot.
    Armed { next: u64, cycle: u32 },
    /// The start time was already past when the unit was activated: the comparator only matches
    /// again when the 64-bit time has wrapped.
    NeverStarts,
    /// A single shot has been fired.
    Done,
}

/// Registers 0x0910–0x09A7 that do something.
#[derive(Debug, Clone, Default)]
pub struct Dc {
    /// System time − local time.
    pub offset: u64,
    pub delay: u32,
    pub sync0: Sync0,
    /// Pulses since activation.
    pub pulses: u64,
    filter_depth: u8,
    /// Mean difference, local copy − received, in ns.
    mean: f64,
    learnt: f64,
    last_write: Option<u64>,
}

impl Dc {
    #[must_use]
    pub fn system(&self, local: u64) -> u64 {
        local.wrapping_add(self.offset)
    }

    /// What a read of 0x0910 shows: the time when the frame passed the reference clock.
    #[must_use]
    pub fn local_copy(&self, local: u64) -> u64 {
        self.system(local).wrapping_sub(u64::from(self.delay))
    }

    /// A write to 0x0910: compare (32 bits, as the hardware does) and bend the clock.
    pub fn compare(&mut self, clock: &mut Clock, now: Nanos, local: u64, received: u32) {
        let difference = (self.local_copy(local) as u32)
            .wrapping_sub(received)
            .cast_signed();
        let difference = f64::from(difference);
        self.mean += (difference - self.mean) / f64::from(1_u32 << self.filter_depth.min(15));
        let Some(last) = self.last_write.replace(local) else {
            return;
        };
        let dt = local.saturating_sub(last) as f64 * 1e-9;
        if dt <= 0.0 {
            return;
        }
        // Rarer frames must not make the loop oscillate.
        let gain = KP.min(0.5 / dt);
        let error = difference * 1e-9;
        let bend = -(gain * error) + self.learnt;
        if bend.abs() < MAX_BEND {
            self.learnt = (self.learnt - KI.min(gain * gain / 4.0) * error * dt)
                .clamp(-MAX_LEARNT, MAX_LEARNT);
        }
        clock.bend(now, bend.clamp(-MAX_BEND, MAX_BEND));
    }

    /// Writing 0x0930 or 0x0934 restarts the loop from the bare crystal.
    pub fn reset_loop(&mut self, clock: &mut Clock, now: Nanos, filter_depth: u8) {
        self.filter_depth = filter_depth & 0x0f;
        self.mean = 0.0;
        self.learnt = 0.0;
        self.last_write = None;
        clock.bend(now, 0.0);
    }

    /// 0x092C: magnitude, bit 31 set where the local copy is behind.
    #[must_use]
    pub fn difference_register(&self) -> u32 {
        let magnitude = self.mean.abs().min(f64::from(0x7fff_ffff_u32)) as u32;
        if self.mean < 0.0 {
            magnitude | 0x8000_0000
        } else {
            magnitude
        }
    }

    /// 0x0932, against a speed counter start value of 0x1000.
    #[must_use]
    pub fn speed_register(&self) -> i16 {
        (self.learnt * 5.0 * 4098.0 * 4098.0).clamp(-4094.0, 4094.0) as i16
    }

    /// 0x0981 changed.
    pub fn activate(&mut self, activation: u8, start: u64, cycle: u32, local: u64) {
        let on = activation & 0b11 == 0b11;
        match (on, self.sync0) {
            (false, _) => self.sync0 = Sync0::Off,
            (true, Sync0::Off) => {
                self.pulses = 0;
                let ahead = start.wrapping_sub(self.system(local)).cast_signed();
                self.sync0 = if ahead > 0 {
                    Sync0::Armed { next: start, cycle }
                } else {
                    Sync0::NeverStarts
                };
            }
            (true, _) => {}
        }
    }

    /// Local time of the next pulse, `u64::MAX` if there is none.
    #[must_use]
    pub fn next_pulse(&self) -> u64 {
        match self.sync0 {
            Sync0::Armed { next, .. } => next.wrapping_sub(self.offset),
            _ => u64::MAX,
        }
    }

    pub fn fire(&mut self) {
        if let Sync0::Armed { next, cycle } = self.sync0 {
            self.pulses += 1;
            self.sync0 = if cycle == 0 {
                Sync0::Done
            } else {
                Sync0::Armed {
                    next: next.wrapping_add(u64::from(cycle)),
                    cycle,
                }
            };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_clock_drifts_and_inverts() {
        let clock = Clock::new(1_000, 500, 50.0);
        assert_eq!(clock.local(1_000), 500);
        assert_eq!(clock.local(1_000_001_000), 1_000_050_499);
        let back = clock.true_time(1_000_050_500);
        assert!(back.abs_diff(1_000_001_000) <= 1, "{back}");
    }

    #[test]
    fn a_start_time_in_the_past_never_starts() {
        let mut dc = Dc::default();
        dc.activate(3, 1_000, 500, 2_000);
        assert_eq!(dc.sync0, Sync0::NeverStarts);
        assert_eq!(dc.next_pulse(), u64::MAX);
        dc.activate(0, 0, 0, 2_000);
        dc.activate(3, 3_000, 500, 2_000);
        dc.fire();
        assert_eq!(dc.next_pulse(), 3_500);
    }

    #[test]
    fn follows_a_reference_through_100_ppm() {
        let (mut clock, mut dc) = (Clock::new(0, 0, 100.0), Dc::default());
        for ms in 1..3_000_u64 {
            let now = ms * 1_000_000;
            let local = clock.local(now);
            dc.compare(&mut clock, now, local, now as u32);
        }
        assert!(clock.local(3_000_000_000).abs_diff(3_000_000_000) < 5);
    }
}
