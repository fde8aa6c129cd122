//! The summary of a run. In virtual time all figures describe the machine, not the computer.

use std::time::Duration;

use ecaxis_master::config::duration;
use ecaxis_master::eoe::EthernetCounters;
use ecaxis_master::rt::stats::Percentiles;
use ecaxis_master::session::{
    AxisSummary, DeviceErrors, EmergencyLine, EventLine, GatewaySummary, Summary, ThreadSummary,
};
use ecaxis_master::text::{pluralize, positive_zero};
use ecaxis_tools::cells;
use ecaxis_tools::document::format::{self, hex_bytes, hex16};
use ecaxis_tools::document::{Document, Table};

/// The number of events shown.
const EVENTS: usize = 12;

/// Returns the whole summary of a run.
pub(crate) fn summary(summary: &Summary) -> Document {
    let runs = usize::try_from(summary.program_runs).unwrap_or(usize::MAX);
    let mut out = Document::new(format!(
        "{}: {}, {} in {} time, {} of the program{}",
        summary.machine,
        pluralize(summary.devices, "SubDevice"),
        seconds(summary.machine_seconds),
        summary.time,
        pluralize(runs, "complete run"),
        if summary.interrupted {
            ", interrupted"
        } else {
            ""
        },
    ));
    out.gap();
    out.table(counters(summary));
    out.table(times(summary));
    if let Some(thread) = &summary.thread {
        self::thread(thread, summary.counters.cycles, &mut out);
    }
    axes(summary, &mut out);
    out.gap();
    for found in &summary.probes {
        let times = match found.times {
            1 => String::new(),
            n => format!(" (the last of {n})"),
        };
        out.line(format!("step {}: {found}{times}", found.step));
    }
    out.gap();
    out.table(errors(&summary.errors));
    gateways(&summary.gateways, &mut out);
    ethernet(&summary.ethernet, &mut out);
    emergencies(&summary.emergencies, summary.more_emergencies, &mut out);
    if summary.events.iter().any(|event| event.failure) {
        out.gap();
        let last = summary.events.len().saturating_sub(EVENTS);
        out.table(events(&summary.events[last..]));
    }
    if let Some(frames) = summary.recorded_frames {
        let dropped = match summary.recorded_frames_dropped {
            Some(n @ 1..) => format!(", {n} dropped: the disk is too slow"),
            _ => String::new(),
        };
        out.gap();
        out.line(format!("{frames} frames recorded{dropped}"));
    }
    out
}

fn seconds(s: f64) -> String {
    let time = Duration::try_from_secs_f64(s).unwrap_or_default();
    format!("{:.3} s", time.as_secs_f64())
}

fn counters(summary: &Summary) -> Table {
    let (counters, link) = (&summary.counters, &summary.link);
    let mut table = Table::new("");
    let cycle = format!("of {}", duration::show(summary.cycle_ns));
    table.row(cells!["cycles", counters.cycles, cycle]);
    // The first three are always shown, the others only if not zero.
    let rows = [
        (
            "lost frames",
            counters.lost_frames,
            "not back before the deadline",
        ),
        ("late frames", counters.late_frames, "back in a later cycle"),
        (
            "working-counter errors",
            counters.wkc_errors,
            "a SubDevice did not take part",
        ),
        (
            "overruns",
            counters.overruns,
            "cycles skipped because the thread woke too late",
        ),
        (
            "link errors",
            counters.link_errors,
            "sends and receives refused",
        ),
        (
            "refused answers",
            counters.refused_answers,
            "mailbox frames too late or damaged",
        ),
        (
            "foreign frames",
            link.foreign,
            "of other protocols or MainDevices on this wire",
        ),
        (
            "tagged frames",
            link.tagged,
            "with a VLAN tag, which ours never have",
        ),
        (
            "damaged frames",
            link.damaged,
            "shorter than they say, or too long",
        ),
        (
            "dropped frames",
            link.dropped,
            "kernel receive buffer overflow",
        ),
    ];
    for (n, (name, count, meaning)) in rows.into_iter().enumerate() {
        if count > 0 || n < 3 {
            table.row(cells![name, count, if count > 0 { meaning } else { "" }]);
        }
    }
    table
}

fn times(summary: &Summary) -> Table {
    let mut table = Table::new("|p50|p99|p99.9|max");
    let mut row = |name: &str, times: &Percentiles| {
        let show = |ns: u64| match times.count {
            0 => "-".to_owned(),
            _ => duration::show(ns),
        };
        let [p50, p99, p99_9, max] =
            [times.p50_ns, times.p99_ns, times.p99_9_ns, times.max_ns].map(show);
        table.row(cells![name, p50, p99, p99_9, max]);
    };
    row("wake-up lateness", &summary.wake_up_lateness);
    row("round trip", &summary.round_trip);
    row("work a cycle", &summary.work);
    if let Some(phase) = &summary.dc_phase_error {
        row("DC phase error", phase);
    }
    table
}

/// Adds CPU time and page faults of the real-time thread.
fn thread(thread: &ThreadSummary, cycles: u64, out: &mut Document) {
    let used = &thread.used;
    let a_cycle = |n: u64| n as f64 / cycles.max(1) as f64;
    out.gap();
    out.line(format!(
        "real-time thread: {:.1} % of its CPU, {} a cycle; {:.2} context switches a cycle, {} against its will; {} page faults{}",
        thread.load_percent,
        duration::show(a_cycle(used.cpu_ns).round() as u64),
        a_cycle(used.voluntary_switches + used.involuntary_switches),
        used.involuntary_switches,
        used.minor_faults + used.major_faults,
        match used.major_faults {
            0 => String::new(),
            n => format!(", {n} of them from disk"),
        },
    ));
    let slept = &thread.sleep_lateness;
    if slept.count > 0 {
        out.line(format!(
            "sleeping ends late by {} (p50), {} (p99), {} (p99.9); {} are spun before a release",
            duration::show(slept.p50_ns),
            duration::show(slept.p99_ns),
            duration::show(slept.p99_9_ns),
            duration::show(thread.spin_ns),
        ));
    }
}

/// Adds a row for each port whose four counters are not all zero.
pub(super) fn port_rows(table: &mut Table, name: &str, counters: [[u8; 4]; 4]) {
    for port in 0..4 {
        let of_port = counters.map(|counter| counter[port]);
        if of_port != [0; 4] {
            let [invalid, rx, forwarded, lost] = of_port;
            table.row(cells![name, port, invalid, rx, forwarded, lost]);
        }
    }
}

fn errors(devices: &[DeviceErrors]) -> Table {
    let mut table =
        Table::new("SubDevice|port|invalid frames|receive errors|found bad before|lost links");
    for device in devices {
        let ports = [
            device.invalid_frames,
            device.rx_errors,
            device.forwarded,
            device.lost_links,
        ];
        port_rows(&mut table, &device.name, ports);
        for (what, count) in [("unit", device.processing_unit), ("PDI", device.pdi)] {
            if count > 0 {
                table.row(cells![device.name, what, count, "", "", ""]);
            }
        }
    }
    table
}

fn gateways(gateways: &[GatewaySummary], out: &mut Document) {
    let mut table = Table::new("gateway|node|drive|state|lost");
    for gateway in gateways {
        for node in &gateway.nodes {
            let lost = match node.losses {
                0 => String::new(),
                count => format::times(count),
            };
            table.row(cells![gateway.name, node.id, node.drive, node.state, lost]);
        }
    }
    out.gap();
    out.table(table);
    for gateway in gateways.iter().filter(|gateway| !gateway.errors.is_empty()) {
        let errors = gateway.errors.join(", ");
        out.line(format!("`{}` has reported: {errors}", gateway.name));
    }
}

/// Shows the ports of the virtual switch (EoE).
fn ethernet(ports: &[EthernetCounters], out: &mut Document) {
    let mut table = Table::new("Ethernet (EoE)|frames from it|to it|dropped");
    for port in ports {
        let dropped = [
            port.overflows,
            port.not_taken,
            port.invalid,
            port.incomplete,
        ];
        let dropped: u64 = dropped.iter().sum();
        table.row(cells![port.name, port.from_port, port.to_port, dropped]);
    }
    out.gap();
    out.table(table);
    for port in ports {
        let delays = [(port.from_delay, "from"), (port.to_delay, "to")];
        for (delay, direction) in delays {
            if let Some(mean) = delay.mean_ns() {
                out.line(format!(
                    "delay {direction} the port of `{}`: mean {} µs, at most {} µs ({} frames)",
                    port.name,
                    mean / 1000,
                    delay.max_ns / 1000,
                    delay.frames
                ));
            }
        }
    }
    for port in ports.iter().filter(|port| port.unsupported) {
        out.line(format!(
            "`{}` has refused EoE with mailbox error 0x0002: omit `eoe`, or use the ESI file of its firmware",
            port.name
        ));
    }
}

fn emergencies(emergencies: &[EmergencyLine], more: u64, out: &mut Document) {
    let mut table = Table::new("time|device|emergency|register|data|what");
    for line in emergencies {
        let (at, register) = (
            format!("{:.3} s", line.at_s),
            format!("0x{:02x}", line.register),
        );
        let data = hex_bytes(&line.data, " ");
        table.row(cells![
            at,
            line.device,
            hex16(line.code),
            register,
            data,
            line.text
        ]);
    }
    out.gap();
    out.table(table);
    match more {
        0 => {}
        1 => out.line("1 more emergency is not kept"),
        n => out.line(format!("{n} more emergencies are not kept")),
    }
}

/// Returns the events of the cycle with their times.
pub(super) fn events(events: &[EventLine]) -> Table {
    let mut table = Table::new("time|cycle|what the cycle noticed last");
    for event in events {
        let (first, last) = (event.first_cycle, event.last_cycle);
        let cycles = match first == last {
            true => first.to_string(),
            false => format!("{first}-{last}"),
        };
        table.row(cells![format!("{:.3} s", event.at_s), cycles, event.what]);
    }
    table
}

fn axes(summary: &Summary, out: &mut Document) {
    let mut table =
        Table::new("axis|mode|target|final position|off by|largest following error|state");
    for axis in &summary.axes {
        table.row(self::axis(axis));
    }
    out.gap();
    out.table(table);
    for axis in &summary.axes {
        for what in [&axis.fault, &axis.trip].into_iter().flatten() {
            out.line(format!("{}: {what}", axis.name));
        }
    }
    for stop in &summary.group_stops {
        let end = if stop.released {
            "reset since"
        } else {
            "not reset"
        };
        out.line(format!(
            "group `{}` stopped, {end}: {}",
            stop.group, stop.cause
        ));
    }
}

fn axis(axis: &AxisSummary) -> [String; 7] {
    let unit = &axis.unit;
    let position = |x: f64| format!("{:.4} {unit}", positive_zero(x, 4));
    let cyclic_position = axis.mode == "csp" && axis.was_enabled;
    let heard = axis.last_heard_s.is_none();
    let only = |show: bool, text: String| if show { text } else { "-".to_owned() };
    let target = position(axis.target_place.unwrap_or(axis.target_position));
    let actual = position(axis.final_place.unwrap_or(axis.final_position));
    let off = match axis.final_error_counts {
        Some(1) if heard => "1 count".to_owned(),
        Some(n) if heard => format!("{n} counts"),
        _ => "-".to_owned(),
    };
    let state = match axis.last_heard_s {
        Some(at_s) => format!("not heard since {}", seconds(at_s)),
        None => axis.final_state.clone(),
    };
    cells![
        axis.name,
        axis.mode,
        only(cyclic_position, target),
        only(axis.was_enabled && heard, actual),
        off,
        only(cyclic_position, position(axis.largest_following_error)),
        state
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Summary {
        let times = Percentiles {
            count: 9,
            p50_ns: 120,
            p99_ns: 1500,
            p99_9_ns: 2000,
            max_ns: 2_000_000,
        };
        Summary {
            machine: "m.toml".into(),
            machine_sha256: String::new(),
            version: "",
            devices: 1,
            time: "virtual",
            cycle_ns: 1_000_000,
            machine_seconds: 12.5,
            program_runs: 2,
            interrupted: false,
            counters: ecaxis_master::rt::stats::Counters {
                cycles: 12_500,
                lost_frames: 1,
                ..Default::default()
            },
            link: ecaxis_master::link::LinkStats::default(),
            wake_up_lateness: times,
            round_trip: times,
            dc_phase_error: Some(times),
            work: Percentiles::default(),
            thread: None,
            axes: vec![AxisSummary {
                name: "x".into(),
                unit: "mm".into(),
                mode: "csp".into(),
                was_enabled: true,
                final_position: -0.000_01,
                target_position: 0.0,
                final_place: None,
                target_place: None,
                final_error_counts: Some(0),
                largest_following_error: 0.1234,
                final_state: "Switch on disabled".into(),
                last_heard_s: None,
                fault: None,
                trip: None,
            }],
            probes: vec![ecaxis_master::session::ProbeCapture {
                step: "3".into(),
                axis: "x".into(),
                input: 2,
                edge: "falling",
                times: 3,
                position: 725.0,
                place: Some(5.0),
                unit: "deg".into(),
            }],
            errors: vec![DeviceErrors {
                name: "x".into(),
                invalid_frames: [0, 3, 0, 0],
                rx_errors: [0, 4, 0, 0],
                forwarded: [0; 4],
                lost_links: [0, 1, 0, 0],
                processing_unit: 0,
                pdi: 0,
            }],
            emergencies: vec![EmergencyLine {
                device: "x".into(),
                at_s: -0.25,
                dc_time_ns: None,
                code: 0x8611,
                text: "following error".into(),
                register: 0x20,
                data: [1, 2, 3, 4, 0xff],
            }],
            more_emergencies: 2,
            ethernet: Vec::new(),
            gateways: vec![GatewaySummary {
                name: "can".into(),
                errors: vec!["CAN error passive"],
                nodes: vec![ecaxis_master::session::NodeSummary {
                    id: 5,
                    drive: "EPOS 24/5",
                    state: "PRE-OPERATIONAL".into(),
                    losses: 1,
                }],
            }],
            events: vec![
                EventLine {
                    at_s: 1.25,
                    first_cycle: 1250,
                    last_cycle: 1252,
                    what: "frames were not back before the deadline".into(),
                    failure: false,
                },
                EventLine {
                    at_s: 1.252,
                    first_cycle: 1252,
                    last_cycle: 1252,
                    what: "stop: 3 cycles in a row without a valid answer".into(),
                    failure: true,
                },
            ],
            group_stops: vec![ecaxis_master::session::GroupStop {
                group: "gantry".into(),
                cause: "`x`: drive fault".into(),
                released: true,
            }],
            recorded_frames: Some(7),
            recorded_frames_dropped: Some(0),
        }
    }

    #[test]
    fn summary_prints_all_figures() {
        let expected = "\
m.toml: 1 SubDevice, 12.500 s in virtual time, 2 complete runs of the program

  cycles                  12500  of 1 ms
  lost frames             1      not back before the deadline
  late frames             0
  working-counter errors  0

                    p50     p99     p99.9  max
  wake-up lateness  120 ns  1.5 µs  2 µs   2 ms
  round trip        120 ns  1.5 µs  2 µs   2 ms
  work a cycle      -       -       -      -
  DC phase error    120 ns  1.5 µs  2 µs   2 ms

  axis  mode  target     final position  off by    largest following error  state
  x     csp   0.0000 mm  0.0000 mm       0 counts  0.1234 mm                Switch on disabled
  group `gantry` stopped, reset since: `x`: drive fault

  step 3: `x`: falling edge of input 2 at 5.0000 deg (the last of 3)

  SubDevice  port  invalid frames  receive errors  found bad before  lost links
  x          1     3               4               0                 1

  gateway  node  drive      state            lost
  can      5     EPOS 24/5  PRE-OPERATIONAL  once
  `can` has reported: CAN error passive

  time      device  emergency  register  data            what
  -0.250 s  x       0x8611     0x20      01 02 03 04 ff  following error
  2 more emergencies are not kept

  time     cycle      what the cycle noticed last
  1.250 s  1250-1252  frames were not back before the deadline
  1.252 s  1252       stop: 3 cycles in a row without a valid answer

  7 frames recorded
";
        assert_eq!(summary(&sample()).text(None), expected);
    }

    #[test]
    fn summary_shows_when_an_axis_was_last_heard() {
        let mut summary = sample();
        summary.axes[0].last_heard_s = Some(0.908);
        let text = self::summary(&summary).text(None);
        let line = text.lines().find(|line| line.starts_with("  x ")).unwrap();
        let cells: Vec<&str> = line
            .split("  ")
            .map(str::trim)
            .filter(|c| !c.is_empty())
            .collect();
        let expected = [
            "x",
            "csp",
            "0.0000 mm",
            "-",
            "-",
            "0.1234 mm",
            "not heard since 0.908 s",
        ];
        assert_eq!(cells, expected);
    }

    #[test]
    fn summary_prints_thread_figures() {
        let thread = ThreadSummary {
            used: ecaxis_master::sys::process::ThreadUsage {
                cpu_ns: 625_000_000,
                minor_faults: 3,
                major_faults: 1,
                voluntary_switches: 12_500,
                involuntary_switches: 125,
            },
            load_percent: 5.0,
            sleep_lateness: sample().wake_up_lateness,
            spin_ns: 34_000,
        };
        let summary = Summary {
            thread: Some(thread),
            ..sample()
        };
        let expected = "
  real-time thread: 5.0 % of its CPU, 50 µs a cycle; 1.01 context switches a cycle, 125 against its will; 4 page faults, 1 of them from disk
  sleeping ends late by 120 ns (p50), 1.5 µs (p99), 2 µs (p99.9); 34 µs are spun before a release
";
        assert!(self::summary(&summary).text(None).contains(expected));
    }
}
