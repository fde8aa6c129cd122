//! The report as an HTML page with tables and a plot of every axis.

use std::fmt::Write;

use ecaxis_esi::address;

use super::plot::{Span, bands, curves};
use super::report::{AxisReport, Report, called};
use crate::html::{self, escape_xml, legend_entry, time};

/// The maximum number of table rows; further ones are counted.
const ROWS: usize = 500;

/// Returns the complete document. `name` is the name of the recording.
#[must_use]
pub fn html(name: &str, report: &Report) -> String {
    let mut out = html::head(&format!("Analysis of {name}"));
    // Writing to a String cannot fail.
    let _ = sections(&mut out, report);
    out + html::END
}

fn table(out: &mut String, head: &[&str], rows: &[Vec<String>]) -> std::fmt::Result {
    write!(out, "<table><thead><tr>")?;
    for cell in head {
        write!(out, "<th>{}</th>", escape_xml(cell))?;
    }
    writeln!(out, "</tr></thead><tbody>")?;
    for row in rows.iter().take(ROWS) {
        write!(out, "<tr>")?;
        for cell in row {
            write!(out, "<td>{}</td>", escape_xml(cell))?;
        }
        writeln!(out, "</tr>")?;
    }
    writeln!(out, "</tbody></table>")?;
    match rows.len().checked_sub(ROWS) {
        Some(more @ 1..) => writeln!(out, "<p>… and {more} more.</p>"),
        _ => Ok(()),
    }
}

fn list(out: &mut String, items: &[String]) -> std::fmt::Result {
    writeln!(out, "<ul>")?;
    for item in items.iter().take(ROWS) {
        writeln!(out, "<li>{}</li>", escape_xml(item))?;
    }
    writeln!(out, "</ul>")
}

fn hex(value: Option<u32>) -> String {
    value.map_or_else(|| "–".to_owned(), |value| format!("0x{value:08x}"))
}

fn sections(out: &mut String, report: &Report) -> std::fmt::Result {
    let file = &report.file;
    writeln!(
        out,
        "<p>{} EtherCAT frames in {:.6} s: {} sent, {} came back, {} lost.</p>",
        file.ethercat_frames, file.seconds, file.sent, file.answered, file.lost
    )?;
    if !file.remarks.is_empty() {
        list(out, &file.remarks)?;
    }
    writeln!(out, "<h2>What stands out</h2>")?;
    if report.trouble.is_empty() {
        writeln!(out, "<p>Nothing.</p>")?;
    } else {
        list(out, &report.trouble)?;
    }
    axes(out, report)?;
    cycle(out, report)?;
    writeln!(out, "<h2>Devices</h2>")?;
    let devices = report.devices.iter().enumerate().map(|(place, device)| {
        vec![
            called(place, device),
            device
                .station
                .map_or_else(|| "–".to_owned(), |s| format!("0x{s:04x}")),
            hex(device.vendor),
            hex(device.product),
            hex(device.revision),
            device.states.join(" → "),
            format!("{} / {}", device.output_bytes, device.input_bytes),
            device
                .sync0_ns
                .map_or_else(|| "–".to_owned(), |ns| time(u64::from(ns))),
        ]
    });
    let head = [
        "",
        "station",
        "vendor",
        "product",
        "revision",
        "states",
        "bytes out / in",
        "SYNC0",
    ];
    table(out, &head, &devices.collect::<Vec<_>>())?;
    writeln!(out, "<h2>What happened</h2>")?;
    let name = |n: &usize| report.devices.get(*n).map(|device| called(*n, device));
    let story = report.story.iter().map(|line| {
        let names: Vec<String> = line.devices.iter().filter_map(name).collect();
        let times = match line.times {
            1 => String::new(),
            n => format!(" ({n} times)"),
        };
        vec![
            format!("{:.6} s", line.at),
            names.join(", "),
            format!("{}{times}", line.text),
        ]
    });
    table(out, &["at", "who", "what"], &story.collect::<Vec<_>>())?;
    if !report.transfers.is_empty() {
        writeln!(out, "<h2>SDO transfers</h2>")?;
        let transfers = report.transfers.iter().map(|transfer| {
            vec![
                format!("{:.6} s", transfer.at),
                name(&transfer.device).unwrap_or_default(),
                if transfer.write { "write" } else { "read" }.to_owned(),
                address(transfer.index, transfer.sub).to_string(),
                transfer.name.clone().unwrap_or_default(),
                match (transfer.ended, transfer.code) {
                    ("done", _) => transfer.value.clone(),
                    (ended, Some(code)) => format!("{ended} 0x{code:08x}"),
                    (ended, None) => ended.to_owned(),
                },
            ]
        });
        let head = ["at", "who", "", "object", "name", "value"];
        table(out, &head, &transfers.collect::<Vec<_>>())?;
    }
    clocks(out, report)?;
    writeln!(
        out,
        "<footer>ecaxis {}. Times are those of the recording, from its first EtherCAT frame on.</footer>",
        env!("CARGO_PKG_VERSION")
    )
}

fn axes(out: &mut String, report: &Report) -> std::fmt::Result {
    // All plots share the same time axis.
    let begins = report
        .axes
        .iter()
        .filter_map(|axis| axis.states.first())
        .map(|(at, _)| *at);
    let span = Span {
        from: begins.fold(report.file.seconds, f64::min),
        to: report.file.seconds,
    };
    for axis in &report.axes {
        writeln!(out, "<h2>Axis {}</h2>", escape_xml(&axis.name))?;
        let mut facts = vec![format!("{} cycles", axis.cycles)];
        if let Some((low, high)) = axis.travelled {
            facts.push(format!("position from {low:.4} to {high:.4} {}", axis.unit));
        }
        if let Some(error) = axis.largest_following_error {
            facts.push(format!("largest following error {error:.4} {}", axis.unit));
        }
        writeln!(out, "<p>{}.</p>", escape_xml(&facts.join(", ")))?;
        picture(out, axis, span)?;
    }
    Ok(())
}

fn picture(out: &mut String, axis: &AxisReport, span: Span) -> std::fmt::Result {
    writeln!(
        out,
        "<h3>State</h3>{}",
        bands(&format!("{}: state", axis.name), &axis.states, span)
    )?;
    if axis.modes.len() > 1 {
        writeln!(
            out,
            "<h3>Mode</h3>{}",
            bands(&format!("{}: mode", axis.name), &axis.modes, span)
        )?;
    } else if let Some((_, mode)) = axis.modes.first() {
        writeln!(out, "<p>Mode {}.</p>", escape_xml(mode))?;
    }
    for plot in &axis.plots {
        writeln!(
            out,
            "<h3>{} ({})</h3>{}<p>{} {}</p>",
            plot.title,
            escape_xml(&plot.unit),
            curves(&format!("{}: {}", axis.name, plot.title), plot, span),
            if plot.target.is_empty() {
                String::new()
            } else {
                legend_entry(0, "set-point")
            },
            if plot.actual.is_empty() {
                String::new()
            } else {
                legend_entry(1, "actual value")
            },
        )?;
    }
    Ok(())
}

fn cycle(out: &mut String, report: &Report) -> std::fmt::Result {
    if report.cycle.is_empty() {
        return Ok(());
    }
    writeln!(out, "<h2>Cycle</h2>")?;
    let rows = report.cycle.iter().map(|cycle| {
        vec![
            format!(
                "{} 0x{:08x}, {} bytes",
                cycle.command, cycle.logical_address, cycle.bytes
            ),
            cycle.count.to_string(),
            time(cycle.cycle_ns),
            time(cycle.interval_p1_ns),
            time(cycle.interval_p99_ns),
            time(cycle.interval_max_ns),
            cycle.lost.to_string(),
            cycle
                .usual_wkc
                .map_or_else(|| "–".to_owned(), |wkc| wkc.to_string()),
        ]
    });
    let head = [
        "",
        "sent",
        "usual",
        "p1",
        "p99",
        "longest",
        "lost",
        "working counter",
    ];
    table(out, &head, &rows.collect::<Vec<_>>())?;
    for cycle in report.cycle.iter().filter(|cycle| cycle.runs.len() > 1) {
        writeln!(
            out,
            "<h3>Working counter of {} 0x{:08x}</h3>",
            cycle.command, cycle.logical_address
        )?;
        let rows = cycle.runs.iter().map(|run| {
            let wkc = run
                .wkc
                .map_or_else(|| "no answer".to_owned(), |wkc| wkc.to_string());
            vec![format!("{:.6} s", run.at), wkc, run.cycles.to_string()]
        });
        table(
            out,
            &["from", "working counter", "cycles"],
            &rows.collect::<Vec<_>>(),
        )?;
    }
    Ok(())
}

fn clocks(out: &mut String, report: &Report) -> std::fmt::Result {
    let clocks = &report.clocks;
    let Some(reference) = clocks.reference else {
        return Ok(());
    };
    writeln!(out, "<h2>Distributed clocks</h2>")?;
    let mut facts = vec![format!(
        "reference 0x{reference:04x}, read {} times",
        clocks.readings
    )];
    if let Some(ppm) = clocks.rate_ppm {
        facts.push(format!("{ppm:+.1} ppm against the recording's clock"));
    }
    writeln!(out, "<p>{}.</p>", escape_xml(&facts.join(", ")))?;
    if clocks.differences.is_empty() {
        return Ok(());
    }
    let rows = clocks.differences.iter().map(|clock| {
        vec![
            format!("0x{:04x}", clock.station),
            clock.readings.to_string(),
            time(clock.p50_ns),
            time(clock.p99_ns),
            time(clock.max_ns),
            format!("{} ns", clock.last_ns),
        ]
    });
    let head = ["station", "readings", "p50", "p99", "most", "last"];
    table(out, &head, &rows.collect::<Vec<_>>())
}
