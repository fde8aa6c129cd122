//! HTTP: who may read and who may command.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use ecaxis_master::session::Options;
use ecaxis_server::http::HttpOptions;
use serde_json::{Value, json};

use crate::harness::{Server, TOKEN, WATCH_TOKEN, demo};
use crate::websocket::address;

pub struct Reply {
    pub status: u16,
    head: String,
    pub body: Vec<u8>,
}

impl Reply {
    pub fn json(&self) -> Value {
        serde_json::from_slice(&self.body).expect("JSON")
    }
}

pub fn request(
    server: &Server,
    method: &str,
    path: &str,
    headers: &[(&str, &str)],
    body: &str,
) -> Reply {
    let address = address(server);
    let mut stream = TcpStream::connect(&address).unwrap();
    let mut text = format!("{method} {path} HTTP/1.1\r\nConnection: close\r\n");
    if !headers.iter().any(|(name, _)| *name == "Host") {
        text += &format!("Host: {address}\r\n");
    }
    for (name, value) in headers {
        text += &format!("{name}: {value}\r\n");
    }
    text += &format!("Content-Length: {}\r\n\r\n{body}", body.len());
    stream.write_all(text.as_bytes()).unwrap();
    let mut bytes = Vec::new();
    stream.read_to_end(&mut bytes).unwrap();
    let end = bytes
        .windows(4)
        .position(|four| four == b"\r\n\r\n")
        .unwrap();
    let head = String::from_utf8(bytes[..end].to_vec()).unwrap();
    let status = head.split(' ').nth(1).unwrap().parse().unwrap();
    let head = head.to_lowercase();
    let mut body = bytes[end + 4..].to_vec();
    if head.contains("transfer-encoding: chunked") {
        body = without_chunks(&body);
    }
    Reply { status, head, body }
}

/// RFC 9112, 7.1. Panics if the body is not whole.
fn without_chunks(mut chunks: &[u8]) -> Vec<u8> {
    let mut body = Vec::new();
    loop {
        let end = chunks.windows(2).position(|two| two == b"\r\n").unwrap();
        let size = std::str::from_utf8(&chunks[..end]).unwrap();
        let size = usize::from_str_radix(size, 16).unwrap();
        let begin = end + 2;
        if size == 0 {
            return body;
        }
        body.extend(&chunks[begin..begin + size]);
        chunks = &chunks[begin + size + 2..];
    }
}

fn with_token(token: &str) -> [(&'static str, &str); 1] {
    [("Authorization", token)]
}

/// These paths answer GET as well.
#[test]
fn operations_that_read_are_posted_like_all() {
    let server = Server::with_http(demo(), true);
    server.client();
    for op in [
        "machine",
        "state",
        "events",
        "diagnostics",
        "fault_reports",
        "hello",
    ] {
        let reply = request(&server, "POST", &format!("/api/{op}"), &[], "{\"id\": 7}");
        let answer = reply.json();
        assert_eq!(
            (reply.status, &answer["id"]),
            (200, &json!(7)),
            "{op}: {answer}"
        );
    }
}

#[test]
fn commands_need_the_token_and_control() {
    let bearer = format!("Bearer {TOKEN}");
    for control in [true, false] {
        let server = Server::with_http(demo(), control);
        server.client();
        let post = |path: &str, headers: &[(&str, &str)], body: &str| {
            let reply = request(&server, "POST", path, headers, body);
            (reply.status, reply.json())
        };
        let (status, answer) = post("/api/take", &[], "{}");
        assert_eq!(
            (status, &answer["error"]["code"]),
            (401, &json!("no_token"))
        );
        let (status, _) = post("/api/stop", &with_token("Bearer wrong"), "");
        assert_eq!(status, 401);
        let (status, answer) = post("/api/take", &with_token(&bearer), r#"{"ttl_ms": 60000}"#);
        let (stop, _) = post("/api/stop", &with_token(&bearer), "");
        if control {
            assert_eq!((status, stop), (200, 200), "{answer}");
            let without = post("/api/enable", &with_token(&bearer), r#"{"axis": "x"}"#);
            assert_eq!(without.1["error"]["code"], json!("not_owner"));
            let enable = json!({"axis": "x", "lease": answer["lease"]}).to_string();
            let (status, answer) = post("/api/enable", &with_token(&bearer), &enable);
            assert_eq!(status, 200, "{answer}");
            let state = request(&server, "GET", "/api/state", &[], "").json();
            assert_eq!(state["axes"][0]["enabled"], json!(true));
        } else {
            assert_eq!((status, stop), (403, 403));
            assert_eq!(answer["error"]["code"], json!("read_only"));
        }
        let watch = format!("Bearer {WATCH_TOKEN}");
        for (op, body) in [
            ("take", "{}"),
            ("stop", "{}"),
            ("enable", r#"{"axis": "x"}"#),
        ] {
            let path = format!("/api/{op}");
            let (status, answer) = post(&path, &with_token(&watch), body);
            assert_eq!(answer["error"]["code"], json!("read_only"), "{op}");
            assert_eq!(status, 403, "{op}");
        }
        let (status, _) = post("/api/fly", &with_token(&bearer), "");
        assert_eq!(status, 404);
        let (status, _) = post("/api/stop", &with_token(&bearer), "[");
        assert_eq!(status, 400);
        let (status, _) = post("/api/area", &with_token(&bearer), "");
        assert!([403, 409].contains(&status));
    }
}

/// The lease belongs to the program that has its secret. One that only reads does not keep it.
#[test]
fn a_lease_over_http_ends_with_its_owner() {
    let server = Server::with_http(demo(), true);
    server.client();
    let bearer = format!("Bearer {TOKEN}");
    let post = |op: &str, body: Value| {
        let path = format!("/api/{op}");
        request(
            &server,
            "POST",
            &path,
            &with_token(&bearer),
            &body.to_string(),
        )
        .json()
    };
    let lease = post("take", json!({"name": "cell", "ttl_ms": 1000}))["lease"].clone();
    assert_eq!(post("take", json!({}))["error"]["code"], json!("not_owner"));
    for secret in [json!({}), json!({"lease": "0".repeat(32)})] {
        let error = post("renew", secret)["error"].clone();
        assert_eq!(error["code"], json!("not_owner"));
    }
    assert_eq!(post("renew", json!({"lease": lease}))["ok"], json!(true));
    let start = Instant::now();
    let expired = loop {
        let state = request(&server, "GET", "/api/state", &with_token(&bearer), "").json();
        if state["lease"]["owner"] == json!(null) {
            break post("renew", json!({"lease": lease}))["error"].clone();
        }
        assert!(start.elapsed() < Duration::from_secs(20), "{state}");
    };
    assert_eq!(expired["code"], json!("no_lease"));
    let message = expired["message"].as_str().unwrap();
    assert!(
        message.contains("has expired") && message.ends_with("lasts 1 s"),
        "{message}"
    );
    let next = post("take", json!({"name": "next"}));
    assert_eq!(next["ok"], json!(true));
    assert_ne!(next["lease"], lease);
}

#[test]
fn keys_headers_and_signals_that_occur_twice_are_refused() {
    let server = Server::with_http(demo(), true);
    server.client();
    let bearer = format!("Bearer {TOKEN}");
    let twice = r#"{"ttl_ms": 1000, "ttl_ms": 2000}"#;
    let reply = request(&server, "POST", "/api/take", &with_token(&bearer), twice);
    assert_eq!(reply.status, 400);
    let text = reply.json()["error"]["message"].to_string();
    assert!(text.contains("occurs twice"), "{text}");
    let hosts = [("Host", "localhost"), ("Host", "localhost")];
    assert_ne!(
        request(&server, "GET", "/api/state", &hosts, "").status,
        200
    );
    let path = "/api/samples?signals=x.position,x.position";
    assert_eq!(request(&server, "GET", path, &[], "").status, 400);
}

/// A client that sends half a request, again and again.
#[test]
fn half_requests_leave_room_for_a_stop() {
    let server = Server::with_http(demo(), true);
    let mut client = server.owner("cell");
    let address = address(&server);
    let half: Vec<TcpStream> = (0..400)
        .filter_map(|_| {
            let mut stream = TcpStream::connect(&address).ok()?;
            let _ = stream.write_all(b"GET /api/state HTTP/1.1\r\nHost: local");
            Some(stream)
        })
        .collect();
    let mut refused = half.last().unwrap();
    let mut answer = Vec::new();
    // The end may be a reset: the server has not read the request.
    let _ = refused.read_to_end(&mut answer);
    let text = String::from_utf8_lossy(&answer);
    assert!(
        text.is_empty() || text.starts_with("HTTP/1.1 503"),
        "{text}"
    );
    client.ok("stop", json!({}));
    server.client().ok("stop", json!({}));
    drop(half);
    let start = Instant::now();
    let served = || {
        let mut stream = TcpStream::connect(&address).ok()?;
        let text =
            format!("GET /api/state HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
        stream.write_all(text.as_bytes()).ok()?;
        let mut bytes = Vec::new();
        stream.read_to_end(&mut bytes).ok()?;
        bytes.starts_with(b"HTTP/1.1 200").then_some(())
    };
    while served().is_none() {
        assert!(start.elapsed() < Duration::from_secs(20), "no new client");
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn a_link_to_the_page_may_stand_anywhere() {
    let server = Server::with_http(demo(), true);
    server.client();
    let get = |path: &str, [site, mode, to]: [&str; 3]| {
        let headers = [
            ("Sec-Fetch-Site", site),
            ("Sec-Fetch-Mode", mode),
            ("Sec-Fetch-Dest", to),
        ];
        request(&server, "GET", path, &headers, "").status
    };
    for site in ["cross-site", "same-site"] {
        assert_eq!(get("/", [site, "navigate", "document"]), 200);
        assert_eq!(get("/", [site, "navigate", "iframe"]), 403);
        assert_eq!(get("/", [site, "no-cors", "script"]), 403);
        assert_eq!(get("/api/state", [site, "navigate", "document"]), 403);
        assert_eq!(get("/api/samples", [site, "no-cors", "image"]), 403);
    }
    for site in ["same-origin", "none"] {
        assert_eq!(get("/api/state", [site, "cors", "empty"]), 200);
    }
}

#[test]
fn pages_of_other_servers_can_neither_read_nor_command() {
    let server = Server::with_http(demo(), true);
    for headers in [
        [("Origin", "http://example.com"), ("X", "")],
        [("Host", "example.com"), ("X", "")],
        [("Host", "127.0.0.1.example.com:80"), ("X", "")],
        [("Host", "localhost"), ("Origin", "http://localhost:1")],
        [("Origin", "null"), ("X", "")],
    ] {
        for path in ["/", "/api/state", "/metrics"] {
            let reply = request(&server, "GET", path, &headers, "");
            assert_eq!(reply.status, 403, "{headers:?} {path}");
        }
    }
    let reply = request(&server, "GET", "/api/state", &[("Host", "localhost")], "");
    assert_eq!(reply.status, 200);
    assert!(
        reply
            .head
            .contains("content-security-policy: default-src 'self'")
    );
    assert!(!reply.head.contains("access-control-allow"));
}

#[test]
fn samples_and_history_are_exact() {
    let server = Server::with_http(demo(), false);
    let mut client = server.owner("test");
    client.done("enable", json!({"axis": "x"}));
    client.done("move", json!({"axis": "x", "to": 2.0, "speed": 0.05}));
    std::thread::sleep(Duration::from_millis(300));
    let path = "/api/samples?signals=x.target_position&count=400";
    let frame = request(&server, "GET", path, &[], "").body;
    let u32_at = |at: usize| u32::from_le_bytes(frame[at..at + 4].try_into().unwrap());
    let f64_at = |at: usize| f64::from_le_bytes(frame[at..at + 8].try_into().unwrap());
    assert_eq!((frame[0], u32_at(4), u32_at(8)), (1, 400, 1));
    let (times, values) = (32 + 400 * 8, 32 + 800 * 8);
    assert_eq!(frame.len(), values + 400 * 8);
    let values: Vec<f64> = (0..400).map(|n| f64_at(values + n * 8)).collect();
    assert!(
        values.windows(2).all(|pair| pair[0] <= pair[1]),
        "{values:?}"
    );
    assert_eq!(values[399], 2.0);
    let time = u64::from_le_bytes(frame[times..times + 8].try_into().unwrap());
    let path = format!("/api/history?signals=x.target_position&from_ns={time}&buckets=4");
    let history = request(&server, "GET", &path, &[], "").body;
    assert_eq!(history[0], 2);
    let buckets = u32::from_le_bytes(history[4..8].try_into().unwrap()) as usize;
    assert!((1..=4).contains(&buckets));
    let at = |n: usize| f64::from_le_bytes(history[n..n + 8].try_into().unwrap());
    assert_eq!(
        at(16 + buckets * 8),
        values[0],
        "the least value of the first bucket"
    );
    assert_eq!(
        at(16 + buckets * 8 * 3 - 8),
        2.0,
        "the greatest of the last"
    );
    let path = format!("/api/export.csv?signals=x.target_position&from_ns={time}");
    let csv = String::from_utf8(request(&server, "GET", &path, &[], "").body).unwrap();
    assert!(csv.starts_with("row,time_ns,\"x.target_position [mm]\"\r\n"));
    let reply = request(&server, "GET", "/api/samples?signals=z", &[], "");
    assert_eq!(reply.status, 404);
    let reply = request(&server, "GET", "/api/recordings/..%2Fs.sock", &[], "");
    assert_eq!(reply.status, 404);
}

#[test]
fn a_client_that_may_not_command_cannot_fill_the_change_log() {
    let server = Server::with_http(demo(), true);
    let stop =
        |headers: &[(&str, &str)]| request(&server, "POST", "/api/stop", headers, "{}").status;
    assert_eq!(stop(&[]), 401);
    let token = format!("Bearer {TOKEN}");
    assert_eq!(stop(&[("Authorization", &token)]), 200);
    let end = Instant::now() + Duration::from_secs(10);
    while server.changes().is_empty() && Instant::now() < end {
        std::thread::sleep(Duration::from_millis(10));
    }
    let outcomes: Vec<_> = server
        .changes()
        .iter()
        .map(|entry| entry["outcome"].clone())
        .collect();
    assert_eq!(outcomes, [json!("ok")]);
}

/// A recording is a plain file of its folder, whatever its name is.
#[test]
fn links_are_no_recordings() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let recordings = path("recordings");
    std::fs::create_dir(&recordings).unwrap();
    std::fs::write(path("secret"), "secret").unwrap();
    std::fs::write(recordings.join("run.pcapng"), "frames").unwrap();
    std::os::unix::fs::symlink(path("secret"), recordings.join("soft")).unwrap();
    std::fs::hard_link(path("secret"), recordings.join("hard")).unwrap();
    std::fs::create_dir(recordings.join("folder")).unwrap();
    let http = HttpOptions {
        address: "127.0.0.1:0".parse().unwrap(),
        control: false,
        token: TOKEN.to_owned(),
        watch_token: Some(WATCH_TOKEN.to_owned()),
        known_token: false,
        hosts: Vec::new(),
        recordings: Some(recordings),
    };
    let server = Server::start(demo(), Options::default(), Some(http));
    let list = request(&server, "GET", "/api/recordings", &[], "").json();
    let names: Vec<_> = list["recordings"].as_array().unwrap().iter().collect();
    assert_eq!(names.len(), 1, "{list}");
    let get = |name: &str| request(&server, "GET", &format!("/api/recordings/{name}"), &[], "");
    assert_eq!(get("run.pcapng").body, b"frames");
    for name in ["soft", "hard", "folder", "none"] {
        assert_eq!(get(name).status, 404, "{name}");
    }
}
