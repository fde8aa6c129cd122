//! The report as text of 80 columns.

use std::fmt::Write;

use super::html::{MEASURES, times};
use super::report::{LatencySummary, Report, Variant, losses};
use crate::html::time;

const WIDTH: usize = 80;
const NAME: usize = 34;

/// Formats the whole report.
#[must_use]
pub fn text(report: &Report) -> String {
    let mut out = String::new();
    // Writing to a String cannot fail.
    let _ = write_all(&mut out, report);
    out
}

fn write_all(out: &mut String, report: &Report) -> std::fmt::Result {
    for facts in [&report.settings, &report.facts] {
        for fact in facts {
            folded(out, &format!("{:<15} ", fact.name), &fact.value)?;
        }
        writeln!(out)?;
    }
    for (title, _, get) in MEASURES {
        measure(out, report, title, get)?;
    }
    counted(out, report)?;
    if !report.remarks.is_empty() {
        writeln!(out)?;
    }
    for remark in &report.remarks {
        folded(out, "note: ", remark)?;
    }
    if !report.findings.is_empty() {
        let found = report.findings.len();
        let what = "what disturbs a cycle on this computer, and how to fix it: ecaxis doctor";
        folded(out, "note: ", &format!("{found} findings of {what}"))?;
    }
    Ok(())
}

/// Wraps text and aligns continuation lines with its start.
fn folded(out: &mut String, head: &str, text: &str) -> std::fmt::Result {
    let indent = head.chars().count();
    let mut line = head.to_owned();
    let mut used = indent;
    for word in text.split(' ') {
        let len = word.chars().count();
        if used + len > WIDTH && used > indent {
            writeln!(out, "{}", line.trim_end())?;
            line = " ".repeat(indent);
            used = indent;
        }
        line += word;
        line.push(' ');
        used += len + 1;
    }
    writeln!(out, "{}", line.trim_end())
}

/// Pads or cuts a name to its column.
fn named(name: &str) -> String {
    let len = name.chars().count();
    if len > NAME {
        let cut: String = name.chars().take(NAME - 1).collect();
        return cut + "…";
    }
    format!("{name}{}", " ".repeat(NAME - len))
}

fn row(out: &mut String, name: &str, cells: &[String]) -> std::fmt::Result {
    let mut line = format!("  {}", named(name));
    for cell in cells {
        let pad = 10_usize.saturating_sub(cell.chars().count());
        let _ = write!(line, " {}{cell}", " ".repeat(pad));
    }
    writeln!(out, "{}", line.trim_end())
}

fn head(out: &mut String, title: &str, cells: &[&str]) -> std::fmt::Result {
    let mut line = format!("{title:<width$}", width = NAME + 2);
    for cell in cells {
        let _ = write!(line, " {cell:>10}");
    }
    writeln!(out, "{}", line.trim_end())
}

fn or_dash(nanos: Option<u64>) -> String {
    nanos.map_or_else(|| "–".to_owned(), time)
}

fn measure(
    out: &mut String,
    report: &Report,
    title: &str,
    get: fn(&Variant) -> Option<&LatencySummary>,
) -> std::fmt::Result {
    if report.variants.iter().all(|v| get(v).is_none()) {
        return Ok(());
    }
    head(out, title, &["p50", "p99", "p99.9", "longest"])?;
    for variant in &report.variants {
        let Some(dist) = get(variant) else { continue };
        let cells = [
            time(dist.p50_ns),
            or_dash(dist.p99_ns),
            or_dash(dist.p99_9_ns),
            time(dist.max_ns),
        ];
        row(out, &variant.name, &cells)?;
    }
    for ratio in &report.ratios {
        if ratio.measure.title() == title && ratio.value.is_none() {
            let name = format!("{} ∕ {}{}", ratio.of, ratio.to, ratio.measure.note());
            let cells = [ratio.p50, ratio.p99, ratio.p99_9, ratio.max].map(times);
            row(out, &name, &cells)?;
        }
    }
    writeln!(out)
}

fn counted(out: &mut String, report: &Report) -> std::fmt::Result {
    head(
        out,
        "Per cycle",
        &["CPU", "of a CPU", "switches", "spinning"],
    )?;
    let none = || "–".to_owned();
    for v in &report.variants {
        let cells = [
            v.cpu_ns_per_cycle.map_or_else(none, |ns| time(ns as u64)),
            v.cpu_percent.map_or_else(none, |p| format!("{p:.1} %")),
            v.context_switches_per_cycle
                .map_or_else(none, |n| format!("{n:.2}")),
            v.spin_ns.map_or_else(none, time),
        ];
        row(out, &v.name, &cells)?;
    }
    for ratio in &report.ratios {
        if ratio.value.is_some() {
            let name = format!("{} ∕ {}", ratio.of, ratio.to);
            row(out, &name, &[times(ratio.value)])?;
        }
    }
    writeln!(out)?;
    head(out, "Counted", &["cycles", "lost", "late", "overruns"])?;
    for v in &report.variants {
        let count = |n: Option<u64>| n.map_or_else(none, |n| n.to_string());
        let cells = [
            v.cycles.to_string(),
            count(v.counters.map(|c| c.lost_frames)),
            count(v.counters.map(|c| c.late_frames)),
            count(v.counters.map(|c| c.overruns)),
        ];
        row(out, &v.name, &cells)?;
    }
    for v in &report.variants {
        details(out, v)?;
    }
    Ok(())
}

/// Formats the non-zero counters of a variant.
fn details(out: &mut String, v: &Variant) -> std::fmt::Result {
    let mut reported = Vec::new();
    if let Some((lost, ours)) = losses(v)
        && lost > 0
        && v.bus.is_some()
    {
        reported.push(format!("{ours} lost without the bus's doing"));
    }
    if let Some(c) = v.counters {
        for (n, what) in [
            (c.wkc_errors, "wrong working counters"),
            (c.link_errors, "link errors"),
        ] {
            if n > 0 {
                reported.push(format!("{n} {what}"));
            }
        }
    }
    if let Some(used) = v.used {
        reported.push(format!(
            "{} page faults, {} times made to wait",
            used.minor_faults + used.major_faults,
            used.involuntary_switches
        ));
    }
    if let Some(taken) = &v.taken {
        let most: Vec<String> = taken
            .most
            .iter()
            .take(2)
            .map(|i| format!("{} {}", i.count, i.name))
            .collect();
        reported.push(format!(
            "CPU taken by the hypervisor {}, by interrupts {} ({})",
            time(taken.steal_ns),
            time(taken.interrupt_ns),
            most.join(", ")
        ));
    }
    if let Some(bus) = v.bus
        && bus.held_up > 0
    {
        reported.push(format!(
            "{} of {} replies held up at the other end",
            bus.held_up, bus.frames
        ));
    }
    folded(out, &format!("  {}: ", v.name), &reported.join("; "))
}
