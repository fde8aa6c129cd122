//! The speed of virtual time: `ecaxis run --sim --virtual` with 2, 8, 32 and 100 CSP drives in
//! motion at 1 ms. The result is in machine seconds per second of CPU time, for the whole process.
//!
//! `cargo bench -p ecaxis --bench virtual_time [-- OTHER]`: with the path of another ecaxis
//! program, both programs alternate, and their ratio is printed.

#![allow(clippy::print_stdout, reason = "a bench prints its result")]

use std::fmt::Write as _;
use std::path::Path;
use std::process::Command;

/// The number of drives, and the machine seconds of one run.
const MACHINES: [(usize, u32); 4] = [(2, 300), (8, 120), (32, 30), (100, 10)];
const ROUNDS: usize = 3;

/// Returns a machine with this number of drives that move forth and back endlessly.
fn machine(drives: usize) -> String {
    let esi = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/esi/EPOS4.xml");
    let mut file = String::from("repeat = 1000000\n[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n");
    for n in 0..drives {
        let _ = write!(
            file,
            "[[device]]\nname = \"a{n}\"\nesi = {esi:?}\nposition = {n}\nmode = \"csp\"\n\
             [device.axis]\nunit = \"mm\"\nper_turn = 5.0\nencoder = 2000\n\
             limits = {{ position = [-60.0, 60.0], velocity = 250.0, acceleration = 2500.0, \
             torque = 100.0, following_error = 2.0 }}\n"
        );
    }
    for target in [50.0, -50.0] {
        let axes: Vec<String> = (0..drives).map(|n| format!("a{n} = {target:?}")).collect();
        let axes = axes.join(", ");
        let _ = write!(file, "[[step]]\nmove = {{ {axes} }}\nspeed = 0.2\n");
    }
    file
}

/// Returns the CPU time of all ended children in kernel clock ticks, 100 per second.
fn children_ticks() -> u64 {
    let stat = std::fs::read_to_string("/proc/self/stat").expect("Linux");
    // Fields 16 and 17 after the name in parentheses (proc(5)).
    let (_, fields) = stat.rsplit_once(')').expect("a name");
    let fields: Vec<&str> = fields.split_whitespace().collect();
    let ticks = |n: usize| fields[n - 3].parse::<u64>().expect("a number");
    ticks(16) + ticks(17)
}

/// Returns machine seconds per second of CPU time.
fn speed(program: &Path, file: &Path, seconds: u32) -> f64 {
    let before = children_ticks();
    let output = Command::new(program)
        .arg("run")
        .arg(file)
        .args(["--sim", "--virtual", "--json", "--for"])
        .arg(format!("{seconds}s"))
        .output()
        .expect("the program starts");
    let used = children_ticks() - before;
    assert!(output.status.success(), "{output:?}");
    let result: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let cycles = result["summary"]["counters"]["cycles"].as_f64();
    let largest = result["summary"]["axes"][0]["largest_following_error"].as_f64();
    assert!(largest > Some(0.0), "the first axis has not moved");
    cycles.expect("a count") * 1e-3 / (used.max(1) as f64 * 1e-2)
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    // `cargo test --benches` only checks that the benchmark runs.
    let short = !arguments.iter().any(|a| a == "--bench");
    let other = arguments.iter().find(|a| !a.starts_with('-'));
    let own = Path::new(env!("CARGO_BIN_EXE_ecaxis"));
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("machine.toml");
    for (drives, seconds) in MACHINES {
        if short && drives > 2 {
            return;
        }
        std::fs::write(&file, machine(drives)).expect("a file");
        let (seconds, rounds) = if short { (2, 1) } else { (seconds, ROUNDS) };
        let (mut best, mut best_other) = (0.0_f64, 0.0_f64);
        for _ in 0..rounds {
            if let Some(other) = other {
                best_other = best_other.max(speed(Path::new(other), &file, seconds));
            }
            best = best.max(speed(own, &file, seconds));
        }
        match other {
            None => println!("{drives:3} drives: {best:6.1} times real time"),
            Some(_) => println!(
                "{drives:3} drives: {best:6.1} times real time, the other {best_other:6.1}: ratio {:.2}",
                best / best_other
            ),
        }
    }
}
