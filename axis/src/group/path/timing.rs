//! The fastest motion along a path within velocities and accelerations.
//!
//! x is the squared velocity of the path parameter, and u its acceleration. Between two nodes u is
//! constant, so x is linear. Position q: the velocity is q′·√x, the acceleration q′·u + q″·x. The
//! backward pass finds the highest x at each node from which the rest of the path is possible. The
//! forward pass takes the highest u that stays below it.

use super::geometry::{At, Geometry, dot};

/// Limits that the motion keeps.
#[derive(Debug, Clone)]
pub(super) struct Bounds {
    pub velocities: Vec<f64>,
    pub accelerations: Vec<f64>,
    /// Velocity and acceleration of all axes together: the lengths of the vectors.
    pub velocity: f64,
    pub acceleration: f64,
    /// The acceleration on and near blends and arcs.
    pub curved: f64,
}

/// The share by which two computed bounds may miss each other.
const ROUNDING: f64 = 1e-12;
/// Number of halvings of the interval that contains the highest x.
const HALVINGS: usize = 60;

/// The interval between two nodes.
#[derive(Debug, Clone, Copy)]
struct Interval {
    part: usize,
    /// The parameter of the first node within the part, and the length.
    along: f64,
    length: f64,
    /// The squared velocities at both ends.
    x: [f64; 2],
    stops: bool,
}

impl Interval {
    fn time(&self) -> f64 {
        2.0 * self.length / (self.x[0].sqrt() + self.x[1].sqrt())
    }
}

#[derive(Debug, Clone)]
pub(super) struct Timing {
    intervals: Vec<Interval>,
}

/// The values of the path at both ends of an interval.
#[derive(Debug, Clone, Default)]
struct Ends {
    at: [At; 2],
    length: f64,
    /// The bound of the whole acceleration.
    acceleration: f64,
}

impl Bounds {
    /// Returns the highest x that the velocities permit at a position.
    fn highest(&self, at: &At) -> f64 {
        let axes = at.first.iter().zip(&self.velocities);
        let own = axes.map(|(first, limit)| (limit / first).powi(2));
        let path = self.velocity.powi(2) / dot(&at.first, &at.first);
        own.fold(path, f64::min)
    }

    /// Returns the lowest and highest u for x at the first node, such that x at the second node is
    /// from 0 to `top`. Lowest above highest: x is too high.
    fn permitted(&self, ends: &Ends, x: f64, top: f64) -> [f64; 2] {
        let double = 2.0 * ends.length;
        let (mut low, mut high) = (-x / double, (top - x) / double);
        let mut narrow = |middle: f64, half: f64| {
            low = low.max(middle - half);
            high = high.min(middle + half);
        };
        for (at, later) in ends.at.iter().zip([0.0, double]) {
            // q′·u + q″·(x + later·u)
            let (mut aa, mut ab, mut bb) = (0.0, 0.0, 0.0);
            let axes = at.first.iter().zip(&at.second).zip(&self.accelerations);
            for ((first, second), limit) in axes {
                let (slope, fixed) = (first + later * second, second * x);
                aa += slope * slope;
                ab += slope * fixed;
                bb += fixed * fixed;
                if slope != 0.0 {
                    narrow(-fixed / slope, limit / slope.abs());
                } else if fixed.abs() > *limit {
                    narrow(0.0, -1.0);
                }
            }
            let limit = ends.acceleration;
            let root = ab * ab - aa * (bb - limit * limit);
            if aa > 0.0 {
                // The square of the length is a parabola in u. NaN: never within the limit.
                narrow(-ab / aa, if root >= 0.0 { root.sqrt() / aa } else { -1.0 });
            } else if bb > limit * limit {
                narrow(0.0, -1.0);
            }
        }
        [low, high]
    }
}

impl Timing {
    pub(super) fn new(geometry: &Geometry, bounds: &Bounds) -> Self {
        let mut intervals: Vec<Interval> = Vec::new();
        for (index, part) in geometry.parts.iter().enumerate() {
            let nodes = part.nodes();
            intervals.extend(nodes.windows(2).map(|ends| Interval {
                part: index,
                along: ends[0],
                length: ends[1] - ends[0],
                x: [0.0; 2],
                stops: part.stops && Some(&ends[1]) == nodes.last(),
            }));
        }
        let mut ends = Ends::default();
        // Backward: x[0] becomes the highest squared velocity at the beginning.
        let mut top = 0.0;
        for interval in intervals.iter_mut().rev() {
            ends.set(geometry, interval, bounds);
            if interval.stops {
                top = 0.0;
            }
            let top_here = f64::min(top, bounds.highest(&ends.at[1]));
            let possible = |x: f64| {
                let [low, high] = bounds.permitted(&ends, x, top_here);
                low <= high + ROUNDING * high.abs()
            };
            let ceiling = bounds.highest(&ends.at[0]);
            let (mut kept, mut refused) = (0.0, ceiling.min(1e30));
            if possible(refused) {
                kept = refused;
            } else {
                for _ in 0..HALVINGS {
                    let middle = 0.5 * (kept + refused);
                    if possible(middle) {
                        kept = middle;
                    } else {
                        refused = middle;
                    }
                }
            }
            interval.x = [kept, top_here];
            top = kept;
        }
        // Forward. The end of an interval is the beginning of the next one.
        let mut x = 0.0;
        for interval in &mut intervals {
            ends.set(geometry, interval, bounds);
            let top = interval.x[1];
            let [low, high] = bounds.permitted(&ends, x, top);
            // Both may miss each other by rounding.
            let u = if low <= high {
                high
            } else {
                0.5 * (low + high)
            };
            let next = (x + 2.0 * interval.length * u).max(0.0).min(top);
            interval.x = [x, next];
            x = next;
        }
        Self { intervals }
    }

    /// Returns the number of rows of [`Timing::sample`], or `None` if the motion stands still.
    pub(super) fn cycles(&self, dt_s: f64, rest: usize) -> Option<usize> {
        let time: f64 = self.intervals.iter().map(Interval::time).sum();
        let stops = self.intervals.iter().filter(|interval| interval.stops);
        let rows = (time / dt_s).ceil() + (stops.count() * rest) as f64;
        (rows < 1e9).then_some(rows as usize)
    }

    /// Returns the positions of all axes in each cycle, from the standstill at the beginning to the
    /// one at the end. The axes stand for `rest` cycles where they stop.
    pub(super) fn sample(&self, geometry: &Geometry, dt_s: f64, rest: usize) -> Vec<f64> {
        let mut points = Vec::new();
        let mut at = At::default();
        let mut time = 0.0;
        for interval in &self.intervals {
            let Some(part) = geometry.parts.get(interval.part) else {
                continue;
            };
            let duration = interval.time();
            let [from, to] = interval.x;
            let u = (to - from) / (2.0 * interval.length);
            while time < duration {
                let along = time * (from.sqrt() + time * u * 0.5);
                part.at(interval.along + along.min(interval.length), &mut at);
                points.extend_from_slice(&at.position);
                time += dt_s;
            }
            time -= duration;
            if interval.stops {
                for _ in 0..rest {
                    points.extend_from_slice(&part.end);
                }
                // The next cycle begins the next part.
                time = 0.0;
            }
        }
        if let Some(part) = geometry.parts.last() {
            points.extend_from_slice(&part.end);
        }
        points
    }
}

impl Ends {
    fn set(&mut self, geometry: &Geometry, interval: &Interval, bounds: &Bounds) {
        self.length = interval.length;
        if let Some(part) = geometry.parts.get(interval.part) {
            part.at(interval.along, &mut self.at[0]);
            part.at(interval.along + interval.length, &mut self.at[1]);
            self.acceleration = match part.curved {
                true => bounds.curved,
                false => bounds.acceleration,
            };
        }
    }
}
