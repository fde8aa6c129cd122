//! Brings one device back to Op.

use std::time::Duration;

use ecaxis_ecat::index::DeviceIndex;

use super::RunningSegment;
use crate::acyclic::{AlState, DeviceRef, al};
use crate::bringup::device_return::{RunningBus, RunningSync, bring_back, reset};
use crate::bringup::{Step, enable_op_only};
use crate::clock::{self, Nanos};
use crate::report::{Error, Progress};

impl RunningSegment {
    /// Brings a device back that answers at its station address. `position`: where it was found, if it
    /// had no address.
    pub(super) async fn attempt(
        &self,
        (index, position): (DeviceIndex, Option<u16>),
        since: Option<Nanos>,
        (restarted, first): (bool, bool),
    ) -> (DeviceIndex, Result<(), Error>) {
        let done = self.bring_to_op(index, restarted).await;
        if done.is_err() {
            self.leave_in_init(index).await;
            return (index, done);
        }
        let since = since.unwrap_or_else(clock::now);
        self.report(Progress::DeviceReturned {
            device: DeviceRef {
                position: position.unwrap_or(self.devices[index].at.position),
                ..self.devices[index].at.clone()
            },
            after_ns: clock::now().saturating_sub(since),
            restarted,
            first,
        });
        (index, Ok(()))
    }

    async fn bring_to_op(&self, index: DeviceIndex, restarted: bool) -> Result<(), Error> {
        let reference = self.bus_status.reference().filter(|r| *r != index);
        let reference = reference
            .and_then(|r| self.devices.get(r))
            .map(|d| d.at.clone());
        let loan = self.mailboxes.borrow(index).await;
        let mut device = self.devices[index].without_mailbox();
        let (coe, give_back) = loan.unzip();
        device.coe = coe;
        let progress = &self.progress;
        let report = |step| {
            if let Step::Warning(text) = step {
                let _ = progress.send(Progress::Warning(text));
            }
        };
        let lost: Vec<_> = self.bus_status.lost().collect();
        let bus = RunningBus {
            wire: &self.wire,
            machine: &self.machine,
            image: &self.image,
            reference: reference.as_ref(),
            sync: self.running_sync(index, &lost),
            latch: &self.latch,
        };
        let returned = bring_back(bus, index, &mut device, &report).await;
        if let (Some(coe), Some(give_back)) = (device.coe.take(), give_back) {
            let _ = give_back.send(coe);
        }
        returned?;
        if restarted {
            // The axes need the positions of SafeOp, and their group is not released before Op.
            self.settle().await;
            self.bus_status.set_restarted(index);
            self.settle().await;
        }
        enable_op_only(&self.wire, &device, true).await?;
        let op = [device.transition(AlState::Op, false)];
        al::change_states(&self.wire, &op, AlState::Op).await
    }

    /// Waits for some cycles.
    async fn settle(&self) {
        const CYCLES: u64 = 5;
        clock::delay(Duration::from_nanos(CYCLES * self.machine.bus.cycle_ns)).await;
    }

    /// Returns a device in Op with SYNC0; one with the same cycle if there is one.
    pub(super) fn running_sync(
        &self,
        returns: DeviceIndex,
        lost: &[DeviceIndex],
    ) -> Option<RunningSync<'_>> {
        let cycle = |device: DeviceIndex| {
            let dc = self.machine.devices.get(device)?.selection.dc.as_ref()?;
            Some((dc, dc.sync0_cycle_ns))
        };
        let own = cycle(returns).map(|(_, cycle)| cycle);
        let runs = |device: &DeviceIndex| !lost.contains(device);
        let others = self
            .devices
            .enumerate()
            .filter(|(d, _)| *d != returns && runs(d));
        let running = others.filter_map(|(index, device)| {
            let (dc, _) = cycle(index).filter(|(_, cycle)| *cycle > 0)?;
            Some(RunningSync { at: &device.at, dc })
        });
        running.min_by_key(|sync| Some(sync.dc.sync0_cycle_ns) != own)
    }

    /// Takes a device that did not return out of the process data, so that its group stays stopped.
    async fn leave_in_init(&self, index: DeviceIndex) {
        let device = &self.devices[index];
        let init = [device.transition(AlState::Init, true)];
        let left = al::change_states(&self.wire, &init, AlState::Init).await;
        let left = left.and(reset(&self.wire, &device.at).await);
        if let Err(error) = left {
            tracing::debug!("{error}");
        }
    }
}
