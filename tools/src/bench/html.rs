//! The report as one XHTML file with embedded drawings and without external resources.

use std::fmt::Write;

use super::report::{Fact, LatencySummary, Ratio, Report, Variant, losses};
use super::svg::chart;
use crate::html::{self, escape_xml, legend_entry, time};

/// Returns the complete document.
#[must_use]
pub fn html(report: &Report) -> String {
    let mut out = html::head("Timing of an EtherCAT cycle");
    // Writing to a String cannot fail.
    let _ = sections(&mut out, report);
    out + html::END
}

fn sections(out: &mut String, report: &Report) -> std::fmt::Result {
    writeln!(out, "<h2>What was measured</h2>")?;
    facts(out, &report.settings)?;
    writeln!(out, "<h2>On which computer</h2>")?;
    facts(out, &report.facts)?;
    if !report.findings.is_empty() {
        writeln!(
            out,
            "<p>Settings that disturb a cycle (<code>ecaxis doctor</code> shows their effect and the fix):</p><ul>"
        )?;
        for finding in &report.findings {
            writeln!(out, "<li>{}</li>", escape_xml(finding))?;
        }
        writeln!(out, "</ul>")?;
    }
    if !report.remarks.is_empty() {
        writeln!(out, "<h2>To be kept in mind</h2><ul>")?;
        for remark in &report.remarks {
            writeln!(out, "<li>{}</li>", escape_xml(remark))?;
        }
        writeln!(out, "</ul>")?;
    }
    for (title, what, get) in MEASURES {
        measure(out, report, title, what, get)?;
    }
    counters(out, report)?;
    writeln!(
        out,
        "<footer>ecaxis {}. Percentiles: p99 is what 99 of 100 cycles did not exceed. Both axes of the drawings are \
         logarithmic; the marks below them are p50, p99 and p99.9.</footer>",
        escape_xml(report.version)
    )
}

type Get = fn(&Variant) -> Option<&LatencySummary>;

/// The measures with a table and a drawing.
pub(super) const MEASURES: [(&str, &str, Get); 4] = [
    (
        "Wake-up lateness",
        "How long after its planned time a cycle began. Its frames leave at once then, so this is the jitter of their release.",
        |v| v.wake_up_lateness.as_ref(),
    ),
    (
        "Release to input",
        "From the planned release of the frames until their answers were there.",
        |v| v.release_to_input.as_ref(),
    ),
    (
        "Work",
        "From the wake-up until the next cycle was ready to be sent; waiting for answers is part of it unless the exchange is pipelined.",
        |v| v.work.as_ref(),
    ),
    (
        "Phase error",
        "How far from their place in the cycle of SYNC0 the frames passed the reference clock.",
        |v| v.phase_error.as_ref(),
    ),
];

fn facts(out: &mut String, facts: &[Fact]) -> std::fmt::Result {
    writeln!(out, "<table class=\"facts\"><tbody>")?;
    for fact in facts {
        writeln!(
            out,
            "<tr><td>{}</td><td>{}</td></tr>",
            escape_xml(fact.name),
            escape_xml(&fact.value)
        )?;
    }
    writeln!(out, "</tbody></table>")
}

/// Formats a quotient with two significant digits.
#[must_use]
pub(super) fn times(value: Option<f64>) -> String {
    match value {
        None => "–".to_owned(),
        Some(v) if v >= 10.0 => format!("{v:.0} ×"),
        Some(v) if v >= 1.0 => format!("{v:.2} ×"),
        Some(v) if v >= 0.1 => format!("{v:.2} ×"),
        Some(v) => format!("{v:.3} ×"),
    }
}

fn measure(
    out: &mut String,
    report: &Report,
    title: &str,
    what: &str,
    get: Get,
) -> std::fmt::Result {
    let all: Vec<(usize, &Variant, &LatencySummary)> = report
        .variants
        .iter()
        .enumerate()
        .filter_map(|(place, v)| Some((place, v, get(v)?)))
        .collect();
    if all.is_empty() {
        return Ok(());
    }
    writeln!(out, "<h2>{title}</h2><p>{what}</p>")?;
    let drawn: Vec<(usize, &LatencySummary)> =
        all.iter().map(|(place, _, dist)| (*place, *dist)).collect();
    out.push_str(&chart(title, &drawn));
    writeln!(
        out,
        "<table><thead><tr><th></th><th>p50</th><th>p99</th><th>p99.9</th><th>longest</th><th>cycles</th></tr></thead><tbody>"
    )?;
    for (place, variant, dist) in &all {
        writeln!(
            out,
            "<tr><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td></tr>",
            legend_entry(*place, &variant.name),
            time(dist.p50_ns),
            dist.p99_ns.map_or_else(|| "–".to_owned(), time),
            dist.p99_9_ns.map_or_else(|| "–".to_owned(), time),
            time(dist.max_ns),
            dist.count
        )?;
    }
    let belongs = |ratio: &&Ratio| ratio.measure.title() == title && ratio.value.is_none();
    for ratio in report.ratios.iter().filter(belongs) {
        writeln!(
            out,
            "<tr class=\"ratio\"><td>{} ∕ {}{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td></td></tr>",
            escape_xml(&ratio.of),
            escape_xml(&ratio.to),
            ratio.measure.note(),
            times(ratio.p50),
            times(ratio.p99),
            times(ratio.p99_9),
            times(ratio.max)
        )?;
    }
    writeln!(out, "</tbody></table>")
}

fn counters(out: &mut String, report: &Report) -> std::fmt::Result {
    writeln!(
        out,
        "<h2>Counted</h2><table><thead><tr><th></th><th>cycles</th><th>lost</th><th>not the bus's</th><th>late frames</th>\
         <th>overruns</th><th>CPU a cycle</th><th>switches a cycle</th><th>page faults</th></tr></thead><tbody>"
    )?;
    let number = |n: Option<u64>| n.map_or_else(|| "–".to_owned(), |n| n.to_string());
    for (place, variant) in report.variants.iter().enumerate() {
        let counters = variant.counters;
        writeln!(
            out,
            "<tr><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td></tr>",
            legend_entry(place, &variant.name),
            variant.cycles,
            number(counters.map(|c| c.lost_frames)),
            number(losses(variant).map(|(_, ours)| ours)),
            number(counters.map(|c| c.late_frames)),
            number(counters.map(|c| c.overruns)),
            variant
                .cpu_ns_per_cycle
                .map_or_else(|| "–".to_owned(), |ns| time(ns as u64)),
            variant
                .context_switches_per_cycle
                .map_or_else(|| "–".to_owned(), |n| format!("{n:.2}")),
            number(variant.used.map(|u| u.minor_faults + u.major_faults)),
        )?;
    }
    writeln!(out, "</tbody></table>")?;
    for ratio in report.ratios.iter().filter(|ratio| ratio.value.is_some()) {
        writeln!(
            out,
            "<p>{}, {} ∕ {}: {}</p>",
            ratio.measure.name(),
            escape_xml(&ratio.of),
            escape_xml(&ratio.to),
            times(ratio.value)
        )?;
    }
    Ok(())
}
