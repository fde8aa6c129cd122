//! Feedback of the drive, in user units.

use super::Inputs;
use crate::scale::Scale;
use crate::units::{Counts, PerMille, RawVelocity};

/// Filter time constant of velocities and accelerations derived from differences.
pub(super) const FILTER_S: f64 = 0.01;

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Actual {
    counts: Option<Counts>,
    position: f64,
    velocity: f64,
    acceleration: f64,
    torque: f64,
    /// Time since the last reading, in seconds.
    elapsed_s: f64,
    measured_velocity: bool,
    wants_acceleration: bool,
}

impl Actual {
    pub(super) fn new(wants_acceleration: bool) -> Self {
        Self {
            wants_acceleration,
            ..Self::default()
        }
    }

    /// Reads the inputs. A position difference faster than `fastest` is a shift of the origin and
    /// is not used as velocity.
    pub(super) fn read(&mut self, inputs: &Inputs, scale: &Scale, fastest: f64) {
        let before = *self;
        if let Some(raw) = inputs.position {
            let counts = self
                .counts
                .map_or(Counts(i64::from(raw)), |c| c.unwrap_next(raw));
            self.counts = Some(counts);
            self.position = scale.position_to_user(counts).0;
        }
        if let Some(raw) = inputs.velocity {
            self.velocity = scale.velocity_to_user(RawVelocity(raw)).0;
        } else if before.counts.is_some() && self.elapsed_s > 0.0 {
            let velocity = (self.position - before.position) / self.elapsed_s;
            if velocity.abs() <= fastest {
                self.velocity += (velocity - self.velocity) * self.weight();
            }
        }
        if self.wants_acceleration && self.elapsed_s > 0.0 {
            let acceleration = (self.velocity - before.velocity) / self.elapsed_s;
            self.acceleration += (acceleration - self.acceleration) * self.weight();
        }
        if let Some(raw) = inputs.torque {
            self.torque = scale.torque_to_user(PerMille(raw)).0;
        }
        self.measured_velocity = inputs.velocity.is_some();
        self.elapsed_s = 0.0;
    }

    /// Returns the weight of a new reading in a filtered value.
    fn weight(&self) -> f64 {
        self.elapsed_s / (self.elapsed_s + FILTER_S)
    }

    /// Takes the reported position as it is, after the drive has shifted its origin.
    pub(super) fn start_over(&mut self, scale: &Scale) {
        if let Some(counts) = self.counts {
            let counts = Counts(i64::from(counts.wrapped()));
            self.counts = Some(counts);
            self.position = scale.position_to_user(counts).0;
        }
    }

    pub(super) fn pass(&mut self, dt_s: f64) {
        self.elapsed_s = (self.elapsed_s + dt_s).min(1.0);
    }

    pub(super) const fn counts(&self) -> Option<Counts> {
        self.counts
    }

    pub(super) const fn position(&self) -> f64 {
        self.position
    }

    pub(super) const fn velocity(&self) -> f64 {
        self.velocity
    }

    /// Returns the acceleration, filtered over 10 ms.
    pub(super) const fn acceleration(&self) -> f64 {
        self.acceleration
    }

    pub(super) const fn torque(&self) -> f64 {
        self.torque
    }

    /// Returns true if the drive reports the velocity, false if it is derived from positions.
    pub(super) const fn velocity_is_measured(&self) -> bool {
        self.measured_velocity
    }
}
