use std::collections::VecDeque;
use std::sync::{Arc, Mutex};

use proptest::prelude::*;

use super::*;
use crate::clock::Clock;

const DEVICES: u16 = 6;
const STATION: u16 = 0x1000;

/// What a device reads from its memory.
fn memory(device: u16, at: usize) -> u8 {
    (device * 37 + 11) as u8 ^ (at as u8).wrapping_mul(29)
}

/// Processes a frame in devices, in order (ETG.1000.4, clause 5.4). Each device owns two bytes of the
/// logical addresses from 0 on.
fn process(frame: &mut [u8], devices: std::ops::Range<u16>) {
    let found: Vec<_> = datagrams(frame).collect();
    for device in devices {
        frame[PROCESSED_AT] |= 0x02;
        for datagram in &found {
            let start = datagram.start;
            let command = Command(frame[start]);
            let low = u16::from_le_bytes([frame[start + 2], frame[start + 3]]);
            let mut counted = 0;
            let to_it = match command {
                Command::APRD | Command::APWR | Command::ARMW => low == 0,
                Command::FPRD | Command::FPWR | Command::FRMW => low == STATION + device,
                _ => false,
            };
            for (offset, at) in datagram.data.clone().enumerate() {
                let own = usize::from(device) * 2;
                match command {
                    Command::BRD => frame[at] |= memory(device, offset),
                    Command::LRW if (own..own + 2).contains(&(usize::from(low) + offset)) => {
                        frame[at] = memory(device, offset);
                        counted = 3;
                    }
                    _ if command.reads() && to_it => frame[at] = memory(device, offset),
                    _ => {}
                }
            }
            counted += match command {
                Command::BRD | Command::BWR | Command::ARMW | Command::FRMW => 1,
                _ => u16::from(to_it),
            };
            if command.is_positional() {
                let next = low.wrapping_add(1).to_le_bytes();
                frame[start + 2..start + 4].copy_from_slice(&next);
            }
            let counter = &mut frame[datagram.data.end..datagram.data.end + 2];
            let sum = u16::from_le_bytes([counter[0], counter[1]]) + counted;
            counter.copy_from_slice(&sum.to_le_bytes());
        }
    }
}

/// Builds a frame of the cycle with these datagrams: command, low address, data.
fn frame(index: u8, datagrams: &[(Command, u16, Vec<u8>)]) -> Vec<u8> {
    let mut frame = vec![0xff; 6];
    frame.extend([0x10, 0x10, 0x10, 0x10, 0, CYCLIC, 0x88, 0xa4, 0, 0x10]);
    for (number, (command, low, data)) in datagrams.iter().enumerate() {
        let header = Header {
            command: *command,
            index,
            address: u32::from(*low),
            len: u16::try_from(data.len()).expect("short"),
            more: number + 1 < datagrams.len(),
        };
        frame.extend(header.emit());
        frame.extend(data);
        frame.extend([0, 0]);
    }
    frame
}

/// Sends a frame through a ring that is broken behind `split` devices, and returns the answer.
fn through_ring(sent: &[u8], split: Option<u16>) -> Vec<u8> {
    let mut answer = sent.to_vec();
    for from in End::BOTH {
        let mut copy = sent.to_vec();
        address(&mut copy, from, split.unwrap_or(DEVICES));
        let devices = match (from, split) {
            (End::First, _) => 0..split.unwrap_or(DEVICES),
            (End::Second, _) => split.unwrap_or(DEVICES)..DEVICES,
        };
        process(&mut copy, devices);
        copy[MARK_AT] &= !MARK;
        merge(sent, &copy, &mut answer);
    }
    answer
}

fn datagram() -> impl Strategy<Value = (Command, u16, Vec<u8>)> {
    let data = prop::collection::vec(any::<u8>(), 1..16);
    let commands = vec![
        Command::APRD,
        Command::APWR,
        Command::FPRD,
        Command::FPWR,
        Command::FRMW,
        Command::BRD,
        Command::BWR,
        Command::LRW,
    ];
    (prop::sample::select(commands), 0..DEVICES, data).prop_map(|(command, device, data)| {
        let low = match command {
            Command::APRD | Command::APWR | Command::ARMW => 0_u16.wrapping_sub(device),
            Command::FPRD | Command::FPWR | Command::FRMW => STATION + device,
            Command::LRW => device,
            _ => 0,
        };
        let data = match command {
            Command::BRD => vec![0; data.len()],
            _ => data,
        };
        (command, low, data)
    })
}

proptest! {
    /// A ring answers as a line, wherever it is broken.
    #[test]
    fn ring_answers_as_a_line(datagrams in prop::collection::vec(datagram(), 1..8), split in prop::option::of(0..=DEVICES)) {
        let sent = frame(7, &datagrams);
        let mut line = sent.clone();
        process(&mut line, 0..DEVICES);
        for (datagram, (command, low, _)) in super::datagrams(&sent).zip(&datagrams) {
            if command.is_positional() && !matches!(*command, Command::BRD | Command::BWR) {
                line[datagram.start + 2..datagram.start + 4].copy_from_slice(&low.to_le_bytes());
            }
        }
        prop_assert_eq!(through_ring(&sent, split), line);
    }

    /// Any bytes may come back.
    #[test]
    fn any_answer_is_survived(bytes in prop::collection::vec(any::<u8>(), 0..80), at in any::<bool>(), cut in 0..60_usize) {
        let (mut link, _) = ring();
        let sent = frame(1, &[(Command::BRD, 0, vec![0; 4])]);
        link.send(&sent).expect("sent");
        let mut answer = sent;
        answer.truncate(cut);
        for (byte, other) in answer.iter_mut().skip(16).zip(&bytes) {
            *byte = *other;
        }
        let end = if at { End::First } else { End::Second };
        for frame in [bytes, answer] {
            link.scratch[..frame.len()].copy_from_slice(&frame);
            let _ = link.take(end, frame.len());
        }
    }
}

/// The frames of an interface.
#[derive(Debug, Default)]
struct Frames {
    waiting: VecDeque<Vec<u8>>,
    sent: Vec<Vec<u8>>,
}

/// Both interfaces.
#[derive(Debug, Default, Clone)]
struct Queues(Arc<Mutex<[Frames; 2]>>);

impl Queues {
    fn arrive(&self, at: End, frame: Vec<u8>) {
        self.0.lock().expect("held briefly")[at as usize]
            .waiting
            .push_back(frame);
    }

    fn sent(&self, from: End) -> Vec<u8> {
        let queues = self.0.lock().expect("held briefly");
        queues[from as usize].sent.last().expect("a frame").clone()
    }
}

impl RingEnds for Queues {
    fn send(&mut self, from: End, frame: &[u8]) -> Result<(), LinkError> {
        self.0.lock().expect("held briefly")[from as usize]
            .sent
            .push(frame.to_vec());
        Ok(())
    }

    fn recv(&mut self, at: End, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        let frame = self.0.lock().expect("held briefly")[at as usize]
            .waiting
            .pop_front();
        Ok(frame.map(|frame| {
            buf[..frame.len()].copy_from_slice(&frame);
            frame.len()
        }))
    }

    fn next_arrival(&self) -> Option<Nanos> {
        None
    }

    fn main_devices(&self) -> u64 {
        0
    }

    fn stats(&mut self) -> LinkStats {
        LinkStats::default()
    }
}

const COPY_TIMEOUT: Nanos = 1_000_000;

fn ring() -> (RedundantLink, Queues) {
    let queues = Queues::default();
    (
        RedundantLink::new(Box::new(queues.clone()), COPY_TIMEOUT),
        queues,
    )
}

/// What happens to the copies of a frame.
#[derive(Clone, Copy, Debug)]
enum Way {
    /// A ring that is closed; broken behind as many devices; whose first or second cable is out.
    Closed,
    Broken(u16),
    /// The ring was broken behind as many devices for the second copy, and is closed for the first.
    Closes(u16),
    /// The copy of an interface is lost on the way.
    Lost(End),
}

impl RedundantLink {
    /// Sends a frame the way and returns the working counter of its answer, with the clock after the
    /// time for the second copy.
    fn exchange(&mut self, queues: &Queues, index: u8, way: Way) -> Option<u16> {
        let sent = frame(index, &[(Command::BRD, 0, vec![0; 2])]);
        self.send(&sent).expect("sent");
        for from in End::BOTH {
            let mut copy = queues.sent(from);
            let (at, devices) = match (way, from) {
                (Way::Lost(lost), _) if lost == from => continue,
                (Way::Closes(behind), End::Second) => (End::Second, behind..DEVICES),
                (Way::Closed | Way::Closes(_) | Way::Lost(_), End::First) => {
                    (End::Second, 0..DEVICES)
                }
                (Way::Closed | Way::Lost(_), End::Second) => (End::First, 0..0),
                (Way::Broken(0), End::First) | (Way::Broken(DEVICES), End::Second) => continue,
                (Way::Broken(behind), End::First) => (End::First, 0..behind),
                (Way::Broken(behind), End::Second) => (End::Second, behind..DEVICES),
            };
            process(&mut copy, devices);
            queues.arrive(at, copy);
        }
        let mut buf = [0; MAX_FRAME];
        let mut answer = self.recv(&mut buf).expect("received");
        if answer.is_none() {
            let expiry = self.next_arrival().expect("it waits");
            Clock::Virtual.sleep_until(expiry, 0);
            answer = self.recv(&mut buf).expect("received");
        }
        let len = answer?;
        assert_eq!(self.recv(&mut buf), Ok(None), "one answer for each frame");
        Some(u16::from_le_bytes([buf[len - 2], buf[len - 1]]))
    }
}

#[test]
fn ring_recognises_breaks_and_repairs_by_the_paths_of_the_copies() {
    let run = || {
        Clock::Virtual.enter();
        let (mut link, queues) = ring();
        let broken = |behind| RingState::Broken {
            behind,
            devices: DEVICES,
        };
        let closed = RingState::Closed;
        let all = Some(DEVICES);
        let table = [
            (Way::Closed, all, closed),
            // The copy that no device processes may be lost; that of the others takes the cycle along.
            (Way::Lost(End::Second), all, closed),
            (Way::Lost(End::First), None, closed),
            (Way::Broken(2), all, broken(2)),
            (Way::Broken(2), all, broken(2)),
            (Way::Broken(5), all, broken(5)),
            // A frame is on its way while the ring closes: some devices process both copies.
            (Way::Closes(3), all, broken(5)),
            (Way::Closed, all, closed),
        ];
        for (index, (way, counted, state)) in (0..).zip(table) {
            let found = link.exchange(&queues, index, way);
            assert_eq!(found, counted, "frame {index}: {way:?}");
            assert_eq!(link.status.get(), state, "frame {index}: {way:?}");
        }
        for behind in [0, DEVICES] {
            for index in 20..40 {
                let found = link.exchange(&queues, index, Way::Broken(behind));
                assert_eq!(found, all, "frame {index}");
                Clock::Virtual.sleep_until(clock::now() + 2 * COPY_TIMEOUT, 0);
                let _ = link.recv(&mut [0; MAX_FRAME]);
            }
            assert_eq!(link.status.get(), broken(behind));
            let found = link.exchange(&queues, 50, Way::Closed);
            assert_eq!((found, link.status.get()), (all, closed));
        }
    };
    std::thread::spawn(run).join().expect("no panic");
}

/// Positions count from the begin of each line.
#[test]
fn positions_are_asked_on_the_side_of_their_device() {
    let sent = frame(1, &[(Command::APRD, 0_u16.wrapping_sub(4), vec![0; 2])]);
    for (before, [first, second]) in [
        (u16::MAX, [(1, -4_i16), (0, -4)]),
        (3, [(0, -4), (1, -1)]),
        (5, [(1, -4), (0, -4)]),
        (0, [(0, -4), (1, -4)]),
    ] {
        for (from, expected) in [(End::First, first), (End::Second, second)] {
            let mut copy = sent.clone();
            address(&mut copy, from, before);
            let position = i16::from_le_bytes([copy[18], copy[19]]);
            assert_eq!((copy[16], position), expected, "{before} {from:?}");
        }
    }
}

/// ethercrab uses its 256 indices again and again: a late copy belongs to no other datagram.
#[test]
fn late_copy_of_another_datagram_is_not_merged() {
    let run = || {
        Clock::Virtual.enter();
        let (mut link, queues) = ring();
        let read = |station: u16| frame(7, &[(Command::FPRD, station, vec![0; 2])]);
        link.send(&read(STATION + 1)).expect("sent");
        let late = queues.sent(End::First);
        link.send(&read(STATION + 4)).expect("sent");
        let mut late = late;
        process(&mut late, 0..DEVICES);
        queues.arrive(End::Second, late);
        let mut buf = [0; MAX_FRAME];
        while link.recv(&mut buf).expect("received").is_some() {
            assert_eq!(buf[18..20], (STATION + 1).to_le_bytes());
        }
        assert_eq!(link.slots[1].copies, [None; 2]);
    };
    std::thread::spawn(run).join().expect("no panic");
}

/// Frames arrive in one direction only: the processed copies, or the others.
#[test]
fn ring_that_carries_one_direction_is_not_reported_as_closed() {
    let run = || {
        Clock::Virtual.enter();
        for (lost, answer) in [(End::Second, Some(DEVICES)), (End::First, None)] {
            let (mut link, queues) = ring();
            link.exchange(&queues, 0, Way::Closed);
            for index in 1..20 {
                let found = link.exchange(&queues, index, Way::Lost(lost));
                assert_eq!(found, answer, "frame {index} without {lost:?}");
                Clock::Virtual.sleep_until(clock::now() + 2 * COPY_TIMEOUT, 0);
                let _ = link.recv(&mut [0; MAX_FRAME]);
            }
            assert_eq!(link.status.get(), RingState::OneDirection);
        }
    };
    std::thread::spawn(run).join().expect("no panic");
}
