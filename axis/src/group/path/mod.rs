//! A path of lines and arcs through several axes, with blended corners.
//!
//! [`PathPlan::new`] plans in three stages, before the first cycle:
//!
//! 1. **Geometry.** A parabola replaces each corner, as far as the tolerance permits. The path then
//!    has no kinks. Without a tolerance the axes stop in the corner.
//! 2. **Timing.** The fastest motion along the path within the velocities and accelerations of the
//!    axes and of the path: a backward and a forward pass over the squared velocity (reachability
//!    analysis, Pham and Pham 2018).
//! 3. **Jerk.** A moving average over a constant time. An average keeps every bound on velocity and
//!    acceleration. It bounds the jerk to twice the acceleration, divided by the time.
//!
//! The average cuts corners and arcs by at most w·a; a: acceleration, w: half the variance of the
//! average. This counts towards the tolerance.

mod geometry;
mod timing;

use self::geometry::{Blending, Geometry};
use self::timing::{Bounds, Timing};
use crate::setpoint::{Knot, MotionLimits, SetpointError, Table};

/// One part of the programmed path, which begins where the part before ends.
#[derive(Debug, Clone, PartialEq)]
pub enum PathSegment {
    /// A straight line to a point.
    Line {
        /// The end, one position per axis.
        to: Vec<f64>,
    },
    /// A circular arc through a point to another one.
    Arc {
        /// A point between both ends.
        through: Vec<f64>,
        /// The end.
        to: Vec<f64>,
    },
}

/// The limits of the motion along the path, in the common unit of the axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathLimits {
    /// Velocity, acceleration and jerk along the path. Infinite: those of the axes apply.
    pub motion: MotionLimits,
    /// The largest distance from the programmed path. 0: the axes stop in each corner.
    pub tolerance: f64,
}

/// The reason why a path is rejected.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PathError {
    /// A point has another number of positions than the path has axes.
    #[error("point {point} has {found} positions for {axes} axes")]
    Positions {
        /// The number of the point, from 1.
        point: usize,
        /// Its positions.
        found: usize,
        /// The axes.
        axes: usize,
    },
    /// A position is impossible.
    #[error("point {point}: {error}")]
    Position {
        /// The number of the point, from 1.
        point: usize,
        /// The reason.
        #[source]
        error: SetpointError,
    },
    /// The path has no length.
    #[error("a path needs two different points at least")]
    Empty,
    /// The three points of an arc lie on a straight line.
    #[error("the arc to point {point} has its three points on a straight line")]
    Straight {
        /// The number of the end point, from 1.
        point: usize,
    },
    /// An arc ends where it begins.
    #[error("the arc to point {point} ends where it begins: a circle needs two arcs")]
    Circle {
        /// The number of the end point, from 1.
        point: usize,
    },
    /// An arc with a tolerance of 0.
    #[error("an arc needs a tolerance, because the jerk limit cuts it a little")]
    ArcWithoutTolerance,
    /// The path limits are not above 0, or the tolerance is negative.
    #[error("the limits of the path must be above 0")]
    Limits,
    /// No plan keeps the limits.
    #[error("no motion on this path within the limits was found")]
    Unsolved,
    /// A limit of an axis is impossible.
    #[error(transparent)]
    Motion(#[from] SetpointError),
    /// The path has too many points.
    #[error("a path has at most {most} points")]
    Points {
        /// The largest number of points.
        most: usize,
    },
    /// The motion has too many cycles.
    #[error("the path takes more than {most} cycles")]
    TooLong {
        /// The largest number of cycles.
        most: usize,
    },
}

/// The largest number of cycles of a path.
const MOST_CYCLES: usize = 1_000_000;
/// The largest number of points. A plan of so many takes some seconds.
const MOST_POINTS: usize = 20_000;
/// The largest number of additions for the average of one axis.
const MOST_SUMS: usize = 2_000_000_000;

/// The largest share of the limits that is used; the rest covers rounding.
const USED: f64 = 1.0 - 1e-6;

/// Number of plans: between two computed nodes a curve can exceed a limit a little, and the next
/// plan uses less of it.
const PLANS: usize = 8;

/// The set-points of all axes on a path.
#[derive(Debug, Clone, PartialEq)]
pub struct PathPlan {
    tables: Vec<Table>,
    length: f64,
}

impl PathPlan {
    /// Plans a path from standstill at `start` to standstill at its end. `dt_s`: the cycle time in
    /// seconds. Allocates.
    ///
    /// # Errors
    /// Fails if a point or a limit is impossible. The caller checks the ranges with
    /// [`Table::check`].
    pub fn new(
        start: &[f64],
        segments: &[PathSegment],
        axes: &[MotionLimits],
        limits: &PathLimits,
        dt_s: f64,
    ) -> Result<Self, PathError> {
        let motion = limits.motion;
        let positive = |limit: f64| limit > 0.0;
        let all = [motion.velocity, motion.acceleration, motion.jerk, dt_s];
        if !all.into_iter().all(positive) || limits.tolerance.is_nan() || limits.tolerance < 0.0 {
            return Err(PathError::Limits);
        }
        for axis in axes {
            axis.check()?;
        }
        if segments.len() >= MOST_POINTS {
            return Err(PathError::Points { most: MOST_POINTS });
        }
        // The average bounds the jerk of each axis, and of the path.
        let squares = axes.iter().map(|axis| axis.acceleration.powi(2));
        let steepest = motion.acceleration.min(squares.sum::<f64>().sqrt());
        let times = axes
            .iter()
            .map(|axis| 2.0 * axis.acceleration.min(steepest) / axis.jerk);
        let time = times.fold(2.0 * steepest / motion.jerk, f64::max);
        let cycles = (time / dt_s).ceil().max(1.0);
        if cycles > MOST_CYCLES as f64 {
            return Err(PathError::TooLong { most: MOST_CYCLES });
        }
        let width = cycles as usize;
        let cut = ((cycles * cycles - 1.0) / 24.0 + 1.0 / 6.0) * dt_s * dt_s;
        let blend = (limits.tolerance - steepest * cut).max(limits.tolerance * 0.5);
        let mut used = USED;
        for _ in 0..PLANS {
            let curved = ((limits.tolerance - blend) / cut).min(steepest) * used;
            let blending = Blending {
                distance: blend,
                time: (cycles + 2.0) * dt_s * 0.5,
                acceleration: curved,
                velocity: motion.velocity,
            };
            let geometry = Geometry::new(start, segments, axes.len(), &blending)?;
            let bounds = Bounds {
                velocities: axes.iter().map(|a| a.velocity * used).collect(),
                accelerations: axes.iter().map(|a| a.acceleration * used).collect(),
                velocity: motion.velocity * used,
                acceleration: steepest * used,
                curved,
            };
            let timing = Timing::new(&geometry, &bounds);
            // The average must come to rest in a corner without blend.
            let rest = width + 2;
            let rows = timing.cycles(dt_s, rest);
            let most = MOST_CYCLES.min(MOST_SUMS / width);
            if rows.is_none_or(|rows| rows > most) {
                return Err(PathError::TooLong { most });
            }
            let points = timing.sample(&geometry, dt_s, rest);
            let most = largest_share(&points, axes, [motion.velocity, steepest], dt_s);
            if most <= USED {
                let tables = 0..axes.len();
                let tables = tables.map(|axis| table(&points, axis, axes.len(), width, dt_s));
                return Ok(Self {
                    tables: tables.collect(),
                    length: geometry.length(),
                });
            }
            if most == f64::INFINITY {
                break;
            }
            used *= USED * 0.9999 / most;
        }
        Err(PathError::Unsolved)
    }

    /// Returns the table of each axis. All have the same rows in time.
    #[must_use]
    pub fn tables(&self) -> &[Table] {
        &self.tables
    }

    /// Takes the tables.
    #[must_use]
    pub fn into_tables(self) -> Vec<Table> {
        self.tables
    }

    /// Returns the length of the path with its blends.
    #[must_use]
    pub fn length(&self) -> f64 {
        self.length
    }

    /// Returns the duration in seconds.
    #[must_use]
    pub fn duration_s(&self) -> f64 {
        self.tables.first().map_or(0.0, Table::duration_s)
    }
}

/// Returns the largest velocity or acceleration as a share of its limit. `path`: the limits of the
/// lengths of both vectors.
fn largest_share(points: &[f64], axes: &[MotionLimits], path: [f64; 2], dt_s: f64) -> f64 {
    let count = axes.len();
    let rows: Vec<&[f64]> = points.chunks_exact(count).collect();
    let row = |row: usize| rows[row.saturating_sub(1).min(rows.len() - 1)];
    let mut most = 0.0_f64;
    // The axes stand before the first row and after the last one.
    for n in 0..=rows.len() {
        let mut squares = [0.0; 2];
        for (axis, limits) in axes.iter().enumerate() {
            let [a, b, c] = [row(n)[axis], row(n + 1)[axis], row(n + 2)[axis]];
            let velocity = (b - a) / dt_s;
            let acceleration = (c - 2.0 * b + a) / (dt_s * dt_s);
            if !acceleration.is_finite() {
                return f64::INFINITY;
            }
            most = most.max(velocity.abs() / limits.velocity);
            most = most.max(acceleration.abs() / limits.acceleration);
            squares[0] += velocity * velocity;
            squares[1] += acceleration * acceleration;
        }
        for (square, limit) in squares.into_iter().zip(path) {
            most = most.max(square.sqrt() / limit);
        }
    }
    most
}

/// Averages the positions of one axis over `width` cycles, and takes the result as the control
/// points of a cubic B-spline. So position, velocity and acceleration are continuous, and bounded by
/// the differences of the control points at every time. `points` ends at rest.
fn table(points: &[f64], axis: usize, axes: usize, width: usize, dt_s: f64) -> Table {
    let position = |row: isize| {
        let last = points.len() / axes - 1;
        points[row.clamp(0, last as isize) as usize * axes + axis]
    };
    let rows = (points.len() / axes + width) as isize;
    let control = |row: isize| {
        let at = position(row);
        // Differences of near positions keep their digits.
        let sum: f64 = (1..width as isize).map(|n| position(row - n) - at).sum();
        at + sum / width as f64
    };
    let mut window = [control(-2), control(-1), control(0)];
    let mut knots = Vec::new();
    for row in -1..=rows {
        let [before, at, after] = window;
        knots.push(Knot {
            position: at + ((before - at) + (after - at)) / 6.0,
            velocity: (after - before) / (2.0 * dt_s),
        });
        window = [at, after, control(row + 2)];
    }
    Table::of_knots(&knots, dt_s)
}

#[cfg(test)]
#[path = "tests.rs"]
mod tests;
