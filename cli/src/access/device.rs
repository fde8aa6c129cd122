//! Device selection: by name in a machine file, or by position, alias or identification on an
//! interface.

use std::path::PathBuf;

use ecaxis_ecat::index::DeviceIndex;
use ecaxis_esi::sii::Sii;
use ecaxis_esi::{DeviceHeader, Dictionary, Identity, SelectOptions, select};
use ecaxis_master::acyclic::eeprom::EepromAccess;
use ecaxis_master::acyclic::enumerate::EnumeratedDevice;
use ecaxis_master::acyclic::parameters::dictionary;
use ecaxis_master::acyclic::{AlState, DeviceRef};
use ecaxis_master::acyclic::{DatagramClient, device};
use ecaxis_master::config::{self, DeviceConfig, Locator, Machine, Nic, nearest};
use ecaxis_master::esi_library::{self, Library, RevisionMatch, cache_file};
use ecaxis_master::mailbox::{CoeClient, NamedObject, SdoError};
use ecaxis_master::parameters::dump::Origin;
use ecaxis_master::report::{Cause, Error};

use crate::access::bus::{self, Bus};
use crate::args::nic::NicArg;
use crate::args::numbers::number_16;
use crate::hints::{self, Failure};
use crate::render::note;

/// Options that select one device
#[derive(Debug, Clone, clap::Args)]
#[command(next_help_heading = "Which device")]
pub(crate) struct DeviceArgs {
    /// Use this network interface instead of the machine file's, or without a machine file;
    /// `IF,IF`: both ends of a ring
    #[arg(long, value_name = "IF", conflicts_with = "sim")]
    nic: Option<NicArg>,
    /// Use the machine file's simulated bus
    #[arg(long)]
    sim: bool,
    /// Position of the device on the interface, counted from 0
    #[arg(long, value_name = "N", requires = "nic", conflicts_with_all = ["alias", "id"])]
    position: Option<u16>,
    /// Station alias of the device
    #[arg(long, value_name = "A", requires = "nic", conflicts_with = "id", value_parser = number_16)]
    alias: Option<u16>,
    /// Explicit device identification of the device, such as its ID switch
    #[arg(long, value_name = "ID", requires = "nic", value_parser = number_16)]
    id: Option<u16>,
}

/// The device selected on the command line.
#[derive(Debug)]
pub(crate) struct Target {
    pub bus: Bus,
    pub at: Locator,
    /// The machine file, if it selects the device.
    pub machine: Option<Box<Machine>>,
    /// The device's section of the machine file.
    pub config: Option<Box<DeviceConfig>>,
    /// ESI file or folder of the device, without a machine file.
    pub esi: Option<PathBuf>,
}

impl DeviceArgs {
    /// Returns the device and the remaining words. Without `--position`, `--alias` or `--id`, the
    /// first two words are machine file and the name or position of the device. `rest` describes the words after them.
    pub fn take<'w>(
        &self,
        words: &'w [String],
        rest: &str,
    ) -> Result<(Target, &'w [String]), Failure> {
        let position = self.position.map(Locator::Position);
        let alias = self.alias.map(Locator::Alias);
        let at = position.or(alias).or(self.id.map(Locator::Id));
        if let (Some(nic), Some(at)) = (&self.nic, at) {
            if nic.is_sim() {
                let message = "the simulated bus is a machine file's: `FILE DEVICE --sim`";
                return Err(Failure::new(hints::WRONG, message));
            }
            let target = Target {
                bus: Bus::interface(nic),
                at,
                machine: None,
                config: None,
                esi: None,
            };
            return Ok((target, words));
        }
        let [file, name, rest @ ..] = words else {
            let message = format!("which device? A machine file and a name in it, then {rest}");
            return Err(Failure::new(hints::WRONG, message).hint(
                "without a machine file: `--nic IF` with `--position N`, `--alias A` or `--id ID`; `ecaxis scan` shows them",
            ));
        };
        let file = PathBuf::from(file);
        let mut machine = config::load(&file).map_err(|error| hints::config(&file, &error))?;
        if self.sim {
            machine.bus.nic = Nic::Sim;
        } else if let Some(nic) = &self.nic {
            nic.replace(&mut machine.bus);
        }
        let device = selected(&machine, name)?;
        Ok((Target::of_device(machine, device), rest))
    }
}

/// Fails if words remain.
pub(crate) fn no_more(rest: &[String]) -> Result<(), Failure> {
    match rest.first() {
        None => Ok(()),
        Some(word) => {
            let message = format!("`{word}` is one word too many");
            Err(Failure::new(hints::WRONG, message))
        }
    }
}

/// Returns the device of a machine with this name, else the one at this position.
pub(crate) fn named<'m>(machine: &'m Machine, name: &str) -> Result<&'m DeviceConfig, Failure> {
    selected(machine, name).map(|index| &machine.devices[index])
}

/// Returns the index of the device with this name, else of the one at this position.
pub(crate) fn selected(machine: &Machine, name: &str) -> Result<DeviceIndex, Failure> {
    let all = || machine.devices.enumerate();
    let at = name.parse().ok().map(Locator::Position);
    let found = all().find(|(_, device)| device.name == name);
    let found = found.or_else(|| all().find(|(_, device)| Some(device.at) == at));
    found.map(|(index, _)| index).ok_or_else(|| {
        let names = machine.devices.iter().map(|device| device.name.as_str());
        let message = format!("{}: no device is called `{name}`", machine.path.display());
        let all: Vec<&str> = names.clone().collect();
        Failure::new(hints::WRONG, message).hint(match nearest(name, names) {
            Some(known) => format!("did you mean `{known}`?"),
            None => format!("there are {}", all.join(", ")),
        })
    })
}

/// A device found on the bus.
#[derive(Debug)]
pub(crate) struct OpenDevice {
    pub wire: DatagramClient,
    pub device: DeviceRef,
    /// The AL state in which it was found.
    pub state: AlState,
    /// Name and identity from the ESI that the machine file names.
    pub expected: Option<(String, Identity)>,
    config: Option<Box<DeviceConfig>>,
    esi: Option<PathBuf>,
    nic: Nic,
    /// True if another MainDevice is active on the bus.
    others: bool,
    found: EnumeratedDevice,
}

impl Target {
    /// Returns a device of a machine.
    pub fn of_device(machine: Machine, device: DeviceIndex) -> Self {
        let config = machine.devices[device].clone();
        Self {
            bus: Bus::of(&machine),
            at: config.at,
            machine: Some(Box::new(machine)),
            config: Some(Box::new(config)),
            esi: None,
        }
    }

    /// Runs `work` on the device in its current state.
    pub fn visit<T: Send + 'static>(
        self,
        work: impl AsyncFnOnce(&OpenDevice) -> Result<T, Failure> + Send + 'static,
    ) -> Result<T, Failure> {
        let Self {
            bus,
            at,
            config,
            esi,
            ..
        } = self;
        let nic = bus.nic();
        let done = bus.visit(async move |wire: DatagramClient, others| {
            bus::warn_foreign_frames(others);
            let located = OpenDevice::find(wire, at, config, nic).await?;
            let others = others > 0;
            work(&OpenDevice {
                esi,
                others,
                ..located
            })
            .await
        });
        done?
    }

    /// Runs `work` on the device's mailbox. `step` names the work in errors. A device in Init is in
    /// PreOp during the work.
    pub fn open<T: Send + 'static>(
        self,
        step: &'static str,
        work: impl AsyncFnOnce(&mut Open<'_>) -> Result<T, Failure> + Send + 'static,
    ) -> Result<T, Failure> {
        self.visit(async move |located: &OpenDevice| {
            let at = located;
            let access = EepromAccess::of(at.state);
            let sii = device::read_sii_unless_in_use(&at.wire, &at.found, &at.device, access).await;
            let sii = at.map_error(sii)?.unwrap_or_default();
            at.check(sii.identity)?;
            let done = device::with_mailbox(&at.wire, &at.device, &sii, step, async |lent| {
                let mut open = Open {
                    at,
                    sii: &sii,
                    coe: &mut lent.coe,
                };
                Ok(work(&mut open).await?)
            });
            at.ended(done.await)
        })
    }
}

/// The errors that end the work.
#[derive(Debug)]
pub(crate) enum DeviceError {
    Reported(Failure),
    Service(Error),
}

impl From<Error> for DeviceError {
    fn from(error: Error) -> Self {
        Self::Service(error)
    }
}

impl From<Failure> for DeviceError {
    fn from(failure: Failure) -> Self {
        Self::Reported(failure)
    }
}

impl OpenDevice {
    /// Finds the device, without an ESI file from the command line.
    pub async fn find(
        wire: DatagramClient,
        at: Locator,
        config: Option<Box<DeviceConfig>>,
        nic: Nic,
    ) -> Result<Self, Failure> {
        let name = config.as_ref().map(|config| config.name.as_str());
        let located = device::locate(&wire, at, name).await;
        let (found, device) = located.map_err(|error| hints::failure(&error, &nic))?;
        Ok(Self {
            wire,
            device,
            state: found.state,
            expected: config.as_ref().map(|config| {
                let selection = &config.selection;
                (selection.device_name.to_string(), selection.identity)
            }),
            config,
            esi: None,
            nic,
            others: false,
            found,
        })
    }

    /// Fails if the device is driven. `what` describes the change of its parameters.
    pub fn at_rest(&self, what: &str) -> Result<(), Failure> {
        if matches!(self.state, AlState::Init | AlState::PreOp) {
            return Ok(());
        }
        let message = format!("{}: is in {}: {what} in PreOp", self.device, self.state);
        Err(Failure::new(hints::FAILED, message)
            .hint("end what drives the device first; then it is in Init or PreOp"))
    }

    /// Maps an error of another type to a failure with hints.
    pub fn advised<E>(&self, error: &E, advice: impl FnOnce(&E, &Nic) -> Failure) -> Failure {
        advice(error, &self.nic)
    }

    pub fn ended<T>(&self, result: Result<T, DeviceError>) -> Result<T, Failure> {
        result.map_err(|trouble| match trouble {
            DeviceError::Reported(failure) => failure,
            DeviceError::Service(error) => self.failure(&error),
        })
    }

    /// Maps a service error to a failure with hints.
    pub fn map_error<T>(&self, result: Result<T, Error>) -> Result<T, Failure> {
        result.map_err(|error| self.failure(&error))
    }

    /// Maps an SDO error of this device to a failure with hints.
    pub fn sdo_error<T>(&self, result: Result<T, SdoError>) -> Result<T, Failure> {
        result.map_err(|error| self.failure(&Cause::Sdo(error).with_device(&self.device)))
    }

    fn failure(&self, error: &Error) -> Failure {
        let failure = hints::failure(error, &self.nic);
        if self.others {
            return hints::with_other_main_device(failure, error);
        }
        failure
    }

    /// Fails if the identity differs from the machine file. A device without an identity passes.
    pub fn check(&self, actual: Identity) -> Result<(), Failure> {
        match &self.expected {
            Some((name, expected))
                if actual.vendor != 0
                    && (actual.vendor, actual.product) != (expected.vendor, expected.product) =>
            {
                let device = &self.device;
                let message = format!(
                    "{device}: the machine file says that it is {name} ({expected}), it is {actual}"
                );
                Err(Failure::new(hints::FAILED, message)
                    .hint("check the order of the devices; `ecaxis scan` lists the devices"))
            }
            _ => Ok(()),
        }
    }
}

/// The maximum number of unusable descriptions that are named.
const MAX_NAMED: usize = 3;

/// A device with open mailbox.
#[derive(Debug)]
pub(crate) struct Open<'a> {
    pub at: &'a OpenDevice,
    pub sii: &'a Sii,
    pub coe: &'a mut CoeClient,
}

impl Open<'_> {
    /// Returns the dictionary from the ESI file, else from the device. `ask`: always from the
    /// device.
    pub async fn dictionary(&mut self, ask: bool) -> Result<Dictionary, Failure> {
        match self.described(ask)? {
            Some(dictionary) => Ok(dictionary),
            None => self.own_dictionary().await,
        }
    }

    /// Returns the dictionary of the ESI file, if there is one.
    pub fn described(&self, ask: bool) -> Result<Option<Dictionary>, Failure> {
        if ask {
            return Ok(None);
        }
        if let Some(config) = &self.at.config {
            let dictionary = &config.selection.dictionary;
            return Ok((!dictionary.objects.is_empty()).then(|| dictionary.clone()));
        }
        let path = self.at.esi.as_deref();
        let described = path.map(|path| self.in_library(path)).transpose()?;
        Ok(described.filter(|dictionary| !dictionary.objects.is_empty()))
    }

    fn in_library(&self, path: &std::path::Path) -> Result<Dictionary, Failure> {
        let wrong = |error: esi_library::LoadError| Failure::new(hints::WRONG, error.to_string());
        let library = match path.is_dir() {
            true => Library::open(path, cache_file(path).as_deref()),
            false => Library::of_file(path),
        };
        let library = library.map_err(wrong)?;
        let identity = self.sii.identity;
        let entry = library
            .find(identity, RevisionMatch::Newer)
            .ok_or_else(|| {
                let message = format!("{}: describes no {identity}", path.display());
                Failure::new(hints::WRONG, message).hint(format!(
                    "`ecaxis esi list {}` shows what it describes",
                    path.display()
                ))
            })?;
        let path = library.folder().join(&entry.file);
        let is_described = |header: &DeviceHeader| {
            (header.identity.product, header.identity.revision) == (entry.product, entry.revision)
        };
        let file = esi_library::load(&path, &is_described).map_err(wrong)?;
        let wanted = Identity {
            revision: entry.revision,
            ..identity
        };
        let device = file.devices.iter().find(|device| device.identity == wanted);
        let Some(device) = device else {
            return Ok(Dictionary::default());
        };
        let choice = SelectOptions {
            cycle_ns: 1_000_000,
            ..SelectOptions::default()
        };
        // If the default configuration is invalid, use the device's own objects.
        let selected = select(&file, device, &choice).map(|selection| selection.dictionary);
        Ok(selected.unwrap_or_else(|_| device.dictionary.clone()))
    }

    async fn own_dictionary(&mut self) -> Result<Dictionary, Failure> {
        let Self { at, coe, .. } = self;
        let mut progress = counter("asking for objects");
        let learned = dictionary::dictionary(coe, &at.wire, &at.device, &mut progress).await;
        bus::passed();
        let read = at.map_error(learned)?;
        for error in read.failed.iter().take(MAX_NAMED) {
            note(&format!(
                "warning: {}: {}",
                at.device,
                error.without_station()
            ));
        }
        match read.failed.len().checked_sub(MAX_NAMED) {
            None | Some(0) => {}
            Some(more) => note(&format!("warning: {more} more descriptions are unusable")),
        }
        Ok(read.dictionary)
    }

    /// Returns the identity from the device's objects, completed from the EEPROM.
    pub async fn origin(&mut self) -> Result<Origin, Failure> {
        let sii = self.sii;
        let general = sii.general.as_ref();
        let name = general.map(|general| general.name.clone());
        let known = [
            sii.identity.vendor,
            sii.identity.product,
            sii.identity.revision,
            sii.serial,
        ];
        let mut reported = [0; 4];
        for (n, (value, known)) in (1..).zip(reported.iter_mut().zip(known)) {
            let read = self.read(0x1018, n).await?;
            let read = read.ok().and_then(|bytes| bytes.try_into().ok());
            *value = read.map_or(known, u32::from_le_bytes);
        }
        let [vendor, product, revision, serial] = reported;
        Ok(Origin {
            name: name.unwrap_or_else(|| self.at.device.name.clone()),
            vendor,
            product,
            revision,
            serial,
        })
    }

    /// Reads one subindex. Returns the abort code if the device refuses it.
    pub async fn read(&mut self, index: u16, sub: u8) -> Result<Result<Vec<u8>, u32>, Failure> {
        let read = self.coe.upload(&self.at.wire, index, sub, false).await;
        match read.map_err(|error| (error.abort_code(), error)) {
            Ok(value) => Ok(Ok(value)),
            Err((Some(code), _)) => Ok(Err(code)),
            Err((None, source)) => self.at.sdo_error(Err(source)),
        }
    }
}

/// Returns a callback that shows the progress of `what` in percent.
pub(crate) fn counter(what: &'static str) -> impl FnMut(usize, usize) {
    let mut last = usize::MAX;
    move |done, all| {
        // Update the terminal once per percent, not for every object.
        let part = done * 100 / all.max(1);
        if part != last {
            last = part;
            bus::passing(&format!("{what}: {done} of {all}"));
        }
    }
}

/// Formats an object as `0x6041:00`.
pub(crate) fn address(at: NamedObject) -> String {
    at.number().to_string()
}
