//! Brings one device back to Op.

use std::cell::RefCell;
use std::time::Duration;

use ecaxis_ecat::index::DeviceIndex;

use super::{RunningSegment, Search};
use crate::acyclic::{AlState, DeviceRef, al};
use crate::bringup::device_return::{RunningBus, RunningSync, bring_back, reset};
use crate::bringup::process_data::ControlBytes;
use crate::bringup::{Step, enable_op_only};
use crate::clock;
use crate::config::AxisSetup;
use crate::report::{Error, Home, Progress};

impl RunningSegment {
    /// Brings a device back that answers at its station address.
    pub(super) async fn attempt(
        &self,
        index: DeviceIndex,
        search: Search,
    ) -> (DeviceIndex, Result<(), Error>) {
        let done = self.bring_to_op(index, &search).await;
        if done.is_err() {
            self.leave_in_init(index).await;
            return (index, done);
        }
        self.report_return(index, &search);
        (index, Ok(()))
    }

    pub(super) fn report_return(&self, index: DeviceIndex, search: &Search) {
        let since = search.since.unwrap_or_else(clock::now);
        let at = self.devices[index].at.clone();
        self.report(Progress::DeviceReturned {
            device: DeviceRef {
                position: search.place.map_or(at.position, |place| place.position),
                ..at
            },
            after_ns: clock::now().saturating_sub(since),
            restarted: search.restarted,
            home: self.home(index, search),
            first: search.absent,
            has_axes: self.machine.has_axes(self.machine.group_of(index)),
        });
    }

    /// Returns what a restart has made of the home of the axes.
    fn home(&self, index: DeviceIndex, search: &Search) -> Option<Home> {
        let mut axes = self.machine.axes_of(index).peekable();
        let same = self.is_same(index, search);
        let kept = |(_, axis): (_, &AxisSetup)| same && axis.config.absolute;
        axes.peek().filter(|_| search.restarted)?;
        Some(if axes.all(kept) {
            Home::Kept
        } else {
            Home::Lost
        })
    }

    /// Returns true if the serial number shows that a device is the one that was there before.
    fn is_same(&self, index: DeviceIndex, search: &Search) -> bool {
        let kept = self.machine.devices[index].parameters.as_ref();
        let known = kept.is_none_or(|kept| kept.is_of(search.serial));
        search.serial != 0 && !search.replaced && known
    }

    async fn bring_to_op(&self, index: DeviceIndex, search: &Search) -> Result<(), Error> {
        let reference = self.bus_status.reference().filter(|r| *r != index);
        let reference = reference
            .and_then(|r| self.devices.get(r))
            .map(|d| d.at.clone());
        let loan = self.mailboxes.borrow(index).await;
        let mut device = self.devices[index].without_mailbox();
        let (coe, give_back) = loan.unzip();
        device.set_client(&self.machine.devices[index], coe);
        device.serial = search.serial;
        if search.replaced {
            device.control_bytes = ControlBytes::default();
        }
        // Those of a failed attempt would come again with each of the next.
        let warnings = RefCell::new(Vec::new());
        let report = |step| {
            if let Step::Warning(text) = step {
                warnings.borrow_mut().push(text);
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
        if let (Some(coe), Some(give_back)) = (device.take_client(), give_back) {
            let _ = give_back.send(coe);
        }
        returned?;
        for text in warnings.into_inner() {
            self.report(Progress::Warning(text));
        }
        if search.restarted {
            // The axes need the positions of SafeOp, and their group is not released before Op.
            self.settle().await;
            let same = self.is_same(index, search);
            self.bus_status.set_restarted(index, same);
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
