//! `[[path]]`: lines and arcs of several axes, planned when the file is read.

use std::path::Path;

use ecaxis_axis::group::{PathError, PathLimits, PathPlan, PathSegment};
use ecaxis_axis::setpoint::{MotionLimits, Table, TablePoint};
use ecaxis_ecat::index::{AxisIndex, IndexVec};
use toml::Spanned;

use super::AxisSetup;
use super::csv::{self, CsvRow};
use super::fields::{Key, KeyExt};
use super::problem::{Problems, Span, suggestion};
use super::raw::{RawPath, RawPoint};
use super::steps::ResolvedAxis;
use crate::text::rounded;

/// A path and its name in the machine file.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct NamedPath {
    pub name: String,
    /// Each axis with an index into the tables of the machine. Empty: the path is invalid and has been
    /// reported.
    pub tables: Vec<(AxisIndex, usize)>,
}

const HINT: &str = "a row has a position for each axis; or the time, and a position or position and velocity for each axis";

/// Plans the paths. Their tables are added to `tables`.
pub(crate) fn check(
    raw: &[RawPath],
    axes: &IndexVec<AxisIndex, ResolvedAxis<'_>>,
    folder: &Path,
    cycle_s: f64,
    tables: &mut Vec<Table>,
    p: &mut Problems<'_>,
) -> Vec<NamedPath> {
    let mut paths: Vec<NamedPath> = Vec::new();
    for raw in raw {
        let Some(name) = &raw.name else { continue };
        if paths.iter().any(|path| path.name == *name.get_ref()) {
            let message = format!("the path \"{}\" is there already", name.get_ref());
            p.add_hint(name.span(), message, "give it another name");
            continue;
        }
        paths.push(NamedPath {
            name: name.get_ref().clone(),
            tables: Vec::new(),
        });
        let Some(members) = members(raw, axes, p) else {
            continue;
        };
        let setups: Vec<_> = members.iter().map(|(_, setup)| *setup).collect();
        let Some(Planned {
            tables: planned,
            place,
            is_timed,
        }) = plan(raw, &setups, folder, cycle_s, p)
        else {
            continue;
        };
        let mut possible = true;
        for (table, setup) in planned.iter().zip(&setups) {
            let limits = &setup.config.limits;
            if let Err(error) = table.check(limits.motion(), limits.position, 0.0, cycle_s) {
                let why = match is_timed {
                    true => error.to_string(),
                    // A row is a cycle.
                    false => {
                        let time = error.line.saturating_sub(1) as f64 * cycle_s;
                        format!("{} s after its begin, {}", rounded(time), error.problem)
                    }
                };
                let message = format!("`{}` cannot follow this path: {why}", setup.name);
                let hint = "change the points, or the limits of the axis";
                p.add_hint(place.clone(), message, hint);
                possible = false;
            }
        }
        if possible {
            let first = tables.len();
            let members = members.iter().map(|(axis, _)| *axis);
            if let Some(path) = paths.last_mut() {
                path.tables = members.zip(first..).collect();
            }
            tables.extend(planned);
        }
    }
    paths
}

/// Returns the axes of a path.
fn members<'c>(
    raw: &RawPath,
    axes: &IndexVec<AxisIndex, ResolvedAxis<'c>>,
    p: &mut Problems<'_>,
) -> Option<Vec<(AxisIndex, &'c AxisSetup)>> {
    let mut members: Vec<(AxisIndex, &AxisSetup)> = Vec::new();
    for name in &raw.axes.as_ref()?.0 {
        let known = |axis: &&AxisIndex| axes[**axis].name == name.get_ref();
        let indices: Vec<_> = axes.indices().collect();
        let Some(&index) = indices.iter().find(known) else {
            let message = format!("no axis is named `{}`", name.get_ref());
            let names = axes.iter().map(|axis| axis.name);
            p.add_hint(
                name.span(),
                message,
                suggestion(name.get_ref(), names, "axes"),
            );
            return None;
        };
        // An invalid axis has been reported.
        let setup = axes[index].setup?;
        if members.iter().any(|(known, _)| *known == index) {
            let message = format!("`{}` is named twice", name.get_ref());
            p.add_hint(name.span(), message, "name each axis once");
            return None;
        }
        if let Some((_, first)) = members
            .first()
            .filter(|(_, first)| first.unit != setup.unit)
        {
            let message = format!(
                "`{}` has the unit {}, and `{}` has {}",
                first.name, first.unit, setup.name, setup.unit
            );
            let hint = "the axes of a path have one unit";
            p.add_hint(name.span(), message, hint);
            return None;
        }
        members.push((index, setup));
    }
    Some(members)
}

/// The table of each axis, and the place of the points.
struct Planned {
    tables: Vec<Table>,
    place: Span,
    /// The rows of the tables are those of a file with times.
    is_timed: bool,
}

/// Plans a path.
fn plan(
    raw: &RawPath,
    axes: &[&AxisSetup],
    folder: &Path,
    cycle_s: f64,
    p: &mut Problems<'_>,
) -> Option<Planned> {
    let count = axes.len();
    let (segments, place, lines) = match (&raw.points, &raw.file) {
        (Some(points), None) => (
            points.get_ref().iter().map(segment).collect::<Vec<_>>(),
            points.span(),
            None,
        ),
        (None, Some(file)) => {
            let rows = csv::read(file, folder, HINT, p)?;
            if rows.first().is_some_and(|row| row.fields.len() != count) {
                return Some(Planned {
                    tables: timed(raw, file, &rows, count, p)?,
                    place: file.span(),
                    is_timed: true,
                });
            }
            let lines: Vec<_> = rows.iter().map(|row| row.line).collect();
            let lined = rows
                .into_iter()
                .map(|row| PathSegment::Line { to: row.fields });
            (lined.collect(), file.span(), Some(lines))
        }
        _ => {
            let hint = "write `points = [[0.0, 0.0], [90.0, 10.0]]`, or `file`";
            let message = "a path has either `points` or a `file`";
            p.add_hint(raw.span.clone(), message, hint);
            return None;
        }
    };
    let Some((PathSegment::Line { to: start }, segments)) = segments.split_first() else {
        let hint = "write its first point as a list: `[0.0, 0.0]`";
        p.add_hint(place, "a path begins at a point", hint);
        return None;
    };
    let motions: Vec<_> = axes
        .iter()
        .map(|axis| axis.config.limits.motion())
        .collect();
    let limits = limits(raw, p)?;
    match PathPlan::new(start, segments, &motions, &limits, cycle_s) {
        Ok(plan) => Some(Planned {
            tables: plan.into_tables(),
            place,
            is_timed: false,
        }),
        Err(error) => {
            let at = match (&error, lines) {
                (
                    PathError::Positions { point, .. }
                    | PathError::Position { point, .. }
                    | PathError::Straight { point }
                    | PathError::Circle { point },
                    Some(lines),
                ) => lines.get(*point - 1).map(|line| format!("line {line}: ")),
                _ => None,
            };
            let hint = match error {
                PathError::ArcWithoutTolerance => "add `tolerance = 0.01`, or what the part allows",
                PathError::Straight { .. } => "choose `through` off the straight line",
                PathError::Circle { .. } => "write one half of it, then the other",
                PathError::Positions { .. } => "write a position for each of `axes`",
                PathError::TooLong { .. } | PathError::Points { .. } => {
                    "divide it, or raise its limits or its tolerance"
                }
                _ => "change the points or the limits",
            };
            let message = format!("{}{error}", at.unwrap_or_default());
            p.add_hint(place, message, hint);
            None
        }
    }
}

fn segment(point: &RawPoint) -> PathSegment {
    let positions = |key: &Key<Vec<f64>>| {
        let positions = key.as_ref().map(|positions| positions.get_ref().clone());
        positions.unwrap_or_default()
    };
    match point {
        RawPoint::Line(to) => PathSegment::Line { to: to.clone() },
        RawPoint::Arc(arc) => PathSegment::Arc {
            through: positions(&arc.through),
            to: positions(&arc.to),
        },
    }
}

/// Returns the limits along the path.
fn limits(raw: &RawPath, p: &mut Problems<'_>) -> Option<PathLimits> {
    let mut possible = true;
    let mut limit = |key: &Key<f64>, name: &str| match key {
        None => f64::INFINITY,
        Some(value) => {
            if *value.get_ref() <= 0.0 {
                let message = format!("`{name}` must be above 0");
                p.add_hint(
                    value.span(),
                    message,
                    "leave it out for the limits of the axes",
                );
                possible = false;
            }
            *value.get_ref()
        }
    };
    let motion = MotionLimits {
        velocity: limit(&raw.velocity, "velocity"),
        acceleration: limit(&raw.acceleration, "acceleration"),
        jerk: limit(&raw.jerk, "jerk"),
    };
    let tolerance = raw.tolerance.value().unwrap_or_default();
    if let Some(value) = raw.tolerance.as_ref().filter(|_| tolerance < 0.0) {
        let hint = "0 stops in each corner";
        p.add_hint(value.span(), "a tolerance is not negative", hint);
        possible = false;
    }
    possible.then_some(PathLimits { motion, tolerance })
}

/// Returns the tables of a file with times.
fn timed(
    raw: &RawPath,
    file: &Spanned<String>,
    rows: &[CsvRow],
    axes: usize,
    p: &mut Problems<'_>,
) -> Option<Vec<Table>> {
    let keys = [
        (&raw.tolerance, "tolerance"),
        (&raw.velocity, "velocity"),
        (&raw.acceleration, "acceleration"),
        (&raw.jerk, "jerk"),
    ];
    for (key, name) in keys {
        if let Some(key) = key {
            let message = format!("`{name}` does not go with a file that has times");
            p.add_hint(key.span(), message, "remove it, or the times");
            return None;
        }
    }
    let wide = rows.first().map(|row| row.fields.len()).unwrap_or_default();
    let velocities = wide == 2 * axes + 1;
    let wrong = match rows.iter().find(|row| row.fields.len() != wide) {
        None if wide == axes + 1 || velocities => None,
        None => rows.first(),
        wrong => wrong,
    };
    if let Some(row) = wrong {
        let message = format!(
            "line {}: {} columns for {axes} axes",
            row.line,
            row.fields.len()
        );
        p.add_hint(file.span(), message, HINT);
        return None;
    }
    let mut tables = Vec::with_capacity(axes);
    for axis in 0..axes {
        let points = rows.iter().map(|row| {
            let field = |at: usize| row.fields.get(at).copied();
            let at = if velocities { 1 + 2 * axis } else { 1 + axis };
            TablePoint {
                line: row.line,
                time: field(0).unwrap_or_default(),
                position: field(at).unwrap_or_default(),
                velocity: field(at + 1).filter(|_| velocities),
            }
        });
        match Table::new(points) {
            Ok(table) => tables.push(table),
            Err(error) => {
                p.add_hint(file.span(), error.to_string(), HINT);
                return None;
            }
        }
    }
    Some(tables)
}
