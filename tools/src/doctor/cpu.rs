//! CPU checks: isolation of the cycle's CPU, and what slows its wake-up.

use super::fix::{Fix, boot, file, write};
use super::{Context, ReportBuilder, Severity};
use crate::host::{Cpus, Host};
use ecaxis_master::rt::exchange::ExchangeMode;

const FOLDER: &str = "sys/devices/system/cpu";
/// The value of /dev/cpu_dma_latency without any request.
const NO_LIMIT: i32 = 2_000_000_000;

/// Returns the CPUs from other files if /sys does not list them.
pub(super) fn counted(host: &Host) -> Cpus {
    let stat = host.text("proc/stat").unwrap_or_default();
    let numbers = stat
        .lines()
        .filter_map(|line| line.split_whitespace().next()?.strip_prefix("cpu"));
    let list: Vec<&str> = numbers.filter(|n| !n.is_empty()).collect();
    Cpus::parse(&list.join(",")).unwrap_or_default()
}

pub(super) fn examine(context: &Context<'_>, notes: &mut ReportBuilder) {
    if context.online.is_empty() {
        return notes.fact("CPUs", "not visible here");
    }
    notes.fact(
        "CPUs",
        format!("{} ({})", context.online.len(), context.online),
    );
    if let Some(cpu) = context.cpu
        && !context.online.contains(cpu)
    {
        return notes.find(
            Severity::Bad,
            "cpu",
            format!("CPU {cpu} is not there or switched off"),
            "The realtime thread cannot be pinned and moves between CPUs.",
            vec![Fix::advice(format!(
                "choose another `cpu`; there are {}",
                context.online
            ))],
        );
    }
    isolation(context, notes);
    frequency(context, notes);
    idle(context, notes);
    siblings(context, notes);
}

fn isolation(context: &Context<'_>, notes: &mut ReportBuilder) {
    let isolated = &context.isolated;
    if context.online.len() == 1 {
        return notes.find(
            Severity::Warning,
            "isolation",
            "there is one CPU: the cycle shares it with everything else",
            "Interrupts and kernel work of all other programs delay the cycle, and its spinning takes CPU time from other programs.",
            vec![Fix::advice("take a computer with at least two CPUs")],
        );
    }
    match context.cpu {
        Some(cpu) if isolated.contains(cpu) => {
            let assumed = match context.intent.cpu {
                Some(_) => "",
                None => "; give it to the cycle with `cpu` in the machine file",
            };
            notes.fact("isolated CPUs", format!("{isolated}{assumed}"));
            quiet(context, cpu, notes);
        }
        Some(cpu) if !isolated.is_empty() => notes.find(
            Severity::Warning,
            "isolation",
            format!("the cycle runs on CPU {cpu}, isolated is {isolated}"),
            "Other programs, their system calls and interrupts delay the cycle, while an isolated CPU has nothing to do.",
            vec![Fix::advice(match isolated.first() {
                Some(free) => format!("write `cpu = {free}` into the machine file's [bus]"),
                None => "choose an isolated CPU".to_owned(),
            })],
        ),
        cpu => not_isolated(context, cpu, notes),
    }
}

fn not_isolated(context: &Context<'_>, cpu: Option<usize>, notes: &mut ReportBuilder) {
    let Some(take) = cpu.or(context.online.last()) else {
        return;
    };
    let rest = context.online.without(&Cpus::only(take));
    let mut fix = vec![boot(context.host, &isolating(context, take, &rest))];
    let found = match cpu {
        Some(cpu) => format!("no CPU is isolated; the cycle shares CPU {cpu} with other programs"),
        None => {
            fix.push(Fix::advice(format!(
                "In any case write `cpu = {take}` into the machine file's [bus]: it pins the realtime thread."
            )));
            "no CPU is isolated, and none is chosen for the cycle".to_owned()
        }
    };
    notes.find(
        Severity::Warning,
        "isolation",
        found,
        "Other programs' kernel work, timers and interrupts come in between: wake-ups some 10 to 100 µs later now and then. A program that the scheduler has put on the same CPU (`ecaxis sim` for one) starves while the cycle spins.",
        fix,
    );
}

/// Returns the isolation parameters that this kernel supports.
fn isolating(context: &Context<'_>, cpu: usize, rest: &Cpus) -> String {
    let mut text = format!("isolcpus=managed_irq,domain,{cpu}");
    for (parameter, option) in [("nohz_full", "NO_HZ_FULL"), ("rcu_nocbs", "RCU_NOCB_CPU")] {
        if context.kernel.has(option) != Some(false) {
            text += &format!(" {parameter}={cpu}");
        }
    }
    if context.kernel.parameter("irqaffinity").is_none() {
        text += &format!(" irqaffinity={rest}");
    }
    text
}

/// Checks an isolated CPU for remaining kernel work.
fn quiet(context: &Context<'_>, cpu: usize, notes: &mut ReportBuilder) {
    let kernel = &context.kernel;
    let full = context.host.cpus(&format!("{FOLDER}/nohz_full"));
    let ticks = !full.unwrap_or_default().contains(cpu);
    let named = kernel.parameter("rcu_nocbs").and_then(Cpus::parse);
    // nohz_full implies rcu_nocbs.
    let callbacks = ticks
        && !named.unwrap_or_default().contains(cpu)
        && kernel.parameter("rcu_nocbs") != Some("all");
    let wanted = [
        (ticks, "nohz_full", "NO_HZ_FULL", "timer tick"),
        (callbacks, "rcu_nocbs", "RCU_NOCB_CPU", "RCU callbacks"),
    ];
    let missing: Vec<_> = wanted
        .into_iter()
        .filter(|(wanted, _, option, _)| *wanted && kernel.has(option) != Some(false))
        .collect();
    if missing.is_empty() {
        return;
    }
    let parameters: Vec<String> = missing.iter().map(|m| format!("{}={cpu}", m.1)).collect();
    let names: Vec<&str> = missing.iter().map(|m| m.3).collect();
    notes.find(
        Severity::Note,
        "kernel-work",
        format!(
            "CPU {cpu} is isolated, but still has the kernel's {}",
            names.join(" and ")
        ),
        "A few microseconds now and then, in the middle of a cycle.",
        vec![boot(context.host, &parameters.join(" "))],
    );
}

/// Returns the CPUs that the cycle may run on.
fn candidates(context: &Context<'_>) -> Vec<usize> {
    match context.cpu {
        Some(cpu) => vec![cpu],
        None => context.online.iter().collect(),
    }
}

fn frequency(context: &Context<'_>, notes: &mut ReportBuilder) {
    let governor = |cpu: &usize| {
        let path = format!("{FOLDER}/cpu{cpu}/cpufreq/scaling_governor");
        Some((
            *cpu,
            context.host.text(&path).filter(|name| !name.is_empty())?,
        ))
    };
    let cpus = candidates(context);
    let governors: Vec<_> = cpus.iter().filter_map(governor).collect();
    let Some((_, first)) = governors.first() else {
        return;
    };
    let Some((cpu, slow)) = governors.iter().find(|(_, name)| name != "performance") else {
        return notes.fact("frequency governor", first);
    };
    let slow = super::text::short(slow);
    notes.find(
        Severity::Warning,
        "governor",
        format!("CPU {cpu} saves power: its frequency governor is `{slow}`"),
        "After a sleep the CPU is slow, and changing its frequency stops it for some 10 µs: work a cycle takes longer and varies.",
        write(
            context.host,
            "performance",
            &match context.cpu {
                Some(cpu) => format!("/{FOLDER}/cpu{cpu}/cpufreq/scaling_governor"),
                None => format!("/{FOLDER}/cpu*/cpufreq/scaling_governor"),
            },
        ),
    );
}

#[derive(Debug)]
struct IdleState {
    number: u32,
    name: String,
    latency_us: u64,
}

fn idle_states(host: &Host, cpu: usize) -> Vec<IdleState> {
    let folder = format!("{FOLDER}/cpu{cpu}/cpuidle");
    let state = |name: String| {
        let of = |what| host.text(&format!("{folder}/{name}/{what}"));
        if of("disable").as_deref() == Some("1") {
            return None;
        }
        Some(IdleState {
            number: name.strip_prefix("state")?.parse().ok()?,
            name: super::text::short(&of("name")?),
            latency_us: of("latency")?.parse().ok()?,
        })
    };
    host.names(&folder).into_iter().filter_map(state).collect()
}

fn idle(context: &Context<'_>, notes: &mut ReportBuilder) {
    let host = context.host;
    let deepest = |states: &[IdleState]| states.iter().map(|s| s.latency_us).max();
    let Some((cpu, states)) = candidates(context)
        .into_iter()
        .map(|cpu| (cpu, idle_states(host, cpu)))
        .max_by_key(|(_, states)| deepest(states))
    else {
        return;
    };
    let Some(state) = states.iter().max_by_key(|state| state.latency_us) else {
        return;
    };
    let limit = host
        .bytes("dev/cpu_dma_latency")
        .and_then(|bytes| Some(i32::from_ne_bytes(bytes.get(..4)?.try_into().ok()?)))
        .filter(|limit| *limit != NO_LIMIT)
        .and_then(|limit| u64::try_from(limit).ok());
    let reported = format!("{}, {} µs to wake", state.name, state.latency_us);
    if let Some(limit) = limit.filter(|limit| *limit < state.latency_us) {
        let limited = format!("{reported}; now limited to {limit} µs by a program");
        return notes.fact("deepest idle state", limited);
    }
    let covered_us = context
        .intent
        .spin
        .longest(context.intent.cycle_ns, ExchangeMode::SameCycle)
        / 1_000;
    // Spinning must cover this latency in every cycle.
    let hidden = (covered_us / 4).max(10);
    if state.latency_us <= hidden {
        return notes.fact("deepest idle state", reported);
    }
    let request = "dev/cpu_dma_latency";
    if host.writable(request) {
        let never = format!("{reported}; ruled out while a machine runs");
        return notes.fact("deepest idle state", never);
    }
    let cost = format!(
        "The cycle wakes that much later, and with cold caches. Spinning covers {covered_us} µs at most, at the price of CPU time."
    );
    let found = format!("CPU {cpu} may sleep as deep as {reported}");
    if host.exists(request) {
        let rule = ["KERNEL==\"cpu_dma_latency\", MODE=\"0666\""];
        let fix = vec![
            Fix::advice(format!(
                "The program rules such states out while it runs, if it may write to /{request}:"
            )),
            Fix::now(format!("sudo chmod 666 /{request}")),
            Fix::lasting(file(&rule, "/etc/udev/rules.d/90-ecaxis.rules")),
        ];
        return notes.find(Severity::Warning, "idle-states", found, cost, fix);
    }
    let slow = states.iter().filter(|state| state.latency_us > hidden);
    let slow: Vec<String> = slow.map(|state| state.number.to_string()).collect();
    let slow = match slow.as_slice() {
        [one] => one.clone(),
        // A CPU has at most ten idle states.
        several => format!("[{}]", several.concat()),
    };
    let cpus = context.cpu.map_or("*".to_owned(), |cpu| cpu.to_string());
    let path = format!("/{FOLDER}/cpu{cpus}/cpuidle/state{slow}/disable");
    let fix = write(host, "1", &path);
    notes.find(Severity::Warning, "idle-states", found, cost, fix);
}

fn siblings(context: &Context<'_>, notes: &mut ReportBuilder) {
    let host = context.host;
    let Some(cpu) = context.cpu else {
        if host.text(&format!("{FOLDER}/smt/active")).as_deref() == Some("1") {
            notes.fact("SMT", "on: two CPUs share a core");
        }
        return;
    };
    let shared = host.cpus(&format!("{FOLDER}/cpu{cpu}/topology/thread_siblings_list"));
    let others = shared.unwrap_or_default().without(&Cpus::only(cpu));
    let Some(other) = others.iter().find(|other| context.online.contains(*other)) else {
        return;
    };
    notes.find(
        Severity::Note,
        "smt",
        format!("CPU {cpu} shares its core with CPU {other}"),
        "Programs on that CPU use the same execution units and cache: the work of a cycle takes up to twice as long.",
        write(host, "0", &format!("/{FOLDER}/cpu{other}/online")),
    );
}
