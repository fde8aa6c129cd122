//! `[[cam]]`: the position of a follower as a function of a master's position.

use std::path::Path;

use ecaxis_axis::setpoint::{Cam, CamPoint};

use super::fields::KeyExt;
use super::problem::{Problems, Span};
use super::raw::RawCam;
use crate::file::{self, unreadable};
use crate::signature::SignedKind;

/// A cam and its name in the machine file.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedCam {
    pub name: String,
    pub cam: Cam,
}

/// The maximum length of a file in bytes.
const MAX_BYTES: u64 = 16 << 20;

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
        let Some((rows, place)) = rows(raw, folder, p) else {
            continue;
        };
        let points: Option<Vec<_>> = rows.iter().map(|row| point(row)).collect();
        let hint = "a row is the master's position, the follower's, and if you like the slope";
        let Some(points) = points else {
            p.add_hint(place, "a point has 2 or 3 numbers", hint);
            continue;
        };
        let law = raw.law.value().unwrap_or_default();
        match Cam::new(&points, law, raw.repeat.value().unwrap_or(false)) {
            Ok(cam) => cams.push(NamedCam {
                name: name.get_ref().clone(),
                cam,
            }),
            Err(error) => p.add_hint(place, error.to_string(), hint),
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
    let path = folder.join(file.get_ref());
    let text = match file::read_text(&path, MAX_BYTES) {
        Ok(text) => text,
        Err(error) => {
            let hint = "paths are relative to the machine file";
            p.add_hint(file.span(), unreadable(&path, &error), hint);
            return None;
        }
    };
    if let Err(error) = p.files.add(SignedKind::Tables, &path, text.as_bytes()) {
        p.add_hint(file.span(), error.to_string(), error.hint());
        return None;
    }
    let mut rows = Vec::new();
    for (number, line) in (1..).zip(text.lines()) {
        let line = line.split('#').next().unwrap_or_default().trim();
        let separator = |c: char| c == ',' || c == ';' || c.is_whitespace();
        let mut fields = line
            .split(separator)
            .filter(|field| !field.is_empty())
            .peekable();
        let word = |field: &&str| field.starts_with(|c: char| c.is_alphabetic());
        if fields.peek().is_none() || (rows.is_empty() && fields.peek().is_some_and(word)) {
            continue;
        }
        let row: Result<Vec<f64>, _> = fields.map(str::parse).collect();
        let Ok(row) = row else {
            let message = format!("{}, line {number}: a field is not a number", path.display());
            let hint = "a row is the master's position, the follower's, and if you like the slope";
            p.add_hint(file.span(), message, hint);
            return None;
        };
        rows.push(row);
    }
    Some((rows, file.span()))
}
