//! Permission checks for this user and this program.

use ecaxis_master::sys::rt_thread::RtSetupError;

use super::fix::Fix;
use super::{Context, ReportBuilder, Severity};
use crate::host::Host;

/// Bit and name from capabilities(7).
const NET_RAW: (u32, &str) = (13, "cap_net_raw");
const IPC_LOCK: (u32, &str) = (14, "cap_ipc_lock");
const SYS_NICE: (u32, &str) = (23, "cap_sys_nice");
/// Sufficient for the program and the stacks of all threads, in bytes.
const ENOUGH_LOCKED: u64 = 1 << 30;

#[derive(Debug)]
struct Capabilities {
    effective: u64,
    /// If true, file capabilities have no effect.
    no_new_privileges: bool,
    root: bool,
    realtime_limit: Option<u64>,
    /// The lock limit in bytes.
    lock_limit: Option<u64>,
}

impl Capabilities {
    fn of(host: &Host) -> Option<Self> {
        let status = host.text("proc/self/status")?;
        let field = |name: &str| {
            let mut lines = status.lines();
            lines
                .find_map(|line| line.strip_prefix(name)?.strip_prefix(':'))
                .map(str::trim)
        };
        let effective = u64::from_str_radix(field("CapEff")?, 16).ok()?;
        let limits = host.text("proc/self/limits").unwrap_or_default();
        // The soft limit decides. Limit names contain spaces.
        let limit = |name: &str| {
            let mut lines = limits.lines();
            let rest = lines.find_map(|line| line.strip_prefix(name))?;
            match rest.split_whitespace().next()? {
                "unlimited" => Some(u64::MAX),
                number => number.parse().ok(),
            }
        };
        Some(Self {
            effective,
            no_new_privileges: field("NoNewPrivs") == Some("1"),
            root: field("Uid").and_then(|ids| ids.split_whitespace().nth(1)) == Some("0"),
            realtime_limit: limit("Max realtime priority"),
            lock_limit: limit("Max locked memory"),
        })
    }

    fn has(&self, (bit, _): (u32, &str)) -> bool {
        self.effective & (1 << bit) != 0
    }
}

pub(super) fn examine(context: &Context<'_>, denied: &[RtSetupError], notes: &mut ReportBuilder) {
    let budget = group(context, notes);
    let Some(rights) = Capabilities::of(context.host) else {
        return notes.fact("rights", "not visible here");
    };
    let priority = context.intent.priority;
    let realtime = rights.has(SYS_NICE)
        || rights
            .realtime_limit
            .is_some_and(|limit| limit >= u64::from(priority));
    let lock = rights.has(IPC_LOCK) || rights.lock_limit.is_some_and(|l| l >= ENOUGH_LOCKED);
    let mut missing = Vec::new();
    let mut lacking = Vec::new();
    let mut severity = Severity::Warning;
    let mut costs = Vec::new();
    if !rights.has(NET_RAW) {
        severity = Severity::Bad;
        missing.push(NET_RAW.1);
        lacking.push("to send raw frames".to_owned());
        costs.push("No frame can be sent.");
    }
    if !realtime {
        severity = Severity::Bad;
        missing.push(SYS_NICE.1);
        lacking.push(format!("SCHED_FIFO priority {priority}"));
        costs.push("Every other program can delay the cycle, by milliseconds under load.");
    }
    if !lock {
        missing.push(IPC_LOCK.1);
        let most = rights
            .lock_limit
            .map(|l| format!(" (at most {} kB)", l / 1024));
        lacking.push(format!("to lock its memory{}", most.unwrap_or_default()));
        costs.push(match swaps(context.host) {
            true => "A page that was swapped out delays a cycle by milliseconds.",
            false => "A page fault delays a cycle by some 10 µs.",
        });
    }
    if missing.is_empty() {
        let by = if rights.root {
            "all needed ones, as root"
        } else {
            "raw frames, SCHED_FIFO, locked memory"
        };
        notes.fact("rights", by);
        if swaps(context.host) {
            notes.fact("swap", "in use; the program's own memory is locked");
        }
    } else {
        let fix = granting(context, &rights, &missing);
        let found = format!("the program is not permitted {}", lacking.join(", "));
        notes.find(severity, "rights", found, costs.join(" "), fix);
    }
    if realtime && budget {
        refused(context, denied, notes);
    }
}

fn granting(context: &Context<'_>, rights: &Capabilities, missing: &[&str]) -> Vec<Fix> {
    let upper: Vec<String> = missing.iter().map(|m| m.to_uppercase()).collect();
    if context.container {
        let options: Vec<String> = upper
            .iter()
            .map(|name| format!("--cap-add={}", name.trim_start_matches("CAP_")))
            .collect();
        return vec![Fix::advice(format!(
            "start the container with `{}` (docker, podman)",
            options.join(" ")
        ))];
    }
    if rights.root || rights.no_new_privileges {
        return vec![Fix::advice(format!(
            "the program was started without these permissions; a systemd unit grants them with `AmbientCapabilities={}` and without `NoNewPrivileges`",
            upper.join(" ")
        ))];
    }
    // A later setcap call replaces the earlier one, so one call sets all three.
    let program = context.intent.program.display();
    vec![Fix::lasting(format!(
        "sudo setcap {},{},{}+ep {program}",
        NET_RAW.1, SYS_NICE.1, IPC_LOCK.1
    ))]
}

fn swaps(host: &Host) -> bool {
    let text = host.text("proc/swaps").unwrap_or_default();
    text.lines().skip(1).any(|line| !line.trim().is_empty())
}

/// Reports operations that the kernel refused although the files permit them.
fn refused(context: &Context<'_>, denied: &[RtSetupError], notes: &mut ReportBuilder) {
    let Some(RtSetupError::Priority { priority, reason }) = denied
        .iter()
        .find(|d| matches!(d, RtSetupError::Priority { .. }))
    else {
        return;
    };
    let fix = match context.kernel.groups_realtime() {
        Some(true) => vec![
            Fix::advice(
                "This kernel gives realtime time to control groups (CONFIG_RT_GROUP_SCHED), and this one has none: start the program outside of it, or turn that off:",
            ),
            super::fix::boot(context.host, "rt_group_sched=0"),
        ],
        _ => vec![Fix::advice(
            "a security module or a sandbox forbids it: look into the journal",
        )],
    };
    notes.find(
        Severity::Bad,
        "rights",
        format!(
            "SCHED_FIFO priority {priority} is refused although the rights are there: {reason}"
        ),
        "Every other program can delay the cycle, by milliseconds under load.",
        fix,
    );
}

/// Checks the real-time budget of a version 1 control group. Returns true if there is one.
fn group(context: &Context<'_>, notes: &mut ReportBuilder) -> bool {
    let host = context.host;
    let groups = host.text("proc/self/cgroup").unwrap_or_default();
    let own = groups.lines().find_map(|line| {
        let mut parts = line.splitn(3, ':').skip(1);
        let controllers = parts.next()?;
        let path = parts.next()?;
        controllers
            .split(',')
            .any(|c| c == "cpu")
            .then(|| path.to_owned())
    });
    let mounts = host.text("proc/self/mounts").unwrap_or_default();
    let mount = mounts.lines().find_map(|line| {
        let words: Vec<&str> = line.split_whitespace().collect();
        let [_, point, "cgroup", options, ..] = words[..] else {
            return None;
        };
        options
            .split(',')
            .any(|o| o == "cpu")
            .then(|| point.to_owned())
    });
    let (Some(path), Some(mount)) = (own, mount) else {
        return true;
    };
    // Seen from a container, the path may lead outside.
    let inside = if path.split('/').any(|part| part == "..") {
        ""
    } else {
        path.trim_matches('/')
    };
    let folder = format!("{}/{inside}", mount.trim_matches('/'));
    let folder = folder.trim_end_matches('/');
    let read = |name: &str| host.number::<i64>(&format!("{folder}/cpu.rt_{name}_us"));
    let (Some(runtime), Some(period)) = (read("runtime"), read("period")) else {
        return true;
    };
    if runtime < 0 || period <= 0 || context.kernel.groups_realtime() == Some(false) {
        return true;
    }
    let share = 100 * runtime / period;
    if share >= 90 {
        return true;
    }
    let name = format!("/{inside}");
    let out = vec![
        Fix::advice("Leave the group, in the shell that starts the program:"),
        Fix::now(format!(
            "echo $$ | sudo tee /{}/tasks",
            mount.trim_matches('/')
        )),
    ];
    if runtime == 0 {
        notes.find(
            Severity::Bad,
            "cgroup",
            format!("the control group `{name}` has no realtime time (cpu.rt_runtime_us = 0)"),
            "SCHED_FIFO is refused, even to root: every other program can delay the cycle.",
            out,
        );
        return false;
    }
    notes.find(
        Severity::Warning,
        "cgroup",
        format!("the control group `{name}` has {runtime} µs of realtime time in every {period} µs"),
        format!("A cycle that takes more than {share} % of its CPU is stopped until the next period: lost frames."),
        out,
    );
    true
}
