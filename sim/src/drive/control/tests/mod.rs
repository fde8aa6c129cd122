//! The loops against their transfer functions.

mod follow;
mod reference;
mod steps;
mod tuning;

use std::f64::consts::TAU;

use super::*;
use crate::drive::CONTROL_STEP;
use crate::drive::objects::float;
use crate::drive::tests::Rig;
use reference::{Asked, Model, Objects, Sample};

/// A resolution at which quantisation does not show.
const COUNTS: u32 = 4_000_000;
/// The tolerance, as a share of the step.
const TOLERANCE: f64 = 0.02;

/// A motor and its gains.
#[derive(Clone, Copy)]
struct Case {
    name: &'static str,
    plant: PlantParams,
    gains: Option<Objects>,
}

fn ideal(plant: PlantParams) -> PlantParams {
    PlantParams {
        counts_per_turn: COUNTS,
        coulomb_friction: 0.0,
        ..plant
    }
}

/// Three cases: the motor of the default plant, tuned by the drive; a flat motor of 90 mm with gear
/// and gains from EPOS Studio; a small motor with a drive's factory gains.
fn cases() -> [Case; 3] {
    let default = PlantParams::default();
    [
        Case {
            name: "45 mm, as tuned",
            plant: ideal(default),
            gains: None,
        },
        Case {
            name: "90 mm flat, EPOS Studio's gains",
            plant: ideal(PlantParams {
                inertia: 2.99e-4,
                viscous_friction: 4.5e-4,
                torque_constant: 0.107_746,
                resistance: 0.67,
                inductance: 0.537e-3,
                nominal_current: 4.76,
                current_limit: 9.52,
                ..default
            }),
            gains: Some(Objects {
                current: [686_858.0, 835_940.0],
                position: [12_603_244.0, 163_393_222.0, 319_873.0, 4175.0, 2777.0],
                velocity: [321_701.0, 9_285_888.0, 4163.0, 2786.0, 276.0],
                observer: [400.0, 100_000.0, 33.0, 47_124.0, 2_990_000.0],
            }),
        },
        Case {
            name: "small, factory gains",
            plant: ideal(PlantParams {
                inertia: 3e-6,
                viscous_friction: 1e-6,
                torque_constant: 0.0137,
                resistance: 3.3,
                inductance: 1e-3,
                nominal_current: 1.5,
                current_limit: 5.0,
                ..default
            }),
            gains: Some(Objects {
                current: [1_171_880.0, 3_906_250.0],
                position: [1_500_000.0, 780_000.0, 16_000.0, 0.0, 0.0],
                velocity: [20_000.0, 500_000.0, 0.0, 0.0, 600.0],
                observer: [400.0, 100_000.0, 33.0, 10.0, 30_000.0],
            }),
        },
    ]
}

/// 0x3000:02.
fn structure(observed: bool) -> i64 {
    if observed { 0x0001_0121 } else { 0x0001_0111 }
}

/// Returns the control parameters of a new drive with this motor.
fn as_tuned(plant: &PlantParams) -> Objects {
    read_objects(&Rig::new(*plant))
}

fn read_objects(rig: &Rig) -> Objects {
    let read = |index, sub| {
        let value = rig.store.get(rig.slot(index, sub));
        f64::from(u32::try_from(value).unwrap())
    };
    let five = |index| [1, 2, 3, 4, 5].map(|sub| read(index, sub));
    Objects {
        current: [1, 2].map(|sub| read(0x30a0, sub)),
        position: five(0x30a1),
        velocity: five(0x30a2),
        observer: five(0x30a3),
    }
}

impl Case {
    /// Returns a drive with these gains in its objects, enabled and at rest, and the gains.
    fn rig(&self, mode: i64) -> (Rig, Objects) {
        let mut rig = Rig::new(self.plant);
        if let Some(gains) = self.gains {
            for (index, values) in [
                (0x30a0, &gains.current[..]),
                (0x30a1, &gains.position),
                (0x30a2, &gains.velocity),
                (0x30a3, &gains.observer),
            ] {
                for (sub, value) in (1..).zip(values) {
                    #[expect(clippy::cast_possible_truncation)]
                    rig.set(index, sub, *value as i64);
                }
            }
        }
        let gains = read_objects(&rig);
        // No interpolation, so that a step stays a step. No following error supervision.
        rig.set(0x60c2, 1, 0);
        rig.set(0x6065, 0, 0xffff_ffff);
        rig.enable(mode);
        (rig, gains)
    }
}

/// Returns the motor state at t = 0, 0.4 ms, 0.8 ms, … . Set-points written before the call take
/// effect at t = 0.
fn respond(rig: &mut Rig, seconds: f64) -> Vec<Sample> {
    let start = rig.drive.position_counts();
    let mut out = Vec::new();
    rig.drive.sync(&rig.store);
    let mut t = 0.0;
    while t <= seconds {
        rig.drive.control(&mut rig.store, true);
        let counts = rig.drive.position_counts() - start;
        out.push(Sample {
            current: rig.drive.plant.current(),
            speed: rig.drive.plant.velocity(),
            angle: float(counts) / f64::from(COUNTS) * TAU,
        });
        t += CONTROL_STEP;
    }
    out
}

/// Returns the largest deviation as a share of the step. The reference has 0.04 ms between samples.
fn deviation(got: &[Sample], reference: &[Sample], step: f64, of: fn(&Sample) -> f64) -> f64 {
    let mut worst = 0.0_f64;
    let mut largest = 0.0_f64;
    for (n, state) in got.iter().enumerate().skip(1) {
        let Some(ideal) = reference.get(10 * n - 1) else {
            break;
        };
        worst = worst.max((of(state) - of(ideal)).abs());
        largest = largest.max(of(ideal).abs());
    }
    assert!(got.len() > 50 && largest > 0.5 * step, "nothing happened");
    worst / step
}
