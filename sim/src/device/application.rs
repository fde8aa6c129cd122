//! The application behind the controller: a drive, a gateway, or inputs and outputs. An application
//! works on the objects of the device. The device decides which objects travel as process data.

use ecaxis_esi::model::{Device, Direction};

use super::build::Objects;
use super::process::ProcessData;
use super::{SimDevice, SimError};
use crate::Nanos;
use crate::coe::object_dictionary::{EntryHandle, ObjectStore};
use crate::coe::pdo::Mapped;
use crate::drive::{CONTROL_PERIOD_NS, DeviceError, Drive, PlantParams};
use crate::gateway::{self, Gateway, GatewayOptions};

#[derive(Debug, Clone)]
pub(super) enum Application {
    /// The axes of a drive, at least one.
    Drives(Box<[Drive]>),
    Gateway(Box<Gateway>),
    Io(Io),
}

/// Digital and analogue inputs and outputs.
#[derive(Debug, Clone, Default)]
pub(super) struct Io {
    mirrors: Vec<Mirror>,
    /// Inputs with a value from [`SimDevice::set_input`].
    held: Vec<EntryHandle>,
}

/// An input that copies an output, because no process connects the outputs of an I/O device to its
/// inputs.
#[derive(Debug, Clone, Copy)]
struct Mirror {
    from: EntryHandle,
    to: EntryHandle,
}

impl Application {
    /// Returns the gateway if the device is one.
    pub(super) fn gateway(
        device: &Device,
        serial: u32,
        options: Option<GatewayOptions>,
    ) -> Result<Option<Gateway>, SimError> {
        if !gateway::is_gateway(device) {
            return match options {
                Some(_) => Err(SimError::NoGateway(device.type_name.clone())),
                None => Ok(None),
            };
        }
        Ok(Some(Gateway::new(
            device,
            serial,
            options.unwrap_or_default(),
        )?))
    }

    pub(super) fn new_drives(store: &mut ObjectStore, plants: &[PlantParams]) -> Self {
        Self::Drives(Drive::of_axes(store, plants))
    }

    /// Returns the period of the application in ns; `None` if it only reacts to frames.
    pub(super) fn period(&self) -> Option<Nanos> {
        match self {
            Self::Drives(_) => Some(CONTROL_PERIOD_NS),
            Self::Gateway(_) => Some(gateway::FORWARD_NS),
            Self::Io(_) => None,
        }
    }

    /// True if the application samples inputs when a frame begins, regardless of arriving outputs.
    pub(super) fn samples_at_frames(&self) -> bool {
        matches!(self, Self::Io(_))
    }

    pub(super) fn samples_when_acting(&self) -> bool {
        matches!(self, Self::Gateway(_))
    }

    /// Applies a new layout of the process data.
    pub(super) fn laid_out(&mut self, process: &[ProcessData]) {
        match self {
            Self::Drives(drives) => {
                let mapped: Vec<EntryHandle> = of(process, Direction::Rx).map(|m| m.slot).collect();
                drives
                    .iter_mut()
                    .for_each(|drive| drive.set_mapped(&mapped));
            }
            Self::Gateway(_) => {}
            Self::Io(io) => {
                io.mirrors = of(process, Direction::Rx)
                    .zip(of(process, Direction::Tx))
                    .filter(|(_, to)| !io.held.contains(&to.slot))
                    .map(|(from, to)| Mirror {
                        from: from.slot,
                        to: to.slot,
                    })
                    .collect();
            }
        }
    }

    /// Processes outputs after their transfer into the objects.
    pub(super) fn sync(&mut self, store: &mut ObjectStore) {
        match self {
            Self::Drives(drives) => drives.iter_mut().for_each(|drive| drive.sync(store)),
            // The gateway fetches its outputs when it forwards.
            Self::Gateway(_) => {}
            Self::Io(io) => io.mirror(store),
        }
    }

    /// Ends the period of the application; the motor of the first drive has turned. `now` returns the true
    /// time and is called only when needed.
    pub(super) fn act(
        &mut self,
        store: &mut ObjectStore,
        in_op: bool,
        now: impl FnOnce() -> Nanos,
    ) {
        match self {
            Self::Drives(drives) => {
                drives.iter_mut().skip(1).for_each(Drive::turn_alone);
                for drive in drives {
                    drive.end_control(store, in_op);
                }
            }
            Self::Gateway(gateway) => gateway.forward(store, in_op, now()),
            Self::Io(_) => {}
        }
    }

    /// Reacts to the end of commanded outputs. Digital and analogue outputs go to zero, their safe
    /// state. Drives react by themselves; a gateway keeps its outputs. Returns false if nothing
    /// changed.
    pub(super) fn rest(&mut self, store: &mut ObjectStore, process: &[ProcessData]) -> bool {
        let Self::Io(io) = self else { return false };
        for mapped in of(process, Direction::Rx) {
            store.bytes_mut(mapped.slot).fill(0);
        }
        io.mirror(store);
        true
    }

    /// Reports an error of the communication side to the application.
    pub(super) fn error(&mut self, error: DeviceError) {
        for drive in self.drives_mut() {
            drive.error(error);
        }
    }

    /// Returns the drives; none for an application of another kind.
    pub(super) fn drives(&self) -> &[Drive] {
        match self {
            Self::Drives(drives) => drives,
            _ => &[],
        }
    }

    pub(super) fn drives_mut(&mut self) -> &mut [Drive] {
        match self {
            Self::Drives(drives) => drives,
            _ => &mut [],
        }
    }

    /// Fixes an input, which no longer follows an output.
    pub(super) fn hold(&mut self, slot: EntryHandle) {
        if let Self::Io(io) = self {
            io.mirrors.retain(|mirror| mirror.to != slot);
            if !io.held.contains(&slot) {
                io.held.push(slot);
            }
        }
    }
}

impl Io {
    fn mirror(&self, store: &mut ObjectStore) {
        for mirror in &self.mirrors {
            let value = store.get(mirror.from);
            store.set(mirror.to, value);
        }
    }
}

fn of(process: &[ProcessData], direction: Direction) -> impl Iterator<Item = &Mapped> {
    process
        .iter()
        .filter(move |data| data.direction == direction)
        .flat_map(|data| &data.map)
}

impl SimDevice {
    /// Returns the drive, or the first axis of it; `None` for a device of another kind.
    #[must_use]
    pub fn drive(&self) -> Option<&Drive> {
        self.axes().first()
    }

    /// Returns the axes of a drive; none for a device of another kind.
    #[must_use]
    pub fn axes(&self) -> &[Drive] {
        self.application.drives()
    }

    /// Returns the drive to change it; `None` for a device of another kind.
    pub fn drive_mut(&mut self) -> Option<&mut Drive> {
        self.axes_mut().first_mut()
    }

    /// Returns the axes of a drive to change them; none for a device of another kind.
    pub fn axes_mut(&mut self) -> &mut [Drive] {
        self.show();
        self.application.drives_mut()
    }

    /// Returns the CANopen gateway; `None` for a device of another kind.
    #[must_use]
    pub fn gateway(&self) -> Option<&Gateway> {
        match &self.application {
            Application::Gateway(gateway) => Some(gateway),
            _ => None,
        }
    }

    /// Returns the CANopen gateway to change it; `None` for a device of another kind.
    pub fn gateway_mut(&mut self) -> Option<&mut Gateway> {
        match &mut self.application {
            Application::Gateway(gateway) => Some(gateway),
            _ => None,
        }
    }

    /// Updates the objects with the state of the drive.
    pub(super) fn show(&mut self) {
        for drive in self.application.drives_mut() {
            drive.show(&mut self.store);
        }
        if let Some(sercos) = &self.sercos {
            sercos.show(&mut self.store, self.application.drives());
        }
    }

    /// Resets the application as at power-on.
    pub(super) fn restart_application(&mut self, now: Nanos) {
        self.store = self.fresh.store.clone();
        self.pdo.power_on();
        self.sercos = self.fresh.sercos.clone();
        let Application::Gateway(gateway) = &mut self.application else {
            let before = std::mem::replace(&mut self.application, self.fresh.application.clone());
            let drives = self.application.drives_mut().iter_mut();
            for (drive, before) in drives.zip(before.drives()) {
                drive.keep_position(before, &mut self.store);
            }
            return;
        };
        // The configuration of the other network and its nodes survives a power cycle.
        if gateway.power_on(now) {
            let mut objects = Objects::new(&gateway.shaped(), &[], self.serial, |store| {
                gateway.prepare(store);
            });
            gateway.bind(&objects.store);
            self.startup.prepare(&mut objects.store, &objects.pdo);
            objects.store.keep_defaults();
            self.fresh.store = objects.store.clone();
            (self.store, self.pdo, self.process) = (objects.store, objects.pdo, objects.process);
        }
    }
}
