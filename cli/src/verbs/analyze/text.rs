//! The report as text of 80 columns, most important facts first.

use ecaxis_tools::analyze::{CycleReport, DeviceReport, Line, Report, called, highest, time};

use ecaxis_esi::address;

use crate::hints;
use crate::render::table::Table;

/// The line width in columns.
const WIDTH: usize = 80;
/// The number of first and last events on a page.
const FIRST: usize = 24;
const LAST: usize = 12;
/// The maximum number of SDO transfers on a page.
const TRANSFERS: usize = 12;
/// The maximum number of working counter changes on a page.
const RUNS: usize = 8;

pub(super) fn page(name: &str, report: &Report, all: bool) -> String {
    let mut out = head(name, report);
    if report.file.ethercat_frames == 0 {
        return out;
    }
    out += "\nWhat stands out\n";
    if report.trouble.is_empty() {
        out += "  nothing\n";
    }
    for line in &report.trouble {
        out += &item("- ", line);
    }
    help(report, &mut out);
    devices(report, all, &mut out);
    story(report, all, &mut out);
    transfers(report, all, &mut out);
    cycle(report, all, &mut out);
    clocks(report, &mut out);
    axes(report, all, &mut out);
    out
}

/// Wraps text and aligns continuation lines with its start.
fn item(mark: &str, text: &str) -> String {
    let indent = 2 + mark.chars().count();
    let mut out = format!("  {mark}");
    let mut used = indent;
    let mut first = true;
    for word in text.split(' ') {
        let len = word.chars().count();
        if !first && used + 1 + len > WIDTH {
            out += "\n";
            out += &" ".repeat(indent);
            used = indent;
            first = true;
        }
        if !first {
            out += " ";
            used += 1;
        }
        out += word;
        used += len;
        first = false;
    }
    out + "\n"
}

fn head(name: &str, report: &Report) -> String {
    let file = &report.file;
    let first = format!(
        "{name}: {} EtherCAT frames in {:.3} s",
        file.ethercat_frames, file.seconds
    );
    let mut out = item("", &first).trim_start().to_owned();
    let mut parts = vec![
        format!("{} sent", file.sent),
        format!("{} came back", file.answered),
        format!("{} lost", file.lost),
    ];
    if file.without_request > 0 {
        parts.push(format!("{} without a request", file.without_request));
    }
    if file.open > 0 {
        parts.push(format!("{} under way at the end", file.open));
    }
    out += &item("", &parts.join(", "));
    // Virtual time has no date.
    if file.began_ns > 86_400_000_000_000 {
        out += &format!("  recorded {}\n", utc(file.began_ns));
    }
    for remark in &file.remarks {
        out += &item("note: ", remark);
    }
    out
}

/// Formats a UTC date (Gregorian calendar). Years begin in March, so that the leap day is the last
/// day.
fn utc(nanos: u64) -> String {
    let seconds = nanos / 1_000_000_000;
    let (days, rest) = (seconds / 86_400, seconds % 86_400);
    let days = days + 719_468;
    let era = days / 146_097;
    let day_of_era = days % 146_097;
    let year_of_era =
        (day_of_era - day_of_era / 1_460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let shifted = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * shifted + 2) / 5 + 1;
    let month = if shifted < 10 {
        shifted + 3
    } else {
        shifted - 9
    };
    let year = year_of_era + era * 400 + u64::from(month <= 2);
    format!(
        "{year:04}-{month:02}-{day:02} {:02}:{:02}:{:02} UTC",
        rest / 3600,
        rest / 60 % 60,
        rest % 60
    )
}

/// Adds the advice for each error code.
fn help(report: &Report, out: &mut String) {
    for (place, device) in report.devices.iter().enumerate() {
        let states = device
            .al_errors
            .iter()
            .map(|code| (*code, hints::al_status(*code)));
        let emergencies = device
            .emergency_codes
            .iter()
            .map(|code| (*code, hints::emergency(*code)));
        for (code, hint) in states.chain(emergencies) {
            *out += &item(
                "help: ",
                &format!("{}, {code:#06x}: {hint}", called(place, device)),
            );
        }
    }
}

fn hex(value: Option<u32>) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("0x{value:08x}"))
}

fn devices(report: &Report, all: bool, out: &mut String) {
    let answering = report
        .answering
        .map_or(String::new(), |n| format!(" ({n} answer at most)"));
    *out += &format!("\nDevices: {}{answering}\n", report.devices.len());
    if report.devices.is_empty() {
        return;
    }
    let mut table = Table::new(&[
        "#", "station", "name", "vendor", "product", "revision", "reached", "last",
    ]);
    for (place, device) in report.devices.iter().enumerate() {
        table.line(vec![
            place.to_string(),
            device
                .station
                .map_or_else(|| "-".to_owned(), |s| format!("0x{s:04x}")),
            device.name.clone().unwrap_or_else(|| "-".to_owned()),
            hex(device.vendor),
            hex(device.product),
            hex(device.revision),
            highest(device).unwrap_or("-").to_owned(),
            device.state.clone().unwrap_or_else(|| "-".to_owned()),
        ]);
    }
    *out += &(table.within(2, WIDTH) + "\n");
    let configured: Vec<(usize, &DeviceReport)> = report
        .devices
        .iter()
        .enumerate()
        .filter(|(_, d)| d.fmmus > 0 || !d.sync_managers.is_empty() || d.sync0_ns.is_some())
        .collect();
    if configured.is_empty() {
        return;
    }
    *out += "\nConfigured\n";
    let mut table = Table::new(&[
        "#", "name", "out", "in", "FMMUs", "SYNC0", "SDO read", "written", "failed",
    ]);
    for (place, device) in &configured {
        table.line(vec![
            place.to_string(),
            called(*place, device),
            format!("{} B", device.output_bytes),
            format!("{} B", device.input_bytes),
            device.fmmus.to_string(),
            device
                .sync0_ns
                .map_or_else(|| "-".to_owned(), |ns| time(u64::from(ns))),
            device.reads.to_string(),
            device.writes.to_string(),
            device.failed_transfers.to_string(),
        ]);
    }
    *out += &(table.within(2, WIDTH) + "\n");
    if all {
        let mut table = Table::new(&["#", "SyncManager", "start", "bytes", "usage"]);
        for (place, device) in configured {
            for sm in &device.sync_managers {
                table.line(vec![
                    place.to_string(),
                    sm.number.to_string(),
                    format!("0x{:04x}", sm.start),
                    sm.len.to_string(),
                    sm.usage.to_owned(),
                ]);
            }
        }
        *out += &format!("\n{}\n", table.within(2, WIDTH));
    }
}

/// Formats the devices of an event; consecutive numbers become ranges.
fn whom(line: &Line, report: &Report) -> String {
    match line.devices.as_slice() {
        [] => "bus".to_owned(),
        [one] => match report
            .devices
            .get(*one)
            .and_then(|device| device.name.as_deref())
        {
            Some(name) => format!("#{one} {name}"),
            None => format!("#{one}"),
        },
        several => {
            let mut rows: Vec<(usize, usize)> = Vec::new();
            for n in several {
                match rows.last_mut() {
                    Some((_, last)) if *last + 1 == *n => *last = *n,
                    _ => rows.push((*n, *n)),
                }
            }
            let rows = rows.iter().map(|(from, to)| match to - from {
                0 => format!("#{from}"),
                1 => format!("#{from}, #{to}"),
                _ => format!("#{from}-{to}"),
            });
            rows.collect::<Vec<_>>().join(", ")
        }
    }
}

fn story(report: &Report, all: bool, out: &mut String) {
    let lines = if all { &report.events } else { &report.story };
    if lines.is_empty() {
        return;
    }
    *out += "\nWhat happened\n";
    let left = if all {
        0
    } else {
        lines.len().saturating_sub(FIRST + LAST)
    };
    for line in lines
        .iter()
        .take(if left > 0 { FIRST } else { lines.len() })
    {
        *out += &describe(line, report);
    }
    if left > 0 {
        *out += &format!("  … {left} more, `--all` shows them\n");
        for line in lines.iter().skip(FIRST + left) {
            *out += &describe(line, report);
        }
    }
    if all && report.more_events > 0 {
        *out += &format!("  … {} more were not kept\n", report.more_events);
    }
}

/// Formats an event: the time in its own column, the wrapped text next to it.
fn describe(line: &Line, report: &Report) -> String {
    let times = match line.times {
        1 => String::new(),
        n => format!(" ({n} times)"),
    };
    let text = format!("{}: {}{times}", whom(line, report), line.text);
    item(&format!("{:>11.6} s  ", line.at), &text)
}

fn transfers(report: &Report, all: bool, out: &mut String) {
    let count = report.transfers.len() as u64 + report.more_transfers;
    if count == 0 {
        return;
    }
    let writes = report
        .transfers
        .iter()
        .filter(|transfer| transfer.write)
        .count();
    let failed = report
        .transfers
        .iter()
        .filter(|transfer| transfer.ended != "done")
        .count();
    *out += &format!(
        "\nSDO transfers: {count} ({} read, {writes} written, {failed} failed)\n",
        report.transfers.len() - writes
    );
    let mut table = Table::new(&["at", "#", "", "object", "name", "value"]);
    let shown = if all { usize::MAX } else { TRANSFERS };
    for transfer in report.transfers.iter().take(shown) {
        let value = match (transfer.ended, transfer.code) {
            ("done", _) => transfer.value.clone(),
            (ended, Some(code)) => format!("{ended} 0x{code:08x}"),
            (ended, None) => ended.to_owned(),
        };
        table.line(vec![
            format!("{:.3} s", transfer.at),
            transfer.device.to_string(),
            if transfer.write { "write" } else { "read" }.to_owned(),
            address(transfer.index, transfer.sub).to_string(),
            transfer.name.clone().unwrap_or_default(),
            value,
        ]);
    }
    *out += &(table.within(2, WIDTH) + "\n");
    if let Some(more @ 1..) = report.transfers.len().checked_sub(shown) {
        *out += &format!("  … {more} more, `--all` shows them\n");
    }
}

fn cycle(report: &Report, all: bool, out: &mut String) {
    if report.cycle.is_empty() {
        *out += "\nCycle: no process data\n";
        return;
    }
    *out += "\nCycle\n";
    let mut table = Table::new(&[
        "datagram", "bytes", "sent", "usual", "p1", "p99", "longest", "lost", "WKC",
    ]);
    for cycle in &report.cycle {
        table.line(vec![
            datagram(cycle),
            cycle.bytes.to_string(),
            cycle.count.to_string(),
            time(cycle.cycle_ns),
            time(cycle.interval_p1_ns),
            time(cycle.interval_p99_ns),
            time(cycle.interval_max_ns),
            cycle.lost.to_string(),
            cycle
                .usual_wkc
                .map_or_else(|| "-".to_owned(), |wkc| wkc.to_string()),
        ]);
    }
    *out += &(table.within(2, WIDTH) + "\n");
    for cycle in &report.cycle {
        if let (Some(p50), Some(max)) = (cycle.round_trip_p50_ns, cycle.round_trip_max_ns) {
            let trip = format!(
                "{}: there and back {}, at most {}",
                datagram(cycle),
                time(p50),
                time(max)
            );
            *out += &item("", &trip);
        }
        if cycle.runs.len() < 2 {
            continue;
        }
        let shown = if all { usize::MAX } else { RUNS };
        let runs = cycle.runs.iter().take(shown).map(|run| {
            let wkc = run
                .wkc
                .map_or_else(|| "no answer".to_owned(), |wkc| wkc.to_string());
            format!("{wkc} from {:.6} s ({})", run.at, run.cycles)
        });
        let mut text = format!(
            "{}: working counter {}",
            datagram(cycle),
            runs.collect::<Vec<_>>().join(", ")
        );
        let more = cycle.more_runs + cycle.runs.len().saturating_sub(shown) as u64;
        if more > 0 {
            text += &format!(", {more} more changes");
        }
        *out += &item("", &text);
    }
}

fn datagram(cycle: &CycleReport) -> String {
    format!("{} 0x{:08x}", cycle.command, cycle.logical_address)
}

fn clocks(report: &Report, out: &mut String) {
    let clocks = &report.clocks;
    if clocks.reference.is_none() && clocks.differences.is_empty() {
        return;
    }
    *out += "\nDistributed clocks\n";
    if let Some(reference) = clocks.reference {
        let mut text = format!(
            "reference 0x{reference:04x}, read {} times",
            clocks.readings
        );
        if let Some(ppm) = clocks.rate_ppm {
            text += &format!(", {ppm:+.1} ppm against the recording's clock");
        }
        if let (Some(p50), Some(p99)) = (clocks.jitter_p50_ns, clocks.jitter_p99_ns) {
            text += &format!(", jitter p50 {}, p99 {}", time(p50), time(p99));
        }
        *out += &item("", &text);
    }
    if clocks.differences.is_empty() {
        return;
    }
    let mut table = Table::new(&["station", "readings", "p50", "p99", "most", "last"]);
    for clock in &clocks.differences {
        table.line(vec![
            format!("0x{:04x}", clock.station),
            clock.readings.to_string(),
            time(clock.p50_ns),
            time(clock.p99_ns),
            time(clock.max_ns),
            format!("{} ns", clock.last_ns),
        ]);
    }
    *out += &(table.within(2, WIDTH) + "\n");
}

fn axes(report: &Report, all: bool, out: &mut String) {
    if report.axes.is_empty() {
        return;
    }
    *out += "\nAxes\n";
    let mut table = Table::new(&[
        "axis", "cycles", "state", "mode", "least", "greatest", "error", "unit",
    ]);
    for axis in &report.axes {
        let number = |value: Option<f64>| {
            value.map_or_else(
                || "-".to_owned(),
                |v| {
                    if axis.unit == "counts" {
                        format!("{v:.0}")
                    } else {
                        format!("{v:.4}")
                    }
                },
            )
        };
        let last =
            |list: &[(f64, String)]| list.last().map_or("-".to_owned(), |(_, text)| text.clone());
        table.line(vec![
            axis.name.clone(),
            axis.cycles.to_string(),
            last(&axis.states),
            last(&axis.modes),
            number(axis.travelled.map(|(low, _)| low)),
            number(axis.travelled.map(|(_, high)| high)),
            number(axis.largest_following_error),
            axis.unit.clone(),
        ]);
    }
    *out += &(table.within(2, WIDTH) + "\n");
    if all {
        for axis in &report.axes {
            for (at, mode) in &axis.modes {
                *out += &format!("  {:>11.6} s  {}: mode {mode}\n", at, axis.name);
            }
        }
    }
}
