//! The report as text: 80 columns, no colours. Commands can be copied unchanged.

use std::fmt::{self, Display, Formatter};

use super::wakeup::{WaitMethod, WakeUp};
use super::{Finding, Fix, Report, Severity};
use ecaxis_master::config::duration;

const COLUMNS: usize = 80;
/// The column of a finding's text, after the labels.
const INDENT: usize = 11;
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

/// Breaks words into lines of at most `width` characters. A longer word gets its own line.
fn lines(words: impl Iterator<Item = String>, width: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in words {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 1 + word.chars().count() <= width => {
                line.push(' ');
                *line += &word;
            }
            _ => lines.push(word),
        }
    }
    lines
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

/// Prints a label and the text next to it.
fn labelled(f: &mut Formatter<'_>, label: &str, lines: &[String]) -> fmt::Result {
    for (n, line) in lines.iter().enumerate() {
        let label = if n == 0 { label } else { "" };
        let line = format!("  {label:<w$}{line}", w = INDENT - 2);
        writeln!(f, "{}", line.trim_end())?;
    }
    Ok(())
}

fn prose(f: &mut Formatter<'_>, label: &str, text: &str) -> fmt::Result {
    let words = text.split_whitespace().map(str::to_owned);
    labelled(f, label, &lines(words, COLUMNS - INDENT))
}

fn command(f: &mut Formatter<'_>, label: &str, command: &str) -> fmt::Result {
    // Room for the line continuation.
    let mut all = lines(shell_words(command).into_iter(), COLUMNS - INDENT - 4);
    let last = all.len().saturating_sub(1);
    for (n, line) in all.iter_mut().enumerate() {
        let deeper = if n == 0 { "" } else { "  " };
        let goes_on = if n < last { " \\" } else { "" };
        *line = format!("{deeper}{line}{goes_on}");
    }
    labelled(f, label, &all)
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

impl Display for Finding {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let words = format!("{}: {}", self.severity, self.found);
        let words = words.split_whitespace().map(str::to_owned);
        for (n, line) in lines(words, COLUMNS - 2).iter().enumerate() {
            writeln!(f, "{}{line}", if n == 0 { "" } else { "  " })?;
        }
        prose(f, "cost", &self.cost)?;
        for fix in &self.fix {
            match fix {
                Fix::Now(line) => command(f, "now", line)?,
                Fix::Lasting(line) => command(f, "for good", line)?,
                Fix::Advice(text) => prose(f, "fix", text)?,
            }
        }
        Ok(())
    }
}

impl Display for Report {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let intent = &self.intent;
        let what = [
            intent
                .nic
                .clone()
                .unwrap_or_else(|| "no interface".to_owned()),
            intent
                .cpu
                .map_or("any CPU".to_owned(), |cpu| format!("CPU {cpu}")),
            format!("priority {}", intent.priority),
            format!("cycle {}", duration::show(intent.cycle_ns)),
        ];
        writeln!(f, "{}\n", what.join(", "))?;
        let widest = self
            .facts
            .iter()
            .map(|fact| fact.name.chars().count())
            .max();
        let at = widest.unwrap_or(0) + 4;
        for fact in &self.facts {
            let words = fact.value.split_whitespace().map(str::to_owned);
            for (n, line) in lines(words, COLUMNS - at).iter().enumerate() {
                let name = if n == 0 { fact.name } else { "" };
                writeln!(f, "  {name:<w$}{line}", w = at - 2)?;
            }
        }
        if let Some(wake_up) = &self.wake_up {
            write!(f, "\n{wake_up}")?;
        }
        for finding in &self.findings {
            write!(f, "\n{finding}")?;
        }
        let count = |severity, one: &str, more: &str| {
            let n = self.count(severity);
            format!("{n} {}", if n == 1 { one } else { more })
        };
        writeln!(
            f,
            "\n{}, {}, {}",
            count(Severity::Bad, "bad", "bad"),
            count(Severity::Warning, "warning", "warnings"),
            count(Severity::Note, "note", "notes"),
        )
    }
}

impl Display for WakeUp {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let fifo = self.denials.is_empty();
        writeln!(
            f,
            "Wake-up lateness in {} s, every {} in turns, {}{}:",
            self.seconds,
            duration::show(self.cycle_ns),
            if fifo {
                format!("SCHED_FIFO {}", self.priority)
            } else {
                "with restrictions".to_owned()
            },
            self.cpu.map_or(String::new(), |cpu| format!(", CPU {cpu}")),
        )?;
        writeln!(
            f,
            "  {:<12} {:>9} {:>9} {:>9} {:>9} {:>10} {:>7}",
            "", "p50", "p99", "p99.9", "max", "interrupts", "stolen"
        )?;
        way(f, "sleep", &self.sleep)?;
        way(f, "sleep + spin", &self.sleep_and_spin)?;
        for (name, way) in [
            ("sleep", &self.sleep),
            ("sleep + spin", &self.sleep_and_spin),
        ] {
            if way.involuntary_switches > 0 {
                let text = format!(
                    "{name}: taken off its CPU {} times by threads of higher priority or throttling",
                    way.involuntary_switches
                );
                prose_at(f, &text)?;
            }
        }
        for denial in &self.denials {
            prose_at(f, denial)?;
        }
        let (most, all) = self.good_for();
        let cycle = |cycle: Option<u64>| match cycle {
            Some(cycle) => format!("cycles from {}", duration::show(cycle)),
            None => "no usual cycle".to_owned(),
        };
        prose_at(
            f,
            &format!(
                "The cycle waits by sleep + spin. If it may lose a quarter of its time to that, 99.9 % of these {} wake-ups would do for {}, all of them for {}. Rarer delays do not show in {} s: measure with the machine's usual load and `--seconds 600` before relying on it.",
                self.sleep_and_spin.lateness.count,
                cycle(most),
                cycle(all),
                self.seconds,
            ),
        )
    }
}

fn prose_at(f: &mut Formatter<'_>, text: &str) -> fmt::Result {
    let words = text.split_whitespace().map(str::to_owned);
    for line in lines(words, COLUMNS - 2) {
        writeln!(f, "  {line}")?;
    }
    Ok(())
}

fn way(f: &mut Formatter<'_>, name: &str, way: &WaitMethod) -> fmt::Result {
    let or = |n: Option<u64>, unit: &str| n.map_or("-".to_owned(), |n| format!("{n}{unit}"));
    let l = &way.lateness;
    writeln!(
        f,
        "  {name:<12} {:>9} {:>9} {:>9} {:>9} {:>10} {:>7}",
        time(l.p50_ns),
        time(l.p99_ns),
        time(l.p99_9_ns),
        time(l.max_ns),
        or(way.interrupts, ""),
        or(way.stolen_ms, " ms"),
    )
}

/// Formats a time with about three digits.
fn time(ns: u64) -> String {
    let micros = ns as f64 / 1e3;
    match ns {
        0..1_000 => format!("{ns} ns"),
        1_000..100_000 => format!("{micros:.1} µs"),
        100_000..10_000_000 => format!("{micros:.0} µs"),
        _ => format!("{:.1} ms", micros / 1e3),
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
        assert_eq!(finding.to_string(), expected);
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
