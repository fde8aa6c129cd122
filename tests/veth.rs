//! Two processes, the simulated bus and the master, on the two ends of a veth pair. Needs root.

#![allow(clippy::print_stdout, reason = "a skipped test says why")]

mod common;

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use common::root;

/// A veth pair that is removed when the test ends, however it ends.
struct Pair {
    a: String,
    b: String,
}

impl Pair {
    /// `None`, with the reason printed, where interfaces may not be created.
    fn new() -> Option<Self> {
        let id = std::process::id() % 100_000;
        let pair = Self {
            a: format!("ecx{id}a"),
            b: format!("ecx{id}b"),
        };
        let made = ip(&[
            "link", "add", &pair.a, "type", "veth", "peer", "name", &pair.b,
        ]);
        if let Err(error) = made {
            println!("skipped: a veth pair needs root: {error}");
            return None;
        }
        for nic in [&pair.a, &pair.b] {
            // No address resolution or router solicitation of the host's on this wire.
            let _ = std::fs::write(format!("/proc/sys/net/ipv6/conf/{nic}/disable_ipv6"), "1");
            ip(&["link", "set", nic, "up"]).expect("an interface of ours goes up");
        }
        Some(pair)
    }
}

impl Drop for Pair {
    fn drop(&mut self) {
        let _ = ip(&["link", "del", &self.a]);
    }
}

fn ip(arguments: &[&str]) -> Result<(), String> {
    let output = Command::new("ip")
        .args(arguments)
        .output()
        .map_err(|e| e.to_string())?;
    if output.status.success() {
        Ok(())
    } else {
        Err(String::from_utf8_lossy(&output.stderr).trim().to_owned())
    }
}

struct Served(Child);

impl Drop for Served {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn ecaxis() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ecaxis"));
    command.current_dir(root()).stdin(Stdio::null());
    command
}

/// A thread that spins with real-time priority leaves nothing to another on its processor, and the scheduler may let them
/// share one for seconds.
fn on_cpu_0() -> Command {
    let mut command = Command::new("taskset");
    command.args(["-c", "0", env!("CARGO_BIN_EXE_ecaxis")]);
    command.current_dir(root()).stdin(Stdio::null());
    command
}

fn can_be_kept_apart() -> bool {
    let taskset = Command::new("taskset").arg("--version").output();
    std::thread::available_parallelism().is_ok_and(|n| n.get() > 1)
        && taskset.is_ok_and(|output| output.status.success())
}

fn wait_until_up(nic: &str) {
    let carrier = format!("/sys/class/net/{nic}/carrier");
    let start = Instant::now();
    while std::fs::read_to_string(Path::new(&carrier)).is_ok_and(|c| c.trim() != "1") {
        assert!(
            start.elapsed() < Duration::from_secs(5),
            "{nic} has no carrier"
        );
        std::thread::sleep(Duration::from_millis(10));
    }
}

#[test]
fn the_demo_over_a_real_interface() {
    let Some(pair) = Pair::new() else { return };
    wait_until_up(&pair.a);
    wait_until_up(&pair.b);
    let apart = can_be_kept_apart();
    // The demo, but patient: a busy test machine may hold either process up for longer than three
    // cycles, and both ends share its processors.
    let demo = std::fs::read_to_string(root().join("configs/demo.toml")).expect("the demo");
    let file = tempfile::Builder::new()
        .prefix("test-veth-")
        .suffix(".toml")
        .tempfile_in(root().join("configs"))
        .expect("a temporary file");
    std::fs::write(
        file.path(),
        demo.replace(
            "lost_frames = 20",
            &format!(
                "lost_frames = 80\nwatchdog = \"500ms\"{}",
                if apart { "\ncpu = 1" } else { "" }
            ),
        ),
    )
    .expect("written");
    let file = file.path().to_str().expect("a path in UTF-8");
    let served = if apart { on_cpu_0() } else { ecaxis() }
        .args(["sim", file, "--nic", &pair.a])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("the binary starts");
    let _served = Served(served);
    std::thread::sleep(Duration::from_millis(300));

    let output = ecaxis()
        .args(["run", file, "--nic", &pair.b, "--json"])
        .output()
        .expect("the binary runs");
    let errors = String::from_utf8_lossy(&output.stderr);
    let result: serde_json::Value = serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|e| panic!("{e}: {}; {errors}", String::from_utf8_lossy(&output.stdout)));
    assert!(output.status.success(), "{errors}\n{result:#}");
    let summary = &result["summary"];
    let axes = summary["axes"].as_array().expect("axes");
    assert_eq!(axes.len(), 2);
    for axis in axes {
        let error = axis["final_error_counts"].as_i64().expect("CSP");
        assert!(error.abs() <= 1, "{axis:#}");
    }
    assert_eq!(summary["program_runs"], 2);
}
