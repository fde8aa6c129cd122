//! The figures of a bench.

use std::collections::BTreeMap;

use serde::Serialize;

use super::bus::Counts;
use crate::host::Fact;
use crate::host::counters::CpuTimeDelta;
use ecaxis_master::rt::stats::{Counters, LatencyHistogram};
use ecaxis_master::sys::process::ThreadUsage;

/// The number of histogram steps per decade.
const STEPS_PER_DECADE: f64 = 20.0;

/// The complete result of a bench. Times are in ns.
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    pub version: &'static str,
    /// Facts about the computer.
    pub facts: Vec<Fact>,
    /// Settings that disturb a cycle; `ecaxis doctor` shows the fixes.
    pub findings: Vec<String>,
    pub settings: Vec<Fact>,
    /// The requested cycle first, then the variants to compare with.
    pub variants: Vec<Variant>,
    /// The ratios of each variant to each following one.
    pub ratios: Vec<Ratio>,
    /// Remarks on figures that need caution.
    pub remarks: Vec<String>,
}

/// The result of one variant.
#[derive(Debug, Clone, Serialize)]
pub struct Variant {
    pub name: String,
    pub rounds: u32,
    pub cycles: u64,
    /// Planned release to wake-up.
    pub wake_up_lateness: Option<LatencySummary>,
    /// Planned release to the last answer.
    pub release_to_input: Option<LatencySummary>,
    /// Wake-up to the end of the cycle's work, including the wait for answers.
    pub work: Option<LatencySummary>,
    /// The absolute phase error against SYNC0.
    pub phase_error: Option<LatencySummary>,
    pub counters: Option<Counters>,
    /// Cycles that began so late that their answers were hardly in time.
    pub late_releases: Option<u64>,
    /// The usage of the thread, or of the whole process for other programs.
    pub used: Option<ThreadUsage>,
    pub cpu_ns_per_cycle: Option<f64>,
    /// The load in percent of one CPU.
    pub cpu_percent: Option<f64>,
    pub context_switches_per_cycle: Option<f64>,
    /// The final spin time before a release.
    pub spin_ns: Option<u64>,
    /// Time of the cycle's CPU taken by others.
    pub taken: Option<CpuTimeDelta>,
    pub bus: Option<Counts>,
}

/// With fewer values, the 99th percentile is not meaningful.
pub(super) const FEW: u64 = 1_000;

/// A distribution of times.
#[derive(Debug, Clone, Serialize)]
pub struct LatencySummary {
    pub count: u64,
    pub p50_ns: u64,
    /// `null` if fewer than ten values are longer.
    pub p99_ns: Option<u64>,
    /// `null` if fewer than ten values are longer.
    pub p99_9_ns: Option<u64>,
    pub max_ns: u64,
    /// The upper limit of each step and its count; twenty steps per decade.
    pub histogram: Vec<(u64, u64)>,
}

impl LatencySummary {
    /// Returns the summary, or `None` without values.
    #[must_use]
    pub fn of(times: &LatencyHistogram) -> Option<Self> {
        let summary = times.summary();
        if summary.count == 0 {
            return None;
        }
        let mut steps = BTreeMap::new();
        for (nanos, count) in times.recorded() {
            let step = ((nanos.max(1) as f64).log10() * STEPS_PER_DECADE).ceil();
            *steps.entry(step as u64).or_insert(0) += count;
        }
        let end = |step: u64| 10_f64.powf(step as f64 / STEPS_PER_DECADE).round() as u64;
        Some(Self {
            count: summary.count,
            p50_ns: summary.p50_ns,
            p99_ns: (summary.count >= FEW).then_some(summary.p99_ns),
            p99_9_ns: (summary.count >= 10_000).then_some(summary.p99_9_ns),
            max_ns: summary.max_ns,
            histogram: steps.into_iter().map(|(step, n)| (end(step), n)).collect(),
        })
    }
}

/// One measure of one variant divided by that of another.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Ratio {
    pub measure: Measure,
    pub of: String,
    pub to: String,
    pub p50: Option<f64>,
    pub p99: Option<f64>,
    pub p99_9: Option<f64>,
    pub max: Option<f64>,
    /// The ratio, if it is a single number.
    pub value: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Measure {
    WakeUpLateness,
    ReleaseToInput,
    /// Release to input without the delay of the bus.
    SoftwareShare,
    CpuPerCycle,
}

impl Measure {
    /// Returns the heading of the measure.
    pub(super) fn title(self) -> &'static str {
        match self {
            Self::WakeUpLateness => "Wake-up lateness",
            Self::ReleaseToInput | Self::SoftwareShare => "Release to input",
            Self::CpuPerCycle => "",
        }
    }

    /// Returns the explanation below the heading.
    pub(super) fn note(self) -> &'static str {
        match self {
            Self::SoftwareShare => ", less hold",
            _ => "",
        }
    }
}

fn quotient(a: u64, b: u64) -> Option<f64> {
    (b > 0).then(|| a as f64 / b as f64)
}

/// Returns the ratios of every variant to each following one. `hold` is the delay of every reply by
/// the bus.
#[must_use]
pub fn ratios(variants: &[Variant], hold: Option<u64>) -> Vec<Ratio> {
    let mut ratios = Vec::new();
    for (place, first) in variants.iter().enumerate() {
        for other in &variants[place + 1..] {
            of_two(first, other, hold, &mut ratios);
        }
    }
    ratios
}

fn of_two(first: &Variant, other: &Variant, hold: Option<u64>, ratios: &mut Vec<Ratio>) {
    let mut add = |measure, a: &Option<LatencySummary>, b: &Option<LatencySummary>, less: u64| {
        let (Some(a), Some(b)) = (a, b) else { return };
        let by = |a: u64, b: u64| quotient(a.saturating_sub(less), b.saturating_sub(less));
        ratios.push(Ratio {
            measure,
            of: first.name.clone(),
            to: other.name.clone(),
            p50: by(a.p50_ns, b.p50_ns),
            p99: a.p99_ns.zip(b.p99_ns).and_then(|(a, b)| by(a, b)),
            p99_9: a.p99_9_ns.zip(b.p99_9_ns).and_then(|(a, b)| by(a, b)),
            max: by(a.max_ns, b.max_ns),
            value: None,
        });
    };
    add(
        Measure::WakeUpLateness,
        &first.wake_up_lateness,
        &other.wake_up_lateness,
        0,
    );
    let (a, b) = (&first.release_to_input, &other.release_to_input);
    match hold {
        Some(hold) => add(Measure::SoftwareShare, a, b, hold),
        None => add(Measure::ReleaseToInput, a, b, 0),
    }
    if let (Some(a), Some(b)) = (first.cpu_ns_per_cycle, other.cpu_ns_per_cycle)
        && b > 0.0
    {
        ratios.push(Ratio {
            measure: Measure::CpuPerCycle,
            of: first.name.clone(),
            to: other.name.clone(),
            p50: None,
            p99: None,
            p99_9: None,
            max: None,
            value: Some(a / b),
        });
    }
}

/// Returns the lost cycles of a variant, and how many of them neither the bus nor the other CPU can
/// have caused.
#[must_use]
pub fn losses(variant: &Variant) -> Option<(u64, u64)> {
    let counters = variant.counters?;
    let elsewhere = variant.bus.map_or(0, |bus| {
        bus.dropped + bus.delayed + bus.not_sent + bus.too_late
    });
    let lost = counters.lost_frames;
    Some((lost, lost.saturating_sub(elsewhere)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn times(values: impl IntoIterator<Item = u64>) -> LatencyHistogram {
        let mut times = LatencyHistogram::new();
        values.into_iter().for_each(|n| times.record(n));
        times
    }

    fn variant(name: &str, lateness: u64, round_trip: u64, cpu: f64) -> Variant {
        Variant {
            name: name.to_owned(),
            rounds: 1,
            cycles: 100,
            wake_up_lateness: LatencySummary::of(&times([lateness; 100])),
            release_to_input: LatencySummary::of(&times([round_trip; 100])),
            work: None,
            phase_error: None,
            counters: None,
            late_releases: None,
            used: None,
            cpu_ns_per_cycle: Some(cpu),
            cpu_percent: None,
            context_switches_per_cycle: None,
            spin_ns: None,
            taken: None,
            bus: None,
        }
    }

    #[test]
    fn histogram_keeps_every_value() {
        let dist = LatencySummary::of(&times((1..=20_000).map(|n| n * 7))).expect("recorded");
        assert_eq!(dist.histogram.iter().map(|(_, n)| n).sum::<u64>(), 20_000);
        assert!(dist.histogram.is_sorted());
        assert!(dist.p99_9_ns.is_some());
        assert!(LatencySummary::of(&times([])).is_none());
        assert_eq!(
            LatencySummary::of(&times([5; 9_999]))
                .expect("some")
                .p99_9_ns,
            None
        );
        assert!(
            LatencySummary::of(&times([5; 1_000]))
                .expect("some")
                .p99_ns
                .is_some()
        );
        assert_eq!(
            LatencySummary::of(&times([5; 999])).expect("some").p99_ns,
            None
        );
    }

    #[test]
    fn ratios_compare_the_first_variant_without_the_hold() {
        let all = [
            variant("a", 100, 36_000, 10.0),
            variant("b", 1_000, 60_000, 40.0),
        ];
        let ratios = ratios(&all, Some(30_000));
        let by = |measure| ratios.iter().find(|r| r.measure == measure).unwrap();
        let lateness = by(Measure::WakeUpLateness);
        assert_eq!((lateness.of.as_str(), lateness.to.as_str()), ("a", "b"));
        assert!((lateness.p50.unwrap() - 0.1).abs() < 0.001);
        assert_eq!(lateness.p99_9, None);
        assert!((by(Measure::SoftwareShare).p50.unwrap() - 0.2).abs() < 0.002);
        assert_eq!(by(Measure::CpuPerCycle).value, Some(0.25));
    }

    #[test]
    fn losses_exclude_those_of_the_bus() {
        let mut variant = variant("a", 1, 1, 1.0);
        variant.counters = Some(Counters {
            lost_frames: 5,
            ..Counters::default()
        });
        assert_eq!(losses(&variant), Some((5, 5)));
        variant.bus = Some(Counts {
            dropped: 3,
            too_late: 1,
            ..Counts::default()
        });
        assert_eq!(losses(&variant), Some((5, 1)));
        variant.bus.as_mut().unwrap().dropped = 30;
        assert_eq!(losses(&variant), Some((5, 0)));
    }
}
