//! Fault reports as text: a short form for the terminal, a full page for a file, and the path of
//! that file.

use std::path::{Path, PathBuf};

use ecaxis_axis::cia402::{Controlword, Statusword};
use ecaxis_master::config::duration;
use ecaxis_master::post_mortem::cause::about;
use ecaxis_master::post_mortem::report::{CycleRecord, DeviceSection};
use ecaxis_master::post_mortem::{DiagnosedCause, FaultReport};
use ecaxis_master::rt::flight_recorder::AxisCycle;
use ecaxis_tools::cells;
use ecaxis_tools::document::format::{civil, hex16, times, utc};
use ecaxis_tools::document::{Document, Table};

use super::report;
use crate::failure::{FAILED, Failure};
use crate::hints::diagnosed;
use crate::render::{note, print_always};

/// The page width in columns.
const WIDTH: usize = 80;
/// The number of events shown on the terminal.
const SHOWN: usize = 6;
/// The maximum number of rows in a table of cycles.
const ROWS: usize = 60;
/// The number of earlier fault reports that are kept.
const KEPT: usize = 19;
const PREFIX: &str = "ecaxis-stop-";

/// Formats the fault report for the terminal in at most 20 lines.
pub(crate) fn short(fault_report: &FaultReport) -> String {
    // The error itself is printed elsewhere.
    let mut out = Document::new(match &fault_report.cause {
        DiagnosedCause::Unexplained { .. } if fault_report.events.is_empty() => {
            return String::new();
        }
        DiagnosedCause::Unexplained { .. } => "events in the cycle:".to_owned(),
        cause => format!("cause: {cause}"),
    });
    // The events that led to the stop, and the stop itself.
    if let Some(stop) = fault_report.events.iter().position(|event| event.failure) {
        for event in &fault_report.events[(stop + 1).saturating_sub(SHOWN)..=stop] {
            out.item(format!("{:.3} s  ", event.at_s), &event.what);
        }
    }
    for cause in fault_report.also.iter().take(2) {
        out.item("also: ", cause.to_string());
    }
    let text = out.text(Some(WIDTH));
    text.split_inclusive('\n').take(18).collect()
}

/// Returns the full page. The first line names the device and the cause.
pub(crate) fn page(fault_report: &FaultReport, hints: &[String]) -> Document {
    let mut out = Document::new(&fault_report.headline);
    out.heading(format!("The run ended with: {}", fault_report.error));
    let stop = fault_report.stop.map(|stop| {
        let (at, cycle) = (stop.at_s, stop.cycle);
        format!(", stopped {at:.3} s after the first cycle, in cycle {cycle}")
    });
    out.line(format!(
        "{}, cycle {}{}, {}",
        fault_report.machine,
        duration::show(fault_report.cycle_ns),
        stop.unwrap_or_default(),
        match fault_report.unix_time {
            Some(seconds) => format!("at {} UTC", utc(seconds)),
            None => "in virtual time".to_owned(),
        }
    ));
    out.line(format!(
        "ecaxis {}, machine sha256 {}",
        fault_report.version, fault_report.machine_sha256
    ));
    let also: Vec<String> = fault_report.also.iter().map(ToString::to_string).collect();
    for (title, items) in [("What to do", hints), ("Also seen", &also)] {
        if !items.is_empty() {
            out.heading(title);
        }
        items.iter().for_each(|item| out.item("- ", item));
    }
    let stop = fault_report.events.iter().position(|event| event.failure);
    let until = stop
        .map_or(usize::MAX, |stop| stop + 10)
        .min(fault_report.events.len());
    let events = report::events(&fault_report.events[until.saturating_sub(40)..until]);
    out.section("What happened, in order", events);
    devices(fault_report, &mut out);
    axes(fault_report, &mut out);
    out.section("This computer", host(fault_report));
    bus_cycles(fault_report, &mut out);
    axis_cycles(fault_report, &mut out);
    out
}

fn devices(fault_report: &FaultReport, out: &mut Document) {
    let mut table = Table::new("SubDevice|at|connected to|state|AL status code");
    let mut ports = Table::new("SubDevice|port|CRC|PHY|forwarded|lost links");
    for device in &fault_report.devices {
        let state = match (&device.state, device.came_back) {
            (Some(state), true) => format!("{state}, after it had been away"),
            (Some(state), false) => state.clone(),
            (None, _) => "no answer".to_owned(),
        };
        let code = device.al_code.filter(|code| *code != 0).map(|code| {
            let text = device.al_text.unwrap_or_default();
            format!("0x{code:04x}: {text}")
        });
        let code = code.unwrap_or_default();
        table.row(cells![
            device.name,
            device.position,
            device.upstream,
            state,
            code
        ]);
        let of = &device.errors;
        let errors = [of.invalid_frames, of.rx_errors, of.forwarded, of.lost_links];
        report::port_rows(&mut ports, &device.name, errors);
    }
    out.section("SubDevices", table);
    for device in &fault_report.devices {
        for line in details(device) {
            out.line(format!("{}: {line}", device.name));
        }
    }
    out.section("Error counters that grew, by port", ports);
}

/// Returns the unusual values of a device.
fn details(device: &DeviceSection) -> Vec<String> {
    let mut lines = Vec::new();
    if let Some(code) = device.error_code.filter(|code| *code != 0) {
        let words = device.error_text.unwrap_or_default();
        lines.push(format!("error code (0x603F) 0x{code:04x}: {words}"));
    }
    if device.answers && device.station == Some(0) {
        lines.push("it has no station address: it lost power, or none was assigned".to_owned());
    }
    if let Some(watchdog) = &device.watchdog {
        let (sm, pdi) = (watchdog.expired, watchdog.pdi_expired);
        if sm > 0 {
            lines.push(format!(
                "its process data watchdog ({}) has expired {} since power-on (0x0442); {} (0x0440)",
                duration::show(watchdog.time_ns),
                counted(sm),
                if watchdog.in_time { "it is in time now" } else { "it is expired now" },
            ));
        }
        if pdi > 0 {
            lines.push(format!(
                "its PDI watchdog has expired {} since power-on (0x0443): its own processor hung",
                counted(pdi)
            ));
        }
    }
    if let Some(sync) = &device.sync
        && sync.activation & 1 != 0
        && sync.next_ns < 0
    {
        lines.push(format!(
            "its SYNC0 was due {} ago and will not come (0x0990)",
            about(sync.next_ns.unsigned_abs())
        ));
    }
    if device.eeprom_error == Some(true) {
        lines.push("its EEPROM interface reports an error (0x0502)".to_owned());
    }
    if let Some(ns) = device.interpolation_ns {
        lines.push(format!(
            "interpolation time (0x60C2) {}",
            duration::show(ns)
        ));
    }
    lines
}

/// Formats a counter that saturates at 255.
fn counted(count: u8) -> String {
    match count {
        255 => "255 times or more".to_owned(),
        n => times(u32::from(n)),
    }
}

fn axes(fault_report: &FaultReport, out: &mut Document) {
    let mut table = Table::new("axis|state at the end|fault or trip");
    for axis in &fault_report.axes {
        let why = [&axis.fault, &axis.trip].into_iter().flatten();
        let why: Vec<&str> = why.map(String::as_str).collect();
        table.row(cells![axis.name, axis.state, why.join("; ")]);
    }
    out.section("Axes", table);
}

fn host(fault_report: &FaultReport) -> Table {
    let (counters, link) = (&fault_report.counters, &fault_report.link);
    let protocols = link.foreign.saturating_sub(link.main_devices);
    let rows = [
        ("cycles", counters.cycles),
        ("lost frames", counters.lost_frames),
        ("late frames", counters.late_frames),
        ("working-counter errors", counters.wkc_errors),
        ("cycles skipped", counters.overruns),
        ("refused by the interface", counters.link_errors),
        ("frames of other protocols", protocols),
        ("frames of another MainDevice", link.main_devices),
        ("damaged frames", link.damaged),
        ("frames the kernel had no room for", link.dropped),
    ];
    let mut table = Table::new("");
    for (name, count) in rows.into_iter().filter(|(_, count)| *count > 0) {
        table.row(cells![name, count]);
    }
    table
}

/// True if both cycles have the same result and neither was late.
fn same(a: &CycleRecord, b: &CycleRecord, cycle_ns: u64) -> bool {
    let late = |page: &CycleRecord| page.cycle.late > cycle_ns / 4;
    let (x, y) = (&a.cycle, &b.cycle);
    (x.complete, x.wkc, x.al_status) == (y.complete, y.wkc, y.al_status) && !late(a) && !late(b)
}

/// Returns the cycles with a change; if there are too many, those nearest to the stop.
fn notable(
    fault_report: &FaultReport,
    changed: impl Fn(&CycleRecord, &CycleRecord) -> bool,
) -> Vec<&CycleRecord> {
    let cycles = &fault_report.cycles;
    let stop = fault_report.stop.map(|stop| stop.cycle);
    let mut found: Vec<&CycleRecord> = Vec::new();
    for (n, page) in cycles.iter().enumerate() {
        let ends = n == 0 || n + 1 == cycles.len();
        let differs = n
            .checked_sub(1)
            .is_some_and(|before| changed(&cycles[before], page));
        if ends || differs || Some(page.cycle.number) == stop {
            found.push(page);
        }
    }
    if found.len() > ROWS {
        let near = |page: &&CycleRecord| stop.map_or(0, |stop| page.cycle.number.abs_diff(stop));
        found.sort_by_key(near);
        found.truncate(ROWS);
        found.sort_by_key(|page| page.cycle.number);
    }
    found
}

fn bus_cycles(fault_report: &FaultReport, out: &mut Document) {
    let mut table = Table::new("cycle|time|frames|wkc|AL status|woke late");
    for page in notable(fault_report, |a, b| !same(a, b, fault_report.cycle_ns)) {
        let cycle = &page.cycle;
        let wkc = match cycle.wkc {
            (seen, expected) if seen == expected => seen.to_string(),
            (seen, expected) => format!("{seen} of {expected}"),
        };
        let status = cycle.al_status;
        let status = status.map(|(status, n)| format!("0x{status:02x} of {n}"));
        table.row(cells![
            cycle.number,
            format!("{:.3} s", page.at_s),
            if cycle.complete { "back" } else { "lost" },
            wkc,
            status.unwrap_or_default(),
            about(cycle.late),
        ]);
    }
    let count = fault_report.cycles.len();
    let title = format!("The last {count} cycles: those in which something on the bus changed");
    out.section(title, table);
}

fn axis_cycles(fault_report: &FaultReport, out: &mut Document) {
    let words = |axis: &AxisCycle| (axis.statusword, axis.controlword, axis.mode, axis.fresh);
    let differs =
        |a: &CycleRecord, b: &CycleRecord| !a.axes.iter().map(words).eq(b.axes.iter().map(words));
    let ends = [
        fault_report.stop.map(|stop| stop.cycle),
        fault_report.cycles.last().map(|c| c.cycle.number),
    ];
    let mut table = Table::new("cycle|axis|Statusword|state|command|target|actual|error|% torque");
    let mut last = vec![None; fault_report.axes.len()];
    let mut rows = 0;
    for page in notable(fault_report, differs) {
        let number = page.cycle.number;
        for ((of, axis), last) in fault_report.axes.iter().zip(&page.axes).zip(&mut last) {
            let now = words(axis);
            if last.replace(now) == Some(now) && !ends.contains(&Some(number)) {
                continue;
            }
            rows += 1;
            let state = Statusword::from_bits_retain(axis.statusword);
            let command = Controlword::from_bits_retain(axis.controlword);
            let stale = if axis.fresh { "" } else { " (old)" };
            let (target, actual) = match axis.mode {
                VELOCITY | PROFILE_VELOCITY => (axis.target_velocity, axis.velocity),
                _ => (axis.target_position, axis.position),
            };
            table.row(cells![
                number,
                of.name,
                hex16(axis.statusword),
                format!("{state}{stale}"),
                command,
                format!("{target:.3}"),
                format!("{actual:.3}"),
                format!("{:.3}", axis.following_error),
                format!("{:.0}", axis.torque),
            ]);
        }
        if rows >= ROWS {
            break;
        }
    }
    out.section("Axes in these cycles: where a word changed", table);
}

/// CSV and PV (0x6060), whose actual value is the velocity.
const VELOCITY: i8 = 9;
const PROFILE_VELOCITY: i8 = 3;

/// Prints a fault report in short on stderr and keeps it. With `advise`, the advice for a known
/// cause replaces `hints`. Returns a line that names the kept file.
pub(crate) fn print(
    fault_report: &FaultReport,
    hints: &mut Vec<String>,
    destination: &ReportDestination,
    advise: bool,
) -> Option<String> {
    let advice = diagnosed(&fault_report.cause);
    if advise && !advice.is_empty() {
        *hints = advice;
    }
    let short = short(fault_report);
    if !short.is_empty() {
        print_always(short.trim_end());
    }
    let kept = keep(fault_report, hints, destination).unwrap_or_else(|trouble| {
        note(&format!("  warning: {}", trouble.message));
        None
    });
    kept.map(|path| {
        let path = path.display();
        format!("  full fault report: {path}, and as JSON next to it")
    })
}

/// Where a fault report is written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum ReportDestination {
    /// A generated file name in this folder; the oldest reports are removed.
    Folder(PathBuf),
    File(PathBuf),
    No,
}

/// Writes the page, and the fault report as JSON next to it.
fn keep(
    fault_report: &FaultReport,
    hints: &[String],
    keep: &ReportDestination,
) -> Result<Option<PathBuf>, Failure> {
    let path = match keep {
        ReportDestination::No => return Ok(None),
        ReportDestination::File(path) => path.clone(),
        ReportDestination::Folder(folder) => {
            make_room(folder);
            let [year, month, day, hour, minute, second] =
                civil(fault_report.unix_time.unwrap_or(0));
            let name =
                format!("{PREFIX}{year:04}{month:02}{day:02}-{hour:02}{minute:02}{second:02}.txt");
            folder.join(name)
        }
    };
    let failed = |path: &Path, error: &std::io::Error| {
        Failure::new(
            FAILED,
            format!(
                "the fault report cannot be written to {}: {error}",
                path.display()
            ),
        )
    };
    std::fs::write(&path, page(fault_report, hints).text(Some(WIDTH)))
        .map_err(|e| failed(&path, &e))?;
    let json = path.with_extension("json");
    let text = serde_json::to_string(fault_report).unwrap_or_default();
    std::fs::write(&json, text + "\n").map_err(|e| failed(&json, &e))?;
    Ok(Some(path))
}

/// Removes the oldest fault reports with generated names.
fn make_room(folder: &Path) {
    // The current folder has an empty path here.
    let named = !folder.as_os_str().is_empty();
    let Ok(entries) = std::fs::read_dir(if named { folder } else { Path::new(".") }) else {
        return;
    };
    let mut reports: Vec<PathBuf> = entries
        .flatten()
        .filter(|entry| entry.file_name().to_str().is_some_and(is_story))
        .map(|entry| entry.path())
        .collect();
    // File names contain the time, so this sorts by time.
    reports.sort();
    let surplus = reports.len().saturating_sub(KEPT);
    for fault_report in reports.iter().take(surplus) {
        let _ = std::fs::remove_file(fault_report);
        let _ = std::fs::remove_file(fault_report.with_extension("json"));
        note(&format!(
            "{}: the oldest fault report is removed",
            fault_report.display()
        ));
    }
}

/// True for names like `ecaxis-stop-20261122-071203.txt`.
fn is_story(name: &str) -> bool {
    let time = name
        .strip_prefix(PREFIX)
        .and_then(|rest| rest.strip_suffix(".txt"));
    time.is_some_and(|time| {
        time.len() == 15
            && time.bytes().enumerate().all(|(n, byte)| {
                if n == 8 {
                    byte == b'-'
                } else {
                    byte.is_ascii_digit()
                }
            })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn make_room_removes_only_own_files() {
        for (name, own) in [
            ("ecaxis-stop-20261122-071203.txt", true),
            ("ecaxis-stop-20261122-071203.json", false),
            ("ecaxis-stop-20261122_071203.txt", false),
            ("ecaxis-stop-.txt", false),
            ("ecaxis-stop-notes-of-today.txt", false),
            ("ecaxis-stop-2026112a-071203.txt", false),
        ] {
            assert_eq!(is_story(name), own, "{name}");
        }
        let folder = tempfile::tempdir().unwrap();
        let file = |n: usize| {
            folder
                .path()
                .join(format!("{PREFIX}20260101-0000{n:02}.txt"))
        };
        for n in 0..25 {
            std::fs::write(file(n), "").unwrap();
        }
        let other = folder.path().join("ecaxis-stop-mine.txt");
        std::fs::write(&other, "").unwrap();
        make_room(folder.path());
        assert!(other.exists());
        assert!((0..25).all(|n| file(n).exists() == (n >= 25 - KEPT)));
    }
}
