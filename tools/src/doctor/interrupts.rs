//! Interrupt checks: which CPU serves which interrupt.

use super::fix::{Fix, boot};
use super::{Context, ReportBuilder, Severity};
use crate::host::{Cpus, Host};

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Interrupt {
    pub number: u32,
    /// The device name from /proc/interrupts.
    pub name: String,
    /// The CPUs that serve it now.
    pub cpus: Option<Cpus>,
}

/// One line of /proc/interrupts.
#[derive(Debug)]
struct Line<'a> {
    number: u32,
    name: &'a str,
    /// Counts by column; columns are the online CPUs.
    counts: Vec<u64>,
}

/// Returns the device interrupts: those with a number.
fn lines(text: &str) -> (Vec<usize>, Vec<Line<'_>>) {
    let mut all = text.lines();
    let head = all.next().unwrap_or_default();
    let cpus: Vec<usize> = head
        .split_whitespace()
        .filter_map(|word| word.strip_prefix("CPU")?.parse().ok())
        .collect();
    let line = |text| {
        let (number, rest) = str::split_once(text, ':')?;
        let words: Vec<&str> = rest.split_whitespace().collect();
        Some(Line {
            number: number.trim().parse().ok()?,
            counts: words
                .iter()
                .take(cpus.len())
                .map_while(|w| w.parse().ok())
                .collect(),
            name: words.get(cpus.len()..)?.last().copied().unwrap_or_default(),
        })
    };
    let lines = all.filter_map(line).collect();
    (cpus, lines)
}

fn served(host: &Host, number: u32) -> Option<Cpus> {
    let folder = format!("proc/irq/{number}");
    host.cpus(&format!("{folder}/effective_affinity_list"))
        .filter(|cpus| !cpus.is_empty())
        .or_else(|| host.cpus(&format!("{folder}/smp_affinity_list")))
}

/// Returns the interrupts of a network card.
pub(super) fn of(host: &Host, nic: &str) -> Vec<Interrupt> {
    let device = format!("sys/class/net/{nic}/device");
    // A virtio card's interrupts belong to its parent PCI device.
    let mut numbers = host.numbers(&format!("{device}/msi_irqs"));
    if numbers.is_empty() && host.link(&format!("{device}/subsystem")).as_deref() == Some("virtio")
    {
        numbers = host.numbers(&format!("{device}/../msi_irqs"));
    }
    if numbers.is_empty() {
        numbers.extend(
            host.number::<u32>(&format!("{device}/irq"))
                .filter(|n| *n > 0),
        );
    }
    let text = host.text("proc/interrupts").unwrap_or_default();
    let (_, lines) = lines(&text);
    let own = |line: &&Line<'_>| {
        let rest = line.name.strip_prefix(nic);
        numbers.contains(&line.number)
            || rest.is_some_and(|rest| rest.is_empty() || rest.starts_with(['-', ':', '@']))
    };
    lines
        .iter()
        .filter(own)
        .map(|line| Interrupt {
            number: line.number,
            name: super::text::short(line.name),
            cpus: served(host, line.number),
        })
        .collect()
}

pub(super) fn examine(context: &Context<'_>, nic: Option<&[Interrupt]>, notes: &mut ReportBuilder) {
    let own = nic.unwrap_or_default();
    if !own.is_empty() {
        let list: Vec<String> = own
            .iter()
            .take(4)
            .map(|i| match &i.cpus {
                Some(cpus) => format!("{} {} on CPU {cpus}", i.number, i.name),
                None => format!("{} {}", i.number, i.name),
            })
            .collect();
        let more = if own.len() > list.len() { ", …" } else { "" };
        notes.fact("NIC interrupts", format!("{}{more}", list.join(", ")));
    }
    let (Some(cpu), Some(elsewhere)) = (context.cpu, context.elsewhere()) else {
        return;
    };
    if !context.online.contains(cpu) {
        return;
    }
    starved(context, own, cpu, elsewhere, notes);
    others(context, own, cpu, elsewhere, notes);
}

/// Finds interrupt threads with lower priority, which starve on the CPU where the cycle spins.
fn starved(
    context: &Context<'_>,
    own: &[Interrupt],
    cpu: usize,
    elsewhere: usize,
    notes: &mut ReportBuilder,
) {
    if !context.kernel.threads_interrupts() {
        return;
    }
    let handler = |interrupt: &Interrupt| {
        let prefix = format!("irq/{}-", interrupt.number);
        let mut threads = context.threads.iter();
        let found = threads.find(|t| t.kernel && t.name.starts_with(&prefix));
        // The kernel's default priority.
        found.map_or(50, |t| t.priority)
    };
    let waits = |i: &&Interrupt| {
        i.cpus.as_ref().is_some_and(|cpus| *cpus == Cpus::only(cpu))
            && handler(i) <= u32::from(context.intent.priority)
    };
    let starved: Vec<&Interrupt> = own.iter().filter(waits).collect();
    let Some(first) = starved.first() else { return };
    notes.find(
        Severity::Bad,
        "nic-interrupt",
        format!(
            "the network card's interrupt {} ({}) is handled by a thread of priority {} on CPU {cpu}, where the cycle spins with priority {}",
            first.number, first.name, handler(first), context.intent.priority,
        ),
        "The thread that would fetch the reply does not run while the cycle waits for it: every reply is late.",
        vec![moving(&starved, elsewhere)],
    );
}

fn others(
    context: &Context<'_>,
    own: &[Interrupt],
    cpu: usize,
    elsewhere: usize,
    notes: &mut ReportBuilder,
) {
    let text = context.host.text("proc/interrupts").unwrap_or_default();
    let (cpus, lines) = lines(&text);
    let Some(column) = cpus.iter().position(|c| *c == cpu) else {
        return;
    };
    let here: Vec<Interrupt> = lines
        .iter()
        .filter(|line| line.counts.get(column).is_some_and(|count| *count > 0))
        .filter(|line| own.iter().all(|i| i.number != line.number))
        .map(|line| Interrupt {
            number: line.number,
            name: super::text::short(line.name),
            cpus: served(context.host, line.number),
        })
        .filter(|i| i.cpus.as_ref().is_some_and(|cpus| cpus.contains(cpu)))
        .collect();
    if here.is_empty() {
        return;
    }
    let list: Vec<String> = here
        .iter()
        .take(5)
        .map(|i| format!("{} ({})", i.number, i.name))
        .collect();
    let more = if here.len() > list.len() { ", …" } else { "" };
    let mut fix = Vec::new();
    if !context.container {
        fix.push(moving(&here.iter().collect::<Vec<_>>(), elsewhere));
    }
    if context.kernel.parameter("irqaffinity").is_none() {
        let rest = context
            .online
            .without(&Cpus::only(cpu))
            .without(&context.isolated);
        let rest = if rest.is_empty() {
            Cpus::only(elsewhere)
        } else {
            rest
        };
        fix.push(boot(context.host, &format!("irqaffinity={rest}")));
    }
    notes.find(
        Severity::Note,
        "interrupts",
        format!("CPU {cpu} serves interrupts of other devices: {}{more}", list.join(", ")),
        "Each takes a few microseconds out of the cycle, a disk's or another network's under load many of them.",
        fix,
    );
}

fn moving(interrupts: &[&Interrupt], to: usize) -> Fix {
    match interrupts {
        [one] => Fix::now(format!(
            "echo {to} | sudo tee /proc/irq/{}/smp_affinity_list",
            one.number
        )),
        many => {
            let numbers: Vec<String> = many.iter().map(|i| i.number.to_string()).collect();
            Fix::now(format!(
                "for i in {}; do echo {to} | sudo tee /proc/irq/$i/smp_affinity_list; done",
                numbers.join(" ")
            ))
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const TABLE: &str = "           CPU0       CPU2
 24:          1         10  IO-APIC   5-edge      ACPI:Ged
 25:          3          4  PCI-MSIX-0000:00:03.0   1-edge      enp3s0-TxRx-0
LOC:        100       2000  Local timer interrupts
ERR:          0
";

    #[test]
    fn lines_parse_the_kernel_table() {
        let (cpus, lines) = lines(TABLE);
        assert_eq!(cpus, [0, 2]);
        let numbers: Vec<_> = lines
            .iter()
            .map(|l| (l.number, l.name, l.counts[1]))
            .collect();
        assert_eq!(numbers, [(24, "ACPI:Ged", 10), (25, "enp3s0-TxRx-0", 4)]);
    }

    proptest! {
        #[test]
        fn no_text_panics(text in "(.{0,40}\n){0,4}|( *CPU[0-9]){0,3}\n([0-9]+:[0-9a-z ]{0,30}\n){0,4}") {
            let _ = lines(&text);
        }
    }
}
