//! The back-ends of a network interface on the two ends of a veth pair. Needs root.

#![allow(clippy::print_stdout, reason = "a skipped test says why")]

#[path = "common/wire.rs"]
mod wire;

use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use ecaxis::bench::reflector::{Pace, Reflector};
use ecaxis::bench::veth::VethPair;
use ecaxis::link::{self, BackEnd, Concern, Link, LinkError, LinkStats, MAX_FRAME};
use ecaxis::os::packet::{PacketSocket, interface_index};
use wire::over_a_pair;

const PATIENCE: Duration = Duration::from_secs(5);
/// Sending alone; any will do.
const ETHERCAT: u16 = 0x88a4;

fn open(nic: &str, back_end: BackEnd) -> Box<dyn Link> {
    let (link, concerns) = link::open(nic, back_end).expect("an interface of ours opens");
    assert_eq!(
        concerns,
        [],
        "the kernel gives a ring, and nobody else uses the interface"
    );
    link
}

/// A frame of ours with so many bytes of datagrams, the first of them as given.
fn frame(len: u16, first: u8) -> Vec<u8> {
    let mut frame = vec![0xff; 6];
    frame.extend([0x10, 0x10, 0x10, 0x10, 0x00, 0x20]);
    frame.extend(ETHERCAT.to_be_bytes());
    frame.extend((0x1000 | len).to_le_bytes());
    frame.resize(frame.len() + usize::from(len), 0x5a);
    frame[16] = first;
    frame
}

/// The next frame within patience.
fn receive(link: &mut dyn Link) -> Option<Vec<u8>> {
    let start = Instant::now();
    let mut buf = [0; MAX_FRAME];
    while start.elapsed() < PATIENCE {
        if let Some(len) = link.recv(&mut buf).expect("receives") {
            return Some(buf[..len].to_vec());
        }
        std::thread::yield_now();
    }
    None
}

/// Something else on the wire that sends what it likes.
fn intruder(nic: &str) -> PacketSocket {
    let socket = PacketSocket::new().expect("root may");
    // Nothing sends this EtherType, so that nothing is received.
    let index = interface_index(nic).expect("an interface of ours");
    socket.bind(index, 0x88b5).expect("bound");
    socket
}

#[test]
fn every_length_comes_back_the_same_over_both() {
    over_a_pair(|pair| {
        let _reflector = Reflector::start(&pair.b, Pace::default(), None).expect("answers");
        let lengths = [12_u16, 44, 45, 100, 486, 1000, 1498];
        let mut all = Vec::new();
        for back_end in BackEnd::ALL {
            let mut link = open(&pair.a, *back_end);
            // More frames than the ring has slots.
            for turn in 0..100_u8 {
                for len in lengths {
                    let sent = frame(len, turn);
                    link.send(&sent).expect("sends");
                    let mut expected = sent;
                    expected[6] = 0x12;
                    let got = receive(link.as_mut());
                    assert_eq!(got.as_ref(), Some(&expected), "{back_end}, {len} bytes");
                    all.push((len, turn));
                }
            }
            assert_eq!(link.stats(), LinkStats::default(), "{back_end}");
        }
        assert_eq!(all.len(), 100 * lengths.len() * BackEnd::ALL.len());
    });
}

#[test]
fn what_is_not_ours_is_counted_and_passed_over() {
    over_a_pair(|pair| {
        let tagged = |vlan: u16| {
            let mut bytes = frame(44, 0);
            bytes.splice(12..12, [0x81, 0x00].into_iter().chain(vlan.to_be_bytes()));
            bytes
        };
        let changed = |at: usize, to: u8| {
            let mut bytes = frame(44, 0);
            bytes[at] = to;
            bytes
        };
        for back_end in BackEnd::ALL {
            let mut link = open(&pair.a, *back_end);
            let intruder = intruder(&pair.b);
            let inject = |bytes: &[u8]| intruder.send(bytes).expect("sent");
            inject(&tagged(5));
            inject(&tagged(4094));
            // Another MainDevice, another receiver, another kind of EtherCAT frame.
            inject(&changed(6, 0x50));
            inject(&changed(0, 0x01));
            inject(&changed(15, 0x40));
            // Not of the EtherType: the kernel does not even show it.
            inject(&changed(12, 0x08));
            inject(&frame(44, 0)[..40]);
            // A header alone is the least that the kernel sends.
            inject(&frame(44, 0)[..14]);
            inject(&frame(44, 7));
            let got = receive(link.as_mut()).expect("the last one is ours");
            assert_eq!(got[16], 7, "{back_end}");
            let expected = LinkStats {
                tagged: 2,
                foreign: 3,
                main_devices: 2,
                damaged: 2,
                dropped: 0,
            };
            assert_eq!(link.stats(), expected, "{back_end}");
        }
    });
}

/// A machine that somebody else drives is left to him: nothing at all is sent.
#[test]
fn where_another_main_device_is_heard_no_machine_begins() {
    let root = concat!(env!("CARGO_MANIFEST_DIR"), "/..");
    over_a_pair(|pair| {
        let intruder = intruder(&pair.b);
        let ended = AtomicBool::new(false);
        let told = std::thread::scope(|scope| {
            scope.spawn(|| {
                // As SOEM sends them.
                let mut bytes = frame(44, 0);
                bytes[6..12].fill(0x01);
                while !ended.load(Ordering::Relaxed) {
                    intruder.send(&bytes).expect("sent");
                    std::thread::sleep(Duration::from_millis(4));
                }
            });
            let run = Command::new(env!("CARGO_BIN_EXE_ecaxis"))
                .args(["run", "configs/demo.toml", "--no-story", "--nic", &pair.a])
                .current_dir(root)
                .output();
            ended.store(true, Ordering::Relaxed);
            let run = run.expect("the binary runs");
            assert_eq!(run.status.code(), Some(1));
            String::from_utf8_lossy(&run.stderr).into_owned()
        });
        let error = format!(
            "error: another MainDevice drives the segment on `{}`: ",
            pair.a
        );
        assert!(told.contains(&error), "{told}");
        assert!(told.contains("= help: two of them"), "{told}");
        let sent = format!("/sys/class/net/{}/statistics/tx_packets", pair.a);
        let sent = std::fs::read_to_string(sent).expect("Linux");
        assert_eq!(sent.trim(), "0", "frames went out");
    });
}

#[test]
fn nobody_looks_and_the_kernel_counts_what_finds_no_room() {
    over_a_pair(|pair| {
        for back_end in BackEnd::ALL.iter().filter(|b| **b != BackEnd::Packet) {
            overflow(&pair, *back_end);
        }
    });
}

/// Rings of 256 frames.
fn overflow(pair: &VethPair, back_end: BackEnd) {
    let mut link = open(&pair.a, back_end);
    let intruder = intruder(&pair.b);
    for n in 0..400_u32 {
        intruder.send(&frame(44, n.to_le_bytes()[0])).expect("sent");
    }
    let mut buf = [0; MAX_FRAME];
    let mut seen = 0_u64;
    // What the kernel has still to deliver comes later.
    let start = Instant::now();
    while seen + link.stats().dropped < 400 && start.elapsed() < PATIENCE {
        seen += u64::from(link.recv(&mut buf).expect("receives").is_some());
    }
    let dropped = link.stats().dropped;
    assert!(dropped > 0 && seen > 0);
    assert_eq!(seen + dropped, 400);
    // And it goes on.
    intruder.send(&frame(44, 9)).expect("sent");
    assert_eq!(receive(link.as_mut()).expect("a frame")[16], 9);
    assert_eq!(link.stats().dropped, dropped);
}

#[test]
fn an_interface_that_goes_down_is_an_error_until_it_is_up_again() {
    over_a_pair(|pair| {
        let _reflector = Reflector::start(&pair.b, Pace::default(), None).expect("answers");
        for back_end in BackEnd::ALL {
            let mut link = open(&pair.a, *back_end);
            let mut buf = [0; MAX_FRAME];
            pair.set(&pair.a, false).expect("goes down");
            let mut refused = 0;
            for _ in 0..100 {
                match link.send(&frame(44, 1)) {
                    Err(LinkError::Send(_)) => refused += 1,
                    other => panic!("{back_end}: {other:?}"),
                }
                // Once told, or never; in no case does it wait.
                let _ = link.recv(&mut buf);
            }
            assert_eq!(refused, 100);
            pair.set(&pair.a, true).expect("goes up");
            let start = Instant::now();
            let answer = loop {
                // The first one may still tell of the past.
                let _ = link.send(&frame(44, 2));
                std::thread::sleep(Duration::from_millis(1));
                match link.recv(&mut buf) {
                    Ok(Some(_)) => break buf[16],
                    _ => assert!(start.elapsed() < PATIENCE, "{back_end}"),
                }
            };
            assert_eq!(answer, 2, "{back_end}");
        }
    });
}

#[test]
fn an_interface_with_an_address_is_told_of() {
    over_a_pair(|pair| {
        let added = Command::new("ip")
            .args(["addr", "add", "192.0.2.7/30", "dev", &pair.a])
            .status();
        assert!(added.expect("ip runs").success());
        let (_, concerns) = link::open(&pair.a, BackEnd::Ring).expect("it opens all the same");
        let expected = Concern::Addresses {
            nic: pair.a.clone(),
            addresses: vec!["192.0.2.7".parse().expect("an address")],
        };
        assert_eq!(concerns, [expected]);
    });
}
