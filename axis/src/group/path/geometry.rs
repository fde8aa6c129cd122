//! The curve of a path: lines, arcs, and blends between them.

use super::{PathError, PathSegment};
use crate::setpoint::check_position;

/// Above this sine of half the change of direction, a corner is a reversal, which is not blended.
const REVERSAL: f64 = 0.998;
/// Below this sine of half the change of direction, the path has no corner.
const SMOOTH: f64 = 1e-7;
/// Number of positions at which the distance of a blend from its corner is measured.
const MEASURED: usize = 33;

/// A piece of the path. Its parameter runs from 0 to its length, and has the unit of a length. At
/// both ends of a piece, the derivative of the position has the length 1.
#[derive(Debug, Clone)]
pub(super) enum Curve {
    Line {
        from: Vec<f64>,
        direction: Vec<f64>,
    },
    Arc {
        center: Vec<f64>,
        /// Two perpendicular unit vectors; the arc begins at the first one.
        plane: [Vec<f64>; 2],
        radius: f64,
    },
    /// A cubic Bézier curve. Between two lines it is a parabola.
    Blend([Vec<f64>; 4]),
}

/// Position, first and second derivative at one parameter.
#[derive(Debug, Clone, Default)]
pub(super) struct At {
    pub position: Vec<f64>,
    pub first: Vec<f64>,
    pub second: Vec<f64>,
}

#[derive(Debug, Clone)]
pub(super) struct Part {
    pub curve: Curve,
    /// The first and the last parameter.
    pub from: f64,
    pub to: f64,
    /// The last point. On the curve up to rounding.
    pub end: Vec<f64>,
    /// The axes stop at the end of this part.
    pub stops: bool,
    /// The part is curved, or the average of its positions reaches into one that is.
    pub curved: bool,
}

impl Part {
    pub(super) fn length(&self) -> f64 {
        self.to - self.from
    }

    /// Returns the parameters of the computed nodes, from the beginning of the part. They are close
    /// at the ends of lines and arcs, where the axes accelerate.
    pub(super) fn nodes(&self) -> Vec<f64> {
        let (count, even) = match self.curve {
            Curve::Line { .. } => (40, false),
            Curve::Blend(_) => (16, true),
            Curve::Arc { radius, .. } => {
                let angle = self.length() / radius;
                ((angle * 32.0).ceil().clamp(40.0, 4000.0) as usize, false)
            }
        };
        let node = |n: usize| {
            let share = n as f64 / count as f64;
            let share = match even {
                true => share,
                false => 0.5 - 0.5 * (core::f64::consts::PI * share).cos(),
            };
            self.length() * share
        };
        (0..=count).map(node).collect()
    }

    /// Returns the distance of a position from a line, or from the circle of an arc.
    fn distance(&self, position: &[f64]) -> f64 {
        match &self.curve {
            Curve::Line { from, direction } => {
                let out = difference(position, from);
                let along = dot(&out, direction).clamp(self.from, self.to);
                let off = out.iter().zip(direction).map(|(o, d)| o - d * along);
                norm(&off.collect::<Vec<_>>())
            }
            Curve::Arc {
                center,
                plane: [u, w],
                radius,
            } => {
                let out = difference(position, center);
                let (x, y) = (dot(&out, u), dot(&out, w));
                let off = out.iter().zip(u.iter().zip(w));
                let off = off.map(|(o, (u, w))| o - x * u - y * w);
                norm(&off.collect::<Vec<_>>()).hypot(x.hypot(y) - radius)
            }
            Curve::Blend([_, _, _, end]) => norm(&difference(position, end)),
        }
    }

    /// `along`: the parameter from the beginning of the part.
    pub(super) fn at(&self, along: f64, into: &mut At) {
        self.curve.at(self.from + along, self.to, into);
    }
}

impl Curve {
    /// `end`: the last parameter of a blend.
    fn at(&self, along: f64, end: f64, into: &mut At) {
        let fill = |to: &mut Vec<f64>, values: &mut dyn Iterator<Item = f64>| {
            to.clear();
            to.extend(values);
        };
        match self {
            Self::Line { from, direction } => {
                let position = from.iter().zip(direction).map(|(p, d)| p + d * along);
                fill(&mut into.position, &mut { position });
                fill(&mut into.first, &mut direction.iter().copied());
                fill(&mut into.second, &mut from.iter().map(|_| 0.0));
            }
            Self::Arc {
                center,
                plane: [u, w],
                radius,
            } => {
                let (sin, cos) = (along / radius).sin_cos();
                let axes = || center.iter().zip(u.iter().zip(w));
                let out = |(c, (u, w)): (&f64, (&f64, &f64))| c + radius * (u * cos + w * sin);
                fill(&mut into.position, &mut axes().map(out));
                fill(
                    &mut into.first,
                    &mut axes().map(|(_, (u, w))| w * cos - u * sin),
                );
                let inwards = |(_, (u, w)): (&f64, (&f64, &f64))| -(u * cos + w * sin) / radius;
                fill(&mut into.second, &mut axes().map(inwards));
            }
            Self::Blend([a, b, c, d]) => {
                let t = along / end;
                let r = 1.0 - t;
                let axes = || a.iter().zip(b).zip(c.iter().zip(d));
                let position = axes().map(|((a, b), (c, d))| {
                    r * r * r * a + 3.0 * t * r * (r * b + t * c) + t * t * t * d
                });
                fill(&mut into.position, &mut { position });
                let first = axes().map(|((a, b), (c, d))| {
                    3.0 * (r * r * (b - a) + 2.0 * r * t * (c - b) + t * t * (d - c)) / end
                });
                fill(&mut into.first, &mut { first });
                let second = axes().map(|((a, b), (c, d))| {
                    6.0 * (r * (a - 2.0 * b + c) + t * (b - 2.0 * c + d)) / (end * end)
                });
                fill(&mut into.second, &mut { second });
            }
        }
    }
}

/// The blends, and the motion around them.
#[derive(Debug, Clone, Copy)]
pub(super) struct Blending {
    /// The largest distance of a blend from its corner; 0: the axes stop in corners.
    pub distance: f64,
    /// Half the time of the average.
    pub time: f64,
    /// The highest acceleration within this time of a curve.
    pub acceleration: f64,
    /// The highest velocity.
    pub velocity: f64,
}

/// The whole path.
#[derive(Debug, Clone)]
pub(super) struct Geometry {
    pub parts: Vec<Part>,
}

impl Geometry {
    pub(super) fn new(
        start: &[f64],
        segments: &[PathSegment],
        axes: usize,
        blending: &Blending,
    ) -> Result<Self, PathError> {
        let mut at = start.to_vec();
        check(&at, axes, 1)?;
        let mut whole: Vec<Part> = Vec::new();
        for (number, segment) in (2..).zip(segments) {
            let (PathSegment::Line { to } | PathSegment::Arc { to, .. }) = segment;
            check(to, axes, number)?;
            let part = match segment {
                PathSegment::Line { .. } => line(&at, to),
                PathSegment::Arc { through, .. } => {
                    check(through, axes, number)?;
                    if blending.distance <= 0.0 {
                        return Err(PathError::ArcWithoutTolerance);
                    }
                    if line(&at, to).is_none() {
                        return Err(PathError::Circle { point: number });
                    }
                    let arc = arc(&at, through, to);
                    Some(arc.ok_or(PathError::Straight { point: number })?)
                }
            };
            whole.extend(part);
            at.clone_from(to);
        }
        if whole.is_empty() {
            return Err(PathError::Empty);
        }
        Ok(Self {
            parts: near_curves(blended(whole, blending.distance), blending),
        })
    }

    pub(super) fn length(&self) -> f64 {
        self.parts.iter().map(Part::length).sum()
    }
}

fn check(point: &[f64], axes: usize, number: usize) -> Result<(), PathError> {
    if point.len() != axes {
        return Err(PathError::Positions {
            point: number,
            found: point.len(),
            axes,
        });
    }
    let mut positions = point.iter();
    positions
        .try_for_each(|position| check_position("position", *position))
        .map_err(|error| PathError::Position {
            point: number,
            error,
        })
}

/// Returns the line, or `None` between equal points.
fn line(from: &[f64], to: &[f64]) -> Option<Part> {
    let way = difference(to, from);
    let length = norm(&way);
    let size = from
        .iter()
        .chain(to)
        .fold(1.0_f64, |most, p| most.max(p.abs()));
    if length <= size * 1e-12 {
        return None;
    }
    Some(Part {
        curve: Curve::Line {
            from: from.to_vec(),
            direction: way.iter().map(|way| way / length).collect(),
        },
        from: 0.0,
        to: length,
        end: to.to_vec(),
        stops: false,
        curved: false,
    })
}

/// Returns the arc through three points, or `None` if they lie on a line.
fn arc(from: &[f64], through: &[f64], to: &[f64]) -> Option<Part> {
    let (a, b) = (difference(through, from), difference(to, from));
    let (aa, bb, ab) = (dot(&a, &a), dot(&b, &b), dot(&a, &b));
    let area = aa * bb - ab * ab;
    if area <= 1e-12 * aa * bb || bb == 0.0 {
        return None;
    }
    // The centre has equal distances from the three points, and lies in their plane.
    let (x, y) = (bb * (aa - ab) / (2.0 * area), aa * (bb - ab) / (2.0 * area));
    let way: Vec<f64> = a.iter().zip(&b).map(|(a, b)| x * a + y * b).collect();
    let center: Vec<f64> = from.iter().zip(&way).map(|(p, w)| p + w).collect();
    let radius = norm(&way);
    let u: Vec<f64> = way.iter().map(|w| -w / radius).collect();
    // Perpendicular to `u`, towards the point between.
    let out = difference(through, &center);
    let across = dot(&out, &u);
    let w: Vec<f64> = out.iter().zip(&u).map(|(o, u)| o - across * u).collect();
    let size = norm(&w);
    // The middle point lies at the radius opposite to the beginning: the end gives the plane.
    let w: Vec<f64> = if size > radius * 1e-6 {
        w.iter().map(|w| w / size).collect()
    } else {
        let out = difference(to, &center);
        let across = dot(&out, &u);
        let w: Vec<f64> = out.iter().zip(&u).map(|(o, u)| across * u - o).collect();
        let size = norm(&w);
        w.iter().map(|w| w / size).collect()
    };
    let angle = |point: &[f64]| {
        let out = difference(point, &center);
        let angle = dot(&out, &w).atan2(dot(&out, &u));
        angle.rem_euclid(core::f64::consts::TAU)
    };
    let (middle, mut end) = (angle(through), angle(to));
    let mut w = w;
    if middle > end {
        // The other way around.
        w.iter_mut().for_each(|w| *w = -*w);
        end = core::f64::consts::TAU - end;
    }
    Some(Part {
        curve: Curve::Arc {
            center,
            plane: [u, w],
            radius,
        },
        from: 0.0,
        to: radius * end,
        end: to.to_vec(),
        stops: false,
        curved: true,
    })
}

/// Replaces corners by blends.
fn blended(whole: Vec<Part>, blend: f64) -> Vec<Part> {
    let mut parts: Vec<Part> = Vec::with_capacity(whole.len() * 2);
    let half: Vec<f64> = whole.iter().map(|part| part.length() * 0.5).collect();
    let mut whole = whole.into_iter().peekable();
    let mut room = half.windows(2).map(|pair| pair[0].min(pair[1]));
    while let Some(mut part) = whole.next() {
        if let Some(next) = whole.peek_mut() {
            let room = room.next().unwrap_or_default();
            match corner(&part, next, blend, room) {
                Corner::None => parts.push(part),
                Corner::Stop => {
                    part.stops = true;
                    parts.push(part);
                }
                Corner::Blend { trim, curve } => {
                    part.to -= trim;
                    next.from += trim;
                    if part.length() > 0.0 {
                        parts.push(part);
                    }
                    parts.push(curve);
                }
            }
        } else if part.length() > 0.0 {
            parts.push(part);
        }
    }
    parts
}

/// Separates the ends of lines that the average mixes with curves. A short line may pass the rest of
/// the way on to the next one.
fn near_curves(parts: Vec<Part>, blending: &Blending) -> Vec<Part> {
    let mut at = At::default();
    // The way from a curve in half the time of the average.
    let mut way = |curve: &Part, along: f64| {
        curve.at(along, &mut at);
        let fastest = (blending.acceleration / norm(&at.second)).sqrt();
        let time = blending.time;
        fastest.min(blending.velocity) * time + blending.acceleration * time * time * 0.5
    };
    let mut reached = vec![[0.0_f64; 2]; parts.len()];
    let mut left = 0.0_f64;
    for (part, reached) in parts.iter().zip(&mut reached) {
        reached[0] = left;
        left = (left - part.length()).max(0.0);
        if part.curved {
            left = left.max(way(part, part.length()));
        }
        if part.stops {
            left = 0.0;
        }
    }
    left = 0.0;
    for (part, reached) in parts.iter().zip(&mut reached).rev() {
        if part.stops {
            left = 0.0;
        }
        reached[1] = left;
        left = (left - part.length()).max(0.0);
        if part.curved {
            left = left.max(way(part, 0.0));
        }
    }
    let mut split = Vec::with_capacity(parts.len() * 2);
    for (part, [before, after]) in parts.into_iter().zip(reached) {
        let cuts = [part.from + before, part.to - after];
        if part.curved || cuts[0] >= cuts[1] {
            split.push(Part {
                curved: true,
                ..part
            });
            continue;
        }
        let bounds = [part.from, cuts[0], cuts[1], part.to];
        for (n, ends) in bounds.windows(2).enumerate() {
            if ends[0] < ends[1] {
                split.push(Part {
                    from: ends[0],
                    to: ends[1],
                    curved: n != 1,
                    stops: part.stops && ends[1] == part.to,
                    ..part.clone()
                });
            }
        }
    }
    split
}

enum Corner {
    None,
    Stop,
    Blend { trim: f64, curve: Part },
}

fn corner(before: &Part, after: &Part, blend: f64, room: f64) -> Corner {
    let mut at = At::default();
    before.at(before.length(), &mut at);
    let point = at.position.clone();
    let out = at.first.clone();
    after.at(0.0, &mut at);
    let turn = norm(&difference(&at.first, &out)) * 0.5;
    if turn < SMOOTH {
        return Corner::None;
    }
    if blend <= 0.0 || turn > REVERSAL {
        return Corner::Stop;
    }
    let mut trim = (2.0 * blend / turn).min(room);
    loop {
        let curve = between(before, after, trim);
        // The blend passes the corner, and leaves the path, by at most `blend`.
        let (mut nearest, mut farthest) = (f64::INFINITY, 0.0_f64);
        for n in 0..MEASURED {
            curve.at(curve.length() * n as f64 / (MEASURED - 1) as f64, &mut at);
            nearest = nearest.min(norm(&difference(&at.position, &point)));
            let off = before
                .distance(&at.position)
                .min(after.distance(&at.position));
            farthest = farthest.max(off);
        }
        if nearest.max(farthest) <= blend * (1.0 + 1e-9) {
            return Corner::Blend { trim, curve };
        }
        trim *= 0.8;
    }
}

/// Returns the blend that begins `trim` before a corner and ends `trim` after it.
fn between(before: &Part, after: &Part, trim: f64) -> Part {
    let mut at = At::default();
    before.at(before.length() - trim, &mut at);
    let reach = trim * 2.0 / 3.0;
    let ahead = |at: &At, reach: f64| -> Vec<f64> {
        let axes = at.position.iter().zip(&at.first);
        axes.map(|(p, d)| p + d * reach).collect()
    };
    let (a, b) = (at.position.clone(), ahead(&at, reach));
    after.at(trim, &mut at);
    let (c, d) = (ahead(&at, -reach), at.position.clone());
    Part {
        end: d.clone(),
        curve: Curve::Blend([a, b, c, d]),
        from: 0.0,
        to: 3.0 * reach,
        stops: false,
        curved: true,
    }
}

pub(super) fn difference(a: &[f64], b: &[f64]) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| a - b).collect()
}

pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

pub(super) fn norm(a: &[f64]) -> f64 {
    dot(a, a).sqrt()
}
