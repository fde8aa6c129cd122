//! Axes that come round: turntables, conveyors, spindles.
//!
//! Positions go on counting; a modulo only says which of them are the same place, and which way leads there.

use super::{Scale, ScaleError};
use crate::units::UserUnits;

/// Which way to a place on a modulo axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Way {
    /// To the nearest such position; of two equally near ones, forwards.
    #[default]
    Shortest,
    /// Forwards, less than one turn.
    Positive,
    /// Backwards, less than one turn.
    Negative,
    /// The position itself, however many turns away.
    AsGiven,
}

impl Scale {
    /// Positions that differ by `length` user units are the same place.
    pub fn with_modulo(mut self, length: f64) -> Result<Self, ScaleError> {
        let counts = length * self.counts_per_unit();
        if !(2.0..=2f64.powi(31)).contains(&counts) {
            return Err(ScaleError::Modulo { value: length });
        }
        self.modulo = Some(length);
        Ok(self)
    }

    /// User units that come round to the same place. `None`: not a modulo axis.
    #[must_use]
    pub const fn modulo(&self) -> Option<f64> {
        self.modulo
    }

    /// The place, from 0 to below the modulo; on other axes the position itself.
    #[must_use]
    pub fn place(&self, position: UserUnits) -> UserUnits {
        let Some(length) = self.modulo else {
            return position;
        };
        let place = position.0.rem_euclid(length);
        // A hair below zero is rounded up to the length itself.
        UserUnits(if place < length { place } else { 0.0 })
    }

    /// The position for which an axis at `from` sets out when it is sent to `to`.
    ///
    /// A place less than half a count away is where the axis stands: it does not turn once round to get there.
    #[must_use]
    pub fn destination(&self, from: UserUnits, to: UserUnits, way: Way) -> UserUnits {
        let Some(length) = self.modulo else {
            return to;
        };
        let half_a_count = 0.5 / self.counts_per_unit();
        let forwards = (self.place(to).0 - self.place(from).0).rem_euclid(length);
        let standing = forwards < half_a_count || length - forwards < half_a_count;
        let by = match way {
            Way::AsGiven => return to,
            _ if standing && forwards > length / 2.0 => forwards - length,
            _ if standing => forwards,
            Way::Positive => forwards,
            Way::Negative => forwards - length,
            Way::Shortest if forwards <= length / 2.0 => forwards,
            Way::Shortest => forwards - length,
        };
        // Of all positions at that place, written as whole turns and the place, so that nothing adds up over turns.
        let turns = ((from.0 + by - self.place(to).0) / length).round();
        UserUnits(turns.mul_add(length, self.place(to).0))
    }
}
