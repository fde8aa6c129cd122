//! The computer that runs a bench.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};

use rustix::thread::{CpuSet, sched_getaffinity};

use crate::host::{Fact, Host};
use ecaxis_master::sys::rt_thread::pin;

/// Returns the CPU for the cycle, isolated if possible, and the CPU for all other work. Both are
/// CPUs that this process may use.
#[must_use]
pub fn cpus() -> (usize, Option<usize>) {
    let allowed: Vec<usize> = sched_getaffinity(None).map_or_else(
        |_| vec![0],
        |set| {
            (0..CpuSet::MAX_CPU)
                .filter(|cpu| set.is_set(*cpu))
                .collect()
        },
    );
    let isolated = Host::here().cpus("sys/devices/system/cpu/isolated");
    let isolated = isolated.unwrap_or_default();
    let last = allowed.iter().rev();
    let cycle = last
        .clone()
        .find(|cpu| isolated.contains(**cpu))
        .or(allowed.last())
        .copied()
        .unwrap_or(0);
    let other = last.copied().find(|cpu| *cpu != cycle);
    (cycle, other)
}

/// Returns the online CPUs in the kernel's notation if `cpu` is not one of them.
#[must_use]
pub fn without(cpu: usize) -> Option<String> {
    let online = Host::here().cpus("sys/devices/system/cpu/online")?;
    (!online.contains(cpu)).then(|| online.to_string())
}

/// Adds the processor and the load to the facts about the computer.
pub(super) fn facts(known: Vec<Fact>) -> Vec<Fact> {
    let host = Host::here();
    let info = host.text("proc/cpuinfo").unwrap_or_default();
    let model = info.lines().find_map(|line| {
        let (name, value) = line.split_once(':')?;
        (name.trim() == "model name").then(|| value.trim().to_owned())
    });
    let load = host.text("proc/loadavg");
    let load = load.and_then(|load| Some(load.split_whitespace().next()?.to_owned()));
    let fact = |name, value: Option<String>| value.map(|value| Fact { name, value });
    let mut facts: Vec<Fact> = fact("processor", model).into_iter().collect();
    facts.extend(known);
    facts.extend(fact("load at the end", load));
    facts
}

/// A SCHED_OTHER thread that loads a CPU and the memory bus until dropped.
#[derive(Debug)]
pub struct Hog {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// Larger than most caches, in words.
const HOG_WORDS: usize = 1 << 20;

impl Hog {
    /// Starts the thread on `cpu`.
    ///
    /// # Errors
    /// Fails if no thread can be started.
    pub fn start(cpu: usize) -> std::io::Result<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let ended = Arc::clone(&stop);
        let thread = thread::Builder::new()
            .name("ecaxis-hog".to_owned())
            .spawn(move || {
                if pin(cpu).is_ok() {
                    let mut words = vec![0_u64; HOG_WORDS];
                    while !ended.load(Ordering::Relaxed) {
                        for word in words.iter_mut().step_by(8) {
                            *word = word.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                        }
                        std::hint::black_box(&mut words);
                    }
                }
            })?;
        Ok(Self {
            stop,
            thread: Some(thread),
        })
    }
}

impl Drop for Hog {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cpus_are_two_different_ones() {
        let (cpu, other) = cpus();
        assert_ne!(Some(cpu), other);
    }
}
