//! What the kernel counts for a CPU: time that others had of it, and what interrupted it.

use std::collections::BTreeMap;
use std::fs;

use serde::Serialize;

/// `USER_HZ`, the unit of /proc/stat, is this on every Linux there is.
const TICKS_PER_SECOND: u64 = 100;
const NANOS_PER_TICK: u64 = 1_000_000_000 / TICKS_PER_SECOND;
/// The most frequent interrupts, of which to tell.
const TOLD: usize = 4;

/// Counters of one CPU since the computer was started.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct CpuView {
    steal: u64,
    interrupt_time: u64,
    interrupts: BTreeMap<String, u64>,
}

/// What happened on a CPU meanwhile.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct CpuTaken {
    /// By the hypervisor for others, to 10 ms.
    pub steal_ns: u64,
    /// By interrupts, to 10 ms.
    pub interrupt_ns: u64,
    pub interrupts: u64,
    /// The most frequent ones.
    pub most: Vec<Interrupt>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Interrupt {
    pub name: String,
    pub count: u64,
}

impl CpuView {
    /// As it is now; empty where the kernel does not tell.
    #[must_use]
    pub fn now(cpu: usize) -> Self {
        let read = |path| fs::read_to_string(path).unwrap_or_default();
        Self::parse(cpu, &read("/proc/stat"), &read("/proc/interrupts"))
    }

    fn parse(cpu: usize, stat: &str, interrupts: &str) -> Self {
        let name = format!("cpu{cpu}");
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

    /// What has come since `before`.
    #[must_use]
    pub fn since(&self, before: &Self) -> CpuTaken {
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
        most.truncate(TOLD);
        CpuTaken {
            steal_ns: self.steal.saturating_sub(before.steal),
            interrupt_ns: self.interrupt_time.saturating_sub(before.interrupt_time),
            interrupts,
            most,
        }
    }
}

impl CpuTaken {
    /// Both together.
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
        self.most.truncate(TOLD);
    }
}

/// By the text after the columns of the CPUs, or the short name where there is none.
fn counts(cpu: usize, text: &str) -> BTreeMap<String, u64> {
    let mut lines = text.lines();
    let head: Vec<&str> = lines
        .next()
        .unwrap_or_default()
        .split_whitespace()
        .collect();
    let name = format!("CPU{cpu}");
    let Some(column) = head.iter().position(|cpu| *cpu == name) else {
        return BTreeMap::new();
    };
    let mut counts = BTreeMap::new();
    for line in lines {
        let Some((short, rest)) = line.split_once(':') else {
            continue;
        };
        let words: Vec<&str> = rest.split_whitespace().collect();
        let Some(count) = words.get(column).and_then(|n| n.parse::<u64>().ok()) else {
            continue;
        };
        let told = words.get(head.len()..).unwrap_or_default();
        // Numbered ones end with the device, the others are a phrase.
        let name = match (short.trim().parse::<u32>(), told.last()) {
            (Ok(_), Some(device)) => (*device).to_owned(),
            (Err(_), Some(_)) => told.join(" "),
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
    fn one_cpu_is_read_out_of_both_files() {
        let view = CpuView::parse(1, STAT, INTERRUPTS);
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
    }

    #[test]
    fn nothing_is_told_of_a_cpu_that_is_not_there() {
        let view = CpuView::parse(7, STAT, INTERRUPTS);
        assert_eq!(view, CpuView::default());
        assert_eq!(CpuView::parse(0, "", "garbage\n: :\n"), CpuView::default());
    }
}
