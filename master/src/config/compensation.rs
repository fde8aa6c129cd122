//! `compensation` of an axis: backlash and pitch error.

use std::path::Path;

use ecaxis_axis::compensation::{CompensationError, Mechanics};
use ecaxis_axis::{Compensation, Mode, Modes};

use super::AxisSetup;
use super::csv;
use super::device::CheckedDevice;
use super::fields::KeyExt;
use super::problem::{Problems, Span};
use super::raw::RawCompensation;

/// Builds the corrections. Their axes get the limits of the load.
pub(crate) fn check(devices: &mut [CheckedDevice], folder: &Path, p: &mut Problems<'_>) {
    for axis in devices.iter_mut().flat_map(|device| &mut device.axes) {
        let (Some(setup), Some(raw)) = (&mut axis.setup, &axis.compensation) else {
            continue;
        };
        check_mode(setup, raw, p);
        if let Some(made) = compensation(setup, raw, folder, p) {
            setup.config.limits = made.load_limits(&setup.config.limits);
            setup.config.modes = without_profiles(setup.config.modes);
            setup.compensation = made;
        }
    }
}

/// Reports a mode in which nothing commands a position.
fn check_mode(setup: &AxisSetup, raw: &RawCompensation, p: &mut Problems<'_>) {
    let loops = &setup.config.loops;
    let (mode, key) = match setup.config.mode {
        Mode::Pp => {
            let message = "in mode \"pp\" the drive plans with its own positions";
            p.add_hint(raw.span.clone(), message, "write `mode = \"csp\"`");
            return;
        }
        Mode::Csv if loops.csv.is_none() => ("csv", "csv = { kv = 20.0 }"),
        Mode::Cst if loops.cst.is_none() => ("cst", "cst = { kp = 10.0 }"),
        _ => return,
    };
    let message = format!("nothing commands the position of an axis in `mode = \"{mode}\"`");
    let hint = format!("write `mode = \"csp\"`, or a position loop: `{key}`");
    p.add_hint(raw.span.clone(), message, hint);
}

/// A profile of the drive has positions of the drive, and would end next to its target.
fn without_profiles(modes: Modes) -> Modes {
    let others = [Mode::Csp, Mode::Csv, Mode::Cst, Mode::Pv, Mode::Hm];
    let kept = others.into_iter().filter(|mode| modes.contains(*mode));
    kept.fold(Modes::NONE, Modes::with)
}

const ROW: &str = "a row is a position of the load, and load minus drive there";
const EXAMPLE: &str = "write `errors = [[0.0, 0.0], [100.0, 0.02]]`, or `file`";

/// Returns the table as written, and its place.
fn rows(
    raw: &RawCompensation,
    folder: &Path,
    p: &mut Problems<'_>,
) -> Option<(Vec<Vec<f64>>, Span)> {
    match (&raw.errors, &raw.file) {
        (Some(_), Some(file)) => {
            let message = "a pitch error has either `errors` or a `file`";
            p.add_hint(file.span(), message, "remove one of them");
            None
        }
        (Some(errors), None) => Some((errors.get_ref().clone(), errors.span())),
        (None, None) => Some((Vec::new(), raw.span.clone())),
        (None, Some(file)) => {
            let rows = csv::read(file, folder, ROW, p)?;
            if rows.is_empty() {
                p.add_hint(file.span(), "the file has no row of numbers", ROW);
                return None;
            }
            let fields = rows.into_iter().map(|row| row.fields);
            Some((fields.collect(), file.span()))
        }
    }
}

fn compensation(
    setup: &AxisSetup,
    raw: &RawCompensation,
    folder: &Path,
    p: &mut Problems<'_>,
) -> Option<Compensation> {
    let (rows, place) = rows(raw, folder, p)?;
    let errors: Option<Vec<[f64; 2]>> = rows
        .iter()
        .map(|row| row.as_slice().try_into().ok())
        .collect();
    let Some(errors) = errors else {
        p.add_hint(place, "a point has 2 numbers", ROW);
        return None;
    };
    if errors.is_empty() && raw.backlash.is_none() {
        let message = "this corrects neither a backlash nor a pitch error";
        p.add_hint(raw.span.clone(), message, EXAMPLE);
        return None;
    }
    if let (Some(backlash), None) = (&raw.backlash, &raw.homing_ends) {
        let message = "which flank has no play when homing ends?";
        let hint = "write the direction of its last motion: `homing_ends = \"negative\"`";
        p.add_hint(backlash.span(), message, hint);
        return None;
    }
    let mechanics = Mechanics {
        errors: &errors,
        backlash: raw.backlash.value(),
        reference: raw.homing_ends.value().unwrap_or_default(),
        period: setup.config.scale.modulo(),
    };
    let error = match Compensation::new(&mechanics, &setup.config.limits) {
        Ok(made) => return Some(made),
        Err(error) => error,
    };
    let at = match error {
        CompensationError::Backlash(_) => raw.backlash.place(),
        _ => Some(place),
    };
    let hint = match error {
        CompensationError::Backlash(_) => "write the way that the motor turns without the load",
        CompensationError::Slope { .. } => {
            "correct the table, or the scale of the axis (`per_turn`, `feed`)"
        }
        CompensationError::Corner { .. } => {
            "write points that are farther apart, smoother errors, or a lower `limits.velocity`"
        }
        CompensationError::Period { .. } => "measure one turn, and end with the error of its begin",
        _ => ROW,
    };
    p.add_hint(at.unwrap_or_default(), error.to_string(), hint);
    None
}
