//! `ecaxis doctor` on known computers: simulated ones, and the test computer.
//!
//! `ECAXIS_UPDATE_SNAPSHOTS=1` writes `tests/snapshots/doctor` again; review the difference.

mod machines;

use std::process::Command;

use ecaxis_master::sys::rt_thread::RtSetupError;
use ecaxis_test_support::program::run;
use ecaxis_test_support::{
    NO_INTERFACE, assert_contains, assert_fits, assert_snapshot, load, skip,
};
use ecaxis_tools::doctor::wakeup::{WaitMethod, WakeUp};
use ecaxis_tools::doctor::{Report, Severity, examine};
use machines::Machine;

fn ids(report: &Report) -> Vec<String> {
    let all = report.findings.iter();
    all.map(|f| format!("{} {}", f.severity, f.id)).collect()
}

/// Compares the whole text with its reviewed snapshot.
#[track_caller]
fn reviewed(name: &str, report: &Report) {
    let text = report.document().text(Some(80));
    assert_fits(&text);
    assert_snapshot(&format!("doctor/{name}.txt"), &text);
}

#[test]
fn doctor_matches_the_snapshots_of_ten_computers() {
    let table: &[(&str, Machine, &[&str])] = &[
        ("ideal", machines::ideal(), &[]),
        (
            "desktop",
            machines::desktop(),
            &[
                "bad rights",
                "warning preemption",
                "warning throttling",
                "warning isolation",
                "warning governor",
                "warning idle-states",
                "warning nic-speed",
                "warning nic-coalescing",
                "warning nic-eee",
                "warning nic-managed",
                "warning nic-address",
                "note irqbalance",
            ],
        ),
        (
            "virtual_machine",
            machines::virtual_machine(),
            &[
                "bad nic-mtu",
                "warning preemption",
                "warning throttling",
                "warning isolation",
            ],
        ),
        (
            "container",
            machines::container(),
            &[
                "bad rights",
                "warning throttling",
                "warning nic-address",
                "note same-cpu",
            ],
        ),
        (
            "group_without_time",
            machines::group_without_time(),
            &["bad cgroup"],
        ),
        (
            "group_with_little_time",
            machines::group_with_little_time(),
            &["warning cgroup"],
        ),
        (
            "no_sys",
            machines::no_sys(),
            &[
                "bad rights",
                "warning preemption",
                "warning throttling",
                "warning isolation",
                "note irqbalance",
            ],
        ),
        (
            "laptop",
            machines::laptop(),
            &[
                "bad rights",
                "bad nic-kind",
                "warning preemption",
                "warning throttling",
                "warning isolation",
                "warning governor",
                "warning idle-states",
                "note battery",
                "note irqbalance",
            ],
        ),
        (
            "crowded",
            machines::crowded(),
            &[
                "bad nic-interrupt",
                "warning clock-source",
                "warning priority",
                "note kernel-work",
                "note smt",
                "note interrupts",
            ],
        ),
        ("nothing", Machine::new(), &[]),
    ];
    for (name, machine, expected) in table {
        let report = machine.examined();
        assert_eq!(ids(&report), *expected, "{name}");
        reviewed(name, &report);
    }
}

#[test]
fn doctor_survives_invalid_contents_in_every_file() {
    let long = "9".repeat(3 << 20);
    for nonsense in [
        "".as_bytes(),
        b"\xff\xfe\x00\x80garbage",
        b"-1",
        b"99999999999999999999999999",
        b"0-4294967295",
        b"0x",
        b"\n\n\n:::\n)(\n",
        b"cpu\ncpu0\ncpu99999\n",
        long.as_bytes(),
    ] {
        let text = machines::malformed(nonsense)
            .examined()
            .document()
            .text(Some(80));
        assert!(text.len() < 20_000, "{}", text.len());
        assert!(
            !text.contains(|c: char| c.is_control() && c != '\n'),
            "{text:?}"
        );
    }
}

#[test]
fn invalid_contents_of_one_file_affect_only_its_findings() {
    let machine = machines::desktop();
    let root = tempfile::tempdir().expect("a folder");
    let host = machine.write(root.path());
    let examined = || examine(&host, &machine.intent, machine.tried.clone());
    let usual = examined().findings.len();
    for path in machine.paths() {
        let file = root.path().join(&path);
        let kept = std::fs::read(&file).expect("a file");
        for nonsense in [b"\xff\xfe\x80".as_slice(), b"-99999999999999999999", b""] {
            std::fs::write(&file, nonsense).expect("written");
            let found = examined().findings.len();
            assert!(
                (usual - 4..=usual + 1).contains(&found),
                "{path}: {found} of {usual}"
            );
        }
        std::fs::write(&file, kept).expect("written");
    }
    assert_eq!(examined().findings.len(), usual);
}

/// Each case changes one property of the ideal computer's network card.
#[test]
fn doctor_reports_each_network_card_problem() {
    type Change = fn(&mut Machine);
    let table: &[(&str, Change)] = &[
        ("bad nic-down", |m| {
            _ = m.file("sys/class/net/enp3s0/flags", "0x1002")
        }),
        ("bad nic-carrier", |m| {
            _ = m.file("sys/class/net/enp3s0/carrier", "0")
        }),
        ("bad nic-speed", |m| {
            _ = m.file("sys/class/net/enp3s0/duplex", "half")
        }),
        ("bad nic-speed", |m| {
            _ = m.file("sys/class/net/enp3s0/speed", "10")
        }),
        ("bad nic-mtu", |m| {
            _ = m.file("sys/class/net/enp3s0/mtu", "1280")
        }),
        ("bad nic-kind", |m| {
            _ = m.file("sys/class/net/enp3s0/type", "772")
        }),
        ("bad nic-kind", |m| {
            _ = m.file("sys/class/net/enp3s0/wireless/x", "")
        }),
        ("bad nic-kind", |m| {
            _ = m.file("sys/class/net/enp3s0/bridge/x", "")
        }),
        ("bad nic-kind", |m| {
            _ = m.link("sys/class/net/enp3s0/master", "../br0")
        }),
        ("warning nic-usb", |m| {
            _ = m.link("sys/class/net/enp3s0/device/subsystem", "../../bus/usb")
        }),
        ("warning nic-threaded", |m| {
            _ = m.file("sys/class/net/enp3s0/threaded", "1")
        }),
        ("warning nic-deferred", |m| {
            m.file("sys/class/net/enp3s0/gro_flush_timeout", "200000");
            m.file("sys/class/net/enp3s0/napi_defer_hard_irqs", "2");
        }),
        ("note nic-eee", |m| {
            let nic = m.tried.nic.as_mut().unwrap();
            nic.energy_efficient.as_mut().unwrap().enabled = true;
        }),
        ("note nic-lro", |m| {
            m.tried.nic.as_mut().unwrap().lro = Some(true)
        }),
        ("note nic-address", |m| {
            m.tried.nic.as_mut().unwrap().addresses = vec!["fe80::2".to_owned()]
        }),
        ("warning nic-coalescing", |m| {
            m.tried
                .nic
                .as_mut()
                .unwrap()
                .coalescing
                .as_mut()
                .unwrap()
                .rx_us = 50;
        }),
        ("warning nic-managed", |m| {
            m.file(
                "run/systemd/netif/links/3",
                "ADMIN_STATE=configured\nOPER_STATE=routable\n",
            );
            m.process(400, "systemd-network", false, 0, 0);
        }),
    ];
    for (expected, change) in table {
        let mut machine = machines::ideal();
        change(&mut machine);
        assert_eq!(ids(&machine.examined()), [*expected]);
    }
}

/// Each case changes one other property of the ideal computer.
#[test]
fn doctor_reports_each_system_setting_problem() {
    type Change = fn(&mut Machine);
    let none: &[&str] = &[];
    let table: &[(&[&str], Change)] = &[
        (&["bad cpu"], |m| m.intent.cpu = Some(4)),
        (&["warning isolation", "note smt"], |m| {
            m.intent.cpu = Some(1);
            m.file(
                "sys/devices/system/cpu/cpu1/topology/thread_siblings_list",
                "0-1",
            );
        }),
        (none, |m| m.intent.cpu = None),
        (&["warning isolation"], |m| {
            m.intent.cpu = None;
            m.file("sys/devices/system/cpu/online", "0");
            m.file("sys/devices/system/cpu/isolated", "");
        }),
        (&["warning idle-states"], |m| {
            m.idle(4, &[("C6", 85, false)])
        }),
        // Another process keeps the CPUs awake.
        (none, |m| {
            m.idle(4, &[("C6", 85, false)]);
            m.file("dev/cpu_dma_latency", 0_i32.to_ne_bytes());
        }),
        // The program keeps the CPUs awake.
        (none, |m| {
            m.idle(4, &[("C6", 85, false)]);
            m.file("dev/cpu_dma_latency", 2_000_000_000_i32.to_ne_bytes());
        }),
        // The program must not keep the CPUs awake, but spinning has the same effect.
        (none, |m| {
            m.idle(4, &[("C6", 50, false)]);
            m.file("dev/cpu_dma_latency/x", "");
        }),
        (&["warning idle-states"], |m| {
            m.idle(4, &[("C6", 50, false)]);
            m.intent.cycle_ns = 250_000;
        }),
        // User limits replace capabilities.
        (none, |m| {
            m.rights(1000, machines::NET_RAW, "95", "unlimited")
        }),
        (&["bad rights"], |m| {
            m.rights(1000, machines::NET_RAW, "50", "unlimited")
        }),
        (&["warning rights"], |m| {
            m.rights(1000, machines::NET_RAW | machines::SYS_NICE, "0", "65536")
        }),
        // Since Linux 6.12 the setting throttles only groups, and this computer has no groups.
        (none, |m| {
            m.file("proc/sys/kernel/sched_rt_runtime_us", "950000");
            m.file(
                "boot/config-6.12.9-rt-amd64",
                "CONFIG_PREEMPT_RT=y\n# CONFIG_RT_GROUP_SCHED is not set\n",
            );
        }),
        (&["warning throttling"], |m| {
            m.file("proc/sys/kernel/sched_rt_runtime_us", "950000");
            m.file("proc/sys/kernel/osrelease", "6.6.1");
        }),
        (&["note priority"], |m| {
            m.process(55, "irq/9-acpi", true, 1, 80)
        }),
        (&["warning priority"], |m| {
            m.process(55, "pulse", false, 6, 0)
        }),
        (none, |m| m.process(55, "jackd", false, 1, 79)),
        (none, |m| m.process(55, "irqbalance", false, 0, 0)),
        (none, |m| _ = m.file("proc/cpuinfo", "flags : hypervisor")),
    ];
    for (n, (expected, change)) in table.iter().enumerate() {
        let mut machine = machines::ideal();
        change(&mut machine);
        assert_eq!(ids(&machine.examined()), *expected, "row {n}");
    }
}

#[test]
fn doctor_reports_calls_that_fail_despite_sufficient_rights() {
    let mut machine = machines::ideal();
    machine.file("boot/config-6.12.9-rt-amd64", "CONFIG_RT_GROUP_SCHED=y\n");
    let refused = RtSetupError::Priority {
        priority: 80,
        reason: "Operation not permitted".to_owned(),
    };
    machine.tried.wake_up = Some(WakeUp {
        denied: vec![refused.clone()],
        ..measured(0)
    });
    let report = machine.examined();
    assert_eq!(ids(&report), ["bad rights"]);
    let fix = format!("{:?}", report.findings[0].fix);
    assert!(fix.contains("rt_group_sched=0"), "{fix}");
    // If a right is missing, only the missing right is reported.
    machine.rights(1000, machines::NET_RAW | machines::IPC_LOCK, "0", "0");
    assert_eq!(machine.examined().count(Severity::Bad), 1);
}

fn measured(too_late: u64) -> WakeUp {
    let mut way = WaitMethod::default();
    way.lateness.count = 1_500;
    way.lateness.max_ns = 300_000;
    way.too_late = too_late;
    WakeUp {
        cycle_ns: 1_000_000,
        spin_ns: 100_000,
        seconds: 3,
        cpu: Some(3),
        priority: 80,
        sleep: way,
        sleep_and_spin: way,
        denied: Vec::new(),
        denials: Vec::new(),
    }
}

#[test]
fn doctor_reports_late_wake_ups() {
    for (too_late, expected) in [
        (0, &[][..]),
        (1, &["note wake-up"]),
        (2, &["warning wake-up"]),
        (15, &["warning wake-up"]),
        (16, &["bad wake-up"]),
    ] {
        let mut machine = machines::ideal();
        machine.tried.wake_up = Some(measured(too_late));
        let report = machine.examined();
        assert_eq!(ids(&report), expected, "{too_late}");
        let text = report.document().text(None);
        assert!(text.contains("1500 wake-ups"), "{text}");
    }
}

/// Compares the findings on the test computer with direct reads.
#[test]
fn doctor_matches_the_test_computer() {
    let ran = run(["doctor", "--seconds", "0", "--json"]);
    let report = ran.json();
    let found = |id: &str| {
        let findings = report["findings"].as_array().expect("findings");
        findings.iter().find(|f| f["id"] == id).cloned()
    };
    let bad = report["findings"]
        .as_array()
        .expect("findings")
        .iter()
        .any(|f| f["severity"] == "bad");
    ran.exits(i32::from(bad));

    let read = |path: &str| {
        std::fs::read_to_string(path)
            .map(|t| t.trim().to_owned())
            .ok()
    };
    let shell = |command: &str| {
        let output = Command::new("sh")
            .args(["-c", command])
            .output()
            .expect("a shell");
        String::from_utf8_lossy(&output.stdout).trim().to_owned()
    };
    let uname = shell("uname -v");
    if !uname.is_empty() && (uname.contains("PREEMPT_RT") || uname.contains("PREEMPT_DYNAMIC")) {
        assert_eq!(
            found("preemption").is_some(),
            !uname.contains("PREEMPT_RT"),
            "{uname}"
        );
    }
    let isolated = read("/sys/devices/system/cpu/isolated");
    if let Some(isolated) = isolated {
        let alone = shell("nproc --all") == "1";
        let expected = isolated.is_empty() || alone;
        assert_eq!(
            found("isolation").is_some(),
            expected,
            "isolated: `{isolated}`"
        );
    }
    let runtime = read("/proc/sys/kernel/sched_rt_runtime_us");
    match runtime.as_deref() {
        Some("-1") | None => assert_eq!(found("throttling"), None),
        Some(runtime) => {
            // A kernel since 6.12 without groups does not throttle.
            if let Some(throttling) = found("throttling") {
                let ms = runtime.parse::<f64>().expect("a number") / 1e3;
                let reported = throttling["found"].as_str().expect("text");
                assert!(reported.contains(&format!("{ms} ms")), "{reported}");
            }
        }
    }
    let governors =
        shell("cat /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor 2>/dev/null | sort -u");
    let saves = !governors.is_empty() && governors != "performance";
    assert_eq!(found("governor").is_some(), saves, "{governors}");
    let source = read("/sys/devices/system/clocksource/clocksource0/current_clocksource");
    let slow = matches!(
        source.as_deref(),
        Some("hpet" | "acpi_pm" | "jiffies" | "refined-jiffies")
    );
    assert_eq!(found("clock-source").is_some(), slow, "{source:?}");
    assert!(found("nic-mtu").is_none(), "no interface was named");
}

#[test]
fn doctor_checks_an_existing_and_a_missing_interface() {
    let ran = run(["doctor", "nonet7", "--seconds", "0"]);
    assert_eq!(ran.out, "");
    ran.fails(2, &["`nonet7` does not exist"]);
    let nics = ecaxis_tools::host::Host::here().interfaces();
    let Some(nic) = nics.first() else {
        return skip(NO_INTERFACE);
    };
    assert_contains(&ran.err, &[nic]);
    let text = run(["doctor", nic, "--seconds", "0"]).out;
    assert_contains(&text, &["NIC  ", nic]);
}

#[test]
fn doctor_uses_the_settings_of_a_machine_file() {
    let demo = "configs/demo.toml";
    let report = run(["doctor", "--machine", demo, "--seconds", "0", "--json"]).json();
    let machine = load("demo.toml");
    assert_eq!(report["intent"]["cycle_ns"], machine.bus.cycle_ns);
    assert_eq!(report["intent"]["priority"], machine.bus.priority);
    assert_eq!(report["wake_up"], serde_json::Value::Null);
    run(["doctor", "--machine", "no-such.toml"]).fails(2, &["cannot read no-such.toml"]);
}
