//! Thread checks: threads with higher priority, and programs that change settings during operation.

use super::fix::Fix;
use super::{Context, ReportBuilder, Severity};
use crate::host::{Cpus, Host};

/// `PF_KTHREAD` of the flags in /proc/…/stat.
const KERNEL_THREAD: u64 = 0x0020_0000;
const FIFO: u32 = 1;
const ROUND_ROBIN: u32 = 2;
const DEADLINE: u32 = 6;
/// The maximum number of threads that are examined.
const MOST: usize = 20_000;

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Thread {
    pub process: u32,
    pub id: u32,
    pub name: String,
    pub kernel: bool,
    pub policy: u32,
    pub priority: u32,
    pub cpus: Option<Cpus>,
}

impl Thread {
    pub fn is_realtime(&self) -> bool {
        matches!(self.policy, FIFO | ROUND_ROBIN | DEADLINE)
    }
}

/// Returns the main thread of every process and all real-time threads.
pub(super) fn all(host: &Host) -> Vec<Thread> {
    let own: Option<u32> = host.link("proc/self").and_then(|id| id.parse().ok());
    let mut threads = Vec::new();
    for process in host
        .numbers("proc")
        .into_iter()
        .filter(|id| Some(*id) != own)
    {
        for id in host.numbers(&format!("proc/{process}/task")) {
            let folder = format!("proc/{process}/task/{id}");
            let Some(mut thread) = host
                .text(&format!("{folder}/stat"))
                .and_then(|stat| parse(process, id, &stat))
            else {
                continue;
            };
            if thread.is_realtime() {
                let status = host.text(&format!("{folder}/status")).unwrap_or_default();
                let allowed = status
                    .lines()
                    .find_map(|l| l.strip_prefix("Cpus_allowed_list:"));
                thread.cpus = allowed.and_then(Cpus::parse);
            }
            if thread.is_realtime() || id == process {
                threads.push(thread);
            }
            if threads.len() >= MOST {
                return threads;
            }
        }
    }
    threads
}

/// Parses proc_pid_stat(5). The name may contain any character, including brackets.
fn parse(process: u32, id: u32, stat: &str) -> Option<Thread> {
    let (head, rest) = stat.rsplit_once(')')?;
    let (_, name) = head.split_once('(')?;
    // The first of these is field 3.
    let fields: Vec<&str> = rest.split_whitespace().collect();
    let field = |n: usize| fields.get(n - 3).copied();
    let flags: u64 = field(9)?.parse().ok()?;
    Some(Thread {
        process,
        id,
        name: super::text::short(name),
        kernel: flags & KERNEL_THREAD != 0,
        priority: field(40)?.parse().ok()?,
        policy: field(41)?.parse().ok()?,
        cpus: None,
    })
}

pub(super) fn examine(context: &Context<'_>, notes: &mut ReportBuilder) {
    let own = u32::from(context.intent.priority);
    let meets = |thread: &&Thread| match (context.cpu, &thread.cpus) {
        (Some(cpu), Some(allowed)) => allowed.contains(cpu),
        _ => true,
    };
    let before: Vec<&Thread> = context
        .threads
        .iter()
        .filter(|t| t.policy == DEADLINE || (t.is_realtime() && t.priority >= own))
        // The kernel migrates threads with these; they have the highest priority.
        .filter(|t| !(t.kernel && t.name.starts_with("migration/")))
        .filter(meets)
        .collect();
    if let Some(first) = before.first() {
        let list: Vec<String> = before
            .iter()
            .take(6)
            .map(|t| match t.policy {
                DEADLINE => format!("{} (SCHED_DEADLINE, thread {})", t.name, t.id),
                _ => format!("{} ({}, thread {})", t.name, t.priority, t.id),
            })
            .collect();
        let more = before.len().saturating_sub(list.len());
        let more = if more > 0 {
            format!(" and {more} more")
        } else {
            String::new()
        };
        let theirs = before.iter().any(|t| !t.kernel);
        let mut fix = Vec::new();
        if theirs {
            let lower = own.saturating_sub(1).max(1);
            let user = before.iter().find(|t| !t.kernel).unwrap_or(first);
            if user.policy != DEADLINE {
                fix.push(Fix::now(format!("sudo chrt -f -p {lower} {}", user.id)));
            }
        }
        fix.push(Fix::advice(
            "give the cycle a higher `priority` in the machine file's [bus] (up to 98), or those threads another CPU",
        ));
        notes.find(
            if theirs {
                Severity::Warning
            } else {
                Severity::Note
            },
            "priority",
            format!(
                "threads that the cycle (priority {own}) has to wait for: {}{more}",
                list.join(", ")
            ),
            "The cycle is late by as long as one of them runs.",
            fix,
        );
    }
    balancing(context, notes);
}

/// Checks for irqbalance, which spares isolated CPUs by itself.
fn balancing(context: &Context<'_>, notes: &mut ReportBuilder) {
    let protected = context
        .cpu
        .is_some_and(|cpu| context.isolated.contains(cpu));
    let runs = context.threads.iter().any(|t| t.name == "irqbalance");
    if runs && !protected && context.online.len() > 1 {
        notes.find(
            Severity::Note,
            "irqbalance",
            "irqbalance moves interrupts between all CPUs",
            "The cycle's CPU gets the interrupts of other devices, a few microseconds each, and the network card's interrupts move between CPUs.",
            vec![Fix::lasting("sudo systemctl disable --now irqbalance")],
        );
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn parse_accepts_any_thread_name() {
        let mut fields = vec!["0"; 49];
        fields[0] = "S";
        fields[6] = "2129984";
        fields[37] = "50";
        fields[38] = "1";
        let stat = format!("7 (a) (b c) {}", fields.join(" "));
        let thread = parse(7, 7, &stat).unwrap();
        assert_eq!(thread.name, "a) (b c");
        assert!(thread.kernel && thread.is_realtime());
        assert_eq!(thread.priority, 50);
    }

    proptest! {
        #[test]
        fn no_text_panics(text in ".{0,80}|[()0-9 ]{0,200}") {
            let _ = parse(1, 1, &text);
        }
    }
}
