//! Fault reports as text: a short form for the terminal, a full page for a file, and the path of
//! that file.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use ecaxis_axis::cia402::{State, Statusword};
use ecaxis_master::config::duration;
use ecaxis_master::post_mortem::cause::about;
use ecaxis_master::post_mortem::report::{CycleRecord, DeviceSection};
use ecaxis_master::post_mortem::{Cause, FaultReport};
use ecaxis_master::rt::flight_recorder::AxisCycle;

use crate::hints;
use crate::hints::Failure;
use crate::render::note;
use crate::render::table::{Table, broken};

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
pub(crate) fn short(story: &FaultReport) -> String {
    // The error itself is printed elsewhere.
    let mut text = match &story.cause {
        Cause::Unexplained { .. } if story.events.is_empty() => return String::new(),
        Cause::Unexplained { .. } => "events in the cycle:\n".to_owned(),
        cause => paragraph(&format!("cause: {cause}"), 0),
    };
    let from = story.events.iter().position(|event| event.failure);
    let events = match from {
        // The events that led to the stop, and the stop itself.
        Some(stop) => &story.events[(stop + 1).saturating_sub(SHOWN)..=stop],
        None => &[],
    };
    for event in events {
        let line = format!("{:.3} s  {}", event.at_s, event.what);
        text += &paragraph(&line, 2);
    }
    for cause in story.also.iter().take(2) {
        text += &paragraph(&format!("also: {cause}"), 2);
    }
    let lines = text.lines().take(18);
    lines.fold(String::new(), |text, line| text + line + "\n")
}

/// Wraps text between words and indents the continuation lines.
fn paragraph(text: &str, indent: usize) -> String {
    let lines = broken(text, WIDTH - indent - 2);
    let mut out = String::new();
    for (n, line) in lines.iter().enumerate() {
        let indent = if n == 0 { indent } else { indent + 2 };
        let _ = writeln!(out, "{:indent$}{line}", "");
    }
    out
}

/// Formats the full page. The first line names the device and the cause.
pub(crate) fn page(story: &FaultReport, hints: &[String]) -> String {
    let mut text = paragraph(&story.headline, 0);
    text += "\n";
    text += &paragraph(&format!("The run ended with: {}", story.error), 0);
    let mut when = format!(
        "{}, cycle {}",
        story.machine,
        duration::show(story.cycle_ns)
    );
    if let Some(stop) = &story.stop {
        let _ = write!(
            when,
            ", stopped {:.3} s after the first cycle, in cycle {}",
            stop.at_s, stop.cycle
        );
    }
    match story.unix_time {
        Some(seconds) => when += &format!(", at {} UTC", utc(seconds)),
        None => when += ", in virtual time",
    }
    text += &paragraph(&when, 0);
    if !hints.is_empty() {
        text += "\nWhat to do\n";
        for hint in hints {
            text += &paragraph(&format!("- {hint}"), 2);
        }
    }
    if !story.also.is_empty() {
        text += "\nAlso seen\n";
        for cause in &story.also {
            text += &paragraph(&format!("- {cause}"), 2);
        }
    }
    events(story, &mut text);
    devices(story, &mut text);
    axes(story, &mut text);
    host(story, &mut text);
    bus_cycles(story, &mut text);
    axis_cycles(story, &mut text);
    text
}

fn section(text: &mut String, title: &str, table: &Table) {
    let _ = writeln!(text, "\n{title}\n{}", table.on_page(2, WIDTH));
}

fn events(story: &FaultReport, text: &mut String) {
    if story.events.is_empty() {
        return;
    }
    let mut table = Table::new(&["time", "cycle", "what"]);
    let stop = story.events.iter().position(|event| event.failure);
    let until = stop.map_or(story.events.len(), |stop| {
        (stop + 10).min(story.events.len())
    });
    let from = until.saturating_sub(40);
    for event in &story.events[from..until] {
        let cycles = if event.first_cycle == event.last_cycle {
            event.first_cycle.to_string()
        } else {
            format!("{}-{}", event.first_cycle, event.last_cycle)
        };
        table.row([&format!("{:.3} s", event.at_s), &cycles, &event.what]);
    }
    section(text, "What happened, in order", &table);
}

fn devices(story: &FaultReport, text: &mut String) {
    if story.devices.is_empty() {
        return;
    }
    let mut table = Table::new(&["SubDevice", "at", "connected to", "state", "AL status code"]);
    for device in &story.devices {
        let state = match (&device.state, device.came_back) {
            (Some(state), true) => format!("{state}, after it had been away"),
            (Some(state), false) => state.clone(),
            (None, _) => "no answer".to_owned(),
        };
        let code = match (device.al_code, device.al_text) {
            (Some(0), _) | (None, _) => String::new(),
            (Some(code), words) => format!("0x{code:04x}: {}", words.unwrap_or_default()),
        };
        table.row([
            &device.name,
            &device.position.to_string(),
            &device.upstream,
            &state,
            &code,
        ]);
    }
    section(text, "SubDevices", &table);
    for device in &story.devices {
        for line in details(device) {
            *text += &paragraph(&format!("{}: {line}", device.name), 2);
        }
    }
    ports(story, text);
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
                times(sm),
                if watchdog.in_time { "it is in time now" } else { "it is expired now" },
            ));
        }
        if pdi > 0 {
            lines.push(format!(
                "its PDI watchdog has expired {} since power-on (0x0443): its own processor hung",
                times(pdi)
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
fn times(count: u8) -> String {
    match count {
        1 => "once".to_owned(),
        255 => "255 times or more".to_owned(),
        n => format!("{n} times"),
    }
}

/// Adds one row per port with errors.
fn ports(story: &FaultReport, text: &mut String) {
    let mut table = Table::new(&["SubDevice", "port", "CRC", "PHY", "forwarded", "lost links"]);
    let mut any = false;
    for device in &story.devices {
        let errors = &device.errors;
        for port in 0..4 {
            let counts = [
                errors.invalid_frames[port],
                errors.rx_errors[port],
                errors.forwarded[port],
                errors.lost_links[port],
            ];
            if counts == [0; 4] {
                continue;
            }
            any = true;
            let [invalid, rx, forwarded, lost] = counts.map(|n| n.to_string());
            table.row([
                &device.name,
                &port.to_string(),
                &invalid,
                &rx,
                &forwarded,
                &lost,
            ]);
        }
    }
    if any {
        section(text, "Error counters that grew, by port", &table);
    }
}

fn axes(story: &FaultReport, text: &mut String) {
    if story.axes.is_empty() {
        return;
    }
    let mut table = Table::new(&["axis", "state at the end", "fault or trip"]);
    for axis in &story.axes {
        let why: Vec<&str> = [&axis.fault, &axis.trip]
            .into_iter()
            .flatten()
            .map(String::as_str)
            .collect();
        table.row([&axis.name, &axis.state, &why.join("; ")]);
    }
    section(text, "Axes", &table);
}

fn host(story: &FaultReport, text: &mut String) {
    let (counters, link) = (&story.counters, &story.link);
    let rows = [
        ("lost frames", counters.lost_frames),
        ("late frames", counters.late_frames),
        ("working-counter errors", counters.wkc_errors),
        ("cycles skipped", counters.overruns),
        ("refused by the interface", counters.link_errors),
        (
            "frames of other protocols",
            link.foreign.saturating_sub(link.main_devices),
        ),
        ("frames of another MainDevice", link.main_devices),
        ("damaged frames", link.damaged),
        ("frames the kernel had no room for", link.dropped),
    ];
    let cycles = counters.cycles.to_string();
    let mut table = Table::new(&["cycles", &cycles]);
    for (name, count) in rows {
        if count > 0 {
            table.row([name, &count.to_string()]);
        }
    }
    if counters.cycles > 0 || rows.iter().any(|(_, count)| *count > 0) {
        section(text, "This computer", &table);
    }
}

/// True if both cycles have the same result and neither was late.
fn same(a: &CycleRecord, b: &CycleRecord, cycle_ns: u64) -> bool {
    let late = |page: &CycleRecord| page.cycle.late > cycle_ns / 4;
    let (x, y) = (&a.cycle, &b.cycle);
    (x.complete, x.wkc, x.al_status) == (y.complete, y.wkc, y.al_status) && !late(a) && !late(b)
}

/// Returns the cycles with a change; if there are too many, those nearest to the stop.
fn notable(
    story: &FaultReport,
    changed: impl Fn(&CycleRecord, &CycleRecord) -> bool,
) -> Vec<&CycleRecord> {
    let cycles = &story.cycles;
    let stop = story.stop.map(|stop| stop.cycle);
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

fn bus_cycles(story: &FaultReport, text: &mut String) {
    if story.cycles.is_empty() {
        return;
    }
    let mut table = Table::new(&["cycle", "time", "frames", "wkc", "AL status", "woke late"]);
    for page in notable(story, |a, b| !same(a, b, story.cycle_ns)) {
        let cycle = &page.cycle;
        let (seen, expected) = cycle.wkc;
        let wkc = match seen == expected {
            true => seen.to_string(),
            false => format!("{seen} of {expected}"),
        };
        let status = cycle.al_status;
        table.row([
            &cycle.number.to_string(),
            &format!("{:.3} s", page.at_s),
            if cycle.complete { "back" } else { "lost" },
            &wkc,
            &status.map_or(String::new(), |(status, n)| {
                format!("0x{status:02x} of {n}")
            }),
            &about(cycle.late),
        ]);
    }
    let title = format!(
        "The last {} cycles: those in which something on the bus changed",
        story.cycles.len()
    );
    section(text, &title, &table);
}

fn axis_cycles(story: &FaultReport, text: &mut String) {
    if story.axes.is_empty() || story.cycles.is_empty() {
        return;
    }
    let words = |axis: &AxisCycle| (axis.statusword, axis.controlword, axis.mode, axis.fresh);
    let differs = |a: &CycleRecord, b: &CycleRecord| {
        a.axes.len() != b.axes.len()
            || a.axes
                .iter()
                .zip(&b.axes)
                .any(|(a, b)| words(a) != words(b))
    };
    let mut table = Table::new(&[
        "cycle",
        "axis",
        "Statusword",
        "state",
        "target",
        "actual",
        "error",
        "% torque",
    ]);
    let mut last: Vec<Option<(u16, u16, i8, bool)>> = vec![None; story.axes.len()];
    let mut rows = 0;
    for page in notable(story, differs) {
        let ends = story
            .stop
            .is_some_and(|stop| stop.cycle == page.cycle.number)
            || story
                .cycles
                .last()
                .is_some_and(|last| last.cycle.number == page.cycle.number);
        for ((of, axis), last) in story.axes.iter().zip(&page.axes).zip(&mut last) {
            let now = words(axis);
            if last.replace(now) == Some(now) && !ends {
                continue;
            }
            rows += 1;
            let state = State::from_statusword(Statusword::from_bits_retain(axis.statusword));
            let stale = if axis.fresh { "" } else { " (old)" };
            let (target, actual) = match axis.mode {
                VELOCITY | PROFILE_VELOCITY => (axis.target_velocity, axis.velocity),
                _ => (axis.target_position, axis.position),
            };
            table.row([
                &page.cycle.number.to_string(),
                &of.name,
                &format!("0x{:04x}", axis.statusword),
                &format!("{state}{stale}"),
                &format!("{target:.3}"),
                &format!("{actual:.3}"),
                &format!("{:.3}", axis.following_error),
                &format!("{:.0}", axis.torque),
            ]);
        }
        if rows >= ROWS {
            break;
        }
    }
    section(text, "Axes in these cycles: where a word changed", &table);
}

/// CSV and PV (0x6060), whose actual value is the velocity.
const VELOCITY: i8 = 9;
const PROFILE_VELOCITY: i8 = 3;

/// Formats a UTC time as `2026-11-22 07:12:03`.
fn utc(seconds: u64) -> String {
    let [year, month, day, hour, minute, second] = civil(seconds);
    format!("{year:04}-{month:02}-{day:02} {hour:02}:{minute:02}:{second:02}")
}

/// Returns year, month, day, hour, minute and second of Unix time (Gregorian calendar).
fn civil(seconds: u64) -> [u64; 6] {
    let (days, rest) = (seconds / 86_400, seconds % 86_400);
    // Years begin in March here; 719 468 days lie between the start of year 0 and 1970.
    let days = days + 719_468;
    let (era, of_era) = (days / 146_097, days % 146_097);
    let year = (of_era - of_era / 1_460 + of_era / 36_524 - of_era / 146_096) / 365;
    let of_year = of_era - (365 * year + year / 4 - year / 100);
    let month = (5 * of_year + 2) / 153;
    let day = of_year - (153 * month + 2) / 5 + 1;
    let month = if month < 10 { month + 3 } else { month - 9 };
    let year = year + era * 400 + u64::from(month <= 2);
    [year, month, day, rest / 3600, rest / 60 % 60, rest % 60]
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
pub(crate) fn keep(
    story: &FaultReport,
    hints: &[String],
    keep: &ReportDestination,
) -> Result<Option<PathBuf>, Failure> {
    let path = match keep {
        ReportDestination::No => return Ok(None),
        ReportDestination::File(path) => path.clone(),
        ReportDestination::Folder(folder) => {
            make_room(folder);
            let [year, month, day, hour, minute, second] = civil(story.unix_time.unwrap_or(0));
            let name =
                format!("{PREFIX}{year:04}{month:02}{day:02}-{hour:02}{minute:02}{second:02}.txt");
            folder.join(name)
        }
    };
    let failed = |path: &Path, error: &std::io::Error| {
        Failure::new(
            hints::FAILED,
            format!(
                "the fault report cannot be written to {}: {error}",
                path.display()
            ),
        )
    };
    std::fs::write(&path, page(story, hints)).map_err(|e| failed(&path, &e))?;
    let json = path.with_extension("json");
    let text = serde_json::to_string(story).unwrap_or_default();
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
    for story in reports.iter().take(surplus) {
        let _ = std::fs::remove_file(story);
        let _ = std::fs::remove_file(story.with_extension("json"));
        note(&format!(
            "{}: the oldest fault report is removed",
            story.display()
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
    fn dates() {
        for (seconds, text) in [
            (0, "1970-01-01 00:00:00"),
            (951_782_399, "2000-02-28 23:59:59"),
            (951_782_400, "2000-02-29 00:00:00"),
            (1_709_251_199, "2024-02-29 23:59:59"),
            (1_735_689_599, "2024-12-31 23:59:59"),
            (4_107_542_400, "2100-03-01 00:00:00"),
        ] {
            assert_eq!(utc(seconds), text);
        }
    }

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
