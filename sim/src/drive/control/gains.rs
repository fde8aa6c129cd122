//! The gains of the loops, in SI units, and the tuning of a motor at commissioning.

use std::f64::consts::TAU;

use crate::drive::plant::PlantParams;

/// The parameters of the control loops. Currents in A, angles of the motor shaft in rad.
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

/// Gains in A per rad, A per rad·s and A per rad/s; feed-forwards in A per rad/s and rad/s².
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::drive) struct PositionGains {
    pub p: f64,
    pub i: f64,
    pub d: f64,
    pub feed: FeedGains,
}

/// Gains in A per rad/s and A per rad.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::drive) struct VelocityGains {
    pub p: f64,
    pub i: f64,
    pub feed: FeedGains,
    /// The cut-off frequency of the low-pass filter behind the encoder, in Hz.
    pub cut_off: f64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::drive) struct FeedGains {
    pub velocity: f64,
    pub acceleration: f64,
}

/// Corrections per control cycle and rad of position error, and the motor model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::drive) struct ObserverGains {
    /// Position correction, in rad.
    pub position: f64,
    /// Velocity correction, in rad/s.
    pub velocity: f64,
    /// Load torque correction, in N·m.
    pub load: f64,
    /// Viscous friction, in N·m·s/rad.
    pub friction: f64,
    /// Inertia, in kg·m².
    pub inertia: f64,
}

/// The range of the position loop's bandwidth, in rad/s. The inner loops limit the upper end; a
/// slower machine is of no use.
const POSITION_BANDWIDTH: (f64, f64) = (60.0, 100.0);
/// The largest reaction of the position loop to one encoder count, as a share of the nominal
/// current.
const KICK: f64 = 0.2;
/// Bandwidths of the other loops and filters, as multiples of the position loop's.
const VELOCITY: f64 = 1.5;
const OBSERVER: f64 = 4.5;
const FILTER: f64 = 45.0;
const CURRENT: f64 = 33.0;
/// The largest bandwidth of the current loop, in rad/s. Beyond it, sampling affects the response.
const MAX_CURRENT_BANDWIDTH: f64 = 2000.0;

impl Gains {
    /// Returns the gains of auto-tuning: a triple pole for the position loop, a double pole for the
    /// velocity loop, a single pole for the current loop.
    pub(in crate::drive) fn tuned(plant: &PlantParams) -> Self {
        let inertia = plant.inertia.max(1e-9);
        let torque_constant = plant.torque_constant.max(1e-9);
        let per_torque = 1.0 / torque_constant;
        // The D part is limited to ten times the P part and reacts to a count as to a step: 30·J·w²
        // per rad.
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
    /// Returns corrections with which every error decays like e^(−bandwidth·t).
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
