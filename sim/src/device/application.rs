//! What stands behind the controller: a drive, a gateway, or inputs and outputs. An application works on the device's
//! objects; which of them travel as process data is the device's business.

use ecaxis_esi::model::{Device, Direction};

use super::build::Objects;
use super::process::ProcessData;
use super::{SimDevice, SimError};
use crate::Nanos;
use crate::coe::pdo::Mapped;
use crate::coe::store::{ObjectStore, Slot};
use crate::drive::{CONTROL_PERIOD_NS, DeviceError, Drive, PlantParams};
use crate::gateway::{self, Gateway, GatewayOptions};

#[derive(Debug, Clone)]
pub(super) enum Application {
    Drive(Box<Drive>),
    Gateway(Box<Gateway>),
    Io(Io),
}

/// Digital and analogue inputs and outputs.
#[derive(Debug, Clone, Default)]
pub(super) struct Io {
    mirrors: Vec<Mirror>,
    /// Inputs that somebody has set.
    held: Vec<Slot>,
}

/// An input that copies an output, as I/O devices without a process behind them do here.
#[derive(Debug, Clone, Copy)]
struct Mirror {
    from: Slot,
    to: Slot,
}

impl Application {
    /// The gateway that a device is, if it is one.
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

    pub(super) fn drive(store: &mut ObjectStore, plant: PlantParams) -> Self {
        Self::Drive(Box::new(Drive::new(store, plant)))
    }

    /// How often it acts by itself.
    pub(super) fn period(&self) -> Option<Nanos> {
        match self {
            Self::Drive(_) => Some(CONTROL_PERIOD_NS),
            Self::Gateway(_) => Some(gateway::FORWARD_NS),
            Self::Io(_) => None,
        }
    }

    /// Its inputs are what they are when a frame begins, or when it has acted, whatever outputs arrive.
    pub(super) fn samples_at_frames(&self) -> bool {
        matches!(self, Self::Io(_))
    }

    pub(super) fn samples_when_acting(&self) -> bool {
        matches!(self, Self::Gateway(_))
    }

    /// The layout of process data has been made anew.
    pub(super) fn laid_out(&mut self, process: &[ProcessData]) {
        match self {
            Self::Drive(drive) => {
                let mapped: Vec<Slot> = of(process, Direction::Rx).map(|m| m.slot).collect();
                drive.set_mapped(&mapped);
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

    /// Outputs have been taken over into the objects.
    pub(super) fn sync(&mut self, store: &mut ObjectStore) {
        match self {
            Self::Drive(drive) => drive.sync(store),
            // It fetches them when it forwards.
            Self::Gateway(_) => {}
            Self::Io(io) => io.mirror(store),
        }
    }

    /// Its period is over; of a drive, the motor has turned. `now` is the true time, which not everybody wants to know.
    pub(super) fn act(
        &mut self,
        store: &mut ObjectStore,
        in_op: bool,
        now: impl FnOnce() -> Nanos,
    ) {
        match self {
            Self::Drive(drive) => drive.end_control(store, in_op),
            Self::Gateway(gateway) => gateway.forward(store, in_op, now()),
            Self::Io(_) => {}
        }
    }

    /// Nobody commands outputs any more. Digital and analogue ones go to their safe state, zero; drives react
    /// themselves, a gateway holds what it has. False if nothing changed.
    pub(super) fn rest(&mut self, store: &mut ObjectStore, process: &[ProcessData]) -> bool {
        let Self::Io(io) = self else { return false };
        for mapped in of(process, Direction::Rx) {
            store.bytes_mut(mapped.slot).fill(0);
        }
        io.mirror(store);
        true
    }

    /// The communication side found an error.
    pub(super) fn error(&mut self, error: DeviceError) {
        if let Self::Drive(drive) = self {
            drive.error(error);
        }
    }

    /// An input is set from now on, whatever the outputs are.
    pub(super) fn hold(&mut self, slot: Slot) {
        if let Self::Io(io) = self {
            io.mirrors.retain(|mirror| mirror.to != slot);
            io.held.push(slot);
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
    #[must_use]
    pub fn drive(&self) -> Option<&Drive> {
        match &self.application {
            Application::Drive(drive) => Some(drive),
            _ => None,
        }
    }

    pub fn drive_mut(&mut self) -> Option<&mut Drive> {
        self.show();
        match &mut self.application {
            Application::Drive(drive) => Some(drive),
            _ => None,
        }
    }

    #[must_use]
    pub fn gateway(&self) -> Option<&Gateway> {
        match &self.application {
            Application::Gateway(gateway) => Some(gateway),
            _ => None,
        }
    }

    pub fn gateway_mut(&mut self) -> Option<&mut Gateway> {
        match &mut self.application {
            Application::Gateway(gateway) => Some(gateway),
            _ => None,
        }
    }

    /// Shows in the objects what the drive has done.
    pub(super) fn show(&mut self) {
        if let Application::Drive(drive) = &mut self.application {
            drive.show(&mut self.store);
        }
    }

    /// As at power-on.
    pub(super) fn restart_application(&mut self, now: Nanos) {
        self.store = self.fresh.store.clone();
        let Application::Gateway(gateway) = &mut self.application else {
            self.application = self.fresh.application.clone();
            return;
        };
        // What was configured on its other network outlives the power, and so do the nodes there.
        if gateway.power_on(now) {
            let mut objects = Objects::new(&gateway.shaped(), &[], self.serial, |store| {
                gateway.prepare(store);
            });
            gateway.bind(&objects.store);
            objects.store.keep_defaults();
            self.fresh.store = objects.store.clone();
            (self.store, self.pdo, self.process) = (objects.store, objects.pdo, objects.process);
        }
    }
}
