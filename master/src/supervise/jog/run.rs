//! The loop that serves the operator.

use std::sync::Arc;

use ecaxis_axis::Command;
use ecaxis_ecat::index::{AxisIndex, GroupIndex};

use super::controller::{Activity, Commands, JogContext, JogController};
use super::{JogEvent, Operator, Presence, View};
use crate::clock;
use crate::report::Error;
use crate::rt::channel::RtCommand;
use crate::rt::reaction_group::GroupStatus;
use crate::supervise::Supervisor;
use crate::supervise::explain::MODES_OF_OPERATION_DISPLAY;

/// The maximum number of requests per call, not counting stops.
const MOST_REQUESTS: usize = 64;

impl Supervisor {
    /// Runs until the operator leaves. Axes are enabled on request.
    pub(in crate::supervise) async fn run_operator(
        &mut self,
        operator: &mut dyn Operator,
    ) -> Result<(), Error> {
        let timeout = self.machine.bus.enable_timeout_ns + self.longest_stop();
        let all: Vec<_> = self.machine.axes.indices().collect();
        let timeout = timeout + self.longest_release(&all);
        let mut worker = JogController::new(all.len(), timeout);
        let machine = Arc::clone(&self.machine);
        // Enabled axes whose mode must be read over CoE because it is not in their process data.
        let mut enabled: Vec<AxisIndex> = Vec::new();
        let hidden = |axis: AxisIndex| {
            let setup = &machine.axes[axis];
            let display = ecaxis_esi::axis::object(MODES_OF_OPERATION_DISPLAY, setup.number);
            let layout = &machine.devices[setup.device].selection.layout;
            layout.tx_field(display, 0).is_none()
        };
        let just_enabled = |news: &JogEvent| match *news {
            JogEvent::Done {
                axis,
                what: Activity::Enabling,
            } if hidden(axis) => Some(axis),
            _ => None,
        };
        loop {
            let snapshot = self.poll_snapshot().await?;
            let mut commands = Commands::new();
            let scene = JogContext {
                now: clock::now(),
                machine: &machine,
                snapshot: &snapshot,
            };
            for (axis, reason) in self.refused.drain(..) {
                worker.refused(axis, reason, &scene, &mut commands);
            }
            // Before this, the snapshot does not show the effect of the commands.
            if snapshot.commands_taken >= self.commands_sent {
                worker.look(&scene, &mut commands);
            }
            let news: Vec<JogEvent> = worker.news.drain(..).collect();
            let turn = operator.turn(&View {
                now: scene.now,
                machine: scene.machine,
                snapshot: &snapshot,
                hands: &worker.hands,
                news: &news,
            });
            worker.watch(&scene, turn.presence, &mut commands);
            let there = turn.presence == Presence::Here;
            for (index, request) in turn.requests.into_iter().enumerate() {
                if request.stops() || (there && index < MOST_REQUESTS) {
                    worker.take(request, &scene, &mut commands);
                }
            }
            let stopped = |group: (GroupIndex, &GroupStatus)| {
                group.1.stopped.is_some() && !self.is_stopped(group.0)
            };
            let just_stopped = snapshot.groups.enumerate().any(stopped);
            enabled.extend(news.iter().filter_map(just_enabled));
            // Mailbox reads may take long, and the jog timeout is not checked meanwhile.
            if just_stopped || !enabled.is_empty() {
                worker.brake(&scene, &mut commands);
            }
            let commands = commands.into_iter();
            let commands = commands.map(|(axis, command)| RtCommand::Axis { axis, command });
            let commands: Vec<RtCommand> = commands.collect();
            if !commands.is_empty() {
                self.send_all(&commands).await;
            }
            if turn.presence == Presence::Gone {
                // The operator has seen these faults, so the shutdown does not report them.
                let ill = |axis: &AxisIndex| {
                    let status = snapshot.axes.get(*axis);
                    status.is_some_and(|s| s.fault.is_some() || s.trip.is_some())
                };
                self.seen = all.iter().copied().filter(ill).collect();
                return Ok(());
            }
            if worker.moves() {
                continue;
            }
            self.report_stopped_groups(&snapshot).await;
            for axis in enabled.drain(..) {
                let own = self.setup(axis).map(|setup| setup.config.mode);
                let other = own != snapshot.axes.get(axis).map(|status| status.mode);
                if !other && let Err(error) = self.confirm_modes(&[axis]).await {
                    let what = Activity::Enabling;
                    let why = error.to_string();
                    worker.news.push_back(JogEvent::Failed { axis, what, why });
                    let command = Command::Disable;
                    self.send(RtCommand::Axis { axis, command }).await;
                }
            }
        }
    }
}
