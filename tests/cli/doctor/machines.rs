//! Computers as folders with the files of the kernel.

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use ecaxis_tools::doctor::ethtool::{Answers, Coalescing, EnergyEfficient};
use ecaxis_tools::doctor::{Measurements, Report, RunProfile, examine};
use ecaxis_tools::host::Host;

pub struct Machine {
    files: BTreeMap<String, Vec<u8>>,
    links: BTreeMap<String, String>,
    pub intent: RunProfile,
    pub tried: Measurements,
}

const CPU: &str = "sys/devices/system/cpu";
pub const NET_RAW: u64 = 1 << 13;
pub const IPC_LOCK: u64 = 1 << 14;
pub const SYS_NICE: u64 = 1 << 23;

impl Machine {
    pub fn new() -> Self {
        Self {
            files: BTreeMap::new(),
            links: BTreeMap::new(),
            intent: RunProfile::new(PathBuf::from("/usr/local/bin/ecaxis")),
            tried: Measurements::default(),
        }
    }

    pub fn file(&mut self, path: impl Into<String>, text: impl AsRef<[u8]>) -> &mut Self {
        self.files.insert(path.into(), text.as_ref().to_vec());
        self
    }

    pub fn files(&mut self, all: &[(&str, &str)]) -> &mut Self {
        for (path, text) in all {
            self.file(*path, format!("{text}\n"));
        }
        self
    }

    pub fn link(&mut self, path: &str, target: &str) -> &mut Self {
        self.links.insert(path.to_owned(), target.to_owned());
        self
    }

    /// Removes files and folders.
    pub fn without(&mut self, prefix: &str) -> &mut Self {
        self.files.retain(|path, _| !path.starts_with(prefix));
        self.links.retain(|path, _| !path.starts_with(prefix));
        self
    }

    pub fn paths(&self) -> Vec<String> {
        self.files.keys().cloned().collect()
    }

    pub fn write(&self, root: &Path) -> Host {
        let folder_of = |path: &Path| fs::create_dir_all(path.parent().unwrap()).unwrap();
        for (path, bytes) in &self.files {
            folder_of(&root.join(path));
            fs::write(root.join(path), bytes).unwrap();
        }
        for (path, target) in &self.links {
            folder_of(&root.join(path));
            symlink(target, root.join(path)).unwrap();
        }
        Host::at(root)
    }

    pub fn examined(&self) -> Report {
        let root = tempfile::tempdir().unwrap();
        examine(&self.write(root.path()), &self.intent, self.tried.clone())
    }

    /// Adds a process with one thread. `policy` is 0 for SCHED_OTHER and 1 for SCHED_FIFO.
    pub fn process(&mut self, id: u32, name: &str, kernel: bool, policy: u32, priority: u32) {
        let flags = if kernel { 0x0020_8040 } else { 0x0040_0000 };
        let nothing = "0 ".repeat(30);
        let stat = format!("{id} ({name}) S 1 1 1 0 -1 {flags} {nothing} {priority} {policy} 0 0");
        self.file(format!("proc/{id}/task/{id}/stat"), stat);
        let status = format!("Name:\t{name}\nCpus_allowed_list:\t0-7\n");
        self.file(format!("proc/{id}/task/{id}/status"), status);
    }

    pub fn rights(&mut self, uid: u32, capabilities: u64, realtime: &str, locked: &str) {
        let status = format!(
            "Name:\tecaxis\nUid:\t{uid}\t{uid}\t{uid}\t{uid}\nCapEff:\t{capabilities:016x}\nNoNewPrivs:\t0\n"
        );
        self.file("proc/self/status", status);
        let limits = format!(
            "Limit                     Soft Limit           Hard Limit           Units     \n\
             Max locked memory         {locked:<20} {locked:<20} bytes     \n\
             Max realtime priority     {realtime:<20} {realtime:<20}           \n"
        );
        self.file("proc/self/limits", limits);
    }

    pub fn governor(&mut self, cpus: u32, governor: &str) {
        for cpu in 0..cpus {
            self.file(format!("{CPU}/cpu{cpu}/cpufreq/scaling_governor"), governor);
        }
    }

    /// Adds idle states: name, exit latency in µs, and whether the state is disabled.
    pub fn idle(&mut self, cpus: u32, states: &[(&str, u32, bool)]) {
        for cpu in 0..cpus {
            for (n, (name, latency, disabled)) in states.iter().enumerate() {
                let folder = format!("{CPU}/cpu{cpu}/cpuidle/state{n}");
                self.file(format!("{folder}/name"), name);
                self.file(format!("{folder}/latency"), latency.to_string());
                self.file(
                    format!("{folder}/disable"),
                    if *disabled { "1" } else { "0" },
                );
            }
        }
    }

    pub fn interrupts(&mut self, cpus: u32, all: &[(u32, u32, &str)]) {
        let head: Vec<String> = (0..cpus).map(|cpu| format!("CPU{cpu}")).collect();
        let mut table = format!("           {}\n", head.join("       "));
        for (number, on, name) in all {
            let counts: Vec<String> = (0..cpus)
                .map(|cpu| if cpu == *on { "1000" } else { "0" }.to_owned())
                .collect();
            table += &format!(
                " {number}:  {}  PCI-MSIX-0000:00:03.0   0-edge      {name}\n",
                counts.join(" ")
            );
            self.file(
                format!("proc/irq/{number}/effective_affinity_list"),
                on.to_string(),
            );
        }
        table += "LOC: 1 2 3 4  Local timer interrupts\n";
        self.file("proc/interrupts", table);
    }

    pub fn card(&mut self, name: &str, speed: &str, duplex: &str) {
        let folder = format!("sys/class/net/{name}");
        for (attribute, value) in [
            ("type", "1"),
            ("flags", "0x1003"),
            ("carrier", "1"),
            ("mtu", "1500"),
            ("ifindex", "3"),
            ("speed", speed),
            ("duplex", duplex),
            ("threaded", "0"),
            ("gro_flush_timeout", "0"),
            ("napi_defer_hard_irqs", "0"),
            ("address", "00:1b:21:0a:0b:0c"),
            ("device/vendor", "0x8086"),
        ] {
            self.file(format!("{folder}/{attribute}"), value);
        }
        self.intent.nic = Some(name.to_owned());
    }

    /// Adds command line, release and configuration of a Debian kernel.
    fn kernel(&mut self, release: &str, built: &str, command_line: &str, config: &str) {
        self.files(&[
            ("proc/sys/kernel/osrelease", release),
            (
                "proc/version",
                &format!("Linux version {release} (builder@host) #1 SMP {built} Debian"),
            ),
            (
                "proc/cmdline",
                &format!("BOOT_IMAGE=/vmlinuz root=/dev/sda1 ro quiet {command_line}"),
            ),
            (&format!("boot/config-{release}"), config),
            (&format!("boot/vmlinuz-{release}"), ""),
            ("etc/os-release", "NAME=\"Debian GNU/Linux\"\nID=debian"),
            ("etc/default/grub.d/init-select.cfg", ""),
            ("proc/sys/kernel/arch", "x86_64"),
            ("run/systemd/system/x", ""),
            (
                "sys/devices/system/clocksource/clocksource0/current_clocksource",
                "tsc",
            ),
            (
                "sys/devices/system/clocksource/clocksource0/available_clocksource",
                "tsc hpet acpi_pm",
            ),
            ("proc/sys/kernel/sched_rt_period_us", "1000000"),
            ("proc/sys/kernel/sched_rt_runtime_us", "950000"),
            ("proc/self/cgroup", "0::/user.slice/session-1.scope"),
            ("proc/self/mounts", "cgroup2 /sys/fs/cgroup cgroup2 rw 0 0"),
            ("proc/swaps", "Filename Type Size Used Priority"),
            (
                "proc/cpuinfo",
                "processor : 0\nflags : fpu tsc constant_tsc",
            ),
        ]);
        self.file("proc/2/comm", "kthreadd\n");
        self.process(2, "kthreadd", true, 0, 0);
        self.process(12, "migration/0", true, 1, 99);
    }
}

/// A computer that follows the guide; doctor must find nothing.
pub fn ideal() -> Machine {
    let mut m = Machine::new();
    m.kernel(
        "6.12.9-rt-amd64",
        "PREEMPT_RT",
        "isolcpus=managed_irq,domain,3 nohz_full=3 rcu_nocbs=3 irqaffinity=0-2",
        "CONFIG_PREEMPT_RT=y\nCONFIG_NO_HZ_FULL=y\nCONFIG_RCU_NOCB_CPU=y",
    );
    m.files(&[
        (&format!("{CPU}/online"), "0-3"),
        (&format!("{CPU}/isolated"), "3"),
        (&format!("{CPU}/nohz_full"), "3"),
        (&format!("{CPU}/cpu3/topology/thread_siblings_list"), "3"),
        ("sys/kernel/realtime", "1"),
        ("proc/sys/kernel/sched_rt_runtime_us", "-1"),
    ]);
    m.governor(4, "performance");
    m.idle(
        4,
        &[
            ("POLL", 0, false),
            ("C1", 2, false),
            ("C6", 85, true),
            ("C10", 890, true),
        ],
    );
    m.rights(1000, NET_RAW | IPC_LOCK | SYS_NICE, "0", "8388608");
    m.interrupts(4, &[(40, 0, "nvme0q1"), (125, 2, "enp3s0-TxRx-0")]);
    m.process(300, "irq/125-enp3s0-", true, 1, 50);
    m.card("enp3s0", "100", "full");
    m.tried.nic = Some(Answers {
        driver: Some("igb".to_owned()),
        coalescing: Some(Coalescing {
            rx_us: 0,
            adaptive_rx: false,
        }),
        energy_efficient: Some(EnergyEfficient {
            enabled: false,
            active: false,
        }),
        gro: Some(true),
        lro: Some(false),
        rx_vlan: Some(true),
        ring: Some((256, 4096)),
        queues: Some(4),
        addresses: Vec::new(),
    });
    m.intent.cpu = Some(3);
    m
}

/// A desktop with factory settings.
pub fn desktop() -> Machine {
    let mut m = ideal();
    m.kernel(
        "6.1.0-28-amd64",
        "PREEMPT_DYNAMIC",
        "",
        "CONFIG_PREEMPT_DYNAMIC=y\nCONFIG_PREEMPT_VOLUNTARY=y\nCONFIG_NO_HZ_FULL=y\nCONFIG_RCU_NOCB_CPU=y",
    );
    m.without("sys/kernel/realtime").without("boot/config-6.12");
    m.files(&[
        (&format!("{CPU}/online"), "0-7"),
        (&format!("{CPU}/isolated"), ""),
        (&format!("{CPU}/nohz_full"), " (null)"),
        (&format!("{CPU}/smt/active"), "1"),
        (
            "proc/swaps",
            "Filename Type Size Used Priority\n/dev/sda2 partition 8000000 0 -2",
        ),
        ("run/NetworkManager/devices/3", "[device]\nmanaged=true"),
        // A folder is not writable as a file, not even by root.
        ("dev/cpu_dma_latency/x", ""),
    ]);
    m.governor(8, "powersave");
    m.idle(
        8,
        &[
            ("POLL", 0, false),
            ("C1_ACPI", 1, false),
            ("C3_ACPI", 1034, false),
        ],
    );
    m.rights(1000, 0, "0", "8388608");
    m.interrupts(8, &[(40, 7, "nvme0q1"), (125, 2, "enp3s0-TxRx-0")]);
    m.process(700, "NetworkManager", false, 0, 0);
    m.process(710, "irqbalance", false, 0, 0);
    m.card("enp3s0", "1000", "full");
    let nic = m.tried.nic.as_mut().unwrap();
    nic.driver = Some("igc".to_owned());
    nic.coalescing = Some(Coalescing {
        rx_us: 3,
        adaptive_rx: true,
    });
    nic.energy_efficient = Some(EnergyEfficient {
        enabled: true,
        active: true,
    });
    nic.addresses = vec!["192.168.1.20".to_owned(), "fe80::1".to_owned()];
    m.intent.cpu = None;
    m
}

/// A guest with two CPUs and a virtual network card.
pub fn virtual_machine() -> Machine {
    let mut m = ideal();
    m.kernel(
        "6.18.44",
        "PREEMPT_DYNAMIC",
        "",
        "CONFIG_PREEMPT_NONE=y\nCONFIG_PREEMPT_DYNAMIC=y\n# CONFIG_NO_HZ_FULL is not set\nCONFIG_RT_GROUP_SCHED=y",
    );
    m.without("sys/kernel/realtime")
        .without("boot/")
        .without("etc/");
    m.without(&format!("{CPU}/")).without("run/");
    m.files(&[
        (&format!("{CPU}/online"), "0-1"),
        (&format!("{CPU}/isolated"), ""),
        ("proc/cpuinfo", "flags : fpu tsc hypervisor"),
        ("sys/class/dmi/id/product_name", "Standard PC (Q35)"),
        (
            "proc/stat",
            "cpu 800 0 100 50 0 0 0 50 0 0\ncpu0 1 0 0 0 0 0 0 0 0 0",
        ),
        ("sys/class/net/eth0/mtu", "1400"),
    ]);
    m.idle(2, &[("POLL", 0, false), ("haltpoll", 1, false)]);
    m.rights(0, u64::MAX, "0", "8388608");
    m.without("sys/class/net/enp3s0");
    m.card("eth0", "-1", "unknown");
    m.file("sys/class/net/eth0/mtu", "1400");
    m.tried.nic = Some(Answers {
        driver: Some("virtio_net".to_owned()),
        ..Answers::default()
    });
    // The configuration exists in one place only.
    let gz = gzip(b"CONFIG_PREEMPT_NONE=y\nCONFIG_PREEMPT_DYNAMIC=y\nCONFIG_RT_GROUP_SCHED=y\n");
    m.file("proc/config.gz", gz);
    m.intent.cpu = None;
    m
}

fn gzip(text: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut packer = flate2::read::GzEncoder::new(text, flate2::Compression::fast());
    std::io::Read::read_to_end(&mut packer, &mut bytes).unwrap();
    bytes
}

/// Docker's rights on a correctly configured host.
pub fn container() -> Machine {
    let mut m = ideal();
    m.file(".dockerenv", "");
    m.without("boot/")
        .without("run/")
        .without("proc/config.gz")
        .without("proc/irq");
    m.rights(0, 0xa804_25fb, "0", "8388608");
    m.without("sys/class/net/enp3s0");
    m.card("eth0", "10000", "full");
    m.without("sys/class/net/eth0/device");
    m.files(&[("proc/sys/kernel/sched_rt_runtime_us", "950000")]);
    m.tried.nic = Some(Answers {
        driver: Some("veth".to_owned()),
        addresses: vec!["172.17.0.2".to_owned()],
        ..Answers::default()
    });
    m.intent.cpu = None;
    m
}

fn cgroup_v1(runtime: &str) -> Machine {
    let mut m = ideal();
    let config = "CONFIG_PREEMPT_RT=y\nCONFIG_RT_GROUP_SCHED=y";
    m.file("boot/config-6.12.9-rt-amd64", config);
    m.files(&[
        (
            "proc/self/cgroup",
            "4:cpu,cpuacct:/user.slice\n0::/user.slice",
        ),
        (
            "proc/self/mounts",
            "cgroup /sys/fs/cgroup/cpu,cpuacct cgroup rw,cpu,cpuacct 0 0",
        ),
        (
            "sys/fs/cgroup/cpu,cpuacct/user.slice/cpu.rt_runtime_us",
            runtime,
        ),
        (
            "sys/fs/cgroup/cpu,cpuacct/user.slice/cpu.rt_period_us",
            "1000000",
        ),
    ]);
    m
}

pub fn group_without_time() -> Machine {
    cgroup_v1("0")
}

pub fn group_with_little_time() -> Machine {
    cgroup_v1("100000")
}

/// /sys is not mounted.
pub fn no_sys() -> Machine {
    let mut m = desktop();
    m.without("sys/");
    m.file("proc/stat", "cpu 1 0 1 1 0 0 0 0\ncpu0 1\ncpu1 1\nintr 5\n");
    m.file(
        "proc/net/dev",
        "Inter-| Receive\n face |bytes\n    lo: 0 0\nenp3s0: 1 2\n",
    );
    m
}

/// A desktop with the given contents in every file.
pub fn malformed(with: &[u8]) -> Machine {
    let mut m = desktop();
    for path in m.paths() {
        m.file(path, with);
    }
    m
}

pub fn laptop() -> Machine {
    let mut m = desktop();
    m.without("sys/class/net/enp3s0");
    m.card("wlp2s0", "-1", "unknown");
    m.files(&[
        ("sys/class/net/wlp2s0/phy80211/index", "0"),
        ("sys/class/power_supply/AC/type", "Mains"),
        ("sys/class/power_supply/AC/online", "0"),
        ("sys/class/power_supply/BAT0/type", "Battery"),
    ]);
    m
}

/// A realtime kernel with all load on one CPU.
pub fn crowded() -> Machine {
    let mut m = ideal();
    m.interrupts(
        4,
        &[
            (40, 3, "nvme0q1"),
            (41, 3, "xhci_hcd"),
            (125, 3, "enp3s0-TxRx-0"),
        ],
    );
    m.process(900, "linuxcnc", false, 1, 90);
    m.process(12, "migration/3", true, 1, 99);
    let clock = "sys/devices/system/clocksource/clocksource0";
    m.files(&[
        (&format!("{clock}/current_clocksource"), "hpet"),
        (&format!("{clock}/available_clocksource"), "hpet acpi_pm"),
        (&format!("{CPU}/nohz_full"), ""),
        (&format!("{CPU}/cpu3/topology/thread_siblings_list"), "1,3"),
        ("proc/cmdline", "isolcpus=3"),
    ]);
    m
}
