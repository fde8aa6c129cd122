//! The round-trip cost of a frame over each socket kind, alternating in one run, on a veth pair
//! whose other end answers after 30 µs. The software's share is the round trip minus these 30 µs.
//! Requires root and two CPUs.
//!
//! `cargo bench --bench wire -- [MILLISECONDS]`: the duration of a round (default 1000).

#![allow(clippy::print_stdout, reason = "a benchmark prints its result")]

use ecaxis_master::link::{self, SocketKind};
use ecaxis_master::rt::exchange::ExchangeMode;
use ecaxis_master::rt::spin::{Spin, SpinWindow};
use ecaxis_master::sys::rt_thread::{self, CpuWakeGuard};
use ecaxis_tools::bench::bus::{Bus, FaultInjection, Options, ReplyDelay};
use ecaxis_tools::bench::exchange::Exchanges;
use ecaxis_tools::bench::segment::BenchSegment;
use ecaxis_tools::bench::veth::VethPair;

const PRIORITY: u8 = 80;
const ROUNDS: usize = 6;
const HOLD_NS: u64 = 30_000;
/// The bytes of the datagrams: 192 bytes of process data and their headers.
const DATA: u16 = 230;

fn main() {
    let said = std::env::args().skip(1).find_map(|a| a.parse().ok());
    let round_ms: u32 = said.unwrap_or(1_000);
    let (_held, mut denied) = CpuWakeGuard::take(None);
    denied.extend(rt_thread::become_realtime(PRIORITY, Some(1)));
    for denied in denied {
        println!("note: {denied}");
    }
    for cycle in [1_000_000_u64, 250_000, 125_000] {
        let rate = 1_000_000_000 / cycle;
        let pair = match VethPair::new() {
            Ok(pair) => pair,
            Err(error) => {
                println!("skipped: a veth pair needs root: {error}");
                return;
            }
        };
        let options = Options {
            hold: ReplyDelay::Fixed(HOLD_NS),
            cycle_ns: cycle,
            mischief: FaultInjection::default(),
            priority: PRIORITY - 20,
            cpu: Some(0),
            slack_ns: cycle / 2,
        };
        let bus = Bus::on(&pair, BenchSegment::new([], 0), options).expect("the other end answers");
        let cycles = u32::try_from(u64::from(round_ms) * rate / 1_000).unwrap_or(1_000);
        let mut results = vec![Exchanges::default(); SocketKind::ALL.len()];
        for round in 0..ROUNDS {
            // Each round starts with another socket kind.
            for turn in 0..SocketKind::ALL.len() {
                let which = (turn + round) % SocketKind::ALL.len();
                let (back_end, result) = (&SocketKind::ALL[which], &mut results[which]);
                // Only one socket is open at a time, because the kernel copies every frame for each
                // open socket.
                let (mut link, concerns) =
                    link::open(&pair.a, *back_end).expect("an interface of ours");
                assert_eq!(concerns, [], "it is this back-end that is measured");
                let mut margin = SpinWindow::new(Spin::For(20_000), cycle, ExchangeMode::SameCycle);
                let done = result.round(link.as_mut(), DATA, cycle, &mut margin, cycles);
                done.expect("the link works");
            }
        }
        println!(
            "\n{rate} Hz, {ROUNDS} rounds of {cycles} cycles each in turns, {DATA} bytes of datagrams\n\
             {:<8} {:>9} {:>9} {:>9} {:>12} {:>11} {:>12} {:>6}",
            "link", "p50 µs", "p99", "p99.9", "software p50", "CPU µs/cycle", "switches", "lost"
        );
        for (back_end, result) in SocketKind::ALL.iter().zip(&results) {
            let p = result.round_trip.summary();
            let us = |ns: u64| ns as f64 / 1e3;
            println!(
                "{:<8} {:>9.2} {:>9.2} {:>9.2} {:>12.2} {:>11.2} {:>12.2} {:>6}",
                back_end.name(),
                us(p.p50_ns),
                us(p.p99_ns),
                us(p.p99_9_ns),
                us(p.p50_ns.saturating_sub(HOLD_NS)),
                result.cpu_ns_a_cycle() / 1e3,
                result.used.voluntary_switches as f64 / result.cycles.max(1) as f64,
                result.lost,
            );
        }
        println!("{} frames answered", bus.counts().replies);
    }
}
