//! Wake-up latency of a thread by the cycle's own clock, and by cyclictest.

use std::io;
use std::process::{Command, Stdio};

use ecaxis_master::clock::{self, Clock, Nanos};
use ecaxis_master::rt::spin::SpinWindow;
use ecaxis_master::rt::stats::LatencyHistogram;
use ecaxis_master::sys::process::ThreadUsage;

/// The result of a wake-up method over all rounds.
#[derive(Debug, Clone, Default)]
pub struct Wakeups {
    /// Planned release to actual release.
    pub lateness: LatencyHistogram,
    /// The latency of sleeping, before the spin.
    pub slept: LatencyHistogram,
    pub used: ThreadUsage,
    pub wall_ns: Nanos,
}

impl Wakeups {
    /// Runs `cycles` on the calling thread, which only wakes up. Cycles that are over at the
    /// wake-up are skipped.
    ///
    /// # Errors
    /// Returns the error of getrusage(2).
    pub fn round(&mut self, cycle: Nanos, margin: &mut SpinWindow, cycles: u32) -> io::Result<()> {
        let (before, began) = (ThreadUsage::now()?, clock::now());
        let mut next = began + cycle;
        for _ in 0..cycles {
            let slept = Clock::Real.sleep_until(next, margin.get());
            let now = clock::now();
            self.lateness.record(now.saturating_sub(next));
            if let Some(late) = slept {
                self.slept.record(late);
            }
            margin.record_wakeup(slept);
            next += cycle;
            if next < now {
                next = now + cycle;
            }
        }
        let used = ThreadUsage::now()?.since(before);
        self.used = self.used.plus(used);
        self.wall_ns += clock::now() - began;
        Ok(())
    }
}

/// A cyclictest thread (rt-tests) with the parameters of ours.
#[derive(Debug, Clone, Copy)]
pub struct Cyclictest {
    pub cycle: Nanos,
    pub priority: u8,
    pub cpu: Option<usize>,
}

/// The maximum latency of cyclictest's histogram in ns.
const LONGEST_NS: u64 = 1_000_000;

impl Cyclictest {
    /// Runs cyclictest for this many cycles and adds its histogram in ns.
    ///
    /// # Errors
    /// Fails if cyclictest is not installed, fails, or prints an invalid result.
    pub fn round(&self, cycles: u32, lateness: &mut LatencyHistogram) -> io::Result<()> {
        let mut command = Command::new("cyclictest");
        command
            .args(["--quiet", "--mlockall", "--threads=1", "--nsecs"])
            .arg(format!("--priority={}", self.priority))
            .arg(format!("--interval={}", self.cycle / 1_000))
            .arg(format!("--loops={cycles}"))
            .arg(format!("--histogram={LONGEST_NS}"));
        if let Some(cpu) = self.cpu {
            command.arg(format!("--affinity={cpu}"));
        }
        let output = command.stdin(Stdio::null()).output()?;
        let text = String::from_utf8_lossy(&output.stdout);
        if !output.status.success() {
            let reported = String::from_utf8_lossy(&output.stderr);
            return Err(io::Error::other(format!("cyclictest: {}", reported.trim())));
        }
        let seen = histogram(&text, lateness);
        if seen == 0 {
            return Err(io::Error::other("cyclictest printed no histogram"));
        }
        Ok(())
    }
}

/// Adds the lines `013562 000042` (ns, count). Values beyond the histogram are counted at its
/// limit, except the longest. Returns their number.
fn histogram(text: &str, lateness: &mut LatencyHistogram) -> u64 {
    let mut seen = 0;
    let mut add = |nanos: u64, count: u64| {
        lateness.record_n(nanos, count);
        seen += count;
    };
    let number = |line: &str, head: &str| line.strip_prefix(head)?.trim().parse::<u64>().ok();
    let (mut beyond, mut longest) = (0, LONGEST_NS);
    for line in text.lines() {
        if let Some(count) = number(line, "# Histogram Overflows:") {
            beyond = count;
            continue;
        }
        if let Some(nanos) = number(line, "# Max Latencies:") {
            longest = nanos;
            continue;
        }
        let mut words = line.split_whitespace();
        let (Some(nanos), Some(count), None) = (words.next(), words.next(), words.next()) else {
            continue;
        };
        if let (Ok(nanos), Ok(count)) = (nanos.parse::<u64>(), count.parse::<u64>())
            && nanos < LONGEST_NS
            && count > 0
        {
            add(nanos, count);
        }
    }
    if beyond > 0 {
        add(longest.max(LONGEST_NS), 1);
        if beyond > 1 {
            add(LONGEST_NS, beyond - 1);
        }
    }
    seen
}

#[cfg(test)]
mod tests {
    use super::*;
    use ecaxis_master::rt::exchange::ExchangeMode;
    use ecaxis_master::rt::spin::Spin;

    #[test]
    fn round_counts_every_cycle_once() {
        let mut wakeups = Wakeups::default();
        for spin in [Spin::Auto, Spin::For(0)] {
            let mut margin = SpinWindow::new(spin, 1_000_000, ExchangeMode::SameCycle);
            wakeups.round(1_000_000, &mut margin, 20).unwrap();
        }
        assert_eq!(wakeups.lateness.summary().count, 40);
        assert!(wakeups.slept.summary().count > 0);
        assert!(wakeups.used.voluntary_switches > 0);
    }

    #[test]
    fn histogram_parses_cyclictest_output() {
        let text = "# /dev/cpu_dma_latency set to 0us\n# Histogram\n000000 000000\n012345 000007\n013000 000002\n\
                    # Total: 000000009\n# Min Latencies: 12345\n# Max Latencies: 20000042\n\
                    # Histogram Overflows: 00002\n# Thread 0: 00042\n";
        let mut times = LatencyHistogram::new();
        assert_eq!(histogram(text, &mut times), 11);
        let summary = times.summary();
        assert_eq!(summary.count, 11);
        assert_eq!(summary.p50_ns / 100, 123);
        assert!(summary.max_ns >= 20_000_000);

        let short = "012000 000007\n013000 000002\n000500 000000\n# Max Latencies: 13000\n# Histogram Overflows: 00000\n";
        let mut times = LatencyHistogram::new();
        assert_eq!(histogram(short, &mut times), 9);
        assert_eq!(times.summary().max_ns / 1_000, 13);
    }
}
