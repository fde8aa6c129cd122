//! Finds out which device has come.

use ecaxis_ecat::index::{DeviceIndex, IndexVec};
use ecaxis_ecat::registers;
use ecaxis_esi::Identity;

use super::{RunningSegment, STEP, Search, TEMPORARY_STATION, failed, gone};
use crate::acyclic::eeprom::{EepromAccess, with_eeprom};
use crate::acyclic::{AlState, DeviceRef, al, enumerate};
use crate::bringup::compare_identity;
use crate::config::Locator;
use crate::mailbox::MailboxTransport;
use crate::report::{Cause, Error, Progress};

/// What the EEPROM says about a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct DeviceNumbers {
    pub identity: Identity,
    pub serial: u32,
    alias: u16,
}

impl RunningSegment {
    /// Finds out which of the missing devices is at a position, and gives it its station address.
    /// Without one, the device gets no address. Then the error of the last candidate is returned as
    /// well.
    pub(super) async fn identify(
        &self,
        candidates: &[DeviceIndex],
        searches: &mut IndexVec<DeviceIndex, Search>,
        position: u16,
    ) -> Result<Result<DeviceIndex, (DeviceNumbers, Option<Error>)>, Error> {
        let temporary = DeviceRef {
            name: candidates.first().map_or_else(
                || format!("device {position}"),
                |index| self.devices[*index].at.name.clone(),
            ),
            position,
            station: TEMPORARY_STATION,
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
        let numbers = match self.read_numbers(&temporary).await {
            Ok(numbers) => numbers,
            Err(error) => {
                self.clear_temporary().await?;
                return Err(error);
            }
        };
        let mut last = None;
        for &index in candidates {
            let at = DeviceRef {
                name: self.devices[index].at.name.clone(),
                ..temporary.clone()
            };
            let search = &mut searches[index];
            match self.compare(index, search, numbers, &at, false).await {
                Ok(()) => {
                    self.give_address(index, &at).await?;
                    return Ok(Ok(index));
                }
                Err(error) => last = Some(error),
            }
        }
        self.clear_temporary().await?;
        Ok(Err((numbers, last)))
    }

    /// Gives the device with the temporary address its own.
    async fn give_address(&self, index: DeviceIndex, at: &DeviceRef) -> Result<(), Error> {
        let (own, register) = (self.devices[index].at.station, registers::STATION_ADDRESS);
        let address = own.to_le_bytes();
        let written = self.wire.write(at.station, register, &address).await;
        match written.map_err(failed)? {
            1 => Ok(()),
            _ => {
                let _ = self.wire.write(own, register, &[0, 0]).await;
                Err(gone(at))
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

    /// Reads the identity in the EEPROM of a device.
    async fn read_numbers(&self, at: &DeviceRef) -> Result<DeviceNumbers, Error> {
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
        Ok(DeviceNumbers {
            identity,
            serial: word(14),
            alias: u16::from_le_bytes([words[0], words[1]]),
        })
    }

    /// Compares a device that answers at the address of a lost one with the machine file. It must be
    /// the lost device.
    pub(super) async fn check_identity(
        &self,
        index: DeviceIndex,
        search: &mut Search,
        at: &DeviceRef,
    ) -> Result<(), Error> {
        let numbers = self.read_numbers(at).await?;
        self.compare(index, search, numbers, at, true).await
    }

    /// Compares a device with the machine file. `kept`: it must be the device that was lost.
    async fn compare(
        &self,
        index: DeviceIndex,
        search: &mut Search,
        numbers: DeviceNumbers,
        at: &DeviceRef,
        kept: bool,
    ) -> Result<(), Error> {
        let DeviceNumbers {
            identity,
            serial,
            alias,
        } = numbers;
        let config = &self.machine.devices[index];
        compare_identity(&self.machine, config, (identity, serial), at)?;
        // The place of a drive is known by its neighbours only: after an exchange of plugs it is another
        // drive of the machine.
        let exchanged = self.devices.enumerate().any(|(other, device)| {
            other != index && serial != 0 && serial != search.serial && device.serial == serial
        });
        if (kept || exchanged) && serial != search.serial {
            let (expected, found) = (search.serial, serial);
            return Err(Cause::Serial { expected, found }.with_device(at));
        }
        let located = match config.at {
            Locator::Position(_) | Locator::Behind(..) => true,
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
        // An optional device that was absent has no serial number yet.
        if serial != search.serial && config.serial.is_none() && search.place.is_some() {
            let warning = format!(
                "{}: the device has the serial number {serial}, before it was {}: it is another one of the same \
                 kind. Home is lost; {}",
                self.devices[index].at,
                search.serial,
                match config.parameters {
                    Some(_) => "its parameters are compared with the parameter file",
                    None => "its parameters are its own (`parameters` restores those of a file)",
                }
            );
            let _ = self.progress.send(Progress::Warning(warning));
        }
        search.replaced |= serial != search.serial && search.place.is_some();
        search.serial = serial;
        Ok(())
    }
}
