//! Gains that meet margins: of the loops in the MainDevice, and of EPOS4 and IDX.

use std::f64::consts::TAU;

use num_complex::Complex64;
use serde::Serialize;

use super::margins::{Margins, dense, margins};
use super::response::Response;

/// The margins that a loop must have.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Targets {
    pub phase_deg: f64,
    /// Both ways.
    pub gain_db: f64,
    /// The highest crossover, in Hz.
    pub bandwidth_hz: f64,
}

impl Targets {
    fn met(&self, found: &Margins) -> bool {
        found.phase_deg >= self.phase_deg
            && found.rise_db >= self.gain_db
            && found.fall_db.is_none_or(|fall| fall >= self.gain_db)
            && found.crossover_hz <= self.bandwidth_hz
    }
}

/// Gains of `loops.cst`, in the units of the machine file.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct TorqueLoop {
    /// % per unit.
    pub kp: f64,
    pub tn_s: f64,
    pub tv_s: f64,
    pub margins: Margins,
}

/// Gains of `loops.csv`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct VelocityLoop {
    /// 1/s.
    pub kv: f64,
    pub margins: Margins,
}

/// Gains of a loop in the drive, in SI units: A, rad, s. The integral gain is 0 for none.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DriveLoop {
    pub p: f64,
    pub i: f64,
    pub d: f64,
    pub margins: Margins,
}

/// Motor and load in SI units.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Motor {
    /// kg·m²
    pub inertia: f64,
    /// N·m·s/rad
    pub viscous: f64,
    /// N·m/A
    pub torque_constant: f64,
}

/// The integral action time, and the derivative action time, times the crossover. Together they lead
/// the phase by 70°.
const INTEGRAL: f64 = 10.0;
const DERIVATIVE: f64 = 4.0;
/// Candidates of the crossover.
const STEPS: usize = 400;

/// Returns the fastest loop with its gains for each candidate of the crossover.
fn fastest<T>(plant: &[(f64, Complex64)], gains: impl Fn(f64) -> Option<T>) -> Option<T> {
    let (first, last) = (plant.first()?.0, plant.last()?.0);
    let ratio = (last / first).ln();
    let mut candidates = (0..STEPS).map(|n| last * (-ratio * n as f64 / STEPS as f64).exp());
    candidates.find_map(gains)
}

fn gain_at(open: &[(f64, Complex64)], omega: f64) -> Option<f64> {
    let after = open.iter().position(|(w, _)| *w >= omega)?;
    Some(open.get(after)?.1.norm())
}

/// Returns the open loop of a controller and a plant, and its margins, scaled to a gain of 1 at
/// `omega`. The first result is the scale.
fn closed(
    plant: &[(f64, Complex64)],
    controller: impl Fn(f64) -> Complex64,
    omega: f64,
    targets: &Targets,
) -> Option<(f64, Margins)> {
    let open: Response = plant
        .iter()
        .map(|(w, p)| (*w, controller(*w) * p))
        .collect();
    let scale = 1.0 / gain_at(&open, omega)?;
    let open: Vec<_> = open.iter().map(|(w, l)| (*w, l * scale)).collect();
    let found = margins(&open).filter(|found| targets.met(found))?;
    Some((scale, found))
}

/// Returns gains for the position loop over torques: `kp · (e + 1/tn ∫e + tv · de/dt)`, sampled
/// with `dt_s`.
#[must_use]
pub fn torque_loop(
    over_torque: &[(f64, Complex64)],
    dt_s: f64,
    targets: &Targets,
) -> Option<TorqueLoop> {
    let plant = dense(over_torque);
    fastest(&plant, |omega| {
        let (tn_s, tv_s) = (INTEGRAL / omega, DERIVATIVE / omega);
        let controller = |w: f64| {
            let step = Complex64::new(0.0, -w * dt_s).exp();
            1.0 + (dt_s / tn_s) / (1.0 - step) + tv_s / dt_s * (1.0 - step)
        };
        let (kp, margins) = closed(&plant, controller, omega, targets)?;
        Some(TorqueLoop {
            kp,
            tn_s,
            tv_s,
            margins,
        })
    })
}

/// Returns the gain of the position loop over velocities.
#[must_use]
pub fn velocity_loop(
    over_velocity: &[(f64, Complex64)],
    targets: &Targets,
) -> Option<VelocityLoop> {
    let plant = dense(over_velocity);
    fastest(&plant, |omega| {
        let (kv, margins) = closed(&plant, |_| Complex64::ONE, omega, targets)?;
        Some(VelocityLoop { kv, margins })
    })
}

/// The same for the drive, whose filter of the derivative part leaves a lead of 52° at most.
const DRIVE_INTEGRAL: f64 = 20.0;
const DRIVE_DERIVATIVE: f64 = 3.2;
/// The transport delay of the loops of EPOS4 and IDX (application notes, 2.3.1 to 2.3.3), in s.
const DRIVE_DELAY_S: f64 = 0.4e-3 + 0.06e-3;

fn grid() -> impl Iterator<Item = f64> {
    (0..1200).map(|n| TAU * 0.1 * 10.0_f64.powf(f64::from(n) / 300.0))
}

/// Returns gains of the drive's position loop: `P + I/s + D·s / (1 + D/(10·P)·s)` (2.3.3).
#[must_use]
pub fn drive_position(motor: &Motor, targets: &Targets) -> Option<DriveLoop> {
    let plant: Response = grid()
        .map(|w| {
            let s = Complex64::new(0.0, w);
            let p = motor.torque_constant / (s * s * motor.inertia + s * motor.viscous);
            (w, p * (-s * DRIVE_DELAY_S).exp())
        })
        .collect();
    fastest(&plant, |omega| {
        let (tn, tv) = (DRIVE_INTEGRAL / omega, DRIVE_DERIVATIVE / omega);
        let controller = |w: f64| {
            let s = Complex64::new(0.0, w);
            1.0 + 1.0 / (s * tn) + s * tv / (1.0 + s * tv / 10.0)
        };
        let (p, margins) = closed(&plant, controller, omega, targets)?;
        Some(DriveLoop {
            p,
            i: p / tn,
            d: p * tv,
            margins,
        })
    })
}

/// Returns gains of the drive's velocity loop: `P + I/s` (2.3.2), with the low-pass filter of the
/// measured velocity at `filter_hz`.
#[must_use]
pub fn drive_velocity(motor: &Motor, filter_hz: f64, targets: &Targets) -> Option<DriveLoop> {
    let plant: Response = grid()
        .map(|w| {
            let s = Complex64::new(0.0, w);
            let filter = TAU * filter_hz / (s + TAU * filter_hz);
            let p = motor.torque_constant / (s * motor.inertia + motor.viscous);
            (w, p * filter * (-s * DRIVE_DELAY_S).exp())
        })
        .collect();
    fastest(&plant, |omega| {
        let tn = INTEGRAL / omega;
        let controller = |w: f64| 1.0 + 1.0 / Complex64::new(0.0, w * tn);
        let (p, margins) = closed(&plant, controller, omega, targets)?;
        Some(DriveLoop {
            p,
            i: p / tn,
            d: 0.0,
            margins,
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const TARGETS: Targets = Targets {
        phase_deg: 50.0,
        gain_db: 6.0,
        bandwidth_hz: 1e3,
    };

    fn plant(of: impl Fn(Complex64) -> Complex64) -> Response {
        let each = (0..60).map(|n| TAU * 0.5 * 400.0_f64.powf(f64::from(n) / 59.0));
        each.map(|w| (w, of(Complex64::new(0.0, w)))).collect()
    }

    proptest! {
        /// The dead time limits the loop; the margins hold for any inertia.
        #[test]
        fn a_torque_loop_meets_its_margins(inertia in 1e-3f64..10.0, delay in 1e-3f64..8e-3) {
            let found = torque_loop(
                &plant(|s| (-s * delay).exp() / (s * s * inertia)),
                1e-3,
                &TARGETS,
            );
            let found = found.unwrap();
            prop_assert!(TARGETS.met(&found.margins));
            let crossover = TAU * found.margins.crossover_hz;
            prop_assert!((0.1..0.6).contains(&(crossover * delay)) || delay < 2e-3, "{found:?}");
        }

        #[test]
        fn a_velocity_loop_meets_its_margins(delay in 3e-3f64..2e-2) {
            let found = velocity_loop(&plant(|s| (-s * delay).exp() / s), &TARGETS).unwrap();
            // 90° − kv · delay = 50°, or π/2/(kv · delay) = 2.
            let expected = 40.0_f64.to_radians() / delay;
            prop_assert!((found.kv / expected - 1.0).abs() < 0.03, "{found:?}");
        }
    }

    #[test]
    fn drive_loops_meet_their_margins() {
        let motor = Motor {
            inertia: 3.6e-5,
            viscous: 2e-5,
            torque_constant: 37e-3,
        };
        let targets = Targets {
            phase_deg: 45.0,
            bandwidth_hz: 40.0,
            ..TARGETS
        };
        let position = drive_position(&motor, &targets).unwrap();
        let velocity = drive_velocity(&motor, 318.0, &targets).unwrap();
        for found in [position, velocity] {
            assert!(targets.met(&found.margins), "{found:?}");
            assert!(found.margins.crossover_hz > 30.0, "{found:?}");
        }
    }

    #[test]
    fn a_loop_that_cannot_meet_its_margins_has_no_gains() {
        assert_eq!(
            torque_loop(&plant(|s| (-s * 0.5).exp() / (s * s)), 1e-3, &TARGETS),
            None
        );
        assert_eq!(velocity_loop(&[], &TARGETS), None);
    }
}
