//! The report as a document: the most important facts first.

use ecaxis_esi::address;

use super::report::{
    AxisReport, CycleReport, DeviceReport, FOLLOWING_ERROR, Line, Report, called, highest,
};
use crate::cells;
use crate::document::format::{hex16, hex32, or_dash, time, utc};
use crate::document::{Axis, Chart, Document, Format, Marker, Series, Shape, Table};

/// The number of first and last events on a page.
const EVENTS: (usize, usize) = (24, 12);
/// The maximum number of SDO transfers on a page.
const TRANSFERS: usize = 12;
/// The maximum number of working counter changes on a page.
const RUNS: usize = 8;

/// Returns the report on the recording `name`. `all`: every event, transfer and SyncManager.
/// `advice` is shown with the problems.
#[must_use]
pub fn document(name: &str, report: &Report, advice: &[String], all: bool) -> Document {
    let mut out = head(name, report);
    if report.file.ethercat_frames == 0 {
        return out;
    }
    match (&report.cause, report.trouble.first()) {
        (Some(cause), _) => out.lead(format!("First fault: {cause}"), true),
        (None, Some(trouble)) => out.lead(trouble.clone(), true),
        (None, None) => out.lead("No fault stands out.", false),
    }
    out.heading("What stands out");
    if report.trouble.is_empty() {
        out.line("nothing");
    }
    for line in &report.trouble {
        out.item("- ", line);
    }
    for advice in advice {
        out.item("help: ", advice);
    }
    axes(report, all, &mut out);
    devices(report, all, &mut out);
    events(report, all, &mut out);
    transfers(report, all, &mut out);
    cycle(report, all, &mut out);
    clocks(report, &mut out);
    out
}

fn head(name: &str, report: &Report) -> Document {
    let file = &report.file;
    let (frames, seconds) = (file.ethercat_frames, file.seconds);
    let mut out = Document::new(format!(
        "{name}: {frames} EtherCAT frames in {seconds:.3} s"
    ));
    let (sent, answered, lost) = (file.sent, file.answered, file.lost);
    let mut counts = format!("{sent} sent, {answered} came back, {lost} lost");
    if file.without_request > 0 {
        counts += &format!(", {} without a request", file.without_request);
    }
    if file.open > 0 {
        counts += &format!(", {} under way at the end", file.open);
    }
    out.line(counts);
    if dated(report) {
        out.line(format!(
            "recorded {} UTC",
            utc(file.began_ns / 1_000_000_000)
        ));
    }
    for remark in &file.remarks {
        out.item("note: ", remark);
    }
    out
}

/// The mailbox protocols whose contents the report shows.
const DECODED: [&str; 3] = ["error", "CoE", "FoE"];

fn devices(report: &Report, all: bool, out: &mut Document) {
    let answering = report.answering;
    let answering = answering.map_or(String::new(), |n| format!(" ({n} answer at most)"));
    out.heading(format!("Devices: {}{answering}", report.devices.len()));
    let head = "#|station|name|vendor|product|revision|reached|last";
    let mut table = match all {
        true => Table::new(&format!("{head}|states")),
        false => Table::new(head),
    };
    let mut configured = Table::new("#|name|out|in|FMMUs|SYNC0|SDO read|written|failed");
    let mut managers = Table::new("#|SyncManager|start|bytes|usage");
    let mut mailboxes = Table::new("#|name|protocol|messages");
    for (place, device) in report.devices.iter().enumerate() {
        let mut row = Vec::from(cells![
            place,
            or_dash(device.station.map(hex16)),
            or_dash(device.name.as_ref()),
            or_dash(device.vendor.map(hex32)),
            or_dash(device.product.map(hex32)),
            or_dash(device.revision.map(hex32)),
            or_dash(highest(device)),
            or_dash(device.state.as_ref()),
        ]);
        if all {
            row.push(device.states.join(" → "));
        }
        table.line(row);
        // CoE and FoE are decoded, and their transfers are listed.
        let counted = device.mailbox_messages.iter();
        for (protocol, count) in counted.filter(|(protocol, _)| !DECODED.contains(protocol)) {
            mailboxes.row(cells![place, called(place, device), protocol, count]);
        }
        if device.fmmus == 0 && device.sync_managers.is_empty() && device.sync0_ns.is_none() {
            continue;
        }
        configured.row(cells![
            place,
            called(place, device),
            format!("{} B", device.output_bytes),
            format!("{} B", device.input_bytes),
            device.fmmus,
            or_dash(device.sync0_ns.map(|ns| time(u64::from(ns)))),
            device.reads,
            device.writes,
            device.failed_transfers,
        ]);
        for sm in &device.sync_managers {
            managers.row(cells![place, sm.number, hex16(sm.start), sm.len, sm.usage]);
        }
    }
    out.table(table);
    let vendors = report.devices.iter();
    let vendors = vendors.filter_map(|device| device.vendor.zip(device.vendor_name));
    out.vendors(vendors);
    out.section("Configured", configured);
    out.section("Mailbox messages, not decoded", mailboxes);
    if all {
        out.table(managers);
    }
}

/// Formats the devices of an event; consecutive numbers become ranges.
fn names(line: &Line, devices: &[DeviceReport]) -> String {
    let name = |n: usize| devices.get(n).and_then(|device| device.name.as_deref());
    match line.devices.as_slice() {
        [] => "bus".to_owned(),
        [one] => match name(*one) {
            Some(name) => format!("#{one} {name}"),
            None => format!("#{one}"),
        },
        several => {
            let ranges = several.chunk_by(|a, b| a + 1 == *b);
            let ranges = ranges.map(|range| match range {
                [] => String::new(),
                [one] => format!("#{one}"),
                [one, other] => format!("#{one}, #{other}"),
                [first, .., last] => format!("#{first}-{last}"),
            });
            ranges.collect::<Vec<_>>().join(", ")
        }
    }
}

fn events(report: &Report, all: bool, out: &mut Document) {
    let lines = if all { &report.events } else { &report.story };
    let mut table = Table::new("");
    for line in lines {
        let times = match line.times {
            1 => String::new(),
            n => format!(" ({n} times)"),
        };
        let text = format!("{}: {}{times}", names(line, &report.devices), line.text);
        table.row(cells![format!("{:>11.6} s", line.at), text]);
    }
    let table = if all {
        table
    } else {
        table.shorten(EVENTS.0, EVENTS.1)
    };
    out.section("What happened", table);
    if all && report.more_events > 0 {
        out.line(format!("… {} more were not kept", report.more_events));
    }
}

fn transfers(report: &Report, all: bool, out: &mut Document) {
    let count = report.transfers.len() as u64 + report.more_transfers;
    if count == 0 {
        return;
    }
    let mut table = Table::new("at|#||object|name|value");
    let (mut writes, mut failed) = (0, 0);
    for transfer in &report.transfers {
        writes += usize::from(transfer.write);
        failed += usize::from(transfer.ended != "done");
        let value = match (transfer.ended, transfer.code) {
            ("done", _) => transfer.value.clone(),
            (ended, Some(code)) => format!("{ended} 0x{code:08x}"),
            (ended, None) => ended.to_owned(),
        };
        table.row(cells![
            format!("{:.3} s", transfer.at),
            transfer.device,
            if transfer.write { "write" } else { "read" },
            address(transfer.index, transfer.sub),
            transfer.name.as_deref().unwrap_or_default(),
            value,
        ]);
    }
    let reads = report.transfers.len() - writes;
    out.heading(format!(
        "SDO transfers: {count} ({reads} read, {writes} written, {failed} failed)"
    ));
    out.table(if all {
        table
    } else {
        table.shorten(TRANSFERS, 0)
    });
}

fn cycle(report: &Report, all: bool, out: &mut Document) {
    if report.cycle.is_empty() {
        out.heading("Cycle: no process data");
    }
    let mut table = Table::new("datagram|bytes|sent|usual|p1|p99|longest|lost|WKC");
    let mut lines = Vec::new();
    for cycle in &report.cycle {
        let datagram = format!("{} 0x{:08x}", cycle.command, cycle.logical_address);
        if let (Some(p50), Some(max)) = (cycle.round_trip_p50_ns, cycle.round_trip_max_ns) {
            let (p50, max) = (time(p50), time(max));
            lines.push(format!("{datagram}: there and back {p50}, at most {max}"));
        }
        if cycle.runs.len() > 1 {
            lines.push(format!("{datagram}: working counter {}", runs(cycle, all)));
        }
        table.row(cells![
            datagram,
            cycle.bytes,
            cycle.count,
            time(cycle.cycle_ns),
            time(cycle.interval_p1_ns),
            time(cycle.interval_p99_ns),
            time(cycle.interval_max_ns),
            cycle.lost,
            or_dash(cycle.usual_wkc),
        ]);
    }
    out.section("Cycle", table);
    lines.into_iter().for_each(|line| out.line(line));
}

/// Formats the changes of the working counter.
fn runs(cycle: &CycleReport, all: bool) -> String {
    let shown = if all { usize::MAX } else { RUNS };
    let runs = cycle.runs.iter().take(shown).map(|run| {
        let wkc = run
            .wkc
            .map_or("no answer".to_owned(), |wkc| wkc.to_string());
        format!("{wkc} from {:.6} s ({})", run.at, run.cycles)
    });
    let mut text = runs.collect::<Vec<_>>().join(", ");
    match cycle.more_runs + cycle.runs.len().saturating_sub(shown) as u64 {
        0 => {}
        more => text += &format!(", {more} more changes"),
    }
    text
}

fn clocks(report: &Report, out: &mut Document) {
    let clocks = &report.clocks;
    if clocks.reference.is_none() && clocks.differences.is_empty() {
        return;
    }
    out.heading("Distributed clocks");
    if let Some(reference) = clocks.reference {
        let readings = clocks.readings;
        let mut text = format!("reference 0x{reference:04x}, read {readings} times");
        if let Some(ppm) = clocks.rate_ppm {
            text += &format!(", {ppm:+.1} ppm against the recording's clock");
        }
        if let (Some(p50), Some(p99)) = (clocks.jitter_p50_ns, clocks.jitter_p99_ns) {
            text += &format!(", jitter p50 {}, p99 {}", time(p50), time(p99));
        }
        out.line(text);
    }
    let mut table = Table::new("station|readings|p50|p99|most|last");
    for clock in &clocks.differences {
        table.row(cells![
            hex16(clock.station),
            clock.readings,
            time(clock.p50_ns),
            time(clock.p99_ns),
            time(clock.max_ns),
            format!("{} ns", clock.last_ns),
        ]);
    }
    out.table(table);
}

fn axes(report: &Report, all: bool, out: &mut Document) {
    let mut table = Table::new("axis|cycles|state|mode|least|greatest|error|unit");
    for axis in &report.axes {
        let number = |value: Option<f64>| {
            let digits = if axis.unit == "counts" { 0 } else { 4 };
            or_dash(value.map(|v| format!("{v:.digits$}")))
        };
        table.row(cells![
            axis.name,
            axis.cycles,
            or_dash(axis.states.last().map(|(_, state)| state)),
            or_dash(axis.modes.last().map(|(_, mode)| mode)),
            number(axis.travelled.map(|(low, _)| low)),
            number(axis.travelled.map(|(_, high)| high)),
            number(axis.largest_following_error),
            axis.unit,
        ]);
    }
    out.section("Axes", table);
    for axis in report.axes.iter().filter(|_| all) {
        for (at, mode) in &axis.modes {
            out.line(format!("{at:>11.6} s  {}: mode {mode}", axis.name));
        }
    }
    let (commanded, others): (Vec<_>, Vec<_>) = report.axes.iter().partition(|a| a.commanded);
    if !others.is_empty() {
        let names: Vec<&str> = others.iter().map(|axis| axis.name.as_str()).collect();
        out.item("never enabled, not plotted: ", names.join(", "));
    }
    // All charts share the same time axis.
    let begins = commanded.iter().filter_map(|axis| axis.states.first());
    let begins = begins.map(|(at, _)| *at);
    let time = Axis {
        format: Format::Seconds,
        origin_ns: dated(report).then_some(report.file.began_ns),
        ..Axis::of_numbers(
            begins.fold(report.file.seconds, f64::min),
            report.file.seconds,
            "s",
        )
    };
    let markers = markers(report, &time);
    for axis in commanded {
        charts(axis, &time, &markers, out);
    }
}

/// True if the time of the recording is a date; virtual time has none.
fn dated(report: &Report) -> bool {
    report.file.began_ns > 86_400_000_000_000
}

/// The maximum number of events that are marked in a plot.
const MARKERS: usize = 60;

/// Returns the faults within the plots.
fn markers(report: &Report, time: &Axis) -> Vec<Marker> {
    let absences = report.absences.iter().map(|absence| Marker {
        at: absence.at,
        text: format!("{} of {} SubDevices vanished", absence.absent, absence.of),
    });
    let lines = report.story.iter().filter(|line| line.trouble);
    let lines = lines.map(|line| Marker {
        at: line.at,
        text: format!("{}: {}", names(line, &report.devices), line.text),
    });
    let shown = |marker: &Marker| marker.at >= time.low && marker.at <= time.high;
    absences.chain(lines).filter(shown).take(MARKERS).collect()
}

fn charts(axis: &AxisReport, x: &Axis, markers: &[Marker], out: &mut Document) {
    let mut bands = |what: &str, states: &[(f64, String)]| {
        let (name, shape) = (what.to_owned(), Shape::Bands(states.to_vec()));
        out.chart(Chart {
            title: format!("{}: {what}", axis.name),
            x: x.clone(),
            y: None,
            series: vec![Series { name, shape }],
            markers: markers.to_vec(),
        });
    };
    bands("state", &axis.states);
    if axis.modes.len() > 1 {
        bands("mode", &axis.modes);
    }
    for plot in &axis.plots {
        let all = || plot.target.iter().chain(&plot.actual);
        let low = all().map(|point| point.1).fold(f64::INFINITY, f64::min);
        let high = all().map(|point| point.2).fold(f64::NEG_INFINITY, f64::max);
        let room = ((high - low) * 0.05).max(0.5e-3 * high.abs().max(1.0));
        let series = |name: &str, points: &[(f64, f64, f64)]| Series {
            name: name.to_owned(),
            shape: Shape::Curve(points.to_vec()),
        };
        let actual = match plot.title {
            FOLLOWING_ERROR => "set-point − actual value",
            _ => "actual value",
        };
        out.chart(Chart {
            title: format!("{}: {}", axis.name, plot.title.to_lowercase()),
            x: x.clone(),
            y: Some(Axis::of_numbers(low - room, high + room, &plot.unit)),
            series: vec![
                series("set-point", &plot.target),
                series(actual, &plot.actual),
            ],
            markers: markers.to_vec(),
        });
    }
}
