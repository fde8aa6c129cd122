//! `ecaxis bench`: its instruments and its report. No test asserts a time, because timing depends
//! on the test machine.

use std::num::NonZeroU64;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::thread::sleep;
use std::time::{Duration, Instant};

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::config::ExchangeMode;
use ecaxis_master::link::capture::{CapturingLink, Recorder, WriterMode};
use ecaxis_master::link::{self, Link, SocketKind};
use ecaxis_master::rt::spin::Spin;
use ecaxis_test_support::host::{alone, over_a_pair, retry_if_host_stalled};
use ecaxis_test_support::program;
use ecaxis_test_support::recordings::{BRD, FPRD, FRMW, Frame, LRW, frames};
use ecaxis_tools::bench::bus::{Bus, Counts, FaultInjection, InProcess, Options, ReplyDelay};
use ecaxis_tools::bench::fixture::{self, Setup};
use ecaxis_tools::bench::measure::{self, Measured, Thread};
use ecaxis_tools::bench::veth::{VethPair, leftovers};

/// A timeout much longer than a start or an end.
const TIMEOUT: Duration = Duration::from_secs(20);

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
        exchange: ExchangeMode::SameCycle,
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
    let (parts, outer) = fixture::parts(setup, link).expect("few axes");
    measure::rig(
        parts,
        outer,
        setup,
        thread(time),
        bus,
        &CancelToken::default(),
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
        assert!(soon(|| !exists(&near)));
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

/// Returns every sent frame of a recording.
fn recorded_frames(axes: usize) -> Vec<Frame> {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("bench.pcapng");
    let segment = fixture::segment(axes).expect("fits");
    let recorder = Recorder::create(&path, WriterMode::Inline, None, "").expect("a recording");
    let link = InProcess::new(segment, ReplyDelay::Fixed(1_000));
    let link = Box::new(CapturingLink::new(Box::new(link), recorder, 0));
    let setup = setup(axes, 2_000_000);
    let (parts, outer) = fixture::parts(setup, link).expect("fits");
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
    let frames = frames(&path).into_iter();
    frames.filter(|frame| frame.sent).collect()
}

/// Process data are 12 bytes per axis in each direction, and each cycle has one frame. The expected
/// bytes come from a capture.
#[test]
fn a_cycle_is_one_frame_without_superfluous_bytes() {
    let _alone = alone();
    for (axes, most) in [(8, 158), (32, 446), (100, 1262)] {
        let frames = recorded_frames(axes);
        assert_eq!(frames.len(), 700, "one a cycle");
        let mut diagnoses = 0;
        for frame in &frames {
            let commands: Vec<u8> = frame.datagrams.iter().map(|d| d.command).collect();
            let of = |command: u8| frame.datagrams.iter().filter(move |d| d.command == command);
            assert!(of(LRW).all(|d| d.data.len() == 12 * axes));
            let diagnosis: usize = of(FPRD).map(|d| d.data.len() + 12).sum();
            assert_eq!(commands[..3], [FRMW, LRW, BRD]);
            assert!(commands.len() <= 4, "{commands:?}");
            assert!(diagnosis <= 20, "{diagnosis}");
            assert!(frame.len - diagnosis <= most, "{axes}: {}", frame.len);
            diagnoses += usize::from(diagnosis > 0);
        }
        assert!(diagnoses > 0, "and the diagnostic datagram besides");
    }
}

#[test]
fn axes_move_in_process() {
    retry_if_host_stalled(|| {
        let setup = setup(5, 1_000_000);
        let segment = fixture::segment(setup.axes).expect("few axes");
        let link = Box::new(InProcess::new(segment, ReplyDelay::Wire));
        let measured = run(link, setup, None, Duration::from_millis(300));
        let counters = measured.stats.counters;
        assert!(counters.cycles > 0);
        assert_eq!(counters.wkc_errors, 0);
        assert!(measured.stats.round_trip.summary().count > 0);
    });
}

#[test]
fn an_interrupt_ends_a_bench_before_motion() {
    let _alone = alone();
    let setup = setup(1, 1_000_000);
    let segment = fixture::segment(1).expect("one axis");
    let link = Box::new(InProcess::new(segment, ReplyDelay::Wire));
    let (parts, outer) = fixture::parts(setup, link).expect("one axis");
    let stop = Arc::<CancelToken>::default();
    stop.cancel();
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

/// A machine file's simulated bus runs through a whole session.
#[test]
fn bench_runs_a_machine_file_on_its_simulated_bus() {
    let line = "--machine configs/demo.toml --sim --seconds 1 --json";
    retry_if_host_stalled(|| {
        let report = program::run(["bench"].into_iter().chain(line.split(' ')))
            .exits(0)
            .json();
        assert!(report["variants"][0]["cycles"].as_u64() > Some(0));
        let settings = report["settings"].to_string();
        assert!(settings.contains("axes not enabled"), "{settings}");
    });
}

struct Killed(Child);

impl Drop for Killed {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Waits until something is true.
fn soon(what: impl Fn() -> bool) -> bool {
    let start = Instant::now();
    while !what() {
        if start.elapsed() > TIMEOUT {
            return false;
        }
        sleep(Duration::from_millis(20));
    }
    true
}

/// Every end of a bench removes its interfaces.
#[test]
fn a_bench_leaves_no_interface_behind() {
    over_a_pair(|_| {
        for signal in ["-INT", "-KILL"] {
            let line = "--axes 1 --cycle 5ms --seconds 100";
            let mut command = program::command();
            command.arg("bench").args(line.split(' '));
            command.stdout(Stdio::null()).stderr(Stdio::null());
            let mut bench = Killed(command.spawn().expect("starts"));
            let nic = format!("/sys/class/net/ecx{}-0a", bench.0.id());
            let nic = Path::new(&nic);
            assert!(soon(|| nic.exists()), "an interface of its own");
            sleep(Duration::from_millis(500));
            let kill = Command::new("kill")
                .args([signal, &bench.0.id().to_string()])
                .status();
            assert!(kill.expect("kill").success());
            let ended = bench.0.wait().expect("ended");
            let interrupted = ended.code() == Some(130);
            assert_eq!(interrupted, signal == "-INT", "{signal}: {ended}");
            assert!(soon(|| !nic.exists()), "{signal}");
        }
    });
}
