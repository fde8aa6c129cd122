//! Distributed clocks: system time and the loop that keeps it, SYNC0 and SYNC1, latches.
//!
//! * `clock`: the crystal
//! * `sync`: SYNC0 and SYNC1
//! * `latch`: time stamps of inputs
//!
//! Data sheets do not say how the control loop works inside. Here it is a PI controller: the proportional part
//! closes a difference, the integral part is the "speed counter difference" that makes up for the crystal. Like the
//! real one it keeps what it has learnt when no more system times arrive; only writing the speed counter start
//! (0x0930) lets the clock run on its bare crystal again.

pub mod clock;
pub mod latch;
pub mod sync;

use crate::Nanos;
pub use clock::{Clock, Jitter};
use latch::Latch;
use sync::SyncUnit;

/// The proportional part closes this share of a difference per second, the integral part is
/// critically damped against it; with the default speed counter start.
const KP: f64 = 50.0;
/// A clock is never bent by more than this, so a wrong offset never converges in useful time;
/// the same holds for real hardware.
const MAX_BEND: f64 = 500e-6;
const MAX_LEARNT: f64 = 300e-6;
/// 0x0930 after reset: the bandwidth that [`KP`] stands for.
pub const DEFAULT_SPEED_START: u16 = 0x1000;
/// 0x0934 and 0x0935 after reset.
pub const DEFAULT_FILTERS: [u8; 2] = [4, 12];

/// Bits of the system time.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Width {
    Bits32,
    #[default]
    Bits64,
}

impl Width {
    /// What the clock shows of a time.
    #[must_use]
    pub fn cut(self, time: u64) -> u64 {
        match self {
            Self::Bits32 => time & 0xffff_ffff,
            Self::Bits64 => time,
        }
    }

    /// How far `target` lies ahead of `now`, going round once at most.
    #[must_use]
    pub fn ahead(self, target: u64, now: u64) -> u64 {
        self.cut(target.wrapping_sub(now))
    }

    #[must_use]
    pub fn half(self) -> u64 {
        match self {
            Self::Bits32 => 1 << 31,
            Self::Bits64 => 1 << 63,
        }
    }
}

/// Registers 0x0910–0x09CF that do something.
#[derive(Debug, Clone)]
pub struct Dc {
    pub width: Width,
    /// System time − local time.
    offset: u64,
    pub delay: u32,
    pub sync: SyncUnit,
    pub latches: [Latch; 2],
    control: Control,
}

#[derive(Debug, Clone)]
struct Control {
    /// 0x0930, in its valid range.
    start: u16,
    filters: [u8; 2],
    /// Mean difference, local copy − received, in ns; `None` before the first.
    mean: Option<f64>,
    learnt: f64,
    /// [`Self::learnt`], averaged for 0x0932.
    shown: f64,
    last_write: Option<u64>,
}

impl Default for Control {
    fn default() -> Self {
        Self {
            start: DEFAULT_SPEED_START,
            filters: DEFAULT_FILTERS,
            mean: None,
            learnt: 0.0,
            shown: 0.0,
            last_write: None,
        }
    }
}

/// A mean that moves by 1/2^depth of the difference.
fn average(mean: f64, value: f64, depth: u8) -> f64 {
    mean + (value - mean) / f64::from(1_u32 << depth.min(15))
}

impl Dc {
    #[must_use]
    pub fn new(width: Width, pulse_length: u16) -> Self {
        Self {
            width,
            offset: 0,
            delay: 0,
            sync: SyncUnit::new(width, pulse_length),
            latches: [Latch::default(); 2],
            control: Control::default(),
        }
    }

    #[must_use]
    pub fn system(&self, local: u64) -> u64 {
        self.width.cut(local.wrapping_add(self.offset))
    }

    /// What a read of 0x0910 shows: the time when the frame passed the reference clock.
    #[must_use]
    pub fn local_copy(&self, local: u64) -> u64 {
        let delay = u64::from(self.delay);
        self.width.cut(self.system(local).wrapping_sub(delay))
    }

    /// 0x0920 was written: pulses that were due stay due at their system time.
    pub fn set_offset(&mut self, offset: u64, local: u64) {
        if self.offset != offset {
            self.offset = offset;
            let system = self.system(local);
            self.sync.aim(local, system);
        }
    }

    /// A write to 0x0910: compare (32 bits, as the hardware does) and bend the clock.
    pub fn compare(&mut self, clock: &mut Clock, now: Nanos, local: u64, received: u32) {
        let difference = (self.local_copy(local) as u32)
            .wrapping_sub(received)
            .cast_signed();
        let difference = f64::from(difference);
        let control = &mut self.control;
        let [mean_depth, speed_depth] = control.filters;
        control.mean = Some(average(control.mean.unwrap_or(0.0), difference, mean_depth));
        let Some(last) = control.last_write.replace(local) else {
            return;
        };
        let dt = local.saturating_sub(last) as f64 * 1e-9;
        if dt <= 0.0 {
            return;
        }
        // Rarer frames must not make the loop oscillate.
        let bandwidth = f64::from(DEFAULT_SPEED_START) / f64::from(control.start);
        let gain = (KP * bandwidth).min(0.5 / dt);
        let error = difference * 1e-9;
        let bend = -(gain * error) + control.learnt;
        if bend.abs() < MAX_BEND {
            control.learnt =
                (control.learnt - gain * gain / 4.0 * error * dt).clamp(-MAX_LEARNT, MAX_LEARNT);
        }
        control.shown = average(control.shown, control.learnt, speed_depth);
        clock.bend(now, bend.clamp(-MAX_BEND, MAX_BEND));
    }

    /// 0x0930 was written: the loop starts anew, from the bare crystal.
    pub fn restart(&mut self, clock: &mut Clock, now: Nanos, start: u16) {
        self.control = Control {
            start: start.clamp(0x0080, 0x3fff),
            filters: self.control.filters,
            ..Control::default()
        };
        clock.bend(now, 0.0);
    }

    /// 0x0934 or 0x0935 was written: what they average starts anew.
    pub fn set_filters(&mut self, filters: [u8; 2]) {
        self.control.filters = filters.map(|depth| depth & 0x0f);
        self.control.mean = None;
        self.control.shown = self.control.learnt;
    }

    /// 0x092C: magnitude; bit 31 is set where the local copy is not less than what was received.
    #[must_use]
    pub fn difference_register(&self) -> u32 {
        let Some(mean) = self.control.mean else {
            return 0;
        };
        let magnitude = mean.abs().min(f64::from(0x7fff_ffff_u32)) as u32;
        if mean >= 0.0 {
            magnitude | 0x8000_0000
        } else {
            magnitude
        }
    }

    /// 0x0932: with d this register and s 0x0930, the local clock's bare period is the reference's times
    /// 1 − d / (5 · (s + d + 2) · (s − d + 2)).
    #[must_use]
    pub fn speed_register(&self) -> i16 {
        let deviation = -self.control.shown;
        let span = f64::from(self.control.start) + 2.0;
        let a = 5.0 * deviation;
        // a·d² + d − a·span² = 0; the second form does not cancel for small a.
        let d = 2.0 * a * span * span / (1.0 + (1.0 + 4.0 * a * a * span * span).sqrt());
        let range = f64::from(self.control.start) - f64::from(0x7f);
        d.round().clamp(-range, range) as i16
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A second of system times each millisecond from a reference that shows true time.
    fn discipline(clock: &mut Clock, dc: &mut Dc, from_ms: u64, to_ms: u64) {
        for ms in from_ms..to_ms {
            let now = ms * 1_000_000;
            let local = clock.local(now);
            dc.compare(clock, now, local, now as u32);
        }
    }

    #[test]
    fn follows_a_reference_through_100_ppm() {
        for start in [0x0400, DEFAULT_SPEED_START, 0x3fff] {
            let (mut clock, mut dc) = (Clock::new(0, 0, 100.0), Dc::new(Width::Bits64, 0));
            dc.restart(&mut clock, 0, start);
            discipline(&mut clock, &mut dc, 1, 3_000);
            let off = clock.local(3_000_000_000).abs_diff(3_000_000_000);
            assert!(off < 5, "{off} ns with 0x{start:04x}");
        }
    }

    #[test]
    fn a_larger_speed_counter_start_means_a_smaller_bandwidth() {
        let left_after_20_ms = |start| {
            let (mut clock, mut dc) = (Clock::new(0, 500, 0.0), Dc::new(Width::Bits64, 0));
            dc.restart(&mut clock, 0, start);
            discipline(&mut clock, &mut dc, 1, 20);
            clock.local(20_000_000).abs_diff(20_000_000)
        };
        let left = [0x0400, 0x1000, 0x3fff].map(left_after_20_ms);
        assert!(left.is_sorted() && left[0] < left[2], "{left:?}");
    }

    #[test]
    fn the_speed_register_says_how_far_the_crystal_is_off() {
        for ppm in [-80.0, -3.0, 0.0, 20.0, 100.0] {
            let (mut clock, mut dc) = (Clock::new(0, 0, ppm), Dc::new(Width::Bits64, 0));
            dc.set_filters([0, 4]);
            discipline(&mut clock, &mut dc, 1, 3_000);
            let d = f64::from(dc.speed_register());
            let s = f64::from(DEFAULT_SPEED_START);
            let deviation = d / (5.0 * (s + d + 2.0) * (s - d + 2.0));
            // A period shorter by that share is a clock faster by it.
            let seen = (1.0 / (1.0 - deviation) - 1.0) * 1e6;
            assert!((seen - ppm).abs() < 0.05, "{seen} for {ppm}");
        }
    }

    #[test]
    fn the_difference_register_has_a_sign_bit_for_clocks_ahead() {
        for (offset, sign) in [(400, 0x8000_0000_u32), (0_u64.wrapping_sub(400), 0)] {
            let (mut clock, mut dc) = (Clock::new(0, 0, 0.0), Dc::new(Width::Bits64, 0));
            assert_eq!(dc.difference_register(), 0, "nothing received yet");
            dc.set_filters([0, 0]);
            dc.set_offset(offset, 0);
            dc.compare(&mut clock, 1_000, 1_000, 1_000);
            assert_eq!(dc.difference_register(), sign | 400);
        }
    }

    #[test]
    fn restarting_forgets_what_was_learnt() {
        let (mut clock, mut dc) = (Clock::new(0, 0, 60.0), Dc::new(Width::Bits64, 0));
        discipline(&mut clock, &mut dc, 1, 3_000);
        let kept = clock.local(4_000_000_000).abs_diff(4_000_000_000);
        assert!(kept < 100, "holds its rate for a second: {kept} ns");
        dc.restart(&mut clock, 4_000_000_000, DEFAULT_SPEED_START);
        let lost = clock.local(5_000_000_000) - 5_000_000_000;
        assert!(lost.abs_diff(60_000) < 200, "{lost} ns");
        assert_eq!((dc.difference_register(), dc.speed_register()), (0, 0));
    }

    #[test]
    fn a_clock_of_32_bits_wraps() {
        let mut dc = Dc::new(Width::Bits32, 0);
        dc.set_offset(0xffff_ffff, 0);
        assert_eq!(dc.system(1), 0);
        assert_eq!(dc.system(11), 10);
    }
}
