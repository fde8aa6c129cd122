//! How late a thread wakes up for its cycles: with the cycle's own clock, and as cyclictest sees the same computer.

use std::io;
use std::process::{Command, Stdio};

use crate::clock::{self, Clock, Nanos};
use crate::os::process::ThreadUse;
use crate::rt::margin::Margin;
use crate::rt::stats::Times;

/// What a way of waking up came to, over any number of rounds.
#[derive(Debug, Clone, Default)]
pub struct Wakeups {
    /// Release planned to release.
    pub lateness: Times,
    /// How late sleeping ended, before anything was spun.
    pub slept: Times,
    pub used: ThreadUse,
    pub wall_ns: Nanos,
}

impl Wakeups {
    /// Adds so many cycles of the calling thread, which does nothing but wake up. A cycle that is over when the thread wakes is
    /// left out.
    ///
    /// # Errors
    /// What getrusage(2) says.
    pub fn round(&mut self, cycle: Nanos, margin: &mut Margin, cycles: u32) -> io::Result<()> {
        let (before, began) = (ThreadUse::now()?, clock::now());
        let mut next = began + cycle;
        for _ in 0..cycles {
            let slept = Clock::Real.sleep_until(next, margin.get());
            let now = clock::now();
            self.lateness.record(now.saturating_sub(next));
            if let Some(late) = slept {
                self.slept.record(late);
            }
            margin.slept(slept);
            next += cycle;
            if next < now {
                next = now + cycle;
            }
        }
        let used = ThreadUse::now()?.since(before);
        self.used = self.used.plus(used);
        self.wall_ns += clock::now() - began;
        Ok(())
    }
}

/// A thread of cyclictest (rt-tests) like ours.
#[derive(Debug, Clone, Copy)]
pub struct Cyclictest {
    pub cycle: Nanos,
    pub priority: u8,
    pub cpu: Option<usize>,
}

/// Longest lateness that its histogram tells apart, ns; it takes no more.
const LONGEST_NS: u64 = 1_000_000;

impl Cyclictest {
    /// Runs it for so many cycles and adds what it saw, in nanoseconds.
    ///
    /// # Errors
    /// Where cyclictest is not installed, fails, or prints something else.
    pub fn round(&self, cycles: u32, lateness: &mut Times) -> io::Result<()> {
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
            let told = String::from_utf8_lossy(&output.stderr);
            return Err(io::Error::other(format!("cyclictest: {}", told.trim())));
        }
        let seen = histogram(&text, lateness);
        if seen == 0 {
            return Err(io::Error::other("cyclictest printed no histogram"));
        }
        Ok(())
    }
}

/// Adds the lines `013562 000042` (nanoseconds, how often). Of those that were longer than the histogram only the longest is
/// known; the others are added as if they had just not fitted. Returns how many there were.
fn histogram(text: &str, lateness: &mut Times) -> u64 {
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
    use crate::rt::exchange::Mode;
    use crate::rt::margin::Spin;

    #[test]
    fn every_cycle_is_counted_once() {
        let mut wakeups = Wakeups::default();
        for spin in [Spin::Auto, Spin::For(0)] {
            let mut margin = Margin::new(spin, 1_000_000, Mode::SameCycle);
            wakeups.round(1_000_000, &mut margin, 20).unwrap();
        }
        assert_eq!(wakeups.lateness.summary().count, 40);
        assert!(wakeups.slept.summary().count > 0);
        assert!(wakeups.used.voluntary_switches > 0);
    }

    #[test]
    fn a_histogram_of_cyclictest() {
        let text = "# /dev/cpu_dma_latency set to 0us\n# Histogram\n000000 000000\n012345 000007\n013000 000002\n\
                    # Total: 000000009\n# Min Latencies: 12345\n# Max Latencies: 20000042\n\
                    # Histogram Overflows: 00002\n# Thread 0: 00042\n";
        let mut times = Times::new();
        assert_eq!(histogram(text, &mut times), 11);
        let summary = times.summary();
        assert_eq!(summary.count, 11);
        assert_eq!(summary.p50_ns / 100, 123);
        assert!(summary.max_ns >= 20_000_000);

        let short = "012000 000007\n013000 000002\n000500 000000\n# Max Latencies: 13000\n# Histogram Overflows: 00000\n";
        let mut times = Times::new();
        assert_eq!(histogram(short, &mut times), 9);
        assert_eq!(times.summary().max_ns / 1_000, 13);
    }
}
