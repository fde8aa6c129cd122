//! Wake-up lateness of the cycle's clock: sleeping to shortly before the release and spinning the
//! rest, against plain sleeping, in turns in the same run. Only the ratio means anything on a
//! machine that others use too.

#![allow(clippy::print_stdout, reason = "a benchmark prints its result")]

use ecaxis::clock::{self, Clock};
use ecaxis::rt::stats::Times;
use ecaxis::rt::thread;

const CYCLE: u64 = 1_000_000;
const CYCLES_A_ROUND: u32 = 1_000;
const ROUNDS: u32 = 5;
const SPIN: u64 = 100_000;

fn round(spin: u64, lateness: &mut Times) {
    let mut next = clock::now() + CYCLE;
    for _ in 0..CYCLES_A_ROUND {
        Clock::Real.sleep_until(next, spin);
        let now = clock::now();
        lateness.record(now.saturating_sub(next));
        next += CYCLE;
        // What has been missed is not made up for.
        next = next.max(now);
    }
}

fn main() {
    for denied in thread::prepare(80, None) {
        println!("note: {denied}");
    }
    let (mut sleeping, mut spinning) = (Times::new(), Times::new());
    for _ in 0..ROUNDS {
        round(0, &mut sleeping);
        round(SPIN, &mut spinning);
    }
    let (sleeping, spinning) = (sleeping.summary(), spinning.summary());
    println!(
        "wake-up lateness at 1 kHz, {ROUNDS} rounds of {CYCLES_A_ROUND} cycles each, in turns"
    );
    println!(
        "{:>8} {:>12} {:>12} {:>8}",
        "", "sleep", "sleep+spin", "ratio"
    );
    for (name, a, b) in [
        ("p50", sleeping.p50_ns, spinning.p50_ns),
        ("p99", sleeping.p99_ns, spinning.p99_ns),
        ("p99.9", sleeping.p99_9_ns, spinning.p99_9_ns),
        ("max", sleeping.max_ns, spinning.max_ns),
    ] {
        println!(
            "{name:>8} {a:>9} ns {b:>9} ns {:>8.3}",
            b as f64 / a.max(1) as f64
        );
    }
}
