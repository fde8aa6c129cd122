//! Shared parts of the reports: each report is one self-contained XHTML file with inline style.

use ecaxis_master::config::duration::show as duration;

/// The colours of curves, distinguishable in greyscale too.
pub(crate) const COLOURS: [&str; 6] = [
    "#0b6e99", "#c2410c", "#6d28d9", "#15803d", "#a16207", "#be185d",
];

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;max-width:900px;margin:2em auto;padding:0 1em;color:#1a1a1a}\
h1{font-size:1.5em}h2{font-size:1.15em;margin-top:2em}h3{font-size:1em;margin-bottom:0}table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums}\
th,td{text-align:right;padding:.25em .6em;border-bottom:1px solid #ddd}th:first-child,td:first-child{text-align:left}\
th{font-weight:600}tr.ratio td{color:#555}svg{width:100%;height:auto;margin:.5em 0}svg text{font-size:11px;fill:#444}\
.grid{stroke:#e5e5e5}.key{display:inline-block;width:.8em;height:.8em;margin-right:.4em}.facts td{text-align:left}\
.facts td:first-child{width:11em;color:#555}li{margin:.3em 0}footer{margin-top:2em;color:#777;font-size:.9em}";

/// Escapes `&`, `<`, `>` and quotes, and removes characters that XML does not allow.
#[must_use]
pub(crate) fn escape_xml(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out += "&amp;",
            '<' => out += "&lt;",
            '>' => out += "&gt;",
            '"' => out += "&quot;",
            '\'' => out += "&#39;",
            '\u{fffe}' | '\u{ffff}' => {}
            c if c.is_control() && !matches!(c, '\n' | '\t') => {}
            c => out.push(c),
        }
    }
    out
}

/// Returns the document up to the first section.
#[must_use]
pub(crate) fn head(title: &str) -> String {
    let title = escape_xml(title);
    format!(
        "<!DOCTYPE html>\n<html xmlns=\"http://www.w3.org/1999/xhtml\" lang=\"en\"><head><meta charset=\"utf-8\"/>\
         <meta name=\"viewport\" content=\"width=device-width\"/><title>{title}</title>\
         <style>{STYLE}</style></head><body>\n<h1>{title}</h1>\n"
    )
}

/// The document after the last section.
pub(crate) const END: &str = "</body></html>\n";

/// Returns the legend entry of the curve at `place`.
#[must_use]
pub(crate) fn legend_entry(place: usize, name: &str) -> String {
    let colour = COLOURS[place % COLOURS.len()];
    format!(
        "<span class=\"key\" style=\"background:{colour}\"></span>{}",
        escape_xml(name)
    )
}

/// Formats a time with three digits and a unit.
#[must_use]
pub fn time(nanos: u64) -> String {
    let digits = |value: f64| match value {
        v if v >= 99.95 => 0,
        v if v >= 9.995 => 1,
        _ => 2,
    };
    let (value, unit) = match nanos {
        0..1_000 => return duration(nanos),
        1_000..1_000_000 => (nanos as f64 / 1e3, "µs"),
        1_000_000..1_000_000_000 => (nanos as f64 / 1e6, "ms"),
        _ => (nanos as f64 / 1e9, "s"),
    };
    format!("{value:.*} {unit}", digits(value))
}
