//! The report as a document.

use ecaxis_master::text::pluralize;

use super::report::{LatencySummary, Measure, Report, Variant, losses};
use crate::cells;
use crate::document::format::{or_dash, time};
use crate::document::{Axis, Chart, Document, Format, Series, Shape, Table};
use crate::host::Fact;
use crate::host::counters::CpuTimeDelta;

/// Returns the whole report.
#[must_use]
pub fn document(report: &Report) -> Document {
    let mut out = Document::new("Timing of an EtherCAT cycle");
    let (text, bad) = result(report);
    out.lead(text, bad);
    out.section("Measured", facts(&report.settings));
    out.section("Computer", facts(&report.facts));
    for (title, explanation, get) in MEASURES {
        measure(&mut out, report, title, explanation, get);
    }
    counters(&mut out, report);
    if !report.remarks.is_empty() || !report.findings.is_empty() {
        out.heading("Remarks");
    }
    for remark in &report.remarks {
        out.item("note: ", remark);
    }
    if !report.findings.is_empty() {
        let count = report.findings.len();
        let what = "what disturbs a cycle on this computer, and how to fix it: ecaxis doctor";
        out.item("note: ", format!("{count} findings of {what}"));
    }
    for finding in &report.findings {
        out.item("- ", finding);
    }
    out
}

/// Returns the main result of the first variant, and whether frames were lost or cycles overrun.
fn result(report: &Report) -> (String, bool) {
    let Some(first) = report.variants.first() else {
        return ("Nothing was measured.".to_owned(), true);
    };
    let mut parts = vec![format!("{}: {} cycles", first.name, first.cycles)];
    for (what, times) in [
        ("wake-up at most {} late", &first.wake_up_lateness),
        (
            "input at most {} after the release",
            &first.release_to_input,
        ),
    ] {
        let times = times.as_ref();
        parts.extend(times.map(|times| what.replace("{}", &time(times.max_ns))));
    }
    let counters = first.counters;
    let bad = counters.is_some_and(|c| c.lost_frames + c.late_frames + c.overruns > 0);
    parts.extend(counters.map(|c| {
        format!(
            "{} lost, {} late, {}",
            pluralize(c.lost_frames as usize, "frame"),
            c.late_frames,
            pluralize(c.overruns as usize, "overrun")
        )
    }));
    (parts.join(", "), bad)
}

fn facts(facts: &[Fact]) -> Table {
    let mut table = Table::new("");
    for fact in facts {
        table.row(cells![format!("{:<14}", fact.name), fact.value]);
    }
    table
}

type Get = fn(&Variant) -> Option<&LatencySummary>;

/// The measures with a table and a chart.
const MEASURES: [(&str, &str, Get); 4] = [
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

/// Formats a quotient with two significant digits.
fn quotient(value: f64) -> String {
    match value {
        v if v >= 10.0 => format!("{v:.0} ×"),
        v if v >= 0.1 => format!("{v:.2} ×"),
        v => format!("{v:.3} ×"),
    }
}

fn measure(out: &mut Document, report: &Report, title: &str, explanation: &str, get: Get) {
    let mut table = Table::new("|p50|p99|p99.9|longest|cycles");
    for variant in &report.variants {
        let Some(times) = get(variant) else { continue };
        table.row(cells![
            variant.name,
            time(times.p50_ns),
            or_dash(times.p99_ns.map(time)),
            or_dash(times.p99_9_ns.map(time)),
            time(times.max_ns),
            times.count,
        ]);
    }
    if table.is_empty() {
        return;
    }
    for ratio in &report.ratios {
        if ratio.measure.title() == title {
            let name = format!("{} ∕ {}{}", ratio.of, ratio.to, ratio.measure.note());
            let all = [ratio.p50, ratio.p99, ratio.p99_9, ratio.max];
            let [p50, p99, p99_9, max] = all.map(|ratio| or_dash(ratio.map(quotient)));
            table.row(cells![name, p50, p99, p99_9, max, ""]);
        }
    }
    out.heading(title);
    out.line(explanation);
    out.chart(chart(title, &report.variants, get));
    out.table(table);
}

/// Returns the histograms on two logarithmic scales, so that events once in a million cycles are
/// visible.
fn chart(title: &str, variants: &[Variant], get: Get) -> Chart {
    // Twenty steps per decade, see `LatencySummary`.
    let step = 10_f64.powf(1.0 / 20.0);
    let (mut least, mut most, mut rarest) = (f64::INFINITY, 1.0, 0.1);
    let series = variants.iter().map(|variant| {
        let (mut steps, mut marks) = (Vec::new(), Vec::new());
        if let Some(times) = get(variant) {
            for (end, count) in &times.histogram {
                let (end, share) = (*end as f64, *count as f64 / times.count.max(1) as f64);
                (least, most) = (end.min(least), end.max(most));
                rarest = share.min(rarest);
                steps.push((end / step, end, share));
            }
            let percentiles = [Some(times.p50_ns), times.p99_ns, times.p99_9_ns];
            marks = percentiles.iter().flatten().map(|ns| *ns as f64).collect();
        }
        let (name, shape) = (variant.name.clone(), Shape::Histogram { steps, marks });
        Series { name, shape }
    });
    let series = series.collect();
    // Round outwards to whole decades.
    let decade = |exponent: f64| 10_f64.powf(exponent);
    let first = least.clamp(1.0, most).log10().floor();
    Chart {
        title: format!("{title} (marks on the axis: p50, p99, p99.9)"),
        x: Axis {
            logarithmic: true,
            format: Format::Duration,
            ..Axis::of_numbers(
                decade(first),
                decade(most.log10().ceil().max(first + 1.0)),
                "ns",
            )
        },
        y: Some(Axis {
            logarithmic: true,
            format: Format::Share,
            ..Axis::of_numbers(decade(rarest.log10().floor()), 1.0, "")
        }),
        series,
        markers: Vec::new(),
    }
}

fn counters(out: &mut Document, report: &Report) {
    let mut table = Table::new("|CPU|of a CPU|switches|spinning");
    for v in &report.variants {
        table.row(cells![
            v.name,
            or_dash(v.cpu_ns_per_cycle.map(|ns| time(ns as u64))),
            or_dash(v.cpu_percent.map(|p| format!("{p:.1} %"))),
            or_dash(v.context_switches_per_cycle.map(|n| format!("{n:.2}"))),
            or_dash(v.spin_ns.map(time)),
        ]);
    }
    for ratio in &report.ratios {
        if ratio.measure == Measure::CpuPerCycle {
            let name = format!("{} ∕ {}", ratio.of, ratio.to);
            let value = or_dash(ratio.value.map(quotient));
            table.row(cells![name, value, "", "", ""]);
        }
    }
    out.section("Per cycle", table);
    let mut table = Table::new("|cycles|lost|late|overruns");
    for v in &report.variants {
        table.row(cells![
            v.name,
            v.cycles,
            or_dash(v.counters.map(|c| c.lost_frames)),
            or_dash(v.counters.map(|c| c.late_frames)),
            or_dash(v.counters.map(|c| c.overruns)),
        ]);
    }
    out.section("Counted", table);
    for v in &report.variants {
        out.item(format!("{}: ", v.name), details(v).join("; "));
    }
}

/// Formats the time of a CPU taken by others, or `None` if nothing is known.
fn cpu_taken(taken: &CpuTimeDelta) -> Option<String> {
    let mut known = Vec::new();
    if let Some(steal) = taken.steal_ns {
        known.push(format!("by the hypervisor {}", time(steal)));
    }
    let most = taken.most.iter().take(2);
    let most: Vec<String> = most.map(|i| format!("{} {}", i.count, i.name)).collect();
    let most = taken.interrupts.map(|_| format!("({})", most.join(", ")));
    let interrupts = taken.interrupt_ns.map(time).into_iter().chain(most);
    let interrupts: Vec<String> = interrupts.collect();
    if !interrupts.is_empty() {
        known.push(format!("by interrupts {}", interrupts.join(" ")));
    }
    (!known.is_empty()).then(|| format!("CPU taken {}", known.join(", ")))
}

/// Formats the non-zero counters of a variant.
fn details(v: &Variant) -> Vec<String> {
    let mut all = Vec::new();
    if let Some((1.., ours)) = losses(v).filter(|_| v.bus.is_some()) {
        all.push(format!("{ours} lost without the bus's doing"));
    }
    for (count, what) in [
        (v.counters.map(|c| c.wkc_errors), "wrong working counters"),
        (v.counters.map(|c| c.link_errors), "link errors"),
    ] {
        all.extend(count.filter(|n| *n > 0).map(|n| format!("{n} {what}")));
    }
    if let Some(used) = v.used {
        let (faults, waits) = (
            used.minor_faults + used.major_faults,
            used.involuntary_switches,
        );
        all.push(format!("{faults} page faults, {waits} times made to wait"));
    }
    all.extend(v.taken.as_ref().and_then(cpu_taken));
    if let Some(bus) = v.bus.filter(|bus| bus.held_up > 0) {
        let (held, frames) = (bus.held_up, bus.frames);
        all.push(format!(
            "{held} of {frames} replies held up at the other end"
        ));
    }
    all
}
