//! A minimal MainDevice for tests of SubDevices: one datagram at a time, virtual time.
#![allow(dead_code, reason = "every test binary uses its own part")]
#![allow(clippy::print_stderr, reason = "prints skipped tests")]

use std::path::PathBuf;

use ecaxis_esi::model::{
    Access, Coe, DcMode, Device, Dictionary, Direction, Eeprom, Entry, FmmuUse, Identity, Mailbox,
    Object, ObjectItem, Pdo, PdoMapping, SmUse, SyncManager, Writable,
};
use ecaxis_sim::frame::{self, FrameBuilder};
use ecaxis_sim::{DeviceOptions, FrameOutcome, Segment, SegmentOptions, SimDevice};

pub const INIT: u8 = 1;
pub const PREOP: u8 = 2;
pub const BOOT: u8 = 3;
pub const SAFEOP: u8 = 4;
pub const OP: u8 = 8;

pub struct Bus {
    pub segment: Segment,
    pub now: u64,
    /// Address and length of the write and read mailbox of all devices.
    pub mailboxes: [(u16, u16); 2],
    counter: u8,
}

/// An SDO abort code or a mailbox error detail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    Abort(u32),
    Mailbox(u16),
}

impl Bus {
    pub fn new(devices: Vec<SimDevice>) -> Self {
        Self::over(Segment::new(devices, SegmentOptions::default()))
    }

    pub fn over(segment: Segment) -> Self {
        Self {
            segment,
            now: 0,
            mailboxes: [(0x1000, 48), (0x1030, 48)],
            counter: 0,
        }
    }

    /// Sends a frame and waits for it. Returns `None` if it is lost.
    pub fn frame(&mut self, mut bytes: Vec<u8>) -> Option<Vec<u8>> {
        match self.segment.transit(&mut bytes, self.now) {
            FrameOutcome::Back { at, .. } => {
                assert!(at > self.now);
                self.now = at;
                Some(bytes)
            }
            FrameOutcome::Lost => {
                self.now += 1_000_000;
                None
            }
        }
    }

    /// Sends one datagram. Returns data and working counter.
    pub fn datagram(&mut self, command: u8, adp: u16, ado: u16, data: &[u8]) -> (Vec<u8>, u16) {
        let bytes = self
            .frame(
                FrameBuilder::default()
                    .datagram(command, adp, ado, data)
                    .build(),
            )
            .expect("the frame comes back");
        let d = frame::next(&bytes, None).unwrap();
        (bytes[d.data.clone()].to_vec(), d.wkc(&bytes))
    }

    pub fn logical(&mut self, command: u8, address: u32, data: &[u8]) -> (Vec<u8>, u16) {
        self.datagram(command, address as u16, (address >> 16) as u16, data)
    }

    pub fn read(&mut self, station: u16, ado: u16, len: usize) -> Vec<u8> {
        let (data, wkc) = self.datagram(4, station, ado, &vec![0; len]);
        assert_eq!(wkc, 1, "read 0x{ado:04x}");
        data
    }

    pub fn read_u16(&mut self, station: u16, ado: u16) -> u16 {
        u16::from_le_bytes(self.read(station, ado, 2).try_into().unwrap())
    }

    pub fn write(&mut self, station: u16, ado: u16, data: &[u8]) {
        assert_eq!(
            self.datagram(5, station, ado, data).1,
            1,
            "write 0x{ado:04x}"
        );
    }

    pub fn wait(&mut self, ns: u64) {
        self.now += ns;
        self.segment.advance(self.now);
    }

    /// Sets station addresses 0x1001, 0x1002 …
    pub fn address_all(&mut self) -> u16 {
        let (_, n) = self.datagram(7, 0, 0, &[0]);
        for position in 0..n {
            let station = (0x1001 + position).to_le_bytes();
            assert_eq!(
                self.datagram(2, 0u16.wrapping_sub(position), 0x10, &station)
                    .1,
                1
            );
        }
        n
    }

    /// Writes zeros to the outputs, which a device needs before Op.
    pub fn first_outputs(&mut self, station: u16) {
        for n in 0..8 {
            let (sm, _) = self.datagram(4, station, 0x800 + n * 8, &[0; 8]);
            let word = |at: usize| u16::from_le_bytes([sm[at], sm[at + 1]]);
            let mailbox = n < 2 && sm[4] & 3 == 2;
            if sm[6] & 1 != 0 && sm[4] >> 2 & 3 == 1 && !mailbox && word(2) > 0 {
                self.datagram(5, station, word(0), &vec![0; word(2).into()]);
            }
        }
    }

    /// Requests a state. Returns (AL status, AL status code) afterwards.
    pub fn request(&mut self, station: u16, control: u16) -> (u16, u16) {
        self.write(station, 0x120, &control.to_le_bytes());
        self.wait(1_000_000);
        (self.read_u16(station, 0x130), self.read_u16(station, 0x134))
    }

    /// Takes a device to a state, to Op with first outputs.
    pub fn to(&mut self, station: u16, state: u8) {
        if state == OP {
            self.first_outputs(station);
        }
        let expected = (u16::from(state), 0);
        assert_eq!(
            self.request(station, u16::from(state)),
            expected,
            "state {state}"
        );
    }

    pub fn sm(&mut self, station: u16, n: u16, start: u16, len: u16, control: u8) {
        let (s, l) = (start.to_le_bytes(), len.to_le_bytes());
        self.write(
            station,
            0x800 + n * 8,
            &[s[0], s[1], l[0], l[1], control, 0, 1, 0],
        );
    }

    /// Sets a byte-aligned FMMU; kind 1 reads, 2 writes.
    pub fn fmmu(&mut self, station: u16, n: u16, logical: u32, len: u16, physical: u16, kind: u8) {
        let mut r = [0; 16];
        r[..4].copy_from_slice(&logical.to_le_bytes());
        r[4..6].copy_from_slice(&len.to_le_bytes());
        r[7] = 7;
        r[8..10].copy_from_slice(&physical.to_le_bytes());
        (r[11], r[12]) = (kind, 1);
        self.write(station, 0x600 + n * 16, &r);
    }

    /// Goes to PreOp with the mailboxes of [`coe_device`] and the EPOS4 unless set otherwise: 48
    /// bytes at 0x1000 and 0x1030.
    pub fn preop(&mut self, station: u16) {
        self.start_mailboxes(station);
        self.to(station, PREOP);
    }

    pub fn start_mailboxes(&mut self, station: u16) {
        let [receive, send] = self.mailboxes;
        self.sm(station, 0, receive.0, receive.1, 0x26);
        self.sm(station, 1, send.0, send.1, 0x22);
    }

    /// Sends a mailbox message with a generated header and returns the reply without its header.
    pub fn mailbox(&mut self, station: u16, kind: u8, payload: &[u8]) -> (u8, Vec<u8>) {
        self.send_mailbox(station, kind, payload);
        self.wait(1_000_000);
        self.fetch(station).expect("a reply")
    }

    pub fn send_mailbox(&mut self, station: u16, kind: u8, payload: &[u8]) {
        self.counter = self.counter % 7 + 1;
        let mut message = vec![0; usize::from(self.mailboxes[0].1)];
        message[..2].copy_from_slice(&(payload.len() as u16).to_le_bytes());
        message[5] = kind | self.counter << 4;
        message[6..6 + payload.len()].copy_from_slice(payload);
        self.write(station, self.mailboxes[0].0, &message);
    }

    pub fn fetch(&mut self, station: u16) -> Option<(u8, Vec<u8>)> {
        let data = self.fetch_raw(station)?;
        let len = usize::from(u16::from_le_bytes([data[0], data[1]]));
        Some((data[5] & 0x0f, data[6..6 + len].to_vec()))
    }

    /// Returns a whole mailbox with its header; `None` while it is empty.
    pub fn fetch_raw(&mut self, station: u16) -> Option<Vec<u8>> {
        let (start, len) = self.mailboxes[1];
        let (data, wkc) = self.datagram(4, station, start, &vec![0; usize::from(len)]);
        (wkc == 1).then_some(data)
    }

    /// Sends one SDO request. Returns everything after the CoE header.
    fn sdo(&mut self, station: u16, request: &[u8]) -> Result<Vec<u8>, Refusal> {
        let mut payload = vec![0, 0x20];
        payload.extend_from_slice(request);
        let (kind, reply) = self.mailbox(station, 3, &payload);
        if kind == 0 {
            return Err(Refusal::Mailbox(u16::from_le_bytes([reply[2], reply[3]])));
        }
        if reply[2] == 0x80 {
            return Err(Refusal::Abort(u32::from_le_bytes(
                reply[6..10].try_into().unwrap(),
            )));
        }
        assert_eq!(reply[..2], [0, 0x30], "SDO response");
        Ok(reply[2..].to_vec())
    }

    pub fn upload_with(
        &mut self,
        station: u16,
        command: u8,
        index: u16,
        sub: u8,
    ) -> Result<Vec<u8>, Refusal> {
        let [low, high] = index.to_le_bytes();
        let first = self.sdo(station, &[command, low, high, sub, 0, 0, 0, 0])?;
        assert_eq!(first[1..4], [low, high, sub]);
        if first[0] & 2 != 0 {
            return Ok(first[4..8 - usize::from(first[0] >> 2 & 3)].to_vec());
        }
        let size = u32::from_le_bytes(first[4..8].try_into().unwrap()) as usize;
        let mut data = first[8..].to_vec();
        let mut toggle = 0;
        while data.len() < size {
            let segment = self.sdo(station, &[0x60 | toggle, 0, 0, 0, 0, 0, 0, 0])?;
            assert_eq!(segment[0] & 0x10, toggle);
            let unused = usize::from(segment[0] >> 1 & 7);
            data.extend_from_slice(&segment[1..segment.len() - unused]);
            assert_eq!(segment[0] & 1 != 0, data.len() == size);
            toggle ^= 0x10;
        }
        Ok(data)
    }

    pub fn upload(&mut self, station: u16, index: u16, sub: u8) -> Result<Vec<u8>, Refusal> {
        self.upload_with(station, 0x40, index, sub)
    }

    pub fn download(
        &mut self,
        station: u16,
        index: u16,
        sub: u8,
        data: &[u8],
    ) -> Result<(), Refusal> {
        self.download_with(station, 0, index, sub, data)
    }

    /// `flags` 0x10: complete access. Up to 4 bytes go expedited, data that fits one mailbox
    /// normal, else segmented.
    pub fn download_with(
        &mut self,
        station: u16,
        flags: u8,
        index: u16,
        sub: u8,
        data: &[u8],
    ) -> Result<(), Refusal> {
        let [low, high] = index.to_le_bytes();
        if (1..=4).contains(&data.len()) {
            let mut request = vec![0x23 | flags | (4 - data.len() as u8) << 2, low, high, sub];
            request.extend_from_slice(data);
            request.resize(8, 0);
            return self.sdo(station, &request).map(drop);
        }
        let mut request = vec![0x21 | flags, low, high, sub];
        request.extend_from_slice(&(data.len() as u32).to_le_bytes());
        let room = usize::from(self.mailboxes[0].1);
        let (now, mut rest) = data.split_at(data.len().min(room - 16));
        request.extend_from_slice(now);
        self.sdo(station, &request)?;
        let mut toggle = 0;
        while !rest.is_empty() {
            let (now, later) = rest.split_at(rest.len().min(room - 9));
            let unused = 7usize.saturating_sub(now.len()) as u8;
            let mut segment = vec![toggle | unused << 1 | u8::from(later.is_empty())];
            segment.extend_from_slice(now);
            segment.resize(segment.len().max(8), 0);
            let reply = self.sdo(station, &segment)?;
            assert_eq!(reply[0], 0x20 | toggle);
            toggle ^= 0x10;
            rest = later;
        }
        Ok(())
    }
}

/// Returns a whole mailbox of this length with the given header.
pub fn message(len: usize, header: [u8; 6], payload: &[u8]) -> Vec<u8> {
    let mut out = header.to_vec();
    out.extend_from_slice(payload);
    out.resize(len, 0);
    out
}

fn sm(usage: SmUse, start_address: u16, default_size: u16, control_byte: u8) -> SyncManager {
    SyncManager {
        position: Default::default(),
        usage,
        start_address,
        default_size,
        min_size: None,
        max_size: None,
        control_byte,
        enable: true,
        virtual_: false,
        op_only: false,
        watchdog: None,
    }
}

pub fn pdo(direction: Direction, index: u16, sm: u8, entries: &[(u16, u8, u16)]) -> Pdo {
    Pdo {
        position: Default::default(),
        direction,
        index,
        name: "PDO".into(),
        sm: Some(sm),
        fixed: false,
        mandatory: false,
        virtual_: false,
        overwritten_by_module: false,
        oversampling: None,
        exclude: Vec::new(),
        entries: entries
            .iter()
            .map(|(index, sub, bit_len)| Entry {
                position: Default::default(),
                index: *index,
                sub: *sub,
                bit_len: *bit_len,
                name: "entry".into(),
                data_type: "UINT".into(),
                depends_on: Default::default(),
            })
            .collect(),
        su: None,
        excluded_sm: Vec::new(),
        depends_on: Default::default(),
    }
}

/// Returns a digital I/O device without a mailbox: 16 bits out at SM0, 16 bits in at SM1.
pub fn io_device() -> Device {
    Device {
        identity: Identity {
            vendor: 0x111,
            product: 0x222,
            revision: 1,
        },
        type_name: "IO16".into(),
        physics: "KK".into(),
        fmmus: [FmmuUse::Outputs, FmmuUse::Inputs].map(Into::into).to_vec(),
        sync_managers: vec![
            sm(SmUse::Outputs, 0x1000, 2, 0x44),
            sm(SmUse::Inputs, 0x1100, 2, 0x00),
        ],
        rx_pdos: vec![pdo(
            Direction::Rx,
            0x1600,
            0,
            &[(0x7000, 1, 8), (0x7000, 2, 8)],
        )],
        tx_pdos: vec![pdo(
            Direction::Tx,
            0x1a00,
            1,
            &[(0x6000, 1, 8), (0x6000, 2, 8)],
        )],
        eeprom: Eeprom {
            byte_size: 2048,
            config_data: vec![4, 0, 0, 0x44],
            bootstrap: Vec::new(),
            ..Eeprom::default()
        },
        ..Device::default()
    }
}

pub fn item(sub: u8, bit_len: u32, bit_offset: u32, write: Writable, default: &[u8]) -> ObjectItem {
    ObjectItem {
        sub,
        name: format!("item {sub}").into(),
        type_name: "UDINT".into(),
        bit_len,
        bit_offset,
        default: default
            .iter()
            .copied()
            .chain([0; 256])
            .take(bit_len.div_ceil(8) as usize)
            .collect(),
        has_default: true,
        min: None,
        max: None,
        access: Access { read: true, write },
        pdo_mapping: PdoMapping { rx: true, tx: true },
        ..ObjectItem::default()
    }
}

pub fn object(index: u16, items: Vec<ObjectItem>) -> Object {
    Object {
        index,
        name: format!("object {index:04x}").into(),
        items,
        ..Object::default()
    }
}

/// Returns a device with mailboxes of 48 bytes, configurable PDOs, distributed clocks and some test
/// objects.
pub fn coe_device() -> Device {
    let rw = Writable::Always;
    let mut limited = item(0, 32, 0, rw, &[5]);
    limited.min = Some([2, 0, 0, 0].into());
    limited.max = Some([10, 0, 0, 0].into());
    let pre_op = Writable::Only {
        pre_op: true,
        safe_op: false,
        op: false,
    };
    Device {
        identity: Identity {
            vendor: 0x333,
            product: 0x444,
            revision: 2,
        },
        type_name: "COE".into(),
        physics: "YY".into(),
        fmmus: [FmmuUse::Outputs, FmmuUse::Inputs, FmmuUse::MBoxState]
            .map(Into::into)
            .to_vec(),
        sync_managers: vec![
            sm(SmUse::MBoxOut, 0x1000, 48, 0x26),
            sm(SmUse::MBoxIn, 0x1030, 48, 0x22),
            sm(SmUse::Outputs, 0x1100, 4, 0x64),
            sm(SmUse::Inputs, 0x1200, 4, 0x20),
        ],
        rx_pdos: vec![pdo(
            Direction::Rx,
            0x1600,
            2,
            &[(0x7010, 1, 16), (0x7010, 2, 16)],
        )],
        tx_pdos: vec![pdo(
            Direction::Tx,
            0x1a00,
            3,
            &[(0x6010, 1, 16), (0x6010, 2, 16)],
        )],
        mailbox: Some(Mailbox {
            coe: Some(Coe {
                pdo_assign: true,
                pdo_config: true,
                complete_access: true,
                segmented_sdo: true,
                ..Coe::default()
            }),
            ..Mailbox::default()
        }),
        dc_modes: vec![DcMode {
            name: "DC".into(),
            assign_activate: 0x300,
            ..DcMode::default()
        }],
        dictionary: Dictionary {
            objects: vec![
                object(0x2000, vec![limited]),
                object(0x2001, vec![item(0, 16, 0, pre_op, &[0x34, 0x12])]),
                object(0x2002, vec![item(0, 1600, 0, rw, &[1, 2, 3])]),
                object(0x2003, vec![item(0, 32, 0, Writable::Never, &[7])]),
                object(
                    0x2004,
                    vec![
                        item(0, 8, 0, Writable::Never, &[3]),
                        item(1, 8, 16, rw, &[0x11]),
                        item(2, 32, 24, rw, &[0x22]),
                        item(3, 16, 56, rw, &[0x33]),
                    ],
                ),
            ],
        },
        eeprom: Eeprom {
            byte_size: 2048,
            config_data: vec![8, 0, 0, 0x44],
            ..Eeprom::default()
        },
        ..Device::default()
    }
}

pub fn sim(device: &Device) -> SimDevice {
    sim_with(device, DeviceOptions::default())
}

pub fn sim_with(device: &Device, options: DeviceOptions) -> SimDevice {
    SimDevice::from_esi(device, &[], options).unwrap()
}

/// Returns the device for mailbox tests.
pub fn mailbox_device() -> Device {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../tests/judges/esi/mailbox.xml");
    let file = ecaxis_esi::parse(&std::fs::read(path).unwrap()).unwrap();
    assert!(file.warnings.is_empty(), "{:?}", file.warnings);
    file.devices.into_iter().next().unwrap()
}

/// Returns [`mailbox_device`] in PreOp with mailboxes of this many bytes each.
pub fn mailbox_bus(len: u16, options: DeviceOptions) -> Bus {
    let mut bus = Bus::new(vec![sim_with(&mailbox_device(), options)]);
    bus.mailboxes = [(0x1000, len), (0x1600, len)];
    bus.address_all();
    bus.preop(0x1001);
    bus
}

pub fn fixtures() -> PathBuf {
    std::env::var_os("ECAXIS_FIXTURES").map_or_else(
        || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../shared/fixtures"),
        PathBuf::from,
    )
}

/// Returns the bytes of a fixture. A missing fixture is printed and gives `None`; on CI it is a
/// failure.
pub fn fixture(path: &str) -> Option<Vec<u8>> {
    match std::fs::read(fixtures().join(path)) {
        Ok(bytes) => Some(bytes),
        Err(error) => {
            assert!(std::env::var_os("CI").is_none(), "fixture {path}: {error}");
            eprintln!("skipped: fixture {path}: {error}");
            None
        }
    }
}
