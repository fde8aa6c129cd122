//! Charts as data: curves and histograms on two scales, states as bands.

use ecaxis_master::config::duration;
use serde::Serialize;

/// A picture of one or more series.
#[derive(Debug, Clone)]
pub struct Chart {
    pub title: String,
    pub x: Axis,
    /// `None`: bands, which have no scale.
    pub y: Option<Axis>,
    /// A series without values keeps its colour for the same series of another chart.
    pub series: Vec<Series>,
    /// Events on the x axis.
    pub markers: Vec<Marker>,
}

/// A scale from `low` to `high`.
#[derive(Debug, Clone, Serialize)]
pub struct Axis {
    pub low: f64,
    pub high: f64,
    pub logarithmic: bool,
    pub format: Format,
    /// The unit of numbers; other formats have their own.
    pub unit: String,
    /// The time of 0 in ns since 1970, if it is known.
    pub origin_ns: Option<u64>,
}

/// The format of the values of an axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Format {
    Number,
    Seconds,
    /// A time in ns with a suitable unit.
    Duration,
    /// A fraction of all cycles.
    Share,
}

#[derive(Debug, Clone)]
pub struct Series {
    pub name: String,
    pub shape: Shape,
}

#[derive(Debug, Clone)]
pub enum Shape {
    /// x, least and greatest y.
    Curve(Vec<(f64, f64, f64)>),
    /// Start, end and height of each step; the marks are below the axis.
    Histogram {
        steps: Vec<(f64, f64, f64)>,
        marks: Vec<f64>,
    },
    /// The start of each state and its name.
    Bands(Vec<(f64, String)>),
}

/// An event at a place of the x axis.
#[derive(Debug, Clone, Serialize)]
pub struct Marker {
    pub at: f64,
    pub text: String,
}

impl Shape {
    pub(super) fn is_empty(&self) -> bool {
        match self {
            Self::Curve(points) => points.is_empty(),
            Self::Histogram { steps, .. } => steps.is_empty(),
            Self::Bands(states) => states.is_empty(),
        }
    }
}

impl Axis {
    /// Returns a linear scale of numbers.
    #[must_use]
    pub fn of_numbers(low: f64, high: f64, unit: &str) -> Self {
        Self {
            low,
            high,
            logarithmic: false,
            format: Format::Number,
            unit: unit.to_owned(),
            origin_ns: None,
        }
    }

    /// Returns the place of a value from 0 to 1.
    pub(super) fn place(&self, value: f64) -> f64 {
        let scale = |v: f64| match self.logarithmic {
            true => v.max(1e-12).log10(),
            false => v,
        };
        let (low, high) = (scale(self.low), scale(self.high));
        ((scale(value) - low) / (high - low).max(1e-9)).clamp(0.0, 1.0)
    }

    /// Returns about `count` round numbers, or the decades of a logarithmic scale.
    pub(super) fn ticks(&self, count: f64) -> Vec<(f64, String)> {
        if self.logarithmic {
            let decades = (self.low.log10().round() as i32)..=(self.high.log10().round() as i32);
            let factors: &[f64] = match self.high / self.low.max(1e-12) > MAX_FINE {
                true => &[1.0],
                false => &[1.0, 2.0, 5.0],
            };
            let of = |decade: i32| factors.iter().map(move |n| n * 10_f64.powi(decade));
            let values = decades.flat_map(of).filter(|at| *at <= self.high * 1.0001);
            return values.map(|at| (at, self.label(at, at))).collect();
        }
        let rough = (self.high - self.low) / count;
        if !rough.is_finite() || rough <= 0.0 {
            return vec![(self.low, self.label(self.low, 1.0))];
        }
        let decade = 10_f64.powf(rough.log10().floor());
        let steps = [1.0, 2.0, 5.0, 10.0].map(|n| n * decade);
        let step = steps.into_iter().find(|step| *step >= rough);
        let step = step.unwrap_or(rough);
        let first = (self.low / step).ceil();
        (0..40)
            .map(|n| (first + f64::from(n)) * step)
            .take_while(|at| *at <= self.high + step * 1e-9)
            .map(|at| (at, self.label(at, step)))
            .collect()
    }

    /// Formats a tick; `step` is the distance of the ticks.
    fn label(&self, value: f64, step: f64) -> String {
        match self.format {
            Format::Number => number(value, step),
            Format::Seconds => format!("{} s", number(value, step)),
            Format::Duration => duration::show(value.round() as u64),
            Format::Share => match -value.log10() {
                d if d <= 0.0 => "all".to_owned(),
                d if d <= 3.0 => format!("1 in {:.0}", 10_f64.powf(d)),
                d => format!("1 in 10^{d:.0}"),
            },
        }
    }
}

/// The largest quotient of the ends of a logarithmic scale with more ticks than decades.
const MAX_FINE: f64 = 101.0;
/// The maximum length of the number at a tick; longer ones have an exponent.
const MAX_DIGITS: usize = 11;

/// Formats a value with enough digits to distinguish the ticks.
fn number(value: f64, step: f64) -> String {
    let digits = (-step.abs().max(1e-12).log10().floor()).clamp(0.0, 9.0);
    let text = format!("{value:.*}", digits as usize);
    if text.len() > MAX_DIGITS {
        return format!("{value:.3e}");
    }
    let zero = |c: char| matches!(c, '-' | '0' | '.');
    match text.chars().all(zero) {
        true => text.trim_start_matches('-').to_owned(),
        false => text,
    }
}
