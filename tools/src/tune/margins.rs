//! Open loops on a measured response, and their margins.

use num_complex::Complex64;

use super::response::Response;

/// The margins of an open loop.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Margins {
    /// The highest frequency at which the gain is 1, in Hz.
    pub crossover_hz: f64,
    /// The least distance of the phase from −180° where the gain is 1, in degrees.
    pub phase_deg: f64,
    /// The factor by which the gain may rise, in dB. If the phase does not reach −180° in the
    /// measured range, the one at its end.
    pub rise_db: f64,
    /// The factor by which the gain may fall, in dB; none if the loop is stable at every lower gain.
    pub fall_db: Option<f64>,
}

/// Points between two lines of a measured response.
const BETWEEN: usize = 16;

/// Returns a finer response: logarithm of the gain and unwrapped phase are linear in the logarithm
/// of the frequency between lines.
#[must_use]
pub fn dense(measured: &[(f64, Complex64)]) -> Response {
    let phases = unwrapped(measured);
    let points: Vec<(f64, f64, f64)> = measured
        .iter()
        .zip(phases)
        .map(|((w, value), phase)| (w.ln(), value.norm().ln(), phase))
        .collect();
    let mut fine = Vec::with_capacity(points.len() * BETWEEN);
    for pair in points.windows(2) {
        let &[(x0, g0, p0), (x1, g1, p1)] = pair else {
            continue;
        };
        for n in 0..BETWEEN {
            let t = n as f64 / BETWEEN as f64;
            let at = |a: f64, b: f64| a + (b - a) * t;
            fine.push((
                at(x0, x1).exp(),
                Complex64::from_polar(at(g0, g1).exp(), at(p0, p1)),
            ));
        }
    }
    fine.extend(measured.last().copied());
    fine
}

/// Returns the phases without jumps, the first one from −360° to 0.
#[must_use]
pub fn unwrapped(response: &[(f64, Complex64)]) -> Vec<f64> {
    use std::f64::consts::{PI, TAU};
    let mut last = None::<f64>;
    let phases = response.iter().map(|(_, value)| {
        let own = value.arg();
        let phase = match last {
            None if own > 0.0 => own - TAU,
            None => own,
            Some(last) => last + (own - last + PI).rem_euclid(TAU) - PI,
        };
        last = Some(phase);
        phase
    });
    phases.collect()
}

/// Returns the margins of an open loop; `None` if its gain does not fall through 1 in the range, or if
/// it is not stable.
#[must_use]
pub fn margins(open: &[(f64, Complex64)]) -> Option<Margins> {
    use std::f64::consts::{PI, TAU};
    let phases = unwrapped(open);
    let points: Vec<(f64, f64, f64)> = open
        .iter()
        .zip(phases)
        .map(|((w, value), phase)| (w.ln(), value.norm().ln(), phase))
        .collect();
    if points.first().is_none_or(|first| first.1 <= 0.0) {
        return None;
    }
    let (mut crossover, mut phase) = (None, f64::INFINITY);
    let (mut rise, mut fall) = (f64::INFINITY, None::<f64>);
    for pair in points.windows(2) {
        let &[(x0, g0, p0), (x1, g1, p1)] = pair else {
            continue;
        };
        if (g0 > 0.0) != (g1 > 0.0) {
            let t = g0 / (g0 - g1);
            crossover = Some((x0 + (x1 - x0) * t).exp());
            phase = phase.min(p0 + (p1 - p0) * t + PI);
        }
        // −180° and every whole turn from it.
        let turn = |p: f64| ((p + PI) / TAU).floor();
        if turn(p0) != turn(p1) {
            let level = turn(p0).max(turn(p1)) * TAU - PI;
            let t = (level - p0) / (p1 - p0);
            let gain = g0 + (g1 - g0) * t;
            if gain <= 0.0 {
                rise = rise.min(-gain);
            } else {
                fall = Some(fall.map_or(gain, |fall| fall.min(gain)));
            }
        }
    }
    let last = points.last()?;
    if last.1 >= 0.0 {
        return None;
    }
    let rise = if rise.is_finite() { rise } else { -last.1 };
    let db = |ln: f64| ln * 20.0 / std::f64::consts::LN_10;
    let found = Margins {
        crossover_hz: crossover? / TAU,
        phase_deg: phase.to_degrees(),
        rise_db: db(rise),
        fall_db: fall.map(db),
    };
    (phase > 0.0).then_some(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn response(of: impl Fn(Complex64) -> Complex64) -> Response {
        let each = (0..400).map(|n| {
            let omega = 0.1 * 10.0_f64.powf(f64::from(n) / 100.0);
            (omega, of(Complex64::new(0.0, omega)))
        });
        each.collect()
    }

    /// `k e^(−sT) / s`: crossover k, phase margin 90° − kT, gain margin π/(2kT).
    #[test]
    fn an_integrator_with_dead_time_has_the_margins_of_the_textbook() {
        let (k, dead) = (10.0, 0.05);
        let found = margins(&response(|s| k * (-s * dead).exp() / s)).unwrap();
        assert!((found.crossover_hz * std::f64::consts::TAU - k).abs() < 0.01);
        assert!((found.phase_deg - (90.0 - (k * dead).to_degrees())).abs() < 0.05);
        let rise = 20.0 * (std::f64::consts::PI / (2.0 * k * dead)).log10();
        assert!((found.rise_db - rise).abs() < 0.05, "{found:?}");
        assert_eq!(found.fall_db, None);
    }

    /// A double integrator with PID: stable only above a least gain.
    #[test]
    fn a_loop_with_two_integrators_and_integral_part_may_not_fall() {
        let found = margins(&response(|s| 100.0 * (1.0 + 2.0 / s + 0.2 * s) / (s * s))).unwrap();
        assert!(
            found.phase_deg > 50.0 && found.fall_db.unwrap() > 6.0,
            "{found:?}"
        );
    }

    #[test]
    fn unstable_and_unfinished_loops_have_none() {
        let dead = |k: f64| response(move |s| k * (-s * 0.05).exp() / s);
        assert_eq!(margins(&dead(40.0)), None);
        assert_eq!(margins(&dead(1e-3)), None);
        assert_eq!(margins(&response(|s| 1e6 / s)), None);
        assert_eq!(margins(&[]), None);
    }

    #[test]
    fn a_dense_response_keeps_its_lines() {
        let coarse = response(|s| 1.0 / (s * s));
        let fine = dense(&coarse);
        assert_eq!(fine.len(), (coarse.len() - 1) * BETWEEN + 1);
        for (at, value) in &coarse {
            let near = fine
                .iter()
                .find(|(w, _)| (w / at - 1.0).abs() < 1e-9)
                .unwrap();
            assert!((near.1 - value).norm() < 1e-9 * value.norm());
        }
    }
}
