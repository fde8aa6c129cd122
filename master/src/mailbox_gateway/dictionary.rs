//! The objects of the MainDevice (ETG.1510, ETG.5001 part 3): configuration, information and
//! diagnosis of every device, their addresses, and counters. Entries whose value is not known are
//! left out; SDO Information says which ones are there.

use std::sync::{Mutex, PoisonError};

use ecaxis_ecat::index::{DeviceIndex, IndexVec};
use ecaxis_ecat::mailbox::coe::{Answer, Request};
use ecaxis_ecat::mailbox::{ERROR_UNSUPPORTED_PROTOCOL, TYPE_COE, abort_code};
use ecaxis_esi as esi;
use tokio::sync::watch;

use super::access::{mailbox_error, sdo_abort};
use super::live::{DeviceLive, Live};
use super::object::{self, Object, Objects};
use crate::acyclic::topology;
use crate::bringup::BusDevice;
use crate::config::{DeviceConfig, Locator, Machine};
use crate::mailbox::{Mailboxes, RawMessage};
use crate::report::DevicePlace;
use crate::rt::exchange::DiagnosticRegister;

/// Modular device (5001) with the profile of an EtherCAT MainDevice (1100).
const DEVICE_TYPE: u32 = 1100 << 16 | 5001;
/// The lengths of the texts in 0x8nnn.
const TYPE_LENGTH: usize = 32;
const NAME_LENGTH: usize = 64;
/// The addresses in one of the objects 0xF020 and 0xF040 and those behind them.
const ADDRESSES: usize = 255;

const CONFIGURATION: u16 = 0x8000;
const INFORMATION: u16 = 0x9000;
const DIAGNOSIS: u16 = 0xa000;
const DETECT_MODULES: u16 = 0xf002;
const CONFIGURED_ADDRESSES: u16 = 0xf020;
const DETECTED_ADDRESSES: u16 = 0xf040;
const DIAG_DATA: u16 = 0xf120;

/// A command has ended without an error, and there is a response (ETG.1020, command objects).
const DONE: u8 = 1;

/// What is known of a device since the start.
#[derive(Debug)]
struct DeviceInfo {
    station: u16,
    type_name: String,
    name: String,
    device_type: u32,
    /// Vendor, product, revision and serial number by the machine file (0: any serial number).
    identity: [u32; 4],
    /// The same as found at the start.
    found: [u32; 4],
    /// The mailboxes to and from the device.
    mailbox: [u16; 2],
    protocols: u16,
    diag_history: bool,
    /// Bit 2: head of a group of optional devices, bit 3: optional.
    flags: u8,
    dl_status: u16,
    /// The station address of the neighbour at each port.
    neighbours: [u16; 4],
}

#[derive(Debug)]
pub(super) struct Dictionary {
    devices: IndexVec<DeviceIndex, DeviceInfo>,
    live: watch::Receiver<Live>,
    scan: Mutex<Scan>,
}

/// The last scan command (0xF002).
#[derive(Debug, Clone, Copy, Default)]
struct Scan {
    request: [u8; 2],
    /// 0 before the first command, then [`DONE`].
    status: u8,
    response: [u8; 6],
}

impl DeviceInfo {
    fn new(config: &DeviceConfig, found: Option<&BusDevice>, mailboxes: &Mailboxes) -> Self {
        let device = &*config.device;
        let station = found.map_or(0, |found| found.at.station);
        let mailbox = device.mailbox.as_ref();
        let protocols = mailbox.map_or([false; 6], |mailbox| {
            let coe = mailbox.coe.is_some();
            [
                mailbox.aoe,
                mailbox.eoe.is_some(),
                coe,
                mailbox.foe,
                mailbox.soe.is_some(),
                mailbox.voe,
            ]
        });
        let bits = protocols.iter().rev();
        let coe = mailbox.and_then(|mailbox| mailbox.coe.as_ref());
        let head = config.optional && !matches!(config.at, Locator::Behind(..));
        let layout = mailboxes.at_station(station).map(|(_, _, layout)| layout);
        Self {
            station,
            type_name: device.type_name.clone(),
            name: config.name.clone(),
            device_type: device_type(device),
            identity: [
                device.identity.vendor,
                device.identity.product,
                device.identity.revision,
                config.serial.unwrap_or(0),
            ],
            found: [
                device.identity.vendor,
                device.identity.product,
                found.map_or(0, |found| found.revision),
                found.map_or(0, |found| found.serial),
            ],
            mailbox: layout.map_or([0; 2], |layout| [layout.out_len, layout.in_len]),
            protocols: bits.fold(0, |bits, supported| bits << 1 | u16::from(*supported)),
            diag_history: coe.is_some_and(|coe| coe.diag_history),
            flags: u8::from(config.optional) << 3 | u8::from(head) << 2,
            dl_status: found.map_or(0, |found| found.dl_status),
            neighbours: [0; 4],
        }
    }

    /// Returns the identity of the machine file or of the device as entries 5 to 8.
    fn with_identity(object: Object, identity: [u32; 4]) -> Object {
        let names = [
            "Vendor ID",
            "Product Code",
            "Revision Number",
            "Serial Number",
        ];
        let entries = (5..).zip(names).zip(identity);
        entries.fold(object, |object, ((sub, name), value)| {
            object.u32(sub, name, value)
        })
    }

    fn configuration(&self, index: u16, live: &DeviceLive) -> Object {
        let object = Object::record(index, format!("Configuration Data {}", self.name), 40)
            .u16(1, "Fixed Station Address", self.station)
            .string(2, "Type", TYPE_LENGTH, &self.type_name)
            .string(3, "Name", NAME_LENGTH, &self.name)
            .u32(4, "Device Type", self.device_type);
        let [out, back] = self.mailbox;
        Self::with_identity(object, self.identity)
            .u16(33, "Mailbox Out Size", out)
            .u16(34, "Mailbox In Size", back)
            .u8(35, "Link Status", self.link_status(live))
            .u8(36, "Link Preset", self.link_preset())
            .u8(37, "Flags", self.flags)
            .u16(39, "Mailbox Protocols Supported", self.protocols)
            .bool(40, "Diag History Object Supported", self.diag_history)
    }

    fn information(&self, index: u16, live: &DeviceLive) -> Object {
        let object = Object::record(index, format!("Information Data {}", self.name), 32).u16(
            1,
            "Fixed Station Address",
            self.station,
        );
        Self::with_identity(object, self.found).u16(32, "DL Status Register", self.dl_now(live))
    }

    fn diagnosis(&self, index: u16, live: &DeviceLive, requested: u8) -> Object {
        let found = &live.found;
        let mut object = Object::record(index, format!("Diagnosis Data {}", self.name), 16)
            .u16(1, "AL Status", found.al_status.into())
            .u16(2, "AL Control", requested.into())
            .u16(3, "AL Status Code", found.al_code)
            .u8(
                4,
                "Link Connection Status",
                link_connection(self.dl_now(live)),
            );
        for (sub, neighbour) in (6..).zip(self.neighbours) {
            object = object.u16(sub, "Fixed Address Connection Port", neighbour);
        }
        for (sub, errors) in (10..).zip(found.errors.invalid_frames) {
            object = object.u32(sub, "Frame Error Counter Port", errors.into());
        }
        object
            .u32(15, "Slave Not Present Counter", live.absences)
            .u32(16, "Abnormal State Change Counter", live.abnormal)
    }

    /// Returns DL status as the cycle has read it last, otherwise that of the start.
    fn dl_now(&self, live: &DeviceLive) -> u16 {
        match live.found.has_read(DiagnosticRegister::DlStatus) {
            true => live.found.dl_status,
            false => self.dl_status,
        }
    }

    /// Returns how the links differ from those at the start: no answer, a link without
    /// communication, a missing link, a further link, and in bits 4 to 7 the ports of these.
    fn link_status(&self, live: &DeviceLive) -> u8 {
        let (mut status, mut at) = (0, 0);
        let now = topology::ports(self.dl_now(live));
        let start = topology::ports(self.dl_status);
        for (port, (now, start)) in now.iter().zip(start).enumerate() {
            let differs = [
                now.link && !now.open,
                start.link && !now.link,
                now.link && !start.link,
            ];
            for (bit, differs) in (1..).zip(differs) {
                status |= u8::from(differs) << bit;
                at |= u8::from(differs) << (4 + port);
            }
        }
        let known = live.found.has_read(DiagnosticRegister::AlStatus);
        status | at | u8::from(known && !live.found.answers)
    }

    /// Returns at which ports, from port 1 on, a device is expected (bits 0 to 2), and a link (bits
    /// 4 to 6).
    fn link_preset(&self) -> u8 {
        let ports = topology::ports(self.dl_status).into_iter();
        let ports = ports.zip(self.neighbours).skip(1).enumerate();
        ports.fold(0, |preset, (bit, (port, neighbour))| {
            preset | u8::from(neighbour != 0) << bit | u8::from(port.link) << (4 + bit)
        })
    }
}

/// Returns the value of 0x1000 in the ESI, otherwise the profile.
fn device_type(device: &esi::Device) -> u32 {
    let described = device.dictionary.item(0x1000, 0);
    let described = described.filter(|item| item.has_default);
    let default = described.and_then(|item| item.default.first_chunk().copied());
    default.map_or(device.profile.unwrap_or(0), u32::from_le_bytes)
}

/// Returns which ports communicate (bits 0 to 3) and which have a link (bits 4 to 7).
fn link_connection(dl_status: u16) -> u8 {
    let ports = topology::ports(dl_status).into_iter().enumerate();
    ports.fold(0, |bits, (port, state)| {
        bits | u8::from(state.open) << port | u8::from(state.link) << (4 + port)
    })
}

impl Dictionary {
    pub(super) fn new(
        machine: &Machine,
        found: &IndexVec<DeviceIndex, BusDevice>,
        places: &IndexVec<DeviceIndex, DevicePlace>,
        mailboxes: &Mailboxes,
        live: watch::Receiver<Live>,
    ) -> Self {
        let devices = machine.devices.enumerate();
        let devices =
            devices.map(|(index, config)| DeviceInfo::new(config, found.get(index), mailboxes));
        let mut devices: IndexVec<DeviceIndex, DeviceInfo> = devices.collect();
        for (child, place) in places.enumerate() {
            let Some((parent, port)) = place.parent else {
                continue;
            };
            let stations = [parent, child].map(|device| devices.get(device).map(|d| d.station));
            for (device, port, neighbour) in [(parent, port, stations[1]), (child, 0, stations[0])]
            {
                if let Some(device) = devices.get_mut(device)
                    && let Some(place) = device.neighbours.get_mut(usize::from(port))
                {
                    *place = neighbour.unwrap_or(0);
                }
            }
        }
        Self {
            devices,
            live,
            scan: Mutex::default(),
        }
    }

    /// Returns the answers to a message. The caller has checked the right to write.
    pub(super) fn answer(&self, message: &RawMessage) -> Vec<RawMessage> {
        if message.protocol != TYPE_COE {
            return vec![mailbox_error(ERROR_UNSUPPORTED_PROTOCOL)];
        }
        let mailbox = message.mailbox();
        let request = Request::parse(&mailbox).ok().flatten();
        match request {
            Some(Request::Upload {
                index,
                sub,
                complete,
            }) => vec![object::upload(
                self.object(index).as_ref(),
                index,
                sub,
                complete,
            )],
            Some(Request::DownloadExpedited { index, sub, data }) => {
                vec![self.download(index, sub, data)]
            }
            Some(Request::Download {
                index, sub, data, ..
            }) => vec![self.download(index, sub, data)],
            Some(Request::Information { opcode, body }) => object::information(self, opcode, body),
            Some(Request::Abort { .. }) => Vec::new(),
            _ => vec![sdo_abort(request.as_ref(), abort_code::INVALID_COMMAND)],
        }
    }

    fn download(&self, index: u16, sub: u8, data: &[u8]) -> RawMessage {
        let entry = self.object(index).map(|object| object.has(sub));
        let code = match (entry, (index, sub), data) {
            (None, ..) => abort_code::NO_OBJECT,
            (Some(false), ..) => abort_code::NO_SUBINDEX,
            (_, (DETECT_MODULES, 1), [low, high]) => {
                self.scan([*low, *high]);
                return object::coe(Answer::Download { index, sub }.body());
            }
            (_, (DETECT_MODULES, 1), _) => abort_code::TYPE_MISMATCH,
            _ => abort_code::READ_ONLY,
        };
        object::coe(Answer::Abort { index, sub, code }.body())
    }

    /// Counts the devices: every cycle asks them all.
    fn scan(&self, request: [u8; 2]) {
        let [low, high] = self.live.borrow().answering.to_le_bytes();
        let scan = Scan {
            request,
            status: DONE,
            response: [DONE, 0, low, high, 0, 0],
        };
        *self.scan.lock().unwrap_or_else(PoisonError::into_inner) = scan;
    }

    fn detect_modules(&self) -> Object {
        let scan = *self.scan.lock().unwrap_or_else(PoisonError::into_inner);
        Object::record(DETECT_MODULES, "Detect Modules Command".to_owned(), 3)
            .octets(1, "Scan Command Request", &scan.request)
            .writable()
            .u8(2, "Scan Command Status", scan.status)
            .octets(3, "Scan Command Response", &scan.response)
    }

    /// Returns a part of a list of addresses.
    fn addresses(&self, index: u16, first: u16, name: &str, all: &[u16]) -> Option<Object> {
        let part = usize::from(index.checked_sub(first)?);
        let part = all.chunks(ADDRESSES).nth(part)?;
        Some(Object::array(index, name.to_owned(), part))
    }

    fn configured(&self) -> Vec<u16> {
        self.devices.iter().map(|device| device.station).collect()
    }

    /// Returns the addresses of the devices that answer.
    fn detected(&self, live: &Live) -> Vec<u16> {
        let each = self.devices.iter().zip(&live.devices);
        let there = each.filter(|(_, live)| live.found.answers);
        there.map(|(device, _)| device.station).collect()
    }
}

impl Objects for Dictionary {
    fn indices(&self) -> Vec<u16> {
        let count = u16::try_from(self.devices.len()).unwrap_or(u16::MAX);
        let detected = self.detected(&self.live.borrow()).len();
        let parts = |first: u16, addresses: usize| {
            let parts = u16::try_from(addresses.div_ceil(ADDRESSES)).unwrap_or(0);
            first..first + parts
        };
        let of_devices = [CONFIGURATION, INFORMATION, DIAGNOSIS].into_iter();
        [0x1000, 0x1008, 0x1009, 0x100a, 0x1018]
            .into_iter()
            .chain(of_devices.flat_map(|first| first..first + count))
            .chain([DETECT_MODULES])
            .chain(parts(CONFIGURED_ADDRESSES, self.devices.len()))
            .chain(parts(DETECTED_ADDRESSES, detected))
            .chain([DIAG_DATA])
            .collect()
    }

    fn object(&self, index: u16) -> Option<Object> {
        let live = self.live.borrow();
        let number = usize::from(index & 0x0fff);
        let of_device = || {
            let now = live.devices.get(number).copied().unwrap_or_default();
            Some((self.devices.get(DeviceIndex(number))?, now))
        };
        match index {
            0x1000 => Some(Object::number(index, "Device Type", DEVICE_TYPE)),
            0x1008 => Some(Object::text(index, "Manufacturer Device Name", "ecaxis")),
            0x1009 => Some(Object::text(
                index,
                "Manufacturer Hardware Version",
                std::env::consts::ARCH,
            )),
            0x100a => Some(Object::text(
                index,
                "Manufacturer Software Version",
                env!("CARGO_PKG_VERSION"),
            )),
            // No vendor ID is assigned to ecaxis.
            0x1018 => Some(
                Object::record(index, "Identity".to_owned(), 4)
                    .u32(1, "Vendor ID", 0)
                    .u32(2, "Product Code", 0)
                    .u32(3, "Revision Number", 0)
                    .u32(4, "Serial Number", 0),
            ),
            0x8000..=0x8fff => of_device().map(|(device, now)| device.configuration(index, &now)),
            0x9000..=0x9fff => of_device().map(|(device, now)| device.information(index, &now)),
            0xa000..=0xafff => {
                of_device().map(|(device, now)| device.diagnosis(index, &now, live.requested))
            }
            DETECT_MODULES => Some(self.detect_modules()),
            0xf020..=0xf02f => {
                let name = "Configured Address List";
                self.addresses(index, CONFIGURED_ADDRESSES, name, &self.configured())
            }
            0xf040..=0xf04f => {
                let name = "Detected Address List";
                self.addresses(index, DETECTED_ADDRESSES, name, &self.detected(&live))
            }
            DIAG_DATA => {
                let lost = u32::try_from(live.lost_frames).unwrap_or(u32::MAX);
                Some(
                    Object::record(index, "Master Diag Data".to_owned(), 16)
                        .u32(1, "Cyclic Lost Frames", lost)
                        .u32(3, "Cyclic Frames/s", live.frames_per_second)
                        .u16(16, "Master State", live.requested.into()),
                )
            }
            _ => None,
        }
    }
}
