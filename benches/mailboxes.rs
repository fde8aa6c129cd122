//! Mailbox transfers during cyclic operation, over a veth pair (root). The simulated bus runs in a
//! separate process, and ten objects of each drive are read repeatedly. Runs with and without
//! transfers alternate, and the activity of the real-time thread is compared.
//!
//! `cargo bench -p ecaxis --bench mailboxes [-- AXES ASKED SECONDS ROUNDS]`; the default is 8 8 10
//! 3. With 0 rounds, one run has transfers and additional programs that load a processor and the
//! memory. Without root, the benchmark prints a note and ends.

#![allow(clippy::print_stdout, reason = "a bench prints its result")]

#[path = "../axis/tests/counting/mod.rs"]
mod counting;

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::JoinHandle;

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::config;
use ecaxis_master::mailbox::Mailboxes;
use ecaxis_master::rt::controller::{Controller, CycleContext};
use ecaxis_master::session::{self, Observer, Options, Progress, Summary};
use ecaxis_tools::bench::veth::VethPair;

/// Identity, state, position and settings, as a commissioning tool reads them.
const OBJECTS: [(u16, u8); 10] = [
    (0x1018, 1),
    (0x1018, 2),
    (0x1018, 3),
    (0x6041, 0),
    (0x6061, 0),
    (0x6064, 0),
    (0x6065, 0),
    (0x607d, 1),
    (0x607d, 2),
    (0x6098, 0),
];

#[derive(Debug, Default)]
struct Counts {
    done: AtomicU64,
    failed: AtomicU64,
}

/// The number of cycles after which the real-time thread has allocated all its memory.
const SETTLED: u64 = 1_000;

/// Allocations and frees of the real-time thread after this time.
struct Meter {
    cycles: u64,
    before: u64,
    since: Arc<AtomicU64>,
}

impl Controller for Meter {
    fn cycle(&mut self, _: &mut CycleContext<'_>) {
        let so_far = counting::allocations();
        self.cycles += 1;
        if self.cycles == SETTLED {
            self.before = so_far;
        } else if self.cycles > SETTLED {
            self.since.store(so_far - self.before, Ordering::Relaxed);
        }
    }
}

/// Reads the objects of the first devices during the run.
struct Asking {
    devices: usize,
    counts: Arc<Counts>,
    user: Option<JoinHandle<()>>,
}

impl Observer for Asking {
    fn progress(&mut self, progress: &Progress) {
        if let Progress::Mailboxes(mailboxes) = progress
            && self.user.is_none()
            && self.devices > 0
        {
            let (mailboxes, devices) = (mailboxes.clone(), self.devices);
            let counts = Arc::clone(&self.counts);
            self.user = Some(std::thread::spawn(move || {
                let runtime = tokio::runtime::Builder::new_current_thread()
                    .enable_time()
                    .build()
                    .expect("a runtime");
                runtime.block_on(ask(mailboxes, devices, counts));
            }));
        }
    }
}

async fn ask(mailboxes: Mailboxes, devices: usize, counts: Arc<Counts>) {
    let mut tasks = tokio::task::JoinSet::new();
    let names: Vec<String> = mailboxes.names().take(devices).map(str::to_owned).collect();
    for name in names {
        let mailbox = mailboxes.device(&name).expect("one of them");
        let counts = Arc::clone(&counts);
        tasks.spawn(async move {
            // The loop ends when the run is over and requests fail.
            let mut in_a_row = 0;
            while in_a_row < OBJECTS.len() {
                for (index, sub) in OBJECTS {
                    if mailbox.upload(index, sub).await.is_ok() {
                        in_a_row = 0;
                        counts.done.fetch_add(1, Ordering::Relaxed);
                    } else {
                        in_a_row += 1;
                        counts.failed.fetch_add(1, Ordering::Relaxed);
                    }
                }
            }
        });
    }
    while tasks.join_next().await.is_some() {}
}

/// A process that is killed when this value is dropped.
struct Background(Child);

impl Drop for Background {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn machine(nic: &str, axes: usize) -> String {
    let mut text = format!(
        "[bus]\nnic = \"{nic}\"\ncycle = \"1ms\"\nlost_frames = 1000\nwatchdog = \"6s\"\ncpu = 1\n"
    );
    for axis in 0..axes {
        text += &format!(
            "[[device]]\nname = \"a{axis}\"\nesi = \"esi/EPOS4.xml\"\nposition = {axis}\nmode = \"csp\"\n\
             [device.axis]\nunit = \"turn\"\nper_turn = 1.0\nencoder = 2000\n\
             limits = {{ position = [-100.0, 100.0], velocity = 50.0, acceleration = 500.0, torque = 100.0, following_error = 100.0 }}\n"
        );
    }
    text
}

/// Starts endless arithmetic, and repeated allocation, writing and release of memory.
fn load() -> Vec<Background> {
    let arithmetic = "while :; do :; done";
    let memory = "while :; do head -c 200000000 /dev/zero | tail -n 1 > /dev/null; done";
    let start = |script| {
        let child = Command::new("sh")
            .args(["-c", script])
            .stdin(Stdio::null())
            .spawn();
        Background(child.expect("a shell"))
    };
    [arithmetic, memory].map(start).into()
}

struct Ran {
    summary: Summary,
    done: u64,
    failed: u64,
    allocated: u64,
}

fn run(nic: &str, axes: usize, asked: usize, seconds: u64) -> Ran {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let text = machine(nic, axes);
    let machine = config::parse(&root.join("configs/bench.toml"), &text);
    let machine = machine.unwrap_or_else(|error| panic!("{error}"));
    let counts = Arc::new(Counts::default());
    let mut observer = Asking {
        devices: asked,
        counts: Arc::clone(&counts),
        user: None,
    };
    let options = Options {
        limit: Some(seconds * 1_000_000_000),
        enable: false,
        ..Options::default()
    };
    let stop = Arc::<CancelToken>::default();
    let allocated = Arc::new(AtomicU64::new(u64::MAX));
    let meter = Meter {
        cycles: 0,
        before: 0,
        since: Arc::clone(&allocated),
    };
    let outcome = session::run_with(machine, options, stop, &mut observer, Box::new(meter));
    if let Some(user) = observer.user {
        user.join().expect("the user ends");
    }
    if let Err(error) = outcome.result {
        println!("the run ended: {error}");
    }
    Ran {
        summary: outcome.summary.expect("the cycle ran"),
        done: counts.done.load(Ordering::Relaxed),
        failed: counts.failed.load(Ordering::Relaxed),
        allocated: allocated.load(Ordering::Relaxed),
    }
}

fn us(ns: u64) -> f64 {
    ns as f64 / 1e3
}

fn main() {
    let numbers: Vec<u64> = std::env::args().filter_map(|a| a.parse().ok()).collect();
    let number = |n: usize, usual| numbers.get(n).copied().unwrap_or(usual);
    let (axes, asked) = (number(0, 8) as usize, number(1, 8) as usize);
    let (seconds, rounds) = (number(2, 10), number(3, 3));
    let pair = match VethPair::new() {
        Ok(pair) => pair,
        Err(error) => return println!("skipped: a veth pair needs root: {error}"),
    };
    let file = tempfile::Builder::new()
        .suffix(".toml")
        .tempfile_in(Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs"))
        .expect("a machine file");
    std::fs::write(file.path(), machine("sim", axes)).expect("written");
    let bus = Command::new("taskset")
        .args(["-c", "0", env!("CARGO_BIN_EXE_ecaxis"), "sim"])
        .arg(file.path())
        .args(["--nic", &pair.b])
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn();
    let _bus = Background(bus.expect("taskset starts the bus"));
    std::thread::sleep(std::time::Duration::from_secs(1));
    println!("{axes} drives at 1 ms, {asked} of them asked; {rounds} rounds of {seconds} s each");
    println!(
        "wake-up lateness p50/p99/p99.9/max, work p99.9, in us; page faults, allocations and frees after {SETTLED} cycles; switches a cycle"
    );
    let _load = if rounds == 0 { load() } else { Vec::new() };
    let turns: &[usize] = if rounds == 0 { &[asked] } else { &[0, asked] };
    let mut ratios = Vec::new();
    for round in 1..=rounds.max(1) {
        let mut jitter = Vec::new();
        for &devices in turns {
            let Ran {
                summary,
                done,
                failed,
                allocated,
            } = run(&pair.a, axes, devices, seconds);
            let late = &summary.wake_up_lateness;
            jitter.push(late.p99_9_ns as f64);
            let thread = summary.thread.as_ref().map(|thread| thread.used);
            let cycles = summary.counters.cycles.max(1);
            println!(
                "{round} asked {devices}: {:.2} / {:.1} / {:.1} / {:.0}, work {:.1}; {}, {allocated}; {:.2}; {} cycles, {} lost, {} wkc; {:.0} transfers/s, {failed} failed at the end",
                us(late.p50_ns),
                us(late.p99_ns),
                us(late.p99_9_ns),
                us(late.max_ns),
                us(summary.work.p99_9_ns),
                thread.map_or(0, |t| t.minor_faults + t.major_faults),
                thread.map_or(0.0, |t| t.voluntary_switches as f64 / cycles as f64),
                summary.counters.cycles,
                summary.counters.lost_frames,
                summary.counters.wkc_errors,
                done as f64 / summary.machine_seconds.max(1e-9),
            );
        }
        if let [quiet, asked] = jitter[..] {
            ratios.push(asked / quiet.max(1.0));
        }
    }
    ratios.sort_by(f64::total_cmp);
    if let Some(median) = ratios.get(ratios.len() / 2) {
        println!("p99.9 with traffic to without, by round: {ratios:.2?}; median {median:.2}");
    }
}
