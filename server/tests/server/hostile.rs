//! Clients that write anything: over TCP, over the WebSocket, into the shared memory.

use std::collections::VecDeque;
use std::io::Write;
use std::net::TcpStream;
use std::time::Duration;

use serde_json::{Value, json};

use crate::fuzz::{Random, mutated};
use crate::harness::{Client, Server, TOKEN, demo};
use crate::memory::{Rows, attach};
use crate::websocket::{address, frame, read_frame, read_now, tcp, websocket};

/// Returns the number in an environment variable.
pub fn count(name: &str, default: u64) -> u64 {
    let value = std::env::var(name).ok();
    value.and_then(|n| n.parse().ok()).unwrap_or(default)
}

/// The resident memory of this process in bytes (proc(5)).
pub fn resident() -> u64 {
    let statm = std::fs::read_to_string("/proc/self/statm").unwrap();
    let pages: u64 = statm.split(' ').nth(1).unwrap().parse().unwrap();
    pages * 4096
}

/// Reads frames until one has this text.
fn read_until(stream: &mut TcpStream, text: &str) {
    while !String::from_utf8_lossy(&read_frame(stream).1).contains(text) {}
}

/// More requests than messages wait, before the first answer is read: the server must not wait for
/// a reader that it keeps from reading.
#[test]
fn a_websocket_that_asks_before_it_reads_gets_all_answers() {
    let server = Server::with_http(demo(), true);
    let mut stream = websocket(&server);
    let mut writer = stream.try_clone().unwrap();
    let asking = std::thread::spawn(move || {
        for id in 0..3000 {
            let request = json!({"op": "machine", "id": format!("number {id}")});
            writer
                .write_all(&frame(1, request.to_string().as_bytes()))
                .unwrap();
        }
    });
    std::thread::sleep(Duration::from_millis(500));
    for id in 0..3000 {
        read_until(&mut stream, &format!("\"number {id}\""));
    }
    asking.join().unwrap();
}

const REQUESTS: &[&str] = &[
    "GET / HTTP/1.1\r\nHost: HOST\r\n\r\n",
    "GET /api/state HTTP/1.1\r\nHost: HOST\r\n\r\n",
    "GET /api/history?signals=x.position&from_ns=0&to_ns=9999999999999&buckets=9 HTTP/1.1\r\nHost: HOST\r\n\r\n",
    "GET /api/samples?signals=x.position&count=5&first=0 HTTP/1.1\r\nHost: HOST\r\n\r\n",
    "GET /api/export.csv?signals=x.position&from_ns=0&to_ns=1 HTTP/1.1\r\nHost: HOST\r\n\r\n",
    "POST /api/enable HTTP/1.1\r\nHost: HOST\r\nAuthorization: Bearer TOKEN\r\nContent-Type: application/json\r\nContent-Length: 33\r\n\r\n{\"axis\": \"x\", \"wait\": false}     ",
    "POST /api/move HTTP/1.1\r\nHost: HOST\r\nAuthorization: Bearer TOKEN\r\nContent-Type: application/json\r\nTransfer-Encoding: chunked\r\n\r\n2\r\n{}\r\n0\r\n\r\n",
    "GET /api/recordings/..%2f..%2fetc%2fpasswd HTTP/1.1\r\nHost: HOST\r\n\r\n",
    "GET /metrics HTTP/1.1\r\nHost: HOST\r\nOrigin: http://other\r\n\r\n",
];

/// Changes some bytes, or cuts the end.
pub fn damage(random: &mut Random, bytes: &mut Vec<u8>) {
    for _ in 0..random.below(4) {
        let at = random.below(bytes.len());
        match random.below(4) {
            0 => bytes.truncate(at.max(1)),
            1 => bytes.insert(at, (random.next() & 0xff) as u8),
            _ => bytes[at] = (random.next() & 0xff) as u8,
        }
    }
}

/// `ECAXIS_FUZZ_REQUESTS` sets the numbers of requests and of frames.
#[test]
fn random_requests_and_frames_break_nothing() {
    let rounds = count("ECAXIS_FUZZ_REQUESTS", 1000);
    let server = Server::with_http(demo(), true);
    server.client();
    let (mut random, host) = (Random(0x2545_f491_4f6c_dd1d), address(&server));
    let mut buffer = [0; 65536];
    let before = resident();
    // The server has time for an answer before its reader leaves.
    let mut open = VecDeque::new();
    for _ in 0..rounds {
        let mut stream = tcp(&server);
        let text = REQUESTS[random.below(REQUESTS.len())];
        let mut bytes = text
            .replace("HOST", &host)
            .replace("TOKEN", TOKEN)
            .into_bytes();
        damage(&mut random, &mut bytes);
        let _ = stream.write_all(&bytes);
        open.push_back(stream);
        if open.len() > 32 {
            let _ = open.pop_front().map(|mut s| read_now(&mut s, &mut buffer));
        }
    }
    drop(open);
    let mut stream = websocket(&server);
    for round in 0..rounds {
        let mut line = mutated(&mut random);
        line.pop();
        let mut bytes = frame(u8::try_from(random.below(3)).unwrap(), &line);
        if random.below(4) == 0 {
            damage(&mut random, &mut bytes);
        }
        let sent = stream.write_all(&bytes);
        // The server closes after a frame that is none.
        let closed = matches!(read_now(&mut stream, &mut buffer), Ok(0));
        if sent.is_err() || round % 16 == 0 || closed {
            stream = websocket(&server);
        }
    }
    drop(stream);
    let grown = resident().saturating_sub(before);
    assert!(grown < 256 << 20, "{grown} bytes more");
    // The server serves on, and the machine takes commands.
    let mut client = server.client();
    client.ok("take", json!({"force": true, "ttl_ms": 60_000}));
    client.ok("reset", json!({"axis": "*"}));
    client.done("enable", json!({"axis": "*"}));
    client.done("move", json!({"axis": "x", "to": 1.0}));
}

/// A client that subscribes and does not read costs little memory, and no other client waits.
#[test]
fn a_client_that_never_reads_costs_little() {
    let server = Server::in_virtual_time(demo());
    let mut owner = server.owner("cell");
    let before = resident();
    let mut deaf = Client::new(&server.socket());
    deaf.send(
        "subscribe",
        json!({"topics": ["samples", "state", "events"], "interval_ms": 10}),
    );
    // Waits are answered later; here they are answered at once, and no client reads the answers.
    deaf.stream.set_nonblocking(true).unwrap();
    let line = format!(
        "{}\n",
        json!({"op": "sdo_read", "device": "none", "index": 1, "sub": 0})
    );
    for _ in 0..20_000 {
        if deaf.stream.write_all(line.as_bytes()).is_err() {
            break;
        }
    }
    for _ in 0..20 {
        owner.advance(1.0);
    }
    let grown = resident().saturating_sub(before);
    assert!(grown < 128 << 20, "{grown} bytes more");
    owner.done("enable", json!({"axis": "x"}));
    owner.done("move", json!({"axis": "x", "to": 1.0}));
}

/// An emergency stop and a `disable` of all axes wait when the lease of the owner ends.
#[test]
fn the_end_of_a_lease_drops_no_emergency_stop() {
    for op in ["emergency_stop", "disable"] {
        let server = Server::in_virtual_time(demo());
        let mut owner = server.owner("cell");
        owner.done("enable", json!({"axis": "*"}));
        let mut other = server.client();
        // Time stands, so the machine has taken nothing yet.
        match op {
            "disable" => other.ok(op, json!({"axis": "*"})),
            _ => other.ok(op, json!({})),
        };
        owner.ok("release", json!({}));
        other.ok("stop", json!({}));
        other.advance(2.0);
        assert_eq!(other.axis("x")["enabled"], json!(false), "{op}");
    }
}

/// The first of two jogs that come together has an outcome, too.
#[test]
fn each_jog_of_a_burst_is_answered() {
    let server = Server::in_virtual_time(demo());
    let mut owner = server.owner("pendant");
    owner.done("enable", json!({"axis": "x"}));
    let jog = |id: u64| json!({"op": "jog", "axis": "x", "velocity": 5.0, "wait": true, "id": id});
    let burst: Vec<String> = (1000..1050).map(|id| jog(id).to_string()).collect();
    owner.send_line(&burst.join("\n"));
    let mut answers: Vec<Value> = (0..50).map(|_| owner.line()).collect();
    answers.sort_by_key(|answer| answer["id"].as_u64());
    let ids: Vec<_> = answers.iter().filter_map(|a| a["id"].as_u64()).collect();
    assert_eq!(ids, (1000..1050).collect::<Vec<_>>());
}

/// Set-points that a client might write: plausible ones, which move the axis, and nonsense.
fn random_set(random: &mut Random, at: &mut [f64; 2], velocity: &mut [f64; 2]) -> [(u64, f64); 2] {
    std::array::from_fn(|axis| match random.below(400) {
        0 => (random.next(), f64::from_bits(random.next())),
        1 => (1, f64::from_bits(random.next())),
        2 => (2, f64::from_bits(random.next())),
        3 => (1, at[axis] + random.below(1000) as f64 - 500.0),
        4 => (3, 5.0),
        5 => (0, 0.0),
        6 => (2, random.below(600) as f64 - 300.0),
        _ => {
            // Up to 1.25 times the limits of acceleration and velocity.
            velocity[axis] += (random.below(1000) as f64 - 500.0) * 6.25e-3;
            velocity[axis] = velocity[axis].clamp(-312.0, 312.0);
            at[axis] += velocity[axis] * 1e-3;
            (1, at[axis])
        }
    })
}

/// Whatever is in the area: range, velocity and acceleration of the machine file hold in every
/// cycle. `ECAXIS_FUZZ_CYCLES` sets the number of cycles.
#[test]
fn random_words_in_the_area_exceed_no_limit() {
    const DT: f64 = 1e-3;
    let cycles = count("ECAXIS_FUZZ_CYCLES", 5_000);
    let server = Server::in_virtual_time(demo());
    let mut client = server.owner("random");
    client.done("enable", json!({"axis": "*"}));
    let area = attach(&mut client);
    let limits = client.ok("machine", json!({}))["axes"][0]["limits"].clone();
    let limit = |name: &str| limits[name].as_f64().unwrap();
    let (fastest, steepest) = (limit("velocity"), limit("acceleration"));
    let [low, high] = [0, 1].map(|end| limits["position"][end].as_f64().unwrap());
    let mut random = Random(0x9e37_79b9_7f4a_7c15);
    let (mut rows, words) = (
        Rows::new(&area, "x"),
        usize::try_from(area.commands.get(2)).unwrap(),
    );
    let (mut at, mut velocity) = ([0.0; 2], [0.0; 2]);
    let mut seen: Vec<f64> = Vec::new();
    let (mut checked, mut moved) = (0_u64, 0.0);
    for cycle in 1..=cycles {
        let set = random_set(&mut random, &mut at, &mut velocity);
        match random.below(200) {
            // Any word, also those of the server, and a sequence that never ends.
            0 => {
                // The client itself needs the first word of the axes.
                let at = Some(random.below(words + 8)).filter(|at| *at != 2);
                area.commands.set(at.unwrap_or(words), random.next());
            }
            1 => area.write(random.next(), &set),
            2 => area.commands.set(5, 2 * cycle + 1),
            3 => {}
            _ => {
                area.commands.set(5, 2 * cycle);
                area.write(cycle, &set);
            }
        }
        client.ok("advance", json!({"cycles": 1}));
        while let Some((target, enabled)) = rows.read() {
            at[0] = if random.below(64) == 0 { target } else { at[0] };
            if !enabled {
                seen.clear();
                continue;
            }
            assert!((low..=high).contains(&target), "{cycle}: {target}");
            seen.push(target);
            if let [.., a, b, c] = seen[..] {
                let (before, after) = ((b - a) / DT, (c - b) / DT);
                assert!(
                    after.abs() <= fastest * (1.0 + 1e-6),
                    "{cycle}: {after} mm/s"
                );
                let change = (after - before).abs() / DT;
                assert!(change <= steepest * (1.0 + 1e-4), "{cycle}: {change} mm/s²");
                (checked, moved) = (checked + 1, moved + (c - b).abs());
            }
        }
        if cycle % 50 == 0 {
            // Follow again from where the axis stands.
            area.commands.set(5, 0);
            area.write(cycle << 32, &[(0, 0.0), (0, 0.0)]);
            client.ok("advance", json!({"seconds": 0.2}));
            let state = client.ok("state", json!({}))["axes"].clone();
            for axis in 0..2 {
                at[axis] = state[axis]["target_position"].as_f64().unwrap();
                velocity[axis] = 0.0;
                if state[axis]["enabled"] != json!(true) {
                    client.ok("reset", json!({"axis": "*"}));
                    client.done("enable", json!({"axis": "*"}));
                }
            }
        }
    }
    println!(
        "{checked} cycles checked, {moved} mm, {} sets used, {} set-points refused",
        area.commands.get(9),
        area.commands.get(11)
    );
    assert!(checked > cycles / 2 && moved > 1.0, "{checked}, {moved}");
}

/// 500 clients of each kind connect and say nothing, or half of a request.
#[test]
fn idle_connections_disturb_neither_owner_nor_cycle() {
    let server = Server::with_http(demo(), true);
    let mut owner = server.client();
    owner.ok("take", json!({"name": "cell", "ttl_ms": 60_000}));
    owner.done("enable", json!({"axis": "x"}));
    let idle: Vec<_> = (0..500)
        .map(|n| {
            let mut stream = tcp(&server);
            if n % 2 == 0 {
                stream.write_all(b"GET /api/state HTTP/1.1\r\nHo").unwrap();
            }
            let socket = std::os::unix::net::UnixStream::connect(server.socket()).unwrap();
            (stream, socket)
        })
        .collect();
    owner.done("move", json!({"axis": "x", "to": 2.0}));
    let lease = owner.ok("state", json!({}))["lease"]["owner"]["name"].clone();
    assert_eq!(lease, json!("cell"));
    drop(idle);
    owner.done("move", json!({"axis": "x", "to": 0.0}));
}
