//! What the loops are tuned to, in SI units, and how commissioning tunes a motor.

use std::f64::consts::TAU;

use crate::drive::plant::PlantParams;

/// Everything the control loops are told. Currents in A, angles of the motor shaft in rad.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::drive) struct Gains {
    pub current: CurrentGains,
    pub position: PositionGains,
    pub velocity: VelocityGains,
    pub observer: ObserverGains,
}

/// V/A and V/(A·s).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::drive) struct CurrentGains {
    pub p: f64,
    pub i: f64,
}

/// A per rad, rad·s, rad/s; feed-forwards in A per rad/s and rad/s².
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::drive) struct PositionGains {
    pub p: f64,
    pub i: f64,
    pub d: f64,
    pub feed: FeedGains,
}

/// A per rad/s and rad.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::drive) struct VelocityGains {
    pub p: f64,
    pub i: f64,
    pub feed: FeedGains,
    /// Cut-off of the low-pass filter behind the encoder, Hz.
    pub cut_off: f64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::drive) struct FeedGains {
    pub velocity: f64,
    pub acceleration: f64,
}

/// Corrections per control cycle and rad of position error, and the model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::drive) struct ObserverGains {
    /// rad.
    pub position: f64,
    /// rad/s.
    pub velocity: f64,
    /// N·m.
    pub load: f64,
    /// N·m·s/rad.
    pub friction: f64,
    /// kg·m².
    pub inertia: f64,
}

/// Bandwidth of the position loop, rad/s: no more than the loops inside can follow, no less than a
/// machine is of use with.
const POSITION_BANDWIDTH: (f64, f64) = (60.0, 100.0);
/// Share of the nominal current that one encoder count may kick the position loop by.
const KICK: f64 = 0.2;
/// Of the other loops and filters, as multiples of the position loop's.
const VELOCITY: f64 = 1.5;
const OBSERVER: f64 = 4.5;
const FILTER: f64 = 45.0;
const CURRENT: f64 = 33.0;
/// rad/s. Beyond this the current loop's sampling would show.
const MAX_CURRENT_BANDWIDTH: f64 = 2000.0;

impl Gains {
    /// As auto-tuning finds them: a triple pole for the position loop, a double one for the velocity
    /// loop, a single one for the current loop.
    pub(in crate::drive) fn tuned(plant: &PlantParams) -> Self {
        let inertia = plant.inertia.max(1e-9);
        let torque_constant = plant.torque_constant.max(1e-9);
        let per_torque = 1.0 / torque_constant;
        // The D part, limited to ten times the P part, meets a count like a step: 30·J·w² a rad.
        let count = 1.0 / plant.counts_per_rad();
        let quiet = (KICK * plant.rated_torque() / (30.0 * inertia * count)).sqrt();
        let w = quiet.clamp(POSITION_BANDWIDTH.0, POSITION_BANDWIDTH.1);
        let feed = FeedGains {
            velocity: plant.viscous_friction * per_torque,
            acceleration: inertia * per_torque,
        };
        let velocity = VELOCITY * w;
        let current = (CURRENT * w).min(MAX_CURRENT_BANDWIDTH);
        Self {
            current: CurrentGains {
                p: plant.inductance.max(1e-6) * current,
                i: plant.resistance * current,
            },
            position: PositionGains {
                p: 3.0 * inertia * w * w * per_torque,
                i: inertia * w * w * w * per_torque,
                d: 3.0 * inertia * w * per_torque,
                feed,
            },
            velocity: VelocityGains {
                p: 2.0 * inertia * velocity * per_torque,
                i: inertia * velocity * velocity * per_torque,
                feed,
                cut_off: FILTER * w / TAU,
            },
            observer: ObserverGains::triple_pole(OBSERVER * w, inertia, plant.viscous_friction),
        }
    }
}

impl ObserverGains {
    /// Corrections that let every error die like e^(−bandwidth·t).
    fn triple_pole(bandwidth: f64, inertia: f64, friction: f64) -> Self {
        let step = crate::drive::CONTROL_STEP;
        let pole = (-bandwidth * step).exp();
        Self {
            position: 1.0 - pole.powi(3),
            velocity: 1.5 * (1.0 - pole * pole) * (1.0 - pole) / step,
            load: inertia * (1.0 - pole).powi(3) / (step * step),
            friction,
            inertia,
        }
    }
}
