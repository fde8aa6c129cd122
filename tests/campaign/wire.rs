//! Converts frames to the data that each drive received and reported, cycle by cycle: EtherCAT
//! datagrams and working counters (ETG.1000.4, 5.4), FMMUs (ETG.1000.4, 6.6), AL control
//! (ETG.1000.4, 6.1). Addresses come from the recorded writes to FMMUs. The object order comes from
//! the generated machine.

use std::collections::BTreeMap;

use super::pcapng::Packet;

const APWR: u8 = 2;
const FPWR: u8 = 5;
const BWR: u8 = 8;
const LRD: u8 = 10;
const LWR: u8 = 11;
const LRW: u8 = 12;
const STATION: u16 = 0x0010;
const AL_CONTROL: u16 = 0x0120;
const FMMUS: u16 = 0x0600;
const FMMU_BYTES: usize = 16;
const FMMU_REGISTERS: usize = 16 * FMMU_BYTES;
/// Process data lies above the registers; FMMUs to registers carry mailbox status.
const PROCESS_RAM: u16 = 0x1000;
/// The bytes before the first datagram: Ethernet and EtherCAT header.
const HEADERS: usize = 16;

/// An object at a place of its device's process data, in bytes.
#[derive(Debug, Clone, Copy)]
pub struct Place {
    pub object: u16,
    pub at: usize,
}

/// Returns objects that follow one another from a byte on.
pub fn packed(objects: &[u16], from: usize) -> Vec<Place> {
    let mut at = from;
    let place = |&object: &u16| {
        let place = Place { object, at };
        at += size(object);
        place
    };
    objects.iter().map(place).collect()
}

/// The words of a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Profile {
    Cia402,
    /// S-0-0134 and S-0-0135 in place of 0x6040 and 0x6041 (IEC 61800-7-204).
    Sercos,
}

/// The judge's knowledge of a drive before it reads the recording.
#[derive(Debug, Clone)]
pub struct DriveLayout {
    pub position: u16,
    pub profile: Profile,
    pub outputs: Vec<Place>,
    pub inputs: Vec<Place>,
}

/// The first bytes of a device without a drive: outputs as sent, inputs as answered.
#[derive(Debug, Clone, Copy, Default)]
pub struct Terminal {
    pub sent: Option<u8>,
    pub heard: Option<u8>,
}

/// The output objects as sent.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Outputs {
    pub controlword: u16,
    pub mode: Option<i8>,
    pub position: Option<i32>,
    pub velocity: Option<i32>,
    pub torque: Option<i16>,
    pub profile_velocity: Option<u32>,
    pub profile_acceleration: Option<u32>,
    pub profile_deceleration: Option<u32>,
}

/// The input objects as the device wrote them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Inputs {
    pub statusword: u16,
    pub position: i32,
    pub mode: Option<i8>,
}

#[derive(Debug, Clone, Copy, Default)]
pub struct Exchange {
    pub sent: Outputs,
    /// The device's answer and the time at which the reply was read.
    pub heard: Option<(u64, Inputs)>,
}

#[derive(Debug, Clone)]
pub struct Cycle {
    /// Time since the first packet, in ns.
    pub at: u64,
    /// The time at which the last of its frames came back.
    pub back: Option<u64>,
    /// True if every device added its full working counter.
    pub complete: bool,
    /// The exchanges in drive order; `None` while a drive is not in the process data.
    pub drives: Vec<Option<Exchange>>,
    /// In the order of the terminals.
    pub terminals: Vec<Terminal>,
}

/// A write to AL control.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AlRequest {
    pub at: u64,
    /// The position; `None`: every device.
    pub position: Option<u16>,
    pub state: u8,
}

/// A write of an object by SDO.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Download {
    pub at: u64,
    pub station: u16,
    pub index: u16,
    pub sub: u8,
}

#[derive(Debug, Default)]
pub struct Wire {
    pub cycles: Vec<Cycle>,
    pub al_requests: Vec<AlRequest>,
    pub downloads: Vec<Download>,
    /// The times of sent frames that violate ETG.1000.4.
    pub malformed: Vec<u64>,
    pub duplicates: usize,
    pub seconds: f64,
}

#[derive(Debug, Clone, Copy)]
struct Datagram<'a> {
    command: u8,
    index: u8,
    address: u32,
    data: &'a [u8],
    counter: u16,
}

impl Datagram<'_> {
    /// Returns the first half of the address: position or station.
    fn device(&self) -> u16 {
        self.address as u16
    }

    fn register(&self) -> u16 {
        (self.address >> 16) as u16
    }

    fn is_logical(&self) -> bool {
        matches!(self.command, LRD | LWR | LRW)
    }
}

fn datagrams(frame: &[u8]) -> Option<Vec<Datagram<'_>>> {
    if frame.get(12..14)? != [0x88, 0xa4] {
        return None;
    }
    let header = u16::from_le_bytes(frame.get(14..16)?.try_into().ok()?);
    let end = HEADERS + usize::from(header & 0x07ff);
    let body = frame.get(..end).filter(|_| header >> 12 == 1)?;
    let mut datagrams = Vec::new();
    let mut at = HEADERS;
    loop {
        let head = body.get(at..at + 10)?;
        let length = u16::from_le_bytes([head[6], head[7]]);
        let data_end = at + 10 + usize::from(length & 0x07ff);
        let counter = body.get(data_end..data_end + 2)?;
        datagrams.push(Datagram {
            command: head[0],
            index: head[1],
            address: u32::from_le_bytes([head[2], head[3], head[4], head[5]]),
            data: &body[at + 10..data_end],
            counter: u16::from_le_bytes([counter[0], counter[1]]),
        });
        at = data_end + 2;
        if length & 0x8000 == 0 {
            return Some(datagrams);
        }
    }
}

/// Reads an SDO request that begins a download (ETG.1000.6, 5.6.2.1) from a mailbox with CoE
/// (ETG.1000.4, 5.6: length, address, channel, type 3).
fn download(at: u64, datagram: &Datagram<'_>) -> Option<Download> {
    const COE: u8 = 3;
    const SDO_REQUEST: u8 = 2;
    const DOWNLOAD: u8 = 1;
    let held = datagram.data.get(..12)?;
    let is_mailbox = datagram.command == FPWR && datagram.register() >= PROCESS_RAM;
    let is_download =
        held[5] & 0x0f == COE && held[7] >> 4 == SDO_REQUEST && held[8] >> 5 == DOWNLOAD;
    (is_mailbox && is_download).then(|| Download {
        at,
        station: datagram.device(),
        index: u16::from_le_bytes([held[9], held[10]]),
        sub: held[11],
    })
}

/// A section of the logical address space that an FMMU of a device maps.
#[derive(Debug, Clone, Copy)]
struct Region {
    logical: u32,
    bytes: u32,
}

impl Region {
    fn of<'a>(&self, datagram: &Datagram<'a>) -> Option<&'a [u8]> {
        let from = self.logical.checked_sub(datagram.address)? as usize;
        datagram.data.get(from..from + self.bytes as usize)
    }
}

#[derive(Debug, Clone, Copy, Default)]
struct Regions {
    outputs: Option<Region>,
    inputs: Option<Region>,
}

/// The contents of a cyclic frame until its reply comes.
struct Pending {
    cycle: usize,
    source: u8,
    index: u8,
    frame: Vec<u8>,
}

struct Reader<'a> {
    drives: &'a [DriveLayout],
    /// The positions of devices without a drive.
    terminals: &'a [u16],
    wire: Wire,
    stations: BTreeMap<u16, u16>,
    fmmus: BTreeMap<u16, [u8; FMMU_REGISTERS]>,
    /// The regions of every device in the process data, by position.
    regions: BTreeMap<u16, Regions>,
    pending: Vec<Pending>,
    answered: Vec<(u8, u8, usize)>,
    /// The logical addresses of the current cycle's datagrams.
    addresses: Vec<(u8, u32)>,
    cycle_complete: bool,
}

/// The maximum delay in cycles at which a reply is matched by its index.
const LATEST: usize = 200;

/// Reads the recording of a machine with these drives and terminals.
pub fn read(packets: &[Packet<'_>], drives: &[DriveLayout], terminals: &[u16]) -> Wire {
    let mut reader = Reader {
        drives,
        terminals,
        wire: Wire::default(),
        stations: BTreeMap::new(),
        fmmus: BTreeMap::new(),
        regions: BTreeMap::new(),
        pending: Vec::new(),
        answered: Vec::new(),
        addresses: Vec::new(),
        cycle_complete: true,
    };
    let start = packets.first().map_or(0, |packet| packet.at);
    for packet in packets {
        let at = packet.at - start;
        match datagrams(packet.frame) {
            Some(datagrams) if packet.sent => reader.sent(at, packet.frame, &datagrams),
            Some(datagrams) => reader.received(at, packet.frame, &datagrams),
            None if packet.sent => reader.wire.malformed.push(at),
            None => {}
        }
        reader.wire.seconds = at as f64 * 1e-9;
    }
    reader.wire
}

impl Reader<'_> {
    fn sent(&mut self, at: u64, frame: &[u8], datagrams: &[Datagram<'_>]) {
        let downloads = datagrams
            .iter()
            .filter_map(|datagram| download(at, datagram));
        self.wire.downloads.extend(downloads);
        let logical: Vec<(u8, u32)> = datagrams
            .iter()
            .filter(|datagram| self.carries_process_data(datagram))
            .map(|datagram| (datagram.command, datagram.address))
            .collect();
        if logical.is_empty() {
            self.acyclic(at, datagrams);
            return;
        }
        if self.wire.cycles.is_empty() || logical.iter().any(|key| self.addresses.contains(key)) {
            self.begin_cycle(at);
        }
        self.addresses.extend(logical);
        let cycle = self.wire.cycles.len() - 1;
        for (drive, layout) in self.drives.iter().enumerate() {
            let Some(region) = self.regions.get(&layout.position).and_then(|of| of.outputs) else {
                continue;
            };
            let writes = |datagram: &&Datagram<'_>| matches!(datagram.command, LWR | LRW);
            let mut found = datagrams.iter().filter(writes);
            if let Some(bytes) = found.find_map(|datagram| region.of(datagram)) {
                let sent = outputs(layout, bytes);
                self.wire.cycles[cycle].drives[drive] = Some(Exchange { sent, heard: None });
            }
        }
        for (number, position) in self.terminals.iter().enumerate() {
            let region = self.regions.get(position).and_then(|of| of.outputs);
            let writes = |datagram: &&Datagram<'_>| matches!(datagram.command, LWR | LRW);
            let bytes = region.and_then(|of| {
                let mut found = datagrams.iter().filter(writes);
                found.find_map(|datagram| of.of(datagram))
            });
            if let Some(bytes) = bytes {
                self.wire.cycles[cycle].terminals[number].sent = bytes.first().copied();
            }
        }
        let (source, index) = (frame[11], datagrams[0].index);
        self.pending.retain(|of| of.cycle + LATEST > cycle);
        self.answered.retain(|of| of.2 + LATEST > cycle);
        self.pending.push(Pending {
            cycle,
            source,
            index,
            frame: frame.to_vec(),
        });
    }

    fn begin_cycle(&mut self, at: u64) {
        self.addresses.clear();
        self.cycle_complete = true;
        self.wire.cycles.push(Cycle {
            at,
            back: None,
            complete: false,
            drives: vec![None; self.drives.len()],
            terminals: vec![Terminal::default(); self.terminals.len()],
        });
    }

    fn carries_process_data(&self, datagram: &Datagram<'_>) -> bool {
        let covers = |region: Option<Region>| region.is_some_and(|of| of.of(datagram).is_some());
        datagram.is_logical()
            && self
                .regions
                .values()
                .any(|of| covers(of.outputs) || covers(of.inputs))
    }

    /// Processes bring-up data: station addresses, FMMUs, states.
    fn acyclic(&mut self, at: u64, datagrams: &[Datagram<'_>]) {
        for datagram in datagrams {
            let (device, register) = (datagram.device(), datagram.register());
            match (datagram.command, register) {
                (APWR, STATION) if datagram.data.len() == 2 => {
                    let station = u16::from_le_bytes([datagram.data[0], datagram.data[1]]);
                    self.stations.insert(station, device.wrapping_neg());
                }
                (FPWR, FMMUS..) if usize::from(register - FMMUS) < FMMU_REGISTERS => {
                    let from = usize::from(register - FMMUS);
                    let held = self.fmmus.entry(device).or_insert([0; FMMU_REGISTERS]);
                    for (to, byte) in held[from..].iter_mut().zip(datagram.data) {
                        *to = *byte;
                    }
                    self.map(device);
                }
                (BWR, FMMUS) => {
                    self.fmmus.clear();
                    self.regions.clear();
                }
                (APWR | FPWR | BWR, AL_CONTROL) if !datagram.data.is_empty() => {
                    let position = match datagram.command {
                        APWR => Some(device.wrapping_neg()),
                        FPWR => self.stations.get(&device).copied(),
                        _ => None,
                    };
                    let state = datagram.data[0] & 0x0f;
                    self.wire.al_requests.push(AlRequest {
                        at,
                        position,
                        state,
                    });
                }
                _ => {}
            }
        }
    }

    /// Reads the FMMUs of a station (ETG.1000.4, table 56: logical start address, length, physical
    /// start address at 8, read 1 and write 2 at 11, enable at 12).
    fn map(&mut self, station: u16) {
        let (Some(&position), Some(held)) = (self.stations.get(&station), self.fmmus.get(&station))
        else {
            return;
        };
        let mut regions = Regions::default();
        for fmmu in held.chunks(FMMU_BYTES).filter(|fmmu| fmmu[12] & 1 == 1) {
            let region = Region {
                logical: u32::from_le_bytes([fmmu[0], fmmu[1], fmmu[2], fmmu[3]]),
                bytes: u32::from(u16::from_le_bytes([fmmu[4], fmmu[5]])),
            };
            if u16::from_le_bytes([fmmu[8], fmmu[9]]) < PROCESS_RAM {
                continue;
            }
            if fmmu[11] & 2 != 0 {
                regions.outputs = Some(region);
            }
            if fmmu[11] & 1 != 0 {
                regions.inputs = Some(region);
            }
        }
        self.regions.insert(position, regions);
    }

    /// Returns the expected working counter. A write counts 2 in an LRW, everything else 1
    /// (ETG.1000.4, 5.4.1.2).
    fn expected_counter(&self, datagram: &Datagram<'_>) -> u16 {
        let covers = |region: Option<Region>| region.is_some_and(|of| of.of(datagram).is_some());
        let share = |of: &Regions| {
            let reads = u16::from(datagram.command != LWR && covers(of.inputs));
            let writes = u16::from(datagram.command != LRD && covers(of.outputs));
            reads + writes * if datagram.command == LRW { 2 } else { 1 }
        };
        self.regions.values().map(share).sum()
    }

    fn received(&mut self, at: u64, frame: &[u8], datagrams: &[Datagram<'_>]) {
        let (source, index) = (frame[11], datagrams[0].index);
        let same = |of: &Pending| {
            of.source == source && of.index == index && of.frame.len() == frame.len()
        };
        let Some(found) = self.pending.iter().rposition(same) else {
            self.duplicates(source, index);
            return;
        };
        let pending = self.pending.remove(found);
        self.answered.push((source, index, pending.cycle));
        let newest = self.wire.cycles.len() - 1;
        let mut complete = true;
        let Some(sent) = self::datagrams(&pending.frame) else {
            return;
        };
        for (sent, datagram) in sent.iter().zip(datagrams) {
            if !self.carries_process_data(datagram) {
                continue;
            }
            let full = datagram.counter == self.expected_counter(datagram);
            complete &= full;
            for (drive, layout) in self.drives.iter().enumerate() {
                let regions = self.regions.get(&layout.position);
                let Some(region) = regions.and_then(|of| of.inputs) else {
                    continue;
                };
                let (Some(bytes), Some(as_sent)) = (region.of(datagram), region.of(sent)) else {
                    continue;
                };
                // A missing device leaves the bytes as sent.
                if datagram.command == LWR || !full && bytes == as_sent {
                    continue;
                }
                if let Some(exchange) = &mut self.wire.cycles[pending.cycle].drives[drive] {
                    let heard = inputs(layout, bytes, &exchange.sent);
                    exchange.heard = Some((at, heard));
                }
            }
            for (number, position) in self.terminals.iter().enumerate() {
                let region = self.regions.get(position).and_then(|of| of.inputs);
                let bytes = region.and_then(|of| of.of(datagram));
                if let Some(bytes) = bytes.filter(|_| datagram.command != LWR && full) {
                    self.wire.cycles[pending.cycle].terminals[number].heard =
                        bytes.first().copied();
                }
            }
        }
        let cycle = &mut self.wire.cycles[pending.cycle];
        let last = pending.cycle == newest;
        if last {
            self.cycle_complete &= complete;
        }
        if !self.pending.iter().any(|of| of.cycle == pending.cycle) {
            cycle.back = Some(at);
            cycle.complete = if last { self.cycle_complete } else { complete };
        }
    }

    fn duplicates(&mut self, source: u8, index: u8) {
        if self
            .answered
            .iter()
            .any(|of| (of.0, of.1) == (source, index))
        {
            self.wire.duplicates += 1;
        }
    }
}

/// Returns the size in bytes of a CiA 402 object (IEC 61800-7-201, table 1).
fn size(object: u16) -> usize {
    match object {
        0x6060 | 0x6061 => 1,
        0x6040 | 0x6041 | 0x6071 | 0x6077 | 0x60b2 | 0x60b8 | 0x60b9 => 2,
        _ => 4,
    }
}

/// Splits the data into its objects.
fn objects<'a>(
    layout: &'a [Place],
    bytes: &'a [u8],
) -> impl Iterator<Item = (u16, [u8; 4])> + use<'a> {
    layout.iter().map_while(move |&Place { object, at }| {
        let piece = bytes.get(at..at + size(object))?;
        let mut held = [0; 4];
        held[..piece.len()].copy_from_slice(piece);
        Some((object, held))
    })
}

/// The position mode of drives behind a gateway is CSP.
fn mode(held: [u8; 4]) -> i8 {
    match held[0].cast_signed() {
        -1 => 8,
        mode => mode,
    }
}

fn outputs(layout: &DriveLayout, bytes: &[u8]) -> Outputs {
    let mut outputs = Outputs::default();
    for (object, held) in objects(&layout.outputs, bytes) {
        let word = u16::from_le_bytes([held[0], held[1]]);
        let long = i32::from_le_bytes(held);
        match object {
            0x6040 if layout.profile == Profile::Sercos => outputs.controlword = controlword(word),
            0x6040 => outputs.controlword = word,
            0x6060 => outputs.mode = Some(mode(held)),
            0x607a | 0x2062 => outputs.position = Some(long),
            0x60ff => outputs.velocity = Some(long),
            0x6071 => outputs.torque = Some(word.cast_signed()),
            0x6081 => outputs.profile_velocity = Some(long.cast_unsigned()),
            0x6083 => outputs.profile_acceleration = Some(long.cast_unsigned()),
            0x6084 => outputs.profile_deceleration = Some(long.cast_unsigned()),
            _ => {}
        }
    }
    outputs
}

fn inputs(layout: &DriveLayout, bytes: &[u8], sent: &Outputs) -> Inputs {
    let mut inputs = Inputs::default();
    for (object, held) in objects(&layout.inputs, bytes) {
        let word = u16::from_le_bytes([held[0], held[1]]);
        match object {
            0x6041 if layout.profile == Profile::Sercos => {
                inputs.statusword = statusword(word, sent.controlword);
            }
            0x6041 => inputs.statusword = word,
            0x6064 => inputs.position = i32::from_le_bytes(held),
            0x6061 => inputs.mode = Some(mode(held)),
            _ => {}
        }
    }
    inputs
}

/// Returns the Controlword that says the same as S-0-0134: bit 15 drive on, bit 14 drive enable, bit
/// 13 drive halt.
fn controlword(master_control: u16) -> u16 {
    match master_control & 0xe000 {
        0xe000 => 0x000f,
        0x4000 | 0x6000 => 0x0002,
        _ => 0x0000,
    }
}

/// Returns the Statusword that says the same as S-0-0135: bits 15 and 14 readiness, bit 13 error of
/// class 1. A drive with torque that is not commanded to be on decelerates.
fn statusword(drive_status: u16, controlword: u16) -> u16 {
    match (drive_status >> 14, drive_status & 0x2000 != 0) {
        (3, false) if controlword & 0x0f == 0x0f => 0x1237,
        (3, false) => 0x0217,
        (3, true) => 0x021f,
        (_, true) => 0x0218,
        (2, false) => 0x0233,
        (1, false) => 0x0250,
        _ => 0x0200,
    }
}
