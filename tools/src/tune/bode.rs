//! Bode plots for a terminal and as a page without scripts.

use std::fmt::Write as _;

use super::margins::unwrapped;
use super::response::Response;
use crate::document::escape;

/// A frequency response with its name and the unit of its gain.
#[derive(Debug, Clone, PartialEq)]
pub struct Plot {
    pub name: String,
    pub unit: String,
    pub response: Response,
    /// For each line, the part that comes from the excitation; empty if it is not known.
    pub coherence: Vec<f64>,
}

/// The points of one diagram: frequency in Hz, value.
type Curve = Vec<(f64, f64)>;

impl Plot {
    fn gain_db(&self) -> Curve {
        let points = self.response.iter();
        points
            .map(|(w, value)| (w / std::f64::consts::TAU, 20.0 * value.norm().log10()))
            .collect()
    }

    fn phase_deg(&self) -> Curve {
        let phases = unwrapped(&self.response);
        let points = self.response.iter().zip(phases);
        points
            .map(|((w, _), phase)| (w / std::f64::consts::TAU, phase.to_degrees()))
            .collect()
    }

    fn coherence(&self) -> Curve {
        let points = self.response.iter().zip(&self.coherence);
        points
            .map(|((w, _), value)| (w / std::f64::consts::TAU, *value))
            .collect()
    }
}

/// The lowest and highest value of a diagram, at whole steps.
fn range(curve: &[(f64, f64)], step: f64) -> (f64, f64) {
    let values = || curve.iter().map(|point| point.1).filter(|v| v.is_finite());
    let low = values().fold(f64::INFINITY, f64::min);
    let high = values().fold(f64::NEG_INFINITY, f64::max);
    if low > high {
        return (0.0, step);
    }
    let low = (low / step).floor() * step;
    (low, ((high / step).ceil() * step).max(low + step))
}

const COLUMNS: usize = 60;
const ROWS: usize = 10;

fn frequency(hz: f64) -> String {
    if hz < 10.0 {
        format!("{hz:.1}")
    } else {
        format!("{hz:.0}")
    }
}

/// Returns gain and phase as text, at most 80 columns wide.
#[must_use]
pub fn text(plot: &Plot) -> String {
    let mut out = String::new();
    let diagrams = [
        (plot.gain_db(), format!("dB {}", plot.unit), 10.0),
        (plot.phase_deg(), "degrees".to_owned(), 45.0),
    ];
    let _ = writeln!(out, "{}", plot.name);
    for (curve, unit, step) in diagrams {
        let (Some(first), Some(last)) = (curve.first(), curve.last()) else {
            continue;
        };
        let (low, high) = range(&curve, step);
        let width = (last.0 / first.0).ln();
        let mut rows = vec![vec![' '; COLUMNS]; ROWS];
        for (hz, value) in curve.iter().filter(|point| point.1.is_finite()) {
            let along = (hz / first.0).ln() / width * (COLUMNS - 1) as f64;
            let up = (value - low) / (high - low) * (ROWS - 1) as f64;
            let row = ROWS - 1 - (up.round() as usize).min(ROWS - 1);
            let column = (along.round() as usize).min(COLUMNS - 1);
            rows[row][column] = '*';
        }
        let _ = writeln!(out, "  {unit}");
        for (n, row) in rows.iter().enumerate() {
            let value = high - (high - low) * n as f64 / (ROWS - 1) as f64;
            let label = match n {
                0 | 9 => format!("{value:.0}"),
                _ => String::new(),
            };
            let line: String = row.iter().collect();
            let _ = writeln!(out, "{label:>6} |{}", line.trim_end());
        }
        let (left, right) = (frequency(first.0), format!("{} Hz", frequency(last.0)));
        let gap = COLUMNS.saturating_sub(left.len());
        let _ = writeln!(out, "{:>6} +{}", "", "-".repeat(COLUMNS));
        let _ = writeln!(out, "{:>6}  {left}{right:>gap$}", "");
    }
    out
}

const WIDTH: f64 = 860.0;
const HEIGHT: f64 = 220.0;
const LEFT: f64 = 60.0;

/// Draws one diagram with its grid.
fn diagram(out: &mut String, curve: &[(f64, f64)], unit: &str, (low, high): (f64, f64), step: f64) {
    let (Some(first), Some(last)) = (curve.first(), curve.last()) else {
        return;
    };
    let x = |hz: f64| LEFT + (hz / first.0).ln() / (last.0 / first.0).ln() * (WIDTH - LEFT - 10.0);
    let y = |value: f64| 10.0 + (high - value) / (high - low) * (HEIGHT - 40.0);
    let _ = write!(
        out,
        "<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{0}\"><g class=\"grid\">",
        escape(unit)
    );
    let mut level = low;
    while level <= high + 1e-9 {
        let at = y(level);
        let _ = write!(
            out,
            "<path d=\"M{LEFT} {at:.1}H{}\"/><text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{level}</text>",
            WIDTH - 10.0,
            LEFT - 6.0,
            at + 4.0
        );
        level += step;
    }
    let mut decade = 10.0_f64.powf(first.0.log10().floor());
    while decade <= last.0 {
        for n in 1..10 {
            let hz = decade * f64::from(n);
            if hz < first.0 * 0.999 || hz > last.0 * 1.001 {
                continue;
            }
            let at = x(hz);
            let _ = write!(out, "<path d=\"M{at:.1} 10V{:.1}\"/>", HEIGHT - 30.0);
            if matches!(n, 1 | 2 | 5) {
                let _ = write!(
                    out,
                    "<text x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{hz}</text>",
                    HEIGHT - 17.0
                );
            }
        }
        decade *= 10.0;
    }
    let _ = write!(
        out,
        "</g><text x=\"{LEFT}\" y=\"{:.1}\">{} over Hz</text>",
        HEIGHT - 4.0,
        escape(unit)
    );
    let points: Vec<String> = curve
        .iter()
        .filter(|point| point.1.is_finite())
        .map(|(hz, value)| format!("{:.1},{:.1}", x(*hz), y(*value)))
        .collect();
    let _ = write!(out, "<polyline points=\"{}\"/></svg>", points.join(" "));
}

/// Returns a page with the plots of an axis and a text, such as estimates and gains.
#[must_use]
pub fn page(title: &str, text: &str, plots: &[Plot]) -> String {
    let mut out = format!(
        "<!DOCTYPE html><html lang=\"en\"><meta charset=\"utf-8\"/><title>{0}</title><style>\
         body{{font:15px system-ui,sans-serif;max-width:900px;margin:2em auto;padding:0 1em;color:#222;background:#fff}}\
         pre{{background:#f4f4f4;padding:1em;overflow:auto}}\
         svg{{width:100%;display:block;margin-bottom:8px}}svg text{{font-size:11px;fill:#444}}\
         .grid path{{stroke:#ddd}}polyline{{fill:none;stroke:#0657a8;stroke-width:1.6}}\
         </style><h1>{0}</h1><pre>{1}</pre>",
        escape(title),
        escape(text)
    );
    for plot in plots {
        let _ = write!(out, "<h2>{}</h2>", escape(&plot.name));
        let gain = plot.gain_db();
        diagram(
            &mut out,
            &gain,
            &format!("dB {}", plot.unit),
            range(&gain, 10.0),
            10.0,
        );
        let phase = plot.phase_deg();
        diagram(&mut out, &phase, "degrees", range(&phase, 45.0), 45.0);
        let coherence = plot.coherence();
        diagram(&mut out, &coherence, "coherence", (0.0, 1.0), 0.25);
    }
    out.push_str("</html>\n");
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use num_complex::Complex64;

    fn plot() -> Plot {
        let lines = (1..40).map(|n| {
            let w = f64::from(n) * 10.0;
            (w, 1.0 / Complex64::new(0.0, w).powi(2))
        });
        let response: Response = lines.collect();
        Plot {
            name: "a <b>".to_owned(),
            unit: "turn/%".to_owned(),
            coherence: vec![1.0; response.len()],
            response,
        }
    }

    #[test]
    fn a_plot_has_its_ranges_and_fits_a_terminal() {
        let shown = text(&plot());
        assert!(
            shown.lines().all(|line| line.chars().count() <= 80),
            "{shown}"
        );
        assert_eq!(shown.matches("degrees").count(), 1);
        assert!(shown.contains("1.6") && shown.contains("62 Hz"), "{shown}");
        assert!(shown.contains("  -180 |*"), "{shown}");
    }

    #[test]
    fn a_page_has_three_diagrams_a_plot_and_no_markup_from_names() {
        let shown = page("x & y", "inertia", &[plot()]);
        assert_eq!(shown.matches("<svg").count(), 3);
        assert_eq!(shown.matches("<polyline").count(), 3);
        assert!(shown.contains("a &lt;b&gt;") && shown.contains("x &amp; y"));
    }

    #[test]
    fn plots_without_points_are_drawn() {
        let empty = Plot {
            response: Vec::new(),
            coherence: Vec::new(),
            ..plot()
        };
        assert!(text(&empty).contains("a <b>"));
        assert!(page("x", "", &[empty]).ends_with("</html>\n"));
    }
}
