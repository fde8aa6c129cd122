//! Judges a run: the data that reached the drives, and whether exit code and report match.

use super::esi;
use super::relations;
use super::rules;
use super::stops;
use super::view::{Machine, Moment, views};
use super::wire::{Download, Inputs, Wire};

/// A command to the drive; no machine of the campaign has it.
const RESTORE_DEFAULTS: u16 = 0x1011;

/// One violated rule.
#[derive(Debug, Clone)]
pub struct Finding {
    pub rule: &'static str,
    pub axis: String,
    /// The cycle of the first violation.
    pub cycle: usize,
    /// Seconds since the first packet.
    pub at: f64,
    pub detail: String,
    /// The number of violations.
    pub count: usize,
}

/// The program's final output, as the user reads it.
#[derive(Debug, Clone, Default)]
pub struct Report {
    pub exit: i32,
    /// The error and the failures among the events.
    pub text: String,
    /// The start of the reported stop, in seconds of cycle time as in the report.
    pub stop_s: Option<f64>,
    /// True if the stop was a failure.
    pub failed: bool,
    /// True if the program ran to its end.
    pub completed: bool,
}

impl Report {
    pub fn names(&self, axis: &str) -> bool {
        self.exit != 0 && self.text.contains(&format!("`{axis}`"))
    }
}

/// Collects the findings of one axis.
pub struct Findings<'a> {
    pub list: Vec<Finding>,
    axis: &'a str,
    answers: Vec<Option<Inputs>>,
}

impl Findings<'_> {
    pub fn add(&mut self, rule: &'static str, moment: &Moment, detail: String) {
        if let Some(first) = self.list.iter_mut().find(|finding| finding.rule == rule) {
            first.count += 1;
            return;
        }
        let at = moment.at as f64 * 1e-9;
        let axis = self.axis.to_string();
        self.list.push(Finding {
            rule,
            axis,
            cycle: moment.cycle,
            at,
            detail,
            count: 1,
        });
    }

    /// Returns the drive's answer to these outputs, at any delay.
    pub fn answer(&self, moment: &Moment) -> Option<Inputs> {
        self.answers[moment.cycle]
    }
}

/// Returns every finding, in the order of the rules.
pub fn judge(machine: &Machine, wire: &Wire, report: &Report) -> Vec<Finding> {
    let views = views(machine, wire);
    let stop = stops::machine_stop(machine, wire, report, &views);
    let mut list = Vec::new();
    if let Some(at) = wire.malformed.first() {
        list.push(Finding {
            rule: "malformed-frame",
            axis: "-".to_string(),
            cycle: 0,
            at: *at as f64 * 1e-9,
            detail: "not EtherCAT as ETG.1000.4 has it".to_string(),
            count: wire.malformed.len(),
        });
    }
    let of_a_unit = |write: &&Download| {
        esi::OF_A_UNIT
            .iter()
            .any(|(index, subs)| *index == write.index && subs.contains(&write.sub))
            || write.index == RESTORE_DEFAULTS
    };
    let mut writes = wire.downloads.iter().filter(of_a_unit);
    if let Some(write) = writes.next() {
        let Download {
            index,
            sub,
            station,
            ..
        } = *write;
        list.push(Finding {
            rule: "write-of-unit-data",
            axis: "-".to_string(),
            cycle: 0,
            at: write.at as f64 * 1e-9,
            detail: format!("0x{index:04x}:{sub:02x} of station 0x{station:04x} was written"),
            count: 1 + writes.count(),
        });
    }
    for (drive, (axis, view)) in machine.axes.iter().zip(&views).enumerate() {
        let heard = |cycle: &super::wire::Cycle| Some(cycle.drives[drive]?.heard?.1);
        let mut findings = Findings {
            list: Vec::new(),
            axis: &axis.name,
            answers: wire.cycles.iter().map(heard).collect(),
        };
        rules::check(machine, axis, view, &mut findings);
        stops::check(machine, axis, view, wire, stop, report, &mut findings);
        list.append(&mut findings.list);
    }
    list.append(&mut relations::check(machine, wire, &views, stop, report));
    list
}
