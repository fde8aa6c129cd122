//! Interpolation between two points: a cubic through positions and velocities, or a straight
//! segment.

use super::{MotionLimits, SetpointError};

/// A point to pass, and the velocity there.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Knot {
    /// The position, user units.
    pub position: f64,
    /// The velocity, user units per second.
    pub velocity: f64,
}

/// The path between two points.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Interpolation {
    /// Constant velocity from point to point; given velocities are ignored. Each change of velocity
    /// happens in one cycle and must be possible in one.
    Linear,
    /// A cubic through positions and velocities.
    Cubic,
}

/// p(t) = p₀ + v₀·t + b·t² + c·t³ for 0 ≤ t ≤ `time`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Piece {
    from: Knot,
    to: Knot,
    time: f64,
    b: f64,
    c: f64,
}

impl Piece {
    /// Creates a cubic; `time` must be above 0.
    pub(crate) fn new(from: Knot, to: Knot, time: f64) -> Self {
        let slope = (to.position - from.position) / time;
        Self {
            from,
            to,
            time,
            b: (3.0 * slope - 2.0 * from.velocity - to.velocity) / time,
            c: (from.velocity + to.velocity - 2.0 * slope) / (time * time),
        }
    }

    /// Creates a piece with constant velocity.
    pub(crate) fn straight(from: f64, to: f64, time: f64) -> Self {
        let velocity = (to - from) / time;
        let knot = |position| Knot { position, velocity };
        Self {
            from: knot(from),
            to: knot(to),
            time,
            b: 0.0,
            c: 0.0,
        }
    }

    pub(crate) const fn from(&self) -> Knot {
        self.from
    }

    pub(crate) const fn to(&self) -> Knot {
        self.to
    }

    pub(crate) const fn time(&self) -> f64 {
        self.time
    }

    pub(crate) fn start_acceleration(&self) -> f64 {
        2.0 * self.b
    }

    pub(crate) fn end_acceleration(&self) -> f64 {
        2.0 * self.b + self.jerk() * self.time
    }

    pub(crate) fn jerk(&self) -> f64 {
        6.0 * self.c
    }

    pub(crate) fn position(&self, t: f64) -> f64 {
        if t >= self.time {
            return self.to.position;
        }
        self.from.position + t * (self.from.velocity + t * (self.b + t * self.c))
    }

    fn velocity(&self, t: f64) -> f64 {
        self.from.velocity + t * (2.0 * self.b + t * 3.0 * self.c)
    }

    fn inside(&self, t: f64) -> bool {
        t > 0.0 && t < self.time
    }

    /// Checks velocity, acceleration and position of the whole piece.
    pub(crate) fn check(
        &self,
        limits: MotionLimits,
        range: Option<[f64; 2]>,
    ) -> Result<(), SetpointError> {
        let vertex = -self.b / (3.0 * self.c);
        let mut velocity = fastest(self.from.velocity, self.to.velocity);
        if self.inside(vertex) {
            velocity = fastest(velocity, self.velocity(vertex));
        }
        super::error::position("velocity", velocity)?;
        if velocity.abs() > limits.velocity {
            return Err(SetpointError::TooFast {
                velocity,
                limit: limits.velocity,
            });
        }
        let acceleration = fastest(self.start_acceleration(), self.end_acceleration());
        steep(acceleration, limits.acceleration)?;
        let Some([low, high]) = range else {
            return Ok(());
        };
        let root = (self.b * self.b - 3.0 * self.c * self.from.velocity).sqrt();
        let q = -(self.b + root.copysign(self.b));
        let turning = [q / (3.0 * self.c), self.from.velocity / q];
        let reached = turning
            .into_iter()
            .filter(|&t| self.inside(t))
            .map(|t| self.position(t))
            .chain([self.from.position, self.to.position]);
        for reaches in reached {
            within(reaches, [low, high])?;
        }
        Ok(())
    }
}

/// Checks a change of velocity within one cycle.
pub(crate) fn check_corner(
    before: f64,
    after: f64,
    acceleration: f64,
    dt_s: f64,
) -> Result<(), SetpointError> {
    steep((after - before) / dt_s, acceleration)
}

/// The rounding of velocities, as a fraction of the change of velocity in one cycle.
const ROUNDING: f64 = 1e-9;

/// Checks that the axis can stand at the end of a piece that ends with `velocity`.
pub(crate) fn check_end(
    interpolation: Interpolation,
    velocity: f64,
    acceleration: f64,
    dt_s: f64,
) -> Result<(), SetpointError> {
    match interpolation {
        Interpolation::Linear => check_corner(velocity, 0.0, acceleration, dt_s),
        // A cubic may end with full deceleration, which leaves no room for a velocity step, except
        // for the rounding of calculated points.
        Interpolation::Cubic if velocity.abs() <= ROUNDING * acceleration * dt_s => Ok(()),
        Interpolation::Cubic => Err(SetpointError::NotAtRest { velocity }),
    }
}

/// Checks that a stop with the limit acceleration after `knot` stays in the range.
pub(crate) fn check_stop(
    knot: Knot,
    acceleration: f64,
    range: Option<[f64; 2]>,
    dt_s: f64,
) -> Result<(), SetpointError> {
    let Some(range) = range else {
        return Ok(());
    };
    let v = knot.velocity;
    let stopped = knot.position + v * v.abs() / (2.0 * acceleration);
    if v == 0.0 {
        return Ok(());
    }
    within(stopped + v * dt_s * 0.5, range)
}

fn fastest(a: f64, b: f64) -> f64 {
    if a.abs() >= b.abs() { a } else { b }
}

fn steep(acceleration: f64, limit: f64) -> Result<(), SetpointError> {
    if acceleration.abs() <= limit {
        Ok(())
    } else {
        Err(SetpointError::TooSteep {
            acceleration,
            limit,
        })
    }
}

pub(crate) fn within(reaches: f64, [low, high]: [f64; 2]) -> Result<(), SetpointError> {
    if (low..=high).contains(&reaches) {
        Ok(())
    } else {
        Err(SetpointError::LeavesRange { reaches, low, high })
    }
}
