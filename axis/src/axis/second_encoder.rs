//! A second encoder at the load: supervised, not controlled.

use super::{Axis, Inputs};
use crate::status::Trip;
use crate::units::Counts;

/// A second encoder. Its position is `counts / counts_per_unit` plus an offset.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SecondEncoder {
    /// Counts per user unit; negative if it counts in the other direction.
    pub counts_per_unit: f64,
    /// The largest difference from the position of the axis, user units. A larger one trips it.
    pub max_difference: f64,
    /// The position of the axis at count 0. `None`: the difference is 0 when home is found.
    pub offset: Option<f64>,
    /// True if its counts begin at 0 (UDINT), false if half of them are negative (DINT).
    pub unsigned: bool,
}

impl SecondEncoder {
    /// Returns the counts of the first reading.
    fn first(&self, raw: i32) -> Counts {
        Counts(match self.unsigned {
            true => i64::from(raw.cast_unsigned()),
            false => i64::from(raw),
        })
    }
}

/// What the second encoder has shown.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct SecondPosition {
    counts: Option<Counts>,
    offset: Option<f64>,
    /// The position of the axis minus that of the encoder, once they are compared.
    pub(super) difference: Option<f64>,
    /// The encoder has restarted, and its counts have no known place until homing.
    waits_for_home: bool,
}

impl Axis {
    /// Reads the second encoder, after the position of the axis. An axis that is not homed is not
    /// compared, and neither is an encoder without fresh data.
    pub(super) fn read_second_encoder(&mut self, inputs: &Inputs) {
        self.second.difference = None;
        let (Some(encoder), Some(raw)) = (self.config.second_encoder, inputs.second_position)
        else {
            return;
        };
        let second = &mut self.second;
        let counts = second
            .counts
            .map_or_else(|| encoder.first(raw), |counts| counts.unwrap_next(raw));
        second.counts = Some(counts);
        if second.waits_for_home || !self.home.validity.is_homed() || self.actual.counts().is_none()
        {
            second.offset = None;
            return;
        }
        let position = counts.0 as f64 / encoder.counts_per_unit;
        let own = self.actual.position();
        let offset = *second
            .offset
            .get_or_insert(encoder.offset.unwrap_or(own - position));
        second.difference = Some(own - position - offset);
    }

    /// Takes the counts of an encoder that has restarted. Without an offset in the configuration,
    /// they are compared after the next homing.
    pub fn restart_second_encoder(&mut self) {
        let offset = self.config.second_encoder.and_then(|e| e.offset);
        self.second = SecondPosition {
            waits_for_home: offset.is_none(),
            ..SecondPosition::default()
        };
    }

    /// Forgets the place of the counts while homing runs.
    pub(super) fn home_second_encoder(&mut self) {
        self.second = SecondPosition {
            counts: self.second.counts,
            ..SecondPosition::default()
        };
    }

    /// Returns the trip of a difference beyond its limit.
    pub(super) fn check_second_encoder(&self) -> Option<Trip> {
        let limit = self.config.second_encoder?.max_difference;
        let difference = self.second.difference?;
        (difference.abs() > limit).then_some(Trip::EncoderDifference { difference, limit })
    }
}
