//! `[[cam]]`: the position of a follower as a function of a master's position.

use std::path::Path;

use ecaxis_axis::setpoint::{Cam, CamPoint};

use super::csv;
use super::fields::KeyExt;
use super::problem::{Problems, Span};
use super::raw::RawCam;

/// A cam and its name in the machine file.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedCam {
    pub name: String,
    pub cam: Cam,
}

const HINT: &str = "a row is the master's position, the follower's, and if you like the slope";

/// Checks the cams.
pub(crate) fn check(raw: &[RawCam], folder: &Path, p: &mut Problems<'_>) -> Vec<NamedCam> {
    let mut cams: Vec<NamedCam> = Vec::new();
    for raw in raw {
        let Some(name) = &raw.name else { continue };
        if cams.iter().any(|cam| cam.name == *name.get_ref()) {
            let message = format!("the cam \"{}\" is there already", name.get_ref());
            p.add_hint(name.span(), message, "give it another name");
            continue;
        }
        // A cam with a mistake has its name: steps that name it are not wrong.
        cams.push(NamedCam {
            name: name.get_ref().clone(),
            cam: Cam::default(),
        });
        let Some((rows, place)) = rows(raw, folder, p) else {
            continue;
        };
        let points: Option<Vec<_>> = rows.iter().map(|row| point(row)).collect();
        let Some(points) = points else {
            p.add_hint(place, "a point has 2 or 3 numbers", HINT);
            continue;
        };
        let law = raw.law.value().unwrap_or_default();
        match Cam::new(&points, law, raw.repeat.value().unwrap_or(false)) {
            Ok(cam) => {
                if let Some(known) = cams.last_mut() {
                    known.cam = cam;
                }
            }
            Err(error) => p.add_hint(place, error.to_string(), HINT),
        }
    }
    cams
}

fn point(row: &[f64]) -> Option<CamPoint> {
    match *row {
        [at, to] => Some(CamPoint { at, to, slope: 0.0 }),
        [at, to, slope] => Some(CamPoint { at, to, slope }),
        _ => None,
    }
}

/// Returns the points of a cam as written, and their place.
fn rows(raw: &RawCam, folder: &Path, p: &mut Problems<'_>) -> Option<(Vec<Vec<f64>>, Span)> {
    let file = match (&raw.points, &raw.file) {
        (Some(points), None) => return Some((points.get_ref().clone(), points.span())),
        (None, Some(file)) => file,
        _ => {
            let hint = "write `points = [[0.0, 0.0], [90.0, 10.0]]`, or `file`";
            p.add_hint(
                raw.span.clone(),
                "a cam has either `points` or a `file`",
                hint,
            );
            return None;
        }
    };
    let rows = csv::read(file, folder, HINT, p)?;
    Some((
        rows.into_iter().map(|row| row.fields).collect(),
        file.span(),
    ))
}
