//! Brings devices back that lost their power, were unplugged or left Op, while the others stay in
//! Op. Their groups have stopped; an axis is enabled by command only.
//!
//! A task next to the supervisor looks for lost devices every [`PERIOD`]. It asks a device that kept
//! its station address at that address. It finds a device without an address by its parent and port.
//! Both must have the identity of the machine file.

use std::convert::Infallible;
use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use ecaxis_ecat::index::{DeviceIndex, IndexVec};
use ecaxis_ecat::registers;
use ecaxis_esi::Identity;
use tokio::sync::{Mutex, oneshot};

use super::Supervisor;
use super::clock_tree::Delays;
use crate::acyclic::eeprom::{EepromAccess, with_eeprom};
use crate::acyclic::topology::{in_line, parents};
use crate::acyclic::{AlState, DeviceRef, StateError, al, enumerate};
use crate::bringup::device_return::{RunningBus, RunningSync, bring_back, reset};
use crate::bringup::{BusDevice, Step, compare_identity, enable_op_only};
use crate::clock::{self, Nanos};
use crate::concurrent::try_join_all;
use crate::config::{Locator, Machine};
use crate::datagram::DatagramClient;
use crate::mailbox::{MailboxTransport, Mailboxes};
use crate::report::{Cause, DevicePlace, Error, Progress};
use crate::rt::exchange::BusStatus;
use crate::rt::image::ImagePlan;

const STEP: &str = "looking for devices that return";
/// The pause between two searches.
const PERIOD: Duration = Duration::from_millis(50);
/// The pause after a device has refused to return.
const RETRY: Nanos = 1_000_000_000;
/// The station address of a device until its identity is known. Devices of the machine have 0x1000
/// and above.
const TEMPORARY_STATION: u16 = 0x0fff;

/// The supervisor's end. The task ends when it is dropped.
pub(crate) type ReturnPort = oneshot::Receiver<Infallible>;

impl Supervisor {
    /// Returns the task. It ends when [`Supervisor::returns`] is dropped.
    pub(super) fn return_devices(
        &mut self,
        latch: Arc<Mutex<()>>,
    ) -> impl Future<Output = ()> + use<> {
        let (mut end, port) = oneshot::channel();
        self.returns = Some(port);
        let devices = self.bus.devices.iter();
        let task = ReturnTask {
            wire: self.wire,
            machine: Arc::clone(&self.machine),
            image: self.bus.image.clone(),
            devices: devices.map(BusDevice::without_mailbox).collect(),
            places: self.bus.places(),
            mailboxes: self.mailboxes.clone(),
            bus_status: Arc::clone(&self.bus_status),
            progress: self.progress.clone(),
            searches: vec![Search::default(); self.bus.devices.len()].into(),
            delays: self.delays(Arc::clone(&latch)),
            latch,
        };
        async move {
            tokio::select! {
                biased;
                () = end.closed() => {}
                never = task.run() => match never {},
            }
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
    /// It had no power, and has not been in Op since.
    restarted: bool,
}

struct ReturnTask {
    wire: DatagramClient,
    machine: Arc<Machine>,
    image: ImagePlan,
    devices: IndexVec<DeviceIndex, BusDevice>,
    places: IndexVec<DeviceIndex, DevicePlace>,
    mailboxes: Mailboxes,
    bus_status: Arc<BusStatus>,
    progress: std::sync::mpsc::Sender<Progress>,
    searches: IndexVec<DeviceIndex, Search>,
    delays: Delays,
    latch: Arc<Mutex<()>>,
}

impl ReturnTask {
    async fn run(mut self) -> Infallible {
        loop {
            clock::delay(PERIOD).await;
            let lost = self.lost();
            for (device, search) in self.searches.enumerate_mut() {
                if !lost.contains(&device) {
                    *search = Search {
                        restarted: search.restarted,
                        ..Search::default()
                    };
                } else if search.since.is_none() {
                    search.since = Some(clock::now());
                }
            }
            if !lost.is_empty()
                && let Err(error) = self.search(&lost).await
            {
                tracing::debug!("{error}");
            }
        }
    }

    /// Returns the lost devices in the order of the segment.
    fn lost(&self) -> Vec<DeviceIndex> {
        let mut lost: Vec<_> = self.bus_status.lost().collect();
        lost.sort_by_key(|device| self.places.get(*device).map(|place| place.position));
        lost
    }

    /// Searches all lost devices once and brings back those that are there, at the same time.
    async fn search(&mut self, lost: &[DeviceIndex]) -> Result<(), Error> {
        let mut present = Vec::new();
        let mut without_address = Vec::new();
        let due = |search: &Search| clock::now() >= search.not_before;
        let lost_now: Vec<_> = lost
            .iter()
            .copied()
            .filter(|d| due(&self.searches[*d]))
            .collect();
        for device in lost_now {
            if let Err(error) = self.check_permitted(device) {
                self.refuse(device, &error);
                continue;
            }
            let station = self.devices[device].at.station;
            let status = al::read_status(&self.wire, station).await;
            match status.map_err(failed)? {
                // The last diagnosis is older.
                Some((status, _)) if status == AlState::Op.code() => {}
                Some(_) if self.still_stops(device) => {}
                Some(_) => {
                    let at = self.devices[device].at.clone();
                    match self.check_identity(device, &at, true).await {
                        Ok(()) => present.push(device),
                        Err(error) => self.refuse(device, &error),
                    }
                }
                None => without_address.push(device),
            }
        }
        if !without_address.is_empty() {
            let found = self.find(&without_address, lost.len()).await?;
            // Some have been connected since they were asked: the next search asks them again.
            if found.iter().any(|(_, position)| position.is_none()) {
                return Ok(());
            }
            for (device, position) in found.into_iter().filter_map(|(d, at)| Some((d, at?))) {
                match self.identify(device, position).await {
                    Ok(()) => {
                        self.searches[device].restarted = true;
                        present.push(device);
                    }
                    Err(error) => self.refuse(device, &error),
                }
            }
        }
        let reference = self.bus_status.reference();
        if let (Some(reference), false) = (reference, present.is_empty()) {
            let updated = self.delays.update(reference, || true);
            if let Err(error) = updated.await {
                // The clock then settles later, or the attempt fails.
                tracing::debug!("{error}");
            }
        }
        let attempts = present.into_iter().map(|device| {
            let attempt = Box::pin(self.attempt(device));
            async move { Ok::<_, Infallible>((device, attempt.await)) }
        });
        let Ok(ended) = try_join_all(attempts).await;
        for (device, done) in ended {
            match done {
                // The next diagnosis shows it in Op.
                Ok(()) => {
                    self.searches[device] = Search {
                        not_before: clock::now() + RETRY,
                        ..Search::default()
                    };
                }
                Err(error) => self.refuse(device, &error),
            }
        }
        Ok(())
    }

    /// Returns the lost devices that are there: those without a known address by the place of a lost
    /// one, with their position, and those that have been connected since they were asked.
    async fn find(
        &self,
        lost: &[DeviceIndex],
        all_lost: usize,
    ) -> Result<Vec<(DeviceIndex, Option<u16>)>, Error> {
        let count = enumerate::count(&self.wire).await?;
        let present = self.devices.len().saturating_sub(all_lost);
        if usize::from(count) <= present {
            return Ok(Vec::new());
        }
        let words = async |register| {
            let word = async |position| {
                let bytes = enumerate::at(&self.wire, position, STEP, register).await?;
                Ok::<_, Error>(u16::from_le_bytes(bytes))
            };
            try_join_all((0..count).map(word)).await
        };
        let stations = words(registers::STATION_ADDRESS).await?;
        let status = words(registers::DL_STATUS).await?.into_iter();
        let ring = self.wire.ring();
        let status = (0..)
            .zip(status)
            .map(|(at, status)| in_line(at, status, ring));
        let mut identified: Vec<Option<DeviceIndex>> = Vec::new();
        let mut found = Vec::new();
        for ((position, station), parent) in (0..).zip(stations).zip(parents(status)) {
            let known = self
                .devices
                .enumerate()
                .find(|(_, d)| d.at.station == station);
            let parent = parent.map(|parent| {
                let device = identified
                    .get(usize::from(parent.device))
                    .copied()
                    .flatten();
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
            identified.push(device);
            if let Some(device) = device.filter(|device| lost.contains(device)) {
                found.push((device, known.is_none().then_some(position)));
            }
        }
        Ok(found)
    }

    /// Gives a device its station address if its identity is that of the machine file.
    async fn identify(&mut self, index: DeviceIndex, position: u16) -> Result<(), Error> {
        let device = &self.devices[index];
        let own = device.at.station;
        let temporary = DeviceRef {
            position,
            station: TEMPORARY_STATION,
            ..device.at.clone()
        };
        // A device that kept this address from an earlier attempt must not answer as well.
        self.clear_temporary().await?;
        self.check_is_new(position).await?;
        let address = TEMPORARY_STATION.to_le_bytes();
        let register = registers::STATION_ADDRESS;
        let written = self.wire.write_at(position, register, &address).await;
        if written.map_err(failed)? != 1 {
            return Err(gone(&temporary));
        }
        let checked = self.check_identity(index, &temporary, false).await;
        if checked.is_err() {
            self.clear_temporary().await?;
            return checked;
        }
        let written = self
            .wire
            .write(TEMPORARY_STATION, register, &own.to_le_bytes())
            .await;
        match written.map_err(failed)? {
            1 => Ok(()),
            _ => {
                let _ = self.wire.write(own, register, &[0, 0]).await;
                Err(gone(&temporary))
            }
        }
    }

    /// Fails unless the device at a position is in Init and has no address of the machine: devices may
    /// have come since the search, and positions then name others.
    async fn check_is_new(&self, position: u16) -> Result<(), Error> {
        let found = enumerate::read_device(&self.wire, position).await?;
        let known = self
            .devices
            .iter()
            .any(|device| device.at.station == found.station);
        if known || found.state != AlState::Init {
            return Err(gone(&found.named(format!("device {position}"))));
        }
        Ok(())
    }

    /// Takes the temporary address from whichever device has it.
    async fn clear_temporary(&self) -> Result<(), Error> {
        let register = registers::STATION_ADDRESS;
        let written = self.wire.write(TEMPORARY_STATION, register, &[0, 0]).await;
        written.map_err(failed).map(drop)
    }

    /// Fails for devices that must not return by themselves. Nothing is written to them.
    fn check_permitted(&self, index: DeviceIndex) -> Result<(), Error> {
        let machine = &self.machine;
        let why = if machine.outputs.iter().any(|signal| signal.device == index) {
            "its outputs would be switched on without a command; restart the bus"
        } else if machine.devices[index].selection.dc.is_some()
            && self.running_sync(index).is_none()
        {
            "no other device in Op has SYNC0, whose pulses it could join; restart the bus"
        } else {
            return Ok(());
        };
        Err(Cause::Scan(why.to_owned()).with_device(&self.devices[index].at))
    }

    /// Returns true while a drive that kept its power may still stop by its own reaction.
    fn still_stops(&self, index: DeviceIndex) -> bool {
        let times = self.machine.axes_of(index).map(|(_, setup)| {
            let config = &setup.config;
            config.stop_time_s(config.mode, config.limits.velocity)
        });
        // At most an hour; the cast saturates.
        let longest = (times.fold(0.0, f64::max) * 1e9) as Nanos;
        let since = self.searches[index].since.unwrap_or_else(clock::now);
        clock::now() < since.saturating_add(longest)
    }

    /// Compares the EEPROM of a device with the machine file. `kept`: it answers at the address of the
    /// lost device, and must be that device.
    async fn check_identity(
        &mut self,
        index: DeviceIndex,
        at: &DeviceRef,
        kept: bool,
    ) -> Result<(), Error> {
        let config = &self.machine.devices[index];
        let device = &mut self.devices[index];
        // The station alias is word 4; vendor, product, revision and serial number begin at word 8.
        let mut words = [0; 24];
        let access = EepromAccess::Force;
        with_eeprom(&self.wire, at, STEP, access, async |eeprom| {
            eeprom.read(4, &mut words).await
        })
        .await?;
        let word =
            |at: usize| u32::from_le_bytes(*words[2 * at - 8..].first_chunk().unwrap_or(&[0; 4]));
        let identity = Identity {
            vendor: word(8),
            product: word(10),
            revision: word(12),
        };
        let (serial, alias) = (word(14), u16::from_le_bytes([words[0], words[1]]));
        compare_identity(&self.machine, config, (identity, serial), at)?;
        if kept && serial != device.serial {
            let (expected, found) = (device.serial, serial);
            return Err(Cause::Serial { expected, found }.with_device(at));
        }
        let located = match config.at {
            Locator::Position(_) => true,
            Locator::Id(_) if kept => true,
            Locator::Alias(wanted) => alias == wanted,
            Locator::Id(id) => {
                let timeout = al::IDENTIFICATION_TIMEOUT;
                al::read_explicit_id(&self.wire, at.station, timeout).await == Ok(Some(id))
            }
        };
        if !located {
            let locator = config.at.to_string();
            return Err(Cause::NotLocated { locator }.with_device(at));
        }
        if serial != device.serial && config.serial.is_none() {
            let warning = format!(
                "{}: the device has the serial number {}, before it was {}: it is another one of the same kind. \
                 Parameters and home are its own",
                device.at, serial, device.serial
            );
            device.serial = serial;
            let _ = self.progress.send(Progress::Warning(warning));
        }
        Ok(())
    }

    /// Brings a device back that answers at its station address.
    async fn attempt(&self, index: DeviceIndex) -> Result<(), Error> {
        let done = self.bring_to_op(index).await;
        if done.is_err() {
            self.leave_in_init(index).await;
            return done;
        }
        let since = self.searches[index].since.unwrap_or_else(clock::now);
        let _ = self.progress.send(Progress::DeviceReturned {
            device: self.devices[index].at.clone(),
            after_ns: clock::now().saturating_sub(since),
            restarted: self.searches[index].restarted,
        });
        Ok(())
    }

    async fn bring_to_op(&self, index: DeviceIndex) -> Result<(), Error> {
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
        let bus = RunningBus {
            wire: &self.wire,
            machine: &self.machine,
            image: &self.image,
            reference: reference.as_ref(),
            sync: self.running_sync(index),
            latch: &self.latch,
        };
        let returned = bring_back(bus, index, &mut device, &report).await;
        if let (Some(coe), Some(give_back)) = (device.coe.take(), give_back) {
            let _ = give_back.send(coe);
        }
        returned?;
        if self.searches[index].restarted {
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
    fn running_sync(&self, returns: DeviceIndex) -> Option<RunningSync<'_>> {
        let lost = self.lost();
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
}

fn gone(device: &DeviceRef) -> Error {
    let wanted = AlState::Init;
    StateError::Gone { wanted }.with_device(device)
}

fn failed(error: crate::mailbox::DatagramError) -> Error {
    Error::from(Cause::Datagram(error)).with_action(STEP)
}
