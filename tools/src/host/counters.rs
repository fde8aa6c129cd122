//! The kernel's counters of a CPU: time used by others, and interrupts.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::doctor::Host;

/// `USER_HZ`, the unit of /proc/stat; 100 on every Linux.
const TICKS_PER_SECOND: u64 = 100;
const NANOS_PER_TICK: u64 = 1_000_000_000 / TICKS_PER_SECOND;
/// The maximum number of interrupt sources reported.
const MAX_REPORTED: usize = 4;

/// Counters of one CPU, or of all, since boot.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct CpuCounters {
    steal: u64,
    interrupt_time: u64,
    interrupts: BTreeMap<String, u64>,
}

/// The increments of a CPU's counters.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct CpuTimeDelta {
    /// Time taken by the hypervisor; resolution 10 ms.
    pub steal_ns: u64,
    /// Time taken by interrupts; resolution 10 ms.
    pub interrupt_ns: u64,
    pub interrupts: u64,
    /// The most frequent interrupts.
    pub most: Vec<Interrupt>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Interrupt {
    pub name: String,
    pub count: u64,
}

impl CpuCounters {
    /// Returns the present counters of a CPU or of all; empty if the kernel does not provide them.
    #[must_use]
    pub fn now(cpu: Option<usize>) -> Self {
        let read = |path| Host::here().text(path).unwrap_or_default();
        Self::parse(cpu, &read("proc/stat"), &read("proc/interrupts"))
    }

    fn parse(cpu: Option<usize>, stat: &str, interrupts: &str) -> Self {
        let name = cpu.map_or("cpu".to_owned(), |cpu| format!("cpu{cpu}"));
        let line = stat
            .lines()
            .map(|line| line.split_whitespace().collect::<Vec<_>>())
            .find(|words| words.first() == Some(&name.as_str()))
            .unwrap_or_default();
        // user nice system idle iowait irq softirq steal, see proc_stat(5)
        let ticks = |n: usize| line.get(n).and_then(|n| n.parse().ok()).unwrap_or(0_u64);
        Self {
            steal: ticks(8) * NANOS_PER_TICK,
            interrupt_time: (ticks(6) + ticks(7)) * NANOS_PER_TICK,
            interrupts: counts(cpu, interrupts),
        }
    }

    /// Returns the increments since `before`; `None` if the counters are not visible here.
    pub(crate) fn visible_since(&self, before: &Self) -> Option<CpuTimeDelta> {
        (*self != Self::default()).then(|| self.since(before))
    }

    /// Returns the increments since `before`.
    #[must_use]
    pub fn since(&self, before: &Self) -> CpuTimeDelta {
        let mut most: Vec<Interrupt> = self
            .interrupts
            .iter()
            .map(|(name, count)| Interrupt {
                name: name.clone(),
                count: count.saturating_sub(before.interrupts.get(name).copied().unwrap_or(0)),
            })
            .filter(|interrupt| interrupt.count > 0)
            .collect();
        most.sort_by_key(|i| std::cmp::Reverse(i.count));
        let interrupts = most.iter().map(|interrupt| interrupt.count).sum();
        most.truncate(MAX_REPORTED);
        CpuTimeDelta {
            steal_ns: self.steal.saturating_sub(before.steal),
            interrupt_ns: self.interrupt_time.saturating_sub(before.interrupt_time),
            interrupts,
            most,
        }
    }
}

impl CpuTimeDelta {
    /// Adds the increments of another measurement.
    pub fn add(&mut self, other: &Self) {
        self.steal_ns += other.steal_ns;
        self.interrupt_ns += other.interrupt_ns;
        self.interrupts += other.interrupts;
        for interrupt in &other.most {
            match self.most.iter_mut().find(|i| i.name == interrupt.name) {
                Some(known) => known.count += interrupt.count,
                None => self.most.push(interrupt.clone()),
            }
        }
        self.most.sort_by_key(|i| std::cmp::Reverse(i.count));
        self.most.truncate(MAX_REPORTED);
    }
}

/// Returns counts by device name, or by short name if there is no device.
fn counts(cpu: Option<usize>, text: &str) -> BTreeMap<String, u64> {
    let mut lines = text.lines();
    let head: Vec<&str> = lines
        .next()
        .unwrap_or_default()
        .split_whitespace()
        .collect();
    let named = |head: &str| cpu.is_none_or(|cpu| head == format!("CPU{cpu}"));
    let columns: Vec<usize> = (0..head.len()).filter(|n| named(head[*n])).collect();
    let mut counts = BTreeMap::new();
    for line in lines {
        let Some((short, rest)) = line.split_once(':') else {
            continue;
        };
        let words: Vec<&str> = rest.split_whitespace().collect();
        let count = |n: &usize| words.get(*n)?.parse::<u64>().ok();
        let Some(count) = columns
            .iter()
            .map(count)
            .reduce(|a, b| Some(a? + b?))
            .flatten()
        else {
            continue;
        };
        let reported = words.get(head.len()..).unwrap_or_default();
        // Numbered interrupts end with the device; others have a description.
        let name = match (short.trim().parse::<u32>(), reported.last()) {
            (Ok(_), Some(device)) => (*device).to_owned(),
            (Err(_), Some(_)) => reported.join(" "),
            (_, None) => short.trim().to_owned(),
        };
        *counts.entry(name).or_insert(0) += count;
    }
    counts
}

#[cfg(test)]
mod tests {
    use super::*;

    const STAT: &str = "cpu  9 9 9 9 9 9 9 9 0 0\ncpu0 1 2 3 4 5 6 7 8 0 0\ncpu1 10 20 30 40 50 60 70 80 0 0\nctxt 1\n";
    const INTERRUPTS: &str = "           CPU0       CPU1       \n 36:          0    1687085 PCI-MSIX-0000:00:02.0   1-edge      virtio1-req.0\n\
        LOC:    7129672    7491558   Local timer interrupts\nERR:          3\n";

    #[test]
    fn counters_read_one_cpu_from_both_files() {
        let view = CpuCounters::parse(Some(1), STAT, INTERRUPTS);
        assert_eq!(view.steal, 800_000_000);
        assert_eq!(view.interrupt_time, 1_300_000_000);
        let mut later = view.clone();
        later.steal += 20_000_000;
        *later.interrupts.get_mut("Local timer interrupts").unwrap() += 5;
        *later.interrupts.get_mut("virtio1-req.0").unwrap() += 7;
        let taken = later.since(&view);
        assert_eq!((taken.steal_ns, taken.interrupts), (20_000_000, 12));
        let names: Vec<_> = taken
            .most
            .iter()
            .map(|i| (i.name.as_str(), i.count))
            .collect();
        assert_eq!(names, [("virtio1-req.0", 7), ("Local timer interrupts", 5)]);
        let all = CpuCounters::parse(None, STAT, INTERRUPTS);
        assert_eq!(all.steal, 90_000_000);
        assert_eq!(all.interrupts["Local timer interrupts"], 14_621_230);
    }

    #[test]
    fn counters_of_a_missing_cpu_are_empty() {
        let view = CpuCounters::parse(Some(7), STAT, INTERRUPTS);
        assert_eq!(view, CpuCounters::default());
        assert_eq!(
            CpuCounters::parse(Some(0), "", "garbage\n: :\n"),
            CpuCounters::default()
        );
    }
}
