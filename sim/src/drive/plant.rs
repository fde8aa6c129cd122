//! The motor and its load: winding, rotor, friction, encoder.

use std::f64::consts::TAU;

use super::mechanics::PitchError;
use super::objects::float;
use super::travel::Track;
use crate::quirks::Quirks;

/// One step of the current loop, in seconds.
pub(super) const CURRENT_STEP: f64 = 40e-6;

/// The torque of a holding brake, as a multiple of the rated torque.
const BRAKE: f64 = 2.0;

/// The largest position in counts. Beyond it, an f64 cannot represent every integer.
const FARTHEST: f64 = 9_007_199_254_740_992.0;

/// A load on an elastic shaft: a second mass, so that the axis has a resonance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ElasticLoad {
    /// The inertia of the load, in kg·m².
    pub inertia: f64,
    /// The frequency with which the load swings while the motor is held, in Hz; at most
    /// [`ElasticLoad::MAX_HZ`].
    pub antiresonance_hz: f64,
    /// The damping ratio of this swing.
    pub damping: f64,
}

impl ElasticLoad {
    /// The step of the current loop resolves no higher frequency.
    pub const MAX_HZ: f64 = 1000.0;

    /// Returns the frequency with which motor and load swing against each other, in Hz.
    #[must_use]
    pub fn resonance_hz(&self, motor_inertia: f64) -> f64 {
        self.antiresonance_hz * (1.0 + self.inertia / motor_inertia).sqrt()
    }
}

/// Motor, load and supply, in SI units. The default is a 70 W brushless motor of 45 mm with a load
/// of about the rotor's inertia.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlantParams {
    /// Encoder counts per motor turn (four per line).
    pub counts_per_turn: u32,
    /// The value of 0x6064 at power-on, in counts.
    pub initial_position: i32,
    /// The inertia of the rotor and of a rigid load, in kg·m².
    pub inertia: f64,
    /// A load on an elastic shaft.
    pub elastic: Option<ElasticLoad>,
    /// The way of the motor between both flanks of the load, in counts.
    pub backlash: f64,
    /// The error between motor and load. The load's position is in 0x60E4:01, if the ESI has it.
    pub pitch_error: PitchError,
    /// Viscous friction, in N·m·s/rad.
    pub viscous_friction: f64,
    /// Coulomb friction, static and sliding, in N·m.
    pub coulomb_friction: f64,
    /// The constant load torque towards negative positions, in N·m.
    pub load_torque: f64,
    /// The torque constant in N·m/A, and the back-EMF constant in V·s/rad.
    pub torque_constant: f64,
    /// The winding resistance, in Ω.
    pub resistance: f64,
    /// The winding inductance, in H.
    pub inductance: f64,
    /// The supply voltage, in V.
    pub supply_voltage: f64,
    /// The nominal current, in A. Nominal current times torque constant is the rated torque.
    pub nominal_current: f64,
    /// The current limit of the output stage, in A.
    pub current_limit: f64,
    /// The thermal time constant of the winding, in s. It bounds the time above the nominal
    /// current.
    pub thermal_time_constant: f64,
    /// The power-on value of 0x6080, in rpm.
    pub max_motor_speed: u32,
    /// The time from Switched on to Operation enabled, in control cycles of 0.4 ms.
    pub enable_cycles: u32,
    /// Switches, index pulses and mechanical ends along the axis.
    pub track: Track,
    /// How the drive differs from the standard.
    pub quirks: Quirks,
}

impl Default for PlantParams {
    fn default() -> Self {
        Self {
            counts_per_turn: 2000,
            initial_position: 0,
            inertia: 3.6e-5,
            elastic: None,
            backlash: 0.0,
            pitch_error: PitchError::default(),
            viscous_friction: 2e-5,
            coulomb_friction: 4e-3,
            load_torque: 0.0,
            torque_constant: 37e-3,
            resistance: 0.6,
            inductance: 0.46e-3,
            supply_voltage: 48.0,
            nominal_current: 3.2,
            current_limit: 9.6,
            thermal_time_constant: 30.0,
            max_motor_speed: 6000,
            enable_cycles: 10,
            track: Track::default(),
            quirks: Quirks::default(),
        }
    }
}

impl PlantParams {
    pub(super) fn counts_per_rad(&self) -> f64 {
        f64::from(self.counts_per_turn.max(1)) / TAU
    }

    /// Returns the rated torque, in N·m.
    pub(super) fn rated_torque(&self) -> f64 {
        self.torque_constant * self.nominal_current
    }
}

/// The state of an elastic load.
#[derive(Debug, Clone, Copy)]
struct Elastic {
    /// Stiffness of the shaft in N·m/rad, and its damping in N·m·s/rad.
    stiffness: f64,
    damping: f64,
    /// The change of the load's speed per N·m in a current-loop step.
    velocity_per_torque: f64,
    /// The twist of the shaft in rad, and the speed of the load in rad/s.
    twist: f64,
    velocity: f64,
}

impl Elastic {
    fn new(load: &ElasticLoad) -> Self {
        let omega = TAU * load.antiresonance_hz.clamp(0.1, ElasticLoad::MAX_HZ);
        let inertia = load.inertia.max(1e-9);
        Self {
            stiffness: omega * omega * inertia,
            damping: 2.0 * load.damping.clamp(0.0, 1.0) * omega * inertia,
            velocity_per_torque: CURRENT_STEP / inertia,
            twist: 0.0,
            velocity: 0.0,
        }
    }

    /// Advances the load by one current-loop step. Returns the torque of the shaft on the motor.
    fn turn(&mut self, motor: f64) -> f64 {
        self.twist += (motor - self.velocity) * CURRENT_STEP;
        let torque = self.stiffness * self.twist + self.damping * (motor - self.velocity);
        self.velocity += torque * self.velocity_per_torque;
        torque
    }
}

#[derive(Debug, Clone)]
pub(super) struct Plant {
    /// The encoder position in counts, with fraction.
    pub(super) position: f64,
    /// The shaft speed, in rad/s.
    pub(super) velocity: f64,
    /// The winding current, in A.
    pub(super) current: f64,
    pub(super) load_torque: f64,
    pub(super) blocked: bool,
    /// The mechanical ends, in counts.
    pub(super) ends: (f64, f64),
    pub(super) coulomb: f64,
    /// Friction without the brake, and the torque of the brake.
    open_coulomb: f64,
    brake_torque: f64,
    pub(super) torque_constant: f64,
    counts_per_rad: f64,
    elastic: Option<Elastic>,
    // Per current-loop step: decay factors of current and speed, and the gains per volt and per
    // N·m.
    pub(super) current_decay: f64,
    pub(super) current_per_volt: f64,
    pub(super) velocity_decay: f64,
    pub(super) velocity_per_torque: f64,
    pub(super) counts_per_velocity: f64,
}

/// Solves `x' = (u − drag·x) / storage` over one current-loop step with constant `u`. Returns the
/// decay factor of x and the gain per unit of u.
fn first_order(storage: f64, drag: f64) -> (f64, f64) {
    let x = CURRENT_STEP * drag / storage;
    let gain = if x > 0.0 { -(-x).exp_m1() / x } else { 1.0 };
    ((-x).exp(), gain * CURRENT_STEP / storage)
}

impl Plant {
    pub(super) fn new(p: &PlantParams) -> Self {
        let (current_decay, current_per_volt) =
            first_order(p.inductance.max(1e-6), p.resistance.max(0.0));
        let (velocity_decay, velocity_per_torque) =
            first_order(p.inertia.max(1e-9), p.viscous_friction.max(0.0));
        Self {
            // The middle of a count: a standing axis must not stand on an edge.
            position: f64::from(p.initial_position) + 0.5,
            velocity: 0.0,
            current: 0.0,
            load_torque: p.load_torque + p.quirks.load_torque,
            blocked: false,
            ends: p
                .track
                .ends
                .filter(|(low, high)| low <= high)
                .map_or((-FARTHEST, FARTHEST), |(low, high)| {
                    (f64::from(low) + 0.5, f64::from(high) + 0.5)
                }),
            coulomb: p.coulomb_friction,
            open_coulomb: p.coulomb_friction,
            brake_torque: BRAKE * p.rated_torque(),
            torque_constant: p.torque_constant,
            counts_per_rad: p.counts_per_rad(),
            elastic: p.elastic.as_ref().map(Elastic::new),
            current_decay,
            current_per_volt,
            velocity_decay,
            velocity_per_torque,
            counts_per_velocity: CURRENT_STEP * p.counts_per_rad(),
        }
    }

    /// Returns the encoder count, starting at the initial position.
    pub(super) fn counts(&self) -> i64 {
        // Rounds down without `floor`, which is a library call on some processors.
        #[expect(
            clippy::cast_possible_truncation,
            reason = "saturates far beyond any axis"
        )]
        let counts = self.position as i64;
        counts - i64::from(self.position < float(counts))
    }

    /// Returns the position in counts, with fraction.
    pub(super) fn position(&self) -> f64 {
        self.position
    }

    /// Returns the last encoder edge: its position in counts and its age in seconds. The age
    /// follows from the present speed and is at most `within`.
    pub(super) fn edge(&self, within: f64) -> (f64, f64) {
        let speed = self.velocity * self.counts_per_rad;
        let below = float(self.counts());
        let edge = if speed < 0.0 && self.position > below {
            below + 1.0
        } else {
            below
        };
        let (way, speed) = ((self.position - edge).abs(), speed.abs());
        let age = if way < speed * within {
            way / speed
        } else {
            within
        };
        (edge, age)
    }

    pub(super) fn velocity(&self) -> f64 {
        self.velocity
    }

    pub(super) fn current(&self) -> f64 {
        self.current
    }

    pub(super) fn set_load_torque(&mut self, torque: f64) {
        self.load_torque = torque;
    }

    /// Closes or opens the brake: friction that holds the shaft.
    pub(super) fn set_brake(&mut self, closed: bool) {
        let brake = if closed { self.brake_torque } else { 0.0 };
        self.coulomb = self.open_coulomb + brake;
    }

    /// True if the load turns a shaft that stands without current.
    pub(super) fn falls(&self) -> bool {
        !self.blocked && self.load_torque.abs() > self.coulomb
    }

    /// Converts positions to another number of counts per turn. The shaft keeps its angle and
    /// speed.
    pub(super) fn take_shaft(&mut self, before: &Self) {
        let ratio = self.counts_per_rad / before.counts_per_rad;
        self.position = (before.position * ratio).clamp(self.ends.0, self.ends.1);
        self.velocity = before.velocity;
        self.load_torque = before.load_torque;
        self.blocked = before.blocked;
        self.coulomb = before.coulomb;
        self.elastic = before.elastic;
    }

    pub(super) fn set_blocked(&mut self, blocked: bool) {
        self.blocked = blocked;
    }

    /// True if a batch of drives can calculate the motor: it turns, with a rigid load.
    pub(super) fn is_simple(&self) -> bool {
        !self.blocked && self.elastic.is_none()
    }

    /// True if the shaft stands and stays at rest without current.
    pub(super) fn at_rest(&self) -> bool {
        // A load swings on.
        let rigid = self.elastic.is_none() || self.blocked;
        rigid && self.velocity == 0.0 && (self.blocked || self.load_torque.abs() <= self.coulomb)
    }

    /// Runs one current-loop step at this voltage.
    #[inline]
    pub(super) fn drive(&mut self, voltage: f64) {
        let before = self.current;
        let back_emf = self.torque_constant * self.velocity;
        self.current = before * self.current_decay + (voltage - back_emf) * self.current_per_volt;
        self.turn(0.5 * (before + self.current));
    }

    /// Runs one current-loop step with the winding open.
    #[inline]
    pub(super) fn coast(&mut self) {
        self.current = 0.0;
        self.turn(0.0);
    }

    pub(super) fn flush(&mut self) {
        super::control::flush(&mut self.current);
    }

    #[inline]
    fn turn(&mut self, current: f64) {
        if self.blocked {
            self.velocity = 0.0;
            return;
        }
        let mut torque = self.torque_constant * current - self.load_torque;
        if let Some(load) = &mut self.elastic {
            torque -= load.turn(self.velocity);
        }
        let before = self.velocity;
        let free = before * self.velocity_decay + torque * self.velocity_per_torque;
        // Friction reduces the speed to zero; it never drives the shaft.
        let friction = self.coulomb * self.velocity_per_torque;
        self.velocity = (free.abs() - friction).max(0.0).copysign(free);
        self.position += 0.5 * (before + self.velocity) * self.counts_per_velocity;
        if self.position < self.ends.0 || self.position > self.ends.1 {
            self.position = self.position.clamp(self.ends.0, self.ends.1);
            self.velocity = 0.0;
        }
    }
}
