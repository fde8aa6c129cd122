//! Brings devices back that lost their power, were unplugged or left Op, while the others stay in
//! Op. Their groups have stopped; an axis is enabled by command only.
//!
//! A task next to the supervisor looks for lost devices, some times a second. A device that kept its
//! station address is asked by it. A device without one is found behind the neighbour and the port at
//! which it was, and must have the identity of the machine file.

use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use ecaxis_ecat::index::{DeviceIndex, IndexVec};
use ecaxis_ecat::registers;
use tokio::sync::{mpsc, oneshot, watch};

use super::Supervisor;
use super::clock_tree;
use crate::acyclic::device::read_sii;
use crate::acyclic::eeprom::EepromAccess;
use crate::acyclic::topology::parents;
use crate::acyclic::{AlState, DeviceRef, al, enumerate};
use crate::bringup::device_return::{RunningBus, RunningSync, bring_back, reset};
use crate::bringup::{BusDevice, Step, enable_op_only};
use crate::clock::{self, Nanos};
use crate::config::{Locator, Machine};
use crate::datagram::DatagramClient;
use crate::mailbox::{MailboxTransport, Mailboxes};
use crate::report::{Cause, DevicePlace, Error, Progress};
use crate::rt::channel::{RtCommand, Snapshot};
use crate::rt::image::ImagePlan;

const STEP: &str = "looking for devices that return";
/// The pause between two searches.
const PERIOD: Duration = Duration::from_millis(50);
/// The pause after a device has refused to return.
const RETRY: Nanos = 1_000_000_000;
/// The station address of a device until its identity is known. Devices of the machine have 0x1000
/// and above.
const TEMPORARY_STATION: u16 = 0x0fff;
/// Cycles until a command has taken effect and the answers show it.
const CYCLES_TO_SETTLE: u64 = 5;

/// What the cycle shows.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Presence {
    /// True for devices of stopped groups that do not answer or are not in Op.
    lost: IndexVec<DeviceIndex, bool>,
    reference: Option<DeviceIndex>,
}

/// A command for the cycle, with an answer once it is on its way.
type Order = (RtCommand, oneshot::Sender<()>);

/// The supervisor's end.
#[derive(Debug)]
pub(crate) struct ReturnPort {
    presence: watch::Sender<Presence>,
    orders: mpsc::Receiver<Order>,
}

impl Supervisor {
    /// Returns the task. It ends when [`Supervisor::returns`] is dropped.
    pub(super) fn return_devices(&mut self) -> impl Future<Output = ()> + use<> {
        let (presence, seen) = watch::channel(Presence::default());
        let (order, orders) = mpsc::channel(1);
        self.returns = Some(ReturnPort { presence, orders });
        let devices = self.bus.devices.iter();
        let task = Returner {
            wire: self.wire,
            machine: Arc::clone(&self.machine),
            image: self.bus.image.clone(),
            devices: devices.map(BusDevice::without_mailbox).collect(),
            places: self.bus.places(),
            mailboxes: self.mailboxes.clone(),
            presence: seen.clone(),
            order,
            progress: self.progress.clone(),
            searches: vec![Search::default(); self.bus.devices.len()].into(),
        };
        let mut ended = seen;
        async move {
            tokio::select! {
                biased;
                () = async { while ended.changed().await.is_ok() {} } => {}
                () = task.run() => {}
            }
        }
    }

    /// Passes on what the cycle shows, and takes the task's commands.
    pub(super) async fn attend_returns(&mut self, snapshot: &Snapshot) {
        let groups = &self.bus.image.groups;
        let lost = |(device, group)| {
            let stopped = snapshot
                .groups
                .get(group)
                .is_some_and(|g| g.stopped.is_some());
            let op = AlState::Op.code();
            let found = snapshot.diagnoses.get(device);
            stopped && found.is_some_and(|found| !found.answers || found.al_status != op)
        };
        let Some(port) = &mut self.returns else {
            return;
        };
        let now = Presence {
            lost: groups.enumerate().map(|(d, g)| lost((d, *g))).collect(),
            reference: snapshot.phase.and_then(|phase| phase.reference),
        };
        port.presence.send_if_modified(|last| {
            let changed = *last != now;
            *last = now;
            changed
        });
        while let Some((command, sent)) = self
            .returns
            .as_mut()
            .and_then(|port| port.orders.try_recv().ok())
        {
            self.send(command).await;
            // The task may have ended.
            let _ = sent.send(());
        }
    }
}

/// What is known of a lost device.
#[derive(Debug, Clone, Default)]
struct Search {
    /// When it was first seen missing.
    since: Option<Nanos>,
    /// No attempt before this time.
    not_before: Nanos,
    /// The last warning about it.
    warned: Option<String>,
}

struct Returner {
    wire: DatagramClient,
    machine: Arc<Machine>,
    image: ImagePlan,
    devices: IndexVec<DeviceIndex, BusDevice>,
    places: IndexVec<DeviceIndex, DevicePlace>,
    mailboxes: Mailboxes,
    presence: watch::Receiver<Presence>,
    order: mpsc::Sender<Order>,
    progress: std::sync::mpsc::Sender<Progress>,
    searches: IndexVec<DeviceIndex, Search>,
}

impl Returner {
    async fn run(mut self) {
        loop {
            let lost = self.lost();
            for (device, search) in self.searches.enumerate_mut() {
                if !lost.contains(&device) {
                    *search = Search::default();
                } else if search.since.is_none() {
                    search.since = Some(clock::now());
                }
            }
            if lost.is_empty() {
                if self.presence.changed().await.is_err() {
                    return;
                }
                continue;
            }
            clock::delay(PERIOD).await;
            if let Err(error) = self.search(&lost).await {
                tracing::debug!("{error}");
            }
        }
    }

    /// Returns the lost devices in the order of the segment.
    fn lost(&mut self) -> Vec<DeviceIndex> {
        let presence = self.presence.borrow_and_update();
        let lost = presence.lost.enumerate().filter(|(_, lost)| **lost);
        let mut lost: Vec<_> = lost.map(|(device, _)| device).collect();
        lost.sort_by_key(|device| self.places.get(*device).map(|place| place.position));
        lost
    }

    /// Searches all lost devices once and brings back those that are there.
    async fn search(&mut self, lost: &[DeviceIndex]) -> Result<(), Error> {
        let mut without_address = Vec::new();
        for &device in lost {
            let station = self.devices[device].at.station;
            let status = al::read_status(&self.wire, station).await;
            match status.map_err(failed)? {
                // The last diagnosis is older.
                Some((status, _)) if status == AlState::Op.code() => {}
                Some(_) => self.attempt(device, false).await,
                None => without_address.push(device),
            }
        }
        if without_address.is_empty() {
            return Ok(());
        }
        for (device, position) in self.find(&without_address).await? {
            if clock::now() < self.searches[device].not_before {
                continue;
            }
            match self.identify(device, position).await {
                Ok(()) => self.attempt(device, true).await,
                Err(error) => self.refuse(device, &error),
            }
        }
        Ok(())
    }

    /// Returns the positions of devices without a known address that are at the place of a lost one.
    async fn find(&self, lost: &[DeviceIndex]) -> Result<Vec<(DeviceIndex, u16)>, Error> {
        let count = enumerate::count(&self.wire).await?;
        let present = self.devices.len().saturating_sub(lost.len());
        if usize::from(count) <= present {
            return Ok(Vec::new());
        }
        let (mut stations, mut status) = (Vec::new(), Vec::new());
        for position in 0..count {
            let word = async |register| {
                let bytes = enumerate::at(&self.wire, position, STEP, register).await?;
                Ok::<_, Error>(u16::from_le_bytes(bytes))
            };
            stations.push(word(registers::STATION_ADDRESS).await?);
            status.push(word(registers::DL_STATUS).await?);
        }
        let mut here: Vec<Option<DeviceIndex>> = Vec::new();
        let mut found = Vec::new();
        for ((position, station), parent) in (0..).zip(stations).zip(parents(status)) {
            let known = self
                .devices
                .enumerate()
                .find(|(_, d)| d.at.station == station);
            let parent = parent.map(|parent| {
                let device = here.get(usize::from(parent.device)).copied().flatten();
                (device, parent.port)
            });
            let at_place = |device: &&DeviceIndex| {
                let before = self.places.get(**device).and_then(|place| place.parent);
                before.map(|(device, port)| (Some(device), port)) == parent
            };
            let device = match known {
                Some((device, _)) => Some(device),
                None => lost.iter().find(at_place).copied(),
            };
            here.push(device);
            if let (None, Some(device)) = (known, device) {
                found.push((device, position));
            }
        }
        Ok(found)
    }

    /// Gives a device its station address if its identity is that of the machine file.
    async fn identify(&mut self, index: DeviceIndex, position: u16) -> Result<(), Error> {
        let config = &self.machine.devices[index];
        let device = &mut self.devices[index];
        let own = device.at.station;
        let temporary = DeviceRef {
            position,
            station: TEMPORARY_STATION,
            ..device.at.clone()
        };
        let address = TEMPORARY_STATION.to_le_bytes();
        let written = self
            .wire
            .write_at(position, registers::STATION_ADDRESS, &address);
        written.await.map_err(failed)?;
        let sii = read_sii(&self.wire, &temporary, EepromAccess::Force).await?;
        let expected = config.selection.identity;
        let same =
            (expected.vendor, expected.product) == (sii.identity.vendor, sii.identity.product);
        if !same
            || !config
                .identity
                .accepts(expected.revision, sii.identity.revision)
        {
            return Err(Cause::Identity {
                esi: config.esi_path.display().to_string(),
                expected: format!("{} ({expected})", config.selection.device_name),
                found: sii.identity.to_string(),
                revisions: same.then_some((expected.revision, sii.identity.revision)),
            }
            .with_device(&temporary));
        }
        if let Some(expected) = config.serial.filter(|expected| *expected != sii.serial) {
            let found = sii.serial;
            return Err(Cause::Serial { expected, found }.with_device(&temporary));
        }
        let located = match config.at {
            Locator::Position(_) => true,
            Locator::Alias(alias) => sii.alias == alias,
            Locator::Id(id) => {
                let timeout = al::IDENTIFICATION_TIMEOUT;
                al::read_explicit_id(&self.wire, TEMPORARY_STATION, timeout).await == Ok(Some(id))
            }
        };
        if !located {
            let locator = config.at.to_string();
            return Err(Cause::NotLocated { locator }.with_device(&temporary));
        }
        if sii.serial != device.serial && config.serial.is_none() {
            let warning = format!(
                "{}: the device has the serial number {}, before it was {}: it is another one of the same kind. \
                 Parameters and home are its own",
                device.at, sii.serial, device.serial
            );
            device.serial = sii.serial;
            let _ = self.progress.send(Progress::Warning(warning));
        }
        let station = own.to_le_bytes();
        let register = registers::STATION_ADDRESS;
        let written = self.wire.write(TEMPORARY_STATION, register, &station).await;
        written.map_err(failed).map(drop)
    }

    /// Brings a device back that answers at its station address. `restarted`: it had no power.
    async fn attempt(&mut self, index: DeviceIndex, restarted: bool) {
        if clock::now() < self.searches[index].not_before {
            return;
        }
        let done = self.bring_to_op(index).await;
        if done.is_err() {
            self.leave_in_init(index).await;
        } else if restarted {
            self.command(RtCommand::Restarted { device: index }).await;
        }
        match done {
            Ok(()) => {
                let since = self.searches[index].since.unwrap_or_else(clock::now);
                let _ = self.progress.send(Progress::DeviceReturned {
                    device: self.devices[index].at.clone(),
                    after_ns: clock::now().saturating_sub(since),
                    restarted,
                });
                // The next diagnosis shows it in Op.
                self.searches[index].not_before = clock::now() + RETRY;
            }
            Err(error) => self.refuse(index, &error),
        }
    }

    async fn bring_to_op(&mut self, index: DeviceIndex) -> Result<(), Error> {
        let reference = self.presence.borrow().reference.filter(|r| *r != index);
        let reference = reference
            .and_then(|r| self.devices.get(r))
            .map(|d| d.at.clone());
        if let Some(reference) = &reference {
            let clocks = clock_tree::clocks(&self.devices);
            clock_tree::update(&self.wire, &clocks, reference.station, || true).await?;
        }
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
        let bus = RunningBus {
            wire: &self.wire,
            machine: &self.machine,
            image: &self.image,
            reference: reference.as_ref(),
            sync: self.running_sync(index),
        };
        let returned = bring_back(bus, index, &mut device, &report).await;
        if let (Some(coe), Some(give_back)) = (device.coe.take(), give_back) {
            let _ = give_back.send(coe);
        }
        returned?;
        enable_op_only(&self.wire, &device, true).await?;
        let op = [device.transition(AlState::Op, false)];
        al::change_states(&self.wire, &op, AlState::Op).await
    }

    /// Returns a device in Op with SYNC0; one with the same cycle if there is one.
    fn running_sync(&self, returns: DeviceIndex) -> Option<RunningSync<'_>> {
        let presence = self.presence.borrow();
        let cycle = |device: DeviceIndex| {
            let dc = self.machine.devices.get(device)?.selection.dc.as_ref()?;
            Some((dc, dc.sync0_cycle_ns))
        };
        let own = cycle(returns).map(|(_, cycle)| cycle);
        let runs = |device: &DeviceIndex| presence.lost.get(*device) == Some(&false);
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

    /// Reports why a device does not return, once.
    fn refuse(&mut self, index: DeviceIndex, error: &Error) {
        let search = &mut self.searches[index];
        search.not_before = clock::now() + RETRY;
        let text = format!(
            "`{}` does not return: {error}",
            self.machine.devices[index].name
        );
        if search.warned.as_ref() != Some(&text) {
            let _ = self.progress.send(Progress::Warning(text.clone()));
            search.warned = Some(text);
        }
    }

    /// Sends a command to the cycle and waits until it has taken effect.
    async fn command(&self, command: RtCommand) {
        let (sent, taken) = oneshot::channel();
        if self.order.send((command, sent)).await.is_ok() {
            let _ = taken.await;
        }
        let cycles = CYCLES_TO_SETTLE * self.machine.bus.cycle_ns;
        clock::delay(Duration::from_nanos(cycles)).await;
    }
}

fn failed(error: crate::mailbox::DatagramError) -> Error {
    Error::from(Cause::Datagram(error)).with_action(STEP)
}
