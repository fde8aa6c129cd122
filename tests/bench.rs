//! `ecaxis bench`: its instruments and its report. No test asserts a time, because timing depends
//! on the test machine.

#![allow(clippy::print_stdout, reason = "a skipped test says why")]

#[path = "common/wire.rs"]
mod wire;

use std::num::NonZeroU64;
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use ecaxis_master::config::Exchange;
use ecaxis_master::link::capture::{CapturingLink, Recorder, WriterMode};
use ecaxis_master::link::{self, Link, SocketKind};
use ecaxis_master::rt::spin::Spin;
use ecaxis_sim::frame::{self, Command};
use ecaxis_tools::bench::bus::{Bus, Counts, FaultInjection, InProcess, Options, ReplyDelay};
use ecaxis_tools::bench::fixture::{self, Setup};
use ecaxis_tools::bench::measure::{self, Measured, Thread};
use ecaxis_tools::bench::veth::{VethPair, leftovers};
use wire::over_a_pair;

/// Two real-time threads on two processors leave no capacity for a second bench.
static ALONE: Mutex<()> = Mutex::new(());

fn alone() -> MutexGuard<'static, ()> {
    ALONE.lock().unwrap_or_else(PoisonError::into_inner)
}

fn exists(nic: &str) -> bool {
    Path::new("/sys/class/net").join(nic).exists()
}

fn options(cycle_ns: u64, mischief: FaultInjection) -> Options {
    Options {
        hold: ReplyDelay::Fixed(30_000),
        cycle_ns,
        mischief,
        priority: 40,
        cpu: Some(0),
        slack_ns: cycle_ns / 2,
    }
}

fn setup(axes: usize, cycle_ns: u64) -> Setup {
    Setup {
        axes,
        cycle_ns,
        spin: Spin::For(0),
        exchange: Exchange::SameCycle,
    }
}

fn thread(time: Duration) -> Thread {
    Thread {
        priority: 41,
        // With one processor, the bus shares it. Its replies are then late and are counted as late.
        cpu: Some(std::thread::available_parallelism().map_or(0, |n| n.get() - 1)),
        time,
    }
}

fn run(link: Box<dyn Link>, setup: Setup, bus: Option<&Bus>, time: Duration) -> Measured {
    let _alone = alone();
    let (parts, outer) = fixture::parts(setup, link).expect("few axes");
    measure::rig(
        parts,
        outer,
        setup,
        thread(time),
        bus,
        &AtomicBool::new(false),
    )
    .expect("runs")
    .expect("not interrupted")
}

/// Runs axes over a pair of interfaces.
fn over_veth(pair: &VethPair, mischief: FaultInjection, link: SocketKind) -> (Measured, Counts) {
    let setup = setup(3, 4_000_000);
    let segment = fixture::segment(setup.axes).expect("few axes");
    let bus = Bus::on(pair, segment, options(setup.cycle_ns, mischief)).expect("answers");
    let (link, _) = link::open(&pair.a, link).expect("opens");
    let measured = run(link, setup, Some(&bus), Duration::from_secs(2));
    let counts = measured.bus.expect("a bus");
    (measured, counts)
}

#[test]
fn a_veth_pair_hides_one_end_and_is_removed_after_use() {
    over_a_pair(|pair| {
        let (near, far) = (pair.a.clone(), pair.b.clone());
        assert!(exists(&near) && exists(&far));
        let segment = fixture::segment(1).expect("one axis");
        let bus = Bus::on(
            &pair,
            segment,
            options(1_000_000, FaultInjection::default()),
        )
        .expect("answers");
        assert!(exists(&near));
        assert!(!exists(&far), "in the bus's own network namespace");
        assert!(!leftovers().contains(&near), "its process lives");
        drop(bus);
        drop(pair);
        let start = Instant::now();
        while exists(&near) && start.elapsed() < Duration::from_secs(5) {
            std::thread::sleep(Duration::from_millis(10));
        }
        assert!(!exists(&near));
    });
}

#[test]
fn axes_move_over_every_socket_kind() {
    for back_end in SocketKind::ALL {
        over_a_pair(|pair| {
            let (measured, bus) = over_veth(&pair, FaultInjection::default(), *back_end);
            let counters = measured.stats.counters;
            assert!(counters.cycles > 0, "{back_end}");
            assert_eq!(counters.wkc_errors, 0, "{back_end} {counters:?}");
            assert_eq!(measured.stats.lateness.summary().count, counters.cycles);
            assert_eq!((bus.malformed, bus.foreign), (0, 0), "{bus:?}");
            assert!(bus.frames > 0);
            assert!(measured.used.voluntary_switches > 0);
        });
    }
}

/// A reply after its deadline is counted and never stops the loop.
#[test]
fn late_and_dropped_replies_are_counted_and_the_loop_goes_on() {
    let every = NonZeroU64::new(7).expect("not zero");
    over_a_pair(|pair| {
        let late = FaultInjection {
            late_every: Some((every, 6_000_000)),
            ..FaultInjection::default()
        };
        let (measured, bus) = over_veth(&pair, late, SocketKind::Ring);
        let counters = measured.stats.counters;
        assert!(bus.delayed > 10, "{bus:?}");
        assert!(counters.late_frames > 10, "{counters:?}");
        assert!(counters.lost_frames >= counters.late_frames / 2);
        // One reply in seven is late; most others are in time even on a busy machine.
        assert!(counters.cycles > 2 * counters.lost_frames, "{counters:?}");
    });
    over_a_pair(|pair| {
        let dropped = FaultInjection {
            drop_every: Some(every),
            ..FaultInjection::default()
        };
        let (measured, bus) = over_veth(&pair, dropped, SocketKind::Ring);
        let counters = measured.stats.counters;
        assert!(bus.dropped > 10, "{bus:?}");
        assert!(counters.lost_frames > 10, "{counters:?}");
        assert!(counters.cycles > 2 * counters.lost_frames, "{counters:?}");
    });
}

/// Returns the bytes of every sent frame from a recording.
fn recorded_frames(axes: usize) -> Vec<Vec<u8>> {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("bench.pcapng");
    let segment = fixture::segment(axes).expect("fits");
    let recorder = Recorder::create(&path, WriterMode::Inline, None).expect("a recording");
    let link = InProcess::new(segment, ReplyDelay::Fixed(1_000));
    let link = Box::new(CapturingLink::new(Box::new(link), recorder, 0));
    let setup = setup(axes, 2_000_000);
    let (parts, outer) = fixture::parts(setup, link).expect("fits");
    let _alone = alone();
    let mut engine = ecaxis_master::rt::cycle::Engine::new(parts);
    for _ in 0..700 {
        engine.cycle();
    }
    drop(outer);
    engine
        .finish()
        .link
        .finish()
        .expect("written")
        .expect("a recording");
    sent(&path)
}

fn sent(path: &Path) -> Vec<Vec<u8>> {
    use pcap_file::pcapng::blocks::enhanced_packet::EnhancedPacketOption;
    use pcap_file::pcapng::{Block, PcapNgReader};
    let file = std::fs::File::open(path).expect("a recording");
    let mut reader = PcapNgReader::new(file).expect("pcapng");
    let mut frames = Vec::new();
    while let Some(block) = reader.next_block() {
        if let Block::EnhancedPacket(packet) = block.expect("a block") {
            let out = packet
                .options
                .iter()
                .any(|o| matches!(o, EnhancedPacketOption::Flags(flags) if flags & 3 == 2));
            if out {
                frames.push(packet.data.to_vec());
            }
        }
    }
    frames
}

/// Process data are 12 bytes per axis in each direction, and each cycle has one frame. The expected
/// bytes come from a capture.
#[test]
fn a_cycle_is_one_frame_without_superfluous_bytes() {
    for (axes, most) in [(8, 158), (32, 446), (100, 1262)] {
        let frames = recorded_frames(axes);
        assert_eq!(frames.len(), 700, "one a cycle");
        let mut diagnoses = 0;
        for frame in &frames {
            let mut commands = Vec::new();
            let mut diagnosis = 0;
            let mut next = frame::next(frame, None);
            while let Some(datagram) = next {
                commands.push(datagram.command);
                if datagram.command == Command::Fprd {
                    diagnosis += datagram.data.len() + 12;
                } else if datagram.command == Command::Lrw {
                    assert_eq!(datagram.data.len(), 12 * axes);
                }
                next = frame::next(frame, Some(&datagram));
            }
            assert_eq!(commands[..3], [Command::Frmw, Command::Lrw, Command::Brd]);
            assert!(commands.len() <= 4, "{commands:?}");
            assert!(diagnosis <= 20, "{diagnosis}");
            assert!(frame.len() - diagnosis <= most, "{axes}: {}", frame.len());
            diagnoses += usize::from(diagnosis > 0);
        }
        assert!(diagnoses > 0, "and the diagnostic datagram besides");
    }
}

#[test]
fn axes_move_in_process() {
    let setup = setup(5, 1_000_000);
    let segment = fixture::segment(setup.axes).expect("few axes");
    let link = Box::new(InProcess::new(segment, ReplyDelay::Wire));
    let measured = run(link, setup, None, Duration::from_millis(300));
    let counters = measured.stats.counters;
    assert!(counters.cycles > 0);
    assert_eq!(counters.wkc_errors, 0);
    assert!(measured.stats.round_trip.summary().count > 0);
}

#[test]
fn an_interrupt_ends_a_bench_before_motion() {
    let setup = setup(1, 1_000_000);
    let segment = fixture::segment(1).expect("one axis");
    let link = Box::new(InProcess::new(segment, ReplyDelay::Wire));
    let (parts, outer) = fixture::parts(setup, link).expect("one axis");
    let stop = Arc::new(AtomicBool::new(true));
    let ended = measure::rig(
        parts,
        outer,
        setup,
        thread(Duration::from_secs(100)),
        None,
        &stop,
    );
    assert!(matches!(ended, Ok(None)));
}

#[test]
fn the_maximum_number_of_axes_fits_a_bus() {
    assert!(fixture::segment(fixture::MOST_AXES).is_ok());
}
