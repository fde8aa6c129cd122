//! Commands and their outcomes.

use std::time::{Duration, Instant};

use serde_json::json;

use crate::harness::{Server, demo};

#[test]
fn a_client_enables_moves_and_disables() {
    let server = Server::in_virtual_time(demo());
    let mut client = server.owner("test");
    client.done("enable", json!({"axis": "*"}));
    assert_eq!(client.axis("x")["state"], json!("Operation enabled"));
    let answer = client.done("move", json!({"axis": "x", "to": 20.0, "speed": 0.5}));
    assert!(answer["request"].as_u64().is_some());
    let axis = client.axis("x");
    // In CSP, bit 12 says that the drive follows the command value (CiA 402-2).
    assert_eq!(axis["statusword"], json!(0x1237));
    let text = "Operation enabled, bit 12";
    assert_eq!(axis["statusword_text"], json!(text));
    assert_eq!(axis["controlword"], json!(0x000f));
    assert_eq!(axis["controlword_text"], json!("enable operation"));
    assert_eq!(axis["target_position"], json!(20.0));
    assert_eq!(axis["in_target"], json!(true));
    client.done("move", json!({"axis": "x", "by": -5.0}));
    assert_eq!(client.position("x"), 15.0);
    client.done("disable", json!({"axis": "*"}));
    assert_eq!(client.axis("x")["enabled"], json!(false));
}

#[test]
fn time_stands_still_between_requests() {
    let server = Server::in_virtual_time(demo());
    let mut client = server.owner("test");
    let start = client.ok("advance", json!({"cycles": 1}))["time_ns"]
        .as_u64()
        .unwrap();
    std::thread::sleep(Duration::from_millis(50));
    let end = client.ok("advance", json!({"cycles": 500}))["time_ns"]
        .as_u64()
        .unwrap();
    // A cycle begins up to one cycle time after the end.
    assert!(
        (500_000_000..501_000_000).contains(&(end - start)),
        "{start} {end}"
    );
    let state = client.ok("state", json!({}))["time_ns"].as_u64().unwrap();
    assert!((end - 3_000_000..=end).contains(&state), "{state} {end}");
}

#[test]
fn refusals_say_why() {
    let server = Server::in_virtual_time(demo());
    let mut client = server.owner("test");
    client.done("enable", json!({"axis": "x"}));
    for (op, keys, code, part) in [
        ("move", json!({"axis": "z", "to": 1}), "unknown_name", "`z`"),
        ("move", json!({"axis": "x"}), "bad_request", "`to` or `by`"),
        (
            "move",
            json!({"axis": "x", "to": 1000, "wait": true}),
            "refused",
            "range",
        ),
        (
            "move",
            json!({"axis": "x", "to": 1, "speed": 2, "wait": true}),
            "refused",
            "%",
        ),
        (
            "velocity",
            json!({"axis": "x", "velocity": 1e9, "wait": true}),
            "refused",
            "velocity",
        ),
        (
            "torque",
            json!({"axis": "x", "torque": 1, "wait": true}),
            "refused",
            "CST",
        ),
        (
            "mode",
            json!({"axis": "x", "mode": "hm"}),
            "unknown_name",
            "hm",
        ),
        (
            "home",
            json!({"axis": "x", "wait": true}),
            "refused",
            "homing",
        ),
        ("override", json!({"factor": 1.3}), "bad_request", "factor"),
        ("hold", json!({"group": "none"}), "unknown_name", "none"),
        (
            "output",
            json!({"device": "x", "output": "Controlword", "value": 1}),
            "unknown_name",
            "Controlword",
        ),
        (
            "sdo_read",
            json!({"device": "x", "index": "0x9999"}),
            "aborted",
            "0x9999",
        ),
        (
            "sdo_read",
            json!({"device": "z", "index": 1}),
            "unknown_name",
            "z",
        ),
        (
            "sdo_write",
            json!({"device": "x", "index": "0x6060", "value": 300}),
            "bad_request",
            "fit",
        ),
        (
            "stream_push",
            json!({"axis": "x", "points": [[1]]}),
            "refused",
            "stream",
        ),
        ("area", json!({"x": 1}), "bad_request", "x"),
        ("advance", json!({"seconds": -1}), "bad_request", "seconds"),
        ("token", json!({"token": "x"}), "no_token", "token"),
        (
            "program",
            json!({"action": "pause", "wait": true}),
            "failed",
            "program",
        ),
    ] {
        let error = client.refused(op, keys.clone());
        let message = error["message"].as_str().unwrap();
        assert_eq!(error["code"], json!(code), "{op} {keys}: {error}");
        assert!(message.contains(part), "{op} {keys}: {error}");
    }
    assert_eq!(client.position("x"), 0.0);
}

#[test]
fn objects_are_read_and_written() {
    let server = Server::in_virtual_time(demo());
    let mut client = server.owner("test");
    let read = client.ok("sdo_read", json!({"device": "x", "index": "0x6061"}));
    assert_eq!((&read["data"], &read["value"]), (&json!("08"), &json!(8)));
    client.ok(
        "sdo_write",
        json!({"device": "x", "index": "0x6065", "value": 4000}),
    );
    let read = client.ok("sdo_read", json!({"device": "x", "index": 0x6065}));
    assert_eq!(read["value"], json!(4000));
    client.ok(
        "sdo_write",
        json!({"device": "x", "index": "0x6065", "data": "d0070000"}),
    );
    let read = client.ok("sdo_read", json!({"device": "x", "index": 0x6065}));
    assert_eq!(read["value"], json!(2000));
}

#[test]
fn a_later_command_replaces_a_motion() {
    let server = Server::in_virtual_time(demo());
    let mut client = server.owner("test");
    client.done("enable", json!({"axis": "x"}));
    let first = client.ok("move", json!({"axis": "x", "to": 50}))["request"].clone();
    client.advance(0.05);
    client.done("move", json!({"axis": "x", "to": 10}));
    assert_eq!(client.position("x"), 10.0);
    let second = client.ok("move", json!({"axis": "x", "to": 50}))["request"].clone();
    client.advance(0.05);
    client.ok("stop", json!({}));
    client.advance(1.0);
    let axis = client.axis("x");
    assert_eq!(axis["at_rest"], json!(true));
    assert_eq!(axis["enabled"], json!(true));
    let replaced = client.kept_events("replaced");
    let replaced: Vec<_> = replaced.iter().map(|event| &event["request"]).collect();
    assert_eq!(replaced, [&first, &second]);
}

#[test]
fn the_program_of_the_file_runs_pauses_and_ends() {
    let server = Server::in_virtual_time(demo());
    let mut client = server.owner("test");
    let run = client.send("program", json!({"action": "start", "wait": true}));
    let refused = client.refused("move", json!({"axis": "x", "to": 1, "wait": true}));
    assert!(refused["message"].as_str().unwrap().contains("program"));
    assert_eq!(client.answer(run)["ok"], json!(true));
    let steps = client.kept_events("program");
    let began = steps
        .iter()
        .filter(|event| event["step"].is_string())
        .count();
    assert_eq!(began, 8, "four steps, twice");
    // One step alone, then the end.
    client.done("program", json!({"action": "step"}));
    client.advance(2.0);
    let state = client.ok("state", json!({}));
    assert_eq!(state["program"]["paused"], json!(true));
    assert_eq!(client.position("x"), 50.0);
    client.done("program", json!({"action": "stop"}));
    client.advance(0.1);
    assert_eq!(
        client.ok("state", json!({}))["program"]["running"],
        json!(false)
    );
}

/// Virtual time begins in 1970. The demonstration has two drives with SYNC0.
#[test]
fn the_program_starts_at_an_instant_of_common_time() {
    let server = Server::in_virtual_time(demo());
    let mut client = server.owner("test");
    let state = client.locked_state();
    let common = &state["bus"]["common_time"];
    assert_eq!(common["clock"], json!("CLOCK_REALTIME"));
    assert_eq!(
        (&common["locked"], &common["aligned"]),
        (&json!(true), &json!(null))
    );
    let now = state["time_ns"].as_u64().expect("a time");
    for (action, at, code, part) in [
        ("start", now - 1_000_000, "failed", "in the past"),
        ("start", now + 4_000_000_000_000, "failed", "1 h"),
        ("pause", now + 1_000_000_000, "bad_request", "start"),
    ] {
        let keys = json!({"action": action, "at_unix_ns": at, "wait": true});
        let refused = client.refused("program", keys);
        assert_eq!(refused["code"], json!(code), "{refused}");
        assert!(
            refused["message"].as_str().unwrap().contains(part),
            "{refused}"
        );
    }
    let at = now + 3_000_000_000;
    let start = json!({"action": "start", "at_unix_ns": at});
    client.ok("program", start.clone());
    client.advance(2.5);
    let state = client.ok("state", json!({}));
    assert_eq!(state["program"]["running"], json!(true));
    let x = &state["axes"][0];
    assert_eq!(
        (&x["enabled"], &x["moving"]),
        (&json!(true), &json!(false)),
        "{x}"
    );
    client.advance(0.6);
    assert_eq!(client.axis("x")["moving"], json!(true));
    client.done("program", json!({"action": "stop"}));
    client.advance(1.0);
    // Another client may stop it before it starts.
    let now = client.ok("state", json!({}))["time_ns"]
        .as_u64()
        .expect("a time");
    let at = now + 1_000_000_000;
    client.ok("program", json!({"action": "start", "at_unix_ns": at}));
    client.advance(0.9);
    let mut other = server.client();
    other.ok("stop", json!({}));
    let before = client.position("x");
    client.advance(1.0);
    assert_eq!(client.position("x"), before);
    let state = client.ok("state", json!({}));
    assert_eq!(state["program"]["running"], json!(false));
}

#[test]
fn an_override_scales_a_running_move() {
    let server = Server::in_virtual_time(demo());
    let mut client = server.owner("test");
    client.done("enable", json!({"axis": "x"}));
    client.ok("move", json!({"axis": "x", "to": 50.0, "speed": 0.2}));
    client.advance(0.2);
    let fast = client.axis("x")["target_velocity"].as_f64().unwrap();
    client.done("override", json!({"factor": 0.5}));
    client.advance(0.2);
    let slow = client.axis("x")["target_velocity"].as_f64().unwrap();
    assert!(
        (fast - 50.0).abs() < 1e-6 && (slow - 25.0).abs() < 1e-6,
        "{fast} {slow}"
    );
    assert_eq!(client.ok("state", json!({}))["override"], json!(0.5));
}

#[test]
fn the_bus_goes_down_and_comes_up() {
    let server = Server::in_virtual_time(demo());
    let mut client = server.owner("test");
    client.done("enable", json!({"axis": "x"}));
    client.ok("bus", json!({"action": "down"}));
    client.ok("await", json!({"bus": "down"}));
    let error = client.refused("enable", json!({"axis": "x"}));
    assert_eq!(error["code"], json!("not_up"));
    client.ok("bus", json!({"action": "up"}));
    client.ok("await", json!({"bus": "op"}));
    client.done("enable", json!({"axis": "x"}));
    client.done("move", json!({"axis": "x", "to": 3.0}));
}

#[test]
fn commands_are_in_the_change_log_with_their_client() {
    let server = Server::in_virtual_time(demo());
    let mut client = server.owner("cell");
    client.done("enable", json!({"axis": "*"}));
    client.ok("override", json!({"factor": 0.5}));
    let write = json!({"device": "x", "index": 0x6065, "value": 1500});
    client.ok("sdo_write", write);
    for _ in 0..5 {
        client.ok("state", json!({}));
        client.ok("renew", json!({}));
        client.ok("jog", json!({"axis": "x", "velocity": 1.0}));
    }
    let mut other = server.client();
    other.refused("move", json!({"axis": "x", "to": 1.0}));
    other.ok("note", json!({"text": "a new spindle"}));
    other.refused("note", json!({"text": "x".repeat(2001)}));
    let expected = [
        "take",
        "enable",
        "override",
        "sdo_write",
        "jog",
        "move",
        "note",
        "note",
    ];
    // The thread that writes is not waited for.
    let end = Instant::now() + Duration::from_secs(10);
    while server.changes().len() < expected.len() && Instant::now() < end {
        std::thread::sleep(Duration::from_millis(10));
    }
    let changes = server.changes();
    let commands: Vec<_> = changes
        .iter()
        .map(|entry| &entry["command"]["op"])
        .collect();
    assert_eq!(commands, expected);
    let text = changes[7]["command"]["text"].as_str();
    assert_eq!(text.map(str::len), Some(2000), "a part of a refused note");
    for entry in &changes[1..5] {
        assert_eq!(entry["client"]["name"], json!("cell"));
        assert_eq!(entry["client"]["peer"]["pid"], json!(std::process::id()));
        assert_eq!(entry["outcome"], json!("ok"));
    }
    assert_eq!(changes[3]["command"]["value"], json!(1500));
    assert_eq!(changes[3]["sha256"].as_str().map(str::len), Some(64));
    let refused = changes[5]["outcome"].as_str().unwrap();
    assert!(refused.contains("cell"), "{refused}");
    assert_eq!(changes[6]["command"]["text"], json!("a new spindle"));
    assert_eq!(changes[6]["outcome"], json!("ok"));
}

/// A client presses the inputs of a simulated bus, without the lease.
#[test]
fn a_client_presses_inputs_of_the_simulated_bus() {
    let mut machine = ecaxis_test_support::load("pick-and-place.toml");
    machine.steps.truncate(1);
    let server = Server::in_virtual_time(machine);
    let mut client = server.client();
    let named = client.ok("machine", json!({}))["sim_inputs"].clone();
    let names: Vec<_> = named
        .as_array()
        .unwrap()
        .iter()
        .map(|each| each["input"].clone())
        .collect();
    assert!(
        names.contains(&json!("start")) && !names.contains(&json!("lamp")),
        "{names:?}"
    );
    let mut value = |name: &str, value: f64| {
        client.ok(
            "sim_input",
            json!({"input": name, "value": value, "wait": true}),
        );
        client.ok("advance", json!({"cycles": 5}));
        let state = client.ok("state", json!({}));
        let inputs = state["inputs"].as_array().unwrap().clone();
        let input = inputs.iter().find(|each| each["name"] == json!("Input 5"));
        input.unwrap()["value"].clone()
    };
    assert_eq!(value("start", 1.0), json!(1.0));
    assert_eq!(value("io.Input 5", 0.0), json!(0.0));
    let refused = client.refused("sim_input", json!({"input": "lamp", "value": 1.0}));
    assert_eq!(refused["code"], json!("unknown_name"));
    let refused = client.refused("sim_input", json!({"input": "start", "value": 2.0}));
    assert!(refused["message"].as_str().unwrap().contains("not a value"));
}

/// A client could cut the power of a drive behind a gateway, move its target and reset its node with
/// `output`.
#[test]
fn nodes_and_control_words_of_gateways_are_commanded_by_requests_only() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/mixed.toml");
    let machine = ecaxis_master::config::load(&path).unwrap();
    let server = Server::in_virtual_time(machine);
    let mut client = server.owner("test");
    client.done("enable", json!({"axis": "feed"}));
    for (output, owner) in [
        (
            "Output byte 0000",
            "is the control word of `gateway` in line",
        ),
        (
            "Output byte 0001",
            "is the control word of `gateway` in line",
        ),
        ("Output byte 0002", "carries 0x6040 of node 1 in line"),
        ("Output byte 0005", "carries 0x607A of node 1 in line"),
    ] {
        let keys = json!({"device": "gateway", "output": output, "value": 64});
        let error = client.refused("output", keys);
        let text = error["message"].as_str().unwrap();
        assert!(
            text.contains(owner) && text.contains("a client may not write it"),
            "{error}"
        );
    }
    let node =
        |action: &str| json!({"device": "gateway", "node": 1, "action": action, "wait": true});
    for action in ["stop", "pre_operational", "reset", "start"] {
        let error = client.refused("node", node(action));
        let text = error["message"].as_str().unwrap();
        assert!(text.contains("`feed`: the axis has power"), "{error}");
    }
    for (keys, part) in [
        (json!({"device": "x", "node": 1, "action": "stop"}), "`x`"),
        (
            json!({"device": "gateway", "node": 9, "action": "stop"}),
            "no node 9",
        ),
    ] {
        let error = client.refused("node", keys);
        assert!(error["message"].as_str().unwrap().contains(part), "{error}");
    }
    for action in ["stop", "pre_operational", "reset"] {
        client.done("disable", json!({"axis": "feed"}));
        client.done("node", node(action));
        client.advance(2.0);
        // The node is not lost: its axis and the others go on.
        let feed = client.axis("feed");
        assert_eq!(feed["trip"], json!(null), "{action}: {feed}");
        if action != "reset" {
            client.done("node", node("start"));
        }
        client.advance(1.0);
        client.done("enable", json!({"axis": "feed"}));
        client.done("move", json!({"axis": "feed", "by": 1.0}));
    }
}
