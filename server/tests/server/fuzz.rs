//! Whatever a client sends, the server lives and the axes keep their limits.

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;

use serde_json::{Value, json};

use crate::harness::{Client, Server, demo};
use crate::line_shaft::with_shaft;

/// A small generator with a fixed seed (xorshift64).
pub struct Random(pub u64);

impl Random {
    pub fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    pub fn below(&mut self, n: usize) -> usize {
        usize::try_from(self.next() % n as u64).unwrap()
    }
}

const LINES: &[&str] = &[
    r#"{"op": "hello", "name": "x", "id": 1}"#,
    r#"{"op": "take", "ttl_ms": 1000, "force": true}"#,
    r#"{"op": "enable", "axis": "*"}"#,
    r#"{"op": "move", "axis": "x", "to": 5.5, "speed": 0.5}"#,
    r#"{"op": "velocity", "axis": "y", "velocity": -20.0}"#,
    r#"{"op": "jog", "axis": "x", "velocity": 10}"#,
    r#"{"op": "mode", "axis": "x", "mode": "csp"}"#,
    r#"{"op": "override", "factor": 0.5}"#,
    r#"{"op": "program", "action": "start"}"#,
    r#"{"op": "stream_open", "axis": "x", "interval_ms": 10, "prefill": 1}"#,
    r#"{"op": "stream_push", "axis": "x", "points": [[0.1, 1.0], [0.2]]}"#,
    r#"{"op": "sdo_read", "device": "x", "index": "0x6061", "sub": 0}"#,
    r#"{"op": "subscribe", "topics": ["events", "state", "samples"], "interval_ms": 10}"#,
    r#"{"op": "subscribe", "topics": ["setpoints"], "axis": "x", "interval_ms": 1}"#,
    r#"{"op": "line_shaft", "name": "shaft", "stream": "00000000000000ab", "points": [{"unix_ns": 1795651200000000000, "position": 1.0, "velocity": 0.5, "acceleration": 0}]}"#,
    r#"{"op": "unsubscribe", "topics": ["samples"]}"#,
    r#"{"op": "state"}"#,
    r#"{"op": "disable", "axis": "*"}"#,
    r#"{"op": "advance", "cycles": 3}"#,
    r#"{"op": "release"}"#,
];
const PARTS: &[&str] = &[
    "1e308",
    "-1e308",
    "null",
    "\"*\"",
    "{}",
    "[]",
    "true",
    "\"\\u0000\"",
    "-0",
    "0.1",
    "\"x\"",
    "18446744073709551616",
    "[[[[[[",
    "}",
    "\"",
    ":",
];

pub fn mutated(random: &mut Random) -> Vec<u8> {
    let mut line = LINES[random.below(LINES.len())].as_bytes().to_vec();
    match random.below(6) {
        0 => {}
        1 => {
            let at = random.below(line.len());
            line[at] = (random.next() & 0xff) as u8;
        }
        2 => {
            let at = random.below(line.len());
            line.truncate(at);
        }
        3 => {
            let other = LINES[random.below(LINES.len())].as_bytes();
            let at = random.below(line.len());
            line.truncate(at);
            line.extend_from_slice(&other[random.below(other.len())..]);
        }
        4 => {
            let part = PARTS[random.below(PARTS.len())].as_bytes();
            let at = random.below(line.len());
            let end = (at + random.below(8)).min(line.len());
            line.splice(at..end, part.iter().copied());
        }
        _ => {
            line = (0..random.below(200))
                .map(|_| (random.next() & 0xff) as u8)
                .collect()
        }
    }
    line.retain(|byte| *byte != b'\n');
    line.push(b'\n');
    line
}

/// `ECAXIS_FUZZ_LINES` sets the number of lines.
#[test]
fn random_lines_break_nothing() {
    let lines = std::env::var("ECAXIS_FUZZ_LINES")
        .ok()
        .and_then(|n| n.parse().ok());
    let lines: u32 = lines.unwrap_or(20_000);
    let server = Server::in_virtual_time(with_shaft());
    server.client();
    let mut random = Random(0x9e37_79b9_7f4a_7c15);
    for round in 0..lines.div_ceil(1000) {
        let mut stream = UnixStream::connect(server.socket()).unwrap();
        let mut reader = stream.try_clone().unwrap();
        let drain = std::thread::spawn(move || {
            let mut buffer = [0; 65536];
            while let Ok(count @ 1..) = reader.read(&mut buffer) {
                let _ = count;
            }
        });
        for _ in 0..1000 {
            stream.write_all(&mutated(&mut random)).unwrap();
        }
        // A long line is refused as a whole.
        if round == 0 {
            stream.write_all(&vec![b'a'; 200_000]).unwrap();
        }
        drop(stream.shutdown(std::net::Shutdown::Both));
        drop(stream);
        drain.join().unwrap();
    }
    let mut client = server.client();
    // The server may still read lines of the last connection, which take the lease again.
    let owns = |client: &mut Client| {
        client.ok("take", json!({"force": true, "name": "last"}));
        client.advance(1.0);
        client.ok("state", json!({}))["lease"]["owner"]["name"] == json!("last")
    };
    assert!((0..100).any(|_| owns(&mut client)));
    let axis = client.axis("x");
    let position = axis["target_position"].as_f64().unwrap();
    assert!((-60.0..=60.0).contains(&position), "{axis}");
    client.done("reset", json!({"axis": "*"}));
    client.done("enable", json!({"axis": "*"}));
    client.done("move", json!({"axis": "x", "to": 1.0}));
}

#[test]
fn a_long_line_is_refused_and_the_next_is_read() {
    let server = Server::in_virtual_time(demo());
    let mut client = server.client();
    client.send_line(&"x".repeat(100_000));
    let answer: Value = client.line();
    assert_eq!(answer["error"]["code"], json!("too_large"));
    client.ok("state", json!({}));
}

#[test]
fn many_connections_that_say_nothing_disturb_no_client() {
    let server = Server::in_virtual_time(demo());
    let mut owner = server.owner("cell");
    let idle: Vec<_> = (0..500)
        .map(|_| UnixStream::connect(server.socket()).unwrap())
        .collect();
    owner.done("enable", json!({"axis": "x"}));
    owner.done("move", json!({"axis": "x", "to": 2.0}));
    drop(idle);
    owner.done("move", json!({"axis": "x", "to": 0.0}));
}
