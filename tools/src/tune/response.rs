//! Spectra of whole periods, and the frequency responses between them.
//!
//! Each signal is averaged over the periods before signals are divided: the excitation is the same in
//! each, so the response does not depend on noise that a control loop feeds back.

use std::f64::consts::TAU;

use num_complex::Complex64;

use super::TuneError;
use super::excitation::Excitation;
use super::excite::Sample;

/// The mean spectra at one frequency.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Line {
    /// The frequency in rad/s.
    pub omega: f64,
    /// The excitation.
    pub excitation: Complex64,
    /// Commanded velocity and torque.
    pub target_velocity: Complex64,
    pub target_torque: Complex64,
    /// Reported position and torque.
    pub position: Complex64,
    pub torque: Complex64,
    /// The sign of the velocity: Coulomb friction.
    pub direction: Complex64,
    /// The part of the position that comes from the excitation, from 0 to 1.
    pub coherence: f64,
}

/// A frequency response: rad/s and value.
pub type Response = Vec<(f64, Complex64)>;

/// The spectra of an excitation.
#[derive(Debug, Clone, PartialEq)]
pub struct Spectra {
    pub lines: Vec<Line>,
    /// The evaluated periods.
    pub periods: usize,
    /// The mean torque, in percent: a load such as gravity.
    pub mean_torque: f64,
}

const SIGNALS: usize = 6;
/// The samples before and after one from which its direction follows.
const AROUND: usize = 3;

impl Spectra {
    /// Evaluates the periods between the first, which settles, and the last, which fades.
    ///
    /// # Errors
    /// Frames were lost in all periods but one.
    pub fn of(plan: &Excitation, samples: &[Sample]) -> Result<Self, TuneError> {
        let period = plan.samples.len();
        let all = (samples.len() / period).saturating_sub(2);
        // A speed needs the samples around it.
        let whole: Vec<usize> = (1..=all)
            .map(|n| n * period)
            .filter(|&at| {
                let own = samples.get(at - 1..at + period + AROUND);
                own.is_some_and(|own| own.iter().all(|sample| sample.fresh))
            })
            .collect();
        if whole.len() < 2 {
            return Err(TuneError::Lost {
                whole: whole.len(),
                all,
            });
        }
        let turns: Vec<Complex64> = (0..period)
            .map(|n| Complex64::cis(-TAU * n as f64 / period as f64))
            .collect();
        let each: Vec<Vec<[Complex64; SIGNALS]>> = whole
            .iter()
            .map(|&at| transform(&signals(samples, at, period), &plan.lines, &turns))
            .collect();
        let lines = plan.lines.iter().enumerate().map(|(n, &line)| {
            let count = each.len() as f64;
            let mut mean = [Complex64::ZERO; SIGNALS];
            let (mut together, mut power, mut excited) = (Complex64::ZERO, 0.0, 0.0);
            for spectrum in &each {
                let own = spectrum[n];
                for (mean, own) in mean.iter_mut().zip(own) {
                    *mean += own / count;
                }
                together += own[3] * own[0].conj();
                power += own[3].norm_sqr();
                excited += own[0].norm_sqr();
            }
            let product = power * excited;
            Line {
                omega: plan.omega(line),
                excitation: mean[0],
                target_velocity: mean[1],
                target_torque: mean[2],
                position: mean[3],
                torque: mean[4],
                direction: mean[5],
                coherence: if product > 0.0 {
                    together.norm_sqr() / product
                } else {
                    0.0
                },
            }
        });
        let torques = whole.iter().flat_map(|&at| &samples[at..at + period]);
        let sum: f64 = torques.map(|sample| sample.torque).sum();
        Ok(Self {
            lines: lines.collect(),
            periods: whole.len(),
            mean_torque: sum / (whole.len() * period) as f64,
        })
    }

    fn ratio(&self, of: impl Fn(&Line) -> (Complex64, Complex64)) -> Response {
        let lines = self.lines.iter().map(|line| {
            let (above, below) = of(line);
            (line.omega, above / below)
        });
        lines.filter(|(_, value)| value.is_finite()).collect()
    }

    /// Position over reported torque, in units per percent: motor and load.
    #[must_use]
    pub fn plant(&self) -> Response {
        self.ratio(|line| (line.position, line.torque))
    }

    /// Position over commanded torque: what `loops.cst` controls.
    #[must_use]
    pub fn over_torque(&self) -> Response {
        self.ratio(|line| (line.position, line.target_torque))
    }

    /// Position over commanded velocity: what `loops.csv` controls.
    #[must_use]
    pub fn over_velocity(&self) -> Response {
        self.ratio(|line| (line.position, line.target_velocity))
    }

    /// Position over commanded position: how the axis follows.
    #[must_use]
    pub fn following(&self) -> Response {
        self.ratio(|line| (line.position, line.excitation))
    }
}

/// The signals of one period.
fn signals(samples: &[Sample], at: usize, period: usize) -> Vec<[f64; SIGNALS]> {
    let position = |n: usize| samples.get(n).map_or(0.0, |sample| sample.position);
    // What the axis drifts over the period would show in all lines.
    let drift = (position(at + period) - position(at)) / period as f64;
    (0..period)
        .map(|n| {
            let sample = samples[at + n];
            // Over a few counts, also at low speed.
            let speed = position(at + n + AROUND) - position((at + n).saturating_sub(AROUND));
            let direction = if speed == 0.0 { 0.0 } else { speed.signum() };
            [
                sample.excitation,
                sample.target_velocity,
                sample.target_torque,
                sample.position - drift * n as f64,
                sample.torque,
                direction,
            ]
        })
        .collect()
}

/// Returns the amplitudes of the lines of each signal.
fn transform(
    signals: &[[f64; SIGNALS]],
    lines: &[usize],
    turns: &[Complex64],
) -> Vec<[Complex64; SIGNALS]> {
    let count = signals.len();
    let each = lines.iter().map(|line| {
        let mut sums = [Complex64::ZERO; SIGNALS];
        for (n, values) in signals.iter().enumerate() {
            let turn = turns[(line * n) % count];
            for (sum, value) in sums.iter_mut().zip(values) {
                *sum += turn * *value;
            }
        }
        sums.map(|sum| sum * (2.0 / count as f64))
    });
    each.collect()
}
