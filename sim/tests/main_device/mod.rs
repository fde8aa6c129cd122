//! A MainDevice that follows only the standard. It learns a SubDevice from its EEPROM and, over
//! CoE, from its PDO assignment. It then configures SyncManagers and FMMUs and goes to Op. It uses
//! no ESI and shares no code with the simulator or the project's own MainDevice.
#![allow(dead_code, reason = "every test binary uses its own part")]

use super::common::{Bus, INIT, OP, PREOP, SAFEOP};

/// The area and usage of a SyncManager.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sm {
    pub start: u16,
    pub len: u16,
    pub control: u8,
    /// 1 mailbox out, 2 mailbox in, 3 outputs, 4 inputs.
    pub usage: u8,
    /// The bits of process data.
    pub bits: usize,
}

/// One SubDevice as its EEPROM describes it.
#[derive(Debug, Clone, Default)]
pub struct Learned {
    pub image: Vec<u8>,
    pub sms: Vec<Sm>,
    /// Protocols of SII word 0x1C.
    pub protocols: u16,
    /// Receive and send mailbox: start and length; zero without a mailbox.
    pub mailbox: [(u16, u16); 2],
    /// The counter of the last mailbox message sent.
    counter: u8,
}

/// A SubDevice with FMMUs configured: outputs and inputs begin at the same logical address.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Mapped {
    pub logical: u32,
    /// The output size in bytes.
    pub outputs: usize,
    pub inputs: usize,
    fmmus: u16,
}

impl Mapped {
    /// Returns the working counter of an LRW over the whole area: 2 for outputs plus 1 for inputs,
    /// regardless of the number of FMMUs.
    pub fn working_counter(&self) -> u16 {
        2 * u16::from(self.outputs > 0) + u16::from(self.inputs > 0)
    }

    pub fn len(&self) -> usize {
        self.outputs.max(self.inputs)
    }
}

const COE: u16 = 4;

fn word(image: &[u8], at: usize) -> u16 {
    image
        .get(at * 2..at * 2 + 2)
        .map_or(0, |b| u16::from_le_bytes([b[0], b[1]]))
}

/// Reads the EEPROM through its registers, 4 or 8 bytes at a time, up to the end of the categories.
pub fn read_eeprom(bus: &mut Bus, station: u16) -> Vec<u8> {
    bus.write(station, 0x500, &[0]);
    let mut image = Vec::new();
    let mut category = 0x40;
    loop {
        let at = image.len() / 2;
        while category + 2 <= at && word(&image, category) != 0xffff {
            category += 2 + usize::from(word(&image, category + 1));
        }
        let ended = category < at && word(&image, category) == 0xffff;
        if ended || at > 0x8000 {
            return image;
        }
        let mut request = vec![0, 1];
        request.extend_from_slice(&(at as u32).to_le_bytes());
        bus.write(station, 0x502, &request);
        let status = loop {
            match bus.read_u16(station, 0x502) {
                busy if busy & 0x8000 != 0 => bus.wait(10_000),
                status => break status,
            }
        };
        assert_eq!(status & 0x7800, 0, "EEPROM status 0x{status:04x}");
        let len = if status & 0x40 != 0 { 8 } else { 4 };
        image.extend(bus.read(station, 0x508, len));
    }
}

/// Reads the parts of categories 40 to 51 that are needed here.
pub fn learn(bus: &mut Bus, station: u16) -> Learned {
    let image = read_eeprom(bus, station);
    let pair = |at| (word(&image, at), word(&image, at + 1));
    let mut learned = Learned {
        protocols: word(&image, 0x1c),
        mailbox: [pair(0x18), pair(0x1a)],
        ..Learned::default()
    };
    let mut bits = [0; 256];
    let mut at = 0x40;
    while word(&image, at) != 0xffff && at * 2 < image.len() {
        let (kind, words) = pair(at);
        let data = image.get(at * 2 + 4..).unwrap_or_default();
        let data = data.get(..usize::from(words) * 2).unwrap_or_default();
        match kind {
            41 => learned.sms.extend(data.chunks_exact(8).map(|sm| Sm {
                start: word(sm, 0),
                len: word(sm, 1),
                control: sm[4],
                usage: if sm[6] & 1 != 0 || sm[7] > 2 {
                    sm[7]
                } else {
                    0
                },
                bits: 0,
            })),
            50 | 51 => {
                let mut rest = data;
                while let [_, _, count, sm, _, _, _, _, entries @ ..] = rest {
                    let (own, next) = entries.split_at(entries.len().min(usize::from(*count) * 8));
                    bits[usize::from(*sm)] += own
                        .chunks_exact(8)
                        .map(|e| usize::from(e[5]))
                        .sum::<usize>();
                    rest = next;
                }
            }
            _ => {}
        }
        at += 2 + usize::from(words);
    }
    learned.sms.truncate(8);
    for (sm, bits) in learned.sms.iter_mut().zip(bits) {
        sm.bits = bits;
    }
    learned.image = image;
    learned
}

/// A mailbox client for mailboxes at any address and of any length.
pub struct Mailbox {
    station: u16,
    areas: [(u16, u16); 2],
    counter: u8,
}

impl Mailbox {
    pub fn new(station: u16, learned: &Learned) -> Self {
        Self {
            station,
            areas: learned.mailbox,
            counter: learned.counter,
        }
    }

    fn exchange(&mut self, bus: &mut Bus, payload: &[u8]) -> Result<Vec<u8>, String> {
        self.counter = self.counter % 7 + 1;
        let [(out, out_len), (inn, in_len)] = self.areas;
        let mut message = (payload.len() as u16).to_le_bytes().to_vec();
        message.extend_from_slice(&[0, 0, 0, 3 | self.counter << 4]);
        message.extend_from_slice(payload);
        message.resize(usize::from(out_len), 0);
        bus.write(self.station, out, &message);
        for _ in 0..50 {
            bus.wait(200_000);
            let (data, counter) = bus.datagram(4, self.station, inn, &vec![0; usize::from(in_len)]);
            if counter == 1 {
                let len = usize::from(word(&data, 0));
                let body = data
                    .get(6..6 + len)
                    .ok_or("a reply longer than its mailbox")?;
                return match data[5] & 0x0f {
                    3 => Ok(body.to_vec()),
                    _ => Err(format!("mailbox error {body:02x?}")),
                };
            }
        }
        Err("no reply".into())
    }

    /// Runs an SDO upload. An abort is an error with its code.
    pub fn upload(&mut self, bus: &mut Bus, index: u16, sub: u8) -> Result<Vec<u8>, String> {
        let [low, high] = index.to_le_bytes();
        let first = self.exchange(bus, &[0, 0x20, 0x40, low, high, sub, 0, 0, 0, 0])?;
        let (command, rest) = (first[2], &first[6..]);
        if command == 0x80 {
            return Err(format!(
                "0x{index:04x}:{sub:02x}: abort {:08x}",
                number(&rest[..4])
            ));
        }
        if command & 2 != 0 {
            return Ok(rest[..4 - usize::from(command >> 2 & 3)].to_vec());
        }
        let size = number(&rest[..4]) as usize;
        let mut data = rest[4..].to_vec();
        let mut toggle = 0;
        while data.len() < size {
            let segment = self.exchange(bus, &[0, 0x20, 0x60 | toggle, 0, 0, 0, 0, 0, 0, 0])?;
            let unused = if segment.len() == 10 {
                usize::from(segment[2] >> 1 & 7)
            } else {
                0
            };
            data.extend_from_slice(&segment[3..segment.len() - unused]);
            toggle ^= 0x10;
        }
        Ok(data)
    }

    /// Runs an expedited SDO download of 1 to 4 bytes.
    pub fn download(
        &mut self,
        bus: &mut Bus,
        index: u16,
        sub: u8,
        data: &[u8],
    ) -> Result<(), String> {
        let [low, high] = index.to_le_bytes();
        let mut request = vec![0, 0x20, 0x23 | (4 - data.len() as u8) << 2, low, high, sub];
        request.extend_from_slice(data);
        request.resize(10, 0);
        let reply = self.exchange(bus, &request)?;
        if reply[2] == 0x80 {
            return Err(format!(
                "0x{index:04x}:{sub:02x}: abort {:08x}",
                number(&reply[6..10])
            ));
        }
        Ok(())
    }
}

pub fn number(bytes: &[u8]) -> u64 {
    bytes.iter().rev().fold(0, |n, b| n << 8 | u64::from(*b))
}

fn step(bus: &mut Bus, station: u16, state: u8) -> Result<(), String> {
    match bus.request(station, u16::from(state)) {
        (status, 0) if status == u16::from(state) => Ok(()),
        (status, code) => Err(format!(
            "state {state}: AL status 0x{status:04x}, code 0x{code:04x}"
        )),
    }
}

/// Goes from Init to PreOp with the mailboxes of the EEPROM.
pub fn to_preop(bus: &mut Bus, station: u16, learned: &Learned) -> Result<(), String> {
    if learned.mailbox[0].1 > 0 {
        for (n, area) in (0..).zip(learned.mailbox) {
            let control = learned.sms.get(usize::from(n)).map_or(0, |sm| sm.control);
            bus.sm(station, n, area.0, area.1, control);
        }
    }
    step(bus, station, PREOP)
}

/// Reads the bits of each process-data SyncManager from 0x1C10 + n and the PDOs assigned there.
fn ask_assignment(bus: &mut Bus, station: u16, learned: &mut Learned) -> Result<(), String> {
    let mut mailbox = Mailbox::new(station, learned);
    for (n, sm) in (0..).zip(&mut learned.sms) {
        if sm.usage < 3 {
            continue;
        }
        sm.bits = 0;
        let assignment = 0x1c10 + n;
        for sub in 1..=mailbox.upload(bus, assignment, 0)?[0] {
            let pdo = word(&mailbox.upload(bus, assignment, sub)?, 0);
            for entry in 1..=mailbox.upload(bus, pdo, 0)?[0] {
                let mapping = number(&mailbox.upload(bus, pdo, entry)?);
                sm.bits += (mapping & 0xff) as usize;
            }
        }
    }
    learned.counter = mailbox.counter;
    Ok(())
}

/// Configures process-data SyncManagers and FMMUs. Adjacent areas share an FMMU.
pub fn map(bus: &mut Bus, station: u16, learned: &Learned, logical: u32) -> Result<Mapped, String> {
    let mut mapped = Mapped {
        logical,
        ..Mapped::default()
    };
    let mut areas: Vec<(u8, u16, u16)> = Vec::new();
    for (n, sm) in (0..).zip(&learned.sms) {
        if sm.usage < 3 || sm.bits == 0 {
            continue;
        }
        let len = sm.bits.div_ceil(8) as u16;
        // Registers need no SyncManager.
        if sm.start >= 0x0f00 {
            bus.sm(station, n, sm.start, len, sm.control);
        }
        match areas.last_mut() {
            Some((usage, start, before)) if (*usage, *start + *before) == (sm.usage, sm.start) => {
                *before += len;
            }
            _ => areas.push((sm.usage, sm.start, len)),
        }
    }
    let fmmus = u16::from(bus.read(station, 4, 1)[0]);
    for (usage, start, len) in areas {
        let (kind, used) = match usage {
            3 => (2, &mut mapped.outputs),
            _ => (1, &mut mapped.inputs),
        };
        if mapped.fmmus >= fmmus {
            return Err(format!("more areas than its {fmmus} FMMUs"));
        }
        bus.fmmu(
            station,
            mapped.fmmus,
            logical + *used as u32,
            len,
            start,
            kind,
        );
        *used += usize::from(len);
        mapped.fmmus += 1;
    }
    Ok(mapped)
}

/// Goes from Init to Op, or returns the cause of the failure. Checks working counters in every
/// state: in PreOp an application keeps its SyncManagers closed, but an ESC with device emulation
/// does not.
pub fn bring_up(bus: &mut Bus, station: u16) -> Result<(Learned, Mapped), String> {
    let mut learned = learn(bus, station);
    step(bus, station, INIT)?;
    to_preop(bus, station, &learned)?;
    if learned.protocols & COE != 0 {
        ask_assignment(bus, station, &mut learned)?;
    }
    let mapped = map(bus, station, &learned, u32::from(station) << 16)?;
    let counter = |bus: &mut Bus| bus.logical(12, mapped.logical, &vec![0; mapped.len()]).1;
    let expect = |state: &str, counter: u16, expected: u16| {
        (counter == expected).then_some(()).ok_or(format!(
            "{state}: working counter {counter}, not {expected}, {mapped:?}"
        ))
    };
    if mapped.len() > 0 {
        let emulated = word(&learned.image, 0) & 0x0100 != 0;
        let open = mapped.working_counter() * u16::from(emulated);
        expect("PreOp", counter(bus), open)?;
    }
    step(bus, station, SAFEOP)?;
    if mapped.len() > 0 {
        expect("SafeOp", counter(bus), mapped.working_counter())?;
    }
    bus.first_outputs(station);
    step(bus, station, OP)?;
    for _ in 0..20 {
        if mapped.len() > 0 {
            expect("Op", counter(bus), mapped.working_counter())?;
        }
        bus.wait(1_000_000);
    }
    match bus.read_u16(station, 0x130) {
        8 => Ok((learned, mapped)),
        status => Err(format!("left Op by itself: AL status 0x{status:04x}")),
    }
}
