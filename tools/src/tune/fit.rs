//! Inertia, friction, dead time and resonance of an axis, from its spectra.

use num_complex::Complex64;

use super::TuneError;
use super::response::Line;

/// The properties of an axis, for torques in percent of rated torque.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plant {
    /// The torque per acceleration, in % per unit/s².
    pub inertia: f64,
    /// The viscous friction, in % per unit/s.
    pub viscous: f64,
    /// The Coulomb friction, in %.
    pub coulomb: f64,
    /// The time from a torque to the position that shows it, in s.
    pub delay_s: f64,
    /// The part of the torque that the model does not explain, from 0 to 1.
    pub residual: f64,
    pub resonance: Option<Resonance>,
}

/// A load behind an elastic coupling, in Hz.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Resonance {
    /// The motor stands while the load swings.
    pub antiresonance_hz: f64,
    /// Motor and load swing against each other.
    pub resonance_hz: f64,
}

/// The least coherence of a line that counts.
pub const MIN_COHERENCE: f64 = 0.9;
/// The residual up to which all lines are those of a rigid body.
const RIGID: f64 = 0.1;
/// The residual of torques that have little to do with the motion.
const WORST: f64 = 0.3;
/// By how much a resonance lifts the response.
const PEAK: f64 = 2.0;

/// Which torque of a line moves the axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TorqueSource {
    /// The reported one.
    Reported,
    /// The commanded one; the dead time is then that of the whole way.
    Commanded,
}

impl TorqueSource {
    fn of(self, line: &Line) -> Complex64 {
        match self {
            Self::Reported => line.torque,
            Self::Commanded => line.target_torque,
        }
    }
}

/// Fits the model `torque · e^(−s·delay) = (inertia · s² + viscous · s) · position + coulomb · sign`.
///
/// # Errors
/// Too few lines follow the excitation, or no inertia shows.
pub fn fit(lines: &[Line], source: TorqueSource, longest_s: f64) -> Result<Plant, TuneError> {
    let good: Vec<Line> = lines
        .iter()
        .filter(|line| line.coherence >= MIN_COHERENCE && source.of(line).norm() > 0.0)
        .copied()
        .collect();
    if good.len() < 4 {
        return Err(TuneError::Fit(format!(
            "only {} of {} lines follow the excitation (coherence of {MIN_COHERENCE} or more), 4 are needed: use a larger amplitude or lower frequencies",
            good.len(),
            lines.len()
        )));
    }
    // A resonance spoils the fit of all lines; the lower ones are then those of a rigid body.
    let counts = [
        good.len(),
        good.len() * 3 / 4,
        good.len() / 2,
        good.len() / 3,
    ];
    let fits = counts.into_iter().filter(|count| *count >= 4);
    let mut fits = fits.map(|count| rigid(&good[..count], source, longest_s));
    let first = fits.next().unwrap_or_else(|| Err(no_axis()));
    let mut plant = fits.fold(first, |best, next| match (&best, &next) {
        (Ok(best), _) if best.residual < RIGID => Ok(*best),
        (Ok(best), Ok(next)) if best.residual <= next.residual => Ok(*best),
        (_, Ok(_)) => next,
        _ => best,
    })?;
    // Lines near a resonance are not those of a rigid body.
    if let Some(found) = resonance(&good, source, &plant) {
        let factor = |omega: f64, hz: f64| 1.0 - (omega / (hz * std::f64::consts::TAU)).powi(2);
        let below: Vec<Line> = good
            .iter()
            .filter(|line| line.omega < 0.5 * found.antiresonance_hz * std::f64::consts::TAU)
            .map(|line| {
                // As the position would be without the elastic coupling.
                let lifted = factor(line.omega, found.antiresonance_hz)
                    / factor(line.omega, found.resonance_hz);
                Line {
                    position: line.position / lifted,
                    ..*line
                }
            })
            .collect();
        if below.len() >= 4 {
            plant = rigid(&below, source, longest_s)?;
        }
        plant.resonance = resonance(&good, source, &plant).or(Some(found));
    }
    Ok(plant)
}

/// Fits inertia and friction for each dead time, and takes the best.
fn rigid(lines: &[Line], source: TorqueSource, longest_s: f64) -> Result<Plant, TuneError> {
    const STEPS: usize = 60;
    let at = |delay: f64| solve(lines, source, delay);
    let (mut low, mut high) = (-0.2 * longest_s, longest_s);
    let mut best = None::<Plant>;
    for _ in 0..4 {
        let step = (high - low) / STEPS as f64;
        for n in 0..=STEPS {
            let found = at(low + step * n as f64);
            if let Some(found) = found
                && best.is_none_or(|best| found.residual < best.residual)
            {
                best = Some(found);
            }
        }
        let middle = best.map_or(0.5 * (low + high), |best| best.delay_s);
        (low, high) = (middle - 2.0 * step, middle + 2.0 * step);
    }
    let best = best.filter(|best| best.inertia > 0.0 && best.residual < WORST);
    best.ok_or_else(no_axis)
}

fn no_axis() -> TuneError {
    TuneError::Fit(
        "the torque does not go with the acceleration of the axis: use a larger amplitude, or look at the coupling"
            .to_owned(),
    )
}

/// Least squares for one dead time.
fn solve(lines: &[Line], source: TorqueSource, delay_s: f64) -> Option<Plant> {
    let (mut normal, mut right, mut power) = ([[0.0_f64; 3]; 3], [0.0; 3], 0.0);
    for line in lines {
        let s = Complex64::new(0.0, line.omega);
        let torque = source.of(line) * (-s * delay_s).exp();
        let terms = [s * s * line.position, s * line.position, line.direction];
        power += torque.norm_sqr();
        for (row, term) in terms.iter().enumerate() {
            right[row] += (term.conj() * torque).re;
            for (column, other) in terms.iter().enumerate() {
                normal[row][column] += (term.conj() * other).re;
            }
        }
    }
    let [inertia, viscous, coulomb] = solve3(normal, right)?;
    let residual = lines.iter().map(|line| {
        let s = Complex64::new(0.0, line.omega);
        let torque = source.of(line) * (-s * delay_s).exp();
        let model = (s * s * inertia + s * viscous) * line.position + coulomb * line.direction;
        (torque - model).norm_sqr()
    });
    let residual = (residual.sum::<f64>() / power).sqrt();
    residual.is_finite().then_some(Plant {
        inertia,
        viscous,
        coulomb,
        delay_s,
        residual,
        resonance: None,
    })
}

/// Solves three equations by Cramer's rule, with columns scaled to each other.
fn solve3(m: [[f64; 3]; 3], r: [f64; 3]) -> Option<[f64; 3]> {
    let scale = [0, 1, 2].map(|n| if m[n][n] > 0.0 { m[n][n].sqrt() } else { 1.0 });
    let mut a = m;
    let mut b = r;
    for row in 0..3 {
        b[row] /= scale[row];
        for column in 0..3 {
            a[row][column] /= scale[row] * scale[column];
        }
        // A column without any signal, such as friction that never shows, gets 0.
        if a[row][row] == 0.0 {
            a[row][row] = 1.0;
        }
    }
    let det = |a: &[[f64; 3]; 3]| {
        a[0][0] * (a[1][1] * a[2][2] - a[1][2] * a[2][1])
            - a[0][1] * (a[1][0] * a[2][2] - a[1][2] * a[2][0])
            + a[0][2] * (a[1][0] * a[2][1] - a[1][1] * a[2][0])
    };
    let all = det(&a);
    if all.abs() < 1e-12 {
        return None;
    }
    let mut found = [0.0; 3];
    for (n, found) in found.iter_mut().enumerate() {
        let mut own = a;
        for row in 0..3 {
            own[row][n] = b[row];
        }
        *found = det(&own) / all / scale[n];
    }
    Some(found)
}

/// Looks for a dip and the peak after it, relative to the rigid body.
fn resonance(lines: &[Line], source: TorqueSource, plant: &Plant) -> Option<Resonance> {
    let relative: Vec<(f64, f64)> = lines
        .iter()
        .map(|line| {
            let s = Complex64::new(0.0, line.omega);
            let needs = (s * s * plant.inertia + s * plant.viscous) * line.position
                + plant.coulomb * line.direction;
            (line.omega, needs.norm() / source.of(line).norm())
        })
        .collect();
    let highest = |range: &[(f64, f64)]| {
        let best = range
            .iter()
            .enumerate()
            .max_by(|a, b| a.1.1.total_cmp(&b.1.1));
        best.map(|(n, (_, value))| (n, *value))
    };
    let (peak, value) = highest(&relative)?;
    let inverse: Vec<_> = relative[..peak]
        .iter()
        .map(|&(w, v)| (w, 1.0 / v))
        .collect();
    let (dip, depth) = highest(&inverse)?;
    // Both lie between lines, and the peak is not an edge of the measured range.
    let found = value > PEAK && depth > PEAK && peak + 1 < relative.len() && dip > 0;
    found.then(|| Resonance {
        antiresonance_hz: vertex(&inverse, dip),
        resonance_hz: vertex(&relative, peak),
    })
}

/// Returns the frequency in Hz of a maximum between lines: the parabola through the logarithms.
fn vertex(values: &[(f64, f64)], at: usize) -> f64 {
    let point = |n: usize| values.get(n).map(|(w, v)| (w.ln(), v.ln()));
    let middle = values.get(at).map_or(0.0, |(w, _)| *w);
    let vertex = (|| {
        let (x0, y0) = point(at.checked_sub(1)?)?;
        let (x1, y1) = point(at)?;
        let (x2, y2) = point(at + 1)?;
        let (a, b) = (x1 - x0, x1 - x2);
        let (p, q) = (y1 - y2, y1 - y0);
        let below = a * p - b * q;
        (below.abs() > 1e-12).then(|| (x1 - 0.5 * (a * a * p - b * b * q) / below).exp())
    })();
    vertex.filter(|w| w.is_finite()).unwrap_or(middle) / std::f64::consts::TAU
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn lines(of: impl Fn(Complex64) -> Complex64) -> Vec<Line> {
        let each = (0..48).map(|n| {
            let omega = std::f64::consts::TAU * 2.0 * (100.0_f64).powf(f64::from(n) / 47.0);
            let s = Complex64::new(0.0, omega);
            let torque = Complex64::new(1.0, 0.3);
            Line {
                omega,
                excitation: torque,
                target_velocity: Complex64::ZERO,
                target_torque: torque,
                position: of(s) * torque,
                torque,
                direction: Complex64::ZERO,
                coherence: 1.0,
            }
        });
        each.collect()
    }

    proptest! {
        #[test]
        fn a_rigid_body_is_found(
            inertia in 1e-3f64..10.0,
            friction in 0.0f64..5.0,
            delay in 0.0f64..0.008,
        ) {
            let viscous = friction * inertia;
            let seen = lines(|s| (-s * delay).exp() / (s * s * inertia + s * viscous));
            let plant = fit(&seen, TorqueSource::Commanded, 0.02).unwrap();
            prop_assert!((plant.inertia / inertia - 1.0).abs() < 0.01, "{:?}", plant);
            prop_assert!((plant.viscous - viscous).abs() < 0.05 * inertia, "{:?}", plant);
            prop_assert!((plant.delay_s - delay).abs() < 1e-5, "{:?}", plant);
            prop_assert_eq!(plant.resonance, None);
        }

        #[test]
        fn a_resonance_is_found(zero in 15.0f64..60.0, ratio in 1.2f64..2.0) {
            let tau = std::f64::consts::TAU;
            let pair = |s: Complex64, hz: f64| {
                let w = tau * hz;
                s * s / (w * w) + s * (0.04 / w) + 1.0
            };
            let seen = lines(|s| pair(s, zero) / pair(s, zero * ratio) / (s * s * 0.5));
            let plant = fit(&seen, TorqueSource::Reported, 0.02).unwrap();
            let found = plant.resonance.unwrap();
            prop_assert!((found.antiresonance_hz / zero - 1.0).abs() < 0.05, "{:?}", found);
            prop_assert!((found.resonance_hz / (zero * ratio) - 1.0).abs() < 0.05, "{:?}", found);
            prop_assert!((plant.inertia / 0.5 - 1.0).abs() < 0.05, "{:?}", plant);
        }
    }

    #[test]
    fn noise_is_no_axis() {
        let mut seen = lines(|s| 1.0 / (s * s));
        for line in &mut seen {
            line.coherence = 0.2;
        }
        let error = fit(&seen, TorqueSource::Reported, 0.02).unwrap_err();
        assert!(error.to_string().contains("larger amplitude"), "{error}");
    }
}
