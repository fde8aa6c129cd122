//! The step that enables axes.

use ecaxis_axis::{AxisStatus, Command, CommandError, EnableBlocker};
use ecaxis_ecat::index::AxisIndex;

use super::Turn;
use crate::clock;
use crate::config::Step;
use crate::report::{Cause, Error, Progress};
use crate::rt::channel::{RtCommand, Snapshot};

impl Turn<'_, '_> {
    pub async fn enable_axes(
        &mut self,
        step: Option<&Step>,
        axes: &[AxisIndex],
    ) -> Result<(), Error> {
        let snapshot = self.poll_and_query().await?;
        let mut commands = Vec::with_capacity(2 * axes.len());
        self.ensure_not_stopped(step, axes)?;
        for &axis in axes {
            if snapshot.axes.get(axis).is_some_and(|s| s.fault.is_some()) {
                self.report_preexisting_fault(axis).await;
                let command = Command::ResetFault;
                commands.push(RtCommand::Axis { axis, command });
            }
            let command = Command::Enable;
            commands.push(RtCommand::Axis { axis, command });
        }
        self.send_all(&commands).await;
        let mut start = clock::now();
        let timeout = self.machine.bus.enable_timeout_ns + self.longest_release(axes);
        loop {
            let snapshot = self.poll_and_query().await?;
            self.ensure_not_stopped(step, axes)?;
            let in_time = clock::now().saturating_sub(start) <= timeout;
            if let Some((axis, reason)) = self.take_refusal(axes) {
                // An axis that coasts may come to rest in time.
                if in_time && matches!(reason, CommandError::StillMoving { .. }) {
                    let command = Command::Enable;
                    self.send_all(&[RtCommand::Axis { axis, command }]).await;
                    continue;
                }
                return Err(Cause::EnableRefused {
                    reason: reason.to_string(),
                }
                .with_device(self.device_of(axis)));
            }
            if self.start.is_some() {
                // The commands wait for an instant of common time.
                start = clock::now();
                continue;
            }
            let status = |axis: AxisIndex| snapshot.axes.get(axis).copied();
            let late = axes
                .iter()
                .find_map(|&axis| Some((axis, status(axis)?)).filter(|(_, s)| !s.ready));
            let Some((waiting, status)) = late else {
                break;
            };
            if status.waiting == Some(EnableBlocker::Held) {
                start = clock::now();
            }
            let failed = status.reset_failed && snapshot.commands_taken >= self.commands_sent;
            if failed || !in_time {
                let (late, status) = self.late_half(waiting, status, &snapshot);
                return Err(self.not_enabled(late, status, timeout).await);
            }
        }
        self.confirm_modes(axes).await?;
        self.report(Progress::Enabled { axes: axes.len() });
        Ok(())
    }

    /// Returns the half of the axis' gantry that keeps the gantry from being ready, or the axis.
    fn late_half(
        &self,
        axis: AxisIndex,
        status: AxisStatus,
        snapshot: &Snapshot,
    ) -> (AxisIndex, AxisStatus) {
        let mut gantries = self.machine.gantries.iter();
        let gantry = gantries.find(|gantry| gantry.axes.contains(&axis));
        let halves = gantry.map(|gantry| gantry.axes).into_iter().flatten();
        let mut halves = halves.filter_map(|half| Some((half, *snapshot.axes.get(half)?)));
        match status.enabled {
            true => halves.find(|(_, half)| !half.enabled),
            false => None,
        }
        .unwrap_or((axis, status))
    }
}
