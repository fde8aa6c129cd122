//! Feedback of the drive, in user units.

use super::Inputs;
use crate::compensation::Compensation;
use crate::scale::Scale;
use crate::units::{Counts, PerMille, RawVelocity};

/// Filter time constant of velocities and accelerations derived from differences.
pub(super) const FILTER_S: f64 = 0.01;

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Actual {
    counts: Option<Counts>,
    /// The position of the drive, and of the load.
    drive: f64,
    position: f64,
    /// Drive position minus that of the screw, and the drive's way per way of the load.
    play: f64,
    ratio: f64,
    velocity: f64,
    /// The velocity of the reported positions, and the reported velocity with the same filter.
    derived: f64,
    filtered: f64,
    /// The last change of the drive's position, and the time that it took in seconds.
    step: f64,
    step_s: f64,
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
            ratio: 1.0,
            ..Self::default()
        }
    }

    /// Reads the inputs. A position difference faster than `fastest` is a shift of the origin and
    /// is not used as velocity.
    pub(super) fn read(
        &mut self,
        inputs: &Inputs,
        scale: &Scale,
        compensation: &Compensation,
        fastest: f64,
    ) {
        let before = *self;
        self.step = 0.0;
        self.step_s = self.elapsed_s;
        let weight = self.weight();
        if let Some(raw) = inputs.position {
            let counts = self
                .counts
                .map_or(Counts(i64::from(raw)), |c| c.unwrap_next(raw));
            self.counts = Some(counts);
            self.drive = scale.position_to_user(counts).0;
            if before.counts.is_some() {
                self.step = self.drive - before.drive;
                self.move_load(before.drive - before.play, compensation);
            } else {
                self.place_load(compensation);
            }
        }
        if before.counts.is_some() && self.elapsed_s > 0.0 {
            let velocity = self.step / (self.elapsed_s * self.ratio);
            if velocity.abs() <= fastest {
                self.derived += (velocity - self.derived) * weight;
            }
        }
        if let Some(raw) = inputs.velocity {
            self.velocity = scale.velocity_to_user(RawVelocity(raw)).0 / self.ratio;
            self.filtered += (self.velocity - self.filtered) * weight;
        } else {
            self.velocity = self.derived;
        }
        if self.wants_acceleration && self.elapsed_s > 0.0 {
            let acceleration = (self.velocity - before.velocity) / self.elapsed_s;
            self.acceleration += (acceleration - self.acceleration) * weight;
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

    /// Returns the drive's position with an origin that the drive has just set: that of its 32 bits,
    /// without the turns counted before.
    pub(super) fn restarted(&self, scale: &Scale) -> Option<f64> {
        let counts = self.counts?;
        Some(
            scale
                .position_to_user(Counts(i64::from(counts.wrapped())))
                .0,
        )
    }

    /// Returns the last change of the drive's position, and its time in seconds.
    pub(super) const fn step(&self) -> (f64, f64) {
        (self.step, self.step_s)
    }

    /// Returns the velocity of the reported positions, filtered over 10 ms.
    pub(super) const fn derived_velocity(&self) -> f64 {
        self.derived
    }

    /// Returns the reported velocity with the same filter.
    pub(super) const fn filtered_velocity(&self) -> f64 {
        self.filtered
    }

    /// Takes the reported position as it is, after the drive has shifted its origin. `keeps_wraps`:
    /// the drive has not; it may have wrapped before.
    pub(super) fn start_over(
        &mut self,
        scale: &Scale,
        compensation: &Compensation,
        keeps_wraps: bool,
    ) {
        if let Some(counts) = self.counts {
            let counts = match keeps_wraps {
                true => counts,
                false => Counts(i64::from(counts.wrapped())),
            };
            self.counts = Some(counts);
            self.drive = scale.position_to_user(counts).0;
            self.place_load(compensation);
        }
    }

    /// Moves the load with the drive, whose screw was at `before`: the load stands until the drive
    /// has passed the play.
    fn move_load(&mut self, before: f64, compensation: &Compensation) {
        let [low, high] = compensation.range_of_play();
        self.play = (self.drive - before).max(low).min(high);
        self.place_load(compensation);
    }

    /// Places the load at the present play.
    fn place_load(&mut self, compensation: &Compensation) {
        self.position = self.load_at(self.drive, compensation);
        if compensation.is_active() {
            self.ratio = compensation.ratio(self.position);
        }
    }

    /// Returns the load's position for a position of the drive near the present one.
    pub(super) fn load_at(&self, drive: f64, compensation: &Compensation) -> f64 {
        if compensation.is_active() {
            compensation.load(drive - self.play)
        } else {
            drive
        }
    }

    /// Sets the load on its reference flank.
    pub(super) fn reference(&mut self) {
        self.play = 0.0;
    }

    pub(super) fn pass(&mut self, dt_s: f64) {
        self.elapsed_s = (self.elapsed_s + dt_s).min(1.0);
    }

    pub(super) const fn counts(&self) -> Option<Counts> {
        self.counts
    }

    /// Returns the velocity of the load: 0 while the drive passes the play.
    pub(super) fn load_velocity(&self, compensation: &Compensation) -> f64 {
        let [low, high] = compensation.range_of_play();
        let passes = self.play > low && self.play < high;
        if passes { 0.0 } else { self.velocity }
    }

    /// Returns the position of the load.
    pub(super) const fn position(&self) -> f64 {
        self.position
    }

    /// Returns the position of the drive.
    pub(super) const fn drive(&self) -> f64 {
        self.drive
    }

    /// Returns the velocity of the drive.
    pub(super) fn drive_velocity(&self) -> f64 {
        self.velocity * self.ratio
    }

    pub(super) const fn play(&self) -> f64 {
        self.play
    }

    /// Returns the velocity of the drive as that of its load without play.
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
