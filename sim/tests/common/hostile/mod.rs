//! Hostile frames: random commands, addresses, lengths and contents, most of them valid enough to
//! pass the first check. A seed determines the sequence.
#![allow(dead_code, reason = "every fuzz target uses its own part")]

mod messages;

use std::path::Path;

use ecaxis_esi::model::EsiFile;
use ecaxis_esi::{Mode, SelectOptions, select};
use ecaxis_sim::frame::{self, Command, FrameBuilder, Kind};
use ecaxis_sim::{AlState, DeviceOptions, FaultScript, FrameOutcome, Segment, SimDevice};

use crate::common::{Bus, INIT, OP, PREOP, SAFEOP};
use messages::message;

const ETHERNET: usize = 14;
const HEADER: usize = 10;
const MAX_FRAME: usize = 1514;

/// The source of all random values: SplitMix64.
#[derive(Debug, Clone)]
pub struct Dice(u64);

impl Dice {
    pub fn new(seed: u64) -> Self {
        Self(seed)
    }

    pub fn roll(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ z >> 31
    }

    /// Returns a number below `n`.
    pub fn below(&mut self, n: usize) -> usize {
        (self.roll() % n.max(1) as u64) as usize
    }

    pub fn percent(&mut self, share: usize) -> bool {
        self.below(100) < share
    }

    pub fn pick<T: Copy>(&mut self, from: &[T]) -> T {
        from[self.below(from.len())]
    }

    pub fn bytes(&mut self, len: usize) -> Vec<u8> {
        (0..len).map(|_| self.roll() as u8).collect()
    }
}

/// The attacker's knowledge of a device.
#[derive(Debug, Clone)]
struct Victim {
    station: u16,
    /// Address and length of the write and read mailbox.
    mailboxes: Option<[(u16, u16); 2]>,
    /// SyncManager number, start, length, control byte.
    process: Vec<(u16, u16, u16, u8)>,
    /// The same for all SyncManagers, mailboxes included.
    sync_managers: Vec<(u16, u16, u16, u8)>,
}

/// A bus that is brought up normally and then attacked.
pub struct Hostile {
    pub dice: Dice,
    pub bus: Bus,
    victims: Vec<Victim>,
    fresh: Vec<SimDevice>,
    files: Vec<EsiFile>,
    /// Frames to send first, as a MainDevice would continue.
    queue: Vec<Vec<u8>>,
    pub answered: u64,
    pub processed: u64,
    pub rebuilt: u64,
    /// The number of frames after which some device was in Op.
    pub in_op: u64,
}

/// Returns one device of one of the project's ESI files.
fn own(path: &str, type_name: &str) -> EsiFile {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let mut file = ecaxis_esi::parse(&std::fs::read(root.join(path)).unwrap()).unwrap();
    file.devices.retain(|device| device.type_name == type_name);
    assert_eq!(file.devices.len(), 1, "{path}: {type_name}");
    file
}

impl Hostile {
    /// Returns two drives, a mailbox test device, a coupler, digital terminals and a gateway.
    pub fn new(seed: u64) -> Self {
        let terminals = "configs/esi/terminals.xml";
        let files = vec![
            own("configs/esi/EPOS4.xml", "EPOS4"),
            own("configs/esi/IDX.xml", "IDX"),
            own("tests/judges/esi/mailbox.xml", "Mailbox"),
            own(terminals, "CP0"),
            own(terminals, "DI8"),
            own(terminals, "DO8"),
            own("configs/esi/IO8.xml", "IO8"),
            own("configs/esi/gateway.xml", "GW16"),
        ];
        let fresh: Vec<SimDevice> = files
            .iter()
            .map(|file| {
                let options = DeviceOptions::default();
                SimDevice::from_esi(&file.devices[0], &file.modules, options).unwrap()
            })
            .collect();
        let mut hostile = Self {
            dice: Dice::new(seed),
            bus: Bus::new(Vec::new()),
            victims: Vec::new(),
            fresh,
            files,
            queue: Vec::new(),
            answered: 0,
            processed: 0,
            rebuilt: 0,
            in_op: 0,
        };
        hostile.rebuild();
        hostile
    }

    /// Rebuilds the bus. After some hundred hostile frames few devices still answer.
    pub fn rebuild(&mut self) {
        self.rebuilt += 1;
        self.queue.clear();
        self.victims.clear();
        self.bus = Bus::new(self.fresh.clone());
        let bus = &mut self.bus;
        let _ = bus.address_all();
        for (n, file) in self.files.iter().enumerate() {
            let device = &file.devices[0];
            let station = 0x1001 + n as u16;
            let choice = SelectOptions {
                mode: (device.profile == Some(402)).then_some(Mode::Csp),
                cycle_ns: 1_000_000,
                ..SelectOptions::default()
            };
            let selection = select(file, device, &choice).unwrap();
            let mut victim = Victim {
                station,
                mailboxes: None,
                process: Vec::new(),
                sync_managers: Vec::new(),
            };
            if device.mailbox.is_some() {
                let [out, back] = [0, 1].map(|sm| {
                    let sm = &device.sync_managers[sm];
                    (sm.start_address, sm.default_size)
                });
                bus.mailboxes = [out, back];
                bus.start_mailboxes(station);
                victim.mailboxes = Some([out, back]);
                victim.sync_managers = vec![(0, out.0, out.1, 0x26), (1, back.0, back.1, 0x22)];
            }
            bus.to(station, PREOP);
            let layout = &selection.layout;
            let logical = 0x40 * n as u32;
            for (fmmu, (sms, kind)) in [(&layout.outputs, 2), (&layout.inputs, 1)]
                .iter()
                .enumerate()
            {
                for sm in sms.iter() {
                    let (number, start) = (u16::from(sm.sm), sm.start_address);
                    bus.sm(station, number, start, sm.len, sm.control_byte);
                    bus.fmmu(station, fmmu as u16, logical, sm.len, start, *kind);
                    victim
                        .process
                        .push((number, start, sm.len, sm.control_byte));
                }
            }
            bus.to(station, SAFEOP);
            bus.to(station, OP);
            victim.sync_managers.extend(&victim.process);
            self.victims.push(victim);
        }
    }

    /// Replaces one device. The bus is not brought up.
    pub fn replace(&mut self, position: usize, device: SimDevice) {
        let mut devices = self.fresh.clone();
        devices[position] = device;
        self.bus = Bus::new(devices);
    }

    /// Rebuilds the bus with faults, without bringing it up.
    pub fn rebuild_with(&mut self, faults: FaultScript) {
        self.bus = Bus::new(self.fresh.clone());
        self.bus.segment.set_faults(faults);
    }

    /// Sends one frame and checks the invariants of every answer.
    pub fn attack(&mut self) {
        let sent = match self.queue.pop() {
            Some(frame) => frame,
            None if self.dice.percent(6) => self.corrected(),
            None => self.frame(),
        };
        let back = exchange(&mut self.bus.segment, self.bus.now, &sent);
        self.answered += u64::from(back.is_some());
        self.processed += u64::from(back.is_some_and(|back| wkc(&back) > 0));
        let mut devices = (0..self.victims.len()).filter_map(|n| self.bus.segment.device(n));
        self.in_op += u64::from(devices.any(|d| d.al_state() == AlState::Op));
        let step = match self.dice.below(100) {
            0..90 => self.dice.below(20_000),
            90..99 => self.dice.below(500_000),
            _ => self.dice.below(20_000_000),
        };
        self.bus.now += step as u64;
    }

    /// Sets a device up for the most effective attack: its own address, its own SyncManagers, then
    /// towards Op.
    fn corrected(&mut self) -> Vec<u8> {
        let n = self.dice.below(self.victims.len());
        let victim = &self.victims[n];
        let position = 0_u16.wrapping_sub(n as u16);
        let mut frame = FrameBuilder::default()
            .datagram(2, position, 0x100, &[1, 0, 7, 0])
            .datagram(2, position, 0x010, &victim.station.to_le_bytes());
        for (number, start, len, control) in &victim.sync_managers {
            let (s, l) = (start.to_le_bytes(), len.to_le_bytes());
            let r = [s[0], s[1], l[0], l[1], *control, 0, 1, 0];
            frame = frame
                .datagram(2, position, 0x806 + number * 8, &[0])
                .datagram(2, position, 0x800 + number * 8, &r);
        }
        let next = match self.bus.segment.device(n).map(SimDevice::al_state) {
            Some(AlState::Init) => PREOP,
            Some(AlState::PreOp) => SAFEOP,
            Some(AlState::SafeOp) => OP,
            _ => INIT,
        };
        let acknowledge = 0x10;
        frame
            .datagram(2, position, 0x120, &[next | acknowledge, 0])
            .build()
    }

    fn frame(&mut self) -> Vec<u8> {
        if self.dice.percent(2) {
            let len = self.dice.below(MAX_FRAME + 1);
            let mut bytes = self.dice.bytes(len);
            if let Some(ethertype) = bytes.get_mut(12..14)
                && self.dice.percent(80)
            {
                ethertype.copy_from_slice(&[0x88, 0xa4]);
            }
            return bytes;
        }
        let mut bytes = vec![0xff; 6];
        bytes.extend_from_slice(&[0x10, 0x10, 0x10, 0x10, 0x10, 0x10, 0x88, 0xa4, 0, 0]);
        let mut last = None;
        for _ in 0..=self.dice.below(4) {
            let room = MAX_FRAME.saturating_sub(bytes.len() + HEADER + 2);
            if let Some(last) = last {
                bytes[last + 7_usize] |= 0x80;
            }
            last = Some(bytes.len());
            self.datagram(&mut bytes, room);
        }
        let len = bytes.len() - ETHERNET - 2;
        bytes[ETHERNET..ETHERNET + 2].copy_from_slice(&(len as u16 & 0x7ff | 0x1000).to_le_bytes());
        if self.dice.percent(5) {
            self.spoil(&mut bytes);
        }
        if bytes.len() < 60 && self.dice.percent(50) {
            bytes.resize(60, 0xa5);
        }
        bytes
    }

    /// Creates inconsistent lengths and flags, and truncated frames.
    fn spoil(&mut self, bytes: &mut Vec<u8>) {
        match self.dice.below(3) {
            0 => bytes.truncate(self.dice.below(bytes.len())),
            1 => {
                let at = ETHERNET + self.dice.below(bytes.len() - ETHERNET);
                bytes[at] ^= 1 << self.dice.below(8);
            }
            _ => {
                // The length field of the first datagram.
                let at = ETHERNET + 2 + 6 + self.dice.below(2);
                bytes[at] = self.dice.roll() as u8;
            }
        }
    }

    fn datagram(&mut self, bytes: &mut Vec<u8>, room: usize) {
        let n = self.dice.below(self.victims.len());
        let victim = self.victims[n].clone();
        let command = match self.dice.below(100) {
            0..70 => self
                .dice
                .pick(&[1, 2, 4, 4, 4, 5, 5, 5, 5, 7, 10, 11, 12, 12]),
            70..97 => self.dice.below(15) as u8,
            _ => self.dice.roll() as u8,
        };
        let logical = (10..=12).contains(&command);
        let (mut adp, mut ado, mut data);
        if logical {
            let address = match self.dice.below(10) {
                0 => self.dice.roll() as u32,
                _ => self.dice.below(0x180) as u32,
            };
            (adp, ado) = (address as u16, (address >> 16) as u16);
            let len = self.dice.below(0x100);
            data = self.dice.bytes(len);
        } else {
            adp = match command {
                1..=3 | 13 => 0_u16.wrapping_sub(n as u16),
                _ => victim.station,
            };
            (ado, data) = self.aim(&victim, n);
            if self.dice.percent(3) {
                adp = self.dice.roll() as u16;
            }
            if self.dice.percent(3) {
                ado = self.dice.roll() as u16;
            }
        }
        if self.dice.percent(4) {
            let len = self.dice.below(room.min(1486) + 1);
            data = self.dice.bytes(len);
        }
        data.truncate(room);
        bytes.extend_from_slice(&[command, self.dice.roll() as u8]);
        bytes.extend_from_slice(&adp.to_le_bytes());
        bytes.extend_from_slice(&ado.to_le_bytes());
        bytes.extend_from_slice(&(data.len() as u16).to_le_bytes());
        bytes.extend_from_slice(&[0, 0]);
        bytes.extend_from_slice(&data);
        bytes.extend_from_slice(&[0, 0]);
    }

    /// Returns address and contents of an access that a device accepts.
    fn aim(&mut self, victim: &Victim, position: usize) -> (u16, Vec<u8>) {
        let len = self.dice.pick(&[1, 2, 2, 4, 4, 8, 8, 16, 32]);
        let random = self.dice.bytes(len);
        match self.dice.below(100) {
            0..30 => match victim.mailboxes {
                Some([out, back]) if self.dice.percent(70) => {
                    let message = message(&mut self.dice, usize::from(out.1));
                    self.read_later(victim.station, back);
                    (out.0, message)
                }
                Some([_, back]) => (back.0, vec![0; usize::from(back.1)]),
                None => (0x1000, random),
            },
            30..40 => match victim.process.get(self.dice.below(victim.process.len())) {
                Some((_, start, len, _)) => (*start, self.dice.bytes(usize::from(*len))),
                None => (0x1000, random),
            },
            40..50 => {
                let state = self
                    .dice
                    .pick(&[1, 2, 2, 3, 4, 4, 4, 8, 8, 8, 0x11, 0x12, 0x14, 0x18]);
                (0x120, vec![state, 0])
            }
            50..54 => (0x600 + 16 * self.dice.below(8) as u16, self.fmmu(victim)),
            54..58 => match victim.process.get(self.dice.below(victim.process.len())) {
                Some((n, start, len, control)) => {
                    let (s, l) = (start.to_le_bytes(), len.to_le_bytes());
                    let enable = self.dice.below(2) as u8;
                    let r = vec![s[0], s[1], l[0], l[1], *control, 0, enable, 0];
                    (0x800 + n * 8, r)
                }
                None => (0x800, random),
            },
            58..64 => {
                let command = self.dice.pick(&[1, 2, 3, 4, 0x81, 0x82]);
                let word = self.dice.below(0x480) as u32;
                let mut r = vec![command & 0x80, command & 7];
                r.extend_from_slice(&word.to_le_bytes());
                (0x502, r)
            }
            64..72 => self.clock(position),
            72..97 => {
                let register = self.dice.pick(&[
                    0x000, 0x010, 0x012, 0x020, 0x030, 0x040, 0x041, 0x100, 0x101, 0x103, 0x110,
                    0x120, 0x130, 0x134, 0x140, 0x150, 0x200, 0x204, 0x210, 0x220, 0x300, 0x308,
                    0x310, 0x400, 0x410, 0x420, 0x440, 0x442, 0x500, 0x502, 0x508, 0x600, 0x610,
                    0x800, 0x805, 0x808, 0x80d, 0x80e, 0x810, 0x900, 0x910, 0x918, 0x920, 0x928,
                    0x92c, 0x930, 0x934, 0x980, 0x981, 0x984, 0x990, 0x998, 0x9a0, 0x9a8, 0x9b0,
                    0xe00, 0xf00, 0xf80, 0x1000, 0x2ffe, 0xfffe,
                ]);
                // Random writes to the loop control and station address silence a device at once.
                (register, random)
            }
            _ => (self.dice.roll() as u16, random),
        }
    }

    fn fmmu(&mut self, victim: &Victim) -> Vec<u8> {
        let mut r = vec![0; 16];
        r[..4].copy_from_slice(&(self.dice.below(0x180) as u32).to_le_bytes());
        r[4..6].copy_from_slice(&(self.dice.below(0x80) as u16).to_le_bytes());
        r[6] = self.dice.roll() as u8 & 7;
        r[7] = self.dice.roll() as u8 & 7;
        let start = match victim
            .process
            .get(self.dice.below(victim.process.len() + 1))
        {
            Some((_, start, ..)) => *start,
            None => self.dice.roll() as u16,
        };
        r[8..10].copy_from_slice(&start.to_le_bytes());
        r[10] = self.dice.roll() as u8 & 7;
        (r[11], r[12]) = (self.dice.roll() as u8 & 3, 1);
        r
    }

    /// Returns distributed clock settings with future start times.
    fn clock(&mut self, position: usize) -> (u16, Vec<u8>) {
        let now = self.bus.now;
        let device = self.bus.segment.device(position);
        let system = device.and_then(|d| d.system_time(now)).unwrap_or(now);
        let soon = system.wrapping_add(self.dice.below(5_000_000) as u64);
        let random = self.dice.bytes(8);
        match self.dice.below(8) {
            0 => (0x990, soon.to_le_bytes().to_vec()),
            1 => (
                0x9a0,
                (self.dice.below(2_000_000) as u32).to_le_bytes().to_vec(),
            ),
            2 => (
                0x9a0,
                self.dice
                    .pick(&[0_u64, 1, 2, 1 << 32, 100_000])
                    .to_le_bytes()
                    .to_vec(),
            ),
            3 => (0x980, vec![0, self.dice.pick(&[0, 1, 3, 3, 3, 5, 7, 7])]),
            4 => (0x910, soon.to_le_bytes()[..4].to_vec()),
            5 => (0x920, random),
            6 => (0x930, random[..2].to_vec()),
            _ => (0x900, random[..4].to_vec()),
        }
    }

    fn read_later(&mut self, station: u16, mailbox: (u16, u16)) {
        if self.queue.len() < 8 && self.dice.percent(80) {
            let data = vec![0; usize::from(mailbox.1)];
            let frame = FrameBuilder::default().datagram(4, station, mailbox.0, &data);
            self.queue.push(frame.build());
        }
    }
}

/// Sends a frame and checks the parts of the answer that must not change. Returns `None` if the
/// frame is lost.
pub fn exchange(segment: &mut Segment, now: u64, sent: &[u8]) -> Option<Vec<u8>> {
    let mut back = sent.to_vec();
    match segment.transit(&mut back, now) {
        FrameOutcome::Lost => None,
        FrameOutcome::Back { at, .. } => {
            assert!(at > now, "back before it was sent");
            compare(segment.len(), sent, &back);
            Some(back)
        }
    }
}

/// Returns the working counter of the first datagram.
fn wkc(bytes: &[u8]) -> u16 {
    frame::next(bytes, None).map_or(0, |d| d.wkc(bytes))
}

fn compare(devices: usize, sent: &[u8], back: &[u8]) {
    assert_eq!(sent.len(), back.len(), "length");
    let mut expected = sent.to_vec();
    // The source is marked unless DL control lets other protocols pass.
    if let (Some(source), Some(back)) = (expected.get_mut(6), back.get(6))
        && *back == *source | 0x02
    {
        *source = *back;
    }
    if frame::kind(sent) != Kind::EtherCat {
        assert_eq!(expected, back, "what is not well-formed passes untouched");
        return;
    }
    // Fields that may change are taken from the answer; the rest must be equal.
    let mut datagram = frame::next(sent, None);
    while let Some(d) = datagram {
        let header = d.data.start - HEADER;
        let data = d.data.clone();
        let grown = d.wkc(back).wrapping_sub(d.wkc(sent));
        assert!(
            usize::from(grown) <= 3 * devices,
            "working counter grew by {grown}"
        );
        let moved = matches!(
            d.command,
            Command::Aprd | Command::Apwr | Command::Aprw | Command::Armw
        ) || matches!(d.command, Command::Brd | Command::Bwr | Command::Brw);
        if moved {
            expected[header + 2..header + 4].copy_from_slice(&back[header + 2..header + 4]);
        }
        let reads = !matches!(
            d.command,
            Command::Nop
                | Command::Apwr
                | Command::Fpwr
                | Command::Bwr
                | Command::Lwr
                | Command::Unknown(_)
        );
        if reads && grown > 0 {
            expected[data.clone()].copy_from_slice(&back[data.clone()]);
        }
        for n in [0, 1] {
            let (old, new) = (sent[header + 8 + n], back[header + 8 + n]);
            assert_eq!(old & new, old, "event bits are only set");
            expected[header + 8 + n] = new;
            expected[data.end + n] = back[data.end + n];
        }
        if matches!(d.command, Command::Nop | Command::Unknown(_)) {
            assert_eq!(grown, 0, "{:?}", d.command);
        }
        datagram = frame::next(sent, Some(&d));
    }
    assert!(
        expected == back,
        "something outside of the datagrams' fields has changed"
    );
}
