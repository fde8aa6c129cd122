//! EoE through a TAP interface: the network stack of the computer opens the page of a simulated drive
//! at the other end of a veth pair. Requires root and /dev/net/tun.

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::path::Path;
use std::process::Stdio;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use ecaxis_test_support::host::over_a_pair;
use ecaxis_test_support::program::{self, ProgramOutput};
use ecaxis_test_support::{skip, tolerant, with_our_esi};
use serde_json::Value;

const HOST: &str = "192.168.198.11:80";

/// Returns `configs/web.toml` with a TAP interface and a subnet of this test.
fn text(tap: &str) -> String {
    let root = ecaxis_test_support::root();
    let text = std::fs::read_to_string(root.join("configs/web.toml")).expect("one of our files");
    let text = tolerant(&with_our_esi(&text)).replace("\"ecat0\"", &format!("\"{tap}\""));
    text.replace("192.168.7.", "192.168.198.")
        .replace("repeat = 20", "repeat = 1000")
}

/// Opens the page and returns it.
fn page() -> std::io::Result<String> {
    let address = HOST.parse().expect("an address");
    let mut stream = TcpStream::connect_timeout(&address, Duration::from_secs(5))?;
    stream.set_read_timeout(Some(Duration::from_secs(5)))?;
    stream.write_all(b"GET / HTTP/1.1\r\nHost: drive\r\n\r\n")?;
    let mut text = String::new();
    stream.read_to_string(&mut text)?;
    Ok(text)
}

/// Runs the machine for some seconds, with or without load in both directions. Returns its summary,
/// and how many pages were opened.
fn run(file: &Path, nic: &str, tap: &str, load: bool) -> (Value, u64) {
    let path = file.to_str().expect("a path in UTF-8");
    let run = ["run", path, "--nic", nic, "--no-fault-report", "--json"];
    let mut run = ProgramOutput::start(program::command().args(run).stdout(Stdio::piped()));
    run.says("Operation enabled");
    let exists = || Path::new("/sys/class/net").join(tap).exists();
    assert!(exists(), "the interface exists during the run");
    let pages = AtomicU64::new(0);
    let ended = AtomicBool::new(false);
    std::thread::scope(|scope| {
        if load {
            for _ in 0..2 {
                scope.spawn(|| {
                    while !ended.load(Ordering::Relaxed) {
                        if page().is_ok_and(|page| page.contains("<h1>SV1</h1>")) {
                            pages.fetch_add(1, Ordering::Relaxed);
                        }
                    }
                });
            }
        }
        std::thread::sleep(Duration::from_secs(4));
        ended.store(true, Ordering::Relaxed);
    });
    run.interrupt();
    let output = run.end();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(130), "{errors}");
    assert!(!exists(), "the interface is gone");
    let result: Value = serde_json::from_slice(&output.stdout).expect("the result as JSON");
    (result["summary"].clone(), pages.into_inner())
}

#[test]
fn page_opens_through_the_tap_interface() {
    if !Path::new("/dev/net/tun").exists() {
        return skip("this computer has no /dev/net/tun");
    }
    over_a_pair(|pair| {
        let tap = format!("ect{}", std::process::id());
        let file = tempfile::Builder::new().suffix(".toml").tempfile();
        let file = file.expect("a temporary file");
        std::fs::write(file.path(), text(&tap)).expect("written");
        let path = file.path().to_str().expect("a path in UTF-8");
        let sim = ["sim", path, "--nic", &pair.a];
        let mut bus = ProgramOutput::start(program::command().args(sim).stdout(Stdio::null()));
        bus.says("answer");
        let p99 = |summary: &Value| summary["wake_up_lateness"]["p99_ns"].as_f64().unwrap();
        let mut ratios = Vec::new();
        // Interleaved, so that a slow minute of the computer concerns both.
        for _ in 0..3 {
            let (without, _) = run(file.path(), &pair.b, &tap, false);
            let (with, pages) = run(file.path(), &pair.b, &tap, true);
            assert!(pages > 3, "{pages} pages");
            for summary in [&without, &with] {
                assert_eq!(
                    summary["counters"]["wkc_errors"], 0,
                    "{}",
                    summary["counters"]
                );
            }
            let port = &with["ethernet"][0];
            let frames = |key: &str| port[key].as_u64().unwrap();
            assert!(frames("from_port") > 10 && frames("to_port") > 10, "{port}");
            println!(
                "{pages} pages, {} frames from x, {} to x; wake-up p99 {} ns, {} ns without load",
                frames("from_port"),
                frames("to_port"),
                p99(&with),
                p99(&without)
            );
            ratios.push(p99(&with) / p99(&without));
        }
        println!("wake-up p99 with load / without: {ratios:.2?}");
    });
}
