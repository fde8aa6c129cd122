//! Streams of points.

use serde_json::{Value, json};

use crate::harness::{Client, Server, demo};

/// Position and velocity of a sine of 5 mm in 2 s, from rest.
fn point(t: f64) -> [f64; 2] {
    let w = std::f64::consts::PI;
    [5.0 * (1.0 - (w * t).cos()), 5.0 * w * (w * t).sin()]
}

fn points(range: std::ops::Range<u32>) -> Value {
    let points = range.map(|n| json!(point(f64::from(n) * 0.01)));
    points.collect()
}

fn opened(server: &Server) -> Client {
    let mut client = server.owner("test");
    client.done("enable", json!({"axis": "x"}));
    client.ok("stream_open", json!({"axis": "x", "interval_ms": 10}));
    client
}

#[test]
fn an_axis_passes_all_points_and_stands_at_the_last() {
    let server = Server::in_virtual_time(demo());
    let mut client = opened(&server);
    let pushed = client.ok(
        "stream_push",
        json!({"axis": "x", "points": points(1..151)}),
    );
    assert_eq!(pushed["accepted"], json!(150));
    client.advance(1.0);
    let pushed = client.ok(
        "stream_push",
        json!({"axis": "x", "points": points(151..201)}),
    );
    assert_eq!(pushed["accepted"], json!(50));
    client.ok("stream_close", json!({"axis": "x"}));
    client.advance(1.5);
    assert_eq!(
        client.kept_events("stream").last().unwrap()["state"],
        json!("done")
    );
    // After a whole period the sine is at its start.
    assert!(client.position("x").abs() < 1e-9);
    client.done("move", json!({"axis": "x", "to": 1.0}));
}

#[test]
fn a_stream_without_points_stops_the_axis() {
    let server = Server::in_virtual_time(demo());
    let mut client = opened(&server);
    client.ok("stream_push", json!({"axis": "x", "points": points(1..31)}));
    client.advance(1.0);
    let axis = client.axis("x");
    assert_eq!(axis["at_rest"], json!(true));
    assert_eq!(
        client.kept_events("stream").last().unwrap()["state"],
        json!("underrun")
    );
    let error = client.refused(
        "stream_push",
        json!({"axis": "x", "points": points(31..32)}),
    );
    assert_eq!(error["code"], json!("refused"));
}

#[test]
fn impossible_points_are_refused_with_those_behind_them() {
    let server = Server::in_virtual_time(demo());
    let mut client = opened(&server);
    let far = json!([[0.001, 0.2], [40.0, 0.0], [0.1, 0.0]]);
    let answer = client.ask("stream_push", json!({"axis": "x", "points": far}));
    assert_eq!(answer["ok"], json!(false));
    assert_eq!(answer["error"]["accepted"], json!(1));
    assert!(
        answer["error"]["message"]
            .as_str()
            .unwrap()
            .starts_with("point 2")
    );
    let many = Value::Array(vec![json!([0.0]); 257]);
    let error = client.refused("stream_push", json!({"axis": "x", "points": many}));
    assert_eq!(error["code"], json!("bad_request"));
    // A halt ends the stream.
    client.done("halt", json!({"axis": "x"}));
    let error = client.refused("stream_close", json!({"axis": "x"}));
    assert!(
        error["message"]
            .as_str()
            .unwrap()
            .contains("no open stream")
    );
}

/// CiA 402: 0x60B2 is the torque offset, in per mille of the rated torque.
#[test]
fn a_torque_feed_forward_reaches_the_drive() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/demo.toml");
    let demo = std::fs::read_to_string(&path).unwrap();
    let objects = "pdo.rx = [\"0x6040\", \"0x6060\", \"0x607A\", \"0x60B2\"]\n\n[device.axis]";
    let (x, y) = demo.split_once("\n[device.axis]").unwrap();
    let without = objects.replace(", \"0x60B2\"", "");
    let machine = format!("{x}{objects}{}", y.replacen("\n[device.axis]", &without, 1));
    let machine = ecaxis_master::config::parse(&path, &machine).unwrap();
    let server = Server::in_virtual_time(machine);
    let mut client = server.owner("test");
    client.done("enable", json!({"axis": "*"}));
    client.ok(
        "stream_open",
        json!({"axis": "x", "interval_ms": 100, "prefill": 1}),
    );
    let points = json!([
        [0.0, 0.0, 4.0],
        [0.0, 0.0, 4.0],
        [0.0, 0.0, 4.0],
        [0.0, 0.0, 4.0]
    ]);
    client.ok("stream_push", json!({"axis": "x", "points": points}));
    let offset = |client: &mut Client| {
        let read = client.ok("sdo_read", json!({"device": "x", "index": "0x60B2"}));
        read["value"].as_i64().unwrap()
    };
    client.advance(0.05);
    let rising = offset(&mut client);
    assert!(
        (15..=30).contains(&rising),
        "half of the way to 40: {rising}"
    );
    client.advance(0.15);
    assert_eq!(offset(&mut client), 40);
    client.advance(1.0);
    assert_eq!(offset(&mut client), 0);
    client.ok("stream_open", json!({"axis": "y", "interval_ms": 100}));
    let points = json!([[0.0, 0.0, 4.0]]);
    let error = client.refused("stream_push", json!({"axis": "y", "points": points}));
    assert!(error["message"].as_str().unwrap().contains("0x60B2"));
}
