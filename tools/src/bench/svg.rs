//! Histograms as SVG with two logarithmic axes, so that events once in a million cycles are
//! visible.

use std::fmt::Write;

use super::report::LatencySummary;
use crate::html::{COLOURS, escape_xml};
use ecaxis_master::config::duration::show as duration;

const WIDTH: f64 = 860.0;
const HEIGHT: f64 = 260.0;
const LEFT: f64 = 64.0;
const RIGHT: f64 = 12.0;
const TOP: f64 = 12.0;
const BOTTOM: f64 = 40.0;

/// Draws a chart of distributions, each with its index into [`COLOURS`].
#[must_use]
pub(super) fn chart(label: &str, all: &[(usize, &LatencySummary)]) -> String {
    let ends = || all.iter().flat_map(|(_, dist)| &dist.histogram);
    let (Some(low), Some(high)) = (
        ends().map(|(end, _)| *end).min(),
        ends().map(|(end, _)| *end).max(),
    ) else {
        return String::new();
    };
    // Round outwards to whole decades.
    let first = (low.max(1) as f64).log10().floor();
    let last = (high.max(2) as f64).log10().ceil().max(first + 1.0);
    let share = |dist: &LatencySummary, count: u64| count as f64 / dist.count.max(1) as f64;
    let rarest = all
        .iter()
        .flat_map(|(_, dist)| dist.histogram.iter().map(|(_, n)| share(dist, *n)))
        .fold(0.1, f64::min);
    let bottom = rarest.log10().floor();
    let x = |nanos: f64| {
        let at = (nanos.max(1.0).log10() - first) / (last - first);
        LEFT + at.clamp(0.0, 1.0) * (WIDTH - LEFT - RIGHT)
    };
    let y = |share: f64| {
        let at = (share.max(1e-12).log10() - bottom) / -bottom;
        HEIGHT - BOTTOM - at.clamp(0.0, 1.0) * (HEIGHT - TOP - BOTTOM)
    };
    let mut svg = format!(
        "<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" xmlns=\"http://www.w3.org/2000/svg\"><title>{}</title>\n",
        escape_xml(label)
    );
    let _ = grid(&mut svg, (first, last), bottom, &x, &y);
    for (colour, dist) in all {
        let colour = COLOURS[colour % COLOURS.len()];
        let _ = steps(&mut svg, dist, colour, &x, &y);
    }
    svg + "</svg>\n"
}

fn grid(
    svg: &mut String,
    (first, last): (f64, f64),
    bottom: f64,
    x: &dyn Fn(f64) -> f64,
    y: &dyn Fn(f64) -> f64,
) -> std::fmt::Result {
    let mut decade = first;
    while decade <= last {
        let nanos = 10_f64.powf(decade);
        let at = x(nanos);
        writeln!(
            svg,
            "<line x1=\"{at:.1}\" y1=\"{TOP}\" x2=\"{at:.1}\" y2=\"{:.1}\" class=\"grid\"/>\
             <text x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
            HEIGHT - BOTTOM,
            HEIGHT - BOTTOM + 16.0,
            duration(nanos.round() as u64)
        )?;
        decade += 1.0;
    }
    let mut decade = bottom;
    while decade <= 0.0 {
        let at = y(10_f64.powf(decade));
        let label = match -decade {
            d if d <= 0.0 => "all".to_owned(),
            d if d <= 3.0 => format!("1 in {:.0}", 10_f64.powf(d)),
            d => format!("1 in 10^{d:.0}"),
        };
        writeln!(
            svg,
            "<line x1=\"{LEFT}\" y1=\"{at:.1}\" x2=\"{:.1}\" y2=\"{at:.1}\" class=\"grid\"/>\
             <text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{label}</text>",
            WIDTH - RIGHT,
            LEFT - 6.0,
            at + 4.0
        )?;
        decade += 1.0;
    }
    Ok(())
}

/// Draws one outline with the histogram's steps, and marks at p50, p99 and p99.9.
fn steps(
    svg: &mut String,
    dist: &LatencySummary,
    colour: &str,
    x: &dyn Fn(f64) -> f64,
    y: &dyn Fn(f64) -> f64,
) -> std::fmt::Result {
    // Twenty steps per decade, see `LatencySummary`.
    let step = 10_f64.powf(1.0 / 20.0);
    let floor = HEIGHT - BOTTOM;
    let mut path = String::new();
    let mut ended = None;
    for (end, count) in &dist.histogram {
        let (from, to) = (x(*end as f64 / step), x(*end as f64));
        let top = y(*count as f64 / dist.count.max(1) as f64);
        match ended {
            Some(at) if from - at < 1.0 => write!(path, "L{at:.1} {top:.1}")?,
            Some(at) => write!(
                path,
                "L{at:.1} {floor:.1}M{from:.1} {floor:.1}L{from:.1} {top:.1}"
            )?,
            None => write!(path, "M{from:.1} {floor:.1}L{from:.1} {top:.1}")?,
        }
        write!(path, "L{to:.1} {top:.1}")?;
        ended = Some(to);
    }
    if let Some(at) = ended {
        write!(path, "L{at:.1} {floor:.1}")?;
    }
    writeln!(
        svg,
        "<path d=\"{path}\" fill=\"{colour}\" fill-opacity=\"0.14\" stroke=\"{colour}\" stroke-width=\"1.3\"/>"
    )?;
    for nanos in [Some(dist.p50_ns), dist.p99_ns, dist.p99_9_ns] {
        let Some(nanos) = nanos else { continue };
        let at = x(nanos as f64);
        writeln!(
            svg,
            "<line x1=\"{at:.1}\" y1=\"{:.1}\" x2=\"{at:.1}\" y2=\"{:.1}\" stroke=\"{colour}\" stroke-width=\"2\"/>",
            floor,
            floor + 5.0
        )?;
    }
    Ok(())
}
