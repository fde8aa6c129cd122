//! `[[path]]`: lines and arcs of several axes.

use toml::de::DeValue;

use super::super::fields::{Field, Key, Read, Table, TableKey, Value, Written};
use super::super::problem::{Problems, Span};
use super::super::schema::{self, Schema};
use super::Names;

table! { "[[path]]",
    table RawPath {
        /// Name for steps (text)
        name: Key<String> = "\"outline\"",
        /// Axes, in the order of the positions (list of names)
        axes: Option<Names> = "[\"x\", \"y\"]",
        /// Points, from the first one (list of [x, y], or { through = [x, y], to = [x, y] } for an arc; default
        /// this or `file`)
        points: Key<Vec<RawPoint>>,
        /// CSV file with a column for each axis; or with the time in s and a position for each axis, or the
        /// position and the velocity (path)
        file: Key<String>,
        /// Largest distance from the programmed path; 0: the axes stop in each corner (unit; default 0)
        tolerance: Key<f64>,
        /// Velocity along the path (unit/s; default that of the axes)
        velocity: Key<f64>,
        /// Acceleration along the path and across it (unit/s²; default that of the axes)
        acceleration: Key<f64>,
        /// Jerk along the path and across it (unit/s³; default that of the axes)
        jerk: Key<f64>,
    }
}

table! { "an arc",
    table RawArc {
        /// Point between both ends of the arc (list of positions)
        through: Key<Vec<f64>> = "[10.0, 10.0]",
        /// End of the arc (list of positions)
        to: Key<Vec<f64>> = "[20.0, 0.0]",
    }
}

/// A point of a path.
#[derive(Debug)]
pub(crate) enum RawPoint {
    Line(Vec<f64>),
    Arc(RawArc),
}

impl Read for RawPoint {
    const LIST: &'static str = "a list of points";

    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        match value.get_ref() {
            DeValue::Table(_) => RawArc::read(value, key, p).map(Self::Arc),
            _ => Vec::read(value, key, p).map(Self::Line),
        }
    }
}

impl Schema for RawPoint {
    fn schema() -> serde_json::Value {
        schema::any_of([Vec::<f64>::schema(), RawArc::schema()])
    }
}
