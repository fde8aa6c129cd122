//! Curves over time and state bands as SVG.

use std::fmt::Write;

use super::report::Plot;
use crate::html::{COLOURS, escape_xml};

const WIDTH: f64 = 860.0;
const HEIGHT: f64 = 220.0;
const LEFT: f64 = 84.0;
const RIGHT: f64 = 12.0;
const TOP: f64 = 10.0;
const BOTTOM: f64 = 26.0;
const BAND: f64 = 30.0;
/// The maximum number of bands; more could not be distinguished.
const BANDS: usize = 400;

/// The mapping of times to the picture.
#[derive(Debug, Clone, Copy)]
pub(super) struct Span {
    pub from: f64,
    pub to: f64,
}

impl Span {
    fn x(self, seconds: f64) -> f64 {
        let at = (seconds - self.from) / (self.to - self.from).max(1e-9);
        LEFT + at.clamp(0.0, 1.0) * (WIDTH - LEFT - RIGHT)
    }
}

/// Returns about `count` round numbers from `low` to `high`.
fn ticks(low: f64, high: f64, count: f64) -> Vec<f64> {
    let rough = (high - low) / count;
    if !rough.is_finite() || rough <= 0.0 {
        return vec![low];
    }
    let decade = 10_f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0]
        .iter()
        .map(|n| n * decade)
        .find(|step| *step >= rough)
        .unwrap_or(rough);
    let first = (low / step).ceil();
    (0..40)
        .map(|n| (first + f64::from(n)) * step)
        .take_while(|at| *at <= high + step * 1e-9)
        .collect()
}

/// Formats a value with enough digits to distinguish the ticks.
fn label(value: f64, step: f64) -> String {
    let digits = (-step.abs().max(1e-12).log10().floor()).clamp(0.0, 9.0);
    let text = format!("{value:.*}", digits as usize);
    if text
        .trim_start_matches('-')
        .chars()
        .all(|c| matches!(c, '0' | '.'))
    {
        return text.trim_start_matches('-').to_owned();
    }
    text
}

fn time_axis(svg: &mut String, span: Span, height: f64) -> std::fmt::Result {
    let at = ticks(span.from, span.to, 8.0);
    let step = at.first().zip(at.get(1)).map_or(1.0, |(a, b)| b - a);
    for seconds in at {
        let x = span.x(seconds);
        writeln!(
            svg,
            "<line x1=\"{x:.1}\" y1=\"{TOP}\" x2=\"{x:.1}\" y2=\"{:.1}\" class=\"grid\"/>\
             <text x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{} s</text>",
            height - BOTTOM,
            height - BOTTOM + 16.0,
            label(seconds, step)
        )?;
    }
    Ok(())
}

fn open(title: &str, height: f64) -> String {
    format!(
        "<svg viewBox=\"0 0 {WIDTH} {height}\" role=\"img\" xmlns=\"http://www.w3.org/2000/svg\"><title>{}</title>\n",
        escape_xml(title)
    )
}

/// Draws target and actual value in one plot.
pub(super) fn curves(title: &str, plot: &Plot, span: Span) -> String {
    let all = || plot.target.iter().chain(&plot.actual);
    let low = all().map(|point| point.1).fold(f64::INFINITY, f64::min);
    let high = all().map(|point| point.2).fold(f64::NEG_INFINITY, f64::max);
    if !low.is_finite() || !high.is_finite() {
        return String::new();
    }
    let room = ((high - low) * 0.05).max(0.5e-3 * high.abs().max(1.0));
    let (low, high) = (low - room, high + room);
    let y = |value: f64| HEIGHT - BOTTOM - (value - low) / (high - low) * (HEIGHT - TOP - BOTTOM);
    let mut svg = open(title, HEIGHT);
    let _ = time_axis(&mut svg, span, HEIGHT);
    let at = ticks(low, high, 5.0);
    let step = at.first().zip(at.get(1)).map_or(1.0, |(a, b)| b - a);
    for value in at {
        let _ = writeln!(
            svg,
            "<line x1=\"{LEFT}\" y1=\"{:.1}\" x2=\"{:.1}\" y2=\"{:.1}\" class=\"grid\"/>\
             <text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
            y(value),
            WIDTH - RIGHT,
            y(value),
            LEFT - 6.0,
            y(value) + 4.0,
            label(value, step)
        );
    }
    // The actual value is drawn on top with a thinner line.
    for (colour, width, points) in [(0, 2.5, &plot.target), (1, 1.2, &plot.actual)] {
        let mut path = String::new();
        for (seconds, least, greatest) in points {
            let (x, start) = (span.x(*seconds), if path.is_empty() { 'M' } else { 'L' });
            let _ = write!(path, "{start}{x:.1} {:.1}", y(*least));
            if least != greatest {
                let _ = write!(path, "L{x:.1} {:.1}", y(*greatest));
            }
        }
        let colour = COLOURS.get(colour).copied().unwrap_or_default();
        if !path.is_empty() {
            let _ = writeln!(
                svg,
                "<path d=\"{path}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"{width}\" stroke-linejoin=\"round\"/>"
            );
        }
    }
    svg + "</svg>\n"
}

/// Draws the states as bands, with their names if there is room.
pub(super) fn bands(title: &str, states: &[(f64, String)], span: Span) -> String {
    let height = BAND + TOP + BOTTOM;
    let mut svg = open(title, height);
    let _ = time_axis(&mut svg, span, height);
    let ends = states.iter().skip(1).map(|(at, _)| *at).chain([span.to]);
    let mut names: Vec<&str> = Vec::new();
    for ((from, name), to) in states.iter().zip(ends).take(BANDS) {
        let place = names
            .iter()
            .position(|known| *known == name)
            .unwrap_or_else(|| {
                names.push(name);
                names.len() - 1
            });
        let colour = COLOURS
            .get(place % COLOURS.len())
            .copied()
            .unwrap_or_default();
        let (x, width) = (span.x(*from), (span.x(to) - span.x(*from)).max(0.5));
        let _ = writeln!(
            svg,
            "<rect x=\"{x:.1}\" y=\"{TOP}\" width=\"{width:.1}\" height=\"{BAND}\" fill=\"{colour}\" fill-opacity=\"0.25\">\
             <title>{} from {from:.6} s</title></rect>",
            escape_xml(name)
        );
        if width > 7.0 * name.chars().count() as f64 {
            let _ = writeln!(
                svg,
                "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
                x + width / 2.0,
                TOP + BAND / 2.0 + 4.0,
                escape_xml(name)
            );
        }
    }
    svg + "</svg>\n"
}
