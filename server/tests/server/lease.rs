//! Who may command, and what stops when the owner is gone.

use std::time::{Duration, Instant};

use serde_json::json;

use crate::harness::{Client, Server, demo};

/// Waits in real time until an axis stands.
fn await_rest(client: &mut Client, axis: &str) {
    let start = Instant::now();
    loop {
        let state = client.axis(axis);
        if state["at_rest"] == json!(true) {
            assert_eq!(state["enabled"], json!(true));
            return;
        }
        assert!(start.elapsed() < Duration::from_secs(20), "{state}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn only_the_owner_commands() {
    let server = Server::in_virtual_time(demo());
    let mut other = server.client();
    let error = other.refused("enable", json!({"axis": "x"}));
    assert_eq!(error["code"], json!("no_lease"));
    let mut owner = server.owner("cell");
    let error = other.refused("enable", json!({"axis": "x"}));
    assert_eq!(error["code"], json!("not_owner"));
    assert_eq!(error["owner"]["name"], json!("cell"));
    let error = other.refused("take", json!({"name": "panel"}));
    assert_eq!(error["owner"]["name"], json!("cell"));
    owner.done("enable", json!({"axis": "x"}));
    owner.ok("release", json!({}));
    other.ok("take", json!({"name": "panel"}));
    let error = owner.refused("move", json!({"axis": "x", "to": 1}));
    assert_eq!(error["owner"]["name"], json!("panel"));
}

#[test]
fn a_take_over_stops_the_motion_first() {
    let server = Server::in_virtual_time(demo());
    let mut owner = server.owner("cell");
    owner.done("enable", json!({"axis": "*"}));
    owner.ok("move", json!({"axis": "x", "to": 50}));
    let mut other = server.client();
    other.advance(0.05);
    other.ok("take", json!({"name": "panel", "force": true}));
    other.advance(1.0);
    let axis = other.axis("x");
    assert_eq!(axis["at_rest"], json!(true));
    assert!(axis["target_position"].as_f64().unwrap() < 50.0);
    let events = other.kept_events("lease");
    let last = events.last().unwrap();
    assert_eq!(last["why"], json!("taken over"));
    assert_eq!(last["previous"]["name"], json!("cell"));
    assert_eq!(last["owner"]["name"], json!("panel"));
}

#[test]
fn a_stop_needs_no_lease() {
    let server = Server::in_virtual_time(demo());
    let mut owner = server.owner("cell");
    owner.done("enable", json!({"axis": "*"}));
    owner.ok("velocity", json!({"axis": "x", "velocity": 20}));
    owner.advance(0.1);
    let mut other = server.client();
    other.ok("stop", json!({}));
    other.advance(0.5);
    assert_eq!(other.axis("x")["at_rest"], json!(true));
    // The owner keeps the motion.
    owner.done("move", json!({"axis": "x", "to": 0.0}));
    owner.ok("velocity", json!({"axis": "x", "velocity": 20}));
    other.ok("emergency_stop", json!({}));
    other.advance(2.0);
    assert_eq!(other.axis("x")["enabled"], json!(false));
    assert_eq!(other.axis("y")["enabled"], json!(false));
}

#[test]
fn a_connection_that_closes_stops_its_axes() {
    let server = Server::in_virtual_time(demo());
    let mut owner = server.owner("cell");
    owner.done("enable", json!({"axis": "x"}));
    owner.ok("velocity", json!({"axis": "x", "velocity": 20}));
    owner.advance(0.1);
    drop(owner);
    let mut other = server.client();
    // The end of the connection is seen in real time.
    let start = Instant::now();
    while other.ok("state", json!({}))["lease"]["owner"] != json!(null) {
        assert!(start.elapsed() < Duration::from_secs(20));
    }
    other.advance(0.5);
    assert_eq!(other.axis("x")["at_rest"], json!(true));
    let events = other.kept_events("lease");
    assert_eq!(events.last().unwrap()["why"], json!("disconnected"));
    assert_eq!(events.last().unwrap()["previous"]["name"], json!("cell"));
}

#[test]
fn a_silent_owner_stops_its_axes() {
    let server = Server::in_real_time(demo());
    let mut owner = server.client();
    owner.ok("take", json!({"name": "frozen", "ttl_ms": 300}));
    owner.done("enable", json!({"axis": "x"}));
    owner.ok("velocity", json!({"axis": "x", "velocity": 5}));
    let mut other = server.client();
    let start = Instant::now();
    while other.ok("state", json!({}))["lease"]["owner"] != json!(null) {
        assert!(start.elapsed() < Duration::from_secs(20));
        std::thread::sleep(Duration::from_millis(5));
    }
    await_rest(&mut other, "x");
    assert_eq!(
        other.kept_events("lease").last().unwrap()["why"],
        json!("expired")
    );
    let error = owner.refused("velocity", json!({"axis": "x", "velocity": 5}));
    assert_eq!(error["code"], json!("no_lease"));
    other.ok("take", json!({"name": "next"}));
}

#[test]
fn a_jog_that_is_not_repeated_stops() {
    let server = Server::in_virtual_time(demo());
    let mut owner = server.owner("page");
    owner.done("enable", json!({"axis": "x"}));
    for _ in 0..10 {
        owner.ok("jog", json!({"axis": "x", "velocity": 10}));
        owner.advance(0.1);
        assert_eq!(owner.axis("x")["at_rest"], json!(false));
    }
    owner.advance(1.0);
    assert_eq!(owner.axis("x")["at_rest"], json!(true));
    assert_eq!(owner.kept_events("let_go").len(), 1);
    let old = owner.ok("state", json!({}))["time_ns"].clone();
    owner.advance(1.0);
    let error = owner.refused("jog", json!({"axis": "x", "velocity": 10, "seen_ns": old}));
    assert_eq!(error["code"], json!("refused"));
    owner.refused("jog", json!({"axis": "x", "velocity": 100, "wait": true}));
}
