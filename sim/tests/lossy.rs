//! A mailbox behind a wire that loses frames. With the counters and repetitions of the mailbox's
//! data link layer (ETG.1000.4 §5.6) every request is executed exactly once.

use crate::common::*;
use ecaxis_sim::frame::{self, FrameBuilder};
use ecaxis_sim::{DeviceOptions, FaultScript};

const S: u16 = 0x1001;
const LEN: u16 = 48;

/// A MainDevice that repeats lost frames.
struct Client {
    bus: Bus,
    request: u8,
    /// The counter of the last message read.
    seen: u8,
    toggle: u8,
    emergencies: Vec<u16>,
    repeated: u32,
}

impl Client {
    fn new(script: &str) -> Self {
        let mut bus = mailbox_bus(LEN, DeviceOptions::default());
        bus.segment.set_faults(FaultScript::parse(script).unwrap());
        Self {
            bus,
            request: 0,
            seen: 0,
            toggle: 0,
            emergencies: Vec::new(),
            repeated: 0,
        }
    }

    /// Sends a frame once. Returns `None` if it is lost in either direction.
    fn once(&mut self, command: u8, ado: u16, data: &[u8]) -> Option<(Vec<u8>, u16)> {
        let request = FrameBuilder::default().datagram(command, S, ado, data);
        let bytes = self.bus.frame(request.build())?;
        let d = frame::next(&bytes, None).unwrap();
        Some((bytes[d.data.clone()].to_vec(), d.wkc(&bytes)))
    }

    /// Reads a register until an answer arrives.
    fn register(&mut self, ado: u16) -> u8 {
        (0..1000)
            .find_map(|_| self.once(4, ado, &[0]))
            .map(|(data, _)| data[0])
            .expect("a register that answers in a thousand times")
    }

    fn send(&mut self, kind: u8, payload: &[u8]) {
        self.request = self.request % 7 + 1;
        let header = [payload.len() as u8, 0, 0, 0, 0, kind | self.request << 4];
        let message = message(usize::from(LEN), header, payload);
        for tries in 0..1000 {
            self.repeated += u32::from(tries > 0);
            match self.once(5, 0x1000, &message) {
                Some((_, 1)) => return,
                _ => self.bus.wait(300_000),
            }
        }
        panic!("never taken");
    }

    fn receive(&mut self) -> Vec<u8> {
        for _ in 0..10_000 {
            if self.register(0x80d) & 8 == 0 {
                self.bus.wait(100_000);
                continue;
            }
            let (start, len) = self.bus.mailboxes[1];
            let Some((message, 1)) = self.once(4, start, &vec![0; usize::from(len)]) else {
                self.ask_again();
                continue;
            };
            let counter = message[5] >> 4;
            if counter == self.seen {
                continue;
            }
            assert_eq!(counter, self.seen % 7 + 1, "a message is missing");
            self.seen = counter;
            let len = usize::from(message[0]);
            let payload = message[6..6 + len].to_vec();
            if message[5] & 0x0f == 3 && payload[1] >> 4 == 1 {
                self.emergencies
                    .push(u16::from_le_bytes([payload[2], payload[3]]));
                continue;
            }
            return payload;
        }
        panic!("no answer");
    }

    fn ask_again(&mut self) {
        self.toggle ^= 2;
        self.repeated += 1;
        for _ in 0..1000 {
            self.once(5, 0x80e, &[1 | self.toggle]);
            if self.register(0x80f) & 2 == self.toggle {
                return;
            }
            self.bus.wait(100_000);
        }
        panic!("no acknowledgement");
    }

    fn exchange(&mut self, kind: u8, payload: &[u8]) -> Vec<u8> {
        self.send(kind, payload);
        self.receive()
    }
}

fn script(seed: u64) -> String {
    let mut script =
        format!("seed = {seed}\n[[fault]]\nkind = \"frame-loss\"\nprobability = 0.25\n");
    for n in 0..10 {
        script += &format!(
            "[[fault]]\nat = \"{}ms\"\nkind = \"emergency\"\ncode = {}\n",
            20 * n + 7,
            0x8100 + n
        );
    }
    script
}

#[test]
fn mailbox_delivers_a_file_and_every_emergency_with_25_percent_frame_loss() {
    let file: Vec<u8> = (0..3000).map(|n: u32| (n * 31 + n / 251) as u8).collect();
    for seed in 1..=5 {
        let mut client = Client::new(&script(seed));
        // Packet numbers reveal a data packet that is executed twice or not at all.
        assert_eq!(client.exchange(4, b"\x02\0\0\0\0\0f"), [4, 0, 0, 0, 0, 0]);
        for (packet, data) in (1_u32..).zip(file.chunks(36)) {
            let mut payload = vec![3, 0];
            payload.extend_from_slice(&packet.to_le_bytes());
            payload.extend_from_slice(data);
            let reply = client.exchange(4, &payload);
            assert_eq!(reply[0], 4, "seed {seed}, packet {packet}: {reply:?}");
            assert_eq!(reply[2..], packet.to_le_bytes());
        }
        let device = client.bus.segment.device(0).unwrap();
        assert_eq!(device.foe_files().get("f"), Some(&file[..]));
        // Toggle bits do the same for segments.
        let first = client.exchange(3, &[0, 0x20, 0x40, 0, 0x20, 0, 0, 0, 0, 0]);
        let mut data = first[10..].to_vec();
        let mut toggle = 0;
        while data.len() < 500 {
            let segment = client.exchange(3, &[0, 0x20, 0x60 | toggle, 0, 0, 0, 0, 0, 0, 0]);
            assert_eq!(segment[2] & 0xf0, toggle, "seed {seed}: {segment:?}");
            data.extend_from_slice(&segment[3..]);
            toggle ^= 0x10;
        }
        assert_eq!(data.len(), 500);
        let codes: Vec<u16> = (0..10).map(|n| 0x8100 + n).collect();
        assert_eq!(client.emergencies, codes, "seed {seed}");
        assert!(client.repeated > 50, "{}", client.repeated);
    }
}
