//! Progress of a run on stderr: a rewritten line on a terminal, otherwise separate lines.

use std::time::{Duration, Instant};

use ecaxis_axis::Mode;
use ecaxis_master::acyclic::DeviceRef;
use ecaxis_master::bringup::{Step, StepTime};
use ecaxis_master::clock::{Clock, Nanos};
use ecaxis_master::config::{Bus, Nic, TorqueUnit};
use ecaxis_master::report::Home;
use ecaxis_master::session::{AxisLine, Observer, Progress, Status};
use indicatif::{ProgressBar, ProgressStyle};

use crate::hints;
use crate::render::live::{Live, clipped};
use crate::render::{note, output, style};

/// The minimum interval between status lines. In virtual time, an hour of status passes in seconds.
const STATUS_PERIOD: Duration = Duration::from_secs(1);

pub(crate) struct ProgressPrinter {
    /// `None` prints separate lines.
    bar: Option<ProgressBar>,
    /// Print where the time of the bring-up went.
    times: bool,
    clock: Clock,
    cycle_ns: u64,
    /// The interface; hints depend on it.
    nic: Nic,
    last_passing: Option<Instant>,
    /// The second of machine time of the last line.
    last_second: Option<u64>,
    live: Live,
    /// The present step of the program.
    step: Option<String>,
    advised: Vec<String>,
}

impl ProgressPrinter {
    /// `plain`: print separate lines, because log lines are mixed in.
    pub fn new(clock: Clock, bus: &Bus, plain: bool) -> Self {
        let bar = (style::rewrites() && !plain && !output::is_quiet()).then(|| {
            let bar = ProgressBar::new_spinner();
            let style = ProgressStyle::with_template("{spinner} {msg}");
            let bar = bar.with_style(style.unwrap_or_else(|_| ProgressStyle::default_spinner()));
            output::attach_bar(&bar);
            bar
        });
        Self {
            bar,
            times: plain,
            clock,
            cycle_ns: bus.cycle_ns,
            nic: bus.nic.clone(),
            last_passing: None,
            last_second: None,
            live: Live::default(),
            step: None,
            advised: Vec::new(),
        }
    }

    /// Shows a transient message.
    fn passing(&self, text: &str) {
        match &self.bar {
            Some(bar) => {
                bar.set_message(fitted(text));
                bar.tick();
            }
            None => note(text),
        }
    }

    /// Prints at most one message per second with separate lines or in virtual time.
    fn rate_limited(&mut self, text: impl FnOnce() -> String) {
        if self
            .last_passing
            .is_none_or(|last| last.elapsed() >= STATUS_PERIOD)
        {
            self.last_passing = Some(Instant::now());
            self.passing(&text());
        }
    }
}

impl ProgressPrinter {
    /// Shows the axes as a table on a terminal; otherwise a line for each second.
    fn status(&mut self, status: &Status) {
        let cycle_ns = self.cycle_ns;
        if let Some(bar) = &self.bar {
            let [columns, rows] = output::stderr_size().unwrap_or([80, 24]);
            let mut text = fitted(&bus_text(status, cycle_ns));
            if let Some(step) = &self.step {
                text += "\n";
                text += &clipped(step, columns.saturating_sub(1));
            }
            let room = [columns.saturating_sub(1), rows.saturating_sub(4)];
            for line in self.live.lines(status, room) {
                text += "\n";
                text += &line;
            }
            bar.set_message(text);
            bar.tick();
        } else if self.clock == Clock::Virtual {
            self.rate_limited(|| status_line(status, cycle_ns));
        } else {
            let second = status.time / 1_000_000_000;
            if self.last_second.replace(second) != Some(second) {
                self.passing(&status_line(status, cycle_ns));
            }
        }
    }
}

/// Cuts a line to the width of the terminal behind the spinner.
fn fitted(text: &str) -> String {
    let columns = output::stderr_width().unwrap_or(80);
    clipped(text, columns.saturating_sub(3))
}

impl Observer for ProgressPrinter {
    fn progress(&mut self, progress: &Progress) {
        match progress {
            // With separate lines, one line per device is enough.
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
            Progress::Ring {
                text,
                broken: false,
            } => note(text),
            Progress::Ring { text, .. } | Progress::Warning(text) => {
                note(&format!("warning: {text}"));
            }
            Progress::MailboxGateway { address, write } => {
                let rights = if *write { "" } else { ", read only" };
                note(&format!("mailbox gateway: {address} (UDP and TCP){rights}"));
            }
            Progress::Tap(tap) => note(&format!("Ethernet of the devices (EoE): {tap}")),
            Progress::Emergency(report) => note(&format!("warning: {report}")),
            // The stop of the group is reported.
            Progress::DeviceLost { .. }
            | Progress::Topology(_)
            | Progress::RingStatus(_)
            | Progress::Mailboxes(_) => {}
            Progress::GroupStopped { group, cause } => {
                note(&format!(
                    "warning: the group `{group}` stops, the rest goes on: {cause}"
                ));
                for hint in hints::failure(cause, &self.nic).hints {
                    note(&format!("  = help: {hint}"));
                }
            }
            Progress::GroupReleased { group } => {
                note(&format!(
                    "the stop of the group `{group}` has ended; its axes can be enabled"
                ));
            }
            Progress::DeviceReturned {
                device,
                after_ns,
                home,
                first,
                has_axes,
                ..
            } => note(&match first {
                true => device_appeared(device, *has_axes),
                false => device_returned(device, *after_ns, *home, *has_axes),
            }),
            Progress::GroupWaits { group } => {
                note(&format!(
                    "the group `{group}` waits for its optional devices"
                ));
            }
            Progress::UnknownDevice(device) => note(&format!("warning: {device}")),
            Progress::BringUpTimes(steps) if self.times => {
                note(bring_up_times(steps).trim_end());
            }
            Progress::BringUpTimes(_) => {}
            Progress::PhaseLocked => note("frames leave in phase with SYNC0"),
            Progress::Enabled { axes: 1 } => note("1 axis in Operation enabled"),
            Progress::Enabled { axes } => note(&format!("{axes} axes in Operation enabled")),
            Progress::Program { run, step, what } => {
                let text = format!("run {run}, step {}: {what}", step.number);
                self.step = Some(text.clone());
                if *run == 1 {
                    note(&text);
                } else if self.bar.is_none() {
                    self.rate_limited(|| text);
                }
            }
            Progress::Captured { run, capture } => {
                note(&format!("run {run}, step {}: {capture}", capture.step));
            }
            Progress::Status(status) => self.status(status),
            Progress::Stopping => note("stopping: axes to rest, power off, bus to Init"),
        }
    }
}

impl Drop for ProgressPrinter {
    fn drop(&mut self) {
        output::detach_bar();
    }
}

/// Returns a table of the steps of a bring-up.
fn bring_up_times(steps: &[StepTime]) -> String {
    let ms = |ns: u64| format!("{:.1}", ns as f64 / 1e6);
    let mut text = format!(
        "{:<26}{:>9}{:>9}  slowest device\n",
        "bring-up", "from ms", "took ms"
    );
    for step in steps {
        let (began, took) = (ms(step.began_ns), ms(step.took_ns));
        text += &format!("  {:<24}{began:>9}{took:>9}", step.name);
        if let Some((device, took)) = &step.slowest {
            text += &format!("  `{device}`, {} ms", ms(*took));
        }
        text.push('\n');
    }
    text
}

fn status_line(status: &Status, cycle_ns: u64) -> String {
    let mut text = bus_text(status, cycle_ns);
    for axis in &status.axes {
        text += "  ";
        text += &axis_text(axis);
    }
    text
}

fn bus_text(status: &Status, cycle_ns: u64) -> String {
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
/// Describes an optional device that was absent.
pub fn device_appeared(device: &DeviceRef, has_axes: bool) -> String {
    format!("{device} has appeared and is in Op{}", next_step(has_axes))
}

/// Returns what a device that is in Op needs next.
fn next_step(has_axes: bool) -> &'static str {
    match has_axes {
        true => "; reset its axes, then enable them",
        false => "; its outputs are off until a step sets them",
    }
}

/// Describes a device that is in Op again.
pub fn device_returned(
    device: &DeviceRef,
    after_ns: Nanos,
    home: Option<Home>,
    has_axes: bool,
) -> String {
    let after = after_ns as f64 * 1e-9;
    let home = match home {
        Some(Home::Lost) => "; it had no power, so home is lost",
        Some(Home::Kept) => "; it had no power, and keeps home by its absolute encoder",
        None => "",
    };
    let next = next_step(has_axes);
    format!("{device} is in Op again after {after:.2} s{home}{next}")
}
