//! `[[line_shaft]]` as written.

use toml::Spanned;

use super::super::fields::{Domain, Field, Key, Ns, Read, Table, TableKey, Value, Written};
use super::super::problem::{Problems, Span};
use super::super::schema::{self, Schema};
use super::{MS, S};

table! { "[[line_shaft]]",
    table RawLineShaft {
        /// Name for steps and for the connection that feeds it (text)
        name: Key<String> = "\"shaft\"",
        /// Position unit, as that of the followed axis (text; default `"turn"`)
        unit: Key<String>,
        /// Highest velocity of the followed axis (unit/s)
        velocity: Key<f64> = "20.0",
        /// Highest acceleration of the shaft, and that of its stop (unit/s²)
        acceleration: Key<f64> = "100.0",
        /// Age of the newest set-point at which the shaft stops (time, 1 ms to 10 s; default
        /// `"50ms"`)
        timeout: Key<Ns> [MS..=10 * S],
        /// Time within which a difference from the prediction decays (time, 1 ms to 10 s; default
        /// `"10ms"`)
        smoothing: Key<Ns> [MS..=10 * S],
        /// Difference from the prediction at which the shaft stops (unit; default `acceleration` ·
        /// `timeout`²)
        max_error: Key<f64>,
    }
}
