//! Statistics of a campaign.

use std::collections::BTreeMap;
use std::fmt;

use super::generate::Plan;
use super::run::Outcome;

/// The maximum number of printed findings per rule.
const SHOWN: usize = 8;

#[derive(Debug, Default)]
pub struct Tally {
    pub runs: usize,
    pub seconds: f64,
    cycles: usize,
    exits: BTreeMap<i32, usize>,
    faults: BTreeMap<&'static str, usize>,
    features: BTreeMap<&'static str, usize>,
    pub right: usize,
    /// Runs whose report names no fault of the script.
    pub wrong: Vec<String>,
    /// Runs with violations, by rule.
    pub broken: BTreeMap<&'static str, Vec<String>>,
}

impl Tally {
    pub fn add(&mut self, plan: &Plan, outcome: Outcome) {
        self.runs += 1;
        // A run that ends at once counts a little, so that the campaign ends.
        self.seconds += outcome.seconds.max(0.1);
        self.cycles += outcome.cycles;
        *self.exits.entry(outcome.exit).or_default() += 1;
        for fault in &plan.faults {
            *self.faults.entry(fault.kind).or_default() += 1;
        }
        for feature in &plan.features {
            *self.features.entry(feature).or_default() += 1;
        }
        let (seed, scene) = (plan.seed, plan.scene);
        let kinds: Vec<&str> = plan.faults.iter().map(|fault| fault.kind).collect();
        match outcome.right {
            Some(true) => self.right += 1,
            Some(false) => {
                let said = if outcome.headline.is_empty() {
                    &outcome.error
                } else {
                    &outcome.headline
                };
                self.wrong
                    .push(format!("seed {seed} ({scene}) {kinds:?}: {said}"));
            }
            None => {}
        }
        let mut counted = Vec::new();
        for finding in &outcome.findings {
            if !counted.contains(&finding.rule) {
                counted.push(finding.rule);
                let line = format!("seed {seed} ({scene}) {finding}");
                self.broken.entry(finding.rule).or_default().push(line);
            }
        }
    }
}

impl fmt::Display for Tally {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            runs,
            seconds,
            cycles,
            exits,
            faults,
            features,
            right,
            ..
        } = self;
        let failed = right + self.wrong.len();
        writeln!(
            f,
            "{runs} runs, {:.2} machine-hours, {cycles} cycles",
            seconds / 3600.0
        )?;
        writeln!(f, "exit codes {exits:?}")?;
        writeln!(f, "faults {faults:?}")?;
        writeln!(f, "features {features:?}")?;
        writeln!(f, "causes: {right} of {failed} name a fault of the script")?;
        for line in &self.wrong {
            writeln!(f, "  {line}")?;
        }
        writeln!(f, "rules broken: {}", self.broken.len())?;
        for (rule, lines) in &self.broken {
            writeln!(f, "  {rule}: {} runs", lines.len())?;
            for line in lines.iter().take(SHOWN) {
                writeln!(f, "    {line}")?;
            }
        }
        Ok(())
    }
}
