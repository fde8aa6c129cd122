//! Builds devices from ESI files.

use ecaxis_esi::model::{Access, Device, Dictionary, Module, ObjectCode, SmUse, SyncManager};
use ecaxis_esi::sii::{Sii, SiiError, SiiOptions, SiiWarning};

use super::application::{Application, Io};
use super::esm::Al;
use super::mailbox::{Mailbox, MailboxOptions};
use super::process::ProcessData;
use super::supervision::Supervision;
use super::{Delays, InputFault, MailboxLimits, PowerOnState, SimDevice};
use crate::Nanos;
use crate::coe::history;
use crate::coe::object_dictionary::ObjectStore;
use crate::coe::pdo::{PdoRules, expand};
use crate::coe::startup::{StartupWrite, StartupWrites};
use crate::drive::PlantParams;
use crate::eoe::EoeServer;
use crate::esc::chip::ChipRequirements;
use crate::esc::ports::Medium;
use crate::esc::registers::{ADDRESS_SPACE, PROCESS_RAM};
use crate::esc::{Esc, EscConfig, EscInfo};
use crate::firmware::{BootLoader, FirmwareOptions};
use crate::foe::FileStore;
use crate::gateway::{Gateway, GatewayError, GatewayOptions};
use crate::quirks::Quirks;
use crate::soe::{self, Sercos};

/// The CiA 402 profile number.
const DRIVE_PROFILE: u32 = 402;
const CONTROLWORD: u16 = 0x6040;
const STATUSWORD: u16 = 0x6041;

/// The properties of one particular device that the ESI does not contain.
#[derive(Debug, Clone)]
pub struct DeviceOptions {
    /// The serial number, 0x1018:04 and EEPROM word 14.
    pub serial: u32,
    /// The station alias, EEPROM word 4; 0: none.
    pub alias: u16,
    /// The drift of the local clock in ppm; positive: the clock is fast.
    pub clock_drift_ppm: f64,
    /// The local time at power-on.
    pub clock_offset_ns: u64,
    /// The noise on the time stamps of frames, ± ns, drawn from a seed.
    pub clock_jitter_ns: u32,
    /// The seed of `clock_jitter_ns`.
    pub jitter_seed: u64,
    /// Motor, load and travel of a drive.
    pub plant: PlantParams,
    /// Likewise for the second axis of a drive and those after it; missing ones are the default.
    pub further_plants: Vec<PlantParams>,
    /// The delay from one port to the next in ns. `None`: 500 for a port with a PHY, 150 for an
    /// E-bus port.
    pub forwarding_ns: Option<u64>,
    /// The additional delay of the processing unit, between port 0 and the next port. Real ESCs
    /// take 20 to 40 ns. A MainDevice that ignores this delay misses half of it per device.
    pub processing_ns: u64,
    /// The EEPROM contents. `None`: generated from the ESI.
    pub sii: Option<Vec<u8>>,
    /// The time in ns from a request in AL control to the answer in AL status.
    pub state_change_ns: Nanos,
    /// The time in ns until the application has read AL control; AL control is writable again after
    /// it. At most `state_change_ns`. `None`: a quarter of `state_change_ns`.
    pub state_notice_ns: Option<Nanos>,
    /// The chip. `None`: the smallest chip that fits the device. Process RAM grows if SyncManagers
    /// need more.
    pub esc: Option<EscInfo>,
    /// How the device differs from the standard, except for its drives.
    pub quirks: Quirks,
    /// Mailbox properties.
    pub mailbox: MailboxOptions,
    /// The boot loader for firmware in Bootstrap and, if the ESI contains 0x1F51, through that
    /// object.
    pub firmware: Option<FirmwareOptions>,
    /// True if the default modules of the slots are hardware: the device refuses SafeOp with other
    /// modules in 0xF030. Otherwise it becomes what 0xF030 says.
    pub modules_are_hardware: bool,
    /// Further downloads that the device accepts even if its dictionary contradicts them, as it
    /// accepts the InitCmds of its ESI.
    pub startup: Vec<StartupWrite>,
    /// The options of a CANopen gateway and its nodes. A gateway without options has no nodes.
    pub gateway: Option<GatewayOptions>,
}

impl Default for DeviceOptions {
    fn default() -> Self {
        Self {
            serial: 0,
            alias: 0,
            clock_drift_ppm: 0.0,
            clock_offset_ns: 0,
            clock_jitter_ns: 0,
            jitter_seed: 0,
            plant: PlantParams::default(),
            further_plants: Vec::new(),
            forwarding_ns: None,
            processing_ns: 0,
            sii: None,
            state_change_ns: 200_000,
            state_notice_ns: None,
            esc: None,
            quirks: Quirks::default(),
            mailbox: MailboxOptions::default(),
            firmware: None,
            modules_are_hardware: false,
            startup: Vec::new(),
            gateway: None,
        }
    }
}

/// The device cannot be simulated.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SimError {
    /// A SyncManager of the ESI or EEPROM image exceeds the process RAM.
    #[error(
        "device `{device}`: SyncManager {sm} (0x{start:04x}, {len} bytes) does not lie in process RAM"
    )]
    SyncManagerOutside {
        /// The type name of the device.
        device: String,
        /// The number of the SyncManager.
        sm: usize,
        /// The physical start address.
        start: u16,
        /// The length in bytes.
        len: u16,
    },
    /// [`DeviceOptions::gateway`] is set for the device with this type name, which is not a gateway.
    #[error("device `{0}` is not a CANopen gateway, so it has no nodes")]
    NoGateway(String),
    /// The settings of the gateway are invalid.
    #[error(transparent)]
    Gateway(#[from] GatewayError),
    /// The EEPROM image is invalid.
    #[error("EEPROM image: {0}")]
    Image(#[from] SiiError),
    /// A category of the EEPROM image is damaged.
    #[error("EEPROM image: {0}")]
    DamagedImage(SiiWarning),
}

/// The objects of a device, its PDOs and the SyncManagers that carry them.
pub(super) struct Objects {
    pub(super) store: ObjectStore,
    pub(super) pdo: PdoRules,
    pub(super) process: Vec<ProcessData>,
}

impl Objects {
    /// Builds the objects. `first` may add objects before the PDOs are added.
    pub(super) fn new(
        device: &Device,
        modules: &[Module],
        serial: u32,
        first: impl FnOnce(&mut ObjectStore),
    ) -> Self {
        let mut store = ObjectStore::from_dictionary(&dictionaries(
            device,
            &modules_at_places(device, modules),
        ));
        identify(&mut store, device, serial);
        first(&mut store);
        let pdo = PdoRules::new(&mut store, device, modules);
        let process = pdo
            .process_sms()
            .iter()
            .filter(|sm| !is_virtual(device, sm.sm))
            .map(|sm| ProcessData {
                sm: usize::from(sm.sm),
                direction: sm.direction,
                mode: sm.mode,
                control: device
                    .sync_managers
                    .get(usize::from(sm.sm))
                    .map_or(0, |sm| sm.control_byte),
                op_only: device
                    .sync_managers
                    .get(usize::from(sm.sm))
                    .is_some_and(|sm| sm.op_only),
                map: Vec::new(),
                len: 0,
            })
            .collect();
        Self {
            store,
            pdo,
            process,
        }
    }
}

impl SimDevice {
    /// Creates the device that the ESI describes, powered on and in Init. A modular device starts
    /// with the default module of every slot.
    pub fn from_esi(
        device: &Device,
        modules: &[Module],
        options: DeviceOptions,
    ) -> Result<Self, SimError> {
        let ram_end = ram_end(device)?;
        let image = match options.sii {
            Some(image) => image,
            None => {
                let own = SiiOptions {
                    alias: options.alias,
                    serial: options.serial,
                };
                factory_image(device, modules, &own)
            }
        };
        let mut gateway = Application::gateway(device, options.serial, options.gateway)?;
        let shaped = gateway.as_ref().map(Gateway::shaped);
        let mut objects = Objects::new(
            shaped.as_ref().unwrap_or(device),
            modules,
            options.serial,
            |store| {
                if let Some(gateway) = &gateway {
                    gateway.prepare(store);
                }
            },
        );
        let is_sercos = device.soe_only().is_some();
        if is_sercos {
            soe::prepare(&mut objects.store, device);
        }
        let is_drive = is_sercos || is_drive(device, &objects.store);
        let mut sercos = None;
        let application = match gateway.take() {
            Some(mut gateway) => {
                gateway.bind(&objects.store);
                Application::Gateway(Box::new(gateway))
            }
            None if is_drive => {
                let mut plants = vec![options.plant];
                plants.extend(options.further_plants);
                let drives = Application::new_drives(&mut objects.store, &plants);
                if is_sercos {
                    let counts = |drive: usize| {
                        let plant = plants.get(drive).copied().unwrap_or_default();
                        plant.counts_per_turn
                    };
                    sercos = Some(Box::new(Sercos::new(&mut objects.store, device, counts)));
                }
                drives
            }
            None => Application::Io(Io::default()),
        };
        let Objects {
            mut store,
            mut pdo,
            process,
        } = objects;
        if options.modules_are_hardware {
            pdo.fix_modules();
        }
        let ram_end = ram_end.max(mapped_end(device, &pdo, &store)).min(0x1_0000);
        let ram_kib = count((ram_end - PROCESS_RAM).div_ceil(1024));
        let needs = ChipRequirements {
            ports: Medium::descriptor(Medium::from_physics(&device.physics)),
            // Without `Fmmu` elements, one for each SyncManager of the process data.
            fmmus: count(match device.fmmus.len() {
                0 => process.len(),
                fmmus => fmmus,
            }),
            sync_managers: count(device.sync_managers.len()),
            ram_kib,
            clock: is_drive || uses_dc(device),
            sync: is_drive || !device.dc_modes.is_empty(),
            no_lrw: device.use_lrd_lwr,
        };
        let info = options
            .esc
            .unwrap_or_else(|| EscInfo::fitting(&needs, image.len()))
            .with_eeprom_of(image.len());
        let esc = Esc::new(
            EscConfig {
                info: EscInfo {
                    ram_kib: info.ram_kib.max(ram_kib),
                    ..info
                },
                ports: needs.ports,
                with_dc: needs.clock,
                clock_offset_ns: options.clock_offset_ns,
                clock_drift_ppm: options.clock_drift_ppm,
                clock_jitter_ns: options.clock_jitter_ns,
                jitter_seed: options.jitter_seed,
            },
            image,
        );
        let plugged = modules_at_places(device, modules);
        let plugged = plugged.iter().map(|(module, _)| module);
        let mut startup = StartupWrites::new(device, plugged, options.startup);
        startup.prepare(&mut store, &pdo);
        store.keep_defaults();
        let coe = device
            .mailbox
            .as_ref()
            .and_then(|mailbox| mailbox.coe.as_ref());
        let has_foe = device.mailbox.as_ref().is_some_and(|mailbox| mailbox.foe);
        let made_for = (device.identity.vendor, device.identity.product);
        let processor = options
            .firmware
            .map(|o| BootLoader::new(o, &store, made_for));
        let mut sim = Self {
            name: device.type_name.clone(),
            delays: Delays {
                forwarding_ns: options.forwarding_ns,
                processing_ns: options.processing_ns,
            },
            powered: true,
            state_change_ns: options.state_change_ns,
            state_notice_ns: options
                .state_notice_ns
                .unwrap_or(options.state_change_ns / 4)
                .min(options.state_change_ns),
            fresh: Box::new(PowerOnState {
                store: store.clone(),
                application: application.clone(),
                sercos: sercos.clone(),
            }),
            esc,
            supervision: Supervision::new(&store),
            store,
            pdo,
            process,
            application,
            sercos,
            mailbox: mailbox(device, options.serial),
            mailbox_limits: mailbox_limits(device),
            boot_mailbox: boot_mailbox(device),
            has_coe: coe.is_some(),
            has_foe: options.mailbox.has_foe.unwrap_or(has_foe),
            sdo_info: coe.is_some_and(|coe| coe.sdo_info),
            has_boot: device.eeprom.bootstrap.iter().any(|b| *b != 0) && device.mailbox.is_some(),
            complete_access: coe.is_some_and(|coe| coe.complete_access),
            mailbox_options: options.mailbox.with(&options.quirks),
            quirks: options.quirks,
            startup,
            files: FileStore::default(),
            al: Al::default(),
            serial: options.serial,
            tick: 0,
            pulses: Default::default(),
            arrivals: Default::default(),
            local: 0,
            hangs: false,
            processor,
            parked: None,
            restarts_until: None,
            was_reset: false,
            refusals: Vec::new(),
            forced_aborts: Vec::new(),
            ignored_writes: Vec::new(),
            input_fault: InputFault::default(),
            mailbox_silent: false,
            sync0_before_safe_op: false,
            activations: device
                .dc_modes
                .iter()
                .map(|mode| mode.assign_activate.to_be_bytes()[0])
                .collect(),
        };
        sim.power_on(0);
        Ok(sim)
    }
}

/// Returns the image of the ESI. Contents that exceed the size in the ESI get the next larger chip;
/// the sizes of chips are powers of two.
fn factory_image(device: &Device, modules: &[Module], options: &SiiOptions) -> Vec<u8> {
    let mut sii = Sii::from_device(device, modules, options);
    let image = sii.to_bytes();
    let size = u32::try_from(image.len()).unwrap_or(u32::MAX);
    if size <= sii.byte_size.next_multiple_of(128) {
        return image;
    }
    sii.byte_size = size.next_power_of_two();
    sii.to_bytes()
}

/// True for a drive profile with a mailbox, or if a dictionary or PDO of device or modules has
/// Controlword and Statusword.
fn is_drive(device: &Device, store: &ObjectStore) -> bool {
    device.profile == Some(DRIVE_PROFILE) && device.mailbox.is_some()
        || [CONTROLWORD, STATUSWORD].map(|index| store.has_object(index)) == [true, true]
}

/// True if the PDI control word (high byte) switches SYNC and latch units on, or the ESI has
/// OpModes. Some vendors provide only OpModes.
fn uses_dc(device: &Device) -> bool {
    let units = device.eeprom.config_data.get(1).map_or(0, |b| b & 0x0c);
    units != 0 || !device.dc_modes.is_empty()
}

/// Modules in slots beyond this number add no objects.
const MAX_PLACES: usize = 32;

/// Returns every module for every slot that accepts it, and whether it is the default of the slot.
fn modules_at_places(device: &Device, modules: &[Module]) -> Vec<(Module, bool)> {
    let mut all = Vec::new();
    let Some(slots) = &device.slots else {
        return all;
    };
    for (place, slot) in expand(slots).enumerate().take(MAX_PLACES) {
        for (ident, default) in &slot.module_idents {
            if let Some(module) = modules.iter().find(|module| module.ident == *ident) {
                all.push((module.at(device, slots, slot, place), *default));
            }
        }
    }
    all
}

/// Returns the dictionaries of pluggable modules, device and default modules. Later dictionaries
/// win.
fn dictionaries<'a>(device: &'a Device, plugged: &'a [(Module, bool)]) -> Vec<&'a Dictionary> {
    let of = |wanted: bool| {
        let fitting = plugged
            .iter()
            .filter(move |(_, default)| *default == wanted);
        fitting.map(|(module, _)| &module.dictionary)
    };
    of(false)
        .chain([&device.dictionary])
        .chain(of(true))
        .collect()
}

/// Adds 0x1018 with the identity of the EEPROM and 0x1C00 with the SyncManager types. Every device
/// with CoE has both objects.
fn identify(store: &mut ObjectStore, device: &Device, serial: u32) {
    if device
        .mailbox
        .as_ref()
        .is_none_or(|mailbox| mailbox.coe.is_none())
    {
        return;
    }
    let ro = Access::default();
    let identity = [
        ("Vendor ID", device.identity.vendor),
        ("Product code", device.identity.product),
        ("Revision number", device.identity.revision),
        ("Serial number", serial),
    ];
    store.ensure(
        0x1000,
        0,
        "Device type",
        32,
        ro,
        &device.profile.unwrap_or(0).to_le_bytes(),
    );
    store.describe(0x1018, ObjectCode::Record, "Identity");
    store.ensure(0x1018, 0, "SubIndex 000", 8, ro, &[4]);
    for (sub, (name, value)) in (1..).zip(identity) {
        let slot = store.ensure(0x1018, sub, name, 32, ro, &[]);
        store.set(slot, i64::from(value));
    }
    let coe = device
        .mailbox
        .as_ref()
        .and_then(|mailbox| mailbox.coe.as_ref());
    if coe.is_some_and(|coe| coe.diag_history) {
        history::create(store);
    }
    let types: Vec<u8> = device.sync_managers.iter().take(8).map(sm_type).collect();
    let count = u8::try_from(types.len()).unwrap_or(8);
    store.describe(0x1c00, ObjectCode::Array, "SyncManager types");
    store.ensure(0x1c00, 0, "SubIndex 000", 8, ro, &[count]);
    for (sub, kind) in (1..).zip(types) {
        let name = format!("SyncManager {}", sub - 1);
        store.ensure(0x1c00, sub, &name, 8, ro, &[kind]);
    }
}

/// Returns the value for 0x1C00 (ETG.1000.6, SyncManager communication type). 0: unused, 1 and 2:
/// mailbox out and in, 3 and 4: process data out and in.
fn sm_type(sm: &SyncManager) -> u8 {
    match sm.usage {
        SmUse::MBoxOut => 1,
        SmUse::MBoxIn => 2,
        SmUse::Outputs => 3,
        SmUse::Inputs => 4,
        SmUse::Other => 0,
    }
}

/// True for a SyncManager whose area is registers, such as latch times. An FMMU reads the registers
/// without the SyncManager.
fn is_virtual(device: &Device, sm: u8) -> bool {
    let sm = device.sync_managers.get(usize::from(sm));
    sm.is_some_and(|sm| (1..ADDRESS_SPACE).contains(&usize::from(sm.start_address)))
}

fn count(n: usize) -> u8 {
    u8::try_from(n).unwrap_or(u8::MAX)
}

/// Returns the end of the process RAM for the SyncManager sizes that the ESI contains.
fn ram_end(device: &Device) -> Result<usize, SimError> {
    let mut end = PROCESS_RAM;
    for (n, sm) in device.sync_managers.iter().enumerate() {
        let (start, len) = (sm.start_address, sm.max_size.unwrap_or(sm.default_size));
        let mailbox = matches!(sm.usage, SmUse::MBoxOut | SmUse::MBoxIn);
        let buffers = if mailbox { 1 } else { 3 };
        let last = usize::from(start) + usize::from(len) * buffers;
        if last > 0x1_0000 {
            return Err(SimError::SyncManagerOutside {
                device: device.type_name.clone(),
                sm: n,
                start,
                len,
            });
        }
        end = end.max(last);
    }
    Ok(end)
}

/// Returns the end of the process RAM for the PDOs that the ESI assigns. A modular device gets 8
/// KiB, because its modules are unknown.
fn mapped_end(device: &Device, pdo: &PdoRules, store: &ObjectStore) -> usize {
    let mut map = Vec::new();
    let modular = if device.slots.is_some() { 0x3000 } else { 0 };
    device
        .sync_managers
        .iter()
        .zip(0..)
        .map(|(sm, n)| {
            let len = pdo.layout(store, n, &mut map).max(pdo.longest_named(n));
            usize::from(sm.start_address) + 3 * len
        })
        .fold(modular, usize::max)
}

fn mailbox(device: &Device, serial: u32) -> Option<Mailbox> {
    let find = |usage| {
        device
            .sync_managers
            .iter()
            .take(8)
            .position(|sm| sm.usage == usage)
    };
    let protocols = device.mailbox.as_ref()?;
    let mut mailbox = Mailbox::new(find(SmUse::MBoxOut)?, find(SmUse::MBoxIn)?);
    mailbox.eoe = protocols
        .eoe
        .map(|eoe| Box::new(EoeServer::new(serial, eoe.time_stamp == Some(true))));
    Some(mailbox)
}

fn mailbox_limits(device: &Device) -> [MailboxLimits; 8] {
    let mut limits = [MailboxLimits::default(); 8];
    for (limit, sm) in limits.iter_mut().zip(&device.sync_managers) {
        *limit = MailboxLimits {
            start: sm.start_address,
            min: sm.min_size.unwrap_or(sm.default_size),
            max: sm.max_size.unwrap_or(sm.default_size).max(sm.default_size),
        };
    }
    limits
}

/// Returns (address, length) of the receive and send mailbox in Bootstrap.
fn boot_mailbox(device: &Device) -> ((u16, u16), (u16, u16)) {
    let word = |n: usize| match device.eeprom.bootstrap.get(n * 2..n * 2 + 2) {
        Some([low, high]) => u16::from_le_bytes([*low, *high]),
        _ => 0,
    };
    ((word(0), word(1)), (word(2), word(3)))
}
