//! Periodic excitations: sums of sines with whole periods, and pseudo-random sequences.

use std::f64::consts::TAU;

use super::TuneError;

/// The form of an excitation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// Sines at logarithmic distances. The best signal for each of them.
    Multisine,
    /// Sines at equal distances, in phases that sweep once a period.
    Chirp,
    /// A binary sequence of maximal length. Of torques only: its steps have no derivative.
    Prbs,
}

/// What an excitation commands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Quantity {
    /// Positions; every sine has the same acceleration.
    Motion,
    /// The same motion, commanded as velocities: in CSV, and in CST with a position loop.
    Velocity,
    /// Torques in percent of rated torque.
    Torque,
}

/// The bounds of an excitation, in units of the axis; torques in percent of rated torque.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// The greatest distance from the start.
    pub travel: f64,
    pub velocity: f64,
    pub acceleration: f64,
    pub torque: f64,
    /// The steepest change of the torque, in percent per second.
    pub torque_slope: f64,
}

/// One period of an excitation.
#[derive(Debug, Clone, PartialEq)]
pub struct Excitation {
    pub form: Form,
    pub quantity: Quantity,
    /// The sampling time, in s.
    pub dt_s: f64,
    /// The values of one period.
    pub samples: Vec<f64>,
    /// The evaluated multiples of the base frequency.
    pub lines: Vec<usize>,
}

/// The share of the limits that an excitation uses; the rest is for its beginning and end.
const SHARE: f64 = 0.8;
/// Lines at logarithmic distances.
const LINES: usize = 48;
/// The most sines: the plan takes samples × sines steps.
const MAX_SINES: usize = 1000;
/// The most samples of a period.
const MAX_SAMPLES: usize = 1 << 18;

impl Excitation {
    /// Plans an excitation from `low` to `high`, in Hz, with a period of `period_s`. `amplitude` is
    /// the share of the bounds, above 0 and at most 1.
    ///
    /// # Errors
    /// The frequencies do not fit to each other, to the period or to the cycle.
    pub fn plan(
        (form, quantity): (Form, Quantity),
        (low, high): (f64, f64),
        period_s: f64,
        dt_s: f64,
        bounds: &Bounds,
        amplitude: f64,
    ) -> Result<Self, TuneError> {
        let refuse = |text: String| Err(TuneError::Excitation(text));
        let nyquist = 0.5 / dt_s;
        if !(low > 0.0 && high > low && high < nyquist) {
            return refuse(format!(
                "frequencies from {low} to {high} Hz: they must rise, above 0 and below half the cycle rate of {:.0} Hz",
                2.0 * nyquist
            ));
        }
        let count = (period_s / dt_s).round();
        if !(count >= 16.0 && count <= MAX_SAMPLES as f64) {
            return refuse(format!(
                "a period of {period_s} s has {count} cycles; 16 to {MAX_SAMPLES} are possible"
            ));
        }
        if low * period_s < 1.0 {
            return refuse(format!(
                "one period at {low} Hz lasts {:.3} s, more than the period of {period_s} s",
                1.0 / low
            ));
        }
        if form == Form::Prbs && quantity != Quantity::Torque {
            return refuse(
                "a PRBS is an excitation of torques: the axis needs mode cst".to_owned(),
            );
        }
        let count = count as usize;
        let base = 1.0 / (count as f64 * dt_s);
        let first = (low / base).ceil().max(1.0) as usize;
        let last = (high / base).floor() as usize;
        let lines = match form {
            Form::Chirp => sweep(first, last),
            Form::Multisine | Form::Prbs => logarithmic(first, last),
        };
        if lines.len() < 4 {
            return refuse(format!(
                "{} lines between {low} and {high} Hz: 4 are needed; use a longer period",
                lines.len()
            ));
        }
        let samples = match form {
            Form::Prbs => prbs(count, (0.5 / (high * dt_s)).max(1.0) as usize),
            Form::Multisine | Form::Chirp => vec![0.0; count],
        };
        let mut plan = Self {
            form,
            quantity,
            dt_s,
            samples,
            lines,
        };
        if form == Form::Prbs {
            // The axis takes each step with its own slope.
            plan.scale(SHARE * amplitude * bounds.torque);
        } else {
            plan.sum(bounds, amplitude);
        }
        if plan.lines.len() > 4 * LINES {
            plan.lines = some(&plan.lines);
        }
        Ok(plan)
    }

    fn scale(&mut self, factor: f64) {
        for sample in &mut self.samples {
            *sample *= factor;
        }
    }

    /// Fills in the sum of sines, as large as the bounds permit.
    fn sum(&mut self, bounds: &Bounds, amplitude: f64) {
        let omega = |line: usize| TAU * line as f64 / (self.samples.len() as f64 * self.dt_s);
        // Schroeder's phases keep the sum of equal sines low; the sweep of a chirp follows from them.
        let count = self.lines.len() as f64;
        let phase = |n: usize| -std::f64::consts::PI * (n * n) as f64 / count;
        // Equal torques of all sines would hardly move the low ones within the slope of the torque.
        let power = match self.quantity {
            Quantity::Motion | Quantity::Velocity => 2,
            Quantity::Torque => 1,
        };
        let mut peaks = [0.0_f64; 3];
        let mut values = vec![0.0; self.samples.len()];
        for (at, value) in values.iter_mut().enumerate() {
            let mut sums = [0.0; 3];
            for (n, &line) in self.lines.iter().enumerate() {
                let w = omega(line);
                // Whole turns are left out before the sine, which is exact for large products.
                let turns = (line * at) % self.samples.len();
                let angle = TAU * turns as f64 / self.samples.len() as f64 + phase(n);
                let (sin, cos) = angle.sin_cos();
                let size = w.powi(-power);
                sums[0] += size * cos;
                sums[1] -= size * w * sin;
                sums[2] -= size * w * w * cos;
            }
            *value = sums[0];
            for (peak, sum) in peaks.iter_mut().zip(sums) {
                *peak = peak.max(sum.abs());
            }
        }
        let limits = match self.quantity {
            Quantity::Motion | Quantity::Velocity => {
                [bounds.travel, bounds.velocity, bounds.acceleration]
            }
            Quantity::Torque => [bounds.torque, bounds.torque_slope, f64::INFINITY],
        };
        let factors = limits.iter().zip(peaks).map(|(limit, peak)| limit / peak);
        let factor = factors.fold(f64::INFINITY, f64::min);
        self.samples = values;
        self.scale(SHARE * amplitude * factor);
    }

    /// Returns the frequency of a line, in rad/s.
    #[must_use]
    pub fn omega(&self, line: usize) -> f64 {
        TAU * line as f64 / (self.samples.len() as f64 * self.dt_s)
    }

    /// Returns the time of one period, in s.
    #[must_use]
    pub fn period_s(&self) -> f64 {
        self.samples.len() as f64 * self.dt_s
    }
}

/// Returns different numbers from `first` to `last`, at about equal ratios.
fn logarithmic(first: usize, last: usize) -> Vec<usize> {
    let ratio = last as f64 / first as f64;
    let steps = (0..LINES).map(|n| n as f64 / (LINES - 1) as f64);
    let mut lines: Vec<_> = steps
        .map(|step| (first as f64 * ratio.powf(step)).round() as usize)
        .collect();
    lines.dedup();
    lines
}

/// Returns at most [`MAX_SINES`] numbers at equal distances.
fn sweep(first: usize, last: usize) -> Vec<usize> {
    let count = (last + 1).saturating_sub(first);
    let step = count.div_ceil(MAX_SINES).max(1);
    (first..=last).step_by(step).collect()
}

/// Returns those of the lines that are at about equal ratios.
fn some(lines: &[usize]) -> Vec<usize> {
    let (Some(first), Some(last)) = (lines.first(), lines.last()) else {
        return Vec::new();
    };
    let wanted = logarithmic(*first, *last).into_iter();
    let mut some: Vec<_> = wanted
        .filter_map(|wanted| {
            lines
                .iter()
                .copied()
                .min_by_key(|line| line.abs_diff(wanted))
        })
        .collect();
    some.dedup();
    some
}

/// Returns a period of ±1, `clock` samples each, from the longest sequence that fits.
fn prbs(count: usize, clock: usize) -> Vec<f64> {
    // Feedback taps of sequences of maximal length.
    const TAPS: [(u32, u32); 10] = [
        (4, 3),
        (5, 3),
        (6, 5),
        (7, 6),
        (9, 5),
        (10, 7),
        (11, 9),
        (15, 14),
        (17, 14),
        (18, 11),
    ];
    let fits = |(bits, _): &&(u32, u32)| ((1 << bits) - 1) * clock <= count;
    let &(bits, tap) = TAPS.iter().rev().find(fits).unwrap_or(&TAPS[0]);
    let mut register = 1_u32;
    let mut values = Vec::with_capacity(count);
    while values.len() < count {
        let bit = (register >> (bits - 1) ^ register >> (tap - 1)) & 1;
        register = (register << 1 | bit) & ((1 << bits) - 1);
        let value = if bit == 1 { 1.0 } else { -1.0 };
        values.extend(std::iter::repeat_n(value, clock));
    }
    values.truncate(count);
    values
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const BOUNDS: Bounds = Bounds {
        travel: 1.0,
        velocity: 30.0,
        acceleration: 400.0,
        torque: 50.0,
        torque_slope: 5000.0,
    };

    #[test]
    fn impossible_excitations_are_refused() {
        let motion = (Form::Multisine, Quantity::Motion);
        for (what, range, period, text) in [
            (motion, (5.0, 2.0), 2.0, "must rise"),
            (motion, (0.0, 2.0), 2.0, "must rise"),
            (motion, (1.0, 500.0), 2.0, "half the cycle rate of 1000 Hz"),
            (motion, (0.1, 50.0), 2.0, "more than the period of 2 s"),
            (motion, (1.0, 50.0), f64::NAN, "NaN cycles"),
            (motion, (1.0, 50.0), 1e9, "are possible"),
            (motion, (10.0, 11.0), 1.0, "4 are needed"),
            (
                (Form::Prbs, Quantity::Motion),
                (1.0, 50.0),
                2.0,
                "needs mode cst",
            ),
        ] {
            let error = Excitation::plan(what, range, period, 1e-3, &BOUNDS, 1.0).unwrap_err();
            assert!(error.to_string().contains(text), "{error}");
        }
    }

    #[test]
    fn a_prbs_is_a_sequence_of_maximal_length() {
        let values = prbs(127 * 3, 3);
        assert_eq!(values.len(), 381);
        assert_eq!(values.iter().sum::<f64>().abs(), 3.0);
    }

    /// Long sweeps are planned in bounded time, and all evaluated lines are excited.
    #[test]
    fn a_long_chirp_has_a_bounded_number_of_sines() {
        for (first, last) in [(1, 1), (3, 1200), (500, 52_000)] {
            let lines = sweep(first, last);
            assert!(lines.len() <= MAX_SINES && lines[0] == first);
            let evaluated = some(&lines);
            assert!(evaluated.len() <= LINES && !evaluated.is_empty());
            assert!(evaluated.iter().all(|line| lines.contains(line)));
        }
    }

    proptest! {
        /// Position, velocity and acceleration stay within their bounds, and the period closes.
        #[test]
        fn motions_stay_within_their_bounds(
            low in 0.5f64..10.0,
            ratio in 3.0f64..40.0,
            period in 2.0f64..5.0,
            amplitude in 0.05f64..=1.0,
            chirp in any::<bool>(),
        ) {
            let dt = 1e-3;
            let form = if chirp { Form::Chirp } else { Form::Multisine };
            let high = (low * ratio).min(200.0);
            let plan =
                Excitation::plan((form, Quantity::Motion), (low, high), period, dt, &BOUNDS, amplitude);
            let plan = plan.unwrap();
            let x = &plan.samples;
            let n = x.len();
            for at in 0..n {
                let (a, b, c) = (x[at], x[(at + 1) % n], x[(at + 2) % n]);
                prop_assert!(a.abs() <= BOUNDS.travel);
                prop_assert!((b - a).abs() / dt <= BOUNDS.velocity);
                prop_assert!((c - 2.0 * b + a).abs() / (dt * dt) <= BOUNDS.acceleration);
            }
        }
    }
}
