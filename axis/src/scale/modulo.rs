//! Modulo axes: turntables, conveyors, spindles.
//!
//! Positions are not reduced. The modulo defines which positions are equivalent, and a
//! [`ModuloDirection`] selects one of them.

use super::{Scale, ScaleError};
use crate::units::UserUnits;

/// The direction to a target on a modulo axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ModuloDirection {
    /// To the nearest equivalent position; forwards if two are equally near.
    #[default]
    Shortest,
    /// Forwards, less than one modulo length.
    Positive,
    /// Backwards, less than one modulo length.
    Negative,
    /// To the given position, across any number of turns.
    AsGiven,
}

impl Scale {
    /// Sets the modulo: positions that differ by `length` user units are equivalent.
    pub fn with_modulo(mut self, length: f64) -> Result<Self, ScaleError> {
        let counts = length * self.counts_per_unit();
        if !(2.0..=2f64.powi(31)).contains(&counts) {
            return Err(ScaleError::Modulo { value: length });
        }
        self.modulo = Some(length);
        Ok(self)
    }

    /// Returns the modulo length in user units. `None`: not a modulo axis.
    #[must_use]
    pub const fn modulo(&self) -> Option<f64> {
        self.modulo
    }

    /// Returns the position reduced to 0 ≤ position < modulo. On other axes this is the position
    /// itself.
    #[must_use]
    pub fn place(&self, position: UserUnits) -> UserUnits {
        let Some(length) = self.modulo else {
            return position;
        };
        let place = position.0.rem_euclid(length);
        // A value slightly below zero rounds up to the length itself.
        UserUnits(if place < length { place } else { 0.0 })
    }

    /// Returns the absolute target of an axis at `from` that moves to `to`.
    ///
    /// If the target is less than half a count away, the axis does not move a full turn.
    #[must_use]
    pub fn destination(&self, from: UserUnits, to: UserUnits, way: ModuloDirection) -> UserUnits {
        let Some(length) = self.modulo else {
            return to;
        };
        let half_a_count = 0.5 / self.counts_per_unit();
        let forwards = (self.place(to).0 - self.place(from).0).rem_euclid(length);
        let standing = forwards < half_a_count || length - forwards < half_a_count;
        let by = match way {
            ModuloDirection::AsGiven => return to,
            _ if standing && forwards > length / 2.0 => forwards - length,
            _ if standing => forwards,
            ModuloDirection::Positive => forwards,
            ModuloDirection::Negative => forwards - length,
            ModuloDirection::Shortest if forwards <= length / 2.0 => forwards,
            ModuloDirection::Shortest => forwards - length,
        };
        // Whole turns plus the reduced position: rounding errors do not accumulate over turns.
        let turns = ((from.0 + by - self.place(to).0) / length).round();
        UserUnits(turns.mul_add(length, self.place(to).0))
    }
}
