//! Each rule finds what it forbids: recordings of good runs, changed in one point.

use std::collections::{BTreeMap, BTreeSet};

use super::causes::Cause;
use super::drive::{Moment, Power, Sent};
use super::features::{self, Feature};
use super::judge::{RULES, Run, Times};
use super::{judge_run, run, strike, times};

/// A change of a recording.
type Change = fn(&mut Run, Times);

fn sent(moment: &mut Moment) -> &mut Sent {
    moment.sent.as_mut().expect("in the process data")
}

fn target(run: &mut Run, axis: usize, cycle: usize) -> &mut i32 {
    let sent = sent(&mut run.axes[axis][cycle]);
    sent.position.as_mut().expect("a target")
}

fn set(run: &mut Run, axis: usize, cycles: std::ops::Range<usize>, power: Power) {
    for cycle in cycles {
        sent(&mut run.axes[axis][cycle]).power = power;
    }
}

fn operates(moment: &Moment) -> bool {
    moment.sent.is_some_and(|sent| sent.power == Power::Operate)
}

/// Returns the first cycle after the cause in which the axis no longer operates.
fn end(run: &Run, axis: usize, times: Times) -> usize {
    let mut cycles = times.counts..run.axes[axis].len();
    let end = cycles.find(|cycle| !operates(&run.axes[axis][*cycle]));
    end.expect("a stop")
}

/// Lets the drive move by itself: every report from this cycle on is farther away.
fn drift(run: &mut Run, axis: usize, from: usize, step: i32) {
    let mut way = 0;
    for moment in &mut run.axes[axis][from..] {
        way += step;
        if let Some(report) = &mut moment.report {
            report.position += way;
        }
    }
}

/// The feature, the cause, the rule, and the change that violates it.
const CHANGES: [(&str, Cause, &str, Change); 32] = [
    ("gear", Cause::Emergency, "velocity-limit", |run, at| {
        *target(run, 1, at.shows) += 2000;
    }),
    ("gear", Cause::Emergency, "acceleration-limit", |run, at| {
        *target(run, 1, at.shows - 5) += 20;
    }),
    (
        "gateway axis",
        Cause::Emergency,
        "acceleration-limit",
        |run, at| {
            for cycle in at.shows - 20..at.shows - 16 {
                *target(run, 0, cycle) += 10;
            }
        },
    ),
    (
        "gear",
        Cause::Emergency,
        "differs-before-the-cause",
        |run, at| {
            sent(&mut run.axes[0][at.shows - 1]).word = 0x1f;
        },
    ),
    ("gear", Cause::Emergency, "relation", |run, at| {
        *target(run, 0, at.shows - 1) += 2;
    }),
    ("gear", Cause::Emergency, "quick-stop-is-late", |run, at| {
        set(run, 0, at.shows..at.shows + 3, Power::Operate);
    }),
    ("gear", Cause::Emergency, "not-a-quick-stop", |run, at| {
        let end = end(run, 0, at);
        set(run, 0, end..end + 1, Power::Off);
    }),
    (
        "gear",
        Cause::Emergency,
        "power-removed-in-motion",
        |run, at| {
            let end = end(run, 0, at);
            set(run, 0, end + 2..end + 3, Power::Off);
        },
    ),
    ("gear", Cause::StoppedGroup, "not-at-rest", |run, at| {
        drift(run, 0, at.shows + 400, 40);
    }),
    ("gear", Cause::Emergency, "not-at-rest", |run, _| {
        let last = run.axes[0].len() - 20;
        drift(run, 0, last, 40);
    }),
    ("gear", Cause::Emergency, "power-again", |run, at| {
        let end = end(run, 0, at);
        set(run, 0, end + 5..end + 6, Power::Operate);
    }),
    ("gear", Cause::Emergency, "power-at-the-end", |run, _| {
        let last = run.axes[0].len() - 1;
        set(run, 0, last..last + 1, Power::QuickStop);
    }),
    ("gear", Cause::Emergency, "cause-not-named", |run, _| {
        run.said = "bus lost".to_owned();
    }),
    ("gear", Cause::Emergency, "run-succeeded", |run, _| {
        run.error = None
    }),
    ("gear", Cause::Emergency, "no-cause", |run, _| {
        run.inputs.fill(Some(0))
    }),
    (
        "line",
        Cause::StoppedGroup,
        "power-removed-in-motion",
        |run, at| {
            set(run, 0, at.shows + 10..at.shows + 40, Power::QuickStop);
        },
    ),
    ("line", Cause::StoppedGroup, "speed-gained", |run, at| {
        for cycle in at.shows + 8..at.shows + 20 {
            *target(run, 0, cycle) += 3 * (cycle - at.shows) as i32;
        }
    }),
    ("line", Cause::StoppedGroup, "speed-gained", |run, at| {
        drift(run, 0, at.shows + 60, 300);
    }),
    ("line", Cause::StoppedGroup, "no-stop", |run, _| {
        let all = run.axes[0].len();
        let first = run.axes[0].iter().position(operates).expect("power");
        set(run, 0, first..all, Power::Operate);
    }),
    ("line", Cause::DeviceLost, "power-stays", |run, at| {
        let (end, all) = (end(run, 0, at), run.axes[0].len());
        set(run, 0, end..all - 1, Power::Operate);
    }),
    (
        "gear",
        Cause::GroupReset,
        "moves-after-a-reset",
        |run, _| {
            let last = run.axes[0].len() - 250;
            drift(run, 0, last, 40);
        },
    ),
    ("gear", Cause::OtherGroupStopped, "disturbed", |run, at| {
        *target(run, 0, at.shows + 100) += 1;
    }),
    (
        "gear",
        Cause::OtherGroupStopped,
        "power-begins-with-a-step",
        |run, _| {
            let first = run.axes[0].iter().position(operates).expect("power");
            *target(run, 0, first) += 100;
        },
    ),
    ("line", Cause::Hold, "moves-in-a-hold", |run, at| {
        *target(run, 0, at.ends - 10) += 1;
    }),
    ("PV", Cause::Hold, "moves-in-a-hold", |run, at| {
        drift(run, 0, at.ends - 50, 5);
    }),
    ("line", Cause::Hold, "does-not-continue", |run, at| {
        for moment in &mut run.axes[0][at.ends..] {
            moment.report = None;
        }
    }),
    ("line", Cause::Hold, "another-end", |run, at| {
        for cycle in at.ends..run.axes[0].len() {
            *target(run, 0, cycle) += 1;
        }
    }),
    ("line", Cause::Hold, "run-failed", |run, _| {
        run.error = Some("a trip".to_owned());
    }),
    ("line", Cause::Pipelined, "another-motion", |run, at| {
        *target(run, 0, at.shows) += 4;
    }),
    (
        "position output",
        Cause::StoppedGroup,
        "output",
        |run, at| {
            run.output[at.shows + 20] = Some(1);
        },
    ),
    ("PV", Cause::StoppedGroup, "no-halt", |run, at| {
        let sent = sent(&mut run.axes[0][at.shows + 4]);
        (sent.word, sent.velocity) = (0x0f, Some(600));
    }),
    ("PP", Cause::StoppedGroup, "profile-limit", |run, at| {
        sent(&mut run.axes[0][at.shows - 4]).ramps = [Some(200_000); 2];
    }),
];

#[test]
fn each_rule_finds_what_it_forbids() {
    let (bench, folder) = (features::files(), tempfile::tempdir().expect("a folder"));
    let all = features::all();
    let mut seen: BTreeMap<String, (&Feature, Run, Run, usize)> = BTreeMap::new();
    let mut found = BTreeSet::new();
    for (name, cause, rule, change) in CHANGES {
        let moment = usize::from(cause.buses().len() > 1);
        let cell = seen.entry(format!("{name} {cause:?}")).or_insert_with(|| {
            let feature = all.iter().find(|feature| feature.name == name);
            let feature = feature.expect("a feature");
            let line = (cause.reference_bus(moment), "");
            let reference = run(feature, &bench, line, "", folder.path());
            let cell = (feature, cause, moment);
            let (run, at) = strike(cell, &bench, &reference, folder.path());
            (feature, run, reference, at)
        });
        let (feature, run, reference, at) = cell;
        let cell = (*feature, cause, moment);
        let rules = |run: &Run| {
            let findings = judge_run(cell, run, reference, *at).into_iter();
            findings.map(|finding| finding.0.rule).collect::<Vec<_>>()
        };
        assert!(
            rules(run).is_empty(),
            "{name} × {cause:?}: {:?}",
            rules(run)
        );
        let times = times(cell, run, *at).expect("a cause");
        let mut run = run.clone();
        change(&mut run, times);
        let rules = rules(&run);
        assert!(
            rules.contains(&rule),
            "{name} × {cause:?}: {rule} is not in {rules:?}"
        );
        found.insert(rule);
    }
    assert_eq!(found, RULES.into_iter().collect());
}
