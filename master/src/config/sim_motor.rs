//! `motor` of `[device.sim]`: inertia and friction of a simulated axis, and a load on an elastic
//! shaft.

use ecaxis_sim::{ElasticLoad, PlantParams};
use toml::Spanned;

use super::fields::{Field, Key, KeyExt, Read, Table, TableKey, Value, Written};
use super::problem::{Problems, Span};
use super::schema::{self, Schema};

table! { "`motor`",
    table RawMotor {
        /// Inertia of the rotor and of a rigid load (kg·m², 1e-9 to 10; default `3.6e-5`)
        inertia: Key<f64>,
        /// Viscous friction (N·m·s/rad, 0 to 100; default `2e-5`)
        viscous_friction: Key<f64>,
        /// Friction at any speed, and at rest (N·m, 0 to 1000; default `4e-3`)
        coulomb_friction: Key<f64>,
        /// Inertia of a load on an elastic shaft (kg·m², 1e-9 to 10; default none)
        load_inertia: Key<f64>,
        /// Frequency of the load on its shaft with the motor held (Hz, 1 to 1000; required with
        /// `load_inertia`)
        antiresonance: Key<f64>,
        /// Damping ratio of the load on its shaft (0 to 1; default 0.02)
        damping: Key<f64>,
    }
}

/// The mechanics of a simulated axis; `None`: as in [`PlantParams::default`].
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct MotorSetup {
    pub inertia: Option<f64>,
    pub viscous_friction: Option<f64>,
    pub coulomb_friction: Option<f64>,
    pub elastic: Option<ElasticLoad>,
}

impl MotorSetup {
    /// Changes the given values of a plant.
    pub fn apply(&self, plant: &mut PlantParams) {
        plant.inertia = self.inertia.unwrap_or(plant.inertia);
        plant.viscous_friction = self.viscous_friction.unwrap_or(plant.viscous_friction);
        plant.coulomb_friction = self.coulomb_friction.unwrap_or(plant.coulomb_friction);
        plant.elastic = self.elastic;
    }
}

/// The highest frequency of two masses that the steps of the simulated current loop resolve.
const MAX_RESONANCE_HZ: f64 = 2000.0;

const INERTIA: [f64; 2] = [1e-9, 10.0];

/// Checks the settings of a device, which has an axis or not.
pub(crate) fn check(raw: &RawMotor, has_axis: bool, p: &mut Problems<'_>) -> MotorSetup {
    if !has_axis {
        let hint = "only drives with a [device.axis] have one";
        p.add_hint(raw.span.clone(), "a motor without an axis", hint);
    }
    let motor = MotorSetup {
        inertia: within(raw.inertia.as_ref(), INERTIA, p),
        viscous_friction: within(raw.viscous_friction.as_ref(), [0.0, 100.0], p),
        coulomb_friction: within(raw.coulomb_friction.as_ref(), [0.0, 1000.0], p),
        elastic: None,
    };
    let inertia = within(raw.load_inertia.as_ref(), INERTIA, p);
    let frequency = within(raw.antiresonance.as_ref(), [1.0, ElasticLoad::MAX_HZ], p);
    let damping = within(raw.damping.as_ref(), [0.0, 1.0], p);
    match (&raw.load_inertia, &raw.antiresonance) {
        (None, None) if raw.damping.is_none() => {}
        (Some(_), Some(_)) => {}
        _ => {
            let hint = "write `load_inertia = 2e-5, antiresonance = 40.0`";
            let at = raw.load_inertia.place().or(raw.antiresonance.place());
            let at = at.or(raw.damping.place()).unwrap_or_default();
            let message = "a load on an elastic shaft has an inertia and a frequency";
            p.add_hint(at, message, hint);
        }
    }
    let elastic = inertia
        .zip(frequency)
        .map(|(inertia, antiresonance_hz)| ElasticLoad {
            inertia,
            antiresonance_hz,
            damping: damping.unwrap_or(0.02),
        });
    if let (Some(load), Some(at)) = (elastic, &raw.antiresonance) {
        let inertia = motor.inertia.unwrap_or(PlantParams::default().inertia);
        let resonance = load.resonance_hz(inertia);
        let damping = load.damping * resonance / load.antiresonance_hz;
        if resonance > MAX_RESONANCE_HZ || damping > 1.0 {
            let message = format!(
                "motor and load swing with {resonance:.0} Hz, damped by {damping:.2}: the simulation has up to {MAX_RESONANCE_HZ} Hz and 1"
            );
            let hint = "write a smaller `load_inertia`, `antiresonance` or `damping`";
            p.add_hint(at.span(), message, hint);
        }
    }
    MotorSetup { elastic, ..motor }
}

fn within(
    value: Option<&Spanned<f64>>,
    [low, high]: [f64; 2],
    p: &mut Problems<'_>,
) -> Option<f64> {
    let value = value?;
    let number = *value.get_ref();
    if (low..=high).contains(&number) {
        return Some(number);
    }
    let message = format!("{number} is not between {low} and {high}");
    p.add_hint(value.span(), message, "values are in SI units");
    None
}
