//! What a server can still do after it gave up its rights, and what it cannot.

use std::fs::read_to_string;
use std::io::{BufRead, BufReader, Write as _};
use std::os::unix::fs::symlink;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use ecaxis_test_support::program::{self, ProgramOutput};
use serde_json::{Value, json};

/// A server in virtual time, with one client that owns the lease.
struct Served {
    program: ProgramOutput,
    client: UnixStream,
    folder: tempfile::TempDir,
}

impl Served {
    /// Serves `configs/groups.toml`, and waits until the bus is in Op.
    fn start(rights: &str, faults: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for made in ["in", "out"] {
            std::fs::create_dir(at(made)).unwrap();
        }
        std::fs::write(at("faults.toml"), faults).unwrap();
        let mut command = program::command();
        command.env("ECAXIS_RIGHTS", rights).env("RUST_LOG", "warn");
        command.env("ECAXIS_CHANGE_LOG", at("in/changes.jsonl"));
        command.args(["serve", "configs/groups.toml", "--virtual", "--faults"]);
        command.arg(at("faults.toml")).arg("--socket");
        command.arg(at("in/s.sock")).stdout(Stdio::null());
        let mut program = ProgramOutput::start(&mut command);
        program.says("socket: ");
        let client = UnixStream::connect(at("in/s.sock")).unwrap();
        client
            .set_read_timeout(Some(Duration::from_secs(60)))
            .unwrap();
        let served = Self {
            program,
            client,
            folder,
        };
        served.ask("await", json!({"bus": "op"}));
        served.ask("take", json!({"ttl_ms": 60_000}));
        served
    }

    fn at(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Sends a request and returns its answer, which must be good.
    #[track_caller]
    fn ask(&self, op: &str, mut keys: Value) -> Value {
        keys["op"] = json!(op);
        keys["id"] = json!(1);
        writeln!(&self.client, "{keys}").unwrap();
        let lines = BufReader::new(&self.client).lines();
        let answers = lines.map(|line| serde_json::from_str::<Value>(&line.unwrap()).unwrap());
        let answer = { answers }.find(|answer| answer["id"] == 1).unwrap();
        assert_eq!(answer["ok"], json!(true), "{keys}: {answer}");
        answer
    }

    /// Writes the window of the following error, and reads it back.
    #[track_caller]
    fn write_object(&self, value: u32) {
        let object = json!({"device": "x", "index": "0x6065"});
        let mut write = object.clone();
        write["value"] = json!(value);
        self.ask("sdo_write", write);
        assert_eq!(self.ask("sdo_read", object)["value"], value);
    }

    /// Checks that all threads are limited.
    fn check_limits(&self) {
        let tasks = format!("/proc/{}/task", self.program.id());
        let mut threads = 0;
        for task in std::fs::read_dir(tasks).unwrap() {
            // Threads end meanwhile.
            let Ok(text) = read_to_string(task.unwrap().path().join("status")) else {
                continue;
            };
            threads += 1;
            for line in ["NoNewPrivs:\t1", "Seccomp:\t2"] {
                assert!(text.contains(line), "{line}: {text}");
            }
        }
        assert!(threads > 1);
    }

    /// Waits until a file contains a text; returns whether it does in time.
    fn contains(file: &Path, text: &str) -> bool {
        (0..200).any(|_| {
            std::thread::sleep(Duration::from_millis(10));
            read_to_string(file).is_ok_and(|content| content.contains(text))
        })
    }
}

/// A link in the folder of the change log leads to another folder: the limited server neither
/// follows it nor stops its work. Without limits, the same server writes there.
#[test]
fn objects_are_written_with_few_rights_and_files_elsewhere_are_not() {
    for (rights, is_limited) in [("strict", true), ("off", false)] {
        let mut served = Served::start(rights, "");
        if is_limited {
            served.check_limits();
        }
        served.write_object(1234);
        let log = served.at("in/changes.jsonl");
        assert!(Served::contains(&log, "sdo_write"));
        std::fs::remove_file(&log).unwrap();
        let elsewhere = served.at("out/changes.jsonl");
        symlink(&elsewhere, &log).unwrap();
        served.write_object(4321);
        if is_limited {
            served.program.says("Permission denied");
            assert!(!elsewhere.exists());
        } else {
            assert!(Served::contains(&elsewhere, "sdo_write"));
        }
        served.write_object(1234);
        served.program.interrupt();
        let ended = served.program.end();
        assert!(ended.status.success(), "{ended:?}");
    }
}

/// The return of a device needs nothing that the server gave up.
#[test]
fn a_lost_device_returns_to_a_server_with_few_rights() {
    let off = "[[fault]]\nkind = \"power-off\"\ndevice = 2\nat = \"1s\"\nfor = \"500ms\"\n";
    let served = Served::start("strict", off);
    served.check_limits();
    // The first cycle.
    served.ask("advance", json!({"seconds": 0.1}));
    let happened = |event: &str| {
        let events = served.ask("events", json!({"after": 0}));
        let events = events["events"].as_array().expect("events");
        events.iter().any(|found| found["event"] == event)
    };
    // Events are published by another thread.
    for event in ["device_lost", "device_returned"] {
        let mut rounds = 0..600;
        while !happened(event) {
            assert!(rounds.next().is_some(), "no `{event}`");
            served.ask("advance", json!({"seconds": 0.1}));
        }
    }
    served.check_limits();
    for axis in ["x", "y"] {
        served.ask("reset", json!({"axis": axis, "wait": true}));
        served.ask("enable", json!({"axis": axis, "wait": true}));
    }
    served.ask("move", json!({"axis": "y", "to": 5.0, "wait": true}));
}
