//! Compares the wake-up lateness of the cycle's clock with cyclictest, alternating in one run:
//! spinning as long as needed, plain sleep, and both on a CPU that is kept awake. Class, priority,
//! CPU and interval are the same for all. On a shared computer only the ratios are meaningful.
//!
//! `cargo bench --bench jitter -- [CPU [SECONDS [hog]]]`: the CPU (default 1), the seconds per
//! round (default 2), and `hog` to keep the other CPUs busy.

#![allow(clippy::print_stdout, reason = "a benchmark prints its result")]

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use ecaxis_master::clock::Nanos;
use ecaxis_master::rt::exchange::ExchangeMode;
use ecaxis_master::rt::spin::{Spin, SpinWindow};
use ecaxis_master::rt::stats::{LatencyHistogram, Percentiles};
use ecaxis_master::sys::idle_spinner::IdleSpinner;
use ecaxis_master::sys::rt_thread::{self, CpuWakeGuard};
use ecaxis_tools::bench::wakeup::{Cyclictest, Wakeups};

const PRIORITY: u8 = 80;
const ROUNDS: u32 = 3;

fn row(name: &str, p: &Percentiles, during: &Percentiles, cpu: Option<f64>) {
    let ratio = |a: u64, b: u64| a as f64 / b.max(1) as f64;
    println!(
        "{name:<22} {:>8.2} {:>8.2} {:>8.2} {:>9.2}   {:>6.3} {:>6.3} {:>6.3}   {}",
        p.p50_ns as f64 / 1e3,
        p.p99_ns as f64 / 1e3,
        p.p99_9_ns as f64 / 1e3,
        p.max_ns as f64 / 1e3,
        ratio(p.p50_ns, during.p50_ns),
        ratio(p.p99_ns, during.p99_ns),
        ratio(p.p99_9_ns, during.p99_9_ns),
        cpu.map_or(String::new(), |cpu| format!("{cpu:.1} %")),
    );
}

fn measure(cycle: Nanos, cpu: usize, seconds: u32, awake: bool) {
    let cycles = seconds * u32::try_from(1_000_000_000 / cycle).unwrap_or(1_000);
    let spinner = awake.then(|| IdleSpinner::start(cpu));
    if let Some(Err(denied)) = &spinner {
        println!("note: {denied}");
        return;
    }
    let reference = Cyclictest {
        cycle,
        priority: PRIORITY,
        cpu: Some(cpu),
    };
    let (mut theirs, mut auto, mut plain) = (
        LatencyHistogram::new(),
        Wakeups::default(),
        Wakeups::default(),
    );
    let mut margin = SpinWindow::new(Spin::Auto, cycle, ExchangeMode::SameCycle);
    let mut sleeping = SpinWindow::new(Spin::For(0), cycle, ExchangeMode::SameCycle);
    for _ in 0..ROUNDS {
        if let Err(error) = reference.round(cycles, &mut theirs) {
            println!("note: {error}");
        }
        auto.round(cycle, &mut margin, cycles).expect("getrusage");
        plain
            .round(cycle, &mut sleeping, cycles)
            .expect("getrusage");
    }
    println!(
        "\n{} Hz, {ROUNDS} rounds of {cycles} cycles each in turns{}; spun before a release at the end: {:.1} µs\n\
         {:<22} {:>8} {:>8} {:>8} {:>9}   {:>6} {:>6} {:>6}   CPU",
        1_000_000_000 / cycle,
        if awake { ", CPU kept awake" } else { "" },
        margin.get() as f64 / 1e3,
        "lateness, µs",
        "p50",
        "p99",
        "p99.9",
        "max",
        "p50",
        "p99",
        "p99.9",
    );
    let during = theirs.summary();
    let load = |w: &Wakeups| Some(w.used.load_percent(w.wall_ns));
    row("cyclictest", &during, &during, None);
    row(
        "sleep, then spin",
        &auto.lateness.summary(),
        &during,
        load(&auto),
    );
    row(
        "sleep alone",
        &plain.lateness.summary(),
        &during,
        load(&plain),
    );
}

fn main() {
    let mut arguments = std::env::args().skip(1).filter(|a| a != "--bench");
    let mut number = |default: u32| {
        let said = arguments.next().and_then(|a| a.parse().ok());
        said.unwrap_or(default)
    };
    let cpu = usize::try_from(number(1)).unwrap_or(1);
    let seconds = number(2);
    let hog = std::env::args().any(|a| a == "hog");

    let stop = Arc::new(AtomicBool::new(false));
    let cpus = std::thread::available_parallelism().map_or(1, |n| n.get());
    let others = (0..cpus).filter(|other| hog && *other != cpu);
    let hogs: Vec<_> = others
        .map(|other| {
            let stop = Arc::clone(&stop);
            std::thread::spawn(move || {
                let _ = rt_thread::pin(other);
                while !stop.load(Ordering::Relaxed) {
                    std::hint::spin_loop();
                }
            })
        })
        .collect();
    let (_held, mut denied) = CpuWakeGuard::take(None);
    denied.extend(rt_thread::become_realtime(PRIORITY, Some(cpu)));
    for denied in denied {
        println!("note: {denied}");
    }
    println!(
        "CPU {cpu}, SCHED_FIFO {PRIORITY}{}; ratios are to cyclictest of the same rounds",
        if hog { ", other CPUs busy" } else { "" }
    );
    for awake in [false, true] {
        for cycle in [1_000_000, 250_000] {
            measure(cycle, cpu, seconds, awake);
        }
    }
    stop.store(true, Ordering::Relaxed);
    for hog in hogs {
        let _ = hog.join();
    }
}
