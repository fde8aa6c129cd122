//! The thread that writes the set-points of each cycle.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender};

use ecaxis_axis::{State, Statusword};
use ecaxis_client::{AxisNumber, Cyclic, Samples, SetPoint, Signal};

use crate::follower::{AxisInput, End, Follower, Publisher, Refusal};
use crate::joints::Joint;
use crate::trajectory::{Plan, Start};

/// A message to the cycle.
#[derive(Debug)]
pub enum Message {
    /// A command for each joint.
    Command {
        publisher: Publisher,
        wanted: Vec<Option<SetPoint>>,
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

/// Where an axis is in the area.
#[derive(Debug, Clone, Copy)]
pub struct Columns {
    axis: AxisNumber,
    pub position: Signal,
    pub velocity: Signal,
    pub torque: Signal,
    target_position: Signal,
    target_velocity: Signal,
    statusword: Signal,
    mode: Signal,
}

impl Columns {
    /// Returns the columns of each joint.
    ///
    /// # Errors
    /// Names the axis or the signal that is missing.
    pub fn of_joints(cyclic: &Cyclic, joints: &[Joint]) -> ecaxis_client::Result<Vec<Self>> {
        let of_joint = |joint: &Joint| {
            let signal = |value: &str| cyclic.signal(&format!("{}.{value}", joint.axis));
            Ok(Self {
                axis: cyclic.axis(&joint.axis)?,
                position: signal("position")?,
                velocity: signal("velocity")?,
                torque: signal("torque")?,
                target_position: signal("target_position")?,
                target_velocity: signal("target_velocity")?,
                statusword: signal("statusword")?,
                mode: signal("mode")?,
            })
        };
        joints.iter().map(of_joint).collect()
    }

    /// Returns the state of the axis in the last cycle.
    #[must_use]
    pub fn start(&self, samples: &Samples) -> Start {
        let word = samples.value(self.statusword);
        let state = State::from_statusword(Statusword::from_bits_retain(word as u16));
        Start {
            position: samples.value(self.target_position),
            enabled: samples.in_op() && !word.is_nan() && state == State::OperationEnabled,
            stands: samples.value(self.target_velocity) == 0.0,
            mode: samples.value(self.mode) as i8,
        }
    }
}

/// The joints in the cycle.
#[derive(Debug)]
pub struct Cycle {
    cyclic: Cyclic,
    columns: Vec<Columns>,
    followers: Vec<Follower>,
    reports: Sender<(usize, Report)>,
    /// The last report of each joint.
    reported: Vec<Option<Report>>,
}

impl Cycle {
    #[must_use]
    pub fn new(
        cyclic: Cyclic,
        columns: Vec<Columns>,
        followers: Vec<Follower>,
        reports: Sender<(usize, Report)>,
    ) -> Self {
        let reported = vec![None; columns.len()];
        Self {
            cyclic,
            columns,
            followers,
            reports,
            reported,
        }
    }

    /// Writes set-points until the bus has no cycle for a second, or `ended` is set.
    pub fn run(&mut self, messages: &Receiver<Message>, ended: &AtomicBool) {
        while !ended.load(Ordering::Relaxed)
            && let Ok(cycles) = self.cyclic.wait()
        {
            while let Ok(message) = messages.try_recv() {
                self.take(message);
            }
            let mut broken = false;
            for index in 0..self.columns.len() {
                let columns = self.columns[index];
                let start = columns.start(&self.cyclic);
                let input = AxisInput {
                    target_position: start.position,
                    enabled: start.enabled,
                    stands: start.stands,
                    blocked: self.cyclic.is_stopped(columns.axis),
                };
                let plays = self.followers[index].plays();
                let (wanted, end) = self.followers[index].advance(input, cycles);
                if let Some(end) = end {
                    broken |= plays && end != End::Done;
                    self.report(index, Report::Ended(end));
                }
                self.cyclic.set(columns.axis, wanted.unwrap_or_default());
            }
            if broken {
                self.stop_trajectory();
            }
            self.cyclic.publish();
        }
    }

    /// The other joints of a trajectory do not go on alone.
    fn stop_trajectory(&mut self) {
        for index in 0..self.columns.len() {
            if self.followers[index].plays() {
                self.followers[index].stop(false);
                self.cyclic.set(self.columns[index].axis, SetPoint::None);
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
