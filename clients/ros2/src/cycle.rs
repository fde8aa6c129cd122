//! The thread that writes the set-points of each cycle.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender};
use std::thread::sleep;
use std::time::{Duration, Instant};

use ecaxis_axis::{State, Statusword};
use rustix::time::{ClockId, clock_gettime};

use crate::command::Wanted;
use crate::follower::{AxisInput, End, Follower, Publisher, Refusal};
use crate::joints::Joint;
use crate::server::{Commands, Samples};
use crate::trajectory::{Plan, Start};

/// The pause between two looks at the samples.
const POLL: Duration = Duration::from_micros(20);
/// The time after which a bus without cycles is given up.
const NO_CYCLE: Duration = Duration::from_secs(1);
/// Bits of the flags of a row.
const IN_OP: u64 = 2;

/// A message to the cycle.
#[derive(Debug)]
pub enum Message {
    /// A command for each joint.
    Command {
        publisher: Publisher,
        wanted: Vec<Option<Wanted>>,
    },
    /// A checked trajectory, and who learns that it does not begin.
    Trajectory(Vec<Plan>),
    /// Ends what joints follow; with `hold` until [`Message::Release`]. `None`: all joints.
    Stop { joint: Option<usize>, hold: bool },
    /// Lets joints follow commands again.
    Release(Option<usize>),
}

/// What a joint does about its commands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Report {
    Follows,
    Plays,
    Ended(End),
    Refused(Refusal),
    Stopped { held: bool },
}

/// Where the values of an axis are in a row.
#[derive(Debug, Clone, Copy)]
pub struct Columns {
    pub position: usize,
    pub velocity: usize,
    pub torque: usize,
    target_position: usize,
    target_velocity: usize,
    statusword: usize,
    mode: usize,
}

impl Columns {
    /// Returns the columns of each joint.
    ///
    /// # Errors
    /// Names the signal that is missing.
    pub fn of_joints(samples: &Samples, joints: &[Joint]) -> Result<Vec<Self>, String> {
        let of_joint = |joint: &Joint| {
            let word = |value: &str| {
                let name = format!("{}.{value}", joint.axis);
                samples
                    .signal(&name)
                    .ok_or_else(|| format!("the samples have no `{name}`"))
            };
            Ok(Self {
                position: word("position")?,
                velocity: word("velocity")?,
                torque: word("torque")?,
                target_position: word("target_position")?,
                target_velocity: word("target_velocity")?,
                statusword: word("statusword")?,
                mode: word("mode")?,
            })
        };
        joints.iter().map(of_joint).collect()
    }

    /// Returns the state of the axis in a row.
    #[must_use]
    pub fn start(&self, row: &[u64]) -> Start {
        let in_op = row.get(3).is_some_and(|flags| flags & IN_OP != 0);
        let word = value(row, self.statusword);
        let state = State::from_statusword(Statusword::from_bits_retain(word as u16));
        Start {
            position: value(row, self.target_position),
            enabled: in_op && !word.is_nan() && state == State::OperationEnabled,
            stands: value(row, self.target_velocity) == 0.0,
            mode: value(row, self.mode) as i8,
        }
    }
}

/// Returns a value of a row; NaN without one.
#[must_use]
pub fn value(row: &[u64], word: usize) -> f64 {
    row.get(word).map_or(f64::NAN, |bits| f64::from_bits(*bits))
}

/// Returns the time of CLOCK_MONOTONIC in ns.
#[must_use]
pub fn monotonic_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

/// Waits for the cycle after `row`. Returns the number of rows; `None` if none comes.
pub fn wait_for_row(samples: &Samples, row: u64, ended: &AtomicBool) -> Option<u64> {
    let begin = Instant::now();
    // Most of the time is slept in one piece.
    let due = samples.next_ns().saturating_sub(monotonic_ns());
    sleep(Duration::from_nanos(due.min(samples.cycle_ns)));
    loop {
        let written = samples.written();
        if written != row {
            return Some(written);
        }
        if begin.elapsed() > NO_CYCLE || ended.load(Ordering::Relaxed) {
            return None;
        }
        sleep(POLL);
    }
}

/// The joints in the cycle.
#[derive(Debug)]
pub struct Cycle {
    pub samples: Samples,
    pub commands: Commands,
    pub columns: Vec<Columns>,
    pub joints: Vec<Joint>,
    pub followers: Vec<Follower>,
    pub reports: Sender<(usize, Report)>,
    /// The last report of each joint.
    reported: Vec<Option<Report>>,
}

impl Cycle {
    #[must_use]
    pub fn new(
        samples: Samples,
        commands: Commands,
        columns: Vec<Columns>,
        joints: Vec<Joint>,
        followers: Vec<Follower>,
        reports: Sender<(usize, Report)>,
    ) -> Self {
        let reported = vec![None; joints.len()];
        Self {
            samples,
            commands,
            columns,
            joints,
            followers,
            reports,
            reported,
        }
    }

    /// Writes set-points until the bus has no cycle for a second, or `ended` is set.
    pub fn run(&mut self, messages: &Receiver<Message>, ended: &AtomicBool) {
        let axes = self
            .joints
            .iter()
            .map(|joint| joint.index + 1)
            .max()
            .unwrap_or(0);
        let mut set = vec![(0, 0.0); axes];
        let mut values = Vec::new();
        let mut row = self.samples.written();
        while let Some(written) = wait_for_row(&self.samples, row, ended) {
            let cycles = written.saturating_sub(row);
            row = written;
            if !self.samples.read_newest(&mut values) {
                continue;
            }
            while let Ok(message) = messages.try_recv() {
                self.take(message);
            }
            let mut broken = false;
            for index in 0..self.joints.len() {
                let axis = self.joints[index].index;
                let Start {
                    position,
                    enabled,
                    stands,
                    ..
                } = self.columns[index].start(&values);
                let blocked = self.commands.blocked(axis);
                let input = AxisInput {
                    target_position: position,
                    enabled,
                    stands,
                    blocked,
                };
                let plays = self.followers[index].plays();
                let (wanted, end) = self.followers[index].advance(input, cycles);
                if let Some(end) = end {
                    broken |= plays && end != End::Done;
                    self.report(index, Report::Ended(end));
                }
                set[axis] = match wanted {
                    None => (0, 0.0),
                    Some(Wanted::Position(position)) => (1, position),
                    Some(Wanted::Velocity(velocity)) => (2, velocity),
                    Some(Wanted::Torque(percent)) => (3, percent),
                };
            }
            if broken {
                self.stop_trajectory(&mut set);
            }
            self.commands.write(row, &set);
        }
    }

    /// The other joints of a trajectory do not go on alone.
    fn stop_trajectory(&mut self, set: &mut [(u64, f64)]) {
        for index in 0..self.joints.len() {
            if self.followers[index].plays() {
                self.followers[index].stop(false);
                set[self.joints[index].index] = (0, 0.0);
                self.report(index, Report::Ended(End::Blocked));
            }
        }
    }

    fn report(&mut self, joint: usize, report: Report) {
        let before = self.reported[joint].replace(report);
        let far = |report| matches!(report, Report::Refused(Refusal::Far(_)));
        if before != Some(report) && !(far(report) && before.is_some_and(far)) {
            let _ = self.reports.send((joint, report));
        }
    }

    fn take(&mut self, message: Message) {
        match message {
            Message::Command { publisher, wanted } => {
                for (joint, wanted) in wanted.into_iter().enumerate() {
                    let (Some(wanted), Some(follower)) = (wanted, self.followers.get_mut(joint))
                    else {
                        continue;
                    };
                    let report = match follower.command(wanted, publisher) {
                        Ok(()) => Report::Follows,
                        Err(refusal) => Report::Refused(refusal),
                    };
                    self.report(joint, report);
                }
            }
            Message::Trajectory(plans) => self.play(plans),
            Message::Stop { joint, hold } => {
                for index in self.chosen(joint) {
                    self.followers[index].stop(hold);
                    let held = self.followers[index].is_held();
                    self.report(index, Report::Stopped { held });
                }
            }
            Message::Release(joint) => {
                for index in self.chosen(joint) {
                    self.followers[index].release();
                    if self.followers[index].is_free() {
                        self.report(index, Report::Stopped { held: false });
                    }
                }
            }
        }
    }

    fn chosen(&self, joint: Option<usize>) -> std::ops::Range<usize> {
        match joint {
            None => 0..self.followers.len(),
            Some(joint) if joint < self.followers.len() => joint..joint + 1,
            Some(_) => 0..0,
        }
    }

    /// Begins a trajectory, with all of its joints or none.
    fn play(&mut self, plans: Vec<Plan>) {
        for plan in &plans {
            let checked = self
                .followers
                .get(plan.joint)
                .map(|f| f.check_play(plan.start));
            if let Some(Err(refusal)) = checked {
                self.report(plan.joint, Report::Refused(refusal));
                return;
            }
        }
        for plan in plans {
            let Some(follower) = self.followers.get_mut(plan.joint) else {
                continue;
            };
            let report = match follower.play(plan.table, plan.start) {
                Ok(()) => Report::Plays,
                Err(refusal) => Report::Refused(refusal),
            };
            self.report(plan.joint, report);
        }
    }
}
