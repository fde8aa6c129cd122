//! Distributed clocks: system time and its control loop, SYNC0 and SYNC1, latches.
//!
//! * `clock`: the crystal
//! * `sync`: SYNC0 and SYNC1
//! * `latch`: time stamps of inputs
//!
//! Data sheets do not describe the control loop. Here it is a PI controller. The proportional part
//! removes a difference. The integral part is the "speed counter difference", which compensates the
//! crystal. Like real hardware, the loop keeps its rate when no more system times arrive. Only a
//! write to the speed counter start (0x0930) restores the bare crystal rate.

pub mod clock;
pub mod latch;
pub mod sync;

use crate::Nanos;
pub use clock::Clock;
use latch::Latch;
use sync::SyncUnit;

/// The share of a difference that the proportional part removes per second, for the default speed
/// counter start. The integral part is critically damped against it.
const KP: f64 = 50.0;
/// The limit of the rate correction. As in real hardware, a wrong offset therefore does not
/// converge in useful time.
const MAX_BEND: f64 = 500e-6;
const MAX_LEARNT: f64 = 300e-6;
/// 0x0930 after reset: the bandwidth of `KP`.
pub const DEFAULT_SPEED_START: u16 = 0x1000;
/// 0x0934 and 0x0935 after reset.
pub const DEFAULT_FILTERS: [u8; 2] = [4, 12];

/// The number of bits of the system time.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Width {
    Bits32,
    #[default]
    Bits64,
}

impl Width {
    /// Reduces a time to the bits of the clock.
    #[must_use]
    pub fn cut(self, time: u64) -> u64 {
        match self {
            Self::Bits32 => time & 0xffff_ffff,
            Self::Bits64 => time,
        }
    }

    /// Returns the time from `now` until `target`, with at most one wrap of the clock.
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

/// The functional registers in 0x0910–0x09CF.
#[derive(Debug, Clone)]
pub struct Dc {
    pub width: Width,
    /// System time − local time.
    offset: u64,
    pub delay: u32,
    /// True if the clock takes no system time.
    pub ignores_time: bool,
    pub sync: SyncUnit,
    pub latches: [Latch; 2],
    control: Control,
}

#[derive(Debug, Clone)]
struct Control {
    /// 0x0930, limited to its valid range.
    start: u16,
    filters: [u8; 2],
    /// Mean difference, local copy − received time, in ns; `None` before the first value.
    mean: Option<f64>,
    learnt: f64,
    /// The average of [`Self::learnt`] for 0x0932.
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

/// Moves a mean by 1/2^depth of the difference.
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
            ignores_time: false,
            sync: SyncUnit::new(width, pulse_length),
            latches: [Latch::default(); 2],
            control: Control::default(),
        }
    }

    #[must_use]
    pub fn system(&self, local: u64) -> u64 {
        self.width.cut(local.wrapping_add(self.offset))
    }

    /// Returns the value of a read of 0x0910: the time at which the frame passed the reference
    /// clock.
    #[must_use]
    pub fn local_copy(&self, local: u64) -> u64 {
        let delay = u64::from(self.delay);
        self.width.cut(self.system(local).wrapping_sub(delay))
    }

    /// Handles a write to 0x0920. Pending pulses keep their system time.
    pub fn set_offset(&mut self, offset: u64, local: u64) {
        if self.offset != offset {
            self.offset = offset;
            let system = self.system(local);
            self.sync.aim(local, system);
        }
    }

    /// Handles a write to 0x0910: compares 32 bits, as the hardware does, and adjusts the clock
    /// rate.
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
        // The loop must not oscillate with less frequent frames.
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

    /// Handles a write to 0x0930: the loop restarts from the bare crystal rate.
    pub fn restart(&mut self, clock: &mut Clock, now: Nanos, start: u16) {
        self.control = Control {
            start: start.clamp(0x0080, 0x3fff),
            filters: self.control.filters,
            ..Control::default()
        };
        clock.bend(now, 0.0);
    }

    /// Handles a write to 0x0934 or 0x0935: the averages restart.
    pub fn set_filters(&mut self, filters: [u8; 2]) {
        self.control.filters = filters.map(|depth| depth & 0x0f);
        self.control.mean = None;
        self.control.shown = self.control.learnt;
    }

    /// Returns 0x092C: the magnitude, with bit 31 set if the local copy is at least the received
    /// time.
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

    /// Returns 0x0932. With d = 0x0932 and s = 0x0930, the bare period of the local clock is the
    /// period of the reference times 1 − d / (5 · (s + d + 2) · (s − d + 2)).
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

    /// Sends system times every millisecond from a reference that shows true time.
    fn discipline(clock: &mut Clock, dc: &mut Dc, from_ms: u64, to_ms: u64) {
        for ms in from_ms..to_ms {
            let now = ms * 1_000_000;
            let local = clock.local(now);
            dc.compare(clock, now, local, now as u32);
        }
    }

    #[test]
    fn clock_follows_a_reference_with_100_ppm_deviation() {
        for start in [0x0400, DEFAULT_SPEED_START, 0x3fff] {
            let (mut clock, mut dc) = (Clock::new(0, 0, 100.0), Dc::new(Width::Bits64, 0));
            dc.restart(&mut clock, 0, start);
            discipline(&mut clock, &mut dc, 1, 3_000);
            let off = clock.local(3_000_000_000).abs_diff(3_000_000_000);
            assert!(off < 5, "{off} ns with 0x{start:04x}");
        }
    }

    #[test]
    fn larger_speed_counter_start_reduces_the_bandwidth() {
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
    fn speed_register_shows_the_deviation_of_the_crystal() {
        for ppm in [-80.0, -3.0, 0.0, 20.0, 100.0] {
            let (mut clock, mut dc) = (Clock::new(0, 0, ppm), Dc::new(Width::Bits64, 0));
            dc.set_filters([0, 4]);
            discipline(&mut clock, &mut dc, 1, 3_000);
            let d = f64::from(dc.speed_register());
            let s = f64::from(DEFAULT_SPEED_START);
            let deviation = d / (5.0 * (s + d + 2.0) * (s - d + 2.0));
            // A period shorter by this share is a clock faster by the same share.
            let seen = (1.0 / (1.0 - deviation) - 1.0) * 1e6;
            assert!((seen - ppm).abs() < 0.05, "{seen} for {ppm}");
        }
    }

    #[test]
    fn difference_register_sets_the_sign_bit_for_clocks_ahead() {
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
    fn restart_returns_to_the_bare_crystal_rate() {
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
    fn system_time_of_32_bits_wraps() {
        let mut dc = Dc::new(Width::Bits32, 0);
        dc.set_offset(0xffff_ffff, 0);
        assert_eq!(dc.system(1), 0);
        assert_eq!(dc.system(11), 10);
    }
}
