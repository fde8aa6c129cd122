//! Charts as data, and as SVG: curves and histograms on two scales, states as bands.

use std::fmt::Write;

use super::html::escape;

/// The colours of the series, distinguishable in greyscale too.
const COLOURS: [&str; 6] = [
    "#0b6e99", "#c2410c", "#6d28d9", "#15803d", "#a16207", "#be185d",
];
const WIDTH: f64 = 860.0;
const HEIGHT: f64 = 240.0;
const LEFT: f64 = 84.0;
const RIGHT: f64 = 12.0;
const TOP: f64 = 10.0;
const BOTTOM: f64 = 30.0;
/// The height of a band.
const BAND: f64 = 30.0;
/// The maximum number of bands; more could not be distinguished.
const BANDS: usize = 400;

/// A picture of one or more series.
#[derive(Debug, Clone)]
pub struct Chart {
    pub title: String,
    pub x: Axis,
    /// `None`: bands, which have no scale.
    pub y: Option<Axis>,
    /// A series without values keeps its colour for the same series of another chart.
    pub series: Vec<Series>,
}

/// A scale from `low` to `high`.
#[derive(Debug, Clone, Copy)]
pub struct Axis {
    pub low: f64,
    pub high: f64,
    pub logarithmic: bool,
    /// Formats a tick; the second argument is the distance of the ticks.
    pub label: fn(f64, f64) -> String,
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

impl Shape {
    fn is_empty(&self) -> bool {
        match self {
            Self::Curve(points) => points.is_empty(),
            Self::Histogram { steps, .. } => steps.is_empty(),
            Self::Bands(states) => states.is_empty(),
        }
    }
}

impl Axis {
    /// Returns the place of a value from 0 to 1.
    fn place(&self, value: f64) -> f64 {
        let scale = |v: f64| match self.logarithmic {
            true => v.max(1e-12).log10(),
            false => v,
        };
        let (low, high) = (scale(self.low), scale(self.high));
        ((scale(value) - low) / (high - low).max(1e-9)).clamp(0.0, 1.0)
    }

    /// Returns about `count` round numbers, or the decades of a logarithmic scale.
    fn ticks(&self, count: f64) -> Vec<(f64, String)> {
        if self.logarithmic {
            let decades = (self.low.log10().round() as i32)..=(self.high.log10().round() as i32);
            let values = decades.map(|decade| 10_f64.powi(decade));
            return values.map(|at| (at, (self.label)(at, at))).collect();
        }
        let rough = (self.high - self.low) / count;
        if !rough.is_finite() || rough <= 0.0 {
            return vec![(self.low, (self.label)(self.low, 1.0))];
        }
        let decade = 10_f64.powf(rough.log10().floor());
        let steps = [1.0, 2.0, 5.0, 10.0].map(|n| n * decade);
        let step = steps.into_iter().find(|step| *step >= rough);
        let step = step.unwrap_or(rough);
        let first = (self.low / step).ceil();
        (0..40)
            .map(|n| (first + f64::from(n)) * step)
            .take_while(|at| *at <= self.high + step * 1e-9)
            .map(|at| (at, (self.label)(at, step)))
            .collect()
    }

    /// Formats a value with enough digits to distinguish the ticks.
    #[must_use]
    pub fn number(value: f64, step: f64) -> String {
        let digits = (-step.abs().max(1e-12).log10().floor()).clamp(0.0, 9.0);
        let text = format!("{value:.*}", digits as usize);
        let zero = |c: char| matches!(c, '-' | '0' | '.');
        match text.chars().all(zero) {
            true => text.trim_start_matches('-').to_owned(),
            false => text,
        }
    }
}

impl Chart {
    /// Returns the SVG and the legend; nothing without a value.
    pub(super) fn html(&self) -> String {
        if self.series.iter().all(|series| series.shape.is_empty()) {
            return String::new();
        }
        let (height, title) = match self.y {
            Some(_) => (HEIGHT, escape(&self.title)),
            None => (BAND + TOP + BOTTOM, escape(&self.title)),
        };
        let mut svg = format!(
            "<p>{title}</p><svg viewBox=\"0 0 {WIDTH} {height}\" role=\"img\" xmlns=\"http://www.w3.org/2000/svg\">\
             <title>{title}</title>\n"
        );
        let floor = height - BOTTOM;
        let x = |value: f64| LEFT + self.x.place(value) * (WIDTH - LEFT - RIGHT);
        let y = |value: f64| floor - self.y.map_or(0.0, |y| y.place(value)) * (floor - TOP);
        for (value, label) in self.x.ticks(8.0) {
            let (x, below) = (x(value), floor + 16.0);
            line(&mut svg, (x, TOP), (x, floor));
            text(&mut svg, (x, below), "middle", &label);
        }
        for (value, label) in self.y.iter().flat_map(|y| y.ticks(5.0)) {
            line(&mut svg, (LEFT, y(value)), (WIDTH - RIGHT, y(value)));
            text(&mut svg, (LEFT - 6.0, y(value) + 4.0), "end", &label);
        }
        let mut legend = String::new();
        for (series, colour) in self.series.iter().zip(COLOURS.into_iter().cycle()) {
            match &series.shape {
                shape if shape.is_empty() => continue,
                Shape::Curve(points) => curve(&mut svg, points, colour, &x, &y),
                Shape::Histogram { steps, marks } => {
                    outline(&mut svg, steps, colour, floor, &x, &y);
                    for mark in marks {
                        let at = x(*mark);
                        let mark = format!("M{at:.1} {floor:.1}v5");
                        path(&mut svg, &mark, colour, r#"stroke-width="2""#);
                    }
                }
                Shape::Bands(states) => bands(&mut svg, states, self.x.high, &x),
            }
            if !series.name.is_empty() {
                let name = escape(&series.name);
                let key = format!("<span class=\"key\" style=\"background:{colour}\"></span>");
                legend += &format!("{key}{name}");
            }
        }
        format!("{svg}</svg>\n<p>{legend}</p>\n")
    }
}

fn line(svg: &mut String, (x1, y1): (f64, f64), (x2, y2): (f64, f64)) {
    let _ = writeln!(
        svg,
        r#"<line x1="{x1:.1}" y1="{y1:.1}" x2="{x2:.1}" y2="{y2:.1}" class="grid"/>"#
    );
}

fn text(svg: &mut String, (x, y): (f64, f64), anchor: &str, text: &str) {
    let text = escape(text);
    let _ = writeln!(
        svg,
        r#"<text x="{x:.1}" y="{y:.1}" text-anchor="{anchor}">{text}</text>"#
    );
}

fn path(svg: &mut String, path: &str, colour: &str, attributes: &str) {
    let _ = writeln!(
        svg,
        r#"<path d="{path}" stroke="{colour}" fill="{colour}" {attributes}/>"#
    );
}

type ToPixel<'a> = &'a dyn Fn(f64) -> f64;

fn curve(
    svg: &mut String,
    points: &[(f64, f64, f64)],
    colour: &str,
    x: ToPixel<'_>,
    y: ToPixel<'_>,
) {
    let mut way = String::new();
    for (at, least, greatest) in points {
        let start = if way.is_empty() { 'M' } else { 'L' };
        let _ = write!(way, "{start}{:.1} {:.1}", x(*at), y(*least));
        if least != greatest {
            let _ = write!(way, "V{:.1}", y(*greatest));
        }
    }
    let line = r#"fill-opacity="0" stroke-width="1.5" stroke-linejoin="round""#;
    path(svg, &way, colour, line);
}

/// Draws the outline of the steps; a gap between two of them falls to the axis.
fn outline(
    svg: &mut String,
    steps: &[(f64, f64, f64)],
    colour: &str,
    floor: f64,
    x: ToPixel<'_>,
    y: ToPixel<'_>,
) {
    let mut way = String::new();
    let mut end: Option<f64> = None;
    for (from, to, height) in steps {
        let (from, to, top) = (x(*from), x(*to), y(*height));
        match end {
            Some(end) if from - end < 1.0 => {}
            _ if way.is_empty() => way += &format!("M{from:.1} {floor:.1}"),
            _ => way += &format!("V{floor:.1}H{from:.1}"),
        }
        let _ = write!(way, "V{top:.1}H{to:.1}");
        end = Some(to);
    }
    let area = r#"fill-opacity="0.14" stroke-width="1.3""#;
    path(svg, &format!("{way}V{floor:.1}"), colour, area);
}

/// Draws the states as bands, with their names if there is room.
fn bands(svg: &mut String, states: &[(f64, String)], end: f64, x: ToPixel<'_>) {
    let ends = states.iter().skip(1).map(|(at, _)| *at).chain([end]);
    let mut names: Vec<&str> = Vec::new();
    for ((from, name), to) in states.iter().zip(ends).take(BANDS) {
        if !names.contains(&name.as_str()) {
            names.push(name);
        }
        let place = names.iter().position(|known| known == name).unwrap_or(0);
        let colour = COLOURS[place % COLOURS.len()];
        let (left, width) = (x(*from), (x(to) - x(*from)).max(0.5));
        let _ = writeln!(
            svg,
            "<rect x=\"{left:.1}\" y=\"{TOP}\" width=\"{width:.1}\" height=\"{BAND}\" fill=\"{colour}\" \
             fill-opacity=\"0.25\"><title>{} from {from:.6} s</title></rect>",
            escape(name)
        );
        if width > 7.0 * name.chars().count() as f64 {
            let middle = (left + width / 2.0, TOP + BAND / 2.0 + 4.0);
            text(svg, middle, "middle", name);
        }
    }
}
