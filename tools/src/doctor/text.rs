//! The report as text: 80 columns, no colours. Commands can be copied unchanged.

use std::fmt::{self, Display, Formatter};

use super::wakeup::WakeUp;
use super::{Finding, Fix, Report, Severity};
use crate::cells;
use crate::document::format::{or_dash, time};
use crate::document::{Document, Table};
use ecaxis_master::config::duration;
use ecaxis_master::text::pluralize;

const COLUMNS: usize = 80;
/// The column of a finding's text, after the labels.
const LABEL: usize = 11;
/// The maximum length of a name from a file.
const LONGEST_NAME: usize = 40;
/// The maximum length of a finding or a fact.
const LONGEST_TEXT: usize = 600;

/// Trims, shortens and sanitizes a name from a file.
pub(super) fn short(text: &str) -> String {
    limited(text.trim(), LONGEST_NAME)
}

/// Replaces control characters and limits the length.
pub(super) fn clean(text: &str) -> String {
    limited(text, LONGEST_TEXT)
}

fn limited(text: &str, most: usize) -> String {
    let shown = |c: char| if c.is_control() { '?' } else { c };
    let mut all = text.chars().map(shown);
    let mut text: String = all.by_ref().take(most).collect();
    if all.next().is_some() {
        text.push('…');
    }
    text
}

/// Splits a command into words, but not inside quotation marks.
fn shell_words(command: &str) -> Vec<String> {
    let mut words = vec![String::new()];
    let mut quote = None;
    for c in command.chars() {
        match (c, quote) {
            (' ', None) => {
                words.push(String::new());
                continue;
            }
            ('\'' | '"', None) => quote = Some(c),
            (c, Some(open)) if c == open => quote = None,
            _ => {}
        }
        if let Some(word) = words.last_mut() {
            word.push(c);
        }
    }
    words
}

/// Breaks a command between its words; all but the last line end with a backslash.
fn command(text: &str) -> String {
    // Room for the line continuation.
    let width = COLUMNS - LABEL - 4;
    let mut out = String::new();
    let mut used = 0;
    for word in shell_words(text) {
        let len = word.chars().count();
        match used {
            0 => {}
            _ if used + 1 + len > width => {
                out += " \\\n  ";
                used = 0;
            }
            _ => out.push(' '),
        }
        used += len + usize::from(used > 0);
        out += &word;
    }
    out
}

impl Display for Severity {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Note => "note",
            Self::Warning => "warning",
            Self::Bad => "bad",
        })
    }
}

impl Finding {
    fn add_to(&self, out: &mut Document) {
        out.heading(format!("{}: {}", self.severity, self.found));
        let fixes = self.fix.iter().map(|fix| match fix {
            Fix::Now(line) => ("now", command(line)),
            Fix::Lasting(line) => ("for good", command(line)),
            Fix::Advice(text) => ("fix", text.clone()),
        });
        for (label, text) in std::iter::once(("cost", self.cost.clone())).chain(fixes) {
            out.item(format!("{label:<w$}", w = LABEL - 2), text);
        }
    }
}

impl Report {
    /// Returns the report for readers.
    #[must_use]
    pub fn document(&self) -> Document {
        let intent = &self.intent;
        let nic = intent.nic.as_deref().unwrap_or("no interface");
        let cpu = intent.cpu;
        let cpu = cpu.map_or("any CPU".to_owned(), |cpu| format!("CPU {cpu}"));
        let (priority, cycle) = (intent.priority, duration::show(intent.cycle_ns));
        let mut out = Document::new(format!("{nic}, {cpu}, priority {priority}, cycle {cycle}"));
        out.gap();
        let mut facts = Table::new("");
        for fact in &self.facts {
            facts.row(cells![fact.name, fact.value]);
        }
        out.table(facts);
        if let Some(wake_up) = &self.wake_up {
            wake_up.add_to(&mut out);
        }
        for finding in &self.findings {
            finding.add_to(&mut out);
        }
        let count = |severity| self.count(severity);
        let warnings = pluralize(count(Severity::Warning), "warning");
        let notes = pluralize(count(Severity::Note), "note");
        out.heading(format!("{} bad, {warnings}, {notes}", count(Severity::Bad)));
        out
    }
}

impl WakeUp {
    fn add_to(&self, out: &mut Document) {
        let policy = match self.denials.is_empty() {
            true => format!("SCHED_FIFO {}", self.priority),
            false => "with restrictions".to_owned(),
        };
        let cpu = self.cpu.map_or(String::new(), |cpu| format!(", CPU {cpu}"));
        let (seconds, cycle) = (self.seconds, duration::show(self.cycle_ns));
        out.heading(format!(
            "Wake-up lateness in {seconds} s, every {cycle} in turns, {policy}{cpu}:"
        ));
        let mut table = Table::new("|p50|p99|p99.9|max|interrupts|stolen");
        let methods = [
            ("sleep", &self.sleep),
            ("sleep + spin", &self.sleep_and_spin),
        ];
        for (name, method) in methods {
            let late = &method.lateness;
            let [p50, p99, p99_9, max] =
                [late.p50_ns, late.p99_ns, late.p99_9_ns, late.max_ns].map(time);
            let stolen = method.stolen_ms.map(|ms| format!("{ms} ms"));
            let interrupts = or_dash(method.interrupts);
            table.row(cells![
                name,
                p50,
                p99,
                p99_9,
                max,
                interrupts,
                or_dash(stolen)
            ]);
        }
        out.table(table);
        for (name, method) in methods {
            if let Some(switches @ 1..) = method.involuntary_switches {
                out.line(format!(
                    "{name}: taken off its CPU {switches} times by threads of higher priority or throttling",
                ));
            }
        }
        for denial in &self.denials {
            out.line(denial);
        }
        let (most, all) = self.good_for();
        let cycle = |cycle: Option<u64>| match cycle {
            Some(cycle) => format!("cycles from {}", duration::show(cycle)),
            None => "no usual cycle".to_owned(),
        };
        out.line(format!(
            "The cycle waits by sleep + spin. If it may lose a quarter of its time to that, 99.9 % of these {} wake-ups would do for {}, all of them for {}. Rarer delays do not show in {} s: measure with the machine's usual load and `--seconds 600` before relying on it.",
            self.sleep_and_spin.lateness.count,
            cycle(most),
            cycle(all),
            self.seconds,
        ));
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn finding_prints_labels_and_wrapped_text() {
        let finding = Finding {
            severity: Severity::Warning,
            id: "x",
            found:
                "one thing is found here that takes more than one line to say, because it is long"
                    .into(),
            cost: "Much.".into(),
            fix: vec![
                Fix::Now("echo 1 | sudo tee /proc/x".into()),
                Fix::Lasting(format!(
                    "printf '%s %s\\n' 'a b' {} | sudo tee /etc/x",
                    "word ".repeat(9).trim()
                )),
                Fix::Advice("Or not.".into()),
            ],
        };
        let expected = "\
warning: one thing is found here that takes more than one line to say, because
  it is long
  cost     Much.
  now      echo 1 | sudo tee /proc/x
  for good printf '%s %s\\n' 'a b' word word word word word word word word \\
             word | sudo tee /etc/x
  fix      Or not.
";
        let mut document = Document::default();
        finding.add_to(&mut document);
        assert_eq!(document.text(Some(COLUMNS)), expected);
    }

    #[test]
    fn short_removes_control_characters() {
        assert_eq!(short(" a\u{1b}[31m\n"), "a?[31m");
        assert_eq!(short(&"x".repeat(100)).chars().count(), LONGEST_NAME + 1);
    }

    proptest! {
        #[test]
        fn command_keeps_its_words(command in "[a-z'\" |]{0,200}") {
            prop_assert_eq!(shell_words(&command).join(" "), command);
        }
    }
}
