//! `motor` of `[device.sim]`: inertia and friction of a simulated axis, a load on an elastic shaft,
//! and the errors of its mechanics.

use ecaxis_axis::Scale;
use ecaxis_axis::units::UserUnits;
use ecaxis_sim::{ElasticLoad, PitchError, PlantParams};
use toml::Spanned;

use super::AxisSetup;
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
        /// Way of the motor between both flanks of the load (from 0, unit; default 0)
        backlash: Key<f64>,
        /// Load minus motor at up to 16 positions of the load, as at power-on (list of [position, error],
        /// unit; default none)
        pitch_error: Key<Vec<Vec<f64>>>,
    }
}

/// The mechanics of a simulated axis; `None`: as in [`PlantParams::default`].
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct MotorSetup {
    pub inertia: Option<f64>,
    pub viscous_friction: Option<f64>,
    pub coulomb_friction: Option<f64>,
    pub elastic: Option<ElasticLoad>,
    /// In counts.
    pub backlash: f64,
    pub pitch_error: PitchError,
}

impl MotorSetup {
    /// Changes the given values of a plant.
    pub fn apply(&self, plant: &mut PlantParams) {
        plant.inertia = self.inertia.unwrap_or(plant.inertia);
        plant.viscous_friction = self.viscous_friction.unwrap_or(plant.viscous_friction);
        plant.coulomb_friction = self.coulomb_friction.unwrap_or(plant.coulomb_friction);
        plant.elastic = self.elastic;
        plant.backlash = self.backlash;
        plant.pitch_error = self.pitch_error;
    }
}

/// The highest frequency of two masses that the steps of the simulated current loop resolve.
const MAX_RESONANCE_HZ: f64 = 2000.0;

const INERTIA: [f64; 2] = [1e-9, 10.0];

/// Checks the settings of a device; for `axis` see [`super::travel::check`].
pub(crate) fn check(
    raw: &RawMotor,
    axis: Result<Option<&AxisSetup>, ()>,
    p: &mut Problems<'_>,
) -> MotorSetup {
    if axis.is_err() {
        let hint = "only drives with a [device.axis] have one";
        p.add_hint(raw.span.clone(), "a motor without an axis", hint);
    }
    let motor = MotorSetup {
        inertia: within(raw.inertia.as_ref(), INERTIA, p),
        viscous_friction: within(raw.viscous_friction.as_ref(), [0.0, 100.0], p),
        coulomb_friction: within(raw.coulomb_friction.as_ref(), [0.0, 1000.0], p),
        elastic: None,
        ..MotorSetup::default()
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
    let scale = axis.ok().flatten().map(|axis| &axis.config.scale);
    MotorSetup {
        elastic,
        backlash: scale.map_or(0.0, |scale| backlash(raw, scale, p)),
        pitch_error: scale.map_or_else(PitchError::default, |scale| pitch_error(raw, scale, p)),
        ..motor
    }
}

/// Returns the backlash in counts.
fn backlash(raw: &RawMotor, scale: &Scale, p: &mut Problems<'_>) -> f64 {
    let Some(backlash) = &raw.backlash else {
        return 0.0;
    };
    if *backlash.get_ref() < 0.0 {
        let message = format!("a backlash of {} is not possible", backlash.get_ref());
        p.add_hint(backlash.span(), message, "write a way from 0 on");
        return 0.0;
    }
    backlash.get_ref() * scale.counts_per_unit()
}

/// Returns the pitch error in counts.
fn pitch_error(raw: &RawMotor, scale: &Scale, p: &mut Problems<'_>) -> PitchError {
    let Some(rows) = &raw.pitch_error else {
        return PitchError::default();
    };
    let sign = if scale.inverted() { -1.0 } else { 1.0 };
    let counts = |row: &Vec<f64>| match **row {
        [position, error] => Some([
            scale.position_to_counts(UserUnits(position)).0 as f64,
            error * scale.counts_per_unit() * sign,
        ]),
        _ => None,
    };
    let points: Option<Vec<_>> = rows.get_ref().iter().map(counts).collect();
    let points = points.map(|mut points| {
        if scale.inverted() {
            points.reverse();
        }
        points
    });
    let ascends = |points: &Vec<[f64; 2]>| points.windows(2).all(|w| w[0][0] < w[1][0]);
    // The simulated load is where the errors of its position put it.
    let flat = |points: &Vec<[f64; 2]>| {
        let slope = |w: &[[f64; 2]]| ((w[1][1] - w[0][1]) / (w[1][0] - w[0][0])).abs() <= 0.1;
        points.windows(2).all(slope)
    };
    let made = points.filter(|points| ascends(points) && flat(points));
    let made = made.and_then(|points| PitchError::new(&points));
    made.unwrap_or_else(|| {
        let message = format!(
            "a simulated pitch error has up to {} pairs of position and error, by ascending positions, and changes by at most 10 % of the way",
            PitchError::MAX_POINTS
        );
        p.add_hint(rows.span(), message, "write `pitch_error = [[0.0, 0.0], [100.0, 0.02]]`");
        PitchError::default()
    })
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
