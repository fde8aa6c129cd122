//! Viewers over the Foxglove WebSocket protocol.

use std::collections::HashMap;
use std::io::Write;
use std::net::TcpStream;
use std::time::Duration;

use ecaxis_master::session::Options;
use ecaxis_server::http::HttpOptions;
use ecaxis_test_support::ros2::{Value as Message, decode};
use serde_json::{Value, json};

use crate::fuzz::Random;
use crate::harness::{Server, TOKEN, WATCH_TOKEN, demo};
use crate::hostile::{count, damage, resident};
use crate::http::request;
use crate::websocket::{frame, read_frame, read_now, upgrade};

const PROTOCOL: &str = "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n";

struct Viewer {
    stream: TcpStream,
    channels: Vec<Value>,
    /// The last status that came between messages.
    status: Value,
}

impl Viewer {
    fn new(server: &Server, protocol: &str) -> Self {
        let offer = format!("Sec-WebSocket-Protocol: other, {protocol}\r\n");
        let (mut stream, head) = upgrade(server, "/", &offer);
        let chosen = format!("sec-websocket-protocol: {protocol}\r\n");
        assert!(head.starts_with("HTTP/1.1 101"), "{head}");
        assert!(head.to_lowercase().contains(&chosen), "{head}");
        let info = text(&mut stream);
        assert_eq!(
            (&info["op"], &info["capabilities"]),
            (&json!("serverInfo"), &json!([]))
        );
        let advertised = text(&mut stream);
        assert_eq!(advertised["op"], json!("advertise"));
        let channels = advertised["channels"].as_array().unwrap().clone();
        Self {
            stream,
            channels,
            status: Value::Null,
        }
    }

    fn channel(&self, topic: &str) -> &Value {
        let mut channels = self.channels.iter();
        let found = channels.find(|channel| channel["topic"] == json!(topic));
        found.unwrap_or_else(|| panic!("{topic}"))
    }

    fn send(&mut self, object: &Value) {
        let bytes = frame(1, object.to_string().as_bytes());
        self.stream.write_all(&bytes).unwrap();
    }

    fn subscribe(&mut self, id: u32, topic: &str) {
        let channel = self.channel(topic)["id"].clone();
        let one = json!({"id": id, "channelId": channel});
        self.send(&json!({"op": "subscribe", "subscriptions": [one]}));
    }

    /// Returns the next message: subscription, time, payload.
    fn message(&mut self) -> (u32, u64, Vec<u8>) {
        loop {
            let (opcode, bytes) = read_frame(&mut self.stream);
            if opcode == 2 {
                assert_eq!(bytes[0], 1);
                let id = u32::from_le_bytes(bytes[1..5].try_into().unwrap());
                let time = u64::from_le_bytes(bytes[5..13].try_into().unwrap());
                return (id, time, bytes[13..].to_vec());
            } else if opcode == 1 {
                self.status = serde_json::from_slice(&bytes).unwrap();
            }
        }
    }

    fn decode(&self, topic: &str, payload: &[u8]) -> Message {
        let schema = self.channel(topic)["schema"].as_str().unwrap();
        decode(schema, payload).expect("a message of its schema")
    }
}

/// Returns the next text frame.
fn text(stream: &mut TcpStream) -> Value {
    loop {
        let (opcode, bytes) = read_frame(stream);
        if opcode == 1 {
            return serde_json::from_slice(&bytes).unwrap();
        }
    }
}

#[test]
fn viewers_get_the_values_of_the_samples() {
    let server = Server::with_http(demo(), false);
    let mut client = server.owner("cell");
    client.done("enable", json!({"axis": "x"}));
    for protocol in ["foxglove.sdk.v1", "foxglove.websocket.v1"] {
        let mut viewer = Viewer::new(&server, protocol);
        for channel in &viewer.channels {
            assert_eq!(channel["encoding"], json!("cdr"));
            assert_eq!(channel["schemaEncoding"], json!("ros2msg"));
        }
        let topics = [
            "/ecaxis/axis/x",
            "/joint_states",
            "/ecaxis/bus",
            "/diagnostics",
        ];
        for (id, topic) in (7..).zip(topics) {
            viewer.subscribe(id, topic);
        }
        client.ok("velocity", json!({"axis": "x", "velocity": 1.0}));
        let mut rows = HashMap::new();
        let (mut joints, mut gaps, mut diagnosed) = (HashMap::new(), 0, None);
        while rows.len() < 400 || diagnosed.is_none() {
            let (id, time, payload) = viewer.message();
            let topic = topics[usize::try_from(id - 7).unwrap()];
            let message = viewer.decode(topic, &payload);
            assert_eq!(message.stamp(), time);
            match topic {
                "/ecaxis/axis/x" => drop(rows.insert(message["row"].integer(), (time, message))),
                "/joint_states" => drop(joints.insert(time, message)),
                "/diagnostics" => diagnosed = Some(message),
                _ => gaps += message["missed"].integer(),
            }
        }
        client.ok("stop", json!({}));
        // One by one: every cycle at 1 kHz.
        let (least, greatest) = (rows.keys().min().unwrap(), rows.keys().max().unwrap());
        let span = greatest - least + 1;
        assert_eq!(i128::try_from(rows.len()).unwrap() + gaps, span);
        let path = format!(
            "/api/samples?signals=x.position,x.target_position,x.statusword&first={least}&count={span}"
        );
        let batch = request(&server, "GET", &path, &[], "").body;
        let span = u32::from_le_bytes(batch[4..8].try_into().unwrap()) as usize;
        let word = |at: usize| u64::from_le_bytes(batch[32 + 8 * at..][..8].try_into().unwrap());
        let value = |signal: usize, row: usize| f64::from_bits(word((2 + signal) * span + row));
        let mut moved = 0.0;
        for n in 0..span {
            let Some((time, axis)) = rows.get(&i128::from(word(n))) else {
                continue;
            };
            let position = value(0, n);
            assert_eq!(axis["position"].real(), position);
            assert_eq!(axis["target_position"].real(), value(1, n));
            assert_eq!(axis["statusword"].integer(), value(2, n) as i128);
            if let Some(joint) = joints.get(time) {
                // The axis is in mm.
                assert_eq!(joint["position"].list()[0].real(), position * 1e-3);
            }
            moved += value(1, n) - value(1, n.saturating_sub(1));
        }
        assert!(moved > 0.1 && span >= 400, "{moved} mm in {span} cycles");
        let diagnosed = diagnosed.unwrap();
        let names = diagnosed["status"].list().iter().map(|s| s["name"].text());
        let names: Vec<_> = names.collect();
        assert_eq!(names, ["bus", "device x", "device y", "axis x", "axis y"]);
        viewer.send(&json!({"op": "unsubscribe", "subscriptionIds": [7, 8, 9, 10, 11]}));
        let status = text(&mut viewer.stream);
        assert_eq!(status["op"], json!("status"), "11 is unknown: {status}");
        viewer.subscribe(1, "/joint_states");
        assert_eq!(viewer.message().0, 1, "the others have ended");
    }
}

#[test]
fn viewers_of_another_origin_need_the_token() {
    let server = Server::with_http(demo(), true);
    let status = |path: &str, headers: &str| {
        let (_, head) = upgrade(&server, path, headers);
        head[9..12].parse::<u16>().unwrap()
    };
    let foreign = format!("Origin: https://viewer.example\r\n{PROTOCOL}");
    let host = format!("Host: viewer.example\r\n{PROTOCOL}");
    let with_token = format!("/?token={TOKEN}");
    for (path, headers, expected) in [
        ("/", PROTOCOL, 101),
        ("/", &*foreign, 403),
        ("/?token=0123456789abcdeg", &foreign, 403),
        ("/?x=1&token", &foreign, 403),
        (&with_token, &foreign, 101),
        (&with_token, &host, 403),
        (&with_token, "Origin: https://viewer.example\r\n", 403),
        (&format!("/api/ws?token={TOKEN}"), &foreign, 403),
        (&format!("/api/state?token={TOKEN}"), &foreign, 403),
        ("/", "Sec-WebSocket-Protocol: other\r\n", 400),
        ("/", "", 400),
    ] {
        assert_eq!(status(path, headers), expected, "{path} {headers}");
    }
    let page = request(&server, "GET", "/", &[], "");
    assert!(page.status == 200 && page.body.starts_with(b"<!"));
}

#[test]
fn viewers_off_loopback_need_the_token() {
    let http = HttpOptions {
        address: "0.0.0.0:0".parse().unwrap(),
        control: false,
        token: TOKEN.to_owned(),
        watch_token: Some(WATCH_TOKEN.to_owned()),
        known_token: false,
        hosts: Vec::new(),
        recordings: None,
    };
    let server = Server::start(demo(), Options::default(), Some(http));
    let header = format!("{PROTOCOL}Authorization: Bearer {TOKEN}\r\n");
    for (path, headers, status) in [
        ("/", PROTOCOL, "401"),
        ("/?token=wrong", PROTOCOL, "401"),
        (&*format!("/?token={TOKEN}"), PROTOCOL, "101"),
        ("/", &*header, "101"),
    ] {
        let (_, head) = upgrade(&server, path, headers);
        assert_eq!(&head[9..12], status, "{path}");
    }
}

#[test]
fn the_number_of_viewers_is_bounded() {
    let server = Server::with_http(demo(), false);
    let mut viewers: Vec<_> = (0..16)
        .map(|_| Viewer::new(&server, "foxglove.sdk.v1"))
        .collect();
    let (_, head) = upgrade(&server, "/", PROTOCOL);
    assert!(head.starts_with("HTTP/1.1 429"), "{head}");
    viewers.pop();
    let free = || {
        upgrade(&server, "/", PROTOCOL)
            .1
            .starts_with("HTTP/1.1 101")
    };
    assert!((0..100).any(|_| {
        std::thread::sleep(Duration::from_millis(50));
        free()
    }));
}

/// What a viewer does not read waits in the buffers of its socket, and then not at all: the viewer
/// misses cycles, and learns how many.
#[test]
fn a_viewer_that_reads_too_slowly_misses_cycles() {
    let server = Server::with_http(demo(), false);
    server.client();
    let mut slow = Viewer::new(&server, "foxglove.sdk.v1");
    // The buffer of the server is up to 4 MB, about 8 s.
    rustix::net::sockopt::set_socket_recv_buffer_size(&slow.stream, 65536).unwrap();
    let topics: Vec<_> = slow
        .channels
        .iter()
        .map(|c| c["topic"].as_str().unwrap().to_owned())
        .collect();
    for (id, topic) in (0..).zip(&topics) {
        slow.subscribe(id, topic);
    }
    let bus = u32::try_from(topics.iter().position(|t| t == "/ecaxis/bus").unwrap()).unwrap();
    std::thread::sleep(Duration::from_secs(14));
    let (mut bytes, mut missed, mut last) = (0, 0, None);
    while missed == 0 && bytes < 12 << 20 {
        let (id, _, payload) = slow.message();
        bytes += payload.len();
        if id == bus {
            let message = slow.decode("/ecaxis/bus", &payload);
            let row = message["row"].integer();
            missed = message["missed"].integer();
            let expected = last.map_or(row, |last| last + 1 + missed);
            assert_eq!(row, expected, "each gap is in the message after it");
            last = Some(row);
        }
    }
    println!("{bytes} bytes before a gap of {missed} cycles");
    assert!(missed > 1000, "{missed} cycles after {bytes} bytes");
    let warning = format!("this viewer reads too slowly: it missed {missed} cycles");
    let status = json!({"op": "status", "level": 1, "message": warning});
    assert_eq!(slow.status, status);
}

/// `ECAXIS_FUZZ_REQUESTS` sets the number of frames.
#[test]
fn random_frames_of_viewers_break_nothing() {
    const MESSAGES: &[&str] = &[
        r#"{"op":"subscribe","subscriptions":[{"id":0,"channelId":1},{"id":1,"channelId":3}]}"#,
        r#"{"op":"subscribe","subscriptions":[{"id":4294967295,"channelId":5}]}"#,
        r#"{"op":"unsubscribe","subscriptionIds":[0,1,7]}"#,
        r#"{"op":"advertise","channels":[{"id":1,"topic":"/t","encoding":"cdr","schemaName":"x"}]}"#,
        r#"{"op":"setParameters","parameters":[{"name":"x","value":1}],"id":"1"}"#,
        r#"{"op":"clientInfo","name":"x"}"#,
        r#"{"op":"subscribe","subscriptions":[{"id":-1,"channelId":1e99}]}"#,
    ];
    let rounds = count("ECAXIS_FUZZ_REQUESTS", 1000);
    let server = Server::with_http(demo(), false);
    server.client();
    let mut random = Random(0x1234_5678_9abc_def1);
    let connect = || {
        let (stream, head) = upgrade(&server, "/", PROTOCOL);
        assert!(
            head.starts_with("HTTP/1.1 101") || head.contains("429"),
            "{head}"
        );
        stream
    };
    let (mut stream, mut buffer) = (connect(), [0; 65536]);
    let before = resident();
    for round in 0..rounds {
        let mut payload = MESSAGES[random.below(MESSAGES.len())].as_bytes().to_vec();
        match random.below(4) {
            0 => damage(&mut random, &mut payload),
            1 => {
                payload = (0..random.below(200))
                    .map(|_| random.next() as u8)
                    .collect()
            }
            _ => {}
        }
        // Text, binary, ping, and opcodes that do not exist.
        let opcode = [1, 1, 1, 2, 2, 9, 3][random.below(7)];
        let mut bytes = frame(opcode, &payload);
        if random.below(8) == 0 {
            damage(&mut random, &mut bytes);
        }
        let sent = stream.write_all(&bytes);
        let closed = matches!(read_now(&mut stream, &mut buffer), Ok(0));
        if sent.is_err() || round % 64 == 0 || closed {
            stream = connect();
        }
    }
    drop(stream);
    let grown = resident().saturating_sub(before);
    assert!(grown < 64 << 20, "{grown} bytes more");
    let mut viewer = std::iter::repeat_with(|| {
        std::thread::sleep(Duration::from_millis(50));
        let (stream, head) = upgrade(&server, "/", PROTOCOL);
        head.starts_with("HTTP/1.1 101").then_some(stream)
    });
    let mut stream = viewer.by_ref().take(600).flatten().next().expect("a place");
    assert_eq!(text(&mut stream)["op"], json!("serverInfo"));
}
