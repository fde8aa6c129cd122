//! Metrics in the Prometheus text format, version 0.0.4. docs/monitoring.md lists them.

use std::fmt::Write as _;
use std::sync::atomic::{AtomicU64, Ordering};

use ecaxis_axis::State;
use ecaxis_master::acyclic::AlState;
use ecaxis_master::config::Machine;
use ecaxis_master::link::redundant::RingState;
use ecaxis_master::rt::stats::LatencyHistogram;
use ecaxis_master::{COMMIT, VERSION};

use crate::hub::{BusState, Count, Counts, Hub, Latest};

/// The upper bounds of the buckets of all times.
const BOUNDS_NS: [u64; 12] = [
    1_000, 2_000, 5_000, 10_000, 20_000, 50_000, 100_000, 200_000, 500_000, 1_000_000, 2_000_000,
    5_000_000,
];
const BUS_STATES: [(BusState, &str); 5] = [
    (BusState::Down, "down"),
    (BusState::Starting, "starting"),
    (BusState::Op, "op"),
    (BusState::Stopping, "stopping"),
    (BusState::Failed, "failed"),
];
const AL_STATES: [AlState; 5] = [
    AlState::Init,
    AlState::PreOp,
    AlState::Bootstrap,
    AlState::SafeOp,
    AlState::Op,
];
const AXIS_STATES: [State; 8] = [
    State::NotReadyToSwitchOn,
    State::SwitchOnDisabled,
    State::ReadyToSwitchOn,
    State::SwitchedOn,
    State::OperationEnabled,
    State::QuickStopActive,
    State::FaultReactionActive,
    State::Fault,
];
/// The times of a cycle, in the order of the columns of a cycle.
const TIMES: [(&str, &str); 4] = [
    (
        "ecaxis_wakeup_lateness_seconds",
        "Wake-up after the planned release.",
    ),
    (
        "ecaxis_exchange_seconds",
        "Release of the frames to the last answer.",
    ),
    (
        "ecaxis_dc_phase_seconds",
        "Magnitude of the phase error against SYNC0.",
    ),
    (
        "ecaxis_work_seconds",
        "Wake-up to the end of the cycle's work.",
    ),
];

/// Returns all metrics.
#[must_use]
pub fn text(hub: &Hub) -> String {
    let mut text = Text::default();
    let machine = &*hub.machine;
    server(&mut text, hub);
    counted(&mut text, machine, &hub.counts());
    for ((name, help), times) in TIMES.iter().zip(&hub.sampler.timing().histograms) {
        text.histogram(name, help, times);
    }
    if let Some(latest) = hub.latest().as_deref() {
        cycle(&mut text, latest);
        devices(&mut text, machine, latest);
        axes(&mut text, machine, latest);
    }
    text.0
}

fn server(text: &mut Text, hub: &Hub) {
    let machine = &*hub.machine;
    let seconds = |ns: u64| ns as f64 * 1e-9;
    text.family(
        "ecaxis_build_info",
        "gauge",
        "The version of the server.",
        |out| {
            out.put(
                &[
                    ("version", VERSION),
                    ("commit", COMMIT.unwrap_or("unknown")),
                ],
                1.0,
            )
        },
    );
    let (file, sha256) = (machine.path.to_string_lossy(), machine.sha256.to_string());
    text.family("ecaxis_machine_info", "gauge", "The machine file.", |out| {
        out.put(&[("file", &file), ("sha256", &sha256)], 1.0);
    });
    text.gauge(
        "ecaxis_cycle_seconds",
        "The nominal cycle time.",
        seconds(machine.bus.cycle_ns),
    );
    text.gauge(
        "ecaxis_dc_window_seconds",
        "The greatest permitted difference of a device's clock.",
        seconds(machine.bus.clock_window_ns),
    );
    let state = hub.bus_state();
    text.family(
        "ecaxis_bus_state",
        "gauge",
        "1 for the present state.",
        |out| {
            for (each, name) in BUS_STATES {
                out.put(&[("state", name)], f64::from(each == state));
            }
        },
    );
    if let Some(ring) = hub.ring() {
        let closed = ring.get() == RingState::Closed;
        let help = "1 if the ring of a machine with cable redundancy is closed.";
        text.gauge("ecaxis_ring_closed", help, f64::from(closed));
        let help = "Breaks of the ring.";
        text.family("ecaxis_ring_breaks_total", "counter", help, |out| {
            out.put(&[], ring.breaks().0.into());
        });
        let help = "1 if the interface at an end of the ring has a link.";
        text.family("ecaxis_interface_link", "gauge", help, |out| {
            for (nic, has_link) in ring.links() {
                out.put(&[("interface", nic)], f64::from(has_link));
            }
        });
    }
    let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
    let area = &hub.area;
    for (name, help, value) in [
        (
            "ecaxis_samples_missed_total",
            "Cycles that history and histograms lack.",
            hub.sampler.missed(),
        ),
        (
            "ecaxis_area_used_total",
            "Sets of set-points used from the cyclic area.",
            read(&area.used),
        ),
        (
            "ecaxis_area_late_total",
            "Cycles without a new set in the cyclic area.",
            read(&area.late),
        ),
        (
            "ecaxis_area_refused_total",
            "Refused set-points of the cyclic area.",
            read(&area.refused),
        ),
        (
            "ecaxis_area_stops_total",
            "Axes stopped because of the cyclic area.",
            read(&area.stopped),
        ),
    ] {
        text.counter(name, help, value);
    }
}

/// What the server has counted since its start. Known names begin at 0.
fn counted(text: &mut Text, machine: &Machine, counts: &Counts) {
    let of = |what, name: &str| counts.get(&(what, name.to_owned())).copied();
    text.family("ecaxis_events_total", "counter", "Events by kind.", |out| {
        for ((what, kind), count) in counts {
            if *what == Count::Event {
                out.put(&[("event", kind)], *count as f64);
            }
        }
    });
    text.family(
        "ecaxis_emergencies_total",
        "counter",
        "CoE emergencies.",
        |out| {
            for device in &machine.devices {
                let count = of(Count::Emergency, &device.name).unwrap_or(0);
                out.put(&[("device", &device.name)], count as f64);
            }
        },
    );
    text.family(
        "ecaxis_axis_trips_total",
        "counter",
        "Faults of the drive and trips of the supervision.",
        |out| {
            for axis in &machine.axes {
                for (what, cause) in [(Count::Fault, "drive"), (Count::Trip, "supervision")] {
                    let count = of(what, &axis.name).unwrap_or(0);
                    out.put(&[("axis", &axis.name), ("cause", cause)], count as f64);
                }
            }
        },
    );
    let groups = machine.axes.enumerate();
    let groups = groups.map(|(index, _)| machine.group_name(machine.group_of_axis(index)));
    let groups: std::collections::BTreeSet<_> = groups.collect();
    text.family(
        "ecaxis_stops_total",
        "counter",
        "Stops of a group by a failure.",
        |out| {
            for group in groups {
                let count = of(Count::Stop, group).unwrap_or(0);
                out.put(&[("group", group)], count as f64);
            }
        },
    );
}

fn cycle(text: &mut Text, latest: &Latest) {
    let snapshot = &latest.snapshot;
    let counters = &snapshot.counters;
    for (name, help, value) in [
        ("ecaxis_cycles_total", "Cycles.", counters.cycles),
        (
            "ecaxis_cycles_lost_total",
            "Cycles whose frames did not all come back in time.",
            counters.lost_frames,
        ),
        (
            "ecaxis_cycles_overrun_total",
            "Cycles skipped because of a late wake-up.",
            counters.overruns,
        ),
        (
            "ecaxis_frames_late_total",
            "Frames that came back in a later cycle, or twice.",
            counters.late_frames,
        ),
        (
            "ecaxis_wkc_errors_total",
            "Cycles with an unexpected working counter.",
            counters.wkc_errors,
        ),
        (
            "ecaxis_link_errors_total",
            "Sends and receives that failed.",
            counters.link_errors,
        ),
        (
            "ecaxis_mailbox_refused_total",
            "Mailbox answers that came too late or damaged.",
            counters.refused_answers,
        ),
        (
            "ecaxis_rt_events_lost_total",
            "Events of the cycle dropped by a full queue.",
            snapshot.events_lost,
        ),
    ] {
        text.counter(name, help, value);
    }
    let common = &snapshot.common_time;
    let (locked, alignment) = (f64::from(common.locked), common.alignment);
    for (name, help, value) in [
        (
            "ecaxis_common_time_locked",
            "1 if offset and drift of the bus against common time are known.",
            Some(locked),
        ),
        (
            "ecaxis_common_time_offset_seconds",
            "Common time minus system time of the bus.",
            common.locked.then_some(common.offset_ns as f64 * 1e-9),
        ),
        (
            "ecaxis_common_time_drift_ppm",
            "Rate of common time against the system time of the bus.",
            common.locked.then_some(common.drift_ppm),
        ),
        (
            "ecaxis_common_time_jitter_seconds",
            "Mean deviation of one measurement of common time.",
            Some(common.jitter_ns * 1e-9),
        ),
        (
            "ecaxis_sync0_offset_seconds",
            "Time from a multiple of the cycle in common time to SYNC0, if aligned.",
            alignment
                .filter(|_| common.locked)
                .map(|a| a.sync0_ns * 1e-9),
        ),
    ] {
        text.family(name, "gauge", help, |out| {
            if let Some(value) = value {
                out.put(&[], value);
            }
        });
    }
    text.counter(
        "ecaxis_common_time_jumps_total",
        "Jumps of common time.",
        common.jumps,
    );
    if let Some(phase) = snapshot.phase {
        for (name, help, value) in [
            (
                "ecaxis_dc_phase_error_seconds",
                "Phase error against SYNC0.",
                phase.error_ns as f64 * 1e-9,
            ),
            (
                "ecaxis_dc_drift_ppm",
                "Rate of the host's clock against the reference clock.",
                phase.drift_ppm,
            ),
            (
                "ecaxis_dc_phase_locked",
                "1 if the release of frames is in phase with SYNC0.",
                f64::from(phase.locked),
            ),
        ] {
            text.gauge(name, help, value);
        }
    }
}

fn devices(text: &mut Text, machine: &Machine, latest: &Latest) {
    let found = || {
        let devices = machine.devices.enumerate();
        devices.filter_map(|(index, device)| {
            let found = latest.snapshot.diagnoses.get(index)?;
            Some((device.name.as_str(), device.selection.dc.is_some(), found))
        })
    };
    text.family(
        "ecaxis_device_al_state",
        "gauge",
        "1 for the present state.",
        |out| {
            for (device, _, found) in found() {
                let now = AlState::from_status(found.al_status);
                for state in AL_STATES {
                    let labels = [("device", device), ("state", &*state.to_string())];
                    out.put(&labels, f64::from(state == now));
                }
            }
        },
    );
    text.family(
        "ecaxis_device_answers",
        "gauge",
        "1 if the device has answered the last diagnostic read.",
        |out| {
            for (device, _, found) in found() {
                out.put(&[("device", device)], f64::from(found.answers));
            }
        },
    );
    text.family(
        "ecaxis_dc_difference_seconds",
        "gauge",
        "The device's clock minus the reference clock.",
        |out| {
            for (device, _, found) in found().filter(|(_, dc, _)| *dc) {
                let difference = f64::from(found.clock_difference) * 1e-9;
                out.put(&[("device", device)], difference);
            }
        },
    );
    text.family(
        "ecaxis_port_errors_total",
        "counter",
        "Errors counted by the device's ports in this run; a port counts to 255.",
        |out| {
            for (device, _, found) in found() {
                let grown = found.grown();
                for (kind, ports) in [
                    ("crc", grown.invalid_frames),
                    ("rx", grown.rx_errors),
                    ("forwarded", grown.forwarded),
                    ("lost_link", grown.lost_links),
                ] {
                    for (port, errors) in ["0", "1", "2", "3"].iter().zip(ports) {
                        let labels = [("device", device), ("port", port), ("kind", kind)];
                        out.put(&labels, f64::from(errors));
                    }
                }
            }
        },
    );
}

fn axes(text: &mut Text, machine: &Machine, latest: &Latest) {
    let all = || {
        let axes = machine.axes.enumerate();
        axes.filter_map(|(index, axis)| Some((axis, latest.snapshot.axes.get(index)?)))
    };
    text.family(
        "ecaxis_axis_state",
        "gauge",
        "1 for the present state (CiA 402).",
        |out| {
            for (axis, status) in all() {
                for state in AXIS_STATES {
                    let labels = [("axis", axis.name.as_str()), ("state", &*state.to_string())];
                    out.put(&labels, f64::from(state == status.state));
                }
            }
        },
    );
    text.family(
        "ecaxis_axis_position",
        "gauge",
        "Reported position in the axis's unit.",
        |out| {
            for (axis, status) in all() {
                out.put(
                    &[("axis", &axis.name), ("unit", &axis.unit)],
                    status.position,
                );
            }
        },
    );
    text.family(
        "ecaxis_axis_following_error",
        "gauge",
        "Commanded minus reported position in the axis's unit.",
        |out| {
            for (axis, status) in all() {
                out.put(&[("axis", &axis.name)], status.following_error);
            }
        },
    );
    text.family(
        "ecaxis_axis_torque_ratio",
        "gauge",
        "Torque divided by the rated torque.",
        |out| {
            for (axis, status) in all() {
                out.put(&[("axis", &axis.name)], status.torque / 100.0);
            }
        },
    );
}

/// The text so far.
#[derive(Debug, Default)]
struct Text(String);

/// Writes the values of one metric.
struct Family<'t> {
    text: &'t mut String,
    name: &'t str,
}

impl Family<'_> {
    /// Writes a value; without one that exists (NaN) nothing.
    fn put(&mut self, labels: &[(&str, &str)], value: f64) {
        self.put_as("", labels, value);
    }

    fn put_as(&mut self, suffix: &str, labels: &[(&str, &str)], value: f64) {
        if !value.is_finite() {
            return;
        }
        let Self { text, name } = self;
        let _ = write!(text, "{name}{suffix}");
        for (index, (label, content)) in labels.iter().enumerate() {
            let open = if index == 0 { '{' } else { ',' };
            let _ = write!(text, "{open}{label}=\"{}\"", escape(content));
        }
        let close = if labels.is_empty() { "" } else { "}" };
        let _ = writeln!(text, "{close} {value}");
    }
}

impl Text {
    fn family(&mut self, name: &str, kind: &str, help: &str, put: impl FnOnce(&mut Family<'_>)) {
        let text = &mut self.0;
        let _ = writeln!(text, "# HELP {name} {help}\n# TYPE {name} {kind}");
        put(&mut Family { text, name });
    }

    fn gauge(&mut self, name: &str, help: &str, value: f64) {
        self.family(name, "gauge", help, |out| out.put(&[], value));
    }

    fn counter(&mut self, name: &str, help: &str, value: u64) {
        self.family(name, "counter", help, |out| out.put(&[], value as f64));
    }

    fn histogram(&mut self, name: &str, help: &str, times: &LatencyHistogram) {
        self.family(name, "histogram", help, |out| {
            let (mut counts, mut all, mut sum_ns) = ([0_u64; BOUNDS_NS.len()], 0, 0.0);
            for (ns, count) in times.recorded() {
                all += count;
                sum_ns += ns as f64 * count as f64;
                let within = |bound: &u64| ns <= *bound;
                if let Some(bucket) = BOUNDS_NS.iter().position(within) {
                    counts[bucket] += count;
                }
            }
            let mut below = 0;
            for (bound, count) in BOUNDS_NS.iter().zip(counts) {
                below += count;
                let le = (*bound as f64 / 1e9).to_string();
                out.put_as("_bucket", &[("le", &le)], below as f64);
            }
            out.put_as("_bucket", &[("le", "+Inf")], all as f64);
            out.put_as("_sum", &[], sum_ns / 1e9);
            out.put_as("_count", &[], all as f64);
        });
    }
}

fn escape(content: &str) -> String {
    let content = content.replace('\\', "\\\\").replace('"', "\\\"");
    content.replace('\n', "\\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Prometheus, "Exposition formats", "Line format": escapes of label values; lines end with
    /// one newline; HELP and TYPE precede the values.
    #[test]
    fn label_values_are_escaped() {
        let mut text = Text::default();
        text.family("m_total", "counter", "Help.", |out| {
            out.put(&[("a", "C:\\DIR\\"), ("b", "say \"x\"\ny")], 3.0);
            out.put(&[], f64::NAN);
        });
        let expected = "# HELP m_total Help.\n# TYPE m_total counter\n\
                        m_total{a=\"C:\\\\DIR\\\\\",b=\"say \\\"x\\\"\\ny\"} 3\n";
        assert_eq!(text.0, expected);
    }

    /// Prometheus, "Exposition formats", "Histograms and summaries": buckets are cumulative, a
    /// bound belongs to its bucket, `+Inf` equals the count.
    #[test]
    fn buckets_are_cumulative() {
        let mut times = LatencyHistogram::new();
        for (ns, count) in [(500, 2), (1_000, 1), (1_001, 4), (9_000_000_000, 1)] {
            times.record_n(ns, count);
        }
        let mut text = Text::default();
        text.histogram("t_seconds", "Time.", &times);
        let value = |line: &str| {
            let found = text.0.lines().find_map(|each| each.strip_prefix(line));
            found.unwrap().trim().parse::<f64>().unwrap()
        };
        assert_eq!(value("t_seconds_bucket{le=\"0.000001\"}"), 3.0);
        assert_eq!(value("t_seconds_bucket{le=\"0.000002\"}"), 7.0);
        assert_eq!(value("t_seconds_bucket{le=\"0.005\"}"), 7.0);
        assert_eq!(value("t_seconds_bucket{le=\"+Inf\"}"), 8.0);
        assert_eq!(value("t_seconds_count"), 8.0);
        // The histogram has three significant digits.
        let sum = value("t_seconds_sum");
        assert!((sum / 9.000_006 - 1.0).abs() < 1e-3, "{sum}");
    }
}
