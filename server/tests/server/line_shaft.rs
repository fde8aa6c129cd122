//! Set-points from an axis to a line shaft.

use ecaxis_master::config::{self, Machine};
use serde_json::{Value, json};

use crate::harness::{Client, Server, demo};

/// The demonstration machine with a line shaft.
pub fn with_shaft() -> Machine {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/demo.toml");
    let text = std::fs::read_to_string(&path).unwrap();
    let shaft = "[[line_shaft]]\nname = \"shaft\"\nunit = \"mm\"\nvelocity = 100.0\nacceleration = 1000.0\n";
    config::parse(&path, &format!("{text}\n{shaft}")).unwrap()
}

/// Returns the next set-point with this condition.
fn setpoint(client: &mut Client, wanted: impl Fn(&Value) -> bool) -> Value {
    client.events.clear();
    loop {
        let line = client.line();
        if line["event"] == json!("setpoints") && wanted(&line) {
            return line;
        }
    }
}

fn shaft(client: &mut Client) -> Value {
    client.ok("state", json!({}))["line_shafts"][0].clone()
}

#[test]
fn set_points_of_an_axis_name_their_instant_and_stream() {
    let server = Server::in_virtual_time(demo());
    let mut client = server.owner("test");
    for (keys, part) in [
        (json!({"topics": ["setpoints"], "interval_ms": 5}), "axis"),
        (
            json!({"topics": ["setpoints"], "axis": "x", "interval_ms": 0}),
            "1 to 1000",
        ),
        (
            json!({"topics": ["setpoints", "state"], "axis": "x", "interval_ms": 50}),
            "no other topic",
        ),
        (
            json!({"topics": ["setpoints"], "axis": "q", "interval_ms": 5}),
            "`q`",
        ),
        (
            json!({"topics": ["state"], "axis": "x", "interval_ms": 50}),
            "axis",
        ),
    ] {
        let error = client.refused("subscribe", keys);
        assert!(error["message"].as_str().unwrap().contains(part), "{error}");
    }
    let keys = json!({"topics": ["setpoints"], "axis": "x", "interval_ms": 1});
    client.ok("subscribe", keys);
    // Common time is known, but the axis has no set-point.
    client.locked_state();
    let early = client
        .events
        .iter()
        .filter(|line| line["event"] == json!("setpoints"));
    assert_eq!(early.count(), 0);
    client.done("enable", json!({"axis": "x"}));
    client.done("move", json!({"axis": "x", "to": 10.0}));
    client.send("advance", json!({"cycles": 1}));
    let there = |line: &Value| line["points"][0]["position"] == json!(10.0);
    let first = setpoint(&mut client, there);
    let stream = first["stream"].as_str().unwrap().to_owned();
    assert_eq!((stream.len(), &first["axis"]), (16, &json!("x")));
    let before = first["points"][0]["unix_ns"].as_u64().unwrap();
    client.send("advance", json!({"cycles": 10}));
    let next = setpoint(&mut client, |line| {
        line["points"][0]["unix_ns"] != json!(before)
    });
    let after = next["points"][0]["unix_ns"].as_u64().unwrap();
    assert!(
        after > before && next["stream"] == first["stream"],
        "{next}"
    );
    client.done("disable", json!({"axis": "x"}));
    client.advance(0.1);
    client.done("enable", json!({"axis": "x"}));
    client.send("advance", json!({"cycles": 10}));
    setpoint(&mut client, |line| line["stream"] != json!(stream));
}

#[test]
fn one_connection_feeds_a_line_shaft_until_it_closes() {
    let server = Server::in_virtual_time(with_shaft());
    let mut client = server.client();
    client.advance(2.0);
    let waits = shaft(&mut client);
    assert_eq!(
        (&waits["state"], &waits["client"]),
        (&json!("waiting"), &Value::Null)
    );
    // Common time is virtual time here.
    let now = |client: &mut Client| client.locked_state()["time_ns"].as_u64().unwrap();
    let point = |at: u64, velocity: f64| json!({"unix_ns": at, "position": 1.0, "velocity": velocity, "acceleration": 0.0});
    let feed =
        |stream: &str, points: Value| json!({"name": "shaft", "stream": stream, "points": points});
    let stream = "00000000000000ab";
    let at = now(&mut client);
    let many = vec![point(at, 0.0); 65];
    for (keys, code, part) in [
        (
            json!({"name": "no", "stream": stream, "points": []}),
            "unknown_name",
            "`no`",
        ),
        (feed("xyz", json!([])), "bad_request", "16 hex digits"),
        (feed(stream, json!(many)), "bad_request", "64 points"),
        (
            feed(stream, json!([point(at, 200.0)])),
            "refused",
            "above the limit 100",
        ),
        (
            feed(stream, json!([point(at + 1_000_000_000, 0.0)])),
            "refused",
            "ahead",
        ),
        (feed(stream, json!([point(1, 0.0)])), "refused", "ago"),
        (
            feed(stream, json!([{"unix_ns": 1}])),
            "bad_request",
            "position",
        ),
    ] {
        let error = client.refused("line_shaft", keys);
        assert_eq!(error["code"], json!(code), "{error}");
        assert!(error["message"].as_str().unwrap().contains(part), "{error}");
    }
    assert_eq!(shaft(&mut client)["state"], json!("waiting"));
    let points = json!([
        point(at, 20.0),
        point(at, 90.0),
        point(at + 1_000_000, 20.0)
    ]);
    let answer = client.ok("line_shaft", feed(stream, points));
    assert_eq!(answer["accepted"], json!(2), "one is not newer");
    client.advance(0.01);
    let runs = shaft(&mut client);
    assert_eq!(
        (&runs["state"], &runs["stream"]),
        (&json!("running"), &json!(stream))
    );
    assert!(runs["age_ns"].as_i64().unwrap() > 5_000_000, "{runs}");
    // Another connection, while the first one is there.
    let mut other = server.client();
    let error = other.refused(
        "line_shaft",
        feed(stream, json!([point(at + 20_000_000, 0.0)])),
    );
    assert!(
        error["message"]
            .as_str()
            .unwrap()
            .contains("another connection"),
        "{error}"
    );
    // Its points are too old: another connection may feed the shaft.
    let mut third = server.client();
    third.advance(0.2);
    let at = now(&mut third);
    third.ok(
        "line_shaft",
        feed("00000000000000aa", json!([point(at, 0.0)])),
    );
    let error = client.refused("line_shaft", feed(stream, json!([point(at, 0.0)])));
    let message = error["message"].as_str().unwrap();
    assert!(message.contains("another connection"), "{error}");
    drop(client);
    drop(third);
    let mut stopped = Value::Null;
    for _ in 0..200 {
        other.advance(0.01);
        stopped = shaft(&mut other);
        if stopped["client"] == Value::Null && stopped["state"] == json!("waiting") {
            break;
        }
    }
    assert!(
        stopped["why"].as_str().is_some_and(|why| why != "null"),
        "{stopped}"
    );
    let at = now(&mut other);
    other.ok(
        "line_shaft",
        feed("00000000000000ac", json!([point(at, 0.0)])),
    );
    other.advance(0.01);
    assert_eq!(shaft(&mut other)["state"], json!("running"));
    // The stream ends.
    other.advance(0.2);
    let stopped = shaft(&mut other);
    assert!(
        stopped["why"].as_str().unwrap().contains("timeout"),
        "{stopped}"
    );
    let events = other.kept_events("line_shaft");
    assert_eq!(events.first().unwrap()["state"], json!("running"));
    assert_eq!(events.last().unwrap()["state"], json!("waiting"));
}
