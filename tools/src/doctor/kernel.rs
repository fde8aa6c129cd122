//! Kernel checks: version, preemption, throttling, clock, and virtualization.

use std::io::Read;

use flate2::read::GzDecoder;

use super::fix::{Fix, boot, sysctl};
use super::{Context, ReportBuilder, Severity};
use crate::host::Host;

/// The maximum size of an unpacked kernel configuration in bytes; typical is 300 kB.
const LONGEST_CONFIG: u64 = 4 << 20;
/// From this version on, real-time threads are throttled by groups only.
const FAIR_SERVER_SINCE: (u32, u32) = (6, 12);

/// The preemption model of the kernel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Preemption {
    RealTime,
    Full,
    Lazy,
    Voluntary,
    None,
    /// Not preemptible: `None` or `Voluntary`.
    NotFull,
    Unknown,
}

#[derive(Debug)]
pub(super) struct Kernel {
    pub release: Option<String>,
    pub version: Option<(u32, u32)>,
    pub preemption: Preemption,
    /// True if the model can be chosen at boot.
    pub dynamic: bool,
    pub command_line: Vec<String>,
    config: Option<String>,
}

impl Kernel {
    pub fn of(host: &Host) -> Self {
        let release = host.text("proc/sys/kernel/osrelease").filter(|r| {
            !r.is_empty() && r.len() < 128 && r.bytes().all(|b| b.is_ascii_graphic() && b != b'/')
        });
        let command_line = host.text("proc/cmdline").unwrap_or_default();
        let mut kernel = Self {
            version: release.as_deref().and_then(version),
            config: config(host, release.as_deref()),
            release,
            preemption: Preemption::Unknown,
            dynamic: false,
            command_line: command_line.split_whitespace().map(str::to_owned).collect(),
        };
        let built = host.text("proc/version").unwrap_or_default();
        kernel.dynamic = built.contains("PREEMPT_DYNAMIC");
        kernel.preemption = kernel.model(host, &built);
        kernel
    }

    fn model(&self, host: &Host, built: &str) -> Preemption {
        let real_time = host.text("sys/kernel/realtime").as_deref() == Some("1")
            || built.contains("PREEMPT_RT")
            || built.contains("PREEMPT RT")
            || self.has("PREEMPT_RT") == Some(true);
        if real_time {
            return Preemption::RealTime;
        }
        let named = |name: &str| match name {
            "none" => Some(Preemption::None),
            "voluntary" => Some(Preemption::Voluntary),
            "full" => Some(Preemption::Full),
            "lazy" => Some(Preemption::Lazy),
            _ => None,
        };
        // For example `none voluntary (full) lazy`; readable by root only.
        let chosen = host.text("sys/kernel/debug/sched/preempt");
        let chosen = chosen.as_deref().and_then(|text| {
            let (_, rest) = text.split_once('(')?;
            named(rest.split_once(')')?.0)
        });
        let booted = || {
            let model = self.parameter("preempt").filter(|_| self.dynamic)?;
            named(model)
        };
        let configured = || {
            [
                ("PREEMPT_NONE", Preemption::None),
                ("PREEMPT_VOLUNTARY", Preemption::Voluntary),
                ("PREEMPT_LAZY", Preemption::Lazy),
                ("PREEMPT", Preemption::Full),
            ]
            .into_iter()
            .find(|(option, _)| self.has(option) == Some(true))
            .map(|(_, model)| model)
        };
        let reported = || match built {
            "" => Preemption::Unknown,
            _ if self.dynamic => Preemption::Unknown,
            _ if built.split_whitespace().any(|word| word == "PREEMPT") => Preemption::Full,
            _ => Preemption::NotFull,
        };
        chosen
            .or_else(booted)
            .or_else(configured)
            .unwrap_or_else(reported)
    }

    /// True if the kernel was built with `CONFIG_…`; `None` if its configuration is not found.
    pub fn has(&self, option: &str) -> Option<bool> {
        let config = self.config.as_deref()?;
        let set = |line: &str| {
            let value = line.strip_prefix("CONFIG_")?.strip_prefix(option)?;
            value.strip_prefix('=').map(|value| value == "y")
        };
        Some(config.lines().find_map(set).unwrap_or(false))
    }

    /// Returns the value of the last such command-line parameter.
    pub fn parameter(&self, name: &str) -> Option<&str> {
        let value = |word: &'_ String| {
            let rest = word.strip_prefix(name)?;
            rest.strip_prefix('=').map(|value| value.len())
        };
        let words = self.command_line.iter().rev();
        words
            .filter_map(|word| value(word).map(|len| &word[word.len() - len..]))
            .next()
    }

    pub fn flag(&self, name: &str) -> bool {
        self.command_line.iter().any(|word| word == name)
    }

    /// True if interrupts run in threads with a priority.
    pub fn threads_interrupts(&self) -> bool {
        self.preemption == Preemption::RealTime || self.flag("threadirqs")
    }

    /// True if control groups have real-time budgets.
    pub fn groups_realtime(&self) -> Option<bool> {
        let has = self.has("RT_GROUP_SCHED")?;
        let off_unless_asked = self.has("RT_GROUP_SCHED_DEFAULT_DISABLED") == Some(true);
        Some(
            has && match self.parameter("rt_group_sched") {
                Some(value) => value != "0",
                None => !off_unless_asked,
            },
        )
    }
}

fn version(release: &str) -> Option<(u32, u32)> {
    let mut parts = release.split(|c: char| !c.is_ascii_digit());
    Some((parts.next()?.parse().ok()?, parts.next()?.parse().ok()?))
}

fn config(host: &Host, release: Option<&str>) -> Option<String> {
    let packed = || unpack(&host.bytes("proc/config.gz")?);
    let release = release?;
    host.text(&format!("boot/config-{release}"))
        .or_else(|| host.text(&format!("lib/modules/{release}/config")))
        .or_else(packed)
}

/// Unpacks a gzip file.
fn unpack(bytes: &[u8]) -> Option<String> {
    let mut text = Vec::new();
    let mut unpacked = GzDecoder::new(bytes).take(LONGEST_CONFIG);
    unpacked.read_to_end(&mut text).ok()?;
    Some(String::from_utf8_lossy(&text).into_owned())
}

pub(super) fn examine(context: &Context<'_>, notes: &mut ReportBuilder) {
    let host = context.host;
    if let Some(release) = &context.kernel.release {
        notes.fact("kernel", release);
    }
    preemption(context, notes);
    throttling(context, notes);
    clock(context, notes);
    if let Some(under) = hypervisor(host) {
        notes.fact("computer", under);
    }
    if context.container {
        notes.fact("container", "yes: the computer is shared with others");
    }
    battery(host, notes);
}

fn preemption(context: &Context<'_>, notes: &mut ReportBuilder) {
    let kernel = &context.kernel;
    let name = match kernel.preemption {
        Preemption::RealTime => return notes.fact("preemption", "PREEMPT_RT"),
        Preemption::Unknown => {
            let reported = match kernel.dynamic {
                true => "chosen while booting, not visible here; not PREEMPT_RT",
                false => "not visible here",
            };
            notes.fact("preemption", reported);
            if !kernel.dynamic {
                return;
            }
            "a stock kernel"
        }
        Preemption::Full => "a stock kernel with preempt=full",
        Preemption::Lazy => "a stock kernel with preempt=lazy",
        Preemption::Voluntary => "a stock kernel with preempt=voluntary",
        Preemption::None => "a stock kernel with preempt=none",
        Preemption::NotFull => "a stock kernel that is not preemptible",
    };
    let gives_way = kernel.preemption == Preemption::Full;
    let cost = match gives_way {
        true => {
            "Interrupt handlers and spinlocks of any driver hold up the cycle: most wake-ups are on time, some come 0.1 to 1 ms late."
        }
        false => {
            "A system call or a driver of any other program can keep the CPU until it is done: most wake-ups are on time, some come milliseconds late."
        }
    };
    let mut fix = vec![real_time_kernel(context)];
    if kernel.dynamic && !gives_way {
        fix.push(Fix::advice(
            "Until then, the same kernel gives way earlier with `preempt=full`:",
        ));
        fix.push(boot(context.host, "preempt=full"));
    }
    let found = format!("the kernel is not PREEMPT_RT: {name}");
    notes.find(Severity::Warning, "preemption", found, cost, fix);
}

fn real_time_kernel(context: &Context<'_>) -> Fix {
    let host = context.host;
    let generic = || {
        let whose = if context.container {
            "give the computer that the container runs on"
        } else {
            "boot"
        };
        Fix::advice(format!(
            "{whose} a kernel with CONFIG_PREEMPT_RT=y (part of Linux since 6.12)"
        ))
    };
    // Without an installed kernel, a kernel package would not boot.
    let installed = host
        .names("boot")
        .iter()
        .any(|name| name.starts_with("vmlinu"));
    if context.container || !installed {
        return generic();
    }
    let about = host.text("etc/os-release").unwrap_or_default();
    let id = about.lines().find_map(|line| line.strip_prefix("ID="));
    match id.map(|id| id.trim_matches('"')) {
        Some("debian") => {
            let arch = match host.text("proc/sys/kernel/arch").as_deref() {
                Some("aarch64") => "arm64",
                Some("x86_64") => "amd64",
                None if cfg!(target_arch = "aarch64") => "arm64",
                None if cfg!(target_arch = "x86_64") => "amd64",
                _ => return generic(),
            };
            Fix::lasting(format!(
                "sudo apt install linux-image-rt-{arch} && sudo reboot"
            ))
        }
        Some("ubuntu") => Fix::lasting("sudo pro enable realtime-kernel && sudo reboot"),
        Some("rhel" | "almalinux" | "rocky" | "centos") => {
            Fix::lasting("sudo dnf install kernel-rt && sudo reboot")
        }
        _ => generic(),
    }
}

fn throttling(context: &Context<'_>, notes: &mut ReportBuilder) {
    let host = context.host;
    let kernel = &context.kernel;
    let read = |name: &str| host.number::<i64>(&format!("proc/sys/kernel/sched_rt_{name}_us"));
    let (Some(runtime), Some(period)) = (read("runtime"), read("period")) else {
        return;
    };
    let by_groups_alone = kernel.version.is_some_and(|v| v >= FAIR_SERVER_SINCE);
    let off = by_groups_alone && kernel.groups_realtime() == Some(false);
    if runtime < 0 || runtime >= period || period <= 0 || off {
        let reported = match off {
            true => "none by this kernel",
            false => "off",
        };
        return notes.fact("RT throttling", reported);
    }
    let ms = |us: i64| {
        let ms = us as f64 / 1e3;
        format!("{} ms", (ms * 10.0).round() / 10.0)
    };
    let found = format!(
        "realtime threads are throttled: {} in every {}",
        ms(runtime),
        ms(period),
    );
    let cost = format!(
        "A cycle that spins or computes for more than {} % of its CPU is stopped for {}: lost frames, and the machine stops. Less load is not affected.",
        100 * runtime / period,
        ms(period - runtime),
    );
    let mut fix = sysctl("kernel.sched_rt_runtime_us", "-1");
    if context.container {
        fix = vec![Fix::advice(
            "on the computer that the container runs on: `sysctl kernel.sched_rt_runtime_us=-1`",
        )];
    }
    notes.find(Severity::Warning, "throttling", found, cost, fix);
}

fn clock(context: &Context<'_>, notes: &mut ReportBuilder) {
    let folder = "sys/devices/system/clocksource/clocksource0";
    let Some(source) = context.host.text(&format!("{folder}/current_clocksource")) else {
        return;
    };
    if !matches!(
        source.as_str(),
        "hpet" | "acpi_pm" | "jiffies" | "refined-jiffies" | "pit"
    ) {
        return notes.fact("clock source", source);
    }
    let available = context
        .host
        .text(&format!("{folder}/available_clocksource"));
    let better = available.unwrap_or_default();
    let better = better.split_whitespace().find(|name| *name == "tsc");
    let fix = match better {
        Some(name) => vec![Fix::now(format!(
            "echo {name} | sudo tee /{folder}/current_clocksource"
        ))],
        None => vec![Fix::advice(
            "the kernel has rejected the CPU's own clock (`journalctl -k | grep -i tsc` says why): update the BIOS; if the clock is known to be good, boot with `tsc=reliable`",
        )],
    };
    notes.find(
        Severity::Warning,
        "clock-source",
        format!("time is read from `{source}`, a device, not from the CPU"),
        "Every look at the clock is a system call and takes a microsecond or more: spinning is coarse, each cycle costs more.",
        fix,
    );
}

/// Returns a description of the hypervisor, or `None` on a physical computer.
fn hypervisor(host: &Host) -> Option<String> {
    if !host.is_virtual() {
        return None;
    }
    let product = || host.text("sys/class/dmi/id/product_name");
    let name = host.hypervisor_kind().or_else(product);
    let name = name.map(|name| format!(" ({})", super::text::short(&name)));
    let stolen = stolen(host)
        .map(|share| format!(", which took {:.1} % of its CPU time so far", 100.0 * share));
    Some(format!(
        "virtual machine{}: its host decides when it runs{}",
        name.unwrap_or_default(),
        stolen.unwrap_or_default(),
    ))
}

/// Returns the share of time since boot in which the host delayed runnable work.
fn stolen(host: &Host) -> Option<f64> {
    let stat = host.text("proc/stat")?;
    let line = stat.lines().find(|line| line.starts_with("cpu "))?;
    let ticks: Vec<u64> = line
        .split_whitespace()
        .skip(1)
        .map_while(|word| word.parse().ok())
        .collect();
    // user nice system idle iowait irq softirq steal; user includes guest time.
    let steal = *ticks.get(7)?;
    let all = ticks
        .iter()
        .take(8)
        .try_fold(0_u64, |sum, t| sum.checked_add(*t))?;
    (all > 0).then(|| steal as f64 / all as f64)
}

fn battery(host: &Host, notes: &mut ReportBuilder) {
    let folder = "sys/class/power_supply";
    let supplies = host.names(folder);
    let mut mains = supplies
        .iter()
        .filter(|name| host.text(&format!("{folder}/{name}/type")).as_deref() == Some("Mains"))
        .map(|name| host.text(&format!("{folder}/{name}/online")))
        .peekable();
    if mains.peek().is_some() && mains.all(|online| online.as_deref() == Some("0")) {
        notes.find(
            Severity::Note,
            "battery",
            "the computer runs on its battery",
            "Firmware slows the CPU down and lets it sleep deeper than the kernel knows.",
            vec![Fix::advice("connect the mains supply")],
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn versions() {
        for (release, expected) in [
            ("6.12.9-rt1-amd64", Some((6, 12))),
            ("5.10.0", Some((5, 10))),
            ("6", None),
            ("x", None),
            ("99999999999.1", None),
        ] {
            assert_eq!(version(release), expected, "{release}");
        }
    }

    #[test]
    fn unpack_reads_a_gzip_configuration() {
        let text = "CONFIG_PREEMPT_RT=y\n".repeat(100);
        let mut plain = Vec::new();
        let mut packer = flate2::read::GzEncoder::new(text.as_bytes(), flate2::Compression::fast());
        packer.read_to_end(&mut plain).unwrap();
        assert_eq!(unpack(&plain).as_deref(), Some(text.as_str()));
        for cut in 0..plain.len() {
            assert_eq!(unpack(&plain[..cut]), None, "{cut}");
        }
    }
}
