//! Cams: the position of a follower as a function of a master's position.
//!
//! A cam is a list of points. A polynomial joins each point to the next with the given slopes, and
//! with no second derivative at both ends (degree 5), or no third one either (degree 7). With
//! slopes 0 these are the rest-to-rest laws 3-4-5 and 4-5-6-7 (VDI 2143). Equal slopes along a
//! straight line give that line.

use super::error::position;
use super::{Motion, SetpointError};

/// A point of a cam, in user units.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CamPoint {
    /// The position of the master.
    pub at: f64,
    /// The position of the follower.
    pub to: f64,
    /// The follower's motion per motion of the master.
    pub slope: f64,
}

/// The polynomial between two points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum CamLaw {
    /// Degree 5: the acceleration is continuous.
    #[default]
    Poly5,
    /// Degree 7: the jerk is continuous as well.
    Poly7,
}

/// The reason why points are not a cam.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum CamError {
    /// There are less than two points, or too many.
    #[error("a cam has 2 to {most} points")]
    Points {
        /// The largest number.
        most: usize,
    },
    /// The master's positions do not increase.
    #[error("the master's position {at} does not come after {before}")]
    NotFarther {
        /// The position.
        at: f64,
        /// The position of the point before.
        before: f64,
    },
    /// The ends of a repeated cam do not fit together.
    #[error("the slopes at both ends are {first} and {last}: a repeated cam needs equal ones")]
    Ends {
        /// The slope at the first point.
        first: f64,
        /// The slope at the last point.
        last: f64,
    },
    /// The follower would not stand outside the cam.
    #[error("the slope at an end is {slope}: a cam that does not repeat ends with slope 0")]
    NotAtRest {
        /// The slope.
        slope: f64,
    },
    /// A number is out of range.
    #[error(transparent)]
    Value(#[from] SetpointError),
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Segment {
    at: f64,
    length: f64,
    /// The polynomial of the part of the segment, 0 to 1.
    coefficients: [f64; 8],
    end: f64,
}

impl Segment {
    fn new(from: CamPoint, to: CamPoint, law: CamLaw) -> Self {
        let length = to.at - from.at;
        let first = from.slope * length;
        // What the straight line of the first slope leaves, in position and slope.
        let (a, b) = (to.to - from.to - first, to.slope * length - first);
        let coefficients = match law {
            CamLaw::Poly5 => {
                let [c3, c4, c5] = [10.0 * a - 4.0 * b, -15.0 * a + 7.0 * b, 6.0 * a - 3.0 * b];
                [from.to, first, 0.0, c3, c4, c5, 0.0, 0.0]
            }
            CamLaw::Poly7 => {
                let [c4, c5] = [35.0 * a - 15.0 * b, -84.0 * a + 39.0 * b];
                let [c6, c7] = [70.0 * a - 34.0 * b, -20.0 * a + 10.0 * b];
                [from.to, first, 0.0, 0.0, c4, c5, c6, c7]
            }
        };
        Self {
            at: from.at,
            length,
            coefficients,
            end: to.to,
        }
    }

    /// Returns position and slope.
    fn value(&self, at: f64) -> (f64, f64) {
        let part = (at - self.at) / self.length;
        let (mut value, mut slope) = (0.0, 0.0);
        for coefficient in self.coefficients.iter().rev() {
            slope = slope * part + value;
            value = value * part + coefficient;
        }
        let value = if part >= 1.0 { self.end } else { value };
        (value, slope / self.length)
    }

    /// Returns the first three derivatives at this part of the segment, from 0 to 1.
    fn derivatives(&self, part: f64) -> [f64; 3] {
        let mut sums = [0.0; 4];
        for coefficient in self.coefficients.iter().rev() {
            for order in (1..4).rev() {
                sums[order] = sums[order] * part + sums[order - 1];
            }
            sums[0] = sums[0] * part + coefficient;
        }
        // Horner's scheme gives the derivatives divided by the factorials of their orders.
        let length = self.length;
        [
            sums[1] / length,
            2.0 * sums[2] / length.powi(2),
            6.0 * sums[3] / length.powi(3),
        ]
    }
}

/// The largest first, second or third derivative of a cam, and where it is.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CamPeak {
    /// The position of the master.
    pub at: f64,
    /// The largest absolute value.
    pub value: f64,
}

/// The parts of a segment at which its derivatives are computed: peaks are exact to 0.1 %.
const PARTS: u32 = 96;

/// The position of a follower as a function of a master's position. The follower of the default
/// stands at 0.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Cam {
    segments: Box<[Segment]>,
    /// First and last point.
    ends: [CamPoint; 2],
    repeats: bool,
}

/// The largest number of points.
const MOST_POINTS: usize = 100_000;

impl Cam {
    /// Creates a cam. With `repeats` it continues beyond its ends, from the follower's position
    /// there; otherwise the follower stands there. Allocates.
    pub fn new(points: &[CamPoint], law: CamLaw, repeats: bool) -> Result<Self, CamError> {
        let (&[first, ..], &[.., last]) = (points, points) else {
            return Err(CamError::Points { most: MOST_POINTS });
        };
        if !(2..=MOST_POINTS).contains(&points.len()) {
            return Err(CamError::Points { most: MOST_POINTS });
        }
        for point in points {
            position("master position", point.at)?;
            position("cam position", point.to)?;
            position("cam slope", point.slope)?;
        }
        let mut segments = Vec::with_capacity(points.len() - 1);
        for pair in points.windows(2) {
            let &[from, to] = pair else { continue };
            // Written so that a length that vanishes is rejected, too.
            if to.at - from.at <= f64::EPSILON * to.at.abs() {
                return Err(CamError::NotFarther {
                    at: to.at,
                    before: from.at,
                });
            }
            segments.push(Segment::new(from, to, law));
        }
        let slopes = [first.slope, last.slope];
        if repeats && slopes[0] != slopes[1] {
            let [first, last] = slopes;
            return Err(CamError::Ends { first, last });
        }
        if let Some(&slope) = slopes.iter().find(|slope| !repeats && **slope != 0.0) {
            return Err(CamError::NotAtRest { slope });
        }
        Ok(Self {
            segments: segments.into(),
            ends: [first, last],
            repeats,
        })
    }

    /// Returns the follower's position, and its motion per motion of the master. RT: O(log points).
    #[must_use]
    pub fn value(&self, at: f64) -> (f64, f64) {
        let [first, last] = self.ends;
        let (mut at, mut shift) = (at, 0.0);
        if self.repeats {
            let period = last.at - first.at;
            let turns = ((at - first.at) / period).floor();
            at -= turns * period;
            shift = turns * (last.to - first.to);
        } else if at <= first.at {
            return (first.to, 0.0);
        } else if at >= last.at {
            return (last.to, 0.0);
        }
        let next = self.segments.partition_point(|segment| segment.at <= at);
        let segment = self.segments.get(next.saturating_sub(1));
        segment.map_or((first.to, 0.0), |segment| {
            let (value, slope) = segment.value(at);
            (value + shift, slope)
        })
    }
}

impl Cam {
    /// Returns the largest first, second and third derivative. The master's velocity v makes the
    /// velocity d₁·v, the acceleration d₂·v² and the jerk d₃·v³ of them. O(points).
    #[must_use]
    pub fn peaks(&self) -> [CamPeak; 3] {
        let mut peaks = [CamPeak::default(); 3];
        for segment in &self.segments {
            for part in 0..=PARTS {
                let part = f64::from(part) / f64::from(PARTS);
                for (peak, value) in peaks.iter_mut().zip(segment.derivatives(part)) {
                    if value.abs() > peak.value {
                        let at = segment.at + part * segment.length;
                        *peak = CamPeak {
                            at,
                            value: value.abs(),
                        };
                    }
                }
            }
        }
        peaks
    }

    /// Returns the motion that a gear with ratio 1 follows. `scale` is the way on the cam per way of
    /// the master. RT: O(log points).
    #[must_use]
    pub fn motion(&self, master: Motion, scale: f64) -> Motion {
        let (position, slope) = self.value(master.position * scale);
        Motion {
            position,
            velocity: slope * scale * master.velocity,
            acceleration: 0.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn rest(at: f64, to: f64) -> CamPoint {
        CamPoint { at, to, slope: 0.0 }
    }

    #[test]
    fn rest_to_rest_laws_are_those_of_vdi_2143() {
        let points = [rest(10.0, -2.0), rest(70.0, 4.0)];
        let five = Cam::new(&points, CamLaw::Poly5, false).unwrap();
        let seven = Cam::new(&points, CamLaw::Poly7, false).unwrap();
        for n in 0..=100 {
            let z = f64::from(n) / 100.0;
            let at = 10.0 + 60.0 * z;
            let law5 = 10.0 * z.powi(3) - 15.0 * z.powi(4) + 6.0 * z.powi(5);
            let law7 = 35.0 * z.powi(4) - 84.0 * z.powi(5) + 70.0 * z.powi(6) - 20.0 * z.powi(7);
            assert!(
                (five.value(at).0 - (-2.0 + 6.0 * law5)).abs() < 1e-12,
                "{z}"
            );
            assert!(
                (seven.value(at).0 - (-2.0 + 6.0 * law7)).abs() < 1e-12,
                "{z}"
            );
        }
        // VDI 2143: C_v, C_a and C_j of both laws, over 60 with a lift of 6.
        for (cam, [v, a, j]) in [
            (&five, [1.875, 5.7735, 60.0]),
            (&seven, [2.1875, 7.5132, 52.5]),
        ] {
            let lift = |order: i32| 6.0 / 60_f64.powi(order);
            for (peak, (order, expected)) in cam.peaks().iter().zip((1..).zip([v, a, j])) {
                let factor = peak.value / lift(order);
                assert!((factor / expected - 1.0).abs() < 1e-3, "{order}: {factor}");
            }
            assert_eq!(cam.peaks()[0].at, 40.0);
        }
        // The peaks of the velocity: 1.875 and 2.1875.
        assert!((five.value(40.0).1 - 1.875 * 0.1).abs() < 1e-12);
        assert!((seven.value(40.0).1 - 2.1875 * 0.1).abs() < 1e-12);
        assert_eq!(five.value(-5.0), (-2.0, 0.0));
        assert_eq!(five.value(75.0), (4.0, 0.0));
    }

    #[test]
    fn impossible_points_are_rejected() {
        let moving = CamPoint {
            slope: 1.0,
            ..rest(1.0, 1.0)
        };
        let cam = |points: &[CamPoint], repeats| Cam::new(points, CamLaw::Poly5, repeats);
        assert!(matches!(
            cam(&[rest(0.0, 0.0)], false),
            Err(CamError::Points { .. })
        ));
        let same = [rest(1.0, 0.0), rest(1.0, 1.0)];
        assert!(matches!(
            cam(&same, false),
            Err(CamError::NotFarther { .. })
        ));
        assert!(matches!(
            cam(&[rest(0.0, 0.0), moving], false),
            Err(CamError::NotAtRest { .. })
        ));
        assert!(matches!(
            cam(&[rest(0.0, 0.0), moving], true),
            Err(CamError::Ends { .. })
        ));
        let wrong = [rest(0.0, f64::NAN), rest(1.0, 1.0)];
        assert!(matches!(cam(&wrong, true), Err(CamError::Value(_))));
    }

    proptest! {
        /// Position and slope are continuous, also where a repeated cam begins again.
        #[test]
        fn a_repeated_cam_is_smooth(
            steps in prop::collection::vec((0.5f64..20.0, -5.0f64..5.0, -1.0f64..1.0), 2..8),
            seven: bool,
            turn in -1000i32..1000,
        ) {
            let mut at = -3.0;
            let mut points = vec![];
            for &(length, to, slope) in &steps {
                points.push(CamPoint { at, to, slope });
                at += length;
            }
            let last = points.len() - 1;
            points[last].slope = points[0].slope;
            let law = if seven { CamLaw::Poly7 } else { CamLaw::Poly5 };
            let cam = Cam::new(&points, law, true).unwrap();
            let period = points[last].at - points[0].at;
            for point in &points {
                let at = point.at + f64::from(turn) * period;
                let (before, slope_before) = cam.value(at - 1e-7);
                let (after, slope_after) = cam.value(at + 1e-7);
                prop_assert!((before - after).abs() < 1e-5, "{before} {after}");
                prop_assert!((slope_before - slope_after).abs() < 1e-4);
                prop_assert!((slope_after - point.slope).abs() < 1e-4);
            }
        }
    }
}
