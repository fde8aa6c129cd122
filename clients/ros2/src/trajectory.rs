//! Trajectories: a table for each joint, checked against the limits before the first cycle.

use std::fmt::Write as _;

use ecaxis_axis::setpoint::{Interpolation, Table, TableError};

use crate::joints::{Interface, Joint};
use crate::messages::{JointTrajectory, JointTrajectoryPoint};

/// The points of a trajectory.
pub const MAX_POINTS: usize = 100_000;
/// The shortest time before the first point, s. An earlier one is the start.
const START_S: f64 = 1e-9;

/// The motion of one joint, relative to the present set-point of its axis only in its begin.
#[derive(Debug, Clone)]
pub struct Plan {
    /// The index of the joint.
    pub joint: usize,
    pub table: Table,
    /// The set-point from which the table begins.
    pub start: f64,
}

/// Where the axes are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Start {
    /// The set-point in units of the axis.
    pub position: f64,
    pub enabled: bool,
    /// The set-point does not move.
    pub stands: bool,
    pub mode: i8,
}

/// Checks a trajectory as a whole. Returns the motion of each joint; none for a trajectory without
/// points, which stops its joints.
///
/// # Errors
/// Names the joint and the point, and says why nothing of the trajectory is carried out.
pub fn plan(
    trajectory: &JointTrajectory,
    joints: &[Joint],
    starts: &[Start],
    tolerance: f64,
    cycle_s: f64,
) -> Result<Vec<Plan>, String> {
    let points = &trajectory.points;
    let names = &trajectory.joint_names;
    if names.is_empty() {
        return Err("the trajectory names no joint".to_owned());
    }
    if points.len() > MAX_POINTS {
        return Err(format!(
            "{} points; the most are {MAX_POINTS}",
            points.len()
        ));
    }
    for (number, point) in points.iter().enumerate() {
        check_sizes(number, point, names.len())?;
    }
    let with = points
        .iter()
        .filter(|point| !point.velocities.is_empty())
        .count();
    if with != 0 && with != points.len() {
        return Err("some points have velocities, others have none".to_owned());
    }
    let mut plans = Vec::new();
    for (column, name) in names.iter().enumerate() {
        if names[..column].contains(name) {
            return Err(format!("joint `{name}` is in the trajectory twice"));
        }
        let index = joints.iter().position(|joint| joint.name == *name);
        let index = index.ok_or_else(|| format!("no joint is called `{name}`"))?;
        if points.is_empty() {
            continue;
        }
        let (joint, start) = (&joints[index], starts[index]);
        if !start.enabled {
            return Err(format!("`{name}` is not enabled: call its service enable"));
        }
        if !start.stands {
            return Err(format!("`{name}` moves: a trajectory begins at rest"));
        }
        if Interface::of_mode(start.mode) != Some(Interface::Position) {
            return Err(format!(
                "`{name}` is not in a mode with positions: change the mode"
            ));
        }
        let table = table(points, column, joint, start, tolerance)?;
        let checked = table.check(joint.limits, joint.range, 0.0, cycle_s);
        checked.map_err(|error| describe(name, joint, &error, points))?;
        plans.push(Plan {
            joint: index,
            table,
            start: start.position,
        });
    }
    Ok(plans)
}

fn check_sizes(number: usize, point: &JointTrajectoryPoint, names: usize) -> Result<(), String> {
    let arrays = [
        ("positions", &point.positions, false),
        ("velocities", &point.velocities, true),
        ("accelerations", &point.accelerations, true),
        ("effort", &point.effort, true),
    ];
    for (name, array, may_be_empty) in arrays {
        if array.len() != names && !(may_be_empty && array.is_empty()) {
            let count = array.len();
            return Err(format!(
                "point {number} has {count} {name} for {names} joints"
            ));
        }
        if array.iter().any(|value| !value.is_finite()) {
            return Err(format!("point {number}: {name} are not all finite numbers"));
        }
    }
    Ok(())
}

/// Returns the table of a joint in units of its axis, from the present set-point on.
fn table(
    points: &[JointTrajectoryPoint],
    column: usize,
    joint: &Joint,
    start: Start,
    tolerance: f64,
) -> Result<Table, String> {
    let name = &joint.name;
    let mut text = String::new();
    let mut row = |time: f64, position: f64, velocity: Option<f64>| {
        let _ = match velocity {
            Some(velocity) => writeln!(text, "{time:e},{position:e},{velocity:e}"),
            None => writeln!(text, "{time:e},{position:e}"),
        };
    };
    let has_velocities = points.iter().any(|point| !point.velocities.is_empty());
    let mut points = points.iter().peekable();
    // A point at the time 0 is where the axis is.
    if let Some(first) = points.next_if(|point| point.time_from_start.seconds() <= START_S) {
        let distance = first.positions[column] - start.position * joint.scale;
        if distance.abs() > tolerance {
            return Err(format!(
                "`{name}`: the first point is {distance:.6} from the axis; the most is {tolerance}"
            ));
        }
        if first
            .velocities
            .get(column)
            .is_some_and(|velocity| *velocity != 0.0)
        {
            return Err(format!(
                "`{name}`: the first point, at the time 0, has a velocity"
            ));
        }
    }
    row(0.0, start.position, has_velocities.then_some(0.0));
    for point in points {
        let velocity = point
            .velocities
            .get(column)
            .map(|velocity| velocity / joint.scale);
        row(
            point.time_from_start.seconds(),
            point.positions[column] / joint.scale,
            velocity,
        );
    }
    Table::parse(&text, Interpolation::Cubic)
        .map_err(|error| format!("`{name}`: {}", error.problem))
}

/// Names the joint and the point of a problem. Row 1 of a table is the start.
fn describe(
    name: &str,
    joint: &Joint,
    error: &TableError,
    points: &[JointTrajectoryPoint],
) -> String {
    let skipped = points
        .first()
        .is_some_and(|point| point.time_from_start.seconds() <= START_S);
    let point = error.line.saturating_sub(if skipped { 1 } else { 2 });
    let unit = match joint.scale {
        1.0 => String::new(),
        scale => format!(" (one unit of the axis is {scale} rad or m)"),
    };
    format!("`{name}`, up to point {point}: {}{unit}", error.problem)
}

#[cfg(test)]
#[path = "trajectory_tests.rs"]
mod tests;
