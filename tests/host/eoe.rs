//! EoE through a TAP interface: the network stack of the computer opens the page of a simulated drive
//! at the other end of a veth pair. Requires root and /dev/net/tun.

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::path::Path;
use std::process::Stdio;
use std::time::{Duration, Instant};

use ecaxis_test_support::host::over_a_pair;
use ecaxis_test_support::program::{self, ProgramOutput};
use ecaxis_test_support::{skip, tolerant, with_our_esi};
use serde_json::Value;

const HOST: &str = "192.168.198.11:80";
/// The pages that each client opens.
const PAGES: u32 = 5;

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

/// Runs the machine until two clients have opened some pages. Returns its summary.
fn run_with_load(file: &Path, nic: &str, tap: &str) -> Value {
    let path = file.to_str().expect("a path in UTF-8");
    let run = ["run", path, "--nic", nic, "--no-fault-report", "--json"];
    let mut run = ProgramOutput::start(program::command().args(run).stdout(Stdio::piped()));
    run.says("Operation enabled");
    let exists = || Path::new("/sys/class/net").join(tap).exists();
    assert!(exists(), "the interface exists during the run");
    let clients: Vec<_> = (0..2).map(|_| std::thread::spawn(open_pages)).collect();
    for client in clients {
        client.join().expect("all pages arrive");
    }
    run.interrupt();
    let output = run.end();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(130), "{errors}");
    assert!(!exists(), "the interface is gone");
    let result: Value = serde_json::from_slice(&output.stdout).expect("the result as JSON");
    result["summary"].clone()
}

fn open_pages() {
    let ends = Instant::now() + Duration::from_secs(20);
    let mut opened = 0;
    while opened < PAGES {
        assert!(Instant::now() < ends, "only {opened} pages");
        if page().is_ok_and(|page| page.contains("<h1>SV1</h1>")) {
            opened += 1;
        }
    }
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
        let summary = run_with_load(file.path(), &pair.b, &tap);
        let counters = &summary["counters"];
        assert_eq!(counters["wkc_errors"], 0, "{counters}");
        let port = &summary["ethernet"][0];
        let frames = |key: &str| port[key].as_u64().unwrap();
        assert!(frames("from_port") > 10 && frames("to_port") > 10, "{port}");
    });
}
