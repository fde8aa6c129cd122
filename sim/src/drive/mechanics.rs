//! The mechanics between motor and load: backlash and pitch error, without inertia of their own.

use super::plant::Plant;

/// The largest number of points of a pitch error.
const MAX_POINTS: usize = 16;

/// A pitch error by its points, linear between them. Beyond them, the error of the end holds.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PitchError {
    /// Position of the load and error there, load minus motor, in counts.
    points: [[f64; 2]; MAX_POINTS],
    count: usize,
}

impl PitchError {
    /// The largest number of points.
    pub const MAX_POINTS: usize = MAX_POINTS;

    /// Returns the error with these points, by ascending positions. `None`: there are too many.
    #[must_use]
    pub fn new(points: &[[f64; 2]]) -> Option<Self> {
        let mut error = Self {
            count: points.len(),
            ..Self::default()
        };
        error
            .points
            .get_mut(..points.len())?
            .copy_from_slice(points);
        Some(error)
    }

    fn at(&self, load: f64) -> f64 {
        let points = self.points.get(..self.count).unwrap_or_default();
        let Some(next) = points.iter().position(|[position, _]| *position > load) else {
            return points.last().map_or(0.0, |[_, error]| *error);
        };
        match (
            next.checked_sub(1).and_then(|n| points.get(n)),
            points.get(next),
        ) {
            (Some([from, a]), Some([to, b])) => a + (b - a) * (load - from) / (to - from),
            (_, first) => first.map_or(0.0, |[_, error]| *error),
        }
    }
}

/// The load behind a motor.
#[derive(Debug, Clone)]
pub(super) struct Mechanics {
    backlash: f64,
    error: PitchError,
    /// The motor position at which the load lies on the flank of negative motion.
    flank: f64,
    load: f64,
}

/// More steps would change less than a thousandth of a count.
const STEPS: usize = 20;

impl Mechanics {
    /// At power-on the load lies as after a motion in the negative direction.
    pub(super) fn new(backlash: f64, error: PitchError, motor: &Plant) -> Self {
        let mut mechanics = Self {
            backlash: backlash.max(0.0),
            error,
            flank: motor.position(),
            load: motor.position(),
        };
        mechanics.follow(motor);
        mechanics
    }

    /// Moves the load with the motor.
    pub(super) fn follow(&mut self, motor: &Plant) {
        let motor = motor.position();
        // The motor pulls the load down, or pushes it up after the backlash.
        self.flank = self.flank.max(motor - self.backlash).min(motor);
        self.load = self.flank;
        for _ in 0..STEPS {
            self.load = self.flank + self.error.at(self.load);
        }
    }

    /// Returns the count of an encoder at the load.
    #[expect(clippy::cast_possible_truncation, reason = "saturates")]
    pub(super) fn counts(&self) -> i64 {
        self.load.floor() as i64
    }
}
