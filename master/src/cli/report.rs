//! A run as a table, for people. In virtual time every figure is the machine's, none the computer's.

use std::time::Duration;

use ecaxis::config::duration;
use ecaxis::rt::stats::Percentiles;
use ecaxis::session::{AxisSummary, Summary};

/// The whole result of a run.
pub(crate) fn summary(summary: &Summary) -> String {
    let mut text = head(summary);
    text += "\n";
    text += &counters(summary).indented(2);
    text += "\n\n";
    text += &times(summary).indented(2);
    text += "\n";
    if !summary.axes.is_empty() {
        text += "\n";
        text += &axes(&summary.axes).indented(2);
        text += "\n";
    }
    for axis in &summary.axes {
        for what in [&axis.fault, &axis.trip].into_iter().flatten() {
            text += &format!("  {}: {what}\n", axis.name);
        }
    }
    if let Some(frames) = summary.recorded_frames {
        text += &format!("\n  {frames} frames recorded");
        match summary.recorded_frames_dropped {
            Some(dropped @ 1..) => text += &format!(", {dropped} dropped: the disk is too slow\n"),
            _ => text += "\n",
        }
    }
    text
}

fn head(summary: &Summary) -> String {
    let plural = |n: u64, what: &str| format!("{n} {what}{}", if n == 1 { "" } else { "s" });
    let devices = u64::try_from(summary.devices).unwrap_or(u64::MAX);
    format!(
        "{}: {}, {} in {} time, {} of the program{}\n",
        summary.machine,
        plural(devices, "SubDevice"),
        seconds(summary.machine_seconds),
        summary.time,
        plural(u64::from(summary.program_runs), "complete run"),
        if summary.interrupted {
            ", interrupted"
        } else {
            ""
        },
    )
}

fn seconds(s: f64) -> String {
    format!(
        "{:.3} s",
        Duration::try_from_secs_f64(s)
            .unwrap_or_default()
            .as_secs_f64()
    )
}

fn counters(summary: &Summary) -> Table {
    let counters = &summary.counters;
    let cycle = format!("of {}", duration::show(summary.cycle_ns));
    let mut table = Table::new(&["cycles", &counters.cycles.to_string(), &cycle]);
    for (name, count, meaning) in [
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
            "cycles left out because the thread woke too late",
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
    ] {
        // The first three are always asked for; the others only matter when they happen.
        if count > 0
            || matches!(
                name,
                "lost frames" | "late frames" | "working-counter errors"
            )
        {
            table.row([
                name,
                &count.to_string(),
                if count > 0 { meaning } else { "" },
            ]);
        }
    }
    table
}

fn times(summary: &Summary) -> Table {
    let mut table = Table::new(&["", "p50", "p99", "p99.9", "max"]);
    let mut row = |name: &str, times: &Percentiles| {
        let show = |ns: u64| {
            if times.count == 0 {
                "-".to_owned()
            } else {
                duration::show(ns)
            }
        };
        let [p50, p99, p99_9, max] =
            [times.p50_ns, times.p99_ns, times.p99_9_ns, times.max_ns].map(show);
        table.row([name, &p50, &p99, &p99_9, &max]);
    };
    row("wake-up lateness", &summary.wake_up_lateness);
    row("round trip", &summary.round_trip);
    row("work a cycle", &summary.work);
    if let Some(phase) = &summary.dc_phase_error {
        row("DC phase error", phase);
    }
    table
}

fn axes(axes: &[AxisSummary]) -> Table {
    let mut table = Table::new(&[
        "axis",
        "mode",
        "target",
        "final position",
        "off by",
        "largest following error",
        "state",
    ]);
    for axis in axes {
        let unit = &axis.unit;
        let position = |x: f64| format!("{:.4} {unit}", positive_zero(x));
        let cyclic_position = axis.mode == "csp" && axis.was_enabled;
        let only = |show: bool, text: String| if show { text } else { "-".to_owned() };
        let off = match axis.final_error_counts {
            Some(1) => "1 count".to_owned(),
            Some(n) => format!("{n} counts"),
            None => "-".to_owned(),
        };
        table.row([
            &axis.name,
            &axis.mode,
            &only(cyclic_position, position(axis.target_position)),
            &only(axis.was_enabled, position(axis.final_position)),
            &off,
            &only(cyclic_position, position(axis.largest_following_error)),
            &axis.final_state,
        ]);
    }
    table
}

/// `-0.0000` reads like a mistake.
fn positive_zero(x: f64) -> f64 {
    if x.abs() < 0.000_05 { 0.0 } else { x }
}

/// Columns as wide as their widest cell.
#[derive(Debug)]
pub(crate) struct Table {
    rows: Vec<Vec<String>>,
}

impl Table {
    pub fn new(head: &[&str]) -> Self {
        Self {
            rows: vec![head.iter().map(|cell| (*cell).to_owned()).collect()],
        }
    }

    pub fn row<const N: usize>(&mut self, cells: [&str; N]) {
        self.line(cells.map(ToOwned::to_owned).to_vec());
    }

    /// A row of as many cells as the head has.
    pub fn line(&mut self, cells: Vec<String>) {
        self.rows.push(cells);
    }

    /// Without a line end after the last row.
    pub fn indented(&self, by: usize) -> String {
        self.fitted(by, None)
    }

    /// For a result that may be read on a terminal: there, long cells are broken so that lines need not be.
    pub fn shown(&self, by: usize) -> String {
        self.fitted(by, terminal_width())
    }

    /// The widest columns give way until a line has no more than `limit` characters.
    fn fitted(&self, by: usize, limit: Option<usize>) -> String {
        let columns = self.rows.iter().map(Vec::len).max().unwrap_or(0);
        let width = |column: usize| {
            let cells = self.rows.iter().filter_map(|row| row.get(column));
            cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
        };
        let mut widths: Vec<usize> = (0..columns).map(width).collect();
        let between = by + GAP * columns.saturating_sub(1);
        let limit = limit.unwrap_or(usize::MAX);
        while widths.iter().sum::<usize>() + between > limit {
            let widest = widths
                .iter_mut()
                .filter(|width| **width > NARROWEST)
                .max_by_key(|width| **width);
            let Some(widest) = widest else { break };
            *widest -= 1;
        }
        let mut lines = Vec::new();
        for row in &self.rows {
            let cells: Vec<Vec<String>> = row
                .iter()
                .zip(&widths)
                .map(|(cell, width)| broken(cell, *width))
                .collect();
            let height = cells.iter().map(Vec::len).max().unwrap_or(0).max(1);
            for n in 0..height {
                let mut line = " ".repeat(by);
                for (column, (cell, width)) in cells.iter().zip(&widths).enumerate() {
                    let part = cell.get(n).map_or("", String::as_str);
                    let gap = if column == 0 { 0 } else { GAP };
                    line += &format!("{:gap$}{part:<width$}", "");
                }
                lines.push(line.trim_end().to_owned());
            }
        }
        lines.join("\n")
    }
}

/// Between columns.
const GAP: usize = 2;
/// No column is made narrower to fit a terminal.
const NARROWEST: usize = 14;

/// `None`: the result goes to a file or another program.
fn terminal_width() -> Option<usize> {
    let size = rustix::termios::tcgetwinsize(std::io::stdout()).ok()?;
    Some(usize::from(size.ws_col)).filter(|columns| *columns > 0)
}

/// In lines of at most `width` characters, between words where there is a place.
fn broken(cell: &str, width: usize) -> Vec<String> {
    if cell.chars().count() <= width {
        return vec![cell.to_owned()];
    }
    let mut lines = vec![String::new()];
    for word in cell.split_inclusive(' ') {
        let mut word: Vec<char> = word.chars().collect();
        loop {
            let used = lines.last().map_or(0, |line| line.chars().count());
            let bare = word.iter().rposition(|c| *c != ' ').map_or(0, |at| at + 1);
            if used + bare <= width {
                break;
            }
            if used > 0 {
                lines.push(String::new());
                continue;
            }
            // A word longer than a line.
            lines.pop();
            lines.push(word.drain(..width.max(1)).collect());
            lines.push(String::new());
        }
        if let Some(line) = lines.last_mut() {
            line.extend(word);
        }
    }
    lines.retain(|line| !line.trim().is_empty());
    lines
        .into_iter()
        .map(|line| line.trim_end().to_owned())
        .collect()
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
            devices: 1,
            time: "virtual",
            cycle_ns: 1_000_000,
            machine_seconds: 12.5,
            program_runs: 2,
            interrupted: false,
            counters: ecaxis::rt::stats::Counters {
                cycles: 12_500,
                lost_frames: 1,
                ..Default::default()
            },
            wake_up_lateness: times,
            round_trip: times,
            dc_phase_error: Some(times),
            work: Percentiles::default(),
            axes: vec![AxisSummary {
                name: "x".into(),
                unit: "mm".into(),
                mode: "csp".into(),
                was_enabled: true,
                final_position: -0.000_01,
                target_position: 0.0,
                final_error_counts: Some(0),
                largest_following_error: 0.1234,
                final_state: "Switch on disabled".into(),
                fault: None,
                trip: None,
            }],
            recorded_frames: Some(7),
            recorded_frames_dropped: Some(0),
        }
    }

    #[test]
    fn a_run_on_paper() {
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

  7 frames recorded
";
        assert_eq!(summary(&sample()), expected);
    }

    #[test]
    fn columns_align() {
        let mut table = Table::new(&["a", "bé", "c"]);
        table.row(["long", "x", ""]);
        assert_eq!(table.indented(1), " a     bé  c\n long  x");
    }

    #[test]
    fn a_terminal_too_narrow_breaks_cells_and_loses_nothing() {
        let mut table = Table::new(&["no", "what it takes", "name"]);
        table.row([
            "1",
            "one module, another module, a third",
            "an_endless_name_without_a_space",
        ]);
        let expected = "  no  what it takes     name
  1   one module,       an_endless_name_
      another module,   without_a_space
      a third";
        assert_eq!(table.fitted(2, Some(40)), expected);
        assert_eq!(table.fitted(2, Some(400)), table.indented(2));
        for limit in 0..100 {
            let text = table.fitted(0, Some(limit));
            let letters = |text: &str| {
                let mut all: Vec<char> = text.chars().filter(|c| !c.is_whitespace()).collect();
                all.sort_unstable();
                all
            };
            assert_eq!(letters(&text), letters(&table.indented(0)), "{limit}");
            let widest = text.lines().map(|line| line.chars().count()).max();
            assert!(
                widest <= Some(limit.max(2 * NARROWEST + 2 + 2 * GAP)),
                "{limit}: {text}"
            );
        }
    }
}
