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
use tokio::sync::{Mutex, oneshot};

use super::Supervisor;
use super::clock_tree::Delays;
use crate::acyclic::{AlState, DeviceRef, StateError, al};
use crate::bringup::BusDevice;
use crate::clock::{self, Nanos};
use crate::concurrent::Background;
use crate::config::Machine;
use crate::datagram::DatagramClient;
use crate::mailbox::Mailboxes;
use crate::report::{Cause, DeviceLog, DevicePlace, Error, Progress};
use crate::rt::exchange::BusStatus;
use crate::rt::image::ImagePlan;

use unknown::UnknownDevices;

mod attempt;
mod identify;
mod survey;
mod unknown;

const STEP: &str = "looking for devices that return";
/// The pause between two searches.
const PERIOD: Duration = Duration::from_millis(50);
/// The pause after a device has refused to return.
const RETRY: Nanos = 1_000_000_000;
/// The time in ns after which a device returns even though the delays cannot be measured, because the
/// ports of the segment still change.
const MAX_BOUNCE: Nanos = 1_000_000_000;
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
        let places = self.bus.places();
        let searches = devices.clone().zip(&places).map(|(device, place)| Search {
            serial: device.serial,
            place: device.present.then_some(*place),
            absent: !device.present,
            ..Search::default()
        });
        let searches = searches.collect();
        let segment = RunningSegment {
            wire: self.wire,
            machine: Arc::clone(&self.machine),
            image: self.bus.image.clone(),
            devices: devices.map(BusDevice::without_mailbox).collect(),
            mailboxes: self.mailboxes.clone(),
            bus_status: Arc::clone(&self.bus_status),
            progress: self.progress.clone(),
            log: self.device_log.clone(),
            delays: self.delays(Arc::clone(&latch)),
            latch,
        };
        let mut task = ReturnTask {
            segment,
            searches,
            unknown: UnknownDevices::default(),
        };
        async move {
            tokio::select! {
                biased;
                () = end.closed() => {}
                never = task.run() => match never {},
            }
            task.unknown.open_ports(&task.segment).await;
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
    /// An attempt to bring it back runs.
    attempted: bool,
    /// The serial number of the device that was there last.
    serial: u32,
    /// The device has another serial number than the one that was lost.
    replaced: bool,
    /// It is optional and was absent until now.
    absent: bool,
    /// Where it was last.
    place: Option<DevicePlace>,
}

/// The segment during the run.
struct RunningSegment {
    wire: DatagramClient,
    machine: Arc<Machine>,
    image: ImagePlan,
    devices: IndexVec<DeviceIndex, BusDevice>,
    mailboxes: Mailboxes,
    bus_status: Arc<BusStatus>,
    progress: std::sync::mpsc::Sender<Progress>,
    log: DeviceLog,
    delays: Delays,
    latch: Arc<Mutex<()>>,
}

struct ReturnTask {
    segment: RunningSegment,
    searches: IndexVec<DeviceIndex, Search>,
    unknown: UnknownDevices,
}

impl ReturnTask {
    /// Searches on while devices are brought back: a slow one delays no other.
    async fn run(&mut self) -> Infallible {
        let Self {
            segment,
            searches,
            unknown,
        } = self;
        let segment = &*segment;
        let mut attempts = Background::new();
        loop {
            let search = async {
                clock::delay(PERIOD).await;
                segment.search(searches, unknown).await
            };
            let (found, ended) = attempts.run_during(search).await;
            for (device, done) in ended {
                segment.end_attempt(device, &mut searches[device], done);
            }
            let found = found.unwrap_or_else(|error| {
                tracing::debug!("{error}");
                Vec::new()
            });
            for device in found {
                let search = &mut searches[device];
                search.attempted = true;
                attempts.add(segment.attempt(device, search.clone()));
            }
        }
    }
}

impl RunningSegment {
    /// Searches the lost devices once. Returns those that are there and may return.
    async fn search(
        &self,
        searches: &mut IndexVec<DeviceIndex, Search>,
        unknown: &mut UnknownDevices,
    ) -> Result<Vec<DeviceIndex>, Error> {
        let lost = self.lost(searches);
        for (device, search) in searches.enumerate_mut() {
            if !lost.contains(&device) && !search.attempted {
                // It was cut off for a moment and has stayed in Op.
                if search.since.is_some() && search.place.is_some() {
                    self.report_return(device, search);
                }
                *search = Search {
                    restarted: search.restarted,
                    replaced: search.replaced,
                    serial: search.serial,
                    place: search.place,
                    absent: search.absent,
                    ..Search::default()
                };
            } else if search.since.is_none() && clock::now() >= search.not_before {
                search.since = Some(clock::now());
                if let Some(place) = search.place {
                    self.report(Progress::DeviceLost {
                        device: self.devices[device].at.clone(),
                        parent: self.name_port(place.parent),
                    });
                }
            }
        }
        let mut present = Vec::new();
        let mut without_address = Vec::new();
        let due = |search: &Search| !search.attempted && clock::now() >= search.not_before;
        for &device in &lost {
            let search = &mut searches[device];
            if !due(search) {
                continue;
            }
            if let Err(error) = self.check_permitted(device, &lost) {
                self.refuse(device, search, &error);
                continue;
            }
            let station = self.devices[device].at.station;
            let status = al::read_status(&self.wire, station).await;
            match status.map_err(failed)? {
                // The last diagnosis is older.
                Some((status, _)) if status == AlState::Op.code() => {}
                Some(_) if self.still_stops(device, search) => {}
                Some(_) => {
                    let at = self.devices[device].at.clone();
                    match self.check_identity(device, search, &at).await {
                        Ok(()) => present.push(device),
                        Err(error) => self.refuse(device, search, &error),
                    }
                }
                None => without_address.push(device),
            }
        }
        unknown.reopen_ports(self, &lost).await?;
        if !without_address.is_empty() || unknown.look_again(self, &lost) {
            let found = self
                .survey((&without_address, &lost), searches, unknown)
                .await?;
            present.extend(found);
        }
        if !present.is_empty() && !self.update_delays().await {
            // The next search finds them again.
            let bounces = |search: &Search| {
                let since = search.since.unwrap_or_else(clock::now);
                clock::now() < since.saturating_add(MAX_BOUNCE)
            };
            present.retain(|device| !bounces(&searches[*device]));
        }
        Ok(present)
    }

    fn report(&self, progress: Progress) {
        self.log.add(clock::now(), &progress);
        let _ = self.progress.send(progress);
    }

    /// Returns the name of the device with a port.
    fn name_port(&self, place: Option<(DeviceIndex, u8)>) -> Option<(String, u8)> {
        let (device, port) = place?;
        Some((self.devices.get(device)?.at.name.clone(), port))
    }

    /// Measures the propagation delays. Returns false if the topology changed meanwhile.
    async fn update_delays(&self) -> bool {
        let Some(reference) = self.bus_status.reference() else {
            return true;
        };
        let updated = self.delays.update(reference, || true).await;
        updated.unwrap_or_else(|error| {
            tracing::debug!("{error}");
            false
        })
    }

    fn end_attempt(&self, device: DeviceIndex, search: &mut Search, done: Result<(), Error>) {
        search.attempted = false;
        match done {
            // The next diagnosis shows it in Op.
            Ok(()) => {
                *search = Search {
                    not_before: clock::now() + RETRY,
                    serial: search.serial,
                    place: search.place,
                    ..Search::default()
                };
            }
            Err(error) => self.refuse(device, search, &error),
        }
    }

    /// Returns the lost devices in the order of the segment.
    fn lost(&self, searches: &IndexVec<DeviceIndex, Search>) -> Vec<DeviceIndex> {
        let mut lost: Vec<_> = self.bus_status.lost().collect();
        lost.sort_by_key(|device| searches[*device].place.map(|place| place.position));
        lost
    }

    /// Fails for devices that must not return by themselves. Nothing is written to them.
    fn check_permitted(&self, index: DeviceIndex, lost: &[DeviceIndex]) -> Result<(), Error> {
        let machine = &self.machine;
        let clocked = machine.devices[index].selection.dc.is_some();
        if !clocked || self.running_sync(index, lost).is_some() {
            return Ok(());
        }
        let why = "no other device in Op has SYNC0, whose pulses it could join; restart the bus";
        Err(Cause::Scan(why.to_owned()).with_device(&self.devices[index].at))
    }

    /// Returns true while a drive that kept its power may still stop by its own reaction.
    fn still_stops(&self, index: DeviceIndex, search: &Search) -> bool {
        let times = self.machine.axes_of(index).map(|(_, setup)| {
            let config = &setup.config;
            config.stop_time_s(config.mode, config.limits.velocity)
        });
        // At most an hour; the cast saturates.
        let longest = (times.fold(0.0, f64::max) * 1e9) as Nanos;
        let since = search.since.unwrap_or_else(clock::now);
        clock::now() < since.saturating_add(longest)
    }

    /// Reports why a device does not return, once.
    fn refuse(&self, index: DeviceIndex, search: &mut Search, error: &Error) {
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
