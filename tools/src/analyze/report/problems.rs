//! The problems of a report, worst first.

use super::{Absence, CycleReport, LINKS_LOST, Line, Report, WkcRun, called};
use crate::document::format::time;
use ecaxis_master::text::pluralize;

/// Clocks with a larger difference in ns are not synchronized.
const CLOCK_NS: u64 = 10_000;
/// The maximum number of lines of one kind; further ones are counted.
const LINES: usize = 5;

pub(super) fn of(report: &Report) -> Vec<String> {
    let mut found = Vec::new();
    let file = &report.file;
    if file.ethercat_frames == 0 {
        found.push("there is no EtherCAT in this file".to_owned());
    } else if file.answered == 0 {
        found.push(
            "no frame came back: no device answered, or the recording shows only what was sent"
                .to_owned(),
        );
    }
    absences(report, &mut found);
    story(report, &mut found);
    if file.lost > 0 && file.answered > 0 {
        found.push(format!(
            "{} of {} sent did not come back",
            pluralize(file.lost as usize, "frame"),
            file.sent
        ));
    }
    for cycle in report.cycle.iter().take(LINES) {
        let name = format!("{} 0x{:08x}", cycle.command, cycle.logical_address);
        let (odd, first) = odd(cycle);
        if odd > 0 {
            found.push(format!(
                "{name}: {} with another working counter than {}, the first at {first:.6} s",
                pluralize(odd as usize, "cycle"),
                cycle.usual_wkc.unwrap_or(0)
            ));
        }
        if let Some((at, longest)) = cycle.gaps.first() {
            found.push(format!(
                "{name}: {} longer than the cycle of {}, the longest {} at {at:.6} s",
                pluralize(cycle.gaps.len(), "interval"),
                time(cycle.cycle_ns),
                time(*longest),
            ));
        }
    }
    for (place, device) in report.devices.iter().enumerate() {
        if !device.errors.is_empty() {
            let counters: Vec<String> = device
                .errors
                .iter()
                .map(|(what, count)| format!("{count} {what}"))
                .collect();
            found.push(format!(
                "{}: {}",
                called(place, device),
                counters.join(", ")
            ));
        }
    }
    for clock in report
        .clocks
        .differences
        .iter()
        .filter(|clock| clock.last_ns.unsigned_abs() > CLOCK_NS)
        .take(LINES)
    {
        found.push(format!(
            "the clock of station 0x{:04x} is {} from the reference",
            clock.station,
            time(clock.last_ns.unsigned_abs())
        ));
    }
    found
}

/// A code that is reported this long in s after a problem of a device explains it.
const EXPLAINED: f64 = 0.1;

/// Returns the first problem with a time: devices that vanish, a wrong working counter, or an
/// event of a device with the code that explains it.
pub(super) fn cause(report: &Report) -> Option<String> {
    let absences = report.absences.iter().map(|absence| {
        let (devices, of) = (usize::from(absence.absent), absence.of);
        let text = format!("{} of {of} vanished", pluralize(devices, "SubDevice"));
        (absence.at, text)
    });
    let counters = report.cycle.iter().filter_map(|cycle| {
        let (name, address) = (cycle.command, cycle.logical_address);
        let (count, at) = odd(cycle);
        let text = format!("{name} 0x{address:08x}: another working counter than usual");
        (count > 0).then_some((at, text))
    });
    let troubles: Vec<_> = report.story.iter().filter(|line| line.trouble).collect();
    let events = troubles.iter().enumerate().map(|(n, line)| {
        let later = troubles
            .iter()
            .skip(n)
            .take_while(|next| next.at <= line.at + EXPLAINED);
        let code = later.filter(|next| next.devices == line.devices && next.text.contains("0x"));
        let mut text = format!("{}: {}", names(report, line), line.text);
        if let Some(code) = code.map(|next| &next.text).find(|text| **text != line.text)
            && !line.text.contains("0x")
        {
            text += &format!("; {code}");
        }
        (line.at, text)
    });
    let all = absences.chain(counters).chain(events);
    let first = all.min_by(|a, b| a.0.total_cmp(&b.0));
    first.map(|(at, text)| format!("{at:.6} s, {text}"))
}

fn names(report: &Report, line: &Line) -> String {
    let names = line.devices.iter();
    let names = names.filter_map(|n| Some(called(*n, report.devices.get(*n)?)));
    let names: Vec<String> = names.take(LINES).collect();
    match names.as_slice() {
        [] => "bus".to_owned(),
        names => names.join(", "),
    }
}

/// Returns the number of cycles with an unusual working counter and the time of the first. Cycles
/// before the first and after the last usual one are excluded: devices start up or shut down there.
fn odd(cycle: &CycleReport) -> (u64, f64) {
    let usual = |run: &WkcRun| run.wkc == cycle.usual_wkc;
    let first = cycle.runs.iter().position(usual).unwrap_or(0);
    let last = cycle.runs.iter().rposition(usual).unwrap_or(0);
    let between = cycle.runs.iter().take(last).skip(first);
    let odd: Vec<&WkcRun> = between
        .filter(|run| run.wkc.is_some() && !usual(run))
        .collect();
    let count = odd.iter().map(|run| run.cycles).sum();
    (count, odd.first().map_or(0.0, |run| run.at))
}

/// Adds devices that no longer answered: the likely cause of what follows.
fn absences(report: &Report, found: &mut Vec<String>) {
    let lost = report
        .devices
        .iter()
        .enumerate()
        .flat_map(|(place, device)| {
            let ports = device.errors.iter();
            let port = |(what, _): &(String, u8)| Some(what.strip_prefix(LINKS_LOST)?.to_owned());
            let ports = ports.filter_map(port);
            ports.map(move |port| {
                format!(" behind port {port} of #{place} {}", called(place, device))
            })
        });
    let lost: Vec<String> = lost.collect();
    // Links lost at several places do not say which of them it was.
    let behind = match lost.as_slice() {
        [one] => one.as_str(),
        _ => "",
    };
    for absence in report.absences.iter().take(LINES) {
        let Absence { at, absent, of, .. } = *absence;
        let devices = pluralize(usize::from(absent), "SubDevice");
        let back = match absence.until {
            Some(until) => format!(", back at {until:.3} s"),
            None => String::new(),
        };
        found.push(format!(
            "{at:.3} s: {devices} of {of} vanished{behind}{back}"
        ));
    }
}

/// Adds AL errors, refused transfers, emergencies and faults in order of occurrence.
fn story(report: &Report, found: &mut Vec<String>) {
    let troubles: Vec<_> = report.story.iter().filter(|line| line.trouble).collect();
    for line in troubles.iter().take(LINES) {
        let names = names(report, line);
        found.push(format!("{:.6} s, {names}: {}", line.at, line.text));
    }
    if let Some(more @ 1..) = troubles.len().checked_sub(LINES) {
        found.push(format!("{more} more such events"));
    }
}
