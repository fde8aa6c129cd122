//! The socket kinds of a network interface at the two ends of a veth pair. Requires root.

use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use ecaxis_master::link::{self, Link, LinkError, LinkStats, MAX_FRAME, NicWarning, SocketKind};
use ecaxis_master::sys::packet::{PacketSocket, interface_index};
use ecaxis_test_support::host::over_a_pair;
use ecaxis_test_support::program;
use ecaxis_tools::bench::bus::{Bus, FaultInjection, Options, ReplyDelay};
use ecaxis_tools::bench::segment::BenchSegment;
use ecaxis_tools::bench::veth::VethPair;

const TIMEOUT: Duration = Duration::from_secs(5);
/// The EtherType for sending.
const ETHERCAT: u16 = 0x88a4;

fn open(nic: &str, back_end: SocketKind) -> Box<dyn Link> {
    let (link, concerns) = link::open(nic, back_end).expect("an interface of ours opens");
    assert_eq!(
        concerns,
        [],
        "the kernel gives a ring, and no other program uses the interface"
    );
    link
}

/// Returns a frame of ecaxis with `len` bytes of datagrams; the index of the first is `first`.
fn frame(len: u16, first: u8) -> Vec<u8> {
    let mut frame = vec![0xff; 6];
    frame.extend([0x10, 0x10, 0x10, 0x10, 0x00, 0x20]);
    frame.extend(ETHERCAT.to_be_bytes());
    frame.extend((0x1000 | len).to_le_bytes());
    frame.resize(frame.len() + usize::from(len), 0x5a);
    // A datagram that no SubDevice processes.
    frame[16..18].copy_from_slice(&[0, first]);
    frame[22..24].copy_from_slice(&(len - 12).to_le_bytes());
    frame
}

/// Answers every frame at once and unchanged.
fn reflect(pair: &VethPair) -> Bus {
    let options = Options {
        hold: ReplyDelay::Fixed(0),
        cycle_ns: 100_000,
        mischief: FaultInjection::default(),
        priority: 1,
        cpu: None,
        slack_ns: 0,
    };
    Bus::on(pair, BenchSegment::new([], 0), options).expect("answers")
}

/// Returns the next frame, or `None` after a timeout.
fn receive(link: &mut dyn Link) -> Option<Vec<u8>> {
    let start = Instant::now();
    let mut buf = [0; MAX_FRAME];
    while start.elapsed() < TIMEOUT {
        if let Some(len) = link.recv(&mut buf).expect("receives") {
            return Some(buf[..len].to_vec());
        }
        std::thread::yield_now();
    }
    None
}

/// Returns another participant on the wire that sends arbitrary frames.
fn intruder(nic: &str) -> PacketSocket {
    let socket = PacketSocket::new().expect("root may");
    // No frame has this EtherType, so the socket receives nothing.
    let index = interface_index(nic).expect("an interface of ours");
    socket.bind(index, 0x88b5).expect("bound");
    socket
}

#[test]
fn frames_of_every_length_return_over_both_socket_kinds() {
    over_a_pair(|pair| {
        let _bus = reflect(&pair);
        let lengths = [12_u16, 44, 45, 100, 486, 1000, 1498];
        let mut all = Vec::new();
        for back_end in SocketKind::ALL {
            let mut link = open(&pair.a, *back_end);
            // Sends more frames than the ring has slots.
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
        assert_eq!(all.len(), 100 * lengths.len() * SocketKind::ALL.len());
    });
}

#[test]
fn foreign_frames_are_counted_and_skipped() {
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
        for back_end in SocketKind::ALL {
            let mut link = open(&pair.a, *back_end);
            let intruder = intruder(&pair.b);
            let inject = |bytes: &[u8]| intruder.send(bytes).expect("sent");
            inject(&tagged(5));
            inject(&tagged(4094));
            // Frames of another MainDevice, for another receiver, and of another EtherCAT frame
            // type.
            inject(&changed(6, 0x50));
            inject(&changed(0, 0x01));
            inject(&changed(15, 0x40));
            // With another EtherType, the kernel does not deliver the frame.
            inject(&changed(12, 0x08));
            inject(&frame(44, 0)[..40]);
            // The shortest frame that the kernel sends: a header alone.
            inject(&frame(44, 0)[..14]);
            inject(&frame(44, 7));
            let got = receive(link.as_mut()).expect("the last one is ours");
            assert_eq!(got[17], 7, "{back_end}");
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

/// If another MainDevice drives the segment, the link sends nothing.
#[test]
fn a_machine_does_not_start_next_to_another_main_device() {
    over_a_pair(|pair| {
        let intruder = intruder(&pair.b);
        let ended = AtomicBool::new(false);
        let reported = std::thread::scope(|scope| {
            scope.spawn(|| {
                // Frames as SOEM sends them.
                let mut bytes = frame(44, 0);
                bytes[6..12].fill(0x01);
                while !ended.load(Ordering::Relaxed) {
                    intruder.send(&bytes).expect("sent");
                    std::thread::sleep(Duration::from_millis(4));
                }
            });
            let run = program::command()
                .args([
                    "run",
                    "configs/demo.toml",
                    "--no-fault-report",
                    "--nic",
                    &pair.a,
                ])
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
        assert!(reported.contains(&error), "{reported}");
        assert!(reported.contains("= help: two of them"), "{reported}");
        let sent = format!("/sys/class/net/{}/statistics/tx_packets", pair.a);
        let sent = std::fs::read_to_string(sent).expect("Linux");
        assert_eq!(sent.trim(), "0", "frames went out");
    });
}

#[test]
fn an_overflow_of_the_receive_buffer_is_counted_by_the_kernel() {
    over_a_pair(|pair| {
        for back_end in SocketKind::ALL.iter().filter(|b| **b != SocketKind::Packet) {
            overflow(&pair, *back_end);
        }
    });
}

/// Sends more than the rings of 256 frames can hold.
fn overflow(pair: &VethPair, back_end: SocketKind) {
    let mut link = open(&pair.a, back_end);
    let intruder = intruder(&pair.b);
    for n in 0..400_u32 {
        intruder.send(&frame(44, n.to_le_bytes()[0])).expect("sent");
    }
    let mut buf = [0; MAX_FRAME];
    let mut seen = 0_u64;
    // The kernel delivers pending frames later.
    let start = Instant::now();
    while seen + link.stats().dropped < 400 && start.elapsed() < TIMEOUT {
        seen += u64::from(link.recv(&mut buf).expect("receives").is_some());
    }
    let dropped = link.stats().dropped;
    assert!(dropped > 0 && seen > 0);
    assert_eq!(seen + dropped, 400);
    // Reception continues afterwards.
    intruder.send(&frame(44, 9)).expect("sent");
    assert_eq!(receive(link.as_mut()).expect("a frame")[17], 9);
    assert_eq!(link.stats().dropped, dropped);
}

#[test]
fn an_interface_that_is_down_is_an_error_until_it_is_up_again() {
    over_a_pair(|pair| {
        let _bus = reflect(&pair);
        for back_end in SocketKind::ALL {
            let mut link = open(&pair.a, *back_end);
            let mut buf = [0; MAX_FRAME];
            pair.set(&pair.a, false).expect("goes down");
            let mut refused = 0;
            for _ in 0..100 {
                match link.send(&frame(44, 1)) {
                    Err(LinkError::Send(_)) => refused += 1,
                    other => panic!("{back_end}: {other:?}"),
                }
                // The error appears once or never; the call must not block.
                let _ = link.recv(&mut buf);
            }
            assert_eq!(refused, 100);
            pair.set(&pair.a, true).expect("goes up");
            let start = Instant::now();
            let answer = loop {
                // The first call may still report the earlier error.
                let _ = link.send(&frame(44, 2));
                std::thread::sleep(Duration::from_millis(1));
                match link.recv(&mut buf) {
                    Ok(Some(_)) => break buf[17],
                    _ => assert!(start.elapsed() < TIMEOUT, "{back_end}"),
                }
            };
            assert_eq!(answer, 2, "{back_end}");
        }
    });
}

#[test]
fn an_interface_with_an_ip_address_is_reported() {
    over_a_pair(|pair| {
        let added = Command::new("ip")
            .args(["addr", "add", "192.0.2.7/30", "dev", &pair.a])
            .status();
        assert!(added.expect("ip runs").success());
        let (_, concerns) = link::open(&pair.a, SocketKind::Ring).expect("it opens all the same");
        let expected = NicWarning::Addresses {
            nic: pair.a.clone(),
            addresses: vec!["192.0.2.7".parse().expect("an address")],
        };
        assert_eq!(concerns, [expected]);
    });
}
