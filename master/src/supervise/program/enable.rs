//! The step that enables axes.

use ecaxis_axis::Command;
use ecaxis_ecat::index::AxisIndex;

use super::Turn;
use crate::clock;
use crate::config::Step;
use crate::report::{Cause, Error, Progress};
use crate::rt::channel::RtCommand;

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
            if let Some((axis, reason)) = self.take_refusal(axes) {
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
            let failed = status.reset_failed && snapshot.commands_taken >= self.commands_sent;
            if failed || clock::now().saturating_sub(start) > timeout {
                return Err(self.not_enabled(waiting, status, timeout).await);
            }
        }
        self.confirm_modes(axes).await?;
        self.report(Progress::Enabled { axes: axes.len() });
        Ok(())
    }
}
