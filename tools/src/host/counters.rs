//! The kernel's counters of a CPU: time used by others, and interrupts.

use std::collections::BTreeMap;

use serde::Serialize;

use super::Host;

/// `USER_HZ`, the unit of /proc/stat; 100 on every Linux.
const TICKS_PER_SECOND: u64 = 100;
const NANOS_PER_TICK: u64 = 1_000_000_000 / TICKS_PER_SECOND;
/// The maximum number of interrupt sources reported.
const MAX_REPORTED: usize = 4;

/// Counters of one CPU, or of all, since boot. `None`: the kernel does not provide them.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct CpuCounters {
    steal_ns: Option<u64>,
    interrupt_ns: Option<u64>,
    interrupts: Option<BTreeMap<String, u64>>,
}

/// The increments of a CPU's counters. `None`: the kernel does not provide them.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct CpuTimeDelta {
    /// Time taken by the hypervisor; resolution 10 ms.
    pub steal_ns: Option<u64>,
    /// Time taken by interrupts; resolution 10 ms.
    pub interrupt_ns: Option<u64>,
    pub interrupts: Option<u64>,
    /// The most frequent interrupts.
    pub most: Vec<Interrupt>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Interrupt {
    pub name: String,
    pub count: u64,
}

impl CpuCounters {
    /// Returns the present counters of a CPU or of all.
    #[must_use]
    pub fn now(cpu: Option<usize>) -> Self {
        let read = |path| Host::here().text(path).unwrap_or_default();
        Self::parse(cpu, &read("proc/stat"), &read("proc/interrupts"))
    }

    fn parse(cpu: Option<usize>, stat: &str, interrupts: &str) -> Self {
        let ticks = ticks(cpu, stat);
        // user nice system idle iowait irq softirq steal, see proc_stat(5)
        let nanos = |n: usize| Some(ticks.as_ref()?.get(n)? * NANOS_PER_TICK);
        Self {
            steal_ns: nanos(7),
            interrupt_ns: nanos(5).zip(nanos(6)).map(|(hard, soft)| hard + soft),
            interrupts: counts(cpu, interrupts),
        }
    }

    /// Returns the increments since `before`.
    #[must_use]
    pub fn since(&self, before: &Self) -> CpuTimeDelta {
        let difference = |now: Option<u64>, before: Option<u64>| {
            now.zip(before)
                .map(|(now, before)| now.saturating_sub(before))
        };
        let counts = self.interrupts.as_ref().zip(before.interrupts.as_ref());
        let mut most: Vec<Interrupt> = counts
            .into_iter()
            .flat_map(|(now, before)| {
                now.iter().map(|(name, count)| Interrupt {
                    name: name.clone(),
                    count: count.saturating_sub(before.get(name).copied().unwrap_or(0)),
                })
            })
            .filter(|interrupt| interrupt.count > 0)
            .collect();
        most.sort_by_key(|i| std::cmp::Reverse(i.count));
        let interrupts = counts.map(|_| most.iter().map(|interrupt| interrupt.count).sum());
        most.truncate(MAX_REPORTED);
        CpuTimeDelta {
            steal_ns: difference(self.steal_ns, before.steal_ns),
            interrupt_ns: difference(self.interrupt_ns, before.interrupt_ns),
            interrupts,
            most,
        }
    }
}

impl CpuTimeDelta {
    /// Adds the increments of another measurement. A sum with an unknown part is unknown.
    pub fn add(&mut self, other: &Self) {
        let sum = |a: Option<u64>, b: Option<u64>| a.zip(b).map(|(a, b)| a + b);
        self.steal_ns = sum(self.steal_ns, other.steal_ns);
        self.interrupt_ns = sum(self.interrupt_ns, other.interrupt_ns);
        self.interrupts = sum(self.interrupts, other.interrupts);
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

/// Returns the columns of a CPU in /proc/stat. Some containers show zeros only: `None`.
fn ticks(cpu: Option<usize>, stat: &str) -> Option<Vec<u64>> {
    let name = cpu.map_or("cpu".to_owned(), |cpu| format!("cpu{cpu}"));
    let ticks = stat.lines().find_map(|line| {
        let (first, columns) = line.split_once(' ')?;
        (first == name).then(|| {
            let columns = columns.split_whitespace();
            columns.map_while(|word| word.parse().ok()).collect()
        })
    });
    ticks.filter(|ticks: &Vec<u64>| ticks.iter().any(|n| *n > 0))
}

/// Returns counts by device name, or by short name if there is no device. `None` without a column
/// of `cpu`.
fn counts(cpu: Option<usize>, text: &str) -> Option<BTreeMap<String, u64>> {
    let mut lines = text.lines();
    let head: Vec<&str> = lines.next()?.split_whitespace().collect();
    let column = match cpu {
        Some(cpu) => Some(head.iter().position(|h| *h == format!("CPU{cpu}"))?),
        None => None,
    };
    if !head.iter().any(|name| name.starts_with("CPU")) {
        return None;
    }
    let mut counts = BTreeMap::new();
    for line in lines {
        let Some((short, rest)) = line.split_once(':') else {
            continue;
        };
        let words: Vec<&str> = rest.split_whitespace().collect();
        let columns = words.iter().take(head.len());
        let columns: Vec<u64> = columns.map_while(|word| word.parse().ok()).collect();
        let count = match column {
            // ERR and MIS have one column for all CPUs.
            Some(_) if columns.len() < head.len() => continue,
            Some(column) => columns[column],
            None if columns.is_empty() => continue,
            None => columns.iter().sum(),
        };
        let reported = &words[columns.len()..];
        // Numbered interrupts end with the device; others have a description.
        let name = match (short.trim().parse::<u32>(), reported.last()) {
            (Ok(_), Some(device)) => (*device).to_owned(),
            (Err(_), Some(_)) => reported.join(" "),
            (_, None) => short.trim().to_owned(),
        };
        *counts.entry(name).or_insert(0) += count;
    }
    Some(counts)
}

#[cfg(test)]
mod tests {
    use super::*;

    const STAT: &str = "\
cpu  11 22 33 44 55 66 77 88 0 0
cpu0 1 2 3 4 5 6 7 8 0 0
cpu1 10 20 30 40 50 60 70 80 0 0
ctxt 1
";
    const INTERRUPTS: &str = "           CPU0       CPU1
 36:          0    1687085 PCI-MSIX-0000:00:02.0   1-edge      virtio1-req.0
LOC:    7129672    7491558   Local timer interrupts
ERR:          3
MIS:          0
";

    fn named(delta: &CpuTimeDelta) -> Vec<(&str, u64)> {
        let most = delta.most.iter();
        most.map(|i| (i.name.as_str(), i.count)).collect()
    }

    #[test]
    fn counters_read_one_cpu_from_both_files() {
        let view = CpuCounters::parse(Some(1), STAT, INTERRUPTS);
        assert_eq!(view.steal_ns, Some(800_000_000));
        assert_eq!(view.interrupt_ns, Some(1_300_000_000));
        let stat = STAT.replace(" 80 ", " 82 ");
        let interrupts = INTERRUPTS
            .replace("1687085", "1687092")
            .replace("7491558", "7491563")
            .replace("ERR:          3", "ERR:          9");
        let taken = CpuCounters::parse(Some(1), &stat, &interrupts).since(&view);
        assert_eq!(taken.steal_ns, Some(20_000_000));
        assert_eq!(taken.interrupts, Some(12));
        assert_eq!(
            named(&taken),
            [("virtio1-req.0", 7), ("Local timer interrupts", 5)]
        );
    }

    #[test]
    fn counters_of_all_cpus_sum_the_columns_that_exist() {
        let all = CpuCounters::parse(None, STAT, INTERRUPTS);
        assert_eq!(all.steal_ns, Some(880_000_000));
        let interrupts = all.interrupts.as_ref().expect("there are columns");
        assert_eq!(interrupts["Local timer interrupts"], 14_621_230);
        assert_eq!((interrupts["ERR"], interrupts["MIS"]), (3, 0));
        let later = INTERRUPTS.replace("ERR:          3", "ERR:          5");
        let taken = CpuCounters::parse(None, STAT, &later).since(&all);
        assert_eq!(named(&taken), [("ERR", 2)]);
    }

    #[test]
    fn counters_of_a_missing_source_are_unknown() {
        let unknown = CpuCounters::default();
        assert_eq!(CpuCounters::parse(Some(7), STAT, INTERRUPTS), unknown);
        for (stat, interrupts) in [
            ("", ""),
            ("", "garbage\n: :\n"),
            ("cpu  0 0 0 0 0 0 0 0 0 0\ncpu0 0 0 0 0 0 0 0 0 0 0\n", ""),
        ] {
            assert_eq!(CpuCounters::parse(Some(0), stat, interrupts), unknown);
            assert_eq!(CpuCounters::parse(None, stat, interrupts), unknown);
        }
        let times = CpuCounters::parse(Some(0), STAT, "");
        let taken = times.since(&times);
        assert_eq!((taken.steal_ns, taken.interrupt_ns), (Some(0), Some(0)));
        assert_eq!(taken.interrupts, None);
        let counts = CpuCounters::parse(Some(0), "", INTERRUPTS);
        let taken = counts.since(&counts);
        assert_eq!((taken.steal_ns, taken.interrupt_ns), (None, None));
        assert_eq!(taken.interrupts, Some(0));
        // Before Linux 2.6.11 there is no column `steal`.
        let old = CpuCounters::parse(Some(0), "cpu0 1 2 3 4 5 6 7\n", "");
        assert_eq!((old.steal_ns, old.interrupt_ns), (None, Some(130_000_000)));
    }

    #[test]
    fn a_sum_with_an_unknown_part_is_unknown() {
        let known = CpuTimeDelta {
            steal_ns: Some(1),
            interrupt_ns: Some(2),
            interrupts: Some(3),
            most: Vec::new(),
        };
        let mut sum = known.clone();
        sum.add(&known);
        assert_eq!(sum.interrupts, Some(6));
        sum.add(&CpuTimeDelta {
            interrupts: None,
            ..known
        });
        assert_eq!((sum.steal_ns, sum.interrupts), (Some(3), None));
    }
}
