//! CANopen axes behind a gateway over a veth pair: a whole program, and a MainDevice that is killed
//! in motion. Requires root.

use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use ecaxis_test_support::host::over_a_pair;
use ecaxis_test_support::program::{self, ProgramOutput};
use ecaxis_test_support::root;
use ecaxis_tools::bench::veth::VethPair;
use rustix::process::Signal;

/// The mixed machine with frames that a busy host may lose, and a program.
fn machine(folder: &Path, program: Option<&str>) -> String {
    let text = std::fs::read_to_string(root().join("configs/mixed.toml")).expect("our file");
    let text = text.replace(
        "lost_frames = 20",
        "lost_frames = 200\nwatchdog = \"500ms\"",
    );
    let esi = root().join("configs/esi");
    let text = text.replace("\"esi/", &format!("\"{}/", esi.display()));
    let text = match program {
        Some(program) => {
            let end = text.find("[[step]]").expect("a program");
            format!("{}{program}", &text[..end])
        }
        None => text,
    };
    let path = folder.join("mixed.toml");
    std::fs::write(&path, text).expect("written");
    path.to_str().expect("a path in UTF-8").to_owned()
}

fn serve(pair: &VethPair, file: &str, log: &Path) -> ProgramOutput {
    let mut command = program::command();
    command.args(["sim", file, "--nic", &pair.a, "--force", "--can-log"]);
    command.arg(log);
    let mut bus = ProgramOutput::start(command.stdout(Stdio::null()));
    bus.says("answer");
    bus
}

#[test]
fn axes_of_both_networks_run_one_program_over_veth() {
    over_a_pair(|pair| {
        let folder = tempfile::tempdir().expect("a folder");
        let file = machine(folder.path(), None);
        let _bus = serve(&pair, &file, &folder.path().join("can.log"));
        let output = program::command()
            .args([
                "run",
                &file,
                "--nic",
                &pair.b,
                "--no-fault-report",
                "--json",
            ])
            .output()
            .expect("the binary runs");
        let errors = String::from_utf8_lossy(&output.stderr);
        let result: serde_json::Value =
            serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {errors}"));
        assert!(output.status.success(), "{errors}\n{result:#}");
        let axes = result["summary"]["axes"].as_array().expect("axes");
        assert_eq!(axes.len(), 5);
        for axis in axes {
            let position = axis["final_position"].as_f64().expect("a position");
            assert!(position.abs() < 0.2, "{axis:#}");
        }
        let nodes = &result["summary"]["gateways"][0]["nodes"];
        assert_eq!(nodes[2]["state"], "PRE-OPERATIONAL", "{nodes:#}");
    });
}

/// Returns the positions in the PDO 1 of a node, from a log of candump, with their times in s.
fn positions(log: &str, node: u16) -> Vec<(f64, i32)> {
    let id = format!("{:03X}#", 0x180 + node);
    let lines = log.lines().filter_map(|line| {
        let mut parts = line.split(' ');
        let (time, frame) = (parts.next()?, parts.nth(1)?);
        let data = frame.strip_prefix(&id)?;
        let bytes = u32::from_str_radix(data.get(4..12)?, 16).ok()?;
        let time = time.trim_matches(['(', ')']).parse().ok()?;
        Some((time, bytes.swap_bytes().cast_signed()))
    });
    lines.collect()
}

/// The gateway's watchdog ends Op; it holds the last set-points, at which the drives stand.
#[test]
fn every_node_comes_to_rest_after_the_program_is_killed() {
    over_a_pair(|pair| {
        let folder = tempfile::tempdir().expect("a folder");
        let program = "[[step]]\nmove = { feed = 50.0, lift = 50.0, table = 300.0 }\nspeed = 0.2\n";
        let file = machine(folder.path(), Some(program));
        let log = folder.path().join("can.log");
        let bus = serve(&pair, &file, &log);
        let mut command = program::command();
        command.args(["run", &file, "--nic", &pair.b, "--no-fault-report"]);
        let mut run = ProgramOutput::start(command.stdout(Stdio::null()));
        run.says("run 1, step 1: ");
        std::thread::sleep(Duration::from_millis(1500));
        run.signal(Signal::KILL);
        std::thread::sleep(Duration::from_secs(3));
        bus.interrupt();
        bus.end();
        let log = std::fs::read_to_string(&log).expect("a log");
        for node in 1..=3 {
            let positions = positions(&log, node);
            let (end, last) = *positions.last().expect("reports");
            let moved = positions.iter().rev().find(|(_, p)| (p - last).abs() > 2);
            let (at, _) = moved.expect("a motion");
            println!("node {node}: at rest for {:.2} s, at {last}", end - at);
            assert!(
                end - at > 1.0,
                "node {node} moves {:.2} s before the end",
                end - at
            );
            assert!(last.abs() > 100, "node {node} stands at {last}");
        }
    });
}
