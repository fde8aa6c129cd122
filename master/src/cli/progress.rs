//! What a run tells while it goes on, on stderr: a line that is rewritten on a terminal, lines
//! elsewhere.

use std::time::{Duration, Instant};

use ecaxis::bringup::Step;
use ecaxis::clock::Clock;
use ecaxis::config::{Bus, Nic, TorqueUnit};
use ecaxis::session::{AxisLine, Observer, Progress, Status};
use ecaxis_axis::Mode;
use indicatif::{ProgressBar, ProgressStyle};

use super::{hints, note, screen, style};

/// Virtual time makes an hour of status lines in seconds; people read one a second.
const STATUS_PERIOD: Duration = Duration::from_secs(1);

pub(crate) struct Teller {
    /// `None`: plain lines.
    bar: Option<ProgressBar>,
    clock: Clock,
    cycle_ns: u64,
    /// Hints depend on it.
    nic: Nic,
    last_passing: Option<Instant>,
    advised: Vec<String>,
}

impl Teller {
    /// `plain`: do not rewrite lines, log lines come in between.
    pub fn new(clock: Clock, bus: &Bus, plain: bool) -> Self {
        let bar = (style::rewrites() && !plain).then(|| {
            let bar = ProgressBar::new_spinner();
            let style = ProgressStyle::with_template("{spinner} {wide_msg}");
            let bar = bar.with_style(style.unwrap_or_else(|_| ProgressStyle::default_spinner()));
            screen::put_up(&bar);
            bar
        });
        Self {
            bar,
            clock,
            cycle_ns: bus.cycle_ns,
            nic: bus.nic.clone(),
            last_passing: None,
            advised: Vec::new(),
        }
    }

    /// Something that the next of its kind replaces.
    fn passing(&self, text: &str) {
        match &self.bar {
            Some(bar) => {
                bar.set_message(text.to_owned());
                bar.tick();
            }
            None => note(text),
        }
    }

    /// At most one of these a second where lines stay or time is virtual.
    fn occasional(&mut self, text: impl FnOnce() -> String) {
        if self
            .last_passing
            .is_none_or(|last| last.elapsed() >= STATUS_PERIOD)
        {
            self.last_passing = Some(Instant::now());
            self.passing(&text());
        }
    }
}

impl Observer for Teller {
    fn progress(&mut self, progress: &Progress) {
        match progress {
            // One line a device is enough where lines stay.
            Progress::Step(Step::StartUp { done, of, .. }) if self.bar.is_none() && done < of => {}
            Progress::Step(step @ (Step::StartUp { .. } | Step::Scan)) => {
                self.passing(&step.to_string());
            }
            Progress::Step(step) => note(&step.to_string()),
            Progress::Denied(denied) => {
                note(&format!("warning: {denied}"));
                let help = hints::denied(denied);
                if !self.advised.contains(&help) {
                    note(&format!("  = help: {help}"));
                    self.advised.push(help);
                }
            }
            Progress::Overload(overload) => {
                note(&format!("warning: {overload}"));
                note(&format!("  = help: {}", hints::overload()));
            }
            Progress::Concern(concern) => {
                note(&format!("warning: {concern}"));
                if let Some(help) = hints::concern(concern) {
                    note(&format!("  = help: {help}"));
                }
            }
            Progress::Warning(text) => note(&format!("warning: {text}")),
            Progress::Emergency(report) => note(&format!("warning: {report}")),
            Progress::Mailboxes(_) => {}
            Progress::GroupStopped { group, cause } => {
                note(&format!(
                    "warning: the group `{group}` stops, the rest goes on: {cause}"
                ));
                for hint in hints::run(cause, &self.nic).hints {
                    note(&format!("  = help: {hint}"));
                }
            }
            Progress::GroupReleased { group } => {
                note(&format!(
                    "the group `{group}` has been reset and can be enabled again"
                ));
            }
            Progress::PhaseLocked => note("frames leave in phase with SYNC0"),
            Progress::Enabled { axes: 1 } => note("1 axis in Operation enabled"),
            Progress::Enabled { axes } => note(&format!("{axes} axes in Operation enabled")),
            Progress::Program { run, step, what } => {
                let text = format!("run {run}, step {}: {what}", step.number);
                if *run == 1 && self.bar.is_none() {
                    note(&text);
                } else {
                    self.occasional(|| text);
                }
            }
            Progress::Captured { run, capture } => {
                note(&format!("run {run}, step {}: {capture}", capture.step));
            }
            Progress::Status(status) if self.clock == Clock::Virtual => {
                let cycle_ns = self.cycle_ns;
                self.occasional(|| status_line(status, cycle_ns));
            }
            Progress::Status(status) => self.passing(&status_line(status, self.cycle_ns)),
            Progress::Stopping => note("stopping: axes to rest, power off, bus to Init"),
        }
    }
}

impl Drop for Teller {
    fn drop(&mut self) {
        screen::take_down();
    }
}

fn status_line(status: &Status, cycle_ns: u64) -> String {
    let counters = &status.counters;
    let turns = counters.cycles.saturating_add(counters.overruns);
    let mut text = format!(
        "{:7.1} s  cycle {}  lost {}  wkc {}",
        turns as f64 * cycle_ns as f64 * 1e-9,
        counters.cycles,
        counters.lost_frames,
        counters.wkc_errors,
    );
    if let Some(phase) = &status.phase {
        text += &format!(
            "  phase {:+} ns{}",
            phase.error_ns,
            if phase.locked { "" } else { " (not locked)" }
        );
    }
    for axis in &status.axes {
        text += "  ";
        text += &axis_text(axis);
    }
    text
}

fn axis_text(axis: &AxisLine) -> String {
    let AxisLine {
        name,
        unit,
        position,
        velocity,
        torque,
        torque_unit,
        ..
    } = axis;
    match axis.mode {
        Mode::Csv => format!("{name} {velocity:.2} {unit}/s"),
        Mode::Cst if *torque_unit == TorqueUnit::Percent => format!("{name} {torque:.1} %"),
        Mode::Cst => format!("{name} {torque:.4} {torque_unit}"),
        _ => format!("{name} {position:.3} {unit}"),
    }
}
