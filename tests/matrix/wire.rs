//! Converts the frames of a recording to the process data of each SubDevice, cycle by cycle:
//! datagrams and working counters (ETG.1000.4, 5.4), station addresses and FMMUs (6.6), AL control
//! (6.1). It knows the number of SubDevices only.

use std::collections::BTreeMap;

use super::pcapng::Packet;

const APWR: u8 = 2;
const FPWR: u8 = 5;
const BWR: u8 = 8;
const LRD: u8 = 10;
const LWR: u8 = 11;
const LRW: u8 = 12;
const STATION: u16 = 0x0010;
const FMMUS: u16 = 0x0600;
const FMMU_BYTES: usize = 16;
const FMMU_REGISTERS: usize = 16 * FMMU_BYTES;
/// Process data lies above the registers; FMMUs to registers carry mailbox status.
const PROCESS_RAM: u16 = 0x1000;
/// The bytes before the first datagram: Ethernet and EtherCAT header.
const HEADERS: usize = 16;
/// The maximum delay in cycles at which a reply is matched by its index.
const LATEST: usize = 200;

/// The process data of a SubDevice in one cycle.
#[derive(Debug, Clone, Default)]
pub struct Exchange {
    pub outputs: Vec<u8>,
    /// The inputs, with the time at which the reply was read.
    pub answer: Option<(u64, Vec<u8>)>,
}

#[derive(Debug)]
pub struct Cycle {
    /// The time of the first frame in ns of the run's clock.
    pub at: u64,
    /// In the order of the positions; `None` while a SubDevice is not in the process data.
    pub devices: Vec<Option<Exchange>>,
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

/// A section of the logical address space that an FMMU of a device maps.
#[derive(Debug, Clone, Copy)]
struct Region {
    logical: u32,
    bytes: u32,
}

impl Region {
    fn part<'a>(&self, datagram: &Datagram<'a>) -> Option<&'a [u8]> {
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

struct Reader {
    devices: usize,
    cycles: Vec<Cycle>,
    stations: BTreeMap<u16, usize>,
    fmmus: BTreeMap<u16, [u8; FMMU_REGISTERS]>,
    regions: BTreeMap<usize, Regions>,
    pending: Vec<Pending>,
    /// The logical addresses of the current cycle's datagrams.
    addresses: Vec<(u8, u32)>,
}

/// Returns the cycles of a bus of `devices` SubDevices.
pub fn read(packets: &[Packet<'_>], devices: usize) -> Result<Vec<Cycle>, String> {
    let mut reader = Reader {
        devices,
        cycles: Vec::new(),
        stations: BTreeMap::new(),
        fmmus: BTreeMap::new(),
        regions: BTreeMap::new(),
        pending: Vec::new(),
        addresses: Vec::new(),
    };
    for packet in packets {
        match datagrams(packet.frame) {
            Some(datagrams) if packet.sent => reader.sent(packet.at, packet.frame, &datagrams),
            Some(datagrams) => reader.received(packet.at, packet.frame, &datagrams),
            None if packet.sent => return Err(format!("malformed frame at {} ns", packet.at)),
            None => {}
        }
    }
    Ok(reader.cycles)
}

impl Reader {
    fn sent(&mut self, at: u64, frame: &[u8], datagrams: &[Datagram<'_>]) {
        let logical: Vec<(u8, u32)> = datagrams
            .iter()
            .filter(|datagram| self.carries_process_data(datagram))
            .map(|datagram| (datagram.command, datagram.address))
            .collect();
        if logical.is_empty() {
            self.acyclic(datagrams);
            return;
        }
        if self.cycles.is_empty() || logical.iter().any(|key| self.addresses.contains(key)) {
            self.addresses.clear();
            let devices = vec![None; self.devices];
            self.cycles.push(Cycle { at, devices });
        }
        self.addresses.extend(logical);
        let cycle = self.cycles.len() - 1;
        for (&position, regions) in &self.regions {
            let writes = |datagram: &&Datagram<'_>| matches!(datagram.command, LWR | LRW);
            let mut found = datagrams.iter().filter(writes);
            let outputs = regions
                .outputs
                .and_then(|of| found.find_map(|d| of.part(d)));
            if let (Some(bytes), Some(to)) = (outputs, self.cycles[cycle].devices.get_mut(position))
            {
                let outputs = bytes.to_vec();
                let answer = None;
                *to = Some(Exchange { outputs, answer });
            }
        }
        self.pending.retain(|of| of.cycle + LATEST > cycle);
        self.pending.push(Pending {
            cycle,
            source: frame[11],
            index: datagrams[0].index,
            frame: frame.to_vec(),
        });
    }

    fn carries_process_data(&self, datagram: &Datagram<'_>) -> bool {
        let covers = |region: Option<Region>| region.is_some_and(|of| of.part(datagram).is_some());
        let mut regions = self.regions.values();
        datagram.is_logical() && regions.any(|of| covers(of.outputs) || covers(of.inputs))
    }

    /// Processes bring-up data: station addresses and FMMUs.
    fn acyclic(&mut self, datagrams: &[Datagram<'_>]) {
        for datagram in datagrams {
            let (device, register) = (datagram.address as u16, (datagram.address >> 16) as u16);
            match (datagram.command, register) {
                (APWR, STATION) if datagram.data.len() == 2 => {
                    let station = u16::from_le_bytes([datagram.data[0], datagram.data[1]]);
                    let position = usize::from(device.wrapping_neg());
                    self.stations.insert(station, position);
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
                _ => {}
            }
        }
    }

    /// Reads the FMMUs of a station (ETG.1000.4, table 56: logical start address, length, physical
    /// start address at 8, read 1 and write 2 at 11, enable at 12). The regions of a device that
    /// returns stay those of its place.
    fn map(&mut self, station: u16) {
        let (Some(&position), Some(held)) = (self.stations.get(&station), self.fmmus.get(&station))
        else {
            return;
        };
        let regions = self.regions.entry(position).or_default();
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
    }

    /// Returns the expected working counter. A write counts 2 in an LRW, everything else 1
    /// (ETG.1000.4, 5.4.1.2).
    fn expected_counter(&self, datagram: &Datagram<'_>) -> u16 {
        let covers = |region: Option<Region>| region.is_some_and(|of| of.part(datagram).is_some());
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
            return;
        };
        let pending = self.pending.remove(found);
        let Some(sent) = self::datagrams(&pending.frame) else {
            return;
        };
        for (sent, datagram) in sent.iter().zip(datagrams) {
            if !self.carries_process_data(datagram) || datagram.command == LWR {
                continue;
            }
            let full = datagram.counter == self.expected_counter(datagram);
            for (&position, regions) in &self.regions {
                let parts = regions
                    .inputs
                    .and_then(|of| of.part(datagram).zip(of.part(sent)));
                let Some((bytes, as_sent)) = parts else {
                    continue;
                };
                // A missing device leaves the bytes as sent.
                if !full && bytes == as_sent {
                    continue;
                }
                let exchange = self.cycles[pending.cycle].devices.get_mut(position);
                if let Some(Some(exchange)) = exchange {
                    exchange.answer = Some((at, bytes.to_vec()));
                }
            }
        }
    }
}
