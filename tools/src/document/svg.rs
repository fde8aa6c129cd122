//! Charts as SVG, with their data for the script of the page.
//!
//! The curves are in an inner `svg` whose `viewBox` the script changes; the scales, names and
//! markers around it are drawn again.

use std::fmt::Write;

use serde_json::{Value, json};

use super::chart::{Axis, Chart, Format, Shape};
use super::html::escape;

/// The number of colours in the style sheet, distinguishable in greyscale too.
const COLOURS: usize = 6;
const WIDTH: f64 = 860.0;
const HEIGHT: f64 = 240.0;
const LEFT: f64 = 84.0;
const RIGHT: f64 = 36.0;
const TOP: f64 = 24.0;
const BOTTOM: f64 = 28.0;
/// The height of a band.
const BAND: f64 = 30.0;
/// The maximum number of bands; more could not be distinguished.
const BANDS: usize = 400;
/// The width of a letter of a band's name.
const LETTER: f64 = 7.0;
/// A curve ends before a distance of its points that exceeds this multiple of the usual one.
const GAP: f64 = 4.0;

impl Chart {
    /// Returns the figure; nothing without a value.
    pub(super) fn html(&self) -> String {
        if self.series.iter().all(|series| series.shape.is_empty()) {
            return String::new();
        }
        let inner = self.y.as_ref().map_or(BAND, |_| HEIGHT - TOP - BOTTOM);
        let (height, width) = (inner + TOP + BOTTOM, WIDTH - LEFT - RIGHT);
        let title = escape(&self.title);
        let mut svg = format!(
            "<figure><figcaption>{title}</figcaption>\
             <svg viewBox=\"0 0 {WIDTH} {height}\" role=\"img\" tabindex=\"0\" \
             xmlns=\"http://www.w3.org/2000/svg\"><title>{title}</title>\n<g class=\"scale\">\n"
        );
        let floor = height - BOTTOM;
        let x = |value: f64| self.x.place(value) * width;
        let y = |value: f64| inner - self.y.as_ref().map_or(0.0, |y| y.place(value)) * inner;
        for (value, label) in self.x.ticks(8.0) {
            let at = LEFT + x(value);
            line(&mut svg, (at, TOP), (at, floor));
            text(&mut svg, (at, floor + 19.0), "middle", &label);
        }
        for (value, label) in self.y.iter().flat_map(|y| y.ticks(5.0)) {
            let at = TOP + y(value);
            line(&mut svg, (LEFT, at), (WIDTH - RIGHT, at));
            text(&mut svg, (LEFT - 6.0, at + 4.0), "end", &label);
        }
        svg += "</g>\n";
        if let Some(unit) = self.y.as_ref().map(unit) {
            let unit = escape(unit);
            let at = format!("x=\"{LEFT}\" y=\"{}\"", TOP - 13.0);
            svg += &format!("<text {at} class=\"unit\" text-anchor=\"middle\">{unit}</text>\n");
        }
        let place = format!("x=\"{LEFT}\" y=\"{TOP}\" width=\"{width}\" height=\"{inner}\"");
        svg += &format!(
            "<svg class=\"plot\" {place} viewBox=\"0 0 {width} {inner}\" preserveAspectRatio=\"none\">\n"
        );
        let mut names = String::new();
        let mut legend = String::new();
        for (n, series) in self.series.iter().enumerate() {
            let colour = n % COLOURS;
            match &series.shape {
                shape if shape.is_empty() => continue,
                Shape::Curve(points) => curve(&mut svg, points, colour, &x, &y),
                Shape::Histogram { steps, marks } => {
                    outline(&mut svg, steps, colour, inner, &x, &y);
                    for mark in marks {
                        let way = format!("M{:.2} {inner:.2}v-7", x(*mark));
                        path(&mut svg, &way, colour, "mark");
                    }
                }
                Shape::Bands(states) => {
                    bands((&mut svg, &mut names), states, self.x.high, &x);
                }
            }
            let name = escape(&series.name);
            let key = match series.shape {
                Shape::Bands(_) => String::new(),
                _ => format!("<span class=\"key s{colour}\"></span>"),
            };
            let output = format!("<output data-series=\"{n}\"></output>");
            legend += &format!("<span class=\"entry\">{key}{name} {output}</span>\n");
        }
        svg += "</svg>\n<g class=\"names\">\n";
        svg += &names;
        svg += "</g>\n<g class=\"markers\">\n";
        for (n, marker) in self.markers.iter().enumerate() {
            let (at, length) = (LEFT + x(marker.at), inner);
            let _ = writeln!(
                svg,
                "<g data-marker=\"{n}\" transform=\"translate({at:.2} {TOP})\"><title>{}</title>\
                 <path d=\"M0 0v{length}\"/><path class=\"head\" d=\"M-5 -8h10l-5 8z\"/></g>",
                escape(&marker.text)
            );
        }
        let data = self.data(width, inner).to_string();
        // Neither HTML nor XML ends the script at such a letter.
        let data = data.replace('<', "\\u003c").replace('&', "\\u0026");
        let data = data.replace('>', "\\u003e");
        format!(
            "{svg}</g>\n</svg>\n<p class=\"legend\">{legend}<output class=\"at\"></output></p>\
             <script type=\"application/json\">{data}</script></figure>\n"
        )
    }

    /// Returns the values and the layout for the script.
    fn data(&self, width: f64, height: f64) -> Value {
        let series = self.series.iter().map(|series| match &series.shape {
            Shape::Curve(points) => {
                let gap = gap(points);
                let points = points.iter().map(|(at, low, high)| match low == high {
                    true => json!([micro(*at), low]),
                    false => json!([micro(*at), low, high]),
                });
                json!({ "gap": gap, "points": points.collect::<Value>() })
            }
            Shape::Histogram { steps, .. } => json!({ "steps": steps }),
            Shape::Bands(states) => json!({ "bands": states.get(..states.len().min(BANDS)) }),
        });
        let layout = json!({ "left": LEFT, "top": TOP, "width": width, "height": height });
        json!({
            "x": self.x, "y": self.y, "series": series.collect::<Value>(),
            "markers": self.markers, "layout": layout,
        })
    }
}

/// Returns the unit of an axis.
fn unit(axis: &Axis) -> &str {
    match axis.format {
        Format::Number => &axis.unit,
        Format::Seconds => "s",
        Format::Duration => "ns",
        Format::Share => "share of cycles",
    }
}

/// Rounds a time in s to µs.
fn micro(seconds: f64) -> f64 {
    (seconds * 1e6).round() / 1e6
}

/// Returns the distance of two points that ends a curve.
fn gap(points: &[(f64, f64, f64)]) -> Option<f64> {
    let pairs = points.windows(2).filter_map(|pair| match pair {
        [a, b] => Some(b.0 - a.0),
        _ => None,
    });
    let mut distances: Vec<f64> = pairs.collect();
    distances.sort_by(f64::total_cmp);
    Some(distances.get(distances.len() / 2)? * GAP).filter(|gap| *gap > 0.0)
}

fn line(svg: &mut String, (x1, y1): (f64, f64), (x2, y2): (f64, f64)) {
    let _ = writeln!(
        svg,
        r#"<line x1="{x1:.1}" y1="{y1:.1}" x2="{x2:.1}" y2="{y2:.1}"/>"#
    );
}

fn text(svg: &mut String, (x, y): (f64, f64), anchor: &str, text: &str) {
    let text = escape(text);
    let _ = writeln!(
        svg,
        r#"<text x="{x:.1}" y="{y:.1}" text-anchor="{anchor}">{text}</text>"#
    );
}

fn path(svg: &mut String, path: &str, colour: usize, class: &str) {
    let _ = writeln!(svg, r#"<path d="{path}" class="{class} s{colour}"/>"#);
}

type ToPixel<'a> = &'a dyn Fn(f64) -> f64;

fn curve(
    svg: &mut String,
    points: &[(f64, f64, f64)],
    colour: usize,
    x: ToPixel<'_>,
    y: ToPixel<'_>,
) {
    let gap = gap(points).unwrap_or(f64::INFINITY);
    let mut way = String::new();
    let mut before = f64::NEG_INFINITY;
    for (at, least, greatest) in points {
        let start = if at - before > gap { 'M' } else { 'L' };
        let _ = write!(way, "{start}{:.3} {:.2}", x(*at), y(*least));
        if least != greatest {
            let _ = write!(way, "V{:.2}", y(*greatest));
        }
        before = *at;
    }
    if before.is_finite() && !way.starts_with('M') {
        way.replace_range(..1, "M");
    }
    path(svg, &way, colour, "curve");
}

/// Draws the outline of the steps; a gap between two of them falls to the axis.
fn outline(
    svg: &mut String,
    steps: &[(f64, f64, f64)],
    colour: usize,
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
            _ if way.is_empty() => way += &format!("M{from:.2} {floor:.2}"),
            _ => way += &format!("V{floor:.2}H{from:.2}"),
        }
        let _ = write!(way, "V{top:.2}H{to:.2}");
        end = Some(to);
    }
    path(svg, &format!("{way}V{floor:.2}"), colour, "area");
}

/// Draws the states as bands, with their names if there is room.
fn bands(
    (svg, shown): (&mut String, &mut String),
    states: &[(f64, String)],
    end: f64,
    x: ToPixel<'_>,
) {
    let ends = states.iter().skip(1).map(|(at, _)| *at).chain([end]);
    let mut names: Vec<&str> = Vec::new();
    for ((from, name), to) in states.iter().zip(ends).take(BANDS) {
        if !names.contains(&name.as_str()) {
            names.push(name);
        }
        let place = names.iter().position(|known| known == name).unwrap_or(0);
        let colour = place % COLOURS;
        let (left, width) = (x(*from), (x(to) - x(*from)).max(0.5));
        let _ = writeln!(
            svg,
            "<rect x=\"{left:.3}\" width=\"{width:.3}\" height=\"{BAND}\" class=\"band s{colour}\">\
             <title>{} from {from:.6} s</title></rect>",
            escape(name)
        );
        if width > LETTER * name.chars().count() as f64 {
            let middle = (LEFT + left + width / 2.0, TOP + BAND / 2.0 + 4.0);
            text(shown, middle, "middle", name);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Marker, Series};
    use super::*;

    #[test]
    fn curve_ends_where_points_are_missing() {
        let point = |at: f64| (at, at, at);
        let points: Vec<_> = [0.0, 1.0, 2.0, 3.0, 9.0, 10.0].map(point).into();
        let mut svg = String::new();
        curve(&mut svg, &points, 0, &|x| x, &|y| y);
        assert_eq!(svg.matches('M').count(), 2, "{svg}");
        let mut svg = String::new();
        curve(&mut svg, &[point(1.0)], 0, &|x| x, &|y| y);
        assert_eq!(svg.matches('M').count(), 1, "{svg}");
    }

    #[test]
    fn data_cannot_end_the_script() {
        let chart = Chart {
            title: "x".to_owned(),
            x: Axis::of_numbers(0.0, 1.0, "mm"),
            y: Some(Axis::of_numbers(0.0, 1.0, "mm")),
            series: vec![Series {
                name: "a".to_owned(),
                shape: Shape::Curve(vec![(0.0, 1.0, 1.0)]),
            }],
            markers: vec![Marker {
                at: 0.5,
                text: "</script><b>&".to_owned(),
            }],
        };
        let html = chart.html();
        assert_eq!(html.matches("</script>").count(), 1, "{html}");
        assert!(
            !html.contains("<b>") && html.contains("\\u003cb\\u003e\\u0026"),
            "{html}"
        );
    }
}
