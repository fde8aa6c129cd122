//! The cyclic data of the report: working counters and intervals, clocks, axes.

use ecaxis_axis::units::RawVelocity;
use hdrhistogram::Histogram;

use super::build::Since;
use super::{
    AxisReport, ClockReport, ClocksReport, CycleReport, DeviceReport, FOLLOWING_ERROR, Plot,
    WkcRun, called,
};
use crate::analyze::axes::Curve;
use crate::analyze::clocks::{Clocks, Reference};
use crate::analyze::cycle::{Cycle, Group, Key};
use crate::analyze::segment::RecordedSegment;

/// An interval longer than this multiple of the usual one contains a skipped cycle.
const GAP: f64 = 1.5;

pub(super) fn cycle(cycle: &Cycle, since: &Since) -> Vec<CycleReport> {
    let mut all: Vec<_> = cycle
        .groups
        .iter()
        .map(|(key, group)| group_report(key, group, since))
        .collect();
    // The most frequent datagram determines the cycle.
    all.sort_by(|a, b| {
        b.count
            .cmp(&a.count)
            .then(a.logical_address.cmp(&b.logical_address))
    });
    all
}

fn quantile(histogram: &Histogram<u64>, quantile: f64) -> u64 {
    histogram.value_at_quantile(quantile)
}

fn group_report(key: &Key, group: &Group, since: &Since) -> CycleReport {
    let (command, logical_address, bytes) = *key;
    let cycle_ns = quantile(&group.intervals, 0.5);
    let answered = !group.round_trips.is_empty();
    let mut gaps: Vec<(f64, u64)> = group
        .gaps
        .iter()
        .filter(|(interval, _)| *interval as f64 > GAP * cycle_ns as f64)
        .map(|(interval, at)| (since.seconds(*at), *interval))
        .collect();
    gaps.sort_by_key(|gap| std::cmp::Reverse(gap.1));
    CycleReport {
        command: command.name(),
        logical_address,
        bytes,
        count: group.sent,
        lost: group.lost,
        cycle_ns,
        interval_min_ns: group.intervals.min(),
        interval_p1_ns: quantile(&group.intervals, 0.01),
        interval_p99_ns: quantile(&group.intervals, 0.99),
        interval_max_ns: group.intervals.max(),
        gaps,
        round_trip_p50_ns: answered.then(|| quantile(&group.round_trips, 0.5)),
        round_trip_max_ns: answered.then(|| group.round_trips.max()),
        usual_wkc: group.usual(),
        wkc: group
            .counters
            .iter()
            .map(|(wkc, count)| (*wkc, *count))
            .collect(),
        runs: group
            .runs
            .iter()
            .map(|run| WkcRun {
                at: since.seconds(run.at),
                wkc: run.wkc,
                cycles: run.cycles,
            })
            .collect(),
        more_runs: group.more_runs,
    }
}

pub(super) fn clocks(clocks: &Clocks) -> ClocksReport {
    let reference = clocks.reference.as_ref();
    let jitter = reference
        .map(|r| &r.jitter)
        .filter(|jitter| !jitter.is_empty());
    ClocksReport {
        reference: reference.map(|r| r.station),
        readings: reference.map_or(0, |r| r.readings),
        rate_ppm: reference.and_then(Reference::rate_ppm),
        jitter_p50_ns: jitter.map(|jitter| quantile(jitter, 0.5)),
        jitter_p99_ns: jitter.map(|jitter| quantile(jitter, 0.99)),
        differences: clocks
            .differences
            .iter()
            .map(|(station, d)| ClockReport {
                station: *station,
                readings: d.readings,
                p50_ns: quantile(&d.amounts, 0.5),
                p99_ns: quantile(&d.amounts, 0.99),
                max_ns: d.amounts.max(),
                last_ns: d.last,
            })
            .collect(),
    }
}

pub(super) fn axes(
    segment: &RecordedSegment,
    order: &[usize],
    devices: &[DeviceReport],
    since: &Since,
) -> Vec<AxisReport> {
    let mut reports = Vec::new();
    for (place, (n, reported)) in order.iter().zip(devices).enumerate() {
        let Some(device) = segment.devices.get(*n) else {
            continue;
        };
        for axis in device.axes.seen() {
            let number = usize::from(axis.number);
            let known = segment
                .known
                .axis(device.position, reported.product, number);
            let (scale, unit) = match known {
                Some((scale, unit)) => (Some(scale), unit.clone()),
                None => (None, "counts".to_owned()),
            };
            let position = |counts: f64| {
                let counts_of = ecaxis_axis::units::Counts(counts as i64);
                scale.map_or(counts, |scale| scale.position_to_user(counts_of).0)
            };
            let raw = |value: f64| value;
            let seconds = |at: u64| since.seconds(at);
            let plot = |title, unit: &str, pair: &(Curve, Curve), to: &dyn Fn(f64) -> f64| {
                let of = |curve: &Curve| -> Vec<(f64, f64, f64)> {
                    let points = curve.points.iter().map(|(at, low, high)| {
                        // An inverted direction swaps the limits.
                        let (a, b) = (to(*low), to(*high));
                        (seconds(*at), a.min(b), a.max(b))
                    });
                    points.collect()
                };
                Plot {
                    title,
                    unit: unit.to_owned(),
                    target: of(&pair.0),
                    actual: of(&pair.1),
                }
            };
            let distance =
                |counts: f64| scale.map_or(counts, |scale| scale.units_of_counts(counts));
            let velocity = |raw: f64| {
                let velocity = RawVelocity(raw as i32);
                scale.map_or(raw, |scale| scale.velocity_to_user(velocity).0)
            };
            let velocity_unit = match scale {
                Some(_) => format!("{unit}/s"),
                None => "drive units".to_owned(),
            };
            let error = (Curve::default(), axis.following_error.clone());
            let plots = [
                plot("Position", &unit, &axis.position, &position),
                plot(FOLLOWING_ERROR, &unit, &error, &distance),
                plot("Velocity", &velocity_unit, &axis.velocity, &velocity),
                plot("Torque", "‰ of rated torque", &axis.torque, &raw),
            ];
            let name = match axis.number {
                0 => called(place, reported),
                number => format!("{} axis {number}", called(place, reported)),
            };
            let error = axis.largest_error.map(|error| error as f64);
            reports.push(AxisReport {
                device: place,
                name,
                cycles: axis.cycles,
                commanded: axis.commanded,
                states: axis
                    .states
                    .iter()
                    .map(|(at, s)| (seconds(*at), s.to_string()))
                    .collect(),
                modes: axis
                    .modes
                    .iter()
                    .map(|(at, m)| (seconds(*at), m.to_string()))
                    .collect(),
                error_code: axis.error,
                largest_following_error: error
                    .map(|error| scale.map_or(error, |scale| scale.units_of_counts(error).abs())),
                travelled: axis.position.1.range().map(|(low, high)| {
                    let (a, b) = (position(low), position(high));
                    (a.min(b), a.max(b))
                }),
                unit,
                plots: plots
                    .into_iter()
                    .filter(|plot| !plot.target.is_empty() || !plot.actual.is_empty())
                    .filter(|_| axis.commanded)
                    .collect(),
            });
        }
    }
    reports
}
